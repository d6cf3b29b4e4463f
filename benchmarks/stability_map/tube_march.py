"""A tube in one dimension through any history of loads, and how far a pressure can be raised: references of `ray`.

It takes forces and tangents of tests/reference/radial.py, which shares no code with the package.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.optimize import root

from benchmarks.stability_map.march import Wall, initial, march, tube_of
from tests.reference.radial import AXIAL, CIRCUMFERENTIAL, Array, Tube, first_piola_kirchhoff


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


def march_of(scene: dict[str, Any], times: Sequence[float], elements: int = 40) -> March:
    """Staggered as the paper does it, through the scene's loads at these times, held at the prescribed elongation."""
    wall = Wall(scene, elements)
    rows, ended = march(scene, wall, times, "staggered")
    inner, outer = ([float(row.unknown[end]) for row in rows] for end in (0, -1))
    return March(wall.tube, [row.time for row in rows], inner, outer, [row.squares for row in rows], ended)


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
