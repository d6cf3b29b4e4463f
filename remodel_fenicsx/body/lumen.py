"""From the surface of a lumen to the mesh of a wall: layers of prisms along its normals, as tetrahedra of degree 2."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.body.gmsh_model import gmsh_model
from remodel_fenicsx.body.mesh_faces import area_vectors, cap_volume, rims
from remodel_fenicsx.body.mesh_file import in_place, of_vtk, split_quads, split_wedges, vtk_arrays
from remodel_fenicsx.body.wall import shared_out
from remodel_fenicsx.errors import UnreadableFile
from remodel_fenicsx.schema.settings import LARGEST_MESH
from remodel_fenicsx.schema.tables import SceneError
from remodel_fenicsx.system.children import read_guarded
from remodel_fenicsx.system.files import ForeignFileError, write_new

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

SURFACE_ENDINGS = (".stl", ".ply", ".vtp", ".obj")
SHARP = 60.0  # degrees between two triangles from which on Gmsh keeps an edge between them
LONGEST_HEAD = 10**5  # bytes of a PLY file
SMOOTHINGS = 50  # of the normals where a wall would fold over: more change no corner that is still there
MOST_THROUGH = 100  # elements through the wall
LEAST_ROOM = 0.5  # of the thickness: an outer face that is nearer to the lumen lies in another part of the wall
EDGES = ([0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3])  # of a tetrahedron, in the order of its further nodes


class Surface(NamedTuple):
    """Triangles whose normals point out of the lumen, and arrays of numbers at their corners."""

    points: Array
    triangles: Integers
    arrays: dict[str, Array]


# ---------------------------------------------------------------- reading, in a process with limits


def read_surface(path: Path) -> Surface:
    """The surface of a file; its ending is one of `SURFACE_ENDINGS`."""
    ending = path.suffix.lower()
    if ending not in SURFACE_ENDINGS:
        raise SceneError(f"{path}: allowed is a file that ends with {', '.join(SURFACE_ENDINGS)}")
    try:
        found, _ = read_guarded(path, f"{__name__}:{ending[1:]}")
    except (OSError, UnreadableFile, ForeignFileError) as error:
        raise SceneError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    points, triangles = found.pop("points"), found.pop("triangles")
    known = points.ndim == 2 and points.shape[1:] == (3,) and len(triangles) and np.isfinite(points).all()
    if not known or triangles.min() < 0 or triangles.max() >= len(points):
        raise SceneError(f"{path}: has no triangles between points of three finite coordinates")
    _, first, number = np.unique(points, axis=0, return_index=True, return_inverse=True)  # STL repeats its corners
    triangles = number.reshape(-1)[triangles]
    whole = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    return oriented(Surface(points[first], triangles[whole], {name: found[name][first] for name in found}), str(path))


def _as_arrays(file: str, kind: str) -> dict[str, Any]:
    import meshio

    mesh = meshio.read(file, file_format=kind)
    arrays = {name: values for name, values in mesh.point_data.items() if np.ndim(values) == 1}
    return {"points": mesh.points, "triangles": mesh.get_cells_type("triangle"), **arrays}


def stl(file: str) -> dict[str, Any]:
    """In the child process."""
    return _as_arrays(file, "stl")


def ply(file: str) -> dict[str, Any]:
    """In the child process."""
    data = Path(file).read_bytes()
    if any(int(count) > len(data) for count in re.findall(rb"(?m)^element \w+ (\d+)", data[:LONGEST_HEAD])):
        raise UnreadableFile("announces more points or triangles than it has bytes")
    return _as_arrays(file, "ply")


def obj(file: str) -> dict[str, Any]:
    """In the child process."""
    return _as_arrays(file, "obj")


def vtp(file: str) -> dict[str, Any]:
    """In the child process: VTK's own file, by VTK."""
    reader, numbers = of_vtk("vtkIOXML", "vtkXMLPolyDataReader")(), of_vtk("util.numpy_support", "vtk_to_numpy")
    triangulated = of_vtk("vtkFiltersCore", "vtkTriangleFilter")()
    reader.SetFileName(file)
    triangulated.SetInputConnection(reader.GetOutputPort())
    triangulated.Update()
    data = triangulated.GetOutput()
    if not data.GetNumberOfPolys():
        raise UnreadableFile("has no polygons")
    return {
        "points": numbers(data.GetPoints().GetData()).astype(float),
        "triangles": numbers(data.GetPolys().GetData()).reshape(-1, 4)[:, 1:],
        **{name: values for name, values in vtk_arrays(data.GetPointData()).items() if values.ndim == 1},
    }


