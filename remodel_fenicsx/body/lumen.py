"""Mesh of a wall from the surface of a lumen: layers of prisms along its normals.

The prisms become tetrahedra of degree 2.
"""

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
    SURFACES,
    Block,
    Surface,
    gmsh_text,
    format_position,
    in_gmsh_order,
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


LARGE_SURFACE = 200_000  # triangles; Gmsh remeshes 6,000 a second
SHARP = 60.0  # degrees between two triangles from which Gmsh keeps their edge
# Smallest volume over area^1.5. A tube of this volume is 80,000 times longer than wide.
HOLLOW = 1e-6
SMOOTHINGS = 50  # passes over the normals if a wall folds; more do not change the remaining folds
MOST_THROUGH = 100  # elements through the wall
# Wall thickness over the lumen's radius: 2 in contracted arterioles, 0.02 in the widest aneurysms.
MOST_RADII, LEAST_RADII = 3.0, 2e-3
# Smallest distance of the outer face from the lumen, over the thickness. A closer face lies in
# another part of the wall.
MIN_CLEARANCE = 0.5
# Where a wall folds or meets itself it gets thinner by this factor until it does not.
THINNING = 0.9
LEAST_THINNED = 0.2  # smallest thickness there, relative to the requested one
SLOPE = 0.25  # of the thickness around these positions
# Edges of a tetrahedron, in the order of its mid-edge nodes.
EDGES = ([0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3])


def read_surface(path: Path) -> Surface:
    """Read a surface from a file whose suffix is in `SURFACES`."""
    if path.suffix.lower() not in SURFACES:
        raise SceneError(f"{path}: must be a file {', '.join(SURFACES)}")
    try:
        surface, _ = triangles_of(path)
    except (OSError, UnreadableFile) as error:
        raise SceneError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    return oriented(surface, str(path))


# ---------------------------------------------------------------- surfaces


def oriented(surface: Surface, name: str) -> Surface:
    """Return the surface with all normals out of the lumen, and check that it bounds one."""
    mesh = polygons(surface.points, surface.triangles)
    kinds = {"boundary_edges": False, "feature_edges": False, "manifold_edges": False}
    if (odd := mesh.extract_feature_edges(non_manifold_edges=True, **kinds)).n_cells:
        place = format_position(odd.cell_centers().points[0])
        raise SceneError(f"{name}: three or more triangles share an edge at {place}; must be two")
    if not mesh.n_open_edges:
        raise SceneError(f"{name}: the surface is closed; cut the ends of the vessel open")
    if (parts := mesh.connectivity()["RegionId"].max() + 1) > 1:
        raise SceneError(f"{name}: has {parts} disconnected parts; must be one lumen")
    normals = mesh.compute_normals(
        point_normals=False, split_vertices=False, auto_orient_normals=False
    )
    points, triangles = surface.points, normals.faces.reshape(-1, 4)[:, 1:].astype(np.int64)
    volume, area = _signed_volume(points, triangles), _area(points, triangles)
    if abs(volume) <= HOLLOW * area**1.5:
        raise SceneError(f"{name}: the surface is flat and encloses no lumen")
    if volume < 0:
        triangles = triangles[:, ::-1]
    return Surface(points, triangles, surface.arrays)


def _signed_volume(points: Array, triangles: Integers) -> float:
    """Return the volume inside the triangles and flat caps on their openings."""
    places = points[triangles]
    sides = np.einsum("ni,ni->", places.mean(axis=1), area_vectors(places)) / 3
    return float(sides + sum(cap_volume(points, rim[:, ::-1]) for rim in rims(triangles)))


def _area(points: Array, triangles: Integers) -> float:
    return float(np.linalg.norm(area_vectors(points[triangles]), axis=1).sum())


def _mean_radius(surface: Surface) -> float:
    """Return the lumen's mean radius, that of a tube of the same volume and area."""
    volume = _signed_volume(surface.points, surface.triangles)
    return 2 * volume / _area(surface.points, surface.triangles)


