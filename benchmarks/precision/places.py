"""The paper's mesh at its quadrature points: what means over places smooth."""

from __future__ import annotations

import numpy as np

from benchmarks.precision.kept import Kept
from remodel_fenicsx.scene.scene import Scene
from tests.reference.radial import solve_radial
from tests.runs import simulated


def run(scene: Scene, kept: Kept) -> None:
    """Errors of the fibre angle in degrees at the end, by radius, against the reference with the scene's own steps."""
    if "places" in kept:
        return
    with simulated(scene.with_values({"model.kinematics": "sector", "output.fields": False})) as (simulation, _):
        coordinates, cells = simulation.quadrature.coordinates, simulation.cells
    angles = scene.geometry.fibre_angle(cells.dimension_values, cells.axis_values, cells.local_axes.axes).ravel()
    radii = np.hypot(coordinates[..., 0], coordinates[..., 1]).ravel()
    exact = solve_radial(end=scene.time.end, step=scene.time.step)
    error = np.abs(angles - np.interp(radii, exact.points, exact.fibre_angle()))
    kept.keep("places", {"radii": radii, "error": error})


def words(kept: Kept) -> str:
    """What the page says of it."""
    radii, error = (kept["places"][name] for name in ("radii", "error"))
    worst = radii[error.argmax()]
    return f"{error.mean():.1f} degrees in the mean over the points, {error.max():.1f} in the front, at R = {worst:.2g}"
