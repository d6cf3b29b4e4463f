"""Families on the cube: homogeneous bodies, each held against a material point typed by hand.

Loads along the axes; a prescribed deformation of the whole boundary, with axes that are not coaxial and bad elements
inside; on one point loads that come late, jumps against a closed form, other units of chain lengths.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

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
from tests.reference.march import (
    Bar,
    Path,
    factor,
    initial,
    march,
    material,
    nominal_stress,
    slowed,
    step_times,
)
from tests.reference.point import prescribed_path
from tests.reference.radial import Array
from tests.reference.solid import smallest_eigenvalue

CUBE: dict[str, Any] = {
    "geometry": {"shape": "cube", "side": 1.0},
    "mesh": {"refinement": 1, "element": "hexahedron", "degree": 1},
    "material": {
        "lame_lambda": 27.293, "lame_mu": 3.103, "chain_density": 7.0e21, "contour_length": 2.125,
        "persistence_length": 1.82, "temperature": 310.0,
    },
    "cells": {"initial": "isotropic", "axes": "global", "end_to_end_length": 1.0},
    "loads": {"force": {"value": 10.0, "ramp": [[0.0, 0.0], [10.0, 1.0]]}},
    "remodeling": {
        "driver": "cauchy", "law": "explicit", "frame": "spatial", "coupling": "staggered", "kappa": 0.025,
    },
    "time": {"end": 100.0, "step": 1.0},
    "output": {"fields": True, "every": 1_000_000},
}  # fmt: skip
STRETCH_TOLERANCE, ANGLE_TOLERANCE, CELL_TOLERANCE = (
    1e-5,
    1e-3,
    1e-4,
)  # relative, degrees, of A over r0^2
LAGGING = 1e3  # times that for a lag of a step: 1 % of a stretch, a degree, 0.1 of A
FRAMES, DRIVERS = ("spatial", "material"), ("cauchy", "pk2", "finger")
LAWS, COUPLINGS = ("explicit", "rate", "relaxation", "none"), ("staggered", "relaxed")
ELEMENTS = {
    f"{kind[:3]}{degree}": (kind, degree)
    for kind in ("hexahedron", "tetrahedron")
    for degree in (1, 2)
}
REFERENCE = "material point"
VARIANT = {"remodeling.law": "tensor", "remodeling.frame": "material", "material.repulsion": "log"}


# ---------------------------------------------------------------- held against the reference
def check_point(case: Case, run: Run) -> Finding:
    """Stretch and angle by step, the cells at the end, and whether the equilibrium is one that lasts."""
    path = march(case.scene, Bar(case.scene))
    unstable, solvable = saddle(case.scene, path), not path.ended
    rows = min(len(path.times), len(run.column("time")))
    if rows == 0:
        return Finding(np.inf if run.code == 0 else 0.0, "no row", unstable, solvable)
    found = farthest(deviations(case.scene, run, path, rows), unstable=unstable, solvable=solvable)
    if path.ended:
        found.words += f"; reference: {path.ended}"
        found.ratio = np.inf if run.code == 0 else found.ratio
    return found


LOOKS, DECIDED = (
    10,
    0.01,
)  # rows of a path that are looked at; over the unloaded eigenvalue: nearer to 0 nobody decides


def saddle(scene: dict[str, Any], path: Path) -> bool | None:
    """Whether one of the states on a path is no minimum; None where it is too near to say, or nobody came there."""
    if not path.times or scene["remodeling"]["law"] == "tensor":  # whose repulsion is another one
        return None
    rows = np.unique(np.linspace(0, len(path.times) - 1, LOOKS).astype(int))
    squares = [by_point[0] for by_point in path.squares]
    lowest = min(
        smallest_eigenvalue(path.unknowns[i], squares[i], material(scene), squares[0]) for i in rows
    )
    return None if abs(lowest) < DECIDED else lowest < 0


def deviations(scene: dict[str, Any], run: Run, path: Path, rows: int) -> dict[str, float]:
    """Deviation over tolerance by quantity."""
    stretch, r0 = np.array(path.unknowns[:rows])[:, 2], scene["cells"]["end_to_end_length"]
    found = {
        "stretch": np.max(np.abs(run.column("mean_stretch")[:rows] / stretch - 1))
        / STRETCH_TOLERANCE
    }
    chains = (
        1.0 if scene["material"]["chain_density"] else 0.0
    )  # without them there are no cells, and no angle
    if chains:
        turned = np.abs(run.column("mean_fibre_angle")[:rows] - path.angle()[:rows])
        found["angle"] = np.max(turned) / ANGLE_TOLERANCE
    times = np.array(path.times)
    at = np.flatnonzero(np.isclose(times, run.fields.get("time") or -1.0))
    if len(at):
        A, F = run.structure_tensor(), run.tensor("deformation_gradient")
        squares, stretches = path.squares[at[0]][0], path.unknowns[at[0]]
        # which of two equal directions gets which rank is nobody's business: x and y may be exchanged
        twins = ([0, 1, 2], [1, 0, 2]) if set(scene["loads"]) == {"force"} else ([0, 1, 2],)
        off = [
            np.abs(A - chains * np.diag(squares[order])).max() / r0**2
            + np.abs(F - np.diag(stretches[order])).max() / stretches.max()
            for order in twins
        ]
        found["cells and F"] = min(off) / CELL_TOLERANCE
    loose = LAGGING if slowed(scene) else 1.0
    return {name: float(np.nan_to_num(value, nan=np.inf)) / loose for name, value in found.items()}


# ---------------------------------------------------------------- families
def cube_case(
    family: str,
    changes: Values,
    place: Place,
    check: Check = check_point,
    reference: str = REFERENCE,
    **more: Any,
) -> Case:
    """The demo's cube with other values."""
    scene = with_values(CUBE, changes)
    return Case(
        family,
        named(family, place),
        scene,
        check,
        reference,
        place,
        base=("demos/cube.toml", changes),
        **more,
    )


