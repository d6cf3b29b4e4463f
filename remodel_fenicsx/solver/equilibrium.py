"""Equilibrium at fixed loads and cells: residual, tangent, stored energy, and limits of a state."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TYPE_CHECKING

import dolfinx.fem
import dolfinx.fem.petsc
import numpy as np
import ufl
from mpi4py import MPI
from petsc4py import PETSc

from remodel_fenicsx.fem import jit
from remodel_fenicsx.fem.assembly import (
    CachedValue,
    assemble_matrix,
    create_matrix,
    integral,
    allgather,
    allreduce,
    second_derivative,
)
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.energy import (
    Stresses,
    Tissue,
    squared_end_to_end_length,
    total_structure_tensor,
)
from remodel_fenicsx.model.tensors import MANDEL, det, determinant_changes_sign, Array
from remodel_fenicsx.state import State

if TYPE_CHECKING:
    from dolfinx.fem import Function
    from ufl.core.expr import Expr

Shares = Callable[[], Sequence[UnitCell]]


# ---------------------------------------------------------------- repulsion without UFL
# Stress and stiffness are values at the quadrature points.


class PointwiseRepulsion:
    """Second Piola-Kirchhoff stress of the repulsion, and stiffness, as quadrature functions."""

    def __init__(self, state: State, tissue: Tissue, cells: Sequence[UnitCell], shares: Shares):
        self.state, self.shares = state, shares
        self.quadrature = state.cells.quadrature
        self._parameters = state.parameters(tissue)
        self.tissue = self._parameters.compiled
        self.stress = self.quadrature.function("repulsion_stress", (3, 3))
        self.stiffness = self.quadrature.function("repulsion_stiffness", (6, 6))
        of_cells = [ufl.as_ufl(part) for cell in cells for part in cell]
        of_stress = [
            state.kinematics.elastic_gradient(state.unknown),
            *of_cells,
            *self.tissue.parameters.values(),
        ]
        self._structure: CachedValue[Array] = CachedValue(None, *of_cells)
        self._stresses, self._stiffnesses = (CachedValue[None](None, *of_stress) for _ in range(2))
        self._stiffness_follows = False  # whether the last stress was followed by the stiffness

    def update(self, stiffness: bool = False) -> None:
        """Update the stress, and the stiffness on request, if unknowns or cells have changed."""
        # Both take little longer than the stress alone.
        self._stresses(lambda: self._evaluate(stiffness or self._stiffness_follows))
        if stiffness:
            self._stiffnesses(lambda: self._evaluate(stiffness=True))
        self._stiffness_follows = stiffness

    def _evaluate(self, stiffness: bool) -> None:
        derivatives = self.tissue.repulsion.derivatives
        assert derivatives is not None
        F, modulus = self.state.elastic_gradient(), self._modulus()
        A = self._structure(lambda: total_structure_tensor(self.shares()))
        first, second = derivatives(np.swapaxes(F, 1, 2) @ F, A, stiffness)
        shape = self.quadrature.shape
        # W_rep = -c g(r0)/2 M: S = 2 dW/dC and 2 dS/dC = 4 d2W/dC2
        self.quadrature.values(self.stress, (3, 3))[:] = (-modulus[:, None, None] * first).reshape(
            *shape, 3, 3
        )
        if second is not None:
            values = self.quadrature.values(self.stiffness, (6, 6))
            values[:] = (-2 * modulus[:, None, None] * second).reshape(*shape, 6, 6)
            self._stiffnesses(lambda: None)  # is up to date

    def energy(self) -> float:
        """Return the repulsion's part of the stored energy, over all ranks. Collective."""
        F = self.state.elastic_gradient()
        r0 = self._parameters.at_points().end_to_end_length
        values = -self._modulus() / 2 * self.tissue.repulsion.sum(F, self.shares(), r0)
        return self.quadrature.integral(self.state.per_mesh_volume(values))

    def residual(self, u: Function, F: Expr, test: Expr) -> Expr:
        """Return the repulsion's virtual work per stress-free volume, UFL."""
        variation = ufl.derivative(F, u, test)
        return ufl.inner(ufl.dot(F, self.stress), variation)

    def tangent(self, u: Function, F: Expr, test: Expr, trial: Expr) -> Expr:
        """Return the derivative of `residual`, UFL."""
        variation, increment = ufl.derivative(F, u, test), ufl.derivative(F, u, trial)
        geometric = ufl.inner(ufl.dot(increment, self.stress), variation)
        strains = [
            ufl.sym(ufl.dot(ufl.transpose(F), direction)) for direction in (increment, variation)
        ]
        along, across = (mandel_vector(strain) for strain in strains)
        return geometric + ufl.inner(ufl.dot(self.stiffness, along), across)

    def _modulus(self) -> Array:
        return self._parameters.at_points().repulsion_modulus


