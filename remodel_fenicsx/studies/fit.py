"""`remodel-fenicsx fit SCENE DATA.toml`: numbers of a scene from measurements, with what the data say of them."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx._version import __version__
from remodel_fenicsx.errors import RemodelError, SOLVE_FAILED
from remodel_fenicsx.evolution.sensitivity import Directions, axes_lie_along, refused, with_derivatives
from remodel_fenicsx.evolution.stepper import Step, Watcher
from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.model.laws import LAWS
from remodel_fenicsx.report.card import Card, folded, section, table as card_table
from remodel_fenicsx.report.page import page_with
from remodel_fenicsx.results.columns import Measurement
from remodel_fenicsx.results.run_folder import chosen_folder
from remodel_fenicsx.results.run_lock import RunLock
from remodel_fenicsx.scene.scene import Scene, SceneError
from remodel_fenicsx.simulation import Simulation, with_choices
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.studies.measurements import Measured, Unknown, doubts, read_measurements
from remodel_fenicsx.studies.page import COLOURS, DOTS_PER_INCH, STYLE, Answer, Page, label, made_with, panels
from remodel_fenicsx.system.files import check_no_link, read_regular, write_whole
from remodel_fenicsx.system.terminal import Line, hold_log, open_log, unsaid

log = logging.getLogger(__name__)

Array = NDArray[np.float64]


# ---------------------------------------------------------------- numbers of a scene, and their derivatives
OF_TISSUE = ("lame_lambda", "lame_mu", "network_modulus", "contour_length")  # of a tissue: those with derivatives
NUMBERS_CHANGE = 1e-4  # of logarithms, for closed formulas: with four points the error is 1e-16, that of rounding 1e-12
STATE_CHANGE = 1e-5  # of logarithms, for columns of a state: central differences err by 1e-10


class Slopes(NamedTuple):
    """Derivatives of the numbers of a scene by the logarithms of k unknowns."""

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


def slopes(at: Callable[[Array], Scene], logarithms: Array, scales: Mapping[str, tuple[int, float]]) -> Slopes:
    """Derivatives of a scene's numbers."""
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
        kappa[k] = _slope([one.properties()[""].kappa for one in around])
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


