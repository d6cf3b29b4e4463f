"""A tube whose matrix is stretched further than its collagen: at a point, outwards, in turnover.

It shares no code with the package. Directions: around (0), along (1) and across the wall (2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from tests.reference.radial import RadialMaterial, cauchy_stress
from tests.reference.wall import State, Wall, solved

Array = np.ndarray
Prestretch = tuple[float, float]
Layer = tuple[float, float, RadialMaterial, Prestretch]  # between two radii


def beyond(prestretch: Prestretch) -> Array:
    """Stretches of elastin beyond those of collagen, which keep the volume."""
    around, along = prestretch
    return np.array([around, along, 1 / (around * along)])


def principal(stretches: Array, of: RadialMaterial, prestretch: Prestretch) -> Array:
    """Cauchy stresses of matrix and isotropic cells at stretches of the collagen, (3,) each."""
    squares = np.full((1, 3), of.end_to_end_length**2 / 3)
    plain = cauchy_stress(stretches[None], squares, of)[0]
    more = (beyond(prestretch) ** 2 - 1) * stretches**2
    return np.asarray(plain + of.lame_mu * more / np.prod(stretches))


def fresh(of: RadialMaterial, prestretch: Prestretch) -> Array:
    """Stretches at which the matrix and new collagen balance."""
    return np.exp(solved(lambda x: principal(np.exp(x), of, prestretch), np.zeros(3)))


def pulled(of: RadialMaterial, prestretch: Prestretch, nominal: Array) -> Array:
    """Stretches of a homogeneous body under nominal stresses along its axes, (3,) each."""
    g = fresh(of, prestretch)

    def left(x: Array) -> Array:
        return principal(np.exp(x) * g, of, prestretch) - nominal * np.exp(x - x.sum())

    return np.exp(solved(left, np.zeros(3)))


def outwards(layers: Sequence[Layer], inner: float, pressure: float, axial: float) -> Array:
    """Outer radius, radial stress left there, and axial force of a tube with this inner radius.

    It does not remodel; no stress is left if the radius is the one under the pressure.
    """
    values = np.array([inner, -pressure, 0.0])
    for low, high, of, prestretch in layers:
        g = fresh(of, prestretch)

        def slopes(R: float, now: Array) -> list[float]:
            def stresses(across: Array) -> Array:
                stretches = np.array([now[0] / R, axial, across[0]]) * g  # noqa: B023
                return principal(stretches, of, prestretch)  # noqa: B023

            thin = np.array([R / now[0] / axial])
            across = solved(lambda x: stresses(x)[2:] - now[1], thin)
            hoop, along, _ = stresses(across)
            steepness = float(across[0])
            force = 2 * np.pi * along * now[0] * steepness
            return [steepness, (hoop - now[1]) * steepness / now[0], force]

        values = solve_ivp(slopes, (low, high), values, rtol=1e-9, atol=1e-10).y[:, -1]
    return values


@dataclass
class ElasticWall(Wall):
    """A wall with a prestretch of elastin, and the driver `finger` with an exponent."""

    prestretch: Prestretch = (1.0, 1.0)
    exponent: float = 2.0

    def __post_init__(self) -> None:
        if self.opening_angle:
            raise ValueError("no reference for elastin with an opening angle")
        super().__post_init__()
        self.G = np.outer(fresh(self.material, self.prestretch), np.ones(self.points))

    def stresses(self, stretches: Array, state: State) -> Array:
        of, J = self.material, np.prod(stretches, axis=0)
        more = (beyond(self.prestretch)[:, None] * stretches) ** 2 - stretches**2
        return super().stresses(stretches, state) + of.lame_mu * more / J

    def _rates(self, state: State) -> State:
        A, stretches = state[0], self.stretches(self.r, self.length, state)
        drive = stretches ** (2 * self.exponent)
        target = self.material.end_to_end_length**2 * drive / drive.sum(axis=0)
        return (self.kappa * (target - A), *super()._rates(state)[1:])
