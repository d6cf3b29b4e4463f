"""Runs that reports are made of: each once for a session, short ones."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.forks import forked
from tests.tables import rows

DEMOS = Path(__file__).parents[2] / "demos"
RUNS = {name: (demo, settings) for name, demo, *settings in rows(__file__, "runs.txt")}
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
                changes = [f"--set={setting}" for setting in settings]
                done = forked(
                    "remodel-fenicsx", "run", DEMOS / f"{demo}.toml", *changes, "-o", place, "-q"
                )
                assert done.returncode == (3 if name in ("failed", "one time") else 0), done.stderr
        return place

    return run
