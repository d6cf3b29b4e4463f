"""The columns of a history: those of every shape, those on request, and which a scene has."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.settings import faces_of

if TYPE_CHECKING:  # a shape has columns
    from remodel_fenicsx.body.shape import Shape

Array = NDArray[np.float64]


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

    def of_case(self, number: int) -> Column:
        """The same of another load case; the first one is 1.

        Parameters
        ----------
        number
            Of the load case, from 1.
        """
        name, meaning = f"{self.name}@{number}", f"{self.meaning}, in load case {number}"
        return replace(self, name=name, meaning=meaning, value=lambda m: self.value(m.of_case(number)))


# ---------------------------------------------------------------- the fibre angle through a body, whatever the mesh
PROFILE_PLACES = 9
PROFILE = tuple(f"angle_profile_{number}" for number in range(PROFILE_PLACES))


def profile_weights(depth: Array) -> Array:
    """Hat functions about equally spaced depths from 0 to 1, along one more axis; their sum is one."""
    return np.maximum(
        0.0, 1.0 - np.abs(np.asarray(depth)[..., None] * (PROFILE_PLACES - 1) - np.arange(PROFILE_PLACES))
    )


def _profile_value(number: int, measurement: Any) -> float:
    return float(measurement.tool_of_step("angle profile", lambda: _profile(measurement))[number])


def _profile(measurement: Any) -> Array:
    quadrature, local_axes = measurement.quadrature, measurement.state.cells.local_axes
    hats = measurement.tool("hats", lambda: profile_weights(local_axes.depth))
    return np.array([quadrature.mean_of_known(measurement.fibre_angle, hats[..., k]) for k in range(PROFILE_PLACES)])


_PROFILE_COLUMNS = tuple(
    Column(
        name,
        "degrees",
        f"mean reference fibre angle near {number}/{PROFILE_PLACES - 1} of the way through the wall of a tube, or "
        "along z in a cube or tendon; the weight is a hat function as wide as a quarter of the way",
        partial(_profile_value, number),
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
            f"mean reference fibre angle in the region `{name}`; chains without an angle do not count",
            lambda m: float(m.quadrature.mean_of_known(m.fibre_angle, m.elements_of_region(name))),
            by_case=False,
        ),
        Column(
            f"max_chain_extension_{name}",
            "",
            f"largest r/L in the region `{name}`; 0 where the chain law has no limit",
            lambda m: float(m.quadrature.maximum(m.chain_extension * m.elements_of_region(name)[:, None])),
            extreme=True,
        ),
    )


# ---------------------------------------------------------------- which a history has
FIRST_COLUMN = Column("time", "time", "time of the scene", lambda m: m.step.time, by_case=False)
COLUMNS: dict[str, Column] = {
    column.name: column
    for column in (
        Column(
            "max_chain_extension",
            "",
            "largest r/L of all chains, always below 1; 0 where the chain law has no limit",
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
            "strain energy of the body, the integral of W",
            lambda m: m.equilibrium.stored_energy(),
        ),
        Column(
            "remodeling_power",
            "stress length^3 / time",
            "energy per time that the remodeling pass after this row releases (docs/theory.md)",
            lambda m: m.step.remodeling_power,
            after_pass=True,
        ),
        Column(
            "newton_iterations",
            "",
            "Newton iterations of the step, with those of failed attempts",
            lambda m: m.step.work.newton_iterations,
            by_case=False,
        ),
        Column(
            "linear_iterations",
            "",
            "iterations of the linear solver in the step, with those of failed attempts",
            lambda m: m.step.work.linear_iterations,
            by_case=False,
        ),
        Column(
            "substeps",
            "",
            "number of solves that made up the step; 1 where it was solved in one piece, as in the paper",
            lambda m: m.step.work.substeps,
            by_case=False,
        ),
        Column("seconds", "s", "wall time of the step", lambda m: m.step.seconds, after_pass=True),
    )
}
"""Columns of every shape by name, after `time` and those of the shape; a script adds its own."""


def _turned_over(name: str, m: Any) -> float:
    return float(m.observer.stepper.turnover.mean(name))


TURNOVER_POWER = "turnover_power"
COLUMNS_ON_REQUEST: dict[str, Column] = {
    column.name: column
    for column in (
        Column(
            "pass_residual",
            "squared link length",
            "distance of the cells from those that their own stress asks for: largest norm of A_pass - A",
            lambda m: m.observer.stepper.remodeling.residual(),
            after_pass=True,
        ),
        Column(
            "time_error",
            "degrees",
            "estimated error in time, the larger of two: of chain directions (root mean square over the body) and of "
            "lengths (relative, 100 % count as 1 radian); with `time.tolerance` it is there without being asked for",
            lambda m: m.step.time_error,
            after_pass=True,
        ),
        Column(
            "negative_eigenvalues",
            "",
            "number of negative eigenvalues of the tangent's symmetric part; 0 where the equilibrium is stable",
            lambda m: m.step.negative_eigenvalues,
            by_case=False,
        ),
        Column(
            "held_points",
            "",
            "number of points at which the coupling 'implicit' found no cells that fit their own stress",
            lambda m: m.step.work.held_points,
            by_case=False,
        ),
        Column(
            "asleep_share",
            "",
            "share of the volume that does not remodel: no principal value of the driver is above remodeling.threshold",
            lambda m: m.observer.stepper.remodeling.asleep_share(),
            by_case=False,
        ),
        *(
            Column(
                name,
                "",
                f"{what} of the collagen over that at the start, volume mean; for scenes with remodeling.turnover",
                partial(_turned_over, name),
                by_case=False,
            )
            for name, what in (("content", "amount"), ("natural_length", "natural length"))
        ),
        Column(
            TURNOVER_POWER,
            "stress length^3 / time",
            "power that turnover releases in the state of the row; for scenes with remodeling.turnover",
            lambda m: m.observer.stepper.turnover.power(),
            by_case=False,
        ),
        Column(
            "processor_seconds",
            "s",
            "processor time of the first rank in the step; other programs on the machine change it less than `seconds`",
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
) -> tuple[Column, ...]:
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
    on_request = columns_on_request(shape)
    extra = (on_request[name] for name in requested if name not in known)
    found = (*always, *(chosen or others), *extra)
    differ = [column for column in found if column.by_case and not column.after_pass]
    return (*found, *(column.of_case(number) for number in range(2, cases + 1) for column in differ))


def columns_on_request(shape: Shape | type[Shape]) -> dict[str, Column]:
    """Columns by name that a history of this shape has only where a scene names them."""
    return COLUMNS_ON_REQUEST | {column.name: column for column in shape.columns_on_request}
