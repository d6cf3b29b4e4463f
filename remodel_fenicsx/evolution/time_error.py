"""How far a row is from what smaller steps would give: an estimate from the step itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.evolution.stepper import Step, Stepper
from remodel_fenicsx.model import spectral, tensors
from remodel_fenicsx.model.cells import UnitCell, angle_between, structure_tensor
from remodel_fenicsx.model.tensors import largest_change_of_length
from remodel_fenicsx.state.memory import Earlier, Numbers

Array = NDArray[np.float64]

SLOWEST = 20.0  # times as slowly as the cells alone body and cells may forget
LARGEST_LINEAR_CHANGE = 1.0  # change of a length: a linear answer says no more
COMPONENTS = (len(tensors.MANDEL),)


@dataclass(frozen=True)
class Estimate:
    """Of one step, in degrees.

    The larger of two errors: that of the direction of the chains in space (`angle_between`), root mean square over the
    body, and the largest error of a length in the body, relative to this length, as an angle in radians. A strain of
    this size turns lines of the body by up to this angle.

    Attributes
    ----------
    controlled
        What a tolerance holds down: the error that the row would end with if all steps were like this one.
    row
        The row's own: where the errors of steps add up, with what is left of those before.
    """

    controlled: float
    row: float


class TimeError:
    """Compares each row with a better one, which the coupling has from the same step (docs/theory.md).

    Rows of some couplings lag nothing, but their cells follow a target that changes within the step: better is one that
    goes from that of its start to that of its end. Each step then adds an error, and kappa forgets it: it ends at the
    error of a step over 1 - exp(-kappa dt), if all steps are alike. Cells forget with kappa, but the stress follows the
    cells, so that body and cells together forget more slowly: with the rate at which they slow down under loads that
    are held, which is measured. With time an error grows by kappa over it.

    A staggered row is solved with cells that lag a step behind: those that its own pass makes are better. But the
    stress, to which the pass answers, lags too: the better cells are those that a pass makes with the stress of a body
    that has the better cells. They are found by one such pass at each step, from what the error was at the last one.

    How the body answers other cells is one solution with the tangent of its last Newton iteration.

    Parameters
    ----------
    stepper
        Whose steps are estimated; what is remembered of them is part of its state.
    """

    def __init__(self, stepper: Stepper):
        self.stepper, self.state = stepper, stepper.state
        self.quadrature, self.kappa = stepper.state.cells.quadrature, stepper.remodeling.slowest
        stepper.coupling.compares = True
        initial = {"row": 0.0, "speed": 0.0, "duration": 0.0, "fading": self.kappa, "answer": 1.0}
        self._numbers = Numbers(stepper.state, "time_error", initial)
        # of structure tensors: with rows that lag the last error, with others the last row
        self._last = Earlier(stepper.state, "time_error_cells", lambda: self.quadrature.function("", COMPONENTS), 1)

    def measure(self, step: Step) -> Estimate:
        """The estimate of a step whose pass is done, within its transaction."""
        duration = step.time - self.state.time
        solved, better = self.state.equilibrium_cells, self.stepper.coupling.better
        row = UnitCell(solved.dimension_values.reshape(-1, 3), solved.axis_values.reshape(-1, 3, 3))
        if self.stepper.coupling.accumulates:
            found = self._added_up(step, row, better, duration)
        elif better is None:
            found = Estimate(0.0, 0.0)
        else:
            lag = self._lag(step, row, better, duration)
            found = Estimate(lag, lag)
        self._numbers["row"], self._numbers["duration"] = found.row, duration
        step.time_error = found.row
        return found

    # ------------------------------------------------------------ rows that lag behind
    def _lag(self, step: Step, row: UnitCell, better: UnitCell, duration: float) -> float:
        """Distance to the cells of a pass with the stress that belongs to such cells."""
        before, expected = structure_tensor(*row[:2]), better
        if self._last.known:
            last = tensors.from_mandel(self._last.values[0].reshape(-1, *COMPONENTS))
            squared, axes = spectral.continued(before + duration / self._numbers["duration"] * last, row.axes)
            expected = UnitCell(np.sqrt(np.maximum(squared, 0.0)), axes)
        known, angle = better, self._angle(row, better)
        with self.state.tentative():
            strain, admissible = self._strain(step, expected)
            if admissible:
                remodeling = self.stepper.remodeling
                better, _ = remodeling.updated_cells(self.state.time, step.time, step.work.residual, row)
        most, angle = SLOWEST * angle, self._angle(row, better)
        if angle > most:  # another state, to which this one does not tend
            better, angle = known, most
        self._last.push(tensors.to_mandel(structure_tensor(*better[:2]) - before).ravel())
        return max(angle, strain)

    # ------------------------------------------------------------ errors that add up
    def _added_up(self, step: Step, row: UnitCell, better: UnitCell | None, duration: float) -> Estimate:
        fading = self._fading(step, row, duration)
        answer, difference = self._answer(fading, duration), 0.0
        if better is not None:
            with self.state.tentative():
                strain, _ = self._strain(step, better)
            difference = max(self._angle(row, better), strain)
        forgotten = float(-np.expm1(-self.kappa * duration))
        left = float(np.exp(-fading * duration)) * self._numbers["row"] + difference
        return Estimate(answer * difference / forgotten if forgotten else difference, left)

    def _fading(self, step: Step, row: UnitCell, duration: float) -> float:
        """Rate at which errors fade: that at which the cells slow down while loads are held."""
        numbers, known = self._numbers, self._last.values
        before, fading, speed = numbers["speed"], numbers["fading"], 0.0
        present = tensors.to_mandel(structure_tensor(*row[:2])).ravel()
        if known:
            change = ((present - known[0]) ** 2).reshape(*self.quadrature.shape, -1).sum(axis=-1)
            speed = float(np.sqrt(self.quadrature.mean(change))) / duration
        if not self._held(step):
            fading = self.kappa
        elif before > 0 and speed > 0:
            rate = np.log(before / speed) / (0.5 * (duration + numbers["duration"]))
            fading = float(np.sqrt(fading * np.clip(rate, self.kappa / SLOWEST, self.kappa)))
        self._last.push(present)
        numbers["speed"], numbers["fading"] = speed, fading
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
        time = self.state.time
        return _same(self.stepper.load_values(time), step.loads) and all(
            _same(case.load_values(time), case.state.loading.values) for case in self.stepper.cases
        )

    # ------------------------------------------------------------ distances
    def _angle(self, row: UnitCell, better: UnitCell) -> float:
        """Between the directions of the chains, root mean square over the body."""
        apart = angle_between(row, better).reshape(self.quadrature.shape)
        return float(np.sqrt(self.quadrature.mean(apart**2)))

    def _strain(self, step: Step, cells: UnitCell) -> tuple[float, bool]:
        """Give the body other cells, and let it answer: the largest change of a length, and whether that is a state.

        In all load cases.
        """
        shape, cases = self.quadrature.shape, self.stepper.cases
        before = [case.state.elastic_gradient() for case in (self.stepper, *cases)]
        self.state.cells.set(cells.dimensions.reshape(*shape, 3), cells.axes.reshape(*shape, 3, 3))
        tangents = [case.coupling.tangents for case in (self.stepper, *cases)] if cases else [step.work.tangents]
        found = [self._answered(*parts) for parts in zip((self.stepper, *cases), before, tangents, strict=True)]
        return max(strain for strain, _ in found), all(admissible for _, admissible in found)

    def _answered(self, case: Any, before: Array, tangents: int) -> tuple[float, bool]:
        """Of one load case, a stepper or what is one to those who look on; `before`: its F_e."""
        state, equilibrium = case.state, case.coupling.equilibrium
        state.unknown.x.array[:] += case.coupling.newton.answer(equilibrium, tangents)
        after, admissible = state.elastic_gradient(), equilibrium.extension().admissible
        changes = np.minimum(largest_change_of_length(before, after), LARGEST_LINEAR_CHANGE)
        changes = changes.reshape(self.quadrature.shape)
        return float(np.degrees(self.quadrature.maximum(changes))), admissible


def _same(before: Mapping[str, float], loads: Mapping[str, float]) -> bool:
    return all(loads.get(name) == value for name, value in before.items())
