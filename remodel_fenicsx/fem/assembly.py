"""Forms and their numbers: what dolfinx and UFL leave to do so that a small problem is fast.

Sums over ranks, parameters as arguments of compiled kernels, values that are computed once for each state, tangents of
energies in few operations, matrices in memory that dolfinx and PETSc share.
"""

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
from numpy.typing import NDArray
from petsc4py import PETSc
from ufl.algorithms.map_integrands import map_integrands
from ufl.classes import Determinant, Inner, Sqrt, Trace
from ufl.corealg.traversal import traverse_unique_terminals, unique_post_traversal
from ufl.domain import extract_unique_domain

from remodel_fenicsx.fem import jit
from remodel_fenicsx.fem.kinematics import lagrange
from remodel_fenicsx.fem.solver_methods import ProblemOptions, multigrid_options

if TYPE_CHECKING:
    from dolfinx.fem import Constant, DirichletBC, Form, Function, FunctionSpace
    from dolfinx.mesh import Mesh
    from ufl.core.expr import Expr

    from remodel_fenicsx.fem.quadrature import Quadrature


# ---------------------------------------------------------------- a linear equation with a positive definite form

TOLERANCE = 1e-12  # relative, of the linear solve: what comes of it has ten digits on any number of ranks
ITERATION_LIMIT = 20_000  # lines of a thousand elements need some thousands


