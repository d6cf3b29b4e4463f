"""The repulsion where it is no closed expression for UFL: stress and stiffness as values at the quadrature points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import ufl
from numpy.typing import NDArray

from remodel_fenicsx.fem import assembly
from remodel_fenicsx.kernels.library import with_kernels
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.energy import Stresses, Tissue, whole_structure_tensor
from remodel_fenicsx.model.tensors import MANDEL
from remodel_fenicsx.state.state import State

Array = NDArray[np.float64]
Shares = Callable[[], Sequence[UnitCell]]


class PointwiseRepulsion:
    """Second Piola-Kirchhoff stress of the repulsion and its derivative, as quadrature functions that forms take.

    They belong to the unknowns with which `update` was called last.

    Parameters
    ----------
    state
        Unknowns and kinematics.
    tissue
        With a repulsion that has derivatives of its own; its parameters are Constants or DG0 Functions.
    shares
        Function that gives the cells at all points in one row, arrays, with numbers for weights.

    Attributes
    ----------
    stress, stiffness
        S (3, 3), and 2 dS/dC as a Mandel matrix (6, 6), dolfinx functions.
    """

    def __init__(self, state: State, tissue: Tissue, shares: Shares):
        self.state, self.shares = state, shares
        self.tissue = with_kernels(tissue, state.comm)
        self.quadrature = state.cells.quadrature
        self.stress = self.quadrature.function("repulsion_stress", (3, 3))
        self.stiffness = self.quadrature.function("repulsion_stiffness", (6, 6))
        self._known: list[Array] = []  # F, A and c g(r0) of the values that are there
        self._cells: list[Array] = []  # what A was made of
        self._structure: Array
        self._stiffness_is_known = False

    def update(self, stiffness: bool = False) -> None:
        """Stress, and stiffness on request, of the present unknowns and cells: what is there already stays."""
        derivatives = self.tissue.repulsion.derivatives
        assert derivatives is not None
        F, A, modulus = self.state.elastic_gradient(), self._structure_tensor(), self._modulus()
        asked = [F, A, modulus]
        known = bool(self._known) and all(map(np.array_equal, asked, self._known))
        if known and (self._stiffness_is_known or not stiffness):
            return
        self._known, self._stiffness_is_known = asked, stiffness
        first, second = derivatives(np.swapaxes(F, 1, 2) @ F, A, stiffness)
        shape = self.quadrature.shape
        # W_rep = -c g(r0)/2 M: S = 2 dW/dC and 2 dS/dC = 4 d2W/dC2
        self.quadrature.values(self.stress, (3, 3))[:] = (-modulus[:, None, None] * first).reshape(*shape, 3, 3)
        if second is not None:
            values = self.quadrature.values(self.stiffness, (6, 6))
            values[:] = (-2 * modulus[:, None, None] * second).reshape(*shape, 6, 6)

    def _structure_tensor(self) -> Array:
        """A of the present cells; they stay through a solve."""
        shares = self.shares()
        cells = [np.asarray(part) for cell in shares for part in cell]
        if not self._cells or not all(map(np.array_equal, cells, self._cells)):
            self._structure, self._cells = whole_structure_tensor(shares), [part.copy() for part in cells]
        return self._structure

    def energy(self) -> float:
        """Its part of the stored energy, over all ranks."""
        F = self.state.elastic_gradient()
        r0 = assembly.point_values(self.tissue.end_to_end_length, self.quadrature).reshape(-1)
        values = -self._modulus() / 2 * self.tissue.repulsion.sum(F, self.shares(), r0)
        return self.quadrature.integral(self.state.per_mesh_volume(values))

    def residual(self, u: Any, F: Any, test: Any) -> Any:
        """Its virtual work per reference volume, UFL."""
        variation = ufl.derivative(F, u, test)
        return ufl.inner(ufl.dot(F, self.stress), variation)

    def tangent(self, u: Any, F: Any, test: Any, trial: Any) -> Any:
        """Derivative of `residual`, UFL."""
        variation, increment = ufl.derivative(F, u, test), ufl.derivative(F, u, trial)
        geometric = ufl.inner(ufl.dot(increment, self.stress), variation)
        strains = [ufl.sym(ufl.dot(ufl.transpose(F), direction)) for direction in (increment, variation)]
        along, across = (mandel_vector(strain) for strain in strains)
        return geometric + ufl.inner(ufl.dot(self.stiffness, along), across)

    def _modulus(self) -> Array:
        points = self.tissue.map(lambda name, value: assembly.point_values(value, self.quadrature).reshape(-1))
        modulus: Array = points.repulsion_modulus
        return modulus


class PointStresses:
    """Stresses at the quadrature points as the residual has them: with what the formulation and the repulsion add.

    Parameters
    ----------
    state
        Unknowns, cells and formulation.
    tissue
        Its parameters are Constants or DG0 Functions.

    Attributes
    ----------
    ufl
        The stresses as expressions, for those who compile them. They belong to the last `refresh`.
    """

    def __init__(self, state: State, tissue: Tissue):
        self._dilatation, self._repulsion = state.dilatation, pointwise_repulsion(state, tissue)
        F = state.kinematics.elastic_gradient(state.unknown)
        self.ufl: Stresses = state.dilatation.stresses(tissue, F, [state.cells.ufl_cell])
        if self._repulsion is not None:
            self.ufl = self.ufl.plus(F, self._repulsion.stress)

    def refresh(self) -> None:
        """Take what the expressions need beside F from the present unknowns and cells."""
        self._dilatation.refresh()
        if self._repulsion is not None:
            self._repulsion.update()


def mandel_vector(tensor: Any) -> Any:
    """Six Mandel components of a symmetric UFL tensor."""
    return ufl.as_vector([tensor[i, j] if i == j else np.sqrt(2.0) * tensor[i, j] for i, j in MANDEL])


def pointwise_repulsion(state: State, tissue: Tissue, shares: Shares | None = None) -> PointwiseRepulsion | None:
    """The part of a tissue's energy that UFL leaves out, with the state's cells or shares of them; None without one."""
    if tissue.chain is None or tissue.repulsion.derivatives is None:
        return None
    return PointwiseRepulsion(state, tissue, shares or (lambda: [state.cells.point_cells]))
