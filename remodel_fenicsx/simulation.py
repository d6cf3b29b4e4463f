"""A scene brought to life: builds the parts in their order and steps them through time."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

from mpi4py import MPI

from remodel_fenicsx.body.domain import Domain
from remodel_fenicsx.body.loading import Loading, LoadValues
from remodel_fenicsx.evolution.locking import LockingWarning
from remodel_fenicsx.evolution.parts import StepFailure
from remodel_fenicsx.evolution.state import State
from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher, times
from remodel_fenicsx.evolution.unit_cells import UnitCells
from remodel_fenicsx.fem.formulations import FORMULATIONS
from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.fem.quadrature import Quadrature
from remodel_fenicsx.results.columns import COLUMNS_ON_REQUEST, Observer, columns_of
from remodel_fenicsx.results.fields import Fields
from remodel_fenicsx.results.run_folder import RunFolder, chosen_folder
from remodel_fenicsx.scene import Scene, SceneError
from remodel_fenicsx.system.environment import versions
from remodel_fenicsx.system.interrupts import (
    Interrupted,
    StopRequest,
    end_all_ranks_on_exception,
    stopping_at_once,
    take_back_signals,
)
from remodel_fenicsx.system.terminal import Progress, hold_log, open_log

log = logging.getLogger(__name__)


class Simulation:
    """Everything that a scene needs, built and ready to step.

    Parameters
    ----------
    scene
        The validated scene.
    comm
        MPI communicator of the mesh.
    domain
        A mesh of the scene's body to take in place of the one that the scene asks for.

    Attributes
    ----------
    domain, unknown, quadrature, cells, loading, state, tissue, stepper, observer
        The parts, each usable by itself (see demos/).

    Raises
    ------
    SceneError
        If `domain` is not a mesh of the scene's body and elements.
    """

    def __init__(self, scene: Scene, comm: MPI.Intracomm = MPI.COMM_WORLD, domain: Domain | None = None):
        take_back_signals()
        self.scene, shape = scene, scene.geometry
        self.domain = checked_domain(shape.build(scene.mesh, comm) if domain is None else domain, scene)
        mesh, kinematics = self.domain.mesh, KINEMATICS[scene.model.kinematics]
        self.unknown = kinematics.unknown(mesh, scene.mesh.degree)
        self.quadrature = Quadrature(mesh, scene.mesh.degree)
        domain = self.domain
        self.cells = UnitCells(self.quadrature, domain.element_number, domain.number_of_elements, scene.cells)
        self.loading = Loading(domain, self.unknown, kinematics)
        shape.support(self.loading)
        formulation = FORMULATIONS[scene.mesh.formulation]
        self.state = State(self.unknown, kinematics, self.cells, self.loading, formulation)
        tissue = scene.material.tissue(scene.cells.end_to_end_length)
        self.stepper = Stepper(self.state, tissue, scene.remodeling, scene.solver, self.load_values)
        self.tissue = self.stepper.tissue
        self.observer = Observer(shape, self.stepper, columns_of(shape, checked_columns(scene.output.columns)))

    def load_values(self, time: float) -> LoadValues:
        """Magnitude of every load at a time."""
        return {name: load.value * load.factor(time) for name, load in self.scene.loads.items()}

    def steps(self, watchers: Sequence[Watcher] = ()) -> Iterator[Step]:
        """Solve and remodel step by step; what is yielded has been accepted.

        The state seen at a yield is one pass ahead of the row: the row and the fields belong to the solved state,
        before the remodeling pass (docs/theory.md).

        Parameters
        ----------
        watchers
            Who else follows the steps; the observer, which fills each step's row, comes first.

        Raises
        ------
        StepFailure
            If a step has no admissible equilibrium.
        """
        self.stepper.remodeling.warn_of_overcorrection(self.stepper.coupling.share)
        ways = times(self.scene.time.end, self.scene.time.step)
        mesh = self.scene.mesh
        locking = LockingWarning(self.stepper, FORMULATIONS[mesh.formulation].locks(mesh.element, mesh.degree))
        return self.stepper.march(ways, [self.observer, locking, *watchers])

    def close(self) -> None:
        """Free PETSc's objects and options."""
        self.stepper.close()


def checked_columns(names: Sequence[str]) -> Sequence[str]:
    """The names, if they are columns on request.

    Raises
    ------
    SceneError
        If one is not; one line that names the key.
    """
    for name in names:
        if name not in COLUMNS_ON_REQUEST:
            known = ", ".join(map(repr, COLUMNS_ON_REQUEST))
            raise SceneError(f"output.columns = {name!r}: no such column on request; allowed are {known}")
    return names


