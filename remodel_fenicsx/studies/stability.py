"""`remodel-fenicsx stability SCENE`: the factors by which the passes of a run multiply a small change of the cells."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dolfinx.fem.petsc
import numpy as np
from matplotlib.figure import Figure
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc
from slepc4py import SLEPc

from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.fem.assembly import factorised
from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.model.cells import UnitCell, structure_tensor
from remodel_fenicsx.model.laws import LAWS
from remodel_fenicsx.results.run_folder import chosen_folder
from remodel_fenicsx.running import run
from remodel_fenicsx.scene import Scene, SceneError
from remodel_fenicsx.schema.settings import Model
from remodel_fenicsx.simulation import Simulation
from remodel_fenicsx.studies.page import COLOURS, Answer, aligned

log = logging.getLogger(__name__)

GROWS = 1.001  # factor: changes that no pass touches, where tension is missing, keep their size to what was iterated
Table = dict[str, list[float]]


# ---------------------------------------------------------------- the derivative of one pass with respect to the cells
Array = NDArray[np.float64]

STEP = 1e-5  # of the differences, over tr A
DISTINCT = 1e-3  # difference of two squared lengths over tr A below which a turn in their plane is no change of A
SHEAR_PLANES = ((0, 1), (0, 2), (1, 2))
LARGEST_BASIS, RESTARTS = 40, 20  # of the Krylov space
FACTOR_ERROR = 5e-3  # absolute: enough to tell on which side of -1 or 1 a factor is
ENDS = {"reversing": SLEPc.EPS.Which.SMALLEST_REAL, "growing": SLEPc.EPS.Which.LARGEST_REAL}


@dataclass(frozen=True)
class PassMode:
    """A change of the cells that a pass multiplies by a factor; NaN where none was found."""

    factor: float
    place: tuple[float, float, float]
    volume_share: float


NOT_FOUND = PassMode(np.nan, (np.nan, np.nan, np.nan), np.nan)


class LinearPass:
    """The derivative of one pass with respect to the cells at the solved state, as a map of fields of tensors."""

    def __init__(self, stepper: Stepper, time: float, residual: float = 0.0):
        self.state, self.remodeling = stepper.state, stepper.remodeling
        self.equilibrium = stepper.coupling.equilibrium
        self.times, self.residual = (self.state.time, time), residual
        self.quadrature = self.state.cells.quadrature
        cells = self.state.cells.point_cells
        self.cells = cells.copy()
        self.size = np.sum(self.cells.dimensions**2, axis=1)
        # the square of a vector, nine numbers a point, is the integral of |dA|^2
        self._weights = np.sqrt(self.quadrature.owned(self.quadrature.volumes).reshape(-1, 1, 1))
        self.owned = self._weights.size
        vector = self.state.unknown.x.petsc_vec
        self._forces, self._answer, self._x = (vector.duplicate() for _ in range(3))
        self._matrix = self.equilibrium.create_matrix()
        self.equilibrium.assemble_tangent(self._matrix)
        self._solver = factorised(self._matrix)

    def close(self) -> None:
        """Free PETSc's objects."""
        for thing in (self._solver, self._matrix, self._forces, self._answer, self._x):
            thing.destroy()

    # ------------------------------------------------------------ the map
    def __call__(self, change: Array) -> Array:
        """What the pass makes of a small change of A at the owned points, (points, 3, 3) both, by differences."""
        relative = np.linalg.norm(change, axis=(1, 2)) / self.size[: self.owned]
        largest = self.equilibrium.comm.allreduce(float(np.max(relative, initial=0.0)), MPI.MAX)
        if largest == 0.0:
            return np.zeros_like(change)
        step = STEP / largest
        unknown = self.state.unknown.x.array.copy()
        all_changes = np.zeros((len(self.size), 3, 3))  # nothing at a ghost's points enters the forces of this rank
        all_changes[: self.owned] = change
        try:
            ends = [self._changed(sign * step * all_changes) for sign in (1.0, -1.0)]
            answer = self._answer_of_equilibrium(*ends)
            passed = []
            for sign, cells in zip((1.0, -1.0), ends, strict=True):
                self._set(cells)
                self.state.unknown.x.array[:] = unknown + sign * answer
                new, _ = self.remodeling.updated_cells(*self.times, self.residual)
                passed.append(structure_tensor(new.dimensions, new.axes)[: self.owned])
        finally:
            self._set(self.cells)
            self.state.unknown.x.array[:] = unknown
        return (passed[0] - passed[1]) / (2 * step)

    def _changed(self, change: Array) -> UnitCell:
        """The cells with another A, to first order: lengths from the diagonal of the change, turns from the rest."""
        dimensions, axes = self.cells.dimensions, self.cells.axes
        inside = axes @ change @ np.swapaxes(axes, 1, 2)
        squared = dimensions**2
        new = np.sqrt(np.maximum(squared + np.einsum("nii->ni", inside), 0.0))
        turn = np.zeros_like(inside)
        for i, j in SHEAR_PLANES:
            gap = squared[:, i] - squared[:, j]
            distinct = np.abs(gap) > DISTINCT * self.size
            turn[:, i, j] = np.where(distinct, inside[:, i, j] / np.where(distinct, gap, 1.0), 0.0)
            turn[:, j, i] = -turn[:, i, j]
        # Cayley's transform: a rotation, exactly
        identity = np.eye(3)
        return UnitCell(new, np.linalg.solve(identity - turn / 2, (identity + turn / 2) @ axes))

    def _answer_of_equilibrium(self, plus: UnitCell, minus: UnitCell) -> Array:
        """Half the difference of the unknowns in equilibrium with two cells close by: -K^-1 dR."""
        self._answer.set(0.0)
        for sign, cells in ((1.0, plus), (-1.0, minus)):
            self._set(cells)
            self.equilibrium.assemble_internal(self._forces)
            self._answer.axpy(-0.5 * sign, self._forces)
        with self._x.localForm() as local:
            local.array[:] = self.state.unknown.x.array
        conditions = self.state.loading.boundary_conditions
        dolfinx.fem.petsc.set_bc(self._answer, conditions, self._x, 0.0)
        self._solver.solve(self._answer, self._x)
        self._x.ghostUpdate(addv=PETSc.InsertMode.INSERT, mode=PETSc.ScatterMode.FORWARD)
        with self._x.localForm() as local:
            return np.array(local.array_r)

    def _set(self, cells: UnitCell) -> None:
        shape = self.quadrature.shape
        self.state.cells.set(cells.dimensions.reshape(*shape, 3), cells.axes.reshape(*shape, 3, 3))

    def mult(self, matrix: Any, x: Any, y: Any) -> None:
        """The map as a matrix of PETSc: y = A x."""
        y.array[:] = (self(self._tensors(x.array_r)) * self._weights).ravel()

    # ------------------------------------------------------------ its eigenvalues
    def extreme(self, end: str) -> PassMode:
        """The mode with the most negative factor ("reversing") or with the largest ("growing"), where it converges."""
        rows = 9 * self.owned
        total = self.equilibrium.comm.allreduce(rows, MPI.SUM)
        operator = PETSc.Mat().createPython(((rows, total), (rows, total)), self, self.equilibrium.comm)
        operator.setUp()
        solver: Any = SLEPc.EPS().create(self.equilibrium.comm)
        solver.setOperators(operator)
        solver.setProblemType(SLEPc.EPS.ProblemType.NHEP)
        solver.setWhichEigenpairs(ENDS[end])
        solver.setDimensions(1, min(LARGEST_BASIS, total))
        solver.setTolerances(FACTOR_ERROR, RESTARTS)
        solver.setConvergenceTest(SLEPc.EPS.Conv.ABS)
        start = operator.createVecRight()
        random = np.random.default_rng(1).standard_normal((self.owned, 3, 3))
        start.array[:] = (random + np.swapaxes(random, 1, 2)).ravel()  # A is symmetric, and so is what a pass makes
        solver.setInitialSpace(start)
        solver.solve()
        found = NOT_FOUND
        if solver.getConverged():
            found = self._mode(float(np.real(solver.getEigenpair(0, start))), self._tensors(start.array_r))
        for thing in (solver, operator, start):
            thing.destroy()
        return found

    def _mode(self, factor: float, change: Array) -> PassMode:
        comm, volumes = self.equilibrium.comm, self._weights.ravel() ** 2
        square = np.sum(change**2, axis=(1, 2))
        first, second, whole = (
            float(comm.allreduce(np.sum(volumes * values))) for values in (square, square**2, np.ones(self.owned))
        )
        place = self.quadrature.place_of_largest(square.reshape(-1, self.quadrature.shape[1]))
        return PassMode(factor, place, first**2 / second / whole)

    def _tensors(self, vector: Array) -> Array:
        """Changes of A (points, 3, 3) of a vector."""
        return np.asarray(vector.reshape(-1, 3, 3) / self._weights)


