"""How forms and expressions are compiled: one place for compiler flags, the cache and its one known trap."""

from __future__ import annotations

import fcntl
import functools
import hashlib
import logging
import os
import platform
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import dolfinx.fem
from mpi4py import MPI
from ufl.domain import extract_unique_domain

log = logging.getLogger(__name__)

TIMEOUT = 600  # seconds that FFCx waits for another process to compile a form; none was cut off (_alone)

# Faster than -O2 by a third for this energy, and NaN and infinity keep their meaning: the guards rely on them.
COMPILER_FLAGS = [
    "-O2", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros", "-freciprocal-math",
    "-fassociative-math", "-w",
]  # fmt: skip


@functools.cache
def cache_folder() -> Path:
    """Folder of compiled kernels: per processor type, because -march=native code must not meet another processor.

    Below XDG_CACHE_HOME or ~/.cache; where that cannot be written, in a private temporary folder, with a warning.
    """
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = next((line for line in lines if line.startswith("flags")), "")
    except OSError:
        processor = platform.processor()
    name = f"remodel-{hashlib.sha256((platform.machine() + processor).encode()).hexdigest()[:8]}"
    folder = base / "fenics" / name
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
    other = Path(tempfile.gettempdir()) / f"remodel-fenicsx-forms-{os.getuid()}"
    other.mkdir(mode=0o700, exist_ok=True)
    if other.is_symlink() or other.stat().st_uid != os.getuid():
        raise PermissionError(f"{other}: of another user; set TMPDIR to a folder of your own")
    log.warning("cannot write to %s: forms are compiled into %s", folder, other)
    return other / name


def is_cold() -> bool:
    """Whether nothing has been compiled on this machine yet, so that the first run takes longer."""
    return not any(cache_folder().glob("*.c.cached"))


def jit_options() -> dict[str, Any]:
    """Options for every compiled form or expression."""
    return {"cffi_extra_compile_args": COMPILER_FLAGS, "cache_dir": cache_folder(), "timeout": TIMEOUT}


def form(ufl_form: Any) -> Any:
    """Compile a UFL form.

    Raises
    ------
    RuntimeError
        If the kernel does not compile.
    """
    with _alone(ufl_form.ufl_domains()[0].ufl_cargo().comm):
        return dolfinx.fem.form(ufl_form, jit_options=jit_options())


def expression(ufl_expression: Any, points: Any) -> Any:
    """Compile a UFL expression for evaluation at reference points of shape (n, 3)."""
    with _alone(extract_unique_domain(ufl_expression).ufl_cargo().comm):
        return dolfinx.fem.Expression(ufl_expression, points, jit_options=jit_options())


@contextmanager
def _alone(comm: MPI.Intracomm) -> Iterator[None]:
    """Only one process compiles at a time, so that whatever is unfinished before was cut off: it is removed.

    FFCx itself would wait for it: its .c file is the lock, and stays when a process is killed. The lock here is the
    kernel's, which ends with its process. Of several ranks the first compiles, the others wait for it.
    """
    if comm.rank != 0:
        yield
        return
    folder = cache_folder()
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "compiling.lock").open("a") as lock:
        try:
            _take(lock)
            _remove_unfinished()
        except OSError as error:  # some network file systems have no locks
            log.warning("%s cannot be locked (%s): runs at once may wait for each other", lock.name, error.strerror)
        yield


def _take(lock: IO[str]) -> None:
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        log.info("another run is compiling forms: waiting for it")
        fcntl.flock(lock, fcntl.LOCK_EX)


def _remove_unfinished() -> None:
    """Remove what a killed compilation left: a .c file (FFCx's lock) without .c.cached (its end mark), or it alone."""
    names = {name for name in os.listdir(cache_folder()) if name.startswith("libffcx_")}
    sources = {name for name in names if name.endswith(".c")}
    finished = {name.removesuffix(".cached") for name in names if name.endswith(".c.cached")}
    for name in sources ^ finished:
        log.info("removing a compilation that was cut off: %s", name)
        for path in (cache_folder() / name, cache_folder() / f"{name}.cached"):
            path.unlink(missing_ok=True)
