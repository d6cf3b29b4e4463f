"""Another run of a scene that must come to the same: other units, kinematics, solvers, ranks, a stop on the way."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field
from random import Random
from typing import Any

import numpy as np

from benchmarks.fuzzing.scenes import STIFF_NAME, Values, has_free_length
from benchmarks.stability_map.cases import Finding, Run, farthest, with_values

EXACT, SOLVED = (
    1e-6,
    1e-4,
)  # relative tolerance of lengths: of the same arithmetic; of another way to the same solution
DEGREES = 100.0  # degrees for a relative error of one
SIZES = {  # powers of the units of stress, length and time of columns
    "force": (1, 2, 0), "axial_force": (1, 2, 0), "reduced_axial_force": (1, 2, 0), "pressure": (1, 0, 0),
    "stored_energy": (1, 3, 0), "remodeling_power": (1, 3, -1), "inner_radius": (0, 1, 0), "outer_radius": (0, 1, 0),
    "time": (0, 0, 1),
}  # fmt: skip
LENGTHS = (
    "inner_radius",
    "outer_radius",
    "mean_stretch",
    "min_stretch",
    "max_stretch",
    "axial_elongation",
)
GEOMETRY = {"side": 1, "length": 1, "inner_radius": 1, "outer_radius": 1, "area": 2}
LOADS = {"force": (1, 2), "axial_force": (1, 2), "pressure": (1, 0)}


@dataclass
class Other:
    """A run that must come to the same: what it is asked for beside its scene, its units over the scene's."""

    name: str
    scene: Values
    asked: Values = field(default_factory=dict)
    units: tuple[float, float, float] = (1.0, 1.0, 1.0)
    tolerance: float = EXACT
    degrees: float | None = None  # allowed of angles, where it is no rounding
    last_only: bool = False
    in_numbers: Values | None = None  # the other scene, where that one has words


Relation = Callable[[Values, Random], Other | None]


def in_units(
    scene: Values, stress: float = 1.0, length: float = 1.0, time: float = 1.0, chain: float = 1.0
) -> Values:
    """The same tissue and loads in other units."""
    s = deepcopy(scene)
    m, cells, r, t = s["material"], s["cells"], s["remodeling"], s["time"]
    for table, key, by in (
        (m, "lame_lambda", stress), (m, "lame_mu", stress), (m, "chain_density", stress), (m, "contour_length", chain),
        (m, "persistence_length", chain), (cells, "end_to_end_length", chain), (r, "kappa", 1 / time),
        (r, "rotation_time", time), (t, "step", time),
    ):  # fmt: skip
        table[key] *= by
    if t["end"] != "equilibrium":
        t["end"] *= time
    if "turnover" in r:
        r["turnover"] |= {
            key: r["turnover"][key] * time for key in ("time", "from") if key in r["turnover"]
        }
    if "times" in s["output"]:
        s["output"]["times"] = [at * time for at in s["output"]["times"]]
    if "absolute_tolerance" in s["solver"]:
        s["solver"]["absolute_tolerance"] *= stress * length**2
    if not isinstance(cells["initial"], str):
        cells["initial"] = [part * chain for part in cells["initial"]]
    for key, power in GEOMETRY.items():
        if key in s["geometry"]:
            s["geometry"][key] *= length**power
    for region in s.get("regions", {}).values():
        region |= {key: radius * length for key, radius in region.items()}
    for name, load in s["loads"].items():
        powers = LOADS.get(name, (0, 0))
        load["value"] *= stress ** powers[0] * length ** powers[1]
        load["ramp"] = [[at * time, factor] for at, factor in load["ramp"]]
    return s


def _unit(of: str, decades: float) -> Relation:
    def relation(scene: Values, random: Random) -> Other:
        by = 10 ** random.uniform(-decades, decades)
        units = tuple(by if each == of else 1.0 for each in ("stress", "length", "time"))
        return Other(f"in another unit of {of}", in_units(scene, **{of: by}), units=units)

    return relation


def _chain(scene: Values, random: Random) -> Other:
    return Other(
        "chain lengths in another unit",
        in_units(scene, chain=random.choice((1e-9, 1e-3, 92.4, 1e6))),
    )


