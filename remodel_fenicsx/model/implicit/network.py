"""Stress of matrix and network on arrays, with its derivatives by strain and by cells: what a condensed tangent needs.

Everything is in the eigenbasis of C, where C is diagonal. Symmetric tensors are Mandel vectors, derivatives 6 x 6
matrices (`mandel`). Cells are given by six numbers y of their own: the structure tensor itself, or the three lengths
and the three turns of an orthotropic cell.

    S = S_matrix + c (g(r) A - g(r0) G),    r^2 = A : C,    G = dM/dC
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.model import logarithm, mandel
from remodel_fenicsx.model.cells import UnitCell, structure_tensor
from remodel_fenicsx.model.energy import Tissue

Array = NDArray[np.float64]


class Strain(NamedTuple):
    """Deformation of n points in the eigenbasis of C.

    Attributes
    ----------
    gradient
        F in the global basis, (n, 3, 3).
    squared
        Eigenvalues of C, (n, 3).
    basis
        Its eigenvectors as columns, (n, 3, 3).
    """

    gradient: Array
    squared: Array
    basis: Array

    @classmethod
    def of(cls, gradient: Array) -> Strain:
        """From F."""
        return cls(gradient, *logarithm.eigen(np.swapaxes(gradient, 1, 2) @ gradient))

    def at(self, chosen: Any) -> Strain:
        """Of some of the points."""
        return Strain(self.gradient[chosen], self.squared[chosen], self.basis[chosen])

    @property
    def stretches(self) -> Array:
        """Eigenvalues of U, (n, 3)."""
        return np.sqrt(self.squared)

    @property
    def rotation(self) -> Array:
        """R of F = R U in the eigenbasis."""
        turned = logarithm.rotated(self.gradient, self.basis)
        quotient: Array = turned / self.stretches[:, None, :]
        return quotient

    def inside(self, tensors: Array) -> Array:
        """Components of tensors (n, 3, 3) in the eigenbasis."""
        return logarithm.rotated(tensors, self.basis)

    def outside(self, tensors: Array) -> Array:
        """Components in the global basis of tensors in the eigenbasis."""
        return logarithm.rotated(tensors, np.swapaxes(self.basis, 1, 2))


class LocalCells(Protocol):
    """Cells of n points in the eigenbasis of C, with six numbers y of their own."""

    @property
    def structure(self) -> Array:
        """A, (n, 3, 3)."""

    def structure_by_cells(self) -> Array:
        """dA/dy, (n, 6, 6)."""


@dataclass(frozen=True)
class StructureCells:
    """Cells that are their structure tensor: y is A."""

    structure: Array

    def structure_by_cells(self) -> Array:
        """The identity."""
        return np.broadcast_to(np.eye(6), (len(self.structure), 6, 6))


@dataclass(frozen=True)
class OrthotropicCells:
    """Cells with lengths and axes (rows): y is dl, and turns w_ij (`mandel.PAIRS`), dn_i = w n_j, dn_j = -w n_i."""

    cell: UnitCell

    @property
    def structure(self) -> Array:
        """A, (n, 3, 3)."""
        return structure_tensor(self.cell.dimensions, self.cell.axes)

    def to_axes(self) -> Array:
        """Matrix that takes components in the cell's axes to the eigenbasis of C."""
        return mandel.congruence(np.swapaxes(self.cell.axes, 1, 2))

    def structure_by_cells(self) -> Array:
        """dA = 2 l dl n n, and (l_i^2 - l_j^2) across the axes."""
        lengths = self.cell.dimensions
        entries = np.zeros((len(lengths), 6))
        entries[:, :3] = 2 * lengths
        for row, (i, j) in enumerate(mandel.PAIRS, start=3):
            entries[:, row] = np.sqrt(2) * (lengths[:, i] ** 2 - lengths[:, j] ** 2)
        columns: Array = self.to_axes() * entries[:, None, :]
        return columns


class Terms(NamedTuple):
    """G = dM/dC (n, 3, 3), and its derivatives by cells and by C, (n, 6, 6); None where they were not asked for."""

    value: Array
    by_cells: Array | None
    by_strain: Array | None


def log_terms(strain: Strain, cells: LocalCells, r0: Array, derivatives: bool) -> Terms:
    """Of M = A : ln C."""
    values, A = strain.squared, cells.structure
    quotients = logarithm.first_divided_differences(values)
    if not derivatives:
        return Terms(quotients * A, None, None)
    by_cells = quotients[:, mandel.ROWS, mandel.COLUMNS][:, :, None] * cells.structure_by_cells()
    return Terms(quotients * A, by_cells, logarithm.second_derivative(values, A))


