"""The meshed body, shared by all ranks, and its data in the order in which it was built."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from remodel_fenicsx.fem import compat


class GeometryError(RuntimeError):
    """Gmsh could not build or read a mesh; raised on all ranks."""


@dataclass(frozen=True, eq=False)
class Domain:
    """A meshed body with named faces.

    Cells and nodes have the numbers under which rank 0 gave them to dolfinx (0, 1, ... in the order of the input).
    They do not depend on the number of ranks: what belongs to a cell or a node for good is drawn and written by them.

    Attributes
    ----------
    mesh
        dolfinx mesh of the reference body, distributed.
    facet_tags
        dolfinx mesh tags of the boundary facets.
    faces
        Name of a face -> its value in `facet_tags`, on every rank.
    shape
        Name of the shape: "cube", "tendon", "tube".
    dimensions
        The shape's dimensions by name, in the scene's unit of length. Tendon: also `radius`, that of the outer nodes.
    cell_number
        Number of each local cell, owned ones first, then ghosts, (local cells,) int64.
    node_number
        Number of each local geometry node, owned ones first, then ghosts, (local nodes,) int64.
    number_of_cells, number_of_nodes
        Of the whole mesh.
    """

    mesh: Any
    facet_tags: Any
    faces: dict[str, int]
    shape: str
    dimensions: dict[str, float]
    cell_number: npt.NDArray[np.int64] = field(init=False)
    node_number: npt.NDArray[np.int64] = field(init=False)
    number_of_cells: int = field(init=False)
    number_of_nodes: int = field(init=False)

    def __post_init__(self) -> None:
        topology, geometry = self.mesh.topology, self.mesh.geometry
        settle = object.__setattr__  # the dataclass is frozen: these four follow from the mesh
        settle(self, "cell_number", np.asarray(topology.original_cell_index, dtype=np.int64))
        settle(self, "node_number", np.asarray(geometry.input_global_indices, dtype=np.int64))
        settle(self, "number_of_cells", int(topology.index_map(topology.dim).size_global))
        settle(self, "number_of_nodes", int(geometry.index_map().size_global))

    @property
    def comm(self) -> MPI.Intracomm:
        """Communicator of the mesh."""
        return self.mesh.comm

    @property
    def size(self) -> float:
        """Largest dimension that is a length: the scale for tolerances on coordinates."""
        return max(value for name, value in self.dimensions.items() if name != "area")

    def gather_cells(self, values: npt.ArrayLike) -> npt.NDArray[Any] | None:
        """Bring what belongs to the cells to rank 0, in input order. Collective.

        Parameters
        ----------
        values
            One row per local cell, (owned cells or more, ...): rows behind the owned ones (ghosts) are ignored.

        Returns
        -------
        array or None
            (number_of_cells, ...) on rank 0, None elsewhere.

        Raises
        ------
        ValueError
            If there are fewer rows than owned cells.
        """
        topology = self.mesh.topology
        owned = topology.index_map(topology.dim).size_local
        return self._gather(np.asarray(values), self.cell_number[:owned], self.number_of_cells)

    def gather_nodes(self, values: npt.ArrayLike) -> npt.NDArray[Any] | None:
        """Bring what belongs to the geometry nodes to rank 0, in input order. Collective.

        Parameters
        ----------
        values
            One row per local geometry node, (owned nodes or more, ...), as `mesh.geometry.x` has them.

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
        return self._gather(np.asarray(values), self.node_number[:owned], self.number_of_nodes)

    def gather_mesh(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]] | tuple[None, None]:
        """The whole mesh on rank 0, in input order, the same for every number of ranks. Collective.

        Returns
        -------
        points, cells
            (number_of_nodes, 3) and (number_of_cells, nodes per cell) on rank 0, (None, None) elsewhere. Within a cell
            the nodes have dolfinx's (tensor product) order; `cells[:, dolfinx.cpp.io.perm_vtk(type, n)]` has VTK's.
        """
        points = self.gather_nodes(self.mesh.geometry.x)
        cells = self.gather_cells(self.node_number[compat.geometry_dofmap(self.mesh)])
        return (None, None) if points is None or cells is None else (points, cells)

    def _gather(self, values: npt.NDArray[Any], number: npt.NDArray[np.int64], total: int) -> npt.NDArray[Any] | None:
        short = self.comm.allreduce(len(values) < len(number), MPI.LOR)
        if short:
            raise ValueError(f"{len(values)} rows for {len(number)} owned entities on rank {self.comm.rank}")
        parts = self.comm.gather((number, values[: len(number)]), root=0)
        if parts is None:
            return None
        whole = np.empty((total, *values.shape[1:]), dtype=values.dtype)
        for numbers, rows in parts:
            whole[numbers] = rows
        return whole
