"""The remodeling pass: driving tensor, its eigen-decomposition, the evolution law, new cells (paper, eqs. 8 to 11)."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import ufl
from numpy.typing import NDArray

from remodel_fenicsx.fem import jit
from remodel_fenicsx.scene import parameters
from remodel_fenicsx.tissue import spectral
from remodel_fenicsx.tissue.cells import UnitCells, structure_tensor
from remodel_fenicsx.tissue.chains import CHAINS
from remodel_fenicsx.tissue.energy import Stresses, stresses
from remodel_fenicsx.fem.kinematics import deformation_gradient
from remodel_fenicsx.tissue.laws import LAWS

Array = NDArray[np.float64]
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Driver:
    """A driving tensor.

    Attributes
    ----------
    tensor
        Its UFL expression from (F, stresses).
    material
        Whether its eigenvectors are material vectors.
    scale
        A typical size from the material, below whose rounding an eigenvalue is zero: the 1e-16 of an unloaded body is
        no tension.
    """

    tensor: Callable[[Any, Stresses], Any]
    material: bool
    scale: Callable[[parameters.Material], float]
    # by frame: factor by which a pass multiplies a small tilt of the axes, where it is below -1 (docs/theory.md)
    overcorrection: dict[str, float] = field(default_factory=dict)


def _stiffness(material: parameters.Material) -> float:
    """lambda + 2 mu: a stress per strain."""
    return material.lame_lambda + 2 * material.lame_mu


DRIVERS: dict[str, Driver] = {
    "cauchy": Driver(lambda F, s: s.cauchy, material=False, scale=_stiffness),
    "pk2": Driver(
        lambda F, s: s.second_piola_kirchhoff,
        material=True,
        scale=_stiffness,
        overcorrection={"material": -1.5, "spatial": -1.5},
    ),
    "finger": Driver(
        lambda F, s: ufl.dot(F, F.T),
        material=False,
        scale=lambda m: 1.0,
        overcorrection={"material": -2.6, "spatial": -1.9},
    ),
}


def spatial_frame(F: Array, spatial_axes: Array) -> Array:
    """n_I = m_I as printed in eq. (9): spatial eigenvectors taken for material axes. Not objective (erratum 4)."""
    return spatial_axes


def material_frame(F: Array, spatial_axes: Array) -> Array:
    """n_1 = F^-1 m_1 normalised, n_2 = F^-1 m_2 orthogonalised against n_1, n_3 = n_1 x n_2. Objective.

    n_1 is the fibre that the deformation carries onto the first principal direction. F (n, 3, 3); rows (n, 3, 3).
    """
    pulled_back = np.swapaxes(np.linalg.solve(F, np.swapaxes(spatial_axes, -1, -2)), -1, -2)
    first = _unit(pulled_back[:, 0])
    second = pulled_back[:, 1] - np.sum(pulled_back[:, 1] * first, axis=-1, keepdims=True) * first
    second = _unit(second)
    return np.stack([first, second, np.cross(first, second)], axis=1)


FRAMES: dict[str, Callable[[Array, Array], Array]] = {"material": material_frame, "spatial": spatial_frame}


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


class RemodelingPass:
    """Updates the unit cells of a solved state.

    Parameters
    ----------
    displacement
        dolfinx function of the displacement.
    cells
        The unit cells that it updates.
    material
        Parameters of matrix and chains.
    settings
        Driver, law, frame and kappa.
    """

    def __init__(
        self, displacement: Any, cells: UnitCells, material: parameters.Material, settings: parameters.Remodeling
    ):
        self.cells, self.material, self.settings = cells, material, settings
        self.driver, self.law, self.frame = DRIVERS[settings.driver], LAWS[settings.law], FRAMES[settings.frame]
        F = deformation_gradient(displacement)
        tensor = self.driver.tensor(F, stresses(F, [cells.ufl_cell], material, cells.settings.end_to_end_length))
        # one stacked expression: the deformation gradient comes at no cost with the driver
        stacked = ufl.as_vector([t[i, j] for t in (F, tensor) for i in range(3) for j in range(3)])
        self._expression = jit.expression(stacked, cells.quadrature.points)

    def warn_of_overcorrection(self) -> None:
        """Log a warning where driver and frame are known to over-correct (docs/theory.md, Stability of the pass)."""
        factor = self.driver.overcorrection.get(self.settings.frame)
        if factor is not None and self.settings.law != "none" and self.cells.quadrature.mesh.comm.rank == 0:
            log.warning(
                "remodeling.driver = %r with frame = %r over-corrects: a pass multiplies small tilts of the axes by "
                "about %g, so late results may drift (docs/theory.md, Stability of the pass)",
                self.settings.driver,
                self.settings.frame,
                factor,
            )

    def driving_tensor(self) -> tuple[Array, Array]:
        """F and the symmetric driving tensor at all points, each (cells * points, 3, 3)."""
        values = self.cells.quadrature.evaluate(self._expression, (2, 3, 3)).reshape(-1, 2, 3, 3)
        driver = values[:, 1]
        return values[:, 0], (driver + np.swapaxes(driver, 1, 2)) / 2

    def updated_cells(self, time_old: float, time_new: float) -> tuple[Array, Array, NDArray[np.bool_], Array]:
        """New dimensions (n, 3) and axes (n, 3, 3), which points remodel (n,), and F (n, 3, 3). Changes nothing."""
        cells, r0 = self.cells, self.cells.settings.end_to_end_length
        F, driver = self.driving_tensor()
        axes = cells.axis_values.reshape(-1, 3, 3)
        dimensions = cells.dimension_values.reshape(-1, 3)
        spatial = not self.driver.material
        # the axes to keep where eigenvalues agree, as vectors of the space in which the driver lives
        carried = spatial and self.settings.frame == "material"
        previous = _unit(axes @ np.swapaxes(F, 1, 2)) if carried else axes
        scale = self.driver.scale(self.material)
        values, principal_axes = spectral.principal(driver, previous, scale=scale)
        direction, active = spectral.positive_direction(values, scale=scale)
        new_axes = self.frame(F, principal_axes) if spatial else principal_axes
        initial = cells.initial_dimensions.reshape(-1, 3)
        new_dimensions = self.law(dimensions, initial, r0 * direction, self.settings.kappa, time_old, time_new)
        new_dimensions = np.where(active[:, None], new_dimensions, dimensions)
        new_axes = np.where(active[:, None, None], new_axes, axes)
        return new_dimensions, new_axes, active, F

    def apply(self, time_old: float, time_new: float) -> float:
        """Remodel over a step with the stress of the solved state at time_new; returns the power of remodeling.

        The power is the stored energy that the pass releases at frozen deformation, per time, to first order
        (`energy_increment`; Remark 6).

        Raises
        ------
        FloatingPointError
            If the driving tensor is not finite anywhere.
        """
        if self.settings.law == "none":
            return 0.0
        cells = self.cells
        quadrature = cells.quadrature
        dimensions, axes, _, F = self.updated_cells(time_old, time_new)
        increment = self.energy_increment(F, dimensions, axes).reshape(quadrature.shape)
        power: float = -quadrature.integral(increment) / (time_new - time_old)
        cells.set(dimensions.reshape(*quadrature.shape, 3), axes.reshape(*quadrature.shape, 3, 3))
        return power

    def energy_increment(self, F: Array, dimensions: Array, axes: Array) -> Array:
        """First-order change of W at frozen F when the cells take new values, per reference volume, shape (n,).

        W depends on the cells through r^2 = A : C and M = sum_I l_I^2 ln I_I only:
        dW = c g(r)/2 d(r^2) - c/2 g(r0) dM, taken at the solved state, where r < L. (Remark 6; the new cells themselves
        may have r > L until the next solve, so their energy is not always defined.)
        """
        material, cells = self.material, self.cells
        chain, L = CHAINS[material.chain], material.contour_length
        C = np.swapaxes(F, 1, 2) @ F
        old_dimensions, old_axes = cells.dimension_values.reshape(-1, 3), cells.axis_values.reshape(-1, 3, 3)
        squared = np.einsum("nij,nij->n", structure_tensor(old_dimensions, old_axes), C)
        squared_change = np.einsum("nij,nij->n", structure_tensor(dimensions, axes), C) - squared
        repulsion_change = _repulsion_sum(dimensions, axes, C) - _repulsion_sum(old_dimensions, old_axes, C)
        stiffness = chain.stiffness(np.sqrt(squared), L)
        stiffness0 = chain.stiffness(cells.settings.end_to_end_length, L)
        change: Array = material.network_modulus / 2 * (stiffness * squared_change - stiffness0 * repulsion_change)
        return change


def _repulsion_sum(dimensions: Array, axes: Array, C: Array) -> Array:
    """M = sum_I l_I^2 ln(n_I . C n_I), shape (n,)."""
    return np.sum(dimensions**2 * np.log(np.sum((axes @ C) * axes, axis=-1)), axis=-1)
