"""Kinematics: the unknowns of the deformation, and the deformation gradient."""

# For all other modules F is always 3x3, and a displacement always has three components. dolfinx is
# imported when it is needed: scenes, which name kinematics, are read without it.

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, TYPE_CHECKING

import numpy as np

from remodel_fenicsx._renamed import with_old_names
from remodel_fenicsx._lazy import Late
from remodel_fenicsx.model.tensors import Array

if TYPE_CHECKING:
    from dolfinx.fem import Constant, Function, FunctionSpace
    from dolfinx.mesh import Mesh
    from ufl.core.expr import Expr

ufl, basix_ufl = Late("ufl"), Late("basix.ufl")
fem = Late("dolfinx.fem")


@with_old_names
class Kinematics(ABC):
    """Meaning of the unknowns for forms, supports and results.

    Attributes
    ----------
    name
        Name in scenes.
    meaning
        Description for docs/scene.md.
    reduced
        Whether it needs another mesh, which a shape's `reductions` make, and is exact for some
        scenes only.
    three_dimensional
        Whether the unknown is the displacement field of a mesh in three dimensions: F = I + grad u.
    has_rigid_modes
        Whether the whole body can move across z or rotate about z. Supports at single nodes then
        constrain it.
    symmetry_planes
        Faces of the mesh that are planes of symmetry, and the component of the displacement that is
        zero there.
    homogeneous
        Whether the strain is the same everywhere, so that results do not depend on the mesh.
    suits_multigrid
        Whether algebraic multigrid converges for these unknowns.
    closed_ring
        Closed ring of a tube with residual stress (`model.residual_stress.ClosedRing`); otherwise
        None.
    grows
        Whether the tissue's volume changes in time (`volume_ratio`).
    number_of_constraints
        Number of unknowns that are multipliers of constraints, such as the pressure at a
        prescribed volume of the lumen. Each adds a negative eigenvalue to the tangent.
    cost
        Cost of a step per quadrature point, relative to a hexahedron, measured on the artery.

    Examples
    --------
    >>> from remodel_fenicsx.extend import KINEMATICS
    >>> {name: kinematics.reduced for name, kinematics in KINEMATICS.items()}
    {'full': False, 'sector': True, 'axisymmetric': True, 'radial': True, 'point': True}
    """

    name: ClassVar[str]
    meaning: ClassVar[str]
    reduced: ClassVar[bool] = True
    three_dimensional: ClassVar[bool] = False
    has_rigid_modes: ClassVar[bool] = False
    symmetry_planes: ClassVar[Mapping[str, int]] = {}
    homogeneous: ClassVar[bool] = False
    suits_multigrid: ClassVar[bool] = True
    cost: ClassVar[float] = 1.0
    closed_ring: Any = None
    grows: ClassVar[bool] = False
    number_of_constraints: ClassVar[int] = 0

    def element(self, kind: str) -> str:
        """Return the kind of the mesh's elements for the kind that the scene sets."""
        return kind

    def for_mesh(self, mesh: Mesh, body: Any) -> Kinematics:
        """Return the kinematics for the mesh of a body (`body.shape.Shape`)."""
        return self

    @abstractmethod
    def unknown(self, mesh: Mesh, degree: int) -> Function:
        """Return a dolfinx function of the unknowns, zero, with elements of this degree.

        Parameters
        ----------
        mesh
            dolfinx mesh.
        degree
            Degree of the elements, 1 or 2.
        """

    @abstractmethod
    def displacement(self, unknown: Function) -> Expr:
        """Return the displacement, a UFL 3-vector, linear in the unknown or test function."""

    @abstractmethod
    def deformation_gradient(self, unknown: Function) -> Expr:
        """Return F, UFL, always of shape (3, 3)."""

    def elastic(self, deformation_gradient: Expr) -> Expr:
        """Return F_e, UFL, of an F: F itself if the mesh is stress-free."""
        return deformation_gradient

    def elastic_gradient(self, unknown: Function) -> Expr:
        """Return F_e, UFL: the deformation gradient of the tissue."""
        return self.elastic(self.deformation_gradient(unknown))

    def stress_free_weight(self, mesh: Mesh) -> Expr | float:
        """Return the stress-free volume of the tissue per unit of mesh."""
        return self.weight(mesh)

    def weight(self, mesh: Mesh) -> Expr | float:
        """Return the body's volume per unit of mesh, a number or UFL; 1 if the mesh is the body."""
        return 1

    def subspace(self, space: FunctionSpace, component: int) -> Any:
        """Return the subspace of the unknown that a support in x, y or z constrains, or None.

        Parameters
        ----------
        space
            Function space of the unknown.
        component
            0, 1 or 2: x, y or z.
        """
        return space.sub(component)

    def uniform_strain(self, component: int) -> Constant | None:
        """Return the Constant of a prescribed uniform strain along x, y or z, or None."""
        return None

    def uniform_unknown(self, space: FunctionSpace, component: int) -> Any:
        """Return subspace, and value at strain 1, of an unknown uniform strain, or None."""
        return None

    def shear(self) -> Constant | None:
        """Return the Constant of a prescribed uniform F_xy, from now on a part of F, or None."""
        return None

    def nodal_space(self, unknown: Function) -> FunctionSpace:
        """Return a scalar or blocked space with the nodes in the order of `nodal_displacement`."""
        return unknown.function_space

    @abstractmethod
    def nodal_displacement(self, unknown: Function) -> Array:
        """Return the displacement of the local nodes, (nodes, 3)."""


