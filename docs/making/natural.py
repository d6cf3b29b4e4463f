"""docs/figures/natural.png: what residual stress does to the paper's artery.

Four tubes on one radius, with opening angles of 0 to 160 degrees. Table and picture stay in docs/figures/.
"""

from __future__ import annotations

from matplotlib.figure import Figure

from docs.making.pages import FIGURES, Columns, drawn, through_the_wall
from remodel_fenicsx.scene.scene import scene_from_dict
from remodel_fenicsx.studies.page import COLOURS, Page, read_table
from tests.runs import made

OPENING_ANGLES = (0, 60, 120, 160)  # degrees
CAPTION = (
    "Residual stress and the fibre angle of the paper's artery",
    "a: hoop stress without load, before any remodeling; b: under the paper's loads at t = 150; c: fibre angle at "
    "t = 150, 0 is circumferential. Isotropic cells at t = 0, one radius, for opening angles of 0 to 160 degrees.",
)


def wall(opening_angle: float) -> Columns:
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
    return {"radius": before["radius"]} | {f"{name}_{opening_angle}": values for name, values in found.items()}


def draw(table: Columns) -> Figure:
    """Three panels over the radius, a curve for each opening angle."""
    figure = Figure(figsize=(7.2, 2.7), layout="constrained")
    panels = figure.subplots(1, 3)
    labels = {"unloaded": "hoop stress, t = 0", "loaded": "hoop stress, t = 150", "angle": "fibre angle, degrees"}
    for letter, axes, (name, label) in zip("abc", panels, labels.items(), strict=True):
        axes.set_title(letter, loc="left", fontweight="bold")
        for colour, opening_angle in zip(COLOURS, OPENING_ANGLES, strict=False):
            axes.plot(table["radius"], table[f"{name}_{opening_angle}"], color=colour, label=f"{opening_angle}°")
        axes.set(xlabel="radius without load", ylabel=label)
    panels[1].set_yscale("log")
    panels[2].set_ylim(0, 90)
    panels[0].legend(title="opening angle", fontsize=7)
    return figure


def make(keep: bool) -> None:
    """Table and picture."""
    page = Page(FIGURES, "natural", *CAPTION)
    if not keep:
        table: Columns = {}
        for opening_angle in OPENING_ANGLES:
            table |= wall(opening_angle)
        page.save_table(table, list(CAPTION))
    drawn(page, draw, read_table(FIGURES / "natural.csv"))
