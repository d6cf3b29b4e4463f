"""The folder of a run: history.csv (a row for each accepted step) and the scene. Rank 0 writes."""

from __future__ import annotations

import csv
import errno
import io
import math
import os
import time as clock
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from mpi4py import MPI

from remodel_fenicsx.evolution.stepper import Step, Watcher
from remodel_fenicsx.fem.assembly import raise_on_all_ranks
from remodel_fenicsx.results.recording import (
    CHAIN_LINES,
    FIELDS,
    FolderTaken,
    HISTORY,
    LARGEST_HISTORY,
    LOG,
    RecordingError,
    RunLock,
    SCENE,
    is_unused,
)
from remodel_fenicsx.results.vtkhdf import check_series
from remodel_fenicsx.system.files import ClosedAtEnd, numbered, open_own, read_regular, write_whole


def choose_folder(requested: Path | None, name: str) -> Path:
    """Return the requested folder, which must be new or empty, or the first free results/NAME."""
    if requested is not None:
        if requested.exists() and not requested.is_dir():
            raise FolderTaken(f"folder {requested}: is a file; must be a new or an empty folder")
        if requested.is_dir() and not is_unused(requested):
            raise FolderTaken(f"folder {requested}: is not empty; must be new or empty")
        return requested
    Path("results").mkdir(exist_ok=True)
    for folder in numbered(Path("results") / name):
        with suppress(FileExistsError):
            folder.mkdir()
            break
    return folder


def chosen_folder(requested: Path | str | None, name: str, comm: MPI.Intracomm) -> Path:
    """Choose the folder for a run's results on rank 0, for all ranks. Collective.

    Parameters
    ----------
    requested
        A new or empty folder; None: results/NAME, with a number if that is taken.
    name
        Name of the run.
    comm
        MPI communicator.

    Returns
    -------
    Path
        The folder, which is not created yet.

    Raises
    ------
    FolderTaken
        If the requested folder is not empty; on all ranks.
    OSError
        If the folder cannot be read; on rank 0.

    Examples
    --------
    >>> from mpi4py import MPI
    >>> from remodel_fenicsx import parts
    >>> str(parts.chosen_folder(None, "my-cube", MPI.COMM_WORLD))
    'results/my-cube'
    """
    wanted = None if requested is None else Path(requested)
    chosen = raise_on_all_ranks(
        comm, lambda: choose_folder(wanted, name) if comm.rank == 0 else None
    )
    return comm.bcast(chosen)


@contextmanager
def locked(folder: Path, comm: MPI.Intracomm, new: bool) -> Iterator[None]:
    """Lock the folder for this run while the block runs. Collective."""
    lock = raise_on_all_ranks(
        comm, lambda: _lock(folder, comm.size, new) if comm.rank == 0 else nullcontext()
    )
    with lock:
        yield


def _lock(folder: Path, ranks: int, new: bool) -> RunLock:
    if not new and not (folder / SCENE).is_file():
        raise FolderTaken(f"{folder}: is not the folder of a run, it has no {SCENE}")
    lock = RunLock(folder, ranks)
    if new and (folder / SCENE).exists():
        lock.close()
        raise FolderTaken(f"folder {folder}: is not empty; must be new or empty")
    return lock


def check_before_resuming(folder: Path, after: LastStep | None, fields: bool) -> None:
    """Check all files that a resumed run continues, before any change."""
    for name in (LOG, HISTORY):
        with suppress(FileNotFoundError):
            os.close(open_own(folder / name, os.O_RDONLY))
    if after is None:
        return
    if not (folder / HISTORY).exists():
        raise RecordingError(
            f"{folder}: has a checkpoint, but no {HISTORY}: "
            "rows that are gone are not computed again"
        )
    size_of_rows(folder / HISTORY, after)
    for name in (FIELDS, CHAIN_LINES) if fields else ():
        if os.path.lexists(folder / name):
            check_series(folder / name)


def remove_partial_results(folder: Path) -> None:
    """Remove the results of a run that was killed before its first checkpoint: it starts again."""
    for name in (HISTORY, FIELDS, CHAIN_LINES):
        (folder / name).unlink(missing_ok=True)


# ---------------------------------------------------------------- history.csv
# Whole rows only, whatever happens.

FLUSHED_AFTER = 0.5  # seconds: rows that come faster are flushed to the disk together


class LastStep(NamedTuple):
    """Last completed step of a resumed run: columns of its history, number and time."""

    columns: Sequence[str]
    number: int
    time: float


