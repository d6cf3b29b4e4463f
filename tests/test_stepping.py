"""Steps that are too large for one solve: in parts to the same state, or a failure that leaves everything as it was."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from remodel_fenicsx.body import cube, tube
from remodel_fenicsx.body.loading import tube_loading
from remodel_fenicsx.scene.parameters import Cells, Remodeling
from remodel_fenicsx.evolution.equilibrium import EquilibriumProblem, Extension, Solution, SolveFailure
from remodel_fenicsx.evolution.remodeling import RemodelingPass
from remodel_fenicsx.scene.scene import Load, Solver, preset_scene
from remodel_fenicsx.evolution import stepper as stepping
from remodel_fenicsx.simulation import Simulation
from remodel_fenicsx.evolution.stepper import KEPT_RESERVE, StepFailure, Stepper, times
from tests import parts

FORCE = 14.0


def clamped_cube() -> parts.Body:
    """Random cells, the bottom clamped, a dead force on the top."""
    made = parts.body(cube(refinement=2), Cells(initial="random", seed=3))
    for component in range(3):
        made.loading.hold_face("z0", component)
    made.loading.add_dead_force("force", "z1", component=2)
    return made


def stepper_of(made: parts.Body, load_values: Any, solver: Solver = parts.TIGHT, **remodeling: Any) -> Stepper:
    """The body's way through time."""
    remodeling_pass = RemodelingPass(made.displacement, made.cells, parts.MATERIAL, Remodeling(**remodeling))
    return Stepper(made.displacement, made.loading, made.cells, parts.MATERIAL, remodeling_pass, solver, load_values)


def state(made: parts.Body) -> dict[str, np.ndarray]:
    """Copies of everything that a step changes."""
    return {
        "u": made.displacement.x.array.copy(),
        "l": made.cells.dimension_values.copy(),
        "n": made.cells.axis_values.copy(),
        "loads": np.array(list(made.loading.values.values())),
    }


def assert_same(first: dict[str, np.ndarray], second: dict[str, np.ndarray]) -> None:
    """Bit by bit."""
    for name, values in first.items():
        np.testing.assert_array_equal(values, second[name], err_msg=name)


# ---------------------------------------------------------------- in parts to the same state
def loaded_and_remodeled(driver: str, frame: str, time: float) -> tuple[parts.Body, Stepper]:
    """Fourteen load steps, then one remodeling pass with most of the remodeling at once; the load goes on to 15."""
    made = clamped_cube()
    stepper = stepper_of(made, lambda t: {"force": min(t, FORCE + 1.0)}, driver=driver, frame=frame)
    for step in times(FORCE, 1.0):
        assert stepper.solve(step).work.substeps == 1
    stepper.remodel(time)
    return made, stepper


@pytest.mark.parametrize(("driver", "frame"), [
    ("cauchy", "material"), ("cauchy", "spatial"), ("pk2", "material"), ("finger", "material"),
])  # fmt: skip
def test_a_remodeling_increment_beyond_the_contour_length_ends_where_a_good_start_leads(
    driver: str, frame: str
) -> None:
    """The new cells are too long at the old displacement: exchanged in parts, then loaded, the state is the same."""
    made, stepper = loaded_and_remodeled(driver, frame, 60.0)
    assert stepper.problem.extension().max_chain_extension > 1.0
    with pytest.raises(SolveFailure):
        stepper.problem.solve()
    solved = stepper.solve(FORCE + 1.0)
    assert solved.work.substeps > 1
    assert solved.extension.admissible and solved.extension == stepper.problem.extension()
    assert solved.loads == made.loading.values == {"force": FORCE + 1.0}
    energy, found = stepper.problem.stored_energy(), made.displacement.x.array.copy()

    # a good start: the new cells on the unloaded body, then the load in small steps
    fresh = clamped_cube()
    fresh.cells.set(made.cells.dimension_values, made.cells.axis_values)
    problem = fresh.problem()
    for force in np.linspace(0.0, FORCE + 1.0, 31)[1:]:
        fresh.loading.set({"force": force})
        problem.solve()
    np.testing.assert_allclose(found, fresh.displacement.x.array, rtol=0, atol=1e-9)
    assert energy == pytest.approx(problem.stored_energy(), rel=1e-11)


