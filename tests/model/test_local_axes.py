"""Local axes of a tube, and those of the deformed body."""

from __future__ import annotations

import numpy as np

from remodel_fenicsx.body import Tube
from remodel_fenicsx.model.cells import cylindrical_axes
from remodel_fenicsx.model.axes import LocalAxes
from tests import parts


def wall_points(count: int = 60) -> np.ndarray:
    """In the wall of a tube of radii 1 and 3 and length 8, (count, 3)."""
    rng = np.random.default_rng(4)
    angle, radius, height = (rng.uniform(0.0, end, count) for end in (2 * np.pi, 2.0, 8.0))
    return np.stack([(1 + radius) * np.cos(angle), (1 + radius) * np.sin(angle), height], axis=-1)


def local_axes(places: np.ndarray, axes: np.ndarray | None = None) -> LocalAxes:
    """Of a tube, or those that are given."""
    tube = Tube(inner_radius=1.0, outer_radius=3.0, length=8.0)
    found = tube.axes_at(places) if axes is None else axes
    return LocalAxes(
        places,
        lambda: found,
        lambda: tube.depth(places),
        lambda: tube.station(places),
        lambda: tube.depth(places),
    )


def test_depth_and_station_of_a_tube() -> None:
    places = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 2.0], [-3.0, 0.0, 8.0]])
    found = local_axes(places)
    np.testing.assert_allclose(found.depth, [0.0, 0.5, 1.0])
    np.testing.assert_allclose(found.station, [0.0, 0.25, 1.0])


def test_a_tube_that_swells_stretches_and_twists_keeps_its_directions() -> None:
    """r = 1.3 R + 0.1 R^2, theta = T + 0.4 Z, z = 0.8 Z: circumferences stay such, the wall's normal radial."""
    places, twist, stretch = wall_points(), 0.4, 0.8
    radius = np.hypot(places[:, 0], places[:, 1])
    grown, slope = 1.3 * radius + 0.1 * radius**2, 1.3 + 0.2 * radius
    turn = twist * places[:, 2]
    c, s = np.cos(turn), np.sin(turn)
    x, y = (
        grown / radius * v
        for v in (c * places[:, 0] - s * places[:, 1], s * places[:, 0] + c * places[:, 1])
    )
    after = cylindrical_axes(np.stack([x, y, stretch * places[:, 2]], axis=-1))
    inner = np.zeros((len(places), 3, 3))  # F from circumferential, axial, radial to the same
    inner[:, 0, 0], inner[:, 1, 1], inner[:, 2, 2], inner[:, 0, 1] = (
        grown / radius,
        stretch,
        slope,
        grown * twist,
    )
    before = local_axes(places)
    F = np.swapaxes(after, -1, -2) @ inner @ before.axes
    np.testing.assert_allclose(before.deformed(F), after, atol=1e-13)


def test_deformed_axes_follow_a_material_line_and_a_material_surface() -> None:
    """c' along F c, r' normal to the surface of F c and F a, and along F^-T r; the rest follows from right angles."""
    rng = np.random.default_rng(6)
    axes = parts.random_rotations(rng, 60)
    F = np.eye(3) + 0.3 * rng.standard_normal((60, 3, 3))
    F = F[np.linalg.det(F) > 0.05]
    axes = axes[: len(F)]
    c, a, r = np.moveaxis(local_axes(wall_points()[: len(F)], axes).deformed(F), -2, 0)
    line = np.einsum("nij,nj->ni", F, axes[:, 0])
    normal = np.einsum("nji,nj->ni", np.linalg.inv(F), axes[:, 2])
    np.testing.assert_allclose(c, line / np.linalg.norm(line, axis=1)[:, None], atol=1e-13)
    np.testing.assert_allclose(r, normal / np.linalg.norm(normal, axis=1)[:, None], atol=1e-11)
    np.testing.assert_allclose(np.cross(c, a), r, atol=1e-13)
    assert len(F) > 30
