"""docs/figures/turnover.png and turnover_map.png.

What turnover makes of a thin and of a thick wall that start free of stress, on one radius (docs/turnover.md), and for
which gain and deposition stretch they come to rest. Ten minutes.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from docs.making.pages import FIGURES, Columns, by_column, drawn, through_the_wall
from remodel_fenicsx import Scene, Simulation
from remodel_fenicsx.body.shape import columns_on_request
from remodel_fenicsx.results.columns import Measurement
from remodel_fenicsx.scene.scene import scene_from_dict
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.studies.page import COLOURS, Page, panel_letters, read_table
from tests.runs import made, simulated

TIME, STEP, TOLERANCE, RAMP_END = 40.0, 4.0, 1.0, 24.0  # of turnover; the first step; degrees, of chosen steps
END = 60 * TIME
AT_REST = 2.5e-4 / TIME  # largest d ln m/dt, d ln rho/dt; steps of half a T leave 2e-4 of rounding and error
SLOW = 40 * TIME  # what rests later rests slowly
WIDE = 10.0  # times the outer radius at the start: far beyond any vessel
FASTER = 1.1  # the rates at the end over their least: from where on growth speeds up
STRETCHES = (1.05, 1.1, 1.15, 1.2, 1.3)
GAINS = (0.2, 0.35, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0)


class Wall(NamedTuple):
    """A tube with an inner radius of 1, and its pressure."""

    outer_radius: float
    pressure: float


WALLS = {"thin": Wall(1.3, 1.2), "thick": Wall(3.0, 4.8)}
GROWN = (
    "Turnover in walls that start free of stress",
    "a: opening angle of a cut over time; b: hoop stress under load over the depth in the wall, after turnover and "
    "without it; c: fibre angle, 0 is circumferential. Walls of 1 to 1.3 under a pressure of 1.2 and of 1 to 3 under "
    "4.8, elongation 10 %, T = 40, deposition stretch 1.1, gain 1, law tensor, isotropic cells at t = 0, one radius.",
)
MAP = (
    "Where turnover comes to rest",
    "By gain and deposition stretch: opening angle at rest in degrees, below 0 where a cut ring would overlap; an "
    "asterisk where it rests after 40 T only; 'slower' where the wall still dilates at 60 T, ever more slowly, "
    "'faster' where it dilates faster and faster. Law tensor, T = 40, chosen steps (tolerance 1), isotropic cells at "
    "t = 0, one radius, elongation 10 %.",
)


def scene_of(wall: Wall, turnover: dict[str, float] | None, end: float = END, **remodeling: Any) -> Scene:
    """A wall on one radius."""
    ramp = [[0.0, 0.0], [RAMP_END, 1.0]]
    loads = {"pressure": wall.pressure, "elongation": 0.1}
    as_before = {"rates": "tension", "volume": 0.0}  # what the page is about
    turned = {"turnover": {"time": TIME} | as_before | turnover} if turnover else {}
    return scene_from_dict({
        "preset": "consistent",
        "geometry": {"shape": "tube", "inner_radius": 1.0, "outer_radius": wall.outer_radius, "length": 2.0},
        "model": {"kinematics": "radial"}, "mesh": {"refinement": 2, "degree": 2}, "cells": {"initial": "isotropic"},
        "remodeling": turned | remodeling,
        "loads": {name: {"value": value, "ramp": ramp} for name, value in loads.items()},
        "time": {"end": end, "step": STEP, "tolerance": TOLERANCE},
        "output": {"fields": False, "columns": ["outer_radius"]},
    })  # fmt: skip


def opening_angle(simulation: Simulation, step: Any) -> float:
    """Of a cut of the state after this step, degrees."""
    column = columns_on_request(simulation.scene.geometry)["opening_angle"]
    return float(column.value(Measurement(simulation.observer, step)))


# ---------------------------------------------------------------- the map
def outcome(wall: Wall, stretch: float, gain: float) -> dict[str, Any]:
    """How a wall ends: as a row of the map's table."""
    least, rate = np.inf, np.inf
    found = {"time": 0.0, "outer_radius": wall.outer_radius, "opening_angle": np.nan}
    with made(scene_of(wall, {"deposition_stretch": stretch, "gain": gain})) as simulation:
        try:
            for step in simulation.steps():
                found |= {"time": step.time, "outer_radius": step.row["outer_radius"]}
                rate = float(np.abs(simulation.stepper.turnover.rates()).max())  # of content and natural length
                if step.time > RAMP_END:
                    least = min(least, rate)
                    if rate < AT_REST:
                        found["opening_angle"] = opening_angle(simulation, step)
                        return {"outcome": "rests" if step.time <= SLOW else "rests slowly"} | found
                if step.row["outer_radius"] > WIDE * wall.outer_radius:
                    break
        except StepFailure as failure:
            print(f"{wall}, stretch {stretch}, gain {gain}: {failure}")
            return {"outcome": "faster"} | found
    return {"outcome": "faster" if rate > FASTER * least else "slower"} | found


def map_of_walls() -> Iterator[dict[str, Any]]:
    """All outcomes."""
    for name, wall in WALLS.items():
        for stretch in STRETCHES:
            for gain in GAINS:
                yield {"wall": name, "deposition_stretch": stretch, "gain": gain} | outcome(wall, stretch, gain)


