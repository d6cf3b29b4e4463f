"""The mesh of an own body on all ranks: read and checked on the first, with what its faces are."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import dolfinx.fem
import dolfinx.mesh
import numpy as np
import ufl
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.body.axes import facets_of, harmonic, slopes
from remodel_fenicsx.body.domain import Domain, cells_of, corners_of, symbolic_mesh
from remodel_fenicsx.body.mesh_faces import Boundary, Face, node_order, rims_of
from remodel_fenicsx.body.mesh_file import Array, Integers, MeshFile
from remodel_fenicsx.fem import jit
from remodel_fenicsx.fem.assembly import agreed, over_ranks


# ---------------------------------------------------------------- a mesh as the text of a Gmsh file, format 2.2
# What `mesh_file` reads.

# Gmsh's numbers of the types of elements and of facets, which are written by their corners
TYPE_OF = {("tetrahedron", 1): 4, ("hexahedron", 1): 5, ("tetrahedron", 2): 11, ("hexahedron", 2): 12}
FACET_OF = {3: 2, 4: 3}


def gmsh_text(file: MeshFile) -> str:
    """Nodes, elements and named groups of a mesh; nodes have the numbers 1, 2, ... in their order."""
    lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat", "$PhysicalNames"]
    names = [(dimension, number, name) for dimension, by in file.names.items() for name, number in by.items()]
    lines += [str(len(names)), *(f'{dimension} {number} "{name}"' for dimension, number, name in names)]
    lines += ["$EndPhysicalNames", "$Nodes", str(len(file.points))]
    places: Any = file.points.tolist()
    lines += [f"{row} {x:.17g} {y:.17g} {z:.17g}" for row, (x, y, z) in enumerate(places, start=1)]
    facets, solid = FACET_OF[file.facets.shape[1]], TYPE_OF[file.kind, file.degree]
    lines += ["$EndNodes", "$Elements", str(len(file.facets) + len(file.cells))]
    number = 0
    for kind, groups, rows in ((facets, file.facet_groups, file.facets), (solid, file.cell_groups, file.cells)):
        listed: Any = (rows + 1).tolist()
        for group, row in zip(groups, listed, strict=True):
            number += 1
            lines.append(f"{number} {kind} 2 {group} {group} {' '.join(str(node) for node in row)}")
    return "\n".join([*lines, "$EndElements", ""])


@dataclass(frozen=True, eq=False)
class MeshDomain(Domain):
    """A domain that knows more of its faces."""

    parts: tuple[Face, ...] = ()
    part_of_element: Mapping[str, Integers] = field(default_factory=dict)
    rims: tuple[Integers, ...] = ()
    volume: float = 0.0

    def of_parts(self, face: str, name: str) -> Array:
        """`normal` or `centre` of each part of a face at the local elements beside it, 0 at others; (elements, 3)."""
        table = np.array([*(getattr(part, name) for part in self.parts), np.zeros(3)])
        return np.asarray(table[self.part_of_element[face]])

    def facets_of_parts(self, face: str) -> Iterator[tuple[Face, NDArray[np.int32]]]:
        """The parts of a face with their local facets."""
        facets = facets_of(self, [face])
        cells, _ = cells_of(self.mesh, facets)
        for number, part in enumerate(self.parts):
            if part.name == face:
                yield part, facets[self.part_of_element[face][cells] == number]

    def area(self, face: str) -> float:
        """Of a named face, with plane facets."""
        return sum(part.area for part in self.parts if part.name == face)

    def middle(self, face: str) -> Array:
        """Mean of the places of a named face, (3,)."""
        return np.asarray(np.concatenate([part.places for part in self.parts if part.name == face]).mean(axis=0))

    @property
    def thickness(self) -> float:
        """Mean thickness of the wall: twice the volume over the areas of its faces; without them of a cube."""
        area = self.area("inner") + self.area("outer")
        return 2 * self.volume / area if area else float(np.cbrt(self.volume))

    def length(self) -> float:
        """Of the body from inlet to outlet: volume over the integral of |grad psi|, psi harmonic from 0 to 1."""
        # In a bend psi goes with the angle: the mean of |grad psi| is that at the distance at which the mean of 1/R is,
        # the line of the sections' centres. Collective; 0 for a body without one of the two.
        if not {"inlet", "outlet"} <= set(self.faces):
            return 0.0
        mesh, degree = self.mesh, int(self.mesh.geometry.cmap.degree)
        dx = ufl.Measure("dx", domain=mesh, metadata={"quadrature_degree": 2 * degree})
        psi = harmonic(slopes(mesh, degree, dx), *(facets_of(self, [face]) for face in ("inlet", "outlet")))
        slope, one = ufl.sqrt(ufl.inner(ufl.grad(psi), ufl.grad(psi))), dolfinx.fem.Constant(mesh, np.float64(1.0))
        parts = [float(np.real(dolfinx.fem.assemble_scalar(jit.form(value * dx)))) for value in (one, slope)]
        volume, total = over_ranks(self.comm, np.array(parts), MPI.SUM)
        return float(volume / total)


def shared(
    read: Callable[[], tuple[MeshFile, Boundary, dict[str, int]]], comm: MPI.Intracomm, shape: str = "mesh"
) -> MeshDomain:
    """What rank 0 reads, on all ranks. Collective."""
    found = agreed(comm, lambda: read() if comm.rank == 0 else None)
    os.environ.setdefault("SCOTCH_PTHREAD_NUMBER", "1")  # as in `domain`
    told = None
    if found is not None:
        file, boundary, regions = found
        extent = float(np.ptp(file.points, axis=0).max())
        told = (
            *(file.kind, file.degree, file.cells.shape[1], extent, regions),
            *(boundary.facets, tuple(boundary.faces), boundary.volume, tuple(rims_of(file, boundary, "inner"))),
        )
    kind, degree, nodes, extent, regions, facets, parts, volume, lines = comm.bcast(told)
    symbolic = symbolic_mesh(kind, degree)
    cells = np.empty((0, nodes), dtype=np.int64) if found is None else file.cells[:, node_order(file)]
    points = np.empty((0, 3)) if found is None else file.points
    mesh: Any = dolfinx.mesh.create_mesh(comm, cells=cells, x=points, e=symbolic)
    faces = {name: number for number, name in enumerate(dict.fromkeys(part.name for part in parts), start=1)}
    values = np.repeat([faces[part.name] for part in parts], [len(part.facets) for part in parts])
    tags = _tags_of_facets(mesh, np.sort(facets[np.concatenate([part.facets for part in parts])], axis=1), values)
    domain = MeshDomain(
        mesh, tags, faces, shape, {"extent": extent}, regions, np.empty(0, np.int32), parts, {}, lines, volume
    )
    beside: dict[str, Any] = {name: None if found is None else np.full(len(cells), -1, np.int64) for name in faces}
    for number, part in enumerate(parts if found is not None else ()):
        beside[part.name][boundary.cell[part.facets]] = number
    touched = {name: domain.scatter_elements(numbers) for name, numbers in beside.items()}
    own = domain.scatter_elements(None if found is None else file.cell_groups.astype(np.int32))
    return replace(domain, element_region=own, part_of_element=touched)


def _tags_of_facets(mesh: Any, corners: Integers, values: Integers) -> Any:
    """Tags of the facets of the boundary with these corners, as rank 0 numbered them, each row ascending."""
    dimension = mesh.topology.dim - 1
    mesh.topology.create_connectivity(dimension, dimension + 1)
    facets = np.sort(dolfinx.mesh.exterior_facet_indices(mesh.topology)).astype(np.int32)
    listed: Any = corners.tolist()
    wanted = dict(zip(map(tuple, listed), values.astype(int), strict=True))
    nodes = np.asarray(mesh.geometry.input_global_indices, dtype=np.int64)[corners_of(mesh, facets)]
    rows: Any = np.sort(nodes, axis=1).tolist()
    found = np.array([wanted.get(tuple(row), 0) for row in rows], dtype=np.int32)
    return dolfinx.mesh.meshtags(mesh, dimension, facets[found > 0], found[found > 0])
