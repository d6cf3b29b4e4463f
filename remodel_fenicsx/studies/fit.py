"""Command `fit`: identification of parameters from measurements, with confidence intervals."""

from __future__ import annotations

import hashlib
import json
import logging
import pickle
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise, zip_longest
from operator import attrgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from matplotlib.figure import Figure
from mpi4py import MPI
from pydantic import Field, model_validator

from remodel_fenicsx._version import __version__
from remodel_fenicsx.body.reductions import describe_choice
from remodel_fenicsx.model.cells import turned_about_z
from remodel_fenicsx.errors import BAD_ENVIRONMENT, SOLVE_FAILED, RemodelError, UnreadableFile
from remodel_fenicsx.results.run_folder import chosen_folder
from remodel_fenicsx.results.recording import RunLock
from remodel_fenicsx.scene.scene import Scene, SceneError
from remodel_fenicsx.schema.settings import Load
from remodel_fenicsx.schema.tables import Table, format_value, listed, validation_error
from remodel_fenicsx.schema.text import read_columns, read_toml
from remodel_fenicsx.schema.units import (
    AREA,
    FORCE,
    LENGTH,
    LENGTH_UNIT,
    STRESS,
    STRESS_UNIT,
    TENSION,
    convention_doubt,
    factor_to_scene,
    scene_units,
)
from remodel_fenicsx.initial import resolve_auto_settings
from remodel_fenicsx.model.tensors import Array, Integers
from remodel_fenicsx.simulation import Simulation, reset_simulation
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.state import Snapshot
from remodel_fenicsx.studies.study import (
    COLOURS,
    StudyResult,
    Page,
    Run,
    Study,
    dimensions,
    label,
    made_with,
    panels,
)
from remodel_fenicsx.system.children import PART
from remodel_fenicsx.system.files import ForeignFileError, check_no_link, read_regular, write_whole
from remodel_fenicsx.system.terminal import buffer_log, open_log, muted_warnings
from remodel_fenicsx.unloading import PASSIVE
from remodel_fenicsx.watch.warnings import WarnsOnce

if TYPE_CHECKING:
    from numpy.typing import ArrayLike
    from scipy.optimize import OptimizeResult

log = logging.getLogger(__name__)

Columns = dict[str, Array]


# ---------------------------------------------------------------- data, checked before any solve
LARGEST_TABLE = 10**7  # bytes: a hundred thousand rows
DIMENSIONS = {"stress": STRESS, "length": LENGTH, "force": FORCE}
PROTOCOL = "protocol"  # the column of labels of protocols
NOT_MEASURED = set(
    (
        "max_chain_extension min_jacobian stored_energy remodeling_power newton_iterations "
        "linear_iterations substeps seconds pass_residual time_error negative_eigenvalues "
        "inactive_fraction asleep_share cpu_seconds processor_seconds turnover_power"
    ).split()
)
SCALE = "scale."  # prefix of the keys of factors on columns
SCALE_BOUNDS = (1e-3, 1e3)  # bounds of factors on columns
LEAST_SD = 1e-4  # of a column's range: an instrument is accurate to a thousandth of its range
WIDE = 1e3  # default bound over the start
# Distance of a logarithm from the end of a key's range, because derivatives need the values at
# `LOGARITHM_CHANGE` on both sides.
FROM_EDGE = 5e-4


# ---------------------------------------------------------------- tables of DATA.toml
Positive = Annotated[float, Field(gt=0)]
_Number = Annotated[
    Positive | None, Field(json_schema_extra={"allowed": "a finite number greater than 0"})
]
_Values = str | float | list[str | float]


class Unknown(Table):
    """An entry of [unknowns]: a positive parameter; its logarithm is fitted."""

    start: float = Field(gt=0)
    lower: _Number = None
    upper: _Number = None
    prior: _Number = None
    prior_sd: _Number = None

    @model_validator(mode="after")
    def _go_together(self) -> Unknown:
        lower, upper = self.bounds
        if not lower <= self.start <= upper or lower == upper:
            raise validation_error(
                f"must lie between lower {lower:g} and upper {upper:g}", "start", self.start
            )
        if (self.prior is None) != (self.prior_sd is None):
            raise validation_error(
                "prior and prior_sd (of the logarithm) go together", "prior", self.prior
            )
        return self

    @property
    def bounds(self) -> tuple[float, float]:
        """Lower and upper bound; by default a thousandth and a thousand times the start."""
        return self.lower or self.start / WIDE, self.upper or self.start * WIDE


class MeasuredTable(Table):
    """A table [[measured]] of DATA.toml."""

    file: str
    state: Literal["virgin", "history", "after"] = "virgin"
    time: _Number = None
    sd: dict[str, Positive] = Field(
        default={},
        json_schema_extra={"allowed": "numbers greater than 0, as in { outer_radius = 0.03 }"},
    )
    scale: dict[str, Literal["unknown"]] = Field(
        default={}, json_schema_extra={"allowed": "'unknown', as in { pressure = 'unknown' }"}
    )
    units: dict[str, str] = Field(
        default={}, json_schema_extra={"allowed": "units, as in { pressure = 'mmHg' }"}
    )
    columns: dict[str, str] = Field(
        default={}, json_schema_extra={"allowed": "headers of the file, as in { pressure = 'P' }"}
    )
    rows: Literal["all", "loading", "last loading"] | dict[str, _Values] = Field(
        default="all",
        json_schema_extra={
            "allowed": "'all', 'loading', 'last loading', or a table of headers with their values"
        },
    )
    protocols: tuple[int, ...] = Field(
        default=(), strict=False, json_schema_extra={"allowed": "numbers of protocols to fit"}
    )
    area: Annotated[_Number, AREA] = None
    length: Annotated[_Number, LENGTH] = None
    thickness: Annotated[_Number, LENGTH] = None
    drive: tuple[str, ...] = Field(
        default=(), strict=False, json_schema_extra={"allowed": "names of columns of loads"}
    )

    @model_validator(mode="after")
    def _go_together(self) -> MeasuredTable:
        if (self.time is not None) != (self.state == "after"):
            raise validation_error(
                "must be given if and only if state = 'after': the tissue remodels until then",
                "time",
                self.time,
            )
        return self


class DataFile(Table):
    """The data file of a fit, DATA.toml."""

    unknowns: dict[str, Unknown] = Field(
        min_length=1,
        json_schema_extra={"allowed": 'a table of keys, as "material.lame_mu" = { start = 10.0 }'},
    )
    measured: tuple[MeasuredTable, ...] = Field(
        min_length=1,
        strict=False,
        json_schema_extra={"allowed": "tables [[measured]], each with a file"},
    )


