"""A tube in one dimension through any history of loads, and how far a pressure can be raised: references of `ray`.

It takes forces and tangents of tests/reference/radial.py, which shares no code with the package.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.optimize import root

from benchmarks.stability_map.homogeneous import factor, initial, material
from tests.reference.radial import (
    AXIAL,
    CIRCUMFERENTIAL,
    RADIAL,
    Array,
    Tube,
    cauchy_stress,
    driving_values,
    first_piola_kirchhoff,
    remodel,
    stress_noise,
)


@dataclass
class March:
    """One entry per step: inner and outer radius, squares l_d^2 of the solved state (points, 3)."""

    tube: Tube
    times: list[float] = field(default_factory=list)
    inner: list[float] = field(default_factory=list)
    outer: list[float] = field(default_factory=list)
    squares: list[Array] = field(default_factory=list)
    ended: str = ""

    def at(self, times: Array) -> Array:
        """Numbers of the steps that end at these times."""
        return np.array([int(np.argmin(np.abs(np.array(self.times) - time))) for time in times])

    def mean_angle(self, inside: float, outside: float, row: int) -> float:
        """Volume mean of the fibre angle between two radii, degrees."""
        chain = np.sqrt(self.squares[row])
        angle = np.degrees(np.arctan2(chain[:, AXIAL], chain[:, CIRCUMFERENTIAL]))
        layer = (self.tube.points > inside) & (self.tube.points < outside)
        return float(np.average(angle[layer], weights=self.tube.areas[layer]))


def tube_of(scene: dict[str, Any], elements: int = 40) -> Tube:
    """The scene's wall."""
    geometry = scene["geometry"]
    return Tube(geometry["inner_radius"], geometry["outer_radius"], elements, material(scene))


def load_at(scene: dict[str, Any], name: str, time: float) -> float:
    """A load that may not be there."""
    load = scene["loads"].get(name)
    return 0.0 if load is None else float(load["value"] * factor(load["ramp"], np.array([time]))[0])


def march(scene: dict[str, Any], times: Sequence[float], elements: int = 40) -> March:
    """Staggered as the paper does it, through the scene's loads at these times, held at the prescribed elongation."""
    tube, r = tube_of(scene, elements), scene["remodeling"]
    m, found = tube.material, March(tube)
    start = np.tile(initial(scene), (len(tube.points), 1))
    ranked, ranks = start.copy(), np.tile([CIRCUMFERENTIAL, AXIAL, RADIAL], (len(start), 1))
    radii, squares, before = tube.nodes.copy(), start**2, 0.0
    state: tuple[Array, float, float] = (squares, 0.0, 1.0)
    for time in times:
        new = (squares, load_at(scene, "pressure", time), 1 + load_at(scene, "elongation", time))
        try:
            radii = tube.advance(radii, state, new)
        except (RuntimeError, ValueError, np.linalg.LinAlgError) as error:
            found.ended = f"t = {time:g}: {error}"
            return found
        state = new
        found.times.append(float(time))
        found.inner.append(float(radii[0]))
        found.outer.append(float(radii[-1]))
        found.squares.append(squares)
        stretches = tube.stretches(radii, new[2])
        stress = cauchy_stress(stretches, squares, m)
        noise = 0.0 if r["driver"] == "finger" else stress_noise(stretches, squares, m)
        ranked, ranks = remodel(
            ranked, driving_values(r["driver"], stretches, stress), ranks, start, r["law"], r["kappa"], float(time),
            float(time) - before, m.end_to_end_length, noise,
        )  # fmt: skip
        by_direction = np.empty_like(ranked)
        np.put_along_axis(by_direction, ranks, ranked, axis=1)
        squares, before = by_direction**2, float(time)
    return found


# ---------------------------------------------------------------- how far a pressure can be raised
WIDER = 0.02  # of the inner radius, from one state of the curve to the next
WIDEST = 5.0


def pressure_curve(scene: dict[str, Any], elements: int = 6) -> tuple[Array, Array]:
    """Inner radii and pressures of a tube that does not remodel, its inner radius raised step by step.

    Where the pressure falls again it has had its largest value: a limit point, however it was loaded. The curve ends
    there. With closed ends the axial stretch is found with the radii, from the thrust p pi r_i^2 on the ends.
    """
    tube = tube_of(scene, elements)
    squares = np.tile(initial(scene) ** 2, (len(tube.points), 1))
    closed = scene.get("supports", {}).get("ends") == "closed"

    def residual(unknown: Array, inner: float) -> Array:
        radii = np.concatenate([[inner], unknown[2:]])
        pressure, axial = unknown[0], unknown[1]
        forces = tube.residual(radii, squares, pressure, axial)
        stress = first_piola_kirchhoff(tube.stretches(radii, axial), squares, tube.material)
        thrust = float(stress[:, AXIAL] @ tube.areas) - pressure * inner**2 / 2
        return np.concatenate([forces, [thrust if closed else axial - 1]])

    unknown, found = np.concatenate([[0.0, 1.0], tube.nodes[1:]]), [(tube.inner_radius, 0.0)]
    for inner in tube.inner_radius * np.arange(1 + WIDER, WIDEST, WIDER):
        unknown[2:] = np.sqrt(unknown[2:] ** 2 + inner**2 - found[-1][0] ** 2)  # a start that keeps areas
        solved = root(residual, unknown, (inner,), tol=1e-12)
        if not np.abs(residual(solved.x, inner)).max() < 1e-9:  # NaN too: chains as long as they can be
            break
        unknown = solved.x
        found.append((inner, float(unknown[0])))
        if found[-1][1] < found[-2][1]:
            break
    radii, pressures = np.array(found).T
    return radii, pressures
