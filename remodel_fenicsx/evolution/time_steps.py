"""Adaptive time stepping: the estimated error of a row, and step size control."""

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
from remodel_fenicsx.schema import same_time
from remodel_fenicsx.solver.attempts import SHORTER_STEP, attempted, say
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.state import Earlier, Numbers

log = logging.getLogger(__name__)
Array = NDArray[np.float64]


# ---------------------------------------------------------------- error of a row
# The time discretisation error is estimated from the step itself.

# Largest ratio of the decay times of body and cells together, and of the cells alone.
SLOWEST = 20.0
# Relative change of a length up to which a linear response has a meaning.
LARGEST_LINEAR_CHANGE = 1.0


@dataclass(frozen=True)
class Estimate:
    """Estimated time discretisation errors of one step, in degrees."""

    controlled: float
    row: float


AllValues = Sequence[Values]  # values of all remodeling processes, in order


class TimeError:
    """Error estimator, which compares each row with a higher-order one of the coupling."""

    # See docs/theory.md, Error-controlled steps.

    def __init__(self, stepper: Stepper):
        self.stepper, self.state = stepper, stepper.state
        self.quadrature, self.kappa = stepper.state.cells.quadrature, stepper.remodeling.slowest
        self.remodels = [part for part in stepper.remodels if part.components]
        # Names of the errors of rows so far; "row" is that of the cells.
        self._errors = ["row" if part is stepper.remodeling else part.name for part in self.remodels]
        initial = {"speed": 0.0, "duration": 0.0, "fading": self.kappa, "answer": 1.0}
        self._numbers = Numbers(stepper.state, "time_error", initial | dict.fromkeys(self._errors, 0.0))
        # The last error if rows lag behind, otherwise the last row.
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
        """Estimate the error of a step after its pass, within its transaction."""
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
        """Return the error of a lagging row, by a pass after the linear response of the body."""
        known, angle = betters, self._apart(rows, betters)
        with self.state.tentative():
            strain, admissible = self._strain(step, self._expected(rows, betters, duration))
            if admissible:
                pairs = zip(self.remodels, rows, strict=True)
                betters = [part.passed(row, step.time, step.work.residual) for part, row in pairs]
        most, angle = SLOWEST * angle, self._apart(rows, betters)
        if angle > most:  # the pass leads to another state, to which this state does not tend
            betters, angle = known, most
        for part, last, row, better in zip(self.remodels, self._last, rows, betters, strict=True):
            last.push((part.as_components(better) - part.as_components(row)).ravel())
        return max(angle, strain)

    def _expected(self, rows: AllValues, betters: AllValues, duration: float) -> AllValues:
        """Return the values predicted by the last error; at first the higher-order values."""
        if not self._last[0].known:
            return betters
        longer, parts = duration / self._numbers["duration"], zip(self.remodels, self._last, rows, strict=True)
        return [part.moved(row, longer * last.values[0].reshape(-1, part.components)) for part, last, row in parts]

    # ------------------------------------------------------------ accumulating errors
    def _added_up(self, step: Step, rows: AllValues, betters: AllValues, duration: float) -> Estimate:
        fading, numbers, strain = self._fading(step, rows, duration), self._numbers, 0.0
        answer, ends, left = self._answer(fading, duration), [], []
        if any(better is not None for better in betters):
            betters = _known(betters, rows)
            with self.state.tentative():
                strain, _ = self._strain(step, betters)
        for part, name, row, better in zip(self.remodels, self._errors, rows, _known(betters, rows), strict=True):
            error = max(part.apart(row, better), strain if part is self.stepper.remodeling else 0.0)
            # Bounded rates do not change for longer than the cells do.
            ends.append(_end_of(error, max(self.kappa, part.slowest) * duration))
            rate = min(fading, part.slowest) if fading else part.slowest
            numbers[name] = float(np.exp(-rate * duration)) * numbers[name] + error
            left.append(numbers[name])
        return Estimate(answer * max(ends), max(left))

    def _fading(self, step: Step, rows: AllValues, duration: float) -> float:
        """Return the decay rate of errors, from changes that slow down under constant loads."""
        numbers, speed, shape = self._numbers, 0.0, self.quadrature.shape
        before, fading = numbers["speed"], numbers["fading"]
        present = [part.as_components(row).ravel() for part, row in zip(self.remodels, rows, strict=True)]
        if self._last[0].known:
            changes = [one - last.values[0] for one, last in zip(present, self._last, strict=True)]
            points = max(shape[0] * shape[1], 1)  # a rank may have no points
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
        """Return the amplification of an error by the stress since loads are constant."""
        # It tends to kappa over the decay rate.
        left = float(np.exp(-fading * duration))
        limit = self.kappa / fading if fading else 1.0
        answer = max(1.0, left * self._numbers["answer"] + (1.0 - left) * limit)
        self._numbers["answer"] = answer
        return answer

    def _held(self, step: Step) -> bool:
        """Return whether all loads were constant over the step."""
        first, *others = self.stepper.each_case
        time, loads = self.state.time, [step.loads, *(case.state.loading.values for case in others)]
        return all(
            values.get(name) == value
            for case, values in zip((first, *others), loads, strict=True)
            for name, value in case.load_values(time).items()
        )

    # ------------------------------------------------------------ distances
    def _apart(self, rows: AllValues, betters: AllValues) -> float:
        """Return the largest distance over all remodeling processes, in degrees."""
        return max(part.apart(*pair) for part, *pair in zip(self.remodels, rows, betters, strict=True))

    def _strain(self, step: Step, remodeled: AllValues) -> tuple[float, bool]:
        """Return length change, in degrees, and admissibility of the linear response."""
        cases = self.stepper.each_case
        before = [case.state.elastic_gradient() for case in cases]
        for part, values in zip(self.remodels, remodeled, strict=True):
            part.set(values)
        tangents = [case.coupling.tangents for case in cases] if cases[1:] else [step.work.tangents]
        found = [self._answered(*parts) for parts in zip(cases, before, tangents, strict=True)]
        return max(strain for strain, _ in found), all(admissible for _, admissible in found)

    def _answered(self, case: LoadCaseSolver, before: Array, tangents: int) -> tuple[float, bool]:
        """Return length change and admissibility of one load case; `before` is its earlier F_e."""
        state, equilibrium = case.state, case.coupling.equilibrium
        state.unknown.x.array[:] += case.coupling.newton.answer(equilibrium, tangents)
        after, admissible = state.elastic_gradient(), equilibrium.extension().admissible
        changes = np.minimum(largest_change_of_length(before, after), LARGEST_LINEAR_CHANGE)
        changes = changes.reshape(self.quadrature.shape)
        return float(np.degrees(self.quadrature.maximum(changes))), admissible


