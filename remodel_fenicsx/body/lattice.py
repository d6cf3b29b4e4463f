"""Structured meshes of intervals and quadrilaterals in space, for bodies of which a part stands for all of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.body.domain import Domain

Array = NDArray[np.float64]
Marker = Callable[[Array], NDArray[np.bool_]]


def interval_domain(
    start: tuple[float, float, float],
    end: tuple[float, float, float],
    elements: int,
    degree: int,
    faces: Mapping[str, Marker],
    shape: str,
    dimensions: dict[str, float],
    comm: MPI.Intracomm | None = None,
) -> Domain:
    """Equal elements on a straight line. Collective.

    Parameters
    ----------
    start, end
        Of the line.
    elements, degree
        Number of elements, and degree of their geometry.
    faces
        Name of a face of the body -> function of coordinates (3, n) that is true on its place on the line.
    shape, dimensions
        As in `Domain`.
    comm
        Ranks that share the mesh; default: all.
    """
    share = np.linspace(0.0, 1.0, degree * elements + 1)[:, None]
    points = (1.0 - share) * np.array(start) + share * np.array(end)
    return _domain("interval", degree, points, _lines(elements, degree), faces, shape, dimensions, comm)


def half_plane_domain(
    radii: tuple[float, float],
    length: float,
    elements: tuple[int, int],
    degree: int,
    faces: Mapping[str, Marker],
    shape: str,
    dimensions: dict[str, float],
    comm: MPI.Intracomm | None = None,
) -> Domain:
    """Equal quadrilaterals on a rectangle of the half-plane y = 0, x > 0; elements along x and z. Collective."""
    across, along = (degree * number + 1 for number in elements)
    x, z = np.linspace(*radii, across), np.linspace(0.0, length, along)
    points = np.stack([np.tile(x, along), np.zeros(across * along), np.repeat(z, across)], axis=1)
    first, second = (_lines(number, degree, in_order=True) for number in elements)
    # dolfinx's order on a quadrilateral of any degree: corners, then edges and inside, from the two lines
    nodes = second[:, None, :, None] * across + first[None, :, None, :]
    quadrilaterals = nodes.reshape(elements[0] * elements[1], -1)[:, _QUADRILATERAL[degree]]
    return _domain("quadrilateral", degree, points, quadrilaterals, faces, shape, dimensions, comm)


# places (second line, first line) of a quadrilateral's nodes in the order of basix; a line's own order is ascending
_QUADRILATERAL = {1: [0, 1, 2, 3], 2: [0, 2, 6, 8, 1, 3, 5, 7, 4]}


def _lines(elements: int, degree: int, in_order: bool = False) -> NDArray[np.int64]:
    """Nodes of each element of a line, ends first unless they are wanted in order; (elements, degree + 1)."""
    nodes = degree * np.arange(elements)[:, None] + np.arange(degree + 1)
    return nodes if in_order else nodes[:, [0, degree, *range(1, degree)]]


def _domain(
    kind: str,
    degree: int,
    points: Array,
    elements: NDArray[np.int64],
    faces: Mapping[str, Marker],
    shape: str,
    dimensions: dict[str, float],
    comm: MPI.Intracomm | None,
) -> Domain:
    import basix.ufl
    import dolfinx.mesh

    from remodel_fenicsx.fem.symbolic_mesh import SymbolicMesh

    comm = comm or MPI.COMM_WORLD
    here = slice(None) if comm.rank == 0 else slice(0)
    geometry = SymbolicMesh(basix.ufl.element("Lagrange", kind, degree, shape=(3,)))
    mesh: Any = dolfinx.mesh.create_mesh(comm, cells=elements[here], x=points[here], e=geometry)
    dimension = mesh.topology.dim - 1
    found = [dolfinx.mesh.locate_entities_boundary(mesh, dimension, marker) for marker in faces.values()]
    values = np.repeat(np.arange(1, len(found) + 1, dtype=np.int32), [len(one) for one in found])
    facets = np.concatenate(found).astype(np.int32)
    order = np.argsort(facets)
    tags = dolfinx.mesh.meshtags(mesh, dimension, facets[order], values[order])
    return Domain(mesh, tags, {name: number + 1 for number, name in enumerate(faces)}, shape, dimensions)
