"""How the linear systems of Newton's method are solved: with every tangent, an earlier factor, or multigrid."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from remodel_fenicsx.fem.assembly import DegreeOne, degree_one, over_ranks, rigid_motions
from remodel_fenicsx.fem.solver_methods import DEFINITE, GENERAL, ProblemOptions, SYMMETRIC, factor_options
from remodel_fenicsx.solver.equilibrium import Equilibrium

if TYPE_CHECKING:
    from mpi4py.MPI import Comm
    from petsc4py.PETSc import Mat, PC, SNES, Vec

Array = NDArray[np.float64]


# ---------------------------------------------------------------- quasi-Newton steps on a kept factor
# L-BFGS, on any number of ranks.

REMEMBERED_PAIRS = 20  # pairs that are remembered
CURVED = 1e-8  # cosine between a step and the change of the residual, below which they say nothing of use


class Secants:
    """Betters the steps of a kept factor by what earlier steps have shown of the present tangent."""

    def __init__(self, comm: MPI.Intracomm) -> None:
        self._comm = comm
        # a step s, the change z of the residual over it, and H z with the kept inverse H; with s . z
        self._pairs: deque[tuple[Array, float]] = deque(maxlen=REMEMBERED_PAIRS)
        self._last: Array | None = None

    def forget(self) -> None:
        """The factor is another one."""
        self.interrupt()
        self._pairs.clear()

    def interrupt(self) -> None:
        """The next step does not follow the last one: another problem, or another place."""
        self._last = None

    def improve(self, x: Vec, residual: Vec, step: Vec) -> bool:
        """Better the step H r (trial: x - step) in place; whether it was changed."""
        now = np.array([x.array_r, residual.array_r, step.array_r])
        if self._last is not None:
            pair = now - self._last
            products = over_ranks(self._comm, pair[:2] @ pair[:2].T, MPI.SUM)
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
        for ((taken, change, _), curvature), weight in zip(self._pairs, reversed(weights), strict=True):
            better += (weight - product(change, better) / curvature) * taken
        step.array[:] = better
        return bool(weights)

    def _product(self, one: Array, other: Array) -> float:
        return float(over_ranks(self._comm, one @ other, MPI.SUM))


log = logging.getLogger(__name__)

UNSYMMETRIC = 1e-10  # relative to the largest row: what a symmetric tangent may be unsymmetric by
OVER = 3  # iterations over which the rate of convergence is taken, but for the first one
SLOW_STEP = 2 / 3  # of `worth`: iterations of a step after which the next one starts with a new factor
MOST_RENEWALS = 6  # of one solve: what needs more is no matter of old factors; Newton's method goes on, as often again

LAST, SURELY = 1e-5, 0.3  # relative, of a linear solve that ends it all: tried down to LAST; share of what is needed


def worth(unknowns: int) -> float:
    """Iterations that a new factor must save, for it costs about as much."""
    # Smaller bodies gain nothing from fewer: the time of 150 steps of 1,881 unknowns is flat between 9 and 16.
    return 12.0 * max(1.0, unknowns / 5616) ** 0.4


class KeptFactor:
    """Factors of an earlier tangent, which PETSc takes as a preconditioner of Python's."""

    comm: Comm = PETSc.COMM_SELF

    def __init__(self) -> None:
        self.preconditioner: PETSc.PC = None
        self._options: ProblemOptions | None = None
        self._kind = ""

    def apply(self, _: PC, x: Vec, y: Vec) -> None:
        """PETSc asks for y, the inverse of the kept tangent times x; NaN where there is none: the solve then fails."""
        if self.preconditioner is None:
            y.set(np.nan)
        else:
            self.preconditioner.apply(x, y)

    def renew(self, matrix: Mat) -> None:
        """Factorise a tangent. Where that fails there are no factors at all, and a log line."""
        symmetric = matrix.isSymmetric(UNSYMMETRIC * matrix.norm(PETSc.NormType.NORM_INFINITY))
        kinds = [DEFINITE, SYMMETRIC, GENERAL] if symmetric else [GENERAL]
        if symmetric and self._was_indefinite():
            kinds.remove(DEFINITE)  # most likely refused again
        for kind in kinds:
            if self._factorised(kind, matrix):
                break

    def is_definite(self, matrix: Mat) -> bool:
        """Whether a symmetric matrix is positive definite: CHOLMOD takes it."""
        taken = self._factorised(DEFINITE, matrix)
        matrix.setOption(PETSc.Mat.Option.SPD, False)  # of others' factors nothing is known
        return taken

    def close(self) -> None:
        """Free PETSc's objects."""
        if self.preconditioner is not None:
            self.preconditioner.destroy()
        if self._options is not None:
            self._options.close()
        self.preconditioner, self._options, self._kind = None, None, ""

    def _was_indefinite(self) -> bool:
        """Whether the kept factor has negative pivots, which MUMPS counts of a symmetric tangent."""
        return self._kind == SYMMETRIC and self.preconditioner.getFactorMatrix().getMumpsInfog(12) > 0

    def _factorised(self, kind: str, matrix: Mat) -> bool:
        if self._kind != kind:
            self.close()
            self._options = ProblemOptions(factor_options(kind), {})
            self.preconditioner, self._kind = PETSc.PC().create(self.comm), kind
            self._options.apply(self.preconditioner)
        matrix.setOption(PETSc.Mat.Option.SPD, kind == DEFINITE)
        self.preconditioner.setOperators(matrix)
        try:
            self.preconditioner.setReusePreconditioner(False)
            self.preconditioner.setUp()
            failed = bool(self.preconditioner.getFailedReason())
            self.preconditioner.setReusePreconditioner(True)  # whatever the matrix becomes
        except PETSc.Error:
            failed = True
        if failed:
            log.info("the tangent cannot be factorised as %s", kind)
            self.close()
        return not failed


