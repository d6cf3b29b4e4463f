"""Makes the tables of docs/against_measurements.md: ./with-fenicsx python3 docs/compare_measurements.py

The numbers of measurements are typed here with their sources; those of the model are from runs. Table and picture stay
in docs/figures/measurements.csv and .png; the tables of the page are made from it alone.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from scipy.special import ive

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS), str(DOCS.parent)]

from remodel_fenicsx import Simulation  # noqa: E402
from remodel_fenicsx.scene.scene import preset_scene, scene_from_dict  # noqa: E402
from remodel_fenicsx.studies.page import COLOURS, STYLE, Page, read_table  # noqa: E402

KEPT, PAGE = DOCS / "figures", DOCS / "against_measurements.md"
MARKS = ("<!-- {}: ./with-fenicsx python3 docs/compare_measurements.py -->\n\n", "\n<!-- end of {} -->")
BANDS = ("fibre_angle_inner", "fibre_angle_middle", "fibre_angle_outer")
CAROTID = {"mean": 0.7, "b": (3.4, 1.9)}  # Fischer et al. 2024, abstract: von Mises, mean +- standard deviation
SHEET = {"before": (25.3, 37.4), "after": (7.1, 18.5)}  # Nguyen et al. 2009, abstract: mean and dispersion, degrees
DAYS = 5.0
CAPTION = (
    "Fibre angles of walls against the human common carotid artery",
    "Angle of the mean structure tensor of the inner, middle and outer eighth of the wall, in equilibrium. Grey: "
    "Fischer et al. 2024, mean concentration and one standard deviation to each side.",
)
WALLS = {
    "1 to 1.3": (1.3, 1.2, 0.0),
    "1 to 1.3, opening angle 90": (1.3, 1.2, 90.0),
    "1 to 3 (the paper's)": (3.0, 4.8, 0.0),
    "1 to 3, opening angle 120": (3.0, 4.8, 120.0),
}
"""Label -> outer radius, pressure, opening angle."""
LENGTHS = (0.0, 0.05, 0.1, 0.2, 0.3)
"""Elongations of the thin wall."""
STIFFER = 2.0
"""Factor of all moduli of the thin wall, 10 % longer, in one more run."""
MODULI = ("lame_lambda", "lame_mu", "chain_density")
FORCE = "reduced_axial_force"


def von_mises_angle(mean: float, concentration: float) -> float:
    """Angle of the second moment of the density exp(b cos 2(t - mean)), in degrees: cos 2a = I1(b)/I0(b) cos 2 mean."""
    cosine = ive(1, concentration) / ive(0, concentration) * np.cos(2 * np.radians(mean))
    return float(np.degrees(np.arccos(cosine)) / 2)


def normal_angle(mean: float, deviation: float) -> float:
    """The same of a wrapped normal distribution: cos 2a = exp(-2 s^2) cos 2 mean, in degrees."""
    cosine = np.exp(-2 * np.radians(deviation) ** 2) * np.cos(2 * np.radians(mean))
    return float(np.degrees(np.arccos(cosine)) / 2)


def last_row(values: dict[str, Any]) -> dict[str, float]:
    """Of a run."""
    simulation = Simulation(scene_from_dict(values))
    try:
        return dict([step.row for step in simulation.steps()][-1])
    finally:
        simulation.close()


def wall(
    outer_radius: float, pressure: float, opening_angle: float, elongation: float = 0.1, stiffer: float = 1.0
) -> dict[str, float]:
    """Bands of the angle of a tube that has come to rest, and its axial force without that of its closed ends."""
    tissue = preset_scene("consistent", "tube").material
    found = last_row(
        {
            "preset": "consistent",
            "geometry": {"shape": "tube", "outer_radius": outer_radius, "length": 1.0},  # short: it does not buckle
            "mesh": {"refinement": 4, "degree": 2},
            "model": {"kinematics": "radial"},
            "cells": {"initial": "isotropic"},
            "natural": {"opening_angle": opening_angle},
            "material": {name: stiffer * getattr(tissue, name) for name in MODULI},
            "loads": {"pressure": {"value": pressure}, "elongation": {"value": elongation}},
            "time": {"end": "equilibrium"},
            "output": {"fields": False, "columns": [*BANDS, FORCE]},
        }
    )
    return {name: found[name] for name in (*BANDS, FORCE)}


def sheet(kappa: float) -> float:
    """Angle of a sheet's fibres to the load after the days of the test, from that before it, in degrees."""
    before = np.radians(normal_angle(*SHEET["before"]))
    found = last_row(
        {
            "geometry": {"shape": "cube"},
            "model": {"kinematics": "point"},
            "cells": {"initial": [float(np.sin(before)), 0.0, float(np.cos(before))]},
            "loads": {"force": {"value": 1.0, "ramp": [[0.0, 1.0]]}},
            "remodeling": {"law": "tensor", "kappa": kappa},
            "time": {"step": DAYS / 20, "end": DAYS},
            "output": {"fields": False},
        }
    )
    return float(found["mean_fibre_angle"])


