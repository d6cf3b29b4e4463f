"""`remodel-fenicsx fit SCENE DATA.toml`: numbers of a scene from measurements, with what the data say of them."""

from __future__ import annotations

import ctypes
import hashlib
import json
import logging
import re
import signal
import time as clock
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import cycle, product
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from matplotlib.figure import Figure
from mpi4py import MPI
from numpy.typing import NDArray
from pydantic import Field, model_validator

from remodel_fenicsx._version import __version__
from remodel_fenicsx.body.reductions import explained
from remodel_fenicsx.errors import BAD_ENVIRONMENT, SOLVE_FAILED, RemodelError, UnreadableFile
from remodel_fenicsx.results.run_folder import chosen_folder
from remodel_fenicsx.results.recording import RunLock
from remodel_fenicsx.scene.scene import Scene, SceneError
from remodel_fenicsx.schema.settings import Load
from remodel_fenicsx.schema.conventions import convention_doubt
from remodel_fenicsx.schema.tables import Table, fault, shown
from remodel_fenicsx.schema.text import read_columns, read_toml
from remodel_fenicsx.schema.units import FORCE, LENGTH, LENGTH_UNIT, STRESS, STRESS_UNIT, factor_to_scene
from remodel_fenicsx.initial import with_choices
from remodel_fenicsx.simulation import Simulation, begin_again
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.state import Snapshot
from remodel_fenicsx.studies.page import COLOURS, Answer, Page, label, made_with, panels
from remodel_fenicsx.system import interrupts
from remodel_fenicsx.system.children import cores
from remodel_fenicsx.system.files import ForeignFileError, check_no_link, read_regular, write_whole
from remodel_fenicsx.system.terminal import Line, hold_log, open_log, unsaid
from remodel_fenicsx.unloading import PASSIVE
from remodel_fenicsx.watch.warnings import WarnsOnce

log = logging.getLogger(__name__)

Array = NDArray[np.float64]


# ---------------------------------------------------------------- what is read: data, checked before any solve
LARGEST_TABLE = 10**7  # bytes: a hundred thousand rows
DIMENSIONS = {"stress": STRESS, "length": LENGTH, "stress * length^2": FORCE, "force": FORCE}
SCALE_BOUNDS = (1e-3, 1e3)  # bounds of a scale
WIDE = 1e3  # a bound that nobody gives over the start
FROM_EDGE = 5e-4  # of a logarithm, from the end of a key's range: derivatives look `LOGARITHM_CHANGE` to both sides


# ---------------------------------------------------------------- the file as it is written
Positive = Annotated[float, Field(gt=0)]
_Number = Annotated[Positive | None, Field(json_schema_extra={"allowed": "a finite number greater than 0"})]


class UnknownTable(Table):
    """An entry of [unknowns]."""

    start: float = Field(gt=0)
    lower: _Number = None
    upper: _Number = None
    prior: _Number = None
    prior_sd: _Number = None

    @model_validator(mode="after")
    def _go_together(self) -> UnknownTable:
        lower, upper = self.bounds
        if not lower <= self.start <= upper or lower == upper:
            raise fault(f"must lie between lower {lower:g} and upper {upper:g}", "start", self.start)
        if (self.prior is None) != (self.prior_sd is None):
            raise fault("prior and prior_sd (of the logarithm) go together", "prior", self.prior)
        return self

    @property
    def bounds(self) -> tuple[float, float]:
        """Those given, or a thousandth and a thousand times the start."""
        return self.lower or self.start / WIDE, self.upper or self.start * WIDE


class MeasuredTable(Table):
    """A table [[measured]]."""

    file: str
    state: Literal["virgin", "history", "after"] = "virgin"
    time: _Number = None
    sd: dict[str, Positive] = Field(default={}, json_schema_extra={"allowed": "numbers greater than 0 by column"})
    scale: dict[str, Literal["unknown"]] = Field(default={}, json_schema_extra={"allowed": "'unknown' by column"})
    units: dict[str, str] = Field(default={}, json_schema_extra={"allowed": "units by column"})
    drive: tuple[str, ...] = Field(default=(), strict=False, json_schema_extra={"allowed": "names of columns of loads"})

    @model_validator(mode="after")
    def _go_together(self) -> MeasuredTable:
        if (self.time is not None) != (self.state == "after"):
            raise fault("goes with state = 'after', and is the time until which the tissue remodels", "time", self.time)
        return self


class DataFile(Table):
    """DATA.toml."""

    unknowns: dict[str, UnknownTable] = Field(
        min_length=1, json_schema_extra={"allowed": 'a table of keys, as "material.lame_mu" = { start = 10.0 }'}
    )
    measured: tuple[MeasuredTable, ...] = Field(
        min_length=1, strict=False, json_schema_extra={"allowed": "tables [[measured]], each with a file"}
    )


# ---------------------------------------------------------------- the same beside a scene
@dataclass(frozen=True)
class Unknown:
    """A number that is fitted, in logarithms."""

    key: str
    start: float
    lower: float
    upper: float
    prior: float | None = None
    prior_sd: float | None = None


