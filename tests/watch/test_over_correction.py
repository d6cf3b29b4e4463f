"""Passes that over-correct: what starts from rounding alone does not start, all else is warned of, nothing else is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.model.cells import angle_to_axis
from remodel_fenicsx.scene import preset_scene
from remodel_fenicsx.simulation import Simulation
from remodel_fenicsx.solver.continuation import Work
from remodel_fenicsx.watch.over_correction import OverCorrection
from tests import parts
from tests.body.test_cube import axial_stretch, closed_form_angle
from tests.conftest import slowly

PAPER = "kuhl-holzapfel-2007"
KAPPA, END = 0.025, 100.0


def cube(force: float, **changes: Any) -> Simulation:
    """The preset's cube under another load."""
    values = {"loads.force.value": force} | {
        name.replace("__", "."): value for name, value in changes.items()
    }
    return Simulation(preset_scene(PAPER, "cube").with_values(values), MPI.COMM_SELF)


def tilt(simulation: Simulation, angle: float) -> None:
    """Turn the cell of one point about y, by an angle in radians."""
    axes = simulation.cells.axis_values
    axes[0, 0] = axes[0, 0] @ parts.rotation((0.0, 1.0, 0.0), np.degrees(angle)).T


class Tilt(Watcher):
    """Turns the cell of one point once, at a time."""

    def __init__(self, simulation: Simulation, time: float, angle: float):
        self.simulation, self.time, self.angle = simulation, time, angle

    def completed(self, step: Step) -> None:
        """Turn it."""
        if step.time == self.time:
            tilt(self.simulation, self.angle)


def angles(simulation: Simulation) -> np.ndarray:
    """Angle between chains and load after the last pass, degrees, all points."""
    return angle_to_axis(
        simulation.cells.dimension_values, simulation.cells.axis_values, np.array([0.0, 0.0, 1.0])
    )


