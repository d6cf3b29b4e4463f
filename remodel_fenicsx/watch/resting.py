"""Cells that rest and then make up for it at once: laws of the absolute time where tension comes and goes."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.state.memory import Earlier, Numbers
from remodel_fenicsx.watch.chatter import Chatter

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
        Whose state is followed; where cells have moved is part of it from now on.
    chatter
        Remembers the cells of the passes before; it watches the same steps, and is asked first.
    """

    def __init__(self, stepper: Stepper, chatter: Chatter):
        self.stepper, self.state, self.chatter = stepper, stepper.state, chatter
        self.quadrature = stepper.state.cells.quadrature
        self._moved = Earlier(self.state, "resting_moved", lambda: self.quadrature.function("", ()), 1)
        self._numbers = Numbers(self.state, "resting", {"said": 0})
        # of the last pass: |change of A|^2 where it was made up for
        self._squares: Array = np.zeros(self.quadrature.shape)

    def started(self, step: Step) -> None:
        """No pass yet."""
        self._moved.forget()
        self._numbers.forget()
        self._moved.push(np.zeros(self.quadrature.shape).ravel())

    def completed(self, step: Step) -> None:
        """One pass more."""
        cells = self.chatter.structures
        nowhere = np.zeros(self.quadrature.shape, dtype=bool)  # where memory begins anew there is nothing to tell
        now = _differ(cells[0], cells[1]) if len(cells) > 1 else nowhere
        moved = self._moved.values[0].reshape(self.quadrature.shape) > 0 if self._moved.known else nowhere
        self._squares = np.zeros(self.quadrature.shape)
        if len(cells) > 2 and not self._numbers["said"]:
            resumed = now & moved & ~_differ(cells[1], cells[2])
            self._squares = np.where(resumed, np.sum((cells[0] - cells[1]) ** 2, axis=-1), 0.0)
        self._moved.push((now | moved).astype(np.float64).ravel())

    def committed(self, step: Step) -> None:
        """Warn."""
        if self._numbers["said"]:
            return
        squares = self._squares
        jump = np.sqrt(self.quadrature.mean(squares)) / self.state.cells.settings.end_to_end_length**2
        if jump < JUMP:
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
    """Where tensors (elements, points, 6) are not the same to the last bit."""
    differ: NDArray[np.bool_] = np.any(one != other, axis=-1)
    return differ
