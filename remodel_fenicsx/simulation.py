"""A scene brought to life: builds the parts in their order and steps them through time."""

from __future__ import annotations

import logging
import time as clock
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import basix.ufl
import dolfinx.fem
from mpi4py import MPI

from remodel_fenicsx import body as geometry
from remodel_fenicsx.fem import jit
from remodel_fenicsx.tissue.cells import UnitCells
from remodel_fenicsx.system.environment import versions
from remodel_fenicsx.system.interrupts import Interrupted, StopRequest, end_all_ranks_on_exception
from remodel_fenicsx.body.loading import LOADINGS, LoadValues
from remodel_fenicsx.results.columns import Observer
from remodel_fenicsx.fem.quadrature import Quadrature
from remodel_fenicsx.results.run_folder import Fields, RunFolder, chosen_folder, history_row
from remodel_fenicsx.evolution.remodeling import RemodelingPass
from remodel_fenicsx.scene.scene import Scene
from remodel_fenicsx.evolution.stepper import StepFailure, Stepper, times
from remodel_fenicsx.system.terminal import Progress, announce, open_log

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StepRecord:
    """An accepted step: its time and its row of the history."""

    time: float
    row: dict[str, float]


class Simulation:
    """Everything that a scene needs, built and ready to step.

    Parameters
    ----------
    scene
        The validated scene.
    comm
        MPI communicator of the mesh.
    domain
        A mesh of the scene's body to take in place of the one that the scene asks for; its cell type and degree must
        be the scene's.

    Attributes
    ----------
    domain, displacement, quadrature, cells, loading, remodeling, stepper, observer
        The parts, each usable by itself (see demos/).
    """

    def __init__(self, scene: Scene, comm: MPI.Intracomm = MPI.COMM_WORLD, domain: geometry.Domain | None = None):
        self.scene = scene
        self.domain = domain or geometry.build(scene.geometry, scene.mesh, comm)
        mesh = self.domain.mesh
        element = basix.ufl.element("Lagrange", mesh.topology.cell_name(), scene.mesh.degree, shape=(3,))
        self.displacement = dolfinx.fem.Function(dolfinx.fem.functionspace(mesh, element), name="displacement")
        self.quadrature = Quadrature(mesh, scene.mesh.degree)
        self.cells = UnitCells(self.quadrature, self.domain.cell_number, self.domain.number_of_cells, scene.cells)
        self.loading = LOADINGS[self.domain.shape](self.domain, self.displacement)
        self.remodeling = RemodelingPass(self.displacement, self.cells, scene.material, scene.remodeling)
        self.stepper = Stepper(
            self.displacement,
            self.loading,
            self.cells,
            scene.material,
            self.remodeling,
            scene.solver,
            self.load_values,
        )
        self.observer = Observer(self.domain, self.displacement, self.loading, self.cells, scene.material)

    def load_values(self, time: float) -> LoadValues:
        """Magnitude of every load at a time."""
        return {name: load.value * load.factor(time) for name, load in self.scene.loads.items()}

    def steps(self, fields: Fields | None = None) -> Iterator[StepRecord]:
        """Solve and remodel step by step; what is yielded has been accepted.

        The state seen at a yield is one pass ahead of the row: the row and the fields belong to the solved state,
        before the remodeling pass (docs/theory.md).

        Raises
        ------
        stepping.StepFailure
            If a step has no admissible equilibrium.
        """
        self.remodeling.warn_of_overcorrection()
        if fields is not None:
            fields.append(0.0)
        every = self.scene.output.every
        for number, time in enumerate(times(self.scene.time.end, self.scene.time.step), start=1):
            start = clock.perf_counter()
            solved = self.stepper.solve(time)
            columns = self.observer.columns()
            if fields is not None and (number % every == 0 or time >= self.scene.time.end * (1 - 1e-12)):
                fields.append(time)
            energy = self.stepper.problem.stored_energy()
            power = self.stepper.remodel(time)
            yield StepRecord(time, history_row(solved, columns, energy, power, clock.perf_counter() - start))


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
    record.FolderTaken
        If the folder is not empty.
    stepping.StepFailure
        If a step has no admissible equilibrium; all steps before it are recorded.
    interrupts.Interrupted
        On SIGINT or SIGTERM; all accepted steps are recorded.
    OSError
        If the results cannot be written.
    """
    end_all_ranks_on_exception()
    # what the scene asks for is built before anything is written
    place = None if folder is None else chosen_folder(folder, scene.name, comm)
    if not quiet and comm.rank == 0 and jit.is_cold():
        announce("compiling the forms of the model, once on this machine: about half a minute")
    simulation = Simulation(scene, comm)
    place = place or chosen_folder(None, scene.name, comm)
    header = "as run: all values, also those of preset and defaults\n" + "\n".join(
        f"{name} {version}" for name, version in versions().items()
    )
    with (
        RunFolder(place, scene.to_toml(header), comm.rank) as record,
        open_log(place / "run.log", comm.rank),
        StopRequest() as stop,
        Progress(scene.time.number_of_steps, scene.name, -1 if quiet else comm.rank) as progress,
    ):
        log.info("scene %s on %d ranks, results in %s", scene.name, comm.size, place)
        log.info("%s", scene.summary())
        for warning in scene.warnings():
            log.warning("%s", warning)
        try:
            _record_steps(simulation, record, progress, stop)
        except (StepFailure, Interrupted) as reason:
            log.info("ended: %s", reason)
            raise
        log.info("finished")
    return place


def _record_steps(simulation: Simulation, record: RunFolder, progress: Progress, stop: StopRequest) -> None:
    """Step through the scene; each accepted step is on disk before the next one starts."""
    scene = simulation.scene
    simulation.stepper.problem.stop_signal = lambda: stop.number
    if scene.output.fields:
        record.fields = Fields(record.folder, simulation.domain, simulation.observer)
    for number, step in enumerate(simulation.steps(record.fields), start=1):
        record.append(step.row)
        log.info("%s", ", ".join(f"{name} {value:.6g}" for name, value in step.row.items()))
        parts = int(step.row["substeps"])
        message = f"time {step.time:g} solved in {parts} parts" if parts > 1 else None
        progress.step(number, step.time, _loads(step.row), int(step.row["newton_iterations"]), message)


def _loads(row: dict[str, float]) -> str:
    names = ("force", "pressure", "axial_stretch")
    return ", ".join(f"{name} {row[name]:.4g}" for name in names if name in row)
