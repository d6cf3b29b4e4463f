"""Steps that are too large for one solve: in parts to the same state, or a failure that leaves everything as it was."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from remodel_fenicsx.evolution.stepper import Stepper, times
from remodel_fenicsx.scene.scene import Load, preset_scene
from remodel_fenicsx.schema.settings import Cells
from remodel_fenicsx.simulation import Simulation
from remodel_fenicsx.solver.continuation import CellHomotopy, StepFailure, Work
from remodel_fenicsx.solver.equilibrium import StateLimits
from remodel_fenicsx.solver.newton import GuardedNewton, Solution, SolveFailure
from tests import parts
from tests.parts import clamped_cube, tube

FORCE = 14.0


def solve(stepper: Stepper, time: float) -> Work:
    """The first half of a step: equilibrium at its loads, the cells as they are."""
    with stepper.state.transaction():
        work = stepper.coupling.solve(time, stepper.load_values(time))
        stepper.state.time = time
    return work


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
    stepper = made.stepper(lambda t: {"force": min(t, FORCE + 1.0)}, driver=driver, frame=frame)
    for step in times(FORCE, 1.0):
        assert solve(stepper, step).substeps == 1
    stepper.coupling.remodel(time)
    return made, stepper


@pytest.mark.parametrize(("driver", "frame"), [
    ("cauchy", "material"), ("cauchy", "spatial"), ("pk2", "material"), ("finger", "material"),
])  # fmt: skip
def test_a_remodeling_increment_beyond_the_contour_length_ends_where_a_good_start_leads(
    driver: str, frame: str
) -> None:
    """The new cells are too long at the old displacement: exchanged in parts, then loaded, the state is the same."""
    made, stepper = loaded_and_remodeled(driver, frame, 60.0)
    coupling: Any = stepper.coupling
    assert coupling.equilibrium.limits().max_chain_extension > 1.0
    with pytest.raises(SolveFailure):
        coupling.newton.solve()
    assert "equilibrium" not in vars(
        coupling.blend
    )  # what parts are solved with is compiled when a step has some
    said: list[str] = []
    coupling.state.tell = said.append
    assert solve(stepper, FORCE + 1.0).substeps > 1
    assert said[0].startswith(
        "step to t = 15: at 0 % of the change of the cells, attempt 1: a substep of "
    )
    assert any(" % of the change of the loads, attempt " in words for words in said)
    assert coupling.equilibrium.limits().admissible
    assert made.loading.values == {"force": FORCE + 1.0}
    energy, found = coupling.equilibrium.stored_energy(), made.displacement.x.array.copy()

    # a good start: the new cells on the unloaded body, then the load in small steps
    fresh = clamped_cube()
    fresh.cells.set(made.cells.dimension_values, made.cells.axis_values)
    problem = fresh.problem()
    for force in np.linspace(0.0, FORCE + 1.0, 31)[1:]:
        fresh.loading.set({"force": force})
        problem.solve()
    np.testing.assert_allclose(found, fresh.displacement.x.array, rtol=0, atol=1e-9)
    assert energy == pytest.approx(problem.stored_energy(), rel=1e-11)


def test_the_first_part_of_an_exchange_is_no_longer_than_its_bound(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _, stepper = loaded_and_remodeled("cauchy", "material", 60.0)
    coupling: Any = stepper.coupling
    done, real = [0.0], GuardedNewton.solve

    def noted(newton: GuardedNewton, origin: Any = None, loose_tolerance: bool = False) -> Solution:
        if newton is not coupling.newton:
            done.append(float(coupling.blend.theta.value))
        return real(newton, origin, loose_tolerance)

    monkeypatch.setattr(GuardedNewton, "solve", noted)
    monkeypatch.setattr(coupling.blend, "largest_increment", lambda done: 0.1)
    solve(stepper, FORCE + 1.0)
    parts_of_it = np.diff(done)
    assert parts_of_it.max() == pytest.approx(0.1) and done[-1] == 1.0


def test_the_bound_of_a_part_is_where_the_first_point_has_lost_its_share() -> None:
    """From any fraction, at the present unknowns: a fifth of 1 - r/L is left at one point, more elsewhere."""
    _, stepper = loaded_and_remodeled("cauchy", "material", 60.0)
    blend: Any = stepper.coupling.blend  # type: ignore[attr-defined]

    def left(theta: float) -> np.ndarray:
        blend.set(theta)
        return 1 - np.sqrt(blend.equilibrium.squared_lengths()) / parts.MATERIAL.contour_length

    first = blend.largest_increment(0.0)
    for done in (0.0, first / 2):
        before = left(done)
        assert np.min(left(done + blend.largest_increment(done)) / before) == pytest.approx(
            0.2, abs=1e-9
        )


# ---------------------------------------------------------------- failures
def small_tube(load_values: Any, **solver: Any) -> tuple[parts.Body, Stepper]:
    """A short artery with random cells."""
    made = parts.body(
        tube(length=1.0, divisions=(8, 3, 1)), Cells(initial="random", axes="cylindrical")
    )
    made.supported()
    settings = parts.TIGHT.model_copy(update=solver)
    return made, made.stepper(load_values, settings, law="explicit")


def test_an_impossible_load_is_a_failure_that_changes_nothing() -> None:
    """No tube of this wall holds a pressure of 50; a smaller one afterwards goes on from where it was."""
    pressures = {0.0: 0.0, 1.0: 0.5, 2.0: 50.0, 3.0: 1.0}
    made, stepper = small_tube(
        lambda t: {"pressure": pressures[t], "elongation": 0.01 * min(t, 1.0)},
        maximum_halvings=3,
        maximum_iterations=8,
    )
    stepper.advance(1.0)
    before = state(made)
    with pytest.raises(StepFailure) as caught:
        stepper.advance(2.0)
    assert caught.value.time == 2.0
    text = str(caught.value)
    assert text.startswith("no equilibrium at time 2: the change of the loads failed at ")
    assert "largest r/L = " in text and "smallest J = " in text
    point = np.array([float(c) for c in text.split(" at (")[1].split(")")[0].split(", ")])
    assert 1.0 <= np.hypot(*point[:2]) <= 3.0 and 0.0 <= point[2] <= 1.0
    assert_same(before, state(made))
    assert stepper.state.time == 1.0 and made.loading.values == {
        "pressure": 0.5,
        "elongation": 0.01,
    }
    pressures[2.0] = 1.0
    assert stepper.advance(2.0).work.substeps == 1
    assert made.loading.values["pressure"] == 1.0


# ---------------------------------------------------------------- bookkeeping
class Refusing:
    """Stands for `GuardedNewton.solve`: refuses increments of the force above a limit; keeps a record."""

    def __init__(self, made: parts.Body, limit: float):
        self.made, self.limit = made, limit
        self.tried: list[float] = []
        self.accepted = [0.0]

    def __call__(self, origin: Any = None, loose_tolerance: bool = False) -> Solution:
        force = self.made.loading.values["force"]
        self.tried.append(force)
        if force - self.accepted[-1] > self.limit:
            raise SolveFailure(
                "too much", Solution(7, 7, limits=StateLimits(0.9, 0.5, (0.0, 0.0, 0.0)))
            )
        self.accepted.append(force)
        return Solution(3, 3)


def test_parts_are_halved_after_a_failure_and_doubled_after_a_success(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = clamped_cube()
    stepper = made.stepper(lambda t: {"force": 8.0 * t})
    refusing = Refusing(made, 2.5)
    monkeypatch.setattr(stepper.coupling.newton, "solve", refusing)  # type: ignore[attr-defined]
    work = solve(stepper, 1.0)
    # in one piece, then a half, a quarter; each success lets the next part try twice as much
    assert refusing.tried == [8.0, 4.0, 2.0, 6.0, 4.0, 8.0, 6.0, 8.0]
    assert refusing.accepted == [0.0, 2.0, 4.0, 6.0, 8.0]
    assert work.substeps == 4
    assert work.newton_iterations == work.linear_iterations == 4 * 3 + 4 * 7
    assert made.loading.values == {"force": 8.0}


def test_a_part_that_would_go_beyond_the_end_is_halved_from_what_is_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """After three quarters half of the whole would be next: the quarter that is left is refused, an eighth tried."""
    made = clamped_cube()
    stepper = made.stepper(lambda t: {"force": 8.0 * t})
    refusing = Refusing(made, 2.5)
    real = refusing.__call__

    def stricter_near_the_end(origin: Any = None, loose_tolerance: bool = False) -> Solution:
        refusing.limit = 1.5 if refusing.accepted[-1] >= 6.0 else 2.5
        return real()

    monkeypatch.setattr(stepper.coupling.newton, "solve", stricter_near_the_end)  # type: ignore[attr-defined]
    assert solve(stepper, 1.0).substeps == 5
    assert refusing.tried == [8.0, 4.0, 2.0, 6.0, 4.0, 8.0, 6.0, 8.0, 7.0, 8.0]


@pytest.mark.parametrize("halvings", [0, 3])
def test_the_number_of_halvings_is_the_scenes(
    halvings: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = clamped_cube()
    stepper = made.stepper(
        lambda t: {"force": 8.0 * t}, parts.TIGHT.model_copy(update={"maximum_halvings": halvings})
    )
    refusing = Refusing(made, 0.0)
    monkeypatch.setattr(stepper.coupling.newton, "solve", refusing)  # type: ignore[attr-defined]
    with pytest.raises(StepFailure, match="loads"):
        stepper.advance(1.0)
    assert refusing.tried == [8.0 / 2**k for k in range(halvings + 1)]
    assert made.loading.values == {"force": 0.0}


def test_times_are_computed_from_their_numbers() -> None:
    assert list(times(150.0, 1.0)) == [float(k) for k in range(1, 151)]
    assert list(times(100.0, 0.1)) == [
        k / 10 for k in range(1, 1001)
    ]  # 0.3, not 3 * 0.1 = 0.30000000000000004
    assert list(times(0.3, 0.1)) == [0.1, 0.2, 0.3] and 0.3 / 0.1 < 3.0
    assert list(times(1.0, 0.3333333333)) == [
        0.3333333333,
        0.6666666666,
        1.0,
    ]  # a third, as a scene may write it


def test_loads_are_hit_exactly_at_the_times_of_the_ramp() -> None:
    ramp = [[0.0, 0.0], [0.3, 1.0], [0.6, 0.25]]
    load = Load(value=10.0, ramp=ramp)
    factors = {time: load.factor(time) for time in times(0.7, 0.1)}
    assert [factors[time] for time in (0.3, 0.6, 0.7)] == [1.0, 0.25, 0.25]
    assert load.factor(0.1 + 0.2) == load.factor(0.3 - 1e-16) == 1.0
    assert factors[0.5] == pytest.approx(0.5, rel=1e-14)


def test_after_an_exchange_of_the_cells_the_loads_are_tried_in_one_piece(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The failure of the whole step says nothing of the loads alone: they start from another state now."""
    made = clamped_cube()
    stepper = made.stepper(lambda t: {"force": t}, kappa=0.4)
    stepper.advance(1.0)
    coupling: Any = stepper.coupling
    tried: list[tuple[str, float]] = []

    def refuse_the_first(
        newton: GuardedNewton, origin: Any = None, loose_tolerance: bool = False
    ) -> Solution:
        tried.append(
            ("loads" if newton is coupling.newton else "cells", made.loading.values["force"])
        )
        if len(tried) == 1:
            raise SolveFailure(
                "too much", Solution(7, 7, limits=StateLimits(0.9, 0.5, (0.0, 0.0, 0.0)))
            )
        return Solution(3, 3)

    monkeypatch.setattr(GuardedNewton, "solve", refuse_the_first)
    work = solve(stepper, 9.0)
    assert tried == [("loads", 9.0), ("cells", 1.0), ("loads", 9.0)]
    assert work.substeps == 2 and work.newton_iterations == 7 + 3 + 3


