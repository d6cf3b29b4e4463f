"""Signals: Ctrl-C, SIGTERM and SIGHUP, remembered until the run is at a place where it can stop cleanly; SIGUSR1, which
lets the step under way end.

Importing this module changes nothing; an application calls what it wants.
"""

from __future__ import annotations

import os
import shlex
import signal
import sys
import threading
import time as clock
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from types import FrameType, TracebackType

from remodel_fenicsx.errors import PAUSED, RemodelError
from remodel_fenicsx.system.files import typed

SIGNALS: tuple[int, ...] = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # ask a process to end

PAUSE = signal.SIGUSR1  # asks a run to end with the step under way; batch systems send it before they kill

_ONE_SIGNAL = 0.2  # seconds: timeout, for one, sends its signal to the process, and then to the group that this is in

# PETSc aborts on all of these, and on some that a run outlives: a closed pipe, the hang-up that nohup ignores
_NOT_PETSCS = (signal.SIGHUP, signal.SIGINT, signal.SIGPIPE, signal.SIGQUIT, signal.SIGTERM, signal.SIGURG)


def _exit_code(number: int) -> int:
    """Of a process that a signal has asked to end."""
    return PAUSED if number == PAUSE else 128 + number


class Interrupted(RemodelError):  # noqa: N818 - no error: somebody asked for it
    """The run was asked to stop; the step under way is dropped."""

    def __init__(self, number: int, on_all_ranks: bool = True):
        super().__init__(signal.Signals(number).name)
        self.on_all_ranks = on_all_ranks
        self.exit_code = _exit_code(number)
        self.kept = "every finished step is kept"

    def in_words(self) -> str:
        """What has stopped it, and what is kept."""
        return f"stopped by {self}; {self.kept}"


class Paused(RemodelError):  # noqa: N818 - no error: somebody asked for it
    """The run stopped on purpose between two steps, on all ranks, and can go on."""

    exit_code = PAUSED

    def __init__(self, reason: str, time: float, folder: Path):
        super().__init__(reason)
        self.time, self.folder = time, folder

    def in_words(self) -> str:
        """Why it stopped, how far it is, and how to go on."""
        way = f"{typed()} run --resume {shlex.quote(str(self.folder))}"
        return f"{self}: all is kept up to time {self.time:g}; it goes on with: {way}"


def take_back_signals() -> None:
    """Load MPI and PETSc, where nobody has yet, so that signals stay what Python has set."""
    with blocked(*SIGNALS, PAUSE):  # the libraries' threads inherit it, and never take one
        import mpi4py.MPI  # noqa: F401
        import petsc4py

        if _has_foreign_options():
            petsc4py.init([sys.argv[0], "-skip_petscrc"])
        import petsc4py.PETSc

        for number in _NOT_PETSCS if _is_main_thread() else ():
            handler = signal.getsignal(number)  # what Python remembers: it does not see what libraries put below
            if handler is not None:
                signal.signal(number, handler)


@contextmanager
def blocked(*numbers: int) -> Iterator[None]:
    """Within, these signals wait, also for programs that are started."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _has_foreign_options() -> bool:
    """Whether PETSc would read options from a file of the working folder, which is not the user's home."""
    home = Path.home()
    return any(map(os.path.lexists, (".petscrc", "petscrc"))) and not (home.exists() and home.samefile("."))


def _is_main_thread() -> bool:
    """Others may not set handlers."""
    return threading.current_thread() is threading.main_thread()


@contextmanager
def handled(
    handler: Callable[[int, FrameType | None], object], numbers: Iterable[int], where: Callable[[object], bool]
) -> Iterator[None]:
    """Within, a function gets these signals, where who has got them so far is one of those that are asked for."""
    chosen = [number for number in numbers if where(signal.getsignal(number))] if _is_main_thread() else []
    before = {number: signal.signal(number, handler) for number in chosen}
    try:
        yield
    finally:
        for number, one in before.items():
            signal.signal(number, one)


