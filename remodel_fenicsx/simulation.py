"""Simulation of a scene: construction of its components, and time stepping."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from functools import partial

from dolfinx.fem import Function
from mpi4py import MPI

from remodel_fenicsx.body.domain import Domain
from remodel_fenicsx.body.loading import LoadValues, values_of_loads
from remodel_fenicsx.evolution.coupling import CouplingFactory
from remodel_fenicsx.evolution.stepper import FixedSteps, Step, Stepper, TimeStepping, Watcher
from remodel_fenicsx.fem.kinematics import NaturalConfiguration
from remodel_fenicsx.initial import (
    field_from_files,
    initial_states,
    measured_fibres,
    meshed,
    natural_gradient,
)
from remodel_fenicsx.model.energy import TURNED_OVER
from remodel_fenicsx.results.columns import Observer
from remodel_fenicsx.scene import Scene, SceneError
from remodel_fenicsx.schema.settings import Remodeling, Solver
from remodel_fenicsx.state import Snapshot, parameters_of
from remodel_fenicsx.system.interrupts import restore_signal_handlers
from remodel_fenicsx.watch import WATCHERS
from remodel_fenicsx.watch.stability import EquilibriumStability

log = logging.getLogger(__name__)

TIME_ERROR = "time_error"  # the column


class Simulation:
    """Simulation of a scene, ready for time stepping.

    Parameters
    ----------
    scene
        The validated scene.
    comm
        MPI communicator of the mesh.
    domain
        Mesh of the scene's body in place of the mesh that the scene specifies.
    coupling
        Factory of a coupling in place of the coupling that the scene names.

    Attributes
    ----------
    domain, unknown, quadrature, cells, loading, state, tissue, stepper, observer
        Components of the simulation, each usable alone (see demos/).
    time_stepping
        Time stepping: constant steps, adaptive steps if the scene has a tolerance, or
        steps to the steady state.
    watchers
        Watchers of the steps, in order: stability of equilibria, the observer, those of
        `extend.WATCHERS`, of the processes, and of further load cases. Numbers that they
        keep between steps belong to the state, so that a resumed run has them too.

    Raises
    ------
    SceneError
        If `domain` is not a mesh of the scene's body and elements.
    TypeError
        If `scene` is not a `Scene`.

    Examples
    --------
    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> scene = preset_scene("kuhl-holzapfel-2007", "cube").with_values({"time.end": 2.0})
    >>> simulation = Simulation(scene)
    >>> for step in simulation.steps():
    ...     print(step.time, round(step.row["mean_stretch"], 3))
    1.0 1.081
    2.0 1.172
    >>> simulation.cells.dimension_values.shape  # l_I of this rank, (elements, points, 3)
    (1, 8, 3)
    >>> simulation.close()
    """

    def __init__(
        self,
        scene: Scene,
        comm: MPI.Intracomm = MPI.COMM_WORLD,
        domain: Domain | None = None,
        coupling: CouplingFactory | None = None,
    ):
        if not isinstance(scene, Scene):
            raise TypeError(
                f"not a Scene: {scene!r}; use read_scene(PATH) for a file, "
                "preset_scene(PAPER, BODY) for a preset"
            )
        restore_signal_handlers()
        self.scene, self.domain, self.stepper, self.observer, self.time_stepping = build(
            scene, comm, domain, coupling
        )
        self.state = self.stepper.state
        self.unknown, self.cells = self.state.unknown, self.state.cells
        self.loading = self.state.loading
        self.quadrature, self.tissue = self.cells.quadrature, self.stepper.tissue
        self.watchers = watchers(self.scene, self.stepper, self.observer)

    def load_values(self, time: float, case: int = 0) -> LoadValues:
        """Return the magnitudes of all loads at a time.

        Parameters
        ----------
        time
            The time.
        case
            Index of the load case from 0, one less than `Step.case`.
        """
        return values_of_loads(self.scene.each_case()[case].loads, time)

    def steps(self, watchers: Sequence[Watcher] = ()) -> Iterator[Step]:
        """Solve and remodel from the present state, and yield each accepted step.

        The row and the fields belong to the solved state. With the couplings "staggered" and
        "relaxed", the cells have already made the next remodeling pass when a step is yielded
        (docs/time_integration.md, Couplings).

        Parameters
        ----------
        watchers
            Additional watchers; those of the simulation come first.

        Yields
        ------
        Step
            The accepted steps.

        Raises
        ------
        StepFailure
            If a step has no admissible equilibrium.
        """
        return self.time_stepping.march([*self.watchers, *watchers])

    def close(self) -> None:
        """Free PETSc's objects and options."""
        for watcher in self.watchers:
            watcher.close()
        self.stepper.close()


def build(
    scene: Scene,
    comm: MPI.Intracomm,
    domain: Domain | None,
    coupling: CouplingFactory | None,
) -> tuple[Scene, Domain, Stepper, Observer, TimeStepping]:
    """Return the resolved scene, mesh, stepper, observer and time stepping. Collective."""
    scene, domain = meshed(scene, comm, domain)
    fibres = measured_fibres(scene, domain)
    state, *further_states = initial_states(scene, domain, fibres)
    if further_states and coupling is not None:
        raise SceneError("cases: a custom coupling solves one load case; remove [[cases]]")
    tissue, kappa = parameters_of(scene.properties(), domain)
    solver = _solver(scene)
    loads, *further_loads = (partial(values_of_loads, case.loads) for case in scene.each_case())
    stepper = Stepper(state, tissue, _remodeling(scene), solver, loads, coupling, kappa)
    for process in stepper.remodels:
        process.set_initial(
            partial(field_from_files, fibres, quadrature=state.cells.quadrature, domain=domain)
        )
    if further_states:
        from remodel_fenicsx.evolution import load_cases

        weights = [case.weight for case in scene.cases]
        load_cases.join(stepper, further_states, further_loads, weights, solver, kappa)
    time_stepping = _time_stepping(scene, stepper)
    additional_columns = {TIME_ERROR} - {*scene.output.columns} if scene.time.is_adaptive else set()
    observer = Observer(scene.geometry, stepper, scene.columns(additional_columns))
    return scene, domain, stepper, observer, time_stepping


