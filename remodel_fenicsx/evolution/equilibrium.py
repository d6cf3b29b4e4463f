"""Equilibrium at given loads and cells: residual, tangent, stored energy, and how far a state is from its limits."""

from __future__ import annotations

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

from remodel_fenicsx.evolution.pointwise import Shares, pointwise_repulsion
from remodel_fenicsx.evolution.state import State
from remodel_fenicsx.fem import coefficients, jit
from remodel_fenicsx.fem.remembered import Remembered
from remodel_fenicsx.tissue.cells import UnitCell
from remodel_fenicsx.tissue.energy import Tissue
from remodel_fenicsx.tissue.operators import passes_through_zero
from remodel_fenicsx.tissue.repulsion import squared_end_to_end_length

Array = NDArray[np.float64]


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


class Equilibrium:
    """The balance of internal forces and loads, compiled; it changes nothing but `state.unknown`, and that on request.

    Parameters
    ----------
    state
        Unknowns, cells and loads.
    tissue
        Its parameters; numbers become Constants of the mesh.
    shares, point_shares
        The cells as the energy takes them, when not simply the state's (a blend of two), and a function that gives them
        as arrays.

    Raises
    ------
    TypeError, ValueError
        If a parameter is neither a number, nor a Constant, nor a DG0 Function of the mesh.
    """

    def __init__(
        self,
        state: State,
        tissue: Tissue,
        shares: Sequence[UnitCell] | None = None,
        point_shares: Shares | None = None,
    ):
        self.state, self.quadrature = state, state.cells.quadrature
        mesh = self.quadrature.mesh
        self.comm = mesh.comm
        self.tissue = on_mesh(tissue, mesh)
        # asked on each rank whenever limits are reduced: the signal (SIGINT, SIGTERM) that should end the solve, or 0
        self.stop_signal: Callable[[], int] = lambda: 0
        u, shares, loading = state.unknown, shares or [state.cells.ufl_cell], state.loading
        test, trial = ufl.TestFunction(u.function_space), ufl.TrialFunction(u.function_space)
        F = state.kinematics.deformation_gradient(u)
        self.energies = state.dilatation.energies(self.tissue, F, shares, state.kinematics.weight(mesh))
        external = loading.external_residual(test)
        self.pointwise = pointwise_repulsion(state, self.tissue, point_shares)
        internal, tangents = self.internal_and_tangents(F, test, trial)
        self.internal_forms = [jit.form(form) for form in internal]
        self.external_form = None if external is None else jit.form(external)
        # apart, so that bodies with other loads share the costly one
        self.tangent_forms = [jit.form(form) for form in tangents]
        if external is not None and _depends_on(external, u):
            self.tangent_forms.append(jit.form(ufl.derivative(external, u, trial)))
        squared = squared_end_to_end_length(F, shares) if self.tissue.chain is not None else ufl.as_ufl(0.0)
        limits = ufl.as_vector([squared, ufl.det(F)])
        self._limits = jit.expression(limits, self.quadrature.points)
        length = ufl.as_ufl(0.0 if self.tissue.locking_length is None else self.tissue.locking_length)
        self._known_extension: Remembered[tuple[Extension, Array]] = Remembered(self.comm, limits, length)
        self._energy_forms: list[Any] = []

    def internal_and_tangents(self, F: Any, test: Any, trial: Any) -> tuple[list[Any], list[Any]]:
        """Virtual work of the stresses and its derivative by the unknowns, UFL forms to be added up."""
        u = self.state.unknown
        internal = [ufl.derivative(energy, u, test) for energy in self.energies]
        tangents = [ufl.derivative(form, u, trial) for form in internal]
        if self.pointwise is not None:
            weight, dx = self.state.kinematics.weight(self.quadrature.mesh), self.quadrature.dx
            internal[0] += self.pointwise.residual(u, F, test) * weight * dx
            tangents[0] += self.pointwise.tangent(u, F, test, trial) * weight * dx
        return internal, tangents

    # ------------------------------------------------------------ what users ask
    def extension(self) -> Extension:
        """Largest r/L and smallest J of the present unknowns over all points of all ranks."""
        return self.extension_and_stretches()[0]

    def extension_and_stretches(self) -> tuple[Extension, NDArray[np.float64]]:
        """The extension, and r/L at the points of this rank's own elements, (elements, points); infinite for NaN."""
        return self._known_extension(self._extension_and_stretches)

    def _extension_and_stretches(self) -> tuple[Extension, Array]:
        squared, at_points = self.limit_values()
        jacobian = np.hstack([at_points, self.state.dilatation.jacobians()])
        squared, jacobian = self.quadrature.owned(squared), self.quadrature.owned(jacobian)
        with np.errstate(invalid="ignore"):
            stretch = np.sqrt(squared) / self.quadrature.owned(self.locking_length())
        stretch = np.where(np.isfinite(stretch), stretch, np.inf)
        jacobian = np.where(np.isfinite(jacobian), jacobian, -np.inf)
        if stretch.size:
            worst = np.unravel_index(int(np.argmax(stretch)), stretch.shape)
            point = self.quadrature.coordinates[worst]
            local = (float(stretch[worst]), (float(point[0]), float(point[1]), float(point[2])))
        else:
            local = (-np.inf, (np.nan, np.nan, np.nan))
        ranks = self.comm.allgather((*local, float(np.min(jacobian, initial=np.inf)), self.stop_signal()))
        largest, worst_point = max((rank[:2] for rank in ranks), key=lambda pair: pair[0])
        extension = Extension(largest, min(rank[2] for rank in ranks), worst_point, max(rank[3] for rank in ranks))
        return extension, stretch

    def keeps_reserve(self, before: Any, after: Any, share: float, nearer_than: float = 0.0) -> bool:
        """Whether every point of all ranks keeps a share of its 1 - r/L; `nearer_than`: only those with r/L above it.

        Parameters
        ----------
        before, after
            r/L at the points, from `extension_and_stretches`.
        """
        lost = bool(np.any((after > nearer_than) & (1 - after < share * (1 - before))))
        return not self.comm.allreduce(lost, MPI.LOR)

    def turns_inside_out(self, before: NDArray[np.float64], after: NDArray[np.float64]) -> bool:
        """Whether J vanishes on the straight way between two states at a point of any rank; F from both."""
        return bool(self.comm.allreduce(bool(passes_through_zero(before, after).any()), MPI.LOR))

    def limit_values(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """r^2 in squared link lengths (0 without chains) and J at all points, each (elements, points)."""
        values = self.quadrature.evaluate(self._limits, (2,))
        return values[..., 0], values[..., 1]

    def locking_length(self) -> NDArray[np.float64]:
        """Length at which a chain locks at all points, (elements, points); infinite where nothing locks."""
        length = self.tissue.locking_length
        if length is None:
            return np.full(self.quadrature.shape, np.inf)
        return coefficients.point_values(length, self.quadrature)

    def stored_energy(self) -> float:
        """Integral of W over the body."""
        if not self._energy_forms:
            self.compile_energy()
        local = sum(np.real(dolfinx.fem.assemble_scalar(form)) for form in self._energy_forms)
        pointwise = 0.0 if self.pointwise is None else self.pointwise.energy()
        return float(self.comm.allreduce(local, MPI.SUM)) + pointwise

    def compile_energy(self) -> None:
        """Make `stored_energy` ready; apart, because a blend needs none."""
        self._energy_forms = [jit.form(energy) for energy in self.energies]

    # ------------------------------------------------------------ what a solver asks
    def assemble_internal(self, vector: Any) -> None:
        """Internal nodal forces of the present unknowns."""
        if self.pointwise is not None:
            self.pointwise.update()
        self._assemble(vector, self.internal_forms)

    def assemble_external(self, vector: Any) -> None:
        """Minus the nodal forces of the loads."""
        self._assemble(vector, [] if self.external_form is None else [self.external_form])

    def _assemble(self, vector: Any, forms: Sequence[Any]) -> None:
        with vector.localForm() as local:
            local.set(0.0)
        for form in forms:
            dolfinx.fem.petsc.assemble_vector(vector, form)
        vector.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)

    def assemble_lifting(self, vector: Any, x: Any) -> None:
        """What the tangent makes of the distance between prescribed values and x: K (u_prescribed - x)."""
        with vector.localForm() as local:
            local.set(0.0)
        conditions = self.state.loading.boundary_conditions
        self._update_tangent()
        for form in self.tangent_forms:
            dolfinx.fem.petsc.apply_lifting(vector, [form], bcs=[conditions], x0=[x], alpha=-1.0)
        vector.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)

    def create_matrix(self) -> Any:
        """An empty matrix with the pattern of the tangent."""
        return dolfinx.fem.petsc.create_matrix(self.tangent_forms[0])

    def assemble_tangent(self, matrix: Any) -> None:
        """Derivative of the residual at the present unknowns, one on the diagonal where they are prescribed."""
        matrix.zeroEntries()
        self._update_tangent()
        for form in self.tangent_forms:
            # mypy sees the other overload of a single-dispatch function
            dolfinx.fem.petsc.assemble_matrix(
                matrix, form, bcs=self.state.loading.boundary_conditions  # type: ignore[misc]
            )
            matrix.assemble()

    def _update_tangent(self) -> None:
        if self.pointwise is not None:
            self.pointwise.update(stiffness=True)

    def prescribed_values(self) -> NDArray[np.float64]:
        """What supports and loads prescribe of this rank's unknowns, ghosts included; NaN where they are free."""
        values = np.full_like(self.state.unknown.x.array, np.nan)
        for condition in self.state.loading.boundary_conditions:
            condition.set(values)
        return values

    def prescribed_gap(self, x: Any) -> float:
        """Largest distance of a prescribed value from its target, over all ranks."""
        with x.localForm() as local:
            values = local.array_r.copy()
        target = values.copy()
        for condition in self.state.loading.boundary_conditions:
            condition.set(target)
        return float(self.comm.allreduce(float(np.max(np.abs(target - values), initial=0.0)), MPI.MAX))