@dataclass(frozen=True)
class Measured:
    """A table of measurements in the scene's units."""

    name: str
    state: str
    time: float
    columns: dict[str, Array]
    loads: tuple[str, ...]
    sd: dict[str, float]
    scaled: tuple[str, ...]
    units: dict[str, tuple[str, float]]  # of the file where it has others, with their factors to the scene's

    @property
    def rows(self) -> int:
        """How many there are."""
        return len(next(iter(self.columns.values())))

    def over(self, name: str) -> str:
        """The column over which a measured one is drawn: the load along its own axis, the first load, or time."""
        same = [load for load in self.loads if load.rpartition("_")[2] == name.rpartition("_")[2]]
        return [*same, *self.loads, "time"][0]

    @property
    def protocols(self) -> list[NDArray[np.int64]]:
        """Rows of each protocol in their order: between two of them the loads fall by more than half of the first's."""
        if not self.loads:
            return [np.arange(self.rows)]
        sizes = np.max(
            [np.abs(self.columns[name]) / (np.abs(self.columns[name]).max() or 1.0) for name in self.loads], axis=0
        )
        starts = [0]
        for row in range(1, self.rows):
            if sizes[row - 1] - sizes[row] > sizes[starts[-1] : row].max() / 2:
                starts.append(row)
        return np.split(np.arange(self.rows), starts[1:])


def read_measurements(path: Path, scene: Scene) -> tuple[list[Unknown], list[Measured]]:
    """Unknowns and tables of DATA.toml, checked against a scene."""
    data = DataFile(**read_toml(path))
    measured = [
        _measured(table, f"measured[{number}]", path.parent, scene) for number, table in enumerate(data.measured)
    ]
    starts = {key: table.start for key, table in data.unknowns.items()}
    for key, start in starts.items():
        scene.with_values({key: start})  # a key that there is not, or that takes no such number, is refused
    scene.with_values(starts)  # and what does not go together
    unknowns = [
        Unknown(key, table.start, *_bounds(key, table, scene, starts), table.prior, table.prior_sd)
        for key, table in data.unknowns.items()
    ]
    scales = dict.fromkeys(name for table in measured for name in table.scaled)
    unknowns += [Unknown(f"scale.{name}", 1.0, *SCALE_BOUNDS) for name in scales]
    if len(unknowns) > sum(table.rows * len(table.sd) for table in measured):
        raise SceneError(f"unknowns: {len(unknowns)} unknowns need as many measurements at least")
    return unknowns, measured


def _bounds(key: str, table: UnknownTable, scene: Scene, starts: Mapping[str, float]) -> tuple[float, float]:
    """Those of the table, or the last numbers before them that are of the key's own range."""

    def allowed(number: float) -> bool:
        """Whether it may be, with the others as they are or moved by the same factor: a wall keeps its form."""
        moved = {other: start * number / table.start for other, start in starts.items()}
        for values in ({**starts, key: number}, moved):
            with suppress(SceneError):
                return bool(scene.with_values(values))
        return False

    ends = []
    for given, end in zip((table.lower, table.upper), table.bounds, strict=True):
        if given is not None and not allowed(given):
            scene.with_values({key: given})  # refuses what somebody has typed
        inside, outside = np.log([table.start, end])
        back = FROM_EDGE * np.sign(inside - outside)
        if not allowed(float(np.exp(outside - back))):
            while abs(outside - inside) > FROM_EDGE:
                middle = (inside + outside) / 2
                inside, outside = (middle, outside) if allowed(float(np.exp(middle - back))) else (inside, middle)
            end = float(np.exp(inside))
        ends.append(end)
    if not ends[0] < ends[1]:
        raise SceneError(f"unknowns.{key}: the scene takes no number beside {table.start:g}, so it is not fitted")
    return ends[0], ends[1]


def _measured(table: MeasuredTable, place: str, folder: Path, scene: Scene) -> Measured:
    if table.state == "after" and scene.remodeling.turnover.is_on:
        raise SceneError(f"{place}.state = 'after': takes cells alone, not what remodeling.turnover has changed")
    file = f"{place}.file = {shown(table.file)}"
    columns = _read_columns(folder / table.file, file, scene)
    loads = _prescribed(columns, table, scene, place)
    _check_columns(columns, loads, table.state, file, scene)
    for key in ("units", "sd", "scale"):
        for name in getattr(table, key):
            if name not in columns or (name == "time" and key != "units"):
                raise SceneError(f"{place}.{key}.{name}: no such column is measured; the file has {', '.join(columns)}")
    units = {
        name: (unit, _factor(name, unit, scene, f"{place}.units.{name} = {shown(unit)}"))
        for name, unit in table.units.items()
    }
    columns |= {name: columns[name] * factor for name, (_, factor) in units.items()}
    for name in columns:
        if (name in loads or name == "time") == (name in table.sd):
            rule = (
                "is prescribed, not measured" if name in table.sd else "each measured column has a standard deviation"
            )
            raise SceneError(f"{place}.sd.{name}: {rule}")
    return Measured(table.file, table.state, table.time or 0.0, columns, loads, table.sd, tuple(table.scale), units)


def _prescribed(columns: Mapping[str, Array], table: MeasuredTable, scene: Scene, place: str) -> tuple[str, ...]:
    """The loads among the columns: those that drive the test; of a force and a strain along one axis the strain."""
    kinds = scene.load_kinds
    for name in table.drive:
        if name not in columns or name not in kinds:
            known = ", ".join(one for one in columns if one in kinds)
            raise SceneError(f"{place}.drive = {shown(name)}: allowed are the columns of loads: {known}")
    if table.drive:
        return table.drive
    loads = [name for name in columns if name in scene.loads or (name in kinds and kinds[name].instead_of)]
    return tuple(name for name in loads if kinds[name].dimension is None or kinds[name].instead_of not in loads)


