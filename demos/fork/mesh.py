"""Make fork.msh with Gmsh: a vessel that forks into two, of two layers, with named faces and volumes.

    ./with-fenicsx python3 demos/fork/mesh.py

Copy it and change the numbers, or leave it out: any mesh by Gmsh with these names will do (docs/my_own_vessel.md).
"""

from __future__ import annotations

import sys
from pathlib import Path

import gmsh
import numpy as np

TRUNK, BRANCH = (1.6, 2.0, 2.4), (1.2, 1.5, 1.8)  # mm: lumen, between the layers, outside
LAYERS = ("media", "adventitia")
LENGTH, HALF_ANGLE = (
    7.0,
    25.0,
)  # mm of each leg from the fork, degrees between a branch and the trunk's axis
SIZE = 0.85  # mm, of an element

Vector = np.ndarray


def legs() -> list[tuple[str, Vector]]:
    """Name of the face at the end of each leg, and its direction from the fork."""
    angle = np.radians(HALF_ANGLE)
    left, right = (np.array([side * np.sin(angle), 0.0, np.cos(angle)]) for side in (-1, 1))
    return [("inlet", np.array([0.0, 0.0, -1.0])), ("outlet_left", left), ("outlet_right", right)]


def solid(level: int) -> tuple[int, int]:
    """Three cylinders and a ball in their middle, as one body."""
    occ, parts = gmsh.model.occ, []
    for name, direction in legs():
        radius = (TRUNK if name == "inlet" else BRANCH)[level]
        parts.append((3, occ.addCylinder(0, 0, 0, *(LENGTH * direction), radius)))
    parts.append((3, occ.addSphere(0, 0, 0, TRUNK[level])))
    return occ.fuse(parts[:1], parts[1:])[0][0]


def layers() -> dict[str, int]:
    """The wall between the solids: number of the volume of each layer, with one face between the two."""
    occ = gmsh.model.occ
    lumen, media, adventitia = (solid(level) for level in range(3))
    outside = occ.cut([adventitia], [media], removeTool=False)[0]
    inside = occ.cut([media], [lumen])[0]
    occ.fragment(inside, outside)
    occ.synchronize()
    return dict(zip(LAYERS, (inside[0][1], outside[0][1]), strict=True))


def name_parts(volumes: dict[str, int]) -> None:
    """Ends are plane; the other faces of one layer alone are the lumen and the outside."""
    inside, outside = (volumes[name] for name in LAYERS)
    faces: dict[str, list[int]] = {"inner": [], "outer": [], **{name: [] for name, _ in legs()}}
    for _, surface in gmsh.model.getEntities(2):
        beside = set(gmsh.model.getAdjacencies(2, surface)[0])
        if gmsh.model.getType(2, surface) == "Plane":
            centre = np.array(gmsh.model.occ.getCenterOfMass(2, surface))
            faces[max(legs(), key=lambda leg: float(centre @ leg[1]))[0]].append(surface)
        elif beside == {inside}:
            faces["inner"].append(surface)
        elif beside == {outside}:
            faces["outer"].append(surface)
    for number, (name, surfaces) in enumerate(faces.items(), 1):
        gmsh.model.addPhysicalGroup(2, surfaces, number, name=name)
    for number, (name, volume) in enumerate(volumes.items(), 11):
        gmsh.model.addPhysicalGroup(3, [volume], number, name=name)


def main(path: Path) -> None:
    """All of it, to a file of format 4.1."""
    gmsh.initialize()
    gmsh.option.setNumber("General.Verbosity", 2)
    gmsh.option.setNumber("Mesh.MeshSizeMax", SIZE)
    gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
    name_parts(layers())
    gmsh.model.mesh.generate(3)
    gmsh.model.mesh.setOrder(2)
    gmsh.write(str(path))
    gmsh.finalize()


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("fork.msh"))
