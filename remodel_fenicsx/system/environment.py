"""What this run computes with: versions of the package and of the libraries that decide its numbers."""

from __future__ import annotations

import functools
import importlib.metadata
import importlib.util
import os
import platform
import re
import shutil
from pathlib import Path

from remodel_fenicsx._version import __version__
from remodel_fenicsx.errors import BAD_ENVIRONMENT, RemodelError
from remodel_fenicsx.system.extensions import extensions
from remodel_fenicsx.system.interrupts import take_back_signals

OLDEST_DOLFINX = (0, 9)
KERNELS = "REMODEL_FENICSX_KERNELS"  # what computes at points: C, or numpy for a debugger
NEEDED = ("basix", "dolfinx", "gmsh", "h5py", "mpi4py", "petsc4py", "pint", "rich", "ufl")


class UnusableEnvironment(RemodelError):  # noqa: N818
    """What a command needs is missing; the text says what."""

    exit_code = BAD_ENVIRONMENT

    def in_words(self) -> str:
        """With what to do."""
        return f"the environment is not usable: {self}; run through ./with-fenicsx"


def check_usable(reason: str | None) -> None:
    """Refuse to go on in an environment that is not usable for a reason, if there is one."""
    if reason is not None:
        raise UnusableEnvironment(reason)


def versions() -> dict[str, str]:
    """Names and versions of everything that the numbers depend on; of extensions their SHA-256."""
    import dolfinx
    import numpy
    from mpi4py import MPI
    from petsc4py import PETSc

    return {
        "remodel_fenicsx": __version__,
        "dolfinx": dolfinx.__version__,
        "ufl": importlib.metadata.version("fenics-ufl"),
        "PETSc": ".".join(map(str, PETSc.Sys.getVersion())),
        "gmsh": gmsh_version(),
        "numpy": numpy.__version__,
        "kernels": kernels(),
        "Python": platform.python_version(),
        "MPI": MPI.Get_library_version().split(",")[0].strip(),
        "BLAS": blas_library(),
        "system": platform.platform(),
    } | extensions()


def kernels() -> str:
    """What computes at the points: "C", or "numpy" where REMODEL_FENICSX_KERNELS says so."""
    name = os.environ.get(KERNELS, "C")
    if name not in ("C", "numpy"):
        raise RemodelError(f"{KERNELS} = {name!r}: allowed are 'C' and 'numpy'")
    return name


@functools.cache
def gmsh_version() -> str:
    """What `gmsh.__version__` is, read from its file: loading Gmsh takes 0.2 s, and many runs mesh nothing with it."""
    spec = importlib.util.find_spec("gmsh")
    head = Path(spec.origin).read_text(encoding="utf-8") if spec is not None and spec.origin else ""
    found = re.search(r'^GMSH_API_VERSION = "(.+)"$', head, re.MULTILINE)
    if found is not None:
        return found[1]
    import gmsh

    return str(gmsh.__version__)


def reason_unusable() -> str | None:
    """Why this environment cannot run a scene, or None: dolfinx missing or too old, PETSc with complex numbers."""
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        return f"{', '.join(missing)} is missing"
    if not any(shutil.which(name) for name in (os.environ.get("CC", "cc").split()[0], "gcc", "clang")):
        return "there is no C compiler"
    try:
        take_back_signals()
        import dolfinx
        import numpy
        from petsc4py import PETSc
    except ImportError as error:
        return str(error)
    major, minor = (int(part) for part in dolfinx.__version__.split(".")[:2])
    if (major, minor) < OLDEST_DOLFINX:
        oldest = ".".join(map(str, OLDEST_DOLFINX))
        return f"dolfinx {dolfinx.__version__} is too old, {oldest} is the oldest that works"
    if numpy.issubdtype(PETSc.ScalarType, numpy.complexfloating):
        return "PETSc is built with complex numbers, real ones are needed (Debian: python3-dolfinx-real)"
    return None


def reason_undrawable() -> str | None:
    """Why this environment cannot draw, or None."""
    missing = [name for name in ("matplotlib", "PIL") if importlib.util.find_spec(name) is None]
    return f"no {missing[0]}" if missing else None


def blas_library() -> str:
    """Path of the BLAS that this process has loaded (Debian's links resolved), or `unknown`."""
    try:
        maps = Path("/proc/self/maps").read_text().splitlines()
    except OSError:
        return "unknown"
    names = {line.split()[-1] for line in maps}
    found = sorted(name for name in names if re.match(r"lib(open)?blas", name.rsplit("/", 1)[-1]))
    return ", ".join(found) or "unknown"
