"""Families on one point: loads that come late, jumps that the implicit coupling meets, other units of chain lengths."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from benchmarks.stability_map.cases import Case, Finding, Place, Run, Values, farthest, table
from benchmarks.stability_map.homogeneous import CUBE, VARIANT, cube_case
from tests.reference.march import Bar, initial, march, nominal_stress, step_times
from tests.reference.radial import Array

POINT: dict[str, Any] = {"model.kinematics": "point"}
TENSOR: dict[str, Any] = POINT | VARIANT
FINER = 32  # steps of the reference in one of the scene's
TRACE_TOLERANCE = 1e-6  # of tr A over r0^2: fields have seven digits
CLOSED_ANGLE_TOLERANCE, CLOSED_STRETCH_TOLERANCE = 1e-3, 1e-5  # degrees; relative
SECOND_ORDER, FIRST_ORDER = 0.5, 1.0  # times (kappa dt)^2, kappa dt: errors that a step may have
LEAST_ERROR = 5e-3  # of a stretch, and of A over r0^2


# ---------------------------------------------------------------- loads that come late
def check_small_steps(case: Case, run: Run) -> Finding:
    """Stretches of all rows, A and its trace at the end, held against the typed law in small steps."""
    scene, r = case.scene, case.scene["remodeling"]
    coarse, step = step_times(scene), scene["time"]["step"] / FINER
    path = march(scene, Bar(scene), step * np.arange(1, round(coarse[-1] / step) + 1), "staggered")
    rows = run.column("time")
    if path.ended or not len(rows):
        return Finding(np.nan if run.code == 0 else 0.0, path.ended or "no row")
    at = np.round(rows / step).astype(int) - 1
    stretch = np.array(path.unknowns)[at, 2]
    rate = r["kappa"] * scene["time"]["step"]
    forces = nominal_stress(scene, coarse)[:, 2]
    # C drives from the first strain on: its direction jumps where the load comes. And where a force passes through zero
    # inside a step, the rest of this step is all that has tension (docs/theory.md)
    within = bool((forces[:-1] * forces[1:] < 0).any())
    first = r["coupling"] == "implicit" or r["driver"] == "finger" or within
    error = max(LEAST_ERROR, FIRST_ORDER * rate if first else SECOND_ORDER * rate**2)
    found = {"stretch": float(np.max(np.abs(run.column("mean_stretch") / stretch - 1))) / error}
    if run.code == 0:
        r0, A = scene["cells"]["end_to_end_length"], run.structure_tensor()
        found["trace of A"] = float(np.abs(np.trace(A, axis1=1, axis2=2) / r0**2 - 1).max()) / TRACE_TOLERANCE
        found["A"] = float(np.abs(A - np.diag(path.squares[-1][0])).max()) / r0**2 / error
    return farthest(found)


LATE = {
    "ramp at 4": [[4.0, 0.0], [5.0, 1.0]],
    "jump at 10": [[9.0, 0.0], [10.0, 1.0]],
    "off and on": [[0.0, 0.0], [2.0, 1.0], [8.0, 1.0], [9.0, 0.0], [14.0, 0.0], [15.0, 1.0]],
    "pushed first": [[0.0, 0.0], [4.0, -0.1], [8.0, -0.1], [10.0, 1.0]],
}


def late_case(family: str, changes: Values, place: Place, **more: Any) -> Case:
    """The scheme itself where that is staggered, else small steps of the law."""
    if place["coupling"] == "staggered":
        return cube_case(family, changes, place, **more)
    small = f"material point, 1/{FINER} of the step"
    return cube_case(family, changes, place, check=check_small_steps, reference=small, **more)


def late(p: Place) -> Values:
    """Tension that is not there from the start, or goes and comes again."""
    return {"loads.force.ramp": LATE[p["history"]], "time.end": 24.0}


table(
    "late load", late_case,
    {
        "history": LATE, "coupling": ("extrapolated", "implicit", "staggered"), "driver": ("cauchy", "pk2", "finger"),
        "kappa dt": (0.025, 0.1, 0.25),
    },
    lambda p: {**TENSOR, **late(p), "loads.force.value": 10.0},
    only=lambda p: (p["driver"] == "cauchy") == (p["kappa dt"] != 0.1),
    reduced=lambda p: p["history"] == "ramp at 4" and p["driver"] == "cauchy",
)  # fmt: skip
table(
    "late load", cube_case, {"history": LATE, "law": ("explicit", "rate", "relaxation")},
    lambda p: {**POINT, **late(p)},
)  # fmt: skip


# ---------------------------------------------------------------- the implicit coupling and weak jumps
def closed_squares(scene: dict[str, Any], times: Array) -> Array:
    """l_d^2 at the ends of steps under uniaxial tension along z, from isotropic cells: eq. (11), or dA/dt, solved."""
    r0, done = scene["cells"]["end_to_end_length"], -np.expm1(-scene["remodeling"]["kappa"] * times)[:, None]
    along = np.array([0.0, 0.0, 1.0])
    if scene["remodeling"]["law"] == "tensor":
        return np.asarray(r0**2 * (1 / 3 + (along - 1 / 3) * done))
    return np.asarray(r0**2 * (3**-0.5 + (along - 3**-0.5) * done) ** 2)


def check_closed_form(case: Case, run: Run) -> Finding:
    """Angle and stretch of all rows; the row's cells are those of its own time."""
    scene, rows = case.scene, run.column("time")
    if not len(rows):
        return Finding(0.0, "no row")
    squares, bar = closed_squares(scene, rows), Bar(scene)
    stretches, old = [bar.start], (initial(scene)[None] ** 2, bar.unloaded)
    for chain, force in zip(squares, nominal_stress(scene, rows), strict=True):
        stretches.append(bar.solve(stretches[-1], old, (chain[None], force)))
        old = chain[None], force
    angle = np.degrees(np.arctan2(np.sqrt(squares[:, 0] + squares[:, 1]), np.sqrt(squares[:, 2])))
    off = np.abs(run.column("mean_stretch") / np.array(stretches)[1:, 2] - 1)
    turned = np.abs(run.column("mean_fibre_angle") - angle)
    return farthest({"angle": turned.max() / CLOSED_ANGLE_TOLERANCE, "stretch": off.max() / CLOSED_STRETCH_TOLERANCE})