@dataclass(frozen=True)
class Amplification:
    """The extreme modes of a step's pass."""

    time: float
    reversing: PassMode
    growing: PassMode


class AmplificationWatcher(Watcher):
    """Computes the extreme modes of the pass of chosen steps."""

    def __init__(self, stepper: Stepper, chosen: Callable[[Step], bool]):
        self.stepper, self.chosen = stepper, chosen
        self.found: list[Amplification] = []

    def solved(self, step: Step) -> None:
        """Look."""
        if not self.chosen(step):
            return
        with closing(LinearPass(self.stepper, step.time, step.work.residual)) as linear:
            modes = [linear.extreme(end) for end in ENDS]
            if NOT_FOUND in modes and linear.equilibrium.comm.rank == 0:
                words = f"not found to {FACTOR_ERROR:g} after {RESTARTS} restarts"
                log.warning("time %g: a factor of the pass was %s", step.time, words)
        self.found.append(Amplification(step.time, *modes))

    def committed(self, step: Step) -> None:
        """Say it."""
        if self.chosen(step):
            factor = self.found[-1].reversing.factor
            log.info("time %g: a pass multiplies the worst small change by %.3g", step.time, factor)

    def undone(self, step: Step) -> None:
        """What was found of the step goes."""
        if self.found and self.found[-1].time == step.time:
            self.found.pop()


