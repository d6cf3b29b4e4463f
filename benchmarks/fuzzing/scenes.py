"""A valid scene from a seed: every table and key, sizes over decades, loads in proportion to the stiffness."""

from __future__ import annotations

import math
from random import Random
from typing import Any

from tests.reference.march import BOLTZMANN, STRESS_UNITS
from tests.reference.radial import secant_stiffness
from tests.values import ramped

Values = dict[str, Any]
COARSE = (
    8,
    4,
    2,
)  # elements of a tube around, through the wall and along, where it is meshed in full
RAY = (16, 8, 1)  # one layer: a half-plane that the radius is held against
COUNTS = {"tendon": {"AROUND": 8, "CORE": 2, "RINGS": 1, "ALONG": 2}}


STIFF, STIFF_NAME = 1_000_000, "nearly incompressible"
"""From this seed on scenes are tubes of tissue that hardly changes its volume, and are called so."""


def rounded(value: float) -> float:
    """Four digits, as somebody would write it."""
    return float(f"{value:.4g}")


def decades(random: Random, low: float, high: float) -> float:
    """10 to a power between two."""
    return rounded(10 ** random.uniform(low, high))


def made(seed: int) -> tuple[Values, Values]:
    """The scene of a seed, and the numbers of elements that scenes cannot ask for (`runner.run_request`)."""
    random = Random(seed)
    if seed >= STIFF:
        return _stiff(random)
    shape = random.choices(("cube", "tendon", "tube"), (8, 1, 11))[0]
    scene: Values = {}
    if random.random() < 0.15:
        scene["preset"] = random.choice(("kuhl-holzapfel-2007", "consistent", "sun-2002"))
    scene["geometry"] = _geometry(random, shape)
    scene["material"], r0, stiffness = _material(random)
    scene["remodeling"] = _remodeling(random)
    scene["cells"] = _cells(random, shape, r0)
    scene["supports"] = {
        "ends": (
            random.choices(("free", "clamped", "closed"), (12, 1, 2))[0]
            if shape == "tube"
            else "free"
        )
    }
    scene["mesh"], scene["model"] = _mesh(random, scene)
    scene["time"] = _time(random, scene)
    scene["loads"] = _loads(random, scene, stiffness)
    scene["solver"] = _solver(random, scene)
    output = {
        "fields": True,
        "every": 1_000_000,
        "checkpoint": random.choice((0, 3)),
        "report": seed % 4 == 0,
    }
    scene["output"] = output
    if random.random() < 0.2:
        scene["output"]["columns"] = ["pass_residual"]
    _rarely(Random(f"more of {seed}"), scene, stiffness)
    small = shape == "tube" and scene["model"]["kinematics"] in (
        "full",
        "sector",
        "auto",
        "axisymmetric",
    )
    elements = list(COARSE if small else RAY)
    return scene, {**COUNTS, "tube": {"PAPER": elements}}