# ---------------------------------------------------------------- data with their scene
@dataclass(frozen=True)
class Measured:
    """A table of measurements in the scene's units."""

    name: str
    state: str
    time: float
    columns: Columns
    loads: tuple[str, ...]
    sd: dict[str, float]
    scaled: tuple[str, ...]
    # The file's units that differ from the scene's, with their factors to the scene's units.
    units: dict[str, tuple[str, float]]
    is_fitted: bool = True  # or only predicted

    @property
    def rows(self) -> int:
        """Number of rows of the table."""
        return len(next(iter(self.columns.values())))

    def over(self, name: str) -> str:
        """Return a measured column's abscissa: the load along its axis, the first load, or time."""
        same = [load for load in self.loads if load.rpartition("_")[2] == name.rpartition("_")[2]]
        return [*same, *self.loads, "time"][0]

    @property
    def protocols(self) -> dict[int, Integers]:
        """Rows of each protocol, by its number."""
        number = self.columns[PROTOCOL]
        return {int(one): np.flatnonzero(number == one) for one in np.unique(number)}


def read_measurements(path: Path, scene: Scene) -> tuple[dict[str, Unknown], list[Measured]]:
    """Read DATA.toml and check it with a scene; return unknowns by key, with bounds, and tables."""
    units = {STRESS_UNIT: scene.material.stress_unit, LENGTH_UNIT: scene.geometry.length_unit}
    with scene_units(units):
        data = DataFile(**read_toml(path))
        measured = [
            part
            for number, table in enumerate(data.measured)
            for part in _measured(table, f"measured[{number}]", path.parent, scene)
        ]
    starts = {key: unknown.start for key, unknown in data.unknowns.items()}
    scene.with_values(starts)  # raises for unknown keys, invalid numbers and combinations
    unknowns = {
        key: _bounded(key, unknown, scene, starts) for key, unknown in data.unknowns.items()
    }
    for name in (name for table in measured for name in table.scaled):
        unknowns[f"{SCALE}{name}"] = Unknown(
            start=1.0, lower=SCALE_BOUNDS[0], upper=SCALE_BOUNDS[1]
        )
    if len(unknowns) > sum(table.rows * len(table.sd) for table in measured if table.is_fitted):
        raise SceneError(f"unknowns: {len(unknowns)} unknowns need at least as many measurements")
    return unknowns, measured


def _bounded(key: str, unknown: Unknown, scene: Scene, starts: Mapping[str, float]) -> Unknown:
    """Return an unknown with its bounds, or the last numbers before them in the key's range."""

    def allowed(logarithm: float) -> bool:
        # The start times a factor is allowed alone, or if all unknowns have the same factor, with
        # which a wall keeps its shape, or if another one is small, as of fractions with a sum.
        number = float(np.exp(logarithm))
        moved = {other: start * number / unknown.start for other, start in starts.items()}
        small = [{**starts, other: start / WIDE} for other, start in starts.items()]
        for values in (starts, moved, *small):
            with suppress(SceneError):
                return bool(scene.with_values({**values, key: number}))
        return False

    ends = []
    for bound, end in zip((unknown.lower, unknown.upper), unknown.bounds, strict=True):
        inside, outside = np.log([unknown.start, end])
        if bound is not None and not allowed(outside):
            scene.with_values({**starts, key: bound})  # raises for the bound in DATA.toml
        back = FROM_EDGE * np.sign(inside - outside)
        if not allowed(outside - back):
            while abs(outside - inside) > FROM_EDGE:
                middle = (inside + outside) / 2
                inside, outside = (middle, outside) if allowed(middle - back) else (inside, middle)
            end = float(np.exp(inside))
        ends.append(end)
    if not ends[0] < ends[1]:
        raise SceneError(
            f"unknowns.{key}: the scene takes no other number than {unknown.start:g}, so it "
            "cannot be fitted"
        )
    return unknown.model_copy(update=dict(zip(("lower", "upper"), ends, strict=True)))


def _measured(table: MeasuredTable, place: str, folder: Path, scene: Scene) -> Iterator[Measured]:
    """Yield the rows to fit, and those to predict, in the scene's units."""
    on = [f"remodeling.{one.name}" for one in scene.remodeling.processes if one.is_on]
    if table.state == "after" and on:
        raise SceneError(
            f"{place}.state = 'after': takes cells alone, not what {on[0]} has changed"
        )
    file = f"{place}.file = {format_value(table.file)}"
    columns, units = _read_columns(table, folder, place, scene)
    labels = columns.pop(PROTOCOL, None)
    loads = _prescribed(columns, table, scene, place)
    _check_columns(columns, loads, table.state, file, scene)
    for key in ("sd", "scale"):
        for name in getattr(table, key):
            if name not in columns or name == "time":
                raise SceneError(
                    f"{place}.{key}.{name}: no such column is measured; the file has "
                    f"{', '.join(columns)}"
                )
    for name in columns:
        if (name in loads or name == "time") == (name in table.sd):
            rule = (
                "is prescribed, not measured"
                if name in table.sd
                else "missing: each measured column needs a standard deviation"
            )
            raise SceneError(f"{place}.sd.{name}: {rule}")
        sd, extent = table.sd.get(name, np.inf), np.ptp(columns[name])
        if sd < LEAST_SD * extent:
            words = f"sd = {sd:.3g}, far below its range {extent:.3g}; is it in the scene's unit?"
            log.warning("%s, %s: %s", table.file, name, words)
    rows, numbers = _rows(columns, loads, labels, table)
    if others := {*table.protocols} - {*numbers}:
        known = ", ".join(map(str, np.unique(numbers)))
        raise SceneError(f"{place}.protocols = {min(others)}: no such protocol; there are {known}")
    fitted = np.isin(numbers, table.protocols or numbers)
    columns[PROTOCOL] = numbers.astype(np.float64)
    for is_fitted in (True, False):
        if (kept := rows[fitted[rows] == is_fitted]).size:
            yield Measured(
                table.file,
                table.state,
                table.time or 0.0,
                {name: values[kept] for name, values in columns.items()},
                loads,
                table.sd,
                tuple(table.scale),
                units,
                is_fitted,
            )


def _rows(
    columns: Columns, loads: tuple[str, ...], labels: Array | None, table: MeasuredTable
) -> tuple[Integers, Integers]:
    """Return the chosen rows, and the numbers of the protocols of all rows; log hysteresis."""
    sizes = [np.abs(columns[name]) / (np.abs(columns[name]).max() or 1.0) for name in loads]
    size = np.max([np.zeros(len(next(iter(columns.values())))), *sizes], axis=0)
    # Without labels loads decrease by over half between two protocols.
    jumps = 1 + np.cumsum(np.diff(size, prepend=0.0) < -0.5)
    number: Integers = (jumps if labels is None else labels).astype(np.int64)
    chosen, gaps = list[Integers](), dict.fromkeys(table.sd, 0.0)
    for one in np.unique(number):
        rows = np.flatnonzero(number == one)
        parts = [rows[part] for part in _cycles(size[rows])]
        of_loading = {"loading": parts[::2], "last loading": parts[-2::2]}
        chosen += of_loading.get(str(table.rows), [rows])
        up, down = parts[-2], parts[-1][np.argsort(size[parts[-1]])]
        for name, gap in gaps.items() if len(down) > 2 else ():
            unloaded = np.interp(size[up], size[down], columns[name][down])
            gaps[name] = max(gap, abs(np.mean(columns[name][up] - unloaded)) / table.sd[name])
    log.info("%s: %d of %d rows are used", table.file, sum(map(len, chosen)), len(size))
    for name, gap in gaps.items():
        if gap > 1.0:
            words = "loading and unloading differ by %.2g standard deviations on average"
            remedy = "the model has no hysteresis"
            remedy += "; rows = 'last loading' takes loading alone" * (table.rows == "all")
            log.warning(f"%s, %s: {words}; {remedy}", table.file, name, gap)
    return np.concatenate(chosen), number


