"""Commands `sweep` and `ensemble`: runs of a scene with other parameter values, or other seeds."""

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
    label_of_key,
    panels,
    value_at,
)
from remodel_fenicsx.system.files import MOST_RUNS

Number = int | float
Point = Mapping[str, Number]

OF_THE_SOLVER = ("time", "seconds", "newton_iterations", "linear_iterations", "substeps")
RULE = (
    "must be KEY=a:b:n (n numbers from a to b) or KEY=a,b,..., as in "
    f"natural.opening_angle=0:160:5; n is an integer from 2 to {MOST_RUNS}"
)
RANGE_RULE = "must be KEY=a:b with --latin, as in loads.pressure.value=2:6"


# ---------------------------------------------------------------- points of a sweep
def grid(axes: Mapping[str, Sequence[Number]]) -> list[dict[str, Number]]:
    """Return all combinations of the numbers; the last key varies fastest."""
    if (number := math.prod(map(len, axes.values()))) > MOST_RUNS:
        raise SceneError(f"sweep: {number} runs; must be at most {MOST_RUNS}")
    return [dict(zip(axes, numbers, strict=True)) for numbers in product(*axes.values())]


def latin_hypercube(
    ranges: Mapping[str, Sequence[Number]], samples: int, seed: int = 1
) -> list[dict[str, Number]]:
    """Draw points by Latin hypercube sampling (McKay et al. 1979).

    Each range is divided into `samples` intervals of equal width, and each interval has one point
    at a random position.
    """
    random = np.random.default_rng(seed)
    positions = {
        key: (random.permutation(samples) + random.random(samples)) / samples for key in ranges
    }
    return [
        {
            key: float(f"{low + (high - low) * positions[key][number]:.6g}")
            for key, (low, high) in ranges.items()
        }
        for number in range(samples)
    ]


def read_axes(texts: Sequence[str], are_ranges: bool = False) -> dict[str, list[Number]]:
    """Read numbers by key from "KEY=a:b:n" or "KEY=a,b,...", or the ends of ranges "KEY=a:b"."""
    axes: dict[str, list[Number]] = {}
    for text in texts:
        key, numbers = _axis(text, are_ranges)
        if key in axes:
            raise SceneError(f"sweep {key}: duplicate key")
        axes[key] = numbers
    return axes


def _axis(text: str, is_range: bool) -> tuple[str, list[Number]]:
    key, _, values = (part.strip() for part in text.partition("="))
    has_ends = ":" in values
    try:
        numbers = [_number(part) for part in values.split(":" if has_ends else ",")]
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
        raise SceneError(f"sweep {format_value(text)}: duplicate number")
    return key, numbers


def _number(text: str) -> Number:
    """Read a finite number; an integer stays an integer."""
    if not math.isfinite(value := float(text)):
        raise ValueError(text)
    return int(text) if re.fullmatch(r"\s*[+-]?\d+\s*", text) else value


# ---------------------------------------------------------------- last rows over the parameters
PANEL_COLUMNS, PANEL_KEYS = 5, 3  # largest numbers of panels that fit on a page


