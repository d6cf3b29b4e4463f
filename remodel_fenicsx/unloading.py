"""Unloaded bodies: the scene of the unloaded body for a scene with loaded geometry."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import ufl
from dolfinx.fem import Form, Function
from mpi4py import MPI

from remodel_fenicsx.body.domain import dof_of_node
from remodel_fenicsx.body.mesh_domain import shared
from remodel_fenicsx.body.mesh_faces import FaceError, jacobian_determinants
from remodel_fenicsx.body.mesh_file import MeshFile, gmsh_text
from remodel_fenicsx.errors import RemodelError, SOLVE_FAILED
from remodel_fenicsx.body.wall import RoundWall
from remodel_fenicsx.model.residual_stress import Loads, close_ring
from remodel_fenicsx.fem import jit
from remodel_fenicsx.fem.assembly import raise_on_all_ranks
from remodel_fenicsx.model.tensors import Array
from remodel_fenicsx.scene.scene import Scene, SceneError, too_soft
from remodel_fenicsx.schema import processes
from remodel_fenicsx.schema.settings import AS_GIVEN, EQUILIBRIUM, Natural
from remodel_fenicsx.simulation import Simulation
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.solver.equilibrium import Equilibrium
from remodel_fenicsx.system import NOTICE
from remodel_fenicsx.system.terminal import Line, muted_warnings

log = logging.getLogger(__name__)


@contextlib.contextmanager
def as_unloaded(scene: Scene, comm: MPI.Intracomm, quiet: bool = True) -> Iterator[Scene]:
    """Yield the scene, or that of its unloaded body with a temporary mesh file. Collective."""
    if not scene.geometry.is_loaded:
        yield scene
        return
    for line in scene.loaded_shape_warnings() if comm.rank == 0 else ():
        log.warning("%s", line)
    with TemporaryDirectory(prefix="remodel-fenicsx-") as folder:
        yield unloaded(scene, comm, comm.bcast(Path(folder)), quiet)


def unloaded(
    scene: Scene,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    folder: Path | None = None,
    quiet: bool = True,
) -> Scene:
    """Compute the unloaded body that the loads, after their ramps, deform to this one. Collective.

    Parameters
    ----------
    scene
        Scene with `geometry.is = "loaded"`. Any other scene is returned unchanged.
    comm
        MPI communicator.
    folder
        Folder for the unloaded mesh if the geometry is a mesh file; written on rank 0.
    quiet
        Show no progress on the terminal.

    Returns
    -------
    Scene
        The scene with the geometry of the unloaded body in place of the loaded one.

    Raises
    ------
    SceneError
        If the unloaded body of this geometry cannot be computed, or a mesh file has no `folder`.
    NoUnloadedShape
        If the iteration does not converge.

    Examples
    --------
    A tube that is measured under its pressure:

    >>> from remodel_fenicsx import preset_scene, unloaded
    >>> tube = preset_scene("kuhl-holzapfel-2007", "tube")
    >>> loaded = tube.with_values({
    ...     "geometry.is": "loaded", "model.kinematics": "radial", "cells.axes": "cylindrical",
    ...     "cells.initial": "isotropic", "loads.pressure.value": 0.5})
    >>> geometry = unloaded(loaded).geometry
    >>> # radii of 1 and 3 under pressure and elongation
    >>> round(geometry.inner_radius, 3), round(geometry.outer_radius, 3)
    (0.968, 3.101)
    """
    if not scene.geometry.is_loaded:
        return scene
    with Line(f"{scene.name} unloaded", silent=quiet or comm.rank != 0) as line:
        if isinstance(scene.geometry, RoundWall):
            _warn(scene)
            return unloaded_tube(scene, comm, line.show)
        if folder is None:
            raise SceneError("geometry.is = 'loaded': needs a folder for the unloaded mesh")
        return unloaded_mesh(scene, comm, folder, line.show)


# ---------------------------------------------------------------- nonlinear solver
# Broyden's method for unloaded dimensions or nodes. Its first Jacobian assumes that loaded values
# change as the unloaded ones do.

Said = Callable[[str], object]

LEAST_SHARE = 1 / 16  # smallest load increment, as a fraction of the loads
MAX_FORWARD_RUNS = 30  # forward runs per load increment
ON_THE_WAY = 0.01  # relative tolerance of dimensions at intermediate load factors
REFUSALS = (ArithmeticError, FaceError, StepFailure, SceneError)


class NoUnloadedShape(RemodelError, RuntimeError):
    """Failure to find an unloaded shape; one line with the load factor and the reason."""

    exit_code = SOLVE_FAILED


def found_unloaded(
    start: Callable[[float], Array],
    missed: Callable[[Array, float], Array],
    tolerance: float,
    said: Said,
    scale: float = 1.0,
) -> tuple[Array, int]:
    """Solve for the unloaded values; return them and the number of forward runs.

    `start` guesses the values at a load factor. `missed` returns the differences of the target
    from the values under load.
    """
    from scipy.optimize import NoConvergence, broyden1  # No other run needs SciPy's solvers.

    runs, words = 0, ""

    def error(numbers: Array) -> Array:
        nonlocal runs, words
        runs += 1
        said(f"iteration {runs}{words}, {100 * share:g} % of the loads")
        difference = missed(numbers, share)
        words = f", last error {np.abs(difference).max():.0e}"
        return difference

    how: dict[str, Any] = {"alpha": scale, "line_search": None, "maxiter": MAX_FORWARD_RUNS}
    done, step = 0.0, 1.0
    change: Any = 0.0  # correction of `start` at the last load factor
    while done < 1.0:
        share, words = min(done + step, 1.0), ""
        try:
            first, nearly = start(share), tolerance if share == 1.0 else ON_THE_WAY
            change = broyden1(error, first + change, f_tol=nearly, **how) - first
            done = share
        except (*REFUSALS, NoConvergence) as refusal:
            reason = f"no convergence in {MAX_FORWARD_RUNS} iterations{words}"
            if not isinstance(refusal, NoConvergence):
                reason = " ".join(str(refusal).split())
            log.info(
                "unloading at %g %% of the loads failed (%s); using smaller load increments",
                100 * share,
                reason,
            )
            step /= 2
            if step < LEAST_SHARE:
                raise NoUnloadedShape(
                    f"geometry.is = 'loaded': no unloaded configuration at {100 * share:g} % of "
                    f"the loads (last converged: {100 * done:g} %): {reason}; lower the loads or "
                    "stiffen the tissue"
                ) from refusal
    return start(1.0) + change, runs


# ---------------------------------------------------------------- unloaded tubes
# Radii and length.
# Forward runs have the scene's own kinematics, so that the following run reaches the dimensions of
# the scene. Broyden's method solves for the logarithms of the dimensions. It starts from inverse
# elastostatics of one radius (`model.residual_stress.close_ring`), where loaded dimensions change
# about as the unloaded ones do.

GEOMETRY_TOLERANCE = 1e-9  # relative tolerance of the loaded dimensions
LOAD_STEPS = 10  # steps of a forward run to the end of the ramps
# Settings without remodeling. Keys that belong to a law get their defaults.
PASSIVE: dict[str, object] = {
    "remodeling.law": "none", "remodeling.coupling": "staggered",
    "remodeling.exponent": 2.0, "remodeling.threshold": 0.0, "time.tolerance": None,
    **{f"remodeling.{name}": {} for name in processes.tables()},
}  # fmt: skip


def unloaded_tube(scene: Scene, comm: MPI.Intracomm, said: Said) -> Scene:
    """Return the scene of the unloaded tube, starting from inverse elastostatics. Collective."""
    shape: Any = scene.geometry
    inside = [radius for radius in _outer_radii(scene).values() if radius < shape.outer_radius]
    given = np.array([shape.inner_radius, *inside, shape.outer_radius, shape.length])

    def missed(numbers: Array, share: float) -> Array:
        return np.log(given / _load_forward(scene, comm, np.exp(numbers), share))

    numbers, runs = found_unloaded(
        lambda share: np.log(_inverse_elastostatics(scene, given, share)),
        missed,
        GEOMETRY_TOLERANCE,
        said,
    )
    dimensions = np.exp(numbers)
    unloaded, loaded = (
        f"radii {', '.join(f'{r:.6g}' for r in radii)}, length {l:.6g}"
        for *radii, l in (dimensions, given)
    )
    log.log(NOTICE, "unloaded: %s; under the loads: %s (%d runs)", unloaded, loaded, runs)
    return _with_dimensions(scene, dimensions)


def _outer_radii(scene: Scene) -> dict[str, float]:
    """Return the outer radii of the regions that set one, from the lumen outwards."""
    said = {
        name: region.outer_radius
        for name, region in scene.regions.items()
        if region.outer_radius is not None
    }
    return dict(sorted(said.items(), key=lambda item: item[1]))


def _inverse_elastostatics(scene: Scene, given: Array, share: float) -> Array:
    """Return unloaded radii and length of a stress-free tube by inverse elastostatics."""
    tissues = {name: properties.tissue for name, properties in scene.properties().items()}
    layers = scene.geometry.layers_of_tissue(Natural(), scene.regions, tissues)
    end = scene.end_of_ramps
    loads = {name: load.value * load.factor(end) * share for name, load in scene.loads.items()}
    axial = 1.0 + loads.get("elongation", 0.0)
    radii = close_ring(layers, 0.0, Loads(loads.get("pressure", 0.0), None, axial)).natural_radius(
        given[:-1]
    )
    return np.append(radii, given[-1] / axial)


def _load_forward(scene: Scene, comm: MPI.Intracomm, numbers: Array, share: float) -> Array:
    """Return radii and length of a forward run at a load factor. Collective."""
    end = scene.end_of_ramps or 1.0
    changes: dict[str, object] = {
        "output.columns": [],
        "output.times": [],
        "output.fields": False,
        "time.end": EQUILIBRIUM,
        "solver.relative_tolerance": min(scene.solver.relative_tolerance, GEOMETRY_TOLERANCE / 10),
    }
    if scene.natural.cells == AS_GIVEN:
        changes |= PASSIVE | {"time.end": end, "time.step": end / LOAD_STEPS}
    for name, load in scene.loads.items():
        changes[f"loads.{name}.value"] = load.value * load.factor(end) * share
        changes[f"loads.{name}.ramp"] = [[0.0, 0.0], [end, 1.0]]
    with (
        muted_warnings(),
        contextlib.closing(
            Simulation(_with_dimensions(scene, numbers).with_values(changes), comm)
        ) as simulation,
    ):
        simulation.watchers = [simulation.observer]
        row = [step.row for step in simulation.steps()][-1]
        domain = simulation.domain
        nodes = domain.gather_nodes(domain.mesh.geometry.x)
        moves = simulation.state.gathered_displacement()
    radii = None
    if nodes is not None and moves is not None:
        before, after = (np.hypot(x[:, 0], x[:, 1]) for x in (nodes, nodes + moves))
        radii = np.array(
            [
                after[np.abs(before - radius) < 1e-6 * numbers.max()].mean()
                for radius in numbers[:-1]
            ]
        )
    loaded_radii: Array = comm.bcast(radii)
    return np.append(loaded_radii, numbers[-1] * (1 + row["axial_elongation"]))


def _with_dimensions(scene: Scene, numbers: Array) -> Scene:
    """Return the scene of an unloaded tube with these radii (inner to outer) and length."""
    changes: dict[str, object] = {
        "geometry.is": "unloaded",
        "natural.cells": AS_GIVEN,
        "geometry.inner_radius": float(numbers[0]),
        "geometry.outer_radius": float(numbers[-2]),
        "geometry.length": float(numbers[-1]),
    }
    for name, radius in zip(_outer_radii(scene), numbers[1:-1], strict=False):
        changes[f"regions.{name}.outer_radius"] = float(radius)
    return scene.with_values(changes)


# ---------------------------------------------------------------- unloaded meshes
# Positions of all nodes. The residual is that of the unloaded body under its loads, displaced to
# the measured positions. Broyden's method takes the Newton steps for it, with the derivative with
# respect to unloaded positions (Govindjee and Mihalic, 1996). The tangent of the body itself does
# not replace it: near a limit point of a thin wall it is almost singular, because a pressure
# follows the displacement.

UNLOADED_MESH = "unloaded.msh"
# Largest distance of a node from its measured position, over the body's extent.
UPDATE_TOLERANCE = 1e-10


def unloaded_mesh(scene: Scene, comm: MPI.Intracomm, folder: Path, said: Said) -> Scene:
    """Return the scene of the unloaded body and write its mesh into the folder. Collective."""
    shape: Any = scene.geometry
    file, regions = raise_on_all_ranks(comm, lambda: _read(scene) if comm.rank == 0 else None) or (
        None,
        None,
    )
    given: Array = comm.bcast(None if file is None else file.points)
    extent = float(np.ptp(given, axis=0).max())
    as_unloaded = scene.with_values({"geometry.is": "unloaded"})

    def missed(places: Array, share: float) -> Array:
        moved: Any = file and replace(file, points=places)
        if not comm.bcast(moved is None or _has_valid_elements(moved)):
            raise ArithmeticError("inverted elements")
        domain = shared(lambda: (moved, shape.boundary(moved), regions or {}), comm)
        with (
            muted_warnings(),
            contextlib.closing(Simulation(as_unloaded, comm, domain)) as simulation,
        ):
            return np.divide(_missed(simulation, given, share), extent, dtype=np.float64)

    places, runs = found_unloaded(lambda _: given, missed, UPDATE_TOLERANCE, said, extent)
    path = folder / UNLOADED_MESH
    if file is not None:
        path.write_text(gmsh_text(places, file.blocks, file.names), encoding="ascii")
    comm.barrier()
    moved = np.linalg.norm(places - given, axis=1).max()
    log.log(
        NOTICE,
        "unloaded: %d nodes, largest movement %.6g, found in %d iterations",
        len(places),
        moved,
        runs,
    )
    changes: dict[str, object] = {
        "geometry.is": "unloaded",
        "geometry.file": str(path),
        "geometry.file_unit": None,
        "geometry.tags": None,
        "geometry.sha256": None,
        "mesh.refinement": 1,
    }
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


def _has_valid_elements(file: MeshFile) -> bool:
    """Return whether no element is inverted."""
    determinants = jacobian_determinants(file)
    return bool((determinants * np.sign(determinants.mean()) > 0).all())


def inverse_tangent(equilibrium: Equilibrium) -> list[Form]:
    """Return minus the derivative of the residual with respect to unloaded positions, compiled.

    Positions under load are fixed, and with them the forces of a pressure. With X + V in place of
    X, F is F (I - grad V) and a volume grows by div V, to the first order in V. The forces of the
    matrix and of the network come first; the stiffness of springs, if there are any, is last.

    Parameters
    ----------
    equilibrium
        Equilibrium of the unloaded body.

    Returns
    -------
    list
        Compiled bilinear forms; their sum takes V, in the unit of length, to forces.

    References
    ----------
    Govindjee and Mihalic, Comput. Methods Appl. Mech. Eng. 136 (1996): inverse elastostatics.
    """
    state = equilibrium.state
    unknown, kinematics = state.unknown, state.kinematics
    space = unknown.function_space
    test, trial = ufl.TestFunction(space), ufl.TrialFunction(space)
    moved = Function(space)
    gradient = kinematics.deformation_gradient(unknown) * (ufl.Identity(3) - ufl.grad(moved))
    energies = state.dilatation.energies(
        equilibrium.tissue,
        kinematics.elastic(gradient),
        [state.cells.symbolic_cell],
        kinematics.stress_free_weight(space.mesh) * (1 + ufl.div(moved)),
    )
    forms = [-ufl.derivative(ufl.derivative(e, unknown, test), moved, trial) for e in energies]
    springs = state.loading.residual_of_potentials(test)
    if springs is not None:
        forms.append(ufl.derivative(springs, unknown, trial))
    return [jit.form(form) for form in forms]


def _missed(simulation: Simulation, given: Array, share: float) -> Array:
    """Return increments of unloaded positions (nodes, 3), in file order. Collective."""
    domain, unknown = simulation.domain, simulation.unknown
    coupling = simulation.stepper.coupling
    loads = simulation.load_values(simulation.scene.end_of_ramps)
    simulation.loading.set({name: share * value for name, value in loads.items()})
    dofs = dof_of_node(domain.mesh, unknown.function_space)
    unknown.x.array.reshape(-1, 3)[dofs] = given[domain.node_number] - domain.mesh.geometry.x
    if not coupling.equilibrium.limits().admissible:
        raise ArithmeticError("no admissible state on the path: r >= L or J <= 0")
    coupling.equilibrium.tangent_forms = inverse_tangent(coupling.equilibrium)
    change = coupling.newton.newton_correction(coupling.equilibrium, 0)
    snes = coupling.newton.linear.snes
    if snes.getKSP().getConvergedReason() < 0:
        raise ArithmeticError("the linear solver failed")
    distances: Array = domain.comm.bcast(domain.gather_nodes(-change.reshape(-1, 3)[dofs]))
    if not np.isfinite(distances).all():
        raise ArithmeticError("the tangent is singular")
    return distances
