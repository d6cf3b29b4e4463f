"""Bodies with a wall between an inner and an outer face: what is measured in it, and its local axes on any mesh."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.body.columns import Column
from remodel_fenicsx.body.shape import Array, Shape
from remodel_fenicsx.model.cells import pitch_angle, radial_share
from remodel_fenicsx.model.local_axes import LocalAxes
from remodel_fenicsx.settings import CONSTANT_FIELDS

if TYPE_CHECKING:
    from remodel_fenicsx.body.domain import Domain
    from remodel_fenicsx.fem.quadrature import Quadrature

AngleOf = Callable[[Any, Array], float]  # of a measurement and angles at its points
NODES_AT_A_DEPTH = 1e-3  # layers of nodes of a regular mesh have their depth to 1e-4
ANGLE_IN = "mean reference fibre angle (0 circumferential, 90 axial) of the chains in the wall, in the elements"


CONFIGURATIONS = {
    "unloaded": "measured in the unloaded body; it differs where the unloaded body has residual stress",
    "deformed": "measured in the deformed body, in local axes that move with it",
}
"""Configurations, beside that of the cells, whose angles may be asked for, each with its words."""


def _angle_at(face: str) -> AngleOf:
    """Mean angle over the elements that have a facet on a face."""

    def elements(m: Any) -> NDArray[np.bool_]:
        from remodel_fenicsx.body.axis_fields import cells_of, facets_of

        found = np.zeros(m.quadrature.shape[0], dtype=np.bool_)
        found[cells_of(m.domain.mesh, facets_of(m.domain, [face]))[0]] = True
        return found

    def value(m: Any, angle: Array) -> float:
        chosen = m.tool(("elements at", face), lambda: elements(m))
        return float(m.quadrature.mean_of_known(angle, chosen))

    return value


def _middle_angle(m: Any, angle: Array) -> float:
    """Mean angle over the elements that are half-way through the wall; there are some in every mesh."""

    def elements() -> NDArray[np.bool_]:
        from remodel_fenicsx.fem.compat import geometry_dofmap

        depths = m.state.cells.local_axes.nodal_depth[geometry_dofmap(m.domain.mesh)]
        low, high = depths.min(axis=1) - NODES_AT_A_DEPTH, depths.max(axis=1) + NODES_AT_A_DEPTH
        return np.asarray((low <= 0.5) & (high >= 0.5), dtype=np.bool_)

    return float(m.quadrature.mean_of_known(angle, m.tool("middle elements", elements)))


def angle_columns(means: Mapping[str, tuple[str, AngleOf]]) -> tuple[Column, ...]:
    """Of the cells' own configuration.

    Parameters
    ----------
    means
        By where, "inner" say: which elements they are, in words, and the mean over them.
    """
    return tuple(
        Column(
            f"fibre_angle_{where}",
            "degrees",
            f"{ANGLE_IN} {words}",
            partial(_of, mean, "fibre_angle"),
            by_case=False,
        )
        for where, (words, mean) in means.items()
    )


def angle_columns_on_request(means: Mapping[str, tuple[str, AngleOf]]) -> tuple[Column, ...]:
    """Of the other configurations."""
    return tuple(
        Column(
            f"fibre_angle_{name}_{where}",
            "degrees",
            f"as `fibre_angle_{where}`, but {meaning}",
            partial(_of, mean, f"fibre_angle_{name}"),
        )
        for name, meaning in CONFIGURATIONS.items()
        for where, (_, mean) in means.items()
    )


def _of(mean: AngleOf, name: str, m: Any) -> float:
    return mean(m, getattr(m, name))


class Walled(Shape):
    """A body with a wall: angles are those in it."""

    columns_on_request: ClassVar[tuple[Column, ...]] = (
        Column(
            "radial_share",
            "",
            "share of the chains that points out of the wall, the volume mean of A_rr / tr A: 0 none, 1 all",
            lambda m: m.quadrature.mean(m.radial_share),
            by_case=False,
        ),
    )
    angle_layers: ClassVar[dict[str, float]] = {
        "fibre_angle_inner": 0.0,
        "fibre_angle_middle": 0.5,
        "fibre_angle_outer": 1.0,
    }
    has_a_wall: ClassVar[bool] = True
    depth_in_words: ClassVar[tuple[str, str, str]] = ("through the wall", "inside", "outside")
    angle_in_words: ClassVar[tuple[str, str]] = ("around", "along")

    def fibre_angle(self, dimensions: Array, axes: Array, local: Array) -> Array:
        """Angle of the chain direction in the wall, degrees, (...,): circumferential 0, axial 90, NaN across."""
        return pitch_angle(dimensions, axes, local)

    def radial_share(self, dimensions: Array, axes: Array, local: Array) -> Array:
        """Share of the chains across the wall, A_rr / tr A, (...,)."""
        return radial_share(dimensions, axes, local)


MEANS_ON_A_MESH: dict[str, tuple[str, AngleOf]] = {
    "inner": ("with a facet on the inner face", _angle_at("inner")),
    "middle": ("half-way through the wall", _middle_angle),
    "outer": ("with a facet on the outer face", _angle_at("outer")),
}


class WalledMesh(Walled):
    """A body with a wall whose local axes are found on its mesh.

    Faces "inner" and "outer" lie across the wall from each other, "inlet" and "outlet" across the body.
    """

    columns: ClassVar[tuple[Column, ...]] = angle_columns(MEANS_ON_A_MESH)
    columns_on_request: ClassVar[tuple[Column, ...]] = (
        *angle_columns_on_request(MEANS_ON_A_MESH),
        *Walled.columns_on_request,
    )
    axis_kinds: ClassVar[tuple[str, ...]] = ("local", "global")
    constant_fields: ClassVar[tuple[str, ...]] = CONSTANT_FIELDS
    defaults: ClassVar[dict[str, Any]] = {"cells": {"axes": "local"}}

    def local_axes(self, domain: Domain, quadrature: Quadrature) -> LocalAxes:
        """Found on the mesh by a few linear solves. Collective.

        Raises
        ------
        SceneError
            If the wall has none.
        """
        from remodel_fenicsx.body.local_axes import found_axes

        return found_axes(domain, quadrature)

    def depth(self, coordinates: Array) -> Array:
        """No function of the place: where it was not recorded all is one layer."""
        return np.zeros(coordinates.shape[:-1])