def element(p: Place) -> Values:
    """Kind and degree of the coordinate `element`."""
    return dict(zip(("mesh.element", "mesh.degree"), ELEMENTS[p["element"]], strict=True))


LOADS = (
    0.0,
    1e-4,
    1e-3,
    0.01,
    0.03,
    0.1,
    0.3,
    0.5,
    1.0,
    3.0,
    10.0,
    30.0,
    100.0,
    1e3,
    1e4,
    1e6,
    1e9,
)
RAMP = [[0.0, 0.0], [10.0, 1.0]]


def spatial_explicit(p: Place) -> bool:
    """The method as printed."""
    return p["frame"] == "spatial" and p["law"] == "explicit"


# from 1e-4 of the network's stiffness to far beyond locking: a tilt needs many passes to grow; a load far beyond
# locking needs many solves for each
table(
    "load", cube_case, {"frame": FRAMES, "force": LOADS},
    lambda p: {} if p["force"] <= 0.5 or p["force"] == 10 else {"time.end": 40.0 if p["force"] < 1e5 else 12.0},
    reduced=lambda p: p["force"] in (1e-4, 0.1, 10.0, 1e3),
)  # fmt: skip

# the same ratio of load and network with other networks and cells
table(
    "weak load", cube_case,
    {"frame": FRAMES, "density": (1e20, 1e23, 1e25, 1e27), "load over network": (1e-4, 1e-3, 1e-2, 3e-2, 0.1)},
    lambda p: {
        "loads.force.value": p["load over network"] * (1.381e-23 * 310.0 * p["density"] / (4 * 1.82) * 1.8),
        "time.end": 100.0, "time.step": 2.0,
    },
)  # fmt: skip

table(
    "speed", cube_case,
    {
        "law": ("explicit", "rate", "relaxation"), "frame": FRAMES,
        "kappa dt": (1e-4, 1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0, 1e3),
    },
    {"time.end": 20.0}, reduced=lambda p: p["law"] == "explicit" and p["kappa dt"] in (1e-4, 1e3),
)  # fmt: skip

table(
    "compressibility", cube_case,
    {"frame": FRAMES, "force": (1.0, 30.0), "lambda/mu": (0.0, 0.1, 1.0, 10.0, 100.0, 1e3, 1e4, 1e5)},
    {"time.end": 30.0}, reduced=lambda p: p["lambda/mu"] in (0.0, 1e5) and p["force"] == 30,
)  # fmt: skip

