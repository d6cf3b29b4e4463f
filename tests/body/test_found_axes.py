"""Local axes that are found on a mesh, against closed forms: tube, torus, ellipse, bend with legs; forks; faults.

Limits in degrees are 1.2 times what the method was measured to reach when it was chosen (docs/my_own_vessel.md).
"""

from __future__ import annotations

import re
from dataclasses import replace

import dolfinx.mesh
import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx.body.axes import MOST_UNDEFINED, UndefinedAxes
from tests import own_bodies, parts
from tests.own_bodies import KnownBody, apart, bent, elliptic, fork, found, ring, straight
from tests.values import assert_orthonormal

TORUS = bent((1.0, 2.0), bend=6.0, angle=np.pi / 3)
BODIES = {
    "straight": (straight(1.0, 3.0, 8.0), (16, 4, 12)),
    "torus": (TORUS, (16, 4, 12)),
    "ellipse": (elliptic(0.7, 1.2, focus=2.0, length=8.0), (24, 4, 8)),
    "bend": (own_bodies.LEGS, (16, 3, 32)),
}


def error(
    body: KnownBody, counts: tuple[int, int, int], kind: str, number: int
) -> tuple[float, float]:
    """Root of the mean square and largest error of c (0) or a (1), degrees."""
    made, quadrature = found(ring(body.place, counts, kind))
    off = apart(made.axes[..., number, :], body.directions(quadrature.coordinates)[number])
    assert made.undefined is not None and not made.undefined.any()
    return float(np.sqrt(quadrature.mean(off**2))), float(off.max())


@pytest.mark.parametrize(
    "name, kind, rms, most",
    [
        ("straight", "hexahedron", 1e-6, 1e-6),
        ("straight", "tetrahedron", 0.28, 0.7),
        ("torus", "hexahedron", 0.76, 1.8),
        ("torus", "tetrahedron", 0.85, 1.8),
        ("ellipse", "hexahedron", 0.22, 0.5),
        ("ellipse", "tetrahedron", 0.53, 2.9),
    ],
)
def test_circumferential_direction(name: str, kind: str, rms: float, most: float) -> None:
    mean, largest = error(*BODIES[name], kind, 0)
    assert mean <= rms and largest <= most


@pytest.mark.parametrize("kind", ["hexahedron", "tetrahedron"])
def test_axial_direction_of_a_bend_with_legs(kind: str) -> None:
    """The curvature has a kink where a leg begins, which is smoothed: the largest error is there."""
    mean, largest = error(*BODIES["bend"], kind, 1)
    assert mean <= 1.6 and largest <= 6.5


@pytest.mark.parametrize("kind, most", [("hexahedron", 0.0156), ("tetrahedron", 0.022)])
def test_depth_station_and_thickness_of_the_papers_wall(kind: str, most: float) -> None:
    """Four elements through it; what is left comes from 16 plane faces around. phi itself is off by 0.145."""
    body, counts = BODIES["straight"]
    domain = ring(body.place, counts, kind)
    made, quadrature = found(domain)
    x, local = quadrature.coordinates, made
    assert body.depth is not None
    off = local.depth - body.depth(x)
    assert np.sqrt(quadrature.mean(off**2)) <= most
    np.testing.assert_allclose(local.station, x[..., 2] / 8.0, atol=1e-3)
    assert made.thickness is not None
    np.testing.assert_allclose(made.thickness, 2.0, rtol=0.03)
    nodes = domain.mesh.geometry.x
    np.testing.assert_allclose(local.nodal_depth, body.depth(nodes), atol=1.5 * most)
    on_faces = np.isclose(body.depth(nodes) % 1.0, 0.0)
    np.testing.assert_allclose(
        local.nodal_depth[on_faces], np.round(body.depth(nodes)[on_faces]), atol=1e-12
    )


def test_station_is_a_share_of_the_length_of_a_bend() -> None:
    """Of its middle line: constant in the sections of a torus."""
    made, quadrature = found(ring(TORUS.place, (16, 4, 12), "hexahedron"))
    turn = np.arctan2(quadrature.coordinates[..., 2], quadrature.coordinates[..., 0] + 6.0)
    np.testing.assert_allclose(made.station, turn / (np.pi / 3), atol=0.004)


@pytest.mark.parametrize("kind, rms", [("hexahedron", 0.01), ("tetrahedron", 0.6)])
def test_curved_elements_of_degree_two(kind: str, rms: float) -> None:
    domain = parts.tube(
        element=kind, degree=2, divisions=(16, 2, 2), length=2.0, comm=MPI.COMM_SELF
    )
    domain.faces.update(inlet=domain.faces["bottom"], outlet=domain.faces["top"])
    made, quadrature = found(domain, 2)
    x, (body, _) = quadrature.coordinates, BODIES["straight"]
    off = apart(made.axes[..., 0, :], body.directions(x)[0])
    assert np.sqrt(quadrature.mean(off**2)) < rms
    assert body.depth is not None
    np.testing.assert_allclose(made.depth, body.depth(x), atol=0.005)
    np.testing.assert_allclose(made.nodal_depth, body.depth(domain.mesh.geometry.x), atol=0.005)


