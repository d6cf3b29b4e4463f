"""Inertia of the tangent: how many of its eigenvalues are negative, and the lowest of them with its mode."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import dolfinx.fem
import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from remodel_fenicsx.fem.solver_methods import LARGE
from remodel_fenicsx.solver.equilibrium import Equilibrium
from remodel_fenicsx.solver.linear import kept_factor, uneven

Array = NDArray[np.float64]

FIRST_SHIFT = 1e-3  # of the smallest diagonal entry: where the search for a bound of the spectrum starts
SHIFT_FACTOR = 8.0  # from one trial of it to the next
MOST_SHIFTS = 40


@dataclass(frozen=True)
class Mode:
    """The lowest eigenvalue, and its mode.

    Attributes
    ----------
    eigenvalue
        Of the tangent's symmetric part, in its unit: it depends on the mesh, so compare it with one of the same mesh.
    place
        Reference coordinates of the node where the mode's displacement is largest.
    displacement
        The unknowns of the mode on this rank, ghosts included; of unit length over all ranks.
    """

    eigenvalue: float
    place: tuple[float, float, float]
    displacement: Array


class FactorisationFailed(ArithmeticError):
    """MUMPS could not factorise the symmetric part, for want of memory say."""


class Inertia:
    """Of the symmetric part of an equilibrium's tangent on the free unknowns, at the present unknowns, cells and loads.

    CHOLMOD, three times as fast, takes it if none is negative. Otherwise MUMPS factorises it as L D L^T (SYM = 2), and
    by Sylvester's law D has as many negative eigenvalues as the matrix.
    Prescribed unknowns do not count: only motions that the supports allow are asked about.

    Parameters
    ----------
    equilibrium
        Whose tangent it is. PETSc's objects are made at the first question and kept until `close`.
    """

    def __init__(self, equilibrium: Equilibrium):
        self.equilibrium = equilibrium
        self._tangent: Any = None
        self._symmetric: Any = None
        self._factorised: Any = None
        self._factorisation: Any = None
        self._definite = kept_factor(equilibrium.comm)

    def close(self) -> None:
        """Free PETSc's objects; the next question makes new ones."""
        for thing in (self._factorisation, self._factorised, self._symmetric, self._tangent):
            if thing is not None:
                thing.destroy()
        self._tangent = self._symmetric = self._factorised = self._factorisation = None
        self._definite.close()

    # ------------------------------------------------------------ questions
    def negative_eigenvalues(self) -> int:
        """How many there are.

        Raises
        ------
        FactorisationFailed
            If MUMPS gives up.
        """
        self._assemble()
        kept = self._symmetric.getSize()[0] <= LARGE  # of larger ones MUMPS on all ranks takes less time and memory
        if kept and self._definite.is_definite(self._symmetric):
            return 0
        return self._negative_of(self._symmetric)

    def lowest(self) -> Mode:
        """The lowest eigenvalue and its mode, by Krylov-Schur iterations (SLEPc) with the inverse about a lower bound.

        Raises
        ------
        FactorisationFailed
            If MUMPS gives up, or no eigenvalue is found.
        """
        from slepc4py import SLEPc

        self._assemble()
        matrix = self._without_prescribed()
        shift = self._lower_bound(matrix)
        solver = SLEPc.EPS().create(self.equilibrium.comm)
        solver.setOperators(matrix)
        solver.setProblemType(SLEPc.EPS.ProblemType.HEP)
        solver.setWhichEigenpairs(SLEPc.EPS.Which.TARGET_MAGNITUDE)  # all others lie above the bound too
        solver.setTarget(shift)
        transform = solver.getST()
        transform.setType("sinvert")
        linear = transform.getKSP()
        linear.setType("preonly")
        linear.getPC().setType("cholesky")
        linear.getPC().setFactorSolverType("mumps")
        solver.setInitialSpace(uneven(matrix.createVecRight()))  # as everywhere: the same on any number of ranks
        solver.solve()
        if solver.getConverged() < 1:
            raise FactorisationFailed("no eigenvalue was found")
        vector = matrix.createVecRight()
        value = float(solver.getEigenpair(0, vector).real)
        mode = self._mode(value, vector)
        for thing in (solver, vector, matrix):
            thing.destroy()
        return mode

    def cosine(self, mode: Mode, direction: Array) -> float:
        """Of the angle between a mode and another change of the unknowns, without its sign."""
        owned = self.equilibrium.state.number_of_owned_unknowns
        mine, other = mode.displacement[:owned], direction[:owned]
        products = self.equilibrium.comm.allreduce(np.array([mine @ other, mine @ mine, other @ other]), MPI.SUM)
        return float(abs(products[0]) / np.sqrt(max(products[1] * products[2], np.finfo(np.float64).tiny)))

    # ------------------------------------------------------------ matrices
    def _assemble(self) -> None:
        if self._tangent is None:
            self._tangent = self.equilibrium.create_matrix()
        self.equilibrium.assemble_tangent(self._tangent)
        if self._symmetric is None:
            self._symmetric = self._tangent.transpose(PETSc.Mat())
        else:
            self._tangent.transpose(self._symmetric)
        self._symmetric.axpy(1.0, self._tangent, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        self._symmetric.scale(0.5)

    def _negative_of(self, matrix: Any, shift: float = 0.0) -> int:
        """Eigenvalues below `shift` of a matrix that has the pattern of the tangent."""
        if self._factorised is None:
            self._factorised = matrix.copy()
        matrix.copy(self._factorised, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        if shift:  # PETSc's own shift would be a change of the pattern on several ranks, and a new factorisation
            diagonal = matrix.getDiagonal()
            diagonal.shift(-shift)
            self._factorised.setDiagonal(diagonal)
            diagonal.destroy()
        if self._factorisation is None:  # kept: the order of elimination is found once
            self._factorisation = PETSc.PC().create(self.equilibrium.comm)
            self._factorisation.setType("cholesky")  # SYM = 2 as long as nobody calls the matrix positive definite
            self._factorisation.setFactorSolverType("mumps")
            self._factorisation.setOperators(self._factorised)
            self._factorisation.setFactorSetUpSolverType()
            factor = self._factorisation.getFactorMatrix()
            factor.setMumpsIcntl(13, 1)  # the last front on one rank: otherwise its pivots are not counted
            factor.setMumpsIcntl(24, 1)  # zero pivots are counted apart
        self._factorisation.setUp()
        factor = self._factorisation.getFactorMatrix()
        if self._factorisation.getFailedReason() or factor.getMumpsInfog(1) < 0:
            raise FactorisationFailed(f"MUMPS stopped with INFOG(1) = {factor.getMumpsInfog(1)}")
        return int(factor.getInertia()[0])

    def _without_prescribed(self) -> Any:
        """A copy in which the prescribed unknowns have an eigenvalue of the size of the largest ones, not one."""
        matrix, diagonal = self._symmetric.copy(), self._symmetric.createVecRight()
        self._symmetric.getDiagonal(diagonal)
        local = diagonal.array
        held = ~np.isnan(self.equilibrium.prescribed_values()[: len(local)])
        largest = float(np.max(np.abs(local[~held]), initial=0.0))
        local[held] = self.equilibrium.comm.allreduce(largest, MPI.MAX)
        matrix.setDiagonal(diagonal)
        diagonal.destroy()
        return matrix

    def _lower_bound(self, matrix: Any) -> float:
        """Below all eigenvalues, but not by far; zero where none is negative."""
        if self._negative_of(matrix) == 0:
            return 0.0
        diagonal = matrix.getDiagonal()
        shift = -FIRST_SHIFT * float(np.abs(diagonal.min()[1]))
        diagonal.destroy()
        for _ in range(MOST_SHIFTS):
            if self._negative_of(matrix, shift) == 0:
                return shift
            shift *= SHIFT_FACTOR
        raise FactorisationFailed("no lower bound of the eigenvalues was found")

    def _mode(self, eigenvalue: float, vector: Any) -> Mode:
        state = self.equilibrium.state
        function = dolfinx.fem.Function(state.unknown.function_space)
        owned = vector.getLocalSize()
        function.x.array[:owned] = vector.array_r
        function.x.scatter_forward()
        amplitude = np.linalg.norm(state.kinematics.nodal_displacement(function), axis=1)
        nodes = state.kinematics.nodal_space(state.unknown).tabulate_dof_coordinates()
        largest = self.equilibrium.comm.allreduce(float(np.max(amplitude, initial=0.0)), MPI.MAX)
        # of nodes that symmetry makes equal the first one in space, whatever the number of ranks
        candidates = [
            tuple(float(round(c, 12)) + 0.0 for c in node) for node in nodes[amplitude >= (1 - 1e-6) * largest]
        ]
        found = [node for rank in self.equilibrium.comm.allgather(candidates) for node in rank]
        x, y, z = min(found)
        return Mode(eigenvalue, (x, y, z), function.x.array.copy())


def of_the_unloaded_body(inertia: Inertia) -> tuple[int, float]:
    """Negative eigenvalues, and the lowest one, without loads, displacement and remodeling; the state stays."""
    state = inertia.equilibrium.state
    before, cells = state.snapshot(), state.cells
    try:
        state.unknown.x.array[:] = 0.0
        state.loading.set(dict.fromkeys(state.loading.values, 0.0))
        cells.set(cells.initial_dimensions, cells.initial_axes())
        state.settle_cells()
        return inertia.negative_eigenvalues(), inertia.lowest().eigenvalue
    finally:
        state.restore(before)
