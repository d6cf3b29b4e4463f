"""Steps as long as a tolerance allows: chosen by the error of those before, taken back where they were too long."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence

from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.evolution.time_error import TimeError
from remodel_fenicsx.schema.times import same_time
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.state.memory import Numbers

log = logging.getLogger(__name__)

AIM = 0.85  # share of the tolerance that another length aims at
NEARLY_THE_TOLERANCE = 0.97  # where steps as they are would come above it, the next one is shorter
WORTHWHILE = 1.5  # ratio from which on steps are lengthened
GROWTH, SHRINKAGE = 2.0, 0.1  # limits of the ratio of two steps
LATEST = 0.5  # share of the last step in an error that lags behind; the rest is of those before
STRETCHED = 1.05  # so much longer steps are allowed to be where they are one fewer to a stop
SHORTER, MUCH_SHORTER = 0.8, 0.5  # a step that was too long is at most this long at the next attempt, and at others
SMALLEST = 2.0**-12  # of the first step: shorter ones are not tried where steps cannot be solved
FASTEST = 360.0  # degrees by which chains turn, at most, while cells remodel or loads go from one corner to the next
FALLS, LONGER = 0.8, 2.0  # an error within this share of that of so much a longer step does not come from the step
SHORT = 0.3  # of such a time: longer steps may have an error that has saturated
IN_VAIN = 20  # steps above the tolerance in such a time that shorter ones would not help, until longer ones go on
AGAIN = 0.5  # share of these that is left when shorter steps are tried again
NEAR = 4.0  # tolerances: below such an error they are tried at once
FAILED_STEPS = 3  # steps in a row that could not be solved, each a quarter of the one before
TELLING_ERROR = 1e-4  # of the tolerance: smaller errors say nothing about the next step


class StepTooLongError(Exception):
    """The step was too long: it has been taken back."""

    def __init__(self, step: Step, duration: float, error: float):
        super().__init__(f"error of {error:g} times the tolerance")
        self.step, self.duration, self.error = step, duration, error


class StepControl:
    """Marches a stepper to the last of some times, which are hit exactly, in steps of an error below a tolerance.

    Steps are kept as they are: to the next stop in equal parts, and until another length is worth it, one and a half
    times as long, or until the error would pass the tolerance, to which its own trend is added (a predictive
    controller: Gustafsson, ACM Trans. Math. Softw. 20 (1994)). The cost of a given mean error hardly depends on how
    errors are distributed in time, but Newton's method starts better where steps are alike, and steps that are
    neither refused nor cut waste nothing (Hairer and Wanner, Solving ODEs II, IV.8, keep them for their factors). The
    other length is h (AIM/e)^(1/p), e the estimate of `TimeError` over the tolerance, p the order of the coupling, and
    h the step that belongs to e: with a pass that lags behind, of the last step and of those before it.

    What it remembers is part of the state: runs that go on take the same steps. Where the error does not fall with the
    step (random cells turn over in the first pass, however short it is; a pass that over-corrects swings) no step is
    shorter than what chains need that turn by `FASTEST` degrees in the shortest time of the scene: 1/kappa, the law's
    rotation time, the time to the next stop. Such steps are accepted with their error, and a warning says so. After
    `IN_VAIN` of them in such a time steps go on that are as long as those before, whatever their error, until it is
    below the tolerance again or some time has passed.

    Parameters
    ----------
    stepper
        What is advanced.
    tolerance
        In degrees, above 0; of `time_error.Estimate`.
    first
        The first step.
    stops
        Times that are hit, increasing; the last one is the end.
    """

    def __init__(self, stepper: Stepper, tolerance: float, first: float, stops: Sequence[float]):
        self.stepper, self.state, self.tolerance = stepper, stepper.state, tolerance
        self.first, self.stops = first, list(stops)
        self.error = TimeError(stepper)
        self.level = logging.WARNING  # of what is said of steps above the tolerance
        initial = {"wanted": first, "effective": 0.0, "before": 1.0, "said": 0.0}
        initial |= {"usual": first, "in_vain": 0.0, "goes_on": 0.0}
        initial |= {"refused": 0.0, "refused_error": 0.0}  # a longer step, since which all have been shorter
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
                ratio = AIM * rejected.error ** (-1 / self.stepper.coupling.order)
                most = MUCH_SHORTER if before else SHORTER
                duration = max(rejected.duration * min(most, max(SHRINKAGE, ratio)), self._shortest())
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
        """Accept a step and choose the next one, or raise.

        Raises
        ------
        StepTooLongError
            If the error is too large and a shorter step makes it smaller.
        """
        error, duration = self.error.measure(step).controlled / self.tolerance, step.time - self.state.time
        numbers, shortest = self._numbers, self._shortest()
        longer = self._longer_with_the_same(error, duration)
        in_vain = duration <= (1 + 1e-9) * STRETCHED * shortest or longer or numbers["goes_on"]
        if error > 1 and not in_vain:
            raise StepTooLongError(step, duration, error)
        wanted = longer or self._next(error, duration)
        self._remember_refused(duration)
        self._count(step, error, duration)
        wanted = max(numbers["usual"] if numbers["goes_on"] else wanted, shortest)
        fastest = self.stepper.fastest
        numbers["wanted"] = min(wanted, self.stepper.coupling.longest / fastest if fastest else wanted)
        numbers["before"], numbers["effective"] = max(error, TELLING_ERROR), self._effective(duration)

    def _longer_with_the_same(self, error: float, duration: float) -> float:
        """Length of a much longer step that was refused for about the same error, now or before a few accepted ones.

        It is that of something that happens at once, now or soon; shorter steps would only come nearer to it. 0: none.
        """
        if error <= 1 or duration > SHORT * self._fastest_time():
            return 0.0
        refused = [(rejected.duration, rejected.error) for rejected in self._rejected]
        refused.append((self._numbers["refused"], self._numbers["refused_error"]))
        same = [length for length, its in refused if length >= LONGER * duration and FALLS < error / its < 1 / FALLS]
        return max(same, default=0.0)

    def _remember_refused(self, duration: float) -> None:
        """For the steps to come; the first step, before which there is no stress, has an error of another kind."""
        numbers = self._numbers
        if self._rejected and self.state.number:
            numbers["refused"], numbers["refused_error"] = self._rejected[0].duration, self._rejected[0].error
        elif duration >= numbers["refused"]:
            numbers["refused"] = numbers["refused_error"] = 0.0

    def _fastest_time(self) -> float:
        """In which chains may turn by `FASTEST` degrees."""
        remodeling, time, fastest = self.stepper.remodeling, self.state.time, self.stepper.fastest
        after = next(stop for stop in self.stops if stop > time and not same_time(stop, time))
        before = max([0.0, *(stop for stop in self.stops if stop < after)])
        if remodeling.law.remodels and not remodeling.law.asks_kappa:
            return min(after - before, remodeling.settings.rotation_time)
        return min(after - before, 1 / fastest) if fastest else after - before

    def _shortest(self) -> float:
        """Length below which no step is cut for its error."""
        return max(self.tolerance / FASTEST * self._fastest_time(), SMALLEST * self.first)

    def _count(self, step: Step, error: float, duration: float) -> None:
        """Steps above the tolerance that could not be made shorter, and how long steps were that could."""
        numbers, faded = self._numbers, math.exp(-duration / self._fastest_time())
        numbers["in_vain"] *= faded
        if error <= 1:
            numbers["usual"] = max(duration, faded * numbers["usual"])
        elif not numbers["goes_on"]:
            numbers["in_vain"] += 1
        if numbers["goes_on"]:
            numbers["goes_on"] = float(error > NEAR and numbers["in_vain"] > AGAIN * IN_VAIN)
        elif numbers["in_vain"] > IN_VAIN:
            numbers["goes_on"] = 1.0
        said = float(error > 1 and step.time_error > self.tolerance) * (1.0 + numbers["goes_on"])
        if said > numbers["said"]:
            self._say(step)
            numbers["said"] = said

    def _effective(self, duration: float) -> float:
        """Length of steps that would, one after another, have this step's error."""
        before = self._numbers["effective"]
        if self.stepper.coupling.accumulates or not before:
            return duration
        return LATEST * duration + (1 - LATEST) * before

    def _next(self, error: float, duration: float) -> float:
        """Length of the next steps: as they are, or another one where it is worth it."""
        numbers, order = self._numbers, self.stepper.coupling.order
        wanted = duration if self._rejected else numbers["wanted"]
        settled = max(error, TELLING_ERROR) * (wanted / self._effective(duration)) ** order  # of steps as they are
        rising = max(0.0, error - numbers["before"]) if numbers["effective"] else 0.0
        ratio = (AIM / settled) ** (1 / order)
        if settled + rising > NEARLY_THE_TOLERANCE:
            return wanted * min(1.0, max(SHRINKAGE, ratio))
        return wanted * min(GROWTH, ratio) if ratio >= WORTHWHILE and not self._rejected else wanted

    def _say(self, step: Step) -> None:
        if self.state.comm.rank:
            return
        goes_on = f". The run goes on with steps of {self._numbers['usual']:.3g}" if self._numbers["goes_on"] else ""
        log.log(
            self.level,
            "time %g: the estimated error in time, %.3g degrees, does not fall to time.tolerance = %g with steps of "
            "%.3g: some cells turn at once, or the pass over-corrects%s. The column time_error has the error that "
            "was reached",
            step.time,
            step.time_error,
            self.tolerance,
            step.time - self.state.time,
            goes_on,
        )
