"""`remodel-fenicsx trade SCENE`: what each setting of a scene costs and how far off it is, measured on the scene."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from remodel_fenicsx.body.columns import PROFILE
from remodel_fenicsx.results.recording import RecordingError
from remodel_fenicsx.results.run_lock import RunLock
from remodel_fenicsx.scene.scene import Scene
from remodel_fenicsx.schema.times import same_time
from remodel_fenicsx.studies.estimates import Result, Row, Trade, estimated, typical
from remodel_fenicsx.studies.ladder import Setting, as_run, compared_lengths, compared_times, ladder
from remodel_fenicsx.studies.page import COLOURS, STYLE, Page, add_head
from remodel_fenicsx.studies.runs import FEWEST_RUNS, Run, TooFewRuns, run_all, write_study
from remodel_fenicsx.system.children import cores
from remodel_fenicsx.system.environment import versions
from remodel_fenicsx.system.regular_files import make_own_folder, write_whole

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
    """Run a scene with a ladder of settings, and estimate the error of each.

    Parameters
    ----------
    scene
        The user's.
    folder
        Default: results/NAME-trade. What is recorded there of the same scene is not run again; runs that were stopped
        go on.
    budget
        Wall time in seconds for the runs of this call: cheap ones first; what would take longer is left out.
    jobs
        Runs at a time; default: the number of cores.
    say
        Takes a line whenever a setting is done.

    Returns
    -------
    The folder with trade.csv, trade.png, a scene of each row in rows/, and the runs; and the table.

    Raises
    ------
    SceneError
        If a folder holds another scene.
    TooFewRuns
        If fewer than two settings reach the end; it says what a budget for two would be.
    Interrupted
        If a signal asked for the end, SIGUSR1 after the steps under way: the same call goes on from there.
    OSError
        If a file cannot be written.
    """
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
    """Cost against error; points of the front have numbers, and beside the axes stands what they are.

    Of points that would cover each other the cheapest has one.
    """
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
