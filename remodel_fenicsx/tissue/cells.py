"""The state of the collagen network: cell dimensions l_I and axes n_I at every quadrature point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.scene import parameters
from remodel_fenicsx.tissue.energy import Cell
from remodel_fenicsx.fem.quadrature import Quadrature

Array = NDArray[np.float64]


class UnitCells:
    """Orthotropic unit cells at the quadrature points (paper, Fig. 2).

    Parameters
    ----------
    quadrature
        The points.
    cell_number
        Number of each local cell (ghosts included) in the mesh file's order, shape (cells,): the seed's index, so that
        random cells do not depend on the number of ranks.
    number_of_cells
        Cells of the whole mesh.
    settings
        `parameters.Cells`: initial dimensions, axes, seed, r0.

    Attributes
    ----------
    dimensions, axes
        dolfinx quadrature functions of shape (3,) and (3, 3); row I of `axes` is n_I.
    initial_dimensions
        l0_I by rank (not by direction), shape (cells, points, 3), in link lengths.
    """

    def __init__(
        self, quadrature: Quadrature, cell_number: NDArray[np.int64], number_of_cells: int, settings: parameters.Cells
    ):
        self.quadrature = quadrature
        self.settings = settings
        self.dimensions = quadrature.function("cell_dimensions", (3,))
        self.axes = quadrature.function("cell_axes", (3, 3))
        dimensions = initial_dimensions(settings, number_of_cells)[cell_number]
        self.dimension_values[:] = dimensions[:, None, :]
        self.axis_values[:] = initial_axes(settings.axes, quadrature.coordinates)
        self.initial_dimensions: Array = self.dimension_values.copy()

    @property
    def dimension_values(self) -> Array:
        """l_I, shape (cells, points, 3): the functions' own memory."""
        return self.quadrature.values(self.dimensions, (3,))

    @property
    def axis_values(self) -> Array:
        """n_I as rows, shape (cells, points, 3, 3): the functions' own memory."""
        return self.quadrature.values(self.axes, (3, 3))

    @property
    def ufl_cell(self) -> Cell:
        """The cell as the energy takes it."""
        return Cell(self.dimensions, self.axes)

    def set(self, dimensions: Array, axes: Array) -> None:
        """Replace all dimensions (cells, points, 3) and axes (cells, points, 3, 3)."""
        self.dimension_values[:] = dimensions
        self.axis_values[:] = axes

    def structure_tensor(self) -> Array:
        """A = sum_I l_I^2 n_I (x) n_I, shape (cells, points, 3, 3), in squared link lengths."""
        return structure_tensor(self.dimension_values, self.axis_values)


def structure_tensor(dimensions: Array, axes: Array) -> Array:
    """A = sum_I l_I^2 n_I (x) n_I from l (..., 3) and axes as rows (..., 3, 3)."""
    scaled = dimensions[..., :, None] * axes
    return np.swapaxes(scaled, -1, -2) @ scaled


def initial_dimensions(settings: parameters.Cells, number_of_cells: int) -> Array:
    """l_I at t = 0 of every cell of the mesh file, shape (number_of_cells, 3), in link lengths.

    `random`: |l| = r0 and l uniform on the positive octant of the sphere, one draw per element. The whole list is drawn
    on every rank, in the mesh file's order: the same cell gets the same draw for any number of ranks.
    """
    r0 = settings.end_to_end_length
    if settings.initial == "random":
        draws = np.abs(np.random.default_rng(settings.seed).standard_normal((number_of_cells, 3)))
        return r0 * draws / np.linalg.norm(draws, axis=1, keepdims=True)
    if settings.initial == "isotropic":
        lengths = [r0 / np.sqrt(3)] * 3
    elif settings.initial == "aligned":
        lengths = [r0 if axis == settings.aligned_axis else 0.0 for axis in (1, 2, 3)]
    else:
        lengths = [float(length) for length in settings.initial]
    return np.tile(lengths, (number_of_cells, 1))


def initial_axes(kind: str, coordinates: Array) -> Array:
    """n_I before the first pass, rows, shape (..., 3, 3), at reference coordinates (..., 3).

    `global`: x, y, z. `cylindrical`: circumferential, axial, radial about the z axis.
    """
    axes = np.zeros((*coordinates.shape[:-1], 3, 3))
    if kind == "global":
        axes[...] = np.eye(3)
        return axes
    radial = radial_direction(coordinates)
    axes[..., 0, :] = circumferential_direction(coordinates)
    axes[..., 1, 2] = 1.0
    axes[..., 2, :] = radial
    return axes


def radial_direction(coordinates: Array) -> Array:
    """Unit vector away from the z axis at coordinates (..., 3)."""
    radius = np.linalg.norm(coordinates[..., :2], axis=-1, keepdims=True)
    return np.concatenate([coordinates[..., :2] / radius, np.zeros_like(radius)], axis=-1)


def circumferential_direction(coordinates: Array) -> Array:
    """Unit vector about the z axis, counter-clockwise, at coordinates (..., 3)."""
    radial = radial_direction(coordinates)
    return np.stack([-radial[..., 1], radial[..., 0], np.zeros_like(radial[..., 0])], axis=-1)


def angle_to_axis(dimensions: Array, axes: Array, direction: Array) -> Array:
    """Angle in degrees between the chain direction and a unit vector, from the structure tensor: (..., ) in [0, 90].

    cos^2 = d . A d / tr A, which is the angle of sum_I l_I n_I when d is one of the axes (docs/theory.md). The part
    across d is summed by itself, so that small angles keep their digits.
    """
    along = np.einsum("...ij,...j->...i", axes, np.broadcast_to(direction, dimensions.shape))
    parallel = along[..., None] * np.broadcast_to(direction, dimensions.shape)[..., None, :]
    across = _norm(axes - parallel)
    return np.degrees(np.arctan2(_norm(dimensions * across), _norm(dimensions * along)))


def pitch_angle(dimensions: Array, axes: Array, coordinates: Array) -> Array:
    """Angle in degrees of the chain direction in the wall of a tube about z, from circumferential (0) to axial (90).

    atan sqrt(A_zz / A_tt) with the structure tensor A and t the circumferential direction.
    """
    circumferential = np.einsum("...ij,...j->...i", axes, circumferential_direction(coordinates))
    return np.degrees(np.arctan2(_norm(dimensions * axes[..., 2]), _norm(dimensions * circumferential)))


def _norm(vectors: Array) -> Array:
    return np.linalg.norm(vectors, axis=-1)