def _solver(scene: Scene) -> Solver:
    """Return the solver settings, without the predictor 'with-tolerance' if steps are constant."""
    # 'with-tolerance' predicts only in adaptive steps and on the path to the steady state.
    solver, time = scene.solver, scene.time
    if solver.predictor == "with-tolerance" and time.tolerance is None and not time.is_equilibrium:
        return solver.model_copy(update={"predictor": "none"})
    return solver


def _remodeling(scene: Scene) -> Remodeling:
    """Return the remodeling settings, with 'relaxed' if the path to a steady state oscillates."""
    # When the driver's principal values change their order, random cells jump, however small the
    # step, and the passes oscillate.
    if not (scene.time.is_equilibrium and scene.has_random_cells and scene.cell_order_can_change):
        return scene.remodeling
    log.info(
        "the path to the steady state uses the coupling 'relaxed', because random cells would "
        "otherwise oscillate"
    )
    return scene.remodeling.model_copy(update={"coupling": "relaxed"})


def _time_stepping(scene: Scene, stepper: Stepper) -> TimeStepping:
    """Return the time stepping: constant steps, adaptive steps, or steps to the steady state."""
    time, stops = scene.time, scene.stops()
    if not (time.is_equilibrium or time.is_adaptive or TIME_ERROR in scene.output.columns):
        return FixedSteps(stepper, time.end, time.step)
    from remodel_fenicsx.evolution.time_steps import StepControl, TimeError

    if time.is_adaptive and time.tolerance is not None:
        return StepControl(stepper, time.tolerance, time.step, stops)
    if not time.is_equilibrium:
        return FixedSteps(stepper, time.end, time.step, TimeError(stepper).measure)
    from remodel_fenicsx.evolution import homeostasis

    unloads = any(load.decreases for load in scene.loads.values())
    tolerance = time.tolerance or (
        homeostasis.UNLOADING_PATH_TOLERANCE if unloads else homeostasis.PATH_TOLERANCE
    )
    if scene.has_random_cells and scene.cell_order_can_change:
        tolerance = homeostasis.NO_ERROR_CONTROL
    plan = homeostasis.PathToSteadyState(
        scene.last_time,
        stops,
        time.step,
        tolerance,
        last_load_change=max(stops[:-1], default=0.0),
        first_hold=scene.hold_before_change,
    )
    return homeostasis.Homeostasis(stepper, plan)


def watchers(scene: Scene, stepper: Stepper, observer: Observer) -> list[Watcher]:
    """Return the watchers in order; each load case checks its stability before its warnings."""
    unstable = scene.solver.unstable
    counted = "negative_eigenvalues" in scene.output.columns
    candidates: list[Watcher | None] = [
        EquilibriumStability(stepper, unstable, every_step=counted),
        observer,
    ]
    candidates += [kind.make(scene, stepper) for kind in WATCHERS.values()]
    candidates += [
        make(scene, stepper) for process in stepper.remodels for make in process.watchers
    ]
    for case in stepper.load_cases[1:]:
        case_watchers: list[Watcher | None] = [EquilibriumStability(case, unstable)]
        case_watchers += [
            kind.make(scene, case) for kind in WATCHERS.values() if kind.checks_each_case
        ]
        candidates += [
            case.adapt_watcher(watcher) for watcher in case_watchers if watcher is not None
        ]
    return [watcher for watcher in candidates if watcher is not None]


def reset_simulation(simulation: Simulation, start: Snapshot, scene: Scene) -> bool:
    """Reset a simulation to a scene with other numbers; return False if it must be rebuilt."""
    # The numbers are those of tissue, kappa, loads and residual stress.
    tissue, kappa = parameters_of(scene.properties(), simulation.domain)
    stepper, kinematics = simulation.stepper, simulation.state.kinematics
    parameters = stepper.tissue.parameters
    varies = {name: isinstance(value, Function) for name, value in tissue.parameters.items()}
    # Adaptive time stepping, growth and solver.unstable = 'stop' keep copies of scene values, which
    # a reset would not update.
    has_variable_steps = not isinstance(simulation.time_stepping, FixedSteps)
    must_rebuild = has_variable_steps or kinematics.grows or scene.solver.unstable == "stop"
    if (
        must_rebuild
        or parameters.keys() - TURNED_OVER != varies.keys()
        or any(varies[name] and not isinstance(parameters[name], Function) for name in varies)
    ):
        return False
    for name, value in tissue.parameters.items():
        present = parameters[name]
        numbers = present.x.array if isinstance(present, Function) else present.value
        numbers[...] = value.x.array if varies[name] else value
    stepper.replace_loads_and_kappa(partial(values_of_loads, scene.loads), kappa)
    simulation.state.restore(start)
    if isinstance(kinematics, NaturalConfiguration) and not scene.natural.fibres:
        cells, quadrature = simulation.cells, simulation.quadrature
        values, kinematics.closed_ring = natural_gradient(
            scene, quadrature, simulation.domain, cells.local_axes
        )
        quadrature.values(kinematics.gradient, (3, 3))[:] = values
    simulation.scene = scene
    return True
