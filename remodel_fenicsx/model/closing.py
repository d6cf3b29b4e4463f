"""The natural configuration of a tube: what closes and joins to a known ring, with or without loads.

A ring that is cut opens to a sector, and its layers may be stretched before they are joined. In cylindrical axes

    G = diag(k r/R, g_z, dr/dR) P,    k = 360/(360 - opening angle),

where R(r) is the sector's radius of what lies at r in the ring, and P the prestretch of the layer. R and g_z are such
that the ring is in equilibrium: as the unloaded tube without pressure and without axial force.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.model.panels import Panels

Array = NDArray[np.float64]
DEGREE = 24  # of R(r): the paper's artery at 160 degrees changes by less than 1e-8 from 16 to 32
MISSING = 1e-8  # of dR/dr: a panel that leaves more of it out is halved; walls of 1 to 7 and thicker have some
MOST_POLYNOMIALS = 8  # of one layer
LARGEST_TURN = (
    0.5  # of k: walls of 1 to 1.05 ... 3 close at 180 degrees (k = 2) in one piece too, and this is half of it
)
ITERATIONS = 30
CLOSED = 1e-9  # of the residual over lambda + 2 mu; the differences of the energy are good to about 1e-11
# of a value, for the tangent: rho(R) has slopes of some 1000 times it near the faces, and bending of a thin wall is so
# soft that with 1e-6 the error of the tangent is a tenth of it: 30 iterations in place of 20
VALUE_DIFFERENCE = 1e-7
STRETCH_DIFFERENCE = 1e-3  # of a stretch in the five-point rule: its error is of fourth order
UNSTRETCHED = (1.0, 1.0, 1.0)


class Layer(NamedTuple):
    """A layer of a ring.

    Attributes
    ----------
    radii
        Where it begins and ends in the ring.
    tissue
        Its parameters are numbers.
    prestretch
        Circumferential, axial and radial: from its natural state to what is joined.
    """

    radii: tuple[float, float]
    tissue: Tissue
    prestretch: tuple[float, float, float] = UNSTRETCHED


class Loads(NamedTuple):
    """What acts on the ring.

    Attributes
    ----------
    pressure
        On its inner face.
    force
        Of the wall along the axis; None where the axial stretch is prescribed.
    axial
        The axial stretch, where it is prescribed.
    """

    pressure: float = 0.0
    force: float | None = 0.0
    axial: float = 1.0


class Closing(NamedTuple):
    """What closes to a ring.

    Attributes
    ----------
    layers
        Of the ring, from the lumen outwards.
    panels
        One for each layer, which is a part of one where a polynomial does not follow it.
    radius
        R at the panels' points.
    circumferential, axial
        k and g_z.
    """

    layers: tuple[Layer, ...]
    panels: Panels
    radius: Array
    circumferential: float
    axial: float

    def natural_radius(self, radius: Array) -> Array:
        """R at r, both (...,)."""
        return self.panels.at(radius, self.radius)

    def stretches(self, radius: Array) -> Array:
        """Circumferential, axial and radial stretch of G at r (...,): (..., 3), as the rows of cylindrical axes."""
        slope = self.panels.at(radius, self.panels.derivative(self.radius))
        prestretch = np.array([layer.prestretch for layer in self.layers])[self.panels.of(radius)]
        return self._joined(radius, self.natural_radius(radius), slope) * prestretch

    def at_panels(self) -> Array:
        """The same at the panels' own points, (panels, points, 3)."""
        prestretch = np.array([layer.prestretch for layer in self.layers])[:, None]
        return self._joined(self.panels.places, self.radius, self.panels.derivative(self.radius)) * prestretch

    def _joined(self, radius: Array, natural: Array, slope: Array) -> Array:
        """G without the prestretch."""
        hoop = self.circumferential * radius / natural
        return np.stack([hoop, np.full_like(radius, self.axial), 1.0 / slope], axis=-1)


