"""Readers of recorded runs, which need h5py and numpy but no dolfinx."""

from __future__ import annotations

import math
import csv
import fcntl
import os
import re
import socket
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from functools import cached_property
from itertools import takewhile
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np

from remodel_fenicsx.errors import RemodelError
from remodel_fenicsx.model.tensors import Array, Integers
from remodel_fenicsx.system.environment import check_extensions
from remodel_fenicsx.system.files import (
    LOCK,
    SCENE,
    ClosedAtEnd,
    check_regular,
    lock_holder,
    open_own,
    partial_path,
    read_regular,
)

if TYPE_CHECKING:
    import h5py
    import pandas

    from remodel_fenicsx.scene.scene import Scene


# ---------------------------------------------------------------- style of pictures of bodies
# Style of figures and reports: colours of angles and dimensions of drawn chains.

# matplotlib's RdYlBu in 18 equal steps of 5 degrees, so that a colour can be read off the scale:
# red along the first direction (0 degrees), blue across it (90)
ANGLE_COLOURS = tuple(
    "#a50026 #c21c27 #dc3b2c #ed5f3c #f7844e #fcaa5f #fec87a #fee496 #fff6b1 #f6fbd0 "
    "#e4f4f1 #c7e7f1 #a8d6e8 #87bdd9 #69a0ca #4d7fb9 #3d5ba7 #313695".split()
)
CHAIN_LOOK: dict[str, Any] = {  # as the page takes it
    "colour": (0.08, 0.08, 0.10),
    "reach": 0.39,  # half a chain's length over the shorter side of its face, both undeformed
    "room": 0.78,  # maximum length of a chain, over the distance from its face's middle to its edge
    "width": 0.06,  # over the shorter side
    "lift": 0.2,  # towards the eye, over the shorter side: faces need not be plane
}
# fraction of a colour that does not depend on the normal of its face: a colour must mean the same
# everywhere
AMBIENT = 0.8
# position of the eye, from the middle of the body
VIEWS = {"front": (0.3, -1.0, 0.42), "above": (0.0, -0.02, 1.0)}


# ---------------------------------------------------------------- times to show


def kept_times(times: Array, most: int) -> Array:
    """Select at most `most` recorded times, evenly spaced, with the first and the last."""
    return times[np.unique(np.linspace(0, len(times) - 1, most).round().astype(int))]


HISTORY = "history.csv"
FIELDS, CHAIN_LINES = "fields.vtkhdf", "fields_chains.vtkhdf"
LOG = "run.log"
# bytes: the million steps that a scene may have, of a thousand characters each
LARGEST_HISTORY = 10**9


class RecordingError(RemodelError, ValueError):
    """A folder is no recorded run, is corrupt, or lacks requested data; the message has one line.

    Examples
    --------
    >>> from remodel_fenicsx import Recording
    >>> Recording("no-such-folder")
    Traceback (most recent call last):
        ...
    remodel_fenicsx.results.recording.RecordingError: no-such-folder: there is no such folder
    """


class HistoryColumns(dict[str, Array]):
    """The columns of a history by name, each (rows,); a value that was not computed is NaN."""

    def frame(self) -> pandas.DataFrame:
        """The columns as a pandas DataFrame, one row per recorded step."""
        try:
            import pandas
        except ImportError as error:
            raise ImportError(
                "history.frame() needs pandas, which is not installed; the columns need not"
            ) from error
        return pandas.DataFrame(dict(self))


