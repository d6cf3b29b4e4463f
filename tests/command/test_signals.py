"""Signals and broken outputs that a run outlives, or that end it without noise: with PETSc loaded, as in every run."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import pyvista

from remodel_fenicsx.results.recording import read_history
from tests.body.test_lumen import tube
from tests.conftest import slowly
from tests.forks import forked
from tests.processes import ran, wait_for_rows

PROJECT = Path(__file__).parents[2]
CUBE = ["run", str(PROJECT / "demos" / "cube.toml"), "--set", "time.end=10"]
COMMAND = [sys.executable, "-m", "remodel_fenicsx.cli", *CUBE]


@pytest.mark.parametrize("stream", ["both", *slowly("stdout", "stderr")])
def test_a_reader_that_goes_away_costs_no_step(stream: str, tmp_path: Path) -> None:
    """`remodel-fenicsx run ... 2>&1 | head -1`."""
    reading, writing = os.pipe()
    os.close(reading)
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    streams |= dict.fromkeys(streams if stream == "both" else [stream], writing)
    done = subprocess.run([*COMMAND, "-o", tmp_path / "out"], timeout=200, text=True, **streams)  # type: ignore
    os.close(writing)
    assert read_history(tmp_path / "out")["time"][-1] == 10
    # 120: Python itself could not say its last word
    assert done.returncode in (0, 120), done.stderr
    assert "Traceback" not in (done.stderr or "") and "PETSC" not in (done.stderr or "")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="Linux has a disk that is always full")
def test_a_full_disk_below_stdout_is_exit_code_5(tmp_path: Path) -> None:
    program = """
import os, sys
from remodel_fenicsx import cli
os.dup2(os.open("/dev/full", os.O_WRONLY), 1)
os._exit(cli.main(sys.argv[1:]))  # what it has not written by itself is lost
"""
    done = forked("python", program, *CUBE, "-q", "-o", tmp_path / "out")
    assert done.returncode == 5
    assert (
        done.stderr
        == "remodel-fenicsx: cannot write to the standard output: No space left on device\n"
    )
    assert read_history(tmp_path / "out")["time"][-1] == 10


STOPPED_WHILE_IT_COMPILES = """
import os, signal, sys
from remodel_fenicsx import cli
from remodel_fenicsx.evolution.coupling import Staggered
from remodel_fenicsx.solver.continuation import CellHomotopy
from remodel_fenicsx.system.interrupts import raise_on_signal
whole = Staggered._solve
def compiled(blend):
    with raise_on_signal():
        os.kill(os.getpid(), signal.SIGTERM)
def in_parts(coupling, step, time, old_loads, loads, work, again):
    if coupling.state.number < 3:
        return whole(coupling, step, time, old_loads, loads, work, again)
    coupling._solve_in_substeps(4.0, dict(coupling.state.loading.values), loads, work, None)
CellHomotopy.equilibrium = property(compiled)
Staggered._solve = in_parts
sys.exit(cli.main(sys.argv[1:]))
"""


def test_a_step_that_is_stopped_while_it_compiles_is_taken_back_and_the_run_goes_on(
    tmp_path: Path,
) -> None:
    """Parts of a step are compiled when the first step needs them."""
    words = [*CUBE, "-q", "--set", "output.checkpoint=0", "-o", tmp_path]
    stopped = forked("python", STOPPED_WHILE_IT_COMPILES, *words)
    assert stopped.returncode == 128 + signal.SIGTERM, stopped.stderr
    assert [*read_history(tmp_path)["time"]] == [0, 1, 2, 3]
    assert forked("remodel-fenicsx", "run", "--resume", tmp_path, "-q").returncode == 0
    assert "resumes from the checkpoint of time 3" in (tmp_path / "run.log").read_text()


@pytest.mark.parametrize("number", [signal.SIGHUP, *slowly(signal.SIGINT)])
def test_a_signal_that_was_ignored_from_the_start_stays_ignored(
    number: signal.Signals, tmp_path: Path
) -> None:
    """nohup ignores SIGHUP, a shell script SIGINT for its jobs in the background."""
    words = [*COMMAND, "--set", "mesh.refinement=3", "-q", "-o", str(tmp_path / "out")]
    process = subprocess.Popen(
        words,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(number, signal.SIG_IGN),
    )
    wait_for_rows(process, tmp_path / "out", 3)
    process.send_signal(number)
    errors = process.communicate(timeout=200)[1]
    assert process.returncode == 0, errors
    assert read_history(tmp_path / "out")["time"][-1] == 10


@pytest.mark.parametrize(
    ("module", "number"),
    [
        ("pydantic", signal.SIGINT),
        ("petsc4py.PETSc", signal.SIGTERM),
        ("remodel_fenicsx.running", signal.SIGHUP),
    ],
)
def test_a_signal_among_the_imports_ends_with_a_line(
    module: str, number: signal.Signals, tmp_path: Path
) -> None:
    program = f"""
import os, runpy, signal, sys
class Signal:
    def find_spec(name, path=None, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), {int(number)})
sys.meta_path.insert(0, Signal)
sys.argv = {["remodel-fenicsx", *CUBE, "-o", str(tmp_path / "out")]!r}
runpy.run_path({str(PROJECT / "bin" / "remodel-fenicsx")!r}, run_name="__main__")
"""
    done = ran([sys.executable, "-c", program])
    line = f"remodel-fenicsx: stopped by {number.name}\n"
    assert (done.returncode, done.stdout, done.stderr) == (128 + number, "", line)
    assert list(tmp_path.iterdir()) == []


def test_a_signal_before_the_first_step_ends_the_run_where_it_comes(tmp_path: Path) -> None:
    program = f"""
