"""Shapes of bodies: keys, mesh, supports, loads, columns and fibre angle, one file each.

`body.SHAPES` lists them.
"""

from __future__ import annotations

import logging
import re
from abc import abstractmethod
from collections.abc import Callable, Collection, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter, methodcaller
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, TYPE_CHECKING, TypeVar

import numpy as np

from remodel_fenicsx._renamed import with_old_names
from remodel_fenicsx.body.gmsh_model import mesh_length_problem
from remodel_fenicsx.body import reductions as reduced
from remodel_fenicsx.model.axes import LocalAxes
from remodel_fenicsx.model.cells import angle_to_axis, global_axes
from remodel_fenicsx.model.tensors import Array
from remodel_fenicsx.schema import processes
from remodel_fenicsx.schema.settings import (
    NAME,
    Load,
    Mesh,
    OnFace,
    Region,
    Support,
    faces_of,
)
from remodel_fenicsx.schema.tables import validation_error, with_key
from remodel_fenicsx.schema.units import FORCE, Dimension, LengthUnit

if TYPE_CHECKING:
    from mpi4py import MPI

    from remodel_fenicsx.body.domain import Domain
    from remodel_fenicsx.body.loading import Loading
    from remodel_fenicsx.fem.quadrature import Quadrature
    from remodel_fenicsx.results.columns import Measurement

log = logging.getLogger(__name__)

Regions = Mapping[str, Region]
Supports = Mapping[str, Support]
Loads = Mapping[str, Load]
T = TypeVar("T")
Measure = Callable[[Any], T]  # of a `results.columns.Measurement`


# ---------------------------------------------------------------- the columns of a history
# Columns of every shape, columns on request, and the columns of a scene.


@dataclass(frozen=True)
class Column:
    """Column of a run's history.csv.

    Attributes
    ----------
    name
        As in the file's first row.
    unit
        Name of the unit in the documentation: "stress", "length", "degrees", "" for none.
    meaning
        Description in one sentence.
    value
        Function of a `results.columns.Measurement` that returns the value.
    after_pass
        Whether the value is known only after the remodeling pass. All other values belong to the
        solved state.
    extreme
        Whether the value is a maximum or minimum over the body. With random cells it depends on
        their number.
    by_case
        Whether the value differs between load cases. Values of the cells or of the complete step do
        not.
    of_one_tissue
        Whether the column is missing for bodies with regions.

    Examples
    --------
    A column for every shape, which a scene's history then contains:

    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> from remodel_fenicsx.extend import COLUMNS, Column
    >>> COLUMNS["reach"] = Column(
    ...     "reach", "length", "largest z", lambda m: float(m.position[:, 2].max()))
    >>> simulation = Simulation(preset_scene("kuhl-holzapfel-2007", "cube"))
    >>> for _, step in zip(range(1), simulation.steps()):
    ...     print(round(step.row["reach"], 4), round(step.row["mean_stretch"], 4))
    1.0808 1.0808
    >>> del COLUMNS["reach"]
    """

    name: str
    unit: str
    meaning: str
    value: Callable[[Any], float]
    after_pass: bool = False
    extreme: bool = False
    by_case: bool = True
    of_one_tissue: bool = False

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[\w .@+-]+", self.name):
            raise ValueError(
                f"column {self.name!r}: must consist of letters, digits, spaces and _ . + - @"
            )

    def of_case(self, number: int) -> Column:
        """Return this column for another load case.

        Parameters
        ----------
        number
            Number of the load case, from 1.
        """
        name, meaning = f"{self.name}@{number}", f"{self.meaning}, in load case {number}"
        return replace(
            self, name=name, meaning=meaning, value=lambda m: self.value(m.of_case(number))
        )


Columns = tuple[Column, ...]
Proportions = tuple[tuple[str, str, float, tuple[float, float]], ...]


# ---------------------------------------------------------------- fibre angle over depth
PROFILE_PLACES = 9
PROFILE = tuple(f"angle_profile_{number}" for number in range(PROFILE_PLACES))


def profile_weights(depth: Array) -> Array:
    """Return hat functions about equal depths from 0 to 1, on a new axis; they sum to one."""
    return np.maximum(
        0.0,
        1.0
        - np.abs(np.asarray(depth)[..., None] * (PROFILE_PLACES - 1) - np.arange(PROFILE_PLACES)),
    )


