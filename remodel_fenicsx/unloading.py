"""A scene whose geometry is the loaded one, as a scene of the unloaded body that its loads bring there."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, TypeVar

import dolfinx.fem
import dolfinx.fem.petsc
import numpy as np
import ufl
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc
from ufl.algorithms.map_integrands import map_integrands

from remodel_fenicsx.body.domain import dof_of_node
from remodel_fenicsx.body.mesh_faces import jacobian_determinants
from remodel_fenicsx.body.mesh_file import MeshFile, gmsh_text
from remodel_fenicsx.errors import RemodelError, SOLVE_FAILED
from remodel_fenicsx.body.wall import RoundWall
from remodel_fenicsx.fem import jit
from remodel_fenicsx.fem.assembly import assemble_matrix, create_matrix, factorised, over_ranks, second_derivative
from remodel_fenicsx.model.residual_stress import Loads, closing
from remodel_fenicsx.fem.assembly import agreed
from remodel_fenicsx.scene.scene import Scene, SceneError, too_soft
from remodel_fenicsx.schema.settings import AS_GIVEN, EQUILIBRIUM, Natural
from remodel_fenicsx.simulation import Simulation
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.solver.equilibrium import mandel_vector
from remodel_fenicsx.system.terminal import Line, unsaid

if TYPE_CHECKING:
    from ufl.core.expr import Expr

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


# ---------------------------------------------------------------- no unloaded shape
# What is said where there is no unloaded shape, and the shares of the loads in which it is looked for.

Found = TypeVar("Found")

SHARES = (0.25, 0.5, 0.75, 1.0)  # of the loads, where they cannot be taken in one piece


class NoUnloadedShape(RemodelError, RuntimeError):
    """There is none that the loads bring to the given one; one line with the share of the loads, and why."""

    exit_code = SOLVE_FAILED


def in_shares(find: Callable[[float, Found], Found], start: Found) -> Found:
    """What is found at all of the loads: in one piece, or in shares, each from the one before."""
    refusals = (ArithmeticError, StepFailure, SceneError)
    try:
        return find(1.0, start)
    except refusals as error:
        log.info("unloading all loads at once failed (%s); they are now taken in parts", " ".join(str(error).split()))
    done = 0.0
    for share in SHARES:
        try:
            start = find(share, start)
        except refusals as error:
            reason = " ".join(str(error).split())
            raise NoUnloadedShape(
                f"geometry.is = 'loaded': no unloaded body was found at {100 * share:g} % of the loads, there is "
                f"one at {100 * done:g} %: {reason}; try lower loads, or a stiffer tissue"
            ) from error
        done = share
    return start


# ---------------------------------------------------------------- the unloaded tube of a loaded one
# Radii and length.
#  They are found by runs of the scene's own kinematics, so that the run that follows comes to the given numbers:
# by Broyden's method for their logarithms, from what inverse elastostatics of one radius says
# (`model.residual_stress.closing`). There the loaded numbers change about as the unloaded ones do.

Array = NDArray[np.float64]
Said = Callable[[str], object]

LOADED_AGAIN = 1e-9  # relative: how far the loaded numbers may be from those of the scene
MOST_LOADINGS = 30  # runs for one share of the loads
LOAD_STEPS = 10  # of a run to the end of the ramps
# cells that stay; what says how to remodel goes with a law
PASSIVE: dict[str, object] = {
    "remodeling.law": "none", "remodeling.coupling": "staggered", "remodeling.turnover": {},
    "remodeling.exponent": 2.0, "remodeling.threshold": 0.0, "time.tolerance": None,
}  # fmt: skip


def unloaded_tube(scene: Scene, comm: MPI.Intracomm, said: Said) -> Scene:
    """By Broyden's method, from inverse elastostatics."""
    from scipy.optimize import NoConvergence, broyden1  # which no run needs

    shape: Any = scene.geometry
    inside = [radius for radius in _outer_radii(scene).values() if radius < shape.outer_radius]
    given = np.array([shape.inner_radius, *inside, shape.outer_radius, shape.length])
    runs, found = 0, given

    def find(share: float, correction: Any) -> Any:
        """How far logarithms are from what inverse elastostatics says, from how far they were; the numbers too."""
        first: Array = np.log(_inverse(scene, given, share))

        words, how = "", {"alpha": 1.0, "line_search": None, "maxiter": MOST_LOADINGS, "f_tol": LOADED_AGAIN}

        def error(numbers: Array) -> Array:
            nonlocal runs, found, words
            runs, found = runs + 1, np.exp(numbers)
            said(f"run {runs}{words}, {100 * share:g} % of the loads")
            missed = np.log(given / _loaded(scene, comm, found, share))
            words = f", off by {np.abs(missed).max():.0e} before"
            return missed

        try:
            return broyden1(error, first + correction, **how) - first
        except NoConvergence as failure:
            raise ArithmeticError(f"not found in {MOST_LOADINGS} runs{words}") from failure

    in_shares(find, np.zeros(len(given)))
    unloaded, loaded = (f"radii {', '.join(f'{r:.6g}' for r in radii)}, length {l:.6g}" for *radii, l in (found, given))
    log.info("unloaded: %s, so that under the loads it has the given %s (%d runs)", unloaded, loaded, runs)
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
# The places of all nodes, by Newton's method.
#  The residual is that of the unloaded body under its loads, displaced to the given places. Its derivative by the
# places of the unloaded nodes is that of inverse elastostatics (Govindjee and Mihalic 1996): with X the unloaded
# places, moved by w, and x = X + u the given ones,
#     F = (1 + grad u) (1 + grad w)^-1,    dV = det(1 + grad w) dX,
# derived by w at w = 0. A pressure stays as it is, for the loaded face does not move.

