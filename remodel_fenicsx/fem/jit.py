"""Compilation of forms, expressions and C functions: compiler flags, cache and log messages."""

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
from ufl import as_vector
from ufl.classes import Label
from ufl.corealg.map_dag import map_expr_dag
from ufl.corealg.multifunction import MultiFunction
from ufl.domain import extract_unique_domain

from remodel_fenicsx.model.tensors import Array
from remodel_fenicsx.system.interrupts import held_back, raise_on_signal
from remodel_fenicsx.system import NOTICE

if TYPE_CHECKING:
    from ufl import Form
    from ufl.core.expr import Expr

log = logging.getLogger(__name__)

TIMEOUT = 600  # seconds that FFCx waits for another process; `_compiling` removes what was cut off
# Environment variable: file that gets a line per compiled kernel.
COMPILED_LOG_VARIABLE = "REMODEL_FENICSX_COMPILED"

# There is no -ffast-math: NaN and infinity keep their meaning, which the guards rely on. Its macro
# alone makes glibc's headers declare their SIMD logarithm (error at most 4 ulp), which vectorises
# the loops over the points of an element. -g0: Python's own flags have -g, whose table takes up to
# half of the compiler's time. The machine code is the same.
COMPILER_FLAGS = (
    "-O3 -D__FAST_MATH__ -g0 -march=native -fno-math-errno -fno-trapping-math "
    "-fno-signed-zeros -freciprocal-math -fassociative-math -w"
).split()

# Flags of tangents. Sums over pairs of unknowns take most of their time. With a dynamic cost model
# -O2 vectorises these sums as -O3 does. Tangents run as fast (21 and 357 ms for the artery of
# degree 1 and 2), and the compiler takes two thirds of the time.
TANGENT_FLAGS = ["-O2", "-ftree-vectorize", "-fvect-cost-model=dynamic", *COMPILER_FLAGS[1:]]

# Numbers of components in one kernel. GCC vectorises stores this far apart over the points, all
# others not. Eleven components in one kernel took 0.65 ms for 12,288 points, eight and three 0.20
# ms.
SIMD_COMPONENTS = (16, 8, 4, 3, 2, 1)

# Flags of the package's C functions: all sums keep the order in which they are written.
LIBRARY_FLAGS = (
    "-std=c17 -O3 -g0 -march=native -fno-math-errno -fno-trapping-math -Wall -Wextra".split()
)

# By number of arguments: name of a form, seconds of its compilation (this energy, hexahedra, one
# core), and flags.
_KINDS = {
    0: ("an integral", 1, COMPILER_FLAGS),
    1: ("the residual", 1, COMPILER_FLAGS),
    2: ("the tangent", 3, TANGENT_FLAGS),
}

compiled_kernels: list[str] = []
"""Names of the kernels that this process has compiled, not of those from the cache."""


@functools.cache
def cache_folder() -> Path:
    """Return the folder of compiled kernels, one per processor type because of -march=native."""
    # The folder is below XDG_CACHE_HOME or ~/.cache. If that is not writable or belongs to another
    # user, it is a private temporary folder, with a warning.
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        # "Features" on ARM.
        processor = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    except OSError:  # on macOS
        processor = platform.processor()
    name = f"remodel-{hashlib.sha256((platform.machine() + processor).encode()).hexdigest()[:8]}"
    places = base / "fenics" / name, Path(tempfile.gettempdir()) / f"{name}-{os.getuid()}"
    for folder in places:
        with suppress(OSError):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            # Its files are executed.
            if os.access(folder, os.W_OK) and folder.lstat().st_uid == os.getuid():
                return folder
        log.warning(
            "cannot write to %s, or it belongs to another user: forms are compiled below %s",
            *places,
        )
    raise PermissionError(f"{folder}: belongs to another user; set TMPDIR to a private folder")


# dolfinx and FFCx read the user's own options once, and none of the working folder. That folder may
# belong to somebody else, and its files would choose libraries to load and change numbers.
with chdir("/"):
    dolfinx.jit.get_options()
    ffcx.options.get_options()


def jit_options(flags: list[str] = COMPILER_FLAGS) -> dict[str, object]:
    """Return the options for compiled forms and expressions."""
    return {"cffi_extra_compile_args": flags, "cache_dir": cache_folder(), "timeout": TIMEOUT}


def form(ufl_form: Form, name: str | None = None) -> dolfinx.fem.Form:
    """Compile a UFL form, or take it from the cache.

    Parameters
    ----------
    ufl_form
        The form.
    name
        Name for the log, such as "the mass matrix". Default: by the number of arguments.

    Returns
    -------
    dolfinx.fem.Form
        Compiled form, for dolfinx to assemble.

    Raises
    ------
    Interrupted
        If a signal arrives during the compilation while a `StopRequest` waits for signals.
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
    >>> volume = form(ufl.det(F) * simulation.quadrature.dx, "the volume")
    >>> round(dolfinx.fem.assemble_scalar(volume), 12)
    1.0
    """
    kind, seconds, flags = _KINDS[len(ufl_form.arguments())]
    with _compiler_watched(ufl_form.ufl_domains()[0].ufl_cargo().comm, name or kind, seconds):
        return dolfinx.fem.form(ufl_form, jit_options=jit_options(flags))


