"""Tables and picture of docs/against_measurements.md.

The numbers of measurements are typed here with their sources; those of the model are from runs. Table and picture stay
in docs/figures/measurements.csv and .png; the tables of the page are made from it alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.special import ive

from docs.making.pages import DOCS, FIGURES, Columns, between_marks, drawn, markdown
from remodel_fenicsx.scene.scene import preset_scene
from remodel_fenicsx.studies.page import COLOURS, Page, read_table
from tests.runs import last_row

PAGE = DOCS / "against_measurements.md"
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


def wall(
    outer_radius: float, pressure: float, opening_angle: float, elongation: float = 0.1, stiffer: float = 1.0
) -> dict[str, float]:
    """Bands of the angle of a tube that has come to rest, and its axial force without that of its closed ends."""
    tissue = preset_scene("consistent", "tube").material
    found = last_row({
        "preset": "consistent", "mesh": {"refinement": 4, "degree": 2}, "model": {"kinematics": "radial"},
        "geometry": {"shape": "tube", "outer_radius": outer_radius, "length": 1.0},  # short: it does not buckle
        "cells": {"initial": "isotropic"}, "natural": {"opening_angle": opening_angle},
        "material": {name: stiffer * getattr(tissue, name) for name in MODULI},
        "loads": {"pressure": {"value": pressure}, "elongation": {"value": elongation}},
        "time": {"end": "equilibrium"}, "output": {"fields": False, "columns": [*BANDS, FORCE]},
    })  # fmt: skip
    return {name: found[name] for name in (*BANDS, FORCE)}


def sheet(kappa: float) -> float:
    """Angle of a sheet's fibres to the load after the days of the test, from that before it, in degrees."""
    before = np.radians(normal_angle(*SHEET["before"]))
    found = last_row({
        "geometry": {"shape": "cube"}, "model": {"kinematics": "point"},
        "cells": {"initial": [float(np.sin(before)), 0.0, float(np.cos(before))]},
        "loads": {"force": {"value": 1.0, "ramp": [[0.0, 1.0]]}}, "remodeling": {"law": "tensor", "kappa": kappa},
        "time": {"step": DAYS / 20, "end": DAYS}, "output": {"fields": False},
    })  # fmt: skip
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


def tables() -> dict[str, str]:
    """Text between the marks of the page, by their name, from the kept table alone."""
    found = read_table(FIGURES / "measurements.csv")
    mean, spread = CAROTID["b"]
    middle, narrow, wide = (von_mises_angle(CAROTID["mean"], b) for b in (mean, mean + spread, mean - spread))
    measured = f"Measured: {middle:.1f} degrees; {narrow:.1f} to {wide:.1f} for one standard deviation of b."
    rows = {str(case): [f"{found[name][i]:.1f}" for name in BANDS] for i, case in enumerate(found["case"])}
    places = ["inside", "half-way", "outside"]
    walls = ([case, *angles] for case, angles in rows.items() if case in WALLS)
    loads = ([case, *rows[case], f"{force:.2f}"] for case, force in zip(rows, found[FORCE], strict=True)
             if case not in WALLS and case != "sheet")  # fmt: skip
    before, after = (normal_angle(*SHEET[name]) for name in ("before", "after"))
    of_sheet = [
        ["measured: mean, dispersion", *("{}, {}".format(*SHEET[name]) for name in ("before", "after"))],
        ["measured: angle of the second moment", f"{before:.1f}", f"{after:.1f}"],
        [f"model, kappa = {found['kappa'][-1]:.3f} per day", f"{before:.1f}", rows["sheet"][0]],
    ]
    return {
        "carotid": f"{measured}\n\n" + markdown(["wall, 10 % longer, in equilibrium", *places], walls),
        "loads": markdown(["the thin wall", *places, "axial force less p pi r_i^2"], loads),
        "sheet": markdown(["", "before", "after 5 days"], of_sheet),
    }


def page_text() -> str:
    """The page with its tables made anew."""
    text = PAGE.read_text(encoding="utf-8")
    for name, table in tables().items():
        text = between_marks(text, name, table)
    return text


def draw(found: Columns) -> Figure:
    """Bands of the four walls over the measured range."""
    mean, spread = CAROTID["b"]
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
    return figure


def make(keep: bool) -> None:
    """Runs, table, picture and page."""
    page = Page(FIGURES, "measurements", *CAPTION)
    if not keep:
        runs(page)
    drawn(page, draw, read_table(FIGURES / "measurements.csv"))
    PAGE.write_text(page_text(), encoding="utf-8")
