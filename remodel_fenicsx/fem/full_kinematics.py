"""What everybody asks of a kinematics, and the full one: the displacement in three dimensions.

dolfinx is imported when it is needed: scenes, which name kinematics, are read without it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray


class Body(Protocol):
    """What a reduced kinematics must know of a body (`body.shape.Shape`)."""

    @property
    def axial_length(self) -> float: ...

    @property
    def section_area(self) -> float: ...


class Kinematics(Protocol):
    """What forms, supports and records need to know of the unknowns.

    Attributes
    ----------
    name
        Under which scenes know it.
    meaning
        What it does, for docs/scene.md.
    reduced
        Whether it needs a mesh of its own, which a shape's `reductions` make, and is exact for some scenes only.
    moves_rigidly
        Whether the body can move as a whole across z, or turn about it: then supports at single nodes hold it.
    symmetry_planes
        Faces of the mesh that are planes of symmetry, and the component of the displacement that is zero there.
    homogeneous
        Whether the strain is the same everywhere: then no mesh changes what is found.
    cost
        Of a step for each quadrature point, in that of one of a hexahedron, as measured on the artery.
    """

    @property
    def name(self) -> str: ...

    @property
    def meaning(self) -> str: ...

    @property
    def reduced(self) -> bool: ...

    @property
    def moves_rigidly(self) -> bool: ...

    @property
    def symmetry_planes(self) -> Mapping[str, int]: ...

    @property
    def homogeneous(self) -> bool: ...

    @property
    def cost(self) -> float: ...

    def element(self, kind: str) -> str:
        """Kind of the mesh's elements where the scene asks for elements of the body of this kind."""

    def on(self, mesh: Any, body: Body) -> Kinematics:
        """The kinematics for the mesh of a body."""

    def unknown(self, mesh: Any, degree: int) -> Any:
        """A dolfinx function of the unknowns, zero, with elements of this degree."""

    def displacement(self, unknown: Any) -> Any:
        """UFL 3-vector, linear in the unknown: so it is also the virtual displacement of a test function."""

    def deformation_gradient(self, unknown: Any) -> Any:
        """F, UFL, always of shape (3, 3)."""

    def weight(self, mesh: Any) -> Any:
        """Volume of the body per unit of mesh, a number or UFL."""

    def subspace(self, space: Any, component: int) -> Any:
        """The part of the unknown's space that a support of the displacement in x, y or z (0, 1, 2) holds, or None."""

    def uniform_strain(self, component: int) -> Any:
        """The Constant that is the engineering strain along x, y or z where it is prescribed as a whole, or None."""

    def nodal_space(self, unknown: Any) -> Any:
        """A space, scalar or blocked, with the mesh's nodes in the order of `nodal_displacement`."""

    def nodal_displacement(self, unknown: Any) -> NDArray[np.float64]:
        """Displacement of the local nodes, (nodes, 3)."""


class FullKinematics:
    """The displacement field in three dimensions: F = I + grad u."""

    name: ClassVar[str] = "full"
    meaning: ClassVar[str] = "the displacement in three dimensions"
    reduced: ClassVar[bool] = False
    moves_rigidly: ClassVar[bool] = True
    symmetry_planes: ClassVar[Mapping[str, int]] = {}
    homogeneous: ClassVar[bool] = False
    cost: ClassVar[float] = 1.0

    def element(self, kind: str) -> str:
        """The same."""
        return kind

    def on(self, mesh: Any, body: Body) -> Kinematics:
        """The same for every mesh."""
        return self

    def unknown(self, mesh: Any, degree: int) -> Any:
        """A vector function, zero."""
        return lagrange(mesh, degree, (3,))

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

    def uniform_strain(self, component: int) -> Any:
        """None: every strain follows from the field."""
        return None

    def nodal_space(self, unknown: Any) -> Any:
        """The unknown's own."""
        return unknown.function_space

    def nodal_displacement(self, unknown: Any) -> NDArray[np.float64]:
        """The unknown's own memory, (nodes, 3)."""
        values: NDArray[np.float64] = unknown.x.array.reshape(-1, 3)
        return values


def lagrange(mesh: Any, degree: int, shape: tuple[int, ...]) -> Any:
    """A continuous function "displacement", zero, with values of this shape."""
    import basix.ufl
    import dolfinx.fem

    element = basix.ufl.element("Lagrange", mesh.topology.cell_name(), degree, shape=shape)
    return dolfinx.fem.Function(dolfinx.fem.functionspace(mesh, element), name="displacement")
