"""Time stepping: one step as one transaction, the loop over all steps, and their watchers."""

from __future__ import annotations

import logging
import math
import time as clock
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from decimal import Decimal
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np

from remodel_fenicsx._renamed import with_old_names
from remodel_fenicsx.body.loading import LoadValues
from remodel_fenicsx.evolution.coupling import Coupling, CouplingFactory
from remodel_fenicsx.evolution.life_cycle import Remodels
from remodel_fenicsx.evolution.remodeling import RemodelingPass
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.schema.settings import COUPLINGS, Remodeling, Solver
from remodel_fenicsx.solver.continuation import Continuation, Work
from remodel_fenicsx.solver.equilibrium import Equilibrium, StateLimits
from remodel_fenicsx.solver.newton import GuardedNewton
from remodel_fenicsx.state import StateNumbers, State
from remodel_fenicsx.system.interrupts import Paused

if TYPE_CHECKING:
    from dolfinx.fem import Function
    from mpi4py import MPI

    from remodel_fenicsx.evolution.homeostasis import Homeostasis
    from remodel_fenicsx.scene.scene import Scene

log = logging.getLogger(__name__)

# Steps between two checks of what changes slowly; a check costs up to a third of a step.
CHECK_INTERVAL = 5


# Only this module creates steps. Therefore the arguments have no deprecated names.
@partial(with_old_names, arguments=False)
@dataclass
class Step:
    """Record of a time step, filled between the solution and the end of the step.

    Attributes
    ----------
    time, number
        Time of the step, and its number; 0 is the unloaded body at the start.
    loads
        Magnitudes of the loads by name.
    limits
        Limits of the solved state: the largest chain extension r/L (`max_chain_extension`) and the
        smallest volume ratio J (`min_jacobian`).
    work
        Solver work.
    remodeling_power
        Stored energy per time that the remodeling pass released; known after the pass.
    seconds, processor_seconds
        Wall time and CPU time of this rank; known after the pass.
    is_last
        Whether it is the last step of the run.
    time_error
        Estimated time discretisation error of the solved state, in degrees; NaN without an estimate
        (`time_steps.TimeError`).
    negative_eigenvalues
        Number of negative eigenvalues of the tangent at the solved state; NaN if not counted
        (`watch.stability`).
    row
        Values of the columns by name; empty without an observer (`results.columns.Observer`).
    case
        Number of the load case that the step describes.
    findings
        Messages of watchers about the step, each a logging level and a line. They are logged when
        the step is accepted.

    Examples
    --------
    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> simulation = Simulation(preset_scene("kuhl-holzapfel-2007", "cube"))
    >>> for _, step in zip(range(2), simulation.steps()):
    ...     print(step.number, step.time, step.loads, step.work.newton_iterations)
    1 1.0 {'force': 1.0} 4
    2 2.0 {'force': 2.0} 3
    >>> round(step.limits.max_chain_extension, 4), step.label
    (0.4769, 'time 2')
    """

    time: float
    number: int
    loads: LoadValues
    limits: StateLimits
    work: Work
    remodeling_power: float = 0.0
    seconds: float = 0.0
    processor_seconds: float = 0.0
    is_last: bool = False
    time_error: float = math.nan
    negative_eigenvalues: float = math.nan
    row: dict[str, float] = field(default_factory=dict)
    case: int = 1
    findings: list[tuple[int, str]] = field(default_factory=list)

    @property
    def is_due(self) -> bool:
        """Whether watchers check what changes slowly: in the first, last, and every fifth step."""
        return self.is_last or self.number % CHECK_INTERVAL == 1

    @property
    def label(self) -> str:
        """Label with the time, and the number of the load case if it is not the first."""
        return f"time {self.time:g}" + (f", load case {self.case}" if self.case > 1 else "")


