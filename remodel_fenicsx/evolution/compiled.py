"""The compiled twins of what a pass does at every point; where they leave a point open, numpy and LAPACK decide it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import ArrayLike, NDArray

from remodel_fenicsx.fem import jit
from remodel_fenicsx.tissue import point_kernels, spectral
from remodel_fenicsx.tissue.cells import UnitCell

Array = NDArray[np.float64]

NOT_FINITE = 2  # mark of a point with NaN or infinity


class PointKernels:
    """Compiled functions on arrays of n points, each with arguments and values of the one that it is a twin of.

    Parameters
    ----------
    comm
        Its ranks compile, or load, together.

    Attributes
    ----------
    twins
        Functions of `spectral` and their compiled twins, for `laws.Drive`.
    """

    def __init__(self, comm: MPI.Intracomm):
        module = jit.library(comm, point_kernels.DECLARATIONS, point_kernels.SOURCE, "the pass")
        self._call, self._ffi = module.lib, module.ffi
        self.twins: Mapping[Callable[..., Any], Callable[..., Any]] = {
            spectral.principal: self.principal, spectral.positive_direction: self.positive_direction
        }  # fmt: skip

    def principal(
        self, tensors: ArrayLike, previous: ArrayLike, tolerance: float = 1e-8, threshold: ArrayLike = 0.0
    ) -> tuple[Array, Array]:
        """`spectral.principal`: by Jacobi's method where the tensor decides."""
        tensors, previous = np.ascontiguousarray(tensors, np.float64), np.ascontiguousarray(previous, np.float64)
        n = len(tensors)
        limit = np.ascontiguousarray(threshold, np.float64).reshape(-1)
        values, axes, open_points = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n, np.uint8)
        count = self._call.principal(
            n, self._in(tensors), self._in(previous), tolerance, self._in(limit), len(limit) > 1, spectral.DECISIVE,
            self._out(values), self._out(axes), self._ffi.from_buffer("uint8_t[]", open_points, require_writable=True),
        )  # fmt: skip
        if count:
            at = np.flatnonzero(open_points)
            if np.any(open_points == NOT_FINITE):  # for the words that name the first one
                return spectral.principal(tensors, previous, tolerance, threshold)
            values[at], axes[at] = spectral.principal(
                tensors[at], previous[at], tolerance, limit[at] if len(limit) > 1 else limit
            )
        return values, axes

    def positive_direction(self, values: ArrayLike, threshold: ArrayLike = 0.0) -> tuple[Array, NDArray[np.bool_]]:
        """`spectral.positive_direction`."""
        values = np.ascontiguousarray(values, np.float64)
        limit = np.ascontiguousarray(threshold, np.float64).reshape(-1)
        direction, active = np.empty(values.shape), np.empty(len(values), np.bool_)
        not_finite = self._call.positive_direction(
            len(values), self._in(values), self._in(limit), len(limit) > 1, spectral.ROUNDING, self._out(direction),
            self._ffi.from_buffer("uint8_t[]", active, require_writable=True),
        )  # fmt: skip
        if not_finite:  # for the words that name the first one
            return spectral.positive_direction(values, threshold)
        return direction, active

    def without_noise(self, tensors: Array, axes: Array, noise: ArrayLike) -> Array:
        """`spectral.without_noise`."""
        tensors, axes = np.ascontiguousarray(tensors), np.ascontiguousarray(axes)
        limit, steady = np.ascontiguousarray(noise, np.float64).reshape(-1), np.empty(tensors.shape)
        self._call.without_noise(
            len(tensors), self._in(tensors), self._in(axes), self._in(limit), len(limit) > 1, self._out(steady)
        )
        return steady

    def squared_length(self, F: Array, cell: UnitCell) -> Array:
        """`repulsion.squared_end_to_end_length` of one whole cell."""
        return self._stretches(F, cell, None)

    def squared_length_and_sum(self, F: Array, cell: UnitCell) -> tuple[Array, Array]:
        """The same, and `repulsion.axes_sum`."""
        logarithms = np.empty(len(F))
        return self._stretches(F, cell, logarithms), logarithms

    def _stretches(self, F: Array, cell: UnitCell, logarithms: Array | None) -> Array:
        squared = np.empty(len(F))
        self._call.stretches(
            len(F), self._in(F), self._in(cell.dimensions), self._in(cell.axes), self._out(squared),
            self._ffi.NULL if logarithms is None else self._out(logarithms),
        )  # fmt: skip
        return squared

    def gradient_and_driver(self, both: Array) -> tuple[Array, Array]:
        """F and the symmetric part of the driving tensor, (n, 3, 3) each, from both (n, 2, 3, 3)."""
        F, driver = np.empty((len(both), 3, 3)), np.empty((len(both), 3, 3))
        self._call.parts(len(both), self._in(both), self._out(F), self._out(driver))
        return F, driver

    def structure_tensor(self, dimensions: Array, axes: Array) -> Array:
        """`cells.structure_tensor` (n, 3, 3)."""
        tensor = np.empty(axes.shape)
        self._call.structure(axes.size // 9, self._in(dimensions), self._in(axes), self._out(tensor))
        return tensor

    def extension(self, states: Array, length: Array) -> tuple[Array, int, float]:
        """How far points are from their limits: r/L (n,), the number of the largest, and the smallest J.

        Parameters
        ----------
        states
            r^2, J and F of n points (n, 11), as `Equilibrium.states` has them.
        length
            L (n,).

        Returns
        -------
        r/L is infinite where it is no finite number; J is minus infinity if one is none, and infinity without points.
        """
        stretch, smallest = np.empty(len(length)), np.empty(1)
        worst = self._call.extension(
            len(length), self._in(states), self._in(length), self._out(stretch), self._out(smallest)
        )
        return stretch, worst, smallest.item()

    def may_turn(self, before: Array, after: Array) -> NDArray[np.intp]:
        """Which points `operators.passes_through_zero` has to be asked for, by number; states (n, 11) of both ends."""
        found = np.empty(len(before), np.uint8)
        out = self._ffi.from_buffer("uint8_t[]", found, require_writable=True)
        count = self._call.may_turn(len(before), self._in(before), self._in(after), out)
        return np.flatnonzero(found) if count else np.empty(0, np.intp)

    def room(self, states: Array, stretch: Array, chain: Array, far: float) -> float:
        """Largest |dF| at which J > 0 and r/L < far at all points; chain: |l|/L (n,)."""
        return float(self._call.room(len(stretch), self._in(states), self._in(stretch), self._in(chain), far))

    def _in(self, values: Array) -> Any:
        return self._ffi.from_buffer("double[]", np.ascontiguousarray(values, np.float64))

    def _out(self, values: Array) -> Any:
        return self._ffi.from_buffer("double[]", values, require_writable=True)
