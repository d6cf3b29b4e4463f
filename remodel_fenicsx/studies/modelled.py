"""What a scene says where a table has measurements, with its derivatives by the unknowns where the model has them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.evolution.sensitivity import Directions, axes_lie_along, refused, with_derivatives
from remodel_fenicsx.evolution.stepper import Step, Watcher
from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.model.laws import LAWS
from remodel_fenicsx.results.columns import Measurement
from remodel_fenicsx.scene.scene import Scene
from remodel_fenicsx.simulation import Simulation, with_choices
from remodel_fenicsx.studies.measured import Measured

Array = NDArray[np.float64]

OF_TISSUE = ("lame_lambda", "lame_mu", "network_modulus", "contour_length")  # of a tissue: those with derivatives
NUMBERS_CHANGE = 1e-4  # of logarithms, for closed formulas: with four points the error is 1e-16, that of rounding 1e-12
STATE_CHANGE = 1e-5  # of logarithms, for columns of a state: central differences err by 1e-10


class Slopes(NamedTuple):
    """Derivatives of the numbers of a scene by the logarithms of k unknowns.

    Attributes
    ----------
    tissue, loads, scales
        By name of a parameter, a load (its `value`) and a scaled column, (k,).
    kappa
        (k,).
    exact
        Which unknowns change these numbers and nothing else, (k,).
    """

    tissue: Mapping[str, Array]
    loads: Mapping[str, Array]
    scales: Mapping[str, Array]
    kappa: Array
    exact: NDArray[np.bool_]


class Modelled(NamedTuple):
    """Columns of a table by name, (rows,), and their derivatives (k, rows); none where they were not asked for."""

    columns: dict[str, Array]
    changes: dict[str, Array]


def without_derivatives(scene: Scene, table: Measured) -> str | None:
    """Why the model of a table has no derivatives but differences, in words; None where it has."""
    scene = with_choices(scene)
    if not KINEMATICS[scene.model.kinematics].turns_nothing:
        return f"model.kinematics = {scene.model.kinematics!r}"
    for key, there in (
        ("regions", bool(scene.regions)),
        ("cases", bool(scene.cases)),
        ("natural.opening_angle", bool(scene.natural.opening_angle)),
        ("time.tolerance", scene.time.tolerance is not None or scene.time.is_equilibrium),
        ("cells.fibres", bool(scene.measured_cells)),
    ):
        if there:
            return key
    late = [column.name for column in _with_columns(scene, table).columns() if column.after_pass]
    if own := sorted(set(late) & set(table.sd)):
        return f"the column {own[0]}"
    settings = scene.remodeling
    return None if table.state == "virgin" else refused(settings, LAWS[settings.law], settings.coupling)


# ---------------------------------------------------------------- numbers of a scene
def slopes(at: Callable[[Array], Scene], logarithms: Array, scales: Mapping[str, tuple[int, float]]) -> Slopes:
    """Derivatives of a scene's numbers.

    Parameters
    ----------
    at
        The scene with unknowns that have these logarithms.
    logarithms
        Of the k unknowns.
    scales
        Number among the unknowns and present value of each scale, by column.
    """
    count, base = len(logarithms), at(logarithms)
    is_scale = {number for number, _ in scales.values()}
    tissue = {name: np.zeros(count) for name in OF_TISSUE}
    loads = {name: np.zeros(count) for name in base.loads}
    kappa, exact = np.zeros(count), np.ones(count, dtype=np.bool_)
    for k in range(count):
        if k in is_scale:
            continue
        around = [at(logarithms + step * NUMBERS_CHANGE * np.eye(count)[k]) for step in (-2, -1, 1, 2)]
        for name, ways in tissue.items():
            ways[k] = _slope([getattr(one.properties()[""].tissue, name) for one in around])
        for name, ways in loads.items():
            ways[k] = _slope([one.loads[name].value for one in around])
        kappa[k] = _slope([one.remodeling.kappa for one in around])
        exact[k] = _apart_from_numbers(around[-1]) == _apart_from_numbers(base)
    of_scales = {name: value * np.eye(count)[number] for name, (number, value) in scales.items()}
    return Slopes(tissue, loads, of_scales, kappa, exact)


def _slope(values: list[float]) -> float:
    """From values at -2, -1, 1 and 2 changes of a logarithm."""
    far, near, ahead, farther = values
    return (8 * (ahead - near) - (farther - far)) / (12 * NUMBERS_CHANGE)


def _apart_from_numbers(scene: Scene) -> Any:
    """What of a scene has no derivative."""
    values = scene.model_dump()
    rest = scene.properties()[""].tissue.map(lambda name, value: 0.0 if name in OF_TISSUE else value)
    values.pop("material")
    values["remodeling"].pop("kappa")
    for load in values["loads"].values():
        load.pop("value")
    return values, rest


# ---------------------------------------------------------------- tables
def model_of(scene: Scene, table: Measured, scales: Mapping[str, float], ways: Slopes | None = None) -> Modelled:
    """What a scene says where a table has measurements, by column.

    Parameters
    ----------
    scene, table, scales
        Scene, table, and factors on columns of loads.
    ways
        With them the derivatives too; not where `without_derivatives` has a word.

    Raises
    ------
    StepFailure
        If a state has no equilibrium.
    """
    scene = _with_columns(scene, table)
    if table.state == "history":
        measured = table.columns["time"]
        end = float(scene.time.step * np.ceil(measured.max() / scene.time.step - 1e-9))
        run = _Run(scene.with_values({"time.end": max(end, scene.time.step)}), table, ways)
        found = run.rows(lambda time: bool(np.abs(measured - time).min() < scene.time.step))
        at = found.columns["time"]
        return Modelled(
            {name: np.interp(measured, at, found.columns[name]) for name in table.sd},
            {name: np.array([np.interp(measured, at, row) for row in rows]) for name, rows in found.changes.items()},
        )
    cells, dimensions = None, None
    if table.state == "after":
        scene = with_choices(scene)
        before = _Run(scene.with_values({"time.end": table.time}), table, ways)
        before.rows(lambda time: False)
        cells, dimensions = before.cells, before.dimensions
    run = _Run(_passive(scene, table, scales), table, ways, _passive_loads(scene, table, ways), cells, dimensions)
    found = run.rows(lambda time: True)
    chosen = found.columns["time"] > 0
    return Modelled(
        {name: found.columns[name][chosen] for name in table.sd},
        {name: rows[:, chosen] for name, rows in found.changes.items()},
    )


def _with_columns(scene: Scene, table: Measured) -> Scene:
    """That has the table's columns."""
    there = {column.name for column in scene.columns()}
    more = [name for name in table.sd if name not in there]
    return scene.with_values({"output.columns": [*scene.output.columns, *more]}) if more else scene


