"""The cache of compiled forms: compilations that were cut off, runs at once, folders that cannot be written."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.conftest import mpirun

PROGRAM = """
import logging, sys, ufl, dolfinx
from mpi4py import MPI
from remodel_fenicsx.fem import jit
logging.basicConfig(level=logging.INFO)
jit.TIMEOUT = 2
mesh = dolfinx.mesh.create_unit_cube(MPI.COMM_WORLD, 2, 2, 2)
x = ufl.SpatialCoordinate(mesh)
value = dolfinx.fem.assemble_scalar(jit.form(x[0] ** 3 * ufl.dx))
total = mesh.comm.allreduce(value)
assert abs(total - 0.25) < 1e-12, total
"""


def compile_and_use(cache: Path, ranks: int = 1, **variables: str) -> subprocess.CompletedProcess[str]:
    own = {"PYTHONPATH": str(Path(__file__).parents[1]), "XDG_CACHE_HOME": str(cache), **variables}
    command = mpirun(ranks, sys.executable, "-c", PROGRAM)
    return subprocess.run(command, capture_output=True, text=True, timeout=120, env=os.environ | own)


@pytest.mark.parametrize("lost", [".c", ".c.cached"])
@pytest.mark.parametrize("ranks", [1, 2])
def test_a_compilation_that_was_cut_off_is_done_again_at_once(ranks: int, lost: str, tmp_path: Path) -> None:
    assert compile_and_use(tmp_path, ranks).returncode == 0
    (library,) = tmp_path.rglob("libffcx_forms_*.so")
    (source,) = tmp_path.rglob("libffcx_forms_*.c")
    library.unlink()  # as if the compiler had been killed: mostly .c, the lock, stays without the end mark
    source.with_suffix(lost).unlink()
    again = compile_and_use(tmp_path, ranks)
    assert again.returncode == 0, again.stderr[-2000:]
    assert "removing a compilation that was cut off" in again.stderr
    assert library.exists()
    assert "removing" not in compile_and_use(tmp_path, ranks).stderr


def test_runs_at_once_compile_one_after_the_other(tmp_path: Path) -> None:
    with ThreadPoolExecutor(3) as pool:
        done = list(pool.map(lambda _: compile_and_use(tmp_path), range(3)))
    assert [run.returncode for run in done] == [0, 0, 0], [run.stderr[-500:] for run in done]
    assert not any("removing a compilation" in run.stderr for run in done)  # none takes another's work for cut off


def test_a_cache_that_cannot_be_written_is_replaced_with_a_warning(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    done = compile_and_use(tmp_path / "file" / "cache", TMPDIR=str(temporary))
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stderr.count("cannot write to") == 1 and str(temporary) in done.stderr
    assert list(temporary.rglob("libffcx_forms_*.so"))
