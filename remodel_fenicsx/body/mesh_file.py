"""User-supplied mesh files, read by VTK and meshio in a child process with limits, never executed.

Gmsh executes a script under any file name, so it never gets one. meshio silently ignores some
faults in Gmsh's own format, MSH 2.2 and 4.1 as text. This module rejects them:
https://gmsh.info/doc/texinfo/gmsh.html#MSH-file-format.
"""

from __future__ import annotations

import hashlib
import importlib
import itertools
import json
import logging
import re
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx._lazy import Late
from remodel_fenicsx.body.gmsh_model import gmsh, gmsh_model
from remodel_fenicsx.errors import UnreadableFile
from remodel_fenicsx.model.tensors import Array, Integers
from remodel_fenicsx.system.children import DAMAGED, read_guarded

log = logging.getLogger(__name__)

# By meshio's names of element types.
VOLUMES = {
    "tetra": ("tetrahedron", 1),
    "hexahedron": ("hexahedron", 1),
    "tetra10": ("tetrahedron", 2),
    "hexahedron27": ("hexahedron", 2),
}
FACET_CORNERS = {"triangle": 3, "triangle6": 3, "quad": 4, "quad8": 4, "quad9": 4}
WEDGE = "wedge"
ALLOWED_ELEMENTS = "tetrahedra of 4 or 10 nodes, hexahedra of 8 or 27, wedges of 6"
# Gmsh's numbers of element types and its orders of nodes, by meshio's names.
gmsh_format = Late("meshio.gmsh.common")


@dataclass(frozen=True, eq=False)
class MeshFile:
    """Contents of a mesh file."""

    points: Array
    cells: Integers
    cell_numbers: Integers
    cell_groups: Integers
    facets: Integers
    facet_groups: Integers
    kind: str
    degree: int
    names: dict[int, dict[str, int]]
    data: bytes
    sha256: str
    surfaces: Mapping[str, bytes] = MappingProxyType({})

    @property
    def blocks(self) -> list[Block]:
        """Facets by their corners, and elements."""
        (kind,) = (name for name, of_kind in VOLUMES.items() if of_kind == (self.kind, self.degree))
        side = "triangle" if self.kind == "tetrahedron" else "quad"
        return [
            Block(side, self.facet_groups, self.facets),
            Block(kind, self.cell_groups, self.cells),
        ]

    @property
    def corners(self) -> Integers:
        """Corners of the elements, (elements, 4 or 8)."""
        return self.cells[:, : 4 if self.kind == "tetrahedron" else 8]


class Block(NamedTuple):
    """Elements of one type (meshio's name): groups, and rows of nodes in Gmsh's order."""

    kind: str
    groups: Integers
    nodes: Integers


def as_rows(table: Integers) -> list[tuple[int, ...]]:
    """Return the rows of a table as tuples."""
    listed: Any = table.tolist()
    return [tuple(row) for row in listed]


def format_position(point: Array) -> str:
    """Format the coordinates of a point."""
    return "(" + ", ".join(f"{number:.4g}" for number in point) + ")"


def unique_in_order(values: Integers) -> list[int]:
    """Return the distinct numbers of an array, in its order."""
    listed: Any = values.tolist()
    return list(dict.fromkeys(listed))


# ---------------------------------------------------------------- files, by VTK and meshio

READERS = {f".{kind}": f"{__name__}:arrays_{kind}" for kind in ("msh", "vtu", "vtk", "xdmf")}
# The child imports gmsh before it is limited to the file, because the import opens other files.
READERS[".msh"] = f"gmsh {READERS['.msh']}"
_FORMAT = re.compile(rb"\$MeshFormat\s+(2\.2|4\.1) 0 \d+\s+\$EndMeshFormat")
_SECTION = re.compile(rb"^\$(\w+)\s*?\n(.*?)^\$End\1\b", re.DOTALL | re.MULTILINE)
_OLD_TAGS = re.compile(rb"(?m)^[ \t]*\d+([ \t]+\d+[ \t]+\d+[ \t]+(\d+)[ \t]+)\d+(?=[ \t])")
SAVE_AS_VTU_HINT = "; save it as VTU with data mode ASCII (ParaView: File, Save Data), or as .msh"
TAGS = ("gmsh:physical", "CellEntityIds", "medit:ref")
"""Names of the array of face and volume numbers in meshio, VMTK and Medit."""


