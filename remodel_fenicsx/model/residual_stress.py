"""Residual stress of a round wall: closing from a sector, and opening angle after a cut."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.model.laws import COMPLEX_STEP
from remodel_fenicsx.model.tensors import Array, stretch_tensor
from remodel_fenicsx.schema.tables import SceneError

# Polynomial degree of R(r). The paper's artery at 160 degrees changes by less than 1e-8 from 16 to
# 32.
DEGREE = 24
# Relative truncation error of dR/dr above which a panel is halved; walls of 1 to 7 and thicker have
# larger errors.
TRUNCATION_TOLERANCE = 1e-8
MOST_POLYNOMIALS = 8  # maximum of one layer; walls of 1 to 1.05 ... 12 take 1 or 2
# Largest increment of k, half of what works: walls of 1 to 1.05 ... 3 close at 180 degrees (k = 2)
# in one increment of 1 too.
MAX_CLOSING_INCREMENT = 0.5
# Limit of Newton's method, which takes 5 to 7 for walls of 1 to 1.05 ... 12 at 90 to 270 degrees.
ITERATIONS = 30
CLOSED = 1e-9  # tolerance of the residual over lambda + 2 mu
# Accepted residual over the effect of one rounding error in each value. Some thin layers hardly
# reach 1.
ROUNDINGS = 8.0
TANGENT_DIFFERENCE = 1e-7  # difference of a logarithm; Newton's method needs no better tangent
# Difference of a logarithm, and tolerance over the largest stress: |x| in place of max(x, 0) has an
# error of half of it.
CHECK_DIFFERENCE, CHECKED = 1e-4, 1e-2
UNSTRETCHED = (1.0, 1.0, 1.0)


# ---------------------------------------------------------------- functions of the radius on panels
# Values at Chebyshev points, with derivative and integral. A panel is a layer or a piece of a
# layer. Within a panel a function is smooth; between panels its derivative may jump.


class Panels:
    """Chebyshev points on panels, with derivative, integral and interpolation of values."""

    def __init__(self, edges: Sequence[float], degree: int):
        self.edges, self.degree = np.asarray(edges, dtype=np.float64), degree
        points = np.cos(np.pi * np.arange(degree, -1, -1) / degree)
        self._half = np.diff(self.edges)[:, None] / 2
        self.places: Array = self.edges[:-1, None] + self._half * (points + 1)
        self.places[:, -1] = self.edges[1:]
        self._coefficients = np.linalg.inv(chebyshev.chebvander(points, degree))
        ones = np.eye(degree + 1)
        slopes = np.stack(
            [chebyshev.chebval(points, chebyshev.chebder(unit)) for unit in ones], axis=-1
        )
        self._slope = slopes @ self._coefficients
        areas = np.array(
            [chebyshev.chebval(1.0, chebyshev.chebint(unit, lbnd=-1)) for unit in ones]
        )
        self._weights = areas @ self._coefficients

    def derivative(self, values: Array) -> Array:
        """Return the radial derivative of values (..., panels, points)."""
        return values @ self._slope.T / self._half

    def integral(self, values: Array) -> Array:
        """Return the integral over all panels of values (..., panels, points)."""
        return np.asarray(np.sum(values * self._weights * self._half, axis=(-2, -1)))

    def jumps(self, values: Array) -> Array:
        """Return the jumps of values from one panel to the next, (..., panels - 1)."""
        return values[..., 1:, 0] - values[..., :-1, -1]

    def panel_index(self, radius: Array) -> NDArray[np.intp]:
        """Return the panel number of each radius (...,); outside the wall it is the nearest."""
        return np.clip(
            np.searchsorted(self.edges, radius, side="right") - 1, 0, len(self.edges) - 2
        )

    def truncation_error(self, values: Array) -> Array:
        """Return the relative truncation error of values (panels, points), (panels,)."""
        # Estimated by the last two Chebyshev coefficients over the largest coefficient.
        coefficients: Array = np.abs(values @ self._coefficients.T)
        return coefficients[:, -2:].max(axis=1) / coefficients.max()

    def interpolate(self, radius: Array, values: Array) -> Array:
        """Interpolate values (panels, points) at radii (...,)."""
        panel = self.panel_index(radius)
        coordinate = (radius - self.edges[panel]) / (2 * self._half[panel, 0]) * 2 - 1
        interpolated = np.empty_like(radius, dtype=np.float64)
        for number, row in enumerate(values @ self._coefficients.T):
            interpolated[panel == number] = chebyshev.chebval(coordinate[panel == number], row)
        return interpolated


# ---------------------------------------------------------------- natural configuration of a tube
# A sector, whose layers may be prestretched before they are joined, closes to a ring of known
# radii. In cylindrical axes
#     G = diag(k r/R, g_z, dr/dR) P,    k = 360/(360 - opening angle),
# where R(r) is the radius in the sector of the point at r in the ring, and P the prestretch of the
# layer. R and g_z bring the ring to equilibrium with its loads; the unloaded tube has no pressure
# and no axial force.


class Layer(NamedTuple):
    """Layer of a ring: radii, tissue and prestretch."""

    radii: tuple[float, float]
    tissue: Tissue
    prestretch: Sequence[float] = UNSTRETCHED


class Loads(NamedTuple):
    """Loads on the ring: pressure, and axial force or, if that is None, axial stretch of G."""

    pressure: float = 0.0
    force: float | None = 0.0
    axial: float = 1.0


class ClosedRing(NamedTuple):
    """Sector that closes to a ring: its radii at the panels' points, k and axial stretch g_z."""

    layers: tuple[Layer, ...]
    panels: Panels
    radius: Array
    circumferential: float
    axial: Array | float

    def natural_radius(self, radius: Array) -> Array:
        """Return R at r, both (...,)."""
        return self.panels.interpolate(radius, self.radius)

    def stretches(self, radius: Array) -> Array:
        """Return circumferential, axial and radial stretch of G at r (...,), (..., 3)."""
        slope = self.panels.interpolate(radius, self.panels.derivative(self.radius))
        prestretch = np.array([layer.prestretch for layer in self.layers])[
            self.panels.panel_index(radius)
        ]
        return self._joined(radius, self.natural_radius(radius), slope) * prestretch

    def at_panels(self) -> Array:
        """Return the stretches of G at the panels' points, (panels, points, 3)."""
        prestretch = np.array([layer.prestretch for layer in self.layers])[:, None]
        return (
            self._joined(self.panels.places, self.radius, self.panels.derivative(self.radius))
            * prestretch
        )

    def _joined(self, radius: Array, natural: Array, slope: Array) -> Array:
        """Return the stretches of G without the prestretch."""
        hoop = self.circumferential * radius / natural
        return np.stack(np.broadcast_arrays(hoop, self.axial, 1.0 / slope), axis=-1)


