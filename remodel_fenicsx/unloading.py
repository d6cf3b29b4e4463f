"""A scene whose geometry is the loaded one, as a scene of the unloaded body that its loads bring there."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.body.domain import dof_of_node
from remodel_fenicsx.body.mesh_domain import shared
from remodel_fenicsx.body.mesh_faces import FaceError, jacobian_determinants
from remodel_fenicsx.body.mesh_file import MeshFile, gmsh_text
from remodel_fenicsx.errors import RemodelError, SOLVE_FAILED
from remodel_fenicsx.body.wall import RoundWall
from remodel_fenicsx.model.residual_stress import Loads, closing
from remodel_fenicsx.fem.assembly import agreed
from remodel_fenicsx.scene.scene import Scene, SceneError, too_soft
from remodel_fenicsx.schema.settings import AS_GIVEN, EQUILIBRIUM, Natural
from remodel_fenicsx.simulation import Simulation
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.system import NOTICE
from remodel_fenicsx.system.terminal import Line, unsaid

log = logging.getLogger(__name__)


@contextlib.contextmanager
def as_unloaded(scene: Scene, comm: MPI.Intracomm, quiet: bool = True) -> Iterator[Scene]:
    """The scene itself, or that of its unloaded body, whose mesh is there as long as this context. Collective."""
    if not scene.geometry.is_loaded:
        yield scene
        return
    for line in scene.turned_away() if comm.rank == 0 else ():
        log.warning("%s", line)
    with TemporaryDirectory(prefix="remodel-fenicsx-") as folder:
        yield unloaded(scene, comm, comm.bcast(Path(folder)), quiet)


def unloaded(
    scene: Scene, comm: MPI.Intracomm = MPI.COMM_WORLD, folder: Path | None = None, quiet: bool = True
) -> Scene:
    """The scene of the body that the loads, at the end of their ramps, bring to the geometry of this one. Collective.

    Parameters
    ----------
    scene
        With `geometry.is = "loaded"`; another is given back.
    comm
        MPI communicator.
    folder
        Where the mesh of an own body is written, on rank 0.
    quiet
        No progress on the terminal.

    Returns
    -------
    Scene
        With the geometry of the unloaded body in place of the loaded one.

    Raises
    ------
    SceneError
        If the body has no numbers or nodes to be found, or an own body no folder.
    NoUnloadedShape
        If none is found.

    Examples
    --------
    A tube that is measured under its pressure:

    >>> from remodel_fenicsx import preset_scene, unloaded
    >>> tube = preset_scene("kuhl-holzapfel-2007", "tube")
    >>> seen = tube.with_values({"geometry.is": "loaded", "model.kinematics": "radial", "cells.axes": "cylindrical",
    ...                          "cells.initial": "isotropic", "loads.pressure.value": 0.5})
    >>> found = unloaded(seen).geometry
    >>> round(found.inner_radius, 3), round(found.outer_radius, 3)  # 1 and 3 are under pressure and elongation
    (0.968, 3.101)
    """
    if not scene.geometry.is_loaded:
        return scene
    with Line(f"{scene.name} unloaded", silent=quiet or comm.rank != 0) as line:
        if isinstance(scene.geometry, RoundWall):
            _warn(scene)
            return unloaded_tube(scene, comm, line.show)
        if folder is None:
            raise SceneError("geometry.is = 'loaded': a folder is needed for the unloaded mesh")
        return unloaded_mesh(scene, comm, folder, line.show)


# ---------------------------------------------------------------- numbers that the loads bring to the given ones
# By Broyden's method, whose first guess is that loaded numbers change as the unloaded ones do.

Array = NDArray[np.float64]
Said = Callable[[str], object]

LEAST_SHARE = 1 / 16  # of the loads, in which they are taken where they cannot be in one piece
MOST_LOADINGS = 30  # for one share of the loads
ON_THE_WAY = 0.01  # relative: how far numbers may be off at a share of the loads
REFUSALS = (ArithmeticError, FaceError, StepFailure, SceneError)


class NoUnloadedShape(RemodelError, RuntimeError):
    """There is none that the loads bring to the given one; one line with the share of the loads, and why."""

    exit_code = SOLVE_FAILED


def found_unloaded(
    start: Callable[[float], Array],
    missed: Callable[[Array, float], Array],
    tolerance: float,
    said: Said,
    scale: float = 1.0,
) -> tuple[Array, int]:
    """Numbers that the loads bring to the given ones, and how often they were loaded.

    `start` guesses them at a share of the loads, `missed` says how far the given ones are from those loaded.
    """
    from scipy.optimize import NoConvergence, broyden1  # which no run needs

    runs, words = 0, ""

    def error(numbers: Array) -> Array:
        nonlocal runs, words
        runs += 1
        said(f"iteration {runs}{words}, {100 * share:g} % of the loads")
        found = missed(numbers, share)
        words = f", off by {np.abs(found).max():.0e} before"
        return found

    how: dict[str, Any] = {"alpha": scale, "line_search": None, "maxiter": MOST_LOADINGS}
    done, step = 0.0, 1.0
    change: Any = 0.0  # of the start, per share of the loads
    while done < 1.0:
        share, words = min(done + step, 1.0), ""
        try:
            first, nearly = start(share), tolerance if share == 1.0 else ON_THE_WAY
            change = (broyden1(error, first + share * change, f_tol=nearly, **how) - first) / share
            done = share
        except (*REFUSALS, NoConvergence) as refusal:
            reason = f"not found in {MOST_LOADINGS} iterations{words}"
            if not isinstance(refusal, NoConvergence):
                reason = " ".join(str(refusal).split())
            log.info("unloading at %g %% of the loads failed (%s); they are now taken in parts", 100 * share, reason)
            step /= 2
            if step < LEAST_SHARE:
                raise NoUnloadedShape(
                    f"geometry.is = 'loaded': no unloaded body was found at {100 * share:g} % of the loads, there is "
                    f"one at {100 * done:g} %: {reason}; try lower loads, or a stiffer tissue"
                ) from refusal
    return start(1.0) + change, runs


# ---------------------------------------------------------------- the unloaded tube of a loaded one
# Radii and length.
#  They are found by runs of the scene's own kinematics, so that the run that follows comes to the given numbers:
# by Broyden's method for their logarithms, from what inverse elastostatics of one radius says
# (`model.residual_stress.closing`). There the loaded numbers change about as the unloaded ones do.

LOADED_AGAIN = 1e-9  # relative: how far the loaded numbers may be from those of the scene
LOAD_STEPS = 10  # of a run to the end of the ramps
# cells that stay; what says how to remodel goes with a law
PASSIVE: dict[str, object] = {
    "remodeling.law": "none", "remodeling.coupling": "staggered", "remodeling.turnover": {},
    "remodeling.exponent": 2.0, "remodeling.threshold": 0.0, "time.tolerance": None,
}  # fmt: skip


def unloaded_tube(scene: Scene, comm: MPI.Intracomm, said: Said) -> Scene:
    """From inverse elastostatics."""
    shape: Any = scene.geometry
    inside = [radius for radius in _outer_radii(scene).values() if radius < shape.outer_radius]
    given = np.array([shape.inner_radius, *inside, shape.outer_radius, shape.length])

    def missed(numbers: Array, share: float) -> Array:
        return np.log(given / _loaded(scene, comm, np.exp(numbers), share))

    numbers, runs = found_unloaded(lambda share: np.log(_inverse(scene, given, share)), missed, LOADED_AGAIN, said)
    found = np.exp(numbers)
    unloaded, loaded = (f"radii {', '.join(f'{r:.6g}' for r in radii)}, length {l:.6g}" for *radii, l in (found, given))
    log.log(NOTICE, "unloaded: %s, so that under the loads it has the given %s (%d runs)", unloaded, loaded, runs)
    return _with_numbers(scene, found)


def _outer_radii(scene: Scene) -> dict[str, float]:
    """Of the regions that say one, from the lumen outwards."""
    said = {name: region.outer_radius for name, region in scene.regions.items() if region.outer_radius is not None}
    return dict(sorted(said.items(), key=lambda item: item[1]))


def _inverse(scene: Scene, given: Array, share: float) -> Array:
    """Unloaded radii and length of a tube with these loaded ones, whose mesh is free of stress; on one radius."""
    tissues = {name: properties.tissue for name, properties in scene.properties().items()}
    layers = scene.geometry.layers_of_tissue(Natural(), scene.regions, tissues)
    end = scene.end_of_ramps
    loads = {name: load.value * load.factor(end) * share for name, load in scene.loads.items()}
    axial = 1.0 + loads.get("elongation", 0.0)
    radii = closing(layers, 0.0, Loads(loads.get("pressure", 0.0), None, axial)).natural_radius(given[:-1])
    return np.append(radii, given[-1] / axial)


def _loaded(scene: Scene, comm: MPI.Intracomm, numbers: Array, share: float) -> Array:
    """Radii and length under a share of the loads, as a run has them."""
    end = scene.end_of_ramps or 1.0
    changes: dict[str, object] = {"output.columns": [], "output.times": [], "output.fields": False}
    if scene.natural.cells == AS_GIVEN:
        changes |= PASSIVE | {"time.end": end, "time.step": end / LOAD_STEPS}
    else:
        changes |= {"time.end": EQUILIBRIUM}
    changes |= {"solver.relative_tolerance": min(scene.solver.relative_tolerance, LOADED_AGAIN / 10)}
    for name, load in scene.loads.items():
        changes |= {f"loads.{name}.value": load.value * load.factor(end) * share}
        changes |= {f"loads.{name}.ramp": [[0.0, 0.0], [end, 1.0]]}
    with (
        unsaid(),
        contextlib.closing(Simulation(_with_numbers(scene, numbers).with_values(changes), comm)) as simulation,
    ):
        simulation.watchers = [simulation.observer]
        row = [step.row for step in simulation.steps()][-1]
        domain = simulation.domain
        places, moves = domain.gather_nodes(domain.mesh.geometry.x), simulation.state.gathered_displacement()
    radii = None
    if places is not None and moves is not None:
        before, after = (np.hypot(x[:, 0], x[:, 1]) for x in (places, places + moves))
        radii = np.array([after[np.abs(before - radius) < 1e-6 * numbers.max()].mean() for radius in numbers[:-1]])
    found: Array = comm.bcast(radii)
    return np.append(found, numbers[-1] * (1 + row["axial_elongation"]))


def _with_numbers(scene: Scene, numbers: Array) -> Scene:
    """The scene of an unloaded tube of these radii, from the lumen outwards, and this length."""
    changes: dict[str, object] = {"geometry.is": "unloaded", "natural.cells": AS_GIVEN}
    changes |= {"geometry.inner_radius": float(numbers[0]), "geometry.outer_radius": float(numbers[-2])}
    changes |= {"geometry.length": float(numbers[-1])}
    for name, radius in zip(_outer_radii(scene), numbers[1:-1], strict=False):
        changes[f"regions.{name}.outer_radius"] = float(radius)
    return scene.with_values(changes)


# ---------------------------------------------------------------- the unloaded mesh of a loaded one
# The places of all nodes. The residual is that of the unloaded body under its loads, displaced to the given places.
# How far these are from the loaded ones is what one Newton step of that body adds to its displacement.

UNLOADED_MESH = "unloaded.msh"
LEAST_MOVE = 1e-10  # of the body's extent: how far a node may be from its given place


def unloaded_mesh(scene: Scene, comm: MPI.Intracomm, folder: Path, said: Said) -> Scene:
    """The scene of the unloaded body, whose mesh is written into the folder. Collective."""
    shape: Any = scene.geometry
    file, regions = agreed(comm, lambda: _read(scene) if comm.rank == 0 else None) or (None, None)
    given: Array = comm.bcast(None if file is None else file.points)
    extent, as_unloaded = float(np.ptp(given, axis=0).max()), scene.with_values({"geometry.is": "unloaded"})

    def missed(places: Array, share: float) -> Array:
        moved: Any = file and replace(file, points=places)
        if not comm.bcast(moved is None or _is_whole(moved)):
            raise ArithmeticError("elements would turn inside out")
        domain = shared(lambda: (moved, shape.boundary(moved), regions or {}), comm)
        with unsaid(), contextlib.closing(Simulation(as_unloaded, comm, domain)) as simulation:
            return np.divide(_missed(simulation, given, share), extent, dtype=np.float64)

    places, runs = found_unloaded(lambda _: given, missed, LEAST_MOVE, said, extent)
    path = folder / UNLOADED_MESH
    if file is not None:
        path.write_text(gmsh_text(places, file.blocks, file.names), encoding="ascii")
    comm.barrier()
    moved = np.linalg.norm(places - given, axis=1).max()
    log.log(NOTICE, "unloaded: %d nodes, moved by %.6g at most, found in %d iterations", len(places), moved, runs)
    changes: dict[str, object] = {"geometry.is": "unloaded", "geometry.file": str(path), "mesh.refinement": 1}
    changes |= {"geometry.file_unit": None, "geometry.tags": None, "geometry.sha256": None}
    if shape.regions:
        numbers: dict[str, int] = comm.bcast(regions)
        changes["geometry.regions"] = {name: [numbers[name]] for name in shape.regions}
    return scene.with_values(changes)


def _warn(scene: Scene, wall: object = None) -> None:
    for words in too_soft(scene, wall):
        log.warning("%s", words)


def _read(scene: Scene) -> tuple[MeshFile, dict[str, int]]:
    shape: Any = scene.geometry
    file, boundary, regions = shape.checked(scene.mesh)
    _warn(scene, boundary)
    return file, regions


def _is_whole(file: MeshFile) -> bool:
    """Whether no element is twisted."""
    determinants = jacobian_determinants(file)
    return bool((determinants * np.sign(determinants.mean()) > 0).all())


def _missed(simulation: Simulation, given: Array, share: float) -> Array:
    """How far the given places are from the loaded ones, (nodes, 3) in the order of the file, on all ranks."""
    domain, coupling, unknown = simulation.domain, simulation.stepper.coupling, simulation.unknown
    loads = simulation.load_values(simulation.scene.end_of_ramps)
    simulation.loading.set({name: share * value for name, value in loads.items()})
    dofs = dof_of_node(domain.mesh, unknown.function_space)
    unknown.x.array.reshape(-1, 3)[dofs] = given[domain.node_number] - domain.mesh.geometry.x
    if not coupling.equilibrium.extension().admissible:
        raise ArithmeticError("no admissible state on the path: r >= L or J <= 0")
    change = coupling.newton.answer(coupling.equilibrium, 0)
    found: Array = domain.comm.bcast(domain.gather_nodes(-change.reshape(-1, 3)[dofs]))
    if not np.isfinite(found).all():
        raise ArithmeticError("the tangent is singular")
    return found
