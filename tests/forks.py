"""remodel-fenicsx in children of one process that has imported all that takes time: that is most of a short run.

`python3 forks.py` is that process. Each line on stdin is a request in JSON, see `Forks.run`; its answer is a line with
the exit status, negative for a signal. `python3 forks.py WORDS` is remodel-fenicsx WORDS with a tube of four layers.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import importlib
import importlib.metadata
import json
import logging
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from remodel_fenicsx.system import children

# before a program: a mesh of few elements for every tube
COARSE = "from remodel_fenicsx.body import tube; tube.PAPER = (8, 4, 1)\n"


class Forks:
    """The process and who asks it: what takes a start of its own (signals, PETSC_OPTIONS, ranks) is not for it."""

    def __init__(self) -> None:
        inherited = {name: value for name, value in os.environ.items() if name != "PETSC_OPTIONS"}
        self.process = subprocess.Popen(
            [sys.executable, __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
            env=inherited,
        )

    def close(self) -> None:
        """End it, and wait for it: its processor time is this session's."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()

    def run(
        self,
        program: str,
        *words: str | Path,
        cwd: Path | None = None,
        variables: Mapping[str, str] | None = None,
        seconds: float | None = None,
        imports: tuple[str, ...] = (),
    ) -> subprocess.CompletedProcess[str]:
        """A program of `PROGRAMS` in a child, as subprocess.run.

        Parameters
        ----------
        program, words, cwd, variables
            What runs where, and the environment; PETSc has read its own long before.
        seconds
            Of its processor time, after which it is killed; None: never.
        imports
            What else it shall find imported.
        """
        assert self.process.stdin is not None and self.process.stdout is not None
        with tempfile.TemporaryDirectory() as folder:
            streams = [os.path.join(folder, name) for name in ("output", "errors")]
            environment = dict(os.environ if variables is None else variables)
            request = [
                program,
                [*map(str, words)],
                str(cwd or Path.cwd()),
                environment,
                streams,
                imports,
                seconds,
            ]
            print(json.dumps(request), file=self.process.stdin, flush=True)
            answer = self.process.stdout.readline()
            assert answer, f"it has ended: {self.process.wait()}"
            output, errors = (Path(name).read_text() for name in streams)
        return subprocess.CompletedProcess(words, int(answer), output, errors)


@functools.cache
def _started() -> list[Forks]:
    return []


def forked(program: str, *words: str | Path, **options: Any) -> subprocess.CompletedProcess[str]:
    """`Forks.run` by the one process that this one has, started anew if a test's limit has ended it."""
    started = _started()
    if not started or started[-1].process.poll() is not None:
        started.append(Forks())
    return started[-1].run(program, *words, **options)


def end_forks() -> None:
    """At the end of a session."""
    for each in _started():
        if each.process.poll() is None:
            each.close()


class ForkedChild:
    """Stands for subprocess.Popen in `remodel_fenicsx.system.children`, for commands that nobody stops."""

    one_at_a_time = threading.Lock()  # threads of a study ask

    def __init__(self, *_: Any, **__: Any):
        self.returncode: int | None = None
        answers, self._answers = os.pipe()
        self.stdin, self.stdout = self, os.fdopen(answers)

    def write(self, request: str) -> None:
        """Do what a worker is asked for, and answer."""
        words, messages = json.loads(request)
        with self.one_at_a_time:
            done = forked("remodel-fenicsx", *words)
        Path(messages).write_text(done.stdout + done.stderr)
        os.write(self._answers, f"{done.returncode}\n".encode())

    def close(self) -> None:
        """Nothing is asked for any more."""
        os.close(self._answers)
        self.returncode = 0

    def poll(self) -> int | None:
        """Whether it has ended."""
        return self.returncode

    def wait(self, timeout: float) -> None:
        """It has ended."""


