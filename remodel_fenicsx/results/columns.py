"""What a run measures on a solved state: the columns of its history and the fields of its pictures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import dolfinx.fem
import numpy as np
import ufl
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.fem import compat, jit
from remodel_fenicsx.scene import parameters
from remodel_fenicsx.tissue import spectral
from remodel_fenicsx.tissue.cells import UnitCells, angle_to_axis, pitch_angle, structure_tensor
from remodel_fenicsx.tissue.energy import stresses
from remodel_fenicsx.body import Domain
from remodel_fenicsx.fem.kinematics import deformation_gradient
from remodel_fenicsx.body.loading import Loading

Array = NDArray[np.float64]
AXIAL = np.array([0.0, 0.0, 1.0])


class Observer:
    """Measures a solved state.

    Parameters
    ----------
    domain, displacement, loading, cells, material
        The state; nothing here changes it.
    """

    def __init__(
        self, domain: Domain, displacement: Any, loading: Loading, cells: UnitCells, material: parameters.Material
    ):
        self.domain, self.displacement, self.loading, self.cells = domain, displacement, loading, cells
        self.quadrature = cells.quadrature
        F = deformation_gradient(displacement)
        self._axial_stretch = jit.expression(F[2, 2], self.quadrature.points)
        cauchy = stresses(F, [cells.ufl_cell], material, cells.settings.end_to_end_length).cauchy
        entries = [t[i, j] for t in (F, cauchy) for i in range(3) for j in range(3)]
        self._state = jit.expression(ufl.as_vector([*entries, *displacement]), self.quadrature.points)
        self._contour_length = material.contour_length
        self._columns = COLUMNS[domain.shape](self)

    def columns(self) -> dict[str, float]:
        """The columns that belong to the shape (docs/commands.md)."""
        return self._columns()

    # ------------------------------------------------------------ fields
    def cell_fields(self) -> dict[str, Array]:
        """Element means for pictures, one row per local cell.

        `deformation_gradient` and `cauchy_stress` (9, row by row); `cell_dimensions` (3) and `axis_1..3`: the cell
        whose structure tensor is the element's mean, longest first; `fibre_angle` and `fibre_angle_deformed` (degrees,
        to the load axis, or in a tube from circumferential to axial); `chain_extension` (largest r/L in the element).
        """
        values = self.quadrature.evaluate(self._state, (21,))
        F, cauchy = values[..., :9].reshape(*values.shape[:2], 3, 3), values[..., 9:18]
        dimensions, axes = self.cells.dimension_values, self.cells.axis_values
        deformed_axes = axes @ np.swapaxes(F, -1, -2)
        position = self.quadrature.coordinates + values[..., 18:]
        lengths, mean_axes = self.mean_cells()
        squared = np.sum((dimensions[..., None] * deformed_axes) ** 2, axis=(-1, -2))
        mean = self.quadrature.cell_mean
        return {
            "deformation_gradient": mean(values[..., :9]),
            "cauchy_stress": mean(cauchy),
            "cell_dimensions": lengths,
            **{f"axis_{i + 1}": mean_axes[:, i] for i in range(3)},
            "fibre_angle": mean(self.fibre_angle(axes, self.quadrature.coordinates)),
            "fibre_angle_deformed": mean(self.fibre_angle(deformed_axes, position)),
            "chain_extension": np.sqrt(squared.max(axis=1)) / self._contour_length,
        }

    def mean_cells(self) -> tuple[Array, Array]:
        """Lengths (cells, 3) and axes as rows (cells, 3, 3) of the element's mean structure tensor, longest first."""
        tensor = structure_tensor(self.cells.dimension_values, self.cells.axis_values)
        squared, axes = spectral.principal(self.quadrature.cell_mean(tensor), self.cells.axis_values[:, 0])
        return np.sqrt(np.maximum(squared, 0.0)), axes

    def fibre_angle(self, axes: Array, coordinates: Array) -> Array:
        """Angle of the chain direction in degrees: in a tube from circumferential to axial, else to the load axis z."""
        if self.domain.shape == "tube":
            return pitch_angle(self.cells.dimension_values, axes, coordinates)
        return angle_to_axis(self.cells.dimension_values, axes, AXIAL)

    def reference_fibre_angle(self) -> Array:
        """Reference fibre angle at all points (cells, points), degrees."""
        return self.fibre_angle(self.cells.axis_values, self.quadrature.coordinates)

    def element_stretch(self) -> Array:
        """Volume mean of F_zz in each local element, shape (cells,)."""
        return self.quadrature.cell_mean(self.quadrature.evaluate(self._axial_stretch, (1,)))[:, 0]

    # ------------------------------------------------------------ reductions
    def reduce(self, values: Array, operation: Any) -> float:
        """Largest (MPI.MAX) or smallest (MPI.MIN) of one value per local cell, over all ranks."""
        owned = self.quadrature.owned(values)
        pick = np.max if operation == MPI.MAX else np.min
        start = -np.inf if operation == MPI.MAX else np.inf
        return self.domain.mesh.comm.allreduce(float(pick(owned, initial=start)), operation)

    def cells_touching_radius(self, radius: float) -> NDArray[np.bool_]:
        """Mask of the local cells with a reference point at this distance from the z axis, shape (cells,)."""
        nodes = self.domain.mesh.geometry.x[compat.geometry_dofmap(self.domain.mesh)]
        radii = np.linalg.norm(nodes[..., :2], axis=-1)
        tolerance = 1e-6 * self.domain.size
        return (radii.min(axis=1) <= radius + tolerance) & (radii.max(axis=1) >= radius - tolerance)