def test_axes_are_a_right_handed_frame_and_a_turned_body_has_turned_ones() -> None:
    """Also shifted, and with as many units of length as one likes."""
    turn, shift = parts.random_rotations(np.random.default_rng(1), 1)[0], np.array(
        [50.0, -30.0, 110.0]
    )
    body, counts = own_bodies.LEGS, (8, 2, 12)
    first, _ = found(ring(body.place, counts, "tetrahedron"))
    moved = ring(
        lambda *shares: 1000.0 * body.place(*shares) @ turn.T + shift, counts, "tetrahedron"
    )
    second, _ = found(moved)
    axes = first.axes
    assert_orthonormal(axes)
    np.testing.assert_allclose(
        np.cross(axes[..., 0, :], axes[..., 1, :]), axes[..., 2, :], atol=1e-12
    )
    np.testing.assert_allclose(second.axes, axes @ turn.T, atol=1e-6)
    np.testing.assert_allclose(second.depth, first.depth, atol=1e-6)
    np.testing.assert_allclose(second.station, first.station, atol=1e-6)
    assert first.thickness is not None and second.thickness is not None
    np.testing.assert_allclose(second.thickness, 1000.0 * first.thickness, rtol=1e-6)


ON_ONE_AND_TWO_RANKS = [{"scene": "a bend with legs"}]


def test_two_ranks_give_the_same(both_ranks: list[tuple[dict, dict]]) -> None:
    ((one, two),) = both_ranks
    assert {"axes", "depth", "station", "thickness", "nodal_depth"} == set(one)
    for name, values in one.items():
        np.testing.assert_allclose(two[name], values, atol=1e-8, err_msg=name)


# ---------------------------------------------------------------- forks
def test_a_fork_has_the_directions_of_its_branches_and_few_points_without() -> None:
    """Three points in the crotch have none of their own; they get those of the nearest point that has some."""
    made, quadrature = found(fork(35.0, size=0.35))
    assert made.undefined is not None and made.undefined.any()
    assert quadrature.mean(made.undefined.astype(float)) < 0.1 * MOST_UNDEFINED
    x, axes = quadrature.coordinates, made.axes
    assert np.isfinite(axes).all() and np.isfinite(made.depth).all()
    for angle, sign in ((0.0, -1.0), (-35.0, 1.0), (35.0, 1.0)):
        way = np.array([np.sin(np.radians(angle)), 0.0, np.cos(np.radians(angle))])
        along = sign * (x @ way)
        away = np.linalg.norm(x - (x @ way)[..., None] * way, axis=-1)
        there = (along > 2.8) & (along < 5.01) & (away < 1.45)
        off = apart(axes[..., 1, :], way)[there]
        assert there.sum() > 500 and np.sqrt(np.mean(off**2)) < 1.0 and off.max() < 4.0
        assert (axes[there] @ way)[:, 1].min() > 0.99  # from the inlet to the outlets
    places, known = x.reshape(-1, 3), ~made.undefined.ravel()
    rows = axes.reshape(-1, 3, 3)
    for point in np.flatnonzero(~known):
        nearest = np.flatnonzero(known)[
            np.linalg.norm(places[known] - places[point], axis=1).argmin()
        ]
        np.testing.assert_array_equal(rows[point], rows[nearest])


# ---------------------------------------------------------------- faults
def test_an_inner_face_that_is_also_outside_is_refused_with_a_place() -> None:
    """The harmonic function has no gradient in a wall with the inner face on both sides."""
    domain = ring(straight(1.0, 1.2, 8.0).place, (16, 1, 12), "tetrahedron")
    tags = domain.facet_tags
    upper = dolfinx.mesh.compute_midpoints(domain.mesh, 2, tags.indices)[:, 2] > 4.0
    values = np.where(
        (tags.values == domain.faces["outer"]) & upper, domain.faces["inner"], tags.values
    )
    wrong = replace(
        domain,
        facet_tags=dolfinx.mesh.meshtags(domain.mesh, 2, tags.indices, values.astype(np.int32)),
    )
    with pytest.raises(
        UndefinedAxes, match=r"undefined in \d+ % of the wall, first at \("
    ) as refused:
        found(wrong)
    text = re.search(r"first at \((.*)\);", str(refused.value))
    assert text is not None and float(text[1].split(",")[2]) > 3.0
    found(domain)  # one element through the wall is enough
