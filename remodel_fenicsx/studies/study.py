"""What studies share: runs in processes, the journal, folders of unloaded bodies, a look at the body."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import time as clock
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx._version import __version__
from remodel_fenicsx.errors import PAUSED, RemodelError, SOLVE_FAILED
from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.fem.quadrature import Quadrature
from remodel_fenicsx.results.export import write_vtu
from remodel_fenicsx.results.fields import local_fields
from remodel_fenicsx.results.recording import (
    HISTORY,
    HistoryColumns,
    RecordedRun,
    RecordingError,
    SCENE,
    STUDY,
    read_history,
    steps_recorded,
)
from remodel_fenicsx.results.run_lock import writer
from remodel_fenicsx.results.vtkhdf import vtk_cells
from remodel_fenicsx.running import with_files_kept
from remodel_fenicsx.scene import Scene
from remodel_fenicsx.scene.scene import SceneError
from remodel_fenicsx.schema.times import same_time
from remodel_fenicsx.simulation import checked_domain, mesh_of, with_choices
from remodel_fenicsx.studies.measurements import Measured, Unknown
from remodel_fenicsx.system.children import Worker, wait_for_one
from remodel_fenicsx.system.files import (
    check_no_link,
    make_own_folder,
    part_of,
    read_regular,
    TakenError,
    refusal_in_words,
    write_whole,
)
from remodel_fenicsx.system.interrupts import Interrupted, PAUSE, StopRequest
from remodel_fenicsx.system.temporary import temporary_folder
from remodel_fenicsx.system.terminal import Line
from remodel_fenicsx.unloading import unloaded


# ---------------------------------------------------------------- what a fit has evaluated, line by line in a file
# What a fit has evaluated, line by line in a file: the same fit called again asks the same, and goes on.

Array = NDArray[np.float64]
Point = tuple[float, ...]

JOURNAL = "evaluations.jsonl"
LARGEST_JOURNAL = 10**9  # bytes


class Evaluation(NamedTuple):
    """Residuals (n,) at a point, and their derivatives (n, k): NaN in columns that the model does not give."""

    residuals: Array
    jacobian: Array


def fingerprint(scene: Scene, unknowns: Sequence[Unknown], tables: Sequence[Measured]) -> str:
    """SHA-256 of all that a fit depends on but its starts."""
    said = [[t.name, t.state, t.time, t.sd, t.scaled, {n: v.tolist() for n, v in t.columns.items()}] for t in tables]
    text = json.dumps([__version__, scene.to_toml(), [list(vars(u).values()) for u in unknowns], said])
    return hashlib.sha256(text.encode()).hexdigest()


def fingerprint_in(folder: Path) -> str | None:
    """That of the fit in a folder; None where there is none."""
    lines = _lines(folder / JOURNAL)
    return str(lines[0].get("fit")) if lines else None


def _lines(path: Path) -> list[dict[str, object]]:
    """Whole lines; the last one may have been cut off."""
    if not path.exists():
        return []
    found = []
    for line in read_regular(path, LARGEST_JOURNAL).decode(errors="replace").splitlines():
        try:
            found.append(json.loads(line))
        except ValueError:
            break
    return [line for line in found if isinstance(line, dict)]


class Journal:
    """The file, open for more."""

    def __init__(self, folder: Path, mark: str):
        folder.mkdir(parents=True, exist_ok=True)
        self._path = folder / JOURNAL
        check_no_link(self._path)
        lines = _lines(self._path)
        self.known: dict[Point, Evaluation] = {}
        for line in lines[1:]:
            point, off, ways = (np.array(line[name], dtype=np.float64) for name in ("at", "residuals", "jacobian"))
            self.known[tuple(map(float, point))] = Evaluation(off, ways)
        # without a line that was cut off
        text = "".join(json.dumps(line) + "\n" for line in (lines or [{"fit": mark}]))
        self._path.write_text(text, encoding="utf-8")

    def add(self, point: Point, evaluation: Evaluation) -> None:
        """One line more, on the disk when this returns."""
        values = {"residuals": evaluation.residuals.tolist(), "jacobian": evaluation.jacobian.tolist()}
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"at": list(point), **values}) + "\n")


# ---------------------------------------------------------------- several recorded runs, so many at a time
# Several recorded runs, so many at a time: what is complete is not run again, what was stopped goes on.
#  The one executor of `ensemble`, `trade` and `figures`. Each of its processes does one run after the other, for most
# of a short run is its start. The processes end with the command, even if that is killed.

POLL = 0.1  # seconds
FEWEST_RUNS = 2  # runs, or settings, without which nothing is compared


class TooFewRuns(RemodelError):  # noqa: N818 - what is recorded is whole, and the same call goes on
    """Fewer than `FEWEST_RUNS` have reached the end, so that there is no answer yet."""

    def __init__(self, reached: str, failed: Mapping[str, str], advice: str = "the same command goes on"):
        super().__init__(f"{reached}, at least {FEWEST_RUNS} are needed; all that is recorded is kept, {advice}")
        self.failed, self.exit_code = dict(failed), SOLVE_FAILED if failed else PAUSED


@dataclass(frozen=True)
class Run:
    """One of several runs."""

    name: str
    scene: Scene
    folder: Path

    def beside(self, ending: str) -> Path:
        """A file beside its folder, of the same name: names have dots of their own (`step-0.5`)."""
        return self.folder.with_name(f"{self.folder.name}{ending}")

    @property
    def steps_done(self) -> int:
        """How many steps are recorded."""
        if self.scene.time.tolerance is None:
            return min(steps_recorded(self.folder), self.scene.time.number_of_steps)
        with suppress(RecordingError):  # none yet, or a row that is being written
            times = self.history()["time"]
            return int(self.scene.time.progress(len(times) - 1, float(times[-1]))) if len(times) else 0
        return 0

    def is_under_way(self) -> bool:
        """Whether a process writes in its folder."""
        return self.folder.is_dir() and writer(self.folder)[1]

    def is_complete(self) -> bool:
        """Whether this very scene is recorded to its end."""
        if not (self.folder / SCENE).exists() or not (self.folder / HISTORY).exists():
            return False
        recording = RecordedRun(self.folder)
        if not _same(recording, self.scene):
            raise SceneError(f"{self.folder}: holds a run of another scene; choose another folder with -o")
        try:
            history = recording.history
        except RecordingError:  # a last row that is not whole is done again
            return False
        if not len(history["time"]) or not same_time(float(history["time"][-1]), self.scene.last_time):
            return False
        if not self._has_all_rows(history):
            raise RecordingError(f"{self.folder}: its history has other columns or rows than its scene asks for")
        if self.scene.output.fields:
            recording.fields(self.scene.last_time)  # the last ones are behind all others in the file
        return True

    def _has_all_rows(self, history: HistoryColumns) -> bool:
        """Whether a history, perhaps somebody else's, has columns and rows of a run that has reached its end."""
        scene, times = self.scene, history["time"]
        names = [column.name for column in scene.columns()]
        is_fixed = scene.time.tolerance is None and not scene.time.is_equilibrium
        rows = scene.time.number_of_steps + 1 if is_fixed else len(times)
        return set(names) <= set(history) and len(times) == rows and bool((np.diff(times) > 0).all())

    def history(self) -> HistoryColumns:
        """What it has recorded."""
        return read_history(self.folder)


