"""Families of tubes on a ray: walls thin and thick, limit points, loose tolerances, equilibrium at once, columns."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import numpy as np

from benchmarks.stability_map.bodies import OUTER_ANGLE_TOLERANCE, RADIUS_TOLERANCE, TUBE, check_inner_displacement
from benchmarks.stability_map.cases import Case, Check, Finding, Run, family, with_values
from benchmarks.stability_map.tube_march import March, load_at, march, pressure_curve, tube_of

RAY: dict[str, Any] = with_values(
    TUBE, {"geometry.length": 8.0, "model.kinematics": "radial", "loads": {}, "time": {"end": 8.0, "step": 1.0}}
)
REFERENCE, CURVE = "tube in one dimension", "tube in one dimension, its inner radius prescribed"
CONSISTENT = {"remodeling.law": "tensor", "remodeling.frame": "material", "material.repulsion": "log"}
UNLOADED = {"material.chain_density": 0.0, "remodeling.law": "none"}
ELEMENTS = 8  # through the wall of a scene with refinement 1


def ray_case(family_name: str, check: Check, changes: dict[str, Any], place: dict[str, Any], **more: Any) -> Case:
    """A tube on a ray; a load is [value, end of its ramp] or a table."""
    changes = dict(changes)
    for name in ("pressure", "elongation"):
        if name in changes:
            value, end = changes.pop(name)
            changes[f"loads.{name}"] = {"value": value, "ramp": [[0.0, 0.0], [end, 1.0]]}
    key = f"{family_name}: " + ", ".join(f"{name} {value}" for name, value in place.items())
    scene = with_values(RAY, changes)
    # a tube held at its length is one of elongation 0
    if scene.get("supports", {}).get("ends") != "closed" and "elongation" not in scene["loads"]:
        scene["loads"]["elongation"] = {"value": 0.0, "ramp": [[0.0, 0.0], [1.0, 1.0]]}
    return Case(family_name, key, scene, check, **{"reference": REFERENCE, "place": place, **more})


# ---------------------------------------------------------------- held against the march
def marched(scene: dict[str, Any]) -> March:
    """The reference with the scene's steps, or finer ones where the scene's cells are not a step behind."""
    step, end = scene["time"]["step"], scene["time"]["end"]
    finer = 1 if scene["remodeling"]["coupling"] == "staggered" else 8
    return march(scene, step / finer * np.arange(1, round(end / step) * finer + 1))


def check_march(case: Case, run: Run) -> Finding:
    """Inner and outer radius of all rows; `displacement`: in their place the inner one, within this share."""
    expected, rows = marched(case.scene), run.column("time")
    rows = rows[: np.searchsorted(rows, (expected.times or [0.0])[-1] + 1e-9)]
    if not len(rows):
        return Finding(
            np.inf if run.code == 0 else 0.0, f"no row to compare {expected.ended}", solvable=not expected.ended
        )
    at, share = expected.at(rows), case.options.get("displacement")
    off = {
        name: float(np.max(np.abs(run.column(name)[: len(rows)] / np.array(radii)[at] - 1)))
        for name, radii in (("inner_radius", expected.inner), ("outer_radius", expected.outer))
    }
    words = ", ".join(f"{name} off by {100 * value:.3g} %" for name, value in off.items())
    if expected.ended:
        words += f"; the reference ends at {expected.ended}"
    ratio = max(off.values()) / case.options.get("radii", RADIUS_TOLERANCE)
    if share is not None:
        inner = case.scene["geometry"]["inner_radius"]
        moved = np.array(expected.inner)[at] - inner
        error = float(np.max(np.abs((run.column("inner_radius")[: len(rows)] - inner) / moved - 1)))
        words, ratio = f"{words}; inner displacement off by {100 * error:.3g} %", abs(error) / share
    ratio = np.inf if run.code == 0 and expected.ended else ratio
    return Finding(ratio, words, solvable=not expected.ended)


@family("thin wall")
def thin_walls() -> Iterator[Case]:
    """Walls of a fiftieth to a fifth of the radius, with and without remodeling, stiff in bulk and not."""
    for wall in (0.02, 0.05, 0.1, 0.2):
        for share in (0.1, 0.3):  # of mu times the thickness: 0.5 is beyond the limit of a tube without chains
            for law in ("none", "explicit", "tensor"):
                for ratio in (8.8, 1e4):
                    changes: dict[str, Any] = {
                        **(CONSISTENT if law == "tensor" else {}), "remodeling.law": law,
                        "pressure": (share * 3.103 * wall, 4.0),
                        "geometry.outer_radius": 1 + wall, "material.lame_lambda": ratio * 3.103,
                    }  # fmt: skip
                    place = {"wall": wall, "pressure over mu wall": share, "law": law, "lambda/mu": ratio}
                    reduced = (wall, share, law) == (0.05, 0.3, "none")
                    yield ray_case("thin wall", check_march, changes, place, reduced=reduced)


@family("thick tube")
def thick_tubes() -> Iterator[Case]:
    """R_o/R_i up to 30, with chains that remodel: elements that span much of the radius."""
    for outer in (5.0, 10.0, 30.0):
        for law, driver in (("none", "cauchy"), ("tensor", "cauchy"), ("tensor", "pk2")):
            for pressure in (1.0, 3.0):
                for degree, refinement in ((1, 1), (1, 4), (2, 2)):
                    changes = {
                        **(CONSISTENT if law == "tensor" else {}), "remodeling.law": law, "remodeling.driver": driver,
                        "geometry.outer_radius": outer, "pressure": (pressure, 8.0), "mesh.degree": degree,
                        "mesh.refinement": refinement, "time.end": 16.0,
                    }  # fmt: skip
                    place = {"outer radius": outer, "law": law, "driver": driver, "pressure": pressure}
                    place |= {"degree": degree, "refinement": refinement}
                    reduced = (outer, law, driver, pressure) == (10.0, "tensor", "cauchy", 3.0) and refinement < 4
                    options = {"options": {"displacement": 0.035}, "reduced": reduced}
                    yield ray_case("thick tube", check_march, changes, place, **options)


# ---------------------------------------------------------------- locking below what is called stiff
@family("moderate lambda/mu")
def moderate_ratios() -> Iterator[Case]:
    """Soft enough not to be called incompressible, walls up to ten radii thick: 3.5 % of the inner displacement."""
    for outer in (1.5, 3.0, 10.0):
        for degree, refinement in ((1, 1), (1, 2), (2, 1)):
            for ratio in (8.8, 20.0, 49.0, 100.0):
                changes = {
                    **UNLOADED, "geometry.outer_radius": outer, "time.end": 4.0,
                    "pressure": (2.0 if outer > 2 else 0.8, 4.0), "mesh.degree": degree,
                    "mesh.refinement": refinement, "material.lame_lambda": ratio * 3.103,
                }  # fmt: skip
                place = {"outer radius": outer, "degree": degree, "refinement": refinement, "lambda/mu": ratio}
                reduced = outer == 3.0 and refinement == 1 and ratio == 49.0
                yield ray_case(
                    "moderate lambda/mu",
                    check_inner_displacement,
                    changes,
                    place,
                    options={"tolerance": 0.035},
                    reduced=reduced,
                )


# ---------------------------------------------------------------- tolerances
@family("loose tolerance")
def loose_tolerances() -> Iterator[Case]:
    """Residuals up to a thousandth of the forces: no more error than they make themselves."""
    for tolerance in (1e-10, 1e-8, 1e-6, 1e-5, 1e-4, 1e-3):
        for law in ("explicit", "tensor"):
            for driver in ("cauchy", "pk2"):
                for pressure in (0.5, 4.8):
                    changes = {
                        **(CONSISTENT if law == "tensor" else {}), "remodeling.law": law, "remodeling.driver": driver,
                        "pressure": (pressure, 25.0), "elongation": (0.1, 25.0), "solver.relative_tolerance": tolerance,
                        "time": {"end": 80.0, "step": 1.0}, "mesh.degree": 2,
                    }  # fmt: skip
                    place = {"tolerance": tolerance, "law": law, "driver": driver, "pressure": pressure}
                    reduced = (law, driver, pressure) == ("tensor", "cauchy", 4.8) and tolerance in (1e-6, 1e-3)
                    yield ray_case(
                        "loose tolerance", check_march, changes, place, options={"radii": 2e-3}, reduced=reduced
                    )


# ---------------------------------------------------------------- equilibrium at once
MEAN_TOLERANCE = 0.03  # of the volume mean of A along the axis, over r0^2


@lru_cache
def growing_steps(ramped: float) -> tuple[float, ...]:
    """Ends of steps of 1 while loads change, then longer ones, until nothing moves: kappa t = 25."""
    found, step = [], 1.0
    while not found or found[-1] < 1000.0:
        found.append((found[-1] if found else 0.0) + step)
        step = min(1.05 * step, 8.0) if found[-1] > ramped + 40 else 1.0
    return tuple(found)


def check_equilibrium(case: Case, run: Run) -> Finding:
    """Radii, angles at both faces and the mean of A along the axis, as a march in small steps leaves them."""
    scene, rows = case.scene, run.column("time")
    ramped = max(load["ramp"][-1][0] for load in scene["loads"].values())
    expected = march(scene, growing_steps(float(ramped)), 24)
    if expected.ended:
        return Finding(np.nan, f"the reference ends at {expected.ended}")
    if not len(rows) or run.code != 0:
        return Finding(0.0, "no row")
    tube = expected.tube
    off = {
        "inner radius": abs(run.column("inner_radius")[-1] / expected.inner[-1] - 1) / RADIUS_TOLERANCE,
        "outer radius": abs(run.column("outer_radius")[-1] / expected.outer[-1] - 1) / RADIUS_TOLERANCE,
    }
    layer = (tube.outer_radius - tube.inner_radius) / (ELEMENTS * scene["mesh"]["refinement"])
    for name, ends in {
        "inner": (tube.inner_radius, tube.inner_radius + layer), "outer": (tube.outer_radius - layer, tube.outer_radius)
    }.items():  # fmt: skip
        angle = expected.mean_angle(*ends, -1)
        off[f"{name} angle"] = abs(run.column(f"fibre_angle_{name}")[-1] - angle) / OUTER_ANGLE_TOLERANCE
    mean = float(np.average(expected.squares[-1][:, 1], weights=tube.areas))
    A, F = run.structure_tensor()[:, 2, 2], _volumes(scene, len(run.structure_tensor()))
    off["mean of A along the axis"] = abs(float(np.average(A, weights=F)) - mean) / MEAN_TOLERANCE
    words, ratio = max(off.items(), key=lambda pair: pair[1])
    return Finding(ratio, f"{words} off by {ratio:.3g} tolerances")


def _volumes(scene: dict[str, Any], count: int) -> np.ndarray:
    """Of the elements of a ray, from the inner face outwards."""
    edges = np.linspace(scene["geometry"]["inner_radius"], scene["geometry"]["outer_radius"], count + 1)
    return np.diff(edges**2)


FALLS = {
    "held": [[0.0, 0.0], [25.0, 1.0]],
    "falls": [[0.0, 0.0], [25.0, 1.0], [50.0, 0.3]],
    "reversed": [[0.0, 0.0], [25.0, 1.0], [50.0, -0.3]],
}


@family("equilibrium")
def equilibria() -> Iterator[Case]:
    """Large elongations, loads that fall and reverse: the state that remodeling comes to depends on the way there."""
    for history, ramp in FALLS.items():
        for elongation in (0.0, 0.1, 0.2, 0.3):
            for pressure in (1.0, 3.0):
                for law in ("explicit", "tensor"):
                    changes = {
                        **(CONSISTENT if law == "tensor" else {}), "remodeling.law": law,
                        "loads.pressure": {"value": pressure, "ramp": ramp},
                        "loads.elongation": {"value": elongation, "ramp": [[0.0, 0.0], [25.0, 1.0]]},
                        "time": {"end": "equilibrium"}, "mesh.degree": 2,
                    }  # fmt: skip
                    place = {"history": history, "elongation": elongation, "pressure": pressure, "law": law}
                    reduced = (elongation, pressure, law) == (0.2, 3.0, "tensor")
                    options = {"reference": f"{REFERENCE}, marched", "reduced": reduced}
                    yield ray_case("equilibrium", check_equilibrium, changes, place, **options)
    for elongation in (0.0, 0.1, 0.2, 0.3):  # a carotid artery, in mm and kPa
        for pressure in (8.0, 13.332):
            for law in ("explicit", "tensor"):
                changes = {
                    **(CONSISTENT if law == "tensor" else {}), "remodeling.law": law, "geometry.inner_radius": 3.2,
                    "geometry.outer_radius": 4.3, "geometry.length": 20.0, "material.lame_lambda": 600.0,
                    "material.lame_mu": 3.0, "material.chain_density": 2e22, "pressure": (pressure, 25.0),
                    "elongation": (elongation, 25.0), "time": {"end": "equilibrium"}, "mesh.degree": 2,
                    "mesh.refinement": 2,
                }  # fmt: skip
                place = {"body": "carotid", "elongation": elongation, "pressure": pressure, "law": law}
                options = {"reference": f"{REFERENCE}, marched"}
                yield ray_case("equilibrium", check_equilibrium, changes, place, **options)


# ---------------------------------------------------------------- limit points
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
        return Finding(off / RADIUS_TOLERANCE, f"inner radius off by {100 * off:.3g} %", False)
    words = f"largest pressure {most:.4g}, asked {asked:.4g}; inner radius off by {100 * off:.3g} % below it"
    return Finding(np.inf if run.code == 0 else off / RADIUS_TOLERANCE, words, solvable=False)


WEAK_HOOPS: dict[str, tuple[Any, dict[float, float]]] = {
    # cells, and their largest pressures by thickness of the wall; the check computes them
    "0.4, 0.2, 0.89": ([0.4, 0.2, 0.8944271909999159], {0.05: 0.154, 0.1: 0.302, 0.5: 1.29}),
    "0.1, 0.1, 0.99": ([0.1, 0.1, 0.98994949366116658], {0.05: 0.159, 0.1: 0.311, 0.5: 1.33}),
    "0.2, 0.6, 0.77": ([0.2, 0.6, 0.7745966692414834], {0.05: 0.140, 0.1: 0.274, 0.5: 1.17}),
}


@family("limit point")
def limit_points() -> Iterator[Case]:
    """Closed tubes with few chains around, below and beyond their largest pressure, in one step and in twenty."""
    for cells, (pattern, largest) in WEAK_HOOPS.items():
        for wall, pressure in largest.items():
            for share in (0.9, 1.2, 1.6):
                for steps in (1, 5, 20):
                    changes = {
                        "cells.initial": pattern, "geometry.outer_radius": 1 + wall, "supports.ends": "closed",
                        "remodeling.law": "none", "pressure": (round(share * pressure, 4), 1.0),
                        "time": {"end": 1.0, "step": 1.0 / steps}, "solver.relative_tolerance": 1e-9,
                    }  # fmt: skip
                    place = {"cells": cells, "wall": wall, "pressure over largest": share, "steps": steps}
                    reduced = (cells, wall) == ("0.4, 0.2, 0.89", 0.1) and steps < 20
                    yield ray_case("limit point", check_limit, changes, place, reference=CURVE, reduced=reduced)


# ---------------------------------------------------------------- columns
def check_thrust(case: Case, run: Run) -> Finding:
    """Whether a pressurised tube of held length can stay straight: its thrust against Euler's load."""
    if not len(run.column("time")):
        return Finding(0.0, "no row")
    tube, pressure = tube_of(case.scene), float(run.column("pressure")[-1])
    m, inner, outer = case.scene["material"], tube.inner_radius, tube.outer_radius
    poisson = m["lame_lambda"] / 2 / (m["lame_lambda"] + m["lame_mu"])
    displacement = pressure * inner**2 / (outer**2 - inner**2) / (2 * m["lame_mu"])  # Lame, plane strain
    expected = inner + displacement * ((1 - 2 * poisson) * inner + outer**2 / inner)
    error = abs((run.column("inner_radius")[-1] - inner) / (expected - inner) - 1)
    return Finding(
        error / 0.2, f"inner displacement off by {100 * error:.3g} % of the linear one", case.options["unstable"]
    )


