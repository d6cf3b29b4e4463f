"""Gmsh models: plane sections, extrusion, named faces, curved elements, limits. Without dolfinx."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from remodel_fenicsx._lazy import Late
from remodel_fenicsx.errors import RemodelError
from remodel_fenicsx.model.tensors import Array

gmsh: Any = Late("gmsh")  # the import takes 0.2 s, and only rank 0 needs it

# Gmsh merges points that are closer than 1e-8, and crashes on much longer or flatter bodies.
SMALLEST_LENGTH, LARGEST_LENGTH = 1e-6, 1e6
LARGEST_LENGTH_RATIO = 1e4


class GeometryError(RemodelError, RuntimeError):
    """Gmsh could not build or read a mesh; raised on all ranks.

    Examples
    --------
    The text is one line:

    >>> from remodel_fenicsx import parts
    >>> raise parts.GeometryError("Gmsh could not mesh the tube")
    Traceback (most recent call last):
        ...
    remodel_fenicsx.body.gmsh_model.GeometryError: Gmsh could not mesh the tube
    """


def mesh_length_problem(lengths: Mapping[str, float]) -> tuple[str, str] | None:
    """Return the name of a length that prevents meshing, and the rule that it breaks, or None."""
    for name, length in lengths.items():
        if not SMALLEST_LENGTH <= length <= LARGEST_LENGTH:
            return name, f"{length:g} long; must be {SMALLEST_LENGTH:g} to {LARGEST_LENGTH:g}"
    smallest, largest = min(lengths, key=lambda k: lengths[k]), max(
        lengths, key=lambda k: lengths[k]
    )
    if lengths[largest] <= LARGEST_LENGTH_RATIO * lengths[smallest]:
        return None
    return smallest, (
        f"{lengths[smallest]:g} long, too small for a length of {lengths[largest]:g}; "
        f"their ratio must be at most {LARGEST_LENGTH_RATIO:g}"
    )


@contextmanager
def gmsh_model(name: str) -> Iterator[Any]:
    """Create a new, silent Gmsh model, and restore Gmsh's previous state when the block ends."""
    foreign = gmsh.isInitialized()
    if not foreign:
        # A ~/.gmshrc could change the mesh. Not interruptible: Python handles Ctrl-C.
        gmsh.initialize(readConfigFiles=False, interruptible=False)
    terminal = gmsh.option.getNumber("General.Terminal")
    gmsh.option.setNumber("General.Terminal", 0)
    previous = gmsh.model.getCurrent() if foreign else ""
    gmsh.model.add(name)
    try:
        yield gmsh
    finally:
        if foreign:  # keep the models of a script that uses Gmsh itself
            gmsh.model.remove()
            gmsh.model.setCurrent(previous)
            gmsh.option.setNumber("General.Terminal", terminal)
        else:
            gmsh.finalize()


def named_groups() -> tuple[dict[str, int], dict[str, int]]:
    """Return the numbers of the model's faces and disjoint regions by name."""
    # dolfinx checks these conditions only on rank 0. A failure there would leave the other ranks
    # waiting.
    faces, regions = _groups(2), _groups(3)
    kinds, *_ = gmsh.model.mesh.getElements(3)
    if not regions or len(kinds) != 1 or not faces:
        raise GeometryError(
            f"{len(regions)} named volumes, {len(kinds)} types of elements, "
            f"{len(faces)} named faces; must be at least 1, exactly 1 and at least 1"
        )
    for _, volume in gmsh.model.getEntities(3):
        groups = gmsh.model.getPhysicalGroupsForEntity(3, volume)
        if len(groups) != 1 and len(gmsh.model.mesh.getElements(3, volume)[0]):
            names = (
                " and ".join(repr(name) for name, tag in regions.items() if tag in groups)
                or "no physical group"
            )
            raise GeometryError(f"volume {volume} is in {names}; a volume must be in one group")
    return faces, regions


def _groups(dimension: int) -> dict[str, int]:
    tags = [tag for _, tag in gmsh.model.getPhysicalGroups(dimension)]
    names = [gmsh.model.getPhysicalName(dimension, tag) or str(tag) for tag in tags]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise GeometryError(f"two physical groups have the name {twice!r}; rename one")
    return dict(zip(names, tags, strict=True))


# ---------------------------------------------------------------- components of shapes
def circle(radius: float, number: int, start: int = 0) -> Array:
    """Return the corners of a regular polygon around the origin, (number, 2).

    Corner `start` is the first one; corner 0 is on the x axis.
    """
    angle = 2.0 * np.pi * (start + np.arange(number)) / number
    corners = np.column_stack((np.cos(angle), np.sin(angle)))
    corners[np.abs(corners) < 1e-15] = 0.0  # nodes on the axes have exact zeros
    return radius * corners


class Point(NamedTuple):
    """Point of the plane z = 0 that is a node of the mesh."""

    tag: int
    x: float
    y: float


def points(coordinates: Array) -> list[Point]:
    """Add points at coordinates (n, 2)."""
    pairs = [(float(x), float(y)) for x, y in coordinates]
    return [Point(gmsh.model.geo.addPoint(x, y, 0.0), x, y) for x, y in pairs]


