"""Turnover over a step: content and natural length of the collagen at all points of a state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.evolution.life_cycle import Remodels
from remodel_fenicsx.evolution.stepper import Step, Stepper, WarnsOnce
from remodel_fenicsx.fem.kinematics import NaturalConfiguration
from remodel_fenicsx.model.axes import GROWTH
from remodel_fenicsx.model.energy import TURNED_OVER, Tissue
from remodel_fenicsx.model.laws import TurnoverRates
from remodel_fenicsx.schema.settings import Remodeling, Turnover
from remodel_fenicsx.solver.continuation import StepFailure, Work
from remodel_fenicsx.solver.diagnosis import Refusal
from remodel_fenicsx.state import Earlier, Numbers, State

if TYPE_CHECKING:
    from remodel_fenicsx.scene.scene import Scene

Array = NDArray[np.float64]

LEAST_VOLUME = 0.05  # of that at the start, below which a step is refused: then hardly anything is left
GONE = Refusal("lost tissue", "take a smaller remodeling.turnover.volume or gain, or higher loads")
LARGEST_TURNOVER = 0.5  # largest |change of ln rho| in a step: the prototype's; it does not act at rest
MUCH = 10.0  # factor of the natural length, from which on a way to rest may be given up by its rates


def changed(start: Array, rates: Array, duration: float) -> Array:
    """ln m and ln rho (2, n) after a time with rates (2, n)."""
    content, length = rates * duration
    return start + [content, np.clip(length, -LARGEST_TURNOVER, LARGEST_TURNOVER)]


class Growth:
    """The room that collagen takes: G at all points, whose direction across the wall follows the content."""

    def __init__(self, state: State, settings: Turnover):
        self.state, self.settings, self.quadrature = state, settings, state.cells.quadrature
        self.start = settings.start  # a way to rest says where it is, where that is asked for
        kinematics = state.kinematics
        assert isinstance(kinematics, NaturalConfiguration)
        self._gradient = self.quadrature.values(kinematics.gradient, (3, 3))
        self._initial = self.quadrature.values(kinematics.initial, (3, 3))
        normal = state.cells.local_axes.axes[..., 2, :]
        self._across = np.einsum("...ij,...j,...k->...ik", self._initial, normal, normal)  # G_0 N (x) N
        reference = self.quadrature.function("reference_content", ())
        reference.x.array[:] = 1.0
        for function in (kinematics.gradient, reference):
            state.remember(function)
        self._reference = self.quadrature.values(reference, ())

    @property
    def ratio(self) -> Array:
        """J_g, by what the volume has grown, (elements, points)."""
        return np.asarray(np.linalg.det(self._initial) / np.linalg.det(self._gradient))

    def share(self, content: Array) -> Array:
        """phi m/(m_ref J_g), the share of the present volume that is collagen; (elements, points)."""
        return np.asarray(self.settings.volume * content / (self._reference * self.ratio))

    def begin_with(self, content: Array, ratio: Array) -> None:
        """Content and J_g of an earlier run: m_ref is such that they belong together."""
        volume = self.settings.volume
        self._reference[:] = content * volume / (ratio - 1.0 + volume)
        self.set(ratio)

    def of_content(self, content: Array) -> Array:
        """J_g at every point by itself, as the content has it; of all points in one row, or (elements, points)."""
        return np.asarray(1.0 + self.settings.volume * (content / self._reference.reshape(content.shape) - 1.0))

    def follow(self, content: Array) -> None:
        """J_g = 1 + phi (m/m_ref - 1) of the content (elements, points), and G = G_0 (1 - (1 - 1/J_g) N (x) N)."""
        if self.state.time < self.start:
            self._reference[:] = content
        ratio = self.of_content(content)
        if self.quadrature.shape[1] > 1:
            # as much as the strain of an element can follow: more of it alternates from point to point
            ratio = ratio - self.quadrature.beyond(self.quadrature.element_degree - 1, ratio[..., None])[..., 0]
        if (least := self.quadrature.minimum(ratio)) < LEAST_VOLUME:
            text = f"after time {self.state.time:g} less than {100 * LEAST_VOLUME:g} % of the tissue's volume is left"
            raise StepFailure(self.state.time, f"{text}: J_g = {least:.3g}", GONE)
        self.set(ratio)

    def set(self, ratio: Array) -> None:
        """Other J_g."""
        self._gradient[:] = self._initial - (1.0 - 1.0 / ratio)[..., None, None] * self._across


class Slowing:
    """Whether rates fall faster than 1/t: told from what they were after a quarter to a half of the time."""

    INITIAL = dict.fromkeys(("early_time", "early_rate", "late_time", "late_rate"), 0.0)

    def __init__(self, numbers: Numbers | dict[str, float]):
        self.numbers = numbers

    def goes_on(self, elapsed: float, rate: float) -> bool:
        """Whether the rate after a time does not fall so; False where that is not known yet."""
        numbers = self.numbers
        if elapsed >= 2 * numbers["late_time"]:
            numbers["early_time"], numbers["early_rate"] = numbers["late_time"], numbers["late_rate"]
            numbers["late_time"], numbers["late_rate"] = elapsed, rate
        return bool(numbers["early_time"] and rate * elapsed >= numbers["early_rate"] * numbers["early_time"])


class TurnoverPass(Remodels):
    """Changes content and natural length with the lengths of solved states; values are ln m and ln rho, (2, n)."""

    name, components, changes, depends_on_path = "turnover", len(TURNED_OVER), True, True

    def __init__(self, state: State, tissue: Tissue, remodeling: Remodeling):
        settings = remodeling.turnover
        assert settings.time is not None
        self.state, self.settings, self.quadrature = state, settings, state.cells.quadrature
        turned_over = {name: self.quadrature.function(name, ()) for name in TURNED_OVER}
        for function in turned_over.values():
            function.x.array[:] = 1.0
            state.remember(function)
        self._parameters = state.parameters(replace(tissue, **turned_over))
        self.tissue = self._parameters.tissue
        self._numbers = Numbers(state, "turnover", {"duration": 0.0})
        self._earlier = Earlier(state, "turnover_rates", lambda: self.quadrature.function("", (2,)), 1)
        self.slowest, self.fastest = 1.0 / settings.time, max(1.0, settings.gain) / settings.time
        self.growth = Growth(state, settings) if state.kinematics.grows else None
        self._start = self._before = self._row = self._better = self.logarithms()  # before: of the last solved state
        self.watchers = (GrowthWithoutRest.of,)
        self._start_rates: Array | None = None  # where those of both ends together are better
        self.begin_path()

    def begin_with(self, values: Callable[[str], Array]) -> None:
        """Take content, natural length and J_g of an earlier run."""
        for name in TURNED_OVER:
            self._values(name)[:] = values(name)
        self._start = self._before = self._row = self._better = self.logarithms()
        if self.growth is not None:
            self.growth.begin_with(self._values("content"), values(GROWTH))

    # ------------------------------------------------------------ over a step
    def before(self, time: float, order: int) -> None:
        """Change m and rho with the rates of the last row; of order 2, with those of the step's middle."""
        duration, last, rates = time - self.state.time, self._numbers["duration"], self.rates()
        self._numbers["duration"], self._start_rates = duration, None
        if order == 1:
            self.change(rates, last)
            return
        mean = rates
        if self._earlier.known:
            mean = rates + duration / (2 * last) * (rates - self._earlier.values[0].reshape(-1, 2).T)
        self._earlier.push(np.ravel(rates.T))
        self._start_rates = rates
        self.change(mean, duration)

    def change(self, rates: Array, duration: float) -> None:
        """Take m and rho after a time with rates (2, n)."""
        self._before = self._start = self.logarithms()
        self._row = changed(self._start, rates, duration)
        self.set(self._row)

    def set_part(self, fraction: float) -> None:
        """Take a part of what has changed since the last solved state."""
        self.set(self._before + fraction * (self._row - self._before))

    def settle(self, time: float, again: bool) -> Work:
        """The present state is solved."""
        self._before = self._row
        return Work()

    def after(self, time: float) -> float:
        """Make what is better than the row; the power of turnover is a column of its own."""
        duration = time - self.state.time
        self._better = changed(self._row, self.rates(), duration)
        if self._start_rates is not None:
            self._better = changed(self._start, (self._start_rates + self.rates()) / 2, duration)
        return 0.0

    # ------------------------------------------------------------ errors and rest
    def row(self) -> Array:
        """Return ln m and ln rho of the solved state."""
        return self._row

    def better(self) -> Array:
        """Return what the rates of the solved state ask for."""
        return self._better

    def as_components(self, values: Array) -> Array:
        """Return them by points."""
        return values.T

    def moved(self, values: Array, change: Array) -> Array:
        """Return values after a change."""
        return values + change.T

    def passed(self, values: Array, time: float, residual: float) -> Array:
        """Return values after a step with the rates of the present state and its cells."""
        return changed(values, self.rates(present=True), time - self.state.time)

    def apart(self, values: Array, other: Array) -> float:
        """Return the largest relative difference of m or rho, as an angle in radians, in degrees."""
        return float(np.degrees(self.size((other - values).T.reshape(*self.quadrature.shape, 2))))

    def left(self, time: float, residual: float) -> float:
        """Return the largest relative change up to a time."""
        return self.quadrature.maximum(self.fastest_changes()) * (time - self.state.time)

    def to_the_limit(self, time: float, duration: float, residual: float) -> Array:
        """Return the changes over a duration; there is no pass to a limit."""
        return np.asarray(self.rates().T * duration).reshape(*self.quadrature.shape, 2)

    def size(self, change: Array) -> float:
        """Return the largest relative change."""
        return self.quadrature.maximum(np.abs(change).max(axis=-1))

    def follow(self, change: Array, factor: float, time: float, residual: float) -> None:
        """Take a multiple of such a change."""
        self.change(change.reshape(-1, 2).T, factor)

    def begin_path(self) -> None:
        """Watch anew whether rates fall."""
        self._slowing = Slowing(dict(Slowing.INITIAL))

    def without_rest(self, waiting: float) -> str:
        """Say that the natural length has grown much while its rates fall no faster than 1/t."""
        goes_on = self._slowing.goes_on(waiting, self.quadrature.maximum(self.fastest_changes()))
        if not goes_on or self.quadrature.maximum(self.factors("natural_length")) <= MUCH:
            return ""
        return (
            "growth does not come to rest, its rates fall no faster than 1/t (docs/tissue_that_lives.md, When it comes "
            f"to rest): the state is that of time {self.state.time:g}, on the path"
        )

    def rested(self, time: float) -> None:
        """What is made from a time on takes room."""
        if self.growth is not None:
            self.growth.start = time

    # ------------------------------------------------------------ values
    def logarithms(self) -> Array:
        """ln m and ln rho at all points in one row, (2, n)."""
        return np.log([getattr(self.tissue, name).x.array for name in TURNED_OVER])

    def set(self, logarithms: Array) -> None:
        """Other m and rho."""
        for name, values in zip(TURNED_OVER, np.exp(logarithms), strict=True):
            getattr(self.tissue, name).x.array[:] = values
        if self.growth is not None:
            self.growth.follow(self._values("content"))

    def rates(self, present: bool = False) -> Array:
        """d ln m / dt and d ln rho / dt of the solved state (2, n), of several load cases the weighted mean."""
        states = (self.state, *self.state.others)
        parts = [np.array(self._rates(state, present)) for state in states]
        return np.asarray(sum(weight * part for weight, part in zip(self.state.weights, parts, strict=True)))

    def _rates(self, state: State, present: bool) -> TurnoverRates:
        """In one load case."""
        cells = state.cells if present else state.equilibrium_cells
        squared = cells.kernels.squared_length(state.elastic_gradient(), cells.point_cells)
        return self.settings.rule.at_length(self._parameters.at_points(), np.sqrt(squared))

    def power(self) -> float:
        """Stored energy per time that turnover releases in the solved state, at its F and cells."""
        cells = self.state.equilibrium_cells.point_cells
        increment = self._parameters.at_points().turnover_increment(self.state.elastic_gradient(), cells, *self.rates())
        return 0.0 - float(self.quadrature.integral(self.state.per_mesh_volume(increment)))

    def mean(self, name: str) -> float:
        """Volume mean of `content` or `natural_length`."""
        return float(self.quadrature.mean(self._values(name)))

    def collagen_share(self) -> float:
        """Volume mean of `Growth.share`, where tissue grows."""
        assert self.growth is not None
        return float(self.quadrature.mean(self.growth.share(self._values("content"))))

    def _values(self, name: str) -> Array:
        return self.quadrature.values(getattr(self.tissue, name), ())

    def fastest_changes(self) -> Array:
        """Larger one of |d ln m / dt| and |d ln rho / dt| in the solved state, (elements, points)."""
        return np.abs(self.rates()).max(axis=0).reshape(self.quadrature.shape)

    def factors(self, name: str) -> Array:
        """By what `content` or `natural_length` has changed, up or down: 1 or more, (elements, points)."""
        return np.exp(np.abs(np.log(self._values(name))))


