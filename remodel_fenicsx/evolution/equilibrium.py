"""Equilibrium at given loads and cells: forms, PETSc SNES with the consistent tangent, and the guards r < L, J > 0."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import dolfinx.fem
import dolfinx.fem.petsc
import numpy as np
import ufl
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from remodel_fenicsx.fem import jit
from remodel_fenicsx.scene import parameters
from remodel_fenicsx.tissue.cells import UnitCells
from remodel_fenicsx.tissue.chains import CHAINS
from remodel_fenicsx.tissue.energy import Cell, squared_end_to_end_length, strain_energy
from remodel_fenicsx.system.interrupts import Interrupted
from remodel_fenicsx.fem.kinematics import deformation_gradient
from remodel_fenicsx.body.loading import Loading
from remodel_fenicsx.scene.scene import Solver
from remodel_fenicsx.fem.petsc_options import set_options, unused_options

log = logging.getLogger(__name__)

LINE_SEARCH_HALVINGS = 20  # of one Newton step, before the solve is given up


@dataclass(frozen=True)
class Extension:
    """How far a state is from its limits: the largest r/L and the smallest J, and where r/L is largest (reference).

    `stop_signal` is the largest signal number that any rank has received, 0 for none: it travels with this reduction.
    """

    max_chain_extension: float
    min_jacobian: float
    worst_point: tuple[float, float, float]
    stop_signal: int = 0

    @property
    def admissible(self) -> bool:
        """True when every chain is shorter than its contour length and no volume has collapsed; False for NaN."""
        return self.max_chain_extension < 1.0 and self.min_jacobian > 0.0


# by PETSc's SNESConvergedReason; numbers, for the names differ between its versions
FAILURES = {
    -3: "the linear solver failed",
    -4: "forces or parameters are too large or too small for floating-point numbers",
    -6: "the line search found no better state",
    -9: "the residual grew beyond all bounds",
}


@dataclass(frozen=True)
class Solution:
    """Work of a solve."""

    newton_iterations: int
    linear_iterations: int


class SolveFailure(RuntimeError):
    """SNES did not find an admissible equilibrium; the state before the call is restored."""

    def __init__(self, reason: str, newton_iterations: int, linear_iterations: int, extension: Extension):
        super().__init__(reason)
        self.reason = reason
        self.newton_iterations = newton_iterations
        self.linear_iterations = linear_iterations
        self.extension = extension


class EquilibriumProblem:
    """Find u with the internal forces of the cells in balance with the loads.

    Parameters
    ----------
    displacement
        dolfinx vector function: start value and solution.
    loading
        Supports and loads.
    cells
        Unit cells; their quadrature rule is that of the forms.
    material
        Parameters of matrix and chains.
    settings
        Tolerances, limits and PETSc options.
    shares
        The cells as the energy takes them, when not simply `cells` (a blend of two).
    """

    def __init__(
        self,
        displacement: Any,
        loading: Loading,
        cells: UnitCells,
        material: parameters.Material,
        settings: Solver,
        shares: Sequence[Cell] | None = None,
    ):
        self.displacement, self.loading, self.cells = displacement, loading, cells
        self.material, self.settings = material, settings
        self.comm = displacement.function_space.mesh.comm
        # asked on each rank whenever limits are reduced: the signal (SIGINT, SIGTERM) that should end the solve, or 0
        self.stop_signal: Callable[[], int] = lambda: 0
        u, shares = displacement, shares or [cells.ufl_cell]
        test = ufl.TestFunction(u.function_space)
        r0 = cells.settings.end_to_end_length
        F = deformation_gradient(u)
        self.energy = strain_energy(F, shares, material, r0) * cells.quadrature.dx
        internal = ufl.derivative(self.energy, u, test)
        external = loading.external_residual(u, test)
        tangent = ufl.derivative(sum(external, internal), u, ufl.TrialFunction(u.function_space))
        self.internal_form = jit.form(internal)
        self.external_form = jit.form(sum(external[1:], external[0])) if external else None
        self.tangent_form = jit.form(tangent)
        self.energy_form = jit.form(self.energy)
        limits = ufl.as_vector([squared_end_to_end_length(F, shares), ufl.det(F)])
        self._limits = jit.expression(limits, cells.quadrature.points)
        self._create_solver()

    # ------------------------------------------------------------ what users ask
    def solve(self) -> Solution:
        """Solve from the present displacement; on success `displacement` is the solution.

        Raises
        ------
        SolveFailure
            If SNES diverges or stops, or where it would stop at a state with r >= L or J <= 0. `displacement` is then
            what it was before.
        Interrupted
            If a signal asked for the end; `displacement` is restored.
        """
        start = self.displacement.x.array.copy()
        self._pull(self._x)
        self._lost = False
        self._snes.solve(None, self._x)
        self._warn_of_unused_options()
        reason = self._snes.getConvergedReason()
        newton, linear = self._snes.getIterationNumber(), self._snes.getLinearSolveIterations()
        self._push(self._x)
        extension = self.extension()
        if reason < 0 or self._lost or not extension.admissible:
            self.displacement.x.array[:] = start
            if extension.stop_signal:
                raise Interrupted(extension.stop_signal)
            text = self._failure_text(reason, extension)
            raise SolveFailure(text, newton, linear, extension)
        return Solution(newton, linear)

    def extension(self) -> Extension:
        """Largest r/L and smallest J of the present displacement over all points of all ranks."""
        squared, jacobian = self._limit_values()
        quadrature = self.cells.quadrature
        squared, jacobian = quadrature.owned(squared), quadrature.owned(jacobian)
        with np.errstate(invalid="ignore"):
            stretch = np.sqrt(squared) / self.material.contour_length
        stretch = np.where(np.isfinite(stretch), stretch, np.inf)
        jacobian = np.where(np.isfinite(jacobian), jacobian, -np.inf)
        if stretch.size:
            worst = np.unravel_index(int(np.argmax(stretch)), stretch.shape)
            point = quadrature.coordinates[worst]
            local = (float(stretch[worst]), (float(point[0]), float(point[1]), float(point[2])))
        else:
            local = (-np.inf, (np.nan, np.nan, np.nan))
        ranks = self.comm.allgather((*local, float(np.min(jacobian, initial=np.inf)), self.stop_signal()))
        largest, worst_point = max((rank[:2] for rank in ranks), key=lambda pair: pair[0])
        return Extension(largest, min(rank[2] for rank in ranks), worst_point, max(rank[3] for rank in ranks))

    def stored_energy(self) -> float:
        """Integral of W over the body."""
        local = np.real(dolfinx.fem.assemble_scalar(self.energy_form))
        return float(self.comm.allreduce(local, MPI.SUM))

    def squared_lengths(self) -> NDArray[np.float64]:
        """r^2 at all points (cells, points) for the present displacement, in squared link lengths."""
        return self._limit_values()[0]

    # ------------------------------------------------------------ SNES
    def _create_solver(self) -> None:
        self._x = self.displacement.x.petsc_vec.duplicate()
        self._residual = self._x.duplicate()
        self._external = self._x.duplicate()
        self._matrix = dolfinx.fem.petsc.create_matrix(self.tangent_form)
        self._force_scale = 0.0
        # an unloaded body has no forces but rounding: 1e-5 of stiffness times area is a scale in any unit of stress
        chain, r0 = CHAINS[self.material.chain], self.cells.settings.end_to_end_length
        network = self.material.network_modulus * chain.stiffness(r0, self.material.contour_length) * r0**2
        stiffness = self.material.lame_lambda + 2 * self.material.lame_mu + network
        self._rounding_scale = 1e-5 * stiffness * self.loading.domain.size**2
        self._lost = self._options_checked = False
        snes: Any = PETSc.SNES().create(self.comm)
        snes.setFunction(self._assemble_residual, self._residual)
        snes.setJacobian(self._assemble_tangent, self._matrix)
        snes.setTolerances(rtol=0.0, atol=0.0, stol=0.0, max_it=self.settings.maximum_iterations)
        snes.setLineSearchPreCheck(self._keep_admissible)
        set_options(snes, self.settings)
        snes.setConvergenceTest(self._converged)
        self._snes: Any = snes

    def _warn_of_unused_options(self) -> None:
        """Once, after the first solve; on all ranks, for each has a database of options."""
        if self._options_checked:
            return
        self._options_checked = True
        unused = unused_options(self.settings)
        if unused and self.comm.rank == 0:
            log.warning("solver.petsc_options: without effect (misspelt?): %s", ", ".join(unused))

    def _pull(self, x: Any) -> None:
        """Copy the displacement into a PETSc vector."""
        with x.localForm() as local:
            local.array[:] = self.displacement.x.array

    def _push(self, x: Any) -> None:
        """Copy a PETSc vector into the displacement, ghosts included."""
        x.ghostUpdate(addv=PETSc.InsertMode.INSERT, mode=PETSc.ScatterMode.FORWARD)
        with x.localForm() as local:
            self.displacement.x.array[:] = local.array_r

    def _assemble_residual(self, snes: Any, x: Any, residual: Any) -> None:
        """R = internal forces - loads, zero where displacements are prescribed and met.

        Fills R with NaN where the state is not admissible: line searches that know NaN shorten their step, others stop.
        """
        self._push(x)
        for vector, form in ((residual, self.internal_form), (self._external, self.external_form)):
            with vector.localForm() as local:
                local.set(0.0)
            if form is not None:
                dolfinx.fem.petsc.assemble_vector(vector, form)
                vector.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
        # forces at the nodes, reactions included: what the residual must be small against
        self._force_scale = max(residual.norm(), self._external.norm())
        residual.axpy(1.0, self._external)
        bcs = self.loading.boundary_conditions
        if self._prescribed_gap(x) > 1e-13 * self.loading.domain.size:
            # lifting assembles tangents of the constrained cells; it adds exactly zero once x meets the conditions
            with self._external.localForm() as local:
                local.set(0.0)
            dolfinx.fem.petsc.apply_lifting(self._external, [self.tangent_form], bcs=[bcs], x0=[x], alpha=-1.0)
            self._external.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
            residual.axpy(1.0, self._external)
        dolfinx.fem.petsc.set_bc(residual, bcs, x, -1.0)
        extension = self.extension()
        self._lost = not extension.admissible or extension.stop_signal > 0
        if self._lost:
            residual.set(np.nan)

    def _prescribed_gap(self, x: Any) -> float:
        """Largest distance of a prescribed value from its target, over all ranks."""
        with x.localForm() as local:
            values = local.array_r.copy()
        target = values.copy()
        for condition in self.loading.boundary_conditions:
            condition.set(target)
        return self.comm.allreduce(float(np.max(np.abs(target - values), initial=0.0)), MPI.MAX)

    def _assemble_tangent(self, snes: Any, x: Any, matrix: Any, preconditioner: Any) -> None:
        matrix.zeroEntries()
        # mypy sees the other overload of a single-dispatch function
        dolfinx.fem.petsc.assemble_matrix(
            matrix, self.tangent_form, bcs=self.loading.boundary_conditions  # type: ignore[misc]
        )
        matrix.assemble()

    def _keep_admissible(self, x: Any, step: Any) -> bool:
        """Halve the Newton step until r < L and J > 0 everywhere (trial: x - step). True when it changed the step."""
        trial = x.duplicate()
        for halving in range(LINE_SEARCH_HALVINGS + 1):
            trial.waxpy(-1.0, step, x)
            self._push(trial)
            extension = self.extension()
            if extension.admissible or extension.stop_signal:
                break
            step.scale(0.5)
        else:
            log.debug("no admissible step after %d halvings", LINE_SEARCH_HALVINGS)
        trial.destroy()
        if halving:
            log.debug("Newton step shortened to 1/%d to keep r < L and J > 0", 2**halving)
        return halving > 0

    def _converged(self, snes: Any, iteration: int, norms: tuple[float, float, float]) -> int:
        """|R| <= absolute_tolerance + relative_tolerance * |nodal forces|: a scale that does not vanish in a hold."""
        norm = norms[2]
        if not np.isfinite(norm):
            return PETSc.SNES.ConvergedReason.DIVERGED_FNORM_NAN
        scale = max(self._force_scale, self._rounding_scale)
        if norm <= self.settings.absolute_tolerance + self.settings.relative_tolerance * scale:
            return PETSc.SNES.ConvergedReason.CONVERGED_FNORM_ABS
        if iteration >= snes.getTolerances()[3]:
            return PETSc.SNES.ConvergedReason.DIVERGED_MAX_IT
        return PETSc.SNES.ConvergedReason.ITERATING

    # ------------------------------------------------------------ inside
    def _limit_values(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        values = self.cells.quadrature.evaluate(self._limits, (2,))
        return values[..., 0], values[..., 1]

    def _failure_text(self, reason: int, extension: Extension) -> str:
        if reason >= 0 or self._lost:
            return f"reached r/L = {extension.max_chain_extension:.4f}, J = {extension.min_jacobian:.4g}"
        if reason == PETSc.SNES.ConvergedReason.DIVERGED_MAX_IT:
            return f"no equilibrium within {self._snes.getTolerances()[3]} Newton iterations"
        return FAILURES.get(reason, f"SNES stopped with reason {reason}")
