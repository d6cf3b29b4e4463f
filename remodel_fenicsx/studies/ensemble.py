"""`remodel-fenicsx ensemble SCENE`: what random cells mean, by many seeds and by isotropic cells in their place."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from numpy.typing import NDArray

from remodel_fenicsx.body.reductions import only_for_means
from remodel_fenicsx.scene.scene import Scene, SceneError, in_region
from remodel_fenicsx.schema.times import same_time
from remodel_fenicsx.results.run_lock import RunLock
from remodel_fenicsx.results.history import unit_of, words
from remodel_fenicsx.studies.page import COLOURS, STYLE, Page, add_head
from remodel_fenicsx.studies.study import FEWEST_RUNS, Run, TooFewRuns, run_all, write_study
from remodel_fenicsx.system.children import cores
from remodel_fenicsx.system.environment import versions

Array = NDArray[np.float64]

NAME, ISOTROPIC = "ensemble", "isotropic"
NOT_COMPARED = ("time", "seconds", "newton_iterations", "linear_iterations", "substeps")
WITHIN = 2.0  # standard deviations
KNOWN = 6  # seeds from which on a deviation is known to a third: its relative error is 1 / sqrt(2 (seeds - 1))
PANELS = 6


@dataclass(frozen=True)
class Ensemble:
    """Columns of the history over the seeds."""

    time: Array
    columns: dict[str, Array]
    isotropic: dict[str, Array]
    failed: dict[str, str]
    extremes: frozenset[str] = frozenset()
    note: str = ""

    @property
    def seeds(self) -> int:
        """How many there are."""
        return len(next(iter(self.columns.values())))

    @property
    def knows_deviations(self) -> bool:
        """Whether the seeds are enough for them."""
        return self.seeds >= KNOWN

    def away(self, name: str, row: int) -> float:
        """By how many standard deviations isotropic cells miss the mean; NaN where that is not to be compared."""
        values = self.columns[name][:, row]
        deviation = float(values.std(ddof=1))
        if name not in self.isotropic or name in self.extremes or not self.knows_deviations or deviation == 0:
            return np.nan
        return (float(self.isotropic[name][row]) - float(values.mean())) / deviation

    def table(self) -> dict[str, Array]:
        """Columns of ensemble.csv: of each column mean, standard deviation, least, most, and isotropic cells."""
        found = {"time": self.time}
        for name, values in self.columns.items():
            found[f"{name}_mean"], found[f"{name}_deviation"] = values.mean(axis=0), values.std(axis=0, ddof=1)
            found[f"{name}_least"], found[f"{name}_most"] = values.min(axis=0), values.max(axis=0)
            if name in self.isotropic:
                found[f"{name}_isotropic"] = self.isotropic[name]
        return found


def members_of(scene: Scene, folder: Path, seeds: int) -> list[Run]:
    """A run for each seed from the scene's own on, and one with isotropic cells."""
    if not scene.has_random_cells:
        raise SceneError(f"cells.initial = {scene.cells.initial!r}: an ensemble needs 'random' cells")
    if scene.time.tolerance is not None and not scene.time.is_equilibrium:
        raise SceneError(f"time.tolerance = {scene.time.tolerance:g}: each seed would have other steps; leave it out")
    numbers = range(scene.cells.seed, scene.cells.seed + seeds)
    every: dict[str, dict[str, Any]] = {f"seed-{number}": {"cells.seed": number} for number in numbers}
    random = [name for name, properties in scene.properties().items() if properties.cells.initial == "random"]
    isotropic = {f"{in_region(name)}cells.initial": ISOTROPIC for name in random}
    every[ISOTROPIC] = isotropic | {"profile": None}  # of isotropic cells it has steps of a tolerance, not the seeds'
    return [
        Run(name, scene.with_values({"output.fields": False, "name": name, **change}), folder / name)
        for name, change in every.items()
    ]


def ensemble(
    scene: Scene, folder: Path | str | None = None, seeds: int = 32, jobs: int | None = None, quiet: bool = True
) -> tuple[Path, Ensemble]:
    """Run a scene with many seeds, and with isotropic cells."""
    place = Path(folder or Path("results") / f"{scene.name}-{NAME}")
    members = members_of(scene, place, seeds)
    checked = partial(write_study, place, NAME, scene.name, members)
    with RunLock(place):
        failed = run_all(members, jobs or cores(), f"{scene.name} {NAME}", quiet, checked=checked)
        found = gathered(members, failed)
        draw(found, place, scene)
    return place, found


def gathered(members: list[Run], failed: dict[str, str]) -> Ensemble:
    """The histories of all that have not failed."""
    histories = {member.name: member.history() for member in members if member.name not in failed}
    isotropic = dict(histories.pop(ISOTROPIC, {}))
    if len(histories) < FEWEST_RUNS:
        raise TooFewRuns(f"{len(histories)} of {len(members) - 1} seeds reached the end", failed)
    first = next(iter(histories.values()))
    columns = {
        name: np.stack([history[name] for history in histories.values()]) for name in first if name not in NOT_COMPARED
    }
    scene = members[0].scene
    extremes = frozenset(column.name for column in scene.columns() if column.extreme)
    same = {name: isotropic[name] for name in columns if name in isotropic}
    means = only_for_means(scene)
    note = f" The deviations are not those of the whole body: {'; '.join(means)}." if means else ""
    return Ensemble(first["time"], columns, same, failed, extremes, note)


