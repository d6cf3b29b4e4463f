"""What a tube without loads does when it is cut along its length: it opens to a sector.

The mesh's ring of radii R becomes a sector of radii rho(R), in cylindrical axes

    F = diag(drho/dR, k rho/R, e),    F_e = F G,

without pressure, axial force and bending moment; its opening angle is 360 (1 - k). The cells stay.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from remodel_fenicsx.model.closing import Closing, principal_stresses, solved
from remodel_fenicsx.model.energy import Tissue

Array = NDArray[np.float64]
CUT_DEGREE = 32  # of rho(R): angles of remodeled walls, whose cells have a front, change by less than 0.1 degrees to 48


class Cut(NamedTuple):
    """A ring that has been cut.

    Attributes
    ----------
    opening_angle
        Angle of the sector that is missing, in degrees; below 0 the ends overlap.
    radii
        Inner and outer radius of the sector.
    axial
        Its length over that of the ring.
    """

    opening_angle: float
    radii: tuple[float, float]
    axial: float


class _Wall(NamedTuple):
    """What is known of the ring: tissue, radii of the mesh, Chebyshev places, G and l_I there, (places, 3)."""

    tissue: Tissue
    radii: tuple[float, float]
    places: Array
    natural: Array
    dimensions: Array


def cut(
    tissue: Tissue, radii: tuple[float, float], closed: Closing | None, radius: Array, squared_dimensions: Array
) -> Cut:
    """Cut an unloaded tube.

    Parameters
    ----------
    tissue
        Its parameters are numbers.
    radii
        Of the ring that is the mesh.
    closed
        Of which sector it is made; None: the mesh is free of stress before any remodeling.
    radius, squared_dimensions
        Places through the wall (n,), increasing, and l_I^2 there around, along and across it, (n, 3).

    Raises
    ------
    ArithmeticError
        If no equilibrium is found.
    """
    places = np.cos(np.pi * np.arange(CUT_DEGREE, -1, -1) / CUT_DEGREE)
    at = radii[0] + (radii[1] - radii[0]) * (places + 1) / 2
    squared = np.stack([np.interp(at, radius, column) for column in squared_dimensions.T], axis=-1)
    natural = np.ones((len(at), 3)) if closed is None else closed.stretches(at)
    wall = _Wall(tissue, radii, places, natural, np.sqrt(np.maximum(squared, 0.0)))
    start = (at, 1.0, 1.0)
    if closed is not None:  # what opens, were the cells as they were
        start = (closed.natural_radius(at), 1 / closed.axial, 1 / closed.circumferential)
    values: Array = np.concatenate([start[0], start[1:]])
    scale: Array = np.concatenate([np.full(len(at), radii[1]), [1.0, 1.0]])
    found = solved(partial(_residual, wall), values, scale, tissue.lame_lambda + 2 * tissue.lame_mu)
    return Cut(360.0 * (1.0 - float(found[-1])), (float(found[0]), float(found[-3])), float(found[-2]))


def _residual(wall: _Wall, values: Array) -> Array:
    """Radial balance inside, radial stress on both faces, axial force and bending moment; all as stresses."""
    rho, axial, k = values[:-2], values[-2], values[-1]
    places, half = wall.places, (wall.radii[1] - wall.radii[0]) / 2
    radius = wall.radii[0] + half * (places + 1)
    slope = chebyshev.chebval(places, chebyshev.chebder(chebyshev.chebfit(places, rho, CUT_DEGREE))) / half
    stretches = np.stack([k * rho / radius, np.full_like(rho, axial), slope], axis=-1)
    stresses = principal_stresses(wall.tissue, stretches * wall.natural, wall.dimensions)
    hoop, along, radial = np.moveaxis(stresses, -1, 0)
    change = chebyshev.chebval(places, chebyshev.chebder(chebyshev.chebfit(places, radial, CUT_DEGREE)))
    balance = change + (radial - hoop) * slope * half / rho

    def over_the_wall(density: Array) -> float:
        integral = chebyshev.chebint(chebyshev.chebfit(places, density * rho * slope, CUT_DEGREE), lbnd=-1)
        return float(chebyshev.chebval(1.0, integral)) / (rho[0] + rho[-1])

    return np.concatenate([balance[1:-1], radial[[0, -1]], [over_the_wall(along), over_the_wall(hoop)]])


def means_through(radius: Array, values: Array, weights: Array, number: int) -> tuple[Array, Array]:
    """Radius and values (n, 3) at points, averaged in as many layers of one thickness as hold a point, by weight."""
    edges = np.linspace(radius.min(), radius.max() * (1 + 1e-12), number + 1)
    layer = np.clip(np.searchsorted(edges, radius, side="right") - 1, 0, number - 1)
    total = np.bincount(layer, weights, number)
    some = total > 0
    means = [np.bincount(layer, weights * column, number)[some] / total[some] for column in (radius, *values.T)]
    return means[0], np.stack(means[1:], axis=-1)
