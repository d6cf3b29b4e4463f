"""Studies: several runs that answer one question, done in parallel.

The same call resumes a study that was stopped. A study writes a picture and its data into its
folder, like a figure.
"""

from __future__ import annotations

import csv
import io
import json
import math
import textwrap
import time as clock
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, SupportsFloat, TypeVar

import matplotlib
import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpi4py import MPI
from numpy.typing import ArrayLike

from remodel_fenicsx._version import __version__
from remodel_fenicsx.errors import FigureError, PAUSED, RemodelError, SOLVE_FAILED
from remodel_fenicsx.results.recording import (
    HISTORY,
    SCENE,
    HistoryColumns,
    RecordedRun,
    RecordingError,
    RunLock,
    read_history,
    unit_of,
    words,
)
from remodel_fenicsx.running import with_stored_files
from remodel_fenicsx.scene import Scene
from remodel_fenicsx.scene.scene import SceneError
from remodel_fenicsx.schema.units import dimension_of
from remodel_fenicsx.initial import resolve_auto_settings
from remodel_fenicsx.system.environment import versions
from remodel_fenicsx.system.children import POLL, Cluster, Threads
from remodel_fenicsx.system.files import (
    check_no_link,
    make_own_folder,
    refusal_in_words,
    write_whole,
)
from remodel_fenicsx.system.interrupts import Interrupted, PAUSE, StopRequest
from remodel_fenicsx.system.terminal import Line
from remodel_fenicsx.unloading import as_unloaded

# ---------------------------------------------------------------- picture and tables of a figure
# The metadata of each picture name the versions that made it. Notes on tables are in a JSON file.
MARK = "remodel_fenicsx figures"  # in all pictures and notes; files with this mark may be replaced
DOTS_PER_INCH = 200
COLOURS = ("#1b4f9c", "#d1495b", "#2a9d6f", "#e09f3e", "#6c4f9c")  # they differ in lightness too
STYLE = matplotlib.rc_params_from_file(
    Path(__file__).with_name("figures.mplstyle"), use_default_template=False
)


class Page:
    """Picture and tables of one figure in a folder, with their notes."""

    def __init__(self, folder: Path, name: str, title: str = "", caption: str = ""):
        self.folder, self.name = folder, name
        self.title, self.caption = title, caption

    def save_figure(self, figure: Figure, made_with: str) -> None:
        """Write NAME.png; its metadata have title, caption and the versions in `made_with`."""
        about = {
            "Software": f"{MARK} {__version__}",
            "Title": self.title,
            "Description": self.caption,
            "Source": f"{made_with}; matplotlib {matplotlib.__version__}",
            "Comment": self.name,
        }
        drawn = io.BytesIO()
        figure.savefig(drawn, format="png", dpi=DOTS_PER_INCH, facecolor="white", metadata=about)
        self._write(f"{self.name}.png", drawn.getvalue())

    def save_table(
        self, columns: Mapping[str, ArrayLike], notes: Sequence[str], part: str = ""
    ) -> None:
        """Write columns of equal length to NAME.csv or NAME-PART.csv, and notes to NAME.json."""
        names, values = list(columns), [np.asarray(column) for column in columns.values()]
        text, file = io.StringIO(), f"{self.name}-{part}.csv" if part else f"{self.name}.csv"
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(names)
        for row in zip(*values, strict=True):
            writer.writerow([_cell(value) for value in row])
        _check_ours(self.folder / file, self.name)
        about = {
            "made by": f"{MARK} {__version__}",
            "notes": read_notes(self.folder, self.name) | {file: list(notes)},
        }
        self._write(
            f"{self.name}.json", (json.dumps(about, indent=1, ensure_ascii=False) + "\n").encode()
        )
        self._write(file, text.getvalue().encode())

    def _write(self, name: str, content: bytes) -> None:
        path = self.folder / name
        _check_ours(path, self.name)
        self.folder.mkdir(parents=True, exist_ok=True)
        write_whole(path, content)


