"""Command `trade`: cost and error of the numerical settings of a scene."""

from __future__ import annotations

import logging
import time as clock
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from remodel_fenicsx.body.reductions import AUTO, choice, objections, reasons_for_means, step_cost
from remodel_fenicsx.body.shape import FromFile, PROFILE
from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.model.laws import LAWS
from remodel_fenicsx.model.tensors import Array
from remodel_fenicsx.results.recording import RecordingError
from remodel_fenicsx.scene.presets import PROFILES, profile_for
from remodel_fenicsx.scene.scene import Scene, SceneError
from remodel_fenicsx.studies.study import COLOURS, FEWEST_RUNS, StudyResult, Study, TooFewRuns
from remodel_fenicsx.system.files import make_own_folder, write_whole

log = logging.getLogger(__name__)


# ---------------------------------------------------------------- settings, from coarse to fine
DEGREES_PER_RUN = 60.0  # typical rotation of angles in a run: a step is about one tolerance of it
STEPS = (8.0, 5.0, 4.0, 2.5, 2.0, 0.5, 0.25, 0.125)  # factors on the scene's step
TOLERANCES = (2.0, 1.0, 0.5, 0.25)  # degrees
MESHES = [
    *product((1, 2, 4), (1, 2), (1.0, 0.25))
]  # factor on the scene's refinement, degree, factor on the scene's step
SEEDS = 3  # number of seeds of random cells
COMPARED = 9  # number of times at which histories are compared, the last is the end
KINEMATIC = "model.kinematics"


@dataclass(frozen=True, eq=False)
class Setting:
    """A numerical setting: a scene that a user could run, and its seeds."""

    name: str
    scene: Scene
    seeds: tuple[int, ...] = (1,)

    @property
    def step(self) -> float:
        """Fixed step size; infinite for adaptive time stepping."""
        return self.scene.time.step if self.scene.time.tolerance is None else np.inf

    @property
    def element(self) -> float:
        """Relative element size over the squared degree; 1 for the coarsest setting."""
        return 1.0 / (self.scene.mesh.refinement * self.scene.mesh.degree**2)

    @property
    def cost(self) -> float:
        """Estimated cost, about proportional to the CPU time of one run."""
        time = self.scene.time
        steps = time.number_of_steps if time.tolerance is None else DEGREES_PER_RUN / time.tolerance
        return step_cost(self.scene, self.scene.model.kinematics) * steps


def ladder(scene: Scene) -> list[Setting]:
    """Return all settings that the scene allows, each once, cheapest first."""
    cheapest = choice(scene.with_values({KINEMATIC: AUTO})).name
    # Without its profile, which would set the step of every row. Values set by the profile stay.
    base = scene.with_values({KINEMATIC: cheapest, "time.tolerance": None, "profile": None})
    number = SEEDS if base.has_random_cells else 1
    seeds = tuple(range(base.cells.seed, base.cells.seed + number))
    settings: dict[str, Setting] = {}
    for profile, values in _wanted(scene, base):
        if (
            isinstance(base.geometry, FromFile)
            or KINEMATICS[values.get(KINEMATIC, cheapest)].homogeneous
        ):
            values = {key: value for key, value in values.items() if not key.startswith("mesh.")}
        try:
            changed = base.with_values(values)
        # For example, corners of ramps are no multiples of the step.
        except SceneError as error:
            log.debug("setting left out: %s", error)
            continue
        time = changed.time
        steps = f"step-{time.step:g}" if time.tolerance is None else f"tolerance-{time.tolerance:g}"
        mesh = f"{changed.mesh.refinement}-degree-{changed.mesh.degree}"
        name = f"{changed.model.kinematics}-{mesh}-{steps}"
        settings.setdefault(
            name, Setting(f"profile-{profile}" if profile else name, changed, seeds)
        )
    return sorted(settings.values(), key=lambda setting: setting.cost)


