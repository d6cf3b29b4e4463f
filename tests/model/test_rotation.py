"""The law of Remark 5: a fibre that turns gradually towards the largest tension, along the exponential map."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from remodel_fenicsx import Scene
from remodel_fenicsx.model.cells import UnitCell, structure_tensor
from remodel_fenicsx.model.drivers import DRIVERS, FRAMES
from remodel_fenicsx.model.laws import LAWS, Array, Drive, remaining_angle
from tests import parts
from tests.runs import made
from tests.values import assert_orthonormal, ramped

TAU = 3.0
FIBRE = np.array([0.9, 0.4, 0.1])  # dimensions of a cell


def pulled(
    tensor: Array, F: Array | None = None, driver: str = "cauchy", threshold: float = 0.0
) -> Drive:
    """A drive of tensors (n, 3, 3); without F on an undeformed body."""
    count = len(tensor)
    F = np.broadcast_to(np.eye(3), (count, 3, 3)) if F is None else F
    l0 = np.tile(FIBRE, (count, 1))
    return Drive(
        F, tensor, DRIVERS[driver], FRAMES["material"], threshold, l0, 1.0, 0.1, rotation_time=TAU
    )


def updated(cells: UnitCell, drive: Drive, step: float, passes: int = 1) -> UnitCell:
    """After passes under the same drive."""
    for _ in range(passes):
        cells = LAWS["rotation"].update(cells, drive, 5.0, 5.0 + step)
    return cells


def cells_of(axes: Array, dimensions: Array = FIBRE) -> UnitCell:
    """The same cell along all axes (n, 3, 3)."""
    return UnitCell(np.broadcast_to(dimensions, (len(axes), 3)), axes)


def angle_to(axes: Array, goal: Array) -> Array:
    """Between the first axes and a line, radians."""
    across = np.linalg.norm(np.cross(axes[:, 0], goal), axis=1)
    return np.arctan2(across, np.abs(np.sum(axes[:, 0] * goal, axis=1)))


def random_case(seed: int = 1, count: int = 40) -> tuple[UnitCell, Array, Array]:
    """Cells, driving tensors with one largest value, and the axes of these."""
    rng = np.random.default_rng(seed)
    goal = parts.random_rotations(rng, count)
    return (
        cells_of(parts.random_rotations(rng, count)),
        parts.symmetric([3.0, 1.0, -2.0], goal),
        goal,
    )


# ---------------------------------------------------------------- one fibre under a constant load
@pytest.mark.parametrize("step", [1e-6, 0.1, 3.0, 1e4])
def test_a_step_is_the_implicit_one_of_the_remark(step: float) -> None:
    """omega = n_new x n_max / tau: the fibre turns by dt |omega| towards the tension, the others along."""
    old, stress, goal = random_case()
    new = updated(old, pulled(stress), step)
    before, after = angle_to(old.axes, goal[:, 0]), angle_to(new.axes, goal[:, 0])
    np.testing.assert_allclose(
        after + step / TAU * np.sin(after), before, rtol=1e-13, atol=1e-15 * max(1.0, step)
    )
    sense = np.sign(np.sum(old.axes[:, 0] * goal[:, 0], axis=1))[:, None]
    omega = np.cross(new.axes[:, 0], sense * goal[:, 0]) / TAU
    turn = Rotation.from_rotvec(step * omega).as_matrix()
    np.testing.assert_allclose(
        new.axes, old.axes @ np.swapaxes(turn, 1, 2), atol=1e-12 * max(1.0, step)
    )
    assert new.dimensions is old.dimensions


def test_small_steps_are_the_closed_form_and_the_differential_equation() -> None:
    """d(angle)/dt = -sin(angle)/tau, tan(angle/2) = tan(angle_0/2) exp(-t/tau); the step's error is of first order."""
    old, stress, goal = random_case(2)
    start, end = angle_to(old.axes, goal[:, 0]), 2.0 * TAU
    exact = 2 * np.arctan(np.tan(start / 2) * np.exp(-end / TAU))
    solved = solve_ivp(lambda t, a: -np.sin(a) / TAU, (0.0, end), start, rtol=1e-10, atol=1e-12).y[
        :, -1
    ]
    np.testing.assert_allclose(solved, exact, atol=1e-8)
    errors = [
        np.abs(
            angle_to(updated(old, pulled(stress), end / passes, passes).axes, goal[:, 0]) - exact
        ).max()
        for passes in (50, 100, 200)
    ]
    assert errors[-1] < 2e-3
    np.testing.assert_allclose(np.log2(np.array(errors[:-1]) / errors[1:]), 1.0, atol=0.05)