class GatheredFactor:
    """The same on several ranks: the first one has the whole tangent and its factors."""

    def __init__(self, comm: Comm):
        self.comm, self.first = comm, KeptFactor()
        self._whole: PETSc.Mat = None  # a matrix of all ranks, whose rows and columns are the first one's
        self._scatter: PETSc.Scatter = None
        self._right: PETSc.Vec = None  # of the first rank; empty on others
        self._answer: PETSc.Vec = None

    def apply(self, _: PC, x: Vec, y: Vec) -> None:
        """As of `KeptFactor`. Collective."""
        self._scatter.scatter(x, self._right, mode=PETSc.ScatterMode.FORWARD)
        if self.comm.rank == 0:
            self.first.apply(_, self._right, self._answer)
        self._scatter.scatter(self._answer, y, mode=PETSc.ScatterMode.REVERSE)

    def renew(self, matrix: Mat) -> None:
        """As of `KeptFactor`. Collective."""
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
        """Free PETSc's objects."""
        self.first.close()
        for thing in (self._whole, self._scatter, self._right, self._answer):
            if thing is not None:
                thing.destroy()
        self._whole = self._scatter = self._right = self._answer = None


def kept_factor(comm: Comm) -> KeptFactor | GatheredFactor:
    """Factors of a matrix of these ranks."""
    return KeptFactor() if comm.size == 1 else GatheredFactor(comm)