# ---------------------------------------------------------------- what a scene says where a table has measurements
def model_of(scene: Scene, table: Measured, scales: Mapping[str, float], ways: Slopes | None = None) -> Modelled:
    """What a scene says where a table has measurements, by column."""
    scene, start, test = _with_columns(scene, table), None, None
    if table.state == "history":
        places, step = table.columns["time"], scene.time.step
        end = max(float(step * np.ceil(places.max() / step - 1e-9)), step)
        run = scene.with_values({"time.end": end})
    else:
        places, step, test = np.arange(table.rows, dtype=np.float64) + 1, 1.0, table
        if table.state == "after":
            scene = with_choices(scene)
            before = scene.with_values({"time.end": table.time})
            _, start = _run(before, table, _directions(before, ways), lambda time: False)
        run = _passive(scene, table, scales)
    directions = _directions(scene, ways, test)
    found, _ = _run(run, table, directions, lambda time: bool(np.abs(places - time).min() < step), start)
    at = found.columns["time"]
    return Modelled(
        {name: np.interp(places, at, found.columns[name]) for name in table.sd},
        {name: np.array([np.interp(places, at, row) for row in rows]) for name, rows in found.changes.items()},
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


def _directions(scene: Scene, ways: Slopes | None, test: Measured | None = None) -> Directions | None:
    """Derivatives under the scene's own loads, or those of `_passive`."""
    if ways is None:
        return None
    known, nothing = ways, np.zeros(len(ways.kappa))

    def loads(time: float) -> dict[str, Array]:
        when = time if test is None else scene.last_time
        found = {name: known.loads[name] * load.factor(when) for name, load in scene.loads.items()}
        if test is not None:
            row = max(round(time) - 1, 0)
            found |= {name: known.scales.get(name, nothing) * test.columns[name][row] for name in test.loads}
        return found

    return Directions(ways.tissue, ways.kappa, loads)


class Start(NamedTuple):
    """Cells as a run leaves them, and the derivatives of their lengths."""

    dimensions: Array
    axes: Array
    changes: Array | None


def _run(
    scene: Scene,
    table: Measured,
    directions: Directions | None,
    wanted: Callable[[float], bool],
    start: Start | None = None,
) -> tuple[Modelled, Start]:
    """Columns and `time` of all steps, their derivatives where they are wanted and zero elsewhere; cells at the end."""
    coupling = None
    if directions is not None:
        coupling = with_derivatives(scene.remodeling.coupling, directions, start.changes if start else None)
    simulation = Simulation(scene, MPI.COMM_SELF, coupling=coupling)
    watchers = [] if directions is None else [RowChanges(simulation, directions, table, wanted)]
    cells = simulation.cells
    try:
        if start is not None:
            cells.set(start.dimensions, start.axes)
            simulation.state.settle_cells()
        rows = [step.row for step in simulation.steps(watchers)]
        changes = getattr(simulation.stepper.coupling, "dimensions", None)
        end = Start(cells.dimension_values.copy(), cells.axis_values.copy(), changes)
    finally:
        simulation.close()
    columns = {name: np.array([row[name] for row in rows]) for name in ("time", *table.sd)}
    return Modelled(columns, watchers[0].changes() if watchers else {}), end


class RowChanges(Watcher):
    """Derivatives of measured columns: of the state as the coupling has them, of the columns by central differences."""

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


# ---------------------------------------------------------------- what was evaluated, a line each in a file
JOURNAL = "evaluations.jsonl"
LARGEST_JOURNAL = 10**9  # bytes

Point = tuple[float, ...]


class Evaluation(NamedTuple):
    """Residuals (n,) at a point, and their derivatives (n, k): NaN in columns that the model does not give."""

    residuals: Array
    jacobian: Array


class Journal:
    """The file in the folder of a fit, from which the same fit goes on; its first line says which fit it is."""

    def __init__(self, folder: Path):
        self._path = folder / JOURNAL
        self._lines: list[dict[str, Any]] = []
        text = read_regular(self._path, LARGEST_JOURNAL).decode(errors="replace") if self._path.exists() else ""
        with suppress(ValueError):  # the last line may have been cut off
            for line in text.splitlines():
                self._lines.append(json.loads(line))

    @property
    def mark(self) -> str | None:
        """Of the fit in the folder; None where there is none."""
        return str(self._lines[0].get("fit")) if self._lines else None

    def known(self) -> dict[Point, Evaluation]:
        """All evaluations by their point."""
        found = {}
        for line in self._lines[1:]:
            point, off, ways = (np.array(line[name], dtype=np.float64) for name in ("at", "residuals", "jacobian"))
            found[tuple(map(float, point))] = Evaluation(off, ways)
        return found

    def begin(self, mark: str) -> None:
        """Open the file for more, without a line that was cut off."""
        self._lines = self._lines or [{"fit": mark}]
        check_no_link(self._path)
        self._path.write_text("".join(json.dumps(line) + "\n" for line in self._lines), encoding="utf-8")

    def add(self, point: Point, evaluation: Evaluation) -> None:
        """One line more, on the disk when this returns."""
        values = {"residuals": evaluation.residuals.tolist(), "jacobian": evaluation.jacobian.tolist()}
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"at": list(point), **values}) + "\n")


def fingerprint(scene: Scene, unknowns: Sequence[Unknown], tables: Sequence[Measured]) -> str:
    """SHA-256 of all that a fit depends on but its starts."""
    said = [[t.name, t.state, t.time, t.sd, t.scaled, {n: v.tolist() for n, v in t.columns.items()}] for t in tables]
    text = json.dumps([__version__, scene.to_toml(), [list(vars(u).values()) for u in unknowns], said])
    return hashlib.sha256(text.encode()).hexdigest()