def test_a_step_that_needs_no_parts_is_one_solve() -> None:
    made = clamped_cube()
    stepper = stepper_of(made, lambda t: {"force": t})
    stepper.solve(1.0)
    stepper.remodel(1.0)
    start = state(made)
    solved = stepper.solve(2.0)
    assert solved.work.substeps == 1
    found = made.displacement.x.array.copy()
    made.displacement.x.array[:] = start["u"]
    direct = stepper.problem.solve()
    assert direct.newton_iterations == solved.work.newton_iterations
    np.testing.assert_array_equal(made.displacement.x.array, found)


def test_each_part_of_the_exchange_leaves_a_reserve_at_every_point(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the start of each part of the exchange no point has lost more than the agreed share of 1 - r/L."""
    _, stepper = loaded_and_remodeled("cauchy", "material", 60.0)
    length = parts.MATERIAL.contour_length
    real, before = EquilibriumProblem.solve, [stepper.problem.extension()]
    reserve: list[float] = []

    def watched(problem: EquilibriumProblem) -> Solution:
        if problem is not stepper.problem:
            now = 1 - np.sqrt(problem.squared_lengths()) / length
            if reserve_before:
                reserve.append(float(np.min(now / reserve_before[-1])))
        solution = real(problem)
        if problem is not stepper.problem:
            reserve_before.append(1 - np.sqrt(problem.squared_lengths()) / length)
        return solution

    reserve_before: list[np.ndarray] = []
    monkeypatch.setattr(EquilibriumProblem, "solve", watched)
    assert stepper.solve(FORCE + 1.0).work.substeps > 2
    assert before[0].max_chain_extension > 1.0
    assert reserve and min(reserve) > KEPT_RESERVE - 1e-9
    assert min(reserve) < KEPT_RESERVE + 1e-6  # the bound decides, not a failed solve


# ---------------------------------------------------------------- failures
def small_tube(load_values: Any, **solver: Any) -> tuple[parts.Body, Stepper]:
    """A short artery with random cells."""
    made = parts.body(tube(length=1.0, divisions=(8, 3, 1)), Cells(initial="random", axes="cylindrical"))
    made.loading = tube_loading(made.domain, made.displacement)
    settings = parts.TIGHT.model_copy(update=solver)
    return made, stepper_of(made, load_values, settings, law="explicit")


def test_an_impossible_load_is_a_failure_that_changes_nothing() -> None:
    """No tube of this wall holds a pressure of 50; a smaller one afterwards goes on from where it was."""
    pressures = {0.0: 0.0, 1.0: 0.5, 2.0: 50.0, 3.0: 1.0}
    made, stepper = small_tube(
        lambda t: {"pressure": pressures[t], "stretch": 0.01 * min(t, 1.0)}, maximum_halvings=3, maximum_iterations=8
    )
    stepper.solve(1.0)
    stepper.remodel(1.0)
    before = state(made)
    with pytest.raises(StepFailure) as caught:
        stepper.solve(2.0)
    assert caught.value.time == 2.0
    text = str(caught.value)
    assert text.startswith("no equilibrium at time 2: the change of the loads stops at ")
    assert "largest r/L = " in text and "smallest J = " in text
    point = np.array([float(c) for c in text.split(" at (")[1].split(")")[0].split(", ")])
    assert 1.0 <= np.hypot(*point[:2]) <= 3.0 and 0.0 <= point[2] <= 1.0
    assert_same(before, state(made))
    assert stepper.time == 1.0 and made.loading.values == {"pressure": 0.5, "stretch": 0.01}
    pressures[2.0] = 1.0
    assert stepper.solve(2.0).work.substeps == 1
    assert made.loading.values["pressure"] == 1.0


def test_cells_that_cannot_be_exchanged_are_a_failure_that_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    made, stepper = loaded_and_remodeled("cauchy", "material", 60.0)
    before = state(made)
    real = EquilibriumProblem.solve

    def refuse(problem: EquilibriumProblem) -> Solution:
        real(problem)
        made.displacement.x.array[:] = before["u"]
        raise SolveFailure("refused", 2, 3, Extension(0.9, 0.5, (0.25, 0.5, 1.0)))

    monkeypatch.setattr(EquilibriumProblem, "solve", refuse)
    with pytest.raises(StepFailure) as caught:
        stepper.solve(FORCE + 1.0)
    assert str(caught.value) == (
        f"no equilibrium at time {FORCE + 1:g}: the change of the cells stops at 0 % of the step (refused; "
        "largest r/L = 0.9000 at (0.250, 0.500, 1.000), smallest J = 0.5)"
    )
    assert_same(before, state(made))
    monkeypatch.undo()
    assert stepper.solve(FORCE + 1.0).work.substeps > 1  # nothing is left of the failed attempt


# ---------------------------------------------------------------- bookkeeping
class Refusing:
    """Stands for `EquilibriumProblem.solve`: refuses increments of the force above a limit; keeps a record."""

    def __init__(self, made: parts.Body, limit: float):
        self.made, self.limit = made, limit
        self.tried: list[float] = []
        self.accepted = [0.0]

    def __call__(self) -> Solution:
        force = self.made.loading.values["force"]
        self.tried.append(force)
        if force - self.accepted[-1] > self.limit:
            raise SolveFailure("too much", 7, 7, Extension(0.9, 0.5, (0.0, 0.0, 0.0)))
        self.accepted.append(force)
        return Solution(3, 3)


def test_parts_are_halved_after_a_failure_and_doubled_after_a_success(monkeypatch: pytest.MonkeyPatch) -> None:
    made = clamped_cube()
    stepper = stepper_of(made, lambda t: {"force": 8.0 * t})
    refusing = Refusing(made, 2.5)
    monkeypatch.setattr(stepper.problem, "solve", refusing)
    solved = stepper.solve(1.0)
    # in one piece, then a half, a quarter; each success lets the next part try twice as much
    assert refusing.tried == [8.0, 4.0, 2.0, 6.0, 4.0, 8.0, 6.0, 8.0]
    assert refusing.accepted == [0.0, 2.0, 4.0, 6.0, 8.0]
    assert solved.work.substeps == 4
    assert solved.work.newton_iterations == solved.work.linear_iterations == 4 * 3 + 4 * 7
    assert made.loading.values == {"force": 8.0}


def test_parts_that_do_not_divide_the_step_end_on_its_load_exactly(monkeypatch: pytest.MonkeyPatch) -> None:
    made = clamped_cube()
    target = 0.1 + 0.2  # not what 3 * 0.1 or sums of parts of it give
    stepper = stepper_of(made, lambda t: {"force": target if t else 0.0})
    refusing = Refusing(made, target / 11)
    monkeypatch.setattr(stepper.problem, "solve", refusing)
    solved = stepper.solve(1.0)
    assert made.loading.values["force"] == target == refusing.accepted[-1]
    assert np.all(np.diff(refusing.accepted) > 0) and solved.work.substeps == len(refusing.accepted) - 1


@pytest.mark.parametrize("halvings", [0, 3])
def test_the_number_of_halvings_is_the_scenes(halvings: int, monkeypatch: pytest.MonkeyPatch) -> None:
    made = clamped_cube()
    stepper = stepper_of(
        made, lambda t: {"force": 8.0 * t}, parts.TIGHT.model_copy(update={"maximum_halvings": halvings})
    )
    refusing = Refusing(made, 0.0)
    monkeypatch.setattr(stepper.problem, "solve", refusing)
    with pytest.raises(StepFailure, match="the change of the loads stops at 0 % of the step"):
        stepper.solve(1.0)
    assert refusing.tried == [8.0 / 2**k for k in range(halvings + 1)]
    assert made.loading.values == {"force": 0.0}


def test_times_are_computed_from_their_numbers() -> None:
    assert list(times(150.0, 1.0)) == [float(k) for k in range(1, 151)]
    assert list(times(100.0, 0.1)) == [k / 10 for k in range(1, 1001)]  # 0.3, not 3 * 0.1 = 0.30000000000000004
    assert list(times(1.0, 0.3333333333)) == [0.3333333333, 0.6666666666, 1.0]  # a third, as a scene may write it


def test_loads_are_hit_exactly_at_the_times_of_the_ramp() -> None:
    ramp = [[0.0, 0.0], [0.3, 1.0], [0.6, 0.25]]
    load = Load(value=10.0, ramp=ramp)
    factors = {time: load.factor(time) for time in times(0.7, 0.1)}
    assert [factors[time] for time in (0.3, 0.6, 0.7)] == [1.0, 0.25, 0.25]
    assert load.factor(0.1 + 0.2) == load.factor(0.3 - 1e-16) == 1.0
    assert factors[0.5] == pytest.approx(0.5, rel=1e-14)


def test_a_load_that_is_there_from_the_start_can_be_solved_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """The body at t = 0 is unloaded: the first step goes from nothing to the load, whatever the ramp says of t = 0."""
    made = clamped_cube()
    stepper = stepper_of(made, lambda t: {"force": 8.0})
    assert made.loading.values == {"force": 0.0}
    refusing = Refusing(made, 5.0)
    monkeypatch.setattr(stepper.problem, "solve", refusing)
    assert stepper.solve(1.0).work.substeps == 2
    assert refusing.tried == [8.0, 4.0, 8.0]


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e6])
def test_an_unloaded_step_converges_in_any_unit_of_stress(unit: float) -> None:
    scene = preset_scene("kuhl-holzapfel-2007", "tendon").with_values(
        {
            "material.lame_lambda": 27.293 * unit,
            "material.lame_mu": 3.103 * unit,
            "material.chain_density": 2e21 * unit,
            "loads.force.ramp": [[0.0, 0.0], [1.0, 0.0], [2.0, unit / 12]],
            "time.end": 2.0,
        }
    )
    first, second = Simulation(scene).steps()
    assert first.row["substeps"] == 1 and first.row["mean_stretch"] == pytest.approx(1.0, abs=1e-12)
    assert second.row["mean_stretch"] == pytest.approx(1.2034, abs=1e-3)  # as with the paper's numbers


@pytest.mark.parametrize(("metre", "unit", "pascal"), [(1.0, "MPa", 1e6), (1e-3, "kPa", 1e3), (1e-3, "MPa", 1e6)])
@pytest.mark.parametrize("shape", ["cube", "tube"])
def test_the_answer_does_not_depend_on_the_units(shape: str, metre: float, unit: str, pascal: float) -> None:
    """The same body in metres and MPa, say: no tolerance may be hidden in a unit."""
    scene = preset_scene("kuhl-holzapfel-2007", shape).with_values({"time.end": 4.0, "cells.initial": "isotropic"})
    lengths = ("side", "inner_radius", "outer_radius", "length")
    changes = {
        f"geometry.{key}": getattr(scene.geometry, key) * metre for key in lengths if hasattr(scene.geometry, key)
    }
    changes |= {f"material.{key}": getattr(scene.material, key) / pascal for key in ("lame_lambda", "lame_mu")}
    load, power = ("force", metre**2) if shape == "cube" else ("pressure", 1.0)
    changes |= {"material.stress_unit": unit, f"loads.{load}.value": scene.loads[load].value * power / pascal}
    columns = {"cube": {"mean_stretch": 1.0}, "tube": {"outer_radius": metre, "fibre_angle_inner": 1.0}}[shape]
    for expected, found in zip(Simulation(scene).steps(), Simulation(scene.with_values(changes)).steps(), strict=True):
        assert found.row["newton_iterations"] == expected.row["newton_iterations"]
        for column, factor in columns.items():
            assert found.row[column] == pytest.approx(factor * expected.row[column], rel=1e-9), column


def test_power_of_remodeling_is_the_derivative_of_the_stored_energy() -> None:
    """-dE/dtheta / dt of the blend of old and new cells at frozen displacement, by central differences."""
    scene = preset_scene("kuhl-holzapfel-2007", "cube").with_values({"cells.initial": "random", "mesh.refinement": 2})
    simulation = Simulation(scene)
    stepper = simulation.stepper
    for time in (1.0, 2.0, 3.0):
        stepper.solve(time)
        power = stepper.remodel(time)
        blend = stepping._Blend(stepper)
        blend.load_cells()
        energy = {}
        for theta in (1e-4, -1e-4):
            blend.set(theta)
            energy[theta] = blend.problem.stored_energy()
        assert abs(power) > 1e-3
        assert power == pytest.approx(-(energy[1e-4] - energy[-1e-4]) / 2e-4, rel=1e-6)