class EveryTangent:
    """As PETSc's options say, with the tangent of every iteration.

    Parameters
    ----------
    equilibrium
        Whose tangents they are.
    snes, matrix
        PETSc's solver with its options, and the tangent.
    options
        Those of the problem.

    Examples
    --------
    A solver that counts its tangents (see `SolverMethod`):

    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> from remodel_fenicsx.extend import SOLVER_METHODS, EveryTangent, SolverMethod
    >>> class Counted(EveryTangent):
    ...     tangents = 0
    ...
    ...     def renew(self):
    ...         super().renew()
    ...         Counted.tangents += 1
    >>> SOLVER_METHODS["counted"] = SolverMethod(SOLVER_METHODS["direct"].options, "direct, counted", Counted)
    >>> scene = preset_scene("kuhl-holzapfel-2007", "cube").with_values({"solver.method": "counted", "time.end": 2.0})
    >>> iterations = [step.row["newton_iterations"] for step in Simulation(scene).steps()]
    >>> Counted.tangents == sum(iterations)
    True
    >>> del SOLVER_METHODS["counted"]
    """

    given_up = False  # whether this way leads to nothing
    keeps = False  # whether factors outlast a solve

    def __init__(self, equilibrium: Equilibrium, snes: SNES, matrix: Mat, options: ProblemOptions):
        self.equilibrium, self.snes, self.matrix, self.options = equilibrium, snes, matrix, options
        self.tangents = 0
        self._always = False  # whether what may be kept is made anew in every iteration

    def begin(self) -> None:
        """A solve begins."""

    def tangent(self, norm: float, tolerance: float) -> None:
        """A linear system is about to be solved, at a residual of this norm.

        Parameters
        ----------
        norm
            Of the residual, in the unit of forces.
        tolerance
            Below which the solve ends.
        """
        self.renew()

    def renew(self) -> None:
        """The tangent of the present unknowns."""
        self.equilibrium.assemble_tangent(self.matrix)
        self.tangents += 1

    def improve(self, x: Vec, residual: Vec, step: Vec, is_exact: bool) -> bool:
        """Improve the Newton step in place (the trial state is x - step); returns whether it was changed.

        `is_exact`: the residual at x is that of the prescribed values too.
        """
        return False

    def ended(self, iterations: int) -> None:
        """A solve has ended well."""

    def second_try(self) -> tuple[str, AbstractContextManager[None]] | None:
        """A slower and safer way for a solve that has failed, and in words; None where this was it."""
        return None

    def keep_nothing(self) -> None:
        """From now on no factor is kept from solve to solve; here none is kept at all."""

    @property
    def more_iterations(self) -> int:
        """Times solver.maximum_iterations before a solve has failed."""
        return 1

    @contextmanager
    def _anew(self) -> Iterator[None]:
        """Meanwhile nothing is kept from one iteration to the next."""
        before, self._always = self._always, True
        try:
            yield
        finally:
            self._always = before

    def _set_up(self) -> None:
        """A new preconditioner, of the present tangent, where PETSc keeps the one it has."""
        preconditioner = self.snes.getKSP().getPC()
        preconditioner.setReusePreconditioner(False)
        preconditioner.setOperators(self.matrix)
        preconditioner.setUp()

    def factorisation(self) -> PC | None:
        """PETSc's preconditioner with the factors of the last tangent; None where there are none."""
        preconditioner = self.snes.getKSP().getPC()
        has_factors = self.tangents and preconditioner.getType() in ("lu", "cholesky", "telescope")
        return preconditioner if has_factors else None

    def close(self) -> None:
        """Free PETSc's objects."""


class Multigrid(EveryTangent):
    """GMRES with levels: of degree 1 below degree 2, made anew with each tangent, or kept as PETSc's options say."""

    def __init__(self, equilibrium: Equilibrium, snes: SNES, matrix: Mat, options: ProblemOptions):
        super().__init__(equilibrium, snes, matrix, options)
        self._solver, self._space = snes.getKSP(), equilibrium.state.unknown.function_space
        self._far = self._solver.getTolerances()[0]  # of the method: as Newton's method needs it far away
        self._below: DegreeOne | None = None
        if equilibrium.state.kinematics.reduced:
            return
        given = {name.split("_")[0] for name in options.given}
        self._chooses = "ksp" not in given and "snes_ksp_ew" not in options.given
        if self._space.ufl_element().degree > 1 and not given & {"pc", "mg"}:
            self._below = DegreeOne(self._solver.getPC(), degree_one(self._space), matrix, elastic=True)
            if self._chooses:
                self._solver.setPCSide(PETSc.PC.Side.RIGHT)  # its tolerance is then that of the residual itself
        else:
            matrix.setNearNullSpace(rigid_motions(self._space, matrix))

    def tangent(self, norm: float, tolerance: float) -> None:
        super().tangent(norm, tolerance)
        if self._below is not None and self._chooses:
            last = SURELY * tolerance / norm
            self._solver.setTolerances(rtol=last if last > LAST else self._far)

    def renew(self) -> None:
        super().renew()
        if self._below is not None:
            self._below.renew(self.matrix)
        if self._below is not None or self._always:
            self._set_up()

    def second_try(self) -> tuple[str, AbstractContextManager[None]] | None:
        if self._below is None:
            return "with new levels in every iteration", self._anew()
        if self.snes.getConvergedReason() != PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE:
            return None
        self.close()  # a stiff bulk needs more than degree 1 knows of it, and an error measured by the levels
        self._solver.getPC().setFromOptions()
        self.matrix.setNearNullSpace(rigid_motions(self._space, self.matrix))
        if self._chooses:
            self._solver.setPCSide(PETSc.PC.Side.LEFT)
            self._solver.setNormType(PETSc.KSP.NormType.PRECONDITIONED)
            self._solver.setTolerances(rtol=self._far)
        return "with levels of the matrix, from now on", nullcontext()

    def close(self) -> None:
        if self._below is not None:
            self._below.destroy()
        self._below = None


