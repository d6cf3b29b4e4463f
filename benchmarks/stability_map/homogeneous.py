"""Families on the cube: homogeneous bodies, each held against a material point typed by hand."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from benchmarks.stability_map.cases import Case, Check, Finding, Run, family, with_values
from benchmarks.stability_map.point import Path, diagonal_path
from benchmarks.stability_map.solid import smallest_eigenvalue
from tests.reference.radial import RadialMaterial

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


# ---------------------------------------------------------------- the reference of a scene
def material(scene: dict[str, Any]) -> RadialMaterial:
    """The reference's parameters from the scene's."""
    m = scene["material"]
    modulus = 1.381e-23 * m["temperature"] * m["chain_density"] / (4 * m["persistence_length"])
    length = m["contour_length"] if m["chain_density"] else 1e9  # where there are no chains, none locks
    return RadialMaterial(m["lame_lambda"], m["lame_mu"], modulus, length, scene["cells"]["end_to_end_length"])


def factor(ramp: Sequence[Sequence[float]], time: np.ndarray) -> np.ndarray:
    """Piecewise linear, held at both ends."""
    times, factors = np.array(ramp, dtype=float).T
    return np.interp(time, times, factors)


def step_times(scene: dict[str, Any]) -> np.ndarray:
    """Times of the steps."""
    step, end = scene["time"]["step"], scene["time"]["end"]
    return step * np.arange(1, round(end / step) + 1)


def nominal_stress(scene: dict[str, Any], times: np.ndarray) -> np.ndarray:
    """Dead stresses along x, y, z by step."""
    geometry, found = scene["geometry"], np.zeros((len(times), 3))
    thickness = geometry["side"] / geometry.get("aspect", 1.0)
    for name, load in scene["loads"].items():
        axis = "xyz".index(name[-1]) if name != "force" else 2
        area = geometry["side"] ** 2 if axis == 0 else geometry["side"] * thickness
        found[:, axis] += load["value"] * factor(load["ramp"], times) / area
    return found


def initial(scene: dict[str, Any]) -> np.ndarray:
    """l_I at t = 0."""
    cells = scene["cells"]
    if isinstance(cells["initial"], str):
        along = cells.get("aligned_axis", 3)
        pattern = {"isotropic": np.full(3, 3**-0.5), "aligned": np.eye(3)[along - 1]}[cells["initial"]]
        return np.asarray(cells["end_to_end_length"] * pattern)
    return np.array(cells["initial"], dtype=float)


def slowed(scene: dict[str, Any]) -> bool:
    """Whether the relaxed pass meets a law with a memory: then its own scheme is no reference, the law is."""
    return scene["remodeling"]["coupling"] == "relaxed" and scene["remodeling"]["law"] in ("rate", "relaxation")


def path_of(scene: dict[str, Any]) -> Path:
    """What the reference does."""
    r, times = scene["remodeling"], step_times(scene)
    relaxed = r["coupling"] == "relaxed" and not slowed(scene)
    return diagonal_path(
        material(scene),
        nominal_stress(scene, times),
        times,
        initial(scene),
        r["driver"],
        r["law"],
        r["kappa"],
        r.get("relaxation_factor", 0.5) if relaxed else 1.0,
    )


def check_point(case: Case, run: Run) -> Finding:
    """Stretch and angle by step, and the cells at the end."""
    path = path_of(case.scene)
    return compared(case.scene, run, path, saddle(case.scene, path))


def compared(scene: dict[str, Any], run: Run, path: Path, unstable: bool | None = None) -> Finding:
    """A run held against a path, of which it may be known whether it comes to a saddle."""
    rows = min(len(path.times), len(run.column("time")))
    if rows == 0:
        return Finding(np.inf if run.code == 0 else 0.0, "no row", unstable, not path.ended)
    found = deviations(scene, run, path, rows)
    words, ratio = max(found.items(), key=lambda pair: pair[1])
    said = f"{words} off by {ratio:.3g} tolerances" + (f"; reference: {path.ended}" if path.ended else "")
    if path.ended and run.code == 0:
        ratio = np.inf
    return Finding(float(ratio), said, unstable, not path.ended)


LOOKS, DECIDED = 10, 0.01  # rows of a path that are looked at; over the unloaded eigenvalue: nearer to 0 nobody decides


def saddle(scene: dict[str, Any], path: Path) -> bool | None:
    """Whether one of the states on a path is no minimum; None where it is too near to say, or nobody came there."""
    if not path.times:
        return None
    rows = np.unique(np.linspace(0, len(path.times) - 1, LOOKS).astype(int))
    lowest = min(
        smallest_eigenvalue(path.stretches[i], path.squares[i], material(scene), path.squares[0]) for i in rows
    )
    return None if abs(lowest) < DECIDED else lowest < 0


def deviations(scene: dict[str, Any], run: Run, path: Path, rows: int) -> dict[str, float]:
    """Deviation over tolerance by quantity."""
    stretch, r0 = np.array(path.stretches[:rows])[:, 2], scene["cells"]["end_to_end_length"]
    found = {
        "stretch": np.max(np.abs(run.column("mean_stretch")[:rows] / stretch - 1)) / STRETCH_TOLERANCE,
        "angle": np.max(np.abs(run.column("mean_fibre_angle")[:rows] - path.angle()[:rows])) / ANGLE_TOLERANCE,
    }
    times = np.array(path.times)
    at = np.flatnonzero(np.isclose(times, run.fields.get("time") or -1.0))
    if len(at):
        A, F = run.structure_tensor(), run.tensor("deformation_gradient")
        squares, stretches = path.squares[at[0]], path.stretches[at[0]]
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
    family_name: str, changes: dict[str, Any], place: dict[str, Any], check: Check = check_point, **more: Any
) -> Case:
    """The demo's cube with other values."""
    scene = with_values(CUBE, changes)
    key = f"{family_name}: " + ", ".join(f"{name} {value}" for name, value in place.items())
    options = {"reference": REFERENCE, "place": place, "base": ("demos/cube.toml", changes), **more}
    return Case(family_name, key, scene, check, **options)