# ---------------------------------------------------------------- least squares
SCALE = "scale."  # what keys of factors on columns begin with
LOGARITHM_CHANGE = 1e-3  # of a logarithm: central differences err by 1e-6, the solves' tolerance of 1e-10 by 1e-7
BLIND = 1e-5  # smallest singular value over the largest, below which the data say nothing: what differences err by
BLIND_EXACT = 1e-8  # the same where all derivatives are exact: columns are differentiated with errors of 1e-10
NAMED = 0.1  # share of a blind direction from which on an unknown is named
UNSOLVED = 1e3  # standard deviations, of all rows of a state that has no equilibrium
START_SPREAD = np.log(2.0)  # of further starts, to both sides
SAME_MINIMUM = 1e-2  # relative difference of the sums of squares
ENOUGH = 1e-6  # relative change of the sum of squares, or of the unknowns, at which a fit ends: noise is far above it
CORRELATED = 0.9  # of two unknowns, from which on their profiles are made
PROFILE_STEP, PROFILE_REACH = 1.0, 4.0  # standard deviations of the straight line
ROUGHLY = 1e-4  # as ENOUGH, of a profile's fits: they start where a straight line has their end
NORMAL_95 = 1.959963984540054  # standard deviations on each side, normal distribution

_MODULI = ("lame_lambda", "lame_mu", "chain_density", "initial_stiffness", "persistence_length", "temperature")
KNOWN_GROUPS: list[tuple[set[str], str]] = [
    (
        {f"material.{key}" for key in ("chain_density", "persistence_length", "temperature", "energy_factor")},
        "only their product c = omega k theta n / (4 A_p) is in the energy",
    ),
    (
        {"material.chain_density", "material.initial_stiffness", "material.persistence_length"},
        "both are the stiffness of the network",
    ),
    ({"material.contour_length", "material.locking_stretch"}, "both are the length at which a chain locks"),
    ({"remodeling.kappa", "remodeling.half_life"}, "the half-life is ln 2 / kappa"),
    (
        {"remodeling.threshold", "loads.pressure.value", "scale.pressure"} | {f"material.{key}" for key in _MODULI},
        "without a measured force, all stresses may be multiplied by one factor",
    ),
]
"""Unknowns that go together, and why; the first group that has all of them counts."""


