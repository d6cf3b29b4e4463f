"""Kinematics: the deformation gradient from the unknowns."""

from __future__ import annotations

from typing import Any

import ufl


def deformation_gradient(displacement: Any) -> Any:
    """F = I + grad u of a three-dimensional displacement field (UFL, shape (3, 3))."""
    return ufl.Identity(len(displacement)) + ufl.grad(displacement)
