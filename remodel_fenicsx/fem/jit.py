"""How forms and expressions are compiled: one place for compiler flags, the cache, and what a compilation says."""

from __future__ import annotations

import fcntl
import functools
import hashlib
import importlib.machinery
import importlib.util
import logging
import os
import platform
import sysconfig
import tempfile
import time as clock
from collections.abc import Callable, Iterator
from contextlib import ExitStack, chdir, contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any, TYPE_CHECKING

import cffi
import dolfinx.fem
import dolfinx.jit
import ffcx.codegeneration.jit
import ffcx.options
import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from ufl import as_vector
from ufl.classes import Label
from ufl.corealg.map_dag import map_expr_dag
from ufl.corealg.multifunction import MultiFunction
from ufl.domain import extract_unique_domain

from remodel_fenicsx.system.interrupts import held_back, stopping_at_once
from remodel_fenicsx.system import NOTICE

if TYPE_CHECKING:
    from dolfinx.mesh import Mesh
    from ufl import Form
    from ufl.core.expr import Expr

log = logging.getLogger(__name__)

TIMEOUT = 600  # seconds that FFCx waits for another process to compile a form; none was cut off (_compiling)
COMPILED = "REMODEL_FENICSX_COMPILED"  # names a file that gets a line for each kernel that is really compiled

# NaN and infinity keep their meaning, which the guards rely on: no -ffast-math. Its name alone, defined for glibc's
# headers, declares their SIMD logarithm (at most 4 ulp off): the loops over the points of an element become vectors.
# -g0: Python's own flags have -g, and their table takes up to half of the compiler's time; the same machine code
COMPILER_FLAGS = (
    "-O3 -D__FAST_MATH__ -g0 -march=native -fno-math-errno -fno-trapping-math "
    "-fno-signed-zeros -freciprocal-math -fassociative-math -w"
).split()

# Of tangents: their time is that of sums over pairs of unknowns, which -O2 makes vectors of as -O3 does if it may count
# the turns of a loop. They run as fast (21 and 357 ms for the artery of degree 1 and 2), and the compiler takes two
# thirds of the time.
TANGENT_FLAGS = ["-O2", "-ftree-vectorize", "-fvect-cost-model=dynamic", *COMPILER_FLAGS[1:]]

# Components of a vector in one kernel: stores this far apart GCC makes from vectors of points, others point by point.
# Eleven in one kernel took 0.65 ms of 12,288 points, eight and three 0.20.
SIMD_COMPONENTS = (16, 8, 4, 3, 2, 1)

# of our own C functions: no sum is taken in another order than it is written in
LIBRARY_FLAGS = "-std=c17 -O3 -g0 -march=native -fno-math-errno -fno-trapping-math -Wall -Wextra".split()

# By number of arguments: what a form is, the seconds that it takes (the energy here, hexahedra, one core), and flags
_KINDS = {
    0: ("an integral", 1, COMPILER_FLAGS),
    1: ("the residual", 1, COMPILER_FLAGS),
    2: ("the tangent", 3, TANGENT_FLAGS),
}

_compiled: list[str] = []


def compiled_kernels() -> tuple[str, ...]:
    """Names of the kernels that this process has really compiled, not found in the cache."""
    return tuple(_compiled)


@functools.cache
def cache_folder() -> Path:
    """Folder of compiled kernels: per processor type, because -march=native code must not meet another processor."""
    # Below XDG_CACHE_HOME or ~/.cache; where that cannot be written or is another user's, in a private temporary
    # folder, with a warning.
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = next((line for line in lines if line.startswith(("flags", "Features"))), "")  # the latter of ARM
    except OSError:  # on macOS
        processor = platform.processor()
    name = f"remodel-{hashlib.sha256((platform.machine() + processor).encode()).hexdigest()[:8]}"
    places = base / "fenics" / name, Path(tempfile.gettempdir()) / f"{name}-{os.getuid()}"
    for folder in places:
        with suppress(OSError):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if os.access(folder, os.W_OK) and folder.lstat().st_uid == os.getuid():  # what is there is run
                return folder
        log.warning("cannot write to %s, or it belongs to another user: forms are compiled below %s", *places)
    raise PermissionError(f"{folder}: belongs to another user; set TMPDIR to a folder of your own")


