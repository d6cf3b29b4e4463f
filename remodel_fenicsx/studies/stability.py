"""`remodel-fenicsx stability SCENE`: the factor by which a pass of a run multiplies a small change of the cells."""

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
from remodel_fenicsx.simulation import Simulation
from remodel_fenicsx.studies.page import COLOURS, Answer, aligned

log = logging.getLogger(__name__)

GROWS = 1.001  # factor: changes that no pass touches, where tension is missing, keep their size to what was iterated


# ---------------------------------------------------------------- the derivative of one pass with respect to the cells
Array = NDArray[np.float64]

STEP = 1e-5  # of the differences, over tr A
DISTINCT = 1e-3  # difference of two squared lengths over tr A below which a turn in their plane is no change of A
SHEAR_PLANES = ((0, 1), (0, 2), (1, 2))
LARGEST_BASIS, RESTARTS = 40, 20  # of the Krylov space
FACTOR_ERROR = 5e-3  # absolute: enough to tell on which side of -1 or 1 a factor is


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
        """Apply the share of the pass that the coupling makes, as a matrix of PETSc: y = A x."""
        share, change = self.remodeling.relaxation, x.array_r.reshape(-1, 3, 3)
        whole = self(np.asarray(change / self._weights)) * self._weights
        y.array[:] = ((1 - share) * change + share * whole).ravel()

    # ------------------------------------------------------------ its eigenvalue
    def factor(self) -> float:
        """Return the eigenvalue of largest magnitude, with the sign of its real part; NaN if it does not converge."""
        rows = 9 * self.owned
        total = self.equilibrium.comm.allreduce(rows, MPI.SUM)
        operator = PETSc.Mat().createPython(((rows, total), (rows, total)), self, self.equilibrium.comm)
        operator.setUp()
        solver: Any = SLEPc.EPS().create(self.equilibrium.comm)
        solver.setOperators(operator)
        solver.setProblemType(SLEPc.EPS.ProblemType.NHEP)
        solver.setDimensions(1, min(LARGEST_BASIS, total))
        solver.setTolerances(FACTOR_ERROR, RESTARTS)
        solver.setConvergenceTest(SLEPc.EPS.Conv.ABS)
        start = operator.createVecRight()
        random = np.random.default_rng(1).standard_normal((self.owned, 3, 3))
        start.array[:] = (random + np.swapaxes(random, 1, 2)).ravel()  # A is symmetric, and so is what a pass makes
        solver.setInitialSpace(start)
        solver.solve()
        value = solver.getEigenvalue(0) if solver.getConverged() else complex(np.nan)
        for thing in (solver, operator, start):
            thing.destroy()
        return float(np.copysign(abs(value), value.real))


class FactorWatcher(Watcher):
    """Computes the factor of the pass of chosen steps, by their times."""

    def __init__(self, stepper: Stepper, chosen: Callable[[Step], bool]):
        self.stepper, self.chosen = stepper, chosen
        self.factors: dict[float, float] = {}

    def solved(self, step: Step) -> None:
        """Compute it."""
        if self.chosen(step):
            with closing(LinearPass(self.stepper, step.time, step.work.residual)) as linear:
                self.factors[step.time] = linear.factor()

    def committed(self, step: Step) -> None:
        """Log it."""
        if step.time in self.factors:
            log.info(
                "time %g: a pass multiplies a small change of the cells by %.3g", step.time, self.factors[step.time]
            )

    def undone(self, step: Step) -> None:
        """Forget it."""
        self.factors.pop(step.time, None)