class PointStresses:
    """UFL stresses of the residual at the quadrature points, with formulation and repulsion."""

    def __init__(self, state: State, tissue: Tissue):
        self._dilatation, self._repulsion = state.dilatation, pointwise_repulsion(
            state, tissue, [state.cells.symbolic_cell]
        )
        F = state.kinematics.elastic_gradient(state.unknown)
        self.ufl: Stresses = state.dilatation.stresses(tissue, F, [state.cells.symbolic_cell])
        if self._repulsion is not None:
            self.ufl = self.ufl.plus(F, self._repulsion.stress)
        kinematics = state.kinematics
        # Amounts refer to the volume at the start, stresses to the present volume.
        if kinematics.grows:
            self.ufl = self.ufl.over(kinematics.volume_ratio())  # type: ignore[attr-defined]

    def refresh(self) -> None:
        """Update what the expressions need in addition to F from the present unknowns and cells."""
        if self._dilatation.jacobian is not None:
            self._dilatation.refresh()
        if self._repulsion is not None:
            self._repulsion.update()


def mandel_vector(tensor: Expr) -> Expr:
    """Return the six Mandel components of a symmetric UFL tensor."""
    return ufl.as_vector(
        [tensor[i, j] if i == j else np.sqrt(2.0) * tensor[i, j] for i, j in MANDEL]
    )


def pointwise_repulsion(
    state: State, tissue: Tissue, cells: Sequence[UnitCell], shares: Shares | None = None
) -> PointwiseRepulsion | None:
    """Return the repulsion that UFL cannot express, of the state's or weighted cells, or None."""
    if tissue.chain is None or tissue.repulsion.derivatives is None:
        return None
    return PointwiseRepulsion(state, tissue, cells, shares or (lambda: [state.cells.point_cells]))


@dataclass(frozen=True)
class StateLimits:
    """Limits of a state: largest r/L with its reference position, and smallest J."""

    max_chain_extension: float
    min_jacobian: float
    worst_point: tuple[float, float, float]
    stop_signal: int = 0

    @property
    def admissible(self) -> bool:
        """Whether r < L and J > 0 everywhere; False for NaN."""
        return self.max_chain_extension < 1.0 and self.min_jacobian > 0.0


class PointState(NamedTuple):
    """State at this rank's own points: limits; r/L and J, (elements, points); F, (n, 3, 3)."""

    limits: StateLimits
    stretches: Array
    jacobians: Array
    gradients: Array