def _known(betters: AllValues, rows: AllValues) -> AllValues:
    """Return the higher-order values, or the row's values if there are none."""
    return [row if better is None else better for better, row in zip(betters, rows, strict=True)]


def _end_of(difference: float, forgotten: float) -> float:
    """Return the limit of an error that each step increases and damps by exp(-forgotten)."""
    share = float(-np.expm1(-forgotten))
    return difference / share if share else difference


# ---------------------------------------------------------------- step size control
# The step size follows from the errors of earlier steps. A step with too large an error is
# rejected.

AIM = 0.85  # the next step aims at this fraction of the tolerance
KEPT, WORTHWHILE = 0.9, 1.5  # optimal over present step size between which the size stays
LENGTHENING, SHRINKAGE = 2.0, 0.1  # limits of the ratio of two step sizes
HALVED = 0.5  # largest factor after a second rejection, because the error hardly decreases
STRETCHED = 1.05  # factor by which steps may grow if that saves one before a breakpoint
SMALLEST = 2.0**-12  # minimum over the first step: unsolved steps are not reduced further
# Largest rotation of chains in degrees while cells remodel or loads go from one breakpoint to the
# next.
FASTEST = 360.0
# Number of steps of minimum size above the tolerance, in the time of `_fastest_time`, after which
# larger steps follow.
IN_VAIN = 20
NEAR_TOLERANCE = 4.0  # error over the tolerance below which smaller steps are tried again
FAILED_STEPS = 3  # maximum number of failed steps in sequence, each a quarter of the step before
TELLING_ERROR = 1e-4  # smallest error over the tolerance that affects the next step size


