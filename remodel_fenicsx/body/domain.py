"""The meshed body, shared by all ranks, and its data in the order in which it was built."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from remodel_fenicsx.fem import compat
from remodel_fenicsx.fem.ranks import over_ranks


@dataclass(frozen=True, eq=False)
class Domain:
    """A meshed body with named faces.

    Elements and nodes have the numbers under which rank 0 gave them to dolfinx (0, 1, ... in the order of the
    input). They do not depend on the number of ranks: what belongs to an element or a node for good is drawn and
    written by them.

    Attributes
    ----------
    mesh
        dolfinx mesh of the reference body, distributed.
    facet_tags
        dolfinx mesh tags of the boundary facets.
    faces
        Name of a face -> its value in `facet_tags`, on every rank.
    shape
        Name of the shape (`body.SHAPES`).
    dimensions
        The shape's dimensions by name, in the scene's unit of length. Tendon: also `radius`, that of the outer nodes.
    element_number
        Number of each local element, owned ones first, then ghosts, (local elements,) int64.
    node_number
        Number of each local geometry node, owned ones first, then ghosts, (local nodes,) int64.
    number_of_elements, number_of_nodes
        Of the whole mesh.
    """

    mesh: Any
    facet_tags: Any
    faces: dict[str, int]
    shape: str
    dimensions: dict[str, float]
    element_number: npt.NDArray[np.int64] = field(init=False)
    node_number: npt.NDArray[np.int64] = field(init=False)
    number_of_elements: int = field(init=False)
    number_of_nodes: int = field(init=False)
    _orders: dict[str, _Order] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        topology, geometry = self.mesh.topology, self.mesh.geometry
        settle = object.__setattr__  # the dataclass is frozen: these follow from the mesh
        settle(self, "_orders", {})
        settle(self, "element_number", np.asarray(topology.original_cell_index, dtype=np.int64))
        settle(self, "node_number", np.asarray(geometry.input_global_indices, dtype=np.int64))
        settle(self, "number_of_elements", int(topology.index_map(topology.dim).size_global))
        settle(self, "number_of_nodes", int(geometry.index_map().size_global))

    @property
    def comm(self) -> MPI.Intracomm:
        """Communicator of the mesh."""
        return self.mesh.comm

    @property
    def size(self) -> float:
        """Largest dimension that is a length: the scale for tolerances on coordinates."""
        return max(value for name, value in self.dimensions.items() if name != "area")

    def gather_elements(self, values: npt.ArrayLike) -> npt.NDArray[Any] | None:
        """Bring what belongs to the elements to rank 0, in input order. Collective.

        Parameters
        ----------
        values
            One row per local element, (owned ones or more, ...): rows behind the owned ones (ghosts) are ignored.

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
        return self._gather(np.asarray(values), "elements", self.element_number[:owned])

    def scatter_elements(self, values: npt.NDArray[Any] | None) -> npt.NDArray[Any]:
        """Give every rank the rows of its elements, ghosts included: the way back of `gather_elements`. Collective.

        Parameters
        ----------
        values
            (number_of_elements, ...) on rank 0, in input order; elsewhere it is not looked at.

        Returns
        -------
        array
            One row per local element.
        """
        wanted = self.comm.gather(self.element_number, root=0)
        parts = None if wanted is None or values is None else [values[numbers] for numbers in wanted]
        return np.asarray(self.comm.scatter(parts, root=0))

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
        return self._gather(np.asarray(values), "nodes", self.node_number[:owned])

    def gather_mesh(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]] | tuple[None, None]:
        """The whole mesh on rank 0, in input order, the same for every number of ranks. Collective.

        Returns
        -------
        points, elements
            (number_of_nodes, 3) and (number_of_elements, nodes per element) on rank 0, None elsewhere. Within one
            the nodes have dolfinx's (tensor product) order; `elements[:, dolfinx.cpp.io.perm_vtk(type, n)]` has VTK's.
        """
        points = self.gather_nodes(self.mesh.geometry.x)
        elements = self.gather_elements(self.node_number[compat.geometry_dofmap(self.mesh)])
        return (None, None) if points is None or elements is None else (points, elements)

    def _gather(self, values: npt.NDArray[Any], kind: str, number: npt.NDArray[np.int64]) -> npt.NDArray[Any] | None:
        """Rows as buffers, without pickle; their numbers are sent once only."""
        short = over_ranks(self.comm, len(values) < len(number), MPI.LOR)
        if short:
            raise ValueError(f"{len(values)} rows for {len(number)} owned entities on rank {self.comm.rank}")
        if kind not in self._orders:
            self._orders[kind] = _Order.gathered(self.comm, number)
        order, rows = self._orders[kind], np.ascontiguousarray(values[: len(number)])
        if self.comm.size == 1:
            whole = np.empty_like(rows)
            whole[order.numbers] = rows
            return whole
        row_bytes = rows.itemsize * int(np.prod(rows.shape[1:], dtype=np.int64))
        row = MPI.BYTE.Create_contiguous(row_bytes).Commit()  # counts of bytes would overflow
        by_rank = np.empty((sum(order.counts), *rows.shape[1:]), rows.dtype)
        self.comm.Gatherv([rows, len(rows), row], [by_rank, order.counts, row] if self.comm.rank == 0 else None, root=0)
        row.Free()
        if self.comm.rank != 0:
            return None
        whole = np.empty_like(by_rank)
        whole[order.numbers] = by_rank
        return whole


@dataclass(frozen=True)
class _Order:
    """On rank 0: the numbers of what all ranks own, rank after rank, and how many each has; elsewhere nothing."""

    numbers: npt.NDArray[np.int64]
    counts: list[int]

    @classmethod
    def gathered(cls, comm: MPI.Intracomm, number: npt.NDArray[np.int64]) -> _Order:
        counts = comm.gather(len(number)) or []
        numbers = np.empty(sum(counts), dtype=np.int64)
        target = [numbers, counts, MPI.INT64_T] if comm.rank == 0 else None
        comm.Gatherv([np.ascontiguousarray(number), len(number), MPI.INT64_T], target)
        return cls(numbers, counts)
