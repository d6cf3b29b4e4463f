"""A study: several runs that answer one question, so many at a time; the same call goes on where it was stopped."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from mpi4py import MPI

from remodel_fenicsx.errors import PAUSED, RemodelError, SOLVE_FAILED
from remodel_fenicsx.results.recording import (
    HISTORY,
    SCENE,
    HistoryColumns,
    RecordedRun,
    RecordingError,
    RunLock,
    read_history,
    writer,
)
from remodel_fenicsx.running import with_files_kept
from remodel_fenicsx.scene import Scene
from remodel_fenicsx.scene.scene import SceneError
from remodel_fenicsx.schema import same_time
from remodel_fenicsx.initial import with_choices
from remodel_fenicsx.studies.page import Answer
from remodel_fenicsx.system.children import Worker, cores, wait_for_one
from remodel_fenicsx.system.files import check_no_link, make_own_folder, refusal_in_words, write_whole
from remodel_fenicsx.system.interrupts import Interrupted, PAUSE, StopRequest
from remodel_fenicsx.system.terminal import Line
from remodel_fenicsx.unloading import as_unloaded

POLL = 0.1  # seconds
FEWEST_RUNS = 2  # runs, or settings, without which nothing is compared

Found = TypeVar("Found", bound=Answer)


class TooFewRuns(RemodelError):  # noqa: N818 - what is recorded is whole, and the same call goes on
    """Fewer than `FEWEST_RUNS` have reached the end, so that there is no answer yet."""

    def __init__(self, reached: str, failed: Mapping[str, str], advice: str = "the same command goes on"):
        super().__init__(f"{reached}, at least {FEWEST_RUNS} are needed; all that is recorded is kept, {advice}")
        self.failed, self.exit_code = dict(failed), SOLVE_FAILED if failed else PAUSED


# ---------------------------------------------------------------- one of the runs
@dataclass(frozen=True)
class Run:
    """One of several runs."""

    name: str
    scene: Scene
    folder: Path

    def beside(self, ending: str) -> Path:
        """A file beside its folder, of the same name: names have dots of their own (`step-0.5`)."""
        return self.folder.with_name(f"{self.folder.name}{ending}")

    def is_complete(self) -> bool:
        """Whether this very scene is recorded to its end."""
        if not all((self.folder / name).exists() for name in (SCENE, HISTORY)):
            return False
        recording = RecordedRun(self.folder)
        if not _same(recording, self.scene):
            raise SceneError(f"{self.folder}: holds a run of another scene; choose another folder with -o")
        try:
            history = recording.history
        except RecordingError:  # a last row that is not whole is done again
            return False
        times = history["time"]
        if not len(times) or not same_time(float(times[-1]), self.scene.last_time):
            return False
        if not {column.name for column in self.scene.columns()} <= set(history) or (np.diff(times) <= 0).any():
            raise RecordingError(f"{self.folder}: its history has other columns or rows than its scene asks for")
        return True

    def history(self) -> HistoryColumns:
        """What it has recorded."""
        return read_history(self.folder)

    def begin(self, worker: Worker) -> None:
        """Begin it, or go on with what is there of it."""
        make_own_folder(self.folder.parent)
        check_no_link(self.folder)
        scene, words = self.beside(".toml"), ["--resume", str(self.folder)]
        if not (self.folder / SCENE).exists():
            write_whole(scene, self.scene.to_toml().encode())
            words = [str(scene), "-o", str(self.folder)]
        worker.begin(["run", *words, "-q", "--no-report"], self.beside(".txt"))


def _same(recording: RecordedRun, wanted: Scene) -> bool:
    """Whether it is of this scene: with the kinematics that "auto" took, its files by SHA-256 wherever they are."""
    if recording.scene == wanted:
        return True
    try:
        kept, _ = with_files_kept(recording.scene)
    except (SceneError, OSError) as error:
        words = refusal_in_words(error) if isinstance(error, OSError) else error
        raise RecordingError(f"{recording.path}: {words}") from error
    with as_unloaded(wanted, MPI.COMM_SELF) as found:
        return kept == with_files_kept(with_choices(found))[0]


# ---------------------------------------------------------------- all of them
class Study:
    """Runs in one folder, and the processes that do them, until it is closed."""

    # A process does one run after the other, for most of a short run is its start. It ends with the command.

    def __init__(
        self,
        name: str,
        scene: Scene,
        folder: Path | str | None,
        scenes: Mapping[str, Scene],
        jobs: int | None = None,
        quiet: bool = True,
    ):
        self.name, self.scene, self.jobs, self.quiet = name, scene, jobs or cores(), quiet
        self.folder = Path(folder or Path("results") / f"{scene.name}-{name}")
        self.runs: list[Any] = [Run(run, changed, self.folder / run) for run, changed in scenes.items()]
        self.failed: dict[str, str] = {}
        self.deadline = math.inf
        self._waiting: list[Run] = []
        self._running: dict[Worker, Run] = {}
        self._idle: list[Worker] = []

    def close(self) -> None:
        """End the processes."""
        for worker in [*self._running, *self._idle]:
            worker.stop()

    def answered(self, answer: Callable[[], Found]) -> tuple[Path, Found]:
        """The folder, and what the runs say once they are done, which is written there."""
        with RunLock(self.folder), closing(self):
            self.do()
            found = answer()
            found.write(self.folder)
        return self.folder, found

    def histories(self) -> dict[str, HistoryColumns]:
        """Of all that have not failed, by name."""
        return {run.name: run.history() for run in self.runs if run.name not in self.failed}

    def learn(self) -> None:
        """Do what is to be done whenever a run has ended."""

    def do(self) -> None:
        """Run what is not complete; `failed` then has the last words of those that have failed, or are damaged."""
        self._waiting = [run for run in self.runs if self._is_left(run)]
        self.learn()
        pausing = False
        with StopRequest() as stop, Line(f"{self.scene.name} {self.name}", self.quiet) as line:
            while (self._waiting or self._running) and clock.monotonic() < self.deadline:
                if stop.number:
                    raise Interrupted(stop.number)
                if stop.pause and not pausing:
                    pausing = True
                    self._waiting.clear()
                    for worker in self._running:  # each run ends with the step under way
                        worker.process.send_signal(PAUSE)
                self._begin()
                self._collect(pausing)
                line.show(self._progress())
        if pausing:
            raise Interrupted(PAUSE)

    def _is_left(self, run: Run) -> bool:
        """Whether it is to be run. One whose folder is damaged is not: nothing of the user's is removed."""
        try:
            return not run.is_complete()
        except RecordingError as error:
            self.failed[run.name] = str(error)
            return False

    def _begin(self) -> None:
        """Begin runs until there are as many as jobs."""
        for run in list(self._waiting):
            if len(self._running) >= self.jobs:
                return
            # by another command, or one that was killed and is ending
            if run.folder.is_dir() and writer(run.folder)[1]:
                continue
            self._waiting.remove(run)
            if self._is_left(run):
                worker = self._idle.pop() if self._idle else Worker()
                self._running[worker] = run
                run.begin(worker)

    def _collect(self, pausing: bool) -> None:
        """Note how those have ended that have."""
        wait_for_one(self._running, POLL)
        for worker, run in list(self._running.items()):
            code = worker.poll()
            if code is None:
                continue
            del self._running[worker]
            if code != 0 and not (pausing and code in (PAUSED, -PAUSE)):  # the latter before Python minds the signal
                self.failed[run.name] = worker.last_words()
            if worker.is_alive:
                self._idle.append(worker)
            self.learn()

    def _progress(self) -> str:
        """How many runs are behind, and which are under way."""
        done = len(self.runs) - len(self._waiting) - len(self._running)
        under_way = ", ".join(run.name for run in self._running.values())
        return f"{done} of {len(self.runs)} runs done{f'; under way: {under_way}' if under_way else ''}"