def _factor(name: str, unit: str, scene: Scene, place: str) -> float:
    kinds = {column.name: column.unit for column in _all_columns(scene)}
    kinds |= {load: kind.dimension.name for load, kind in scene.load_kinds.items() if kind.dimension}
    if (dimension := DIMENSIONS.get(kinds.get(name, ""))) is None:
        raise SceneError(f"{place}: {name} takes no unit")
    units = {STRESS_UNIT: scene.material.stress_unit, LENGTH_UNIT: scene.geometry.length_unit}
    try:
        return factor_to_scene(unit, dimension, units)
    except ValueError as error:
        raise SceneError(f"{place}: {error}") from error


def _all_columns(scene: Scene) -> tuple[Any, ...]:
    return scene.columns(column.name for column in scene.geometry.columns_on_request)


def _read_columns(path: Path, place: str, scene: Scene) -> dict[str, Array]:
    known = {column.name for column in _all_columns(scene)} - {"seconds", "substeps"}
    strains = {name.replace("elongation", "stretch"): name for name in scene.load_kinds if "elongation" in name}
    allowed = sorted({*scene.loads, *known, "time", *strains})
    try:
        columns = read_columns(read_regular(path, LARGEST_TABLE), path.name, allowed)
    except (OSError, ForeignFileError, UnreadableFile) as error:
        raise SceneError(f"{place}: {getattr(error, 'strerror', None) or error}") from error
    for stretch, strain in strains.items():
        if stretch in columns and strain in columns:
            raise SceneError(f"{place}: has both {stretch} and {strain}")
    for name in {*columns} & {*strains, *scene.load_kinds}:  # before any solve, which may fail because of them
        if words := convention_doubt(name, columns[name]):
            log.warning("%s, %s: %s", path.name, name, words)
    return {strains.get(name, name): values - (name in strains) for name, values in columns.items()}


def _check_columns(columns: Mapping[str, Array], loads: tuple[str, ...], state: str, place: str, scene: Scene) -> None:
    if set(columns) <= {*loads, "time"}:
        raise SceneError(f"{place}: has no measured column")
    if state == "history":
        if "time" not in columns:
            raise SceneError(f"{place}: needs a column time with state = 'history'")
        if loads:
            raise SceneError(f"{place}: {loads[0]}: with state = 'history' the scene's own ramps hold")
        if scene.time.is_equilibrium or not (0 <= columns["time"].min() <= columns["time"].max() <= scene.last_time):
            raise SceneError(f"{place}: column time: must lie between 0 and the scene's time.end")
    elif not loads:
        raise SceneError(f"{place}: needs a column of a load with state = {state!r}: {', '.join(scene.loads)}")


WALL = ("wall_thickness", "inner_radius")


def doubts(tables: Sequence[Measured], modelled: Sequence[Mapping[str, Array]], scene: Scene) -> Iterator[str]:
    """Lines on measured columns that may be in another convention, beside the model at the start."""
    units = {column.name: column.unit for column in _all_columns(scene)}
    for table, model in zip(tables, modelled, strict=True):
        pairs = {f"{name} ({units[name]})": (table.columns[name], model[name]) for name in table.sd}
        pairs = {name: pair for name, pair in pairs.items() if name.split()[0] not in table.scaled}
        if {*WALL} <= {*table.sd}:
            thickness, radius = ([columns[name] for columns in (table.columns, model)] for name in WALL)
            pairs[" / ".join(WALL)] = (thickness[0] / radius[0], thickness[1] / radius[1])
        for name, pair in pairs.items():
            if words := convention_doubt(name, *pair):
                yield f"{table.name}, {name.partition(' (')[0]}: {words}"


# ---------------------------------------------------------------- what a scene says where a table has measurements
# keys whose numbers a simulation takes that is built already (`begin_again`)
TISSUE, OTHERS = r"(regions\.\w+\.)?(material\.\w+|remodeling\.(kappa|half_life))", r"loads\.\w+\.value|natural\.\w+"
CAN_BE_SET = rf"scale\..*|{TISSUE}|{OTHERS}"
# what differences of runs divide by a small change is rounding alone
PRECISE = {"solver.relative_tolerance": 1e-13, "solver.absolute_tolerance": 0.0}


def model_of(scene: Scene, table: Measured, scales: Mapping[str, float], kept: Kept | None = None) -> dict[str, Array]:
    """What a scene says where a table has measurements, by column, (rows,)."""
    changes = PRECISE | {"output.columns": [*table.sd], "output.times": [], "output.fields": False}
    scene = with_choices(scene.with_values(changes))
    if table.state == "history":
        measured, step = table.columns["time"], scene.time.step
        end = max(float(step * np.ceil(measured.max() / step - 1e-9)), step)
        found, _ = _run(scene.with_values({"time.end": end}), table, kept)
        return {name: np.interp(measured, found["time"], found[name]) for name in table.sd}
    start = None
    if table.state == "after":
        _, start = _run(scene.with_values({"time.end": table.time}), table, kept)
    found, _ = _run(_passive(scene, table, scales), table, kept, start)
    return {name: found[name][found["time"] > 0] for name in table.sd}


def _passive(scene: Scene, table: Measured, scales: Mapping[str, float]) -> Scene:
    """Cells that stay, and a step for each row; loads that the table has not keep their last value."""
    scene = _with_loads_of(table, scene)
    changes = PASSIVE | {"time.step": 1.0, "time.end": float(table.rows)}
    for name, load in scene.loads.items():
        values: Array = np.full(table.rows, load.value * load.factor(scene.last_time))
        if name in table.loads:
            values = scales.get(name, 1.0) * table.columns[name]
        largest = float(values[np.abs(values).argmax()]) or 1.0
        ramp = [[0.0, 0.0], *([number + 1.0, float(value / largest)] for number, value in enumerate(values))]
        changes |= {f"loads.{name}.value": largest, f"loads.{name}.ramp": ramp}
    return scene.with_values(changes)