class Problem:
    """Residuals over their standard deviations as a function of the logarithms of the unknowns."""

    def __init__(self, scene: Scene, unknowns: Sequence[Unknown], tables: Sequence[Measured]):
        self.scene, self.unknowns, self.tables = scene, list(unknowns), list(tables)
        self._known: dict[Point, Evaluation] = {}
        self._journal: Journal | None = None
        first = np.log([unknown.start for unknown in unknowns])
        words = [reason for table in tables if (reason := without_derivatives(scene, table)) is not None]
        if not words and rotated_cells(scene):
            words = [f"cells.axes = {scene.cells.axes!r}"]
        self.exact: NDArray[np.bool_] = np.zeros(len(first), dtype=np.bool_) if words else self._slopes(first).exact
        self.reason = words[0] if words else "the model has no derivative by them"

    def keep(self, journal: Journal) -> None:
        """From now on each evaluation is in the journal, and what that has is not evaluated again."""
        known = journal.known()
        for point in self._known.keys() - known.keys():
            journal.add(point, self._known[point])
        self._known |= known
        self._journal = journal

    def how(self) -> str:
        """Which derivatives are exact, in words."""
        keys = [unknown.key for unknown in self.unknowns]
        exact = [key for key, known in zip(keys, self.exact, strict=True) if known]
        others = [key for key in keys if key not in exact]
        parts = [f"exact by {', '.join(exact)}"] if exact else []
        parts += [f"by differences of runs for {', '.join(others)} ({self.reason})"] if others else []
        return f"derivatives: {'; '.join(parts)}"

    def scene_of(self, logarithms: Array) -> Scene:
        """The scene with these numbers."""
        found = {u.key: float(np.exp(x)) for u, x in zip(self.unknowns, logarithms, strict=True)}
        return self.scene.with_values({key: value for key, value in found.items() if not key.startswith(SCALE)})

    def scales_of(self, logarithms: Array) -> dict[str, float]:
        """Factors on columns, by name."""
        pairs = zip(self.unknowns, logarithms, strict=True)
        return {u.key.removeprefix(SCALE): float(np.exp(x)) for u, x in pairs if u.key.startswith(SCALE)}

    def _slopes(self, logarithms: Array) -> Slopes:
        names = {u.key.removeprefix(SCALE): k for k, u in enumerate(self.unknowns) if u.key.startswith(SCALE)}
        scales = {name: (k, float(np.exp(logarithms[k]))) for name, k in names.items()}
        return slopes(self.scene_of, logarithms, scales)

    def models(self, logarithms: Array, derivatives: bool = False) -> list[Modelled]:
        """What the model says of each table, with derivatives on request."""
        scene, scales = self.scene_of(logarithms), self.scales_of(logarithms)
        ways = self._slopes(logarithms) if derivatives else None
        return [model_of(scene, table, scales, ways) for table in self.tables]

    def residuals(self, logarithms: Array) -> Array:
        """Model less measurement over standard deviation, table by table; then the priors."""
        return self.at(logarithms).residuals

    def at(self, logarithms: Array, derivatives: bool = True) -> Evaluation:
        """Residuals, and those derivatives that are exact, where they are asked for."""
        key = tuple(map(float, logarithms))
        if key not in self._known or (derivatives and self.exact.any() and np.isnan(self._known[key].jacobian).all()):
            with unsaid():
                self._known[key] = self._evaluated(np.array(logarithms), derivatives and bool(self.exact.any()))
            if self._journal is not None:
                self._journal.add(key, self._known[key])
        return self._known[key]

    def _evaluated(self, x: Array, derivatives: bool) -> Evaluation:
        scales, parts, slopes_ = self.scales_of(x), [], []
        models: list[Modelled] | None = None
        with suppress(StepFailure, SceneError):  # numbers that do not go together have no equilibrium either
            models = self.models(x, derivatives)
        for number, table in enumerate(self.tables):
            for name, sd in table.sd.items():
                measured = scales.get(name, 1.0) * table.columns[name]
                off = models[number].columns[name] - measured if models else np.full(table.rows, UNSOLVED * sd)
                parts.append(off / sd)
                by_scale = np.array([u.key == SCALE + name for u in self.unknowns], dtype=np.float64)
                ways: Array = np.zeros((table.rows, len(x)))
                if models and derivatives:
                    ways = models[number].changes[name].T - measured[:, None] * by_scale
                slopes_.append(ways / sd)
        for number, (unknown, value) in enumerate(zip(self.unknowns, x, strict=True)):
            if unknown.prior is not None and unknown.prior_sd is not None:
                parts.append(np.array([(value - np.log(unknown.prior)) / unknown.prior_sd]))
                slopes_.append(np.eye(len(x))[[number]] / unknown.prior_sd)
        known = self.exact if derivatives else np.zeros_like(self.exact)
        return Evaluation(np.concatenate(parts), np.where(known, np.concatenate(slopes_), np.nan))

    def jacobian(self, logarithms: Array, central: bool = False) -> Array:
        """Derivatives, (residuals, unknowns): of the model where it has them, else by differences of runs."""
        found, step = self.at(logarithms).jacobian.copy(), LOGARITHM_CHANGE * (1.0 if central else 0.1)
        ends = [np.log([getattr(unknown, end) for unknown in self.unknowns]) for end in ("lower", "upper")]
        for k in np.flatnonzero(~self.exact):
            ahead, behind = (np.clip(logarithms + way * np.eye(len(logarithms))[k], *ends) for way in (step, -step))
            if not central:
                behind, ahead = (logarithms, ahead) if ahead[k] > logarithms[k] else (behind, logarithms)
            off = self.at(ahead, False).residuals - self.at(behind, False).residuals
            found[:, k] = off / (ahead[k] - behind[k])
        return found

    def check_tells_apart(self, jacobian: Array) -> None:
        """Refuse unknowns of which the data say nothing."""
        _, singular, directions = np.linalg.svd(jacobian, full_matrices=False)
        if singular[-1] > (BLIND_EXACT if self.exact.all() else BLIND) * singular[0]:
            return
        blind = directions[-1] * np.sign(directions[-1][np.abs(directions[-1]).argmax()])
        pairs = [(u.key, part) for u, part in zip(self.unknowns, blind, strict=True) if abs(part) > NAMED]
        keys, named = [key for key, _ in pairs], [f"{key} ({part:+.2f})" for key, part in pairs]
        if len(named) == 1:
            raise SceneError(f"unknowns: {keys[0]} changes nothing that is measured; fix it or give it a prior")
        raise SceneError(
            f"unknowns: the data cannot tell apart {', '.join(named)}: changed together by these powers of a factor "
            f"they give the same measurements{_reason(keys)}; fix one of them or give it a prior"
        )