class FullKinematics(Kinematics):
    """Displacement field in three dimensions: F = I + grad u.

    Examples
    --------
    >>> from remodel_fenicsx import parts
    >>> domain = parts.Cube(side=1.0).build(parts.Mesh())
    >>> kinematics = parts.FullKinematics()
    >>> displacement = kinematics.unknown(domain.mesh, degree=1)
    >>> kinematics.deformation_gradient(displacement).ufl_shape
    (3, 3)
    >>> kinematics.nodal_displacement(displacement).shape  # (nodes, 3)
    (8, 3)
    """

    name = "full"
    meaning = "the displacement in three dimensions"
    reduced = False
    three_dimensional = True
    has_rigid_modes = True

    def unknown(self, mesh: Mesh, degree: int) -> Function:
        """Return a vector function, zero."""
        return lagrange(mesh, degree, (3,))

    def displacement(self, unknown: Function) -> Expr:
        """Return the unknown itself."""
        return unknown

    def deformation_gradient(self, unknown: Function) -> Expr:
        """Return F = I + grad u."""
        return ufl.Identity(3) + ufl.grad(unknown)

    def nodal_displacement(self, unknown: Function) -> Array:
        """Return the unknown's own memory, (nodes, 3)."""
        return unknown.x.array.reshape(-1, 3)


# ---------------------------------------------------------------- reductions
# The mesh of a reduction is a part of the body at its position in space: a ray on the x axis, a
# half-plane in y = 0, a quarter, a bar along z next to the axis. There the radial, circumferential
# and axial directions are x, y and z. So axes of cells, normals and positions need no other
# coordinates, and tensors need no other basis.


class SectorKinematics(FullKinematics):
    """Displacement of a quarter of a tube between its planes of symmetry x = 0 and y = 0."""

    name = "sector"
    meaning = (
        "the displacement in three dimensions on a quarter of a tube, between planes of symmetry"
    )
    reduced = True
    has_rigid_modes = False
    symmetry_planes: ClassVar[Mapping[str, int]] = {"plane_x": 0, "plane_y": 1}

    def weight(self, mesh: Mesh) -> Expr | float:
        """Return 4, because four quarters are the body."""
        return 4


