"""What `remodel-fenicsx fit` reads, unknowns and tables of measurements: data, checked before any solve."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from remodel_fenicsx.scene.scene import Scene, SceneError
from remodel_fenicsx.schema.csv_table import TableFileError, read_columns
from remodel_fenicsx.schema.tables import Table, fault, shown
from remodel_fenicsx.schema.toml import read_toml
from remodel_fenicsx.schema.units import FORCE, LENGTH, LENGTH_UNIT, STRESS, STRESS_UNIT, factor_to_scene
from remodel_fenicsx.system.files import ForeignFileError, read_regular

Array = NDArray[np.float64]

LARGEST_TABLE = 10**7  # bytes: a hundred thousand rows
DIMENSIONS = {"stress": STRESS, "length": LENGTH, "stress * length^2": FORCE, "force": FORCE}
SCALE_BOUNDS = (1e-3, 1e3)  # bounds of a scale
WIDE = 1e3  # a bound that nobody gives over the start
TWICE = (1.7, 2.4)  # diameters over radii of the model at the start, whose tissue is a guess
ANOTHER_UNIT = 5.0  # lengths over those of the model, or less than its inverse: units differ by ten and more
FROM_EDGE = 5e-4  # of a logarithm, from the end of a key's range: derivatives look 2e-4 to both sides


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

    @property
    def rows(self) -> int:
        """How many there are."""
        return len(next(iter(self.columns.values())))


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
    loads = tuple(name for name in columns if name in scene.loads)
    _check_columns(columns, loads, table.state, file, scene)
    for key in ("units", "sd", "scale"):
        for name in getattr(table, key):
            if name not in columns or (name == "time" and key != "units"):
                raise SceneError(f"{place}.{key}.{name}: no such column is measured; the file has {', '.join(columns)}")
    for name, unit in table.units.items():
        columns[name] = columns[name] * _factor(name, unit, scene, f"{place}.units.{name} = {shown(unit)}")
    for name in columns:
        if (name in loads or name == "time") == (name in table.sd):
            rule = (
                "is prescribed, not measured" if name in table.sd else "each measured column has a standard deviation"
            )
            raise SceneError(f"{place}.sd.{name}: {rule}")
    return Measured(table.file, table.state, table.time or 0.0, columns, loads, table.sd, tuple(table.scale))


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
    try:
        return read_columns(read_regular(path, LARGEST_TABLE), path.name, sorted({*scene.loads, *known, "time"}))
    except (OSError, ForeignFileError, TableFileError) as error:
        raise SceneError(f"{place}: {getattr(error, 'strerror', None) or error}") from error


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
