"""Tables of numbers that somebody else has written: CSV in the dialects of spreadsheets and of ParaView, as data."""

from __future__ import annotations

import codecs
import csv
import logging
import math
from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.errors import RemodelError
from remodel_fenicsx.schema.tables import shown

log = logging.getLogger(__name__)
DELIMITERS = {"\t": "tabs", ";": "semicolons", ",": "commas", " ": "spaces"}


class TableFileError(RemodelError, ValueError):
    """What is wrong with a table; one line."""


def read_columns(
    data: bytes,
    file: str,
    allowed: Iterable[str],
    spellings: Mapping[str, str] | None = None,
    unused: Iterable[str] = (),
) -> dict[str, NDArray[np.float64]]:
    """Columns of numbers by name, (rows,); a line of the log says how they were written."""
    names, rows, written = _cells(data)
    allowed, unused = list(allowed), set(unused)
    known = {name.lower(): name for name in (*allowed, *unused)}
    head = [known.get((spellings or {}).get(name.lower(), name.lower()), "") for name in names]
    if unknown := [name for name, found in zip(names, head, strict=True) if not found]:
        if all(_number(name, ".") is not None for name in names):
            raise TableFileError("begins with a row of numbers; the first row must have the names of the columns")
        raise TableFileError(f"the column {shown(unknown[0])} is not known; allowed are {', '.join(allowed)}")
    if twice := [name for number, name in enumerate(head) if name in head[:number]]:
        raise TableFileError(f"the column {twice[0]} is there twice")
    mark = "," if any("," in cell for row in rows for cell in row) else "."
    values = np.empty((len(rows), len(head)))
    for number, row in enumerate(rows):
        if len(row) != len(head):
            raise TableFileError(f"row {number + 1} has {len(row)} numbers, not {len(head)}")
        for place, cell in enumerate(row):
            if (value := _number(cell, mark)) is None:
                more = " (others have decimal commas)" if mark == "," and "." in cell else ""
                raise TableFileError(f"row {number + 1}, {head[place]}: {shown(cell)} is no number{more}")
            values[number, place] = value
    used = {name: column for name, column in zip(head, values.T, strict=True) if name not in unused}
    words = [f"{written} between columns", *(["decimal commas"] if mark == "," else [])]
    words += [f"not used: {', '.join(left)}"] if (left := [name for name in head if name in unused]) else []
    log.info("%s: %d rows of %s; %s", file, len(rows), ", ".join(used), "; ".join(words))
    return used


def _cells(data: bytes) -> tuple[list[str], list[list[str]], str]:
    """Names, rows of cells as they are written, and what stands between them."""
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = data.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise TableFileError("is no text in UTF-8") from error
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    said = lines.pop(0).strip()[4:] if lines and lines[0].lower().startswith("sep=") else ""
    head = lines[0] if lines else ""
    mark = said or next((one for one in DELIMITERS if one in head.strip()), ",")
    if mark == " " or not mark.isspace():
        lines = [line.strip(" ") for line in lines]
    try:
        table = [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=mark, skipinitialspace=True)]
    except (TypeError, csv.Error) as error:  # a delimiter of several letters
        raise TableFileError(f"cannot be read as a table: {error}") from error
    while table and table[0] and not table[0][-1]:
        table[0].pop()
    width = len(table[0]) if table else 0
    table = [row[:width] if not any(row[width:]) else row for row in table if any(row)]
    if len(table) < 2:
        raise TableFileError("is no table: needed are a row of names and rows of numbers")
    return table[0], table[1:], DELIMITERS.get(mark, repr(mark))


def _number(cell: str, mark: str) -> float | None:
    """A finite number with this decimal mark; None of what is none."""
    if "_" in cell or (mark == "," and "." in cell):  # Python would take 1_0 for 10
        return None
    try:
        value = float(cell.replace(",", "."))
    except ValueError:
        return None
    return value if math.isfinite(value) else None
