"""What cells a driving tensor makes at the end of a step, with the derivative: the laws, for Newton's method.

Everything is in the eigenbasis of C (`network`). The tensor X lives where the law looks for its eigenvectors: in
material space, or, for a spatial driver and the frame `spatial`, in space. The cells themselves are those of `laws`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.model import mandel, spectral, tensor_law
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.drivers import Driver, Frame, carried_axes
from remodel_fenicsx.model.implicit.network import LocalCells, OrthotropicCells, Strain, StructureCells
from remodel_fenicsx.model.laws import Drive, Law, framed, principal_directions

Array = NDArray[np.float64]

AGREE = 1e-7
"""Relative difference of two principal values below which nothing is known about a turn in their plane."""
SAME_LENGTH = 1e-9  # over r0: lengths of isotropic cells, but for rounding


@dataclass(frozen=True)
class StepOfCells:
    """What points know of their cells in a step, in the global basis.

    Attributes
    ----------
    law, driver, frame, pairing
        Of the registries.
    cells, structure
        At the start of the step: lengths (n, 3) and axes (n, 3, 3), and A (n, 3, 3).
    initial_dimensions
        l0, (n, 3).
    end_to_end_length
        r0, (n,).
    kappa, time_old, time_new
        Of the step.
    noise, rounding
        Size up to which a principal value of the driving tensor may be an error, and that of its rounding alone. Down
        to the latter it is solved for: what is missing here is missing in the balance of forces.
    """

    law: Law
    driver: Driver
    frame: Frame
    pairing: spectral.Pairing
    cells: UnitCell
    structure: Array
    initial_dimensions: Array
    end_to_end_length: Array
    kappa: float
    time_old: float
    time_new: float
    noise: float
    rounding: float

    @property
    def floor(self) -> float:
        """Of `tensor_law.target`."""
        return float(tensor_law.floor_above(self.noise, self.rounding))

    def at(self, chosen: Any) -> StepOfCells:
        """Of some of the points."""
        return replace(
            self,
            cells=UnitCell(self.cells.dimensions[chosen], self.cells.axes[chosen]),
            structure=self.structure[chosen],
            initial_dimensions=self.initial_dimensions[chosen],
            end_to_end_length=self.end_to_end_length[chosen],
        )

    @property
    def is_spatial(self) -> bool:
        """Whether X lives in space."""
        return not self.driver.material and not self.frame.carries_axes


class Response(NamedTuple):
    """Cells in the eigenbasis of C, and the derivatives of their numbers y by X and by U, (n, 6, 6).

    `place`: for cells with axes, where each of them stands among the lengths and axes of the law, (n, 3).
    """

    cells: LocalCells
    by_tensor: Array | None = None
    by_stretch: Array | None = None
    place: NDArray[np.intp] | None = None


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
    old, r0 = step.cells.dimensions, step.end_to_end_length[:, None]
    alike = np.repeat(r0 / np.sqrt(3), 3, axis=1)
    lengths = step.law.dimensions(old, step.initial_dimensions, alike, step.kappa, step.time_old, step.time_new)
    apart: NDArray[np.bool_] = np.ptp(lengths, axis=1) > SAME_LENGTH * step.end_to_end_length
    return apart


# ---------------------------------------------------------------- the law for A


def tensor_response(step: StepOfCells, strain: Strain, tensor: Array, derivatives: bool) -> Response:
    """A = A_old + w (r0^2 E - A_old), w = 1 - exp(-kappa s dt): `tensor_law` and its derivative."""
    rate = step.kappa * (step.time_new - step.time_old)
    towards = tensor_law.target(tensor, step.floor)
    old = strain.inside(step.structure)
    cells = StructureCells(tensor_law.follow(old, towards, step.end_to_end_length, rate))
    if not derivatives:
        return Response(cells)
    direction, share = tensor_law.target_derivatives(tensor, step.floor)
    left = np.exp(-rate * towards.share)
    squared = step.end_to_end_length**2
    way = mandel.vectors(squared[:, None, None] * towards.direction - old)
    by_tensor = (squared * -np.expm1(-rate * towards.share))[:, None, None] * direction
    by_tensor += mandel.dyads((rate * left)[:, None] * way, share)
    return Response(cells, by_tensor)


# ---------------------------------------------------------------- laws by rank


class _Principal(NamedTuple):
    """Principal values and axes (rows) of X with what the law makes of them, in the order of the frame."""

    values: Array
    axes: Array
    direction: Array
    slope: Array  # dl/d(target)
    cell: UnitCell
    active: NDArray[np.bool_]
    place: NDArray[np.intp]


def ranked_response(step: StepOfCells, strain: Strain, tensor: Array, derivatives: bool) -> Response:
    """Lengths by rank along the framed principal axes of X (`laws.ranked`), and their derivatives."""
    found = _principal(step, strain, tensor)
    cells = OrthotropicCells(found.cell)
    if not derivatives:
        return Response(cells, place=found.place)
    e, active = found.direction, found.active
    size = np.linalg.norm(np.where(e > 0, found.values, 0.0), axis=1)
    steepness = found.slope * (step.end_to_end_length / np.where(active, size, 1.0))[:, None]
    by_tensor: Array = np.zeros((len(e), 6, 6))
    by_tensor[:, :3, :3] = steepness[:, :, None] * (np.eye(3) - e[:, :, None] * e[:, None, :]) * (e > 0)[:, None, :]
    largest = np.abs(found.values).max(axis=1)
    for row, (i, j) in enumerate(mandel.PAIRS, start=3):
        gap = found.values[:, i] - found.values[:, j]
        known = np.abs(gap) > np.maximum(AGREE * largest, step.noise)
        by_tensor[:, row, row] = np.where(known, np.sqrt(0.5) / np.where(known, gap, 1.0), 0.0)
    by_stretch = None
    if not step.driver.material and step.frame.carries_axes:
        by_tensor, by_stretch = _pulled_back(found, strain, by_tensor)
        by_stretch[~active] = 0.0
    by_tensor[~active] = 0.0
    by_tensor = by_tensor @ mandel.congruence(found.axes)  # X in its own axes from X as it is
    return Response(cells, by_tensor, by_stretch, found.place)


def _principal(step: StepOfCells, strain: Strain, tensor: Array) -> _Principal:
    U = np.zeros_like(tensor)
    U[:, range(3), range(3)] = strain.stretches
    old = UnitCell(step.cells.dimensions, step.cells.axes @ strain.basis)
    carried = not step.driver.material and step.frame.carries_axes
    # an error may not decide how cells jump; where they do not, axes that stay up to the noise would be the only jump
    error = np.where(jumps_by_rank(step), step.noise, step.rounding)
    drive = Drive(
        U,
        spectral.without_noise(tensor, carried_axes(U, old.axes) if carried else old.axes, error),
        step.driver,
        step.frame,
        step.noise,
        step.initial_dimensions,
        step.end_to_end_length,
        step.kappa,
        step.pairing,
    )
    values, axes = principal_directions(drive, old.axes, step.pairing)
    direction, active = spectral.positive_direction(values, threshold=step.noise)
    target, tiny = step.end_to_end_length[:, None] * direction, 1e-30
    # elementwise in its arguments: the slope by a complex step
    law: Any = step.law.dimensions
    lengths = law(old.dimensions, step.initial_dimensions, target + 1j * tiny, step.kappa, step.time_old, step.time_new)
    dimensions, slope = np.real(lengths), np.imag(lengths) / tiny
    by_rank = step.pairing is spectral.principal
    cell_axes = framed(drive, axes, None if by_rank else dimensions)
    place = np.tile(np.arange(3), (len(values), 1))
    if carried and not by_rank:
        place = np.argsort(-dimensions, axis=1, kind="stable")
    cell = UnitCell(
        np.where(active[:, None], dimensions, old.dimensions),
        np.where(active[:, None, None], cell_axes, old.axes),
    )

    def ordered(entries: Array) -> Array:
        return np.take_along_axis(entries, place if entries.ndim == 2 else place[:, :, None], axis=1)

    cell = UnitCell(ordered(cell.dimensions), ordered(cell.axes))
    return _Principal(ordered(values), ordered(axes), ordered(direction), ordered(slope), cell, active, place)


def _pulled_back(found: _Principal, strain: Strain, turns: Array) -> tuple[Array, Array]:
    """dy/dX in the axes of X and dy/dU, where n_1 is U^-1 m_1, n_2 U^-1 m_2 orthogonalised, n_3 what is left.

    `turns`: dy/dX in the axes of X where n = m.
    """
    m, n, inverse = found.axes, found.cell.axes, 1 / strain.stretches[:, None, :]
    w = (n * inverse) @ np.swapaxes(m, 1, 2)  # n_a . U^-1 m_b
    w = np.where(found.active[:, None, None], w, np.eye(3))  # axes that stay follow none of X
    (r12, r02, r01), turned = (turns[:, 3], turns[:, 4], turns[:, 5]), turns.copy()
    first, second, third = (w[:, i, i, None] for i in range(3))
    turned[:, 5] = (w[:, 1, 1, None] * r01 + w[:, 1, 2, None] * r02) / first
    turned[:, 4] = third * r02 / first
    turned[:, 3] = (third * r12 - w[:, 0, 1, None] * turned[:, 4]) / second
    stretched = np.zeros_like(turns)
    carried, pulled = m * inverse, n * inverse  # U^-1 m_b, U^-1 n_a

    def across(a: int, b: int) -> Array:
        dyad = pulled[:, a, :, None] * carried[:, b, None, :]
        return mandel.vectors((dyad + np.swapaxes(dyad, 1, 2)) / 2)

    stretched[:, 5] = -across(1, 0) / first
    stretched[:, 4] = -across(2, 0) / first
    stretched[:, 3] = (-across(2, 1) - w[:, 0, 1, None] * stretched[:, 4]) / second
    return turned, stretched
