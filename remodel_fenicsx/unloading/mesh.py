"""The unloaded mesh of a loaded one: the places of all nodes, by Newton's method.

The residual is that of the unloaded body under its loads, displaced to the given places. Its derivative by the places
of the unloaded nodes is that of inverse elastostatics (Govindjee and Mihalic 1996): with X the unloaded places, moved
by w, and x = X + u the given ones,

    F = (1 + grad u) (1 + grad w)^-1,    dV = det(1 + grad w) dX,

derived by w at w = 0. A pressure stays as it is, for the loaded face does not move.
"""

from __future__ import annotations

import logging
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import dolfinx.fem
import dolfinx.fem.petsc
import numpy as np
import ufl
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc
from ufl.algorithms.map_integrands import map_integrands

from remodel_fenicsx.body.mesh_faces import jacobian_determinants
from remodel_fenicsx.body.mesh_file import MeshFile
from remodel_fenicsx.body.mesh_writer import gmsh_text
from remodel_fenicsx.fem import jit
from remodel_fenicsx.fem.assembly import assemble_matrix, create_matrix, over_ranks, second_derivative
from remodel_fenicsx.results.fields import dof_of_node
from remodel_fenicsx.results.run_folder import agreed
from remodel_fenicsx.scene import Scene
from remodel_fenicsx.simulation import Simulation
from remodel_fenicsx.solver.pointwise import mandel_vector
from remodel_fenicsx.system.terminal import unsaid
from remodel_fenicsx.unloading.failure import in_shares

log = logging.getLogger(__name__)
Array = NDArray[np.float64]

UNLOADED_MESH = "unloaded.msh"
LEAST_MOVE = 1e-10  # of the body's extent: the last change of a place
MOST_MOVES = 20  # Newton iterations for one share of the loads
LEAST_STEP = 1 / 64  # of a Newton step that keeps elements whole and chains shorter than their contour length


def unloaded_mesh(scene: Scene, comm: MPI.Intracomm, folder: Path) -> Scene:
    """The scene of the unloaded body, whose mesh is written into the folder. Collective.

    Raises
    ------
    SceneError
        If the mesh of the scene is none of a body with its faces.
    NoUnloadedShape
        If there is none.
    """
    shape: Any = scene.geometry
    file, regions = agreed(comm, lambda: _read(scene) if comm.rank == 0 else None) or (None, None)
    given: Array = comm.bcast(None if file is None else file.points)
    path = folder / UNLOADED_MESH
    changes: dict[str, Any] = {"geometry.is": "unloaded", "geometry.file": str(path), "mesh.refinement": 1}
    changes |= {"geometry.file_unit": None, "geometry.tags": None, "geometry.sha256": None}
    if shape.regions:
        numbers: dict[str, int] = comm.bcast(regions)
        changes["geometry.regions"] = {name: [numbers[name]] for name in shape.regions}
    iterations = 0

    def write(places: Array) -> None:
        if file is not None:
            path.write_text(gmsh_text(replace(file, points=places)), encoding="ascii")
        comm.barrier()

    def find(share: float, start: Array) -> Array:
        nonlocal iterations
        places, step, length = start, np.zeros_like(start), 1.0
        for _ in range(MOST_MOVES):
            iterations += 1
            write(places)
            with unsaid(), closing(Simulation(scene.with_values(changes), comm)) as simulation:
                found = _newton_step(simulation, given, share)
            if found is None:  # too far: back to half of the way
                length /= 2
                if length < LEAST_STEP or not step.any():
                    raise ArithmeticError("no admissible state on the path: r >= L or J <= 0")
                places = places - length * step
                continue
            size, length = float(np.abs(found).max()), 1.0
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


def _read(scene: Scene) -> tuple[MeshFile, dict[str, int]]:
    shape: Any = scene.geometry
    file, _, regions = shape.checked(scene.mesh)
    return file, regions


def _is_whole(file: MeshFile) -> bool:
    """Whether no element is twisted."""
    determinants = jacobian_determinants(file)
    return bool((determinants * np.sign(determinants.mean()) > 0).all())


def _newton_step(simulation: Simulation, given: Array, share: float) -> Array | None:
    """How the unloaded nodes move, (nodes, 3) in the order of the file, on all ranks; None beyond the limits.

    Parameters
    ----------
    simulation
        Of the mesh as it is now.
    given
        Loaded places.
    share
        Of the loads.
    """
    domain, state, scene = simulation.domain, simulation.state, simulation.scene
    equilibrium, unknown = simulation.stepper.coupling.equilibrium, simulation.unknown
    loads = simulation.load_values(scene.end_of_ramps)
    state.loading.set({name: share * value for name, value in loads.items()})
    dofs = dof_of_node(domain, unknown.function_space)
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
    _solve(matrix, right, move.x.petsc_vec)
    move.x.scatter_forward()
    for thing in (matrix, right, external, lift):
        thing.destroy()
    if over_ranks(domain.comm, not np.isfinite(move.x.array).all(), MPI.LOR):
        return None
    found: Array = domain.comm.bcast(domain.gather_nodes(move.x.array.reshape(-1, 3)[dofs]))
    return found


def _tangents(simulation: Simulation, move: Any) -> list[Any]:
    """Derivative of the residual by the unloaded places, UFL forms to be added up; `move` is zero.

    Compiled one by one: in one kernel they take the compiler minutes.
    """
    state, unknown = simulation.state, simulation.unknown
    equilibrium, kinematics, mesh = simulation.stepper.coupling.equilibrium, state.kinematics, simulation.domain.mesh
    test, trial = ufl.TestFunction(move.function_space), ufl.TrialFunction(move.function_space)
    back = ufl.Identity(3) - ufl.grad(move)  # (1 + grad w)^-1 and, below, det(1 + grad w), to first order
    F = kinematics.elastic(ufl.dot(kinematics.deformation_gradient(unknown), back))
    weight = kinematics.stress_free_weight(mesh)
    energies = state.dilatation.energies(equilibrium.tissue, F, [state.cells.ufl_cell], weight)
    forms = [second_derivative(energy, unknown, test, trial, move) for energy in energies]

    def larger(density: Any) -> Any:
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


def _solve(matrix: Any, right: Any, solution: Any) -> None:
    """By factors: the matrix is not symmetric."""
    solver = PETSc.KSP().create(matrix.comm)
    solver.setType(PETSc.KSP.Type.PREONLY)
    solver.getPC().setType(PETSc.PC.Type.LU)
    solver.getPC().setFactorSolverType(PETSc.Mat.SolverType.MUMPS)
    solver.setOperators(matrix)
    solver.solve(right, solution)
    solver.destroy()
