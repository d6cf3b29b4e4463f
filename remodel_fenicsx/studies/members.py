"""The runs of a study: each in a folder of its own, several at a time, gone on with where they have stopped.

Each of the processes at work does one run after the other: most of a short run would be its start.
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

from remodel_fenicsx.body.columns import columns_of
from remodel_fenicsx.results.recording import (
    HISTORY,
    SCENE,
    STUDY,
    HistoryColumns,
    Recording,
    RecordingError,
    read_history,
    steps_recorded,
)
from remodel_fenicsx.scene.scene import Scene, SceneError
from remodel_fenicsx.schema.times import same_time
from remodel_fenicsx.system.children import Worker, wait_for_one
from remodel_fenicsx.system.interrupts import Interrupted, StopRequest
from remodel_fenicsx.system.regular_files import check_no_link, make_own_folder, write_whole
from remodel_fenicsx.system.terminal import Line

POLL = 0.1  # seconds
LEAST = 2  # runs, or settings, without which nothing is compared


class TooFewRuns(Exception):  # noqa: N818 - what is recorded is whole, and the same call goes on
    """Fewer than `LEAST` have reached the end, so that there is no answer yet.

    Attributes
    ----------
    failed
        Last words of runs that have failed, by name; empty where the study was only stopped early.
    """

    def __init__(self, reached: str, failed: Mapping[str, str], advice: str = "the same command goes on"):
        super().__init__(f"{reached}, at least {LEAST} are needed; all that is recorded is kept, {advice}")
        self.failed = dict(failed)


@dataclass(frozen=True)
class Member:
    """One run of a study.

    Attributes
    ----------
    name
        Of its folder, unique in the study.
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
            return self.scene.time.progress(len(times) - 1, float(times[-1])) if len(times) else 0
        return 0

    def is_complete(self) -> bool:
        """Whether this very scene is recorded to its end.

        Raises
        ------
        SceneError
            If the folder holds another scene, or a history that is not the scene's.
        """
        if not (self.folder / SCENE).exists() or not (self.folder / HISTORY).exists():
            return False
        recording = Recording(self.folder)
        if recording.scene != self.scene:
            raise SceneError(f"{self.folder}: holds a run of another scene; choose another folder with -o")
        with suppress(RecordingError):  # a last row that is not whole is done again
            history = recording.history
            times = history["time"]
            if not len(times) or not same_time(float(times[-1]), self.scene.last_time):
                return False
            if not self._is_of_the_scene(history):
                raise SceneError(f"{self.folder}: its history has other columns or rows than its scene asks for")
            return True
        return False

    def _is_of_the_scene(self, history: HistoryColumns) -> bool:
        """Whether somebody else's history has the columns and the rows of a run that has reached its end."""
        scene, times = self.scene, history["time"]
        names = [column.name for column in columns_of(scene.geometry, scene.output.columns, scene.loads)]
        is_fixed = scene.time.tolerance is None and not scene.time.is_equilibrium
        rows = scene.time.number_of_steps + 1 if is_fixed else len(times)
        return set(names) <= set(history) and len(times) == rows and bool((np.diff(times) > 0).all())

    def history(self) -> HistoryColumns:
        """What it has recorded."""
        return read_history(self.folder)


@dataclass(frozen=True)
class Study:
    """What several runs are for.

    Attributes
    ----------
    name
        Of the command.
    scene
        Name of the user's scene.
    folder
        Where all runs are.
    """

    name: str
    scene: str
    folder: Path

    def write(self, runs: Sequence[str]) -> None:
        """Say in the folder what it is: `remodel-fenicsx status` reads it.

        Raises
        ------
        OSError
            If it cannot be written.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps({"study": self.name, "scene": self.scene, "runs": list(runs)}, indent=1)
        write_whole(self.folder / STUDY, (text + "\n").encode())


def run_members(
    members: Sequence[Member],
    jobs: int,
    study: Study,
    quiet: bool = False,
    deadline: float = math.inf,
    fits: Callable[[Member], bool] = lambda member: True,
    finished: Callable[[], None] = lambda: None,
) -> dict[str, str]:
    """Run what is not complete; returns the last words of those that have failed, by name.

    Parameters
    ----------
    members
        In the order in which they begin.
    jobs, study, quiet
        Runs at a time; what they are runs of; no progress.
    deadline
        `time.monotonic` at which runs are stopped; what they have recorded stays.
    fits
        Asked before a run begins: whether it shall.
    finished
        Called when a run has ended.

    Raises
    ------
    SceneError
        If a folder holds another scene.
    Interrupted
        If a signal asked for the end: what is recorded stays, and the same call goes on from there.
    OSError
        If a folder cannot be written.
    """
    waiting = [member for member in reversed(members) if not member.is_complete()]
    running: dict[Worker, Member] = {}
    idle: list[Worker] = []
    study.write([member.name for member in members])
    total, failed = sum(member.scene.time.number_of_steps for member in members), {}
    line = Line(f"{study.scene} {study.name}")
    with StopRequest() as stop:
        try:
            while waiting or running:
                if stop.number:
                    raise Interrupted(stop.number)
                if clock.monotonic() > deadline:
                    break
                while waiting and len(running) < jobs:
                    member = waiting.pop()
                    if fits(member):
                        worker = idle.pop() if idle else Worker()
                        running[worker] = member
                        _begin(worker, member)
                wait_for_one(running, POLL)
                for worker, member in list(running.items()):
                    code = worker.poll()
                    if code is not None:
                        del running[worker]
                        if code != 0:
                            failed[member.name] = worker.last_words()
                        if worker.is_alive:
                            idle.append(worker)
                        finished()
                if not quiet:
                    done = sum(member.steps_done for member in members)
                    names = ", ".join(member.name for member in running.values())
                    line.show(f"{100 * done // total} % of {len(members)} runs: {names or 'done'}")
        finally:
            for worker in [*running, *idle]:
                worker.stop()
            line.end()
    return failed


def _begin(worker: Worker, member: Member) -> None:
    """Begin, or go on with what is there."""
    make_own_folder(member.folder.parent)
    check_no_link(member.folder)
    messages = member.beside(".txt")
    if (member.folder / SCENE).exists():
        worker.begin(["run", "--resume", str(member.folder), "-q"], messages)
        return
    scene = member.beside(".toml")
    write_whole(scene, member.scene.to_toml().encode())
    worker.begin(["run", str(scene), "-o", str(member.folder), "-q"], messages)