LOADS = (0.0, 1e-4, 1e-3, 0.01, 0.03, 0.1, 0.3, 0.5, 1.0, 3.0, 10.0, 30.0, 100.0, 1e3, 1e4, 1e6, 1e9)


@family("load")
def loads() -> Iterator[Case]:
    """From 1e-4 of the network's stiffness to far beyond locking."""
    for frame in FRAMES:
        for load in LOADS:
            changes = {"loads.force.value": load, "remodeling.frame": frame}
            # a tilt needs many passes to grow; a load far beyond locking needs many solves for each
            changes |= {} if load <= 0.5 or load == 10 else {"time.end": 40.0 if load < 1e5 else 12.0}
            yield cube_case("load", changes, {"frame": frame, "force": load}, reduced=load in (1e-4, 0.1, 10.0, 1e3))


@family("weak load")
def weak_loads() -> Iterator[Case]:
    """The same ratio of load and network with other networks and cells."""
    for frame in FRAMES:
        for density in (1e20, 1e23, 1e25, 1e27):
            for share in (1e-4, 1e-3, 1e-2, 3e-2, 0.1):
                stiffness = 1.381e-23 * 310.0 * density / (4 * 1.82) * 1.8
                changes = {
                    "material.chain_density": density, "loads.force.value": share * stiffness,
                    "remodeling.frame": frame, "time.end": 100.0, "time.step": 2.0,
                }  # fmt: skip
                yield cube_case("weak load", changes, {"frame": frame, "density": density, "load over network": share})


@family("speed")
def speeds() -> Iterator[Case]:
    """kappa dt from 1e-4 to 1e3."""
    for law in ("explicit", "rate", "relaxation"):
        for frame in FRAMES:
            for speed in (1e-4, 1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0, 1e3):
                changes = {
                    "remodeling.kappa": speed, "remodeling.law": law, "remodeling.frame": frame, "time.end": 20.0,
                }  # fmt: skip
                place = {"law": law, "frame": frame, "kappa dt": speed}
                yield cube_case("speed", changes, place, reduced=law == "explicit" and speed in (1e-4, 1e3))


@family("compressibility")
def compressibilities() -> Iterator[Case]:
    """lambda/mu from 0 to 1e5."""
    for frame in FRAMES:
        for ratio in (0.0, 0.1, 1.0, 10.0, 100.0, 1e3, 1e4, 1e5):
            for load in (1.0, 30.0):
                changes = {
                    "material.lame_lambda": ratio * 3.103, "loads.force.value": load, "remodeling.frame": frame,
                    "time.end": 30.0,
                }  # fmt: skip
                place = {"frame": frame, "force": load, "lambda/mu": ratio}
                yield cube_case("compressibility", changes, place, reduced=ratio in (0.0, 1e5) and load == 30)


