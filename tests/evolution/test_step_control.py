"""Steps chosen by a tolerance: they keep it, hit what must be hit, and go on as if nothing had happened."""

from __future__ import annotations

from itertools import pairwise
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx import Recording, SceneError, Simulation
from remodel_fenicsx.evolution.remodeling import RemodelingPass
from remodel_fenicsx.evolution.stepper import Pause, Step, Watcher
from remodel_fenicsx.evolution.time_steps import Estimate
from remodel_fenicsx.model.cells import UnitCell, angle_between
from remodel_fenicsx.running import resume, run
from remodel_fenicsx.scene.scene import Scene, scene_from_dict
from remodel_fenicsx.schema.settings import MOST_STEPS, Time
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.solver.diagnosis import TOO_LARGE
from remodel_fenicsx.system.interrupts import Paused
from tests.conftest import Refused
from tests.runs import made
from tests.values import PAPER, isotropic, ramp_to

END = 40.0
COUPLINGS = {"staggered": PAPER, "relaxed": PAPER, "extrapolated": "consistent"}
PRESETS = tuple(dict.fromkeys(COUPLINGS.values()))


def tube(coupling: str, end: float = END, **changes: Any) -> Scene:
    """The wall of the paper's artery, of isotropic cells."""
    scene = scene_from_dict(
        isotropic(COUPLINGS[coupling], remodeling={"frame": "material", "coupling": coupling})
    )
    return scene.with_values({"time.end": end, **changes})


class Angles(Watcher):
    """Fibre angles and cells of the accepted rows by time."""

    def __init__(self, simulation: Simulation):
        self.simulation, self.by_time = simulation, dict[float, np.ndarray]()
        self.cells = dict[float, UnitCell]()

    def committed(self, step: Step) -> None:
        simulation = self.simulation
        cells, local = simulation.state.equilibrium_cells, simulation.cells.local_axes.axes
        angles = simulation.scene.geometry.fibre_angle(
            cells.dimension_values, cells.axis_values, local
        )
        self.by_time[step.time] = angles.copy()
        self.cells[step.time] = UnitCell(*(values.copy() for values in cells.point_cells[:2]))


def marched(scene: Scene) -> tuple[list[Step], Angles]:
    """All steps, and the angles of their rows."""
    with made(scene) as simulation:
        angles = Angles(simulation)
        steps = list(simulation.steps([angles]))
    return steps, angles


@pytest.fixture(scope="module")
def artery() -> dict[str, tuple[list[Step], Angles]]:
    """One controlled run of each coupling."""
    return {name: marched(tube(name, **{"time.tolerance": 1.0})) for name in COUPLINGS}


def distance(simulation: Simulation, first: np.ndarray, second: np.ndarray) -> float:
    """Root mean square over the body."""
    return float(np.sqrt(simulation.quadrature.mean((first - second) ** 2)))


@pytest.fixture(scope="module")
def exact() -> dict[str, dict[float, np.ndarray]]:
    """Of eq. (11) Richardson's extrapolation of halved steps; of the law `tensor`, small steps of second order."""
    coarse, fine, tensor = (
        marched(tube(coupling, **{"time.step": step}))[1].by_time
        for coupling, step in (("staggered", 0.25), ("staggered", 0.125), ("extrapolated", 0.5))
    )
    printed = {time: 2 * fine[time] - angles for time, angles in coarse.items()}
    return dict(zip(PRESETS, (printed, tensor), strict=True))


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_the_estimate_is_the_error(
    coupling: str,
    artery: dict[str, tuple[list[Step], Angles]],
    exact: dict[str, dict[float, np.ndarray]],
) -> None:
    """At the end of the ramp and of the run; errors that cancel over time are not counted on."""
    steps, angles = artery[coupling]
    for time in (25.0, END):
        step = next(step for step in steps if step.time == time)
        error = distance(angles.simulation, angles.by_time[time], exact[COUPLINGS[coupling]][time])
        assert step.time_error / 4 < error < 2.5 * step.time_error, (
            coupling,
            time,
            error,
            step.time_error,
        )


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_no_step_is_above_the_tolerance_and_few_are_far_below(
    coupling: str, artery: dict[str, tuple[list[Step], Angles]]
) -> None:
    steps, _ = artery[coupling]
    errors = np.array([step.time_error for step in steps])
    assert errors.max() <= 1.0 and np.median(errors) > 0.15
    assert [step.row["time_error"] for step in steps] == errors.tolist()
    assert len(steps) < 90