def jump(p: Place) -> Values:
    """All of the load at once: no point may keep its cells."""
    base = TENSOR if p["law"] == "tensor" else POINT
    return {**base, "remodeling.coupling": "implicit", "loads.force.ramp": [[0.0, 1.0]], "time.end": 6.0}


# from weak to strong, soft to nearly incompressible
closed_case = partial(cube_case, check=check_closed_form, reference="closed form")
table(
    "implicit, jump", closed_case,
    {"law": ("explicit", "tensor"), "force": (0.01, 0.05, 0.2, 1.0, 10.0), "kappa dt": (0.025, 0.5)}, jump,
    reduced=lambda p: (p["force"], p["kappa dt"]) == (0.2, 0.5),
)  # fmt: skip
table(
    "implicit, jump", closed_case,
    {"law": ("explicit", "tensor"), "force": (0.2, 10.0), "lambda/mu": (100.0, 1e4, 1e5)}, jump,
)  # fmt: skip


# ---------------------------------------------------------------- units
UNITS = (1e-9, 1e-3, 92.4, 1e6)


LENGTHS = (("material", "contour_length"), ("material", "persistence_length"), ("cells", "end_to_end_length"))


def in_units(p: Place, changes: Values) -> Values:
    """Chain lengths in another unit; c times r0 is what stresses have, so that n_chn stays."""
    return {**changes, **{f"{part}.{key}": CUBE[part][key] * p["unit"] for part, key in LENGTHS}}


# L, A_p and r0 in other units: the reference is that of the numbers as they are
table(
    "units", cube_case, {"law": ("explicit", "rate", "relaxation"), "driver": ("cauchy", "pk2"), "unit": UNITS},
    lambda p: in_units(p, {**POINT, "time.end": 20.0}),
)  # fmt: skip
table(
    "units", cube_case,
    {"law": ("tensor",), "coupling": ("staggered", "extrapolated"), "unit": UNITS},
    lambda p: in_units(p, {**TENSOR, "time.end": 20.0}),
)  # fmt: skip
table(
    "units", closed_case, {"law": ("explicit", "tensor"), "coupling": ("implicit",), "unit": UNITS},
    lambda p: in_units(p, jump(p)),
)  # fmt: skip
