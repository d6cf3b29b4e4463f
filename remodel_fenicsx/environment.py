"""What this run computes with: versions of the package and of the libraries that decide its numbers."""

from __future__ import annotations

import importlib.metadata
import platform
import re
from pathlib import Path

import remodel_fenicsx


def versions() -> dict[str, str]:
    """Names and versions of everything that the numbers depend on."""
    import dolfinx
    import gmsh
    import numpy
    from mpi4py import MPI
    from petsc4py import PETSc

    return {
        "remodel_fenicsx": remodel_fenicsx.__version__,
        "dolfinx": dolfinx.__version__,
        "ufl": importlib.metadata.version("fenics-ufl"),
        "PETSc": ".".join(map(str, PETSc.Sys.getVersion())),
        "gmsh": gmsh.__version__,
        "numpy": numpy.__version__,
        "Python": platform.python_version(),
        "MPI": MPI.Get_library_version().split(",")[0].strip(),
        "BLAS": blas_library(),
        "system": platform.platform(),
    }


def blas_library() -> str:
    """Path of the BLAS that this process has loaded (Debian's links resolved), or `unknown`."""
    try:
        maps = Path("/proc/self/maps").read_text().splitlines()
    except OSError:
        return "unknown"
    names = {line.split()[-1] for line in maps}
    found = sorted(name for name in names if re.match(r"lib(open)?blas", name.rsplit("/", 1)[-1]))
    return ", ".join(found) or "unknown"