def _profile(number: int, m: Any) -> float:
    cells = m.state.cells
    hats = m.cached("hats", lambda: profile_weights(cells.local_axes.depth))
    return m.quadrature.nanmean(m.fibre_angle, hats[..., number])


_remodeling = attrgetter("observer.stepper.remodeling")
_PROFILE_COLUMNS = tuple(
    Column(
        name,
        "degrees",
        f"mean reference fibre angle near normalised depth {number}/{PROFILE_PLACES - 1} in "
        "the wall of a tube, or along z in a cube or tendon",
        partial(_profile, number),
        by_case=False,
    )
    for number, name in enumerate(PROFILE)
)


# ---------------------------------------------------------------- columns of regions


def columns_of_region(name: str) -> tuple[Column, Column]:
    """Return the history's columns for one region of a scene."""
    return (
        Column(
            f"fibre_angle_{name}",
            "degrees",
            f"mean reference fibre angle in the region `{name}`",
            lambda m: m.quadrature.nanmean(m.fibre_angle, m.elements_of_region(name)),
            by_case=False,
        ),
        Column(
            f"max_chain_extension_{name}",
            "",
            f"largest r/L in the region `{name}`",
            lambda m: m.quadrature.maximum(m.chain_extension * m.elements_of_region(name)[:, None]),
            extreme=True,
        ),
    )


# ---------------------------------------------------------------- columns of a history
def _of_work(name: str, meaning: str) -> Column:
    """Return a column of the solver's work in the step."""
    return Column(name, "", meaning, attrgetter(f"step.work.{name}"), by_case=False)


FIRST_COLUMN = Column("time", "time", "time of the scene", lambda m: m.step.time, by_case=False)
COLUMNS: dict[str, Column] = {
    column.name: column
    for column in (
        Column(
            "max_chain_extension",
            "",
            "largest r/L of all chains, below 1; 0 if the chain law has no limit",
            lambda m: m.step.limits.max_chain_extension,
            extreme=True,
        ),
        Column(
            "min_jacobian",
            "",
            "smallest volume ratio J, always above 0",
            lambda m: m.step.limits.min_jacobian,
            extreme=True,
        ),
        Column(
            "stored_energy",
            "stress length^3",
            "integral of W, 0 for an undeformed matrix without chains; at r0 chains have eq. (1)",
            lambda m: m.equilibrium.stored_energy(),
        ),
        Column(
            "remodeling_power",
            "stress length^3 / time",
            "energy per time that the pass of this step releases (docs/model.md, "
            "Power of remodeling)",
            lambda m: m.step.remodeling_power,
            after_pass=True,
        ),
        _of_work("newton_iterations", "Newton iterations of the step, including failed attempts"),
        _of_work("linear_iterations", "iterations of the linear solver, including failed attempts"),
        _of_work("substeps", "number of solves in the step"),
        Column("seconds", "s", "wall time of the step", lambda m: m.step.seconds, after_pass=True),
    )
}
"""Columns of every shape by name, after `time` and the shape's columns; scripts may add columns."""


def _of_process(process: str, value: Callable[..., float], m: Any) -> float:
    return float(value(m.observer.stepper.process(process)))


def _largest_principal_stress(m: Measurement) -> Array:
    return m.cached_for_step(
        "principal", lambda: np.asarray(np.linalg.eigvalsh(m.stress)[..., 2], float)
    )


def _max_principal_stress(m: Measurement) -> float:
    stress = _largest_principal_stress(m)
    largest, position = m.quadrature.maximum(stress), m.quadrature.shown_place_of_largest(stress)
    text = "time %g: largest principal stress %.6g at the reference position %s"
    log.info(text, m.step.time, largest, position)
    return largest


def _percentile_99_stress(m: Measurement) -> float:
    values = _largest_principal_stress(m), np.linalg.det(m.F) * m.quadrature.volumes
    parts = m.domain.comm.allgather([m.quadrature.owned(one).ravel() for one in values])
    stress, volumes = np.concatenate(parts, axis=1)
    return float(np.quantile(stress, 0.99, weights=volumes, method="inverted_cdf"))


