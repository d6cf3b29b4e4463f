"""What a figure or a study leaves in its folder: a picture and its data.

Each picture says what it was made with; what is to be said of tables stands in a file beside them.
"""

from __future__ import annotations

import csv
import io
import json
import textwrap
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, SupportsFloat

import matplotlib
import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from remodel_fenicsx._version import __version__
from remodel_fenicsx.errors import BAD_INPUT, RemodelError
from remodel_fenicsx.results.recording import unit_of, words
from remodel_fenicsx.scene.scene import Scene
from remodel_fenicsx.system.environment import versions
from remodel_fenicsx.system.files import write_whole

MARK = "remodel_fenicsx figures"  # in every picture, and beside every table: what bears it may be drawn anew
DOTS_PER_INCH = 200
COLOURS = ("#1b4f9c", "#d1495b", "#2a9d6f", "#e09f3e", "#6c4f9c")  # apart in lightness too
STYLE: dict[str, object] = {
    "axes.prop_cycle": matplotlib.rcsetup.cycler(color=COLOURS),
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "axes.titlesize": 9,
    "axes.titlepad": 4.0,
    "axes.labelsize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "grid.color": "0.9",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.6,
    "legend.frameon": False,
    "figure.facecolor": "white",
}


class FigureError(RemodelError, ValueError):
    """No figure for a reason that its one line names; `exit_code` is the command's."""

    def __init__(self, message: str, exit_code: int = BAD_INPUT):
        super().__init__(message)
        self.exit_code = exit_code


class Page:
    """Collects the picture and the tables of one figure, and writes them."""

    def __init__(self, folder: Path, name: str, title: str = "", caption: str = ""):
        self.folder, self.name, self.title, self.caption = folder, name, title, caption

    def save_figure(self, figure: Figure, made_with: str) -> None:
        """Write NAME.png; title, caption and what it was made with stand in the file."""
        about = {"Software": f"{MARK} {__version__}", "Title": self.title, "Description": self.caption,
                 "Source": f"{made_with}; matplotlib {matplotlib.__version__}", "Comment": self.name}  # fmt: skip
        drawn = io.BytesIO()
        figure.savefig(drawn, format="png", dpi=DOTS_PER_INCH, facecolor="white", metadata=about)
        self._write(f"{self.name}.png", drawn.getvalue())

    def save_table(self, columns: Mapping[str, ArrayLike], notes: Sequence[str], part: str = "") -> None:
        """Write NAME.csv or NAME-PART.csv, columns of one length under their names; the notes go into NAME.json."""
        names, values = list(columns), [np.asarray(column) for column in columns.values()]
        text, file = io.StringIO(), f"{self.name}-{part}.csv" if part else f"{self.name}.csv"
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(names)
        for row in zip(*values, strict=True):
            writer.writerow([_cell(value) for value in row])
        _check_ours(self.folder / file, self.name)
        said = {"made by": f"{MARK} {__version__}", "notes": read_notes(self.folder, self.name) | {file: list(notes)}}
        self._write(f"{self.name}.json", (json.dumps(said, indent=1, ensure_ascii=False) + "\n").encode())
        self._write(file, text.getvalue().encode())

    def _write(self, name: str, content: bytes) -> None:
        path = self.folder / name
        _check_ours(path, self.name)
        self.folder.mkdir(parents=True, exist_ok=True)
        write_whole(path, content)


class Answer(ABC):
    """What a study has found: `verdict` says it in a sentence, and stands over the picture and below the table."""

    name: str  # of its files
    caption: str  # of its picture
    scene: Scene  # that was asked for
    only_in_file: Sequence[str] = ()  # columns that a terminal does not show
    failed: Mapping[str, str] = {}
    notes: Sequence[str] = ()

    @property
    @abstractmethod
    def title(self) -> str:
        """Of the picture."""

    @abstractmethod
    def table(self) -> Mapping[str, ArrayLike]:
        """Columns of NAME.csv."""

    def lines(self) -> list[str]:
        """The table for a terminal."""
        return aligned({name: cells for name, cells in self.table().items() if name not in self.only_in_file}, 8, 5)

    @abstractmethod
    def verdict(self) -> str:
        """The answer in a sentence."""

    @abstractmethod
    def figure(self) -> Figure:
        """The picture, without its head."""

    def in_words(self) -> str:
        """For a terminal."""
        return "\n".join([*self.lines(), self.verdict(), *self.notes])

    def write(self, folder: Path) -> None:
        """Write the table and the picture."""
        page = Page(folder, self.name, self.title, self.caption)
        page.save_table(self.table(), [self.title, *self.notes, made_with()])
        with rc_context(STYLE):
            figure = self.figure()
            add_head(figure, self.title, self.verdict())
            page.save_figure(figure, made_with())


