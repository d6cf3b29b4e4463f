"""Signals and broken outputs that a run outlives, or that end it without noise: with PETSc loaded, as in every run."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from remodel_fenicsx.results.recording import read_history

PROJECT = Path(__file__).parents[1]
CUBE = ["run", str(PROJECT / "demos" / "cube.toml"), "--set", "time.end=10"]
COMMAND = [sys.executable, "-m", "remodel_fenicsx.cli", *CUBE]


@pytest.mark.parametrize("stream", ["stdout", "stderr", "both"])
def test_a_reader_that_goes_away_costs_no_step(stream: str, tmp_path: Path) -> None:
    """`remodel-fenicsx run ... 2>&1 | head -1`."""
    reading, writing = os.pipe()
    os.close(reading)
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    streams |= dict.fromkeys(streams if stream == "both" else [stream], writing)
    done = subprocess.run([*COMMAND, "-o", tmp_path / "out"], timeout=200, text=True, **streams)  # type: ignore
    os.close(writing)
    assert len(read_history(tmp_path / "out")["time"]) == 10
    # 120: Python itself could not say its last word
    assert done.returncode in (0, 120), done.stderr
    assert "Traceback" not in (done.stderr or "") and "PETSC" not in (done.stderr or "")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="Linux has a disk that is always full")
def test_a_full_disk_below_stdout_is_exit_code_5(tmp_path: Path) -> None:
    with open("/dev/full", "w") as full:
        words = [*COMMAND, "-q", "-o", tmp_path / "out"]
        done = subprocess.run(words, timeout=200, stdout=full, stderr=subprocess.PIPE)
    assert done.returncode == 5
    assert done.stderr.decode() == "remodel-fenicsx: cannot write to the standard output: No space left on device\n"
    assert len(read_history(tmp_path / "out")["time"]) == 10


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGINT])
def test_a_signal_that_was_ignored_from_the_start_stays_ignored(number: signal.Signals, tmp_path: Path) -> None:
    """nohup ignores SIGHUP, a shell script SIGINT for its jobs in the background."""
    history = tmp_path / "out" / "history.csv"
    words = [*COMMAND, "--set", "mesh.refinement=3", "-q", "-o", str(tmp_path / "out")]
    process = subprocess.Popen(
        words, stderr=subprocess.PIPE, text=True, preexec_fn=lambda: signal.signal(number, signal.SIG_IGN)
    )
    deadline = time.monotonic() + 200
    while time.monotonic() < deadline and not (history.exists() and history.read_text().count("\n") > 2):
        time.sleep(0.02)
        assert process.poll() is None
    process.send_signal(number)
    errors = process.communicate(timeout=200)[1]
    assert process.returncode == 0, errors
    assert len(read_history(tmp_path / "out")["time"]) == 10


@pytest.mark.parametrize("module", ["pydantic", "mpi4py", "petsc4py.PETSc", "dolfinx", "basix"])
def test_ctrl_c_among_the_imports_ends_without_a_word(module: str, tmp_path: Path) -> None:
    program = f"""
import os, runpy, signal, sys
class CtrlC:
    def find_spec(name, path=None, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, CtrlC)
sys.argv = {["remodel-fenicsx", *CUBE, "-o", str(tmp_path / "out")]!r}
runpy.run_path({str(PROJECT / "bin" / "remodel-fenicsx")!r}, run_name="__main__")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=100)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")
    assert list(tmp_path.iterdir()) == []


def test_a_usage_error_is_said_by_the_first_rank_alone() -> None:
    said = []
    for rank in ("0", "1"):
        environment = {**os.environ, "OMPI_COMM_WORLD_RANK": rank}
        words = [sys.executable, "-m", "remodel_fenicsx.cli", "run", "--bad"]
        done = subprocess.run(words, capture_output=True, text=True, timeout=100, env=environment)
        assert done.returncode == 2
        said.append(done.stderr + done.stdout)
    assert "required: SCENE" in said[0] and said[1] == ""
