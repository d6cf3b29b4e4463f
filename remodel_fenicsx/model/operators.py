"""The few tensor operations of the model, on UFL expressions and on arrays alike.

Arrays have shape (..., 3, 3) for tensors and (..., 3) for vectors; what is in front are points. What is neither number
nor array is UFL, which is imported only then: scenes are read, and points computed, without it.
"""

from __future__ import annotations

from typing import Any

import numpy as np


def is_array(value: Any) -> bool:
    """Whether a value is a number or an array, not UFL."""
    return isinstance(value, (np.ndarray, np.generic, float, int, complex))


def ln(value: Any) -> Any:
    """Natural logarithm."""
    if is_array(value):
        return np.log(value)
    import ufl

    return ufl.ln(value)


def sqrt(value: Any) -> Any:
    """Square root."""
    if is_array(value):
        return np.sqrt(value)
    import ufl

    return ufl.sqrt(value)


def det(tensor: Any) -> Any:
    """Determinant."""
    if is_array(tensor):
        return np.linalg.det(tensor)
    import ufl

    return ufl.det(tensor)


def squared_norm(tensor: Any) -> Any:
    """A : A, the sum of the squares of all nine entries."""
    if is_array(tensor):
        return np.einsum("...ij,...ij->...", tensor, tensor)
    import ufl

    return ufl.inner(tensor, tensor)


def squared_stretch(deformation_gradient: Any, directions: Any, row: int) -> Any:
    """n . C n of the unit vector n in a row of `directions` (..., 3, 3), C = F^T F."""
    if is_array(deformation_gradient):
        fibre = np.einsum("...ij,...j->...i", deformation_gradient, directions[..., row, :])
        return np.einsum("...i,...i->...", fibre, fibre)
    import ufl

    fibre = ufl.dot(deformation_gradient, directions[row, :])
    return ufl.inner(fibre, fibre)


def component(vector: Any, index: int) -> Any:
    """Component of a UFL vector, or of vectors in the last dimension of an array."""
    return vector[..., index] if is_array(vector) else vector[index]


def passes_through_zero(before: Any, after: Any) -> Any:
    """Where det((1 - s) F + s G) is not positive for an s between 0 and 1: the straight way turns the body inside out.

    Both ends may be in order all the same, for two axes can turn at once. Exact: the determinant is a cubic in s.

    Parameters
    ----------
    before, after
        F and G, (n, 3, 3), with positive determinants.

    Returns
    -------
    ndarray
        (n,), bool; False where an entry is not finite.
    """
    change = after - before
    crossing = np.zeros(len(before), dtype=bool)
    # |F^-1| <= F:F / (2 det F): nearer than its inverse nothing is singular, and the cubic need not be asked
    size, square = np.sqrt(np.einsum("nij,nij->n", change, change)), np.einsum("nij,nij->n", before, before)
    near = np.flatnonzero(size * square >= 2 * determinant(before))
    if not near.size:
        return crossing
    at = [determinant(before[near] + s * change[near]) for s in (0.0, 1 / 3, 2 / 3, 1.0)]
    coefficients = np.linalg.solve(np.vander([0.0, 1 / 3, 2 / 3, 1.0], 4, increasing=True), np.stack(at))
    _, linear, quadratic, cubic = coefficients
    with np.errstate(invalid="ignore", divide="ignore"):
        # turning points: 3 c s^2 + 2 b s + a = 0, by the stable formula; a parabola has one of them at infinity
        root = -(quadratic + np.copysign(np.sqrt(quadratic**2 - 3 * cubic * linear), quadratic))
        places = [np.where((s > 0) & (s < 1), s, 0.0) for s in (root / (3 * cubic), linear / root)]
    lowest = np.min([np.polynomial.polynomial.polyval(s, coefficients, tensor=False) for s in places] + at, axis=0)
    crossing[near] = lowest <= 1e-12 * np.max(at, axis=0)  # a double root by rounding
    return crossing


def determinant(tensors: Any) -> Any:
    """By the rule for three rows: seven times as fast as a factorisation of each."""
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(tensors, 0, -1)
    return a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g)


def cofactor(tensors: Any) -> Any:
    """J F^-T of arrays (..., 3, 3): each row is the cross product of the two others."""
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(tensors, (-2, -1), (0, 1)).copy()  # nine arrays without gaps
    entries = [e * i - f * h, f * g - d * i, d * h - e * g, h * c - i * b, i * a - g * c, g * b - h * a,
               b * f - c * e, c * d - a * f, a * e - b * d]  # fmt: skip
    return np.stack(entries, axis=-1).reshape(np.shape(tensors))


def largest_change_of_length(before: Any, after: Any) -> Any:
    """By what share the lengths at points change most between two deformation gradients (n, 3, 3), to first order.

    sqrt(2/3) |E| with E the symmetric part of G F^-1 - 1: the largest |e_I| of a bar, 2/sqrt(3) of it in pure shear,
    where the volume stays.
    """
    change = after @ np.linalg.inv(before) - np.eye(3)
    strain = 0.5 * (change + np.swapaxes(change, 1, 2))
    return np.sqrt(2 / 3 * squared_norm(strain))
