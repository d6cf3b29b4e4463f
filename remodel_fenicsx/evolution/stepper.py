"""The way through time: one step as one transaction, and the loop over all of them, which watchers follow."""

from __future__ import annotations

import logging
import math
import time as clock
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np

from remodel_fenicsx.body.loading import LoadValues
from remodel_fenicsx.evolution.coupling import Coupling, Maker
from remodel_fenicsx.evolution.life_cycle import Remodels
from remodel_fenicsx.evolution.remodeling import RemodelingPass
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.schema.settings import COUPLINGS, Remodeling, Solver
from remodel_fenicsx.solver.continuation import Change, Work
from remodel_fenicsx.solver.equilibrium import Equilibrium, Extension
from remodel_fenicsx.solver.newton import GuardedNewton
from remodel_fenicsx.state import Numbers, State
from remodel_fenicsx.system.interrupts import Paused

if TYPE_CHECKING:
    from dolfinx.fem import Function
    from mpi4py import MPI

    from remodel_fenicsx.evolution.homeostasis import Homeostasis
    from remodel_fenicsx.scene.scene import Scene

log = logging.getLogger(__name__)

SLOWNESS = 5  # steps between two looks of warnings, each of which costs up to a third of a step


@dataclass
class Step:
    """A step, from its solution to its end.

    Attributes
    ----------
    time, number
        Its time, and how many steps there have been with it (0: the unloaded body at the start).
    loads
        Magnitudes of the loads.
    extension
        How far the solved state is from its limits.
    work
        Solver work.
    remodeling_power
        Stored energy per time that the remodeling pass released; known once it is complete.
    seconds, processor_seconds
        Wall time, and time of this rank's processor; known once it is complete.
    is_last
        Whether it is the last one of the way.
    time_error
        Estimated error in time of the solved state, degrees; NaN where nobody estimates it (`time_steps.TimeError`).
    negative_eigenvalues
        Of the tangent at the solved state; NaN where nobody counts them (`watch.stability`).
    row
        Its columns by name, where somebody measures (`results.columns.Observer`).
    case
        Number of the load case that is looked at.
    findings
        What watchers say of the step, each a level of logging and a line: it is logged where the step is accepted.

    Examples
    --------
    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> simulation = Simulation(preset_scene("kuhl-holzapfel-2007", "cube"))
    >>> for _, step in zip(range(2), simulation.steps()):
    ...     print(step.number, step.time, step.loads, step.work.newton_iterations)
    1 1.0 {'force': 1.0} 4
    2 2.0 {'force': 2.0} 3
    >>> round(step.extension.max_chain_extension, 4), step.moment
    (0.4769, 'time 2')
    """

    time: float
    number: int
    loads: LoadValues
    extension: Extension
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
        """Whether it is time to look at what changes slowly: the first step, the last, and one in five between."""
        return self.is_last or self.number % SLOWNESS == 1

    @property
    def moment(self) -> str:
        """Its time in words, and which load case it is, if not the first."""
        return f"time {self.time:g}" + (f", load case {self.case}" if self.case > 1 else "")


class Watcher:
    """Follows the steps; whoever wants to know less overrides less.

    `solved` and `completed` happen inside the step's transaction: an exception there undoes the step for all watchers.

    Examples
    --------
    >>> from remodel_fenicsx import Simulation, parts, preset_scene
    >>> class Loudest(parts.Watcher):
    ...     found = 0.0
    ...
    ...     def committed(self, step):
    ...         self.found = max(self.found, step.extension.max_chain_extension)
    >>> scene = preset_scene("kuhl-holzapfel-2007", "cube").with_values({"time.end": 3.0})
    >>> watcher = Loudest()
    >>> for step in Simulation(scene).steps([watcher]):
    ...     pass
    >>> round(watcher.found, 4)
    0.486
    """

    def started(self, step: Step) -> None:
        """Before the first step: the unloaded body, as a step of its own."""

    def resumed(self, step: Step) -> None:
        """In place of `started` where a run goes on: the last step that was committed, its cells already remodeled."""

    def solved(self, step: Step) -> None:
        """The state is the solved one, which the step's row describes."""

    def completed(self, step: Step) -> None:
        """The cells have remodeled; all of the step is known."""

    def undone(self, step: Step) -> None:
        """Somebody has failed after the state was solved, here or elsewhere: what is kept of the step must go."""

    def committed(self, step: Step) -> None:
        """The step is accepted."""

    def close(self) -> None:
        """Free what PETSc has made for it."""