def _with_loads_of(table: Measured, scene: Scene) -> Scene:
    """With the table's loads in place of those of the scene that cannot be beside them."""
    replaced = {scene.load_kinds[name].instead_of for name in table.loads}
    loads = {name: load for name, load in scene.loads.items() if name not in replaced}
    new = {name: Load(value=1.0, ramp=((0.0, 0.0), (1.0, 1.0))) for name in table.loads if name not in loads}
    return scene.model_copy(update={"loads": loads | new})


class Kept:
    """Simulations on the way, which nobody hears: they stay, and get other numbers where a scene differs in no more."""

    def __init__(self, keys: Sequence[str]):
        self._may_stay = all(re.fullmatch(CAN_BE_SET, key) for key in keys)
        self._known: dict[Any, tuple[Simulation, Snapshot]] = {}

    def simulation(self, scene: Scene, table: Measured, has_own_cells: bool) -> Simulation:
        """At t = 0."""
        use = id(table), has_own_cells, scene.model.kinematics, scene.mesh.formulation
        if use in self._known:
            if self._may_stay and begin_again(*self._known[use], scene):
                return self._known[use][0]
            self._known.pop(use)[0].close()
        made = Simulation(scene, MPI.COMM_SELF)
        made.watchers = [one for one in made.watchers if not isinstance(one, WarnsOnce)]
        made.observer.columns = tuple(one for one in made.observer.columns if one.name in ("time", *table.sd))
        self._known[use] = made, made.state.snapshot()
        return made


def _run(
    scene: Scene, table: Measured, kept: Kept | None = None, start: tuple[Array, Array] | None = None
) -> tuple[dict[str, Array], tuple[Array, Array]]:
    """Columns and `time` of all steps; dimensions and axes of the cells at the end."""
    simulation = Simulation(scene, MPI.COMM_SELF) if kept is None else kept.simulation(scene, table, start is None)
    cells = simulation.cells
    try:
        if start is not None:
            cells.set(*start)
            simulation.state.settle_cells()
        rows = [step.row for step in simulation.steps()]
        end = cells.dimension_values.copy(), cells.axis_values.copy()
    finally:
        if kept is None:
            simulation.close()
    return {name: np.array([row[name] for row in rows]) for name in ("time", *table.sd)}, end


# ---------------------------------------------------------------- what was evaluated, a line each in a file
JOURNAL = "evaluations.jsonl"
LARGEST_JOURNAL = 10**9  # bytes

Point = tuple[float, ...]


class Journal:
    """The file in the folder of a fit, from which the same fit goes on; its first line says which fit it is."""

    def __init__(self, folder: Path):
        self.path, self._begun = folder / JOURNAL, False
        self.mark: str | None = None  # of the fit in the folder
        self.known: dict[Point, Array] = {}  # residuals (n,) of all points
        text = read_regular(self.path, LARGEST_JOURNAL).decode(errors="replace") if self.path.exists() else ""
        with suppress(ValueError):  # the last line may have been cut off
            for line in map(json.loads, text.splitlines()):
                if "at" in line:
                    self.known[tuple(map(float, line["at"]))] = np.array(line["residuals"], np.float64)
                else:
                    self.mark = str(line.get("fit"))

    def begin(self, mark: str) -> None:
        """Open the file for more, without a line that was cut off; what was evaluated before is there too."""
        check_no_link(self.path)
        self.path.write_text(json.dumps({"fit": mark}) + "\n", encoding="utf-8")
        self._begun = True
        for point, residuals in self.known.items():
            self.add(point, residuals)

    def add(self, point: Point, residuals: Array) -> None:
        """One line more; once the file is open it is on the disk when this returns."""
        if self._begun:
            with self.path.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"at": list(point), "residuals": residuals.tolist()}) + "\n")


def fingerprint(scene: Scene, unknowns: Sequence[Unknown], tables: Sequence[Measured]) -> str:
    """SHA-256 of all that a fit depends on but its starts."""
    said = [[t.name, t.state, t.time, t.sd, t.scaled, {n: v.tolist() for n, v in t.columns.items()}] for t in tables]
    text = json.dumps([__version__, PRECISE, scene.to_toml(), [list(vars(u).values()) for u in unknowns], said])
    return hashlib.sha256(text.encode()).hexdigest()


# ---------------------------------------------------------------- least squares
SCALE = "scale."  # what keys of factors on columns begin with
LOGARITHM_CHANGE = 1e-4  # of a logarithm: central differences err by 1e-8, those to one side by 1e-4
BLIND = 1e-7  # smallest singular value over the largest, below which the data say nothing: what differences err by
NAMED = 0.1  # share of a blind direction from which on an unknown is named
UNSOLVED = 1e3  # standard deviations, of all rows of a state that has no equilibrium
START_SPREAD = np.log(2.0)  # of further starts, to both sides
SAME_MINIMUM = 1e-2  # relative difference of the sums of squares
ENOUGH = 1e-6  # relative change of the sum of squares, or of the unknowns, at which a fit ends: noise is far above it
TELLING = 0.5  # of a change of the residuals: where a Jacobian misses more, the next is made by differences
CORRELATED = 0.9  # of two unknowns, from which on their profiles are made
PROFILE_STEP, PROFILE_REACH = 1.0, 4.0  # standard deviations of the straight line
ROUGHLY = 1e-4  # as ENOUGH, of a profile's fits, which start where a straight line has their end, and before the last
LIMITED_BY_MODEL = 1.5  # standard deviations that a model is off: the noise of ten rows alone is below 1.35 at 95 %
NORMAL_95 = 1.959963984540054  # standard deviations on each side, normal distribution


