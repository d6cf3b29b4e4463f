"""One linear equation with a symmetric, positive definite form."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import dolfinx.fem
import dolfinx.la
from petsc4py import PETSc

from remodel_fenicsx.fem import jit
from remodel_fenicsx.fem.assembly import assemble_matrix, create_matrix

TOLERANCE = 1e-12  # relative, of the linear solve: what comes of it has ten digits on any number of ranks
ITERATION_LIMIT = 20_000  # lines of a thousand elements need some thousands


class SolveStopped(ArithmeticError):
    """The iterations did not converge."""


def solve_positive(bilinear: Any, linear: Any, unknown: Any, conditions: Sequence[Any] = ()) -> None:
    """Solve bilinear(unknown, v) = linear(v) for all v. Collective.

    Conjugate gradients with Jacobi's preconditioner: the same numbers each time, and no memory for factors.

    Parameters
    ----------
    bilinear, linear
        UFL forms; `linear` may be None for zero.
    unknown
        dolfinx function; its values where no condition holds are where the iterations start.
    conditions
        dolfinx Dirichlet conditions on its space.

    Raises
    ------
    SolveStopped
        If they do not converge.
    """
    tangent = jit.form(bilinear)
    for condition in conditions:
        condition.set(unknown.x.array)
    matrix, start = create_matrix(tangent), unknown.x.petsc_vec
    assemble_matrix(matrix, [tangent], [])
    load, change = start.duplicate(), start.duplicate()
    change.set(0.0)
    matrix.mult(start, load)
    load.scale(-1.0)
    if linear is not None:
        external = dolfinx.fem.assemble_vector(jit.form(linear))
        external.scatter_reverse(dolfinx.la.InsertMode.add)
        load.array[:] += external.array[: load.getLocalSize()]
    for condition in conditions:
        dofs, _ = condition.dof_indices()  # of a vector, dolfinx counts ghosts among its own ones
        load.array[dofs[dofs < load.getLocalSize()]] = 0.0
    if conditions:
        assemble_matrix(matrix, [tangent], conditions)
    solver = PETSc.KSP().create(unknown.function_space.mesh.comm)  # type: ignore[attr-defined]
    solver.setOperators(matrix)
    solver.setType("cg")
    solver.getPC().setType("jacobi")
    solver.setTolerances(rtol=TOLERANCE, max_it=ITERATION_LIMIT)
    solver.solve(load, change)
    reason, iterations = solver.getConvergedReason(), solver.getIterationNumber()
    start.axpy(1.0, change)
    unknown.x.scatter_forward()
    for thing in (solver, matrix, load, change):
        thing.destroy()
    if reason < 0:
        raise SolveStopped(f"the linear solve stopped after {iterations} iterations (reason {reason} of PETSc)")
