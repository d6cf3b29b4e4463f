"""Make bent.msh with Gmsh: a bent, tapered vessel of two layers, with named faces and volumes.

    ./with-fenicsx python3 demos/bent_vessel/mesh.py

Copy it and change the numbers, or leave it out: any mesh by Gmsh with these names will do (docs/my_own_vessel.md).
"""

from __future__ import annotations

import sys
from pathlib import Path

import gmsh
import numpy as np

RADII = (1.5, 1.8, 2.1)  # mm, at the inlet: lumen, between the layers, outside
LAYERS = ("media", "adventitia")
LENGTH, BEND, TAPER = (
    12.0,
    60.0,
    0.85,
)  # mm along the middle, degrees, size of the outlet over that of the inlet
AROUND, THROUGH, ALONG = 24, 2, 16  # elements around, in each layer, along


def straight() -> None:
    """A straight tube along z: quarters of rings, extruded."""
    occ = gmsh.model.occ
    quarters = []
    for inner, outer in zip(RADII, RADII[1:], strict=False):
        ring = occ.cut(
            [(2, occ.addDisk(0, 0, 0, outer, outer))], [(2, occ.addDisk(0, 0, 0, inner, inner))]
        )[0]
        boxes = [
            (2, occ.addRectangle(min(0, x * outer), min(0, y * outer), 0, outer, outer))
            for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))
        ]
        quarters += occ.intersect(ring, boxes)[0]
    quarters = occ.fragment(quarters, [])[0]
    occ.extrude(quarters, 0, 0, LENGTH, numElements=[ALONG], recombine=True)
    occ.synchronize()
    for _, curve in gmsh.model.getEntities(1):
        ends = [np.hypot(*place[:2]) for place in _corners(1, curve)]
        if abs(ends[0] - ends[1]) > 1e-6:
            gmsh.model.mesh.setTransfiniteCurve(curve, 1 + THROUGH)
        elif np.ptp([place[2] for place in _corners(1, curve)]) < 1e-6:
            gmsh.model.mesh.setTransfiniteCurve(curve, 1 + AROUND // 4)
    for _, surface in quarters:
        gmsh.model.mesh.setTransfiniteSurface(surface)
        gmsh.model.mesh.setRecombine(2, surface)


def _corners(dimension: int, entity: int) -> list[np.ndarray]:
    points = gmsh.model.getBoundary([(dimension, entity)], recursive=True)
    return [np.array(gmsh.model.getValue(0, point, [])) for _, point in points]


def name_parts() -> None:
    """Faces and volumes by where their corners are."""
    faces: dict[str, list[int]] = {"inner": [], "outer": [], "inlet": [], "outlet": []}
    for _, surface in gmsh.model.getEntities(2):
        corners = np.array(_corners(2, surface))
        radii, heights = np.hypot(corners[:, 0], corners[:, 1]), corners[:, 2]
        places = {"inner": (radii, RADII[0]), "outer": (radii, RADII[-1])}
        places |= {"inlet": (heights, 0.0), "outlet": (heights, LENGTH)}
        for name, (values, at) in places.items():
            if np.allclose(values, at, atol=1e-3):
                faces[name].append(surface)
    for number, (name, surfaces) in enumerate(faces.items(), 1):
        gmsh.model.addPhysicalGroup(2, surfaces, number, name=name)
    volumes: dict[str, list[int]] = {name: [] for name in LAYERS}
    for _, volume in gmsh.model.getEntities(3):
        outside = max(np.hypot(*place[:2]) for place in _corners(3, volume))
        volumes[LAYERS[int(np.argmin(np.abs(np.array(RADII[1:]) - outside)))]].append(volume)
    for number, (name, entities) in enumerate(volumes.items(), 11):
        gmsh.model.addPhysicalGroup(3, entities, number, name=name)


def bend() -> None:
    """Move the nodes: the axis becomes an arc, and sections become smaller along it."""
    numbers, places, _ = gmsh.model.mesh.getNodes()
    angle = np.radians(BEND)
    middle = LENGTH / angle  # radius of the arc
    for number, (x, y, z) in zip(numbers, places.reshape(-1, 3), strict=True):
        size, turn = 1 + (TAPER - 1) * z / LENGTH, angle * z / LENGTH
        across = middle + size * x
        moved = [across * np.cos(turn) - middle, size * y, across * np.sin(turn)]
        gmsh.model.mesh.setNode(number, moved, [])


def main(path: Path) -> None:
    """All of it, to a file of format 4.1."""
    gmsh.initialize(["-v", "2"])
    straight()
    name_parts()
    gmsh.model.mesh.generate(3)
    bend()
    gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
    gmsh.write(str(path))
    gmsh.finalize()


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("bent.msh"))