def stability(
    scene: Scene,
    folder: Path | str | None = None,
    number: int = 10,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    quiet: bool = True,
) -> tuple[Path, Analysis]:
    """Run a scene and compute the factor of its passes at some times."""
    if not LAWS[scene.remodeling.law].remodels:
        raise SceneError(f"remodeling.law = {scene.remodeling.law!r}: nothing remodels, so there is no pass to analyse")
    if scene.cases[1:]:
        raise SceneError("cases: the analysis takes one load case; leave out [[cases]]")
    if scene.time.tolerance is not None and not scene.time.is_equilibrium:
        raise SceneError(f"time.tolerance = {scene.time.tolerance:g}: the analysis needs equal steps; leave it out")
    place = chosen_folder(folder, f"{scene.name}-stability", comm)
    steps, made = scene.time.number_of_steps, list[FactorWatcher]()
    chosen = {round(steps * (index + 1) / number) for index in range(number)}

    def watcher(simulation: Simulation) -> Watcher:
        made.append(FactorWatcher(simulation.stepper, lambda step: step.number in chosen))
        return made[0]

    def answer() -> Analysis:
        stepper = made[0].stepper
        return Analysis(scene, made[0].factors, stepper.state.kinematics.name, stepper.remodeling.relaxation)

    try:
        run(scene.with_values({"output.fields": False}), place, comm, quiet, report=False, watchers=[watcher])
    finally:
        if comm.rank == 0 and made and made[0].factors:  # of a run that ends early too
            answer().write(place)
    return place, answer()


# ---------------------------------------------------------------- the answer
@dataclass(frozen=True)
class Analysis(Answer):
    """Factors of the passes, of which the coupling makes a share, by time; NaN where none was found."""

    scene: Scene
    factors: dict[float, float]
    kinematics: str
    share: float

    name = "stability"
    caption = "Factor by which one pass multiplies a small change of the cells; beyond -1 and 1 the change grows."

    @property
    def title(self) -> str:
        """Of the picture."""
        how = self.scene.remodeling
        return f"{self.scene.name}: driver {how.driver}, frame {how.frame}, coupling {how.coupling}"

    def table(self) -> dict[str, list[float]]:
        """A row for each time."""
        return {"time": [*self.factors], "factor": [*self.factors.values()]}

    def lines(self) -> list[str]:
        """A row for each time."""
        return aligned(self.table(), 8, 5)

    def verdict(self) -> str:
        """Whether passes make small changes smaller; and what a reduction does not see."""
        number, times, factors = len(self.factors), *map(np.array, self.table().values())
        grows = np.abs(factors) > GROWS
        text = f"Stable: at all {number} times a pass makes small changes of the cells smaller, or keeps them."
        if grows.any():
            worst = int(np.nanargmax(np.abs(factors)))
            text = (
                f"Unstable: at {grows.sum()} of {number} times a pass makes small changes of the cells larger, first "
                f"at {times[grows][0]:g}; the worst by a factor of {factors[worst]:.5g}, at time {times[worst]:g}."
            )
            if (lowest := np.nanmin(factors)) < -GROWS:  # of a smaller share it is 1 - (1 - factor) smaller / share
                damping = 2 * self.share / (1 - lowest)
                text += f" The coupling 'relaxed' with a relaxation_factor below {damping:.2g} damps what swings."
        elif missing := np.isnan(factors).sum():
            text = f"Not known: at {missing} of {number} times no factor was found; stable at all others."
        if KINEMATICS[self.kinematics].reduced:
            text += f" But kinematics {self.kinematics!r} sees changes that keep its symmetry only; 'full' sees all."
        return text

    def figure(self) -> Figure:
        """Factors over time."""
        figure = Figure(figsize=(5.2, 3.4), layout="constrained")
        axes = figure.add_subplot()
        axes.axhspan(-1, 1, color=COLOURS[2], alpha=0.12, linewidth=0, label="stable: from −1 to 1")
        axes.plot(*self.table().values(), "o-", markersize=4, color=COLOURS[1], label="one pass")
        axes.set_yscale("symlog", linthresh=2)
        axes.set(xlabel="time", ylabel="factor of one pass on a\nsmall change of the cells")
        axes.set_xlim(left=0)
        figure.legend(loc="outside lower center", ncols=2)
        return figure
