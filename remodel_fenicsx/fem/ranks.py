"""Sums, largest values and agreements over the ranks of a run; one rank asks nobody."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI


def over_ranks(comm: MPI.Intracomm, value: Any, operation: MPI.Op) -> Any:
    """The operation over the values of all ranks, on all ranks. Collective.

    A run of one rank makes some ten of these in a Newton iteration, and a small problem has no time for them.
    """
    return value if comm.size == 1 else comm.allreduce(value, operation)


def of_all_ranks(comm: MPI.Intracomm, value: Any) -> list[Any]:
    """The values of all ranks, on all ranks. Collective."""
    return [value] if comm.size == 1 else comm.allgather(value)
