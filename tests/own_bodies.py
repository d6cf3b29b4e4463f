"""Bodies with an inner and an outer face, an inlet and an outlet, with their directions known or made by Gmsh."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import dolfinx.mesh
import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.body.domain import Domain, build_domain, symbolic_mesh
from remodel_fenicsx.body.axes import compute_local_axes
from remodel_fenicsx.fem.quadrature import Quadrature
from remodel_fenicsx.model.axes import LocalAxes

Array = NDArray[np.float64]
FACES: dict[str, Callable[[Array], NDArray[np.bool_]]] = {
    "inner": lambda x: np.isclose(np.hypot(x[0], x[1]), 1.0), "outer": lambda x: np.isclose(np.hypot(x[0], x[1]), 2.0),
    "inlet": lambda x: np.isclose(x[2], 0.0), "outlet": lambda x: np.isclose(x[2], 1.0),
}  # fmt: skip
# a hexahedron between its first and its last corner, in dolfinx's order
TETRAHEDRA = ((0, 1, 3, 7), (0, 1, 5, 7), (0, 2, 3, 7), (0, 2, 6, 7), (0, 4, 5, 7), (0, 4, 6, 7))


@dataclass(frozen=True)
class KnownBody:
    """A ring of blocks whose places and directions are closed forms.

    Attributes
    ----------
    place
        Places (n, 3) of shares from 0 to 1 around, through the wall and along, (n,) each.
    directions
        Circumferential and axial unit vectors at places (..., 3).
    depth
        At places; None where it is not known.
    """

    place: Callable[[Array, Array, Array], Array]
    directions: Callable[[Array], tuple[Array, Array]]
    depth: Callable[[Array], Array] | None = None


def bent(radii: tuple[float, float], bend: float, angle: float, leg: float = 0.0) -> KnownBody:
    """A tube along an arc in the plane y = 0 about (-bend, 0, 0), with straight legs at both ends."""
    inner, outer = radii
    arc = bend * angle
    axis = np.array([-bend, 0.0, 0.0])

    def frame(turn: Array) -> tuple[Array, Array]:
        zero = np.zeros_like(turn)
        return np.stack([np.cos(turn), zero, np.sin(turn)], -1), np.stack(
            [-np.sin(turn), zero, np.cos(turn)], -1
        )

    def place(around: Array, through: Array, along: Array) -> Array:
        radius, length = inner + through * (outer - inner), along * (arc + 2 * leg) - leg
        turn = np.clip(length / bend, 0.0, angle)
        outwards, ahead = frame(turn)
        x, y = radius * np.cos(2 * np.pi * around), radius * np.sin(2 * np.pi * around)
        rest = length - np.clip(length, 0.0, arc)
        return (
            axis
            + (bend + x)[:, None] * outwards
            + y[:, None] * np.eye(3)[1]
            + rest[:, None] * ahead
        )

    def local(places: Array) -> tuple[Array, Array, Array, Array]:
        turn = np.clip(np.arctan2(places[..., 2], places[..., 0] + bend), 0.0, angle)
        outwards, ahead = frame(turn)
        return np.sum((places - axis) * outwards, axis=-1) - bend, places[..., 1], outwards, ahead

    def directions(places: Array) -> tuple[Array, Array]:
        x, y, outwards, ahead = local(places)
        radius = np.hypot(x, y)[..., None]
        return (-y[..., None] * outwards + x[..., None] * np.eye(3)[1]) / radius, ahead

    def depth(places: Array) -> Array:
        x, y, _, _ = local(places)
        return (np.hypot(x, y) - inner) / (outer - inner)

    return KnownBody(place, directions, depth)


def straight(inner: float, outer: float, length: float) -> KnownBody:
    """About z."""

    def place(around: Array, through: Array, along: Array) -> Array:
        radius, turn = inner + through * (outer - inner), 2 * np.pi * around
        return np.stack([radius * np.cos(turn), radius * np.sin(turn), length * along], axis=-1)

    def directions(places: Array) -> tuple[Array, Array]:
        x, y, zero = places[..., 0], places[..., 1], np.zeros(places.shape[:-1])
        return np.stack([-y, x, zero], -1) / np.hypot(x, y)[..., None], np.stack(
            [zero, zero, zero + 1.0], -1
        )

    return KnownBody(
        place, directions, lambda x: (np.hypot(x[..., 0], x[..., 1]) - inner) / (outer - inner)
    )


def elliptic(inner: float, outer: float, focus: float, length: float) -> KnownBody:
    """Between confocal ellipses focus (cosh u cos v, sinh u sin v): the harmonic function is linear in u."""

    def place(around: Array, through: Array, along: Array) -> Array:
        u, v = inner + through * (outer - inner), 2 * np.pi * around
        return np.stack(
            [focus * np.cosh(u) * np.cos(v), focus * np.sinh(u) * np.sin(v), length * along],
            axis=-1,
        )

    def directions(places: Array) -> tuple[Array, Array]:
        w = np.arccosh((places[..., 0] + 1j * places[..., 1]) / focus)
        u, v, zero = (
            np.abs(w.real),
            np.where(w.real < 0, -w.imag, w.imag),
            np.zeros(places.shape[:-1]),
        )
        around = np.stack([-np.cosh(u) * np.sin(v), np.sinh(u) * np.cos(v), zero], -1)
        return around / np.linalg.norm(around, axis=-1)[..., None], np.stack(
            [zero, zero, zero + 1.0], -1
        )

    return KnownBody(place, directions)


def ring(
    place: Callable[[Array, Array, Array], Array],
    counts: tuple[int, int, int],
    kind: str,
    comm: Any = MPI.COMM_SELF,
) -> Domain:
    """The mesh of a body in blocks around, through and along; each is a hexahedron or six tetrahedra."""
    around, through, along = counts
    places = np.indices((around, through + 1, along + 1)).reshape(3, -1)
    number = np.arange(places.shape[1]).reshape(around, through + 1, along + 1)
    corners = []
    for corner in range(8):
        i, j, k = corner & 1, corner >> 1 & 1, corner >> 2
        corners.append(np.roll(number, -i, axis=0)[:, j : through + j, k : along + k].ravel())
    hexahedra = np.stack(corners, axis=1)
    cells = (
        hexahedra
        if kind == "hexahedron"
        else np.concatenate([hexahedra[:, list(those)] for those in TETRAHEDRA])
    )
    here = slice(None) if comm.rank == 0 else slice(0)
    shares = places / np.array(counts)[:, None]
    tube = straight(1.0, 2.0, 1.0).place(*shares)  # on which the faces are easily told apart
    mesh: Any = dolfinx.mesh.create_mesh(
        comm, cells=cells[here], x=tube[here], e=symbolic_mesh(kind, 1)
    )
    found = [dolfinx.mesh.locate_entities_boundary(mesh, 2, marker) for marker in FACES.values()]
    facets, values = np.concatenate(found), np.repeat(
        np.arange(1, 5, dtype=np.int32), list(map(len, found))
    )
    order = np.argsort(facets)
    tags = dolfinx.mesh.meshtags(mesh, 2, facets[order], values[order])
    mesh.geometry.x[:] = place(*shares)[mesh.geometry.input_global_indices]
    return Domain(
        mesh, tags, {name: tag for tag, name in enumerate(FACES, start=1)}, "ring", {"size": 1.0}
    )


def fork(
    half_angle: float, size: float, radius: float = 1.0, wall: float = 0.4, length: float = 5.0
) -> Domain:
    """A trunk along z below the origin and two branches above, as Gmsh cuts and meshes it; both are its outlet."""
    branches = [half_angle * sign for sign in (-1.0, 1.0)]
    ways = [np.array([0.0, 0.0, -1.0])]  # the inlet, then the outlets
    ways += [np.array([np.sin(angle), 0.0, np.cos(angle)]) for angle in np.radians(branches)]

    def draw() -> None:
        import gmsh

        occ = gmsh.model.occ

        def solid(size: float) -> list[tuple[int, int]]:
            parts = [(3, occ.addCylinder(0, 0, 0, *(length * way), size)) for way in ways]
            fused, _ = occ.fuse([(3, occ.addSphere(0, 0, 0, size))], parts)
            return list(fused)

        body, _ = occ.cut(solid(radius + wall), solid(radius))
        occ.synchronize()
        groups: dict[str, list[int]] = {name: [] for name in FACES}
        for _, face in gmsh.model.getEntities(2):
            centre = np.array(occ.getCenterOfMass(2, face))
            at_end = [abs(centre @ way - length) < 1e-6 for way in ways]
            (low, other), (high, last) = gmsh.model.getParametrizationBounds(2, face)
            place = np.array(gmsh.model.getValue(2, face, [(low + high) / 2, (other + last) / 2]))
            away = min(float(np.linalg.norm(place - max(place @ way, 0.0) * way)) for way in ways)
            end = "inlet" if at_end[0] else "outlet" if any(at_end) else ""
            groups[end or ("inner" if away < radius + wall / 2 else "outer")].append(face)
        for name, faces in groups.items():
            gmsh.model.addPhysicalGroup(2, faces, name=name)
        gmsh.model.addPhysicalGroup(3, [tag for _, tag in body], name="body")
        gmsh.option.setNumber("Mesh.MeshSizeMax", size)
        gmsh.option.setNumber("Mesh.MeshSizeMin", size)
        gmsh.model.mesh.generate(3)

    return build_domain(draw, "fork", {"size": length}, MPI.COMM_SELF)


def found(domain: Domain, degree: int = 1) -> tuple[LocalAxes, Quadrature]:
    """Local axes of a mesh, and the points."""
    quadrature = Quadrature(domain.mesh, degree)
    return compute_local_axes(domain, quadrature), quadrature


def apart(one: Array, other: Array) -> Array:
    """Angle between two lines in degrees."""
    along = np.abs(np.sum(one * other, axis=-1))
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(one, other), axis=-1), along))


LEGS = bent((1.0, 2.0), bend=5.0, angle=np.pi / 2, leg=4.0)


def gathered_bend(comm: Any) -> dict[str, Array] | None:
    """Everything that is found of a bend with legs, by element of the input; on rank 0."""
    domain = ring(LEGS.place, (8, 2, 12), "tetrahedron", comm)
    made, _ = found(domain)
    values = {name: getattr(made, name) for name in ("axes", "depth", "station", "thickness")}
    whole = {name: domain.gather_elements(array) for name, array in values.items()}
    whole["nodal_depth"] = domain.gather_nodes(made.nodal_depth)
    return whole if comm.rank == 0 else None
