"""Whether the tissue keeps its volume: soft tissue is nearly incompressible, and a matrix that is not says so."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.state.memory import Numbers

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

# Of its volume a soft tissue is measured to lose a few per cent at most: what is beyond is a choice of lambda. The
# paper's tendon and artery, lambda/mu = 8.8, keep J above 0.92 at every point.
NOTED = 0.05  # mean loss that the log mentions at the end
MEAN_LOSS, LEAST_JACOBIAN = 0.2, 0.6  # from where on it is hardly meant


class VolumeLoss(Watcher):
    """Warns, once, where the tissue loses much of its volume, and says at the end how much it has lost at most.

    Where the formulation takes J at points of its own, J is that: at the others nothing holds it.

    Parameters
    ----------
    stepper
        Whose solved states are looked at; what is remembered of them is part of its state.
    """

    def __init__(self, stepper: Stepper):
        self.stepper, self.state, self.quadrature = stepper, stepper.state, stepper.state.cells.quadrature
        initial = {"mean": 1.0, "mean_time": 0.0, "least": 1.0, "least_time": 0.0, "warned": 0}
        self._numbers = Numbers(stepper.state, "volume", initial | dict.fromkeys("xyz", 0.0))

    def solved(self, step: Step) -> None:
        """Look at J."""
        numbers, look = self._numbers, self.stepper.coupling.equilibrium.look()
        jacobians = look.states[:, 1].reshape(look.stretches.shape)
        mean = self.quadrature.integral(jacobians) / self.quadrature.volume
        if mean < numbers["mean"]:
            numbers["mean"], numbers["mean_time"] = mean, step.time
        of_formulation = self.quadrature.owned(self.state.dilatation.jacobians())
        if of_formulation.shape[1]:
            jacobians = np.broadcast_to(of_formulation.min(axis=1)[:, None], jacobians.shape)
        least = self.quadrature.minimum(jacobians)
        if least < numbers["least"]:
            numbers["least"], numbers["least_time"] = least, step.time
            for name, value in zip("xyz", self.quadrature.place_of_largest(-jacobians), strict=True):
                numbers[name] = value

    def committed(self, step: Step) -> None:
        """Say what there is to say."""
        numbers = self._numbers
        if not numbers["warned"] and (1 - numbers["mean"] >= MEAN_LOSS or numbers["least"] < LEAST_JACOBIAN):
            numbers["warned"] = True
            self._say(
                logging.WARNING, f"time {step.time:g}: ", "; set a larger material.lame_lambda (docs/commands.md)"
            )
        elif step.is_last and 1 - numbers["mean"] >= NOTED:
            self._say(logging.INFO, "", "")

    def _say(self, level: int, before: str, after: str) -> None:
        found = {name: self._numbers[name] for name in self._numbers.initial}
        if self.state.comm.rank == 0:
            text = (
                "the tissue has lost up to {lost:.2g} % of its volume (mean J {mean:.3g} at time {mean_time:g}; least "
                "J {least:.3g} at {x:.4g}, {y:.4g}, {z:.4g}, time {least_time:g})"
            ).format(lost=100 * (1 - found["mean"]), **found)
            log.log(level, "%s%s%s", before, text, after)