def _stiff(random: Random) -> tuple[Values, Values]:
    """A loaded tube that remodels, lambda/mu from 50 to 10,000, in any formulation, profile, law and kinematics."""
    wall, mu = rounded(random.uniform(0.2, 2.0)), 3.103
    kinematics = random.choices(("radial", "axisymmetric", "sector", "full"), (12, 4, 2, 1))[0]
    law = random.choice(("tensor", "tensor", "explicit", "rate", "relaxation"))
    couplings = ["staggered"] + ["extrapolated"] * 2 * (law == "tensor")
    pressure = mu * math.log(1 + wall) * random.uniform(0.1, 1.5)
    scene: Values = {
        "name": STIFF_NAME,
        "geometry": {"shape": "tube", "inner_radius": 1.0, "outer_radius": 1 + wall, "length": 2.0},
        "material": {"lame_lambda": rounded(mu * decades(random, 1.7, 4.0)), "lame_mu": mu, "stress_unit": "Pa"},
        "cells": {"initial": "isotropic", "axes": "cylindrical", "end_to_end_length": 1.0},
        "supports": {"ends": "free"},
        "mesh": {
            "formulation": random.choice(("auto", "displacement")), "degree": random.choice((1, 2)), "refinement": 1,
            "element": "tetrahedron" if kinematics in ("sector", "full") and random.random() < 0.5 else "hexahedron",
        },
        "model": {"kinematics": kinematics},
        "remodeling": {
            "law": law, "coupling": random.choice(couplings), "driver": random.choice(("cauchy", "cauchy", "pk2")),
        },
        "loads": ramped(20.0, pressure=rounded(pressure), elongation=rounded(random.uniform(0.0, 0.3))),
        "time": {"end": 40.0, "step": 2.5}, "solver": {"method": "auto"}, "output": {"report": False},
    }  # fmt: skip
    if kinematics in ("radial", "axisymmetric") and random.random() < 0.4:
        scene["profile"] = random.choice(("fast", "balanced", "reference"))
        del scene["mesh"], scene["remodeling"]["coupling"]
        scene["mesh"] = {"element": "hexahedron"}
    return scene, {
        **COUNTS,
        "tube": {"PAPER": list(COARSE if kinematics in ("sector", "full") else RAY)},
    }


def cheap(scene: Values) -> bool:
    """Whether a step costs next to nothing."""
    kinematics = scene["model"]["kinematics"]
    return (
        kinematics in ("point", "radial")
        or scene["geometry"]["shape"] == "cube"
        and kinematics == "auto"
    )


def cost(scene: Values) -> tuple[bool, bool]:
    """To sort by: whether a step costs much, whether there may be many."""
    long = "tolerance" in scene["time"] or scene["time"]["end"] == "equilibrium"
    return not cheap(scene), long


def _geometry(random: Random, shape: str) -> Values:
    size = rounded(random.choice((1.0, 1.0, decades(random, -3, 3))))
    if shape == "cube":
        geometry = {"shape": shape, "side": size}
    elif shape == "tendon":
        geometry = {
            "shape": shape,
            "length": size,
            "area": rounded((size * random.uniform(0.2, 1)) ** 2),
        }
    else:
        wall = decades(random, -1.3, 0.6)
        geometry = {
            "shape": shape,
            "inner_radius": size,
            "outer_radius": rounded(size * (1 + wall)),
        }
        geometry["length"] = rounded(size * random.uniform(0.5, 4))
    if random.random() < 0.3:
        geometry["length_unit"] = random.choice(("m", "cm", "mm", "um"))
    return geometry


def _material(random: Random) -> tuple[Values, float, float]:
    """The table, r0, and a stiffness in the scene's unit of stress."""
    unit, mu = random.choice(list(STRESS_UNITS)), decades(random, -2, 3)
    scale = random.choice((1.0, 1.0, 1.0, 1e-9, 1e-3, 92.4, 1e6))
    length = rounded(scale * random.uniform(1.2, 4))
    r0, persistence = rounded(length * random.uniform(0.2, 0.9)), rounded(
        length * 10 ** random.uniform(-1.3, 0.3)
    )
    network = 0.0 if random.random() < 0.05 else mu * decades(random, -1.5, 1.5)
    temperature, factor = random.choice((310.0, rounded(random.uniform(280, 320)))), random.choice(
        (1, 1, 4)
    )
    pulled = float(secant_stiffness(r0, length)) * r0**2 * factor  # type: ignore[arg-type]
    density = rounded(
        network / pulled * STRESS_UNITS[unit] * 4 * persistence / BOLTZMANN / temperature
    )
    table = {
        "lame_lambda": 0.0 if random.random() < 0.05 else rounded(mu * decades(random, -1, 2.5)), "lame_mu": mu,
        "chain_density": density, "contour_length": length, "persistence_length": persistence,
        "temperature": temperature, "energy_factor": factor, "stress_unit": unit,
    }  # fmt: skip
    return table, r0, 3 * mu + network


