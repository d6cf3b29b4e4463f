"""A tube on one radius with residual stress, turnover and growth: Chebyshev collocation and Runge-Kutta's fourth order.

It shares no code with the package: equations of docs/model.md (law `tensor`, repulsion `log`) and
turnover.md, for cells that lie along the axes around (0), along (1) and across the wall (2).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial import chebyshev

from tests.reference.radial import RadialMaterial

Array = np.ndarray
State = tuple[Array, Array, Array]  # A (3, n), m and rho


def solved(residual: Callable[[Array], Array], values: Array) -> Array:
    """Newton's method with a derivative by complex steps, halved where it leaves what has an energy."""
    for _ in range(60):
        error = residual(values)
        if np.abs(error).max() < 1e-9:
            return values
        ways = values + 1e-30j * np.eye(len(values))
        step = np.linalg.solve(np.array([residual(way).imag / 1e-30 for way in ways]).T, error)
        for share in 0.5 ** np.arange(11):
            with np.errstate(all="ignore"):
                size = np.linalg.norm(residual(values - share * step))
            if size < 2 * np.linalg.norm(error) + 1e-8:
                break
        values = values - share * step
    raise ArithmeticError(f"out of balance by {np.abs(error).max():.2g}")


@dataclass
class Wall:
    """Between two radii, free of stress at the start, or closed from a sector; per unit of length."""

    material: RadialMaterial = field(default_factory=RadialMaterial)
    radii: tuple[float, float] = (1.0, 1.3)
    opening_angle: float = 0.0
    kappa: float = 0.025
    time: float = np.inf
    deposition_stretch: float = 1.1
    gain: float = 1.0
    volume: float = 0.0
    points: int = 12

    def __post_init__(self) -> None:
        n, (inner, outer) = self.points, self.radii
        x, one = -np.cos(np.pi * np.arange(n) / (n - 1)), np.eye(n)
        inverse = np.linalg.inv(chebyshev.chebvander(x, n - 1))
        slopes = np.array([chebyshev.chebval(x, chebyshev.chebder(row)) for row in one]).T
        areas = np.array([0.0 if k % 2 else 2.0 / (1 - k * k) for k in range(n)])
        half = (outer - inner) / 2
        self.R: Array = (inner + outer) / 2 + half * x
        self.slope, self.weights = slopes @ inverse / half, half * areas @ inverse
        self.G = np.ones((3, n))
        self.state: State = (
            np.full((3, n), self.material.end_to_end_length**2 / 3),
            np.ones(n),
            np.ones(n),
        )
        self.r, self.length = self.R.copy(), 1.0
        if self.opening_angle:
            self._close()

    def chain(self, r: Array | float) -> Array:
        """g(r), of a wormlike chain."""
        x = np.asarray(r) / self.material.contour_length
        return (1 + (2 - x) / (4 * (1 - x) ** 2)) / self.material.contour_length

    def stresses(self, stretches: Array, state: State) -> Array:
        """Principal Cauchy stresses of the tissue at stretches of F_e, (3, n), per volume that has not grown."""
        A, m, rho = state
        of, J = self.material, stretches[0] * stretches[1] * stretches[2]
        r = np.sqrt((A * stretches**2).sum(axis=0)) / rho
        network = (
            m
            * of.network_modulus
            * A
            * (self.chain(r) / rho**2 * stretches**2 - self.chain(of.end_to_end_length))
        )
        return (of.lame_lambda * np.log(J) - of.lame_mu + of.lame_mu * stretches**2 + network) / J

    def growth(self, state: State) -> Array:
        """J_g."""
        return 1 + self.volume * (state[1] - 1)

    def stretches(self, r: Array, length: float | Array, state: State) -> Array:
        """Of F_e."""
        return np.array([r / self.R, length + 0 * r, self.slope @ r / self.growth(state)]) * self.G

    def _balance(self, stresses: Array, r: Array, pressure: float) -> Array:
        slope = self.slope @ r
        error = self.slope @ stresses[2] + (stresses[2] - stresses[0]) * slope / r
        error[0], error[-1] = stresses[2][0] + pressure, stresses[2][-1]
        return error

    def _close(self) -> None:
        whole = 360.0 / (360.0 - self.opening_angle)

        def gradient(values: Array, turn: float) -> Array:
            R = values[:-1]
            return np.array([turn * self.R / R, values[-1] + 0 * R, 1 / (self.slope @ R)])

        def residual(values: Array, turn: float) -> Array:
            stresses = self.stresses(gradient(values, turn), self.state)
            return np.append(
                self._balance(stresses, self.R, 0.0), self.weights @ (stresses[1] * self.R)
            )

        values = np.append(self.R, 1.0)
        for turn in np.linspace(1.0, whole, 9)[1:]:
            values[:-1] *= 1 + 0.5 * (whole - 1) / 8
            values = solved(lambda v: residual(v, turn), values)  # noqa: B023
        self.G = gradient(values, whole)

    def _solve(self, pressure: float, length: float, state: State) -> None:
        def residual(r: Array) -> Array:
            stresses = self.stresses(self.stretches(r, length, state), state) / self.growth(state)
            return self._balance(stresses, r, pressure)

        self.r, self.length = solved(residual, self.r), length

    def _rates(self, state: State) -> State:
        A, m, rho = state
        of, stretches = self.material, self.stretches(self.r, self.length, state)
        stress = self.stresses(stretches, state) / self.growth(state)
        tension = np.maximum(stress, 0.0) ** 2
        size = tension.sum(axis=0)
        share = size / (size + 0.01 * (np.minimum(stress, 0.0) ** 2).sum(axis=0) + 1e-8)
        turned = (
            self.kappa
            * share
            * (of.end_to_end_length**2 * tension / np.where(size > 0, size, 1.0) - A)
        )
        stretch = np.sqrt((A * stretches**2).sum(axis=0)) / rho / of.end_to_end_length

        def fibre(some: Array | float) -> Array:
            return self.chain(some * of.end_to_end_length) * some**2

        relative = fibre(stretch) / fibre(self.deposition_stretch)
        steepness = np.log(fibre(stretch * (1 + 1e-30j))).imag / 1e-30
        produced = np.maximum(1 + self.gain * (relative - 1), 0.0)
        return (
            turned,
            m * (produced - 1) / self.time,
            rho * produced * (1 - 1 / relative) / (steepness * self.time),
        )

    def run(self, pressure: float, elongation: float, ramp: float, end: float, step: float) -> None:
        """The loads rise to the end of the ramp, and stay."""

        def rates(time: float, state: State) -> State:
            factor = min(time / ramp, 1.0)
            self._solve(pressure * factor, 1 + elongation * factor, state)
            return self._rates(state)

        def ahead(rate: State, duration: float) -> State:
            a, m, rho = (
                value + duration * change for value, change in zip(self.state, rate, strict=True)
            )
            return a, m, rho

        for number in range(round(end / step)):
            time, half = number * step, step / 2
            first = rates(time, self.state)
            second = rates(time + half, ahead(first, half))
            third = rates(time + half, ahead(second, half))
            fourth = rates(time + step, ahead(third, step))
            four = zip(first, second, third, fourth, strict=True)
            mean_a, mean_m, mean_rho = ((a + 2 * b + 2 * c + d) / 6 for a, b, c, d in four)
            self.state = ahead((mean_a, mean_m, mean_rho), step)
        self._solve(pressure, 1 + elongation, self.state)

    def row(self) -> dict[str, float]:
        """Columns of the package."""
        r, weights, growth = self.r, self.weights, self.growth(self.state)
        stress = self.stresses(self.stretches(r, self.length, self.state), self.state) / growth
        slope, volume, (_, content, length) = self.slope @ r, weights @ self.R, self.state
        means = {"content": content, "natural_length": length, "growth": growth}
        return {
            name: float(weights @ (self.R * values) / volume) for name, values in means.items()
        } | {
            "inner_radius": float(r[0]),
            "wall_thickness": float(r[-1] - r[0]),
            "mean_hoop_stress": float(weights @ (stress[0] * slope) / (r[-1] - r[0])),
            "axial_force": float(2 * np.pi * weights @ (stress[1] * r * slope)),
        }

    def cut(self) -> float:
        """By how many degrees the unloaded wall opens when it is cut."""
        growth, start = self.growth(self.state), np.concatenate(
            [self.r, [self.length, 1 - self.opening_angle / 360]]
        )

        def residual(values: Array) -> Array:
            r, axial, k = values[:-2], values[-2], values[-1]
            stretches = np.array([k * r / self.R, axial + 0 * r, self.slope @ r / growth]) * self.G
            stress = self.stresses(stretches, self.state) / growth
            sums = [self.weights @ (stress[n] * r * (self.slope @ r)) for n in (1, 0)]
            return np.concatenate([self._balance(stress, r, 0.0), sums])

        values, first = start, residual(start)
        for share in np.linspace(1.0, 0.0, 11)[1:]:
            values = solved(lambda v: residual(v) - share * first, values)  # noqa: B023
        return 360.0 * (1 - float(values[-1]))