COLUMNS_ON_REQUEST: dict[str, Column] = {
    column.name: column
    for column in (
        Column(
            "max_principal_stress",
            "stress",
            "largest principal Cauchy stress of all integration points; run.log has its position",
            _max_principal_stress,
            extreme=True,
        ),
        Column(
            "percentile_99_stress",
            "stress",
            "principal Cauchy stress that 99 % of the deformed volume do not exceed",
            _percentile_99_stress,
        ),
        Column(
            "pass_residual",
            "squared link length",
            "distance of the cells from equilibrium with their stress: largest norm of A_pass - A",
            lambda m: _remodeling(m).distance(),
            after_pass=True,
        ),
        Column(
            "time_error",
            "degrees",
            "estimated time discretisation error (docs/time_integration.md, Error-controlled "
            "steps); always present with `time.tolerance`",
            lambda m: m.step.time_error,
            after_pass=True,
        ),
        Column(
            "negative_eigenvalues",
            "",
            "eigenvalues of the tangent with negative real part; 0 if the equilibrium is stable",
            lambda m: m.step.negative_eigenvalues,
            by_case=False,
        ),
        Column(
            "inactive_fraction",
            "",
            "inactive fraction of the volume, below remodeling.threshold",
            lambda m: _remodeling(m).inactive_fraction(),
            by_case=False,
        ),
        *(
            Column(name, unit, meaning, partial(_of_process, process, value), by_case=False)
            for process, table in processes.tables().items()
            for name, unit, meaning, value in table.columns
        ),
        Column(
            "cpu_seconds",
            "s",
            "CPU time of rank 0 in the step",
            lambda m: m.step.processor_seconds,
            after_pass=True,
        ),
        *_PROFILE_COLUMNS,
    )
}
"""Columns that a scene may name in `output.columns`; scripts may add columns."""
for old_name, new_name in (
    ("asleep_share", "inactive_fraction"),
    ("processor_seconds", "cpu_seconds"),
):
    COLUMNS_ON_REQUEST[old_name] = replace(
        COLUMNS_ON_REQUEST[new_name], name=old_name, meaning=f"earlier name of `{new_name}`"
    )


def columns_of(
    shape: Shape | type[Shape],
    requested: Sequence[str] = (),
    loads: Container[str] | None = None,
    regions: Iterable[str] = (),
    cases: int = 1,
    held: Iterable[str] = (),
) -> Columns:
    """Return the columns of a shape's history, with columns on request last.

    If default columns are requested by name, the history has only these, with time and loads.

    Parameters
    ----------
    shape
        Shape of the body.
    requested
        Names in a scene's `output.columns`.
    loads
        The scene's loads by name, or their names; default: all loads of the shape. The column of a
        load that makes the body's length an unknown is on request if the load is not among them.
    regions
        Names of the scene's regions.
    cases
        Number of load cases. Columns that differ between cases exist for each case.
    held
        Names of the faces with supports (`Shape.held_faces`).

    Returns
    -------
    tuple of Column
        Columns in the order of the file.

    Raises
    ------
    KeyError
        If a requested column does not exist.

    Examples
    --------
    >>> from remodel_fenicsx import parts
    >>> columns = parts.columns_of(parts.Cube(side=1.0))
    >>> [column.name for column in columns][:5]
    ['time', 'force', 'mean_stretch', 'min_stretch', 'max_stretch']
    >>> columns = parts.columns_of(parts.Cube(side=1.0), requested=["mean_stretch"])
    >>> [column.name for column in columns]
    ['time', 'force', 'mean_stretch']
    """
    kinds = shape.loads_on(faces_of(loads) if isinstance(loads, Mapping) else {})
    of_loads = (
        kind.make_column(name)
        for name, kind in kinds.items()
        if not (kind.makes_length_unknown or kind.makes_pressure_unknown)
        or loads is None
        or name in loads
        or kind.column_name(name) in requested
    )
    always = (FIRST_COLUMN, *of_loads)
    of_regions = [column for name in regions for column in columns_of_region(name)]
    others = (*shape.columns, *of_regions, *COLUMNS.values())
    chosen = [column for column in others if column.name in requested]
    known = {column.name for column in (*always, *others)}
    on_request = columns_on_request(shape, regions, held)
    extra = (on_request[name] for name in requested if name not in known)
    columns = (*always, *(chosen or others), *extra)
    differ = [column for column in columns if column.by_case and not column.after_pass]
    return (
        *columns,
        *(column.of_case(number) for number in range(2, cases + 1) for column in differ),
    )


def columns_on_request(
    shape: Shape | type[Shape], regions: Iterable[str] = (), held: Iterable[str] = ()
) -> dict[str, Column]:
    """Return the columns of this shape's history that a scene must name, by name."""
    of_regions = [column for name in regions for column in shape.region_columns_on_request(name)]
    of_supports = [
        Column(
            f"support_force_{face}",
            "force",
            f"force of the support on the face `{face}`, along the face's mean outward normal",
            methodcaller("support_force", face),
        )
        for face in held
        if re.fullmatch(NAME, face)
    ]
    requestable = (*shape.columns_on_request, *of_regions, *of_supports)
    return COLUMNS_ON_REQUEST | {column.name: column for column in requestable}


