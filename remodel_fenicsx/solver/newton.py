"""Newton's method for one equilibrium, with PETSc SNES and the guards r < L and J > 0."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import dolfinx.fem.petsc
import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from remodel_fenicsx.fem.assembly import allreduce
from remodel_fenicsx.fem.solver_methods import (
    AUTO,
    LAGGED,
    ProblemOptions,
    SOLVER_METHODS,
    resolve_auto,
    is_small,
    method_options,
)
from remodel_fenicsx.model.tensors import Array
from remodel_fenicsx.schema.settings import Solver
from remodel_fenicsx.solver.attempts import WITH_FALLBACK, say
from remodel_fenicsx.solver.equilibrium import Equilibrium, StateLimits, PointState
from remodel_fenicsx.solver.linear import FullNewton, cheaper_method, takes_levels
from remodel_fenicsx.state import stress_rounding
from remodel_fenicsx.system.interrupts import Interrupted

log = logging.getLogger(__name__)
T = TypeVar("T")
F = TypeVar("F", bound=Exception)


# ---------------------------------------------------------------- convergence
# The residual must not exceed a tolerance. The tolerance is at least the rounding error.

FORCE_ROUNDINGS = 8.0  # accepted residual as a multiple of the rounding error of assembled forces
# Accepted residual as a multiple of the force due to rounded displacements, whose strain is
# eps |u|/h. On thin and on stiff walls 0.07 to 4 was measured.
ROUNDED_STRAINS = 8.0
# Largest error of a prescribed displacement, relative to the body's size. It needs a tolerance of
# its own, because at constrained dofs the residual is this error, not a force.
PRESCRIBED_TOLERANCE = 1e-10
# Gap, relative to the body's size, below which a Newton step need not correct prescribed values.
PRESCRIBED_ROUNDING = 1e-13
# Residual at which a substep of a change of the cells ends, relative to the nodal forces; the last
# substep has the full tolerance. Jump detection compares the displacements of successive substeps.
# With 1e-3 the quasi-Newton solver stopped too early, and some substeps were mistaken for jumps.
INTERMEDIATE_TOLERANCE = 1e-5
# With r/L above NEARLY_STRAIGHT and a tolerance above COARSE times the nodal forces, the rounding
# error of one point may dominate the tolerance.
NEARLY_STRAIGHT, COARSE = 0.99, 1e-8
# Newton's method stagnates if a residual exceeds this fraction of the residual before it.
STAGNATION = 0.25


class Convergence:
    """Test of |R| <= absolute_tolerance + relative_tolerance |nodal forces|, or rounding error."""

    def __init__(self, equilibrium: Equilibrium, settings: Solver):
        self.equilibrium, self.settings = equilibrium, settings
        quadrature = equilibrium.quadrature
        areas, gradients = quadrature.largest_areas, quadrature.gradients
        self._area = quadrature.norm(areas)
        # A force, if it is multiplied by a stress and a displacement.
        self._area_times_gradient = quadrature.norm(areas * gradients)
        self.force_scale = self.max_chain_extension = self.displacement = 0.0
        self.prescribed_gap, self.intermediate = float("inf"), False
        self.begin()

    def begin(self) -> None:
        """Prepare for a solve: parameters may change between solves, but not within one."""
        self._largest = self.equilibrium.parameters.largest()
        self.set_max_chain_extension(self.max_chain_extension)

    def set_max_chain_extension(self, max_chain_extension: float) -> None:
        """Set the largest r/L of the present state, and the rounding error of its stress."""
        self.max_chain_extension = max_chain_extension
        self._stress_rounding = stress_rounding(self._largest, max_chain_extension)

    def reached(self, norm: float, previous: float) -> bool:
        """Return whether a residual norm is accepted; `previous`: the norm before, or infinity."""
        # The rounding error is computed for the largest r/L and the largest displacement of the
        # body. Near L it may be far above the rounding error of most points. If so (`coarse`), a
        # residual above the requested tolerance is accepted only if Newton's method stagnates.
        # Otherwise this holds only for a residual that rounded displacements alone explain.
        if self.prescribed_gap > PRESCRIBED_TOLERANCE:
            return False
        if self.intermediate and norm <= INTERMEDIATE_TOLERANCE * self.force_scale:
            return True
        tolerance = self.tolerance()
        if norm > tolerance:
            return False
        requested = (
            self.settings.absolute_tolerance + self.settings.relative_tolerance * self.force_scale
        )
        coarse = (
            self.max_chain_extension > NEARLY_STRAIGHT and tolerance > COARSE * self.force_scale
        )
        always_accepted = requested if coarse else self.tolerance(rounded_strains=0.0)
        return norm <= always_accepted or norm > STAGNATION * previous

    def goal(self) -> float:
        """Return the approximate norm of the residual at which the solve ends."""
        intermediate = INTERMEDIATE_TOLERANCE * self.force_scale if self.intermediate else 0.0
        return max(intermediate, self.tolerance())

    def tolerance(self, rounded_strains: float = ROUNDED_STRAINS) -> float:
        """Return the tolerance in the unit of force, at least the rounding error of forces."""
        # Stresses have rounding errors, and so have displacements: in a thin element that is a
        # strain of eps |u|/h.
        relative = self.settings.relative_tolerance * self.force_scale
        area = (
            FORCE_ROUNDINGS * self._area
            + rounded_strains * self.displacement * self._area_times_gradient
        )
        return self.settings.absolute_tolerance + max(relative, self._stress_rounding * area)


# ---------------------------------------------------------------- admissible states
# The limits r < L and J > 0 in the line search of Newton's method.

# Where a Newton step ends with r/L above NEAR_LIMIT, the point must keep at least the fraction
# RESERVE of the 1 - r/L that it had before the step.
NEAR_LIMIT, RESERVE = 0.95, 0.3
NOT_EVALUATED = StateLimits(0.0, 1.0, (np.nan,) * 3)
LINE_SEARCH_HALVINGS = 20  # largest number of halvings of a Newton step to keep r < L and J > 0
# Number of Newton steps in a row, and of halvings of each, after which a solve fails. Solves that
# succeed have at most two such steps; on a thin wall under too much load all steps are that short.
SHORT_STEPS, SHORT_STEP_HALVINGS = 4, 6
# A solve of a large body diverges if its residual exceeds both DIVERGED times the first one and
# half of the residual DIVERGENCE_WINDOW iterations before. Without this limit, the first load step
# of an aorta fails after 13 iterations with a residual 13 times the first one; each iteration has a
# factorisation. Small bodies may take all iterations, because some succeed after such a residual.
DIVERGED, DIVERGENCE_WINDOW = 3.0, 4
# Smallest displacement of a jump, relative to the body's size; for a tube ten radii long this is
# 1 % of its radius.
POSSIBLE_JUMP = 1e-3


@dataclass(eq=False)
class SolverCounts:
    """Work of the solver: iterations and tangents."""

    newton_iterations: int = 0
    linear_iterations: int = 0
    tangents: int = 0  # number of assembled tangents

    def count(self, other: SolverCounts) -> None:
        """Add the work of another solve."""
        self.newton_iterations += other.newton_iterations
        self.linear_iterations += other.linear_iterations
        self.tangents += other.tangents


@dataclass
class Solution(SolverCounts):
    """Result of a successful solve."""

    residual: float = 0.0
    limits: StateLimits = NOT_EVALUATED
    # |solution - start of the step| / |first iterate - start of the step|, by which jumps are
    # detected; 0 for small distances.
    displacement_ratio: float = 0.0


class SolveFailure(RuntimeError, SolverCounts):
    """Failure of SNES to find an admissible equilibrium; the unknowns before it are restored."""

    def __init__(
        self,
        reason: str,
        solution: Solution,
        residual_over_tolerance: float = np.inf,
        relative_residual: float = np.inf,
        stagnates: bool = False,
    ):
        super().__init__(reason)
        self.reason, self.limits = reason, solution.limits
        self.stagnates, self.relative_residual = stagnates, relative_residual
        self.residual_over_tolerance = residual_over_tolerance
        self.count(solution)


def attempted(solve: Callable[[], T], *failures: type[F]) -> T | F:
    """Return the result of a solve, or its failure."""
    try:
        return solve()
    except failures as failed:
        return failed


@dataclass
class _Solve:
    """Data of one solve."""

    step_start: Array  # unknowns at the start of the step
    first_iterate: float | None = None  # its distance from the start of the step
    norm: float = np.inf
    previous: float = np.inf
    inadmissible: bool = False  # also on a request to stop
    # All states whose |dF| from the present iterate is below this are admissible.
    safe_change: float = 0.0
    is_known_admissible: bool = False  # without an evaluation, because safe_change is positive
    short_steps: int = 0  # number of Newton steps in a row that the guards have made very short


# Keys: PETSc's SNESConvergedReason as numbers, because the names differ between its versions.
SNES_REASONS = {
    -3: "the linear solver failed",
    -4: "overflow or NaN in the residual; check units and magnitudes of loads and parameters",
    -6: "the line search did not reduce the residual",
    -8: "the guards r < L and J > 0 made the last Newton steps too short",
    -9: "the residual diverges",
}
DIVERGED_MAX_IT = -5
LARGE = 50_000  # number of unknowns above which an iteration takes seconds


def failure_text(reason: int, iterations: int, limits: StateLimits) -> str:
    """Return why a solve has failed: SNES's reason, or an inadmissible last state."""
    if reason >= 0:
        return (
            f"the state is not admissible: r/L = {limits.max_chain_extension:.4f}, "
            f"J = {limits.min_jacobian:.4g}"
        )
    if reason == DIVERGED_MAX_IT:
        return f"no equilibrium within {iterations} Newton iterations"
    return SNES_REASONS.get(reason, f"SNES stopped with reason {reason}")