def runs(page: Page) -> None:
    """Make the table."""
    rows = {label: wall(*numbers) for label, numbers in WALLS.items()}
    thin = WALLS["1 to 1.3"]
    rows |= {f"{100 * elongation:g} % longer": wall(*thin, elongation) for elongation in LENGTHS}
    rows["10 % longer, all moduli doubled"] = wall(*thin, stiffer=STIFFER)
    before, after = (np.radians(normal_angle(*SHEET[name])) for name in ("before", "after"))
    kappa = float(np.log(np.sin(before) ** 2 / np.sin(after) ** 2) / DAYS)
    table: dict[str, Any] = {"case": [*rows, "sheet"]}
    table |= {name: [*(row[name] for row in rows.values()), sheet(kappa)] for name in BANDS}
    table[FORCE] = [*(row[FORCE] for row in rows.values()), 0.0]
    page.save_table(table | {"kappa": [0.0] * len(rows) + [kappa]}, list(CAPTION))


def tables(kept: Path = KEPT) -> dict[str, str]:
    """Text between the marks of the page, by their name, from the kept table alone."""
    found = read_table(kept / "measurements.csv")
    mean, spread = CAROTID["b"]
    middle, narrow, wide = (von_mises_angle(CAROTID["mean"], b) for b in (mean, mean + spread, mean - spread))
    carotid = [
        f"Measured: {middle:.1f} degrees; {narrow:.1f} to {wide:.1f} for one standard deviation of b.\n",
        "| wall, 10 % longer, in equilibrium | inside | half-way | outside |",
        "|---|---|---|---|",
    ]
    lines = list(zip(found["case"], *(found[name] for name in (*BANDS, FORCE)), strict=True))
    carotid += [f"| {case} | {a:.1f} | {b:.1f} | {c:.1f} |" for case, a, b, c, _ in lines if case in WALLS]
    other = ["| the thin wall | inside | half-way | outside | axial force less p pi r_i^2 |", "|---|---|---|---|---|"]
    other += [
        f"| {case} | {a:.1f} | {b:.1f} | {c:.1f} | {force:.2f} |"
        for case, a, b, c, force in lines
        if case not in WALLS and case != "sheet"
    ]
    before, after = (normal_angle(*SHEET[name]) for name in ("before", "after"))
    sheet_lines = [
        "| | before | after 5 days |",
        "|---|---|---|",
        "| measured: mean, dispersion | {}, {} | {}, {} |".format(*SHEET["before"], *SHEET["after"]),
        f"| measured: angle of the second moment | {before:.1f} | {after:.1f} |",
        f"| model, kappa = {found['kappa'][-1]:.3f} per day | {before:.1f} | {found[BANDS[0]][-1]:.1f} |",
    ]
    made = {"carotid": carotid, "loads": other, "sheet": sheet_lines}
    return {name: "\n".join(text) + "\n" for name, text in made.items()}


def page_text(kept: Path = KEPT) -> str:
    """The page with its tables made anew."""
    text = PAGE.read_text(encoding="utf-8")
    for name, table in tables(kept).items():
        start, end = (mark.format(name) for mark in MARKS)
        before, rest = text.split(start)
        text = before + start + table + end + rest.split(end)[1]
    return text


def draw(page: Page) -> None:
    """Bands of the four walls over the measured range."""
    found = read_table(KEPT / "measurements.csv")
    mean, spread = CAROTID["b"]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(5.2, 3.2), layout="constrained")
        axes = figure.subplots()
        narrow, wide = (von_mises_angle(CAROTID["mean"], b) for b in (mean + spread, mean - spread))
        axes.axhspan(narrow, wide, color="0.85", label="carotid arteries, measured")
        axes.axhline(von_mises_angle(CAROTID["mean"], mean), color="0.6")
        for number, label in enumerate(WALLS):
            style = {"color": COLOURS[number // 2], "linestyle": "-" if number % 2 else "--", "marker": "o"}
            axes.plot(["inside", "half-way", "outside"], [found[name][number] for name in BANDS], label=label, **style)
        axes.set(ylabel="angle to the circumference, degrees", ylim=(0, 90))
        axes.legend(fontsize=7)
        page.save_figure(figure, "")


def main() -> None:
    """Runs, table, picture and page."""
    page = Page(KEPT, "measurements", *CAPTION)
    runs(page)
    draw(page)
    PAGE.write_text(page_text(), encoding="utf-8")


if __name__ == "__main__":
    main()
