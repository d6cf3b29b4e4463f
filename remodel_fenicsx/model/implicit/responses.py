"""What cells a driving tensor makes at the end of a step, with the derivative: the laws, for Newton's method.

Everything is in the eigenbasis of C (`network`). The tensor X lives where the law looks for its eigenvectors: in
material space, or, for a spatial driver and the frame `spatial`, in space. The cells themselves are those of `laws`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.model import spectral, tensor_law, tensors
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.drivers import carried_axes
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.model.implicit.network import LocalCells, OrthotropicCells, Strain, StructureCells
from remodel_fenicsx.model.laws import Drive, Law, Ranked, by_rank
from remodel_fenicsx.model.turnover import TurnedOver, TurnoverRule, at_the_end

Array = NDArray[np.float64]

AGREE = 1e-7
"""Relative difference of two principal values below which nothing is known about a turn in their plane."""
SAME_LENGTH = 1e-9  # over r0: lengths of isotropic cells, but for rounding


class StepOfCells(NamedTuple):
    """What points know of their cells in a step, in the global basis.

    Attributes
    ----------
    law
        Of the registry.
    drive
        What acts, with the driver's parameters; its deformation and tensor are those at the start. Down to its
        `rounding` the driving tensor is solved for: what is missing here is missing in the balance of forces.
    cells, structure
        At the start of the step: lengths (n, 3) and axes (n, 3, 3), and A (n, 3, 3).
    time_old, time_new
        Of the step.
    turnover
        How content and natural length change over it; None where they stay.
    """

    law: Law
    drive: Drive
    cells: UnitCell
    structure: Array
    time_old: float
    time_new: float
    turnover: TurnoverRule | None = None

    @property
    def turned_over(self) -> Callable[[Tissue, Array], TurnedOver] | None:
        """Content and natural length at its end from the tissue and r there."""
        rule, duration = self.turnover, self.time_new - self.time_old
        return None if rule is None else lambda tissue, length: at_the_end(rule, tissue, length, duration)

    @property
    def is_spatial(self) -> bool:
        """Whether X lives in space."""
        return not self.drive.driver.material and not self.drive.frame.carries_axes

    @property
    def carries_axes(self) -> bool:
        """Whether the principal axes of X are pulled back to those of the cells."""
        return not self.drive.driver.material and self.drive.frame.carries_axes

    @property
    def rate(self) -> Array | float:
        """kappa dt, (n,) or a number."""
        return self.drive.kappa * (self.time_new - self.time_old)


class Response(NamedTuple):
    """Cells in the eigenbasis of C, and the derivatives of their numbers y by X and by U, (n, 6, 6)."""

    cells: LocalCells
    by_tensor: Array | None = None
    by_stretch: Array | None = None


def response(step: StepOfCells, strain: Strain, tensor: Array, derivatives: bool) -> Response:
    """Of a law with a target (`Law.target`) or with dimensions by rank (`Law.dimensions`).

    Parameters
    ----------
    tensor
        X, (n, 3, 3).
    """
    respond = ranked_response if step.law.dimensions is not None else tensor_response
    return respond(step, strain, tensor, derivatives)


def jumps_by_rank(step: StepOfCells) -> NDArray[np.bool_]:
    """Where cells jump when principal values cross, (n,): where equal targets leave the ranks different lengths.

    There the equations of an implicit step may have no solution. Elsewhere cells are continuous in the driving tensor:
    from isotropic cells eq. (11) never jumps, and the law for A nowhere.
    """
    if step.law.dimensions is None:
        return np.zeros(len(step.structure), dtype=bool)
    r0 = np.asarray(step.drive.end_to_end_length)
    lengths = _lengths(step, np.repeat(r0[:, None] / np.sqrt(3), 3, axis=1))
    apart: NDArray[np.bool_] = np.ptp(lengths, axis=1) > SAME_LENGTH * r0
    return apart & (np.asarray(step.drive.kappa) > 0.0)


def _lengths(step: StepOfCells, target: Any) -> Array:
    """What a law by rank makes of the lengths; `target` may be complex."""
    drive, law = step.drive, step.law.dimensions
    assert law is not None
    return law(step.cells.dimensions, drive.initial_dimensions, target, drive.kappas, step.time_old, step.time_new)


# ---------------------------------------------------------------- the law for A


def tensor_response(step: StepOfCells, strain: Strain, tensor: Array, derivatives: bool) -> Response:
    """A = A_old + w (r0^2 E - A_old), w = 1 - exp(-kappa s dt): `tensor_law` and its derivative."""
    r0 = np.asarray(step.drive.end_to_end_length)
    towards, old = tensor_law.target(tensor, step.drive.floor), strain.inside(step.structure)
    cells = StructureCells(tensor_law.follow(old, towards, r0, step.rate))
    if not derivatives:
        return Response(cells)
    direction, share = tensor_law.target_derivatives(tensor, step.drive.floor)
    squared, weight = r0**2, -np.expm1(-step.rate * towards.share)
    by_tensor = (squared * weight)[:, None, None] * direction
    by_share = step.rate * np.exp(-step.rate * towards.share)
    way = tensors.to_mandel(squared[:, None, None] * towards.direction - old)
    by_tensor += tensors.dyads(by_share[:, None] * way, share)
    return Response(cells, by_tensor)


# ---------------------------------------------------------------- laws by rank


def ranked_response(step: StepOfCells, strain: Strain, tensor: Array, derivatives: bool) -> Response:
    """Lengths by rank along the framed principal axes of X (`laws.by_rank`), and their derivatives."""
    old = UnitCell(step.cells.dimensions, step.cells.axes @ strain.basis)
    assert step.law.dimensions is not None
    found = by_rank(step.law.dimensions, old, _drive(step, strain, tensor, old), step.time_old, step.time_new)
    cells = OrthotropicCells(found.cells)
    if not derivatives:
        return Response(cells)
    by_tensor: Array = np.zeros((len(tensor), 6, 6))
    by_tensor[:, :3, :3] = _lengths_by_values(step, found)
    by_tensor[:, range(3, 6), range(3, 6)] = _turns_by_tensor(step, found)
    by_stretch = None
    if step.carries_axes:
        by_stretch = np.zeros_like(by_tensor)
        by_turns, by_stretch[:, 3:] = _pulled_back(step, found, strain)
        by_tensor[:, 3:] = by_turns @ by_tensor[:, 3:]
        by_stretch[~found.active] = 0.0
    by_tensor[~found.active] = 0.0
    by_tensor = by_tensor @ tensors.congruence(found.axes)  # X in its own axes from X as it is
    return Response(cells, by_tensor, by_stretch)


def _drive(step: StepOfCells, strain: Strain, tensor: Array, old: UnitCell) -> Drive:
    """What acts at a strain, with a driving tensor."""
    U = np.zeros_like(tensor)
    U[:, range(3), range(3)] = strain.stretches
    axes = carried_axes(U, old.axes) if step.carries_axes else old.axes
    # an error may not decide how cells jump; where they do not, axes that stay up to the noise would be the only jump
    error = np.where(jumps_by_rank(step), step.drive.threshold, step.drive.rounding)
    steady = spectral.without_noise(tensor, axes, error)
    return step.drive._replace(deformation_gradient=U, tensor=steady, kernels=spectral)


def _lengths_by_values(step: StepOfCells, found: Ranked) -> Array:
    """dl/d(principal values of X), (n, 3, 3): de = (1 - e e) dv+ / |v+|, and the law's slope by a complex step."""
    tiny, r0 = 1e-30, np.reshape(step.drive.end_to_end_length, (-1, 1))
    slope = np.imag(_lengths(step, found.target + 1j * tiny)) / tiny
    e = found.target / r0
    size = np.linalg.norm(np.where(e > 0, found.values, 0.0), axis=1)
    steepness = slope * (r0 / np.where(found.active, size, 1.0)[:, None])
    by_values: Array = steepness[:, :, None] * (np.eye(3) - e[:, :, None] * e[:, None, :]) * (e > 0)[:, None, :]
    return by_values