# ---------------------------------------------------------------- what a surface is


def oriented(surface: Surface, name: str) -> Surface:
    """The surface with all normals out of the lumen, whatever the file has; refused where it is none of a lumen."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import breadth_first_order, connected_components

    points, triangles = surface.points, surface.triangles
    edges, directions, owners = _edges(triangles)
    distinct, number, counts = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    number = number.reshape(-1)
    if (counts > 2).any():
        place = points[distinct[counts > 2][0]].mean(axis=0)
        raise SceneError(f"{name}: three triangles or more meet in one edge, at {in_place(place)}; a lumen has two")
    if (counts == 2).all():
        raise SceneError(f"{name}: the surface is closed; cut its ends open, where the vessel goes on")
    order = np.argsort(number, kind="stable")
    shared = counts[number[order]] == 2
    one, other = order[shared].reshape(-1, 2).T
    count = len(triangles)
    turned = directions[one] == directions[other]  # both go the same way along their edge: one is inside out
    links = coo_matrix((np.where(turned, 2.0, 1.0), (owners[one], owners[other])), (count, count)).tocsr()
    links = links.maximum(links.T)
    if (parts := connected_components(links, directed=False)[0]) > 1:
        raise SceneError(f"{name}: has {parts} parts that do not touch; allowed is one lumen")
    visited, before = breadth_first_order(links, 0, directed=False)
    flipped: Flags = np.zeros(count, dtype=bool)
    for triangle in visited[1:]:
        flipped[triangle] = flipped[before[triangle]] ^ (links[triangle, before[triangle]] == 2.0)
    triangles = np.where(flipped[:, None], triangles[:, ::-1], triangles)
    if _signed_volume(points, triangles) < 0:
        triangles = triangles[:, ::-1]
    return Surface(points, triangles, surface.arrays)


def _edges(triangles: Integers) -> tuple[Integers, Flags, Integers]:
    """All edges with the smaller number first, whether they go that way, and their triangles."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    return np.sort(edges, axis=1), edges[:, 0] < edges[:, 1], np.tile(np.arange(len(triangles)), 3)


def _signed_volume(points: Array, triangles: Integers) -> float:
    """Inside of the triangles and flat caps on their openings."""
    places = points[triangles]
    sides = np.einsum("ni,ni->", places.mean(axis=1), area_vectors(places)) / 3
    return float(sides + sum(cap_volume(points, rim[:, ::-1]) for rim, _ in rims(triangles)))


def remeshed(surface: Surface, size: float) -> Surface:
    """The surface with triangles of a size, by Gmsh; arrays as at the nearest corner before."""
    import meshio
    from scipy.spatial import cKDTree

    with tempfile.TemporaryDirectory() as folder, gmsh_model("wall") as gmsh:
        file = Path(folder) / "lumen.stl"
        meshio.Mesh(surface.points, [("triangle", surface.triangles)]).write(file)
        try:
            gmsh.merge(str(file))
            gmsh.model.mesh.classifySurfaces(np.radians(SHARP), True, True, np.pi)
            gmsh.model.mesh.createGeometry()
            for option in ("Mesh.MeshSizeMin", "Mesh.MeshSizeMax"):
                gmsh.option.setNumber(option, size)
            gmsh.model.mesh.generate(2)
        except Exception as error:  # Gmsh has no other
            raise SceneError(f"--size {size:g}: Gmsh could not divide the surface so: {error}") from error
        numbers, places, _ = gmsh.model.mesh.getNodes()
        corners = gmsh.model.mesh.getElementsByType(2)[1]
    used, triangles = np.unique(corners, return_inverse=True)
    order = np.argsort(numbers)
    points = places.reshape(-1, 3)[order[np.searchsorted(numbers[order], used)]]
    _, near = cKDTree(surface.points).query(points)
    arrays = {name: values[near] for name, values in surface.arrays.items()}
    return oriented(Surface(points, triangles.reshape(-1, 3), arrays), "the surface by Gmsh")


# ---------------------------------------------------------------- the wall


class GrownWall(NamedTuple):
    """Tetrahedra of degree 2 with the numbers of their layers, and triangles of degree 2 of each face by name."""

    points: Array
    tetrahedra: Integers
    layers: Integers
    faces: dict[str, Integers]