def test_axes_stay_orthonormal_and_keep_their_hand_and_the_cell_its_dimensions() -> None:
    rng = np.random.default_rng(3)
    axes = parts.random_rotations(rng, 40)
    axes[::2, 1] *= -1.0
    cells = cells_of(axes)
    for _ in range(300):
        stress = parts.symmetric([3.0, 1.0, -2.0], parts.random_rotations(rng, 40))
        cells = updated(cells, pulled(stress), rng.uniform(0.0, 10.0))
    assert_orthonormal(cells.axes, 1e-13)
    np.testing.assert_allclose(
        np.linalg.det(cells.axes), np.where(np.arange(40) % 2, 1.0, -1.0), atol=1e-13
    )
    squared = np.linalg.eigvalsh(structure_tensor(*cells[:2]))
    np.testing.assert_allclose(squared, np.tile(np.sort(FIBRE**2), (40, 1)), atol=1e-13)


def test_it_is_objective() -> None:
    rng = np.random.default_rng(4)
    old, stress, _ = random_case(4)
    F = parts.random_rotations(rng, 40) @ (np.eye(3) + rng.uniform(-0.3, 0.3, (40, 3, 3)))
    Q = parts.random_rotations(rng, 40)
    still = updated(old, pulled(stress, F), 2.0)
    other = updated(old, pulled(Q @ stress @ np.swapaxes(Q, 1, 2), Q @ F), 2.0)
    np.testing.assert_allclose(other.axes, still.axes, atol=1e-12)
    assert np.abs(still.axes - old.axes).max() > 0.1
    # the goal is the fibre that the deformation carries onto the principal direction
    there = updated(old, pulled(stress, F), 1e9).axes[:, 0]
    carried = np.einsum("nab,nb->na", F, there)
    largest = np.linalg.eigh(stress)[1][:, :, 2]
    np.testing.assert_allclose(np.cross(carried, largest), 0.0, atol=1e-7)


def test_the_fibre_is_the_largest_dimension_whatever_its_number() -> None:
    old, stress, goal = random_case(5)
    expected = updated(old, pulled(stress), 2.0)
    for order in ([1, 2, 0], [2, 0, 1], [0, 2, 1]):
        found = updated(UnitCell(old.dimensions[:, order], old.axes[:, order]), pulled(stress), 2.0)
        np.testing.assert_allclose(found.axes, expected.axes[:, order], atol=1e-13)
    np.testing.assert_array_less(
        angle_to(expected.axes, goal[:, 0]), angle_to(old.axes, goal[:, 0])
    )


# ---------------------------------------------------------------- where the remark's formula has no answer
X, Y, Z = np.eye(3)


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_fibre_along_the_tension_stays_whichever_sense_it_has(sense: float) -> None:
    axes = np.array([[sense * X, Y, Z]])
    new = updated(cells_of(axes), pulled(np.diag([2.0, 1.0, 0.0])[None]), 7.0)
    np.testing.assert_array_equal(new.axes, axes)


def test_a_fibre_across_the_tension_turns_and_rounding_does_not_choose_where() -> None:
    """Both ways are as near. The cell's next axes choose: those that a rotation of everything takes along."""
    turn = parts.random_rotations(np.random.default_rng(7), 1)[0]
    for noise in (0.0, 1e-12, -1e-12):
        axes = Rotation.from_rotvec([0.0, noise, 0.0]).apply(np.eye(3)[[0, 1, 2]])
        new = updated(cells_of(axes[None]), pulled(np.diag([1.0, 0.0, 2.0])[None]), 2.0).axes[0]
        angle = remaining_angle(np.array([np.pi / 2]), 2.0 / TAU)[0]
        np.testing.assert_allclose(
            new[0], [np.sin(angle), 0.0, np.cos(angle)], atol=1e-11
        )  # towards +z, the third
        np.testing.assert_allclose(new[1], Y, atol=1e-11)
        stress = turn @ np.diag([1.0, 0.0, 2.0]) @ turn.T
        other = updated(cells_of((axes @ turn.T)[None]), pulled(stress[None]), 2.0).axes[0]
        np.testing.assert_allclose(other, new @ turn.T, atol=1e-11)


