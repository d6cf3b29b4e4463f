"""The natural configuration at the points of a mesh: G leads from where the tissue is free of stress to the mesh."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.body.wall import Wall
from remodel_fenicsx.model.residual_stress import UNSTRETCHED, Layer
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.model.axes import LocalAxes
from remodel_fenicsx.schema.settings import Natural

if TYPE_CHECKING:
    from remodel_fenicsx.body.domain import Domain

Array = NDArray[np.float64]


def tube_layers(wall: Wall, natural: Natural, tissues: Mapping[str, Tissue]) -> list[Layer]:
    """Of a round wall: where tissue or prestretch change."""
    inner, outer = wall.radii[0], wall.radii[-1]
    edges = set(wall.radii)
    for layer in natural.layers:
        edges |= {inner + share * (outer - inner) for share in layer.share}
    apart = [a for a, b in itertools.pairwise(sorted(edges)) if b - a > 1e-9 * outer] + [outer]
    found = []
    for low, high in itertools.pairwise(apart):
        middle = (low + high) / 2
        region = wall.names[int(np.searchsorted(wall.radii[1:-1], middle))]
        share = (middle - inner) / (outer - inner)
        of_layer = [
            layer.prestretch.stretches
            for layer in natural.layers
            if (layer.share[0] <= share < layer.share[1] if layer.region is None else layer.region == region)
        ]
        found.append(Layer((low, high), tissues[region if region in tissues else ""], (*of_layer, UNSTRETCHED)[0]))
    return found


def prestretch(natural: Natural, local_axes: LocalAxes, domain: Domain) -> Array:
    """Circumferential, axial and radial stretch of the layers at the points, (elements, points, 3)."""
    depth = local_axes.depth
    found = np.ones((*depth.shape, 3))
    for layer in natural.layers:
        if layer.region is not None:
            found[domain.element_region == domain.regions[layer.region]] = layer.prestretch.stretches
        else:
            low, high = layer.share
            found[(depth >= low) & ((depth < high) | (high == 1.0))] = layer.prestretch.stretches
    return found


def gradient(stretches: Array, axes: Array) -> Array:
    """G (..., 3, 3) of stretches (..., 3) along axes, rows (..., 3, 3)."""
    found: Array = np.swapaxes(axes, -1, -2) @ (stretches[..., None] * axes)
    return found
