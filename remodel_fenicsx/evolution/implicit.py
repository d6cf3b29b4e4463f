"""Cells at the end of a step belong to the stress of its end (docs/theory.md, Implicit coupling)."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.body.loading import LoadValues
from remodel_fenicsx.evolution.coupling import Traits
from remodel_fenicsx.evolution.remodeling import RemodelingPass
from remodel_fenicsx.fem.assembly import over_ranks
from remodel_fenicsx.fem.solver_methods import AUTO
from remodel_fenicsx.kernels.tensor import condensed_points, tensor_kernels
from remodel_fenicsx.model import implicit as condensed
from remodel_fenicsx.model.cells import UnitCell, structure_tensor
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.model.implicit import StepOfCells
from remodel_fenicsx.model.laws import relaxed
from remodel_fenicsx.model.tensor_law import weight_of_the_end
from remodel_fenicsx.model.tensors import det
from remodel_fenicsx.schema.settings import Solver
from remodel_fenicsx.solver.continuation import Change, Work
from remodel_fenicsx.solver.equilibrium import Equilibrium, Look
from remodel_fenicsx.solver.newton import Counted, GuardedNewton, Solution, SolveFailure
from remodel_fenicsx.state import State, at_points


# ---------------------------------------------------------------- cells that answer within a solve
# Equilibrium with stress and consistent tangent as values at the points.

log = logging.getLogger(__name__)

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

BEFORE_REFUSAL = 5  # Newton iterations after which states are refused where some point has no cells
PASSES = 8  # with frozen cells, before a second try
ROOM_PASSES, ROOM_ACCURACY = 30, 1e-8  # a tenth to a thirtieth of the change of J_g is left by each; of J_g
SETTLES = 0.5  # of the largest change of the unknowns over a pass: what the last may be


class AnsweringCells:
    """The cells at the end of a step as a function of the unknowns, at all points of this rank in one row."""

    def __init__(self, state: State, tissue: Tissue, remodeling: RemodelingPass):
        self.state, self.tissue, self.remodeling = state, tissue, remodeling
        self.quadrature = state.cells.quadrature
        self.stress = self.quadrature.function("answering_stress", (3, 3))
        self.tangent = self.quadrature.function("answering_tangent", (9, 9))
        self.frozen: UnitCell | None = None
        self._growth = None if remodeling.turnover is None else remodeling.turnover.growth
        self._kernels = tensor_kernels(state.comm) if remodeling.law.target is not None else None
        self._points: condensed.CondensedPoints
        self._found: condensed.LocalSolution
        self._gradient: Array | None = None  # F of what was found
        self._tangent_is_there = False
        self._start: Array
        self.accepted: Array
        self._iterations = 0

    # ------------------------------------------------------------ a step
    def begin(self, time: float, residual: float) -> None:
        """The present state is the start of a step to this time; it was accepted with these out-of-balance forces."""
        drive, cells = self.remodeling.drive(residual), self.state.cells.point_cells
        old = UnitCell(cells.dimensions.copy(), cells.axes.copy())
        given = self.remodeling.settings.turnover
        rule = given.rule if given.is_on else None
        step = StepOfCells(self.remodeling.law, drive, old, structure_tensor(*old[:2]), self.state.time, time, rule)
        self._points = condensed_points(self._kernels, at_points(self.tissue, self.quadrature), step)
        self.accepted = self._points.with_cells(drive.deformation_gradient, old).driving_tensor
        self.release()

    def set_time(self, time: float) -> None:
        """Another end of the step, which starts with the same cells."""
        self._points = replace(self._points, step=self._points.step._replace(time_new=time))
        self.release()

    def release(self) -> None:
        """All cells answer again, from the driving tensor of the last accepted state."""
        self._start, self._gradient, self._iterations = self.accepted, None, 0

    def freeze(self, cells: UnitCell | None = None) -> None:
        """No cells answer: these stay, or those at the start of the step."""
        self.frozen, self._gradient = cells or self._points.step.cells, None

    def follow(self, factor: float) -> None:
        """Frozen cells make a share of a pass with the present stress: towards what it asks for at the step's end."""
        assert self.frozen is not None
        self.update()
        cells = self._points.unit_cells(self._points.passed(self._found))
        self.freeze(relaxed(self.frozen, cells, factor))

    @property
    def room(self) -> Array | None:
        """J_g at all points, where tissue grows."""
        return None if self._growth is None else self._growth.ratio

    @room.setter
    def room(self, ratio: Array | None) -> None:
        if self._growth is not None and ratio is not None:
            self._growth.set(ratio)

    def make_room(self) -> float:
        """Take J_g from the content of the last update: by how much it changes, over itself."""
        if self._growth is None:
            return 0.0
        self.update()
        assert self.turnover is not None
        before = self._growth.ratio
        self._growth.follow(np.exp(self.turnover[0]).reshape(before.shape))
        return self.quadrature.maximum(np.abs(self._growth.ratio / before - 1.0))

    def accept(self) -> None:
        """The present state is a solved one."""
        self.update()
        self.accepted = self._found.driving_tensor

    @property
    def step(self) -> StepOfCells:
        """The one that has begun."""
        return self._points.step

    @property
    def asked(self) -> UnitCell:
        """The cells of the last update."""
        return self._points.unit_cells(self._found)

    @property
    def turnover(self) -> Array | None:
        """ln m and ln rho (2, n) of the last update, where they change."""
        return None if self._found.turnover is None else self._found.turnover.T

    def complete(self) -> bool:
        """Whether at all points, of all ranks, cells belong to the stress of the present unknowns."""
        self.update()
        return not self._anywhere(~self._found.converged)

    def _anywhere(self, points: Flags) -> bool:
        owned = self.quadrature.owned(points.reshape(self.quadrature.shape))
        return bool(self.state.comm.allreduce(int(owned.any())))

    # ------------------------------------------------------------ values
    def update(self, tangent: bool = False) -> None:
        """Stress, and tangent on request, of the present unknowns."""
        F = self.state.elastic_gradient()
        if self._gradient is None or not np.array_equal(F, self._gradient):
            self._found = self._solved(F)
            self._gradient, self._tangent_is_there = F, False
            stress = self._found.first_piola_kirchhoff.reshape(*self.quadrature.shape, 3, 3)
            self.quadrature.values(self.stress, (3, 3))[:] = stress
        if tangent and not self._tangent_is_there:
            self._iterations += 1
            self._start = self._found.driving_tensor
            derivative = self._points.tangent if self.frozen is None else self._points.frozen_tangent
            values = derivative(self._found).reshape(*self.quadrature.shape, 9, 9)
            self.quadrature.values(self.tangent, (9, 9))[:] = values
            self._tangent_is_there = True

    def _solved(self, F: Array) -> condensed.LocalSolution:
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            F = np.where((det(F) > 0)[:, None, None], F, np.eye(3))
            if self.frozen is not None:
                return self._points.with_cells(F, self.frozen)
            return self._points.solve(F, self._start)

    def squared_lengths(self) -> Array:
        """r^2 at all points, (elements, points); infinite where there are no cells for these unknowns."""
        self.update()
        squared = np.where(self._refused, np.inf, self._found.squared_lengths)
        return squared.reshape(self.quadrature.shape)

    @property
    def _refused(self) -> Flags:
        """Points without a solution, after so many iterations that none is expected."""
        return ~self._found.converged & (self._iterations > BEFORE_REFUSAL)

    def unsolved(self, locking_length: Array) -> bool:
        """Whether the present unknowns are refused for points, on any rank, that have no solution with r < L."""
        self.update()
        return self._anywhere(self._refused & (self._found.squared_lengths < locking_length.reshape(-1) ** 2))