def _passive(scene: Scene, table: Measured, scales: Mapping[str, float]) -> Scene:
    """Cells that stay, and a step for each row; loads that the table has not keep their last value."""
    changes: dict[str, Any] = {"remodeling.law": "none", "remodeling.coupling": "staggered", "remodeling.turnover": {}}
    changes |= {"output.times": [], "output.fields": False, "output.columns": [*table.sd]}  # some need turnover
    changes |= {"time.step": 1.0, "time.end": float(table.rows), "time.tolerance": None}
    for name, load in scene.loads.items():
        values: Array = np.full(table.rows, load.value * load.factor(scene.last_time))
        if name in table.loads:
            values = scales.get(name, 1.0) * table.columns[name]
        largest = float(values[np.abs(values).argmax()]) or 1.0
        ramp = [[0.0, 0.0], *([number + 1.0, float(value / largest)] for number, value in enumerate(values))]
        changes |= {f"loads.{name}.value": largest, f"loads.{name}.ramp": ramp}
    return scene.with_values(changes)


Loads = Callable[[float], Mapping[str, Array]]


def _passive_loads(scene: Scene, table: Measured, ways: Slopes | None) -> Loads | None:
    """Derivatives of the loads of `_passive` at its times."""
    if ways is None:
        return None
    known, nothing = ways, np.zeros(len(ways.kappa))

    def loads(time: float) -> dict[str, Array]:
        found = {name: known.loads[name] * load.factor(scene.last_time) for name, load in scene.loads.items()}
        row = max(round(time) - 1, 0)
        return found | {name: known.scales.get(name, nothing) * table.columns[name][row] for name in table.loads}

    return loads


