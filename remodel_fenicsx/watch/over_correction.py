"""Whether passes over-correct, told from the run itself: cells that swing, or that make up for a rest at once."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple, TYPE_CHECKING

import dolfinx.la
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
# factor of a pass, and passes in a row, from which on a swing is told that will be over `TOLERANCE` after one more:
# the beginning of an instability, of the cells over r0^2. All bodies that left their solution had it, no other one
GROWING = -1.2, 2
# its end, of the displacement over itself: random cells swing for ever at single points, each its own way, which the
# body hardly feels
SUSTAINED = -0.9, 3
TOLERANCE = 0.02
RESTED_SHARE = 0.5  # of the body: after a pass that has left so much of it as it was, a jump is no swing
UNEVEN = 1.5  # ratio of two steps up to which they are about alike; of uneven ones a jump looks like a swing
LOAD_JUMP = 1e-3  # share of a load by which it may swing itself
# root mean square over the body of what cells after a rest change in A in one pass, over r0^2
RESUMED_CHANGE = 0.03


def _difference(times: Array, values: Array) -> Array:
    """Difference of order ORDER over the newest passes: of equal steps 1, -3, 3, -1 times the values."""
    # Of passes that are not equally far from each other it is the divided difference, made as large.
    apart = np.subtract.outer(times[: ORDER + 1], times[: ORDER + 1])
    np.fill_diagonal(apart, 1.0)
    weights = 1.0 / apart.prod(axis=1)
    return np.tensordot(GAIN * weights / np.abs(weights).sum(), values[: ORDER + 1], 1)


class Swing(NamedTuple):
    """The part of a step's change that the pass before had made the other way round."""

    size: float
    factor: float


