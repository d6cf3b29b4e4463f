"""What of a tube stands for all of it: a ray, a half-plane, a quarter; their meshes, and when they are exact."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from remodel_fenicsx.body import gmsh_model as model
from remodel_fenicsx.body.reductions import (
    Reduction,
    about_z,
    free_ends,
    known_loads,
    mirrored,
    round_about_z,
    same_cells,
    symmetric_law,
    symmetric_planes,
)

if TYPE_CHECKING:
    from remodel_fenicsx.body.domain import Domain

PAPER = (16, 8, 12)  # the paper's elements around, through the wall, and along


def build_ray(scene: Any, comm: Any = None) -> Domain:
    """The wall on the x axis, as many elements as the body has through it."""
    from remodel_fenicsx.body.lattice import interval_domain

    shape, faces = scene.geometry, _faces(scene.geometry, "inner", "outer")
    ends = (shape.inner_radius, 0.0, 0.0), (shape.outer_radius, 0.0, 0.0)
    elements = PAPER[1] * scene.mesh.refinement
    return interval_domain(*ends, elements, scene.mesh.degree, faces, shape.name, _dimensions(shape), comm)


def build_half_plane(scene: Any, comm: Any = None) -> Domain:
    """The wall in the half-plane y = 0, x > 0, with the body's elements through the wall and along."""
    from remodel_fenicsx.body.lattice import half_plane_domain

    shape, faces = scene.geometry, _faces(scene.geometry, "bottom", "top", "inner", "outer")
    elements = PAPER[1] * scene.mesh.refinement, PAPER[2] * scene.mesh.refinement
    radii = shape.inner_radius, shape.outer_radius
    return half_plane_domain(
        radii, shape.length, elements, scene.mesh.degree, faces, shape.name, _dimensions(shape), comm
    )


def build_quarter(scene: Any, comm: Any = None) -> Domain:
    """The body's elements with x > 0 and y > 0; one layer along z where all sections are alike."""
    from remodel_fenicsx.body.meshing import build_domain

    shape, mesh = scene.geometry, scene.mesh
    counts = PAPER[0] * mesh.refinement, PAPER[1] * mesh.refinement, layers(scene)

    def draw() -> None:
        draw_quarter(shape.inner_radius, shape.outer_radius, shape.length, counts, mesh.element, mesh.degree)

    return build_domain(draw, shape.name, _dimensions(shape), comm)


def layers(scene: Any) -> int:
    """Elements of a quarter along z: u_z is linear in z where the ends are free, and nothing else depends on it."""
    return 1 if free_ends(scene) is None else PAPER[2] * scene.mesh.refinement


def draw_quarter(
    inner_radius: float, outer_radius: float, length: float, counts: tuple[int, int, int], element: str, degree: int
) -> None:
    """Draw and mesh a quarter in the current Gmsh model; counts are those of the whole tube around."""
    number, through, along = counts
    quarter = number // 4
    inner = model.points(model.circle(inner_radius, number)[: quarter + 1])
    outer = model.points(model.circle(outer_radius, number)[: quarter + 1])
    inner_line, outer_line = (
        [curve for pair in zip(arc[:-1], arc[1:], strict=True) for curve in model.line(*pair)] for arc in (inner, outer)
    )
    first, last = (model.line(inner[k], outer[k], through) for k in (0, quarter))
    edges = [first, outer_line, model.reverse(last), model.reverse(inner_line)]
    section = model.block(edges, [inner[0], outer[0], outer[quarter], inner[quarter]], element)
    sides = {"inner": inner_line, "outer": outer_line, "plane_y": first, "plane_x": last}
    model.extrude([section], length, along, element, sides)
    model.raise_degree(degree, np.ones_like)


def _faces(shape: Any, *names: str) -> dict[str, Any]:
    """Where the faces of a tube are in a half-plane."""
    places = {
        "bottom": lambda x: np.isclose(x[2], 0.0, atol=1e-9 * shape.length),
        "top": lambda x: np.isclose(x[2], shape.length),
        "inner": lambda x: np.isclose(x[0], shape.inner_radius),
        "outer": lambda x: np.isclose(x[0], shape.outer_radius),
    }
    return {name: places[name] for name in names}


def _dimensions(shape: Any) -> dict[str, float]:
    return {name: float(getattr(shape, name)) for name in ("inner_radius", "outer_radius", "length")}


_EVERYWHERE = (same_cells, symmetric_law)
REDUCTIONS = {
    "radial": Reduction(
        build_ray,
        lambda scene: PAPER[1] * scene.mesh.refinement,
        (*_EVERYWHERE, round_about_z, free_ends, known_loads("radial")),
        about_z,
    ),
    "axisymmetric": Reduction(
        build_half_plane,
        lambda scene: PAPER[1] * PAPER[2] * scene.mesh.refinement**2,
        (*_EVERYWHERE, round_about_z, known_loads("axisymmetric")),
        about_z,
    ),
    "sector": Reduction(
        build_quarter,
        lambda scene: PAPER[0] * PAPER[1] * scene.mesh.refinement**2 * layers(scene) // 4,
        (*_EVERYWHERE, symmetric_planes, known_loads("sector")),
        mirrored,
    ),
}
"""The cheapest first."""