def _remodeling(random: Random) -> Values:
    law = random.choices(
        ("explicit", "rate", "relaxation", "tensor", "rotation", "none"), (4, 2, 3, 6, 1, 1)
    )[0]
    couplings = ["staggered", "staggered", "relaxed"] + ["extrapolated"] * 4 * (law == "tensor")
    return {
        "law": law, "driver": random.choices(("cauchy", "pk2", "finger"), (3, 1, 1))[0],
        "frame": random.choice(("material", "spatial")), "coupling": random.choice(couplings),
        "pairing": random.choices(("sorted", "continuous"), (4, 1))[0],
        "relaxation_factor": rounded(random.uniform(0.2, 1)),
    }  # fmt: skip


def _cells(random: Random, shape: str, r0: float) -> Values:
    initial: Any = random.choices(("isotropic", "aligned", "random", "given"), (6, 1, 1, 1))[0]
    if initial == "given":
        drawn = [random.uniform(0.1, 1) for _ in range(3)]
        initial = [r0 * part / math.hypot(*drawn) for part in drawn]
    axes = "cylindrical" if shape == "tube" and random.random() < 0.9 else "global"
    aligned_axis, seed = random.choice((1, 2, 3)), random.randrange(1000)
    # by the seed: a further draw would make every scene another one
    return {
        "initial": initial, "axes": axes, "aligned_axis": aligned_axis, "seed": seed, "antithetic": seed % 2 == 1,
        "end_to_end_length": r0,
    }  # fmt: skip


def _mesh(random: Random, scene: Values) -> tuple[Values, Values]:
    """Degree, formulation and kinematics that fit the scene: what is not the same everywhere is not reduced."""
    shape, cells, remodeling = scene["geometry"]["shape"], scene["cells"], scene["remodeling"]
    same = cells["initial"] != "random" and remodeling["law"] != "rotation"
    kinematics = "full"
    if shape == "tube":
        kinds, free = ["auto"], scene["supports"]["ends"] != "clamped"
        if same and cells["axes"] == "cylindrical":
            kinds += ["radial"] * 12 * free + ["axisymmetric"]
        if same and free and random.random() < 0.2:
            kinds = ["sector"]
        kinematics = random.choice(kinds)
    elif same:
        kinematics = random.choices(("auto", "point", "full"), (2, 3, 1))[0]
    formulation = "displacement"
    if random.random() < 0.15:
        formulation = "selective-integration"
    reduced = kinematics in ("radial", "point")
    mesh = {
        "degree": random.choice((1, 2)) if reduced else 1, "formulation": formulation, "element": "hexahedron",
        "refinement": random.choice((1, 1, 2)) if reduced else 1,
    }  # fmt: skip
    if (
        shape == "cube"
        and kinematics == "full"
        and formulation == "displacement"
        and random.random() < 0.2
    ):
        mesh["element"] = "tetrahedron"
    repulsions = (
        ("log", "length") if remodeling["law"] == "tensor" else ("axes", "axes", "log", "length")
    )
    scene["material"]["repulsion"] = random.choice(repulsions)
    return mesh, {"kinematics": kinematics}


def _time(random: Random, scene: Values) -> Values:
    few = not cheap(scene)
    steps, rate = random.randint(3, 4) if few else random.randint(4, 16), decades(random, -2, 0.2)
    kappa = random.choice((0.025, decades(random, -4, 3)))
    step = rounded(rate / kappa)
    scene["remodeling"] |= {"kappa": kappa, "rotation_time": rounded(step * random.uniform(2, 40))}
    time: Values = {"end": steps * step, "step": step}
    chosen = random.random()
    if (
        chosen < 0.12
        and scene["remodeling"]["law"] in ("explicit", "relaxation", "tensor")
        and not few
    ):
        return {"end": "equilibrium", "step": step} if scene["material"]["chain_density"] else time
    if chosen < 0.3 and not few:
        time["tolerance"] = random.choice((0.5, 1.0, 2.0))
    return time


