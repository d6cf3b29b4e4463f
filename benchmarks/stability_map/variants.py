"""Families of what a scene may choose beside the paper's method: the consistent variant, formulations, other laws."""

from __future__ import annotations

from functools import partial
from typing import Any

from benchmarks.stability_map import bodies, homogeneous as cube
from benchmarks.stability_map.cases import Case, Place, Values, table, with_values
from benchmarks.stability_map.judging import SAME_MESH

# ---------------------------------------------------------------- law `tensor`, repulsion `log`
SCHEMES = ("staggered", "extrapolated")

table(
    "consistent", cube.cube_case,
    {"driver": cube.DRIVERS, "coupling": SCHEMES, "force": (0.01, 0.1, 1.0, 10.0, 100.0, 1e4, -3.0)},
    {**cube.VARIANT, "time.end": 40.0}, reduced=lambda p: p["driver"] == "cauchy" and p["force"] == 10,
)  # fmt: skip
table(
    "consistent", cube.cube_case,
    {"driver": cube.DRIVERS, "coupling": SCHEMES, "kappa dt": (1e-3, 0.25, 1.0, 10.0, 1e3)},
    {**cube.VARIANT, "time.end": 20.0},
)  # fmt: skip
table(
    "consistent", cube.cube_case, {"driver": cube.DRIVERS, "element": cube.ELEMENTS},
    lambda p: {
        **cube.VARIANT, **cube.element(p), "remodeling.coupling": "extrapolated", "time.end": 20.0, "time.step": 2.0,
    },
)  # fmt: skip

# repeated and crossing principal stresses, loads that turn
table(
    "consistent, three axes", partial(cube.case_of_shape, "block", cube.check_point),
    {"load": cube.TRIAXIAL, "driver": cube.DRIVERS, "coupling": SCHEMES},
    lambda p: {**cube.VARIANT, **cube.triaxial(p)},
    only=lambda p: p["driver"] == "cauchy" or p["coupling"] == "extrapolated",
)  # fmt: skip

# axes that are not coaxial, and a shear that changes its sign
table(
    "consistent, shear", partial(cube.case_of_shape, "driven", cube.check_limit, reference=cube.OF_LIMIT),
    {"shear": (0.3, 1.0), "history": ("held", "reversed"), "driver": cube.DRIVERS, "coupling": SCHEMES},
    lambda p: {
        **cube.VARIANT,
        "loads.h_xz": {"value": p["shear"], "ramp": cube.RAMP if p["history"] == "held" else cube.REVERSED},
        "time.end": 40.0 if p["history"] == "held" else 80.0,
    },
    only=lambda p: p["history"] == "held" or p["shear"] == 0.3,
    reduced=lambda p: (p["driver"], p["shear"], p["history"]) == ("cauchy", 0.3, "held"),
)  # fmt: skip

# random cells from weak loads to locking, and a twisted bar
table(
    "consistent, bodies", bodies.tendon_case,
    {"cells": ("random",), "driver": cube.DRIVERS, "coupling": SCHEMES, "force": (30.0, 300.0, 1000.0)}, cube.VARIANT,
)  # fmt: skip
table(
    "consistent, bodies", bodies.twisted_case, {"driver": cube.DRIVERS, "coupling": SCHEMES, "twist": (0.5, 3.0)},
    cube.VARIANT
)  # fmt: skip

# Figs. 7, 10 and 11 to their end; a row of the reference is a pass behind that of the schemes but `staggered`
table(
    "consistent, tube", bodies.tube_case, {"driver": cube.DRIVERS, "coupling": SCHEMES},
    {**cube.VARIANT, "time.end": 150.0, "time.step": 1.0, "mesh.degree": 1}, more=bodies.LONG,
)  # fmt: skip

# ---------------------------------------------------------------- formulations, the laws left open, runs that stop
# the thick tube towards incompressibility, and the cube, where nothing may change
SELECTIVE = {"mesh.formulation": "selective-integration"}
HEXAHEDRA = [name for name in bodies.MESHES if name.startswith("hex")]
table(
    "selective integration",
    bodies.thick_wall,
    {"mesh": HEXAHEDRA, "lambda/mu": bodies.RATIOS},
    SELECTIVE,
)
table(
    "selective integration", bodies.tube_case, {"chains": ("yes",), "lambda/mu": (0.1, 8.8, 100.0, 1e3, 1e4)},
    {**SELECTIVE, "loads.pressure.value": 2.4, "mesh.degree": 1}, more=bodies.LONG,
)  # fmt: skip
table(
    "selective integration", cube.cube_case,
    {"body": ("cube",), "driver": cube.DRIVERS, "force": (0.01, 10.0, 100.0, -30.0)}, {**SELECTIVE, "time.end": 20.0},
)  # fmt: skip

# Remark 5's rotation and the continuous pairing under loads along three axes; random cells
METHODS = {
    "rotation": {"remodeling.law": "rotation"},
    "continuous": {"remodeling.pairing": "continuous"},
}


def block_and_half_step(family: str, changes: Values, place: Place, **more: Any) -> Case:
    """A block and the same with half of its step."""
    case = partial(
        cube.case_of_shape, "block", bodies.check_half_step, family, reference=SAME_MESH, **more
    )
    scene = case(changes, place).scene
    return case(
        changes, place, companion=with_values(scene, {"time.step": scene["time"]["step"] / 2})
    )


table(
    "other laws", block_and_half_step, {"method": METHODS, "load": cube.TRIAXIAL, "frame": cube.FRAMES},
    lambda p: {**METHODS[p["method"]], **cube.triaxial(p)},
)  # fmt: skip
table(
    "other laws", bodies.tendon_case, {"method": METHODS, "driver": cube.DRIVERS, "frame": cube.FRAMES},
    lambda p: METHODS[p["method"]]
)  # fmt: skip

# exit 3 that names the eigenvalue, and nothing where the equilibrium is stable
STOP = {"solver.unstable": "stop"}
table(
    "stopped where unstable", cube.cube_case, {"body": ("cube",), "force": (10.0, -1.0, -10.0, -30.0, -100.0)},
    {**STOP, "time.end": 12.0},
)  # fmt: skip
table(
    "stopped where unstable", bodies.tube_case, {"body": ("tube",), "pressure": (2.4, -4.8)},
    {**STOP, "loads.elongation.value": 0.0, "mesh.degree": 1},
    more=lambda p: bodies.long(unstable=p["pressure"] < 0),
)  # fmt: skip
table(
    "stopped where unstable", bodies.tendon_case, {"body": ("tendon",), "force": (300.0, -10.0)},
    {**STOP, "cells.initial": "isotropic"},
)  # fmt: skip
