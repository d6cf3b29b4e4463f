"""Steps as long as a tolerance allows: chosen by the error of those before, taken back where they were too long."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence

from remodel_fenicsx.evolution.memory import Numbers
from remodel_fenicsx.evolution.parts import StepFailure
from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.evolution.time_error import FibreAngle, TimeError
from remodel_fenicsx.schema.times import same_time

log = logging.getLogger(__name__)

AIM = 0.85  # share of the tolerance that another length aims at
MOST = 0.97  # where steps as they are would come above it, the next one is shorter
WORTHWHILE = 1.5  # ratio from which on steps are lengthened
GROWTH, SHRINKAGE = 2.0, 0.1  # limits of the ratio of two steps
LATEST = 0.5  # share of the last step in an error that lags behind; the rest is of those before
STRETCHED = 1.05  # so much longer steps are allowed to be where they are one fewer to a stop
SHORTER, MUCH_SHORTER = 0.8, 0.5  # a step that was too long is at most this long at the next attempt, and at others
SMALLEST = 2.0**-12  # of the first step
FALLS = 0.8  # an error within this share of that of a step over three times as long does not come from the step
LONGER = 3.0
SHORT = 0.3  # of what the law forgets over a step: longer ones may have an error that has saturated
ABOVE_FLOOR = 1.2  # error over such a floor that is accepted
FLOOR_FADES = 0.8  # from step to step, so that it is asked again
FAILURES = 3  # steps in a row that could not be solved, each a quarter of the one before
LEAST = 1e-4  # of the tolerance: smaller errors say nothing about the next step


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
    step (random cells turn over in the first pass, however short it is) steps go on as they are, with their error in
    the row, and a warning says so.

    Parameters
    ----------
    stepper
        What is advanced.
    fibre_angle
        As of `TimeError`.
    tolerance
        In degrees, above 0.
    first
        The first step.
    stops
        Times that are hit, increasing; the last one is the end.
    """

    def __init__(
        self, stepper: Stepper, fibre_angle: FibreAngle, tolerance: float, first: float, stops: Sequence[float]
    ):
        self.stepper, self.state, self.tolerance = stepper, stepper.state, tolerance
        self.first, self.stops = first, list(stops)
        self.error = TimeError(stepper, fibre_angle)
        initial = {"wanted": first, "effective": 0.0, "before": 1.0, "floor": 0.0, "said": 0.0}
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
                before = [rejected.step for rejected in self._rejected]
                return self.stepper.advance(time, watchers, time == self.stops[-1], before)
            except StepTooLongError as rejected:
                log.debug("time %g: %s, taken back", time, rejected)
                self._rejected.append(rejected)
                ratio = AIM * (self._level() / rejected.error) ** (1 / self.stepper.coupling.order)
                most = MUCH_SHORTER if before else SHORTER
                duration = rejected.duration * min(most, max(SHRINKAGE, ratio))
            except StepFailure as failure:
                failures += 1
                duration = (time - self.state.time) / 4
                if failures > FAILURES or duration < SMALLEST * self.first:
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
        found = self.error.measure(step)
        error, duration = found.controlled / self.tolerance, step.time - self.state.time
        longer = self._longer_with_the_same(error, duration) if found.forgotten < SHORT else 0.0
        if error > self._level() and not longer and duration > SMALLEST * self.first:
            raise StepTooLongError(step, duration, error)
        numbers, wanted = self._numbers, self._numbers["wanted"]
        self._remember_refused(duration)
        numbers["floor"] = error if longer else min(error, FLOOR_FADES * numbers["floor"])
        if error > 1 and not numbers["said"]:
            self._say(step, error)
            numbers["said"] = 1.0
        wanted = longer or self._next(error, duration)  # no worse than this one
        kappa = self.stepper.remodeling.settings.kappa
        wanted = min(wanted, self.stepper.coupling.longest / kappa if kappa else wanted)
        numbers["wanted"], numbers["before"] = max(wanted, SMALLEST * self.first), max(error, LEAST)
        numbers["effective"] = self._effective(duration)

    def _level(self) -> float:
        """Errors that are accepted, over the tolerance."""
        return max(1.0, ABOVE_FLOOR * self._numbers["floor"])

    def _longer_with_the_same(self, error: float, duration: float) -> float:
        """Length of a much longer step that was refused for about the same error, now or before a few accepted ones.

        It is that of something that happens at once, now or soon; shorter steps would only come nearer to it. 0: none.
        """
        refused = [(rejected.duration, rejected.error) for rejected in self._rejected]
        refused.append((self._numbers["refused"], self._numbers["refused_error"]))
        same = [length for length, its in refused if length >= LONGER * duration and _same(error, its)]
        return max(same, default=0.0)

    def _remember_refused(self, duration: float) -> None:
        """For the steps to come; the first step, before which there is no stress, has an error of another kind."""
        numbers = self._numbers
        if self._rejected and self.state.number:
            longest = self._rejected[0]
            if longest.duration > numbers["refused"] or not _same(longest.error, numbers["refused_error"]):
                numbers["refused"], numbers["refused_error"] = longest.duration, longest.error
        elif duration >= numbers["refused"]:
            numbers["refused"] = numbers["refused_error"] = 0.0

    def _effective(self, duration: float) -> float:
        """Length of steps that would, one after another, have this step's error."""
        before = self._numbers["effective"]
        if self.stepper.coupling.accumulates or not before:
            return duration
        return LATEST * duration + (1 - LATEST) * before

    def _next(self, error: float, duration: float) -> float:
        """Length of the next steps: as they are, or another one where it is worth it."""
        numbers, level, order = self._numbers, self._level(), self.stepper.coupling.order
        wanted = duration if self._rejected else numbers["wanted"]
        settled = max(error, LEAST) * (wanted / self._effective(duration)) ** order / level  # of steps as they are
        rising = max(0.0, error - numbers["before"]) / level if numbers["effective"] else 0.0
        ratio = (AIM / settled) ** (1 / order)
        if settled + rising > MOST:
            return wanted * min(1.0, max(SHRINKAGE, ratio))
        return wanted * min(GROWTH, ratio) if ratio >= WORTHWHILE and not self._rejected else wanted

    def _say(self, step: Step, error: float) -> None:
        if self.state.comm.rank == 0:
            log.warning(
                "time %g: the estimated error in time, %.3g degrees, does not fall to time.tolerance = %g with shorter "
                "steps: cells turn over at once there. The column time_error has what was reached",
                step.time,
                error * self.tolerance,
                self.tolerance,
            )


def _same(error: float, other: float) -> bool:
    """Whether two errors are about the same."""
    return FALLS * other < error < other / FALLS
