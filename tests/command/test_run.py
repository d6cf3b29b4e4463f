"""The command line as a user meets it: what a run leaves behind, exit codes, signals, bad input, the demos."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from remodel_fenicsx import cli
from remodel_fenicsx.body.shape import COLUMNS
from remodel_fenicsx.results.recording import read_history
from tests.conftest import Refused, mpirun, slowly
from tests.forks import COARSE, forked
from tests.processes import ran, wait_for_rows
from tests.values import assert_close

PROJECT = Path(__file__).parents[2]
COMMAND = [sys.executable, "-m", "remodel_fenicsx.cli"]


def run(
    *arguments: str | Path, ranks: int = 1, **options: object
) -> subprocess.CompletedProcess[str]:
    """remodel-fenicsx ARGUMENTS on so many ranks; a process of its own, imports and all, where a test asks for more."""
    if ranks == 1 and options.keys() <= {"cwd"}:
        return forked("remodel-fenicsx", *arguments, **options)
    command = mpirun(ranks, *COMMAND, *map(str, arguments))
    return ran(command, **options)


def refusal_of(*words: str | Path, **options: Any) -> str:
    """The one line of a command that ends with exit code 2."""
    done = run(*words, **options)
    assert done.returncode == 2, (done.returncode, done.stdout, done.stderr)
    assert done.stderr.count("\n") == 1 and done.stderr.startswith("remodel-fenicsx: "), done.stderr
    return done.stderr


def demo(name: str) -> Path:
    """Path of a demo's scene."""
    return PROJECT / "demos" / f"{name}.toml"


# ---------------------------------------------------------------- on two ranks, which start once
IMPOSSIBLE = """
cells.initial=aligned | cells.aligned_axis=2 | loads.elongation.value=1.0 | loads.pressure.value=0
loads.elongation.ramp=[[0.0, 0.0], [5.0, 1.0]] | remodeling.law=none | solver.maximum_halvings=3
"""
UNSTABLE = "loads.force.value=-30 | mesh.refinement=2 | solver.unstable=stop | output.fields=false"
# by name: the demo, what is set, and the folder where that is not one of the command's own
ON_RANKS = {
    "bad": ("artery", "remodeling.kappa=-1", ""),
    "files": ("cube", "time.end=3 | mesh.refinement=3 | cells.initial=random", ""),
    "taken": ("cube", "", ""),
    # axial chains lock at a stretch of L / r0 = 1.594: reached between t = 2 and t = 3
    "impossible": ("artery", IMPOSSIBLE, ""),
    # elements enough for both ranks: with eight the cube can leave its shape earlier, between -3 and -6
    "unstable": ("cube", UNSTABLE, ""),
    "nowhere": ("cube", "", "/proc/below"),  # found by one rank, which ends the others: the last
}
Done = tuple[subprocess.CompletedProcess[str], Path]


def words_on_ranks(name: str, parent: Path) -> tuple[list[str], Path]:
    """Of a command of `ON_RANKS`, and its folder."""
    scene, settings, folder = ON_RANKS[name]
    out = Path(folder or parent / name)
    if name == "taken":
        out.mkdir()
        (out / "mine.txt").write_text("dear")
    changes = [
        f"--set={setting.strip()}"
        for setting in settings.strip().replace("\n", "|").split("|")
        if setting
    ]
    return ["run", str(demo(scene)), *changes, "-o", str(out)], out


@pytest.fixture(scope="module")
def two_ranks(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Done]:
    """What tests/commands.py makes of all of them."""
    parent = tmp_path_factory.mktemp("ranks")
    commands = {name: words_on_ranks(name, parent) for name in ON_RANKS}
    (parent / "commands.json").write_text(
        json.dumps({name: words for name, (words, _) in commands.items()})
    )
    program = [sys.executable, str(Path(__file__).parents[1] / "commands.py"), str(parent)]
    done = ran(mpirun(2, *program))
    codes = json.loads((parent / "codes.json").read_text()) | {"nowhere": [done.returncode] * 2}
    assert codes.keys() == commands.keys(), done.stderr
    found = {}
    for name, (first, second) in codes.items():
        assert first == second, name
        said = [(parent / f"{name}.{ending}").read_text() for ending in ("out", "err")]
        found[name] = (
            subprocess.CompletedProcess(commands[name][0], first, *said),
            commands[name][1],
        )
    return found


