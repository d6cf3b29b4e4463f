"""The picture and the table of docs/reliability.md on random cells: the tendon with 32 seeds and with isotropic cells.

The runs stay in results/seeds and are used again.
"""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from docs.making.pages import DOCS, FIGURES, Columns, drawn, panel_letters, read_table
from remodel_fenicsx import read_scene
from remodel_fenicsx.studies.study import COLOURS, Page, made_with
from remodel_fenicsx.studies.sweep import ensemble
from tests.runs import rows_of

SEEDS = 32
LABELS = {"mean_stretch": "mean stretch", "mean_fibre_angle": "mean fibre angle, degrees"}
CAPTION = (
    "The tendon with random and with isotropic cells",
    f"a: mean stretch, b: mean fibre angle of {SEEDS} seeds of random cells, and of isotropic cells.",
)


def table() -> Columns:
    """Statistics of the seeds over time, and the values of isotropic cells."""
    scene = read_scene(DOCS.parent / "demos" / "tendon.toml")
    folder, _ = ensemble(scene, DOCS.parent / "results" / "seeds", SEEDS)
    found = read_table(folder / "ensemble.csv")
    isotropic = {"cells.initial": "isotropic", "output.fields": False}
    rows = list(rows_of(scene.with_values(isotropic)))
    found = {name: values[1:] for name, values in found.items()}  # the rows of steps
    columns = {"time": found["time"]}
    for name in LABELS:
        columns |= {
            f"{name}_{kind}": found[f"{name}_{kind}"] for kind in ("mean", "std", "min", "max")
        }
        columns[f"{name}_isotropic"] = np.array([row[name] for row in rows])
    return columns


def draw(found: Columns) -> Figure:
    """A panel for each column."""
    figure = Figure(figsize=(7.2, 3.0), layout="constrained")
    panels = figure.subplots(1, 2)
    time, colour = found["time"], COLOURS[0]
    for axes, (name, label) in zip(panels, LABELS.items(), strict=True):
        mean, std, low, high, isotropic = (
            found[f"{name}_{kind}"] for kind in ("mean", "std", "min", "max", "isotropic")
        )
        axes.fill_between(
            time, low, high, color=colour, alpha=0.15, lw=0, label="minimum to maximum"
        )
        axes.fill_between(
            time,
            mean - std,
            mean + std,
            color=colour,
            alpha=0.35,
            lw=0,
            label="one standard deviation",
        )
        axes.plot(time, mean, color=colour, label="random cells, mean of the seeds")
        axes.plot(time, isotropic, "--", color=COLOURS[1], label="isotropic cells")
        axes.set(xlabel="time", ylabel=label, xlim=(0, time[-1]))
    panels[0].legend(fontsize=7)
    panel_letters(*panels)
    return figure


def make(keep: bool) -> None:
    """Run, keep the table, draw."""
    page = Page(FIGURES, "tendon-seeds", *CAPTION)
    if not keep:
        page.save_table(table(), [*CAPTION, made_with()])
    drawn(page, draw, read_table(FIGURES / "tendon-seeds.csv"))
