"""What a run leaves in its folder: history.csv, fields, the scene as run. Only rank 0 writes.

A checkpoint of the state belongs here too, beside `Fields`; it does not exist yet.
"""

from __future__ import annotations

import os
from pathlib import Path
from types import TracebackType

from mpi4py import MPI

from remodel_fenicsx.evolution.stepper import Step, Watcher
from remodel_fenicsx.results.history import History


class FolderTaken(ValueError):
    """The folder asked for holds something already."""


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
        if requested.exists() and not requested.is_dir():
            raise FolderTaken(f"-o {requested}: is a file; allowed is a new or an empty folder")
        if requested.is_dir() and any(requested.iterdir()):
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

    Raises
    ------
    OSError
        If the folder cannot be made or written.
    """

    def __init__(self, folder: Path, scene_text: str, rank: int = 0):
        self.folder = Path(folder)
        self.history: History | None = None
        self._last_row = -1  # number of its step
        if rank == 0:
            self.folder.mkdir(parents=True, exist_ok=True)
            with (self.folder / "scene.toml").open("x", encoding="utf-8") as file:
                file.write(scene_text)
                file.flush()
                os.fsync(file.fileno())
            self.history = History(self.folder / "history.csv")

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
