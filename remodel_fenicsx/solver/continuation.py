"""Continuation: a change in substeps, halved after a failure and doubled after a success."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import dolfinx.fem
import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from remodel_fenicsx.errors import RemodelError, SOLVE_FAILED
from remodel_fenicsx.fem.assembly import allreduce
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.chains import UflOrArray
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.model.tensors import Array
from remodel_fenicsx.schema.settings import Solver
from remodel_fenicsx.solver.equilibrium import Equilibrium, StateLimits
from remodel_fenicsx.solver.newton import (
    POSSIBLE_JUMP,
    SolverCounts,
    GuardedNewton,
    Solution,
    SolveFailure,
    attempted,
)
from remodel_fenicsx.solver.diagnosis import (
    BIFURCATION,
    LIMIT_POINT,
    SEVERAL_SOLUTIONS,
    FailureCause,
    diagnose_failure,
)
from remodel_fenicsx.state import State

log = logging.getLogger(__name__)

MAX_DISPLACEMENT_RATIO = 2.0
"""`Solution.displacement_ratio` above which a step is repeated in substeps. The paper's bodies have
at most 1.25. A tube without chains that approaches its largest pressure in one step has 2.9, a jump
over a limit point 3.9 and more."""
# A reach below CLOSE after more than MANY iterations (or tangents of a whole step) may be a jump.
# Chains near their contour length have a small reach too, but need at most 11 iterations.
CLOSE, MANY = 0.5, 12
# Difference of equal solutions, relative to their distance from the start. Other branches differ by
# much of it.
SAME_SOLUTION = 1e-4
# Ratio of the displacement to that of the substep before that may be a jump. Towards a limit point
# the last of equal substeps moves up to 3 times as far.
FASTER = 4.0
END_OF_PATH = (
    LIMIT_POINT.kind,
    BIFURCATION.kind,
)  # causes of failure for which no smaller step helps
MIN_HALVINGS_FOR_JUMP = (
    8  # number of halvings needed to distinguish a jump from a step that is too large
)
# Number of jumps in a run that are checked, each by about 25 solves. A body that collapses jumps in
# every step.
MOST_JUMPS = 3
# Numbers of the state: jumps in the run so far, and largest change of an unknown in the last step.
JUMPS_SO_FAR, LAST_CHANGE = "jumps_found", "jumps_moved"
KEPT_RESERVE = 0.2  # fraction of 1 - r/L that a remodeling substep leaves at every point


@dataclass
class Work(SolverCounts):
    """Solver work of one step, including failed attempts."""

    substeps: int = 0
    residual: float = 0.0  # of the last solution, in the unit of force
    # Of the last solution, if evaluated with the cells of the row.
    limits: StateLimits | None = None
    last: Solution | None = None

    def add(self, done: Solution | SolveFailure | Work) -> None:
        """Add the work of a solve, or of a rejected step."""
        self.count(done)
        if isinstance(done, Solution):
            self.residual, self.limits = done.residual, done.limits
            self.last = done


class StepFailure(RemodelError, RuntimeError):
    """Failure of a step, or an unstable equilibrium that stops the run.

    The state is that of the last accepted step.

    Parameters
    ----------
    time
        Time of the step.
    text
        One line: position in the step, and reason.
    refusal
        Cause of the failure, and advice.

    Attributes
    ----------
    time
        Time of the step.
    refusal
        Cause of the failure, and advice.
    kept
        One clause on the saved part of the run.

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

    def __init__(self, time: float, text: str, refusal: FailureCause):
        super().__init__(text)
        self.time, self.refusal = time, refusal
        self.kept = "every finished step is kept"

    def in_words(self) -> str:
        """Return position, reason, advice, and the saved part of the run.

        Returns
        -------
        str
            One line.
        """
        return f"{self}. {self.refusal}; {self.kept}"


def failure_text(time: float, stage: str, fraction: float, cause: SolveFailure) -> str:
    """Return the message of a change that stops at a fraction of the step, with its cause."""
    point = ", ".join(f"{c:.3f}" for c in cause.limits.worst_point)
    return (
        f"no equilibrium at time {time:g}: {stage} failed at {100 * fraction:.3g} % of the step "
        f"({cause.reason}; largest r/L = {cause.limits.max_chain_extension:.4f} at ({point}), "
        f"smallest J = {cause.limits.min_jacobian:.4g})"
    )


