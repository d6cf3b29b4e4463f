"""`remodel-fenicsx trade SCENE`: what each setting of a scene costs and how far off it is, measured on the scene."""

from __future__ import annotations

import logging
import time as clock
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from remodel_fenicsx.body.reductions import AUTO, choice, is_for_means, objections, step_cost
from remodel_fenicsx.body.shape import FromFile, PROFILE
from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.model.laws import LAWS
from remodel_fenicsx.results.recording import RecordingError
from remodel_fenicsx.scene.presets import PROFILES, profile_for
from remodel_fenicsx.scene.scene import Scene, SceneError
from remodel_fenicsx.schema import same_time
from remodel_fenicsx.studies.page import COLOURS, Answer
from remodel_fenicsx.studies.study import FEWEST_RUNS, Run, Study, TooFewRuns
from remodel_fenicsx.system.files import make_own_folder, write_whole

log = logging.getLogger(__name__)

Array = NDArray[np.float64]


# ---------------------------------------------------------------- settings of a scene from coarse to fine
SECONDS_PER_POINT = 3e-5  # of a step: a first guess, corrected by the runs
DEGREES_PER_RUN = 60.0  # what angles turn by: steps of a tolerance are about so many tolerances
STEPS = (8.0, 5.0, 4.0, 2.5, 2.0, 0.5, 0.25, 0.125)  # in the scene's own
TOLERANCES = (2.0, 1.0, 0.5, 0.25)  # degrees
MESHES = ((1, 1), (2, 1), (4, 1), (8, 1), (1, 2), (2, 2), (4, 2))  # refinement, degree
TOGETHER = ((2, 1, 0.5), (2, 2, 0.5), (2, 2, 0.25), (4, 2, 0.25))  # both finer: refinement, degree, step in the scene's
SEEDS = 3  # where another mesh draws other cells
COMPARED = 8  # times at which rows are compared, beside corners of ramps and the end
STRETCH, KINEMATIC = "mean_stretch", "model.kinematics"


@dataclass(frozen=True)
class Setting:
    """One row of the table: a scene that a user could take."""

    changes: Mapping[str, Any] = field(hash=False)
    scene: Scene = field(hash=False)
    seeds: tuple[int, ...]
    profile: str = ""

    @property
    def key(self) -> str:
        """What it is: kinematics, mesh and steps."""
        kinematics, refinement, degree = self.mesh
        return f"{kinematics}-{refinement}-degree-{degree}-{self.steps_in_words.replace(' ', '-')}"

    @property
    def name(self) -> str:
        """Of its row."""
        return f"profile-{self.profile}" if self.profile else self.key

    @property
    def step(self) -> float | None:
        """The fixed step; None with a tolerance."""
        return self.scene.time.step if self.scene.time.tolerance is None else None

    @property
    def mesh(self) -> tuple[str, int, int]:
        """Kinematics, refinement and degree."""
        return self.scene.model.kinematics, self.scene.mesh.refinement, self.scene.mesh.degree

    @property
    def kinematics(self) -> str:
        """What a step costs goes by them."""
        return self.scene.model.kinematics

    @property
    def expected_seconds(self) -> float:
        """Of one of its runs, roughly."""
        time = self.scene.time
        steps = time.number_of_steps if time.tolerance is None else DEGREES_PER_RUN / time.tolerance
        return SECONDS_PER_POINT * step_cost(self.scene, self.scene.model.kinematics) * steps

    @property
    def steps_in_words(self) -> str:
        """How long they are, or their tolerance."""
        return f"step {self.step:g}" if self.step is not None else f"tolerance {self.scene.time.tolerance:g}"


