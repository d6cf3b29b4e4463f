"""Evolution laws: eqs. (10) and (11) and what they have in common."""

import numpy as np
import pytest

from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.drivers import DRIVERS, FRAMES
from remodel_fenicsx.model.laws import LAWS, Array, Drive, explicit, rate, relaxation
from tests import parts

FUNCTIONS = {"explicit": explicit, "rate": rate, "relaxation": relaxation}

KAPPA = 0.025


def octant(rng: np.random.Generator, count: int = 200) -> Array:
    """Unit vectors with non-negative components."""
    vectors = np.abs(rng.normal(size=(count, 3)))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def march(law: str, l0: Array, target: Array, times: Array, kappa: float = KAPPA) -> Array:
    """Dimensions at the end of a series of steps with a constant target."""
    l = l0  # noqa: E741
    for old, new in zip(times[:-1], times[1:]):
        l = FUNCTIONS[law](l, l0, target, kappa, float(old), float(new))  # noqa: E741
    return l


@pytest.fixture
def cells() -> tuple[Array, Array]:
    rng = np.random.default_rng(1)
    return octant(rng), 1.3 * octant(rng)


@pytest.mark.parametrize("law", ["rate", "relaxation"])
@pytest.mark.parametrize("steps", [1, 7, 150])
def test_laws_are_eq_11_when_the_target_is_constant(
    law: str, steps: int, cells: tuple[Array, Array]
) -> None:
    l0, target = cells
    inner = np.sort(np.random.default_rng(steps).uniform(0.0, 150.0, steps - 1))
    times = np.concatenate([[0.0], inner, [150.0]])
    by_hand = l0 + (target - l0) * (1 - np.exp(-KAPPA * 150.0))
    np.testing.assert_allclose(march(law, l0, target, times), by_hand, atol=1e-13)
    np.testing.assert_allclose(march("explicit", l0, target, times), by_hand, atol=1e-14)


def test_rate_integrates_eq_10_between_any_two_times(cells: tuple[Array, Array]) -> None:
    l0, target = cells
    start, end, count = 12.0, 13.5, 2000
    middle = start + (np.arange(count) + 0.5) * (end - start) / count
    slopes = [KAPPA * (target - l0) * np.exp(-KAPPA * t) for t in middle]
    change = rate(target, l0, target, KAPPA, start, end) - target
    np.testing.assert_allclose(change, np.sum(slopes, axis=0) * (end - start) / count, atol=1e-10)


def test_laws_differ_when_the_target_changes() -> None:
    """Erratum 7: eq. (11) forgets its past at once, eq. (10) keeps a memory that has died out before l = r0 e."""
    l0 = np.array([[0.6, 0.8, 0.0]])
    first, second = np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.0]])
    ends = {}
    for law in ("explicit", "rate", "relaxation"):
        half = FUNCTIONS[law](l0, l0, first, KAPPA, 0.0, 40.0)
        ends[law] = FUNCTIONS[law](half, l0, second, KAPPA, 40.0, 1e5)[0]
    np.testing.assert_allclose(ends["explicit"], second[0], atol=1e-14)
    np.testing.assert_allclose(ends["relaxation"], second[0], atol=1e-14)
    weight = 1 - np.exp(-1.0)  # of the first target: kappa times 40 is one
    np.testing.assert_allclose(
        ends["rate"], weight * first[0] + (1 - weight) * second[0], atol=1e-14
    )


def uniaxial_drive(count: int, l0: Array) -> Drive:
    """Tension of 2 along x at every point of an undeformed body."""
    tensor = np.zeros((count, 3, 3))
    tensor[:, 0, 0] = 2.0
    F = np.broadcast_to(np.eye(3), (count, 3, 3))
    return Drive(
        F, tensor, DRIVERS["cauchy"], FRAMES["material"], 0.0, l0, np.full(count, 1.3), KAPPA
    )


def test_laws_turn_the_axes_at_once_and_the_dimensions_gradually(
    cells: tuple[Array, Array],
) -> None:
    l0, _ = cells
    axes = np.broadcast_to(np.eye(3)[[2, 0, 1]], (len(l0), 3, 3))  # rows: z, x, y
    for name, function in FUNCTIONS.items():
        new = LAWS[name].update(UnitCell(l0, axes), uniaxial_drive(len(l0), l0), 3.0, 4.0)
        np.testing.assert_allclose(
            np.abs(new.axes[:, 0]), np.broadcast_to([1.0, 0.0, 0.0], l0.shape), atol=1e-14
        )
        target = np.broadcast_to([1.3, 0.0, 0.0], l0.shape)
        np.testing.assert_allclose(
            new.dimensions, function(l0, l0, target, KAPPA, 3.0, 4.0), atol=1e-14
        )