table(
    "chain length", cube_case,
    {"frame": FRAMES, "force": (1.0, 10.0), "r0/L": (0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.99, 0.999)},
    lambda p: {"cells.end_to_end_length": p["r0/L"] * 2.125, "time.end": 40.0},
    reduced=lambda p: p["r0/L"] in (0.05, 0.9, 0.999) and p["force"] == 10,
)  # fmt: skip

table(
    "chain density", cube_case,
    {"frame": FRAMES, "force": (3.0, 30.0), "density": (0.0, *(10.0**n for n in range(17, 28)))},
    {"time.end": 40.0}, reduced=lambda p: p["density"] in (0.0, 1e17, 1e27) and p["force"] == 30,
)  # fmt: skip

# stable and not: the tangent of one element is the reference
table(
    "compression", cube_case,
    {"frame": FRAMES, "density": (0.0, 7e21, 1e24), "force": (-0.01, -1.0, -3.0, -10.0, -30.0, -100.0)},
    {"time.end": 12.0}, reduced=lambda p: p["density"] == 7e21 and p["force"] in (-10.0, -30.0),
)  # fmt: skip

HISTORIES = {
    "unloaded": [[0.0, 0.0], [10.0, 1.0], [30.0, 1.0], [40.0, 0.0]],
    "reversed": [[0.0, 0.0], [10.0, 1.0], [30.0, 1.0], [50.0, -0.2]],
    "cycled": [[0.0, 0.0], [10.0, 1.0], [20.0, 0.1], [30.0, 1.0], [40.0, 0.1], [50.0, 1.0]],
    "released at once": [[0.0, 0.0], [10.0, 1.0], [30.0, 1.0], [31.0, 0.0]],
}
table(
    "unloading", cube_case,
    {"history": HISTORIES, "law": ("explicit", "rate", "relaxation"), "frame": FRAMES, "force": (10.0, 100.0)},
    lambda p: {"loads.force.ramp": HISTORIES[p["history"]], "time.end": 60.0},
    only=lambda p: p["force"] == 10 or spatial_explicit(p),
    reduced=lambda p: p["force"] == 10 and spatial_explicit(p),
)  # fmt: skip

# all of a chain along one axis, l = 0 along the others, along and across the load
PATTERNS: dict[str, Any] = {
    **{f"axis {a}": ("aligned", a) for a in (1, 2, 3)},
    "0.6, 0.8, 0": ([0.6, 0.8, 0.0], 3), "0, 0.6, 0.8": ([0.0, 0.6, 0.8], 3),
}  # fmt: skip
table(
    "aligned cells", cube_case,
    {"cells": PATTERNS, "law": ("explicit", "relaxation"), "frame": FRAMES, "force": (10.0, -3.0)},
    lambda p: {
        "cells.initial": PATTERNS[p["cells"]][0], "cells.aligned_axis": PATTERNS[p["cells"]][1], "time.end": 40.0,
    },
    reduced=lambda p: p["force"] == 10 and spatial_explicit(p),
)  # fmt: skip

# one huge step, and a thousand tiny ones
STEPS = {
    1: {"time.end": 100.0, "time.step": 100.0, "loads.force.ramp": [[0.0, 1.0]]},
    4: {"time.end": 200.0, "time.step": 50.0, "loads.force.ramp": [[0.0, 0.0], [50.0, 1.0]]},
    1000: {"time.end": 20.0, "time.step": 0.02, "loads.force.ramp": [[0, 0], [10, 1]]},
}
table(
    "steps", cube_case, {"frame": FRAMES, "steps": STEPS, "force": (1.0, 10.0, 100.0, 1e4)},
    lambda p: STEPS[p["steps"]], only=lambda p: p["steps"] < 1000 or p["force"] == 10,
    reduced=lambda p: p["steps"] == 1 and p["force"] == 1e4,
)  # fmt: skip