Arrays = dict[str, NDArray[Any]]
Blocks = list[tuple[str, Integers]]


class ExchangeFile(NamedTuple):
    """Contents of an exchange file: element types with nodes, arrays, and the bytes."""

    points: Array
    cells: Blocks
    point_data: Arrays
    cell_data: Arrays
    group_names: list[tuple[int, int, str]]
    data: bytes


def read_exchange_file(path: Path) -> ExchangeFile:
    """Read a file whose suffix is in `READERS`."""
    ending = path.suffix.lower()
    try:
        arrays, data = read_guarded(path, READERS[ending])
    except UnreadableFile as error:
        is_exchanged = ending != ".msh" and str(error).startswith(DAMAGED)
        raise UnreadableFile(f"{error}{SAVE_AS_VTU_HINT if is_exchanged else ''}") from None
    names, points, *others = arrays.values()
    (kinds, of_points, of_cells, groups), rest = json.loads(names.tobytes()), iter(others)
    cells = [*zip(kinds, rest, strict=False)]  # each zip consumes its part of the iterator
    data_of_points, data_of_cells = (
        dict(zip(one, rest, strict=False)) for one in (of_points, of_cells)
    )
    return ExchangeFile(points, cells, data_of_points, data_of_cells, groups, data)


# Functions that the child calls. It does not import the modules of other formats.


def arrays_xdmf(file: str) -> Arrays:
    """Read the arrays of an XDMF file."""
    mesh = importlib.import_module("meshio.xdmf").read(file)
    cells = [(block.type, in_gmsh_order(block.type, block.data)) for block in mesh.cells]
    of_cells = {name: np.concatenate(values) for name, values in mesh.cell_data.items()}
    return as_arrays(mesh.points, cells, mesh.point_data, of_cells)


def _read_by_vtk(module: str, reader: str, file: str, is_surface: bool = True) -> Any:
    made = getattr(importlib.import_module(f"vtkmodules.{module}"), reader)()
    if is_surface:
        # VTK warns, for example, of colours after the coordinates of an OBJ file.
        made.AddObserver("WarningEvent", lambda *_: None)
    made.SetFileName(file)
    for read_all in ("ReadAllScalarsOn", "ReadAllVectorsOn", "ReadAllTensorsOn", "ReadAllFieldsOn"):
        getattr(made, read_all, lambda: None)()
    made.Update()
    return made.GetOutput()


def _of_vtk(module: str, reader: str, file: str) -> Arrays:
    """Read the arrays of a file by VTK, in meshio's form."""
    from meshio._vtk_common import vtk_to_meshio_type
    from vtkmodules.util.numpy_support import vtk_to_numpy as numbers

    grid = _read_by_vtk(module, reader, file, is_surface=False)
    if not grid.GetNumberOfCells():
        raise UnreadableFile("has no elements")
    types, nodes = numbers(grid.GetCellTypesArray()), numbers(
        grid.GetCells().GetConnectivityArray()
    )
    starts = numbers(grid.GetCells().GetOffsetsArray())
    changes: Any = np.flatnonzero(np.diff(types)) + 1
    cells = []
    for start, stop in itertools.pairwise([0, *changes.tolist(), len(types)]):
        rows = nodes[starts[start] : starts[stop]].reshape(stop - start, -1)
        kind = vtk_to_meshio_type[int(types[start])]
        cells.append((kind, in_gmsh_order(kind, rows)))
    points = numbers(grid.GetPoints().GetData())
    return as_arrays(points, cells, vtk_arrays(grid.GetPointData()), vtk_arrays(grid.GetCellData()))


