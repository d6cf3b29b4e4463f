"""Meshes of one's own, read as data: nothing in a file is ever run. Without Gmsh and dolfinx.

Gmsh itself runs a file that is a script under whatever name, so it never sees one. MSH 2.2 and 4.1 as text:
https://gmsh.info/doc/texinfo/gmsh.html#MSH-file-format. VTU, VTK and XDMF are read by meshio in a child process with
limits. It would read MSH too, but three to eight times slower, and without second groups of a part.
"""

from __future__ import annotations

import functools
import hashlib
import importlib
import json
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.errors import RemodelError
from remodel_fenicsx.system.files import read_regular
from remodel_fenicsx.system.guarded import DAMAGED, LARGEST_FILE, UnreadableFile, read_guarded

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


class ElementType(NamedTuple):
    """A type of element: Gmsh's number of it, its dimension and its nodes."""

    number: int
    dimension: int
    corners: int
    nodes: int


TYPES = {  # by meshio's name
    "vertex": ElementType(15, 0, 1, 1),
    "line": ElementType(1, 1, 2, 2),
    "line3": ElementType(8, 1, 2, 3),
    "line4": ElementType(26, 1, 2, 4),
    "line5": ElementType(27, 1, 2, 5),
    "line6": ElementType(28, 1, 2, 6),
    "triangle": ElementType(2, 2, 3, 3),
    "quad": ElementType(3, 2, 4, 4),
    "triangle6": ElementType(9, 2, 3, 6),
    "quad8": ElementType(16, 2, 4, 8),
    "quad9": ElementType(10, 2, 4, 9),
    "tetra": ElementType(4, 3, 4, 4),
    "hexahedron": ElementType(5, 3, 8, 8),
    "tetra10": ElementType(11, 3, 4, 10),
    "hexahedron27": ElementType(12, 3, 8, 27),
}
BY_NUMBER = {kind.number: kind for kind in TYPES.values()}
# Gmsh's number of a type of element of a body -> what it is
VOLUMES = {4: ("tetrahedron", 1), 5: ("hexahedron", 1), 11: ("tetrahedron", 2), 12: ("hexahedron", 2)}
ALLOWED_ELEMENTS = "tetrahedra of 4 or 10 nodes, hexahedra of 8 or 27"


class MeshFileError(RemodelError, ValueError):
    """What is wrong with a mesh file: one line."""


@dataclass(frozen=True, eq=False)
class MeshFile:
    """What a mesh file holds."""

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

    @property
    def corners(self) -> Integers:
        """Of the elements, (elements, 4 or 8)."""
        return self.cells[:, : 4 if self.kind == "tetrahedron" else 8]


@dataclass(frozen=True)
class Block:
    """Elements of one type: numbers, groups (one row per group), nodes as numbered in the file, in Gmsh's order."""

    type: ElementType
    numbers: Integers
    groups: Integers
    nodes: Integers


def read_mesh(path: Path, tags: str | None = None) -> MeshFile:
    """Read a mesh file."""
    try:
        found = path.stat()
        if path.is_dir():
            raise MeshFileError("is a folder; a mesh is a file")
        return _read(path, tags, found.st_mtime_ns, found.st_size)
    except FileNotFoundError:
        raise MeshFileError(f"no such file: {path}") from None
    except OSError as error:
        raise MeshFileError(f"cannot be read: {error.strerror or error}") from None


@functools.lru_cache(maxsize=1)
def _read(path: Path, tags: str | None, _changed: int, _size: int) -> MeshFile:
    return _read_exchanged(path, tags) if path.suffix.lower() in ENDINGS else _read_gmsh(path)


def as_rows(table: Integers) -> list[tuple[int, ...]]:
    """Rows of a table as tuples."""
    listed: Any = table.tolist()
    return [tuple(row) for row in listed]


def distinct(values: Integers) -> list[int]:
    """Different ones of a list of numbers, in its order."""
    listed: Any = values.tolist()
    return list(dict.fromkeys(listed))


# ---------------------------------------------------------------- formats of other programs, by meshio

ENDINGS = (".vtu", ".vtk", ".xdmf")
SAVED_OTHERWISE = "; save it as VTU with data mode ASCII (ParaView: File, Save Data), or as .msh"
TAGS = ("gmsh:physical", "CellEntityIds", "medit:ref")
"""Arrays of numbers of faces and volumes: as meshio, VMTK and Medit call them."""
# Gmsh's order of nodes, as places in VTK's
# https://gmsh.info/doc/texinfo/gmsh.html#Node-ordering, https://vtk.org/doc/nightly/html (vtkTriQuadraticHexahedron)
ORDERS = {
    "tetra10": (0, 1, 2, 3, 4, 5, 6, 7, 9, 8),
    "hexahedron27": (
        0, 1, 2, 3, 4, 5, 6, 7, 8, 11, 16, 9, 17, 10, 18, 19, 12, 15, 13, 14, 24, 22, 20, 21, 23, 25, 26
    ),
}  # fmt: skip


