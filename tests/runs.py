"""Scenes, or tables of them, run to their end in this process alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from mpi4py import MPI

from remodel_fenicsx import Scene, Simulation
from remodel_fenicsx.scene.scene import scene_from_dict

SELF = MPI.COMM_SELF
Rows = list[dict[str, float]]


@contextmanager
def made(scene: Scene | Mapping[str, Any], domain: Any = None) -> Iterator[Simulation]:
    """A simulation before its first step, which is closed in the end."""
    simulation = Simulation(scene if isinstance(scene, Scene) else scene_from_dict(dict(scene)), SELF, domain)
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


def rows_of(scene: Scene | Mapping[str, Any], domain: Any = None, watchers: Sequence[Any] = ()) -> Rows:
    """All rows of its steps."""
    with simulated(scene, domain, watchers) as (_, rows):
        return rows


def last_row(scene: Scene | Mapping[str, Any], domain: Any = None) -> dict[str, float]:
    """The row of its end."""
    return rows_of(scene, domain)[-1]


def columns_of(scene: Scene | Mapping[str, Any], domain: Any = None) -> dict[str, np.ndarray]:
    """Its rows by column."""
    rows = rows_of(scene, domain)
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}