def remeshed(surface: Surface, size: float) -> tuple[Surface, Integers]:
    """Remesh the surface by Gmsh with triangles of a size, rounded.

    Also return the nearest corner of the original surface for each new corner.
    """
    from scipy.spatial import cKDTree

    numbers = io.BytesIO()
    np.savez(numbers, points=surface.points, triangles=surface.triangles, size=size)
    try:  # in a child process, because Gmsh ignores signals
        arrays = made_apart(numbers.getvalue(), "the surface", f"{__name__}:by_gmsh")
    except UnreadableFile as error:
        reason = str(error).removeprefix(DAMAGED)
        raise SceneError(f"--size {size:g}: Gmsh could not remesh the surface: {reason}") from error
    points, triangles = arrays["points"], arrays["triangles"]
    on_rims = np.isin(np.arange(len(points)), np.concatenate(rims(triangles)))
    divided = Surface(rounded(surface, points, on_rims), triangles, {})
    return oriented(divided, "the surface by Gmsh"), cKDTree(surface.points).query(points)[1]


def by_gmsh(file: str) -> dict[str, Any]:
    """Remesh the triangles of a file to a size, in the child process."""
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
    used, triangles = np.unique(
        next(b.nodes for b in blocks if b.kind == "triangle"), return_inverse=True
    )
    return {"points": points[used], "triangles": triangles.reshape(-1, 3)}


def rounded(surface: Surface, places: Array, on_rims: Flags) -> Array:
    """Project positions near a surface to the smooth surface through its corners, rims to its rims.

    The smooth surface is perpendicular to the corners' normals: Phong tessellation with the factor
    1/2, exact for parabolas. T. Boubekeur and M. Alexa, Phong tessellation (2008).
    """
    rims_of_it = rims(surface.triangles)
    normals, lifted = _normals(surface, rims_of_it), np.empty_like(places)
    for simplices, chosen in ((surface.triangles, ~on_rims), (np.concatenate(rims_of_it), on_rims)):
        rows, flat = nearest(surface.points, simplices, places[chosen])
        corners, upwards = surface.points[simplices[rows]], normals[simplices[rows]]
        sides = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
        shares = np.einsum("nij,nj->ni", np.linalg.pinv(sides), flat - corners[:, 0])
        shares = np.column_stack([1 - shares.sum(axis=1), shares])
        lifts = np.einsum("nki,nki->nk", corners - flat[:, None], upwards)
        lifted[chosen] = flat + np.einsum("nk,nk,nki->ni", shares, lifts, upwards) / 2
    return lifted


def nearest(points: Array, simplices: Integers, places: Array) -> tuple[Integers, Array]:
    """Return the index of the nearest edge or triangle to each position, and the nearest point."""
    return polygons(points, simplices).find_closest_cell(places, return_closest_point=True)


def polygons(points: Array, simplices: Integers) -> Any:
    """Return edges or triangles as VTK's polygons."""
    import pyvista

    cells: Any = np.insert(simplices, 0, simplices.shape[1], axis=1).ravel()
    return pyvista.PolyData(points, **{"lines" if simplices.shape[1] == 2 else "faces": cells})


# ---------------------------------------------------------------- the wall


class ExtrudedWall(NamedTuple):
    """Tetrahedra of degree 2 with layer numbers, and the triangles of degree 2 of each face."""

    points: Array
    tetrahedra: Integers
    layers: Integers
    faces: dict[str, Integers]
    straight: int
    allowed: Array  # thickness at the surface's corners


