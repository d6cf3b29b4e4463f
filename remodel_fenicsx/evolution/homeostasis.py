"""The homeostatic state: the cells to which remodeling tends under the loads at the end.

Laws with a limit reach a state in which the cells are those of their own stress: l = r0 e with n its axes, or
A = r0^2 E. A body may have several such states, and a point without tension keeps its cells: the path decides. So the
path is followed in chosen steps, which grow under constant loads, until the cells hardly change; the tail of their
exponential decay is extrapolated (docs/theory.md, "Equilibrium at once").
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.body.loading import LoadValues
from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.evolution.time_steps import StepControl
from remodel_fenicsx.fem import assembly
from remodel_fenicsx.solver.attempts import attempted
from remodel_fenicsx.solver.continuation import StepFailure, Work
from remodel_fenicsx.state import Snapshot
from remodel_fenicsx.system import NOTICE

log = logging.getLogger(__name__)
Array = NDArray[np.float64]

PATH_TOLERANCE, UNLOADING = 3.0, 0.5
"""Of the steps on the way, in degrees, where a scene has no time.tolerance: in all, and where loads fall or reverse.
There points lose their tension, and their cells stay as exact as the way. The paper's artery takes 25 solves."""
UNCHECKED = 90.0  # degrees: more than any step's error, where it leaves nothing
LONGEST = 1.0  # step on the way, times kappa: longer ones leave too few looks at cells that come to rest slowly
LENGTHENING_OF_STEPS, LONGEST_AT_END = 1.5, 8.0
"""Under constant loads each step may be longer by this factor while changes fall, up to so many times 1/kappa: then a
step is a pass to the limit but for 0.03 %."""
FRONT = 1.2
"""Difference of A over r0^2 between neighbouring points from which on a front lies between them: chains of one
direction that turn by 58 degrees. The paper's artery has 0.67 at most, tubes with a front had 1.35 to 1.41."""
REST = 1e-4
"""Change of A over r0^2 in a time of 1/kappa at which the path ends. The slowest bodies seen forget at a twentieth of
kappa: what is left is 0.002, a tenth of a degree, before the tail."""
LONGEST_HOLD = 100.0  # times 1/kappa under held loads after which cells that do not rest are left
NEAR_REST, AGAIN = 0.01, 0.5  # change of A over r0^2 from which on the tail is tried, and how much nearer the next time
TAIL_PASSES, TAIL = 15, 1e-9  # passes to the limit after the path, at most, and the change over r0^2 that ends them
LARGEST_RATIO = 0.95  # of two changes, for Aitken's extrapolation: it then goes 20 times as far as the last change


class PathToRest(NamedTuple):
    """Hold what is known of the path: end, stops, first step, and tolerance in degrees.

    `held_from`: time from which all loads are held. `before_change`: hold of the loads in which all rests once before,
    from and to.
    """

    end: float
    stops: Sequence[float]
    first: float
    tolerance: float
    held_from: float
    before_change: tuple[float, float] | None = None


