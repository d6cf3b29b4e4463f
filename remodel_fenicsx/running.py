"""Recorded runs: start a run in a folder, resume one, and write files before any solve."""

from __future__ import annotations

import hashlib
import logging
import shutil
import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from remodel_fenicsx.evolution.stepper import Pause, Step, Watcher
from remodel_fenicsx.fem.quadrature import Quadrature
from remodel_fenicsx.fem.assembly import raise_on_all_ranks
from remodel_fenicsx.results.checkpoint import Checkpoints, restore_state
from remodel_fenicsx.results.checkpoint_file import Checkpoint, CheckpointError, read_checkpoint
from remodel_fenicsx.results.export import write_vtu
from remodel_fenicsx.results.fields import Fields, field_names, local_fields
from remodel_fenicsx.results.recording import (
    LOCK,
    LOG,
    RecordingError,
    RunLock,
    SCENE,
    scene_as_run,
    versions_as_run,
)
from remodel_fenicsx.results.run_folder import (
    LastStep,
    RunFolder,
    check_before_resuming,
    chosen_folder,
    remove_partial_results,
    locked,
)
from remodel_fenicsx.results.status import BEGUN, FAILED, OVERRIDE, STOPPED
from remodel_fenicsx.results.vtkhdf import vtk_cells
from remodel_fenicsx.scene import Scene, SceneError, read_scene, scene_from_dict
from remodel_fenicsx.scene.scene import check_continuation, leaves
from remodel_fenicsx.schema.settings import in_region
from remodel_fenicsx.schema.tables import format_value
from remodel_fenicsx.schema.text import read_toml
from remodel_fenicsx.initial import checked_domain, mesh_of, resolve_auto_settings
from remodel_fenicsx.simulation import Simulation
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.system import NOTICE, interrupts
from remodel_fenicsx.system.environment import check_extensions, versions
from remodel_fenicsx.system.files import TakenError, partial_path, read_regular
from remodel_fenicsx.system.children import LARGEST_FILE
from remodel_fenicsx.system.terminal import Progress, announce, buffer_log, open_log
from remodel_fenicsx.unloading import as_unloaded, unloaded

log = logging.getLogger(__name__)


def run(
    scene: Scene,
    folder: Path | str | None = None,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    quiet: bool = True,
    deadline: float | None = None,
    report: bool = True,
    watchers: Sequence[Watcher | Callable[[Simulation], Watcher]] = (),
    overrides: Sequence[str] = (),
) -> Path:
    """Run a scene and record the results.

    Parameters
    ----------
    scene
        The validated scene.
    folder
        New or empty folder for the results. Default: results/NAME, numbered if it exists.
    comm
        MPI communicator.
    quiet
        Show no progress on the terminal.
    deadline
        Value of `time.monotonic` before which the run stops, between two steps. None: no limit.
    report
        Whether to write report.html at the end, unless the scene sets `output.report = false`.
    watchers
        Further watchers, or functions that make one from the `Simulation`. They see each step
        before it is recorded. Watchers for every run are in `extend.WATCHERS`.
    overrides
        "KEY=VALUE" with which the scene was read, for run.log and the report.

    Returns
    -------
    Path
        The folder with history.csv, fields.vtkhdf, fields_chains.vtkhdf, scene.toml, run.log,
        report.html and the checkpoints.

    Raises
    ------
    FolderTaken
        If the folder is not empty.
    StepFailure
        If a step has no admissible equilibrium. The steps before it are recorded, with a
        checkpoint.
    Interrupted
        On SIGINT, SIGTERM or SIGHUP. All accepted steps are recorded.
    Paused
        On SIGUSR1, or before the deadline. All steps are recorded, with a checkpoint.
    OSError
        If the results cannot be written.

    Examples
    --------
    >>> from remodel_fenicsx import preset_scene, run
    >>> scene = preset_scene("kuhl-holzapfel-2007", "cube").with_values({"time.end": 1.0})
    >>> folder = run(scene, "one-step", report=False)
    >>> sorted(path.name for path in folder.glob("*.vtkhdf"))
    ['fields.vtkhdf', 'fields_chains.vtkhdf']
    >>> run(scene, "one-step")
    Traceback (most recent call last):
        ...
    remodel_fenicsx.results.recording.FolderTaken: folder one-step: is not empty; ...
    """
    interrupts.end_all_ranks_on_exception()
    # The simulation is built before anything is written.
    place = None if folder is None else chosen_folder(folder, scene.name, comm)
    with interrupts.StopRequest() as stop, ExitStack() as body:
        with buffer_log(comm.rank, quiet=quiet) as held:
            _log_overrides(overrides)
            scene = body.enter_context(as_unloaded(scene, comm, quiet))
            stored = comm.bcast(
                raise_on_all_ranks(
                    comm, lambda: _files_to_store(scene)[0] if comm.rank == 0 else {}
                )
            )
            # A file that is replaced after this point is refused, so the stored files are those
            # that are read.
            if sums := {key: value for key, value in stored.items() if key.endswith("sha256")}:
                scene = scene.with_values(sums)
            simulation = body.enter_context(_open_simulation(scene, comm))
            place = place or chosen_folder(None, scene.name, comm)
        with locked(place, comm, new=True):
            followers = [one if isinstance(one, Watcher) else one(simulation) for one in watchers]
            _record(simulation, place, stop, held, quiet, deadline, report, watchers=followers)
    return place