class StudyResult(ABC):
    """Result of a study; its `verdict` is shown above the picture and below the table."""

    name: str  # stem of the files
    caption: str  # caption of the picture
    scene: Scene  # the requested scene
    only_in_file: Sequence[str] = ()  # columns that a terminal does not show
    failed: Mapping[str, str] = {}
    notes: Sequence[str] = ()

    about: str  # second half of the title, after the scene's name

    @property
    def title(self) -> str:
        """Title of the picture: the scene's name and `about`."""
        return f"{self.scene.name}: {self.about}"

    @abstractmethod
    def table(self) -> Mapping[str, ArrayLike]:
        """Return the columns of NAME.csv by name."""

    def lines(self) -> list[str]:
        """Return the table for a terminal, a string for each line."""
        return aligned(
            {name: cells for name, cells in self.table().items() if name not in self.only_in_file},
            8,
            5,
        )

    @abstractmethod
    def verdict(self) -> str:
        """Return the result in one or a few sentences."""

    @abstractmethod
    def figure(self) -> Figure:
        """Draw the picture, without title and verdict."""

    def in_words(self) -> str:
        """Return table, verdict and notes for a terminal."""
        return "\n".join([*self.lines(), self.verdict(), *self.notes])

    def write(self, folder: Path) -> None:
        """Write the table and the picture into a folder."""
        page = Page(folder, self.name, self.title, self.caption)
        page.save_table(self.table(), [self.title, *self.notes, made_with()])
        with rc_context(STYLE):
            figure = self.figure()
            add_head(figure, self.title, self.verdict())
            page.save_figure(figure, made_with())


def aligned(table: Mapping[str, ArrayLike | Sequence[str]], least: int, digits: int) -> list[str]:
    """Format columns with their names; numbers right-aligned, text left-aligned.

    Each column is at least `least` characters wide.
    """
    columns = []
    for name, values in table.items():
        cells = [
            value if isinstance(value, str) else f"{value:.{digits}g}"
            for value in np.asarray(values).tolist()
        ]
        side = "<" if np.asarray(values).dtype.kind == "U" else ">"
        width = max(least, *map(len, (name, *cells)))
        if not {*cells} <= {"", "nan"}:
            columns.append([f"{cell:{side}{width}}" for cell in (name, *cells)])
    return [" ".join(row).rstrip() for row in zip(*columns, strict=True)]


