"""Whether the columns of the fibre angle say what they seem to: chains across the wall, fronts within a layer."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.body.domain import Domain
from remodel_fenicsx.body.shape import Shape
from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.fem.compat import geometry_dofmap
from remodel_fenicsx.state.memory import Numbers
from remodel_fenicsx.system.terminal import NOTICE

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

MOST = 0.5  # of the chains
# degrees between two points of an element that are a front, not a slope: within its elements the paper's artery turns
# by up to 14 degrees; and the share of a layer that such elements make up
FRONT_ANGLE, FRONT_SHARE = 45.0, 0.5


class RadialChains(Watcher):
    """Says once that more than half of the chains point out of the wall: the columns' angles are those of the others.

    A notice and no warning: the results are right, they have to be read otherwise.

    Parameters
    ----------
    stepper
        Whose solved states are looked at.
    radial_share
        Of dimensions, axes and places, as `Shape.radial_share`.
    """

    def __init__(self, stepper: Stepper, radial_share: Callable[[Array, Array, Array], Array]):
        self.state, self.radial_share = stepper.state, radial_share
        self._numbers = Numbers(stepper.state, "radial_chains", {"share": 0.0, "said": 0})

    def solved(self, step: Step) -> None:
        """Measure, until it was said."""
        if not self._numbers["said"]:
            cells, quadrature = self.state.cells, self.state.cells.quadrature
            share = self.radial_share(cells.dimension_values, cells.axis_values, quadrature.coordinates)
            self._numbers["share"] = quadrature.mean(share)

    def committed(self, step: Step) -> None:
        """Say it."""
        if self._numbers["said"] or self._numbers["share"] <= MOST:
            return
        self._numbers["said"] = True
        if self.state.comm.rank == 0:
            log.log(
                NOTICE,
                "time %g: more than half of the chains point out of the wall (radial_share %.2g); the fibre angles are "
                "those of the others",
                step.time,
                self._numbers["share"],
            )


class FrontsInLayers(Watcher):
    """Warns at the end where a layer's mean fibre angle is one of two families, with a front between them.

    Inside of an element a front lies between two points, wherever it would be: the mean over the element moves by steps
    with the mesh. What is no mean over a single layer of elements hardly notices.

    Parameters
    ----------
    stepper
        Whose last state is looked at.
    shape, domain
        With the layers (`Shape.angle_layers`) and the angles.
    """

    def __init__(self, stepper: Stepper, shape: Shape, domain: Domain):
        self.state, self.shape, self._found = stepper.state, shape, list[tuple[str, float, float]]()
        nodes = domain.mesh.geometry.x[geometry_dofmap(domain.mesh)]
        depths = shape.depth(nodes) if shape.angle_layers else np.zeros(nodes.shape[:-1])
        self._layers = {
            name: (depths.min(axis=1) <= share + 1e-6) & (depths.max(axis=1) >= share - 1e-6)
            for name, share in shape.angle_layers.items()
        }

    def solved(self, step: Step) -> None:
        """Look at the last state."""
        self._found = []
        if not step.is_last:
            return
        cells, quadrature = self.state.cells, self.state.cells.quadrature
        angles = self.shape.fibre_angle(cells.dimension_values, cells.axis_values, quadrature.coordinates)
        known = ~np.isnan(angles)
        least = np.where(known, angles, np.inf).min(axis=1)
        most = np.where(known, angles, -np.inf).max(axis=1)
        has_front = most - least > FRONT_ANGLE
        for name, layer in self._layers.items():
            share = quadrature.mean(np.repeat(has_front[:, None], quadrature.shape[1], axis=1).astype(float), layer)
            if share > FRONT_SHARE:
                inside = (layer & has_front)[:, None]
                low = quadrature.minimum(np.where(inside, least[:, None], np.inf))
                high = quadrature.maximum(np.where(inside, most[:, None], -np.inf))
                self._found.append((name, low, high))

    def committed(self, step: Step) -> None:
        """Say it."""
        for name, low, high in self._found if self.state.comm.rank == 0 else ():
            log.warning(
                "time %g: %s is a mean over elements in which the angle jumps, from %.3g to %.3g degrees: a front lies "
                "in them, and the mean depends on the mesh; set a larger mesh.refinement",
                step.time,
                name,
                low,
                high,
            )