@dataclass(frozen=True)
class Sweep(StudyResult):
    """Parameter values and histories of the runs; a failed run has no history."""

    scene: Scene
    points: Mapping[str, Point]
    histories: Mapping[str, Mapping[str, Array]]
    failed: dict[str, str] = field(default_factory=dict)

    name = "sweep"
    caption = "Each point is the end of one run; a line joins them if only one key varies."

    @property
    def about(self) -> str:  # type: ignore[override]
        """Second half of the title: the number of runs."""
        return f"the last row of {len(self.points)} runs"

    @cached_property
    def values(self) -> dict[str, Array]:
        """Parameter values of the runs, (runs,), by key."""
        points = list(self.points.values())
        return {
            key: np.array([point[key] for point in points], dtype=np.float64) for key in points[0]
        }

    @cached_property
    def ends(self) -> dict[str, Array]:
        """Last rows of the runs, (runs,), by column; NaN for failed runs."""
        names = next(iter(self.histories.values()))
        ends = [
            [self.histories[run][n][-1] if run in self.histories else np.nan for n in names]
            for run in self.points
        ]
        return dict(zip(names, np.transpose(ends), strict=True))

    @cached_property
    def shown(self) -> list[str]:
        """Columns that differ between the runs at the end, those of the shape first."""
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
        """Return the columns of sweep.csv: the keys, then the last row of each history."""
        return self.values | self.ends

    def lines(self) -> list[str]:
        """Return the table for a terminal, with a row for each run."""
        return aligned(
            self.values | {name: self.ends[name] for name in self.shown[:PANEL_COLUMNS]}, 12, 6
        )

    def verdict(self) -> str:
        """Return minimum and maximum of the first columns, with their parameters, as a sentence."""
        parts = []
        for name in self.shown[:2]:
            ends = self.ends[name]
            lowest, highest = (
                f"{ends[run]:.4g} ({self._at(run)})"
                for run in (np.nanargmin(ends), np.nanargmax(ends))
            )
            parts.append(f"{name} from {lowest} to {highest}")
        if not parts:
            return "No column of the last row differs between the runs."
        return f"At the end of {len(self.histories)} runs: {'; '.join(parts)}."

    def _at(self, run: np.integer) -> str:
        return ", ".join(f"{key} {numbers[run]:g}" for key, numbers in self.values.items())

    def figure(self) -> Figure:
        """Draw the columns over the keys, a panel for each pair."""
        keys, columns = list(self.values)[:PANEL_KEYS], self.shown[:PANEL_COLUMNS]
        figure = Figure(figsize=(7.2, 2.2 * max(1, len(columns)) + 0.4), layout="constrained")
        grid = figure.subplots(
            max(1, len(columns)), len(keys), squeeze=False, sharey="row", sharex="col"
        )
        for (row, name), (column, key) in product(enumerate(columns), enumerate(keys)):
            axes, order = grid[row, column], np.argsort(self.values[key])
            look = "o-" if len(self.values) == 1 else "o"
            axes.plot(self.values[key][order], self.ends[name][order], look)
            axes.set(xlabel=label_of_key(self.scene, key), ylabel=label(self.scene, name))
            axes.label_outer()
        return figure


def sweep(
    scene: Scene,
    points: Sequence[Point] | Mapping[str, Sequence[Number]] | str,
    folder: Path | str | None = None,
    jobs: int | None = None,
    quiet: bool = True,
    sampled: bool = False,
    scheduler: str | None = None,
) -> tuple[Path, Sweep]:
    """Run a scene at each point. Points without a valid scene raise, or fail if `sampled`.

    Points are also all combinations of the numbers of keys, or of words "KEY=a:b:n KEY=a,b,...".
    """
    axes = read_axes(points.split()) if isinstance(points, str) else points
    points = grid(axes) if isinstance(axes, Mapping) else axes
    if not FEWEST_RUNS <= len(points) <= MOST_RUNS:
        raise SceneError(f"sweep: {len(points)} runs; must be {FEWEST_RUNS} to {MOST_RUNS}")
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
    study = Study("sweep", scene, folder, scenes, jobs, quiet, scheduler)
    return _answered(Sweep, named, refused, study)


Swept = TypeVar("Swept", bound=Sweep)


def _answered(
    kind: type[Swept], points: Mapping[str, Point], refused: Mapping[str, str], study: Study
) -> tuple[Path, Swept]:
    """Run a sweep; at least `FEWEST_RUNS` of its points must reach the end."""
    study.failed |= refused

    def answer() -> Swept:
        histories = study.histories()
        if (reached := len(histories.keys() & points.keys())) < FEWEST_RUNS:
            raise TooFewRuns(f"{reached} of {len(points)} runs reached the end", study.failed)
        return kind(study.scene, points, histories, study.failed)

    return study.run_and_write(answer)


def _changed(scene: Scene, point: Point) -> Scene:
    """Return the scene at a point. Some keys accept numbers but do not store them; these raise."""
    changed = scene.with_values({**point, "output.fields": False})
    for key, value in point.items():
        if value_at(changed, key.split(".")) not in (value, None):
            raise SceneError(f"sweep {key}: this key does not take a number")
    return changed


# ---------------------------------------------------------------- sweeps of seeds
PANELS = 6  # largest number of panels that fit on a page