class ExchangeFile(NamedTuple):
    """What such a file holds: types of the elements by block with their rows of nodes, arrays, and the file itself."""

    points: NDArray[Any]
    cells: list[tuple[str, NDArray[Any]]]
    point_data: dict[str, NDArray[Any]]
    cell_data: dict[str, list[NDArray[Any]]]
    data: bytes


def read_exchange_file(path: Path) -> ExchangeFile:
    """Read one; its ending is one of `ENDINGS`."""
    try:
        arrays, data = read_guarded(path, f"{__name__}:arrays_{path.suffix.lower()[1:]}")
    except UnreadableFile as error:
        raise UnreadableFile(f"{error}{SAVED_OTHERWISE}" if str(error).startswith(DAMAGED) else str(error)) from None
    types, points, cells = json.loads(arrays["names"].tobytes())
    return ExchangeFile(
        arrays["points"],
        [(kind, arrays[f"cells{n}"]) for n, kind in enumerate(types)],
        {name: arrays[f"point_data{n}"] for n, name in enumerate(points)},
        {name: [arrays[f"cell_data{n}_{m}"] for m in range(len(types))] for n, name in enumerate(cells)},
        data,
    )


def _arrays(kind: str, file: str) -> dict[str, Any]:
    mesh = importlib.import_module(f"meshio.{kind}").read(file)
    names = [[block.type for block in mesh.cells], [*mesh.point_data], [*mesh.cell_data]]
    found = {"names": np.frombuffer(json.dumps(names).encode(), np.uint8), "points": mesh.points}
    found |= {f"cells{n}": block.data for n, block in enumerate(mesh.cells)}
    found |= {f"point_data{n}": values for n, values in enumerate(mesh.point_data.values())}
    blocks = enumerate(mesh.cell_data.values())
    return found | {f"cell_data{n}_{m}": values for n, listed in blocks for m, values in enumerate(listed)}


# what the child calls, without the modules of other formats
arrays_vtu, arrays_vtk, arrays_xdmf = (functools.partial(_arrays, ending[1:]) for ending in ENDINGS)


