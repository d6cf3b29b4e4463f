"""Tables of cases beside the tests that read them: a line for each, its columns parted by bars."""

from __future__ import annotations

import csv
import tomllib
from pathlib import Path
from typing import Any

HUGE = "1" + 400 * "0"  # no float can hold it


def rows(test: str, name: str) -> list[list[str]]:
    """Lines of a file in the folder of a test, given as its `__file__`; those that begin with # say what is meant."""
    lines = Path(test).with_name(name).read_text(encoding="utf-8").splitlines()
    return [
        [column.strip() for column in line.split(" | ")]
        for line in lines
        if not line.startswith("#")
    ]


def of_csv(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file."""
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))


def values(text: str) -> dict[str, Any]:
    """Keys and values of TOML on one line; dotted keys in quotes."""
    return dict(tomllib.loads(f"row = {{{text.replace('HUGE', HUGE)}}}")["row"])


def unescaped(text: str) -> str:
    """With the line ends and other characters that a line of a table can only name."""
    return text.encode("latin-1").decode("unicode_escape")