def _wanted(scene: Scene, base: Scene) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the name of a profile, or nothing, and the values of each setting."""
    own, step = base.model.kinematics, base.time.step
    remodels = LAWS[scene.remodeling.law].remodels
    yield "", {}
    for name in PROFILES if remodels else ():
        values = profile_for(name, base).settings(base)
        yield name, values | ({KINEMATIC: own} if values[KINEMATIC] == AUTO else {})
    for factor in STEPS:
        yield "", {"time.step": factor * step}
    for refinement, degree, factor in MESHES:
        mesh = {"mesh.refinement": refinement * base.mesh.refinement, "mesh.degree": degree}
        yield "", mesh | {"time.step": factor * step}
    for tolerance in TOLERANCES if remodels else ():
        yield "", {"time.tolerance": tolerance}
        yield "", {
            "time.tolerance": tolerance,
            "mesh.refinement": 2 * base.mesh.refinement,
            "mesh.degree": 2,
        }
    yield "", {KINEMATIC: choice(scene).name}
    for name in ("sector", "full"):
        if not (objections(scene, name) or reasons_for_means(scene, name)):
            yield "", {KINEMATIC: name}


def compared_lengths(scene: Scene) -> tuple[str, list[str]]:
    """Return the name and the columns of the lengths to compare: radii, stretch or volume."""
    columns = scene.geometry.columns
    if radii := [column.name for column in columns if column.unit == "length"]:
        return "radii", radii
    stretch = [column.name for column in columns if column.name == "mean_stretch"]
    return (
        ("stretch", stretch)
        if stretch
        else ("volume", [c.name for c in columns if c.unit == "length^3"])
    )


def as_run(setting: Setting, seed: int = 1) -> Scene:
    """Return the scene of a run that records only the compared columns."""
    columns = [*compared_lengths(setting.scene)[1], "cpu_seconds", *PROFILE]
    values = {
        "output.fields": False,
        "output.columns": columns,
        "output.every": 1,
        "output.times": [],
    }
    return setting.scene.with_values(
        {**values, "cells.seed": seed, "name": f"{setting.name}-{seed}"}
    )


# ---------------------------------------------------------------- errors relative to the finest
NOISY = 2.0  # smallest trusted error, over the noise of the mean over the seeds
FINER = 1.99  # smallest ratio of a trusted setting's steps and elements to those of the finest


@dataclass(frozen=True)
class Result:
    """Results of the runs of a setting, (seeds, columns, times), and the CPU seconds of one run."""

    setting: Setting
    angles: Array
    lengths: Array
    seconds: float


class Row(NamedTuple):
    """A row of the table: the errors and the cost of a setting."""

    setting: Setting
    angle_error: float
    length_error: float
    seconds: float
    doubt: str
    on_front: bool = False


def nanrms(values: Array) -> float:
    """Return the root mean square of the values that are not NaN."""
    return float(np.sqrt(np.nanmean(values**2)))


def pareto(costs: Sequence[float], errors: Sequence[float]) -> list[bool]:
    """Return which settings are Pareto-optimal in cost and error, rounded to two digits.

    Timings are not reproducible to more digits.
    """
    pairs = [
        (float(f"{cost:.2g}"), float(f"{error:.2g}"))
        for cost, error in zip(costs, errors, strict=True)
    ]
    return [
        np.isfinite(error)
        and not any((c <= cost and e < error) or (c < cost and e <= error) for c, e in pairs)
        for cost, error in pairs
    ]


def compared(results: Sequence[Result]) -> list[Row]:
    """Return rows with errors relative to the finest setting, cheapest first.

    The error of the finest setting is NaN.
    """
    finest = min(results, key=lambda result: result.setting.step * result.setting.element)
    rows = [_row(result, finest) for result in sorted(results, key=lambda result: result.seconds)]
    on_front = pareto([row.seconds for row in rows], [row.angle_error for row in rows])
    return [row._replace(on_front=is_best) for row, is_best in zip(rows, on_front, strict=True)]


def _row(result: Result, finest: Result) -> Row:
    setting, seeds = result.setting, len(result.angles)
    if result is finest:
        return Row(
            setting, np.nan, np.nan, result.seconds, "the other settings are compared with it"
        )
    # The difference is taken seed by seed, so that both settings have the same cells.
    apart = result.angles - finest.angles
    noise = nanrms(np.std(apart, axis=0, ddof=1)) / seeds**0.5 if seeds > 1 else 0.0
    error = nanrms(np.mean(apart, axis=0))
    ratio = np.mean(result.lengths, axis=0) / np.mean(finest.lengths, axis=0)
    sizes = {"steps": (setting.step, finest.setting.step)}
    if not setting.scene.kinematics.homogeneous:
        sizes["elements"] = setting.element, finest.setting.element
    shared = [name for name, (own, least) in sizes.items() if own < FINER * least]
    doubt = f"the finest has no finer {' and '.join(shared)}" if shared else ""
    if NOISY * noise > error:
        doubt = f"noise of random cells {noise:.2g}"
    return Row(setting, error, float(np.nanmax(np.abs(ratio - 1))), result.seconds, doubt)


# ---------------------------------------------------------------- the runs
def trade(
    scene: Scene,
    folder: Path | str | None = None,
    budget: float = 600.0,
    jobs: int | None = None,
    quiet: bool = True,
    scheduler: str | None = None,
) -> tuple[Path, Trade]:
    """Run a scene with all settings, within a budget in seconds; compare each with the finest."""
    study = _TradeStudy(scene, folder, budget, jobs, quiet, scheduler)
    return study.run_and_write(study.answer)


class _TradeStudy(Study):
    """A study that does its runs in the order of their cost, within a budget."""

    def __init__(self, scene: Scene, folder: Path | str | None, budget: float, *how: Any):
        deadline = clock.monotonic() + budget
        runs = [
            (setting, as_run(setting, seed)) for setting in ladder(scene) for seed in setting.seeds
        ]
        super().__init__("trade", scene, folder, {run.name: run for _, run in runs}, *how)
        self.settings = {run.name: setting for setting, run in runs}
        self.budget, self.deadline = budget, deadline
        self._results: dict[Setting, Result] = {}

    @property
    def left(self) -> list[Setting]:
        """Settings without a result that have not failed."""
        done = {*self._results, *map(self.settings.get, self.failed)}
        return [setting for setting in dict.fromkeys(self.settings.values()) if setting not in done]

    def answer(self) -> Trade:
        """Return the table of the settings that were run."""
        if len(self._results) < FEWEST_RUNS:
            reached = (
                f"{len(self._results)} of {len({*self.settings.values()})} settings reached the end"
            )
            advice = (
                "set a larger budget to continue"
                if self.left
                else "repeat the command to run them again"
            )
            raise TooFewRuns(
                f"{reached} within the budget of {self.budget:g} s", self.failed, advice
            )
        names = ", ".join(setting.name for setting in self.left)
        notes = [f"left out, over the budget: {names}"] if names else []
        return Trade(self.scene, compared([*self._results.values()]), notes, self.failed)

    def update(self) -> None:
        """Read the results of settings whose runs are complete."""
        for setting in self.left:
            runs = [run for run in self.runs if self.settings[run.name] is setting]
            # A run with a corrupt folder is listed in `failed` later.
            with suppress(RecordingError):
                if all(run.is_complete() for run in runs):
                    self._results[setting] = read(setting, [run.history() for run in runs])


def read(setting: Setting, histories: Sequence[Mapping[str, Array]]) -> Result:
    """Return the compared quantities of a setting's runs, interpolated linearly in time."""
    times = np.linspace(0.0, setting.scene.last_time, COMPARED + 1)[1:]

    def columns(names: Sequence[str]) -> Array:
        return np.array(
            [[np.interp(times, run["time"], run[name]) for name in names] for run in histories]
        )

    seconds = float(np.mean([np.nansum(run["cpu_seconds"]) for run in histories]))
    return Result(setting, columns(PROFILE), columns(compared_lengths(setting.scene)[1]), seconds)


