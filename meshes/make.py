#!/usr/bin/env python3
"""Make the paper's two meshes, tendon.msh (480 hexahedra) and artery.msh (1,536), again.

    ./with-fenicsx python3 meshes/make.py [FOLDER]

They are Gmsh files (4.1, ASCII) of the same builders that a scene uses, at refinement 1, with the faces and the volume
as physical groups. Without FOLDER they replace the two files beside this script; a test holds these to the builders.
"""

from __future__ import annotations

import sys
from pathlib import Path

from remodel_fenicsx.body.gmsh_model import gmsh_model
from remodel_fenicsx.body.tendon import draw_tendon
from remodel_fenicsx.body.wall import Wall
from remodel_fenicsx.body.tube import draw_tube

WALL = Wall.from_regions(1.0, 3.0, 8, {})

# file -> what is in it, as in the paper: Figs. 6 and 7
MESHES = {
    "tendon.msh": lambda: draw_tendon(10.0, 10.0, 1, "hexahedron", 1),
    "artery.msh": lambda: draw_tube(WALL, 8.0, (16, 12), "hexahedron", 1),
}


def make(folder: Path) -> None:
    """Write both files into `folder`."""
    for name, draw in MESHES.items():
        with gmsh_model(Path(name).stem) as gmsh:
            draw()
            gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
            gmsh.option.setNumber("Mesh.Binary", 0)
            gmsh.write(str(folder / name))


if __name__ == "__main__":
    make(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parent)