import os, signal, sys
from remodel_fenicsx import cli, running
def meshing(scene, comm):
    os.kill(os.getpid(), signal.SIGTERM)
    raise AssertionError("it goes on")
running.Simulation = meshing
sys.exit(cli.main({[*CUBE, "-o", str(tmp_path / "out")]!r}))
"""
    done = forked("python", program)
    assert (done.returncode, done.stdout) == (143, "")
    assert done.stderr == "remodel-fenicsx: stopped by SIGTERM; nothing was computed\n"
    assert list(tmp_path.iterdir()) == []


def test_a_usage_error_is_said_by_the_first_rank_alone() -> None:
    said = []
    for rank in ("0", "1"):
        environment = {**os.environ, "OMPI_COMM_WORLD_RANK": rank}
        done = forked("remodel-fenicsx", "run", "--bad", variables=environment)
        assert done.returncode == 2
        said.append(done.stderr + done.stdout)
    assert "unrecognized arguments: --bad" in said[0] and said[1] == ""


def test_processes_of_srun_that_share_no_mpi_are_refused(tmp_path: Path) -> None:
    """SLURM_NTASKS alone stands in every batch script."""
    variables = {**os.environ, "SLURM_NTASKS": "2", "SLURM_STEP_NUM_TASKS": "2"}
    words = [*CUBE, "--set", "time.end=1", "-q", "-o", tmp_path / "out"]
    done = forked("remodel-fenicsx", *words, variables=variables)
    assert done.returncode == 5 and "without a common MPI: use mpirun -n 2" in done.stderr
    assert not (tmp_path / "out").exists()
    assert (
        forked(
            "remodel-fenicsx", *words, variables=variables | {"SLURM_STEP_NUM_TASKS": "1"}
        ).returncode
        == 0
    )


def wall_on(folder: Path, **counts: int) -> tuple[Path, list[str]]:
    """A surface with so many triangles, and the words that ask for a wall on it."""
    points, triangles = tube(**counts)
    file = folder / "lumen.vtp"
    pyvista.PolyData.from_regular_faces(points, triangles).save(file)
    options = f"--thickness 0.3 --size 0.3 -o {folder / 'wall.msh'}"
    return file, [*COMMAND[:3], "wall", str(file), *options.split()]


def test_a_wall_on_a_large_surface_says_what_it_does_and_ends_at_once(tmp_path: Path) -> None:
    """While Gmsh, which hears no signals, divides 204,800 triangles."""
    file, words = wall_on(tmp_path, around=640, along=160)
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None and "remeshing 204800 triangles" in process.stderr.readline()
    process.terminate()
    _, said = process.communicate(timeout=5)
    assert process.returncode == 128 + signal.SIGTERM
    assert said == "remodel-fenicsx: stopped by SIGTERM; nothing is written\n"
    assert list(tmp_path.iterdir()) == [file]


def test_a_wall_that_is_stopped_after_its_file_is_complete_says_so(tmp_path: Path) -> None:
    program = """
import os, signal, sys
from remodel_fenicsx import cli
link = os.link
def and_stop(*names):
    link(*names)
    os.kill(os.getpid(), signal.SIGTERM)
os.link = and_stop
sys.exit(cli.main(sys.argv[1:]))
"""
    done = forked("python", program, *wall_on(tmp_path)[1][3:])
    path = tmp_path / "wall.msh"
    said = f"remodel-fenicsx: stopped by SIGTERM; {path} is complete\n"
    assert (done.returncode, done.stderr) == (128 + signal.SIGTERM, said)
    assert path.read_text().endswith("$EndElements\n")


def test_a_limit_of_files_is_no_fault_of_a_surface(tmp_path: Path) -> None:
    """Below the size of the surface, and below that of the mesh."""
    file, words = wall_on(tmp_path)
    for blocks in (20, 200):
        limited = ["bash", "-c", f'ulimit -f {blocks}; exec "$0" "$@"', *words]
        done = ran(limited)
        assert done.returncode == 5, done.stderr
        assert "lumen.vtp" not in done.stderr and "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == [file]


def test_a_rank_does_not_wait_for_a_second_signal() -> None:
    """mpirun gives its ranks a quarter of a second between SIGTERM and SIGKILL: all of it is for the checkpoint."""
    program = """
import os, signal, time
from remodel_fenicsx.system.interrupts import StopRequest
time.sleep = None
with StopRequest() as stop:
    os.kill(os.getpid(), signal.SIGTERM)
    assert stop.number == signal.SIGTERM
"""
    done = forked("python", program, variables={**os.environ, "OMPI_COMM_WORLD_SIZE": "2"})
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "caught",
    [
        pytest.param("watch = weakref.ref(body, kill); del body", id="in a finaliser"),
        pytest.param("try: kill()\n        except Exception: pass", id="in a library"),
        pytest.param("try: kill()\n        except BaseException: pass", id="in a library in C"),
    ],
)
def test_a_signal_where_exceptions_are_caught_is_not_lost(caught: str) -> None:
    """Python ignores exceptions in finalisers, and SciPy prints those that end its import."""
    program = f"""
import os, signal, time, weakref
from remodel_fenicsx.system.interrupts import Interrupted, StopRequest, raise_on_signal
class Body: pass
body = Body()
def kill(_=None): os.kill(os.getpid(), signal.SIGTERM)
try:
    with StopRequest(), raise_on_signal():
        {caught}
        time.sleep(60)
except Interrupted as interruption:
    assert interruption.exit_code == 143
else:
    raise SystemExit("the signal was lost")
"""
    done = forked("python", program)
    assert done.returncode == 0 and not done.stderr, done.stderr
