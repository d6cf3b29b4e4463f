"""A remodeling tube in one dimension: the reference for the finite element runs of the artery.

Shares no code with the package. The tube stays axisymmetric and its sections stay plane and are stretched by a given
amount (generalised plane strain), so the only unknown is the deformed radius r(R), and the deformation gradient is
diagonal in the directions circumferential, axial, radial:

    lambda_t = r/R,   lambda_z = given,   lambda_r = dr/dR.

The cells start equal in all directions, so their axes stay along these three directions for ever and a remodeling pass
only decides which direction has which rank. The stresses are typed from eq. (7) of the paper with erratum 5 (1/J also
on mu b), the weak form is

    int (P_r dv/dR + P_t v/R) R dR = p lambda_z r(R_i) v(R_i),

quadratic elements, three Gauss points, tangents by complex steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_banded

Array = npt.NDArray[Any]

CIRCUMFERENTIAL, AXIAL, RADIAL = 0, 1, 2

# Gauss points and weights on (0, 1), and the quadratic shape functions of the nodes 0, 1/2, 1 and their slopes there
POINTS = 0.5 + 0.5 * np.array([-np.sqrt(0.6), 0.0, np.sqrt(0.6)])
WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0
SHAPES = np.stack(
    [(1 - POINTS) * (1 - 2 * POINTS), 4 * POINTS * (1 - POINTS), POINTS * (2 * POINTS - 1)], axis=1
)
SLOPES = np.stack([4 * POINTS - 3, 4 - 8 * POINTS, 4 * POINTS - 1], axis=1)


@dataclass(frozen=True)
class RadialMaterial:
    """Parameters of the paper's artery, of layers (points, 1); stresses in Pa, lengths of the chain in link lengths."""

    lame_lambda: Any = 27.293
    lame_mu: Any = 3.103
    network_modulus: Any = 1.381e-23 * 310.0 * 2.0e21 / (4 * 1.365)
    contour_length: Any = 1.594
    end_to_end_length: Any = 1.0


@dataclass(frozen=True)
class RadialHistory:
    """What `solve_radial` returns. Directions (last axis of length 3): circumferential, axial, radial.

    Attributes
    ----------
    times, pressures, inner_radii, outer_radii : (steps,)
        One entry per solved step, the first at t = step.
    nodes : (2 elements + 1,)
        Reference radii R of the nodes.
    radii : (steps, nodes)
        Deformed radii r(R).
    points, areas : (points,)
        Reference radii of the Gauss points, and their weights R dR w (their sum is (R_o^2 - R_i^2)/2).
    stretches, cauchy : (steps, points, 3)
        Principal stretches and stresses of the solved states.
    dimensions : (steps + 1, points, 3)
        Cell dimensions by direction: [k] are those with which step k was solved (row k of a run's history), [k + 1]
        those after its remodeling pass; [-1] is the end.
    """

    times: Array
    pressures: Array
    inner_radii: Array
    outer_radii: Array
    nodes: Array
    radii: Array
    points: Array
    areas: Array
    stretches: Array
    cauchy: Array
    dimensions: Array

    def fibre_angle(self, row: int = -1) -> Array:
        """Return atan(l_z / l_t) at the Gauss points, degrees from circumferential to axial; row as in `dimensions`."""
        chain = self.dimensions[row]
        return np.degrees(np.arctan2(chain[:, AXIAL], chain[:, CIRCUMFERENTIAL]))

    def mean_fibre_angle(self, inside: float, outside: float, row: int = -1) -> float:
        """Return the volume mean of the fibre angle over the Gauss points with inside < R < outside."""
        layer = (self.points > inside) & (self.points < outside)
        return float(np.average(self.fibre_angle(row)[layer], weights=self.areas[layer]))


def secant_stiffness(r: Array, contour_length: float) -> Array:
    """Return the bracket of eqs. (7b) and (7c)."""
    return 1 / contour_length + 1 / (4 * r * (1 - r / contour_length) ** 2) - 1 / (4 * r)


def cauchy_stress(stretches: Array, squares: Array, material: RadialMaterial) -> Array:
    """Return the principal Cauchy stresses of eq. (7), erratum 5 mended.

    stretches: (n, 3), real or complex; squares: (n, 3), l_d^2 by direction.
    """
    m = material
    jacobian = (stretches[:, 0] * stretches[:, 1] * stretches[:, 2])[:, None]
    r = np.sqrt(np.sum(squares * stretches**2, axis=1))[:, None]
    matrix = (m.lame_lambda * np.log(jacobian) - m.lame_mu + m.lame_mu * stretches**2) / jacobian
    chains = (
        m.network_modulus
        / jacobian
        * secant_stiffness(r, m.contour_length)
        * squares
        * stretches**2
    )
    # n(x)n / I_I is the unit dyad along the direction: the stretch cancels
    repulsion = (
        -m.network_modulus
        / jacobian
        * secant_stiffness(np.array(m.end_to_end_length), m.contour_length)
        * squares
    )
    return matrix + chains + repulsion