class Problem:
    """Residuals over their standard deviations as a function of the logarithms of the unknowns."""

    def __init__(
        self,
        scene: Scene,
        unknowns: Sequence[Unknown],
        tables: Sequence[Measured],
        journal: Journal | None = None,
    ):
        self.scene, self.unknowns, self.tables, self._journal = scene, list(unknowns), list(tables), journal
        self.known = {} if journal is None else journal.known
        self.bounds = np.log([[unknown.lower, unknown.upper] for unknown in unknowns])
        self.differences = 0  # Jacobians that were made
        self.kept = Kept([unknown.key for unknown in unknowns])

    def scene_of(self, logarithms: Array) -> Scene:
        """The scene with these numbers."""
        found = {u.key: float(np.exp(x)) for u, x in zip(self.unknowns, logarithms, strict=True)}
        return self.scene.with_values({key: value for key, value in found.items() if not key.startswith(SCALE)})

    def scales_of(self, logarithms: Array) -> dict[str, float]:
        """Factors on columns, by name."""
        pairs = zip(self.unknowns, logarithms, strict=True)
        return {u.key.removeprefix(SCALE): float(np.exp(x)) for u, x in pairs if u.key.startswith(SCALE)}

    def models(self, logarithms: Array, kept: Kept | None = None) -> list[dict[str, Array]]:
        """What the model says of each table."""
        scene, scales = self.scene_of(logarithms), self.scales_of(logarithms)
        return [model_of(scene, table, scales, kept) for table in self.tables]

    def residuals(self, logarithms: Array) -> Array:
        """Model less measurement over standard deviation, table by table; then the priors."""
        key = tuple(map(float, logarithms))
        if key not in self.known:
            with unsaid():
                self.known[key] = self._evaluated(np.array(logarithms))
            if self._journal is not None:
                self._journal.add(key, self.known[key])
        return self.known[key]

    def _evaluated(self, x: Array) -> Array:
        scales = self.scales_of(x)
        parts: list[Array] = []
        models: list[dict[str, Array]] | None = None
        with suppress(StepFailure, SceneError):  # numbers that do not go together have no equilibrium either
            models = self.models(x, self.kept)
        for number, table in enumerate(self.tables):
            for name, sd in table.sd.items():
                off = models[number][name] - scales.get(name, 1.0) * table.columns[name] if models else UNSOLVED * sd
                parts.append(np.full(table.rows, off / sd))
        for unknown, value in zip(self.unknowns, x, strict=True):
            if unknown.prior is not None and unknown.prior_sd is not None:
                parts.append(np.array([(value - np.log(unknown.prior)) / unknown.prior_sd]))
        return np.concatenate(parts)

    def jacobian(self, logarithms: Array, central: bool = False) -> Array:
        """Derivatives, (residuals, unknowns), by differences of runs."""
        self.differences += 1
        columns = []
        for k, way in enumerate(LOGARITHM_CHANGE * np.eye(len(logarithms))):
            ahead, behind = (np.clip(logarithms + side * way, *self.bounds.T) for side in (1, -1))
            if not central:
                behind, ahead = (logarithms, ahead) if ahead[k] > logarithms[k] else (behind, logarithms)
            columns.append((self.residuals(ahead) - self.residuals(behind)) / (ahead[k] - behind[k]))
        return np.transpose(columns)

    def check_tells_apart(self, jacobian: Array) -> None:
        """Refuse unknowns of which the data say nothing."""
        _, singular, directions = np.linalg.svd(jacobian, full_matrices=False)
        if singular[-1] > BLIND * singular[0]:
            return
        blind = directions[-1] * np.sign(directions[-1][np.abs(directions[-1]).argmax()])
        pairs = [(u.key, part) for u, part in zip(self.unknowns, blind, strict=True) if abs(part) > NAMED]
        named = [f"{key} ({part:+.2f})" for key, part in pairs]
        if len(named) == 1:
            raise SceneError(f"unknowns: {pairs[0][0]} changes nothing that is measured; fix it or give it a prior")
        raise SceneError(
            f"unknowns: the data cannot tell apart {', '.join(named)}: changed together by these powers of a factor "
            f"they give the same measurements; fix one of them or give it a prior"
        )


class NoStart(RemodelError):  # noqa: N818
    """A fit starts where the scene has no equilibrium."""

    exit_code = SOLVE_FAILED


class LostProcess(RemodelError):  # noqa: N818
    """A process of a fit was killed by somebody else."""

    exit_code = BAD_ENVIRONMENT