class History:
    """history.csv: one row per accepted step, in the file as soon as the step is accepted."""

    def __init__(self, path: Path, after: LastStep | None = None):
        size = 0 if after is None else size_of_rows(path, after)
        flags = os.O_RDWR | (os.O_CREAT | os.O_EXCL if after is None else 0)
        self._path, self._file = path, open(open_own(path, flags), "r+b", buffering=0)
        self._columns = (
            None if after is None else next(csv.reader([self._file.readline().decode()]))
        )
        # bytes up to the end of the last complete row, and before it of the previous row
        self._sizes = [size]
        self._flushed_at = -math.inf
        self._cut()

    def append(self, row: dict[str, float]) -> None:
        """Write one row; the first one decides the columns."""
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, fieldnames=self._columns or list(row), lineterminator="\n")
        if not self._sizes[-1]:
            writer.writeheader()
        writer.writerow({key: _number(value) for key, value in row.items()})
        self._write(text.getvalue().encode())
        self._columns = list(writer.fieldnames)

    def _write(self, data: bytes) -> None:
        """Write all of the data or none: a truncated number would read as another number."""
        view = memoryview(data)
        try:
            while view:
                view = view[self._file.write(view) :]
            if clock.monotonic() - self._flushed_at >= FLUSHED_AFTER:
                self.flush()
        except OSError:
            self._cut()
            raise
        self._sizes = [self._sizes[-1], self._sizes[-1] + len(data)]

    def flush(self) -> None:
        """Flush all rows to the disk."""
        os.fsync(self._file.fileno())
        if os.fstat(self._file.fileno()).st_nlink == 0:
            lost = "the rows of this run, and what else was in its folder"
            raise FileNotFoundError(
                errno.ENOENT, f"the file was deleted during the run; lost: {lost}", self._path
            )
        self._flushed_at = clock.monotonic()

    def drop_last(self) -> None:
        """Remove the last row; only once after each row."""
        self._sizes.pop()
        self._cut()

    def _cut(self) -> None:
        self._file.truncate(self._sizes[-1])
        self._file.seek(self._sizes[-1])

    def close(self) -> None:
        """Flush and close the file, unless it is closed."""
        if not self._file.closed:
            try:
                self.flush()
            finally:
                self._file.close()


def size_of_rows(path: Path, after: LastStep) -> int:
    """Return the bytes of a history's head and of its rows up to a step."""
    rows = after.number + 1
    lines = read_regular(path, LARGEST_HISTORY).splitlines(keepends=True)[: rows + 1]
    try:
        texts = [line.decode("utf-8") for line in lines]
        columns, *read = csv.reader(texts)
        whole = len(read) == rows and texts[-1].endswith("\n")
        right = whole and math.isclose(float(read[-1][columns.index("time")]), after.time)
    except (ValueError, IndexError, csv.Error):
        right = False
    if not right:
        raise RecordingError(
            f"{path}: lacks rows: the checkpoint belongs to {rows} rows up to time {after.time:g}"
        )
    if columns != list(after.columns):
        raise RecordingError(
            f"{path}: has other columns than this run; output.columns must stay as it was"
        )
    return sum(map(len, lines))


def _number(value: float) -> str:
    """Format a number as the shortest text that reads back the same; NaN is empty."""
    if math.isnan(value):
        return ""
    return str(value) if isinstance(value, int) else repr(float(value))


# ---------------------------------------------------------------- the folder


class RunFolder(Watcher, ClosedAtEnd):
    """A run's folder, open for writing; as a watcher it writes the row of every step.

    Parameters
    ----------
    folder
        Folder without a run; it is created with its parents.
    scene_text
        The scene as run, written to scene.toml.
    rank
        Rank in the communicator: all but rank 0 write nothing.
    after
        Last completed step of a resumed run: the history is cut after it.
    files
        Contents of further files that the scene needs, by name.

    Raises
    ------
    FileExistsError
        If the run is new and a history exists.
    OSError
        If the folder cannot be created or written.
    RecordingError
        If the history lacks completed steps; nothing has changed then.

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
            if after is not None:  # a refusal leaves the scene as it is
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
        """Remove the step's row, if it was written."""
        if self.history is not None and self._last_row == step.number:
            self.history.drop_last()
            self._last_row = -1

    def flush(self) -> None:
        """Flush the rows to the disk."""
        if self.history is not None:
            self.history.flush()

    def close(self) -> None:
        """Flush and close the history."""
        if self.history is not None:
            self.history.close()