class AnsweringEquilibrium(Equilibrium):
    """Equilibrium whose stress and tangent come from `AnsweringCells`."""

    def __init__(self, state: State, tissue: Tissue, answering: AnsweringCells):
        self.answering = answering
        super().__init__(state, tissue)

    def internal_and_tangents(self, F: Any, test: Any, trial: Any) -> tuple[list[Any], list[Any]]:
        """Virtual work of P, and with it dP/dF."""
        u, weight, dx = (
            self.state.unknown,
            self.state.kinematics.stress_free_weight(self.quadrature.mesh),
            self.quadrature.dx,
        )
        variation, increment = (ufl.derivative(F, u, function) for function in (test, trial))
        row, column = (ufl.as_vector([F_[i, j] for i in range(3) for j in range(3)]) for F_ in (variation, increment))
        internal = ufl.inner(self.answering.stress, variation) * weight * dx
        return [internal], [ufl.inner(ufl.dot(self.answering.tangent, column), row) * weight * dx]

    def look(self) -> Look:
        """As of `Equilibrium`, which knows nothing of cells that answer: nothing is remembered."""
        return self._look()

    def states(self) -> Array:
        """As of `Equilibrium`, with the cells that belong to the present unknowns."""
        states = super().states()
        if np.all(states[..., 1] > 0):  # for a state that is inside out no cells are looked for
            states[..., 0] = self.answering.squared_lengths()
        return states

    def assemble_internal(self, vector: Any) -> None:
        """Internal nodal forces of the present unknowns."""
        self.answering.update()
        super().assemble_internal(vector)

    def _update_tangent(self) -> None:
        self.answering.update(tangent=True)