def _said(scene: Values, random: Random) -> Other | None:
    s, unit, own = (
        deepcopy(scene),
        scene["geometry"].get("length_unit"),
        scene["material"]["stress_unit"],
    )
    if unit is None:
        return None
    for key, power in GEOMETRY.items():
        if key in s["geometry"]:
            s["geometry"][key] = f"{s['geometry'][key]!r} {unit}" + (
                f"^{power}" if power > 1 else ""
            )
    other, by = ("MPa", 1e-3) if own == "kPa" else ("kPa", {"Pa": 1e-3, "MPa": 1e3}[own])
    s["material"]["lame_mu"] = f"{s['material']['lame_mu'] * by!r} {other}"
    s["material"]["temperature"] = f"{s['material']['temperature'] - 273.15!r} degC"
    for name, load in s["loads"].items():
        if name == "pressure":
            load["value"] = f"{load['value'] * by!r} {other}"
        elif name in LOADS:
            load["value"] = f"{load['value'] * by!r} {other}*{unit}^2"
    return Other("with units in words", s, in_numbers=scene)


def _ramp(scene: Values, random: Random) -> Other:
    s, by = deepcopy(scene), 10 ** random.uniform(-2, 2)
    for load in s["loads"].values():
        load["value"], ramp = load["value"] * by, [[at, factor / by] for at, factor in load["ramp"]]
        load["ramp"] = ramp
    return Other("loads over a factor, ramps times it", s)


def _recorded(scene: Values, random: Random) -> Other:
    return Other("from its own scene.toml", scene, {"recorded": True})


def _resumed(scene: Values, random: Random) -> Other | None:
    t = scene["time"]
    if t["end"] == "equilibrium" or "tolerance" in t:
        return None
    stop = random.randint(1, round(t["end"] / t["step"]) - 1) * t["step"]
    s, exact = deepcopy(scene), scene["solver"]["method"] == "direct"
    s["output"].pop("times", None)  # they may be after the stop
    return Other(
        f"stopped at t = {stop:g} and resumed",
        s,
        {"stop": stop},
        tolerance=EXACT if exact else SOLVED,
    )


def _ranks(scene: Values, random: Random) -> Other | None:
    small = scene["model"]["kinematics"] in (
        "point",
        "radial",
    )  # fewer elements than ranks, or nearly
    return (
        None
        if small and random.random() < 0.7
        else Other("on two ranks", scene, {"ranks": 2}, tolerance=SOLVED)
    )


KINDS = {
    "cube": ("point", "full"),
    "tendon": ("point", "full"),
    "tube": ("radial", "axisymmetric", "sector", "full"),
}


def _kinematics(scene: Values, random: Random) -> Other | None:
    kinds, chosen, cells = (
        KINDS[scene["geometry"]["shape"]],
        scene["model"]["kinematics"],
        scene["cells"],
    )
    if (
        chosen not in kinds
        or cells["initial"] == "random"
        or scene["remodeling"]["law"] == "rotation"
    ):
        return None
    if (
        scene["solver"].get("unstable")
        or scene["time"]["end"] == "equilibrium"
        and chosen == "full"
    ):
        return None
    # a polygon is no circle: radius and half-plane agree, and the quarter and the whole
    other = kinds[kinds.index(chosen) ^ 1]
    pulled = scene["supports"]["ends"] == "clamped" or "axial_force" in scene["loads"]
    if other in ("radial", "sector") and pulled or other == "sector" and cells["axes"] == "global":
        return None
    return Other(
        f"kinematics {other}", with_values(scene, {"model.kinematics": other}), tolerance=SOLVED
    )


def _solver(scene: Values, random: Random) -> Other:
    method = random.choice(("direct", "lagged", "iterative"))
    solver = {
        "method": "lagged" if method == "iterative" and has_free_length(scene) else method, "relative_tolerance": 1e-10,
        "predictor": random.choice(("none", "autoregressive")),
    }  # fmt: skip
    loose = 1e-3 if scene["solver"]["relative_tolerance"] > 1e-9 else SOLVED
    return Other(f"another solver {solver}", scene | {"solver": solver}, tolerance=loose)


def _tolerance(scene: Values, random: Random) -> Other | None:
    asked = scene["time"].get("tolerance")
    if asked is None or scene["time"]["end"] == "equilibrium":
        return None
    finer, allowed = with_values(scene, {"time.tolerance": asked / 4}), 1.3 * asked
    return Other(
        f"a quarter of time.tolerance {asked:g}",
        finer,
        tolerance=float(np.radians(allowed)),
        degrees=allowed,
    )


