"""`remodel-fenicsx fit SCENE DATA.toml`: numbers of a scene from measurements, with what the data say of them."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.results.run_folder import chosen_folder
from remodel_fenicsx.results.words import unit_of, words
from remodel_fenicsx.scene.scene import Scene, SceneError
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.studies.measured import Measured, Unknown, read_measurements
from remodel_fenicsx.studies.modelled import Modelled, Slopes, model_of, rotated_cells, slopes, without_derivatives
from remodel_fenicsx.studies.page import COLOURS, STYLE, Page, add_head
from remodel_fenicsx.system.environment import versions
from remodel_fenicsx.system.regular_files import write_whole
from remodel_fenicsx.system.terminal import Line

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

FIT = "fit"
SCALE = "scale."  # what keys of factors on columns begin with
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


# ---------------------------------------------------------------- least squares
class Evaluation(NamedTuple):
    """Residuals (n,) at a point, and their derivatives (n, k): NaN in columns that the model does not give."""

    residuals: Array
    jacobian: Array


class Problem:
    """Residuals over their standard deviations as a function of the logarithms of the unknowns.

    Attributes
    ----------
    exact
        Which unknowns have derivatives of the model, (k,); those of the others are differences of runs.
    reason
        Why there are others.
    """

    def __init__(self, scene: Scene, unknowns: Sequence[Unknown], tables: Sequence[Measured]):
        self.scene, self.unknowns, self.tables = scene, list(unknowns), list(tables)
        self._known: dict[tuple[float, ...], Evaluation] = {}
        first = np.log([unknown.start for unknown in unknowns])
        words = [reason for table in tables if (reason := without_derivatives(scene, table)) is not None]
        if not words and rotated_cells(scene):
            words = [f"cells.axes = {scene.cells.axes!r}"]
        self.exact: NDArray[np.bool_] = np.zeros(len(first), dtype=np.bool_) if words else self._slopes(first).exact
        self.reason = words[0] if words else "the model has no derivative by them"

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
        """What the model says of each table, with derivatives on request.

        Raises
        ------
        StepFailure
            If a state has no equilibrium.
        """
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
            self._known[key] = self._evaluated(np.array(logarithms), derivatives and bool(self.exact.any()))
        return self._known[key]

    def _evaluated(self, x: Array, derivatives: bool) -> Evaluation:
        scales, parts, slopes_ = self.scales_of(x), [], []
        models: list[Modelled] | None = None
        with suppress(StepFailure):
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
        present, found = self.at(logarithms)
        found = found.copy()
        for k, change in enumerate(LOGARITHM_CHANGE * np.eye(len(logarithms))):
            if self.exact[k]:
                continue
            if central:
                ahead, behind = (self.at(logarithms + way, False).residuals for way in (change, -change))
                found[:, k] = (ahead - behind) / (2 * LOGARITHM_CHANGE)
            else:
                ahead = self.at(logarithms + 0.1 * change, False).residuals
                found[:, k] = (ahead - present) / (0.1 * LOGARITHM_CHANGE)
        return found

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
    log.info("%s", problem.how())
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
        [modelled.columns for modelled in problem.models(logarithms)],
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