class Lagged(EveryTangent):
    """Modified Newton with quasi-Newton steps: the tangent is renewed where that costs less than going on without."""

    keeps = True
    _begins_anew = False  # whether each solve has factors of its own, renewed as soon as one iteration says so

    def __init__(self, equilibrium: Equilibrium, snes: SNES, matrix: Mat, options: ProblemOptions):
        super().__init__(equilibrium, snes, matrix, options)
        self.factor = kept_factor(equilibrium.comm)
        self._own = "pc_type" not in options.given
        if self._own:
            preconditioner = snes.getKSP().getPC()
            preconditioner.setType(PETSc.PC.Type.PYTHON)
            preconditioner.setPythonContext(self.factor)
        self.secants = Secants(equilibrium.comm)
        self._before = 0  # tangents before the solve
        self._norms: list[float] = []  # of the residual since the tangent was renewed, of this solve
        self._due = True
        self.worth = worth(matrix.getSize()[0])
        self._spent, self._solves = 0.0, 0  # iterations since the factor was made, its cost included, and solves

    @property
    def more_iterations(self) -> int:
        return 1 if self._always or self._begins_anew else 3

    def keep_nothing(self) -> None:
        self._begins_anew = True

    def begin(self) -> None:
        self._norms, self._due = [], self._due or self._begins_anew
        self._before = self.tangents
        self.secants.interrupt()

    @property
    def given_up(self) -> bool:  # type: ignore[override]
        return self._renewed_over(2 * MOST_RENEWALS)

    def _renewed_over(self, most: int) -> bool:
        """Whether this solve, where factors may be kept, has made more than so many."""
        return not self._always and not self._begins_anew and self.tangents - self._before > most

    def tangent(self, norm: float, tolerance: float) -> None:
        self._norms.append(norm)
        if self._always or self._due or self._renewed_over(MOST_RENEWALS) or self._costs_more(tolerance):
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
        """The next step starts with a new factor after a slow one."""
        # The mean cost of a step, its share of the factor included, is least where the next step would cost more.
        self._spent, self._solves = self._spent + iterations, self._solves + 1
        self._due = self._always or iterations > SLOW_STEP * self.worth or iterations * self._solves > self._spent

    def second_try(self) -> tuple[str, AbstractContextManager[None]] | None:
        return None if self._always else ("with new factors in every iteration", self._anew())

    def _costs_more(self, tolerance: float) -> bool:
        """Whether the iterations that are left cost more than new factors; also where the residual rises."""
        # The first iteration with a factor tells whether the problem is near linear. The second one often is worse, and
        # L-BFGS makes up for it: only three of them tell more.
        since = len(self._norms) - 1
        if since == 0 or (1 < since < OVER and not self._begins_anew):
            return False
        over = 1 if self._begins_anew else min(since, OVER)
        rate = (self._norms[-1] / self._norms[-1 - over]) ** (1 / over)
        return bool(not rate < 1 or np.log(tolerance / self._norms[-1]) / np.log(rate) > self.worth)

    def factorisation(self) -> PC | None:
        if not self._own:
            return super().factorisation()
        return self.snes.getKSP().getPC() if self.tangents else None

    def close(self) -> None:
        self.factor.close()
        self.secants.forget()


def uneven(vector: Vec) -> Vec:
    """The vector, filled with what no symmetry leaves unchanged."""
    first, last = vector.getOwnershipRange()
    vector.array[:] = np.sin(1.0 + np.arange(first, last) * np.sqrt(2.0))
    return vector
