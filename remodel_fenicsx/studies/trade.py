"""`remodel-fenicsx trade SCENE`: what each setting of a scene costs and how far off it is, measured on the scene."""

from __future__ import annotations

import logging
import time as clock
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from remodel_fenicsx.body.reductions import AUTO, choice, is_for_means, objections, step_cost
from remodel_fenicsx.body.shape import PROFILE
from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.model.laws import LAWS
from remodel_fenicsx.results.recording import RecordingError
from remodel_fenicsx.results.run_lock import RunLock
from remodel_fenicsx.scene.presets import EXACT, PROFILES, profile_for
from remodel_fenicsx.scene.scene import Scene, SceneError
from remodel_fenicsx.schema.times import same_time
from remodel_fenicsx.studies.page import COLOURS, Page, STYLE, add_head
from remodel_fenicsx.studies.study import FEWEST_RUNS, Run, TooFewRuns, run_all, write_study
from remodel_fenicsx.system.children import cores
from remodel_fenicsx.system.environment import versions
from remodel_fenicsx.system.files import make_own_folder, write_whole


# ---------------------------------------------------------------- settings of a scene from coarse to fine
# Settings of a scene from coarse to fine: what `remodel-fenicsx trade` runs, each a scene that a user could take.

log = logging.getLogger(__name__)

SECONDS_PER_POINT = 3e-5  # of a step: a first guess, corrected by the runs
COST_OF_EXACT = 20.0  # of a step with the coupling that has no error in time, in others, as measured on the artery
DEGREES_PER_RUN = 60.0  # what angles turn by: steps of a tolerance are about so many tolerances
STEPS = (8.0, 5.0, 4.0, 2.5, 2.0)  # longer ones than the scene's, in its own
FINER_STEPS = 3  # of the scene's own step
TOLERANCES = (2.0, 1.0, 0.5, 0.25)  # degrees
MESHES = ((1, 1), (2, 1), (4, 1), (8, 1), (1, 2), (2, 2), (4, 2))  # refinement, degree
TOGETHER = ((2, 1, 0.5), (2, 2, 0.5), (2, 2, 0.25), (4, 2, 0.25))  # both finer: refinement, degree, step in the scene's
SEEDS = 3  # where another mesh draws other cells
COMPARED = 8  # times at which rows are compared, beside corners of ramps and the end
STRETCH, COUPLING = "mean_stretch", "remodeling.coupling"
TIME, MESH, BOTH, KINEMATIC = "time", "mesh", "both", "kinematics"


@dataclass(frozen=True)
class Setting:
    """One row of the table."""

    name: str
    factor: str
    changes: Mapping[str, Any] = field(hash=False)
    scene: Scene = field(hash=False)
    seeds: tuple[int, ...]
    profile: str = ""

    @property
    def step(self) -> float | None:
        """The fixed step; None with a tolerance."""
        return self.scene.time.step if self.scene.time.tolerance is None else None

    @property
    def mesh(self) -> tuple[str, int, int]:
        """Kinematics, refinement and degree."""
        return self.scene.model.kinematics, self.scene.mesh.refinement, self.scene.mesh.degree

    @property
    def way(self) -> tuple[str, str]:
        """Kinematics and coupling: what a step costs goes by them."""
        return self.scene.model.kinematics, self.scene.remodeling.coupling

    @property
    def expected_seconds(self) -> float:
        """Of one of its runs, roughly."""
        time, is_exact = self.scene.time, self.scene.remodeling.coupling == EXACT
        steps: float = time.number_of_steps
        if time.tolerance is not None:  # where steps have no error they are as long as they may be
            steps = COMPARED if is_exact else DEGREES_PER_RUN / time.tolerance
        cost = step_cost(self.scene, self.scene.model.kinematics) * (COST_OF_EXACT if is_exact else 1.0)
        return SECONDS_PER_POINT * cost * steps

    @property
    def steps_in_words(self) -> str:
        """How long they are, or their tolerance."""
        return f"step {self.step:g}" if self.step is not None else f"tolerance {self.scene.time.tolerance:g}"

    def in_words(self) -> str:
        """Kinematics, mesh, steps and coupling on a line."""
        kinematics, refinement, degree = self.mesh
        mesh = "" if KINEMATICS[kinematics].homogeneous else f" refinement {refinement} degree {degree}"
        profile = f" (profile {self.profile})" if self.profile else ""
        coupling = f" {self.way[1]}" if COUPLING in self.changes else ""
        return f"{kinematics:12}{mesh} {self.steps_in_words}{coupling}{profile}"


