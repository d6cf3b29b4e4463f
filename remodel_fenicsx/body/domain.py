"""The meshed body, distributed over all ranks, and its data in the order of the input mesh.

Gmsh meshes it on rank 0 (`body.gmsh_model`). Intervals and quadrilaterals of reduced bodies are
structured meshes without Gmsh.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TYPE_CHECKING

import basix.ufl
import dolfinx.mesh
import numpy as np
import numpy.typing as npt
import ufl
from mpi4py import MPI

from remodel_fenicsx.body.gmsh_model import GeometryError, gmsh_model, named_groups
from remodel_fenicsx.fem import compat
from remodel_fenicsx.fem.assembly import allreduce
from remodel_fenicsx.model.tensors import Array, Flags, Integers

if TYPE_CHECKING:
    from dolfinx.fem import FunctionSpace
    from dolfinx.mesh import Mesh, MeshTags

Marker = Callable[[Array], Flags]


@dataclass(frozen=True, eq=False)
class Domain:
    """Meshed body with named faces and regions.

    Elements and nodes keep the numbers with which rank 0 passed them to dolfinx (0, 1, ... in the
    order of the input). The numbers do not depend on the number of ranks. Permanent data of an
    element or node are drawn and written in their order.

    Parameters
    ----------
    mesh
        dolfinx mesh of the reference configuration, distributed.
    facet_tags
        dolfinx mesh tags of the boundary facets.
    faces
        Name of a face -> its value in `facet_tags`, on every rank.
    shape
        Name of the shape (`extend.SHAPES`).
    dimensions
        The shape's dimensions by name, in the scene's unit of length. A tendon also has `radius`,
        the radius of the outer nodes.
    regions
        Name of a region -> its number in `element_region`, on every rank; a body without named
        regions has one. A shape defines regions as named volumes of its Gmsh model
        (`build_domain`), or here (`layers.Wall.marked`). Every element is in one region; a scene's
        `[regions.NAME]` names some or all of them.
    element_region
        Number of each local element's region, owned elements first, then ghosts, (local elements,)
        int32; default: the only region.

    Attributes
    ----------
    element_number
        Number of each local element, owned elements first, then ghosts, (local elements,) int64.
    node_number
        Number of each local geometry node, owned nodes first, then ghosts, (local nodes,) int64.
    number_of_elements, number_of_nodes
        Numbers of the global mesh.

    Examples
    --------
    >>> from remodel_fenicsx import parts
    >>> domain = parts.Cube(side=1.0).build(parts.Mesh(refinement=2))
    >>> domain.number_of_elements, domain.number_of_nodes, domain.dimensions
    (8, 27, {'side': 1.0})
    >>> points, elements = domain.gather_mesh()  # on rank 0
    >>> points.shape, elements.shape
    ((27, 3), (8, 8))
    """

    mesh: Mesh
    facet_tags: MeshTags
    faces: dict[str, int]
    shape: str
    dimensions: dict[str, float]
    regions: dict[str, int] = field(default_factory=lambda: {"body": 1})
    element_region: npt.NDArray[np.int32] = None  # type: ignore[assignment]  # set below
    element_number: Integers = field(init=False)
    node_number: Integers = field(init=False)
    number_of_elements: int = field(init=False)
    number_of_nodes: int = field(init=False)

    def __post_init__(self) -> None:
        topology, geometry = self.mesh.topology, self.mesh.geometry
        settle = object.__setattr__  # the dataclass is frozen; these values follow from the mesh
        settle(self, "element_number", np.asarray(topology.original_cell_index, dtype=np.int64))
        settle(self, "node_number", np.asarray(geometry.input_global_indices, dtype=np.int64))
        settle(self, "number_of_elements", int(topology.index_map(topology.dim).size_global))
        settle(self, "number_of_nodes", int(geometry.index_map().size_global))
        if self.element_region is None:
            (only,) = self.regions.values()
            settle(self, "element_region", np.full(len(self.element_number), only, dtype=np.int32))

    @property
    def comm(self) -> MPI.Intracomm:
        """Communicator of the mesh."""
        return self.mesh.comm

    @cached_property
    def size(self) -> float:
        """Largest dimension that is a length, the scale for tolerances of coordinates."""
        return max(value for name, value in self.dimensions.items() if name != "area")

    def facets(self, face: str) -> npt.NDArray[np.int32]:
        """Return the local facets of a named face, ascending, (n,)."""
        return self.facet_tags.find(self.faces[face])

    def gather_elements(self, values: npt.ArrayLike) -> npt.NDArray[Any] | None:
        """Gather values of the elements on rank 0, in input order. Collective.

        Parameters
        ----------
        values
            One row per local element, (owned elements or more, ...). The rows after those of the
            owned elements (ghosts) are ignored.

        Returns
        -------
        array or None
            (number_of_elements, ...) on rank 0, None elsewhere.

        Raises
        ------
        ValueError
            If there are fewer rows than owned elements.
        """
        topology = self.mesh.topology
        owned = topology.index_map(topology.dim).size_local
        return self._gather(np.asarray(values), self.element_number[:owned])

    def scatter_elements(self, values: npt.NDArray[Any] | None) -> npt.NDArray[Any]:
        """Scatter rows to the ranks of their elements, including ghosts. Collective.

        This is the inverse of `gather_elements`.

        Parameters
        ----------
        values
            (number_of_elements, ...) on rank 0, in input order; ignored on other ranks.

        Returns
        -------
        array
            One row per local element.
        """
        wanted = self.comm.gather(self.element_number, root=0)
        parts = (
            None if wanted is None or values is None else [values[numbers] for numbers in wanted]
        )
        return self.comm.scatter(parts, root=0)

    def gather_nodes(self, values: npt.ArrayLike) -> npt.NDArray[Any] | None:
        """Gather values of the geometry nodes on rank 0, in input order. Collective.

        Parameters
        ----------
        values
            One row per local geometry node, (owned nodes or more, ...), in the order of
            `mesh.geometry.x`.

        Returns
        -------
        array or None
            (number_of_nodes, ...) on rank 0, None elsewhere.

        Raises
        ------
        ValueError
            If there are fewer rows than owned nodes.
        """
        owned = self.mesh.geometry.index_map().size_local
        return self._gather(np.asarray(values), self.node_number[:owned])

    def gather_mesh(self) -> tuple[Array, Integers] | tuple[None, None]:
        """Gather the mesh on rank 0, in input order, independent of the rank count. Collective.

        Returns
        -------
        points, elements
            (number_of_nodes, 3) and (number_of_elements, nodes per element) on rank 0, None
            elsewhere. The nodes of an element have dolfinx's (tensor product) order;
            `elements[:, dolfinx.cpp.io.perm_vtk(type, n)]` has VTK's.
        """
        points = self.gather_nodes(self.mesh.geometry.x)
        elements = self.gather_elements(self.node_number[compat.geometry_dofmap(self.mesh)])
        return (None, None) if points is None or elements is None else (points, elements)

    def _gather(self, values: npt.NDArray[Any], number: Integers) -> npt.NDArray[Any] | None:
        if allreduce(self.comm, len(values) < len(number), MPI.LOR):
            raise ValueError(
                f"{len(values)} rows for {len(number)} owned entities on rank {self.comm.rank}"
            )
        own = number, values[: len(number)]
        parts = [own] if self.comm.size == 1 else self.comm.gather(own, root=0)
        if parts is None:
            return None
        whole = np.empty((sum(len(one) for one, _ in parts), *values.shape[1:]), values.dtype)
        for numbers, rows in parts:
            whole[numbers] = rows
        return whole


class SymbolicMesh(ufl.Mesh):
    """UFL mesh that constructs its cell only once."""

    def __init__(self, coordinate_element: Any) -> None:
        super().__init__(coordinate_element)
        self._cell = super().ufl_cell()

    def ufl_cell(self) -> Any:
        """Return the same cell object at each call."""
        return self._cell


def symbolic_mesh(kind: str, degree: int) -> SymbolicMesh:
    """Return a mesh of the element of dolfinx's Gmsh reader, so that all bodies share kernels."""
    return SymbolicMesh(
        basix.ufl.element("Lagrange", kind, degree, basix.LagrangeVariant.equispaced, shape=(3,))
    )