def close_ring(layers: Sequence[Layer], opening_angle: float, loads: Loads = Loads()) -> ClosedRing:
    """Compute the sector that closes to a ring in equilibrium, with isotropic cells."""
    final_k = 360.0 / (360.0 - opening_angle)
    panels = Panels([layers[0].radii[0], *(layer.radii[1] for layer in layers)], DEGREE)
    factors = np.linspace(
        1.0, final_k, 1 + max(1, int(np.ceil((final_k - 1.0) / MAX_CLOSING_INCREMENT)))
    )[1:]
    ring = ClosedRing(tuple(layers), panels, panels.places.copy(), 1.0, loads.axial)
    for k in factors:
        grown = np.mean(ring.radius + (k - 1.0) * panels.places * 0.5) / np.mean(ring.radius)
        ring = _balanced(ring._replace(radius=grown * ring.radius, circumferential=float(k)), loads)
    while (
        rough := ring.panels.truncation_error(ring.panels.derivative(ring.radius))
        > TRUNCATION_TOLERANCE
    ).any():
        pieces = [
            piece
            for layer, is_rough in zip(ring.layers, rough, strict=True)
            for piece in (_halves(layer) if is_rough else [layer])
        ]
        if len(pieces) > MOST_POLYNOMIALS * len(layers):
            raise ArithmeticError(
                f"the stretches vary too steeply through the wall for {len(pieces)} polynomials"
            )
        finer = Panels([pieces[0].radii[0], *(piece.radii[1] for piece in pieces)], DEGREE)
        radius = ring.natural_radius(finer.places)
        ring = _balanced(ring._replace(layers=tuple(pieces), panels=finer, radius=radius), loads)
    return ring


def _halves(layer: Layer) -> list[Layer]:
    """Split a layer at the geometric mean of its radii, because R varies with ln r."""
    low, high = layer.radii
    middle = float(np.sqrt(low * high))
    return [layer._replace(radii=(low, middle)), layer._replace(radii=(middle, high))]


