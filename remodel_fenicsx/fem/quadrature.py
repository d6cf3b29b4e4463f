"""Quadrature points: one rule for unit cells, forms and stress."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, TYPE_CHECKING

import basix
import basix.ufl
import dolfinx.fem
import dolfinx.la
import numpy as np
import ufl
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx._renamed import with_old_names
from remodel_fenicsx.fem import jit
from remodel_fenicsx.fem.assembly import allgather, allreduce
from remodel_fenicsx.fem.compat import geometry_dofmap
from remodel_fenicsx.model.tensors import Array

if TYPE_CHECKING:
    from dolfinx.fem import Function, FunctionSpace
    from dolfinx.mesh import Mesh
    from ufl.core.expr import Expr

# Degrees of the elements' rules, because UFL's estimate for this energy is far too high.
DEGREES = {
    **{
        (kind, degree): 2 * degree
        for kind in ("interval", "quadrilateral", "hexahedron")
        for degree in (1, 2)
    },
    ("tetrahedron", 1): 1,
    ("tetrahedron", 2): 2,
}


def shape_functions(kind: str, degree: int, points: Array) -> Array:
    """Return values, then slopes of a Lagrange element, (1 + dimension, points, nodes)."""
    family, variant = basix.ElementFamily.P, basix.LagrangeVariant.gll_warped
    element = basix.create_element(
        family, basix.CellType[kind], degree, variant, discontinuous=degree == 0
    )
    return np.asarray(element.tabulate(1, points))[..., 0]


def expression_values(
    expression: Sequence[dolfinx.fem.Expression],
    mesh: Mesh,
    elements: NDArray[np.int32],
    points: int,
) -> Array:
    """Evaluate a compiled expression (`jit.expression`), (elements, points, components)."""
    values = [
        part.eval(mesh, elements).reshape(len(elements), points, *part.ufl_expression.ufl_shape)
        for part in expression
    ]
    return values[0] if len(values) == 1 else np.concatenate(values, axis=2)


@with_old_names
class Quadrature:
    """Quadrature points of a mesh, with functions and reductions over them.

    Arrays over the points have shape (elements, points, ...): all elements this rank knows, owned
    first, then ghosts. Nothing at a point depends on another point, so updates need no
    communication.

    Parameters
    ----------
    mesh
        dolfinx mesh.
    element_degree
        Degree of the displacement element (1 or 2); decides the rule.
    weight
        Volume of the body per unit of mesh, a number or UFL (`Kinematics.weight`).

    Attributes
    ----------
    shape
        (elements of this rank with ghosts, points per element).
    coordinates
        Reference coordinates of the points, (elements, points, 3).
    volumes
        Weight of the points in integrals over the body, (elements, points).
    extent
        Mean length of an element in every direction of the mesh.
    smallest_lengths
        Smallest extent of the elements at the points, per unit of the reference element,
        (elements, points).
    largest_areas, smallest_areas
        Volume over the smallest and over the largest extent, (elements,). A stress times these
        areas is about the largest and the smallest force that it causes at a node of the element.

    Examples
    --------
    >>> import numpy as np
    >>> from remodel_fenicsx import parts
    >>> domain = parts.Cube(side=2.0).build(parts.Mesh())
    >>> quadrature = parts.Quadrature(domain.mesh, element_degree=1)
    >>> quadrature.shape  # (elements, points)
    (1, 8)
    >>> round(quadrature.volume, 12), round(quadrature.mean(quadrature.coordinates[..., 2]), 12)
    (8.0, 1.0)
    >>> round(quadrature.integral(np.full(quadrature.shape, 0.5)), 12)
    4.0
    """

    def __init__(self, mesh: Mesh, element_degree: int, weight: Expr | float = 1):
        self.mesh, self.element_degree = mesh, element_degree
        self._spaces: dict[tuple[int, ...], FunctionSpace] = {}
        self._complements: dict[int, Array] = {}
        self.element_kind = mesh.topology.cell_name()
        self.degree = DEGREES[self.element_kind, element_degree]
        points, weights = basix.make_quadrature(basix.CellType[self.element_kind], self.degree)
        self.points = np.asarray(points, dtype=np.float64)
        self.weights = np.asarray(weights, dtype=np.float64)
        dimension = mesh.topology.dim
        elements = mesh.topology.index_map(dimension)
        self.number_of_owned_elements = elements.size_local
        self.elements = np.arange(elements.size_local + elements.num_ghosts, dtype=np.int32)
        self.shape = len(self.elements), len(self.weights)
        self.coordinates, lengths = self._geometry()
        # the product of an element's extents is |det J|, on lines and surfaces too
        self.volumes: Array = lengths.prod(axis=2) * self.weights
        self.extent = float(
            (self.integral(np.ones(self.shape)) / elements.size_global) ** (1 / dimension)
        )
        if not isinstance(weight, (int, float)):
            weight = self.evaluate(
                jit.expression(weight, self.points, "the volume of the body per unit of mesh"), ()
            )
        self.volumes = self.volumes * weight
        self.smallest_lengths = np.asarray(lengths[..., -1], dtype=np.float64)
        self.largest_areas: Array = (self.volumes / lengths[..., -1]).sum(axis=1)
        self.smallest_areas: Array = (self.volumes / lengths[..., 0]).sum(axis=1)

    def _geometry(self) -> tuple[Array, Array]:
        """Return points and the Jacobian's singular values, descending, (elements, points, ...)."""
        element = self.mesh.ufl_domain().ufl_coordinate_element().basix_element
        functions = element.tabulate(1, self.points)[..., 0]
        nodes = self.mesh.geometry.x[geometry_dofmap(self.mesh)[self.elements]]
        slopes = functions[1:].swapaxes(0, 1).reshape(-1, functions.shape[2])
        jacobians = (slopes @ nodes).reshape(len(nodes), *self.points.shape, 3)
        return functions[0] @ nodes, np.linalg.svd(jacobians, compute_uv=False)

    @property
    def dx(self) -> ufl.Measure:
        """Volume measure at exactly these points."""
        return ufl.Measure("dx", domain=self.mesh, metadata={"quadrature_degree": self.degree})

    def function(self, name: str, value_shape: tuple[int, ...]) -> Function:
        """Return a dolfinx function with values of `value_shape` at the points.

        Parameters
        ----------
        name
            Name of the dolfinx function.
        value_shape
            Shape of its value at a point, such as (), (3,) or (3, 3).
        """
        # One space for each shape: its dofmap takes time and memory.
        if value_shape not in self._spaces:
            element = basix.ufl.quadrature_element(
                self.element_kind, value_shape=value_shape, degree=self.degree
            )
            self._spaces[value_shape] = dolfinx.fem.functionspace(self.mesh, element)
        return dolfinx.fem.Function(self._spaces[value_shape], name=name)

    def values(self, function: Function, value_shape: tuple[int, ...]) -> Array:
        """Return the function's own memory as an array ``(elements, points, *value_shape)``."""
        return function.x.array.reshape(*self.shape, *value_shape)

    def evaluate(
        self,
        expression: Sequence[dolfinx.fem.Expression],
        value_shape: tuple[int, ...],
    ) -> Array:
        """Evaluate a compiled expression at the points, ``(elements, points, *value_shape)``."""
        values = expression_values(expression, self.mesh, self.elements, self.shape[1])
        return values.reshape(*self.shape, *value_shape)

    def owned(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the rows of the elements that this rank owns, (owned elements, ...)."""
        return values[: self.number_of_owned_elements]

    def integral(self, values: Array) -> float:
        """Integrate values (elements or owned elements, points) over the body. Collective."""
        local = float((self.owned(values) * self.owned(self.volumes)).sum())
        return allreduce(self.mesh.comm, local, MPI.SUM)

    def mean(self, values: Array) -> float:
        """Return the volume mean of values (elements, points). Collective."""
        return self.integral(values) / self.volume

    def nanmean(self, values: Array, weights: Array | None = None) -> float:
        """Return the volume mean over the points whose value is not NaN. Collective.

        The mean is NaN if all values are NaN.

        Parameters
        ----------
        values
            Values, (elements, points).
        weights
            Weights of the points in addition to their volume, (elements, points) or (elements,).
            Default: 1.
        """
        known = ~np.isnan(values)
        counted = (
            known
            if weights is None
            else known * (weights if weights.ndim == 2 else weights[:, None])
        )
        volume = self.integral(counted.astype(np.float64))
        return (
            self.integral(np.where(known, values, 0.0) * counted) / volume if volume > 0 else np.nan
        )

    @cached_property
    def gradients(self) -> Array:
        """G with ``|grad u| <= G max |u_node|`` in each element, (elements,)."""
        slopes = shape_functions(self.element_kind, self.element_degree, self.points)[1:]
        sums = np.linalg.norm(slopes, axis=0).sum(axis=-1)
        return np.max(sums / self.smallest_lengths, axis=1, initial=0.0)

    @cached_property
    def largest_gradient(self) -> float:
        """Largest of `gradients` over all ranks. Collective on first access."""
        return self.maximum(self.gradients)

    @cached_property
    def volume(self) -> float:
        """Volume of the body, over all ranks. Collective on first access."""
        return self.integral(np.ones(self.shape))

    def element_mean(self, values: Array) -> Array:
        """Return the volume mean over each element, (elements, points, ...) to (elements, ...)."""
        return np.einsum("ep,ep...->e...", self._shares, values)

    def element_nanmean(self, values: Array) -> Array:
        """Return each element's volume mean without NaN, (elements, points) to (elements,)."""
        known = ~np.isnan(values)
        sums, shares = self.element_mean(np.where(known, values, 0.0)), self.element_mean(
            known.astype(np.float64)
        )
        return np.divide(sums, shares, out=np.full_like(sums, np.nan), where=shares > 0)

    @cached_property
    def _shares(self) -> Array:
        """Volume fraction of each quadrature point in its element, (elements, points)."""
        return self.volumes / self.volumes.sum(axis=1, keepdims=True)

    def polynomial_residual(self, degree: int, values: Array) -> Array:
        """Return values (owned elements, points, n) minus a least-squares polynomial.

        Each element has its own polynomial of this degree. In elements of a single point it is
        the mean over adjacent elements, which is collective.
        """
        if self.shape[1] == 1:
            return values - self._means_at_nodes(values).mean(axis=1, keepdims=True)
        if degree not in self._complements:
            self._complements[degree] = np.eye(self.shape[1]) - self._fitted(degree, self.points)
        return self._complements[degree] @ values

    def _fitted(self, degree: int, points: Array) -> Array:
        """Return the matrix from values to their least-squares polynomial at other points."""
        polynomials, elsewhere = (
            shape_functions(self.element_kind, degree, x)[0] for x in (self.points, points)
        )
        roots = np.sqrt(self.weights)[:, None]
        return elsewhere @ (np.linalg.pinv(roots * polynomials) * roots.T)

    def superconvergent(self, values: Array) -> Array:
        """Return values (elements, points, n) at superconvergent points.

        The result has shape (elements, fewer points, n). At these points gradients converge one
        order faster (Barlow 1976). In a hexahedron these are the points of Gauss's rule of one
        order less: the centre, or 2 x 2 x 2.
        """
        return self._fitted(self.element_degree - 1, self._superconvergent_points) @ values

    def superconvergent_from_nodes(self, values: Array) -> Array:
        """Interpolate nodal values (elements, nodes) to the superconvergent points."""
        return values @ self._node_functions(self._superconvergent_points).T

    def _node_functions(self, points: Array) -> Array:
        """Return the geometry's shape functions at points of an element, (points, nodes)."""
        geometry = self.mesh.geometry
        return shape_functions(self.element_kind, geometry.cmap.degree, points)[0]

    @cached_property
    def _superconvergent_points(self) -> Array:
        kind = basix.CellType[self.element_kind]
        return np.asarray(basix.make_quadrature(kind, max(1, 2 * self.element_degree - 2))[0])

    def jumps(self, values: Array) -> Array:
        """Return mean-square jumps of values (owned elements, points, n) to adjacent elements.

        Values are extrapolated to the element's nodes, and compared with the mean over all elements
        there. The result has shape (owned elements,). Collective.
        """
        continued = self._extrapolation @ values
        return np.square(continued - self._means_at_nodes(continued)).sum(axis=-1).mean(axis=-1)

    @cached_property
    def _extrapolation(self) -> Array:
        """Matrix from values at an element's points to those at its nodes, (nodes, points)."""
        return np.asarray(np.linalg.pinv(self._node_functions(self.points)))

    def _means_at_nodes(self, values: Array) -> Array:
        """Return nodal means by volume of values (owned elements, nodes or 1, n). Collective."""
        nodes, number = (
            geometry_dofmap(self.mesh)[: self.number_of_owned_elements],
            values.shape[-1] + 1,
        )
        sums = dolfinx.la.vector(self.mesh.geometry.index_map(), number, dtype=np.float64)
        volumes = np.ones((*nodes.shape, 1)) * self.owned(self.volumes).sum(axis=1)[:, None, None]
        at_nodes = sums.array.reshape(-1, number)
        np.add.at(at_nodes, nodes, np.concatenate([values * volumes, volumes], axis=-1))
        sums.scatter_reverse(dolfinx.la.InsertMode.add)
        sums.scatter_forward()
        return at_nodes[nodes, :-1] / at_nodes[nodes, -1:]

    def maximum(self, values: Array) -> float:
        """Return the largest of values (elements, ...) over all ranks. Collective."""
        local = float(np.max(self.owned(values), initial=-np.inf))
        return allreduce(self.mesh.comm, local, MPI.MAX)

    def argmax_position(self, values: Array) -> tuple[float, float, float]:
        """Return the reference position of the largest of values (elements, points). Collective."""
        owned = self.owned(values)
        local = (-np.inf, (np.nan, np.nan, np.nan))
        if owned.size:
            at = np.unravel_index(int(np.argmax(owned)), owned.shape)
            local = (float(owned[at]), tuple(self.coordinates[at].tolist()))
        return max(allgather(self.mesh.comm, local), key=lambda largest: largest[0])[1]

    def shown_place_of_largest(self, values: Array) -> str:
        """Return the reference position of the largest value as text. Collective."""
        return f"({', '.join(f'{c:.4g}' for c in self.argmax_position(values))})"

    def minimum(self, values: Array) -> float:
        """Return the smallest of values (elements, ...) over all ranks. Collective."""
        return -self.maximum(-values)

    def norm(self, values: Array) -> float:
        """Return the root of the sum of squares of values (elements, ...). Collective."""
        return float(
            np.sqrt(self.mesh.comm.allreduce(float(np.sum(self.owned(values) ** 2)), MPI.SUM))
        )
