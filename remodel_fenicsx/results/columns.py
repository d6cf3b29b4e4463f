"""The columns of a run's history, and how they are measured on a solved state."""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence
from functools import cached_property
from typing import Any

import dolfinx.fem
import numpy as np
import ufl
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.body.column import Column
from remodel_fenicsx.body.domain import Domain
from remodel_fenicsx.body.shape import Shape
from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.fem import compat, jit
from remodel_fenicsx.fem.quadrature import Quadrature
from remodel_fenicsx.results import profile

Array = NDArray[np.float64]

FIRST_COLUMN = Column("time", "time", "time of the scene", lambda m: m.step.time)
COLUMNS: dict[str, Column] = {
    column.name: column
    for column in (
        Column(
            "max_chain_extension",
            "",
            "largest r/L, always below 1 (0 where no chain locks)",
            lambda m: m.step.extension.max_chain_extension,
            extreme=True,
        ),
        Column("min_jacobian", "", "smallest J, always above 0", lambda m: m.step.extension.min_jacobian, extreme=True),
        Column("stored_energy", "stress length^3", "integral of W", lambda m: m.equilibrium.stored_energy()),
        Column(
            "remodeling_power",
            "stress length^3 / time",
            "power released by the remodeling pass that follows (docs/theory.md)",
            lambda m: m.step.remodeling_power,
            after_pass=True,
        ),
        Column(
            "newton_iterations",
            "",
            "Newton iterations of the step, failed attempts included",
            lambda m: m.step.work.newton_iterations,
        ),
        Column("linear_iterations", "", "linear iterations of the same", lambda m: m.step.work.linear_iterations),
        Column(
            "substeps",
            "",
            "solves that made up the step; 1: the paper's step in one piece",
            lambda m: m.step.work.substeps,
        ),
        Column("seconds", "s", "wall time of the step", lambda m: m.step.seconds, after_pass=True),
    )
}
"""Columns of every shape by name, after `time` and those of the shape; a script adds its own."""

COLUMNS_ON_REQUEST: dict[str, Column] = {
    column.name: column
    for column in (
        Column(
            "pass_residual",
            "squared link length",
            "largest norm of A_pass - A over all points: how far the row is from cells that belong to its own stress",
            lambda m: m.observer.stepper.remodeling.residual(),
            after_pass=True,
        ),
        Column(
            "time_error",
            "degrees",
            "estimated error in time: of the direction of the chains, root mean square over the body, or of lengths, "
            "relative (1 radian is 100 %), the larger; there without request with `time.tolerance`",
            lambda m: m.step.time_error,
            after_pass=True,
        ),
        Column(
            "negative_eigenvalues",
            "",
            "negative eigenvalues of the tangent's symmetric part: 0 where the equilibrium is stable",
            lambda m: m.step.negative_eigenvalues,
        ),
        Column(
            "held_points",
            "",
            "points at which the coupling 'implicit' found no cells that belong to their stress",
            lambda m: m.step.work.held_points,
        ),
        Column(
            "processor_seconds",
            "s",
            "time of the first rank's processor in the step: on a machine that others use it says more than `seconds`",
            lambda m: m.step.processor_seconds,
            after_pass=True,
        ),
        *profile.COLUMNS,
    )
}
"""Columns that a scene may name in `output.columns`; a script adds its own."""


def columns_of(shape: Shape | type[Shape], requested: Sequence[str] = ()) -> tuple[Column, ...]:
    """The columns of a shape's history, in the order of the file, those on request last.

    Where some of the others are requested too, only they are there, with time and loads.

    Raises
    ------
    KeyError
        If a column that is requested does not exist.
    """
    always = (FIRST_COLUMN, *(kind.make_column(name) for name, kind in shape.loads.items()))
    others = (*shape.columns, *COLUMNS.values())
    chosen = [column for column in others if column.name in requested]
    known = {column.name for column in (*always, *others)}
    extra = (COLUMNS_ON_REQUEST[name] for name in requested if name not in known)
    return (*always, *(chosen or others), *extra)


def without_free_length(columns: Sequence[Column], shape: Shape, loads: Container[str]) -> tuple[Column, ...]:
    """The columns but those of loads that free the length of the body, where these are not among the loads."""
    free = {name for name, kind in shape.loads.items() if kind.frees_length and name not in loads}
    return tuple(column for column in columns if column.name not in free)


class Observer(Watcher):
    """Gives every step its row.

    Parameters
    ----------
    shape
        Says which columns there are, and what the fibre angle is.
    stepper
        What is measured; nothing here changes it.
    columns
        Other columns than `columns_of(shape)`.
    """

    def __init__(self, shape: Shape, stepper: Stepper, columns: Sequence[Column] | None = None):
        self.shape, self.stepper, self.state = shape, stepper, stepper.state
        if columns is None:
            columns = without_free_length(columns_of(shape), shape, self.state.loading.values)
        self.columns = tuple(columns)
        self.quadrature: Quadrature = self.state.cells.quadrature
        self.domain: Domain = self.state.loading.domain
        self.tools: dict[Any, Any] = {}

    # ------------------------------------------------------------ as a watcher
    def started(self, step: Step) -> None:
        """Measure the start; every form that a column needs is compiled now."""
        self.solved(step)
        self.completed(step)

    def resumed(self, step: Step) -> None:
        """Compile every form that a column needs; nobody keeps this row."""
        self.started(step)

    def solved(self, step: Step) -> None:
        """Measure the solved state."""
        step.row |= dict.fromkeys((column.name for column in self.columns), np.nan)
        self._fill(step, after_pass=False)

    def completed(self, step: Step) -> None:
        """Fill in what is known only now."""
        self._fill(step, after_pass=True)

    def _fill(self, step: Step, after_pass: bool) -> None:
        measurement = Measurement(self, step)
        for column in self.columns:
            if column.after_pass == after_pass:
                step.row[column.name] = column.value(measurement)