def _reason(keys: Sequence[str]) -> str:
    """Why unknowns go together, where it is known."""
    return next((f" ({words})" for group, words in KNOWN_GROUPS if set(keys) <= group and len(set(keys)) > 1), "")


class NoStart(RemodelError):  # noqa: N818
    """A fit starts where the scene has no equilibrium."""

    exit_code = SOLVE_FAILED


def fit(
    scene: Scene,
    data: Path | str,
    folder: Path | str | None = None,
    starts: int = 3,
    quiet: bool = True,
    profiles: bool = True,
) -> tuple[Path, Fit]:
    """Fit numbers of a scene to measurements."""
    if scene.cases:
        raise SceneError("cases: a fit takes one load case; leave out [[cases]]")
    line = Line(f"{scene.name} fit")

    def show(text: str) -> None:
        if not quiet:
            line.show(text)

    with hold_log(quiet=quiet) as held:
        unknowns, tables = read_measurements(Path(data), scene)
        mark = fingerprint(scene, unknowns, tables)
        place, journal = _place(folder, f"{scene.name}-fit", mark)
        problem, first = Problem(scene, unknowns, tables), np.log([unknown.start for unknown in unknowns])
        log.info("%s", problem.how())
        try:
            at_start = problem.models(first)
        except StepFailure as failure:
            raise NoStart(f"at the start of the fit {failure}. {failure.refusal}; choose other starts") from failure
        for doubt in doubts(tables, [modelled.columns for modelled in at_start], scene):
            log.warning("%s", doubt)
        problem.check_tells_apart(problem.jacobian(first, central=True))
    random, found = np.random.default_rng(1), []
    with ExitStack() as stack:
        stack.enter_context(RunLock(place))
        journal.begin(mark)
        problem.keep(journal)
        stack.enter_context(open_log(place / "fit.log", quiet=quiet, held=held))
        stack.callback(line.end)
        for number in range(1, starts + 1):
            start = first + (random.uniform(-START_SPREAD, START_SPREAD, len(first)) if number > 1 else 0.0)

            def said(misfit: float, words: str = f"start {number} of {starts}, misfit") -> None:
                show(f"{words} {misfit:.4g}")

            found.append(minimised(problem, start, said))
            log.info("start %d: sum of squares %.6g, %d evaluations", number, 2 * found[-1].cost, found[-1].nfev)
        result = result_of(problem, found)
        if profiles:
            result = with_profiles(problem, result, lambda key: show(f"profile of {key}"))
        log.info("%s", result.verdict())
        write_whole(place / "scene.toml", result.scene.to_toml(f"fitted to {Path(data).name}").encode())
        result.write(place)
    return place, result


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
    said: Callable[[float], object] = lambda misfit: None,
    held: int | None = None,
    enough: float = ENOUGH,
) -> Any:
    """SciPy's least squares from a start, logarithms; `said` gets each misfit."""
    from scipy.optimize import least_squares

    free = np.array([number != held for number in range(len(start))])
    bounds = [np.log([getattr(u, end) for u in problem.unknowns])[free] for end in ("lower", "upper")]

    def whole(x: Array) -> Array:
        found = start.copy()
        found[free] = x
        return found

    def residuals(x: Array) -> Array:
        off = problem.residuals(whole(x))
        said(float(np.sqrt(np.mean(off**2))))
        return off

    inside = np.clip(start[free], bounds[0] + 1e-6, bounds[1] - 1e-6)
    return least_squares(
        residuals,
        inside,
        lambda x: problem.jacobian(whole(x))[:, free],
        bounds,
        x_scale="jac",
        xtol=enough,
        ftol=enough,
    )


