"""Values of functions and constants that are computed once for each state of what they depend on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

import dolfinx.fem
import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from ufl.corealg.traversal import traverse_unique_terminals

from remodel_fenicsx.fem.ranks import over_ranks

T = TypeVar("T")


class Remembered(Generic[T]):
    """The last value, as long as nothing has changed that it depends on.

    Parameters
    ----------
    comm
        Ranks that must agree on whether something has changed: collective, as what it spares may be. None where each
        rank has values of its own.
    expressions
        UFL: the value depends on their functions and constants, and on nothing else.
    """

    def __init__(self, comm: MPI.Intracomm | None, *expressions: Any):
        self._comm = comm
        terminals = {terminal for expression in expressions for terminal in traverse_unique_terminals(expression)}
        functions = [terminal for terminal in terminals if isinstance(terminal, dolfinx.fem.Function)]
        constants = [terminal for terminal in terminals if isinstance(terminal, dolfinx.fem.Constant)]
        # their own memory; what is small is asked first, for one difference is enough
        self._arrays: list[NDArray[np.float64]] = sorted((f.x.array for f in functions), key=lambda array: array.size)
        self._numbers = [np.asarray(c.value) for c in constants]
        self._seen: list[NDArray[np.float64]] = []
        self._seen_numbers: list[bytes] | None = None
        self._value: T

    def __call__(self, make: Callable[[], T]) -> T:
        """The value, of `make` where it is not known yet."""
        numbers = [number.tobytes() for number in self._numbers]
        known = numbers == self._seen_numbers and all(map(_same, self._arrays, self._seen))
        if self._comm is not None:
            known = bool(over_ranks(self._comm, known, MPI.LAND))
        if not known:
            self.forget()  # should `make` fail
            self._value = make()
            self._remember(numbers)
        return self._value

    def forget(self) -> None:
        """The next value is made anew."""
        self._seen_numbers = None

    def _remember(self, numbers: list[bytes]) -> None:
        if not self._seen:
            self._seen = [array.copy() for array in self._arrays]
        for array, seen in zip(self._arrays, self._seen, strict=True):
            if not _same(array, seen):
                seen[:] = array
        self._seen_numbers = numbers


def _same(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    return bool((one == other).all())
