"""Make the mesh of a vessel's wall from the surface of its lumen with Gmsh: named faces, tetrahedra of degree 2.

    ./with-fenicsx python3 demos/own_vessel/mesh.py lumen.stl vessel.msh --thickness 0.6 --size 0.8

The surface is an STL file, open at its ends. The wall has the same thickness everywhere.
docs/my_own_vessel.md goes through it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import gmsh
import numpy as np

SHARP = 60.0  # degrees between two triangles, from which on there is an edge


def wall(surface: str, thickness: float, size: float, through: int) -> tuple[list[int], list[int], list[int]]:
    """The wall outside of the surface: its inner faces, its outer faces, its volumes."""
    gmsh.merge(surface)
    outwards = 1 if _is_turned_outwards() else -1
    gmsh.model.mesh.classifySurfaces(np.radians(SHARP), True, True, np.pi)
    gmsh.model.mesh.createGeometry()
    inner = gmsh.model.getEntities(2)
    gmsh.option.setNumber("Mesh.MeshSizeMin", size)
    gmsh.option.setNumber("Mesh.MeshSizeMax", size)
    gmsh.option.setNumber("Geometry.ExtrudeReturnLateralEntities", 0)
    made = gmsh.model.geo.extrudeBoundaryLayer(inner, [through], [outwards * thickness], False)
    gmsh.model.geo.synchronize()
    outer, volumes = ([entity for dimension, entity in made if dimension == which] for which in (2, 3))
    return [entity for _, entity in inner], outer, volumes


def _is_turned_outwards() -> bool:
    """Whether the normals of the surface's triangles point away from its middle, in the mean."""
    numbers, places, _ = gmsh.model.mesh.getNodes()
    points = dict(zip(numbers, places.reshape(-1, 3), strict=True))
    corners = np.array([points[n] for n in gmsh.model.mesh.getElementsByType(2)[1]]).reshape(-1, 3, 3)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    centres = corners.mean(axis=1)
    middle = np.average(centres, axis=0, weights=np.linalg.norm(normals, axis=1))
    return bool(((centres - middle) * normals).sum() > 0)


def ends(known: list[int]) -> list[list[int]]:
    """The other faces of one volume alone, by the opening that they are around; the first is nearest to the origin."""
    found: list[tuple[np.ndarray, list[int]]] = []
    for _, face in gmsh.model.getEntities(2):
        if face in known or len(gmsh.model.getAdjacencies(2, face)[0]) != 1:
            continue
        _, places, _ = gmsh.model.mesh.getNodes(2, face, includeBoundary=True)
        places = places.reshape(-1, 3)
        near = [entry for entry in found if np.linalg.norm(entry[0][:, None] - places, axis=2).min() < 1e-9]
        for entry in near:
            found.remove(entry)
        joined = [places, *(entry[0] for entry in near)], [face, *(other for entry in near for other in entry[1])]
        found.append((np.concatenate(joined[0]), joined[1]))
    found.sort(key=lambda entry: float(np.linalg.norm(entry[0].mean(axis=0))))
    return [faces for _, faces in found]


def main() -> None:
    """Read the surface, write the mesh."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("surface")
    parser.add_argument("mesh")
    parser.add_argument("--thickness", type=float, required=True, help="of the wall, in the unit of the surface")
    parser.add_argument("--size", type=float, required=True, help="of an element along the wall")
    parser.add_argument("--through", type=int, default=2, help="elements through the wall (default: 2)")
    chosen = parser.parse_args()
    if not (chosen.surface.lower().endswith(".stl") and Path(chosen.surface).is_file()):
        parser.exit(2, f"{chosen.surface}: needed is an STL file that is there\n")
    if min(chosen.thickness, chosen.size, chosen.through) <= 0:
        parser.exit(2, "--thickness, --size and --through: must be above 0\n")
    gmsh.initialize()
    gmsh.option.setNumber("General.Verbosity", 2)
    gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
    inner, outer, volumes = wall(chosen.surface, chosen.thickness, chosen.size, chosen.through)
    gmsh.model.mesh.generate(3)
    if not (openings := ends([*inner, *outer])):
        parser.exit(2, f"{chosen.surface} has no open end: cut its ends\n")
    inlet, *outlets = openings
    faces = {"inner": inner, "outer": outer, "inlet": inlet}
    faces |= {f"outlet_{number}": face for number, face in enumerate(outlets, 1)}
    for number, (name, entities) in enumerate(faces.items(), 1):
        gmsh.model.addPhysicalGroup(2, entities, number, name=name)
    gmsh.model.addPhysicalGroup(3, volumes, 11, name="wall")
    gmsh.option.setNumber("Mesh.SecondOrderLinear", 1)  # straight edges: curved ones would twist thin elements
    gmsh.model.mesh.setOrder(2)
    gmsh.write(chosen.mesh)
    print(f"{chosen.mesh}: {sum(map(len, gmsh.model.mesh.getElements(3)[1]))} tetrahedra, faces {', '.join(faces)}")
    gmsh.finalize()


if __name__ == "__main__":
    main()