class Measurement:
    """What columns may ask of a step; everything is computed once, when the first one asks.

    Attributes
    ----------
    step
        The step.
    observer
        Whose measurement it is.
    domain, quadrature, state
        The body, its quadrature points and its state.
    """

    def __init__(self, observer: Observer, step: Step):
        self.step, self.observer = step, observer
        self._of_step: dict[Any, Any] = {}
        self.domain, self.quadrature, self.state = observer.domain, observer.quadrature, observer.state

    @property
    def equilibrium(self) -> Any:
        """The forms of the solved state (`evolution.equilibrium.Equilibrium`)."""
        return self.observer.stepper.coupling.equilibrium

    @cached_property
    def displacement(self) -> Array:
        """Displacement of the local nodes, (nodes, 3)."""
        return self.state.kinematics.nodal_displacement(self.state.unknown)

    @cached_property
    def position(self) -> Array:
        """Deformed place of the local nodes, (nodes, 3)."""
        nodes: Array = self.state.kinematics.nodal_space(self.state.unknown).tabulate_dof_coordinates()
        return nodes + self.displacement

    @cached_property
    def fibre_angle(self) -> Array:
        """Reference fibre angle at all points (elements, points), degrees."""
        cells = self.state.cells
        return self.observer.shape.fibre_angle(cells.dimension_values, cells.axis_values, self.quadrature.coordinates)

    @cached_property
    def axial_stretch(self) -> Array:
        """Volume mean of F_zz in each local element, (elements,)."""
        F = self.state.deformation_gradient()
        return self.quadrature.element_mean(F[:, 2, 2].reshape(self.quadrature.shape))

    def face_mean(self, face: str, nodal_values: Array, deformed: bool = False) -> float:
        """Mean of nodal values (nodes,) over a named face, by its reference or its deformed area."""
        mean = self.tool((face, deformed), lambda: _FaceMean(self.observer, face, deformed))
        return float(mean(nodal_values))

    def largest(self, values: Array) -> float:
        """Largest of one value per local element, over all ranks."""
        local = float(np.max(self.quadrature.owned(values), initial=-np.inf))
        return float(self.domain.comm.allreduce(local, MPI.MAX))

    def smallest(self, values: Array) -> float:
        """Smallest of one value per local element, over all ranks."""
        return -self.largest(-values)

    def elements_touching_radius(self, radius: float) -> NDArray[np.bool_]:
        """Mask of the local elements with a reference point at this distance from the z axis, (elements,)."""
        return self.tool(("elements at", radius), lambda: self._touching(radius))

    def _touching(self, radius: float) -> NDArray[np.bool_]:
        nodes = self.domain.mesh.geometry.x[compat.geometry_dofmap(self.domain.mesh)]
        radii = np.linalg.norm(nodes[..., :2], axis=-1)
        tolerance = 1e-6 * self.domain.size
        return (radii.min(axis=1) <= radius + tolerance) & (radii.max(axis=1) >= radius - tolerance)

    def tool(self, key: Any, make: Callable[[], Any]) -> Any:
        """What a column needs for every step, a compiled form say: made once, by make(), and kept under a key."""
        if key not in self.observer.tools:
            self.observer.tools[key] = make()
        return self.observer.tools[key]

    def tool_of_step(self, key: Any, make: Callable[[], Any]) -> Any:
        """What several columns of one step share: made once for the step."""
        if key not in self._of_step:
            self._of_step[key] = make()
        return self._of_step[key]


class _FaceMean:
    """Mean over a face of a nodal field, over the reference or the deformed area."""

    def __init__(self, observer: Observer, face: str, deformed: bool):
        domain, state = observer.domain, observer.state
        # first component of a function of the displacement's space: surely the same order of nodes
        self.field = dolfinx.fem.Function(state.kinematics.nodal_space(state.unknown))
        self._size = self.field.function_space.dofmap.index_map_bs
        value = self.field[0] if self.field.ufl_shape else self.field
        normal = ufl.FacetNormal(domain.mesh)
        F = state.kinematics.deformation_gradient(state.unknown)
        stretched = ufl.cofac(F) * normal if deformed else normal
        weight = ufl.sqrt(ufl.inner(stretched, stretched)) * state.kinematics.weight(domain.mesh)
        self._form = jit.form(value * weight * state.loading.measure_alone(face))
        self._comm = domain.comm

    def __call__(self, nodal_values: Array) -> float:
        weighted, area = self._comm.allreduce(
            np.array([self._integral(values) for values in (nodal_values, 1.0)]), MPI.SUM
        )
        return float(weighted / area)

    def _integral(self, nodal_values: Array | float) -> float:
        self.field.x.array.reshape(-1, self._size)[:, 0] = nodal_values
        return float(np.real(dolfinx.fem.assemble_scalar(self._form)))