@with_old_names
@dataclass(frozen=True)
class LoadKind:
    """Registry entry of a load of a shape.

    Attributes
    ----------
    add
        Function that adds the load to a body's loading: add(shape, loading, name).
    meaning
        Description in one sentence, also for the column.
    dimension
        Dimension of the value; None for a number without unit.
    column
        Name of the load's column; default: the name of the load.
    above
        Exclusive lower bound of values.
    reductions
        Names of the reduced kinematics that can apply the load.
    value
        Function of a measurement that returns the column's value; default: the load's magnitude.
    makes_length_unknown, makes_pressure_unknown
        Whether the load makes the body's length, or the pressure in its lumen, an unknown. In
        scenes without the load its column is on request.
    area
        For a force: function of the shape that returns the reference area that carries it.
    replaces
        Name of another load that the load excludes.
    of_one_strain
        Whether the load is a strain of the whole body, for kinematics of uniform strain.

    Examples
    --------
    The weight of the cube, per reference volume:

    >>> import ufl
    >>> from remodel_fenicsx import preset_scene
    >>> from remodel_fenicsx.extend import LENGTH_UNIT, STRESS_UNIT, Dimension, LoadKind
    >>> from remodel_fenicsx.parts import Cube
    >>> def add_weight(shape, loading, name):
    ...     weight = loading.magnitude(name)
    ...     loading.add_term(lambda u, v: -weight * v[2] * loading.weight * ufl.dx)
    >>> units = ((STRESS_UNIT, 1), (LENGTH_UNIT, -1))
    >>> per_volume = Dimension("force per volume", "9.81 kN/m^3", units)
    >>> Cube.loads["weight"] = LoadKind(add_weight, "weight along z", per_volume)
    >>> heavy = {"loads": {"weight": {"value": 0.02, "ramp": [[0.0, 0.0], [2.0, 1.0]]}}}
    >>> preset_scene("kuhl-holzapfel-2007", "cube").with_values(heavy).loads["weight"].value
    0.02
    >>> del Cube.loads["weight"]
    """

    add: Callable[[Any, Loading, str], None]
    meaning: str
    dimension: Dimension | None = None
    column: str = ""
    above: float = -np.inf
    reductions: tuple[str, ...] = ()
    value: Callable[[Any], float] | None = None
    makes_length_unknown: bool = False
    area: Callable[[Any], float] | None = None
    replaces: str = ""
    of_one_strain: bool = False
    makes_pressure_unknown: bool = False

    def column_name(self, name: str) -> str:
        """Return the name of the column for the load of this name."""
        return self.column or name

    def make_column(self, name: str) -> Column:
        """Return the column for the load of this name."""
        unit = self.dimension.name if self.dimension else ""
        value = self.value or (lambda m: float(m.step.loads.get(name, 0.0)))
        return Column(self.column_name(name), unit, self.meaning, value)


@with_old_names
class End(NamedTuple):
    """Supports of a body's ends.

    Attributes
    ----------
    hold
        Function of shape and loading that adds the supports.
    makes_length_unknown
        Whether the supports make the body's length an unknown.

    Examples
    --------
    >>> from remodel_fenicsx.parts import Tube
    >>> {name: end.makes_length_unknown for name, end in Tube.ends.items()}
    {'free': False, 'clamped': False, 'closed': True}
    """

    hold: Callable[[Any, Loading], None]
    makes_length_unknown: bool = False


_Is: Any = with_key(
    "is",
    Literal["unloaded", "loaded"],
    default="unloaded",
    description="State of the geometry: without loads, or (tube, user-supplied body) under the "
    "loads at the end of their ramps; the unloaded body is then computed "
    "(docs/load_cases.md).",
)