def grown(surface: Surface, thickness: Array, layers: Mapping[str, float], through: int) -> GrownWall:
    """Prisms outwards of a surface: thickness (points,), of which each layer has its share."""
    counts = shared_out(list(layers.values()), max(through, len(layers)))
    shares, ends = np.array(list(layers.values())), np.cumsum([0.0, *layers.values()])
    levels = np.concatenate([[0.0], *(np.linspace(ends[k], ends[k + 1], n + 1)[1:] for k, n in enumerate(counts))])
    levels /= shares.sum()
    openings = [rim for rim, _ in rims(surface.triangles)]
    size, layer = len(surface.points), np.arange(len(levels) - 1)[:, None, None]
    wedges = np.concatenate([surface.triangles, surface.triangles + size], axis=1) + size * layer
    tetrahedra = split_wedges(wedges.reshape(-1, 6)).reshape(-1, 4)
    normals = _normals(surface, openings)
    for _ in range(SMOOTHINGS):
        points = (surface.points + levels[:, None, None] * thickness[:, None] * normals).reshape(-1, 3)
        folded = np.linalg.det(points[tetrahedra[:, 1:]] - points[tetrahedra[:, :1]]) <= 0
        if not folded.any():
            break
        normals = _smoothed(normals, surface, openings)
    else:
        place = points[tetrahedra[folded][0]].mean(axis=0)
        raise SceneError(f"--thickness: too thick: the wall folds over at {in_place(place)}, where the lumen is hollow")
    _check_room(surface.points, points[-size:], thickness)
    of_layer = np.repeat(np.repeat(np.arange(len(layers)), counts), 3 * len(surface.triangles))
    faces = {"inner": surface.triangles, "outer": surface.triangles + size * (len(levels) - 1)}
    quads = [np.concatenate([rim, rim[:, ::-1] + size], axis=1) + size * layer for rim in openings]
    sides = [split_quads(each.reshape(-1, 4)) for each in quads]
    sides.sort(key=lambda side: float(np.linalg.norm(points[side].mean(axis=(0, 1)))))
    faces |= {"inlet": sides[0]} | {f"outlet_{number}": side for number, side in enumerate(sides[1:], 1)}
    return _of_degree_2(points, tetrahedra, of_layer, faces)


def _normals(surface: Surface, openings: Sequence[Integers]) -> Array:
    """Unit vectors out of the lumen at the points, by the triangles around them; those of a rim in its plane."""
    found, vectors = np.zeros_like(surface.points), area_vectors(surface.points[surface.triangles])
    for k in range(3):
        np.add.at(found, surface.triangles[:, k], vectors)
    return _in_planes(found, surface.points, openings)


def _in_planes(vectors: Array, points: Array, openings: Sequence[Integers]) -> Array:
    found = vectors.copy()
    for rim in openings:
        nodes = np.unique(rim)
        across = np.linalg.svd(points[nodes] - points[nodes].mean(axis=0))[2][2]
        found[nodes] -= np.outer(found[nodes] @ across, across)
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))


def _smoothed(normals: Array, surface: Surface, openings: Sequence[Integers]) -> Array:
    """Each with the mean of those around it."""
    edges = np.unique(_edges(surface.triangles)[0], axis=0)
    sums, counts = normals.copy(), np.ones(len(normals))
    for one, other in (edges.T, edges.T[::-1]):
        np.add.at(sums, one, normals[other])
        np.add.at(counts, one, 1.0)
    return _in_planes(sums / counts[:, None], surface.points, openings)


def _check_room(inner: Array, outer: Array, thickness: Array) -> None:
    """Refuse a wall that reaches into another part of itself, or of the lumen."""
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(inner).query(outer)
    if (crossed := distance < LEAST_ROOM * thickness).any():
        place = outer[int(np.argmax(crossed))]
        raise SceneError(f"--thickness: too thick: the wall meets another part of the vessel at {in_place(place)}")


def _of_degree_2(points: Array, tetrahedra: Integers, layers: Integers, faces: Mapping[str, Integers]) -> GrownWall:
    """With nodes in the middle of straight edges: curved ones would twist thin elements."""
    edges = np.sort(np.concatenate([tetrahedra[:, edge] for edge in EDGES]), axis=1)
    distinct, number = np.unique(edges, axis=0, return_inverse=True)
    middles = number.reshape(len(EDGES), -1).T + len(points)
    keys = distinct @ [len(points), 1]

    def with_middles(face: Integers) -> Integers:
        sides = (np.sort(face[:, edge], axis=1) @ [len(points), 1] for edge in EDGES[:3])
        return np.column_stack([face, *(len(points) + np.searchsorted(keys, side) for side in sides)])

    whole = np.concatenate([points, points[distinct].mean(axis=1)])
    return GrownWall(
        whole, np.column_stack([tetrahedra, middles]), layers, {k: with_middles(v) for k, v in faces.items()}
    )


