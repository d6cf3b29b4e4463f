"""Whether passes over-correct, told from the run itself: cells that swing, or that make up for a rest at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from math import prod
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.fem.assembly import over_ranks
from remodel_fenicsx.model import tensors
from remodel_fenicsx.state import Earlier
from remodel_fenicsx.watch.warnings import WarnsOnce, largest_at

Array = NDArray[np.float64]

ORDER = 3  # of the difference over passes that takes a smooth course away and keeps what changes its sign each time
GAIN = 2.0**ORDER  # by which it magnifies that
# the beginning of an instability: measured, all bodies that left their solution did so; none that stayed on it
# (factor of a pass, passes in a row, swing of A over r0^2 after the next)
GROWTH, GROWING_PASSES, CELL_TOLERANCE = -1.2, 2, 2e-2
# its end: random cells swing for ever at single points, each its own way, which the body hardly feels
SUSTAINED, SUSTAINED_PASSES, BODY_TOLERANCE = -0.9, 3, 0.02  # the same of the displacement, over the displacement
RESTED_SHARE = 0.5  # of the body: after a pass that has left so much of it as it was, a jump is no swing
UNEVEN = 1.5  # ratio of two steps up to which they are about alike
LOAD_JUMP = 1e-3  # share of a load by which it may swing itself
# root mean square over the body of what cells after a rest change in A in one pass, over r0^2
RESUMED_CHANGE = 0.03


def _difference(values: Sequence[Any], times: Sequence[float]) -> Any:
    """The difference of order ORDER over passes, the newest value first: a - 3 b + 3 c - d."""
    # Of passes that are not equally far from each other it is the divided difference, made as large.
    used = range(ORDER + 1)
    weights = [prod(1.0 / (times[age] - times[other]) for other in used if other != age) for age in used]
    total = sum(map(abs, weights))
    return sum(GAIN * weights[age] / total * values[age] for age in used)


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
        self.rested = RestedCells(stepper, self) if stepper.remodeling.law.of_absolute_time else Watcher()

    @classmethod
    def of(cls, scene: Any, stepper: Any) -> OverCorrection | None:
        return cls(stepper) if stepper.remodeling.law.remodels and not scene.time.is_equilibrium else None

    @property
    def structures(self) -> list[Array]:
        """A of the last passes as Mandel components (elements, points, 6), the newest first."""
        return [self._at_points(values) for values in self._cells.values]

    def started(self, step: Step) -> None:
        """The cells before the first pass."""
        for memory in (self._cells, self._body, self._numbers):
            memory.forget()
        self._keep(step, self._structure())
        self.rested.started(step)

    def due(self, step: Step) -> bool:
        """A solved state says nothing: passes do."""
        return False

    def completed(self, step: Step) -> None:
        """One pass more."""
        structure, self.swing = self._structure(), None
        if self._cells.known > ORDER:
            cells, body = [structure, *self._cells.values], [self.state.unknown.x.array, *self._body.values]
            times = [step.time, *self.times]
            self.swing = swing = self._measured(cells, body, times)
            tells = not self._loads_jump(step) and not self._rested(cells) and self._evenly(step)
            self._count("growing", tells and swing.cells_factor < GROWTH)
            self._count("sustained", tells and swing.body_factor < SUSTAINED)
            if not self.said and self._may_swing and self._suffers(swing):
                self.find(self._in_words(swing, cells, times))
        self._keep(step, structure)
        self.rested.completed(step)

    def undone(self, step: Step) -> None:
        super().undone(step)
        self.rested.undone(step)

    def committed(self, step: Step) -> None:
        super().committed(step)
        self.rested.committed(step)

    def _suffers(self, swing: Swing) -> bool:
        """Whether a swing has begun or lasts, and is large."""
        next_one = swing.cells * abs(swing.cells_factor)  # as large as it will be after one pass more
        begins = self._numbers["growing"] >= GROWING_PASSES and next_one >= CELL_TOLERANCE
        return begins or (self._numbers["sustained"] >= SUSTAINED_PASSES and swing.body >= BODY_TOLERANCE)

    def _count(self, name: str, once_more: bool) -> None:
        """Passes in a row."""
        self._numbers[name] = self._numbers[name] + 1 if once_more else 0

    def _keep(self, step: Step, structure: Array) -> None:
        self._cells.push(structure)
        self._body.push(self.state.unknown.x.array)
        for age in range(ORDER, 0, -1):
            self._numbers[f"time_{age}"] = self._numbers[f"time_{age - 1}"]
        self._numbers["time_0"] = step.time

    @property
    def times(self) -> list[float]:
        """Of the passes that are remembered, the newest first."""
        return [self._numbers[f"time_{age}"] for age in range(ORDER + 1)]

    def _structure(self) -> Array:
        """A at all points, six Mandel components after each other."""
        return tensors.to_mandel(self.state.cells.structure_tensor().reshape(-1, 3, 3)).ravel()

    def _at_points(self, components: Any) -> Any:
        """What stands after each other by points, (elements, points, 6)."""
        return components.reshape(*self.quadrature.shape, len(tensors.MANDEL))

    def _rested(self, cells: list[Array]) -> bool:
        """Whether one of the passes has left most cells as they were: what goes on after that jumps."""
        same = [self._at_points(a == b).all(axis=-1) for a, b in pairwise(cells[: ORDER + 1])]
        return any(self.quadrature.mean(passed.astype(np.float64)) > RESTED_SHARE for passed in same)

    def _evenly(self, step: Step) -> bool:
        """Whether the passes are about as far from each other: of others a single jump looks like a swing."""
        lengths = [later - earlier for later, earlier in pairwise([step.time, *self.times])]
        return max(lengths) <= UNEVEN * min(lengths)

    def _loads_jump(self, step: Step) -> bool:
        times = self.times[:ORDER]
        earlier = [self.stepper.load_values(time) if time else {} for time in times]  # the body starts unloaded

        def jump(name: str, value: float) -> float:
            return abs(_difference([value, *(loads.get(name, 0.0) for loads in earlier)], [step.time, *times]))

        return any(jump(name, value) > LOAD_JUMP * GAIN * abs(value) for name, value in step.loads.items())

    def _measured(self, cells: list[Array], body: list[Array], times: list[float]) -> Swing:
        """Of the last passes, the newest first."""
        owned = self.state.number_of_owned_unknowns

        def of_cells(a: Array, b: Array) -> float:
            return self.quadrature.integral(np.einsum("epi,epi->ep", self._at_points(a), self._at_points(b)))

        def of_body(a: Array, b: Array) -> float:
            return float(over_ranks(self.state.comm, float(np.dot(a[:owned], b[:owned])), MPI.SUM))

        now, last = _difference(cells, times), _difference(cells[1:], times[1:])
        moved, moved_last, place = _difference(body, times), _difference(body[1:], times[1:]), body[0]
        r0 = self.stepper.remodeling.parameters.largest().end_to_end_length
        return Swing(
            np.sqrt(of_cells(now, now) / self.quadrature.volume) / GAIN / r0**2,
            _ratio(of_cells(now, last), of_cells(last, last)),
            np.sqrt(_ratio(of_body(moved, moved), of_body(place, place))) / GAIN,
            _ratio(of_body(moved, moved_last), of_body(moved_last, moved_last)),
        )

    # ------------------------------------------------------------ words
    def _in_words(self, swing: Swing, cells: list[Array], times: list[float]) -> str:
        change = np.linalg.norm(self._at_points(_difference(cells, times)), axis=-1)
        return (
            "the remodeling pass over-corrects: from pass to pass the cells swing to and fro. The structure tensor A "
            f"changes by {swing.cells:.2g} r0^2 (root mean square; most at "
            f"{largest_at(self.quadrature, change)}), the displacement by {swing.body:.2g} of its size; each pass "
            f"multiplies this by about {swing.cells_factor:.2g}. Results may be wrong from here on; set "
            f"{self._advice(swing.cells_factor)} "
            "(docs/theory.md, Stability of the pass)"
        )

    def _advice(self, factor: float) -> str:
        """A share of the pass with which the swing dies out: 1 - theta (1 - f) > -1."""
        share = self.stepper.remodeling.share
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

    def __init__(self, stepper: Stepper, passes: OverCorrection):
        super().__init__(stepper)
        self.passes = passes
        self._moved = Earlier(self.state, "rested_cells_moved", partial(self.quadrature.function, "", ()), 1)

    def started(self, step: Step) -> None:
        """No pass yet."""
        self._moved.forget()
        self._numbers.forget()
        self._moved.push(np.zeros(self.quadrature.shape).ravel())

    def completed(self, step: Step) -> None:
        """One pass more."""
        if self.said:
            return
        cells = self.passes.structures
        nowhere = np.zeros(self.quadrature.shape, dtype=bool)  # where memory begins anew there is nothing to tell
        now = _differ(cells[0], cells[1]) if len(cells) > 1 else nowhere
        moved = self._moved.values[0].reshape(self.quadrature.shape) > 0 if self._moved.known else nowhere
        self._moved.push((now | moved).astype(np.float64).ravel())
        # a rest without loads is the loads', and no matter of steps
        if len(cells) > 2 and any(self.stepper.load_values(self.passes.times[1]).values()):
            resumed = now & moved & ~_differ(cells[1], cells[2])
            # |change of A|^2 where it was made up for
            self._judge(np.where(resumed, np.sum((cells[0] - cells[1]) ** 2, axis=-1), 0.0))

    def _judge(self, squares: Array) -> None:
        r0 = self.stepper.remodeling.parameters.largest().end_to_end_length
        change = np.sqrt(self.quadrature.mean(squares)) / r0**2
        if change < RESUMED_CHANGE:
            return
        share = self.quadrature.mean((squares > 0).astype(float))
        self.find(
            "cells that had rested without tension remodel again, and the law catches up in one pass. In "
            f"{100 * share:.2g} % of the body the structure tensor A changes by {change:.2g} r0^2 (root mean square "
            f"over the body; most at {largest_at(self.quadrature, squares)}). When cells rest "
            'depends on time.step, and so does the result; set remodeling.coupling = "relaxed", or a remodeling.law '
            "that is a rate (docs/theory.md, Stability of the pass)"
        )


def _differ(one: Array, other: Array) -> NDArray[np.bool_]:
    """Where tensors (elements, points, 6) are not the same to the last bit."""
    return np.any(one != other, axis=-1)