# ---------------------------------------------------------------- runs
class _Run:
    """A run whose measured columns are kept.

    Parameters
    ----------
    scene, table
        What is run, and whose columns.
    ways
        With them: derivatives.
    loads
        Those of the loads, where they are not those of the scene's ramps.
    cells, dimensions
        To begin with: values of cells, and dl (k, elements, points, 3).
    """

    def __init__(
        self,
        scene: Scene,
        table: Measured,
        ways: Slopes | None,
        loads: Loads | None = None,
        cells: tuple[Array, Array] | None = None,
        dimensions: Array | None = None,
    ):
        self.scene, self.table, self.cells, self.dimensions = scene, table, cells, dimensions
        self.directions: Directions | None = None
        if ways is not None:
            self.directions = Directions(ways.tissue, ways.kappa, loads or self._ramped(ways))

    def _ramped(self, ways: Slopes) -> Loads:
        return lambda time: {name: ways.loads[name] * load.factor(time) for name, load in self.scene.loads.items()}

    def rows(self, wanted: Callable[[float], bool]) -> Modelled:
        """Columns and `time` of all steps; their derivatives where the time is wanted, zero elsewhere."""
        coupling = None
        if self.directions is not None:
            coupling = with_derivatives(self.scene.remodeling.coupling, self.directions, self.dimensions)
        simulation = Simulation(self.scene, MPI.COMM_SELF, coupling=coupling)
        watcher = None if self.directions is None else RowChanges(simulation, self.directions, self.table, wanted)
        try:
            if self.cells is not None:
                simulation.cells.set(*self.cells)
                simulation.state.settle_cells()
            rows = [step.row for step in simulation.steps([watcher] if watcher else [])]
            self.cells = simulation.cells.dimension_values.copy(), simulation.cells.axis_values.copy()
            self.dimensions = getattr(simulation.stepper.coupling, "dimensions", None)
        finally:
            simulation.close()
        names = ("time", *self.table.sd)
        columns = {name: np.array([row[name] for row in rows]) for name in names}
        return Modelled(columns, {} if watcher is None else watcher.changes())


class RowChanges(Watcher):
    """Derivatives of measured columns: of the state as the coupling has them, of the columns by central differences.

    Parameters
    ----------
    simulation
        Its coupling carries derivatives.
    directions
        What changes.
    table
        Whose columns.
    wanted
        At which times; elsewhere they are zero.
    """

    def __init__(
        self, simulation: Simulation, directions: Directions, table: Measured, wanted: Callable[[float], bool]
    ):
        self.simulation, self.directions, self.wanted = simulation, directions, wanted
        self.columns = [column for column in simulation.observer.columns if column.name in table.sd]
        self._rows: list[dict[str, Array]] = []

    def solved(self, step: Step) -> None:
        """Measure the state a little ahead and behind in each direction."""
        count = len(self.directions.kappa)
        row: dict[str, Array] = {column.name: np.zeros(count) for column in self.columns}
        if self.wanted(step.time):
            for k in range(count):
                ahead, behind = (self._measured(step, k, way) for way in (STATE_CHANGE, -STATE_CHANGE))
                for column in self.columns:
                    row[column.name][k] = (ahead[column.name] - behind[column.name]) / (2 * STATE_CHANGE)
        self._rows.append(row)

    def _measured(self, step: Step, k: int, way: float) -> dict[str, float]:
        state, coupling = self.simulation.state, self.simulation.stepper.coupling
        tissue, loads = self.simulation.tissue, self.directions.loads(step.time)
        with state.tentative():
            state.unknown.x.array[:] += way * coupling.unknowns[k]  # type: ignore[attr-defined]
            state.cells.dimension_values[:] += way * coupling.dimensions[k]  # type: ignore[attr-defined]
            state.loading.set({**step.loads, **{name: step.loads[name] + way * by[k] for name, by in loads.items()}})
            before = {name: float(getattr(tissue, name).value) for name in self.directions.tissue}
            for name, value in before.items():
                getattr(tissue, name).value = value + way * self.directions.tissue[name][k]
            try:
                extension = coupling.equilibrium.extension()
                moved = replace(step, loads=dict(state.loading.values), extension=extension)
                at = Measurement(self.simulation.observer, moved)
                return {column.name: column.value(at) for column in self.columns}
            finally:
                for name, value in before.items():
                    getattr(tissue, name).value = value

    def changes(self) -> dict[str, Array]:
        """By column, (k, steps)."""
        return {column.name: np.array([row[column.name] for row in self._rows]).T for column in self.columns}


def rotated_cells(scene: Scene) -> bool:
    """Whether cells do not lie along the coordinates of the mesh, so that there are no derivatives."""
    simulation = Simulation(with_choices(scene), MPI.COMM_SELF)
    try:
        return not axes_lie_along(simulation.cells.point_cells.axes)
    finally:
        simulation.close()