class GuardedNewton:
    """Newton's method with guards, from the present unknowns; `close` frees it. Collective."""

    def __init__(self, equilibrium: Equilibrium, settings: Solver, robust: bool = False):
        self.equilibrium, self.settings = equilibrium, settings
        self._robust = robust
        self.unknown = equilibrium.state.unknown
        vector = self.unknown.x
        self._values = vector.array
        self._x = vector.petsc_vec.duplicate()
        self._residual, self._external, self._trial = (self._x.duplicate() for _ in range(3))
        self.convergence = Convergence(equilibrium, settings)
        self._present = _Solve(self._values.copy())
        self._options_checked = False
        self._make_solver()

    def _make_solver(self) -> None:
        """Create PETSc's objects of the method, which serve all steps."""
        equilibrium, settings = self.equilibrium, self.settings
        kinematics, unknowns = equilibrium.state.kinematics, self._x.getSize()
        ranks, is_reduced = equilibrium.comm.size, not kinematics.three_dimensional
        self.method = method = resolve_auto(
            settings.method, unknowns, is_reduced, kinematics.suits_multigrid
        )
        if settings.method == AUTO and method == "iterative":
            self.method = method = cheaper_method(equilibrium)
        # In three dimensions PETSc's LU replaces MUMPS only with 'auto', so that the results of a
        # named method do not depend on the size.
        # A constraint needs pivoting, which PETSc's LU does not have.
        small = is_small(unknowns, is_reduced) and (is_reduced or settings.method == AUTO)
        small &= not kinematics.number_of_constraints
        self._options = ProblemOptions(method_options(method, ranks, small), settings.petsc_options)
        blocked = method == "iterative" and takes_levels(equilibrium, self._options)
        self._matrix = equilibrium.create_matrix(blocked)
        self._uses_safe_change = (
            method == LAGGED
            and not self._robust
            and "snes_linesearch_type" not in self._options.given
            and kinematics.three_dimensional
            and equilibrium.state.dilatation.jacobian is None
        )
        snes: PETSc.SNES = PETSc.SNES().create(equilibrium.comm)
        snes.setFunction(self._assemble_residual, self._residual)
        snes.setJacobian(
            lambda *_: self.linear.tangent(self._present.norm, self.convergence.goal()),
            self._matrix,
        )
        snes.setLineSearchPreCheck(self._keep_admissible)
        snes.setTolerances(rtol=0.0, atol=0.0, stol=0.0, max_it=settings.maximum_iterations)
        self._options.apply(snes)
        # A PETSc option of the user may have changed it.
        self._most_iterations = snes.getTolerances()[3]
        snes.setConvergenceTest(self._converged)
        if unknowns > LARGE:
            snes.setMonitor(self._show)
            snes.setConvergenceHistory(reset=True)
        self._snes: PETSc.SNES = snes
        self.linear: FullNewton = SOLVER_METHODS[method].make_linear(
            equilibrium, snes, self._matrix, self._options
        )
        if self._robust:
            self.linear.disable_reuse()

    def close(self) -> None:
        """Free PETSc's objects and options. Further calls have no effect."""
        if self._snes is None:
            return
        self.linear.close()
        self._snes.destroy()
        self._options.close()
        for thing in (self._matrix, self._x, self._residual, self._external, self._trial):
            thing.destroy()
        self._snes = None

    def solve(self, step_start: Array | None = None, loose_tolerance: bool = False) -> Solution:
        """Solve from the present unknowns, and set them.

        `step_start`: unknowns at the start of the step; by default the present ones. Set
        `loose_tolerance` if further substeps follow; an intermediate tolerance is then enough.
        """
        self.convergence.intermediate = loose_tolerance
        first = attempted(
            partial(self._attempt, step_start, self.linear.iteration_factor), SolveFailure
        )
        if isinstance(first, Solution):
            return first
        second = None if self._present.short_steps >= SHORT_STEPS else self.linear.fallback()
        if second is None:
            raise first
        description, fallback = second
        say(WITH_FALLBACK, first.reason, description)
        with fallback:
            again = attempted(partial(self._attempt, step_start), SolveFailure)
        again.count(first)
        if isinstance(again, SolveFailure):
            raise again
        return again

    def is_admissible_start(self, last_extension: float) -> bool:
        """Return whether a solve may start here: admissible, and not too near to r = L."""
        limits, least = self.equilibrium.limits(), RESERVE * (1 - last_extension)
        near = limits.max_chain_extension > NEAR_LIMIT and 1 - limits.max_chain_extension < least
        return limits.admissible and not near

    def _attempt(self, step_start: Array | None, iteration_factor: int = 1) -> Solution:
        start, tangents = self._values.copy(), self.linear.tangents
        self._snes.setTolerances(max_it=iteration_factor * self._most_iterations)
        self.convergence.begin()
        self._to_petsc(self._x)
        self._present = _Solve(start if step_start is None else step_start)
        self.linear.begin()
        self._snes.solve(None, self._x)
        if not self._options_checked:
            self._warn_of_unused_options()
        reason = self._snes.getConvergedReason()
        self._from_petsc(self._x)
        limits, norm = self.equilibrium.limits(), float(self._snes.getFunctionNorm())
        newton, linear = self._snes.getIterationNumber(), self._snes.getLinearSolveIterations()
        solution = Solution(newton, linear, self.linear.tangents - tangents, norm, limits)
        if reason >= 0 and not self._present.inadmissible and limits.admissible:
            self.linear.ended(newton)
            solution.displacement_ratio = self._displacement_ratio()
            return solution
        self._values[:] = start
        if limits.stop_signal:
            raise Interrupted(limits.stop_signal)
        text = failure_text(0 if self._present.inadmissible else reason, newton, limits)
        scales = self.convergence.tolerance(), self.convergence.force_scale
        over_tolerance, relative = (
            norm / max(scale, float(np.finfo(np.float64).tiny)) for scale in scales
        )
        raise SolveFailure(
            text, solution, over_tolerance, relative, norm > STAGNATION * self._present.previous
        )

    def _displacement_ratio(self) -> float:
        """Return `Solution.displacement_ratio` of the present unknowns. Collective."""
        state, present = self.equilibrium.state, self._present
        change = self._values - present.step_start
        largest = allreduce(state.comm, np.abs(change).max(initial=0.0), MPI.MAX)
        if not present.first_iterate or largest < POSSIBLE_JUMP * state.loading.domain.size:
            return 0.0
        return self._length(change[: state.number_of_owned_unknowns]) / present.first_iterate

    def _length(self, change: Array) -> float:
        """Return the norm over all ranks; `change` holds owned unknowns. Collective."""
        return float(np.sqrt(allreduce(self.equilibrium.comm, float(change @ change), MPI.SUM)))

    def newton_correction(self, equilibrium: Equilibrium, tangents: int) -> Array:
        """Return the Newton step for the residual of `equilibrium`. Collective.

        If no tangent was assembled for this state (`tangents` is 0), it is assembled here. A method
        that reuses factorisations uses its last one instead, if there is one.
        """
        self._to_petsc(self._x)
        equilibrium.assemble_internal(self._residual)
        equilibrium.assemble_external(self._external)
        self._residual.axpy(1.0, self._external)
        dolfinx.fem.petsc.set_bc(
            self._residual, equilibrium.state.loading.boundary_conditions, self._x, -1.0
        )
        if not (self.linear.tangents if self.linear.reuses_factorisation else tangents):
            self.linear.renew()
        solver, direction = self._snes.getKSP(), self._x.duplicate()
        solver.setOperators(self._matrix)
        solver.solve(self._residual, direction)
        direction.ghostUpdate(addv=PETSc.InsertMode.INSERT, mode=PETSc.ScatterMode.FORWARD)
        with direction.localForm() as local:
            values = -local.array_r
        direction.destroy()
        return values

    def _warn_of_unused_options(self) -> None:
        """Warn of unused PETSc options after the first solve. Collective."""
        self._options_checked = True
        unused = self._options.unused()
        if unused and self.equilibrium.comm.rank == 0:
            log.warning("solver.petsc_options: without effect (misspelt?): %s", ", ".join(unused))

    # ------------------------------------------------------------ SNES
    def _show(self, snes: PETSc.SNES, iteration: int, norm: float) -> None:
        self.equilibrium.state.tell(f"Newton iteration {iteration}, residual {norm:.2g}")

    def _to_petsc(self, x: PETSc.Vec) -> None:
        """Copy the unknowns into a PETSc vector."""
        with x.localForm() as local:
            local.array[:] = self._values

    def _from_petsc(self, x: PETSc.Vec) -> None:
        """Copy a PETSc vector into the unknowns, ghosts included."""
        if self.equilibrium.comm.size == 1:
            self._values[:] = x.array_r
            return
        x.ghostUpdate(addv=PETSc.InsertMode.INSERT, mode=PETSc.ScatterMode.FORWARD)
        with x.localForm() as local:
            self._values[:] = local.array_r

    def _assemble_residual(self, snes: PETSc.SNES, x: PETSc.Vec, residual: PETSc.Vec) -> None:
        """Assemble R = internal forces - loads, zero for prescribed displacements that are met."""
        # R is NaN if the state is not admissible. Line searches that handle NaN shorten their step,
        # others stop.
        self._from_petsc(x)
        equilibrium, loading = self.equilibrium, self.equilibrium.state.loading
        equilibrium.assemble_internal(residual)
        equilibrium.assemble_external(self._external)
        # The residual must be small compared with the forces at the nodes, including reactions.
        self.convergence.force_scale = max(residual.norm(), self._external.norm())
        residual.axpy(1.0, self._external)
        self.convergence.prescribed_gap = equilibrium.prescribed_gap() / loading.domain.size
        if self.convergence.prescribed_gap > PRESCRIBED_ROUNDING:
            # Lifting assembles tangents of the constrained elements. It adds exactly zero once x
            # meets the conditions.
            equilibrium.assemble_lifting(self._external, x)
            residual.axpy(1.0, self._external)
        dolfinx.fem.petsc.set_bc(residual, loading.boundary_conditions, x, -1.0)
        present = self._present
        if present.is_known_admissible:
            present.inadmissible = (
                allreduce(equilibrium.comm, equilibrium.state.stop_signal(), MPI.MAX) > 0
            )
        else:
            limits = equilibrium.limits()
            present.inadmissible = not limits.admissible or limits.stop_signal > 0
            if not present.inadmissible:
                self.convergence.set_max_chain_extension(limits.max_chain_extension)
                present.safe_change = (
                    equilibrium.safe_change(NEAR_LIMIT) if self._uses_safe_change else 0.0
                )
        if present.inadmissible:
            residual.set(np.nan)
            return
        self.convergence.displacement = x.norm(PETSc.NormType.NORM_INFINITY)

    def _keep_admissible(self, x: PETSc.Vec, step: PETSc.Vec) -> bool:
        """Halve the step until r < L and J > 0 (trial: x - step). Return whether it changed."""
        # J must be positive on the whole path, because a step that inverts two axes of an element
        # has J > 0 at its end again. Near L each point also keeps a fraction of its 1 - r/L. If
        # a point comes much too near to L, its forces are huge, and each iteration increases its
        # 1 - r/L only by a factor of 1.5.
        met, present = self.convergence.prescribed_gap <= PRESCRIBED_ROUNDING, self._present
        improved = self.linear.improve(x, self._snes.getFunction()[0], step, met)
        if present.first_iterate is None:
            first = x.array_r - step.array_r
            present.first_iterate = self._length(first - present.step_start[: first.size])
        # The largest gradient times the largest nodal step bounds |dF|. No evaluation is needed if
        # all states within the bound are admissible.
        largest = np.sqrt(3) * step.norm(PETSc.NormType.NORM_INFINITY)
        present.safe_change -= self.equilibrium.quadrature.largest_gradient * largest
        present.is_known_admissible = present.safe_change > 0.0
        if present.is_known_admissible:
            return improved
        self._from_petsc(x)
        before, trial = self.equilibrium.evaluate(), self._trial
        for halving in range(LINE_SEARCH_HALVINGS + 1):
            trial.waxpy(-1.0, step, x)
            self._from_petsc(trial)
            after = self.equilibrium.evaluate()
            if after.limits.stop_signal or self._allows(before, after):
                if halving:
                    log.debug("Newton step shortened to 1/%d: r < L and J > 0", 2**halving)
                break
            step.scale(0.5)
        else:
            log.debug(
                "line search failed: no step with r < L and J > 0 after %d halvings",
                LINE_SEARCH_HALVINGS,
            )
        present.short_steps = present.short_steps + 1 if halving >= SHORT_STEP_HALVINGS else 0
        return improved or halving > 0

    def _allows(self, before: PointState, after: PointState) -> bool:
        """Return whether a step is admissible: its end, a margin near L, and J > 0 on its path."""
        near, equilibrium = after.limits.max_chain_extension > NEAR_LIMIT, self.equilibrium
        if not after.limits.admissible:
            return False
        if near and not equilibrium.keeps_margin(
            before.stretches, after.stretches, RESERVE, NEAR_LIMIT
        ):
            return False
        return not equilibrium.inverts_between(before, after)

    def _converged(
        self, snes: PETSc.SNES, iteration: int, norms: tuple[float, float, float]
    ) -> int:
        """Return whether the solve converged, failed (and why), or continues, as a SNES reason."""
        norm = norms[2]
        if not np.isfinite(norm):
            return PETSc.SNES.ConvergedReason.DIVERGED_FNORM_NAN
        present = self._present
        present.previous, present.norm = present.norm if iteration else np.inf, norm
        if self.convergence.reached(norm, present.previous):
            return PETSc.SNES.ConvergedReason.CONVERGED_FNORM_ABS
        if present.short_steps >= SHORT_STEPS:
            return PETSc.SNES.ConvergedReason.DIVERGED_LOCAL_MIN
        residuals, _ = snes.getConvergenceHistory()  # recorded for large bodies alone
        if len(residuals) > DIVERGENCE_WINDOW + 1 and norm > max(
            DIVERGED * residuals[0], residuals[-1 - DIVERGENCE_WINDOW] / 2
        ):
            return PETSc.SNES.ConvergedReason.DIVERGED_DTOL
        if iteration >= snes.getTolerances()[3] or self.linear.given_up:
            return PETSc.SNES.ConvergedReason.DIVERGED_MAX_IT
        return PETSc.SNES.ConvergedReason.ITERATING