class Ensemble(Sweep):
    """A sweep of the seed of random cells."""

    name = "ensemble"
    caption = (
        "Lines: means over the seeds; dark: mean and one standard deviation; "
        "light: minimum to maximum of all seeds."
    )

    @property
    def about(self) -> str:  # type: ignore[override]
        """Second half of the title: the number of seeds."""
        return f"{len(self.histories)} seeds of random cells"

    @cached_property
    def statistics(self) -> dict[str, dict[str, Array]]:
        """Mean, standard deviation, minimum and maximum over the seeds, (times,), by column."""
        runs = [*self.histories.values()]
        columns = {
            name: np.array([run[name] for run in runs])
            for name in runs[0]
            if name not in OF_THE_SOLVER
        }
        kinds: dict[str, Any] = {
            "mean": np.mean,
            "std": partial(np.std, ddof=1),
            "min": np.min,
            "max": np.max,
        }
        return {
            name: {kind: of(v, axis=0) for kind, of in kinds.items()} for name, v in columns.items()
        }

    def table(self) -> dict[str, Array]:
        """Return the columns of ensemble.csv: NAME_mean, NAME_std, NAME_min and NAME_max."""
        columns = self.statistics.items()
        statistics = {
            f"{name}_{kind}": values for name, kinds in columns for kind, values in kinds.items()
        }
        return {"time": next(iter(self.histories.values()))["time"], **statistics}

    def lines(self) -> list[str]:
        """Return the table for a terminal: columns that differ between seeds, at the end."""
        rows: dict[str, Any] = {f"{len(self.histories)} seeds": self.shown}
        for kind in ("mean", "std", "min", "max"):
            rows[kind] = [self.statistics[name][kind][-1] for name in self.shown]
        return aligned(rows, 11, 5)

    def verdict(self) -> str:
        """Return mean and standard deviation of the first columns at the end as a sentence."""
        time, seeds = f"At time {self.table()['time'][-1]:g}", len(self.histories)
        if not self.shown:
            return f"{time} no column differs between the {seeds} seeds."
        ends = [
            (name, *(values[-1] for values in self.statistics[name].values()))
            for name in self.shown[:2]
        ]
        parts = [
            f"{name} is {mean:.4g}, with a standard deviation of {std:.2g}"
            for name, mean, std, *_ in ends
        ]
        means = "; ".join(only_for_means(self.scene))
        note = f" The standard deviations are not those of the whole body: {means}."
        return f"{time}, mean of {seeds} seeds: {'; '.join(parts)}.{note if means else ''}"

    def figure(self) -> Figure:
        """Draw the columns that differ between seeds over time, a panel for each."""
        (figure, grid), time = panels(len(self.shown[:PANELS]), 2.2), self.table()["time"]
        for axes, name in zip(grid, self.shown, strict=False):
            mean, std, lowest, highest = self.statistics[name].values()
            band: dict[str, Any] = {"color": COLOURS[0], "linewidth": 0}
            axes.plot(time, mean, color=COLOURS[0], label="random cells, mean over the seeds")
            words = "mean and one standard deviation"
            axes.fill_between(time, mean - std, mean + std, alpha=0.35, label=words, **band)
            axes.fill_between(
                time, lowest, highest, alpha=0.15, label="minimum to maximum of all seeds", **band
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
    scheduler: str | None = None,
) -> tuple[Path, Ensemble]:
    """Run a scene with many consecutive seeds, starting from its own."""
    if seeds < FEWEST_RUNS:
        raise SceneError(f"--seeds {seeds}: must be an integer of at least {FEWEST_RUNS}")
    if not scene.has_random_cells:
        raise SceneError(
            f"cells.initial = {scene.cells.initial!r}: an ensemble needs 'random' cells"
        )
    if scene.time.is_adaptive:
        raise SceneError(
            f"time.tolerance = {scene.time.tolerance:g}: each seed would have other steps; "
            "leave it out"
        )
    first = scene.cells.seed
    points = {f"seed-{n}": {"cells.seed": n} for n in range(first, first + seeds)}
    scenes = {
        name: scene.with_values({"output.fields": False, "name": name, **p})
        for name, p in points.items()
    }
    study = Study("ensemble", scene, folder, scenes, jobs, quiet, scheduler)
    return _answered(Ensemble, points, {}, study)
