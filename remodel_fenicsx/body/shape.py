"""What a body is: keys, mesh, supports, loads, columns, fibre angle; one file and one line in `body.SHAPES` each."""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Callable, Collection, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import methodcaller
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, TYPE_CHECKING

import numpy as np

from remodel_fenicsx.body.gmsh_model import length_fault
from remodel_fenicsx.body import reductions as reduced
from remodel_fenicsx.model.axes import LocalAxes
from remodel_fenicsx.model.cells import angle_to_axis, global_axes
from remodel_fenicsx.model.tensors import Array
from remodel_fenicsx.schema.settings import (
    NAME,
    TURNOVER_POWER,
    Load,
    Mesh,
    OnFace,
    Region,
    Support,
    faces_of,
)
from remodel_fenicsx.schema.tables import fault, with_key
from remodel_fenicsx.schema.units import FORCE, Dimension, LengthUnit

if TYPE_CHECKING:
    from mpi4py import MPI

    from remodel_fenicsx.body.domain import Domain
    from remodel_fenicsx.body.loading import Loading
    from remodel_fenicsx.fem.quadrature import Quadrature

Regions = Mapping[str, Region]
Supports = Mapping[str, Support]
Loads = Mapping[str, Load]


# ---------------------------------------------------------------- the columns of a history
# Those of every shape, those on request, and which a scene has.