@family("pressurised column")
def columns() -> Iterator[Case]:
    """The tube pushes against ends that hold its length: thrust (1 - 2 nu) p pi r_i^2 over Euler's load."""
    inner, outer, pressure, mu = 1.0, 1.5, 0.1, 3.103
    for ratio in (1.0, 3.0):
        lame = ratio * mu
        modulus, poisson = mu * (3 * lame + 2 * mu) / (lame + mu), lame / 2 / (lame + mu)
        thrust = (1 - 2 * poisson) * pressure * np.pi * inner**2
        bending = np.pi**2 * modulus * np.pi / 4 * (outer**4 - inner**4)
        for share in (0.05, 0.2, 8.0, 30.0):
            length = float(np.round(np.sqrt(share * bending / thrust), 3))
            changes = {
                **UNLOADED, "model.kinematics": "auto", "material.lame_lambda": lame, "geometry.outer_radius": outer,
                "geometry.length": length, "pressure": (pressure, 2.0), "time": {"end": 2.0, "step": 1.0},
                "output.fields": False,
            }  # fmt: skip
            place = {"lambda/mu": ratio, "thrust over Euler's load": share}
            options = {"options": {"unstable": share > 1}, "counts": {"tube": {"PAPER": [8, 1, 24]}}}
            reference, reduced = "Lame's tube and Euler's load", (ratio, share) == (3.0, 8.0)
            yield ray_case(
                "pressurised column", check_thrust, changes, place, reference=reference, reduced=reduced, **options
            )