def test_no_row_of_the_printed_method_is_off_by_more_than_the_tolerance() -> None:
    """Chains in space, their pitch, and radii, against steps of a sixteenth; the estimate is the error."""
    tolerance, radii = 2.0, ["inner_radius", "outer_radius"]
    columns = {"output.columns": radii}
    steps, rows = marched(tube("staggered", 60.0, **{"time.tolerance": tolerance, **columns}))
    reference = Simulation(tube("staggered", 60.0, **columns), MPI.COMM_SELF)
    exact, times = Angles(reference), [0.0, *(step.time for step in steps)]
    parts = [
        time for before, after in pairwise(times) for time in np.linspace(before, after, 17)[1:]
    ]
    same = list(reference.stepper.march(parts, [reference.observer, exact]))[15::16]
    estimated, largest = [], []
    for step, other in zip(steps, same, strict=True):
        apart = angle_between(rows.cells[step.time], exact.cells[step.time]).reshape(
            reference.quadrature.shape
        )
        angle = float(np.sqrt(reference.quadrature.mean(apart**2)))
        pitch = distance(reference, rows.by_time[step.time], exact.by_time[step.time])
        strain = np.degrees(max(abs(step.row[name] / other.row[name] - 1) for name in radii))
        assert max(angle, pitch, strain) < tolerance, step.time
        estimated.append(step.time_error)
        largest.append(max(angle, strain))
    assert estimated == pytest.approx(largest, rel=0.2)


