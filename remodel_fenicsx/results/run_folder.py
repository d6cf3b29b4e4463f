"""What a run leaves in its folder: history.csv and the scene as run. Only rank 0 writes."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from types import MappingProxyType
from typing import TypeVar, cast

from mpi4py import MPI

from remodel_fenicsx.evolution.stepper import Step, Watcher
from remodel_fenicsx.results.history import History, LastStep, size_of_rows
from remodel_fenicsx.results.recording import CHAIN_LINES, FIELDS, HISTORY, LOG, SCENE, RecordingError
from remodel_fenicsx.results.run_lock import FolderTaken, RunLock, is_vacant
from remodel_fenicsx.results.vtkhdf import check_file
from remodel_fenicsx.system.files import open_own, write_whole

DEEPEST = 100  # folders in folders: Python makes them by a function that calls itself


T = TypeVar("T")


def agreed(comm: MPI.Intracomm, make: Callable[[], T]) -> T:
    """What `make` makes on every rank; what one of them refuses with a ValueError is refused on all. Collective."""
    made = refusal = None
    try:
        made = make()
    except ValueError as error:
        refusal = error
    refusal = next(filter(None, comm.allgather(refusal)), None)
    if refusal is not None:
        raise refusal
    return cast(T, made)


def choose_folder(requested: Path | None, name: str) -> Path:
    """The folder of a run: the one asked for, which must be new or empty, or the first free results/NAME."""
    if requested is not None:
        if len(requested.parts) > DEEPEST:
            raise FolderTaken(f"folder {requested}: lies in more than {DEEPEST} folders")
        if requested.exists() and not requested.is_dir():
            raise FolderTaken(f"folder {requested}: is a file; allowed is a new or an empty folder")
        if requested.is_dir() and not is_vacant(requested):
            raise FolderTaken(f"folder {requested}: is not empty; allowed is a new or an empty folder")
        return requested
    Path("results").mkdir(exist_ok=True)
    for number in itertools.count(1):
        folder = Path("results") / (name if number == 1 else f"{name}-{number}")
        with suppress(FileExistsError):
            folder.mkdir()
            break
    return folder


def chosen_folder(requested: Path | str | None, name: str, comm: MPI.Intracomm) -> Path:
    """The folder for a run's results: what is decided on rank 0 holds on all ranks. Collective.

    Parameters
    ----------
    requested
        A new or empty folder; None: results/NAME, with a number where that is taken.
    name
        Of the run.
    comm
        MPI communicator.

    Returns
    -------
    Path
        The folder; it is not made yet.

    Raises
    ------
    FolderTaken
        If the folder asked for is not empty; on all ranks.
    OSError
        If it cannot be looked at; on rank 0.

    Examples
    --------
    >>> from mpi4py import MPI
    >>> from remodel_fenicsx import parts
    >>> str(parts.chosen_folder(None, "my-cube", MPI.COMM_WORLD))
    'results/my-cube'
    """
    wanted = None if requested is None else Path(requested)
    chosen = agreed(comm, lambda: choose_folder(wanted, name) if comm.rank == 0 else None)
    return cast(Path, comm.bcast(chosen))


@contextmanager
def locked(folder: Path, comm: MPI.Intracomm, new: bool) -> Iterator[None]:
    """Within, this run alone writes in the folder. Collective."""
    lock = agreed(comm, lambda: _lock(folder, comm.size, new) if comm.rank == 0 else nullcontext())
    with lock:
        yield


def _lock(folder: Path, ranks: int, new: bool) -> RunLock:
    if not new and not (folder / SCENE).is_file():
        raise FolderTaken(f"{folder}: is not the folder of a run, it has no {SCENE}")
    lock = RunLock(folder, ranks)
    if new and (folder / SCENE).exists():
        lock.close()
        raise FolderTaken(f"folder {folder}: is not empty; allowed is a new or an empty folder")
    return lock


def check_before_resuming(folder: Path, after: LastStep | None, fields: bool) -> None:
    """Look at all that a run goes on with, before anything is changed."""
    for name in (LOG, HISTORY):
        with suppress(FileNotFoundError):
            os.close(open_own(folder / name, os.O_RDONLY))
    if after is None:
        return
    if not (folder / HISTORY).exists():
        raise RecordingError(f"{folder}: has a checkpoint, but no {HISTORY}: rows that are gone are not computed again")
    size_of_rows(folder / HISTORY, after)
    for name in (FIELDS, CHAIN_LINES) if fields else ():
        if os.path.lexists(folder / name):
            check_file(folder / name)


def forget_steps(folder: Path) -> None:
    """Take away what a run has kept that was killed before its first checkpoint: it starts again."""
    for name in (HISTORY, FIELDS, CHAIN_LINES):
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
        Where a run goes on: the history is cut there.
    files
        Contents of further files by name, which the scene needs.

    Raises
    ------
    FileExistsError
        If a new run finds another one's history.
    OSError
        If the folder cannot be made or written.
    RecordingError
        If the history does not hold the steps that were done; nothing has changed then.

    Examples
    --------
    >>> from remodel_fenicsx import Recording, Simulation, parts, preset_scene
    >>> scene = preset_scene("kuhl-holzapfel-2007", "cube").with_values({"time.end": 2.0})
    >>> simulation = Simulation(scene)
    >>> with parts.RunFolder("rows-alone", scene.to_toml()) as record:
    ...     for step in simulation.steps([record]):
    ...         pass
    >>> Recording("rows-alone").history["time"]
    array([0., 1., 2.])
    """

    def __init__(
        self,
        folder: Path,
        scene_text: str,
        rank: int = 0,
        after: LastStep | None = None,
        files: Mapping[str, bytes] = MappingProxyType({}),
    ):
        self.folder = Path(folder)
        self.history: History | None = None
        self._last_row = -1  # number of its step
        if rank == 0:
            self.folder.mkdir(parents=True, exist_ok=True)
            if after is not None:  # what is refused leaves the scene as it is
                self.history = History(self.folder / HISTORY, after)
            for name, data in files.items():
                write_whole(self.folder / name, data)
            write_whole(self.folder / SCENE, scene_text.encode("utf-8"))
            self.history = self.history or History(self.folder / HISTORY)

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

    def __exit__(self, *error: object) -> None:
        self.close()
