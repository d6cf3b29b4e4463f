"""Laplace's equation on a mesh: the field between faces that hold it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import dolfinx.fem
import dolfinx.fem.petsc
import numpy as np
import numpy.typing as npt
import ufl
from mpi4py import MPI
from petsc4py import PETSc

from remodel_fenicsx.fem import jit
from remodel_fenicsx.fem.assembly import assemble_matrix, create_matrix
from remodel_fenicsx.fem.kinematics import lagrange

Facets = npt.NDArray[np.int32]
TOLERANCE = 1e-10  # relative, of the linear solve: lengths and axes have ten digits on any number of ranks


def harmonic(mesh: Any, degree: int, held: Sequence[tuple[Facets, float]]) -> Any:
    """The function of this degree with given values on facets, and no flux through the rest of the boundary. Collective.

    Parameters
    ----------
    mesh, degree
        dolfinx mesh, and degree of the function's elements.
    held
        Local facets, with the value on them.

    Raises
    ------
    RuntimeError
        If the linear solve does not converge.
    """
    found = lagrange(mesh, degree, ())
    space = found.function_space
    conditions = []
    for facets, value in held:
        dofs = dolfinx.fem.locate_dofs_topological(space, mesh.topology.dim - 1, facets)
        conditions.append(dolfinx.fem.dirichletbc(PETSc.ScalarType(value), dofs, space))  # type: ignore[attr-defined]
        found.x.array[dofs] = value
    test, trial = ufl.TestFunction(space), ufl.TrialFunction(space)
    dx = ufl.Measure("dx", domain=mesh, metadata={"quadrature_degree": 2 * degree})
    form = jit.form(ufl.inner(ufl.grad(trial), ufl.grad(test)) * dx)
    matrix = create_matrix(form)
    assemble_matrix(matrix, [form], [])
    start = found.x.petsc_vec
    load = start.duplicate()
    matrix.mult(start, load)
    load.scale(-1.0)
    assemble_matrix(matrix, [form], conditions)
    rows = np.unique(np.concatenate([condition.dof_indices()[0] for condition in conditions]))
    owned = rows[rows < space.dofmap.index_map.size_local]
    load.array[owned] = 0.0
    change, solver = start.duplicate(), PETSc.KSP().create(mesh.comm)  # type: ignore[attr-defined]
    solver.setOperators(matrix)
    solver.setType("cg")
    solver.getPC().setType("jacobi")
    solver.setTolerances(rtol=TOLERANCE, max_it=10_000)
    solver.solve(load, change)
    reason = solver.getConvergedReason()
    start.axpy(1.0, change)
    found.x.scatter_forward()
    for one in (solver, matrix, load, change):
        one.destroy()
    if reason < 0:
        raise RuntimeError(f"Laplace's equation on the mesh: the linear solve stopped with {reason}")
    return found


def integral_of_slope(field: Any) -> float:
    """Integral of |grad| over the volume. Collective."""
    mesh = field.function_space.mesh
    dx = ufl.Measure("dx", domain=mesh, metadata={"quadrature_degree": 4})
    form = jit.form(ufl.sqrt(ufl.inner(ufl.grad(field), ufl.grad(field))) * dx)
    return float(mesh.comm.allreduce(np.real(dolfinx.fem.assemble_scalar(form)), MPI.SUM))
