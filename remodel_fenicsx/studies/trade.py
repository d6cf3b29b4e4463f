"""`remodel-fenicsx trade SCENE`: what each setting of a scene costs and how far off it is, measured on the scene."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from remodel_fenicsx.body.columns import PROFILE
from remodel_fenicsx.scene.scene import Scene
from remodel_fenicsx.schema.times import same_time
from remodel_fenicsx.studies import trade_output
from remodel_fenicsx.studies.convergence import typical
from remodel_fenicsx.studies.estimates import Result, Trade, estimated
from remodel_fenicsx.studies.ladder import Setting, as_run, compared_lengths, compared_times, ladder
from remodel_fenicsx.studies.members import LEAST, Member, Study, TooFewRuns, run_members
from remodel_fenicsx.system.children import cores

NAME = "trade"
BUDGET = 600.0  # seconds
NOTHING = 1e-9  # degrees: the error of what others are compared with


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
        If a signal asked for the end: the same call goes on from there.
    OSError
        If a file cannot be written.
    """
    place = Path(folder or Path("results") / f"{scene.name}-{NAME}")
    settings = ladder(scene)
    times = compared_times(scene, settings)
    members = {
        setting.name: [
            Member(f"{setting.name}-{seed}", as_run(setting, seed, times), place / f"{setting.name}-{seed}")
            for seed in setting.seeds
        ]
        for setting in settings
    }
    runner = _Runner(settings, members, times, budget, say)
    failed = runner.run(jobs or cores(), Study(NAME, scene.name, place))
    results = runner.results()
    if len(results) < LEAST:
        reached = f"{len(results)} of {len(settings)} settings reached the end within the budget of {budget:g} s"
        raise TooFewRuns(reached, failed, runner.advice(LEAST - len(results), jobs or cores(), failed))
    rows, notes = estimated(results)
    done = {row.result.setting.name for row in rows}
    left = [name for name, runs in members.items() if name not in done and not any(run.name in failed for run in runs)]
    found = Trade(rows, notes, left, failed)
    trade_output.write(found, place, scene)
    return place, found


class _Runner:
    """The runs of a study in the order of their cost, within a budget."""

    def __init__(
        self,
        settings: Sequence[Setting],
        members: dict[str, list[Member]],
        times: list[float],
        budget: float,
        say: Callable[[str], None] | None,
    ):
        self.settings, self.members, self.times, self.say = settings, members, times, say
        self.deadline = clock.monotonic() + budget
        self._results: dict[str, Result] = {}
        self._pace: dict[tuple[str, str], float] = {}  # seconds over those expected, by kinematics and coupling

    def run(self, jobs: int, study: Study) -> dict[str, str]:
        """All that fits; returns the last words of those that failed."""
        self._finished()
        every = [member for setting in self.settings for member in self.members[setting.name]]
        return run_members(every, jobs, study, self.say is None, self.deadline, self._fits, self._finished)

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
            "steps, each process a few seconds for its start, and more where kernels are to be compiled"
        )

    def _expected(self, setting: Setting) -> float:
        """Seconds of one of its runs, by what others have taken."""
        return self._pace.get(setting.way, 1.0) * setting.expected_seconds

    def _fits(self, member: Member) -> bool:
        """Whether a run that begins now would end in time."""
        setting = next(setting for setting in self.settings if member in self.members[setting.name])
        return clock.monotonic() + self._expected(setting) < self.deadline

    def _finished(self) -> None:
        """Read, say and learn from what is new."""
        for setting in self.settings:
            members = self.members[setting.name]
            if setting.name in self._results or not all(member.is_complete() for member in members):
                continue
            result = self._results[setting.name] = read(setting, members, self.times)
            self._pace[setting.way] = max(result.wall_seconds / setting.expected_seconds, 0.1)
            if self.say is not None:
                rows, _ = estimated(self.results()) if len(self._results) > 1 else ([], [])
                error = next((row.angle_error for row in rows if row.result.setting == setting), np.nan)
                so_far = f"so far {error:.2g} degrees off" if error > NOTHING else "the finest so far"
                self.say(f"{setting.in_words()}: {result.seconds:.2g} s, {so_far}")


def read(setting: Setting, members: Sequence[Member], times: Sequence[float]) -> Result:
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
