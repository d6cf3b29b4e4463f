"""Bodies of one dimension through time, their axes fixed: references of the map and of random scenes.

Typed from docs/time_integration.md on top of tests/reference/radial.py, which shares no code with the package. A cube
or bar is one point, a tube is divided along its radius; cells are three squares l_d^2 by direction.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tests.reference.point import COMPRESSION
from tests.reference.radial import (
    AXIAL,
    CIRCUMFERENTIAL,
    Array,
    RadialMaterial,
    Tube,
    cauchy_stress,
    driving_values,
    first_piola_kirchhoff,
    remodel,
    stress_noise,
)

Scene = dict[str, Any]
BOLTZMANN = 1.381e-23
STRESS_UNITS = {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6}
COUNTS = 0.01  # a target with a smaller share is none to go on from


class NoEquilibrium(RuntimeError):
    """The reference finds none from the state before."""


# ---------------------------------------------------------------- what a scene asks for
def material(scene: Scene) -> RadialMaterial:
    """The reference's parameters, stresses in the scene's unit."""
    m = scene["material"]
    modulus = BOLTZMANN * m["temperature"] * m["chain_density"] / (4 * m["persistence_length"])
    modulus *= m.get("energy_factor", 1) / STRESS_UNITS[m.get("stress_unit", "Pa")]
    length = (
        m["contour_length"] if m["chain_density"] else 1e9
    )  # where there are no chains, none locks
    return RadialMaterial(
        m["lame_lambda"], m["lame_mu"], modulus, length, scene["cells"]["end_to_end_length"]
    )


def factor(ramp: Sequence[Sequence[float]], time: Array) -> Array:
    """Piecewise linear, held at both ends."""
    times, factors = np.array(ramp, dtype=float).T
    return np.interp(time, times, factors)


def load_at(scene: Scene, name: str, time: float) -> float:
    """A load that may not be there."""
    load = scene["loads"].get(name)
    return 0.0 if load is None else float(load["value"] * factor(load["ramp"], np.array([time]))[0])


def step_times(scene: Scene) -> Array:
    """Times of the steps."""
    step, end = scene["time"]["step"], scene["time"]["end"]
    return step * np.arange(1, round(end / step) + 1)


def nominal_stress(scene: Scene, times: Array) -> Array:
    """Dead stresses along x, y, z by step, (steps, 3)."""
    geometry, found = scene["geometry"], np.zeros((len(times), 3))
    side = geometry.get("side", 1.0)
    for name, load in scene["loads"].items():
        axis = "xyz".index(name[-1]) if name != "force" else 2
        area = side**2 if axis == 0 else side * (side / geometry.get("aspect", 1.0))
        found[:, axis] += load["value"] * factor(load["ramp"], times) / geometry.get("area", area)
    return found


def initial(scene: Scene) -> Array:
    """l_I at t = 0."""
    cells = scene["cells"]
    if isinstance(cells["initial"], str):
        along = cells.get("aligned_axis", 3)
        pattern = {"isotropic": np.full(3, 3**-0.5), "aligned": np.eye(3)[along - 1]}[
            cells["initial"]
        ]
        return np.asarray(cells["end_to_end_length"] * pattern)
    return np.array(cells["initial"], dtype=float)


def slowed(scene: Scene) -> bool:
    """Whether the relaxed pass meets a law with a memory: then its own scheme is no reference, the law is."""
    return scene["remodeling"]["coupling"] == "relaxed" and scene["remodeling"]["law"] in (
        "rate",
        "relaxation",
    )


# ---------------------------------------------------------------- bodies
class Bar:
    """A cube or bar: one point under dead forces; its unknown are the stretches."""

    points, start, unloaded = 1, np.ones(3), np.zeros(3)

    def __init__(self, scene: Scene):
        self.scene, self.material = scene, material(scene)

    def loads(self, time: float) -> Array:
        """Nominal stresses (3)."""
        return nominal_stress(self.scene, np.array([time]))[0]

    def solve(self, stretches: Array, old: tuple[Array, Array], new: tuple[Array, Array]) -> Array:
        """Equilibrium with new squares and load, in parts where one Newton solve fails."""
        found = self.equilibrium(stretches, *new)
        if found is not None:
            return found
        middle = (new[0], old[1])
        for start, end in ((old, middle), (middle, new)):
            done, part = 0.0, 0.5
            while done < 1.0:
                at = min(1.0, done + part)
                found = self.equilibrium(
                    stretches, *((1 - at) * a + at * b for a, b in zip(start, end, strict=True))
                )
                if found is not None:
                    stretches, done, part = found, at, 2 * part
                elif (part := part / 2) < 1e-10:
                    raise NoEquilibrium(f"nothing beyond a share {done:.4g} of the step")
        return stretches

    def admissible(self, stretches: Array, squares: Array) -> bool:
        """r < L and every stretch positive."""
        length = np.sqrt(np.sum(squares * stretches**2))
        return bool(np.all(stretches > 0) and length < self.material.contour_length)

    def equilibrium(self, stretches: Array, squares: Array, load: Array) -> Array | None:
        """Newton's method on P_d = load_d with complex steps, kept where r < L; None where it finds nothing."""
        if not self.admissible(stretches, squares):
            return None

        def residual(values: Array) -> Array:
            return first_piola_kirchhoff(values[None], squares, self.material)[0] - load

        smallest = np.inf
        for _ in range(300):
            tangent = np.stack(
                [residual(stretches + 1e-30j * axis).imag / 1e-30 for axis in np.eye(3)], axis=1
            )
            step = -np.linalg.solve(tangent, residual(stretches).real)
            while not self.admissible(stretches + step, squares):
                step = step / 2
                if np.max(np.abs(step)) < 1e-14:
                    return None
            stretches = stretches + step
            size = float(np.max(np.abs(step) / stretches))
            if size < 1e-12 or (size < 1e-9 and size >= smallest):
                return stretches
            smallest = min(size, smallest)
        return None

    def stretches(self, unknown: Array, loads: Any) -> Array:
        """(1, 3)"""
        return unknown[None]


