"""A scene whose geometry is the loaded one, as a scene of the unloaded body that its loads bring there."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mpi4py import MPI

from remodel_fenicsx.body.wall import RoundWall
from remodel_fenicsx.scene import Scene, SceneError
from remodel_fenicsx.unloading.search import NoUnloadedShape
from remodel_fenicsx.system.temporary import temporary_folder

log = logging.getLogger(__name__)

__all__ = ["NoUnloadedShape", "as_unloaded", "unloaded"]


@contextmanager
def as_unloaded(scene: Scene, comm: MPI.Intracomm) -> Iterator[Scene]:
    """The scene itself, or that of its unloaded body, whose mesh is there as long as this context. Collective."""
    if not scene.geometry.is_loaded:
        yield scene
        return
    for line in scene.turned_away() if comm.rank == 0 else ():
        log.warning("%s", line)
    with temporary_folder() as folder:
        yield unloaded(scene, comm, comm.bcast(folder))


def unloaded(scene: Scene, comm: MPI.Intracomm = MPI.COMM_WORLD, folder: Path | None = None) -> Scene:
    """The scene of the body that the loads, at the end of their ramps, bring to the geometry of this one. Collective.

    Parameters
    ----------
    scene
        With `geometry.is = "loaded"`; another is given back.
    comm
        MPI communicator.
    folder
        Where the mesh of an own body is written, on rank 0.

    Returns
    -------
    Scene
        With the geometry of the unloaded body in place of the loaded one.

    Raises
    ------
    SceneError
        If the body has no numbers or nodes to be found, or an own body no folder.
    NoUnloadedShape
        If none is found.

    Examples
    --------
    A tube that is measured under its pressure:

    >>> from remodel_fenicsx import preset_scene, unloaded
    >>> tube = preset_scene("kuhl-holzapfel-2007", "tube")
    >>> seen = tube.with_values({"geometry.is": "loaded", "model.kinematics": "radial", "cells.axes": "cylindrical",
    ...                          "cells.initial": "isotropic", "loads.pressure.value": 0.5})
    >>> found = unloaded(seen).geometry
    >>> round(found.inner_radius, 3), round(found.outer_radius, 3)  # 1 and 3 are under pressure and elongation
    (0.968, 3.101)
    """
    if not scene.geometry.is_loaded:
        return scene
    if isinstance(scene.geometry, RoundWall):
        from remodel_fenicsx.unloading.search import unloaded_tube

        return unloaded_tube(scene, comm)
    if folder is None:
        raise SceneError("geometry.is = 'loaded': a folder is needed for the unloaded mesh")
    from remodel_fenicsx.unloading.search import unloaded_mesh

    return unloaded_mesh(scene, comm, folder)
