"""Consistent evolution law of one symmetric tensor A per point, without ranks and axes.

    dA/dt = kappa s (r0^2 E - A),    E = N / tr N,  N = (D+)^n,  n = 2

D is the driving tensor in material space, D+ its positive part, s a switch that is one under
tension and zero without tension. For the driver `finger` D is C. E has trace one, so tr A stays
r0^2. Pure functions on arrays (n, 3, 3).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from remodel_fenicsx.model.tensors import Array, Flags

COMPRESSION = 0.01
"""Weight of the squared compression against the squared tension. The switch is one half if
n+ = COMPRESSION n-, a tension of a tenth of the compression."""

MIN_TENSION_OVER_ROUNDING = 7000.0
"""Threshold of the switch over the rounding of a principal value (1e-10 of the stiffness), wide
enough that the switch is smooth for Newton's method."""


def switch_threshold(noise: Array | float, rounding: Array | float) -> Array | float:
    """Return the tension at which the switch is one half without compression."""
    # The noise from the solver's residual is not multiplied like the rounding: the product would be
    # as large as a stress.
    return MIN_TENSION_OVER_ROUNDING * rounding + noise


class Target(NamedTuple):
    """Target E of A, (n, 3, 3), and switch s, the active fraction of kappa, (n,)."""

    direction: Array
    switch: Array

    def towards(self, other: Target, weight: Array | float) -> Target:
        """Return the target with sE + weight (s'E' - sE); weights outside [0, 1] extrapolate."""
        # The rate of A is kappa (r0^2 sE - sA). Therefore sE is interpolated; its trace is s, so
        # that E keeps trace one and a target with s = 0 has no influence. The result s is clipped
        # to [0, 1].
        scaled = (
            self.switch[:, None, None] * self.direction,
            other.switch[:, None, None] * other.direction,
        )
        changed = scaled[0] + np.reshape(weight, (-1, 1, 1)) * (scaled[1] - scaled[0])
        switch = np.einsum("nii->n", changed)
        active = switch > 0.0
        direction = changed / np.where(active, switch, 1.0)[:, None, None]
        return Target(direction, np.where(active, np.minimum(switch, 1.0), 0.0))

    def where(self, chosen: Flags, other: Target) -> Target:
        """Return the target, replaced by `other` at the chosen points."""
        return Target(
            np.where(chosen[:, None, None], other.direction, self.direction),
            np.where(chosen, other.switch, self.switch),
        )


def target(tensor: Array, floor: Array | float, exponent: float = 2.0) -> Target:
    """Return E and s of driving tensors in material space, (n, 3, 3)."""
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


def activation(tensor: Array, least_tension: float) -> Array:
    """Return the active fraction of kappa, max(0, 1 - s0/s) for the largest tension s; (n,)."""
    # This is a lazy zone, as in models of bone adaptation; Hypothesis I of the paper reads "within
    # a range".
    return 1 - least_tension / np.maximum(np.linalg.eigvalsh(tensor)[:, -1], least_tension)


def weight_of_the_end(kappa_dt: Array | float) -> Array:
    """Return the end target's weight in the effective target of a step with linear change; (n,)."""
    # A(h) = (1 - w) A(0) + w (E_0 + weight (E_1 - E_0)), w = 1 - exp(-z), weight = 1/w - 1/z,
    # z = kappa h. Past targets decay: the weight is one half for small steps and one for large
    # steps.
    z = np.asarray(kappa_dt, dtype=np.float64)
    short = z < 1e-3
    long = np.where(short, 1.0, z)
    return np.where(short, 0.5 + z / 12, -1.0 / np.expm1(-long) - 1.0 / long)


def relax_exactly(
    structure: Array, towards: Target, end_to_end_length: Array | float, kappa_dt: Array | float
) -> Array:
    """Return A after a time with a constant target; exact."""
    squared = np.reshape(np.asarray(end_to_end_length, dtype=np.float64) ** 2, (-1, 1, 1))
    weight = -np.expm1(-kappa_dt * towards.switch)[:, None, None]
    change = weight * (squared * towards.direction - structure)
    return structure + change
