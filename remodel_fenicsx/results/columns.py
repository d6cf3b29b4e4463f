"""The rows of a run's history: every column measured on a solved state."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from numbers import Real
from typing import Any, NamedTuple, TypeVar

import dolfinx.fem
import numpy as np
import ufl
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx._renamed import with_old_names
from remodel_fenicsx.body.shape import Column, Shape, columns_of
from remodel_fenicsx.body.domain import Domain
from remodel_fenicsx.errors import RemodelError
from remodel_fenicsx.evolution.stepper import Step, Watcher
from remodel_fenicsx.fem import compat, jit
from remodel_fenicsx.fem.assembly import integral, allreduce
from remodel_fenicsx.fem.quadrature import Quadrature
from remodel_fenicsx.model.drivers import DRIVERS
from remodel_fenicsx.model.tensors import Array, Flags
from remodel_fenicsx.schema.tables import SceneError, format_value
from remodel_fenicsx.solver.equilibrium import Equilibrium, PointStresses

T = TypeVar("T")
NO_LUMEN = 1e-9  # of the body's size cubed: a flat inner face encloses that by rounding


class Observer(Watcher):
    """A watcher that fills every step's row.

    Parameters
    ----------
    shape
        Body shape, which defines the columns and the fibre angle.
    stepper
        Time stepper with the measured state and its further load cases; stays unchanged.
    columns
        Columns to use instead of `columns_of(shape)` with the scene's loads.

    Examples
    --------
    A simulation has one; its rows are the history:

    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> simulation = Simulation(preset_scene("kuhl-holzapfel-2007", "cube"))
    >>> [column.name for column in simulation.observer.columns][:4]
    ['time', 'force', 'mean_stretch', 'min_stretch']
    >>> for _, step in zip(range(2), simulation.steps()):
    ...     print(step.row["force"], round(step.row["max_stretch"], 4))
    1.0 1.0808
    2.0 1.1717
    """

    def __init__(self, shape: Shape, stepper: Any, columns: Sequence[Column] | None = None):
        self.shape, self.stepper = shape, stepper
        self.state = stepper.state
        if columns is None:
            columns = columns_of(shape, loads=self.state.loading.values)
        self.columns = tuple(columns)
        self.quadrature: Quadrature = self.state.cells.quadrature
        self.domain: Domain = self.state.loading.domain
        self.tools: dict[object, Any] = {}
        self.others = [Observer(shape, case, ()) for case in stepper.load_cases[1:]]

    # ------------------------------------------------------------ as a watcher
    def started(self, step: Step) -> None:
        """Measure the start, which compiles every form that a column needs."""
        self.solved(step)
        self.completed(step)

    def resumed(self, step: Step) -> None:
        """Compile every form that a column needs; this row is not recorded."""
        self.started(step)

    def solved(self, step: Step) -> None:
        """Measure the solved state."""
        step.row |= {column.name: np.nan for column in self.columns}
        self._fill(step, after_pass=False)

    def completed(self, step: Step) -> None:
        """Fill in the columns that are known only after the remodeling pass."""
        self._fill(step, after_pass=True)

    def _fill(self, step: Step, after_pass: bool) -> None:
        measurement = Measurement(self, step)
        for column in self.columns:
            if column.after_pass == after_pass:
                value = column.value(measurement)
                if not isinstance(value, Real) or np.isinf(value):
                    error = RemodelError(
                        f"the column {column.name!r} is {format_value(value)} "
                        f"at time {step.time:g}: must be a finite number, or nan if there is none"
                    )
                    error.on_all_ranks = False
                    raise error
                step.row[column.name] = float(value)


@with_old_names
class Measurement:
    """Quantities of a step for columns; each is computed once, when a column first needs it.

    Parameters
    ----------
    observer
        Observer that the measurement belongs to.
    step
        The step.

    Attributes
    ----------
    step
        The step.
    observer
        Observer that the measurement belongs to.
    domain, quadrature, state
        Body, quadrature points and state.

    Examples
    --------
    A column's function gets one; here in a watcher:

    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> from remodel_fenicsx.extend import Measurement
    >>> simulation = Simulation(preset_scene("kuhl-holzapfel-2007", "cube"))
    >>> for _, step in zip(range(1), simulation.steps()):
    ...     measured = Measurement(simulation.observer, step)
    >>> measured.displacement.shape, measured.fibre_angle.shape  # (nodes, 3), (elements, points)
    ((8, 3), (1, 8))
    >>> round(measured.face_mean("z1", measured.position[:, 2]), 4)
    1.0808
    >>> round(measured.face_area("z1"), 4)
    1.0
    """

    def __init__(self, observer: Observer, step: Step):
        self.step, self.observer = step, observer
        self._of_step: dict[object, Any] = {}
        self.domain, self.quadrature = observer.domain, observer.quadrature
        self.state = observer.state

    @property
    def equilibrium(self) -> Equilibrium:
        """Equilibrium with the forms of the solved state."""
        coupling = self.observer.stepper.coupling
        return coupling.equilibrium

    @cached_property
    def displacement(self) -> Array:
        """Displacement of the local nodes, (nodes, 3)."""
        return self.state.kinematics.nodal_displacement(self.state.unknown)

    @cached_property
    def position(self) -> Array:
        """Deformed position of the local nodes, (nodes, 3)."""
        nodes: Array = self.state.kinematics.nodal_space(
            self.state.unknown
        ).tabulate_dof_coordinates()
        return nodes + self.displacement

    @cached_property
    def F(self) -> Array:  # noqa: N802
        """Deformation gradient at all points, (elements, points, 3, 3)."""
        return self.state.deformation_gradient().reshape(*self.quadrature.shape, 3, 3)

    @cached_property
    def stress(self) -> Array:
        """Cauchy stress with formulation and repulsion terms, (elements, points, 3, 3)."""
        stepper = self.observer.stepper
        if stepper.remodeling.law.remodels and stepper.remodeling.driver is DRIVERS["cauchy"]:
            # the pass needs the same tensor
            return stepper.remodeling.driving_tensor()[1].reshape(*self.quadrature.shape, 3, 3)

        return self._cauchy_stress()

    def _cauchy_stress(self, of_collagen: bool = False) -> Array:
        def compiled() -> tuple[PointStresses, list[dolfinx.fem.Expression]]:
            stresses = PointStresses(self.state, self.observer.stepper.tissue)
            part = stresses.ufl.collagen if of_collagen else stresses.ufl
            assert part is not None
            return stresses, jit.expression(part.cauchy, self.quadrature.points)

        stresses, expression = self.cached(("cauchy stress", of_collagen), compiled)
        stresses.refresh()
        return self.quadrature.evaluate(expression, (3, 3))

    @cached_property
    def wall_stress(self) -> Array:
        """Cauchy stress around, along and across the wall at all points, (elements, points, 3)."""
        return self._in_the_wall(self.stress)

    @cached_property
    def collagen_wall_stress(self) -> Array:
        """Part of `wall_stress` that the network bears, (elements, points, 3)."""
        stepper = self.observer.stepper
        if stepper.tissue.chain is None:
            return np.zeros_like(self.wall_stress)
        return self._in_the_wall(self._cauchy_stress(of_collagen=True))

    def _in_the_wall(self, stress: Array) -> Array:
        cells = self.state.cells
        axes = cells.local_axes.deformed(self.F)
        return np.einsum("...ki,...ij,...kj->...k", axes, stress, axes)

    @cached_property
    def elastin_stretches(self) -> Array:
        """Stretches F G G_e around, along and across the wall, (elements, points, 3)."""
        tissue = self.equilibrium.parameters.at_points()
        cells = self.state.cells
        moved = np.einsum("...ij,...kj->...ki", self.state.elastic(self.F), cells.local_axes.axes)
        stretches = np.linalg.norm(moved, axis=-1)
        return (stretches.reshape(-1, 3) * tissue.elastin_prestretch).reshape(stretches.shape)

    @cached_property
    def fibre_angle(self) -> Array:
        """Reference fibre angle at all points, (elements, points), degrees; NaN without chains."""
        cells = self.state.cells
        return self._angle(cells.axis_values, cells.local_axes.axes)

    @cached_property
    def fibre_angle_unloaded(self) -> Array:
        """Fibre angle in the unloaded body, at all points (elements, points), degrees."""
        cells = self.state.cells
        axes = self.state.elastic_axes(cells.axis_values)
        return self._angle(axes, cells.local_axes.axes)

    @cached_property
    def fibre_angle_deformed(self) -> Array:
        """Fibre angle in the deformed configuration, (elements, points), degrees."""
        cells = self.state.cells
        axes = self.state.elastic_axes(cells.axis_values, self.F)
        return self._angle(axes, cells.local_axes.deformed(self.F))

    @cached_property
    def radial_share(self) -> Array:
        """Radial fraction of the chains at all points, (elements, points)."""
        cells = self.state.cells
        share = self.observer.shape.radial_share(
            cells.dimension_values, cells.axis_values, cells.local_axes.axes
        )
        return self.equilibrium.parameters.nan_without_chains(share)

    def _angle(self, axes: Array, local: Array) -> Array:
        angle = self.observer.shape.fibre_angle(self.state.cells.dimension_values, axes, local)
        return self.equilibrium.parameters.nan_without_chains(angle)

    @cached_property
    def chain_extension(self) -> Array:
        """r/L at all points (elements, points); 0 where no chain locks."""
        cells, F = self.state.cells, self.state.elastic_gradient()
        length = self.equilibrium.parameters.locking_length()
        squared = cells.kernels.squared_length(F, cells.point_cells).reshape(length.shape)
        return np.sqrt(squared) / length

    def elements_of_region(self, name: str) -> Flags:
        """Return a mask of the local elements of a region, (elements,)."""
        return self.domain.element_region == self.domain.regions[name]

    @cached_property
    def axial_stretch(self) -> Array:
        """Volume mean of F_zz in each local element, (elements,)."""
        return self.quadrature.element_mean(self.F[..., 2, 2])

    def face_mean(self, face: str, nodal_values: Array, deformed: bool = False) -> float:
        """Compute the mean of nodal values over a named face, by reference or deformed area.

        Parameters
        ----------
        face
            Name from `Domain.faces`.
        nodal_values
            Values at the local nodes, (nodes,); the mean is in their unit.
        deformed
            Whether to average by the deformed area.
        """
        weighted, area = self._over_face(face, deformed, nodal_values, 1.0)
        return weighted / area

    def face_area(self, face: str, deformed: bool = False) -> float:
        """Compute the reference or deformed area of a named face."""
        return self._over_face(face, deformed, 1.0)[0]

    def _over_face(self, face: str, deformed: bool, *nodal_values: Array | float) -> list[float]:
        field, form = self.cached((face, deformed), lambda: _face_form(self, face, deformed))
        block_size = field.function_space.dofmap.index_map_bs
        at_nodes, integrals = field.x.array.reshape(-1, block_size)[:, 0], []
        for values in nodal_values:
            at_nodes[:] = values
            integrals.append(integral(form))
        return integrals

    def end_force(self, face: str) -> EndForce:
        """Compute the force at the end z = length of a tube.

        Parameters
        ----------
        face
            Name of the tube's inner face.
        """

        def measured() -> EndForce:
            groups = self.cached(("end force", face), lambda: _end_forms(self, face))
            if self.equilibrium.pointwise is not None:
                self.equilibrium.pointwise.update()
            return EndForce(*(sum(map(integral, group)) for group in groups))

        return self.cached_for_step(("end force", face), measured)

    def support_force(self, face: str) -> float:
        """Compute the force by which the support of a face pulls a user-supplied body.

        The force is along the mean normal of each connected part of the face.

        Parameters
        ----------
        face
            Name from `Domain.faces`.
        """
        return self.cached(("support", face), lambda: _support_force(self.equilibrium, face))()

    def lumen_volume(self) -> float:
        """Compute the volume inside the deformed inner face, with flat caps on its rims.

        Only for a user-supplied body (`MeshDomain`).
        """
        return self.cached("lumen volume", lambda: _lumen_volume(self.observer))()

    def largest(self, values: Array) -> float:
        """Return the largest of one value per local element, over all ranks.

        Parameters
        ----------
        values
            One value per local element, (elements,).
        """
        return self.quadrature.maximum(values)

    def smallest(self, values: Array) -> float:
        """Return the smallest of one value per local element, over all ranks.

        Parameters
        ----------
        values
            One value per local element, (elements,).
        """
        return self.quadrature.minimum(values)

    def elements_touching_radius(self, radius: float) -> Flags:
        """Return a mask of the local elements at a radius from the z axis, (elements,)."""

        def touch() -> Flags:
            mesh = self.domain.mesh
            nodes = mesh.geometry.x[compat.geometry_dofmap(mesh)]
            radii, tolerance = np.linalg.norm(nodes[..., :2], axis=-1), 1e-6 * self.domain.size
            return (radii.min(axis=1) <= radius + tolerance) & (
                radii.max(axis=1) >= radius - tolerance
            )

        return self.cached(("elements touching", radius), touch)  # type: ignore[no-any-return]

    def of_case(self, number: int) -> Measurement:
        """Return the measurement of the same step in another load case.

        Parameters
        ----------
        number
            Number of the load case, from 1.
        """

        def measured() -> Measurement:
            observer = self.observer.others[number - 2]
            return Measurement(observer, observer.stepper.seen(self.step))

        if number == 1:
            return self
        return self.cached_for_step(("case", number), measured)  # type: ignore[no-any-return]

    def cached(self, key: object, make: Callable[[], T]) -> T:
        """Return an object that a column needs at every step, for example a compiled form.

        The first call for a key stores the result of make().
        """
        if key not in self.observer.tools:
            self.observer.tools[key] = make()
        return self.observer.tools[key]

    def cached_for_step(self, key: object, make: Callable[[], T]) -> T:
        """Return an object that several columns of this step use: make() runs once for the step."""
        if key not in self._of_step:
            self._of_step[key] = make()
        return self._of_step[key]


def _face_form(
    measured: Measurement, face: str, deformed: bool
) -> tuple[dolfinx.fem.Function, dolfinx.fem.Form]:
    """Make a nodal field, and its integral over the reference or deformed area of a face."""
    state, mesh = measured.state, measured.domain.mesh
    # first component of a function of the displacement's space, which has the same order of nodes
    field = dolfinx.fem.Function(state.kinematics.nodal_space(state.unknown))
    value, normal = field[0] if field.ufl_shape else field, ufl.FacetNormal(mesh)
    F = state.kinematics.deformation_gradient(state.unknown)
    stretched = ufl.cofac(F) * normal if deformed else normal
    weight = ufl.sqrt(ufl.inner(stretched, stretched)) * state.kinematics.weight(mesh)
    return field, jit.form(value * weight * state.loading.separate_measure(face))


def _lumen_volume(observer: Observer) -> Callable[[], float]:
    """Return a function for -1/3 integral of x . cof(F) N over the inner face, plus flat caps."""
    domain: Any = observer.domain  # a `MeshDomain`
    state, mesh = observer.state, domain.mesh
    middle = domain.boundary.parts("inner")[0].centre
    nodes = domain.gather_nodes(mesh.geometry.x - middle)
    place = ufl.SpatialCoordinate(mesh) - dolfinx.fem.Constant(mesh, middle)
    place += state.kinematics.displacement(state.unknown)
    normal = ufl.cofac(state.kinematics.deformation_gradient(state.unknown)) * ufl.FacetNormal(mesh)
    form = jit.form(-ufl.inner(place, normal) / 3 * state.loading.separate_measure("inner"))

    def volume() -> float:
        displacement = state.gathered_displacement()
        places = None if displacement is None else nodes + displacement
        enclosed = integral(form) + domain.caps(places)
        return enclosed if abs(enclosed) > NO_LUMEN * domain.size**3 else math.nan

    return volume


def _support_force(equilibrium: Equilibrium, face: str) -> Callable[[], float]:
    """Return a function for the force of springs, or of constrained nodes, along the normal."""
    state, unknown = equilibrium.state, equilibrium.state.unknown
    domain: Any = state.loading.domain  # a `MeshDomain`
    if domain.boundary.goes_around(face):
        raise SceneError(
            f"output.columns = 'support_force_{face}': the face goes around the body, "
            "so that the force has no direction; choose a part of it, or another face"
        )
    if (potential := state.loading.supports[face]) is not None:
        along = [*domain.of_parts(face, "normal"), *(len(unknown) - 3) * [0.0]]
        form = jit.form(-ufl.derivative(potential(unknown), unknown, ufl.as_vector(along)))
        return lambda: integral(form)
    held: list[tuple[NDArray[np.int32], float]] = []
    for part, facets in domain.facets_of_parts(face):
        for component, weight in enumerate(part.normal.tolist()):
            subspace = state.kinematics.subspace(unknown.function_space, component)
            dofs = dolfinx.fem.locate_dofs_topological(subspace, 2, facets)
            held.append((dofs[dofs < state.number_of_owned_unknowns], weight))

    def out_of_balance() -> float:
        vectors = [unknown.x.petsc_vec.duplicate() for _ in range(2)]
        equilibrium.assemble_internal(vectors[0])
        equilibrium.assemble_external(vectors[1])
        forces = vectors[0].array + vectors[1].array
        for vector in vectors:
            vector.destroy()
        return float(
            allreduce(
                domain.comm, sum(weight * float(forces[n].sum()) for n, weight in held), MPI.SUM
            )
        )

    return out_of_balance


class EndForce(NamedTuple):
    """Virtual work of a lengthening v = z/L e_z of a tube, per displacement of the end z = L."""

    internal: float
    inward: float
    lumen: float

    def wall_force(self, pressure: float) -> float:
        """Return the force in the wall's section at z = L, with a pressure on the inner face."""
        return self.internal + pressure * self.inward

    def reduced(self, pressure: float) -> float:
        """Return the force to apply to capped ends: less pressure times the lumen's area."""
        return self.internal - pressure * self.lumen