class Watcher:
    """Base class of step observers; a subclass overrides the methods that it needs.

    `solved` and `completed` run inside the step's transaction: an exception there undoes the step
    for all watchers.

    Examples
    --------
    >>> from remodel_fenicsx import Simulation, parts, preset_scene
    >>> class LargestExtension(parts.Watcher):
    ...     value = 0.0
    ...
    ...     def committed(self, step):
    ...         self.value = max(self.value, step.limits.max_chain_extension)
    >>> scene = preset_scene("kuhl-holzapfel-2007", "cube").with_values({"time.end": 3.0})
    >>> watcher = LargestExtension()
    >>> for step in Simulation(scene).steps([watcher]):
    ...     pass
    >>> round(watcher.value, 4)
    0.486
    """

    def started(self, step: Step) -> None:
        """Process the unloaded body before the first step, as a step of its own."""

    def resumed(self, step: Step) -> None:
        """Process the last committed step of a resumed run; its cells have already remodeled."""

    def solved(self, step: Step) -> None:
        """Process the solved state, which the step's row describes."""

    def completed(self, step: Step) -> None:
        """Process the complete step, whose cells have remodeled."""

    def undone(self, step: Step) -> None:
        """Discard all records of a step that failed after its solution, here or on other ranks."""

    def committed(self, step: Step) -> None:
        """Process the accepted step."""

    def close(self) -> None:
        """Free PETSc's objects of the watcher."""


@with_old_names
class WarnsOnce(Watcher):
    """Watcher that logs one warning at most once in a run, also if the run is resumed.

    Parameters
    ----------
    stepper
        Stepper or load case whose solved states are checked.

    Attributes
    ----------
    name
        Prefix of the names of its numbers in the state.
    initial
        Initial values of numbers that carry over from step to step, by name.
    level
        Logging level.

    Examples
    --------
    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> from remodel_fenicsx.extend import WATCHERS, WarnsOnce, WatcherKind
    >>> class Stretched(WarnsOnce):
    ...     name = "stretched"
    ...
    ...     def check(self, step):
    ...         return "the cube is long" if step.row["mean_stretch"] > 1.5 else ""
    >>> WATCHERS["stretched"] = WatcherKind(Stretched.for_scene)
    >>> simulation = Simulation(preset_scene("kuhl-holzapfel-2007", "cube"))
    >>> for step in simulation.steps():
    ...     pass
    >>> simulation.watchers[-1].is_reported
    True
    >>> del WATCHERS["stretched"]
    """

    name = ""
    initial: ClassVar[Mapping[str, float]] = {}
    level = logging.WARNING

    def __init__(self, stepper: LoadCaseSolver):
        self.stepper, self.state = stepper, stepper.state
        self.quadrature = stepper.state.cells.quadrature
        self._numbers = StateNumbers(self.state, self.name, {"said": 0} | dict(self.initial))

    @classmethod
    def for_scene(cls, scene: Scene, stepper: Stepper) -> WarnsOnce | None:
        """Make the watcher of a scene's stepper or load case (`WATCHERS`), or return None.

        Parameters
        ----------
        scene
            The scene.
        stepper
            Stepper of the scene, or one of its load cases.

        Returns
        -------
        WarnsOnce or None
            None if there is nothing to watch.
        """
        return cls(stepper)

    @property
    def is_reported(self) -> bool:
        """Whether the warning was issued."""
        return bool(self._numbers["said"])

    def due(self, step: Step) -> bool:
        """Return whether to check a step.

        Parameters
        ----------
        step
            The solved step.

        Returns
        -------
        bool
            By default `Step.is_due`.
        """
        return step.is_due

    def check(self, step: Step) -> str:
        """Check the solved state, and return the warning or an empty string.

        Parameters
        ----------
        step
            The solved step.

        Returns
        -------
        str
            One line without the time.
        """
        return ""

    def solved(self, step: Step) -> None:
        """Check the state until the warning is issued."""
        if self.due(step) and not self.is_reported and (text := self.check(step)):
            self.emit(step, text)

    def emit(self, step: Step, text: str) -> None:
        """Issue the warning; it is logged when the step is accepted, and discarded otherwise.

        Parameters
        ----------
        step
            The solved step.
        text
            One line without the time.
        """
        self._numbers["said"] = True
        step.findings.append((self.level, f"{step.label}: {text}"))


class LoadCaseSolver:
    """A state and its solver: the stepper, or a further load case with the same cells.

    Attributes
    ----------
    state, tissue, remodeling, coupling
        The state, its tissue, the pass that computes the driving tensor of its cells, and its
        coupling.
    load_values
        Function of time that returns the magnitudes of all loads by name.
    load_cases
        All load cases, if this one is the stepper; otherwise this one alone.
    """

    state: State
    tissue: Tissue
    remodeling: RemodelingPass
    coupling: Coupling
    load_values: Callable[[float], LoadValues]
    load_cases: list[LoadCaseSolver]

    def adapt_watcher(self, watcher: Watcher) -> Watcher:
        """Return a watcher that passes each step to `watcher` with this load case's values."""
        return watcher