@contextmanager
def held_back() -> Iterator[None]:
    """Within, signals wait: Python's handlers, and those of programs that are started."""
    caught: list[int] = []
    try:
        with (
            handled(lambda number, _: caught.append(number), signal.valid_signals(), callable),
            blocked(*SIGNALS, PAUSE),
        ):
            yield
    finally:
        for number in caught:
            signal.raise_signal(number)


# ---------------------------------------------------------------- ranks


def is_first_rank() -> bool:
    """Whether this process is the one that speaks, without starting MPI."""
    rank = os.environ.get("OMPI_COMM_WORLD_RANK") or os.environ.get("PMI_RANK")
    if rank is None and "mpi4py.MPI" in sys.modules:  # of another MPI
        rank = str(sys.modules["mpi4py.MPI"].COMM_WORLD.rank)
    return rank in (None, "0")


def end_all_ranks_on_exception() -> None:
    """From now on an exception that nobody catches ends every rank of the run, not only the one that raised it.

    The others would wait for it for ever. (``python3 -m mpi4py`` is not enough once PETSc is there: its own end is
    collective and comes first.) On one rank nothing changes but that signals are taken back from PETSc, which would
    end a rank in its own way (`take_back_signals`).

    Notes
    -----
    Call it once, after MPI and PETSc have been imported.

    Examples
    --------
    >>> from remodel_fenicsx import parts
    >>> parts.end_all_ranks_on_exception()
    """
    from mpi4py import MPI

    take_back_signals()
    if MPI.COMM_WORLD.size > 1:
        sys.excepthook = _print_and_abort


def _print_and_abort(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    from mpi4py import MPI

    traceback.print_exception(kind, error, trace)
    sys.stderr.flush()
    MPI.COMM_WORLD.Abort(1)


# ---------------------------------------------------------------- before there is anything to keep


def ending_at_once() -> AbstractContextManager[None]:
    """Within, a signal ends the process with one line and its exit code, wherever no `StopRequest` waits for it."""
    nobody = (signal.SIG_DFL, signal.default_int_handler)
    return handled(_end, (*SIGNALS, PAUSE), lambda handler: handler in nobody)


def _end(number: int, frame: FrameType | None) -> None:
    signal.signal(number, signal.SIG_IGN)  # one line, also of a signal that comes twice
    if is_first_rank():
        with suppress(OSError):  # the terminal is gone
            os.write(2, f"remodel-fenicsx: stopped by {signal.Signals(number).name}\n".encode())
    os._exit(_exit_code(number))


# ---------------------------------------------------------------- a run


class StopRequest:
    """Context that turns the first SIGINT, SIGTERM or SIGHUP into a request; a second one stops at once."""

    def __init__(self) -> None:
        self.number = 0
        self.pause = False
        self.raises = False
        self._handled = handled(self._remember, (*SIGNALS, PAUSE), lambda handler: handler != signal.SIG_IGN)

    def __enter__(self) -> StopRequest:
        self._handled.__enter__()
        self.pause = any(request.pause for request in _requests)
        _requests.append(self)
        return self

    def _remember(self, number: int, frame: FrameType | None) -> None:
        if number == PAUSE:
            self.pause = True
        elif number != self.number:  # not during the sleep below
            self.number = number
            if os.environ.get("OMPI_COMM_WORLD_SIZE", "1") == "1":  # mpirun kills its ranks a quarter of a second later
                clock.sleep(_ONE_SIGNAL)
            signal.signal(number, signal.SIG_DFL)
            if self.raises:
                raise Interrupted(number, on_all_ranks=False)

    def __exit__(self, *error: object) -> None:
        _requests.remove(self)
        self._handled.__exit__(None, None, None)


_requests: list[StopRequest] = []  # those that are waiting for signals; the last one gets them


@contextmanager
def stopping_at_once() -> Iterator[None]:
    """Within, a request to stop is an exception at once."""
    if not _requests:
        yield
        return
    request = _requests[-1]
    if request.number:
        raise Interrupted(request.number, on_all_ranks=False)
    before, request.raises = request.raises, True
    try:
        yield
    finally:
        request.raises = before
