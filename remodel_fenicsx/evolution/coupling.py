"""How equilibrium and remodeling of one step are coupled: strategies over the same state."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.body.loading import LoadValues
from remodel_fenicsx.evolution.predictor import PREDICTORS, LoadStep
from remodel_fenicsx.evolution.remodeling import RemodelingPass
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.schema.settings import Solver
from remodel_fenicsx.solver.continuation import Blend, Change, Work
from remodel_fenicsx.solver.equilibrium import Equilibrium
from remodel_fenicsx.solver.newton import GuardedNewton, SolveFailure
from remodel_fenicsx.state.state import Numbers, State

Array = NDArray[np.float64]
log = logging.getLogger(__name__)


class Coupling(Protocol):
    """One step in two halves, inside the stepper's transaction. What is between them is the step's row.

    Attributes
    ----------
    equilibrium
        The forms of the solved state.
    newton
        What solved it.
    share
        Share of a pass's change of the cells that is made.
    order
        Power of the step with which the error in time falls.
    accumulates
        Whether the errors in time of steps add up; where not, a row lags behind.
    longest
        kappa times the longest step that may be chosen for its error: longer ones of an explicit rule swing.
    compares
        Whether `better` is wanted; set it before the first step.
    others
        Further load cases, solved with the same cells after the state itself (`load_cases.OtherCase`).
    turnover
        Content and natural length of the collagen (`turnover.TurnoverPass`), which it changes; None where they stay.

    Examples
    --------
    What a script writes is most often a `Staggered` with another second half; a simulation has one:

    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> coupling = Simulation(preset_scene("kuhl-holzapfel-2007", "cube")).stepper.coupling
    >>> coupling.order, coupling.accumulates
    (1, False)
    """

    equilibrium: Equilibrium
    newton: GuardedNewton
    share: float
    order: int
    accumulates: bool
    longest: float
    compares: bool
    others: Sequence[Any]
    turnover: Any

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
        """Make the cells that the next step starts with; returns the power of remodeling.

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
    loads are applied in parts (docs/theory.md, "Steps that are too large"): the state at the end is the same.

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

    order, accumulates, longest = 1, False, math.inf

    def __init__(self, state: State, tissue: Tissue, remodeling: RemodelingPass, settings: Solver):
        self.state, self.remodeling, self.settings = state, remodeling, settings
        self.equilibrium = Equilibrium(state, tissue)
        self.equilibrium.compile_energy()
        self.newton = GuardedNewton(self.equilibrium, settings)
        self.predictor = PREDICTORS[settings.predictor](state)
        self._last = Numbers(state, "last_solution", {"extension": 0.0})  # its largest r/L
        self.share, self.compares, self.residual = 1.0, False, 0.0
        self.others: Sequence[Any] = ()
        self.turnover: Any = None
        self.tangents = 0  # that were assembled in the last solve of the state itself
        self.blend: Blend | None = None
        if (
            remodeling.law.remodels or remodeling.settings.turnover.is_on
        ):  # now, for no form is compiled in the middle of a run
            self.blend = Blend(state, tissue, settings)
            self.blend.equilibrium.stop_signal = lambda: self.equilibrium.stop_signal()

    def solve(self, time: float, loads: LoadValues) -> Work:
        """Equilibrium at `time` with the present cells.

        Raises
        ------
        StepFailure
            If no admissible equilibrium is found.
        """
        if self.turnover is not None and not self.accumulates:
            self.turnover.lag(time)
        work, before, old_loads = Work(), self.state.unknown.x.array.copy(), dict(self.state.loading.values)
        step = LoadStep.between(self.state.time, old_loads, time, loads)
        if self._solved_as_expected(step, loads, work):
            pass
        elif self.equilibrium.extension().admissible:
            self._solve_in_one(time, loads, work)
        else:
            log.info("solving in parts: the remodeled cells have r >= L at the old displacement")
            self._solve_in_parts(time, old_loads, loads, work, failure=None)
        self._whole(time, old_loads, loads).look_back(before, work)
        self.predictor.solved(step, before)
        self.state.settle_cells()
        if self.turnover is not None:
            self.turnover.settle()
        self.residual = work.residual
        work.extension = work.extension or self.equilibrium.extension()
        self._last["extension"] = work.extension.max_chain_extension
        self.tangents = work.tangents
        for case in self.others:
            work.count(case.solve(time))
        return work

    def remodel(self, time: float) -> float:
        """The pass with the solved state."""
        power = 0.0
        if self.remodeling.law.remodels:
            power = self.remodeling.apply(self.state.time, time, self.residual, self.share)
        if self.turnover is not None:
            self.turnover.complete(time)
        return power

    @property
    def better(self) -> UnitCell | None:
        """The cells that the whole pass with the row's own stress asks for: those of the row are a step behind."""
        return self.remodeling.asked

    def close(self) -> None:
        """Free PETSc's objects."""
        self.newton.close()
        for case in self.others:
            case.coupling.close()
        if self.blend is not None:
            self.blend.close()

    # ------------------------------------------------------------ in one piece: the paper's step
    def _solved_as_expected(self, step: LoadStep, loads: LoadValues, work: Work) -> bool:
        """Solve from where the predictor expects the solution; if that fails, all is as before."""
        # Where chains would be almost straight the forces are huge, and Newton's method comes back slowly: from the
        # last displacement it takes fewer iterations.
        unknown, loading = self.state.unknown.x.array, self.state.loading
        before, old_loads = unknown.copy(), dict(loading.values)
        loading.set(loads)  # what they prescribe is part of what is expected
        expected = self.predictor.expected(step)
        try:
            if expected is not None:
                unknown[:] = expected
            if expected is not None and self.newton.may_start(self._last["extension"]):
                work.add(self.newton.solve(origin=before))
                work.substeps = 1
                return True
        except SolveFailure as failure:
            work.add(failure)
            log.info("not solved from the predicted displacement: %s", failure.reason)
        unknown[:] = before
        loading.set(old_loads)
        return False

    def _solve_in_one(self, time: float, loads: LoadValues, work: Work) -> None:
        old_loads = dict(self.state.loading.values)
        self.state.loading.set(loads)
        try:
            work.add(self.newton.solve())
            work.substeps = 1
        except SolveFailure as failure:
            work.add(failure)
            log.info("solving in parts: %s", failure.reason)
            self._solve_in_parts(time, old_loads, loads, work, failure)

    # ------------------------------------------------------------ in parts
    def _solve_in_parts(
        self, time: float, old_loads: LoadValues, new_loads: LoadValues, work: Work, failure: SolveFailure | None
    ) -> None:
        """First the change of the cells and of turnover, then that of the loads."""
        # `failure`: that of the whole step, if it was tried.
        loading, halvings = self.state.loading, self.settings.maximum_halvings
        loading.set(old_loads)
        if self.blend is not None and self._cells_changed():
            blend = self.blend
            stage = "the change of the cells"
            Change(time, stage, self._set_part, blend.newton, halvings, blend.largest_part, roughly=True).advance(work)
            failure = None  # the loads have not been tried from here

        def set_load_fraction(fraction: float) -> None:
            loading.set(between(old_loads, new_loads, fraction))

        Change(time, "the change of the loads", set_load_fraction, self.newton, halvings).advance(work, failure)
        loading.set(new_loads)
        log.info("time %g solved in %d parts", time, work.substeps)

    def _whole(self, time: float, old_loads: LoadValues, new_loads: LoadValues) -> Change:
        """The change of the cells and of the loads together."""
        blend = self.blend if self.blend is not None and self._cells_changed() else None

        def set_fraction(fraction: float) -> None:
            self.state.loading.set(between(old_loads, new_loads, fraction))
            if blend is not None:
                self._set_part(fraction)

        halvings = self.settings.maximum_halvings
        if blend is None:
            return Change(time, "the step", set_fraction, self.newton, halvings)
        return Change(time, "the step", set_fraction, blend.newton, halvings, blend.largest_part)

    def _set_part(self, fraction: float) -> None:
        """Of what the cells have changed since the last solved state, and content and natural length."""
        assert self.blend is not None
        self.blend.set(fraction)
        if self.turnover is not None:
            self.turnover.set_part(fraction)

    def _cells_changed(self) -> bool:
        """Or content and natural length."""
        if self.turnover is not None:
            return True
        same = self.state.equilibrium_cells.equals(self.state.cells)
        return bool(self.state.comm.allreduce(int(not same)) > 0)


def between(old: LoadValues, new: LoadValues, fraction: float) -> LoadValues:
    """Loads after a fraction of their change."""
    return new if fraction == 1.0 else {name: old[name] + fraction * (new[name] - old[name]) for name in new}


class Relaxed(Staggered):
    """A share of each pass's change of the structure tensor: stable where the printed pass over-corrects."""

    def __init__(self, state: State, tissue: Tissue, remodeling: RemodelingPass, settings: Solver):
        super().__init__(state, tissue, remodeling, settings)
        self.share = remodeling.settings.relaxation_factor


Maker = Callable[[State, Tissue, RemodelingPass, Solver], Coupling]