arrays_vtu = partial(_of_vtk, "vtkIOXML", "vtkXMLUnstructuredGridReader")
arrays_vtk = partial(_of_vtk, "vtkIOLegacy", "vtkUnstructuredGridReader")


def arrays_msh(file: str) -> Arrays:
    """Read the arrays of a file by Gmsh; elements of several groups appear several times."""
    data = Path(file).read_bytes()
    version = _FORMAT.match(data)
    if version is None:  # Gmsh would run a script
        raise UnreadableFile(
            "is not a Gmsh mesh in format 2.2 or 4.1 as text (in Gmsh: Mesh.Binary = 0)"
        )
    if rest := _SECTION.sub(b"", data).split():
        words = b" ".join(rest[:9])[:40].decode("ascii", "replace")
        raise UnreadableFile(f"has {words!r} outside of its sections: is it truncated?")
    is_old, number = version[1] == b"2.2", itertools.count(1)
    sections = dict(_SECTION.findall(data))
    # Numbers of lines in a section for each number in its head. Gmsh ignores further lines.
    for name, lines in {"Nodes": (1, 2), "Elements": (1, 1), "Entities": (1, 1, 1, 1)}.items():
        head, *rows = sections.get(name.encode(), b"0").strip().splitlines()
        if len(rows) != sum(
            count * int(number) for count, number in zip(lines, head.split(), strict=False)
        ):
            raise UnreadableFile(f"has other {name.lower()} than ${name} announces")
    if is_old:  # its elements have their own groups, independent of entities, and an order
        data = _OLD_TAGS.sub(lambda match: b"%d%b%b" % (next(number), match[1], match[2]), data)
        Path(file).write_bytes(data)  # the file is in this process's memory
    with gmsh_model("file"):
        gmsh.merge(file)
        groups = gmsh.model.getPhysicalGroups()
        names = [(*group, name) for group in groups if (name := gmsh.model.getPhysicalName(*group))]
        points, blocks = of_gmsh(is_old)
    groups = np.concatenate([[], *(block.groups for block in blocks)])
    return as_arrays(
        points, [(block.kind, block.nodes) for block in blocks], {}, {TAGS[0]: groups}, names
    )


def of_gmsh(by_number: bool = False) -> tuple[Array, list[Block]]:
    """Return the nodes of Gmsh's current model by number, and its elements, once for each group."""
    model, parts_of_kind = gmsh.model, dict[str, list[Any]]()
    tags, places, _ = model.mesh.getNodes()
    order = np.argsort(tags)
    for dimension, entity in model.getEntities():
        if model.getType(dimension, entity).startswith("Ghost"):  # copies from other partitions
            continue
        groups: list[int] = [*model.getPhysicalGroupsForEntity(dimension, entity)]
        for kind, numbers, nodes in zip(*model.mesh.getElements(dimension, entity), strict=True):
            name = gmsh_format._gmsh_to_meshio_type[kind]
            rows = np.searchsorted(tags, nodes, sorter=order).reshape(len(numbers), -1)
            parts_of_kind.setdefault(name, []).extend(
                (numbers, np.full(len(rows), group), rows) for group in groups or [0]
            )
    blocks = []
    for name, parts in parts_of_kind.items():
        numbers, of_groups, rows = map(np.concatenate, zip(*parts, strict=True))
        chosen = np.argsort(numbers) if by_number else slice(None)
        blocks.append(Block(name, of_groups[chosen], rows[chosen]))
    return np.reshape(places, (-1, 3))[order], blocks


