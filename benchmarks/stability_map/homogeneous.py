"""Families on the cube: homogeneous bodies, each held against a material point typed by hand."""

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
from tests.reference.march import Bar, Path, march, material, slowed
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
STRETCH_TOLERANCE, ANGLE_TOLERANCE, CELL_TOLERANCE = 1e-5, 1e-3, 1e-4  # relative, degrees, of A over r0^2
LAGGING = 1e3  # times that for a lag of a step: 1 % of a stretch, a degree, 0.1 of A
FRAMES, DRIVERS = ("spatial", "material"), ("cauchy", "pk2", "finger")
LAWS, COUPLINGS = ("explicit", "rate", "relaxation", "none"), ("staggered", "relaxed")
ELEMENTS = {
    "hex1": ("hexahedron", 1),
    "hex2": ("hexahedron", 2),
    "tet1": ("tetrahedron", 1),
    "tet2": ("tetrahedron", 2),
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


LOOKS, DECIDED = 10, 0.01  # rows of a path that are looked at; over the unloaded eigenvalue: nearer to 0 nobody decides


def saddle(scene: dict[str, Any], path: Path) -> bool | None:
    """Whether one of the states on a path is no minimum; None where it is too near to say, or nobody came there."""
    if not path.times or scene["remodeling"]["law"] == "tensor":  # whose repulsion is another one
        return None
    rows = np.unique(np.linspace(0, len(path.times) - 1, LOOKS).astype(int))
    squares = [by_point[0] for by_point in path.squares]
    lowest = min(smallest_eigenvalue(path.unknowns[i], squares[i], material(scene), squares[0]) for i in rows)
    return None if abs(lowest) < DECIDED else lowest < 0


def deviations(scene: dict[str, Any], run: Run, path: Path, rows: int) -> dict[str, float]:
    """Deviation over tolerance by quantity."""
    stretch, r0 = np.array(path.unknowns[:rows])[:, 2], scene["cells"]["end_to_end_length"]
    found = {
        "stretch": np.max(np.abs(run.column("mean_stretch")[:rows] / stretch - 1)) / STRETCH_TOLERANCE,
        "angle": np.max(np.abs(run.column("mean_fibre_angle")[:rows] - path.angle()[:rows])) / ANGLE_TOLERANCE,
    }
    times = np.array(path.times)
    at = np.flatnonzero(np.isclose(times, run.fields.get("time") or -1.0))
    if len(at):
        A, F = run.structure_tensor(), run.tensor("deformation_gradient")
        squares, stretches = path.squares[at[0]][0], path.unknowns[at[0]]
        # which of two equal directions gets which rank is nobody's business: x and y may be exchanged
        twins = ([0, 1, 2], [1, 0, 2]) if set(scene["loads"]) == {"force"} else ([0, 1, 2],)
        off = [
            np.abs(A - np.diag(squares[order])).max() / r0**2
            + np.abs(F - np.diag(stretches[order])).max() / stretches.max()
            for order in twins
        ]
        found["cells and F"] = min(off) / CELL_TOLERANCE
    loose = LAGGING if slowed(scene) else 1.0
    return {name: float(np.nan_to_num(value, nan=np.inf)) / loose for name, value in found.items()}


# ---------------------------------------------------------------- families
def cube_case(
    family: str, changes: Values, place: Place, check: Check = check_point, reference: str = REFERENCE, **more: Any
) -> Case:
    """The demo's cube with other values."""
    scene = with_values(CUBE, changes)
    return Case(family, named(family, place), scene, check, reference, place, base=("demos/cube.toml", changes), **more)


def element(p: Place) -> Values:
    """Kind and degree of the coordinate `element`."""
    return dict(zip(("mesh.element", "mesh.degree"), ELEMENTS[p["element"]], strict=True))


LOADS = (0.0, 1e-4, 1e-3, 0.01, 0.03, 0.1, 0.3, 0.5, 1.0, 3.0, 10.0, 30.0, 100.0, 1e3, 1e4, 1e6, 1e9)
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
    "crossing": ({"x": (10.0, [[0, 0], [10, 0.2], [50, 1]]), "z": (10.0, [[0, 0], [10, 1], [50, 0.2]])}, 80.0),
    "turned": ({"x": (10.0, [[0, 0], [30, 0], [40, 1]]), "z": (10.0, [[0, 0], [10, 1], [30, 1], [40, 0]])}, 80.0),
    "hydrostatic 3": ({axis: (3.0, RAMP) for axis in "xyz"}, 30.0),
    "hydrostatic 30": ({axis: (30.0, RAMP) for axis in "xyz"}, 30.0),
    "hydrostatic -30": ({axis: (-30.0, RAMP) for axis in "xyz"}, 30.0),
}


def triaxial(p: Place) -> Values:
    """Dead forces along the axes, for the coordinate `load`."""
    forces, end = TRIAXIAL[p["load"]]
    return {f"loads.force_{a}": {"value": v, "ramp": ramp} for a, (v, ramp) in forces.items()} | {"time.end": end}


def has_frame(p: Place) -> bool:
    """S is of the reference: its frame is one."""
    return p["driver"] != "pk2" or p["frame"] == FRAMES[0]


def case_of_shape(
    shape: str, check: Check, family: str, changes: Values, place: Place, reference: str = REFERENCE, **more: Any
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
