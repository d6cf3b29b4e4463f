"""Processes that tests look at: who is at work in a session (Linux)."""

from __future__ import annotations

import os
import subprocess
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

COMPILER, TICKS = (
    "cc1",
    2,
)  # its name, and hundredths of a second of work after which it has read its source


CHILDREN, GROUP, SESSION = 1, 2, 3  # which of the numbers of a process, behind its state


def ran(command: Any, timeout: float = 300, **options: Any) -> subprocess.CompletedProcess[str]:
    """A command at its end, with what it has said."""
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout, **options)


def members(number: int, kind: int = SESSION) -> dict[int, str]:
    """Number and name of every process of a session, a group or a parent, that has not ended."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            # number (name) state parent group session ...; a name may hold spaces and brackets
            front, _, rest = (folder / "stat").read_text().rpartition(")")
        except OSError:  # it has ended meanwhile
            continue
        state, *numbers = rest.split()[:4]
        if int(numbers[kind - 1]) == number and state not in "ZX":
            found[int(folder.name)] = front.partition("(")[2]
    return found


def has_ended(number: int, timeout: float = 30) -> bool:
    """Whether a process ends, but for what its parent has not asked for yet."""
    deadline, stat = time.monotonic() + timeout, Path(f"/proc/{number}/stat")
    while time.monotonic() < deadline:
        with suppress(FileNotFoundError, ProcessLookupError):
            if stat.read_text().rpartition(")")[2].split()[0] not in "ZX":
                time.sleep(0.02)
                continue
        return True
    return False


def all_end(session: int, timeout: float = 60) -> bool:
    """Whether all processes of a session end by themselves: what was killed does so in its own time."""
    deadline = time.monotonic() + timeout
    while members(session) and time.monotonic() < deadline:
        time.sleep(0.02)
    return not members(session)


def wait_for_rows(
    process: subprocess.Popen[Any], folder: Path, rows: int, timeout: float = 200
) -> None:
    """Wait until a run has recorded so many rows, its head among them."""
    history, deadline = folder / "history.csv", time.monotonic() + timeout
    while time.monotonic() < deadline and not (
        history.exists() and history.read_text().count("\n") >= rows
    ):
        time.sleep(0.02)
        assert process.poll() is None, process.communicate()


def wait_for_compiler(
    process: subprocess.Popen[str], program: str = COMPILER, timeout: float = 120
) -> int:
    """Wait until the C compiler itself is at work in this process's session; the number of the gcc that called it.

    At work is a compiler that has used processor time: it has opened its source.
    """
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        for number, name in members(process.pid).items():
            if name == program:
                with suppress(OSError):  # it has ended meanwhile
                    numbers = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()
                    if program != COMPILER or int(numbers[11]) >= TICKS:
                        return int(numbers[1])
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    os.killpg(process.pid, 9)
    raise AssertionError("no compiler was started")
