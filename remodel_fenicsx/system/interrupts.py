"""Signals: stop a run cleanly on SIGINT, SIGTERM and SIGHUP, and after a step on SIGUSR1.

Importing this module changes no handler; an application calls the functions that it needs.
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
from functools import partial
from pathlib import Path
from types import FrameType, TracebackType

from remodel_fenicsx.errors import PAUSED, RemodelError
from remodel_fenicsx.system.files import command_name

# requests to end a process
SIGNALS: tuple[int, ...] = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

# Asks a run to stop after the current step; batch systems send it before they kill a job.
PAUSE = signal.SIGUSR1

# seconds to wait for a repeated signal: `timeout`, for one, signals the process and then its group
_ONE_SIGNAL = 0.2

# Raises the exception of a signal again that was lost: Python ignores exceptions in finalisers, and
# libraries in C and in imports ignore any. Without a handler this signal does nothing.
_AGAIN = signal.SIGURG

# Signals on which PETSc aborts, including some that a run survives: a closed pipe, and the hangup
# that nohup ignores.
_NOT_PETSCS = (
    signal.SIGHUP,
    signal.SIGINT,
    signal.SIGPIPE,
    signal.SIGQUIT,
    signal.SIGTERM,
    signal.SIGURG,
)


def _exit_code(number: int) -> int:
    """Return the exit code of a process that ends on a signal."""
    return PAUSED if number == PAUSE else 128 + number


class Interrupted(RemodelError):  # noqa: N818 - no error: a user has stopped the run
    """Request to stop a run; the current step is discarded."""

    def __init__(self, number: int, on_all_ranks: bool = True):
        super().__init__(signal.Signals(number).name)
        self.on_all_ranks = on_all_ranks
        self.exit_code = _exit_code(number)
        self.kept = "all finished steps are saved"

    def in_words(self) -> str:
        """Describe the signal and what is saved, on one line."""
        return f"stopped by {self}; {self.kept}"


class _Signal(BaseException):
    """Signal that a handler raises; like KeyboardInterrupt no Exception, which libraries catch."""


class Paused(RemodelError):  # noqa: N818 - no error: a user has stopped the run
    """Stop on request between two steps, on all ranks; the run can be resumed."""

    exit_code = PAUSED

    def __init__(self, reason: str, time: float, folder: Path):
        super().__init__(reason)
        self.time, self.folder = time, folder

    def in_words(self) -> str:
        """Describe why and when the run stopped, and the command that resumes it."""
        way = f"{command_name()} run --resume {shlex.quote(str(self.folder))}"
        return f"{self} at time {self.time:g}; all steps are saved. Resume: {way}"


def restore_signal_handlers() -> None:
    """Import MPI and PETSc, then restore Python's signal handlers."""
    # The libraries' threads inherit the mask, so that they never receive a signal.
    with blocked(*SIGNALS, PAUSE):
        import mpi4py.MPI  # noqa: F401
        import petsc4py

        if _has_foreign_options():
            petsc4py.init([sys.argv[0], "-skip_petscrc"])
        import petsc4py.PETSc

        for number in _NOT_PETSCS if _is_main_thread() else ():
            # Python's own record: it does not see the handlers that libraries install.
            handler = signal.getsignal(number)
            if handler is not None:
                signal.signal(number, handler)


@contextmanager
def blocked(*numbers: int) -> Iterator[None]:
    """Block signals while the block runs, also for child processes."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _has_foreign_options() -> bool:
    """Return whether PETSc would read options from a working folder that is not the user's home."""
    home = Path.home()
    return any(map(os.path.lexists, (".petscrc", "petscrc"))) and not (
        home.exists() and home.samefile(".")
    )


def _is_main_thread() -> bool:
    """Return whether this is the main thread, the only one that may set handlers."""
    return threading.current_thread() is threading.main_thread()


@contextmanager
def handled(
    handler: Callable[[int, FrameType | None], object],
    numbers: Iterable[int],
    where: Callable[[object], bool],
) -> Iterator[None]:
    """Install a handler for those signals whose present handler satisfies `where`."""
    chosen = (
        [number for number in numbers if where(signal.getsignal(number))]
        if _is_main_thread()
        else []
    )
    before = {number: signal.signal(number, handler) for number in chosen}
    try:
        yield
    finally:
        for number, one in before.items():
            signal.signal(number, one)