@with_old_names
class Shape(_Is):  # type: ignore[misc]
    """Body of a scene.

    The fields are the keys of `[geometry]`, among them `shape: Literal["name"] = "name"`.

    Attributes
    ----------
    loads
        Loads by name; scripts may add loads.
    columns
        Columns of the history in addition to those of the loads.
    columns_on_request
        Further columns that a scene may name in `output.columns`.
    angle_layers
        Columns of the fibre angle that are means over one layer of elements, with the layer's
        `depth`.
    axis_kinds
        Values of `cells.axes` (`model.local_axes.AXES`).
    number_of_elements
        Number of hexahedra of the mesh with refinement 1.
    face_names
        Names of the faces for supports, loads and columns.
    reductions
        Reductions by name of the kinematics, the cheapest first. Each is exact for some scenes and
        cheaper than the displacement in three dimensions.
    buckles
        Whether compressive loads may buckle the body.
    ends
        Supports of the ends, an `End` for each value of `supports.ends`.
    depth_labels
        Labels of `depth`: its direction, its value 0, and its value 1.
    angle_in_words
        Labels of the directions of fibre angles of 0 and 90 degrees.
    constant_fields
        Fields of `settings.CONSTANT_FIELDS` that `output.fields = true` includes.
    defaults
        Defaults of other tables that this shape changes, below those of preset and scene.
    supported_faces
        Faces for which `[supports.NAME]` may define springs, as for surrounding tissue. With None
        every face may have any support.
    directions
        Local axes as rows, (3, 3), unless `axes_at` depends on the position: y, z and x.

    Raises
    ------
    SceneError
        If a key is unknown or missing, or a value is not allowed: one line.

    Examples
    --------
    The keys of a new body; tests/body/test_extensions.py has a complete one with mesh and loads:

    >>> from typing import Annotated, Literal
    >>> from pydantic import Field
    >>> from remodel_fenicsx.extend import LENGTH, Shape
    >>> class Bar(Shape):
    ...     shape: Literal["bar"] = "bar"
    ...     length: Annotated[float, LENGTH] = Field(
    ...         default=4.0, gt=0, description="Length along z.")
    ...
    ...     def build(self, mesh, comm=None):
    ...         raise NotImplementedError("a script builds a mesh here and returns a Domain")
    ...
    ...     def hold(self, loading):
    ...         loading.hold_face("z0", component=2)
    >>> Bar(length=2.0).length, Bar().name
    (2.0, 'bar')
    >>> Bar(length=-2.0)
    Traceback (most recent call last):
        ...
    remodel_fenicsx.schema.tables.SceneError: length = -2.0: must be a finite number greater than 0
    """

    loads: ClassVar[dict[str, LoadKind]]
    columns: ClassVar[Columns]
    columns_on_request: ClassVar[Columns] = ()
    angle_layers: ClassVar[dict[str, float]] = {}
    axis_kinds: ClassVar[tuple[str, ...]] = ("global",)
    number_of_elements: ClassVar[int]
    face_names: ClassVar[tuple[str, ...]] = ()
    reductions: ClassVar[dict[str, reduced.Reduction]] = {}
    buckles: ClassVar[bool] = True
    ends: ClassVar[dict[str, End]] = {"free": End(lambda shape, loading: shape.hold(loading))}
    depth_labels: ClassVar[tuple[str, str, str]] = ("along the body", "bottom", "top")
    angle_in_words: ClassVar[tuple[str, str]] = ("along the load", "across")
    constant_fields: ClassVar[tuple[str, ...]] = ()
    defaults: ClassVar[dict[str, Any]] = {}
    supported_faces: ClassVar[tuple[str, ...] | None] = ()
    directions: ClassVar[Array] = np.roll(np.eye(3), -1, axis=0)

    shape: str
    """Shape of the body."""
    length_unit: LengthUnit = None

    @property
    def is_loaded(self) -> bool:
        """Whether the geometry is the loaded configuration."""
        return bool(getattr(self, "is") == "loaded")

    @property
    def axial_length(self) -> float:
        """Length along z, for reduced kinematics."""
        raise NotImplementedError(f"a {self.name} has no length along z")

    @property
    def section_area(self) -> float:
        """Area of every section across z."""
        raise NotImplementedError(f"a {self.name} has no section across z")

    @property
    def proportions(self) -> Proportions:
        """Ratios of lengths that reveal wrong units: key, label, ratio, usual decades."""
        return ()

    def log_of_radii(self, wall: Any) -> float | None:
        """Return ln(r_o/r_i) of a wall, from `wall.area(face)` on a mesh, or None."""
        return None

    def strut(self, ends: str) -> reduced.Strut | None:
        """Return the column that compression may buckle, or None if nothing bends it."""
        return None

    def axes_at(self, coordinates: Array) -> Array:
        """Return local axes at positions (..., 3) as rows circumferential, axial, radial.

        By default these are `directions`: y, z and x, where z is the direction of the load.

        Parameters
        ----------
        coordinates
            Reference positions, (..., 3), in the unit of length.
        """
        return np.broadcast_to(self.directions, (*coordinates.shape[:-1], 3, 3))

    def depth(self, coordinates: Array) -> Array:
        """Return the normalised depth of positions (..., 3), from 0 to 1; by default along z.

        Parameters
        ----------
        coordinates
            Reference positions, (..., 3), in the unit of length.
        """
        return self.station(coordinates)

    def station(self, coordinates: Array) -> Array:
        """Return the normalised axial coordinate of positions (..., 3), from 0 to 1; here along z.

        Parameters
        ----------
        coordinates
            Reference positions, (..., 3), in the unit of length.
        """
        station: Any = coordinates[..., 2] / self.axial_length
        return station

    def local_axes(self, domain: Domain, quadrature: Quadrature) -> LocalAxes:
        """Return axes, depth and station at quadrature points, by default functions of position.

        Parameters
        ----------
        domain
            The meshed body.
        quadrature
            Quadrature of the domain.
        """
        places, geometry = quadrature.coordinates, domain.mesh.geometry
        return LocalAxes(
            places,
            lambda: self.axes_at(places),
            lambda: self.depth(places),
            lambda: self.station(places),
            lambda: self.depth(geometry.x.astype(np.float64)),
        )

    def unresolved(self, mesh: Mesh, columns: Collection[str]) -> list[str]:
        """Return warnings of columns whose values the elements do not resolve, one line each.

        Parameters
        ----------
        mesh
            The table `[mesh]`.
        columns
            Requested columns.
        """
        return []

    @property
    def name(self) -> str:
        """Name of the shape."""
        return self.shape

    @abstractmethod
    def build(self, mesh: Mesh, comm: MPI.Intracomm | None = None) -> Domain:
        """Mesh the body. Collective.

        Parameters
        ----------
        mesh
            Settings of the elements, a `Mesh`.
        comm
            MPI communicator; default: all ranks.

        Raises
        ------
        ValueError
            If a value is not allowed.
        body.gmsh_model.GeometryError
            On all ranks, if Gmsh fails.
        """

    def build_with(self, regions: Regions, mesh: Mesh, comm: MPI.Intracomm | None = None) -> Domain:
        """Mesh the body with a scene's regions, if these have a geometry. Collective."""
        return self.build(mesh, comm)

    def region_depths(self, regions: Regions) -> dict[str, tuple[float, float]]:
        """Return start and end depth of regions that are layers; empty for other regions."""
        return {}

    @classmethod
    def region_columns_on_request(cls, name: str) -> Columns:
        """Return further columns that a scene may name for its region `name`."""
        return ()

    @abstractmethod
    def hold(self, loading: Loading) -> None:
        """Add the supports of the unloaded body with free ends.

        Parameters
        ----------
        loading
            Loading of the body, to which the conditions are added.
        """

    def support(
        self, loading: Loading, ends: str = "free", loads: Collection[str] | None = None
    ) -> None:
        """Add supports, and loads with magnitude zero.

        Parameters
        ----------
        loading
            Loading of the body or of its reduction, which has its own planes of symmetry.
        ends
            Name in `Shape.ends`.
        loads
            Names of the scene's loads; default: all loads of the body that the kinematics can
            apply.
        """
        self.ends[ends].hold(self, loading)
        kinematics = loading.kinematics
        for face, component in kinematics.symmetry_planes.items():
            loading.hold_face(face, component)
        for name, kind in self.loads.items():
            known = not kinematics.reduced or kinematics.name in kind.reductions
            if name in loads if loads is not None else known:
                kind.add(self, loading, name)

    def held_faces(self, supports: Supports) -> list[str]:
        """Return the faces with supports `[supports.NAME]`, without the shape's own supports.

        Parameters
        ----------
        supports
            Supports of a scene by name of the face.
        """
        return []

    def covers_body(self, regions: Collection[str]) -> bool:
        """Return whether these regions of a scene, by name, cover the body."""
        return False

    @classmethod
    def loads_on(cls, faces: Mapping[str, OnFace]) -> dict[str, LoadKind]:
        """Return all loads by name: the shape's own, and further ones on faces if it allows them.

        Parameters
        ----------
        faces
            Faces of the scene's further loads by name of the load (`faces_of`).
        """
        return cls.loads

    def check_faces(self, domain: Domain, supports: Supports, loads: Loads) -> None:
        """Check that the faces of a mesh can have these supports and loads. Collective.

        Parameters
        ----------
        domain
            The mesh.
        supports, loads
            See `hold_faces`.

        Raises
        ------
        SceneError
            If a face cannot, on all ranks: one line with the key.
        """

    def hold_faces(
        self, loading: Loading, supports: Supports, modulus: float, loads: Loads
    ) -> None:
        """Add the supports `[supports.NAME]` of faces.

        Parameters
        ----------
        loading
            Loading of the body, with all loads.
        supports
            Supports by name of the face.
        modulus
            lambda + 2 mu of the stiffest matrix in the body, in the scene's unit of stress.
        loads
            Loads of the scene by name.
        """

    @classmethod
    def defaults_of(cls, own: Mapping[str, Any]) -> dict[str, Any]:
        """Return `defaults` for a scene with these keys, as read."""
        return cls.defaults

    @classmethod
    def with_files_from(cls, geometry: Mapping[str, Any], folder: Path) -> dict[str, Any]:
        """Return the keys of `[geometry]` as read from a scene in a folder, with paths of files."""
        return dict(geometry)

    def kept_files(self) -> tuple[dict[str, Any], dict[str, bytes]]:
        """Return values of a stored scene by dotted key, and the files stored with it by name."""
        return {}, {}

    def check_size(self, mesh: Mesh) -> None:
        """Check that the shape can have this mesh, or raise a `fault` that names the key."""

    def fibre_angle(self, dimensions: Array, axes: Array, local: Array) -> Array:
        """Return the angle of the chain direction in degrees, by default to the load axis z.

        Parameters
        ----------
        dimensions, axes, local
            l_I (..., 3), axes of the cells and local axes of the body as rows (..., 3, 3), all in
            the reference or all in the deformed configuration.

        Returns
        -------
        array (...,)
            Degrees, NaN if the chain direction has no such angle. Means ignore NaN.
        """
        return angle_to_axis(dimensions, axes, np.array([0.0, 0.0, 1.0]))

    def radial_share(self, dimensions: Array, axes: Array, local: Array) -> Array:
        """Return the chains' fraction that `fibre_angle` omits, by squared length, (...,)."""
        return np.zeros(dimensions.shape[:-1])


