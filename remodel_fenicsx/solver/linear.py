"""Linear solvers of Newton's method: full Newton, lagged factorisation, or multigrid."""

from __future__ import annotations

import logging
import os
from collections import deque
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from remodel_fenicsx._renamed import with_old_names
from remodel_fenicsx.fem.assembly import (
    PMultigrid,
    allreduce,
    prolongation_from_degree_one,
    rigid_body_modes,
)
from remodel_fenicsx.fem.solver_methods import (
    DEFINITE,
    FACTOR_OPTIONS,
    GENERAL,
    LAGGED,
    ProblemOptions,
    SYMMETRIC,
)
from remodel_fenicsx.model.tensors import Array
from remodel_fenicsx.solver.equilibrium import Equilibrium

if TYPE_CHECKING:
    from mpi4py.MPI import Comm
    from petsc4py.PETSc import Mat, PC, SNES, Vec


# ---------------------------------------------------------------- quasi-Newton steps
# L-BFGS with a lagged factorisation, on any number of ranks.

REMEMBERED_PAIRS = 20  # number of stored pairs
CURVED = 1e-8  # smallest cosine between a step and the change of the residual for a pair


class LimitedMemoryUpdate:
    """L-BFGS update of a lagged factorisation, from the residuals of earlier steps."""

    def __init__(self, comm: MPI.Intracomm) -> None:
        self._comm = comm
        # Each pair is a step s, the change z of the residual over it, and H z with the lagged
        # inverse H; with s . z.
        self._pairs: deque[tuple[Array, float]] = deque(maxlen=REMEMBERED_PAIRS)
        self._last: Array | None = None

    def forget(self) -> None:
        """Delete all pairs, because the factorisation is another one."""
        self.interrupt()
        self._pairs.clear()

    def interrupt(self) -> None:
        """Form no pair from the next step, because it does not follow the last one."""
        self._last = None

    def improve(self, x: Vec, residual: Vec, step: Vec) -> bool:
        """Improve the step H r (trial: x - step) in place. Return True if so. Collective."""
        now = np.array([x.array_r, residual.array_r, step.array_r])
        if self._last is not None:
            pair = now - self._last
            products = allreduce(self._comm, pair[:2] @ pair[:2].T, MPI.SUM)
            if products[0, 1] > CURVED * np.sqrt(products[0, 0] * products[1, 1]):
                self._pairs.append((pair, products[0, 1]))
        self._last = now.copy()
        _, right, better = now
        product = np.dot if self._comm.size == 1 else self._product
        weights = []
        for (taken, change, image), curvature in reversed(self._pairs):
            weights.append(product(taken, right) / curvature)
            right -= weights[-1] * change
            better -= weights[-1] * image
        for ((taken, change, _), curvature), weight in zip(
            self._pairs, reversed(weights), strict=True
        ):
            better += (weight - product(change, better) / curvature) * taken
        step.array[:] = better
        return bool(weights)

    def _product(self, one: Array, other: Array) -> float:
        return allreduce(self._comm, one @ other, MPI.SUM)


log = logging.getLogger(__name__)

UNSYMMETRIC = 1e-10  # largest unsymmetric part of a symmetric tangent, relative to the largest row
RATE_WINDOW = 3  # number of iterations for the rate of convergence, except for the first iteration
# Iterations of a step, relative to `worth`, after which the next step factorises first.
SLOW_STEP = 2 / 3
# Number of factorisations in a solve. If it needs more, lagging is not the cause: the solve
# continues as Newton's method for as many more.
MOST_RENEWALS = 6
# Iterations of a linear solve up to which the next one has the same preconditioner. New levels cost
# about as much as seven iterations.
KEPT_LEVELS = 8
# Operations of a factorisation per entry of the tangent up to which a few factorisations cost less
# than multigrid: 6,200 in a branching wall of 250,000 unknowns; 10,700 in a stout one of 306,000,
# where both take about as long.
CHEAP_FACTOR = 10_000
FACTOR_BYTES = 13  # memory of a factorisation per entry of the factor, measured with CHOLMOD

# Relative tolerance of a linear solve that may be the last one: SURELY times the required
# reduction, if above LAST.
LAST, SURELY = 1e-5, 0.3


def refactorisation_cost(unknowns: int) -> float:
    """Return the number of iterations that cost about as much as a factorisation."""
    # Smaller bodies gain nothing from a lower number: 150 steps of 1,881 unknowns take the same
    # time from 9 to 16.
    return 12.0 * max(1.0, unknowns / 5616) ** 0.4