# dolfinx and FFCx read the options of the user's own folder, once, and none of the working folder: that may be somebody
# else's, and its files would choose libraries to load and change numbers
with chdir("/"):
    dolfinx.jit.get_options()
    ffcx.options.get_options()


def jit_options(flags: list[str] = COMPILER_FLAGS) -> dict[str, object]:
    """Options for compiled forms and expressions."""
    return {"cffi_extra_compile_args": flags, "cache_dir": cache_folder(), "timeout": TIMEOUT}


def form(ufl_form: Form, name: str | None = None) -> dolfinx.fem.Form:
    """Compile a UFL form, or take it from the cache.

    Parameters
    ----------
    ufl_form
        The form.
    name
        What is being compiled, for people: "the mass matrix". Default: by the number of its arguments.

    Returns
    -------
    dolfinx.fem.Form
        Compiled, for dolfinx to assemble.

    Raises
    ------
    Interrupted
        If a `StopRequest` is waiting for signals and one came while it was compiled.
    RuntimeError
        If the kernel does not compile.

    Examples
    --------
    The volume of a body:

    >>> import dolfinx
    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> from remodel_fenicsx.extend import form
    >>> import ufl
    >>> simulation = Simulation(preset_scene("kuhl-holzapfel-2007", "cube"))
    >>> F = simulation.state.kinematics.deformation_gradient(simulation.unknown)
    >>> round(dolfinx.fem.assemble_scalar(form(ufl.det(F) * simulation.quadrature.dx, "the volume")), 12)
    1.0
    """
    kind, seconds, flags = _KINDS[len(ufl_form.arguments())]
    with _compiler_watched(ufl_form.ufl_domains()[0].ufl_cargo().comm, name or kind, seconds):
        return dolfinx.fem.form(ufl_form, jit_options=jit_options(flags))


def expression(
    ufl_expression: Expr,
    points: NDArray[np.float64],
    name: str | None = None,
) -> PointValues:
    """Compile a UFL expression for evaluation at reference points of shape (n, 3); otherwise like `form`."""
    flat = [ufl_expression[place] if place else ufl_expression for place in np.ndindex(ufl_expression.ufl_shape)]
    parts, sizes, comm = [], [], extract_unique_domain(ufl_expression).ufl_cargo().comm
    while flat:
        size = next(size for size in SIMD_COMPONENTS if size <= len(flat))
        part, flat = as_vector(flat[:size]), flat[size:]
        with _compiler_watched(comm, name or "an expression", 1):
            own = map_expr_dag(_OwnLabels(), part)
            parts.append(dolfinx.fem.Expression(own, points, jit_options=jit_options()))
            sizes.append(size)
    return PointValues(parts, sizes, len(points))


class PointValues:
    """An expression at reference points of elements, compiled in parts of some components each (`expression`)."""

    def __init__(self, parts: list[dolfinx.fem.Expression], sizes: list[int], points: int):
        self._parts, self._sizes, self._points = parts, sizes, points
        self.components = sum(sizes)

    def eval(self, mesh: Mesh, elements: NDArray[np.int32]) -> NDArray[np.float64]:
        """The components, in their order, at the points of each element: (elements, points, components)."""
        values = [
            part.eval(mesh, elements).reshape(len(elements), self._points, size)
            for part, size in zip(self._parts, self._sizes, strict=True)
        ]
        return values[0] if len(values) == 1 else np.concatenate(values, axis=2)


def library(comm: MPI.Intracomm, declarations: str, source: str, what: str) -> ModuleType:
    """Compile C functions of our own, or take them from the cache. Collective; says and raises what `form` does."""
    text = "\0".join([declarations, source, *LIBRARY_FLAGS, cffi.__version__, sysconfig.get_python_version()])
    name = f"libremodel_{hashlib.sha256(text.encode()).hexdigest()[:40]}"
    failure: BaseException | None = None
    if comm.rank == 0 and not _is_cached(name):
        try:
            with _compiling(name, what, seconds=2):
                builder = cffi.FFI()
                builder.cdef(declarations)
                builder.set_source(name, source, extra_compile_args=LIBRARY_FLAGS, libraries=["m"])
                if not _is_cached(name):  # else by the run that this one has waited for
                    builder.compile(tmpdir=str(cache_folder()))
                    (cache_folder() / f"{name}.c.cached").touch()  # as FFCx does: last the end mark
        except BaseException as error:
            failure = error
    if comm.bcast(failure is not None):
        raise failure or RuntimeError(f"the first rank could not compile {what}")
    return _loaded(name)


