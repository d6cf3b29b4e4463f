"""A change in as many parts as Newton's method needs: half the part after a failure, twice after a success."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import dolfinx.fem
import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from remodel_fenicsx.errors import RemodelError, SOLVE_FAILED
from remodel_fenicsx.fem.assembly import over_ranks
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.chains import UflOrArray
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.schema.settings import Solver
from remodel_fenicsx.solver.attempts import attempted
from remodel_fenicsx.solver.equilibrium import Equilibrium, Extension
from remodel_fenicsx.solver.newton import POSSIBLE_JUMP, Counted, GuardedNewton, Solution, SolveFailure
from remodel_fenicsx.solver.diagnosis import BIFURCATION, LIMIT_POINT, SEVERAL_SOLUTIONS, Refusal, diagnosed
from remodel_fenicsx.state import Numbers, State

log = logging.getLogger(__name__)

FAR = 2.0
"""`Solution.reach` from which on a way is looked at again in parts. The paper's bodies have at most 1.25, a tube
without chains that comes near its largest pressure in one step 2.9, a jump over a limit point 3.9 and more."""
# Iterations, or tangents of a whole step: chains near their contour length make ends nearer too, but within 11
CLOSE, MANY = 0.5, 12
SAME_SOLUTION = (
    1e-4  # of the way to them: by what two solutions may differ that are one; of other branches it is a good part
)
FASTER = 4.0  # than the part before: a way that comes to a limit point is up to 3 times as fast in its last equal part
WAYS_END = (LIMIT_POINT.kind, BIFURCATION.kind)  # refusals for which no smaller step helps
PROOF = 8  # halvings without which a jump is not told from a step that is only too large
MOST_JUMPS = 3  # that are looked into in a run, each by some 25 solves: a body that falls apart jumps in every step
KEPT_RESERVE = 0.2  # share of 1 - r/L that a part of a remodeling increment leaves at every point


@dataclass
class Work(Counted):
    """Solver work of one step, failed attempts included."""

    substeps: int = 0
    residual: float = 0.0  # of the last solution, in the unit of force
    extension: Extension | None = None  # of the last solution, where it was looked at with the cells of the row
    last: Solution | None = None

    def add(self, done: Solution | SolveFailure | Work) -> None:
        """Count a solve, or the work of a step that was taken back."""
        self.count(done)
        if isinstance(done, Solution):
            self.residual, self.extension, self.last = done.residual, done.extension, done


class StepFailure(RemodelError, RuntimeError):
    """A step cannot be solved, or is not wanted; the state is that of the last accepted step.

    Parameters
    ----------
    time
        Of the step.
    text
        One line: where it stops, and why.
    refusal
        What kind of refusal it is, and what helps.

    Attributes
    ----------
    time
        Of the step.
    refusal
        Why, and what helps.
    kept
        What of the run is on the disk.

    Examples
    --------
    A large force in few steps, with too few iterations of Newton's method:

    >>> from remodel_fenicsx import Simulation, parts, preset_scene
    >>> scene = preset_scene("kuhl-holzapfel-2007", "cube").with_values({
    ...     "loads.force.value": 1e6, "solver.maximum_iterations": 2, "solver.maximum_halvings": 0})
    >>> try:
    ...     for step in Simulation(scene).steps():
    ...         pass
    ... except parts.StepFailure as failure:
    ...     print(str(failure).split(":")[0])
    ...     print(failure.refusal)
    no equilibrium at time 1
    try a smaller time.step, a slower ramp or lower loads
    """

    exit_code = SOLVE_FAILED

    def __init__(self, time: float, text: str, refusal: Refusal):
        super().__init__(text)
        self.time, self.refusal, self.kept = time, refusal, "every finished step is kept"

    def in_words(self) -> str:
        """Where it stops and why, what helps, and what is kept.

        Returns
        -------
        str
            One line.
        """
        return f"{self}. {self.refusal}; {self.kept}"


def failure_text(time: float, stage: str, fraction: float, cause: SolveFailure) -> str:
    """Where a change of the problem has stopped, and why."""
    point = ", ".join(f"{c:.3f}" for c in cause.extension.worst_point)
    return (
        f"no equilibrium at time {time:g}: {stage} stops at {100 * fraction:.3g} % of the step ({cause.reason}; "
        f"largest r/L = {cause.extension.max_chain_extension:.4f} at ({point}), "
        f"smallest J = {cause.extension.min_jacobian:.4g})"
    )


@dataclass
class Change:
    """A change of the problem that can be applied in parts."""

    time: float
    stage: str
    set_fraction: Callable[[float], None]
    state: State
    solves: Callable[[], GuardedNewton]  # asked for when parts are solved: few steps have any
    maximum_halvings: int
    largest_part: Callable[[float], float] = lambda done: 1.0
    roughly: bool = False
    refusal: Refusal | None = field(default=None, init=False)  # what there was no way past but by a jump
    _direction: NDArray[np.float64] | None = field(default=None, init=False)  # of the unknowns over the last part

    @functools.cached_property
    def newton(self) -> GuardedNewton:
        """Who solves the parts."""
        return self.solves()

    def advance(self, work: Work, failure: SolveFailure | None = None, part: float = 1.0) -> None:
        """Go from 0 to 1."""
        # A part that ends far from where its tangent points to is halved like one that fails. If it is the smallest,
        # the way ends here: this is said, and the change goes on beyond the jump.
        done, attempts = 0.0, 0
        if failure is not None:
            part = self._halved(part, done, failure, work)
        while done < 1.0:
            attempts += 1
            self.state.tell(
                f"t = {self.time:g}, {100 * done:.3g} % of {self.stage}, attempt {attempts}: {100 * part:.2g} %"
            )
            before = self.state.unknown.x.array.copy()
            part = min(part, 1.0 - done, self.largest_part(done))
            is_last = done + part > 1.0 - 1e-12
            self.set_fraction(1.0 if is_last else done + part)
            solution = attempted(partial(self.newton.solve, before, self.roughly and not is_last), SolveFailure)
            work.add(solution)
            if isinstance(solution, SolveFailure):
                self.state.unknown.x.array[:] = before
                part = self._halved(part, done, solution, work)
            else:
                expected = 0.0 if self._direction is None else part * self._size(self._direction)
                moved = self._size(self.state.unknown.x.array - before)
                if self.is_another_branch(solution, moved, expected) and self._looks():
                    solved, self.state.unknown.x.array[:] = self.state.unknown.x.array.copy(), before
                    if part / 2 >= self._smallest:
                        log.debug(
                            "%s: far from the last part, %.3g of the first Newton step", self.stage, solution.reach
                        )
                        part /= 2
                        continue
                    self.set_fraction(done)
                    refusal = diagnosed(self.newton, None, self._direction)
                    self._jumped(solved, refusal if refusal.kind else SEVERAL_SOLUTIONS)
                    self.set_fraction(1.0 if is_last else done + part)
                    self.state.unknown.x.array[:] = solved
                done = 1.0 if is_last else done + part
                self._direction = (self.state.unknown.x.array - before) / part
                part *= 2
                work.substeps += 1

    def look_back(self, before: NDArray[np.float64], work: Work, again: bool) -> bool:
        """After a step: look into one that has ended far from its tangent or from the step before."""
        # `again`: it was solved once more, with other cells; that is no step of its own
        unknown, jumps = self.state.unknown.x.array, self._jumps
        moved, last = self._size(unknown - before), jumps["moved"]
        tangents, expected = work.tangents if work.substeps == 1 else 0, 0.0 if again else last
        looked = self.is_another_branch(work.last, moved, expected, tangents) and self._looks()
        if looked:
            self.confirm(before, work)
            moved = self._size(unknown - before)
        jumps["moved"] = max(moved, last) if again else moved
        return looked

    def confirm(self, before: NDArray[np.float64], work: Work) -> None:
        """Go the way again in parts, from the unknowns before it, where the whole was solved far from its tangent."""
        # Where there is no such way, the solution stays, and a warning says so. Where it leads to another solution,
        # this one is taken: the body comes to it.
        unknown = self.state.unknown.x.array
        found, parts = unknown.copy(), Work()
        unknown[:] = before
        failure = attempted(lambda: self.advance(parts, part=0.5), StepFailure)
        leads_on = failure is None and self.refusal is None
        if failure is not None:
            if self.refusal is None and failure.refusal.kind in WAYS_END:
                self._jumped(found, failure.refusal)
            log.info(
                "time %g: the solution is far from what the tangent predicts, and parts of the step fail: %s",
                self.time,
                failure,
            )
        work.count(parts)
        if leads_on and self._size(unknown - found) > SAME_SOLUTION * self._size(found - before):
            log.info("time %g: there are several solutions; parts of the step lead to the one that is taken", self.time)
            work.residual, work.extension, work.substeps = parts.residual, parts.extension, parts.substeps
            return
        unknown[:] = found
        self.set_fraction(1.0)

    @property
    def _smallest(self) -> float:
        return 2.0**-self.maximum_halvings

    def is_another_branch(self, solution: Solution | None, moved: float, expected: float, tangents: int = 0) -> bool:
        """Whether a solve may have ended there: far from its tangent, late, or much further than was expected."""
        # `expected`: what the way before lets expect, 0 where there is none; `tangents`: of a whole step
        least = POSSIBLE_JUMP * self.state.loading.domain.size
        if tangents > MANY or 0.0 < expected < moved / FASTER and moved > least:
            return True
        if solution is None:
            return False
        return solution.reach > FAR or (0.0 < solution.reach < CLOSE and solution.newton_iterations > MANY)

    def _size(self, change: NDArray[np.float64]) -> float:
        """Largest change of an unknown, over all ranks."""
        return float(over_ranks(self.state.comm, float(np.abs(change).max(initial=0.0)), MPI.MAX))

    def _looks(self) -> bool:
        """Whether a part that has ended far away is looked into."""
        enough = self.maximum_halvings >= PROOF
        return enough and self.refusal is None and self._jumps["found"] < MOST_JUMPS

    @property
    def _jumps(self) -> Numbers:
        return Numbers(self.state, "jumps", {"found": 0, "moved": 0})

    def _jumped(self, solved: NDArray[np.float64], refusal: Refusal) -> None:
        """Say that there is no way to what was solved; unknowns and loads are those where the way ends."""
        self.refusal = refusal
        self._jumps["found"] += 1
        state, far = self.state, self._size(solved - self.state.unknown.x.array)
        if state.comm.rank == 0:
            loads = ", ".join(f"{name} {value:.4g}" for name, value in state.loading.values.items() if value)
            log.warning(
                "time %g: the body jumps by %.3g to another solution: the path of the last one ends at %s. %s; a "
                "smaller time.step shows that path", self.time, far, loads or "the start", refusal,
            )  # fmt: skip

    def _halved(self, part: float, done: float, failure: SolveFailure, work: Work) -> float:
        if part / 2 < self._smallest:
            text = self.state.label + failure_text(self.time, self.stage, done, failure)
            self.set_fraction(done)  # the last state that was solved
            found = diagnosed(self.newton, failure, self._direction)
            refusal = found if found.kind or self.refusal is None else self.refusal
            raise StepFailure(self.time, text, refusal) from failure
        log.debug("%s: %s; next part %g", self.stage, failure.reason, part / 2)
        return part / 2


class Blend:
    """Equilibrium with (1 - theta) old + theta new cells in r^2 and in W_rep: the old and the new model at the ends.

    Few runs have a step that needs it, and its kernels take as long to compile as those of the run itself: it is made
    when it is asked for.
    """

    def __init__(self, state: State, tissue: Tissue, settings: Solver):
        self.state, self.tissue, self.settings = state, tissue, settings
        self.theta = dolfinx.fem.Constant(state.cells.quadrature.mesh, PETSc.ScalarType(0.0))

    @functools.cached_property
    def equilibrium(self) -> Equilibrium:
        """Compiled."""
        old, new = self.state.equilibrium_cells, self.state.cells

        def at_points() -> list[UnitCell]:
            return shares(old.point_cells, new.point_cells, float(np.real(self.theta.value)))

        return Equilibrium(self.state, self.tissue, shares(old.ufl_cell, new.ufl_cell, self.theta), at_points)

    @functools.cached_property
    def newton(self) -> GuardedNewton:
        """The solver."""
        return GuardedNewton(self.equilibrium, self.settings, robust=True)

    def close(self) -> None:
        """Free PETSc's objects."""
        if "newton" in vars(self):
            vars(self).pop("newton").close()

    def set(self, fraction: float) -> None:
        """theta."""
        self.theta.value = fraction

    def largest_part(self, done: float) -> float:
        """Largest further part of theta that keeps KEPT_RESERVE of 1 - r/L at every point of the present unknowns."""
        # r^2 is linear in theta at a frozen deformation, so the bound is in closed form.
        equilibrium, quadrature = self.equilibrium, self.equilibrium.quadrature
        length = quadrature.owned(equilibrium.locking_length())
        self.theta.value = done
        now = quadrature.owned(equilibrium.squared_lengths())
        self.theta.value = 1.0
        end = quadrature.owned(equilibrium.squared_lengths())
        allowed = ((1 - KEPT_RESERVE) * length + KEPT_RESERVE * np.sqrt(now)) ** 2  # infinite where nothing locks
        increase = end - now
        room = np.where(increase > 0, (allowed - now) / np.where(increase > 0, increase, 1.0), np.inf)
        return (1.0 - done) * quadrature.minimum(room)


def shares(old: UnitCell, new: UnitCell, theta: UflOrArray) -> list[UnitCell]:
    """(1 - theta) of an old cell and theta of a new one, UFL or arrays."""
    return [UnitCell(*old[:2], 1 - theta), UnitCell(*new[:2], theta)]