def expression(
    ufl_expression: Expr,
    points: Array,
    name: str | None = None,
) -> list[dolfinx.fem.Expression]:
    """Compile a UFL expression for evaluation at reference points, (n, 3). See `form`.

    Returns
    -------
    list of Expression
        Vectors of components, in order; `quadrature.expression_values` evaluates them.
    """
    flat = [
        ufl_expression[place] if place else ufl_expression
        for place in np.ndindex(ufl_expression.ufl_shape)
    ]
    parts = []
    comm = extract_unique_domain(ufl_expression).ufl_cargo().comm
    while flat:
        size = next(size for size in SIMD_COMPONENTS if size <= len(flat))
        part, flat = as_vector(flat[:size]), flat[size:]
        with _compiler_watched(comm, name or "an expression", 1):
            own = map_expr_dag(_OwnLabels(), part)
            parts.append(dolfinx.fem.Expression(own, points, jit_options=jit_options()))
    return parts


def library(
    comm: MPI.Intracomm,
    declarations: str,
    source: str,
    what: str,
) -> ModuleType:
    """Compile the package's C functions, or take them from the cache. See `form`. Collective."""
    text = "\0".join(
        [declarations, source, *LIBRARY_FLAGS, cffi.__version__, sysconfig.get_python_version()]
    )
    name = f"libremodel_{hashlib.sha256(text.encode()).hexdigest()[:40]}"
    failure: BaseException | None = None
    if comm.rank == 0 and not _is_cached(name):
        try:
            with _compiling(name, what, seconds=2):
                builder = cffi.FFI()
                builder.cdef(declarations)
                builder.set_source(name, source, extra_compile_args=LIBRARY_FLAGS, libraries=["m"])
                if not _is_cached(name):  # unless the run that this one waited for has compiled it
                    builder.compile(tmpdir=str(cache_folder()))
                    # The end mark comes last, as in FFCx.
                    (cache_folder() / f"{name}.c.cached").touch()
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
    """Numbering of the variables (`ufl.variable`) of an expression from 0."""

    expr = MultiFunction.reuse_if_untouched

    def __init__(self) -> None:
        super().__init__()
        self.labels: dict[Label, Label] = {}

    def label(self, label: Label) -> Label:
        """Return the label with its number, the next one for a new label."""
        return self.labels.setdefault(label, Label(len(self.labels)))


@contextmanager
def _compiler_watched(comm: MPI.Intracomm, what: str, seconds: int) -> Iterator[None]:
    """Compile kernels that the cache lacks, each by one process, and log them during the block."""
    # FFCx computes a kernel's name and looks it up with `get_cached_module`. Only there is it
    # known, without doing that work twice, whether the compiler is going to run. So `watched`
    # replaces that function. Cached kernels need no lock, no waiting, and no list of the cache's
    # thousands of files, which FFCx makes at every look-up. Of several ranks the first compiles,
    # and all other ranks look up when it has finished.
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
    """Lock a kernel that the block compiles, log the compilation, and hold back signals."""
    # The compiler must not get signals either: terminals and batch systems send them to all
    # processes of a job.
    with raise_on_signal(), _exclusive(kernel), held_back():
        if _is_cached(kernel):  # compiled by the run that this one waited for
            yield
            return
        log.log(NOTICE, "compiling %s, once on this machine: about %d s", what, seconds)
        start = clock.monotonic()
        yield
        log.info("compiled %s in %.1f s: %s", what, clock.monotonic() - start, kernel)
        compiled_kernels.append(kernel)
        if os.environ.get(COMPILED_LOG_VARIABLE):
            with open(os.environ[COMPILED_LOG_VARIABLE], "a") as file:
                file.write(f"{kernel}\n")


# ---------------------------------------------------------------- the cache


def _files(kernel: str) -> list[Path]:
    """Return FFCx's files of a kernel: source (which is its lock), end mark and library."""
    folder, library = cache_folder(), importlib.machinery.EXTENSION_SUFFIXES[0]
    return [folder / f"{kernel}{ending}" for ending in (".c", ".c.cached", library)]


def _is_cached(kernel: str) -> bool:
    return all(path.exists() for path in _files(kernel))


@contextmanager
def _exclusive(kernel: str) -> Iterator[None]:
    """Lock a kernel against other processes, and remove a compilation of it that was cut off."""
    # FFCx itself would wait for a compilation that was cut off: its .c file is the lock, and stays
    # if a process is killed. The lock here is the operating system's, which ends with its process.
    # The file holds the process number. Each kernel has its own lock, so that several runs, or
    # tests, compile at the same time.
    folder = cache_folder() / "locks"
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / kernel).open("a+") as lock:
        try:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                lock.seek(0)
                process = lock.read().strip() or "unknown"
                log.log(
                    NOTICE,
                    "another run is compiling the same (process %s): waiting for it",
                    process,
                )
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
                "%s cannot be locked (%s): runs that compile at the same time may fail, and after "
                "a killed run others may wait until they time out; set XDG_CACHE_HOME to a folder "
                "on a local disk",
                lock.name,
                error.strerror,
            )
        yield