def rigid_motions(space: FunctionSpace, matrix: PETSc.Mat) -> PETSc.NullSpace:
    """Those of the space of a vector, which multigrid must know of its matrix."""
    place = matrix.createVecRight()
    place.array[:] = space.tabulate_dof_coordinates()[: place.getLocalSize() // 3].ravel()
    motions = PETSc.NullSpace().createRigidBody(place)
    place.destroy()
    return motions


def degree_one(space: FunctionSpace) -> tuple[FunctionSpace, PETSc.Mat]:
    """The same functions of degree 1, and the matrix that interpolates them. Collective."""
    below = lagrange(space.mesh, 1, tuple(space.value_shape)).function_space
    prolongation = dolfinx.fem.petsc.interpolation_matrix(below, space)
    prolongation.assemble()
    return below, prolongation


class DegreeOne:
    """Multigrid for elements of degree 2 whose next level is `degree_one`: all others then cost little. Collective."""

    def __init__(
        self,
        pc: PETSc.PC,
        next_level: tuple[FunctionSpace, PETSc.Mat],
        matrix: PETSc.Mat,
        elastic: bool,
    ):
        below, self._prolongation = next_level
        self._coarse = matrix.PtAP(self._prolongation)
        self._coarse.setBlockSize(below.dofmap.bs)
        if elastic:
            self._coarse.setNearNullSpace(rigid_motions(below, self._coarse))
        self._options = ProblemOptions(multigrid_options(), {})
        pc.setType("mg")
        pc.setMGLevels(2)
        pc.setMGType(PETSc.PC.MGType.ADDITIVE)
        pc.setMGInterpolation(1, self._prolongation)
        fine, coarse = pc.getMGSmoother(1), pc.getMGCoarseSolve()
        fine.setOptionsPrefix(self._options.prefix + "fine_")  # not those of GAMG's levels
        fine.setType("preonly")
        fine.getPC().setType("pbjacobi")
        coarse.setOperators(self._coarse)
        coarse.setType("preonly")
        self._options.apply(coarse.getPC())

    def renew(self, matrix: PETSc.Mat) -> None:
        """The next level of another matrix."""
        matrix.PtAP(self._prolongation, result=self._coarse)

    def destroy(self) -> None:
        """Free PETSc's objects."""
        self._options.close()
        self._coarse.destroy()


class SolveStopped(ArithmeticError):
    """The iterations did not converge."""


class Positive:
    """A positive definite form, which several solves share. Collective."""

    def __init__(self, bilinear: ufl.Form):
        self._form, self.space = jit.form(bilinear), bilinear.arguments()[0].ufl_function_space()
        self._matrix = create_matrix(self._form)

    @cached_property
    def _degree_one(self) -> tuple[FunctionSpace, PETSc.Mat]:
        """For all solves. Collective."""
        return degree_one(self.space)

    def solve(
        self,
        linear: ufl.Form | None,
        conditions: Sequence[DirichletBC] = (),
        multigrid: bool = False,
    ) -> Function:
        """The function u with bilinear(u, v) = linear(v) for all v; linear is 0 where it is None. Collective."""
        # Conjugate gradients, with no memory for factors. Multigrid is for where what is held is far away; it cannot be
        # where all is held.
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
        solver.setType("cg")
        solver.getPC().setType("gamg" if multigrid else "jacobi")
        levels = None
        if multigrid and self.space.ufl_element().degree > 1:
            levels = DegreeOne(solver.getPC(), self._degree_one, matrix, elastic=False)
        solver.setInitialGuessNonzero(True)
        solver.setTolerances(rtol=TOLERANCE, max_it=ITERATION_LIMIT)
        solver.solve(load, answer)
        reason, iterations = solver.getConvergedReason(), solver.getIterationNumber()
        unknown.x.scatter_forward()
        for thing in (solver, load, *([levels] if levels else [])):
            thing.destroy()
        if reason < 0:
            raise SolveStopped(f"the linear solve stopped after {iterations} iterations (reason {reason} of PETSc)")
        return unknown


T = TypeVar("T")

# ---------------------------------------------------------------- over ranks


def over_ranks(comm: MPI.Intracomm, value: Any, operation: MPI.Op) -> Any:
    """The operation over the values of all ranks, on all ranks. Collective."""
    # A run of one rank makes some ten of these in a Newton iteration, and a small problem has no time for them.
    return value if comm.size == 1 else comm.allreduce(value, operation)


def integral(form: Form) -> float:
    """Value of a compiled form without arguments, over all ranks. Collective."""
    return float(form.mesh.comm.allreduce(np.real(dolfinx.fem.assemble_scalar(form)), MPI.SUM))


def of_all_ranks(comm: MPI.Intracomm, value: Any) -> list[Any]:
    """The values of all ranks, on all ranks. Collective."""
    return [value] if comm.size == 1 else comm.allgather(value)


def agreed(comm: MPI.Intracomm, make: Callable[[], T]) -> T:
    """What `make` makes on every rank; what one of them refuses with a ValueError is refused on all. Collective."""
    made = refusal = None
    try:
        made = make()
    except ValueError as error:
        refusal = error
    refusal = next(filter(None, comm.allgather(refusal)), None)
    if refusal is not None:
        raise refusal
    return cast(T, made)


# ---------------------------------------------------------------- parameters of kernels


def coefficient(mesh: Mesh, name: str, value: float | Constant | Function) -> Constant | Function:
    """The value as forms take it, so that another value compiles nothing."""
    if isinstance(value, Real) and not isinstance(value, (bool, np.bool_)):
        value = dolfinx.fem.Constant(mesh, PETSc.ScalarType(float(value)))
    if not isinstance(value, (dolfinx.fem.Constant, dolfinx.fem.Function)):
        raise TypeError(
            f"{name} = {value!r:.60}: must be a number, a dolfinx Constant or a DG0 Function of this mesh, "
            f"not a {type(value).__name__}"
        )
    domain = extract_unique_domain(value)
    if domain is None or domain.ufl_cargo() is not mesh.ufl_domain().ufl_cargo():
        raise ValueError(f"{name}: belongs to another mesh; must be of this one")
    is_function = isinstance(value, dolfinx.fem.Function)
    element = value.function_space.ufl_element() if is_function else None
    if value.ufl_shape != () or (element and not (element.degree == 0 and element.discontinuous)):
        words = f"a {type(value).__name__} of shape {value.ufl_shape}" + (f", {element}" if element else "")
        raise ValueError(f"{name}: {words}; must be one number, or a scalar DG0 Function, one value an element")
    numbers = value.x.array if is_function else value.value
    if not mesh.comm.allreduce(bool(np.all(np.isfinite(numbers))), MPI.LAND):
        raise ValueError(f"{name} = {value if is_function else value.value}: must be finite everywhere")
    if is_function:
        return dolfinx.fem.Function(value.function_space, value.x, name=name)
    own = dolfinx.fem.Constant(mesh, PETSc.ScalarType(value.value))
    own._cpp_object = value._cpp_object
    return own


def point_values(value: Constant | Function, quadrature: Quadrature) -> NDArray[np.float64]:
    """Values of a coefficient at the quadrature points, (elements, points); ghosts included."""
    if isinstance(value, dolfinx.fem.Function):
        dofs = value.function_space.dofmap.list.reshape(-1)
        if dofs.size == np.prod(quadrature.shape):  # one at each point (as DG0 with one point an element)
            return quadrature.values(value, ()).copy()
        return np.repeat(np.real(value.x.array[dofs])[:, None], quadrature.shape[1], axis=1)
    return np.full(quadrature.shape, float(np.real(value.value)))


# ---------------------------------------------------------------- values computed once for each state


class Remembered(Generic[T]):
    """The last value, as long as nothing has changed that it depends on."""

    def __init__(self, comm: MPI.Intracomm | None, *expressions: Expr):
        self._comm = comm
        terminals = {terminal for expression in expressions for terminal in traverse_unique_terminals(expression)}
        functions = [terminal for terminal in terminals if isinstance(terminal, dolfinx.fem.Function)]
        constants = [terminal for terminal in terminals if isinstance(terminal, dolfinx.fem.Constant)]
        # their own memory; what is small is asked first, for one difference is enough
        self._arrays: list[NDArray[np.float64]] = sorted((f.x.array for f in functions), key=lambda array: array.size)
        self._numbers = [np.asarray(c.value) for c in constants]
        self._seen: list[NDArray[np.float64]] = []
        self._seen_numbers: list[bytes] | None = None
        self._value: T

    def __call__(self, make: Callable[[], T]) -> T:
        """The value, of `make` where it is not known yet."""
        numbers = [number.tobytes() for number in self._numbers]
        known = numbers == self._seen_numbers and all(map(np.array_equal, self._arrays, self._seen))
        if self._comm is not None:
            known = bool(over_ranks(self._comm, known, MPI.LAND))
        if not known:
            self.forget()  # should `make` fail
            self._value = make()
            self._remember(numbers)
        return self._value

    def forget(self) -> None:
        """The next value is made anew."""
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
    """Derivative of an energy by its unknowns, twice; its kernel takes a third of the time."""
    # An energy W(I_1, I_2, ...) of scalar invariants of F has sum_m W_m D(d I_m) + sum_mn W_mn d I_m D I_n. Left to
    # itself UFL puts test and trial function through every operation of W, and each of these is then 81 at a point in
    # three dimensions. Here they are operations on numbers, and each pair of invariants that W couples has one dyad.
    return map_integrands(lambda density: _of_density(density, unknown, test, trial), energy)


def _of_density(density: Expr, unknown: Function, test: Expr, trial: Expr) -> Expr:
    found = invariants(density, unknown)
    if not found:
        return ufl.derivative(ufl.derivative(density, unknown, test), unknown, trial)
    by_number = [(ufl.variable(invariant), invariant) for invariant in found]
    function = ufl.replace(density, {invariant: number for number, invariant in by_number})
    changes = [[ufl.derivative(invariant, unknown, way) for invariant in found] for way in (test, trial)]
    total = ufl.as_ufl(0)
    for (number, _), change in zip(by_number, changes[0], strict=True):
        slope = ufl.diff(function, number)
        total += slope * ufl.derivative(change, unknown, trial)
        for (partner, _), its_change in zip(by_number, changes[1], strict=True):
            total += ufl.diff(slope, partner) * (change * its_change)
    return total


def invariants(density: Expr, unknown: Function) -> list[Expr]:
    """Scalar products, determinants."""
    # The outermost ones; none at all where it depends on the unknown in another way too.
    depends: set[Expr] = set()
    for part in unique_post_traversal(density):  # operands come before what is made of them
        if part == unknown or any(operand in depends for operand in part.ufl_operands):
            depends.add(part)
    found: dict[Expr, None] = {}
    stack, seen = [density], set()
    while stack:
        part = stack.pop()
        if part in seen or part not in depends:
            continue
        seen.add(part)
        if part.ufl_shape == () and isinstance(part, (Inner, Determinant, Trace)):
            found[part] = None
        elif isinstance(part, Sqrt):
            found[part.ufl_operands[0]] = None
        elif part.ufl_operands:
            stack.extend(reversed(part.ufl_operands))
        else:
            return []
    return list(found)


# ---------------------------------------------------------------- matrices
SHARED = "dolfinx"  # attribute of a PETSc matrix: dolfinx's own, with the starts of its rows and the column numbers


def create_matrix(form: Form) -> PETSc.Mat:
    """An empty PETSc matrix with the pattern of a compiled bilinear form. Collective."""
    # Forms are assembled into a `dolfinx.la.MatrixCSR`. On one rank its memory is that of the matrix; on several ranks
    # the matrix takes its values as a whole. Either way none goes through PETSc's insertion, which takes as long as the
    # kernels.
    shared = dolfinx.fem.create_matrix(form, dolfinx.la.BlockMode.expanded)
    block, matrix = form.function_spaces[0].dofmap.index_map_bs, PETSc.Mat()
    rows, columns = (shared.index_map(axis) for axis in (0, 1))
    size = rows.size_local
    starts, numbers = shared.indptr[: size + 1].astype(PETSc.IntType), shared.indices[: shared.indptr[size]]
    if form.mesh.comm.size == 1:
        numbers = numbers.astype(PETSc.IntType, copy=False)
        matrix.createAIJWithArrays((size, size), (starts, numbers, shared.data), comm=form.mesh.comm)
        matrix.setBlockSizes(block, block)  # for multigrid
    else:
        numbers = columns.local_to_global(numbers).astype(PETSc.IntType)
        matrix.createAIJ(((size, None), (size, None)), block, csr=(starts, numbers, None), comm=form.mesh.comm)
    matrix.setAttr(SHARED, (shared, starts, numbers))
    return matrix


def assemble_matrix(
    matrix: PETSc.Mat,
    forms: Sequence[Form],
    conditions: Sequence[DirichletBC],
) -> None:
    """The sum of compiled bilinear forms; zero in the rows and columns of conditions, one on their diagonal."""
    shared, starts, numbers = matrix.getAttr(SHARED)
    shared.set_value(0.0)
    assemble: Any = dolfinx.fem.assemble_matrix  # mypy sees one overload of a single-dispatch function
    for form in forms:
        assemble(shared, form, bcs=list(conditions))
    if matrix.comm.size > 1:
        shared.scatter_reverse()
        matrix.setValuesCSR(starts, numbers, shared.data[: len(numbers)])
    matrix.assemble()
