"""Scenes, or tables of them, run to their end in this process alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from mpi4py import MPI

from remodel_fenicsx import Recording, Scene, Simulation
from remodel_fenicsx.body.tube import _of_rings
from remodel_fenicsx.evolution.stepper import Step, Watcher
from remodel_fenicsx.results.columns import Measurement
from remodel_fenicsx.running import resume, run
from remodel_fenicsx.scene.scene import scene_from_dict
from tests.values import assert_close

SELF = MPI.COMM_SELF
Rows = list[dict[str, float]]


class AtSolved(Watcher):
    """Looks at each solved state."""

    def __init__(self, look: Callable[[Step], Any]):
        self.look = look

    def solved(self, step: Step) -> None:
        self.look(step)


@contextmanager
def made(scene: Scene | Mapping[str, Any], domain: Any = None) -> Iterator[Simulation]:
    """A simulation before its first step, which is closed in the end."""
    simulation = Simulation(
        scene if isinstance(scene, Scene) else scene_from_dict(dict(scene)), SELF, domain
    )
    try:
        yield simulation
    finally:
        simulation.close()


@contextmanager
def simulated(
    scene: Scene | Mapping[str, Any], domain: Any = None, watchers: Sequence[Any] = ()
) -> Iterator[tuple[Simulation, Rows]]:
    """A simulation at its end, and its rows."""
    with made(scene, domain) as simulation:
        yield simulation, [dict(step.row) for step in simulation.steps(watchers)]


def rows_of(
    scene: Scene | Mapping[str, Any], domain: Any = None, watchers: Sequence[Any] = ()
) -> Rows:
    """All rows of its steps."""
    with simulated(scene, domain, watchers) as (_, rows):
        return rows


def rows_and_looks(
    scene: Scene | Mapping[str, Any], look: Callable[[Simulation], Any], domain: Any = None
) -> tuple[Rows, list[Any]]:
    """All rows, and what `look` finds in the simulation at each solved state."""
    found: list[Any] = []
    with made(scene, domain) as simulation:
        watcher = AtSolved(lambda step: found.append(look(simulation)))
        return [dict(step.row) for step in simulation.steps([watcher])], found


def last_row(scene: Scene | Mapping[str, Any], domain: Any = None) -> dict[str, float]:
    """The row of its end."""
    return rows_of(scene, domain)[-1]


def opening_angle(simulation: Simulation, release: str = "cut") -> float:
    """Of a cut of a tube as it is, or its `unloaded_stretch`; columns would do it in every row."""
    step: Any = SimpleNamespace(time=0.0)
    return _of_rings(release, Measurement(simulation.observer, step))


def columns(rows: Rows) -> dict[str, np.ndarray]:
    """The same by column."""
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def columns_of(scene: Scene | Mapping[str, Any], domain: Any = None) -> dict[str, np.ndarray]:
    """Its rows by column."""
    return columns(rows_of(scene, domain))


def goes_on(scene: Scene | Mapping[str, Any], folder: Path, *stops: float) -> Recording:
    """A run that stops at these times and goes on has the rows of one that does not, to rounding."""
    asked = scene if isinstance(scene, Scene) else scene_from_dict(dict(scene))
    whole = Recording(run(asked, folder / "whole", SELF, report=False)).history
    parts = run(asked.with_values({"time.end": stops[0]}), folder / "parts", SELF, report=False)
    for end in (*stops[1:], asked.time.end):
        resume(parts, [f"time.end={end}"], SELF, report=False)
    found = Recording(parts)
    assert list(found.history) == list(whole)
    assert_close(found.history, whole, set(whole) - {"seconds"}, 1e-13, 1e-15, equal_nan=True)
    return found


def taylor_orders(simulation: Simulation, equilibrium: Any, size: float) -> np.ndarray:
    """Orders of what the tangent leaves of the forces, for a random change of the free unknowns, halved twice."""
    x, unknown = simulation.unknown.x.petsc_vec, simulation.unknown.x.array
    residual, loads, matrix = x.duplicate(), x.duplicate(), equilibrium.create_matrix()
    free, start = np.isnan(equilibrium.prescribed_values()), unknown.copy()
    direction = np.where(free, np.random.default_rng(3).standard_normal(len(unknown)) * size, 0.0)

    def force(h: float) -> np.ndarray:
        unknown[:] = start + h * direction
        equilibrium.assemble_internal(residual)
        equilibrium.assemble_external(loads)
        return np.asarray((residual.array + loads.array)[free])

    zero = force(0.0)
    equilibrium.assemble_tangent(matrix)
    step, change = matrix.createVecRight(), matrix.createVecLeft()
    step.array[:] = direction
    matrix.mult(step, change)
    left = [np.linalg.norm(force(h) - zero - h * change.array[free]) for h in (1.0, 0.5, 0.25)]
    unknown[:] = start
    return np.asarray(np.log2(np.divide(left[:-1], left[1:])))