def stability(
    scene: Scene,
    folder: Path | str | None = None,
    number: int = 10,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    quiet: bool = True,
) -> tuple[Path, Analysis]:
    """Run a scene and analyse the stability of its passes on the way."""
    if not LAWS[scene.remodeling.law].remodels:
        raise SceneError(f"remodeling.law = {scene.remodeling.law!r}: nothing remodels, so there is no pass to analyse")
    if scene.cases[1:]:
        raise SceneError("cases: the analysis takes one load case; leave out [[cases]]")
    if scene.time.tolerance is not None and not scene.time.is_equilibrium:
        raise SceneError(f"time.tolerance = {scene.time.tolerance:g}: the analysis needs equal steps; leave it out")
    place = chosen_folder(folder, f"{scene.name}-stability", comm)
    steps, made = scene.time.number_of_steps, list[AmplificationWatcher]()
    chosen = {round(steps * (index + 1) / number) for index in range(number)}

    def watcher(simulation: Simulation) -> Watcher:
        made.append(AmplificationWatcher(simulation.stepper, lambda step: step.number in chosen))
        return made[0]

    def answer() -> Analysis:
        share, kinematics = made[0].stepper.remodeling.relaxation, made[0].stepper.state.kinematics.name
        taken = scene.model_copy(update={"model": Model(kinematics=kinematics)})
        return Analysis(taken, as_table(made[0], share), share)

    try:
        run(scene.with_values({"output.fields": False}), place, comm, quiet, report=False, watchers=[watcher])
    finally:
        if comm.rank == 0 and made and made[0].found:  # of a run that ends early too
            answer().write(place)
    return place, answer()


def unseen_by(scene: Scene) -> str:
    """What an analysis on the scene's kinematics does not see, in a sentence; nothing where it sees all."""
    name = scene.model.kinematics
    if not KINEMATICS[name].reduced:
        return ""
    return (
        f"kinematics {name!r} sees changes that keep its symmetry only: passes of the whole body may multiply others "
        "by more, and the body may buckle; model.kinematics = 'full' sees all"
    )


