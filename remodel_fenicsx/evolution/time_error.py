"""How far a row is from what smaller steps would give: an estimate from the step itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

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
    this size turns lines of the body by up to this angle. With turnover the errors of content and natural length count
    like those of lengths.

    Attributes
    ----------
    controlled
        What a tolerance holds down: the error that the row would end with if all steps were like this one.
    row
        The row's own: where the errors of steps add up, with what is left of those before.
    """

    controlled: float
    row: float


class Remodeled(NamedTuple):
    """What remodels, at all points in one row: cells, and with turnover ln m and ln rho (2, n)."""

    cells: UnitCell
    turnover: Array | None = None


class TimeError:
    """Compares each row with a better one, which the coupling has from the same step (docs/theory.md).

    Rows of some couplings lag nothing, but their cells follow a target that changes within the step: better is one that
    goes from that of its start to that of its end. Each step then adds an error, and kappa forgets it: it ends at the
    error of a step over 1 - exp(-kappa dt), if all steps are alike. Cells forget with kappa, but the stress follows the
    cells, so that body and cells together forget more slowly: with the rate at which they slow down under loads that
    are held, which is measured. With time an error grows by kappa over it. Those of turnover are forgotten with 1/T.

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
        self.turnover = stepper.turnover
        stepper.coupling.compares = True
        initial = {"row": 0.0, "speed": 0.0, "duration": 0.0, "fading": self.kappa, "answer": 1.0, "turnover": 0.0}
        self._numbers = Numbers(stepper.state, "time_error", initial)
        # of structure tensors: with rows that lag the last error, with others the last row
        self._last = Earlier(stepper.state, "time_error_cells", lambda: self.quadrature.function("", COMPONENTS), 1)
        if self.turnover is not None:  # the same of ln m and ln rho
            made = stepper.state, "time_error_turnover", lambda: self.quadrature.function("", (2,)), 1
            self._last_turnover = Earlier(*made)

    def measure(self, step: Step) -> Estimate:
        """The estimate of a step whose pass is done, within its transaction."""
        duration = step.time - self.state.time
        row, better = self._row_and_better()
        if self.stepper.coupling.accumulates:
            found = self._added_up(step, row, better, duration)
        elif better is None:
            found = Estimate(0.0, 0.0)
        else:
            lag = self._lag(step, row, better, duration)
            found = Estimate(lag, lag)
        self._numbers["duration"] = duration
        step.time_error = found.row
        return found

    def _row_and_better(self) -> tuple[Remodeled, Remodeled | None]:
        """Of the solved state, and what the coupling has that is better; None where nothing is."""
        cells, better = UnitCell(*self.state.equilibrium_cells.point_cells[:2]), self.stepper.coupling.better
        if self.turnover is None:
            return Remodeled(cells), None if better is None else Remodeled(better)
        return Remodeled(cells, self.turnover.row), Remodeled(better or cells, self.turnover.better)

    # ------------------------------------------------------------ rows that lag behind
    def _lag(self, step: Step, row: Remodeled, better: Remodeled, duration: float) -> float:
        """Distance to what a pass makes with the stress of a body that has remodeled so."""
        known, angle = better, self._apart(row, better)
        with self.state.tentative():
            strain, admissible = self._strain(step, self._expected(row, better, duration))
            if admissible:
                better = self._passed(step, row, duration)
        most, angle = SLOWEST * angle, self._apart(row, better)
        if angle > most:  # another state, to which this one does not tend
            better, angle = known, most
        before, after = (structure_tensor(*some.cells[:2]) for some in (row, better))
        self._last.push(tensors.to_mandel(after - before).ravel())
        if row.turnover is not None and better.turnover is not None:
            self._last_turnover.push(np.ravel((better.turnover - row.turnover).T))
        return max(angle, strain)

    def _expected(self, row: Remodeled, better: Remodeled, duration: float) -> Remodeled:
        """By what the last error lets expect; at first the better ones."""
        if not self._last.known:
            return better
        longer = duration / self._numbers["duration"]
        last = tensors.from_mandel(self._last.values[0].reshape(-1, *COMPONENTS))
        squared, axes = spectral.continued(structure_tensor(*row.cells[:2]) + longer * last, row.cells.axes)
        cells = UnitCell(np.sqrt(np.maximum(squared, 0.0)), axes)
        if row.turnover is None:
            return Remodeled(cells)
        return Remodeled(cells, row.turnover + longer * self._last_turnover.values[0].reshape(-1, 2).T)

    def _passed(self, step: Step, row: Remodeled, duration: float) -> Remodeled:
        """What the present state makes of the row's cells and collagen."""
        remodeling, turnover, cells = self.stepper.remodeling, row.turnover, row.cells
        if remodeling.law.remodels:
            cells, _ = remodeling.updated_cells(self.state.time, step.time, step.work.residual, cells)
        if turnover is not None:
            turnover = self.turnover.after(turnover, duration, present=True)
        return Remodeled(cells, turnover)

    # ------------------------------------------------------------ errors that add up
    def _added_up(self, step: Step, row: Remodeled, better: Remodeled | None, duration: float) -> Estimate:
        fading = self._fading(step, row, duration)
        answer, numbers, difference, turned_over = self._answer(fading, duration), self._numbers, 0.0, 0.0
        if better is not None:
            with self.state.tentative():
                strain, _ = self._strain(step, better)
            difference = max(self._angle(row.cells, better.cells), strain)
            turned_over = self._largest(row, better)
        ends = [_end_of(difference, self.kappa * duration)]
        left = float(np.exp(-fading * duration)) * numbers["row"] + difference
        numbers["row"] = left
        if self.turnover is not None:
            # the rates of turnover, which are bounded, change no longer than the cells do
            ends.append(_end_of(turned_over, max(self.kappa, self.turnover.slowest) * duration))
            fading = min(fading, self.turnover.slowest) if fading else self.turnover.slowest
            numbers["turnover"] = float(np.exp(-fading * duration)) * numbers["turnover"] + turned_over
            left = max(left, numbers["turnover"])
        return Estimate(answer * max(ends), left)

    def _fading(self, step: Step, row: Remodeled, duration: float) -> float:
        """Rate at which errors fade: that at which cells and turnover slow down while loads are held."""
        numbers, known = self._numbers, self._last.known
        before, fading, speed = numbers["speed"], numbers["fading"], 0.0
        kept = [(self._last, tensors.to_mandel(structure_tensor(*row.cells[:2])).ravel())]
        if row.turnover is not None:
            kept.append((self._last_turnover, np.ravel(row.turnover.T)))
        if known:
            changes = [present - last.values[0] for last, present in kept]
            shape = self.quadrature.shape
            points = max(shape[0] * shape[1], 1)  # a rank may have none
            squares = [(change**2).reshape(*shape, change.size // points).sum(axis=-1) for change in changes]
            speed = float(np.sqrt(self.quadrature.mean(sum(squares)))) / duration
        if not self._held(step):
            fading = self.kappa
        elif before > 0 and speed > 0:
            rate = np.log(before / speed) / (0.5 * (duration + numbers["duration"]))
            fading = float(np.sqrt(fading * np.clip(rate, self.kappa / SLOWEST, self.kappa)))
        for last, present in kept:
            last.push(present)
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
    def _apart(self, row: Remodeled, better: Remodeled) -> float:
        """Between the directions of the chains, or the largest relative one of content and natural length, degrees."""
        return max(self._angle(row.cells, better.cells), self._largest(row, better))

    def _largest(self, row: Remodeled, better: Remodeled) -> float:
        """Relative difference of content or natural length in the body, as an angle in radians, in degrees."""
        if row.turnover is None or better.turnover is None:
            return 0.0
        largest = np.abs(better.turnover - row.turnover).max(axis=0).reshape(self.quadrature.shape)
        return float(np.degrees(self.quadrature.maximum(largest)))

    def _angle(self, row: UnitCell, better: UnitCell) -> float:
        """Between the directions of the chains, root mean square over the body."""
        apart = angle_between(row, better).reshape(self.quadrature.shape)
        return float(np.sqrt(self.quadrature.mean(apart**2)))

    def _strain(self, step: Step, remodeled: Remodeled) -> tuple[float, bool]:
        """Let the body answer what has remodeled: the largest change of a length, and whether that is a state.

        In all load cases.
        """
        shape, cases, cells = self.quadrature.shape, self.stepper.cases, remodeled.cells
        before = [case.state.elastic_gradient() for case in (self.stepper, *cases)]
        self.state.cells.set(cells.dimensions.reshape(*shape, 3), cells.axes.reshape(*shape, 3, 3))
        if remodeled.turnover is not None:
            self.turnover.set(remodeled.turnover)
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


def _end_of(difference: float, forgotten: float) -> float:
    """Where an error ends that each step adds to, if all steps are alike and exp(-forgotten) is left after each."""
    share = float(-np.expm1(-forgotten))
    return difference / share if share else difference


def _same(before: Mapping[str, float], loads: Mapping[str, float]) -> bool:
    return all(loads.get(name) == value for name, value in before.items())
