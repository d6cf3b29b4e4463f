"""`remodel-fenicsx sweep SCENE KEY=a:b:n ...` and `ensemble SCENE`: runs of a scene with other numbers, or seeds."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from remodel_fenicsx.body.reductions import only_for_means
from remodel_fenicsx.results.recording import HistoryColumns
from remodel_fenicsx.scene.scene import Scene, SceneError
from remodel_fenicsx.schema.settings import in_region
from remodel_fenicsx.schema.tables import shown
from remodel_fenicsx.studies.page import COLOURS, Answer, aligned, label, panels
from remodel_fenicsx.studies.study import FEWEST_RUNS, Study, TooFewRuns
from remodel_fenicsx.system.files import MOST_RUNS

Array = NDArray[np.float64]
Number = int | float

OF_THE_SOLVER = ("time", "seconds", "newton_iterations", "linear_iterations", "substeps")
RULE = (
    "must be KEY=a:b:n (n numbers from a to b) or KEY=a,b,..., as in natural.opening_angle=0:160:5; "
    f"n is a whole number from 2 to {MOST_RUNS}"
)
RANGE_RULE = "must be KEY=a:b with --latin, as in loads.pressure.value=2:6"


# ---------------------------------------------------------------- which points
def grid(axes: Mapping[str, Sequence[Number]]) -> list[dict[str, Number]]:
    """All combinations, the last key fastest."""
    if (number := math.prod(map(len, axes.values()))) > MOST_RUNS:
        raise SceneError(f"sweep: {number} runs; allowed are at most {MOST_RUNS}")
    return [dict(zip(axes, numbers, strict=True)) for numbers in itertools.product(*axes.values())]


def latin_hypercube(ranges: Mapping[str, Sequence[Number]], samples: int, seed: int = 1) -> list[dict[str, Number]]:
    """Points of which each `samples`-th part of each range has one, at a random place in it (McKay et al. 1979)."""
    random = np.random.default_rng(seed)
    shares = {key: (random.permutation(samples) + random.random(samples)) / samples for key in ranges}
    return [
        {key: _rounded(low + (high - low) * shares[key][number]) for key, (low, high) in ranges.items()}
        for number in range(samples)
    ]


def _rounded(number: float) -> float:
    """Six digits, as somebody would write it: names of runs tell the numbers."""
    return float(f"{number:.6g}")


def read_axes(texts: Sequence[str], are_ranges: bool = False) -> dict[str, list[Number]]:
    """Numbers by key of "KEY=a:b:n" or "KEY=a,b,..."; the two ends of "KEY=a:b" of ranges."""
    axes: dict[str, list[Number]] = {}
    for text in texts:
        key, numbers = _axis(text, are_ranges)
        if key in axes:
            raise SceneError(f"sweep {key}: this key is given twice")
        axes[key] = numbers
    return axes


def _axis(text: str, is_range: bool) -> tuple[str, list[Number]]:
    key, _, given = (part.strip() for part in text.partition("="))
    has_ends = ":" in given
    try:
        numbers = [_number(part) for part in given.split(":" if has_ends else ",")]
    except ValueError:
        numbers = []
    if is_range:
        fits = has_ends and len(numbers) == 2 and numbers[0] < numbers[1]
    elif has_ends:
        fits = len(numbers) == 3 and numbers[0] != numbers[1] and numbers[2] in range(2, MOST_RUNS + 1)
    else:
        fits = len(numbers) > 0
    if not fits or not re.fullmatch(r"[\w-]+(\.[\w-]+)+", key):
        raise SceneError(f"sweep {shown(text)}: {RANGE_RULE if is_range else RULE}")
    if has_ends and not is_range:
        numbers = _spaced(numbers[0], numbers[1], int(numbers[2]))
    if len(set(numbers)) < len(numbers):
        raise SceneError(f"sweep {shown(text)}: a number is there twice")
    return key, numbers


def _number(text: str) -> Number:
    """A finite number; a whole one stays whole."""
    if not math.isfinite(value := float(text)):
        raise ValueError(text)
    return int(text) if re.fullmatch(r"\s*[+-]?\d+\s*", text) else value


def _spaced(low: Number, high: Number, count: int) -> list[Number]:
    """Whole numbers where both ends and their distance are."""
    if isinstance(low, int) and isinstance(high, int) and (high - low) % (count - 1) == 0:
        return [low + (high - low) // (count - 1) * number for number in range(count)]
    return [_rounded(float(number)) for number in np.linspace(low, high, count)]


# ---------------------------------------------------------------- a sweep: the last rows over the numbers
PANEL_COLUMNS, PANEL_KEYS = 5, 3  # of the picture: what fits on a page
MOST_LINES = 6  # in a panel; where there are more combinations of the other keys, points are drawn


@dataclass(frozen=True)
class Sweep(Answer):
    """Ends of the runs: what has failed is NaN."""

    scene: Scene
    points: dict[str, Mapping[str, Number]]
    histories: dict[str, HistoryColumns]
    failed: dict[str, str] = field(default_factory=dict)

    name = "sweep"
    caption = "Each point is the end of one run; lines join runs whose other numbers are equal."

    @property
    def title(self) -> str:
        """Of the picture."""
        return f"{self.scene.name}: the last row of {len(self.points)} runs"

    @cached_property
    def values(self) -> dict[str, Array]:
        """Numbers of the runs by key."""
        points = list(self.points.values())
        return {key: np.array([point[key] for point in points], dtype=np.float64) for key in points[0]}

    @cached_property
    def columns(self) -> dict[str, Array]:
        """Last rows of the runs by column."""
        ends = {run: {name: float(v[-1]) for name, v in history.items()} for run, history in self.histories.items()}
        names = next(iter(ends.values()))
        return {name: np.array([ends.get(run, {}).get(name, np.nan) for run in self.points]) for name in names}

    @cached_property
    def shown(self) -> list[str]:
        """Columns that differ between the runs, the shape's own first."""
        own = [column.name for column in self.scene.geometry.columns]
        spread = {name: np.nanmax(v) - np.nanmin(v) for name, v in self.columns.items() if np.isfinite(v).any()}
        varying = [name for name, width in spread.items() if width > 0 and name not in OF_THE_SOLVER]
        return sorted(varying, key=lambda name: own.index(name) if name in own else len(own))[:PANEL_COLUMNS]

    def table(self) -> dict[str, Array]:
        """The keys, then the last row of each history."""
        return self.values | self.columns

    def lines(self) -> list[str]:
        """A row for each run."""
        return aligned(self.values | {name: self.columns[name] for name in self.shown}, 12, 6)

    def verdict(self) -> str:
        """Between which ends the columns lie, and where."""
        parts = []
        for name in self.shown[:2]:
            ends = self.columns[name]
            least, most = (f"{ends[run]:.4g} ({self._at(run)})" for run in (np.nanargmin(ends), np.nanargmax(ends)))
            parts.append(f"{name} from {least} to {most}")
        if not parts:
            return "No column of the last row differs between the runs."
        return f"At the end of {len(self.histories)} runs: {'; '.join(parts)}."

    def _at(self, run: Any) -> str:
        return ", ".join(f"{key} {numbers[run]:g}" for key, numbers in self.values.items())

    def figure(self) -> Figure:
        """Columns over keys."""
        keys, rows = list(self.values)[:PANEL_KEYS], max(1, len(self.shown))
        figure = Figure(figsize=(7.2, 2.2 * rows + 0.4), layout="constrained")
        grid = figure.subplots(rows, len(keys), squeeze=False, sharey="row", sharex="col")
        for row, name in zip(grid, self.shown, strict=False):
            row[0].set(ylabel=label(self.scene, name))
            for axes, key in zip(row, keys, strict=True):
                self._draw(axes, name, key)
        for axes, key in zip(grid[-1], keys, strict=True):
            axes.set(xlabel=key)
        for axes in grid[0]:
            if axes.get_legend_handles_labels()[0]:
                axes.legend(loc="lower left", bbox_to_anchor=(0, 1), fontsize=7)
        return figure

    def _draw(self, axes: Any, name: str, key: str) -> None:
        """A column over a key: a line for each combination of the other keys, points where these are many."""
        x, y, others = self.values[key], self.columns[name], [other for other in self.values if other != key]
        groups: dict[str, list[int]] = {}
        for run in range(len(x)):
            groups.setdefault(", ".join(f"{other} {self.values[other][run]:g}" for other in others), []).append(run)
        if len(groups) > MOST_LINES or len(groups) == len(x):
            axes.plot(x, y, "o", color=COLOURS[0])
            return
        for number, (words, runs) in enumerate(groups.items()):
            order = sorted(runs, key=lambda run: float(x[run]))
            axes.plot(x[order], y[order], "o-", color=COLOURS[number % len(COLOURS)], label=words or None)


