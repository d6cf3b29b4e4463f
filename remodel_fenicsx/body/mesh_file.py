"""Meshes of one's own: a Gmsh file read line by line, as data. Nothing in it is ever run; without Gmsh and dolfinx.

Gmsh itself runs a file that is a script under whatever name, so it never sees one. MSH 2.2 and 4.1 as text:
https://gmsh.info/doc/texinfo/gmsh.html#MSH-file-format
"""

from __future__ import annotations

import functools
import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.errors import RemodelError
from remodel_fenicsx.system.files import read_regular
from remodel_fenicsx.system.guarded import DAMAGED, LARGEST_FILE, UnreadableFile, read_guarded


# ---------------------------------------------------------------- meshes with arrays in formats of other programs
# Meshes with arrays in formats of other programs: VTU, VTK, XDMF, by meshio in a child process with limits.

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
    """Read one; its ending is one of `ENDINGS`."""
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


# ---------------------------------------------------------------- a mesh of one's own from a file of any kind that
# A mesh of one's own from a file of any kind that is known: by Gmsh, or in a format of other programs.

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
    """Read a mesh file."""
    if path.suffix.lower() not in ENDINGS:
        return read_mesh_file(path)
    changed, size = found_file(path)
    try:
        return _read_exchanged(path, tags, changed, size)
    except OSError as error:
        raise MeshFileError(f"cannot be read: {error.strerror or error}") from None


@functools.lru_cache(maxsize=1)
def _read_exchanged(path: Path, tags: str | None, _changed: int, _size: int) -> MeshFile:
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


Array = NDArray[np.float64]
Integers = NDArray[np.int64]

VERSIONS = (b"2.2", b"4.1")
# Gmsh's number of a type of element -> what it is
VOLUMES = {4: ("tetrahedron", 1), 5: ("hexahedron", 1), 11: ("tetrahedron", 2), 12: ("hexahedron", 2)}
NODES = {("tetrahedron", 1): 4, ("hexahedron", 1): 8, ("tetrahedron", 2): 10, ("hexahedron", 2): 27}
CORNERS_OF_FACET = {2: 3, 3: 4, 9: 3, 10: 4, 16: 4}
OF_LINES_AND_POINTS = (1, 8, 15, 26, 27, 28)
IGNORED = (
    b"Comments",
    b"Periodic",
    b"NodeData",
    b"ElementData",
    b"ElementNodeData",
    b"InterpolationScheme",
    b"Parametrizations",
)
READ = (b"MeshFormat", b"PhysicalNames", b"Entities", b"Nodes", b"Elements")
ALLOWED_ELEMENTS = "tetrahedra of 4 or 10 nodes, hexahedra of 8 or 27"


def as_rows(table: Integers) -> list[tuple[int, ...]]:
    """Rows of a table as tuples."""
    listed: Any = table.tolist()
    return [tuple(row) for row in listed]


def distinct(values: Integers) -> list[int]:
    """Different ones of a list of numbers, in its order."""
    listed: Any = values.tolist()
    return list(dict.fromkeys(listed))


class MeshFileError(RemodelError, ValueError):
    """What is wrong with a mesh file: one line, with its line in the file where there is one."""


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
        return self.cells[:, : NODES[self.kind, 1]]


def read_mesh_file(path: Path) -> MeshFile:
    """Read a Gmsh file of format 2.2 or 4.1, text."""
    changed, size = found_file(path)
    try:
        return _read(path, changed, size)
    except OSError as error:
        raise MeshFileError(f"cannot be read: {error.strerror or error}") from None


def found_file(path: Path) -> tuple[int, int]:
    """When it changed last, in ns, and its size in bytes."""
    try:
        if path.is_dir():
            raise MeshFileError("is a folder; a mesh is a file")
        found = path.stat()
        return found.st_mtime_ns, found.st_size
    except FileNotFoundError:
        raise MeshFileError(f"no such file: {path}") from None
    except OSError as error:
        raise MeshFileError(f"cannot be read: {error.strerror or error}") from None


