"""The biological equilibrium at once: the state that remodeling comes to under the loads at the end.

Laws with a limit come to rest where the cells are those of their own stress: l = r0 e with n its axes, or A = r0^2 E.
That state is the end of one implicit step over a time without end (docs/theory.md, "Equilibrium at once").
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import numpy as np

from remodel_fenicsx.body.loading import LoadValues
from remodel_fenicsx.evolution.coupling import Relaxed
from remodel_fenicsx.evolution.implicit import RESIDUAL, Implicit
from remodel_fenicsx.evolution.newton import SolveFailure, SolverSettings
from remodel_fenicsx.evolution.parts import StepFailure, Work
from remodel_fenicsx.evolution.refusals import Refusal
from remodel_fenicsx.evolution.remodeling import RemodelingPass
from remodel_fenicsx.evolution.state import State
from remodel_fenicsx.fem import coefficients
from remodel_fenicsx.system.terminal import NOTICE
from remodel_fenicsx.tissue.energy import Tissue

log = logging.getLogger(__name__)

PATH = ((0.3, 0.3), (0.6, 0.5), (1.0, 0.65), (1.0, 0.8), (1.0, 0.92), (1.0, 1.0))
"""Share of the change of the loads, and share s of the cells that follow their stress. Both must rise together: cells
that follow by half under the whole load have r >= L where they come from the elastic state."""
HALVINGS = 4  # of a part of the path, before it is left for passes
PASSES = 400
RAMP, FIRST_SHARE, SHARE = (0.3, 0.6, 1.0, 1.0), 0.3, 0.5
"""Of the passes: shares of the loads in the first ones, share of a pass's change in these and in the others."""
NEAR = 0.25
"""Change of A over r0^2 by a whole pass from which on the rest is tried in one piece, and again at each half of it."""
CONSISTENT = 1e-6  # over r0^2: more than this is said as a warning

NO_LIMIT = Refusal(
    "no equilibrium of the cells", 'follow it in time: a number for time.end, with remodeling.coupling = "relaxed"'
)


@dataclass(frozen=True)
class Station:
    """A place on the path: share of the change of the loads, and s = 1 - exp(-kappa t)."""

    loads: float
    cells: float

    def halfway(self, start: Station) -> Station:
        """The middle of the way from another one."""
        return Station((self.loads + start.loads) / 2, (self.cells + start.cells) / 2)

    def distance(self, start: Station) -> float:
        """The larger of the two changes."""
        return max(self.loads - start.loads, self.cells - start.cells)


@dataclass
class Change:
    """What is asked of a step: its time, loads before and after; and the work so far."""

    time: float
    old: LoadValues
    new: LoadValues
    work: Work

    def loads(self, share: float) -> LoadValues:
        """The loads with a share of their change."""
        if share == 1.0:
            return self.new
        return {name: self.old[name] + share * (value - self.old[name]) for name, value in self.new.items()}