class _FaceMean:
    """Mean over a face of a nodal field, over the reference or the deformed area."""

    def __init__(self, observer: Observer, face: str, deformed: bool):
        domain, u = observer.domain, observer.displacement
        degree = u.function_space.element.basix_element.degree
        # first component of a function of the displacement's space: surely the same order of nodes
        self.field = dolfinx.fem.Function(u.function_space)
        measure = ufl.Measure("ds", domain=domain.mesh, subdomain_data=domain.facet_tags)(
            domain.faces[face], metadata={"quadrature_degree": 2 * degree}
        )
        normal = ufl.FacetNormal(domain.mesh)
        stretched = ufl.cofac(deformation_gradient(u)) * normal
        weight = ufl.sqrt(ufl.inner(stretched, stretched)) if deformed else ufl.sqrt(ufl.inner(normal, normal))
        self._weighted, self._area = jit.form(self.field[0] * weight * measure), jit.form(weight * measure)
        self._comm = domain.mesh.comm

    def __call__(self, nodal_values: Array) -> float:
        self.field.x.array.reshape(-1, 3)[:, 0] = nodal_values
        both = np.array([np.real(dolfinx.fem.assemble_scalar(form)) for form in (self._weighted, self._area)])
        weighted, area = self._comm.allreduce(both, MPI.SUM)
        return float(weighted / area)


def _uniaxial_columns(top: str, length_name: str) -> Callable[[Observer], Callable[[], dict[str, float]]]:
    def prepare(observer: Observer) -> Callable[[], dict[str, float]]:
        mean_on_top = _FaceMean(observer, top, deformed=False)
        length = observer.domain.dimensions[length_name]

        def columns() -> dict[str, float]:
            stretch = observer.element_stretch()
            axial_displacement = observer.displacement.x.array.reshape(-1, 3)[:, 2]
            return {
                "force": observer.loading.values["force"],
                "mean_stretch": 1.0 + mean_on_top(axial_displacement) / length,
                "min_stretch": observer.reduce(stretch, MPI.MIN),
                "max_stretch": observer.reduce(stretch, MPI.MAX),
                "mean_fibre_angle": observer.quadrature.mean(observer.reference_fibre_angle()),
            }

        return columns

    return prepare


def _tube_columns(observer: Observer) -> Callable[[], dict[str, float]]:
    faces = {face: _FaceMean(observer, face, deformed=True) for face in ("inner", "outer")}
    size = observer.domain.dimensions
    radii = {
        "inner": size["inner_radius"],
        "middle": (size["inner_radius"] + size["outer_radius"]) / 2,
        "outer": size["outer_radius"],
    }
    layers = {name: observer.cells_touching_radius(radius) for name, radius in radii.items()}
    reference = observer.displacement.function_space.tabulate_dof_coordinates()

    def columns() -> dict[str, float]:
        position = reference + observer.displacement.x.array.reshape(-1, 3)
        radius = np.linalg.norm(position[:, :2], axis=1)
        angle = observer.reference_fibre_angle()
        return {
            "pressure": observer.loading.values["pressure"],
            "axial_stretch": observer.loading.values["stretch"],
            "inner_radius": faces["inner"](radius),
            "outer_radius": faces["outer"](radius),
            **{f"fibre_angle_{name}": observer.quadrature.mean(angle, layer) for name, layer in layers.items()},
        }

    return columns


COLUMNS: dict[str, Callable[[Observer], Callable[[], dict[str, float]]]] = {
    "cube": _uniaxial_columns("z1", "side"),
    "tendon": _uniaxial_columns("top", "length"),
    "tube": _tube_columns,
}
