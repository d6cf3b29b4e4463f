"""Families of the consistent variant: law `tensor`, repulsion `log`, staggered and extrapolated."""

from __future__ import annotations

from functools import partial

from benchmarks.stability_map.bodies import LONG, tendon_case, tube_case, twisted_case
from benchmarks.stability_map.cases import table
from benchmarks.stability_map.homogeneous import (
    DRIVERS,
    ELEMENTS,
    RAMP,
    TRIAXIAL,
    VARIANT,
    case_of_shape,
    check_point,
    cube_case,
    element,
    triaxial,
)
from benchmarks.stability_map.prescribed import REFERENCE, REVERSED, check_limit

SCHEMES = ("staggered", "extrapolated")

table(
    "consistent", cube_case,
    {"driver": DRIVERS, "coupling": SCHEMES, "force": (0.01, 0.1, 1.0, 10.0, 100.0, 1e4, -3.0)},
    {**VARIANT, "time.end": 40.0}, reduced=lambda p: p["driver"] == "cauchy" and p["force"] == 10,
)  # fmt: skip
table(
    "consistent", cube_case, {"driver": DRIVERS, "coupling": SCHEMES, "kappa dt": (1e-3, 0.25, 1.0, 10.0, 1e3)},
    {**VARIANT, "time.end": 20.0},
)  # fmt: skip
table(
    "consistent", cube_case, {"driver": DRIVERS, "element": ELEMENTS},
    lambda p: {
        **VARIANT, **element(p), "remodeling.coupling": "extrapolated", "time.end": 20.0, "time.step": 2.0,
    },
)  # fmt: skip

# repeated and crossing principal stresses, loads that turn
table(
    "consistent, three axes", partial(case_of_shape, "block", check_point),
    {"load": TRIAXIAL, "driver": DRIVERS, "coupling": SCHEMES}, lambda p: {**VARIANT, **triaxial(p)},
    only=lambda p: p["driver"] == "cauchy" or p["coupling"] == "extrapolated",
)  # fmt: skip

# axes that are not coaxial, and a shear that changes its sign
table(
    "consistent, shear", partial(case_of_shape, "driven", check_limit, reference=REFERENCE),
    {"shear": (0.3, 1.0), "history": ("held", "reversed"), "driver": DRIVERS, "coupling": SCHEMES},
    lambda p: {
        **VARIANT, "loads.h_xz": {"value": p["shear"], "ramp": RAMP if p["history"] == "held" else REVERSED},
        "time.end": 40.0 if p["history"] == "held" else 80.0,
    },
    only=lambda p: p["history"] == "held" or p["shear"] == 0.3,
    reduced=lambda p: (p["driver"], p["shear"], p["history"]) == ("cauchy", 0.3, "held"),
)  # fmt: skip

# random cells from weak loads to locking, and a twisted bar
table(
    "consistent, bodies", tendon_case,
    {"cells": ("random",), "driver": DRIVERS, "coupling": SCHEMES, "force": (30.0, 300.0, 1000.0)}, VARIANT,
)  # fmt: skip
table(
    "consistent, bodies", twisted_case, {"driver": DRIVERS, "coupling": SCHEMES, "twist": (0.5, 3.0)}, VARIANT
)  # fmt: skip

# Figs. 7, 10 and 11 to their end; a row of the reference is a pass behind that of the schemes but `staggered`
table(
    "consistent, tube", tube_case, {"driver": DRIVERS, "coupling": (*SCHEMES, "implicit")},
    {**VARIANT, "time.end": 150.0, "time.step": 1.0, "mesh.degree": 1}, more=LONG,
)  # fmt: skip