class WarnsOnce(Watcher):
    """Says one thing about a run, once; resumed runs know whether it was said.

    Parameters
    ----------
    stepper
        Whose solved states are looked at.

    Attributes
    ----------
    name
        Of what is remembered of it in the state.
    initial
        Numbers of its own that are remembered from step to step, by name.
    level
        Of logging.

    Examples
    --------
    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> from remodel_fenicsx.extend import WATCHERS, WarnsOnce, WatcherKind
    >>> class Stretched(WarnsOnce):
    ...     name = "stretched"
    ...
    ...     def look(self, step):
    ...         return "the cube is long" if step.row["mean_stretch"] > 1.5 else ""
    >>> WATCHERS["stretched"] = WatcherKind(Stretched.of)
    >>> simulation = Simulation(preset_scene("kuhl-holzapfel-2007", "cube"))
    >>> for step in simulation.steps():
    ...     pass
    >>> simulation.watchers[-1].said
    True
    >>> del WATCHERS["stretched"]
    """

    name = ""
    initial: ClassVar[Mapping[str, float]] = {}
    level = logging.WARNING

    def __init__(self, stepper: LoadCaseSolver):
        self.stepper, self.state = stepper, stepper.state
        self.quadrature = stepper.state.cells.quadrature
        self._numbers = Numbers(self.state, self.name, {"said": 0} | dict(self.initial))

    @classmethod
    def of(cls, scene: Scene, stepper: Stepper) -> WarnsOnce | None:
        """For a scene's stepper, or another load case (`WATCHERS`); None where there is nothing to watch.

        Parameters
        ----------
        scene
            The scene.
        stepper
            Its stepper, or the load case.
        """
        return cls(stepper)

    @property
    def said(self) -> bool:
        """Whether it was."""
        return bool(self._numbers["said"])

    def due(self, step: Step) -> bool:
        """Whether it is time to look.

        Parameters
        ----------
        step
            The step that is solved.
        """
        return step.is_due

    def look(self, step: Step) -> str:
        """What is to be said of the solved state; nothing where all is well.

        Parameters
        ----------
        step
            The step that is solved.
        """
        return ""

    def solved(self, step: Step) -> None:
        """Look, until it was said."""
        if self.due(step) and not self.said and (text := self.look(step)):
            self.find(step, text)

    def find(self, step: Step, text: str) -> None:
        """It is said where the step is accepted, and else forgotten.

        Parameters
        ----------
        step
            The step that is solved.
        text
            One line, without the time.
        """
        self._numbers["said"] = True
        step.findings.append((self.level, f"{step.moment}: {text}"))


class LoadCaseSolver:
    """A state with what solves it: that of a stepper, or of a further load case, which has the same cells.

    Attributes
    ----------
    state, tissue, remodeling, coupling
        The state, its tissue, what makes its drive, and what solves it.
    load_values
        Function of time: magnitudes of all loads.
    each_case
        This one and further load cases.
    """

    state: State
    tissue: Tissue
    remodeling: RemodelingPass
    coupling: Coupling
    load_values: Callable[[float], LoadValues]
    each_case: list[LoadCaseSolver]

    def watched(self, watcher: Watcher) -> Watcher:
        """Return a watcher of the stepper that sees each step as it is here."""
        return watcher