def _half(scene: Values, random: Random) -> Other | None:
    """The coupling `extrapolated` is of second order."""
    r, t = scene["remodeling"], scene["time"]
    rate = r["kappa"] * t["step"]
    if (
        t["end"] == "equilibrium"
        or "tolerance" in t
        or r["coupling"] != "extrapolated"
        or rate >= 0.1
    ):
        return None
    # a step in which tension comes or goes is off by up to kappa dt
    error = max(20 * rate**2, rate)
    finer = with_values(scene, {"time.step": t["step"] / 2})
    return Other("half of the step", finer, tolerance=error, degrees=60 * error, last_only=True)


def _equilibrium(scene: Values, random: Random) -> Other | None:
    if scene["time"]["end"] != "equilibrium":
        return None
    last = max(load["ramp"][-1][0] for load in scene["loads"].values())
    long = with_values(
        scene, {"time.end": last + 40 / scene["remodeling"]["kappa"], "time.tolerance": 1.0}
    )
    return Other("in time", long, tolerance=5e-3, degrees=0.5, last_only=True)


def _elements(scene: Values) -> Other | None:
    if scene.get("name") != STIFF_NAME:
        return None
    changes = {"mesh.formulation": "selective-integration", "mesh.element": "hexahedron"}
    finer = with_values(scene, changes)
    return Other(
        "by selective integration", finer, tolerance=5e-3, degrees=1.0, last_only="profile" in scene
    )


RELATIONS: tuple[tuple[int, Relation], ...] = (
    (3, _unit("stress", 4)), (3, _unit("length", 2)), (3, _unit("time", 3)), (3, _chain), (3, _said), (2, _ramp),
    (2, _recorded), (4, _resumed),
    (2, _ranks), (6, _kinematics), (4, _solver), (30, _tolerance), (4, _half), (60, _equilibrium),
)  # fmt: skip


def chosen(scene: Values, random: Random) -> Other:
    """One that the scene allows."""
    if (elements := _elements(scene)) is not None:
        return elements
    found = [
        (weight, other)
        for weight, relation in RELATIONS
        if (other := relation(scene, random)) is not None
    ]
    return random.choices([other for _, other in found], [weight for weight, _ in found])[0]


def compared(other: Other, run: Run, again: Run) -> Finding:
    """The columns of two runs at the times that both have."""
    sizes = {name: float(np.prod(np.power(other.units, powers))) for name, powers in SIZES.items()}
    mine, theirs = np.array(run.history["time"]), np.array(again.history["time"]) / sizes["time"]
    pairs = [
        (i, j)
        for i, at in enumerate(mine)
        for j in np.flatnonzero(np.isclose(theirs, at, rtol=1e-9))[:1]
    ]
    if other.last_only:
        pairs = [(len(mine) - 1, len(theirs) - 1)]
    if len(pairs) < len(mine) and not other.last_only and "tolerance" not in other.scene["time"]:
        return Finding(np.inf, f"{other.name}: {len(pairs)} of {len(mine)} times are there")
    rows, others = (np.array(index) for index in zip(*pairs, strict=True))
    off: dict[str, Any] = {}
    for name in run.history:
        if name not in again.history or (allowed := _allowed(name, other)) is None:
            continue
        a, b = np.array(run.history[name])[rows], np.array(again.history[name])[others] / sizes.get(
            name, 1.0
        )
        if np.any(np.isnan(a) != np.isnan(b)):
            off[f"emptiness of {name}"] = np.inf
        scale = (
            1.0
            if "angle" in name or name.startswith(("axial_elongation", "max_chain_extension"))
            else np.nanmax(np.abs(a), initial=0.0)
        )
        off[name] = np.nanmax(np.abs(a - b), initial=0.0) / (scale or 1.0) / allowed
    return farthest(off, f"{other.name}: ")


def _allowed(name: str, other: Other) -> float | None:
    if "angle" in name:
        return other.degrees or DEGREES * other.tolerance
    if name in LENGTHS:
        return other.tolerance
    if other.degrees is not None:
        return None
    loose = name in ("stored_energy", "force", "pressure") or name.startswith("max_chain_extension")
    return 100 * other.tolerance if loose else None
