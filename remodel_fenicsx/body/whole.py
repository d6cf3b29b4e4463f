"""Whole bodies for pictures, from the meshes of reductions: extended, revolved or mirrored.

Meshes are points (n, 3) and the corners of the elements (m, 2, 4 or 8) in VTK's order.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Corners = NDArray[np.int64]
Body = tuple[Array, Corners]

ROUND, LONG = 16, 12  # elements around and along, the paper's of its artery


def extended(points: Array, lines: Corners, length: float) -> Body:
    """Quadrilaterals of lines across z, from z = 0 to the length."""
    levels = np.linspace(0.0, length, LONG + 1)
    found = np.tile(points, (LONG + 1, 1))
    found[:, 2] = np.repeat(levels, len(points))
    first = np.arange(LONG)[:, None, None] * len(points) + lines
    return found, np.concatenate([first, first[..., ::-1] + len(points)], axis=-1).reshape(-1, 4)


def revolved(points: Array, quadrilaterals: Corners) -> Body:
    """Hexahedra around the z axis of quadrilaterals in the half-plane y = 0."""
    angles = 2 * np.pi * np.arange(ROUND) / ROUND
    radii, z = points[:, 0], np.tile(points[:, 2], ROUND)
    found = np.stack([np.outer(np.cos(angles), radii).ravel(), np.outer(np.sin(angles), radii).ravel(), z], axis=1)
    start = np.arange(ROUND)[:, None, None] * len(points)
    here, next_one = start + quadrilaterals, np.roll(start, -1, axis=0) + quadrilaterals
    return found, _oriented(found, np.concatenate([here, next_one], axis=-1).reshape(-1, 8))


def mirrored_twice(points: Array, elements: Corners) -> Body:
    """The quarter x > 0, y > 0 and its images in the planes x = 0 and y = 0; nodes on the planes are shared."""
    signs = np.array([(1.0, 1.0, 1.0), (-1.0, 1.0, 1.0), (-1.0, -1.0, 1.0), (1.0, -1.0, 1.0)])
    copies = (signs[:, None] * points).reshape(-1, 3)
    places = np.rint(copies / (1e-7 * np.abs(points).max())).astype(np.int64)
    _, first, number = np.unique(places, axis=0, return_index=True, return_inverse=True)
    every = (np.arange(4)[:, None, None] * len(points) + elements).reshape(-1, elements.shape[1])
    return copies[first], _oriented(copies[first], np.ravel(number)[every])


# corners of one side and of the side across from it, for each of three directions, and the order of the mirror image
_SIDES = {
    8: (((0, 3, 4, 7), (1, 2, 5, 6)), ((0, 1, 4, 5), (2, 3, 6, 7)), ((0, 1, 2, 3), (4, 5, 6, 7))),
    4: (((0,), (1,)), ((0,), (2,)), ((0,), (3,))),
}
_MIRRORED = {8: (0, 3, 2, 1, 4, 7, 6, 5), 4: (0, 2, 1, 3)}


def _oriented(points: Array, elements: Corners) -> Corners:
    """The same hexahedra or tetrahedra, all of positive volume as VTK has them."""
    size = elements.shape[1]
    along = [points[elements[:, b]].mean(axis=1) - points[elements[:, a]].mean(axis=1) for a, b in _SIDES[size]]
    is_mirrored = np.linalg.det(np.stack(along, axis=1)) < 0
    return np.where(is_mirrored[:, None], elements[:, _MIRRORED[size]], elements)


def divided_along(points: Array, hexahedra: Corners) -> Body:
    """One layer of hexahedra from a bottom to a top face across z, in `LONG` layers."""
    low, high = points[hexahedra[:, :4]], points[hexahedra[:, 4:]]
    share = np.linspace(0.0, 1.0, LONG + 1)[:, None, None, None]
    levels = (1.0 - share) * low + share * high  # (levels, elements, 4, 3)
    nodes = np.arange((LONG + 1) * len(hexahedra) * 4).reshape(LONG + 1, -1, 4)
    corners = np.concatenate([nodes[:-1], nodes[1:]], axis=-1).reshape(-1, 8)
    places = np.rint(levels.reshape(-1, 3) / (1e-7 * np.abs(points).max())).astype(np.int64)
    _, first, number = np.unique(places, axis=0, return_index=True, return_inverse=True)
    return levels.reshape(-1, 3)[first], np.ravel(number)[corners]


def box(side: float) -> Body:
    """The cube [0, side]^3, one element."""
    section = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    points = np.array([(*place, z) for z in (0.0, 1.0) for place in section])
    return side * points, np.arange(8)[None]


def cylinder(radius: float, length: float) -> Body:
    """About z, from z = 0 to the length: wedges, as hexahedra with one edge on the axis."""
    return revolved(*extended(np.array([(0.0, 0.0, 0.0), (radius, 0.0, 0.0)]), np.array([[0, 1]]), length))
