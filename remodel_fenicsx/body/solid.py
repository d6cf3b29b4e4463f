"""A body of one's own without a lumen: faces of any name, angles to an axis."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from remodel_fenicsx.body.mesh_body import FileBody
from remodel_fenicsx.body.shape import Column, LoadKind, cauchy_columns
from remodel_fenicsx.model.cells import angle_to_axis


class Solid(FileBody):
    """A body of your own from a mesh file, without a lumen: a gel between posts, a patch, a tendon of any shape.

    Its faces have any names; each that is held has a table `[supports.NAME]`. Directions are those of x, y and z.
    """

    loads: ClassVar[dict[str, LoadKind]] = {}
    columns: ClassVar[tuple[Column, ...]] = (
        Column(
            "fibre_angle",
            "degrees",
            "angle between chains and the axis `geometry.axis` in the reference body, mean over the volume",
            lambda m: m.quadrature.mean_of_known(m.fibre_angle),
        ),
        Column("volume", "length^3", "deformed volume", lambda m: m.quadrature.integral(np.linalg.det(m.F))),
    )
    columns_on_request: ClassVar[tuple[Column, ...]] = cauchy_columns("x", "y", "z")
    angle_in_words: ClassVar[tuple[str, str]] = ("along the axis", "across")
    depth_in_words: ClassVar[tuple[str, str, str]] = ("in the body", "", "")

    shape: Literal["solid"] = Field(default="solid", description="Which body it is.")
    axis: Literal["x", "y", "z"] = Field(default="x", description="The axis to which fibre angles are measured.")

    def fibre_angle(self, dimensions: Any, axes: Any, local: Any) -> Any:
        """To `axis`."""
        return angle_to_axis(dimensions, axes, np.eye(3)["xyz".index(self.axis)])

    def depth(self, coordinates: Any) -> Any:
        """The body is one layer."""
        return np.zeros(coordinates.shape[:-1])

    station = depth