@contextmanager
def held_back() -> Iterator[None]:
    """Hold back signals while the block runs, in Python and in child processes."""
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
    """Return whether this process is rank 0, without starting MPI."""
    rank = os.environ.get("OMPI_COMM_WORLD_RANK") or os.environ.get("PMI_RANK")
    if rank is None and "mpi4py.MPI" in sys.modules:  # MPI without these variables
        rank = str(sys.modules["mpi4py.MPI"].COMM_WORLD.rank)
    return rank in (None, "0")


def end_all_ranks_on_exception() -> None:
    """End all ranks of the run on an uncaught exception, not only the rank that raised it.

    Otherwise the remaining ranks would wait forever. (``python3 -m mpi4py`` does not suffice with
    PETSc, whose finalisation is collective and comes first.) On one rank the function only restores
    Python's signal handlers, which PETSc replaces (`restore_signal_handlers`).

    Notes
    -----
    Call it once, after importing MPI and PETSc.

    Examples
    --------
    >>> from remodel_fenicsx import parts
    >>> parts.end_all_ranks_on_exception()
    """
    from mpi4py import MPI

    restore_signal_handlers()
    if MPI.COMM_WORLD.size > 1:
        sys.excepthook = _print_and_abort


def _print_and_abort(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    from mpi4py import MPI

    traceback.print_exception(kind, error, trace)
    sys.stderr.flush()
    MPI.COMM_WORLD.Abort(1)


# ---------------------------------------------------------------- before a run has results


def exit_on_signal() -> AbstractContextManager[None]:
    """End the process on a signal with one line, unless a `StopRequest` handles the signal."""
    nobody = (signal.SIG_DFL, signal.default_int_handler)
    return handled(_end, (*SIGNALS, PAUSE), lambda handler: handler in nobody)


def _end(number: int, frame: FrameType | None) -> None:
    signal.signal(number, signal.SIG_IGN)  # One line, also if the signal comes twice.
    if is_first_rank():
        with suppress(OSError):  # The terminal is closed.
            os.write(2, f"remodel-fenicsx: stopped by {signal.Signals(number).name}\n".encode())
    os._exit(_exit_code(number))


# ---------------------------------------------------------------- a run


class StopRequest:
    """Context that records the first SIGINT, SIGTERM or SIGHUP; a second one ends the process."""

    def __init__(self) -> None:
        self.number = 0
        self.pause = False
        self.raises = False
        self._handled = handled(
            self._remember, (*SIGNALS, PAUSE), lambda handler: handler != signal.SIG_IGN
        )

    def __enter__(self) -> StopRequest:
        self._handled.__enter__()
        self.pause = any(request.pause for request in _requests)
        _requests.append(self)
        return self

    def _remember(self, number: int, frame: FrameType | None) -> None:
        if number == PAUSE:
            self.pause = True
        elif number != self.number:  # Ignores a repeated signal during the sleep below.
            self.number = number
            # mpirun kills its ranks a quarter of a second later.
            if os.environ.get("OMPI_COMM_WORLD_SIZE", "1") == "1":
                clock.sleep(_ONE_SIGNAL)
            signal.signal(number, signal.SIG_DFL)
            self.raise_again()

    def raise_again(self, *_: object) -> None:
        """Raise while the block of `raise_on_signal` runs, now and after each interval."""
        if self.number and self.raises:
            main = threading.main_thread().ident
            again = threading.Timer(_ONE_SIGNAL, signal.pthread_kill, (main, _AGAIN))
            again.daemon = True
            again.start()
            if not isinstance(sys.exception(), (_Signal, Interrupted)):  # It was lost.
                raise _Signal

    def __exit__(self, *error: object) -> None:
        _requests.remove(self)
        self._handled.__exit__(None, None, None)


_requests: list[StopRequest] = []  # active contexts; the last one receives the signals


@contextmanager
def raise_on_signal() -> Iterator[None]:
    """Raise Interrupted as soon as a signal arrives while the block runs."""
    if not _requests:
        yield
        return
    request = _requests[-1]
    if request.number:
        raise Interrupted(request.number, on_all_ranks=False)
    before, request.raises = request.raises, True
    hook, sys.unraisablehook = sys.unraisablehook, partial(
        _report_unless_signal, sys.unraisablehook
    )
    try:
        with handled(request.raise_again, [_AGAIN], lambda _: True):
            yield
    except _Signal:
        raise Interrupted(request.number, on_all_ranks=False) from None
    finally:
        request.raises, sys.unraisablehook = before, hook


def _report_unless_signal(
    report: Callable[[sys.UnraisableHookArgs], object], lost: sys.UnraisableHookArgs
) -> None:
    if not isinstance(lost.exc_value, _Signal):
        report(lost)
