"""A change in as many parts as Newton's method needs: half the part after a failure, twice after a success."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

from remodel_fenicsx.evolution.newton import GuardedNewton, Solution, SolveFailure
from remodel_fenicsx.evolution.refusals import TOO_LARGE, Refusal

log = logging.getLogger(__name__)


@dataclass
class Work:
    """Solver work of one step, failed attempts included."""

    newton_iterations: int = 0
    linear_iterations: int = 0
    substeps: int = 0
    residual: float = 0.0  # of the last solution, in the unit of force

    def add(self, done: Solution | SolveFailure) -> None:
        """Count a solve."""
        self.newton_iterations += done.newton_iterations
        self.linear_iterations += done.linear_iterations
        if isinstance(done, Solution):
            self.residual = done.residual


class StepFailure(RuntimeError):
    """A step cannot be solved even in the smallest parts; the state is that of the last accepted step."""

    def __init__(self, time: float, text: str, refusal: Refusal):
        super().__init__(text)
        self.time, self.refusal = time, refusal


def failure_text(time: float, stage: str, fraction: float, cause: SolveFailure) -> str:
    """Where a change of the problem has stopped, and why."""
    point = ", ".join(f"{c:.3f}" for c in cause.extension.worst_point)
    return (
        f"no equilibrium at time {time:g}: {stage} stops at {100 * fraction:.3g} % of the step ({cause.reason}; "
        f"largest r/L = {cause.extension.max_chain_extension:.4f} at ({point}), "
        f"smallest J = {cause.extension.min_jacobian:.4g})"
    )


@dataclass
class Change:
    """A change of the problem that can be applied in parts.

    Attributes
    ----------
    time, stage
        Time of the step and name of the change, for messages.
    set_fraction
        Applies a fraction of it, 0 to 1.
    newton
        Solves the problem with what is applied.
    maximum_halvings
        How often the whole is halved before it has failed.
    largest_part
        Largest further part from a fraction on, where there is a bound.
    """

    time: float
    stage: str
    set_fraction: Callable[[float], None]
    newton: GuardedNewton
    maximum_halvings: int
    largest_part: Callable[[float], float] = lambda done: 1.0

    def advance(self, work: Work, failure: SolveFailure | None = None) -> None:
        """Go from 0 to 1; `failure`: that of the whole, if it was tried.

        Raises
        ------
        StepFailure
            If the smallest part fails.
        """
        done, part = 0.0, 1.0
        if failure is not None:
            part = self._halved(part, done, failure)
        while done < 1.0:
            part = min(part, self.largest_part(done), 1.0 - done)
            self.set_fraction(1.0 if done + part > 1.0 - 1e-12 else done + part)
            try:
                work.add(self.newton.solve())
            except SolveFailure as failed:
                work.add(failed)
                part = self._halved(part, done, failed)
            else:
                done = 1.0 if done + part > 1.0 - 1e-12 else done + part
                part *= 2
                work.substeps += 1

    def _halved(self, part: float, done: float, failure: SolveFailure) -> float:
        if part / 2 < 2.0**-self.maximum_halvings:
            text = failure_text(self.time, self.stage, done, failure)
            raise StepFailure(self.time, text, TOO_LARGE) from failure
        log.debug("%s: %s; next part %g", self.stage, failure.reason, part / 2)
        return part / 2
