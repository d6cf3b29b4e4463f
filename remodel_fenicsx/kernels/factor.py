"""Factors in single precision (factor.c), where CHOLMOD can make them: SuiteSparse 7 and later, with its header."""

from __future__ import annotations

import functools
import logging
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.kernels.library import Library, in_numpy

log = logging.getLogger(__name__)
Array = NDArray[np.float64]
HEADER = "suitesparse/cholmod.h"
FIRST = 5  # CHOLMOD's version that has single precision


@functools.cache
def include_folder() -> Path | None:
    """Where CHOLMOD's header is; None, and a line in the log, where no version with single precision is."""
    for folder in (Path(sys.prefix) / "include", Path("/usr/include"), Path("/usr/local/include")):
        path = folder / HEADER
        if path.is_file():
            version = re.search(r"define CHOLMOD_MAIN_VERSION\s+(\d+)", path.read_text(encoding="utf-8"))
            if version and int(version[1]) >= FIRST:
                return folder
    log.info("kept factors have double precision, for twice the time: no header of CHOLMOD %d or later is here", FIRST)
    return None


def is_available() -> bool:
    """Whether such factors can be made here."""
    return include_folder() is not None and not in_numpy()


class SingleFactor:
    """A factor L L^T of sparse symmetric matrices of one pattern, with seven digits."""

    def __init__(self, starts: NDArray[np.int32], columns: NDArray[np.int32]):
        self._call = Library(
            MPI.COMM_SELF, "factor.c", "factors in single precision", include=include_folder(), libraries=("cholmod",)
        )
        self._handle: Any = self._call("factor_new", len(starts) - 1, starts, columns)
        if not self._handle:
            raise MemoryError("no memory for a factor in single precision")

    def renew(self, values: Array) -> bool:
        """Factorise the matrix with these values (entries,); whether it is positive definite to single precision."""
        return bool(self._call("factor_renew", self._handle, values))

    def solve(self, right: Array, answer: Array) -> bool:
        """Write the answer (n,) to a right-hand side (n,); whether both are finite."""
        return bool(self._call("factor_solve", self._handle, right, answer))

    def close(self) -> None:
        """Free its memory."""
        if self._handle:
            self._call("factor_free", self._handle)
        self._handle = None
