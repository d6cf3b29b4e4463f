"""A cache of recorded runs: what is not there, or no longer valid, is run in processes of its own."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
import time as clock
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from remodel_fenicsx.paper.errors import FigureError
from remodel_fenicsx.paper.validity import fault, library_versions, run_key, source_fingerprint
from remodel_fenicsx.results.recording import steps_recorded
from remodel_fenicsx.scene.scene import Scene
from remodel_fenicsx.system.children import Child
from remodel_fenicsx.system.interrupts import StopRequest
from remodel_fenicsx.system.terminal import Line, announce

_WORK = ".part-"  # and letters: a folder of unfinished runs, locked by the command they belong to and by each of them
_POLL = 0.25  # seconds
_COST = {"tendon": 0.2, "cube": 0.01}  # of a step, beside those of other shapes


@dataclass
class RunCache:
    """Recorded runs in a folder, each in NAME-KEY: a run whose scene, source or libraries have changed has another key.

    Parameters
    ----------
    folder
        Where the runs are; made when the first one is.
    source, libraries
        What the present numbers depend on beside the scene.
    """

    folder: Path
    source: str = field(default_factory=source_fingerprint)
    libraries: Mapping[str, str] = field(default_factory=library_versions)

    def path(self, scene: Scene) -> Path:
        """Folder of a scene's run, whether it exists or not."""
        return self.folder / f"{scene.name}-{run_key(scene, self.source, self.libraries)}"

    def is_valid(self, scene: Scene) -> bool:
        """Whether a whole run of this very scene with the present source and libraries is recorded."""
        return fault(self.path(scene), scene) is None

    def obtain(self, wanted: Iterable[Scene], jobs: int) -> dict[str, Path]:
        """Folders by name of scene; what is not valid is run first, so many at a time.

        Raises
        ------
        FigureError
            If a run fails (with its exit code) or the command is stopped (130, 143). Finished runs stay.
        OSError
            If the folder cannot be written.
        """
        wanted = list(wanted)
        missing = []
        for scene in wanted:
            reason = fault(self.path(scene), scene)
            if reason is not None:
                missing.append(scene)
                if self.path(scene).exists():
                    announce(f"figures: run again: {self.path(scene)}: {reason}")
        if missing:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._run(missing, jobs)
        return {scene.name: self.path(scene) for scene in wanted}

    def _run(self, missing: Sequence[Scene], jobs: int) -> None:
        """Run scenes, the longest first."""
        waiting = sorted(missing, key=lambda scene: _COST.get(scene.geometry.name, 1.0) * scene.time.number_of_steps)
        running: list[_Run] = []
        finished, total = 0, sum(scene.time.number_of_steps for scene in missing)
        progress = Line("figures")
        with StopRequest() as stop, _work_folder(self.folder) as (work, lock):
            try:
                while waiting or running:
                    if stop.number:
                        raise FigureError("stopped; finished runs are kept", 128 + stop.number)
                    while waiting and len(running) < jobs:
                        running.append(_Run(waiting.pop(), work, lock))
                    for run in [run for run in running if run.child.process.poll() is not None]:
                        running.remove(run)
                        self._keep(run)
                        finished += run.scene.time.number_of_steps
                    done = 100 * (finished + sum(run.steps_done() for run in running)) // total
                    parts = [f"{run.scene.name} {run.steps_done()}/{run.scene.time.number_of_steps}" for run in running]
                    more = f", {len(waiting)} more to start" if waiting else ""
                    progress.show(f"{done} % of the runs: {', '.join(parts)}{more}")
                    clock.sleep(_POLL)
            finally:
                for run in running:
                    run.child.stop()
                progress.end()

    def _keep(self, run: _Run) -> None:
        """Give the folder of a run that has ended its name, or say why there is none."""
        code, name, target = run.child.process.returncode, run.scene.name, self.path(run.scene)
        if code != 0:
            message = f"the run {name} in {run.folder}: {run.child.last_words()}"
            raise _RunFailed(message, code if code > 0 else 128 - code)
        if source_fingerprint() != self.source:
            raise FigureError(f"the package's source changed during the run {name}: start again", 1)
        try:
            run.folder.rename(target)
        except OSError:
            if not target.is_dir():
                raise
            # the same run by another process in the meantime, or what is left of one that is not whole
            shutil.rmtree(target)
            run.folder.rename(target)


class _RunFailed(FigureError):
    """What the run has left may say why."""


class _Run:
    """One scene in one process."""

    def __init__(self, scene: Scene, work: Path, lock: int):
        self.scene, self.folder = scene, work / scene.name
        scene_file = work / f"{scene.name}.toml"
        scene_file.write_text(scene.to_toml(), encoding="utf-8")
        arguments = ["run", str(scene_file), "-o", str(self.folder), "-q"]
        self.child = Child(arguments, work / f"{scene.name}.txt", [lock])

    def steps_done(self) -> int:
        return min(steps_recorded(self.folder), self.scene.time.number_of_steps)


# ---------------------------------------------------------------- unfinished runs


@contextmanager
def _work_folder(folder: Path) -> Iterator[tuple[Path, int]]:
    """A new folder for unfinished runs, and its lock, which each run shares; what a run that failed left stays."""
    with _lock(folder):
        work = Path(tempfile.mkdtemp(prefix=_WORK, dir=folder))
        lock = os.open(work, os.O_RDONLY)
        fcntl.flock(lock, fcntl.LOCK_EX)
    try:
        _remove_litter(folder)
        yield work, lock
    except _RunFailed:
        raise  # until the next command
    except BaseException:
        shutil.rmtree(work)
        raise
    else:
        shutil.rmtree(work)
    finally:
        os.close(lock)


def _remove_litter(folder: Path) -> None:
    """Remove what failed runs and killed commands have left: unfinished runs whose folder nobody locks any more."""
    with _lock(folder):
        for work in folder.glob(f"{_WORK}*/"):
            try:
                with _lock(work, fcntl.LOCK_NB):
                    shutil.rmtree(work)
            except BlockingIOError:  # runs under way
                continue


@contextmanager
def _lock(folder: Path, how: int = 0) -> Iterator[None]:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | how)
        yield
    finally:
        os.close(descriptor)