class Equilibrium:
    """Balance of internal forces and loads, compiled."""

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
        self.parameters = state.parameters(tissue)
        self.tissue, self._point_shares = self.parameters.tissue, point_shares
        u, loading = state.unknown, state.loading
        shares = shares or [state.cells.symbolic_cell]
        test, trial = ufl.TestFunction(u.function_space), ufl.TrialFunction(u.function_space)
        F = state.kinematics.elastic_gradient(u)
        self.energies = state.dilatation.energies(
            self.tissue, F, shares, state.kinematics.stress_free_weight(mesh)
        )
        external = loading.external_residual(test)
        self.pointwise = pointwise_repulsion(state, self.tissue, shares, point_shares)
        internal = [ufl.derivative(energy, u, test) for energy in self.energies]
        tangents = [second_derivative(energy, u, test, trial) for energy in self.energies]
        if self.pointwise is not None:
            weight, dx = state.kinematics.stress_free_weight(mesh), self.quadrature.dx
            internal[0] += self.pointwise.residual(u, F, test) * weight * dx
            tangents[0] += self.pointwise.tangent(u, F, test, trial) * weight * dx
        self.internal_forms = [jit.form(form) for form in internal]
        self.external_forms = [] if external is None else [jit.form(external)]
        # A separate form, so that bodies with other loads reuse the costly one.
        self.tangent_forms = [jit.form(form) for form in tangents]
        if external is not None and _depends_on(external, u):
            self.tangent_forms.append(jit.form(ufl.derivative(external, u, trial)))
        chains = [] if self.tissue.chain is None else [part for cell in shares for part in cell]
        length = 0.0 if self.tissue.locking_length is None else self.tissue.locking_length
        self._known: CachedValue[PointState] = CachedValue(
            self.comm, F, *map(ufl.as_ufl, [*chains, length])
        )
        self._energy_forms: list[dolfinx.fem.Form] = []

    # ------------------------------------------------------------ state and limits
    def limits(self) -> StateLimits:
        """Return largest r/L and smallest J of the present unknowns over all ranks. Collective."""
        return self.evaluate().limits

    def evaluate(self) -> PointState:
        """Return limits, r/L, J and F of the present unknowns, cached for a state. Collective."""
        look = self._known(self._look)
        if look.limits.stop_signal:
            self._known.forget()  # the stop request may be withdrawn
        return look

    def _look(self) -> PointState:
        quadrature = self.quadrature
        squares, lengths = quadrature.owned(self.squared_lengths()), quadrature.owned(
            self.parameters.locking_length()
        )
        gradients = self.state.elastic_gradient()[: squares.size]
        jacobians = det(gradients).reshape(squares.shape)
        with np.errstate(invalid="ignore"):
            stretches = np.sqrt(squares) / lengths
        stretches[~np.isfinite(stretches)] = np.inf
        smallest, dilatation = _smallest(jacobians), self.state.dilatation
        if dilatation.jacobian is not None:
            smallest = min(smallest, _smallest(quadrature.owned(dilatation.jacobians())))
        local: tuple[float, tuple[float, ...]] = (-np.inf, (np.nan,) * 3)
        if stretches.size:
            worst = int(np.argmax(stretches))
            local = stretches.item(worst), tuple(
                quadrature.coordinates.reshape(-1, 3)[worst].tolist()
            )
        ranks = allgather(self.comm, (*local, smallest, self.state.stop_signal()))
        extensions, positions, jacobians_of_ranks, signals = zip(*ranks, strict=True)
        worst_rank = int(np.argmax(extensions))
        limits = StateLimits(
            extensions[worst_rank], min(jacobians_of_ranks), positions[worst_rank], max(signals)
        )
        return PointState(limits, stretches, jacobians, gradients)

    def keeps_margin(
        self,
        before: Array,
        after: Array,
        share: float,
        nearer_than: float,
    ) -> bool:
        """Return whether every point keeps a fraction of its 1 - r/L. Collective."""
        lost = bool(np.any((after > nearer_than) & (1 - after < share * (1 - before))))
        return not allreduce(self.comm, lost, MPI.LOR)

    def inverts_between(self, before: PointState, after: PointState) -> bool:
        """Return whether J vanishes on the straight path between two states. Collective."""
        # |F^-1| <= F:F / (2 det F), and no matrix within 1 / |F^-1| of F is singular. So few points
        # need the exact check.
        F, G = before.gradients, after.gradients
        J = before.jacobians.ravel()
        change, own = (np.einsum("nij,nij->n", each, each) for each in (G - F, F))
        at = np.flatnonzero((J <= 0.0) | (np.sqrt(change) * own >= 2.0 * J))
        turns = at.size > 0 and bool(determinant_changes_sign(F[at], G[at]).any())
        return allreduce(self.comm, turns, MPI.LOR)

    def safe_change(self, far: float) -> float:
        """Return the largest |dF| with J > 0 and r/L < `far` at all points. Collective."""
        look, lengths = self.evaluate(), self.state.cells.dimension_values
        chains = np.sqrt((lengths**2).sum(axis=-1)) / self.parameters.locking_length()
        volume = (
            2.0 * look.jacobians.ravel() / np.einsum("nij,nij->n", look.gradients, look.gradients)
        )
        length = (far - look.stretches) / np.maximum(self.quadrature.owned(chains), 1e-300)
        return float(
            allreduce(self.comm, np.minimum(volume, length.ravel()).min(initial=np.inf), MPI.MIN)
        )

    def squared_lengths(self) -> Array:
        """Return r^2 in squared link lengths, (elements, points); 0 without chains."""
        shape = self.quadrature.shape
        if self.tissue.chain is None:
            return np.zeros(shape)
        F, cells = self.state.elastic_gradient(), self.state.cells
        if self._point_shares is None:
            return cells.kernels.squared_length(F, cells.point_cells).reshape(shape)
        return squared_end_to_end_length(F, self._point_shares()).reshape(shape)

    def stored_energy(self) -> float:
        """Return the integral of W over the body. Collective."""
        if not self._energy_forms:
            self.compile_energy()
        pointwise = 0.0 if self.pointwise is None else self.pointwise.energy()
        return sum(map(integral, self._energy_forms)) + pointwise

    def compile_energy(self) -> None:
        """Compile `stored_energy`, which `continuation.CellHomotopy` does not need. Collective."""
        self._energy_forms = [jit.form(energy) for energy in self.energies]

    # ------------------------------------------------------------ vectors and matrices
    def assemble_internal(self, vector: PETSc.Vec) -> None:
        """Assemble the internal nodal forces of the present unknowns. Collective."""
        if self.pointwise is not None:
            self.pointwise.update()
        self._assemble(vector, self.internal_forms)

    def assemble_external(self, vector: PETSc.Vec) -> None:
        """Assemble minus the nodal forces of the loads. Collective."""
        self._assemble(vector, self.external_forms)

    def _assemble(self, vector: PETSc.Vec, forms: Sequence[dolfinx.fem.Form]) -> None:
        with vector.localForm() as local:
            values = local.array_w
            values.fill(0.0)
            for form in forms:
                dolfinx.fem.assemble_vector(values, form)
        vector.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)

    def assemble_lifting(self, vector: PETSc.Vec, x: PETSc.Vec) -> None:
        """Assemble K (u_prescribed - x), the forces of prescribed values not met. Collective."""
        with vector.localForm() as local:
            local.set(0.0)
        conditions = self.state.loading.boundary_conditions
        self._update_tangent()
        for form in self.tangent_forms:
            dolfinx.fem.petsc.apply_lifting(vector, [form], bcs=[conditions], x0=[x], alpha=-1.0)
        vector.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)

    def create_matrix(self, blocked: bool = False) -> PETSc.Mat:
        """Return an empty matrix with the pattern of the tangent, in blocks or not. Collective."""
        return create_matrix(self.tangent_forms[0], blocked)

    def assemble_tangent(self, matrix: PETSc.Mat) -> None:
        """Assemble the tangent, with unit diagonal for prescribed unknowns. Collective."""
        self._update_tangent()
        assemble_matrix(matrix, self.tangent_forms, self.state.loading.boundary_conditions)

    def _update_tangent(self) -> None:
        if self.pointwise is not None:
            self.pointwise.update(stiffness=True)

    def prescribed_values(self) -> Array:
        """Return prescribed values of this rank's unknowns with ghosts; NaN for free unknowns."""
        vector = self.state.unknown.x
        values = np.full_like(vector.array, np.nan)
        for condition in self.state.loading.boundary_conditions:
            condition.set(values)
        return values

    def prescribed_gap(self) -> float:
        """Return the largest difference of an unknown from its prescribed value. Collective."""
        vector = self.state.unknown.x
        gap = np.abs(self.prescribed_values() - vector.array)
        return allreduce(self.comm, float(np.nanmax(gap, initial=0.0)), MPI.MAX)


def _smallest(values: Array) -> float:
    """Return the smallest value, or -inf if one is not finite."""
    return float(values.min(initial=np.inf)) if np.isfinite(values).all() else -np.inf


def _depends_on(form: ufl.Form, unknown: Function) -> bool:
    """Return whether a form depends on the unknown."""
    return unknown in form.coefficients()