class Stepper(LoadCaseSolver):
    """Advances a state in time; a step is all or nothing.

    Parameters
    ----------
    state
        What is advanced.
    tissue
        Parameters of matrix and chains.
    remodeling
        Driver, law, frame, coupling and kappa.
    solver
        Solver settings.
    load_values
        Function of time: magnitudes of all loads.
    coupling
        Makes a coupling in place of the one that `remodeling` names.
    kappa
        A number, or a DG0 Function, in place of that of `remodeling`.

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
        coupling: Maker | None = None,
        kappa: float | Function | None = None,
    ):
        self.state, self.load_values, self._solver = state, load_values, solver
        beside: list[Remodels] = []
        for kind in remodeling.beside:
            beside.append(kind.make(state, tissue, remodeling))
            tissue = beside[-1].tissue or tissue
        self.tissue = state.parameters(tissue).tissue
        self.remodeling = RemodelingPass(state, self.tissue, remodeling, kappa, beside)
        self.each_case = [self]
        # cells that never change are coupled to nothing
        name = remodeling.coupling if self.remodeling.law.remodels else "staggered"
        if beside and name != remodeling.coupling and state.comm.rank == 0:
            log.warning(
                "kappa is 0: the cells do not change, and %s follows with the coupling 'staggered' in place of %r, "
                "whose errors fall with the step",
                ", ".join(part.name for part in beside),
                remodeling.coupling,
            )
        make = coupling or COUPLINGS[name].make
        self.coupling = make(state, self.tissue, self.remodeling, solver)
        self._closed = False

    @property
    def remodels(self) -> list[Remodels]:
        """What remodels: the cells, and what is beside them."""
        return [self.remodeling, *self.remodeling.beside]

    def part(self, name: str) -> Any:  # type: ignore[explicit-any]  # the name tells the class
        """Return what remodels under this name; None where nothing has it."""
        return next((part for part in self.remodels if part.name == name), None)

    @property
    def slowest(self) -> float:
        """The smallest rate above 0, 1/time; 0 where nothing remodels."""
        return min((part.slowest for part in self.remodels if part.changes and part.slowest), default=0.0)

    @property
    def fastest(self) -> float:
        """The largest one."""
        return max((part.fastest for part in self.remodels if part.changes), default=0.0)

    def start(self, watchers: Sequence[Watcher] = ()) -> Step:
        """The present state as the step that watchers see before all others; at first in equilibrium without loads."""
        state, work = self.state, Work()
        if not state.number:
            for case in self.each_case:
                release(case.state, case.coupling.equilibrium, self._solver, work)
        step = Step(state.time, state.number, dict(state.loading.values), self.coupling.equilibrium.extension(), work)
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
        way: Homeostasis | None = None,
        judge: Callable[[Step], object] = lambda step: None,
    ) -> Step:
        """One step: equilibrium with the loads of `time`, and remodeling.

        Parameters
        ----------
        time
            Its end.
        watchers, is_last
            Who follows it, and whether it is the last one.
        rejected
            The last attempt at it that was taken back: its work and seconds, which have those of the attempts before
            it, belong to the step.
        way
            Solves and remodels in place of the coupling (`homeostasis.Homeostasis`).
        judge
            Asked when the step's pass is done; what it raises takes the step back (`time_steps`).

        Raises
        ------
        StepFailure
            If no admissible equilibrium is found.
        ValueError
            If `time` does not come after the state's.
        RuntimeError
            After `close`.
        BaseException
            Whatever is raised, by a watcher too: the state is then that of the last committed step.
        """
        state, start, processor_start = self.state, clock.perf_counter(), clock.process_time()
        if self._closed:
            raise RuntimeError("this stepper (or its simulation) has been closed; make another one to go on")
        if time <= state.time:
            raise ValueError(f"time {time!r} does not come after {state.time!r}, that of the last step")
        with state.transaction():
            work = (way or self.coupling).solve(time, self.load_values(time))
            extension = work.extension or self.coupling.equilibrium.extension()
            if rejected is not None:
                work.add(rejected.work)
            loads = dict(state.loading.values)  # those that nobody has named too
            step = Step(time, state.number + 1, loads, extension, work, is_last=is_last)
            with undone_by_all(watchers, step):
                for watcher in watchers:
                    watcher.solved(step)
                step.remodeling_power = (way or self.coupling).remodel(time)
                step.seconds = clock.perf_counter() - start
                step.processor_seconds = clock.process_time() - processor_start
                if rejected is not None:
                    step.seconds += rejected.seconds
                    step.processor_seconds += rejected.processor_seconds
                judge(step)
                state.reach(time, step.number)
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
        judge: Callable[[Step], object] = lambda step: None,
    ) -> Iterator[Step]:
        """The loop through time: start, and every step to the end of `times`; what is yielded is committed.

        Parameters
        ----------
        times
            Of the steps, ascending.
        watchers
            Who follows them.
        judge
            As of `advance`.
        """
        remaining = list(times)
        self.start(watchers)
        for number, time in enumerate(remaining, start=1):
            yield self.advance(time, watchers, is_last=number == len(remaining), judge=judge)

    def take(self, load_values: Callable[[float], LoadValues], kappa: float | Function) -> None:
        """Replace loads and rates."""
        self.load_values = load_values
        self.remodeling.set_kappa(kappa)

    @contextmanager
    def holding(self, held: float) -> Iterator[None]:
        """Keep all loads constant from a time on, within the block."""
        given = self.load_values
        self.load_values = lambda time: given(min(time, held))
        try:
            yield
        finally:
            self.load_values = given

    def close(self) -> None:
        """Free PETSc's objects and options; the state stays, and takes no further step."""
        self._closed = True
        self.coupling.close()


