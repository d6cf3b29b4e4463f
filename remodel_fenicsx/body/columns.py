"""The columns of a history by name: those of every shape, those on request, and which a scene has."""

from __future__ import annotations

from collections.abc import Container, Sequence

from remodel_fenicsx.body import profile
from remodel_fenicsx.body.column import Column
from remodel_fenicsx.body.shape import Shape

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


def columns_of(
    shape: Shape | type[Shape], requested: Sequence[str] = (), loads: Container[str] | None = None
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
        Names of the loads that there are; default: all of the shape's. The column of a load that frees the length of
        the body is on request where it is not among them.

    Raises
    ------
    KeyError
        If a column that is requested does not exist.
    """
    of_loads = (
        kind.make_column(name)
        for name, kind in shape.loads.items()
        if not kind.frees_length or loads is None or name in loads or kind.column_name(name) in requested
    )
    always = (FIRST_COLUMN, *of_loads)
    others = (*shape.columns, *COLUMNS.values())
    chosen = [column for column in others if column.name in requested]
    known = {column.name for column in (*always, *others)}
    on_request = columns_on_request(shape)
    extra = (on_request[name] for name in requested if name not in known)
    return (*always, *(chosen or others), *extra)


def columns_on_request(shape: Shape | type[Shape]) -> dict[str, Column]:
    """Columns by name that a history of this shape has only where a scene names them."""
    return COLUMNS_ON_REQUEST | {column.name: column for column in shape.columns_on_request}