def _cycles(size: Array) -> list[Integers]:
    """Return the rows of each loading and unloading, in turns, from the size of the loads."""
    half, turns = np.ptp(size) / 2, [0]
    for row, present in enumerate(size):
        further = (present - size[turns[-1]]) * (-1) ** len(turns)
        if further >= 0:
            turns[-1] = row
        elif further < -half:
            turns.append(row)
    turns += [len(size) - 1] * max(3 - len(turns), 1 - len(turns) % 2)
    return [np.arange(first, last + 1) for first, last in pairwise(turns)]


def _prescribed(
    columns: Columns, table: MeasuredTable, scene: Scene, place: str
) -> tuple[str, ...]:
    """Return the loads that drive the test; the strain if an axis has both force and strain."""
    kinds = scene.load_kinds
    for name in table.drive:
        if name not in columns or name not in kinds:
            known = ", ".join(column for column in columns if column in kinds)
            raise SceneError(
                f"{place}.drive = {format_value(name)}: must be columns of loads: {known}"
            )
    if table.drive:
        return table.drive
    loads = [
        name for name in columns if name in scene.loads or (name in kinds and kinds[name].replaces)
    ]
    return tuple(
        name for name in loads if kinds[name].dimension is None or kinds[name].replaces not in loads
    )


def _factor(
    name: str, unit: str, table: MeasuredTable, place: str, scene: Scene
) -> tuple[float, str]:
    """Return the factor to the scene's unit, and the key by whose value it is divided, or ""."""
    own = dimensions(scene).get(name, "")
    if unit == "%" and not own:
        return 0.01, ""
    choices = {"": DIMENSIONS[own]} if own in DIMENSIONS else {}
    if "nominal_stress" in name:
        choices |= {"area": FORCE, "thickness": TENSION}
    elif re.search("elongation|stretch|shear", name):
        choices |= {"length": LENGTH}
    problems = [] if choices else [f"{name} takes no unit"]
    for key, dimension in choices.items():
        try:
            factor = factor_to_scene(unit, dimension)
        except ValueError as error:
            problems.append(str(error))
            continue
        if (by := getattr(table, key) if key else 1.0) is None:
            raise SceneError(f"{place}: needs the key {key!r}, by which the column is divided")
        return factor / by, key
    raise SceneError(f"{place}: {'; '.join(problems)}")


def _read_columns(
    table: MeasuredTable, folder: Path, place: str, scene: Scene
) -> tuple[Columns, dict[str, tuple[str, float]]]:
    """Read the columns in the scene's units, and the units of those that have others."""
    file, path = f"{place}.file = {format_value(table.file)}", folder / table.file
    stretches = [load.replace("elongation", "stretch") for load in scene.load_kinds]
    known = dict.fromkeys([*scene.loads, *dimensions(scene), *stretches, "time", PROTOCOL])
    allowed = [name for name in known if name not in NOT_MEASURED]
    for key in table.columns:
        if key not in allowed:
            raise SceneError(
                f"{place}.columns.{key}: unknown column; allowed: {listed(allowed, key)}"
            )
    chosen = table.rows if isinstance(table.rows, dict) else {}
    values_of = {name: one if isinstance(one, list) else [one] for name, one in chosen.items()}
    try:
        data = read_regular(path, LARGEST_TABLE)
        columns = read_columns(
            data,
            path.name,
            allowed,
            headers=table.columns,
            chosen=values_of,
            labels=PROTOCOL,
        )
    except (OSError, ForeignFileError, UnreadableFile) as error:
        raise SceneError(f"{file}: {getattr(error, 'strerror', None) or error}") from error
    units = {}
    for name, unit in table.units.items():
        key = f"{place}.units.{name}"
        if name not in columns:
            raise SceneError(
                f"{key}: no such column is measured; the file has {', '.join(columns)}"
            )
        factor, by = _factor(name, unit, table, f"{key} = {format_value(unit)}", scene)
        columns[name] *= factor
        if name in table.sd:
            words = f"its standard deviation is {table.sd[name]:g} in the scene's unit"
            log.info("%s, %s: %s, %.3g %s", path.name, name, words, table.sd[name] / factor, unit)
        if not by:
            units[name] = unit, factor
    # These warnings come before any solve, which may fail because of their cause.
    mmhg = factor_to_scene("mmHg", STRESS)
    if scene.material.lame_mu < mmhg:  # softer than any vessel: numbers without units
        mmhg = np.nan
    for name in {*columns} & {*stretches, *scene.load_kinds} - {*table.scale}:
        if words := convention_doubt(name, columns[name], mmhg):
            log.warning("%s, %s: %s", path.name, name, words)
    for name in [*columns]:
        load = re.sub("stretch|green_strain", "elongation", name)
        if load == name or load not in scene.load_kinds or name in table.sd:
            continue
        if load in columns:
            raise SceneError(f"{file}: has both {name} and {load}")
        values = columns.pop(name)
        columns[load] = (np.sqrt(1.0 + 2.0 * values) if "green" in name else values) - 1.0
    return columns, units


def _check_columns(
    columns: Columns, loads: tuple[str, ...], state: str, place: str, scene: Scene
) -> None:
    if set(columns) <= {*loads, "time"}:
        raise SceneError(f"{place}: has no measured column")
    if state == "history":
        if "time" not in columns:
            raise SceneError(f"{place}: needs a column 'time', because state = 'history'")
        if loads:
            raise SceneError(
                f"{place}: {loads[0]}: state = 'history' takes the scene's loads; remove it"
            )
        if scene.time.is_equilibrium or not (
            0 <= columns["time"].min() <= columns["time"].max() <= scene.last_time
        ):
            raise SceneError(f"{place}: column time: must lie between 0 and the scene's time.end")
    elif not loads:
        raise SceneError(
            f"{place}: state = {state!r} needs a column of a load: {', '.join(scene.loads)}"
        )