class _Reduced(Kinematics):
    """Kinematics with fewer dimensions."""

    element_kind: ClassVar[str]
    # Of the unknown, by component of the displacement.
    components: ClassVar[tuple[int | None, int | None, int | None]]

    def __init__(self, mesh: Any = None, body: Any = None):
        self.mesh, self.body = mesh, body
        # Constants, so that another body compiles nothing.
        if mesh is not None and body is not None:
            self.axial_length = _constant(mesh, body.axial_length)
            self.section_area = _constant(mesh, body.section_area)

    def element(self, kind: str) -> str:
        """Return the kind of elements with fewer dimensions."""
        return self.element_kind

    def for_mesh(self, mesh: Mesh, body: Any) -> Kinematics:
        """Return new kinematics, because their Constants belong to the mesh."""
        return type(self)(mesh, body)

    def subspace(self, space: FunctionSpace, component: int) -> Any:
        """Return the component's own subspace, or None if the component is no field."""
        own = self.components[component]
        return None if own is None else space.sub(own)


class AxisymmetricKinematics(_Reduced):
    """Body of revolution about z without twist: u_r and u_z on the half-plane y = 0, x > 0."""

    name = "axisymmetric"
    meaning = "u_r and u_z over radius and length of a tube that stays a body of revolution"
    element_kind = "quadrilateral"
    components = (0, None, 1)
    cost = 0.3

    def unknown(self, mesh: Mesh, degree: int) -> Function:
        """Return (u_r, u_z), zero."""
        return lagrange(mesh, degree, (2,))

    def displacement(self, unknown: Function) -> Expr:
        """Return u_r e_x + u_z e_z."""
        return ufl.as_vector([unknown[0], 0.0, unknown[1]])

    def deformation_gradient(self, unknown: Function) -> Expr:
        """Return F with the circumferential stretch 1 + u_r/r."""
        r, _, _ = ufl.SpatialCoordinate(self.mesh)
        return ufl.Identity(3) + ufl.grad(self.displacement(unknown)) + _along(1, unknown[0] / r)

    def weight(self, mesh: Mesh) -> Expr | float:
        """Return 2 pi r."""
        return _circumference(mesh)

    def nodal_displacement(self, unknown: Function) -> Array:
        """Return the displacement of the nodes in the half-plane, (nodes, 3)."""
        values = unknown.x.array.reshape(-1, 2)
        return np.stack([values[:, 0], np.zeros(len(values)), values[:, 1]], axis=1)


class RadialKinematics(_Reduced):
    """Tube with round, plane and equal sections: u_r on the x axis, and one axial stretch."""

    name = "radial"
    meaning = "u_r over the radius of a tube whose sections stay round, plane and alike"
    element_kind = "interval"
    components = (None, None, None)
    cost = 0.2

    def __init__(self, mesh: Any = None, body: Any = None):
        super().__init__(mesh, body)
        if mesh is not None:
            self.axial_strain = _constant(mesh, 0.0)

    def unknown(self, mesh: Mesh, degree: int) -> Function:
        """Return the radial displacement u_r, zero."""
        return lagrange(mesh, degree, ())

    def displacement(self, unknown: Function) -> Expr:
        """Return u_r e_x, because the ray lies in the plane z = 0."""
        return ufl.as_vector([unknown, 0.0, 0.0])

    def deformation_gradient(self, unknown: Function) -> Expr:
        """Return F, a diagonal tensor."""
        r, _, _ = ufl.SpatialCoordinate(self.mesh)
        stretches = _along(1, unknown / r) + _along(2, self.axial_strain)
        return ufl.Identity(3) + ufl.grad(self.displacement(unknown)) + stretches

    def weight(self, mesh: Mesh) -> Expr | float:
        """Return 2 pi r times the length."""
        return self.axial_length * _circumference(mesh)

    def uniform_strain(self, component: int) -> Constant | None:
        """Return the axial strain, or None for other components."""
        return self.axial_strain if component == 2 else None

    def subspace(self, space: FunctionSpace, component: int) -> Any:
        """Return the whole space for x, otherwise None."""
        return space if component == 0 else None

    def nodal_displacement(self, unknown: Function) -> Array:
        """Return the displacement of the nodes on the ray, (nodes, 3)."""
        return unknown.x.array[:, None] * np.array([1.0, 0.0, 0.0])