def resume(
    folder: Path | str,
    overrides: Sequence[str] = (),
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    quiet: bool = True,
    deadline: float | None = None,
    report: bool = True,
) -> Path:
    """Resume a recorded run from its last checkpoint, or from t = 0 if it has none. Collective."""
    interrupts.end_all_ranks_on_exception()
    place = Path(folder)
    with interrupts.StopRequest() as stop, locked(place, comm, new=False), ExitStack() as body:
        with buffer_log(comm.rank, quiet=quiet) as held:
            _log_overrides(overrides)
            scene, checkpoint = _read_run(place, overrides, comm)
            simulation = body.enter_context(_open_simulation(scene, comm))
            if comm.bcast(checkpoint is not None):
                restore_state(simulation.state, checkpoint)
        _record(simulation, place, stop, held, quiet, deadline, report, resumes=True)
    return place


def _log_overrides(overrides: Sequence[str]) -> None:
    for override in overrides:
        log.info(OVERRIDE + "%s", override)


def _read_run(
    place: Path, overrides: Sequence[str], comm: MPI.Intracomm
) -> tuple[Scene, Checkpoint | None]:
    """Return scene, and checkpoint on rank 0, of a run to resume; raise errors on all ranks."""

    def read() -> tuple[Scene, Checkpoint | None]:
        begun = versions_as_run(place)
        check_extensions(begun, place)
        try:
            scene = read_scene(place / SCENE, overrides)
        except SceneError:
            # A corrupt folder raises its own error here; otherwise the overrides are wrong.
            scene_as_run(place)
            raise
        checkpoint, values = read_checkpoint(place), read_toml(place / SCENE)
        if checkpoint is None:
            log.info("no checkpoint: restarting at t = 0")
        else:
            try:
                before = tomllib.loads(checkpoint.scene)
            except (tomllib.TOMLDecodeError, RecursionError) as error:
                raise CheckpointError(f"the checkpoint's scene is not TOML: {error}") from error
            check_continuation(scene_from_dict(before), scene, checkpoint.time)
            _check_complete(values, before, place)
            log.info(
                "resumes from the checkpoint of time %g, step %d",
                checkpoint.time,
                checkpoint.number,
            )
            begun = checkpoint.versions
        now = versions()
        for name, version in begun.items():
            if now.get(name) != version:
                log.warning(
                    "resumes with %s %s, but was started with %s", name, now.get(name), version
                )
        return scene, checkpoint

    scene, checkpoint = raise_on_all_ranks(comm, lambda: read() if comm.rank == 0 else (None, None))
    return comm.bcast(scene), checkpoint


def _check_complete(values: dict[str, Any], before: dict[str, Any], place: Path) -> None:
    """Check that a recorded scene has all values: a truncated file could be valid with defaults."""
    had, has = (dict(leaves(scene, ("loads",))) for scene in (before, values))
    if lost := had.keys() - has.keys():
        rule = f"lacks {min(lost)}, which the run had; add the key with its old or a new value"
        raise RecordingError(f"{place / SCENE}: {rule}")


@contextmanager
def _open_simulation(scene: Scene, comm: MPI.Intracomm) -> Iterator[Simulation]:
    """Open a simulation and close it on exit, unless only some ranks have raised. Collective."""
    try:
        with interrupts.raise_on_signal(), _petsc_errors_as_scene_errors(scene):
            simulation = Simulation(scene, comm)
    except interrupts.Interrupted as interruption:
        interruption.kept = "nothing was computed"
        raise
    try:
        yield simulation
    except BaseException as error:
        if _is_on_all_ranks(error, comm):
            simulation.close()
        raise
    simulation.close()


def _is_on_all_ranks(error: BaseException, comm: MPI.Intracomm) -> bool:
    """Return whether all ranks have raised the error and may call collective functions."""
    return comm.size == 1 or getattr(error, "on_all_ranks", False)


@contextmanager
def _petsc_errors_as_scene_errors(scene: Scene) -> Iterator[None]:
    """Raise PETSc errors as a SceneError on solver.petsc_options, if the scene sets any."""
    try:
        yield
    except PETSc.Error as error:
        if not (given := scene.solver.petsc_options):
            raise
        rule = f"PETSc rejects them (error {error.ierr}); PETSc's manual pages list all options"
        raise SceneError(f"solver.petsc_options = {format_value(given)}: {rule}") from error