def _unloaded(scene: Scene, table: Measured, name: str) -> tuple[Array, ArrayLike]:
    """Return a column at the smallest load, and the model's without forces; NaN if it fails."""
    sizes = [np.abs(table.columns[load]) for load in table.loads or ("time",)]
    row = int(np.argmin(sum(size / (size.max() or 1.0) for size in sizes)))
    kinds, value = scene.load_kinds, table.columns[name][row]
    loads = {load: table.columns[load][[row]] for load in table.loads}
    loads |= {load: np.zeros(1) for load in (*scene.loads, *loads) if kinds[load].dimension}
    with muted_warnings(), suppress(StepFailure, SceneError):
        alone = replace(table, state="virgin", columns=loads, loads=tuple(loads))
        return value, model_of(scene, alone, {})[name]
    return value, np.nan


def data_warnings(
    tables: Sequence[Measured], modelled: Sequence[Columns], scene: Scene
) -> Iterator[str]:
    """Yield warnings of measured columns that may have another convention than the model."""
    units = dimensions(scene)
    for table, model in zip(tables, modelled, strict=True):
        for name in sorted({*table.sd} - {*table.scaled}):
            is_length = units[name] == "length"
            pair = (
                _unloaded(scene, table, name) if is_length else (table.columns[name], model[name])
            )
            if words := convention_doubt(f"{name} ({units[name]})", *pair):
                yield f"{table.name}, {name}: {words}"


# ---------------------------------------------------------------- model values at measurements
# Keys whose numbers an existing simulation can take (`reset_simulation`).
TISSUE = r"(regions\.\w+\.)?(material\.[\w.]+|remodeling\.(kappa|half_life))"
OTHERS = r"loads\.\w+\.value|natural\.\w+"
CAN_BE_SET = rf"scale\..*|{TISSUE}|{OTHERS}"
OF_CELLS = r"cells\.(fraction_[xy]|mean_angle)"  # for runs whose cells are set
# With these tolerances only rounding errors are amplified by difference quotients of runs.
PRECISE = {"solver.relative_tolerance": 1e-13, "solver.absolute_tolerance": 0.0}


def model_of(
    scene: Scene, table: Measured, scales: Mapping[str, float], kept: SimulationCache | None = None
) -> Columns:
    """Compute the model's values at the measurements of a table, (rows,), by column."""
    changes = PRECISE | {"output.columns": [*table.sd], "output.times": [], "output.fields": False}
    scene = resolve_auto_settings(scene.with_values(changes))
    if table.state == "history":
        measured, step = table.columns["time"], scene.time.step
        end = max(float(step * np.ceil(measured.max() / step - 1e-9)), step)
        columns, _ = _run(scene.with_values({"time.end": end}), table, kept)
        return {name: np.interp(measured, columns["time"], columns[name]) for name in table.sd}
    start, cells = None, scene.cells
    if table.state == "after":
        _, start = _run(scene.with_values({"time.end": table.time}), table, kept)
    elif cells.axes == "global" and not (scene.regions or isinstance(cells.initial, str)):
        start = cells.dimensions(1), turned_about_z(np.eye(3), cells.mean_angle)
    columns, _ = _run(_passive(scene, table, scales), table, kept, start)
    return {name: columns[name][columns["time"] > 0] for name in table.sd}


def _passive(scene: Scene, table: Measured, scales: Mapping[str, float]) -> Scene:
    """Return the scene of a test: a step for each row, fixed cells, further loads constant."""
    # These loads exclude those of the table.
    replaced = {scene.load_kinds[name].replaces for name in table.loads}
    loads = {}
    for name in [
        name for name in dict.fromkeys((*scene.loads, *table.loads)) if name not in replaced
    ]:
        if name in table.loads:
            values = scales.get(name, 1.0) * table.columns[name]
        else:
            values = np.full(
                table.rows, scene.loads[name].value * scene.loads[name].factor(scene.last_time)
            )
        largest = float(values[np.abs(values).argmax()]) or 1.0
        ramp = (
            (0.0, 0.0),
            *((number + 1.0, float(value / largest)) for number, value in enumerate(values)),
        )
        loads[name] = Load(value=largest, ramp=ramp)
    changes = PASSIVE | {"time.step": 1.0, "time.end": float(table.rows)}
    return scene.model_copy(update={"loads": loads}).with_values(changes)


class SimulationCache(dict[object, tuple[Simulation, Snapshot]]):
    """Open simulations, without their warnings, for scenes that differ only in parameter values."""

    def __init__(self, keys: tuple[str, ...]):
        super().__init__()
        self.keys_of_scene = keys

    def __reduce__(self) -> tuple[object, ...]:
        return SimulationCache, (self.keys_of_scene,)  # each process builds its own simulations

    def simulation(self, scene: Scene, table: Measured, has_own_cells: bool) -> Simulation:
        """Return a simulation of the scene at t = 0, a cached one if possible."""
        use = id(table), has_own_cells, scene.model.kinematics, scene.mesh.formulation
        if use in self:
            can_be_set = CAN_BE_SET if has_own_cells else rf"{CAN_BE_SET}|{OF_CELLS}"
            if all(
                re.fullmatch(can_be_set, key) for key in self.keys_of_scene
            ) and reset_simulation(*self[use], scene):
                return self[use][0]
            self.pop(use)[0].close()
        new = Simulation(scene, MPI.COMM_SELF)
        new.watchers = [each for each in new.watchers if not isinstance(each, WarnsOnce)]
        new.observer.columns = tuple(
            column for column in new.observer.columns if column.name in ("time", *table.sd)
        )
        self[use] = new, new.state.snapshot()
        return new


def _run(
    scene: Scene,
    table: Measured,
    kept: SimulationCache | None = None,
    start: tuple[Array, Array] | None = None,
) -> tuple[Columns, tuple[Array, Array]]:
    """Return columns and `time` of all steps; dimensions and axes of the cells at the end."""
    simulation = (
        Simulation(scene, MPI.COMM_SELF)
        if kept is None
        else kept.simulation(scene, table, start is None)
    )
    cells = simulation.cells
    try:
        if start is not None:
            cells.set(*start)
            simulation.state.mark_cells_in_equilibrium()
        rows = [step.row for step in simulation.steps()]
        end = cells.dimension_values.copy(), cells.axis_values.copy()
    finally:
        if kept is None:
            simulation.close()
    return {name: np.array([row[name] for row in rows]) for name in ("time", *table.sd)}, end


# ---------------------------------------------------------------- journal of evaluated points
JOURNAL = "evaluations.jsonl"
LARGEST_JOURNAL = 10**9  # bytes

Point = tuple[float, ...]


def read_journal(folder: Path) -> tuple[str | None, dict[Point, Array]]:
    """Read a folder's fit: its fingerprint, None if there is none, and residuals by point."""
    path, mark = folder / JOURNAL, None
    known = dict[Point, Array]()
    text = read_regular(path, LARGEST_JOURNAL).decode(errors="replace") if path.exists() else ""
    with suppress(ValueError):  # The last line may be truncated.
        for line in map(json.loads, text.splitlines()):
            mark = mark or str(line.get("fit"))
            if "at" in line:
                known[tuple(map(float, line["at"]))] = np.array(line["residuals"], np.float64)
    return mark, known


