"""A part of the page, and its HTML: all text of others goes through `escape`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from html import escape
from typing import Any

from numpy.typing import NDArray


@dataclass(frozen=True)
class Array:
    """Numbers that the page unpacks into a typed array.

    Attributes
    ----------
    values
        Of a type that JavaScript has: (...,).
    differences
        Whether each row along the first axis is stored as its difference to the row before, modulo the type's range.
    """

    values: NDArray[Any]
    differences: bool = False


@dataclass(frozen=True)
class Card:
    """A part of the page.

    Attributes
    ----------
    name
        The script's part of this name, if there is one, is called with data and arrays.
    html
        What stands on the page.
    data
        JSON.
    arrays
        By name.
    """

    name: str
    html: str
    data: Mapping[str, Any] = field(default_factory=dict)
    arrays: Mapping[str, Array] = field(default_factory=dict)


def section(title: str, content: str, width: str = "half", note: str = "") -> str:
    """A card with a heading; `content` is HTML, the others text. Widths: whole, wide, narrow, half, third."""
    more = f' <span class="note">{escape(note)}</span>' if note else ""
    heading = f"<h2>{escape(title)}{more}</h2>" if title else ""
    return f'<section class="card {width}">{heading}{content}</section>'


def folded(title: str, content: str) -> str:
    """The same, closed until somebody opens it."""
    return f'<details class="card half"><summary>{escape(title)}</summary>{content}</details>'


def table(rows: Iterable[tuple[str, str]]) -> str:
    """Names and values."""
    cells = "".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in rows)
    return f"<table>{cells}</table>"