class LaggedFactorisation:
    """Lagged factorisation of an earlier tangent, a Python preconditioner of PETSc."""

    comm: Comm = PETSc.COMM_SELF

    def __init__(self) -> None:
        self.preconditioner: PETSc.PC = None
        self._options: ProblemOptions | None = None
        self._kind = ""

    def apply(self, _: PC, x: Vec, y: Vec) -> None:
        """Apply the lagged factorisation: y = K^-1 x; NaN without one, and the solve fails."""
        if self.preconditioner is None:
            y.set(np.nan)
        else:
            self.preconditioner.apply(x, y)

    def renew(self, matrix: Mat) -> None:
        """Factorise a tangent. If that fails, log it and keep no factorisation."""
        symmetric = matrix.isSymmetric(UNSYMMETRIC * matrix.norm(PETSc.NormType.NORM_INFINITY))
        kinds = [DEFINITE, SYMMETRIC, GENERAL] if symmetric else [GENERAL]
        if symmetric and self._was_indefinite():
            kinds.remove(DEFINITE)  # most likely fails again
        for kind in kinds:
            if self._factorised(kind, matrix):
                break

    @property
    def is_cholesky(self) -> bool:
        """Whether the matrix of the last factorisation is known to be positive definite."""
        return self._kind == DEFINITE

    def is_definite(self, matrix: Mat) -> bool:
        """Return whether CHOLMOD factorises a symmetric matrix, which is then positive definite."""
        taken = self._factorised(DEFINITE, matrix)
        matrix.setOption(PETSc.Mat.Option.SPD, False)  # unknown for other matrices
        return taken

    def close(self) -> None:
        """Free the objects of PETSc."""
        if self.preconditioner is not None:
            self.preconditioner.destroy()
        if self._options is not None:
            self._options.close()
        self.preconditioner, self._options = None, None
        self._kind = ""

    def _was_indefinite(self) -> bool:
        """Return whether MUMPS has counted negative pivots in its LDL^T factorisation."""
        return (
            self._kind == SYMMETRIC and self.preconditioner.getFactorMatrix().getMumpsInfog(12) > 0
        )

    def _factorised(self, kind: str, matrix: Mat) -> bool:
        if self._kind != kind:
            self.close()
            self._options = ProblemOptions(FACTOR_OPTIONS[kind], {})
            self.preconditioner, self._kind = PETSc.PC().create(self.comm), kind
            self._options.apply(self.preconditioner)
        matrix.setOption(PETSc.Mat.Option.SPD, kind == DEFINITE)
        self.preconditioner.setOperators(matrix)
        try:
            self.preconditioner.setReusePreconditioner(False)
            self.preconditioner.setUp()
            failed = bool(self.preconditioner.getFailedReason())
            self.preconditioner.setReusePreconditioner(True)  # for all later matrices
        except PETSc.Error:
            failed = True
        if failed:
            log.info("%s of the tangent failed (tried in this order: Cholesky, LDL^T, LU)", kind)
            self.close()
        return not failed


class GatheredFactor:
    """Lagged factorisation on several ranks: the first one has the whole tangent. Collective."""

    is_cholesky = False  # unknown on ranks without the factorisation

    def __init__(self, comm: Comm):
        self.comm, self.first = comm, LaggedFactorisation()
        # A matrix of all ranks; the first rank owns all rows and columns.
        self._whole: PETSc.Mat = None
        self._scatter: PETSc.Scatter = None
        self._right: PETSc.Vec = None  # on the first rank; empty on others
        self._answer: PETSc.Vec = None

    def apply(self, _: PC, x: Vec, y: Vec) -> None:
        """Apply the factorisation, see `LaggedFactorisation.apply`. Collective."""
        self._scatter.scatter(x, self._right, mode=PETSc.ScatterMode.FORWARD)
        if self.comm.rank == 0:
            self.first.apply(_, self._right, self._answer)
        self._scatter.scatter(self._answer, y, mode=PETSc.ScatterMode.REVERSE)

    def renew(self, matrix: Mat) -> None:
        """Factorise a tangent, see `LaggedFactorisation.renew`. Collective."""
        if self._scatter is None:
            template = matrix.createVecRight()
            self._scatter, self._right = PETSc.Scatter.toZero(template)
            self._answer = self._right.duplicate()
            template.destroy()
        rows = PETSc.IS().createStride(self._right.getLocalSize(), 0, 1, comm=matrix.comm)
        self._whole = matrix.createSubMatrix(rows, rows, submat=self._whole)
        rows.destroy()
        if self.comm.rank == 0:
            self.first.renew(self._whole.getDiagonalBlock())

    def close(self) -> None:
        """Free all objects. Collective."""
        self.first.close()
        for thing in (self._whole, self._scatter, self._right, self._answer):
            if thing is not None:
                thing.destroy()
        self._whole = self._scatter = self._right = self._answer = None


