"""From one time of the scene to the next: loads, equilibrium, remodeling pass, and the cure where a step is too large.

A step to t sets the loads of t, solves with the cells of t - dt, and lets the remodeling pass make the cells of t.
Where Newton's method cannot go that way in one piece, the change of the cells and then the change of the loads are
applied in parts (docs/theory.md, "Steps that are too large"): the state at t is the same.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

import dolfinx.fem
import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from remodel_fenicsx.scene import parameters
from remodel_fenicsx.tissue.cells import UnitCells
from remodel_fenicsx.tissue.energy import Cell
from remodel_fenicsx.body.loading import Loading, LoadValues
from remodel_fenicsx.evolution.equilibrium import EquilibriumProblem, Extension, Solution, SolveFailure
from remodel_fenicsx.evolution.remodeling import RemodelingPass
from remodel_fenicsx.scene.scene import Solver

log = logging.getLogger(__name__)
Array = NDArray[np.float64]

KEPT_RESERVE = 0.2  # share of 1 - r/L that a part of a remodeling increment leaves at every point


@dataclass
class Work:
    """Solver work of one step, failed attempts included."""

    newton_iterations: int = 0
    linear_iterations: int = 0
    substeps: int = 0

    def add(self, done: Solution | SolveFailure) -> None:
        """Count a solve."""
        self.newton_iterations += done.newton_iterations
        self.linear_iterations += done.linear_iterations


@dataclass(frozen=True)
class SolvedStep:
    """An accepted state: everything about it but the fields themselves, which live in displacement and cells."""

    time: float
    loads: LoadValues
    extension: Extension
    work: Work


class StepFailure(RuntimeError):
    """A step cannot be solved even in the smallest parts; the state is that of the last accepted step."""

    def __init__(self, time: float, stage: str, fraction: float, cause: SolveFailure):
        point = ", ".join(f"{c:.3f}" for c in cause.extension.worst_point)
        super().__init__(
            f"no equilibrium at time {time:g}: {stage} stops at {100 * fraction:.3g} % of the step ({cause.reason}; "
            f"largest r/L = {cause.extension.max_chain_extension:.4f} at ({point}), "
            f"smallest J = {cause.extension.min_jacobian:.4g})"
        )
        self.time = time


class Stepper:
    """Advances displacement and cells together; a step commits both or neither.

    Parameters
    ----------
    displacement, loading, cells, material
        The state and what acts on it.
    remodeling
        The remodeling pass.
    settings
        Solver settings.
    load_values
        Function of time: magnitudes of all loads.
    """

    def __init__(
        self,
        displacement: Any,
        loading: Loading,
        cells: UnitCells,
        material: parameters.Material,
        remodeling: RemodelingPass,
        settings: Solver,
        load_values: Callable[[float], LoadValues],
    ):
        self.displacement, self.loading, self.cells = displacement, loading, cells
        self.material, self.remodeling, self.settings = material, remodeling, settings
        self.load_values = load_values
        self.time = 0.0
        self.problem = EquilibriumProblem(displacement, loading, cells, material, settings)
        # the body starts unloaded; a load that is there from t = 0 on comes with the first step
        loading.set(dict.fromkeys(loading.values, 0.0))
        # cells with which `displacement` is in equilibrium; the cells themselves are one pass ahead of it
        self._solved_dimensions = cells.dimension_values.copy()
        self._solved_axes = cells.axis_values.copy()
        self._blend: _Blend | None = None

    def solve(self, time: float) -> SolvedStep:
        """Equilibrium at `time` with the present cells. The remodeling pass is the caller's next call.

        Raises
        ------
        StepFailure
            If no admissible equilibrium is found; displacement and loads are then those of the last accepted state.
        """
        old_loads, new_loads = dict(self.loading.values), self.load_values(time)
        start = self.displacement.x.array.copy()
        work = Work()
        try:
            if not self.problem.extension().admissible:
                log.info("solving in parts: the remodeled cells have r >= L at the old displacement")
                self._solve_in_parts(time, old_loads, new_loads, work, failure=None)
            else:
                self._solve_in_one(time, old_loads, new_loads, work)
        except BaseException:
            self.displacement.x.array[:] = start
            self.loading.set(old_loads)
            raise
        self._solved_dimensions[:] = self.cells.dimension_values
        self._solved_axes[:] = self.cells.axis_values
        return SolvedStep(time, new_loads, self.problem.extension(), work)

    def remodel(self, time: float) -> float:
        """The remodeling pass with the solved state at `time`; returns its power (`RemodelingPass.apply`)."""
        power = self.remodeling.apply(self.time, time)
        self.time = time
        return power

    # ------------------------------------------------------------ in one piece: the paper's step
    def _solve_in_one(self, time: float, old_loads: LoadValues, new_loads: LoadValues, work: Work) -> None:
        self.loading.set(new_loads)
        try:
            work.add(self.problem.solve())
            work.substeps = 1
        except SolveFailure as failure:
            work.add(failure)
            log.info("solving in parts: %s", failure.reason)
            self._solve_in_parts(time, old_loads, new_loads, work, failure)

    # ------------------------------------------------------------ in parts
    def _solve_in_parts(
        self, time: float, old_loads: LoadValues, new_loads: LoadValues, work: Work, failure: SolveFailure | None
    ) -> None:
        """First the change of the cells, then that of the loads; `failure`: that of the whole step, if it was tried."""
        self.loading.set(old_loads)
        if self._cells_changed():
            if self._blend is None:
                self._blend = _Blend(self)
            blend = self._blend
            blend.load_cells()
            self._advance(time, "the change of the cells", blend.set, blend.problem, work, blend.largest_part)
            failure = None  # the loads have not been tried from here

        def set_load_fraction(fraction: float) -> None:
            self.loading.set({k: old_loads[k] + fraction * (new_loads[k] - old_loads[k]) for k in new_loads})

        self._advance(time, "the change of the loads", set_load_fraction, self.problem, work, failure=failure)
        self.loading.set(new_loads)
        log.info("time %g solved in %d parts", time, work.substeps)

    def _cells_changed(self) -> bool:
        same = np.array_equal(self._solved_dimensions, self.cells.dimension_values) and np.array_equal(
            self._solved_axes, self.cells.axis_values
        )
        return self.problem.comm.allreduce(int(not same)) > 0

    def _advance(
        self,
        time: float,
        stage: str,
        set_fraction: Callable[[float], None],
        problem: EquilibriumProblem,
        work: Work,
        largest_part: Callable[[float], float] = lambda done: 1.0,
        failure: SolveFailure | None = None,
    ) -> None:
        """Go from fraction 0 to 1: half the part after a failure (`failure`: of the whole), twice after a success."""
        done, part = 0.0, 1.0
        if failure is not None:
            part = self._halved(part, time, stage, done, failure)
        while done < 1.0:
            part = min(part, largest_part(done), 1.0 - done)
            set_fraction(1.0 if done + part > 1.0 - 1e-12 else done + part)
            try:
                work.add(problem.solve())
            except SolveFailure as failure:
                work.add(failure)
                part = self._halved(part, time, stage, done, failure)
            else:
                done = 1.0 if done + part > 1.0 - 1e-12 else done + part
                part *= 2
                work.substeps += 1

    def _halved(self, part: float, time: float, stage: str, done: float, failure: SolveFailure) -> float:
        if part / 2 < 2.0**-self.settings.maximum_halvings:
            raise StepFailure(time, stage, done, failure) from failure
        log.debug("%s: %s; next part %g", stage, failure.reason, part / 2)
        return part / 2


class _Blend:
    """Equilibrium with (1 - theta) old + theta new cells in r^2 and in W_rep: the old and the new model at the ends."""

    def __init__(self, stepper: Stepper):
        quadrature, cells = stepper.cells.quadrature, stepper.cells
        self.stepper = stepper
        self.theta = dolfinx.fem.Constant(quadrature.mesh, PETSc.ScalarType(0.0))
        self.old_dimensions = quadrature.function("old_cell_dimensions", (3,))
        self.old_axes = quadrature.function("old_cell_axes", (3, 3))
        shares = [Cell(self.old_dimensions, self.old_axes, 1 - self.theta), cells.ufl_cell._replace(weight=self.theta)]
        self.problem = EquilibriumProblem(
            stepper.displacement, stepper.loading, cells, stepper.material, stepper.settings, shares
        )
        self.problem.stop_signal = lambda: stepper.problem.stop_signal()

    def load_cells(self) -> None:
        """Take over the cells with which the displacement is in equilibrium."""
        quadrature = self.stepper.cells.quadrature
        quadrature.values(self.old_dimensions, (3,))[:] = self.stepper._solved_dimensions
        quadrature.values(self.old_axes, (3, 3))[:] = self.stepper._solved_axes

    def set(self, fraction: float) -> None:
        """theta."""
        self.theta.value = fraction

    def largest_part(self, done: float) -> float:
        """Largest further part of theta that keeps KEPT_RESERVE of 1 - r/L at every point of the present displacement.

        r^2 is linear in theta at a frozen displacement, so the bound is in closed form.
        """
        length = self.stepper.material.contour_length
        quadrature = self.stepper.cells.quadrature
        self.theta.value = done
        now = quadrature.owned(self.problem.squared_lengths())
        self.theta.value = 1.0
        end = quadrature.owned(self.problem.squared_lengths())
        allowed = (length - KEPT_RESERVE * (length - np.sqrt(now))) ** 2
        growth = end - now
        room = np.where(growth > 0, (allowed - now) / np.where(growth > 0, growth, 1.0), np.inf)
        return (1.0 - done) * quadrature.minimum(room)


def times(end: float, step: float) -> Iterator[float]:
    """Times of the scene after t = 0: multiples of step as decimal numbers (3 * 0.1 is 0.3); the last one is end."""
    number_of_steps = round(end / step)
    for number in range(1, number_of_steps):
        yield float(number * Decimal(repr(step)))
    yield end