# ---------------------------------------------------------------- weak loads
@pytest.mark.parametrize("frame", ["spatial", "material"])
@pytest.mark.parametrize("force", [0.03, *slowly(1e-4, 0.01, 0.1, 0.5)])
def test_the_angle_under_a_weak_load_is_the_closed_form(
    force: float, frame: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Where a pass multiplies a tilt by -100 (force 1e-4 to 1e-3), rounding must not be one. No false alarm either."""
    simulation = cube(force, remodeling__frame=frame)
    *_, last = simulation.steps()
    np.testing.assert_allclose(angles(simulation), closed_form_angle(KAPPA, END), rtol=0, atol=1e-8)
    expected = axial_stretch(force, 1 - np.exp(-KAPPA * (END - 1.0)))
    assert last.row["mean_stretch"] == pytest.approx(expected, abs=1e-8)
    assert "overshoots" not in caplog.text


@pytest.mark.parametrize(("force", "swings"), [(0.01, True), (0.5, False)])
def test_a_tilt_that_grows_is_warned_of_before_the_angle_is_off(
    force: float, swings: bool, caplog: pytest.LogCaptureFixture
) -> None:
    simulation = cube(force, time__end=45.0)
    warned, off = [], []
    for step in simulation.steps([Tilt(simulation, 20.0, 1e-8)]):
        if "overshoots" in caplog.text:
            warned.append(step.time)
        if abs(np.mean(angles(simulation)) - closed_form_angle(KAPPA, step.time)) > 0.5:
            off.append(step.time)
    assert bool(warned) == bool(off) == swings
    if swings:
        assert warned[0] <= off[0] + 1
        (record,) = caplog.records
        assert record.levelname == "WARNING" and record.message.startswith(
            f"time {warned[0]:g}: the remodeling pass"
        )
        assert 'coupling = "relaxed" with a relaxation_factor below 0.1' in record.message


def test_loads_that_swing_themselves_are_no_over_correction(
    caplog: pytest.LogCaptureFixture,
) -> None:
    ramp = [[float(time), 1.0 if time % 2 else 0.3] for time in range(21)]
    simulation = cube(10.0, time__end=20.0, loads__force__ramp=ramp, remodeling__law="relaxation")
    rows = [step.row for step in simulation.steps()]
    assert np.ptp([row["mean_stretch"] for row in rows[10:]]) > 0.1
    assert "overshoots" not in caplog.text


# ---------------------------------------------------------------- the measure
class Scripted:
    """Sets the cells and the displacement after each pass to A_0 + a smooth course + a swing, instead of a law."""

    def __init__(self, factor: float, size: float, **changes: Any):
        self.simulation = cube(1.0, loads__force__ramp=[[0.0, 1.0]], **changes)
        self.stepper: Stepper = self.simulation.stepper
        (self.watcher,) = (
            watcher for watcher in self.simulation.watchers if isinstance(watcher, OverCorrection)
        )
        self.factor, self.size = factor, size

    def step(self, number: int) -> Step:
        """The state of a number."""
        swing = self.size * self.factor**number
        self.simulation.cells.dimension_values[..., 2] = np.sqrt(0.5 + 0.01 * number + swing)
        return Step(
            float(number),
            number,
            {"force": 1.0},
            self.stepper.coupling.equilibrium.limits(),
            Work(),
        )

    def passes(self, last: int, rest: int = 0) -> None:
        """Until the last one; in one of them the cells may rest."""
        self.watcher.started(self.step(0))
        for number in range(1, last + 1):
            step = self.step(number)
            if number == rest:
                self.step(number - 1)
            self.watcher.completed(step)
            self.watcher.committed(step)


@pytest.mark.parametrize("factor", [-3.0, -1.1, -0.5, 0.9])
def test_factor_and_size_of_a_swing_are_found_beside_a_smooth_course(factor: float) -> None:
    scripted = Scripted(factor, 4e-5)
    scripted.passes(6)
    swing = scripted.watcher.swings["growing"]
    assert swing.factor == pytest.approx(factor, rel=1e-6)
    # the third difference of f^k is f^(k-3) (f - 1)^3
    expected = 4e-5 * abs(factor) ** 3 * abs(factor - 1) ** 3 / 8
    assert swing.size == pytest.approx(expected, rel=1e-6)
    assert scripted.watcher.is_reported == (factor == -3.0)


@pytest.mark.parametrize(("coupling", "said"), [("staggered", True), ("extrapolated", True)])
def test_rows_whose_cells_belong_to_their_stress_over_correct_nothing(
    coupling: str, said: bool
) -> None:
    """Long steps may look like a swing; an explicit rule does swing."""
    law = {
        "remodeling__law": "tensor",
        "material__repulsion": "log",
        "remodeling__coupling": coupling,
    }
    scripted = Scripted(-3.0, 4e-5, **law)
    scripted.passes(8)
    assert scripted.watcher.is_reported == said


def test_passes_around_a_rest_do_not_count() -> None:
    """Cells that go on after a rest jump. The same swing without one is warned of at 6, as above."""
    scripted = Scripted(-3.0, 4e-5)
    scripted.passes(8, rest=5)
    assert not scripted.watcher.is_reported


# ---------------------------------------------------------------- cells that rest
class Shut(Watcher):
    """Lets no cell of some points remodel in some passes, as if there were no tension."""

    def __init__(self, simulation: Simulation, passes: set[int], points: slice):
        self.simulation, self.passes, self.points = simulation, passes, points

    def solved(self, step: Step) -> None:
        """What the cells are."""
        cells = self.simulation.cells
        self.kept = cells.dimension_values.copy(), cells.axis_values.copy()

    def completed(self, step: Step) -> None:
        """They are it again."""
        if step.number in self.passes:
            cells = self.simulation.cells
            cells.dimension_values[:, self.points] = self.kept[0][:, self.points]
            cells.axis_values[:, self.points] = self.kept[1][:, self.points]


@pytest.mark.parametrize(
    ("law", "passes", "points", "said"),
    [
        ("explicit", range(5, 12), slice(None), "time 12: cells resume remodeling"),
        ("explicit", range(1, 12), slice(None), ""),  # had never moved: a load that comes late
        ("explicit", range(12, 13), slice(0, 1), ""),  # a little, in a part of the body
        ("relaxation", range(5, 12), slice(None), ""),  # does not make up for it
    ],
)
def test_cells_that_make_up_for_a_rest_are_warned_of(
    law: str, passes: range, points: slice, said: str, caplog: pytest.LogCaptureFixture
) -> None:
    simulation = cube(10.0, remodeling__law=law, remodeling__kappa=0.1, time__end=14.0)
    simulation.watchers.insert(0, Shut(simulation, set(passes), points))
    list(simulation.steps())
    assert caplog.text.count("cells resume remodeling") == bool(said)
    assert said in caplog.text
    if said:
        assert "1e+02 % of the body" in caplog.text


def test_a_rest_without_loads_is_no_matter_of_steps(caplog: pytest.LogCaptureFixture) -> None:
    """Cells rest because the force is off: they would with any step."""
    ramp = [[0.0, 0.0], [2.0, 1.0], [8.0, 1.0], [9.0, 0.0], [14.0, 0.0], [15.0, 1.0]]
    simulation = cube(
        10.0,
        loads__force__ramp=ramp,
        remodeling__law="explicit",
        remodeling__kappa=0.1,
        time__end=17.0,
    )
    list(simulation.steps())
    assert "resume remodeling" not in caplog.text
