"""Evolution laws of the cell dimensions: pure functions on arrays, one for each way to integrate the paper's eq. (10).

Every law has the signature ``law(l, l0, target, kappa, time_old, time_new) -> l_new`` with

- ``l``: cell dimensions at time_old, shape (n, 3), in link lengths, by rank (column 0: largest eigenvalue),
- ``l0``: cell dimensions at t = 0, shape (n, 3),
- ``target``: r0 e, the dimensions that the driver asks for, shape (n, 3), e = lambda^+ / |lambda^+|,
- ``kappa``: relaxation parameter, in 1/time.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Law = Callable[[Array, Array, Array, float, float, float], Array]


def explicit(l: Array, l0: Array, target: Array, kappa: float, time_old: float, time_new: float) -> Array:
    """Eq. (11): l = l0 + (r0 e - l0)(1 - exp(-kappa t)), a function of the absolute time and the present target."""
    return l0 - (target - l0) * np.expm1(-kappa * time_new)


def rate(l: Array, l0: Array, target: Array, kappa: float, time_old: float, time_new: float) -> Array:
    """Eq. (10): dl/dt = kappa (r0 e - l0) exp(-kappa t), integrated exactly over the step with e frozen."""
    return l - (target - l0) * np.exp(-kappa * time_old) * np.expm1(-kappa * (time_new - time_old))


def relaxation(l: Array, l0: Array, target: Array, kappa: float, time_old: float, time_new: float) -> Array:
    """Autonomous form dl/dt = kappa (r0 e - l), integrated exactly over the step with e frozen."""
    return l - (target - l) * np.expm1(-kappa * (time_new - time_old))


def none(l: Array, l0: Array, target: Array, kappa: float, time_old: float, time_new: float) -> Array:
    """No change of the cell dimensions (the axes do not turn either: `remodel` skips the pass)."""
    return l


LAWS: dict[str, Law] = {"explicit": explicit, "rate": rate, "relaxation": relaxation, "none": none}
