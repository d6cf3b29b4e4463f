"""Families on one point: loads that come late, jumps that the implicit coupling meets, other units of chain lengths."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks.stability_map import consistent
from benchmarks.stability_map.cases import Case, Finding, Run, family
from benchmarks.stability_map.homogeneous import (
    CUBE,
    cube_case,
    initial,
    material,
    nominal_stress,
    step_times,
)
from benchmarks.stability_map.point import Array, advance

POINT: dict[str, Any] = {"model.kinematics": "point"}
TENSOR: dict[str, Any] = {
    **POINT,
    "remodeling.law": "tensor",
    "remodeling.frame": "material",
    "material.repulsion": "log",
}
FINER = 32  # steps of the reference in one of the scene's
TRACE_TOLERANCE = 1e-6  # of tr A over r0^2: fields have seven digits
CLOSED_ANGLE_TOLERANCE, CLOSED_STRETCH_TOLERANCE = 1e-3, 1e-5  # degrees; relative
SECOND_ORDER, FIRST_ORDER = 0.5, 1.0  # times (kappa dt)^2, kappa dt: errors that a step may have
LEAST_ERROR = 5e-3  # of a stretch, and of A over r0^2


# ---------------------------------------------------------------- loads that come late
def check_small_steps(case: Case, run: Run) -> Finding:
    """Stretches of all rows, A and its trace at the end, held against the typed law in small steps."""
    scene, r = case.scene, case.scene["remodeling"]
    coarse, m = step_times(scene), material(scene)
    step = scene["time"]["step"] / FINER
    times = step * np.arange(1, round(coarse[-1] / step) + 1)
    path = consistent.diagonal_path(
        m, nominal_stress(scene, times), times, initial(scene), r["driver"], "staggered", r["kappa"]
    )  # fmt: skip
    rows = run.column("time")
    if path.ended or not len(rows):
        return Finding(np.nan if run.code == 0 else 0.0, path.ended or "no row")
    at = np.round(rows / step).astype(int) - 1
    stretch = np.array(path.stretches)[at, 2]
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
        found["A"] = float(np.abs(A - np.diag(path.squares[-1])).max()) / r0**2 / error
    words, ratio = max(found.items(), key=lambda pair: pair[1])
    return Finding(ratio, f"{words} off by {ratio:.3g} tolerances")


LATE = {
    "ramp at 4": [[4.0, 0.0], [5.0, 1.0]],
    "jump at 10": [[9.0, 0.0], [10.0, 1.0]],
    "off and on": [[0.0, 0.0], [2.0, 1.0], [8.0, 1.0], [9.0, 0.0], [14.0, 0.0], [15.0, 1.0]],
    "pushed first": [[0.0, 0.0], [4.0, -0.1], [8.0, -0.1], [10.0, 1.0]],
}


@family("late load")
def late_loads() -> Iterator[Case]:
    """Tension that is not there from the start, or goes and comes again."""
    for history, ramp in LATE.items():
        loads = {"loads.force.ramp": ramp, "time.end": 24.0}
        for coupling in ("extrapolated", "implicit", "staggered"):
            for driver in ("cauchy", "pk2", "finger"):
                for force, kappa in ((10.0, 0.025), (10.0, 0.25)) if driver == "cauchy" else ((10.0, 0.1),):
                    changes = {**TENSOR, **loads, "remodeling.coupling": coupling, "remodeling.driver": driver}
                    changes |= {"remodeling.kappa": kappa, "loads.force.value": force}
                    place = {"history": history, "coupling": coupling, "driver": driver, "kappa dt": kappa}
                    if coupling == "staggered":
                        check, reference = consistent.check_point, "material point, the same scheme"
                    else:
                        check, reference = check_small_steps, f"material point, 1/{FINER} of the step"
                    reduced = history == "ramp at 4" and driver == "cauchy"
                    yield cube_case("late load", changes, place, check, reference=reference, reduced=reduced)
        for law in ("explicit", "rate", "relaxation"):
            changes = {**POINT, **loads, "remodeling.law": law}
            yield cube_case("late load", changes, {"history": history, "law": law})


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
    squares, m = closed_squares(scene, rows), material(scene)
    forces = nominal_stress(scene, rows)
    stretches, old = [np.ones(3)], (initial(scene)[None] ** 2, np.zeros(3))
    for chain, force in zip(squares, forces, strict=True):
        stretches.append(advance(stretches[-1], old, (chain[None], force), m))
        old = chain[None], force
    angle = np.degrees(np.arctan2(np.sqrt(squares[:, 0] + squares[:, 1]), np.sqrt(squares[:, 2])))
    found = {
        "angle": np.max(np.abs(run.column("mean_fibre_angle") - angle)) / CLOSED_ANGLE_TOLERANCE,
        "stretch": np.max(np.abs(run.column("mean_stretch") / np.array(stretches)[1:, 2] - 1))
        / CLOSED_STRETCH_TOLERANCE,
    }
    words, ratio = max(found.items(), key=lambda pair: pair[1])
    return Finding(float(ratio), f"{words} off by {ratio:.3g} tolerances")


@family("implicit, jump")
def implicit_jumps() -> Iterator[Case]:
    """All of the load at once, from weak to strong, soft to nearly incompressible: no point may keep its cells."""
    for law in ("explicit", "tensor"):
        base = {**(TENSOR if law == "tensor" else POINT), "remodeling.law": law, "remodeling.coupling": "implicit"}
        base |= {"loads.force.ramp": [[0.0, 1.0]], "time.end": 6.0}
        for force in (0.01, 0.05, 0.2, 1.0, 10.0):
            for kappa in (0.025, 0.5):
                changes = {**base, "loads.force.value": force, "remodeling.kappa": kappa}
                place, reduced = {"law": law, "force": force, "kappa dt": kappa}, (force, kappa) == (0.2, 0.5)
                options = {"reference": "closed form", "reduced": reduced}
                yield cube_case("implicit, jump", changes, place, check_closed_form, **options)
        for ratio in (100.0, 1e4, 1e5):
            for force in (0.2, 10.0):
                changes = {**base, "loads.force.value": force, "material.lame_lambda": 3.103 * ratio}
                place = {"law": law, "force": force, "lambda/mu": ratio}
                yield cube_case("implicit, jump", changes, place, check_closed_form, reference="closed form")


# ---------------------------------------------------------------- units
UNITS = (1e-9, 1e-3, 92.4, 1e6)


def in_units(changes: dict[str, Any], unit: float) -> dict[str, Any]:
    """Chain lengths in another unit; c times r0 is what stresses have, so that n_chn stays."""
    own = {**CUBE["material"], **CUBE["cells"]}
    return {
        **changes,
        "material.contour_length": own["contour_length"] * unit,
        "material.persistence_length": own["persistence_length"] * unit,
        "cells.end_to_end_length": own["end_to_end_length"] * unit,
    }


@family("units")
def units() -> Iterator[Case]:
    """L, A_p and r0 in other units: the reference is that of the numbers as they are."""
    for unit in UNITS:
        for law in ("explicit", "rate", "relaxation"):
            for driver in ("cauchy", "pk2"):
                changes = in_units({**POINT, "remodeling.law": law, "remodeling.driver": driver}, unit)
                yield cube_case("units", changes | {"time.end": 20.0}, {"law": law, "driver": driver, "unit": unit})
        for coupling in ("staggered", "extrapolated"):
            changes = in_units({**TENSOR, "remodeling.coupling": coupling, "time.end": 20.0}, unit)
            place = {"law": "tensor", "coupling": coupling, "unit": unit}
            yield cube_case("units", changes, place, consistent.check_point)
        for law in ("explicit", "tensor"):
            base = TENSOR if law == "tensor" else POINT
            changes = {**base, "remodeling.law": law, "remodeling.coupling": "implicit", "time.end": 6.0}
            changes = in_units({**changes, "loads.force.ramp": [[0.0, 1.0]]}, unit)
            place = {"law": law, "coupling": "implicit", "unit": unit}
            yield cube_case("units", changes, place, check_closed_form, reference="closed form")
