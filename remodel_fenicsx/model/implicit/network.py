"""Stress of matrix and network on arrays, with its derivatives by strain and by cells: what a condensed tangent needs.

Everything is in the eigenbasis of C, where C is diagonal. Symmetric tensors are Mandel vectors, derivatives 6 x 6
matrices (`tensors`). Cells are given by six numbers y of their own: the structure tensor itself, or the three lengths
and the three turns of an orthotropic cell.

    S = S_matrix + c (g(r) A - g(r0) G),    r^2 = A : C,    G = dM/dC

With turnover it is m c (g(r/rho)/rho^2 A - g(r0) G), m and rho those at the end of a step as functions of r.

Points are named tuples of arrays, one entry of each array a point: `at` takes some of them, `put` puts some into them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.model import tensors
from remodel_fenicsx.model.cells import UnitCell, structure_tensor
from remodel_fenicsx.model.energy import BY_AXES, BY_LENGTH, BY_LOG, Repulsion, Tissue
from remodel_fenicsx.model.turnover import TurnedOver

Array = NDArray[np.float64]


def at(points: Any, chosen: Any) -> Any:
    """Some of the points, by mask or by number; what is no array is the same at all of them."""
    if isinstance(points, tuple):
        return type(points)(*(at(values, chosen) for values in points))  # type: ignore[call-arg]
    return points[chosen] if isinstance(points, np.ndarray) else points


def put(points: Any, chosen: Any, better: Any) -> None:
    """Put some of the points into all of them."""
    for values, others in zip(points, better, strict=True):
        if isinstance(values, tuple):
            put(values, chosen, others)
        elif isinstance(values, np.ndarray):
            values[chosen] = others


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
        return cls(gradient, *tensors.eigen(np.swapaxes(gradient, 1, 2) @ gradient))

    @property
    def stretches(self) -> Array:
        """Eigenvalues of U, (n, 3)."""
        return np.sqrt(self.squared)

    @property
    def rotation(self) -> Array:
        """R of F = R U in the eigenbasis."""
        turned = tensors.rotated(self.gradient, self.basis)
        quotient: Array = turned / self.stretches[:, None, :]
        return quotient

    @property
    def by_gradient(self) -> Array:
        """dC/dF, (n, 6, 9): dC = dF^T F + F^T dF in the eigenbasis, dF in the global one, row by row."""
        carried, Q = self.gradient @ self.basis, self.basis
        both = _dyads_of_columns(carried, Q, tensors.ROWS, tensors.COLUMNS)
        both += _dyads_of_columns(carried, Q, tensors.COLUMNS, tensors.ROWS)
        found: Array = tensors.FACTORS[:, None] * both
        return found

    @property
    def turn_by_gradient(self) -> Array:
        """dw/dF, (n, 3, 9), of turns dR = R W: w_ij = ((R^T dF)_ij - (R^T dF)_ji)/(u_i + u_j) in the eigenbasis."""
        u, (i, j) = self.stretches, np.transpose(tensors.PAIRS)
        axes = self.gradient @ self.basis / u[:, None, :]  # R Q
        both = _dyads_of_columns(axes, self.basis, i, j) - _dyads_of_columns(axes, self.basis, j, i)
        found: Array = both / (u[:, i] + u[:, j])[:, :, None]
        return found

    @property
    def stretch_by_strain(self) -> Array:
        """dU/dC, (n, 6, 6): 1/(u_i + u_j)."""
        u = self.stretches
        return tensors.diagonal(1 / (u[:, :, None] + u[:, None, :]))

    def inside(self, components: Array) -> Array:
        """Components of tensors (n, 3, 3) in the eigenbasis."""
        return tensors.rotated(components, self.basis)

    def outside(self, components: Array) -> Array:
        """Components in the global basis of tensors in the eigenbasis."""
        return tensors.rotated(components, np.swapaxes(self.basis, 1, 2))


def _dyads_of_columns(left: Array, right: Array, i: Any, j: Any) -> Array:
    """Column i of one matrix times column j of another, row by row, for numbers i and j: (n, len(i), 9)."""
    dyads = left[:, :, None, i] * right[:, None, :, j]
    return np.moveaxis(dyads.reshape(len(left), 9, len(i)), 2, 1)


class StructureCells(NamedTuple):
    """Cells of n points in the eigenbasis of C that are their structure tensor: y is A (n, 3, 3)."""

    structure: Array

    def structure_by_cells(self) -> Array:
        """dA/dy, (n, 6, 6): the identity."""
        return np.broadcast_to(np.eye(6), (len(self.structure), 6, 6))


class OrthotropicCells(NamedTuple):
    """Cells with lengths and axes (rows): y is dl, and turns w_ij (`tensors.PAIRS`), dn_i = w n_j, dn_j = -w n_i."""

    cell: UnitCell

    @property
    def structure(self) -> Array:
        """A, (n, 3, 3)."""
        return structure_tensor(self.cell.dimensions, self.cell.axes)

    def to_axes(self) -> Array:
        """Matrix that takes components in the cell's axes to the eigenbasis of C."""
        return tensors.congruence(np.swapaxes(self.cell.axes, 1, 2))

    def structure_by_cells(self) -> Array:
        """dA = 2 l dl n n, and (l_i^2 - l_j^2) across the axes."""
        lengths = self.cell.dimensions
        entries = np.zeros((len(lengths), 6))
        entries[:, :3] = 2 * lengths
        for row, (i, j) in enumerate(tensors.PAIRS, start=3):
            entries[:, row] = np.sqrt(2) * (lengths[:, i] ** 2 - lengths[:, j] ** 2)
        columns: Array = self.to_axes() * entries[:, None, :]
        return columns


