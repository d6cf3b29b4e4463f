"""Whether the pass over-corrects, told from the run itself: a swing of cells and body from pass to pass."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import prod
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.fem.assembly import over_ranks
from remodel_fenicsx.model import mandel
from remodel_fenicsx.state.memory import Earlier, Numbers

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

ORDER = 3  # of the difference over passes that takes a smooth course away and keeps what changes its sign each time
GAIN = 2.0**ORDER  # by which it magnifies that
# the beginning of an instability: measured, all bodies that left their solution did so; none that stayed on it
# (factor of a pass, passes in a row, swing of A over r0^2 after the next)
GROWTH, GROWING_PASSES, CELL_TOLERANCE = -1.2, 2, 2e-2
# its end: random cells swing for ever at single points, each its own way, which the body hardly feels
SUSTAINED, SUSTAINED_PASSES, BODY_TOLERANCE = -0.9, 3, 0.02  # the same of the displacement, over the displacement
MOST = 0.5  # of the body
UNEVEN = 1.5  # ratio of two steps up to which they are about alike
LOAD_JUMP = 1e-3  # share of a load by which it may swing itself


def _difference(values: Sequence[Any], times: Sequence[float]) -> Any:
    """The difference of order ORDER over passes, the newest value first: a - 3 b + 3 c - d.

    Of passes that are not equally far from each other it is the divided difference, made as large.
    """
    used = range(ORDER + 1)
    weights = [prod(1.0 / (times[age] - times[other]) for other in used if other != age) for age in used]
    total = sum(map(abs, weights))
    return sum(GAIN * weights[age] / total * values[age] for age in used)


@dataclass(frozen=True)
class Swing:
    """The part of a step's change that the pass before had made the other way round.

    Attributes
    ----------
    cells
        Root mean square over the body of the swing of A, over r0^2.
    cells_factor
        By what the last pass has multiplied it: negative.
    body
        Norm of the swing of the unknowns over their norm.
    body_factor
        By what the last pass has multiplied it.
    """

    cells: float
    cells_factor: float
    body: float
    body_factor: float


class Chatter(Watcher):
    """Warns, once, when the cells swing to and fro from pass to pass so that results suffer.

    The solve takes the cells as they are, the pass replaces them: where the stress answers a change of the cells by
    more than the change, every pass goes too far, and the next one back (docs/theory.md, "Stability of the pass"). Such
    a swing has the period of two passes. The third difference over the passes, A_k - 3 A_(k-1) + 3 A_(k-2) - A_(k-3),
    magnifies it by eight and leaves nearly nothing of a smooth course; the ratio of two of them in a row is the factor
    of a pass. Passes at which the loads themselves jump say nothing.

    Parameters
    ----------
    stepper
        Whose state is followed; what is remembered of the passes before is part of it from now on.

    Attributes
    ----------
    swing
        That of the last pass; None before there have been enough.
    warned
        Whether the warning has been given.
    """

    def __init__(self, stepper: Stepper):
        self.stepper, self.state = stepper, stepper.state
        state, self.quadrature = self.state, stepper.state.cells.quadrature
        self.swing: Swing | None = None
        # of the passes before, with the newest one
        self._cells = Earlier(state, "chatter_cells", lambda: self.quadrature.function("", (6,)), ORDER + 1)
        self._body = Earlier(state, "chatter_body", state.unknown.copy, ORDER + 1)
        times = {f"time_{age}": 0.0 for age in range(ORDER + 1)}
        self._numbers = Numbers(state, "chatter", {"growing": 0, "sustained": 0, "warned": 0} | times)

    @property
    def structures(self) -> list[Array]:
        """A of the last passes as Mandel components (elements, points, 6), the newest first."""
        return [self._at_points(values) for values in self._cells.values]

    @property
    def warned(self) -> bool:
        """Whether the warning has been given."""
        return bool(self._numbers["warned"])

    def started(self, step: Step) -> None:
        """The cells before the first pass."""
        for memory in (self._cells, self._body, self._numbers):
            memory.forget()
        self._keep(step, self._structure())

    def completed(self, step: Step) -> None:
        """One pass more."""
        structure = self._structure()
        self.swing = None
        if self._cells.known > ORDER:
            cells, body = [structure, *self._cells.values], [self.state.unknown.x.array, *self._body.values]
            self.swing = self._measured(cells, body, [step.time, *self._times])
            tells = not self._loads_jump(step) and not self._rested(cells) and self._evenly(step)
            self._count("growing", tells and self.swing.cells_factor < GROWTH)
            self._count("sustained", tells and self.swing.body_factor < SUSTAINED)
        self._keep(step, structure)

    def committed(self, step: Step) -> None:
        """Warn."""
        if self.warned or self.swing is None:
            return
        next_one = self.swing.cells * abs(self.swing.cells_factor)  # as large as it will be after one pass more
        begins = self._numbers["growing"] >= GROWING_PASSES and next_one >= CELL_TOLERANCE
        lasts = self._numbers["sustained"] >= SUSTAINED_PASSES and self.swing.body >= BODY_TOLERANCE
        if begins or lasts:
            self._numbers["warned"] = True
            self._warn(step, self.swing)

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
    def _times(self) -> list[float]:
        """Of the passes that are remembered, the newest first."""
        return [self._numbers[f"time_{age}"] for age in range(ORDER + 1)]

    def _structure(self) -> Array:
        """A at all points, six Mandel components after each other."""
        return mandel.vectors(self.state.cells.structure_tensor().reshape(-1, 3, 3)).ravel()

    def _at_points(self, components: Any) -> Any:
        """What stands after each other by points, (elements, points, 6)."""
        return components.reshape(*self.quadrature.shape, len(mandel.MANDEL))

    def _rested(self, cells: list[Array]) -> bool:
        """Whether one of the passes has left most cells as they were: what goes on after that jumps (`resting`)."""
        same = [self._at_points(a == b).all(axis=-1) for a, b in pairwise(cells[: ORDER + 1])]
        return any(self.quadrature.mean(passed.astype(np.float64)) > MOST for passed in same)

    def _evenly(self, step: Step) -> bool:
        """Whether the passes are about as far from each other: of others a single jump looks like a swing."""
        lengths = [later - earlier for later, earlier in pairwise([step.time, *self._times])]
        return max(lengths) <= UNEVEN * min(lengths)

    def _loads_jump(self, step: Step) -> bool:
        times = self._times[:ORDER]
        earlier = [self.stepper.load_values(time) if time else {} for time in times]  # the body starts unloaded

        def jump(name: str, value: float) -> float:
            return abs(_difference([value, *(loads.get(name, 0.0) for loads in earlier)], [step.time, *times]))

        return any(jump(name, value) > LOAD_JUMP * GAIN * abs(value) for name, value in step.loads.items())

    def _measured(self, cells: list[Array], body: list[Array], times: list[float]) -> Swing:
        """Of the last passes, the newest first."""
        owned = self.state.number_of_owned_unknowns

        def of_cells(a: Array, b: Array) -> float:
            return self.quadrature.integral(self._at_points(a * b).sum(axis=-1))

        def of_body(a: Array, b: Array) -> float:
            return float(over_ranks(self.state.comm, float(np.dot(a[:owned], b[:owned])), MPI.SUM))

        now, last = _difference(cells, times), _difference(cells[1:], times[1:])
        moved, moved_last, place = _difference(body, times), _difference(body[1:], times[1:]), body[0]
        return Swing(
            np.sqrt(of_cells(now, now) / self.quadrature.volume)
            / GAIN
            / self.state.cells.settings.end_to_end_length**2,
            _ratio(of_cells(now, last), of_cells(last, last)),
            np.sqrt(_ratio(of_body(moved, moved), of_body(place, place))) / GAIN,
            _ratio(of_body(moved, moved_last), of_body(moved_last, moved_last)),
        )

    # ------------------------------------------------------------ words
    def _warn(self, step: Step, swing: Swing) -> None:
        place = self._place()
        if self.state.comm.rank == 0:
            log.warning(
                "time %g: the remodeling pass over-corrects: from pass to pass the cells swing to and fro, A by %.2g "
                "r0^2 (root mean square; most at %.4g, %.4g, %.4g), the displacement by %.2g of itself; a pass "
                "multiplies this by about %.2g. Results may be wrong from here on; set %s (docs/theory.md, Stability "
                "of the pass)",
                step.time,
                swing.cells,
                *place,
                swing.body,
                swing.cells_factor,
                self._advice(swing.cells_factor),
            )

    def _advice(self, factor: float) -> str:
        """A share of the pass with which the swing dies out: 1 - theta (1 - f) > -1."""
        share = self.stepper.coupling.share
        stable = 2 * share / (1 - factor)
        if share == 1.0 and stable > 0.5:
            return 'remodeling.coupling = "relaxed"'
        return f'remodeling.coupling = "relaxed" with a relaxation_factor below {min(stable, share):.2g}'

    def _place(self) -> tuple[float, float, float]:
        """Reference place of the largest swing of the cells."""
        swing = self._at_points(_difference(self._cells.values, self._times))
        return self.quadrature.place_of_largest(np.linalg.norm(swing, axis=-1))


def _ratio(value: float, size: float) -> float:
    """value / size; 0 where there is nothing to compare with."""
    return value / size if size > 0.0 else 0.0
