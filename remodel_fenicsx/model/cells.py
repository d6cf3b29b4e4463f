"""Orthotropic unit cells of the collagen network: dimensions l_I along axes n_I, plain arrays or UFL."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx._lazy import Late
from remodel_fenicsx.model.chains import UflOrArray
from remodel_fenicsx.model.tensors import is_array

ufl = Late("ufl")
Array = NDArray[np.float64]


class UnitCell(NamedTuple):
    """An orthotropic eight-chain unit cell, or a share of one (paper, Fig. 2).

    Attributes
    ----------
    dimensions
        l_I in link lengths: UFL vector of length 3, or array (..., 3).
    axes
        n_I: UFL tensor (3, 3) or array (..., 3, 3); row I is the unit vector n_I in the reference configuration.
    weight
        Share of this cell in r^2 and in W_rep. One for a whole cell; a blend of an old and a new cell (weights that add
        up to one) is how a remodeling increment is applied in parts.

    Examples
    --------
    Two cells along the axes, the second one stretched to twice its length along x:

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
        """Arrays of its own."""
        return UnitCell(self.dimensions.copy(), self.axes.copy(), self.weight)

    def squared_stretches(self, deformation_gradient: UflOrArray) -> list[UflOrArray]:
        """I_I = n_I . C n_I, the squared stretches along the three axes (eq. 5).

        Parameters
        ----------
        deformation_gradient
            F, UFL of shape (3, 3) or array (..., 3, 3).
        """
        if is_array(deformation_gradient):  # by component, three times as fast as np.einsum
            F, n = by_component(deformation_gradient), by_component(self.axes)
            along = [F[:, 0] * n[i, 0] + F[:, 1] * n[i, 1] + F[:, 2] * n[i, 2] for i in range(3)]
            return [(fibre**2).sum(axis=0) for fibre in along]
        fibres = [ufl.dot(deformation_gradient, self.axes[i, :]) for i in range(3)]
        return [ufl.inner(fibre, fibre) for fibre in fibres]


def structure_tensor(dimensions: Array, axes: Array) -> Array:
    """A = sum_I l_I^2 n_I (x) n_I from l (..., 3) and axes as rows (..., 3, 3)."""
    scaled = dimensions[..., :, None] * axes
    return np.swapaxes(scaled, -1, -2) @ scaled


def global_axes(coordinates: Array) -> Array:
    """x, y, z at all points: rows, (..., 3, 3), at reference coordinates (..., 3)."""
    axes = np.zeros((*coordinates.shape[:-1], 3, 3))
    axes[...] = np.eye(3)
    return axes


def cylindrical_axes(coordinates: Array) -> Array:
    """Circumferential, axial and radial direction about the z axis: rows, (..., 3, 3), at coordinates (..., 3)."""
    axes = np.zeros((*coordinates.shape[:-1], 3, 3))
    radial = radial_direction(coordinates)
    axes[..., 0, 0], axes[..., 0, 1] = -radial[..., 1], radial[..., 0]
    axes[..., 1, 2] = 1.0
    axes[..., 2, :] = radial
    return axes


def radial_direction(coordinates: Array) -> Array:
    """Unit vector away from the z axis at coordinates (..., 3)."""
    radius = np.sqrt(coordinates[..., 0] ** 2 + coordinates[..., 1] ** 2)[..., None]
    return np.concatenate([coordinates[..., :2] / radius, np.zeros_like(radius)], axis=-1)


def angle_to_axis(dimensions: Array, axes: Array, direction: Array) -> Array:
    """Angle in degrees between the chain direction and a unit vector, from the structure tensor.

    cos^2 = d . A d / tr A, which is the angle of sum_I l_I n_I when d is one of the axes (docs/theory.md,
    Angles). The part across d is summed by itself, so that small angles keep their digits.

    Parameters
    ----------
    dimensions
        l_I, (..., 3), in any one unit of length.
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


IN_THE_WALL = 1e-6  # of tr A: of less a rounded A has no direction, and a chain there has none that a picture shows


def pitch_angle(dimensions: Array, axes: Array, local: Array) -> Array:
    """Angle in degrees of the chain direction in the wall, from circumferential (0) to axial (90)."""
    # atan sqrt(A_aa / A_cc) with the structure tensor A and local axes c, a, r as rows (..., 3, 3); NaN where chains
    # point out of the wall, A_aa + A_cc < IN_THE_WALL tr A.
    circumferential, axial, radial = _local_components(dimensions, axes, local)
    inside = circumferential**2 + axial**2
    angle: Array = np.degrees(np.arctan2(axial, circumferential))
    return np.where(inside < IN_THE_WALL * (inside + radial**2), np.nan, angle)


def radial_share(dimensions: Array, axes: Array, local: Array) -> Array:
    """A_rr / tr A with local axes as rows, from 0 (chains in the wall) to 1 (across it); 0 where there are none."""
    circumferential, axial, radial = _local_components(dimensions, axes, local)
    trace = circumferential**2 + axial**2 + radial**2
    return np.divide(radial**2, trace, out=np.zeros_like(trace), where=trace > 0)


def _local_components(dimensions: Array, axes: Array, local: Array) -> list[Array]:
    """Roots of A_cc, A_aa and A_rr."""
    l, n, d = by_component(dimensions, 1), by_component(axes), by_component(local)
    # sums of three products, each rounded by itself: the same numbers with every BLAS
    along = ([n[i, 0] * d[k, 0] + n[i, 1] * d[k, 1] + n[i, 2] * d[k, 2] for i in range(3)] for k in range(3))
    return [np.sqrt((l[0] * x) ** 2 + (l[1] * y) ** 2 + (l[2] * z) ** 2) for x, y, z in along]


def by_component(values: Array, rank: int = 2) -> Array:
    """Vectors (..., 3) or tensors (..., 3, 3) with the components first: numpy is twice as fast over all points."""
    last = tuple(range(-rank, 0))
    return np.ascontiguousarray(np.moveaxis(values, last, range(rank)))


def angle_between(first: UnitCell, second: UnitCell) -> Array:
    """Angle in degrees between the directions of the chains of two cells, of n points: (n,) in [0, 90]."""
    # Of chains along one axis it is the angle between the axes; of two cells with the same axes that of the directions
    # sum_I l_I n_I. So it is at least the change of the angle to any axis (`angle_to_axis`), and of the pitch times the
    # cosine of the angle out of the wall, which it counts too. To first order in the change it is Bures' angle between
    # A/tr A of both, ds^2 = sum_IJ dA_IJ^2 / (a_I + a_J) / 2 in the axes of A with the principal values a.
    share = first.dimensions / _norm(first.dimensions)[:, None]  # the roots of a_I
    scaled = second.axes * (second.dimensions / _norm(second.dimensions)[:, None])[:, :, None]
    root = np.swapaxes(second.axes, 1, 2) @ scaled
    change = first.axes @ root @ np.swapaxes(first.axes, 1, 2) - share[:, :, None] * np.eye(3)
    squared = share**2
    both = squared[:, :, None] + squared[:, None, :]
    weight = np.divide((share[:, :, None] + share[:, None, :]) ** 2, 2 * both, out=np.ones_like(both), where=both > 0)
    chord = np.sqrt((weight * change**2).sum(axis=(1, 2)))
    return np.degrees(2 * np.arcsin(np.minimum(0.5 * chord, np.sqrt(0.5))))


def _norm(vectors: Array) -> Array:
    """Length of vectors (..., 3); by columns, five times faster than np.linalg.norm."""
    return np.sqrt(vectors[..., 0] ** 2 + vectors[..., 1] ** 2 + vectors[..., 2] ** 2)
