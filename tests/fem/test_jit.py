"""Compiling: what is said, who waits for whom, compilations that were cut off, folders that cannot be written."""

from __future__ import annotations

import fcntl
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import mpirun, slowly
from tests.forks import forked
from tests.processes import all_end, ran, wait_for_compiler

PROGRAM = """
import logging, sys, ufl, dolfinx
from mpi4py import MPI
from remodel_fenicsx.fem import jit
logging.basicConfig(level=logging.INFO)
jit.TIMEOUT = 2
mesh = dolfinx.mesh.create_unit_cube(MPI.COMM_WORLD, 2, 2, 2)
x = ufl.SpatialCoordinate(mesh)
value = dolfinx.fem.assemble_scalar(jit.form(x[0] ** 3 * ufl.dx, name="the moment"))
total = mesh.comm.allreduce(value)
assert abs(total - 0.25) < 1e-12, total
print(len(jit.compiled_kernels))
"""


def compile_and_use(
    cache: Path, ranks: int = 1, **variables: str
) -> subprocess.CompletedProcess[str]:
    command, environment = program(cache)
    if ranks == 1:
        return forked("python", PROGRAM, variables=environment | variables)
    command = mpirun(ranks, *command)
    return ran(command, env=environment | variables)


def program(cache: Path, text: str = PROGRAM) -> tuple[list[str], dict[str, str]]:
    """The command and its environment."""
    own = {"PYTHONPATH": str(Path(__file__).parents[2]), "XDG_CACHE_HOME": str(cache)}
    return [sys.executable, "-c", text], os.environ | own


def one_file(folder: Path, pattern: str) -> Path:
    (file,) = folder.rglob(pattern)
    return file


@contextmanager
def locked_by_this_process(cache: Path) -> Iterator[None]:
    """As if a run with this process's number were compiling the program's kernel."""
    with one_file(cache, "locks/libffcx_*").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        lock.write(f"{os.getpid()}\n")
        lock.flush()
        yield


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache with the program's kernel."""
    cache = tmp_path_factory.mktemp("compiled")
    assert compile_and_use(cache).returncode == 0
    return cache


@pytest.fixture
def cache(compiled: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(compiled, tmp_path / "cache"))


def test_only_what_is_really_compiled_is_said_and_counted(tmp_path: Path) -> None:
    count = tmp_path / "count"
    first, again = (
        compile_and_use(tmp_path, REMODEL_FENICSX_COMPILED=str(count)) for _ in range(2)
    )
    assert (
        "compiling the moment, once on this machine" in first.stderr
        and "compil" not in again.stderr
    )
    assert (first.stdout, again.stdout) == ("1\n", "0\n")
    assert count.read_text() == one_file(tmp_path, "libffcx_forms_*.c").stem + "\n"


def test_what_is_in_the_cache_waits_for_no_compiler(cache: Path) -> None:
    with locked_by_this_process(cache):
        warm = compile_and_use(cache)
    assert warm.returncode == 0, warm.stderr[-2000:]
    assert "waiting" not in warm.stderr


def test_who_waits_for_a_compiler_says_for_whose(cache: Path) -> None:
    for path in cache.rglob("libffcx_*.*"):  # all but the lock
        path.unlink()
    command, environment = program(cache)
    with locked_by_this_process(cache):
        waiting = subprocess.Popen(command, stderr=subprocess.PIPE, env=environment, text=True)
        assert waiting.stderr
        line = next(line for line in waiting.stderr if "compil" in line)
    assert f"another run is compiling the same (process {os.getpid()}): waiting for it" in line
    assert line.startswith("NOTICE:")  # the terminal gets it
    assert "compiling the moment" in waiting.communicate(timeout=120)[1]
    assert waiting.returncode == 0


@pytest.mark.parametrize(
    ("ranks", "lost"),
    [(1, ".c"), (1, ".c.cached"), *slowly((2, ".c.cached"), (2, ".c"), (1, ".so"))],
)
def test_a_compilation_that_was_cut_off_is_done_again_at_once(
    ranks: int, lost: str, cache: Path
) -> None:
    library, source = one_file(cache, "libffcx_forms_*.so"), one_file(cache, "libffcx_forms_*.c")
    library.unlink()  # as if the compiler had been killed: mostly .c, the lock, stays without the end mark
    source.with_suffix(lost).unlink(missing_ok=True)
    again = compile_and_use(cache, ranks)
    assert again.returncode == 0, again.stderr[-2000:]
    assert "removing a compilation that was cut off" in again.stderr
    assert library.exists()
    assert "removing" not in compile_and_use(cache, ranks).stderr


@pytest.mark.parametrize("theirs", [False, True])
def test_a_cache_that_is_not_ones_own_is_replaced_with_a_warning(
    theirs: bool, cache: Path, tmp_path: Path
) -> None:
    """What is there is run."""
    temporary, place = tmp_path / "temporary", tmp_path / "file" / "cache"
    temporary.mkdir()
    (tmp_path / "file").touch()
    if theirs:
        place = cache
        for folder in (cache / "fenics").iterdir():
            try:
                os.chown(folder, 12345, 12345)
            except OSError:
                pytest.skip("only root can give a folder away")
    done = compile_and_use(place, TMPDIR=str(temporary))
    assert done.returncode == 0 and done.stderr.count("cannot write to") == 1, done.stderr[-2000:]
    assert list(temporary.rglob("libffcx_forms_*.so"))