def as_arrays(
    points: Array,
    cells: Blocks,
    point_data: Arrays,
    cell_data: Arrays,
    group_names: Sequence[object] = (),
) -> Arrays:
    """Return an `ExchangeFile` as the child transfers it: names, and arrays in their order."""
    names = [[kind for kind, _ in cells], [*point_data], [*cell_data], group_names]
    arrays = [points, *(rows for _, rows in cells), *point_data.values(), *cell_data.values()]
    listed = {str(number): values for number, values in enumerate(arrays)}
    return {"names": np.frombuffer(json.dumps(names).encode(), np.uint8), **listed}


def in_gmsh_order(kind: str, rows: Integers) -> Integers:
    """Return rows of nodes in Gmsh's order, from VTK's order, which meshio uses."""
    return gmsh_format._meshio_to_gmsh_order(kind, rows)


# ---------------------------------------------------------------- surfaces

ARRAY = "array "  # prefix of the name of an array that a child transfers
# Letters of Python's `struct`.
PLY_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
PLY_TYPES = dict(
    zip("char uchar short ushort int uint float double".split(), "bBhHiIfd", strict=True)
)
PLY_TYPES |= dict(
    zip("int8 uint8 int16 uint16 int32 uint32 float32 float64".split(), "bBhHiIfd", strict=True)
)
SURFACES = (".vtp", ".stl", ".ply", ".obj")  # suffixes


class Surface(NamedTuple):
    """Triangles whose normals point out of the lumen, and numerical arrays at their corners."""

    points: Array
    triangles: Integers
    arrays: dict[str, Array]


def triangles_of(path: Path) -> tuple[Surface, bytes]:
    """Read the triangles of a file, in any orientation, and the file's bytes."""
    try:
        arrays, data = read_guarded(path, f"{__name__}:{path.suffix[1:].lower()}")
    except UnreadableFile as error:
        raise UnreadableFile(f"{error}; save it again in ParaView, as VTP or binary STL") from None
    points, triangles = arrays.pop("points").astype(np.float64), arrays.pop("triangles").astype(
        np.int64
    )
    return (
        Surface(
            points, triangles, {name.removeprefix(ARRAY): values for name, values in arrays.items()}
        ),
        data,
    )


# ---------------------------------------------------------------- in the child process


def _by_vtk(module: str, reader: str, file: str) -> Arrays:
    return _triangulated(_read_by_vtk(module, reader, file))


vtp = partial(_by_vtk, "vtkIOXML", "vtkXMLPolyDataReader")
obj = partial(_by_vtk, "vtkIOGeometry", "vtkOBJReader")


def stl(file: str) -> Arrays:
    """Read an STL file, as text also with decimal commas."""
    data = Path(file).read_bytes()
    if b"\0" not in data:
        # The file is in this process's memory.
        Path(file).write_bytes(re.sub(rb"(?<=\d),(?=\d)", b".", data))
    return _by_vtk("vtkIOGeometry", "vtkSTLReader", file)


def ply(file: str) -> Arrays:
    """Read the surface in a PLY file."""
    # VTK's reader ignores arrays at points, and crashes on a truncated file.
    head, _, body = Path(file).read_bytes().partition(b"end_header")
    header = [line.split() for line in head.decode("ascii", "replace").splitlines() if line.strip()]
    try:
        order = PLY_ORDERS[next(line[1] for line in header if line[0] == "format")]
        points, polygons = _ply_numbers(header, order, body[body.index(b"\n") + 1 :])
        places = np.column_stack([points.pop(axis) for axis in "xyz"]).astype(np.float64)
    except (IndexError, KeyError, StopIteration, ValueError, struct.error):
        raise UnreadableFile(
            "has other numbers than its header announces: is it truncated?"
        ) from None
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

    surface = vtkPolyData()
    cells, corners = vtkCellArray(), vtkPoints()
    corners.SetData(numpy_to_vtk(places))
    cells.ImportLegacyFormat(numpy_to_vtkIdTypeArray(np.array(polygons, dtype=np.int64)))
    surface.SetPoints(corners)
    surface.SetPolys(cells)
    for name, values in points.items():
        array = numpy_to_vtk(values.astype(np.float64), deep=True)
        array.SetName(name)
        surface.GetPointData().AddArray(array)
    return _triangulated(surface)