class Stepper(LoadCaseSolver):
    """Time stepper of a state; each step is a transaction.

    Parameters
    ----------
    state
        State to advance.
    tissue
        Parameters of matrix and chains.
    remodeling
        Settings of the remodeling.
    solver
        Solver settings.
    load_values
        Function of time that returns the magnitudes of all loads by name.
    coupling
        Factory of a coupling in place of the coupling that `remodeling` names.
    kappa
        Number or DG0 Function in place of the kappa of `remodeling`.

    Examples
    --------
    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> simulation = Simulation(preset_scene("kuhl-holzapfel-2007", "cube"))
    >>> stepper = simulation.stepper
    >>> for step in stepper.march([1.0, 2.0], [simulation.observer]):
    ...     print(step.time, round(step.row["mean_fibre_angle"], 3))
    1.0 54.736
    2.0 53.569
    >>> stepper.close()
    """

    def __init__(
        self,
        state: State,
        tissue: Tissue,
        remodeling: Remodeling,
        solver: Solver,
        load_values: Callable[[float], LoadValues],
        coupling: CouplingFactory | None = None,
        kappa: float | Function | None = None,
    ):
        self.state, self._solver = state, solver
        self.load_values = load_values
        processes: list[Remodels] = []  # in addition to the cells
        for kind in remodeling.additional_kinds:
            processes.append(kind.make(state, tissue, remodeling))
            tissue = processes[-1].tissue or tissue
        self.tissue = state.parameters(tissue).tissue
        self.remodeling = RemodelingPass(state, self.tissue, remodeling, kappa, processes)
        self.load_cases = [self]
        # If the cells never change, the cheapest coupling replaces that of the scene.
        name = remodeling.coupling if self.remodeling.law.remodels else "staggered"
        if processes and not coupling and name != remodeling.coupling and state.comm.rank == 0:
            log.warning(
                "the cells do not change; %s uses the coupling 'staggered' in place of "
                "%r, with an error of first order in the step size",
                ", ".join(process.name for process in processes),
                remodeling.coupling,
            )
        make = coupling or COUPLINGS[name].make
        self.coupling = make(state, self.tissue, self.remodeling, solver)
        self._closed = False

    @property
    def remodels(self) -> list[Remodels]:
        """Remodeling processes: the cells first, then the additional ones."""
        return [self.remodeling, *self.remodeling.additional_processes]

    def process(self, name: str) -> Any:  # type: ignore[explicit-any]  # the name tells the class
        """Return the remodeling process of this name, or None.

        Parameters
        ----------
        name
            Name of the process, such as "turnover" (`Remodels.name`).
        """
        return next((process for process in self.remodels if process.name == name), None)

    @property
    def slowest(self) -> float:
        """Smallest positive rate of all remodeling processes, 1/time; 0 if nothing remodels."""
        rates = (process.slowest for process in self.remodels if process.changes)
        return min(filter(None, rates), default=0.0)

    @property
    def fastest(self) -> float:
        """Largest rate of all remodeling processes, 1/time; 0 if nothing remodels."""
        return max((process.fastest for process in self.remodels if process.changes), default=0.0)

    def start(self, watchers: Sequence[Watcher] = ()) -> Step:
        """Pass the present state to watchers as a step.

        The prestretch of a new state is brought to equilibrium first.

        Parameters
        ----------
        watchers
            Watchers of the steps.

        Returns
        -------
        Step
            The present state as a step.
        """
        state, work = self.state, Work()
        if not state.number:
            for case in self.load_cases:
                equilibrate_prestretch(case.state, case.coupling.equilibrium, self._solver, work)
        step = Step(
            state.time,
            state.number,
            dict(state.loading.values),
            self.coupling.equilibrium.limits(),
            work,
        )
        for watcher in watchers:
            if step.number:
                watcher.resumed(step)
            else:
                watcher.started(step)
        return step

    def advance(
        self,
        time: float,
        watchers: Sequence[Watcher] = (),
        is_last: bool = False,
        rejected: Step | None = None,
        coupling: Homeostasis | None = None,
        measure_error: Callable[[Step], object] | None = None,
    ) -> Step:
        """Advance by one step: equilibrium with the loads of `time`, and remodeling.

        Parameters
        ----------
        time
            End of the step.
        watchers, is_last
            Watchers of the step, and whether it is the last step.
        rejected
            Last rejected attempt at the step. Its work and seconds (those of earlier attempts
            included) are added to the new step.
        coupling
            Object that solves and remodels in place of the stepper's coupling
            (`homeostasis.Homeostasis`).
        measure_error
            Function that is called after the pass to measure the time error. It may raise to reject
            the step (`time_steps`).

        Returns
        -------
        Step
            The committed step.

        Raises
        ------
        StepFailure
            If no admissible equilibrium is found.
        ValueError
            If `time` is not later than the state's time.
        RuntimeError
            If the stepper was closed.
        BaseException
            Any exception, also from a watcher; the state is then that of the last committed step.
        """
        state = self.state
        start, processor_start = clock.perf_counter(), clock.process_time()
        if self._closed:
            raise RuntimeError("the stepper or its simulation has been closed; create a new one")
        if time <= state.time:
            raise ValueError(
                f"time {time!r} does not come after {state.time!r}, that of the last step"
            )
        with state.transaction():
            work = (coupling or self.coupling).solve(time, self.load_values(time))
            limits = work.limits or self.coupling.equilibrium.limits()
            if rejected is not None:
                work.add(rejected.work)
            loads = dict(state.loading.values)  # also those that `load_values` omits
            step = Step(time, state.number + 1, loads, limits, work, is_last=is_last)
            with notify_undone(watchers, step):
                for watcher in watchers:
                    watcher.solved(step)
                step.remodeling_power = (coupling or self.coupling).remodel(time)
                step.seconds = clock.perf_counter() - start
                step.processor_seconds = clock.process_time() - processor_start
                if rejected is not None:
                    step.seconds += rejected.seconds
                    step.processor_seconds += rejected.processor_seconds
                if measure_error is not None:
                    measure_error(step)
                state.complete_step(time, step.number)
                for watcher in watchers:
                    watcher.completed(step)
        if state.comm.rank == 0:
            for level, text in step.findings:
                log.log(level, "%s", text)
        for watcher in watchers:
            watcher.committed(step)
        return step

    def march(
        self,
        times: Iterable[float],
        watchers: Sequence[Watcher] = (),
        measure_error: Callable[[Step], object] | None = None,
    ) -> Iterator[Step]:
        """Start, and yield each committed step up to the end of `times`.

        Parameters
        ----------
        times
            Times of the steps, ascending.
        watchers
            Watchers of the steps.
        measure_error
            See `advance`.

        Yields
        ------
        Step
            The committed steps.
        """
        remaining = list(times)
        self.start(watchers)
        for number, time in enumerate(remaining, start=1):
            yield self.advance(
                time, watchers, is_last=number == len(remaining), measure_error=measure_error
            )

    def replace_loads_and_kappa(
        self, load_values: Callable[[float], LoadValues], kappa: float | Function
    ) -> None:
        """Replace the loads and the rate kappa.

        Parameters
        ----------
        load_values, kappa
            See `Stepper`.
        """
        self.load_values = load_values
        self.remodeling.set_kappa(kappa)

    @contextmanager
    def constant_loads_from(self, start: float) -> Iterator[None]:
        """Keep all loads constant from a time on while the block runs.

        Parameters
        ----------
        start
            Time from which the loads are constant.
        """
        load_values = self.load_values
        self.load_values = lambda time: load_values(min(time, start))
        try:
            yield
        finally:
            self.load_values = load_values

    def close(self) -> None:
        """Free PETSc's objects and options; the state stays, but no further step is possible."""
        self._closed = True
        self.coupling.close()