def _same(recording: RecordedRun, wanted: Scene) -> bool:
    """Whether it is of this scene: with the kinematics that "auto" took, its files by SHA-256 wherever they are."""
    if recording.scene == wanted:
        return True
    from mpi4py import MPI

    from remodel_fenicsx.running import with_files_kept
    from remodel_fenicsx.simulation import with_choices
    from remodel_fenicsx.unloading import as_unloaded

    try:
        kept, _ = with_files_kept(recording.scene)
    except (SceneError, OSError) as error:
        words = refusal_in_words(error) if isinstance(error, OSError) else error
        raise RecordingError(f"{recording.path}: {words}") from error
    with as_unloaded(wanted, MPI.COMM_SELF) as found:
        return kept == with_files_kept(with_choices(found))[0]


def write_study(folder: Path, name: str, scene: str, runs: Sequence[Run]) -> None:
    """Say in the folder of a study what it is: `remodel-fenicsx status` reads it."""
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"study": name, "scene": scene, "runs": [run.name for run in runs]}, indent=1)
    write_whole(folder / STUDY, (text + "\n").encode())


def run_all(
    runs: Sequence[Run],
    jobs: int,
    title: str,
    quiet: bool = False,
    deadline: float = math.inf,
    fits: Callable[[Run], bool] = lambda run: True,
    ended: Callable[[], None] = lambda: None,
    checked: Callable[[], None] = lambda: None,
) -> dict[str, str]:
    """Run what is not complete; returns the last words of those that have failed or are damaged, by name."""
    executor = _Executor(runs, jobs, fits)
    checked()
    line, failed, pausing = Line(title), executor.failed, False
    with StopRequest() as stop:
        try:
            while executor.waiting or executor.running:
                if stop.number:
                    raise Interrupted(stop.number)
                if clock.monotonic() > deadline:
                    break
                if stop.pause and not pausing:
                    pausing = True
                    executor.pause()
                executor.begin()
                wait_for_one(executor.running, POLL)
                for run, code, last_words in executor.ended():
                    if pausing and code in (PAUSED, -PAUSE):  # the latter before Python minds the signal
                        continue
                    if code != 0:
                        failed[run.name] = last_words
                    ended()
                if not quiet:
                    line.show(executor.progress())
        finally:
            executor.stop()
            line.end()
    if pausing:
        raise Interrupted(PAUSE)
    return failed


