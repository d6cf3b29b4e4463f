"""Meshes with arrays in formats of other programs: VTU, VTK, XDMF, by meshio in a child process with limits."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.system.guarded import DAMAGED, UnreadableFile, read_guarded

ENDINGS = (".vtu", ".vtk", ".xdmf")
SAVED_OTHERWISE = "; save it as VTU with data mode ASCII (ParaView: File, Save Data), or as .msh"


class ElementBlock(NamedTuple):
    """Elements of a type, by meshio's name of it: rows of nodes."""

    type: str
    data: NDArray[Any]


class ExchangeFile(NamedTuple):
    """What such a file holds: as a `meshio.Mesh`, and the file itself."""

    points: NDArray[Any]
    cells: list[ElementBlock]
    point_data: dict[str, NDArray[Any]]
    cell_data: dict[str, list[NDArray[Any]]]
    data: bytes


def read_exchange_file(path: Path) -> ExchangeFile:
    """Read one; its ending is one of `ENDINGS`.

    Raises
    ------
    UnreadableFile
        If it is damaged, needs more time or memory than it may, or its numbers stand in another file.
    OSError
        If it cannot be opened.
    """
    try:
        arrays, data = read_guarded(path, f"{__name__}:arrays_{path.suffix.lower()[1:]}")
    except UnreadableFile as error:
        raise UnreadableFile(f"{error}{SAVED_OTHERWISE}" if str(error).startswith(DAMAGED) else str(error)) from None
    types, points, cells = json.loads(arrays["names"].tobytes())
    return ExchangeFile(
        arrays["points"],
        [ElementBlock(kind, arrays[f"cells{n}"]) for n, kind in enumerate(types)],
        {name: arrays[f"point_data{n}"] for n, name in enumerate(points)},
        {name: [arrays[f"cell_data{n}_{m}"] for m in range(len(types))] for n, name in enumerate(cells)},
        data,
    )


def arrays_vtu(file: str) -> dict[str, Any]:
    """Of a VTU file; in the child."""
    from meshio import vtu

    return _arrays(vtu.read(file))


def arrays_vtk(file: str) -> dict[str, Any]:
    """Of a VTK file; in the child."""
    from meshio import vtk

    return _arrays(vtk.read(file))


def arrays_xdmf(file: str) -> dict[str, Any]:
    """Of an XDMF file; in the child."""
    from meshio import xdmf

    return _arrays(xdmf.read(file))


def _arrays(mesh: Any) -> dict[str, Any]:
    names = [[block.type for block in mesh.cells], [*mesh.point_data], [*mesh.cell_data]]
    found = {"names": np.frombuffer(json.dumps(names).encode(), np.uint8), "points": mesh.points}
    found |= {f"cells{n}": block.data for n, block in enumerate(mesh.cells)}
    found |= {f"point_data{n}": values for n, values in enumerate(mesh.point_data.values())}
    blocks = enumerate(mesh.cell_data.values())
    return found | {f"cell_data{n}_{m}": values for n, listed in blocks for m, values in enumerate(listed)}