# ---------------------------------------------------------------- what the command does


def write_wall(
    surface: Path, path: Path, thickness: str | None, layers: Sequence[str], size: float, through: int
) -> list[str]:
    """Make the mesh of a wall and write it, a new file; what is in it, in lines."""
    import meshio

    if path.suffix.lower() != ".msh":
        raise SceneError(f"-o {path}: allowed is a file that ends with .msh")
    if path.exists():
        raise SceneError(f"-o {path}: is there already; nothing is overwritten")
    if not 0.0 < size < np.inf:
        raise SceneError("--size: allowed is a number above 0")
    if not 1 <= through <= MOST_THROUGH:
        raise SceneError(f"--through: allowed is a whole number from 1 to {MOST_THROUGH}")
    shares, read = _thicknesses(layers), read_surface(surface)
    area = np.linalg.norm(area_vectors(read.points[read.triangles]), axis=1).sum()
    number = 3 * max(through, len(shares)) * area / (np.sqrt(0.1875) * size**2)  # of equilateral triangles
    if number > LARGEST_MESH:
        raise SceneError(f"--size {size:g}: makes about {number:.2g} tetrahedra; at most {LARGEST_MESH:g} are made")
    found = remeshed(read, size)
    depth = _thickness(thickness, shares, found)
    wall = grown(found, depth, shares or {"wall": 1.0}, through)
    if taken := shares.keys() & wall.faces:
        raise SceneError(f"--layers {min(taken)}=...: a face has this name; choose another one for the layer")
    names = list(shares) or ["wall"]
    groups = {name: (number, 2) for number, name in enumerate(wall.faces, 1)}
    groups |= {name: (len(wall.faces) + number, 3) for number, name in enumerate(names, 1)}
    tags = [np.full(len(face), groups[name][0]) for name, face in wall.faces.items()] + [
        len(wall.faces) + 1 + wall.layers
    ]
    cells = [("triangle6", face) for face in wall.faces.values()] + [("tetra10", wall.tetrahedra)]
    data: Any = {"gmsh:physical": tags, "gmsh:geometrical": tags}
    mesh = meshio.Mesh(wall.points, cells, cell_data=data, field_data={k: np.array(v) for k, v in groups.items()})
    with tempfile.TemporaryDirectory() as folder:
        mesh.write(Path(folder) / "wall.msh", file_format="gmsh22", binary=False)
        write_new(path, (Path(folder) / "wall.msh").read_bytes())
    layers_of = f"regions {', '.join(names)}" if shares else "one region"
    return [
        f"{path}: {len(wall.tetrahedra)} tetrahedra of degree 2, {max(through, len(names))} through the wall",
        f"thickness {depth.min():.4g} to {depth.max():.4g}; faces {', '.join(wall.faces)}; {layers_of}",
    ]


def _thicknesses(said: Sequence[str]) -> dict[str, float]:
    """Thickness by name."""
    found: dict[str, float] = {}
    for text in said:
        name, _, number = text.partition("=")
        if not name.isidentifier() or name in found or (value := _positive(number)) is None:
            raise SceneError(f"--layers {text}: allowed is NAME=THICKNESS, each name once, from the lumen outwards")
        found[name] = value
    return found


def _thickness(said: str | None, layers: Mapping[str, float], surface: Surface) -> Array:
    """At the points, (n,): a number, an array of the file, or the sum of the layers."""
    whole = sum(layers.values())
    if said is None and not layers:
        raise SceneError("--thickness: missing; a number in the unit of the surface, an array of it, or --layers")
    value = _positive(said or "")
    if said is None or value is not None:
        number = value or whole
        if layers and not np.isclose(number, whole):
            raise SceneError(f"--thickness {said}: the layers come to {whole:g}; leave one of both out")
        return np.full(len(surface.points), number)
    if said not in surface.arrays:
        known = ", ".join(surface.arrays) or "none"
        raise SceneError(f"--thickness {said}: allowed is a number above 0, or an array at the points: {known}")
    if not (surface.arrays[said] > 0).all():
        raise SceneError(f"--thickness {said}: this array has values that are not above 0")
    return np.asarray(surface.arrays[said], dtype=np.float64)


def _positive(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if 0.0 < value < np.inf else None
