"""Linear stability of the remodeling pass: by what one pass multiplies a small change of the cells, and where.

At a solved state the cells determine the equilibrium, the equilibrium the driving tensor, and the pass makes new cells
of it. The derivative of this map with respect to the cells is what decides whether the staggered scheme over-corrects
(docs/theory.md, "Stability of the pass"). SLEPc finds its extreme eigenvalues without a matrix.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import dolfinx.fem.petsc
import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc
from slepc4py import SLEPc

from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.model.cells import UnitCell, structure_tensor

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

STEP = 1e-5  # of the differences, over tr A
DISTINCT = 1e-3  # difference of two squared lengths over tr A below which a turn in their plane is no change of A
SHEAR_PLANES = ((0, 1), (0, 2), (1, 2))
LARGEST_BASIS, RESTARTS = 40, 20  # of the Krylov space
FACTOR_ERROR = 5e-3  # absolute: enough to tell on which side of -1 or 1 a factor is
ENDS = {"reversing": SLEPc.EPS.Which.SMALLEST_REAL, "growing": SLEPc.EPS.Which.LARGEST_REAL}
SHARE_NAMES = ("turn_12", "turn_13", "turn_23", "lengths")


class NotFound(RuntimeError):
    """The eigenvalues have not converged."""


@dataclass(frozen=True)
class PassMode:
    """A change of the cells that a pass multiplies by a factor."""

    factor: float
    place: tuple[float, float, float]
    volume_share: float
    shares: dict[str, float]


class LinearPass:
    """The derivative of one pass with respect to the cells at the solved state, as a map of fields of tensors."""

    def __init__(self, stepper: Stepper, time: float, residual: float = 0.0):
        self.state, self.remodeling = stepper.state, stepper.remodeling
        self.equilibrium = stepper.coupling.equilibrium
        self.times, self.residual = (self.state.time, time), residual
        self.quadrature = self.state.cells.quadrature
        cells = self.state.cells.point_cells
        self.cells = UnitCell(cells.dimensions.copy(), cells.axes.copy())
        self.size = np.sum(self.cells.dimensions**2, axis=1)
        self._weights = np.sqrt(self.quadrature.owned(self.quadrature.volumes).reshape(-1))
        self.owned = self._weights.size
        vector = self.state.unknown.x.petsc_vec
        self._forces, self._answer, self._x = (vector.duplicate() for _ in range(3))
        self._matrix = self.equilibrium.create_matrix()
        self.equilibrium.assemble_tangent(self._matrix)
        self._solver: Any = PETSc.KSP().create(self.equilibrium.comm)
        self._solver.setOperators(self._matrix)
        self._solver.setType("preonly")
        self._solver.getPC().setType("lu")
        self._solver.getPC().setFactorSolverType("mumps")

    def close(self) -> None:
        """Free PETSc's objects."""
        for thing in (self._solver, self._matrix, self._forces, self._answer, self._x):
            thing.destroy()

    def __enter__(self) -> LinearPass:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ------------------------------------------------------------ the map
    def __call__(self, change: Array) -> Array:
        """What the pass makes of a small change of A at the owned points, (points, 3, 3) both, by differences."""
        relative = np.linalg.norm(change, axis=(1, 2)) / self.size[: self.owned]
        largest = self.equilibrium.comm.allreduce(float(np.max(relative, initial=0.0)), MPI.MAX)
        if largest == 0.0:
            return np.zeros_like(change)
        step = STEP / largest
        unknown = self.state.unknown.x.array.copy()
        all_changes = np.zeros((len(self.size), 3, 3))  # nothing at a ghost's points enters the forces of this rank
        all_changes[: self.owned] = change
        try:
            ends = [self._changed(sign * step * all_changes) for sign in (1.0, -1.0)]
            answer = self._answer_of_equilibrium(*ends)
            passed = []
            for sign, cells in zip((1.0, -1.0), ends, strict=True):
                self._set(cells)
                self.state.unknown.x.array[:] = unknown + sign * answer
                new, _ = self.remodeling.updated_cells(*self.times, self.residual)
                passed.append(structure_tensor(new.dimensions, new.axes)[: self.owned])
        finally:
            self._set(self.cells)
            self.state.unknown.x.array[:] = unknown
        return (passed[0] - passed[1]) / (2 * step)

    def _changed(self, change: Array) -> UnitCell:
        """The cells with another A, to first order: lengths from the diagonal of the change, turns from the rest."""
        dimensions, axes = self.cells.dimensions, self.cells.axes
        inside = axes @ change @ np.swapaxes(axes, 1, 2)
        squared = dimensions**2
        new = np.sqrt(np.maximum(squared + np.einsum("nii->ni", inside), 0.0))
        turn = np.zeros_like(inside)
        for i, j in SHEAR_PLANES:
            gap = squared[:, i] - squared[:, j]
            distinct = np.abs(gap) > DISTINCT * self.size
            turn[:, i, j] = np.where(distinct, inside[:, i, j] / np.where(distinct, gap, 1.0), 0.0)
            turn[:, j, i] = -turn[:, i, j]
        # Cayley's transform: a rotation, exactly
        identity = np.eye(3)
        return UnitCell(new, np.linalg.solve(identity - turn / 2, (identity + turn / 2) @ axes))

    def _answer_of_equilibrium(self, plus: UnitCell, minus: UnitCell) -> Array:
        """Half the difference of the unknowns in equilibrium with two cells close by: -K^-1 dR."""
        self._answer.set(0.0)
        for sign, cells in ((1.0, plus), (-1.0, minus)):
            self._set(cells)
            self.equilibrium.assemble_internal(self._forces)
            self._answer.axpy(-0.5 * sign, self._forces)
        with self._x.localForm() as local:
            local.array[:] = self.state.unknown.x.array
        conditions = self.state.loading.boundary_conditions
        dolfinx.fem.petsc.set_bc(self._answer, conditions, self._x, 0.0)
        self._solver.solve(self._answer, self._x)
        self._x.ghostUpdate(addv=PETSc.InsertMode.INSERT, mode=PETSc.ScatterMode.FORWARD)
        with self._x.localForm() as local:
            return np.array(local.array_r)

    def _set(self, cells: UnitCell) -> None:
        shape = self.quadrature.shape
        self.state.cells.set(cells.dimensions.reshape(*shape, 3), cells.axes.reshape(*shape, 3, 3))

    # ------------------------------------------------------------ its eigenvalues
    def extreme(self, end: str) -> PassMode:
        """The mode with the most negative factor ("reversing") or with the largest ("growing")."""
        rows = 6 * self.owned
        total = self.equilibrium.comm.allreduce(rows, MPI.SUM)
        operator = PETSc.Mat().createPython(((rows, total), (rows, total)), _Shell(self), self.equilibrium.comm)
        operator.setUp()
        solver: Any = SLEPc.EPS().create(self.equilibrium.comm)
        solver.setOperators(operator)
        solver.setProblemType(SLEPc.EPS.ProblemType.NHEP)
        solver.setWhichEigenpairs(ENDS[end])
        solver.setDimensions(1, min(LARGEST_BASIS, total))
        solver.setTolerances(FACTOR_ERROR, RESTARTS)
        solver.setConvergenceTest(SLEPc.EPS.Conv.ABS)
        start = operator.createVecRight()
        start.array[:] = np.random.default_rng(1).standard_normal(rows)
        solver.setInitialSpace(start)
        solver.solve()
        if not solver.getConverged():
            raise NotFound(
                f"no factor of the pass was found to {FACTOR_ERROR:g} after {solver.getIterationNumber()} restarts"
            )
        found = self._mode(float(np.real(solver.getEigenpair(0, start))), self.tensors(start.array_r))
        for thing in (solver, operator, start):
            thing.destroy()
        return found

    def _mode(self, factor: float, change: Array) -> PassMode:
        comm, volumes = self.equilibrium.comm, self._weights**2
        axes = self.cells.axes[: self.owned]
        inside = axes @ change @ np.swapaxes(axes, 1, 2)
        square = np.sum(change**2, axis=(1, 2))
        first, second, whole = (
            float(comm.allreduce(np.sum(volumes * values))) for values in (square, square**2, np.ones(self.owned))
        )
        parts = [2 * inside[:, i, j] ** 2 for i, j in SHEAR_PLANES]
        parts.append(square - np.sum(parts, axis=0))
        shares = [float(comm.allreduce(np.sum(volumes * part))) / first for part in parts]
        place = self.quadrature.place_of_largest(square.reshape(-1, self.quadrature.shape[1]))
        return PassMode(factor, place, first**2 / second / whole, dict(zip(SHARE_NAMES, shares, strict=True)))

    # ------------------------------------------------------------ tensors as vectors
    def tensors(self, vector: Array) -> Array:
        """Changes of A (points, 3, 3) of a vector of six numbers a point, whose square is the integral of |dA|^2."""
        six = vector.reshape(-1, 6) / self._weights[:, None]
        found = np.zeros((len(six), 3, 3))
        for index in range(3):
            found[:, index, index] = six[:, index]
        for index, (i, j) in enumerate(SHEAR_PLANES, start=3):
            found[:, i, j] = found[:, j, i] = six[:, index] / np.sqrt(2)
        return found

    def vector(self, tensors: Array) -> Array:
        """The inverse of `tensors`."""
        diagonal = [tensors[:, i, i] for i in range(3)]
        others = [np.sqrt(2) * tensors[:, i, j] for i, j in SHEAR_PLANES]
        six: Array = np.stack(diagonal + others, axis=1) * self._weights[:, None]
        return six.reshape(-1)


