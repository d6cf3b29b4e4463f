"""What must hold in every row of a run, and what a reference of one dimension makes of a scene, where it can.

The reference is typed from docs/theory.md on top of tests/reference/radial.py and `stability_map.point`: a cube or bar
is one point, a tube is divided along its radius; axes stay, so that cells are three squares by direction.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from benchmarks.fuzzing.scenes import STRESS_UNITS, Values
from benchmarks.stability_map.cases import Finding, Run
from benchmarks.stability_map.homogeneous import factor, initial, material, step_times
from benchmarks.stability_map.point import Array, NoEquilibrium, advance
from tests.reference.radial import RadialMaterial, Tube, cauchy_stress, driving_values, remodel, stress_noise

COUNTS = 0.01  # a target with a smaller share is none to go on from
COMPRESSION = 0.1
SETTLED, PASSES = 1e-10, 300  # of an implicit step by repeated passes: change of the squares over r0^2; how many
POINT_TOLERANCE, ROUNDING = 1e-5, 1e-9  # of stretches; of radii
# Of the largest displacement. That elements lack more than 5 % of it is warned of, by an estimate; eight linear ones
# around, half of what scenes have, are off by 10 % where nothing locks
WALL_TOLERANCE, POLYGON_TOLERANCE = 0.08, 0.2


# ---------------------------------------------------------------- bodies of one dimension
class Bar:
    """A cube or bar: one point under a dead force along z; its unknown are the stretches."""

    def __init__(self, scene: Values, m: RadialMaterial):
        g = scene["geometry"]
        self.area, self.material, self.start, self.points = g.get("area", g.get("side", 1.0) ** 2), m, np.ones(3), 1

    def solve(self, unknown: Array, old: tuple[Array, Values], new: tuple[Array, Values]) -> Array:
        """Equilibrium with other squares and loads."""
        before, after = (np.array([0.0, 0.0, loads["force"] / self.area]) for _, loads in (old, new))
        return advance(unknown, (old[0], before), (new[0], after), self.material)

    def stretches(self, unknown: Array, loads: Values) -> Array:
        """(1, 3)"""
        return unknown[None]


class Wall:
    """A tube with free ends and a given length; its unknown are the radii of the nodes."""

    def __init__(self, scene: Values, m: RadialMaterial):
        g = scene["geometry"]
        self.tube = Tube(g["inner_radius"], g["outer_radius"], 40, m)
        self.start, self.points = self.tube.nodes.copy(), len(self.tube.points)

    def solve(self, unknown: Array, old: tuple[Array, Values], new: tuple[Array, Values]) -> Array:
        """Equilibrium with other squares and loads."""
        states = [(squares, loads["pressure"], 1 + loads["elongation"]) for squares, loads in (old, new)]
        try:
            return self.tube.advance(unknown, *states)
        except (RuntimeError, ValueError, np.linalg.LinAlgError) as error:
            raise NoEquilibrium(str(error)) from error

    def stretches(self, unknown: Array, loads: Values) -> Array:
        """(points, 3)"""
        return self.tube.stretches(unknown, 1 + loads["elongation"])


def parameters(scene: Values) -> RadialMaterial:
    """Of the reference, stresses in the scene's unit."""
    m, table = material(scene), scene["material"]
    return replace(m, network_modulus=m.network_modulus * table["energy_factor"] / STRESS_UNITS[table["stress_unit"]])


def known(scene: Values) -> bool:
    """Whether the reference can do it: axes that stay, the repulsions that agree then, equal steps, paired by rank."""
    r, g, time = scene["remodeling"], scene["geometry"]["shape"], scene["time"]
    lags = r["coupling"] == "relaxed" and r["law"] in ("rate", "relaxation")  # slower than its law says
    # across a bar two values agree: which of them has which rank matters where the old cells tell x from y, and stay
    lags |= r["coupling"] == "relaxed" and g != "tube" and scene["cells"]["initial"] != "isotropic"
    return (
        r["law"] != "rotation" and not lags and (r["pairing"] == "sorted" or r["law"] in ("tensor", "none"))
        and "tolerance" not in time and time["end"] != "equilibrium" and scene["material"]["repulsion"] != "length"
        and scene["cells"]["initial"] != "random"
        and scene["cells"]["axes"] == ("cylindrical" if g == "tube" else "global")
        and (g != "tube" or scene["supports"]["ends"] == "free" and "axial_force" not in scene["loads"])
    )  # fmt: skip


# ---------------------------------------------------------------- through time
class Row(NamedTuple):
    """A solved state: unknown of the body, squares (points, 3) of its cells."""

    time: float
    unknown: Array
    squares: Array


