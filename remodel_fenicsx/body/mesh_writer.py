"""A mesh as the text of a Gmsh file, format 2.2: what `mesh_file` reads."""

from __future__ import annotations

from typing import Any

from remodel_fenicsx.body.mesh_file import VOLUMES, MeshFile

TYPE_OF = {kind: number for number, kind in VOLUMES.items()}
FACET_OF = {3: 2, 4: 3}  # corners -> Gmsh's number of the type; facets are written by their corners


def gmsh_text(file: MeshFile) -> str:
    """Nodes, elements and named groups of a mesh; nodes have the numbers 1, 2, ... in their order."""
    lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat", "$PhysicalNames"]
    names = [(dimension, number, name) for dimension, by in file.names.items() for name, number in by.items()]
    lines += [str(len(names)), *(f'{dimension} {number} "{name}"' for dimension, number, name in names)]
    lines += ["$EndPhysicalNames", "$Nodes", str(len(file.points))]
    places: Any = file.points.tolist()
    lines += [f"{row} {x:.17g} {y:.17g} {z:.17g}" for row, (x, y, z) in enumerate(places, start=1)]
    facets, solid = FACET_OF[file.facets.shape[1]], TYPE_OF[file.kind, file.degree]
    lines += ["$EndNodes", "$Elements", str(len(file.facets) + len(file.cells))]
    number = 0
    for kind, groups, rows in ((facets, file.facet_groups, file.facets), (solid, file.cell_groups, file.cells)):
        listed: Any = (rows + 1).tolist()
        for group, row in zip(groups, listed, strict=True):
            number += 1
            lines.append(f"{number} {kind} 2 {group} {group} {' '.join(str(node) for node in row)}")
    return "\n".join([*lines, "$EndElements", ""])