def sweep(
    scene: Scene,
    points: Sequence[Mapping[str, Number]],
    folder: Path | str | None = None,
    jobs: int | None = None,
    quiet: bool = True,
    sampled: bool = False,
) -> tuple[Path, Sweep]:
    """Run a scene with other numbers; of points that were drawn those that are no scenes have failed."""
    if not FEWEST_RUNS <= len(points) <= MOST_RUNS:
        raise SceneError(f"sweep: {len(points)} runs; allowed are {FEWEST_RUNS} to {MOST_RUNS}")
    named = {"_".join(f"{key}-{value:.10g}" for key, value in point.items()): point for point in points}
    scenes, refused = {}, {}
    for name, point in named.items():
        try:
            scenes[name] = _changed(scene, point)
        except SceneError as error:
            refused[name] = str(error)
            if not sampled or len(refused) > len(points) - FEWEST_RUNS:
                raise
    study = Study("sweep", scene, folder, scenes, jobs, quiet)
    study.failed |= refused

    def answer() -> Sweep:
        histories = study.histories()
        if len(histories) < FEWEST_RUNS:
            raise TooFewRuns(f"{len(histories)} of {len(points)} runs reached the end", study.failed)
        return Sweep(scene, named, histories, study.failed)

    return study.answered(answer)


