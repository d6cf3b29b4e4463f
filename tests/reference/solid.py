"""One trilinear hexahedron typed by hand: is a homogeneous state of it a minimum of its energy?"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from tests.reference.radial import RadialMaterial, secant_stiffness

Array = npt.NDArray[Any]
CORNERS = np.array(list(product((0, 1), repeat=3)), dtype=float)
# the sliding planes x = y = z = 0 of the cube: component d is held at the corners with coordinate d = 0
FREE = np.flatnonzero(CORNERS.ravel() > 0)


def piola(F: Array, squares: Array, m: RadialMaterial) -> Array:
    """P = dW/dF for cells with axes along x, y, z; F (n, 3, 3), squares l_d^2 (3,)."""
    J = np.linalg.det(F)[:, None, None]
    inverse = np.swapaxes(np.linalg.inv(F), 1, 2)
    stretch = np.sum(F**2, axis=1)  # n_d . C n_d of the three axes
    r = np.sqrt(stretch @ squares)
    g = secant_stiffness(r, m.contour_length)[:, None]
    g0 = secant_stiffness(np.array(m.end_to_end_length), m.contour_length)
    chain = m.network_modulus * squares * (g - g0 / stretch)
    return np.asarray(
        m.lame_mu * F + (m.lame_lambda * np.log(J) - m.lame_mu) * inverse + F * chain[:, None, :]
    )


def gradients() -> tuple[Array, Array]:
    """dN/dX of the eight corners at the eight Gauss points, (8, 8, 3), and the weights."""
    points = 0.5 + np.array(list(product((-0.5, 0.5), repeat=3))) / np.sqrt(3)
    found = np.empty((8, 8, 3))
    for p, x in enumerate(points):
        for a, corner in enumerate(CORNERS):
            factors = np.where(corner > 0, x, 1 - x)
            for d in range(3):
                found[p, a, d] = (2 * corner[d] - 1) * np.prod(np.delete(factors, d))
    return found, np.full(8, 0.125)


def smallest_eigenvalue(
    stretches: Array, squares: Array, material: RadialMaterial, start: Array | None = None
) -> float:
    """Smallest eigenvalue of the tangent of the sliding unit cube in one element, over that of the unloaded one.

    `start`: squares l_d^2 of the unloaded body, if they were others; its tangent is positive where |l| = r0.
    """
    unloaded = _smallest(np.eye(3), squares if start is None else start, material)
    return _smallest(np.diag(stretches), squares, material) / unloaded


def _smallest(F: Array, squares: Array, material: RadialMaterial) -> float:
    slopes, weights = gradients()
    at = CORNERS @ F.T

    def forces(x: Array) -> Array:
        deformation = np.einsum("ai,paj->pij", x.reshape(8, 3), slopes)
        stress = piola(deformation, squares, material)
        return np.einsum("p,pij,paj->ai", weights, stress, slopes).ravel()

    h, columns = 1e-6, []
    for dof in FREE:
        shift = np.zeros(24)
        shift[dof] = h
        columns.append((forces(at.ravel() + shift) - forces(at.ravel() - shift))[FREE] / (2 * h))
    tangent = np.array(columns)
    return float(np.linalg.eigvalsh((tangent + tangent.T) / 2)[0])