@pytest.fixture
def on_ranks(request: pytest.FixtureRequest, tmp_path: Path) -> Callable[[str, int], Done]:
    """on_ranks(name, ranks) -> what a command of `ON_RANKS` said, the same on all ranks, and its folder."""

    def command(name: str, ranks: int) -> Done:
        if ranks == 2:
            return request.getfixturevalue("two_ranks")[name]
        words, folder = words_on_ranks(name, tmp_path)
        return run(*words), folder

    return command


# ---------------------------------------------------------------- what a run leaves


@pytest.fixture(scope="module")
def tendon_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three steps of the tendon demo."""
    folder = tmp_path_factory.mktemp("runs") / "tendon"
    done = run("run", demo("tendon"), "--set", "time.end=3", "-o", folder)
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"results in {folder}\n"
    return folder


def test_folder_holds_history_fields_scene_and_log(tendon_run: Path) -> None:
    names = {path.name for path in tendon_run.iterdir()}
    # on a slow machine there is a second checkpoint
    files = {
        "history.csv",
        "fields.vtkhdf",
        "fields_chains.vtkhdf",
        "scene.toml",
        "run.log",
        "report.html",
    }
    assert names - {"checkpoint-b.npz"} == files | {"checkpoint-a.npz"}
    log = (tendon_run / "run.log").read_text()
    assert "finished" in log
    # 25 a time unit, over an area of 10
    assert "INFO network modulus c = 1.568 Pa, shear modulus mu = 3.103 Pa, " in log


def test_history_has_the_columns_of_the_contract(tendon_run: Path) -> None:
    history = read_history(tendon_run)
    uniaxial = {"force", "mean_stretch", "min_stretch", "max_stretch", "mean_fibre_angle"}
    assert set(history) == {"time", *COLUMNS} | uniaxial
    np.testing.assert_array_equal(history["time"], [0.0, 1.0, 2.0, 3.0])
    np.testing.assert_allclose(history["force"], [0.0, 25.0, 50.0, 75.0], rtol=1e-14)
    assert np.all(history["min_stretch"][1:] < history["mean_stretch"][1:])
    assert np.all(history["mean_stretch"][1:] < history["max_stretch"][1:])


def test_the_first_row_is_the_unloaded_body(tendon_run: Path) -> None:
    first = {name: values[0] for name, values in read_history(tendon_run).items()}
    nothing = (
        "time",
        "force",
        "remodeling_power",
        "newton_iterations",
        "linear_iterations",
        "substeps",
        "seconds",
    )
    assert all(first[name] == 0.0 for name in nothing)
    for name in ("mean_stretch", "min_stretch", "max_stretch", "min_jacobian"):
        assert first[name] == pytest.approx(1.0, abs=1e-14)
    assert first["max_chain_extension"] == pytest.approx(1.0 / 1.594, rel=1e-12)
    assert 45.0 < first["mean_fibre_angle"] < 65.0


def test_one_and_two_ranks_write_the_same_files(on_ranks: Callable[[str, int], Done]) -> None:
    (alone, here), (done, folder) = on_ranks("files", 1), on_ranks("files", 2)
    assert alone.returncode == done.returncode == 0, done.stderr
    assert done.stdout.count("results in") == 1  # only rank 0 speaks
    one, two = read_history(here), read_history(folder)
    names = ("mean_stretch", "max_stretch", "mean_fibre_angle", "stored_energy")
    assert_close(two, one, names, 1e-7, 0.0)
    for name in ("fields.vtkhdf", "fields_chains.vtkhdf"):
        with h5py.File(here / name) as first, h5py.File(folder / name) as second:
            np.testing.assert_array_equal(
                first["VTKHDF/Connectivity"][:], second["VTKHDF/Connectivity"][:]
            )
            a, b = (file["VTKHDF/PointData/displacement"][:] for file in (first, second))
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-5)


def test_petsc_options_from_scene_and_environment(tmp_path: Path) -> None:
    """The scene's lie over the method's, those of PETSC_OPTIONS over the scene's."""
    one = ["run", demo("cube"), "--set", "time.end=1", "-q", "-o"]
    quiet = run(*one, tmp_path / "quiet")
    assert quiet.returncode == 0 and "SNES Function norm" not in quiet.stdout
    monitored = run(*one, tmp_path / "scene", "--set", "solver.petsc_options.snes_monitor=true")
    assert monitored.returncode == 0 and "SNES Function norm" in monitored.stdout
    # LU of MUMPS is exact: one linear iteration a Newton iteration; GMRES with Jacobi needs more
    loose = {
        **os.environ,
        "PETSC_OPTIONS": "-remodel_ksp_type gmres -remodel_ksp_rtol 1e-12 -remodel_pc_type jacobi",
    }
    other = run(
        *one, tmp_path / "other", "--set", "solver.petsc_options.pc_type=cholesky", env=loose
    )
    assert other.returncode == 0, other.stderr
    direct, iterative = read_history(tmp_path / "quiet"), read_history(tmp_path / "other")
    assert direct["linear_iterations"][1] == direct["newton_iterations"][1] > 0
    assert iterative["linear_iterations"][1] > 2 * iterative["newton_iterations"][1]
    np.testing.assert_allclose(iterative["mean_stretch"], direct["mean_stretch"], rtol=1e-9)


