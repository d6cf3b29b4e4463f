"""The few tensor operations of the model, on UFL expressions and on numbers and arrays alike.

Arrays have shape (..., 3, 3) for tensors and (..., 3) for vectors; what is in front are points. UFL is imported when
the first expression comes: scenes and arrays do without it.
"""

from __future__ import annotations

from functools import singledispatch
from numbers import Real
from typing import Any

import numpy as np


@singledispatch
def ln(value: Any) -> Any:
    """Natural logarithm."""
    import ufl

    return ufl.ln(value)


@ln.register(Real)
@ln.register(np.ndarray)
def _(value: Any) -> Any:
    return np.log(value)


@singledispatch
def sqrt(value: Any) -> Any:
    """Square root."""
    import ufl

    return ufl.sqrt(value)


@sqrt.register(Real)
@sqrt.register(np.ndarray)
def _(value: Any) -> Any:
    return np.sqrt(value)


@singledispatch
def det(tensor: Any) -> Any:
    """Determinant."""
    import ufl

    return ufl.det(tensor)


@det.register(np.ndarray)
def _(tensor: Any) -> Any:
    return np.linalg.det(tensor)


@singledispatch
def squared_norm(tensor: Any) -> Any:
    """A : A, the sum of the squares of all nine entries."""
    import ufl

    return ufl.inner(tensor, tensor)


@squared_norm.register(np.ndarray)
def _(tensor: Any) -> Any:
    return np.einsum("...ij,...ij->...", tensor, tensor)


@singledispatch
def squared_stretch(deformation_gradient: Any, directions: Any, row: int) -> Any:
    """n . C n of the unit vector n in a row of `directions` (..., 3, 3), C = F^T F."""
    import ufl

    fibre = ufl.dot(deformation_gradient, directions[row, :])
    return ufl.inner(fibre, fibre)


@squared_stretch.register(np.ndarray)
def _(deformation_gradient: Any, directions: Any, row: int) -> Any:
    fibre = np.einsum("...ij,...j->...i", deformation_gradient, directions[..., row, :])
    return np.einsum("...i,...i->...", fibre, fibre)


def component(vector: Any, index: int) -> Any:
    """Component of a UFL vector, or of vectors in the last dimension of an array."""
    return vector[..., index] if isinstance(vector, np.ndarray) else vector[index]
