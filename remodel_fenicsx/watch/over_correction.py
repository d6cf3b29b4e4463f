"""Overshooting passes, detected in the run: oscillating cells, and cells that make up a delay."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple, TYPE_CHECKING

import dolfinx.la
import numpy as np
from mpi4py import MPI

from remodel_fenicsx.evolution.stepper import Step, Stepper, WarnsOnce
from remodel_fenicsx.fem.assembly import allreduce
from remodel_fenicsx.model.tensors import Array, to_mandel
from remodel_fenicsx.state import FieldHistory

if TYPE_CHECKING:
    from remodel_fenicsx.scene.scene import Scene

# Order of the difference over passes. It removes a smooth course, and keeps a part that changes its
# sign in each pass.
ORDER = 3
GAIN = 2.0**ORDER  # factor of the difference on the oscillating part
# Factor of a pass, and number of successive passes, of an oscillation that is reported if it
# exceeds `TOLD_SIZE` after one more pass. GROWING is the start of an instability, of the
# cells, A/r0^2: all bodies that left their solution had it, and no other body.
GROWING = -1.2, 2
# SUSTAINED is its end, of the displacement relative to itself. Random cells oscillate for ever at
# single points, without a common phase, which has hardly any effect on the body.
SUSTAINED = -0.9, 3
TOLD_SIZE = 0.02
# Largest fraction of the body that a pass may leave unchanged. After more a jump is no oscillation.
RESTED_SHARE = 0.5
# Largest ratio of two steps of similar size. A jump looks like an oscillation if the steps differ
# more.
MAX_STEP_RATIO = 1.5
LOAD_JUMP = 1e-3  # largest oscillation of a load, relative to the load
# RMS over the body of the change of A/r0^2 in one pass after a delay, above which a run warns.
RESUMED_CHANGE = 0.03


def _difference(times: Array, values: Array) -> Array:
    """Return the difference of order ORDER over the newest passes, 1, -3, 3, -1 for equal steps."""
    # For unequal steps it is the divided difference, scaled to the same size.
    apart = np.subtract.outer(times[: ORDER + 1], times[: ORDER + 1])
    np.fill_diagonal(apart, 1.0)
    weights = 1.0 / apart.prod(axis=1)
    return np.tensordot(GAIN * weights / np.abs(weights).sum(), values[: ORDER + 1], 1)


class Oscillation(NamedTuple):
    """Oscillation from pass to pass: its size, and the factor of the last pass."""

    size: float
    factor: float


class OverCorrection(WarnsOnce):
    """Warning that the cells oscillate from pass to pass, with an effect on results."""

    name = "over_correction"
    initial = dict.fromkeys(
        ("growing", "sustained", *(f"time_{age}" for age in range(ORDER + 1))), 0.0
    )

    def __init__(self, stepper: Stepper):
        super().__init__(stepper)
        self.swings: dict[str, Oscillation] = {}
        # Histories of previous passes, including the newest one.
        cells = partial(self.quadrature.function, "", (6,))
        self._cells = FieldHistory(self.state, "over_correction_cells", cells, ORDER + 1)
        self._body = FieldHistory(
            self.state, "over_correction_body", self.state.unknown.copy, ORDER + 1
        )
        self.rested = (
            ReactivatedCells(stepper) if stepper.remodeling.law.depends_on_absolute_time else None
        )

    @classmethod
    def for_scene(cls, scene: Scene, stepper: Stepper) -> OverCorrection | None:
        return (
            cls(stepper)
            if stepper.remodeling.law.remodels and not scene.time.is_equilibrium
            else None
        )

    def started(self, step: Step) -> None:
        """Reset the histories to the cells before the first pass. Collective."""
        for memory in (self._cells, self._body, self._numbers):
            memory.forget()
        if self.rested is not None:
            self.rested.forget()
        self.completed(step)

    def completed(self, step: Step) -> None:
        """Check the new pass, and record it. Collective."""
        structure = to_mandel(self.state.cells.structure_tensor().reshape(-1, 3, 3)).ravel()
        cells, known = [structure, *self._cells.values], self._cells.known
        numbers, vector = self._numbers, self.state.unknown.x
        structures = np.reshape(cells, (len(cells), *self.quadrature.shape, 6))
        times = [step.time, *(numbers[f"time_{age}"] for age in range(ORDER + 1))]
        if known > ORDER:
            self._judge(step, structures, np.array(times))
        if self.rested is not None and known:
            self.rested.compare(step, structures[0] - structures[1], times[1])
        self._cells.push(structure)
        self._body.push(vector.array)
        for age, time in enumerate(times[:-1]):
            numbers[f"time_{age}"] = time

    def _judge(self, step: Step, cells: Array, times: Array) -> None:
        """Warn of oscillations of the last passes (passes, ...), the newest first. Collective."""
        quadrature, parameters = self.quadrature, self.stepper.remodeling.parameters
        vector, r0 = self.state.unknown.x, parameters.largest().end_to_end_length
        scale = np.sqrt(quadrature.owned(quadrature.volumes) / quadrature.volume)[..., None] / r0**2
        bodies = np.array([vector.array, *self._body.values])
        cells_swing = self._swing(times, cells[:, : len(scale)], scale)
        body_swing = self._swing(
            times,
            bodies[:, : self.state.number_of_owned_unknowns],
            np.array(1 / (dolfinx.la.norm(vector) or 1.0)),
        )
        self.swings = {"growing": cells_swing, "sustained": body_swing}
        tells, overshoots = self._is_pass_oscillation(cells, times), False
        for (name, swing), (factor, passes) in zip(
            self.swings.items(), (GROWING, SUSTAINED), strict=True
        ):
            self._numbers[name] = self._numbers[name] + 1 if tells and swing.factor < factor else 0
            after_one_more = swing.size * abs(swing.factor)
            overshoots |= self._numbers[name] >= passes and after_one_more >= TOLD_SIZE
        if overshoots and not self.is_reported:
            most = quadrature.shown_place_of_largest(
                np.linalg.norm(_difference(times, cells), axis=-1)
            )
            self.emit(
                step,
                "the remodeling pass overshoots: the cells oscillate from pass to pass. "
                f"The structure tensor A changes by {cells_swing.size:.2g} r0^2 (RMS; maximum at "
                f"{most}), the displacement by {body_swing.size:.2g} of its size; "
                f"each pass multiplies this by about {cells_swing.factor:.2g}. "
                f"Results may be wrong from here on; set {self._advice(cells_swing.factor)} "
                "(docs/solver.md, Stability of the pass)",
            )

    def _swing(self, times: Array, values: Array, weight: Array) -> Oscillation:
        """Return the oscillation of this rank's values (passes, ...), weighted. Collective."""
        changes = np.array(
            [(weight * _difference(times[age:], values[age:])).ravel() for age in (0, 1)]
        )
        products = allreduce(self.state.comm, changes @ changes.T, MPI.SUM)
        return Oscillation(
            np.sqrt(products[0, 0]) / GAIN, products[0, 1] / (products[1, 1] or np.inf)
        )

    def _is_pass_oscillation(self, cells: Array, times: Array) -> bool:
        """Return whether passes oscillate, not loads, unequal steps or delays. Collective."""
        # At time 0 there are no loads.
        loads = np.array([[*self.stepper.load_values(time).values()] for time in times]) * (
            times[:, None] > 0
        )
        lengths, rested = -np.diff(times), (cells[:-1] == cells[1:]).all(axis=-1).astype(np.float64)
        return bool(
            np.all(np.abs(_difference(times, loads)) <= LOAD_JUMP * GAIN * np.abs(loads[0]))
            and lengths.max() <= MAX_STEP_RATIO * lengths.min()
            and max(map(self.quadrature.mean, rested)) <= RESTED_SHARE
        )

    def _advice(self, factor: float) -> str:
        """Return the setting of theta that damps the oscillation: 1 - theta (1 - f) > -1."""
        share = self.stepper.remodeling.relaxation
        stable = 2 * share / (1 - factor)
        if share == 1.0 and stable > 0.5:
            return 'remodeling.coupling = "relaxed"'
        factor_below = f"with a relaxation_factor below {min(stable, share):.2g}"
        return f'remodeling.coupling = "relaxed" {factor_below}'