table(
    "method", cube_case,
    {"element": ELEMENTS, "driver": DRIVERS, "law": LAWS, "frame": FRAMES, "coupling": COUPLINGS},
    lambda p: {**element(p), "time.end": 20.0, "time.step": 2.0},
    # nothing passes with the law "none"
    only=lambda p: p["law"] != "none" or (p["frame"], p["coupling"]) == ("spatial", "staggered"),
    reduced=lambda p: (p["element"], p["law"], p["coupling"]) == ("hex1", "explicit", "relaxed"),
)  # fmt: skip


# ---------------------------------------------------------------- loads along all axes, bad elements
TRIAXIAL: dict[str, tuple[dict[str, tuple[float, list[list[float]]]], float]] = {
    "equibiaxial 3": ({"x": (3.0, RAMP), "z": (3.0, RAMP)}, 80.0),
    "equibiaxial 20": ({"x": (20.0, RAMP), "z": (20.0, RAMP)}, 80.0),
    "three unequal": ({"x": (3.0, RAMP), "y": (6.0, RAMP), "z": (10.0, RAMP)}, 60.0),
    "tension and compression": ({"x": (-2.0, RAMP), "z": (8.0, RAMP)}, 60.0),
    "crossing": (
        {"x": (10.0, [[0, 0], [10, 0.2], [50, 1]]), "z": (10.0, [[0, 0], [10, 1], [50, 0.2]])},
        80.0,
    ),
    "turned": (
        {"x": (10.0, [[0, 0], [30, 0], [40, 1]]), "z": (10.0, [[0, 0], [10, 1], [30, 1], [40, 0]])},
        80.0,
    ),
    "hydrostatic 3": ({axis: (3.0, RAMP) for axis in "xyz"}, 30.0),
    "hydrostatic 30": ({axis: (30.0, RAMP) for axis in "xyz"}, 30.0),
    "hydrostatic -30": ({axis: (-30.0, RAMP) for axis in "xyz"}, 30.0),
}


def triaxial(p: Place) -> Values:
    """Dead forces along the axes, for the coordinate `load`."""
    forces, end = TRIAXIAL[p["load"]]
    return {f"loads.force_{a}": {"value": v, "ramp": ramp} for a, (v, ramp) in forces.items()} | {
        "time.end": end
    }


def has_frame(p: Place) -> bool:
    """S is of the reference: its frame is one."""
    return p["driver"] != "pk2" or p["frame"] == FRAMES[0]


def case_of_shape(
    shape: str,
    check: Check,
    family: str,
    changes: Values,
    place: Place,
    reference: str = REFERENCE,
    **more: Any,
) -> Case:
    """A shape of `extensions` of the cube's size and material."""
    base = {**CUBE, "geometry": {"shape": shape, "side": 1.0}, "loads": {}}
    scene = with_values(base, changes)
    return Case(family, named(family, place), scene, check, reference, place, extended=True, **more)


block_case = partial(case_of_shape, "block", check_point)
# repeated and crossing principal stresses, loads that turn, hydrostatic dead loads
table(
    "three axes", block_case, {"load": TRIAXIAL, "driver": DRIVERS, "frame": FRAMES, "coupling": COUPLINGS}, triaxial,
    only=lambda p: has_frame(p)
    and (not p["load"].startswith("hydrostatic") or (p["driver"], p["coupling"]) == ("cauchy", "staggered")),
    reduced=lambda p: (p["driver"], p["coupling"], p["frame"]) == ("cauchy", "staggered", "spatial"),
)  # fmt: skip

# a homogeneous state is exact on any elements: flat ones, and nearly inverted ones
table(
    "bad elements", block_case,
    {"element": ("hexahedron", "tetrahedron"), "aspect ratio": (1.0, 10.0, 100.0, 1e3, 1e4)},
    lambda p: {
        "loads.force_z": {"value": 10.0 / p["aspect ratio"], "ramp": RAMP}, "geometry.aspect": p["aspect ratio"],
        "mesh.element": p["element"], "mesh.refinement": 2, "time.end": 12.0,
    },
    reduced=lambda p: p["aspect ratio"] == 100,
)  # fmt: skip
table(
    "bad elements", block_case, {"distortion": (0.5, 0.9, 0.99, 0.999, 1.1), "frame": FRAMES},
    {"loads.force_z": {"value": 10.0, "ramp": RAMP}, "mesh.refinement": 2, "time.end": 12.0},
    reduced=lambda p: p["distortion"] == 0.99,
)  # fmt: skip


