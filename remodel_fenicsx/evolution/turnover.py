"""Turnover over a step: content and natural length of collagen at all points of a state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from remodel_fenicsx.evolution.life_cycle import Remodels
from remodel_fenicsx.evolution.stepper import Step, Stepper, WarnsOnce
from remodel_fenicsx.fem.kinematics import NaturalConfiguration
from remodel_fenicsx.model.axes import GROWTH
from remodel_fenicsx.model.energy import TURNED_OVER, Tissue
from remodel_fenicsx.model.laws import TurnoverRates
from remodel_fenicsx.model.tensors import Array
from remodel_fenicsx.schema.processes.turnover import Turnover
from remodel_fenicsx.schema.settings import Remodeling
from remodel_fenicsx.solver.continuation import StepFailure, Work
from remodel_fenicsx.solver.diagnosis import FailureCause
from remodel_fenicsx.state import FieldHistory, StateNumbers, State

if TYPE_CHECKING:
    from remodel_fenicsx.scene.scene import Scene


# Smallest volume, relative to the initial one. With less the tissue is lost, and the step fails.
LEAST_VOLUME = 0.05
TISSUE_LOST = FailureCause(
    "lost tissue", "lower remodeling.turnover.volume or gain, or raise the loads"
)
# Largest |change of ln rho| in a step; a larger change is cut to this. Near a steady state changes
# are smaller.
LARGEST_TURNOVER = 0.5
# A path to the steady state ends as unbounded only if the natural length has changed by more than
# this factor somewhere.
MIN_UNBOUNDED_FACTOR = 10.0


def changed(start: Array, rates: Array, duration: float) -> Array:
    """Return ln m and ln rho (2, n) after a time with constant rates (2, n)."""
    content, length = rates * duration
    return start + [content, np.clip(length, -LARGEST_TURNOVER, LARGEST_TURNOVER)]


class Growth:
    """Volumetric growth by deposited collagen: sets G at all points, which thickens the wall."""

    def __init__(self, state: State, settings: Turnover):
        self.state, self.settings = state, settings
        self.quadrature = state.cells.quadrature
        self.start = settings.start  # a path to the steady state may set it later
        kinematics = state.kinematics
        assert isinstance(kinematics, NaturalConfiguration)
        self._gradient = self.quadrature.values(kinematics.gradient, (3, 3))
        self._initial = self.quadrature.values(kinematics.initial, (3, 3))
        normal = state.cells.local_axes.axes[..., 2, :]
        # G_0 N (x) N
        self._across = np.einsum("...ij,...j,...k->...ik", self._initial, normal, normal)
        reference = self.quadrature.function("reference_content", ())
        reference.x.array[:] = 1.0
        for function in (kinematics.gradient, reference):
            state.remember(function)
        self._reference = self.quadrature.values(reference, ())

    @property
    def ratio(self) -> Array:
        """Volume ratio of growth, J_g, (elements, points)."""
        return np.linalg.det(self._initial) / np.linalg.det(self._gradient)

    def share(self, content: Array) -> Array:
        """Return the volume fraction of collagen, phi m/(m_ref J_g), (elements, points)."""
        return self.settings.volume * content / (self._reference * self.ratio)

    def set_initial(self, content: Array, ratio: Array) -> None:
        """Set J_g of an earlier run, and the reference content m_ref that gives this J_g."""
        volume = self.settings.volume
        self._reference[:] = content * volume / (ratio - 1.0 + volume)
        self.set(ratio)

    def volume_ratio(self, content: Array) -> Array:
        """Return J_g for a content, (n,) or (elements, points); the result has the same shape."""
        return 1.0 + self.settings.volume * (content / self._reference.reshape(content.shape) - 1.0)

    def set_content(self, content: Array) -> None:
        """Set J_g = 1 + phi (m/m_ref - 1) and G = G_0 (1 - (1 - 1/J_g) N (x) N)."""
        # Before growth starts, m_ref follows m.
        if self.state.time < self.start:
            self._reference[:] = content
        ratio = self.volume_ratio(content)
        if self.quadrature.shape[1] > 1:
            # J_g is reduced to the polynomial degree of the element's strain; otherwise its
            # higher-degree part would oscillate between quadrature points.
            ratio = (
                ratio
                - self.quadrature.polynomial_residual(
                    self.quadrature.element_degree - 1, ratio[..., None]
                )[..., 0]
            )
        if (smallest := self.quadrature.minimum(ratio)) < LEAST_VOLUME:
            text = f"time {self.state.time:g}: tissue volume below {100 * LEAST_VOLUME:g} %"
            raise StepFailure(
                self.state.time, f"{text} of its initial value: J_g = {smallest:.3g}", TISSUE_LOST
            )
        self.set(ratio)

    def set(self, ratio: Array) -> None:
        """Set the volume ratio J_g, and G from it."""
        self._gradient[:] = self._initial - (1.0 - 1.0 / ratio)[..., None, None] * self._across


class DecayMonitor:
    """Monitor of a rate: does it decay faster than 1/t, t being the time under constant loads?"""

    # It compares the rate at t with one at t/2 or before; with short steps, between t/4 and t/2.

    INITIAL = dict.fromkeys(("early_time", "early_rate", "late_time", "late_rate"), 0.0)

    def __init__(self, numbers: StateNumbers | dict[str, float]):
        self.numbers = numbers

    def is_unbounded(self, elapsed: float, rate: float) -> bool:
        """Record a rate, and return whether rates decay no faster than 1/t; False if unknown."""
        numbers = self.numbers
        if elapsed >= 2 * numbers["late_time"]:
            numbers["early_time"], numbers["early_rate"] = (
                numbers["late_time"],
                numbers["late_rate"],
            )
            numbers["late_time"], numbers["late_rate"] = elapsed, rate
        return bool(
            numbers["early_time"]
            and rate * elapsed >= numbers["early_rate"] * numbers["early_time"]
        )


class TurnoverPass(Remodels):
    """Turnover of content and natural length; its rates follow from the solved chain lengths."""

    # The values are ln m and ln rho, (2, n).

    name, components = "turnover", len(TURNED_OVER)
    changes, depends_on_path = True, True

    def __init__(self, state: State, tissue: Tissue, remodeling: Remodeling):
        settings: Turnover = getattr(remodeling, self.name)
        assert settings.time is not None
        self.state, self.settings = state, settings
        self.quadrature = state.cells.quadrature
        turned_over = {name: self.quadrature.function(name, ()) for name in TURNED_OVER}
        for function in turned_over.values():
            function.x.array[:] = 1.0
            state.remember(function)
        self._parameters = state.parameters(replace(tissue, **turned_over))
        self.tissue = self._parameters.tissue
        self._numbers = StateNumbers(state, "turnover", {"duration": 0.0})
        self._earlier = FieldHistory(
            state, "turnover_rates", lambda: self.quadrature.function("", (2,)), 1
        )
        self.slowest, self.fastest = 1.0 / settings.time, max(1.0, settings.gain) / settings.time
        self.growth = Growth(state, settings) if state.kinematics.grows else None
        # Values of ln m and ln rho. A failed step need not restore them: `before` computes them.
        # `_step_start`: at the start of the step
        # `_last_solved`: in the last solved state
        # `_present`: in the equilibrium of this step
        # `_higher_order`: by the higher-order rule, for the error of the step
        self._step_start = self._last_solved = self._present = self._higher_order = (
            self.logarithms()
        )
        self.watchers = (UnboundedGrowth.for_scene,)
        # Rates at the start of the step, for a coupling of order 2; None for order 1.
        self._start_rates: Array | None = None
        self.begin_path()

    def set_initial(self, values: Callable[[str], Array]) -> None:
        """Set content, natural length and J_g from fields of an earlier run."""
        for name in TURNED_OVER:
            self._values(name)[:] = values(name)
        self._step_start = self._last_solved = self._present = self._higher_order = (
            self.logarithms()
        )
        if self.growth is not None:
            self.growth.set_initial(self._values("content"), values(GROWTH))

    # ------------------------------------------------------------ over a step
    def before(self, time: float, order: int) -> None:
        """Change m and rho before the step is solved."""
        # Order 1: m and rho follow one step late, with the last rates and duration.
        # Order 2: with the duration of this step, and rates extrapolated to its middle.
        duration, last = time - self.state.time, self._numbers["duration"]
        rates = self.rates()
        self._numbers["duration"], self._start_rates = duration, None
        if order == 1:
            self.change(rates, last)
            return
        mean = rates
        if self._earlier.known:
            mean = rates + duration / (2 * last) * (
                rates - self._earlier.values[0].reshape(-1, 2).T
            )
        self._earlier.push(np.ravel(rates.T))
        self._start_rates = rates
        self.change(mean, duration)

    def change(self, rates: Array, duration: float) -> None:
        """Change m and rho over a time with constant rates (2, n)."""
        self._last_solved = self._step_start = self.logarithms()
        self._present = changed(self._step_start, rates, duration)
        self.set(self._present)

    def set_fraction(self, fraction: float) -> None:
        """Apply a fraction of the change since the last solved state."""
        self.set(self._last_solved + fraction * (self._present - self._last_solved))

    def settle(self, time: float, again: bool) -> Work:
        """Record the present values as those of the solved state."""
        self._last_solved = self._present
        return Work()

    def after(self, time: float) -> float:
        """Compute the higher-order values, and return 0."""
        # The power of turnover has a column of its own (`turnover_power`), and is not added to that
        # of the cells.
        duration = time - self.state.time
        self._higher_order = changed(self._present, self.rates(), duration)
        if self._start_rates is not None:
            self._higher_order = changed(
                self._step_start, (self._start_rates + self.rates()) / 2, duration
            )
        return 0.0

    # ------------------------------------------------------------ error and steady state
    def solved_values(self) -> Array:
        """Return ln m and ln rho of the solved state."""
        return self._present

    def higher_order(self) -> Array:
        """Return the higher-order values, by the rates of the solved state."""
        return self._higher_order

    def as_components(self, values: Array) -> Array:
        """Return the values by points, (n, 2)."""
        return values.T

    def with_change(self, values: Array, change: Array) -> Array:
        """Return values after a change of their components (n, 2)."""
        return values + change.T

    def after_pass(self, values: Array, time: float, residual: float) -> Array:
        """Return values after a step with the rates of the present state and cells."""
        return changed(values, self.rates(present=True), time - self.state.time)

    def distance_between(self, values: Array, other: Array) -> float:
        """Return the largest relative difference of m or rho times 180/pi, for time.tolerance."""
        return float(np.degrees(self.size((other - values).T.reshape(*self.quadrature.shape, 2))))

    def remaining_change(self, time: float, residual: float) -> float:
        """Return the largest relative change up to a time."""
        return self.quadrature.maximum(self.fastest_changes()) * (time - self.state.time)

    def change_to_limit(self, time: float, duration: float, residual: float) -> Array:
        """Return the changes over a duration, because turnover has no pass to a limit."""
        return (self.rates().T * duration).reshape(*self.quadrature.shape, 2)

    def size(self, change: Array) -> float:
        """Return the largest relative change."""
        return self.quadrature.maximum(np.abs(change).max(axis=-1))

    def apply_change(self, change: Array, factor: float, time: float, residual: float) -> None:
        """Apply a multiple of the change of `change_to_limit`."""
        # The method multiplies rates by a duration: here `change` by `factor`.
        self.change(change.reshape(-1, 2).T, factor)

    def begin_path(self) -> None:
        """Reset the monitor of the rates."""
        self._decay = DecayMonitor(dict(DecayMonitor.INITIAL))

    def steady_state_problem(self, waiting: float) -> str:
        """Return text if the natural length changed much, and rates decay no faster than 1/t."""
        is_unbounded = self._decay.is_unbounded(
            waiting, self.quadrature.maximum(self.fastest_changes())
        )
        if (
            not is_unbounded
            or self.quadrature.maximum(self.factors("natural_length")) <= MIN_UNBOUNDED_FACTOR
        ):
            return ""
        return (
            "turnover has not reached equilibrium: its rates decay no faster than 1/t "
            "(mechanobiological instability). The result is the state at time "
            f"{self.state.time:g}; try a larger remodeling.turnover.gain"
        )

    def start_at_steady_state(self, time: float) -> None:
        """Start volumetric growth at a time."""
        if self.growth is not None:
            self.growth.start = time

    # ------------------------------------------------------------ values
    def logarithms(self) -> Array:
        """Return ln m and ln rho, flattened over the quadrature points, (2, n)."""
        return np.log([getattr(self.tissue, name).x.array for name in TURNED_OVER])

    def set(self, logarithms: Array) -> None:
        """Set m and rho by their logarithms (2, n), and growth by the content."""
        for name, values in zip(TURNED_OVER, np.exp(logarithms), strict=True):
            getattr(self.tissue, name).x.array[:] = values
        if self.growth is not None:
            self.growth.set_content(self._values("content"))

    def rates(self, present: bool = False) -> Array:
        """Return d ln m / dt and d ln rho / dt, (2, n), mean over load cases; see `_rates`."""
        states = (self.state, *self.state.other_cases)
        return np.asarray(
            sum(
                weight * np.array(self._rates(state, present))
                for weight, state in zip(self.state.weights, states, strict=True)
            )
        )

    def _rates(self, state: State, present: bool) -> TurnoverRates:
        """Return the rates in one load case, with present cells or those of the solved state."""
        cells = state.cells if present else state.equilibrium_cells
        squared = cells.kernels.squared_length(state.elastic_gradient(), cells.point_cells)
        return self.settings.rule.at_length(self._parameters.at_points(), np.sqrt(squared))

    def power(self) -> float:
        """Return the stored energy per time that turnover releases in the solved state."""
        cells = self.state.equilibrium_cells.point_cells
        increment = self._parameters.at_points().turnover_increment(
            self.state.elastic_gradient(), cells, *self.rates()
        )
        return 0.0 - self.quadrature.integral(self.state.per_mesh_volume(increment))

    def mean(self, name: str) -> float:
        """Return the volume mean of `content` or `natural_length`."""
        return self.quadrature.mean(self._values(name))

    def mean_volume_ratio(self) -> float:
        """Return the volume mean of `Growth.ratio`, for tissue that grows."""
        assert self.growth is not None
        return self.quadrature.mean(self.growth.ratio)

    def collagen_share(self) -> float:
        """Return the volume mean of `Growth.share`, for tissue that grows."""
        assert self.growth is not None
        return self.quadrature.mean(self.growth.share(self._values("content")))

    def _values(self, name: str) -> Array:
        return self.quadrature.values(getattr(self.tissue, name), ())

    def fastest_changes(self) -> Array:
        """Return the larger of |d ln m / dt| and |d ln rho / dt|, (elements, points)."""
        return np.abs(self.rates()).max(axis=0).reshape(self.quadrature.shape)

    def factors(self, name: str) -> Array:
        """Return max(x, 1/x) for x = `content` or `natural_length`, (elements, points)."""
        return np.exp(np.abs(np.log(self._values(name))))


# ---------------------------------------------------------------- runs without a steady state
# Number of turnover times under constant loads before a warning. In walls with a steady state the
# rates have risen to their maximum by then, and decrease.
MIN_TURNOVER_TIMES = 10.0
FAR_FROM_STEADY_STATE = 0.01  # smallest change of ln m or ln rho per turnover time that is reported


class UnboundedGrowth(WarnsOnce):
    """Warning at the end of a run if turnover rates decay no faster than 1/t (`DecayMonitor`)."""

    name, initial = "growth", DecayMonitor.INITIAL

    def __init__(self, stepper: Stepper, last_load_change: float):
        super().__init__(stepper)
        self.last_load_change, self._decay = last_load_change, DecayMonitor(self._numbers)
        self.turnover = stepper.process(TurnoverPass.name)

    @classmethod
    def for_scene(cls, scene: Scene, stepper: Stepper) -> UnboundedGrowth:
        return cls(stepper, scene.end_of_ramps)

    def due(self, step: Step) -> bool:
        return step.time > self.last_load_change

    def check(self, step: Step) -> str:
        """Check the rates under constant loads."""
        elapsed, period = step.time - self.last_load_change, self.turnover.settings.time
        rates = self.turnover.fastest_changes()
        rate = self.quadrature.maximum(rates)
        is_unbounded = self._decay.is_unbounded(elapsed, rate)
        if not (
            is_unbounded
            and step.is_last
            and elapsed >= MIN_TURNOVER_TIMES * period
            and rate * period >= FAR_FROM_STEADY_STATE
        ):
            return ""
        return (
            "turnover has not reached equilibrium: content or natural length change by up to "
            f"{100 * rate * period:.2g} % within one remodeling.turnover.time, most at "
            f"{self.quadrature.shown_place_of_largest(rates)}, and the rates have decayed no "
            f"faster than 1/t since time {self.last_load_change + self._numbers['early_time']:g} "
            "(mechanobiological instability, docs/turnover.md). "
            "Try a larger remodeling.turnover.gain"
        )