UNLOADED_MESH = "unloaded.msh"
LEAST_MOVE = 1e-10  # of the body's extent: the last change of a place
MOST_MOVES = 20  # Newton iterations for one share of the loads
LEAST_STEP = 1 / 64  # of a Newton step that keeps elements whole and chains shorter than their contour length


def unloaded_mesh(scene: Scene, comm: MPI.Intracomm, folder: Path, said: Said) -> Scene:
    """The scene of the unloaded body, whose mesh is written into the folder. Collective."""
    shape: Any = scene.geometry
    file, regions = agreed(comm, lambda: _read(scene) if comm.rank == 0 else None) or (None, None)
    given: Array = comm.bcast(None if file is None else file.points)
    path = folder / UNLOADED_MESH
    changes: dict[str, object] = {"geometry.is": "unloaded", "geometry.file": str(path), "mesh.refinement": 1}
    changes |= {"geometry.file_unit": None, "geometry.tags": None, "geometry.sha256": None}
    if shape.regions:
        numbers: dict[str, int] = comm.bcast(regions)
        changes["geometry.regions"] = {name: [numbers[name]] for name in shape.regions}
    iterations = 0

    def write(places: Array) -> None:
        if file is not None:
            path.write_text(gmsh_text(places, file.blocks, file.names), encoding="ascii")
        comm.barrier()

    def find(share: float, start: Array) -> Array:
        nonlocal iterations
        places, step, length, words = start, np.zeros_like(start), 1.0, ""
        for _ in range(MOST_MOVES):
            iterations += 1
            said(f"iteration {iterations}{words}, {100 * share:g} % of the loads")
            write(places)
            with unsaid(), contextlib.closing(Simulation(scene.with_values(changes), comm)) as simulation:
                found = _newton_step(simulation, given, share)
            if found is None:  # too far: back to half of the way
                length /= 2
                if length < LEAST_STEP or not step.any():
                    raise ArithmeticError("no admissible state on the path: r >= L or J <= 0")
                places = places - length * step
                continue
            size, length = float(np.abs(found).max()), 1.0
            words = f", moved by {size:.0e} before"
            while not comm.bcast(file is None or _is_whole(replace(file, points=places + length * found))):
                length /= 2
                if length < LEAST_STEP:
                    raise ArithmeticError("elements would turn inside out")
            step = found
            places = places + length * step
            if size <= LEAST_MOVE * float(np.ptp(given, axis=0).max()):
                return places
        raise ArithmeticError(f"nodes still move by {size:.2g} after {MOST_MOVES} iterations")

    write(in_shares(find, given))
    log.info("unloaded: %s, found in %d Newton iterations", UNLOADED_MESH, iterations)
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


