"""A tube whose matrix is stretched further than its collagen: at a point, integrated outwards, and as it turns over.

It shares no code with the package. Directions: around (0), along (1) and across the wall (2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from tests.reference.radial import RadialMaterial
from tests.reference.wall import State, Wall, solved

Array = np.ndarray
Prestretch = tuple[float, float]
Layer = tuple[float, float, RadialMaterial, Prestretch]  # between two radii


def beyond(prestretch: Prestretch) -> Array:
    """Stretches of elastin beyond those of collagen, which keep the volume."""
    around, along = prestretch
    return np.array([around, along, 1 / (around * along)])


def stiffness(r: Array, contour_length: float) -> Array:
    """g(r), of a wormlike chain."""
    x = r / contour_length
    return (1 + (2 - x) / (4 * (1 - x) ** 2)) / contour_length


def principal(
    l: Array, A: Array, of: RadialMaterial, prestretch: Prestretch
) -> Array:  # noqa: E741
    """Cauchy stresses of matrix and chains at stretches l of the collagen, (3,) each."""
    J, start = np.prod(l), of.end_to_end_length
    matrix = of.lame_mu * ((beyond(prestretch) * l) ** 2 - 1) + of.lame_lambda * np.log(J)
    g, g0 = (stiffness(r, of.contour_length) for r in (np.sqrt(A @ l**2), start))
    return np.asarray((matrix + of.network_modulus * A * (g * l**2 - g0)) / J)


def isotropic_cells(of: RadialMaterial) -> Array:
    """A of cells without directions."""
    return np.full(3, of.end_to_end_length**2 / 3)


def fresh(of: RadialMaterial, prestretch: Prestretch) -> Array:
    """Stretches at which the matrix and new collagen balance."""
    A = isotropic_cells(of)
    return np.exp(solved(lambda x: principal(np.exp(x), A, of, prestretch), np.zeros(3)))


def outwards(layers: Sequence[Layer], inner: float, pressure: float, axial: float) -> Array:
    """Outer radius, radial stress left there, and axial force of a tube with this inner radius.

    It does not remodel; no stress is left if the radius is the one under the pressure.
    """
    values = np.array([inner, -pressure, 0.0])
    for low, high, of, prestretch in layers:
        A, g = isotropic_cells(of), fresh(of, prestretch)

        def slopes(R: float, now: Array) -> list[float]:
            def stresses(across: Array) -> Array:
                l = np.array([now[0] / R, axial, across[0]]) * g  # noqa: B023, E741
                return principal(l, A, of, prestretch)  # noqa: B023

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
