"""What a run leaves in its folder: history.csv and the scene as run. Only rank 0 writes."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

from mpi4py import MPI

from remodel_fenicsx.evolution.stepper import Step, Watcher
from remodel_fenicsx.results.history import History
from remodel_fenicsx.results.recording import CHAINS, FIELDS, HISTORY, LOG, SCENE
from remodel_fenicsx.results.run_lock import FolderTaken, RunLock, is_vacant
from remodel_fenicsx.results.vtkhdf import check_file
from remodel_fenicsx.system.regular_files import open_own, write_whole

DEEPEST = 100  # folders in folders: Python makes them by a function that calls itself


class LastStep(NamedTuple):
    """Where a run goes on."""

    columns: Sequence[str]
    number: int
    time: float


def choose_folder(requested: Path | None, name: str) -> Path:
    """The folder of a run: the one asked for, which must be new or empty, or the first free results/NAME[-2, -3, ...].

    The one asked for is not made yet; a default one is, so that two runs started at once take two.

    Raises
    ------
    FolderTaken
        If the requested folder is not empty or is no folder.
    OSError
        If the default folder cannot be made.
    """
    if requested is not None:
        if len(requested.parts) > DEEPEST:
            raise FolderTaken(f"-o {requested}: lies in more than {DEEPEST} folders")
        if requested.exists() and not requested.is_dir():
            raise FolderTaken(f"-o {requested}: is a file; allowed is a new or an empty folder")
        if requested.is_dir() and not is_vacant(requested):
            raise FolderTaken(f"-o {requested}: is not empty; allowed is a new or an empty folder")
        return requested
    Path("results").mkdir(exist_ok=True)
    number, folder = 1, Path("results") / name
    while True:
        try:
            folder.mkdir()
        except FileExistsError:
            number += 1
            folder = Path("results") / f"{name}-{number}"
        else:
            return folder


def chosen_folder(requested: Path | str | None, name: str, comm: MPI.Intracomm) -> Path:
    """`choose_folder` on rank 0, its folder or its refusal on all ranks. Collective.

    Raises
    ------
    FolderTaken, OSError
        As `choose_folder` does, on all ranks.
    """
    verdict: Path | FolderTaken | OSError | None = None
    if comm.rank == 0:
        try:
            verdict = choose_folder(None if requested is None else Path(requested), name)
        except (FolderTaken, OSError) as refusal:
            verdict = refusal
    verdict = comm.bcast(verdict)
    if isinstance(verdict, Exception):
        raise verdict
    assert verdict is not None
    return verdict


@contextmanager
def locked(folder: Path, comm: MPI.Intracomm, new: bool) -> Iterator[None]:
    """Within, this run alone writes in the folder. Collective.

    Parameters
    ----------
    folder
        The folder of a run; a new one is made.
    comm
        Communicator.
    new
        Whether the run is new to it, or goes on.

    Raises
    ------
    FolderTaken
        If another one writes there, or there is a run where there must be none, or none where there must be one; on
        all ranks.
    OSError
        On rank 0, if the folder cannot be made or written.
    """
    lock = refusal = None
    if comm.rank == 0:
        try:
            if not new and not (folder / SCENE).is_file():
                raise FolderTaken(f"{folder}: is not the folder of a run, it has no {SCENE}")
            lock = RunLock(folder, comm.size)
            if new and (folder / SCENE).exists():
                lock.close()
                raise FolderTaken(f"-o {folder}: is not empty; allowed is a new or an empty folder")
        except FolderTaken as taken:
            refusal = taken
    refusal = comm.bcast(refusal)
    if refusal is not None:
        raise refusal
    try:
        yield
    finally:
        if lock is not None:
            lock.close()


def check_kept(folder: Path, after: LastStep | None, fields: bool) -> None:
    """Look at all that a run goes on with, before anything is changed.

    Parameters
    ----------
    folder
        The run's.
    after
        Where it goes on; None: at the start, with nothing but its log.
    fields
        Whether it goes on with its fields too.

    Raises
    ------
    RecordingError
        If the history does not hold the steps that were done, or a file of fields is damaged or foreign.
    OSError
        If one cannot be read.
    ForeignFileError
        If one is a link or no regular file.
    """
    for name in (LOG, HISTORY):
        with suppress(FileNotFoundError):
            os.close(open_own(folder / name, os.O_RDONLY))
    if after is None:
        return
    History.size_of(folder / HISTORY, after.columns, after.number + 1, after.time)
    for name in (FIELDS, CHAINS) if fields else ():
        if (folder / name).exists():
            check_file(folder / name)


def forget_steps(folder: Path) -> None:
    """Take away what a run has kept that was killed before its first checkpoint: it starts again.

    Raises
    ------
    OSError
        If that cannot be done.
    """
    for name in (HISTORY, FIELDS, CHAINS):
        (folder / name).unlink(missing_ok=True)


class RunFolder(Watcher):
    """A run's folder, open for writing; as a watcher it writes the row of every step.

    Parameters
    ----------
    folder
        Must not hold a run; it is made with its parents.
    scene_text
        The scene as run, written to scene.toml.
    rank
        Rank in the communicator: all but rank 0 write nothing.
    after
        Where a run goes on: columns of its history, number and time of the last step that was done. The history is cut
        there.

    Raises
    ------
    FileExistsError
        If a new run finds another one's history.
    OSError
        If the folder cannot be made or written.
    RecordingError
        If the history does not hold the steps that were done; nothing has changed then.
    """

    def __init__(self, folder: Path, scene_text: str, rank: int = 0, after: LastStep | None = None):
        self.folder = Path(folder)
        self.history: History | None = None
        self._last_row = -1  # number of its step
        if rank == 0:
            self.folder.mkdir(parents=True, exist_ok=True)
            history, scene = self.folder / HISTORY, self.folder / SCENE
            if after is not None:  # what is refused leaves the scene as it is
                self.history = History.continued(history, after.columns, after.number + 1, after.time)
            write_whole(scene, scene_text.encode("utf-8"))
            if after is None:
                self.history = History(history)

    def started(self, step: Step) -> None:
        """Write the row at the start."""
        self.completed(step)

    def completed(self, step: Step) -> None:
        """Write the row of the step; an observer before this watcher has filled it."""
        if self.history is not None:
            self.history.append(step.row)
            self._last_row = step.number

    def undone(self, step: Step) -> None:
        """Take its row back, if it was written."""
        if self.history is not None and self._last_row == step.number:
            self.history.drop_last()
            self._last_row = -1

    def flush(self) -> None:
        """Bring the rows to the disk."""
        if self.history is not None:
            self.history.flush()

    def close(self) -> None:
        """Close the history."""
        if self.history is not None:
            self.history.close()

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