def test_points_without_tension_keep_their_cells(cells: tuple[Array, Array]) -> None:
    l0, _ = cells
    drive = uniaxial_drive(len(l0), l0)
    drive.tensor[::2] *= -1.0
    axes = np.broadcast_to(np.eye(3)[[2, 0, 1]], (len(l0), 3, 3))
    for name in FUNCTIONS:
        new = LAWS[name].update(UnitCell(l0, axes), drive, 3.0, 4.0)
        np.testing.assert_array_equal(new.dimensions[::2], l0[::2])
        np.testing.assert_array_equal(new.axes[::2], axes[::2])
        assert np.all(np.abs(new.dimensions[1::2] - l0[1::2]).max(axis=1) > 1e-3)


def random_cells(rng: np.random.Generator, count: int = 50) -> UnitCell:
    """Cells of any dimensions, turned anywhere."""
    return UnitCell(1.3 * octant(rng, count), parts.random_rotations(rng, count))


def drive(
    tensor: Array, F: Array, frame: str, driver: str = "cauchy", threshold: float = 0.0
) -> Drive:
    """A drive on cells that began with equal dimensions, r0 = 1.3."""
    count = len(tensor)
    l0 = np.full((count, 3), 1.3 / np.sqrt(3))
    return Drive(
        F, tensor, DRIVERS[driver], FRAMES[frame], threshold, l0, np.full(count, 1.3), KAPPA
    )


@pytest.mark.parametrize(("driver", "frame"), [
    ("cauchy", "material"), ("finger", "material"), ("cauchy", "spatial"), ("pk2", "material"), ("pk2", "spatial"),
])  # fmt: skip
def test_equal_principal_values_keep_the_axes_whatever_the_deformation(
    driver: str, frame: str
) -> None:
    """What the tensor does not decide, the previous axes do: in space as the deformation has carried them there."""
    rng = np.random.default_rng(3)
    old = random_cells(rng)
    F = parts.random_rotations(rng, 50) @ (np.eye(3) + rng.uniform(-0.3, 0.3, (50, 3, 3)))
    tensor = np.broadcast_to(2.0 * np.eye(3), F.shape)
    new = LAWS["explicit"].update(old, drive(tensor, F, frame, driver), 3.0, 4.0)
    np.testing.assert_allclose(new.axes, old.axes, atol=1e-13)
    assert np.abs(new.dimensions - old.dimensions).max() > 0.1  # they have remodeled


def test_frames_make_material_axes_of_spatial_directions_and_leave_material_ones() -> None:
    """A quarter turn carries the fibres along x onto y, where the tension is."""
    turn = np.array([[[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
    tensor = np.diag([1.0, 3.0, 2.0])[None]
    old = UnitCell(np.array([[0.9, 0.8, 0.5]]), np.eye(3)[None])
    x, y, z = np.eye(3)
    expected = {
        ("cauchy", "material"): [x, z, y],
        ("cauchy", "spatial"): [y, z, x],
        ("pk2", "material"): [y, z, x],
    }
    for (driver, frame), axes in expected.items():
        new = LAWS["explicit"].update(old, drive(tensor, turn, frame, driver), 3.0, 4.0)
        np.testing.assert_allclose(
            np.abs(new.axes[0]), axes, atol=1e-14, err_msg=f"{driver} {frame}"
        )
        # by rank: the target is r0 (3, 2, 1) / sqrt 14, approached from the equal dimensions of the start
        e = 1.3 * np.array([3.0, 2.0, 1.0]) / np.sqrt(14)
        start = 1.3 / np.sqrt(3)
        np.testing.assert_allclose(
            new.dimensions[0], start + (e - start) * (1 - np.exp(-KAPPA * 4.0)), atol=1e-14
        )


def test_below_the_threshold_values_are_zero_and_differences_are_none() -> None:
    rng = np.random.default_rng(4)
    old, true = random_cells(rng), parts.random_rotations(rng, 50)
    F = np.broadcast_to(np.eye(3), true.shape)

    def updated(values: list[float]) -> UnitCell:
        tensor = np.swapaxes(true, 1, 2) @ (np.array(values)[:, None] * true)
        return LAWS["explicit"].update(old, drive(tensor, F, "material", threshold=1e-3), 0.0, 1e9)

    # the largest two differ by less: any direction of their plane is as good, so the previous axes choose it
    new = updated([0.0023, 0.0017, -0.02])
    np.testing.assert_allclose(np.abs(np.sum(new.axes[:, 2] * true[:, 2], axis=1)), 1.0, atol=1e-12)
    projected = old.axes[:, 0] - np.sum(old.axes[:, 0] * true[:, 2], axis=1)[:, None] * true[:, 2]
    projected /= np.linalg.norm(projected, axis=1)[:, None]
    np.testing.assert_allclose(new.axes[:, 0], projected, atol=1e-12)
    # the second value is no tension
    np.testing.assert_allclose(
        updated([0.02, 0.0009, -0.02]).dimensions, np.tile([1.3, 0.0, 0.0], (50, 1)), atol=1e-12
    )
    for name, values in zip(("dimensions", "axes"), updated([0.0009, -0.02, -0.03])):
        np.testing.assert_array_equal(values, getattr(old, name))