def test_lengths_count_as_angles(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cube under a large force whose chains are not looked at, against Richardson's extrapolation of halved steps."""
    monkeypatch.setattr(RemodelingPass, "distance_between", lambda self, row, better: 0.0)
    scene = scene_from_dict(
        {
            "preset": COUPLINGS["staggered"],
            "geometry": {"shape": "cube"},
            "model": {"kinematics": "point"},
            "cells": {"initial": "isotropic"},
            "output": {"fields": False, "columns": ["time_error", "mean_stretch"]},
        }
    )
    scene = scene.with_values(
        {"time.end": 5.0, "time.step": 0.25, "loads.force.value": 8 * scene.loads["force"].value}
    )
    steps, _ = marched(scene)
    coarse, fine = (
        np.array(
            [
                step.row["mean_stretch"]
                for step in marched(scene.with_values({"time.step": 0.25 / n}))[0]
            ]
        )[n - 1 :: n]
        for n in (8, 16)
    )
    found = [step.time_error for step in steps[4:]]
    radians = np.array([step.row["mean_stretch"] for step in steps]) / (2 * fine - coarse) - 1
    np.testing.assert_allclose(found, np.degrees(np.abs(radians))[4:], rtol=0.2)
    assert max(found) > 0.1


def test_corners_and_asked_times_are_hit_and_no_step_is_left_over() -> None:
    asked = (7.3, 33.0)
    steps, _ = marched(tube("extrapolated", 61.7, **{"time.tolerance": 2.0, "output.times": asked}))
    times = np.array([step.time for step in steps])
    assert {*asked, 25.0, 61.7} <= set(times.tolist()) and times[-1] == 61.7
    lengths = np.diff([0.0, *times])
    assert (lengths[1:] / lengths[:-1]).min() > 0.2
    assert [step.is_last for step in steps] == [False] * (len(steps) - 1) + [True]


def test_fields_of_asked_times_are_written(tmp_path: Path) -> None:
    values = {"output.fields": ["displacement"], "output.every": 1000, "output.times": [3.0]}
    folder = run(tube("staggered", 5.0, **values), tmp_path / "run", MPI.COMM_SELF, report=False)
    assert Recording(folder).times.tolist() == [0.0, 3.0, 5.0]


def test_a_rejected_step_leaves_no_trace_but_its_work() -> None:
    """The rows are those of fixed steps of the same lengths."""
    first = 20.0
    scene = tube(
        "staggered",
        25.0,
        **{"time.tolerance": 1.5, "time.step": first, "output.columns": ["inner_radius"]},
    )
    scene = scene.with_values({"solver.predictor": "none"})
    simulation = Simulation(scene, MPI.COMM_SELF)
    undone: list[float] = []

    class Undone(Watcher):
        def undone(self, step: Step) -> None:
            undone.append(step.time)

    steps = list(simulation.steps([Undone()]))
    assert undone and undone[0] == 12.5 and steps[0].time < 12.5
    plain = tube(
        "staggered", 25.0, **{"output.columns": ["inner_radius"], "solver.predictor": "none"}
    )
    plain = Simulation(plain, MPI.COMM_SELF)
    again = list(plain.stepper.march([step.time for step in steps], [plain.observer]))
    assert [step.row["inner_radius"] for step in again] == [
        step.row["inner_radius"] for step in steps
    ]
    assert steps[0].work.newton_iterations > again[0].work.newton_iterations
    np.testing.assert_array_equal(plain.cells.dimension_values, simulation.cells.dimension_values)


SWINGS: dict[str, Any] = {"cells.initial": [0.8, 0.0, 0.6], "remodeling.frame": "spatial"}


@pytest.mark.parametrize(("coupling", "changes"), [("extrapolated", {}), ("staggered", SWINGS)])
def test_a_run_that_goes_on_takes_the_same_steps(
    coupling: str, changes: dict[str, Any], tmp_path: Path
) -> None:
    """In steps that were chosen, and among those in vain."""
    scene = tube(
        coupling,
        25.0,
        **{"time.tolerance": 0.3, "output.checkpoint": 5, "output.report": False, **changes},
    )
    whole, part = run(scene, tmp_path / "whole", MPI.COMM_SELF), tmp_path / "part"

    def stops(self: Pause, step: Step) -> None:
        if step.number == 7:
            raise Paused("stopped by a test", step.time, part)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(Paused):
        patch.setattr(Pause, "committed", stops)
        run(scene, part, MPI.COMM_SELF)
    resume(part, comm=MPI.COMM_SELF)
    first, second = Recording(whole).history, Recording(part).history
    for name in first.keys() - {"seconds"}:
        np.testing.assert_array_equal(first[name], second[name], err_msg=name)
    with pytest.raises(SceneError, match=r"^time\.tolerance = 0\.5: "):
        resume(part, ["time.tolerance=0.5"], MPI.COMM_SELF)


def test_where_no_step_is_short_enough_the_run_goes_on_and_says_so(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Cells of other lengths than their stress asks for turn over in the first pass, however short it is."""
    lengths = [0.2, 0.4, float(np.sqrt(0.8))]
    steps, _ = marched(tube("staggered", 10.0, **{"cells.initial": lengths, "time.tolerance": 0.5}))
    errors = [step.time_error for step in steps]
    assert errors[0] > 10.0 and np.median(errors) < 0.5 and len(steps) < 120
    assert sum("exceeds time.tolerance" in line for line in caplog.messages) == 1


def test_a_step_that_can_never_be_solved_is_tried_three_times_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each a quarter of the one before; none is shorter than 2^-12 of the first step."""
    simulation = Simulation(
        tube("staggered", 4.0, **{"time.tolerance": 5.0, "time.step": 4.0}), MPI.COMM_SELF
    )
    tried: list[float] = []

    def fails(time: float, loads: Any) -> Any:
        tried.append(time)
        raise StepFailure(time, "never", TOO_LARGE)

    monkeypatch.setattr(simulation.stepper.coupling, "solve", fails)
    with pytest.raises(StepFailure):
        next(simulation.steps())
    assert tried == pytest.approx([4.0, 1.0, 0.25, 0.0625], rel=0.05)  # equal parts of what is left
    tried.clear()
    simulation.state.numbers["step_control_wanted"] = shortest = 4.0 * 2.0**-12
    with pytest.raises(StepFailure):
        next(simulation.steps())
    assert tried == pytest.approx([shortest], rel=0.05)


def controlled(
    error: Callable[[float, float], float], end: float, **changes: Any
) -> tuple[Simulation, list[float]]:
    """Times of the steps where the estimated error is this function of their start and length, over the tolerance."""
    simulation = Simulation(
        tube("staggered", end, **{"time.tolerance": 1.0, **changes}), MPI.COMM_SELF
    )
    control = simulation.time_stepping
    assert control is not None

    def measured(step: Step) -> Estimate:
        step.time_error = error(simulation.state.time, step.time - simulation.state.time)
        return Estimate(step.time_error, step.time_error)

    control.error.measure = measured  # type: ignore[method-assign]
    return simulation, [step.time for step in simulation.steps()]


def test_steps_grow_to_twice_their_length_and_shrink_to_a_tenth() -> None:
    """An error that always allows more, and one that asks for a thousandth at first."""
    _, times = controlled(lambda start, length: 1e-3 * length, 25.0, **{"time.step": 0.01})
    ratios = np.diff(times)[1:-4] / np.diff(times)[:-5]
    assert 1.9 < ratios.min() and ratios.max() < 2.0 * 1.05 + 1e-9
    tried: list[float] = []

    def steep(start: float, length: float) -> float:
        if not start:
            tried.append(length)
        return 10.0 * length if start < 1.0 else 0.5

    controlled(steep, 25.0, **{"time.step": 25.0})
    assert tried[0] == 25.0 and 0.1 / 1.05 - 1e-9 <= tried[1] / tried[0] < 0.11


def test_a_step_whose_error_hardly_falls_is_not_tried_for_ever() -> None:
    """However little is missing: half of the length with the same error, and shorter ones would not help."""
    tried: list[float] = []

    def hardly(start: float, length: float) -> float:
        if not start:
            tried.append(length)
        return 1.01 if length > 0.2 else 0.5

    controlled(hardly, 2.0, **{"time.step": 1.0, "loads.pressure.ramp": [[0.0, 1.0]]})
    assert 2 <= len(tried) <= 4 and max(np.array(tried[1:]) / tried[:-1]) <= 0.85 * 1.05


def test_where_errors_do_not_fall_the_number_of_steps_is_bounded(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """An error that is the same however short the step: twenty in vain in a time 1/kappa, and longer ones."""
    tried = 0

    def stays(start: float, length: float) -> float:
        nonlocal tried
        tried += 1
        return 0.85 if start < 25.0 else 30.0 + start % 7.0

    end = 200.0
    simulation, times = controlled(stays, end, **{"time.step": 1.0})
    lengths = np.diff([0.0, *times])
    settings = simulation.scene.remodeling
    shortest = 1.0 / 360.0 / settings.kappa
    assert lengths.min() >= shortest / 1.05
    in_vain = int((lengths < 0.9).sum())
    assert 20 <= in_vain <= 20 + 20 * (end - 25.0) * settings.kappa + 8
    assert len(times) < end + 150 and tried < 2 * len(times)
    said = [line for line in caplog.messages if "exceeds time.tolerance" in line]
    assert (
        len(said) == 2
        and "continuing" not in said[0]
        and "continuing with step size 1.04" in said[1]
    )


def test_the_tolerance_counts_again_when_errors_fall() -> None:
    """Nothing helps for a while; what comes then is resolved."""

    def error(start: float, length: float) -> float:
        return 0.85 * length if start < 5.0 else 50.0 + start if start < 10.0 else length / 0.4

    _, times = controlled(error, 25.0)
    starts, lengths = np.array(times[:-1]), np.diff(times)
    assert 0.9 < lengths[starts < 4.0].min() and lengths[starts > 12.0].max() <= 0.4 * 1.05


def test_steps_of_an_explicit_rule_are_at_most_half_of_the_cells_own_time() -> None:
    """Longer ones swing about the equilibrium, however small their error."""
    simulation = Simulation(tube("extrapolated", 300.0, **{"time.tolerance": 20.0}), MPI.COMM_SELF)
    lengths = np.diff([step.time for step in simulation.steps()])
    assert 0.9 * 20.0 < lengths.max() <= 20.0 * 1.05


def test_a_printed_pass_that_swings_does_not_crawl(caplog: pytest.LogCaptureFixture) -> None:
    """By rank the chains of this tube turn over at once, to and fro: thousands of steps in 0.2.0."""
    steps, _ = marched(tube("staggered", 150.0, **{"time.tolerance": 0.5}, **SWINGS))
    assert len(steps) < 600 and steps[-1].time == 150.0
    assert (
        np.diff([step.time for step in steps]).min() > 0.5 / 360 * 25 / 1.06
    )  # degrees, and the time of the ramp
    assert any("exceeds time.tolerance" in line for line in caplog.messages)


def test_fixed_steps_tell_their_error_where_it_is_asked_for() -> None:
    scene = tube("staggered", 5.0, **{"output.columns": ["time_error"]})
    steps, _ = marched(scene)
    assert [step.time for step in steps] == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert all(0.1 < step.row["time_error"] < 1.0 for step in steps)
    plain, _ = marched(tube("staggered", 5.0))
    assert "time_error" not in plain[0].row
    for step, other in zip(steps, plain, strict=True):
        assert step.row["inner_radius"] == other.row["inner_radius"]


def test_after_cells_have_turned_over_the_error_is_that_of_the_steps_again() -> None:
    """Better cells that stay on the other side of a turn are another state, not an error of short steps."""
    lengths = [0.2, 0.4, float(np.sqrt(0.8))]
    values = {"cells.initial": lengths, "time.step": 0.015, "output.columns": ["time_error"]}
    steps, _ = marched(tube("staggered", 0.15, **values))
    assert steps[0].time_error > 10.0 and steps[-1].time_error < 0.1


def test_nothing_that_remodels_has_no_error() -> None:
    steps, _ = marched(
        tube(
            "staggered", 50.0, **{"remodeling.kappa": 0.0, "time.tolerance": 0.1, "time.step": 5.0}
        )
    )
    assert [step.time_error for step in steps] == [0.0] * len(steps) and len(steps) < 6


def test_with_a_tolerance_any_time_may_be_hit() -> None:
    ramp = ramp_to(10.3)
    scene = tube("staggered", 60.5, **{"time.tolerance": 1.0, "loads.pressure.ramp": ramp})
    assert scene.stops() == [10.3, 25.0, 60.5]
    assert Time(end=MOST_STEPS, tolerance=1.0).in_words() == "steps with an error below 1 degrees"


def test_studies_of_equal_steps_refuse_it(tmp_path: Path, refused: Refused) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(tube("staggered", **{"time.tolerance": 1.0}).to_toml())
    said = refused("stability", path, "-o", tmp_path / "a")
    assert "time.tolerance = 1: the analysis needs equal steps" in said
    said = refused(
        "ensemble", path, "--set", "cells.initial=random", "--set", "model.kinematics=full"
    )
    assert "time.tolerance = 1: each seed would have other steps" in said
