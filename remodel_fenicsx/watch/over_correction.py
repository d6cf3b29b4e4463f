"""Whether passes over-correct, told from the run itself: cells that swing, or that make up for a rest at once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, TYPE_CHECKING

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.evolution.stepper import Step, Stepper, WarnsOnce
from remodel_fenicsx.fem.assembly import over_ranks
from remodel_fenicsx.model import tensors
from remodel_fenicsx.state import Earlier

if TYPE_CHECKING:
    from remodel_fenicsx.scene.scene import Scene

Array = NDArray[np.float64]

ORDER = 3  # of the difference over passes that takes a smooth course away and keeps what changes its sign each time
GAIN = 2.0**ORDER  # by which it magnifies that
# the beginning of an instability: measured, all bodies that left their solution did so; none that stayed on it
# (factor of a pass, passes in a row, swing of A over r0^2 after the next)
GROWING, GROWING_PASSES, CELL_TOLERANCE = -1.2, 2, 2e-2
# its end: random cells swing for ever at single points, each its own way, which the body hardly feels
SUSTAINED, SUSTAINED_PASSES, BODY_TOLERANCE = -0.9, 3, 0.02  # the same of the displacement, over the displacement
RESTED_SHARE = 0.5  # of the body: after a pass that has left so much of it as it was, a jump is no swing
UNEVEN = 1.5  # ratio of two steps up to which they are about alike; of uneven ones a jump looks like a swing
LOAD_JUMP = 1e-3  # share of a load by which it may swing itself
# root mean square over the body of what cells after a rest change in A in one pass, over r0^2
RESUMED_CHANGE = 0.03


def _weights(times: Array) -> Array:
    """Of the difference of order ORDER over passes, the newest first: 1, -3, 3, -1."""
    # Of passes that are not equally far from each other it is the divided difference, made as large.
    apart = np.subtract.outer(times[: ORDER + 1], times[: ORDER + 1])
    np.fill_diagonal(apart, 1.0)
    weights = 1.0 / apart.prod(axis=1)
    return np.asarray(GAIN * weights / np.abs(weights).sum())


@dataclass(frozen=True)
class Swing:
    """The part of a step's change that the pass before had made the other way round."""

    cells: float
    cells_factor: float
    body: float
    body_factor: float


class OverCorrection(WarnsOnce):
    """Warns, once, when the cells swing to and fro from pass to pass so that results suffer."""

    name = "over_correction"
    initial = {"growing": 0, "sustained": 0} | {f"time_{age}": 0.0 for age in range(ORDER + 1)}

    def __init__(self, stepper: Stepper):
        super().__init__(stepper)
        self.swing: Swing | None = None
        # cells that belong to the stress of their own row, by a rule for any step, go nowhere too far
        traits = stepper.coupling.traits
        self._may_swing = not traits.accumulates or traits.longest < np.inf
        # of the passes before, with the newest one
        cells = partial(self.quadrature.function, "", (6,))
        self._cells = Earlier(self.state, "over_correction_cells", cells, ORDER + 1)
        self._body = Earlier(self.state, "over_correction_body", self.state.unknown.copy, ORDER + 1)
        self.rested = RestedCells(stepper) if stepper.remodeling.law.of_absolute_time else None

    @classmethod
    def of(cls, scene: Scene, stepper: Stepper) -> OverCorrection | None:
        return cls(stepper) if stepper.remodeling.law.remodels and not scene.time.is_equilibrium else None

    def started(self, step: Step) -> None:
        """The cells before the first pass."""
        for memory in (self._cells, self._body, self._numbers):
            memory.forget()
        self._keep(step, self._structure(), self.times)
        if self.rested is not None:
            self.rested.started(step)

    def due(self, step: Step) -> bool:
        """A solved state says nothing: passes do."""
        return False

    def completed(self, step: Step) -> None:
        """One pass more."""
        structure, known, self.swing = self._structure(), self.times, None
        cells, times = np.array([structure, *self._cells.values]), np.array([step.time, *known])
        if self._cells.known > ORDER:
            body = np.array([self.state.unknown.x.array, *self._body.values])
            self.swing = swing = self._measured(cells, body, times)
            tells = self._tells(step, cells, times)
            numbers = self._numbers  # of passes in a row
            numbers["growing"] = numbers["growing"] + 1 if tells and swing.cells_factor < GROWING else 0
            numbers["sustained"] = numbers["sustained"] + 1 if tells and swing.body_factor < SUSTAINED else 0
            next_one = swing.cells * abs(swing.cells_factor)  # as large as it will be after one pass more
            begins = numbers["growing"] >= GROWING_PASSES and next_one >= CELL_TOLERANCE
            lasts = numbers["sustained"] >= SUSTAINED_PASSES and swing.body >= BODY_TOLERANCE
            if self._may_swing and (begins or lasts) and not self.said:
                self.find(step, self._in_words(swing, cells, times))
        self._keep(step, structure, known)
        if self.rested is not None and not self.rested.said:
            self.rested.compare(step, self._at_points(cells), times)

    def _keep(self, step: Step, structure: Array, times: list[float]) -> None:
        self._cells.push(structure)
        self._body.push(self.state.unknown.x.array)
        for age, time in enumerate([step.time, *times[:ORDER]]):
            self._numbers[f"time_{age}"] = time

    @property
    def times(self) -> list[float]:
        """Of the passes that are remembered, the newest first."""
        return [self._numbers[f"time_{age}"] for age in range(ORDER + 1)]

    def _structure(self) -> Array:
        """A at all points, six Mandel components after each other."""
        return tensors.to_mandel(self.state.cells.structure_tensor().reshape(-1, 3, 3)).ravel()

    def _at_points(self, components: Array) -> Array:
        """What stands after each other by points, (..., elements, points, 6)."""
        return components.reshape(*components.shape[:-1], *self.quadrature.shape, len(tensors.MANDEL))

    def _tells(self, step: Step, cells: Array, times: Array) -> bool:
        """Whether a swing is one of passes: not of loads, of uneven steps, nor of cells that had rested."""
        # it starts unloaded
        earlier = [self.stepper.load_values(time) if time else {} for time in times[1 : ORDER + 1]]
        loads = [[one.get(name, 0.0) for name in step.loads] for one in (step.loads, *earlier)]
        if np.any(np.abs(_weights(times) @ loads) > LOAD_JUMP * GAIN * np.abs(loads[0])):
            return False
        lengths = -np.diff(times)
        if lengths.max() > UNEVEN * lengths.min():
            return False
        same: Any = self._at_points(cells[:ORDER] == cells[1 : ORDER + 1]).all(axis=-1)
        return max([self.quadrature.mean(passed.astype(np.float64)) for passed in same]) <= RESTED_SHARE

    def _measured(self, cells: Array, body: Array, times: Array) -> Swing:
        """Of the last passes, the newest first."""
        pair = np.array([np.append(_weights(times), 0.0), np.append(0.0, _weights(times[1:]))])
        volumes = self.quadrature.owned(self.quadrature.volumes)
        changes = self._at_points(pair @ cells)[:, : len(volumes)]
        owned = np.concatenate([pair @ body, body[:1]])[:, : self.state.number_of_owned_unknowns]
        # integrals of the products of fields, each with each
        of_cells = over_ranks(self.state.comm, np.einsum("aepi,bepi,ep->ab", changes, changes, volumes), MPI.SUM)
        of_body = over_ranks(self.state.comm, owned @ owned.T, MPI.SUM)
        r0 = self.stepper.remodeling.parameters.largest().end_to_end_length
        return Swing(
            np.sqrt(of_cells[0, 0] / self.quadrature.volume) / GAIN / r0**2,
            _ratio(of_cells[0, 1], of_cells[1, 1]),
            np.sqrt(_ratio(of_body[0, 0], of_body[2, 2])) / GAIN,
            _ratio(of_body[0, 1], of_body[1, 1]),
        )

    # ------------------------------------------------------------ words
    def _in_words(self, swing: Swing, cells: Array, times: Array) -> str:
        change = np.linalg.norm(self._at_points(_weights(times) @ cells[: ORDER + 1]), axis=-1)
        most = self.quadrature.shown_place_of_largest(change)
        return (
            "the remodeling pass over-corrects: from pass to pass the cells swing to and fro. The structure tensor A "
            f"changes by {swing.cells:.2g} r0^2 (root mean square; most at {most}), "
            f"the displacement by {swing.body:.2g} of its size; each pass "
            f"multiplies this by about {swing.cells_factor:.2g}. Results may be wrong from here on; set "
            f"{self._advice(swing.cells_factor)} "
            "(docs/theory.md, Stability of the pass)"
        )

    def _advice(self, factor: float) -> str:
        """A share of the pass with which the swing dies out: 1 - theta (1 - f) > -1."""
        share = self.stepper.remodeling.relaxation
        stable = 2 * share / (1 - factor)
        if share == 1.0 and stable > 0.5:
            return 'remodeling.coupling = "relaxed"'
        return f'remodeling.coupling = "relaxed" with a relaxation_factor below {min(stable, share):.2g}'