@dataclass(frozen=True)
class Column:
    """A column of history.csv.

    Attributes
    ----------
    name
        As in the file's first row.
    unit
        In words, for the documentation: "stress", "length", "degrees", "" for none.
    meaning
        One sentence.
    value
        Its value from a `results.columns.Measurement`.
    after_pass
        Whether it is known only when the cells have remodeled; all others belong to the solved state.
    extreme
        Whether it is the largest or smallest value of the body: of random cells it goes with their number.
    by_case
        Whether it has another value in each load case: what belongs to the cells or to the step as a whole has not.
    of_one_tissue
        Whether a body with regions has it not.

    Examples
    --------
    A column of every shape; a scene's history then has it:

    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> from remodel_fenicsx.extend import COLUMNS, Column
    >>> COLUMNS["reach"] = Column("reach", "length", "largest z", lambda m: float(m.position[:, 2].max()))
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
            raise ValueError(f"column {self.name!r}: its name must be of letters, digits, spaces and _ . + - @")

    def of_case(self, number: int) -> Column:
        """The same of another load case; the first one is 1.

        Parameters
        ----------
        number
            Of the load case, from 1.
        """
        name, meaning = f"{self.name}@{number}", f"{self.meaning}, in load case {number}"
        return replace(self, name=name, meaning=meaning, value=lambda m: self.value(m.of_case(number)))


Columns = tuple[Column, ...]


# ---------------------------------------------------------------- the fibre angle through a body, whatever the mesh
PROFILE_PLACES = 9
PROFILE = tuple(f"angle_profile_{number}" for number in range(PROFILE_PLACES))


def profile_weights(depth: Array) -> Array:
    """Hat functions about equally spaced depths from 0 to 1, along one more axis; their sum is one."""
    return np.maximum(
        0.0, 1.0 - np.abs(np.asarray(depth)[..., None] * (PROFILE_PLACES - 1) - np.arange(PROFILE_PLACES))
    )


def _profile(number: int, m: Any) -> float:
    hats = m.tool("hats", lambda: profile_weights(m.state.cells.local_axes.depth))
    return m.quadrature.mean_of_known(m.fibre_angle, hats[..., number])


_PROFILE_COLUMNS = tuple(
    Column(
        name,
        "degrees",
        f"mean reference fibre angle near {number}/{PROFILE_PLACES - 1} of the way through the wall of a tube, or "
        "along z in a cube or tendon",
        partial(_profile, number),
        by_case=False,
    )
    for number, name in enumerate(PROFILE)
)


# ---------------------------------------------------------------- of regions


def columns_of_region(name: str) -> tuple[Column, Column]:
    """What a history says of each region of a scene."""
    return (
        Column(
            f"fibre_angle_{name}",
            "degrees",
            f"mean reference fibre angle in the region `{name}`",
            lambda m: m.quadrature.mean_of_known(m.fibre_angle, m.elements_of_region(name)),
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


# ---------------------------------------------------------------- which a history has
def _of_work(name: str, meaning: str) -> Column:
    """What the solver did in the step."""
    return Column(name, "", meaning, lambda m: getattr(m.step.work, name), by_case=False)


FIRST_COLUMN = Column("time", "time", "time of the scene", lambda m: m.step.time, by_case=False)
COLUMNS: dict[str, Column] = {
    column.name: column
    for column in (
        Column(
            "max_chain_extension",
            "",
            "largest r/L of all chains, below 1; 0 where the chain law has no limit",
            lambda m: m.step.extension.max_chain_extension,
            extreme=True,
        ),
        Column(
            "min_jacobian",
            "",
            "smallest volume ratio J, always above 0",
            lambda m: m.step.extension.min_jacobian,
            extreme=True,
        ),
        Column(
            "stored_energy",
            "stress length^3",
            "integral of W, where 0 is a matrix at rest without chains; those of the unloaded start have eq. (1) at r0",
            lambda m: m.equilibrium.stored_energy(),
        ),
        Column(
            "remodeling_power",
            "stress length^3 / time",
            "energy per time that the pass of this step releases (docs/theory.md, Power of remodeling)",
            lambda m: m.step.remodeling_power,
            after_pass=True,
        ),
        _of_work("newton_iterations", "Newton iterations of the step, of failed attempts too"),
        _of_work("linear_iterations", "iterations of the linear solver, of failed attempts too"),
        _of_work("substeps", "number of solves that made up the step"),
        Column("seconds", "s", "wall time of the step", lambda m: m.step.seconds, after_pass=True),
    )
}
"""Columns of every shape by name, after `time` and those of the shape; a script adds its own."""


def _of_turnover(name: str, unit: str, meaning: str, value: Callable[[Any], float]) -> Column:
    """Make a column of a function of `evolution.turnover.Turnover`."""
    return Column(name, unit, meaning, lambda m: float(value(m.observer.stepper.part("turnover"))), by_case=False)


COLUMNS_ON_REQUEST: dict[str, Column] = {
    column.name: column
    for column in (
        Column(
            "pass_residual",
            "squared link length",
            "distance of the cells from those of their own stress: largest norm of A_pass - A",
            lambda m: m.observer.stepper.remodeling.distance(),
            after_pass=True,
        ),
        Column(
            "time_error",
            "degrees",
            "estimated error in time (docs/theory.md, Error-controlled steps); always there with `time.tolerance`",
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
            "asleep_share",
            "",
            "share of the volume that does not remodel, below remodeling.threshold",
            lambda m: m.observer.stepper.remodeling.asleep_share(),
            by_case=False,
        ),
        *(
            _of_turnover(
                name,
                "",
                f"{what} of the collagen over that at the start, volume mean; with remodeling.turnover",
                methodcaller("mean", name),
            )
            for name, what in (("content", "amount"), ("natural_length", "natural length"))
        ),
        Column(
            "growth",
            "",
            "volume of the tissue free of stress over that at the start; mean over the volume at the start",
            lambda m: m.quadrature.mean(m.observer.stepper.part("turnover").growth.ratio),
            by_case=False,
        ),
        _of_turnover(
            "collagen_share",
            "",
            "share of the tissue's volume that is collagen, mean over the volume at the start",
            methodcaller("collagen_share"),
        ),
        _of_turnover(
            TURNOVER_POWER,
            "stress length^3 / time",
            "power that turnover releases at the F of the row, without growth",
            methodcaller("power"),
        ),
        Column(
            "processor_seconds",
            "s",
            "processor time of the first rank in the step",
            lambda m: m.step.processor_seconds,
            after_pass=True,
        ),
        *_PROFILE_COLUMNS,
    )
}
"""Columns that a scene may name in `output.columns`; a script adds its own."""


def columns_of(
    shape: Shape | type[Shape],
    requested: Sequence[str] = (),
    loads: Container[str] | None = None,
    regions: Iterable[str] = (),
    cases: int = 1,
    held: Iterable[str] = (),
) -> Columns:
    """The columns of a shape's history, in the order of the file, those on request last.

    Where some of the others are requested too, only they are there, with time and loads.

    Parameters
    ----------
    shape
        Of the body.
    requested
        Names that a scene's `output.columns` gives.
    loads
        The loads that there are by name, or their names; default: all of the shape's. The column of one that frees the
        length of the body is on request where it is not among them.
    regions
        Names of the scene's regions.
    cases
        Number of its load cases: what differs in them has a column for each.
    held
        Names of its faces with supports (`Shape.held_faces`).

    Returns
    -------
    tuple of Column
        In the order of the file.

    Raises
    ------
    KeyError
        If a column that is requested does not exist.

    Examples
    --------
    >>> from remodel_fenicsx import parts
    >>> [column.name for column in parts.columns_of(parts.Cube(side=1.0))][:5]
    ['time', 'force', 'mean_stretch', 'min_stretch', 'max_stretch']
    >>> [column.name for column in parts.columns_of(parts.Cube(side=1.0), requested=["mean_stretch"])]
    ['time', 'force', 'mean_stretch']
    """
    kinds = shape.loads_on(faces_of(loads) if isinstance(loads, Mapping) else {})
    of_loads = (
        kind.make_column(name)
        for name, kind in kinds.items()
        if not kind.frees_length or loads is None or name in loads or kind.column_name(name) in requested
    )
    always = (FIRST_COLUMN, *of_loads)
    of_regions = [column for name in regions for column in columns_of_region(name)]
    others = (*shape.columns, *of_regions, *COLUMNS.values())
    chosen = [column for column in others if column.name in requested]
    known = {column.name for column in (*always, *others)}
    on_request = columns_on_request(shape, regions, held)
    extra = (on_request[name] for name in requested if name not in known)
    found = (*always, *(chosen or others), *extra)
    differ = [column for column in found if column.by_case and not column.after_pass]
    return (*found, *(column.of_case(number) for number in range(2, cases + 1) for column in differ))


def columns_on_request(
    shape: Shape | type[Shape], regions: Iterable[str] = (), held: Iterable[str] = ()
) -> dict[str, Column]:
    """Columns by name that a history of this shape has only where a scene names them."""
    of_regions = [column for name in regions for column in shape.region_columns_on_request(name)]
    of_supports = [
        Column(f"support_force_{face}", "force", SUPPORT_FORCE.format(face), partial(_support_force, face))
        for face in held
        if re.fullmatch(NAME, face)
    ]
    found = (*shape.columns_on_request, *of_regions, *of_supports)
    return COLUMNS_ON_REQUEST | {column.name: column for column in found}


SUPPORT_FORCE = "force by which the support of the face `{}` pulls the body, along the mean outward normal of the face"


def _support_force(face: str, m: Any) -> float:
    return float(m.support_force(face))


@dataclass(frozen=True)
class LoadKind:
    """A load that a shape knows, named once.

    Attributes
    ----------
    add
        Adds it to a body's loading: add(shape, loading, name).
    meaning
        One sentence for the documentation, the column's too.
    dimension
        Of its value; None for a number.
    column
        Name of its column; default: its own.
    above
        Values must be greater than this.
    reductions
        Names of the reduced kinematics that have it.
    value
        What its column shows; default: the load's magnitude.
    frees_length
        Whether the body's length is an unknown where a scene has it. Elsewhere its column is there on request.
    area
        Of a force: the reference area that carries it, from the shape.
    instead_of
        Name of another load that a scene may have in its place, not beside it.
    of_one_strain
        Whether it is a strain of the whole body, for kinematics whose strain is the same everywhere.

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
    >>> per_volume = Dimension("force per volume", "9.81 kN/m^3", ((STRESS_UNIT, 1), (LENGTH_UNIT, -1)))
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
    frees_length: bool = False
    area: Callable[[Any], float] | None = None
    instead_of: str = ""
    of_one_strain: bool = False

    def column_name(self, name: str) -> str:
        """Of its column, for the load of this name."""
        return self.column or name

    def make_column(self, name: str) -> Column:
        """Its column, for the load of this name."""
        unit = self.dimension.name if self.dimension else ""
        value = self.value or (lambda m: float(m.step.loads.get(name, 0.0)))
        return Column(self.column_name(name), unit, self.meaning, value)


