"""Newton's method for one equilibrium: PETSc SNES, with the tangent or an older one, and the guards r < L, J > 0."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import dolfinx.fem.petsc
import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from remodel_fenicsx.fem.assembly import over_ranks
from remodel_fenicsx.fem.solver_methods import (
    AUTO,
    LAGGED,
    ProblemOptions,
    SOLVER_METHODS,
    chosen,
    is_small,
    method_options,
)
from remodel_fenicsx.schema.settings import Solver
from remodel_fenicsx.solver.attempts import MADE_ANEW, attempted, say
from remodel_fenicsx.solver.equilibrium import Equilibrium, Extension, Look
from remodel_fenicsx.solver.linear import EveryTangent
from remodel_fenicsx.state import stress_rounding
from remodel_fenicsx.system.interrupts import Interrupted

log = logging.getLogger(__name__)
Array = NDArray[np.float64]


# ---------------------------------------------------------------- when Newton's method has converged
# A residual below a tolerance that no rounding error can pass.

FORCE_ROUNDINGS = 8.0  # how many times the rounding of assembled forces a residual may be
# the same of the rounding of displacements; 0.07 to 4 were measured on thin and on stiff walls. What only this rounding
# allows is accepted where it goes no further down
ROUNDED_STRAINS = 8.0
PRESCRIBED_TOLERANCE = (
    1e-10  # of the body's size: how far a prescribed displacement may be missed; no force measures it
)
PRESCRIBED_ROUNDING = 1e-13  # of the body's size: prescribed values that are met to rounding
# Of the nodal forces: residual of a part that others follow. A part may be 1/256 of a step, and the next one is held
# against its direction: of 1e-3, which quasi-Newton steps stop just below, some were taken for jumps
INTERMEDIATE_TOLERANCE = 1e-5
# Above this r/L the rounding of one point may be more than this share of the nodal forces. A residual below it is then
# accepted only when an iteration leaves more than this share of it
NEARLY_STRAIGHT, COARSE, STAGNATION = 0.99, 1e-8, 0.25


class Convergence:
    """|R| <= absolute_tolerance + relative_tolerance |nodal forces|, not below the rounding of assembled forces."""

    def __init__(self, equilibrium: Equilibrium, settings: Solver):
        self.equilibrium, self.settings = equilibrium, settings
        quadrature = equilibrium.quadrature
        areas, gradients = quadrature.largest_areas, quadrature.gradients
        self._area = quadrature.norm(areas)
        self._area_of_gradients = quadrature.norm(areas * gradients)  # per displacement
        self.force_scale = self.max_chain_extension = self.displacement = 0.0
        self.prescribed_gap, self.intermediate = float("inf"), False
        self.begin()

    def begin(self) -> None:
        """A solve begins: parameters may be others from solve to solve, not within one."""
        self._largest = self.equilibrium.parameters.largest()
        self.extended(self.max_chain_extension)

    def extended(self, max_chain_extension: float) -> None:
        """An admissible state has this largest r/L."""
        self.max_chain_extension = max_chain_extension
        self._stress_rounding = stress_rounding(self._largest, max_chain_extension)

    def reached(self, norm: float, previous: float) -> bool:
        """Whether a residual of this norm is accepted; `previous`: that of the iteration before, infinite at first."""
        # Near L the rounding of the worst point may be far above that of all others, and the largest displacement is
        # not that of all elements. What is below such a rounding is accepted only when it goes no further down.
        if self.prescribed_gap > PRESCRIBED_TOLERANCE:
            return False
        if self.intermediate and norm <= INTERMEDIATE_TOLERANCE * self.force_scale:
            return True
        tolerance = self.tolerance()
        if norm > tolerance:
            return False
        requested = self.settings.absolute_tolerance + self.settings.relative_tolerance * self.force_scale
        coarse = self.max_chain_extension > NEARLY_STRAIGHT and tolerance > COARSE * self.force_scale
        certain = requested if coarse else self.tolerance(rounded_strains=0.0)
        return norm <= certain or norm > STAGNATION * previous

    def goal(self) -> float:
        """Norm of the residual at which the solve ends, about."""
        coarse = INTERMEDIATE_TOLERANCE * self.force_scale if self.intermediate else 0.0
        return max(coarse, self.tolerance())

    def tolerance(self, rounded_strains: float = ROUNDED_STRAINS) -> float:
        """In the unit of force: relative to the nodal forces, not below the rounding of forces that cancel there."""
        # Stresses are rounded, and so are displacements: over a thin element that is a strain of eps |u|/h.
        relative = self.settings.relative_tolerance * self.force_scale
        area = FORCE_ROUNDINGS * self._area + rounded_strains * self.displacement * self._area_of_gradients
        return self.settings.absolute_tolerance + max(relative, self._stress_rounding * area)


# ---------------------------------------------------------------- admissible states
# The limits r < L and J > 0 in the line search of Newton's method.

NEAR_LIMIT, RESERVE = 0.95, 0.3  # a Newton step that ends above this r/L keeps this share of 1 - r/L
NOWHERE = Extension(0.0, 1.0, (np.nan,) * 3)
LINE_SEARCH_HALVINGS = 20  # of one Newton step, before the solve is given up
POSSIBLE_JUMP = 1e-3  # of the body's size: displacements that may be a jump; 1 % of the radius of a tube of this length


@dataclass(eq=False)
class Counted:
    """Work of the solver."""

    newton_iterations: int = 0
    linear_iterations: int = 0
    tangents: int = 0  # that were assembled

    def count(self, other: Counted) -> None:
        """Add the work of another solve."""
        self.newton_iterations += other.newton_iterations
        self.linear_iterations += other.linear_iterations
        self.tangents += other.tangents


@dataclass
class Solution(Counted):
    """How a solve has ended."""

    residual: float = 0.0
    extension: Extension = NOWHERE
    reach: float = 0.0  # how far it is from its origin, over how far the first iterate was; 0 where that says nothing


class SolveFailure(RuntimeError, Counted):
    """SNES did not find an admissible equilibrium; the unknowns before the call are restored."""

    def __init__(
        self,
        reason: str,
        found: Solution,
        residual_over_tolerance: float = np.inf,
        relative_residual: float = np.inf,
        stagnates: bool = False,
    ):
        super().__init__(reason)
        self.reason, self.extension, self.stagnates = reason, found.extension, stagnates
        self.residual_over_tolerance, self.relative_residual = residual_over_tolerance, relative_residual
        self.count(found)


@dataclass
class _Solve:
    """What is known within one solve."""

    origin: Array
    first_iterate: float | None = None
    norm: float = np.inf
    previous: float = np.inf
    inadmissible: bool = False
    room: float = 0.0  # |dF| around the last state that was looked at within which all are admissible
    is_certain: bool = False  # whether the state is within it


# by PETSc's SNESConvergedReason; numbers, for the names differ between its versions
SNES_REASONS = {
    -3: "the linear solver failed",
    -4: "forces or parameters are too large or too small for floating-point numbers",
    -6: "the line search found no better state",
    -9: "the residual grew beyond all bounds",
}
MOST_ITERATIONS = -5


def failure_text(reason: int, iterations: int, extension: Extension) -> str:
    """Why SNES has ended; where it did not fail itself, the state is not admissible."""
    if reason >= 0:
        return f"reached r/L = {extension.max_chain_extension:.4f}, J = {extension.min_jacobian:.4g}"
    if reason == MOST_ITERATIONS:
        return f"no equilibrium within {iterations} Newton iterations"
    return SNES_REASONS.get(reason, f"SNES stopped with reason {reason}")


class GuardedNewton:
    """Solves an equilibrium from the present unknowns; use `close` when it is needed no more."""

    def __init__(self, equilibrium: Equilibrium, settings: Solver, robust: bool = False):
        self.equilibrium, self.settings, self._robust = equilibrium, settings, robust
        self.unknown = equilibrium.state.unknown
        self._values = self.unknown.x.array
        self._x = self.unknown.x.petsc_vec.duplicate()
        self._residual, self._external, self._trial = (self._x.duplicate() for _ in range(3))
        self._matrix = equilibrium.create_matrix()
        self.convergence = Convergence(equilibrium, settings)
        self._present = _Solve(self._values.copy())
        self._options_checked = False
        self._make_solver()

    def _make_solver(self) -> None:
        """PETSc's objects of the method, which a body has for all of its steps."""
        equilibrium, settings, kinematics = self.equilibrium, self.settings, self.equilibrium.state.kinematics
        unknowns, ranks, narrow = self._x.getSize(), equilibrium.comm.size, not kinematics.three_dimensional
        self.method = method = chosen(settings.method, unknowns, narrow, kinematics.suits_multigrid)
        # where a method is named, three dimensions stay with it: its numbers shall not depend on their size
        small = is_small(unknowns, narrow) and (narrow or settings.method == AUTO)
        self._options = ProblemOptions(method_options(method, ranks, small), settings.petsc_options)
        bounded = method == LAGGED and not self._robust and "snes_linesearch_type" not in self._options.given
        self._bounded = bounded and kinematics.three_dimensional and equilibrium.state.dilatation.jacobian is None
        snes: PETSc.SNES = PETSc.SNES().create(equilibrium.comm)
        snes.setFunction(self._assemble_residual, self._residual)
        snes.setJacobian(lambda *_: self._linear.tangent(self._present.norm, self.convergence.goal()), self._matrix)
        snes.setLineSearchPreCheck(self._keep_admissible)
        snes.setTolerances(rtol=0.0, atol=0.0, stol=0.0, max_it=settings.maximum_iterations)
        self._options.apply(snes)
        self._most_iterations = snes.getTolerances()[3]  # the user's PETSc option may have changed it
        snes.setConvergenceTest(self._converged)
        self._snes: PETSc.SNES = snes
        self._linear: EveryTangent = SOLVER_METHODS[method].make_linear(equilibrium, snes, self._matrix, self._options)
        if self._robust:
            self._linear.keep_nothing()

    def close(self) -> None:
        """Free PETSc's objects and take the options out of its database; calling it again does nothing."""
        if self._snes is None:
            return
        self._linear.close()
        self._snes.destroy()
        self._options.close()
        for thing in (self._matrix, self._x, self._residual, self._external, self._trial):
            thing.destroy()
        self._snes = None

    def solve(self, origin: Array | None = None, roughly: bool = False) -> Solution:
        """Solve from the present unknowns; on success they are the solution. `roughly`: others follow."""
        self.convergence.intermediate = roughly
        first = attempted(lambda: self._attempt(origin, self._linear.more_iterations), SolveFailure)
        if isinstance(first, Solution):
            return first
        second = self._linear.second_try()
        if second is None:
            raise first
        words, other_way = second
        say(MADE_ANEW, first.reason, words)
        with other_way:
            again = attempted(lambda: self._attempt(origin), SolveFailure)
        again.count(first)
        if isinstance(again, SolveFailure):
            raise again
        return again

    def may_start(self, last_extension: float) -> bool:
        """Whether the present unknowns, from which `solve` is to start, are admissible and not too near to locking."""
        extension, least = self.equilibrium.extension(), RESERVE * (1 - last_extension)
        near = extension.max_chain_extension > NEAR_LIMIT and 1 - extension.max_chain_extension < least
        return extension.admissible and not near

    def _attempt(self, origin: Array | None, more_iterations: int = 1) -> Solution:
        start, tangents = self._values.copy(), self._linear.tangents
        self._snes.setTolerances(max_it=more_iterations * self._most_iterations)
        self.convergence.begin()
        self._pull(self._x)
        self._present = _Solve(start if origin is None else origin)
        self._linear.begin()
        self._snes.solve(None, self._x)
        self._warn_of_unused_options()
        reason = self._snes.getConvergedReason()
        self._push(self._x)
        extension, norm = self.equilibrium.extension(), float(self._snes.getFunctionNorm())
        newton, linear = self._snes.getIterationNumber(), self._snes.getLinearSolveIterations()
        found = Solution(newton, linear, self._linear.tangents - tangents, norm, extension)
        if reason >= 0 and not self._present.inadmissible and extension.admissible:
            self._linear.ended(newton)
            found.reach = self._reach()
            return found
        self._values[:] = start
        if extension.stop_signal:
            raise Interrupted(extension.stop_signal)
        text = failure_text(0 if self._present.inadmissible else reason, newton, extension)
        scales = self.convergence.tolerance(), self.convergence.force_scale
        left, relative = (norm / max(scale, float(np.finfo(np.float64).tiny)) for scale in scales)
        raise SolveFailure(text, found, left, relative, norm > STAGNATION * self._present.previous)

    def _reach(self) -> float:
        """`Solution.reach` of the present unknowns."""
        comm, state, present = self.equilibrium.comm, self.equilibrium.state, self._present
        change = self._values - present.origin
        largest = over_ranks(comm, np.abs(change).max(initial=0.0), MPI.MAX)
        if not present.first_iterate or largest < POSSIBLE_JUMP * state.loading.domain.size:
            return 0.0
        return self._length(change[: state.number_of_owned_unknowns]) / present.first_iterate

    def _length(self, change: Array) -> float:
        """Norm of a change of the unknowns; of this rank only those that it owns."""
        return float(np.sqrt(over_ranks(self.equilibrium.comm, float(change @ change), MPI.SUM)))

    def answer(self, equilibrium: Equilibrium, tangents: int) -> Array:
        """Change of a solved state's unknowns with which the residual of `equilibrium` vanishes; one linear system."""
        # `tangents` were assembled for that state: the last one counts, or where there is none a new one.
        self._pull(self._x)
        equilibrium.assemble_internal(self._residual)
        equilibrium.assemble_external(self._external)
        self._residual.axpy(1.0, self._external)
        dolfinx.fem.petsc.set_bc(self._residual, equilibrium.state.loading.boundary_conditions, self._x, -1.0)
        if not (self._linear.tangents if self._linear.keeps else tangents):
            self._linear.renew()
        solver, direction = self._snes.getKSP(), self._x.duplicate()
        solver.setOperators(self._matrix)
        solver.solve(self._residual, direction)
        direction.ghostUpdate(addv=PETSc.InsertMode.INSERT, mode=PETSc.ScatterMode.FORWARD)
        with direction.localForm() as local:
            values = -local.array_r
        direction.destroy()
        return values

    def factorisation(self) -> PETSc.PC | None:
        """PETSc's preconditioner with the factors of the last tangent; None where the method does not factorise."""
        return self._linear.factorisation()

    def _warn_of_unused_options(self) -> None:
        """Once, after the first solve; on all ranks, for each has a database of options."""
        if self._options_checked:
            return
        self._options_checked = True
        unused = self._options.unused()
        if unused and self.equilibrium.comm.rank == 0:
            log.warning("solver.petsc_options: without effect (misspelt?): %s", ", ".join(unused))

    # ------------------------------------------------------------ SNES
    def _pull(self, x: PETSc.Vec) -> None:
        """Copy the unknowns into a PETSc vector."""
        with x.localForm() as local:
            local.array[:] = self._values

    def _push(self, x: PETSc.Vec) -> None:
        """Copy a PETSc vector into the unknowns, ghosts included."""
        if self.equilibrium.comm.size == 1:
            self._values[:] = x.array_r
            return
        x.ghostUpdate(addv=PETSc.InsertMode.INSERT, mode=PETSc.ScatterMode.FORWARD)
        with x.localForm() as local:
            self._values[:] = local.array_r

    def _assemble_residual(self, snes: PETSc.SNES, x: PETSc.Vec, residual: PETSc.Vec) -> None:
        """R = internal forces - loads, zero where displacements are prescribed and met."""
        # Fills R with NaN where the state is not admissible: line searches that know NaN shorten their step, others
        # stop.
        self._push(x)
        equilibrium, loading = self.equilibrium, self.equilibrium.state.loading
        equilibrium.assemble_internal(residual)
        equilibrium.assemble_external(self._external)
        # forces at the nodes, reactions included: what the residual must be small against
        self.convergence.force_scale = max(residual.norm(), self._external.norm())
        residual.axpy(1.0, self._external)
        self.convergence.prescribed_gap = equilibrium.prescribed_gap() / loading.domain.size
        if self.convergence.prescribed_gap > PRESCRIBED_ROUNDING:
            # lifting assembles tangents of the constrained elements; it adds exactly zero once x meets the conditions
            equilibrium.assemble_lifting(self._external, x)
            residual.axpy(1.0, self._external)
        dolfinx.fem.petsc.set_bc(residual, loading.boundary_conditions, x, -1.0)
        present = self._present
        if present.is_certain:
            present.inadmissible = over_ranks(equilibrium.comm, equilibrium.state.stop_signal(), MPI.MAX) > 0
        else:
            extension = equilibrium.extension()
            present.inadmissible = not extension.admissible or extension.stop_signal > 0
            if not present.inadmissible:
                self.convergence.extended(extension.max_chain_extension)
                present.room = equilibrium.room(NEAR_LIMIT) if self._bounded else 0.0
        if present.inadmissible:
            residual.set(np.nan)
            return
        self.convergence.displacement = x.norm(PETSc.NormType.NORM_INFINITY)

    def _keep_admissible(self, x: PETSc.Vec, step: PETSc.Vec) -> bool:
        """Halve the Newton step until r < L and J > 0 everywhere (trial: x - step). True when it changed the step."""
        # J > 0 all the way there: a step that turns two axes of an element has J > 0 at its end again. Near L each
        # point also keeps a share of its 1 - r/L: from a point much too near, where forces are huge, Newton's method
        # comes back only by a factor of 1.5 an iteration.
        met, present = self.convergence.prescribed_gap <= PRESCRIBED_ROUNDING, self._present
        improved = self._linear.improve(x, self._snes.getFunction()[0], step, met)
        if present.first_iterate is None:
            first = x.array_r - step.array_r
            present.first_iterate = self._length(first - present.origin[: first.size])
        # so far |dF| goes at most; where that is admissible for certain, nobody looks
        largest = np.sqrt(3) * step.norm(PETSc.NormType.NORM_INFINITY)
        present.room -= self.equilibrium.quadrature.largest_gradient * largest
        present.is_certain = present.room > 0.0
        if present.is_certain:
            return improved
        self._push(x)
        before, trial = self.equilibrium.look(), self._trial
        for halving in range(LINE_SEARCH_HALVINGS + 1):
            trial.waxpy(-1.0, step, x)
            self._push(trial)
            after = self.equilibrium.look()
            if after.extension.stop_signal or self._allows(before, after):
                break
            step.scale(0.5)
        else:
            log.debug("no admissible step after %d halvings", LINE_SEARCH_HALVINGS)
        if halving:
            log.debug("Newton step shortened to 1/%d to keep r < L and J > 0", 2**halving)
        return improved or halving > 0

    def _allows(self, before: Look, after: Look) -> bool:
        """Whether a step may end there: at an admissible state, with a reserve near L, and no J <= 0 on the way."""
        near, equilibrium = after.extension.max_chain_extension > NEAR_LIMIT, self.equilibrium
        if not after.extension.admissible:
            return False
        if near and not equilibrium.keeps_reserve(before.stretches, after.stretches, RESERVE, NEAR_LIMIT):
            return False
        return not equilibrium.turns_inside_out(before, after)

    def _converged(self, snes: PETSc.SNES, iteration: int, norms: tuple[float, float, float]) -> int:
        """SNES asks after every iteration: `Convergence`, or no more iterations."""
        norm = norms[2]
        if not np.isfinite(norm):
            return PETSc.SNES.ConvergedReason.DIVERGED_FNORM_NAN
        present = self._present
        present.previous, present.norm = present.norm if iteration else np.inf, norm
        if self.convergence.reached(norm, present.previous):
            return PETSc.SNES.ConvergedReason.CONVERGED_FNORM_ABS
        if iteration >= snes.getTolerances()[3] or self._linear.given_up:
            return PETSc.SNES.ConvergedReason.DIVERGED_MAX_IT
        return PETSc.SNES.ConvergedReason.ITERATING
