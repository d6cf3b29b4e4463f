"""The coupling "implicit": cells at the end of a step belong to the stress of its end (docs/theory.md).

At each point `model.local_problem` makes cells, stress and consistent tangent of F (`ImplicitCells`). They enter the
equilibrium as values at the points (`ImplicitEquilibrium`), which Newton's method solves (`ImplicitNewton`). `Implicit`
is the step.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import ufl
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.body.loading import LoadValues
from remodel_fenicsx.evolution.coupling import Traits, between, how_many
from remodel_fenicsx.evolution.remodeling import RemodelingPass
from remodel_fenicsx.fem.assembly import Remembered, over_ranks
from remodel_fenicsx.fem.solver_methods import LAGGED, PRECONDITIONED
from remodel_fenicsx.kernels.tensor import problem_of, tensor_kernels
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.model.laws import relaxed
from remodel_fenicsx.model.local_problem import LocalProblem, LocalSolution, StepOfCells
from remodel_fenicsx.model.tensor_law import weight_of_the_end
from remodel_fenicsx.model.tensors import det, from_mandel
from remodel_fenicsx.schema.settings import Solver
from remodel_fenicsx.solver.continuation import Change, Work
from remodel_fenicsx.solver.equilibrium import Equilibrium, Look
from remodel_fenicsx.solver.newton import Counted, GuardedNewton, Solution, SolveFailure
from remodel_fenicsx.state import State, at_points

log = logging.getLogger(__name__)

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

RESIDUAL = "residual of the last step"
BEFORE_REFUSAL = 5  # Newton iterations after which states are refused where some point has no cells
NEAR = 0.1  # of D: a change up to which its slope says more of the next D than the last D does
PASSES = 8  # before a second try
SETTLES = 0.5  # of the largest change of the unknowns over a pass: what the last may be
ROOM_PASSES, ROOM_ACCURACY = 30, 1e-8  # a tenth to a thirtieth of the change of J_g is left by each; of J_g
MOST_SOLVES = 20  # of all Newton iterations that one may have, for a step with its parts; then it is refused


class Guess(NamedTuple):
    """D of a state, and where they are known its F with the slope of D there (n, 6, 9)."""

    tensor: Array
    known: tuple[Array, Array] | None = None

    def at(self, gradient: Array) -> Array:
        """D at an F near that one, where it changes little: else that of the state."""
        if self.known is None:
            return self.tensor
        before, slope = self.known
        way = from_mandel((slope @ (gradient - before).reshape(-1, 9, 1))[:, :, 0])
        near = np.linalg.norm(way, axis=(1, 2)) < NEAR * np.linalg.norm(self.tensor, axis=(1, 2))
        return self.tensor + np.where(near[:, None, None], way, 0.0)


class ImplicitCells:
    """The cells at the end of a step as a function of the unknowns, at all points of this rank in one row."""

    def __init__(self, state: State, tissue: Tissue, remodeling: RemodelingPass):
        self.state, self.tissue, self.remodeling = state, tissue, remodeling
        self.quadrature = state.cells.quadrature
        self.stress = self.quadrature.function("implicit_stress", (3, 3))
        self.tangent = self.quadrature.function("implicit_tangent", (9, 9))
        self._kernels = tensor_kernels(state.comm)
        F = state.kinematics.elastic_gradient(state.unknown)
        self._solutions: Remembered[LocalSolution] = Remembered(None, F)
        self._tangents: Remembered[None] = Remembered(None, F)
        self._problem: LocalProblem
        self._accepted: Array  # D of the last solved state
        self._guess: Guess  # from where cells are looked for
        self._iterations = 0

    # ------------------------------------------------------------ a step
    def begin(self, time: float, residual: float) -> None:
        """The present state is the start of a step to this time; it was accepted with these out-of-balance forces."""
        old, drive = self.state.cells.point_cells.copy(), self.remodeling.drive(residual)
        given = self.remodeling.settings.turnover
        rule = given.rule if given.is_on else None
        step = StepOfCells(self.remodeling.law, drive, old, self.state.time, time, rule)
        self._problem = problem_of(self._kernels, at_points(self.tissue, self.quadrature), step)
        self._accepted = self.tensor_of_state()
        self.restart()

    def set_time(self, time: float) -> None:
        """Another end of the step, which starts with the same cells."""
        self._problem = replace(self._problem, step=self.step._replace(time_new=time))
        self.restart()

    def restart(self, guess: Array | None = None) -> None:
        """Cells are looked for from a D, or from that of the last accepted state."""
        self._guess, self._iterations = Guess(self._accepted if guess is None else guess), 0
        self._solutions.forget()

    def accept(self) -> None:
        """The present state is a solved one."""
        self._accepted = self.solution().driving_tensor

    def tensor_of_state(self) -> Array:
        """D of the present cells, were they to stay."""
        return self._problem.tensor_of(self.state.elastic_gradient(), self.state.cells.point_cells)

    @property
    def step(self) -> StepOfCells:
        """The one that has begun."""
        return self._problem.step

    # ------------------------------------------------------------ at the present unknowns
    def solution(self) -> LocalSolution:
        """Of all points; their stress goes into the form."""
        return self._solutions(self._solved)

    def update_tangent(self) -> None:
        """The tangent goes into the form; the next cells are looked for from here."""
        found = self.solution()
        self._tangents(lambda: self._differentiated(found))

    def _solved(self) -> LocalSolution:
        F = self.state.elastic_gradient()
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            F = np.where((det(F) > 0)[:, None, None], F, np.eye(3))
            found = self._problem.solve(F, self._guess.at(F))
        stress = found.first_piola_kirchhoff.reshape(*self.quadrature.shape, 3, 3)
        self.quadrature.values(self.stress, (3, 3))[:] = stress
        self._tangents.forget()
        return found

    def _differentiated(self, found: LocalSolution) -> None:
        slopes = self._problem.tangent(found)
        self._iterations += 1
        self._guess = Guess(found.driving_tensor, (found.gradient, slopes.by_gradient))
        self.quadrature.values(self.tangent, (9, 9))[:] = slopes.tangent.reshape(*self.quadrature.shape, 9, 9)

    def unit_cells(self) -> UnitCell:
        """Those that belong to the present unknowns."""
        return self._problem.unit_cells(self.solution())

    def turnover(self) -> Array | None:
        """ln m and ln rho (2, n), where they change."""
        turnover = self.solution().turnover
        return None if turnover is None else turnover.T

    def make_room(self) -> float:
        """Let J_g follow the content, where tissue grows: by how much it changes, over itself."""
        turnover = self.turnover()
        if turnover is None or self.remodeling.turnover.growth is None:
            return 0.0
        growth = self.remodeling.turnover.growth
        before = growth.ratio
        growth.follow(np.exp(turnover[0]).reshape(before.shape))
        return self.quadrature.maximum(np.abs(growth.ratio / before - 1.0))

    def complete(self) -> bool:
        """Whether at all points, of all ranks, cells belong to the stress."""
        return not how_many(self.state, ~self.solution().converged)

    def squared_lengths(self) -> Array:
        """r^2 at all points, (elements, points); infinite where there are no cells for these unknowns."""
        squared = np.where(self._refused(), np.inf, self.solution().squared_lengths)
        return squared.reshape(self.quadrature.shape)

    def unsolved(self, locking_length: Array) -> bool:
        """Whether the present unknowns are refused for points, on any rank, that have no solution with r < L."""
        short = self.solution().squared_lengths < locking_length.reshape(-1) ** 2
        return how_many(self.state, self._refused() & short) > 0

    def _refused(self) -> Flags:
        """Points without a solution, after so many iterations that none is expected."""
        return ~self.solution().converged & (self._iterations > BEFORE_REFUSAL)


class ImplicitEquilibrium(Equilibrium):
    """Equilibrium whose stress and tangent are those of `ImplicitCells`."""

    def __init__(self, state: State, tissue: Tissue, cells: ImplicitCells):
        self.cells = cells
        super().__init__(state, tissue)
        self.pointwise = None  # what UFL leaves out is in the stress

    def internal_and_tangents(self, F: Any, test: Any, trial: Any) -> tuple[list[Any], list[Any]]:
        """Virtual work of P, and with it dP/dF."""
        u, weighted = self.state.unknown, self.state.kinematics.stress_free_weight(self.quadrature.mesh)
        dx = self.quadrature.dx
        variation, increment = (ufl.derivative(F, u, function) for function in (test, trial))
        row, column = (ufl.as_vector([F_[i, j] for i in range(3) for j in range(3)]) for F_ in (variation, increment))
        internal = ufl.inner(self.cells.stress, variation) * weighted * dx
        return [internal], [ufl.inner(ufl.dot(self.cells.tangent, column), row) * weighted * dx]

    def look(self) -> Look:
        """As of `Equilibrium`, which would remember what it saw of other cells at these unknowns."""
        return self._look()

    def states(self) -> Array:
        """As of `Equilibrium`, with the cells that belong to the present unknowns."""
        states = super().states()
        if np.all(states[..., 1] > 0):  # for a state that is inside out no cells are looked for
            states[..., 0] = self.cells.squared_lengths()
        return states

    def assemble_internal(self, vector: Any) -> None:
        """Internal nodal forces of the present unknowns."""
        self.cells.solution()
        super().assemble_internal(vector)

    def _update_tangent(self) -> None:
        self.cells.update_tangent()


def newton_of_still_cells(equilibrium: Equilibrium, settings: Solver) -> GuardedNewton:
    """For cells that stay as they are, robust as the parts of a step; to be closed, with its matrix and factors."""
    return GuardedNewton(equilibrium, settings, robust=True)


class ImplicitNewton(GuardedNewton):
    """Newton's method for unknowns that their cells follow."""

    methods = {LAGGED: PRECONDITIONED}  # tangents are unsymmetric, and each of them is worth its iteration

    def __init__(self, equilibrium: ImplicitEquilibrium, still: Equilibrium, settings: Solver):
        super().__init__(equilibrium, settings, robust=True)  # a named `lagged` too: an old factor leads astray
        self.cells, self.state, self.still = equilibrium.cells, equilibrium.state, still

    def solve(self, origin: Array | None = None) -> Solution:
        """As of `GuardedNewton`, or from where passes lead."""
        # Where Newton's method fails, or some cells have no solution at its deformations, it starts again from the
        # equilibrium to which passes lead: it often is near.
        try:
            return self._solved(origin)
        except SolveFailure as failure:
            log.info("the step is solved once more, from where remodeling passes lead: %s", failure.reason)
            try:
                with self.state.transaction():
                    solution = self._after_passes(failure)
            except SolveFailure as again:
                if again is not failure:
                    again.count(failure)
                raise
            solution.count(failure)
            return solution

    def _solved(self, origin: Array | None = None, guess: Array | None = None) -> Solution:
        self.cells.restart(guess)
        spent = Counted()
        try:
            with self.state.transaction():
                for _ in range(ROOM_PASSES):  # an element's points share room: it is no function of one point's F
                    solution = super().solve(origin)
                    solution.count(spent)
                    spent, origin = solution, None
                    if self.cells.make_room() <= ROOM_ACCURACY:
                        break
                else:
                    raise SolveFailure("what is made does not find its room", 0, 0, self.equilibrium.extension())
                if not self.cells.complete():
                    text = "points without cells that fit their own stress"
                    raise SolveFailure(text, 0, 0, self.equilibrium.extension())
        except SolveFailure as failure:
            failure.count(spent)
            raise
        self.cells.accept()
        return solution

    def _after_passes(self, work: SolveFailure) -> Solution:
        with self.state.tentative(), closing(newton_of_still_cells(self.still, self.settings)) as newton:
            settled = self._pass(newton, work)
            unknowns, guess = self.unknown.x.array.copy(), self.cells.tensor_of_state()
        if not settled:
            log.info("remodeling passes do not converge")
            raise work
        self.unknown.x.array[:] = unknowns
        return self._solved(guess=guess)

    def _pass(self, newton: GuardedNewton, work: SolveFailure) -> bool:
        """Passes over the step, each with its equilibrium, up to one that changes nothing; adds what they cost."""
        # Returns whether they come nearer to each other.
        values, cells, step, remodeling = self.unknown.x.array, self.state.cells, self.cells.step, self.cells.remodeling
        ways: list[float] = []  # of the unknowns, over each pass
        part, solution = 1.0, newton.solve()
        work.count(solution)
        for _ in range(PASSES):
            before, old = values.copy(), cells.point_cells.copy()
            asked, _ = remodeling.updated_cells(step.time_old, step.time_new, solution.residual, step.cells)
            cells.set(*relaxed(old, asked, part)[:2])
            try:
                solution = newton.solve()
            except SolveFailure as failure:  # too large a change of the cells: r >= L where they are longer
                work.count(failure)
                cells.set(*old[:2])
                part /= 2
                continue
            work.count(solution)
            ways.append(over_ranks(newton.equilibrium.comm, np.abs(values - before).max(initial=0.0), MPI.MAX) / part)
            if part == 1.0 and not solution.newton_iterations:
                break
            part = min(1.0, 2 * part)
        return bool(ways) and ways[-1] <= SETTLES * max(ways)

    def gives_up(self, trial: Look) -> bool:
        """Where cells have no solution: passes, and parts of the step, cost less than shorter steps."""
        return trial.extension.min_jacobian > 0 and self.cells.unsolved(self.equilibrium.locking_length())