def _line(point: Point, residuals: Array) -> str:
    return json.dumps({"at": list(point), "residuals": residuals.tolist()}) + "\n"


def fingerprint(problem: Problem) -> str:
    """Return the SHA-256 of everything that a fit depends on, except its starts."""
    parts = [__version__, PRECISE, problem.scene.to_toml(), problem.unknowns, problem.tables]
    text = json.dumps(
        parts, default=lambda part: part.tolist() if isinstance(part, np.ndarray) else vars(part)
    )
    return hashlib.sha256(text.encode()).hexdigest()


# ---------------------------------------------------------------- least squares
# Change of a logarithm: the error of central differences is 1e-8, of one-sided ones 1e-4.
LOGARITHM_CHANGE = 1e-4
# Smallest over largest singular value below which unknowns are not identifiable: the error of the
# differences.
SINGULAR_TOLERANCE = 1e-7
NAMED = 0.1  # smallest component of an unknown that is named in an unidentifiable direction
FAILED_RUN_RESIDUAL = 1e3  # standard deviations, for all rows of a state without equilibrium
START_SPREAD = np.log(2.0)  # largest distance of further starts from the first, in logarithms
SAME_MINIMUM = 1e-2  # relative difference of the sums of squares
# Relative change of the sum of squares, or of the unknowns, at which a fit ends. The noise is far
# above it.
FIT_TOLERANCE = 1e-6
# Largest error of a predicted change of the residuals, over the change. If it is larger, the next
# Jacobian is computed by differences.
TELLING = 0.5
# Smallest correlation of two unknowns that is named, and of an unknown with all others together
# for which its profile is computed.
CORRELATED = 0.9
PROFILE_END = 1e-2  # change of the end of an interval, over half of the interval, that is accepted
MAX_PROFILE_FITS = 15  # for one end of an interval
PROFILE_EXTRAPOLATION = 3.0  # over the distance of the two last points of a profile
# Smallest distance of a new point from both ends of a bracket, over its size. Without it, points
# do not leave a bound near which the unknown has no effect.
PROFILE_SHARE = 0.1
LOWER_MINIMUM = 0.1  # decrease of the sum of squares in a profile with which the fit continues
# Like FIT_TOLERANCE, for the fits of a profile and for all fits before the last.
PROFILE_TOLERANCE = 1e-4
# RMS of the normalised residuals. By the noise of ten rows alone it is below 1.35 at 95 %.
LIMITED_BY_MODEL = 1.5
# RMS of the normalised residuals of a column above which the model does not follow it. Models miss
# the shape of a curve by two or three standard deviations of a good instrument; with data in a
# wrong unit a fit ends above ten.
MISFIT = 5.0
FRACTION_MARGIN = 1e-12  # distance of a logarithm from the bound that the sum of fractions sets
NORMAL_95 = 1.959963984540054  # standard deviations on each side, normal distribution


class Problem:
    """Normalised residuals as a function of the logarithms of the unknowns."""

    def __init__(self, scene: Scene, unknowns: Mapping[str, Unknown], tables: Sequence[Measured]):
        self.scene, self.unknowns = scene, dict(unknowns)
        self.tables = list(tables)
        self.fitted = [table for table in tables if table.is_fitted]
        keys, self.bounds = [*unknowns], np.log([unknown.bounds for unknown in unknowns.values()])
        # Pairs of fractions, whose sum is at most 1. The bound of a single one is constant.
        pairs = [(key, f"{key[:-1]}y") for key in keys if key.endswith("cells.fraction_x")]
        numbers = [[keys.index(x), keys.index(y)] for x, y in pairs if y in keys]
        self.fractions = np.array(numbers, np.int64).reshape(-1, 2)
        self.bounds[:, 1] = self.upper(self.bounds[:, 0])
        self.known: dict[Point, Array] = {}
        self.journal: Path | None = None
        self.kept = SimulationCache(tuple(unknowns))

    def upper(self, logarithms: Array) -> Array:
        """Return the upper bound of each logarithm, (n,), if the others have these values."""
        upper, pairs = self.bounds[:, 1].copy(), self.fractions
        rest = np.log1p(-np.exp(logarithms[pairs[:, ::-1]])) - FRACTION_MARGIN
        upper[pairs] = np.minimum(upper[pairs], rest)
        return upper

    def begin(self, folder: Path, mark: str) -> None:
        """Start the journal in the folder with all evaluated points, without a truncated line."""
        self.journal = folder / JOURNAL
        check_no_link(self.journal)
        head = json.dumps({"fit": mark}) + "\n"
        self.journal.write_text(
            head + "".join(_line(*item) for item in self.known.items()), encoding="utf-8"
        )

    def start_near(self, first: Array, random: np.random.Generator) -> Array:
        """Draw a start within a factor of two, or of less where the scene takes no such numbers."""
        spread = START_SPREAD
        while True:
            point = first + random.uniform(-spread, spread, len(first))
            with suppress(SceneError):
                self.scene_of(np.clip(point, *self.bounds.T))
                return point
            spread *= 0.8

    def scene_of(self, logarithms: Array) -> Scene:
        """Return the scene with these parameters."""
        return self.scene.with_values(
            {key: n for key, n in self._numbers(logarithms) if not key.startswith(SCALE)}
        )

    def scales_of(self, logarithms: Array) -> dict[str, float]:
        """Return the factors on columns, by name."""
        return {
            key.removeprefix(SCALE): n
            for key, n in self._numbers(logarithms)
            if key.startswith(SCALE)
        }

    def _numbers(self, logarithms: Array) -> zip[tuple[str, float]]:
        return zip(self.unknowns, map(float, np.exp(logarithms)), strict=True)

    def predictions(
        self,
        logarithms: Array,
        kept: SimulationCache | None = None,
        tables: Sequence[Measured] | None = None,
    ) -> list[Columns]:
        """Compute the model's values at the measurements of tables, by default of all."""
        scene, scales = self.scene_of(logarithms), self.scales_of(logarithms)
        return [model_of(scene, table, scales, kept) for table in tables or self.tables]

    def residuals(self, logarithms: Array) -> Array:
        """Return (model - measurement) / standard deviation, table by table; then the priors."""
        key = tuple(map(float, logarithms))
        if key not in self.known:
            with muted_warnings():
                self.known[key] = self._evaluated(np.array(logarithms))
            if self.journal is not None:
                with self.journal.open("a", encoding="utf-8") as file:
                    file.write(_line(key, self.known[key]))
        return self.known[key]

    def _evaluated(self, x: Array) -> Array:
        scales, models = self.scales_of(x), list[Columns]()
        # Invalid combinations of numbers have no equilibrium either.
        with suppress(StepFailure, SceneError):
            models = self.predictions(x, self.kept, self.fitted)
        parts: list[ArrayLike] = []
        for table, model in zip_longest(self.fitted, models):
            for name, sd in table.sd.items():
                difference = (
                    model[name] - scales.get(name, 1.0) * table.columns[name]
                    if model
                    else FAILED_RUN_RESIDUAL * sd
                )
                parts.append(np.full(table.rows, difference / sd))
        for unknown, value in zip(self.unknowns.values(), x, strict=True):
            if unknown.prior is not None:
                parts.append([(value - np.log(unknown.prior)) / unknown.prior_sd])
        return np.concatenate(parts)

    def jacobian(self, logarithms: Array, central: bool = False) -> Array:
        """Compute the derivatives, (residuals, unknowns), by differences of runs."""
        columns, upper = [], self.upper(logarithms)
        for k, change in enumerate(LOGARITHM_CHANGE * np.eye(len(logarithms))):
            ahead, behind = (
                np.clip(logarithms + side * change, self.bounds[:, 0], upper) for side in (1, -1)
            )
            if not central:
                behind, ahead = (
                    (logarithms, ahead) if ahead[k] > logarithms[k] else (behind, logarithms)
                )
            columns.append(
                (self.residuals(ahead) - self.residuals(behind)) / (ahead[k] - behind[k])
            )
        return np.transpose(columns)

    def check_identifiable(self, jacobian: Array) -> None:
        """Raise if the data do not determine some unknowns."""
        _, singular, directions = np.linalg.svd(jacobian, full_matrices=False)
        if singular[-1] > SINGULAR_TOLERANCE * singular[0]:
            return
        blind = directions[-1] * np.sign(directions[-1][np.abs(directions[-1]).argmax()])
        powers = {
            key: power
            for key, power in zip(self.unknowns, blind, strict=True)
            if abs(power) > NAMED
        }
        names = ", ".join(powers)
        if len(powers) == 1:
            raise SceneError(
                f"unknowns: {names} changes nothing that is measured; fix it or set a prior"
            )
        scaled = " and ".join(f"{key} by s^{power:+.2f}" for key, power in powers.items())
        raise SceneError(
            f"unknowns: {names} are not identifiable: scaling {scaled} leaves the measurements "
            "unchanged; fix one of them or set a prior"
        )