def ladder(scene: Scene) -> list[Setting]:
    """All settings that the scene allows, each once: sweeps of one factor from the cheapest kinematics, then both."""
    cheapest = choice(scene.with_values({KINEMATIC: AUTO})).name
    # without its profile, which would choose the steps of every row; what the profile has set stays
    base = scene.with_values({KINEMATIC: cheapest, "time.tolerance": None, "profile": None})
    remodels, step = LAWS[scene.remodeling.law].remodels, base.time.step

    def finer(refinement: int, degree: int) -> dict[str, Any]:
        return {"mesh.refinement": refinement * base.mesh.refinement, "mesh.degree": degree}

    wanted: list[dict[str, Any]] = [{"time.step": factor * step} for factor in STEPS]
    wanted += [finer(*mesh) for mesh in MESHES]
    wanted += [finer(refinement, degree) | {"time.step": factor * step} for refinement, degree, factor in TOGETHER]
    for tolerance in TOLERANCES if remodels else ():
        wanted += [finer(2, 2) | {"time.tolerance": tolerance}, {"time.tolerance": tolerance}]
    for name in dict.fromkeys((choice(scene).name, "sector", "full")):
        if name == choice(scene).name or not (objections(scene, name) or is_for_means(scene, name)):
            wanted.append({KINEMATIC: name})
    first = _setting(base, {})
    settings = [first, *_profiles(base)] if remodels else [first]
    found: dict[str, Setting] = {}
    for setting in [*settings, *(_setting(base, values) for values in wanted)]:
        if setting is not None:
            found.setdefault(setting.key, setting)
    return sorted(found.values(), key=lambda setting: setting.expected_seconds)


def _setting(base: Scene, values: Mapping[str, Any], profile: str = "") -> Setting | None:
    """The base with some values; None where it does not take them."""
    values = _known(base, values)
    try:
        changed = base.with_values(values)
    except SceneError as error:  # a step of which a corner is no multiple, an element that a formulation has not
        log.debug("left out: %s", error)
        return None
    has_same_cells = bool(values) and not profile and set(values) <= {"time.step", "time.tolerance", KINEMATIC}
    has_same_cells &= not is_for_means(base, changed.model.kinematics)
    seeds = 1 if has_same_cells or not base.has_random_cells else SEEDS
    return Setting(values, changed, tuple(range(base.cells.seed, base.cells.seed + seeds)), profile)


def _profiles(base: Scene) -> list[Setting | None]:
    """Those that say something else than the base, on its kinematics unless they have one."""
    own: dict[str, Any] = {KINEMATIC: base.model.kinematics}
    found: dict[str, dict[str, Any]] = {}
    for name in PROFILES:
        profile = profile_for(name, base)
        values = profile.settings(base.with_values(_known(base, profile.values | own)))
        values |= own if values[KINEMATIC] == AUTO else {}
        if values not in (own, *found.values()):
            found[name] = values
    return [_setting(base, values, name) for name, values in found.items()]


def _known(base: Scene, values: Mapping[str, Any]) -> Mapping[str, Any]:
    """Without those of a mesh that means nothing, or is given."""
    homogeneous = KINEMATICS[values.get(KINEMATIC, base.model.kinematics)].homogeneous
    if not isinstance(base.geometry, FromFile) and not homogeneous:
        return values
    return {key: value for key, value in values.items() if not key.startswith("mesh.")}


