"""How faces of an own body are held: potentials over them, and the rigid motions that these leave free."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from remodel_fenicsx.body.mesh_faces import Face
from remodel_fenicsx.body.mesh_file import Array
from remodel_fenicsx.schema.settings import Support
from remodel_fenicsx.schema.tables import SceneError

if TYPE_CHECKING:
    from remodel_fenicsx.body.loading import Loading
    from remodel_fenicsx.body.mesh_domain import MeshDomain

log = logging.getLogger(__name__)
Density = Callable[[Any], Any]

GUIDE = (
    1000.0  # default stiffness over (lambda + 2 mu) / thickness: radii of the paper's tube within 2e-5 of exact ones
)
PARALLEL = 1e-3  # radians between normals: what a mesh in single precision has
LEAST_TANGENTIAL = 0.5  # measured with ends held: 0 has one or two negative eigenvalues, 0.3 and 1 have none
STILL = 1e-8  # smallest eigenvalue over the largest below which nothing holds a rigid motion


def add_support(
    loading: Loading, face: str, support: Support, stiffness: float, moves: tuple[str, float] | None
) -> None:
    """Hold a face, which a load may move along its normal: its name, and how far at magnitude 1."""
    if support.kind == "held":  # u = d N
        domain: MeshDomain = loading.domain  # type: ignore[assignment]
        for part, facets in domain.facets_of_parts(face):
            loading.hold_facets(facets, *((moves[0], moves[1] * part.normal) if moves else ()))
    elif support.kind in _DENSITIES:
        density = _DENSITIES[support.kind](loading, face, support, moves)
        half, measure = loading.constant((support.stiffness or stiffness) / 2), loading.surface_measure(face)
        loading.add_potential(lambda u: half * density(loading.kinematics.displacement(u)) * loading.weight * measure)


def _guided(loading: Loading, face: str, support: Support, moves: tuple[str, float] | None) -> Density:
    """(u . N - d)^2 + (u . c)^2."""
    import ufl

    sliding = _sliding(loading, face, support, moves)
    normal, centre = _of_parts(loading, face, "normal"), _of_parts(loading, face, "centre")
    around = ufl.cross(normal, ufl.SpatialCoordinate(loading.domain.mesh) - centre)
    # a Constant: a number in the kernel would be another kernel for each mesh
    squared = ufl.inner(around, around) + loading.constant(1e-24 * loading.domain.size**2)
    return lambda u: sliding(u) + ufl.inner(u, around) ** 2 / squared


def _sliding(loading: Loading, face: str, support: Support, moves: tuple[str, float] | None) -> Density:
    """(u . N - d)^2."""
    import ufl

    normal = _of_parts(loading, face, "normal")
    way = loading.magnitude(*moves) if moves else 0.0
    return lambda u: (ufl.inner(u, normal) - way) ** 2


def _elastic(loading: Loading, face: str, support: Support, moves: tuple[str, float] | None) -> Density:
    """(u . N)^2 + s |u - (u . N) N|^2, N of the place."""
    import ufl

    share, normal = loading.constant(support.tangential), ufl.FacetNormal(loading.domain.mesh)
    return lambda u: share * ufl.inner(u, u) + (1 - share) * ufl.inner(u, normal) ** 2


# what a face's springs store over half of their stiffness, by the kind of support
_DENSITIES: dict[str, Callable[[Loading, str, Support, tuple[str, float] | None], Density]] = {
    "guided": _guided,
    "sliding": _sliding,
    "elastic": _elastic,
}


def _of_parts(loading: Loading, face: str, name: str) -> Any:
    """A vector of each part of the face, as a function that is constant on elements."""
    import basix.ufl
    import dolfinx.fem

    domain: MeshDomain = loading.domain  # type: ignore[assignment]
    element = basix.ufl.element("DG", domain.mesh.topology.cell_name(), 0, shape=(3,))
    field: Any = dolfinx.fem.Function(dolfinx.fem.functionspace(domain.mesh, element))
    values = domain.of_parts(face, name)
    field.x.array.reshape(-1, 3)[np.asarray(field.function_space.dofmap.list).reshape(-1)] = values
    return field


# ---------------------------------------------------------------- rigid motions


def check_supports(domain: MeshDomain, supports: Mapping[str, Support], elongated: bool) -> None:
    """Refuse supports that leave the body free to move as a whole, or, where it is elongated, to evade that."""
    free = free_motions(domain.parts, supports)
    if free:
        kinds = ", ".join(f"{name} {support.kind!r}" for name, support in supports.items()) or "none"
        raise SceneError(f"supports ({kinds}): they leave the body free to {' and to '.join(free)}")
    sliding = [part for part in domain.parts if supports.get(part.name, Support(kind="free")).kind == "sliding"]
    if elongated and len(sliding) == 2 and np.linalg.norm(np.cross(sliding[0].normal, sliding[1].normal)) > PARALLEL:
        raise SceneError(
            "loads.elongation: both ends slide and are not parallel, so the elongation would only shift the body, "
            "held by the pressure on its ends; allowed with an end that is 'guided' or 'held'"
        )
    for name, support in supports.items():
        warn_of_twist(name, support, domain.comm)


def warn_of_twist(name: str, support: Support, comm: Any) -> None:
    """Say so where springs may turn a body about its axis."""
    if support.kind == "elastic" and support.tangential < LEAST_TANGENTIAL and comm.rank == 0:
        log.warning(
            "supports.%s.tangential = %g: springs that hardly hold a wall across their direction push it sideways "
            "once it has grown, and it twists; with %g and more no wall has twisted",
            name, support.tangential, LEAST_TANGENTIAL,
        )  # fmt: skip


def free_motions(parts: Sequence[Face], supports: Mapping[str, Support]) -> list[str]:
    """Rigid motions of the body that no support holds, in words: of the 6 x 6 matrix of the supports over them."""
    everywhere = np.concatenate([part.places for part in parts])
    middle = everywhere.mean(axis=0)
    size = float(np.linalg.norm(everywhere - middle, axis=1).max())
    matrix = np.zeros((6, 6))
    for part in parts:
        support = supports.get(part.name)
        if support is not None and support.kind != "free":
            motions = _motions((part.places - middle) / size)
            matrix += np.einsum("fki,fij,flj->kl", motions, _held_directions(support, part), motions) / len(motions)
    values, vectors = np.linalg.eigh(matrix)
    still = vectors[:, values <= STILL * max(float(values[-1]), 1e-300)]
    return [_in_words(motion, middle, size) for motion in _plain(still).T]


def _motions(places: Array) -> Array:
    """Displacements (facets, 6, 3) of the unit motions along and about the axes at places (facets, 3)."""
    turns = np.cross(np.eye(3)[None], places[:, None])
    return np.concatenate([np.broadcast_to(np.eye(3), turns.shape), turns], axis=1)


def _held_directions(support: Support, part: Face) -> Array:
    """What a support holds at the facets of a part, as projections (facets, 3, 3)."""
    along = np.broadcast_to(np.outer(part.normal, part.normal), (len(part.places), 3, 3))
    around = np.cross(part.normal, part.places - part.centre)
    around /= np.maximum(np.linalg.norm(around, axis=1, keepdims=True), 1e-300)
    own = part.normals
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
