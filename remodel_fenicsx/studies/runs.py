"""Several recorded runs, so many at a time: what is complete is not run again, what was stopped goes on.

The one executor of `ensemble`, `trade` and `figures`. Each of its processes does one run after the other, for most of a
short run is its start. The processes end with the command, even if that is killed.
"""

from __future__ import annotations

import json
import math
import time as clock
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from remodel_fenicsx.results.recording import (
    HISTORY,
    SCENE,
    STUDY,
    HistoryColumns,
    RecordedRun,
    RecordingError,
    read_history,
    steps_recorded,
)
from remodel_fenicsx.results.run_lock import writer
from remodel_fenicsx.scene.scene import Scene, SceneError
from remodel_fenicsx.schema.times import same_time
from remodel_fenicsx.system.children import Worker, wait_for_one
from remodel_fenicsx.system.interrupts import PAUSE, PAUSED, Interrupted, StopRequest
from remodel_fenicsx.system.regular_files import check_no_link, make_own_folder, refusal_in_words, write_whole
from remodel_fenicsx.system.terminal import Line

POLL = 0.1  # seconds
FEWEST_RUNS = 2  # runs, or settings, without which nothing is compared


class TooFewRuns(Exception):  # noqa: N818 - what is recorded is whole, and the same call goes on
    """Fewer than `FEWEST_RUNS` have reached the end, so that there is no answer yet.

    Attributes
    ----------
    failed
        Last words of runs that have failed, by name; empty where the study was only stopped early.
    """

    def __init__(self, reached: str, failed: Mapping[str, str], advice: str = "the same command goes on"):
        super().__init__(f"{reached}, at least {FEWEST_RUNS} are needed; all that is recorded is kept, {advice}")
        self.failed = dict(failed)


@dataclass(frozen=True)
class Run:
    """One of several runs.

    Attributes
    ----------
    name
        Unique among them; what is said of the run.
    scene
        What is run.
    folder
        Where its record is.
    """

    name: str
    scene: Scene
    folder: Path

    def beside(self, ending: str) -> Path:
        """A file beside its folder, of the same name: names have dots of their own (`step-0.5`)."""
        return self.folder.with_name(f"{self.folder.name}{ending}")

    @property
    def steps_done(self) -> int:
        """How many steps are recorded."""
        if self.scene.time.tolerance is None:
            return min(steps_recorded(self.folder), self.scene.time.number_of_steps)
        with suppress(RecordingError):  # none yet, or a row that is being written
            times = self.history()["time"]
            return int(self.scene.time.progress(len(times) - 1, float(times[-1]))) if len(times) else 0
        return 0

    def is_under_way(self) -> bool:
        """Whether a process writes in its folder."""
        return self.folder.is_dir() and writer(self.folder)[1]

    def is_complete(self) -> bool:
        """Whether this very scene is recorded to its end.

        Raises
        ------
        SceneError
            If the folder holds another scene.
        RecordingError
            If it is damaged, so that the run could not go on.
        """
        if not (self.folder / SCENE).exists() or not (self.folder / HISTORY).exists():
            return False
        recording = RecordedRun(self.folder)
        if not _same(recording, self.scene):
            raise SceneError(f"{self.folder}: holds a run of another scene; choose another folder with -o")
        try:
            history = recording.history
        except RecordingError:  # a last row that is not whole is done again
            return False
        if not len(history["time"]) or not same_time(float(history["time"][-1]), self.scene.last_time):
            return False
        if not self._has_all_rows(history):
            raise RecordingError(f"{self.folder}: its history has other columns or rows than its scene asks for")
        if self.scene.output.fields:
            recording.fields(self.scene.last_time)  # the last ones are behind all others in the file
        return True

    def _has_all_rows(self, history: HistoryColumns) -> bool:
        """Whether a history, perhaps somebody else's, has columns and rows of a run that has reached its end."""
        scene, times = self.scene, history["time"]
        names = [column.name for column in scene.columns()]
        is_fixed = scene.time.tolerance is None and not scene.time.is_equilibrium
        rows = scene.time.number_of_steps + 1 if is_fixed else len(times)
        return set(names) <= set(history) and len(times) == rows and bool((np.diff(times) > 0).all())

    def history(self) -> HistoryColumns:
        """What it has recorded."""
        return read_history(self.folder)


def _same(recording: RecordedRun, wanted: Scene) -> bool:
    """Whether it is of this scene: with the kinematics that "auto" took, its files by SHA-256 wherever they are."""
    if recording.scene == wanted:
        return True
    from mpi4py import MPI

    from remodel_fenicsx.running import with_files_kept
    from remodel_fenicsx.simulation import with_choices
    from remodel_fenicsx.unloading import as_unloaded

    try:
        kept, _ = with_files_kept(recording.scene)
    except (SceneError, OSError) as error:
        words = refusal_in_words(error) if isinstance(error, OSError) else error
        raise RecordingError(f"{recording.path}: {words}") from error
    with as_unloaded(wanted, MPI.COMM_SELF) as found:
        return kept == with_files_kept(with_choices(found))[0]