class RecordedRun:
    """The folder of a run, finished or under way.

    Data are read on first access and cached: create a new object to read later rows.

    Parameters
    ----------
    folder
        Folder of a run, as for `remodel-fenicsx run -o`.

    Attributes
    ----------
    path : Path
        The folder.

    Raises
    ------
    RecordingError
        If the folder is not that of a run.
    """

    def __init__(self, folder: str | os.PathLike[str]):
        self.path = Path(folder)
        if not self.path.is_dir():
            raise RecordingError(
                f"{self.path}: {'is a file' if self.path.exists() else 'there is no such folder'}"
            )
        for name in (SCENE, HISTORY):
            if not (self.path / name).is_file():
                raise RecordingError(f"{self.path}: is not the folder of a run, it has no {name}")

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.path)!r})"

    # ------------------------------------------------------------ scene
    @cached_property
    def scene(self) -> Scene:
        """The scene as run.

        Raises
        ------
        RecordingError
            If scene.toml is corrupt.
        """
        return scene_as_run(self.path)

    @cached_property
    def versions(self) -> dict[str, str]:
        """Versions of package and libraries, and hashes of extensions, from scene.toml."""
        return versions_as_run(self.path)

    # ------------------------------------------------------------ history
    @cached_property
    def history(self) -> HistoryColumns:
        """Columns of history.csv by name, arrays (rows,); `history.frame()` is a pandas DataFrame.

        Raises
        ------
        RecordingError
            If history.csv is corrupt.
        """
        return read_history(self.path)

    def value(self, column: str, time: float) -> float:
        """A column of the history at a recorded time.

        Raises
        ------
        RecordingError
            If there is no such column, or no row at this time.
        """
        if column not in self.history:
            raise RecordingError(
                f"{self.path}: no column {column!r}; there are {', '.join(self.history)}"
            )
        return float(self.history[column][self._number_of(time, self.history["time"], "row")])

    # ------------------------------------------------------------ fields
    @cached_property
    def times(self) -> Array:
        """Times at which fields are recorded, (n,); none if the run wrote no fields.

        Raises
        ------
        RecordingError
            If fields.vtkhdf is corrupt.
        """
        if not (self.path / FIELDS).exists():
            return np.zeros(0)
        with self._fields_file() as root:
            steps = root["Steps"]
            return _block(steps["Values"], 0, int(steps.attrs["NSteps"]))

    @cached_property
    def points(self) -> Array:
        """Reference coordinates of the nodes, (nodes, 3).

        Raises
        ------
        RecordingError
            If the run wrote no fields, or fields.vtkhdf is corrupt.
        """
        with self._fields_file() as root:
            return _block(root["Points"], 0, int(root["NumberOfPoints"][0]))

    @cached_property
    def elements(self) -> Integers:
        """Numbers of the nodes of each element in VTK's order, (elements, nodes of one).

        Raises
        ------
        RecordingError
            If the run wrote no fields, or fields.vtkhdf is corrupt.
        """
        with self._fields_file() as root:
            count = int(root["NumberOfCells"][0])
            numbers = np.asarray(root["Connectivity"][:], dtype=np.int64).reshape(count, -1)
            if not np.isin(numbers, np.arange(len(root["Points"]))).all():
                raise RecordingError("elements have nodes that are not there")
            return numbers

    def fields(self, time: float, names: Collection[str] | None = None) -> dict[str, Array]:
        """Read the fields at a recorded time by name.

        Fields at nodes are (nodes, ...), means over elements are (elements, ...). `displacement`
        belongs to the nodes; docs/commands.md lists the other fields. Values have 7 digits.

        Parameters
        ----------
        time
            Time as recorded.
        names
            Names of the fields to read; fields that were not recorded are omitted.

        Raises
        ------
        RecordingError
            If no fields are recorded at this time, or fields.vtkhdf is corrupt.
        """
        number = self._number_of(time, self.times, "fields")
        fields: dict[str, Array] = {}
        with self._fields_file() as root:
            for kind, unit in (("PointData", "NumberOfPoints"), ("CellData", "NumberOfCells")):
                for name in (name for name in root[kind] if names is None or name in names):
                    values = root[kind][name]
                    start = int(root["Steps"][f"{kind}Offsets"][name][number])
                    fields[name] = _block(values, start, int(root[unit][0]))
        return fields

    def _number_of(self, time: float, times: Array, what: str) -> int:
        """Return the index of a recorded time."""
        numbers = [number for number, recorded in enumerate(times) if math.isclose(recorded, time)]
        if not numbers:
            raise RecordingError(
                f"{self.path}: no {what} at time {time:g}; recorded are {_in_words(times)}"
            )
        return numbers[0]

    @contextmanager
    def _fields_file(self) -> Iterator[h5py.Group]:
        path = self.path / FIELDS
        if not path.exists():
            raise RecordingError(f"{self.path}: the run recorded no fields, there is no {FIELDS}")
        with series_file(path) as root:
            yield root


