"""Residual stress of a round wall: closed from a sector, or cut, on panels through its radius."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.energy import TURNED_OVER, Tissue


# ---------------------------------------------------------------- functions of the radius on panels
# Values at Chebyshev points, with derivative and integral.
# A panel is a layer or a part of one: within it a function is smooth, from one to the next its derivative may jump.

Array = NDArray[np.float64]


class Panels:
    """Chebyshev points of one or more panels, and what is done with values there."""

    def __init__(self, edges: Sequence[float], degree: int):
        self.edges, self.degree = np.asarray(edges, dtype=np.float64), degree
        self._points = points = np.cos(np.pi * np.arange(degree, -1, -1) / degree)
        self._half = np.diff(self.edges)[:, None] / 2
        self.places: Array = self.edges[:-1, None] + self._half * (points + 1)
        self.places[:, -1] = self.edges[1:]
        self._coefficients = np.linalg.inv(chebyshev.chebvander(points, degree))
        ones = np.eye(degree + 1)
        slopes = np.stack([chebyshev.chebval(points, chebyshev.chebder(one)) for one in ones], axis=-1)
        self._slope: Array = slopes @ self._coefficients
        areas = np.array([chebyshev.chebval(1.0, chebyshev.chebint(one, lbnd=-1)) for one in ones])
        self._weights: Array = areas @ self._coefficients

    def derivative(self, values: Array) -> Array:
        """By the radius, of values (panels, points)."""
        return values @ self._slope.T / self._half

    def integral(self, values: Array) -> float:
        """Over all panels."""
        return float(np.sum(values * self._weights * self._half))

    def jumps(self, values: Array) -> Array:
        """From one panel to the next, (panels - 1,)."""
        return values[1:, 0] - values[:-1, -1]

    def of(self, radius: Array) -> NDArray[np.intp]:
        """Number of the panel of each radius (...,); what is outside belongs to the nearest."""
        return np.clip(np.searchsorted(self.edges, radius, side="right") - 1, 0, len(self.edges) - 2)

    def missing(self, values: Array) -> Array:
        """About what the polynomials leave out of values (panels, points), as shares of the largest; (panels,)."""
        found: Array = np.abs(values @ self._coefficients.T)
        return found[:, -2:].max(axis=1) / found.max()

    def at(self, radius: Array, values: Array) -> Array:
        """Of values (panels, points), at radii (...,)."""
        panel = self.of(radius)
        share = (radius - self.edges[panel]) / (2 * self._half[panel, 0]) * 2 - 1
        found = np.empty_like(radius, dtype=np.float64)
        for number, row in enumerate(values @ self._coefficients.T):
            found[panel == number] = chebyshev.chebval(share[panel == number], row)
        return found


# ---------------------------------------------------------------- the natural configuration of a tube
# What closes and joins to a known ring, with or without loads.
# A ring that is cut opens to a sector, and its layers may be stretched before they are joined. In cylindrical axes
#     G = diag(k r/R, g_z, dr/dR) P,    k = 360/(360 - opening angle),
# where R(r) is the sector's radius of what lies at r in the ring, and P the prestretch of the layer. R and g_z are
# such that the ring is in equilibrium: as the unloaded tube without pressure and without axial force.

DEGREE = 24  # of R(r): the paper's artery at 160 degrees changes by less than 1e-8 from 16 to 32
MISSING = 1e-8  # of dR/dr: a panel that leaves more of it out is halved; walls of 1 to 7 and thicker have some
MOST_POLYNOMIALS = 8  # of one layer
LARGEST_TURN = 0.5  # of k: walls of 1 to 1.05 ... 3 close at 180 degrees (k = 2) in one piece too; half of it
ITERATIONS = 30
CLOSED = 1e-9  # of the residual over lambda + 2 mu; the differences of the energy are good to about 1e-11
# of a value, for the tangent: rho(R) has slopes of some 1000 times it near the faces, and bending of a thin wall is so
# soft that with 1e-6 the error of the tangent is a tenth of it: 30 iterations in place of 20
VALUE_DIFFERENCE = 1e-7
STRETCH_DIFFERENCE = 1e-3  # of a stretch in the five-point rule: its error is of fourth order
UNSTRETCHED = (1.0, 1.0, 1.0)


class Layer(NamedTuple):
    """A layer of a ring."""

    radii: tuple[float, float]
    tissue: Tissue
    prestretch: tuple[float, float, float] = UNSTRETCHED


class Loads(NamedTuple):
    """What acts on the ring."""

    pressure: float = 0.0
    force: float | None = 0.0
    axial: float = 1.0


class Closing(NamedTuple):
    """What closes to a ring."""

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
    """What closes to a ring in equilibrium: of a tissue with isotropic cells."""
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
    """Newton with differences, halved where a step leaves what has an energy."""

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
    """Principal Cauchy stresses (..., 3) along stretches (..., 3), which are the axes of the cells."""
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
    return np.stack(slopes, axis=-1) / np.prod(stretches, axis=-1)[..., None]


# ---------------------------------------------------------------- what a tube without loads does when it is cut
# It is cut along its length, and opens to a sector. The mesh's ring of radii R becomes a sector of radii rho(R), in
# cylindrical axes
#     F = diag(k rho/R, e, drho/dR),    F_e = F G,
# without pressure, axial force and bending moment; its opening angle is 360 (1 - k). The cells stay.

CUT_DEGREE = 32  # of rho(R): angles of remodeled walls, whose cells have a front, change by less than 0.1 degrees to 48


class Cut(NamedTuple):
    """A ring that has been cut."""

    opening_angle: float
    radii: tuple[float, float]
    axial: float


class _Wall(NamedTuple):
    """What is known of the ring: its layers' tissues, points, and G and l_I there, (panels, points, 3)."""

    tissues: tuple[Tissue, ...]
    panels: Panels
    natural: Array
    dimensions: Array


