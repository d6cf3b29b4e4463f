"""history.csv: one row per accepted step and one at t = 0; whole rows only, whatever happens."""

from __future__ import annotations

import csv
import io
import math
import os
from pathlib import Path


class History:
    """history.csv: one row per accepted step, complete on disk as soon as the step is accepted."""

    def __init__(self, path: Path):
        self._file = path.open("xb", buffering=0)
        self._columns: list[str] | None = None
        self._sizes = [0]  # bytes up to the end of each whole row

    def append(self, row: dict[str, float]) -> None:
        """Write one row; the first one decides the columns.

        Raises
        ------
        OSError
            If the row could not be written (disk full); the file then ends with the row before.
        ValueError
            If the row has other columns than the first one.
        """
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
            os.fsync(self._file.fileno())
        except OSError:
            self._cut()
            raise
        self._sizes = [self._sizes[-1], self._sizes[-1] + len(data)]

    def drop_last(self) -> None:
        """Take the last row back; only once after each row."""
        self._sizes.pop()
        self._cut()

    def _cut(self) -> None:
        self._file.truncate(self._sizes[-1])
        self._file.seek(self._sizes[-1])

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _number(value: float) -> str:
    """Shortest text that reads back as the same number; none for what was not computed."""
    if math.isnan(value):
        return ""
    return str(value) if isinstance(value, int) else repr(float(value))
