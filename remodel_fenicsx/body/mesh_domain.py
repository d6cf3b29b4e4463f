"""The mesh of an own body on all ranks: read and checked on the first, with what its faces are."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import dolfinx.fem
import numpy as np
import ufl
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.body.axes import facets_of
from remodel_fenicsx.body.domain import Domain, MeshArrays, cells_of, share_mesh
from remodel_fenicsx.body.mesh_faces import Boundary, Face, node_order, rims
from remodel_fenicsx.body.mesh_file import Array, Integers, MeshFile
from remodel_fenicsx.fem import jit
from remodel_fenicsx.fem.assembly import agreed, over_ranks, solve_positive
from remodel_fenicsx.fem.kinematics import lagrange


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
        """Mean thickness of the wall: twice the volume over the areas of its two faces."""
        return 2 * self.volume / (self.area("inner") + self.area("outer"))

    def length(self) -> float:
        """Of the body from inlet to outlet: volume over the integral of |grad psi|, psi harmonic from 0 to 1."""
        # In a bend psi goes with the angle: the mean of |grad psi| is that at the distance at which the mean of 1/R is,
        # the line of the sections' centres. Collective; 0 for a body without one of the two.
        if not {"inlet", "outlet"} <= set(self.faces):
            return 0.0
        mesh, degree = self.mesh, int(self.mesh.geometry.cmap.degree)
        psi = lagrange(mesh, degree, ())
        space, dx = psi.function_space, ufl.Measure("dx", domain=mesh, metadata={"quadrature_degree": 2 * degree})
        conditions = []
        for value, face in enumerate(("inlet", "outlet")):
            dofs = dolfinx.fem.locate_dofs_topological(space, 2, facets_of(self, [face]))
            held = dolfinx.fem.Constant(mesh, np.float64(value))
            conditions.append(dolfinx.fem.dirichletbc(held, dofs, space))
        trial, test = ufl.TrialFunction(space), ufl.TestFunction(space)
        solve_positive(ufl.inner(ufl.grad(trial), ufl.grad(test)) * dx, None, psi, conditions)
        slope, one = ufl.sqrt(ufl.inner(ufl.grad(psi), ufl.grad(psi))), dolfinx.fem.Constant(mesh, np.float64(1.0))
        parts = [float(np.real(dolfinx.fem.assemble_scalar(jit.form(value * dx)))) for value in (one, slope)]
        volume, total = over_ranks(self.comm, np.array(parts), MPI.SUM)
        return float(volume / total)


def shared(read: Callable[[], tuple[MeshFile, Boundary, dict[str, int]]], comm: MPI.Intracomm) -> MeshDomain:
    """What rank 0 reads, on all ranks. Collective."""
    found = agreed(comm, lambda: read() if comm.rank == 0 else None)
    arrays = None if found is None else _arrays(*found)
    extent = comm.bcast(arrays and float(np.ptp(arrays.points, axis=0).max()))
    domain = share_mesh(arrays, "mesh", {"extent": extent}, comm)
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
