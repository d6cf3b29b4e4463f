"""The biological equilibrium at once: the state that remodeling comes to under the loads at the end.

Laws with a limit come to rest where the cells are those of their own stress: l = r0 e with n its axes, or A = r0^2 E.
A body may have several such states, and a point without tension keeps its cells: the way there decides. So the way is
gone, in steps of chosen lengths, until the rest of it is one step of Newton's method (docs/theory.md, "Equilibrium at
once").
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.body.loading import LoadValues
from remodel_fenicsx.evolution.implicit import RESIDUAL, Implicit
from remodel_fenicsx.evolution.stepper import Step, Watcher
from remodel_fenicsx.evolution.time_steps import StepControl
from remodel_fenicsx.evolution.turnover import MUCH, Slowing
from remodel_fenicsx.fem import assembly
from remodel_fenicsx.model.cells import structure_tensor
from remodel_fenicsx.solver.continuation import Work
from remodel_fenicsx.solver.newton import GuardedNewton, SolveFailure
from remodel_fenicsx.state import Snapshot
from remodel_fenicsx.system import NOTICE

log = logging.getLogger(__name__)
Array = NDArray[np.float64]

PATH_TOLERANCE, UNLOADING = 3.0, 0.5
"""Of the steps on the way, in degrees, where a scene has no time.tolerance: in all, and where loads fall or reverse.
There points lose their tension, and their cells stay as exact as the way. The paper's artery takes 25 solves."""
UNCHECKED = 90.0  # degrees: more than any step's error, where it leaves nothing
LONGEST = 1.0  # step on the way, times kappa: longer ones leave too few looks at cells that come to rest slowly
LIMIT_ITERATIONS = 10
"""Of Newton's method in the step to the limit: from near it takes 3 to 7, and one that fails costs more than steps."""
NEAR_REST, AGAIN, TRIES = 0.05, 0.7, 6
"""Change of A over r0^2 by a pass to the limit from which on the rest is tried in one step, how much nearer the cells
are at the next try, and how often. Where there are points that gain and lose their tension, none is solved."""
SAME_WAY, NO_CHANGE = 0.5, 0.03
"""The step leads where time does if it changes A at each point in the direction of that pass: cosine, and change over
r0^2 that needs none. Measured on tubes: steps to another state had points with a cosine of -0.7 and below. Right ones
from afar had some too (-0.6), and are made from nearer."""
FRONT = 1.2
"""Difference of A over r0^2 between neighbouring points from which on a front lies between them: chains of one
direction that turn by 58 degrees. The paper's artery has 0.67 at most, tubes with a front had 1.35 to 1.41."""
REST = 1e-4
"""Change of A over r0^2 in a time of 1/kappa at which cells rest. The slowest bodies seen forget at a twentieth of
kappa: what is left is 0.002, a tenth of a degree."""
LONGEST_HOLD = 100.0  # times 1/kappa under held loads after which cells that do not rest are left


class Limit(Implicit):
    """A step over a time without end, in one piece or not at all."""

    def _go(
        self, time: float, stage: str, set_fraction: Callable[[float], None], newton: GuardedNewton, work: Work
    ) -> None:
        set_fraction(1.0)
        work.add(newton.solve())
        work.substeps += 1


