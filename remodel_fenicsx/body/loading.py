"""Supports and loads: boundary conditions, dead traction, follower pressure, elongation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import dolfinx.fem
import numpy as np
import ufl
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from remodel_fenicsx._renamed import with_old_arguments, with_old_names
from remodel_fenicsx.body.domain import Domain
from remodel_fenicsx.fem import jit
from remodel_fenicsx.fem.assembly import integral
from remodel_fenicsx.fem.kinematics import FullKinematics, Kinematics, field_degree
from remodel_fenicsx.model.tensors import Array
from remodel_fenicsx.schema.settings import Load
from remodel_fenicsx.schema.tables import SceneError

if TYPE_CHECKING:
    from dolfinx.fem import Constant, DirichletBC, Function
    from ufl.core.expr import Expr

    Potential = Callable[[Function], ufl.Form]

LoadValues = dict[str, float]


def values_of_loads(loads: Mapping[str, Load], time: float) -> LoadValues:
    """Return the magnitude of every load of a scene at a time."""
    return {name: load.value * load.factor(time) for name, load in loads.items()}


@with_old_names
class Loading:
    """Supports and loads of a body: boundary conditions, external forces, and their magnitudes.

    Parameters
    ----------
    domain
        The meshed body with its named faces.
    unknown
        dolfinx function of the unknowns.
    kinematics
        Meaning of the unknowns.

    Attributes
    ----------
    weight
        Volume of the body per unit of mesh, or area per unit of its faces (UFL), a factor of every
        term.
    boundary_conditions
        dolfinx Dirichlet conditions.
    values
        Current magnitude of each named load.
    has_caps
        Whether an internal pressure also acts on caps at the ends; a support sets it.

    Examples
    --------
    >>> from remodel_fenicsx import parts
    >>> domain = parts.Cube(side=2.0).build(parts.Mesh())
    >>> kinematics = parts.FullKinematics()
    >>> displacement = kinematics.unknown(domain.mesh, degree=1)
    >>> loading = parts.Loading(domain, displacement, kinematics)
    >>> for component, face in enumerate(("x0", "y0", "z0")):
    ...     loading.hold_face(face, component)
    >>> loading.add_dead_force("force", "z1", component=2)
    >>> loading.set({"force": 10.0})  # in the unit of stress times the unit of length squared
    >>> loading.values, round(loading.area("z1"), 12), len(loading.boundary_conditions)
    ({'force': 10.0}, 4.0, 3)
    """

    def __init__(self, domain: Domain, unknown: Function, kinematics: Kinematics | None = None):
        self.domain, self.unknown = domain, unknown
        self.kinematics = kinematics or FullKinematics()
        self.space = unknown.function_space
        self.weight = self.kinematics.weight(domain.mesh)
        self.boundary_conditions: list[DirichletBC] = []
        self.values: LoadValues = {}
        self._setters: dict[str, list[Callable[[float], None]]] = {}
        self._terms: list[Callable[[Function, ufl.Argument], ufl.Form]] = []
        self._potentials: list[Potential] = []
        self._begins: dict[int, str] = {}  # by component of uniform strain: first constrained face
        self.has_caps = False
        # by face: the potential of its springs, a function of u; None: fixed
        self.supports: dict[str, Potential | None] = {}

    # ------------------------------------------------------------ supports
    def hold_face(self, face: str, component: int) -> None:
        """Prescribe u_component = 0 on a named face.

        Parameters
        ----------
        face
            Name of the face in `Domain.faces`.
        component
            0, 1 or 2: x, y or z.

        Raises
        ------
        SceneError
            If the strain is one unknown and a face is constrained laterally: the body would bulge.
        """
        if self.kinematics.uniform_unknown(self.space, component) is None:
            self._prescribe_face(face, component, self.constant(0.0))
        elif face in self.domain.faces and component != 2:
            raise SceneError(
                f"model.kinematics = {self.kinematics.name!r}: {face} "
                "is constrained laterally, so the body bulges"
            )
        elif self._begins.setdefault(component, face) != face:
            self._prescribe_strain(component, self.constant(0.0))

    def hold_node(self, point: tuple[float, float, float], component: int) -> None:
        """Prescribe u_component = 0 at a mesh node, if the kinematics has rigid body modes.

        Parameters
        ----------
        point
            Reference position of the node, (3,), in the unit of length.
        component
            0, 1 or 2: x, y or z.

        Raises
        ------
        ValueError
            If the mesh has no node at `point`.
        """
        if not self.kinematics.has_rigid_modes:
            return
        tolerance = 1e-9 * self.domain.size
        subspace = self.kinematics.subspace(self.space, component)
        collapsed, _ = subspace.collapse()
        dofs = dolfinx.fem.locate_dofs_geometrical(
            (subspace, collapsed),
            lambda x: np.linalg.norm(x - np.reshape(point, (3, 1)), axis=0) < tolerance,
        )
        owned = subspace.dofmap.index_map.size_local * subspace.dofmap.index_map_bs
        number = self.domain.comm.allreduce(int(np.sum(dofs[0] < owned)), MPI.SUM)
        if number != 1:
            raise ValueError(f"{number} mesh nodes at {point}: a support needs exactly one")
        # With the dofs of the subspace only, the value is a Constant, as for faces.
        self._prescribe(self.constant(0.0), dofs[0], subspace)

    @partial(with_old_arguments, "hold_facets")
    def hold_facets(
        self, facets: NDArray[np.int32], name: str | None = None, direction: Array | float = 0.0
    ) -> None:
        """Prescribe u = magnitude times `direction` on local facets, for the full displacement.

        Parameters
        ----------
        facets
            Local numbers of the facets.
        name
            Name of the load that sets the magnitude; None: u = 0.
        direction
            Displacement at magnitude 1, (3,).

        Raises
        ------
        SceneError
            If the kinematics is not that of a mesh in three dimensions.
        """
        self._check_three_dimensional("fixed facets")
        for component, scale in enumerate(np.broadcast_to(direction, 3)):
            value = self.constant(0.0)
            self._prescribe_facets(facets, component, value)
            if name is not None:
                self._take(name, value, float(scale))

    # ------------------------------------------------------------ loads
    def add_dead_force(
        self, name: str, face: str, component: int, length: float | None = None
    ) -> None:
        """Add a dead load: a total force on a face along a coordinate axis.

        The nominal traction is constant, force over reference area.

        Parameters
        ----------
        name
            Name of the load. Its magnitude (`set`) is a force: stress times length squared.
        face
            Name of the face in `Domain.faces`.
        component
            0, 1 or 2: x, y or z.
        length
            Length of the body across the face, in the unit of length. With it, kinematics of
            uniform strain along this axis do not need the face.
        """
        uniform = self.kinematics.uniform_unknown(self.space, component)
        if length is not None and uniform is not None:
            dx = ufl.Measure("dx", domain=self.domain.mesh)
            # The force of one unknown is distributed over the volume.
            force = self.magnitude(name, length / uniform[1] / self._integral(dx))
            self.add_potential(lambda u: -force * u[component] * self.weight * dx)
            return
        traction, measure = self.magnitude(name, 1.0 / self.area(face)), self.surface_measure(face)
        self.add_term(lambda u, v: -traction * v[component] * self.weight * measure)

    def add_dead_traction(self, name: str, face: str, direction: Sequence[float]) -> None:
        """Add a dead load: a force per reference area of a face, in a fixed direction.

        Parameters
        ----------
        name
            Name of the load. Its magnitude (`set`) is a stress.
        face
            Name of the face in `Domain.faces`.
        direction
            Direction of the force, of any length, (3,).
        """
        traction = dolfinx.fem.Constant(self.domain.mesh, np.zeros(3, dtype=PETSc.ScalarType))
        self._take(name, traction, np.asarray(direction) / np.linalg.norm(direction))
        measure = self.surface_measure(face)
        self.add_term(lambda u, v: -ufl.inner(traction, v) * self.weight * measure)

    def add_follower_pressure(self, name: str, face: str) -> None:
        """Add a follower pressure: a pressure on the deformed face, against its outward normal.

        The term is p cof(F) N . v, with the exact linearisation.

        Parameters
        ----------
        name
            Name of the load. Its magnitude (`set`) is a stress.
        face
            Name of the face in `Domain.faces`.
        """
        pressure = self.magnitude(name)
        normal = ufl.FacetNormal(self.domain.mesh)
        measure = self.surface_measure(face)
        F = self.kinematics.deformation_gradient
        self.add_term(
            lambda u, v: pressure * ufl.inner(ufl.cofac(F(u)) * normal, v) * self.weight * measure
        )

    def add_cavity_pressure(self, name: str, face: str) -> None:
        """Add the pressure of a cavity between a face and two plane caps across z.

        The pressure acts on the deformed face and on the caps. Its potential is -p V with the
        volume V = -1/2 integral of (x e_x + y e_y) . cof(F) N over the face. The caps, whose
        normals are along z, do not contribute to V.

        Parameters
        ----------
        name
            Name of the load. Its magnitude (`set`) is a stress.
        face
            Name of the face in `Domain.faces`.
        """
        pressure = self.magnitude(name)
        normal, measure = ufl.FacetNormal(self.domain.mesh), self.surface_measure(face)

        def potential(u: Function) -> ufl.Form:
            place = ufl.SpatialCoordinate(self.domain.mesh) + self.kinematics.displacement(u)
            across = ufl.as_vector([place[0], place[1], 0.0])
            cofactor = ufl.cofac(self.kinematics.deformation_gradient(u))
            return pressure / 2 * ufl.inner(across, cofactor * normal) * self.weight * measure

        self.add_potential(potential)

    def lumen_volume(self, face: str, across: Array) -> tuple[Callable[[Function], Expr], float]:
        """Return the lumen's volume, per reference area of its face, and at the start. Collective.

        The volume is -1 times the integral of P x . cof(F) N over the face. P projects to the
        directions across the normals of all ends, over their number. So ends that stay in their
        planes do not contribute. Without such a direction the volume lacks the cones from the
        origin to the ends, which must not move. Its change is what the face sweeps on a straight
        path, by Simpson's rule, which is exact.

        Parameters
        ----------
        face
            Name of the face in `Domain.faces`.
        across
            Unit vectors across the normals of all ends as columns, (3, n).

        Returns
        -------
        function, float
            Function of the unknown that returns UFL, and the integral at the start.
        """
        mesh, number = self.domain.mesh, across.shape[1]
        projection = dolfinx.fem.Constant(mesh, across @ across.T / max(number, 1))
        place, normal = ufl.SpatialCoordinate(mesh), ufl.FacetNormal(mesh)

        def volume(u: Function) -> Expr:
            moved, F = self.kinematics.displacement(u), self.kinematics.deformation_gradient(u)
            end = ufl.cofac(F) * normal
            if number:
                return -ufl.inner(projection * (place + moved), end)
            middle = ufl.cofac((F + ufl.Identity(3)) / 2) * normal
            return -ufl.inner(place, normal) / 3 - ufl.inner(moved, normal + 4 * middle + end) / 6

        at_start = volume(dolfinx.fem.Function(self.space)) * self.weight
        return volume, integral(jit.form(at_start * self.surface_measure(face)))

    def add_lumen_expansion(self, name: str, face: str, across: Array, caps: float = 0.0) -> None:
        """Prescribe the volume of the lumen if its pressure is an unknown (`UnknownPressure`).

        Parameters
        ----------
        name
            Name of the load. Its magnitude (`set`) is V/V_0 - 1, without unit.
        face, across
            See `lumen_volume`.
        caps
            Volume of the cones from the origin to the ends, if `across` is empty.
        """
        pressure = getattr(self.kinematics, "lumen_pressure", None)
        if pressure is None:
            return
        (present, start), area = self.lumen_volume(face, across), self.area(face)
        change = self.magnitude(name, (start + caps) / area)
        before, measure = self.constant(start / area), self.surface_measure(face)
        normal, F = ufl.FacetNormal(self.domain.mesh), self.kinematics.deformation_gradient

        def residual(u: Function, test: ufl.Argument) -> ufl.Form:
            if self.has_caps:
                work = ufl.derivative(present(u), u, test)
            else:
                work = -ufl.inner(ufl.cofac(F(u)) * normal, self.kinematics.displacement(test))
            gap = present(u) - before - change
            return -(pressure(u) * work + pressure(test) * gap) * self.weight * measure

        self._terms.append(residual)

    def lumen_expansion(self, face: str, across: Array, caps: float = 0.0) -> Callable[[], float]:
        """Return a function for V/V_0 - 1 of the lumen; see `add_lumen_expansion`. Collective."""
        volume, start = self.lumen_volume(face, across)
        form = jit.form(volume(self.unknown) * self.weight * self.surface_measure(face))
        return lambda: (integral(form) - start) / (start + caps)

    def lumen_pressure(self) -> float:
        """Return the pressure in the lumen, a load or an unknown. Collective."""
        solved = getattr(self.kinematics, "pressure_value", None)
        return self.values.get("pressure", 0.0) if solved is None else float(solved(self.unknown))

    def add_axial_force(self, name: str) -> None:
        """Add a force on the ends along z if the length is an unknown (`FreeLength`)."""
        change = getattr(self.kinematics, "length_change", None)
        if change is None:
            return
        dx = ufl.Measure("dx", domain=self.domain.mesh)
        # The force is distributed over the volume, because the change of length has no position.
        force = self.magnitude(name, 1.0 / self._integral(dx))
        self.add_potential(lambda u: -force * change(u) * self.weight * dx)

    def add_prescribed_shear(self, name: str) -> None:
        """Prescribe F_xy = magnitude for kinematics of uniform strain.

        Parameters
        ----------
        name
            Name of the load. Its magnitude (`set`) is a number without unit.

        Raises
        ------
        SceneError
            If the kinematics has no uniform shear.
        """
        shear = self.kinematics.shear()
        if shear is None:
            raise SceneError(
                f"model.kinematics = {self.kinematics.name!r}: "
                "must be 'point' for a prescribed shear"
            )
        self._take(name, shear, 1.0)

    def add_prescribed_elongation(
        self, name: str, face: str, component: int, length: float
    ) -> None:
        """Prescribe u_component = elongation * length on a face, the engineering strain.

        Parameters
        ----------
        name
            Name of the load. Its magnitude (`set`) is a number without unit: 0.1 is 10 % longer.
        face
            Name of the face in `Domain.faces`.
        component
            0, 1 or 2: x, y or z.
        length
            Reference length, in the unit of length.
        """
        strain = self.kinematics.uniform_strain(component)
        if strain is not None:
            self._take(name, strain, 1.0)
        elif (unknown := self.kinematics.uniform_unknown(self.space, component)) is not None:
            self._prescribe_strain(component, self.magnitude(name, unknown[1]))
        else:
            self._prescribe_face(face, component, self.magnitude(name, length))

    def add_prescribed_displacement(
        self,
        name: str,
        face: str,
        displacement: Callable[[float, Array], Array],
        components: Sequence[int] = (0, 1, 2),
    ) -> None:
        """Prescribe u = displacement(magnitude, X) on a face, such as a rotation.

        Parameters
        ----------
        name
            Name of the load, whose magnitude `set` sets.
        face
            Name of the face in `Domain.faces`.
        displacement
            Function of the magnitude and of reference positions X (n, 3) that returns displacements
            (n, 3).
        components
            Prescribed components, from 0, 1 and 2: x, y and z. Other components are free.

        Raises
        ------
        SceneError
            If the kinematics is not that of a mesh in three dimensions.
        """
        self._check_three_dimensional("prescribed displacements")
        facets = self.domain.facets(face)
        for component in components:
            subspace = self.kinematics.subspace(self.space, component)
            collapsed, _ = subspace.collapse()
            dofs = dolfinx.fem.locate_dofs_topological((subspace, collapsed), 2, facets)
            value = dolfinx.fem.Function(collapsed)
            self._prescribe(value, dofs, subspace)
            places = collapsed.tabulate_dof_coordinates()[dofs[1]]
            self.follow(name, partial(_set_values, value, dofs[1], places, component, displacement))

    def follow(self, name: str, setter: Callable[[float], None]) -> None:
        """Register a function that is called with each new magnitude of a load.

        Parameters
        ----------
        name
            Name of the load.
        setter
            Function of the magnitude. It is called immediately with zero.
        """
        self._setters.setdefault(name, []).append(setter)
        self.values[name] = 0.0
        setter(0.0)

    def add_term(self, term: Callable[[Function, Expr], ufl.Form]) -> None:
        """Add any load as a term of the residual, minus its virtual work.

        Parameters
        ----------
        term
            Function of the unknown and of the virtual displacement, a 3-vector, that returns a UFL
            form: ``lambda u, v: -ufl.inner(b, v) * dx`` is a body force b per reference volume.
            The derivative with respect to the unknown enters the tangent.
        """
        self._terms.append(lambda u, test: term(u, self.kinematics.displacement(test)))

    def add_potential(self, potential: Potential) -> None:
        """Add any load as its potential, a function of the unknown that returns a UFL form."""
        self._potentials.append(potential)

    def magnitude(self, name: str, scale: float = 1.0) -> Constant:
        """Return a Constant that follows the load's magnitude times `scale`, for terms."""
        constant = self.constant(0.0)
        self._take(name, constant, scale)
        return constant

    def surface_measure(self, face: str) -> ufl.Measure:
        """Return the measure over a face of the mesh; `weight` makes it the body's."""
        measure = ufl.Measure("ds", domain=self.domain.mesh, subdomain_data=self.domain.facet_tags)
        degree = field_degree(self.space)
        return measure(self.domain.faces[face], metadata={"quadrature_degree": 2 * degree})

    def separate_measure(self, face: str) -> ufl.Measure:
        """Return `surface_measure` for forms of one face, which share their kernels."""
        mesh, facets = self.domain.mesh, self.domain.facets(face)
        ones = np.ones(len(facets), dtype=np.int32)
        tags = dolfinx.mesh.meshtags(mesh, mesh.topology.dim - 1, facets, ones)
        measure = ufl.Measure("ds", domain=mesh, subdomain_data=tags)
        return measure(1, metadata={"quadrature_degree": 2 * field_degree(self.space)})

    def external_residual(self, test: ufl.Argument) -> ufl.Form | None:
        """Return minus the external virtual work, a UFL form, or None without loads."""
        terms = [term(self.unknown, test) for term in self._terms]
        potentials = self.residual_of_potentials(test)
        terms += [] if potentials is None else [potentials]
        return sum(terms) if terms else None

    def residual_of_potentials(self, test: ufl.Argument) -> ufl.Form | None:
        """Return the residual of the loads with a potential, such as springs, or None."""
        terms = [
            ufl.derivative(potential(self.unknown), self.unknown, test)
            for potential in self._potentials
        ]
        return sum(terms) if terms else None

    def set(self, values: Mapping[str, float]) -> None:
        """Set the magnitudes of named loads.

        Parameters
        ----------
        values
            Magnitude of each load by name. A pressure has the unit of stress, a force that of
            stress times length squared.

        Raises
        ------
        KeyError
            If a name is not a load of this body.
        """
        for name, value in values.items():
            if name not in self.values:
                raise KeyError(name)
            for setter in self._setters.get(name, ()):
                setter(float(value))
            self.values[name] = float(value)

    def area(self, face: str) -> float:
        """Return the reference area of a named face. Collective."""
        return self._integral(self.separate_measure(face))

    # ------------------------------------------------------------ inside
    def _integral(self, measure: ufl.Measure) -> float:
        """Return the volume or area of the body over a measure. Collective."""
        return integral(jit.form(self.constant(1.0) * self.weight * measure))

    def constant(self, value: float) -> Constant:
        """Return a number as an argument of kernels, so that another value needs no compilation."""
        return dolfinx.fem.Constant(self.domain.mesh, PETSc.ScalarType(value))

    def _take(self, name: str, constant: Constant, scale: float | Array) -> None:
        """Set a constant to the load's magnitude times `scale`, now and at each change."""

        def set_value(magnitude: float) -> None:
            constant.value = magnitude * scale

        self.follow(name, set_value)

    def _check_three_dimensional(self, what: str) -> None:
        if not self.kinematics.three_dimensional:
            raise SceneError(
                f"model.kinematics = {self.kinematics.name!r}: must be 'full' for {what}"
            )

    def _prescribe_strain(self, component: int, value: Constant) -> None:
        number, _ = self.kinematics.uniform_unknown(self.space, component)
        self._prescribe(value, number.dofmap.list.flatten(), number)

    def _prescribe_face(self, face: str, component: int, value: Constant) -> None:
        if self.kinematics.subspace(self.space, component) is not None:
            self._prescribe_facets(self.domain.facets(face), component, value)

    def _prescribe_facets(self, facets: NDArray[np.int32], component: int, value: Constant) -> None:
        subspace = self.kinematics.subspace(self.space, component)
        dimension = self.domain.facet_tags.dim
        dofs = dolfinx.fem.locate_dofs_topological(subspace, dimension, facets)
        self._prescribe(value, dofs, subspace)

    def _prescribe(self, *values_dofs_space: Any) -> None:
        self.boundary_conditions.append(dolfinx.fem.dirichletbc(*values_dofs_space))


def _set_values(
    value: Function,
    dofs: NDArray[np.int32],
    places: Array,
    component: int,
    displacement: Callable[[float, Array], Array],
    magnitude: float,
) -> None:
    """Set one component of the values on a face for a magnitude."""
    value.x.array[dofs] = displacement(magnitude, places)[:, component]