def test_without_a_change_of_the_cells_only_the_loads_are_divided(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """From the load of the step before to exactly the new one, which their difference misses by rounding."""
    made = clamped_cube()
    old, new = 0.4, 1.8
    assert old + (new - old) != new
    stepper = made.stepper(lambda t: {"force": {1.0: old, 2.0: new}[t]}, law="none")
    stepper.advance(1.0)
    refusing = Refusing(made, 0.8)
    refusing.accepted = [old]
    monkeypatch.setattr(stepper.coupling.newton, "solve", refusing)  # type: ignore[attr-defined]
    assert solve(stepper, 2.0).substeps == 2
    assert refusing.tried == pytest.approx([new, (old + new) / 2, new], rel=1e-14)
    assert made.loading.values["force"] == new


def test_power_of_remodeling_is_the_derivative_of_the_stored_energy() -> None:
    """-dE/dtheta / dt of the blend of old and new cells at frozen displacement, by central differences."""
    scene = preset_scene("kuhl-holzapfel-2007", "cube").with_values(
        {"cells.initial": "random", "mesh.refinement": 2}
    )
    simulation = Simulation(scene)
    stepper = simulation.stepper
    tissue, solver = stepper.tissue, scene.solver
    for time in (1.0, 2.0, 4.5):  # steps that are not one: power is energy per time
        step = time - stepper.state.time
        power = stepper.advance(time).remodeling_power
        blend = CellHomotopy(simulation.state, tissue, solver)
        energy = {}
        for theta in (1e-4, -1e-4):
            blend.set(theta)
            energy[theta] = blend.equilibrium.stored_energy()
        assert abs(power) > 1e-3
        assert power == pytest.approx(-(energy[1e-4] - energy[-1e-4]) / 2e-4 / step, rel=1e-6)
