"""Where steps start: a predictor changes the work, not the solution."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from remodel_fenicsx import Recording, Simulation
from remodel_fenicsx.evolution.coupling import LoadStep, Predictor
from remodel_fenicsx.running import run
from remodel_fenicsx.solver.equilibrium import Equilibrium
from remodel_fenicsx.solver.newton import GuardedNewton, SolveFailure, Solution
from tests.parts import pulled_cube
from tests.results.test_resume import SELF, rows
from tests.runs import made
from tests.values import assert_close

RATES = {"force": 2.0}
PREDICTED, NOT_PREDICTED = {"predictor": "autoregressive"}, {"predictor": "none"}


@pytest.fixture
def simulation() -> Any:
    with made(pulled_cube(9.0, solver=NOT_PREDICTED)) as found:
        yield found


def test_a_trend_and_a_swing_are_both_continued_whatever_the_steps(simulation: Simulation) -> None:
    """A trend, and what alternates from step to step as a staggered pass does, each at the speed of its step."""
    state = simulation.state
    predictor, unknown, rng = Predictor(state), state.unknown.x.array, np.random.default_rng(1)
    trend, swing = 1e-3 * rng.standard_normal((2, len(unknown)))
    assert predictor.expected(LoadStep(1.0, RATES)) is None
    free = np.isnan(simulation.stepper.coupling.equilibrium.prescribed_values())
    for number, duration in enumerate(rng.uniform(0.5, 2.0, 8)):
        step, before = LoadStep(duration, RATES), unknown.copy()
        found, increment = predictor.expected(step), duration * (
            0.9**number * trend + (-0.8) ** number * swing
        )
        unknown[:] += increment
        predictor.solved(step, before)
    assert found is not None
    np.testing.assert_allclose((found - before)[free], increment[free], rtol=0, atol=1e-12)
    assert np.all(found[~free] == 0.0)  # what supports prescribe
    assert predictor.expected(LoadStep(1.0, {"force": 2.1})) is None


def iterations(folder: Path) -> int:
    return int(sum(Recording(folder).history["newton_iterations"]))


@pytest.fixture(scope="module")
def predicted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    scene = pulled_cube(16.0, solver=PREDICTED, output={"fields": False, "checkpoint": 1})
    return run(scene, tmp_path_factory.mktemp("predicted") / "run", SELF)


def test_the_solutions_are_the_same_with_less_work(predicted: Path, tmp_path: Path) -> None:
    plain = run(
        pulled_cube(16.0, solver=NOT_PREDICTED, output={"fields": False}), tmp_path / "plain", SELF
    )
    found, expected = Recording(predicted).history, Recording(plain).history
    names = ("mean_stretch", "stored_energy", "max_chain_extension", "remodeling_power")
    assert_close(found, expected, names, 1e-8, 0.0)
    assert iterations(predicted) <= 0.9 * iterations(plain)


def nearly_straight(predictor: Predictor, step: LoadStep) -> np.ndarray | None:
    """The last displacement, stretched until the longest chain has 0.999 of its contour length."""
    tissue = pulled_cube(4.0).material.tissue(pulled_cube(4.0).cells.end_to_end_length)
    unknown, extension = (
        predictor.state.unknown.x.array,
        Equilibrium(predictor.state, tissue).limits,
    )
    last, factors = unknown.copy(), [1.0, 20.0]
    if not predictor.state.number:
        return None
    while factors[1] - factors[0] > 1e-9:
        middle = sum(factors) / 2
        unknown[:] = middle * last
        factors[int(extension().max_chain_extension > 0.999)] = middle
    unknown[:] = last
    return factors[0] * last


def test_what_is_expected_wrongly_costs_no_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not admissible, with chains nearly straight, or a start from which the solve fails: all is as without."""
    scene = pulled_cube(4.0, solver=PREDICTED, output={"fields": False})
    plain = run(
        pulled_cube(4.0, solver=NOT_PREDICTED, output={"fields": False}), tmp_path / "plain", SELF
    )
    monkeypatch.setattr(
        Predictor, "expected", lambda self, step: -50.0 * self.state.unknown.x.array
    )
    assert rows(run(scene, tmp_path / "far", SELF)) == rows(plain)
    monkeypatch.setattr(Predictor, "expected", nearly_straight)
    assert rows(run(scene, tmp_path / "straight", SELF)) == rows(plain)
    solve, failed = GuardedNewton.solve, []

    def failing(newton: GuardedNewton, origin: Any = None) -> Any:
        if not failed or failed[-1] != newton.equilibrium.state.number:
            failed.append(newton.equilibrium.state.number)
            raise SolveFailure("made to fail", Solution(3, 3, limits=newton.equilibrium.limits()))
        return solve(newton, origin)

    monkeypatch.setattr(Predictor, "expected", lambda self, step: self.state.unknown.x.array + 0.0)
    monkeypatch.setattr(GuardedNewton, "solve", failing)
    folder = run(scene, tmp_path / "failing", SELF)
    assert failed == [0, 1, 2, 3] and iterations(folder) == iterations(plain) + 12
    assert Recording(folder).history["substeps"].tolist()[1:] == [1, 1, 1, 1]
