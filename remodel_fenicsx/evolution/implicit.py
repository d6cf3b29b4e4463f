"""The implicit coupling: the cells at the end of a step belong to the stress of its end (docs/theory.md)."""

from __future__ import annotations

import logging
import math
from typing import Any

from remodel_fenicsx.body.loading import LoadValues
from remodel_fenicsx.evolution.condensed import AnsweringCells, AnsweringEquilibrium, AnsweringNewton
from remodel_fenicsx.evolution.remodeling import RemodelingPass
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.model.laws import relaxed
from remodel_fenicsx.model.tensor_law import weight_of_the_end
from remodel_fenicsx.settings import Solver
from remodel_fenicsx.solver.continuation import Change, StepFailure, Work
from remodel_fenicsx.solver.equilibrium import Equilibrium
from remodel_fenicsx.solver.newton import GuardedNewton, SolveFailure
from remodel_fenicsx.state.memory import Numbers
from remodel_fenicsx.state.state import State

log = logging.getLogger(__name__)

RESIDUAL = "residual of the last step"
MUCH_MORE = 2.0  # times the share that was said
STEP_HALVINGS = 1  # of a step, before points are held; where there is no solution parts cost, and do not help
MOST_SOLVES = 20  # of all Newton iterations that one may have, for a step with its parts; then it is refused


class Implicit:
    """Newton's method on the unknowns with cells that follow at each point (`evolution.condensed`).

    A step that does not converge in one piece, with cells that belong to their stress at all points, is made in parts
    of its time and loads, each from the cells at its start: the end is that of the whole step. Where that fails too,
    points whose law jumps may keep other cells; a warning says in which share of the body. The first step, before which
    there is no stress, is first solved with the cells as they are. Cells, stress and row belong together at the end.
    """

    order, accumulates, longest = 1, True, math.inf

    def __init__(self, state: State, tissue: Tissue, remodeling: RemodelingPass, settings: Solver):
        self.state, self.remodeling, self.settings = state, remodeling, settings
        self.equilibrium: Equilibrium = Equilibrium(state, tissue)  # of solved states
        self.equilibrium.compile_energy()
        self.answering = AnsweringCells(state, self.equilibrium.tissue, remodeling)
        solved = AnsweringEquilibrium(state, tissue, self.answering)
        solved.stop_signal = lambda: self.equilibrium.stop_signal()
        self.newton: GuardedNewton = AnsweringNewton(solved, settings)
        self.share, self.compares, self._power = 1.0, False, 0.0
        self.turnover: Any = None
        self._better: UnitCell | None = None
        state.numbers[RESIDUAL] = 0.0
        self._numbers = Numbers(state, "implicit", {"held": 0.0})  # the largest share that a warning has named

    def solve(self, time: float, loads: LoadValues) -> Work:
        """Equilibrium at `time` with the cells that belong to it.

        Raises
        ------
        StepFailure
            If none is found.
        """
        work, start = Work(), self.state.elastic_gradient()
        self.answering.begin(time, self.state.numbers[RESIDUAL])
        if self.turnover is not None:
            self.turnover.begin()
        if self.state.number == 0:
            self._solve(time, loads, work, answering=False)
            self.answering.begin(time, work.residual)
        from_start = self._from_start(time, work.residual if self.state.number == 0 else self.state.numbers[RESIDUAL])
        self._solve(time, loads, work, answering=True)
        if from_start is not None:
            weight = weight_of_the_end(self.remodeling.kappa * (time - self.state.time))
            self._better = relaxed(from_start, self.answering.asked, weight)
        work.substeps -= int(self.state.number == 0)
        self.state.numbers[RESIDUAL] = work.residual
        work.held_points = self.answering.held_points()
        self._say(time, self.answering.held_share())
        work.extension = None  # the row's is with the cells that are taken over now
        self._power = self.remodeling.replace(self.answering.asked, start, time - self.state.time)
        self.state.settle_cells()
        if self.turnover is not None:
            self.turnover.take(self.answering.turnover)
        return work

    def remodel(self, time: float) -> float:
        """Nothing is left to do."""
        if self.turnover is not None:
            self.turnover.complete(time)
        return self._power

    @property
    def better(self) -> UnitCell | None:
        """What the stresses at both ends of the step ask for together; eq. (11) asks for the end alone."""
        return self._better

    def _from_start(self, time: float, residual: float) -> UnitCell | None:
        """What the stress at the start of a step asks for, where somebody compares, and the law has errors in time."""
        if not self.compares or self.remodeling.law.of_absolute_time:
            return None
        cells, _ = self.remodeling.updated_cells(self.state.time, time, residual)
        return cells

    def _say(self, time: float, share: float) -> None:
        """Warn of cells that do not belong to their stress; again where they are much more."""
        if share <= MUCH_MORE * self._numbers["held"]:
            return
        self._numbers["held"] = share
        if self.state.comm.rank == 0:
            log.warning(
                "time %g: in %.3g %% of the body no cells were found that fit their own stress, in parts of the step "
                "neither. The cells there keep their last values, so the row is not the implicit solution. "
                "The column held_points counts the points; smaller steps have fewer, the law 'tensor' has none",
                time,
                100 * share,
            )

    def close(self) -> None:
        """Free PETSc's objects."""
        self.newton.close()

    def _solve(self, time: float, loads: LoadValues, work: Work, answering: bool) -> None:
        """With all cells belonging to their stress; where that cannot be, not even in parts, some are held."""
        answers, unknown, old = self.answering, self.state.unknown.x.array, dict(self.state.loading.values)
        before, residual, most = unknown.copy(), work.residual, self.settings.maximum_halvings
        if not answering or not answers.jumps_somewhere():
            self._solve_or_part(time, loads, work, answering, most)
            return
        answers.may_hold = False
        try:
            self._solve_or_part(time, loads, work, answering, min(STEP_HALVINGS, most))
        except StepFailure as failure:
            log.info("some cells keep their last values: %s", failure)
            unknown[:] = before
            self.state.loading.set(old)
            answers.begin(time, residual)
            answers.may_hold = True
            self._solve_or_part(time, loads, work, answering, most)
        finally:
            answers.may_hold = True

    def _solve_or_part(self, time: float, loads: LoadValues, work: Work, answering: bool, halvings: int) -> None:
        """In one piece, or in parts of time and loads."""
        loading, answers, start = self.state.loading, self.answering, self.state.time
        old = dict(loading.values)

        def set_fraction(fraction: float) -> None:
            loading.set({name: old[name] + fraction * (loads[name] - old[name]) for name in loads})
            # nothing remodels where cells do not answer: the first step starts from the loaded body as it was
            answers.set_time(start + (fraction * (time - start) if answering else 0.0))

        if not answering:
            answers.freeze()
        before, stage = self.state.unknown.x.array.copy(), "the step" if answering else "the change of the loads"
        most = MOST_SOLVES * self.settings.maximum_iterations + work.newton_iterations
        change = Change(time, stage, set_fraction, self.newton, halvings, most_iterations=most)
        try:
            set_fraction(1.0)
            loading.set(loads)
            work.add(self.newton.solve())
            work.substeps += 1
            # with cells that are held the way in parts has been tried already
            if not answers.held_points() and change.look_back(before, work):
                work.add(self.newton.solve())  # the cells that answer the unknowns: there is nothing else to do
        except SolveFailure as failure:
            work.add(failure)
            log.info("solving in parts: %s", failure.reason)
            change.advance(work, failure)
            loading.set(loads)
            log.info("time %g solved in %d parts", time, work.substeps)
        finally:
            answers.frozen = None