@dataclass
class Continuation:
    """Change of cells or loads that can be applied in substeps."""

    time: float
    stage: str
    set_fraction: Callable[[float], None]
    state: State
    solves: Callable[[], GuardedNewton]  # called for substeps only, which few steps need
    maximum_halvings: int
    largest_increment: Callable[[float], float] = lambda done: 1.0
    loose_tolerance: bool = False
    refusal: FailureCause | None = field(default=None, init=False)  # cause of a jump in the change
    # Rate of the unknowns in the last substep.
    _direction: Array | None = field(default=None, init=False)

    @functools.cached_property
    def newton(self) -> GuardedNewton:
        """Newton's method of the substeps."""
        return self.solves()

    def advance(self, work: Work, failure: SolveFailure | None = None, part: float = 1.0) -> None:
        """Apply the change in substeps, from 0 to 1."""
        # A substep that ends far from the prediction of its tangent is halved like one that fails.
        # The branch ends there if it is the smallest one. Then a warning is logged, and the change
        # continues beyond the jump.
        done, attempts = 0.0, 0
        if failure is not None:
            part = self._bisect(part, done, failure)
        vector = self.state.unknown.x
        while done < 1.0:
            attempts += 1
            self.state.tell(
                f"step to t = {self.time:g}: at {100 * done:.3g} % of {self.stage}, "
                f"attempt {attempts}: a substep of {100 * part:.2g} %"
            )
            before = vector.array.copy()
            part = min(part, 1.0 - done, self.largest_increment(done))
            is_last = done + part > 1.0 - 1e-12
            self.set_fraction(1.0 if is_last else done + part)
            solution = attempted(
                partial(self.newton.solve, before, self.loose_tolerance and not is_last),
                SolveFailure,
            )
            work.add(solution)
            if isinstance(solution, SolveFailure):
                vector.array[:] = before
                part = self._bisect(part, done, solution)
            else:
                expected = 0.0 if self._direction is None else part * self._size(self._direction)
                moved = self._size(vector.array - before)
                if self.is_another_branch(solution, moved, expected) and self._may_check_jumps():
                    solved = vector.array.copy()
                    vector.array[:] = before
                    if part / 2 >= self._smallest:
                        log.debug(
                            "%s: far from the last substep, %.3g of the first Newton step",
                            self.stage,
                            solution.displacement_ratio,
                        )
                        part /= 2
                        continue
                    self.set_fraction(done)
                    refusal = diagnose_failure(self.newton, None, self._direction)
                    self._warn_of_jump(solved, refusal if refusal.kind else SEVERAL_SOLUTIONS)
                    self.set_fraction(1.0 if is_last else done + part)
                    vector.array[:] = solved
                done = 1.0 if is_last else done + part
                self._direction = (vector.array - before) / part
                part *= 2
                work.substeps += 1

    def check_for_jump(self, before: Array, work: Work, again: bool) -> None:
        """Repeat a step in substeps if it may have jumped. Collective."""
        # `again`: the same step was solved before, with other cells.
        vector, last = self.state.unknown.x, self.state.numbers.get(LAST_CHANGE, 0.0)
        moved = self._size(vector.array - before)
        tangents, expected = work.tangents if work.substeps == 1 else 0, 0.0 if again else last
        if self.is_another_branch(work.last, moved, expected, tangents) and self._may_check_jumps():
            self.repeat_in_substeps(before, work)
            moved = self._size(vector.array - before)
        self.state.numbers[LAST_CHANGE] = max(moved, last) if again else moved

    def repeat_in_substeps(self, before: Array, work: Work) -> None:
        """Repeat a step in substeps from the unknowns before it. Collective."""
        # The solution stays if the substeps fail, with a warning if the branch ends there. If they
        # lead to another solution, that one is used, because the body reaches it.
        vector = self.state.unknown.x
        unknown = vector.array
        solution, parts = unknown.copy(), Work()
        unknown[:] = before
        failure = attempted(lambda: self.advance(parts, part=0.5), StepFailure)
        leads_on = failure is None and self.refusal is None
        if failure is not None:
            if self.refusal is None and failure.refusal.kind in END_OF_PATH:
                self._warn_of_jump(solution, failure.refusal)
            log.info(
                "time %g: the solution is far from the tangent's prediction; it stays, because "
                "repeating the step in substeps failed: %s",
                self.time,
                failure,
            )
        work.count(parts)
        if leads_on and self._size(unknown - solution) > SAME_SOLUTION * self._size(
            solution - before
        ):
            log.info(
                "time %g: several solutions exist; using the one reached by substeps", self.time
            )
            work.residual, work.limits = parts.residual, parts.limits
            work.substeps = parts.substeps
            return
        unknown[:] = solution
        self.set_fraction(1.0)

    @property
    def _smallest(self) -> float:
        return 2.0**-self.maximum_halvings

    def is_another_branch(
        self, solution: Solution | None, moved: float, expected: float, tangents: int = 0
    ) -> bool:
        """Return whether a solve may have jumped: far from its tangent, slow, or too far."""
        # `expected`: distance predicted by the last substep, 0 if unknown; `tangents`: number of a
        # whole step.
        domain = self.state.loading.domain
        least = POSSIBLE_JUMP * domain.size
        if tangents > MANY or 0.0 < expected < moved / FASTER and moved > least:
            return True
        if solution is None:
            return False
        return solution.displacement_ratio > MAX_DISPLACEMENT_RATIO or (
            0.0 < solution.displacement_ratio < CLOSE and solution.newton_iterations > MANY
        )

    def _size(self, change: Array) -> float:
        """Return the largest change of an unknown over all ranks. Collective."""
        return allreduce(self.state.comm, float(np.abs(change).max(initial=0.0)), MPI.MAX)

    def _may_check_jumps(self) -> bool:
        """Return whether a possible jump is checked."""
        enough = self.maximum_halvings >= MIN_HALVINGS_FOR_JUMP
        jumps = self.state.numbers.get(JUMPS_SO_FAR, 0.0)
        return enough and self.refusal is None and jumps < MOST_JUMPS

    def _warn_of_jump(self, solved: Array, refusal: FailureCause) -> None:
        """Warn of a jump from the end of a branch, the present state, to `solved`. Collective."""
        self.refusal = refusal
        state, vector = self.state, self.state.unknown.x
        state.numbers[JUMPS_SO_FAR] = state.numbers.get(JUMPS_SO_FAR, 0.0) + 1.0
        far = self._size(solved - vector.array)
        if state.comm.rank == 0:
            loads = ", ".join(
                f"{name} {value:.4g}" for name, value in state.loading.values.items() if value
            )
            log.warning(
                "time %g: jump to another solution branch (largest displacement change %.3g). "
                "The previous branch ends at %s (%s)",
                self.time, far, loads or "the start", refusal,
            )  # fmt: skip

    def _bisect(self, part: float, done: float, failure: SolveFailure) -> float:
        if part / 2 < self._smallest:
            text = self.state.label + failure_text(self.time, self.stage, done, failure)
            self.set_fraction(done)  # the last solved state
            cause = diagnose_failure(self.newton, failure, self._direction)
            refusal = cause if cause.kind or self.refusal is None else self.refusal
            raise StepFailure(self.time, text, refusal) from failure
        log.debug("%s: %s; next substep %g", self.stage, failure.reason, part / 2)
        return part / 2


