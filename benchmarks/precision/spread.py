"""What random cells mean: the demo's tendon with many seeds beside isotropic cells."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from remodel_fenicsx.studies.page import COLOURS, STYLE, Page
from remodel_fenicsx.scene.scene import Scene
from remodel_fenicsx.schema.times import same_time
from remodel_fenicsx.studies.ensemble import WITHIN, Ensemble, ensemble, gathered, members_of

Array = NDArray[np.float64]

SEEDS, TIMES = 32, (12.0, 150.0)
PICTURE = "tendon-seeds"
COLUMNS = {"mean_stretch": "mean stretch", "mean_fibre_angle": "mean fibre angle, degrees"}


def run(scene: Scene, folder: Path, jobs: int) -> None:
    """The command `remodel-fenicsx ensemble`; what is recorded is not run again."""
    ensemble(scene, folder, SEEDS, jobs, quiet=False)


def recorded(scene: Scene, folder: Path) -> Ensemble:
    """What the runs have recorded; one that has not reached its end counts as failed."""
    members = members_of(scene, folder, SEEDS)
    return gathered(members, {member.name: "not complete" for member in members if not member.is_complete()})


def rows(found: Ensemble) -> str:
    """The table of the page."""
    table, lines = found.table(), []
    for name, words in COLUMNS.items():
        for time in TIMES:
            at = next(k for k, recorded in enumerate(found.time) if same_time(float(recorded), time))
            kinds = ("mean", "deviation", "least", "most", "isotropic")
            mean, deviation, least, most, isotropic = (float(table[f"{name}_{kind}"][at]) for kind in kinds)
            away = (isotropic - mean) / deviation
            verdict = "within" if abs(away) <= WITHIN else "outside"
            lines.append(f"| {words} | {time:g} | {mean:.5g} | {deviation:.2g} | {least:.5g} to {most:.5g} "
                         f"| {isotropic:.5g} | {away:+.1f} deviations: {verdict} |")  # fmt: skip
    return "\n".join(lines)


def draw(found: Ensemble, folder: Path, made: str) -> None:
    """Write the picture and its numbers."""
    title = f"The tendon: {found.seeds} seeds of random cells, and isotropic cells"
    caption = "Line: mean over the seeds; dark: one standard deviation; light: least to most of all seeds."
    page, table = Page(folder, PICTURE, title, caption), found.table()
    page.save_table({k: v for k, v in table.items() if k == "time" or k.startswith(tuple(COLUMNS))}, [title, made])
    with rc_context(STYLE):
        figure = Figure(figsize=(7.2, 3.0), layout="constrained")
        for axes, (name, words) in zip(figure.subplots(1, len(COLUMNS)), COLUMNS.items(), strict=True):
            _bands(axes, found.time, table, name)
            axes.set(xlabel="time", ylabel=words, xlim=(0, found.time[-1]))
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2)
        page.save_figure(figure, made)


def _bands(axes: Axes, time: Array, table: Mapping[str, Array], name: str) -> None:
    mean, deviation = table[f"{name}_mean"], table[f"{name}_deviation"]
    axes.fill_between(time, table[f"{name}_least"], table[f"{name}_most"], color=COLOURS[0], alpha=0.15)
    axes.fill_between(time, mean - deviation, mean + deviation, color=COLOURS[0], alpha=0.35)
    axes.plot(time, mean, color=COLOURS[0], label="random cells, mean over the seeds")
    axes.plot(time, table[f"{name}_isotropic"], "--", color=COLOURS[1], label="isotropic cells")
    for moment in TIMES:
        axes.axvline(moment, color="0.7", lw=0.6, zorder=0)
