"""How equilibrium and remodeling of one step are coupled: strategies over the same state."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.body.loading import LoadValues
from remodel_fenicsx.evolution.remodeling import RemodelingPass
from remodel_fenicsx.fem.assembly import over_ranks
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.model.tensor_law import Target, weight_of_the_end
from remodel_fenicsx.schema.settings import Solver
from remodel_fenicsx.solver.attempts import FROM_EXPECTED, FROM_LAST, Attempt, attempted, say
from remodel_fenicsx.solver.continuation import Blend, Change, Work
from remodel_fenicsx.solver.equilibrium import Equilibrium
from remodel_fenicsx.solver.newton import GuardedNewton, SolveFailure
from remodel_fenicsx.state import Earlier, Numbers, State

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
log = logging.getLogger(__name__)

TARGET = np.dtype([("direction", float, (3, 3)), ("switch", float), ("time", float)])  # what is kept of one
NEVER = -1.0  # time of a target that there has not been
COUNTS = 0.01  # share of a target from which on it is one: what is less moves the cells less than a step is off
ORDER, FITTED = 3, 2  # increments that predict the next one; increments to which the weights are fitted
SAME_RATE = 1e-9  # relative difference of two rates of a load that are the same
INDEPENDENT = 1e-12  # of increments: what is less is rounding


# ---------------------------------------------------------------- where Newton's method starts a step


class LoadStep(NamedTuple):
    """A step as it is asked for: its length, and the rates of the loads over it."""

    duration: float
    rates: dict[str, float]

    @classmethod
    def between(cls, duration: float, old: Mapping[str, float], new: Mapping[str, float]) -> LoadStep:
        """From the loads at its start and its end."""
        return cls(duration, {name: (new.get(name, old[name]) - old[name]) / duration for name in old})


class Predictor:
    """Expects the increment of a step by those of the last ones, d_n = sum_j a_j d_(n-j), while load rates stay."""

    def __init__(self, state: State):
        self.state = state
        # increments over the lengths of their steps: steps of any length take part
        self._speeds = Earlier(state, "predictor_speed", state.unknown.copy, ORDER + FITTED)
        self._numbers = Numbers(state, "predictor", {f"rate_{name}": 0.0 for name in state.loading.values})

    def expected(self, step: LoadStep) -> Array | None:
        """The unknowns at its end, ghosts included, with what supports and loads prescribe; None at first."""
        speeds = self._speeds.values
        if not speeds or not self._goes_on(step):
            return None
        speed = speeds[0]
        if len(speeds) == ORDER + FITTED:
            speed = self._weights(speeds) @ np.array(speeds[:ORDER])
        values: Array = self.state.unknown.x.array + step.duration * speed
        for condition in self.state.loading.boundary_conditions:
            condition.set(values)
        return values

    def solved(self, step: LoadStep, before: Array, again: bool = False) -> None:
        """The state is the solution of the step; `before`: the unknowns of the step before, or of its first solve."""
        speed = np.asarray((self.state.unknown.x.array - before) / step.duration, dtype=np.float64)
        if again:
            self._speeds.values[0][:] += speed
            return
        if not self._goes_on(step):
            self._speeds.forget()
        self._speeds.push(speed)
        for name, rate in step.rates.items():
            self._numbers[f"rate_{name}"] = rate

    def _goes_on(self, step: LoadStep) -> bool:
        """Whether the rates are those of the last step."""
        rates = [(rate, self._numbers[f"rate_{name}"]) for name, rate in step.rates.items()]
        return all([abs(rate - last) <= SAME_RATE * max(abs(rate), abs(last)) for rate, last in rates])

    def _weights(self, speeds: list[Array]) -> Array:
        """Fit the newest increments by those before them, in the sense of least squares."""
        rows = np.array([speed[: self.state.number_of_owned_unknowns] for speed in speeds])
        products = over_ranks(self.state.comm, rows @ rows.T, MPI.SUM)
        matrix, right = np.zeros((ORDER, ORDER)), np.zeros(ORDER)
        for k in range(FITTED):
            matrix += products[k + 1 : k + 1 + ORDER, k + 1 : k + 1 + ORDER]
            right += products[k + 1 : k + 1 + ORDER, k]
        return np.asarray(np.linalg.lstsq(matrix, right, rcond=INDEPENDENT)[0], dtype=np.float64)


class Traits(NamedTuple):
    """Of a coupling's errors in time: how steps are chosen for a tolerance.

    Attributes
    ----------
    order
        Power of the step with which they fall.
    accumulates
        Whether those of steps add up; where not, a row lags behind.
    longest
        kappa times the longest step that may be chosen for its error: longer ones of an explicit rule swing.

    Examples
    --------
    >>> from remodel_fenicsx.extend import Traits
    >>> Traits(order=2, accumulates=True).longest
    inf
    """

    order: int
    accumulates: bool
    longest: float = math.inf


class Coupling(Protocol):
    """One step in two halves, inside the stepper's transaction. What is between them is the step's row.

    Cells are changed by `RemodelingPass.apply` or `replace`, which know the power. What goes on from step to step is
    remembered in the state (`State.remember`, `state.Numbers`). The coupling tells what remodels beside the cells
    (`RemodelingPass.beside`) where a step is: `before`, `settle` in equilibrium, `after`.

    Attributes
    ----------
    equilibrium
        The forms of the solved state, with its cells.
    newton
        What solved it; with forms of its own where cells belong to the unknowns.
    traits
        What is known of its errors in time.
    tangents
        How many were assembled in the last solve of the state itself.

    Examples
    --------
    What a script writes is most often a `Staggered` with another second half; a simulation has one:

    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> coupling = Simulation(preset_scene("kuhl-holzapfel-2007", "cube")).stepper.coupling
    >>> coupling.traits
    Traits(order=1, accumulates=False, longest=inf)
    """

    equilibrium: Equilibrium
    newton: GuardedNewton
    traits: Traits
    tangents: int

    @property
    def better(self) -> UnitCell | None:
        """After `remodel`: cells (n, 3) and (n, 3, 3) that a better rule gives; None if the row has no error."""

    def solve(self, time: float, loads: LoadValues) -> Work:
        """Bring the state to equilibrium with the loads of `time`; `state.equilibrium_cells` are those of the row.

        Parameters
        ----------
        time
            Of the step.
        loads
            Magnitudes of all loads at this time, by name.
        """

    def remodel(self, time: float) -> float:
        """Make the cells that the next step starts with, where `solve` has not; returns the power of remodeling.

        Parameters
        ----------
        time
            Of the step.
        """

    def close(self) -> None:
        """Free PETSc's objects."""


