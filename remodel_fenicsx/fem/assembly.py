"""Reductions over ranks, coefficients, cached values, tangents, matrices and linear solves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from numbers import Real
from typing import Any, cast, Generic, TYPE_CHECKING, TypeVar

import dolfinx.fem
import dolfinx.fem.petsc
import dolfinx.la
import numpy as np
import ufl
from mpi4py import MPI
from petsc4py import PETSc
from ufl.algorithms.map_integrands import map_integrands
from ufl.classes import Determinant, Inner, Sqrt, Trace
from ufl.corealg.traversal import traverse_unique_terminals, unique_post_traversal
from ufl.domain import extract_unique_domain

from remodel_fenicsx.fem import jit
from remodel_fenicsx.fem.kinematics import lagrange
from remodel_fenicsx.fem.solver_methods import ProblemOptions, levels_options
from remodel_fenicsx.model.tensors import Array

if TYPE_CHECKING:
    from dolfinx.fem import Constant, DirichletBC, Form, Function, FunctionSpace
    from dolfinx.mesh import Mesh
    from ufl.core.expr import Expr

    from remodel_fenicsx.fem.quadrature import Quadrature


# ---------------------------------------------------------------- linear equations

# Relative tolerance of the linear solve. Its results have ten digits on any number of ranks.
TOLERANCE = 1e-12
ITERATION_LIMIT = 20_000  # a thousand elements in a line need some thousands


def rigid_body_modes(space: FunctionSpace, matrix: PETSc.Mat) -> PETSc.NullSpace:
    """Return a vector space's rigid body modes, the near null space of multigrid. Collective."""
    place = matrix.createVecRight()
    place.array[:] = space.tabulate_dof_coordinates()[: place.getLocalSize() // 3].ravel()
    motions = PETSc.NullSpace().createRigidBody(place)
    place.destroy()
    return motions


def prolongation_from_degree_one(space: FunctionSpace) -> PETSc.Mat:
    """Return the matrix that interpolates from degree 1 to the space. Collective."""
    below = lagrange(space.mesh, 1, tuple(space.value_shape)).function_space
    prolongation = dolfinx.fem.petsc.interpolation_matrix(below, space)
    prolongation.assemble()
    return prolongation


class PMultigrid:
    """Multigrid for elements of degree 2, with degree 1 as the lower level. Collective."""

    # A factor of the lower level is cheap: it has an eighth of the unknowns.

    def __init__(self, pc: PETSc.PC, prolongation: PETSc.Mat, matrix: PETSc.Mat):
        self._prolongation = prolongation
        self._fine: PETSc.Mat = None  # a copy without blocks of a matrix with them
        self._coarse = self._without_blocks(matrix).PtAP(self._prolongation)
        self._options = ProblemOptions(levels_options(matrix.comm.size), {})
        # The solvers of the levels take the prefix that the preconditioner has when they are made.
        self._options.apply(pc)
        pc.setMGInterpolation(1, self._prolongation)
        pc.getMGCoarseSolve().setOperators(self._coarse)

    def renew(self, matrix: PETSc.Mat) -> None:
        """Compute the next level for another matrix. Collective."""
        self._without_blocks(matrix).PtAP(self._prolongation, result=self._coarse)

    def _without_blocks(self, matrix: PETSc.Mat) -> PETSc.Mat:
        if "baij" not in matrix.getType():
            return matrix
        self._fine = matrix.convert(PETSc.Mat.Type.AIJ, self._fine or PETSc.Mat())
        return self._fine

    def destroy(self) -> None:
        """Free the objects of PETSc."""
        self._options.close()
        if self._fine is not None:
            self._fine.destroy()
        self._coarse.destroy()


class LinearSolveFailure(ArithmeticError):
    """Failure of an iterative linear solve to converge."""


class SpdSolver:
    """Linear solver for a positive definite form, used by several solves. Collective."""

    def __init__(self, bilinear: ufl.Form):
        self._form, self.space = jit.form(bilinear), bilinear.arguments()[0].ufl_function_space()
        self._matrix = create_matrix(self._form)

    @cached_property
    def _prolongation(self) -> PETSc.Mat:
        """Interpolation from degree 1, for all solves. Collective on first access."""
        return prolongation_from_degree_one(self.space)

    def solve(
        self,
        linear: ufl.Form | None,
        conditions: Sequence[DirichletBC] = (),
        multigrid: bool = False,
    ) -> Function:
        """Return u with bilinear(u, v) = linear(v) for all v; None stands for 0. Collective."""
        # Conjugate gradients need no memory for a factorisation. Multigrid helps if the constrained
        # dofs are far away. For degree 2 it is not symmetric, which flexible gradients allow.
        unknown, matrix = dolfinx.fem.Function(self.space), self._matrix
        answer = unknown.x.petsc_vec
        load, conditions = answer.duplicate(), list(conditions)
        assemble_matrix(matrix, [self._form], conditions)
        with load.localForm() as local:
            local.array_w[:] = 0.0
        if linear is not None:
            dolfinx.fem.petsc.assemble_vector(load, jit.form(linear))
        dolfinx.fem.petsc.apply_lifting(load, [self._form], bcs=[conditions])
        load.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
        dolfinx.fem.petsc.set_bc(load, conditions)
        for condition in conditions:
            condition.set(unknown.x.array)
        solver = PETSc.KSP().create(matrix.comm)
        solver.setOperators(matrix)
        # If all dofs are constrained, as in one layer of elements, the first guess is the solution.
        multigrid &= (load - matrix * answer).norm() > TOLERANCE * load.norm()
        solver.setType("fcg" if multigrid else "cg")
        solver.getPC().setType("gamg" if multigrid else "jacobi")
        levels = None
        if multigrid and self.space.ufl_element().degree > 1:
            levels = PMultigrid(solver.getPC(), self._prolongation, matrix)
        solver.setInitialGuessNonzero(True)
        solver.setTolerances(rtol=TOLERANCE, max_it=ITERATION_LIMIT)
        solver.solve(load, answer)
        reason, iterations = solver.getConvergedReason(), solver.getIterationNumber()
        unknown.x.scatter_forward()
        for thing in (solver, load, *([levels] if levels else [])):
            thing.destroy()
        if reason < 0:
            raise LinearSolveFailure(
                f"no convergence in {iterations} iterations of the linear solve (reason {reason})"
            )
        return unknown


T = TypeVar("T")

# ---------------------------------------------------------------- over ranks


def allreduce(comm: MPI.Intracomm, value: Any, operation: MPI.Op) -> Any:
    """Return the reduction of the values of all ranks, on all ranks. Collective."""
    # A Newton iteration needs about ten reductions, and a small problem on one rank has no time for
    # them.
    return value if comm.size == 1 else comm.allreduce(value, operation)


def integral(form: Form) -> float:
    """Return the value of a compiled form without arguments, over all ranks. Collective."""
    return float(form.mesh.comm.allreduce(np.real(dolfinx.fem.assemble_scalar(form)), MPI.SUM))


def allgather(comm: MPI.Intracomm, value: Any) -> list[Any]:
    """Return the values of all ranks, on all ranks. Collective."""
    return [value] if comm.size == 1 else comm.allgather(value)


def raise_on_all_ranks(comm: MPI.Intracomm, make: Callable[[], T]) -> T:
    """Return the result of `make`; raise a ValueError of any rank on all ranks. Collective."""
    made = refusal = None
    try:
        made = make()
    except ValueError as error:
        refusal = error
    refusal = next(filter(None, allgather(comm, refusal)), None)
    if refusal is not None:
        raise refusal
    return cast(T, made)


# ---------------------------------------------------------------- parameters of kernels


def coefficient(mesh: Mesh, name: str, value: float | Constant | Function) -> Constant | Function:
    """Return a coefficient of forms, so that another value compiles nothing. Collective."""
    if isinstance(value, Real) and not isinstance(value, (bool, np.bool_)):
        value = dolfinx.fem.Constant(mesh, PETSc.ScalarType(float(value)))
    if not isinstance(value, (dolfinx.fem.Constant, dolfinx.fem.Function)):
        raise TypeError(
            f"{name} = {value!r:.60}: must be a number, a dolfinx Constant "
            f"or a DG0 Function of this mesh, not a {type(value).__name__}"
        )
    domain = extract_unique_domain(value)
    if domain is None or domain.ufl_cargo() is not mesh.ufl_domain().ufl_cargo():
        raise ValueError(f"{name}: belongs to another mesh; must be of this one")
    is_function = isinstance(value, dolfinx.fem.Function)
    element = value.function_space.ufl_element() if is_function else None
    if value.ufl_shape != () or (element and not (element.degree == 0 and element.discontinuous)):
        words = f"a {type(value).__name__} of shape {value.ufl_shape}" + (
            f", {element}" if element else ""
        )
        raise ValueError(
            f"{name}: {words}; must be one number, or a scalar DG0 Function, one value an element"
        )
    numbers = value.x.array if is_function else value.value
    if not mesh.comm.allreduce(bool(np.all(np.isfinite(numbers))), MPI.LAND):
        raise ValueError(
            f"{name} = {value if is_function else value.value}: must be finite everywhere"
        )
    if is_function:
        return dolfinx.fem.Function(value.function_space, value.x, name=name)
    own = dolfinx.fem.Constant(mesh, PETSc.ScalarType(value.value))
    own._cpp_object = value._cpp_object
    return own


def point_values(value: Constant | Function, quadrature: Quadrature) -> Array:
    """Return a coefficient's values at the quadrature points, (elements, points), with ghosts."""
    if isinstance(value, dolfinx.fem.Function):
        dofmap = value.function_space.dofmap
        dofs = dofmap.list.reshape(-1)
        # One value per point, also DG0 with one point per element.
        if dofs.size == np.prod(quadrature.shape):
            return quadrature.values(value, ()).copy()
        return np.repeat(np.real(value.x.array[dofs])[:, None], quadrature.shape[1], axis=1)
    return np.full(quadrature.shape, float(np.real(value.value)))


# ---------------------------------------------------------------- cached values


class CachedValue(Generic[T]):
    """Cache of one value, valid until a function or constant of the expressions changes."""

    def __init__(self, comm: MPI.Intracomm | None, *expressions: Expr):
        self._comm = comm
        terminals = {
            terminal
            for expression in expressions
            for terminal in traverse_unique_terminals(expression)
        }
        functions = [
            terminal for terminal in terminals if isinstance(terminal, dolfinx.fem.Function)
        ]
        constants = [
            terminal for terminal in terminals if isinstance(terminal, dolfinx.fem.Constant)
        ]
        # Arrays are the functions' own memory. Small ones come first, because one difference is
        # enough.
        self._arrays: list[Array] = sorted(
            (f.x.array for f in functions), key=lambda array: array.size
        )
        self._numbers = [np.asarray(c.value) for c in constants]
        self._seen: list[Array] = []
        self._seen_numbers: list[bytes] | None = None
        self._value: T

    def __call__(self, make: Callable[[], T]) -> T:
        """Return the cached value, or compute it with `make`. Collective with a communicator."""
        numbers = [number.tobytes() for number in self._numbers]
        known = numbers == self._seen_numbers and all(map(np.array_equal, self._arrays, self._seen))
        if self._comm is not None:
            known = allreduce(self._comm, known, MPI.LAND)
        if not known:
            self.forget()  # in case `make` fails
            self._value = make()
            self._remember(numbers)
        return self._value

    def forget(self) -> None:
        """Invalidate the cache: the next call computes the value again."""
        self._seen_numbers = None

    def _remember(self, numbers: list[bytes]) -> None:
        if not self._seen:
            self._seen = [array.copy() for array in self._arrays]
        for array, seen in zip(self._arrays, self._seen, strict=True):
            if not np.array_equal(array, seen):
                seen[:] = array
        self._seen_numbers = numbers


# ---------------------------------------------------------------- the tangent of an energy


def second_derivative(energy: ufl.Form, unknown: Function, test: Expr, trial: Expr) -> ufl.Form:
    """Return the second derivative of an energy; its kernel takes a third of the time of UFL's."""
    # An energy W(I_1, I_2, ...) of scalar invariants of F has sum_m W_m D(d I_m) + sum_mn W_mn d
    # I_m D I_n. UFL alone differentiates every operation of W by test and trial function, which
    # makes 81 operations of each at a point in three dimensions. Here these are operations on
    # numbers, and each pair of invariants that W couples has one dyad.
    return map_integrands(lambda density: _of_density(density, unknown, test, trial), energy)


def _of_density(density: Expr, unknown: Function, test: Expr, trial: Expr) -> Expr:
    scalars = invariants(density, unknown)
    if not scalars:
        return ufl.derivative(ufl.derivative(density, unknown, test), unknown, trial)
    by_number = [(ufl.variable(invariant), invariant) for invariant in scalars]
    function = ufl.replace(density, {invariant: number for number, invariant in by_number})
    changes = [
        [ufl.derivative(invariant, unknown, way) for invariant in scalars] for way in (test, trial)
    ]
    total = ufl.as_ufl(0)
    for (number, _), change in zip(by_number, changes[0], strict=True):
        slope = ufl.diff(function, number)
        total += slope * ufl.derivative(change, unknown, trial)
        for (partner, _), its_change in zip(by_number, changes[1], strict=True):
            total += ufl.diff(slope, partner) * (change * its_change)
    return total


def invariants(density: Expr, unknown: Function) -> list[Expr]:
    """Return the outermost scalar products, determinants, traces and radicands of a density."""
    # The list is empty if the density depends on the unknown in another way too.
    depends: set[Expr] = set()
    for part in unique_post_traversal(density):  # operands come before their results
        if part == unknown or any(operand in depends for operand in part.ufl_operands):
            depends.add(part)
    scalars: dict[Expr, None] = {}
    stack, seen = [density], set()
    while stack:
        part = stack.pop()
        if part in seen or part not in depends:
            continue
        seen.add(part)
        if part.ufl_shape == () and isinstance(part, (Inner, Determinant, Trace)):
            scalars[part] = None
        elif isinstance(part, Sqrt):
            scalars[part.ufl_operands[0]] = None
        elif part.ufl_operands:
            stack.extend(reversed(part.ufl_operands))
        else:
            return []
    return list(scalars)


# ---------------------------------------------------------------- matrices
SHARED = "dolfinx"  # attribute of a PETSc matrix: dolfinx's matrix, row starts and column numbers


def create_matrix(form: Form, blocked: bool = False) -> PETSc.Mat:
    """Return an empty PETSc matrix with the pattern of a compiled bilinear form. Collective.

    If `blocked`, it has an entry per pair of nodes: products and sweeps take 0.8 of the time.
    """
    # Forms are assembled into a `dolfinx.la.MatrixCSR`. On one rank the matrix uses its memory. On
    # several ranks, and in blocks, the matrix takes all values in one call. Both avoid PETSc's
    # insertion, which takes as long as the kernels.
    mode = dolfinx.la.BlockMode.compact if blocked else dolfinx.la.BlockMode.expanded
    shared = dolfinx.fem.create_matrix(form, mode)
    block, matrix = form.function_spaces[0].dofmap.index_map_bs, PETSc.Mat()
    rows, columns = (shared.index_map(axis) for axis in (0, 1))
    size = rows.size_local
    starts, numbers = (
        shared.indptr[: size + 1].astype(PETSc.IntType),
        shared.indices[: shared.indptr[size]],
    )
    if form.mesh.comm.size == 1 and not blocked:
        numbers = numbers.astype(PETSc.IntType, copy=False)
        matrix.createAIJWithArrays(
            (size, size), (starts, numbers, shared.data), comm=form.mesh.comm
        )
        matrix.setBlockSizes(block, block)  # for multigrid
    else:
        numbers = columns.local_to_global(numbers).astype(PETSc.IntType)
        make = matrix.createBAIJ if blocked else matrix.createAIJ
        sizes = (size * shared.block_size[0], None)
        make((sizes, sizes), block, csr=(starts, numbers, None), comm=form.mesh.comm)
    matrix.setAttr(SHARED, (shared, starts, numbers))
    return matrix


def assemble_matrix(
    matrix: PETSc.Mat,
    forms: Sequence[Form],
    conditions: Sequence[DirichletBC],
) -> None:
    """Assemble the sum of bilinear forms; conditions zero rows and columns, with unit diagonal."""
    shared, starts, numbers = matrix.getAttr(SHARED)
    shared.set_value(0.0)
    # Mypy sees one overload of a single-dispatch function.
    assemble: Any = dolfinx.fem.assemble_matrix
    for form in forms:
        assemble(shared, form, bcs=list(conditions))
    block = shared.block_size[0]
    if matrix.comm.size > 1:
        shared.scatter_reverse()
    if matrix.comm.size > 1 or block > 1:
        insert = matrix.setValuesBlockedCSR if block > 1 else matrix.setValuesCSR
        insert(starts, numbers, shared.data[: len(numbers) * block**2])
    matrix.assemble()