@functools.cache
def _loaded(name: str) -> ModuleType:
    path = cache_folder() / f"{name}{importlib.machinery.EXTENSION_SUFFIXES[0]}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class _OwnLabels(MultiFunction):
    """Numbers the variables (`ufl.variable`) of an expression from 0."""

    expr = MultiFunction.reuse_if_untouched

    def __init__(self) -> None:
        super().__init__()
        self.labels: dict[Label, Label] = {}

    def label(self, label: Label) -> Label:
        """The next number, or the one that this label has got."""
        return self.labels.setdefault(label, Label(len(self.labels)))


@contextmanager
def _compiler_watched(comm: MPI.Intracomm, what: str, seconds: int) -> Iterator[None]:
    """Within, what is not in the cache is compiled, each kernel by one process, and said."""
    # FFCx computes a kernel's name and looks for it by `get_cached_module`: nothing else knows without doing that work
    # twice whether the compiler is going to run. So this stands before that function. What is in the cache passes at
    # once: no lock, no waiting, and no list of the cache's thousands of files, which FFCx makes at every look. Of
    # several ranks the first compiles; the others ask when it is done.
    look_up: Callable[..., Any] = ffcx.codegeneration.jit.get_cached_module
    with ExitStack() as until_compiled:

        def watched(kernel: str, names: list[str], *arguments: Any, **options: Any) -> Any:
            if _is_cached(kernel):
                module = _loaded(kernel)
                return [getattr(module.lib, name) for name in names], module
            if comm.rank == 0:
                until_compiled.enter_context(_compiling(kernel, what, seconds))
            return look_up(kernel, names, *arguments, **options)

        ffcx.codegeneration.jit.get_cached_module = watched
        try:
            yield
        finally:
            ffcx.codegeneration.jit.get_cached_module = look_up


@contextmanager
def _compiling(kernel: str, what: str, seconds: int) -> Iterator[None]:
    """The only process that compiles this kernel; signals wait until it is there."""
    # also for the compiler: a terminal and batch systems send them to all processes of a job
    with stopping_at_once(), _alone(kernel), held_back():
        if _is_cached(kernel):  # by the run that this one has waited for
            yield
            return
        log.log(NOTICE, "compiling %s, once on this machine: about %d s", what, seconds)
        start = clock.monotonic()
        yield
        log.info("compiled %s in %.1f s: %s", what, clock.monotonic() - start, kernel)
        _compiled.append(kernel)
        if os.environ.get(COMPILED):
            with open(os.environ[COMPILED], "a") as file:
                file.write(f"{kernel}\n")


# ---------------------------------------------------------------- the cache


def _files(kernel: str) -> list[Path]:
    """What FFCx leaves of a kernel: the source, which is its lock, the end mark, the library."""
    folder, library = cache_folder(), importlib.machinery.EXTENSION_SUFFIXES[0]
    return [folder / f"{kernel}{ending}" for ending in (".c", ".c.cached", library)]


def _is_cached(kernel: str) -> bool:
    return all(path.exists() for path in _files(kernel))


@contextmanager
def _alone(kernel: str) -> Iterator[None]:
    """Only one process compiles a kernel, so that whatever is unfinished of it was cut off before: it is removed."""
    # FFCx itself would wait for it: its .c file is the lock, and stays when a process is killed. The lock here is the
    # operating system's, which ends with its process; the file holds the number of that process. Other kernels have
    # other locks: several runs, or tests, compile at the same time.
    folder = cache_folder() / "locks"
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / kernel).open("a+") as lock:
        try:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                lock.seek(0)
                process = lock.read().strip() or "unknown"
                log.log(NOTICE, "another run is compiling the same (process %s): waiting for it", process)
                fcntl.flock(lock, fcntl.LOCK_EX)
            lock.truncate(0)
            lock.write(f"{os.getpid()}\n")
            lock.flush()
            if not _is_cached(kernel) and any(path.exists() for path in _files(kernel)):
                log.info("removing a compilation that was cut off: %s", kernel)
                for path in folder.parent.glob(f"{kernel}.*"):
                    path.unlink(missing_ok=True)
        except OSError as error:  # some network file systems have no locks
            log.warning(
                "%s cannot be locked (%s): several runs at a time may wait for each other", lock.name, error.strerror
            )
        yield
