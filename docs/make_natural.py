"""Draws docs/figures/natural.png: ./with-fenicsx python3 docs/make_natural.py

What residual stress does to the paper's artery.
Four tubes on one radius, with opening angles of 0 to 160 degrees. Table and picture stay in docs/figures/.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS.parent)]

from remodel_fenicsx import Simulation  # noqa: E402
from remodel_fenicsx.scene.scene import scene_from_dict  # noqa: E402
from remodel_fenicsx.studies.page import COLOURS, STYLE, Page, read_table  # noqa: E402
from remodel_fenicsx.system.environment import versions  # noqa: E402

KEPT = DOCS / "figures"
OPENING_ANGLES = (0, 60, 120, 160)  # degrees
CAPTION = (
    "Residual stress and the fibre angle of the paper's artery",
    "a: hoop stress without load, before any remodeling; b: under the paper's loads at t = 150; c: fibre angle at "
    "t = 150, 0 is circumferential. Isotropic cells at t = 0, one radius, for opening angles of 0 to 160 degrees.",
)


def through_the_wall(opening_angle: float) -> dict[str, np.ndarray]:
    """Radius without load, hoop stress without load and at t = 150, and fibre angle at t = 150, at the points."""
    scene = scene_from_dict(
        {
            "preset": "kuhl-holzapfel-2007",
            "geometry": {"shape": "tube"},
            "mesh": {"refinement": 2, "degree": 2},
            "model": {"kinematics": "radial"},
            "cells": {"initial": "isotropic"},
            "natural": {"opening_angle": opening_angle},
            "output": {"fields": False},
        }
    )
    simulation = Simulation(scene)
    try:
        cells, remodeling = simulation.cells, simulation.stepper.remodeling
        radius = cells.local_axes.coordinates[..., 0].reshape(-1)
        before = remodeling.driving_tensor()[1][:, 1, 1]
        for _ in simulation.steps():
            pass
        after = remodeling.driving_tensor()[1][:, 1, 1]
        angle = scene.geometry.fibre_angle(cells.dimension_values, cells.axis_values, cells.local_axes.axes).reshape(-1)
    finally:
        simulation.close()
    order = np.argsort(radius)
    return {"radius": radius[order], "unloaded": before[order], "loaded": after[order], "angle": angle[order]}


def runs(page: Page) -> None:
    """Make the table."""
    table: dict[str, np.ndarray] = {}
    for opening_angle in OPENING_ANGLES:
        found = through_the_wall(opening_angle)
        table["radius"] = found.pop("radius")
        table |= {f"{name}_{opening_angle}": values for name, values in found.items()}
    page.save_table(table, list(CAPTION))


def draw(page: Page) -> None:
    """Three panels over the radius, a curve for each opening angle."""
    table = read_table(KEPT / "natural.csv")
    with matplotlib.rc_context(STYLE):
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
        made_with = ", ".join(f"{name} {version}" for name, version in versions().items() if name != "BLAS")
        page.save_figure(figure, made_with)


if __name__ == "__main__":
    kept = Page(KEPT, "natural", *CAPTION)
    runs(kept)
    draw(kept)
