"""Surfaces as modelling programs write them, STL, PLY, VTP and OBJ: triangles, read in a child process with limits."""

from __future__ import annotations

import importlib
import itertools
import re
import struct
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.errors import UnreadableFile
from remodel_fenicsx.model.tensors import Array, Integers
from remodel_fenicsx.system.children import read_guarded

ARRAY = "array "  # before the name of an array that a child hands over
# letters of Python's struct
PLY_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
PLY_TYPES = dict(zip("char uchar short ushort int uint float double".split(), "bBhHiIfd", strict=True))
PLY_TYPES |= dict(zip("int8 uint8 int16 uint16 int32 uint32 float32 float64".split(), "bBhHiIfd", strict=True))
SURFACES = (".vtp", ".stl", ".ply", ".obj")  # endings


class Surface(NamedTuple):
    """Triangles whose normals point out of the lumen, and arrays of numbers at their corners."""

    points: Array
    triangles: Integers
    arrays: dict[str, Array]


def triangles_of(path: Path) -> tuple[Surface, bytes]:
    """The triangles of a file, whichever way they look, and the file."""
    try:
        found, data = read_guarded(path, f"{__name__}:{path.suffix[1:].lower()}")
    except UnreadableFile as error:
        raise UnreadableFile(f"{error}; save it again, in ParaView as VTP or binary STL") from None
    points, triangles = found.pop("points").astype(np.float64), found.pop("triangles").astype(np.int64)
    return Surface(points, triangles, {name.removeprefix(ARRAY): values for name, values in found.items()}), data


# ---------------------------------------------------------------- the child


def _by_vtk(module: str, name: str, file: str) -> dict[str, Any]:
    reader = getattr(importlib.import_module(f"vtkmodules.{module}"), name)()
    reader.AddObserver("WarningEvent", lambda *_: None)  # of colours behind the places of an OBJ, say
    reader.SetFileName(file)
    reader.Update()
    return _triangulated(reader.GetOutput())


vtp = partial(_by_vtk, "vtkIOXML", "vtkXMLPolyDataReader")
obj = partial(_by_vtk, "vtkIOGeometry", "vtkOBJReader")


def stl(file: str) -> dict[str, Any]:
    """As text with decimal commas too."""
    data = Path(file).read_bytes()
    if b"\0" not in data:
        Path(file).write_bytes(re.sub(rb"(?<=\d),(?=\d)", b".", data))  # in this process' memory
    return _by_vtk("vtkIOGeometry", "vtkSTLReader", file)


def ply(file: str) -> dict[str, Any]:
    """Not by VTK, whose reader leaves arrays at points out, and crashes where a file is cut off."""
    head, _, body = Path(file).read_bytes().partition(b"end_header")
    header = [line.split() for line in head.decode("ascii", "replace").splitlines() if line.strip()]
    try:
        order = PLY_ORDERS[next(line[1] for line in header if line[0] == "format")]
        points, polygons = _ply_numbers(header, order, body[body.index(b"\n") + 1 :])
        places = np.column_stack([points[axis] for axis in "xyz"]).astype(np.float64)
    except (IndexError, KeyError, StopIteration, ValueError, struct.error):
        raise UnreadableFile("has other numbers than its header announces: is it cut off?") from None
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

    surface, cells, corners = vtkPolyData(), vtkCellArray(), vtkPoints()
    corners.SetData(numpy_to_vtk(places))
    cells.ImportLegacyFormat(numpy_to_vtkIdTypeArray(np.array(polygons, dtype=np.int64)))
    surface.SetPoints(corners)
    surface.SetPolys(cells)
    for name in {*(points.dtype.names or ())} - {*"xyz"}:
        array = numpy_to_vtk(points[name].astype(np.float64), deep=True)
        array.SetName(name)
        surface.GetPointData().AddArray(array)
    return _triangulated(surface)


def _ply_numbers(header: Sequence[list[str]], order: str, body: bytes) -> tuple[NDArray[Any], list[int]]:
    """Numbers at the points by name, and polygons, each with the number of its corners before them."""
    is_text, at = order == "=", 0
    body = np.array(body.split(), dtype=np.float64).tobytes() if is_text else body
    points = np.empty(0)
    polygons: list[int] = []
    starts = [*(k for k, line in enumerate(header) if line[0] == "element"), len(header)]
    for start, end in itertools.pairwise(starts):
        (_, element, count), lines = header[start], header[start + 1 : end]
        properties = {
            line[-1]: ["d" if is_text else PLY_TYPES[kind] for kind in line[1:-1] if kind != "list"]
            for line in lines
            if line[0] == "property"
        }
        if element == "vertex":  # numbers alone, and most of them
            record = np.dtype([(name, order + kind) for name, (kind,) in properties.items()])
            points = np.frombuffer(body, record, abs(int(count)), at)
            at += points.nbytes
            continue
        for _ in range(int(count)):
            for name, kinds in properties.items():
                row: tuple[Any, ...] = (1,)
                for kind in kinds:  # before a list stands its length
                    code = f"{order}{int(row[0])}{kind}"
                    row = struct.unpack_from(code, body, at)
                    at += struct.calcsize(code)
                if element == "face" and name.startswith("vertex_ind"):
                    polygons.extend((len(row), *map(int, row)))
    if body[at:].strip():
        raise ValueError
    return points, polygons


def _triangulated(data: Any) -> dict[str, Any]:
    """Triangles of polygons and strips, with corners at one place as one, and arrays of a number at each point."""
    from vtkmodules.util.numpy_support import vtk_to_numpy as numbers
    from vtkmodules.vtkFiltersCore import vtkCleanPolyData, vtkTriangleFilter

    points = data.GetPoints()
    cells = [
        numbers(each.GetConnectivityArray()) for each in (data.GetPolys(), data.GetStrips()) if each.GetNumberOfCells()
    ]
    if not cells:
        raise UnreadableFile("has no triangles or other polygons")
    if min(each.min() for each in cells) < 0 or max(each.max() for each in cells) >= data.GetNumberOfPoints():
        raise UnreadableFile("has polygons with corners that are not there")
    if not np.isfinite(numbers(points.GetData())).all():
        raise UnreadableFile("has points whose coordinates are not finite")
    triangles, merged = vtkTriangleFilter(), vtkCleanPolyData()
    triangles.SetInputData(data)
    merged.SetInputConnection(triangles.GetOutputPort())
    merged.SetTolerance(0.0)  # two corners at one place leave a line, which is passed over
    merged.Update()
    found = merged.GetOutput()
    if not found.GetNumberOfPolys():
        raise UnreadableFile("has no triangles with three different corners")
    return {
        "points": numbers(found.GetPoints().GetData()),
        "triangles": numbers(found.GetPolys().GetConnectivityArray()).reshape(-1, 3),
        **{ARRAY + name: values for name, values in vtk_arrays(found.GetPointData()).items() if values.ndim == 1},
    }


def vtk_arrays(data: Any) -> dict[str, Any]:
    """Arrays of points or cells by name."""
    from vtkmodules.util.numpy_support import vtk_to_numpy as numbers

    found = (data.GetArray(k) for k in range(data.GetNumberOfArrays()))
    return {one.GetName(): numbers(one) for one in found if one is not None and one.GetName()}