def _record(
    simulation: Simulation,
    place: Path,
    stop: interrupts.StopRequest,
    held: list[logging.LogRecord],
    quiet: bool,
    deadline: float | None,
    report: bool,
    resumes: bool = False,
    watchers: Sequence[Watcher] = (),
) -> None:
    """Run a simulation in its folder; `held` has the log records of its construction."""
    scene, state = simulation.scene, simulation.state
    comm = simulation.domain.comm
    header = "as run: all values, also those of preset and defaults\n" + "\n".join(
        f"{name} {version}" for name, version in versions().items()
    )
    scene, files = raise_on_all_ranks(
        comm, lambda: with_stored_files(scene) if comm.rank == 0 else (scene, {})
    )
    text = scene.to_toml(header)
    columns = [column.name for column in simulation.observer.columns]
    wants_report = report and scene.output.report and comm.rank == 0
    after = LastStep(columns, state.number, state.time) if state.number else None
    if resumes:
        wanted = bool(scene.output.fields)
        raise_on_all_ranks(
            comm, lambda: check_before_resuming(place, after, wanted) if comm.rank == 0 else None
        )
        if after is None and comm.rank == 0:
            remove_partial_results(place)
    with ExitStack() as stack:
        record = stack.enter_context(
            raise_on_all_ranks(
                comm, lambda: RunFolder(place, text, comm.rank, after, {} if resumes else files)
            )
        )
        stack.enter_context(open_log(place / LOG, comm.rank, quiet=quiet, held=held))
        steps = (
            scene.time.number_of_steps
            if scene.time.is_adaptive
            else state.number + len(simulation.time_stepping.remaining())
        )
        silent, done = quiet or comm.rank != 0, scene.time.progress(state.number, state.time)
        progress = stack.enter_context(Progress(steps, scene.name, silent, done=done))
        ranks = "1 rank" if comm.size == 1 else f"{comm.size} ranks"
        log.info(BEGUN + "%s on %s, results in %s", scene.name, ranks, place)
        log.info("%s", scene.summary())
        # This scene has the paths of its files; `scene` has their names in the run's folder.
        for warning in simulation.scene.warnings(simulation.domain):
            log.warning("%s", warning)
        followers, kept = list(watchers), [record.flush]
        if scene.output.fields:
            names = field_names(
                scene.output.fields, scene.lacking_fields, scene.geometry.constant_fields
            )
            parts = (
                place,
                scene.geometry,
                simulation.stepper,
                scene.output.every,
                after and after.time,
                names,
            )
            times = scene.output.times
            fields = stack.enter_context(raise_on_all_ranks(comm, lambda: Fields(*parts, times)))
            followers, kept = [*followers, fields], [*kept, fields.close]
        checkpoints = Checkpoints(place, state, text, scene.output.checkpoint, kept)
        pause = Pause(comm, place, lambda: stop.pause, deadline)
        followers += [record, _StepLog(scene, progress), checkpoints, pause]
        leave_report = partial(_try_report, place) if wants_report else lambda: None
        simulation.state.tell = progress.show
        simulation.state.stop_signal = lambda: stop.number
        try:
            with _petsc_errors_as_scene_errors(scene):
                for _ in simulation.steps(followers):
                    pass
        except (StepFailure, interrupts.Interrupted, interrupts.Paused) as reason:
            if isinstance(reason, StepFailure):
                log.info(FAILED + "%s. %s", reason, reason.refusal)
                reason.kept += ", and run --resume continues from there"
            else:
                log.info(STOPPED + "%s", reason)
            if _is_on_all_ranks(reason, comm):
                checkpoints.write()
            # Interrupted and paused runs must end soon, without a report.
            if not isinstance(reason, (interrupts.Interrupted, interrupts.Paused)):
                leave_report()
            raise
        except Exception as defect:
            with suppress(OSError):  # The disk may be full.
                log.info(FAILED + "%s: %s", type(defect).__name__, defect)
            raise
        log.info("finished")
        leave_report()


def with_stored_files(scene: Scene) -> tuple[Scene, dict[str, bytes]]:
    """Return the scene with file names relative to the run folder and SHA-256, and these files."""
    changes, files = _files_to_store(scene)
    return scene.with_values(changes) if changes else scene, files