def fit(
    scene: Scene,
    data: Path | str,
    folder: Path | str | None = None,
    starts: int = 3,
    quiet: bool = True,
    profiles: bool = True,
    jobs: int | None = None,
) -> tuple[Path, Fit]:
    """Fit numbers of a scene to measurements."""
    if scene.cases:
        raise SceneError("cases: a fit takes one load case; leave out [[cases]]")
    random = np.random.default_rng(1)
    with ExitStack() as stack:
        line = stack.enter_context(Line(f"{scene.name} fit", quiet))
        with hold_log(quiet=quiet) as held:
            unknowns, tables = read_measurements(Path(data), scene)
            mark = fingerprint(scene, unknowns, tables)
            place, journal = _place(folder, f"{scene.name}-fit", mark)
            for words in (*explained(scene), scene.formulation_in_words()):
                log.info("%s", words)
            problem, first = Problem(scene, unknowns, tables, journal), np.log([u.start for u in unknowns])
            for words in problem.scene_of(first).warnings():
                log.warning("%s", words)
            line.show(f"the start, and derivatives there: {2 * len(unknowns) + 1} runs")
            try:
                at_start = problem.models(first)
            except StepFailure as failure:
                raise NoStart(f"at the start of the fit {failure}. {failure.refusal}; choose other starts") from failure
            for doubt in doubts(tables, at_start, scene):
                log.warning("%s", doubt)
            near = first, problem.jacobian(first, central=True)
            problem.check_tells_apart(near[1])
        points = [first, *(first + random.uniform(-START_SPREAD, START_SPREAD, len(first)) for _ in range(starts - 1))]
        stack.enter_context(RunLock(place))
        journal.begin(mark)
        stack.enter_context(open_log(place / "fit.log", quiet=quiet, held=held))
        pool = ProcessPoolExecutor(jobs or cores(), get_context("fork"), _begin_with, (problem,))
        stack.callback(_end, pool, active_children())

        def on_cores(tasks: Mapping[str, Callable[[Problem], Any]]) -> list[Any]:
            asked = [pool.submit(_told, *task) for task in tasks.items()]
            left, processes = set(asked), active_children()
            while left:
                left = wait(left, 0.5).not_done
                runs = journal.path.read_bytes().count(b"\n") - 1
                line.show(f"{runs} runs, {len(left)} of {len(asked)} left: {', '.join(tasks)}")
            try:
                answers = [one.result() for one in asked]
            except BrokenProcessPool as error:
                pool.shutdown()  # it has ended the others by SIGTERM
                codes = [one.exitcode for one in processes if one.exitcode]
                first = min(codes, key=lambda code: code == -signal.SIGTERM)
                raise LostProcess(
                    f"a process was ended by {signal.Signals(-first).name}, as where memory is short (--jobs 1 takes "
                    "less); all that is recorded is kept, the same command goes on"
                ) from error
            problem.known |= Journal(place).known
            return answers

        rough = partial(minimised, near=near, enough=ROUGHLY)
        found = on_cores({f"start {n}": partial(rough, start=x) for n, x in enumerate(points, start=1)})
        best = int(np.argmin([one.cost for one in found]))
        found[best] = on_cores({f"from the end of start {best + 1}": partial(minimised, start=found[best].x)})[0]
        log.info("sums of squares: %s", ", ".join(f"{2 * one.cost:.6g}" for one in found))
        result = result_of(problem, found)
        if profiles:
            result = with_profiles(problem, result, on_cores)
        log.info("%s", result.verdict())
        write_whole(place / "scene.toml", result.scene.to_toml(f"fitted to {Path(data).name}").encode())
        result.write(place)
    return place, result


_problem: Problem  # of a process


def _begin_with(problem: Problem) -> None:
    """A process of a fit, which has all that the fit knows, begins."""
    global _problem
    _problem = problem
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # it ends with its parent, which minds the other signals
    for number in (signal.SIGTERM, signal.SIGHUP, interrupts.PAUSE):
        signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _told(words: str, task: Callable[[Problem], Any]) -> Any:
    """What a task returns; what was evaluated for it stands in the journal, and the log counts it."""
    before, differences, begun = len(_problem.known), _problem.differences, clock.monotonic()
    answer = task(_problem)
    numbers = len(_problem.known) - before, clock.monotonic() - begun, _problem.differences - differences
    log.info("%s: %d runs in %.1f s; derivatives by differences at %d points", words, *numbers)
    return answer


def _end(pool: ProcessPoolExecutor, others: Sequence[Any]) -> None:
    """At once, whatever its processes do."""
    pool.shutdown(wait=False, cancel_futures=True)
    for process in set(active_children()).difference(others):
        process.kill()


def _place(folder: Path | str | None, name: str, mark: str) -> tuple[Path, Journal]:
    """The folder of the same fit, or a new one."""
    wanted = Path(folder or Path("results") / name)
    journal = Journal(wanted)
    if journal.mark == mark:
        return wanted, journal
    if journal.mark is not None and folder is not None:
        raise SceneError(f"folder {wanted}: holds a fit of another scene, data or version; choose another folder")
    place = chosen_folder(folder, name, MPI.COMM_SELF)
    return place, Journal(place)


@dataclass(frozen=True)
class LikelihoodProfile:
    """Smallest sums of squares with one unknown held."""

    values: Array
    increases: Array
    lower: float
    upper: float

    def in_words(self) -> str:
        """Its ends."""
        ends = ["beyond what was tried" if np.isnan(end) else f"{end:.5g}" for end in (self.lower, self.upper)]
        return " to ".join(ends)


def minimised(
    problem: Problem,
    start: Array,
    held: int | None = None,
    near: tuple[Array, Array] | None = None,
    enough: float = ENOUGH,
) -> Any:
    """SciPy's least squares from a start, logarithms."""
    # The Jacobian, by differences or that of a point `near`, is updated (Broyden 1965) as long as it tells what
    # residuals do: differences are made only where they pay
    from scipy.optimize import least_squares

    free = np.array([number != held for number in range(len(start))])
    bounds = problem.bounds[free].T

    def whole(x: Array) -> Array:
        found = start.copy()
        found[free] = x
        return found

    def jacobian(x: Array) -> Array:
        nonlocal near
        point, updated = whole(x), None
        if near is not None:
            step, change = point - near[0], problem.residuals(point) - problem.residuals(near[0])
            missed = change - near[1] @ step
            if np.linalg.norm(missed) <= TELLING * np.linalg.norm(change):
                updated = near[1] + np.outer(missed, step) / max(float(step @ step), 1e-300)
        near = point, problem.jacobian(point) if updated is None else updated
        return near[1][:, free]

    inside = np.clip(start[free], bounds[0] + 1e-6, bounds[1] - 1e-6)
    return least_squares(
        lambda x: problem.residuals(whole(x)), inside, jacobian, bounds, x_scale="jac", xtol=enough, ftol=enough
    )


