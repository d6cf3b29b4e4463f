"""Bodies of the paper, built by Gmsh: unit cube, tendon, tube."""

from __future__ import annotations

from typing import Any, Protocol

from mpi4py import MPI

from remodel_fenicsx.body.cube import cube
from remodel_fenicsx.body.domain import Domain, GeometryError
from remodel_fenicsx.body.tendon import tendon
from remodel_fenicsx.body.tube import tube

__all__ = ["SHAPES", "Domain", "GeometryError", "build", "cube", "tendon", "tube"]

# name of a shape -> its builder and the keys of its dimensions, which are the builder's arguments
SHAPES: dict[str, tuple[Any, tuple[str, ...]]] = {
    "cube": (cube, ("side",)),
    "tendon": (tendon, ("length", "area")),
    "tube": (tube, ("inner_radius", "outer_radius", "length")),
}


class _Shape(Protocol):
    @property
    def shape(self) -> str:
        """Name of the shape."""


class _Mesh(Protocol):
    @property
    def refinement(self) -> int:
        """Factor on the paper's element counts."""

    @property
    def cell(self) -> str:
        """Cell type."""

    @property
    def degree(self) -> int:
        """Degree of the geometry."""


def build(geometry: _Shape, mesh: _Mesh, comm: MPI.Intracomm = MPI.COMM_WORLD) -> Domain:
    """Mesh the body that a scene describes. Collective.

    Parameters
    ----------
    geometry
        Has `shape` and that shape's dimensions: `side`; `length`, `area`; or `inner_radius`, `outer_radius`, `length`.
    mesh
        Has `refinement` (>= 1), `cell` ("hexahedron" or "tetrahedron"), `degree` (1 or 2).
    comm
        Ranks that share the mesh.

    Raises
    ------
    ValueError
        If the shape is not known, or a value is not allowed.
    GeometryError
        On all ranks, if Gmsh fails on rank 0.
    """
    if geometry.shape not in SHAPES:
        raise ValueError(f"shape = {geometry.shape!r}: allowed are {', '.join(SHAPES)}")
    builder, keys = SHAPES[geometry.shape]
    dimensions = {key: getattr(geometry, key) for key in keys}
    return builder(**dimensions, refinement=mesh.refinement, cell=mesh.cell, degree=mesh.degree, comm=comm)