def first_piola_kirchhoff(stretches: Array, squares: Array, material: RadialMaterial) -> Array:
    """Return P_d = J sigma_d / lambda_d, (n, 3)."""
    jacobian = (stretches[:, 0] * stretches[:, 1] * stretches[:, 2])[:, None]
    return jacobian * cauchy_stress(stretches, squares, material) / stretches


@dataclass
class Tube:
    """The discrete tube: quadratic elements of equal length in R."""

    inner_radius: float
    outer_radius: float
    elements: int
    material: RadialMaterial

    def __post_init__(self) -> None:
        n = self.elements
        self.nodes: Array = np.linspace(self.inner_radius, self.outer_radius, 2 * n + 1)
        self.connectivity = 2 * np.arange(n)[:, None] + np.arange(3)
        self.length = (self.outer_radius - self.inner_radius) / n
        self.points: Array = (self.nodes[:-1:2, None] + self.length * POINTS).ravel()
        self.areas: Array = np.tile(WEIGHTS * self.length, n) * self.points

    def stretches(self, radii: Array, axial: float) -> Array:
        """Return (points, 3) principal stretches of nodal radii r."""
        local = radii[self.connectivity]
        circumferential = (local @ SHAPES.T).ravel() / self.points
        radial = (local @ SLOPES.T).ravel() / self.length
        return np.stack([circumferential, np.full_like(radial, axial), radial], axis=1)

    def admissible(self, stretches: Array, squares: Array) -> bool:
        """Whether every point has J > 0 and r < L."""
        chain = np.sqrt(np.sum(squares * stretches**2, axis=1))
        return bool(
            np.all(stretches > 0) and np.all(chain < np.ravel(self.material.contour_length))
        )

    def residual(self, radii: Array, squares: Array, pressure: float, axial: float) -> Array:
        """Return internal minus external forces at the nodes, per radian and unit length of the axis."""
        stress = first_piola_kirchhoff(self.stretches(radii, axial), squares, self.material)
        along, across = (stress * self.areas[:, None])[:, [RADIAL, CIRCUMFERENTIAL]].T
        local = (
            along.reshape(-1, 3) @ SLOPES / self.length
            + (across / self.points).reshape(-1, 3) @ SHAPES
        )
        forces = np.zeros(len(self.nodes))
        np.add.at(forces, self.connectivity, local)
        forces[0] -= pressure * axial * radii[0]
        return forces

    def tangent(self, radii: Array, squares: Array, pressure: float, axial: float) -> Array:
        """Return the derivative of the residual in LAPACK's banded storage (2 above, 2 below)."""
        stretches = self.stretches(radii, axial)
        tiny = 1e-30
        moduli = np.zeros((len(self.points), 2, 2))
        directions = [RADIAL, CIRCUMFERENTIAL]
        for column, direction in enumerate(directions):
            shifted = stretches.astype(complex)
            shifted[:, direction] += 1j * tiny
            moduli[:, :, column] = (
                first_piola_kirchhoff(shifted, squares, self.material).imag[:, directions] / tiny
            )
        moduli *= self.areas[:, None, None]
        gradients = np.zeros(
            (self.elements, 3, 2, 3)
        )  # element, point, (radial, circumferential), node
        gradients[:, :, 0] = SLOPES / self.length
        gradients[:, :, 1] = SHAPES / self.points.reshape(-1, 3, 1)
        at_points = moduli.reshape(self.elements, 3, 2, 2)
        local = np.sum(np.swapaxes(gradients, 2, 3) @ at_points @ gradients, axis=1)
        banded = np.zeros((5, len(self.nodes)))
        for a in range(3):
            for b in range(3):
                np.add.at(banded[2 + a - b], self.connectivity[:, b], local[:, a, b])
        banded[2, 0] -= pressure * axial
        return banded

    def newton(self, radii: Array, squares: Array, pressure: float, axial: float) -> Array | None:
        """Return the equilibrium radii, or None where Newton finds none from here."""
        if not self.admissible(self.stretches(radii, axial), squares):
            return None
        for _ in range(30):
            residual = self.residual(radii, squares, pressure, axial)
            step = solve_banded((2, 2), self.tangent(radii, squares, pressure, axial), -residual)
            while not self.admissible(self.stretches(radii + step, axial), squares):
                step = step / 2
                if np.max(np.abs(step)) < 1e-12:
                    return None
            radii = radii + step
            if np.max(np.abs(step)) < 1e-11 * self.outer_radius:
                return radii
        return None

    def advance(
        self, radii: Array, old: tuple[Array, float, float], new: tuple[Array, float, float]
    ) -> Array:
        """Return the equilibrium with the new (l^2, pressure, axial stretch), in parts where one solve fails.

        First the cells are exchanged at the old loads, then the loads are raised: both linearly, the energy is linear
        in the squares in W_rep and r^2. The end state is the same as that of one solve.
        """
        found = self.newton(radii, *new)
        if found is not None:
            return found
        for start, end in (old, (new[0], old[1], old[2])), ((new[0], old[1], old[2]), new):
            done, part = 0.0, 0.5
            while done < 1.0:
                share = min(1.0, done + part)
                squares = (1 - share) * start[0] + share * end[0]
                pressure = (1 - share) * start[1] + share * end[1]
                axial = (1 - share) * start[2] + share * end[2]
                found = self.newton(radii, squares, pressure, axial)
                if found is not None:
                    radii, done, part = found, share, 2 * part
                else:
                    part /= 2
                    if part < 1e-6:
                        raise RuntimeError(f"no equilibrium: p = {pressure}, axial stretch {axial}")
        return radii


