"""Make gel.msh with Gmsh: a strip of gel whose ends lie against two round posts, with named faces.

    ./with-fenicsx python3 demos/gel/mesh.py

Copy it and change the numbers, or leave it out: any mesh by Gmsh with named faces will do (docs/tutorial_gel.md).
"""

from __future__ import annotations

import sys
from pathlib import Path

import gmsh

LENGTH, WIDTH, HEIGHT = 12.0, 5.0, 2.0  # mm, between the middles of the posts, across, and up
POST = 1.2  # mm, radius
SIZE = 1.0  # mm, of an element


def draw() -> int:
    """The strip without the posts: number of its volume."""
    occ = gmsh.model.occ
    strip = occ.addBox(0, -WIDTH / 2, 0, LENGTH, WIDTH, HEIGHT)
    posts = [(3, occ.addCylinder(x, 0, 0, 0, 0, HEIGHT, POST)) for x in (0.0, LENGTH)]
    ((_, volume),) = occ.cut([(3, strip)], posts)[0]
    occ.synchronize()
    return int(volume)


def name_faces() -> None:
    """Round faces lie against the posts; lower and upper face are plane across z, the others are the sides."""
    faces: dict[str, list[int]] = {
        "left_post": [],
        "right_post": [],
        "bottom": [],
        "top": [],
        "sides": [],
    }
    for _, surface in gmsh.model.getEntities(2):
        x, _, z = gmsh.model.occ.getCenterOfMass(2, surface)
        if gmsh.model.getType(2, surface) == "Cylinder":
            faces["left_post" if x < LENGTH / 2 else "right_post"].append(surface)
        else:
            faces[{0.0: "bottom", HEIGHT: "top"}.get(round(z, 6), "sides")].append(surface)
    for name, surfaces in faces.items():
        gmsh.model.addPhysicalGroup(2, surfaces, name=name)


def main(path: Path = Path(__file__).with_name("gel.msh")) -> None:
    """Write the mesh."""
    gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    volume = draw()
    name_faces()
    gmsh.model.addPhysicalGroup(3, [volume], name="gel")
    gmsh.option.setNumber("Mesh.MeshSizeMax", SIZE)
    gmsh.model.mesh.generate(3)
    gmsh.write(str(path))
    gmsh.finalize()
    print(path)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:2]))
