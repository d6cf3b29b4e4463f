"""One unstructured grid as a VTU file, which ParaView, PyVista, VMTK, SimVascular and meshio read."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import ArrayLike, NDArray

from remodel_fenicsx.system.regular_files import write_new

_TYPES = {"f": ("Float64", np.float64), "i": ("Int64", np.int64), "u": ("UInt8", np.uint8), "b": ("UInt8", np.uint8)}


def write_vtu(
    path: Path,
    points: ArrayLike,
    cells: NDArray[np.int64],
    cell_type: int,
    cell_data: Mapping[str, ArrayLike],
    point_data: Mapping[str, ArrayLike] = MappingProxyType({}),
) -> None:
    """Write a new file.

    Parameters
    ----------
    path
        That does not exist.
    points
        (points, 3).
    cells
        Node numbers of each cell in VTK's order, (cells, nodes).
    cell_type
        VTK's number, one for all cells.
    cell_data, point_data
        Arrays by name: scalars (n,), vectors (n, 3), tensors (n, 9).

    Raises
    ------
    FileExistsError
        If the path is taken.
    OSError
        If it cannot be written.
    """
    places = np.asarray(points, dtype=np.float64)
    offsets = cells.shape[1] * np.arange(1, len(cells) + 1)
    topology = {"connectivity": cells.ravel(), "offsets": offsets, "types": np.full(len(cells), cell_type, np.uint8)}
    text = [
        '<?xml version="1.0"?>',
        '<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt64" '
        'compressor="vtkZLibDataCompressor">',
        f'<UnstructuredGrid><Piece NumberOfPoints="{len(places)}" NumberOfCells="{len(cells)}">',
        *("<Points>", _array("Points", places), "</Points>"),
        *("<Cells>", *(_array(name, values) for name, values in topology.items()), "</Cells>"),
        *("<PointData>", *(_array(name, values) for name, values in point_data.items()), "</PointData>"),
        *("<CellData>", *(_array(name, values) for name, values in cell_data.items()), "</CellData>"),
        "</Piece></UnstructuredGrid></VTKFile>",
    ]
    write_new(path, "\n".join(text).encode())


def _array(name: str, values: ArrayLike) -> str:
    """One array: a header of four numbers (blocks, size of one, of the last, compressed size), then a zlib block."""
    block = np.asarray(values)
    kind, dtype = _TYPES[block.dtype.kind]
    data = np.ascontiguousarray(block, dtype=np.dtype(dtype).newbyteorder("<")).tobytes()
    packed = zlib.compress(data, 1)
    header = np.array([1, len(data), 0, len(packed)], dtype="<u8").tobytes()
    inside = (base64.b64encode(part).decode() for part in (header, packed))
    columns = f' NumberOfComponents="{block.shape[1]}"' if block.ndim > 1 else ""
    start = f'<DataArray type="{kind}" Name={quoteattr(name)}{columns} format="binary">'
    return f"{start}{''.join(inside)}</DataArray>"
