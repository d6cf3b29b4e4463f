"""How faces of an own body are held: potentials over them, and the rigid motions that these leave free."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from remodel_fenicsx.body.mesh_faces import Boundary
from remodel_fenicsx.body.mesh_file import Array
from remodel_fenicsx.settings import Support

if TYPE_CHECKING:
    from remodel_fenicsx.body.loading import Loading
    from remodel_fenicsx.body.mesh_domain import MeshDomain

GUIDE = 1000.0  # default stiffness over (lambda + 2 mu) / thickness: radii of the paper's tube within 2e-5 of exact ones
STILL = 1e-8  # smallest eigenvalue over the largest below which nothing holds a rigid motion


def add_support(
    loading: Loading, face: str, support: Support, stiffness: float, moves: tuple[str, float] | None
) -> None:
    """Hold a face.

    Parameters
    ----------
    loading
        Of the body.
    face, support
        Name of the face, and how it is held.
    stiffness
        Where the support does not say it.
    moves
        Name of the load by which the face moves along its normal, and the way at 1; None: it stays.
    """
    _KINDS[support.kind](loading, face, support, support.stiffness or stiffness, moves)


def _guided(loading: Loading, face: str, support: Support, stiffness: float, moves: tuple[str, float] | None) -> None:
    """k/2 ((u . N - d)^2 + (u . c)^2)."""
    import ufl

    normal, centre = _of_parts(loading, face, "normal"), _of_parts(loading, face, "centre")
    around = ufl.cross(normal, ufl.SpatialCoordinate(loading.domain.mesh) - centre)
    unit = around / ufl.sqrt(ufl.inner(around, around) + 1e-24 * loading.domain.size**2)
    way = loading.magnitude(*moves) if moves else 0.0
    _add(loading, face, stiffness, lambda u: (ufl.inner(u, normal) - way) ** 2 + ufl.inner(u, unit) ** 2)


def _sliding(loading: Loading, face: str, support: Support, stiffness: float, moves: tuple[str, float] | None) -> None:
    """k/2 (u . N - d)^2."""
    import ufl

    normal = _of_parts(loading, face, "normal")
    way = loading.magnitude(*moves) if moves else 0.0
    _add(loading, face, stiffness, lambda u: (ufl.inner(u, normal) - way) ** 2)


def _elastic(loading: Loading, face: str, support: Support, stiffness: float, moves: tuple[str, float] | None) -> None:
    """k/2 ((u . N)^2 + s |u - (u . N) N|^2), N of the place."""
    import ufl

    share = loading.constant(support.tangential)
    normal = ufl.FacetNormal(loading.domain.mesh)

    def density(u: Any) -> Any:
        along = ufl.inner(u, normal)
        return share * ufl.inner(u, u) + (1 - share) * along**2

    _add(loading, face, stiffness, density)


def _held(loading: Loading, face: str, support: Support, stiffness: float, moves: tuple[str, float] | None) -> None:
    """u = d N."""
    loading.prescribe_displacement(face, _of_parts(loading, face, "normal"), moves)


def _free(loading: Loading, face: str, support: Support, stiffness: float, moves: tuple[str, float] | None) -> None:
    """Nothing."""


_KINDS: dict[str, Callable[[Loading, str, Support, float, tuple[str, float] | None], None]] = {
    "guided": _guided,
    "sliding": _sliding,
    "held": _held,
    "elastic": _elastic,
    "free": _free,
}


def _add(loading: Loading, face: str, stiffness: float, density: Callable[[Any], Any]) -> None:
    half, measure = loading.constant(stiffness / 2), loading.surface_measure(face)
    loading.add_potential(lambda u: half * density(loading.kinematics.displacement(u)) * measure)


def _of_parts(loading: Loading, face: str, name: str) -> Any:
    """A vector of each part of the face, as a function that is constant on elements."""
    import basix.ufl
    import dolfinx.fem

    domain: MeshDomain = loading.domain  # type: ignore[assignment]
    element = basix.ufl.element("DG", domain.mesh.topology.cell_name(), 0, shape=(3,))
    field: Any = dolfinx.fem.Function(dolfinx.fem.functionspace(domain.mesh, element))
    values = domain.of_part(face, lambda part: getattr(part, name))
    field.x.array.reshape(-1, 3)[np.asarray(field.function_space.dofmap.list).reshape(-1)] = values
    return field


# ---------------------------------------------------------------- rigid motions


def free_motions(boundary: Boundary, places: Array, supports: Mapping[str, Support]) -> list[str]:
    """Rigid motions of the body that no support holds, in words.

    Parameters
    ----------
    boundary, places
        Of the body, and its nodes.
    supports
        By name of the face.
    """
    middle = places.mean(axis=0)
    size = float(np.linalg.norm(places - middle, axis=1).max())
    matrix = np.zeros((6, 6))
    for part in boundary.faces:
        support = supports.get(part.name)
        if support is None or support.kind == "free":
            continue
        corners = places[boundary.facets[part.facets]]
        at = corners.mean(axis=1)
        motions = _motions((at - middle) / size)
        held = _held_directions(support, part.normal, at - part.centre, corners)
        matrix += np.einsum("fki,fij,flj->kl", motions, held, motions) / len(at)
    values, vectors = np.linalg.eigh(matrix)
    still = vectors[:, values <= STILL * max(float(values[-1]), 1e-300)]
    return [_in_words(motion, middle, size) for motion in _plain(still).T]


def _motions(places: Array) -> Array:
    """Displacements of the six unit motions at places (facets, 3): three along, three about the axes, (facets, 6, 3)."""
    turns = np.cross(np.eye(3)[None], places[:, None])
    return np.concatenate([np.broadcast_to(np.eye(3), turns.shape), turns], axis=1)


def _held_directions(support: Support, normal: Array, from_centre: Array, corners: Array) -> Array:
    """What a support holds at facets, as projections (facets, 3, 3)."""
    along = np.broadcast_to(np.outer(normal, normal), (len(from_centre), 3, 3))
    around = np.cross(normal, from_centre)
    around /= np.maximum(np.linalg.norm(around, axis=1, keepdims=True), 1e-300)
    own = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    own /= np.linalg.norm(own, axis=1, keepdims=True)
    share, springs = support.tangential, np.einsum("fi,fj->fij", own, own)
    return {
        "guided": along + np.einsum("fi,fj->fij", around, around),
        "sliding": along,
        "held": np.broadcast_to(np.eye(3), along.shape),
        "elastic": share * np.eye(3) + (1 - share) * springs,
    }[support.kind]


def _plain(motions: Array) -> Array:
    """Another basis of the same motions, (6, n), each with as many zeros as can be: Gauss-Jordan with pivots."""
    rows = motions.T.copy()
    for row in range(len(rows)):
        column = int(np.argmax(np.abs(rows[row:]).max(axis=0)))
        pivot = row + int(np.argmax(np.abs(rows[row:, column])))
        rows[[row, pivot]] = rows[[pivot, row]]
        rows[row] /= rows[row, column]
        others = np.arange(len(rows)) != row
        rows[others] -= np.outer(rows[others, column], rows[row])
    return np.asarray(rows.T)


def _in_words(motion: Array, middle: Array, size: float) -> str:
    """A rigid motion: along a direction, or about an axis through a place."""
    shift, turn = motion[:3], motion[3:] / size
    if np.linalg.norm(motion[3:]) <= 1e-6 * np.linalg.norm(shift):
        return f"move along {_vector(shift / np.linalg.norm(shift))}"
    axis = turn / np.linalg.norm(turn)
    through = middle + np.cross(turn, shift) / (turn @ turn)
    return f"turn about {_vector(axis)} through {_vector(through)}"


def _vector(values: Array) -> str:
    tidy = np.where(np.abs(values) < 5e-4 * max(1.0, float(np.abs(values).max())), 0.0, values)
    return "(" + ", ".join(f"{value:.3g}" for value in tidy) + ")"