class TimeStepping(Protocol):
    """Protocol of time stepping: constant or adaptive steps, or steps to the steady state."""

    def remaining(self) -> list[float]:
        """Return the times of the remaining steps, as far as they are known."""

    def march(self, watchers: Sequence[Watcher] = ()) -> Iterator[Step]:
        """Yield the committed steps from the present state to the end."""


class FixedSteps:
    """Time stepping with a constant step size."""

    def __init__(
        self,
        stepper: Stepper,
        end: float,
        step: float,
        measure_error: Callable[[Step], object] | None = None,
    ):
        self.stepper, self.measure_error = stepper, measure_error
        self.end, self.step = end, step

    def remaining(self) -> list[float]:
        """Return the times of the remaining steps."""
        return list(times(self.end, self.step))[self.stepper.state.number :]

    def march(self, watchers: Sequence[Watcher] = ()) -> Iterator[Step]:
        """Yield the committed steps from the present state to the end."""
        return self.stepper.march(self.remaining(), watchers, self.measure_error)


def equilibrate_prestretch(
    state: State, equilibrium: Equilibrium, settings: Solver, work: Work
) -> None:
    """Equilibrate a body with prestretch, in substeps as needed. Collective."""
    G, identity = state.natural_gradient, np.eye(3)
    # The prestretch of a closed ring is in equilibrium already.
    if (
        G is None
        or state.kinematics.closed_ring is not None
        or not state.cells.quadrature.maximum(np.abs(G - identity))
    ):
        return
    prestretch = G.copy()

    def set_fraction(fraction: float) -> None:
        G[:] = prestretch if fraction == 1.0 else identity + fraction * (prestretch - identity)

    with state.transaction(), closing(GuardedNewton(equilibrium, settings)) as newton:
        change = Continuation(
            state.time,
            "the prestretch",
            set_fraction,
            state,
            lambda: newton,
            settings.maximum_halvings,
        )
        try:
            change.advance(work)
        finally:
            G[:] = prestretch
    log.info("prestretched body equilibrated in %d substeps", work.substeps)