class PointKinematics(_Reduced):
    """Body with uniform strain: three numbers u, F = I + diag(u)/length, and F_xy if prescribed."""

    name = "point"
    meaning = "three numbers, for a cube, tendon or sheet with the same strain everywhere"
    element_kind = "interval"
    components = (None, None, None)
    homogeneous = True
    cost = 0.2
    _shear: Constant | None = None

    def unknown(self, mesh: Mesh, degree: int) -> Function:
        """Return three numbers on the only element, zero."""
        self._nodes = lagrange(mesh, degree, ()).function_space
        return lagrange(mesh, 0, (3,), "DG")

    def displacement(self, unknown: Function) -> Expr:
        """Return u_i x_i / length."""
        x = ufl.SpatialCoordinate(self.mesh)
        return ufl.as_vector([unknown[i] * x[i] / self.axial_length for i in range(3)])

    def deformation_gradient(self, unknown: Function) -> Expr:
        """Return F, constant and diagonal except for F_xy."""
        stretches = (_along(i, unknown[i] / self.axial_length) for i in range(3))
        F = sum(stretches, ufl.Identity(3))
        return (
            F
            if self._shear is None
            else F + ufl.as_tensor([[0, self._shear, 0], [0, 0, 0], [0, 0, 0]])
        )

    def shear(self) -> Constant | None:
        """Return the Constant F_xy, from now on a part of F."""
        self._shear = _constant(self.mesh, 0.0) if self._shear is None else self._shear
        return self._shear

    def uniform_unknown(self, space: FunctionSpace, component: int) -> Any:
        """Return the subspace of the number along the axis, and the length."""
        return space.sub(component), self.body.axial_length

    def weight(self, mesh: Mesh) -> Expr | float:
        """Return the area of the section."""
        return self.section_area

    def nodal_space(self, unknown: Function) -> FunctionSpace:
        """Return the continuous space on the bar."""
        return self._nodes

    def nodal_displacement(self, unknown: Function) -> Array:
        """Return the displacement of the nodes of the bar, (nodes, 3)."""
        places = self._nodes.tabulate_dof_coordinates()
        # a rank without the element has neither nodes nor numbers
        return (
            places * unknown.x.array.reshape(-1, 3)[:1] / self.body.axial_length
            if len(places)
            else places
        )


KINEMATICS: dict[str, Kinematics] = {
    kind.name: kind()
    for kind in (
        FullKinematics,
        SectorKinematics,
        AxisymmetricKinematics,
        RadialKinematics,
        PointKinematics,
    )
}
"""Kinematics by their name in scenes."""


# ---------------------------------------------------------------- natural configuration


class _KinematicsWrapper:
    """Wrapper of other kinematics, `field`, for all that the subclass does not define."""

    field: Kinematics

    def __getattr__(self, name: str) -> Any:
        if name == "field":  # it is missing during a copy
            raise AttributeError(name)
        return getattr(self.field, name)

    def elastic_gradient(self, unknown: Function) -> Expr:
        """Return F_e, UFL: the deformation gradient of the tissue."""
        return self.elastic(self.deformation_gradient(unknown))


@with_old_names
class NaturalConfiguration(_KinematicsWrapper):
    """Body with a stress-free (natural) configuration; G leads from it to the mesh, F_e = F G."""

    # G of growing tissue changes in time. `initial` is G at the start, to whose volume all amounts
    # refer.

    def __init__(
        self,
        kinematics: Kinematics,
        gradient: Expr,
        closed_ring: Any,
        initial: Expr | None,
    ):
        self.field, self.gradient = kinematics, gradient
        self.closed_ring = closed_ring
        self.initial, self.grows = (gradient, False) if initial is None else (initial, True)

    def elastic(self, deformation_gradient: Expr) -> Expr:
        """Return F_e = F G."""
        return ufl.dot(deformation_gradient, self.gradient)

    def stress_free_weight(self, mesh: Mesh) -> Expr | float:
        """Return the mesh's weight over det G at the start."""
        return self.field.weight(mesh) / ufl.det(self.initial)

    def volume_ratio(self) -> Expr:
        """Return J_g, the volume ratio of growth since the start, UFL."""
        return ufl.det(self.initial) / ufl.det(self.gradient)


# ---------------------------------------------------------------- numbers as unknowns


