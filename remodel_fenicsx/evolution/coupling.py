"""Couplings of equilibrium and remodeling in one step, of which a simulation uses one."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import NamedTuple, Protocol

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx._renamed import with_old_names
from remodel_fenicsx.body.loading import LoadValues
from remodel_fenicsx.evolution.remodeling import RemodelingPass
from remodel_fenicsx.fem.assembly import allreduce
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.model.tensor_law import Target, weight_of_the_end
from remodel_fenicsx.model.tensors import Array, Flags
from remodel_fenicsx.schema.settings import Solver
from remodel_fenicsx.solver.attempts import FROM_PREDICTION, FROM_PREVIOUS, Attempt, say
from remodel_fenicsx.solver.continuation import CellHomotopy, Continuation, Work
from remodel_fenicsx.solver.equilibrium import Equilibrium
from remodel_fenicsx.solver.newton import GuardedNewton, SolveFailure, attempted
from remodel_fenicsx.state import FieldHistory, StateNumbers, State

log = logging.getLogger(__name__)

# Record of a target at one point.
TARGET = np.dtype([("direction", float, (3, 3)), ("switch", float), ("time", float)])
NO_TIME = -1.0  # time of a record without a target
# A point gains a target when the target's switch (1 under tension, 0 without; `tensor_law`)
# reaches this. Below it the target changes the cells by less than the time error of a step.
MIN_TARGET_WEIGHT = 0.01
# The next rate of the unknowns is predicted as a weighted sum of their last SUMMED rates, with
# weights that are fitted to the last FITTED rates.
SUMMED, FITTED = 3, 2
SAME_RATE = 1e-9  # relative tolerance of equal load rates
DEPENDENT = 1e-12  # relative size of singular values that the fit of the weights omits


# ---------------------------------------------------------------- starting values of Newton


class LoadStep(NamedTuple):
    """Duration of a step, and the rates of the loads over the step."""

    duration: float
    rates: dict[str, float]

    @classmethod
    def between(
        cls, duration: float, old: Mapping[str, float], new: Mapping[str, float]
    ) -> LoadStep:
        """Return a step with the rates that lead from the old to the new loads."""
        return cls(
            duration, {name: (new.get(name, old[name]) - old[name]) / duration for name in old}
        )


class Predictor:
    """Prediction of the unknowns by the rates of earlier steps, v_n = sum_j a_j v_(n-j)."""

    # It needs load rates that are the same as in the earlier steps.

    def __init__(self, state: State):
        self.state = state
        # Rates are increments over the duration of their steps, so that the step size may change.
        self._speeds = FieldHistory(state, "predictor_speed", state.unknown.copy, SUMMED + FITTED)
        self._numbers = StateNumbers(
            state, "predictor", {f"rate_{name}": 0.0 for name in state.loading.values}
        )

    def expected(self, step: LoadStep) -> Array | None:
        """Return the prediction with boundary values and ghosts, or None."""
        # There is none without earlier rates, or if the load rates have changed.
        speeds, state = self._speeds.values, self.state
        if not speeds or not self._has_same_load_rates(step):
            return None
        speed = speeds[0]
        if len(speeds) == SUMMED + FITTED:
            speed = self._weights(speeds) @ np.array(speeds[:SUMMED])
        values = state.unknown.x.array + step.duration * speed
        for condition in state.loading.boundary_conditions:
            condition.set(values)
        return values

    def solved(self, step: LoadStep, before: Array, again: bool = False) -> None:
        """Record the rate of a solved step.

        `before` holds the unknowns before this solve. In a second solve of the step (`again`) its
        rate is added to that of the first.
        """
        unknown = self.state.unknown
        speed = np.asarray((unknown.x.array - before) / step.duration, dtype=np.float64)
        if again:
            self._speeds.values[0][:] += speed
            return
        if not self._has_same_load_rates(step):
            self._speeds.forget()
        self._speeds.push(speed)
        for name, rate in step.rates.items():
            self._numbers[f"rate_{name}"] = rate

    def _has_same_load_rates(self, step: LoadStep) -> bool:
        """Return whether the load rates are those of the last step."""
        rates = [(rate, self._numbers[f"rate_{name}"]) for name, rate in step.rates.items()]
        return all(
            [abs(rate - last) <= SAME_RATE * max(abs(rate), abs(last)) for rate, last in rates]
        )

    def _weights(self, speeds: list[Array]) -> Array:
        """Return the weights with which earlier rates fit the newest ones best. Collective."""
        rows = np.array([speed[: self.state.number_of_owned_unknowns] for speed in speeds])
        products = allreduce(self.state.comm, rows @ rows.T, MPI.SUM)
        matrix, right = np.zeros((SUMMED, SUMMED)), np.zeros(SUMMED)
        for k in range(FITTED):
            matrix += products[k + 1 : k + 1 + SUMMED, k + 1 : k + 1 + SUMMED]
            right += products[k + 1 : k + 1 + SUMMED, k]
        return np.asarray(np.linalg.lstsq(matrix, right, rcond=DEPENDENT)[0], dtype=np.float64)


@with_old_names
class Traits(NamedTuple):
    """Properties of a coupling's time discretisation error, for adaptive time stepping.

    Attributes
    ----------
    order
        Order of the error in the step size.
    accumulates
        True if the errors of all steps add up; False if the only error is a delay of the cells and
        of other remodeling processes by one step.
    max_scaled_step
        Largest adaptive step times the largest rate of all processes; an explicit rule oscillates
        with larger steps.

    Examples
    --------
    >>> from remodel_fenicsx.extend import Traits
    >>> Traits(order=2, accumulates=True).max_scaled_step
    inf
    """

    order: int
    accumulates: bool
    max_scaled_step: float = math.inf


class Coupling(Protocol):
    """Protocol of a coupling.

    A step has two halves, `solve` and `remodel`; the output row is taken between them. Both run
    inside the stepper's transaction. `RemodelingPass.apply` and `replace` change the cells and
    compute the power. Values that carry over from step to step belong to the state
    (`State.remember`, `state.StateNumbers`). For each of `RemodelingPass.additional_processes` the
    coupling calls `before`, then `settle` once equilibrium is reached, then `after`.

    Attributes
    ----------
    equilibrium
        Forms of the forces, the tangent and the energy, at the unknowns and cells of the state.
    newton
        Newton's method for the state.
    traits
        Properties of the time discretisation error.
    tangents
        Number of tangents assembled in the last solve of the state.

    Examples
    --------
    A custom coupling is usually a `Staggered` with another second half. The coupling of a
    simulation:

    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> coupling = Simulation(preset_scene("kuhl-holzapfel-2007", "cube")).stepper.coupling
    >>> coupling.traits
    Traits(order=1, accumulates=False, max_scaled_step=inf)
    """

    equilibrium: Equilibrium
    newton: GuardedNewton
    traits: Traits
    tangents: int

    @property
    def higher_order_cells(self) -> UnitCell | None:
        """Cells of a higher-order rule, (n, 3) and (n, 3, 3), after `remodel`; or None."""

    def solve(self, time: float, loads: LoadValues) -> Work:
        """Solve for equilibrium, and store its cells in `state.equilibrium_cells`.

        Parameters
        ----------
        time
            End of the step.
        loads
            Magnitudes of all loads at this time, by name.

        Returns
        -------
        Work
            Solver work of the step.
        """

    def remodel(self, time: float) -> float:
        """Compute the next step's cells, unless `solve` does it; return the power of remodeling.

        Parameters
        ----------
        time
            End of the step.

        Returns
        -------
        float
            Stored energy released per time.
        """

    def close(self) -> None:
        """Free the PETSc objects of the coupling."""


@with_old_names
class Staggered:
    """Paper's coupling: equilibrium with the previous cells, then one remodeling pass.

    If Newton's method does not converge in one increment, the change of the cells and then the
    change of the loads are applied in substeps (docs/solver.md, "Substeps").

    Parameters
    ----------
    state
        State to advance.
    tissue
        Constitutive parameters on the mesh.
    remodeling
        Pass that changes the cells.
    settings
        Solver settings.

    Examples
    --------
    A custom coupling overrides one of the halves, see `CouplingKind`. A simulation makes it
    from its class:

    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> from remodel_fenicsx.extend import Staggered
    >>> simulation = Simulation(preset_scene("kuhl-holzapfel-2007", "cube"), coupling=Staggered)
    >>> type(simulation.stepper.coupling).__name__
    'Staggered'
    """

    traits = Traits(order=1, accumulates=False)

    def __init__(self, state: State, tissue: Tissue, remodeling: RemodelingPass, settings: Solver):
        self.state, self.settings = state, settings
        self.remodeling = remodeling
        self.equilibrium = Equilibrium(state, tissue)
        self.equilibrium.compile_energy()
        self.newton = GuardedNewton(self.equilibrium, settings)
        self.predictor = None if settings.predictor == "none" else Predictor(state)
        self._last = StateNumbers(state, "last_solution", {"extension": 0.0})  # largest r/L
        self.residual = 0.0
        self.tangents = 0  # assembled in the last solve of the state
        changes = any(process.changes for process in (remodeling, *remodeling.additional_processes))
        self.blend = CellHomotopy(state, tissue, settings) if changes else None

    def solve(self, time: float, loads: LoadValues) -> Work:
        """Solve for equilibrium at `time` with the present cells.

        Raises
        ------
        StepFailure
            If no admissible equilibrium is found.
        """
        for process in self.remodeling.additional_processes:
            process.before(time, self.traits.order)
        return self.solve_equilibrium(time, loads)

    def solve_equilibrium(self, time: float, loads: LoadValues, again: bool = False) -> Work:
        """Solve for equilibrium with the present cells, then call `settle` of further processes.

        Parameters
        ----------
        time, loads
            See `solve`.
        again
            Whether the step was already solved with other cells.

        Returns
        -------
        Work
            Solver work.
        """
        work, state = Work(), self.state
        unknown, old_loads = state.unknown, dict(state.loading.values)
        before = unknown.x.array.copy()
        step = LoadStep.between(time - state.time, old_loads, loads)
        self._solve(step, time, old_loads, loads, work, again)
        # If the solution may be on another branch, the step is repeated from `before` in substeps
        # that change cells and loads together.
        self._combined_change(time, old_loads, loads).check_for_jump(before, work, again)
        if self.predictor is not None:
            self.predictor.solved(step, before, again)
        state.mark_cells_in_equilibrium()
        self.residual = work.residual
        work.limits = work.limits or self.equilibrium.limits()
        self._last["extension"] = work.limits.max_chain_extension
        self.tangents = work.tangents
        for process in self.remodeling.additional_processes:
            work.count(process.settle(time, again))
        return work

    def remodel(self, time: float) -> float:
        """Remodel with the stress of the solved state, and return the power."""
        power = 0.0
        if self.remodeling.law.remodels:
            power = self.remodeling.apply(self.state.time, time, self.residual)
        for process in self.remodeling.additional_processes:
            power += process.after(time)
        return power

    @property
    def higher_order_cells(self) -> UnitCell | None:
        """Cells after an unrelaxed pass with the solved stress; output has the cells before it."""
        return self.remodeling.full_pass_cells

    def close(self) -> None:
        """Free the PETSc objects of the coupling."""
        self.newton.close()
        for process in self.remodeling.additional_processes:
            process.close()
        if self.blend is not None:
            self.blend.close()

    # ------------------------------------------------------------ one increment: the paper's step
    def _solve(
        self,
        step: LoadStep,
        time: float,
        old_loads: LoadValues,
        loads: LoadValues,
        work: Work,
        again: bool,
    ) -> None:
        """Attempt `FROM_PREDICTION`, `FROM_PREVIOUS` and `IN_SUBSTEPS` in this order."""
        state, failure = self.state, None
        unknown, loading = state.unknown.x.array, state.loading
        before = unknown.copy()
        loading.set(loads)  # prescribed values are part of the prediction
        if not again and self._set_prediction(step):
            if not self._failure_of(FROM_PREDICTION, work, before):
                return
        unknown[:] = before
        loading.set(old_loads)
        if self.equilibrium.limits().admissible:
            loading.set(loads)
            failure = self._failure_of(FROM_PREVIOUS, work)
            if not failure:
                return
        else:
            say(FROM_PREVIOUS, "the remodeled cells exceed r = L at the previous displacement")
        self._solve_in_substeps(time, old_loads, loads, work, failure)

    def _set_prediction(self, step: LoadStep) -> bool:
        """Set the unknowns to the prediction, and return whether it exists and is admissible."""
        # If chains are almost straight in the prediction, the forces are huge, and Newton's method
        # needs many iterations. It needs fewer from the last displacement.
        expected = None if self.predictor is None else self.predictor.expected(step)
        if expected is None:
            return False
        unknown = self.state.unknown
        unknown.x.array[:] = expected
        return self.newton.is_admissible_start(self._last["extension"])

    def _failure_of(
        self, attempt: Attempt, work: Work, step_start: Array | None = None
    ) -> SolveFailure | None:
        """Solve from the present unknowns, and return the failure or None."""
        outcome = attempted(partial(self.newton.solve, step_start), SolveFailure)
        work.add(outcome)
        if isinstance(outcome, SolveFailure):
            say(attempt, outcome.reason)
            return outcome
        work.substeps = 1
        return None

    # ------------------------------------------------------------ substeps
    def _solve_in_substeps(
        self,
        time: float,
        old_loads: LoadValues,
        new_loads: LoadValues,
        work: Work,
        failure: SolveFailure | None,
    ) -> None:
        """Apply the change of the cells and then that of the loads in substeps."""
        # `failure` is that of the full step, if it was tried.
        loading, halvings = self.state.loading, self.settings.maximum_halvings
        loading.set(old_loads)
        if (blend := self.blend) is not None and self._has_remodeled():
            cell_change = Continuation(
                time,
                "the change of the cells",
                self._set_cell_fraction,
                self.state,
                lambda: blend.newton,
                halvings,
                blend.largest_increment,
                loose_tolerance=True,
            )
            cell_change.advance(work)
            failure = None  # the loads were not yet tried from this state

        def set_load_fraction(fraction: float) -> None:
            loading.set(between(old_loads, new_loads, fraction))

        load_change = Continuation(
            time,
            "the change of the loads",
            set_load_fraction,
            self.state,
            lambda: self.newton,
            halvings,
        )
        load_change.advance(work, failure)
        loading.set(new_loads)
        log.info("time %g solved in %d substeps", time, work.substeps)

    def _combined_change(
        self, time: float, old_loads: LoadValues, new_loads: LoadValues
    ) -> Continuation:
        """Return the change of cells and loads together."""
        blend = cache(lambda: self.blend if self._has_remodeled() else None)

        def set_fraction(fraction: float) -> None:
            self.state.loading.set(between(old_loads, new_loads, fraction))
            if blend() is not None:
                self._set_cell_fraction(fraction)

        def largest_increment(done: float) -> float:
            return 1.0 if (homotopy := blend()) is None else homotopy.largest_increment(done)

        return Continuation(
            time,
            "the step",
            set_fraction,
            self.state,
            lambda: (blend() or self).newton,
            self.settings.maximum_halvings,
            largest_increment,
        )

    def _set_cell_fraction(self, fraction: float) -> None:
        """Apply a fraction of the remodeling since the last solved state."""
        assert self.blend is not None
        self.blend.set(fraction)
        for process in self.remodeling.additional_processes:
            process.set_fraction(fraction)

    def _has_remodeled(self) -> bool:
        if any(process.changes for process in self.remodeling.additional_processes):
            return True
        are_equal = self.state.equilibrium_cells.equals(self.state.cells)
        return self.state.comm.allreduce(int(not are_equal)) > 0


def between(old: LoadValues, new: LoadValues, fraction: float) -> LoadValues:
    """Return the loads after a fraction of their change."""
    return (
        new
        if fraction == 1.0
        else {name: old[name] + fraction * (new[name] - old[name]) for name in new}
    )


class Extrapolated(Staggered):
    """Second-order coupling: remodel with an extrapolated target, then solve."""

    # A `Target` holds the tensor E that A/r0^2 approaches, and the switch s, the active fraction of
    # kappa. Their product is extrapolated from the last two steps to the middle of this step of
    # size h: s E + h/2 d(s E)/dt. See docs/time_integration.md, Extrapolated coupling.

    traits = Traits(order=2, accumulates=True, max_scaled_step=0.5)

    def __init__(self, state: State, tissue: Tissue, remodeling: RemodelingPass, settings: Solver):
        super().__init__(state, tissue, remodeling, settings)
        size = TARGET.itemsize // 8
        targets = state.cells.quadrature.function("targets", (2, size))
        memory = state.cells.quadrature.values(targets, (2, size)).reshape(-1, 2, size)
        # Last target and the one before, flattened over the quadrature points, in the function's
        # memory.
        self._newest: NDArray[np.void]
        self._older: NDArray[np.void]
        self._newest, self._older = np.moveaxis(memory.view(TARGET)[..., 0], 1, 0)
        self._newest["time"] = self._older["time"] = NO_TIME
        state.remember(targets)
        self._power = 0.0
        self._start: UnitCell  # the cells at the start of the step
        self._solved_target: Target  # target of the solved state
        self._gains_target: Flags  # points that gain a target in this step
        self._duration = 0.0  # duration of the step

    @property
    def higher_order_cells(self) -> UnitCell:
        """Cells computed with a weighted mean of the targets at both ends of the step."""
        # Points that gain a target in this step use that target alone.
        weight = weight_of_the_end(self.remodeling.kappa * self._duration)
        mean = target_from_records(self._older).towards(self._solved_target, weight)
        mean = mean.where(self._gains_target, self._solved_target)
        return self.remodeling.cells_towards(mean, self._duration, self._start)

    def solve(self, time: float, loads: LoadValues) -> Work:
        """Compute the new cells, and solve for equilibrium at `time` with them."""
        cells = self.state.cells
        self._start, expected = cells.point_cells.copy(), self._extrapolated(time)
        self._set_cells_after(expected, time)
        work = super().solve(time, loads)
        self._solved_target = self.remodeling.target(self.residual)
        self._gains_target = (self._newest["switch"] < MIN_TARGET_WEIGHT) & (
            self._solved_target.switch >= MIN_TARGET_WEIGHT
        )
        if not count_points(self.state, self._gains_target):
            return work
        cells.set(*self._start[:2])
        self._set_cells_after(expected.where(self._gains_target, self._solved_target), time)
        repeated = self.solve_equilibrium(time, loads, again=True)
        self._solved_target = self.remodeling.target(self.residual)
        repeated.substeps += work.substeps - 1
        repeated.count(work)
        return repeated

    def remodel(self, time: float) -> float:
        """Record the target of the solved state, whose cells `solve` has set."""
        self._duration = time - self.state.time
        self._older[:] = self._newest
        self._older["time"][self._gains_target] = NO_TIME  # no older target
        self._newest["direction"], self._newest["switch"] = self._solved_target
        self._newest["time"] = time
        for process in self.remodeling.additional_processes:
            self._power += process.after(time)
        return self._power

    def _extrapolated(self, time: float) -> Target:
        """Return the target extrapolated to the middle of the step."""
        last, before = self._newest["time"], self._older["time"]
        weight, has_both = np.zeros_like(last), before != NO_TIME
        weight[has_both] = (time - last[has_both]) / 2 / (last[has_both] - before[has_both])
        return target_from_records(self._newest).towards(target_from_records(self._older), -weight)

    def _set_cells_after(self, target: Target, time: float) -> None:
        """Set the cells of the step's end; use the last target where A would become indefinite."""
        duration = time - self.state.time
        self._power = 0.0
        if not count_points(self.state, target.switch != 0.0):
            return
        cells = self.remodeling.cells_towards(target, duration)
        lost = ~np.isfinite(cells.dimensions).all(axis=-1)
        if lost.any():
            cells = self.remodeling.cells_towards(
                target.where(lost, target_from_records(self._newest)), duration
            )
        points = count_points(self.state, lost)
        if points:
            log.info("time %g: %d points use the last target, without extrapolation", time, points)
        self._power = self.remodeling.replace(cells, self.state.elastic_gradient(), duration)


def count_points(state: State, points: Flags) -> int:
    """Count selected points (n,) over all ranks. Collective."""
    quadrature = state.cells.quadrature
    owned = quadrature.owned(points.reshape(quadrature.shape))
    return allreduce(state.comm, int(owned.sum()), MPI.SUM)


def target_from_records(records: NDArray[np.void]) -> Target:
    """Return the target stored in records of `TARGET`; zero before the first target."""
    return Target(records["direction"], records["switch"])


CouplingFactory = Callable[[State, Tissue, RemodelingPass, Solver], Coupling]