def _ratio(value: float, size: float) -> float:
    """value / size; 0 where there is nothing to compare with."""
    return value / size if size > 0.0 else 0.0


class RestedCells(WarnsOnce):
    """Warns, once, when cells that had rested change in one pass as much as if they had remodeled all the time."""

    name = "rested_cells"

    def __init__(self, stepper: Stepper):
        super().__init__(stepper)
        self._moved = Earlier(self.state, "rested_cells_moved", partial(self.quadrature.function, "", ()), 1)
        self._nowhere = np.zeros(self.quadrature.shape, dtype=np.bool_)  # where memory begins anew nothing is told

    def started(self, step: Step) -> None:
        """No pass yet."""
        self._moved.forget()
        self._numbers.forget()
        self._moved.push(self._nowhere.astype(np.float64).ravel())

    def compare(self, step: Step, structures: Array, times: Array) -> None:
        """One pass more: A of the last ones (passes, elements, points, 6), and their times, the newest first."""
        now, *before = (structures[:-1] != structures[1:]).any(axis=-1) if len(structures) > 1 else [self._nowhere]
        moved = self._moved.values[0].reshape(now.shape) > 0 if self._moved.known else self._nowhere
        self._moved.push((now | moved).astype(np.float64).ravel())
        # a rest without loads is the loads', and no matter of steps
        if before and any(self.stepper.load_values(times[1]).values()):
            # |change of A|^2 where it was made up for
            squares = np.sum((structures[0] - structures[1]) ** 2, axis=-1)
            self._judge(step, np.where(now & moved & ~before[0], squares, 0.0))

    def _judge(self, step: Step, squares: Array) -> None:
        r0 = self.stepper.remodeling.parameters.largest().end_to_end_length
        change = np.sqrt(self.quadrature.mean(squares)) / r0**2
        if change < RESUMED_CHANGE:
            return
        share = self.quadrature.mean((squares > 0).astype(float))
        self.find(
            step,
            "cells that had rested without tension remodel again, and the law catches up in one pass. In "
            f"{100 * share:.2g} % of the body the structure tensor A changes by {change:.2g} r0^2 (root mean square "
            f"over the body; most at {self.quadrature.shown_place_of_largest(squares)}). "
            'When cells rest depends on time.step, and so does the result; set remodeling.coupling = "relaxed", or a '
            "remodeling.law that is a rate (docs/theory.md, Stability of the pass)",
        )