@contextmanager
def series_file(path: Path, remedy: str = "") -> Iterator[h5py.Group]:
    """Open a file of fields; HDF5's errors become a `RecordingError`, errors of the disk stay."""
    import h5py  # late: a run without fields needs none

    try:
        check_regular(path)
        with h5py.File(path, "r") as file:
            yield file["VTKHDF"]
    except (KeyError, ValueError, TypeError, IndexError, RuntimeError, OSError) as error:
        # errors of the disk have a number, HDF5's have none
        if isinstance(error, OSError) and error.errno is not None:
            raise
        # h5py's message can have several lines
        words = f"{' '.join(str(error).split())}{remedy}"
        raise RecordingError(f"{path}: is corrupt or of another kind: {words}") from error


def scene_as_run(folder: Path) -> Scene:
    """The scene of a run's folder (this alone imports pydantic)."""
    from remodel_fenicsx.scene.scene import SceneError, read_scene

    path = folder / SCENE
    try:
        return read_scene(path)
    except SceneError as error:  # about the file, or about a key of this one
        check_extensions(versions_as_run(folder), folder)
        raise RecordingError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error


def versions_as_run(folder: Path) -> dict[str, str]:
    """Return the versions at the head of scene.toml in a run's folder, by name."""
    path = folder / SCENE
    text = read_regular(path, LARGEST_HISTORY).decode(errors="replace") if path.is_file() else ""
    lines = takewhile(lambda line: line.startswith("#"), text.splitlines()[1:])
    return dict(line[1:].strip().partition(" ")[::2] for line in lines)


def read_history(folder: str | os.PathLike[str]) -> HistoryColumns:
    """Read the columns of history.csv by name; before the first step, an empty `time`."""
    path = Path(folder) / HISTORY
    try:
        return _columns(read_regular(path, LARGEST_HISTORY).decode())
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, csv.Error) as error:
        raise RecordingError(f"{path}: {error}") from error


def _columns(text: str) -> HistoryColumns:
    """Read the columns of a history's text. Raise ValueError if it is not valid."""
    if not text:
        return HistoryColumns(time=np.zeros(0))
    if not text.endswith("\n"):
        raise ValueError("ends in the middle of a row")
    names, *rows = csv.reader(text.splitlines())
    if "time" not in names:
        raise ValueError("is not the history of a run, it has no column 'time'")
    for number, row in enumerate(rows, start=2):
        if len(row) != len(names):
            raise ValueError(
                f"line {number} has {len(row)} values, but there are {len(names)} columns"
            )
    values = np.array([[float(cell) if cell else np.nan for cell in row] for row in rows]).reshape(
        -1, len(names)
    )
    if np.isinf(values).any() or np.isnan(values[:, names.index("time")]).any():
        raise ValueError("has numbers that are not finite")  # what was not computed is not there
    return HistoryColumns(zip(names, values.T, strict=True))


def _block(dataset: h5py.Dataset, start: int, length: int) -> Array:
    """Rows of a dataset as numbers of double precision; all of them or ValueError."""
    values = np.asarray(dataset[start : start + length], dtype=np.float64)
    if len(values) != length:
        raise ValueError(f"values of {dataset.name} are missing")
    return values


# ---------------------------------------------------------------- labels, numbers and units

WORDS = {
    "max_chain_extension": "largest r/L",
    "max_principal": "largest principal",
    "von_mises": "von Mises",
    "min_jacobian": "smallest J",
    "seconds": "seconds a step",
}


