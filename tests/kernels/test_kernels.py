"""The C files: a complete table, no warning, no undefined behaviour, each number once, and numpy in their place."""

from __future__ import annotations

import logging
import os
import re
import shlex
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx.errors import RemodelError
from remodel_fenicsx.fem import jit
from remodel_fenicsx import kernels
from remodel_fenicsx.model.cells import structure_tensor
from remodel_fenicsx.scene import preset_scene
from remodel_fenicsx.system.environment import KERNELS, versions
from tests.conftest import Refused
from tests.processes import ran
from tests.runs import simulated

ROOT = Path(__file__).parents[2]
NUMBERS = {"spectral.c": {}, "tensor.c": kernels.NUMBERS}
CC = shlex.split(os.environ.get("CC", "cc"))


@pytest.mark.parametrize("name", NUMBERS)
def test_there_is_no_warning(name: str, tmp_path: Path) -> None:
    """All that the compiler sees when it optimises, which is all with -O2."""
    asked = "-O2 -Wall -Wextra -Werror -c -x c - -o".split()
    command = [*CC, *jit.LIBRARY_FLAGS, *asked, tmp_path / "object"]
    done = ran(command, input=kernels.source(name, NUMBERS[name]))
    assert (done.returncode, done.stderr) == (0, "")
    assert not {"-w", "-Wno-all"} & set(jit.LIBRARY_FLAGS)


SANITIZED = """
import sys
import pytest
from remodel_fenicsx.errors import RemodelError
from remodel_fenicsx.fem import jit
jit.LIBRARY_FLAGS += ["-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
files = ["tests/kernels/test_compiled.py", "tests/kernels/test_compiled_tensor.py"]
sys.exit(pytest.main(["-q", "-s", "-p", "no:cacheprovider", "-x", *files]))
"""


def test_memory_and_arithmetic_under_the_sanitizers() -> None:
    """What is held against numpy once more, with C that ends the process where it leaves an array, or the standard."""
    asked = [[*CC, f"-print-file-name=lib{name}.so"] for name in ("asan", "ubsan")]
    found = [ran(command).stdout.strip() for command in asked]
    if not all(map(os.path.isabs, found)):
        pytest.skip(f"{CC[0]} has no address and undefined-behaviour sanitizers")
    # what Python and its libraries keep to their end is no leak of ours
    own = {"LD_PRELOAD": " ".join(found), "ASAN_OPTIONS": "detect_leaks=0", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", SANITIZED]
    done = ran(command, cwd=ROOT, env=os.environ | own)
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    assert re.search(r"\d\d passed", done.stdout)


def test_a_change_of_any_file_or_number_is_another_library(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By its text it is found in the cache."""
    before = kernels.source("tensor.c", kernels.NUMBERS)
    assert kernels.source("tensor.c", kernels.NUMBERS) == before
    assert kernels.source("tensor.c", {**kernels.NUMBERS, "TOLERANCE": 1e-11}) != before
    copy = tmp_path / "kernels"
    shutil.copytree(kernels.FOLDER, copy)
    monkeypatch.setattr(kernels, "FOLDER", copy)
    assert kernels.source("tensor.c", kernels.NUMBERS) == before
    for name in ("tensor.c", "algebra.h"):
        text = (copy / name).read_text()
        (copy / name).write_text(text + "/* more */\n")
        assert kernels.source("tensor.c", kernels.NUMBERS) != before
        (copy / name).write_text(text)


# ---------------------------------------------------------------- numpy in their place
RANDOM = {"model.kinematics": "full", "cells.initial": "random", "geometry.length": 1.0}
TENSOR = {"remodeling.law": "tensor", "material.repulsion": "log", "remodeling.frame": "material"}


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"remodeling.law": "relaxation"},
        RANDOM,
        RANDOM | {"remodeling.frame": "material"},
        TENSOR | {"remodeling.coupling": "extrapolated"},
    ],
)
def test_numpy_does_the_same_and_no_c_runs(
    changes: dict[str, Any], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A radial artery, which says what computes, and random cells; all alike, rounding alone tells some axes apart."""
    monkeypatch.setattr("remodel_fenicsx.body.tube.PAPER", (8, 4, 2))
    values = {"model.kinematics": "radial", "cells.initial": "isotropic", "time.end": 2.0} | changes
    scene, found = preset_scene("kuhl-holzapfel-2007", "tube").with_values(values), []
    for where in ("C", "numpy"):
        monkeypatch.setenv(KERNELS, where)
        assert versions()["kernels"] == where
        if where == "numpy":
            kernels._log_numpy_once.cache_clear()
            monkeypatch.setattr(jit, "library", None)
        with caplog.at_level(logging.INFO), simulated(scene) as (simulation, _):
            wanted = kernels.CompiledPointKernels if where == "C" else kernels.PointKernels
            assert type(simulation.cells.kernels) is wanted
            found.append(structure_tensor(*simulation.cells.point_cells[:2]))
    accuracy = 1e-9 if RANDOM.items() <= changes.items() else 1e-12
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=accuracy)
    assert caplog.text.count(f"{KERNELS}=numpy") == 1


def test_what_the_setting_allows(monkeypatch: pytest.MonkeyPatch, refused: Refused) -> None:
    """One line, before anything is read."""
    monkeypatch.setenv(KERNELS, "numpy")
    assert type(kernels.point_kernels(MPI.COMM_SELF)) is kernels.PointKernels
    monkeypatch.setenv(KERNELS, "c")
    assert refused("run", "no-such-scene.toml") == f"{KERNELS} = 'c': must be 'C' or 'numpy'\n"
    with pytest.raises(RemodelError, match=KERNELS):
        kernels.point_kernels(MPI.COMM_SELF)