@contextmanager
def notify_undone(watchers: Sequence[Watcher], step: Step) -> Iterator[None]:
    """Call `undone` of all watchers, the last first, if the block raises."""
    try:
        yield
    except BaseException:
        for watcher in reversed(watchers):
            watcher.undone(step)
        raise


def times(end: float, step: float) -> Iterator[float]:
    """Yield times of steps: decimal multiples of the step (3 * 0.1 is 0.3), and the end.

    The last step ends at `end`: it has 0.5 to 1.5 of `step`, or less if it is the only one.

    Parameters
    ----------
    end
        Last time.
    step
        Step size, in the same unit.

    Yields
    ------
    float
        Times in ascending order, without 0.

    Examples
    --------
    >>> from remodel_fenicsx import parts
    >>> list(parts.times(0.35, step=0.1))
    [0.1, 0.2, 0.35]
    """
    end, step = float(end), float(step)
    number_of_steps = round(end / step)
    for number in range(1, number_of_steps):
        yield float(number * Decimal(repr(step)))
    yield end


# ---------------------------------------------------------------- intended stops between two steps
# A signal requests the stop, or the wall time limit requires it.

MARGIN = 1.2  # wall time reserved for the next step, as a multiple of the longest recent one


class Pause(Watcher):
    """Watcher that raises `Paused` on all ranks, on request or for a limit of wall time."""

    def __init__(
        self,
        comm: MPI.Comm,
        folder: Path,
        is_requested: Callable[[], bool],
        deadline: float | None,
    ):
        self.comm, self.folder = comm, folder
        self.is_requested, self.deadline = is_requested, deadline
        self._last = clock.monotonic()
        # Wall time of the last step with its output, or half of the former value if that is larger.
        self._seconds = 0.0

    def started(self, step: Step) -> None:
        """Check for a stop before the first step."""
        self._last = clock.monotonic()
        self._check(step)

    def resumed(self, step: Step) -> None:
        """Check for a stop before the first step of a resumed run."""
        self.started(step)

    def committed(self, step: Step) -> None:
        """Check for a stop after each step except the last."""
        now = clock.monotonic()
        self._seconds, self._last = max(0.5 * self._seconds, now - self._last), now
        if not step.is_last:
            self._check(step)

    def _check(self, step: Step) -> None:
        reason = "stopped by SIGUSR1" if self.is_requested() else ""
        if self.deadline is not None and self.comm.rank == 0 and not reason:
            if clock.monotonic() + MARGIN * self._seconds > self.deadline:
                reason = "stopped before --max-wall-time is over"
        if reasons := [text for text in self.comm.allgather(reason) if text]:
            raise Paused(reasons[0], step.time, self.folder)
