"""`remodel-fenicsx sweep SCENE KEY=a:b:n ...` and `ensemble SCENE`: runs of a scene with other numbers, or seeds."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from matplotlib.figure import Figure

from remodel_fenicsx.body.reductions import only_for_means
from remodel_fenicsx.model.tensors import Array
from remodel_fenicsx.scene.scene import Scene, SceneError
from remodel_fenicsx.schema.tables import format_value
from remodel_fenicsx.studies.study import (
    COLOURS,
    FEWEST_RUNS,
    StudyResult,
    Study,
    TooFewRuns,
    aligned,
    label,
    panels,
)
from remodel_fenicsx.system.files import MOST_RUNS

Number = int | float
Point = Mapping[str, Number]

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
    return [dict(zip(axes, numbers, strict=True)) for numbers in product(*axes.values())]


def latin_hypercube(
    ranges: Mapping[str, Sequence[Number]], samples: int, seed: int = 1
) -> list[dict[str, Number]]:
    """Points of which each `samples`-th part of each range has one, at a random place in it (McKay et al. 1979)."""
    random = np.random.default_rng(seed)
    shares = {
        key: (random.permutation(samples) + random.random(samples)) / samples for key in ranges
    }
    return [
        {
            key: float(f"{low + (high - low) * shares[key][number]:.6g}")
            for key, (low, high) in ranges.items()
        }
        for number in range(samples)
    ]


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
        fits = (
            len(numbers) == 3 and numbers[0] != numbers[1] and numbers[2] in range(2, MOST_RUNS + 1)
        )
    else:
        fits = len(numbers) > 0
    if not fits or not re.fullmatch(r"[\w-]+(\.[\w-]+)+", key):
        raise SceneError(f"sweep {format_value(text)}: {RANGE_RULE if is_range else RULE}")
    if has_ends and not is_range:
        spaced = np.linspace(numbers[0], numbers[1], int(numbers[2]))
        numbers = [_number(f"{number:.6g}" if number % 1 else f"{number:.0f}") for number in spaced]
    if len(set(numbers)) < len(numbers):
        raise SceneError(f"sweep {format_value(text)}: a number is there twice")
    return key, numbers


def _number(text: str) -> Number:
    """A finite number; a whole one stays whole."""
    if not math.isfinite(value := float(text)):
        raise ValueError(text)
    return int(text) if re.fullmatch(r"\s*[+-]?\d+\s*", text) else value


# ---------------------------------------------------------------- a sweep: the last rows over the numbers
PANEL_COLUMNS, PANEL_KEYS = 5, 3  # of the picture: what fits on a page


@dataclass(frozen=True)
class Sweep(StudyResult):
    """Numbers by key and histories of the runs; one that has failed has no history."""

    scene: Scene
    points: Mapping[str, Point]
    histories: Mapping[str, Mapping[str, Array]]
    failed: dict[str, str] = field(default_factory=dict)

    name = "sweep"
    caption = "Each point is the end of one run; where one key varies a line joins them."

    @property
    def about(self) -> str:  # type: ignore[override]
        """What is shown."""
        return f"the last row of {len(self.points)} runs"

    @cached_property
    def values(self) -> dict[str, Array]:
        """Numbers of the runs by key."""
        points = list(self.points.values())
        return {
            key: np.array([point[key] for point in points], dtype=np.float64) for key in points[0]
        }

    @cached_property
    def ends(self) -> dict[str, Array]:
        """Last rows of the runs by column; NaN where a run has failed."""
        names = next(iter(self.histories.values()))
        ends = [
            [self.histories[run][n][-1] if run in self.histories else np.nan for n in names]
            for run in self.points
        ]
        return dict(zip(names, np.transpose(ends), strict=True))

    @cached_property
    def shown(self) -> list[str]:
        """Columns that differ between the runs at the end, the shape's own first."""
        own = [column.name for column in self.scene.geometry.columns]
        spread = {
            name: np.nanmax(v) - np.nanmin(v)
            for name, v in self.ends.items()
            if np.isfinite(v).any()
        }
        varying = [
            name for name, width in spread.items() if width > 0 and name not in OF_THE_SOLVER
        ]
        return sorted(varying, key=lambda name: own.index(name) if name in own else len(own))

    def table(self) -> dict[str, Array]:
        """The keys, then the last row of each history."""
        return self.values | self.ends

    def lines(self) -> list[str]:
        """A row for each run."""
        return aligned(
            self.values | {name: self.ends[name] for name in self.shown[:PANEL_COLUMNS]}, 12, 6
        )

    def verdict(self) -> str:
        """Between which ends the columns lie, and where."""
        parts = []
        for name in self.shown[:2]:
            ends = self.ends[name]
            least, most = (
                f"{ends[run]:.4g} ({self._at(run)})"
                for run in (np.nanargmin(ends), np.nanargmax(ends))
            )
            parts.append(f"{name} from {least} to {most}")
        if not parts:
            return "No column of the last row differs between the runs."
        return f"At the end of {len(self.histories)} runs: {'; '.join(parts)}."

    def _at(self, run: np.integer) -> str:
        return ", ".join(f"{key} {numbers[run]:g}" for key, numbers in self.values.items())

    def figure(self) -> Figure:
        """Columns over keys."""
        keys, columns = list(self.values)[:PANEL_KEYS], self.shown[:PANEL_COLUMNS]
        figure = Figure(figsize=(7.2, 2.2 * max(1, len(columns)) + 0.4), layout="constrained")
        grid = figure.subplots(
            max(1, len(columns)), len(keys), squeeze=False, sharey="row", sharex="col"
        )
        for (row, name), (column, key) in product(enumerate(columns), enumerate(keys)):
            axes, order = grid[row, column], np.argsort(self.values[key])
            look = "o-" if len(self.values) == 1 else "o"
            axes.plot(self.values[key][order], self.ends[name][order], look)
            axes.set(xlabel=key, ylabel=label(self.scene, name))
            axes.label_outer()
        return figure