def extrude_wall(
    surface: Surface, given: Surface, thickness: Array, layers: Mapping[str, float], through: int
) -> ExtrudedWall:
    """Extrude prisms from a surface outwards, curved as the original one, by a thickness (points,).

    Each layer has its fraction of the thickness.
    """
    ends, counts = np.cumsum([0.0, *layers.values()]), shared_out([*layers.values()], through)
    levels = Wall((*layers,), (*ends,), counts).nodes(1) / ends[-1]
    openings = rims(surface.triangles)
    size, layer = len(surface.points), np.arange(len(levels) - 1)[:, None, None]
    wedges = np.concatenate([surface.triangles, surface.triangles + size], axis=1) + size * layer
    tetrahedra = split_wedges(wedges.reshape(-1, 6)).reshape(-1, 4)
    normals = _smoothed_normals(surface, openings, levels, thickness, tetrahedra)
    allowed = thickness
    while True:
        points = _extruded(surface, levels, allowed, normals)
        faulty = _crossed(surface.points, points[-size:], allowed)
        faulty[tetrahedra[_folded(points, tetrahedra)] % size] = True
        if not faulty.any():
            break
        allowed = _thinned(surface, faulty, allowed, thickness)
    of_layer = np.repeat(np.repeat(np.arange(len(layers)), counts), 3 * len(surface.triangles))
    faces = {"inner": surface.triangles, "outer": surface.triangles + size * (len(levels) - 1)}
    quads = [np.concatenate([rim, rim[:, ::-1] + size], axis=1) + size * layer for rim in openings]
    sides = [split_quads(each.reshape(-1, 4)) for each in quads]
    sides.sort(key=lambda side: float(np.linalg.norm(points[side].mean(axis=(0, 1)))))
    faces |= {"inlet": sides[0]} | {
        f"outlet_{number}": side for number, side in enumerate(sides[1:], 1)
    }
    rim_edges, key = np.sort(np.concatenate(openings), axis=1), [len(points), 1]
    keys = np.unique(np.sort(tetrahedra[:, EDGES], axis=2).reshape(-1, 2) @ key)
    pairs = np.column_stack(np.divmod(keys, len(points)))
    # Below each pair lies a corner of the surface, twice the same, or an edge.
    below, row = np.unique(np.sort(pairs % size, axis=1) @ key, return_inverse=True)
    ends = np.column_stack(np.divmod(below, len(points)))
    feet, is_edge = surface.points[ends].mean(axis=1), ends[:, 0] != ends[:, 1]
    feet[is_edge] = rounded(given, feet[is_edge], np.isin(below, rim_edges @ key)[is_edge])
    outwards, depth = normals[ends].mean(axis=1), np.repeat(levels, size)[pairs].mean(axis=1)
    outwards *= (allowed[ends].mean(axis=1) / np.linalg.norm(outwards, axis=1))[:, None]
    points = np.concatenate([points, feet[row] + depth[:, None] * outwards[row]])

    def with_middles(cells: Integers, edges: Sequence[Sequence[int]]) -> Integers:
        sides = np.sort(cells[:, edges], axis=2) @ key
        return np.column_stack([cells, len(points) - len(pairs) + np.searchsorted(keys, sides)])

    elements = with_middles(tetrahedra, EDGES)
    faces = {name: with_middles(face, EDGES[:3]) for name, face in faces.items()}
    return ExtrudedWall(points, elements, of_layer, faces, _straightened(points, elements), allowed)


def _straightened(points: Array, tetrahedra: Integers) -> int:
    """Straighten edges of inverted elements until none is left; return the number of edges."""
    done: set[int] = set()
    body: Any = SimpleNamespace(
        kind="tetrahedron", degree=2, points=points, cells=in_gmsh_order("tetra10", tetrahedra)
    )
    while True:
        twisted = tetrahedra[(jacobian_determinants(body) <= 0).any(axis=1)]
        middles = twisted[:, 4:]
        if done.issuperset(middles.ravel()):
            return len(done)
        done |= {*middles.ravel()}
        points[middles] = points[twisted[:, EDGES]].mean(axis=2)


def _around(surface: Surface, vectors: Array, openings: Sequence[Integers]) -> Array:
    """Return unit sums of vectors (triangles, 3) around each point; at a rim, in its plane."""
    sums = np.zeros_like(surface.points)
    np.add.at(sums, surface.triangles, vectors[:, None])
    for rim in openings:
        nodes = np.unique(rim)
        across = np.linalg.svd(surface.points[nodes] - surface.points[nodes].mean(axis=0))[2][2]
        sums[nodes] -= np.outer(sums[nodes] @ across, across)
    return sums / np.linalg.norm(sums, axis=1, keepdims=True)


def _normals(surface: Surface, openings: Sequence[Integers]) -> Array:
    """Return unit vectors out of the lumen at the points."""
    return _around(surface, area_vectors(surface.points[surface.triangles]), openings)


