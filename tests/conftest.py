"""Runs that several tests look at are made once for a test session, also when pytest runs on several processes."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from remodel_fenicsx.system import children
from tests.forks import ForkedChild, forked

CASE = Path(__file__).with_name("run_case.py")
Case = Callable[..., dict[str, Any]]


def mpirun(ranks: int, *command: str) -> list[str]:
    """A command on so many ranks; --oversubscribe, because a test machine may have fewer cores."""
    return [*command] if ranks == 1 else ["mpirun", "--oversubscribe", "-n", str(ranks), *command]


def slowly(*cases: Any) -> list[Any]:
    """Cases of a parametrised test that only `-m slow` runs, where the others already show what it tells."""
    return [pytest.param(*(one if isinstance(one, tuple) else (one,)), marks=pytest.mark.slow) for one in cases]


@contextmanager
def forked_children() -> Iterator[None]:
    """Within, the runs that figures, ensembles and trades start are forked, one after the other."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(children, "subprocess", SimpleNamespace(Popen=ForkedChild, DEVNULL=subprocess.DEVNULL))
        yield


@pytest.fixture(scope="session")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """case(scene, ranks=1, snapshots=(), divisions=None) -> what tests/run_case.py saved, by name."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "cases"
    folder.mkdir(exist_ok=True)

    def run(
        scene: dict[str, Any],
        ranks: int = 1,
        snapshots: tuple[float, ...] = (),
        divisions: tuple[int, int, int] | None = None,
    ) -> dict[str, Any]:
        request = json.dumps({"scene": scene, "snapshots": list(snapshots), "divisions": divisions}, sort_keys=True)
        out = folder / (hashlib.sha256(f"{ranks} {request}".encode()).hexdigest()[:16] + ".npz")
        with out.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not out.exists():
                part = out.with_suffix(".part.npz")
                command = mpirun(ranks, sys.executable, "-m", "mpi4py", str(CASE), str(part), request)
                if ranks == 1:
                    done = forked("case", part, request)
                else:
                    done = subprocess.run(command, capture_output=True, text=True, timeout=900)
                assert done.returncode == 0, done.stderr[-3000:]
                part.rename(out)
        with np.load(out) as data:
            return dict(data)

    return run
