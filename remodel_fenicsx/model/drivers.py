"""Driving tensors, and frames that map their eigenvectors to cell axes (paper, eqs. 8 and 9)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from remodel_fenicsx._lazy import Late
from remodel_fenicsx.model.chains import UflOrArray
from remodel_fenicsx.model.energy import Stresses
from remodel_fenicsx.model.tensors import Array

ufl = Late("ufl")


@dataclass(frozen=True)
class Driver:
    """Driving tensor, whose principal directions the cells follow.

    Attributes
    ----------
    tensor
        Function of (F, stresses) that returns the UFL expression.
    material
        Whether the eigenvectors are material vectors.
    is_stress
        Whether the tensor is a stress. A stress is zero within the rounding error of stresses and
        the accepted residual. Other tensors are of order one, and zero within their own rounding
        error.
    over_corrects
        Whether the coupling "staggered" may leave a symmetric solution with this driver.

    Examples
    --------
    The Kirchhoff stress, whose principal directions are those of the Cauchy stress:

    >>> import ufl
    >>> from remodel_fenicsx.extend import DRIVERS, Driver
    >>> DRIVERS["kirchhoff"] = Driver(
    ...     lambda F, stresses: ufl.det(F) * stresses.cauchy, material=False)
    >>> from remodel_fenicsx import preset_scene
    >>> scene = preset_scene("kuhl-holzapfel-2007", "cube")
    >>> scene.with_values({"remodeling.driver": "kirchhoff"}).remodeling.driver
    'kirchhoff'
    >>> del DRIVERS["kirchhoff"]
    """

    tensor: Callable[[UflOrArray, Stresses], UflOrArray]
    material: bool
    is_stress: bool = True
    over_corrects: bool = False


DRIVERS: dict[str, Driver] = {
    "cauchy": Driver(lambda F, s: s.cauchy, material=False),
    "pk2": Driver(
        lambda F, s: s.second_piola_kirchhoff,
        material=True,
        over_corrects=True,
    ),
    "finger": Driver(
        lambda F, s: ufl.dot(F, F.T),  # b
        material=False,
        is_stress=False,
        over_corrects=True,
    ),
}


def corotational_tensor(F: Array, spatial_tensor: Array) -> Array:
    """Return R^T t R (n, 3, 3), R of F = R U; U S U / J for t = sigma, C for t = b; objective."""
    squared, basis = np.linalg.eigh(np.swapaxes(F, 1, 2) @ F)
    R = F @ (basis / np.sqrt(squared)[:, None, :]) @ np.swapaxes(basis, 1, 2)  # F U^-1
    rotated: Array = np.swapaxes(R, 1, 2) @ spatial_tensor @ R
    return (rotated + np.swapaxes(rotated, 1, 2)) / 2


@dataclass(frozen=True)
class Frame:
    """Map from the eigenvectors of a spatial driver to cell axes.

    Attributes
    ----------
    axes
        Function of (F (n, 3, 3), m_I as rows (n, 3, 3)) that returns n_I as rows.
    carries_axes
        Whether the cells' axes move with the material, so that F n_I are the previous axes in
        space.
    tensor
        Function of (F (n, 3, 3), spatial tensor (n, 3, 3)) that returns the tensor in material
        space, for laws that need no axes.

    Examples
    --------
    A frame that rotates spatial axes back by the rotation R of F = R U:

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
    tensor: Callable[[Array, Array], Array] = corotational_tensor


def material_frame(F: Array, spatial_axes: Array) -> Array:
    """Return n_1 ~ F^-1 m_1, n_2 ~ F^-1 m_2 orthogonal to n_1, n_3 = n_1 x n_2; objective."""
    # The deformation maps the fibre n_1 onto the first principal direction. F (n, 3, 3); rows
    # (n, 3, 3).
    pulled_back = np.swapaxes(np.linalg.solve(F, np.swapaxes(spatial_axes, -1, -2)), -1, -2)
    first = _unit(pulled_back[:, 0])
    second = pulled_back[:, 1] - np.sum(pulled_back[:, 1] * first, axis=-1, keepdims=True) * first
    second = _unit(second)
    return np.stack([first, second, np.cross(first, second)], axis=1)


FRAMES: dict[str, Frame] = {
    "material": Frame(material_frame, carries_axes=True),
    # n_I = m_I as printed in eq. (9): spatial eigenvectors; not objective (erratum 4).
    "spatial": Frame(lambda F, axes: axes, carries_axes=False, tensor=lambda F, tensor: tensor),
}


def convected_axes(F: Array, axes: Array) -> Array:
    """Return F n_I normalised, the convected axes as rows, (n, 3, 3)."""
    return _unit(axes @ np.swapaxes(F, 1, 2))


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
