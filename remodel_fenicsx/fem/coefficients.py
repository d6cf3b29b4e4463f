"""Parameters as arguments of the compiled kernels: one number for the body, or one for each element."""

from __future__ import annotations

from numbers import Real
from typing import Any

import dolfinx.fem
import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from remodel_fenicsx.fem.quadrature import Quadrature


def coefficient(mesh: Any, name: str, value: Any) -> Any:
    """The value as forms take it, so that another value compiles nothing.

    Parameters
    ----------
    mesh
        dolfinx mesh of the forms.
    name
        Of the parameter, for errors.
    value
        A number, which becomes a Constant; a scalar dolfinx Constant, or a scalar DG0 Function of this mesh, which stay
        the user's: what is returned shares their memory. It is an object of its own, because UFL numbers constants and
        functions by their age, and kernels are found again by these numbers.

    Raises
    ------
    TypeError
        If it is anything else.
    ValueError
        If a value is not finite, or a Constant or Function belongs to another mesh or has another shape.
    """
    if isinstance(value, Real) and not isinstance(value, (bool, np.bool_)):
        if not np.isfinite(float(value)):
            raise ValueError(f"{name} = {value}: must be finite")
        return dolfinx.fem.Constant(mesh, PETSc.ScalarType(float(value)))
    if isinstance(value, dolfinx.fem.Constant):
        _require_this_mesh(mesh, name, value.ufl_domain())
        if value.ufl_shape != ():
            raise ValueError(f"{name}: a Constant of shape {value.ufl_shape}; must be a scalar")
        if not np.all(np.isfinite(value.value)):
            raise ValueError(f"{name} = {value.value}: must be finite")
        own = dolfinx.fem.Constant(mesh, PETSc.ScalarType(value.value))
        own._cpp_object = value._cpp_object
        return own
    if isinstance(value, dolfinx.fem.Function):
        space = value.function_space
        _require_this_mesh(mesh, name, space.mesh.ufl_domain())
        element = space.ufl_element()
        if element.degree != 0 or not element.discontinuous or value.ufl_shape != ():
            raise ValueError(f"{name}: {_described(value)}; must be a scalar DG0 Function, one value an element")
        finite = bool(np.all(np.isfinite(value.x.array)))
        if not mesh.comm.allreduce(finite, MPI.LAND):
            raise ValueError(f"{name}: a Function with values that are not finite; every one must be")
        return dolfinx.fem.Function(space, value.x, name=name)
    raise TypeError(
        f"{name} = {value!r:.60}: must be a number, a dolfinx Constant or a DG0 Function of this mesh, "
        f"not a {type(value).__name__}"
    )


def _described(function: Any) -> str:
    """What a Function is, on one line."""
    element = function.function_space.ufl_element()
    family, shape = getattr(element, "family_name", "quadrature"), function.ufl_shape
    return f"a Function of {family} elements of degree {element.degree}" + (f" and shape {shape}" if shape else "")


def _require_this_mesh(mesh: Any, name: str, domain: Any) -> None:
    if domain is None or domain.ufl_cargo() is not mesh.ufl_domain().ufl_cargo():
        raise ValueError(f"{name}: belongs to another mesh; must be of this one")


def point_values(value: Any, quadrature: Quadrature) -> NDArray[np.float64]:
    """Values of a coefficient at the quadrature points, (elements, points); ghosts included."""
    if isinstance(value, dolfinx.fem.Function):
        dofs = value.function_space.dofmap.list.reshape(-1)
        return np.repeat(np.real(value.x.array[dofs])[:, None], quadrature.shape[1], axis=1)
    return np.full(quadrature.shape, float(np.real(value.value)))


def largest(value: Any, mesh: Any) -> float:
    """Largest value of a coefficient in the body, over all ranks."""
    if isinstance(value, dolfinx.fem.Function):
        owned = value.function_space.dofmap.index_map.size_local
        local = float(np.max(np.real(value.x.array[:owned]), initial=-np.inf))
        return float(mesh.comm.allreduce(local, MPI.MAX))
    return float(np.real(value.value))
