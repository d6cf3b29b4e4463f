"""What warnings have in common: they follow the steps of a run, and speak once."""

from __future__ import annotations

import logging
from collections.abc import Mapping

from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.state.memory import Numbers

log = logging.getLogger(__name__)


class WarnsOnce(Watcher):
    """Says one thing about a run, once; resumed runs know whether it was said.

    Parameters
    ----------
    stepper
        Whose states are looked at; what is remembered of them is part of its state.
    name
        What the names of all that is remembered begin with.
    initial
        Numbers to be remembered beside "said", and what they are at the start.
    """

    def __init__(self, stepper: Stepper, name: str, initial: Mapping[str, float] | None = None):
        self.stepper, self.state = stepper, stepper.state
        self.quadrature = stepper.state.cells.quadrature
        self._numbers = Numbers(stepper.state, name, {"said": 0} | dict(initial or {}))
        self._found = ""

    @property
    def said(self) -> bool:
        """Whether it was."""
        return bool(self._numbers["said"])

    def find(self, text: str) -> None:
        """In a solved state: it is said where the step is accepted, and else forgotten."""
        self._numbers["said"], self._found = True, text

    def undone(self, step: Step) -> None:
        """Forget what was found."""
        self._found = ""

    def committed(self, step: Step) -> None:
        """Say what was found."""
        if self._found:
            self.say(step, self._found)
            self._found = ""

    def say(self, step: Step, text: str, level: int = logging.WARNING) -> None:
        """Now, on the first rank, with the time of the step."""
        self._numbers["said"] = True
        if self.state.comm.rank == 0:
            log.log(level, "%s: %s", step.moment, text)
