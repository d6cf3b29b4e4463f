"""Unit cells on plain arrays: what they are at t = 0, and the angles that are measured on them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from remodel_fenicsx.model.cells import (
    UnitCell,
    angle_between,
    angle_to_axis,
    cylindrical_axes,
    global_axes,
    pitch_angle,
    structure_tensor,
)
from remodel_fenicsx.schema.settings import Cells
from tests import parts
from tests.values import assert_orthonormal

R0 = 1.3


def places(count: int = 40) -> np.ndarray:
    """Anywhere but on the z axis, (count, 3)."""
    rng = np.random.default_rng(1)
    angle = rng.uniform(0.0, 2 * np.pi, count)
    radius, height = rng.uniform(1.0, 3.0, count), rng.uniform(-2.0, 2.0, count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1)


# ---------------------------------------------------------------- at t = 0
def test_random_cells_are_uniform_on_the_octant_of_the_sphere() -> None:
    """On a sphere each coordinate is uniform: the means of l and l^2 are r0/2 and r0^2/3."""
    found = Cells(initial="random", seed=5, end_to_end_length=R0).dimensions(20_000)
    assert found.shape == (20_000, 3) and found.min() > 0.0
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), R0, rtol=1e-14)
    np.testing.assert_allclose(found.mean(axis=0), R0 / 2, atol=0.01)
    np.testing.assert_allclose((found**2).mean(axis=0), R0**2 / 3, atol=0.01)


def test_random_cells_are_the_seeds() -> None:
    one, again, other = (Cells(initial="random", seed=seed).dimensions(4) for seed in (5, 5, 6))
    np.testing.assert_array_equal(one, again)
    assert np.abs(one - other).max() > 0.1


def test_antithetic_seeds_are_isotropic_in_threes_and_as_random_each() -> None:
    """1 to 3 and 4 to 6: A of the mean is r0^2/3 I in every element; two threes are strangers."""
    found = [
        Cells(initial="random", seed=s, antithetic=True, end_to_end_length=R0).dimensions(2000)
        for s in range(1, 7)
    ]
    for three in (found[:3], found[3:]):
        np.testing.assert_allclose(np.square(three).mean(axis=0), R0**2 / 3, rtol=1e-12)
    alone = Cells(initial="random", seed=1, end_to_end_length=R0).dimensions(2000)
    for one in found:
        np.testing.assert_allclose(
            np.square(one).mean(axis=0), np.square(alone).mean(axis=0), atol=0.03 * R0**2
        )
    assert abs(np.corrcoef(found[0][:, 0], found[3][:, 0])[0, 1]) < 0.1


def test_other_cells_are_what_their_names_say() -> None:
    isotropic = Cells(initial="isotropic", end_to_end_length=R0).dimensions(2)
    np.testing.assert_allclose(isotropic, np.full((2, 3), R0 / np.sqrt(3)), rtol=1e-15)
    for axis in (1, 2, 3):
        aligned = Cells(initial="aligned", aligned_axis=axis, end_to_end_length=R0).dimensions(2)
        np.testing.assert_array_equal(aligned, np.tile(R0 * np.eye(3)[axis - 1], (2, 1)))
    given = Cells(initial=(0.0, 0.6, 0.8)).dimensions(2)
    np.testing.assert_array_equal(given, [[0.0, 0.6, 0.8]] * 2)


def test_cylindrical_axes_are_circumferential_axial_and_radial() -> None:
    axes = cylindrical_axes(np.array([[2.0, 0.0, 5.0], [0.0, 3.0, 1.0]]))
    x, y, z = np.eye(3)
    np.testing.assert_allclose(axes, [[y, z, x], [-x, z, y]], atol=1e-15)
    anywhere = cylindrical_axes(places())
    assert_orthonormal(anywhere, 1e-14)
    outwards = np.sum(anywhere[:, 2] * places(), axis=1)
    np.testing.assert_allclose(outwards, np.hypot(places()[:, 0], places()[:, 1]), rtol=1e-14)
    np.testing.assert_array_equal(global_axes(places()), np.tile(np.eye(3), (40, 1, 1)))


# ---------------------------------------------------------------- measured
def test_structure_tensor_is_the_sum_of_the_dyads() -> None:
    rng = np.random.default_rng(2)
    l, n = rng.uniform(size=(6, 3)), parts.random_rotations(rng, 6)  # noqa: E741
    by_hand = [sum(l[p, i] ** 2 * np.outer(n[p, i], n[p, i]) for i in range(3)) for p in range(6)]
    np.testing.assert_allclose(structure_tensor(l, n), by_hand, atol=1e-15)


@pytest.mark.parametrize("pitch", [0.0, 20.0, 45.0, 75.0, 90.0])
def test_pitch_is_0_around_the_tube_and_90_along_it(pitch: float) -> None:
    """The same helix as one chain direction, and as a cell with dimensions around and along; radial chains are not."""
    at, (along, around) = places(), (np.sin(np.radians(pitch)), np.cos(np.radians(pitch)))
    circumferential = (
        np.stack([-at[:, 1], at[:, 0], 0 * at[:, 0]], axis=1)
        / np.hypot(at[:, 0], at[:, 1])[:, None]
    )
    helix = around * circumferential + along * np.array([0.0, 0.0, 1.0])
    across = np.cross(helix, circumferential + [0.0, 0.0, 2.0])
    axes = np.stack([helix, across, across], axis=1)
    np.testing.assert_allclose(
        pitch_angle(np.tile([R0, 0.0, 0.0], (40, 1)), axes, cylindrical_axes(at)), pitch, atol=1e-6
    )
    cell = np.tile([R0 * around, R0 * along, 0.7], (40, 1))
    np.testing.assert_allclose(
        pitch_angle(cell, cylindrical_axes(at), cylindrical_axes(at)), pitch, atol=1e-6
    )


@pytest.mark.parametrize("angle", [0.0, 1e-7, 30.0, 90.0])
def test_angle_to_an_axis_is_that_of_the_chain(angle: float) -> None:
    direction = parts.rotation((1.0, 2.0, -1.0), 40.0)
    cell = R0 * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0])
    assert angle_to_axis(cell, direction, direction[0]) == pytest.approx(angle, rel=1e-8, abs=1e-14)


# ---------------------------------------------------------------- between two cells
def random_cells(count: int) -> UnitCell:
    """Any dimensions, any axes."""
    rng = np.random.default_rng(7)
    return UnitCell(
        rng.uniform(0.05, 2.0, (count, 3)), np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    )


def test_it_is_that_of_bures() -> None:
    """cos = tr sqrt(sqrt(A) B sqrt(A)) for small changes of any kind; no change is no angle."""
    first = random_cells(50)
    size = np.linspace(0.1, 3.0, 50)
    about = np.random.default_rng(3).normal(size=(50, 3))
    turns = Rotation.from_rotvec(
        np.radians(size)[:, None] * about / np.linalg.norm(about, axis=1)[:, None]
    ).as_matrix()
    second = UnitCell(
        first.dimensions * (1 + np.radians(size))[:, None] ** [1, -1, 2], first.axes @ turns
    )
    roots = [
        np.swapaxes(axes, 1, 2) @ (lengths[:, :, None] * axes)
        for lengths, axes, _ in (first, second)
    ]
    sizes = [np.linalg.norm(lengths, axis=1) for lengths, _, _ in (first, second)]
    cosine = np.linalg.svd(roots[0] @ roots[1], compute_uv=False).sum(axis=1) / (
        sizes[0] * sizes[1]
    )
    np.testing.assert_allclose(
        angle_between(first, second), np.degrees(np.arccos(cosine)), rtol=0.03
    )
    np.testing.assert_allclose(angle_between(first, first), 0.0, atol=1e-12)