class Wall:
    """A tube with free ends and a given length; its unknown are the radii of the nodes."""

    unloaded = (0.0, 1.0)

    def __init__(self, scene: Scene, elements: int = 40):
        geometry = scene["geometry"]
        self.tube = Tube(
            geometry["inner_radius"], geometry["outer_radius"], elements, material(scene)
        )
        self.scene, self.start, self.points = scene, self.tube.nodes.copy(), len(self.tube.points)

    def loads(self, time: float) -> tuple[float, float]:
        """Pressure and axial stretch."""
        return load_at(self.scene, "pressure", time), 1 + load_at(self.scene, "elongation", time)

    def solve(self, unknown: Array, old: tuple[Array, Any], new: tuple[Array, Any]) -> Array:
        """Equilibrium with other squares and loads."""
        try:
            return self.tube.advance(unknown, (old[0], *old[1]), (new[0], *new[1]))
        except (RuntimeError, ValueError, np.linalg.LinAlgError) as error:
            raise NoEquilibrium(str(error)) from error

    def stretches(self, unknown: Array, loads: tuple[float, float]) -> Array:
        """(points, 3)"""
        return self.tube.stretches(unknown, loads[1])


# ---------------------------------------------------------------- through time
@dataclass
class Path:
    """What a body does: its unknown and the squares (points, 3) of its cells by solved state; why it ends early."""

    times: list[float] = field(default_factory=list)
    unknowns: list[Array] = field(default_factory=list)
    squares: list[Array] = field(default_factory=list)
    ended: str = ""

    def angle(self, direction: int = 2) -> Array:
        """Degrees between a bar's chains and a direction, by step."""
        squares = np.array(self.squares)[:, 0]
        across = squares.sum(axis=1) - squares[:, direction]
        return np.degrees(np.arctan2(np.sqrt(across), np.sqrt(squares[:, direction])))

    def faces(self) -> tuple[Array, Array]:
        """Inner and outer radius of a wall, by step."""
        radii = np.array(self.unknowns)
        return radii[:, 0], radii[:, -1]

    def at(self, times: Array) -> Array:
        """Numbers of the steps that end at these times."""
        return np.array([int(np.argmin(np.abs(np.array(self.times) - time))) for time in times])

    def mean_angle(self, tube: Tube, inside: float, outside: float, row: int) -> float:
        """Volume mean of the fibre angle between two radii of a wall, degrees."""
        chain = np.sqrt(self.squares[row])
        angle = np.degrees(np.arctan2(chain[:, AXIAL], chain[:, CIRCUMFERENTIAL]))
        layer = (tube.points > inside) & (tube.points < outside)
        return float(np.average(angle[layer], weights=tube.areas[layer]))


