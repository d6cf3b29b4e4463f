"""The two pictures of docs/turnover.md and their tables, in ten minutes.

Four tubes on one radius, with opening angles of 0 to 160 degrees; and for which gain and deposition stretch a thin and
a thick wall that start free of stress come to rest.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from docs.making.pages import FIGURES, Columns, by_column, drawn, panel_letters, read_table
from remodel_fenicsx import Scene, Simulation
from remodel_fenicsx.body.shape import columns_on_request
from remodel_fenicsx.results.columns import Measurement
from remodel_fenicsx.scene.scene import scene_from_dict
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.studies.study import COLOURS, Page
from tests.runs import made

NO_ANGLE = {"rests": "no cut", "rests slowly": "no cut*"}  # whose cut was not solved
OPENING_ANGLES = (0, 60, 120, 160)  # degrees
LOOKS = [
    {"color": colour, "linestyle": line}
    for colour, line in zip(COLOURS, ("-", "--", "-.", ":"), strict=False)
]
RESIDUAL = (
    "Residual stress and the fibre angle of the paper's artery",
    "a: hoop stress without load, before any remodeling; b: under the paper's loads at t = 150; c: fibre angle at "
    "t = 150, 0 is circumferential. Isotropic cells at t = 0, one radius, for opening angles of 0 to 160 degrees.",
)
TIME, STEP, TOLERANCE, RAMP_END = (
    40.0,
    4.0,
    1.0,
    24.0,
)  # of turnover; the first step; degrees, of chosen steps
END = 60 * TIME
AT_REST = (
    2.5e-4 / TIME
)  # largest d ln m/dt, d ln rho/dt; steps of half a T leave 2e-4 of rounding and error
SLOW = 40 * TIME  # what rests later rests slowly
WIDE = 10.0  # times the outer radius at the start: far beyond any vessel
FASTER = 1.1  # the rates at the end over their least: from where on growth speeds up
STRETCHES = (1.05, 1.1, 1.15, 1.2, 1.3)
GAINS = (0.2, 0.35, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0)


# ---------------------------------------------------------------- residual stress
def through_the_wall(simulation: Simulation) -> Columns:
    """Radius without load, depth, hoop stress and fibre angle at the points of a tube as it is, by radius."""
    cells, local = simulation.cells, simulation.cells.local_axes
    found = {
        "radius": local.coordinates[..., 0],
        "depth": local.depth,
        "stress": simulation.stepper.remodeling.driving_tensor()[1][:, 1, 1],
        "angle": simulation.scene.geometry.fibre_angle(
            cells.dimension_values, cells.axis_values, local.axes
        ),
    }
    order = np.argsort(found["radius"].reshape(-1))
    return {name: values.reshape(-1)[order] for name, values in found.items()}


def residual(opening_angle: float) -> Columns:
    """Radius without load, hoop stress without load and at t = 150, and fibre angle at t = 150, at the points."""
    scene = scene_from_dict({
        "preset": "kuhl-holzapfel-2007", "geometry": {"shape": "tube"}, "mesh": {"refinement": 2, "degree": 2},
        "model": {"kinematics": "radial"}, "cells": {"initial": "isotropic"},
        "natural": {"opening_angle": opening_angle}, "output": {"fields": False},
    })  # fmt: skip
    with made(scene) as simulation:
        before = through_the_wall(simulation)
        list(simulation.steps())
        after = through_the_wall(simulation)
    found = {"unloaded": before["stress"], "loaded": after["stress"], "angle": after["angle"]}
    return {"radius": before["radius"]} | {
        f"{name}_{opening_angle}": values for name, values in found.items()
    }


def draw_walls(table: Columns) -> Figure:
    """Three panels over the radius, a curve for each opening angle."""
    figure = Figure(figsize=(7.2, 3.0), layout="constrained")
    panels = figure.subplots(1, 3)
    labels = {
        "unloaded": "hoop stress at t = 0, unit of μ",
        "loaded": "hoop stress at t = 150, unit of μ",
        "angle": "fibre angle at t = 150, degrees",
    }
    for letter, axes, (name, label) in zip("abc", panels, labels.items(), strict=True):
        axes.set_title(letter, loc="left", fontweight="bold")
        for look, opening_angle in zip(LOOKS, OPENING_ANGLES, strict=True):
            axes.plot(
                table["radius"],
                table[f"{name}_{opening_angle}"],
                **look,
                label=f"{opening_angle}°",
            )
        axes.set(xlabel="unloaded radius (lumen: 1)", ylabel=label, xlim=(1, 3))
    panels[1].set_yscale("log")
    panels[1].set_yticks((1, 3, 10, 30))
    panels[1].minorticks_off()
    panels[1].yaxis.set_major_formatter("{x:g}")
    panels[2].set(ylim=(0, 90), yticks=range(0, 91, 15))
    panels[0].legend(title="opening angle", fontsize=7)
    return figure


# ---------------------------------------------------------------- turnover
class Wall(NamedTuple):
    """A tube with an inner radius of 1, and its pressure."""

    outer_radius: float
    pressure: float


WALLS = {"thin": Wall(1.3, 1.2), "thick": Wall(3.0, 4.8)}
MAP = (
    "Where turnover comes to rest",
    "By gain and deposition stretch: opening angle in equilibrium in degrees, below 0 if a cut ring would overlap; an "
    "asterisk: equilibrium after 40 T only; 'slower': the wall still dilates at 60 T, ever more slowly; 'faster' "
    "(hatched): it dilates faster and faster; 'no cut': equilibrium, but the cut ring was not solved. Law tensor, T = 40, adaptive steps (tolerance 1), isotropic cells at "
    "t = 0, one radius, elongation 10 %.",
)


def scene_of(
    wall: Wall, turnover: dict[str, float] | None, end: float = END, **remodeling: Any
) -> Scene:
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
                rate = float(
                    np.abs(simulation.stepper.process("turnover").rates()).max()
                )  # of content and natural length
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
                yield {"wall": name, "deposition_stretch": stretch, "gain": gain} | outcome(
                    wall, stretch, gain
                )


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
    label = "opening angle in equilibrium, degrees"
    figure.colorbar(image, ax=panels, label=label, extend="min")
    panel_letters(*panels)
    return figure


def _map(axes: Axes, table: dict[str, Any]) -> Any:
    shape = len(STRETCHES), len(GAINS)
    angles, outcomes = table["opening_angle"].reshape(shape), table["outcome"].reshape(shape)
    image = axes.imshow(
        angles.T, origin="lower", aspect="auto", cmap="cividis", vmin=0.0, vmax=180.0
    )
    for i, j in np.ndindex(shape):
        if np.isnan(angles[i, j]):
            text, colour = NO_ANGLE.get(outcomes[i, j], outcomes[i, j]), "0.2"
            if text == "faster":
                axes.add_patch(
                    Rectangle((i - 0.5, j - 0.5), 1, 1, fc="0.88", ec="0.65", lw=0, hatch="///")
                )
        else:
            text = f"{angles[i, j]:.0f}" + ("*" if outcomes[i, j] == "rests slowly" else "")
            colour = "white" if angles[i, j] < 110 else "black"
        axes.text(i, j, text, ha="center", va="center", fontsize=6.5, color=colour)
    axes.set_xticks(range(shape[0]), [f"{stretch:g}" for stretch in STRETCHES])
    axes.set_yticks(range(shape[1]), [f"{gain:g}" for gain in GAINS])
    return image


def make(keep: bool) -> None:
    """Tables and pictures."""
    walls, of_map = Page(FIGURES, "natural", *RESIDUAL), Page(FIGURES, "turnover_map", *MAP)
    if not keep:
        table: Columns = {}
        for angle in OPENING_ANGLES:
            table |= residual(angle)
        walls.save_table(table, list(RESIDUAL))
        of_map.save_table(by_column(map_of_walls()), list(MAP))
    drawn(walls, draw_walls, read_table(FIGURES / "natural.csv"))
    drawn(of_map, draw_map, read_table(FIGURES / "turnover_map.csv"), **{"axes.grid": False})