class Implicit:
    """A step in which Newton's method finds the unknowns with the cells that belong to them."""

    traits = Traits(order=1, accumulates=True)

    def __init__(self, state: State, tissue: Tissue, remodeling: RemodelingPass, settings: Solver):
        self.state, self.remodeling, self.settings = state, remodeling, settings
        self.equilibrium: Equilibrium = Equilibrium(state, tissue)  # of solved states
        self.equilibrium.compile_energy()
        self.cells = ImplicitCells(state, self.equilibrium.tissue, remodeling)
        implicit = ImplicitEquilibrium(state, tissue, self.cells)
        self.newton: GuardedNewton = ImplicitNewton(implicit, self.equilibrium, settings)
        self.turnover, self._power = remodeling.turnover, 0.0
        state.numbers[RESIDUAL] = 0.0

    def solve(self, time: float, loads: LoadValues) -> Work:
        """Equilibrium at `time` with the cells that belong to it."""
        work, state, F = Work(), self.state, self.state.elastic_gradient()
        if self.turnover is not None:
            self.turnover.begin()
        is_first = state.number == 0
        if is_first:  # it starts from the loaded body with its cells as they were
            with closing(newton_of_still_cells(self.equilibrium, self.settings)) as newton:
                self._go(time, "the change of the loads", self._loading_to(loads), newton, work)
        self.cells.begin(time, work.residual if is_first else state.numbers[RESIDUAL])
        start, set_loads = state.time, self._loading_to(loads)

        def set_fraction(fraction: float) -> None:
            set_loads(fraction)
            self.cells.set_time((1.0 - fraction) * start + fraction * time)

        self._go(time, "the step", set_fraction, self.newton, work)
        work.substeps -= int(is_first)
        state.numbers[RESIDUAL] = work.residual
        work.extension = None  # the row's is with the cells that are taken over now
        self._power = self.remodeling.replace(self.cells.unit_cells(), F, time - start)
        state.settle_cells()
        if self.turnover is not None:
            self.turnover.take(self.cells.turnover())
        return work

    def remodel(self, time: float) -> float:
        """Nothing is left to do."""
        if self.turnover is not None:
            self.turnover.complete(time)
        return self._power

    @property
    def better(self) -> UnitCell | None:
        """What the stresses at both ends of the step ask for together; eq. (11) asks for the end alone."""
        law, step = self.remodeling.law, self.cells.step
        if law.of_absolute_time:
            return None
        from_start = law.update(step.cells, step.drive, step.time_old, step.time_new)
        return relaxed(from_start, self.cells.unit_cells(), weight_of_the_end(step.kappa_dt))

    def close(self) -> None:
        """Free PETSc's objects."""
        self.newton.close()

    def _loading_to(self, loads: LoadValues) -> Callable[[float], None]:
        """Sets the loads after a fraction of their change from the present ones."""
        loading, old = self.state.loading, dict(self.state.loading.values)
        return lambda fraction: loading.set(between(old, loads, fraction))

    def _go(
        self, time: float, stage: str, set_fraction: Callable[[float], None], newton: GuardedNewton, work: Work
    ) -> None:
        """Solve after a change, in one piece or in parts."""
        most = MOST_SOLVES * self.settings.maximum_iterations + work.newton_iterations
        change = Change(
            time, stage, set_fraction, self.state, lambda: newton, self.settings.maximum_halvings, most_iterations=most
        )
        before, again = self.state.unknown.x.array.copy(), work.substeps > 0
        try:
            set_fraction(1.0)
            work.add(newton.solve())
            work.substeps += 1
            if change.look_back(before, work, again):
                work.add(newton.solve())  # the cells that belong to the unknowns: there is nothing else to do
        except SolveFailure as failure:
            work.add(failure)
            log.info("solving in parts: %s", failure.reason)
            change.advance(work, failure)
            log.info("time %g solved in %d parts", time, work.substeps)
