"""Cylindrical tendon, the paper's second specimen (Fig. 6)."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from remodel_fenicsx.body import gmsh_model as model
from remodel_fenicsx.body.reductions import Strut, cylinder
from remodel_fenicsx.body.shape import (
    Proportions,
    WithAxes,
    axial_dead_force,
    cauchy_columns,
    check_lengths,
    homogeneous_bar,
    uniaxial_columns,
)
from remodel_fenicsx.model.cells import global_axes
from remodel_fenicsx.model.tensors import Array
from remodel_fenicsx.schema.settings import Mesh
from remodel_fenicsx.schema.units import AREA, LENGTH

if TYPE_CHECKING:
    from mpi4py import MPI

    from remodel_fenicsx.body.domain import Domain
    from remodel_fenicsx.body.loading import Loading

# The paper's numbers of elements: around, along a side of the core, rings, along.
AROUND, CORE = 16, 4
RINGS, ALONG = 2, 10
# Position of the core's corners over the radius, and roundness of its sides from straight (0) to
# round (1). Smallest scaled Jacobian of the hexahedra: 0.86 (refinement 1), 0.83 (2), 0.81 (4).
CORE_RADIUS, CORE_ROUNDNESS = 0.65, 0.4


class Tendon(WithAxes):
    """Cylinder along z, fixed at its bottom, pulled at its top: the tendon of the paper's Fig. 6.

    Length and square root of the area: 1e-6 to 1e6, one up to 10,000 times the other.

    Its keyword arguments are the keys of `[geometry]`: `length` and `area` in the unit
    `length_unit`, or in any one unit.

    Raises
    ------
    SceneError
        If a value is not allowed: one line.

    Examples
    --------
    >>> from remodel_fenicsx import parts
    >>> body = parts.Tendon(length=10.0, area=1.0)
    >>> body.axial_length, body.section_area, list(body.loads)
    (10.0, 1.0, ['force'])
    >>> parts.Tendon(length=-1.0, area=1.0)
    Traceback (most recent call last):
        ...
    remodel_fenicsx.schema.tables.SceneError: length = -1.0: must be a finite number greater than 0
    """

    loads = {"force": axial_dead_force("top")}
    columns = uniaxial_columns("top", "length")
    columns_on_request = cauchy_columns("x", "y", "z")
    axis_kinds = ("global", "cylindrical")
    number_of_elements = 480
    face_names = ("bottom", "top", "side")
    reductions = {
        "point": homogeneous_bar(
            "bottom",
            "top",
            lambda shape: _dimensions(shape.length, shape.area, math.sqrt(shape.area / math.pi)),
            lambda shape: cylinder(outer_radius(shape.area), shape.length),
        ),
    }

    shape: Literal["tendon"] = "tendon"
    """Shape of the body."""
    length: Annotated[float, LENGTH] = Field(default=10.0, gt=0)
    """Length along z, in the scene's unit of length."""
    area: Annotated[float, AREA] = Field(default=10.0, gt=0)
    """Area of the cross-section, in the unit of length squared."""

    @property
    def axial_length(self) -> float:
        """Length of the tendon along z."""
        return self.length

    @property
    def section_area(self) -> float:
        """Area of the cross-section."""
        return self.area

    @property
    def proportions(self) -> Proportions:
        """Proportions of tendons, which are neither plates nor threads."""
        return (("length", "length / sqrt(area)", self.length / math.sqrt(self.area), (-2, 3)),)

    def strut(self, ends: str) -> Strut:
        """Return the strut: the bottom stays in its plane, the top is free."""
        moment = self.area / (4 * math.pi)
        return Strut(self.length, 2.0, global_axes, lambda places: np.full(len(places), moment))

    @model_validator(mode="after")
    def _can_be_meshed(self) -> Tendon:
        check_lengths(self, {"length": self.length, "area": math.sqrt(self.area)})
        return self

    def build(self, mesh: Mesh, comm: MPI.Intracomm | None = None) -> Domain:
        """Mesh a core of 4 x 4 elements, rounded, in two rings of 16, in ten layers.

        The refinement multiplies these numbers. The centre of the section and the axes have nodes.
        `dimensions["radius"]` is the radius of the outer nodes. It slightly exceeds sqrt(area /
        pi), so that the area of the mesh is `area`.
        """
        from remodel_fenicsx.body.domain import build_domain

        draw = partial(
            draw_tendon, self.length, self.area, mesh.refinement, mesh.element, mesh.degree
        )
        radius = outer_radius(self.area, mesh.refinement, mesh.degree)
        return build_domain(draw, self.name, _dimensions(self.length, self.area, radius), comm)

    def hold(self, loading: Loading) -> None:
        """Constrain u_z at the bottom, and the other rigid body modes at two of its nodes."""
        loading.hold_face("bottom", 2)
        loading.hold_node((0.0, 0.0, 0.0), 0)
        loading.hold_node((0.0, 0.0, 0.0), 1)
        loading.hold_node((loading.domain.dimensions["radius"], 0.0, 0.0), 1)


def _dimensions(length: float, area: float, radius: float) -> dict[str, float]:
    return {"length": float(length), "area": float(area), "radius": float(radius)}


def outer_radius(area: float, refinement: int = 1, degree: int = 1) -> float:
    """Return the radius of the outer nodes for which the meshed cross-section has an area."""
    number = AROUND * refinement
    half = np.pi / number
    sector = 0.5 * np.sin(2.0 * half)  # triangle between the centre and the chord, of radius 1
    # An edge of degree 2 through the arc's midpoint is a parabola, which adds two thirds of chord
    # times sagitta.
    if degree == 2:
        sector += 2.0 / 3.0 * (2.0 * np.sin(half)) * (1.0 - np.cos(half))
    return float(np.sqrt(area / (number * sector)))


def draw_tendon(length: float, area: float, refinement: int, element: str, degree: int) -> None:
    """Draw and mesh the tendon in Gmsh: a core and four ring quarters, extruded."""
    radius = outer_radius(area, refinement, degree)
    number, quarter = AROUND * refinement, CORE * refinement
    inner = model.points(core_boundary(CORE_RADIUS * radius, refinement))
    outer = model.points(model.circle(radius, number, -quarter // 2))  # corner 0 at -45 degrees
    inner_lines, outer_lines = model.polygon(inner), model.polygon(outer)
    corners = range(0, number, quarter)
    spokes = [model.line(inner[k], outer[k], RINGS * refinement) for k in corners]
    section = [model.block([inner_lines], [inner[k] for k in corners], element)]
    section += model.ring(inner, outer, inner_lines, outer_lines, spokes, element)
    model.extrude(section, length, ALONG * refinement, element, {"side": outer_lines})
    # Elements are round at the side and become straight towards the centre, where they are not
    # concentric.
    model.raise_degree(degree, lambda mean_radius: np.square(mean_radius / radius))


def core_boundary(radius: float, refinement: int) -> Array:
    """Return the nodes around the core, (16 refinement, 2), from -45 degrees on.

    The curve lies between a square and its circumscribed circle.
    """
    number, quarter = AROUND * refinement, CORE * refinement
    round_side = model.circle(radius, number, -quarter // 2)
    corner = round_side[::quarter]
    fraction = np.arange(quarter)[:, None] / quarter
    square = np.concatenate(
        [(1.0 - fraction) * corner[i] + fraction * corner[(i + 1) % 4] for i in range(4)]
    )
    return (1.0 - CORE_ROUNDNESS) * square + CORE_ROUNDNESS * round_side