def as_table(watcher: AmplificationWatcher, share: float) -> Table:
    """Columns of stability.csv, one row per time that was analysed; NaN where a mode was not found."""
    reversing = [found.reversing for found in watcher.found]
    factors, places = np.array([mode.factor for mode in reversing]), np.array([mode.place for mode in reversing])
    return {
        "time": [found.time for found in watcher.found],
        "factor": list(factors),
        "factor_of_coupling": list(1 - share * (1 - factors)),
        "stable_share": list(np.minimum(1.0, 2 / (1 - np.minimum(factors, 0.0)))),
        **dict(zip("xyz", map(list, places.T), strict=True)),
        "volume_share": [mode.volume_share for mode in reversing],
        "growing_factor": [found.growing.factor for found in watcher.found],
    }


# ---------------------------------------------------------------- the answer
@dataclass(frozen=True)
class Analysis(Answer):
    """Factors of the passes, by column of stability.csv; the coupling makes a share of each pass."""

    scene: Scene
    columns: Table
    share: float

    name = "stability"
    caption = "Factor by which one pass multiplies the worst small change of the cells; below -1 it swings and grows."

    @property
    def title(self) -> str:
        """Of the picture."""
        how = self.scene.remodeling
        return f"{self.scene.name}: driver {how.driver}, frame {how.frame}, coupling {how.coupling}"

    def table(self) -> Table:
        """A row for each time."""
        return self.columns

    def lines(self) -> list[str]:
        """A row for each time."""
        return aligned(self.columns, 8, 5)

    def verdict(self) -> str:
        """Whether passes with the scene's coupling make small changes smaller; and what the analysis does not see."""
        unseen = unseen_by(self.scene)
        return verdict(self.columns, self.scene.time.step) + (f" But {unseen}." if unseen else "")

    def figure(self) -> Figure:
        """Factors over time."""
        figure = Figure(figsize=(5.2, 3.4), layout="constrained")
        axes, table = figure.add_subplot(), self.columns
        axes.axhspan(-1, 1, color=COLOURS[2], alpha=0.12, linewidth=0, label="stable: from −1 to 1")
        axes.plot(table["time"], table["factor"], "o-", markersize=4, color=COLOURS[1], label="whole pass")
        if self.share != 1.0:
            words = f"the share {self.share:g} of it that is made"
            axes.plot(table["time"], table["factor_of_coupling"], "s-", markersize=4, color=COLOURS[0], label=words)
        lowest = np.nanmin([*table["factor"], -1.6])
        axes.set_yscale("symlog", linthresh=2)
        axes.set(ylim=(1.3 * lowest, 1.2), xlabel="time")
        axes.set(ylabel="factor of one pass on the\nworst small change of the cells")
        axes.set_xlim(left=0)
        figure.legend(loc="outside lower center", ncols=2)
        return figure


def verdict(table: Table, step: float) -> str:
    """The answer in a sentence: whether passes with the scene's coupling make small changes smaller."""
    times, factors, growing = (np.array(table[name]) for name in ("time", "factor_of_coupling", "growing_factor"))
    unknown = ~np.isfinite(table["factor"])
    swings, grows = factors < -1, growing > GROWS
    if swings.any():
        worst, share = int(np.nanargmin(factors)), np.nanmin(table["stable_share"])
        return (
            f"Unstable: passes over-correct at {swings.sum()} of {len(times)} times, first at {times[swings][0]:g}; "
            f"the worst multiplies a small change by {factors[worst]:.3g} at time {times[worst]:g}. The coupling "
            f"'relaxed' with a relaxation_factor below {share:.2g} does not."
        )
    if grows.any():
        worst = int(np.nanargmax(growing))
        return (
            f"Unstable: at {grows.sum()} of {len(times)} times a small change of the cells grows from pass to pass "
            f"without swinging, first at {times[grows][0]:g}; at time {times[worst]:g} by a factor of "
            f"{growing[worst]:.6g} a pass, {growing[worst] ** (1 / step):.6g} a unit of time."
        )
    if unknown.any():
        return f"Not known: at {unknown.sum()} of {len(times)} times no mode was found (run.log); stable at all others."
    return (
        f"Stable: at all {len(times)} times a pass makes small changes of the cells smaller, or keeps them as they are."
    )
