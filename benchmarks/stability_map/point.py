"""A material point of the tissue, typed by hand from the paper: the reference of all homogeneous cases.

Shares no code with the package. Energy, stress and pass are written out here (with tests/reference/radial.py, which is
another reference of the same kind); equilibrium is found with complex steps.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from tests.reference.radial import (
    RadialMaterial,
    first_piola_kirchhoff,
    secant_stiffness,
)

Array = npt.NDArray[Any]


class NoEquilibrium(RuntimeError):
    """The reference finds none from the state before."""


@dataclass
class Path:
    """What a homogeneous body does, one entry per step: stretches (3), squares l_d^2 (3) of the solved state."""

    times: list[float] = field(default_factory=list)
    stretches: list[Array] = field(default_factory=list)
    squares: list[Array] = field(default_factory=list)
    ended: str = ""

    def angle(self, direction: int = 2) -> Array:
        """Degrees between the chains and a direction, by step."""
        squares = np.array(self.squares)
        across = squares.sum(axis=1) - squares[:, direction]
        return np.degrees(np.arctan2(np.sqrt(across), np.sqrt(squares[:, direction])))


# ---------------------------------------------------------------- axes along x, y, z for ever
def advance(stretches: Array, old: tuple[Array, Array], new: tuple[Array, Array], material: RadialMaterial) -> Array:
    """Stretches in equilibrium with new squares and load, in parts where one Newton solve fails."""
    found = equilibrium(stretches, *new, material)
    if found is not None:
        return found
    middle = (new[0], old[1])
    for start, end in ((old, middle), (middle, new)):
        done, part = 0.0, 0.5
        while done < 1.0:
            at = min(1.0, done + part)
            mixed = [(1 - at) * a + at * b for a, b in zip(start, end, strict=True)]
            found = equilibrium(stretches, mixed[0], mixed[1], material)
            if found is not None:
                stretches, done, part = found, at, 2 * part
            else:
                part /= 2
                if part < 1e-10:
                    raise NoEquilibrium(f"nothing beyond a share {done:.4g} of the step")
    return stretches


def admissible(stretches: Array, squares: Array, material: RadialMaterial) -> bool:
    """r < L and every stretch positive."""
    length = np.sqrt(np.sum(squares * stretches**2))
    return bool(np.all(stretches > 0) and length < material.contour_length)


def equilibrium(stretches: Array, squares: Array, load: Array, material: RadialMaterial) -> Array | None:
    """Newton's method on P_d = load_d, kept where r < L; None where it finds nothing."""
    if not admissible(stretches, squares, material):
        return None

    def residual(values: Array) -> Array:
        return first_piola_kirchhoff(values[None], squares, material)[0] - load

    smallest = np.inf
    for _ in range(300):
        tangent = np.empty((3, 3))
        for d in range(3):
            tangent[:, d] = residual(stretches + 1e-30j * np.eye(3)[d]).imag / 1e-30
        step = -np.linalg.solve(tangent, residual(stretches).real)
        while not admissible(stretches + step, squares, material):
            step = step / 2
            if np.max(np.abs(step)) < 1e-14:
                return None
        stretches = stretches + step
        size = float(np.max(np.abs(step) / stretches))
        if size < 1e-12 or (size < 1e-9 and size >= smallest):
            return stretches
        smallest = min(size, smallest)
    return None


# ---------------------------------------------------------------- any deformation, prescribed
def cauchy(F: Array, l: Array, n: Array, m: RadialMaterial) -> Array:
    """Sigma of eq. (7) with erratum 5, for one F (3, 3), l (3,), axes as rows n (3, 3)."""
    J = np.linalg.det(F)
    f = n @ F.T  # rows F n_I
    squared = np.sum(f**2, axis=1)
    r = np.sqrt(np.sum(l**2 * squared))
    g, g0 = secant_stiffness(r, m.contour_length), secant_stiffness(np.array(m.end_to_end_length), m.contour_length)
    sigma = (m.lame_lambda * np.log(J) - m.lame_mu) * np.eye(3) + m.lame_mu * F @ F.T
    for I in range(3):
        sigma += m.network_modulus * l[I] ** 2 * (g - g0 / squared[I]) * np.outer(f[I], f[I])
    return np.asarray(sigma / J)


def driving_tensor(driver: str, F: Array, sigma: Array) -> Array:
    """Sigma, S or b."""
    if driver == "pk2":
        inverse = np.linalg.inv(F)
        return np.linalg.det(F) * inverse @ sigma @ inverse.T
    return F @ F.T if driver == "finger" else sigma


def prescribed_path(
    material: RadialMaterial,
    gradients: Array,
    times: Array,
    dimensions: Array,
    driver: str = "cauchy",
    law: str = "explicit",
    frame: str = "spatial",
    kappa: float = 0.025,
    share: float = 1.0,
) -> Array:
    """A of the cells with which each state is in equilibrium, (steps, 3, 3), under given F (steps, 3, 3)."""
    l, n, r0 = dimensions.copy(), np.eye(3), material.end_to_end_length
    found, before = [], 0.0
    for time, F in zip(times, gradients, strict=True):
        A = n.T @ np.diag(l**2) @ n
        found.append(A)
        values, vectors = np.linalg.eigh(driving_tensor(driver, F, cauchy(F, l, n, material)))
        values, rows = values[::-1], vectors.T[::-1]
        positive = np.where(values > 1e-13 * np.max(np.abs(values)), values, 0.0)
        if law == "none" or not positive.any():
            before = float(time)
            continue
        target = r0 * positive / np.linalg.norm(positive)
        step = float(time) - before
        if law == "explicit":
            new = dimensions + (target - dimensions) * -np.expm1(-kappa * time)
        elif law == "rate":
            new = l + (target - dimensions) * (np.exp(-kappa * before) - np.exp(-kappa * time))
        else:
            new = target + (l - target) * np.exp(-kappa * step)
        axes = _material_axes(F, rows) if frame == "material" and driver != "pk2" else rows
        relaxed = A + share * (axes.T @ np.diag(new**2) @ axes - A)
        if share < 1.0:
            squared, vectors = np.linalg.eigh(relaxed)
            new, axes = np.sqrt(np.maximum(squared[::-1], 0.0)), vectors.T[::-1]
        l, n, before = new, axes, float(time)
    return np.array(found)


def _material_axes(F: Array, rows: Array) -> Array:
    first, second = np.linalg.solve(F, rows[0]), np.linalg.solve(F, rows[1])
    first = first / np.linalg.norm(first)
    second = second - second @ first * first
    second = second / np.linalg.norm(second)
    return np.array([first, second, np.cross(first, second)])