class Homeostasis(Implicit):
    """One step to the limit of all steps: along `PATH`, or by relaxed passes until the rest goes in one piece.

    Passes are made where the cells are not alike at the start: laws by rank then have no implicit solution on the way,
    while at its end nothing is left of the ranks at the start. They also follow where the path leads nowhere. From a
    state that has remodeled before (a run that goes on) all is tried in one piece first.

    Attributes
    ----------
    solves
        How many nonlinear solves there were, failed ones included.
    only_passes
        Whether nothing else is tried: for other starts, which the path would forget.
    """

    def __init__(self, state: State, tissue: Tissue, remodeling: RemodelingPass, settings: SolverSettings):
        super().__init__(state, tissue, remodeling, settings)
        self.answering.holds = False
        self.solves, self.only_passes = 0, False
        self._relaxed: Relaxed | None = None

    def solve(self, time: float, loads: LoadValues) -> Work:
        """Equilibrium of forces and of cells.

        Raises
        ------
        StepFailure
            If none is found.
        """
        state, self.solves = self.state, 0
        before, start = state.snapshot(), state.deformation_gradient()
        change = Change(time, dict(state.loading.values), loads, Work())
        if self.only_passes or not self._directly(change):
            state.restore(before)
            self._by_passes(change)
        state.numbers[RESIDUAL] = change.work.residual
        self._power = self.remodeling.replace(self.answering.asked, start, time - state.time)
        state.settle_cells()
        return change.work

    def remodel(self, time: float) -> float:
        """Nothing is left to do but to say how far the state is from the cells of its own stress."""
        self.remodeling.look_ahead(time, self.state.numbers[RESIDUAL])
        residual = self.remodeling.residual() / self._largest_length() ** 2
        if self.state.comm.rank == 0:
            level = NOTICE if residual <= CONSISTENT else logging.WARNING
            log.log(level, "cells and stress agree to |A_pass - A| = %.2g r0^2, after %d solves", residual, self.solves)
        return self._power

    def close(self) -> None:
        """Free PETSc's objects."""
        super().close()
        if self._relaxed is not None:
            self._relaxed.close()

    def _largest_length(self) -> float:
        return float(coefficients.largest(self.equilibrium.tissue.end_to_end_length, self.equilibrium.quadrature.mesh))

    # ------------------------------------------------------------ along the path
    def _directly(self, change: Change) -> bool:
        """Along the path, or in one piece where the cells have remodeled before."""
        if self.state.number:
            return self._jumped(change)
        if not self._alike():
            return False
        first = Station(PATH[0][0], 0.0)
        try:
            self.answering.begin(change.time, 0.0)
            self.answering.keeps = True  # before there is a stress
            self._go([first], Station(0.0, 0.0), change)
            self.answering.keeps = False
            self.answering.begin(change.time, change.work.residual)
            self._go([Station(*pair) for pair in PATH], first, change)
        except SolveFailure as failure:
            log.info("the path to the equilibrium is left: %s", failure.reason)
            return False
        finally:
            self.answering.keeps = False
        return True

    def _alike(self) -> bool:
        """Whether all points start with the same lengths."""
        quadrature, comm = self.state.cells.quadrature, self.state.comm
        lengths = quadrature.owned(self.state.cells.dimension_values).reshape(-1, 3)
        least = np.min(comm.allgather(lengths.min(axis=0, initial=np.inf)), axis=0)
        most = np.max(comm.allgather(lengths.max(axis=0, initial=-np.inf)), axis=0)
        return bool(np.all(most - least <= 1e-12 * most.max()))

    def _jumped(self, change: Change) -> bool:
        """Try the rest in one piece; if it fails, all is as before."""
        before = dict(self.state.loading.values)
        self.answering.begin(change.time, self.state.numbers.get(RESIDUAL, 0.0))
        try:
            self._go([Station(1.0, 1.0)], Station(0.0, 0.0), change, halvings=0)
        except SolveFailure as failure:
            self.state.loading.set(before)
            log.info("the rest of the way is not solved in one piece: %s", failure.reason)
            return False
        return True

    def _go(self, way: list[Station], done: Station, change: Change, halvings: int = HALVINGS) -> None:
        """Solve at station after station; a part that fails is halved.

        Raises
        ------
        SolveFailure
            If the smallest part fails.
        """
        for station in way:
            ahead, smallest = [station], station.distance(done) * 2.0**-halvings
            while ahead:
                self._set(ahead[0], change)
                try:
                    self.solves += 1
                    change.work.add(self.newton.solve())
                except SolveFailure as failure:
                    change.work.add(failure)
                    place = f"{ahead[0].loads:.3g} of the loads, {ahead[0].cells:.3g} of the cells"
                    log.info("not solved at %s: %s", place, failure.reason)
                    if ahead[0].distance(done) <= smallest:
                        raise
                    ahead.insert(0, ahead[0].halfway(done))
                else:
                    change.work.substeps += 1
                    done = ahead.pop(0)

    def _set(self, station: Station, change: Change) -> None:
        self.state.loading.set(change.loads(station.loads))
        elapsed = change.time - self.state.time
        if station.cells < 1.0:
            elapsed = min(elapsed, -math.log1p(-station.cells) / self.remodeling.settings.kappa)
        self.answering.set_time(self.state.time + elapsed)

    # ------------------------------------------------------------ by passes
    def _by_passes(self, change: Change) -> None:
        """Shares of passes that go to their limit, each after a solve; from time to time the rest in one piece."""
        if self.state.comm.rank == 0 and not self.only_passes:
            log.log(NOTICE, "the equilibrium of the cells is approached by relaxed passes")
        relaxed, time, done = self._passes(), change.time, math.inf
        squared, near = self._largest_length() ** 2, NEAR
        for number in range(PASSES):
            slowly = number < len(RAMP)
            relaxed.share = FIRST_SHARE if slowly else SHARE
            work = relaxed.solve(time, change.loads(RAMP[number] if slowly else 1.0))
            self.solves += work.substeps
            change.work.newton_iterations += work.newton_iterations
            change.work.linear_iterations += work.linear_iterations
            change.work.substeps += work.substeps
            self.state.numbers[RESIDUAL] = change.work.residual = work.residual
            if not slowly and done <= near:
                near = done / 2
                if self._jumped(change):
                    return
            relaxed.remodel(time)
            done = self.remodeling.residual() / squared
            log.info("pass %d: changes A by up to %.3g r0^2", number + 1, done)
        text = f"no equilibrium of the cells after {PASSES} relaxed passes: the last one changes A by {done:.3g} r0^2"
        raise StepFailure(time, text, NO_LIMIT)

    def _passes(self) -> Relaxed:
        if self._relaxed is None:
            self._relaxed = Relaxed(self.state, self.equilibrium.tissue, self.remodeling, self.settings)
            self._relaxed.equilibrium.stop_signal = lambda: self.equilibrium.stop_signal()
        return self._relaxed
