"""How far a row's cells are from those that smaller steps would give: an estimate from the step itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.evolution.memory import Earlier, Numbers
from remodel_fenicsx.evolution.stepper import Step, Stepper

Array = NDArray[np.float64]
FibreAngle = Callable[[Array, Array, Array], Array]

SLOWEST = 20.0  # times as slowly as the cells alone body and cells may forget


@dataclass(frozen=True)
class Estimate:
    """Of one step, in degrees of the fibre angle, root mean square over the body.

    Attributes
    ----------
    controlled
        What a tolerance holds down: the error that the row would end with if all steps were like this one.
    row
        The row's own: where the errors of steps add up, with what is left of those before.
    forgotten
        Share of an earlier error that the cells forget over the step, 1 - exp(-kappa dt).
    """

    controlled: float
    row: float
    forgotten: float


class TimeError:
    """Compares the cells of each row with better ones, which the coupling has from the same step (docs/theory.md).

    A staggered row is solved with cells that lag a step behind: the cells that its own pass makes are better. Rows of
    the other couplings lag nothing, but their cells follow a target that changes within the step: better is one that
    goes from that of its start to that of its end. Each step then adds an error, and kappa forgets it: it ends at the
    error of a step over 1 - exp(-kappa dt), if all steps are alike.

    Cells forget with kappa, but the stress follows the cells, so that body and cells together forget more slowly: with
    the rate at which they slow down under loads that are held, which is measured. With time an error grows by kappa
    over it.

    Parameters
    ----------
    stepper
        Whose steps are estimated; what is remembered of them is part of its state.
    fibre_angle
        Of dimensions, axes and places, as `Shape.fibre_angle`.
    """

    def __init__(self, stepper: Stepper, fibre_angle: FibreAngle):
        self.stepper, self.state, self.fibre_angle = stepper, stepper.state, fibre_angle
        self.quadrature, self.kappa = stepper.state.cells.quadrature, stepper.remodeling.settings.kappa
        stepper.coupling.compares = True
        initial = {"row": 0.0, "speed": 0.0, "duration": 0.0, "fading": self.kappa, "answer": 1.0}
        self._numbers = Numbers(stepper.state, "time_error", initial)
        self._angles = Earlier(stepper.state, "time_error_angles", lambda: self.quadrature.function("", ()), 1)

    def measure(self, step: Step) -> Estimate:
        """The estimate of a step whose pass is done, within its transaction."""
        coupling, duration = self.stepper.coupling, step.time - self.state.time
        solved = self.state.equilibrium_cells
        angles = self.fibre_angle(solved.dimension_values, solved.axis_values, self.quadrature.coordinates)
        fading = self._fading(step, angles, duration)
        difference, answer = self._difference(angles), self._answer(fading, duration)
        forgotten = float(-np.expm1(-self.kappa * duration))
        if not coupling.accumulates or not forgotten:
            found = Estimate(answer * difference, answer * difference, forgotten)
        else:
            left = float(np.exp(-fading * duration)) * self._numbers["row"] + difference
            found = Estimate(answer * difference / forgotten, left, forgotten)
        self._numbers["row"] = step.time_error = found.row
        return found

    def _fading(self, step: Step, angles: Array, duration: float) -> float:
        """Rate at which errors fade: that at which the angles slow down while loads are held."""
        numbers, known = self._numbers, self._angles.values
        before, fading = numbers["speed"], numbers["fading"]
        speed = 0.0
        if known:
            last = known[0].reshape(angles.shape)
            speed = self._typical(angles - last) / duration
        if not self._held(step):
            fading = self.kappa
        elif before > 0 and speed > 0:
            rate = np.log(before / speed) / (0.5 * (duration + numbers["duration"]))
            fading = float(np.sqrt(fading * np.clip(rate, self.kappa / SLOWEST, self.kappa)))
        self._angles.push(angles.ravel())
        numbers["speed"], numbers["duration"], numbers["fading"] = speed, duration, fading
        return fading

    def _answer(self, fading: float, duration: float) -> float:
        """By what the stress, which follows the cells, has magnified an error since loads are held: to kappa/fading."""
        left = float(np.exp(-fading * duration))
        limit = self.kappa / fading if fading else 1.0
        answer = max(1.0, left * self._numbers["answer"] + (1.0 - left) * limit)
        self._numbers["answer"] = answer
        return answer

    def _held(self, step: Step) -> bool:
        """Whether no load has changed over the step."""
        before = self.stepper.load_values(self.state.time)
        return all(step.loads.get(name) == value for name, value in before.items())

    def _difference(self, angles: Array) -> float:
        """Root mean square of the difference to the angles of the better cells."""
        better = self.stepper.coupling.better
        if better is None:
            return 0.0
        dimensions = better.dimensions.reshape(*self.quadrature.shape, 3)
        axes = better.axes.reshape(*self.quadrature.shape, 3, 3)
        apart = self.fibre_angle(dimensions, axes, self.quadrature.coordinates) - angles
        return self._typical(apart)

    def _typical(self, differences: Array) -> float:
        """Root mean square over the points that have an angle; 0 where there is none."""
        return float(np.sqrt(np.nan_to_num(self.quadrature.mean_of_known(differences**2))))