def _turns_by_tensor(step: StepOfCells, found: Ranked) -> Array:
    """By what the axes of X turn in the planes of `PAIRS`, over the Mandel components of dX there: 1/(v_i - v_j)."""
    i, j = np.transpose(tensors.PAIRS)
    gap = found.values[:, i] - found.values[:, j]
    unknown = AGREE * np.abs(found.values).max(axis=1)
    known = np.abs(gap) > np.maximum(unknown, step.drive.threshold)[:, None]
    return np.where(known, np.sqrt(0.5) / np.where(known, gap, 1.0), 0.0)


def _pulled_back(step: StepOfCells, found: Ranked, strain: Strain) -> tuple[Array, Array]:
    """Turns of the cells' axes n by those of the axes m of X, (n, 3, 3), and by the Mandel components of dU (n, 3, 6).

    n are the rows m U^-1, orthonormalised in the frame's order (`drivers.material_frame`): m U^-1 = L n, L lower
    triangular in that order. With dm = W m it follows that dn = V n, V_ij = (L^-1 W L - n dU U^-1 n^T)_ij where n_i
    comes before n_j.
    """
    m, n, u = found.axes, found.cells.axes, strain.stretches[:, None, :]
    carried = n / u
    L, inverse = m @ np.swapaxes(carried, 1, 2), (n * u) @ np.swapaxes(m, 1, 2)
    i, j = (number[:, None] for number in np.transpose(tensors.PAIRS))
    p, q = i.T, j.T
    before: Any = True
    if step.drive.pairing is not spectral.principal:  # as `laws.framed`
        lengths = found.cells.dimensions
        before = lengths[:, i] >= lengths[:, j]

    def by_turns(i: Any, j: Any) -> Array:
        return inverse[:, i, p] * L[:, q, j] - inverse[:, i, q] * L[:, p, j]

    def by_stretch(i: Any, j: Any) -> Array:
        dyads = n[:, i[:, 0], :, None] * carried[:, j[:, 0], None, :]
        return -tensors.to_mandel(dyads + np.swapaxes(dyads, 2, 3)) / 2

    return np.where(before, by_turns(i, j), -by_turns(j, i)), np.where(before, by_stretch(i, j), -by_stretch(j, i))
