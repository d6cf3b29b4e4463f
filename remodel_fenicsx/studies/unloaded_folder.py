"""The scene of an unloaded body in a folder of its own."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
from mpi4py import MPI

from remodel_fenicsx.running import with_files_kept
from remodel_fenicsx.scene import Scene
from remodel_fenicsx.unloading import unloaded
from remodel_fenicsx.system.regular_files import part_of
from remodel_fenicsx.system.temporary import temporary_folder


def write_unloaded(scene: Scene, folder: Path) -> str:
    """Write scene.toml of the unloaded body into a new folder, with unloaded.msh of an own one; say what was found.

    Raises
    ------
    SceneError, NoUnloadedShape
        As `unloaded`.
    FileExistsError
        If the folder is there.
    OSError
        If it cannot be written.
    """
    if folder.exists():
        raise FileExistsError(folder)
    with temporary_folder() as temporary:
        found = unloaded(scene, MPI.COMM_SELF, temporary)
        kept, files = with_files_kept(found)
        part = part_of(folder)
        shutil.rmtree(part, ignore_errors=True)  # of one that was killed
        part.mkdir(parents=True)
        for name, data in files.items():
            (part / name).write_bytes(data)
        (part / "scene.toml").write_text(kept.to_toml(f"the unloaded body of {scene.name}"), encoding="utf-8")
        part.rename(folder)
        return "unloaded: " + _in_words(scene, found)


def _in_words(scene: Scene, found: Scene) -> str:
    numbers = found.geometry.model_dump()
    lengths = {name: value for name, value in numbers.items() if isinstance(value, float)}
    known = scene.geometry.model_dump()
    words = [f"{name} {value:.6g} (loaded {known[name]:.6g})" for name, value in lengths.items()]
    if words:
        return ", ".join(words)
    before, after = (one.geometry.checked(one.mesh)[0].points for one in (scene, found))  # type: ignore[attr-defined]
    return f"{len(after)} nodes, moved by {np.linalg.norm(after - before, axis=1).max():.6g} at most"