def _balanced(start: ClosedRing, loads: Loads) -> ClosedRing:
    """Return the neighbouring equilibrium with the loads on both faces and along the axis."""
    panels, tissues = start.panels, [layer.tissue for layer in start.layers]
    stiffness, edges = _stiffness(tissues), panels.edges

    def stretches(values: Array) -> Array:
        radius = values[..., :-1].reshape(*values.shape[:-1], *start.radius.shape)
        return start._replace(radius=radius, axial=values[..., -1:, None]).at_panels()

    def residual(values: Array, stresses: Array) -> Array:
        through = _through(panels, values[..., :-1], stresses, loads.pressure / stiffness)
        force = 2 * np.pi * panels.integral(stresses[..., 1] * panels.places)
        if loads.force is None:
            along = values[..., -1] - loads.axial
        else:
            along = (force - loads.force / stiffness) / (np.pi * (edges[-1] ** 2 - edges[0] ** 2))
        return np.concatenate([through, along[..., None]], axis=-1)

    solution = solve_newton(
        tissues, [None] * len(tissues), stretches, residual, np.append(start.radius, start.axial)
    )
    return start._replace(
        radius=solution[:-1].reshape(start.radius.shape), axial=float(solution[-1])
    )


def _stiffness(tissues: Sequence[Tissue]) -> float:
    return max(float(np.max(tissue.lame_lambda + 2 * tissue.lame_mu)) for tissue in tissues)


def _through(panels: Panels, unknown: Array, stresses: Array, pressure: float) -> Array:
    """Return the residuals of radial balance, faces, and continuity between panels."""
    hoop, _, radial = np.moveaxis(stresses, -1, 0)
    balance = panels.derivative(radial) + (radial - hoop) / panels.places
    inside = balance[..., 1:-1] * (panels.edges[-1] - panels.edges[0]) / 2
    faces = np.stack([radial[..., 0, 0] + pressure, radial[..., -1, -1]], axis=-1)
    between = panels.jumps(unknown.reshape(radial.shape)) / panels.edges[0]
    return np.concatenate(
        [inside.reshape(*inside.shape[:-2], -1), faces, panels.jumps(radial), between], axis=-1
    )


@np.errstate(all="ignore")
def solve_newton(
    tissues: Sequence[Tissue],
    dimensions: Sequence[Array | None],
    stretches: Callable[[Array], Array],
    residual: Callable[[Array, Array], Array],
    values: Array,
) -> Array:
    """Find values (n,) with zero residual by Newton's method with step halving."""
    # A step is halved if the energy is not finite after it, or the residual is 10 times as large.
    # `stretches` maps values (..., n) to (..., panels, points, 3). `residual` maps values and
    # stresses over the largest stiffness, real or complex, to (..., n).
    stiffness = _stiffness(tissues)

    def state(trial: Array) -> tuple[Array, Array, Array, Array]:
        stretch = stretches(trial)
        by_layer = [
            principal_stresses(*layer)
            for layer in zip(tissues, [*stretch], dimensions, strict=True)
        ]
        stresses, tangents = (
            np.stack(arrays) / stiffness for arrays in zip(*by_layer, strict=True)
        )
        return stretch, stresses, tangents, residual(trial, stresses)

    stretch, stresses, tangents, present = state(values)
    for _ in range(ITERATIONS):
        # A stress depends only on the stretches at its point. The derivatives of the formulas are
        # exact by a complex step.
        moved = values + 1j * COMPLEX_STEP * np.eye(len(values))
        strains = np.log(stretches(moved) / stretch)
        columns = (
            residual(moved, stresses + (tangents @ strains[..., None])[..., 0]).imag / COMPLEX_STEP
        )
        if not np.isfinite(columns).all() or not np.isfinite(present).all():
            break
        try:
            step = np.linalg.solve(columns.T, present)
        except np.linalg.LinAlgError:
            break
        rounding = ROUNDINGS * np.finfo(np.float64).eps * np.abs(values) @ np.abs(columns)
        if (np.abs(present) < np.maximum(CLOSED, rounding)).all():
            for tissue, layer_stretches, cells in zip(tissues, [*stretch], dimensions, strict=True):
                _check_complex(tissue, layer_stretches, cells)
            # The bending stiffness is small: the accepted residual may be a millionth of the angle,
            # so the step is added.
            return values - step
        for step_length in (0.5**power for power in range(12)):
            stretch, stresses, tangents, trial = state(values - step_length * step)
            if np.isfinite(trial).all() and np.linalg.norm(trial) < np.linalg.norm(present) * 10:
                break
        values, present = values - step_length * step, trial
    raise ArithmeticError(f"no equilibrium of the ring: residual {np.abs(present).max():.2g}")


