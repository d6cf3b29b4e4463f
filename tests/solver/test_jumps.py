"""A step that ends far from where its tangent points to: what is beyond a limit point is not taken without a word."""

from __future__ import annotations

import logging
import re
from contextlib import closing
from typing import Any

import numpy as np
import pytest

from benchmarks.stability_map.cases import all_cases
from benchmarks.stability_map.running import Runner
from remodel_fenicsx import Scene
from remodel_fenicsx.scene import scene_from_dict
from remodel_fenicsx.solver.continuation import Continuation
from remodel_fenicsx.solver.equilibrium import StateLimits
from remodel_fenicsx.solver.newton import GuardedNewton, SolveFailure, Solution
from remodel_fenicsx.solver.diagnosis import diagnose_failure
from tests.conftest import warnings_of
from tests.locking_bodies import thick_tube
from tests.runs import made
from tests.values import isotropic, ramp_to, ramped

LARGEST = (
    0.3018  # pressure of this tube: tests/reference/march.py, with the inner radius prescribed
)


def thin_tube(pressure: float = 0.5, end: float = 1.0, **values: Any) -> Scene:
    """Few of its chains run around it: with closed ends its pressure has a largest value."""
    scene = isotropic(
        None, geometry={"shape": "tube", "inner_radius": 1.0, "outer_radius": 1.1, "length": 8.0},
        cells={"initial": [0.4, 0.2, 0.8944271909999159]}, supports={"ends": "closed"}, remodeling={"law": "none"},
        loads=ramped(1.0, pressure=pressure), time={"end": end, "step": 1.0}, output={"columns": ["inner_radius"]},
    )  # fmt: skip
    return scene_from_dict(scene).with_values(values)


def radii(scene: Scene) -> tuple[list[float], int]:
    """Inner radius of the steps, and their Newton iterations."""
    with made(scene) as simulation:
        steps = list(simulation.steps())
    return [step.row["inner_radius"] for step in steps], sum(
        step.work.newton_iterations for step in steps
    )


@pytest.mark.parametrize(("pressure", "step"), [(0.5, 0.25), (0.5, 0.05), (0.3624, 0.2)])
def test_a_limit_point_that_is_jumped_over_is_named(
    pressure: float, step: float, caplog: pytest.LogCaptureFixture
) -> None:
    """From r = 1.6 to 3.4: where the way ends is the largest pressure, whatever the step."""
    found, _ = radii(
        thin_tube(
            pressure, **{"mesh.degree": 2, "time.step": step, "solver.relative_tolerance": 1e-9}
        )
    )
    assert max(np.diff(found)) > 1.5
    (said,) = warnings_of(caplog)
    assert "limit point" in said
    place = re.search(r"The previous branch ends at pressure ([0-9.]+) \(", said)
    assert place is not None and float(place[1]) == pytest.approx(LARGEST, rel=5e-3)


def test_a_refusal_beyond_it_is_no_matter_of_the_tolerance() -> None:
    """The far state that Newton's method ends near may miss the tolerance by a little; the tangent knows better."""
    with made(thin_tube(LARGEST - 1e-4, **{"time.step": 0.125})) as simulation:
        before = [simulation.unknown.x.array.copy() for _ in simulation.steps()][-2]
        last = simulation.unknown.x.array - before
        failure = SolveFailure(
            "refused", Solution(25, 25, limits=StateLimits(0.7, 1.0, (0.0, 0.0, 0.0))), 50.0
        )
        refusal = diagnose_failure(simulation.stepper.coupling.newton, failure, last)
    assert refusal.kind == "limit point"


