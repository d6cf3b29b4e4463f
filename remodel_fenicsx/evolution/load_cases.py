"""Further load cases: states with the same cells, whose stresses drive the cells too."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from remodel_fenicsx.body.loading import LoadValues
from remodel_fenicsx.evolution.coupling import Staggered
from remodel_fenicsx.evolution.life_cycle import Remodels
from remodel_fenicsx.evolution.remodeling import RemodelingPass
from remodel_fenicsx.evolution.stepper import LoadCaseSolver, Step, Stepper, Watcher
from remodel_fenicsx.model.laws import Drive
from remodel_fenicsx.schema.settings import Solver
from remodel_fenicsx.solver.continuation import Work
from remodel_fenicsx.state import State

if TYPE_CHECKING:
    from dolfinx.fem import Function


class FurtherCase(LoadCaseSolver):
    """Further load case, which is solved after the first one and drives the same cells."""

    coupling: Staggered

    def __init__(
        self,
        number: int,
        state: State,
        load_values: Callable[[float], LoadValues],
        stepper: Stepper,
        solver: Solver,
        kappa: float | Function | None,
    ):
        self.number, self.state = number, state
        self.load_values = load_values
        state.label = f"load case {number}: "
        self.tissue, self.load_cases = stepper.tissue, [self]
        self.remodeling = RemodelingPass(state, stepper.tissue, stepper.remodeling.settings, kappa)
        self.coupling = Staggered(state, stepper.tissue, self.remodeling, solver)
        state.stop_signal = lambda: stepper.state.stop_signal()

    def solve(self, time: float, again: bool) -> Work:
        """Solve for equilibrium with the present cells; see `Staggered.solve_equilibrium`."""
        return self.coupling.solve_equilibrium(time, self.load_values(time), again)

    def drive(self) -> Drive:
        """Return the drive of the solved state."""
        return self.remodeling.drive(self.coupling.residual)

    def adapt_watcher(self, watcher: Watcher) -> Watcher:
        return FurtherCaseWatcher(self, watcher)

    def seen(self, step: Step) -> Step:
        """Return a copy of a step with the loads and limits of this load case."""
        limits = self.coupling.equilibrium.limits()
        return replace(step, loads=dict(self.state.loading.values), limits=limits, case=self.number)


class LoadCases(Remodels):
    """All further load cases of a step; they have no values of their own."""

    name = "cases"

    def __init__(self, cases: Sequence[FurtherCase]):
        self.cases = cases

    def settle(self, time: float, again: bool) -> Work:
        """Solve each load case."""
        work = Work()
        for case in self.cases:
            work.count(case.solve(time, again))
        return work

    def close(self) -> None:
        """Free PETSc's objects of all load cases."""
        for case in self.cases:
            case.coupling.close()


def join(
    stepper: Stepper,
    states: Sequence[State],
    load_values: Sequence[Callable[[float], LoadValues]],
    weights: Sequence[float],
    solver: Solver,
    kappa: float | Function | None,
) -> None:
    """Add further load cases to a stepper; `weights` are of all cases, in their order."""
    numbered = enumerate(zip(states, load_values, strict=True), start=2)
    cases = [
        FurtherCase(number, state, values, stepper, solver, kappa)
        for number, (state, values) in numbered
    ]
    stepper.state.join(states, weights)
    stepper.load_cases += cases
    stepper.remodeling.further += [case.drive for case in cases]
    stepper.remodeling.additional_processes.append(LoadCases(cases))


class FurtherCaseWatcher(Watcher):
    """Watcher that gets each step with the values of another load case."""

    def __init__(self, case: FurtherCase, watcher: Watcher):
        def as_there(hook: Callable[[Step], None], step: Step) -> None:
            hook(case.seen(step))

        for name in ("started", "resumed", "solved", "completed", "undone", "committed"):
            setattr(self, name, partial(as_there, getattr(watcher, name)))
        self.close = watcher.close  # type: ignore[method-assign]
