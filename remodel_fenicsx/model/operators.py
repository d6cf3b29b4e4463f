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
    if is_array(tensor):  # np.linalg.det factorises each tensor by itself, which takes ten times as long
        (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(tensor, (-2, -1), (0, 1))
        return a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g)
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
    if is_array(deformation_gradient):  # by component, three times as fast as np.einsum
        F, n = np.moveaxis(deformation_gradient, (-2, -1), (0, 1)), np.moveaxis(directions[..., row, :], -1, 0)
        return sum((F[i, 0] * n[0] + F[i, 1] * n[1] + F[i, 2] * n[2]) ** 2 for i in range(3))
    import ufl

    fibre = ufl.dot(deformation_gradient, directions[row, :])
    return ufl.inner(fibre, fibre)


def component(vector: Any, index: int) -> Any:
    """Component of a UFL vector, or of vectors in the last dimension of an array."""
    return vector[..., index] if is_array(vector) else vector[index]