# ---------------------------------------------------------------- meshes by Gmsh


def build_domain(
    draw: Callable[[], None],
    shape: str,
    dimensions: dict[str, float],
    comm: MPI.Intracomm | None = None,
) -> Domain:
    """Draw and mesh a body on rank 0, then distribute the mesh. Collective."""
    comm = comm or MPI.COMM_WORLD
    # With several threads Scotch's partition of the same mesh differs from run to run.
    os.environ.setdefault("SCOTCH_PTHREAD_NUMBER", "1")
    with ExitStack() as stack:
        model = groups = failure = None
        if comm.rank == 0:
            try:
                model = stack.enter_context(gmsh_model(shape)).model
                draw()
                groups = named_groups()
            except BaseException as error:  # any error must reach the other ranks, which wait
                failure = error
        verdict = (
            failure and f"Gmsh could not mesh the {shape}: {str(failure) or type(failure).__name__}"
        )
        verdict, groups = comm.bcast((verdict, groups), root=0)
        if failure is not None and not isinstance(failure, Exception):  # Ctrl-C on rank 0 stays one
            raise failure
        if groups is None:
            raise GeometryError(verdict) from failure
        mesh, cell_tags, facet_tags = compat.mesh_from_gmsh(model, comm)
    symbolic = SymbolicMesh(mesh.ufl_domain().ufl_coordinate_element())
    region = np.zeros(len(mesh.topology.original_cell_index), dtype=np.int32)
    region[cell_tags.indices] = cell_tags.values
    drawn = (
        type(mesh)(mesh._cpp_object, symbolic),
        facet_tags,
        groups[0],
        shape,
        dimensions,
        groups[1],
    )
    domain = Domain(*drawn, region)
    return replace(
        domain, element_region=domain.scatter_elements(domain.gather_elements(region))
    )  # with ghosts