class InfeasibleStart(RemodelError):  # noqa: N818
    """The scene has no equilibrium at the start of a fit."""

    exit_code = SOLVE_FAILED


class LostProcess(RemodelError):  # noqa: N818
    """A process of a fit has ended early, for example because it was killed."""

    exit_code = BAD_ENVIRONMENT


Task = Callable[[Problem], "OptimizeResult"]


@dataclass(frozen=True)
class Part(Run):
    """A part of a fit for a worker, which leaves the result of a task in a file."""

    work: tuple[Problem, Task]

    def is_complete(self) -> bool:
        """Return False: a part is not recorded, but its evaluated points are known."""
        return False

    def words(self) -> list[str]:
        """Write the task; return the command that does it."""
        file = self.sibling_path(".pickle")
        file.write_bytes(pickle.dumps(self.work))
        return [PART, str(file)]

    @property
    def answer(self) -> OptimizeResult:
        """Result of the task, from the part's file."""
        return pickle.loads(self.sibling_path(".pickle").read_bytes())


class _FitStudy(Study):
    """Study whose runs are the parts of a fit."""

    def answers(
        self, problem: Problem, place: Path, tasks: Mapping[str, Task]
    ) -> list[OptimizeResult]:
        """Return the results of the tasks; the problem gets the points evaluated for them."""
        parts = [
            Part(name, self.scene, self.folder / name, (problem, task))
            for name, task in tasks.items()
        ]
        self.runs = [*parts]
        self.run_all()
        problem.known |= read_journal(place)[1]
        return [part.answer for part in parts]

    def update(self) -> None:
        """Raise if a part has failed."""
        for name, words in self.failed.items():
            raise LostProcess(
                f"{name}: {words}; if memory is short, --jobs 1 takes less; all recorded results "
                "are kept; repeat the command to resume"
            )


def do_part(file: Path) -> None:
    """Do a part of a fit in a worker process; replace the task in the file by its result."""
    problem, task = pickle.loads(file.read_bytes())
    write_whole(file, pickle.dumps(task(problem)))


def fit(
    scene: Scene,
    data: Path | str,
    folder: Path | str | None = None,
    starts: int = 3,
    quiet: bool = True,
    profiles: bool = True,
    jobs: int | None = None,
) -> tuple[Path, Fit]:
    """Fit parameters of a scene to measurements."""
    if scene.cases:
        raise SceneError("cases: a fit takes one load case; leave out [[cases]]")
    with buffer_log(quiet=quiet) as held:
        problem = Problem(scene, *read_measurements(Path(data), scene))
        mark = fingerprint(problem)
        place, problem.known = _place(folder, f"{scene.name}-fit", mark)
        for words in (*describe_choice(scene), scene.describe_formulation()):
            log.info("%s", words)
        first, jacobian = _begun(problem)
    with (
        RunLock(place),
        open_log(place / "fit.log", quiet=quiet, held=held),
        TemporaryDirectory() as parts,
    ):
        problem.begin(place, mark)
        random = np.random.default_rng(1)
        points = [
            first,
            *(problem.start_near(first, random) for _ in range(starts - 1)),
        ]
        rough = partial(minimised, near=(first, jacobian), enough=PROFILE_TOLERANCE)
        with closing(_FitStudy("fit", scene, parts, {}, jobs, quiet)) as study:
            on_cores = partial(study.answers, problem, place)
            minima = on_cores(
                {f"start {n}": partial(rough, start=x) for n, x in enumerate(points, start=1)}
            )
            best = int(np.argmin([end.cost for end in minima]))
            again = partial(minimised, start=minima[best].x)
            (minima[best],) = on_cores({f"from the end of start {best + 1}": again})
            log.info(
                "sum of squares of each start: %s",
                ", ".join(f"{2 * end.cost:.6g}" for end in minima),
            )
            result = (
                with_profiles(problem, minima, on_cores) if profiles else result_of(problem, minima)
            )
        for words in result.warnings():
            log.warning("%s", words)
        log.info("%s", result.verdict())
        write_whole(
            place / "scene.toml", result.scene.to_toml(f"fitted to {Path(data).name}").encode()
        )
        result.write(place)
    return place, result


def _begun(problem: Problem) -> tuple[Array, Array]:
    """Return the start and the derivatives there; log warnings, check that all is identifiable."""
    first = np.log([unknown.start for unknown in problem.unknowns.values()])
    for words in problem.scene_of(first).warnings():
        log.warning("%s", words)
    try:
        at_start = problem.predictions(first)
    except StepFailure as failure:
        raise InfeasibleStart(
            f"at the start of the fit {failure}. {failure.refusal}; choose other starts"
        ) from failure
    for doubt in data_warnings(problem.tables, at_start, problem.scene_of(first)):
        log.warning("%s", doubt)
    jacobian = problem.jacobian(first, central=True)
    problem.check_identifiable(jacobian)
    return first, jacobian


