"""Values of functions and constants that are computed once for each state of what they depend on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

T = TypeVar("T")


class Remembered(Generic[T]):
    """The last value, as long as nothing has changed that it depends on. Collective, as what it spares may be.

    Parameters
    ----------
    comm
        Ranks that must agree on whether something has changed.
    expressions
        UFL: the value depends on their functions and constants, and on nothing else.
    """

    def __init__(self, comm: MPI.Intracomm, *expressions: Any):
        from ufl.algorithms.analysis import extract_coefficients, extract_constants

        self._comm = comm
        self._functions = {f for expression in expressions for f in extract_coefficients(expression)}
        self._constants = {c for expression in expressions for c in extract_constants(expression)}
        self._seen: list[NDArray[np.float64]] | None = None
        self._value: T

    def __call__(self, make: Callable[[], T]) -> T:
        """The value, of `make` where it is not known yet."""
        now = self._state()
        known = self._seen is not None and all(map(np.array_equal, self._seen, now))
        if self._comm.size > 1:
            known = bool(self._comm.allreduce(known, MPI.LAND))
        if not known:
            self._seen = [array.copy() for array in now]
            self._value = make()
        return self._value

    def _state(self) -> Sequence[NDArray[np.float64]]:
        return [f.x.array for f in self._functions] + [np.asarray(c.value) for c in self._constants]