class _WithNumbers(_KinematicsWrapper):
    """Body with further unknowns, numbers with the unit of a length."""

    suits_multigrid = False  # GMRES with GAMG does not converge if a row is full
    count: ClassVar[int] = 1

    def __init__(self, kinematics: Kinematics, body: Any, pressure_scale: float = 0.0):
        self.field, self.body = kinematics, body
        self.pressure_scale = pressure_scale

    def unknown(self, mesh: Mesh, degree: int) -> Function:
        """Return the field and the numbers, zero. Collective."""
        element = self.field.unknown(mesh, degree).function_space.ufl_element()
        numbers = self.count * [basix_ufl.element("DG", mesh.topology.cell_name(), 0)]
        space = fem.functionspace(mesh, basix_ufl.mixed_element([element, *numbers]))
        for component in range(1, self.count + 1):
            space = global_constant_space(space, component)
        nodes, self._dofs = space.sub(0).collapse()
        self._nodal = fem.Function(nodes)
        return fem.Function(space, name="displacement")

    def displacement(self, unknown: Function) -> Expr:
        """Return the field's displacement."""
        return self.field.displacement(ufl.split(unknown)[0])

    def deformation_gradient(self, unknown: Function) -> Expr:
        """Return the field's F."""
        return self.field.deformation_gradient(ufl.split(unknown)[0])

    def subspace(self, space: FunctionSpace, component: int) -> Any:
        """Return the field's subspace, or None."""
        return self.field.subspace(space.sub(0), component)

    def nodal_space(self, unknown: Function) -> FunctionSpace:
        """Return the field's nodal space."""
        return self.field.nodal_space(self._nodal)

    def nodal_displacement(self, unknown: Function) -> Array:
        """Return the displacement of the local nodes, (nodes, 3). Collective."""
        self._nodal.x.array[:] = unknown.x.array[self._dofs]
        return self.field.nodal_displacement(self._nodal).copy()

    def _number(self, unknown: Function, component: int) -> float:
        """Return a number, the same on every rank. Collective."""
        from mpi4py import MPI

        space = unknown.function_space
        dofs = space.sub(component).dofmap.list.flatten()
        here = float(unknown.x.array[dofs[0]]) if len(dofs) else -np.inf
        return space.mesh.comm.allreduce(here, MPI.MAX)


class FreeLength(_WithNumbers):
    """Body whose length is an unknown too, for a prescribed axial force or pressure on end caps."""

    def unknown(self, mesh: Mesh, degree: int) -> Function:
        """Return (u, e), zero. Collective."""
        self._length = _constant(mesh, self.body.axial_length)
        return super().unknown(mesh, degree)

    def length_change(self, unknown: Function) -> Expr:
        """Return the change of length e, UFL, linear in the unknown."""
        return ufl.split(unknown)[1]

    def displacement(self, unknown: Function) -> Expr:
        """Return u + e z/length e_z."""
        z = ufl.SpatialCoordinate(unknown.ufl_function_space().mesh)[2]
        along = self.length_change(unknown) * z / self._length
        return super().displacement(unknown) + ufl.as_vector([0.0, 0.0, along])

    def deformation_gradient(self, unknown: Function) -> Expr:
        """Return the field's F plus e/length along z."""
        F = super().deformation_gradient(unknown)
        return F + _along(2, self.length_change(unknown) / self._length)

    def nodal_displacement(self, unknown: Function) -> Array:
        """Return the displacement of the local nodes, (nodes, 3). Collective."""
        places = self.nodal_space(unknown).tabulate_dof_coordinates()
        displacement = super().nodal_displacement(unknown)
        displacement[:, 2] += self.strain_of_length(unknown) * places[:, 2]
        return displacement

    def strain_of_length(self, unknown: Function) -> float:
        """Return e/length, the same on every rank. Collective."""
        return self._number(unknown, 1) / self.body.axial_length


