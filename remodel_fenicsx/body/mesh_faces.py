"""Faces of user-supplied meshes: facets, normals and rims, and checks that they bound one body."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx._lazy import Late
from remodel_fenicsx.body.mesh_file import MeshFile, as_rows, unique_in_order, format_position
from remodel_fenicsx.errors import UnreadableFile
from remodel_fenicsx.model.tensors import Array, Flags, Integers, det

log = logging.getLogger(__name__)
dolfinx, basix = Late("dolfinx"), Late("basix")

# Corners of the facets of an element, in Gmsh's order, counterclockwise seen from outside.
FACETS = {
    "tetrahedron": ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)),
    "hexahedron": (
        (0, 3, 2, 1),
        (4, 5, 6, 7),
        (0, 1, 5, 4),
        (1, 2, 6, 5),
        (2, 3, 7, 6),
        (3, 0, 4, 7),
    ),
}
FLAT = 1e-12  # det J over the mean |det J| up to which an element is degenerate
ROLES = ("inner", "outer", "inlet", "outlet")  # faces of a vessel
NOT_AROUND = 0.5  # smallest mean unit normal of a face with a direction: that of a half sphere
Groups = Mapping[str, Sequence[int]]


class FaceError(UnreadableFile):
    """Error in one face, with the name of the face."""

    def __init__(self, face: str, rule: str):
        super().__init__(rule)
        self.face = face


class Face:
    """Connected part of a named face: its facets, and their corners, (facets, 3 or 4, 3)."""

    def __init__(self, name: str, facets: Integers, corners: Array):
        vectors = area_vectors(corners)
        sizes, mean = np.linalg.norm(vectors, axis=1), vectors.sum(axis=0)
        self.name, self.facets = name, facets
        self.corners, self.area = corners, float(sizes.sum())
        self.places, self.normals = corners.mean(axis=1), vectors / sizes[:, None]
        self.normal = mean / max(float(np.linalg.norm(mean)), 1e-300)
        self.centre = sizes @ self.places / self.area
        # 1 for a plane part, 0 for a closed one
        self.flatness = float(np.linalg.norm(self.normals.mean(axis=0)))


@dataclass(frozen=True, eq=False)
class Boundary:
    """Boundary of a body: facets, the elements behind them, and the names of their faces or ""."""

    facets: Integers
    cell: Integers
    owner: NDArray[np.object_]
    faces: list[Face]
    volume: float

    def parts(self, name: str) -> list[Face]:
        """Return the connected parts of a named face."""
        return [face for face in self.faces if face.name == name]

    def area(self, name: str) -> float:
        """Return the area of a named face."""
        return sum(face.area for face in self.parts(name))

    def goes_around(self, name: str) -> bool:
        """Return whether a part of a named face has no mean normal."""
        return min(face.flatness for face in self.parts(name)) < NOT_AROUND


def boundary_of(
    file: MeshFile, groups: Groups, open_boundary: bool, others: Groups = MappingProxyType({})
) -> Boundary:
    """Find the named faces on a body's boundary, and the other groups that are faces."""
    facets, cell, twice = _facets(file)
    places = file.points[facets]
    owner = np.full(len(facets), "", dtype=object)
    index = {corners: row for row, corners in enumerate(as_rows(np.sort(facets, axis=1)))}
    for name, numbers in (*groups.items(), *others.items()):
        keys = as_rows(np.sort(file.facets[np.isin(file.facet_groups, numbers)], axis=1))
        indices: list[Any] = [index.get(key) for key in keys]
        for key, row in zip(keys, indices, strict=True):
            if row is not None and owner[row] in ("", name):
                continue
            if name in others:
                log.info("face %r of the file ignored: inside, or shares facets with others", name)
                break
            words = "has facets that belong to no element"
            if row is not None:
                words = f"shares facets with the face {owner[row]!r}"
            elif key in as_rows(np.sort(twice, axis=1)):
                words = "has facets inside the body"
            raise FaceError(
                name,
                f"{words}, the first at {format_position(file.points[list(key)].mean(axis=0))}",
            )
        else:
            owner[indices] = name
    bare = owner == ""
    if bare.any() and not open_boundary:
        where, share = format_position(places[bare][0].mean(axis=0)), bare.sum()
        rule = f"{share} of {len(bare)} boundary facets are in no face, first at {where}"
        raise UnreadableFile(
            rule + "; add them to geometry.faces, or set geometry.open_boundary = true"
        )
    faces = []
    for name in (*groups, *others):
        rows = np.flatnonzero(owner == name)
        label = components(facets[rows], len(file.points))
        parts = (rows[label == one] for one in unique_in_order(label))
        faces += [Face(name, part, places[part]) for part in parts]
    volume = float(np.einsum("fi,fi->", places.mean(axis=1), area_vectors(places)) / 3)
    return Boundary(facets, cell, owner, faces, volume)


def shared_entities(corners: Integers, groups: Integers, numbers: Collection[int]) -> Flags:
    """Mark the elements or facets of other groups that are also in these groups, (rows,)."""
    chosen = np.isin(groups, list(numbers))
    _, which = np.unique(np.sort(corners, axis=1), axis=0, return_inverse=True)
    return ~chosen & np.isin(which.reshape(-1), which.reshape(-1)[chosen])


def through_the_wall(boundary: Boundary) -> bool:
    """Return whether an element has facets on the inner and on the outer face."""
    inner, outer = (boundary.cell[boundary.owner == name] for name in ("inner", "outer"))
    return bool(np.isin(inner, outer).any())


