"""Surfaces as modelling programs write them, STL, VTP and OBJ: triangles, read in a child process with limits."""

from __future__ import annotations

import importlib
import re
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from remodel_fenicsx.errors import UnreadableFile
from remodel_fenicsx.model.tensors import Array, Integers
from remodel_fenicsx.system.children import read_guarded

ARRAY = "array "  # before the name of an array that a child hands over
SURFACES = (".vtp", ".stl", ".obj")  # endings


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
    reader = of_vtk(module, name)()
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


def _triangulated(data: Any) -> dict[str, Any]:
    """Triangles of polygons and strips, with corners at one place as one, and arrays of a number at each point."""
    numbers, points = of_vtk("util.numpy_support", "vtk_to_numpy"), data.GetPoints()
    cells = [
        numbers(each.GetConnectivityArray()) for each in (data.GetPolys(), data.GetStrips()) if each.GetNumberOfCells()
    ]
    if not cells:
        raise UnreadableFile("has no triangles or other polygons")
    if min(each.min() for each in cells) < 0 or max(each.max() for each in cells) >= data.GetNumberOfPoints():
        raise UnreadableFile("has polygons with corners that are not there")
    if not np.isfinite(numbers(points.GetData())).all():
        raise UnreadableFile("has points whose coordinates are not finite")
    triangles, merged = of_vtk("vtkFiltersCore", "vtkTriangleFilter")(), of_vtk("vtkFiltersCore", "vtkCleanPolyData")()
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


def of_vtk(module: str, name: str) -> Any:
    """A class or a function of VTK's."""
    try:
        return getattr(importlib.import_module(f"vtkmodules.{module}"), name)
    except ImportError:
        raise UnreadableFile("VTK, which reads such files, is not installed: pip install vtk") from None


def vtk_arrays(data: Any) -> dict[str, Any]:
    """Arrays of points or cells by name."""
    numbers = of_vtk("util.numpy_support", "vtk_to_numpy")
    found = (data.GetArray(k) for k in range(data.GetNumberOfArrays()))
    return {one.GetName(): numbers(one) for one in found if one is not None and one.GetName()}
