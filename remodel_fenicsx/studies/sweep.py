"""`remodel-fenicsx sweep SCENE KEY=a:b:n ...`: how the end of a run depends on numbers of its scene."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from numpy.typing import NDArray

from remodel_fenicsx.results.run_lock import RunLock
from remodel_fenicsx.results.history import unit_of, words
from remodel_fenicsx.scene.scene import Scene, SceneError
from remodel_fenicsx.schema.tables import shown
from remodel_fenicsx.studies.page import COLOURS, STYLE, Page, add_head
from remodel_fenicsx.studies.study import FEWEST_RUNS, Run, TooFewRuns, run_all, write_study
from remodel_fenicsx.system.files import MOST_RUNS
from remodel_fenicsx.system.children import cores
from remodel_fenicsx.system.environment import versions

Array = NDArray[np.float64]
Number = int | float

SWEEP = "sweep"
NOT_SHOWN = ("time", "seconds", "newton_iterations", "linear_iterations", "substeps")
PANEL_COLUMNS, PANEL_KEYS = 5, 3  # of the picture: what fits on a page
MOST_LINES = 6  # in a panel; where there are more combinations of the other keys, points are drawn
RULE = "must be KEY=a:b:n (n numbers from a to b) or KEY=a,b,..., as in natural.opening_angle=0:160:5"
RANGE_RULE = "must be KEY=a:b with --latin, as in loads.pressure.value=2:6"


@dataclass(frozen=True)
class Sweep:
    """Ends of the runs."""

    values: dict[str, Array]
    columns: dict[str, Array]
    names: list[str]
    failed: dict[str, str]


# ---------------------------------------------------------------- which runs
def grid(axes: Mapping[str, Sequence[Number]]) -> list[dict[str, Number]]:
    """All combinations, the last key fastest."""
    return [dict(zip(axes, numbers, strict=True)) for numbers in itertools.product(*axes.values())]


def latin_hypercube(ranges: Mapping[str, tuple[float, float]], samples: int, seed: int = 1) -> list[dict[str, Number]]:
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


def read_axis(text: str, samples: int | None = None) -> tuple[str, list[Number]]:
    """Key and numbers of "KEY=a:b:n" or "KEY=a,b,..."; of "KEY=a:b", with samples, the two ends."""
    key, equals, given = (part.strip() for part in text.partition("="))
    rule = RULE if samples is None else RANGE_RULE
    if not equals or not re.fullmatch(r"[\w-]+(\.[\w-]+)+", key):
        raise SceneError(f"sweep {shown(text)}: {rule}")
    parts = given.split(":") if ":" in given else given.split(",")
    numbers = [_number(part) for part in parts]
    if any(number is None or not math.isfinite(number) for number in numbers):
        raise SceneError(f"sweep {shown(text)}: {rule}")
    found = [number for number in numbers if number is not None]
    if samples is not None:
        if ":" not in given or len(found) != 2 or not found[0] < found[1]:
            raise SceneError(f"sweep {shown(text)}: {rule}")
        return key, found
    if ":" in given:
        found = _spaced(text, found)
    if len(set(found)) < len(found):
        raise SceneError(f"sweep {shown(text)}: a number is there twice")
    return key, found


def _number(text: str) -> Number | None:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return None


def _spaced(text: str, given: list[Number]) -> list[Number]:
    """n numbers from a to b; whole ones where a, b and their distance are."""
    if len(given) != 3 or not isinstance(given[2], int) or not 2 <= given[2] <= MOST_RUNS or given[0] == given[1]:
        raise SceneError(f"sweep {shown(text)}: {RULE}; n is a whole number from 2 to {MOST_RUNS}")
    (low, high), count = given[:2], int(given[2])
    if isinstance(low, int) and isinstance(high, int) and (high - low) % (count - 1) == 0:
        return [low + (high - low) // (count - 1) * number for number in range(count)]
    return [_rounded(float(number)) for number in np.linspace(low, high, count)]


def members_of(
    scene: Scene, points: Sequence[Mapping[str, Number]], folder: Path, sampled: bool = False
) -> tuple[list[str], list[Run], dict[str, str]]:
    """Names of the points, runs, and why points that were drawn have none: nobody has typed their numbers."""
    if not FEWEST_RUNS <= len(points) <= MOST_RUNS:
        raise SceneError(f"sweep: {len(points)} runs; allowed are {FEWEST_RUNS} to {MOST_RUNS}")
    names, members, refused = [], [], {}
    for point in points:
        names.append(name := "_".join(f"{key}-{value:.10g}" for key, value in point.items()))
        try:
            changed = scene.with_values({**point, "output.fields": False})
        except SceneError as error:
            refused[name] = str(error)
            if not sampled or len(refused) > len(points) - FEWEST_RUNS:
                raise
            continue
        if any(value != _value_of(changed, key) for key, value in point.items()):
            raise SceneError(f"sweep {', '.join(point)}: one of these keys does not take a number")
        members.append(Run(name, changed, folder / name))
    return names, members, refused


def _value_of(scene: Scene, key: str) -> Any:
    found: Any = scene
    for part in key.split("."):
        found = found[part] if isinstance(found, Mapping) else getattr(found, part)
    return found


# ---------------------------------------------------------------- runs
def sweep(
    scene: Scene,
    points: Sequence[Mapping[str, Number]],
    folder: Path | str | None = None,
    jobs: int | None = None,
    quiet: bool = True,
    sampled: bool = False,
) -> tuple[Path, Sweep]:
    """Run a scene with other numbers, several runs at a time."""
    place = Path(folder or Path("results") / f"{scene.name}-{SWEEP}")
    names, members, refused = members_of(scene, points, place, sampled)
    checked = partial(write_study, place, SWEEP, scene.name, members)
    with RunLock(place):
        failed = refused | run_all(members, jobs or cores(), f"{scene.name} {SWEEP}", quiet, checked=checked)
        found = gathered(names, members, points, failed)
        draw(found, place, scene)
    return place, found


def gathered(
    every: list[str], members: Sequence[Run], points: Sequence[Mapping[str, Number]], failed: dict[str, str]
) -> Sweep:
    """The last rows of all that have not failed."""
    ends = {
        member.name: {name: float(values[-1]) for name, values in member.history().items()}
        for member in members
        if member.name not in failed
    }
    if len(ends) < FEWEST_RUNS:
        raise TooFewRuns(f"{len(ends)} of {len(every)} runs reached the end", failed)
    values = {key: np.array([point[key] for point in points], dtype=np.float64) for key in points[0]}
    names = next(iter(ends.values()))
    columns = {name: np.array([ends.get(one, {}).get(name, np.nan) for one in every]) for name in names}
    return Sweep(values, columns, every, failed)


# ---------------------------------------------------------------- words and picture
def shown_columns(found: Sweep, scene: Scene) -> list[str]:
    """Columns that differ between the runs, the shape's own first."""
    own = [column.name for column in scene.geometry.columns]
    spread = {name: np.ptp(ends[np.isfinite(ends)]) for name, ends in found.columns.items() if name not in NOT_SHOWN}
    varying = [name for name, width in spread.items() if width > 0]
    return sorted(varying, key=lambda name: own.index(name) if name in own else len(own))[:PANEL_COLUMNS]