class _Shell:
    """The map as a matrix of PETSc."""

    def __init__(self, linear: LinearPass):
        self.linear = linear

    def mult(self, matrix: Any, x: Any, y: Any) -> None:
        """y = A x."""
        y.array[:] = self.linear.vector(self.linear(self.linear.tensors(x.array_r)))


@dataclass(frozen=True)
class Amplification:
    """The extreme modes of a step's pass; None for one that was not found."""

    time: float
    reversing: PassMode | None
    growing: PassMode | None


class AmplificationWatcher(Watcher):
    """Computes the extreme modes of the pass of chosen steps."""

    def __init__(self, stepper: Stepper, chosen: Callable[[Step], bool]):
        self.stepper, self.chosen = stepper, chosen
        self.found: list[Amplification] = []

    def solved(self, step: Step) -> None:
        """Look."""
        if not self.chosen(step):
            return
        with LinearPass(self.stepper, step.time, step.work.residual) as linear:
            ends = [self._first_mode(linear, end, step) for end in ENDS]
        self.found.append(Amplification(step.time, *ends))

    def _first_mode(self, linear: LinearPass, end: str, step: Step) -> PassMode | None:
        try:
            return linear.extreme(end)
        except NotFound as reason:
            if linear.equilibrium.comm.rank == 0:
                log.warning("time %g, %s modes: %s", step.time, end, reason)
            return None

    def undone(self, step: Step) -> None:
        """What was found of the step goes."""
        if self.found and self.found[-1].time == step.time:
            self.found.pop()