class Staggered:
    """The paper's coupling: solve with the cells of the step before, then one remodeling pass.

    Where Newton's method cannot go to the new state in one piece, the change of the cells and then the change of the
    loads are applied in parts (docs/theory.md, "Steps that are too large").

    Parameters
    ----------
    state
        What is advanced.
    tissue
        Its constitutive parameters, on the mesh.
    remodeling
        The pass that changes the cells.
    settings
        Of the solver.

    Examples
    --------
    A coupling of one's own overrides one of its halves, see `CouplingKind`. A simulation makes it:

    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> from remodel_fenicsx.extend import Staggered
    >>> simulation = Simulation(preset_scene("kuhl-holzapfel-2007", "cube"), coupling=Staggered)
    >>> type(simulation.stepper.coupling).__name__
    'Staggered'
    """

    traits = Traits(order=1, accumulates=False)

    def __init__(self, state: State, tissue: Tissue, remodeling: RemodelingPass, settings: Solver):
        self.state, self.remodeling, self.settings = state, remodeling, settings
        self.equilibrium = Equilibrium(state, tissue)
        self.equilibrium.compile_energy()
        self.newton = GuardedNewton(self.equilibrium, settings)
        self.predictor = None if settings.predictor == "none" else Predictor(state)
        self._last = Numbers(state, "last_solution", {"extension": 0.0})  # its largest r/L
        self.residual = 0.0
        self.tangents = 0  # that were assembled in the last solve of the state itself
        changes = any(part.changes for part in (remodeling, *remodeling.beside))
        self.blend = Blend(state, tissue, settings) if changes else None

    def solve(self, time: float, loads: LoadValues) -> Work:
        """Equilibrium at `time` with the present cells.

        Raises
        ------
        StepFailure
            If no admissible equilibrium is found.
        """
        self._before(time)
        return self.balanced(time, loads)

    def _before(self, time: float) -> None:
        for part in self.remodeling.beside:
            part.before(time, self.traits.order)

    def balanced(self, time: float, loads: LoadValues, again: bool = False) -> Work:
        """Equilibrium with what has remodeled.

        Parameters
        ----------
        time, loads
            As of `solve`.
        again
            The step has been solved already, with other cells.
        """
        work, before, old_loads = Work(), self.state.unknown.x.array.copy(), dict(self.state.loading.values)
        step = LoadStep.between(time - self.state.time, old_loads, loads)
        self._solve(step, time, old_loads, loads, work, again)
        self._whole(time, old_loads, loads).look_back(before, work, again)
        if self.predictor is not None:
            self.predictor.solved(step, before, again)
        self.state.settle_cells()
        self.residual = work.residual
        work.extension = work.extension or self.equilibrium.extension()
        self._last["extension"] = work.extension.max_chain_extension
        self.tangents = work.tangents
        for part in self.remodeling.beside:
            work.count(part.settle(time, again))
        return work

    def remodel(self, time: float) -> float:
        """The pass with the solved state."""
        power = 0.0
        if self.remodeling.law.remodels:
            power = self.remodeling.apply(self.state.time, time, self.residual)
        return power + self._after(time)

    def _after(self, time: float) -> float:
        return sum(part.after(time) for part in self.remodeling.beside)

    @property
    def better(self) -> UnitCell | None:
        """The cells that the whole pass with the row's own stress asks for: those of the row are a step behind."""
        return self.remodeling.asked

    def close(self) -> None:
        """Free PETSc's objects."""
        self.newton.close()
        for part in self.remodeling.beside:
            part.close()
        if self.blend is not None:
            self.blend.close()

    # ------------------------------------------------------------ in one piece: the paper's step
    def _solve(
        self, step: LoadStep, time: float, old_loads: LoadValues, loads: LoadValues, work: Work, again: bool
    ) -> None:
        """Try `attempts.FROM_EXPECTED`, `FROM_LAST` and `IN_PARTS`."""
        unknown, loading, failure = self.state.unknown.x.array, self.state.loading, None
        before = unknown.copy()
        loading.set(loads)  # what they prescribe is part of what is expected
        if not again and self._starts_as_expected(step):
            if self._tried(FROM_EXPECTED, work, before) is None:
                return
        unknown[:] = before
        loading.set(old_loads)
        if self.equilibrium.extension().admissible:
            loading.set(loads)
            failure = self._tried(FROM_LAST, work)
            if failure is None:
                return
        else:
            say(FROM_LAST, "the remodeled cells have r >= L at the old displacement")
        self._solve_in_parts(time, old_loads, loads, work, failure)

    def _starts_as_expected(self, step: LoadStep) -> bool:
        """Take the unknowns that are expected, where there are any that are admissible."""
        # Where chains would be almost straight the forces are huge, and Newton's method comes back slowly: from the
        # last displacement it takes fewer iterations.
        expected = None if self.predictor is None else self.predictor.expected(step)
        if expected is None:
            return False
        self.state.unknown.x.array[:] = expected
        return self.newton.may_start(self._last["extension"])

    def _tried(self, attempt: Attempt, work: Work, origin: Array | None = None) -> SolveFailure | None:
        """Solve from the present unknowns; return the failure, if it is one."""
        found = attempted(lambda: self.newton.solve(origin), SolveFailure)
        work.add(found)
        if isinstance(found, SolveFailure):
            say(attempt, found.reason)
            return found
        work.substeps = 1
        return None

    # ------------------------------------------------------------ in parts
    def _solve_in_parts(
        self, time: float, old_loads: LoadValues, new_loads: LoadValues, work: Work, failure: SolveFailure | None
    ) -> None:
        """First the change of what remodels, then that of the loads."""
        # `failure`: that of the whole step, if it was tried.
        loading, halvings = self.state.loading, self.settings.maximum_halvings
        loading.set(old_loads)
        if self.blend is not None and self._has_remodeled():
            blend = self.blend
            parts = time, "the change of the cells", self._set_part, self.state, lambda: blend.newton
            Change(*parts, halvings, blend.largest_part, roughly=True).advance(work)
            failure = None  # the loads have not been tried from here

        def set_load_fraction(fraction: float) -> None:
            loading.set(between(old_loads, new_loads, fraction))

        whole = time, "the change of the loads", set_load_fraction, self.state, lambda: self.newton
        Change(*whole, halvings).advance(work, failure)
        loading.set(new_loads)
        log.info("time %g solved in %d parts", time, work.substeps)

    def _whole(self, time: float, old_loads: LoadValues, new_loads: LoadValues) -> Change:
        """The change of the cells and of the loads together."""
        blend = self.blend if self.blend is not None and self._has_remodeled() else None

        def set_fraction(fraction: float) -> None:
            self.state.loading.set(between(old_loads, new_loads, fraction))
            if blend is not None:
                self._set_part(fraction)

        halvings = self.settings.maximum_halvings
        if blend is None:
            return Change(time, "the step", set_fraction, self.state, lambda: self.newton, halvings)
        return Change(time, "the step", set_fraction, self.state, lambda: blend.newton, halvings, blend.largest_part)

    def _set_part(self, fraction: float) -> None:
        """Take a part of what has remodeled since the last solved state."""
        assert self.blend is not None
        self.blend.set(fraction)
        for part in self.remodeling.beside:
            part.set_part(fraction)

    def _has_remodeled(self) -> bool:
        if any(part.changes for part in self.remodeling.beside):
            return True
        same = self.state.equilibrium_cells.equals(self.state.cells)
        return bool(self.state.comm.allreduce(int(not same)) > 0)


