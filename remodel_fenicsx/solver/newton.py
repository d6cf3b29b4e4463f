"""Newton's method for one equilibrium: PETSc SNES with the consistent tangent, and the guards r < L, J > 0."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import dolfinx.fem.petsc
import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from remodel_fenicsx.fem.assembly import over_ranks
from remodel_fenicsx.fem.petsc_options import ProblemOptions
from remodel_fenicsx.fem.solver_methods import AUTO, LAGGED, chosen, is_small, method_options
from remodel_fenicsx.settings import Solver
from remodel_fenicsx.solver.equilibrium import Equilibrium, Look
from remodel_fenicsx.solver.limits import Limits
from remodel_fenicsx.solver.linear import LINEAR_METHODS, EveryTangent
from remodel_fenicsx.solver.solution import Solution, SolveFailure, failure_text
from remodel_fenicsx.state.parameters import stress_rounding
from remodel_fenicsx.system.interrupts import Interrupted

log = logging.getLogger(__name__)

LINE_SEARCH_HALVINGS = 20  # of one Newton step, before the solve is given up
ROUNDINGS = 8.0  # how many times the rounding of assembled forces a residual may be
NOTICEABLE = 1e-3  # of the body's size: displacements that may be a jump; 1 % of the radius of a tube of this length
ROUNDED_STRAINS = 2.0  # the same of the rounding of displacements; on thin walls 0.07 to 0.96 were measured
MET = 1e-13  # of the body's size: prescribed values that are met to rounding
PRESCRIBED_MET = 1e-10  # of the body's size: how far a prescribed displacement may be missed; no force measures it
ON_THE_WAY = 1e-3  # of the nodal forces: residual of a part that others follow
NEAR_LOCKING, KEPT_RESERVE = 0.95, 0.3  # a Newton step that ends above this r/L keeps this share of 1 - r/L
NEARLY_LOCKED, COARSE, GOES_DOWN = 0.99, 1e-8, 0.25  # see GuardedNewton._is_small


class GuardedNewton:
    """Solves an equilibrium from the present unknowns; use `close` (or `with`) when it is needed no more.

    Parameters
    ----------
    equilibrium
        Residual, tangent and limits.
    settings
        Method, tolerances, limits and PETSc options.
    robust
        Take new factors in every iteration, where the method would keep them.

    Attributes
    ----------
    method
        Name of the method, where the settings leave it open.
    """

    def __init__(self, equilibrium: Equilibrium, settings: Solver, robust: bool = False):
        self.equilibrium, self.settings = equilibrium, settings
        self.unknown = equilibrium.state.unknown
        self._values = self.unknown.x.array
        self._x = self.unknown.x.petsc_vec.duplicate()
        unknowns, ranks = self._x.getSize(), equilibrium.comm.size
        reduced = equilibrium.state.kinematics.reduced
        self.method = chosen(settings.method, unknowns, ranks, reduced)
        if robust and self.method == LAGGED:
            self.method = "direct"
        # where a method is named, three dimensions stay with it: its numbers shall not depend on their size
        small = is_small(unknowns, reduced) and (reduced or settings.method == AUTO)
        self._options = ProblemOptions(method_options(self.method, ranks, small), settings.petsc_options)
        self._residual, self._external, self._trial = (self._x.duplicate() for _ in range(3))
        self._matrix = equilibrium.create_matrix()
        self._force_scale = self._extension = 0.0
        self._largest = equilibrium.parameters.largest()
        self._rounds_at, self._rounding = 0.0, (np.nan, 0.0)  # r/L of an admissible state; r/L and its rounding
        areas, gradients = equilibrium.quadrature.largest_areas, equilibrium.quadrature.gradients
        self._area = equilibrium.quadrature.norm(areas)
        self._area_of_gradients = equilibrium.quadrature.norm(areas * gradients)  # per displacement
        self._displacement = 0.0  # largest unknown of an admissible state
        self.on_the_way = False  # whether the solution is only the start of a further one: then it may be coarser
        self._lost, self._gap, self._last_norm = False, np.inf, np.inf
        bounded = self.method == LAGGED and "snes_linesearch_type" not in self._options.given
        self.limits = Limits(equilibrium, bounded)
        self._first: float | None = None  # length of the first Newton step of a solve
        self._looked = False  # whether the limits of the start are known
        self._spared = False  # whether the present trial is admissible by the bound alone
        self._options_checked = False
        snes: Any = PETSc.SNES().create(equilibrium.comm)
        snes.setFunction(self._assemble_residual, self._residual)
        snes.setJacobian(self._assemble_tangent, self._matrix)
        snes.setLineSearchPreCheck(self._keep_admissible)
        snes.setTolerances(rtol=0.0, atol=0.0, stol=0.0, max_it=settings.maximum_iterations)
        self._options.apply(snes)
        self._most_iterations = snes.getTolerances()[3]  # the user's PETSc option may have changed it
        snes.setConvergenceTest(self._converged)
        self._snes: Any = snes
        self._linear = LINEAR_METHODS.get(self.method, EveryTangent)(equilibrium, snes, self._matrix, self._options)

    def close(self) -> None:
        """Free PETSc's objects and take the options out of its database; calling it again does nothing."""
        if self._snes is None:
            return
        self._linear.close()
        for thing in (self._snes, self._matrix, self._x, self._residual, self._external, self._trial):
            thing.destroy()
        self._options.close()
        self._snes = None

    def __enter__(self) -> GuardedNewton:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def solve(self) -> Solution:
        """Solve from the present unknowns; on success they are the solution.

        Raises
        ------
        SolveFailure
            If SNES diverges or stops, or where it would stop at a state with r >= L or J <= 0. The unknowns are then
            what they were before.
        Interrupted
            If a signal asked for the end; the unknowns are restored.
        """
        try:
            return self._attempt(self._linear.more_iterations)
        except SolveFailure as failure:
            second = self._linear.second_try()
            if second is None:
                raise
            words, other_way = second
            log.info("solved once more, %s: %s", words, failure.reason)
            with other_way:
                try:
                    return self._attempt().after(failure)
                except SolveFailure as again:
                    again.count(failure)
                    raise

    def may_start(self) -> bool:
        """Whether the present unknowns, from which `solve` is to start, are admissible."""
        self.limits.forget()
        self._looked = self.limits.look().extension.admissible
        return self._looked

    def _attempt(self, more_iterations: int = 1) -> Solution:
        start, tangents = self._values.copy(), self._linear.tangents
        self._snes.setTolerances(max_it=more_iterations * self._most_iterations)
        # they may be others from solve to solve, not within one
        self._largest, self._rounding = self.equilibrium.parameters.largest(), (np.nan, 0.0)
        self._pull(self._x)
        self._lost, self._spared, self._first = False, False, None
        if not self._looked:
            self.limits.forget()
        self._looked = False
        self._linear.begin()
        self._snes.solve(None, self._x)
        self._warn_of_unused_options()
        reason = self._snes.getConvergedReason()
        newton, linear = self._snes.getIterationNumber(), self._snes.getLinearSolveIterations()
        self._push(self._x)
        extension = self.limits.look().extension if self.limits.bounded else self.equilibrium.extension()
        if reason < 0 or self._lost or not extension.admissible:
            self._values[:] = start
            if extension.stop_signal:
                raise Interrupted(extension.stop_signal)
            norm, tiny = float(self._snes.getFunctionNorm()), float(np.finfo(np.float64).tiny)
            left, relative = norm / max(self._tolerance(), tiny), norm / max(self._force_scale, tiny)
            text, tangents = (
                failure_text(0 if self._lost else reason, newton, extension),
                self._linear.tangents - tangents,
            )
            raise SolveFailure(text, newton, linear, extension, left, tangents, relative)
        self._linear.ended(newton)
        norm, tangents = float(self._snes.getFunctionNorm()), self._linear.tangents - tangents
        return Solution(newton, linear, norm, tangents, extension, self._reach(self._values - start))

    def _reach(self, change: Any) -> float:
        """`Solution.reach` of a solve that has changed the unknowns so."""
        comm, state = self.equilibrium.comm, self.equilibrium.state
        largest = over_ranks(comm, np.abs(change).max(initial=0.0), MPI.MAX)
        if not self._first or largest < NOTICEABLE * state.loading.domain.size:
            return 0.0
        owned = change[: state.number_of_owned_unknowns]
        return float(np.sqrt(over_ranks(comm, owned @ owned, MPI.SUM))) / self._first

    def tangent_direction(self, set_fraction: Callable[[float], None], done: float, distance: float) -> Any:
        """Change of the unknowns per fraction of a change of the problem, at a solved state; one linear solve.

        Parameters
        ----------
        set_fraction, done
            Applies a fraction of the change; the one that is solved. It is applied at the end.
        distance
            Fraction over which the residual's slope is taken.
        """
        self._pull(self._x)
        slope = self._x.duplicate()
        set_fraction(done + distance)
        self.limits.forget()
        self._assemble_residual(self._snes, self._x, slope)
        set_fraction(done)
        self.limits.forget()
        self._assemble_residual(self._snes, self._x, self._residual)
        slope.axpy(-1.0, self._residual)
        self._linear.renew()
        values = self._linear_answer(slope) / distance
        slope.destroy()
        return values

    def answer(self, equilibrium: Equilibrium, tangents: int) -> Any:
        """Change of a solved state's unknowns with which the residual of `equilibrium` vanishes; one linear system.

        `tangents` were assembled for that state: the last one counts, or where there is none a new one.
        """
        self._pull(self._x)
        equilibrium.assemble_internal(self._residual)
        equilibrium.assemble_external(self._external)
        self._residual.axpy(1.0, self._external)
        dolfinx.fem.petsc.set_bc(self._residual, equilibrium.state.loading.boundary_conditions, self._x, -1.0)
        if not (self._linear.tangents if self._linear.keeps else tangents):
            self._linear.renew()
        return self._linear_answer(self._residual)

    def _linear_answer(self, residual: Any) -> Any:
        """Change of the unknowns that the tangent gives for a residual, ghosts included."""
        solver, direction = self._snes.getKSP(), self._x.duplicate()
        solver.setOperators(self._matrix)
        solver.solve(residual, direction)
        direction.ghostUpdate(addv=PETSc.InsertMode.INSERT, mode=PETSc.ScatterMode.FORWARD)
        with direction.localForm() as local:
            values = -local.array_r
        direction.destroy()
        return values

    def factorisation(self) -> Any | None:
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
    def _pull(self, x: Any) -> None:
        """Copy the unknowns into a PETSc vector."""
        with x.localForm() as local:
            local.array[:] = self._values

    def _push(self, x: Any) -> None:
        """Copy a PETSc vector into the unknowns, ghosts included."""
        if self.equilibrium.comm.size == 1:
            self._values[:] = x.array_r
            return
        x.ghostUpdate(addv=PETSc.InsertMode.INSERT, mode=PETSc.ScatterMode.FORWARD)
        with x.localForm() as local:
            self._values[:] = local.array_r

    def _assemble_residual(self, snes: Any, x: Any, residual: Any) -> None:
        """R = internal forces - loads, zero where displacements are prescribed and met.

        Fills R with NaN where the state is not admissible: line searches that know NaN shorten their step, others stop.
        """
        self._push(x)
        equilibrium, loading = self.equilibrium, self.equilibrium.state.loading
        equilibrium.assemble_internal(residual)
        equilibrium.assemble_external(self._external)
        # forces at the nodes, reactions included: what the residual must be small against
        self._force_scale = max(residual.norm(), self._external.norm())
        residual.axpy(1.0, self._external)
        self._gap = equilibrium.prescribed_gap(x) / loading.domain.size
        if self._gap > MET:
            # lifting assembles tangents of the constrained elements; it adds exactly zero once x meets the conditions
            equilibrium.assemble_lifting(self._external, x)
            residual.axpy(1.0, self._external)
        dolfinx.fem.petsc.set_bc(residual, loading.boundary_conditions, x, -1.0)
        if self._spared:
            self._lost = over_ranks(equilibrium.comm, equilibrium.stop_signal(), MPI.MAX) > 0
        else:
            extension = self.limits.look().extension
            self._lost = not extension.admissible or extension.stop_signal > 0
            self._extension = extension.max_chain_extension
        if self._lost:
            residual.set(np.nan)
            return
        self._rounds_at, self._displacement = self._extension, x.norm(PETSc.NormType.NORM_INFINITY)

    def _assemble_tangent(self, snes: Any, x: Any, matrix: Any, preconditioner: Any) -> None:
        self._linear.tangent(self._last_norm, self._tolerance())

    def _keep_admissible(self, x: Any, step: Any) -> bool:
        """Halve the Newton step until r < L and J > 0 everywhere (trial: x - step). True when it changed the step.

        J > 0 all the way there: a step that turns two axes of an element has J > 0 at its end again.
        Near L each point also keeps a share of its 1 - r/L: from a point much too near, where forces are huge, Newton's
        method comes back only by a factor of 1.5 an iteration.
        """
        improved = self._linear.improve(x, self._snes.getFunction()[0], step, self._gap <= MET)
        if self._first is None:
            self._first = float(step.norm())
        self._spared = self.limits.bounded and self.limits.spare(np.sqrt(3) * step.norm(PETSc.NormType.NORM_INFINITY))
        if self._spared:
            return improved
        self._push(x)
        before, trial = self.limits.look(), self._trial
        for halving in range(LINE_SEARCH_HALVINGS + 1):
            trial.waxpy(-1.0, step, x)
            self._push(trial)
            after = self.limits.look()
            if after.extension.stop_signal or self._may_go(before, after):
                break
            step.scale(0.5)
        else:
            log.debug("no admissible step after %d halvings", LINE_SEARCH_HALVINGS)
        if halving:
            log.debug("Newton step shortened to 1/%d to keep r < L and J > 0", 2**halving)
        return improved or halving > 0

    def _may_go(self, before: Look, after: Look) -> bool:
        """Whether a Newton step ends at an admissible state, with some reserve, and turns nothing inside out."""
        if not after.extension.admissible:
            return False
        near = after.extension.max_chain_extension > NEAR_LOCKING
        if near and not self.equilibrium.keeps_reserve(before.stretches, after.stretches, KEPT_RESERVE, NEAR_LOCKING):
            return False
        return not self.equilibrium.turns_inside_out(before.states, after.states)

    def _converged(self, snes: Any, iteration: int, norms: tuple[float, float, float]) -> int:
        """|R| <= absolute_tolerance + relative_tolerance * |nodal forces|: a scale that does not vanish in a hold."""
        norm = norms[2]
        if not np.isfinite(norm):
            return PETSc.SNES.ConvergedReason.DIVERGED_FNORM_NAN
        last, self._last_norm = self._last_norm if iteration else np.inf, norm
        if self._gap <= PRESCRIBED_MET and self._is_small(norm, last):
            return PETSc.SNES.ConvergedReason.CONVERGED_FNORM_ABS
        if iteration >= snes.getTolerances()[3] or self._linear.given_up:
            return PETSc.SNES.ConvergedReason.DIVERGED_MAX_IT
        return PETSc.SNES.ConvergedReason.ITERATING

    def _is_small(self, norm: float, last: float) -> bool:
        """Whether a residual may be accepted; `last`: that of the iteration before.

        Near L the rounding of the worst point may be far above that of all others, and the largest displacement is not
        that of all elements. What is below such a rounding counts as solved only when it goes no further down.
        """
        if self.on_the_way and norm <= ON_THE_WAY * self._force_scale:
            return True
        if norm > self._tolerance():
            return False
        relative = self.settings.absolute_tolerance + self.settings.relative_tolerance * self._force_scale
        coarse = self._extension > NEARLY_LOCKED and self._tolerance() > COARSE * self._force_scale
        certain = relative if coarse else self._tolerance(rounded_strains=0.0)
        return norm <= certain or norm > GOES_DOWN * last

    def _tolerance(self, rounded_strains: float = ROUNDED_STRAINS) -> float:
        """Relative to the forces at the nodes, not below the rounding of forces that add up to nothing there.

        Stresses are rounded, and so are displacements: over a thin element that is a strain of eps |u|/h.
        """
        relative = self.settings.relative_tolerance * self._force_scale
        area = ROUNDINGS * self._area + rounded_strains * self._displacement * self._area_of_gradients
        return self.settings.absolute_tolerance + max(relative, self._stress_rounding() * area)

    def _stress_rounding(self) -> float:
        """At the last admissible state."""
        if self._rounding[0] != self._rounds_at:
            self._rounding = self._rounds_at, stress_rounding(self._largest, self._rounds_at)
        return self._rounding[1]