def draw_map(table: Columns) -> Figure:
    """A panel for each wall, with the opening angle in each field."""
    figure = Figure(figsize=(7.2, 3.6), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for axes, (name, wall) in zip(panels, WALLS.items(), strict=True):
        here = table["wall"] == name
        image = _map(axes, {key: values[here] for key, values in table.items()})
        axes.set(title=f"wall of 1 to {wall.outer_radius:g}, pressure {wall.pressure:g}")
        axes.set_xlabel("deposition stretch")
    panels[0].set_ylabel("gain")
    figure.colorbar(image, ax=panels, label="opening angle at rest, degrees", extend="min")
    panel_letters(*panels)
    return figure


def _map(axes: Axes, table: dict[str, Any]) -> Any:
    shape = len(STRETCHES), len(GAINS)
    angles, outcomes = table["opening_angle"].reshape(shape), table["outcome"].reshape(shape)
    image = axes.imshow(angles.T, origin="lower", aspect="auto", cmap="viridis", vmin=0.0, vmax=180.0)
    for i, j in np.ndindex(shape):
        if np.isnan(angles[i, j]):
            text, colour = outcomes[i, j], {"slower": "0.35", "faster": COLOURS[1]}[outcomes[i, j]]
        else:
            text = f"{angles[i, j]:.0f}" + ("*" if outcomes[i, j] == "rests slowly" else "")
            colour = "white" if angles[i, j] < 110 else "black"
        axes.text(i, j, text, ha="center", va="center", fontsize=6.5, color=colour)
    axes.set_xticks(range(shape[0]), [f"{stretch:g}" for stretch in STRETCHES])
    axes.set_yticks(range(shape[1]), [f"{gain:g}" for gain in GAINS])
    return image


# ---------------------------------------------------------------- what comes of a wall
UNIT_GAIN = {"deposition_stretch": 1.1, "gain": 1.0}
TO_REST = 1440.0


def opening() -> Iterator[dict[str, Any]]:
    """Opening angle over time, of both walls, with cells that turn and without."""
    for name, wall in WALLS.items():
        for cells, kappa in (("turn", {}), ("fixed", {"kappa": 0.0})):
            with made(scene_of(wall, UNIT_GAIN, TO_REST, **kappa)) as simulation:
                for step in simulation.steps():
                    angle = opening_angle(simulation, step)
                    yield {"wall": name, "cells": cells, "time": step.time, "angle": angle}


def walls_at_rest() -> Columns:
    """Depth, hoop stress and fibre angle, of both walls at the end with turnover and without."""
    table: Columns = {}
    for name, wall in WALLS.items():
        for how, turnover in (("with", UNIT_GAIN), ("without", None)):
            with simulated(scene_of(wall, turnover, TO_REST)) as (simulation, _):
                found = through_the_wall(simulation)
            table["depth"] = found["depth"]
            table |= {f"{what}_{name}_{how}": found[what] for what in ("stress", "angle")}
    return table


def draw(over_time: Columns, table: Columns) -> Figure:
    """Three panels: opening angle over time, stress and angle over the depth."""
    figure = Figure(figsize=(7.2, 3.1), layout="constrained")
    panels = figure.subplots(1, 3)
    for colour, (name, wall) in zip(COLOURS, WALLS.items(), strict=False):
        label = f"wall of 1 to {wall.outer_radius:g}"
        for cells, line in (("turn", "-"), ("fixed", "--")):
            here = (over_time["wall"] == name) & (over_time["cells"] == cells)
            panels[0].plot(over_time["time"][here], over_time["angle"][here], line, color=colour)
        for axes, what in zip(panels[1:], ("stress", "angle"), strict=True):
            axes.plot(table["depth"], table[f"{what}_{name}_with"], color=colour, label=label)
            axes.plot(table["depth"], table[f"{what}_{name}_without"], ":", color=colour)
    panels[0].set(xlabel="time", ylabel="opening angle, degrees", ylim=(0, None))
    panels[1].set(xlabel="depth in the wall", ylabel="hoop stress under load", yscale="log")
    panels[2].set(xlabel="depth in the wall", ylabel="fibre angle, degrees", ylim=(0, 90))
    styles = {"turnover": "-", "cells that do not turn": "--", "no turnover": ":"}
    handles = [*panels[2].get_lines()[::2], *(Line2D([], [], color="0.3", ls=style) for style in styles.values())]
    labels = [*(str(line.get_label()) for line in handles[:2]), *styles]
    figure.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=7)
    panel_letters(*panels)
    return figure


def make(keep: bool) -> None:
    """Tables and pictures."""
    grown, of_map = Page(FIGURES, "turnover", *GROWN), Page(FIGURES, "turnover_map", *MAP)
    if not keep:
        grown.save_table(by_column(opening()), list(GROWN), "time")
        grown.save_table(walls_at_rest(), list(GROWN))
        of_map.save_table(by_column(map_of_walls()), list(MAP))
    drawn(grown, draw, read_table(FIGURES / "turnover-time.csv"), read_table(FIGURES / "turnover.csv"))
    drawn(of_map, draw_map, read_table(FIGURES / "turnover_map.csv"), **{"axes.grid": False})
