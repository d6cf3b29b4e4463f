"""Cards of the report's page: sections, tables, and arrays packed as text."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray


# ---------------------------------------------------------------- arrays as text of a page
# Arrays as text of a page: one block, deflated, in base64; and how numbers become few bytes.

ANGLE_STEPS = 252  # of a byte for 0 to 90 degrees: 14 for each of the 18 colours, so that all agree about these
NO_ANGLE = 255


def packed(arrays: Mapping[str, Array]) -> tuple[str, dict[str, dict[str, Any]]]:
    """The block, and what tells the page where each array is in it."""
    parts, table, start = [], {}, 0
    for name, array in arrays.items():
        values = np.ascontiguousarray(array.values)
        stored = values
        if array.differences and len(values) > 1:
            stored = values.copy()
            stored[1:] -= values[:-1]  # modulo the range of the type
        data = stored.astype(values.dtype.newbyteorder("<")).tobytes()
        start += -start % 4  # typed arrays begin at multiples of their size
        parts.append((start, data))
        table[name] = {
            "type": values.dtype.name, "shape": list(values.shape), "start": start, "differences": array.differences
        }  # fmt: skip
        start += len(data)
    block = bytearray(start)
    for place, data in parts:
        block[place : place + len(data)] = data
    deflate = zlib.compressobj(
        3, zlib.DEFLATED, 31
    )  # 31: with the head of gzip; 6 is 5 % smaller and takes as long again
    return base64.b64encode(deflate.compress(bytes(block)) + deflate.flush()).decode("ascii"), table


def of_angles(degrees: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Angles from 0 to 90 degrees in `ANGLE_STEPS` levels; `NO_ANGLE` where there is none."""
    steps = np.clip(np.floor(degrees * ANGLE_STEPS / 90.0), 0, ANGLE_STEPS - 1)
    return np.where(np.isnan(degrees), NO_ANGLE, steps).astype(np.uint8)


def of_places(places: NDArray[np.float32]) -> tuple[NDArray[np.uint16], list[float], float]:
    """Coordinates (..., 3) as steps from the least of each, with these three and the length of a step."""
    flat = places.reshape(-1, 3)
    least = flat.min(axis=0)
    step = float((flat.max(axis=0) - least).max() / 65535) or 1.0
    return np.rint((places - least) / step).astype(np.uint16), [float(value) for value in least], step


def of_vectors(vectors: NDArray[np.float32]) -> tuple[NDArray[np.int8], float]:
    """Components as 127ths of the largest, and the length of a step."""
    step = float(np.abs(vectors).max()) / 127 or 1.0
    return np.rint(vectors / step).astype(np.int8), step


# ---------------------------------------------------------------- a part of the page, and its HTML
# A part of the page, and its HTML: all text of others goes through `escape`.


@dataclass(frozen=True)
class Array:
    """Numbers that the page unpacks into a typed array."""

    values: NDArray[Any]
    differences: bool = False


@dataclass(frozen=True)
class Card:
    """A part of the page."""

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