def _changed(scene: Scene, point: Mapping[str, Number]) -> Scene:
    """With the numbers of a point; some keys take them and mean something else."""
    found = scene.with_values({**point, "output.fields": False})
    for key, value in point.items():
        there: Any = found
        for part in key.split("."):
            there = there[part] if isinstance(there, Mapping) else getattr(there, part)
        if there != value:
            raise SceneError(f"sweep {key}: this key does not take a number")
    return found


# ---------------------------------------------------------------- an ensemble: a sweep of seeds, and isotropic cells
ISOTROPIC = "isotropic"
WITHIN = 2.0  # standard deviations
KNOWN = 6  # seeds from which on a deviation is known to a third: its relative error is 1 / sqrt(2 (seeds - 1))
PANELS = 6


@dataclass(frozen=True)
class Ensemble(Answer):
    """Columns of the history over the seeds, each (seeds, rows), and those of isotropic cells, (rows,)."""

    scene: Scene
    time: Array
    columns: dict[str, Array]
    isotropic: dict[str, Array]
    failed: dict[str, str] = field(default_factory=dict)

    name = "ensemble"
    caption = "Lines: means over the seeds; dark: mean and one standard deviation; light: least and most of all seeds."

    @property
    def title(self) -> str:
        """Of the picture."""
        return f"{self.scene.name}: {self.seeds} seeds of random cells, and isotropic cells"

    @property
    def seeds(self) -> int:
        """How many there are."""
        return len(next(iter(self.columns.values())))

    @property
    def knows_deviations(self) -> bool:
        """Whether the seeds are enough for them."""
        return self.seeds >= KNOWN

    @cached_property
    def extremes(self) -> set[str]:
        """Columns that are not compared: with random cells they grow with the number of cells."""
        return {column.name for column in self.scene.columns() if column.extreme}

    def statistics(self, name: str) -> dict[str, Array]:
        """Of a column over the seeds, at each time."""
        values = self.columns[name]
        spread = {"least": values.min(axis=0), "most": values.max(axis=0)}
        return {"mean": values.mean(axis=0), "deviation": values.std(axis=0, ddof=1)} | spread

    def table(self) -> dict[str, Array]:
        """Of each column mean, standard deviation, least, most, and isotropic cells."""
        found = {"time": self.time}
        for name in self.columns:
            found |= {f"{name}_{kind}": values for kind, values in self.statistics(name).items()}
            if name in self.isotropic:
                found[f"{name}_isotropic"] = self.isotropic[name]
        return found

    def away(self, name: str, row: int) -> float:
        """By how many standard deviations isotropic cells miss the mean; NaN where that is not to be compared."""
        mean, deviation = (float(self.statistics(name)[kind][row]) for kind in ("mean", "deviation"))
        if name not in self.isotropic or name in self.extremes or not self.knows_deviations or deviation == 0:
            return np.nan
        return (float(self.isotropic[name][row]) - mean) / deviation

    def varying(self, row: int) -> list[str]:
        """Columns that are no load."""
        return [name for name, values in self.columns.items() if np.ptp(values[:, row]) != 0]

    def lines(self) -> list[str]:
        """The columns that differ between seeds, at the end."""
        width, row = max(len(name) for name in self.columns), len(self.time) - 1
        lines = [f"time {self.time[row]:g}, {self.seeds} seeds"]
        lines.append(f"{'':{width}} {'mean':>11} {'deviation':>11} {'least':>11} {'most':>11} {ISOTROPIC:>11}")
        for name in self.varying(row):
            cells = {kind: f"{values[row]:11.5g}" for kind, values in self.statistics(name).items()}
            if not self.knows_deviations:
                cells["deviation"] = f"{'not known':>11}"
            lines.append(f"{name:{width}} {' '.join(cells.values())} {self._beside(name, row)}")
        return lines

    def _beside(self, name: str, row: int) -> str:
        """Isotropic cells, and by how many standard deviations they miss the mean."""
        if name not in self.isotropic:
            return f"{'failed':>11}"
        value, away = f"{float(self.isotropic[name][row]):11.5g}", self.away(name, row)
        if name in self.extremes:
            return f"{value}  an extreme: not compared"
        if not np.isfinite(away):
            return value
        return f"{value}  {away:+.1f} deviations: {'within the spread' if abs(away) <= WITHIN else 'outside of it'}"

    def verdict(self) -> str:
        """Whether isotropic cells say what random ones do."""
        time, row = f"At time {self.time[-1]:g}", len(self.time) - 1
        if not self.isotropic:
            return "Not known: the run with isotropic cells has failed, so there is nothing to compare."
        if not self.knows_deviations:
            return (
                f"Not known: {self.seeds} seeds are too few for a standard deviation; {KNOWN} tell it to a third. The "
                f"same command with --seeds {KNOWN} or more goes on from these."
            )
        away = {name: number for name in self.varying(row) if np.isfinite(number := self.away(name, row))}
        outside = [f"{name} ({number:+.1f} deviations)" for name, number in away.items() if abs(number) > WITHIN]
        if not away:
            return f"{time} no column differs between the seeds: there is nothing to compare."
        if outside:
            words = f"do not stand for random ones: outside of the spread are {', '.join(outside)}."
        else:
            words = (
                f"lie within {WITHIN:g} deviations of the mean of {self.seeds} seeds in all {len(away)} columns: they "
                "say what one sample of random cells would."
            )
        means = "; ".join(only_for_means(self.scene))
        note = f" The deviations are not those of the whole body: {means}." if means else ""
        return f"{time} isotropic cells {words}{note}"

    def figure(self) -> Figure:
        """Columns that vary over time, the shape's own first."""
        own = {column.name for column in self.scene.geometry.columns}
        varying = [name for name, values in self.columns.items() if np.nanmax(np.ptp(values, axis=0)) > 0]
        shown = sorted(varying, key=lambda name: name not in own)[:PANELS]
        figure, grid = panels(len(shown), 2.2)
        for axes, name in zip(grid, shown, strict=True):
            self._draw(axes, name)
        known = {words: line for axes in grid for line, words in zip(*axes.get_legend_handles_labels(), strict=True)}
        figure.legend(list(known.values()), list(known), loc="outside lower center", ncols=2)
        return figure

    def _draw(self, axes: Any, name: str) -> None:
        mean, deviation, least, most = self.statistics(name).values()
        band: dict[str, Any] = {"color": COLOURS[0], "linewidth": 0}
        axes.plot(self.time, mean, color=COLOURS[0], label="random cells, mean over the seeds")
        if self.knows_deviations:
            words = "mean and one standard deviation"
            axes.fill_between(self.time, mean - deviation, mean + deviation, alpha=0.35, label=words, **band)
        axes.fill_between(self.time, least, most, alpha=0.15, label="least to most of all seeds", **band)
        if name in self.isotropic and name not in self.extremes:
            axes.plot(self.time, self.isotropic[name], "--", color=COLOURS[1], label="isotropic cells")
        axes.set(xlabel="time", ylabel=label(self.scene, name), xlim=(0, self.time[-1]))


