"""Cells that rest and then make up for it at once: laws of the absolute time where tension comes and goes."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.evolution.memory import Earlier, Numbers
from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

JUMP = 0.03  # root mean square over the body of what the resumed cells change in A in one pass, over r0^2


class Resting(Watcher):
    """Warns, once, when cells that had rested change in one pass as much as if they had remodeled all the time.

    A pass leaves cells as they are where no principal value of the driver is positive. The law `explicit` (eq. 11)
    gives the cells of a time, not their rate: if tension comes back there, the next pass makes up for all that have
    been left out. Where remodeling itself takes the tension away and brings it back, as under weak loads with a strong
    network, when it stops and goes on depends on the step, and so does the result.

    Parameters
    ----------
    stepper
        Whose state is followed; what is remembered of the passes before is part of it from now on.
    """

    def __init__(self, stepper: Stepper):
        self.stepper, self.state = stepper, stepper.state
        self.quadrature = stepper.state.cells.quadrature
        self._cells = Earlier(self.state, "resting_cells", lambda: self.quadrature.function("", (3, 3)), 2)
        self._moved = Earlier(self.state, "resting_moved", lambda: self.quadrature.function("", ()), 1)
        self._numbers = Numbers(self.state, "resting", {"said": 0})
        # of the last pass: |change of A|^2 where it was made up for
        self._squares: Array = np.zeros(self.quadrature.shape)

    def started(self, step: Step) -> None:
        """No pass yet."""
        for memory in (self._cells, self._moved, self._numbers):
            memory.forget()
        self._cells.push(self.state.cells.structure_tensor().ravel())
        self._moved.push(np.zeros(self.quadrature.shape).ravel())

    def completed(self, step: Step) -> None:
        """One pass more."""
        structure = self.state.cells.structure_tensor()
        earlier = [values.reshape(structure.shape) for values in self._cells.values]
        now = _differ(structure, earlier[0])
        moved = self._moved.values[0].reshape(self.quadrature.shape) > 0
        self._squares = np.zeros(self.quadrature.shape)
        if len(earlier) > 1 and not self._numbers["said"]:
            resumed = now & moved & ~_differ(earlier[0], earlier[1])
            self._squares = np.where(resumed, np.sum((structure - earlier[0]) ** 2, axis=(-2, -1)), 0.0)
        self._cells.push(structure.ravel())
        self._moved.push((now | moved).astype(np.float64).ravel())

    def committed(self, step: Step) -> None:
        """Warn."""
        squares = self._squares
        jump = np.sqrt(self.quadrature.mean(squares)) / self.state.cells.settings.end_to_end_length**2
        if self._numbers["said"] or jump < JUMP:
            return
        self._numbers["said"] = True
        share, place = self.quadrature.mean((squares > 0).astype(float)), self.quadrature.place_of_largest(squares)
        if self.state.comm.rank == 0:
            log.warning(
                "time %g: cells that had rested for want of tension remodel again, and the law makes up for it in one "
                "pass: %.2g %% of the body, A by %.2g r0^2 (root mean square over the body; most at %.4g, %.4g, %.4g). "
                "When they rest depends on time.step, and so does the result; set remodeling.coupling = "
                '"relaxed", or a remodeling.law that is a rate (docs/theory.md, Stability of the pass)',
                step.time,
                100 * share,
                jump,
                *place,
            )


def _differ(one: Array, other: Array) -> NDArray[np.bool_]:
    """Where tensors (elements, points, 3, 3) are not the same to the last bit."""
    differ: NDArray[np.bool_] = np.any(one != other, axis=(-2, -1))
    return differ
