"""The consistent evolution law: one symmetric tensor A per point, without ranks and without axes (docs/theory.md).

    dA/dt = kappa s (r0^2 E - A),    E = N / tr N,  N = (D+)^2

D is the driving tensor in material space, D+ its positive part, s a switch that is one under tension and vanishes with
it. For the driver `finger` D is C. E has trace one, so tr A stays r0^2. Pure functions on arrays (n, 3, 3).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

COMPRESSION = 0.1
"""How large a tension beside a compression must be to remodel: the switch is one half where n+ = COMPRESSION^2 n-."""

ABOVE_NOISE = 7000.0
"""Where the switch sets in, over the size up to which a principal value may be an error (1e-10 of the stiffness): wide
enough that Newton's method sees a smooth function."""


class Target(NamedTuple):
    """What A tends to, and how much of it.

    Attributes
    ----------
    direction
        E, (n, 3, 3), trace one (zero where nothing is positive).
    share
        s, (n,), between 0 and 1.
    """

    direction: Array
    share: Array


def target(tensor: Array, noise: Array | float) -> Target:
    """E and s of driving tensors in material space.

    Parameters
    ----------
    tensor
        D, symmetric, (n, 3, 3), any unit.
    noise
        Size up to which a principal value may be an error, in the same unit; (n,) or a number.
    """
    values, vectors = np.linalg.eigh(tensor)
    largest = np.abs(values).max(axis=1)
    unit = np.where(largest > 0, largest, 1.0)
    values = values / unit[:, None]  # squares must neither overflow nor underflow
    positive = np.maximum(values, 0.0) ** 2
    tension, compression = positive.sum(axis=1), (np.minimum(values, 0.0) ** 2).sum(axis=1)
    weights = positive / np.where(tension > 0, tension, 1.0)[:, None]
    direction = (vectors * weights[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    floor = (ABOVE_NOISE * np.asarray(noise) / unit) ** 2
    total = tension + COMPRESSION**2 * compression + floor
    return Target(direction, tension / np.where(total > 0, total, 1.0))


def follow(structure: Array, towards: Target, end_to_end_length: Array | float, rate: float) -> Array:
    """A after a time in which the target does not change: exact.

    Parameters
    ----------
    structure
        A, (n, 3, 3), in squared link lengths.
    towards
        E and s.
    end_to_end_length
        r0, (n,) or a number.
    rate
        kappa times the time.
    """
    squared = np.reshape(np.asarray(end_to_end_length, dtype=np.float64) ** 2, (-1, 1, 1))
    weight = -np.expm1(-rate * towards.share)[:, None, None]
    change: Array = weight * (squared * towards.direction - structure)
    return structure + change