DERIVED_TWICE = """
import dolfinx, numpy, ufl
from mpi4py import MPI
from remodel_fenicsx.fem import jit, quadrature
mesh = dolfinx.mesh.create_unit_cube(MPI.COMM_WORLD, 1, 1, 1, dolfinx.mesh.CellType.hexahedron)
for _ in range(2):
    x = ufl.SpatialCoordinate(mesh)
    first, second = ufl.variable(x[0]), ufl.variable(x[1])
    value = first**2 * second**3
    derivatives = ufl.as_vector([ufl.diff(value, first), ufl.diff(value, second)])
    compiled = jit.expression(derivatives, numpy.array([[0.5, 0.25, 0.0]]))
    numpy.testing.assert_allclose(quadrature.expression_values(compiled, mesh, numpy.zeros(1, numpy.int32), 1)[0], [[1 / 64, 3 / 64]])
print(len(jit.compiled_kernels))
"""


def test_an_expression_with_derivatives_is_compiled_once_for_all_problems_of_a_process(
    tmp_path: Path,
) -> None:
    """Of (0.5^2 0.25^3): UFL's numbers of variables are not part of the kernel."""
    done = forked("python", DERIVED_TWICE, variables=program(tmp_path)[1])
    assert (done.returncode, done.stdout) == (0, "1\n"), done.stderr[-2000:]


# A run that is under way: a signal is a request that it looks at now and then, but not while it compiles
IN_A_RUN = """
import sys, ufl, dolfinx
from mpi4py import MPI
from remodel_fenicsx.fem import jit
from remodel_fenicsx.system.interrupts import Interrupted, StopRequest
mesh = dolfinx.mesh.create_unit_cube(MPI.COMM_WORLD, 2, 2, 2)
x = ufl.SpatialCoordinate(mesh)
# takes the compiler a while
terms = [ufl.exp(x[0] * k) * ufl.sin(x[1] + k) * ufl.cos(x[2] * k) for k in range(1, 150)]
with StopRequest():
    try:
        jit.form(sum(terms[1:], terms[0]) * ufl.dx(degree=4))
    except Interrupted as interruption:
        sys.exit(interruption.exit_code)
"""


@pytest.mark.parametrize(
    ("group", "number"),
    [(True, signal.SIGINT), (False, signal.SIGTERM), *slowly((True, signal.SIGHUP))],
)
def test_a_signal_waits_for_the_compiler(
    group: bool, number: signal.Signals, tmp_path: Path
) -> None:
    """A terminal sends it to all processes; what is there afterwards is whole."""
    command, environment = program(tmp_path, IN_A_RUN)
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, env=environment, text=True, start_new_session=True
    )
    wait_for_compiler(process)
    (os.killpg if group else os.kill)(process.pid, number)
    errors = process.communicate(timeout=200)[1]
    assert (process.returncode, errors) == (128 + number, "") and all_end(process.pid)
    assert (
        one_file(tmp_path, "libffcx_*.so").exists()
        and one_file(tmp_path, "libffcx_*.c.cached").exists()
    )


LOGARITHMS = """
import sys, dolfinx, numpy as np, ufl
from mpi4py import MPI
from remodel_fenicsx.fem import jit
jit.COMPILER_FLAGS[:] = [flag for flag in jit.COMPILER_FLAGS if flag not in sys.argv[1:]]
mesh = dolfinx.mesh.create_unit_cube(MPI.COMM_WORLD, 5, 3, 2, dolfinx.mesh.CellType.hexahedron)
V = dolfinx.fem.functionspace(mesh, ("DG", 1))
u = dolfinx.fem.Function(V)
form = jit.form(ufl.ln(u) * ufl.TestFunction(V) * ufl.dx(degree=4))
u.x.array[:] = np.random.default_rng(1).uniform(1e-3, 1e3, u.x.array.size)
print(*dolfinx.fem.assemble_vector(form).array.tolist())
for element, bad in enumerate((np.nan, np.inf, 0.0, -1.0)):
    u.x.array[8 * element : 8 * element + 8] = bad
print(*dolfinx.fem.assemble_vector(form).array[:48:8].tolist())
"""


def test_the_simd_logarithm_is_the_scalar_one_and_lets_nothing_pass_the_guards(
    tmp_path: Path,
) -> None:
    """Equal but for rounding; what is no number or infinite is so afterwards, in its own element alone."""
    said = []
    for left_out in (
        (),
        ("-D__FAST_MATH__", "-O3"),
    ):  # at -O3 the compiler takes seconds for scalar logarithms
        done = forked("python", LOGARITHMS, *left_out, variables=program(tmp_path)[1])
        assert done.returncode == 0, done.stderr
        said.append([np.array(line.split(), dtype=float) for line in done.stdout.splitlines()])
    (vectors, bad), (scalars, bad_scalars) = said
    assert np.abs(vectors - scalars).max() <= 1e-14 * np.abs(scalars).max()
    assert (
        np.isnan(bad[[0, 3]]).all()
        and bad[1] == np.inf
        and bad[2] == -np.inf
        and np.isfinite(bad[4:]).all()
    )
    np.testing.assert_array_equal(np.isfinite(bad), np.isfinite(bad_scalars))