def ladder(scene: Scene) -> list[Setting]:
    """All settings that the scene allows, each once: sweeps of one factor from the cheapest kinematics, then both."""
    solved = choice(scene).name
    # without its profile, which would choose the steps of every row; what the profile has set stays
    base = scene.with_values({"model.kinematics": _cheapest(scene), "time.tolerance": None, "profile": None})
    step, mesh = base.time.step, (base.mesh.refinement, base.mesh.degree)
    random, seed = scene.has_random_cells, scene.cells.seed
    several = tuple(range(seed, seed + SEEDS)) if random else (seed,)
    found: dict[str, Setting] = {}

    def known(values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Without those of a mesh that means nothing, or is given."""
        homogeneous = KINEMATICS[values.get("model.kinematics", base.model.kinematics)].homogeneous
        if scene.geometry.refines and not homogeneous:
            return values
        return {key: value for key, value in values.items() if not key.startswith("mesh.")}

    def add(factor: str, seeds: tuple[int, ...], values: Mapping[str, Any], profile: str = "") -> Setting | None:
        values = known(values)
        try:
            changed = base.with_values(values)
        except SceneError as error:  # a step of which a corner is no multiple, an element that a formulation has not
            log.debug("left out: %s", error)
            return None
        name = _name(changed) + (f"-{values[COUPLING]}" if COUPLING in values else "")
        setting = Setting(f"profile-{profile}" if profile else name, factor, values, changed, seeds, profile)
        return found.setdefault(name, setting)

    def meshes(refinement: int, degree: int) -> dict[str, int]:
        return {"mesh.refinement": refinement * mesh[0], "mesh.degree": degree}

    add(MESH, several, {})
    remodels = LAWS[scene.remodeling.law].remodels
    for name in PROFILES if remodels else ():
        profile = profile_for(name, base)
        own = {"model.kinematics": base.model.kinematics}
        values = profile.settings(base.with_values(known(profile.values | own)))
        values |= own if values["model.kinematics"] == AUTO else {}
        if values != own and all(values != setting.changes for setting in found.values()):
            add(BOTH, several, values, name)
    for factor in [*STEPS, *(0.5**k for k in range(1, FINER_STEPS + 1))]:
        add(TIME, (seed,), {"time.step": factor * step})
    for refinement, degree in MESHES:
        add(MESH, several, meshes(refinement, degree))
    for refinement, degree, factor in TOGETHER:
        add(BOTH, several, meshes(refinement, degree) | {"time.step": factor * step})
    for tolerance in TOLERANCES if remodels else ():
        add(BOTH, several, meshes(2, 2) | {"time.tolerance": tolerance})
        add(TIME, (seed,), {"time.tolerance": tolerance})
    if base.has_exact_coupling and base.remodeling.coupling != EXACT:  # long steps are as good as short ones, and pay
        values = {COUPLING: EXACT}
        longer = [add(TIME, several, values | {"time.step": factor * step}) for factor in STEPS]
        longest = max((setting.scene.time.step for setting in longer if setting is not None), default=step)
        for refinement, degree in MESHES:
            add(MESH, several, values | meshes(refinement, degree) | {"time.step": longest})
        for tolerance in TOLERANCES[:1]:
            add(BOTH, several, values | meshes(2, 2) | {"time.tolerance": tolerance})
    for name in dict.fromkeys((solved, "sector", "full")):
        if name == solved or not (objections(scene, name) or is_for_means(scene, name)):
            add(KINEMATIC, several if is_for_means(scene, name) else (seed,), {"model.kinematics": name})
    return sorted(found.values(), key=lambda setting: setting.expected_seconds)


def _cheapest(scene: Scene) -> str:
    """That of `auto`, whatever the scene says."""
    return choice(scene.with_values({"model.kinematics": AUTO})).name


def _name(scene: Scene) -> str:
    time, (kinematics, mesh) = scene.time, (scene.model.kinematics, scene.mesh)
    steps = f"step-{time.step:g}" if time.tolerance is None else f"tolerance-{time.tolerance:g}"
    return f"{kinematics}-{mesh.refinement}-degree-{mesh.degree}-{steps}"


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
    radii = [column.name for column in columns if column.unit == "length"]
    if radii:
        return "radii", radii
    stretch = [column.name for column in columns if column.name == STRETCH]
    return ("stretch", stretch) if stretch else ("volume", [c.name for c in columns if c.unit == "length^3"])


def as_run(setting: Setting, seed: int, times: list[float]) -> Scene:
    """The scene of a run of the study: only what is compared is measured."""
    columns = [*compared_lengths(setting.scene)[1], "substeps", "seconds", "processor_seconds", *PROFILE]
    values = {"output.fields": False, "output.columns": columns, "output.times": times, "output.every": 1}
    return setting.scene.with_values({**values, "cells.seed": seed, "name": f"{setting.name}-{seed}"})


def is_reduced(setting: Setting) -> bool:
    """Whether a part stands for the body."""
    return KINEMATICS[setting.scene.model.kinematics].reduced


# ---------------------------------------------------------------- the errors of settings from what all of them give
# The errors of settings from what all of them give: the table of a trade, and what it rests on.
#  What ever finer settings tend to is known by Richardson's extrapolation, where their results show an order.

Array = NDArray[np.float64]

UNKNOWN_SHARE = 0.5  # of an error: what is left unknown may be so much of it
NO_ERROR = 1e-6  # degrees: what solves leave is less, what elements and steps leave more
SPREAD = 2.0  # noise of the mean over the seeds that an error must be above
RATIOS = (1.35, 40.0)  # of differences of one halving and the next that are those of an order
ALIGNED = 0.5  # cosine of the angle between two differences, as vectors, that shrink along one way


# ---------------------------------------------------------------- an order, and what is left with it
@dataclass(frozen=True)
class SweepLimit:
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
    if len(results) < 3:
        last = results[-1] - results[-2] if len(results) == 2 else np.full_like(results[-1], np.nan)
        return SweepLimit(np.zeros_like(results[-1]), np.nan, last)
    before, last = results[-2] - results[-3], results[-1] - results[-2]
    size_before, size = typical(before), typical(last)
    if size == 0:
        return SweepLimit(np.zeros_like(last), np.inf, last)
    ratio = size_before / size
    cosine = float(np.nansum(before * last) / max(np.nansum(before**2) ** 0.5 * np.nansum(last**2) ** 0.5, 1e-300))
    if not RATIOS[0] < ratio < RATIOS[1] or cosine < ALIGNED:
        return SweepLimit(np.zeros_like(last), np.nan, last)
    return SweepLimit(np.asarray(last / (ratio - 1), dtype=np.float64), float(np.log2(ratio)), last)


def typical(values: Array) -> float:
    """Root mean square of what is known."""
    return float(np.sqrt(np.nanmean(values**2)))


def pareto(costs: Sequence[float], errors: Sequence[float]) -> list[bool]:
    """Which of some settings no other one beats in cost and error."""
    pairs = list(zip(costs, errors, strict=True))
    return [
        np.isfinite(error) and not any((c <= cost and e < error) or (c < cost and e <= error) for c, e in pairs)
        for cost, error in pairs
    ]


# ---------------------------------------------------------------- the table
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


@dataclass(frozen=True)
class Trade:
    """The table, and what it rests on."""

    rows: list[Row]
    notes: list[str]
    left_out: list[str]
    failed: dict[str, str]


@dataclass(frozen=True)
class _Guess:
    """Of the exact result: what settings of one coupling tend to."""

    angles: Array
    lengths: Array
    unknown: float
    beyond: float
    notes: list[str]


def estimated(results: Sequence[Result]) -> tuple[list[Row], list[str]]:
    """Rows with errors against the best guess of the exact result, and what it rests on."""
    notes = _about_steps_on_the_same_cells(results)
    results = _on_the_mean(results)
    fixed = [result for result in results if result.setting.step is not None]
    by_coupling = {
        name: [result for result in fixed if result.setting.way[1] == name]
        for name in dict.fromkeys(result.setting.way[1] for result in fixed)
    }
    guesses = {name: _guess(same) for name, same in by_coupling.items()}
    if not guesses:
        return [Row(result, np.nan, np.nan, doubt="nothing to compare with") for result in results], notes
    name, best = min(guesses.items(), key=lambda item: float(np.hypot(item[1].unknown, item[1].beyond)))
    notes += best.notes
    for other, guess in guesses.items():
        if other != name and np.isfinite(guess.unknown):
            apart = typical(guess.angles - best.angles)
            notes.append(f"couplings: the limits of {other!r} and {name!r} are {apart:.2g} degrees apart")
    rows = [_row(result, best) for result in results]
    rows.sort(key=lambda row: row.result.seconds)
    on_front = pareto([row.result.seconds for row in rows], [row.angle_error for row in rows])
    notes += _about_kinematics(results)
    return [replace(row, on_front=is_best) for row, is_best in zip(rows, on_front, strict=True)], notes


def _guess(fixed: Sequence[Result]) -> _Guess:
    """What settings with fixed steps, and one coupling, tend to."""
    finest = min(fixed, key=_fineness)
    angles, lengths, unknown, notes = finest.angles, finest.lengths, 0.0, []
    sweeps = {"time": _time_sweep(fixed)}
    if not KINEMATICS[finest.setting.mesh[0]].homogeneous:
        sweeps["mesh"] = _mesh_sweep(fixed)
    for factor, (sweep, words) in sweeps.items():
        if not sweep:
            notes.append(f"{factor}: fewer than two settings were run, so its error is in no estimate")
            unknown = np.inf
            continue
        found, found_lengths = limit([r.angles for r in sweep]), limit([r.lengths for r in sweep])
        # what the sweep has still before it where the finest of all stands
        ahead = next((r for r in sweep if _same_level(r, finest, factor)), sweep[-1])
        angles = angles + found.beyond + sweep[-1].angles - ahead.angles
        lengths = lengths + found_lengths.beyond + sweep[-1].lengths - ahead.lengths
        notes.append(_setting_words(factor, words, found))
        if not found.trusted:
            unknown = max(unknown, typical(found.last)) if np.isfinite(found.last).any() else np.inf
    return _Guess(angles, lengths, unknown, typical(angles - finest.angles), notes)


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
    _, refinement, degree = result.setting.mesh
    return (result.setting.step or np.inf) / (refinement * degree**2), not is_reduced(result.setting)


def _time_sweep(results: Sequence[Result]) -> tuple[list[Result], str]:
    """A chain of halved steps on one mesh: of chains that may tell an order that on the finest mesh."""
    chains = []
    for mesh in sorted({result.setting.mesh for result in results}, key=lambda mesh: mesh[1] * mesh[2] ** 2):
        same = [r for r in results if r.setting.mesh == mesh]
        chains.append(_halved({r.setting.step: r for r in same if r.setting.step is not None}))
    found = _last_of_the_longest(chains)
    return found, f"steps {', '.join(f'{r.setting.step:g}' for r in found)} on {_mesh_in_words(found)}"


def _mesh_sweep(results: Sequence[Result]) -> tuple[list[Result], str]:
    """A chain of doubled refinements: of chains that may tell an order that of the highest degree, with small steps."""
    chains = []
    fixed = [(r.setting.step, r) for r in results if r.setting.step is not None]
    kinds = {(r.setting.mesh[2], -step, r.setting.mesh[0]) for step, r in fixed}
    for degree, negative, kinematics in sorted(kinds):
        same = [r for step, r in fixed if step == -negative and r.setting.mesh[::2] == (kinematics, degree)]
        chains.append(_halved({1.0 / r.setting.mesh[1]: r for r in same}))
    found = _last_of_the_longest(chains)
    refinements = ", ".join(str(r.setting.mesh[1]) for r in found)
    return found, f"refinements {refinements} of degree {found[-1].setting.mesh[2] if found else 0}"


def _last_of_the_longest(chains: Sequence[list[Result]]) -> list[Result]:
    """The last chain of three or more, or of two; nothing where there is none."""
    for length in (3, 2):
        if long := [chain for chain in chains if len(chain) >= length]:
            return long[-1]
    return []


def _mesh_in_words(found: Sequence[Result]) -> str:
    return f"refinement {found[-1].setting.mesh[1]}, degree {found[-1].setting.mesh[2]}" if found else "no mesh"


def _halved(by_size: dict[float, Result]) -> list[Result]:
    """The longest chain of sizes that are each half of the one before, the finest last."""
    chains = []
    for size in by_size:
        chain = [size]
        while (finer := next((s for s in by_size if same_time(2 * s, chain[-1])), None)) is not None:
            chain.append(finer)
        chains.append(chain)
    longest = max(chains, key=lambda chain: (len(chain), -chain[-1]), default=[])
    return [by_size[size] for size in longest]


def _same_level(result: Result, finest: Result, factor: str) -> bool:
    if factor == "time":
        return result.setting.step == finest.setting.step
    return result.setting.mesh[1:] == finest.setting.mesh[1:]


def _setting_words(factor: str, words: str, found: SweepLimit) -> str:
    if typical(found.last) < NO_ERROR:
        return f"{factor}: no error ({words}): the last two differ by {typical(found.last):.2g} degrees"
    if found.trusted:
        return f"{factor}: order {found.order:.2g} ({words}); the finest is {typical(found.beyond):.2g} degrees off"
    return (
        f"{factor}: no order seen ({words}), the last two differ by {typical(found.last):.2g} degrees: the estimates "
        "are differences to the finest, and no better than that"
    )


def _about_steps_on_the_same_cells(results: Sequence[Result]) -> list[str]:
    """What steps alone cost, where the noise of random cells hides it: all of them have the first seed's cells."""
    if not any(result.noise for result in results):
        return []
    by_mesh: dict[tuple[str, int, int], list[Result]] = {}
    for result in results:
        by_mesh.setdefault(result.setting.mesh, []).append(replace(result, angles=result.single[0]))
    same = max(by_mesh.values(), key=len)  # the mesh on which most steps were tried
    sweep = _halved({result.setting.step: result for result in same if result.setting.step is not None})
    if len(sweep) < 2:
        return []
    found = limit([result.angles for result in sweep])
    exact, finest = sweep[-1].angles + found.beyond, sweep[-1].setting
    costs = ", ".join(
        f"{r.setting.steps_in_words} {typical(r.angles - exact):.2g}" for r in same if r.setting is not finest
    )
    last = "an order shows" if found.trusted else f"no order shows, {finest.steps_in_words} counts as exact"
    return [f"steps alone, on the same cells ({_mesh_in_words(sweep)}; {last}), cost in degrees: {costs}"]


def _about_kinematics(results: Sequence[Result]) -> list[str]:
    """Whether the whole body does what a part of it does."""
    notes = []
    for result in results:
        if result.setting.factor != KINEMATIC or is_reduced(result.setting):
            continue
        alike = [r for r in results if is_reduced(r.setting) and r.setting.mesh[1:] == result.setting.mesh[1:]]
        part = next((r for r in alike if (r.setting.step, r.setting.way[1])
                     == (result.setting.step, result.setting.way[1])), None)  # fmt: skip
        if part is not None:
            apart = typical(result.angles - part.angles)
            several = "; where finer meshes do not bring them together the body has several solutions"
            notes.append(
                f"kinematics: {result.setting.mesh[0]} and {part.setting.mesh[0]} on alike elements are {apart:.2g} "
                f"degrees apart{several if apart > NO_ERROR else ''}"
            )
    return notes


TRADE = "trade"
BUDGET = 600.0  # seconds
NOTHING = 1e-9  # degrees: the error of what others are compared with
ROWS = "rows"  # folder of the scenes
WANTED = 1.0  # degrees of error, which the verdict asks for: less than what random cells scatter
SIZE = 8.0  # of a point with a number in it
APART = 0.05  # of the axes: such points that are closer would cover each other


def trade(
    scene: Scene,
    folder: Path | str | None = None,
    budget: float = BUDGET,
    jobs: int | None = None,
    say: Callable[[str], None] | None = None,
) -> tuple[Path, Trade]:
    """Run a scene with a ladder of settings, and estimate the error of each."""
    place = Path(folder or Path("results") / f"{scene.name}-{TRADE}")
    settings = ladder(scene)
    times = compared_times(scene, settings)
    members = {
        setting.name: [
            Run(f"{setting.name}-{seed}", as_run(setting, seed, times), place / f"{setting.name}-{seed}")
            for seed in setting.seeds
        ]
        for setting in settings
    }
    runner = _Runner(settings, members, times, budget, say)
    with RunLock(place):
        failed = runner.run(jobs or cores(), place, scene.name)
        results = runner.results()
        if len(results) < FEWEST_RUNS:
            reached = f"{len(results)} of {len(settings)} settings reached the end within the budget of {budget:g} s"
            raise TooFewRuns(reached, failed, runner.advice(FEWEST_RUNS - len(results), jobs or cores(), failed))
        rows, notes = estimated(results)
        done = {row.result.setting.name for row in rows}
        left = [
            name for name, runs in members.items() if name not in done and not any(run.name in failed for run in runs)
        ]
        found = Trade(rows, notes, left, failed)
        write(found, place, scene)
    return place, found


class _Runner:
    """The runs of a study in the order of their cost, within a budget."""

    def __init__(
        self,
        settings: Sequence[Setting],
        members: dict[str, list[Run]],
        times: list[float],
        budget: float,
        say: Callable[[str], None] | None,
    ):
        self.settings, self.members, self.times, self.say = settings, members, times, say
        self.deadline = clock.monotonic() + budget
        self._results: dict[str, Result] = {}
        self._pace: dict[tuple[str, str], float] = {}  # seconds over those expected, by kinematics and coupling

    def run(self, jobs: int, place: Path, name: str) -> dict[str, str]:
        """All that fits, of the scene of this name in a folder; returns the last words of those that failed."""
        self._finished()
        every = [run for setting in self.settings for run in self.members[setting.name]]
        return run_all(
            every,
            jobs,
            f"{name} {TRADE}",
            quiet=self.say is None,
            deadline=self.deadline,
            fits=self._fits,
            ended=self._finished,
            checked=lambda: write_study(place, TRADE, name, every),
        )

    def results(self) -> list[Result]:
        """Of the settings all of whose runs have reached the end, the cheapest expected first."""
        return [self._results[setting.name] for setting in self.settings if setting.name in self._results]

    def advice(self, number: int, jobs: int, failed: Mapping[str, str]) -> str:
        """What the cheapest settings that are left would take, if so many are left."""
        left = [
            -(-len(self.members[setting.name]) // jobs) * self._expected(setting)
            for setting in self.settings
            if setting.name not in self._results and not any(run.name in failed for run in self.members[setting.name])
        ]
        if len(left) < number:
            return "the same command tries again what has failed"
        return (
            f"a larger budget goes on; the cheapest {number} need about {sum(sorted(left)[:number]):.2g} s for their "
            "steps; add a few seconds for the start of each process, and more where code must be compiled"
        )

    def _expected(self, setting: Setting) -> float:
        """Seconds of one of its runs, by what others have taken."""
        return self._pace.get(setting.way, 1.0) * setting.expected_seconds

    def _fits(self, member: Run) -> bool:
        """Whether a run that begins now would end in time."""
        setting = next(setting for setting in self.settings if member in self.members[setting.name])
        return clock.monotonic() + self._expected(setting) < self.deadline

    def _finished(self) -> None:
        """Learn from what is new."""
        for setting in self.settings:
            members = self.members[setting.name]
            with suppress(RecordingError):  # one that is damaged will be among those that have failed
                if setting.name not in self._results and all(member.is_complete() for member in members):
                    self._learn_from(setting, members)

    def _learn_from(self, setting: Setting, members: Sequence[Run]) -> None:
        """Read its runs, and say what they say."""
        result = self._results[setting.name] = read(setting, members, self.times)
        self._pace[setting.way] = max(result.wall_seconds / setting.expected_seconds, 0.1)
        if self.say is not None:
            rows, _ = estimated(self.results()) if len(self._results) > 1 else ([], [])
            error = next((row.angle_error for row in rows if row.result.setting == setting), np.nan)
            so_far = f"so far {error:.2g} degrees off" if error > NOTHING else "the finest so far"
            self.say(f"{setting.in_words()}: {result.seconds:.2g} s, {so_far}")


def read(setting: Setting, members: Sequence[Run], times: Sequence[float]) -> Result:
    """The rows at some times of the runs of a setting."""
    angles, lengths, seconds, wall = [], [], [], []
    for member in members:
        history = member.history()
        rows = [next(r for r, time in enumerate(history["time"]) if same_time(float(time), t)) for t in times]
        angles.append(np.array([history[name] for name in PROFILE]).T[rows])
        known = compared_lengths(setting.scene)[1]
        lengths.append(np.array([history[name] for name in known]).T[rows])
        seconds.append(float(np.nansum(history["processor_seconds"])))
        wall.append(float(np.nansum(history["seconds"])))
    noise = np.std(angles, axis=0, ddof=1) / np.sqrt(len(angles)) if len(angles) > 1 else np.zeros(1)
    single = angles[0], lengths[0]
    means = np.mean(angles, axis=0), np.mean(lengths, axis=0)
    return Result(setting, *means, float(np.mean(seconds)), float(np.mean(wall)), typical(noise), single)


# ---------------------------------------------------------------- the answer: words, a table, a picture, scenes
def in_words(found: Trade) -> str:
    """The table for a terminal."""
    lengths = compared_lengths(found.rows[0].result.setting.scene)[0]
    lines = [f"{'':2}{'seconds':>9} {'degrees':>9} {lengths + ' %':>9}  setting"]
    for row in found.rows:
        setting = row.result.setting
        doubt = f"  ({row.doubt})" if row.doubt else ""
        lines.append(
            f"{'* ' if row.on_front else '  '}{row.result.seconds:9.3g} {row.angle_error:9.2g} "
            f"{100 * row.length_error:9.2g}  {setting.in_words()}{doubt}"
        )
    lines.append(
        "*: no other setting is as good for less. Errors are estimates; degrees: fibre angle, root mean square."
    )
    lines += [verdict(found.rows), *found.notes]
    if found.left_out:
        lines.append(f"left out, over the budget: {', '.join(found.left_out)}")
    return "\n".join(lines)


def verdict(rows: list[Row]) -> str:
    """The answer in a sentence: what `WANTED` degrees cost."""
    trusted = [row for row in rows if not row.doubt]
    good = [row for row in trusted if row.angle_error <= WANTED]
    if not trusted:
        return f"Not known: all {len(rows)} errors are doubted; trade.csv says why."
    if good:
        best = min(good, key=lambda row: (row.result.seconds, row.angle_error))
    else:
        best = min(trusted, key=lambda row: row.angle_error)
    what = (
        f"{_words(best)}, {best.result.seconds:.2g} s of the processor for an error of {best.angle_error:.2g} degrees"
    )
    if not good:
        return f"No setting is known to be within {WANTED:g} degree; the closest is {what}."
    return f"The cheapest setting within {WANTED:g} degree is {what}."


def write(found: Trade, folder: Path, scene: Scene) -> None:
    """Write trade.csv, trade.png and a scene of each row."""
    title = f"{scene.name}: error and cost of its settings"
    made_with = ", ".join(f"{name} {version}" for name, version in versions().items() if name != "BLAS")
    page = Page(folder, "trade", title, "Estimated errors; filled: no other setting is as good for less.")
    rows = found.rows
    table: dict[str, list[str] | list[float] | list[int]] = {
        "setting": [row.result.setting.name for row in rows],
        "scene": [_scene_file(row) for row in rows],
        "error_degrees": [row.angle_error for row in rows],
        f"error_{compared_lengths(scene)[0]}": [row.length_error for row in rows],
        "cpu_seconds": [row.result.seconds for row in rows],
        "on_front": [int(row.on_front) for row in rows],
        "trusted": [int(not row.doubt) for row in rows],
        "doubt": [row.doubt for row in rows],
        "noise": [row.result.noise for row in rows],
    }
    page.save_table(table, [title, *found.notes, made_with])
    make_own_folder(folder / ROWS)
    for row in rows:
        doubt = f" ({row.doubt})" if row.doubt else ""
        header = (
            f"{scene.name}: {row.angle_error:.2g} degrees and {100 * row.length_error:.2g} % off for "
            f"{row.result.seconds:.2g} s, as estimated by remodel-fenicsx trade{doubt}"
        )
        write_whole(folder / _scene_file(row), row.result.setting.scene.to_toml(header).encode())
    with rc_context(STYLE):
        figure = picture(rows)
        add_head(figure, title, verdict(rows))
        page.save_figure(figure, made_with)


def _scene_file(row: Row) -> str:
    return f"{ROWS}/{row.result.setting.name}.toml"


def picture(rows: list[Row]) -> Figure:
    """Cost against error; points of the front have numbers, and beside the axes stands what they are."""
    shown = [row for row in rows if row.angle_error > 0]
    kinds = dict(zip(dict.fromkeys(row.result.setting.way for row in shown), COLOURS, strict=False))
    figure = Figure(figsize=(7.2, 4.2), layout="constrained")
    axes = figure.subplots()
    axes.set(xscale="log", yscale="log", xlabel="seconds of the processor", ylabel="error of the fibre angle, degrees")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
    front = [row for row in shown if row.on_front]
    axes.plot(*_places(front), color="0.6", zorder=0, lw=0.8)
    for way, colour in kinds.items():
        same = [row for row in shown if row.result.setting.way == way]
        axes.plot(*_places(same), "o", color=colour, markerfacecolor="white", markersize=4, label=", ".join(way))
    names = []
    for row in front:
        axes.plot(row.result.seconds, row.angle_error, "o", color=kinds[row.result.setting.way], markersize=4)
    for number, row in enumerate(_apart(front, shown), start=1):
        colour, at = kinds[row.result.setting.way], (row.result.seconds, row.angle_error)
        axes.plot(*at, "o", color=colour, markersize=SIZE)
        axes.annotate(str(number), at, ha="center", va="center_baseline", fontsize=6, color="white")
        names.append(f"{number}  {_words(row)}")
    names += [f"no error: {_words(row)}" for row in rows if row.on_front and row not in front]
    axes.margins(0.06)  # a point of the front is half as wide
    if kinds:
        figure.legend(loc="outside lower left", ncols=3)
        nothing = [Line2D([], [], linestyle="")] * len(names)
        place: dict[str, Any] = {"loc": "outside right center", "title_fontsize": 7.5}
        place["title"] = "filled: no other one\nis as good for less"
        figure.legend(nothing, names, handlelength=0, fontsize=6.5, **place)
    return figure


def _apart(front: list[Row], shown: list[Row]) -> list[Row]:
    """Those of the front whose points do not cover each other."""
    spread = np.maximum(np.ptp(np.log(_places(shown)), axis=1), 1e-9) if shown else np.ones(2)
    found: list[Row] = []
    for row in front:
        ways = [np.ptp(np.log(_places([row, other])), axis=1) / spread for other in found]
        if all(np.hypot(*way) > APART for way in ways):
            found.append(row)
    return found


def _words(row: Row) -> str:
    return " ".join(row.result.setting.in_words().split())


def _places(rows: list[Row]) -> tuple[list[float], list[float]]:
    return [row.result.seconds for row in rows], [row.angle_error for row in rows]