LocalCells = StructureCells | OrthotropicCells


class Terms(NamedTuple):
    """G = dM/dC (n, 3, 3), and its derivatives by cells and by C, (n, 6, 6); None where they were not asked for."""

    value: Array
    by_cells: Array | None
    by_strain: Array | None


def log_terms(strain: Strain, cells: LocalCells, r0: Array, derivatives: bool) -> Terms:
    """Of M = A : ln C."""
    values, A = strain.squared, cells.structure
    quotients = tensors.first_divided_differences(values)
    if not derivatives:
        return Terms(quotients * A, None, None)
    by_cells = quotients[:, tensors.ROWS, tensors.COLUMNS][:, :, None] * cells.structure_by_cells()
    return Terms(quotients * A, by_cells, tensors.second_derivative(values, A))


def length_terms(strain: Strain, cells: LocalCells, r0: Array, derivatives: bool) -> Terms:
    """Of M = r0^2 ln(A : C / r0^2)."""
    A, scale = cells.structure, r0[:, None, None] ** 2
    squared = np.einsum("nii,ni->n", A, strain.squared)[:, None, None]
    if not derivatives:
        return Terms(scale * A / squared, None, None)
    a, by_cells = tensors.to_mandel(A), cells.structure_by_cells()
    c = tensors.on_diagonal(strain.squared)
    across = tensors.dyads(a, np.einsum("na,nab->nb", c, by_cells))
    return Terms(
        scale * A / squared,
        scale * (by_cells / squared - across / squared**2),
        -scale * tensors.dyads(a, a) / squared**2,
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
    for column, (i, j) in enumerate(tensors.PAIRS, start=3):
        changes[:, column, column] = np.sqrt(2) * (entries[:, i] - entries[:, j])
        changes[:, i, column] = 2 * steepness[:, i] * C[:, i, j]
        changes[:, j, column] = -2 * steepness[:, j] * C[:, i, j]
    to_axes = cells.to_axes()
    along = to_axes * tensors.on_diagonal(steepness)[:, None, :]
    return Terms(value, to_axes @ changes, along @ np.swapaxes(to_axes, 1, 2))


TERMS: dict[Repulsion, Callable[[Strain, LocalCells, Array, bool], Terms]] = {
    BY_AXES: axes_terms,
    BY_LOG: log_terms,
    BY_LENGTH: length_terms,
}
"""Of the repulsions themselves: another of the same name has others."""


class Stress(NamedTuple):
    """S (n, 3, 3) in the eigenbasis of C, r/L (n,), and derivatives of S by y and by C, (n, 6, 6).

    With turnover r/(rho L), and ln m and ln rho (n, 2).
    """

    value: Array
    extension: Array
    by_cells: Array | None = None
    by_strain: Array | None = None
    turnover: Array | None = None


class Moduli(NamedTuple):
    """Of chains with length r: S = S_matrix + `chains` A - `repulsion` G, their slopes by r, and r/L; arrays (n,)."""

    chains: Array
    chains_slope: Array
    repulsion: Array
    repulsion_slope: Array
    extension: Array
    turnover: Array | None = None


def moduli(tissue: Tissue, r: Array, turned_over: TurnedOver | None) -> Moduli:
    """c g(r) and c g(r0); with turnover m c g(r/rho)/rho^2 and m c g(r0)."""
    chain, L, c = tissue.chain, tissue.contour_length, tissue.network_modulus
    assert chain is not None
    s = r if turned_over is None else r / turned_over.natural_length
    extension = s / L if chain.locks else np.zeros_like(r)
    tiny = 1e-30
    stiffness = chain.stiffness(s + 1j * tiny, L)  # plain arithmetic: its derivative by a complex step
    g, slope = stiffness.real, stiffness.imag / tiny
    g0 = c * chain.stiffness(tissue.end_to_end_length, L)
    if turned_over is None:
        return Moduli(c * g, c * slope, g0, np.zeros_like(r), extension)
    m, rho, by_m, by_rho = turned_over
    chains = m * c * g / rho**2
    relative = by_m + s * slope / g * (1.0 - by_rho) - 2.0 * by_rho
    logarithms = np.log(np.stack([m, rho], axis=1))
    return Moduli(chains, chains * relative / r, m * g0, m * g0 * by_m / r, extension, logarithms)


def stress(
    tissue: Tissue,
    terms: Callable[..., Terms],
    strain: Strain,
    cells: LocalCells,
    derivatives: bool,
    turned_over: Callable[[Tissue, Array], TurnedOver] | None = None,
) -> Stress:
    """S of points whose parameters are arrays (n,).

    Parameters
    ----------
    tissue
        Its matrix energy has `derivatives`, its parameters are arrays (n,).
    terms
        Of its repulsion, of `TERMS`.
    turned_over
        Content and natural length from the tissue and r, where they change within the step.
    """
    matrix, A = tissue.matrix.derivatives, cells.structure  # type: ignore[attr-defined]
    r = np.sqrt(np.einsum("nii,ni->n", A, strain.squared))
    chains = moduli(tissue, r, None if turned_over is None else turned_over(tissue, r))
    repulsion = terms(strain, cells, tissue.end_to_end_length, derivatives)
    of_matrix, by_strain = matrix(strain.squared, tissue.lame_lambda, tissue.lame_mu, derivatives)
    g, g0 = chains.chains[:, None, None], chains.repulsion[:, None, None]
    value = of_matrix + g * A - g0 * repulsion.value
    if not derivatives:
        return Stress(value, chains.extension, turnover=chains.turnover)
    assert repulsion.by_cells is not None and repulsion.by_strain is not None
    a, by_cells = tensors.to_mandel(A), cells.structure_by_cells()
    by_length = chains.chains_slope[:, None] * a
    if turned_over is not None:
        by_length = by_length - chains.repulsion_slope[:, None] * tensors.to_mandel(repulsion.value)
    steep = by_length / (2 * r)[:, None]  # by r^2 = A : C
    along = np.einsum("na,nab->nb", tensors.on_diagonal(strain.squared), by_cells)
    by_cells = tensors.dyads(steep, along) + g * by_cells - g0 * repulsion.by_cells
    by_strain = by_strain + tensors.dyads(steep, a) - g0 * repulsion.by_strain
    return Stress(value, chains.extension, by_cells, by_strain, chains.turnover)
