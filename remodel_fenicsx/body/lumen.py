"""From the surface of a lumen to the mesh of a wall: layers of prisms along its normals, as tetrahedra of degree 2."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from remodel_fenicsx.body.gmsh_model import gmsh_model
from remodel_fenicsx.body.mesh_faces import area_vectors, cap_volume, jacobian_determinants, rims
from remodel_fenicsx.body.mesh_file import (
    ORDERS,
    SURFACES,
    Block,
    Surface,
    gmsh_text,
    in_place,
    of_gmsh,
    split_quads,
    split_wedges,
    triangles_of,
)
from remodel_fenicsx.body.wall import Wall, shared_out
from remodel_fenicsx.errors import UnreadableFile
from remodel_fenicsx.model.tensors import Array, Flags, Integers
from remodel_fenicsx.schema.settings import LARGEST_MESH
from remodel_fenicsx.schema.tables import SceneError
from remodel_fenicsx.system.children import DAMAGED, made_apart
from remodel_fenicsx.system.files import write_new
from remodel_fenicsx.system.terminal import announce


LARGE_SURFACE = 200_000  # triangles of which Gmsh divides 6,000 a second
SHARP = 60.0  # degrees between two triangles from which on Gmsh keeps an edge between them
HOLLOW = 1e-6  # of an area to the power of 1.5: a tube of that volume is 80,000 times longer than wide
SMOOTHINGS = 50  # of the normals where a wall would fold over: more change no corner that is still there
MOST_THROUGH = 100  # elements through the wall
MOST_RADII, LEAST_RADII = 3.0, 2e-3  # of a wall: arterioles that are contracted have 2, the widest aneurysms 0.02
LEAST_ROOM = 0.5  # of the thickness: an outer face that is nearer to the lumen lies in another part of the wall
EDGES = ([0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3])  # of a tetrahedron, in the order of its further nodes


def read_surface(path: Path) -> Surface:
    """The surface of a file; its ending is one of `SURFACES`."""
    if path.suffix.lower() not in SURFACES:
        raise SceneError(f"{path}: allowed is a file that ends with {', '.join(SURFACES)}")
    try:
        surface, _ = triangles_of(path)
    except (OSError, UnreadableFile) as error:
        raise SceneError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    return oriented(surface, str(path))


# ---------------------------------------------------------------- what a surface is


def oriented(surface: Surface, name: str) -> Surface:
    """The surface with all normals out of the lumen, whatever the file has; refused where it is none of a lumen."""
    mesh = polygons(surface.points, surface.triangles)
    kinds = {"boundary_edges": False, "feature_edges": False, "manifold_edges": False}
    if (odd := mesh.extract_feature_edges(non_manifold_edges=True, **kinds)).n_cells:
        place = in_place(odd.cell_centers().points[0])
        raise SceneError(f"{name}: three triangles or more meet in one edge, at {place}; a lumen has two")
    if not mesh.n_open_edges:
        raise SceneError(f"{name}: the surface is closed; cut its ends open, where the vessel goes on")
    if (parts := mesh.connectivity()["RegionId"].max() + 1) > 1:
        raise SceneError(f"{name}: has {parts} parts that do not touch; allowed is one lumen")
    normals = mesh.compute_normals(point_normals=False, split_vertices=False, auto_orient_normals=False)
    points, triangles = surface.points, normals.faces.reshape(-1, 4)[:, 1:].astype(np.int64)
    volume, area = _signed_volume(points, triangles), np.linalg.norm(area_vectors(points[triangles]), axis=1).sum()
    if abs(volume) <= HOLLOW * area**1.5:
        raise SceneError(f"{name}: the surface is flat, it encloses no lumen")
    if volume < 0:
        triangles = triangles[:, ::-1]
    return Surface(points, triangles, surface.arrays)


def _signed_volume(points: Array, triangles: Integers) -> float:
    """Inside of the triangles and flat caps on their openings."""
    places = points[triangles]
    sides = np.einsum("ni,ni->", places.mean(axis=1), area_vectors(places)) / 3
    return float(sides + sum(cap_volume(points, rim[:, ::-1]) for rim in rims(triangles)))


def remeshed(surface: Surface, size: float) -> tuple[Surface, Integers]:
    """The surface with triangles of a size, by Gmsh, rounded, and the nearest corner before of each of its own."""
    from scipy.spatial import cKDTree

    numbers = io.BytesIO()
    np.savez(numbers, points=surface.points, triangles=surface.triangles, size=size)
    try:  # a process of its own: Gmsh hears no signals
        found = made_apart(numbers.getvalue(), "the surface", f"{__name__}:by_gmsh")
    except UnreadableFile as error:
        reason = str(error).removeprefix(DAMAGED)
        raise SceneError(f"--size {size:g}: Gmsh could not divide the surface so: {reason}") from error
    points, triangles = found["points"], found["triangles"]
    on_rims = np.isin(np.arange(len(points)), np.concatenate(rims(triangles)))
    divided = Surface(rounded(surface, points, on_rims), triangles, {})
    return oriented(divided, "the surface by Gmsh"), cKDTree(surface.points).query(points)[1]


def by_gmsh(file: str) -> dict[str, Any]:
    """In the child process: points and triangles of a size, of those in a file."""
    with np.load(file) as read, gmsh_model("wall") as gmsh:
        count, corners = len(read["points"]), read["triangles"].ravel() + 1
        gmsh.model.addDiscreteEntity(2, 1)
        gmsh.model.mesh.addNodes(2, 1, np.arange(1, count + 1), read["points"].ravel())
        gmsh.model.mesh.addElementsByType(1, 2, [], corners)
        gmsh.model.mesh.classifySurfaces(np.radians(SHARP), True, True, np.pi)
        gmsh.model.mesh.createGeometry()
        for option in ("Mesh.MeshSizeMin", "Mesh.MeshSizeMax"):
            gmsh.option.setNumber(option, float(read["size"]))
        gmsh.model.mesh.generate(2)
        points, blocks = of_gmsh()
    used, triangles = np.unique(next(b.nodes for b in blocks if b.kind == "triangle"), return_inverse=True)
    return {"points": points[used], "triangles": triangles.reshape(-1, 3)}


def rounded(surface: Surface, places: Array, on_rims: Flags) -> Array:
    """Places near a surface on the smooth one through its corners, square to their normals; those of rims on its rims.

    Phong's tessellation with the factor 1/2, which is exact where the surface is a parabola: T. Boubekeur and M. Alexa,
    Phong tessellation (2008).
    """
    rims_of_it = rims(surface.triangles)
    normals, found = _normals(surface, rims_of_it), np.empty_like(places)
    for simplices, chosen in ((surface.triangles, ~on_rims), (np.concatenate(rims_of_it), on_rims)):
        rows, flat = nearest(surface.points, simplices, places[chosen])
        corners, upwards = surface.points[simplices[rows]], normals[simplices[rows]]
        sides = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
        shares = np.einsum("nij,nj->ni", np.linalg.pinv(sides), flat - corners[:, 0])
        shares = np.column_stack([1 - shares.sum(axis=1), shares])
        lifts = np.einsum("nki,nki->nk", corners - flat[:, None], upwards)
        found[chosen] = flat + np.einsum("nk,nk,nki->ni", shares, lifts, upwards) / 2
    return found


def nearest(points: Array, simplices: Integers, places: Array) -> tuple[Integers, Array]:
    """Which of the edges or triangles is the nearest of each place, and where."""
    found: Any = polygons(points, simplices).find_closest_cell(places, return_closest_point=True)
    return found


def polygons(points: Array, simplices: Integers) -> Any:
    """Edges or triangles, as VTK has them."""
    import pyvista

    cells: Any = np.insert(simplices, 0, simplices.shape[1], axis=1).ravel()
    return pyvista.PolyData(points, **{"lines" if simplices.shape[1] == 2 else "faces": cells})


# ---------------------------------------------------------------- the wall


class GrownWall(NamedTuple):
    """Tetrahedra of degree 2 with the numbers of their layers, and triangles of degree 2 of each face by name."""

    points: Array
    tetrahedra: Integers
    layers: Integers
    faces: dict[str, Integers]
    straight: int


def grown(surface: Surface, given: Surface, thickness: Array, layers: Mapping[str, float], through: int) -> GrownWall:
    """Prisms outwards of a surface, bent as the given one: thickness (points,), of which each layer has its share."""
    ends, counts = np.cumsum([0.0, *layers.values()]), shared_out([*layers.values()], max(through, len(layers)))
    levels = Wall((*layers,), (*ends,), counts).nodes(1) / ends[-1]
    openings = rims(surface.triangles)
    size, layer = len(surface.points), np.arange(len(levels) - 1)[:, None, None]
    wedges = np.concatenate([surface.triangles, surface.triangles + size], axis=1) + size * layer
    tetrahedra = split_wedges(wedges.reshape(-1, 6)).reshape(-1, 4)
    normals = _normals(surface, openings)
    for _ in range(SMOOTHINGS):
        points = (surface.points + levels[:, None, None] * thickness[:, None] * normals).reshape(-1, 3)
        folded = np.linalg.det(points[tetrahedra[:, 1:]] - points[tetrahedra[:, :1]]) <= 0
        if not folded.any():
            break
        normals = _around(surface, normals[surface.triangles].sum(axis=1), openings)
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
    rim_edges, key = np.sort(np.concatenate(openings), axis=1), [len(points), 1]
    keys = np.unique(np.sort(tetrahedra[:, EDGES], axis=2).reshape(-1, 2) @ key)
    pairs = np.column_stack(np.divmod(keys, len(points)))
    # below each lies a corner of the surface, twice the same, or an edge of it
    below, row = np.unique(np.sort(pairs % size, axis=1) @ key, return_inverse=True)
    ends = np.column_stack(np.divmod(below, len(points)))
    feet, is_edge = surface.points[ends].mean(axis=1), ends[:, 0] != ends[:, 1]
    feet[is_edge] = rounded(given, feet[is_edge], np.isin(below, rim_edges @ key)[is_edge])
    outwards, depth = normals[ends].mean(axis=1), np.repeat(levels, size)[pairs].mean(axis=1)
    outwards *= (thickness[ends].mean(axis=1) / np.linalg.norm(outwards, axis=1))[:, None]
    points = np.concatenate([points, feet[row] + depth[:, None] * outwards[row]])

    def with_middles(cells: Integers, edges: Sequence[Sequence[int]]) -> Integers:
        sides = np.sort(cells[:, edges], axis=2) @ key
        return np.column_stack([cells, len(points) - len(pairs) + np.searchsorted(keys, sides)])

    elements = with_middles(tetrahedra, EDGES)
    faces = {name: with_middles(face, EDGES[:3]) for name, face in faces.items()}
    return GrownWall(points, elements, of_layer, faces, _straightened(points, elements))


def _straightened(points: Array, tetrahedra: Integers) -> int:
    """Give elements straight edges that are twisted by bent ones, until none is; how many edges these are."""
    done: set[int] = set()
    body: Any = SimpleNamespace(kind="tetrahedron", degree=2, points=points, cells=tetrahedra[:, ORDERS["tetra10"]])
    while True:
        twisted = tetrahedra[(jacobian_determinants(body) <= 0).any(axis=1)]
        middles = twisted[:, 4:]
        if done.issuperset(middles.ravel()):
            return len(done)
        done |= {*middles.ravel()}
        points[middles] = points[twisted[:, EDGES]].mean(axis=2)


def _around(surface: Surface, vectors: Array, openings: Sequence[Integers]) -> Array:
    """Unit vectors at the points, sums over the triangles around them (triangles, 3); those of a rim in its plane."""
    found = np.zeros_like(surface.points)
    np.add.at(found, surface.triangles, vectors[:, None])
    for rim in openings:
        nodes = np.unique(rim)
        across = np.linalg.svd(surface.points[nodes] - surface.points[nodes].mean(axis=0))[2][2]
        found[nodes] -= np.outer(found[nodes] @ across, across)
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def _normals(surface: Surface, openings: Sequence[Integers]) -> Array:
    """Unit vectors out of the lumen at the points."""
    return _around(surface, area_vectors(surface.points[surface.triangles]), openings)


def _check_room(inner: Array, outer: Array, thickness: Array) -> None:
    """Refuse a wall that reaches into another part of itself, or of the lumen."""
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(inner).query(outer)
    if (crossed := distance < LEAST_ROOM * thickness).any():
        place = outer[int(np.argmax(crossed))]
        raise SceneError(f"--thickness: too thick: the wall meets another part of the vessel at {in_place(place)}")


# ---------------------------------------------------------------- what the command does


def write_wall(
    surface: Path, path: Path, thickness: str | None, layers: Sequence[str], size: float, through: int
) -> list[str]:
    """Make the mesh of a wall and write it, a new file; what is in it, in lines."""
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
    depth, radius = _thickness(thickness, shares, read), 2 * _signed_volume(read.points, read.triangles) / area
    _check_units(radius, size, depth)
    if len(read.triangles) > LARGE_SURFACE:
        announce(f"{surface}: {len(read.triangles)} triangles are divided again, which takes minutes")
    found, near = remeshed(read, size)
    wall = grown(found, read, depth[near], shares or {"wall": 1.0}, through)
    if taken := shares.keys() & wall.faces:
        raise SceneError(f"--layers {min(taken)}=...: a face has this name; choose another one for the layer")
    names = list(shares) or ["wall"]
    of_names = {2: {name: number for number, name in enumerate(wall.faces, 1)}}
    of_names[3] = {name: number for number, name in enumerate(names, len(wall.faces) + 1)}
    blocks = [Block("triangle6", np.full(len(face), of_names[2][name]), face) for name, face in wall.faces.items()]
    blocks += [Block("tetra10", len(wall.faces) + 1 + wall.layers, wall.tetrahedra[:, ORDERS["tetra10"]])]
    write_new(path, gmsh_text(wall.points, blocks, of_names).encode())
    inner, outer = (wall.faces[name] for name in ("inner", "outer"))
    nodes = np.unique(outer)
    between = np.linalg.norm(wall.points[nodes] - nearest(wall.points, _halved(inner), wall.points[nodes])[1], axis=1)
    lines = [
        f"{path}: {len(wall.tetrahedra)} tetrahedra of degree 2, {max(through, len(names))} through the wall",
        f"thickness {between.min():.4g} to {between.max():.4g} at the nodes",
        f"faces {', '.join(wall.faces)}; " + (f"regions {', '.join(names)}" if shares else "one region"),
    ]
    if wall.straight:
        lines.append(f"{wall.straight} edges are straight: bent as the surface they would twist elements")
    return lines


def _halved(face: Integers) -> Integers:
    """Four triangles for each of degree 2."""
    return face[:, [0, 3, 5, 3, 1, 4, 5, 4, 2, 3, 4, 5]].reshape(-1, 3)


def _check_units(radius: float, size: float, thickness: Array) -> None:
    """Refuse lengths that no vessel has beside the mean radius of its lumen."""
    for option, length in (("--thickness", thickness.max()), ("--thickness", thickness.min()), ("--size", size)):
        if length > MOST_RADII * radius or (option == "--thickness" and length < LEAST_RADII * radius):
            raise SceneError(
                f"{option}: {length:.3g} is {length / radius:.3g} times the lumen's radius, which is {radius:.3g}: "
                "is it in another unit than the surface?"
            )


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
    if not ((surface.arrays[said] > 0) & np.isfinite(surface.arrays[said])).all():
        raise SceneError(f"--thickness {said}: this array has values that are not above 0, or not finite")
    return surface.arrays[said]


def _positive(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if 0.0 < value < np.inf else None