def _smoothed_normals(
    surface: Surface,
    openings: Sequence[Integers],
    levels: Array,
    thickness: Array,
    tetrahedra: Integers,
) -> Array:
    """Return the normals, smoothed until no element folds, or those that fold the fewest."""
    normals = best = _normals(surface, openings)
    fewest = len(tetrahedra)
    for _ in range(SMOOTHINGS):
        points = _extruded(surface, levels, thickness, normals)
        folds = int(_folded(points, tetrahedra).sum())
        if folds < fewest:
            best, fewest = normals, folds
        if not folds:
            break
        normals = _around(surface, normals[surface.triangles].sum(axis=1), openings)
    return best


def _extruded(surface: Surface, levels: Array, thickness: Array, normals: Array) -> Array:
    """Return the corners of the wall, level by level, (levels points, 3)."""
    return (surface.points + levels[:, None, None] * thickness[:, None] * normals).reshape(-1, 3)


def _folded(points: Array, tetrahedra: Integers) -> Flags:
    return np.linalg.det(points[tetrahedra[:, 1:]] - points[tetrahedra[:, :1]]) <= 0


def _crossed(inner: Array, outer: Array, thickness: Array) -> Flags:
    """Return where the wall reaches into another part of itself or of the lumen, (points,)."""
    from scipy.spatial import cKDTree

    return cKDTree(inner).query(outer)[0] < MIN_CLEARANCE * thickness


def _thinned(surface: Surface, faulty: Flags, allowed: Array, thickness: Array) -> Array:
    """Return a smaller thickness at faulty points, which grows around them by a slope."""
    worst = np.flatnonzero(faulty)[np.argmin((allowed / thickness)[faulty])]
    place = format_position(surface.points[worst])
    radius = _mean_radius(surface)
    if thickness[worst] > radius or allowed[worst] < LEAST_THINNED * thickness[worst]:
        raise SceneError(
            f"--thickness: too thick: the wall folds or meets itself at {place} with a "
            f"thickness of {allowed[worst]:.3g}; the lumen's mean radius is {radius:.3g}"
        )
    result = np.where(faulty, THINNING * allowed, allowed)
    edges = surface.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    rise = SLOPE * np.linalg.norm(np.diff(surface.points[edges], axis=1)[:, 0], axis=1)
    before = None
    while before is None or (result < before).any():
        before = result.copy()
        for start, end in (edges.T, edges.T[::-1]):
            np.minimum.at(result, end, result[start] + rise)
    return result


# ---------------------------------------------------------------- the command