class UnknownPressure(_WithNumbers):
    """Body whose lumen has a prescribed volume, by a pressure that is an unknown too."""

    number_of_constraints = 1

    def unknown(self, mesh: Mesh, degree: int) -> Function:
        """Return the field and the pressure over its scale, zero. Collective."""
        self._scale = _constant(mesh, self.pressure_scale)
        return super().unknown(mesh, degree)

    def lumen_pressure(self, unknown: Function) -> Expr:
        """Return the pressure, UFL, linear in the unknown."""
        return self._scale * ufl.split(unknown)[-1]

    def pressure_value(self, unknown: Function) -> float:
        """Return the pressure, the same on every rank. Collective."""
        return self.pressure_scale * self._number(unknown, self.count)


class UnknownLengthAndPressure(UnknownPressure, FreeLength):
    """Body whose length and pressure in the lumen are unknowns too."""

    count = 2


WITH_NUMBERS = {
    (True, False): FreeLength,
    (False, True): UnknownPressure,
    (True, True): UnknownLengthAndPressure,
}
"""Kinematics by whether the length and the pressure are unknowns."""


def global_constant_space(space: FunctionSpace, component: int) -> FunctionSpace:
    """Return a mixed space whose DG0 component has one value for the whole mesh. Collective."""
    # The first rank with elements owns the value; it is a ghost on all other ranks with elements.
    import dolfinx.la
    from mpi4py import MPI

    from remodel_fenicsx.fem import compat

    dofmap, comm = space.dofmap, space.mesh.comm
    old = dofmap.index_map
    is_one = np.zeros(old.size_local + old.num_ghosts, dtype=bool)
    is_one[space.sub(component).dofmap.list.flatten()] = True
    owned, ghosts = ~is_one[: old.size_local], ~is_one[old.size_local :]
    has_elements = len(dofmap.list) > 0
    owner = comm.allreduce(comm.rank if has_elements else comm.size, MPI.MIN)
    is_owner = comm.rank == owner
    size = int(owned.sum()) + is_owner
    offset = comm.exscan(size) or 0
    numbers = dolfinx.la.vector(old, 1, dtype=np.float64)  # exact for integers
    numbers.array[: old.size_local][owned] = offset + np.arange(owned.sum())
    numbers.scatter_forward()
    one = comm.bcast(offset + int(owned.sum()), root=owner)
    is_ghost = has_elements and not is_owner
    new_ghosts = numbers.array[old.size_local :][ghosts].astype(np.int64)
    owners = old.owners[ghosts]
    if is_ghost:
        new_ghosts, owners = np.append(new_ghosts, one), np.append(owners, owner)
    place = np.zeros(len(is_one), dtype=np.int32)
    place[: old.size_local][owned] = np.arange(owned.sum())
    place[old.size_local :][ghosts] = size + np.arange(ghosts.sum())
    place[is_one] = size - 1 if is_owner else size + ghosts.sum()
    return compat.space_with_dofs(
        space, size, new_ghosts, owners.astype(np.int32), place[dofmap.list]
    )


def field_degree(space: FunctionSpace) -> int:
    """Return the polynomial degree of the unknown's field, without an additional number."""
    element = space.ufl_element()
    return int((element.sub_elements or [element])[0].degree)


# ---------------------------------------------------------------- building blocks


def lagrange(mesh: Mesh, degree: int, shape: tuple[int, ...], family: str = "Lagrange") -> Function:
    """Return a function "displacement", zero, with values of this shape; by default continuous."""
    element = basix_ufl.element(family, mesh.topology.cell_name(), degree, shape=shape)
    return fem.Function(fem.functionspace(mesh, element), name="displacement")


def _constant(mesh: Mesh, value: float) -> Constant:
    from petsc4py import PETSc

    return fem.Constant(mesh, PETSc.ScalarType(value))  # type: ignore[attr-defined]


def _along(axis: int, value: Expr) -> Expr:
    """Return value e (x) e along an axis, UFL."""
    return ufl.as_tensor([[value if i == j == axis else 0.0 for j in range(3)] for i in range(3)])


def _circumference(mesh: Mesh) -> Expr:
    """Return 2 pi r on the half-plane y = 0."""
    return 2 * np.pi * ufl.SpatialCoordinate(mesh)[0]
