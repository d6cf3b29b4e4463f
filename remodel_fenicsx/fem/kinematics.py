"""Kinematics: which unknowns describe the deformation, and the deformation gradient that follows from them.

Everything else asks the object: F is always 3x3, a displacement always has three components. dolfinx is imported when
it is needed: scenes, which name kinematics, are read without it.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


class Kinematics(Protocol):
    """What forms, supports and records need to know of the unknowns."""

    def unknown(self, mesh: Any, degree: int) -> Any:
        """A dolfinx function of the unknowns, zero, with elements of this degree."""

    def displacement(self, unknown: Any) -> Any:
        """UFL 3-vector, linear in the unknown: so it is also the virtual displacement of a test function."""

    def deformation_gradient(self, unknown: Any) -> Any:
        """F, UFL, always of shape (3, 3)."""

    def weight(self, mesh: Any) -> Any:
        """Volume of the body per unit of mesh, UFL."""

    def subspace(self, space: Any, component: int) -> Any:
        """The part of the unknown's space that a support of the displacement in x, y or z (0, 1, 2) holds, or None."""

    def nodal_displacement(self, unknown: Any) -> NDArray[np.float64]:
        """Displacement of the local nodes, (nodes, 3)."""


class FullKinematics:
    """The displacement field in three dimensions: F = I + grad u."""

    def unknown(self, mesh: Any, degree: int) -> Any:
        """A vector function, zero."""
        import basix.ufl
        import dolfinx.fem

        element = basix.ufl.element("Lagrange", mesh.topology.cell_name(), degree, shape=(3,))
        return dolfinx.fem.Function(dolfinx.fem.functionspace(mesh, element), name="displacement")

    def displacement(self, unknown: Any) -> Any:
        """The unknown itself."""
        return unknown

    def deformation_gradient(self, unknown: Any) -> Any:
        """F = I + grad u."""
        import ufl

        return ufl.Identity(3) + ufl.grad(unknown)

    def weight(self, mesh: Any) -> Any:
        """One: the mesh is the body."""
        return 1

    def subspace(self, space: Any, component: int) -> Any:
        """The component's own subspace."""
        return space.sub(component)

    def nodal_displacement(self, unknown: Any) -> NDArray[np.float64]:
        """The unknown's own memory, (nodes, 3)."""
        values: NDArray[np.float64] = unknown.x.array.reshape(-1, 3)
        return values


KINEMATICS: dict[str, Kinematics] = {"full": FullKinematics()}
"""Kinematics by the name that a scene gives them."""
