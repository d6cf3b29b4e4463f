"""How forms and expressions are compiled: one place for compiler flags, the cache and its one known trap."""

from __future__ import annotations

import hashlib
import logging
import os
import platform
import time as clock
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import dolfinx.fem
from mpi4py import MPI

T = TypeVar("T")
log = logging.getLogger(__name__)

TIMEOUT = 60  # seconds that a run waits for another one to compile the same form

# Faster than -O2 by a third for this energy, and NaN and infinity keep their meaning: the guards rely on them.
COMPILER_FLAGS = [
    "-O2", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros", "-freciprocal-math",
    "-fassociative-math", "-w",
]  # fmt: skip


def cache_folder() -> Path:
    """Folder of compiled kernels: per processor type, because -march=native code must not meet another processor."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = next((line for line in lines if line.startswith("flags")), "")
    except OSError:
        processor = platform.processor()
    key = hashlib.sha256((platform.machine() + processor).encode()).hexdigest()[:8]
    return base / "fenics" / f"remodel-{key}"


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
    return _compiled(lambda: dolfinx.fem.form(ufl_form, jit_options=jit_options()))


def expression(ufl_expression: Any, points: Any) -> Any:
    """Compile a UFL expression for evaluation at reference points of shape (n, 3)."""
    return _compiled(lambda: dolfinx.fem.Expression(ufl_expression, points, jit_options=jit_options()))


def _compiled(compile_it: Callable[[], T]) -> T:
    try:
        return compile_it()
    except (TimeoutError, RuntimeError):  # on several ranks dolfinx turns rank 0's TimeoutError into another one
        removed = _remove_unfinished() if MPI.COMM_WORLD.rank == 0 else 0
        if not MPI.COMM_WORLD.bcast(removed):
            raise
        return compile_it()


def _remove_unfinished() -> int:
    """Remove what a killed compilation left: a .c file (FFCx's lock) that no .c.cached (its end mark) follows."""
    removed = 0
    for source in cache_folder().glob("libffcx_*.c"):
        finished = source.with_suffix(".c.cached").exists()
        if not finished and clock.time() - source.stat().st_mtime > TIMEOUT:
            log.warning("removing a compilation that was cut off: %s", source.name)
            source.unlink(missing_ok=True)
            removed += 1
    return removed
