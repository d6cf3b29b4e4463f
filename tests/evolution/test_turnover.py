"""remodeling.turnover: an unstressed wall makes its own residual stress; rates, refusals, and the law without it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from remodel_fenicsx import Simulation
from remodel_fenicsx.model.chains import CHAINS
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.model.laws import TURNOVER_RATES, TurnoverRule
from remodel_fenicsx.scene import scene_from_dict
from remodel_fenicsx.system import NOTICE
from remodel_fenicsx.solver.newton import SolveFailure, Solution
from tests.conftest import warnings_of
from tests.runs import goes_on, last_row, made, opening_angle, rows_of, simulated
from tests.values import ANGLES, TENSION, assert_close, isotropic, ramped

COLUMNS = ["content", "natural_length"]
GROWS = {"time": 40.0, "deposition_stretch": 1.1, "gain": 1.0}


def wall(
    end: float | str,
    step: float,
    turnover: dict[str, float] | None,
    columns: list[str],
    **changes: Any,
) -> Any:
    """A tube of 1 to 1.3 under a pressure of 1.2 and an elongation of 10 %."""
    return isotropic(
        "consistent",
        geometry={"shape": "tube", "inner_radius": 1.0, "outer_radius": 1.3, "length": 2.0},
        mesh={"refinement": 2, "degree": 2},
        remodeling=({"turnover": TENSION | turnover} if turnover else {}) | changes,
        loads=ramped(24.0, pressure=1.2, elongation=0.1),
        time={"end": end, "step": step},
        output={"fields": False, "columns": [*ANGLES, "outer_radius", "stored_energy", *columns]},
    )


def test_an_unstressed_wall_comes_to_rest_with_an_opening_angle_of_its_own(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Figures of an independent program on one radius: in time, and at once in fewer steps; nothing is said."""
    for end, degrees in ((960.0, 3.0), ("equilibrium", 0.5)):
        with made(wall(end, 8.0, GROWS, COLUMNS)) as simulation:
            row = list(simulation.steps())[-1].row
            turnover, order = simulation.stepper.process("turnover"), np.argsort(
                simulation.quadrature.coordinates[..., 0].ravel()
            )
            assert [row[name] for name in ANGLES] == pytest.approx([6.7, 10.3, 14.5], abs=1.0)
            assert opening_angle(simulation) == pytest.approx(115.4, abs=degrees)
            for name, expected in (
                ("content", (3.9, 2.9, 2.2)),
                ("natural_length", (1.43, 1.31, 1.22)),
            ):
                values = turnover._values(name).ravel()[order]
                assert values[[0, len(values) // 2, -1]] == pytest.approx(expected, rel=0.03)
    assert simulation.time_stepping.steps < 100
    assert 40.0 * np.abs(turnover.rates()).max() < 2e-4
    assert not warnings_of(caplog)


def test_growth_has_no_equilibrium_and_says_so(caplog: pytest.LogCaptureFixture) -> None:
    assert (
        last_row(wall("equilibrium", 4.0, GROWS | {"gain": 0.2}, COLUMNS))["natural_length"] > 5.0
    )
    assert sum("turnover has not reached equilibrium" in line for line in caplog.messages) == 1


@pytest.mark.parametrize(
    ("stretch", "tube", "angle"),
    [(1.15, (1.3, 1.2), 82.0), (1.1, (3.0, 4.8), 92.7)],
    ids=["stretch", "paper's wall"],
)
def test_other_walls_open_as_an_independent_solver_says(
    stretch: float, tube: tuple[float, float], angle: float
) -> None:
    """At rest; another stretch of deposition; the paper's wall under its pressure."""
    values = wall("equilibrium", 4.0, GROWS | {"deposition_stretch": stretch}, [])
    values["geometry"]["outer_radius"], values["loads"]["pressure"]["value"] = tube
    with simulated(values) as (simulation, _):
        assert opening_angle(simulation) == pytest.approx(angle, abs=1.0)


@pytest.mark.parametrize("coupling", ["staggered", "relaxed", "extrapolated"])
@pytest.mark.parametrize("time", [{}, {"tolerance": 1.0}], ids=["equal", "chosen"])
def test_without_turnover_it_is_the_law_tensor(coupling: str, time: dict[str, float]) -> None:
    """Gain 0 and a huge time."""
    never = {"time": 1e12, "deposition_stretch": 1.1, "gain": 0.0}
    scenes = [wall(20.0, 4.0, turnover, [], coupling=coupling) for turnover in (None, never)]
    plain, turned = (rows_of(scene | {"time": scene["time"] | time}) for scene in scenes)
    assert len(turned) == len(plain)
    assert turned[-1] == pytest.approx(plain[-1], rel=1e-9, abs=1e-9, nan_ok=True)


# ---------------------------------------------------------------- errors in time


@pytest.fixture(scope="module")
def small_steps() -> list[dict[str, float]]:
    """Rows up to t = 96, where m is 1.7."""
    return rows_of(wall(96.0, 0.5, GROWS, COLUMNS))


def errors(rows: list[dict[str, float]], small_steps: list[dict[str, float]]) -> np.ndarray:
    """The largest ones of mean m, mean rho and the angle in the middle over all rows, in degrees."""
    times, exact = [row["time"] for row in rows], [row["time"] for row in small_steps]
    found = []
    for name in (*COLUMNS, ANGLES[1]):
        here = np.array([row[name] for row in rows])
        there = np.interp(times, exact, [row[name] for row in small_steps])
        found.append(
            np.abs(here - there).max()
            if name in ANGLES
            else np.degrees(np.abs(np.log(here / there)).max())
        )
    return np.array(found)


@pytest.mark.parametrize(("coupling", "order"), [("staggered", 1), ("extrapolated", 2)])
def test_content_and_natural_length_have_the_order_of_the_coupling(
    coupling: str, order: int, small_steps: list[dict[str, float]]
) -> None:
    coarse, fine = (
        errors(rows_of(wall(96.0, step, GROWS, COLUMNS, coupling=coupling))[-1:], small_steps)
        for step in (8.0, 2.0)
    )
    np.testing.assert_allclose(np.log(coarse / fine) / np.log(4.0), order, atol=0.35)


@pytest.mark.parametrize("coupling", ["staggered", "extrapolated"])
def test_chosen_steps_watch_content_and_natural_length(
    coupling: str, small_steps: list[dict[str, float]]
) -> None:
    """Errors fall as the tolerance does, and are below it; the estimate is about the error of the content."""
    found, counts = [], []
    for tolerance in (4.0, 1.0):
        values = wall(48.0, 1.0, GROWS, COLUMNS, coupling=coupling)
        values["time"]["tolerance"] = tolerance
        rows = rows_of(values)
        error, estimate = errors(rows, small_steps), max(row["time_error"] for row in rows)
        assert error.max() < tolerance and error[0] / 1.5 < estimate <= tolerance
        found.append(error)
        counts.append(len(rows))
    assert ((found[0] / found[1])[:2] > 2.5).all(), found
    assert counts[1] > 1.5 * counts[0]


def test_rates_against_their_equation() -> None:
    """At the stretch of deposition nothing changes; beyond it m and rho grow, and no faster than 1/T and its double."""
    chain, r0, contour, time = CHAINS["wormlike"], 1.0, 1.594, 40.0
    tissue = Tissue(
        1.0,
        1.0,
        1.0,
        contour,
        r0,
        content=np.ones(4),
        natural_length=np.array([1.0, 1.3, 1.3, 1.0]),
    )
    stretches = np.array([1.1, 1.15, 0.9, 1.4])
    found = TurnoverRule(time, 1.1, 1.0, TURNOVER_RATES["tension"]).at_length(
        tissue, stretches * tissue.natural_length
    )
    tension = (
        stretches * chain.stiffness(stretches, contour) / (1.1 * chain.stiffness(1.1, contour))
    )
    assert found.content == pytest.approx(np.clip(tension - 1, -1, 1) / time, abs=1e-15)
    growth = (1 / time + np.maximum(found.content, 0)) * (stretches / 1.1 - 1)
    assert found.natural_length == pytest.approx(growth, abs=1e-15)
    assert found.content[1] > 0 > found.content[2] and found.content[3] == 1 / time


@pytest.mark.parametrize("end", [1600.0, "equilibrium"])
def test_a_growth_that_rests_is_no_instability_however_large(
    end: float | str, caplog: pytest.LogCaptureFixture
) -> None:
    """A second load makes the content more than ten times as large, and it rests: no warning."""
    values = wall(end, 4.0, GROWS, COLUMNS)
    values["loads"]["pressure"]["ramp"] += [[800.0, 1.0], [824.0, 1.6]]
    values["time"]["tolerance"] = 3.0
    with caplog.at_level(NOTICE), simulated(values) as (simulation, _):
        assert simulation.stepper.process("turnover")._values("content").max() > 10.0
    assert not any("rest" in line for line in warnings_of(caplog))


@pytest.mark.parametrize(
    ("coupling", "time"),
    [("staggered", {}), ("extrapolated", {"tolerance": 1.0})],
)
def test_a_run_goes_on_with_its_content(
    coupling: str, time: dict[str, float], tmp_path: Path
) -> None:
    room = {"rates": "cauchy", "volume": 0.5} if time else {}
    values = wall(24.0, 4.0, {"time": 10.0, "gain": 1.0} | room, COLUMNS, coupling=coupling)
    values["time"] |= time
    values["mesh"] = {"refinement": 1, "degree": 2}
    values["output"]["times"] = [12.0]
    assert goes_on(values, tmp_path, 12.0).history["content"][-1] > 1.05


@pytest.mark.parametrize(("gain", "rests"), [(0.5, False), (0.2, False), (1.0, True)])
def test_growth_that_does_not_come_to_rest_is_said_at_the_end(
    gain: float, rests: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """Ever more slowly, or faster and faster; not of a wall that rests some time later, nor of a short run."""
    turnover = GROWS | {"gain": gain}
    rows_of(wall(480.0, 8.0, turnover, COLUMNS))
    found = [line for line in caplog.messages if "has not reached equilibrium" in line]
    assert len(found) == (0 if rests else 1)
    assert rests or (
        "decayed no faster than 1/t" in found[0] and "mechanobiological instability" in found[0]
    )
    if gain == 0.2:
        caplog.clear()
        rows_of(wall(240.0, 8.0, turnover, COLUMNS))
        assert "not reached equilibrium" not in caplog.text


@pytest.mark.parametrize("coupling", ["staggered", "extrapolated"])
def test_a_step_in_parts_has_parts_of_its_turnover(
    coupling: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The end is that of the whole step; half-way ln m is half-way too."""
    values = wall(40.0, 8.0, GROWS, COLUMNS, coupling=coupling) | {"solver": {"predictor": "none"}}
    whole = rows_of(values)
    simulation = Simulation(scene_from_dict(values))
    coupled, turnover = simulation.stepper.coupling, simulation.stepper.process("turnover")
    set_fraction, parts, refused = turnover.set_fraction, [], set()
    newton = coupled.blend.newton
    solve = newton.solve

    def in_parts(
        step: Any, time: float, old_loads: Any, loads: Any, work: Any, again: bool
    ) -> None:
        coupled._solve_in_substeps(time, old_loads, loads, work, None)

    def solved(origin: Any = None, loose_tolerance: bool = False) -> Any:
        if simulation.state.number not in refused:
            refused.add(simulation.state.number)
            raise SolveFailure("in vain", Solution(limits=coupled.equilibrium.limits()))
        return solve(origin, loose_tolerance)

    def noted(fraction: float) -> None:
        set_fraction(fraction)
        parts.append((fraction, turnover.logarithms()[0].mean()))

    monkeypatch.setattr(newton, "solve", solved)
    monkeypatch.setattr(coupled, "_solve", in_parts)
    monkeypatch.setattr(turnover, "set_fraction", noted)
    rows = [dict(step.row) for step in simulation.steps()]
    simulation.close()
    assert_close(rows[-1], whole[-1], (*COLUMNS, *ANGLES, "outer_radius"), 1e-7)
    assert {fraction for fraction, _ in parts} >= {0.5, 1.0}
    ends = {fraction: value for fraction, value in parts[-10:] if fraction in (0.5, 1.0)}
    assert 0.0 < ends[0.5] < ends[1.0]


def cube(end: float, step: float, turnover: dict[str, float], **changes: Any) -> dict[str, Any]:
    """Equal cells under a force: one point."""
    return isotropic(
        "consistent", "point", geometry={"shape": "cube"}, loads=ramped(10.0, force=3.0), output={"columns": COLUMNS},
        remodeling={"turnover": TENSION | {"time": 40.0} | turnover} | changes, time={"end": end, "step": step},
    )  # fmt: skip


def test_steps_that_are_too_long_for_the_turnover_are_said() -> None:
    """Of fixed steps; chosen ones come to rest."""
    long = cube(100.0, 10.0, {"time": 5.0})
    (line,) = (line for line in scene_from_dict(long).warnings() if "turnover.time" in line)
    assert (
        "time.step = 10 exceeds remodeling.turnover.time = 5" in line and "time.tolerance" in line
    )
    chosen = long | {"time": {"end": 100.0, "tolerance": 1.0}}
    for fine in (cube(100.0, 10.0, {}), chosen):
        assert not [line for line in scene_from_dict(fine).warnings() if "turnover.time" in line]


def test_cells_that_stay_are_said_to_take_staggered_turnover(
    caplog: pytest.LogCaptureFixture,
) -> None:
    Simulation(scene_from_dict(cube(10.0, 5.0, {}, kappa=0.0, coupling="extrapolated"))).close()
    assert "the cells do not change" in caplog.text and "in place of 'extrapolated'" in caplog.text


def test_tissue_that_loses_nearly_all_of_its_collagen_and_rests_is_no_instability(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A deposition stretch that the load never reaches: the natural length falls too, and the rates with it."""
    values = cube(200.0, 2.0, {"time": 10.0, "deposition_stretch": 1.59})
    values["loads"]["force"]["value"] = 0.3
    assert last_row(values)["content"] < 0.1
    assert not warnings_of(caplog)