class _Executor:
    """The runs that wait, and the processes that do them."""

    def __init__(self, runs: Sequence[Run], jobs: int, fits: Callable[[Run], bool]):
        self.runs, self.jobs, self.fits = runs, jobs, fits
        self.failed: dict[str, str] = {}
        self.waiting = [run for run in runs if self._is_left(run)]
        self.running: dict[Worker, Run] = {}
        self.idle: list[Worker] = []

    def _is_left(self, run: Run) -> bool:
        """Whether it is to be run. One whose folder is damaged is not: nothing of the user's is removed."""
        try:
            return not run.is_complete()
        except RecordingError as error:
            self.failed[run.name] = str(error)
            return False

    def begin(self) -> None:
        """Begin runs until there are as many as jobs, or go on with what is there of them."""
        for run in list(self.waiting):
            if len(self.running) >= self.jobs:
                return
            if run.is_under_way():  # by another command, or by a process whose command was killed and that is ending
                continue
            self.waiting.remove(run)
            if self._is_left(run) and self.fits(run):
                worker = self.idle.pop() if self.idle else Worker()
                self.running[worker] = run
                _begin(worker, run)

    def ended(self) -> list[tuple[Run, int, str]]:
        """Runs that have ended since the last call: with exit code and last words."""
        found = []
        for worker, run in list(self.running.items()):
            code = worker.poll()
            if code is None:
                continue
            del self.running[worker]
            if code != 0 and run.is_under_way():  # another process was faster, so that this one was refused
                self.waiting.append(run)
            else:
                found.append((run, code, worker.last_words() if code else ""))
            if worker.is_alive:
                self.idle.append(worker)
        return found

    def pause(self) -> None:
        """Begin nothing more, and let each run end with the step under way."""
        self.waiting.clear()
        for worker in self.running:
            worker.process.send_signal(PAUSE)

    def stop(self) -> None:
        """End all processes; a run drops the step under way."""
        for worker in [*self.running, *self.idle]:
            worker.stop()

    def progress(self) -> str:
        """How far all runs are, and those under way."""
        total = sum(run.scene.time.number_of_steps for run in self.runs)
        done = {run.name: run.steps_done for run in self.runs}
        parts = [f"{run.name} {done[run.name]}/{run.scene.time.number_of_steps}" for run in self.running.values()]
        more = [f"{len(self.waiting)} more to start"] if self.waiting else []
        return f"{100 * sum(done.values()) // total} % of {len(self.runs)} runs: {', '.join(parts + more) or 'done'}"


