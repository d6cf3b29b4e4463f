"""A mesh of one's own from a file of any kind that is known: by Gmsh, or in a format of other programs."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from remodel_fenicsx.body.exchange_file import ENDINGS, read_exchange_file
from remodel_fenicsx.body.mesh_file import (
    ALLOWED_ELEMENTS,
    Block,
    Integers,
    MeshFile,
    MeshFileError,
    assembled,
    found_file,
    read_mesh_file,
)
from remodel_fenicsx.system.guarded import UnreadableFile

TAGS = ("gmsh:physical", "CellEntityIds", "medit:ref")
"""Arrays of numbers of faces and volumes: as meshio, VMTK and Medit call them."""
# meshio's name of a type of element -> Gmsh's number of it
TYPES = {
    "tetra": 4, "hexahedron": 5, "tetra10": 11, "hexahedron27": 12,
    "triangle": 2, "quad": 3, "triangle6": 9, "quad9": 10, "quad8": 16,
}  # fmt: skip
SOLIDS = ("tetra", "hexahedron", "tetra10", "hexahedron27")
LINES_AND_POINTS = ("vertex", "line", "line3", "line4")
# Gmsh's order of nodes, as places in VTK's
# https://gmsh.info/doc/texinfo/gmsh.html#Node-ordering, https://vtk.org/doc/nightly/html (vtkTriQuadraticHexahedron)
ORDERS = {
    "tetra10": (0, 1, 2, 3, 4, 5, 6, 7, 9, 8),
    "hexahedron27": (
        0, 1, 2, 3, 4, 5, 6, 7, 8, 11, 16, 9, 17, 10, 18, 19, 12, 15, 13, 14, 24, 22, 20, 21, 23, 25, 26
    ),
}  # fmt: skip


def read_mesh(path: Path, tags: str | None = None) -> MeshFile:
    """Read a mesh file.

    Parameters
    ----------
    path
        By Gmsh (.msh), or one of `exchange_file.ENDINGS`.
    tags
        Of the latter: name of the array with the numbers of faces and volumes; default: the first of `TAGS`.

    Raises
    ------
    MeshFileError
        If it is not there, is no such file, or is damaged: one line.
    """
    if path.suffix.lower() not in ENDINGS:
        return read_mesh_file(path)
    changed, size = found_file(path)
    try:
        return _read(path, tags, changed, size)
    except OSError as error:
        raise MeshFileError(f"cannot be read: {error.strerror or error}") from None


@functools.lru_cache(maxsize=1)
def _read(path: Path, tags: str | None, _changed: int, _size: int) -> MeshFile:
    try:
        mesh = read_exchange_file(path)
    except UnreadableFile as error:
        raise MeshFileError(str(error)) from None
    points = np.asarray(mesh.points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise MeshFileError(f"its nodes have {points.shape[-1]} coordinates; needed are three")
    blocks = _blocks(mesh.cells, _tags(mesh.cell_data, tags))
    return assembled(np.arange(len(points)), points, blocks, {2: {}, 3: {}}, mesh.data)


def _tags(arrays: dict[str, Any], asked: str | None) -> list[Integers]:
    """Numbers of faces and volumes, block by block."""
    name = next((name for name in ((asked,) if asked else TAGS) if name in arrays), None)
    if name is None:
        wanted = repr(asked) if asked else " or ".join(map(repr, TAGS))
        there = ", ".join(map(repr, arrays)) or "none"
        raise MeshFileError(
            f"has no array {wanted} with the numbers of faces and volumes (geometry.tags); it has {there}"
        )
    found = []
    for values in arrays[name]:
        numbers = np.asarray(values, dtype=np.float64)
        numbers = numbers.reshape(len(numbers)) if numbers.shape == (len(numbers), 1) else numbers  # as Gmsh and VTK do
        if numbers.ndim != 1 or not np.isfinite(numbers).all() or (numbers != np.rint(numbers)).any():
            raise MeshFileError(f"the array {name!r} has no whole number for each element")
        found.append(numbers.astype(np.int64))
    return found


def _blocks(cells: Sequence[Any], tags: Sequence[Integers]) -> list[Block]:
    """As Gmsh would number and order them."""
    found, number = [], 1
    for block, groups in zip(cells, tags, strict=True):
        nodes, kind = np.asarray(block.data, dtype=np.int64), str(block.type)
        numbers = np.arange(number, number + len(nodes))
        number += len(nodes)
        if kind in LINES_AND_POINTS:
            continue
        if kind not in TYPES:
            raise MeshFileError(f"elements of type {kind!r}; allowed are {ALLOWED_ELEMENTS}")
        nodes = nodes[:, ORDERS[kind]] if kind in ORDERS else nodes
        found.append(Block(TYPES[kind], 3 if kind in SOLIDS else 2, 0 * numbers, numbers, groups, nodes))
    return found
