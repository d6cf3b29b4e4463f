"""history.csv: one row per accepted step and one at t = 0; whole rows only, whatever happens."""

from __future__ import annotations

import csv
import errno
import io
import math
import os
import re
import time as clock
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from remodel_fenicsx.results.recording import LARGEST_HISTORY, RecordingError
from remodel_fenicsx.schema.times import same_time
from remodel_fenicsx.system.files import open_own, read_regular


# ---------------------------------------------------------------- columns of a history, numbers and units as people
# Columns of a history, numbers and units as people read them.

WORDS = {"max_chain_extension": "largest r/L", "min_jacobian": "smallest J", "seconds": "seconds a step"}


def words(name: str) -> str:
    """A column's name."""
    known = next((known for known in WORDS if f"{name}_".startswith(f"{known}_")), "")
    return WORDS.get(known, "") + name.removeprefix(known).replace("_", " ")


def number(value: float) -> str:
    """Three digits, all of them: 3.40 beside 2.45."""
    if value == 0:
        return "0"
    return f"{value:#.3g}".rstrip(".") if 1e-3 <= abs(value) < 1e5 else f"{value:.2e}"


def with_unit(value: float, unit: str) -> str:
    """A number and its unit."""
    return number(value) + (unit if unit == "°" else f" {unit}" if unit else "")


def unit_of(scene: Any, dimension: str) -> str:
    """The unit of a `Column` by what it measures, where the scene says what it is, else nothing."""
    names = {"stress": scene.material.stress_unit, "length": scene.geometry.length_unit, "degrees": "°"}
    parts = re.split(r"(\w+)", dimension.replace("force", "stress length^2"))
    if not all(names.get(part, part) for part in parts if part):
        return ""
    return "".join(names.get(part) or part for part in parts).replace("^2", "²").replace("^3", "³")


FLUSHED_AFTER = 0.5  # seconds: rows that come faster are brought to the disk together


class LastStep(NamedTuple):
    """Where a run goes on: columns of its history, number and time of the last step that was done."""

    columns: Sequence[str]
    number: int
    time: float


class History:
    """history.csv: one row per accepted step, in the file as soon as the step is accepted."""

    def __init__(self, path: Path, after: LastStep | None = None):
        size = 0 if after is None else size_of_rows(path, after)
        flags = os.O_RDWR | (os.O_CREAT | os.O_EXCL if after is None else 0)
        self._path, self._file = path, open(open_own(path, flags), "r+b", buffering=0)
        self._columns = None if after is None else list(after.columns)
        self._sizes = [size]  # bytes up to the end of the last whole row, and before of the one before it
        self._flushed_at, self._is_flushed = -math.inf, True
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
        """All of it or nothing: a number that was cut short would read as another number."""
        view = memoryview(data)
        try:
            while view:
                view = view[self._file.write(view) :]
            self._is_flushed = False
            if clock.monotonic() - self._flushed_at >= FLUSHED_AFTER:
                self.flush()
        except OSError:
            self._cut()
            raise
        self._sizes = [self._sizes[-1], self._sizes[-1] + len(data)]

    def flush(self) -> None:
        """Bring all rows to the disk."""
        if not self._is_flushed:
            os.fsync(self._file.fileno())
            if os.fstat(self._file.fileno()).st_nlink == 0:
                lost = "the rows of this run, and what else was in its folder"
                raise FileNotFoundError(errno.ENOENT, f"the file was deleted during the run; lost: {lost}", self._path)
            self._flushed_at, self._is_flushed = clock.monotonic(), True

    def drop_last(self) -> None:
        """Take the last row back; only once after each row."""
        self._sizes.pop()
        self._cut()

    def _cut(self) -> None:
        self._file.truncate(self._sizes[-1])
        self._file.seek(self._sizes[-1])

    def close(self) -> None:
        """Flush and close the file; more than once does no harm."""
        if not self._file.closed:
            try:
                self.flush()
            finally:
                self._file.close()


def size_of_rows(path: Path, after: LastStep) -> int:
    """Bytes of a history's head and of its rows up to a step."""
    rows = after.number + 1
    lines = read_regular(path, LARGEST_HISTORY).splitlines(keepends=True)[: rows + 1]
    try:
        texts = [line.decode("utf-8") for line in lines]
        found, *read = csv.reader(texts)
        whole = len(read) == rows and texts[-1].endswith("\n")
        right = whole and same_time(float(read[-1][found.index("time")]), after.time)
    except (ValueError, IndexError, csv.Error):
        right = False
    if not right:
        raise RecordingError(f"{path}: lacks rows: the checkpoint belongs to {rows} rows up to time {after.time:g}")
    if found != list(after.columns):
        raise RecordingError(f"{path}: has other columns than this run; output.columns must stay as it was")
    return sum(map(len, lines))


def _number(value: float) -> str:
    """Shortest text that reads back as the same number; none for what was not computed."""
    if math.isnan(value):
        return ""
    return str(value) if isinstance(value, int) else repr(float(value))