def _place(folder: Path | str | None, name: str, mark: str) -> tuple[Path, dict[Point, Array]]:
    """Return the folder of the same fit with its evaluated points, or a new folder."""
    wanted = Path(folder or Path("results") / name)
    present, known = read_journal(wanted)
    if present == mark:
        return wanted, known
    if present is not None and folder is not None:
        raise SceneError(
            f"folder {wanted}: holds a fit of another scene, data or version; choose another folder"
        )
    return chosen_folder(folder, name, MPI.COMM_SELF), {}


def minimised(
    problem: Problem,
    start: Array,
    held: int | None = None,
    near: tuple[Array, Array] | None = None,
    enough: float = FIT_TOLERANCE,
) -> OptimizeResult:
    """Minimise the sum of squares from a start, in logarithms, by SciPy's least squares."""
    # The Jacobian, by differences or that of a point `near`, is updated (Broyden 1965) as long as
    # it predicts the residuals, because differences are expensive.
    from scipy.optimize import OptimizeResult, least_squares

    free = np.array([number != held for number in range(len(start))])
    (lower, upper), bounds = problem.bounds.T, problem.bounds[free].T
    start = np.clip(start, lower, upper)
    if not free.any():
        cost = np.sum(problem.residuals(start) ** 2) / 2
        return OptimizeResult(x=start, cost=cost, near=near)
    last = [x if y == held else y for x, y in problem.fractions]

    def whole(x: Array) -> Array:
        # SciPy's bounds are constant: the bound that a fraction leaves the last one shifts it.
        point = start.copy()
        point[free] = x
        point[last] += (problem.upper(point) - upper)[last]
        return np.maximum(point, lower)

    def jacobian(x: Array) -> Array:
        nonlocal near
        point, updated = whole(x), None
        if near is not None:
            step, change = point - near[0], problem.residuals(point) - problem.residuals(near[0])
            missed = change - near[1] @ step
            if np.linalg.norm(missed) <= TELLING * np.linalg.norm(change):
                updated = near[1] + np.outer(missed, step) / max(float(step @ step), 1e-300)
        near = point, problem.jacobian(point) if updated is None else updated
        steps = 1e-6 * np.eye(len(x))
        return near[1] @ np.transpose([whole(x + step) - whole(x - step) for step in steps]) / 2e-6

    first = start.copy()
    first[last] -= (problem.upper(start) - upper)[last]
    end = least_squares(
        lambda x: problem.residuals(whole(x)),
        np.clip(first[free], bounds[0] + 1e-6, bounds[1] - 1e-6),
        jacobian,
        bounds,
        x_scale="jac",
        xtol=enough,
        ftol=enough,
    )
    end.x, end.near = whole(end.x), near
    return end


def result_of(problem: Problem, ends: Sequence[OptimizeResult]) -> Fit:
    """Return the best of several minima, with its covariance."""
    logarithms: Array = min(ends, key=attrgetter("cost")).x
    jacobian = problem.jacobian(logarithms, central=True)
    problem.check_identifiable(jacobian)
    misfit = float(np.sqrt(np.mean(problem.residuals(logarithms) ** 2)))
    covariance = np.asarray(np.linalg.inv(jacobian.T @ jacobian))
    minima = [2 * float(end.cost) for end in ends]
    scene, models = problem.scene_of(logarithms), problem.predictions(logarithms)
    return Fit(scene, problem, logarithms, covariance, misfit, minima, models)


def profile_end(
    problem: Problem, best: OptimizeResult, step: Array, width: float, held: int
) -> OptimizeResult:
    """Return the lowest point of an unknown's profile, with the `end` of the confidence interval.

    The first point is that of the linear model, a step from the best fit.
    """
    from scipy.optimize import OptimizeResult

    # The root of the increase of the sum of squares, `width` at the end, is nearly linear.
    known, fit = [(0.0, best)], best
    point = best.x + step
    near = best.x, problem.jacobian(best.x, central=True)
    while len(known) <= MAX_PROFILE_FITS:
        point = np.clip(point, *problem.bounds.T)
        if abs(point - fit.x)[held] <= PROFILE_END * abs(point - best.x)[held]:
            break
        fit = minimised(problem, point, held, near, PROFILE_TOLERANCE)
        near = fit.near
        known.append((np.sqrt(max(2 * (fit.cost - best.cost), 0.0)), fit))
        known.sort(key=lambda one: float(abs(one[1].x - best.x)[held]))
        beyond = [number for number, (root, _) in enumerate(known) if root > width]
        outside = [*beyond, len(known) - 1][0]
        (low, inner), (high, outer) = known[outside - 1 : outside + 1]
        share = (width - low) / max(high - low, (width - low) / PROFILE_EXTRAPOLATION)
        if beyond:
            share = np.clip(share, PROFILE_SHARE, 1 - PROFILE_SHARE)
        point = inner.x + share * (outer.x - inner.x)
    lowest = min((fit for _, fit in known), key=attrgetter("cost"))
    return OptimizeResult(lowest, end=np.clip(point, *problem.bounds.T)[held])


def with_profiles(
    problem: Problem,
    minima: Sequence[OptimizeResult],
    on_cores: Callable[[Mapping[str, Task]], list[OptimizeResult]],
) -> Fit:
    """Return the fit with likelihood profiles of correlated unknowns, or of all near a bound.

    At each value of such an unknown all other unknowns are fitted again.
    """
    result, best = result_of(problem, minima), min(minima, key=attrgetter("cost"))
    covariance, width = result.covariance, NORMAL_95 * result.inflation
    independent = 1 / (np.diag(covariance) * np.diag(np.linalg.inv(covariance)))
    steps = width * covariance / result.deviations[:, None]
    room = np.minimum(problem.upper(best.x) - best.x, best.x - problem.bounds[:, 0])
    # A bound within an interval changes the intervals of all unknowns.
    chosen = np.flatnonzero((independent < 1 - CORRELATED**2) | np.any(steps.diagonal() > room))
    tasks = {
        f"profile of {result.keys[held]}, {name} end": partial(
            profile_end, best=best, step=side * steps[held], width=width, held=int(held)
        )
        for held in chosen
        for side, name in ((-1, "lower"), (1, "upper"))
    }
    ends = on_cores(tasks)
    lowest = min([best, *ends], key=attrgetter("cost"))
    if 2 * (best.cost - lowest.cost) > LOWER_MINIMUM * result.inflation**2:
        log.info("a profile leads to a lower sum of squares, from which the fit continues")
        lower = on_cores({"from a profile": partial(minimised, start=lowest.x)})
        return with_profiles(problem, [*minima, *lower], on_cores)
    limits = np.exp([end.end for end in ends]).reshape(-1, 2)
    keys = [result.keys[held] for held in chosen]
    return replace(result, profiles=dict(zip(keys, limits, strict=True)))