def _ply_numbers(
    header: Sequence[list[str]], order: str, body: bytes
) -> tuple[dict[str, Any], list[int]]:
    """Return point arrays by name, and polygons, each after the number of its corners."""
    is_text, at = order == "=", 0
    body = np.array(body.split(), dtype=np.float64).tobytes() if is_text else body
    points: dict[str, Any] = {}
    polygons: list[int] = []
    starts = [*(k for k, line in enumerate(header) if line[0] == "element"), len(header)]
    for start, end in itertools.pairwise(starts):
        (_, element, count), lines = header[start], header[start + 1 : end]
        properties = {
            line[-1]: ["d" if is_text else PLY_TYPES[kind] for kind in line[1:-1] if kind != "list"]
            for line in lines
            if line[0] == "property"
        }
        if all(len(kinds) == 1 for kinds in properties.values()):
            record = np.dtype([(name, order + kind) for name, (kind,) in properties.items()])
            records = (
                np.frombuffer(body, record, abs(int(count)), at)
                if int(count)
                else np.empty(0, record)
            )
            at += records.nbytes
            points |= {name: records[name] for name in properties} if element == "vertex" else {}
            continue
        for _ in range(int(count)):
            for name, kinds in properties.items():
                row: tuple[Any, ...] = (1,)
                for kind in kinds:  # the length of a list precedes it
                    code = f"{order}{int(row[0])}{kind}"
                    row = struct.unpack_from(code, body, at)
                    at += struct.calcsize(code)
                if element == "face" and name.startswith("vertex_ind"):
                    polygons.extend((len(row), *map(int, row)))
    if body[at:].strip():
        raise ValueError
    return points, polygons


def _triangulated(data: Any) -> Arrays:
    """Return triangles of polygons and strips with merged corners, and scalar point arrays."""
    from vtkmodules.util.numpy_support import vtk_to_numpy as numbers
    from vtkmodules.vtkFiltersCore import vtkCleanPolyData, vtkTriangleFilter

    points = data.GetPoints()
    cells = [
        numbers(each.GetConnectivityArray())
        for each in (data.GetPolys(), data.GetStrips())
        if each.GetNumberOfCells()
    ]
    if not cells:
        raise UnreadableFile("has no triangles or other polygons")
    if (
        min(each.min() for each in cells) < 0
        or max(each.max() for each in cells) >= data.GetNumberOfPoints()
    ):
        raise UnreadableFile("has polygons with missing corners")
    if not np.isfinite(numbers(points.GetData())).all():
        raise UnreadableFile("has points whose coordinates are not finite")
    triangles, merged = vtkTriangleFilter(), vtkCleanPolyData()
    triangles.SetInputData(data)
    merged.SetInputConnection(triangles.GetOutputPort())
    merged.SetTolerance(0.0)  # a triangle with two equal corners becomes a line, which is ignored
    merged.Update()
    surface = merged.GetOutput()
    if not surface.GetNumberOfPolys():
        raise UnreadableFile("has no triangles with three different corners")
    return {
        "points": numbers(surface.GetPoints().GetData()),
        "triangles": numbers(surface.GetPolys().GetConnectivityArray()).reshape(-1, 3),
        **{
            ARRAY + name: values
            for name, values in vtk_arrays(surface.GetPointData()).items()
            if values.ndim == 1
        },
    }


def vtk_arrays(data: Any) -> Arrays:
    """Return the arrays of points or cells by name."""
    from vtkmodules.util.numpy_support import vtk_to_numpy as numbers

    arrays = (data.GetArray(k) for k in range(data.GetNumberOfArrays()))
    return {one.GetName(): numbers(one) for one in arrays if one is not None and one.GetName()}


