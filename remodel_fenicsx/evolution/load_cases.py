"""Further load cases of a cycle: each a state of its own with the same cells, which all of them drive."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from remodel_fenicsx.body.loading import LoadValues
from remodel_fenicsx.evolution.coupling import Staggered
from remodel_fenicsx.evolution.remodeling import RemodelingPass
from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.model.laws import Drive
from remodel_fenicsx.schema.settings import Solver, Turnover
from remodel_fenicsx.solver.continuation import StepFailure, Work
from remodel_fenicsx.state.state import State


class OtherCase:
    """A load case beside the first: solved after it in each step, and asked for its drive before the pass."""

    def __init__(
        self,
        number: int,
        state: State,
        load_values: Callable[[float], LoadValues],
        stepper: Stepper,
        solver: Solver,
        kappa: Any = None,
    ):
        self.number, self.state, self.load_values = number, state, load_values
        self.tissue = stepper.tissue
        settings = stepper.remodeling.settings.model_copy(update={"turnover": Turnover()})  # the first case makes it
        self.remodeling = RemodelingPass(state, stepper.tissue, settings, kappa)
        self.coupling = Staggered(state, stepper.tissue, self.remodeling, solver)
        state.stop_signal = lambda: stepper.state.stop_signal()

    def solve(self, time: float) -> Work:
        """Equilibrium at `time` with the present cells."""
        try:
            return self.coupling.solve(time, self.load_values(time))
        except StepFailure as failure:
            raise StepFailure(failure.time, f"load case {self.number}: {failure}", failure.refusal) from failure

    def drive(self) -> Drive:
        """Of the solved state."""
        return self.remodeling.drive(self.coupling.residual)

    def seen(self, step: Step) -> Step:
        """A step as it is in this case."""
        extension = self.coupling.equilibrium.extension()
        return replace(step, loads=dict(self.state.loading.values), extension=extension, case=self.number)

    def watched_by(self, watcher: Watcher) -> Watcher:
        """The watcher of this case as one of all steps."""
        return OtherCaseWatcher(self, watcher)


class OtherCaseWatcher(Watcher):
    """A watcher of the states of another load case: it sees each step as it is there."""

    def __init__(self, case: OtherCase, watcher: Watcher):
        self.case, self.watcher = case, watcher

    def started(self, step: Step) -> None:
        """As the watcher does, and so all others."""
        self.watcher.started(self.case.seen(step))

    def resumed(self, step: Step) -> None:
        self.watcher.resumed(self.case.seen(step))

    def solved(self, step: Step) -> None:
        self.watcher.solved(self.case.seen(step))

    def completed(self, step: Step) -> None:
        self.watcher.completed(self.case.seen(step))

    def undone(self, step: Step) -> None:
        self.watcher.undone(self.case.seen(step))

    def committed(self, step: Step) -> None:
        self.watcher.committed(self.case.seen(step))

    def close(self) -> None:
        self.watcher.close()
