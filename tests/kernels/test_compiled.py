"""The compiled pass does what numpy's does: eigenpairs, noise, lengths, and a whole pass of a tube."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx.kernels import CompiledPointKernels, PointKernels
from remodel_fenicsx.model import energy, spectral
from remodel_fenicsx.model.cells import UnitCell, structure_tensor
from tests.values import assert_orthonormal

COUNT = 203  # no multiple of the eight that are done at once


@pytest.fixture(scope="module")
def kernels() -> PointKernels:
    return CompiledPointKernels(MPI.COMM_SELF)


def random_axes(rng: np.random.Generator) -> spectral.Array:
    return np.linalg.qr(rng.normal(size=(COUNT, 3, 3)))[0].copy()


def tensors_of_every_kind(rng: np.random.Generator) -> tuple[spectral.Array, spectral.Array]:
    """Random ones; every fifth with two or three equal values, one zero, one diagonal; axes with weak signs too."""
    axes = random_axes(rng)
    values = rng.normal(size=(COUNT, 3))
    values[::5, 1] = values[::5, 0]
    values[::10] = values[::10, :1]
    values[7] = 0.0
    tensors = np.swapaxes(axes, 1, 2) @ (values[:, :, None] * axes)
    tensors[8] = np.diag([1.0, -2.0, 3.0])
    previous = 3.0 * random_axes(rng)
    previous[1::7] = np.roll(axes[1::7], 1, axis=1)  # orthogonal to what they shall decide
    return tensors, previous


@pytest.mark.parametrize("size", [1e-200, 1e-6, 1.0, 1e200])
@pytest.mark.parametrize("threshold", [0.0, 0.1, "each its own"])
def test_eigenpairs(kernels: PointKernels, size: float, threshold: float | str) -> None:
    rng = np.random.default_rng(4)
    tensors, previous = tensors_of_every_kind(rng)
    limit = size * (rng.random(COUNT) if isinstance(threshold, str) else np.asarray(threshold))
    values, axes = spectral.principal(size * tensors, previous, threshold=limit)
    found, found_axes = kernels.principal(size * tensors, previous, threshold=limit)
    np.testing.assert_allclose(found / size, values / size, rtol=0, atol=1e-14)
    np.testing.assert_allclose(found_axes, axes, rtol=0, atol=1e-12)


def test_close_values_are_told_apart_as_far_as_their_distance_allows(kernels: PointKernels) -> None:
    rng = np.random.default_rng(5)
    axes, gap = random_axes(rng), np.geomspace(3e-8, 1e-1, COUNT)
    values = np.stack([1 + gap, np.ones(COUNT), -np.ones(COUNT)], axis=1)
    found, found_axes = kernels.principal(
        np.swapaxes(axes, 1, 2) @ (values[:, :, None] * axes), axes
    )
    np.testing.assert_allclose(found, values, rtol=0, atol=2e-15)
    assert np.max(np.abs(found_axes - axes) * gap[:, None, None]) < 2e-15
    assert_orthonormal(found_axes, 3e-15)


def test_what_is_not_finite_is_named(kernels: PointKernels) -> None:
    tensors, axes = np.tile(np.diag([3.0, 2.0, 1.0]), (20, 1, 1)), np.tile(np.eye(3), (20, 1, 1))
    tensors[17, 0, 1] = np.nan
    with pytest.raises(FloatingPointError, match="tensor 17 of 20 is not finite .1 in all."):
        kernels.principal(tensors, axes)
    with pytest.raises(FloatingPointError, match="triad of previous axes 3 of 20"):
        kernels.principal(axes, np.where(np.arange(20)[:, None, None] == 3, np.inf, axes))


def test_noise_across_the_axes(kernels: PointKernels) -> None:
    rng = np.random.default_rng(6)
    tensors, axes = tensors_of_every_kind(rng)
    steady = tensors + 1e-3 * rng.normal(size=tensors.shape)
    steady = steady + np.swapaxes(steady, 1, 2)
    near = np.linalg.eigh(tensors)[1].swapaxes(1, 2)
    for limit in (0.0, 1e-2, 0.5, rng.random(COUNT)):
        for given in (axes, near):
            wanted = spectral.drop_noise_shear(steady, given, limit)
            np.testing.assert_allclose(
                kernels.drop_noise_shear(steady, given, limit), wanted, rtol=0, atol=1e-14
            )


def test_the_positive_direction(kernels: PointKernels) -> None:
    rng = np.random.default_rng(9)
    values = rng.normal(size=(COUNT, 3)) * 10.0 ** rng.integers(-200, 200, (COUNT, 1))
    values[:5] = [
        [0.0] * 3,
        [-1.0, -2.0, -3.0],
        [1.0, 1e-15, -1.0],
        [1.0, 1e-13, -1.0],
        [2.0, 0.5, 0.4],
    ]
    for limit in (0.0, 0.5, rng.random(COUNT)):
        wanted, active = spectral.positive_direction(values, limit)
        found, found_active = kernels.positive_direction(values, limit)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-15)
        np.testing.assert_array_equal(found_active, active)
        assert 0 < active.sum() < COUNT
    for bad in (np.nan, np.inf):
        with pytest.raises(
            FloatingPointError, match=f"set of principal values 7 of {COUNT} is not finite"
        ):
            kernels.positive_direction(np.where(np.arange(COUNT)[:, None] == 7, bad, values))


def test_length_and_structure(kernels: PointKernels) -> None:
    rng = np.random.default_rng(7)
    F, cell = np.eye(3) + 0.2 * rng.normal(size=(COUNT, 3, 3)), UnitCell(
        rng.random((COUNT, 3)), random_axes(rng)
    )
    expected = energy.squared_end_to_end_length(F, [cell])
    np.testing.assert_allclose(kernels.squared_length(F, cell), expected, rtol=1e-14)
    wanted = structure_tensor(*cell[:2])
    np.testing.assert_allclose(kernels.structure_tensor(*cell[:2]), wanted, rtol=0, atol=1e-15)


# ---------------------------------------------------------------- at the edges of what they decide
EDGES = np.array([0.0, 0.5, 0.9, 0.99, 1 - 1e-6, 1 + 1e-6, 1.005, 1.02, 1.1, 1.5, 2.0, 10.0])
"""Times a threshold."""


@pytest.mark.parametrize("limited_by", ["tolerance", "threshold"])
@pytest.mark.parametrize("pair", [0, 1])
def test_values_that_just_agree_or_just_do_not(
    kernels: PointKernels, limited_by: str, pair: int
) -> None:
    """Diagonal tensors, whose values have no rounding, with previous axes a quarter of a turn off in the plane."""
    limit = 3e-8 if limited_by == "tolerance" else 1e-3  # of a largest value of 3
    values = np.tile([3.0, 2.0, 1.0], (len(EDGES), 1))
    values[:, pair + 1] = values[:, pair] - EDGES * limit
    tensors = values[:, :, None] * np.eye(3)
    half = np.sqrt(0.5)
    turned = np.eye(3)
    turned[pair : pair + 2, pair : pair + 2] = [[half, half], [-half, half]]
    previous = np.tile(turned, (len(EDGES), 1, 1))
    threshold = 0.0 if limited_by == "tolerance" else limit
    expected = spectral.principal(tensors, previous, threshold=threshold)
    found = kernels.principal(tensors, previous, threshold=threshold)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)
    stays = np.abs(found[1][:, pair, pair] - half) < 1e-12
    np.testing.assert_array_equal(stays, EDGES <= 1)


def test_signs_that_just_decide_or_just_do_not(kernels: PointKernels) -> None:
    """The first previous axis is almost across its own, on its other side; the next one would choose the other sign."""
    cosine = EDGES * spectral.MIN_OVERLAP
    previous = np.tile(np.eye(3), (len(EDGES), 1, 1))
    previous[:, 0] = np.stack([-cosine, np.sqrt(1 - cosine**2), np.zeros_like(cosine)], axis=1)
    previous[:, 1] = [0.6, 0.8, 0.0]
    tensors = np.tile(np.diag([3.0, 2.0, 1.0]), (len(EDGES), 1, 1))
    expected, found = (
        principal(tensors, previous)[1] for principal in (spectral.principal, kernels.principal)
    )
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(found[:, 0, 0], np.where(EDGES > 1, -1.0, 1.0))


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_tension_that_is_just_more_than_noise(kernels: PointKernels, size: float) -> None:
    """By the threshold, at equality none; and by rounding of the largest value, here one of compression."""
    near = np.concatenate([EDGES, [1.0]])
    for limit, largest in ((0.25 * size, size), (spectral.ROUNDING * size, size)):
        threshold = limit if limit > 1e-3 * size else 0.0
        values = np.stack(
            [near * limit, np.full(len(near), -largest), np.full(len(near), -largest)], axis=1
        )
        expected, active = spectral.positive_direction(values, threshold)
        found, found_active = kernels.positive_direction(values, threshold)
        np.testing.assert_array_equal(found_active, active)
        np.testing.assert_array_equal(found_active, near > 1)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize("plane", [(0, 1), (1, 2), (0, 2)])
def test_what_is_just_across_the_axes(kernels: PointKernels, plane: tuple[int, int]) -> None:
    """Each plane by itself; at equality it is noise."""
    near, noise = np.concatenate([EDGES, [1.0]]), 0.125
    tensors = np.tile(np.diag([3.0, 2.0, 1.0]), (len(near), 1, 1))
    tensors[:, plane[0], plane[1]] = tensors[:, plane[1], plane[0]] = -near * noise
    axes = np.tile(np.eye(3), (len(near), 1, 1))
    found = kernels.drop_noise_shear(tensors, axes, noise)
    np.testing.assert_array_equal(found, spectral.drop_noise_shear(tensors, axes, noise))
    np.testing.assert_array_equal(
        found[:, plane[0], plane[1]], np.where(near > 1, -near * noise, 0.0)
    )