def cut(layers: Sequence[Layer], closed: Closing | None, radius: Array, squared_dimensions: Array) -> Cut:
    """Cut an unloaded tube."""
    panels = Panels([layers[0].radii[0], *(layer.radii[1] for layer in layers)], CUT_DEGREE)
    squared = np.empty((*panels.places.shape, squared_dimensions.shape[1]))
    panel = panels.of(radius)
    for number, at in enumerate(panels.places):  # what lies in a layer says nothing of the next
        here = panel == number
        rows = radius[here], squared_dimensions[here]
        squared[number] = np.stack([np.interp(at, rows[0], column) for column in rows[1].T], axis=-1)
    squared, turned = squared[..., :3], np.moveaxis(squared[..., 3:], -1, 0)
    natural, start = np.ones_like(squared), (panels.places.copy(), 1.0, 1.0)
    if closed is not None:
        fine = closed._replace(layers=tuple(layers), panels=panels, radius=closed.natural_radius(panels.places))
        natural = fine.at_panels()
        start = (fine.radius, 1 / closed.axial, 1 / closed.circumferential)  # what opens, were the cells as they were
    tissues = []
    for number, layer in enumerate(layers):
        changes: dict[str, Any] = dict(zip(TURNED_OVER, turned[:, number], strict=False))  # none without turnover
        tissues.append(replace(layer.tissue, **changes))
    wall = _Wall(tuple(tissues), panels, natural, np.sqrt(np.maximum(squared, 0.0)))
    values: Array = np.concatenate([start[0].ravel(), start[1:]])
    scale: Array = np.concatenate([np.full(panels.places.size, panels.edges[-1]), [1.0, 1.0]])
    stiffness = max(tissue.lame_lambda + 2 * tissue.lame_mu for tissue in tissues)
    found = solved(partial(_residual_of_a_cut, wall, stiffness), values, scale, stiffness)
    return Cut(360.0 * (1.0 - float(found[-1])), (float(found[0]), float(found[-3])), float(found[-2]))


def _residual_of_a_cut(wall: _Wall, stiffness: float, values: Array) -> Array:
    """Radial balance in the layers, what goes on between them, both faces, axial force and bending moment: stresses."""
    panels, axial, k = wall.panels, values[-2], values[-1]
    ring, half = panels.places, (panels.edges[-1] - panels.edges[0]) / 2
    rho = values[:-2].reshape(ring.shape)
    slope = panels.derivative(rho)
    stretches = np.stack([k * rho / ring, np.full_like(rho, axial), slope], axis=-1) * wall.natural
    stresses = [principal_stresses(t, stretches[n], wall.dimensions[n]) for n, t in enumerate(wall.tissues)]
    hoop, along, radial = np.moveaxis(np.array(stresses), -1, 0)
    balance = (panels.derivative(radial) + (radial - hoop) * slope / rho)[:, 1:-1] * half
    between = panels.jumps(rho) / ring[0, 0] * stiffness
    means = [panels.integral(density * rho * slope) / half / (rho[0, 0] + rho[-1, -1]) for density in (along, hoop)]
    faces = [radial[0, 0], radial[-1, -1]]
    return np.concatenate([balance.ravel(), faces, panels.jumps(radial), between, means])


def means_through(radius: Array, values: Array, weights: Array, number: int) -> tuple[Array, Array]:
    """Radius and values (n, 3) at points, averaged in as many layers of one thickness as hold a point, by weight."""
    edges = np.linspace(radius.min(), radius.max() * (1 + 1e-12), number + 1)
    layer = np.clip(np.searchsorted(edges, radius, side="right") - 1, 0, number - 1)
    total = np.bincount(layer, weights, number)
    some = total > 0
    means = [np.bincount(layer, weights * column, number)[some] / total[some] for column in (radius, *values.T)]
    return means[0], np.stack(means[1:], axis=-1)
