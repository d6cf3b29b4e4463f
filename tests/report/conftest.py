"""Runs that reports are made of: each once for a session, short ones."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.forks import forked

DEMOS = Path(__file__).parents[2] / "demos"
# axial chains lock at a stretch of L / r0 = 1.594
LOCKING = (
    "cells.initial=aligned | cells.aligned_axis=2 | loads.elongation.value=1.0 | loads.pressure.value=0 | "
    "remodeling.law=none | solver.maximum_halvings=3 | loads.elongation.ramp="
)
# by name: the demo, and what is set
RUNS = {
    "artery": ("artery", "time.end=10"),
    "tendon": ("tendon", "time.end=5"),
    "cube": ("cube", "time.end=10"),
    "tetrahedra": ("cube", "time.end=2 | mesh.element=tetrahedron"),
    "three tetrahedra": ("cube", "time.end=1 | mesh.element=tetrahedron | mesh.refinement=3"),
    "unloaded": ("turnover", "time.end=4 | time.step=2 | natural.opening_angle=60 | geometry.is=loaded"),
    "quadratic": ("cube", "time.end=2 | mesh.degree=2"),
    "radial": ("artery", "time.end=3 | cells.initial=isotropic | model.kinematics=radial"),
    "axisymmetric": ("artery", "time.end=3 | cells.initial=isotropic | model.kinematics=axisymmetric"),
    "layers": ("layers", "time.end=3"),
    "sector": ("artery", "time.end=3 | cells.initial=isotropic | model.kinematics=sector"),
    "point": ("tendon", "time.end=3 | cells.initial=isotropic | model.kinematics=point"),
    "without fields": ("cube", "time.end=3 | output.fields=false"),
    "angles alone": ("cube", "time.end=3 | mesh.refinement=2 | output.fields=['fibre_angle_deformed']"),
    "failed": ("artery", f"{LOCKING}[[0.0, 0.0], [5.0, 1.0]]"),  # between t = 2 and t = 3
    "one time": ("artery", f"{LOCKING}[[0.0, 0.0], [1.0, 1.0]]"),
}  # fmt: skip
Recorded = Callable[[str], Path]


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """recorded(name of `RUNS`) -> the folder of the run, with its report."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "reported"
    folder.mkdir(exist_ok=True)

    def run(name: str) -> Path:
        place = folder / name
        with (folder / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not place.exists():
                demo, settings = RUNS[name]
                changes = [f"--set={setting.strip()}" for setting in settings.split("|")]
                done = forked("remodel-fenicsx", "run", DEMOS / f"{demo}.toml", *changes, "-o", place, "-q")
                assert done.returncode == (3 if name in ("failed", "one time") else 0), done.stderr
        return place

    return run
