"""Commands in processes of their own: a worker does one after the other, and says how each has ended."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from remodel_fenicsx.system.children import WarmProcess
from tests.parts import pulled_cube
from tests.processes import CHILDREN, has_ended, members


@pytest.fixture
def process() -> Iterator[WarmProcess]:
    """A process; it ends with the test."""
    made = WarmProcess({})
    yield made
    made.stop()
    assert not made.is_alive


def test_one_process_does_many_commands(process: WarmProcess, tmp_path: Path) -> None:
    """Each with words of its own; then it is killed in one of them."""
    scene, number = tmp_path / "step-0.5.toml", process.process.pid
    scene.write_text(pulled_cube(5000.0).to_toml())
    said = [tmp_path / f"{name}.txt" for name in ("one", "two", "three")]

    def end_of(words: list[str], messages: Path) -> tuple[int, str]:
        process.begin(words, messages)
        return process.result(messages)

    code, words = end_of(["validate", str(tmp_path / "nothing.toml")], said[0])
    assert code == 2 and words.endswith("nothing.toml: no such file; a scene is a TOML file")
    assert end_of(["no-such-command"], said[1])[0] == 2  # argparse ends in a way of its own
    assert "no such file" not in said[1].read_text()
    assert process.is_alive and process.process.pid == number
    process.begin(["run", str(scene), "-o", str(tmp_path / "run"), "-q"], said[2])
    assert not process.has_ended(0.0)
    os.kill(number, signal.SIGKILL)
    assert process.result(said[2]) == (-signal.SIGKILL, "killed by SIGKILL")
    assert end_of(["info"], said[2])[0] == -signal.SIGKILL  # who is not there does nothing


# ---------------------------------------------------------------- the processes of a study
COMMAND = "import sys; from remodel_fenicsx.cli import main; sys.exit(main(sys.argv[1:]))"
ARTERY = Path(__file__).parents[2] / "demos" / "artery.toml"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGUSR1, signal.SIGKILL])
def test_a_stopped_study_ends_its_runs(number: int, tmp_path: Path) -> None:
    """What it has recorded stays, without an answer."""
    words = ["ensemble", str(ARTERY), "--jobs", "1", "-o", str(tmp_path / "runs")]
    command = [sys.executable, "-c", COMMAND, *words]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert process.stderr.readline().startswith("artery ensemble: 0 of 32 runs done")
        while not (found := members(process.pid, CHILDREN)):
            time.sleep(0.01)
        (child,) = found
        process.send_signal(number)
        said = "" if number == signal.SIGKILL else process.stderr.read()
    expected = {signal.SIGTERM: 143, signal.SIGUSR1: 4, signal.SIGKILL: -signal.SIGKILL}
    assert process.returncode == expected[signal.Signals(number)] and has_ended(child)
    kept = "; all recorded results are saved; repeat the command to resume"
    assert not said or said.splitlines()[-1].endswith(kept)
    assert number == signal.SIGKILL or said
    assert not (tmp_path / "runs" / "ensemble.csv").exists()
    assert all(
        history.read_text().count("\n") < 152
        for history in (tmp_path / "runs").rglob("history.csv")
    )


# ---------------------------------------------------------------- the processes of a fit
FIT = ARTERY.parent / "fit"


@pytest.mark.parametrize(
    ("whose", "number", "code"), [("child", signal.SIGKILL, 5), ("parent", signal.SIGINT, 130)]
)
def test_a_fit_whose_process_is_killed_ends(
    whose: str, number: signal.Signals, code: int, tmp_path: Path
) -> None:
    """Who is short of memory kills a process: one line, and what was evaluated stays."""
    words = [
        "fit",
        str(FIT / "scene.toml"),
        str(FIT / "inflation.toml"),
        "--starts",
        "999",
        "--jobs",
        "2",
        "-o",
        "out",
    ]
    journal, command = tmp_path / "out" / "evaluations.jsonl", [
        sys.executable,
        "-c",
        COMMAND,
        *words,
    ]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as process:
        while (
            len(pool := members(process.pid, CHILDREN)) < 2 or journal.read_text().count("\n") < 10
        ):
            assert process.poll() is None
            time.sleep(0.05)
        os.kill(min(pool) if whose == "child" else process.pid, number)
        last = process.communicate(timeout=60)[1].splitlines()[-1]
    assert process.returncode == code and number.name in last and all(map(has_ended, pool))
    assert last.endswith("; repeat the command to resume")
    assert journal.read_text().count("\n") >= 10
