"""Runs of benchmarks/work_precision.py that have been measured, and how far they are from what is exact."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.body.shape import PROFILE
from remodel_fenicsx.scene.scene import Scene
from remodel_fenicsx.schema import same_time
from remodel_fenicsx.studies import trade as rungs
from tests.runs import rows_of

Array = NDArray[np.float64]
Run = Mapping[str, Array]
EVERY_TANGENT = {"solver.method": "direct", "solver.predictor": "with-tolerance"}
"""How the tables of docs/speed_and_accuracy.md were measured: the presets named this up to 0.2.0."""


@dataclass(frozen=True)
class Found:
    """One run.

    Attributes
    ----------
    seconds
        Of the processor.
    typical, anywhere
        Error of the fibre angle, degrees: root mean square over places and times, and the largest.
    percent
        Largest relative error of the lengths.
    """

    seconds: float
    typical: float
    anywhere: float
    percent: float


class Kept:
    """A folder with a file for each run."""

    def __init__(self, folder: Path):
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def path(self, name: str) -> Path:
        """Of a run."""
        return self.folder / f"{name.replace(' ', '-')}.npz"

    def __contains__(self, name: str) -> bool:
        return self.path(name).exists()

    def __getitem__(self, name: str) -> Run:
        with np.load(self.path(name)) as found:
            return dict(found)

    def keep(self, name: str, run: Run) -> None:
        """A file."""
        np.savez(self.path(name), **run)  # type: ignore[arg-type]
        if "seconds" in run:
            print(f"{name}: {float(run['seconds']):.2g} s", flush=True)

    def measure(self, name: str, scene: Scene, times: list[float]) -> None:
        """A run that is not kept yet."""
        if name not in self:
            self.keep(name, measured(scene, times))

    def found(self, name: str, angles: Array, lengths: Array) -> Found:
        """A run against exact angles and lengths."""
        run = self[name]
        apart = run["angles"] - angles
        percent = 100 * float(np.max(np.abs(run["lengths"] / lengths - 1)))
        return Found(float(run["seconds"]), float(rungs.typical(apart)), float(np.abs(apart).max()), percent)


def measured(scene: Scene, times: list[float]) -> Run:
    """Angles and radii at the compared times, and seconds of the processor of a run."""
    rows = rows_of(rungs.as_run(rungs.Setting({}, scene, (1,)), 1, times))
    asked = [next(row for row in rows if same_time(row["time"], time)) for time in times]
    return {
        "angles": np.array([[row[name] for name in PROFILE] for row in asked]),
        "lengths": np.array([[row["inner_radius"], row["outer_radius"]] for row in asked]),
        "seconds": np.array(sum(row["processor_seconds"] for row in rows)),
    }
