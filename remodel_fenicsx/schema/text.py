"""Text files as data: TOML input and output (scenes, overrides, tables), and columns of numbers.

A leaf that is independent of any scene's keys.
"""

from __future__ import annotations

import codecs
import csv
import functools
import logging
import math
import re
import textwrap
import tomllib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from numpy.typing import NDArray
from pydantic import BaseModel

from remodel_fenicsx.errors import UnreadableFile, printable
from remodel_fenicsx.schema.tables import SceneError, listed, quoted, format_value
from remodel_fenicsx.schema.units import is_quantity
from remodel_fenicsx.system.files import read_regular

log = logging.getLogger(__name__)

COMMENT_WIDTH = 100  # characters in a line of comment
LARGEST = 10**6  # bytes: thirty times a scene with all keys and their comments
MOST_PARTS = 100  # components of a dotted key: tomllib's time grows with the square of the number
_DECIMAL = re.compile(r"(?<![\w.])[+-]?\d[\d_]*\.\d[\d_]*(?:[eE][+-]?\d+)?(?![\w.])")


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file as nested dicts."""
    try:
        text = read_regular(path, LARGEST).decode("utf-8-sig")
    except FileNotFoundError:
        raise SceneError(f"{path}: no such file; a scene is a TOML file") from None
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise SceneError(
            f"{path}: line {line}: not UTF-8 text; a scene is a TOML file in UTF-8"
        ) from None
    except (OSError, ValueError) as error:
        raise SceneError(
            f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}"
        ) from None
    for number, words in enumerate(text.splitlines(), start=1):
        if not words.lstrip().startswith("#") and _DECIMAL.sub("", words).count(".") > MOST_PARTS:
            raise SceneError(
                f"{path}: line {number}: a key of more than {MOST_PARTS} parts; "
                "scene keys have up to 4"
            )
    try:
        values = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        place = re.search(
            r"^(.*) \(at (?:line (\d+), column \d+|(end of document))\)$", str(error), re.DOTALL
        )
        where = f"line {place[2] or len(text.splitlines())}: " if place else ""
        words = text.splitlines()[int(place[2]) - 1] if place and place[2] else ""
        raise SceneError(
            f"{path}: {where}not TOML: {place[1] if place else error}{_marks(words)}"
        ) from None
    if _depth_exceeds(values, MOST_PARTS):
        raise SceneError(f"{path}: more than {MOST_PARTS} nested tables; a scene has up to 4")
    return values


def _marks(text: str) -> str:
    """Return a remark on typographic quotes in a text, which word processors insert, or nothing."""
    match = re.search("[\u2018-\u201f\u00ab\u00bb]", text)
    return f'; {match[0]} is not a quote of TOML: type " instead' if match else ""


def _depth_exceeds(value: object, most: int) -> bool:
    """Return whether tables and lists are nested more than `most` levels deep."""
    if not isinstance(value, (dict, list)):
        return False
    entries = value.values() if isinstance(value, dict) else value
    return most == 0 or any(_depth_exceeds(entry, most - 1) for entry in entries)


def parse_override(text: str) -> tuple[str, object]:
    """Parse "KEY=VALUE"; VALUE is TOML, a bare word or a number with a unit."""
    key, equals, value = (part.strip() for part in text.partition("="))
    if not equals:
        raise SceneError(f"--set {format_value(text)}: must be KEY=VALUE, as in cells.seed=2")
    if len(key.split(".")) > MOST_PARTS:
        raise SceneError(
            f"--set {format_value(text)}: a key of more than {MOST_PARTS} parts; "
            "scene keys have up to 4"
        )
    if not all(key.split(".")):
        raise SceneError(
            f"--set {format_value(text)}: the key must be a dotted path, as in cells.seed=2"
        )
    try:
        parsed = tomllib.loads(f"value = {value}")
    except (ValueError, RecursionError):
        parsed = {}
    if list(parsed) == ["value"]:
        return key, parsed["value"]
    if re.fullmatch(r"[\w.+/:-]+", value) or is_quantity(value):
        return key, value
    raise SceneError(
        f"--set {key} = {format_value(value)}: must be a TOML value or a bare word{_marks(value)}"
    )


def set_nested(values: dict[str, object], key: str, value: object) -> None:
    """Set a value at a dotted key, of a list at its number, and create the tables around it."""
    *parents, name = (part.strip() for part in key.split("."))
    for depth, parent in enumerate(parents):
        table = values.setdefault(parent, {})
        if isinstance(table, (list, tuple)) and name in map(str, range(len(table))):
            values[parent] = [*table[: int(name)], value, *table[int(name) + 1 :]]
            return
        if not isinstance(table, dict):
            place = ".".join(parents[: depth + 1])
            raise SceneError(
                f"{key} = {format_value(value)}: {place} = {format_value(table)} is a value, "
                "not a table"
            )
        values = table
    values[name] = value


def merge_nested(base: Mapping[str, object], over: Mapping[str, object]) -> dict[str, Any]:
    """Merge nested dicts table by table; a list or value of `over` replaces that of `base`."""
    result = dict(base)
    for name, value in over.items():
        below = result.get(name)
        result[name] = (
            merge_nested(below, value)
            if isinstance(below, Mapping) and isinstance(value, Mapping)
            else value
        )
    return result


def toml_text(table: BaseModel, header: str) -> str:
    """Format a table with all its values as TOML, each key under its description as a comment."""
    head = [f"# {printable(line)}" if line.strip() else "" for line in header.splitlines()]
    return "\n".join([*head, *([""] if head else []), *_lines(table), ""])


def _lines(table: BaseModel | Mapping[str, object], place: str = "") -> Iterator[str]:
    """Yield the lines of a table. TOML requires its values before the tables in it."""
    fields = type(table).model_fields if isinstance(table, BaseModel) else {}
    inside: list[tuple[str, Any]] = []
    entries: dict[str, Any] = dict(table)
    for name, value in entries.items():
        if isinstance(value, (BaseModel, dict)):
            inside.append((f"[{place}{quoted(name)}]", value))
        elif isinstance(value, tuple) and value and isinstance(value[0], BaseModel):
            inside += [(f"[[{place}{quoted(name)}]]", entry) for entry in value]
        elif value is not None:
            yield from _wrapped((name in fields and fields[name].description) or "")
            yield f"{quoted(name)} = {tomlkit.item(value).as_string()}"
    for head, value in inside:
        lines = [*_lines(value, head.strip("[]") + ".")]
        if fields and not lines:  # an empty table has no information, but a free name does
            continue
        # A plain table that contains only tables needs no heading of its own.
        if isinstance(value, BaseModel) or lines[:1] != [""]:
            yield from ("", head)
        yield from lines


@functools.cache
def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(
        " ".join(text.split()), COMMENT_WIDTH + 2, initial_indent="# ", subsequent_indent="# "
    )


# ---------------------------------------------------------------- tables of numbers
# CSV in the dialects of spreadsheets and ParaView.
DELIMITERS = {"\t": "tabs", ";": "semicolons", ",": "commas", " ": "spaces"}


def read_columns(
    data: bytes,
    file: str,
    allowed: Iterable[str],
    spellings: Mapping[str, str] | None = None,
    unused: Iterable[str] = (),
    headers: Mapping[str, str] | None = None,
    chosen: Mapping[str, Sequence[object]] | None = None,
    labels: str = "",
) -> dict[str, NDArray[np.float64]]:
    """Read columns of numbers by name, (rows,), and log how they were written.

    Parameters
    ----------
    data, file
        Content and name of the file.
    allowed, unused
        Names of the columns that the caller reads, and of those that it leaves out.
    spellings
        Names by other names of columns, in lower case.
    headers
        Headers of the file by name. Only these columns are read, and lines before the header and a
        row of units are left out.
    chosen
        Values by header, of the rows to read.
    labels
        Name of a column of labels, which are numbered from 1 in their order.
    """
    headers, chosen = headers or {}, chosen or {}
    names, rows, written = _cells(data, headers.values())
    if missing := [name for name in (*headers.values(), *chosen) if name not in names]:
        raise UnreadableFile(
            f"has no column {format_value(missing[0])}; it has {listed(names, missing[0])}"
        )
    allowed, unused = list(allowed), set(unused)
    known = {name.lower(): name for name in (*allowed, *unused)}
    head = [known.get((spellings or {}).get(name.lower(), name.lower()), "") for name in names]
    if headers:
        named = {header: name for name, header in headers.items()}
        head = [named.get(name, "") for name in names]
    elif unknown := [
        name for name, meant in zip(names, head, strict=True) if not meant and name not in chosen
    ]:
        if all(_number(name, ".") is not None for name in names):
            raise UnreadableFile(
                "begins with a row of numbers; the first row must have the names of the columns"
            )
        raise UnreadableFile(
            f"unknown column {format_value(unknown[0])}; allowed: {listed(allowed, unknown[0])}"
        )
    if twice := [name for number, name in enumerate(head) if name and name in head[:number]]:
        raise UnreadableFile(f"duplicate column {twice[0]}")
    for number, row in enumerate(rows):
        if len(row) != len(head):
            raise UnreadableFile(f"row {number + 1} has {len(row)} numbers, not {len(head)}")
    used = [place for place, name in enumerate(head) if name and name not in unused]
    table = np.array(rows)
    mark = "," if any("," in cell for cell in table[:, used].flat) else "."
    if headers and all(_number(cell, mark) is None for cell in table[0, used]):
        table = table[1:]
    for header, values in chosen.items():
        cells = table[:, names.index(header)]
        table = table[[cell in values or _number(cell, mark) in values for cell in cells]]
    if not len(table):
        rule = " and ".join(f"{header!r} in {values}" for header, values in chosen.items())
        raise UnreadableFile(f"has no row of numbers with {rule}")
    columns = {
        head[place]: _numbers(
            [str(cell) for cell in table[:, place]], head[place], mark, head[place] == labels
        )
        for place in used
    }
    words = [f"{written} between columns", *(["decimal commas"] if mark == "," else [])]
    left = [name for name, meant in zip(names, head, strict=True) if meant not in columns]
    words += [f"not used: {', '.join(left)}"] if left else []
    log.info("%s: %d rows of %s; %s", file, len(table), ", ".join(columns), "; ".join(words))
    return columns


def _numbers(cells: list[str], name: str, mark: str, are_labels: bool) -> NDArray[np.float64]:
    """Return a column of numbers, or the numbers of labels in their order."""
    if are_labels:
        order = [*dict.fromkeys(cells)]
        return np.array([1.0 + order.index(cell) for cell in cells])
    values = np.empty(len(cells))
    for number, cell in enumerate(cells):
        if (value := _number(cell, mark)) is None:
            more = " (others have decimal commas)" if mark == "," and "." in cell else ""
            raise UnreadableFile(
                f"row {number + 1}, {name}: {format_value(cell)} is not a number{more}"
            )
        values[number] = value
    return values


def _cells(data: bytes, headers: Collection[str]) -> tuple[list[str], list[list[str]], str]:
    """Return the column names, the rows of cells as written, and the name of the delimiter."""
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = data.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise UnreadableFile("is not text in UTF-8 or UTF-16") from error
    lines = [
        line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")
    ]
    said = lines.pop(0).strip()[4:] if lines and lines[0].lower().startswith("sep=") else ""
    if lines and headers:  # the header is the line that has most of them
        has = [sum(header in line for header in headers) for line in lines]
        lines = lines[has.index(max(has)) :]
    head = lines[0] if lines else ""
    mark = said or next((one for one in DELIMITERS if one in head.strip()), ",")
    if mark == " " or not mark.isspace():
        lines = [line.strip(" ") for line in lines]
    try:
        table = [
            [cell.strip() for cell in row]
            for row in csv.reader(lines, delimiter=mark, skipinitialspace=True)
        ]
    except (TypeError, csv.Error) as error:  # a delimiter of several letters
        raise UnreadableFile(f"cannot be read as a table: {error}") from error
    while table and table[0] and not table[0][-1]:
        table[0].pop()
    width = len(table[0]) if table else 0
    table = [row[:width] if not any(row[width:]) else row for row in table if any(row)]
    if len(table) < 2:
        raise UnreadableFile("is not a table; must have a row of names and rows of numbers")
    return table[0], table[1:], DELIMITERS.get(mark, repr(mark))


def _number(cell: str, mark: str) -> float | None:
    """Parse a finite number with this decimal mark, or return None."""
    if "_" in cell or (mark == "," and "." in cell):  # Python would read 1_0 as 10
        return None
    try:
        value = float(cell.replace(",", "."))
    except ValueError:
        return None
    return value if math.isfinite(value) else None
