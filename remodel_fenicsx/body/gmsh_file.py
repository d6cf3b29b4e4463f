"""Meshes of Gmsh's current model, and of files in its own format, which it reads in a child process with limits."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import Any

import gmsh  # here, for a child that has begun to read imports no library any more
import numpy as np

from remodel_fenicsx.body.gmsh_model import gmsh_model
from remodel_fenicsx.body.mesh_file import GMSH_KINDS, TAGS, Block, as_arrays
from remodel_fenicsx.errors import UnreadableFile
from remodel_fenicsx.model.tensors import Array

_FORMAT = re.compile(rb"\$MeshFormat\s+(2\.2|4\.1) 0 \d+\s+\$EndMeshFormat")
_SECTION = re.compile(rb"^\$(\w+)\s*?\n(.*?)^\$End\1\b", re.DOTALL | re.MULTILINE)
_TAGS = re.compile(rb"(?m)^[ \t]*\d+([ \t]+\d+[ \t]+\d+[ \t]+(\d+)[ \t]+)\d+(?=[ \t])")


def arrays_msh(file: str) -> dict[str, Any]:
    """Those of a file by Gmsh, where elements of several groups are there several times."""
    data = Path(file).read_bytes()
    version = _FORMAT.match(data)
    if version is None:  # Gmsh would run a script
        raise UnreadableFile("is no mesh by Gmsh in format 2.2 or 4.1 as text (in Gmsh: Mesh.Binary = 0)")
    if rest := _SECTION.sub(b"", data).split():
        words = b" ".join(rest[:9])[:40].decode("ascii", "replace")
        raise UnreadableFile(f"has {words!r} outside of its sections: is it cut off?")
    is_old, number, sections = version[1] == b"2.2", itertools.count(1), dict(_SECTION.findall(data))
    # lines of a section for each number at its head: Gmsh passes over what is not announced
    for name, lines in {"Nodes": (1, 2), "Elements": (1, 1), "Entities": (1, 1, 1, 1)}.items():
        head, *rows = sections.get(name.encode(), b"0").strip().splitlines()
        if len(rows) != sum(count * int(number) for count, number in zip(lines, head.split(), strict=False)):
            raise UnreadableFile(f"has other {name.lower()} than ${name} announces")
    if is_old:  # its elements have groups of their own, not by the parts of the body, and an order
        data = _TAGS.sub(lambda found: b"%d%b%b" % (next(number), found[1], found[2]), data)
        Path(file).write_bytes(data)  # in this process' memory
    with gmsh_model("file"):
        gmsh.merge(file)
        groups = gmsh.model.getPhysicalGroups()
        names = [(*group, name) for group in groups if (name := gmsh.model.getPhysicalName(*group))]
        points, blocks = of_gmsh(is_old)
    return as_arrays(
        points, [(kind, rows) for kind, _, rows in blocks], {}, {TAGS[0]: [b.groups for b in blocks]}, names
    )


def of_gmsh(by_number: bool = False) -> tuple[Array, list[Block]]:
    """Nodes of Gmsh's current model by their numbers, and its elements, those of several groups several times."""
    model, found = gmsh.model, dict[str, list[Any]]()
    tags, places, _ = model.mesh.getNodes()
    order = np.argsort(tags)
    for dimension, entity in model.getEntities():
        if model.getType(dimension, entity).startswith("Ghost"):  # of other parts of the mesh
            continue
        groups: list[int] = [*model.getPhysicalGroupsForEntity(dimension, entity)]
        for kind, numbers, nodes in zip(*model.mesh.getElements(dimension, entity), strict=True):
            name = GMSH_KINDS.get(kind) or model.mesh.getElementProperties(kind)[0]
            rows = np.searchsorted(tags, nodes, sorter=order).reshape(len(numbers), -1)
            found.setdefault(name, []).extend((numbers, np.full(len(rows), group), rows) for group in groups or [0])
    blocks = []
    for name, parts in found.items():
        numbers, of_groups, rows = map(np.concatenate, zip(*parts, strict=True))
        chosen = np.argsort(numbers) if by_number else slice(None)
        blocks.append(Block(name, of_groups[chosen], rows[chosen]))
    return np.reshape(places, (-1, 3))[order], blocks
