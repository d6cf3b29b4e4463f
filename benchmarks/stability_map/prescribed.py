"""Families under a prescribed deformation of the whole boundary: axes that are not coaxial, bad elements inside."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from benchmarks.stability_map.cases import Case, Finding, Run, table
from benchmarks.stability_map.homogeneous import (
    COUPLINGS,
    DRIVERS,
    FRAMES,
    RAMP,
    case_of_shape,
    has_frame,
)
from tests.reference.march import factor, initial, material, step_times
from tests.reference.point import prescribed_path

FINER = 16  # steps of the reference in one of the scene's
LIMIT_TOLERANCE = 0.03  # of A over r0^2: the staggered pass has an error of the order of kappa dt = 0.025
SETTLED = 0.01  # of A between two references, or there is no limit
REFERENCE = "material point, dt -> 0"


def gradients(scene: dict[str, Any], times: np.ndarray) -> np.ndarray:
    """F by step, (steps, 3, 3)."""
    F = np.tile(np.eye(3), (len(times), 1, 1))
    for name, load in scene["loads"].items():
        i, j = ("xyz".index(letter) for letter in name[-2:])
        F[:, i, j] += load["value"] * factor(load["ramp"], times)
    return F


def limit(scene: dict[str, Any], finer: int) -> np.ndarray:
    """A at the last row's time for a step that goes to zero.

    The law `explicit` is relaxed, so that it does not chatter; laws with a memory would only become slower by that.
    """
    r, step = scene["remodeling"], scene["time"]["step"]
    # a staggered row's cells have remodeled up to the step before it
    end = step_times(scene)[-1] - (0.0 if r["coupling"] == "extrapolated" else step)
    step /= finer
    times = step * np.arange(1, round(end / step) + 2)
    path = prescribed_path(
        material(scene), gradients(scene, times), times, initial(scene),
        r["driver"], r["law"], r["frame"], r["kappa"], 0.5 if r["law"] == "explicit" else 1.0,
    )  # fmt: skip
    return np.asarray(path[-1])


def check_limit(case: Case, run: Run) -> Finding:
    """F everywhere as on the boundary, and A as for dt -> 0, held against two steps."""
    if "time" not in run.fields:
        return Finding(0.0, "no field")
    scene, r0 = case.scene, case.scene["cells"]["end_to_end_length"]
    expected, coarser = (limit(scene, finer) for finer in (FINER, FINER // 2))
    if np.abs(expected - coarser).max() / r0**2 > SETTLED:
        return Finding(np.nan, "the reference does not converge with dt")
    F = gradients(scene, step_times(scene))[-1]
    patch = np.abs(run.tensor("deformation_gradient") - F).max() / np.abs(F).max() / 1e-5
    cells = np.abs(run.structure_tensor() - expected).max() / r0**2 / LIMIT_TOLERANCE
    words = f"A differs from dt -> 0 by {cells * LIMIT_TOLERANCE:.3g} r0^2" if cells > patch else "F is not uniform"
    return Finding(float(max(cells, patch)), words)


driven_case = partial(case_of_shape, "driven", check_limit, reference=REFERENCE)

# the principal directions turn with the load and differ between stress, strain and cells
table(
    "shear", driven_case, {"shear": (0.01, 0.3, 1.0), "driver": DRIVERS, "frame": FRAMES, "coupling": COUPLINGS},
    lambda p: {"loads.h_xz": {"value": p["shear"], "ramp": RAMP}, "time.end": 40.0},
    only=has_frame, reduced=lambda p: p["shear"] == 0.3 and p["driver"] == "cauchy",
)  # fmt: skip

# the patch test under shear and stretch, with a node inside that is moved
table(
    "shear of bad elements", driven_case,
    {"distortion": (0.0, 0.9, 0.999), "law": ("explicit", "relaxation"), "frame": FRAMES},
    {
        "loads.h_xz": {"value": 0.3, "ramp": RAMP}, "loads.h_zz": {"value": 0.2, "ramp": RAMP}, "mesh.refinement": 2,
        "time.end": 30.0,
    },
    reduced=lambda p: p["distortion"] == 0.9,
)  # fmt: skip

# shear that changes its sign, under a constant stretch; laws that forget
REVERSED = [[0, 0], [10, 1], [30, 1], [50, -1]]
table(
    "shear reversed", driven_case,
    {"law": ("explicit", "relaxation"), "driver": DRIVERS, "frame": FRAMES, "coupling": COUPLINGS},
    {
        "loads.h_xz": {"value": 0.3, "ramp": REVERSED}, "loads.h_zz": {"value": 0.1, "ramp": RAMP}, "time.end": 80.0,
    },
    only=has_frame,
)  # fmt: skip