def _ramp(random: Random, step: float, steps: int) -> list[list[float]]:
    """At once, at the start, late, falling, reversed or in cycles; corners at steps."""
    at = sorted(random.sample(range(1, steps + 1), min(3, steps)))
    a, b, c = (at + [steps + 1, steps + 2])[:3]
    kind = random.choice(
        ("start", "start", "start", "late", "falling", "reversed", "cycles", "at once", "beyond")
    )
    corners = {
        "start": [(0, 0.0), (a, 1.0)], "late": [(a, 0.0), (b, 1.0)],
        "falling": [(0, 0.0), (a, 1.0), (b, 1.0), (c, 0.0)],
        "reversed": [(0, 0.0), (a, 1.0), (c, -0.3)], "cycles": [(0, 0.0), (a, 1.0), (b, 0.2), (c, 1.0)],
        "at once": [(0, 1.0)], "beyond": [(0, 0.0), (2 * steps, 1.0)],
    }[kind]  # fmt: skip
    return [[number * step, factor] for number, factor in corners]


def _loads(random: Random, scene: Values, stiffness: float) -> Values:
    geometry, time = scene["geometry"], scene["time"]
    steps = round(time["end"] / time["step"]) if time["end"] != "equilibrium" else 8
    share = decades(random, -3, 0.3) * random.choices((1, -1), (6, 1))[0]

    def load(value: float) -> Values:
        return {"value": rounded(value), "ramp": _ramp(random, time["step"], steps)}

    if geometry["shape"] != "tube":
        area = geometry["side"] ** 2 if geometry["shape"] == "cube" else geometry["area"]
        return {"force": load(stiffness * area * share)}
    inner, outer = geometry["inner_radius"], geometry["outer_radius"]
    loads = {"pressure": load(stiffness * share * min(1.0, (outer - inner) / inner) / 3)}
    if scene["supports"]["ends"] == "closed":
        loads["elongation"] = {"value": 0.0, "ramp": [[0.0, 0.0]]}
    else:
        if random.random() < 0.8:
            loads["elongation"] = load(random.uniform(-0.05, 0.4))
        else:
            loads["elongation"] = {
                "value": 0.0,
                "ramp": [[0.0, 0.0]],
            }  # a preset's stays where the scene has none
            loads["axial_force"] = load(
                stiffness * math.pi * (outer**2 - inner**2) * random.uniform(-0.02, 0.3)
            )
    return loads


def has_free_length(scene: Values) -> bool:
    """Whether the body's length is an unknown."""
    return scene["supports"].get("ends") == "closed" or "axial_force" in scene["loads"]


def _solver(random: Random, scene: Values) -> Values:
    solver: Values = {
        "method": random.choices(("auto", "direct", "lagged", "iterative"), (3, 3, 1, 1))[0],
        "predictor": random.choice(("none", "autoregressive", "with-tolerance")),
        "relative_tolerance": random.choice((1e-10, 1e-10, 1e-10, 1e-9, 1e-8, 1e-6)),
    }
    if solver["method"] == "iterative" and has_free_length(scene):
        solver["method"] = "auto"  # refused
    if random.random() < 0.1:
        solver |= {
            "maximum_iterations": random.randint(10, 50),
            "maximum_halvings": random.randint(4, 14),
        }
    if scene["model"]["kinematics"] == "full" and random.random() < 0.2:
        solver["unstable"] = "stop"
    if random.random() < 0.05:
        solver["petsc_options"] = {"snes_max_it": 40}
    return solver