# ---------------------------------------------------------------- meshes of bodies


def read_mesh(path: Path, tags: str | None = None, surfaces: Sequence[Path] = ()) -> MeshFile:
    """Read a mesh file, with faces from surface files, each under the name of its file."""
    try:
        stats = [file.stat() for file in (path, *surfaces)]
        if any(file.is_dir() for file in (path, *surfaces)):
            raise UnreadableFile("is a folder; a mesh is a file")
        changed = tuple((status.st_mtime_ns, status.st_size) for status in stats)
        return _read(path, tags, tuple(surfaces), changed)
    except FileNotFoundError as error:
        raise UnreadableFile(f"no such file: {error.filename}") from None
    except OSError as error:
        raise UnreadableFile(f"cannot be read: {error.strerror or error}") from None


@lru_cache(maxsize=1)
def _read(
    path: Path, tags: str | None, surfaces: tuple[Path, ...], _changed: tuple[Any, ...]
) -> MeshFile:
    mesh = read_exchange_file(path)
    points = np.asarray(mesh.points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise UnreadableFile(f"its nodes have {points.shape[-1]} coordinates; must have three")
    names: dict[int, dict[str, int]] = {2: {}, 3: {}}
    for dimension, number, name in mesh.group_names:
        names.setdefault(dimension, {})[name] = number
    ends = np.cumsum([len(rows) for _, rows in mesh.cells])
    of_blocks = zip(mesh.cells, np.split(_tags(mesh, tags, bool(surfaces)), ends), strict=False)
    blocks = [
        Block(kind, groups, np.asarray(rows, dtype=np.int64)) for (kind, rows), groups in of_blocks
    ]
    mesh_file = assembled(
        points, blocks, {dimension: names[dimension] for dimension in (2, 3)}, mesh.data
    )
    for surface in surfaces:
        mesh_file = _with_surface(mesh_file, surface)
    return mesh_file


SAME_NODE = 1e-3  # distance of equal nodes over a triangle's shortest side; files have 7 digits


def _with_surface(file: MeshFile, path: Path) -> MeshFile:
    """Add the triangles of a surface to a mesh as a face; their corners must be nodes."""
    from scipy.spatial import cKDTree  # most meshes are one file

    if file.kind != "tetrahedron":
        raise UnreadableFile(f"{path.name}: a surface of triangles needs a mesh of tetrahedra")
    if path.stem in file.names[2]:
        raise UnreadableFile(f"{path.name}: face {path.stem!r} already exists; rename the surface")
    try:
        surface, data = triangles_of(path)
    except UnreadableFile as error:
        raise UnreadableFile(f"{path.name}: {error}") from None
    corners = surface.points[surface.triangles]
    away, nodes = cKDTree(file.points).query(corners)
    far = away > SAME_NODE * np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).min(
        axis=1, keepdims=True
    )
    if far.any():
        where = f"at {format_position(corners[far][0])}, {away[far][0]:.3g} from the nearest node"
        rule = "The surface must belong to this mesh, in the same unit"
        raise UnreadableFile(
            f"{path.name}: {far.sum()} triangle corners are no nodes, the first {where}. {rule}"
        )
    number = 1 + max([*unique_in_order(file.facet_groups), *file.names[2].values()], default=0)
    return replace(
        file,
        facets=np.concatenate([file.facets, nodes]),
        facet_groups=np.append(file.facet_groups, np.full(len(nodes), number)),
        names={**file.names, 2: {**file.names[2], path.stem: number}},
        surfaces={**file.surfaces, path.name: data},
        sha256=hashlib.sha256(
            f"{file.sha256} {hashlib.sha256(data).hexdigest()}".encode()
        ).hexdigest(),
    )