class AnsweringNewton(GuardedNewton):
    """Newton's method for cells that answer."""

    def __init__(self, equilibrium: AnsweringEquilibrium, settings: Solver):
        # cells that answer make steps far more nonlinear, and tangents unsymmetric: nothing is gained by old factors
        super().__init__(equilibrium, settings, robust=settings.method == AUTO)
        self.answering = equilibrium.answering
        self._patient = False  # whether shorter steps are looked for where cells have no solution

    def solve(self, origin: Array | None = None) -> Solution:
        """As of `GuardedNewton`, or from where passes lead, or at last with shorter steps."""
        # Where Newton's method fails, or some cells have no solution at its deformations, it starts again from the
        # equilibrium to which passes with frozen cells come: it often is near.
        start, accepted = self.unknown.x.array.copy(), self.answering.accepted
        try:
            return self._solved(origin)
        except SolveFailure as failure:
            if self.answering.frozen is not None:
                raise
            work = failure
        for again in (self._solved_after_passes, self._solved_patiently):
            try:
                solution = again(work)
                solution.count(work)
                return solution
            except SolveFailure as failure:
                if failure is not work:
                    failure.count(work)
                    work = failure
                self.unknown.x.array[:], self.answering.accepted = start, accepted
        raise work

    def _solved_after_passes(self, work: SolveFailure) -> Solution:
        log.info("the step is solved once more, from where remodeling passes lead: %s", work.reason)
        if not self._pass(work):
            log.info("remodeling passes do not converge")
            raise work
        return self._solved()

    def _solved_patiently(self, work: SolveFailure) -> Solution:
        log.info("the step is solved once more, with shorter Newton steps: %s", work.reason)
        self._patient = True
        try:
            return self._solved()
        finally:
            self._patient = False

    def _pass(self, work: SolveFailure) -> bool:
        """Passes with frozen cells, each with its equilibrium, up to one that changes nothing; adds what they cost."""
        # Returns whether they come nearer to each other.
        answering, values, share = self.answering, self.unknown.x.array, 1.0
        ways: list[float] = []  # of the unknowns, over each pass
        try:
            answering.freeze()
            work.count(self._solved())
            for _ in range(PASSES):
                before, frozen = values.copy(), answering.frozen
                try:
                    answering.follow(share)
                    solution = self._solved()
                except SolveFailure as failure:  # too large a change of the cells: r >= L where they are longer
                    work.count(failure)
                    values[:], share = before, share / 2
                    answering.freeze(frozen)
                    continue
                work.count(solution)
                way = over_ranks(self.equilibrium.comm, float(np.abs(values - before).max(initial=0.0)), MPI.MAX)
                ways.append(way / share)
                if share == 1.0 and not solution.newton_iterations:
                    break
                share = min(1.0, 2 * share)
        finally:
            answering.frozen = None
        return bool(ways) and ways[-1] <= SETTLES * max(ways)

    def gives_up(self, trial: Look) -> bool:
        """Where cells have no solution: passes cost less than shorter steps."""
        right_way_out = trial.extension.min_jacobian > 0 and not self._patient
        return right_way_out and self.answering.unsolved(self.equilibrium.locking_length())

    def _solved(self, origin: Array | None = None) -> Solution:
        self.answering.release()
        start, room, spent = self.unknown.x.array.copy(), self.answering.room, Counted()
        try:
            for _ in range(ROOM_PASSES):  # the points of an element share it: no function of one point's deformation
                solution = super().solve(origin)
                solution.count(spent)
                spent, origin = solution, None
                if self.answering.make_room() <= ROOM_ACCURACY:
                    break
            else:
                raise SolveFailure("what is made does not find its room", 0, 0, self.equilibrium.extension())
            if not self.answering.complete():
                text = "points without cells that fit their own stress"
                raise SolveFailure(text, 0, 0, self.equilibrium.extension())
        except SolveFailure as failure:
            failure.count(spent)
            self.unknown.x.array[:], self.answering.room = start, room
            raise
        self.answering.accept()
        return solution


