"""What `remodel-fenicsx fit` reads, unknowns and tables of measurements: data, checked before any solve."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.scene.scene import Scene, SceneError
from remodel_fenicsx.schema.csv_table import TableFileError, read_columns
from remodel_fenicsx.schema.tables import shown
from remodel_fenicsx.schema.toml import read_toml
from remodel_fenicsx.schema.units import FORCE, LENGTH, LENGTH_UNIT, STRESS, STRESS_UNIT, factor_to_scene
from remodel_fenicsx.system.files import ForeignFileError, read_regular

Array = NDArray[np.float64]

STATES = ("virgin", "history", "after")
LARGEST_TABLE = 10**7  # bytes: a hundred thousand rows
DIMENSIONS = {"stress": STRESS, "length": LENGTH, "stress * length^2": FORCE, "force": FORCE}
KEYS_OF_UNKNOWNS = ("start", "lower", "upper", "prior", "prior_sd")
KEYS_OF_TABLES = ("file", "state", "time", "sd", "scale", "units")
SCALE_BOUNDS = (1e-3, 1e3)  # bounds of a scale
WIDE = 1e3  # a bound that nobody gives over the start
TWICE = (1.7, 2.4)  # diameters over radii of the model at the start, whose tissue is a guess
ANOTHER_UNIT = 5.0  # lengths over those of the model, or less than its inverse: units differ by ten and more
FROM_EDGE = 5e-4  # of a logarithm, from the end of a key's range: derivatives look 2e-4 to both sides


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

    @property
    def rows(self) -> int:
        """How many there are."""
        return len(next(iter(self.columns.values())))


def read_measurements(path: Path, scene: Scene) -> tuple[list[Unknown], list[Measured]]:
    """Unknowns and tables of DATA.toml, checked against a scene."""
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
    starts = {unknown.key: unknown.start for unknown in unknowns}
    scene.with_values(starts)  # what does not go together is refused
    ends = [[_end(unknown, end, scene, starts) for end in ("lower", "upper")] for unknown in unknowns]
    unknowns = [replace(one, lower=lower, upper=upper) for one, (lower, upper) in zip(unknowns, ends, strict=True)]
    for one in unknowns:
        if not one.lower < one.upper:
            raise SceneError(f"unknowns.{one.key}: the scene takes no number beside {one.start:g}, so it is not fitted")
    scales = dict.fromkeys(name for table in measured for name in table.scaled)
    unknowns += [Unknown(f"scale.{name}", 1.0, *SCALE_BOUNDS) for name in scales]
    if len(unknowns) > sum(table.rows * len(table.sd) for table in measured):
        raise SceneError(f"unknowns: {len(unknowns)} unknowns need as many measurements at least")
    return unknowns, measured


def doubts(tables: Sequence[Measured], modelled: Sequence[Mapping[str, Array]], scene: Scene) -> Iterator[str]:
    """What measured numbers look like beside those of the model at the start: diameters, another unit; a line each."""
    units = {column.name: column.unit for column in _all_columns(scene)}
    for table, model in zip(tables, modelled, strict=True):
        for name in (one for one in table.sd if one not in table.scaled):
            found, place = np.abs(table.columns[name]), f"{table.name}, {name}"
            known = np.maximum(np.abs(model[name]), 1e-300)
            if units[name] == "degrees" and found.max() <= np.pi < known.max():
                yield f"{place}: all lie within 3.14, those of the scene reach {known.max():.3g}; degrees are asked"
            if units[name] != "length":
                continue
            ratio, one = float(np.median(found / known)), f"geometry.length_unit = {scene.geometry.length_unit!r}"
            if name.endswith("radius") and TWICE[0] < (found / known).min() <= ratio < TWICE[1]:
                yield f"{place}: {ratio:.3g} times those of the scene at the start; are they diameters?"
            elif ratio > ANOTHER_UNIT or ratio < 1 / ANOTHER_UNIT:
                yield f"{place}: {ratio:.3g} times those of the scene at the start; {one}, see units"


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
    lower, upper = numbers.get("lower", start / WIDE), numbers.get("upper", start * WIDE)
    if not lower <= start <= upper or lower == upper:
        raise SceneError(f"{place}.start = {start:g}: must lie between lower {lower:g} and upper {upper:g}")
    if ("prior" in numbers) != ("prior_sd" in numbers):
        raise SceneError(f"{place}: prior and prior_sd (of the logarithm) go together")
    scene.with_values({key: start})  # a key that there is not, or that takes no such number, is refused
    return Unknown(key, start, lower, upper, numbers.get("prior"), numbers.get("prior_sd"))


def _end(unknown: Unknown, end: str, scene: Scene, starts: Mapping[str, float]) -> float:
    """The lower or upper end of an unknown, or the last number before it that is of the key's own range."""
    given, start = getattr(unknown, end), unknown.start
    inside, outside = np.log([start, given])
    back = FROM_EDGE * np.sign(inside - outside)

    def allowed(number: float) -> bool:
        """Whether it may be, with the others as they are or moved by the same factor: a wall keeps its form."""
        moved = {key: other * number / start for key, other in starts.items()}
        for values in ({**starts, unknown.key: number}, moved):
            with suppress(SceneError):
                return bool(scene.with_values(values))
        return False

    if not math.isclose(abs(np.log(given / start)), np.log(WIDE)) and not allowed(given):
        scene.with_values({unknown.key: given})  # refuses what somebody has typed
    if allowed(float(np.exp(outside - back))):
        return float(given)
    while abs(outside - inside) > FROM_EDGE:
        middle = (inside + outside) / 2
        inside, outside = (middle, outside) if allowed(float(np.exp(middle - back))) else (inside, middle)
    return float(np.exp(inside))


def _table(table: Any, place: str, folder: Path, scene: Scene) -> Measured:
    if not isinstance(table, Mapping) or not isinstance(table.get("file"), str):
        raise SceneError(f"{place}.file: must be the name of a CSV file")
    _only(table, KEYS_OF_TABLES, place)
    state = table.get("state", "virgin")
    if state not in STATES:
        raise SceneError(f"{place}.state = {shown(state)}: must be one of {', '.join(map(repr, STATES))}")
    if state == "after" and scene.remodeling.turnover.is_on:
        raise SceneError(f"{place}.state = 'after': takes cells alone, not what remodeling.turnover has changed")
    if ("time" in table) != (state == "after"):
        raise SceneError(f"{place}.time: allowed only with state = 'after': the time until which the tissue remodels")
    time = _positive(table["time"], f"{place}.time") if state == "after" else 0.0
    columns = _read_columns(folder / table["file"], f"{place}.file", scene)
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


def _read_columns(path: Path, place: str, scene: Scene) -> dict[str, Array]:
    known = {column.name for column in _all_columns(scene)} - {"seconds", "substeps"}
    try:
        data = read_regular(path, LARGEST_TABLE)
        return read_columns(data, path.name, sorted({*scene.loads, *known, "time"}))
    except (OSError, ForeignFileError, TableFileError) as error:
        raise SceneError(f"{place} = {shown(path.name)}: {getattr(error, 'strerror', None) or error}") from error


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