def principal_stresses(
    tissue: Tissue, stretches: Array, dimensions: Array | None
) -> tuple[Array, Array]:
    """Return principal Cauchy stresses (..., 3) and d sigma_i/d ln lambda_j at stretches."""
    # The stretches (..., 3) are along the axes of the cells.
    units = np.eye(3).reshape(3, *(1,) * (stretches.ndim - 1), 3)
    perturbed = stretches * np.exp(
        TANGENT_DIFFERENCE * np.concatenate([np.zeros_like(units[:1]), units])
    )
    complex_stretches = np.exp(1j * COMPLEX_STEP * units)
    slopes = (
        np.imag(_energy(tissue, perturbed * complex_stretches[:, None], dimensions)) / COMPLEX_STEP
    )
    stresses, *neighbours = np.moveaxis(slopes, 0, -1) / np.prod(perturbed, axis=-1)[..., None]
    return stresses, np.stack(
        [(neighbour - stresses) / TANGENT_DIFFERENCE for neighbour in neighbours], axis=-1
    )


def fresh_stretches(tissue: Tissue) -> Array:
    """Return the principal stretches of G, (3,), that make fresh tissue stress-free.

    With a prestretch of elastin, matrix and isotropic cells balance at these stretches along its
    axes.
    """
    if tissue.elastin_axial is None:
        return np.ones(3)
    logarithms = solve_newton(
        [tissue],
        [None],
        lambda values: np.exp(values)[..., None, None, :],
        lambda values, stresses: stresses[..., 0, 0, :],
        np.zeros(3),
    )
    return np.exp(logarithms)


def _energy(tissue: Tissue, stretches: Array, dimensions: Array | None) -> Array:
    """Return W (...) at stretches (..., 3) along the axes of the cells, those of elastin."""
    length = np.broadcast_to(
        tissue.end_to_end_length / np.sqrt(3.0) if dimensions is None else dimensions,
        stretches.shape,
    )
    axes = tissue.elastin_axes
    cell = UnitCell(length, np.broadcast_to(axes, (*stretches.shape, 3)))
    return np.asarray(tissue.strain_energy(stretch_tensor(stretches, axes), [cell]))


def _check_complex(tissue: Tissue, stretches: Array, dimensions: Array | None) -> None:
    """Reject an energy whose complex-step derivative is wrong, as with |x|."""
    # The direction preserves the volume, because the volumetric stiffness may be large.
    direction = CHECK_DIFFERENCE * np.array([1.0, 2.0, -3.0])
    complex_stretches = stretches * np.exp(1j * COMPLEX_STEP * direction)
    complex_slope = np.imag(_energy(tissue, complex_stretches, dimensions)) / COMPLEX_STEP
    ahead, centre, behind = (
        _energy(tissue, stretches * np.exp(side * direction), dimensions) for side in (1, 0, -1)
    )
    slope, bend = (ahead - behind) / 2, np.abs(ahead + behind - 2 * centre) + 1e-14 * np.abs(centre)
    if not (np.abs(complex_slope - slope) <= CHECKED * np.abs(slope).max() + bend).all():
        rule = "must accept complex numbers for its derivatives: np.maximum(x, 0), not |x|"
        raise SceneError(f"material.matrix, chain or repulsion: {rule}")


# ---------------------------------------------------------------- opening angle after a cut
# A cut along the length opens the unloaded tube to a sector. The mesh's ring of radii R becomes a
# sector of radii rho(R). In cylindrical axes
#     F = diag(k rho/R, e, drho/dR),    F_e = F G,
# with minimal energy, so that pressure, axial force and bending moment vanish. The opening angle is
# 360 (1 - k). The cells do not change. The energy is the sum over the points of the run, with its
# elements through the wall.


class Rings(NamedTuple):
    """Thin rings of an unloaded tube, (n,) or (n, 3) in circumferential, axial, radial order."""

    radius: Array
    volume: Array
    natural: Array
    squared: Array


def cut(tissue: Tissue, rings: Rings, edges: Array, closed: ClosedRing | None = None) -> float:
    """Return the opening angle in degrees of rings after a cut; `edges` are radii of elements."""
    return 360.0 * (1.0 - _released(tissue, rings, edges, closed)[1])


