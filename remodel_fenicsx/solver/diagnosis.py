"""Diagnosis of a solve: inertia of the tangent, and causes of failed steps."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import dolfinx.fem
import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from remodel_fenicsx.model.tensors import Array
from remodel_fenicsx.solver.equilibrium import Equilibrium
from remodel_fenicsx.solver.linear import LaggedFactorisation, fill_asymmetric
from remodel_fenicsx.solver.newton import GuardedNewton, SolveFailure

log = logging.getLogger(__name__)


# ---------------------------------------------------------------- inertia of the tangent
# The number of negative eigenvalues, and the lowest eigenvalue with its mode.

# First trial of a lower bound of the spectrum, relative to the smallest diagonal entry.
FIRST_SHIFT = 1e-3
SHIFT_FACTOR = 8.0  # ratio of two successive trials
MOST_SHIFTS = 40
# Largest unsymmetric part, relative to the tangent's norm. Rounding causes 1e-16, a pressure on an
# open face far more.
SYMMETRIC_TO = 1e-9


@dataclass(frozen=True)
class Mode:
    """Lowest eigenvalue and its mode, with the position of its largest displacement."""

    eigenvalue: float
    place: tuple[float, float, float]
    displacement: Array


class FactorisationFailed(ArithmeticError):
    """Failure of MUMPS to factorise the symmetric part, for example for lack of memory."""


class Inertia:
    """Signs of the eigenvalues of an equilibrium's tangent on the free unknowns. Collective."""

    # A tangent whose symmetric part is positive definite has eigenvalues of positive real part. The
    # converse holds for symmetric tangents only. With a follower pressure on an open face, such as
    # that of a strip under tension, the symmetric part may be indefinite although all eigenvalues
    # are positive. A prescribed volume adds a multiplier, and a negative eigenvalue that is not
    # counted. The body is stable at this volume if there is no further one.

    def __init__(self, equilibrium: Equilibrium):
        self.equilibrium = equilibrium
        self._constraints = equilibrium.state.kinematics.number_of_constraints
        self._tangent: PETSc.Mat | None = None
        self._symmetric: PETSc.Mat = None
        self._factorised: PETSc.Mat | None = None
        self._factorisation: PETSc.PC | None = None
        self._is_unsymmetric = False
        self._definite = LaggedFactorisation()

    def close(self) -> None:
        """Free PETSc's objects; the next call makes new ones."""
        for thing in (self._factorisation, self._factorised, self._symmetric, self._tangent):
            if thing is not None:
                thing.destroy()
        self._tangent = self._symmetric = self._factorised = self._factorisation = None
        self._definite.close()

    # ------------------------------------------------------------ eigenvalues
    def negative_eigenvalues(self) -> int:
        """Count the eigenvalues of negative real part."""
        self._assemble()
        # CHOLMOD takes half of MUMPS's time.
        alone = self.equilibrium.comm.size == 1 and not self._constraints
        if alone and self._definite.is_definite(self._symmetric):
            return 0
        number = self._count_eigenvalues_below(self._symmetric) - self._constraints
        if number == 0 or not self._is_unsymmetric:
            return number
        wanted = 1
        while (negative := sum(value < 0 for value in self._lowest(wanted)[0])) >= wanted:
            wanted = min(2 * negative, self._symmetric.getSize()[0])
        return negative

    def lowest(self) -> Mode:
        """Return the eigenvalue of smallest real part, and its mode."""
        self._assemble()
        values, vector = self._lowest(1)
        mode = self._mode(values[0], vector)
        vector.destroy()
        return mode

    def _lowest(self, number: int) -> tuple[list[float], PETSc.Vec]:
        """Return at least `number` smallest real parts of eigenvalues, and the first vector."""
        from slepc4py import SLEPc

        matrix = self._without_prescribed(self._symmetric)
        # Real parts exceed the symmetric part's lowest eigenvalue.
        shift = self._lower_bound(matrix)
        unsymmetric = self._is_unsymmetric and shift < 0
        if unsymmetric:
            matrix.destroy()
            matrix = self._without_prescribed(self._tangent)
        solver = SLEPc.EPS().create(self.equilibrium.comm)
        solver.setOperators(matrix)
        kinds, which = SLEPc.EPS.ProblemType, SLEPc.EPS.Which
        solver.setProblemType(kinds.NHEP if unsymmetric else kinds.HEP)
        solver.setWhichEigenpairs(which.TARGET_REAL if unsymmetric else which.TARGET_MAGNITUDE)
        solver.setTarget(shift)
        solver.setDimensions(number)
        transform = solver.getST()
        transform.setType("sinvert")
        linear = transform.getKSP()
        linear.setType("preonly")
        linear.getPC().setType("lu" if unsymmetric else "cholesky")
        linear.getPC().setFactorSolverType("mumps")
        # The same start on any number of ranks.
        solver.setInitialSpace(fill_asymmetric(matrix.createVecRight()))
        solver.solve()
        if solver.getConverged() < number:
            raise FactorisationFailed("the lowest eigenvalues of the tangent did not converge")
        values = [float(solver.getEigenvalue(i).real) for i in range(solver.getConverged())]
        vector = matrix.createVecRight()
        solver.getEigenvector(0, vector)
        for thing in (solver, matrix):
            thing.destroy()
        return values, vector

    def cosine(self, mode: Mode, direction: Array) -> float:
        """Return the absolute cosine of a mode and another change of the unknowns. Collective."""
        owned = self.equilibrium.state.number_of_owned_unknowns
        both = np.array([mode.displacement, direction])[:, :owned]
        products = self.equilibrium.comm.allreduce(both @ both.T)
        size = np.sqrt(products[0, 0] * products[1, 1])
        return float(abs(products[0, 1]) / max(size, np.finfo(np.float64).tiny))

    # ------------------------------------------------------------ matrices
    def _assemble(self) -> None:
        if self._tangent is None:
            self._tangent = self.equilibrium.create_matrix()
        self.equilibrium.assemble_tangent(self._tangent)
        if self._symmetric is None:
            self._symmetric = self._tangent.transpose(PETSc.Mat())
        else:
            self._tangent.transpose(self._symmetric)
        same = PETSc.Mat.Structure.SAME_NONZERO_PATTERN
        self._symmetric.axpy(-1.0, self._tangent, same)
        self._is_unsymmetric = self._symmetric.norm() > SYMMETRIC_TO * self._tangent.norm()
        self._symmetric.axpy(2.0, self._tangent, same)
        self._symmetric.scale(0.5)

    def _count_eigenvalues_below(self, matrix: PETSc.Mat, shift: float = 0.0) -> int:
        """Count the eigenvalues below `shift` of a matrix with the pattern of the tangent."""
        if self._factorised is None:
            self._factorised = matrix.copy()
        matrix.copy(self._factorised, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        if shift:  # PETSc's own shift would change the pattern on several ranks
            diagonal = matrix.getDiagonal()
            diagonal.shift(-shift)
            self._factorised.setDiagonal(diagonal)
            diagonal.destroy()
        if self._factorisation is None:  # reused: the elimination order is computed once
            self._factorisation = PETSc.PC().create(self.equilibrium.comm)
            # SYM = 2, because the matrix is not marked as positive definite.
            self._factorisation.setType("cholesky")
            self._factorisation.setFactorSolverType("mumps")
            self._factorisation.setOperators(self._factorised)
            self._factorisation.setFactorSetUpSolverType()
            factor = self._factorisation.getFactorMatrix()
            # The last front on one rank; otherwise its pivots are not counted.
            factor.setMumpsIcntl(13, 1)
            factor.setMumpsIcntl(24, 1)  # zero pivots are counted separately
        self._factorisation.setUp()
        factor = self._factorisation.getFactorMatrix()
        if self._factorisation.getFailedReason() or factor.getMumpsInfog(1) < 0:
            raise FactorisationFailed(f"MUMPS stopped with INFOG(1) = {factor.getMumpsInfog(1)}")
        return int(factor.getInertia()[0])

    def _without_prescribed(self, matrix: PETSc.Mat) -> PETSc.Mat:
        """Return a copy whose prescribed unknowns have a large eigenvalue instead of one."""
        matrix, diagonal = matrix.copy(), matrix.getDiagonal()
        held = ~np.isnan(self.equilibrium.prescribed_values()[: diagonal.getLocalSize()])
        largest = matrix.norm(PETSc.NormType.NORM_INFINITY)
        diagonal.array[held] = largest
        matrix.setDiagonal(diagonal)
        diagonal.destroy()
        return matrix

    def _lower_bound(self, matrix: PETSc.Mat) -> float:
        """Return a close lower bound of the eigenvalues that count, or zero if none is negative."""
        if self._count_eigenvalues_below(matrix) <= self._constraints:
            return 0.0
        diagonal = matrix.getDiagonal()
        shift = -FIRST_SHIFT * float(np.abs(diagonal.min()[1]))
        diagonal.destroy()
        for _ in range(MOST_SHIFTS):
            if self._count_eigenvalues_below(matrix, shift) <= self._constraints:
                return shift
            shift *= SHIFT_FACTOR
        raise FactorisationFailed("no lower bound of the eigenvalues")

    def _mode(self, eigenvalue: float, vector: PETSc.Vec) -> Mode:
        state = self.equilibrium.state
        function = dolfinx.fem.Function(state.unknown.function_space)
        owned = vector.getLocalSize()
        function.x.array[:owned] = vector.array_r
        function.x.scatter_forward()
        amplitude = np.linalg.norm(state.kinematics.nodal_displacement(function), axis=1)
        nodes = state.kinematics.nodal_space(state.unknown).tabulate_dof_coordinates()
        largest = self.equilibrium.comm.allreduce(float(np.max(amplitude, initial=0.0)), MPI.MAX)
        # Of nodes that are equal by symmetry the first one in space, for any number of ranks.
        candidates = (np.round(nodes[amplitude >= (1 - 1e-6) * largest], 12) + 0.0).tolist()
        place = min(
            tuple(node) for rank in self.equilibrium.comm.allgather(candidates) for node in rank
        )
        return Mode(eigenvalue, place, function.x.array.copy())


def inertia_without_loads(inertia: Inertia) -> tuple[int, float]:
    """Return negative eigenvalues (number, lowest) of the unloaded body with initial cells."""
    state = inertia.equilibrium.state
    cells = state.cells
    with state.tentative():
        state.unknown.x.array[:] = 0.0
        state.loading.set(dict.fromkeys(state.loading.values, 0.0))
        cells.set(cells.initial_dimensions, cells.initial_axes())
        state.mark_cells_in_equilibrium()
        return inertia.negative_eigenvalues(), inertia.lowest().eigenvalue


# ---------------------------------------------------------------- causes of failed steps
# Causes are distinguished at the last solved state. Each has its own advice.

NEARLY_LOCKED = 0.98  # r/L of locking chains under a prescribed motion
LOCKED = 0.999  # r/L of locking chains under any load
COLLAPSED_JACOBIAN = 0.02  # J of collapsed elements
NEARLY_CRITICAL = 0.1  # lowest eigenvalue, relative to that of the unloaded body
ALONG_THE_MODE = 0.5  # cosine between the last change of the displacement and the mode
NEARLY_SOLVED = 1e3  # largest residual / tolerance that is attributed to the tolerance
MAX_ADVISED_TOLERANCE = 1e-4  # largest relative_tolerance that a message recommends


@dataclass(frozen=True)
class FailureCause:
    """Cause of a failed step, with advice and evidence."""

    kind: str
    advice: str
    finding: str = ""

    def __str__(self) -> str:
        finding = f" ({self.finding})" if self.finding else ""
        return f"{self.kind}{finding}: {self.advice}" if self.kind else self.advice


TOO_LARGE = FailureCause("", "try a smaller time.step, a slower ramp or lower loads")
LIMIT_POINT = FailureCause(
    "limit point",
    "the load approaches the largest that the body can carry; "
    "lower it, or prescribe a displacement or loads.lumen_expansion instead",
)
BIFURCATION = FailureCause(
    "bifurcation",
    "the body buckles or loses its symmetry; lower the load, add supports, "
    'or stop before it with solver.unstable = "stop"',
)
CHAIN_LOCKING = FailureCause(
    "chain locking",
    "chains cannot exceed material.contour_length; prescribe less elongation, or load more slowly",
)
KINEMATIC_LOCKING = FailureCause(
    "kinematic locking",
    "supports and loads reduce the volume of elements to almost zero; "
    "prescribe a smaller motion, or refine the mesh",
)
SOLVER_TOLERANCE = FailureCause(
    "solver tolerance",
    "the residual does not fall below the tolerance; "
    "try a larger solver.maximum_iterations, or a smaller time.step",
)
SEVERAL_SOLUTIONS = FailureCause(
    "several solutions",
    "this solution does not continue the previous branch; try a slower ramp, or lower loads",
)
UNSTABLE = FailureCause(
    "lost stability", 'lower the load, or continue beyond it with solver.unstable = "warn"'
)


def diagnose_failure(
    newton: GuardedNewton,
    failure: SolveFailure | None,
    direction: Array | None = None,
) -> FailureCause:
    """Return the cause of a failure, from the last solved state. Collective."""
    limits = newton.equilibrium.limits()
    if not limits.admissible:
        return TOO_LARGE
    longest, prescribed = limits.max_chain_extension, newton.equilibrium.prescribed_values()
    moved = newton.equilibrium.comm.allreduce(bool(np.any(np.nan_to_num(prescribed))), MPI.LOR)
    if longest > (NEARLY_LOCKED if moved else LOCKED):
        place = ", ".join(f"{c:.4g}" for c in limits.worst_point)
        return replace(
            CHAIN_LOCKING, finding=f"r/L = {longest:.6g} at ({place}) in the last solved state"
        )
    if limits.min_jacobian < COLLAPSED_JACOBIAN:
        return replace(
            KINEMATIC_LOCKING, finding=f"J = {limits.min_jacobian:.3g} in the last solved state"
        )
    inertia = Inertia(newton.equilibrium)
    try:
        cause = _of_the_tangent(inertia, direction)
        # The residual may be near the tolerance beyond a limit point too, at a remote state.
        if failure is None or cause.kind == LIMIT_POINT.kind:
            return cause
        return _of_the_tolerance(failure) or cause
    except FactorisationFailed as reason:
        log.info("the cause of the failed step could not be determined: %s", reason)
        return TOO_LARGE
    finally:
        inertia.close()


def _of_the_tolerance(failure: SolveFailure) -> FailureCause | None:
    """Return advice on the tolerance if the residual is close to it, otherwise None."""
    if not 1.0 < failure.residual_over_tolerance < NEARLY_SOLVED:
        return None
    cause = replace(
        SOLVER_TOLERANCE,
        finding=f"the residual is {failure.residual_over_tolerance:.3g} times the tolerance",
    )
    if failure.relative_residual > MAX_ADVISED_TOLERANCE:
        return cause
    # Twice, because it varies between iterations.
    enough = 10.0 ** np.ceil(np.log10(2 * failure.relative_residual))
    key = f"solver.relative_tolerance = {enough:g}"
    if failure.stagnates:
        return replace(
            cause, advice=f"the residual stagnates at rounding errors; {key} accepts this state"
        )
    return replace(cause, advice=f"{cause.advice}; {key} would accept this state")


def _of_the_tangent(inertia: Inertia, direction: Array | None) -> FailureCause:
    negative, mode = inertia.negative_eigenvalues(), inertia.lowest()
    at_start, unloaded = inertia_without_loads(inertia)
    place = ", ".join(f"{c:.4g}" for c in mode.place)
    finding = f"the lowest eigenvalue of the tangent is {mode.eigenvalue:.3g} "
    finding += f"(unloaded body: {unloaded:.3g}); its mode is largest at ({place})"
    if negative > at_start:
        return replace(BIFURCATION, finding=finding)
    if mode.eigenvalue > NEARLY_CRITICAL * unloaded:
        return TOO_LARGE
    along = direction is not None and inertia.cosine(mode, direction) > ALONG_THE_MODE
    return replace(LIMIT_POINT if along else BIFURCATION, finding=finding)
