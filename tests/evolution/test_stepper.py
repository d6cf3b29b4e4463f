"""The way through time: a step is all or nothing, watchers see each stage once, steps of any length."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.scene.scene import scene_from_dict
from remodel_fenicsx.schema.settings import Cells, Load
from remodel_fenicsx.simulation import Simulation
from remodel_fenicsx.solver.equilibrium import StateLimits
from remodel_fenicsx.state import State
from tests import parts
from tests.parts import cube

KAPPA = 0.4


def pulled_cube(
    load: Callable[[float], float] = lambda t: 1.0 + t, **remodeling: Any
) -> tuple[parts.Body, Stepper]:
    """One element of isotropic cells, free to contract, a force along z: stress and cells are the same everywhere."""
    made = parts.body(cube(comm=MPI.COMM_SELF), Cells(initial="isotropic")).supported()
    return made, made.stepper(lambda t: {"force": load(t)}, kappa=KAPPA, **remodeling)


# ---------------------------------------------------------------- the length of a step
@pytest.mark.parametrize("law", ["explicit", "rate", "relaxation"])
def test_cells_follow_the_time_not_the_number_of_steps(law: str) -> None:
    """With one tension that lasts, every law is l0 + (r0 e - l0)(1 - exp(-kappa t)), in steps of any length."""
    made, stepper = pulled_cube(law=law)
    start = 1 / np.sqrt(3)
    for time in (0.5, 3.0, 3.25):
        stepper.advance(time)
        left = np.exp(-KAPPA * time)
        expected = np.array([1 + (start - 1) * left, start * left, start * left])
        found = made.cells.dimension_values
        np.testing.assert_allclose(
            found, np.broadcast_to(expected, found.shape), rtol=0, atol=1e-12
        )
        along = np.abs(made.cells.axis_values[..., 0, :])
        np.testing.assert_allclose(along, np.broadcast_to([0.0, 0.0, 1.0], along.shape), atol=1e-12)


def test_the_relaxed_pass_makes_its_share_of_the_change() -> None:
    """Of A = diag(l^2); `residual` is the whole change."""
    made, stepper = pulled_cube(coupling="relaxed", relaxation_factor=0.25)
    assert np.isnan(stepper.remodeling.distance())
    stepper.advance(2.0)
    left, start = np.exp(-KAPPA * 2.0), 1 / np.sqrt(3)
    asked = np.array([1 + (start - 1) * left, start * left, start * left]) ** 2
    found = made.cells.dimension_values**2
    np.testing.assert_allclose(
        found, np.broadcast_to(0.75 / 3 + 0.25 * asked, found.shape), rtol=1e-12
    )
    assert stepper.remodeling.distance() == pytest.approx(np.linalg.norm(asked - 1 / 3), rel=1e-12)


def test_power_is_energy_per_time() -> None:
    """The same state, passed over in steps of 1 and of 4 with the cells' change of the same size."""
    powers = []
    for step, kappa in ((1.0, 0.04), (4.0, 0.01)):
        made = parts.body(cube(comm=MPI.COMM_SELF), Cells(initial="isotropic")).supported()
        stepper = made.stepper(lambda t: {"force": 3.0}, kappa=kappa)
        powers.append(stepper.advance(step).remodeling_power)
    assert powers[0] > 1e-3  # chains that turn towards the tension release energy
    assert powers[1] == pytest.approx(powers[0] / 4, rel=1e-9)


# ---------------------------------------------------------------- watchers
class Notes(Watcher):
    """Writes down who is called when, and what the state is then."""

    def __init__(self, name: str, notes: list[tuple], stepper: Stepper):
        self.name, self.notes, self.stepper, self.state = name, notes, stepper, stepper.state

    def note(self, stage: str, step: Step) -> None:
        state = self.state
        passed = not state.equilibrium_cells.equals(state.cells)
        self.notes.append(
            (self.name, stage, step.number, step.is_last, state.time, state.number, passed)
        )

    def started(self, step: Step) -> None:
        assert step.loads == {"force": 0.0} and step.work.substeps == 0
        self.note("started", step)

    def solved(self, step: Step) -> None:
        assert step.loads == self.state.loading.values == {"force": 1.0 + step.time}
        assert step.remodeling_power == step.seconds == 0.0 and step.work.newton_iterations > 0
        assert step.limits == self.stepper.coupling.equilibrium.limits()
        self.note("solved", step)

    def completed(self, step: Step) -> None:
        assert step.remodeling_power != 0.0 and step.seconds > 0.0
        self.note("completed", step)

    def committed(self, step: Step) -> None:
        self.note("committed", step)