class Homeostasis:
    """The way through ramps and held loads until the cells rest, as one step of a stepper."""

    def __init__(
        self, control: StepControl, held_from: float, limit: Limit | None, first: tuple[float, float] | None = None
    ):
        self.control, self.held_from, self.limit = control, held_from, limit
        self.first = first  # hold of the loads in which the way rests once before, from and to
        self.stepper, self.state, self.tolerance = control.stepper, control.state, control.tolerance
        self.remodeling, self.turnover = self.stepper.remodeling, self.stepper.turnover
        self.quadrature = self.state.cells.quadrature
        control.level = logging.INFO  # no row of the way is a result; of points that turn over at once fronts tell
        self.steps, self._residual = 0, 0.0
        self._held: Snapshot | None = None  # the first state on the way under held loads

    def march(self, time: float, watchers: Sequence[Watcher] = ()) -> Iterator[Step]:
        """The state at rest, as the step to a time; what is yielded is committed."""
        self.stepper.start(watchers)
        if self.state.time < time:
            yield self.stepper.advance(time, watchers, is_last=True, way=self)

    def close(self) -> None:
        """Free PETSc's objects."""
        if self.limit is not None:
            self.limit.close()

    def solve(self, time: float, loads: LoadValues) -> Work:
        """Equilibrium of forces and of cells."""
        state, work = self.state, Work()
        start, number, self.steps, self._held = state.time, state.number, 0, None
        coarsens = not self.stepper.coupling.traits.accumulates and self.tolerance < UNCHECKED and self.turnover is None
        if self.first is not None:
            self._rest_before(*self.first, work)
        self._go(time, loads, max(start, self.held_from), coarsens, work)
        if coarsens and self._held is not None and self._largest_jump()[0] > FRONT:
            log.info(
                "the cells have a front, whose place depends on the path: the path is followed again with the tolerance"
            )
            state.restore(self._held)
            self._go(time, loads, max(start, self.held_from), False, work)
        state.reach(start, number)
        for case in state.cases().values():
            case.settle_cells()
        self._residual = work.residual
        return work

    def _rest_before(self, held: float, change: float, work: Work) -> None:
        """Wait under loads that are held until all rests; what is made from there on takes room."""
        control, stepper, growth = self.control, self.stepper, self.turnover.growth
        stops, given = control.stops, stepper.load_values
        control.stops = [*(stop for stop in stops if stop <= held), stops[-1]]
        stepper.load_values = lambda time: given(min(time, held))
        try:
            self._go(stops[-1], given(held), held, False, work)
        finally:
            control.stops, stepper.load_values = stops, given
        self.state.settle_cells()
        log.info("growth begins, after %d steps", self.steps)
        growth.start = change
        self.state.reach(change, self.state.number)

    def _go(self, time: float, loads: LoadValues, held: float, coarsens: bool, work: Work) -> None:
        """From where the state is until the cells rest."""
        # The error of a row that lags leaves nothing once the cells rest, unless they come to rest elsewhere. Where
        # collagen comes to rest depends on the way.
        state, self.near, self.tries, self._slowing = self.state, NEAR_REST, TRIES, Slowing(dict(Slowing.INITIAL))
        self.control.tolerance = self.tolerance
        for step in self.control.march():
            self.steps += 1
            work.add(step.work)
            work.substeps += step.work.substeps
            work.residual = step.work.residual
            log.info("on the path: time %g, %d Newton iterations", step.time, step.work.newton_iterations)
            if state.time < held:
                continue
            if coarsens:
                self.control.tolerance = UNCHECKED
            ahead, solved = state.snapshot(), state.equilibrium_cells
            self._held = self._held or ahead
            state.cells.set(solved.dimension_values, solved.axis_values)  # those that the stress belongs to
            if self._is_over(time, loads, self.stepper.slowest * (state.time - held), work):
                return
            state.restore(ahead)

    def _is_over(self, time: float, loads: LoadValues, waiting: float, work: Work) -> bool:
        """Whether the cells rest, or the rest of the way was made in one step."""
        towards = self._change_by_a_pass(time, work.residual)
        towards[self.remodeling.without_tension(work.residual).reshape(self.quadrature.shape)] = 0.0
        rest = self._largest(towards)
        far = max(rest, self._growth())
        if self.limit is not None and self.tries and far <= self.near:
            self.near, self.tries = AGAIN * far, self.tries - 1
            if self._arrived(self.limit, time, loads, towards, work):
                return True
        soon = self.state.time + 1 / self.stepper.slowest
        if max(self._largest(self._change_by_a_pass(soon, work.residual)), self._growth()) <= REST:
            return True
        if self._grows_on(waiting):
            text = (
                "growth does not come to rest, its rates fall no faster than 1/t "
                "(docs/tissue_that_lives.md, When it comes to rest): the state is that "
                "of time %g, on the path"
            )
            self._say(logging.WARNING, text, self.state.time)
            return True
        if waiting > LONGEST_HOLD:
            self._say(
                logging.WARNING,
                "the cells do not come to rest: a pass to its limit changes the structure tensor A by up to %.2g r0^2",
                rest,
            )
            if self.turnover is not None:
                self._say(
                    logging.WARNING, "content or natural length change by up to %.2g in a time of T", self._growth()
                )
        return waiting > LONGEST_HOLD

    def _growth(self) -> float:
        """Largest relative change of content or natural length in the time in which `REST` is asked for."""
        if self.turnover is None:
            return 0.0
        return self.quadrature.maximum(self.turnover.fastest_changes()) / self.stepper.slowest

    def _grows_on(self, waiting: float) -> bool:
        """Whether the natural length has grown much, and its rates do not fall as those do that come to rest."""
        if self.turnover is None:
            return False
        goes_on = self._slowing.goes_on(waiting, self._growth())
        return goes_on and self.quadrature.maximum(self.turnover.factors("natural_length")) > MUCH

    def _arrived(self, limit: Limit, time: float, loads: LoadValues, towards: Array, work: Work) -> bool:
        """Make the rest of the way in one step; if it is not solved or leads elsewhere, all is as before."""
        state, before, residual = self.state, self.state.snapshot(), work.residual
        structure = state.cells.structure_tensor()
        grown = None if self.turnover is None else (self.turnover.logarithms(), self.turnover.rates())
        state.numbers[RESIDUAL] = residual
        try:
            found = limit.solve(time, loads)
        except SolveFailure as failure:
            work.add(failure)
            log.info("the rest of the path was not solved in one step: %s", failure.reason)
            state.restore(before)
            return False
        work.add(found)
        leads_on = self._is_along(state.cells.structure_tensor() - structure, towards)
        if not leads_on or (grown is not None and not self._grows_along(*grown)):
            work.residual = residual
            log.info("one step for the rest of the path led to another state; it is not used")
            state.restore(before)
            return False
        self.steps, work.substeps, work.residual = self.steps + 1, work.substeps + 1, found.residual
        return True

    def _is_along(self, change: Array, towards: Array) -> bool:
        """Whether a change of A goes where a pass does, at all points where it counts."""
        size, pass_size = (np.linalg.norm(tensors, axis=(-1, -2)) for tensors in (change, towards))
        aside = (change * towards).sum(axis=(-1, -2)) < SAME_WAY * size * pass_size
        return self._largest(np.where((aside | (pass_size == 0.0))[..., None, None], change, 0.0)) <= NO_CHANGE

    def _grows_along(self, before: Array, rates: Array) -> bool:
        """Whether ln m and ln rho have changed as their rates did, at all points where it counts."""
        change = self.turnover.logarithms() - before
        against = np.where(change * rates < 0.0, np.abs(change), 0.0).max(axis=0)
        return self.quadrature.maximum(against.reshape(self.quadrature.shape)) <= NO_CHANGE

    def _change_by_a_pass(self, time: float, residual: float) -> Array:
        """Of A up to a time, at all points."""
        asked, _ = self.remodeling.updated_cells(self.state.time, time, residual)
        found = structure_tensor(*asked[:2]).reshape(*self.quadrature.shape, 3, 3)
        return np.asarray(found - self.state.cells.structure_tensor())

    def _largest(self, change: Array) -> float:
        """Over r0^2, of all points."""
        r0 = assembly.point_values(self.stepper.tissue.end_to_end_length, self.quadrature)
        return self.quadrature.maximum(np.linalg.norm(change, axis=(-1, -2)) / r0**2)

    def _largest_jump(self) -> tuple[float, NDArray[np.float64]]:
        """Largest difference of A over r0^2 between a point and its nearest ones, and the middle of the two."""
        # Collective: a neighbour may belong to another rank.
        from scipy.spatial import cKDTree  # only runs that end in an equilibrium need it

        quadrature = self.quadrature
        r0 = assembly.point_values(self.stepper.tissue.end_to_end_length, quadrature)
        tensors = self.state.cells.structure_tensor() / r0[..., None, None] ** 2
        found = [quadrature.owned(values) for values in (quadrature.coordinates, tensors)]
        all_ranks = zip(*assembly.of_all_ranks(quadrature.mesh.comm, found), strict=True)
        places, structure = (
            np.concatenate([values.reshape(-1, size) for values in parts])
            for parts, size in zip(all_ranks, (3, 9), strict=True)
        )
        neighbours = min(1 + 2 * quadrature.mesh.topology.dim, len(places))
        _, near = cKDTree(places).query(places, np.arange(1, neighbours + 1))
        jumps = np.linalg.norm(structure[near] - structure[:, None], axis=-1)
        point, other = np.unravel_index(int(jumps.argmax()), jumps.shape)
        return float(jumps.max()), (places[point] + places[near[point, other]]) / 2

    def _say(self, level: int, text: str, *values: float) -> None:
        if self.state.comm.rank == 0:
            log.log(level, text, *values)

    def remodel(self, time: float) -> float:
        """Nothing is left to do but to say how far the state is from the cells of its own stress."""
        self.remodeling.look_ahead(time, self._residual)
        quadrature, r0 = self.quadrature, float(
            assembly.largest(self.stepper.tissue.end_to_end_length, self.quadrature.mesh)
        )
        left = self.remodeling.distance() / r0**2
        self._say(NOTICE, "cells and stress agree to |A_pass - A| = %.2g r0^2, after %d steps", left, self.steps)
        jump, place = self._largest_jump()
        if jump > FRONT:
            self._say(
                NOTICE,
                "the cells have a front near %.4g, %.4g, %.4g: the structure tensor A differs by %.2g r0^2 between "
                "neighbouring points. The front might rest at another place: its place depends on the path, and is as "
                "exact as time.tolerance and the mesh (docs/theory.md, Equilibrium at once)",
                *place,
                jump,
            )
        slack = self.remodeling.without_tension(self._residual).reshape(quadrature.shape)
        if share := quadrature.mean(slack.astype(float)):
            self._say(
                NOTICE,
                "%.3g %% of the body has no tension at rest, or hardly any beside compression. The cells there stay as "
                "the path has left them, and depend on it (docs/theory.md, Equilibrium at once)",
                100 * share,
            )
        return 0.0
