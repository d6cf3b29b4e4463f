"""What must hold in every row of a run, and what `stability_map.march` makes of a scene, where it can."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.fuzzing.scenes import STIFF_NAME, Values
from benchmarks.stability_map.cases import Finding, Run, farthest
from tests.reference.march import Bar, Wall, factor, march, slowed

POINT_TOLERANCE, ROUNDING = 1e-5, 1e-9  # of stretches; of radii
# Of the largest displacement. That elements lack more than 5 % of it is warned of, by an estimate; eight linear ones
# around, half of what scenes have, are off by 10 % where nothing locks
WALL_TOLERANCE, POLYGON_TOLERANCE = 0.08, 0.2
# Ratio of radii for which these hold. At 4.3 the motion of the inner one is 15, 5.3, 1.4 % off with 4, 8 (what scenes
# have) and 16 elements through the wall: of second order in their size over the radius
PAPERS_RATIO = 3.0


def known(scene: Values) -> bool:
    """Whether the reference can do it: axes that stay, no residual stress, equal steps, sorted values."""
    if (
        scene.get("name") == STIFF_NAME
    ):  # its elements have noise of its own in a bulk as stiff as that
        return False
    r, g, time = scene["remodeling"], scene["geometry"]["shape"], scene["time"]
    lags = slowed(scene)
    # across a bar two values agree: which of them has which rank matters where the old cells tell x from y, and stay
    lags |= r["coupling"] == "relaxed" and g != "tube" and scene["cells"]["initial"] != "isotropic"
    return (
        r["law"] != "rotation" and not lags and (r["pairing"] == "sorted" or r["law"] in ("tensor", "none"))
        and "tolerance" not in time and time["end"] != "equilibrium" and scene["material"]["repulsion"] != "length"
        and scene["cells"]["initial"] != "random" and "natural" not in scene
        and "is" not in scene["geometry"] and "turnover" not in r and "cases" not in scene
        and r.get("exponent", 2.0) == 2.0 and not r.get("threshold")
        and scene["cells"]["axes"] == ("cylindrical" if g == "tube" else "global")
        and (g != "tube" or scene["supports"]["ends"] == "free" and "axial_force" not in scene["loads"])
    )  # fmt: skip


def compared(scene: Values, run: Run) -> Finding:
    """A run held against the reference, as far as both go."""
    tube = scene["geometry"]["shape"] == "tube"
    path = march(scene, Wall(scene) if tube else Bar(scene))
    number, ended = min(len(path.times), len(run.column("time"))), path.ended
    if number == 0 or ended.startswith("unknown"):
        return Finding(np.nan, ended or "no row", solvable=not ended)
    off = {}
    if tube:
        radii = np.stack(path.faces(), axis=1)[:number]
        start = np.array([scene["geometry"]["inner_radius"], scene["geometry"]["outer_radius"]])
        moved = np.abs(radii - start).max() + ROUNDING * start[1]
        allowed = (
            POLYGON_TOLERANCE
            if scene["model"]["kinematics"] in ("sector", "full")
            else WALL_TOLERANCE
        )
        allowed *= max(1.0, (start[1] / start[0] - 1) / (PAPERS_RATIO - 1)) ** 2
        for i, name in enumerate(("inner_radius", "outer_radius")):
            off[name] = np.abs(run.column(name)[:number] - radii[:, i]).max() / moved / allowed
    else:
        stretch = np.array(path.unknowns)[:number, 2]
        off["mean_stretch"] = (
            np.abs(run.column("mean_stretch")[:number] / stretch - 1).max() / POINT_TOLERANCE
        )
        turned = np.abs(run.column("mean_fibre_angle")[:number] - path.angle()[:number]).max()
        off["mean_fibre_angle"] = turned / POINT_TOLERANCE / 100
    found = farthest(off, "reference: ", solvable=not ended)
    return replace(found, ratio=np.inf) if ended and run.code == 0 else found


# ---------------------------------------------------------------- what must hold in every row
def broken(scene: Values, run: Run) -> list[str]:
    """What does not, in words."""
    found, history = [], {name: np.array(values) for name, values in run.history.items()}
    if run.code not in (0, 2, 3):
        return [f"exit code {run.code}"]
    if "Traceback" in run.said or run.code == 2 and len(run.said.strip().splitlines()) != 1:
        return [f"not one line: {run.said[-300:]}"]
    if not len(history.get("time", ())):
        return []
    times, end = history["time"], scene["time"]["end"]
    if (
        np.any(np.diff(times) <= 0)
        or run.code == 0
        and end != "equilibrium"
        and not np.isclose(times[-1], end)
    ):
        found.append(f"times {times[0]:g} to {times[-1]:g} for {end}")
    found += [f"{name} is not finite" for name, values in history.items() if np.isinf(values).any()]
    if np.nanmax(history["max_chain_extension"]) >= 1 or np.nanmin(history["min_jacobian"]) <= 0:
        found.append("r >= L or J <= 0")
    found_length = scene["supports"]["ends"] == "closed" or "axial_force" in scene["loads"]
    first = scene.get("cases", [{}])[0].get("loads", {})  # columns are those of the first case
    for name, load in scene["loads"].items() if end != "equilibrium" else ():
        if name == "elongation" and found_length:
            continue
        column = history.get(
            "axial_elongation" if name == "elongation" else name, np.full(len(times), np.nan)
        )
        asked = load["value"] * first.get(name, 1.0) * factor(load["ramp"], times)
        near = 1e-4 if name == "axial_force" else 1e-9  # the one is that of the wall, as solved
        if np.nanmax(np.abs(column - asked)[1:], initial=0.0) > near * max(map(abs, asked)):
            found.append(f"{name} is not its ramp")
    r0 = scene["cells"]["end_to_end_length"]
    if (
        "cell_dimensions" in run.fields and scene["material"]["chain_density"]
    ):  # without chains they are zero
        trace = np.sum(np.array(run.fields["cell_dimensions"]) ** 2, axis=1) / r0**2
        exact = scene["remodeling"]["law"] in ("tensor", "none", "rotation")
        bounded = scene["remodeling"]["law"] != "rate"  # eq. (10) adds up whatever its targets were
        if bounded and trace.max() > 1 + 1e-5 or exact and trace.min() < 1 - 1e-5:
            found.append(f"tr A between {trace.min():.7g} and {trace.max():.7g} r0^2")
    if scene["remodeling"]["law"] == "none" and end != "equilibrium":
        loads = [
            history[name] for name in ("force", "pressure", "axial_elongation") if name in history
        ]
        held = np.all(np.diff(loads, axis=1) == 0, axis=0)
        change = np.abs(np.diff(history["stored_energy"]))[held]
        if (
            "axial_force" not in scene["loads"]
            and change.max(initial=0.0) > 1e-5 * np.abs(history["stored_energy"]).max()
        ):
            found.append("energy changes under held loads without remodeling")
    return found