RESIDUAL = "residual of the last step"
MOST_SOLVES = 20  # of all Newton iterations that one may have, for a step with its parts; then it is refused


class Implicit:
    """Newton's method on the unknowns with cells that follow at each point (`model.implicit`)."""

    traits = Traits(order=1, accumulates=True)

    def __init__(self, state: State, tissue: Tissue, remodeling: RemodelingPass, settings: Solver):
        self.state, self.remodeling, self.settings = state, remodeling, settings
        self.equilibrium: Equilibrium = Equilibrium(state, tissue)  # of solved states
        self.equilibrium.compile_energy()
        self.answering = AnsweringCells(state, self.equilibrium.tissue, remodeling)
        solved = AnsweringEquilibrium(state, tissue, self.answering)
        self.newton: GuardedNewton = AnsweringNewton(solved, settings)
        self.turnover, self._power = remodeling.turnover, 0.0
        state.numbers[RESIDUAL] = 0.0

    def solve(self, time: float, loads: LoadValues) -> Work:
        """Equilibrium at `time` with the cells that belong to it."""
        work, start = Work(), self.state.elastic_gradient()
        self.answering.begin(time, self.state.numbers[RESIDUAL])
        if self.turnover is not None:
            self.turnover.begin()
        if self.state.number == 0:
            self._solve(time, loads, work, answering=False)
            self.answering.begin(time, work.residual)
        self._solve(time, loads, work, answering=True)
        work.substeps -= int(self.state.number == 0)
        self.state.numbers[RESIDUAL] = work.residual
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
        law, step = self.remodeling.law, self.answering.step
        if law.of_absolute_time:
            return None
        from_start = law.update(step.cells, step.drive, step.time_old, step.time_new)
        weight = weight_of_the_end(self.remodeling.kappa * (step.time_new - step.time_old))
        return relaxed(from_start, self.answering.asked, weight)

    def close(self) -> None:
        """Free PETSc's objects."""
        self.newton.close()

    def _solve(self, time: float, loads: LoadValues, work: Work, answering: bool) -> None:
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
        halvings = self.settings.maximum_halvings
        change = Change(time, stage, set_fraction, self.newton, halvings, most_iterations=most)
        try:
            set_fraction(1.0)
            loading.set(loads)
            work.add(self.newton.solve())
            work.substeps += 1
            if change.look_back(before, work):
                work.add(self.newton.solve())  # the cells that answer the unknowns: there is nothing else to do
        except SolveFailure as failure:
            work.add(failure)
            log.info("solving in parts: %s", failure.reason)
            change.advance(work, failure)
            loading.set(loads)
            log.info("time %g solved in %d parts", time, work.substeps)
        finally:
            answers.frozen = None