def kept_factor(comm: Comm) -> LaggedFactorisation | GatheredFactor:
    """Return a lagged factorisation for matrices of these ranks."""
    return LaggedFactorisation() if comm.size == 1 else GatheredFactor(comm)


@with_old_names
class FullNewton:
    """Full Newton: linear solves with the tangent of every iteration, by PETSc's options.

    Parameters
    ----------
    equilibrium
        Equilibrium that assembles the tangents.
    snes, matrix
        PETSc's solver with its options, and the tangent.
    options
        Options of the problem.

    Examples
    --------
    A solver that counts its tangents (see `SolverMethod`):

    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> from remodel_fenicsx.extend import SOLVER_METHODS, FullNewton, SolverMethod
    >>> class SolverCounts(FullNewton):
    ...     tangents = 0
    ...
    ...     def renew(self):
    ...         super().renew()
    ...         SolverCounts.tangents += 1
    >>> direct = SOLVER_METHODS["direct"].options
    >>> SOLVER_METHODS["counted"] = SolverMethod(direct, "direct, counted", SolverCounts)
    >>> scene = preset_scene("kuhl-holzapfel-2007", "cube")
    >>> scene = scene.with_values({"solver.method": "counted", "time.end": 2.0})
    >>> iterations = [step.row["newton_iterations"] for step in Simulation(scene).steps()]
    >>> SolverCounts.tangents == sum(iterations)
    True
    >>> del SOLVER_METHODS["counted"]
    """

    given_up = False  # whether the solve shall stop
    reuses_factorisation = False  # whether a factorisation is reused in later solves

    def __init__(self, equilibrium: Equilibrium, snes: SNES, matrix: Mat, options: ProblemOptions):
        self.equilibrium, self.snes = equilibrium, snes
        self.matrix, self.options = matrix, options
        self.tangents = 0

    def begin(self) -> None:
        """Prepare for a new solve."""

    def tangent(self, norm: float, tolerance: float) -> None:
        """Prepare the tangent for a linear solve.

        Parameters
        ----------
        norm
            Norm of the residual, in the unit of force.
        tolerance
            Norm below which the nonlinear solve ends.
        """
        self.renew()

    def renew(self) -> None:
        """Assemble the tangent of the present unknowns. Collective."""
        self.equilibrium.assemble_tangent(self.matrix)
        self.tangents += 1

    def improve(self, x: Vec, residual: Vec, step: Vec, is_exact: bool) -> bool:
        """Improve the Newton step in place (trial state: x - step). Return whether it changed.

        If `is_exact`, the residual at x includes the prescribed values.
        """
        return False

    def ended(self, iterations: int) -> None:
        """Record a successful solve and its number of iterations."""

    def fallback(self) -> tuple[str, AbstractContextManager[None]] | None:
        """Return a slower and safer fallback for a failed solve, with its description, or None."""
        return None

    def disable_reuse(self) -> None:
        """Reuse no factorisation between solves from now on."""

    @property
    def iteration_factor(self) -> int:
        """Factor on the key solver.maximum_iterations."""
        return 1

    def factorisation(self) -> PC | None:
        """Return PETSc's preconditioner with the last factorisation, or None without one."""
        preconditioner = self.snes.getKSP().getPC()
        has_factors = self.tangents and preconditioner.getType() in ("lu", "cholesky", "telescope")
        return preconditioner if has_factors else None

    def close(self) -> None:
        """Free all objects of PETSc."""


def takes_levels(equilibrium: Equilibrium, options: ProblemOptions) -> bool:
    """Return whether multigrid has degree 1 as a level of its own, on a matrix in blocks."""
    state = equilibrium.state
    return (
        not state.kinematics.reduced
        and state.unknown.function_space.ufl_element().degree > 1
        and not any(name[:2] in ("pc", "mg") for name in options.given)
    )


