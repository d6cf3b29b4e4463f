"""Kinematics of a part of the body that stands for all of it.

Such a mesh lies in three dimensions where the part lies: a ray on the x axis, a half-plane in y = 0, a quarter, a bar
along z beside the axis. There the radial, circumferential and axial directions are x, y and z: axes of cells, normals
and places need no other coordinates, and no tensor another basis.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.fem.full_kinematics import Body, FullKinematics, lagrange

Array = NDArray[np.float64]


class SectorKinematics(FullKinematics):
    """The full displacement of a quarter of a tube between its planes of symmetry x = 0 and y = 0."""

    name = "sector"
    meaning = "the same on a quarter of a tube, with planes of symmetry"
    reduced = True
    homogeneous = False
    moves_rigidly = False
    symmetry_planes: ClassVar[Mapping[str, int]] = {"plane_x": 0, "plane_y": 1}

    def weight(self, mesh: Any) -> Any:
        """Four of them are the body."""
        return 4


class _Reduced:
    """What the kinematics with fewer dimensions have in common."""

    reduced: ClassVar[bool] = True
    homogeneous: ClassVar[bool] = False
    moves_rigidly: ClassVar[bool] = False
    symmetry_planes: ClassVar[Mapping[str, int]] = {}
    element_kind: ClassVar[str]
    components: ClassVar[tuple[int | None, int | None, int | None]]  # of the unknown, by that of the displacement

    def __init__(self, mesh: Any = None, body: Body | None = None):
        self.mesh, self.body = mesh, body
        if mesh is not None and body is not None:  # Constants, so that another body compiles nothing
            self.axial_length = _constant(mesh, body.axial_length)
            self.section_area = _constant(mesh, body.section_area)

    def element(self, kind: str) -> str:
        """Of fewer dimensions."""
        return self.element_kind

    def on(self, mesh: Any, body: Body) -> Any:
        """One of its own: its numbers belong to the mesh."""
        return type(self)(mesh, body)

    def subspace(self, space: Any, component: int) -> Any:
        """The component's own subspace, if it is a field."""
        own = self.components[component]
        return None if own is None else space.sub(own)

    def uniform_strain(self, component: int) -> Any:
        """None."""
        return None

    def nodal_space(self, unknown: Any) -> Any:
        """The unknown's own."""
        return unknown.function_space


class AxisymmetricKinematics(_Reduced):
    """A body of revolution about z that does not twist: u_r and u_z on the half-plane y = 0, x > 0.

    F = I + grad d + u_r/x e_y (x) e_y with d = u_r e_x + u_z e_z.
    """

    name = "axisymmetric"
    meaning = "a tube that stays one of revolution: u_r and u_z over radius and length"
    element_kind = "quadrilateral"
    components = (0, None, 1)
    cost = 0.3

    def unknown(self, mesh: Any, degree: int) -> Any:
        """(u_r, u_z), zero."""
        return lagrange(mesh, degree, (2,))

    def displacement(self, unknown: Any) -> Any:
        """u_r e_x + u_z e_z."""
        import ufl

        return ufl.as_vector([unknown[0], 0.0, unknown[1]])

    def deformation_gradient(self, unknown: Any) -> Any:
        """With the circumferential stretch 1 + u_r/r."""
        import ufl

        r, _, _ = ufl.SpatialCoordinate(self.mesh)
        return ufl.Identity(3) + ufl.grad(self.displacement(unknown)) + _along(1, unknown[0] / r)

    def weight(self, mesh: Any) -> Any:
        """2 pi r."""
        return _circumference(mesh)

    def nodal_displacement(self, unknown: Any) -> Array:
        """Of the nodes in the half-plane, (nodes, 3)."""
        values = unknown.x.array.reshape(-1, 2)
        return np.stack([values[:, 0], np.zeros(len(values)), values[:, 1]], axis=1)