class Pass:
    """The evolution laws at points with axes that stay: from squares (points, 3) to squares."""

    def __init__(self, scene: Scene, points: int, coupling: str):
        self.r, self.material = scene["remodeling"], material(scene)
        self.r0, self.law = self.material.end_to_end_length, self.r["law"]
        self.start = np.tile(initial(scene), (points, 1))
        self.ranked, self.ranks = self.start.copy(), np.tile([0, 1, 2], (points, 1))
        relaxed = coupling == "relaxed" and not slowed(scene)
        self.share = self.r.get("relaxation_factor", 0.5) if relaxed else 1.0
        self.targets: list[tuple[float, Array]] = (
            []
        )  # time and sE of solved states, the last one first
        self.begun = np.zeros(points, bool)  # points whose last target stands alone

    def values(self, stretches: Array, squares: Array) -> tuple[Array, float]:
        """Of the driver by direction, and what of them is rounding."""
        driver = self.r["driver"]
        noise = 0.0 if driver == "finger" else stress_noise(stretches, squares, self.material)
        return (
            driving_values(driver, stretches, cauchy_stress(stretches, squares, self.material)),
            noise,
        )

    def target(self, stretches: Array, squares: Array) -> Array:
        """sE of the law `tensor`."""
        values, noise = self.values(stretches, squares)
        tension, compression = np.maximum(values, 0) ** 2, np.minimum(values, 0) ** 2
        total = tension.sum(axis=1) + COMPRESSION**2 * compression.sum(axis=1) + (100 * noise) ** 2
        return np.divide(
            tension, total[:, None], out=np.zeros_like(tension), where=total[:, None] > 0
        )

    def followed(self, squares: Array, target: Array, step: float) -> Array:
        """dA/dt = kappa (r0^2 sE - s A) with sE kept."""
        share = np.clip(target.sum(axis=1, keepdims=True), 0.0, 1.0)
        direction = target / np.where(share > 0, target.sum(axis=1, keepdims=True), 1.0)
        done = -np.expm1(-self.r["kappa"] * step * share)
        return np.where(share > 0, squares + (self.r0**2 * direction - squares) * done, squares)

    def after(
        self, stretches: Array, squares: Array, old: Array, time: float, step: float
    ) -> tuple[Array, Any]:
        """Squares that a pass makes of `old` under the stress of a state, and what to keep if it is the last one."""
        if self.law == "tensor":
            asked = self.followed(old, self.target(stretches, squares), step)
            return old + self.share * (asked - old), (self.ranked, self.ranks)
        values, noise = self.values(stretches, squares)
        ranked, ranks = remodel(
            self.ranked,
            values,
            self.ranks,
            self.start,
            self.law,
            self.r["kappa"],
            time,
            step,
            self.r0,
            noise,
        )
        asked = np.empty_like(ranked)
        np.put_along_axis(asked, ranks, ranked, axis=1)
        new = old + self.share * (asked**2 - old)
        if (
            self.share < 1.0
        ):  # rank is the order of A's eigenvalues; where they agree the pass's ranks stay
            by_rank = np.take_along_axis(new, ranks, axis=1)
            order = np.argsort(-np.round(by_rank / self.r0**2, 12), axis=1, kind="stable")
            ranks = np.take_along_axis(ranks, order, axis=1)
            ranked = np.sqrt(np.take_along_axis(new, ranks, axis=1))
        return new, (ranked, ranks)

    def ahead(self, time: float) -> Array:
        """sE in the middle of the step to `time`, along the line through two states."""
        (last, now), *earlier = self.targets
        if not earlier:
            return now
        slope = (time - last) / 2 / (last - earlier[0][0])
        return now + np.where(self.begun[:, None], 0.0, slope * (now - earlier[0][1]))


def march(
    scene: Scene, body: Bar | Wall, times: Iterable[float] | None = None, coupling: str = ""
) -> Path:
    """The way of a body; times and coupling are the scene's where none are given."""
    coupling = coupling or scene["remodeling"]["coupling"]
    cells, path = Pass(scene, body.points, coupling), Path()
    unknown, squares, before = body.start, cells.start**2, 0.0
    solved, loads = (
        squares,
        body.unloaded,
    )  # of the last state: the way to the next one begins there
    for time in map(float, step_times(scene) if times is None else times):
        new: Any = body.loads(time)
        step, start = time - before, squares
        expected = np.zeros_like(squares)
        if coupling == "extrapolated" and cells.targets:
            expected = cells.ahead(time)
            squares = cells.followed(start, expected, step)
            indefinite = np.any(squares < 0, axis=1, keepdims=True)
            if indefinite.any():  # there the last target itself counts
                expected = np.where(indefinite, cells.targets[0][1], expected)
                squares = cells.followed(start, expected, step)
        try:
            unknown = body.solve(unknown, (solved, loads), (squares, new))
            if coupling == "extrapolated":
                found = cells.target(body.stretches(unknown, new), squares)
                had = cells.targets[0][1] if cells.targets else np.zeros_like(found)
                cells.begun = (had.sum(axis=1) < COUNTS) & (found.sum(axis=1) >= COUNTS)
                if cells.begun.any():
                    other = cells.followed(
                        start, np.where(cells.begun[:, None], found, expected), step
                    )
                    unknown, squares = body.solve(unknown, (squares, new), (other, new)), other
                    found = cells.target(body.stretches(unknown, new), squares)
                cells.targets = [(time, found), *cells.targets[:1]]
        except NoEquilibrium as error:
            path.ended = (
                str(error)
                if str(error).startswith("unknown")
                else f"no equilibrium at t = {time:g}: {error}"
            )
            return path
        path.times.append(time)
        path.unknowns.append(unknown)
        path.squares.append(squares)
        solved, loads, before = squares, new, time
        if coupling in ("staggered", "relaxed"):
            stretches = body.stretches(unknown, new)
            squares, (cells.ranked, cells.ranks) = cells.after(
                stretches, squares, squares, time, step
            )
    return path