def _tags(mesh: ExchangeFile, asked: str | None, may_be_none: bool) -> Integers:
    """Return the numbers of faces and volumes, or zeros if the file has none and needs none."""
    arrays, count = mesh.cell_data, sum(len(rows) for _, rows in mesh.cells)
    name = next((name for name in ((asked,) if asked else TAGS) if name in arrays), None)
    if name is None and asked is None and may_be_none:
        return np.zeros(count, dtype=np.int64)
    if name is None:
        wanted = repr(asked) if asked else " or ".join(map(repr, TAGS))
        there = ", ".join(map(repr, arrays)) or "none"
        raise UnreadableFile(
            f"has no array {wanted} with the numbers of faces and volumes (geometry.tags); "
            f"it has {there}"
        )
    numbers = np.asarray(arrays[name], dtype=np.float64)
    if (
        numbers.size != count
        or not np.isfinite(numbers).all()
        or (numbers != np.rint(numbers)).any()
    ):
        raise UnreadableFile(f"the array {name!r} must have an integer for each element")
    return numbers.reshape(-1).astype(np.int64)


# ---------------------------------------------------------------- elements of all formats


# Orders of a wedge's nodes that begin at each corner, and its tetrahedra in the order that begins
# at its smallest corner. J. Dompierre et al., How to subdivide pyramids, prisms and hexahedra into
# tetrahedra (1999): the diagonal of a face begins at its smallest corner.
_SEEN = np.array(
    [
        (0, 1, 2, 3, 4, 5),
        (1, 2, 0, 4, 5, 3),
        (2, 0, 1, 5, 3, 4),
        (3, 5, 4, 0, 2, 1),
        (4, 3, 5, 1, 0, 2),
        (5, 4, 3, 2, 1, 0),
    ]
)
_SPLIT = np.array(
    [[(0, 1, 2, 4), (0, 4, 2, 5), (0, 4, 5, 3)], [(0, 1, 2, 5), (0, 1, 5, 4), (0, 4, 5, 3)]]
)


def split_wedges(nodes: Integers) -> Integers:
    """Split each wedge (n, 6) into three tetrahedra of the same orientation, (n, 3, 4)."""
    rows = np.arange(len(nodes))
    seen = nodes[rows[:, None], _SEEN[nodes.argmin(axis=1)]]
    other = np.minimum(seen[:, 1], seen[:, 5]) < np.minimum(seen[:, 2], seen[:, 4])
    return seen[rows[:, None, None], _SPLIT[other.astype(int)]]


