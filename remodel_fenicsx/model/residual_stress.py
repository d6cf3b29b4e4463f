"""Residual stress of a round wall: closed from a sector, or cut, on panels through its radius."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.energy import TURNED_OVER, Tissue
from remodel_fenicsx.model.laws import COMPLEX_STEP

Array = NDArray[np.float64]

DEGREE = 24  # of R(r): the paper's artery at 160 degrees changes by less than 1e-8 from 16 to 32
MISSING = 1e-8  # of dR/dr: a panel that leaves more of it out is halved; walls of 1 to 7 and thicker have some
MOST_POLYNOMIALS = 8  # of one layer: walls of 1 to 1.05 ... 12 take 1 or 2
LARGEST_TURN = 0.5  # of k: walls of 1 to 1.05 ... 3 close at 180 degrees (k = 2) in one piece too; half of it
ITERATIONS = 30  # of Newton's method, which takes 5 to 7 for walls of 1 to 1.05 ... 12 at 90 to 270 degrees
CLOSED = 1e-9  # of the residual over lambda + 2 mu; the differences of the energy are good to about 1e-11
STRETCH_DIFFERENCE = 1e-3  # of a logarithm in the five-point rules: their error is of fourth order
UNSTRETCHED = (1.0, 1.0, 1.0)
MODULI = ("lame_lambda", "lame_mu", "network_modulus")
PARTS_OF_A_LAYER, CUT_DEGREE = 6, 12
"""Polynomials of rho(R) in a layer, and their degree. Angles of remodeled walls, whose cells have fronts, are good to
0.3 degrees; one of degree 32 is off by 1.3 in a thick wall that has grown, and one of 64 ends at rounding."""


# ---------------------------------------------------------------- functions of the radius on panels
# Values at Chebyshev points, with derivative and integral.
# A panel is a layer or a part of one: within it a function is smooth, from one to the next its derivative may jump.


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
        """By the radius, of values (..., panels, points)."""
        return values @ self._slope.T / self._half

    def integral(self, values: Array) -> Array:
        """Over all panels, of values (..., panels, points)."""
        return np.asarray(np.sum(values * self._weights * self._half, axis=(-2, -1)))

    def jumps(self, values: Array) -> Array:
        """From one panel to the next, (..., panels - 1)."""
        return values[..., 1:, 0] - values[..., :-1, -1]

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
    axial: Any

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
        return np.stack(np.broadcast_arrays(hoop, self.axial, 1.0 / slope), axis=-1)


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
    """The equilibrium that is near: forces on both faces, and along."""
    panels, tissues = near.panels, [layer.tissue for layer in near.layers]
    stiffness, edges = _stiffness(tissues), panels.edges

    def stretches(values: Array) -> Array:
        radius = values[..., :-1].reshape(*values.shape[:-1], *near.radius.shape)
        return near._replace(radius=radius, axial=values[..., -1:, None]).at_panels()

    def residual(values: Array, stresses: Array) -> Array:
        through = _through(panels, values[..., :-1], stresses, panels.places, loads.pressure / stiffness)
        force = 2 * np.pi * panels.integral(stresses[..., 1] * panels.places)
        if loads.force is None:
            along = values[..., -1] - loads.axial
        else:
            along = (force - loads.force / stiffness) / (np.pi * (edges[-1] ** 2 - edges[0] ** 2))
        return np.concatenate([through, along[..., None]], axis=-1)

    found = solved(tissues, [None] * len(tissues), stretches, residual, np.append(near.radius, near.axial))
    return near._replace(radius=found[:-1].reshape(near.radius.shape), axial=float(found[-1]))


def _stiffness(tissues: Sequence[Tissue]) -> float:
    return max(float(np.max(tissue.lame_lambda + 2 * tissue.lame_mu)) for tissue in tissues)


def _through(
    panels: Panels, unknown: Array, stresses: Array, place: Array, pressure: float = 0.0, slope: Array | float = 1.0
) -> Array:
    """Radial balance in the layers, radial stress on both faces, and what goes from one layer to the next."""
    hoop, _, radial = np.moveaxis(stresses, -1, 0)
    balance = panels.derivative(radial) + (radial - hoop) * slope / place
    inside = balance[..., 1:-1] * (panels.edges[-1] - panels.edges[0]) / 2
    faces = np.stack([radial[..., 0, 0] + pressure, radial[..., -1, -1]], axis=-1)
    between = panels.jumps(unknown.reshape(radial.shape)) / panels.edges[0]
    return np.concatenate([inside.reshape(*inside.shape[:-2], -1), faces, panels.jumps(radial), between], axis=-1)


@np.errstate(all="ignore")
def solved(
    tissues: Sequence[Tissue],
    dimensions: Sequence[Array | None],
    stretches: Callable[[Array], Array],
    residual: Callable[[Array, Array], Array],
    values: Array,
) -> Array:
    """Newton, halved where a step leaves what has an energy: values (n,) whose residual is zero."""
    # `stretches` (..., panels, points, 3) and `residual` (..., n) are of values (..., n), and of stresses over the
    # largest stiffness, real or complex
    stiffness = _stiffness(tissues)

    def state(trial: Array) -> tuple[Array, Array, Array, Array]:
        of = stretches(trial)
        found = [principal_stresses(*layer) for layer in zip(tissues, [*of], dimensions, strict=True)]
        stresses, tangents = (np.stack(parts) / stiffness for parts in zip(*found, strict=True))
        return of, stresses, tangents, residual(trial, stresses)

    of, stresses, tangents, present = state(values)
    for _ in range(ITERATIONS):
        # a stress depends on its own point's stretches alone; all else is closed formulas: exact by a complex step
        moved = values + 1j * COMPLEX_STEP * np.eye(len(values))
        strains = np.log(stretches(moved) / of)
        columns = residual(moved, stresses + (tangents @ strains[..., None])[..., 0]).imag / COMPLEX_STEP
        if not np.isfinite(columns).all() or not np.isfinite(present).all():
            break
        try:
            step = np.linalg.solve(columns.T, present)
        except np.linalg.LinAlgError:
            break
        if np.abs(present).max() < CLOSED:
            return values - step  # bending is soft: what is left of the balance may be a millionth of the angle
        for share in (0.5**power for power in range(12)):
            of, stresses, tangents, trial = state(values - share * step)
            if np.isfinite(trial).all() and np.linalg.norm(trial) < np.linalg.norm(present) * 10:
                break
        values, present = values - share * step, trial
    raise ArithmeticError(f"no equilibrium of ring and sector; out of balance by {np.abs(present).max():.2g}")


def principal_stresses(tissue: Tissue, stretches: Array, dimensions: Array | None = None) -> tuple[Array, Array]:
    """Principal Cauchy stresses (..., 3) along stretches (..., 3), axes of the cells, and d sigma_i/d ln lambda_j."""
    h, one = STRETCH_DIFFERENCE, np.eye(3)
    pairs = one[[0, 0, 1]] + one[[1, 2, 2]]
    ways = np.concatenate([np.zeros((1, 3)), one, -one, 2 * one, -2 * one, pairs, -pairs])
    moved = stretches * np.exp(h * ways.reshape(-1, *(1,) * (stretches.ndim - 1), 3))
    length = tissue.end_to_end_length / np.sqrt(3.0) if dimensions is None else dimensions
    cell = UnitCell(np.broadcast_to(length, moved.shape), np.broadcast_to(one, (*moved.shape, 3)))
    still, *changed = np.asarray(tissue.strain_energy(moved[..., None] * one, [cell]))
    ahead, behind, two_ahead, two_behind, both, neither = np.reshape(changed, (6, 3, *still.shape))
    volume, sums = np.prod(stretches, axis=-1), ahead + behind
    stresses = np.moveaxis(8 * (ahead - behind) - (two_ahead - two_behind), 0, -1) / (12 * h) / volume[..., None]
    mixed = (both + neither - sums[[0, 0, 1]] - sums[[1, 2, 2]] + 2 * still) / (2 * h**2)
    tangents = np.empty((*stretches.shape, 3))
    tangents[..., range(3), range(3)] = np.moveaxis(16 * sums - two_ahead - two_behind - 30 * still, 0, -1) / (
        12 * h**2
    )
    tangents[..., [0, 0, 1], [1, 2, 2]] = tangents[..., [1, 2, 2], [0, 0, 1]] = np.moveaxis(mixed, 0, -1)
    return stresses, tangents / volume[..., None, None] - stresses[..., None]


# ---------------------------------------------------------------- what a tube without loads does when it is cut
# It is cut along its length, and opens to a sector. The mesh's ring of radii R becomes a sector of radii rho(R), in
# cylindrical axes
#     F = diag(k rho/R, e, drho/dR),    F_e = F G,
# without pressure, axial force and bending moment; its opening angle is 360 (1 - k). The cells stay.


class Cut(NamedTuple):
    """A ring that has been cut."""

    opening_angle: float
    radii: tuple[float, float]
    axial: float


def cut(layers: Sequence[Layer], closed: Closing | None, radius: Array, squared_dimensions: Array) -> Cut:
    """Cut an unloaded tube: squared dimensions of its cells, and m, rho and J_g of turnover, at radii."""
    edges = [np.linspace(*layer.radii, PARTS_OF_A_LAYER + 1)[1:] for layer in layers]
    layers = [layer for layer in layers for _ in range(PARTS_OF_A_LAYER)]
    panels = Panels([layers[0].radii[0], *np.concatenate(edges)], CUT_DEGREE)
    squared = np.empty((*panels.places.shape, squared_dimensions.shape[1]))
    panel = panels.of(radius)
    for number, at in enumerate(panels.places):  # what lies in a layer says nothing of the next
        here = panel // PARTS_OF_A_LAYER == number // PARTS_OF_A_LAYER
        rows = radius[here], squared_dimensions[here]
        squared[number] = np.stack([np.interp(at, rows[0], column) for column in rows[1].T], axis=-1)
    squared, turned = squared[..., :3], np.moveaxis(squared[..., 3:], -1, 0)
    natural, start = np.ones_like(squared), (panels.places, 1.0, 1.0)
    if closed is not None:
        fine = closed._replace(layers=tuple(layers), panels=panels, radius=closed.natural_radius(panels.places))
        natural = fine.at_panels()
        start = (fine.radius, 1 / closed.axial, 1 / closed.circumferential)  # what opens, were the cells as they were
    tissues = []
    for number, layer in enumerate(layers):
        changes: dict[str, Any] = dict(zip(TURNED_OVER, turned[:, number], strict=False))  # none without turnover
        if len(turned) > len(TURNED_OVER):  # what has grown across is longer there, and as much as before in all
            growth = turned[-1, number]
            natural[number, :, 2] /= growth
            changes |= {key: getattr(layer.tissue, key) / growth for key in MODULI}
        tissues.append(replace(layer.tissue, **changes))

    def opened(values: Array) -> tuple[Array, Array]:
        rho = values[..., :-2].reshape(*values.shape[:-1], *panels.places.shape)
        return rho, panels.derivative(rho)

    def stretches(values: Array) -> Array:
        (rho, slope), axial, k = opened(values), values[..., -2:-1, None], values[..., -1:, None]
        return np.stack(np.broadcast_arrays(k * rho / panels.places, axial, slope), axis=-1) * natural

    def residual(values: Array, stresses: Array) -> Array:  # and axial force and bending moment, as stresses
        rho, slope = opened(values)
        through = _through(panels, values[..., :-2], stresses, rho, slope=slope)
        area = (panels.edges[-1] - panels.edges[0]) / 2 * (rho[..., 0, 0] + rho[..., -1, -1])
        means = [panels.integral(stresses[..., n] * rho * slope) / area for n in (1, 0)]
        return np.concatenate([through, np.stack(means, axis=-1)], axis=-1)

    dimensions = [*np.sqrt(np.maximum(squared, 0.0))]
    found = solved(tissues, dimensions, stretches, residual, np.append(start[0], start[1:]))
    return Cut(360.0 * (1.0 - float(found[-1])), (float(found[0]), float(found[-3])), float(found[-2]))


def means_through(radius: Array, values: Array, weights: Array, number: int) -> tuple[Array, Array]:
    """Radius and values (n, 3) at points, averaged in as many layers of one thickness as hold a point, by weight."""
    edges = np.linspace(radius.min(), radius.max() * (1 + 1e-12), number + 1)
    layer = np.clip(np.searchsorted(edges, radius, side="right") - 1, 0, number - 1)
    total = np.bincount(layer, weights, number)
    some = total > 0
    means = [np.bincount(layer, weights * column, number)[some] / total[some] for column in (radius, *values.T)]
    return means[0], np.stack(means[1:], axis=-1)
