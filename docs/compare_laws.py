"""Runs the laws beside each other for docs/laws.md: ./with-fenicsx python3 docs/compare_laws.py

Three bodies, seven laws, coarse meshes. `compare_laws.py tendon cube` runs these bodies again and keeps the others. The
histories stay in docs/figures/laws.csv; table and picture are made from it alone, so that a test can do the same
without a run.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpi4py import MPI

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS), str(DOCS.parent)]

from remodel_fenicsx import Scene, Simulation  # noqa: E402
from remodel_fenicsx.body import Cube, LoadKind  # noqa: E402
from remodel_fenicsx.body.domain import Domain  # noqa: E402
from remodel_fenicsx.body.tube import Tube, whole_tube  # noqa: E402
from remodel_fenicsx.studies.page import COLOURS, STYLE, Page, panel_letters, read_table  # noqa: E402
from remodel_fenicsx.schema.units import FORCE  # noqa: E402
from remodel_fenicsx.solver.continuation import StepFailure  # noqa: E402

KEPT, PAGE = DOCS / "figures", DOCS / "laws.md"
LATE = 10  # steps at the end of a run in which the cells should have come to rest
MARKS = ("<!-- laws: ./with-fenicsx python3 docs/compare_laws.py -->\n\n", "\n<!-- end of laws -->")
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
    "explicit-continuous": CompareLaw("eq. (11), continuous", {"pairing": "continuous"}, COLOURS[0], "--"),
    "rate": CompareLaw("eq. (10)", {"law": "rate"}, COLOURS[2]),
    "rate-continuous": CompareLaw("eq. (10), continuous", {"law": "rate", "pairing": "continuous"}, COLOURS[2], "--"),
    "relaxation": CompareLaw("relaxation", {"law": "relaxation"}, COLOURS[3]),
    "relaxation-continuous": CompareLaw(
        "relaxation, continuous", {"law": "relaxation", "pairing": "continuous"}, COLOURS[3], "--"
    ),
    "rotation": CompareLaw("rotation (Remark 5)", {"law": "rotation", "rotation_time": 40.0}, COLOURS[1]),
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
CASES = {
    "cube": Case(
        "load that turns",
        {
            "geometry": {"shape": "cube"},
            "cells": {"initial": [0.8, 0.424264069, 0.424264069]},
            "loads": {"force": TURNED, "sideways": TURN},
            "time": {"end": 150.0},
        },
        "mean_fibre_angle",
        "mean_stretch",
    ),
    "tendon": Case(
        "tendon", {"geometry": {"shape": "tendon"}, "time": {"end": 30.0}}, "mean_fibre_angle", "mean_stretch"
    ),
    "artery": Case(
        "artery",
        {"geometry": {"shape": "tube", "length": 0.5}, "time": {"end": 100.0}},
        "fibre_angle_outer",
        "outer_radius",
        lambda: whole_tube(
            Tube(inner_radius=1.0, outer_radius=3.0, length=0.5), (12, 8, 1), "hexahedron", 1, MPI.COMM_SELF
        ),
    ),
}
COLUMNS = ("time", "angle", "size", "change", "newton_iterations", "substeps")
Columns = dict[str, np.ndarray]


# ---------------------------------------------------------------- runs


def history(case: Case, law: CompareLaw, **changes: Any) -> list[list[float]]:
    """`COLUMNS` of every step of a run; a run that cannot go on ends early."""
    Cube.loads["sideways"] = SIDEWAYS
    values = {"preset": "kuhl-holzapfel-2007", "remodeling": {"frame": "material", **law.values}}
    scene = Scene(**values, **case.scene, output={"columns": ["pass_residual"]}).with_values(changes)
    simulation = Simulation(scene, MPI.COMM_SELF, case.domain() if case.domain else None)
    names = ("time", case.angle, case.size, "pass_residual", "newton_iterations", "substeps")
    found: list[list[float]] = []
    try:
        for step in simulation.steps():
            found.append([float(step.row[name]) for name in names])
    except StepFailure as failure:
        print(f"laws: {failure}", file=sys.stderr)
    simulation.close()
    return found


def run(names: Sequence[str], folder: Path) -> None:
    """Histories of these cases into the table, which keeps those of the others."""
    path = folder / "laws.csv"
    kept = read_table(path) if path.exists() else {}
    rows = [row for row in zip(*kept.values(), strict=True) if row[0] not in names]
    for name in names:
        for law, settings in LAWS.items():
            print(f"laws: {name}, {settings.label}", file=sys.stderr, flush=True)
            rows += [(name, law, *step) for step in history(CASES[name], settings)]
    columns = {column: [row[i] for row in rows] for i, column in enumerate(("case", "law", *COLUMNS))}
    columns |= {column: np.array(columns[column], dtype=float) for column in COLUMNS}  # type: ignore[dict-item]
    Page(folder, "laws").save_table(
        columns, ["docs/compare_laws.py; change: max |A_pass - A| of the pass after the row"]
    )


def kept_runs(folder: Path) -> dict[tuple[str, str], Columns]:
    """Columns of each run in the table, by case and law."""
    table = read_table(folder / "laws.csv")
    case, law = table["case"], table["law"]
    return {(one, other): {name: table[name][(case == one) & (law == other)] for name in COLUMNS}
            for one in CASES for other in LAWS}  # fmt: skip


# ---------------------------------------------------------------- table and picture


def comparison(folder: Path = KEPT) -> str:
    """The table in Markdown."""
    header = ("case", "law", "to t =", "fibre angle", "size", "largest change of A", "late", "Newton", "in parts")
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    for (case, law), found in kept_runs(folder).items():
        cells = (
            CASES[case].label,
            LAWS[law].label,
            f"{found['time'][-1]:g}",
            f"{found['angle'][-1]:.1f}°",
            f"{found['size'][-1]:.3f}",
            f"{found['change'][1:].max():.3f}",
            f"{found['change'][-LATE:].max():.1e}",
            f"{found['newton_iterations'].sum():.0f}",
            f"{(found['substeps'] > 1).sum()}",
        )
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def draw(folder: Path) -> None:
    """The picture."""
    runs = kept_runs(folder)
    figure = Figure(figsize=(7.2, 6.0))
    panels = [figure.add_axes((x, y, 0.395, 0.33)) for y in (0.62, 0.17) for x in (0.075, 0.58)]
    _curves(panels[0], runs, "cube", "angle", "mean fibre angle to z (degrees)")
    _curves(panels[1], runs, "cube", "change", r"largest change of $A$ / $r_0^2$")
    _curves(panels[2], runs, "tendon", "size", "mean stretch")
    _curves(panels[3], runs, "artery", "angle", "fibre angle, outer wall (degrees)")
    panels[1].set(yscale="log", ylim=(1e-4, 3))
    for axes, title in zip(panels, ("load that turns", "load that turns", "tendon", "artery"), strict=True):
        axes.set_title(title)
    for axes in panels[:2]:
        axes.axvspan(50, 60, color="0.92", lw=0)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=4, fontsize=8)
    panel_letters(*panels)
    Page(folder, "laws", *CAPTION).save_figure(figure, "docs/compare_laws.py")


def _curves(axes: Axes, runs: dict[tuple[str, str], Columns], case: str, what: str, label: str) -> None:
    for name, law in LAWS.items():
        found = runs[case, name]
        axes.plot(found["time"], found[what], color=law.colour, ls=law.line, lw=1.3, label=law.label)
    axes.set(xlabel="time $t$", ylabel=label, xlim=(0, None))


def main(names: Sequence[str]) -> None:
    """Run, draw, write the table into the page."""
    for name in names or CASES:
        run([name], KEPT)
    with matplotlib.rc_context(STYLE):
        draw(KEPT)
    text = PAGE.read_text(encoding="utf-8")
    head, tail = text.split(MARKS[0])[0], text.split(MARKS[1])[1]
    PAGE.write_text(head + MARKS[0] + comparison() + MARKS[1] + tail, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