class OverCorrection(WarnsOnce):
    """Warns, once, when the cells swing to and fro from pass to pass so that results suffer."""

    name = "over_correction"
    initial = dict.fromkeys(("growing", "sustained", *(f"time_{age}" for age in range(ORDER + 1))), 0.0)

    def __init__(self, stepper: Stepper):
        super().__init__(stepper)
        self.swings: dict[str, Swing] = {}
        # of the passes before, with the newest one
        cells = partial(self.quadrature.function, "", (6,))
        self._cells = Earlier(self.state, "over_correction_cells", cells, ORDER + 1)
        self._body = Earlier(self.state, "over_correction_body", self.state.unknown.copy, ORDER + 1)
        self.rested = RestedCells(stepper) if stepper.remodeling.law.of_absolute_time else None

    @classmethod
    def of(cls, scene: Scene, stepper: Stepper) -> OverCorrection | None:
        return cls(stepper) if stepper.remodeling.law.remodels and not scene.time.is_equilibrium else None

    def started(self, step: Step) -> None:
        """Remember the cells before the first pass, and nothing else."""
        for memory in (self._cells, self._body, self._numbers):
            memory.forget()
        if self.rested is not None:
            self.rested.forget()
        self.completed(step)

    def completed(self, step: Step) -> None:
        """Judge one pass more, and remember it."""
        structure = tensors.to_mandel(self.state.cells.structure_tensor().reshape(-1, 3, 3)).ravel()
        cells, known, numbers = [structure, *self._cells.values], self._cells.known, self._numbers
        structures = np.reshape(cells, (len(cells), *self.quadrature.shape, 6))
        times = [step.time, *(numbers[f"time_{age}"] for age in range(ORDER + 1))]
        if known > ORDER:
            self._judge(step, structures, np.array(times))
        if self.rested is not None and known:
            self.rested.compare(step, structures[0] - structures[1], times[1])
        self._cells.push(structure)
        self._body.push(self.state.unknown.x.array)
        for age, time in enumerate(times[:-1]):
            numbers[f"time_{age}"] = time

    def _judge(self, step: Step, cells: Array, times: Array) -> None:
        """Say what swings, of the last passes (passes, ...), the newest first."""
        quadrature, r0 = self.quadrature, self.stepper.remodeling.parameters.largest().end_to_end_length
        scale = np.sqrt(quadrature.owned(quadrature.volumes) / quadrature.volume)[..., None] / r0**2
        of_cells = (cells[:, : len(scale)] * scale).reshape(len(cells), -1)
        of_body = np.array([self.state.unknown.x.array, *self._body.values])[:, : self.state.number_of_owned_unknowns]
        of_body /= dolfinx.la.norm(self.state.unknown.x) or 1.0
        swings = self.swings = {"growing": self._swing(times, of_cells), "sustained": self._swing(times, of_body)}
        tells, found = self._tells(step, cells, times), False
        for (name, swing), (factor, passes) in zip(swings.items(), (GROWING, SUSTAINED), strict=True):
            self._numbers[name] = self._numbers[name] + 1 if tells and swing.factor < factor else 0
            after_one_more = swing.size * abs(swing.factor)
            found |= self._numbers[name] >= passes and after_one_more >= TOLERANCE
        if found and not self.said:
            most = quadrature.shown_place_of_largest(np.linalg.norm(_difference(times, cells), axis=-1))
            self.find(step, self._in_words(*swings.values(), most))

    def _swing(self, times: Array, values: Array) -> Swing:
        """Return that of values of this rank (passes, n), as root of their sum of squares."""
        changes = np.array([_difference(times, values), _difference(times[1:], values[1:])])
        products = over_ranks(self.state.comm, changes @ changes.T, MPI.SUM)
        return Swing(np.sqrt(products[0, 0]) / GAIN, products[0, 1] / (products[1, 1] or np.inf))

    def _tells(self, step: Step, cells: Array, times: Array) -> bool:
        """Whether a swing is one of passes: not of loads, of uneven steps, nor of cells that had rested."""
        # it starts unloaded
        loads = np.array([[*self.stepper.load_values(time).values()] for time in times]) * (times[:, None] > 0)
        lengths, rested = -np.diff(times), (cells[:-1] == cells[1:]).all(axis=-1).astype(np.float64)
        return bool(
            np.all(np.abs(_difference(times, loads)) <= LOAD_JUMP * GAIN * np.abs(loads[0]))
            and lengths.max() <= UNEVEN * lengths.min()
            and max(map(self.quadrature.mean, rested)) <= RESTED_SHARE
        )

    # ------------------------------------------------------------ words
    def _in_words(self, cells: Swing, body: Swing, most: str) -> str:
        return (
            "the remodeling pass over-corrects: from pass to pass the cells swing to and fro. The structure tensor A "
            f"changes by {cells.size:.2g} r0^2 (root mean square; most at {most}), "
            f"the displacement by {body.size:.2g} of its size; each pass "
            f"multiplies this by about {cells.factor:.2g}. Results may be wrong from here on; set "
            f"{self._advice(cells.factor)} "
            "(docs/theory.md, Stability of the pass)"
        )

    def _advice(self, factor: float) -> str:
        """A share of the pass with which the swing dies out: 1 - theta (1 - f) > -1."""
        share = self.stepper.remodeling.relaxation
        stable = 2 * share / (1 - factor)
        if share == 1.0 and stable > 0.5:
            return 'remodeling.coupling = "relaxed"'
        return f'remodeling.coupling = "relaxed" with a relaxation_factor below {min(stable, share):.2g}'


class RestedCells(WarnsOnce):
    """Warns, once, when cells that had rested change in one pass as much as if they had remodeled all the time."""

    name = "rested_cells"

    def __init__(self, stepper: Stepper):
        super().__init__(stepper)
        # passes since a cell has moved, by points; 0 before it ever did
        self._rest = Earlier(self.state, "rested_cells_moved", partial(self.quadrature.function, "", ()), 1)

    def forget(self) -> None:
        """Forget all passes."""
        self._rest.forget()
        self._numbers.forget()

    def compare(self, step: Step, changes: Array, time_before: float) -> None:
        """Judge one pass more: its changes of A (elements, points, 6), and the time of the one before."""
        now = changes.any(axis=-1)
        rest = np.reshape(self._rest.values, (self._rest.known, *now.shape)).sum(axis=0)
        self._rest.push(np.where(now, 1.0, rest + (rest > 0)).ravel())
        # a rest without loads is the loads', and no matter of steps
        if self.said or not any(self.stepper.load_values(time_before).values()):
            return
        # |change of A|^2 where it was made up for
        squares = np.where(now & (rest > 1), np.square(changes).sum(axis=-1), 0.0)
        r0 = self.stepper.remodeling.parameters.largest().end_to_end_length
        if (change := np.sqrt(self.quadrature.mean(squares)) / r0**2) < RESUMED_CHANGE:
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