def read_in_a_fork(command: Sequence[str], **_: Any) -> subprocess.CompletedProcess[bytes]:
    """Stands for subprocess.run in `remodel_fenicsx.system.children`: a reader with its limits, in a fork."""
    reader, *words, memory = command[command.index("remodel_fenicsx.system.children") + 1 :]
    for module in ("meshio", *reader.partition(":")[0].split()):
        importlib.import_module(module)
    with tempfile.TemporaryFile() as said, warnings.catch_warnings(action="ignore"):
        child = os.fork()
        if not child:
            try:
                logging.root.handlers.clear()
                sys.stdout = sys.stderr = open(os.dup(said.fileno()), "w", buffering=1)
                for stream in (1, 2):
                    os.dup2(said.fileno(), stream)
                here = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
                children.read_as_child(reader, *words, str(int(memory) + here))
                os._exit(0)
            except SystemExit as end:
                print(end.code)
            finally:  # whatever it was: this process is no second session
                os._exit(1)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        said.seek(0)
        return subprocess.CompletedProcess(command, status, b"", said.read())


def readers_are_forks() -> None:
    """From here on in this process and its children; tests/body/test_guarded.py has readers that start."""
    children.subprocess = SimpleNamespace(**vars(subprocess) | {"run": read_in_a_fork})  # type: ignore[assignment]


# ---------------------------------------------------------------- the process itself
def four_layers(words: list[str]) -> int:
    """remodel-fenicsx with another mesh of the tube: around, through, along."""
    importlib.import_module("remodel_fenicsx.body.tube").PAPER = (8, 4, 1)
    return remodel_fenicsx(words)


def remodel_fenicsx(words: list[str]) -> int:
    """The command."""
    from remodel_fenicsx import cli

    return cli.main(words)


def run_case(words: list[str]) -> int:
    """What tests/conftest.py asks for."""
    from tests import run_case

    for path, text in zip(words[::2], words[1::2], strict=True):
        run_case.main(path, json.loads(text))
    return 0


def python(words: list[str]) -> int:
    """`python3 -c`."""
    sys.argv = ["-c", *words[1:]]
    exec(compile(words[0], "<string>", "exec"), {"__name__": "__main__"})
    return 0


PROGRAMS = {
    "remodel-fenicsx": remodel_fenicsx,
    "four layers": four_layers,
    "case": run_case,
    "python": python,
}


def begin(
    program: str, words: list[str], folder: str, variables: dict[str, str], streams: list[str]
) -> int:
    """In a child: the program with a folder, an environment and streams of its own."""
    for number, name in enumerate([os.devnull, *streams]):
        os.dup2(os.open(name, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o600), number)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(variables)
    try:
        status = PROGRAMS[program](words)
    except SystemExit as end:  # argparse's way
        status = int(end.code or 0)
    except BaseException:
        traceback.print_exc()
        status = 1
    with contextlib.suppress(BrokenPipeError):
        sys.stdout.flush()
    return status


def status_of(child: int, seconds: float | None) -> int:
    """Exit status of a child, killed when it has worked for so long, however busy the machine is."""
    if seconds is None:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    while True:
        found, status = os.waitpid(child, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        if int(Path(f"/proc/{child}/schedstat").read_text().split()[0]) > 1e9 * seconds:
            os.kill(child, signal.SIGKILL)
            return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        time.sleep(0.002)


def what_is_imported_stays() -> None:
    """For a process that goes on for long, and its children: work of libraries that finds nothing new is spared.

    Garbage is collected less often, and setuptools, which cffi asks for its compiler, does not read the entry points of
    all packages anew, six times for every kernel.
    """
    gc.set_threshold(50_000, *gc.get_threshold()[1:])  # forms make many objects and little garbage
    known = importlib.metadata.entry_points()
    importlib.metadata.entry_points = lambda **wanted: known.select(**wanted)


def serve() -> None:
    """Until there are no more requests."""
    for line in sys.stdin:
        *request, imports, seconds = json.loads(line)
        for module in imports:
            importlib.import_module(module)
        child = os.fork()
        if not child:
            os._exit(begin(*request))
        print(status_of(child, seconds), flush=True)


if __name__ == "__main__":
    for module in (
        "gmsh",
        "h5py",
        "meshio",
        "remodel_fenicsx.body.tube",
        "remodel_fenicsx.body.domain",
        "remodel_fenicsx.running",
        "tests.run_case",
    ):
        importlib.import_module(module)
    what_is_imported_stays()
    readers_are_forks()
    gc.freeze()  # children share what is there: no collection goes through it
    if sys.argv[1:]:
        sys.exit(four_layers(sys.argv[1:]))
    serve()