def closing(layers: Sequence[Layer], opening_angle: float, loads: Loads = Loads()) -> Closing:
    """What closes to a ring in equilibrium: of a tissue with isotropic cells.

    Parameters
    ----------
    layers
        Of the ring, from the lumen outwards.
    opening_angle
        Angle of the sector that is missing, in degrees (Fung's opening angle is half of it).
    loads
        Of the ring; default: none, the unloaded tube.

    Raises
    ------
    ArithmeticError
        If no equilibrium is found.
    """
    whole = 360.0 / (360.0 - opening_angle)
    panels = Panels([layers[0].radii[0], *(layer.radii[1] for layer in layers)], DEGREE)
    turns = np.linspace(1.0, whole, 1 + max(1, int(np.ceil((whole - 1.0) / LARGEST_TURN))))[1:]
    found = Closing(tuple(layers), panels, panels.places.copy(), 1.0, loads.axial)
    for k in turns:
        grown = np.mean(found.radius + (k - 1.0) * panels.places * 0.5) / np.mean(found.radius)
        found = _balanced(found._replace(radius=grown * found.radius, circumferential=float(k)), loads)
    while (rough := found.panels.missing(found.panels.derivative(found.radius)) > MISSING).any():
        parts = [
            part
            for layer, one in zip(found.layers, rough, strict=True)
            for part in (_halves(layer) if one else [layer])
        ]
        if len(parts) > MOST_POLYNOMIALS * len(layers):
            raise ArithmeticError(f"ring and sector vary too much through the wall for {len(parts)} polynomials")
        finer = Panels([parts[0].radii[0], *(part.radii[1] for part in parts)], DEGREE)
        radius = found.natural_radius(finer.places)
        found = _balanced(found._replace(layers=tuple(parts), panels=finer, radius=radius), loads)
    return found


def _halves(layer: Layer) -> list[Layer]:
    """Of one ratio of radii: what closes varies with the logarithm of the radius."""
    low, high = layer.radii
    middle = float(np.sqrt(low * high))
    return [layer._replace(radii=(low, middle)), layer._replace(radii=(middle, high))]


def _balanced(near: Closing, loads: Loads) -> Closing:
    """The equilibrium that is near."""
    stiffness = max(layer.tissue.lame_lambda + 2 * layer.tissue.lame_mu for layer in near.layers)
    scale: Array = np.append(np.full(near.radius.size, near.panels.edges[-1]), 1.0)
    residual = partial(_residual, near.layers, near.panels, near.circumferential, loads)
    values = solved(residual, np.append(near.radius, near.axial), scale, stiffness)
    return near._replace(radius=values[:-1].reshape(near.radius.shape), axial=float(values[-1]))


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
        changes = VALUE_DIFFERENCE * np.diag(scale)
        columns = [(residual(values + d) - residual(values - d)) / (2 * VALUE_DIFFERENCE) for d in changes]
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


def _residual(layers: tuple[Layer, ...], panels: Panels, k: float, loads: Loads, values: Array) -> Array:
    """Radial balance in the layers, what goes from one to the next, radial stress on both faces, axial force."""
    ring, radius = panels.places, values[:-1].reshape(panels.places.shape)
    stretches = Closing(layers, panels, radius, k, float(values[-1])).at_panels()
    stresses = [principal_stresses(layer.tissue, stretches[n]) for n, layer in enumerate(layers)]
    hoop, axial, radial = np.moveaxis(np.array(stresses), -1, 0)
    balance = (panels.derivative(radial) + (radial - hoop) / ring)[:, 1:-1] * (panels.edges[-1] - panels.edges[0]) / 2
    faces = [radial[0, 0] + loads.pressure, radial[-1, -1]]
    moduli = np.array([layer.tissue.lame_lambda + 2 * layer.tissue.lame_mu for layer in layers])
    between = panels.jumps(radius) / ring[0, 0] * moduli.max()
    edges = panels.edges
    area = np.pi * (edges[-1] ** 2 - edges[0] ** 2)
    if loads.force is None:
        along = (float(values[-1]) - loads.axial) * moduli.max()
    else:
        along = (2 * np.pi * panels.integral(axial * ring) - loads.force) / area
    return np.concatenate([balance.ravel(), faces, panels.jumps(radial), between, [along]])


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