def write_wall(
    surface: Path,
    path: Path,
    thickness: str | None,
    layers: Sequence[str],
    size: float,
    through: int,
) -> list[str]:
    """Write the mesh of a wall to a new file, and return lines that describe it."""
    if path.suffix.lower() != ".msh":
        raise SceneError(f"-o {path}: must be a file .msh")
    if path.exists():
        raise SceneError(f"-o {path}: already exists; nothing is overwritten")
    if not 0.0 < size < np.inf:
        raise SceneError("--size: must be a positive number")
    if not 1 <= through <= MOST_THROUGH:
        raise SceneError(f"--through: must be an integer from 1 to {MOST_THROUGH}")
    shares, read = _thicknesses(layers), read_surface(surface)
    through = max(through, len(shares))
    area = _area(read.points, read.triangles)
    number = 3 * through * area / (np.sqrt(0.1875) * size**2)  # for equilateral triangles
    if number > LARGEST_MESH:
        raise SceneError(
            f"--size {size:g}: about {number:.2g} tetrahedra; must be at most {LARGEST_MESH:g}"
        )
    depth = _thickness(thickness, shares, read)
    _check_units(_mean_radius(read), size, depth)
    if len(read.triangles) > LARGE_SURFACE:
        announce(f"{surface}: remeshing {len(read.triangles)} triangles takes minutes")
    divided, near = remeshed(read, size)
    requested = depth[near]
    layered = shares or {"wall": 1.0}
    wall = extrude_wall(divided, read, requested, layered, through)
    if taken := shares.keys() & wall.faces:
        raise SceneError(f"--layers {min(taken)}=...: a face has this name; rename the layer")
    of_names = {2: {name: number for number, name in enumerate(wall.faces, 1)}}
    of_names[3] = {name: number for number, name in enumerate(layered, len(wall.faces) + 1)}
    blocks = [
        Block("triangle6", np.full(len(face), of_names[2][name]), face)
        for name, face in wall.faces.items()
    ]
    tetrahedra = in_gmsh_order("tetra10", wall.tetrahedra)
    blocks.append(Block("tetra10", len(wall.faces) + 1 + wall.layers, tetrahedra))
    write_new(path, gmsh_text(wall.points, blocks, of_names).encode())
    inner, outer = (wall.faces[name] for name in ("inner", "outer"))
    nodes = np.unique(outer)
    between = np.linalg.norm(
        wall.points[nodes] - nearest(wall.points, _halved(inner), wall.points[nodes])[1], axis=1
    )
    lines = [
        f"{path}: {len(wall.tetrahedra)} tetrahedra of degree 2, {through} through the wall",
        f"thickness {between.min():.4g} to {between.max():.4g} at the nodes",
        f"faces {', '.join(wall.faces)}; "
        + (f"regions {', '.join(shares)}" if shares else "one region"),
    ]
    if (thinner := wall.allowed < requested).any():
        thinnest = int(np.argmin(wall.allowed / requested))
        lines.append(
            f"thinner than requested at {thinner.sum()} of {len(thinner)} corners, where the wall "
            f"would fold or meet itself; least {wall.allowed[thinnest]:.3g} for "
            f"{requested[thinnest]:.3g} at {format_position(divided.points[thinnest])}"
        )
    if wall.straight:
        lines.append(f"{wall.straight} edges are straight: curved ones would invert elements")
    return lines


def _halved(face: Integers) -> Integers:
    """Split each triangle of degree 2 into four triangles."""
    return face[:, [0, 3, 5, 3, 1, 4, 5, 4, 2, 3, 4, 5]].reshape(-1, 3)


def _check_units(radius: float, size: float, thickness: Array) -> None:
    """Check that the lengths are plausible for a vessel of this mean radius of the lumen."""
    for option, length in (
        ("--thickness", thickness.max()),
        ("--thickness", thickness.min()),
        ("--size", size),
    ):
        if length > MOST_RADII * radius or (
            option == "--thickness" and length < LEAST_RADII * radius
        ):
            raise SceneError(
                f"{option}: {length:.3g} is {length / radius:.3g} times the lumen's radius, which "
                f"is {radius:.3g}: is it in another unit than the surface?"
            )


def _thicknesses(said: Sequence[str]) -> dict[str, float]:
    """Parse the thickness of each layer, by name."""
    layers: dict[str, float] = {}
    for text in said:
        name, _, number = text.partition("=")
        if not name.isidentifier() or name in layers or (value := _positive(number)) is None:
            raise SceneError(
                f"--layers {text}: must be NAME=THICKNESS, each name once, from the lumen outwards"
            )
        layers[name] = value
    return layers


def _thickness(said: str | None, layers: Mapping[str, float], surface: Surface) -> Array:
    """Return the thickness at the points, (n,): a number, an array, or the layers' sum."""
    whole = sum(layers.values())
    if said is None and not layers:
        raise SceneError(
            "--thickness: missing; must be a number or an array of the surface; or set --layers"
        )
    value = _positive(said or "")
    if said is None or value is not None:
        number = value or whole
        if layers and not np.isclose(number, whole):
            raise SceneError(f"--thickness {said}: the sum of --layers is {whole:g}; omit one")
        return np.full(len(surface.points), number)
    if said not in surface.arrays:
        known = ", ".join(surface.arrays) or "none"
        raise SceneError(
            f"--thickness {said}: must be a positive number, or an array at the points: {known}"
        )
    if not ((surface.arrays[said] > 0) & np.isfinite(surface.arrays[said])).all():
        raise SceneError(f"--thickness {said}: values of the array must be positive and finite")
    return surface.arrays[said]


def _positive(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if 0.0 < value < np.inf else None
