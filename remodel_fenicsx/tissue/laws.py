"""Evolution laws: what the unit cells become while a drive acts on them. Pure functions on arrays.

A law is `update(cells, drive, time_old, time_new) -> cells` with cells of shape (n, 3) and (n, 3, 3). The paper's laws
(one for each way to integrate its eq. 10) change the dimensions by rank towards a target while the axes turn at once:
`ranked` makes a law of such a function.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.tissue import spectral, tensor_law
from remodel_fenicsx.tissue.cells import UnitCell, structure_tensor
from remodel_fenicsx.tissue.drivers import Driver, Frame, carried_axes

Array = NDArray[np.float64]


class Drive(NamedTuple):
    """What acts on the cells of n points during a step.

    Attributes
    ----------
    deformation_gradient
        F, (n, 3, 3).
    tensor
        The driving tensor, symmetric, (n, 3, 3).
    driver, frame
        Where the tensor's eigenvectors live, and what becomes of them.
    threshold
        Principal values up to this size are zero, in the unit of the tensor; (n,) or a number.
    initial_dimensions
        l0_I by rank, (n, 3), in link lengths.
    end_to_end_length
        r0, in link lengths; (n,) or a number.
    kappa
        Speed of remodeling, in 1/time.
    """

    deformation_gradient: Array
    tensor: Array
    driver: Driver
    frame: Frame
    threshold: Array | float
    initial_dimensions: Array
    end_to_end_length: Array | float
    kappa: float


@dataclass(frozen=True)
class Law:
    """An evolution law.

    Attributes
    ----------
    update
        New cells from (cells, drive, time_old, time_new).
    has_limit
        Whether the cells tend to a limit under a constant drive that does not depend on the way there.
    remodels
        False where cells never change: then there is no pass at all.
    target, follow
        Of laws whose cells tend to a tensor: ``target(drive)`` and ``follow(cells, target, r0, kappa dt)``, of which
        `update` is made. A scheme of second order needs them apart.
    """

    update: Callable[[UnitCell, Drive, float, float], UnitCell]
    has_limit: bool = False
    remodels: bool = True
    target: Callable[[Drive], tensor_law.Target] | None = None
    follow: Callable[[UnitCell, tensor_law.Target, Array | float, float], UnitCell] | None = None


RankedFunction = Callable[[Array, Array, Array, float, float, float], Array]


def ranked(function: RankedFunction, has_limit: bool = False) -> Law:
    """A law of the paper's kind: axes at the drive's principal directions, dimensions by rank from `function`.

    Parameters
    ----------
    function
        ``function(l, l0, target, kappa, time_old, time_new) -> l_new`` with l and l0 (n, 3) by rank (column 0: largest
        principal value), target = r0 e, e = lambda^+ / |lambda^+|. Points without a positive value keep their cells.
    has_limit
        As in `Law`.
    """

    def update(cells: UnitCell, drive: Drive, time_old: float, time_new: float) -> UnitCell:
        spatial = not drive.driver.material
        F = drive.deformation_gradient
        # the axes to keep where values agree, as vectors of the space in which the driver lives
        previous = carried_axes(F, cells.axes) if spatial and drive.frame.carries_axes else cells.axes
        values, axes = spectral.principal(drive.tensor, previous, threshold=drive.threshold)
        direction, active = spectral.positive_direction(values, threshold=drive.threshold)
        axes = drive.frame.axes(F, axes) if spatial else axes
        target = np.reshape(drive.end_to_end_length, (-1, 1)) * direction
        dimensions = function(cells.dimensions, drive.initial_dimensions, target, drive.kappa, time_old, time_new)
        return UnitCell(
            np.where(active[:, None], dimensions, cells.dimensions),
            np.where(active[:, None, None], axes, cells.axes),
        )

    return Law(update, has_limit)


def relaxed(old: UnitCell, new: UnitCell, factor: float) -> UnitCell:
    """The cells that a pass has reached with a share of its change: A = A_old + factor (A_new - A_old).

    A = sum_I l_I^2 n_I (x) n_I; the dimensions are the roots of its eigenvalues, the axes its eigenvectors. Where
    eigenvalues agree, the new axes decide. Arrays of n points; a factor of 1 gives the new cells as they are.
    """
    if factor == 1.0:
        return new
    before, after = structure_tensor(*old[:2]), structure_tensor(*new[:2])
    squared, axes = spectral.principal(before + factor * (after - before), new.axes)
    return UnitCell(np.sqrt(np.maximum(squared, 0.0)), axes)


def explicit(l: Array, l0: Array, target: Array, kappa: float, time_old: float, time_new: float) -> Array:
    """Eq. (11): l = l0 + (r0 e - l0)(1 - exp(-kappa t)), a function of the absolute time and the present target."""
    return l0 - (target - l0) * np.expm1(-kappa * time_new)


def rate(l: Array, l0: Array, target: Array, kappa: float, time_old: float, time_new: float) -> Array:
    """Eq. (10): dl/dt = kappa (r0 e - l0) exp(-kappa t), integrated exactly over the step with e frozen."""
    return l - (target - l0) * np.exp(-kappa * time_old) * np.expm1(-kappa * (time_new - time_old))


def relaxation(l: Array, l0: Array, target: Array, kappa: float, time_old: float, time_new: float) -> Array:
    """Autonomous form dl/dt = kappa (r0 e - l), integrated exactly over the step with e frozen."""
    return l - (target - l) * np.expm1(-kappa * (time_new - time_old))


def keep(cells: UnitCell, drive: Drive, time_old: float, time_new: float) -> UnitCell:
    """The same cells."""
    return cells


def tensor_target(drive: Drive) -> tensor_law.Target:
    """What the structure tensor tends to (`tensor_law.target`)."""
    tensor = drive.tensor
    if not drive.driver.material:
        tensor = drive.frame.tensor(drive.deformation_gradient, tensor)
    return tensor_law.target(tensor, drive.threshold)


def follow_tensor(
    cells: UnitCell, target: tensor_law.Target, end_to_end_length: Array | float, rate: float
) -> UnitCell:
    """Cells whose structure tensor is `tensor_law.follow`; where its eigenvalues agree, the axes stay.

    Lengths are NaN where the target, extrapolated, makes the tensor indefinite by more than rounding.
    """
    structure = tensor_law.follow(structure_tensor(*cells[:2]), target, end_to_end_length, rate)
    squared, axes = spectral.principal(structure, cells.axes)
    rounding = spectral.ROUNDING * np.abs(squared).max(axis=-1, keepdims=True)
    return UnitCell(np.where(squared < -rounding, np.nan, np.sqrt(np.maximum(squared, 0.0))), axes)


def tensor(cells: UnitCell, drive: Drive, time_old: float, time_new: float) -> UnitCell:
    """dA/dt = kappa s (r0^2 E - A) with E and s frozen over the step (docs/theory.md, "The consistent variant")."""
    return follow_tensor(cells, tensor_target(drive), drive.end_to_end_length, drive.kappa * (time_new - time_old))


LAWS: dict[str, Law] = {
    "explicit": ranked(explicit, has_limit=True),
    "rate": ranked(rate),
    "relaxation": ranked(relaxation, has_limit=True),
    "tensor": Law(tensor, has_limit=True, target=tensor_target, follow=follow_tensor),
    "none": Law(keep, remodels=False),
}
