"""Stops on purpose, between two steps: asked for by a signal, or because the time that was given is over."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from pathlib import Path
from typing import Any

from remodel_fenicsx.evolution.stepper import Step, Watcher
from remodel_fenicsx.system.interrupts import Paused

MARGIN = 1.2  # how much longer than those before it the next step may take
NOT_ASKED, BY_SIGNAL, BY_CLOCK = range(3)
REASONS = {BY_SIGNAL: "stopped by SIGUSR1", BY_CLOCK: "stopped before --max-wall-time is over"}


class Pause(Watcher):
    """Raises `Paused` after a step, on all ranks, if somebody asked for it or the next step would come too late.

    Parameters
    ----------
    comm
        Communicator; the clock is that of rank 0.
    folder
        Where the run is kept.
    asked
        Whether this rank was asked to stop.
    deadline
        `time.monotonic` at which the run must have ended; None: never.
    """

    def __init__(self, comm: Any, folder: Path, asked: Callable[[], bool], deadline: float | None = None):
        self.comm, self.folder, self.asked, self.deadline = comm, folder, asked, deadline
        self._last = clock.monotonic()
        self._seconds = 0.0  # of a step with all that is written of it

    def started(self, step: Step) -> None:
        """Before the first step."""
        self._last = clock.monotonic()
        self._check(step)

    def resumed(self, step: Step) -> None:
        """Before the first step of this run."""
        self.started(step)

    def committed(self, step: Step) -> None:
        """After each step but the last."""
        now = clock.monotonic()
        self._seconds, self._last = max(0.5 * self._seconds, now - self._last), now
        if not step.is_last:
            self._check(step)

    def _check(self, step: Step) -> None:
        reason = BY_SIGNAL if self.asked() else NOT_ASKED
        if self.deadline is not None and self.comm.rank == 0 and not reason:
            late = clock.monotonic() + MARGIN * self._seconds > self.deadline
            reason = BY_CLOCK if late else NOT_ASKED
        asked = [one for one in self.comm.allgather(reason) if one]
        if asked:
            raise Paused(REASONS[asked[0]], step.time, self.folder)
