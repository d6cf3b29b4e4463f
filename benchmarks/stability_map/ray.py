"""Families of tubes on a ray: walls thin and thick, limit points, loose tolerances, equilibrium at once, columns."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import numpy as np
from scipy.optimize import root

from benchmarks.stability_map import bodies
from benchmarks.stability_map.bodies import MU
from benchmarks.stability_map.cases import (
    Case,
    Check,
    Finding,
    Place,
    Run,
    Values,
    farthest,
    named,
    table,
    with_values,
)
from benchmarks.stability_map.homogeneous import VARIANT
from tests.reference.march import Wall, initial, load_at, march
from tests.reference.radial import AXIAL, Array, Tube, first_piola_kirchhoff

RAY: dict[str, Any] = with_values(
    bodies.TUBE,
    {
        "geometry.length": 8.0,
        "model.kinematics": "radial",
        "loads": {},
        "time": {"end": 8.0, "step": 1.0},
    },
)
CURVE = f"{bodies.REFERENCE}, its inner radius prescribed"
UNLOADED = {"material.chain_density": 0.0, "remodeling.law": "none"}
AT_ALL_POINTS = {"mesh.formulation": "displacement"}


def ray_case(
    family: str,
    changes: Values,
    place: Place,
    check: Check,
    reference: str = bodies.REFERENCE,
    **more: Any,
) -> Case:
    """A tube on a ray; a load is [value, end of its ramp] or a table."""
    changes = dict(changes)
    for name in ("pressure", "elongation"):
        if name in changes:
            value, end = changes.pop(name)
            changes[f"loads.{name}"] = {"value": value, "ramp": [[0.0, 0.0], [end, 1.0]]}
    if changes.get("remodeling.law") == "tensor":
        changes |= VARIANT
    scene = with_values(RAY, changes)
    # a tube held at its length is one of elongation 0
    if scene.get("supports", {}).get("ends") != "closed" and "elongation" not in scene["loads"]:
        scene["loads"]["elongation"] = {"value": 0.0, "ramp": [[0.0, 0.0], [1.0, 1.0]]}
    return Case(family, named(family, place), scene, check, reference, place, **more)


# ---------------------------------------------------------------- held against the march
marched_case = partial(ray_case, check=bodies.check_wall)

# walls of a fiftieth to a fifth of the radius, with and without remodeling, stiff in bulk and not. 0.5 of mu times the
# thickness is beyond the limit of a tube without chains
table(
    "thin wall", marched_case,
    {
        "wall": (0.02, 0.05, 0.1, 0.2), "pressure over mu wall": (0.1, 0.3), "law": ("none", "explicit", "tensor"),
        "lambda/mu": (8.8, 1e4),
    },
    lambda p: {"pressure": (p["pressure over mu wall"] * MU * p["wall"], 4.0), "geometry.outer_radius": 1 + p["wall"]},
    reduced=lambda p: (p["wall"], p["pressure over mu wall"], p["law"]) == (0.05, 0.3, "none"),
)  # fmt: skip

# R_o/R_i up to 30, with chains that remodel: elements that span much of the radius
table(
    "thick tube", marched_case,
    {
        "outer radius": (5.0, 10.0, 30.0), "law": ("none", "tensor"), "driver": ("cauchy", "pk2"),
        "pressure": (1.0, 3.0), "degree": (1, 2), "refinement": (1, 2, 4),
    },
    lambda p: {"pressure": (p["pressure"], 8.0), "time.end": 16.0},
    only=lambda p: (p["law"], p["driver"]) != ("none", "pk2")
    and (p["degree"], p["refinement"]) in ((1, 1), (1, 4), (2, 2)),
    reduced=lambda p: (p["outer radius"], p["law"], p["driver"], p["pressure"]) == (10.0, "tensor", "cauchy", 3.0)
    and p["refinement"] < 4,
    more={"options": {"displacement": 0.035}},
)  # fmt: skip


# ---------------------------------------------------------------- locking below what is called stiff
# soft enough not to be called incompressible, walls up to ten radii thick: 3.5 % of the inner displacement
table(
    "moderate lambda/mu", partial(ray_case, check=bodies.check_inner_displacement),
    {
        "outer radius": (1.5, 3.0, 10.0), "degree": (1, 2), "refinement": (1, 2),
        "lambda/mu": (8.8, 20.0, 49.0, 100.0),
    },
    lambda p: {**UNLOADED, **AT_ALL_POINTS, "time.end": 4.0, "pressure": (2.0 if p["outer radius"] > 2 else 0.8, 4.0)},
    only=lambda p: (p["degree"], p["refinement"]) != (2, 2),
    reduced=lambda p: (p["outer radius"], p["refinement"], p["lambda/mu"]) == (3.0, 1, 49.0),
    more={"options": {"tolerance": 0.035}},
)  # fmt: skip


# tissue that hardly changes its volume and remodels: what drives the cells must be as right as the radii
table(
    "nearly incompressible", marched_case,
    {
        "outer radius": (1.3, 3.0), "law": ("explicit", "tensor"), "lambda/mu": (50.0, 300.0, 1e3, 1e4),
        "degree": (1, 2), "formulation": ("auto", "displacement"),
    },
    lambda p: {
        "pressure": (1.2 if p["outer radius"] < 2 else 4.8, 20.0), "elongation": (0.1, 20.0),
        "mesh.formulation": p["formulation"], "time": {"end": 40.0, "step": 1.0},
    },
    reduced=lambda p: (p["outer radius"], p["law"], p["degree"]) == (3.0, "tensor", 2) and p["lambda/mu"] == 1e3,
    more={"options": {"radii": 5e-3, "angles": dict.fromkeys(("inner", "middle", "outer"), 1.0), "elements": 160}},
)  # fmt: skip


# residuals up to a thousandth of the forces: no more error than they make themselves
table(
    "loose tolerance", marched_case,
    {
        "tolerance": (1e-10, 1e-8, 1e-6, 1e-5, 1e-4, 1e-3), "law": ("explicit", "tensor"),
        "driver": ("cauchy", "pk2"), "pressure": (0.5, 4.8),
    },
    lambda p: {
        "pressure": (p["pressure"], 25.0), "elongation": (0.1, 25.0), "solver.relative_tolerance": p["tolerance"],
        "time": {"end": 80.0, "step": 1.0}, "mesh.degree": 2,
    },
    reduced=lambda p: (p["law"], p["driver"], p["pressure"]) == ("tensor", "cauchy", 4.8)
    and p["tolerance"] in (1e-6, 1e-3),
    more={"options": {"radii": 2e-3}},
)  # fmt: skip


# ---------------------------------------------------------------- equilibrium at once
MEAN_TOLERANCE = 0.03  # of the volume mean of A along the axis, over r0^2


@lru_cache
def growing_steps(ramped: float) -> tuple[float, ...]:
    """Ends of steps of 1/4 while loads change and fronts move, then longer ones, until nothing moves: kappa t = 25.

    A staggered pass lags a step behind, and a front between two states rests where the lag has left it. With steps of 1
    that of the carotid (elongation 0.3, pressure 8) came to rest at R = 4.168, with 1/4, 1/8, 1/16 at 4.19, 4.20, 4.20.
    """
    found, step = [], 0.25
    while not found or found[-1] < 1000.0:
        found.append((found[-1] if found else 0.0) + step)
        step = min(1.05 * step, 8.0) if found[-1] > ramped + 40 else 0.25
    return tuple(found)


PROMISED_ANGLE = (
    0.5  # degrees: by what a run to the equilibrium and one in time may differ without a word
)


def check_equilibrium(case: Case, run: Run) -> Finding:
    """Radii, angles at both faces and the mean of A along the axis, as a march in small steps leaves them."""
    scene, rows = case.scene, run.column("time")
    ramped = max(load["ramp"][-1][0] for load in scene["loads"].values())
    wall = Wall(scene, 24)
    expected = march(scene, wall, growing_steps(float(ramped)), "staggered")
    if expected.ended:
        return Finding(np.nan, f"the reference ends at {expected.ended}")
    if not len(rows) or run.code != 0:
        return Finding(0.0, "no row")
    off = {
        name: abs(run.column(name)[-1] / radii[-1] - 1) / bodies.RADIUS_TOLERANCE
        for name, radii in zip(bodies.FACES, expected.faces(), strict=True)
    }
    turned = {
        f"fibre_angle_{place}": abs(
            run.column(f"fibre_angle_{place}")[-1]
            - expected.mean_angle(wall.tube, *bodies.layer(case, place), -1)
        )
        for place in ("inner", "outer")
    }
    off |= {name: degrees / bodies.OUTER_ANGLE_TOLERANCE for name, degrees in turned.items()}
    mean = np.average(expected.squares[-1][:, 1], weights=wall.tube.areas)
    along = run.structure_tensor()[
        :, 2, 2
    ]  # of the elements of a ray, from the inner face outwards
    volumes = np.diff(
        np.linspace(wall.tube.inner_radius, wall.tube.outer_radius, len(along) + 1) ** 2
    )
    off["mean of A along the axis"] = (
        abs(np.average(along, weights=volumes) - mean) / MEAN_TOLERANCE
    )
    jumps = [name for name, degrees in turned.items() if degrees > PROMISED_ANGLE]
    return farthest(
        off,
        confirmed=tuple(
            f"{name} is a mean over elements in which the angle jumps" for name in jumps
        ),
    )


FALLS = {
    "held": [[0.0, 0.0], [25.0, 1.0]],
    "falls": [[0.0, 0.0], [25.0, 1.0], [50.0, 0.3]],
    "reversed": [[0.0, 0.0], [25.0, 1.0], [50.0, -0.3]],
}


# large elongations, loads that fall and reverse: the state that remodeling comes to depends on the way there
rest_case = partial(ray_case, check=check_equilibrium, reference=f"{bodies.REFERENCE}, marched")
AT_REST = {"time": {"end": "equilibrium"}, "mesh.degree": 2}
table(
    "equilibrium", rest_case,
    {
        "history": FALLS, "elongation": (0.0, 0.1, 0.2, 0.3), "pressure": (1.0, 3.0), "law": ("explicit", "tensor"),
    },
    lambda p: {
        **AT_REST, "loads.pressure": {"value": p["pressure"], "ramp": FALLS[p["history"]]},
        "elongation": (p["elongation"], 25.0),
    },
    reduced=lambda p: (p["elongation"], p["pressure"], p["law"]) == (0.2, 3.0, "tensor"),
)  # fmt: skip
# a carotid artery, in mm and kPa
CAROTID = {
    "geometry.inner_radius": 3.2, "geometry.outer_radius": 4.3, "geometry.length": 20.0,
    "material.lame_lambda": 600.0, "material.lame_mu": 3.0, "material.chain_density": 2e22, "mesh.refinement": 2,
}  # fmt: skip
table(
    "equilibrium", rest_case,
    {
        "body": ("carotid",), "elongation": (0.0, 0.1, 0.2, 0.3), "pressure": (8.0, 13.332),
        "law": ("explicit", "tensor"),
    },
    lambda p: {
        **CAROTID, **AT_REST, "pressure": (p["pressure"], 25.0), "elongation": (p["elongation"], 25.0),
    },
)  # fmt: skip


# ---------------------------------------------------------------- limit points
WIDER = 0.02  # of the inner radius, from one state of the curve to the next
WIDEST = 5.0


def pressure_curve(scene: Values, elements: int = 6) -> tuple[Array, Array]:
    """Inner radii and pressures of a tube that does not remodel, its inner radius raised step by step.

    Where the pressure falls again it has had its largest value: a limit point, however it was loaded. The curve ends
    there. With closed ends the axial stretch is found with the radii, from the thrust p pi r_i^2 on the ends.
    """
    tube = Wall(scene, elements).tube
    residual = _of_given_inner_radius(
        tube, initial(scene) ** 2, scene.get("supports", {}).get("ends") == "closed"
    )
    unknown, found = np.concatenate([[0.0, 1.0], tube.nodes[1:]]), [(tube.inner_radius, 0.0)]
    for inner in tube.inner_radius * np.arange(1 + WIDER, WIDEST, WIDER):
        unknown[2:] = np.sqrt(
            unknown[2:] ** 2 + inner**2 - found[-1][0] ** 2
        )  # a start that keeps areas
        solved = root(residual, unknown, (inner,), tol=1e-12)
        if (
            not np.abs(residual(solved.x, inner)).max() < 1e-9
        ):  # NaN too: chains as long as they can be
            break
        unknown = solved.x
        found.append((inner, float(unknown[0])))
        if found[-1][1] < found[-2][1]:
            break
    radii, pressures = np.array(found).T
    return radii, pressures


def _of_given_inner_radius(
    tube: Tube, squares: Array, closed: bool
) -> Callable[[Array, float], Array]:
    """Residual of pressure, axial stretch and the other radii."""
    cells = np.tile(squares, (len(tube.points), 1))

    def residual(unknown: Array, inner: float) -> Array:
        radii = np.concatenate([[inner], unknown[2:]])
        pressure, axial = unknown[0], unknown[1]
        forces = tube.residual(radii, cells, pressure, axial)
        stress = first_piola_kirchhoff(tube.stretches(radii, axial), cells, tube.material)
        thrust = float(stress[:, AXIAL] @ tube.areas) - pressure * inner**2 / 2
        return np.concatenate([forces, [thrust if closed else axial - 1]])

    return residual


def check_limit(case: Case, run: Run) -> Finding:
    """Inner radii up to the largest pressure; beyond it there is nothing to go on to."""
    radii, pressures = pressure_curve(case.scene)
    most, wanted = float(pressures.max()), run.column("pressure")
    found, peak = run.column("inner_radius"), int(np.argmax(pressures))
    below = wanted < 0.99 * most
    expected = np.interp(wanted[below], pressures[: peak + 1], radii[: peak + 1])
    off = float(np.max(np.abs(found[below] / expected - 1), initial=0.0))
    asked = load_at(case.scene, "pressure", 1e9)
    if asked < most:
        return Finding(
            off / bodies.RADIUS_TOLERANCE, f"inner radius off by {100 * off:.3g} %", False
        )
    words = f"largest pressure {most:.4g}, asked {asked:.4g}; inner radius off by {100 * off:.3g} % below it"
    return Finding(
        np.inf if run.code == 0 else off / bodies.RADIUS_TOLERANCE, words, solvable=False
    )


WEAK_HOOPS: dict[str, tuple[Any, dict[float, float]]] = {
    # cells, and their largest pressures by thickness of the wall; the check computes them
    "0.4, 0.2, 0.89": ([0.4, 0.2, 0.8944271909999159], {0.05: 0.154, 0.1: 0.302, 0.5: 1.29}),
    "0.1, 0.1, 0.99": ([0.1, 0.1, 0.98994949366116658], {0.05: 0.159, 0.1: 0.311, 0.5: 1.33}),
    "0.2, 0.6, 0.77": ([0.2, 0.6, 0.7745966692414834], {0.05: 0.140, 0.1: 0.274, 0.5: 1.17}),
}


# closed tubes with few chains around, below and beyond their largest pressure, in one step and in twenty
table(
    "limit point", partial(ray_case, check=check_limit, reference=CURVE),
    {
        "cells": WEAK_HOOPS, "wall": (0.05, 0.1, 0.5), "pressure over largest": (0.9, 1.2, 1.6), "steps": (1, 5, 20),
    },
    lambda p: {
        "cells.initial": WEAK_HOOPS[p["cells"]][0], "geometry.outer_radius": 1 + p["wall"], "supports.ends": "closed",
        "pressure": (round(p["pressure over largest"] * WEAK_HOOPS[p["cells"]][1][p["wall"]], 4), 1.0),
        "remodeling.law": "none", "time": {"end": 1.0, "step": 1.0 / p["steps"]}, "solver.relative_tolerance": 1e-9,
    },
    reduced=lambda p: (p["cells"], p["wall"]) == ("0.4, 0.2, 0.89", 0.1) and p["steps"] < 20,
)  # fmt: skip


# ---------------------------------------------------------------- columns
def check_thrust(case: Case, run: Run) -> Finding:
    """Whether a pressurised tube of held length can stay straight: its thrust against Euler's load."""
    if not len(run.column("time")):
        return Finding(0.0, "no row")
    tube, pressure = Wall(case.scene).tube, float(run.column("pressure")[-1])
    m, inner, outer = case.scene["material"], tube.inner_radius, tube.outer_radius
    poisson = m["lame_lambda"] / 2 / (m["lame_lambda"] + m["lame_mu"])
    displacement = (
        pressure * inner**2 / (outer**2 - inner**2) / (2 * m["lame_mu"])
    )  # Lame, plane strain
    expected = inner + displacement * ((1 - 2 * poisson) * inner + outer**2 / inner)
    error = abs((run.column("inner_radius")[-1] - inner) / (expected - inner) - 1)
    return Finding(
        error / 0.2,
        f"inner displacement off by {100 * error:.3g} % of the linear one",
        case.options["unstable"],
    )