def sweep(
    scene: Scene,
    points: Sequence[Point],
    folder: Path | str | None = None,
    jobs: int | None = None,
    quiet: bool = True,
    sampled: bool = False,
) -> tuple[Path, Sweep]:
    """Run a scene with other numbers; of points that were drawn those that are no scenes have failed."""
    if not FEWEST_RUNS <= len(points) <= MOST_RUNS:
        raise SceneError(f"sweep: {len(points)} runs; allowed are {FEWEST_RUNS} to {MOST_RUNS}")
    named = {
        "_".join(f"{key}-{value:.10g}" for key, value in point.items()): point for point in points
    }
    scenes, refused = {}, {}
    for name, point in named.items():
        try:
            scenes[name] = _changed(scene, point)
        except SceneError as error:
            refused[name] = str(error)
            if not sampled or len(refused) > len(points) - FEWEST_RUNS:
                raise
    return _answered(Sweep, named, refused, Study("sweep", scene, folder, scenes, jobs, quiet))


Swept = TypeVar("Swept", bound=Sweep)


def _answered(
    kind: type[Swept], points: Mapping[str, Point], refused: Mapping[str, str], study: Study
) -> tuple[Path, Swept]:
    """Do the runs of a sweep; at least `FEWEST_RUNS` of its points must reach the end."""
    study.failed |= refused

    def answer() -> Swept:
        histories = study.histories()
        if (reached := len(histories.keys() & points.keys())) < FEWEST_RUNS:
            raise TooFewRuns(f"{reached} of {len(points)} runs reached the end", study.failed)
        return kind(study.scene, points, histories, study.failed)

    return study.run_and_write(answer)


def _changed(scene: Scene, point: Point) -> Scene:
    """With the numbers of a point; some keys take them and mean something else."""
    found = scene.with_values({**point, "output.fields": False})
    for key, value in point.items():
        there: Any = found
        for part in key.split("."):
            there = there[part] if isinstance(there, Mapping) else getattr(there, part)
        if there != value:
            raise SceneError(f"sweep {key}: this key does not take a number")
    return found


# ---------------------------------------------------------------- an ensemble: a sweep of seeds
PANELS = 6


