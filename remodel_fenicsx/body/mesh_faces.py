"""Faces of a mesh of one's own: which facets they have, their normals and rims, and whether they bound one body."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx._lazy import Late
from remodel_fenicsx.body.mesh_file import MeshFile, as_rows, distinct, in_place
from remodel_fenicsx.errors import UnreadableFile
from remodel_fenicsx.model.tensors import Array, Flags, Integers, det

log = logging.getLogger(__name__)
dolfinx, basix = Late("dolfinx"), Late("basix")

# corners of the facets of an element and of the edges around a facet, in Gmsh's order; the normals point outwards
FACETS = {
    "tetrahedron": ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)),
    "hexahedron": ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
}
FLAT = 1e-12  # of the mean |det J| of the elements: below it one has no volume
ROLES = ("inner", "outer", "inlet", "outlet")  # faces of a vessel
NOT_AROUND = 0.5  # length of the mean normal of a face that has a direction: that of a half sphere
Groups = Mapping[str, Sequence[int]]


class FaceError(UnreadableFile):
    """A fault of one face, under its name."""

    def __init__(self, face: str, rule: str):
        super().__init__(rule)
        self.face = face


class Face:
    """A connected part of a named face: its facets, and their corners, (facets, 3 or 4, 3)."""

    def __init__(self, name: str, facets: Integers, corners: Array):
        vectors = area_vectors(corners)
        sizes, mean = np.linalg.norm(vectors, axis=1), vectors.sum(axis=0)
        self.name, self.facets, self.corners, self.area = name, facets, corners, float(sizes.sum())
        self.places, self.normals = corners.mean(axis=1), vectors / sizes[:, None]
        self.normal = mean / max(float(np.linalg.norm(mean)), 1e-300)
        self.centre = sizes @ self.places / self.area
        # 1 of a plane part, 0 of one that goes around
        self.flatness = float(np.linalg.norm(self.normals.mean(axis=0)))


@dataclass(frozen=True, eq=False)
class Boundary:
    """What bounds a body: facets, the elements behind them, and the names of their faces or ""."""

    facets: Integers
    cell: Integers
    owner: NDArray[np.object_]
    faces: list[Face]
    volume: float

    def parts(self, name: str) -> list[Face]:
        """The connected parts of a named face."""
        return [face for face in self.faces if face.name == name]

    def area(self, name: str) -> float:
        """Of a named face."""
        return sum(face.area for face in self.parts(name))

    def goes_around(self, name: str) -> bool:
        """Whether a part of a named face has no direction."""
        return min(face.flatness for face in self.parts(name)) < NOT_AROUND


def boundary_of(file: MeshFile, groups: Groups, open_boundary: bool, others: Groups = MappingProxyType({})) -> Boundary:
    """Find the named faces on the boundary of the one body that a file holds, and others where they are faces."""
    facets, cell, twice = _facets(file)
    places = file.points[facets]
    owner = np.full(len(facets), "", dtype=object)
    index = {corners: row for row, corners in enumerate(as_rows(np.sort(facets, axis=1)))}
    for name, numbers in (*groups.items(), *others.items()):
        keys = as_rows(np.sort(file.facets[np.isin(file.facet_groups, numbers)], axis=1))
        found: list[Any] = [index.get(key) for key in keys]
        for key, row in zip(keys, found, strict=True):
            if row is not None and owner[row] in ("", name):
                continue
            if name in others:
                log.info("face %r of the file is inside, or shares facets with others: left out", name)
                break
            words = "has facets that are no facets of its elements"
            if row is not None:
                words = f"shares facets with the face {owner[row]!r}"
            elif key in as_rows(np.sort(twice, axis=1)):
                words = "has facets inside the body"
            raise FaceError(name, f"{words}, the first at {in_place(file.points[list(key)].mean(axis=0))}")
        else:
            owner[found] = name
    bare = owner == ""
    if bare.any() and not open_boundary:
        where, share = in_place(places[bare][0].mean(axis=0)), bare.sum()
        rule = f"{share} of {len(bare)} facets of the boundary are in no face of geometry.faces, the first at {where}"
        raise UnreadableFile(rule + "; if that is meant: geometry.open_boundary = true")
    faces = []
    for name in (*groups, *others):
        rows = np.flatnonzero(owner == name)
        label = components(facets[rows], len(file.points))
        parts = (rows[label == one] for one in distinct(label))
        faces += [Face(name, part, places[part]) for part in parts]
    volume = float(np.einsum("fi,fi->", places.mean(axis=1), area_vectors(places)) / 3)
    return Boundary(facets, cell, owner, faces, volume)


def again(corners: Integers, groups: Integers, numbers: Collection[int]) -> Flags:
    """Which elements or facets of other groups are also in groups of these numbers, (rows,)."""
    chosen = np.isin(groups, list(numbers))
    _, which = np.unique(np.sort(corners, axis=1), axis=0, return_inverse=True)
    return ~chosen & np.isin(which.reshape(-1), which.reshape(-1)[chosen])


def through_the_wall(boundary: Boundary) -> bool:
    """Whether an element has facets on the inner and on the outer face."""
    inner, outer = (boundary.cell[boundary.owner == name] for name in ("inner", "outer"))
    return bool(np.isin(inner, outer).any())


def rims_of(file: MeshFile, boundary: Boundary, face: str) -> list[Integers]:
    """The closed lines in which a face ends, each as nodes of its edges, (edges, 2 or 3: start, end, middle)."""
    # They run so that the normal of a flat cap on one points out of what the face encloses.
    there = boundary.owner == face
    lines = rims(boundary.facets[there])
    if file.degree == 1:
        return lines
    element = basix.create_element(basix.ElementFamily.P, basix.CellType[file.kind], 2)
    edges = file.cells[boundary.cell[there]][:, node_order(file)][:, np.array(element.entity_closure_dofs[1])]
    middles = {frozenset(ends): middle for *ends, middle in as_rows(edges.reshape(-1, 3))}
    return [np.column_stack([line, [middles[frozenset(ends)] for ends in as_rows(line)]]) for line in lines]


def rims(facets: Integers) -> list[Integers]:
    """The closed lines in which facets end, each as its edges (n, 2), as the facets go along them."""
    edges = np.stack([facets, np.roll(facets, -1, axis=1)], axis=-1).reshape(-1, 2)
    _, first, count = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    alone = np.sort(first[count == 1])
    label = components(edges[alone], int(facets.max(initial=0)) + 1)
    return [edges[alone[label == one]] for one in distinct(label)]


def cap_volume(points: Array, rim: Integers) -> float:
    """Of the cone between the origin and a flat cap on a closed line of straight or parabolic edges."""
    a, b = points[rim[:, 0]], points[rim[:, 1]]
    m = points[rim[:, 2]] if rim.shape[1] == 3 else (a + b) / 2
    vector = (4 * (np.cross(a, m) + np.cross(m, b)) - np.cross(a, b)).sum(axis=0) / 6  # area times normal
    return float(a.mean(axis=0) @ vector / 3)


def components(rows: Integers, nodes: int) -> Integers:
    """Number of the connected part of each row, which share nodes; (rows,)."""
    from scipy.sparse import coo_array, csgraph

    first = np.repeat(rows[:, :1], rows.shape[1], axis=1)
    shared = coo_array((np.ones(rows.size), (first.ravel(), rows.ravel())), shape=(nodes, nodes))
    _, label = csgraph.connected_components(shared, directed=False)
    return np.asarray(label[rows[:, 0]], dtype=np.int64)


# ---------------------------------------------------------------- inside


def _facets(file: MeshFile) -> tuple[Integers, Integers, Integers]:
    """Facets of the boundary with normals outwards, the elements behind them, and the facets between two elements."""
    signs = _checked_signs(file)  # elements may be numbered as in a mirror
    local = np.array(FACETS[file.kind])
    facets = file.corners[:, local].reshape(-1, local.shape[1])
    _, first, inverse, count = np.unique(
        np.sort(facets, axis=1), axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    if (count > 2).any():
        bad = int(first[count > 2][0]) // len(local)
        raise UnreadableFile(f"element {file.cell_numbers[bad]} shares a facet with two others")
    one = np.flatnonzero(count[inverse.reshape(-1)] == 1)
    facets_one, cell = facets[one], one // len(local)
    flipped = signs[cell] < 0
    facets_one[flipped] = facets_one[flipped][:, ::-1]
    return facets_one, cell, facets[first[count == 2]]


def _checked_signs(file: MeshFile) -> Array:
    """Of det J of each element; refused is what is not one body of elements that have a volume, none twice."""
    ordered = np.sort(file.corners, axis=1)
    _, first, count = np.unique(ordered, axis=0, return_index=True, return_counts=True)
    if (count > 1).any():
        rule = "is there twice: in two named volumes?"
        raise UnreadableFile(f"element {file.cell_numbers[first[count > 1][0]]} {rule}")
    extent = np.ptp(file.points, axis=0).max()
    if extent == 0:
        raise UnreadableFile("all nodes are at one place")
    bodies = len(distinct(components(file.corners, len(file.points))))
    if bodies > 1:
        raise UnreadableFile(f"{bodies} bodies that have no node in common; allowed is one (in Gmsh: BooleanFragments)")
    determinants = jacobian_determinants(file)
    signs: Array = np.sign(determinants.mean(axis=1))
    bad = np.flatnonzero((determinants * signs[:, None]).min(axis=1) <= FLAT * np.abs(determinants).mean())
    if len(bad):
        cell = int(bad[0])
        where = in_place(file.points[file.corners[cell]].mean(axis=0))
        raise UnreadableFile(
            f"element {file.cell_numbers[cell]} at {where} is twisted or flat: its volume is not above zero "
            f"everywhere in it ({len(bad)} such element{'s' if len(bad) > 1 else ''})"
        )
    return signs


def jacobian_determinants(file: MeshFile) -> Array:
    """det J at the quadrature points of each element, (elements, points)."""
    kind = basix.CellType[file.kind]
    points, _ = basix.make_quadrature(kind, 2 * file.degree)
    element = basix.create_element(basix.ElementFamily.P, kind, file.degree, basix.LagrangeVariant.gll_warped)
    table: Any = element.tabulate(1, np.asarray(points))
    slopes = table[1:, :, :, 0]  # (3, points, nodes)
    nodes = file.points[file.cells[:, node_order(file)]]
    jacobians = np.tensordot(nodes, slopes, axes=(1, 2))  # (elements, coordinates, directions, points)
    return det(np.moveaxis(jacobians, 3, 1))


def node_order(file: MeshFile) -> Integers:
    """dolfinx's order of an element's nodes, as places in Gmsh's."""
    kind = getattr(dolfinx.mesh.CellType, file.kind)
    return np.asarray(dolfinx.cpp.io.perm_gmsh(kind, file.cells.shape[1]), dtype=np.int64)


def area_vectors(places: Array) -> Array:
    """Area times normal of facets at (facets, 3 or 4, 3): half the cross product of two edges, or of the diagonals."""
    if places.shape[1] == 3:
        return np.cross(places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]) / 2
    return np.cross(places[:, 2] - places[:, 0], places[:, 3] - places[:, 1]) / 2
