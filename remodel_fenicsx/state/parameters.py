"""The parameters of a tissue on a mesh as numbers and arrays, made again only where one of them has changed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import dolfinx.fem
import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.body.domain import Domain
from remodel_fenicsx.fem import assembly
from remodel_fenicsx.fem.assembly import Remembered
from remodel_fenicsx.fem.quadrature import Quadrature
from remodel_fenicsx.model.energy import TURNED_OVER, Tissue

Array = NDArray[np.float64]


def on_mesh(tissue: Tissue, mesh: Any) -> Tissue:
    """The tissue with Constants in place of numbers, so that other numbers compile nothing.

    Raises
    ------
    TypeError, ValueError
        If a parameter is neither a number, nor a Constant, nor a DG0 Function of the mesh.
    """
    return tissue.map(lambda name, value: value if name in TURNED_OVER else assembly.coefficient(mesh, name, value))


def at_points(tissue: Tissue, quadrature: Quadrature) -> Tissue:
    """A tissue on a mesh with its parameters as arrays over the points in one row, (elements * points,)."""
    return tissue.map(lambda name, value: assembly.point_values(value, quadrature).reshape(-1))


def stress_rounding(numbers: Tissue, max_chain_extension: float) -> float:
    """Rounding error of a stress in a body, from the stiffness of matrix and network at the largest r/L.

    Parameters
    ----------
    numbers
        The largest value of each parameter (`Parameters.largest`).
    max_chain_extension
        r/L.
    """
    length = numbers.end_to_end_length
    if numbers.locking_length is not None:
        length = max(length, max_chain_extension * numbers.locking_length)
    return float(np.finfo(np.float64).eps * numbers.stiffness(length))


def by_region(domain: Domain, values: Mapping[str, float]) -> Any:
    """A DG0 Function with the value of each region of a domain by its name; "" is for those that have none."""
    found = dolfinx.fem.Function(dolfinx.fem.functionspace(domain.mesh, ("DG", 0)))
    places = found.function_space.dofmap.list.reshape(-1)
    for name, number in domain.regions.items():
        found.x.array[places[domain.element_region == number]] = values[name if name in values else ""]
    return found


class Parameters:
    """What the live parameters of a tissue are at present.

    Parameters
    ----------
    tissue
        On the mesh: each parameter is a Constant or a DG0 Function (`on_mesh`).
    quadrature
        The points.
    """

    def __init__(self, tissue: Tissue, quadrature: Quadrature):
        self.tissue, self.quadrature = tissue, quadrature
        values: list[Any] = []

        def found(name: str, value: Any) -> Any:
            values.append(value)
            return value

        tissue.map(found)
        self._largest: Remembered[Tissue] = Remembered(quadrature.mesh.comm, *values)
        self._at_points: Remembered[Tissue] = Remembered(None, *values)

    def largest(self) -> Tissue:
        """The largest value of each in the body, numbers. Collective."""
        return self._largest(lambda: self.tissue.map(lambda name, value: assembly.largest(value, self.quadrature.mesh)))

    def at_points(self) -> Tissue:
        """`at_points`; not to be written into."""
        return self._at_points(lambda: at_points(self.tissue, self.quadrature))

    def locking_length(self) -> Array:
        """Length at which a chain locks at all points, (elements, points); infinite where nothing locks."""
        length = self.at_points().locking_length
        if length is None:
            return np.full(self.quadrature.shape, np.inf)
        at_all: Array = length.reshape(self.quadrature.shape)
        return at_all
