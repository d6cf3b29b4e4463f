"""The natural configuration of a tube with an opening angle: the sector that closes to a known ring without loads.

A ring that is cut opens to a sector. With k = 360/(360 - opening angle) the way back is, in cylindrical axes,

    G = diag(dr/dR, k r/R, g_z),

where R(r) is the sector's radius of what lies at r in the closed ring. R and g_z are such that the ring is in
equilibrium without pressure and without axial force.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.energy import Tissue

Array = NDArray[np.float64]
DEGREE = 24  # of R(r): the paper's artery at 160 degrees changes by less than 1e-8 from 16 to 32
LARGEST_TURN = (
    0.5  # of k: walls of 1 to 1.05 ... 3 close at 180 degrees (k = 2) in one piece too, and this is half of it
)
ITERATIONS = 30
CLOSED = 1e-9  # of the residual over lambda + 2 mu; the differences of the energy are good to about 1e-11
STRETCH_DIFFERENCE = 1e-3  # of a stretch in the five-point rule: its error is of fourth order


class Closing(NamedTuple):
    """A sector that closes to a ring.

    Attributes
    ----------
    radii
        r_i and r_o of the ring.
    coefficients
        Of R(r), in Chebyshev polynomials of the ring's radius between -1 and 1.
    circumferential, axial
        k and g_z.
    """

    radii: tuple[float, float]
    coefficients: Array
    circumferential: float
    axial: float

    def natural_radius(self, radius: Array) -> Array:
        """R at r, both (...,)."""
        return np.asarray(chebyshev.chebval(between(radius, self.radii), self.coefficients), dtype=np.float64)

    def stretches(self, radius: Array) -> Array:
        """Circumferential, axial and radial stretch of G at r (...,): (..., 3), as the rows of cylindrical axes."""
        slope = chebyshev.chebval(between(radius, self.radii), chebyshev.chebder(self.coefficients))
        inner, outer = self.radii
        radial = (outer - inner) / 2 / slope
        hoop = self.circumferential * radius / self.natural_radius(radius)
        return np.stack([hoop, np.full_like(radius, self.axial), radial], axis=-1)

    def gradient(self, radius: Array, axes: Array) -> Array:
        """G (..., 3, 3) at r (...,), with the cylindrical axes there as rows (..., 3, 3)."""
        found: Array = np.swapaxes(axes, -1, -2) @ (self.stretches(radius)[..., None] * axes)
        return found


def closing(tissue: Tissue, radii: tuple[float, float], opening_angle: float) -> Closing:
    """The sector of a tissue with isotropic cells that closes to a ring of these radii.

    Parameters
    ----------
    tissue
        Its parameters are numbers.
    radii
        r_i and r_o of the closed ring.
    opening_angle
        Angle of the sector that is missing, in degrees (Fung's opening angle is half of it).

    Raises
    ------
    ArithmeticError
        If no equilibrium is found.
    """
    whole = 360.0 / (360.0 - opening_angle)
    places = np.cos(np.pi * np.arange(DEGREE, -1, -1) / DEGREE)
    radius = radii[0] + (radii[1] - radii[0]) * (places + 1) / 2
    values = np.append(radius, 1.0)  # R at the places, and g_z
    for k in np.linspace(1.0, whole, 1 + int(np.ceil((whole - 1.0) / LARGEST_TURN)))[1:]:
        values[:-1] *= np.mean(values[:-1] + (k - 1.0) * radius * 0.5) / np.mean(values[:-1])
        scale: Array = np.append(np.full(len(places), radii[1]), 1.0)
        stiffness = tissue.lame_lambda + 2 * tissue.lame_mu
        values = solved(partial(_residual, tissue, radii, places, float(k)), values, scale, stiffness)
    coefficients: Array = np.asarray(chebyshev.chebfit(places, values[:-1], DEGREE), dtype=np.float64)
    return Closing(radii, coefficients, whole, float(values[-1]))


def between(radius: Array, radii: tuple[float, float]) -> Array:
    return np.asarray(2 * (radius - radii[0]) / (radii[1] - radii[0]) - 1, dtype=np.float64)


def solved(function: Callable[[Array], Array], values: Array, scale: Array, stiffness: float) -> Array:
    """Newton with differences, halved where a step leaves what has an energy.

    Parameters
    ----------
    function
        Stresses that shall vanish, of the values.
    values, scale
        A start, and sizes of the values.
    stiffness
        Of which the stresses are shares.

    Raises
    ------
    ArithmeticError
        If no solution is found.
    """

    def residual(trial: Array) -> Array:
        with np.errstate(all="ignore"):
            return np.asarray(function(trial) / stiffness, dtype=np.float64)

    present = residual(values)
    for _ in range(ITERATIONS):
        if np.abs(present).max() < CLOSED:
            return values
        changes = 1e-6 * np.diag(scale)
        columns = [(residual(values + d) - residual(values - d)) / 2e-6 for d in changes]
        if not np.isfinite(columns).all() or not np.isfinite(present).all():
            break
        step: Array = scale * np.linalg.solve(np.transpose(columns), present)
        shares = (0.5**power for power in range(12))
        for share in shares:
            trial = residual(values - share * step)
            if np.isfinite(trial).all() and np.linalg.norm(trial) < np.linalg.norm(present) * 10:
                break
        values, present = values - share * step, trial
    raise ArithmeticError(f"no equilibrium of ring and sector; out of balance by {np.abs(present).max():.2g}")


def _residual(tissue: Tissue, radii: tuple[float, float], places: Array, k: float, values: Array) -> Array:
    """Radial balance inside, radial stress on both faces, axial force."""
    half = (radii[1] - radii[0]) / 2
    radius = radii[0] + half * (places + 1)
    coefficients: Array = np.asarray(chebyshev.chebfit(places, values[:-1], DEGREE), dtype=np.float64)
    shape = Closing(radii, coefficients, k, float(values[-1]))
    hoop, axial, radial = np.moveaxis(principal_stresses(tissue, shape.stretches(radius)), -1, 0)
    fitted = chebyshev.chebfit(places, radial, DEGREE)
    balance = chebyshev.chebval(places, chebyshev.chebder(fitted)) + (radial - hoop) * half / radius
    force = chebyshev.chebint(chebyshev.chebfit(places, axial * radius, DEGREE), lbnd=-1)
    faces = radial[[0, -1]]
    return np.concatenate([balance[1:-1], faces, [chebyshev.chebval(1.0, force) / (radii[0] + radii[1])]])


def principal_stresses(tissue: Tissue, stretches: Array, dimensions: Array | None = None) -> Array:
    """Principal Cauchy stresses (..., 3) along stretches (..., 3), which are the axes of the cells.

    Parameters
    ----------
    tissue
        Its parameters are numbers.
    stretches
        F_e.
    dimensions
        l_I along them (..., 3), in link lengths; default: isotropic cells.
    """
    shape = stretches.shape[:-1]
    length = np.full((*shape, 3), tissue.end_to_end_length / np.sqrt(3.0)) if dimensions is None else dimensions
    cell = UnitCell(length, np.broadcast_to(np.eye(3), (*shape, 3, 3)))

    def energy(index: int, change: float) -> Array:
        moved = stretches.copy()
        moved[..., index] *= np.exp(change)
        return np.asarray(tissue.strain_energy(moved[..., None] * np.eye(3), [cell]))

    h = STRETCH_DIFFERENCE
    slopes = [
        (8 * (energy(i, h) - energy(i, -h)) - (energy(i, 2 * h) - energy(i, -2 * h))) / (12 * h) for i in range(3)
    ]
    found: Array = np.stack(slopes, axis=-1) / np.prod(stretches, axis=-1)[..., None]
    return found