def _half_profile(
    problem: Problem, best: Array, jacobian: Array, way: Array, number: int, inflation: float
) -> tuple[list[tuple[float, float]], float]:
    """Of an unknown, from the minimum one way until the band ends: points, and the end."""
    least, x, points = float(np.sum(problem.residuals(best) ** 2)), best, [(float(best[number]), 0.0)]
    ends = problem.bounds[number]
    for _ in range(round(PROFILE_REACH / PROFILE_STEP)):
        x = x + way
        x[number] = np.clip(x[number], *ends)
        if len(x) > 1:
            others = np.arange(len(x)) != number
            x[others] = minimised(problem, x, held=number, near=(best, jacobian), enough=ROUGHLY).x
        points.append((float(x[number]), float(np.sum(problem.residuals(x) ** 2)) - least))
        if points[-1][1] > (inflation * NORMAL_95) ** 2:  # the root is nearly a straight line
            (inner, low), (outer, high) = points[-2:]
            roots = np.sqrt([max(low, 0.0), high])
            return points, float(np.exp(np.interp(inflation * NORMAL_95, roots, [inner, outer])))
        if x[number] in ends:
            return points, float(np.exp(x[number]))
    return points, float("nan")


def result_of(problem: Problem, found: Sequence[Any]) -> Fit:
    """The best of several minima, with bands."""
    logarithms: Array = min(found, key=lambda one: float(one.cost)).x
    jacobian = problem.jacobian(logarithms, central=True)
    problem.check_tells_apart(jacobian)
    misfit = float(np.sqrt(np.mean(problem.residuals(logarithms) ** 2)))
    return Fit(
        problem.unknowns,
        logarithms,
        problem.bounds,
        np.asarray(np.linalg.inv(jacobian.T @ jacobian), np.float64),
        misfit,
        [2 * float(one.cost) for one in found],
        len(problem.known),
        problem.models(logarithms),
        problem.scene_of(logarithms),
        problem.tables,
    )


def with_profiles(problem: Problem, found: Fit, on_cores: Callable[[Mapping[str, Any]], list[Any]]) -> Fit:
    """The fit with profiles of what goes together: the others are fitted again at each value."""
    best = found.logarithms
    numbers = np.flatnonzero((np.abs(found.correlations) > CORRELATED).sum(axis=0) > 1)
    tasks, half = {}, partial(_half_profile, best=best, jacobian=problem.jacobian(best, central=True))
    for number, side in product(numbers, (-1, 1)):
        way = side * PROFILE_STEP * found.inflation * found.covariance[:, number] / found.deviations[number]
        task = partial(half, way=way, number=int(number), inflation=found.inflation)
        tasks[f"profile of {found.unknowns[number].key}, {'down' if side < 0 else 'up'}wards"] = task
    halves, profiles = on_cores(tasks), {}
    for number, (down, lower), (up, upper) in zip(numbers, halves[::2], halves[1::2], strict=True):
        values, increases = np.array(sorted([*down, *up[1:]])).T
        profiles[found.unknowns[number].key] = LikelihoodProfile(np.exp(values), increases, lower, upper)
    return replace(found, profiles=profiles)


