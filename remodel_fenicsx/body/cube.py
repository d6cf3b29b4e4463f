"""Unit cube, the paper's first specimen (Fig. 5)."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from remodel_fenicsx.body import gmsh_model as model
from remodel_fenicsx.body.domain import Domain


def cube(
    side: float = 1.0,
    refinement: int = 1,
    cell: str = "hexahedron",
    degree: int = 1,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
) -> Domain:
    """Cube [0, side]^3 with the faces x0, x1, y0, y1, z0, z1. Collective.

    Parameters
    ----------
    side
        Length of the edges.
    refinement
        Elements along each edge; 1 is the paper's single element.
    cell
        "hexahedron", or "tetrahedron": each hexahedron split into six.
    degree
        Of the geometry, 1 or 2.
    comm
        Ranks that share the mesh.

    Raises
    ------
    ValueError
        If a value is not allowed.
    GeometryError
        On all ranks, if Gmsh fails on rank 0.
    """
    model.check_arguments({"side": side}, refinement, cell, degree)
    model.check_lengths({"side": side})
    return model.build_domain(lambda: draw_cube(side, refinement, cell, degree), "cube", {"side": float(side)}, comm)


def draw_cube(side: float, refinement: int = 1, cell: str = "hexahedron", degree: int = 1) -> None:
    """Draw and mesh the cube in the current Gmsh model."""
    n = refinement
    corners = model.points(side * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]))
    y0, x1, y1, x0 = (model.line(corners[i], corners[(i + 1) % 4], n) for i in range(4))
    section = model.block([y0, x1, y1, x0], corners, cell)
    sides = {"x0": x0, "x1": x1, "y0": y0, "y1": y1}
    model.extrude([section], side, n, cell, sides, ends=("z0", "z1"))
    model.raise_degree(degree, np.zeros_like)