def words(name: str) -> str:
    """Return a column's label for people."""
    known = next((known for known in WORDS if f"{name}_".startswith(f"{known}_")), "")
    return WORDS.get(known, "") + name.removeprefix(known).replace("_", " ")


def number(value: float) -> str:
    """Format a number with three digits, all of them: 3.40 next to 2.45."""
    if value == 0:
        return "0"
    return f"{value:#.3g}".rstrip(".") if 1e-3 <= abs(value) < 1e5 else f"{value:.2e}"


def with_unit(value: float, unit: str) -> str:
    """Format a number with its unit."""
    return number(value) + (unit if unit == "°" else f" {unit}" if unit else "")


FORCES = {
    "MPa mm": "N",
    "kPa mm": "mN",
    "Pa mm": "µN",
    "kPa um": "nN",
    "Pa m": "N",
}  # stress length^2, if it has a name


def unit_of(scene: Scene, dimension: str) -> str:
    """Return the unit of a `Column` by its dimension; empty if the scene does not specify it."""
    names = {
        "stress": scene.material.stress_unit,
        "length": scene.geometry.length_unit,
        "degrees": "°",
    }
    if dimension == "force" and (name := FORCES.get(f"{names['stress']} {names['length']}")):
        return name
    parts = re.split(r"(\w+)", dimension.replace("force", "stress length^2"))
    if not all(names.get(part, part) for part in parts if part):
        return ""
    return "".join(names.get(part) or part for part in parts).replace("^2", "²").replace("^3", "³")


def _in_words(times: Array) -> str:
    """Recorded times: all of a few, the first and the last ones of many."""
    if not len(times):
        return "none"
    shown = [f"{time:g}" for time in times]
    return ", ".join(shown if len(shown) <= 8 else [*shown[:3], "...", *shown[-2:]])


# ---------------------------------------------------------------- who writes in a folder
# One run at a time, and others can see which.


class FolderTaken(RemodelError, ValueError):
    """The requested folder is not empty, or a run writes in it.

    Examples
    --------
    >>> from pathlib import Path
    >>> from mpi4py import MPI
    >>> from remodel_fenicsx import parts
    >>> Path("taken").mkdir()
    >>> written = Path("taken/notes.txt").write_text("mine")
    >>> parts.chosen_folder("taken", "cube", MPI.COMM_WORLD)
    Traceback (most recent call last):
        ...
    remodel_fenicsx.results.recording.FolderTaken: folder taken: is not empty; must be new or empty
    """


class RunLock(ClosedAtEnd):
    """Exclusive right to write in a folder; the system releases the lock of a killed process."""

    def __init__(self, folder: Path, ranks: int = 1):
        self._path = folder / LOCK
        folder.mkdir(parents=True, exist_ok=True)
        while True:
            self._descriptor = open_own(self._path, os.O_RDWR | os.O_CREAT)
            try:
                fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(self._descriptor)
                raise FolderTaken(
                    f"{folder}: {lock_holder(folder)[0] or 'another process'} writes in it"
                ) from None
            if self._path.exists() and os.path.samestat(
                os.fstat(self._descriptor), os.stat(self._path)
            ):
                break
            os.close(self._descriptor)  # the writer before has taken the file away meanwhile
        others = f" ({ranks} ranks)" if ranks > 1 else ""
        os.ftruncate(self._descriptor, 0)
        os.write(
            self._descriptor, f"process {os.getpid()} on {socket.gethostname()}{others}\n".encode()
        )

    def close(self) -> None:
        """Release the lock and remove its file."""
        self._path.unlink(missing_ok=True)
        os.close(self._descriptor)


def is_unused(folder: Path) -> bool:
    """Return whether a folder is empty, except for files of a process killed before its scene."""
    left = {LOCK, partial_path(Path(SCENE)).name}
    return {entry.name for entry in folder.iterdir()} <= left and not lock_holder(folder)[1]