class CellHomotopy:
    """Equilibrium with (1 - theta) old + theta new cells in r^2 and in W_rep."""

    # At theta = 0 and 1 it is the model with the old and with the new cells. Few runs need it, and
    # its kernels take as long to compile as those of the run itself. So it is compiled on first
    # access.

    def __init__(self, state: State, tissue: Tissue, settings: Solver):
        self.state, self.tissue = state, tissue
        self.settings = settings
        self.theta = dolfinx.fem.Constant(state.cells.quadrature.mesh, PETSc.ScalarType(0.0))

    @functools.cached_property
    def equilibrium(self) -> Equilibrium:
        """Equilibrium of the mixed cells, compiled on first access."""
        old, new = self.state.equilibrium_cells, self.state.cells

        def at_points() -> list[UnitCell]:
            return shares(old.point_cells, new.point_cells, float(np.real(self.theta.value)))

        return Equilibrium(
            self.state,
            self.tissue,
            shares(old.symbolic_cell, new.symbolic_cell, self.theta),
            at_points,
        )

    @functools.cached_property
    def newton(self) -> GuardedNewton:
        """Newton's method for the mixed cells."""
        return GuardedNewton(self.equilibrium, self.settings, robust=True)

    def close(self) -> None:
        """Free the objects of PETSc."""
        if "newton" in vars(self):
            vars(self).pop("newton").close()

    def set(self, fraction: float) -> None:
        """Set theta to this fraction."""
        self.theta.value = fraction

    def largest_increment(self, done: float) -> float:
        """Return the largest increment of theta that keeps KEPT_RESERVE of 1 - r/L everywhere."""
        # r^2 is linear in theta at a frozen deformation, so the bound is in closed form.
        equilibrium, quadrature = self.equilibrium, self.equilibrium.quadrature
        length = quadrature.owned(equilibrium.parameters.locking_length())
        self.theta.value = done
        now = quadrature.owned(equilibrium.squared_lengths())
        self.theta.value = 1.0
        end = quadrature.owned(equilibrium.squared_lengths())
        # Infinite without locking.
        allowed = ((1 - KEPT_RESERVE) * length + KEPT_RESERVE * np.sqrt(now)) ** 2
        increase = end - now
        room = np.where(
            increase > 0, (allowed - now) / np.where(increase > 0, increase, 1.0), np.inf
        )
        return (1.0 - done) * quadrature.minimum(room)


def shares(old: UnitCell, new: UnitCell, theta: UflOrArray) -> list[UnitCell]:
    """Return an old cell with weight 1 - theta and a new one with theta, UFL or arrays."""
    return [UnitCell(*old[:2], 1 - theta), UnitCell(*new[:2], theta)]
