"""The columns of work: every iteration, part and second of a step is counted once, whatever way led to it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest
from mpi4py import MPI

from remodel_fenicsx import Simulation
from remodel_fenicsx.evolution import stepper
from remodel_fenicsx.scene.scene import Scene, scene_from_dict
from remodel_fenicsx.solver.continuation import MIN_HALVINGS_FOR_JUMP
from remodel_fenicsx.solver.newton import GuardedNewton, Solution, SolveFailure
from tests.runs import made
from tests.values import isotropic, ramp_to

Attempt = Solution | SolveFailure
PRESETS = {"staggered": "kuhl-holzapfel-2007", "extrapolated": "consistent"}


def artery(coupling: str, **changes: Any) -> Scene:
    """The wall of the paper's artery, of isotropic cells, for two steps."""
    scene = scene_from_dict(
        isotropic(PRESETS[coupling], remodeling={"coupling": coupling, "frame": "material"})
    )
    return scene.with_values({"time.end": 2.0, **changes})


@pytest.fixture
def attempts(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Attempt]]:
    """All solutions and failures of Newton's method."""
    found: list[Attempt] = []
    solve = GuardedNewton.solve

    def counted(self: GuardedNewton, origin: Any = None, loose_tolerance: bool = False) -> Solution:
        try:
            solution = solve(self, origin, loose_tolerance)
        except SolveFailure as failure:
            found.append(failure)
            raise
        found.append(solution)
        return solution

    monkeypatch.setattr(GuardedNewton, "solve", counted)
    yield found


def counts(found: list[Attempt]) -> tuple[int, int, int]:
    """Newton and linear iterations and tangents of all."""
    names = ("newton_iterations", "linear_iterations", "tangents")
    newton, linear, tangents = (sum(getattr(attempt, name) for attempt in found) for name in names)
    return newton, linear, tangents


def rows(
    scene: Scene, found: list[Attempt]
) -> Iterator[tuple[dict[str, float], Any, list[Attempt]]]:
    """Row, work and attempts of each step; the latter are forgotten."""
    with made(scene) as simulation:
        for step in simulation.steps():
            yield step.row, step.work, list(found)
            found.clear()


@pytest.mark.parametrize("coupling", PRESETS)
@pytest.mark.parametrize("method", ["direct", "lagged"])
def test_every_solve_of_a_step_counts_once(
    coupling: str, method: str, attempts: list[Attempt]
) -> None:
    """The first step of a coupling without a stress before it is solved twice."""
    solves = []
    # with fewer halvings than `parts.MIN_HALVINGS_FOR_JUMP` a step that goes far is not looked into again
    plain = {"solver.method": method, "solver.maximum_halvings": MIN_HALVINGS_FOR_JUMP - 1}
    for row, work, found in rows(artery(coupling, **plain), attempts):
        spent = counts(found)
        assert (work.newton_iterations, work.linear_iterations, work.tangents) == spent
        assert (row["newton_iterations"], row["linear_iterations"], row["substeps"]) == (
            *spent[:2],
            1,
        )
        solves.append(len(found))
    assert solves == [1 + (coupling != "staggered"), 1]


@pytest.mark.parametrize("coupling", PRESETS)
def test_looks_at_a_step_that_goes_far_count(coupling: str, attempts: list[Attempt]) -> None:
    """What is solved again in parts is work too."""
    for row, work, found in rows(artery(coupling), attempts):
        assert (work.newton_iterations, work.linear_iterations, work.tangents) == counts(found)
        assert row["newton_iterations"] == work.newton_iterations


@pytest.mark.parametrize("coupling", ["staggered", "extrapolated"])
def test_failed_solves_and_parts_count(coupling: str, attempts: list[Attempt]) -> None:
    """A load far too large for one piece."""
    changes = {
        "loads.pressure.value": 30.0,
        "loads.pressure.ramp": ramp_to(2.0),
        "time.step": 2.0,
    }
    scene = artery(coupling, **changes, **{"solver.maximum_iterations": 4})
    ((row, work, found),) = rows(scene, attempts)
    solved = sum(isinstance(attempt, Solution) for attempt in found)
    assert len(found) > solved > 1
    assert row["substeps"] == solved - (
        coupling == "extrapolated"
    )  # of two solves that are one step
    newton, linear, tangents = counts(found)
    assert work.tangents == tangents
    # the direction in which a part may start is one iteration more
    assert (
        0 <= row["newton_iterations"] - newton <= 2 and 0 <= row["linear_iterations"] - linear <= 2
    )


def test_attempts_that_were_taken_back_count_once(
    attempts: list[Attempt], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three of them, more than two: sums of sums would double with each."""
    clock = SimpleNamespace(wall=0.0, processor=0.0)
    clock.perf_counter, clock.process_time = (lambda: clock.wall), (lambda: clock.processor)
    monkeypatch.setattr(stepper, "clock", clock)
    scene = artery("staggered", **{"time.end": 25.0, "time.step": 25.0, "time.tolerance": 0.1})
    simulation = Simulation(scene, MPI.COMM_SELF)
    solve: Callable[..., Any] = simulation.stepper.coupling.solve
    starts = []

    def timed(time: float, loads: Any) -> Any:
        clock.wall, clock.processor = clock.wall + 10.0, clock.processor + 7.0
        starts.append(time)
        return solve(time, loads)

    monkeypatch.setattr(simulation.stepper.coupling, "solve", timed)
    step = next(simulation.steps())
    assert len(starts) > 3 and starts == sorted(starts, reverse=True)
    assert (step.work.newton_iterations, step.work.linear_iterations, step.work.tangents) == counts(
        attempts
    )
    assert (step.seconds, step.processor_seconds) == (10.0 * len(starts), 7.0 * len(starts))