# ---------------------------------------------------------------- in words
def in_words(found: Ensemble, times: list[float]) -> str:
    """A table for a terminal: the columns that differ between seeds, at some times; then the answer in a sentence."""
    table, lines = found.table(), []
    width = max(len(name) for name in found.columns)
    head = f"{'':{width}} {'mean':>11} {'deviation':>11} {'least':>11} {'most':>11} {'isotropic':>11}"
    for time in times:
        row = _row_of(found, time)
        lines += [f"time {time:g}, {found.seeds} seeds", head]
        for name in _varying(found, row):
            numbers = {kind: float(table[f"{name}_{kind}"][row]) for kind in ("mean", "deviation", "least", "most")}
            words = {kind: f"{number:11.5g}" for kind, number in numbers.items()}
            if not found.knows_deviations:
                words["deviation"] = f"{'not known':>11}"
            lines.append(f"{name:{width}} {' '.join(words.values())} {_beside(found, name, row)}")
    return "\n".join([*lines, verdict(found, times[-1])])


def _row_of(found: Ensemble, time: float) -> int:
    return next(row for row, recorded in enumerate(found.time) if same_time(float(recorded), time))


def _varying(found: Ensemble, row: int) -> list[str]:
    """Columns that are no load."""
    return [name for name, values in found.columns.items() if np.ptp(values[:, row]) != 0]


def _beside(found: Ensemble, name: str, row: int) -> str:
    """Isotropic cells, and by how many standard deviations they miss the mean."""
    if name not in found.isotropic:
        return f"{'failed':>11}"
    value, away = float(found.isotropic[name][row]), found.away(name, row)
    if name in found.extremes:
        return f"{value:11.5g}  an extreme: not compared"
    if not np.isfinite(away):
        return f"{value:11.5g}"
    words = "within the spread" if abs(away) <= WITHIN else "outside of it"
    return f"{value:11.5g}  {away:+.1f} deviations: {words}"


def verdict(found: Ensemble, time: float) -> str:
    """Whether isotropic cells say what random ones do, in a sentence."""
    row = _row_of(found, time)
    if not found.isotropic:
        return "Not known: the run with isotropic cells has failed, so there is nothing to compare."
    if not found.knows_deviations:
        return (
            f"Not known: {found.seeds} seeds are too few for a standard deviation; {KNOWN} tell it to a third. The "
            f"same command with --seeds {KNOWN} or more goes on from these."
        )
    away = {name: found.away(name, row) for name in _varying(found, row)}
    compared = {name: number for name, number in away.items() if np.isfinite(number)}
    outside = [f"{name} ({number:+.1f} deviations)" for name, number in compared.items() if abs(number) > WITHIN]
    if not compared:
        return f"At time {time:g} no column differs between the seeds: there is nothing to compare."
    if outside:
        names = ", ".join(outside)
        words = f"At time {time:g} isotropic cells do not stand for random ones: outside of the spread are {names}."
        return words + found.note
    return (
        f"At time {time:g} isotropic cells lie within {WITHIN:g} deviations of the mean of {found.seeds} seeds in all "
        f"{len(compared)} columns: they say what one sample of random cells would.{found.note}"
    )


def chosen_times(scene: Scene) -> list[float]:
    """The end of the last ramp, and the end."""
    step, end = scene.time.step, scene.last_time
    if scene.time.is_equilibrium:
        return [end]
    last = step * round(scene.end_of_ramps / step)
    return [last, end] if step <= last < end else [end]


# ---------------------------------------------------------------- picture
def draw(found: Ensemble, folder: Path, scene: Scene) -> None:
    """Write ensemble.csv and ensemble.png."""
    title = f"{scene.name}: {found.seeds} seeds of random cells, and isotropic cells"
    caption = "Lines: means over the seeds; dark: mean and one standard deviation; light: least and most of all seeds."
    page = Page(folder, NAME, title, caption)
    made_with = ", ".join(f"{name} {version}" for name, version in versions().items() if name != "BLAS")
    table = found.table()
    page.save_table(table, [title, made_with])
    varying = [name for name, values in found.columns.items() if np.nanmax(np.ptp(values, axis=0)) > 0]
    shown = sorted(varying, key=lambda name: name not in _own_columns(scene))[:PANELS]
    columns = scene.columns()
    units = {column.name: unit_of(scene, column.unit) for column in columns}
    with rc_context(STYLE):
        rows = -(-len(shown) // 2)
        figure = Figure(figsize=(7.2, 2.2 * rows + 0.4), layout="constrained")
        grid = figure.subplots(rows, 2, squeeze=False).ravel()
        for axes, name in zip(grid, shown, strict=False):
            mean, deviation = table[f"{name}_mean"], table[f"{name}_deviation"]
            band: dict[str, Any] = {"color": COLOURS[0], "linewidth": 0}
            axes.plot(found.time, mean, color=COLOURS[0], label="random cells, mean over the seeds")
            if found.knows_deviations:
                label = "mean and one standard deviation"
                axes.fill_between(found.time, mean - deviation, mean + deviation, alpha=0.35, label=label, **band)
            least, most = table[f"{name}_least"], table[f"{name}_most"]
            axes.fill_between(found.time, least, most, alpha=0.15, label="least to most of all seeds", **band)
            if name in found.isotropic and name not in found.extremes:
                axes.plot(found.time, found.isotropic[name], "--", color=COLOURS[1], label="isotropic cells")
            unit = units.get(name)
            axes.set(xlabel="time", ylabel=words(name) + (f", {unit}" if unit else ""), xlim=(0, found.time[-1]))
        for axes in grid[len(shown) :]:
            axes.set_axis_off()
        known = {label: line for axes in grid for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}
        figure.legend(list(known.values()), list(known), loc="outside lower center", ncols=2)
        add_head(figure, title, verdict(found, float(found.time[-1])))
        page.save_figure(figure, made_with)


def _own_columns(scene: Scene) -> set[str]:
    """The shape's own columns."""
    return {column.name for column in scene.geometry.columns}