@family("chain length")
def chain_lengths() -> Iterator[Case]:
    """r0/L from 0.05 to 0.999."""
    for frame in FRAMES:
        for share in (0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.99, 0.999):
            for load in (1.0, 10.0):
                changes = {
                    "cells.end_to_end_length": share * 2.125, "loads.force.value": load, "remodeling.frame": frame,
                    "time.end": 40.0,
                }  # fmt: skip
                place = {"frame": frame, "force": load, "r0/L": share}
                yield cube_case("chain length", changes, place, reduced=share in (0.05, 0.9, 0.999) and load == 10)


@family("chain density")
def chain_densities() -> Iterator[Case]:
    """n_chn over ten decades, and zero."""
    for frame in FRAMES:
        for density in (0.0, *(10.0**n for n in range(17, 28))):
            changes = {"material.chain_density": density, "remodeling.frame": frame, "time.end": 40.0}
            for load in (3.0, 30.0):
                place = {"frame": frame, "force": load, "density": density}
                reduced = density in (0.0, 1e17, 1e27) and load == 30
                yield cube_case("chain density", {**changes, "loads.force.value": load}, place, reduced=reduced)


@family("compression")
def compressions() -> Iterator[Case]:
    """Stable and not: the tangent of one element is the reference."""
    for frame in FRAMES:
        for density in (0.0, 7e21, 1e24):
            for load in (-0.01, -1.0, -3.0, -10.0, -30.0, -100.0):
                changes = {
                    "loads.force.value": load, "material.chain_density": density, "remodeling.frame": frame,
                    "time.end": 12.0,
                }  # fmt: skip
                place = {"frame": frame, "density": density, "force": load}
                yield cube_case("compression", changes, place, reduced=density == 7e21 and load in (-10.0, -30.0))


HISTORIES = {
    "unloaded": [[0.0, 0.0], [10.0, 1.0], [30.0, 1.0], [40.0, 0.0]],
    "reversed": [[0.0, 0.0], [10.0, 1.0], [30.0, 1.0], [50.0, -0.2]],
    "cycled": [[0.0, 0.0], [10.0, 1.0], [20.0, 0.1], [30.0, 1.0], [40.0, 0.1], [50.0, 1.0]],
    "released at once": [[0.0, 0.0], [10.0, 1.0], [30.0, 1.0], [31.0, 0.0]],
}


@family("unloading")
def unloadings() -> Iterator[Case]:
    """After remodeling."""
    for name, ramp in HISTORIES.items():
        for law in ("explicit", "rate", "relaxation"):
            for frame in FRAMES:
                for load in (10.0, 100.0) if (law, frame) == ("explicit", "spatial") else (10.0,):
                    changes = {
                        "loads.force.value": load, "loads.force.ramp": ramp, "remodeling.law": law,
                        "remodeling.frame": frame, "time.end": 60.0,
                    }  # fmt: skip
                    place = {"history": name, "law": law, "frame": frame, "force": load}
                    reduced = frame == "spatial" and load == 10 and law == "explicit"
                    yield cube_case("unloading", changes, place, reduced=reduced)


@family("aligned cells")
def aligned_cells() -> Iterator[Case]:
    """All of a chain along one axis, l = 0 along the others, along and across the load."""
    patterns: dict[str, Any] = {f"axis {a}": ("aligned", a) for a in (1, 2, 3)}
    patterns |= {"0.6, 0.8, 0": ([0.6, 0.8, 0.0], 3), "0, 0.6, 0.8": ([0.0, 0.6, 0.8], 3)}
    for name, (start, axis) in patterns.items():
        for law in ("explicit", "relaxation"):
            for frame in FRAMES:
                for load in (10.0, -3.0):
                    changes = {
                        "cells.initial": start, "cells.aligned_axis": axis, "remodeling.law": law,
                        "remodeling.frame": frame, "loads.force.value": load, "time.end": 40.0,
                    }  # fmt: skip
                    place = {"cells": name, "law": law, "frame": frame, "force": load}
                    reduced = law == "explicit" and frame == "spatial" and load == 10
                    yield cube_case("aligned cells", changes, place, reduced=reduced)


