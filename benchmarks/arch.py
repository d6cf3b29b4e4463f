"""The lumen of an aortic arch with three branches, as a surface with five openings.

The numbers are round ones of an adult's aorta in mm: the arch has a radius of 40 and a lumen of
radius 12, and its descending part leads 60 further down. The branches have radii of 6, 4.5 and 5.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyvista
from numpy.typing import NDArray

Array = NDArray[np.float64]

ARCH, LUMEN, DOWN, UP = 40.0, 12.0, 60.0, 35.0  # mm; branches end at UP from the arch's axis
BRANCHES = ((115.0, 6.0), (92.0, 4.5), (70.0, 5.0))  # degrees along the arch, and radii
FILLET = 3.0  # mm, of the crotches


def _direction(degrees: float) -> Array:
    angle = np.radians(degrees)
    return np.array([np.cos(angle), 0.0, np.sin(angle)])


def _distance(places: Array) -> Array:
    """Return the signed distance from the lumen's wall, smooth at the crotches."""
    above = places[:, 2] >= 0
    angle = np.arctan2(np.where(above, places[:, 2], 0.0), places[:, 0])
    centre = ARCH * np.column_stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)])
    centre[:, 2] = np.where(above, centre[:, 2], places[:, 2])
    distance = np.linalg.norm(places - centre, axis=1) - LUMEN
    for degrees, radius in BRANCHES:
        axis = _direction(degrees)
        along = np.clip(places @ axis, ARCH, ARCH + 2 * UP)
        branch = np.linalg.norm(places - along[:, None] * axis, axis=1) - radius
        weight = np.clip(0.5 + 0.5 * (branch - distance) / FILLET, 0.0, 1.0)
        distance = branch * (1 - weight) + distance * weight - FILLET * weight * (1 - weight)
    return distance


def write_lumen(path: Path, size: float = 1.2) -> int:
    """Write the lumen's triangles, cut open, with edges of about this size; return their number."""
    low, high = np.array([-60.0, -20.0, -DOWN - 10]), np.array([60.0, 20.0, 100.0])
    counts = np.ceil((high - low) / size).astype(int) + 1
    grid = pyvista.ImageData(dimensions=counts, spacing=(size,) * 3, origin=low)
    grid["distance"] = _distance(np.asarray(grid.points))
    surface = grid.contour([0.0], scalars="distance").triangulate().clean()
    surface = surface.clip((0, 0, 1), origin=(0, 0, -DOWN), invert=False)
    for degrees, _ in BRANCHES:
        axis = _direction(degrees)
        surface = surface.clip(axis, origin=(ARCH + UP) * axis, invert=True)
    surface = surface.triangulate().clean().connectivity("largest").extract_surface().triangulate()
    surface.clear_data()
    surface.save(path)
    return int(surface.n_cells)