# ---------------------------------------------------------------- facets


def cells_of(mesh: Mesh, facets: npt.NDArray[np.int32]) -> tuple[Integers, Integers]:
    """Return the element of each boundary facet, and the facet's number in the element."""
    topology, dimension = mesh.topology, mesh.topology.dim
    for pair in ((dimension - 1, dimension), (dimension, dimension - 1), (dimension - 1, 0)):
        topology.create_connectivity(*pair)
    to_cells = topology.connectivity(dimension - 1, dimension)
    cells = to_cells.array[to_cells.offsets[facets]].astype(np.int64)
    of_cells = topology.connectivity(dimension, dimension - 1)
    number = of_cells.offsets[1] if len(cells) else 1  # number of an element's facets
    return cells, np.argmax(of_cells.array.reshape(-1, number)[cells] == facets[:, None], axis=1)


def dof_of_node(mesh: Mesh, space: FunctionSpace) -> Integers:
    """Return the (blocked) degree of freedom at each local geometry node, (nodes,)."""
    # The space and the geometry have the same degree: node k of an element is its dof k.
    dofs = np.zeros(len(mesh.geometry.x), dtype=np.int64)
    dofs[compat.geometry_dofmap(mesh).reshape(-1)] = space.dofmap.list.reshape(-1)
    return dofs


# ---------------------------------------------------------------- structured, without Gmsh

# Lattice indices (second direction, first direction) of a quadrilateral's nodes in basix's order:
# corners, edges, interior.
_QUADRILATERAL = {1: [0, 1, 2, 3], 2: [0, 2, 6, 8, 1, 3, 5, 7, 4]}


def lattice_domain(
    points: Array, counts: Sequence[int], degree: int, faces: Mapping[str, Marker], shape: str,
    dimensions: dict[str, float], comm: MPI.Intracomm | None,
) -> Domain:  # fmt: skip
    """Mesh nodes in rows by lines or quadrilaterals. Collective."""
    comm = comm or MPI.COMM_WORLD
    first, *second = (
        degree * np.arange(count)[:, None] + np.arange(degree + 1) for count in counts
    )
    kind, elements = "interval", first[:, [0, degree, *range(1, degree)]]
    if second:
        nodes = second[0][:, None, :, None] * (degree * counts[0] + 1) + first[None, :, None, :]
        kind, elements = (
            "quadrilateral",
            nodes.reshape(counts[0] * counts[1], -1)[:, _QUADRILATERAL[degree]],
        )
    here = slice(None) if comm.rank == 0 else slice(0)
    mesh: Any = dolfinx.mesh.create_mesh(
        comm, cells=elements[here], x=points[here], e=symbolic_mesh(kind, degree)
    )
    dimension = mesh.topology.dim - 1
    facets_of_faces = [
        dolfinx.mesh.locate_entities_boundary(mesh, dimension, marker) for marker in faces.values()
    ]
    values = np.repeat(
        np.arange(1, len(facets_of_faces) + 1, dtype=np.int32),
        [len(one) for one in facets_of_faces],
    )
    facets = np.concatenate(facets_of_faces).astype(np.int32)
    order = np.argsort(facets)
    tags = dolfinx.mesh.meshtags(mesh, dimension, facets[order], values[order])
    return Domain(
        mesh, tags, {name: number + 1 for number, name in enumerate(faces)}, shape, dimensions
    )
