"""What `remodel-fenicsx fit` reads, unknowns and tables of measurements: data, checked before any solve."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.scene.scene import Scene, SceneError
from remodel_fenicsx.schema.tables import shown
from remodel_fenicsx.schema.toml import read_toml
from remodel_fenicsx.schema.units import FORCE, LENGTH, LENGTH_UNIT, STRESS, STRESS_UNIT, factor_to_scene
from remodel_fenicsx.system.regular_files import ForeignFileError, read_regular

Array = NDArray[np.float64]

STATES = ("virgin", "history", "after")
LARGEST_TABLE = 10**7  # bytes: a hundred thousand rows
DIMENSIONS = {"stress": STRESS, "length": LENGTH, "stress * length^2": FORCE, "force": FORCE}
KEYS_OF_UNKNOWNS = ("start", "lower", "upper", "prior", "prior_sd")
KEYS_OF_TABLES = ("file", "state", "time", "sd", "scale", "units")
SCALE_BOUNDS = (1e-3, 1e3)  # bounds of a scale


@dataclass(frozen=True)
class Unknown:
    """A number that is fitted, in logarithms.

    Attributes
    ----------
    key
        Dotted key of the scene, or `scale.NAME`.
    start, lower, upper
        Positive, lower <= start <= upper.
    prior, prior_sd
        What is known of it before, and the standard deviation of its logarithm; None: nothing.
    """

    key: str
    start: float
    lower: float
    upper: float
    prior: float | None = None
    prior_sd: float | None = None


@dataclass(frozen=True)
class Measured:
    """A table of measurements in the scene's units.

    Attributes
    ----------
    name
        Of its file.
    state
        One of `STATES`.
    time
        Until when the tissue has remodeled before a passive test ("after").
    columns
        Loads, `time` and columns of the history by name, (rows,).
    loads
        Names of the columns that are loads.
    sd
        Standard deviation by measured column.
    scaled
        Columns with a factor that is fitted too.
    """

    name: str
    state: str
    time: float
    columns: dict[str, Array]
    loads: tuple[str, ...]
    sd: dict[str, float]
    scaled: tuple[str, ...]

    @property
    def rows(self) -> int:
        """How many there are."""
        return len(next(iter(self.columns.values())))


def read_measurements(path: Path, scene: Scene) -> tuple[list[Unknown], list[Measured]]:
    """Unknowns and tables of DATA.toml, checked against a scene.

    Raises
    ------
    SceneError
        One line: key, value and what is allowed.
    """
    values = read_toml(path)
    _only(values, ("unknowns", "measured"), "")
    tables = values.get("measured")
    if not isinstance(tables, list) or not tables:
        raise SceneError(f"{path}: must have a table [[measured]]")
    measured = [_table(table, f"measured {number}", path.parent, scene) for number, table in enumerate(tables, 1)]
    given = values.get("unknowns")
    if not isinstance(given, Mapping) or not given:
        raise SceneError(f'{path}: must have a table [unknowns], as "material.lame_mu" = {{ start = 10.0 }}')
    unknowns = [_unknown(str(key), table, scene) for key, table in given.items()]
    scales = dict.fromkeys(name for table in measured for name in table.scaled)
    unknowns += [Unknown(f"scale.{name}", 1.0, *SCALE_BOUNDS) for name in scales]
    if len(unknowns) > sum(table.rows * len(table.sd) for table in measured):
        raise SceneError(f"unknowns: {len(unknowns)} unknowns need as many measurements at least")
    return unknowns, measured


def _only(table: Mapping[str, Any], keys: Iterable[str], place: str) -> None:
    for key in table:
        if key not in keys:
            raise SceneError(f"{place}{'.' if place else ''}{shown(key)}: no such key; allowed are {', '.join(keys)}")


def _positive(value: Any, key: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < math.inf:
        raise SceneError(f"{key} = {shown(value)}: must be a number above 0")
    return float(value)


def _unknown(key: str, table: Any, scene: Scene) -> Unknown:
    place = f"unknowns.{key}"
    if not isinstance(table, Mapping) or "start" not in table:
        raise SceneError(f"{place} = {shown(table)}: must be a table with start, as {{ start = 10.0 }}")
    _only(table, KEYS_OF_UNKNOWNS, place)
    numbers = {name: _positive(value, f"{place}.{name}") for name, value in table.items()}
    start = numbers["start"]
    lower, upper = numbers.get("lower", start / 1e3), numbers.get("upper", start * 1e3)
    if not lower <= start <= upper or lower == upper:
        raise SceneError(f"{place}.start = {start:g}: must lie between lower {lower:g} and upper {upper:g}")
    if ("prior" in numbers) != ("prior_sd" in numbers):
        raise SceneError(f"{place}: prior and prior_sd (of the logarithm) go together")
    scene.with_values({key: start})  # a key that there is not, or that takes no such number, is refused
    return Unknown(key, start, lower, upper, numbers.get("prior"), numbers.get("prior_sd"))


def _table(table: Any, place: str, folder: Path, scene: Scene) -> Measured:
    if not isinstance(table, Mapping) or not isinstance(table.get("file"), str):
        raise SceneError(f"{place}.file: must be the name of a CSV file")
    _only(table, KEYS_OF_TABLES, place)
    state = table.get("state", "virgin")
    if state not in STATES:
        raise SceneError(f"{place}.state = {shown(state)}: must be one of {', '.join(map(repr, STATES))}")
    if ("time" in table) != (state == "after"):
        raise SceneError(f"{place}.time: allowed only with state = 'after': the time until which the tissue remodels")
    time = _positive(table["time"], f"{place}.time") if state == "after" else 0.0
    columns = _read_columns(folder / table["file"], f"{place}.file")
    loads = tuple(name for name in columns if name in scene.loads)
    _check_columns(columns, loads, state, f"{place}.file = {shown(table['file'])}", scene)
    for name, unit in _pairs(table, "units", place, columns):
        columns[name] = columns[name] * _factor(name, unit, scene, f"{place}.units.{name}")
    sd = {name: _positive(value, f"{place}.sd.{name}") for name, value in _pairs(table, "sd", place, columns)}
    for name in columns:
        if name not in sd and name not in loads and name != "time":
            raise SceneError(f"{place}.sd: has no {name}; each measured column has a standard deviation")
    for name in sd:
        if name in loads or name == "time":
            raise SceneError(f"{place}.sd.{name}: is prescribed, not measured")
    for name, word in _pairs(table, "scale", place, columns):
        if word != "unknown" or name == "time":
            raise SceneError(f"{place}.scale.{name} = {shown(word)}: must be 'unknown'")
    return Measured(table["file"], state, time, columns, loads, sd, tuple(table.get("scale", {})))


def _pairs(table: Mapping[str, Any], key: str, place: str, columns: Mapping[str, Array]) -> list[tuple[str, Any]]:
    found = table.get(key, {})
    if not isinstance(found, Mapping):
        raise SceneError(f"{place}.{key} = {shown(found)}: must be a table by column")
    for name in found:
        if name not in columns:
            raise SceneError(f"{place}.{key}.{name}: the file has no such column; it has {', '.join(columns)}")
    return list(found.items())


def _factor(name: str, unit: Any, scene: Scene, place: str) -> float:
    kinds = {column.name: column.unit for column in _all_columns(scene)}
    kinds |= {load: kind.dimension.name for load, kind in scene.load_kinds.items() if kind.dimension}
    dimension = DIMENSIONS.get(kinds.get(name, ""))
    if dimension is None:
        raise SceneError(f"{place} = {shown(unit)}: {name} takes no unit")
    units = {STRESS_UNIT: scene.material.stress_unit, LENGTH_UNIT: scene.geometry.length_unit}
    try:
        return factor_to_scene(str(unit), dimension, units)
    except ValueError as error:
        raise SceneError(f"{place} = {shown(unit)}: {error}") from error


def _all_columns(scene: Scene) -> tuple[Any, ...]:
    return scene.columns(column.name for column in scene.geometry.columns_on_request)


def _read_columns(path: Path, place: str) -> dict[str, Array]:
    try:
        text = read_regular(path, LARGEST_TABLE).decode("utf-8-sig")
    except (OSError, ForeignFileError, UnicodeDecodeError) as error:
        words = getattr(error, "strerror", None) or "is no text"
        raise SceneError(f"{place} = {shown(path.name)}: {words}") from error
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    table = [[cell.strip() for cell in row] for row in csv.reader(lines)]
    if len(table) < 2:
        raise SceneError(f"{place} = {shown(path.name)}: must have a row of names, and rows of numbers")
    head = table[0]
    if len(set(head)) < len(head):
        raise SceneError(f"{place} = {shown(path.name)}: a column is there twice")
    for number, row in enumerate(table[1:], 1):
        if len(row) != len(head):
            raise SceneError(f"{place} = {shown(path.name)}: row {number} has {len(row)} numbers, not {len(head)}")
        for name, cell in zip(head, row, strict=True):
            if not _is_finite(cell):
                raise SceneError(f"{place} = {shown(path.name)}: row {number}, {name}: {shown(cell)} is no number")
    values = np.array([[float(cell) for cell in row] for row in table[1:]])
    return {name: values[:, index] for index, name in enumerate(head)}


def _is_finite(cell: str) -> bool:
    try:
        return math.isfinite(float(cell))
    except ValueError:
        return False


def _check_columns(columns: Mapping[str, Array], loads: tuple[str, ...], state: str, place: str, scene: Scene) -> None:
    known = {column.name for column in _all_columns(scene)} - {"seconds", "substeps"}
    for name in columns:
        if name not in known and name not in scene.loads and name != "time":
            allowed = ", ".join(sorted({*scene.loads, *known}))
            raise SceneError(f"{place}: {shown(name)} is no load of the scene and no column; allowed are {allowed}")
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