def test_a_far_step_with_a_way_to_it_says_nothing(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Near its largest pressure a tube without chains goes more than twice as far as its first tangent points."""
    changes: dict[str, Any] = {
        "material.chain_density": 0.0,
        "geometry.outer_radius": 3.0,
        "supports.ends": "free",
    }
    changes |= {"loads.elongation": {"value": 0.0, "ramp": ramp_to(1.0)}}
    looked, confirm = [], Continuation.repeat_in_substeps
    monkeypatch.setattr(
        Continuation,
        "repeat_in_substeps",
        lambda *arguments: looked.append(1) or confirm(*arguments),
    )
    (whole,), _ = radii(thin_tube(3.15, **changes))
    assert looked and not warnings_of(caplog)
    small, _ = radii(thin_tube(3.15, **changes, **{"time.step": 0.1}))
    assert whole == pytest.approx(small[-1], rel=1e-8)


def test_where_a_step_is_expected_to_end_is_no_start_of_its_way(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An increment like the last one changes the volume of a stiff body: its first Newton step is short, no way far."""
    looked: list[int] = []
    monkeypatch.setattr(Continuation, "repeat_in_substeps", lambda *arguments: looked.append(1))
    found = []
    for predictor in ("autoregressive", "none"):
        scene = thick_tube(1e3, "displacement").with_values(
            {"model.kinematics": "radial", "mesh.degree": 2, "solver.predictor": predictor}
        )
        found.append(radii(scene))
    (radius, iterations), (without, _) = found
    assert not looked and iterations <= 6 * len(radius)
    assert radius == pytest.approx(without, rel=1e-8)


def test_of_several_solutions_the_one_that_parts_lead_to_is_taken(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Newton's method starts at the wide tube, whose branch reaches down below the limit point."""
    caplog.set_level(logging.INFO)
    narrow, _ = radii(thin_tube(0.29))
    with made(thin_tube(0.5, **{"time.step": 0.25, "solver.relative_tolerance": 1e-9})) as wide:
        list(wide.steps())
        far = wide.unknown.x.array.copy()
    solve, starts = GuardedNewton.solve, [far]

    def misled(newton: GuardedNewton, origin: Any = None, loose_tolerance: bool = False) -> Any:
        if starts:
            first = newton.unknown.x.array.copy()
            newton.unknown.x.array[:] = starts.pop()
            solution = solve(newton, origin, loose_tolerance)
            assert np.abs(newton.unknown.x.array - first).max() > 1.0
            object.__setattr__(solution, "displacement_ratio", 10.0)
            return solution
        return solve(newton, origin, loose_tolerance)

    monkeypatch.setattr(GuardedNewton, "solve", misled)
    found, _ = radii(thin_tube(0.29, **{"solver.relative_tolerance": 1e-9}))
    assert found == pytest.approx(narrow, rel=1e-7)
    assert "several solutions exist; using the one reached by substeps" in caplog.text


def test_a_body_that_jumps_again_and_again_is_looked_into_three_times(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Loaded, unloaded, loaded: each way over a limit point is a warning, up to a number."""
    cycle = [[0.0, 0.0], *([float(t), float(t % 2)] for t in range(1, 9))]
    scene = thin_tube(
        end=8.0,
        **{"loads.pressure.ramp": cycle, "time.step": 0.25, "solver.relative_tolerance": 1e-9},
    )
    found, _ = radii(scene)
    assert sum(np.abs(np.diff(found)) > 1.0) >= 4
    assert len(warnings_of(caplog)) == 3


def test_parts_of_quasi_newton_steps_are_no_jump() -> None:
    """Quasi-Newton steps stop just below the tolerance of a part: that rest once looked like a change of direction."""
    case = all_cases()["random cells: frame material, force 3000.0"]
    with closing(Runner(limit=60)) as runner:
        scene = case.scene | {"solver": {"method": "lagged"}, "time": {"step": 1.0, "end": 6.0}}
        run = runner.run({"scene": scene, "counts": case.counts, "extended": case.extended})
        assert run.code == 0 and max(run.column("substeps")) > 4
        assert run.column("mean_stretch")[-1] == pytest.approx(
            1.81231133, rel=1e-8
        )  # so every tangent says
        assert not any("jumps" in warning for warning in run.warnings)


@pytest.mark.parametrize("method", ["direct", "lagged"])
def test_a_step_that_takes_many_tangents_is_gone_in_parts(method: str) -> None:
    """A thin tube of random cells under long steps has several equilibria; 20 to 200 parts lead to this one."""
    scene = isotropic(
        kinematics="sector", geometry={"shape": "tube", "inner_radius": 1.0, "outer_radius": 1.2, "length": 3.0},
        cells={"initial": "random", "seed": 1}, loads=ramped(4.0, pressure=1.0, elongation=0.1),
        time={"end": 3.0, "step": 1.0}, solver={"method": method}, output={"columns": ["inner_radius"]},
    )  # fmt: skip
    found, _ = radii(scene_from_dict(scene))
    assert found[-1] == pytest.approx(1.45346788, rel=1e-8)