def _newton_step(simulation: Simulation, given: Array, share: float) -> Array | None:
    """How the unloaded nodes move, (nodes, 3) in the order of the file, on all ranks; None beyond the limits."""
    domain, state, scene = simulation.domain, simulation.state, simulation.scene
    equilibrium, unknown = simulation.stepper.coupling.equilibrium, simulation.unknown
    loads = simulation.load_values(scene.end_of_ramps)
    state.loading.set({name: share * value for name, value in loads.items()})
    dofs = dof_of_node(domain.mesh, unknown.function_space)
    unknown.x.array.reshape(-1, 3)[dofs] = given[domain.node_number] - domain.mesh.geometry.x
    if not equilibrium.extension().admissible:
        return None
    move = dolfinx.fem.Function(unknown.function_space)
    tangents = [jit.form(form) for form in _tangents(simulation, move)]
    prescribed = equilibrium.prescribed_values()
    held = dolfinx.fem.Function(unknown.function_space)
    fixed = np.isfinite(prescribed)
    held.x.array[fixed] = (unknown.x.array - prescribed)[fixed]
    blocks = np.flatnonzero(fixed.reshape(-1, 3).all(axis=1)).astype(np.int32)
    conditions = [dolfinx.fem.dirichletbc(held, blocks)]
    matrix = create_matrix(tangents[0])
    assemble_matrix(matrix, tangents, conditions)
    right, external = unknown.x.petsc_vec.duplicate(), unknown.x.petsc_vec.duplicate()
    equilibrium.assemble_internal(right)
    equilibrium.assemble_external(external)
    right.axpy(1.0, external)
    right.scale(-1.0)
    lift = right.duplicate()
    with lift.localForm() as local:
        local.set(0.0)
    for tangent in tangents:
        dolfinx.fem.petsc.apply_lifting(lift, [tangent], bcs=[conditions])
    lift.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
    right.axpy(1.0, lift)
    dolfinx.fem.petsc.set_bc(right, conditions)
    solver = factorised(matrix)
    solver.solve(right, move.x.petsc_vec)
    move.x.scatter_forward()
    for thing in (solver, matrix, right, external, lift):
        thing.destroy()
    if over_ranks(domain.comm, not np.isfinite(move.x.array).all(), MPI.LOR):
        return None
    found: Array = domain.comm.bcast(domain.gather_nodes(move.x.array.reshape(-1, 3)[dofs]))
    return found


def _tangents(simulation: Simulation, move: dolfinx.fem.Function) -> list[ufl.Form]:
    """Derivative of the residual by the unloaded places, UFL forms to be added up; `move` is zero."""
    # Compiled one by one: in one kernel they take the compiler minutes.
    state, unknown = simulation.state, simulation.unknown
    equilibrium, kinematics, mesh = simulation.stepper.coupling.equilibrium, state.kinematics, simulation.domain.mesh
    test, trial = ufl.TestFunction(move.function_space), ufl.TrialFunction(move.function_space)
    back = ufl.Identity(3) - ufl.grad(move)  # (1 + grad w)^-1 and, below, det(1 + grad w), to first order
    F = kinematics.elastic(ufl.dot(kinematics.deformation_gradient(unknown), back))
    weight = kinematics.stress_free_weight(mesh)
    energies = state.dilatation.energies(equilibrium.tissue, F, [state.cells.ufl_cell], weight)
    forms = [second_derivative(energy, unknown, test, trial, move) for energy in energies]

    def larger(density: Expr) -> Expr:
        return ufl.derivative(density, unknown, test) * ufl.div(trial)

    forms += [map_integrands(larger, energy) for energy in energies]
    pointwise = equilibrium.pointwise
    if pointwise is not None:
        pointwise.update(stiffness=True)
        virtual, increment = ufl.derivative(F, unknown, test), ufl.derivative(F, move, trial)
        work = pointwise.residual(unknown, F, test)
        strains = [mandel_vector(ufl.sym(ufl.dot(ufl.transpose(F), way))) for way in (increment, virtual)]
        stiffness = ufl.inner(ufl.dot(pointwise.stiffness, strains[0]), strains[1])
        changes = ufl.derivative(work, move, trial) + stiffness + work * ufl.div(trial)
        forms.append(changes * weight * equilibrium.quadrature.dx)
    supports = state.loading.residual_of_potentials(test)
    if supports is not None:  # of fixed direction: u shrinks by what the unloaded place moves
        forms.append(-ufl.derivative(supports, unknown, trial))
    return forms
