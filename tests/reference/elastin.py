"""A tube whose matrix is stretched further than its collagen: at a point, by shooting, and as it turns over.

It shares no code with the package. Directions: around (0), along (1) and across the wall (2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from tests.reference.radial import RadialMaterial
from tests.reference.wall import State, Wall, solved

Array = np.ndarray
Prestretch = tuple[float, float]


def beyond(prestretch: Prestretch) -> Array:
    """Stretches of elastin beyond those of collagen, which keep the volume."""
    around, along = prestretch
    return np.array([around, along, 1 / (around * along)])


def stiffness(r: Array, contour_length: float) -> Array:
    """g(r), of a wormlike chain."""
    x = r / contour_length
    return (1 + (2 - x) / (4 * (1 - x) ** 2)) / contour_length


def principal(l: Array, A: Array, of: RadialMaterial, prestretch: Prestretch) -> Array:  # noqa: E741
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


def shot(
    layers: Sequence[tuple[float, float, RadialMaterial, Prestretch]], pressure: float, axial: float
) -> tuple[float, float, float]:
    """Inner and outer radius and axial force of a tube that does not remodel, by shooting outwards.

    Layers are (inner radius, outer radius, tissue, prestretch).
    """
    starts = [fresh(of, prestretch) for _, _, of, prestretch in layers]

    def outwards(inner: float) -> Array:
        values = np.array([inner, -pressure, 0.0])
        for (low, high, of, prestretch), g in zip(layers, starts, strict=True):
            A = isotropic_cells(of)

            def slopes(R: float, now: Array) -> list[float]:
                def stresses(across: float) -> tuple[Array, float]:
                    l = np.array([now[0] / R, axial, across]) * g  # noqa: B023, E741
                    return principal(l, A, of, prestretch), across  # noqa: B023

                stretched = np.array([now[0] / R, axial]) * g[:2]
                room = of.contour_length**2 - A[:2] @ stretched**2  # noqa: B023
                if room <= 0:  # the chains lock
                    raise ArithmeticError
                most = 0.9999 * np.sqrt(room / A[2]) / g[2]  # noqa: B023
                stress, across = stresses(
                    brentq(lambda x: stresses(x)[0][2] - now[1], 0.05, most, xtol=1e-13)
                )
                force = 2 * np.pi * stress[1] * now[0] * across
                return [across, (stress[0] - now[1]) * across / now[0], force]

            way = solve_ivp(slopes, (low, high), values, rtol=1e-9, atol=1e-10)
            values = way.y[:, -1]
        return values

    def left(inner: float) -> float:
        try:
            return float(outwards(inner)[1])
        except ArithmeticError:
            return 1e3

    inner = layers[0][0]
    inner = brentq(left, inner, 3 * inner, xtol=1e-9)
    outer, _, force = outwards(inner)
    return inner, float(outer), float(force)


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

    def unloaded(self) -> tuple[float, float, float]:
        """Inner and outer radius and length over that of the mesh, without loads."""

        def residual(values: Array) -> Array:
            r, axial = values[:-1], values[-1]
            stress = self.stresses(self.stretches(r, axial, self.state), self.state)
            stress = stress / self.growth(self.state)
            force = self.weights @ (stress[1] * r * (self.slope @ r))
            return np.append(self._balance(stress, r, 0.0), force)

        values, first = np.append(self.r, self.length), residual(np.append(self.r, self.length))
        for share in np.linspace(1.0, 0.0, 11)[1:]:
            values = solved(lambda v: residual(v) - share * first, values)  # noqa: B023
        return float(values[0]), float(values[-2]), float(values[-1])