def write_study(folder: Path, name: str, scene: str, runs: Sequence[Run]) -> None:
    """Say in the folder of a study what it is: `remodel-fenicsx status` reads it.

    Parameters
    ----------
    folder
        Where all runs are; made if it is not there.
    name, scene
        Of the command, and of the user's scene.
    runs
        All of them.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"study": name, "scene": scene, "runs": [run.name for run in runs]}, indent=1)
    write_whole(folder / STUDY, (text + "\n").encode())


def run_all(
    runs: Sequence[Run],
    jobs: int,
    title: str,
    quiet: bool = False,
    deadline: float = math.inf,
    fits: Callable[[Run], bool] = lambda run: True,
    ended: Callable[[], None] = lambda: None,
    checked: Callable[[], None] = lambda: None,
) -> dict[str, str]:
    """Run what is not complete; returns the last words of those that have failed or are damaged, by name.

    Parameters
    ----------
    runs
        In the order in which they begin. One that another process has under way is waited for.
    jobs
        Runs at a time.
    title, quiet
        Of the line that shows the progress; no such line.
    deadline
        `time.monotonic` at which runs are stopped; what they have recorded stays.
    fits
        Asked before a run begins: whether it shall.
    ended
        Called when a run has ended. Where it raises, all others are stopped.
    checked
        Called before anything is written, when no folder holds another scene.

    Raises
    ------
    SceneError
        If a folder holds another scene.
    Interrupted
        If a signal asked for the end, SIGUSR1 after the steps under way: what is recorded stays, and the same call
        goes on from there.
    OSError
        If a folder cannot be written.
    """
    executor = _Executor(runs, jobs, fits)
    checked()
    line, failed, pausing = Line(title), executor.failed, False
    with StopRequest() as stop:
        try:
            while executor.waiting or executor.running:
                if stop.number:
                    raise Interrupted(stop.number)
                if clock.monotonic() > deadline:
                    break
                if stop.pause and not pausing:
                    pausing = True
                    executor.pause()
                executor.begin()
                wait_for_one(executor.running, POLL)
                for run, code, last_words in executor.ended():
                    if pausing and code in (PAUSED, -PAUSE):  # the latter before Python minds the signal
                        continue
                    if code != 0:
                        failed[run.name] = last_words
                    ended()
                if not quiet:
                    line.show(executor.progress())
        finally:
            executor.stop()
            line.end()
    if pausing:
        raise Interrupted(PAUSE)
    return failed


class _Executor:
    """The runs that wait, and the processes that do them."""

    def __init__(self, runs: Sequence[Run], jobs: int, fits: Callable[[Run], bool]):
        self.runs, self.jobs, self.fits = runs, jobs, fits
        self.failed: dict[str, str] = {}
        self.waiting = [run for run in runs if self._is_left(run)]
        self.running: dict[Worker, Run] = {}
        self.idle: list[Worker] = []

    def _is_left(self, run: Run) -> bool:
        """Whether it is to be run. One whose folder is damaged is not: nothing of the user's is removed."""
        try:
            return not run.is_complete()
        except RecordingError as error:
            self.failed[run.name] = str(error)
            return False

    def begin(self) -> None:
        """Begin runs until there are as many as jobs, or go on with what is there of them."""
        for run in list(self.waiting):
            if len(self.running) >= self.jobs:
                return
            if run.is_under_way():  # by another command, or by a process whose command was killed and that is ending
                continue
            self.waiting.remove(run)
            if self._is_left(run) and self.fits(run):
                worker = self.idle.pop() if self.idle else Worker()
                self.running[worker] = run
                _begin(worker, run)

    def ended(self) -> list[tuple[Run, int, str]]:
        """Runs that have ended since the last call: with exit code and last words."""
        found = []
        for worker, run in list(self.running.items()):
            code = worker.poll()
            if code is None:
                continue
            del self.running[worker]
            if code != 0 and run.is_under_way():  # another process was faster, so that this one was refused
                self.waiting.append(run)
            else:
                found.append((run, code, worker.last_words() if code else ""))
            if worker.is_alive:
                self.idle.append(worker)
        return found

    def pause(self) -> None:
        """Begin nothing more, and let each run end with the step under way."""
        self.waiting.clear()
        for worker in self.running:
            worker.process.send_signal(PAUSE)

    def stop(self) -> None:
        """End all processes; a run drops the step under way."""
        for worker in [*self.running, *self.idle]:
            worker.stop()

    def progress(self) -> str:
        """How far all runs are, and those under way."""
        total = sum(run.scene.time.number_of_steps for run in self.runs)
        done = {run.name: run.steps_done for run in self.runs}
        parts = [f"{run.name} {done[run.name]}/{run.scene.time.number_of_steps}" for run in self.running.values()]
        more = [f"{len(self.waiting)} more to start"] if self.waiting else []
        return f"{100 * sum(done.values()) // total} % of {len(self.runs)} runs: {', '.join(parts + more) or 'done'}"


def _begin(worker: Worker, run: Run) -> None:
    """Begin a run, or go on with what is there of it."""
    make_own_folder(run.folder.parent)
    check_no_link(run.folder)
    messages = run.beside(".txt")
    if (run.folder / SCENE).exists():
        worker.begin(["run", "--resume", str(run.folder), "-q", "--no-report"], messages)
        return
    scene = run.beside(".toml")
    write_whole(scene, run.scene.to_toml().encode())
    worker.begin(["run", str(scene), "-o", str(run.folder), "-q", "--no-report"], messages)
