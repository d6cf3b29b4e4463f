"""Steps of chosen lengths: the error of a row, estimated from the step itself, and what follows of it."""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.evolution.life_cycle import Remodels, Values
from remodel_fenicsx.evolution.stepper import LoadCaseSolver, Step, Stepper, Watcher
from remodel_fenicsx.model.tensors import largest_change_of_length
from remodel_fenicsx.solver.attempts import SHORTER_STEP, attempted, say
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.state import Earlier, Numbers

log = logging.getLogger(__name__)
Array = NDArray[np.float64]


# ---------------------------------------------------------------- how far a row is from what smaller steps would give
# An estimate from the step itself.

SLOWEST = 20.0  # times as slowly as the cells alone body and cells may forget
LARGEST_LINEAR_CHANGE = 1.0  # change of a length: a linear answer says no more


@dataclass(frozen=True)
class Estimate:
    """Of one step, in degrees."""

    controlled: float
    row: float


AllValues = Sequence[Values]  # of all that remodels, in its order


class TimeError:
    """Compares each row with a better one that the coupling has (docs/theory.md, Error-controlled steps)."""

    def __init__(self, stepper: Stepper):
        self.stepper, self.state = stepper, stepper.state
        self.quadrature, self.kappa = stepper.state.cells.quadrature, stepper.remodeling.slowest
        self.remodels = [part for part in stepper.remodels if part.components]
        # the error of rows so far, by name; "row": that of the cells
        self._errors = ["row" if part is stepper.remodeling else part.name for part in self.remodels]
        initial = {"speed": 0.0, "duration": 0.0, "fading": self.kappa, "answer": 1.0}
        self._numbers = Numbers(stepper.state, "time_error", initial | dict.fromkeys(self._errors, 0.0))
        # with rows that lag the last error, with others the last row
        self._last = [
            Earlier(
                stepper.state,
                f"time_error_{part.name}",
                partial(self.quadrature.function, "", (part.components,)),
                1,
            )
            for part in self.remodels
        ]

    def measure(self, step: Step) -> Estimate:
        """Estimate the error of a step whose pass is done, within its transaction."""
        duration = step.time - self.state.time
        rows = [part.row() for part in self.remodels]
        betters = [self._better(part) for part in self.remodels]
        if self.stepper.coupling.traits.accumulates:
            found = self._added_up(step, rows, betters, duration)
        elif all(better is None for better in betters):
            found = Estimate(0.0, 0.0)
        else:
            lag = self._lag(step, rows, _known(betters, rows), duration)
            found = Estimate(lag, lag)
        self._numbers["duration"] = duration
        step.time_error = found.row
        return found

    def _better(self, part: Remodels) -> Values:
        return self.stepper.coupling.better if part is self.stepper.remodeling else part.better()

    # ------------------------------------------------------------ rows that lag behind
    def _lag(self, step: Step, rows: AllValues, betters: AllValues, duration: float) -> float:
        """Measure the distance to what a pass makes with the stress of a body that has remodeled so."""
        known, angle = betters, self._apart(rows, betters)
        with self.state.tentative():
            strain, admissible = self._strain(step, self._expected(rows, betters, duration))
            if admissible:
                pairs = zip(self.remodels, rows, strict=True)
                betters = [part.passed(row, step.time, step.work.residual) for part, row in pairs]
        most, angle = SLOWEST * angle, self._apart(rows, betters)
        if angle > most:  # another state, to which this one does not tend
            betters, angle = known, most
        for part, last, row, better in zip(self.remodels, self._last, rows, betters, strict=True):
            last.push((part.as_components(better) - part.as_components(row)).ravel())
        return max(angle, strain)

    def _expected(self, rows: AllValues, betters: AllValues, duration: float) -> AllValues:
        """Return what the last error lets expect; at first the better ones."""
        if not self._last[0].known:
            return betters
        longer, parts = duration / self._numbers["duration"], zip(self.remodels, self._last, rows, strict=True)
        return [part.moved(row, longer * last.values[0].reshape(-1, part.components)) for part, last, row in parts]

    # ------------------------------------------------------------ errors that add up
    def _added_up(self, step: Step, rows: AllValues, betters: AllValues, duration: float) -> Estimate:
        fading, numbers, strain = self._fading(step, rows, duration), self._numbers, 0.0
        answer, ends, left = self._answer(fading, duration), [], []
        if any(better is not None for better in betters):
            betters = _known(betters, rows)
            with self.state.tentative():
                strain, _ = self._strain(step, betters)
        for part, name, row, better in zip(self.remodels, self._errors, rows, _known(betters, rows), strict=True):
            error = max(part.apart(row, better), strain if part is self.stepper.remodeling else 0.0)
            # bounded rates change no longer than the cells do
            ends.append(_end_of(error, max(self.kappa, part.slowest) * duration))
            rate = min(fading, part.slowest) if fading else part.slowest
            numbers[name] = float(np.exp(-rate * duration)) * numbers[name] + error
            left.append(numbers[name])
        return Estimate(answer * max(ends), max(left))

    def _fading(self, step: Step, rows: AllValues, duration: float) -> float:
        """Return the rate at which errors fade: that at which all slows down while loads are held."""
        numbers, speed, shape = self._numbers, 0.0, self.quadrature.shape
        before, fading = numbers["speed"], numbers["fading"]
        present = [part.as_components(row).ravel() for part, row in zip(self.remodels, rows, strict=True)]
        if self._last[0].known:
            changes = [one - last.values[0] for one, last in zip(present, self._last, strict=True)]
            points = max(shape[0] * shape[1], 1)  # a rank may have none
            squares = [(change**2).reshape(*shape, change.size // points).sum(axis=-1) for change in changes]
            speed = float(np.sqrt(self.quadrature.mean(sum(squares)))) / duration
        if not self._held(step):
            fading = self.kappa
        elif before > 0 and speed > 0:
            rate = np.log(before / speed) / (0.5 * (duration + numbers["duration"]))
            fading = float(np.sqrt(fading * np.clip(rate, self.kappa / SLOWEST, self.kappa)))
        for last, one in zip(self._last, present, strict=True):
            last.push(one)
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
        first, *others = self.stepper.each_case
        time, loads = self.state.time, [step.loads, *(case.state.loading.values for case in others)]
        return all(
            values.get(name) == value
            for case, values in zip((first, *others), loads, strict=True)
            for name, value in case.load_values(time).items()
        )

    # ------------------------------------------------------------ distances
    def _apart(self, rows: AllValues, betters: AllValues) -> float:
        """Return the largest distance of what remodels, degrees."""
        return max(part.apart(*pair) for part, *pair in zip(self.remodels, rows, betters, strict=True))

    def _strain(self, step: Step, remodeled: AllValues) -> tuple[float, bool]:
        """Let the body answer what has remodeled: the largest change of a length, and whether that is a state."""
        cases = self.stepper.each_case
        before = [case.state.elastic_gradient() for case in cases]
        for part, values in zip(self.remodels, remodeled, strict=True):
            part.set(values)
        tangents = [case.coupling.tangents for case in cases] if cases[1:] else [step.work.tangents]
        found = [self._answered(*parts) for parts in zip(cases, before, tangents, strict=True)]
        return max(strain for strain, _ in found), all(admissible for _, admissible in found)

    def _answered(self, case: LoadCaseSolver, before: Array, tangents: int) -> tuple[float, bool]:
        """Of one load case; `before`: its F_e."""
        state, equilibrium = case.state, case.coupling.equilibrium
        state.unknown.x.array[:] += case.coupling.newton.answer(equilibrium, tangents)
        after, admissible = state.elastic_gradient(), equilibrium.extension().admissible
        changes = np.minimum(largest_change_of_length(before, after), LARGEST_LINEAR_CHANGE)
        changes = changes.reshape(self.quadrature.shape)
        return float(np.degrees(self.quadrature.maximum(changes))), admissible


def _known(betters: AllValues, rows: AllValues) -> AllValues:
    """Better values where there are any, those of the row elsewhere."""
    return [row if better is None else better for better, row in zip(betters, rows, strict=True)]


def _end_of(difference: float, forgotten: float) -> float:
    """Where an error ends that each step adds to, if all steps are alike and exp(-forgotten) is left after each."""
    share = float(-np.expm1(-forgotten))
    return difference / share if share else difference


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
        self,
        stepper: Stepper,
        tolerance: float,
        first: float,
        stops: Sequence[float],
        longest: float = math.inf,
        level: int = logging.WARNING,
    ):
        self.stepper, self.state, self.first, self.stops = stepper, stepper.state, first, list(stops)
        self.error = TimeError(stepper)
        self.level = level  # of what is said of steps above the tolerance
        # "before": error of the last step; "usual": length of steps within the tolerance
        initial = {"wanted": first, "before": 1.0, "usual": first, "in_vain": 0.0, "said": 0.0}
        self._numbers = Numbers(stepper.state, "step_control", initial)
        self._rejected: list[StepTooLongError] = []  # attempts at the step under way
        self.limit(tolerance, longest)

    def limit(self, tolerance: float, longest: float) -> None:
        """From now on take this tolerance in degrees, and no longer steps than this one times kappa."""
        self.tolerance, self.longest = tolerance, min(longest, self.stepper.coupling.traits.longest)

    def with_stops(self, stops: Sequence[float]) -> StepControl:
        """Return one that goes on to other times."""
        other = copy.copy(self)
        other.stops = list(stops)
        return other

    def march(self, watchers: Sequence[Watcher] = ()) -> Iterator[Step]:
        """From where the state is to the last stop; what is yielded is committed."""
        self.stepper.start(watchers)
        while stops := self.remaining():
            yield self._accepted(stops[0], watchers)

    def remaining(self) -> list[float]:
        """Return the stops that are left."""
        time = self.state.time
        return [stop for stop in self.stops if stop > time and not math.isclose(stop, time)]

    def _accepted(self, stop: float, watchers: Sequence[Watcher]) -> Step:
        """The next step, shortened until it is accepted."""
        self._rejected, duration, failures = [], self._numbers["wanted"], 0
        while True:
            time = self._end_of_step(duration, stop)
            before = self._rejected[-1].step if self._rejected else None
            advance = partial(self.stepper.advance, time, watchers, time == self.stops[-1], before, judge=self._judge)
            found = attempted(advance, StepFailure, StepTooLongError)
            if isinstance(found, Step):
                return found
            if isinstance(found, StepTooLongError):
                log.debug("time %g: %s, taken back", time, found)
                self._rejected.append(found)
                most = 1.0 if len(self._rejected) == 1 else HALVED
                duration = max(self._best(found.error, found.duration, most), self._shortest())
                continue
            failures += 1
            duration = (time - self.state.time) / 4
            if failures > FAILED_STEPS or duration < SMALLEST * self.first:
                raise found
            say(SHORTER_STEP, found)

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
        remodeling, fastest, after = self.stepper.remodeling, self.stepper.fastest, self.remaining()[0]
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