# ---------------------------------------------------------------- verdict, table, picture, scenes
ROWS = "rows"  # folder of the scenes
WANTED = 1.0  # degrees: error that the verdict asks for, below the scatter of random cells


@dataclass(frozen=True)
class Trade(StudyResult):
    """Errors and costs of the settings of a scene."""

    scene: Scene
    rows: list[Row]
    notes: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)

    name, about = "trade", "error and cost of its settings"
    caption = "Errors against the finest setting; filled: no other setting is as good for less."
    only_in_file = "scene", "trusted"

    def table(self) -> dict[str, list[Any]]:
        """Return the columns of trade.csv, with a row for each setting."""
        rows = [
            (row.setting.name, f"{ROWS}/{row.setting.name}.toml", row.angle_error, row.length_error,
             row.seconds, int(row.on_front), int(not row.doubt), row.doubt)
            for row in self.rows
        ]  # fmt: skip
        lengths = f"error_{compared_lengths(self.scene)[0]}"
        names = (
            "setting",
            "scene",
            "error_degrees",
            lengths,
            "cpu_seconds",
            "on_front",
            "trusted",
            "doubt",
        )
        return dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))

    def verdict(self) -> str:
        """Return the cheapest trusted setting with an error of at most `WANTED` degrees."""
        trusted = [row for row in self.rows if not row.doubt]
        good = [row for row in trusted if row.angle_error <= WANTED]
        if not trusted:
            return f"Not known: all {len(self.rows)} errors are doubted; trade.csv says why."
        best = min(good or trusted, key=lambda row: (row.seconds if good else 0.0, row.angle_error))
        cost = f"{best.seconds:.2g} s of CPU time for an error of {best.angle_error:.2g} degrees"
        if not good:
            text = f"No setting is known to be within {WANTED:g} degree; the closest is "
        else:
            text = f"The cheapest setting within {WANTED:g} degree is "
        return f"{text}{best.setting.name}, {cost}."

    def write(self, folder: Path) -> None:
        """Write the table, the picture and the scene of each row."""
        make_own_folder(folder / ROWS)
        for row, file in zip(self.rows, self.table()["scene"], strict=True):
            header = f"{row.setting.name} of {self.scene.name}, {row.seconds:.2g} s; "
            header += "../trade.csv has its errors"
            write_whole(folder / file, row.setting.scene.to_toml(header).encode())
        super().write(folder)

    def figure(self) -> Figure:
        """Plot error over cost; the legend names the settings on the Pareto front."""
        known = [row for row in self.rows if row.angle_error > 0]
        figure = Figure(figsize=(7.2, 4.2), layout="constrained")
        axes = figure.subplots()
        axes.set(xscale="log", yscale="log", xlabel="CPU time, seconds")
        axes.set(ylabel="error of the fibre angle, degrees")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter("{x:g}")
        axes.plot(
            [row.seconds for row in known],
            [row.angle_error for row in known],
            "o",
            color=COLOURS[0],
            mfc="white",
        )
        for row in known:
            if row.on_front:
                axes.plot(row.seconds, row.angle_error, "o", label=row.setting.name)
        look = {
            "title": "filled: no other one\nis as good for less",
            "title_fontsize": 7.5,
            "fontsize": 6.5,
        }
        figure.legend(loc="outside right center", **look)
        return figure
