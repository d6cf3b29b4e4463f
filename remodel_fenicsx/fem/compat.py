"""Every difference between dolfinx 0.9, 0.10 and 0.11, and nothing else."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

try:
    from dolfinx.io import gmsh as _gmsh_reader  # type: ignore[attr-defined]  # 0.10 and later
except ImportError:
    from dolfinx.io import gmshio as _gmsh_reader  # type: ignore[attr-defined,no-redef]  # 0.9


def mesh_from_gmsh(model: Any, comm: MPI.Intracomm) -> tuple[Any, Any]:
    """The dolfinx mesh and its facet tags of the Gmsh model that rank 0 holds (`model` is not looked at elsewhere)."""
    # 0.9 returns (mesh, cell tags, facet tags), later versions a longer named tuple that starts with the same three
    mesh, _, facet_tags = _gmsh_reader.model_to_mesh(model, comm, 0, gdim=3)[:3]
    return mesh, facet_tags


def geometry_dofmap(mesh: Any) -> Any:
    """Geometry nodes of the local cells, (local cells, nodes per cell)."""
    geometry = mesh.geometry
    return geometry.dofmaps[0] if hasattr(geometry, "dofmaps") else geometry.dofmap