def line(start: Point, stop: Point, elements: int = 1) -> list[int]:
    """Add a straight chain of equal curves of one element each."""
    # Every node is prescribed, as on circles, because Gmsh's own nodes along a curve are accurate
    # only to 1e-12 on straight lines and to 1e-9 on arcs.
    geo = gmsh.model.geo
    fraction = np.arange(1, elements)[:, None] / elements
    between = points((1.0 - fraction) * np.array(start[1:]) + fraction * np.array(stop[1:]))
    chain = [start, *between, stop]
    curves = [geo.addLine(a.tag, b.tag) for a, b in zip(chain[:-1], chain[1:], strict=True)]
    for curve in curves:
        geo.mesh.setTransfiniteCurve(curve, 2)
    return curves


def polygon(corners: Sequence[Point], is_closed: bool = True) -> list[int]:
    """Add a chain of straight curves of one element each; curve i starts at corner i."""
    chain = [*corners, corners[0]] if is_closed else corners
    return [line(start, stop)[0] for start, stop in itertools.pairwise(chain)]


def block(edges: Sequence[Sequence[int]], corners: Sequence[Point], element: str) -> int:
    """Add a structured plane surface between four sides (chains of curves) and four corners."""
    geo = gmsh.model.geo
    surface = geo.addPlaneSurface([geo.addCurveLoop([curve for side in edges for curve in side])])
    geo.mesh.setTransfiniteSurface(surface, cornerTags=[corner.tag for corner in corners])
    if element == "hexahedron":
        geo.mesh.setRecombine(2, surface)
    return surface


def reverse(curves: Sequence[int]) -> list[int]:
    """Return a chain of curves in reverse direction."""
    return [-curve for curve in reversed(curves)]


def ring(
    inner: Sequence[Point], outer: Sequence[Point],
    inner_lines: Sequence[int], outer_lines: Sequence[int],
    spokes: Sequence[Sequence[int]], element: str,
) -> list[int]:  # fmt: skip
    """Add blocks between two open or closed polygons, from each spoke to the next."""
    number = len(spokes) - (len(inner) - len(inner_lines))
    part, blocks = len(inner_lines) // number, []
    for i in range(number):
        k, m = i * part, (i + 1) * part % len(inner)
        next_spoke = spokes[(i + 1) % len(spokes)]
        edges = [
            spokes[i],
            outer_lines[k : k + part],
            reverse(next_spoke),
            reverse(inner_lines[k : k + part]),
        ]
        blocks.append(block(edges, [inner[k], outer[k], outer[m], inner[m]], element))
    return blocks


def extrude(
    section: Sequence[int],
    length: float,
    layers: int,
    element: str,
    sides: Mapping[str, Sequence[int]],
    ends: tuple[str, str] = ("bottom", "top"),
) -> None:
    """Extrude a plane section along z, mesh it, and name the volume and the faces."""
    made = gmsh.model.geo.extrude(
        [(2, surface) for surface in section],
        0.0,
        0.0,
        length,
        numElements=[layers],
        recombine=element == "hexahedron",
    )
    gmsh.model.geo.synchronize()
    volumes = [tag for dimension, tag in made if dimension == 3]
    tops = [made[i - 1][1] for i, (dimension, _) in enumerate(made) if dimension == 3]
    groups = {ends[0]: list(section), ends[1]: tops}
    for name, curves in sides.items():
        # A boundary curve bounds only two faces: the section and the face that it sweeps.
        swept = {
            int(face) for curve in curves for face in gmsh.model.getAdjacencies(1, abs(curve))[0]
        }
        groups[name] = sorted(swept - set(section))
    for name, surfaces in groups.items():
        gmsh.model.addPhysicalGroup(2, surfaces, name=name)
    gmsh.model.addPhysicalGroup(3, volumes, name="body")
    gmsh.model.mesh.generate(3)


def raise_degree(degree: int, bulge: Callable[[Array], npt.NDArray[Any]]) -> None:
    """Add nodes between the corners of straight elements, and curve them around the z axis."""
    if degree == 1:
        return
    mesh = gmsh.model.mesh
    (straight,), _, _ = mesh.getElements(3)
    mesh.setOrder(degree)
    tags, coordinates, _ = mesh.getNodes()
    old = coordinates.reshape(-1, 3)
    row = np.zeros(int(tags.max()) + 1, dtype=np.int64)
    row[tags] = np.arange(len(tags))
    (kind,), _, (nodes,) = mesh.getElements(3)
    _, _, _, count, local, corners = mesh.getElementProperties(kind)
    cells = row[nodes].reshape(-1, count)
    weights = mesh.getBasisFunctions(straight, local[3 * corners :], "Lagrange")[1].reshape(
        -1, corners
    )
    mean = np.einsum("kc,ncd->nkd", weights, old[cells[:, :corners]])
    radius = np.hypot(*np.moveaxis(old[cells[:, :corners], :2], 2, 0)) @ weights.T
    chord = np.hypot(mean[..., 0], mean[..., 1])
    off_axis = chord > 1e-12 * radius.max()
    outwards = np.where(off_axis, radius / np.where(off_axis, chord, 1.0) - 1.0, 0.0)
    mean[..., :2] *= (1.0 + bulge(radius) * outwards)[..., None]
    between, first = np.unique(cells[:, corners:], return_index=True)
    for index, point in zip(between, mean.reshape(-1, 3)[first], strict=True):
        mesh.setNode(tags[index], point, [])