@functools.lru_cache(maxsize=1)
def _read(path: Path, _changed: int, _size: int) -> MeshFile:
    data = read_regular(path, LARGEST_FILE)
    sections = _sections(data)
    groups = _physical_names(sections.get(b"PhysicalNames"))
    numbers, points, elements = (_read_22 if sections[b"MeshFormat"].version == b"2.2" else _read_41)(sections)
    return assembled(numbers, points, elements, groups, data)


# ---------------------------------------------------------------- lines


class _Section:
    """The lines between $Name and $EndName."""

    def __init__(self, name: bytes, first: int, lines: Sequence[bytes]):
        self.name, self.first, self.lines, self.at = name.decode(), first, lines, 0
        self.version = b""

    def fault(self, rule: str, back: int = 1) -> MeshFileError:
        """About the line that was read last, or the one that is missing (0)."""
        return MeshFileError(f"line {self.first + self.at - back + 1}: {rule}")

    def numbers(self, least: int, words: str) -> list[int]:
        """The whole numbers at the start of the next line, as many as `least`; what follows may be anything."""
        fields = self.fields(least, words)
        try:
            return [int(field) for field in fields[:least]]
        except ValueError:
            raise self.fault(f"{_shown(fields)} where {words} should be") from None

    def fields(self, least: int, words: str) -> list[bytes]:
        """The next line, of `least` fields or more."""
        if self.at >= len(self.lines):
            raise self.fault(f"${self.name} ends where {words} should be", back=0)
        fields = self.lines[self.at].split()
        self.at += 1
        if len(fields) < least:
            raise self.fault(f"{_shown(fields)} where {words} should be")
        return fields

    def count(self, fields: int, column: int, words: str) -> int:
        """A number of lines that follow, no more than there are."""
        number = self.numbers(fields, words)[column]
        if not 0 <= number <= len(self.lines) - self.at:
            left = len(self.lines) - self.at
            raise self.fault(f"{number} of {words}, but ${self.name} has {left} more line{'' if left == 1 else 's'}")
        return number

    def table(self, rows: int, kind: Any, columns: int, words: str) -> NDArray[Any]:
        """The next lines as numbers, (rows, columns or more)."""
        if rows == 0:
            return np.empty((0, columns), dtype=kind)
        if rows > len(self.lines) - self.at:
            self.at = len(self.lines)
            raise self.fault(f"${self.name} ends within {words}", back=0)
        try:
            lines = [line.decode("ascii") for line in self.lines[self.at : self.at + rows]]
            table: NDArray[Any] = np.loadtxt(lines, dtype=kind, comments=None, ndmin=2)
            good = len(table) == rows and table.shape[1] >= columns
        except (ValueError, OverflowError, UnicodeDecodeError):
            good = False
        if not good:
            raise self._first_bad(rows, kind, columns, words)
        self.at += rows
        return table

    def _first_bad(self, rows: int, kind: Any, columns: int, words: str) -> MeshFileError:
        width = None
        for _ in range(rows):
            fields = self.fields(0, words)
            try:
                np.array([field.decode("ascii") for field in fields]).astype(kind)
                good = len(fields) >= columns and (width is None or len(fields) == width)
            except (ValueError, OverflowError):
                good = False
            if not good:
                break
            width = len(fields)
        return self.fault(f"{_shown(self.lines[self.at - 1].split())} where {words} should be")

    def end(self) -> None:
        """Nothing may follow."""
        if any(line.strip() for line in self.lines[self.at :]):
            self.at += 1
            raise self.fault(f"more lines in ${self.name} than it announces")


def _shown(fields: Sequence[bytes]) -> str:
    text = b" ".join(fields)[:40].decode("ascii", "replace")
    return repr(text) if text else "nothing"


