"""`remodel-fenicsx fit SCENE DATA.toml`: numbers of a scene from measurements, with what the data say of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.results.run_folder import chosen_folder
from remodel_fenicsx.results.words import unit_of, words
from remodel_fenicsx.scene.scene import Scene, SceneError
from remodel_fenicsx.simulation import Simulation, with_kinematics
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.studies.measured import Measured, Unknown, read_measurements
from remodel_fenicsx.studies.page import COLOURS, STYLE, Page, add_head
from remodel_fenicsx.system.environment import versions
from remodel_fenicsx.system.regular_files import write_whole
from remodel_fenicsx.system.terminal import Line

Array = NDArray[np.float64]

FIT = "fit"
LOGARITHM_CHANGE = 1e-3  # of a logarithm: central differences err by 1e-6, the solves' tolerance of 1e-10 by 1e-7
BLIND = 1e-5  # smallest singular value over the largest, below which the data say nothing: what differences err by
NAMED = 0.1  # share of a blind direction from which on an unknown is named
UNSOLVED = 1e3  # standard deviations, of all rows of a state that has no equilibrium
START_SPREAD = np.log(2.0)  # of further starts, to both sides
SAME_MINIMUM = 1e-2  # relative difference of the sums of squares
NORMAL_95 = 1.959963984540054  # standard deviations on each side, normal distribution


@dataclass(frozen=True)
class Fit:
    """What a fit has found.

    Attributes
    ----------
    unknowns
        As they were asked for.
    values, lower, upper
        Fitted numbers and their 95 % bands, (unknowns,).
    correlations
        Of the logarithms, (unknowns, unknowns).
    misfit
        Root mean square of the residuals over their standard deviations: about one where model and bands are right.
    minima
        Sum of squares that each start has reached.
    evaluations
        How often the solver asked for residuals, by start; derivatives not counted.
    modelled
        Columns of each table at the fit.
    scene
        With the fitted numbers.
    """

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


# ---------------------------------------------------------------- the model of a table
def model_of(scene: Scene, table: Measured, scales: Mapping[str, float]) -> dict[str, Array]:
    """What a scene says where a table has measurements, by column.

    Raises
    ------
    StepFailure
        If a state has no equilibrium.
    """
    wanted = {column.name for column in scene.columns()}
    scene = scene.with_values({"output.columns": [*scene.output.columns, *(n for n in table.sd if n not in wanted)]})
    if table.state == "history":
        end = float(scene.time.step * np.ceil(table.columns["time"].max() / scene.time.step - 1e-9))
        history, _ = _rows(scene.with_values({"time.end": max(end, scene.time.step)}), table)
        return {name: np.interp(table.columns["time"], history["time"], history[name]) for name in table.sd}
    cells = None
    if table.state == "after":
        scene = with_kinematics(scene)
        _, cells = _rows(scene.with_values({"time.end": table.time}), table)
    history, _ = _rows(_passive(scene, table, scales), table, cells)
    return {name: history[name][history["time"] > 0] for name in table.sd}


def _passive(scene: Scene, table: Measured, scales: Mapping[str, float]) -> Scene:
    """Cells that stay, and a step for each row; loads that the table has not keep their last value."""
    changes: dict[str, Any] = {"remodeling.law": "none", "remodeling.coupling": "staggered", "output.times": []}
    changes |= {"time.step": 1.0, "time.end": float(table.rows), "time.tolerance": None}
    for name, load in scene.loads.items():
        values: Array = np.full(table.rows, load.value * load.factor(scene.last_time))
        if name in table.loads:
            values = scales.get(name, 1.0) * table.columns[name]
        largest = float(values[np.abs(values).argmax()]) or 1.0
        ramp = [[0.0, 0.0], *([number + 1.0, float(value / largest)] for number, value in enumerate(values))]
        changes |= {f"loads.{name}.value": largest, f"loads.{name}.ramp": ramp}
    return scene.with_values(changes)


def _rows(scene: Scene, table: Measured, cells: tuple[Array, Array] | None = None) -> tuple[dict[str, Array], Any]:
    """Measured columns of a run over its time, and the cells at its end."""
    simulation = Simulation(scene, MPI.COMM_SELF)
    try:
        if cells is not None:
            simulation.cells.set(*cells)
            simulation.state.settle_cells()
        rows = [step.row for step in simulation.steps()]
        kept = simulation.cells.dimension_values.copy(), simulation.cells.axis_values.copy()
    finally:
        simulation.close()
    return {name: np.array([row[name] for row in rows]) for name in ("time", *table.sd)}, kept


# ---------------------------------------------------------------- least squares
class Problem:
    """Residuals over their standard deviations as a function of the logarithms of the unknowns."""

    def __init__(self, scene: Scene, unknowns: Sequence[Unknown], tables: Sequence[Measured]):
        self.scene, self.unknowns, self.tables = scene, list(unknowns), list(tables)
        self._known = cache(self._residuals)

    def scene_of(self, logarithms: Array) -> Scene:
        """The scene with these numbers."""
        found = {u.key: float(np.exp(x)) for u, x in zip(self.unknowns, logarithms, strict=True)}
        return self.scene.with_values({key: value for key, value in found.items() if not key.startswith("scale.")})

    def scales_of(self, logarithms: Array) -> dict[str, float]:
        """Factors on columns, by name."""
        pairs = zip(self.unknowns, logarithms, strict=True)
        return {u.key.removeprefix("scale."): float(np.exp(x)) for u, x in pairs if u.key.startswith("scale.")}

    def models(self, logarithms: Array) -> list[dict[str, Array]]:
        """What the model says of each table."""
        scene, scales = self.scene_of(logarithms), self.scales_of(logarithms)
        return [model_of(scene, table, scales) for table in self.tables]

    def residuals(self, logarithms: Array) -> Array:
        """Model less measurement over standard deviation, table by table; then the priors."""
        return self._known(tuple(map(float, logarithms)))

    def _residuals(self, logarithms: tuple[float, ...]) -> Array:
        x = np.array(logarithms)
        scales, parts = self.scales_of(x), []
        models: list[dict[str, Array]] | None = None
        try:
            models = self.models(x)
        except StepFailure:
            models = None
        for number, table in enumerate(self.tables):
            for name, sd in table.sd.items():
                measured = scales.get(name, 1.0) * table.columns[name]
                off = models[number][name] - measured if models else np.full(table.rows, UNSOLVED * sd)
                parts.append(off / sd)
        for unknown, value in zip(self.unknowns, x, strict=True):
            if unknown.prior is not None and unknown.prior_sd is not None:
                parts.append(np.array([(value - np.log(unknown.prior)) / unknown.prior_sd]))
        return np.concatenate(parts)

    def jacobian(self, logarithms: Array, central: bool = False) -> Array:
        """Derivatives by differences, (residuals, unknowns)."""
        present, columns = self.residuals(logarithms), []
        for change in LOGARITHM_CHANGE * np.eye(len(logarithms)):
            if central:
                ahead, behind = self.residuals(logarithms + change), self.residuals(logarithms - change)
                columns.append((ahead - behind) / (2 * LOGARITHM_CHANGE))
            else:
                columns.append((self.residuals(logarithms + 0.1 * change) - present) / (0.1 * LOGARITHM_CHANGE))
        return np.stack(columns, axis=1)

    def check_tells_apart(self, jacobian: Array) -> None:
        """Refuse unknowns of which the data say nothing.

        Raises
        ------
        SceneError
            One line that names them.
        """
        _, singular, directions = np.linalg.svd(jacobian, full_matrices=False)
        if singular[-1] > BLIND * singular[0]:
            return
        blind = directions[-1] * np.sign(directions[-1][np.abs(directions[-1]).argmax()])
        named = [f"{u.key} ({part:+.2f})" for u, part in zip(self.unknowns, blind, strict=True) if abs(part) > NAMED]
        raise SceneError(
            f"unknowns: the data cannot tell apart {', '.join(named)}: changed together by these powers of a factor "
            "they give the same measurements; fix one of them or give it a prior"
        )


def fit(
    scene: Scene, data: Path | str, folder: Path | str | None = None, starts: int = 3, quiet: bool = True
) -> tuple[Path, Fit]:
    """Fit numbers of a scene to measurements.

    Parameters
    ----------
    scene
        All that is not fitted.
    data
        A TOML file with `[unknowns]` and `[[measured]]` (docs/fit.md).
    folder
        New or empty; default: results/FIT-fit, numbered when taken.
    starts
        How many: the given one, and others at random within a factor of two.
    quiet
        No progress.

    Returns
    -------
    The folder with fit.csv, correlations.csv, scene.toml and fit.png; and what they hold.

    Raises
    ------
    SceneError
        If a key, a unit or a number is not allowed, or if the data cannot tell the unknowns apart.
    StepFailure
        If the scene has no equilibrium where the fit starts.
    FolderTaken
        If the folder is not empty.
    OSError
        If a file cannot be written.
    """
    from scipy.optimize import least_squares

    unknowns, tables = read_measurements(Path(data), scene)
    place = chosen_folder(folder, f"{scene.name}-{FIT}", MPI.COMM_SELF)
    problem, line = Problem(scene, unknowns, tables), Line(f"{scene.name} {FIT}")
    first = np.log([unknown.start for unknown in unknowns])
    bounds = np.log([u.lower for u in unknowns]), np.log([u.upper for u in unknowns])
    problem.models(first)  # what has no equilibrium here says so
    problem.check_tells_apart(problem.jacobian(first, central=True))
    random = np.random.default_rng(1)
    found = []
    try:
        for number in range(starts):
            start = first + (random.uniform(-START_SPREAD, START_SPREAD, len(first)) if number else 0.0)
            inside = np.clip(start, bounds[0] + 1e-6, bounds[1] - 1e-6)

            def residuals(x: Array, number: int = number) -> Array:
                off = problem.residuals(x)
                if not quiet:
                    line.show(f"start {number + 1} of {starts}, misfit {np.sqrt(np.mean(off**2)):.4g}")
                return off

            found.append(
                least_squares(residuals, inside, jac=problem.jacobian, bounds=bounds, x_scale="jac", xtol=1e-8)
            )
    finally:
        line.end()
    best = min(found, key=lambda one: float(one.cost))
    result = _result(problem, best.x, [2 * float(one.cost) for one in found], [int(one.nfev) for one in found])
    place.mkdir(parents=True, exist_ok=True)
    write_whole(place / "scene.toml", result.scene.to_toml(f"fitted to {Path(data).name}").encode())
    _draw(result, tables, place)
    return place, result


def _result(problem: Problem, logarithms: Array, minima: list[float], evaluations: list[int]) -> Fit:
    jacobian = problem.jacobian(logarithms, central=True)
    problem.check_tells_apart(jacobian)
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    deviations = np.sqrt(np.diag(covariance))
    off = problem.residuals(logarithms)
    return Fit(
        problem.unknowns,
        np.exp(logarithms),
        np.exp(logarithms - NORMAL_95 * deviations),
        np.exp(logarithms + NORMAL_95 * deviations),
        covariance / np.outer(deviations, deviations),
        float(np.sqrt(np.mean(off**2))),
        minima,
        evaluations,
        problem.models(logarithms),
        problem.scene_of(logarithms),
    )


# ---------------------------------------------------------------- words and picture
def in_words(found: Fit) -> str:
    """A table for a terminal; then how good the fit is, in a sentence."""
    width = max(len(unknown.key) for unknown in found.unknowns)
    lines = [f"{'':{width}} {'fitted':>12} {'95 % from':>12} {'to':>12} {'start':>12}"]
    for number, u in enumerate(found.unknowns):
        row = (found.values[number], found.lower[number], found.upper[number], u.start)
        lines.append(f"{u.key:{width}} {' '.join(f'{value:12.5g}' for value in row)}")
    return "\n".join([*lines, verdict(found)])


def verdict(found: Fit) -> str:
    """How far the model is off, how many starts agree, and which unknowns go together."""
    least = min(found.minima)
    same = sum(one - least <= SAME_MINIMUM * max(least, 1.0) for one in found.minima)
    text = f"The model is off by {found.misfit:.2g} standard deviations (root mean square); "
    text += f"{same} of {len(found.minima)} starts end in this minimum."
    pairs = np.argwhere(np.triu(np.abs(found.correlations) > 0.9, 1))
    keys = [unknown.key for unknown in found.unknowns]
    together = [f"{keys[i]} and {keys[j]} ({found.correlations[i, j]:+.2f})" for i, j in pairs]
    if together:
        text += f" Correlated above 0.9, so that bands are those of a straight line at best: {', '.join(together)}."
    edges = [
        u.key
        for u, v in zip(found.unknowns, found.values, strict=True)
        if min(abs(np.log(v / u.lower)), abs(np.log(v / u.upper))) < 1e-3
    ]
    return text + (f" At the edge of what is allowed: {', '.join(edges)}." if edges else "")


def _label(name: str, units: Mapping[str, str]) -> str:
    return words(name) + (f", {units[name]}" if units.get(name) else "")


def _draw(found: Fit, tables: Sequence[Measured], folder: Path) -> None:
    """Write fit.csv, correlations.csv and fit.png."""
    title = f"{found.scene.name}: measured and fitted"
    page = Page(folder, FIT, title, "Points: measured, with one standard deviation; lines: the fitted model.")
    made_with = ", ".join(f"{name} {version}" for name, version in versions().items() if name != "BLAS")
    keys = [unknown.key for unknown in found.unknowns]
    table = {"value": found.values, "lower": found.lower, "upper": found.upper}
    page.save_table({"key": keys, **table, "start": [u.start for u in found.unknowns]}, [title, made_with])
    correlations = Page(folder, "correlations", title, "")
    correlations.save_table({"key": keys, **dict(zip(keys, found.correlations, strict=True))}, [title, made_with])
    panels = [(number, name) for number, one in enumerate(tables) for name in one.sd]
    units = {column.name: unit_of(found.scene, column.unit) for column in found.scene.columns()}
    kinds = found.scene.load_kinds
    units |= {name: unit_of(found.scene, kind.dimension.name) for name, kind in kinds.items() if kind.dimension}
    scales = {u.key: value for u, value in zip(found.unknowns, found.values, strict=True)}
    with rc_context(STYLE):
        rows = -(-len(panels) // 2)
        figure = Figure(figsize=(7.2, 2.4 * rows + 0.4), layout="constrained")
        grid = figure.subplots(rows, 2, squeeze=False).ravel()
        for axes, (number, name) in zip(grid, panels, strict=False):
            one = tables[number]
            along = one.loads[0] if one.loads else "time"
            x = scales.get(f"scale.{along}", 1.0) * one.columns[along]
            y, order = scales.get(f"scale.{name}", 1.0) * one.columns[name], np.argsort(x)
            axes.errorbar(x, y, yerr=one.sd[name], fmt="o", color=COLOURS[1], label="measured")
            axes.plot(x[order], found.modelled[number][name][order], color=COLOURS[0], label="fitted model")
            axes.set(xlabel=_label(along, units), ylabel=_label(name, units))
            axes.set_title(f"{one.name} ({one.state})", fontsize=8)
        grid[0].legend()
        for axes in grid[len(panels) :]:
            axes.set_axis_off()
        add_head(figure, title, verdict(found))
        page.save_figure(figure, made_with)
