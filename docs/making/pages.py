"""What all scripts that make pages share: tables in Markdown, texts between marks, templates, runs, pictures."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from remodel_fenicsx.studies.study import DOTS_PER_INCH, STYLE, Page, made_with
from remodel_fenicsx.system.children import cores

DOCS = Path(__file__).resolve().parents[1]
FIGURES = DOCS / "figures"
EDGES = np.linspace(1.0, 3.0, 9)  # of the eight layers of elements in the paper's artery
Columns = dict[str, np.ndarray]


# ---------------------------------------------------------------- texts
def lines(rows: Iterable[Sequence[str]]) -> str:
    """Rows of a table, whose head is in a template."""
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def markdown(head: Iterable[str], rows: Iterable[Sequence[str]]) -> str:
    """A table; cells may hold several, parted by bars."""
    first = lines([list(head)])
    found = lines(rows)
    return "\n".join([first, "|" + " --- |" * (first.count("|") - 1), *([found] if found else [])])


def shown(rows: Iterable[Sequence[str]]) -> Iterator[Sequence[str]]:
    """Print each row of a table as it comes."""
    for row in rows:
        print(" | ".join(row), flush=True)
        yield row


def between_marks(text: str, name: str, made: str) -> str:
    """A page with another text between the two comments of this name."""
    start, end = f"<!-- {name}: ./with-fenicsx ", f"\n<!-- end of {name} -->"
    before, rest = text.split(start)
    command, rest = rest.split("\n", 1)
    return f"{before}{start}{command}\n\n{made.strip()}\n{end}{rest.split(end)[1]}"


def filled(template: Path, words: Mapping[str, str]) -> str:
    """A template with its {{names}} replaced."""
    text = template.read_text(encoding="utf-8")
    for name, value in words.items():
        text = text.replace("{{" + name + "}}", value)
    return text


# ---------------------------------------------------------------- tables
def by_column(rows: Iterable[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Rows as columns; says each row as it comes."""
    found: dict[str, list[Any]] = {}
    for row in rows:
        print(row, flush=True)
        for name, value in row.items():
            found.setdefault(name, []).append(value)
    return found


def side_by_side(function: Callable[[Any], Any], cases: Iterable[Any]) -> list[Any]:
    """What a function makes of each case, in processes of their own, one for each core."""
    os.environ["OMP_NUM_THREADS"] = "1"  # of these processes
    with ProcessPoolExecutor(cores(), get_context("spawn")) as pool:
        return list(pool.map(function, cases))


def read_table(path: Path) -> dict[str, np.ndarray]:
    """Columns of a table that `Page.save_table` wrote: numbers, or text where one of them is none."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(line for line in file if not line.startswith("#")))
    return {
        name: _as_numbers([row[index] for row in rows[1:]]) for index, name in enumerate(rows[0])
    }


def _as_numbers(values: list[str]) -> np.ndarray:
    try:
        return np.array(values, dtype=float)
    except ValueError:
        return np.array(values)


def rows_of(path: Path) -> list[dict[str, Any]]:
    """Rows of a table, numbers where they are."""
    columns = read_table(path)
    return [
        dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)
    ]


# ---------------------------------------------------------------- pictures
def drawn(
    page: Page, draw: Callable[..., Figure], *tables: Any, made: str = "", **style: Any
) -> None:
    """Save what a function draws of tables."""
    with rc_context(STYLE | style):
        page.save_figure(draw(*tables), made or made_with())
    path = page.folder / f"{page.name}.png"
    save_small(path, path)


def save_small(source: Path, path: Path) -> None:
    """Copy a picture; 256 colours are enough, and a third of the bytes."""
    with Image.open(source) as picture:
        about = PngInfo()
        for key, value in picture.info.items():
            if isinstance(value, str):
                about.add_text(key, value)
        dots = picture.info.get("dpi", (DOTS_PER_INCH, DOTS_PER_INCH))
        small = picture.convert("RGB").quantize(
            256, Image.Quantize.MAXCOVERAGE, 2, dither=Image.Dither.NONE
        )
    small.save(path, pnginfo=about, optimize=True, dpi=dots)


def panel_letters(*axes_of_panels: Axes) -> None:
    """Letter the panels of a figure a, b, c, ...: bold, on the line of the titles, left of the axes."""
    for letter, axes in zip("abcdefgh", axes_of_panels, strict=False):
        axes.annotate(
            letter,
            (0, 1),
            (-28.0, STYLE["axes.titlepad"]),
            "axes fraction",
            "offset points",
            fontsize=10,
            fontweight="bold",
        )