class Homeostasis:
    """The way through ramps and held loads until the cells rest, as one step of a stepper."""

    def __init__(self, stepper: Stepper, plan: PathToRest):
        self.stepper, self.state, self.plan = stepper, stepper.state, plan
        self.remodeling = stepper.remodeling
        self.remodels = [part for part in stepper.remodels if part.components]
        self.quadrature = self.state.cells.quadrature
        # no row of the way is a result; of points that turn over at once fronts tell
        self.control = StepControl(stepper, plan.tolerance, plan.first, plan.stops, LONGEST, logging.INFO)
        self.steps, self._residual = 0, 0.0
        self._held: Snapshot | None = None  # the first state on the way under held loads

    def remaining(self) -> list[float]:
        """Return the time of the steady state, unless it is reached."""
        return [self.plan.end] if self.state.time < self.plan.end else []

    def march(self, watchers: Sequence[Watcher] = ()) -> Iterator[Step]:
        """Yield the steady state as one committed step."""
        self.stepper.start(watchers)
        for time in self.remaining():
            yield self.stepper.advance(time, watchers, is_last=True, way=self)

    def solve(self, time: float, loads: LoadValues) -> Work:
        """Equilibrium of forces and of cells."""
        state, work = self.state, Work()
        start, number, self.steps, self._held = state.time, state.number, 0, None
        remembers = any(part.depends_on_path for part in self.remodels)
        coarsens = not (self.stepper.coupling.traits.accumulates or self.plan.tolerance >= UNCHECKED or remembers)
        if self.plan.before_change is not None:
            self._rest_before(*self.plan.before_change, work)
        held = max(start, self.plan.held_from)
        self._go(self.control, time, loads, held, coarsens, work)
        if coarsens and self._held is not None and self._largest_jump()[0] > FRONT:
            log.info(
                "the cells have a front, whose place depends on the path: the path is followed again with the tolerance"
            )
            state.restore(self._held)
            self._go(self.control, time, loads, held, False, work)
        state.reach(start, number)
        for case in state.each_case().values():
            case.settle_cells()
        self._residual = work.residual
        return work

    def _rest_before(self, held: float, change: float, work: Work) -> None:
        """Wait under constant loads for the steady state; then begins what waits for it."""
        stops = [*(stop for stop in self.plan.stops if stop <= held), self.plan.stops[-1]]
        control = self.control.with_stops(stops)
        with self.stepper.holding(held):
            self._go(control, stops[-1], self.stepper.load_values(held), held, False, work)
        self.state.settle_cells()
        log.info("all rests after %d steps, before time %g", self.steps, change)
        for part in self.remodels:
            part.rested(change)
        self.state.reach(change, self.state.number)

    def _go(
        self, control: StepControl, time: float, loads: LoadValues, held: float, coarsens: bool, work: Work
    ) -> None:
        """From where the state is until the cells rest."""
        # The error of a row that lags leaves nothing once the cells rest, unless they come to rest elsewhere. Where
        # collagen comes to rest depends on the way.
        state, before, waiting, near, longest = self.state, np.inf, 0.0, NEAR_REST, LONGEST
        for part in self.remodels:
            part.begin_path()
        control.limit(self.plan.tolerance, longest)
        start = held
        for step in control.march():
            self.steps += 1
            work.add(step.work)
            work.substeps += step.work.substeps
            work.residual = step.work.residual
            log.info("on the path: time %g, %d Newton iterations", step.time, step.work.newton_iterations)
            if state.time < held:
                continue
            if coarsens:
                control.limit(UNCHECKED, longest)
            ahead, solved = state.snapshot(), state.equilibrium_cells
            self._held = self._held or ahead
            state.cells.set(solved.dimension_values, solved.axis_values)  # those that the stress belongs to
            left, residual = self._left(work.residual), work.residual
            waiting += min(1.0, self.stepper.slowest * (state.time - start))  # a long step forgets as much as one
            start = state.time
            is_over = self._is_over(left, waiting)
            if (is_over or left <= near) and (self._add_tail(time, loads, work) or is_over):
                return
            work.residual, near = residual, min(near, AGAIN * left)
            state.restore(ahead)
            if coarsens:
                longer = min(LENGTHENING_OF_STEPS * longest, LONGEST_AT_END)
                longest, before = longer if left < before else LONGEST, left
                control.limit(UNCHECKED, longest)

    def _left(self, residual: float) -> float:
        """Return the largest relative change in a time of 1/kappa."""
        soon = self.state.time + 1 / self.stepper.slowest
        return max(part.left(soon, residual) for part in self.remodels)

    def _is_over(self, left: float, waiting: float) -> bool:
        """Whether the path ends: the cells hardly change, or do not come to rest."""
        if left <= REST:
            return True
        if without := [text for part in self.remodels if (text := part.without_rest(waiting))]:
            self._say(logging.WARNING, without[0])
            return True
        if waiting > LONGEST_HOLD:
            text = "the cells do not come to rest: in a time of 1/kappa the state still changes by %.2g of its size"
            self._say(logging.WARNING, text, left)
        return waiting > LONGEST_HOLD

    # ------------------------------------------------------------ the tail of the decay
    def _add_tail(self, time: float, loads: LoadValues, work: Work) -> bool:
        """Extrapolate what is left of the path; return whether nothing is left.

        Passes to the limit with Aitken's factor, each in equilibrium, while the change that they make falls.
        """
        state, factor = self.state, 1.0
        coupling = self.stepper.coupling
        changes = self._to_the_limit(time, work.residual)
        for _ in range(TAIL_PASSES):
            left = self._size(changes)
            if left <= TAIL:
                return True
            before, residual = state.snapshot(), work.residual
            for part, change in zip(self.remodels, changes, strict=True):
                part.follow(change, factor, time, residual)
            soon = state.time + 1 / self.stepper.slowest
            balanced = partial(coupling.balanced, soon, loads, again=True)  # type: ignore[attr-defined]
            found = attempted(balanced, StepFailure)
            if isinstance(found, StepFailure):
                log.info("the tail of the path is not extrapolated further: %s", found)
                state.restore(before)
                return False
            work.add(found)
            work.substeps, self.steps = work.substeps + found.substeps, self.steps + 1
            earlier, changes = changes, self._to_the_limit(time, found.residual)
            if self._size(changes) >= left:
                state.restore(before)
                work.residual = residual
                return False
            work.residual = found.residual
            # a change d that falls to s d when d/(1 - s_0) was added leaves s d/(1 - s): s of the last factor
            pairs = zip(earlier, changes, strict=True)
            ratios = [self._dot(one, other) / square for one, other in pairs if (square := self._dot(one, one))]
            ratio = 1 - (1 - max(ratios)) / factor
            factor = 1 / (1 - min(max(ratio, -1.0), LARGEST_RATIO))
        return False

    def _to_the_limit(self, time: float, residual: float) -> list[Array]:
        """Return the changes of all that remodels to its limits."""
        return [part.to_the_limit(time, 1 / self.stepper.slowest, residual) for part in self.remodels]

    def _size(self, changes: Sequence[Array]) -> float:
        """The largest relative change."""
        return max(part.size(change) for part, change in zip(self.remodels, changes, strict=True))

    def _dot(self, one: Array, other: Array) -> float:
        """Sum of products over all ranks."""
        return float(self.state.comm.allreduce(float(self.quadrature.owned(one * other).sum())))

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
        quadrature, r0 = self.quadrature, self.remodeling.parameters.largest().end_to_end_length
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
