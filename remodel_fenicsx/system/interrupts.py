"""Signals: Ctrl-C, SIGTERM and SIGHUP, remembered until the run is at a place where it can stop cleanly."""

from __future__ import annotations

import signal
import sys
import threading
import traceback
from types import FrameType, TracebackType

import petsc4py.PETSc  # noqa: F401 - before its signals can be taken back
from mpi4py import MPI

_EXIT_CODE_BASE = 128

# PETSc aborts on all of these, and on some that a run outlives: a closed pipe, the hang-up that nohup ignores
_NOT_PETSCS = (signal.SIGHUP, signal.SIGINT, signal.SIGPIPE, signal.SIGQUIT, signal.SIGTERM, signal.SIGURG)


def _take_back_signals() -> None:
    """What Python had set before PETSc was loaded: a closed pipe is a BrokenPipeError, an ignored signal is ignored."""
    if threading.current_thread() is not threading.main_thread():  # others may not
        return
    for number in _NOT_PETSCS:
        handler = signal.getsignal(number)  # what Python remembers: it does not see that PETSc has replaced it
        if handler is not None:
            signal.signal(number, handler)


_take_back_signals()


class Interrupted(Exception):  # noqa: N818 - no error: somebody asked for it
    """The run was asked to stop; the step under way is dropped."""

    def __init__(self, number: int):
        super().__init__(signal.Signals(number).name)
        self.exit_code = _EXIT_CODE_BASE + number


def end_all_ranks_on_exception() -> None:
    """From now on an exception that nobody catches ends every rank of the run, not only the one that raised it.

    The others would wait for it for ever. (``python3 -m mpi4py`` is not enough once PETSc is there: its own end is
    collective and comes first.) On one rank nothing changes.
    """
    if MPI.COMM_WORLD.size > 1:
        sys.excepthook = _print_and_abort


def _print_and_abort(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    traceback.print_exception(kind, error, trace)
    sys.stderr.flush()
    MPI.COMM_WORLD.Abort(1)


class StopRequest:
    """Context that turns the first SIGINT, SIGTERM or SIGHUP into a request; a second one stops at once.

    PETSc must not see an exception from a callback, so a handler that raises is not enough: the solver asks `number`.
    A signal that is ignored (a background job of a script, nohup) stays ignored.
    """

    def __init__(self) -> None:
        self.number = 0
        self._previous: dict[int, object] = {}

    def __enter__(self) -> StopRequest:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) != signal.SIG_IGN:
                self._previous[number] = signal.signal(number, self._remember)
        return self

    def _remember(self, number: int, frame: FrameType | None) -> None:
        self.number = number
        signal.signal(number, signal.SIG_DFL)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
