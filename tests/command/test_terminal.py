"""Progress and log: on a terminal (a pseudo terminal stands for it), in a pipe, on other ranks."""

from __future__ import annotations

import logging
import os
import pty
import re
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from remodel_fenicsx.system import NOTICE, terminal
from remodel_fenicsx.system.files import command_name
from remodel_fenicsx.system.terminal import Progress, buffer_log, open_log
from tests.forks import forked

SCRIPT = """
import sys, time, logging
from remodel_fenicsx.system import NOTICE
from remodel_fenicsx.system.terminal import Progress, open_log
with open_log(sys.argv[1], quiet=False), Progress(8, "artery [4]", 0) as progress:
    for k in range(1, 9):
        time.sleep(0.06)
        progress.step(k, f"t = {k}, pressure [0.5], 3 Newton")
        if k == 4:
            logging.getLogger("remodel_fenicsx.running").log(NOTICE, "two substeps")
        if k == 5:
            logging.getLogger("remodel_fenicsx.evolution.stepper").warning("careful")
        if k == int(sys.argv[2]):
            raise KeyboardInterrupt
print("the end")
"""


def run_in_terminal(arguments: list[str], columns: int = 100) -> tuple[int, str]:
    """Exit status and everything that a terminal got."""
    leader, follower = pty.openpty()
    environment = {**os.environ, "TERM": "xterm-256color", "COLUMNS": str(columns)}
    environment.pop("NO_COLOR", None)
    with subprocess.Popen(
        arguments, stdin=follower, stdout=follower, stderr=follower, env=environment
    ) as run:
        os.close(follower)
        received = bytearray()
        while True:
            try:
                data = os.read(leader, 4096)
            except OSError:  # Linux: nobody holds the other end any more
                break
            if not data:
                break
            received += data
    os.close(leader)
    return run.returncode, received.decode()


def plain(text: str) -> str:
    """Without colours and cursor movements."""
    return re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", text)


def test_a_terminal_gets_a_bar(tmp_path):
    status, text = run_in_terminal([sys.executable, "-c", SCRIPT, str(tmp_path / "run.log"), "0"])
    assert status == 0, text
    lines = [line.strip() for line in re.split(r"[\r\n]+", plain(text))]
    bars = [line for line in lines if "━" in line]
    assert re.match(
        r"artery \[4\] ━+ 8/8 t = 8, pressure \[0.5\], 3 Newton 0:00:0\d", bars[-1]
    ), bars[-1]
    assert any(re.search(r"[2-7]/8 .* left$", line) for line in bars)
    assert (
        "two substeps" in lines and "WARNING: careful" in lines
    )  # lines of their own, above the bar
    assert lines[-2:] == ["the end", ""]
    assert text.count("\x1b[?25l") == text.count("\x1b[?25h") == 1  # the cursor came back
    assert "WARNING careful" in (tmp_path / "run.log").read_text()


def test_ctrl_c_puts_the_terminal_right(tmp_path):
    status, text = run_in_terminal([sys.executable, "-c", SCRIPT, str(tmp_path / "run.log"), "6"])
    assert status != 0 and "KeyboardInterrupt" in text
    assert text.rindex("\x1b[?25h") < text.index("Traceback")


@pytest.fixture
def time_passes(monkeypatch):
    """A clock that tests set."""
    now = [100.0]
    monkeypatch.setattr(terminal.clock, "monotonic", lambda: now[0])
    return now


def test_a_pipe_gets_plain_lines_now_and_then(capsys, time_passes):
    with Progress(20, "tendon", 0, interval=5.0) as progress:
        for k in range(1, 21):
            time_passes[0] += 2.0
            progress.step(k, f"t = {0.5 * k:g}, force 25, 4 Newton")
    out, err = capsys.readouterr()
    assert out == ""
    lines = [line for line in err.splitlines() if "/20" in line]
    assert lines[0] == "tendon: step 1/20, t = 0.5, force 25, 4 Newton"
    assert lines[1] == "tendon: step 4/20, t = 2, force 25, 4 Newton, 32 s left"
    assert [int(line.split("/")[0].split()[-1]) for line in lines] == [1, 4, 7, 10, 13, 16, 19, 20]


def test_chosen_steps_are_counted_and_their_share_is_that_of_time(tmp_path):
    """Not as if they were the equal ones that time.step would make."""
    demo = Path(__file__).parents[2] / "demos" / "cube.toml"
    changes = ["--set", "time.end=20", "--set", "time.tolerance=5", "--set", "output.fields=false"]
    done = forked("remodel-fenicsx", "run", demo, *changes, "-o", tmp_path / "run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    number = len((tmp_path / "run" / "history.csv").read_text().splitlines()) - 2
    assert number != 20 and f"cube: step {number} at 100%, t = 20" in done.stderr
    page = (tmp_path / "run" / "report.html").read_text()
    assert f"{number} steps with an error below 5 degrees" in page and "20/20" not in done.stderr


def test_hints_are_typed_as_the_command_was_found(tmp_path, monkeypatch):
    """Through the launcher, whose folder of commands comes first; an installed one by its name."""
    checkout = Path(__file__).parents[2]
    monkeypatch.setenv("PATH", f"{checkout / 'bin'}:{os.environ['PATH']}")
    monkeypatch.chdir(checkout)
    assert command_name() == "./with-fenicsx remodel-fenicsx"
    monkeypatch.chdir(tmp_path)
    assert command_name() == f"{checkout / 'with-fenicsx'} remodel-fenicsx"
    monkeypatch.setenv("PATH", "/usr/bin:/bin")
    assert command_name() == "remodel-fenicsx"


def test_other_ranks_are_silent(capsys, tmp_path):
    with open_log(tmp_path / "run.log", 1) as log, Progress(2, "artery", 1) as progress:
        progress.step(1, "something")
        log.warning("something")
    with buffer_log(1, quiet=False) as held:
        log.log(NOTICE, "something")
    assert not held and capsys.readouterr() == ("", "") and not list(tmp_path.iterdir())


def test_log_has_times_and_the_terminal_only_warnings(tmp_path, capsys):
    path = tmp_path / "run.log"
    path.write_text("an earlier run\n")
    with open_log(path) as log:
        log.info("step 1: 3 iterations")
        with warnings.catch_warnings(action="always"):
            warnings.warn("from Python", stacklevel=1)
    log.warning("after the run")
    before, step, warned, *_ = path.read_text().splitlines()
    time = r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} "
    assert before == "an earlier run" and re.fullmatch(time + "INFO step 1: 3 iterations", step)
    assert re.fullmatch(time + "WARNING .*UserWarning: from Python", warned)
    assert "from Python" in (err := capsys.readouterr().err) and "iterations" not in err


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="Linux has a disk that is always full")
def test_a_log_that_cannot_be_written_is_an_error():
    with pytest.raises(OSError), open_log("/dev/full") as log:
        log.info("a line")
    assert not logging.getLogger(terminal.LOGGER).handlers