class Multigrid(FullNewton):
    """GMRES with multigrid, and with a factorisation once multigrid has failed."""

    def __init__(self, equilibrium: Equilibrium, snes: SNES, matrix: Mat, options: ProblemOptions):
        super().__init__(equilibrium, snes, matrix, options)
        self._solver = snes.getKSP()
        self._far = self._solver.getTolerances()[0]  # tolerance far from the solution
        self._levels: PMultigrid | None = None
        self._factor: LaggedFactorisation | GatheredFactor | None = None
        space, given = equilibrium.state.unknown.function_space, options.given
        self._chooses = False
        if equilibrium.state.kinematics.reduced:
            return
        self._chooses = not any(name.startswith(("ksp", "snes_ksp_ew")) for name in given)
        if self._chooses:
            # The tolerance is then that of the residual itself.
            self._solver.setPCSide(PETSc.PC.Side.RIGHT)
        if takes_levels(equilibrium, options):
            self._levels = PMultigrid(
                self._solver.getPC(), prolongation_from_degree_one(space), matrix
            )
        else:
            matrix.setNearNullSpace(rigid_body_modes(space, matrix))

    def tangent(self, norm: float, tolerance: float) -> None:
        super().tangent(norm, tolerance)
        if self._chooses:
            last = SURELY * tolerance / norm
            self._solver.setTolerances(rtol=min(last, SURELY) if last > LAST else self._far)

    def renew(self) -> None:
        super().renew()
        if self._factor is not None:
            # Factors take no blocks.
            self._factor.renew(self.matrix.convert(PETSc.Mat.Type.AIJ, PETSc.Mat()))
            return
        if self.tangents > 1 and self._solver.getIterationNumber() <= KEPT_LEVELS:
            return
        if self._levels is not None:
            self._levels.renew(self.matrix)
        preconditioner = self._solver.getPC()
        preconditioner.setReusePreconditioner(False)
        preconditioner.setOperators(self.matrix)
        preconditioner.setUp()
        preconditioner.setReusePreconditioner(True)

    def fallback(self) -> tuple[str, AbstractContextManager[None]] | None:
        failed = self.snes.getConvergedReason() == PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE
        if self._factor is not None or not failed:
            return None
        self.close()
        self._factor = kept_factor(self.equilibrium.comm)
        preconditioner = self._solver.getPC()
        preconditioner.setType(PETSc.PC.Type.PYTHON)
        preconditioner.setPythonContext(self._factor)
        return "with a factorisation from now on", nullcontext()

    def close(self) -> None:
        if self._levels is not None:
            self._levels.destroy()
        if self._factor is not None:
            self._factor.close()
        self._levels = self._factor = None


def cheaper_method(equilibrium: Equilibrium) -> str:
    """Return the method for a large tangent, by the cost of factorising it. Collective."""
    matrix = equilibrium.create_matrix()
    # One megabyte is too little for the factor, so that MUMPS ends after its analysis.
    options = ProblemOptions(FACTOR_OPTIONS[SYMMETRIC] | {"mat_mumps_icntl_23": 1}, {})
    preconditioner = PETSc.PC().create(matrix.comm)
    preconditioner.setOperators(matrix)
    options.apply(preconditioner)
    preconditioner.setUp()
    factor = preconditioner.getFactorMatrix()
    operations, entries = factor.getMumpsRinfog(1), factor.getMumpsInfog(20)
    preconditioner.destroy()
    options.close()
    size = FACTOR_BYTES * (entries if entries > 0 else -1e6 * entries)  # negative: millions
    nonzeros = matrix.getInfo(PETSc.Mat.InfoType.GLOBAL_SUM)["nz_used"]
    matrix.destroy()
    memory = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    is_cheap = operations < CHEAP_FACTOR * nonzeros and size < memory
    method = LAGGED if is_cheap else "iterative"
    log.info(
        "solver.method 'auto' takes %r: a factorisation needs %.1e operations, %.0f for each entry "
        "of the tangent, and %.1f of %.1f GB of free memory",
        method,
        operations,
        operations / nonzeros,
        size / 1e9,
        memory / 1e9,
    )
    return allreduce(equilibrium.comm, method, MPI.MAX)


