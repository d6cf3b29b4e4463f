"""A material point of the tissue under any deformation that is given, typed by hand from the paper and docs/model.md.

Shares no code with the package. Equilibrium of a point whose axes stay is in tests/reference/march.py.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import fsolve

from tests.reference.radial import Array, RadialMaterial, first_piola_kirchhoff, secant_stiffness

COMPRESSION = 0.1  # weight of what pushes in the law `tensor`


def cauchy(F: Array, A: Array, repulsion: Array, m: RadialMaterial) -> Array:
    """sigma of W_iso, of chains of length r, r^2 = A : C, and of a repulsion - c/2 g(r0) `repulsion` : C."""
    C, J = F.T @ F, np.linalg.det(F)
    g, g0 = (
        secant_stiffness(r, m.contour_length)
        for r in (np.sqrt(np.sum(A * C)), np.array(m.end_to_end_length))
    )
    inner = m.lame_mu * np.eye(3) + m.network_modulus * (g * A - g0 * repulsion)
    return np.asarray(((m.lame_lambda * np.log(J) - m.lame_mu) * np.eye(3) + F @ inner @ F.T) / J)


def uniaxial_stretches(stress: float, dimensions: Array, m: RadialMaterial) -> Array:
    """Of a point under a nominal stress along its first axis; cells l (3,) along the axes."""

    def balance(stretches: Array) -> Array:
        found = first_piola_kirchhoff(stretches[None], dimensions[None] ** 2, m)[0]
        return found - np.array([stress, 0.0, 0.0])

    return np.asarray(fsolve(balance, [1.4, 0.85, 0.85], xtol=1e-13))


def repulsion_of_axes(F: Array, l: Array, n: Array) -> Array:
    """Of eq. (7) with erratum 5, lengths l (3,), axes as rows n (3, 3)."""
    return np.asarray(n.T @ np.diag(l**2 / np.sum((n @ F.T) ** 2, axis=1)) @ n)


def repulsion_of_logarithm(F: Array, A: Array) -> Array:
    """The derivative of A : ln C with respect to C."""
    squares, Q = np.linalg.eigh(F.T @ F)
    near = np.abs(squares[:, None] - squares) < 1e-7 * squares.max()
    middle = (squares[:, None] + squares) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        quotients = (np.log(squares)[:, None] - np.log(squares)) / (squares[:, None] - squares)
    return np.asarray(Q @ (np.where(near, 1 / middle, quotients) * (Q.T @ A @ Q)) @ Q.T)


def driving_tensor(driver: str, F: Array, sigma: Array, frame: str = "spatial") -> Array:
    """sigma, S or b; in the material frame R^T sigma R, S or C."""
    if driver == "pk2":
        inverse = np.linalg.inv(F)
        return np.asarray(np.linalg.det(F) * inverse @ sigma @ inverse.T)
    if driver == "finger":
        return F.T @ F if frame == "material" else F @ F.T
    if frame == "spatial":
        return sigma
    squares, Q = np.linalg.eigh(F.T @ F)
    R = F @ (Q / np.sqrt(squares)) @ Q.T
    return np.asarray(R.T @ sigma @ R)


def prescribed_path(
    material: RadialMaterial, gradients: Array, times: Array, dimensions: Array, driver: str = "cauchy",
    law: str = "explicit", frame: str = "spatial", kappa: float = 0.025, share: float = 1.0,
) -> Array:  # fmt: skip
    """A of the cells with which each state is in equilibrium, (steps, 3, 3), under given F (steps, 3, 3)."""
    if law == "tensor":
        return _tensor_path(material, gradients, times, dimensions, driver, kappa)
    l, n, r0 = dimensions.copy(), np.eye(3), material.end_to_end_length
    found, before = [], 0.0
    for time, F in zip(times, gradients, strict=True):
        A = n.T @ np.diag(l**2) @ n
        found.append(A)
        sigma = cauchy(F, A, repulsion_of_axes(F, l, n), material)
        values, vectors = np.linalg.eigh(driving_tensor(driver, F, sigma))
        values, rows = values[::-1], vectors.T[::-1]
        positive = np.where(values > 1e-13 * np.max(np.abs(values)), values, 0.0)
        if law == "none" or not positive.any():
            before = float(time)
            continue
        target = r0 * positive / np.linalg.norm(positive)
        if law == "explicit":
            new = dimensions + (target - dimensions) * -np.expm1(-kappa * time)
        elif law == "rate":
            new = l + (target - dimensions) * (np.exp(-kappa * before) - np.exp(-kappa * time))
        else:
            new = target + (l - target) * np.exp(-kappa * (float(time) - before))
        axes = _material_axes(F, rows) if frame == "material" and driver != "pk2" else rows
        if share < 1.0:
            squared, vectors = np.linalg.eigh(A + share * (axes.T @ np.diag(new**2) @ axes - A))
            new, axes = np.sqrt(np.maximum(squared[::-1], 0.0)), vectors.T[::-1]
        l, n, before = new, axes, float(time)
    return np.array(found)


def _tensor_path(
    m: RadialMaterial, F: Array, times: Array, start: Array, driver: str, kappa: float
) -> Array:
    A, before, r0, found = np.diag(start**2), 0.0, m.end_to_end_length, []
    for time, gradient in zip(times, F, strict=True):
        found.append(A)
        sigma = cauchy(gradient, A, repulsion_of_logarithm(gradient, A), m)
        values, vectors = np.linalg.eigh(driving_tensor(driver, gradient, sigma, "material"))
        positive, negative = np.maximum(values, 0.0) ** 2, np.minimum(values, 0.0) ** 2
        if positive.sum() > 0:
            share = positive.sum() / (positive.sum() + COMPRESSION**2 * negative.sum())
            direction = (vectors * positive / positive.sum()) @ vectors.T
            A = A + (r0**2 * direction - A) * -np.expm1(-kappa * (float(time) - before) * share)
        before = float(time)
    return np.array(found)


def _material_axes(F: Array, rows: Array) -> Array:
    first, second = np.linalg.solve(F, rows[0]), np.linalg.solve(F, rows[1])
    first = first / np.linalg.norm(first)
    second = second - second @ first * first
    second = second / np.linalg.norm(second)
    return np.array([first, second, np.cross(first, second)])
