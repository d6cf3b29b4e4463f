"""From a body drawn by Gmsh on rank 0 to every rank's `Domain`."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

from mpi4py import MPI

from remodel_fenicsx.body.domain import Domain
from remodel_fenicsx.body.gmsh_model import GeometryError, gmsh_model, named_faces
from remodel_fenicsx.fem import compat


def build_domain(
    draw: Callable[[], None], shape: str, dimensions: dict[str, float], comm: MPI.Intracomm | None = None
) -> Domain:
    """Draw and mesh on rank 0, then share the mesh. Collective.

    Parameters
    ----------
    draw
        Draws and meshes the body in the current Gmsh model, with physical groups for the volume and the faces.
    shape, dimensions
        As in `Domain`.
    comm
        Ranks that share the mesh; default: all.

    Raises
    ------
    GeometryError
        On all ranks, if `draw` fails on rank 0.
    """
    comm = comm or MPI.COMM_WORLD
    # with several threads Scotch parts the same mesh differently from run to run
    os.environ.setdefault("SCOTCH_PTHREAD_NUMBER", "1")
    if comm.rank != 0:
        verdict, faces = comm.bcast(None, root=0)
        if verdict:
            raise GeometryError(verdict)
        return _domain(None, comm, faces, shape, dimensions)
    # the verdict goes out exactly once, whether Gmsh is missing, fails or is interrupted: nobody waits for ever
    told = False
    try:
        with gmsh_model(shape) as gmsh:
            draw()
            faces = named_faces()
            told = True
            comm.bcast(("", faces), root=0)
            return _domain(gmsh.model, comm, faces, shape, dimensions)
    except BaseException as error:
        if told:
            raise
        verdict = f"Gmsh could not mesh the {shape}: {str(error) or type(error).__name__}"
        comm.bcast((verdict, {}), root=0)
        if not isinstance(error, Exception):  # Ctrl-C on rank 0 stays what it is there
            raise
        raise GeometryError(verdict) from error


def _domain(model: Any, comm: MPI.Intracomm, faces: dict[str, int], shape: str, dimensions: dict[str, float]) -> Domain:
    from remodel_fenicsx.fem.symbolic_mesh import SymbolicMesh

    mesh, facet_tags = compat.mesh_from_gmsh(model, comm)
    symbolic = SymbolicMesh(mesh.ufl_domain().ufl_coordinate_element())
    return Domain(type(mesh)(mesh._cpp_object, symbolic), facet_tags, faces, shape, dimensions)