class RadialKinematics(_Reduced):
    """A tube whose sections stay round, plane and alike: u_r on the x axis, and one axial stretch.

    F = diag(1 + du_r/dr, 1 + u_r/r, 1 + axial strain). The axial strain is prescribed.
    """

    name = "radial"
    meaning = "a tube whose sections stay round, plane and alike: u_r over the radius"
    element_kind = "interval"
    components = (None, None, None)
    cost = 0.2

    def __init__(self, mesh: Any = None, body: Body | None = None):
        super().__init__(mesh, body)
        if mesh is not None:
            self.axial_strain = _constant(mesh, 0.0)

    def unknown(self, mesh: Any, degree: int) -> Any:
        """u_r, zero."""
        return lagrange(mesh, degree, ())

    def displacement(self, unknown: Any) -> Any:
        """u_r e_x: the ray lies in the plane z = 0."""
        import ufl

        return ufl.as_vector([unknown, 0.0, 0.0])

    def deformation_gradient(self, unknown: Any) -> Any:
        """Diagonal."""
        import ufl

        r, _, _ = ufl.SpatialCoordinate(self.mesh)
        stretches = _along(1, unknown / r) + _along(2, self.axial_strain)
        return ufl.Identity(3) + ufl.grad(self.displacement(unknown)) + stretches

    def weight(self, mesh: Any) -> Any:
        """2 pi r times the length."""
        return self.axial_length * _circumference(mesh)

    def uniform_strain(self, component: int) -> Any:
        """The axial strain."""
        return self.axial_strain if component == 2 else None

    def nodal_displacement(self, unknown: Any) -> Array:
        """Of the nodes on the ray, (nodes, 3)."""
        return unknown.x.array[:, None] * np.array([1.0, 0.0, 0.0])


class PointKinematics(_Reduced):
    """A body with the same strain everywhere: three numbers u, F = I + diag(u)/length.

    Number i is the displacement along axis i at a distance of the body's length, so that it and its force have the same
    units as everywhere. The mesh is one bar along z as long as the body.
    """

    name = "point"
    meaning = "a cube or tendon with the same strain everywhere: three numbers"
    element_kind = "interval"
    components = (None, None, None)
    homogeneous = True
    cost = 0.2

    def unknown(self, mesh: Any, degree: int) -> Any:
        """Three numbers on the one element, zero."""
        import basix.ufl
        import dolfinx.fem

        self._nodes = lagrange(mesh, degree, ()).function_space
        element = basix.ufl.element("DG", mesh.topology.cell_name(), 0, shape=(3,))
        return dolfinx.fem.Function(dolfinx.fem.functionspace(mesh, element), name="displacement")

    def displacement(self, unknown: Any) -> Any:
        """u_i x_i / length."""
        import ufl

        x = ufl.SpatialCoordinate(self.mesh)
        return ufl.as_vector([unknown[i] * x[i] / self.axial_length for i in range(3)])

    def deformation_gradient(self, unknown: Any) -> Any:
        """Diagonal and constant."""
        import ufl

        stretches = (_along(i, unknown[i] / self.axial_length) for i in range(3))
        return sum(stretches, ufl.Identity(3))

    def weight(self, mesh: Any) -> Any:
        """Area of the section."""
        return self.section_area

    def nodal_space(self, unknown: Any) -> Any:
        """Continuous on the bar."""
        return self._nodes

    def nodal_displacement(self, unknown: Any) -> Array:
        """Of the nodes of the bar, (nodes, 3)."""
        assert self.body is not None
        places: Array = self._nodes.tabulate_dof_coordinates()
        # a rank without the element has neither nodes nor numbers
        return places * unknown.x.array.reshape(-1, 3)[:1] / self.body.axial_length if len(places) else places


def _constant(mesh: Any, value: float) -> Any:
    import dolfinx.fem
    from petsc4py import PETSc

    return dolfinx.fem.Constant(mesh, PETSc.ScalarType(value))  # type: ignore[attr-defined]


def _along(axis: int, value: Any) -> Any:
    """value e (x) e along an axis, UFL."""
    import ufl

    return ufl.as_tensor([[value if i == j == axis else 0.0 for j in range(3)] for i in range(3)])


def _circumference(mesh: Any) -> Any:
    """2 pi r on the half-plane y = 0."""
    import ufl

    return 2 * np.pi * ufl.SpatialCoordinate(mesh)[0]
