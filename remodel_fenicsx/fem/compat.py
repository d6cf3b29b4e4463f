"""Compatibility with dolfinx 0.9, 0.10 and 0.11: all differences, and nothing else."""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

from mpi4py import MPI

if TYPE_CHECKING:
    import numpy as np
    from dolfinx.fem import FunctionSpace
    from dolfinx.mesh import Mesh, MeshTags
    from numpy.typing import NDArray


def mesh_from_gmsh(model: Any, comm: MPI.Intracomm) -> tuple[Mesh, MeshTags, MeshTags]:
    """Return dolfinx's mesh, cell tags and facet tags of the Gmsh model on rank 0. Collective."""
    # Tags are the numbers of physical groups. Other ranks ignore `model`.
    try:
        from dolfinx.io import gmsh as reader  # type: ignore[attr-defined]  # 0.10 and later
    except ImportError:
        from dolfinx.io import gmshio as reader  # type: ignore[attr-defined,no-redef]  # 0.9
    # 0.9 returns (mesh, cell tags, facet tags), later versions a longer named tuple that starts
    # with the same three
    return reader.model_to_mesh(model, comm, 0, gdim=3)[:3]


def geometry_dofmap(mesh: Mesh) -> Any:
    """Return the geometry nodes of the local cells, (local cells, nodes per cell)."""
    geometry = mesh.geometry
    return geometry.dofmaps[0] if hasattr(geometry, "dofmaps") else geometry.dofmap


def space_with_dofs(
    space: FunctionSpace,
    size: int,
    ghosts: NDArray[np.int64],
    owners: NDArray[np.int32],
    dofs: NDArray[np.int32],
) -> FunctionSpace:
    """Return a space with the elements of another one and new dofs of block size 1."""
    import dolfinx.cpp
    import dolfinx.fem
    import dolfinx.graph

    index_map = dolfinx.cpp.common.IndexMap(space.mesh.comm, size, ghosts, owners)
    adjacency: Any = dolfinx.graph.adjacencylist(dofs)
    adjacency = getattr(adjacency, "_cpp_object", adjacency)  # a Python object from 0.10 on
    dofmap = dolfinx.cpp.fem.DofMap(space.dofmap.dof_layout, index_map, 1, adjacency, 1)
    old = space._cpp_object
    # A property of the element from 0.10 on.
    shape = [list(old.value_shape)] if hasattr(old, "value_shape") else []
    made = type(old)(space.mesh._cpp_object, old.element, dofmap, *shape)
    return dolfinx.fem.FunctionSpace(space.mesh, space.ufl_element(), made)