def profile(problem: Problem, best: Array, covariance: Array, number: int) -> LikelihoodProfile:
    """Of an unknown, from the minimum outwards until the band ends: the others are fitted again at each value."""
    least, deviation = float(np.sum(problem.residuals(best) ** 2)), float(np.sqrt(covariance[number, number]))
    unknown, points, ends = problem.unknowns[number], [(float(best[number]), 0.0)], []
    for side in (-1.0, 1.0):
        x, last, end = best.copy(), (float(best[number]), 0.0), float("nan")
        way = side * PROFILE_STEP * deviation * covariance[:, number] / covariance[number, number]
        for _ in range(round(PROFILE_REACH / PROFILE_STEP)):
            x = x + way
            if not np.log(unknown.lower) < x[number] < np.log(unknown.upper):
                break
            if len(x) > 1:
                x[np.arange(len(x)) != number] = minimised(problem, x, held=number, enough=ROUGHLY).x
            point = float(x[number]), float(np.sum(problem.residuals(x) ** 2)) - least
            points.append(point)
            if point[1] > NORMAL_95**2:  # the root is nearly a straight line
                roots = [float(np.sqrt(max(increase, 0.0))) for _, increase in (last, point)]
                end = float(np.exp(np.interp(NORMAL_95, roots, [last[0], point[0]])))
                break
            last = point
        ends.append(end)
    values, increases = np.array(sorted(points)).T
    return LikelihoodProfile(np.exp(values), increases, *ends)


def result_of(problem: Problem, found: Sequence[Any]) -> Fit:
    """The best of several minima, with bands."""
    logarithms: Array = min(found, key=lambda one: float(one.cost)).x
    jacobian = problem.jacobian(logarithms, central=True)
    problem.check_tells_apart(jacobian)
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    deviations = np.sqrt(np.diag(covariance))
    correlations, off = covariance / np.outer(deviations, deviations), problem.residuals(logarithms)
    return Fit(
        problem.unknowns,
        np.exp(logarithms),
        np.exp(logarithms - NORMAL_95 * deviations),
        np.exp(logarithms + NORMAL_95 * deviations),
        correlations,
        float(np.sqrt(np.mean(off**2))),
        [2 * float(one.cost) for one in found],
        [int(one.nfev) for one in found],
        [modelled.columns for modelled in problem.models(logarithms)],
        problem.scene_of(logarithms),
        problem.tables,
    )


def with_profiles(problem: Problem, found: Fit, said: Callable[[str], object] = lambda key: None) -> Fit:
    """The fit with profiles of what goes together; `said` gets the key of each unknown whose profile is made."""
    deviations, profiles = np.log(found.upper / found.lower) / (2 * NORMAL_95), {}
    covariance = found.correlations * np.outer(deviations, deviations)
    for number in np.flatnonzero((np.abs(found.correlations) > CORRELATED).sum(axis=0) > 1):
        said(found.unknowns[number].key)
        profiles[found.unknowns[number].key] = profile(problem, np.log(found.values), covariance, int(number))
    return replace(found, profiles=profiles)


