"""`remodel-fenicsx trade SCENE`: what each setting of a scene costs, and how far it is from the finest one."""

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

from remodel_fenicsx.body.reductions import AUTO, choice, is_for_means, objections, step_cost
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


# ---------------------------------------------------------------- settings of a scene from coarse to fine
DEGREES_PER_RUN = 60.0  # what angles turn by: steps of a tolerance are about so many tolerances
STEPS = (8.0, 5.0, 4.0, 2.5, 2.0, 0.5, 0.25, 0.125)  # in the scene's own
TOLERANCES = (2.0, 1.0, 0.5, 0.25)  # degrees
MESHES = [
    *product((1, 2, 4), (1, 2), (1.0, 0.25))
]  # refinement in the scene's own, degree, step in the scene's own
SEEDS = 3  # of random cells
COMPARED = 9  # times at which rows are compared, the last is the end
KINEMATIC = "model.kinematics"


@dataclass(frozen=True, eq=False)
class Setting:
    """One row of the table: a scene that a user could take."""

    name: str
    scene: Scene
    seeds: tuple[int, ...] = (1,)

    @property
    def step(self) -> float:
        """The fixed step; infinite with a tolerance."""
        return self.scene.time.step if self.scene.time.tolerance is None else np.inf

    @property
    def element(self) -> float:
        """Size of the elements over their degree, the coarsest 1."""
        return 1.0 / (self.scene.mesh.refinement * self.scene.mesh.degree**2)

    @property
    def cost(self) -> float:
        """What orders them: about in proportion to the time of one run."""
        time = self.scene.time
        steps = time.number_of_steps if time.tolerance is None else DEGREES_PER_RUN / time.tolerance
        return step_cost(self.scene, self.scene.model.kinematics) * steps


def ladder(scene: Scene) -> list[Setting]:
    """All settings that the scene allows, each once, the cheapest first."""
    cheapest = choice(scene.with_values({KINEMATIC: AUTO})).name
    # without its profile, which would choose the steps of every row; what the profile has set stays
    base = scene.with_values({KINEMATIC: cheapest, "time.tolerance": None, "profile": None})
    number = SEEDS if base.has_random_cells else 1
    seeds = tuple(range(base.cells.seed, base.cells.seed + number))
    found: dict[str, Setting] = {}
    for profile, values in _wanted(scene, base):
        if (
            isinstance(base.geometry, FromFile)
            or KINEMATICS[values.get(KINEMATIC, cheapest)].homogeneous
        ):
            values = {key: value for key, value in values.items() if not key.startswith("mesh.")}
        try:
            changed = base.with_values(values)
        except (
            SceneError
        ) as error:  # a step of which a corner is no multiple, an element that a formulation has not
            log.debug("left out: %s", error)
            continue
        time = changed.time
        steps = f"step-{time.step:g}" if time.tolerance is None else f"tolerance-{time.tolerance:g}"
        name = f"{changed.model.kinematics}-{changed.mesh.refinement}-degree-{changed.mesh.degree}-{steps}"
        found.setdefault(name, Setting(f"profile-{profile}" if profile else name, changed, seeds))
    return sorted(found.values(), key=lambda setting: setting.cost)


