"""Adaptive time stepping: the estimated error of a row, and step size control."""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from remodel_fenicsx.evolution.life_cycle import Remodels, Values
from remodel_fenicsx.evolution.stepper import LoadCaseSolver, Step, Stepper, Watcher
from remodel_fenicsx.model.tensors import max_stretch_increment, Array
from remodel_fenicsx.solver.attempts import SHORTER_STEP, say
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.solver.newton import attempted
from remodel_fenicsx.state import FieldHistory, StateNumbers

log = logging.getLogger(__name__)


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

    # See docs/time_integration.md, Error-controlled steps.

    def __init__(self, stepper: Stepper):
        self.stepper, self.state = stepper, stepper.state
        self.quadrature, self.kappa = stepper.state.cells.quadrature, stepper.remodeling.slowest
        self.remodels = [process for process in stepper.remodels if process.components]
        # Names of the errors of rows so far; "row" is that of the cells.
        self._errors = [
            "row" if process is stepper.remodeling else process.name for process in self.remodels
        ]
        initial = {"speed": 0.0, "duration": 0.0, "fading": self.kappa, "answer": 1.0}
        self._numbers = StateNumbers(
            stepper.state, "time_error", initial | dict.fromkeys(self._errors, 0.0)
        )
        # The last error if rows lag behind, otherwise the last row.
        self._last = [
            FieldHistory(
                stepper.state,
                f"time_error_{process.name}",
                partial(self.quadrature.function, "", (process.components,)),
                1,
            )
            for process in self.remodels
        ]

    def measure(self, step: Step) -> Estimate:
        """Estimate the error of a step after its pass, within its transaction."""
        duration = step.time - self.state.time
        rows = [process.solved_values() for process in self.remodels]
        betters = [self._better(process) for process in self.remodels]
        traits = self.stepper.coupling.traits
        if traits.accumulates:
            estimate = self._added_up(step, rows, betters, duration)
        elif all(better is None for better in betters):
            estimate = Estimate(0.0, 0.0)
        else:
            lag = self._lag(step, rows, _known(betters, rows), duration)
            estimate = Estimate(lag, lag)
        self._numbers["duration"] = duration
        step.time_error = estimate.row
        return estimate

    def _better(self, process: Remodels) -> Values:
        return (
            self.stepper.coupling.higher_order_cells
            if process is self.stepper.remodeling
            else process.higher_order()
        )

    # ------------------------------------------------------------ rows that lag behind
    def _lag(self, step: Step, rows: AllValues, betters: AllValues, duration: float) -> float:
        """Return the error of a lagging row, by a pass after the linear response of the body."""
        first_betters, angle = betters, self._distance(rows, betters)
        with self.state.tentative():
            strain, admissible = self._strain(step, self._expected(rows, betters, duration))
            if admissible:
                pairs = zip(self.remodels, rows, strict=True)
                betters = [
                    process.after_pass(row, step.time, step.work.residual) for process, row in pairs
                ]
        limit, angle = SLOWEST * angle, self._distance(rows, betters)
        if angle > limit:  # the pass leads to another state, to which this state does not tend
            betters, angle = first_betters, limit
        for process, last, row, better in zip(
            self.remodels, self._last, rows, betters, strict=True
        ):
            last.push((process.as_components(better) - process.as_components(row)).ravel())
        return max(angle, strain)

    def _expected(self, rows: AllValues, betters: AllValues, duration: float) -> AllValues:
        """Return the values predicted by the last error; at first the higher-order values."""
        if not self._last[0].known:
            return betters
        ratio, processes = duration / self._numbers["duration"], zip(
            self.remodels, self._last, rows, strict=True
        )
        return [
            process.with_change(row, ratio * last.values[0].reshape(-1, process.components))
            for process, last, row in processes
        ]

    # ------------------------------------------------------------ accumulating errors
    def _added_up(
        self, step: Step, rows: AllValues, betters: AllValues, duration: float
    ) -> Estimate:
        decay_rate = self._decay_rate(step, rows, duration)
        amplification = self._stress_amplification(decay_rate, duration)
        numbers, strain = self._numbers, 0.0
        limits, errors = [], []
        if any(better is not None for better in betters):
            betters = _known(betters, rows)
            with self.state.tentative():
                strain, _ = self._strain(step, betters)
        for process, name, row, better in zip(
            self.remodels, self._errors, rows, _known(betters, rows), strict=True
        ):
            error = max(
                process.distance_between(row, better),
                strain if process is self.stepper.remodeling else 0.0,
            )
            # Bounded rates do not change for longer than the cells do.
            limits.append(_accumulated_error(error, max(self.kappa, process.slowest) * duration))
            rate = min(decay_rate, process.slowest) if decay_rate else process.slowest
            numbers[name] = float(np.exp(-rate * duration)) * numbers[name] + error
            errors.append(numbers[name])
        return Estimate(amplification * max(limits), max(errors))

    def _decay_rate(self, step: Step, rows: AllValues, duration: float) -> float:
        """Return the decay rate of errors, from changes that slow down under constant loads."""
        numbers, speed = self._numbers, 0.0
        shape = self.quadrature.shape
        before, decay_rate = numbers["speed"], numbers["fading"]
        present = [
            process.as_components(row).ravel()
            for process, row in zip(self.remodels, rows, strict=True)
        ]
        if self._last[0].known:
            changes = [
                values - last.values[0] for values, last in zip(present, self._last, strict=True)
            ]
            points = max(shape[0] * shape[1], 1)  # a rank may have no points
            squares = [
                (change**2).reshape(*shape, change.size // points).sum(axis=-1)
                for change in changes
            ]
            speed = float(np.sqrt(self.quadrature.mean(sum(squares)))) / duration
        if not self._held(step):
            decay_rate = self.kappa
        elif before > 0 and speed > 0:
            rate = np.log(before / speed) / (0.5 * (duration + numbers["duration"]))
            decay_rate = float(
                np.sqrt(decay_rate * np.clip(rate, self.kappa / SLOWEST, self.kappa))
            )
        for last, values in zip(self._last, present, strict=True):
            last.push(values)
        numbers["speed"], numbers["fading"] = speed, decay_rate
        return decay_rate

    def _stress_amplification(self, decay_rate: float, duration: float) -> float:
        """Return the amplification of an error by the stress since loads are constant."""
        # It tends to kappa / decay rate.
        decay = float(np.exp(-decay_rate * duration))
        limit = self.kappa / decay_rate if decay_rate else 1.0
        amplification = max(1.0, decay * self._numbers["answer"] + (1.0 - decay) * limit)
        self._numbers["answer"] = amplification
        return amplification

    def _held(self, step: Step) -> bool:
        """Return whether all loads were constant over the step."""
        first, *further = self.stepper.load_cases
        time, loads = self.state.time, [
            step.loads,
            *(case.state.loading.values for case in further),
        ]
        return all(
            values.get(name) == value
            for case, values in zip((first, *further), loads, strict=True)
            for name, value in case.load_values(time).items()
        )

    # ------------------------------------------------------------ distances
    def _distance(self, rows: AllValues, betters: AllValues) -> float:
        """Return the largest distance over all remodeling processes, in degrees."""
        return max(
            process.distance_between(*pair)
            for process, *pair in zip(self.remodels, rows, betters, strict=True)
        )

    def _strain(self, step: Step, remodeled: AllValues) -> tuple[float, bool]:
        """Return length change, in degrees, and admissibility of the linear response."""
        cases = self.stepper.load_cases
        before = [case.state.elastic_gradient() for case in cases]
        for process, values in zip(self.remodels, remodeled, strict=True):
            process.set(values)
        tangents = [case.coupling.tangents for case in cases] if cases[1:] else [step.work.tangents]
        responses = [
            self._answered(*arguments) for arguments in zip(cases, before, tangents, strict=True)
        ]
        return max(strain for strain, _ in responses), all(
            admissible for _, admissible in responses
        )

    def _answered(self, case: LoadCaseSolver, before: Array, tangents: int) -> tuple[float, bool]:
        """Return length change and admissibility of one load case; `before` is its earlier F_e."""
        state, equilibrium = case.state, case.coupling.equilibrium
        state.unknown.x.array[:] += case.coupling.newton.newton_correction(equilibrium, tangents)
        after, admissible = state.elastic_gradient(), equilibrium.limits().admissible
        changes = np.minimum(max_stretch_increment(before, after), LARGEST_LINEAR_CHANGE)
        changes = changes.reshape(self.quadrature.shape)
        return float(np.degrees(self.quadrature.maximum(changes))), admissible


def _known(betters: AllValues, rows: AllValues) -> AllValues:
    """Return the higher-order values, or the row's values if there are none."""
    return [row if better is None else better for better, row in zip(betters, rows, strict=True)]


def _accumulated_error(difference: float, forgotten: float) -> float:
    """Return the limit of an error that each step increases and damps by exp(-forgotten)."""
    fraction = float(-np.expm1(-forgotten))
    return difference / fraction if fraction else difference


# ---------------------------------------------------------------- step size control
# The step size follows from the errors of earlier steps. A step with too large an error is
# rejected.

SAFETY_FACTOR = 0.85  # the next step aims at this fraction of the tolerance
KEPT, WORTHWHILE = 0.9, 1.5  # optimal / present step size between which the size stays
LENGTHENING, SHRINKAGE = 2.0, 0.1  # limits of the ratio of two step sizes
HALVED = 0.5  # largest factor after a second rejection, because the error hardly decreases
STRETCHED = 1.05  # factor by which steps may grow if that saves one before a breakpoint
SMALLEST = 2.0**-12  # minimum / first step size: unsolved steps are not reduced further
# Largest rotation of chains in degrees while cells remodel or loads go from one breakpoint to the
# next.
FASTEST = 360.0
# Number of steps of minimum size above the tolerance, in the time of `_fastest_time`, after which
# larger steps follow.
MAX_FUTILE_STEPS = 20
NEAR_TOLERANCE = 4.0  # error / tolerance below which smaller steps are tried again
FAILED_STEPS = 3  # maximum number of failed steps in sequence, each a quarter of the step before
MIN_ERROR = 1e-4  # smallest error / tolerance that affects the next step size


class StepRejectedError(Exception):
    """Step rejected because its error exceeds the tolerance."""

    def __init__(self, step: Step, duration: float, error: float):
        super().__init__(f"error of {error:g} times the tolerance")
        self.step, self.duration = step, duration
        self.error = error


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
        self.stepper, self.state = stepper, stepper.state
        self.first, self.stops = first, list(stops)
        self.error = TimeError(stepper)
        self.level = level  # of warnings about steps above the tolerance
        # "before" is the error of the last step, "usual" the step size within the tolerance.
        initial = {"wanted": first, "before": 1.0, "usual": first, "in_vain": 0.0, "said": 0.0}
        self._numbers = StateNumbers(stepper.state, "step_control", initial)
        self._rejected: list[StepRejectedError] = []  # rejected attempts at the present step
        self.limit(tolerance, longest)

    def limit(self, tolerance: float, longest: float) -> None:
        """Set the tolerance in degrees, and the largest step times kappa."""
        traits = self.stepper.coupling.traits
        self.tolerance, self.longest = tolerance, min(longest, traits.max_scaled_step)

    def with_stops(self, stops: Sequence[float]) -> StepControl:
        """Return a copy with other breakpoints."""
        control = copy.copy(self)
        control.stops = list(stops)
        return control

    def march(self, watchers: Sequence[Watcher] = ()) -> Iterator[Step]:
        """Yield the committed steps from the present state to the last breakpoint."""
        self.stepper.start(watchers)
        while stops := self.remaining():
            yield self._accepted(stops[0], watchers)

    def remaining(self) -> list[float]:
        """Return the breakpoints after the present time."""
        time = self.state.time
        return [stop for stop in self.stops if stop > time and not math.isclose(stop, time)]

    def _accepted(self, stop: float, watchers: Sequence[Watcher]) -> Step:
        """Advance by one step, whose size is reduced until the step is accepted."""
        self._rejected, failures = [], 0
        duration = self._numbers["wanted"]
        while True:
            time = self._end_of_step(duration, stop)
            before = self._rejected[-1].step if self._rejected else None
            advance = partial(
                self.stepper.advance,
                time,
                watchers,
                time == self.stops[-1],
                before,
                measure_error=self._accept_or_reject,
            )
            outcome = attempted(advance, StepFailure, StepRejectedError)
            if isinstance(outcome, Step):
                return outcome
            if isinstance(outcome, StepRejectedError):
                log.debug("time %g: %s; step rejected", time, outcome)
                self._rejected.append(outcome)
                max_factor = 1.0 if len(self._rejected) == 1 else HALVED
                duration = max(
                    self._optimal_step(outcome.error, outcome.duration, max_factor),
                    self._shortest(),
                )
                continue
            failures += 1
            duration = (time - self.state.time) / 4
            if failures > FAILED_STEPS or duration < SMALLEST * self.first:
                raise outcome
            say(SHORTER_STEP, outcome)

    def _end_of_step(self, duration: float, stop: float) -> float:
        """Return the end of the next step, so that steps to a breakpoint have one size."""
        time = self.state.time
        interval = stop - time
        number = math.ceil(interval / (STRETCHED * duration))
        return stop if number <= 1 else time + interval / number

    # ------------------------------------------------------------ within the step's transaction
    def _accept_or_reject(self, step: Step) -> None:
        """Accept a step and choose the next step size, or raise."""
        error, duration = (
            self.error.measure(step).controlled / self.tolerance,
            step.time - self.state.time,
        )
        numbers, shortest = self._numbers, self._shortest()
        goes_on = numbers["in_vain"] > MAX_FUTILE_STEPS
        if error > 1 and not (goes_on or duration <= (1 + 1e-9) * STRETCHED * shortest):
            raise StepRejectedError(step, duration, error)
        next_step = self._next(error, duration)
        goes_on = self._count(error, duration)
        if step.time_error > self.tolerance and error > 1 and numbers["said"] < 1 + goes_on:
            numbers["said"] = 1.0 + goes_on
            self._log(step, goes_on)
        fastest = self.stepper.fastest
        next_step = max(numbers["usual"] if goes_on else next_step, shortest)
        numbers["wanted"] = min(next_step, self.longest / fastest if fastest else next_step)
        numbers["before"] = max(error, MIN_ERROR)

    def _optimal_step(self, error: float, duration: float, max_factor: float) -> float:
        """Return the step size with the intended error."""
        traits = self.stepper.coupling.traits
        ratio = (SAFETY_FACTOR / max(error, MIN_ERROR)) ** (1 / traits.order)
        return duration * min(max_factor, max(SHRINKAGE, ratio))

    def _next(self, error: float, duration: float) -> float:
        """Return the next step size, the present one within the deadband."""
        if self._rejected:
            return self._optimal_step(error, duration, 1.0)
        # A lagging error rises a second time after a larger step, by the same amount.
        present = self._numbers["wanted"]
        best = self._optimal_step(
            error + max(0.0, error - self._numbers["before"]),
            duration,
            LENGTHENING * present / duration,
        )
        return present if KEPT * present <= best < WORTHWHILE * present else best

    # ------------------------------------------------------------ steps of minimum size
    def _count(self, error: float, duration: float) -> bool:
        """Count steps of minimum size above the tolerance; return whether larger steps follow."""
        numbers, decay = self._numbers, math.exp(-duration / self._fastest_time())
        numbers["in_vain"] *= decay
        if error <= 1:
            numbers["usual"] = max(duration, decay * numbers["usual"])
        elif numbers["in_vain"] <= MAX_FUTILE_STEPS:
            numbers["in_vain"] += 1
        if error <= NEAR_TOLERANCE:
            numbers["in_vain"] = min(numbers["in_vain"], MAX_FUTILE_STEPS)
        return numbers["in_vain"] > MAX_FUTILE_STEPS

    def _shortest(self) -> float:
        """Return the minimum step size of error control."""
        return max(self.tolerance / FASTEST * self._fastest_time(), SMALLEST * self.first)

    def _fastest_time(self) -> float:
        """Return the time in which chains may rotate by `FASTEST` degrees."""
        remodeling, fastest = self.stepper.remodeling, self.stepper.fastest
        after = self.remaining()[0]
        before = max([0.0, *(stop for stop in self.stops if stop < after)])
        if remodeling.law.remodels and not remodeling.law.stops_at_zero_kappa:
            return min(after - before, remodeling.settings.rotation_time)
        return min(after - before, 1 / fastest) if fastest else after - before

    def _log(self, step: Step, goes_on: bool) -> None:
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
