"""Commands of this very package in processes of their own, which end with the one that has started them."""

from __future__ import annotations

import gc
import json
import os
import select
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any, TextIO

from remodel_fenicsx.system.environment import extensions_for_children
from remodel_fenicsx.system.files import open_own

SECONDS_TO_END = 30.0  # seconds
SERVE = "serve"  # the command of a worker's process


class Worker:
    """A process that does commands one after the other: what it has imported and compiled serves all of them."""

    def __init__(self) -> None:
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "bufsize": 1}
        self.process = _process([SERVE], **pipes)
        self.messages: Path | None = None
        self.is_at_work = False

    def begin(self, arguments: Sequence[str], messages: Path) -> None:
        """Begin a command, with a file for all that it says."""
        _emptied(messages).close()
        self.messages, self.is_at_work = messages, True
        assert self.process.stdin is not None
        if self.is_alive:  # else `poll` will see it; PETSc, where it is loaded, aborts at a closed pipe
            self.process.stdin.write(json.dumps([list(arguments), str(messages.absolute())]) + "\n")

    def poll(self) -> int | None:
        """Exit code of the command, negative for a signal that has ended the process; None while it is at work."""
        if not wait_for_one([self], 0.0):
            return None
        assert self.process.stdout is not None
        self.is_at_work, line = False, self.process.stdout.readline()
        return int(line) if line else self.process.wait() or 1  # it has ended without an answer

    @property
    def is_alive(self) -> bool:
        """Whether it takes another command."""
        return self.process.poll() is None

    def last_words(self) -> str:
        """The last line that the command has said, or what has ended the process."""
        code = self.process.poll()
        if code is not None and code < 0:
            return f"killed by {signal.Signals(-code).name}"
        assert self.messages is not None
        return last_line(self.messages.read_text(errors="replace")).removeprefix("remodel-fenicsx: ")

    def stop(self) -> None:
        """End it, by force if it takes too long."""
        if self.is_at_work:
            self.process.terminate()
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.close()
        _wait(self.process)
        self.process.stdout.close()


def wait_for_one(workers: Collection[Worker], seconds: float) -> bool:
    """Wait until a worker has something to say, at most so long; whether one has."""
    return bool(select.select([worker.process.stdout for worker in workers], [], [], seconds)[0])


def serve(command: Callable[[Sequence[str]], int]) -> int:
    """Do what a `Worker` asks for until it asks no more: the other end of its pipes."""
    with os.fdopen(os.dup(1), "w") as answers:
        for line in sys.stdin:
            words, messages = json.loads(line)
            descriptor = open_own(Path(messages), os.O_WRONLY | os.O_APPEND)
            for stream in (1, 2):
                os.dup2(descriptor, stream)
            os.close(descriptor)
            try:
                code = command(words)
            except SystemExit as end:  # argparse's way
                code = int(end.code or 0)
            sys.stdout.flush()
            if code > 128:  # a signal has asked this process to end
                return code
            print(code, file=answers, flush=True)
            gc.collect()  # meshes and matrices that refer to each other
    return 0


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0))


def _process(arguments: Sequence[str], **streams: Any) -> subprocess.Popen[Any]:
    """remodel-fenicsx ARGUMENTS; -P: no module is taken from the working folder, which may be somebody else's."""
    command = [sys.executable, "-P", "-m", "remodel_fenicsx.cli", *arguments]
    if shutil.which("setpriv"):  # the signal comes from now on; who was killed before is not the parent any more
        only_with_parent = ["sh", "-c", '[ "$PPID" = "$0" ] && exec "$@"', str(os.getpid())]
        command = ["setpriv", "--pdeathsig", signal.SIGTERM.name, *only_with_parent, *command]
    return subprocess.Popen(command, env=environment_of_child(), **streams)


def environment_of_child() -> dict[str, str]:
    """With this very package, and parts of one's own; one thread, as there are jobs for the cores."""
    paths = [str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])]
    own = {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    return os.environ | own | extensions_for_children()


def _emptied(messages: Path) -> TextIO:
    """A new file for what a run says, whatever was in its place: a link too."""
    messages.unlink(missing_ok=True)
    return open(open_own(messages, os.O_WRONLY | os.O_CREAT | os.O_EXCL), "w")


def last_line(said: str) -> str:
    """Of what a process has said."""
    return (said.strip().splitlines() or ["it said nothing"])[-1]


def _wait(process: subprocess.Popen[Any]) -> None:
    """Until it has ended, or is killed for taking too long."""
    try:
        process.wait(timeout=SECONDS_TO_END)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