def _wanted(scene: Scene, base: Scene) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the name of a profile, or nothing, and the values of each setting."""
    own, step, remodels = base.model.kinematics, base.time.step, LAWS[scene.remodeling.law].remodels
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
        if not (objections(scene, name) or is_for_means(scene, name)):
            yield "", {KINEMATIC: name}


def compared_lengths(scene: Scene) -> tuple[str, list[str]]:
    """What the lengths of a body are called, and its columns of them: radii, or the stretch of what has none."""
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
    """The scene of a run of the study: only what is compared is measured."""
    columns = [*compared_lengths(setting.scene)[1], "processor_seconds", *PROFILE]
    values = {
        "output.fields": False,
        "output.columns": columns,
        "output.every": 1,
        "output.times": [],
    }
    return setting.scene.with_values(
        {**values, "cells.seed": seed, "name": f"{setting.name}-{seed}"}
    )


# ---------------------------------------------------------------- errors against the finest
NOISY = 2.0  # noise of the mean over the seeds that an error must be above
FINER = 1.99  # how much finer steps and elements of the finest must be than those of a row that is trusted


@dataclass(frozen=True)
class Result:
    """What the runs of a setting give, (seeds, columns, times), and the processor seconds of one of them."""

    setting: Setting
    angles: Array
    lengths: Array
    seconds: float


class Row(NamedTuple):
    """A row of the table."""

    setting: Setting
    angle_error: float
    length_error: float
    seconds: float
    doubt: str
    on_front: bool = False


def nanrms(values: Array) -> float:
    """Root mean square of what is known."""
    return float(np.sqrt(np.nanmean(values**2)))


def pareto(costs: Sequence[float], errors: Sequence[float]) -> list[bool]:
    """Which of some settings no other one beats in cost and error, to two digits: timings are not known to more."""
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
    """Rows with errors against the finest one, the cheapest first; the error of the finest is not known."""
    finest = min(results, key=lambda result: result.setting.step * result.setting.element)
    rows = [_row(result, finest) for result in sorted(results, key=lambda result: result.seconds)]
    on_front = pareto([row.seconds for row in rows], [row.angle_error for row in rows])
    return [row._replace(on_front=is_best) for row, is_best in zip(rows, on_front, strict=True)]


def _row(result: Result, finest: Result) -> Row:
    setting, seeds = result.setting, len(result.angles)
    if result is finest:
        return Row(setting, np.nan, np.nan, result.seconds, "the others are compared with it")
    apart = result.angles - finest.angles  # seed by seed: steps are compared on the same cells
    noise = nanrms(np.std(apart, axis=0, ddof=1)) / seeds**0.5 if seeds > 1 else 0.0
    error, ratio = nanrms(np.mean(apart, axis=0)), np.mean(result.lengths, axis=0) / np.mean(
        finest.lengths, axis=0
    )
    sizes = {"steps": (setting.step, finest.setting.step)}
    if not KINEMATICS[setting.scene.model.kinematics].homogeneous:
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
) -> tuple[Path, Trade]:
    """Run a scene with a ladder of settings, within a budget of seconds, and compare each with the finest."""
    study = _TradeStudy(scene, folder, budget, jobs, quiet)
    return study.run_and_write(study.answer)


class _TradeStudy(Study):
    """Runs in the order of their cost, within a budget."""

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
        """Settings that have neither ended nor failed."""
        done = {*self._results, *map(self.settings.get, self.failed)}
        return [setting for setting in dict.fromkeys(self.settings.values()) if setting not in done]

    def answer(self) -> Trade:
        """The table of what was run."""
        if len(self._results) < FEWEST_RUNS:
            reached = (
                f"{len(self._results)} of {len({*self.settings.values()})} settings reached the end"
            )
            advice = "a larger budget goes on" if self.left else "the same command tries again"
            raise TooFewRuns(
                f"{reached} within the budget of {self.budget:g} s", self.failed, advice
            )
        names = ", ".join(setting.name for setting in self.left)
        notes = [f"left out, over the budget: {names}"] if names else []
        return Trade(self.scene, compared([*self._results.values()]), notes, self.failed)

    def update(self) -> None:
        """Read what is new."""
        for setting in self.left:
            runs = [run for run in self.runs if self.settings[run.name] is setting]
            with suppress(
                RecordingError
            ):  # one that is damaged will be among those that have failed
                if all(run.is_complete() for run in runs):
                    self._results[setting] = read(setting, [run.history() for run in runs])


def read(setting: Setting, histories: Sequence[Mapping[str, Array]]) -> Result:
    """What is compared of the runs of a setting, between rows on the straight line."""
    times = np.linspace(0.0, setting.scene.last_time, COMPARED + 1)[1:]

    def columns(names: Sequence[str]) -> Array:
        return np.array(
            [[np.interp(times, each["time"], each[name]) for name in names] for each in histories]
        )

    seconds = float(np.mean([np.nansum(each["processor_seconds"]) for each in histories]))
    return Result(setting, columns(PROFILE), columns(compared_lengths(setting.scene)[1]), seconds)


# ---------------------------------------------------------------- the answer: words, a table, a picture, scenes
ROWS = "rows"  # folder of the scenes
WANTED = 1.0  # degrees of error, which the verdict asks for: less than what random cells scatter


@dataclass(frozen=True)
class Trade(StudyResult):
    """The table."""

    scene: Scene
    rows: list[Row]
    notes: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)

    name, about = "trade", "error and cost of its settings"
    caption = "Errors against the finest setting; filled: no other setting is as good for less."
    only_in_file = "scene", "trusted"

    def table(self) -> dict[str, list[Any]]:
        """A row for each setting."""
        rows = [
            (one.setting.name, f"{ROWS}/{one.setting.name}.toml", one.angle_error, one.length_error, one.seconds,
             int(one.on_front), int(not one.doubt), one.doubt)
            for one in self.rows
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
        """What `WANTED` degrees cost."""
        trusted = [row for row in self.rows if not row.doubt]
        good = [row for row in trusted if row.angle_error <= WANTED]
        if not trusted:
            return f"Not known: all {len(self.rows)} errors are doubted; trade.csv says why."
        best = min(good or trusted, key=lambda row: (row.seconds if good else 0.0, row.angle_error))
        cost = (
            f"{best.seconds:.2g} s of the processor for an error of {best.angle_error:.2g} degrees"
        )
        if not good:
            return f"No setting is known to be within {WANTED:g} degree; the closest is {best.setting.name}, {cost}."
        return f"The cheapest setting within {WANTED:g} degree is {best.setting.name}, {cost}."

    def write(self, folder: Path) -> None:
        """Write the table, the picture, and a scene of each row."""
        make_own_folder(folder / ROWS)
        for row, file in zip(self.rows, self.table()["scene"], strict=True):
            header = f"{row.setting.name} of {self.scene.name}, {row.seconds:.2g} s; ../trade.csv has its errors"
            write_whole(folder / file, row.setting.scene.to_toml(header).encode())
        super().write(folder)

    def figure(self) -> Figure:
        """Cost against error; beside the axes stands what the front is."""
        known = [row for row in self.rows if row.angle_error > 0]
        figure = Figure(figsize=(7.2, 4.2), layout="constrained")
        axes = figure.subplots()
        axes.set(xscale="log", yscale="log", xlabel="seconds of the processor")
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
