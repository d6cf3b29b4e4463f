"""The coupling that extrapolates what the cells tend to, for laws with a target: of second order in the step."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.body.loading import LoadValues
from remodel_fenicsx.evolution.coupling import Staggered
from remodel_fenicsx.evolution.remodeling import RemodelingPass
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.model.tensor_law import Target, weight_of_the_end
from remodel_fenicsx.schema.settings import Solver
from remodel_fenicsx.solver.continuation import Work
from remodel_fenicsx.state.state import State

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
log = logging.getLogger(__name__)

NEVER = -1.0  # time of a target that there has not been
COUNTS = 0.01  # share of a target from which on it is one: what is less moves the cells less than a step is off


class Extrapolated(Staggered):
    """Remodel, then solve: sE + h/2 d(sE)/dt from the targets of the last two states, h the step (docs/theory.md)."""

    order, accumulates, longest = 2, True, 0.5

    def __init__(self, state: State, tissue: Tissue, remodeling: RemodelingPass, settings: Solver):
        super().__init__(state, tissue, remodeling, settings)
        self._targets = state.cells.quadrature.function("targets", (2, 11))  # the last first: E, s, its time
        self._values[..., 10] = NEVER
        state.remember(self._targets)
        self._power = 0.0
        self._start: UnitCell  # the cells at the start of the step
        self._found: Target  # of the solved state
        self._begins: Flags  # points whose first step with a target this is
        self._better: UnitCell | None = None

    @property
    def better(self) -> UnitCell | None:
        """The cells that the targets at both ends give together; where a point begins, the target of its end."""
        return self._better

    @property
    def _values(self) -> Array:
        return self.state.cells.quadrature.values(self._targets, (2, 11))

    def _known(self, age: int) -> Target:
        """The last target (0) or the one before (1) of all points in one row; zero where there was none."""
        values = self._values.reshape(-1, 2, 11)[:, age]
        return Target(values[:, :9].reshape(-1, 3, 3), values[:, 9])

    def solve(self, time: float, loads: LoadValues) -> Work:
        """New cells, and equilibrium at `time` with them."""
        cells = self.state.cells
        self._start = UnitCell(*(values.copy() for values in cells.point_cells[:2]))
        expected = self._extrapolated(time)
        self._follow(expected, time)
        if self.turnover is not None:
            self.turnover.extrapolate(time)
        work = super().solve(time, loads)
        self._found = self.remodeling.target(self.residual)
        self._begins = (self._known(0).share < COUNTS) & (self._found.share >= COUNTS)
        if not self._anywhere(self._begins):
            return work
        shape = cells.quadrature.shape
        cells.set(self._start.dimensions.reshape(*shape, 3), self._start.axes.reshape(*shape, 3, 3))
        self._follow(expected.where(self._begins, self._found), time)
        again = super().solve(time, loads)
        self._found = self.remodeling.target(self.residual)
        again.substeps += work.substeps - 1
        again.count(work)
        return again

    def remodel(self, time: float) -> float:
        """Remember the target of the solved state; the cells are those of the row."""
        target, values = self._found, self._values
        if self.compares:
            duration = time - self.state.time
            mean = self._mean(target, duration).where(self._begins, target)
            self._better = self.remodeling.followed(mean, duration, self._start)
        values[:, :, 1] = values[:, :, 0]
        values[:, :, 1, 10][self._begins.reshape(values.shape[:2])] = NEVER  # its step had the target of its end
        values[:, :, 0, :9] = target.direction.reshape(*values.shape[:2], 9)
        values[:, :, 0, 9] = target.share.reshape(values.shape[:2])
        values[:, :, 0, 10] = time
        if self.turnover is not None:
            self.turnover.complete(time)
        return self._power

    def _mean(self, target: Target, duration: float) -> Target:
        """What counts of the targets at the start and at the end of the step."""
        return self._known(0).towards(target, weight_of_the_end(self.remodeling.kappa * duration))

    def _extrapolated(self, time: float) -> Target:
        return self._known(0).towards(self._known(1), -self._back(time))

    def _back(self, time: float) -> Array:
        """Minus the weight of the target before in the extrapolated one, (n,)."""
        times = self._values.reshape(-1, 2, 11)[:, :, 10]
        back, known = np.zeros(len(times)), times[:, 1] != NEVER
        back[known] = (time - times[known, 0]) / 2 / (times[known, 0] - times[known, 1])
        return back

    def _follow(self, target: Target, time: float) -> None:
        """Cells after the step; where an extrapolated target would make A indefinite, the last target itself counts."""
        duration = time - self.state.time
        self._power = 0.0
        if not self._anywhere(target.share != 0.0):
            return
        asked = self.remodeling.followed(target, duration)
        lost = ~np.isfinite(asked.dimensions).all(axis=-1)
        if lost.any():
            asked = self.remodeling.followed(target.where(lost, self._known(0)), duration)
        points = self._anywhere(lost)
        if points and self.state.comm.rank == 0:
            log.info("time %g: %d points follow the last stress, not the extrapolated one", time, points)
        self._power = self.remodeling.replace(asked, self.state.elastic_gradient(), duration)

    def _anywhere(self, points: Flags) -> int:
        """How many there are on all ranks."""
        quadrature = self.state.cells.quadrature
        return int(self.state.comm.allreduce(int(quadrature.owned(points.reshape(quadrature.shape)).sum())))
