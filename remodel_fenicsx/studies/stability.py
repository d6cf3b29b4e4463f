"""Command `stability`: amplification factors of small changes of the cells by remodeling passes."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from mpi4py import MPI

from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.model.cells import structure_tensor
from remodel_fenicsx.model.laws import LAWS, cells_from_structure, relaxed
from remodel_fenicsx.model.tensors import Array
from remodel_fenicsx.results.run_folder import chosen_folder
from remodel_fenicsx.running import run
from remodel_fenicsx.scene import Scene, SceneError
from remodel_fenicsx.simulation import Simulation
from remodel_fenicsx.solver.newton import SolveFailure
from remodel_fenicsx.studies.study import COLOURS, StudyResult

log = logging.getLogger(__name__)


# Smallest factor of growth. Without tension no pass affects a change, and its factor is 1 up to the
# error of the iteration.
GROWS = 1.001
SIZE = 1e-5  # size of a change of A, over tr A
PASSES = 40  # largest number of passes, each a solve
SETTLED = 1e-4  # relative difference of the factors of two passes at convergence
AVERAGED = 10  # number of last factors to average without convergence, as for rotating changes


def pass_factor(stepper: Stepper, step: Step) -> float:
    """Return the factor of passes on a small change of A at the solved state; < 0 if A oscillates.

    This is a power iteration: each pass starts from the change that the previous one has left,
    scaled to be small.
    """
    state, remodeling = stepper.state, stepper.remodeling
    quadrature, cells = state.cells.quadrature, state.cells.point_cells.copy()
    tensor = structure_tensor(*cells[:2])
    newton = getattr(stepper.coupling, "newton")  # noqa: B009 - user-supplied couplings

    def passed() -> Array:
        target, _ = remodeling.updated_cells(state.time, step.time, step.work.residual)
        relaxed_cells = relaxed(state.cells.point_cells, target, remodeling.relaxation)
        return structure_tensor(*relaxed_cells[:2])

    def dot(one: Array, other: Array) -> float:
        return quadrature.integral(np.sum(one * other, axis=(1, 2)))

    factors: list[float] = []
    with state.tentative():
        undisturbed, change = passed(), np.random.default_rng(1).standard_normal(tensor.shape)
        change += np.swapaxes(change, 1, 2)
        for _ in range(PASSES):
            relative = np.linalg.norm(change, axis=(1, 2)) / np.trace(tensor, axis1=1, axis2=2)
            if not (largest := quadrature.maximum(relative.reshape(quadrature.shape))):
                return 0.0
            change *= SIZE / largest
            state.cells.set(*cells_from_structure(tensor + change, cells.axes)[:2])
            newton.solve()
            before, change = change, passed() - undisturbed
            factors.append(
                float(
                    np.copysign(
                        (dot(change, change) / dot(before, before)) ** 0.5, dot(before, change)
                    )
                )
            )
            if len(factors) > 1 and abs(factors[-1] - factors[-2]) < SETTLED * abs(factors[-1]):
                return factors[-1]
    return float(np.copysign(np.exp(np.mean(np.log(np.abs(factors[-AVERAGED:])))), factors[-1]))


class FactorWatcher(Watcher):
    """Watcher that computes the factor of the pass at selected steps, by their times."""

    def __init__(self, stepper: Stepper, chosen: Callable[[Step], bool]):
        self.stepper, self.chosen = stepper, chosen
        self.factors: dict[float, float] = {}

    def solved(self, step: Step) -> None:
        """Compute the factor at the solved state of a selected step."""
        if not self.chosen(step):
            return
        try:
            self.factors[step.time] = pass_factor(self.stepper, step)
        except SolveFailure as failure:
            log.warning("time %g: the factor of the pass is unknown: %s", step.time, failure.reason)
            self.factors[step.time] = np.nan

    def undone(self, step: Step) -> None:
        """Remove the factor of a step that is undone."""
        self.factors.pop(step.time, None)


def stability(
    scene: Scene,
    folder: Path | str | None = None,
    number: int = 10,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    quiet: bool = True,
) -> tuple[Path, Analysis]:
    """Run a scene and compute the factor of its passes at `number` times."""
    if not LAWS[scene.remodeling.law].remodels:
        raise SceneError(
            f"remodeling.law = {scene.remodeling.law!r}: nothing remodels, so there is no pass to "
            "analyse"
        )
    if scene.cases[1:]:
        raise SceneError("cases: the analysis takes one load case; leave out [[cases]]")
    if scene.time.is_adaptive:
        raise SceneError(
            f"time.tolerance = {scene.time.tolerance:g}: the analysis needs equal steps; "
            "leave it out"
        )
    place = chosen_folder(folder, f"{scene.name}-stability", comm)
    steps, made = scene.time.number_of_steps, list[FactorWatcher]()
    chosen = {round(steps * (index + 1) / number) for index in range(number)}

    def watcher(simulation: Simulation) -> Watcher:
        made.append(FactorWatcher(simulation.stepper, lambda step: step.number in chosen))
        return made[0]

    def answer() -> Analysis:
        stepper = made[0].stepper
        return Analysis(
            scene, made[0].factors, stepper.state.kinematics.name, stepper.remodeling.relaxation
        )

    try:
        run(
            scene.with_values({"output.fields": False}),
            place,
            comm,
            quiet,
            report=False,
            watchers=[watcher],
        )
    finally:
        if comm.rank == 0 and made and made[0].factors:  # also of a run that ends early
            answer().write(place)
    return place, answer()


# ---------------------------------------------------------------- result
@dataclass(frozen=True)
class Analysis(StudyResult):
    """Factors of the passes by time, NaN if unknown, with the coupling's relaxation factor."""

    scene: Scene
    factors: dict[float, float]
    kinematics: str
    share: float

    name = "stability"
    caption = (
        "Factor by which one pass multiplies a small change of the cells; "
        "beyond -1 and 1 the change grows."
    )

    @property
    def about(self) -> str:  # type: ignore[override]
        """Second half of the title: driver, frame and coupling."""
        how = self.scene.remodeling
        return f"driver {how.driver}, frame {how.frame}, coupling {how.coupling}"

    def table(self) -> dict[str, list[float]]:
        """Return the columns of stability.csv, with a row for each time."""
        return {"time": [*self.factors], "factor": [*self.factors.values()]}

    def verdict(self) -> str:
        """Return whether passes damp small changes, and what a reduction cannot show."""
        number = len(self.factors)
        times, factors = map(np.array, self.table().values())
        grows = np.abs(factors) > GROWS
        at_all = "a pass makes small changes of the cells smaller, or keeps them."
        text = f"Stable: at all {number} times {at_all}"
        if grows.any():
            worst = int(np.nanargmax(np.abs(factors)))
            text = (
                f"Unstable: at {grows.sum()} of {number} times a pass makes small changes of the "
                f"cells larger, first at {times[grows][0]:g}; the worst by a factor of "
                f"{factors[worst]:.5g}, at time {times[worst]:g}."
            )
            # With a relaxation factor theta in place of theta_0 the factor g becomes
            # 1 - (1 - g) theta / theta_0.
            if (lowest := np.nanmin(factors)) < -GROWS:
                damping = 2 * self.share / (1 - lowest)
                text += " The coupling 'relaxed' with a relaxation_factor below "
                text += f"{damping:.2g} damps the oscillation."
        elif missing := np.isnan(factors).sum():
            text = f"Unknown: at {missing} of {number} times the factor could not be computed; "
            text += "stable at all other times."
        if KINEMATICS[self.kinematics].reduced:
            text += f" But kinematics {self.kinematics!r} shows only changes with its symmetry; "
            text += "'full' shows all."
        return text

    def figure(self) -> Figure:
        """Plot the factors over time."""
        figure = Figure(figsize=(5.2, 3.4), layout="constrained")
        axes = figure.add_subplot()
        axes.axhspan(-1, 1, color=COLOURS[2], alpha=0.12, linewidth=0, label="stable: from −1 to 1")
        axes.plot(*self.table().values(), "o-", markersize=4, color=COLOURS[1], label="one pass")
        axes.set_yscale("symlog", linthresh=2)
        axes.set(xlabel="time", ylabel="factor of one pass on a\nsmall change of the cells")
        axes.set_xlim(left=0)
        figure.legend(loc="outside lower center", ncols=2)
        return figure