class Ensemble(Sweep):
    """A sweep whose axis is the seed."""

    name = "ensemble"
    caption = "Lines: means over the seeds; dark: mean and one standard deviation; light: least and most of all seeds."

    @property
    def about(self) -> str:  # type: ignore[override]
        """What is shown."""
        return f"{len(self.histories)} seeds of random cells"

    @cached_property
    def statistics(self) -> dict[str, dict[str, Array]]:
        """Of each column over the seeds, at each time."""
        runs = [*self.histories.values()]
        columns = {
            name: np.array([run[name] for run in runs])
            for name in runs[0]
            if name not in OF_THE_SOLVER
        }
        kinds: dict[str, Any] = {
            "mean": np.mean,
            "deviation": partial(np.std, ddof=1),
            "least": np.min,
            "most": np.max,
        }
        return {
            name: {kind: of(v, axis=0) for kind, of in kinds.items()} for name, v in columns.items()
        }

    def table(self) -> dict[str, Array]:
        """Of each column mean, standard deviation, least and most."""
        columns = self.statistics.items()
        found = {
            f"{name}_{kind}": values for name, kinds in columns for kind, values in kinds.items()
        }
        return {"time": next(iter(self.histories.values()))["time"], **found}

    def lines(self) -> list[str]:
        """The columns that differ between seeds, at the end."""
        rows: dict[str, Any] = {f"{len(self.histories)} seeds": self.shown}
        for kind in ("mean", "deviation", "least", "most"):
            rows[kind] = [self.statistics[name][kind][-1] for name in self.shown]
        return aligned(rows, 11, 5)

    def verdict(self) -> str:
        """What the end of the first columns is, and how far seeds are apart."""
        time, seeds = f"At time {self.table()['time'][-1]:g}", len(self.histories)
        if not self.shown:
            return f"{time} no column differs between the {seeds} seeds."
        ends = [
            (name, *(values[-1] for values in self.statistics[name].values()))
            for name in self.shown[:2]
        ]
        parts = [
            f"{name} is {mean:.4g}, with a standard deviation of {deviation:.2g}"
            for name, mean, deviation, *_ in ends
        ]
        means = "; ".join(only_for_means(self.scene))
        note = f" The deviations are not those of the whole body: {means}." if means else ""
        return f"{time}, mean of {seeds} seeds: {'; '.join(parts)}.{note}"

    def figure(self) -> Figure:
        """Columns that differ between seeds, over time."""
        (figure, grid), time = panels(len(self.shown[:PANELS]), 2.2), self.table()["time"]
        for axes, name in zip(grid, self.shown, strict=False):
            mean, deviation, least, most = self.statistics[name].values()
            band: dict[str, Any] = {"color": COLOURS[0], "linewidth": 0}
            axes.plot(time, mean, color=COLOURS[0], label="random cells, mean over the seeds")
            words = "mean and one standard deviation"
            axes.fill_between(
                time, mean - deviation, mean + deviation, alpha=0.35, label=words, **band
            )
            axes.fill_between(
                time, least, most, alpha=0.15, label="least to most of all seeds", **band
            )
            axes.set(xlabel="time", ylabel=label(self.scene, name), xlim=(0, time[-1]))
        if self.shown:
            figure.legend(*grid[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
        return figure


def ensemble(
    scene: Scene,
    folder: Path | str | None = None,
    seeds: int = 32,
    jobs: int | None = None,
    quiet: bool = True,
) -> tuple[Path, Ensemble]:
    """Run a scene with many seeds, from its own on."""
    if seeds < FEWEST_RUNS:
        raise SceneError(f"--seeds {seeds}: allowed is a whole number at least {FEWEST_RUNS}")
    if not scene.has_random_cells:
        raise SceneError(
            f"cells.initial = {scene.cells.initial!r}: an ensemble needs 'random' cells"
        )
    if scene.time.is_adaptive:
        raise SceneError(
            f"time.tolerance = {scene.time.tolerance:g}: each seed would have other steps; leave it out"
        )
    first = scene.cells.seed
    points = {f"seed-{n}": {"cells.seed": n} for n in range(first, first + seeds)}
    scenes = {
        name: scene.with_values({"output.fields": False, "name": name, **p})
        for name, p in points.items()
    }
    return _answered(Ensemble, points, {}, Study("ensemble", scene, folder, scenes, jobs, quiet))
