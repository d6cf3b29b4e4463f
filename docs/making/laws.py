"""The laws beside each other, for docs/time_integration.md: three bodies, seven laws, coarse meshes.

The histories stay in docs/figures/laws.csv; table and picture are made from it alone, so that a test can do the same
without a run.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpi4py import MPI

from docs.making.pages import (
    DOCS,
    FIGURES,
    Columns,
    between_marks,
    by_column,
    drawn,
    markdown,
    panel_letters,
    read_table,
)
from remodel_fenicsx import Scene
from remodel_fenicsx.body import Cube, LoadKind
from remodel_fenicsx.body.domain import Domain
from remodel_fenicsx.body.tube import Tube, whole_tube
from remodel_fenicsx.schema.units import FORCE
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.studies.study import COLOURS, Page
from tests.runs import made

PAGE = DOCS / "time_integration.md"
CAPTION = (
    "The laws beside each other",
    "a: mean angle to z of a cube pulled along x, from t = 50 to 60 more and more along z instead; b: largest change "
    "of A in a pass on it, over r0^2; c: mean stretch of the tendon; d: fibre angle at the outer wall of the artery.",
)


@dataclass(frozen=True)
class CompareLaw:
    """A law with its pairing, and how it is drawn."""

    label: str
    values: dict[str, Any]
    colour: str
    line: str = "-"


LAWS = {
    "explicit": CompareLaw("eq. (11), as printed", {}, COLOURS[0]),
    "explicit-continuous": CompareLaw(
        "eq. (11), continuous", {"pairing": "continuous"}, COLOURS[0], "--"
    ),
    "rate": CompareLaw("eq. (10)", {"law": "rate"}, COLOURS[2]),
    "rate-continuous": CompareLaw(
        "eq. (10), continuous", {"law": "rate", "pairing": "continuous"}, COLOURS[2], "--"
    ),
    "relaxation": CompareLaw("relaxation", {"law": "relaxation"}, COLOURS[3]),
    "relaxation-continuous": CompareLaw(
        "relaxation, continuous", {"law": "relaxation", "pairing": "continuous"}, COLOURS[3], "--"
    ),
    "rotation": CompareLaw(
        "rotation (Remark 5)", {"law": "rotation", "rotation_time": 40.0}, COLOURS[1]
    ),
}


@dataclass(frozen=True)
class Case:
    """A body under its loads, and which of its columns are compared: an angle and a size."""

    label: str
    scene: dict[str, Any]
    angle: str
    size: str
    domain: Callable[[], Domain] | None = None


def sideways(shape: Any, loading: Any, name: str) -> None:
    """A dead force along x on the cube."""
    loading.add_dead_force(name, "x1", component=0)


SIDEWAYS = LoadKind(sideways, "total dead force along x on the side x = 1", FORCE)
TURN = {"value": 4.0, "ramp": [[0.0, 0.0], [10.0, 1.0], [50.0, 1.0], [60.0, 0.0]]}
TURNED = {"value": 4.0, "ramp": [[0.0, 0.0], [50.0, 0.0], [60.0, 1.0]]}
SHORT = Tube(inner_radius=1.0, outer_radius=3.0, length=0.5)
CASES = {
    "cube": Case(
        "load that turns",
        {
            "geometry": {"shape": "cube"}, "cells": {"initial": [0.8, 0.424264069, 0.424264069]},
            "loads": {"force": TURNED, "sideways": TURN}, "time": {"end": 150.0},
        },
        "mean_fibre_angle", "mean_stretch",
    ),
    "tendon": Case(
        "tendon", {"geometry": {"shape": "tendon"}, "time": {"end": 30.0}}, "mean_fibre_angle", "mean_stretch"
    ),
    "artery": Case(
        "artery", {"geometry": {"shape": "tube", "length": 0.5}, "time": {"end": 100.0}},
        "fibre_angle_outer", "outer_radius", lambda: whole_tube(SHORT, (12, 8, 1), "hexahedron", 1, MPI.COMM_SELF),
    ),
}  # fmt: skip
COLUMNS = ("time", "angle", "size", "change", "newton_iterations", "substeps")


# ---------------------------------------------------------------- runs
def history(case: Case, law: CompareLaw, **changes: Any) -> Iterator[dict[str, float]]:
    """`COLUMNS` of every step of a run; a run that cannot go on ends early."""
    Cube.loads["sideways"] = SIDEWAYS
    values = {"preset": "kuhl-holzapfel-2007", "remodeling": {"frame": "material", **law.values}}
    scene = Scene(**values, **case.scene, output={"columns": ["pass_residual"]}).with_values(
        changes
    )
    names = ("time", case.angle, case.size, "pass_residual", "newton_iterations", "substeps")
    with made(scene, case.domain() if case.domain else None) as simulation:
        try:
            for step in simulation.steps():
                yield {
                    column: float(step.row[name])
                    for column, name in zip(COLUMNS, names, strict=True)
                }
        except StepFailure as failure:
            print(f"laws: {failure}", file=sys.stderr)


def histories() -> Iterator[dict[str, Any]]:
    """Of all cases and laws."""
    for name, case in CASES.items():
        for law, settings in LAWS.items():
            for row in history(case, settings):
                yield {"case": name, "law": law, **row}


def kept_runs() -> dict[tuple[str, str], Columns]:
    """Columns of each run in the table, by case and law."""
    table = read_table(FIGURES / "laws.csv")
    case, law = table["case"], table["law"]
    return {(one, other): {name: table[name][(case == one) & (law == other)] for name in COLUMNS}
            for one in CASES for other in LAWS}  # fmt: skip


# ---------------------------------------------------------------- table and picture
def comparison() -> str:
    """The table in Markdown: a row for each law, a column for each case."""
    runs = kept_runs()

    def shown(case: str, law: str) -> str:
        found = runs[case, law]
        return (
            f"{found['angle'][-1]:.1f}°, {found['size'][-1]:.3f}, {found['change'][1:].max():.3f}"
        )

    rows = (
        [settings.label, *(shown(case, law) for case in CASES)] for law, settings in LAWS.items()
    )
    return markdown(["law", *(case.label for case in CASES.values())], rows)


def page_text() -> str:
    """The page with its table made anew."""
    return between_marks(PAGE.read_text(encoding="utf-8"), "laws", comparison())


def draw(runs: dict[tuple[str, str], Columns]) -> Figure:
    """Four panels, a line for each law."""
    figure = Figure(figsize=(7.2, 6.0))
    panels = [figure.add_axes((x, y, 0.395, 0.33)) for y in (0.62, 0.17) for x in (0.075, 0.58)]
    _curves(panels[0], runs, "cube", "angle", "mean fibre angle to z (degrees)")
    _curves(panels[1], runs, "cube", "change", r"largest change of $A$ / $r_0^2$")
    _curves(panels[2], runs, "tendon", "size", "mean stretch")
    _curves(panels[3], runs, "artery", "angle", "fibre angle, outer wall (degrees)")
    panels[1].set(yscale="log", ylim=(1e-4, 3))
    for axes in panels[:2]:
        axes.axvspan(50, 60, color="0.92", lw=0)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=4, fontsize=8)
    panel_letters(*panels)
    return figure


def _curves(
    axes: Axes, runs: dict[tuple[str, str], Columns], case: str, what: str, label: str
) -> None:
    for name, law in LAWS.items():
        found = runs[case, name]
        axes.plot(
            found["time"], found[what], color=law.colour, ls=law.line, lw=1.3, label=law.label
        )
    axes.set(xlabel="time $t$", ylabel=label, xlim=(0, None), title=CASES[case].label)


def make(keep: bool) -> None:
    """Run, draw, write the table into the page."""
    page = Page(FIGURES, "laws", *CAPTION)
    if not keep:
        notes = ["docs/making/laws.py; change: max |A_pass - A| of the pass after the row"]
        page.save_table(by_column(histories()), notes)
    drawn(page, draw, kept_runs(), made="docs/making/laws.py")
    PAGE.write_text(page_text(), encoding="utf-8")