def driving_values(driver: str, stretches: Array, cauchy: Array) -> Array:
    """Return the driver's eigenvalues by direction, (points, 3)."""
    jacobian = np.prod(stretches, axis=1, keepdims=True)
    return {"cauchy": cauchy, "pk2": jacobian * cauchy / stretches**2, "finger": stretches**2}[
        driver
    ]


def stress_noise(stretches: Array, squares: Array, material: RadialMaterial) -> float:
    """Return the size up to which a stress may be the solver's error: strains are accepted to 1e-11."""
    m = material
    r = np.sqrt(np.sum(squares * stretches**2, axis=1, keepdims=True))
    network = (
        m.network_modulus
        * secant_stiffness(r, m.contour_length)
        * r**2
        / (1 - r / m.contour_length)
    )
    return 1e-11 * float(np.max(m.lame_lambda + 2 * m.lame_mu) + np.max(network))


def sorted_directions(
    values: Array, previous: Array, tolerance: float = 1e-8, noise: float = 0.0
) -> Array:
    """Return the directions by descending value; values that agree keep their previous order."""
    ranks = previous.copy()
    rows = np.arange(len(ranks))
    near = np.maximum(tolerance * np.max(np.abs(values), axis=1), noise)
    for first in (0, 1, 0):
        a, b = ranks[:, first].copy(), ranks[:, first + 1].copy()
        swap = values[rows, b] > values[rows, a] + near
        ranks[:, first], ranks[:, first + 1] = np.where(swap, b, a), np.where(swap, a, b)
    return ranks


def updated(
    law: str, old: Array, start: Array, target: Array, kappa: Any, time: float, step: float
) -> Array:
    """Return the dimensions by rank at `time` (eq. 11, eq. 10 integrated over the step, or the autonomous form)."""
    if law == "explicit":
        return start + (target - start) * (1 - np.exp(-kappa * time))
    if law == "rate":
        return old + (target - start) * (np.exp(-kappa * (time - step)) - np.exp(-kappa * time))
    if law == "relaxation":
        return target + (old - target) * np.exp(-kappa * step)
    if law == "none":
        return old
    raise ValueError(law)


def remodel(
    ranked: Array,
    values: Array,
    ranks: Array,
    start: Array,
    law: str,
    kappa: Any,
    time: float,
    step: float,
    r0: Any,
    noise: float = 0.0,
) -> tuple[Array, Array]:
    """Return the dimensions by rank and the direction of each rank after one remodeling pass."""
    if law == "none":
        return ranked, ranks
    if law == "tensor":
        by_direction = np.empty_like(ranked)
        np.put_along_axis(by_direction, ranks, ranked, axis=1)
        return (
            np.take_along_axis(
                np.sqrt(structure(by_direction**2, values, kappa * step, r0)), ranks, axis=1
            ),
            ranks,
        )
    largest = np.max(np.abs(values), axis=1, keepdims=True)
    positive = np.where(values > np.maximum(1e-14 * largest, noise), values, 0.0)
    norm = np.linalg.norm(positive, axis=1, keepdims=True)
    active = norm > 0
    new_ranks = np.where(active, sorted_directions(values, ranks, noise=noise), ranks)
    direction = np.take_along_axis(positive / np.where(active, norm, 1.0), new_ranks, axis=1)
    new = updated(law, ranked, start, r0 * direction, kappa, time, step)
    return np.where(active, new, ranked), new_ranks


