"""Thick-walled tube, the paper's artery (Figs. 7 to 11)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from mpi4py import MPI

from remodel_fenicsx.body import gmsh_model as model
from remodel_fenicsx.body.domain import Domain

PAPER = (16, 8, 12)  # the paper's elements around, through the wall, and along


def tube(
    inner_radius: float = 1.0,
    outer_radius: float = 3.0,
    length: float = 8.0,
    refinement: int = 1,
    cell: str = "hexahedron",
    degree: int = 1,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    divisions: tuple[int, int, int] | None = None,
) -> Domain:
    """Tube around the z axis, 0 <= z <= length, with the faces bottom, top, inner, outer. Collective.

    The nodes lie exactly on the radii, equally spaced through the wall; some are on the positive and negative x and y
    axes. Elements of degree 1 have plane faces: their inner and outer faces are regular prisms inside the cylinders.

    Parameters
    ----------
    inner_radius, outer_radius, length
        Of the reference body, in the scene's unit of length.
    refinement
        Multiplies the paper's 16 elements around, 8 through the wall, 12 along.
    cell
        "hexahedron", or "tetrahedron": each hexahedron split into six.
    degree
        Of the geometry, 1 or 2 (curved).
    comm
        Ranks that share the mesh.
    divisions
        Elements around (a multiple of 4), through the wall and along, in place of the paper's 16, 8, 12; `refinement`
        multiplies them too.

    Raises
    ------
    ValueError
        If a value is not allowed.
    GeometryError
        On all ranks, if Gmsh fails on rank 0.
    """
    dimensions = {"inner_radius": inner_radius, "outer_radius": outer_radius, "length": length}
    model.check_arguments(dimensions, refinement, cell, degree)
    if not inner_radius < outer_radius:
        raise ValueError(f"inner_radius = {inner_radius}: must be smaller than outer_radius = {outer_radius}")
    model.check_lengths({"inner_radius": inner_radius, "outer_radius": outer_radius - inner_radius, "length": length})
    counts = PAPER if divisions is None else _checked(divisions)
    return model.build_domain(
        lambda: draw_tube(inner_radius, outer_radius, length, refinement, cell, degree, counts),
        "tube",
        {name: float(value) for name, value in dimensions.items()},
        comm,
    )


def draw_tube(
    inner_radius: float,
    outer_radius: float,
    length: float,
    refinement: int = 1,
    cell: str = "hexahedron",
    degree: int = 1,
    divisions: tuple[int, int, int] = PAPER,
) -> None:
    """Draw and mesh the tube in the current Gmsh model: four quarters, swept along z."""
    number, through, along = (refinement * count for count in divisions)
    quarter = number // 4
    inner = model.points(model.circle(inner_radius, number))
    outer = model.points(model.circle(outer_radius, number))
    inner_lines, outer_lines = model.polygon(inner), model.polygon(outer)
    corners = range(0, number, quarter)
    spokes = [model.line(inner[k], outer[k], through) for k in corners]
    section = []
    for i, k in enumerate(corners):
        j, m = (i + 1) % 4, (k + quarter) % number
        edges = [
            spokes[i],
            outer_lines[k : k + quarter],
            model.reverse(spokes[j]),
            model.reverse(inner_lines[k : k + quarter]),
        ]
        section.append(model.block(edges, [inner[k], outer[k], outer[m], inner[m]], cell))
    model.extrude(section, length, along, cell, {"inner": inner_lines, "outer": outer_lines})
    model.raise_degree(degree, np.ones_like)


def _checked(divisions: Sequence[int]) -> tuple[int, int, int]:
    """The three counts, or the ValueError that says what they must be."""
    whole = all(isinstance(count, (int, np.integer)) and count >= 1 for count in divisions)
    if len(divisions) != 3 or not whole or divisions[0] % 4:
        raise ValueError(
            f"divisions = {tuple(divisions)}: must be three whole numbers of at least 1 (elements around, through the "
            "wall, along), the first a multiple of 4"
        )
    around, through, along = divisions
    return around, through, along
