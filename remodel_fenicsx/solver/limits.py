"""Admissible states: the limits r < L and J > 0 in the line search of Newton's method."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.fem.assembly import over_ranks
from remodel_fenicsx.solver.equilibrium import Equilibrium, Look

Array = NDArray[np.float64]

NEAR_LIMIT, RESERVE = 0.95, 0.3  # a Newton step that ends above this r/L keeps this share of 1 - r/L


class Limits:
    """How far from their limits r < L and J > 0 the states of one solve are; each is evaluated once.

    Parameters
    ----------
    equilibrium
        Whose states they are.
    bounded
        Whether a bound may stand for a look: |dF| <= G max |du|, |dr| <= |l| |dF|, and J > 0 while |dF| < 2 J / (F:F).
        It needs displacements for unknowns, and J at the quadrature points alone.
    """

    def __init__(self, equilibrium: Equilibrium, bounded: bool):
        self.equilibrium, state = equilibrium, equilibrium.state
        self._unknown: Array = state.unknown.x.array
        self.bounded = bounded and state.kinematics.three_dimensional and state.dilatation.jacobians().shape[1] == 0
        self._gain = equilibrium.quadrature.largest_gradient if self.bounded else np.inf
        self.forget()

    def forget(self) -> None:
        """Cells or loads may be others from now on."""
        self._place: Array | None = None
        self._chains: Array | None = None  # |l|/L at the points
        self._room, self._travelled = 0.0, np.inf

    def look(self) -> Look:
        """`Equilibrium.look` of the present unknowns."""
        if not self._is_here():
            self._place = self._unknown.copy()
            self._found = self.equilibrium.look()
            if self.bounded:
                self._room, self._travelled = self._room_around(self._found), 0.0
        return self._found

    def allow(self, before: Look, after: Look) -> bool:
        """Whether a step may end there: at an admissible state, with a reserve near L, and no J <= 0 on the way."""
        if not after.extension.admissible:
            return False
        near = after.extension.max_chain_extension > NEAR_LIMIT
        if near and not self.equilibrium.keeps_reserve(before.stretches, after.stretches, RESERVE, NEAR_LIMIT):
            return False
        return not self.equilibrium.turns_inside_out(before.states, after.states)

    def certainly_allow(self, largest_displacement: float) -> bool:
        """Whether a further step is admissible by the bound, without a look at its end; it then counts as made.

        Parameters
        ----------
        largest_displacement
            Bound of the change of a node's displacement, over all ranks.
        """
        further = self._travelled + self._gain * largest_displacement
        if not further < self._room:
            return False
        self._travelled = further
        return True

    def _is_here(self) -> bool:
        here = self._place is not None and bool((self._place == self._unknown).all())
        return bool(over_ranks(self.equilibrium.comm, here, MPI.LAND))

    def _room_around(self, look: Look) -> float:
        """Largest |dF| at which J > 0 and r/L < NEAR_LIMIT at every point of all ranks."""
        if not look.extension.admissible:
            return 0.0
        quadrature, cells = self.equilibrium.quadrature, self.equilibrium.state.cells
        if self._chains is None:
            length = np.sqrt(squares_of(cells.dimension_values)) / self.equilibrium.locking_length()
            self._chains = np.maximum(quadrature.owned(length), 1e-300).reshape(-1)
        room = cells.kernels.room(look.states, look.stretches.reshape(-1), self._chains, NEAR_LIMIT)
        return float(over_ranks(self.equilibrium.comm, room, MPI.MIN))


def reserved(before: float, after: float) -> bool:
    """Whether of two largest r/L the later one is no nearer to 1 than a Newton step would come."""
    return not after > NEAR_LIMIT or 1 - after >= RESERVE * (1 - before)


def squares_of(vectors: Array) -> Array:
    """Squared length of vectors (..., 3)."""
    squares: Array = vectors[..., 0] ** 2 + vectors[..., 1] ** 2 + vectors[..., 2] ** 2
    return squares