class StepTooLongError(Exception):
    """Step rejected because its error exceeds the tolerance."""

    def __init__(self, step: Step, duration: float, error: float):
        super().__init__(f"error of {error:g} times the tolerance")
        self.step, self.duration, self.error = step, duration, error


class StepControl:
    """Adaptive time stepping with an error tolerance, which hits breakpoints exactly."""

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
        self.level = level  # of warnings about steps above the tolerance
        # "before" is the error of the last step, "usual" the step size within the tolerance.
        initial = {"wanted": first, "before": 1.0, "usual": first, "in_vain": 0.0, "said": 0.0}
        self._numbers = Numbers(stepper.state, "step_control", initial)
        self._rejected: list[StepTooLongError] = []  # rejected attempts at the present step
        self.limit(tolerance, longest)

    def limit(self, tolerance: float, longest: float) -> None:
        """Set the tolerance in degrees, and the largest step times kappa."""
        self.tolerance, self.longest = tolerance, min(longest, self.stepper.coupling.traits.longest)

    def with_stops(self, stops: Sequence[float]) -> StepControl:
        """Return a copy with other breakpoints."""
        other = copy.copy(self)
        other.stops = list(stops)
        return other

    def march(self, watchers: Sequence[Watcher] = ()) -> Iterator[Step]:
        """Yield the committed steps from the present state to the last breakpoint."""
        self.stepper.start(watchers)
        while stops := self.remaining():
            yield self._accepted(stops[0], watchers)

    def remaining(self) -> list[float]:
        """Return the breakpoints after the present time."""
        time = self.state.time
        return [stop for stop in self.stops if stop > time and not same_time(stop, time)]

    def _accepted(self, stop: float, watchers: Sequence[Watcher]) -> Step:
        """Advance by one step, whose size is reduced until the step is accepted."""
        self._rejected, duration, failures = [], self._numbers["wanted"], 0
        while True:
            time = self._end_of_step(duration, stop)
            before = self._rejected[-1].step if self._rejected else None
            advance = partial(self.stepper.advance, time, watchers, time == self.stops[-1], before, judge=self._judge)
            found = attempted(advance, StepFailure, StepTooLongError)
            if isinstance(found, Step):
                return found
            if isinstance(found, StepTooLongError):
                log.debug("time %g: %s; step rejected", time, found)
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
        """Return the end of the next step, so that steps to a breakpoint have one size."""
        time = self.state.time
        left = stop - time
        number = math.ceil(left / (STRETCHED * duration))
        return stop if number <= 1 else time + left / number

    # ------------------------------------------------------------ within the step's transaction
    def _judge(self, step: Step) -> None:
        """Accept a step and choose the next step size, or raise."""
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
        """Return the step size with the intended error."""
        ratio = (AIM / max(error, TELLING_ERROR)) ** (1 / self.stepper.coupling.traits.order)
        return duration * min(most, max(SHRINKAGE, ratio))

    def _next(self, error: float, duration: float) -> float:
        """Return the next step size, the present one within the deadband."""
        if self._rejected:
            return self._best(error, duration, 1.0)
        # A lagging error rises a second time after a larger step, by the same amount.
        present = self._numbers["wanted"]
        best = self._best(error + max(0.0, error - self._numbers["before"]), duration, LENGTHENING * present / duration)
        return present if KEPT * present <= best < WORTHWHILE * present else best

    # ------------------------------------------------------------ steps of minimum size
    def _count(self, error: float, duration: float) -> bool:
        """Count steps of minimum size above the tolerance; return whether larger steps follow."""
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
        """Return the minimum step size of error control."""
        return max(self.tolerance / FASTEST * self._fastest_time(), SMALLEST * self.first)

    def _fastest_time(self) -> float:
        """Return the time in which chains may rotate by `FASTEST` degrees."""
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
            "time %g: estimated time error %.3g degrees exceeds time.tolerance = %g at step size "
            "%.3g: cells rotate abruptly, or the pass overshoots%s. See column time_error",
            step.time,
            step.time_error,
            self.tolerance,
            step.time - self.state.time,
            f"; continuing with step size {self._numbers['usual']:.3g}" if goes_on else "",
        )