def _begin(worker: Worker, run: Run) -> None:
    """Begin a run, or go on with what is there of it."""
    make_own_folder(run.folder.parent)
    check_no_link(run.folder)
    messages = run.beside(".txt")
    if (run.folder / SCENE).exists():
        worker.begin(["run", "--resume", str(run.folder), "-q", "--no-report"], messages)
        return
    scene = run.beside(".toml")
    write_whole(scene, run.scene.to_toml().encode())
    worker.begin(["run", str(scene), "-o", str(run.folder), "-q", "--no-report"], messages)


# ---------------------------------------------------------------- the scene of an unloaded body in a folder of its
# The scene of an unloaded body in a folder of its own.


def write_unloaded(scene: Scene, folder: Path) -> str:
    """Write scene.toml of the unloaded body into a new folder, with unloaded.msh of an own one; say what was found."""
    if folder.exists():
        raise TakenError(folder, "folder")
    with temporary_folder() as temporary:
        found = unloaded(scene, MPI.COMM_SELF, temporary)
        kept, files = with_files_kept(found)
        part = part_of(folder)
        shutil.rmtree(part, ignore_errors=True)  # of one that was killed
        part.mkdir(parents=True)
        for name, data in files.items():
            (part / name).write_bytes(data)
        (part / "scene.toml").write_text(kept.to_toml(f"the unloaded body of {scene.name}"), encoding="utf-8")
        part.rename(folder)
        return "unloaded: " + _in_words(scene, found)


def _in_words(scene: Scene, found: Scene) -> str:
    numbers = found.geometry.model_dump()
    lengths = {name: value for name, value in numbers.items() if isinstance(value, float)}
    known = scene.geometry.model_dump()
    words = [f"{name} {value:.6g} (loaded {known[name]:.6g})" for name, value in lengths.items()]
    if words:
        return ", ".join(words)
    before, after = (one.geometry.checked(one.mesh)[0].points for one in (scene, found))  # type: ignore[attr-defined]
    return f"{len(after)} nodes, moved by {np.linalg.norm(after - before, axis=1).max():.6g} at most"


# ---------------------------------------------------------------- what a scene's body is, looked at before any solve
# What a scene's body is, looked at before any solve: its local axes on its mesh.


def write_axes(scene: Scene, path: Path, comm: MPI.Intracomm = MPI.COMM_WORLD) -> str:
    """Write local axes, depth, station, thickness, and where the axes are undefined, by element. Collective."""
    scene = with_choices(scene)
    domain, shape = checked_domain(mesh_of(scene, comm), scene), scene.geometry
    mesh = domain.mesh
    weight = KINEMATICS[scene.model.kinematics].on(mesh, shape).weight(mesh)
    quadrature = Quadrature(mesh, scene.mesh.degree, weight)
    local_axes = shape.local_axes(domain, quadrature)
    fields = local_fields(local_axes, quadrature) | {"region": domain.element_region.astype(np.int64)}
    words = [f"{domain.number_of_elements} elements"]
    if local_axes.thickness is not None:
        fields["thickness"] = quadrature.element_mean(local_axes.thickness)
        least, most = quadrature.minimum(local_axes.thickness), quadrature.maximum(local_axes.thickness)
        words.append(f"wall {least:.4g} to {most:.4g} thick")
    if local_axes.undefined is not None:
        undefined = local_axes.undefined.astype(np.float64)
        fields["undefined"] = undefined.max(axis=1)
        words.append(f"axes undefined in {100 * quadrature.mean(undefined):.2g} % of the wall")
    gathered = {name: domain.gather_elements(values) for name, values in fields.items()}
    points, elements = domain.gather_mesh()
    if points is not None and elements is not None:
        cell_type, cells = vtk_cells(mesh.topology.cell_name(), mesh.geometry.cmap.degree, elements)
        write_vtu(path, points, cells, cell_type, {n: v for n, v in gathered.items() if v is not None})
    return "; ".join(words)