def ensemble(
    scene: Scene, folder: Path | str | None = None, seeds: int = 32, jobs: int | None = None, quiet: bool = True
) -> tuple[Path, Ensemble]:
    """Run a scene with many seeds, and with isotropic cells."""
    study = Study("ensemble", scene, folder, scenes_of_seeds(scene, seeds), jobs, quiet)

    def answer() -> Ensemble:
        histories = study.histories()
        isotropic = dict(histories.pop(ISOTROPIC, {}))
        if len(histories) < FEWEST_RUNS:
            raise TooFewRuns(f"{len(histories)} of {seeds} seeds reached the end", study.failed)
        first = next(iter(histories.values()))
        names = [name for name in first if name not in OF_THE_SOLVER]
        columns = {name: np.stack([history[name] for history in histories.values()]) for name in names}
        same = {name: isotropic[name] for name in names if name in isotropic}
        return Ensemble(scene, first["time"], columns, same, study.failed)

    return study.answered(answer)


def scenes_of_seeds(scene: Scene, seeds: int) -> dict[str, Scene]:
    """A scene for each seed from its own on, and one with isotropic cells."""
    if seeds < FEWEST_RUNS:
        raise SceneError(f"--seeds {seeds}: allowed is a whole number at least {FEWEST_RUNS}")
    if not scene.has_random_cells:
        raise SceneError(f"cells.initial = {scene.cells.initial!r}: an ensemble needs 'random' cells")
    if scene.time.tolerance is not None and not scene.time.is_equilibrium:
        raise SceneError(f"time.tolerance = {scene.time.tolerance:g}: each seed would have other steps; leave it out")
    numbers = range(scene.cells.seed, scene.cells.seed + seeds)
    every: dict[str, dict[str, Any]] = {f"seed-{number}": {"cells.seed": number} for number in numbers}
    random = [name for name, properties in scene.properties().items() if properties.cells.initial == "random"]
    isotropic = {f"{in_region(name)}cells.initial": ISOTROPIC for name in random}
    every[ISOTROPIC] = isotropic | {"profile": None}  # of isotropic cells it has steps of a tolerance, not the seeds'
    return {name: scene.with_values({"output.fields": False, "name": name, **change}) for name, change in every.items()}