def test_watchers_follow_each_step_from_its_solution_to_its_end() -> None:
    made, stepper = pulled_cube()
    notes: list[tuple] = []
    watchers = [Notes(name, notes, stepper) for name in ("first", "second")]
    steps = list(stepper.march([0.5, 2.0], watchers))
    assert [step.loads for step in steps] == [{"force": 1.5}, {"force": 3.0}]
    assert [(step.time, step.number, step.is_last) for step in steps] == [
        (0.5, 1, False),
        (2.0, 2, True),
    ]
    expected = [("started", 0, False, 0.0, 0, False)]
    for number, (old, new) in enumerate([(0.0, 0.5), (0.5, 2.0)], start=1):
        last = number == 2
        # solved with the cells of the step before; the pass, the time and the number come then
        expected.append(("solved", number, last, old, number - 1, False))
        expected.append(("completed", number, last, new, number, True))
        expected.append(("committed", number, last, new, number, True))
    assert notes == [(name, *entry) for entry in expected for name in ("first", "second")]


def test_the_cells_in_equilibrium_are_those_before_the_pass() -> None:
    made, stepper = pulled_cube()
    stepper.advance(1.0)
    before = made.cells.dimension_values.copy()
    stepper.advance(2.0)
    np.testing.assert_array_equal(stepper.state.equilibrium_cells.dimension_values, before)
    assert np.abs(made.cells.dimension_values - before).max() > 0.01


# ---------------------------------------------------------------- all or nothing


class Raising(Watcher):
    """Raises at a stage, once."""

    def __init__(self, stage: str, error: type[BaseException]):
        self.stage, self.error = stage, error

    def _raise(self, stage: str) -> None:
        if stage == self.stage:
            self.stage = "never again"
            raise self.error(stage)

    def solved(self, step: Step) -> None:
        self._raise("solved")

    def completed(self, step: Step) -> None:
        self._raise("completed")


def test_watchers_forget_a_step_that_has_not_happened_the_last_one_first() -> None:
    _, stepper = pulled_cube()
    notes: list[tuple[str, float]] = []

    class Forgetting(Watcher):
        def __init__(self, name: str):
            self.name = name

        def undone(self, step: Step) -> None:
            notes.append((self.name, step.time))

    watchers = [Forgetting("first"), Raising("solved", OSError), Forgetting("second")]
    with pytest.raises(OSError, match="solved"):
        stepper.advance(0.5, watchers)
    assert notes == [("second", 0.5), ("first", 0.5)]
    stepper.advance(0.5, watchers)
    assert len(notes) == 2


def test_cells_are_the_same_only_if_all_numbers_are() -> None:
    made, stepper = pulled_cube()
    solved = stepper.state.equilibrium_cells
    assert solved.equals(made.cells)
    for function in (made.cells.dimensions, made.cells.axes):
        value = function.x.array[-1]
        function.x.array[-1] += 1e-15
        assert not solved.equals(made.cells)
        function.x.array[-1] = value


# ---------------------------------------------------------------- limits and loads
def test_a_state_starts_unloaded() -> None:
    made, _ = pulled_cube()
    made.loading.set({"force": 3.0})
    fresh = State(made.displacement, made.kinematics, made.cells, made.loading)
    assert made.loading.values == {"force": 0.0} and fresh.time == 0.0 and fresh.number == 0


def test_admissible_is_below_the_contour_length_with_volume_left() -> None:
    here = (0.0, 0.0, 0.0)
    assert StateLimits(0.999, 1e-3, here).admissible
    for extension, jacobian in (
        (1.0, 0.5),
        (1.1, 0.5),
        (0.5, 0.0),
        (0.5, -0.1),
        (np.nan, 0.5),
        (0.5, np.nan),
    ):
        assert not StateLimits(extension, jacobian, here).admissible


def test_extension_names_the_point_where_chains_are_longest() -> None:
    """u = x (X, 0, 0) on chains along x: F_xx = 1 + 2 x, largest at the points next to x = 1."""
    made = parts.body(
        cube(refinement=2, comm=MPI.COMM_SELF), Cells(initial="aligned", aligned_axis=1)
    )
    x = made.nodes[:, :1]
    made.set_displacement(np.hstack([0.2 * x**2, -0.1 * made.nodes[:, 1:2], 0 * x]))
    problem = made.problem()
    found = problem.limits()
    # between the nodes u is linear: F_xx = 1 + 0.2 (x_1 + x_2) with x from 1/2 to 1
    assert found.max_chain_extension == pytest.approx(1.3 / 1.594, rel=1e-13)
    assert found.min_jacobian == pytest.approx(1.1 * 0.9, rel=1e-13)
    assert 0.5 < found.worst_point[0] < 1.0


def test_a_load_between_two_times_of_its_ramp_is_on_the_line_between_them() -> None:
    load = Load(value=2.0, ramp=[[1.0, 0.5], [3.0, 1.5], [4.0, 1.0]])
    assert [load.factor(t) for t in (0.0, 1.0, 1.5, 2.5, 3.0, 3.25, 9.0)] == [
        0.5,
        0.5,
        0.75,
        1.25,
        1.5,
        1.375,
        1.0,
    ]
    table = {
        "preset": "kuhl-holzapfel-2007",
        "geometry": {"shape": "cube"},
        "loads": {"force": load.model_dump()},
    }
    assert Simulation(scene_from_dict(table), MPI.COMM_SELF).load_values(2.5) == {"force": 2.5}