# ---------------------------------------------------------------- result
@dataclass(frozen=True)
class Fit(StudyResult):
    """Result of a fit: the minimum, its covariance and likelihood profiles."""

    scene: Scene
    problem: Problem
    logarithms: Array
    covariance: Array  # of the logarithms, by the noise alone
    misfit: float  # RMS of the normalised residuals
    minima: list[float]
    modelled: list[Columns]
    profiles: Columns = field(default_factory=dict)  # 95 % confidence limits, (2,), by profiles

    name, about = "fit", "measured and fitted"
    only_in_file = ("limited_by",)
    caption = (
        "Points: measured, with one standard deviation; lines: the fitted model. "
        "Each protocol has its panels."
    )

    @property
    def keys(self) -> list[str]:
        """Keys of the unknowns, in order."""
        return list(self.problem.unknowns)

    @property
    def values(self) -> Array:
        """Fitted values of the unknowns, (n,)."""
        return np.exp(self.logarithms)

    @property
    def deviations(self) -> Array:
        """Standard deviations of the logarithms by the noise alone, (n,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlations(self) -> Array:
        """Correlation matrix of the logarithms, (n, n)."""
        return self.covariance / np.outer(self.deviations, self.deviations)

    @property
    def inflation(self) -> float:
        """Factor on the confidence intervals if the model limits them, else 1.

        The residuals then estimate the variance, so that Student's distribution holds.
        """
        if self.misfit <= LIMITED_BY_MODEL:
            return 1.0
        from scipy.special import stdtrit

        count = len(self.problem.residuals(self.logarithms))
        freedom = max(count - len(self.keys), 1)
        quantile = stdtrit(freedom, 0.975)
        return float(self.misfit * np.sqrt(count / freedom) * quantile / NORMAL_95)

    @cached_property
    def band(self) -> Array:
        """95 % confidence limits of the logarithms, (2, n), by profiles if there are any."""
        half = NORMAL_95 * self.inflation * self.deviations
        band = np.array([self.logarithms - half, self.logarithms + half])
        for key, limits in self.profiles.items():
            band[:, self.keys.index(key)] = np.log(limits)
        return np.clip(band, *self.problem.bounds.T[:, None])

    @property
    def open(self) -> list[str]:
        """Ends of each confidence interval that are bounds: nothing, lower, upper or both."""
        return [
            ("", "lower", "upper", "both")[low + 2 * high]
            for low, high in self.band.T == self.problem.bounds
        ]

    @property
    def limited_by(self) -> str:
        """Cause that limits the accuracy: "noise" or "model"."""
        return "noise" if self.inflation == 1.0 else "model"

    def table(self) -> dict[str, ArrayLike]:
        """Return the columns of fit.csv, with a row for each unknown."""
        lower, upper = np.exp(self.band)
        return {
            "key": self.keys,
            "value": self.values,
            "lower": lower,
            "upper": upper,
            "open": self.open,
            "limited_by": [self.limited_by] * len(self.keys),
            "method": ["profile" if key in self.profiles else "linear" for key in self.keys],
            "start": [unknown.start for unknown in self.problem.unknowns.values()],
        }

    def warnings(self) -> Iterator[str]:
        """Yield a line for each fitted column that the model does not follow."""
        columns = [(table, name) for table in self.problem.fitted for name in table.sd]
        ends = np.cumsum([table.rows for table, _ in columns])
        parts = np.split(self.problem.residuals(self.logarithms), ends)
        for (table, name), part in zip(columns, parts, strict=False):  # the last part: priors
            if (rms := np.sqrt(np.mean(part**2))) > MISFIT:
                yield (
                    f"{table.name}, {name}: the model does not follow these data: the RMS of the "
                    f"residuals is {rms:.2g} standard deviations; check columns, units and sd"
                )

    def verdict(self) -> str:
        """Return RMS of the normalised residuals, agreement of starts, and correlated unknowns."""
        least, keys = min(self.minima), self.keys
        same = sum(end - least <= SAME_MINIMUM * max(least, 1.0) for end in self.minima)
        text = f"RMS of the normalised residuals: {self.misfit:.2g}; "
        text += f"{same} of {len(self.minima)} starts end in this minimum."
        if self.limited_by == "model":
            text += (
                " The model, not the noise, limits the accuracy: all confidence intervals are "
                f"{self.inflation:.3g} times as wide."
            )
        pairs = np.argwhere(np.triu(np.abs(self.correlations) > CORRELATED, 1))
        together = [f"{keys[i]} and {keys[j]} ({self.correlations[i, j]:+.2f})" for i, j in pairs]
        if together:
            text += f" Correlated: {', '.join(together)}"
            text += "." if self.profiles else "; linear intervals are unreliable."
        return text

    @property
    def notes(self) -> list[str]:  # type: ignore[override]
        """Coefficients of determination of the protocols that are predicted, a line each."""
        scales, lines = self.problem.scales_of(self.logarithms), []
        for table, model in zip(self.problem.tables, self.modelled, strict=True):
            for number, rows in ({} if table.is_fitted else table.protocols).items():
                scores = f"{table.name}, protocol {number}, predicted: R²"
                for name in table.sd:
                    values = scales.get(name, 1.0) * table.columns[name][rows]
                    missed = np.mean((model[name][rows] - values) ** 2) / np.var(values)
                    scores += f" {1 - missed:.3f} of {name}"
                lines.append(scores)
        return lines

    def write(self, folder: Path) -> None:
        """Write the tables and the picture into a folder."""
        super().write(folder)
        correlations = dict(zip(self.keys, self.correlations, strict=True))
        notes = [self.title, made_with()]
        Page(folder, "correlations").save_table({"key": self.keys, **correlations}, notes)

    def figure(self) -> Figure:
        """Plot each measured column of each protocol over its prescribed load, or time."""
        shown = [
            (table, model[name], name, rows, f", protocol {number}")
            for table, model in zip(self.problem.tables, self.modelled, strict=True)
            for number, rows in table.protocols.items()
            for name in table.sd
        ]
        (figure, grid), scales = panels(len(shown), 2.6), self.problem.scales_of(self.logarithms)
        for axes, (table, model, name, rows, which) in zip(grid, shown, strict=True):
            over = table.over(name)
            (unit_of_x, per_x), (unit, per) = (
                table.units.get(column, ("", 1.0)) for column in (over, name)
            )
            x, y = (
                scales.get(column, 1.0) * table.columns[column][rows] for column in (over, name)
            )
            axes.errorbar(
                x / per_x,
                y / per,
                table.sd[name] / per,
                fmt="o",
                color=COLOURS[0],
                label="measured",
            )
            words = "fitted model" if table.is_fitted else "predicted"
            axes.plot(x / per_x, model[rows] / per, color=COLOURS[1], label=words)
            title = f"{Path(table.name).name} ({table.state})"
            axes.set_title(title + which, fontsize=8)
            axes.set(
                xlabel=label(self.scene, over, unit_of_x), ylabel=label(self.scene, name, unit)
            )
            axes.legend(fontsize=7)
        return figure