def _sections(data: bytes) -> dict[bytes, _Section]:
    """The file's sections by name: each closed, none twice, nothing between or behind them."""
    if not data.startswith(b"$MeshFormat"):
        raise MeshFileError("line 1: not a mesh by Gmsh: it must begin with $MeshFormat")
    lines = data.splitlines()
    if len(lines) < 3:
        raise MeshFileError("line 2: the file ends within $MeshFormat")
    version = lines[1].split()
    if len(version) != 3 or version[0] not in VERSIONS:
        written = f"format {version[0].decode('ascii', 'replace')[:20]}" if version else "no number of a format"
        raise MeshFileError(f"line 2: {written}; allowed are 2.2 and 4.1")
    if version[1] != b"0":
        raise MeshFileError("line 2: a binary file; allowed is text (in Gmsh: Mesh.Binary = 0)")
    found: dict[bytes, _Section] = {}
    at = 0
    heads = [number for number, line in enumerate(lines) if line.startswith(b"$")] + [len(lines)]
    for head, tail in zip(heads[::2], [*heads[1::2], len(lines)], strict=False):
        for number in range(at, head):
            if lines[number].strip():
                raise MeshFileError(f"line {number + 1}: {_shown(lines[number].split())} between two sections")
        if head == len(lines):
            break
        name = lines[head].strip()[1:]
        if name not in (*READ, *IGNORED):
            known = ", ".join(f"${section.decode()}" for section in (*READ, *IGNORED))
            raise MeshFileError(f"line {head + 1}: unknown section {_shown([b'$' + name])}; known are {known}")
        if tail == len(lines):
            raise MeshFileError(f"line {len(lines)}: the file ends within ${name.decode()}")
        if lines[tail].strip() != b"$End" + name:
            raise MeshFileError(f"line {tail + 1}: {_shown(lines[tail].split())} within ${name.decode()}")
        if name in READ and name in found:
            raise MeshFileError(f"line {head + 1}: a second ${name.decode()}")
        found[name] = _Section(name, head + 1, lines[head + 1 : tail])
        at = tail + 1
    for needed in (b"Nodes", b"Elements"):
        if needed not in found:
            raise MeshFileError(f"line {len(lines)}: the file ends without ${needed.decode()}")
    found[b"MeshFormat"].version = version[0]
    return found


def _physical_names(section: _Section | None) -> dict[int, dict[str, int]]:
    """Numbers by name of the faces (2) and the volumes (3)."""
    names: dict[int, dict[str, int]] = {2: {}, 3: {}}
    if section is None:
        return names
    for _ in range(section.count(1, 0, "named groups")):
        line = b" ".join(section.fields(3, "dimension, number and name of a group")).decode("utf-8", "replace")
        found = re.fullmatch(r'([0-3]) (\d{1,9}) "([^"\x00-\x1f]{0,127})"', line)
        if found is None:
            raise section.fault(f"{line[:40]!r} where dimension, number and name of a group should be")
        dimension, number, name = int(found[1]), int(found[2]), found[3]
        if dimension in names:
            if name in names[dimension]:
                raise section.fault(f"a second group {name!r}")
            names[dimension][name] = number
    section.end()
    return names


# ---------------------------------------------------------------- the two formats


@dataclass(frozen=True)
class Block:
    """Elements of one type: lines (0: none), numbers, groups (one row per group), nodes as numbered in the file."""

    type: int
    dimension: int
    lines: Integers
    numbers: Integers
    groups: Integers
    nodes: Integers


def _read_41(sections: dict[bytes, _Section]) -> tuple[Integers, Array, list[Block]]:
    groups_of = _entities(sections.get(b"Entities"))
    nodes = sections[b"Nodes"]
    numbers, points = [], []
    for _ in range(nodes.count(4, 0, "blocks of nodes")):
        count = nodes.count(4, 3, "nodes")
        numbers.append(nodes.table(count, np.int64, 1, "the number of a node")[:, 0])
        points.append(nodes.table(count, np.float64, 3, "the place of a node")[:, :3])
    nodes.end()
    elements, blocks = sections[b"Elements"], []
    for _ in range(elements.count(4, 0, "blocks of elements")):
        dimension, entity, kind = elements.numbers(4, "dimension, entity, type and number of elements")[:3]
        elements.at -= 1
        count = elements.count(4, 3, "elements")
        if dimension in (2, 3):
            columns = 1 + _nodes_of(kind, elements)
            first = elements.first + elements.at
            rows = elements.table(count, np.int64, columns, f"an element of {columns - 1} nodes")
            groups = groups_of.get((dimension, entity), [])
            for group in groups or [0]:
                parts = np.arange(first, first + count) + 1, rows[:, 0], np.full(count, group), rows[:, 1:columns]
                blocks.append(Block(kind, dimension, *parts))
        else:
            elements.at += count
    elements.end()
    return np.concatenate([np.empty(0, dtype=np.int64), *numbers]), np.concatenate([np.empty((0, 3)), *points]), blocks


