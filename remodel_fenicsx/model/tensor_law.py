"""The consistent evolution law: one symmetric tensor A per point, without ranks and without axes (docs/theory.md, Law).

    dA/dt = kappa s (r0^2 E - A),    E = N / tr N,  N = (D+)^n,  n = 2

D is the driving tensor in material space, D+ its positive part, s a switch that is one under tension and vanishes with
it. For the driver `finger` D is C. E has trace one, so tr A stays r0^2. Pure functions on arrays (n, 3, 3).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

COMPRESSION = 0.01
"""Share of the squared compression that counts against the tension: the switch is one half where n+ = COMPRESSION n-,
a tension of a tenth of the compression."""

ABOVE_ROUNDING = 7000.0
"""Where the switch sets in, over the rounding of a principal value (1e-10 of the stiffness): wide enough that Newton's
method sees a smooth function."""


def floor_above(noise: Array | float, rounding: Array | float) -> Array | float:
    """Tension at which the switch is one half, where there is no compression."""
    # What the solver's tolerance leaves out of balance counts as it is: multiplied like the rounding, it would be
    # stress.
    return ABOVE_ROUNDING * rounding + noise


class Target(NamedTuple):
    """What A tends to, E, and how much of kappa acts, s."""

    direction: Array
    switch: Array

    def towards(self, other: Target, weight: Array | float) -> Target:
        """sE + weight (s'E' - sE), of another target s'E'; weights below 0 or above 1 extrapolate."""
        # What acts on A is kappa (r0^2 sE - sA): it is sE that changes linearly, and s is its trace. So a target that
        # does not count takes no part, and E has trace one. An s below 0 is 0, one above 1 is 1.
        ends = (self.switch[:, None, None] * self.direction, other.switch[:, None, None] * other.direction)
        changed = ends[0] + np.reshape(weight, (-1, 1, 1)) * (ends[1] - ends[0])
        switch = np.einsum("nii->n", changed)
        some = switch > 0.0
        direction = changed / np.where(some, switch, 1.0)[:, None, None]
        return Target(direction, np.where(some, np.minimum(switch, 1.0), 0.0))

    def where(self, chosen: NDArray[np.bool_], other: Target) -> Target:
        """Itself, and at the chosen points another target."""
        return Target(
            np.where(chosen[:, None, None], other.direction, self.direction),
            np.where(chosen, other.switch, self.switch),
        )


def target(tensor: Array, floor: Array | float, exponent: float = 2.0) -> Target:
    """E and s of driving tensors in material space."""
    values, vectors = np.linalg.eigh(tensor)
    largest = np.abs(values).max(axis=1)
    unit = np.where(largest > 0, largest, 1.0)
    values = values / unit[:, None]  # squares must neither overflow nor underflow
    positive = np.maximum(values, 0.0) ** 2
    tension, compression = positive.sum(axis=1), (np.minimum(values, 0.0) ** 2).sum(axis=1)
    weights = positive / np.where(tension > 0, tension, 1.0)[:, None]
    if exponent != 2.0:
        top = np.where(tension > 0, weights.max(axis=1), 1.0)[:, None]
        powers = (weights / top) ** (exponent / 2)
        weights = powers / np.where(tension > 0, powers.sum(axis=1), 1.0)[:, None]
    direction = (vectors * weights[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    total = tension + COMPRESSION * compression + (np.asarray(floor) / unit) ** 2
    return Target(direction, tension / np.where(total > 0, total, 1.0))


def awake(tensor: Array, least_tension: float) -> Array:
    """Share of kappa that acts: max(0, 1 - s0/s) with the largest principal value s; (n,)."""
    # A lazy zone, as in models of the adaptation of bone; Hypothesis I of the paper says "within a range".
    return 1 - least_tension / np.maximum(np.linalg.eigvalsh(tensor)[:, -1], least_tension)


def weight_of_the_end(kappa_dt: Array | float) -> Array:
    """Weight of the target at the end of a step in the one that acts, if targets change linearly over it; (n,)."""
    # A forgets: A(h) = (1 - w) A(0) + w (E_0 + weight (E_1 - E_0)), w = 1 - exp(-z), weight = 1/w - 1/z, z = kappa h:
    # one half for short steps, one for long ones.
    z = np.asarray(kappa_dt, dtype=np.float64)
    short = z < 1e-3
    long = np.where(short, 1.0, z)
    return np.where(short, 0.5 + z / 12, -1.0 / np.expm1(-long) - 1.0 / long)


def follow(structure: Array, towards: Target, end_to_end_length: Array | float, kappa_dt: Array | float) -> Array:
    """A after a time in which the target does not change: exact."""
    squared = np.reshape(np.asarray(end_to_end_length, dtype=np.float64) ** 2, (-1, 1, 1))
    weight = -np.expm1(-kappa_dt * towards.switch)[:, None, None]
    change: Array = weight * (squared * towards.direction - structure)
    return structure + change