def _files_to_store(scene: Scene) -> tuple[dict[str, object], dict[str, bytes]]:
    changes, files = scene.geometry.kept_files()
    for region, cells in scene.measured_cells.items():
        key, path = f"{in_region(region)}cells.fibres", Path(cells.fibres or "")
        name = f"fibres{'_' if region else ''}{region}{path.suffix.lower()}"
        try:
            files[name] = read_regular(path, LARGEST_FILE)
        except OSError as error:
            raise SceneError(
                f"{key} = {cells.fibres!r}: cannot be read: {error.strerror or error}"
            ) from error
        digest = hashlib.sha256(files[name]).hexdigest()
        if cells.fibres_sha256 not in (None, digest):
            raise SceneError(
                f"{key} = {cells.fibres!r}: has changed: its SHA-256 was {cells.fibres_sha256}"
            )
        changes |= {key: name, f"{key}_sha256": digest}
    return changes, files


def _try_report(place: Path) -> None:
    """Write the page of the run. Log a warning if that fails: the results are complete."""
    from remodel_fenicsx.report import REPORT, write_report

    try:
        write_report(place)
    except Exception as error:  # No error of the report may end a run whose results are complete.
        words = f"no {REPORT}: {' '.join(str(error).split()) or type(error).__name__}"
        try:
            log.warning("%s", words)
        except OSError:  # The disk is full.
            announce(f"WARNING: {words}")


class _StepLog(Watcher):
    """Watcher that writes each accepted step to the log and the terminal."""

    def __init__(self, scene: Scene, progress: Progress):
        self.progress, self.time = progress, scene.time
        self.loads = [kind.column or name for name, kind in scene.load_kinds.items()]

    def committed(self, step: Step) -> None:
        """Log the step's row and update the progress display."""
        log.info("%s", ", ".join(f"{name} {value:.6g}" for name, value in step.row.items()))
        if (parts := step.work.substeps) > 1:
            log.log(NOTICE, "time %g solved in %d substeps", step.time, parts)
        loads = [f"{name} {step.row[name]:.4g}" for name in self.loads if name in step.row]
        state = ", ".join([f"t = {step.time:g}", *loads, f"{step.work.newton_iterations} Newton"])
        count = (
            f"{step.number} at {step.time / self.time.end:.0%}" if self.time.is_adaptive else None
        )
        self.progress.step(self.time.progress(step.number, step.time), state, count)


# ---------------------------------------------------------------- before any solve
# The scene of the unloaded body, and the local axes on the mesh.


def write_unloaded(scene: Scene, folder: Path) -> None:
    """Write scene.toml of the unloaded body, and its mesh if it has one, into a new folder."""
    part = partial_path(folder)
    with RunLock(part), buffer_log(quiet=False):
        try:
            if folder.exists():
                raise TakenError(folder, "folder")
            with TemporaryDirectory(prefix="remodel-fenicsx-") as temporary:
                kept, files = with_stored_files(
                    unloaded(scene, MPI.COMM_SELF, Path(temporary), quiet=False)
                )
            for name, data in files.items():
                (part / name).write_bytes(data)
            (part / SCENE).write_text(
                kept.to_toml(f"the unloaded body of {scene.name}"), encoding="utf-8"
            )
            (part / LOCK).unlink()
            part.rename(folder)
        finally:
            shutil.rmtree(part, ignore_errors=True)


def write_axes(scene: Scene, path: Path) -> str:
    """Write local axes, depth, station and thickness by element; describe them. Collective."""
    scene = resolve_auto_settings(scene)
    domain, shape = checked_domain(mesh_of(scene, MPI.COMM_WORLD), scene), scene.geometry
    mesh = domain.mesh
    weight = scene.kinematics.for_mesh(mesh, shape).weight(mesh)
    quadrature = Quadrature(mesh, scene.mesh.degree, weight)
    local_axes = shape.local_axes(domain, quadrature)
    fields = local_fields(local_axes, quadrature) | {
        "region": domain.element_region.astype(np.int64)
    }
    words = [f"{domain.number_of_elements} elements"]
    if local_axes.thickness is not None:
        fields["thickness"] = quadrature.element_mean(local_axes.thickness)
        thinnest = quadrature.minimum(local_axes.thickness)
        thickest = quadrature.maximum(local_axes.thickness)
        words.append(f"wall {thinnest:.4g} to {thickest:.4g} thick")
    if local_axes.undefined is not None:
        undefined = local_axes.undefined.astype(np.float64)
        fields["undefined"] = undefined.max(axis=1)
        words.append(f"axes undefined in {100 * quadrature.mean(undefined):.2g} % of the wall")
    gathered = {name: domain.gather_elements(values) for name, values in fields.items()}
    points, elements = domain.gather_mesh()
    if points is not None and elements is not None:
        cell_type, cells = vtk_cells(mesh.topology.cell_name(), mesh.geometry.cmap.degree, elements)
        write_vtu(
            path, points, cells, cell_type, {n: v for n, v in gathered.items() if v is not None}
        )
    return "; ".join(words)
