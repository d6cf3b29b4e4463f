"""A change in as many parts as Newton's method needs: half the part after a failure, twice after a success."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.evolution.blend import KEPT_RESERVE
from remodel_fenicsx.evolution.equilibrium import Extension
from remodel_fenicsx.evolution.newton import GuardedNewton, Solution, SolveFailure
from remodel_fenicsx.evolution.refusals import Refusal, diagnosed

SLOPE_SHARE = 1e-3  # of the bounded part: over it the slope of the residual is taken
log = logging.getLogger(__name__)


@dataclass
class Work:
    """Solver work of one step, failed attempts included."""

    newton_iterations: int = 0
    linear_iterations: int = 0
    substeps: int = 0
    residual: float = 0.0  # of the last solution, in the unit of force
    tangents: int = 0  # that were assembled
    extension: Extension | None = None  # of the last solution, where it was looked at with the cells of the row
    held_points: int = 0  # points whose cells do not belong to their stress, of the coupling "implicit"

    def add(self, done: Solution | SolveFailure | Work) -> None:
        """Count a solve, or the work of a step that was taken back."""
        self.newton_iterations += done.newton_iterations
        self.linear_iterations += done.linear_iterations
        self.tangents += done.tangents
        if isinstance(done, Solution):
            self.residual, self.extension = done.residual, done.extension


class StepFailure(RuntimeError):
    """A step cannot be solved, or is not wanted; the state is that of the last accepted step.

    Attributes
    ----------
    time
        Of the step.
    refusal
        Why, and what helps.
    """

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
    roughly
        Whether all parts but the last may be solved coarsely. Not near a limit of the load: it would be passed.
    """

    time: float
    stage: str
    set_fraction: Callable[[float], None]
    newton: GuardedNewton
    maximum_halvings: int
    largest_part: Callable[[float], float] = lambda done: 1.0
    roughly: bool = False
    _direction: NDArray[np.float64] | None = field(default=None, init=False)  # of the unknowns over the last part

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
            before = self.newton.unknown.x.array.copy()
            part = self._started(min(part, 1.0 - done), done, work)
            is_last = done + part > 1.0 - 1e-12
            self.set_fraction(1.0 if is_last else done + part)
            self.newton.on_the_way = self.roughly and not is_last
            try:
                work.add(self.newton.solve())
            except SolveFailure as failed:
                self.newton.unknown.x.array[:] = before
                work.add(failed)
                part = self._halved(part, done, failed)
            else:
                done = 1.0 if is_last else done + part
                self._direction = (self.newton.unknown.x.array - before) / part
                part *= 2
                work.substeps += 1
            finally:
                self.newton.on_the_way = False

    def _started(self, wanted: float, done: float, work: Work) -> float:
        """The next part, with the unknowns that it starts from.

        Where the bound at the present unknowns is smaller than what is wanted, they go on as over the last part: along
        that way chains keep about their length, and parts can be larger. Every point keeps its reserve there too.
        """
        bound = min(wanted, self.largest_part(done))
        if bound >= wanted:
            return bound
        if self._direction is None:
            self._direction = self.newton.tangent_direction(self.set_fraction, done, SLOPE_SHARE * bound)
            work.newton_iterations += 1
            work.linear_iterations += 1
        if not np.all(np.isfinite(self._direction)):
            self._direction = None
            return bound
        unknown, equilibrium = self.newton.unknown.x.array, self.newton.equilibrium
        before = unknown.copy()
        self.set_fraction(done)
        present = equilibrium.look().stretches
        while wanted > bound:
            self.set_fraction(done + wanted)
            unknown[:] = before + wanted * self._direction
            expected = equilibrium.look()
            if expected.extension.admissible and equilibrium.keeps_reserve(present, expected.stretches, KEPT_RESERVE):
                return wanted
            wanted /= 2
        unknown[:] = before
        return bound

    def _halved(self, part: float, done: float, failure: SolveFailure) -> float:
        if part / 2 < 2.0**-self.maximum_halvings:
            text = failure_text(self.time, self.stage, done, failure)
            self.set_fraction(done)  # the last state that was solved
            raise StepFailure(self.time, text, diagnosed(self.newton, failure, self._direction)) from failure
        log.debug("%s: %s; next part %g", self.stage, failure.reason, part / 2)
        return part / 2
