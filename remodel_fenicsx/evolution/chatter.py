"""Whether the pass over-corrects, told from the run itself: a swing of cells and body from pass to pass."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

ORDER = 3  # of the difference over passes that takes a smooth course away and keeps what changes its sign each time
GAIN = 2.0**ORDER  # by which it magnifies that
# the beginning of an instability: measured, all bodies that left their solution did so; none that stayed on it
GROWTH, GROWING_PASSES, CELL_TOLERANCE = -1.2, 2, 1e-3  # factor of a pass, passes in a row, swing of A over r0^2
# its end: random cells swing for ever at single points, each its own way, which the body hardly feels
SUSTAINED, SUSTAINED_PASSES, BODY_TOLERANCE = -0.9, 3, 0.02  # the same of the displacement, over the displacement
LOAD_JUMP = 1e-3  # share of a load by which it may swing itself


def _differences(before: tuple[Array, ...], value: Array) -> tuple[Array, ...]:
    """All differences over the passes up to ORDER with one more value: those of order 0, 1, ..."""
    found = [value]
    for difference in before[:ORDER]:
        found.append(found[-1] - difference)
    return tuple(found)


@dataclass(frozen=True)
class _Course:
    """What is kept from pass to pass: differences of A, displacement and loads, and how often in a row they swung."""

    cells: tuple[Array, ...] = ()
    body: tuple[Array, ...] = ()
    loads: tuple[Array, ...] = ()
    growing: int = 0
    sustained: int = 0


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
        Whose state is followed.

    Attributes
    ----------
    swing
        That of the last pass; None before there have been enough.
    warned
        Whether the warning has been given.
    """

    def __init__(self, stepper: Stepper):
        self.stepper, self.state = stepper, stepper.state
        self.quadrature = stepper.state.cells.quadrature
        self.swing: Swing | None = None
        self.warned = False
        self._course = self._before = _Course()

    def started(self, step: Step) -> None:
        """The cells before the first pass."""
        self._course = self._before = self._continued(_Course(), step)

    def resumed(self, step: Step) -> None:
        """The cells after the last pass before; the passes before that one are forgotten."""
        self.started(step)

    def completed(self, step: Step) -> None:
        """One pass more."""
        self._before = self._course
        self._course = self._continued(self._before, step)

    def undone(self, step: Step) -> None:
        """The pass has not been."""
        self._course = self._before

    def committed(self, step: Step) -> None:
        """Warn."""
        self._before = self._course
        if self.warned or self.swing is None:
            return
        begins = self._course.growing >= GROWING_PASSES and self.swing.cells >= CELL_TOLERANCE
        lasts = self._course.sustained >= SUSTAINED_PASSES and self.swing.body >= BODY_TOLERANCE
        if begins or lasts:
            self.warned = True
            self._warn(step, self.swing)

    def _continued(self, before: _Course, step: Step) -> _Course:
        """The course with the present state."""
        unknown = self.state.unknown
        owned = unknown.function_space.dofmap.index_map.size_local * unknown.function_space.dofmap.index_map_bs
        cells = _differences(before.cells, self.state.cells.structure_tensor())
        body = _differences(before.body, unknown.x.array[:owned].copy())
        loads = _differences(before.loads, np.array(list(step.loads.values())))
        course = _Course(cells, body, loads)
        self.swing = None
        if len(before.cells) <= ORDER:
            return course
        self.swing = self._measured(course, before)
        if np.any(np.abs(loads[ORDER]) > LOAD_JUMP * GAIN * np.abs(loads[0])):
            return course
        growing = before.growing + 1 if self.swing.cells_factor < GROWTH else 0
        sustained = before.sustained + 1 if self.swing.body_factor < SUSTAINED else 0
        return _Course(cells, body, loads, growing, sustained)

    def _measured(self, course: _Course, before: _Course) -> Swing:
        def of_cells(a: Array, b: Array) -> float:
            return self.quadrature.integral(np.einsum("epij,epij->ep", a, b))

        def of_body(a: Array, b: Array) -> float:
            return float(self.state.comm.allreduce(float(np.dot(a, b)), MPI.SUM))

        volume = self.quadrature.integral(np.ones(self.quadrature.shape))
        now, last = course.cells[ORDER], before.cells[ORDER]
        moved, moved_last, place = course.body[ORDER], before.body[ORDER], course.body[0]
        return Swing(
            np.sqrt(of_cells(now, now) / volume) / GAIN / self.state.cells.settings.end_to_end_length**2,
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
        return self.quadrature.place_of_largest(np.linalg.norm(self._course.cells[ORDER], axis=(-1, -2)))


def _ratio(value: float, size: float) -> float:
    """value / size; 0 where there is nothing to compare with."""
    return value / size if size > 0.0 else 0.0