# ---------------------------------------------------------------- the answer
@dataclass(frozen=True)
class Fit(Answer):
    """What a fit has found."""

    unknowns: list[Unknown]
    values: Array
    lower: Array
    upper: Array
    correlations: Array
    misfit: float
    minima: list[float]
    evaluations: list[int]
    modelled: list[dict[str, Array]]
    scene: Scene
    tables: list[Measured]
    profiles: dict[str, LikelihoodProfile] = field(default_factory=dict)

    name = "fit"
    caption = "Points: measured, with one standard deviation; lines: the fitted model."

    @property
    def title(self) -> str:
        """Of the picture."""
        return f"{self.scene.name}: measured and fitted"

    @property
    def keys(self) -> list[str]:
        """Of the unknowns."""
        return [unknown.key for unknown in self.unknowns]

    def table(self) -> dict[str, Any]:
        """A row for each unknown."""
        table = {"key": self.keys, "value": self.values, "lower": self.lower, "upper": self.upper}
        for end in ("lower", "upper"):
            table[f"profile_{end}"] = [getattr(self.profiles.get(key), end, np.nan) for key in self.keys]
        return table | {"start": [unknown.start for unknown in self.unknowns]}

    def lines(self) -> list[str]:
        """A row for each unknown, and its profile."""
        width = max(len(key) for key in self.keys)
        lines = [f"{'':{width}} {'fitted':>12} {'95 % from':>12} {'to':>12} {'start':>12}"]
        for u, *row in zip(self.unknowns, self.values, self.lower, self.upper, strict=True):
            lines.append(f"{u.key:{width}} {' '.join(f'{value:12.5g}' for value in (*row, u.start))}")
        return lines + [f"profile of {key}: 95 % from {one.in_words()}" for key, one in self.profiles.items()]

    def verdict(self) -> str:
        """How far the model is off, how many starts agree, and which unknowns go together."""
        least, keys = min(self.minima), self.keys
        same = sum(one - least <= SAME_MINIMUM * max(least, 1.0) for one in self.minima)
        text = f"The model is off by {self.misfit:.2g} standard deviations (root mean square); "
        text += f"{same} of {len(self.minima)} starts end in this minimum."
        pairs = np.argwhere(np.triu(np.abs(self.correlations) > CORRELATED, 1))
        together = [f"{keys[i]} and {keys[j]} ({self.correlations[i, j]:+.2f})" for i, j in pairs]
        if together:
            text += f" Correlated above {CORRELATED:g}, so that profiles count, not bands: {', '.join(together)}."
        ends = np.log([[u.lower, u.upper] for u in self.unknowns]) - np.log(self.values)[:, None]
        edges = [key for key, away in zip(keys, np.abs(ends).min(axis=1), strict=True) if away < 1e-3]
        return text + (f" At the edge of what is allowed: {', '.join(edges)}." if edges else "")

    def write(self, folder: Path) -> None:
        """Write tables, picture and page."""
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
        write_whole(folder / "fit.html", page_with(self._cards()).encode())

    def figure(self) -> Figure:
        """Each measured column over the load, or time, that was prescribed."""
        shown = [(*pair, name) for pair in zip(self.tables, self.modelled, strict=True) for name in pair[0].sd]
        figure, grid = panels(len(shown), 2.4)
        for axes, (table, modelled, name) in zip(grid, shown, strict=True):
            self._draw(axes, table, name, modelled[name])
        grid[0].legend()
        return figure

    def _draw(self, axes: Any, table: Measured, name: str, modelled: Array) -> None:
        scales, along = dict(zip(self.keys, self.values, strict=True)), table.loads[0] if table.loads else "time"
        x, y = (scales.get(f"{SCALE}{one}", 1.0) * table.columns[one] for one in (along, name))
        order = np.argsort(x)
        axes.errorbar(x, y, yerr=table.sd[name], fmt="o", color=COLOURS[1], label="measured")
        axes.plot(x[order], modelled[order], color=COLOURS[0], label="fitted model")
        axes.set(xlabel=label(self.scene, along), ylabel=label(self.scene, name))
        axes.set_title(f"{table.name} ({table.state})", fontsize=8)

    def _cards(self) -> list[Card]:
        """All that was found, for a page like a run's report: it has title and verdict as text."""
        with rc_context(STYLE):
            self.figure().savefig(plain := io.BytesIO(), dpi=DOTS_PER_INCH["png"])
        picture = base64.b64encode(plain.getvalue()).decode("ascii")
        image = f'<img alt="measured and fitted" width="100%" src="data:image/png;base64,{picture}">'
        note = f'<p class="note">{escape(self.verdict())}</p>'
        numbers, pairs = [], []
        for i, (key, value, low, high) in enumerate(zip(self.keys, self.values, self.lower, self.upper, strict=True)):
            more = f"; profile {self.profiles[key].in_words()}" if key in self.profiles else ""
            numbers.append((key, f"{value:.5g} (95 %: {low:.5g} to {high:.5g}{more})"))
            pairs += [(f"{key}, {self.keys[j]}", f"{self.correlations[i, j]:+.2f}") for j in range(i)]
        return [
            Card("head", f'<header class="whole"><h1>{escape(self.title)}</h1>{note}</header>', {"name": self.title}),
            Card(
                "picture", section("Measured and fitted", image, "whole", "points with one standard deviation; lines")
            ),
            Card("numbers", section("Fitted numbers", card_table(numbers))),
            Card("pairs", section("Correlations of the logarithms", card_table(pairs))),
            Card("scene", folded("The scene with these numbers", f"<pre>{escape(self.scene.to_toml())}</pre>")),
            Card("made", folded("Made with", f"<p>{escape(made_with())}</p>")),
        ]
