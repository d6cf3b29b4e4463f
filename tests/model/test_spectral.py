"""Principal values and axes: right where the tensor decides, the previous axes where it does not."""

import numpy as np
import pytest

from remodel_fenicsx.model.spectral import ROUNDING, Array, positive_direction, principal
from tests.parts import random_rotations, symmetric
from tests.values import assert_orthonormal

COUNT = 50


def absolute_cosines(a: Array, b: Array) -> Array:
    return np.abs(np.sum(a * b, axis=-1))


@pytest.mark.parametrize("size", [1.0, 1e-200, 1e200])
def test_distinct_values(size: float) -> None:
    rng = np.random.default_rng(1)
    random = rng.normal(size=(COUNT, 3, 3))
    tensors = size * (random + np.swapaxes(random, 1, 2))
    previous = random_rotations(rng, COUNT)
    values, axes = principal(tensors, previous)
    assert np.all(np.diff(values, axis=1) <= 0)
    assert_orthonormal(axes, 1e-14)
    np.testing.assert_allclose(
        np.swapaxes(axes, 1, 2) @ (values[:, :, None] / size * axes), tensors / size, atol=1e-13
    )
    cosines = np.sum(axes * previous, axis=2)
    assert np.all(cosines[np.abs(cosines) > 1e-3] > 0)


def test_only_the_symmetric_part_counts() -> None:
    rng = np.random.default_rng(2)
    tensors, previous = rng.normal(size=(COUNT, 3, 3)), random_rotations(rng, COUNT)
    for one, other in zip(
        principal(tensors, previous), principal(np.swapaxes(tensors, 1, 2), previous)
    ):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    "values, single, pair", [([5.0, 5.0, -2.0], 2, (0, 1)), ([5.0, -2.0, -2.0], 0, (1, 2))]
)
def test_pair_of_equal_values_keeps_the_previous_axes_in_its_plane(
    values: list[float], single: int, pair: tuple[int, int]
) -> None:
    rng = np.random.default_rng(3)
    true, previous = random_rotations(rng, COUNT), random_rotations(rng, COUNT)
    found, axes = principal(symmetric(values, true), previous)
    np.testing.assert_allclose(found, np.broadcast_to(values, found.shape), atol=1e-13)
    assert_orthonormal(axes, 1e-14)
    normal = true[:, single]
    np.testing.assert_allclose(absolute_cosines(axes[:, single], normal), 1.0, atol=1e-14)
    first, second = (
        previous[:, rank] - np.sum(previous[:, rank] * normal, axis=1)[:, None] * normal
        for rank in pair
    )
    first /= np.linalg.norm(first, axis=1)[:, None]
    second -= np.sum(first * second, axis=1)[:, None] * first
    second /= np.linalg.norm(second, axis=1)[:, None]
    np.testing.assert_allclose(axes[:, pair[0]], first, atol=1e-12)
    np.testing.assert_allclose(axes[:, pair[1]], second, atol=1e-12)


@pytest.mark.parametrize(
    "values",
    [
        [3.0, 3.0, 1.0],
        [3.0, 1.0, 1.0],
        [2.0, 2.0, 2.0],
        [0.0, 0.0, 0.0],
        [-1.0, -1.0, -1.0],
        [0.0, 0.0, -4.0],
    ],
)
def test_previous_axes_that_are_principal_stay(values: list[float]) -> None:
    previous = random_rotations(np.random.default_rng(4), COUNT)
    _, axes = principal(symmetric(values, previous), previous)
    np.testing.assert_allclose(axes, previous, atol=1e-14)


@pytest.mark.parametrize("values", [[3.0, 3.0, 1.0], [3.0, 1.0, 1.0], [2.0, 2.0, 2.0]])
def test_rounding_does_not_choose_the_axes(values: list[float]) -> None:
    rng = np.random.default_rng(5)
    true, previous = random_rotations(rng, COUNT), random_rotations(rng, COUNT)
    exact = symmetric(values, true)
    noise = 1e-12 * rng.normal(size=exact.shape)
    noise += np.swapaxes(noise, 1, 2)
    # the noise does turn LAPACK's vectors, so there is something to be protected from
    bare = np.linalg.eigh(exact)[1], np.linalg.eigh(exact + noise)[1]
    assert np.min(np.abs(np.sum(bare[0] * bare[1], axis=1))) < 0.9
    np.testing.assert_allclose(
        principal(exact + noise, previous)[1], principal(exact, previous)[1], atol=1e-9
    )


def test_values_that_agree_in_a_chain_are_one_cluster() -> None:
    rng = np.random.default_rng(6)
    true, previous = random_rotations(rng, COUNT), random_rotations(rng, COUNT)
    _, axes = principal(symmetric([1.0, 1.0 - 0.8e-8, 1.0 - 1.6e-8], true), previous)
    np.testing.assert_allclose(axes, previous, atol=1e-14)
    _, axes = principal(symmetric([1.0, 1.0 - 1.6e-8, 1.0 - 3.2e-8], true), previous)
    np.testing.assert_allclose(absolute_cosines(axes, true), 1.0, atol=1e-12)