class Pass:
    """The evolution laws at points with axes that stay: from squares (points, 3) to squares."""

    def __init__(self, scene: Values, points: int):
        self.r, self.material = scene["remodeling"], parameters(scene)
        self.r0, self.law = self.material.end_to_end_length, self.r["law"]
        self.start = np.tile(initial(scene), (points, 1))
        self.ranked, self.ranks = self.start.copy(), np.tile([0, 1, 2], (points, 1))
        self.share = self.r["relaxation_factor"] if self.r["coupling"] == "relaxed" else 1.0
        self.targets: list[tuple[float, Array]] = []  # time and sE of solved states, the last one first
        self.begun = np.zeros(points, bool)  # points whose last target stands alone

    def values(self, stretches: Array, squares: Array) -> tuple[Array, float]:
        """Of the driver by direction, and what of them is rounding."""
        driver = self.r["driver"]
        noise = 0.0 if driver == "finger" else stress_noise(stretches, squares, self.material)
        return driving_values(driver, stretches, cauchy_stress(stretches, squares, self.material)), noise

    def target(self, stretches: Array, squares: Array) -> Array:
        """sE of the law `tensor`."""
        values, noise = self.values(stretches, squares)
        tension, compression = np.maximum(values, 0) ** 2, np.minimum(values, 0) ** 2
        total = tension.sum(axis=1) + COMPRESSION**2 * compression.sum(axis=1) + (100 * noise) ** 2
        return np.asarray(tension / total[:, None])

    def followed(self, squares: Array, target: Array, rate: float) -> Array:
        """dA/dt = kappa (r0^2 sE - s A) with sE kept."""
        share = np.clip(target.sum(axis=1, keepdims=True), 0.0, 1.0)
        direction = target / np.where(share > 0, target.sum(axis=1, keepdims=True), 1.0)
        return np.where(share > 0, squares + (self.r0**2 * direction - squares) * -np.expm1(-rate * share), squares)

    def after(self, stretches: Array, squares: Array, old: Array, time: float, step: float) -> tuple[Array, Any]:
        """Squares that a pass makes of `old` under the stress of a state, and what to keep if it is the last one."""
        if self.law == "tensor":
            asked = self.followed(old, self.target(stretches, squares), self.r["kappa"] * step)
            return old + self.share * (asked - old), (self.ranked, self.ranks)
        values, noise = self.values(stretches, squares)
        ranked, ranks = remodel(
            self.ranked, values, self.ranks, self.start, self.law, self.r["kappa"], time, step, self.r0, noise
        )
        asked = np.empty_like(ranked)
        np.put_along_axis(asked, ranks, ranked, axis=1)
        new = old + self.share * (asked**2 - old)
        if self.share < 1.0:  # rank is the order of A's eigenvalues; where they agree the pass's ranks stay
            by_rank = np.take_along_axis(new, ranks, axis=1)
            order = np.argsort(-np.round(by_rank / self.r0**2, 12), axis=1, kind="stable")
            ranks = np.take_along_axis(ranks, order, axis=1)
            ranked = np.sqrt(np.take_along_axis(new, ranks, axis=1))
        return new, (ranked, ranks)

    def ahead(self, time: float) -> Array:
        """sE in the middle of the step to `time`, along the line through two states."""
        (last, now), *earlier = self.targets
        if not earlier:
            return now
        slope = (time - last) / 2 / (last - earlier[0][0])
        return now + np.where(self.begun[:, None], 0.0, slope * (now - earlier[0][1]))


def march(scene: Values, body: Any) -> tuple[list[Row], str]:
    """The rows, and why there are no more."""
    cells, times, coupling = Pass(scene, body.points), step_times(scene), scene["remodeling"]["coupling"]
    names = ("force",) if isinstance(body, Bar) else ("pressure", "elongation")
    unknown, squares, rows, before = body.start, cells.start**2, [], 0.0
    loads: Values = dict.fromkeys(names, 0.0)
    for time in map(float, times):
        new = {name: _load(scene, name, time) for name in names}
        step, start = time - before, squares
        if coupling == "extrapolated" and cells.targets:
            expected = cells.ahead(time)
            squares = cells.followed(start, expected, cells.r["kappa"] * step)
            if np.any(squares < 0):
                return rows, "unknown: an extrapolated target makes A indefinite"
        try:
            unknown = body.solve(unknown, (start, loads), (squares, new))
            for number in range(PASSES if coupling == "implicit" else 0):
                other, kept = cells.after(body.stretches(unknown, new), squares, start, time, step)
                change = np.abs(other - squares).max() / cells.r0**2
                unknown, squares = body.solve(unknown, (squares, new), (other, new)), other
                if change < SETTLED:
                    cells.ranked, cells.ranks = kept
                    break
                if number == PASSES - 1:
                    return rows, "unknown: repeated passes do not settle"
            if coupling == "extrapolated":
                found = cells.target(body.stretches(unknown, new), squares)
                had = cells.targets[0][1] if cells.targets else np.zeros_like(found)
                cells.begun = (had.sum(axis=1) < COUNTS) & (found.sum(axis=1) >= COUNTS)
                if cells.begun.any():
                    mixed = np.where(cells.begun[:, None], found, expected if cells.targets else 0.0)
                    other = cells.followed(start, mixed, cells.r["kappa"] * step)
                    unknown, squares = body.solve(unknown, (squares, new), (other, new)), other
                    found = cells.target(body.stretches(unknown, new), squares)
                cells.targets = [(time, found), *cells.targets[:1]]
        except NoEquilibrium as error:
            return rows, f"no equilibrium at t = {time:g}: {error}"
        rows.append(Row(time, unknown, squares))
        if coupling in ("staggered", "relaxed"):
            squares, (cells.ranked, cells.ranks) = cells.after(
                body.stretches(unknown, new), squares, squares, time, step
            )
        loads, before = new, time
    return rows, ""


