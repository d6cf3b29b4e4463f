"""What a tube without loads does when it is cut along its length: it opens to a sector.

The mesh's ring of radii R becomes a sector of radii rho(R), in cylindrical axes

    F = diag(k rho/R, e, drho/dR),    F_e = F G,

without pressure, axial force and bending moment; its opening angle is 360 (1 - k). The cells stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.model.closing import Closing, Layer, principal_stresses, solved
from remodel_fenicsx.model.energy import TURNED_OVER, Tissue
from remodel_fenicsx.model.panels import Panels

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
    """What is known of the ring: its layers' tissues, points, and G and l_I there, (panels, points, 3)."""

    tissues: tuple[Tissue, ...]
    panels: Panels
    natural: Array
    dimensions: Array


def cut(layers: Sequence[Layer], closed: Closing | None, radius: Array, squared_dimensions: Array) -> Cut:
    """Cut an unloaded tube.

    Parameters
    ----------
    layers
        Of the ring that is the mesh.
    closed
        Of what it was closed; None: the mesh is free of stress before any remodeling.
    radius, squared_dimensions
        Places through the wall (n,), increasing, and l_I^2 there around, along and across it, (n, 3); with
        turnover also content and natural length, (n, 5).

    Raises
    ------
    ArithmeticError
        If no equilibrium is found.
    """
    panels = Panels([layers[0].radii[0], *(layer.radii[1] for layer in layers)], CUT_DEGREE)
    squared = np.empty((*panels.places.shape, squared_dimensions.shape[1]))
    panel = panels.of(radius)
    for number, at in enumerate(panels.places):  # what lies in a layer says nothing of the next
        here = panel == number
        rows = radius[here], squared_dimensions[here]
        squared[number] = np.stack([np.interp(at, rows[0], column) for column in rows[1].T], axis=-1)
    squared, turned = squared[..., :3], np.moveaxis(squared[..., 3:], -1, 0)
    natural, start = np.ones_like(squared), (panels.places.copy(), 1.0, 1.0)
    if closed is not None:
        fine = closed._replace(layers=tuple(layers), panels=panels, radius=closed.natural_radius(panels.places))
        natural = fine.at_panels()
        start = (fine.radius, 1 / closed.axial, 1 / closed.circumferential)  # what opens, were the cells as they were
    tissues = []
    for number, layer in enumerate(layers):
        changes: dict[str, Any] = dict(zip(TURNED_OVER, turned[:, number], strict=False))  # none without turnover
        tissues.append(replace(layer.tissue, **changes))
    wall = _Wall(tuple(tissues), panels, natural, np.sqrt(np.maximum(squared, 0.0)))
    values: Array = np.concatenate([start[0].ravel(), start[1:]])
    scale: Array = np.concatenate([np.full(panels.places.size, panels.edges[-1]), [1.0, 1.0]])
    stiffness = max(tissue.lame_lambda + 2 * tissue.lame_mu for tissue in tissues)
    found = solved(partial(_residual, wall, stiffness), values, scale, stiffness)
    return Cut(360.0 * (1.0 - float(found[-1])), (float(found[0]), float(found[-3])), float(found[-2]))


def _residual(wall: _Wall, stiffness: float, values: Array) -> Array:
    """Radial balance in the layers, what goes on between them, both faces, axial force and bending moment: stresses."""
    panels, axial, k = wall.panels, values[-2], values[-1]
    ring, half = panels.places, (panels.edges[-1] - panels.edges[0]) / 2
    rho = values[:-2].reshape(ring.shape)
    slope = panels.derivative(rho)
    stretches = np.stack([k * rho / ring, np.full_like(rho, axial), slope], axis=-1) * wall.natural
    stresses = [principal_stresses(t, stretches[n], wall.dimensions[n]) for n, t in enumerate(wall.tissues)]
    hoop, along, radial = np.moveaxis(np.array(stresses), -1, 0)
    balance = (panels.derivative(radial) + (radial - hoop) * slope / rho)[:, 1:-1] * half
    between = panels.jumps(rho) / ring[0, 0] * stiffness
    means = [panels.integral(density * rho * slope) / half / (rho[0, 0] + rho[-1, -1]) for density in (along, hoop)]
    faces = [radial[0, 0], radial[-1, -1]]
    return np.concatenate([balance.ravel(), faces, panels.jumps(radial), between, means])


def means_through(radius: Array, values: Array, weights: Array, number: int) -> tuple[Array, Array]:
    """Radius and values (n, 3) at points, averaged in as many layers of one thickness as hold a point, by weight."""
    edges = np.linspace(radius.min(), radius.max() * (1 + 1e-12), number + 1)
    layer = np.clip(np.searchsorted(edges, radius, side="right") - 1, 0, number - 1)
    total = np.bincount(layer, weights, number)
    some = total > 0
    means = [np.bincount(layer, weights * column, number)[some] / total[some] for column in (radius, *values.T)]
    return means[0], np.stack(means[1:], axis=-1)