# ---------------------------------------------------------------- a prescribed deformation of the whole boundary
FINER_PATHS = 16  # steps of the reference in one of the scene's
LIMIT_TOLERANCE = (
    0.03  # of A over r0^2: the staggered pass has an error of the order of kappa dt = 0.025
)
SETTLED = 0.01  # of A between two references, or there is no limit
OF_LIMIT = "material point, dt -> 0"


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
    expected, coarser = (limit(scene, finer) for finer in (FINER_PATHS, FINER_PATHS // 2))
    if np.abs(expected - coarser).max() / r0**2 > SETTLED:
        return Finding(np.nan, "the reference does not converge with dt")
    F = gradients(scene, step_times(scene))[-1]
    patch = np.abs(run.tensor("deformation_gradient") - F).max() / np.abs(F).max() / 1e-5
    cells = np.abs(run.structure_tensor() - expected).max() / r0**2 / LIMIT_TOLERANCE
    words = (
        f"A differs from dt -> 0 by {cells * LIMIT_TOLERANCE:.3g} r0^2"
        if cells > patch
        else "F is not uniform"
    )
    return Finding(float(max(cells, patch)), words)


driven_case = partial(case_of_shape, "driven", check_limit, reference=OF_LIMIT)

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


# ---------------------------------------------------------------- one point
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
    # inside a step, the rest of this step is all that has tension (docs/time_integration.md)
    within = bool((forces[:-1] * forces[1:] < 0).any())
    first = r["driver"] == "finger" or within
    error = max(LEAST_ERROR, FIRST_ORDER * rate if first else SECOND_ORDER * rate**2)
    found = {"stretch": float(np.max(np.abs(run.column("mean_stretch") / stretch - 1))) / error}
    if run.code == 0:
        r0, A = scene["cells"]["end_to_end_length"], run.structure_tensor()
        found["trace of A"] = (
            float(np.abs(np.trace(A, axis1=1, axis2=2) / r0**2 - 1).max()) / TRACE_TOLERANCE
        )
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
        "history": LATE, "coupling": ("extrapolated", "staggered"), "driver": ("cauchy", "pk2", "finger"),
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


# ---------------------------------------------------------------- weak jumps
def closed_squares(scene: dict[str, Any], times: Array) -> Array:
    """l_d^2 at the ends of steps under uniaxial tension along z, from isotropic cells: dA/dt solved."""
    r0, done = (
        scene["cells"]["end_to_end_length"],
        -np.expm1(-scene["remodeling"]["kappa"] * times)[:, None],
    )
    along = np.array([0.0, 0.0, 1.0])
    return np.asarray(r0**2 * (1 / 3 + (along - 1 / 3) * done))


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
    return farthest(
        {
            "angle": turned.max() / CLOSED_ANGLE_TOLERANCE,
            "stretch": off.max() / CLOSED_STRETCH_TOLERANCE,
        }
    )


def jump(p: Place) -> Values:
    """All of the load at once: no point may keep its cells, and the target stays, so that steps have no error."""
    return {
        **TENSOR,
        "remodeling.coupling": "extrapolated",
        "loads.force.ramp": [[0.0, 1.0]],
        "time.end": 6.0,
    }


# from weak to strong, soft to nearly incompressible
closed_case = partial(cube_case, check=check_closed_form, reference="closed form")
table(
    "extrapolated, jump", closed_case,
    {"law": ("tensor",), "force": (0.01, 0.05, 0.2, 1.0, 10.0), "kappa dt": (0.025, 0.5)}, jump,
    reduced=lambda p: (p["force"], p["kappa dt"]) == (0.2, 0.5),
)  # fmt: skip
table(
    "extrapolated, jump", closed_case,
    {"law": ("tensor",), "force": (0.2, 10.0), "lambda/mu": (100.0, 1e4, 1e5)}, jump,
)  # fmt: skip


# ---------------------------------------------------------------- units
UNITS = (1e-9, 1e-3, 92.4, 1e6)


LENGTHS = (
    ("material", "contour_length"),
    ("material", "persistence_length"),
    ("cells", "end_to_end_length"),
)


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
