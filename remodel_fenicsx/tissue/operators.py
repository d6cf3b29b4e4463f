"""The few tensor operations of the model, on UFL expressions and on arrays alike.

Arrays have shape (..., 3, 3) for tensors and (..., 3) for vectors; what is in front are points.
"""

from __future__ import annotations

from functools import singledispatch
from typing import Any

import numpy as np
import ufl
from ufl.core.expr import Expr


@singledispatch
def ln(value: Any) -> Any:
    """Natural logarithm."""
    return np.log(value)


@ln.register
def _(value: Expr) -> Any:
    return ufl.ln(value)


@singledispatch
def sqrt(value: Any) -> Any:
    """Square root."""
    return np.sqrt(value)


@sqrt.register
def _(value: Expr) -> Any:
    return ufl.sqrt(value)


@singledispatch
def det(tensor: Any) -> Any:
    """Determinant."""
    return np.linalg.det(tensor)


@det.register
def _(tensor: Expr) -> Any:
    return ufl.det(tensor)


@singledispatch
def squared_norm(tensor: Any) -> Any:
    """A : A, the sum of the squares of all nine entries."""
    return np.einsum("...ij,...ij->...", tensor, tensor)


@squared_norm.register
def _(tensor: Expr) -> Any:
    return ufl.inner(tensor, tensor)


@singledispatch
def squared_stretch(deformation_gradient: Any, directions: Any, row: int) -> Any:
    """n . C n of the unit vector n in a row of `directions` (..., 3, 3), C = F^T F."""
    fibre = np.einsum("...ij,...j->...i", deformation_gradient, directions[..., row, :])
    return np.einsum("...i,...i->...", fibre, fibre)


@squared_stretch.register
def _(deformation_gradient: Expr, directions: Any, row: int) -> Any:
    fibre = ufl.dot(deformation_gradient, directions[row, :])
    return ufl.inner(fibre, fibre)


def component(vector: Any, index: int) -> Any:
    """Component of a UFL vector, or of vectors in the last dimension of an array."""
    return vector[index] if isinstance(vector, Expr) else vector[..., index]