class End(NamedTuple):
    """A way to hold a body.

    Attributes
    ----------
    hold
        Function of shape and loading.
    frees_length
        Whether the body's length is an unknown then.

    Examples
    --------
    >>> from remodel_fenicsx.parts import Tube
    >>> {name: end.frees_length for name, end in Tube.ends.items()}
    {'free': False, 'clamped': False, 'closed': True}
    """

    hold: Callable[[Any, Loading], None]
    frees_length: bool = False


_Is: Any = with_key(
    "is",
    Literal["unloaded", "loaded"],
    default="unloaded",
    description="What the geometry describes: the body without loads, or (a tube, a body of your own) the one "
    "under the loads at the end of their ramps; the unloaded body is found first (docs/tissue_that_lives.md).",
)


class Shape(_Is):  # type: ignore[misc]
    """A body of a scene. Its fields are the keys of `[geometry]`; `shape: Literal["name"] = "name"` is one of them.

    Attributes
    ----------
    loads
        Loads by name; a script may add its own.
    columns
        Columns of the history beside those of the loads.
    columns_on_request
        Further ones that a scene may name in `output.columns`.
    angle_layers
        Columns of the fibre angle that are means over one layer of elements, each with the layer's `depth`.
    axis_kinds
        What `cells.axes` may be (`model.local_axes.AXES`).
    number_of_elements
        Hexahedra of the mesh with refinement 1.
    face_names
        Names of the faces that supports, loads and columns refer to.
    reductions
        What is cheaper than the displacement in three dimensions and exact for some scenes, by name of the kinematics,
        the cheapest first.
    buckles
        Whether loads that press may bend it.
    ends
        How the body may be held, by what `supports.ends` says: an `End` each.
    depth_in_words
        What `depth` goes through, where it is 0 and where it is 1.
    angle_in_words
        Where a fibre angle of 0 degrees and one of 90 point.
    constant_fields
        Of `settings.CONSTANT_FIELDS`, those that `output.fields = true` stands for too.
    defaults
        Defaults of other tables that this shape changes, under the keys of preset and scene.
    supported_faces
        Faces that `[supports.NAME]` may put on springs, as in what surrounds the body; None: any face, held in any way.

    Raises
    ------
    SceneError
        If a key is unknown or missing, or a value is not allowed: one line.

    Examples
    --------
    The keys of a new body; tests/body/test_extensions.py has one whole, with mesh, supports and loads:

    >>> from typing import Annotated, Literal
    >>> from pydantic import Field
    >>> from remodel_fenicsx.extend import LENGTH, Shape
    >>> class Bar(Shape):
    ...     shape: Literal["bar"] = "bar"
    ...     length: Annotated[float, LENGTH] = Field(default=4.0, gt=0, description="Length along z.")
    ...
    ...     def build(self, mesh, comm=None):
    ...         raise NotImplementedError("here a script makes a mesh and returns a Domain")
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
    depth_in_words: ClassVar[tuple[str, str, str]] = ("along the body", "bottom", "top")
    angle_in_words: ClassVar[tuple[str, str]] = ("along the load", "across")
    constant_fields: ClassVar[tuple[str, ...]] = ()
    defaults: ClassVar[dict[str, Any]] = {}
    supported_faces: ClassVar[tuple[str, ...] | None] = ()

    shape: str
    """Which body it is."""
    length_unit: LengthUnit = None

    @property
    def is_loaded(self) -> bool:
        """Whether the geometry is that under the loads."""
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
    def proportions(self) -> tuple[tuple[str, str, float, tuple[float, float]], ...]:
        """Ratios of lengths, which tell numbers in different units: key, words, ratio, decades where bodies have it."""
        return ()

    def log_of_radii(self, wall: Any) -> float | None:
        """ln(r_o/r_i) of a wall, of one on a mesh from areas `wall.area(face)`; None where it is not known."""
        return None

    def strut(self, ends: str) -> reduced.Strut | None:
        """What of the body buckles under thrust, held as `supports.ends` says; None if nothing bends it."""
        return None

    def axes_at(self, coordinates: Array) -> Array:
        """Local axes at places (..., 3), rows circumferential, axial, radial: here y, z, x, axial along the load.

        Parameters
        ----------
        coordinates
            Reference places, (..., 3), in the unit of length.
        """
        return np.broadcast_to(np.roll(np.eye(3), -1, axis=0), (*coordinates.shape[:-1], 3, 3))

    def depth(self, coordinates: Array) -> Array:
        """How far places (..., 3) are through the body, from 0 to 1: here along z.

        Parameters
        ----------
        coordinates
            Reference places, (..., 3), in the unit of length.
        """
        return self.station(coordinates)

    def station(self, coordinates: Array) -> Array:
        """How far places (..., 3) are along the body, from 0 to 1: here along z.

        Parameters
        ----------
        coordinates
            Reference places, (..., 3), in the unit of length.
        """
        found: Any = coordinates[..., 2] / self.axial_length
        return found

    def local_axes(self, domain: Domain, quadrature: Quadrature) -> LocalAxes:
        """Axes, depth and station at the points of a mesh of the body: here functions of the place.

        Parameters
        ----------
        domain
            The meshed body.
        quadrature
            Its points.
        """
        places = quadrature.coordinates
        return LocalAxes(
            places,
            lambda: self.axes_at(places),
            lambda: self.depth(places),
            lambda: self.station(places),
            lambda: self.depth(domain.mesh.geometry.x.astype(np.float64)),
        )

    def unresolved(self, mesh: Mesh, columns: Collection[str]) -> list[str]:
        """Warn of columns whose values the elements of a mesh do not resolve, a line each.

        Parameters
        ----------
        mesh
            The table `[mesh]`.
        columns
            Columns that are asked for.
        """
        return []

    @property
    def name(self) -> str:
        """The shape's name."""
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
        """Mesh the body with the regions of a scene, where the scene draws them. Collective."""
        return self.build(mesh, comm)

    def region_depths(self, regions: Regions) -> dict[str, tuple[float, float]]:
        """Where regions that lie one behind the other begin and end in `depth`; empty where they do not."""
        return {}

    @classmethod
    def region_columns_on_request(cls, name: str) -> Columns:
        """Further columns that a scene may name of its region `name`."""
        return ()

    @abstractmethod
    def hold(self, loading: Loading) -> None:
        """Hold the body as it is held without loads, its ends free.

        Parameters
        ----------
        loading
            Of the body; its conditions are added to it.
        """

    def support(self, loading: Loading, ends: str = "free", loads: Collection[str] | None = None) -> None:
        """Hold the body and add loads, each zero.

        Parameters
        ----------
        loading
            Of the body or of its reduction, which has planes of symmetry of its own.
        ends
            Of `Shape.ends`.
        loads
            Names of those that there are; default: all that the body knows and the kinematics has.
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
        """Faces whose supports are `[supports.NAME]`, and none of the shape's own.

        Parameters
        ----------
        supports
            Those of a scene by name of the face.
        """
        return []

    def fills(self, regions: Collection[str]) -> bool:
        """Whether these regions of a scene, by name, are all of the body."""
        return False

    @classmethod
    def loads_on(cls, faces: Mapping[str, OnFace]) -> dict[str, LoadKind]:
        """All loads by name: its own, and those that a scene puts on faces, where any may be held and loaded.

        Parameters
        ----------
        faces
            Of the scene's further loads by name (`faces_of`).
        """
        return cls.loads

    def check_faces(self, domain: Domain, supports: Supports, loads: Loads) -> None:
        """Refuse supports of, and loads on, faces of a mesh that cannot have them. Collective.

        Parameters
        ----------
        domain
            The mesh.
        supports, loads
            As for `hold_faces`.

        Raises
        ------
        SceneError
            On all ranks; one line that names the key.
        """

    def hold_faces(self, loading: Loading, supports: Supports, modulus: float, loads: Loads) -> None:
        """Hold faces as `[supports.NAME]` says.

        Parameters
        ----------
        loading
            Of the body, with all its loads.
        supports
            By name of the face.
        modulus
            lambda + 2 mu of the stiffest matrix in the body, in the scene's unit of stress.
        loads
            Names of those that the scene has.
        """

    @classmethod
    def defaults_of(cls, own: Mapping[str, Any]) -> dict[str, Any]:
        """`defaults` for a scene with these keys, as they were read."""
        return cls.defaults

    @classmethod
    def with_files_from(cls, geometry: Mapping[str, Any], folder: Path) -> dict[str, Any]:
        """The keys of `[geometry]` as they were read from a scene in a folder, with the places of files."""
        return dict(geometry)

    def kept_files(self) -> tuple[dict[str, Any], dict[str, bytes]]:
        """Values that a scene as run has in place of its own, by dotted key, and files beside it by name."""
        return {}, {}

    def check_size(self, mesh: Mesh) -> None:
        """Refuse a mesh that the shape cannot have, whatever its size: raise a `fault` that names the key."""

    def fibre_angle(self, dimensions: Array, axes: Array, local: Array) -> Array:
        """Angle of the chain direction in degrees; here to the load axis z.

        Parameters
        ----------
        dimensions, axes, local
            l_I (..., 3), axes of the cells and local axes of the body as rows (..., 3, 3), all in the reference or all
            in the deformed configuration.

        Returns
        -------
        array (...,)
            Degrees; NaN where the chain direction has no such angle: means are over the others.
        """
        return angle_to_axis(dimensions, axes, np.array([0.0, 0.0, 1.0]))

    def radial_share(self, dimensions: Array, axes: Array, local: Array) -> Array:
        """Share of the chains, by squared length, that `fibre_angle` does not see, (...,); parameters as there."""
        return np.zeros(dimensions.shape[:-1])


# ---------------------------------------------------------------- what some bodies can
class WithRegions(Shape):
    """A body to which a scene may give `[regions.NAME]`, parts with tissue of their own; here they come with its mesh.

    Its keyword arguments are the keys of `[geometry]`, as of every `Shape`.

    Examples
    --------
    >>> from remodel_fenicsx.extend import SHAPES, WithRegions
    >>> [name for name, shape in SHAPES.items() if issubclass(shape, WithRegions)]
    ['tube', 'mesh', 'solid']
    """

    def check_regions(self, regions: Regions, mesh: Mesh) -> None:
        """Refuse what the regions of a scene ask of the body and it cannot have, with the key.

        Parameters
        ----------
        regions
            By name.
        mesh
            Settings of the elements.

        Raises
        ------
        SceneError
            One line that names the key.
        """
        for name, region in regions.items():
            if region.outer_radius is not None:
                rule = f"the regions of a {self.name} come with its mesh; only layers of a tube have an outer radius"
                raise fault(rule, f"regions.{name}.outer_radius", region.outer_radius)


class Unloads(Shape):
    """A body whose loaded shape a scene may give, `geometry.is = "loaded"`."""


class FromFile(Shape):
    """A body whose elements are those of a file: `[mesh]` may divide them, and decides on nothing else."""


def check_lengths(shape: Shape, lengths: dict[str, float]) -> None:
    """Raise the fault of `length_fault` at its key."""
    found = length_fault(lengths)
    if found is not None:
        raise fault(found[1], found[0], getattr(shape, found[0]))


def axial_dead_force(face: str) -> LoadKind:
    """A force along z on a face across it."""
    return LoadKind(
        lambda shape, loading, name: loading.add_dead_force(name, face, component=2),
        "total force along z on the top; its direction stays (a dead load)",
        FORCE,
        reductions=("point",),
        area=lambda shape: shape.section_area,
    )


def uniaxial_columns(top: str, length: str) -> Columns:
    """Columns of a body that is pulled along z: its stretches and its mean fibre angle.

    Parameters
    ----------
    top
        Name of the face that is pulled.
    length
        Name of the body's dimension along z (`Domain.dimensions`).

    Returns
    -------
    tuple of Column
        For `Shape.columns`.

    Examples
    --------
    >>> from remodel_fenicsx.extend import uniaxial_columns
    >>> [column.name for column in uniaxial_columns("z1", "length")]
    ['mean_stretch', 'min_stretch', 'max_stretch', 'mean_fibre_angle']
    """

    def mean_stretch(m: Any) -> float:
        return float(1.0 + m.face_mean(top, m.displacement[:, 2]) / m.domain.dimensions[length])

    return (
        Column("mean_stretch", "", "deformed length over reference length, mean over the top", mean_stretch),
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
            "angle between chains and load axis in the reference body, mean over the volume",
            lambda m: m.quadrature.mean_of_known(m.fibre_angle),
        ),
    )


def cauchy_columns(*names: str) -> Columns:
    """Columns of Cauchy's stress, volume means: of "x" the normal one along x, of "xy" the shear stress.

    Parameters
    ----------
    names
        Letters of one or two axes.

    Returns
    -------
    tuple of Column
        `cauchy_stress_` with each name.

    Examples
    --------
    >>> from remodel_fenicsx.extend import cauchy_columns
    >>> [column.name for column in cauchy_columns("x", "xy")]
    ['cauchy_stress_x', 'cauchy_stress_xy']
    """

    def mean(name: str, m: Any) -> float:
        row, column = "xyz".index(name[0]), "xyz".index(name[-1])
        return m.quadrature.mean(m.stress[..., row, column])

    return tuple(
        Column(f"cauchy_stress_{name}", "stress", f"Cauchy stress {name}, volume mean", partial(mean, name))
        for name in names
    )


def homogeneous_bar(
    bottom: str, top: str, dimensions: Callable[[Any], dict[str, float]], whole: Callable[[Any], reduced.Body]
) -> reduced.Reduction:
    """The reduction "point" of a body between two faces across z, the same strain everywhere."""

    def build(scene: reduced.ReducedScene, comm: MPI.Intracomm | None = None) -> Domain:
        from remodel_fenicsx.body.domain import lattice_domain

        shape, length = scene.geometry, scene.geometry.axial_length
        faces = {bottom: lambda x: np.isclose(x[2], 0.0), top: lambda x: np.isclose(x[2], length)}
        degree: int = scene.mesh.degree
        share = np.linspace(0.0, 1.0, degree + 1)[:, None]
        points = length * ([1.0, 0.0, 0.0] + share * [0.0, 0.0, 1.0])
        return lattice_domain(points, [1], degree, faces, shape.name, dimensions(shape), comm)

    rules = (reduced.same_cells, reduced.symmetric_law, reduced.homogeneous, reduced.known_loads("point"))
    return reduced.Reduction(build, lambda scene: 1, rules, global_axes, lambda shape, points, corners: whole(shape))