def test_noise_below_the_scale_is_the_zero_tensor() -> None:
    rng = np.random.default_rng(8)
    true, previous = random_rotations(rng, COUNT), random_rotations(rng, COUNT)
    noise = symmetric([3e-16, 1e-16, -2e-16], true)
    np.testing.assert_allclose(
        principal(noise, previous, threshold=ROUNDING)[1], previous, atol=1e-14
    )
    np.testing.assert_allclose(
        absolute_cosines(principal(noise, previous)[1], true), 1.0, atol=1e-12
    )


def test_previous_axis_across_the_eigenspace_is_passed_over() -> None:
    previous = np.array([[[0.0, 0.0, 1.0], [0.6, 0.8, 0.0], [-0.8, 0.6, 0.0]]])
    _, axes = principal(np.diag([2.0, 2.0, 1.0])[None], previous)
    np.testing.assert_allclose(
        axes[0], [[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]], atol=1e-15
    )
    # almost across: the same choice, not a direction made of rounding
    previous[0, 0] = [1e-9, -1e-9, 1.0]
    np.testing.assert_allclose(
        principal(np.diag([2.0, 2.0, 1.0])[None], previous)[1][0], axes[0], atol=1e-9
    )
    _, axes = principal(np.diag([1.0, 1.0, 2.0])[None], np.eye(3)[[0, 2, 1]][None])
    np.testing.assert_array_equal(axes[0], [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])


def test_swapped_ranks_take_their_sign_from_the_other_previous_axes() -> None:
    for sign in (1.0, -1.0):
        previous = sign * np.eye(3)[None]
        _, axes = principal(np.diag([1.0, 2.0, 3.0])[None], previous)
        np.testing.assert_array_equal(axes[0], sign * np.eye(3)[[2, 1, 0]])


def test_without_previous_axes_the_coordinate_axes_decide() -> None:
    nothing = np.zeros((2, 3, 3))
    np.testing.assert_array_equal(
        principal(np.zeros((2, 3, 3)), nothing)[1], np.broadcast_to(np.eye(3), (2, 3, 3))
    )
    for values in ([2.0, 2.0, 1.0], [2.0, 1.0, 1.0]):
        true = random_rotations(np.random.default_rng(9), COUNT)
        _, axes = principal(symmetric(values, true), np.zeros_like(true))
        assert_orthonormal(axes, 1e-14)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_named(bad: float) -> None:
    tensors = np.zeros((5, 3, 3))
    tensors[3, 0, 1] = tensors[4, 2, 2] = bad
    with pytest.raises(FloatingPointError, match="^tensor 3 of 5 "):
        principal(tensors, np.zeros((5, 3, 3)))
    with pytest.raises(FloatingPointError, match="^triad of previous axes 3 of 5 "):
        principal(np.zeros((5, 3, 3)), tensors)
    with pytest.raises(FloatingPointError, match="^set of principal values 0 of 1 "):
        positive_direction([[bad, 0.0, 0.0]])


@pytest.mark.parametrize(
    "values, direction",
    [
        ([3.0, 4.0, 0.0], [0.6, 0.8, 0.0]),
        ([4.0, 3.0, -100.0], [0.8, 0.6, 0.0]),
        ([1.0, 1e-16, -1e-16], [1.0, 0.0, 0.0]),
        ([3e-310, 4e-310, 0.0], [0.6, 0.8, 0.0]),
        ([3e290, 4e290, -1e300], [0.6, 0.8, 0.0]),
    ],
)
def test_positive_direction(values: list[float], direction: list[float]) -> None:
    with np.errstate(all="raise", under="ignore"):
        found, active = positive_direction([values])
    assert active.tolist() == [True]
    np.testing.assert_allclose(found[0], direction, atol=1e-12)


@pytest.mark.parametrize(
    "values", [[0.0, 0.0, 0.0], [-1.0, -2.0, -3.0], [1e-16, -1.0, -1.0], [0.0, -1e-300, -1e-300]]
)
def test_nothing_positive_is_inactive(values: list[float]) -> None:
    with np.errstate(all="raise", under="ignore"):
        found, active = positive_direction([values, [1.0, 0.0, 0.0]])
    assert active.tolist() == [False, True]
    np.testing.assert_array_equal(found, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])


def test_noise_below_the_scale_is_inactive() -> None:
    noise = [[2e-16, 1e-16, -1e-16]]
    assert positive_direction(noise)[1].tolist() == [True]
    assert positive_direction(noise, threshold=ROUNDING)[1].tolist() == [False]