def checked_domain(domain: Domain, scene: Scene) -> Domain:
    """The domain, if it is a mesh of the scene's body and elements.

    Raises
    ------
    SceneError
        If it is not; one line that names the key.
    """
    shape, mesh = scene.geometry, domain.mesh
    kind, degree = mesh.topology.cell_name(), mesh.geometry.cmap.degree
    if domain.shape != shape.name:
        raise SceneError(f"geometry.shape = {shape.name!r}: the mesh is a {domain.shape!r}")
    if kind != scene.mesh.element:
        raise SceneError(f"mesh.element = {scene.mesh.element!r}: the mesh has elements of type {kind!r}")
    if degree != scene.mesh.degree:
        raise SceneError(f"mesh.degree = {scene.mesh.degree}: the mesh has degree {degree}")
    missing = [face for face in shape.faces if face not in domain.faces]
    if missing:
        raise SceneError(f"geometry.shape = {shape.name!r}: the mesh has no face {', '.join(missing)}")
    for name, value in domain.dimensions.items():
        wanted = getattr(shape, name, value)
        if abs(wanted - value) > 1e-9 * domain.size:
            raise SceneError(f"geometry.{name} = {wanted:g}: that of the mesh is {value:g}")
    return domain


def run(
    scene: Scene, folder: Path | str | None = None, comm: MPI.Intracomm = MPI.COMM_WORLD, quiet: bool = True
) -> Path:
    """Run a scene and record it.

    Parameters
    ----------
    scene
        The validated scene.
    folder
        New or empty folder for the results; default: results/NAME, numbered when taken.
    comm
        MPI communicator.
    quiet
        No progress on the terminal.

    Returns
    -------
    The folder with history.csv, fields.vtkhdf, fields_chains.vtkhdf, scene.toml and run.log.

    Raises
    ------
    FolderTaken
        If the folder is not empty.
    StepFailure
        If a step has no admissible equilibrium; all steps before it are recorded.
    Interrupted
        On SIGINT, SIGTERM or SIGHUP; all accepted steps are recorded.
    OSError
        If the results cannot be written.
    """
    end_all_ranks_on_exception()
    # what the scene asks for is built before anything is written
    place = None if folder is None else chosen_folder(folder, scene.name, comm)
    with StopRequest() as stop:
        with hold_log(comm.rank, quiet=quiet) as held:
            simulation = _built(scene, comm)
            place = place or chosen_folder(None, scene.name, comm)
        _record(simulation, place, stop, quiet, held)
    return place


def _built(scene: Scene, comm: MPI.Intracomm) -> Simulation:
    try:
        with stopping_at_once():
            return Simulation(scene, comm)
    except Interrupted as interruption:
        interruption.kept = "nothing was computed"
        raise


def _record(simulation: Simulation, place: Path, stop: StopRequest, quiet: bool, held: list[logging.LogRecord]) -> None:
    scene, comm = simulation.scene, simulation.domain.mesh.comm
    header = "as run: all values, also those of preset and defaults\n" + "\n".join(
        f"{name} {version}" for name, version in versions().items()
    )
    with ExitStack() as stack:
        record = stack.enter_context(RunFolder(place, scene.to_toml(header), comm.rank))
        stack.enter_context(open_log(place / "run.log", comm.rank, quiet=quiet, held=held))
        progress = stack.enter_context(Progress(scene.time.number_of_steps, scene.name, -1 if quiet else comm.rank))
        log.info("scene %s on %d ranks, results in %s", scene.name, comm.size, place)
        log.info("%s", scene.summary())
        for warning in scene.warnings():
            log.warning("%s", warning)
        watchers: list[Watcher] = []
        if scene.output.fields:
            fields = Fields(place, scene.geometry, simulation.stepper, scene.output.every)
            watchers.append(stack.enter_context(fields))
        watchers += [record, _Report(scene, progress)]
        simulation.stepper.stop_signal = lambda: stop.number
        try:
            for _ in simulation.steps(watchers):
                pass
        except (StepFailure, Interrupted) as reason:
            log.info("ended: %s", reason)
            simulation.close()  # all ranks have this exception; after any other one they would wait for ever
            raise
        simulation.close()
        log.info("finished")


class _Report(Watcher):
    """Each accepted step in the log and on the terminal."""

    def __init__(self, scene: Scene, progress: Progress):
        self.progress = progress
        self.loads = [kind.column or name for name, kind in scene.geometry.loads.items()]

    def committed(self, step: Step) -> None:
        """Say it."""
        log.info("%s", ", ".join(f"{name} {value:.6g}" for name, value in step.row.items()))
        parts = step.work.substeps
        message = f"time {step.time:g} solved in {parts} parts" if parts > 1 else None
        loads = ", ".join(f"{name} {step.row[name]:.4g}" for name in self.loads if name in step.row)
        self.progress.step(step.number, step.time, loads, step.work.newton_iterations, message)
