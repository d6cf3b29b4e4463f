"""Driving tensors, and the frames that make cell axes of their eigenvectors (paper, eqs. 8 and 9)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx._lazy import Late
from remodel_fenicsx.model import tensors
from remodel_fenicsx.model.chains import UflOrArray
from remodel_fenicsx.model.energy import Stresses

ufl = Late("ufl")
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Driver:
    """A driving tensor.

    Attributes
    ----------
    tensor
        Its UFL expression from (F, stresses).
    material
        Whether its eigenvectors are material vectors.
    is_stress
        Whether it is a stress, zero up to the rounding of stresses and to the residual that was accepted; else it is a
        number near one, zero up to its own rounding.
    over_corrects
        Whether the coupling "staggered" may leave a symmetric solution with it.

    Examples
    --------
    The Kirchhoff stress, which turns the cells as Cauchy's does:

    >>> import ufl
    >>> from remodel_fenicsx.extend import DRIVERS, Driver
    >>> DRIVERS["kirchhoff"] = Driver(lambda F, stresses: ufl.det(F) * stresses.cauchy, material=False)
    >>> from remodel_fenicsx import preset_scene
    >>> preset_scene("kuhl-holzapfel-2007", "cube").with_values({"remodeling.driver": "kirchhoff"}).remodeling.driver
    'kirchhoff'
    >>> del DRIVERS["kirchhoff"]
    """

    tensor: Callable[[UflOrArray, Stresses], UflOrArray]
    material: bool
    is_stress: bool = True
    over_corrects: bool = False


def finger_tensor(deformation_gradient: UflOrArray, stresses: Stresses) -> UflOrArray:
    """b = F F^T (UFL)."""
    return ufl.dot(deformation_gradient, deformation_gradient.T)


DRIVERS: dict[str, Driver] = {
    "cauchy": Driver(lambda F, s: s.cauchy, material=False),
    "pk2": Driver(
        lambda F, s: s.second_piola_kirchhoff,
        material=True,
        over_corrects=True,
    ),
    "finger": Driver(
        finger_tensor,
        material=False,
        is_stress=False,
        over_corrects=True,
    ),
}


def rotated_back(F: Array, spatial_tensor: Array) -> Array:
    """R^T t R (n, 3, 3) with the rotation R of F = R U: objective. For t = sigma it is U S U / J, for t = b it is C."""
    squared, basis = tensors.eigen(np.swapaxes(F, 1, 2) @ F)
    R = F @ (basis / np.sqrt(squared)[:, None, :]) @ np.swapaxes(basis, 1, 2)  # F U^-1
    back: Array = np.swapaxes(R, 1, 2) @ spatial_tensor @ R
    return (back + np.swapaxes(back, 1, 2)) / 2


@dataclass(frozen=True)
class Frame:
    """What becomes of the eigenvectors of a spatial driver.

    Attributes
    ----------
    axes
        n_I from (F (n, 3, 3), m_I as rows (n, 3, 3)).
    carries_axes
        Whether the cells' axes move with the material, so that F n_I are the previous axes in space.
    tensor
        A spatial tensor as one in material space, from (F (n, 3, 3), tensor (n, 3, 3)): for laws that need no axes.
    Examples
    --------
    A frame that turns spatial axes back with the rotation R of F = R U:

    >>> import numpy as np
    >>> from remodel_fenicsx.extend import FRAMES, Frame
    >>> def rotated_back(F, spatial_axes):
    ...     left, _, right = np.linalg.svd(F)
    ...     return spatial_axes @ (left @ right)
    >>> FRAMES["rotated"] = Frame(rotated_back, carries_axes=False)
    >>> FRAMES["rotated"].axes(np.diag([2.0, 1.0, 1.0])[None], np.eye(3)[None])[0]
    array([[1., 0., 0.],
           [0., 1., 0.],
           [0., 0., 1.]])
    >>> del FRAMES["rotated"]
    """

    axes: Callable[[Array, Array], Array]
    carries_axes: bool
    tensor: Callable[[Array, Array], Array] = rotated_back


def spatial_frame(F: Array, spatial_axes: Array) -> Array:
    """n_I = m_I as printed in eq. (9): spatial eigenvectors taken for material axes. Not objective (erratum 4)."""
    return spatial_axes


def material_frame(F: Array, spatial_axes: Array) -> Array:
    """n_1 = F^-1 m_1 normalised, n_2 = F^-1 m_2 orthogonalised against n_1, n_3 = n_1 x n_2. Objective."""
    # n_1 is the fibre that the deformation carries onto the first principal direction. F (n, 3, 3); rows (n, 3, 3).
    pulled_back = np.swapaxes(np.linalg.solve(F, np.swapaxes(spatial_axes, -1, -2)), -1, -2)
    first = _unit(pulled_back[:, 0])
    second = pulled_back[:, 1] - np.sum(pulled_back[:, 1] * first, axis=-1, keepdims=True) * first
    second = _unit(second)
    return np.stack([first, second, np.cross(first, second)], axis=1)


FRAMES: dict[str, Frame] = {
    "material": Frame(material_frame, carries_axes=True),
    "spatial": Frame(spatial_frame, carries_axes=False, tensor=lambda F, tensor: tensor),
}


def carried_axes(F: Array, axes: Array) -> Array:
    """F n_I normalised: where the deformation carries the axes, rows, (n, 3, 3)."""
    return _unit(axes @ np.swapaxes(F, 1, 2))


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