def length_terms(strain: Strain, cells: LocalCells, r0: Array, derivatives: bool) -> Terms:
    """Of M = r0^2 ln(A : C / r0^2)."""
    A, scale = cells.structure, r0[:, None, None] ** 2
    squared = np.einsum("nii,ni->n", A, strain.squared)[:, None, None]
    if not derivatives:
        return Terms(scale * A / squared, None, None)
    a, by_cells = mandel.vectors(A), cells.structure_by_cells()
    c = mandel.on_diagonal(strain.squared)
    across = mandel.dyads(a, np.einsum("na,nab->nb", c, by_cells))
    return Terms(
        scale * A / squared,
        scale * (by_cells / squared - across / squared**2),
        -scale * mandel.dyads(a, a) / squared**2,
    )


def axes_terms(strain: Strain, cells: LocalCells, r0: Array, derivatives: bool) -> Terms:
    """Of M = sum_I l_I^2 ln(n_I . C n_I); for cells with axes."""
    assert isinstance(cells, OrthotropicCells)
    lengths, axes = cells.cell.dimensions, cells.cell.axes
    C = (axes * strain.squared[:, None, :]) @ np.swapaxes(axes, 1, 2)  # in the cell's axes
    stretches = np.einsum("nii->ni", C)
    entries = lengths**2 / stretches
    value = np.swapaxes(axes, 1, 2) @ (entries[:, :, None] * axes)
    if not derivatives:
        return Terms(value, None, None)
    changes = np.zeros((len(lengths), 6, 6))
    steepness = -entries / stretches
    for i in range(3):
        changes[:, i, i] = 2 * lengths[:, i] / stretches[:, i]
    for column, (i, j) in enumerate(mandel.PAIRS, start=3):
        changes[:, column, column] = np.sqrt(2) * (entries[:, i] - entries[:, j])
        changes[:, i, column] = 2 * steepness[:, i] * C[:, i, j]
        changes[:, j, column] = -2 * steepness[:, j] * C[:, i, j]
    to_axes = cells.to_axes()
    along = to_axes * mandel.on_diagonal(steepness)[:, None, :]
    return Terms(value, to_axes @ changes, along @ np.swapaxes(to_axes, 1, 2))


TERMS: dict[str, Callable[[Strain, LocalCells, Array, bool], Terms]] = {
    "axes": axes_terms,
    "log": log_terms,
    "length": length_terms,
}
"""Of the repulsions, by their names in `energy.REPULSIONS`."""


class Stress(NamedTuple):
    """S (n, 3, 3) in the eigenbasis of C, r/L (n,), and derivatives of S by y and by C, (n, 6, 6)."""

    value: Array
    extension: Array
    by_cells: Array | None = None
    by_strain: Array | None = None


def stress(tissue: Tissue, terms: Callable[..., Terms], strain: Strain, cells: LocalCells, derivatives: bool) -> Stress:
    """S of points whose parameters are arrays (n,).

    Parameters
    ----------
    tissue
        Its matrix energy has `derivatives`, its parameters are arrays (n,).
    terms
        Of its repulsion, of `TERMS`.
    """
    chain, matrix = tissue.chain, tissue.matrix.derivatives  # type: ignore[attr-defined]
    assert chain is not None
    L, r0, c = tissue.contour_length, tissue.end_to_end_length, tissue.network_modulus
    A = cells.structure
    r = np.sqrt(np.einsum("nii,ni->n", A, strain.squared))
    extension = r / L if chain.locks else np.zeros_like(r)
    tiny = 1e-30
    stiffness = chain.stiffness(r + 1j * tiny, L)  # plain arithmetic: its derivative by a complex step
    g, slope = stiffness.real, stiffness.imag / tiny
    g0 = c * chain.stiffness(r0, L)
    repulsion = terms(strain, cells, r0, derivatives)
    of_matrix, by_strain = matrix(strain.squared, tissue.lame_lambda, tissue.lame_mu, derivatives)
    value = of_matrix + (c * g)[:, None, None] * A - g0[:, None, None] * repulsion.value
    if not derivatives:
        return Stress(value, extension)
    assert repulsion.by_cells is not None and repulsion.by_strain is not None
    a, by_cells = mandel.vectors(A), cells.structure_by_cells()
    steep = c * slope / (2 * r)
    along = np.einsum("na,nab->nb", mandel.on_diagonal(strain.squared), by_cells)
    by_cells = (
        mandel.dyads(steep[:, None] * a, along)
        + (c * g)[:, None, None] * by_cells
        - g0[:, None, None] * repulsion.by_cells
    )
    by_strain = by_strain + mandel.dyads(steep[:, None] * a, a) - g0[:, None, None] * repulsion.by_strain
    return Stress(value, extension, by_cells, by_strain)