def _entities(section: _Section | None) -> dict[tuple[int, int], list[int]]:
    """Numbers of the groups of faces and volumes by dimension and number."""
    found: dict[tuple[int, int], list[int]] = {}
    if section is None:
        return found
    counts = section.numbers(4, "numbers of points, curves, surfaces and volumes")
    for dimension, count in enumerate(counts):
        box = 4 if dimension == 0 else 7
        for _ in range(count):
            fields = section.fields(box + 1, "an entity")
            try:
                many = int(fields[box])
                groups = [abs(int(field)) for field in fields[box + 1 : box + 1 + many]]
                found[dimension, int(fields[0])] = groups
                good = many == len(groups)
            except ValueError:
                good = False
            if not good:
                raise section.fault(f"{_shown(fields)} where an entity should be")
    section.end()
    return found


def _read_22(sections: dict[bytes, _Section]) -> tuple[Integers, Array, list[Block]]:
    nodes, elements = sections[b"Nodes"], sections[b"Elements"]
    table = nodes.table(nodes.count(1, 0, "nodes"), np.float64, 4, "number and place of a node")
    nodes.end()
    rows: dict[int, list[list[int]]] = {}
    for _ in range(elements.count(1, 0, "elements")):
        number, kind, tags = elements.numbers(3, "number, type and number of tags of an element")
        elements.at -= 1
        if kind not in OF_LINES_AND_POINTS:
            columns = 3 + tags + _nodes_of(kind, elements, 1)
            words = f"an element with {tags} tags and {columns - 3 - tags} nodes"
            row = elements.numbers(columns, words) if 0 < tags < 1000 else [0]
            if len(row) != columns:
                raise elements.fault(f"{tags} tags of an element")
            rows.setdefault(kind, []).append([elements.first + elements.at, number, row[3], *row[3 + tags :]])
        else:
            elements.at += 1
    elements.end()
    tables = {kind: np.array(found, dtype=np.int64) for kind, found in rows.items()}
    blocks = [
        Block(kind, 3 if kind in VOLUMES else 2, found[:, 0], found[:, 1], found[:, 2], found[:, 3:])
        for kind, found in tables.items()
    ]
    return table[:, 0].astype(np.int64), table[:, 1:4], blocks


def _nodes_of(kind: int, section: _Section, ahead: int = 0) -> int:
    """Nodes of an element of this type."""
    if kind in CORNERS_OF_FACET:
        return {2: 3, 3: 4, 9: 6, 10: 9, 16: 8}[kind]
    if kind not in VOLUMES:
        rule = f"elements of Gmsh's type {kind}; allowed are {ALLOWED_ELEMENTS}"
        raise section.fault(rule, back=1 - ahead)
    return NODES[VOLUMES[kind]]


# ---------------------------------------------------------------- what both lead to


def assembled(
    numbers: Integers, points: Array, blocks: list[Block], names: dict[int, dict[str, int]], data: bytes
) -> MeshFile:
    """What a file of any kind holds."""
    order = np.argsort(numbers, kind="stable")
    ordered = numbers[order]
    if len(ordered) > 1 and (np.diff(ordered) == 0).any():
        raise MeshFileError(f"node {ordered[:-1][np.diff(ordered) == 0][0]} is there twice")
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
            line = f"line {block.lines[row]}: " if block.lines[row] else ""
            raise MeshFileError(line + rule)
        return order[place]

    solid = [block for block in blocks if block.dimension == 3 and len(block.numbers)]
    kinds = sorted({block.type for block in solid})
    if not kinds:
        raise MeshFileError("no elements of a volume; in Gmsh: a physical volume, and Mesh 3D")
    if len(kinds) > 1:
        listed = " and ".join(f"{VOLUMES[kind][0]} of degree {VOLUMES[kind][1]}" for kind in kinds)
        raise MeshFileError(f"elements of several types: {listed}; allowed is one")
    kind, degree = VOLUMES[kinds[0]]
    corners = 3 if kind == "tetrahedron" else 4
    flat = [block for block in blocks if block.dimension == 2 and CORNERS_OF_FACET[block.type] == corners]
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