def unloaded_stretch(
    tissue: Tissue, rings: Rings, edges: Array, closed: ClosedRing | None = None
) -> float:
    """Return the axial stretch e of whole rings without loads; arguments as of `cut`."""
    return _released(tissue, rings, edges, closed, opens=False)[0]


def _released(
    tissue: Tissue, rings: Rings, edges: Array, closed: ClosedRing | None, opens: bool = True
) -> tuple[float, float]:
    """Return e and k of rings without loads, which keep k = 1 unless they open."""
    # The volumes are those of the stress-free tissue. `closed` is the sector of the initial state,
    # a starting value.
    from scipy.interpolate import BSpline  # imported here, because few runs need it

    knots = np.concatenate([edges[:1], np.repeat(edges, 2), edges[-1:]])
    spline = BSpline(knots, np.eye(len(knots) - 3), 2)
    # The functions are zero at the lumen.
    functions, slopes = spline(rings.radius)[:, 1:], spline(rings.radius, 1)[:, 1:]
    inner = edges[0]
    depth, steepness = rings.radius - edges[0], np.ones_like(rings.radius)
    axial: Array | float = 1.0
    k = 1.0
    if closed is not None:  # start from the sector of the initial cells
        inner = closed.radius[0, 0]
        axial, k = 1 / closed.axial, 1 / closed.circumferential
        depth = closed.natural_radius(rings.radius) - inner
        steepness = closed.panels.interpolate(rings.radius, closed.panels.derivative(closed.radius))
    fractions = rings.volume / rings.volume.sum()
    thinner = fractions @ (1 / (steepness * rings.natural[:, 2]))  # growth across the wall
    depth, steepness = thinner * depth, thinner * steepness

    # The unknowns are k rho at the lumen, rho minus rho at the lumen, e and k. In them a thin wall
    # with large bending is almost linear, and k may be zero or negative.
    def opened(values: Array) -> tuple[Array, Array, Array, Array]:
        across, slope = (
            depth + values[..., 1:-2] @ functions.T,
            steepness + values[..., 1:-2] @ slopes.T,
        )
        around = values[..., :1] + values[..., -1:] * across
        gradient = np.stack(
            np.broadcast_arrays(around / rings.radius, values[..., -2:-1], slope), axis=-1
        )
        return across, slope, around, gradient * rings.natural

    def residual(values: Array, stresses: Array) -> Array:  # derivatives of the energy
        across, slope, around, stretches = opened(values)
        work = stresses[..., 0, :, :] * (np.prod(stretches, axis=-1) * fractions)[..., None]
        hoop, axial, radial = np.moveaxis(work, -1, 0)
        hoop = edges[-1] * hoop / around
        nodes = (values[..., -1:] * hoop) @ functions + edges[-1] * (radial / slope) @ slopes
        integrals = [
            density.sum(axis=-1, keepdims=True)
            for density in (hoop, axial, hoop * across / np.ptp(edges))
        ]
        if not opens:
            integrals[2] = values[..., -1:] - 1.0
        return np.concatenate([integrals[0], nodes, *integrals[1:]], axis=-1)

    values = np.concatenate([[inner * k], np.zeros(functions.shape[1]), [axial, k / thinner]])
    dimensions = [np.sqrt(np.maximum(rings.squared, 0.0))]
    solution = solve_newton(
        [tissue], dimensions, lambda values: opened(values)[-1][..., None, :, :], residual, values
    )
    return float(solution[-2]), float(solution[-1])


def means_through(
    radius: Array, volumes: Array, values: Array, edges: Array
) -> tuple[Array, Array]:
    """Return volumes (m,) of rings between edges, and volume means of values (n, ...)."""
    # Points are assigned to rings by their cumulated fraction of the volume. Facets of elements lie
    # inside the cylinders by more than a thin ring, so that an assignment by the radius would leave
    # some rings empty.
    order = np.argsort(radius, kind="stable")
    inside = np.cumsum(volumes[order]) - volumes[order] / 2
    bounds = (edges[1:-1] ** 2 - edges[0] ** 2) / (edges[-1] ** 2 - edges[0] ** 2)
    ring = np.unique(np.searchsorted(bounds, inside / volumes.sum()), return_inverse=True)[1]
    columns = (np.ones_like(radius), *values.T)
    sums = [
        np.bincount(ring, volumes[order] * column[order]).astype(np.float64) for column in columns
    ]
    return sums[0], np.stack(sums[1:], axis=-1) / sums[0][:, None]
