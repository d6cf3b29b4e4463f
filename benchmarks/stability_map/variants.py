"""Families of what a scene may choose beside the paper's method: formulations, the laws left open, runs that stop."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

from benchmarks.stability_map.bodies import (
    ELASTIC,
    check_half_step,
    check_inner_displacement,
    check_long,
    ring,
    tendon_case,
    tube_case,
)
from benchmarks.stability_map.cases import Case, family, with_values
from benchmarks.stability_map.homogeneous import DRIVERS, FRAMES, TRIAXIAL, case_of_shape, cube_case

MESHES = {
    "hex1 16x8": (1, ring(16, 8), 0.05),
    "hex1 32x16": (1, ring(32, 16), 0.035),
    "hex2 8x4": (2, ring(8, 4), 0.035),
}


@family("selective integration")
def selective_integration() -> Iterator[Case]:
    """The thick tube towards incompressibility, and the cube, where nothing may change."""
    formulation = {"mesh.formulation": "selective-integration"}
    for mesh, (degree, counts, tolerance) in MESHES.items():
        for ratio in (0.1, 1.0, 10.0, 100.0, 1e3, 1e4, 1e5):
            changes = {
                **ELASTIC, **formulation, "loads.pressure": {"value": 2.0, "ramp": [[0.0, 0.0], [4.0, 1.0]]},
                "mesh.degree": degree, "material.lame_lambda": ratio * 3.103, "time.end": 4.0, "time.step": 1.0,
            }  # fmt: skip
            place = {"mesh": mesh, "lambda/mu": ratio}
            options = {"check": check_inner_displacement, "counts": counts, "options": {"tolerance": tolerance}}
            yield tube_case("selective integration", changes, place, **options)
    for ratio in (0.1, 8.8, 100.0, 1e3, 1e4):
        changes = {**formulation, "material.lame_lambda": ratio * 3.103, "loads.pressure.value": 2.4, "mesh.degree": 1}
        place = {"chains": "yes", "lambda/mu": ratio}
        yield tube_case("selective integration", changes, place, counts=ring(16, 8), check=check_long)
    for driver in DRIVERS:
        for load in (0.01, 10.0, 100.0, -30.0):
            changes = {**formulation, "remodeling.driver": driver, "loads.force.value": load, "time.end": 20.0}
            yield cube_case("selective integration", changes, {"body": "cube", "driver": driver, "force": load})


@family("other laws")
def other_laws() -> Iterator[Case]:
    """Remark 5's rotation and the continuous pairing under loads along three axes; random cells."""
    methods: dict[str, dict[str, Any]] = {
        "rotation": {"remodeling.law": "rotation"},
        "continuous": {"remodeling.pairing": "continuous"},
    }
    for name, method in methods.items():
        for load, (forces, end) in TRIAXIAL.items():
            for frame in FRAMES:
                changes = {f"loads.force_{a}": {"value": v, "ramp": ramp} for a, (v, ramp) in forces.items()}
                changes |= {**method, "remodeling.frame": frame, "time.end": end}
                place = {"method": name, "load": load, "frame": frame}
                case = partial(case_of_shape, "block", check_half_step, reference="half of the step")
                made = case("other laws", changes, place)
                halved = with_values(made.scene, {"time.step": made.scene["time"]["step"] / 2})
                yield case("other laws", changes, place, companion=halved)
        for driver in DRIVERS:
            for frame in FRAMES:
                changes = {**method, "remodeling.driver": driver, "remodeling.frame": frame}
                yield tendon_case("other laws", changes, {"method": name, "driver": driver, "frame": frame})


@family("stopped where unstable")
def stopped() -> Iterator[Case]:
    """`solver.unstable = "stop"`: exit 3 that names the eigenvalue, and nothing where the equilibrium is stable."""
    stop = {"solver.unstable": "stop"}
    for load in (10.0, -1.0, -10.0, -30.0, -100.0):
        changes = {**stop, "loads.force.value": load, "time.end": 12.0}
        yield cube_case("stopped where unstable", changes, {"body": "cube", "force": load})
    for pressure in (2.4, -4.8):
        changes = {**stop, "loads.pressure.value": pressure, "loads.elongation.value": 0.0, "mesh.degree": 1}
        options = {"counts": ring(16, 8), "check": check_long, "options": {"unstable": pressure < 0}}
        yield tube_case("stopped where unstable", changes, {"body": "tube", "pressure": pressure}, **options)
    for force in (300.0, -10.0):
        changes = {**stop, "loads.force.value": force, "cells.initial": "isotropic"}
        yield tendon_case("stopped where unstable", changes, {"body": "tendon", "force": force})