# ---------------------------------------------------------------- folders


@pytest.mark.parametrize("ranks", [2, *slowly(1)])
def test_a_folder_with_files_is_never_touched(
    ranks: int, on_ranks: Callable[[str, int], Done]
) -> None:
    done, folder = on_ranks("taken", ranks)
    assert done.returncode == 2
    assert done.stderr == f"remodel-fenicsx: folder {folder}: is not empty; must be new or empty\n"
    assert [path.name for path in folder.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize("ranks", [1, 2])
def test_output_that_cannot_be_written_is_exit_code_5(
    ranks: int, on_ranks: Callable[[str, int], Done]
) -> None:
    done, _ = on_ranks("nowhere", ranks)
    assert done.returncode == 5
    assert done.stderr.count("cannot write the results") == 1 and done.stderr.count("\n") == 1


def test_a_folder_below_a_file_is_exit_code_2(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert "must be a new or an empty folder" in refusal_of(
        "run", demo("cube"), "-o", tmp_path / "file" / "below"
    )


# ---------------------------------------------------------------- failures and signals


@pytest.mark.parametrize("ranks", [2, *slowly(1)])
def test_an_impossible_load_is_exit_code_3_and_says_where(
    ranks: int, on_ranks: Callable[[str, int], Done]
) -> None:
    done, folder = on_ranks("impossible", ranks)
    assert done.returncode == 3, done.stderr
    line = next(line for line in done.stderr.splitlines() if line.startswith("remodel-fenicsx:"))
    assert (
        "no equilibrium at time 3: " in line
        and "largest r/L = " in line
        and "prescribe less elongation" in line
    )
    np.testing.assert_array_equal(read_history(folder)["time"], [0.0, 1.0, 2.0])
    assert (folder / "scene.toml").exists()


@pytest.mark.parametrize(
    ("number", "ranks"),
    [(signal.SIGINT, 1), (signal.SIGTERM, 2),
     *slowly((signal.SIGINT, 2), (signal.SIGTERM, 1), (signal.SIGHUP, 1), (signal.SIGHUP, 2))],
)  # fmt: skip
def test_a_signal_ends_the_run_and_keeps_finished_steps(
    tmp_path: Path, number: signal.Signals, ranks: int
) -> None:
    """The end that it makes is a checkpoint, also where there is none on the way."""
    folder = tmp_path / "out"
    command = mpirun(ranks, *COMMAND, "run", str(demo("cube")), "--set=output.checkpoint=0", "--set=time.end=900",
                     "--set=mesh.refinement=2", "-o", str(folder))  # fmt: skip
    # in a group of its own, which gets the signal as a terminal gives it
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, process_group=0
    )
    wait_for_rows(process, folder, 4)
    os.killpg(process.pid, number)
    _, errors = process.communicate(timeout=200)
    assert (
        process.returncode == 128 + number if ranks == 1 else process.returncode != 0
    )  # mpirun's own code
    assert ranks == 2 or errors.endswith(
        f"stopped by {number.name}; all finished steps are saved\n"
    )
    last = read_history(folder)["time"][-1]
    assert last >= 2 and (folder / "history.csv").read_text().endswith("\n")
    for _ in range(60):  # mpirun may end before its ranks have written what they keep
        done = run("run", "--resume", folder, "--set", f"time.end={last + 2}")
        if "writes in it" not in done.stderr:
            break
        time.sleep(0.5)
    assert done.returncode == 0, done.stderr
    assert (
        ranks == 2
        or f"resumes from the checkpoint of time {last:g}, " in (folder / "run.log").read_text()
    )
    assert read_history(folder)["time"].tolist() == list(range(int(last) + 3))


def test_an_exception_in_a_script_on_two_ranks_ends_both(tmp_path: Path) -> None:
    """A place that cannot be written is found by rank 0 alone; nobody may wait for it."""
    (tmp_path / "file").touch()
    program = tmp_path / "program.py"
    program.write_text(
        "from remodel_fenicsx.scene.scene import preset_scene\n"
        "from remodel_fenicsx.running import run\n"
        f"run(preset_scene('kuhl-holzapfel-2007', 'cube'), {str(tmp_path / 'file' / 'below')!r})\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(PROJECT)}
    command = mpirun(2, sys.executable, str(program))
    done = ran(command, env=environment)
    assert done.returncode != 0
    assert "Not a directory" in done.stderr


def test_two_runs_at_once_take_two_folders(tmp_path: Path) -> None:
    program = """
import os, sys
from remodel_fenicsx import cli
other = os.fork()
status = cli.main(sys.argv[1:])
if other:
    status = status or os.waitstatus_to_exitcode(os.waitpid(other, 0)[1])
os._exit(status)
"""
    done = forked("python", program, "run", demo("cube"), "--set", "time.end=2", "-q", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert sorted(done.stdout.splitlines()) == [
        "results in results/cube",
        "results in results/cube-2",
    ]
    assert all(
        (tmp_path / "results" / name / "history.csv").exists() for name in ("cube", "cube-2")
    )


def test_a_misspelt_petsc_option_is_said_and_logged(tmp_path: Path) -> None:
    options = [
        "--set",
        "solver.petsc_options.snes_linesearch_typ=bt",
        "--set",
        "solver.petsc_options.ksp_type=preonly",
    ]
    done = run("run", demo("cube"), *options, "--set", "time.end=2", "-q", "-o", tmp_path / "out")
    assert done.returncode == 0
    warning = "WARNING: solver.petsc_options: without effect (misspelt?): snes_linesearch_typ\n"
    assert done.stderr == warning  # once, and nothing about the options that were used
    assert warning.removeprefix("WARNING: ") in (tmp_path / "out" / "run.log").read_text()


def test_an_old_dolfinx_is_exit_code_5(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import dolfinx

    monkeypatch.setattr(dolfinx, "__version__", "0.8.0")
    assert cli.main(["run", str(demo("cube")), "-o", str(tmp_path / "out")]) == 5
    assert "dolfinx 0.8.0 is too old" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


# ---------------------------------------------------------------- bad input and the small commands

BAD_SETTINGS = (
    Path(__file__).parent / "bad_settings.txt"
).read_text()  # what is set, and how the line begins


@pytest.mark.parametrize("line", BAD_SETTINGS.splitlines())
def test_a_bad_scene_is_one_line_exit_code_2_and_nothing_written(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    setting, beginning = line.split(" | ")
    monkeypatch.chdir(tmp_path)
    assert refused("run", demo("artery"), "--set", setting).startswith(beginning)
    assert list(tmp_path.iterdir()) == []


def test_bad_input_is_refused_once_on_two_ranks(two_ranks: dict[str, Done]) -> None:
    done, folder = two_ranks["bad"]
    assert done.returncode == 2 and not folder.exists()
    assert done.stderr.count("\n") == done.stderr.count("remodeling.kappa = -1") == 1


def test_validate_new_and_info(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["validate", str(demo("artery"))]) == 0
    assert (
        "a valid scene (tube, 150 steps)\nnetwork modulus c = 1.568 Pa, " in capsys.readouterr().out
    )
    for preset in ("kuhl-holzapfel-2007", "sun-2002"):
        for shape in ("cube", "tendon", "tube", "sheet"):
            capsys.readouterr()
            assert cli.main(["new", preset, "--shape", shape]) == 0
            scene = tmp_path / f"{preset}-{shape}.toml"
            scene.write_text(capsys.readouterr().out)
            assert cli.main(["validate", str(scene)]) == 0, capsys.readouterr().err
    assert cli.main(["info"]) == 0
    out = capsys.readouterr().out
    assert "dolfinx" in out and "blas" in out


# ---------------------------------------------------------------- demos


WHOLE_RAMP = slowly(("tendon", "3"), ("tendon", "14"), ("artery", "27"))


@pytest.mark.parametrize(("name", "end"), [("cube", None), ("artery", "2"), *WHOLE_RAMP])
def test_the_script_and_the_scene_of_a_demo_are_the_same_simulation(
    name: str, end: str | None, tmp_path: Path
) -> None:
    """On a coarse mesh of the tube, which both take by themselves."""
    program = f"{COARSE}import runpy; runpy.run_path({str(PROJECT / 'demos' / name)!r} + '.py', run_name='__main__')"
    script = forked("python", program, *([end] if end else []), cwd=tmp_path)
    assert script.returncode == 0, script.stderr
    settings = ["output.fields=false", *([f"time.end={end}"] if end else [])]
    scene = forked(
        "four layers",
        "run",
        demo(name),
        *(f"--set={setting}" for setting in settings),
        cwd=tmp_path,
    )
    assert scene.returncode == 0, scene.stderr
    ours, theirs = read_history(tmp_path / "results" / f"{name}-script"), read_history(
        tmp_path / "results" / name
    )
    assert list(ours) == list(theirs)
    assert_close(ours, theirs, set(ours) - {"seconds"}, 1e-10, 0.0, equal_nan=True)


@pytest.mark.parametrize("ranks", [2, *slowly(1)])
def test_an_unstable_equilibrium_is_exit_code_3_where_the_scene_says_stop(
    ranks: int, on_ranks: Callable[[str, int], Done]
) -> None:
    done, folder = on_ranks("unstable", ranks)
    assert done.returncode == 3, done.stderr
    line = next(line for line in done.stderr.splitlines() if line.startswith("remodel-fenicsx:"))
    assert (
        "the equilibrium at time 2 is unstable: 1 negative" in line
        and "run --resume continues from there" in line
    )
    history = read_history(folder)
    np.testing.assert_array_equal(history["time"], [0.0, 1.0])