def rims_of(file: MeshFile, boundary: Boundary) -> list[Integers]:
    """Return the closed lines around the inner face, as edges (n, 2 or 3: start, end, middle)."""
    # The normal of a flat cap on such a line points out of the enclosed region.
    there = boundary.owner == "inner"
    lines = rims(boundary.facets[there])
    if file.degree == 1:
        return lines
    element = basix.create_element(basix.ElementFamily.P, basix.CellType[file.kind], 2)
    edges = file.cells[boundary.cell[there]][:, node_order(file)][
        :, np.array(element.entity_closure_dofs[1])
    ]
    middles = {frozenset(ends): middle for *ends, middle in as_rows(edges.reshape(-1, 3))}
    return [
        np.column_stack([line, [middles[frozenset(ends)] for ends in as_rows(line)]])
        for line in lines
    ]


def rims(facets: Integers) -> list[Integers]:
    """Return the closed lines that bound facets, as edges (n, 2) in the direction of the facets."""
    edges = np.stack([facets, np.roll(facets, -1, axis=1)], axis=-1).reshape(-1, 2)
    _, first, count = np.unique(
        np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True
    )
    alone = np.sort(first[count == 1])
    label = components(edges[alone], int(facets.max(initial=0)) + 1)
    return [edges[alone[label == one]] for one in unique_in_order(label)]


def cap_volume(points: Array, rim: Integers) -> float:
    """Return the volume of the cone between the origin and a flat cap on a line of edges."""
    a, b = points[rim[:, 0]], points[rim[:, 1]]
    m = points[rim[:, 2]] if rim.shape[1] == 3 else (a + b) / 2
    vector = (4 * (np.cross(a, m) + np.cross(m, b)) - np.cross(a, b)).sum(
        axis=0
    ) / 6  # area times normal
    return float(a.mean(axis=0) @ vector / 3)


def components(rows: Integers, nodes: int) -> Integers:
    """Return the number of each row's connected component, (rows,)."""
    from scipy.sparse import coo_array, csgraph

    first = np.repeat(rows[:, :1], rows.shape[1], axis=1)
    shared = coo_array((np.ones(rows.size), (first.ravel(), rows.ravel())), shape=(nodes, nodes))
    _, label = csgraph.connected_components(shared, directed=False)
    return np.asarray(label[rows[:, 0]], dtype=np.int64)


# ---------------------------------------------------------------- internals


def _facets(file: MeshFile) -> tuple[Integers, Integers, Integers]:
    """Return boundary facets oriented outwards, the elements behind them, and interior facets."""
    signs = _checked_signs(file)  # elements may have the order of a mirror image
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
    """Return the sign of det J of each element; raise unless they form one valid body."""
    ordered = np.sort(file.corners, axis=1)
    _, first, count = np.unique(ordered, axis=0, return_index=True, return_counts=True)
    if (count > 1).any():
        raise UnreadableFile(
            f"element {file.cell_numbers[first[count > 1][0]]} is duplicated: in two named volumes?"
        )
    extent = np.ptp(file.points, axis=0).max()
    if extent == 0:
        raise UnreadableFile("all nodes coincide")
    bodies = len(unique_in_order(components(file.corners, len(file.points))))
    if bodies > 1:
        raise UnreadableFile(
            f"{bodies} bodies without common nodes; must be one (in Gmsh: BooleanFragments)"
        )
    determinants = jacobian_determinants(file)
    signs: Array = np.sign(determinants.mean(axis=1))
    bad = np.flatnonzero(
        (determinants * signs[:, None]).min(axis=1) <= FLAT * np.abs(determinants).mean()
    )
    if len(bad):
        cell = int(bad[0])
        where = format_position(file.points[file.corners[cell]].mean(axis=0))
        raise UnreadableFile(
            f"element {file.cell_numbers[cell]} at {where} is inverted or degenerate: its Jacobian "
            f"is not positive ({len(bad)} such element{'s' if len(bad) > 1 else ''})"
        )
    return signs


def jacobian_determinants(file: MeshFile) -> Array:
    """Return det J at the quadrature points of each element, (elements, points)."""
    kind = basix.CellType[file.kind]
    points, _ = basix.make_quadrature(kind, 2 * file.degree)
    element = basix.create_element(
        basix.ElementFamily.P, kind, file.degree, basix.LagrangeVariant.gll_warped
    )
    table: Any = element.tabulate(1, np.asarray(points))
    slopes = table[1:, :, :, 0]  # (3, points, nodes)
    nodes = file.points[file.cells[:, node_order(file)]]
    jacobians = np.tensordot(
        nodes, slopes, axes=(1, 2)
    )  # (elements, coordinates, directions, points)
    return det(np.moveaxis(jacobians, 3, 1))


def node_order(file: MeshFile) -> Integers:
    """Return dolfinx's order of an element's nodes, as indices into Gmsh's order."""
    kind = getattr(dolfinx.mesh.CellType, file.kind)
    return np.asarray(dolfinx.cpp.io.perm_gmsh(kind, file.cells.shape[1]), dtype=np.int64)


def area_vectors(places: Array) -> Array:
    """Return area times normal of facets (facets, 3 or 4, 3): half the cross product of two edges.

    For quadrilaterals it is half the cross product of the diagonals.
    """
    if places.shape[1] == 3:
        return np.cross(places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]) / 2
    return np.cross(places[:, 2] - places[:, 0], places[:, 3] - places[:, 1]) / 2