def aligned(table: Mapping[str, ArrayLike | Sequence[str]], least: int, digits: int) -> list[str]:
    """Columns under their names, each `least` wide or more: numbers to the right, text to the left, none of what is not known."""
    columns = []
    for name, values in table.items():
        cells = [value if isinstance(value, str) else f"{value:.{digits}g}" for value in np.asarray(values).tolist()]
        side = "<" if np.asarray(values).dtype.kind == "U" else ">"
        width = max(least, *map(len, (name, *cells)))
        if not {*cells} <= {"", "nan"}:
            columns.append([f"{cell:{side}{width}}" for cell in (name, *cells)])
    return [" ".join(row).rstrip() for row in zip(*columns, strict=True)]


def panels(number: int, height: float) -> tuple[Figure, list[Axes]]:
    """A figure of so many panels, two beside each other, of this height in inches."""
    rows = -(-number // 2)
    figure = Figure(figsize=(7.2, height * rows + 0.4), layout="constrained")
    grid = list(figure.subplots(rows, 2, squeeze=False).ravel())
    for axes in grid[number:]:
        axes.set_axis_off()
    return figure, grid[:number]


def made_with() -> str:
    """The libraries of this process."""
    return ", ".join(f"{name} {version}" for name, version in versions().items() if name != "BLAS")


def label(scene: Scene, name: str, unit: str = "") -> str:
    """A column of the history in words, or a load, with its unit, that of the scene where it says one."""
    loads = {load: kind.dimension.name for load, kind in scene.load_kinds.items() if kind.dimension}
    dimensions = loads | {column.name: column.unit for column in scene.columns()}
    unit = unit or unit_of(scene, dimensions.get(name, ""))
    return words(name) + (f", {unit}" if unit else "")


HEAD_LETTER, HEAD_LINE = 0.0585, 0.155  # inches: mean letter and line of a head
TICK_LABEL = 0.14  # half of one at the end of an axis: which labels there are is settled after the layout


def add_head(figure: Figure, title: str, verdict: str) -> None:
    """Write title and verdict over a figure of constrained layout, which becomes that much taller."""
    wide, tall = figure.get_size_inches()
    lines = [title, *textwrap.wrap(verdict, int((wide - 0.16) / HEAD_LETTER))]
    figure.set_size_inches(wide, tall + HEAD_LINE * len(lines))
    engine: Any = figure.get_layout_engine()
    engine.set(w_pad=TICK_LABEL)
    figure.suptitle("\n".join(lines), x=0.08 / wide, ha="left", fontsize=8, parse_math=False)


def _cell(value: str | SupportsFloat) -> str:
    return str(value) if isinstance(value, (str, int, np.integer)) else f"{float(value):.7g}"


def _check_ours(path: Path, name: str) -> None:
    if not path.exists():
        return
    # tables of older versions begin with it
    if MARK.encode() not in path.read_bytes() and path.name not in read_notes(path.parent, name):
        raise FigureError(
            f"{path}: is not a figure of this command and is not overwritten; choose another folder with -o"
        )


def read_notes(folder: Path, name: str) -> dict[str, list[str]]:
    """What NAME.json says of each table of a figure, by the table's file; nothing where there is none."""
    path = folder / f"{name}.json"
    text = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""
    try:
        return dict(json.loads(text)["notes"]) if MARK in text else {}
    except (ValueError, KeyError, TypeError):  # was cut short, or is somebody else's
        return {}
