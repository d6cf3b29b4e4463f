"""A compilation that was cut off does not stop later runs."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import mpirun

PROGRAM = """
import sys, ufl, dolfinx
from mpi4py import MPI
from remodel_fenicsx import jit
jit.TIMEOUT = 2
mesh = dolfinx.mesh.create_unit_cube(MPI.COMM_WORLD, 2, 2, 2)
x = ufl.SpatialCoordinate(mesh)
value = dolfinx.fem.assemble_scalar(jit.form(x[0] ** 3 * ufl.dx))
total = mesh.comm.allreduce(value)
assert abs(total - 0.25) < 1e-12, total
"""


@pytest.mark.parametrize("ranks", [1, 2])
def test_a_compilation_that_was_cut_off_is_done_again(ranks: int, tmp_path: Path) -> None:
    environment = {
        **os.environ,
        "PYTHONPATH": str(Path(__file__).parents[1]),
        "XDG_CACHE_HOME": str(tmp_path),
    }

    def compile_and_use() -> subprocess.CompletedProcess[str]:
        command = mpirun(ranks, sys.executable, "-c", PROGRAM)
        return subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment)

    assert compile_and_use().returncode == 0
    libraries = list(tmp_path.rglob("libffcx_forms_*.so"))
    assert len(libraries) == 1
    (source,) = tmp_path.rglob("libffcx_forms_*.c")
    libraries[0].unlink()  # as if the compiler had been killed: its .c file, the lock, stays without the end mark
    source.with_suffix(".c.cached").unlink()
    os.utime(source, (0, 0))
    again = compile_and_use()
    assert again.returncode == 0, again.stderr[-2000:]
    assert "removing a compilation that was cut off" in again.stderr
    assert list(tmp_path.rglob("libffcx_forms_*.so"))
