"""How far a row's cells are from those that smaller steps would give: an estimate from the step itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.evolution.memory import Numbers
from remodel_fenicsx.evolution.stepper import Step, Stepper

Array = NDArray[np.float64]
FibreAngle = Callable[[Array, Array, Array], Array]


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
        Share of an earlier error that the law forgets over the step, 1 - exp(-kappa dt).
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

    Parameters
    ----------
    stepper
        Whose steps are estimated.
    fibre_angle
        Of dimensions, axes and places, as `Shape.fibre_angle`.
    """

    def __init__(self, stepper: Stepper, fibre_angle: FibreAngle):
        self.stepper, self.state, self.fibre_angle = stepper, stepper.state, fibre_angle
        stepper.coupling.compares = True
        self._numbers = Numbers(stepper.state, "time_error", {"row": 0.0})

    def measure(self, step: Step) -> Estimate:
        """The estimate of a step whose pass is done, within its transaction."""
        coupling = self.stepper.coupling
        duration = step.time - self.state.time
        forgotten = float(-np.expm1(-self.stepper.remodeling.settings.kappa * duration))
        difference = self._difference()
        if not coupling.accumulates or not forgotten:
            found = Estimate(difference, difference, forgotten)
        else:
            left = (1.0 - forgotten) * self._numbers["row"] + difference
            found = Estimate(difference / forgotten, left, forgotten)
        self._numbers["row"] = step.time_error = found.row
        return found

    def _difference(self) -> float:
        better = self.stepper.coupling.better
        if better is None:
            return 0.0
        solved, quadrature = self.state.equilibrium_cells, self.state.cells.quadrature
        dimensions = better.dimensions.reshape(*quadrature.shape, 3)
        axes = better.axes.reshape(*quadrature.shape, 3, 3)
        angles = self.fibre_angle(dimensions, axes, quadrature.coordinates)
        angles = angles - self.fibre_angle(solved.dimension_values, solved.axis_values, quadrature.coordinates)
        return float(np.sqrt(quadrature.mean(angles**2)))
