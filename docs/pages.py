"""What all scripts that make pages share: tables in Markdown, texts between marks, templates, what made them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from remodel_fenicsx.system.environment import versions

DOCS = Path(__file__).resolve().parent
FIGURES = DOCS / "figures"


def lines(rows: Iterable[Sequence[str]]) -> str:
    """Rows of a table, whose head is in a template."""
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def markdown(head: Iterable[str], rows: Iterable[Sequence[str]]) -> str:
    """A table; cells may hold several, parted by bars."""
    first = lines([list(head)])
    return "\n".join([first, "|" + " --- |" * (first.count("|") - 1), *([found] if (found := lines(rows)) else [])])


def between_marks(text: str, name: str, made: str) -> str:
    """A page with another text between the two comments of this name."""
    start, end = f"<!-- {name}: ./with-fenicsx docs/make ", f"<!-- end of {name} -->"
    before, rest = text.split(start)
    command, rest = rest.split("\n", 1)
    return f"{before}{start}{command}\n\n{made.strip()}\n\n{end}{rest.split(end)[1]}"


def filled(template: Path, words: Mapping[str, str]) -> str:
    """A template with its {{names}} replaced."""
    text = template.read_text(encoding="utf-8")
    for name, value in words.items():
        text = text.replace("{{" + name + "}}", value)
    return text


def made_with() -> str:
    """Versions of what counts."""
    return ", ".join(f"{name} {version}" for name, version in versions().items() if name != "BLAS")


def by_column(rows: Iterable[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Rows as columns; says each row as it comes."""
    found: dict[str, list[Any]] = {}
    for row in rows:
        print(row, flush=True)
        for name, value in row.items():
            found.setdefault(name, []).append(value)
    return found