def _read_exchanged(path: Path, tags: str | None) -> MeshFile:
    try:
        mesh = read_exchange_file(path)
    except UnreadableFile as error:
        raise MeshFileError(str(error)) from None
    points = np.asarray(mesh.points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise MeshFileError(f"its nodes have {points.shape[-1]} coordinates; needed are three")
    blocks, number = [], 1
    for (kind, rows), groups in zip(mesh.cells, _tags(mesh.cell_data, tags), strict=True):
        if kind not in TYPES:
            raise MeshFileError(f"elements of type {kind!r}; allowed are {ALLOWED_ELEMENTS}")
        nodes, numbers = np.asarray(rows, dtype=np.int64), np.arange(number, number + len(rows))
        number += len(rows)
        blocks.append(Block(TYPES[kind], numbers, groups, nodes[:, ORDERS[kind]] if kind in ORDERS else nodes))
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


# ---------------------------------------------------------------- Gmsh's own format

FORMATS = (b"2.2", b"4.1")
READ = (b"MeshFormat", b"PhysicalNames", b"Entities", b"Nodes", b"Elements")
IGNORED = tuple(b"Comments Periodic NodeData ElementData ElementNodeData InterpolationScheme Parametrizations".split())
_HEAD = re.compile(rb"\s*\$(\w+)[ \t\r]*\n")
_GROUP_NAME = re.compile(r'([0-3])\s+(\d{1,9})\s+"([^"\x00-\x1f]{0,127})"')
_NO_NUMBER = re.compile(rb"\S*[^-+.\deE\s]\S*")


def _read_gmsh(path: Path) -> MeshFile:
    data = read_regular(path, LARGEST_FILE)
    if not data.startswith(b"$MeshFormat"):
        raise MeshFileError("not a mesh by Gmsh: it must begin with $MeshFormat")
    sections = _sections(data)
    version, binary, *_ = [*sections[b"MeshFormat"].split(), b"", b""]
    if version not in FORMATS or binary != b"0":
        rule = "allowed are 2.2 and 4.1 as text (in Gmsh: Mesh.Binary = 0)"
        raise MeshFileError(f"format {_shown(sections[b'MeshFormat'])}; {rule}")
    for needed in (b"Nodes", b"Elements"):
        if needed not in sections:
            raise MeshFileError(f"the file ends without ${needed.decode()}")
    numbers, points, blocks = (_read_22 if version == b"2.2" else _read_41)(sections)
    return assembled(numbers.astype(np.int64), points, blocks, _physical_names(sections), data)


def _sections(data: bytes) -> dict[bytes, bytes]:
    """The text of each section by name: each is closed, nothing stands between them, those that are read come once."""
    found: dict[bytes, bytes] = {}
    at = 0
    while head := _HEAD.match(data, at):
        name, end = head[1], data.find(b"$End" + head[1], head.end())
        if name not in (*READ, *IGNORED):
            known = ", ".join(f"${section.decode()}" for section in (*READ, *IGNORED))
            raise MeshFileError(f"unknown section {_shown(b'$' + name)}; known are {known}")
        if end < 0:
            raise MeshFileError(f"the file ends within ${name.decode()}")
        if name in READ and name in found:
            raise MeshFileError(f"a second ${name.decode()}")
        found[name] = data[head.end() : end]
        at = end + len(b"$End" + name)
    if rest := data[at : at + 1000].strip():
        raise MeshFileError(f"{_shown(rest)} between two sections")
    return found


def _shown(text: bytes) -> str:
    return repr(b" ".join(text[:1000].split())[:40].decode("ascii", "replace"))


def _physical_names(sections: dict[bytes, bytes]) -> dict[int, dict[str, int]]:
    """Numbers by name of the faces (2) and the volumes (3)."""
    names: dict[int, dict[str, int]] = {2: {}, 3: {}}
    lines = sections.get(b"PhysicalNames", b"0").decode("utf-8", "replace").split("\n")
    number, *named = [line.strip() for line in lines if line.strip()] or [""]
    if number != str(len(named)):
        raise MeshFileError(f"$PhysicalNames announces {number[:20]!r} groups and has {len(named)}")
    for line in named:
        found = _GROUP_NAME.fullmatch(line)
        if found is None or found[3] in names.get(int(found[1]), ()):
            raise MeshFileError(f"$PhysicalNames: {line[:40]!r} where dimension, number and a new name should be")
        names.setdefault(int(found[1]), {})[found[3]] = int(found[2])
    return {dimension: names[dimension] for dimension in (2, 3)}


class _Numbers:
    """The numbers of a section, taken row by row."""

    def __init__(self, name: bytes, sections: dict[bytes, bytes], kind: Any = np.float64):
        self.name, self.at = name.decode(), 0
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # NumPy reads up to what is no number, and warns
            try:
                self.values = np.fromstring(sections[name], dtype=kind, sep=" ")
            except (ValueError, DeprecationWarning):
                odd = _NO_NUMBER.search(sections[name])
                raise MeshFileError(f"${self.name} has {_shown(odd[0] if odd else b'.')} among its numbers") from None

    def take(self, rows: int, columns: int) -> Any:
        """The next rows, (rows, columns)."""
        left = len(self.values) - self.at
        if not 0 <= rows * columns <= left:
            raise MeshFileError(f"${self.name} announces {rows * columns} more numbers, but has {left}")
        start, self.at = self.at, self.at + rows * columns
        return self.values[start : self.at].reshape(rows, columns)

    def row(self, columns: int) -> list[int]:
        """The next row, of whole numbers."""
        return self.take(1, columns)[0].astype(np.int64).tolist()

    def end(self) -> None:
        """Nothing may follow."""
        if left := len(self.values) - self.at:
            raise MeshFileError(f"${self.name} has {left} numbers more than it announces")


def _read_22(sections: dict[bytes, bytes]) -> tuple[Array, Array, list[Block]]:
    nodes, elements = _Numbers(b"Nodes", sections), _Numbers(b"Elements", sections, np.int64)
    table = nodes.take(nodes.row(1)[0], 4)
    nodes.end()
    values: Any = elements.values.tolist()
    starts: dict[tuple[int, int], list[int]] = {}
    (count,), at = elements.row(1), 1
    elements.take(count, 4)  # at least
    try:
        for _ in range(count):
            kind, tags = values[at + 1], values[at + 2]
            starts.setdefault((kind, tags), []).append(at)
            at += _width(kind, tags)
    except IndexError:
        at = len(values) + 1
    elements.at = 1
    elements.take(1, at - 1)
    elements.end()
    blocks = []
    for (kind, tags), first in starts.items():
        rows = elements.values[np.array(first)[:, None] + np.arange(_width(kind, tags))]
        groups = rows[:, 3] if tags else np.zeros(len(rows), dtype=np.int64)
        blocks.append(Block(_type(kind), rows[:, 0], groups, rows[:, 3 + tags :]))
    return table[:, 0], table[:, 1:], blocks


def _width(kind: int, tags: int) -> int:
    """Numbers of an element: its own, its type, how many tags it has, these and its nodes."""
    if tags < 0:
        raise MeshFileError(f"$Elements has an element with {tags} tags")
    return 3 + tags + _type(kind).nodes


def _read_41(sections: dict[bytes, bytes]) -> tuple[Array, Array, list[Block]]:
    groups_of = _entities(sections)
    nodes, elements = _Numbers(b"Nodes", sections), _Numbers(b"Elements", sections, np.int64)
    numbers, points, blocks = [np.empty((0, 1))], [np.empty((0, 3))], []
    for _ in range(nodes.row(4)[0]):
        dimension, _, is_parametric, count = nodes.row(4)
        numbers.append(nodes.take(count, 1))
        points.append(nodes.take(count, 3 + (dimension if is_parametric else 0))[:, :3])
    nodes.end()
    for _ in range(elements.row(4)[0]):
        dimension, entity, kind, count = elements.row(4)
        rows = elements.take(count, 1 + _type(kind).nodes)
        for group in groups_of.get((dimension, entity)) or [0]:
            blocks.append(Block(_type(kind), rows[:, 0], np.full(count, group), rows[:, 1:]))
    elements.end()
    return np.concatenate(numbers)[:, 0], np.concatenate(points), blocks


def _entities(sections: dict[bytes, bytes]) -> dict[tuple[int, int], list[int]]:
    """Numbers of the groups of points, curves, faces and volumes, by dimension and number."""
    found: dict[tuple[int, int], list[int]] = {}
    if b"Entities" not in sections:
        return found
    entities = _Numbers(b"Entities", sections)
    for dimension, count in enumerate(entities.row(4)):
        for _ in range(count):
            entity = entities.row(7 if dimension else 4)[0]  # with the box around it
            found[dimension, entity] = [abs(group) for group in entities.row(entities.row(1)[0])]
            entities.row(entities.row(1)[0] if dimension else 0)  # what bounds it
    entities.end()
    return found


def _type(kind: int) -> ElementType:
    if kind not in BY_NUMBER:
        raise MeshFileError(f"elements of Gmsh's type {kind}; allowed are {ALLOWED_ELEMENTS}")
    return BY_NUMBER[kind]


# ---------------------------------------------------------------- what all lead to


def assembled(
    numbers: Integers, points: Array, blocks: list[Block], names: dict[int, dict[str, int]], data: bytes
) -> MeshFile:
    """What a file of any kind holds."""
    order = np.argsort(numbers, kind="stable")
    ordered = numbers[order]
    if len(twice := ordered[1:][np.diff(ordered) == 0]):
        raise MeshFileError(f"node {twice[0]} is there twice")
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        raise MeshFileError(f"node {numbers[bad][0]} is at {tuple(points[bad][0].tolist())}: its place must be finite")

    def rows_of(block: Block, columns: int | None = None) -> Integers:
        nodes = block.nodes[:, :columns]
        place = np.searchsorted(ordered, nodes).clip(max=max(len(ordered) - 1, 0))
        lost = ordered[place] != nodes if len(ordered) else np.ones_like(nodes, dtype=bool)
        if lost.any():
            row, column = np.argwhere(lost)[0]
            rule = f"element {block.numbers[row]} has the node {nodes[row, column]}, which is not in $Nodes"
            raise MeshFileError(rule)
        return order[place]

    solid = [block for block in blocks if block.type.dimension == 3 and len(block.numbers)]
    kinds = sorted({block.type.number for block in solid})
    if not kinds:
        raise MeshFileError("no elements of a volume; in Gmsh: a physical volume, and Mesh 3D")
    if len(kinds) > 1:
        listed = " and ".join(f"{VOLUMES[kind][0]} of degree {VOLUMES[kind][1]}" for kind in kinds)
        raise MeshFileError(f"elements of several types: {listed}; allowed is one")
    kind, degree = VOLUMES[kinds[0]]
    corners = 3 if kind == "tetrahedron" else 4
    flat = [block for block in blocks if block.type.dimension == 2 and block.type.corners == corners]
    facets = [np.empty((0, corners), dtype=np.int64), *(rows_of(block, corners) for block in flat)]
    cells = np.concatenate([rows_of(block) for block in solid])
    used, rows = np.unique(cells, return_inverse=True)  # Gmsh also writes nodes that no element of the body has
    row_of = np.full(len(points), -1, dtype=np.int64)
    row_of[used] = np.arange(len(used))
    return MeshFile(
        points[used],
        rows.reshape(cells.shape),
        np.concatenate([block.numbers for block in solid]),
        np.concatenate([block.groups for block in solid]),
        row_of[np.concatenate(facets)],
        np.concatenate([np.empty(0, dtype=np.int64), *(block.groups for block in flat)]),
        kind,
        degree,
        names,
        data,
        hashlib.sha256(data).hexdigest(),
    )