# ---------------------------------------------------------------- capabilities of some bodies
class WithRegions(Shape):
    """Body that may have regions `[regions.NAME]` with their own tissue, defined by its mesh.

    Its keyword arguments are the keys of `[geometry]`, as of every `Shape`.

    Examples
    --------
    >>> from remodel_fenicsx.extend import SHAPES, WithRegions
    >>> [name for name, shape in SHAPES.items() if issubclass(shape, WithRegions)]
    ['tube', 'mesh', 'solid']
    """

    def check_regions(self, regions: Regions, mesh: Mesh) -> None:
        """Check that the body can have these regions.

        Parameters
        ----------
        regions
            Regions of the scene by name.
        mesh
            Settings of the elements.

        Raises
        ------
        SceneError
            If the body cannot have a region: one line with the key.
        """
        for name, region in regions.items():
            if region.outer_radius is not None:
                rule = f"the mesh defines the regions of a {self.name}; only a tube has this key"
                raise validation_error(rule, f"regions.{name}.outer_radius", region.outer_radius)


class WithAxes(Shape):
    """Body whose local axes have a meaning, so that its elastin may be prestretched in them.

    Its keyword arguments are the keys of `[geometry]`, as of every `Shape`.

    Examples
    --------
    >>> from remodel_fenicsx.extend import SHAPES, WithAxes
    >>> [name for name, shape in SHAPES.items() if issubclass(shape, WithAxes)]
    ['cube', 'tendon', 'tube', 'sheet', 'mesh']
    """


