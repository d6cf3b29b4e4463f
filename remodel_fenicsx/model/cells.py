"""Orthotropic unit cells of the collagen network: dimensions l_I along axes n_I, arrays or UFL."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from remodel_fenicsx._lazy import Late
from remodel_fenicsx.model.chains import UflOrArray
from remodel_fenicsx.model.tensors import is_array, Array

ufl = Late("ufl")


class UnitCell(NamedTuple):
    """Orthotropic eight-chain unit cell, whole or weighted (paper, Fig. 2).

    Attributes
    ----------
    dimensions
        l_I in link lengths: UFL vector of length 3, or array (..., 3).
    axes
        n_I: UFL tensor (3, 3) or array (..., 3, 3); row I is the unit vector n_I in the reference
        configuration.
    weight
        Weight of this cell in r^2 and in W_rep; one for a whole cell. A blend of an old and a new
        cell, whose weights add up to one, applies a remodeling increment in substeps.

    Examples
    --------
    Two cells along the axes, the second cell stretched to twice its length along x:

    >>> import numpy as np
    >>> from remodel_fenicsx.extend import UnitCell, squared_end_to_end_length
    >>> cells = UnitCell(np.full((2, 3), 3**-0.5), np.broadcast_to(np.eye(3), (2, 3, 3)))
    >>> F = np.stack([np.eye(3), np.diag([2.0, 1.0, 1.0])])
    >>> squared_end_to_end_length(F, [cells]).round(4)  # r^2
    array([1., 2.])
    """

    dimensions: UflOrArray
    axes: UflOrArray
    weight: UflOrArray = 1.0

    def copy(self) -> UnitCell:
        """Return a cell with copies of the arrays."""
        return UnitCell(self.dimensions.copy(), self.axes.copy(), self.weight)

    def squared_stretches(self, deformation_gradient: UflOrArray) -> list[UflOrArray]:
        """Return I_I = n_I . C n_I, the squared stretches along the three axes (eq. 5).

        Parameters
        ----------
        deformation_gradient
            F, UFL of shape (3, 3) or array (..., 3, 3).
        """
        if is_array(deformation_gradient):  # by component, three times as fast as np.einsum
            F, n = components_first(deformation_gradient), components_first(self.axes)
            along = [F[:, 0] * n[i, 0] + F[:, 1] * n[i, 1] + F[:, 2] * n[i, 2] for i in range(3)]
            return [(fibre**2).sum(axis=0) for fibre in along]
        fibres = [ufl.dot(deformation_gradient, self.axes[i, :]) for i in range(3)]
        return [ufl.inner(fibre, fibre) for fibre in fibres]


def structure_tensor(dimensions: Array, axes: Array) -> Array:
    """Return A = sum_I l_I^2 n_I (x) n_I from l (..., 3) and axes as rows (..., 3, 3)."""
    scaled = dimensions[..., :, None] * axes
    return np.swapaxes(scaled, -1, -2) @ scaled


def global_axes(coordinates: Array) -> Array:
    """Return the axes x, y, z as rows, (..., 3, 3), at coordinates (..., 3)."""
    return np.tile(np.eye(3), (*coordinates.shape[:-1], 1, 1))


def turned_about_z(axes: Array, angle: float) -> Array:
    """Return axes as rows (..., 3, 3), turned about z from x towards y by an angle in degrees."""
    x = np.exp(1j * np.radians(angle))
    return axes @ [[x.real, x.imag, 0.0], [-x.imag, x.real, 0.0], [0.0, 0.0, 1.0]]


def cylindrical_axes(coordinates: Array) -> Array:
    """Return circumferential, axial and radial direction about z as rows, (..., 3, 3)."""
    axes = np.zeros((*coordinates.shape[:-1], 3, 3))
    radial = coordinates[..., :2] / np.linalg.norm(coordinates[..., :2], axis=-1, keepdims=True)
    axes[..., 0, 0], axes[..., 0, 1] = -radial[..., 1], radial[..., 0]
    axes[..., 1, 2] = 1.0
    axes[..., 2, :2] = radial
    return axes


def angle_to_axis(dimensions: Array, axes: Array, direction: Array) -> Array:
    """Return the angle in degrees between the chain direction and a unit vector.

    cos^2 = d . A d / tr A with the structure tensor A. If d is one of the axes, it is the angle of
    sum_I l_I n_I (docs/model.md, Fibre angles). The component across d is summed separately, so
    that small angles keep their digits.

    Parameters
    ----------
    dimensions
        l_I, (..., 3), in any unit of length.
    axes
        n_I as rows, (..., 3, 3).
    direction
        A unit vector, (3,) or (..., 3).

    Returns
    -------
    array
        Degrees, (...,), from 0 to 90.

    Examples
    --------
    Chains of an isotropic cell:

    >>> import numpy as np
    >>> from remodel_fenicsx.extend import angle_to_axis
    >>> angle_to_axis(np.ones((1, 3)), np.eye(3)[None], np.array([0.0, 0.0, 1.0])).round(4)
    array([54.7356])
    """
    along = np.einsum("...ij,...j->...i", axes, np.broadcast_to(direction, dimensions.shape))
    parallel = along[..., None] * np.broadcast_to(direction, dimensions.shape)[..., None, :]
    across = _norm(axes - parallel)
    return np.degrees(np.arctan2(_norm(dimensions * across), _norm(dimensions * along)))


# Fraction of tr A. Below it the direction in the wall is rounding error, and no picture shows it.
MIN_IN_PLANE_FRACTION = 1e-6


def pitch_angle(dimensions: Array, axes: Array, local: Array) -> Array:
    """Return the angle of the chains in the wall in degrees, circumferential (0) to axial (90)."""
    # atan sqrt(A_aa / A_cc) with the structure tensor A and local axes c, a, r as rows (..., 3, 3).
    # The angle is NaN if chains point out of the wall, A_aa + A_cc < IN_THE_WALL tr A.
    circumferential, axial, radial = _local_components(dimensions, axes, local)
    inside = circumferential**2 + axial**2
    angle: Array = np.degrees(np.arctan2(axial, circumferential))
    return np.where(inside < MIN_IN_PLANE_FRACTION * (inside + radial**2), np.nan, angle)


def radial_fraction(dimensions: Array, axes: Array, local: Array) -> Array:
    """Return A_rr / tr A from 0 (chains in the wall) to 1 (across the wall); 0 without chains."""
    circumferential, axial, radial = _local_components(dimensions, axes, local)
    trace = circumferential**2 + axial**2 + radial**2
    return np.divide(radial**2, trace, out=np.zeros_like(trace), where=trace > 0)


def _local_components(dimensions: Array, axes: Array, local: Array) -> list[Array]:
    """Return the square roots of A_cc, A_aa and A_rr."""
    l = components_first(dimensions, 1)
    n, d = components_first(axes), components_first(local)
    # Explicit sums of three products give the same numbers with every BLAS.
    along = (
        [n[i, 0] * d[k, 0] + n[i, 1] * d[k, 1] + n[i, 2] * d[k, 2] for i in range(3)]
        for k in range(3)
    )
    return [np.sqrt((l[0] * x) ** 2 + (l[1] * y) ** 2 + (l[2] * z) ** 2) for x, y, z in along]


def components_first(values: Array, order: int = 2) -> Array:
    """Move the components of vectors (..., 3) or tensors (..., 3, 3) to the front."""
    # Numpy is twice as fast over all points then.
    last = tuple(range(-order, 0))
    return np.ascontiguousarray(np.moveaxis(values, last, range(order)))


def angle_between(first: UnitCell, second: UnitCell) -> Array:
    """Return the angle in degrees between the chain directions of two cells, (n,) in [0, 90]."""
    # For chains along one axis it is the angle between the axes. For two cells with the same axes
    # it is the angle between the directions sum_I l_I n_I. So it is at least the change of the
    # angle to any axis (`angle_to_axis`). It is also at least the change of the pitch times the
    # cosine of the angle out of the wall, and includes the change of that angle. To first order in
    # the change it is Bures' angle between A/tr A of both cells, ds^2 = sum_IJ
    # dA_IJ^2 / (a_I + a_J) / 2 in the axes of A with the principal values a.
    first_root = first.dimensions / _norm(first.dimensions)[:, None]  # the roots of a_I
    scaled = second.axes * (second.dimensions / _norm(second.dimensions)[:, None])[:, :, None]
    second_root = np.swapaxes(second.axes, 1, 2) @ scaled
    change = first.axes @ second_root @ np.swapaxes(first.axes, 1, 2) - first_root[
        :, :, None
    ] * np.eye(3)
    squared = first_root**2
    sums = squared[:, :, None] + squared[:, None, :]
    squares = (first_root[:, :, None] + first_root[:, None, :]) ** 2
    weight = np.divide(squares, 2 * sums, out=np.ones_like(sums), where=sums > 0)
    chord = np.sqrt((weight * change**2).sum(axis=(1, 2)))
    return np.degrees(2 * np.arcsin(np.minimum(0.5 * chord, np.sqrt(0.5))))


def _norm(vectors: Array) -> Array:
    """Return the length of vectors (..., 3); by columns, 5 times faster than np.linalg.norm."""
    return np.sqrt(vectors[..., 0] ** 2 + vectors[..., 1] ** 2 + vectors[..., 2] ** 2)