def on_mesh(tissue: Tissue, mesh: Any) -> Tissue:
    """The tissue with Constants in place of numbers, so that other numbers compile nothing.

    Raises
    ------
    TypeError, ValueError
        If a parameter is neither a number, nor a Constant, nor a DG0 Function of the mesh.
    """
    return tissue.map(lambda name, value: coefficients.coefficient(mesh, name, value))


def at_points(tissue: Tissue, quadrature: Any) -> Tissue:
    """A tissue on a mesh with its parameters as arrays over the points in one row, (elements * points,)."""
    return tissue.map(lambda name, value: coefficients.point_values(value, quadrature).reshape(-1))


def stress_rounding(tissue: Tissue, mesh: Any, max_chain_extension: float) -> float:
    """Rounding error of a stress in a body, from the stiffness of matrix and network at the largest r/L."""
    return rounding_of(largest_parameters(tissue, mesh), max_chain_extension)


def largest_parameters(tissue: Tissue, mesh: Any) -> Tissue:
    """A tissue on a mesh with the largest value of each parameter in the body, numbers."""
    return tissue.map(lambda name, value: coefficients.largest(value, mesh))


def rounding_of(numbers: Tissue, max_chain_extension: float) -> float:
    """`stress_rounding` from the largest parameters."""
    length = numbers.end_to_end_length
    if numbers.locking_length is not None:
        length = max(length, max_chain_extension * numbers.locking_length)
    return float(np.finfo(np.float64).eps * numbers.stiffness(length))


def _depends_on(form: Any, unknown: Any) -> bool:
    """Whether a form's derivative with respect to the unknown is not zero."""
    return unknown in form.coefficients()