class Unloads(Shape):
    """Body whose geometry may be the loaded configuration, `geometry.is = "loaded"`."""


class FromFile(Shape):
    """Body with the elements of a file, which `[mesh]` may only divide."""


def check_lengths(shape: Shape, lengths: dict[str, float]) -> None:
    """Check that Gmsh can mesh a body of these lengths, or raise the fault at its key."""
    problem = mesh_length_problem(lengths)
    if problem is not None:
        raise validation_error(problem[1], problem[0], getattr(shape, problem[0]))


def axial_dead_force(face: str) -> LoadKind:
    """Return a dead load along z on a face across z."""
    return LoadKind(
        lambda shape, loading, name: loading.add_dead_force(name, face, component=2),
        "total force along z on the top, a dead load",
        FORCE,
        reductions=("point",),
        area=lambda shape: shape.section_area,
    )


def uniaxial_columns(top: str, length: str) -> Columns:
    """Return the columns of a body under tension along z: stretches and mean fibre angle.

    Parameters
    ----------
    top
        Name of the loaded face.
    length
        Name of the body's dimension along z (`Domain.dimensions`).

    Returns
    -------
    tuple of Column
        Columns for `Shape.columns`.

    Examples
    --------
    >>> from remodel_fenicsx.extend import uniaxial_columns
    >>> [column.name for column in uniaxial_columns("z1", "length")]
    ['mean_stretch', 'min_stretch', 'max_stretch', 'mean_fibre_angle']
    """

    def mean_stretch(m: Any) -> float:
        return float(1.0 + m.face_mean(top, m.displacement[:, 2]) / m.domain.dimensions[length])

    return (
        Column(
            "mean_stretch",
            "",
            "deformed length over reference length, mean over the top",
            mean_stretch,
        ),
        Column(
            "min_stretch",
            "",
            "smallest stretch F_zz of an element (its mean)",
            lambda m: m.smallest(m.axial_stretch),
            extreme=True,
        ),
        Column(
            "max_stretch",
            "",
            "largest stretch F_zz of an element (its mean)",
            lambda m: m.largest(m.axial_stretch),
            extreme=True,
        ),
        Column(
            "mean_fibre_angle",
            "degrees",
            "angle between chains and load axis in the reference configuration, volume mean",
            lambda m: m.quadrature.nanmean(m.fibre_angle),
        ),
    )