@family("steps")
def steps() -> Iterator[Case]:
    """One huge step, and a thousand tiny ones."""
    for frame in FRAMES:
        for load in (1.0, 10.0, 100.0, 1e4):
            changes = {"time.end": 100.0, "time.step": 100.0, "loads.force.ramp": [[0.0, 1.0]]}
            changes |= {"loads.force.value": load, "remodeling.frame": frame}
            yield cube_case("steps", changes, {"frame": frame, "steps": 1, "force": load}, reduced=load == 1e4)
            changes = {"time.end": 200.0, "time.step": 50.0, "loads.force.ramp": [[0.0, 0.0], [50.0, 1.0]]}
            changes |= {"loads.force.value": load, "remodeling.frame": frame}
            yield cube_case("steps", changes, {"frame": frame, "steps": 4, "force": load})
        changes = {
            "time.end": 20.0,
            "time.step": 0.02,
            "remodeling.frame": frame,
            "loads.force.ramp": [[0, 0], [10, 1]],
        }
        yield cube_case("steps", changes, {"frame": frame, "steps": 1000, "force": 10.0})


@family("method")
def methods() -> Iterator[Case]:
    """Every driver, law, frame, coupling and element."""
    for element, (kind, degree) in ELEMENTS.items():
        for driver in DRIVERS:
            for law in LAWS:
                for frame in FRAMES:
                    for coupling in COUPLINGS:
                        if law == "none" and (frame, coupling) != ("spatial", "staggered"):
                            continue  # nothing passes there
                        changes = {
                            "mesh.element": kind, "mesh.degree": degree, "remodeling.driver": driver,
                            "remodeling.law": law, "remodeling.frame": frame, "remodeling.coupling": coupling,
                            "time.end": 20.0, "time.step": 2.0,
                        }  # fmt: skip
                        place = {
                            "element": element, "driver": driver, "law": law, "frame": frame, "coupling": coupling,
                        }  # fmt: skip
                        reduced = element == "hex1" and law == "explicit" and coupling == "relaxed"
                        yield cube_case("method", changes, place, reduced=reduced)


# ---------------------------------------------------------------- loads along all axes, bad elements
RAMP = [[0.0, 0.0], [10.0, 1.0]]
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


def case_of_shape(
    shape: str, check: Check, family_name: str, changes: dict[str, Any], place: dict[str, Any], **more: Any
) -> Case:
    """A shape of `extensions` of the cube's size and material."""
    base = {**CUBE, "geometry": {"shape": shape, "side": 1.0}, "loads": {}}
    key = f"{family_name}: " + ", ".join(f"{name} {value}" for name, value in place.items())
    options = {"reference": REFERENCE, "place": place, "extended": True, **more}
    return Case(family_name, key, with_values(base, changes), check, **options)


block_case = partial(case_of_shape, "block", check_point)


@family("three axes")
def three_axes() -> Iterator[Case]:
    """Repeated and crossing principal stresses, loads that turn, hydrostatic dead loads."""
    for name, (forces, end) in TRIAXIAL.items():
        for driver in DRIVERS:
            for frame in FRAMES[:1] if driver == "pk2" else FRAMES:
                for coupling in COUPLINGS:
                    if name.startswith("hydrostatic") and (driver, coupling) != ("cauchy", "staggered"):
                        continue
                    changes = {f"loads.force_{a}": {"value": v, "ramp": ramp} for a, (v, ramp) in forces.items()}
                    changes |= {"remodeling.driver": driver, "remodeling.frame": frame, "time.end": end}
                    changes |= {"remodeling.coupling": coupling}
                    place = {"load": name, "driver": driver, "frame": frame, "coupling": coupling}
                    reduced = driver == "cauchy" and coupling == "staggered" and frame == "spatial"
                    yield block_case("three axes", changes, place, reduced=reduced)


@family("bad elements")
def bad_elements() -> Iterator[Case]:
    """A homogeneous state is exact on any elements: flat ones, and nearly inverted ones."""
    force = {"loads.force_z": {"value": 10.0, "ramp": RAMP}, "time.end": 12.0}
    for aspect in (1.0, 10.0, 100.0, 1e3, 1e4):
        for kind in ("hexahedron", "tetrahedron"):
            changes = {**force, "loads.force_z": {"value": 10.0 / aspect, "ramp": RAMP}, "geometry.aspect": aspect}
            changes |= {"mesh.element": kind, "mesh.refinement": 2}
            yield block_case("bad elements", changes, {"element": kind, "aspect ratio": aspect}, reduced=aspect == 100)
    for distortion in (0.5, 0.9, 0.99, 0.999, 1.1):
        for frame in FRAMES:
            changes = {**force, "geometry.distortion": distortion, "mesh.refinement": 2, "remodeling.frame": frame}
            place = {"distortion": distortion, "frame": frame}
            yield block_case("bad elements", changes, place, reduced=distortion == 0.99)