def compared_times(scene: Scene, settings: Sequence[Setting]) -> list[float]:
    """Times that every row has: corners of ramps, the end, and some between that are whole steps of all settings."""
    fixed = [setting.scene.time for setting in settings if setting.step is not None]
    longest = max(time.step for time in fixed)
    multiples = [longest * number for number in range(1, round(scene.time.end / longest))]
    hit = [time for time in multiples if all(one.is_hit(time) for one in fixed)]
    return sorted({*scene.stops(), *hit[:: -(-len(hit) // COMPARED) or 1]})


def compared_lengths(scene: Scene) -> tuple[str, list[str]]:
    """What the lengths of a body are called, and its columns of them: radii, or the stretch of what has none."""
    columns = scene.geometry.columns
    if radii := [column.name for column in columns if column.unit == "length"]:
        return "radii", radii
    stretch = [column.name for column in columns if column.name == STRETCH]
    return ("stretch", stretch) if stretch else ("volume", [c.name for c in columns if c.unit == "length^3"])


def as_run(setting: Setting, seed: int, times: list[float]) -> Scene:
    """The scene of a run of the study: only what is compared is measured."""
    columns = [*compared_lengths(setting.scene)[1], "substeps", "seconds", "processor_seconds", *PROFILE]
    values = {"output.fields": False, "output.columns": columns, "output.times": times, "output.every": 1}
    return setting.scene.with_values({**values, "cells.seed": seed, "name": f"{setting.name}-{seed}"})


# ---------------------------------------------------------------- an order of convergence, and what is left with it
# What ever finer settings tend to is known by Richardson's extrapolation, where their results show an order.
UNKNOWN_SHARE = 0.5  # of an error: what is left unknown may be so much of it
NO_ERROR = 1e-6  # degrees: what solves leave is less, what elements and steps leave more
SPREAD = 2.0  # noise of the mean over the seeds that an error must be above
RATIOS = (1.35, 40.0)  # of differences of one halving and the next that are those of an order
ALIGNED = 0.5  # cosine of the angle between two differences, as vectors, that shrink along one way


class SweepLimit(NamedTuple):
    """What a sweep of one factor tends to."""

    beyond: Array
    order: float
    last: Array

    @property
    def trusted(self) -> bool:
        """Whether an order shows."""
        return bool(np.isfinite(self.order))


def limit(results: Sequence[Array]) -> SweepLimit:
    """The limit of results of settings that are each half of the one before, the finest last."""
    nothing = np.zeros_like(results[-1])
    last = results[-1] - results[-2] if len(results) > 1 else np.full_like(nothing, np.nan)
    if len(results) < 3:
        return SweepLimit(nothing, np.nan, last)
    before = results[-2] - results[-3]
    if typical(last) == 0:
        return SweepLimit(nothing, np.inf, last)
    ratio = typical(before) / typical(last)
    cosine = float(np.nansum(before * last) / max(np.nansum(before**2) ** 0.5 * np.nansum(last**2) ** 0.5, 1e-300))
    if not RATIOS[0] < ratio < RATIOS[1] or cosine < ALIGNED:
        return SweepLimit(nothing, np.nan, last)
    return SweepLimit(np.asarray(last / (ratio - 1), dtype=np.float64), float(np.log2(ratio)), last)


def typical(values: Array) -> float:
    """Root mean square of what is known."""
    return float(np.sqrt(np.nanmean(values**2)))


def _shown(number: float) -> float:
    """Two digits: what is as good there is no better, as estimates and timings are not known to more."""
    return float(f"{number:.2g}")


def pareto(costs: Sequence[float], errors: Sequence[float]) -> list[bool]:
    """Which of some settings no other one beats in cost and error, as they are shown."""
    pairs = [(_shown(cost), _shown(error)) for cost, error in zip(costs, errors, strict=True)]
    return [
        np.isfinite(error) and not any((c <= cost and e < error) or (c < cost and e <= error) for c, e in pairs)
        for cost, error in pairs
    ]


# ---------------------------------------------------------------- the errors of settings from what all of them give
@dataclass(frozen=True)
class Result:
    """What a setting gives: means over its seeds."""

    setting: Setting
    angles: Array
    lengths: Array
    seconds: float
    wall_seconds: float
    noise: float
    single: tuple[Array, Array]


@dataclass(frozen=True)
class Row:
    """A row of the table."""

    result: Result
    angle_error: float
    length_error: float
    on_front: bool = False
    doubt: str = ""


class _Guess(NamedTuple):
    """Of the exact result: what settings with fixed steps tend to."""

    angles: Array
    lengths: Array
    unknown: float
    notes: list[str]


def estimated(results: Sequence[Result]) -> tuple[list[Row], list[str]]:
    """Rows with errors against the best guess of the exact result, and what it rests on."""
    results = _on_the_mean(results)
    fixed = [result for result in results if result.setting.step is not None]
    if not fixed:
        return [Row(result, np.nan, np.nan, doubt="nothing to compare with") for result in results], []
    guess = _guess(fixed)
    rows = sorted((_row(result, guess) for result in results), key=lambda row: row.result.seconds)
    on_front = pareto([row.result.seconds for row in rows], [row.angle_error for row in rows])
    return [replace(row, on_front=is_best) for row, is_best in zip(rows, on_front, strict=True)], guess.notes


def _guess(fixed: Sequence[Result]) -> _Guess:
    """What settings with fixed steps tend to."""
    finest = min(fixed, key=_fineness)
    angles, lengths, unknown, notes = finest.angles, finest.lengths, 0.0, []
    sweeps = [_time_sweep(fixed)]
    if not KINEMATICS[finest.setting.mesh[0]].homogeneous:
        sweeps.append(_mesh_sweep(fixed))
    for sweep in sweeps:
        if not sweep.results:
            notes.append(f"{sweep.factor}: fewer than two settings were run, so its error is in no estimate")
            unknown = np.inf
            continue
        found, found_lengths = (limit([getattr(r, kind) for r in sweep.results]) for kind in ("angles", "lengths"))
        # what the sweep has still before it where the finest of all stands
        last = sweep.results[-1]
        ahead = next((r for r in sweep.results if sweep.level(r) == sweep.level(finest)), last)
        angles = angles + found.beyond + last.angles - ahead.angles
        lengths = lengths + found_lengths.beyond + last.lengths - ahead.lengths
        notes.append(_in_words(sweep, found))
        if not found.trusted:
            unknown = max(unknown, typical(found.last)) if np.isfinite(found.last).any() else np.inf
    return _Guess(angles, lengths, unknown, notes)


def _row(result: Result, guess: _Guess) -> Row:
    error, unknown = typical(result.angles - guess.angles), guess.unknown
    if np.isfinite(unknown):
        error = float(np.hypot(error, unknown))
    length = float(np.nanmax(np.abs(result.lengths / guess.lengths - 1)))
    doubt = ""
    if unknown > UNKNOWN_SHARE * error:
        doubt = "no order seen" if np.isfinite(unknown) else "a factor was not varied"
    if SPREAD * result.noise > error:
        doubt = f"noise of random cells {result.noise:.2g}"
    return Row(result, error, length, doubt=doubt)


def _on_the_mean(results: Sequence[Result]) -> list[Result]:
    """Settings of one seed moved by what the mean over the seeds is beside it, on the mesh that they share."""
    several = {result.setting.mesh: result for result in results if len(result.setting.seeds) > 1}
    found = []
    for result in results:
        other = several.get(result.setting.mesh)
        if other is not None and len(result.setting.seeds) == 1:
            angles = result.angles + other.angles - other.single[0]
            lengths = result.lengths + other.lengths - other.single[1]
            result = replace(result, angles=angles, lengths=lengths, noise=other.noise)
        found.append(result)
    return found


def _fineness(result: Result) -> tuple[float, ...]:
    """Smaller is finer: the size of elements over their degree, and the step."""
    kinematics, refinement, degree = result.setting.mesh
    return _step(result) / (refinement * degree**2), not KINEMATICS[kinematics].reduced


class _Sweep(NamedTuple):
    """Results that differ in one factor, each half of the one before, the finest last."""

    factor: str
    results: list[Result]
    words: str
    level: Callable[[Result], Any]


def _time_sweep(results: Sequence[Result]) -> _Sweep:
    """Of halved steps on one mesh, the finest that may tell an order."""
    found = _swept(results, lambda r: (r.setting.mesh[1] * r.setting.mesh[2] ** 2, r.setting.mesh), _step)
    meshes = [f"refinement {r.setting.mesh[1]}, degree {r.setting.mesh[2]}" for r in found]
    words = f"steps {', '.join(f'{_step(r):g}' for r in found)} on {''.join(meshes[-1:])}"
    return _Sweep("time", found, words, _step)


def _mesh_sweep(results: Sequence[Result]) -> _Sweep:
    """Of doubled refinements with one degree and step: the highest degree, the smallest step that may tell an order."""
    found = _swept(
        results, lambda r: (r.setting.mesh[2], -_step(r), r.setting.mesh[0]), lambda r: 1.0 / r.setting.mesh[1]
    )
    refinements = ", ".join(str(r.setting.mesh[1]) for r in found)
    words = f"refinements {refinements} of degree {found[-1].setting.mesh[2] if found else 0}"
    return _Sweep("mesh", found, words, lambda r: r.setting.mesh[1:])


def _step(result: Result) -> float:
    return result.setting.step or np.inf


def _swept(results: Sequence[Result], group: Callable[[Result], Any], size: Callable[[Result], float]) -> list[Result]:
    """The last chain of three or more sizes in one group, or of two; nothing where there is none."""
    groups = sorted({group(result) for result in results})
    chains = [_halved({size(r): r for r in results if group(r) == one}) for one in groups]
    return next((chain for length in (3, 2) for chain in reversed(chains) if len(chain) >= length), [])


def _halved(by_size: dict[float, Result]) -> list[Result]:
    """The longest chain of sizes that are each half of the one before, the finest last."""

    def chain(size: float) -> list[float]:
        coarser = next((s for s in by_size if same_time(s, 2 * size)), None)
        return [size] if coarser is None else [*chain(coarser), size]

    return [by_size[size] for size in max(map(chain, sorted(by_size)), key=len)]


def _in_words(sweep: _Sweep, found: SweepLimit) -> str:
    start, last = f"{sweep.factor}: ", f"the last two differ by {typical(found.last):.2g} degrees"
    if typical(found.last) < NO_ERROR:
        return f"{start}no error ({sweep.words}): {last}"
    if found.trusted:
        return f"{start}order {found.order:.2g} ({sweep.words}); the finest is {typical(found.beyond):.2g} degrees off"
    return f"{start}no order seen ({sweep.words}), {last}: the estimates are differences to the finest, no better"


# ---------------------------------------------------------------- the runs
BUDGET = 600.0  # seconds


def trade(
    scene: Scene,
    folder: Path | str | None = None,
    budget: float = BUDGET,
    jobs: int | None = None,
    quiet: bool = True,
) -> tuple[Path, Trade]:
    """Run a scene with a ladder of settings, and estimate the error of each."""
    study = _TradeStudy(scene, folder, ladder(scene), budget, jobs, quiet)
    return study.answered(study.answer)


class _TradeStudy(Study):
    """Runs in the order of their cost, within a budget."""

    def __init__(
        self,
        scene: Scene,
        folder: Path | str | None,
        settings: Sequence[Setting],
        budget: float,
        jobs: int | None,
        quiet: bool,
    ):
        self.settings, self.budget = settings, budget
        self.times = compared_times(scene, settings)
        of_run = {f"{setting.name}-{seed}": (setting, seed) for setting in settings for seed in setting.seeds}
        scenes = {name: as_run(setting, seed, self.times) for name, (setting, seed) in of_run.items()}
        super().__init__("trade", scene, folder, scenes, jobs, quiet)
        self.deadline = clock.monotonic() + budget
        self._setting_of = {name: setting for name, (setting, _) in of_run.items()}
        self._results: dict[str, Result] = {}
        self._begun: dict[str, float] = {}
        self._start = 0.0  # seconds before the first step: mesh, kernels, the search for an unloaded body
        self._pace: dict[str, float] = {}  # seconds over those expected, by kinematics

    @property
    def results(self) -> list[Result]:
        """Of the settings all of whose runs have reached the end, the cheapest expected first."""
        return [self._results[setting.name] for setting in self.settings if setting.name in self._results]

    @property
    def left(self) -> list[Setting]:
        """Those that have neither ended nor failed."""
        failed = {self._setting_of[name].name for name in self.failed}
        return [one for one in self.settings if one.name not in failed and one.name not in self._results]

    def answer(self) -> Trade:
        """The table of what was run."""
        if len(self.results) < FEWEST_RUNS:
            reached = f"{len(self.results)} of {len(self.settings)} settings reached the end"
            advice = (
                f"a larger budget goes on{self._needed()}" if self.left else "the same command tries again what failed"
            )
            raise TooFewRuns(f"{reached} within the budget of {self.budget:g} s", self.failed, advice)
        rows, notes = estimated(self.results)
        if self.left:
            notes = [*notes, f"left out, over the budget: {', '.join(setting.name for setting in self.left)}"]
        return Trade(self.scene, rows, notes, self.failed)

    def fits(self, run: Run) -> bool:
        """Whether a run that begins now would end in time, by what others have taken."""
        self._begun[run.name] = clock.monotonic()
        return self._begun[run.name] + self._seconds(self._setting_of[run.name]) < self.deadline

    def _seconds(self, setting: Setting) -> float:
        """Of a run, by what others of its kind have taken, or else by the slowest."""
        pace = self._pace.get(setting.kinematics, max(self._pace.values(), default=1.0))
        return self._start + pace * setting.expected_seconds

    def _needed(self) -> str:
        """What the settings that are left take, once one has ended; nothing where the budget has it."""
        seconds = sum(self._seconds(setting) * len(setting.seeds) for setting in self.left) / self.jobs
        if not self._pace or seconds < self.deadline - clock.monotonic():
            return ""
        return f"; all settings take about {_shown(seconds / 60):g} min more (--budget)"

    def _progress(self) -> str:
        return super()._progress() + self._needed()

    def learn(self) -> None:
        """Read what is new, and how long it took."""
        for setting in (one for one in self.settings if one.name not in self._results):
            runs = [run for run in self.runs if self._setting_of[run.name] is setting]
            with suppress(RecordingError):  # one that is damaged will be among those that have failed
                if all(run.is_complete() for run in runs):
                    result = self._results[setting.name] = read(setting, runs, self.times)
                    self._pace[setting.kinematics] = max(result.wall_seconds / setting.expected_seconds, 0.1)
                    took = [clock.monotonic() - self._begun[run.name] for run in runs if run.name in self._begun]
                    self._start = max(min(took, default=0.0) - result.wall_seconds, 0.0)


def read(setting: Setting, runs: Sequence[Run], times: Sequence[float]) -> Result:
    """The rows at some times of the runs of a setting."""
    angles, lengths, seconds, wall = [], [], [], []
    for run in runs:
        history = run.history()
        rows = [next(r for r, time in enumerate(history["time"]) if same_time(float(time), t)) for t in times]
        angles.append(np.array([history[name] for name in PROFILE]).T[rows])
        lengths.append(np.array([history[name] for name in compared_lengths(setting.scene)[1]]).T[rows])
        seconds.append(float(np.nansum(history["processor_seconds"])))
        wall.append(float(np.nansum(history["seconds"])))
    noise = np.std(angles, axis=0, ddof=1) / np.sqrt(len(angles)) if len(angles) > 1 else np.zeros(1)
    single = angles[0], lengths[0]
    means = np.mean(angles, axis=0), np.mean(lengths, axis=0)
    return Result(setting, *means, float(np.mean(seconds)), float(np.mean(wall)), typical(noise), single)


# ---------------------------------------------------------------- the answer: words, a table, a picture, scenes
ROWS = "rows"  # folder of the scenes
WANTED = 1.0  # degrees of error, which the verdict asks for: less than what random cells scatter


@dataclass(frozen=True)
class Trade(Answer):
    """The table, and what it rests on."""

    scene: Scene
    rows: list[Row]
    notes: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)

    name = "trade"
    caption = "Estimated errors; filled: no other setting is as good for less."

    @property
    def title(self) -> str:
        """Of the picture."""
        return f"{self.scene.name}: error and cost of its settings"

    def table(self) -> dict[str, list[str] | list[float] | list[int]]:
        """A row for each setting."""
        rows = self.rows
        return {
            "setting": [row.result.setting.name for row in rows],
            "scene": [_scene_file(row) for row in rows],
            "error_degrees": [row.angle_error for row in rows],
            f"error_{compared_lengths(self.scene)[0]}": [row.length_error for row in rows],
            "cpu_seconds": [row.result.seconds for row in rows],
            "on_front": [int(row.on_front) for row in rows],
            "trusted": [int(not row.doubt) for row in rows],
            "doubt": [row.doubt for row in rows],
            "noise": [row.result.noise for row in rows],
        }

    def lines(self) -> list[str]:
        """A row for each setting."""
        lines = [f"{'':2}{'seconds':>9} {'degrees':>9} {compared_lengths(self.scene)[0] + ' %':>9}  setting"]
        for row in self.rows:
            numbers = f"{row.result.seconds:9.2g} {row.angle_error:9.2g} {100 * row.length_error:9.2g}"
            doubt = f"  ({row.doubt})" if row.doubt else ""
            lines.append(f"{'* ' if row.on_front else '  '}{numbers}  {row.result.setting.name}{doubt}")
        about = "*: no other setting is as good for less. Errors are estimates; degrees: fibre angle, root mean square."
        return [*lines, about]

    def verdict(self) -> str:
        """What `WANTED` degrees cost."""
        trusted = [row for row in self.rows if not row.doubt]
        good = [row for row in trusted if row.angle_error <= WANTED]
        if not trusted:
            return f"Not known: all {len(self.rows)} errors are doubted; trade.csv says why."
        best = min(good or trusted, key=lambda row: (row.result.seconds if good else 0.0, row.angle_error))
        cost = f"{best.result.seconds:.2g} s of the processor for an error of {best.angle_error:.2g} degrees"
        name = best.result.setting.name
        if not good:
            return f"No setting is known to be within {WANTED:g} degree; the closest is {name}, {cost}."
        return f"The cheapest setting within {WANTED:g} degree is {name}, {cost}."

    def write(self, folder: Path) -> None:
        """Write the table, the picture, and a scene of each row."""
        make_own_folder(folder / ROWS)
        for row in self.rows:
            header = (
                f"{self.scene.name}: {row.angle_error:.2g} degrees and {100 * row.length_error:.2g} % off for "
                f"{row.result.seconds:.2g} s, as estimated by remodel-fenicsx trade"
            )
            header += f" ({row.doubt})" if row.doubt else ""
            write_whole(folder / _scene_file(row), row.result.setting.scene.to_toml(header).encode())
        super().write(folder)

    def figure(self) -> Figure:
        """Cost against error; points of the front have numbers, and beside the axes stands what they are."""
        shown = [row for row in self.rows if row.angle_error > 0]
        front = [row for row in shown if row.on_front]
        kinds = dict(zip(dict.fromkeys(row.result.setting.kinematics for row in shown), COLOURS, strict=False))
        figure = Figure(figsize=(7.2, 4.2), layout="constrained")
        axes = figure.subplots()
        axes.set(xscale="log", yscale="log", xlabel="seconds of the processor")
        axes.set(ylabel="error of the fibre angle, degrees")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter("{x:g}")
        axes.plot(*_places(front), color="0.6", zorder=0, lw=0.8)
        for kinematics, colour in kinds.items():
            same = [row for row in shown if row.result.setting.kinematics == kinematics]
            axes.plot(*_places(same), "o", color=colour, markerfacecolor="white", markersize=4, label=kinematics)
            axes.plot(*_places([row for row in same if row.on_front]), "o", color=colour, markersize=5)
        if kinds:
            figure.legend(loc="outside lower left", ncols=3)
            names = [row.result.setting.name for row in front]
            names += [f"no error: {row.result.setting.name}" for row in self.rows if row.on_front and row not in front]
            place: dict[str, Any] = {"loc": "outside right center", "handlelength": 0, "fontsize": 6.5}
            place |= {"title": "filled, from left to right: no\nother one is as good for less", "title_fontsize": 7.5}
            figure.legend([Line2D([], [], linestyle="")] * len(names), names, **place)
        return figure


def _scene_file(row: Row) -> str:
    return f"{ROWS}/{row.result.setting.name}.toml"


def _places(rows: list[Row]) -> tuple[list[float], list[float]]:
    return [row.result.seconds for row in rows], [row.angle_error for row in rows]