def split_quads(nodes: Integers) -> Integers:
    """Split each quadrilateral (n, 4) into two triangles that fit adjacent wedges, (2 n, 3)."""
    turned = np.where((nodes.argmin(axis=1) % 2 == 1)[:, None], np.roll(nodes, -1, axis=1), nodes)
    return turned[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def _split(points: Array, block: Block) -> Block:
    """Split wedges of boundary layers, and the quadrilaterals next to them."""
    if block.kind == WEDGE:
        tetrahedra = split_wedges(block.nodes)
        sides = points[tetrahedra[:, :, 1:]] - points[tetrahedra[:, :, :1]]
        # All tetrahedra of a wedge are reordered or none, so that an invalid wedge stays invalid.
        turned = np.linalg.det(sides).sum(axis=1) < 0
        tetrahedra[turned] = tetrahedra[turned][:, :, [0, 2, 1, 3]]
        return Block("tetra", np.repeat(block.groups, 3), tetrahedra.reshape(-1, 4))
    if block.kind == "quad":
        return Block("triangle", np.repeat(block.groups, 2), split_quads(block.nodes))
    return block


def _numbered(blocks: list[Block]) -> Iterator[tuple[Integers, Block]]:
    """Yield each block with the numbers of its elements, from 1 in the order of the file."""
    starts = np.cumsum([1, *(len(block.nodes) for block in blocks)])
    for start, block in zip(starts, blocks, strict=False):
        yield np.arange(start, start + len(block.nodes)), block


def assembled(
    points: Array, blocks: list[Block], names: dict[int, dict[str, int]], data: bytes
) -> MeshFile:
    """Check points and blocks of elements, and return them as a `MeshFile`."""
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        raise UnreadableFile(
            f"a node is at {tuple(points[bad][0].tolist())}: coordinates must be finite"
        )
    for number, block in _numbered(blocks):
        if block.kind not in (*VOLUMES, *FACET_CORNERS, WEDGE) and not block.kind.startswith(
            ("vertex", "line")
        ):
            raise UnreadableFile(f"elements of type {block.kind!r}; must be {ALLOWED_ELEMENTS}")
        if (lost := ((block.nodes < 0) | (block.nodes >= len(points))).any(axis=1)).any():
            raise UnreadableFile(f"element {number[lost][0]} has a missing node")
    if any(block.kind == WEDGE and len(block.nodes) for block in blocks):
        log.info("each wedge is split into three tetrahedra, each quadrilateral into two triangles")
        blocks = [_split(points, block) for block in blocks]
    solid = [(number, block) for number, block in _numbered(blocks) if block.kind in VOLUMES]
    kinds = sorted({VOLUMES[block.kind] for _, block in solid if len(block.nodes)})
    if not kinds:
        raise UnreadableFile("no elements of a volume; in Gmsh: a physical volume, and Mesh 3D")
    if len(kinds) > 1:
        listed = " and ".join(f"{kind} of degree {degree}" for kind, degree in kinds)
        raise UnreadableFile(f"elements of several types: {listed}; must be of one type")
    kind, degree = kinds[0]
    corners = 3 if kind == "tetrahedron" else 4
    flat = [block for block in blocks if FACET_CORNERS.get(block.kind) == corners]
    facets = np.concatenate(
        [np.empty((0, corners), dtype=np.int64), *(block.nodes[:, :corners] for block in flat)]
    )
    cells = np.concatenate([block.nodes for _, block in solid])
    used, rows = np.unique(cells, return_inverse=True)  # Gmsh also writes nodes without elements
    row_of = np.full(len(points), -1, dtype=np.int64)
    row_of[used] = np.arange(len(used))
    return MeshFile(
        points[used],
        rows.reshape(cells.shape),
        np.concatenate([number for number, _ in solid]),
        np.concatenate([block.groups for _, block in solid]),
        row_of[facets],
        np.concatenate([np.empty(0, dtype=np.int64), *(block.groups for block in flat)]),
        kind,
        degree,
        names,
        data,
        hashlib.sha256(data).hexdigest(),
    )


def gmsh_text(
    points: Array, blocks: Iterable[Block], names: Mapping[int, Mapping[str, int]]
) -> str:
    """Format a mesh as a Gmsh file, format 2.2, with nodes numbered 1, 2, ... in their order."""
    numbers = gmsh_format._meshio_to_gmsh_type
    groups = [
        f'{dimension} {number} "{name}"'
        for dimension, by in names.items()
        for name, number in by.items()
    ]
    places = [f"{x:.17g} {y:.17g} {z:.17g}" for x, y, z in points]
    rows = [
        f"{numbers[kind]} 2 {group} {group} {' '.join(map(str, row))}"
        for kind, of_rows, nodes in blocks
        for group, row in zip(of_rows, as_rows(nodes + 1), strict=True)
    ]
    lines = [
        "$MeshFormat",
        "2.2 0 8",
        "$EndMeshFormat",
        "$PhysicalNames",
        str(len(groups)),
        *groups,
    ]
    lines += ["$EndPhysicalNames"]
    for section, entries in (("Nodes", places), ("Elements", rows)):
        listed = (f"{number} {row}" for number, row in enumerate(entries, start=1))
        lines += [f"${section}", str(len(entries)), *listed, f"$End{section}"]
    return "\n".join([*lines, ""])