def _load(scene: Values, name: str, time: float) -> float:
    load = scene["loads"].get(name, {"value": 0.0, "ramp": [[0.0, 0.0]]})
    return float(load["value"] * factor(load["ramp"], np.array([time]))[0])


def compared(scene: Values, run: Run) -> Finding:
    """A run held against the reference, as far as both go."""
    tube = scene["geometry"]["shape"] == "tube"
    rows, ended = march(scene, (Wall if tube else Bar)(scene, parameters(scene)))
    number = min(len(rows), len(run.column("time")))
    if number == 0 or ended.startswith("unknown"):
        return Finding(np.nan, ended or "no row", solvable=not ended)
    off = {}
    if tube:
        radii = np.array([row.unknown[[0, -1]] for row in rows[:number]])
        start = np.array([scene["geometry"]["inner_radius"], scene["geometry"]["outer_radius"]])
        moved = np.abs(radii - start).max() + ROUNDING * start[1]
        allowed = POLYGON_TOLERANCE if scene["model"]["kinematics"] in ("sector", "full") else WALL_TOLERANCE
        for i, name in enumerate(("inner_radius", "outer_radius")):
            off[name] = np.abs(run.column(name)[:number] - radii[:, i]).max() / moved / allowed
    else:
        stretch, squares = (np.array([row[i] for row in rows[:number]]) for i in (1, 2))
        off["mean_stretch"] = np.abs(run.column("mean_stretch")[:number] / stretch[:, 2] - 1).max() / POINT_TOLERANCE
        across = np.sqrt(squares[:, 0, :2].sum(axis=1))
        angle = np.degrees(np.arctan2(across, np.sqrt(squares[:, 0, 2])))
        off["mean_fibre_angle"] = np.abs(run.column("mean_fibre_angle")[:number] - angle).max() / POINT_TOLERANCE / 100
    name = max(off, key=lambda key: off[key])
    ratio = np.inf if ended and run.code == 0 else off[name]
    return Finding(float(ratio), f"reference: {name} off by {off[name]:.3g} tolerances {ended}", None, not ended)


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
    if np.any(np.diff(times) <= 0) or run.code == 0 and end != "equilibrium" and not np.isclose(times[-1], end):
        found.append(f"times {times[0]:g} to {times[-1]:g} for {end}")
    found += [f"{name} is not finite" for name, values in history.items() if np.isinf(values).any()]
    if np.nanmax(history["max_chain_extension"]) >= 1 or np.nanmin(history["min_jacobian"]) <= 0:
        found.append("r >= L or J <= 0")
    found_length = scene["supports"]["ends"] == "closed" or "axial_force" in scene["loads"]
    for name, load in scene["loads"].items() if end != "equilibrium" else ():
        if name == "elongation" and found_length:
            continue
        column = history.get("axial_elongation" if name == "elongation" else name, np.full(len(times), np.nan))
        asked = load["value"] * factor(load["ramp"], times)
        near = 1e-4 if name == "axial_force" else 1e-9  # the one is that of the wall, as solved
        if np.nanmax(np.abs(column - asked)[1:], initial=0.0) > near * max(map(abs, asked)):
            found.append(f"{name} is not its ramp")
    r0 = scene["cells"]["end_to_end_length"]
    if run.fields.get("cell_dimensions"):
        trace = np.sum(np.array(run.fields["cell_dimensions"]) ** 2, axis=1) / r0**2
        exact = scene["remodeling"]["law"] in ("tensor", "none", "rotation")
        bounded = scene["remodeling"]["law"] != "rate"  # eq. (10) adds up whatever its targets were
        if bounded and trace.max() > 1 + 1e-5 or exact and trace.min() < 1 - 1e-5:
            found.append(f"tr A between {trace.min():.7g} and {trace.max():.7g} r0^2")
    if scene["remodeling"]["law"] == "none" and end != "equilibrium":
        loads = [history[name] for name in ("force", "pressure", "axial_elongation") if name in history]
        held = np.all(np.diff(loads, axis=1) == 0, axis=0)
        change = np.abs(np.diff(history["stored_energy"]))[held]
        if (
            "axial_force" not in scene["loads"]
            and change.max(initial=0.0) > 1e-5 * np.abs(history["stored_energy"]).max()
        ):
            found.append("energy changes under held loads without remodeling")
    return found