class ReactivatedCells(WarnsOnce):
    """Warning that cells make up in one pass for a phase without tension."""

    name = "rested_cells"

    def __init__(self, stepper: Stepper):
        super().__init__(stepper)
        # Number of passes at each point since its cell has changed; 0 before its first change.
        self._rest = FieldHistory(
            self.state, "rested_cells_moved", partial(self.quadrature.function, "", ()), 1
        )

    def forget(self) -> None:
        """Reset the record of all passes."""
        self._rest.forget()
        self._numbers.forget()

    def compare(self, step: Step, changes: Array, time_before: float) -> None:
        """Check the changes of A (elements, points, 6) in a pass since a time. Collective."""
        now = changes.any(axis=-1)
        rest = np.reshape(self._rest.values, (self._rest.known, *now.shape)).sum(axis=0)
        self._rest.push(np.where(now, 1.0, rest + (rest > 0)).ravel())
        # A phase without loads is due to the loads, not to the steps.
        if self.is_reported or not any(self.stepper.load_values(time_before).values()):
            return
        # |change of A|^2 at the points that make up a delay.
        squares = np.where(now & (rest > 1), np.square(changes).sum(axis=-1), 0.0)
        parameters = self.stepper.remodeling.parameters
        r0 = parameters.largest().end_to_end_length
        if (change := np.sqrt(self.quadrature.mean(squares)) / r0**2) < RESUMED_CHANGE:
            return
        share = self.quadrature.mean((squares > 0).astype(float))
        self.emit(
            step,
            "cells resume remodeling after a phase without tension; an absolute-time law makes up "
            f"the delay in one pass. In {100 * share:.2g} % of the body the structure tensor A "
            f"changes by {change:.2g} r0^2 (RMS over the body; maximum at "
            f"{self.quadrature.shown_place_of_largest(squares)}). This depends on time.step; set "
            'remodeling.coupling = "relaxed", or a remodeling.law that is a rate '
            "(docs/solver.md, Stability of the pass)",
        )