def in_words(found: Sweep, scene: Scene) -> str:
    """A table for a terminal; then the answer in a sentence."""
    columns = shown_columns(found, scene)
    heads = [*found.values, *columns]
    widths = [max(len(head), 11) for head in heads]
    lines = ["  ".join(f"{head:>{width}}" for head, width in zip(heads, widths, strict=True))]
    for number in range(len(found.names)):
        row = [ends[number] for ends in (*found.values.values(), *(found.columns[name] for name in columns))]
        lines.append("  ".join(f"{value:>{width}.6g}" for value, width in zip(row, widths, strict=True)))
    return "\n".join([*lines, verdict(found, scene)])


def verdict(found: Sweep, scene: Scene) -> str:
    """Between which ends the columns lie, and where, in a sentence."""
    parts = []
    for name in shown_columns(found, scene)[:2]:
        ends = found.columns[name]
        least, most = int(np.nanargmin(ends)), int(np.nanargmax(ends))
        parts.append(f"{name} from {ends[least]:.4g} ({_at(found, least)}) to {ends[most]:.4g} ({_at(found, most)})")
    if not parts:
        return "No column of the last row differs between the runs."
    return f"At the end of {len(found.names) - len(found.failed)} runs: {'; '.join(parts)}."


def _at(found: Sweep, run: int) -> str:
    return ", ".join(f"{key} {numbers[run]:g}" for key, numbers in found.values.items())


def draw(found: Sweep, folder: Path, scene: Scene) -> None:
    """Write sweep.csv and sweep.png."""
    title = f"{scene.name}: the last row of {len(found.names)} runs"
    page = Page(
        folder, SWEEP, title, "Each point is the end of one run; lines join runs whose other numbers are equal."
    )
    made_with = ", ".join(f"{name} {version}" for name, version in versions().items() if name != "BLAS")
    page.save_table({**found.values, **found.columns}, [title, made_with])
    columns, keys = shown_columns(found, scene), list(found.values)[:PANEL_KEYS]
    units = {column.name: unit_of(scene, column.unit) for column in scene.columns()}
    with rc_context(STYLE):
        figure = Figure(figsize=(7.2, 2.2 * max(1, len(columns)) + 0.4), layout="constrained")
        panels = figure.subplots(max(1, len(columns)), len(keys), squeeze=False, sharey="row", sharex="col")
        for row, name in enumerate(columns):
            unit = units.get(name)
            panels[row, 0].set(ylabel=words(name) + (f", {unit}" if unit else ""))
            for axes, key in zip(panels[row], keys, strict=True):
                _draw_panel(axes, found, name, key)
        for axes, key in zip(panels[-1], keys, strict=True):
            axes.set(xlabel=key)
        for axes in panels[0]:
            if axes.get_legend_handles_labels()[0]:
                axes.legend(loc="lower left", bbox_to_anchor=(0, 1), fontsize=7)
        add_head(figure, title, verdict(found, scene))
        page.save_figure(figure, made_with)


def _draw_panel(axes: Any, found: Sweep, name: str, key: str) -> None:
    """A column over a key: a line for each combination of the other keys, points where these are many."""
    x, y = found.values[key], found.columns[name]
    others = [tuple(row) for row in zip(*(v for k, v in found.values.items() if k != key), strict=True)] or [()] * len(
        x
    )
    groups = list(dict.fromkeys(others))
    if len(groups) > MOST_LINES or len(groups) == len(x):
        axes.plot(x, y, "o", color=COLOURS[0])
        return
    for number, group in enumerate(groups):
        chosen = np.array([one == group for one in others])
        order = np.argsort(x[chosen])
        label = ", ".join(f"{k} {v:g}" for k, v in zip((k for k in found.values if k != key), group, strict=True))
        line = {"color": COLOURS[number % len(COLOURS)], "label": label or None}
        axes.plot(x[chosen][order], y[chosen][order], "o-", **line)