def panels(number: int, height: float) -> tuple[Figure, list[Axes]]:
    """Make a figure with this number of panels, two in a row, of this height in inches."""
    rows = -(-number // 2)
    figure = Figure(figsize=(7.2, height * rows + 0.4), layout="constrained")
    grid = list(figure.subplots(rows, 2, squeeze=False).ravel())
    for axes in grid[number:]:
        axes.set_axis_off()
    return figure, grid[:number]


def made_with() -> str:
    """Return the versions of the libraries in this process."""
    return ", ".join(f"{name} {version}" for name, version in versions().items() if name != "BLAS")


def label(scene: Scene, name: str, unit: str = "") -> str:
    """Return the label of a column or load, with its unit; by default the scene's unit, if any."""
    unit = unit or unit_of(scene, dimensions(scene).get(name, ""))
    return words(name) + (f", {unit}" if unit else "")


def label_of_key(scene: Scene, key: str) -> str:
    """Return the label of a key with its unit, such as "pressure, kPa" of loads.pressure.value."""
    *parents, name = key.split(".")
    if parents[0] == "loads":
        return label(scene, parents[1])
    field = getattr(type(value_at(scene, parents)), "model_fields", {}).get(name)
    dimension = "degrees" if "angle" in name else getattr(field and dimension_of(field), "name", "")
    unit = {"temperature": "K", "number per volume": "1/m³"}.get(dimension, dimension)
    return label(scene, " ".join([*parents[1:2], name]), unit_of(scene, unit))


def value_at(scene: Scene, parts: Iterable[str]) -> object:
    """Return the value of a scene at the parts of a dotted key."""
    there: Any = scene
    for part in parts:
        there = (
            there[int(part)]
            if isinstance(there, tuple)
            else (there[part] if isinstance(there, Mapping) else getattr(there, part))
        )
    return there


def dimensions(scene: Scene) -> dict[str, str]:
    """Return the dimensions of loads and columns by name, also of columns on request."""
    loads = {load: kind.dimension.name for load, kind in scene.load_kinds.items() if kind.dimension}
    columns = scene.columns(column.name for column in scene.geometry.columns_on_request)
    return loads | {column.name: column.unit for column in columns}


HEAD_LETTER, HEAD_LINE = 0.0585, 0.155  # inches: mean width of a letter, and line height
# Inches: half of a tick label at the end of an axis. Tick labels are known only after the layout.
TICK_LABEL = 0.14


def add_head(figure: Figure, title: str, verdict: str) -> None:
    """Write title and verdict above a figure with constrained layout, and increase its height."""
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
    # Tables of older versions begin with the mark.
    if MARK.encode() not in path.read_bytes() and path.name not in read_notes(path.parent, name):
        raise FigureError(
            f"{path}: is not a figure of this command and is not overwritten; "
            "choose another folder with -o"
        )


def read_notes(folder: Path, name: str) -> dict[str, list[str]]:
    """Read the notes on the tables of a figure from NAME.json, by file name; empty if absent."""
    path = folder / f"{name}.json"
    text = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""
    try:
        return dict(json.loads(text)["notes"]) if MARK in text else {}
    except (ValueError, KeyError, TypeError):  # truncated, or a file of another program
        return {}


# ---------------------------------------------------------------- a run of a study
AnyResult = TypeVar("AnyResult", bound=StudyResult)

FEWEST_RUNS = 2  # smallest number of runs, or settings, that can be compared


class TooFewRuns(RemodelError):  # noqa: N818 - the recorded runs are complete, the study can resume
    """Fewer than `FEWEST_RUNS` runs have reached the end, so that there is no result yet."""

    def __init__(
        self, reached: str, failed: Mapping[str, str], advice: str = "repeat the command to resume"
    ):
        super().__init__(
            f"{reached}, at least {FEWEST_RUNS} are needed; all recorded results are kept, {advice}"
        )
        self.failed, self.exit_code = dict(failed), SOLVE_FAILED if failed else PAUSED


@dataclass(frozen=True)
class Run:
    """A run of a study: its name, scene and folder."""

    name: str
    scene: Scene
    folder: Path

    def sibling_path(self, ending: str) -> Path:
        """Return the file next to the folder with this suffix; names may have dots (`step-0.5`)."""
        return self.folder.with_name(f"{self.folder.name}{ending}")

    def is_complete(self) -> bool:
        """Return whether this scene is recorded to its end; raise if it is another scene."""
        if not all((self.folder / name).exists() for name in (SCENE, HISTORY)):
            return False
        recording = RecordedRun(self.folder)
        if not _same(recording, self.scene):
            raise SceneError(
                f"{self.folder}: holds a run of another scene; choose another folder with -o"
            )
        try:
            history = recording.history
        except RecordingError:  # An incomplete last row is computed again.
            return False
        times = history["time"]
        if not len(times) or not math.isclose(float(times[-1]), self.scene.last_time):
            return False
        if (
            not {column.name for column in self.scene.columns()} <= set(history)
            or (np.diff(times) <= 0).any()
        ):
            raise RecordingError(
                f"{self.folder}: columns or rows of its history are not those of its scene"
            )
        return True

    def history(self) -> HistoryColumns:
        """Read the recorded history."""
        return read_history(self.folder)

    def words(self) -> list[str]:
        """Write the scene next to the folder; return the command that begins the run."""
        make_own_folder(self.folder.parent)
        check_no_link(self.folder)
        scene = self.sibling_path(".toml")
        write_whole(scene, self.scene.to_toml().encode())
        return ["run", str(scene), "-o", str(self.folder), "-q", "--no-report"]


def _same(recording: RecordedRun, wanted: Scene) -> bool:
    """Return whether a run is of this scene; "auto" is resolved, files are compared by SHA-256."""
    if recording.scene == wanted:
        return True
    try:
        stored, _ = with_stored_files(recording.scene)
    except (SceneError, OSError) as error:
        words = refusal_in_words(error) if isinstance(error, OSError) else error
        raise RecordingError(f"{recording.path}: {words}") from error
    with as_unloaded(wanted, MPI.COMM_SELF) as unloaded:
        return stored == with_stored_files(resolve_auto_settings(unloaded))[0]


# ---------------------------------------------------------------- all runs
class Study:
    """Runs in one folder, and the processes that do them, until the study is closed."""

    # A process does one run after another, because most of a short run is its start. All processes
    # end with the command.

    def __init__(
        self,
        name: str,
        scene: Scene,
        folder: Path | str | None,
        scenes: Mapping[str, Scene],
        jobs: int | None = None,
        quiet: bool = True,
        scheduler: str | None = None,
    ):
        self.name, self.scene = name, scene
        self.jobs, self.quiet = jobs, quiet
        self.scheduler = scheduler
        self.folder = Path(folder or Path("results") / f"{scene.name}-{name}")
        place = self.folder.absolute()  # Processes on other machines have other working folders.
        self.runs = [Run(run, changed, place / run) for run, changed in scenes.items()]
        self.failed: dict[str, str] = {}
        self.deadline = math.inf
        self._running: dict[Future[tuple[int, str]], Run] = {}

    @cached_property
    def _pool(self) -> Threads:
        """Threads, or workers of a scheduler, that wait for the runs; made when runs are left."""
        if self.scheduler is None:
            return Threads(self.jobs)
        return Cluster(self.scheduler, self.folder, self.jobs)

    def close(self) -> None:
        """End all runs and processes."""
        if "_pool" in vars(self):
            self._pool.close(self._running)

    def run_and_write(self, answer: Callable[[], AnyResult]) -> tuple[Path, AnyResult]:
        """Do all runs, compute the result and write it; return the folder and the result."""
        with RunLock(self.folder), closing(self):
            self.run_all()
            result = answer()
            result.write(self.folder)
        return self.folder, result

    def histories(self) -> dict[str, HistoryColumns]:
        """Read the histories of all runs that have not failed, by name."""
        return {run.name: run.history() for run in self.runs if run.name not in self.failed}

    def update(self) -> None:
        """Update the study at the start, and whenever a run has ended."""

    def run_all(self) -> None:
        """Do all incomplete runs; `failed` gets the last output of failed and corrupt ones."""
        waiting = [run for run in self.runs if self._is_left(run)]
        self.update()
        pausing = False
        with StopRequest() as stop, Line(f"{self.scene.name} {self.name}", self.quiet) as line:
            while (waiting or self._running) and clock.monotonic() < self.deadline:
                if stop.number:
                    raise Interrupted(stop.number)
                if stop.pause and not pausing:
                    pausing = True
                    waiting.clear()
                    # Each run ends after its current step.
                    self._pool.everywhere(partial(self._pool.members.send, PAUSE))
                self._collect(pausing)
                while len(self._running) < self._pool.places() and waiting:
                    run, begin = waiting.pop(0), self._pool.members.run
                    member = self._pool.executor.submit(begin, run.folder, run.words())
                    self._running[member] = run
                line.show(self._progress(len(waiting)))
        if pausing:
            raise Interrupted(PAUSE)

    def _is_left(self, run: Run) -> bool:
        """Return whether a run is to be done: no if its folder is corrupt. Removes no files."""
        try:
            return not run.is_complete()
        except RecordingError as error:
            self.failed[run.name] = str(error)
            return False

    def _collect(self, pausing: bool) -> None:
        """Collect the runs that have ended."""
        for member in wait(self._running, POLL, FIRST_COMPLETED).done:
            run = self._running.pop(member)
            code, words = self._pool.result(member)
            # -PAUSE: the signal came before Python had installed its handler.
            if code != 0 and not (pausing and code in (PAUSED, -PAUSE)):
                self.failed[run.name] = words
            self.update()

    def _progress(self, waiting: int) -> str:
        """Return the number of runs that have ended, and the names of the current ones."""
        done = len(self.runs) - waiting - len(self._running)
        under_way = ", ".join(run.name for run in self._running.values())
        text = f"{done} of {len(self.runs)} runs done"
        return f"{text}; under way: {under_way}" if under_way else text