def cauchy_columns(*names: str) -> Columns:
    """Return columns of the Cauchy stress, volume means.

    Parameters
    ----------
    names
        Letters of one or two axes: "x" is the normal stress along x, "xy" the shear stress.

    Returns
    -------
    tuple of Column
        Columns `cauchy_stress_...`, one for each name.

    Examples
    --------
    >>> from remodel_fenicsx.extend import cauchy_columns
    >>> [column.name for column in cauchy_columns("x", "xy")]
    ['cauchy_stress_x', 'cauchy_stress_xy']
    """

    return tensor_columns("cauchy_stress", "stress", "Cauchy stress", attrgetter("stress"), names)


def tensor_columns(
    quantity: str, unit: str, words: str, tensor: Measure[Array], names: Iterable[str]
) -> Columns:
    """Return columns of a tensor, volume means, for letters of one or two axes each."""
    return tuple(
        Column(
            f"{quantity}_{name}", unit, f"{words} {name}, volume mean", mean_component(tensor, name)
        )
        for name in names
    )


def mean_component(tensor: Measure[Array], name: str) -> Measure[float]:
    """Return the volume mean of a component, of one or two letters, of a tensor at the points."""
    row, column = "xyz".index(name[0]), "xyz".index(name[-1])

    def mean(m: Any) -> float:
        values = m.cached_for_step(tensor, lambda: tensor(m))
        return float(m.quadrature.mean(values[..., row, column]))

    return mean


def mean_over(mean: Callable[..., float], values: Measure[Array]) -> Measure[float]:
    """Return a mean, such as that over the elements at a face, of values at the points."""
    return lambda m: mean(m, values(m))


def homogeneous_bar(
    bottom: str,
    top: str,
    dimensions: Callable[[Any], dict[str, float]],
    whole: Callable[[Any], reduced.Body],
) -> reduced.Reduction:
    """Return the reduction "point", of uniform strain, for a body between two faces across z."""

    def build(scene: reduced.ReducedScene, comm: MPI.Intracomm | None) -> Domain:
        from remodel_fenicsx.body.domain import lattice_domain

        shape, length = scene.geometry, scene.geometry.axial_length
        faces = {bottom: lambda x: np.isclose(x[2], 0.0), top: lambda x: np.isclose(x[2], length)}
        degree = scene.mesh.degree
        share = np.linspace(0.0, 1.0, degree + 1)[:, None]
        points = length * ([1.0, 0.0, 0.0] + share * [0.0, 0.0, 1.0])
        return lattice_domain(points, [1], degree, faces, shape.name, dimensions(shape), comm)

    rules = (
        reduced.same_cells,
        reduced.symmetric_law,
        reduced.homogeneous,
        reduced.known_loads("point"),
    )
    return reduced.Reduction(
        build, lambda scene: 1, rules, global_axes, lambda shape, points, corners: whole(shape)
    )