def structure(squares: Array, values: Array, rate: Any, r0: Any) -> Array:
    """Return the squares by direction after a step of dA/dt = kappa s (r0^2 E - A), A diagonal; rate: kappa times step.

    E = (d+)^2 / |d+|^2 with the driver's eigenvalues d, and s = |d+|^2 / (|d+|^2 + |d-|^2 / 100): no ranks.
    """
    tension, compression = np.maximum(values, 0.0) ** 2, np.minimum(values, 0.0) ** 2
    pulled, pushed = (np.sum(part, axis=1, keepdims=True) for part in (tension, compression))
    share = np.divide(pulled, pulled + 0.1**2 * pushed, out=np.zeros_like(pulled), where=pulled > 0)
    towards = np.divide(tension, pulled, out=np.zeros_like(tension), where=pulled > 0)
    return squares + (1 - np.exp(-rate * share)) * (r0**2 * towards - squares)


def solve_radial(
    pressure: float = 4.8,
    stretch: float = 0.1,
    ramp_time: float = 25.0,
    end: float = 150.0,
    step: float = 1.0,
    driver: str = "cauchy",
    law: str = "explicit",
    kappa: Any = 0.025,
    inner_radius: float = 1.0,
    outer_radius: float = 3.0,
    elements: int = 200,
    material: RadialMaterial = RadialMaterial(),
    initial: Array | None = None,
) -> RadialHistory:
    """Remodel the tube; staggered in time as the paper does it.

    Each step to t: set pressure and stretch of t; solve with the cells of t - step; the stress and the time t then give
    the cells of t. A rank keeps its dimension when it changes its direction.

    Parameters
    ----------
    pressure, stretch
        Final inner pressure (Pa, follower) and axial stretch minus one; both rise linearly over `ramp_time`.
    driver : "cauchy" | "pk2" | "finger"
    law : "explicit" (eq. 11) | "rate" (eq. 10) | "relaxation" | "tensor" (of the consistent variant, whose repulsion
        is the paper's where cells and stretches have the same axes, as here) | "none"
    kappa
        A number, or (points, 1).
    elements
        Quadratic elements through the wall.
    initial
        Cell dimensions at t = 0 by direction, (points, 3); default: isotropic cells.

    Raises
    ------
    RuntimeError
        If no equilibrium is found.
    """
    tube = Tube(inner_radius, outer_radius, elements, material)
    count = len(tube.points)
    number_of_steps = round(end / step)
    start = (
        np.full((count, 3), material.end_to_end_length / np.sqrt(3)) if initial is None else initial
    )
    ranked: Array = start.copy()
    ranks: Array = np.tile(np.array([CIRCUMFERENTIAL, AXIAL, RADIAL]), (count, 1))
    radii = tube.nodes.copy()
    state: tuple[Array, float, float] = (start**2, 0.0, 1.0)
    dimensions: list[Array] = [start.copy()]
    solved: list[tuple[Array, Array, Array]] = []
    times = step * np.arange(1, number_of_steps + 1)
    factors = np.minimum(times / ramp_time, 1.0)
    for time, factor in zip(times, factors):
        new_state = (dimensions[-1] ** 2, pressure * factor, 1 + stretch * factor)
        radii = tube.advance(radii, state, new_state)
        state = new_state
        stretches = tube.stretches(radii, state[2])
        stresses = cauchy_stress(stretches, state[0], material)
        ranked, ranks = remodel(
            ranked,
            driving_values(driver, stretches, stresses),
            ranks,
            start,
            law,
            kappa,
            float(time),
            step,
            material.end_to_end_length,
            0.0 if driver == "finger" else stress_noise(stretches, state[0], material),
        )
        by_direction = np.empty_like(ranked)
        np.put_along_axis(by_direction, ranks, ranked, axis=1)
        dimensions.append(by_direction)
        solved.append((radii, stretches, stresses))
    all_radii, all_stretches, all_stresses = (np.array(column) for column in zip(*solved))
    return RadialHistory(
        times,
        pressure * factors,
        all_radii[:, 0],
        all_radii[:, -1],
        tube.nodes,
        all_radii,
        tube.points,
        tube.areas,
        all_stretches,
        all_stresses,
        np.array(dimensions),
    )
