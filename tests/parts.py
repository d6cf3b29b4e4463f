"""A body with its cells and supports, put together by hand: what tests of single parts of the package start from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import basix.ufl
import dolfinx.fem
import numpy as np

from remodel_fenicsx.tissue.cells import UnitCells
from remodel_fenicsx.body import Domain
from remodel_fenicsx.body.loading import Loading
from remodel_fenicsx.scene.parameters import Cells, Material
from remodel_fenicsx.evolution.equilibrium import EquilibriumProblem
from remodel_fenicsx.fem.quadrature import Quadrature
from remodel_fenicsx.scene.scene import Solver

MATERIAL = Material()
TIGHT = Solver(absolute_tolerance=1e-11, relative_tolerance=1e-13)


def rotation(axis: tuple[float, float, float], degrees: float) -> np.ndarray:
    """The rotation about an axis, (3, 3)."""
    a = np.asarray(axis) / np.linalg.norm(axis)
    cross = np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])
    angle = np.radians(degrees)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def random_rotations(rng: np.random.Generator, count: int) -> np.ndarray:
    """Rotations, (count, 3, 3)."""
    matrices = np.linalg.qr(rng.standard_normal((count, 3, 3)))[0]
    return matrices * np.linalg.det(matrices)[:, None, None]


@dataclass
class Body:
    """A meshed body, its displacement and its cells; supports and loads are for the test to add."""

    domain: Domain
    displacement: Any
    quadrature: Quadrature
    cells: UnitCells
    loading: Loading

    def problem(self, solver: Solver = TIGHT, material: Material = MATERIAL) -> EquilibriumProblem:
        """Its equilibrium."""
        return EquilibriumProblem(self.displacement, self.loading, self.cells, material, solver)

    def set_displacement(self, values: np.ndarray) -> None:
        """Displacement by local node, (nodes, 3)."""
        self.displacement.x.array[:] = np.asarray(values).ravel()

    @property
    def nodes(self) -> np.ndarray:
        """Reference coordinates of the nodes of the displacement, (nodes, 3)."""
        return self.displacement.function_space.tabulate_dof_coordinates()


def body(domain: Domain, cells: Cells, degree: int = 1) -> Body:
    """Cells, quadrature and displacement of a mesh."""
    mesh = domain.mesh
    element = basix.ufl.element("Lagrange", mesh.topology.cell_name(), degree, shape=(3,))
    displacement = dolfinx.fem.Function(dolfinx.fem.functionspace(mesh, element), name="displacement")
    quadrature = Quadrature(mesh, degree)
    unit_cells = UnitCells(quadrature, domain.cell_number, domain.number_of_cells, cells)
    return Body(domain, displacement, quadrature, unit_cells, Loading(domain, displacement))


def random_axes(made: Body, rng: np.random.Generator) -> None:
    """Turn the cell of every quadrature point by a rotation of its own."""
    cells = made.cells
    axes = random_rotations(rng, int(np.prod(made.quadrature.shape))).reshape(cells.axis_values.shape)
    cells.set(cells.dimension_values.copy(), axes)