class Lagged(FullNewton):
    """Modified Newton with L-BFGS: the tangent is renewed if more iterations would cost more."""

    reuses_factorisation = True
    # Whether each solve factorises first, and one slow iteration suffices to do so again.
    _begins_anew = False

    def __init__(self, equilibrium: Equilibrium, snes: SNES, matrix: Mat, options: ProblemOptions):
        super().__init__(equilibrium, snes, matrix, options)
        self.factor = kept_factor(equilibrium.comm)
        self._own = "pc_type" not in options.given
        if self._own:
            preconditioner = snes.getKSP().getPC()
            preconditioner.setType(PETSc.PC.Type.PYTHON)
            preconditioner.setPythonContext(self.factor)
        self.secants = LimitedMemoryUpdate(equilibrium.comm)
        self._always = False  # whether nothing is reused between iterations
        self._before = 0  # number of tangents before the solve
        # Norms of the residual in this solve since the tangent was renewed.
        self._norms: list[float] = []
        self._due = True
        self.worth = refactorisation_cost(matrix.getSize()[0])
        # Iterations, including the cost of the factorisation, and solves since then.
        self._spent, self._solves = 0.0, 0

    @property
    def iteration_factor(self) -> int:
        return 1 if self._always or self._begins_anew else 3

    def disable_reuse(self) -> None:
        self._begins_anew = True

    def begin(self) -> None:
        self._norms, self._due = [], self._due or self._begins_anew
        self._before = self.tangents
        self.secants.interrupt()

    @property
    def given_up(self) -> bool:  # type: ignore[override]
        return self._renewed_over(2 * MOST_RENEWALS)

    def _renewed_over(self, most: int) -> bool:
        """Return whether this solve has renewed the tangent more than `most` times, if it lags."""
        return not self._always and not self._begins_anew and self.tangents - self._before > most

    def tangent(self, norm: float, tolerance: float) -> None:
        self._norms.append(norm)
        if (
            self._always
            or self._due
            or self._renewed_over(MOST_RENEWALS)
            or self._costs_more(tolerance)
        ):
            self.renew()

    def renew(self) -> None:
        super().renew()
        if self._own:
            self.factor.renew(self.matrix)
        self.secants.forget()
        self._norms, self._due = self._norms[-1:], False
        self._spent, self._solves = self.worth, 0

    def improve(self, x: Vec, residual: Vec, step: Vec, is_exact: bool) -> bool:
        if self._always or not is_exact or self._renewed_over(MOST_RENEWALS):
            self.secants.interrupt()
            return False
        return self.secants.improve(x, residual, step)

    def ended(self, iterations: int) -> None:
        """Decide whether the next step starts with a new factorisation."""
        # The mean cost of a step, including that of the factorisation, is smallest if the next step
        # would cost more.
        self._spent, self._solves = self._spent + iterations, self._solves + 1
        self._due = (
            self._always
            or iterations > SLOW_STEP * self.worth
            or iterations * self._solves > self._spent
        )

    def fallback(self) -> tuple[str, AbstractContextManager[None]] | None:
        return (
            None if self._always else ("with a new factorisation in every iteration", self._anew())
        )

    @contextmanager
    def _anew(self) -> Iterator[None]:
        """Reuse nothing between iterations while the block runs."""
        self._always = True
        try:
            yield
        finally:
            self._always = False

    def _costs_more(self, tolerance: float) -> bool:
        """Return whether the remaining iterations cost more than factorising, or diverge."""
        # The first iteration with a factorisation shows whether the problem is nearly linear. The
        # second is often worse, and L-BFGS makes up for it. So the next estimate needs three
        # iterations.
        since = len(self._norms) - 1
        if since == 0 or (1 < since < RATE_WINDOW and not self._begins_anew):
            return False
        over = 1 if self._begins_anew else min(since, RATE_WINDOW)
        rate = (self._norms[-1] / self._norms[-1 - over]) ** (1 / over)
        return bool(not rate < 1 or np.log(tolerance / self._norms[-1]) / np.log(rate) > self.worth)

    def factorisation(self) -> PC | None:
        if not self._own:
            return super().factorisation()
        if self.factor.is_cholesky:  # no direction of it has a negative curvature
            return None
        return self.snes.getKSP().getPC() if self.tangents else None

    def close(self) -> None:
        self.factor.close()
        self.secants.forget()


def fill_asymmetric(vector: Vec) -> Vec:
    """Fill a vector with values that no symmetry leaves unchanged, and return it."""
    first, last = vector.getOwnershipRange()
    vector.array[:] = np.sin(1.0 + np.arange(first, last) * np.sqrt(2.0))
    return vector