def _rarely(random: Random, scene: Values, stiffness: float) -> None:
    """Keys that change no number of a row, or hardly one."""
    time, size = scene["time"], scene["geometry"].get("side", scene["geometry"].get("length"))
    if random.random() < 0.1 and time["end"] != "equilibrium":
        scene["output"]["times"] = [time["step"] * 2]
    if random.random() < 0.3 and "tolerance" in time:
        scene["profile"] = random.choice(("fast", "balanced", "reference"))
    if random.random() < 0.1:
        scene["solver"]["absolute_tolerance"] = rounded(1e-13 * stiffness * size**2)
    if random.random() < 0.1:
        scene |= {"name": f"scene {random.randrange(100)}", "format": 2}
        scene["material"] |= {"matrix": "neo-hookean", "chain": "wormlike"}
    if scene["geometry"]["shape"] == "tube" and random.random() < 0.1:  # two layers of one tissue
        middle = (scene["geometry"]["inner_radius"] + scene["geometry"]["outer_radius"]) / 2
        scene["regions"] = {"inside": {"outer_radius": middle}, "outside": {}}
    if _closes_from_a_sector(scene) and random.random() < 0.3:
        scene["natural"] = {"opening_angle": rounded(random.uniform(0, 120))}
        if random.random() < 0.4:
            along = {"axial": rounded(random.uniform(0.95, 1.1))}
            scene["natural"]["layers"] = [
                {"from": rounded(random.uniform(0.2, 0.8)), "prestretch": along}
            ]
    _exponent_and_threshold(random, scene, stiffness)
    plain = (
        "tolerance" not in scene["time"]
        and "profile" not in scene
        and scene["time"]["end"] != "equilibrium"
    )
    turns = scene["remodeling"]["law"] == "tensor" and scene["remodeling"]["coupling"] in (
        "staggered",
        "extrapolated",
    )
    locked = scene["material"]["contour_length"] <= 1.3 * scene["cells"]["end_to_end_length"]
    if (
        turns
        and plain
        and not locked
        and scene["material"]["chain_density"]
        and random.random() < 0.2
    ):
        numbers = {
            "time": rounded(random.uniform(20, 80)),
            "deposition_stretch": rounded(random.uniform(1.02, 1.2)),
        }
        numbers |= {
            "gain": rounded(random.uniform(0.5, 2)),
            "rates": random.choice(("cauchy", "tension")),
        }
        grows = scene["geometry"]["shape"] == "tube"
        grows = grows and scene.get("mesh", {}).get("formulation", "displacement") == "displacement"
        scene["remodeling"]["turnover"] = numbers | {
            "volume": random.choice((0.0, 0.3, 0.6)) if grows else 0.0
        }
    if (
        _closes_from_a_sector(scene)
        and scene["supports"]["ends"] != "clamped"
        and random.random() < 0.05
    ):
        scene["geometry"]["is"] = "loaded"
        if scene["time"]["end"] == "equilibrium":
            scene.setdefault("natural", {})["cells"] = "equilibrium"
    if "profile" not in scene and "is" not in scene["geometry"]:
        _cases(random, scene)


def _cases(random: Random, scene: Values) -> None:
    """Two load cases, or one that is no other than none; what they follow."""
    if random.random() > 0.15:
        return
    weight = rounded(random.uniform(0.2, 0.8))
    name = random.choice(sorted(scene["loads"]))
    factors = [{"loads": {name: rounded(random.uniform(0.5, 1.0))}}, {}]
    weights = [weight, 1 - weight] if random.random() < 0.7 else [1.0]
    scene["cases"] = [
        {"weight": share} | more for share, more in zip(weights, factors, strict=False)
    ]
    means = ("tensor", "largest") + ("target",) * (scene["remodeling"]["law"] == "tensor")
    scene["remodeling"]["mean"] = random.choice(means)


def _exponent_and_threshold(random: Random, scene: Values, stiffness: float) -> None:
    """Exponent and threshold of the law that has them."""
    remodeling = scene["remodeling"]
    if remodeling["law"] != "tensor":
        return
    if random.random() < 0.15:
        remodeling["exponent"] = random.choice((1.0, 3.0))
    if remodeling["driver"] != "finger" and random.random() < 0.15:
        remodeling["threshold"] = rounded(stiffness * random.uniform(0.01, 0.2))


def _closes_from_a_sector(scene: Values) -> bool:
    """Whether an opening angle goes with all else."""
    uniform = scene["cells"]["initial"] == "isotropic" and scene["cells"]["axes"] == "cylindrical"
    plain = (
        scene["mesh"]["formulation"] == "displacement"
        and "regions" not in scene
        and "profile" not in scene
    )
    return scene["geometry"]["shape"] == "tube" and uniform and plain
