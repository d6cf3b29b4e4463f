"""Steps of chosen lengths: the error of a row, estimated from the step itself, and what follows of it."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.model import spectral, tensors
from remodel_fenicsx.model.cells import UnitCell, angle_between, structure_tensor
from remodel_fenicsx.model.tensors import largest_change_of_length
from remodel_fenicsx.schema import same_time
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.state import Earlier, Numbers

log = logging.getLogger(__name__)
Array = NDArray[np.float64]


# ---------------------------------------------------------------- how far a row is from what smaller steps would give
# An estimate from the step itself.

SLOWEST = 20.0  # times as slowly as the cells alone body and cells may forget
LARGEST_LINEAR_CHANGE = 1.0  # change of a length: a linear answer says no more
COMPONENTS = (len(tensors.MANDEL),)


@dataclass(frozen=True)
class Estimate:
    """Of one step, in degrees."""

    controlled: float
    row: float


class Remodeled(NamedTuple):
    """What remodels, at all points in one row: cells, and with turnover ln m and ln rho (2, n)."""

    cells: UnitCell
    turnover: Array | None = None


class TimeError:
    """Compares each row with a better one that the coupling has (docs/theory.md, Error-controlled steps)."""

    def __init__(self, stepper: Stepper):
        self.stepper, self.state = stepper, stepper.state
        self.quadrature, self.kappa = stepper.state.cells.quadrature, stepper.remodeling.slowest
        self.turnover = stepper.turnover
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
        if self.stepper.coupling.traits.accumulates:
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
            _same(case.load_values(time), case.state.loading.values) for case in self.stepper.remodeling.cases
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
        """Let the body answer what has remodeled: the largest change of a length, and whether that is a state."""
        # In all load cases.
        shape, cases, cells = self.quadrature.shape, self.stepper.remodeling.cases, remodeled.cells
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


# ---------------------------------------------------------------- steps as long as a tolerance allows
# Chosen by the error of those before, taken back where they were too long.

AIM = 0.85  # share of the tolerance that another length aims at
KEPT, WORTHWHILE = 0.9, 1.5  # best lengths over the present one between which steps stay as they are
LENGTHENING, SHRINKAGE = 2.0, 0.1  # limits of the ratio of two steps
HALVED = 0.5  # what is left, at most, of a step that is taken back once more: its error hardly falls
STRETCHED = 1.05  # so much longer steps are allowed to be where they are one fewer to a stop
SMALLEST = 2.0**-12  # of the first step: shorter ones are not tried where steps cannot be solved
FASTEST = 360.0  # degrees by which chains turn, at most, while cells remodel or loads go from one corner to the next
IN_VAIN = 20  # steps above the tolerance in such a time that shorter ones would not help, until longer ones go on
NEAR_TOLERANCE = 4.0  # tolerances: below such an error shorter steps are tried again
FAILED_STEPS = 3  # steps in a row that could not be solved, each a quarter of the one before
TELLING_ERROR = 1e-4  # of the tolerance: smaller errors say nothing about the next step


class StepTooLongError(Exception):
    """The step was too long: it has been taken back."""

    def __init__(self, step: Step, duration: float, error: float):
        super().__init__(f"error of {error:g} times the tolerance")
        self.step, self.duration, self.error = step, duration, error


class StepControl:
    """Marches a stepper to the last of some times, which are hit exactly, in steps of an error below a tolerance."""

    def __init__(
        self, stepper: Stepper, tolerance: float, first: float, stops: Sequence[float], longest: float = math.inf
    ):
        self.stepper, self.state, self.tolerance = stepper, stepper.state, tolerance
        self.first, self.stops = first, list(stops)
        self.longest = min(longest, stepper.coupling.traits.longest)  # times kappa
        self.error = TimeError(stepper)
        self.level = logging.WARNING  # of what is said of steps above the tolerance
        # "before": error of the last step; "usual": length of steps within the tolerance
        initial = {"wanted": first, "before": 1.0, "usual": first, "in_vain": 0.0, "said": 0.0}
        self._numbers = Numbers(stepper.state, "step_control", initial)
        self._rejected: list[StepTooLongError] = []  # attempts at the step under way
        stepper.judge = self._judge

    def march(self, watchers: Sequence[Watcher] = ()) -> Iterator[Step]:
        """From where the state is to the last stop; what is yielded is committed."""
        self.stepper.start(watchers)
        while (stop := self._next_stop()) is not None:
            yield self._accepted(stop, watchers)

    def _next_stop(self) -> float | None:
        time = self.state.time
        return next((stop for stop in self.stops if stop > time and not same_time(stop, time)), None)

    def _accepted(self, stop: float, watchers: Sequence[Watcher]) -> Step:
        """The next step, shortened until it is accepted."""
        self._rejected, duration, failures = [], self._numbers["wanted"], 0
        while True:
            time = self._end_of_step(duration, stop)
            try:
                before = self._rejected[-1].step if self._rejected else None
                return self.stepper.advance(time, watchers, time == self.stops[-1], before)
            except StepTooLongError as rejected:
                log.debug("time %g: %s, taken back", time, rejected)
                self._rejected.append(rejected)
                most = 1.0 if len(self._rejected) == 1 else HALVED
                duration = max(self._best(rejected.error, rejected.duration, most), self._shortest())
            except StepFailure as failure:
                failures += 1
                duration = (time - self.state.time) / 4
                if failures > FAILED_STEPS or duration < SMALLEST * self.first:
                    raise
                log.info("%s; a shorter step is tried", failure)

    def _end_of_step(self, duration: float, stop: float) -> float:
        """Steps to a stop are alike: none that is left over is shorter than the others."""
        time = self.state.time
        left = stop - time
        number = math.ceil(left / (STRETCHED * duration))
        return stop if number <= 1 else time + left / number

    # ------------------------------------------------------------ within the step's transaction
    def _judge(self, step: Step) -> None:
        """Accept a step and choose the next one, or raise."""
        error, duration = self.error.measure(step).controlled / self.tolerance, step.time - self.state.time
        numbers, shortest, goes_on = self._numbers, self._shortest(), self._numbers["in_vain"] > IN_VAIN
        if error > 1 and not (goes_on or duration <= (1 + 1e-9) * STRETCHED * shortest):
            raise StepTooLongError(step, duration, error)
        wanted = self._next(error, duration)
        goes_on = self._count(error, duration)
        if step.time_error > self.tolerance and error > 1 and numbers["said"] < 1 + goes_on:
            numbers["said"] = 1.0 + goes_on
            self._say(step, goes_on)
        fastest = self.stepper.fastest
        wanted = max(numbers["usual"] if goes_on else wanted, shortest)
        numbers["wanted"] = min(wanted, self.longest / fastest if fastest else wanted)
        numbers["before"] = max(error, TELLING_ERROR)

    def _best(self, error: float, duration: float, most: float) -> float:
        """Length of a step with the error that is aimed at."""
        ratio = (AIM / max(error, TELLING_ERROR)) ** (1 / self.stepper.coupling.traits.order)
        return duration * min(most, max(SHRINKAGE, ratio))

    def _next(self, error: float, duration: float) -> float:
        """Length of the next steps: as they are, or another one where it is worth it."""
        if self._rejected:
            return self._best(error, duration, 1.0)
        # an error that lags behind rises once more after a longer step, by as much
        present = self._numbers["wanted"]
        best = self._best(error + max(0.0, error - self._numbers["before"]), duration, LENGTHENING * present / duration)
        return present if KEPT * present <= best < WORTHWHILE * present else best

    # ------------------------------------------------------------ steps in vain
    def _count(self, error: float, duration: float) -> bool:
        """Steps above the tolerance that could not be made shorter: whether they are so many that longer ones go on."""
        numbers, faded = self._numbers, math.exp(-duration / self._fastest_time())
        numbers["in_vain"] *= faded
        if error <= 1:
            numbers["usual"] = max(duration, faded * numbers["usual"])
        elif numbers["in_vain"] <= IN_VAIN:
            numbers["in_vain"] += 1
        if error <= NEAR_TOLERANCE:
            numbers["in_vain"] = min(numbers["in_vain"], IN_VAIN)
        return numbers["in_vain"] > IN_VAIN

    def _shortest(self) -> float:
        """Length below which no step is cut for its error."""
        return max(self.tolerance / FASTEST * self._fastest_time(), SMALLEST * self.first)

    def _fastest_time(self) -> float:
        """In which chains may turn by `FASTEST` degrees."""
        remodeling, time, fastest = self.stepper.remodeling, self.state.time, self.stepper.fastest
        after = next(stop for stop in self.stops if stop > time and not same_time(stop, time))
        before = max([0.0, *(stop for stop in self.stops if stop < after)])
        if remodeling.law.remodels and not remodeling.law.asks_kappa:
            return min(after - before, remodeling.settings.rotation_time)
        return min(after - before, 1 / fastest) if fastest else after - before

    def _say(self, step: Step, goes_on: bool) -> None:
        if self.state.comm.rank:
            return
        log.log(
            self.level,
            "time %g: the estimated error in time, %.3g degrees, does not fall to time.tolerance = %g with steps of "
            "%.3g: some cells turn at once, or the pass over-corrects%s. The column time_error has the error that "
            "was reached",
            step.time,
            step.time_error,
            self.tolerance,
            step.time - self.state.time,
            f". The run goes on with steps of {self._numbers['usual']:.3g}" if goes_on else "",
        )
