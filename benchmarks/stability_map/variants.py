"""Families of what a scene may choose beside the paper's method: formulations, the laws left open, runs that stop."""

from __future__ import annotations

from functools import partial
from typing import Any

from benchmarks.stability_map.bodies import (
    LONG,
    MESHES,
    RATIOS,
    check_half_step,
    long,
    tendon_case,
    thick_wall,
    tube_case,
)
from benchmarks.stability_map.cases import Case, Place, Values, table, with_values
from benchmarks.stability_map.homogeneous import DRIVERS, FRAMES, TRIAXIAL, case_of_shape, cube_case, triaxial
from benchmarks.stability_map.judging import SAME_MESH

# the thick tube towards incompressibility, and the cube, where nothing may change
SELECTIVE = {"mesh.formulation": "selective-integration"}
HEXAHEDRA = [name for name in MESHES if name.startswith("hex")]
table("selective integration", thick_wall, {"mesh": HEXAHEDRA, "lambda/mu": RATIOS}, SELECTIVE)
table(
    "selective integration", tube_case, {"chains": ("yes",), "lambda/mu": (0.1, 8.8, 100.0, 1e3, 1e4)},
    {**SELECTIVE, "loads.pressure.value": 2.4, "mesh.degree": 1}, more=LONG,
)  # fmt: skip
table(
    "selective integration", cube_case,
    {"body": ("cube",), "driver": DRIVERS, "force": (0.01, 10.0, 100.0, -30.0)}, {**SELECTIVE, "time.end": 20.0},
)  # fmt: skip

# Remark 5's rotation and the continuous pairing under loads along three axes; random cells
METHODS = {"rotation": {"remodeling.law": "rotation"}, "continuous": {"remodeling.pairing": "continuous"}}


def block_and_half_step(family: str, changes: Values, place: Place, **more: Any) -> Case:
    """A block and the same with half of its step."""
    case = partial(case_of_shape, "block", check_half_step, family, reference=SAME_MESH, **more)
    scene = case(changes, place).scene
    return case(changes, place, companion=with_values(scene, {"time.step": scene["time"]["step"] / 2}))


table(
    "other laws", block_and_half_step, {"method": METHODS, "load": TRIAXIAL, "frame": FRAMES},
    lambda p: {**METHODS[p["method"]], **triaxial(p)},
)  # fmt: skip
table(
    "other laws", tendon_case, {"method": METHODS, "driver": DRIVERS, "frame": FRAMES}, lambda p: METHODS[p["method"]]
)  # fmt: skip

# exit 3 that names the eigenvalue, and nothing where the equilibrium is stable
STOP = {"solver.unstable": "stop"}
table(
    "stopped where unstable", cube_case, {"body": ("cube",), "force": (10.0, -1.0, -10.0, -30.0, -100.0)},
    {**STOP, "time.end": 12.0},
)  # fmt: skip
table(
    "stopped where unstable", tube_case, {"body": ("tube",), "pressure": (2.4, -4.8)},
    {**STOP, "loads.elongation.value": 0.0, "mesh.degree": 1},
    more=lambda p: long(unstable=p["pressure"] < 0),
)  # fmt: skip
table(
    "stopped where unstable", tendon_case, {"body": ("tendon",), "force": (300.0, -10.0)},
    {**STOP, "cells.initial": "isotropic"},
)  # fmt: skip
