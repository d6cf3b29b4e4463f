"""Direct solution for the homeostatic state, to which remodeling tends under the final loads.

In the homeostatic state of a law with a limit the cells belong to their own stress: l = r0 e along
the principal axes, or A = r0^2 E. A body may have several such states, and a point without tension
keeps its cells, so that the state depends on the load path. Therefore the path is integrated in
adaptive steps, which grow under constant loads, until the cells hardly change. The tail of their
exponential decay is extrapolated (docs/solver.md, "Homeostatic state").
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from remodel_fenicsx.body.loading import LoadValues
from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.evolution.time_steps import StepControl
from remodel_fenicsx.fem import assembly
from remodel_fenicsx.model.tensors import Array
from remodel_fenicsx.solver.continuation import StepFailure, Work
from remodel_fenicsx.solver.newton import attempted
from remodel_fenicsx.state import Snapshot
from remodel_fenicsx.system import NOTICE

log = logging.getLogger(__name__)

PATH_TOLERANCE, UNLOADING_PATH_TOLERANCE = 3.0, 0.5
"""Time tolerance in degrees if the scene sets none: for monotonic loading, and for unloading or
load reversal. With unloading, points lose their tension and keep the error of the path. The paper's
artery takes 25 solves."""
# Tolerance in degrees without error control, for steps whose error decays completely.
NO_ERROR_CONTROL = 90.0
# Largest step on the path times kappa. Larger steps would check slowly converging cells too rarely.
MAX_STEP = 1.0
LENGTHENING_OF_STEPS, LONGEST_AT_END = 1.5, 8.0
"""Growth factor of the largest step under constant loads while changes decrease, and its limit
times kappa. At the limit a step is a pass to the limit within 0.03 %."""
FRONT = 1.2
"""Difference of A/r0^2 between neighbouring points that indicates a front. Chains of one
direction that rotate by 58 degrees have this difference. The paper's artery has 0.67 at most; tubes
with a front had 1.35 to 1.41."""
STEADY_TOLERANCE = 1e-4
"""Change of A/r0^2 in a time of 1/kappa at which the path ends. Changes of the slowest bodies
seen decay at a twentieth of kappa: the remaining change before the tail is 0.002, a tenth of a
degree."""
MAX_HOLD = 100.0  # largest time under constant loads, times kappa
# Change of A/r0^2 below which the tail is tried, and the factor by which it must decrease
# before the next trial.
NEAR_REST, AGAIN = 0.01, 0.5
# Maximum number of passes to the limit after the path, and the change of A/r0^2 that ends them.
TAIL_PASSES, TAIL = 15, 1e-9
# Largest ratio of two changes in Aitken's extrapolation, which then goes 20 times as far as the
# last change.
LARGEST_RATIO = 0.95


class PathToSteadyState(NamedTuple):
    """Path to the steady state: end, breakpoints, first step, and tolerance in degrees."""

    # `first_hold` is an earlier interval of constant loads, which ends in a first steady state.

    end: float
    stops: Sequence[float]
    first: float
    tolerance: float
    last_load_change: float
    first_hold: tuple[float, float] | None = None


class Homeostasis:
    """Time integration over ramps and constant loads to the steady state, as one step."""

    def __init__(self, stepper: Stepper, plan: PathToSteadyState):
        self.stepper, self.state = stepper, stepper.state
        self.plan = plan
        self.remodeling = stepper.remodeling
        self.remodels = [process for process in stepper.remodels if process.components]
        self.quadrature = self.state.cells.quadrature
        # No row of the path is a result; fronts report points with abrupt changes.
        self.control = StepControl(
            stepper, plan.tolerance, plan.first, plan.stops, MAX_STEP, logging.INFO
        )
        self.steps, self._residual = 0, 0.0
        self._held: Snapshot | None = None  # the first state under constant loads

    def remaining(self) -> list[float]:
        """Return the time of the steady state, unless it was reached."""
        return [self.plan.end] if self.state.time < self.plan.end else []

    def march(self, watchers: Sequence[Watcher] = ()) -> Iterator[Step]:
        """Yield the steady state as one committed step."""
        self.stepper.start(watchers)
        for time in self.remaining():
            yield self.stepper.advance(time, watchers, is_last=True, coupling=self)

    def solve(self, time: float, loads: LoadValues) -> Work:
        """Solve for the equilibrium of forces and of cells."""
        state, work = self.state, Work()
        start, number = state.time, state.number
        self.steps, self._held = 0, None
        remembers = any(process.depends_on_path for process in self.remodels)
        traits = self.stepper.coupling.traits
        coarsens = not (traits.accumulates or self.plan.tolerance >= NO_ERROR_CONTROL or remembers)
        if self.plan.first_hold is not None:
            self._equilibrate_before_growth(*self.plan.first_hold, work)
        held = max(start, self.plan.last_load_change)
        self._integrate(self.control, time, loads, held, coarsens, work)
        if coarsens and self._held is not None and self._largest_jump()[0] > FRONT:
            log.info(
                "the cells have a front, which depends on the path; repeating it with error control"
            )
            state.restore(self._held)
            self._integrate(self.control, time, loads, held, False, work)
        state.complete_step(start, number)
        for case in state.each_case().values():
            case.mark_cells_in_equilibrium()
        self._residual = work.residual
        return work

    def _equilibrate_before_growth(self, held: float, change: float, work: Work) -> None:
        """Integrate to the steady state under constant loads, then start waiting processes."""
        stops = [*(stop for stop in self.plan.stops if stop <= held), self.plan.stops[-1]]
        control = self.control.with_stops(stops)
        with self.stepper.constant_loads_from(held):
            self._integrate(control, stops[-1], self.stepper.load_values(held), held, False, work)
        self.state.mark_cells_in_equilibrium()
        log.info("steady state reached after %d steps, before time %g", self.steps, change)
        for process in self.remodels:
            process.start_at_steady_state(change)
        self.state.complete_step(change, self.state.number)

    def _integrate(
        self,
        control: StepControl,
        time: float,
        loads: LoadValues,
        held: float,
        coarsens: bool,
        work: Work,
    ) -> None:
        """Integrate from the present state to the steady state."""
        # The error of a lagging row vanishes in the steady state, unless the cells reach another
        # one. The steady state of turnover depends on the path.
        state, waiting = self.state, 0.0
        before, longest = np.inf, MAX_STEP
        try_below = NEAR_REST
        for process in self.remodels:
            process.begin_path()
        control.limit(self.plan.tolerance, longest)
        start = held
        for step in control.march():
            self.steps += 1
            work.add(step.work)
            work.substeps += step.work.substeps
            work.residual = step.work.residual
            log.info(
                "path to the steady state: time %g solved in %d Newton iterations",
                step.time,
                step.work.newton_iterations,
            )
            if state.time < held:
                continue
            if coarsens:
                control.limit(NO_ERROR_CONTROL, longest)
            ahead, solved = state.snapshot(), state.equilibrium_cells
            self._held = self._held or ahead
            # The cells of the present stress.
            state.cells.set(solved.dimension_values, solved.axis_values)
            change, residual = self._remaining_change(work.residual), work.residual
            # A step larger than 1/kappa counts as 1/kappa.
            waiting += min(1.0, self.stepper.slowest * (state.time - start))
            start = state.time
            is_over = change <= STEADY_TOLERANCE
            if not is_over and self._has_no_rest(change, waiting):
                return
            if (is_over or change <= try_below) and (self._add_tail(time, loads, work) or is_over):
                return
            work.residual, try_below = residual, min(try_below, AGAIN * change)
            state.restore(ahead)
            if coarsens:
                longer = min(LENGTHENING_OF_STEPS * longest, LONGEST_AT_END)
                longest, before = longer if change < before else MAX_STEP, change
                control.limit(NO_ERROR_CONTROL, longest)

    def _remaining_change(self, residual: float) -> float:
        """Return the largest relative change in a time of 1/kappa."""
        soon = self.state.time + 1 / self.stepper.slowest
        return max(process.remaining_change(soon, residual) for process in self.stepper.remodels)

    def _has_no_rest(self, change: float, waiting: float) -> bool:
        """Return whether the path ends without a steady state, and warn."""
        reasons = [process.steady_state_problem(waiting) for process in self.stepper.remodels]
        if reason := next(filter(None, reasons), ""):
            self._log(logging.WARNING, reason)
            return True
        if waiting > MAX_HOLD:
            text = (
                "the cells have not reached equilibrium: a time of 1/kappa still changes the state "
                "by %.2g of its size. Set time.end to a late time to follow the history"
            )
            self._log(logging.WARNING, text, change)
        return waiting > MAX_HOLD

    # ------------------------------------------------------------ the tail of the decay
    def _add_tail(self, time: float, loads: LoadValues, work: Work) -> bool:
        """Extrapolate the remaining change of the path, and return whether none is left."""
        # Passes to the limit with Aitken's factor, each followed by equilibrium, continue while
        # their change decreases.
        state, factor = self.state, 1.0
        coupling = self.stepper.coupling
        changes = self._changes_to_limit(time, work.residual)
        for _ in range(TAIL_PASSES):
            size = self._size(changes)
            if size <= TAIL:
                return True
            before, residual = state.snapshot(), work.residual
            for process, change in zip(self.remodels, changes, strict=True):
                process.apply_change(change, factor, time, residual)
            soon = state.time + 1 / self.stepper.slowest
            solve = coupling.solve_equilibrium  # type: ignore[attr-defined]
            outcome = attempted(partial(solve, soon, loads, again=True), StepFailure)
            if isinstance(outcome, StepFailure):
                log.info("extrapolation of the path stopped: %s", outcome)
                state.restore(before)
                return False
            work.add(outcome)
            work.substeps, self.steps = work.substeps + outcome.substeps, self.steps + 1
            earlier, changes = changes, self._changes_to_limit(time, outcome.residual)
            if self._size(changes) >= size:
                state.restore(before)
                work.residual = residual
                return False
            work.residual = outcome.residual
            # If a pass reduces the remaining distance by s, the step f d reduces the change d to r
            # d with r = 1 - f (1 - s). The next factor is 1/(1 - s) with s = 1 - (1 - r)/f.
            pairs = zip(earlier, changes, strict=True)
            ratios = [
                self._dot(old, new) / square
                for old, new in pairs
                if (square := self._dot(old, old))
            ]
            ratio = 1 - (1 - max(ratios)) / factor
            factor = 1 / (1 - min(max(ratio, -1.0), LARGEST_RATIO))
        return False

    def _changes_to_limit(self, time: float, residual: float) -> list[Array]:
        """Return the changes to the limit of all remodeling processes."""
        return [
            process.change_to_limit(time, 1 / self.stepper.slowest, residual)
            for process in self.remodels
        ]

    def _size(self, changes: Sequence[Array]) -> float:
        """Return the largest relative change."""
        return max(
            process.size(change) for process, change in zip(self.remodels, changes, strict=True)
        )

    def _dot(self, first: Array, second: Array) -> float:
        """Return the sum of products over all ranks. Collective."""
        return float(self.state.comm.allreduce(float(self.quadrature.owned(first * second).sum())))

    def _largest_jump(self) -> tuple[float, Array]:
        """Return the largest jump of A/r0^2 between near points, and its position. Collective."""
        # All ranks take part, because a neighbour may belong to another rank.
        from scipy.spatial import cKDTree  # imported here, because only these runs need it

        quadrature = self.quadrature
        r0 = assembly.point_values(self.stepper.tissue.end_to_end_length, quadrature)
        tensors = self.state.cells.structure_tensor() / r0[..., None, None] ** 2
        fields = [quadrature.owned(values) for values in (quadrature.coordinates, tensors)]
        all_ranks = zip(*assembly.allgather(quadrature.mesh.comm, fields), strict=True)
        positions, structure = (
            np.concatenate([values.reshape(-1, size) for values in arrays])
            for arrays, size in zip(all_ranks, (3, 9), strict=True)
        )
        count = min(1 + 2 * quadrature.mesh.topology.dim, len(positions))
        _, neighbours = cKDTree(positions).query(positions, np.arange(1, count + 1))
        jumps = np.linalg.norm(structure[neighbours] - structure[:, None], axis=-1)
        point, neighbour = np.unravel_index(int(jumps.argmax()), jumps.shape)
        return float(jumps.max()), (positions[point] + positions[neighbours[point, neighbour]]) / 2

    def _log(self, level: int, text: str, *values: float) -> None:
        if self.state.comm.rank == 0:
            log.log(level, text, *values)

    def remodel(self, time: float) -> float:
        """Log the distance to the cells of the row's own stress, fronts, and slack regions."""
        self.remodeling.predict_limit(time, self._residual)
        quadrature, r0 = self.quadrature, self.remodeling.parameters.largest().end_to_end_length
        distance = self.remodeling.distance() / r0**2
        self._log(
            NOTICE,
            "cells and stress agree to |A_pass - A| = %.2g r0^2, after %d steps",
            distance,
            self.steps,
        )
        jump, position = self._largest_jump()
        if jump > FRONT:
            self._log(
                NOTICE,
                "the cells have a front near %.4g, %.4g, %.4g: A jumps by %.2g r0^2. Its position "
                "depends on the load path, time.tolerance and the mesh (docs/solver.md)",
                *position,
                jump,
            )
        slack = self.remodeling.without_tension(self._residual).reshape(quadrature.shape)
        if fraction := quadrature.mean(slack.astype(float)):
            self._log(
                NOTICE,
                "%.3g %% of the body carries no tension in equilibrium; the cells there depend on "
                "the load path (docs/solver.md)",
                100 * fraction,
            )
        return 0.0
