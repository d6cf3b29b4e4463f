"""The unit cells at the quadrature points: l_I and n_I as functions that forms take and passes change."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.body.domain import Domain
from remodel_fenicsx.fem.quadrature import Quadrature
from remodel_fenicsx.kernels.kernels import PointKernels, point_kernels
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.axes import AXES, LocalAxes, cells_of, structure_tensors
from remodel_fenicsx.schema.settings import MEASURED_CELLS, Cells

Array = NDArray[np.float64]


class CellField:
    """Cell dimensions and axes as quadrature functions.

    Attributes
    ----------
    dimensions, axes
        dolfinx quadrature functions of shape (3,) and (3, 3); row I of `axes` is n_I.
    dimension_values, axis_values
        l_I (cells, points, 3), and n_I as rows (cells, points, 3, 3): the functions' own memory.
    point_cells
        The cells of all points in one row, (cells * points, ...): the functions' own memory.
    """

    def __init__(self, quadrature: Quadrature, name: str):
        self.quadrature = quadrature
        self.dimensions = quadrature.function(f"{name}_dimensions", (3,))
        self.axes = quadrature.function(f"{name}_axes", (3, 3))
        self.dimension_values: Array = quadrature.values(self.dimensions, (3,))
        self.axis_values: Array = quadrature.values(self.axes, (3, 3))
        self.point_cells = UnitCell(self.dimension_values.reshape(-1, 3), self.axis_values.reshape(-1, 3, 3))

    @property
    def ufl_cell(self) -> UnitCell:
        """The cell as the energy takes it."""
        return UnitCell(self.dimensions, self.axes)

    def set(self, dimensions: Array, axes: Array) -> None:
        """Replace all dimensions (cells, points, 3) and axes (cells, points, 3, 3)."""
        self.dimension_values[:] = dimensions
        self.axis_values[:] = axes

    def equals(self, other: CellField) -> bool:
        """Whether all values of this rank are the same numbers."""
        mine, others = (self.dimensions, self.axes), (other.dimensions, other.axes)
        return all(np.array_equal(a.x.array, b.x.array) for a, b in zip(mine, others, strict=True))

    @cached_property
    def kernels(self) -> PointKernels:
        """What a pass computes at points. Collective, the first time."""
        return point_kernels(self.quadrature.mesh.comm)

    def structure_tensor(self) -> Array:
        """A = sum_I l_I^2 n_I (x) n_I, shape (cells, points, 3, 3), in squared link lengths. Collective at first."""
        return self.kernels.structure_tensor(self.dimension_values, self.axis_values)


class UnitCells(CellField):
    """Orthotropic unit cells at the quadrature points (paper, Fig. 2).

    Parameters
    ----------
    quadrature
        The points.
    domain
        With the numbers of its elements in the mesh file's order, which are the seed's index: random cells do not
        depend on the number of ranks.
    settings
        Initial dimensions, axes, seed, r0.
    local_axes
        Of the body at the points (`Shape.local_axes`).
    regions
        Initial dimensions and r0 of regions where they are others, by name.
    fibres
        Measured fibres of all elements, (number_of_elements, columns) by name of `model.fibres.MEASURED`, by region;
        "" is the whole body.

    Attributes
    ----------
    local_axes
        As given.
    initial_dimensions
        l0_I by rank (not by direction), shape (cells, points, 3), in link lengths.

    Examples
    --------
    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> simulation = Simulation(preset_scene("kuhl-holzapfel-2007", "cube"))
    >>> cells = simulation.cells
    >>> cells.dimension_values.shape, cells.axis_values.shape  # (elements, points, 3) and (elements, points, 3, 3)
    ((1, 8, 3), (1, 8, 3, 3))
    >>> cells.structure_tensor()[0, 0].round(4)
    array([[0.3333, 0.    , 0.    ],
           [0.    , 0.3333, 0.    ],
           [0.    , 0.    , 0.3333]])
    """

    def __init__(
        self,
        quadrature: Quadrature,
        domain: Domain,
        settings: Cells,
        local_axes: LocalAxes,
        regions: Mapping[str, Cells] = MappingProxyType({}),
        fibres: Mapping[str, Mapping[str, Array]] = MappingProxyType({}),
    ):
        super().__init__(quadrature, "cell")
        self.settings, self.local_axes = settings, local_axes
        self.axis_values[:] = axes = self.initial_axes()
        everywhere = np.ones(len(domain.element_number), dtype=np.bool_)
        for name, cells in {"": settings, **regions}.items():
            chosen = domain.element_region == domain.regions[name] if name else everywhere
            if name in fibres:
                measured = {key: values[domain.element_number[chosen]] for key, values in fibres[name].items()}
                self._take(measured, chosen, axes[chosen], cells.end_to_end_length)
            elif cells.initial != MEASURED_CELLS:
                drawn = cells.dimensions(domain.number_of_elements)
                self.dimension_values[chosen] = drawn[domain.element_number[chosen]][:, None, :]
                self.axis_values[chosen] = axes[chosen]
        self.initial_dimensions: Array = self.dimension_values.copy()

    def _take(self, measured: Mapping[str, Array], chosen: NDArray[np.bool_], axes: Array, length: float) -> None:
        """Cells of measured fibres in the chosen elements; `axes` where these leave some open."""
        at_points = {name: values[:, None, :] for name, values in measured.items()}
        tensors = np.broadcast_to(structure_tensors(at_points, self.local_axes.axes[chosen]), axes.shape)
        self.dimension_values[chosen], self.axis_values[chosen] = cells_of(tensors, length, axes)

    def initial_axes(self) -> Array:
        """n_I before the first pass, rows, (cells, points, 3, 3)."""
        return AXES[self.settings.axes](self.local_axes)
