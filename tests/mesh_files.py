"""Mesh files of tubes, as a user of Gmsh writes them, and what goes wrong with such files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from remodel_fenicsx.body.gmsh_model import gmsh_model
from remodel_fenicsx.body.wall import Wall
from remodel_fenicsx.body.tube import draw_tube

NAMES = {"bottom": "inlet", "top": "outlet", "inner": "inner", "outer": "outer"}
COUNTS = (8, 2, 3)
RADII, LENGTH = (1.0, 2.0), 3.0
TUBE = (
    Path(__file__).parent / "body" / "files" / "tube.msh"
)  # of `write_tube` in format 2.2, a line for each


def write_tube(
    path: Path,
    element: str = "hexahedron",
    degree: int = 1,
    version: float = 4.1,
    turn: Any = None,
    shift: Any = (0.0, 0.0, 0.0),
    renamed: dict[str, str] = NAMES,
    counts: tuple[int, int, int] = COUNTS,
    length: float = LENGTH,
    moved: Callable[[Any], Any] | None = None,
    every: bool = False,
) -> Path:
    """A tube about z as a file with named faces, perhaps turned and shifted, or its places (n, 3) moved at will."""
    around, through, along = counts
    wall = Wall.from_regions(*RADII, through, {})
    with gmsh_model("tube") as gmsh:
        draw_tube(wall, length, (around, along), element, degree)
        for dimension, tag in gmsh.model.getPhysicalGroups(2):
            name = gmsh.model.getPhysicalName(dimension, tag)
            gmsh.model.removePhysicalName(name)
            gmsh.model.setPhysicalName(dimension, tag, renamed.get(name, name))
        if turn is not None:
            moved = lambda places: places @ np.asarray(turn).T + shift  # noqa: E731
        if moved is not None:
            tags, places, _ = gmsh.model.mesh.getNodes()
            for tag, place in zip(tags, moved(places.reshape(-1, 3)), strict=True):
                gmsh.model.mesh.setNode(tag, place, [])
        gmsh.option.setNumber("Mesh.MshFileVersion", version)
        gmsh.option.setNumber("Mesh.Binary", 0)
        gmsh.option.setNumber("Mesh.SaveAll", int(every))
        gmsh.write(str(path))
    return path


def changed(target: Path, *changes: tuple[str, str], source: Path = TUBE) -> Path:
    """A copy of a file with other words in it."""
    text = source.read_text()
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    target.write_text(text)
    return target