# ---------------------------------------------------------------- a run that does not come to rest
EARLY = 10.0  # times of turnover, before which rates say little: walls that rest have risen and fall by then
FAR_FROM_REST = 0.01  # change of ln m or ln rho in a time of turnover


class GrowthWithoutRest(WarnsOnce):
    """Warns at the end where turnover goes on, and its rates do not fall as those do that come to rest (`Slowing`)."""

    name, initial = "growth", Slowing.INITIAL

    def __init__(self, stepper: Stepper, held_from: float):
        super().__init__(stepper)
        self.held_from, self._slowing = held_from, Slowing(self._numbers)
        self.turnover = stepper.part(TurnoverPass.name)

    @classmethod
    def of(cls, scene: Scene, stepper: Stepper) -> GrowthWithoutRest:
        return cls(stepper, scene.end_of_ramps)

    def due(self, step: Step) -> bool:
        return step.time > self.held_from

    def look(self, step: Step) -> str:
        """At the rates, while loads are held."""
        elapsed, period = step.time - self.held_from, self.turnover.settings.time
        rates = self.turnover.fastest_changes()
        rate = self.quadrature.maximum(rates)
        goes_on = self._slowing.goes_on(elapsed, rate)
        if not (goes_on and step.is_last and elapsed >= EARLY * period and rate * period >= FAR_FROM_REST):
            return ""
        return (
            "the tissue has not come to rest: content or natural length change by up to "
            f"{100 * rate * period:.2g} % in remodeling.turnover.time, most at "
            f"{self.quadrature.shown_place_of_largest(rates)}, "
            f"and since time {self.held_from + self._numbers['early_time']:g} the rates have fallen no faster than "
            "1/t. It goes on without bound (mechanobiological instability, docs/tissue_that_lives.md), "
            "or rests much later; "
            "with a larger remodeling.turnover.gain it rests sooner"
        )