def between(old: LoadValues, new: LoadValues, fraction: float) -> LoadValues:
    """Loads after a fraction of their change."""
    return new if fraction == 1.0 else {name: old[name] + fraction * (new[name] - old[name]) for name in new}


class Extrapolated(Staggered):
    """Remodel, then solve: sE + h/2 d(sE)/dt from the last two targets (docs/theory.md, Extrapolated coupling)."""

    traits = Traits(order=2, accumulates=True, longest=0.5)

    def __init__(self, state: State, tissue: Tissue, remodeling: RemodelingPass, settings: Solver):
        super().__init__(state, tissue, remodeling, settings)
        size = TARGET.itemsize // 8
        targets = state.cells.quadrature.function("targets", (2, size))
        memory = state.cells.quadrature.values(targets, (2, size)).reshape(-1, 2, size)
        # of all points in one row, the function's own memory: the last target, and the one before
        self._newest: NDArray[np.void]
        self._older: NDArray[np.void]
        self._newest, self._older = np.moveaxis(memory.view(TARGET)[..., 0], 1, 0)
        self._newest["time"] = self._older["time"] = NEVER
        state.remember(targets)
        self._power = 0.0
        self._start: UnitCell  # the cells at the start of the step
        self._found: Target  # of the solved state
        self._begins: Flags  # points whose first step with a target this is
        self._duration = 0.0  # of the step

    @property
    def better(self) -> UnitCell:
        """The cells that the targets at both ends give together; where a point begins, the target of its end."""
        weight = weight_of_the_end(self.remodeling.kappa * self._duration)
        mean = known(self._older).towards(self._found, weight).where(self._begins, self._found)
        return self.remodeling.followed(mean, self._duration, self._start)

    def solve(self, time: float, loads: LoadValues) -> Work:
        """New cells, and equilibrium at `time` with them."""
        cells = self.state.cells
        self._start, expected = cells.point_cells.copy(), self._extrapolated(time)
        self._follow(expected, time)
        self._before(time)
        work = self.balanced(time, loads)
        self._found = self.remodeling.target(self.residual)
        self._begins = (self._newest["switch"] < COUNTS) & (self._found.switch >= COUNTS)
        if not how_many(self.state, self._begins):
            return work
        cells.set(*self._start[:2])
        self._follow(expected.where(self._begins, self._found), time)
        again = self.balanced(time, loads, again=True)
        self._found = self.remodeling.target(self.residual)
        again.substeps += work.substeps - 1
        again.count(work)
        return again

    def remodel(self, time: float) -> float:
        """Remember the target of the solved state; the cells are those of the row."""
        self._duration = time - self.state.time
        self._older[:] = self._newest
        self._older["time"][self._begins] = NEVER  # its step had the target of its end
        self._newest["direction"], self._newest["switch"], self._newest["time"] = *self._found, time
        return self._power + self._after(time)

    def _extrapolated(self, time: float) -> Target:
        """The target at the middle of the step."""
        last, before = self._newest["time"], self._older["time"]
        back, apart = np.zeros_like(last), before != NEVER
        back[apart] = (time - last[apart]) / 2 / (last[apart] - before[apart])
        return known(self._newest).towards(known(self._older), -back)

    def _follow(self, target: Target, time: float) -> None:
        """Cells after the step; where an extrapolated target would make A indefinite, the last target itself counts."""
        duration = time - self.state.time
        self._power = 0.0
        if not how_many(self.state, target.switch != 0.0):
            return
        asked = self.remodeling.followed(target, duration)
        lost = ~np.isfinite(asked.dimensions).all(axis=-1)
        if lost.any():
            asked = self.remodeling.followed(target.where(lost, known(self._newest)), duration)
        points = how_many(self.state, lost)
        if points and self.state.comm.rank == 0:
            log.info("time %g: %d points follow the last stress, not the extrapolated one", time, points)
        self._power = self.remodeling.replace(asked, self.state.elastic_gradient(), duration)


def how_many(state: State, points: Flags) -> int:
    """Of all points in one row that are chosen, on all ranks."""
    quadrature = state.cells.quadrature
    return int(over_ranks(state.comm, int(quadrature.owned(points.reshape(quadrature.shape)).sum()), MPI.SUM))


def known(records: NDArray[np.void]) -> Target:
    """The target that records of `TARGET` hold; zero where there was none."""
    return Target(records["direction"], records["switch"])


Maker = Callable[[State, Tissue, RemodelingPass, Solver], Coupling]