class Way(Protocol):
    """A way through time."""

    def remaining(self) -> list[float]:
        """Return the times of the steps that are left, as far as they are known."""

    def march(self, watchers: Sequence[Watcher] = ()) -> Iterator[Step]:
        """Yield the committed steps from the present state to the end."""


class FixedSteps:
    """March in steps of one length."""

    def __init__(self, stepper: Stepper, end: float, step: float, judge: Callable[[Step], object] = lambda step: None):
        self.stepper, self.end, self.step, self.judge = stepper, end, step, judge

    def remaining(self) -> list[float]:
        """Return the times of the steps that are left."""
        return list(times(self.end, self.step))[self.stepper.state.number :]

    def march(self, watchers: Sequence[Watcher] = ()) -> Iterator[Step]:
        """Yield the committed steps from the present state to the end."""
        return self.stepper.march(self.remaining(), watchers, self.judge)


def release(state: State, equilibrium: Equilibrium, settings: Solver, work: Work) -> None:
    """Let a body go that its prestretch leaves out of balance, in as many parts as it needs. Collective."""
    G, one = state.natural_gradient, np.eye(3)
    if G is None or state.kinematics.closing is not None or not state.cells.quadrature.maximum(np.abs(G - one)):
        return
    whole = G.copy()

    def set_fraction(fraction: float) -> None:
        G[:] = whole if fraction == 1.0 else one + fraction * (whole - one)

    with state.transaction(), closing(GuardedNewton(equilibrium, settings)) as newton:
        change = Change(state.time, "the prestretch", set_fraction, state, lambda: newton, settings.maximum_halvings)
        try:
            change.advance(work)
        finally:
            G[:] = whole
    log.info("the body is let go with its prestretch: %d parts", work.substeps)


@contextmanager
def undone_by_all(watchers: Sequence[Watcher], step: Step) -> Iterator[None]:
    """Whatever is raised in the block, every watcher forgets the step, the last one first."""
    try:
        yield
    except BaseException:
        for watcher in reversed(watchers):
            watcher.undone(step)
        raise


def times(end: float, step: float) -> Iterator[float]:
    """Times of steps after t = 0: multiples of the step as decimal numbers (3 * 0.1 is 0.3); the last one is the end.

    Parameters
    ----------
    end
        Last time.
    step
        From one time to the next; in the same unit.

    Yields
    ------
    float
        Ascending; without 0.

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


# ---------------------------------------------------------------- stops on purpose, between two steps
# Asked for by a signal, or because the time that was given is over.

MARGIN = 1.2  # how much longer than those before it the next step may take
NOT_ASKED, BY_SIGNAL, BY_CLOCK = range(3)
REASONS = {BY_SIGNAL: "stopped by SIGUSR1", BY_CLOCK: "stopped before --max-wall-time is over"}


class Pause(Watcher):
    """Raises `Paused` after a step, on all ranks, if somebody asked for it or the next step would come too late."""

    def __init__(self, comm: MPI.Comm, folder: Path, asked: Callable[[], bool], deadline: float | None = None):
        self.comm, self.folder, self.asked, self.deadline = comm, folder, asked, deadline
        self._last = clock.monotonic()
        self._seconds = 0.0  # of a step with all that is written of it

    def started(self, step: Step) -> None:
        """Before the first step."""
        self._last = clock.monotonic()
        self._check(step)

    def resumed(self, step: Step) -> None:
        """Before the first step of this run."""
        self.started(step)

    def committed(self, step: Step) -> None:
        """After each step but the last."""
        now = clock.monotonic()
        self._seconds, self._last = max(0.5 * self._seconds, now - self._last), now
        if not step.is_last:
            self._check(step)

    def _check(self, step: Step) -> None:
        reason = BY_SIGNAL if self.asked() else NOT_ASKED
        if self.deadline is not None and self.comm.rank == 0 and not reason:
            late = clock.monotonic() + MARGIN * self._seconds > self.deadline
            reason = BY_CLOCK if late else NOT_ASKED
        asked = [one for one in self.comm.allgather(reason) if one]
        if asked:
            raise Paused(REASONS[asked[0]], step.time, self.folder)