# ---------------------------------------------------------------- the answer
@dataclass(frozen=True)
class Fit(Answer):
    """What a fit has found."""

    unknowns: list[Unknown]
    logarithms: Array
    bounds: Array
    covariance: Array  # of the logarithms, by the noise alone
    misfit: float
    minima: list[float]
    runs: int
    modelled: list[dict[str, Array]]
    scene: Scene
    tables: list[Measured]
    profiles: dict[str, LikelihoodProfile] = field(default_factory=dict)

    name = "fit"
    caption = "Points: measured, with one standard deviation; lines: the fitted model. A panel is a protocol."

    @property
    def title(self) -> str:
        """Of the picture."""
        return f"{self.scene.name}: measured and fitted"

    @property
    def keys(self) -> list[str]:
        """Of the unknowns."""
        return [unknown.key for unknown in self.unknowns]

    @property
    def values(self) -> Array:
        """Of the unknowns."""
        return np.exp(self.logarithms)

    @property
    def deviations(self) -> Array:
        """Standard deviations of the logarithms, by the noise alone."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlations(self) -> Array:
        """Of the logarithms."""
        return np.asarray(self.covariance / np.outer(self.deviations, self.deviations))

    @property
    def inflation(self) -> float:
        """What widens the bands: the misfit, where it says that the model and not the noise limits them."""
        return self.misfit if self.misfit > LIMITED_BY_MODEL else 1.0

    @property
    def _band(self) -> Array:
        """Ends of the logarithms, (2, n), not beyond the bounds."""
        half = NORMAL_95 * self.inflation * self.deviations
        return np.clip([self.logarithms - half, self.logarithms + half], *self.bounds.T[:, None])

    @property
    def lower(self) -> Array:
        """Ends of the bands."""
        return np.exp(self._band[0])

    @property
    def upper(self) -> Array:
        """Ends of the bands."""
        return np.exp(self._band[1])

    @property
    def open(self) -> list[str]:
        """Which ends of each band are bounds: nothing, lower, upper or both."""
        return [("", "lower", "upper", "both")[low + 2 * high] for low, high in self._band.T == self.bounds]

    @property
    def limited_by(self) -> str:
        """What limits the bands."""
        return "noise" if self.inflation == 1.0 else "model"

    def table(self) -> dict[str, Any]:
        """A row for each unknown."""
        table = {"key": self.keys, "value": self.values, "lower": self.lower, "upper": self.upper, "open": self.open}
        table["limited_by"] = [self.limited_by] * len(self.keys)
        for end in ("lower", "upper"):
            table[f"profile_{end}"] = [getattr(self.profiles.get(key), end, np.nan) for key in self.keys]
        return table | {"start": [unknown.start for unknown in self.unknowns]}

    def lines(self) -> list[str]:
        """A row for each unknown, and its profile."""
        width = max(len(key) for key in self.keys)
        lines = [f"{'':{width}} {'fitted':>12} {'95 % from':>12} {'to':>12} {'start':>12}"]
        for u, ends, *row in zip(self.unknowns, self.open, self.values, self.lower, self.upper, strict=True):
            line = f"{u.key:{width}} {' '.join(f'{value:12.5g}' for value in (*row, u.start))}"
            line += f"  at the bound: {ends}" if ends else ""
            lines.append(line + ("  limited by the model, not the noise" if self.limited_by == "model" else ""))
        return lines + [f"profile of {key}: 95 % from {one.in_words()}" for key, one in self.profiles.items()]

    def verdict(self) -> str:
        """How far the model is off, how many starts agree, and which unknowns go together."""
        least, keys = min(self.minima), self.keys
        same = sum(one - least <= SAME_MINIMUM * max(least, 1.0) for one in self.minima)
        text = f"The model is off by {self.misfit:.2g} standard deviations (root mean square); "
        text += f"{same} of {len(self.minima)} starts end in this minimum."
        if self.limited_by == "model":
            text += f" Bands are {self.misfit:.2g} times those of the noise, for the model limits them."
        pairs = np.argwhere(np.triu(np.abs(self.correlations) > CORRELATED, 1))
        together = [f"{keys[i]} and {keys[j]} ({self.correlations[i, j]:+.2f})" for i, j in pairs]
        if together:
            text += f" Correlated above {CORRELATED:g}, so that profiles count, not bands: {', '.join(together)}."
        away = np.abs(self.bounds - self.logarithms[:, None]).min(axis=1)
        edges = [key for key, distance in zip(keys, away, strict=True) if distance < 1e-3]
        return text + (f" At the edge of what is allowed: {', '.join(edges)}." if edges else "")

    def write(self, folder: Path) -> None:
        """Write tables and picture."""
        super().write(folder)
        notes = [self.title, made_with()]
        if self.profiles:
            rows = [
                (k, *row) for k, one in self.profiles.items() for row in zip(one.values, one.increases, strict=True)
            ]
            columns = dict(zip(("key", "value", "increase"), zip(*rows, strict=True), strict=True))
            Page(folder, "profiles").save_table(columns, notes)
        correlations = dict(zip(self.keys, self.correlations, strict=True))
        Page(folder, "correlations").save_table({"key": self.keys, **correlations}, notes)

    def figure(self) -> Figure:
        """A panel for each protocol, and in it for each unit; each column over what was prescribed along its axis."""
        shown: list[tuple[Any, ...]] = []
        for table, modelled in zip(self.tables, self.modelled, strict=True):
            units: dict[str, list[str]] = {}
            for name in table.sd:
                units.setdefault(self._label(table, name).partition(", ")[2], []).append(name)
            parts, title = table.protocols, f"{Path(table.name).name} ({table.state})"
            for number, (rows, names) in enumerate(product(parts, units.values()), start=1):
                which = f", protocol {-(-number // len(units))} of {len(parts)}" if len(parts) > 1 else ""
                shown.append((table, modelled, names, rows, title + which))
        figure, grid = panels(len(shown), 2.6)
        for axes, (*panel, title) in zip(grid, shown, strict=True):
            self._draw(axes, *panel)
            axes.set_title(title, fontsize=8)
        return figure

    def _label(self, table: Measured, name: str) -> str:
        return label(self.scene, name, table.units.get(name, ("", 1.0))[0])

    def _draw(
        self, axes: Any, table: Measured, modelled: Mapping[str, Array], names: list[str], rows: NDArray[np.int64]
    ) -> None:
        scales = dict(zip(self.keys, self.values, strict=True))

        def in_unit(values: Any, name: str, scale: float = 1.0) -> Array:
            return np.asarray(scale * values / table.units.get(name, ("", 1.0))[1])

        unit = self._label(table, names[0]).partition(", ")[2]
        for name, color in zip(names, cycle(COLOURS)):
            x, y = (
                in_unit(table.columns[one][rows], one, scales.get(f"{SCALE}{one}", 1.0))
                for one in (table.over(name), name)
            )
            axes.errorbar(
                x,
                y,
                in_unit(table.sd[name], name),
                fmt="o",
                color=color,
                label=label(self.scene, name).partition(", ")[0],
            )
            axes.plot(x, in_unit(modelled[name][rows], name), color=color)
        over = dict.fromkeys(self._label(table, table.over(name)) for name in names)
        axes.plot([], [], color="0.3", label="fitted model")
        axes.set(xlabel=" and ".join(over), ylabel=self._label(table, names[0]) if len(names) == 1 else unit)
        axes.legend(fontsize=7)
