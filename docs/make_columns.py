#!/usr/bin/env python3
"""Prints the table of columns in docs/commands.md: ``./with-fenicsx python3 docs/make_columns.py``."""

from __future__ import annotations

from collections.abc import Iterator

from remodel_fenicsx.body import SHAPES
from remodel_fenicsx.body.shape import COLUMNS_ON_REQUEST, Column, columns_of


def table() -> str:
    """A Markdown table: the name of every column, the shapes that have it, unit and meaning."""
    return "| column | of | unit | meaning |\n|---|---|---|---|\n" + "\n".join(_rows()) + "\n"


def _rows() -> Iterator[str]:
    """Columns of all shapes before those of some; the same one of several shapes on one row."""
    shapes: dict[tuple[str, str, str], list[str]] = {}
    for shape, kind in SHAPES.items():
        for column in columns_of(kind, loads=(), regions=["NAME"] if kind.has_regions else []):
            shapes.setdefault(_key(column), []).append(shape)
    for (name, unit, meaning), having in sorted(shapes.items(), key=lambda item: len(item[1]) != len(SHAPES)):
        of = "all" if len(having) == len(SHAPES) else ", ".join(having)
        yield f"| `{name}` | {of} | {unit} | {meaning} |"
    asked: dict[tuple[str, str, str], list[str]] = {}
    for shape, kind in SHAPES.items():
        of_loads = (load.make_column(name) for name, load in kind.loads.items() if load.frees_length)
        for column in (*of_loads, *kind.columns_on_request):
            asked.setdefault(_key(column), []).append(shape)
    for (name, unit, meaning), having in asked.items():
        yield f"| `{name}` | {', '.join(having)}, on request | {unit} | {meaning} |"
    for column in COLUMNS_ON_REQUEST.values():
        yield f"| `{column.name}` | on request | {column.unit} | {column.meaning} |"


def _key(column: Column) -> tuple[str, str, str]:
    return column.name, column.unit, column.meaning


if __name__ == "__main__":
    print(table(), end="")
