"""Steps as long as a tolerance allows: chosen by the error of those before, taken back where they were too long."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence

from remodel_fenicsx.evolution.memory import Numbers
from remodel_fenicsx.evolution.parts import StepFailure
from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.evolution.time_error import FibreAngle, TimeError
from remodel_fenicsx.schema.times import same_time

log = logging.getLogger(__name__)

AIM = 0.9  # share of the tolerance that the next step aims at
PROPORTIONAL, INTEGRAL = 0.4, 0.7  # exponents over the order: the change of the error, and the error itself
GROWTH, SHRINKAGE = 4.0, 0.1  # limits of the ratio of two steps
SHORTER = 0.5  # a step that was too long is at most this long at the next attempt
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

    A PI controller: h <- h e^(-INTEGRAL/p) e_before^(PROPORTIONAL/p), with e the estimate of `TimeError` over AIM times
    the tolerance and p the order of the coupling. What it remembers is part of the state: runs that go on take the same
    steps. Where the error does not fall with the step (random cells turn over in the first pass, however short it
    is) steps go on as they are, with their error in the row, and a warning says so.

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
        initial = {"wanted": first, "before": 1.0, "floor": 0.0, "said": 0.0}
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
                duration = rejected.duration * min(SHORTER, max(SHRINKAGE, ratio))
            except StepFailure as failure:
                failures += 1
                duration = (time - self.state.time) / 4
                if failures > FAILURES or duration < SMALLEST * self.first:
                    raise
                log.info("%s; a shorter step is tried", failure)

    def _end_of_step(self, duration: float, stop: float) -> float:
        """No step that is left over before a stop is much shorter than the others."""
        time = self.state.time
        left = stop - time
        if duration >= left * (1 - 1e-9):
            return stop
        return time + (left / 2 if duration > left / 2 else duration)

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
        if longer:
            wanted = longer  # no worse than this one
        else:
            was_cut = not self._rejected and duration < wanted
            wanted = max(duration * self._ratio(error), wanted if was_cut else 0.0)
        kappa = self.stepper.remodeling.settings.kappa
        wanted = min(wanted, self.stepper.coupling.longest / kappa if kappa else wanted)
        numbers["wanted"], numbers["before"] = max(wanted, SMALLEST * self.first), max(error, LEAST)

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
        numbers = self._numbers
        if self._rejected:
            longest = self._rejected[0]
            if longest.duration > numbers["refused"] or not _same(longest.error, numbers["refused_error"]):
                numbers["refused"], numbers["refused_error"] = longest.duration, longest.error
        elif duration >= numbers["refused"]:
            numbers["refused"] = numbers["refused_error"] = 0.0

    def _ratio(self, error: float) -> float:
        """Of the next step to this one."""
        order, level = self.stepper.coupling.order, self._level()
        now, before = (value / (AIM * level) for value in (max(error, LEAST), self._numbers["before"]))
        ratio = now ** (-INTEGRAL / order) * before ** (PROPORTIONAL / order)
        return min(1.0 if self._rejected else GROWTH, max(SHRINKAGE, ratio))

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