def test_equal_largest_values_take_the_fibre_to_their_plane_the_nearest_way() -> None:
    old, _, goal = random_case(8)
    new = updated(old, pulled(parts.symmetric([3.0, 3.0, -2.0], goal)), 1e9).axes[:, 0]
    projected = old.axes[:, 0] - np.sum(old.axes[:, 0] * goal[:, 2], axis=1)[:, None] * goal[:, 2]
    np.testing.assert_allclose(
        new, projected / np.linalg.norm(projected, axis=1)[:, None], atol=1e-7
    )


@pytest.mark.parametrize(
    ("values", "threshold"),
    [
        ([2.0, 2.0, 2.0], 0.0),
        ([0.0, 0.0, 0.0], 0.0),
        ([-1.0, -2.0, -3.0], 0.0),
        ([1e-3, -1.0, -2.0], 2e-3),
    ],
)
def test_equal_values_and_no_tension_turn_nothing(values: list[float], threshold: float) -> None:
    old, _, goal = random_case(9)
    new = updated(old, pulled(parts.symmetric(values, goal), threshold=threshold), 7.0)
    np.testing.assert_allclose(new.axes, old.axes, atol=1e-14)


def test_the_nearer_sense_is_the_one_in_the_reference_configuration() -> None:
    """In a strong shear a fibre may be near one sense of the tension in space, and its goal near the other one."""
    old, stress, _ = random_case(12)
    F = np.tile(np.eye(3) + 3.0 * np.outer(X, Y), (40, 1, 1))
    goal = updated(old, pulled(stress, F), 1e9).axes[:, 0]
    assert np.all(np.sum(goal * old.axes[:, 0], axis=1) > -1e-3)


# ---------------------------------------------------------------- with the rest
def test_a_share_of_a_rotation_is_a_rotation() -> None:
    """What the coupling `relaxed` makes of it: not the mean of two structure tensors, which would change the cell."""
    old, stress, _ = random_case(11)
    new, share = updated(old, pulled(stress), 2.0), LAWS["rotation"].relax
    half = share(old, new, 0.5)
    np.testing.assert_array_equal(half.dimensions, old.dimensions)
    assert_orthonormal(half.axes, 1e-13)
    once = (
        np.swapaxes(old.axes, 1, 2) @ half.axes
    )  # what turns the old axes into these turns these into the new ones
    np.testing.assert_allclose(half.axes @ once, new.axes, atol=1e-13)
    assert share(old, new, 1.0) is new
    np.testing.assert_array_equal(share(old, old, 0.5).axes, old.axes)


@pytest.mark.parametrize("coupling", ["staggered", "relaxed"])
def test_a_cube_with_fibres_across_its_load(
    coupling: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Driver b, whose principal directions are the cube's: from 90 degrees on, each pass is the implicit step.

    The chains are too few to shear the matrix. A pass puts no axes anywhere at once, so the warning of drivers that
    over-correct does not concern it.
    """
    tau, share = 5.0, {"staggered": 1.0, "relaxed": 0.5}[coupling]
    scene = Scene(
        preset="kuhl-holzapfel-2007",
        geometry={"shape": "cube"},
        material={"chain_density": 1e12},
        cells={"initial": "aligned", "aligned_axis": 1},
        loads=ramped(2.0, force=0.5),
        remodeling={
            "law": "rotation",
            "rotation_time": tau,
            "driver": "finger",
            "coupling": coupling,
        },
        time={"end": 6.0},
    )
    with made(scene) as simulation:
        angles = [step.row["mean_fibre_angle"] for step in simulation.steps()]
    expected = [np.pi / 2]
    for _ in range(5):
        expected.append(
            (1 - share) * expected[-1]
            + share * remaining_angle(np.array(expected[-1:]), 1 / tau)[0]
        )
    np.testing.assert_allclose(angles[-6:], np.degrees(expected), atol=1e-6)
    assert "overshoots" not in caplog.text
