"""What of a body buckles, and whether a scene's loads may make it: a strut under thrust."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.model.energy import Tissue

Array = NDArray[np.float64]
NEAR_LOCKING = 0.9  # r/L that chains of the inner face are thought to reach
WALL_POINTS = 100  # through the wall
WIDEST = 3.0  # radius, over the inner one at rest: a thin wall of unit mu bears 99 % there of the most that it ever can


@dataclass(frozen=True)
class Strut:
    """A body along z that thrust may bend, and suction make oval.

    Attributes
    ----------
    length
        In the reference.
    end_factor
        Length of the pin-ended column with the same Euler load over the body's: 1 where the ends cannot turn but one
        of them moves sideways, 1/2 where neither moves, 2 where one is free.
    directions
        (n, 3, 3) at places (n, 3): columns are two directions across z and z; the stress has them as axes.
    squared_distances
        Mean of x^2 over all places of the body that those (n, 3) stand for, (n,).
    radii
        Inner and outer radius of a cavity along z that the load "pressure" fills; None without one.
    capped
        Whether that pressure acts on the ends too.
    """

    length: float
    end_factor: float
    directions: Callable[[Array], Array]
    squared_distances: Callable[[Array], Array]
    radii: tuple[float, float] | None = None
    capped: bool = False

    def euler_load(self, bending_stiffness: float, length: float) -> float:
        """pi^2 EI / (k length)^2."""
        return math.pi**2 * bending_stiffness / (self.end_factor * length) ** 2


def expected_thrust(scene: Any) -> float:
    """Largest thrust on the way over Euler's load, as far as the scene's numbers tell; 0 where nothing pushes.

    The wall is taken as an incompressible neo-Hookean one of the tissue's small-strain modulus, a closed form, with
    Lame's term for a compressible one beside it. Where a force is given, that and the lumen are all there is. Of
    several regions it has the mean over the section. Euler's load is that of the inflated wall.
    """
    shape = scene.geometry
    strut = shape.strut(scene.supports.ends)
    if strut is None or strut.radii is None:
        return 0.0
    inner, outer = strut.radii
    shares, properties = shape.section_shares(scene.regions), scene.properties()
    parts = [(share, _stiffness(properties[name].tissue)) for name, share in shares.items()]
    ratio, modulus = (sum(share * part[k] for share, part in parts) for k in (0, 1))
    longest = min(part[2] for _, part in parts)

    def share(time: float) -> float:
        loads = {name: load.value * load.factor(time) for name, load in scene.loads.items()}
        pressure, stretch = loads.get("pressure", 0.0), 1 + loads.get("elongation", 0.0)
        radius, reduced, bending = inflated(pressure / (modulus / 3), inner, outer, stretch, longest)
        lumen = math.pi * radius**2
        if scene.has_free_length:
            thrust = (0.0 if strut.capped else pressure * lumen) - loads.get("axial_force", 0.0)
        else:
            thrust = (1 - 2 * ratio) * pressure * lumen - modulus / 3 * reduced
        return thrust / strut.euler_load(modulus / 3 * bending, strut.length * stretch)

    corners = {float(time) for load in scene.loads.values() for time, _ in load.ramp}
    return max(0.0, max(map(share, corners), default=0.0))


def _stiffness(tissue: Tissue) -> tuple[float, float, float]:
    """Poisson's ratio of the matrix, Young's modulus of matrix and network, and the stretch near which chains lock."""
    lame, shear, longest = tissue.lame_lambda, tissue.lame_mu, math.inf
    ratio, modulus = lame / (2 * (lame + shear)), shear * (3 * lame + 2 * shear) / (lame + shear)
    if tissue.chain is not None:
        modulus += tissue.repulsion_modulus * tissue.end_to_end_length**2  # isotropic cells pulled along one axis
    if tissue.locking_length is not None:
        longest = NEAR_LOCKING * tissue.locking_length / tissue.end_to_end_length
    return ratio, modulus, longest


def inflated(pressure: float, inner: float, outer: float, stretch: float, longest: float) -> tuple[float, float, float]:
    """Inner radius, reduced axial force and bending stiffness of an incompressible neo-Hookean tube of unit mu.

    p = int (t^2 - 1/(t z)^2) dr/r,  F = pi int (2 z^2 - 1/(t z)^2 - t^2) r dr,  EI = pi int E r^3 dr, t = r/R, z the
    axial stretch, E the modulus along z at constant stress across. Chains of isotropic cells bound t: their mean
    stretch stays below `longest`. What bears no such pressure has the radius at which it bears nearly all that it can.
    """
    R2 = np.linspace(inner**2, outer**2, WALL_POINTS)

    def of(radius: float) -> tuple[float, float, float]:
        r2 = radius**2 + (R2 - inner**2) / stretch
        hoop, radial = r2 / R2, R2 / (r2 * stretch**2)
        areas = np.gradient(r2) / 2  # r dr
        areas[[0, -1]] /= 2
        carried = float(((hoop - radial) / r2 * areas).sum())
        modulus = 2 * stretch**2 + 2 * radial - 2 * radial**2 / (hoop + radial)
        reduced = 2 * stretch**2 - radial - hoop
        force, stiffness = (math.pi * float((part * areas).sum()) for part in (reduced, modulus * r2))
        return carried, force, stiffness

    def extended(hoop: float) -> bool:
        return (hoop**2 + stretch**2 + 1 / (hoop * stretch) ** 2) / 3 > longest**2

    low, high = inner * 1e-3, inner * WIDEST
    for _ in range(60):
        middle = math.sqrt(low * high)
        over = of(middle)[0] > pressure or (middle > inner and extended(middle / inner))
        low, high = (low, middle) if over else (middle, high)
    _, force, stiffness = of(low)
    return low, force, stiffness