def _end_forms(measured: Measurement, face: str) -> list[list[dolfinx.fem.Form]]:
    """Make the forms of `EndForce`, in any kinematics and formulation."""
    state, equilibrium = measured.state, measured.equilibrium
    mesh = measured.domain.mesh
    weight, F = state.kinematics.weight(mesh), state.kinematics.deformation_gradient(state.unknown)
    tissue, elastic = state.kinematics.stress_free_weight(mesh), state.kinematics.elastic
    # a function in place of a number: UFL differentiates by functions only, and some kinematics
    # prescribe F_zz
    change = dolfinx.fem.Function(dolfinx.fem.functionspace(mesh, ("DG", 0)))
    one, size = (
        dolfinx.fem.Constant(mesh, np.float64(v))
        for v in (1.0, measured.domain.dimensions["length"])
    )
    along = ufl.as_tensor(
        [[1.0 / size if i == j == 2 else 0.0 for j in range(3)] for i in range(3)]
    )
    longer = F + change * along
    energies = state.dilatation.energies(
        equilibrium.tissue, elastic(longer), [state.cells.symbolic_cell], tissue
    )
    internal = [ufl.derivative(energy, change, one) for energy in energies]
    if equilibrium.pointwise is not None:
        work = ufl.inner(ufl.dot(elastic(F), equilibrium.pointwise.stress), elastic(along))
        internal[0] += work * tissue * equilibrium.quadrature.dx
    place, normal = ufl.SpatialCoordinate(mesh), ufl.FacetNormal(mesh)
    surface = state.loading.surface_measure(face)
    inward = ufl.dot(ufl.cofac(F), normal)[2] * place[2] / size
    moved = place + state.kinematics.displacement(state.unknown)
    # as in Loading.add_cavity_pressure: caps, across which z alone changes, add nothing
    across = ufl.as_vector([moved[0], moved[1], 0.0])
    volume = -ufl.inner(across, ufl.dot(ufl.cofac(longer), normal)) / 2 * weight * surface
    groups = internal, [inward * weight * surface], [ufl.derivative(volume, change, one)]
    return [[jit.form(form) for form in group] for group in groups]
