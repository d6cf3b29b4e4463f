"""The mesh of an own body on all ranks: read and checked on the first, with what its faces are."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI

from remodel_fenicsx.body.domain import Domain, MeshArrays, share_mesh
from remodel_fenicsx.body.mesh_faces import Boundary, Face, node_order, rims
from remodel_fenicsx.body.mesh_file import Array, Integers, MeshFile
from remodel_fenicsx.fem.harmonic import harmonic, integral_of_slope
from remodel_fenicsx.schema.tables import SceneError

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class MeshDomain(Domain):
    """A domain that knows more of its faces.

    Attributes
    ----------
    parts
        The connected parts of all named faces, on every rank; their `facets` are rows of the first rank's list.
    part_of_element
        By name of a face: the number in `parts` of the part that a local element touches, or -1; (local elements,).
    rims
        On rank 0: the closed lines in which the inner face ends, as node numbers (`mesh_faces.rims`).
    volume
        Of the body, with plane faces.
    """

    parts: tuple[Face, ...] = ()
    part_of_element: dict[str, Integers] | None = None
    rims: tuple[Integers, ...] = ()
    volume: float = 0.0

    def of_part(self, face: str, values: Callable[[Face], Array]) -> Array:
        """A vector of each part of a face at the local elements that touch it, zero at the others, (elements, 3)."""
        table = np.array([values(part) for part in self.parts] + [np.zeros(3)])
        assert self.part_of_element is not None
        return np.asarray(table[self.part_of_element[face]])

    def area(self, face: str) -> float:
        """Of a named face, with plane facets."""
        return sum(part.area for part in self.parts if part.name == face)

    def length(self) -> float:
        """Of the body from inlet to outlet: volume over the integral of |grad psi|, psi harmonic from 0 to 1.

        In a bend psi goes with the angle: the mean of |grad psi| is that at the distance at which the mean of 1/R is,
        the line of the sections' centres. Collective; 0 for a body without one of the two.
        """
        held = [(self.facets(face), value) for face, value in (("inlet", 0.0), ("outlet", 1.0))]
        if not all(self.comm.allreduce(len(facets)) for facets, _ in held):
            return 0.0
        field = harmonic(self.mesh, int(self.mesh.geometry.cmap.degree), held)
        return self.volume / integral_of_slope(field)

    def facets(self, face: str) -> Any:
        """Local facets of a named face; none where the body has no such face."""
        return self.facet_tags.find(self.faces[face]) if face in self.faces else np.empty(0, dtype=np.int32)


def shared(
    read: Callable[[], tuple[MeshFile, Boundary, dict[str, int]]], dimensions: dict[str, float], comm: MPI.Intracomm
) -> MeshDomain:
    """What rank 0 reads, on all ranks. Collective.

    Parameters
    ----------
    read
        Called on rank 0: the file with its points in the scene's unit, its boundary, and numbers of regions by name.
    dimensions
        As in `Domain`.
    comm
        Ranks that share it.

    Raises
    ------
    SceneError
        On all ranks, if `read` raises it.
    """
    verdict, found = "", None
    if comm.rank == 0:
        try:
            found = read()
        except SceneError as error:
            verdict = str(error)
        except BaseException:
            comm.bcast("rank 0 could not read the mesh")
            raise
    verdict = comm.bcast(verdict)
    if verdict:
        raise SceneError(verdict)
    arrays = None if found is None else _arrays(*found)
    domain = share_mesh(arrays, "mesh", dimensions, comm)
    boundary = None if found is None else found[1]
    parts, volume = comm.bcast(boundary and (tuple(boundary.faces), boundary.volume))
    touched = {}
    for name in domain.faces:
        values = None
        if boundary is not None:
            values = np.full(domain.number_of_elements, -1, dtype=np.int64)
            for number, part in enumerate(boundary.faces):
                if part.name == name:
                    values[boundary.cell[part.facets]] = number
        touched[name] = domain.scatter_elements(values)
    lines = () if found is None else tuple(rims(found[0], found[1], "inner"))
    fields = domain.mesh, domain.facet_tags, domain.faces, domain.shape, domain.dimensions, domain.regions
    return MeshDomain(*fields, domain.element_region, parts, touched, lines, volume)


def _arrays(file: MeshFile, boundary: Boundary, regions: dict[str, int]) -> MeshArrays:
    names = list(dict.fromkeys(part.name for part in boundary.faces))
    faces = {name: number for number, name in enumerate(names, start=1)}
    rows = [part.facets for part in boundary.faces]
    values = [np.full(len(part.facets), faces[part.name]) for part in boundary.faces]
    cells = file.cells[:, node_order(file)]
    tagged = boundary.facets[np.concatenate(rows)], np.concatenate(values)
    return MeshArrays(file.kind, file.degree, file.points, cells, *tagged, file.cell_groups, faces, regions)