# a tube pushes against ends that hold its length: thrust (1 - 2 nu) p pi r_i^2 over Euler's load
INNER, OUTER, PRESSURE = 1.0, 1.5, 0.1


def length_of_column(ratio: float, share: float) -> float:
    """At which the thrust is this share of Euler's load."""
    lame = ratio * MU
    modulus, poisson = MU * (3 * lame + 2 * MU) / (lame + MU), lame / 2 / (lame + MU)
    thrust = (1 - 2 * poisson) * PRESSURE * np.pi * INNER**2
    bending = np.pi**2 * modulus * np.pi / 4 * (OUTER**4 - INNER**4)
    return float(np.round(np.sqrt(share * bending / thrust), 3))


table(
    "pressurised column", partial(ray_case, check=check_thrust, reference="Lame's tube and Euler's load"),
    {"lambda/mu": (1.0, 3.0), "thrust over Euler's load": (0.05, 0.2, 8.0, 30.0)},
    lambda p: {
        **UNLOADED, "model.kinematics": "auto", "geometry.outer_radius": OUTER, "output.fields": False,
        "geometry.length": length_of_column(p["lambda/mu"], p["thrust over Euler's load"]),
        "pressure": (PRESSURE, 2.0), "time": {"end": 2.0, "step": 1.0},
    },
    reduced=lambda p: (p["lambda/mu"], p["thrust over Euler's load"]) == (3.0, 8.0),
    more=lambda p: {
        "options": {"unstable": p["thrust over Euler's load"] > 1}, "counts": {"tube": {"PAPER": [8, 1, 24]}},
    },
)  # fmt: skip
