"""docs/validation.md: the program against other codes and closed forms, and the model against measurements.

The numbers of others are typed here with their sources; those of the model are from runs and stay in docs/figures. The
page is validation.template.md with tables that are made of these files alone.
"""

from __future__ import annotations

import runpy
from collections.abc import Iterator
from functools import cache
from itertools import product
from tempfile import TemporaryDirectory
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import brentq
from scipy.special import ive

from docs.making.pages import (
    DOCS,
    FIGURES,
    Columns,
    by_column,
    drawn,
    filled,
    markdown,
    read_table,
    rows_of,
    side_by_side,
)
from remodel_fenicsx import RemodelError, extend, read_scene
from remodel_fenicsx.studies.fit import fit
from remodel_fenicsx.studies.study import COLOURS, Page
from tests.body.test_peers import passive
from tests.runs import last_row
from tests.runs import rows_of as run
from tests.values import isotropic, ramped

PAGE = DOCS / "validation.md"
DEMOS = DOCS.parent / "demos"
Row = dict[str, Any]
BANDS = ("fibre_angle_inner", "fibre_angle_middle", "fibre_angle_outer")
FORCE = "reduced_axial_force"
CAROTID = {
    "mean": 0.7,
    "b": (3.4, 1.9),
}  # Fischer et al. 2024, abstract: von Mises, mean +- standard deviation
SHEET = {
    "before": (25.3, 37.4),
    "after": (7.1, 18.5),
}  # Nguyen et al. 2009, abstract: mean and dispersion, degrees
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
TWO_LAYERS = "1 to 1.3, media and adventitia"
LAYERS = {
    "media": {"outer_radius": 1.2, "material": {"lame_mu": 4.65}},
    "adventitia": {"material": {"lame_mu": 1.55, "chain_density": 4e21}},
}
MAP = (0.6, 1.2, 1.8, 2.4), (0.0, 0.1, 0.2, 0.3)
"""Pressures and elongations of the thin wall."""
TISSUE = ("lame_mu", "initial_stiffness", "locking_stretch")
CELL_ANGLES = (40.0, 45.0, 50.0)  # tan: l2/l1 of the cells of a sheet
DRIVERS, EXPONENTS, SHARES = ("cauchy", "pk2", "finger"), (2.0, 4.0, 6.0, 10.0), (0.0, 0.5)
PYMECHT, FELUPE = "pymecht 1.1.3", "FElupe 11.3"
GOH = {0.5: 1.11531899, 1.0: 1.19358498, 1.5: 1.23428423}
"""Pressure -> inner radius in pymecht: walls of 1 to 1.3, 10 % longer, mu 1, k1 5, k2 15, kappa 0.1, angles 0.7 rad."""
SHEETS = {
    ("isotropic", 8, 8): (0.5175315317, 0.5175315317), ("isotropic", 8, 4): (0.7212825113, 0.0580510195),
    ("in plane", 8, 8): (0.4756195849, 0.1821463399), ("in plane", 8, 4): (0.6439287993, -0.0381871828),
}  # fmt: skip
"""Cells and forces on a cube of side 1 -> its two elongations in FElupe, lambda/mu 1e4."""


# ---------------------------------------------------------------- what must agree
def agreements() -> Iterator[Row]:
    """Against others and closed forms: a row for each number."""

    def row(
        case: str, source: str, theirs: float, ours: float, tolerance: float, relative: bool = True
    ) -> Row:
        difference = abs(ours - theirs) / (abs(theirs) if relative else 1.0)
        return {"case": case, "source": source, "theirs": theirs, "ours": ours, "difference": difference,
                "tolerance": tolerance}  # fmt: skip

    columns = {"output.columns": ["inner_radius", "outer_radius", "axial_force"]}
    rows = passive(**columns)
    for found, radius in zip(rows, (1.16158, 1.49517, 1.96467, 2.25815), strict=True):
        yield row(
            f"V1 tube, p = {found['pressure']:.1f}, radius",
            PYMECHT,
            radius,
            found["inner_radius"],
            1e-4,
        )
    yield row("V1 tube, axial force", PYMECHT, 62.867, rows[-1]["axial_force"], 5e-4)
    for opening, radius in ((60, 2.43220), (120, 2.54422), (160, 2.57366)):
        found = passive(**columns, **{"natural.opening_angle": opening})[-1]
        yield row(
            f"V1 tube, opening angle {opening}, radius",
            PYMECHT,
            radius,
            found["inner_radius"],
            1e-4,
        )
    for (cells, x, y), elongations in SHEETS.items():
        found = last_row({
            "geometry": {"shape": "sheet", "length_x": 1.0, "length_y": 1.0, "thickness": 1.0},
            "material": {"lame_lambda": 31030.0, "lame_mu": 3.103, "repulsion": "log"},
            "cells": {"initial": "isotropic" if cells == "isotropic" else [0.6, 0.8, 0.0]},
            "remodeling": {"law": "none"}, "loads": ramped(4.0, force_x=float(x), force_y=float(y)),
            "time": {"end": 4.0}, "solver": {"relative_tolerance": 1e-12},
        })  # fmt: skip
        for axis, theirs in zip("xy", elongations, strict=True):
            label = f"V2 sheet, {cells}, forces {x} and {y}, stretch {axis}"
            yield row(label, FELUPE, 1 + theirs, 1 + found[f"elongation_{axis}"], 1e-6)
    found = passive(**columns, **{"cells.initial": [0.8, 0.6, 0.0], "loads.pressure.value": 2.4,
                                  "material.lame_lambda": 27.293, "mesh.formulation": "displacement"})[-1]  # fmt: skip
    for name, theirs in (
        ("inner_radius", 1.313393),
        ("outer_radius", 3.012636),
        ("axial_force", 34.79425),
    ):
        yield row(f"V2 tube, {name.replace('_', ' ')}", FELUPE, theirs, found[name], 1e-6)
    for exponent, theirs in ((1.0, 35.26), (2.0, 26.57), (3.5, 16.56), (4.0, 14.04)):
        found = last_row(isotropic(
            "consistent", geometry={"shape": "tube", "inner_radius": 100.0, "outer_radius": 100.5, "length": 10.0},
            supports={"ends": "closed"}, remodeling={"exponent": exponent, "kappa": 0.1},
            loads=ramped(10.0, pressure=0.005, elongation=0.0), time={"end": 300.0, "step": 5.0},
        ))  # fmt: skip
        label = f"V5 closed membrane, exponent {exponent:g}, degrees"
        yield row(label, "tan a = 2^(-n/2)", theirs, found["fibre_angle_middle"], 0.5, False)
    runpy.run_path(str(DEMOS / "extensions" / "gasser_ogden_holzapfel.py"))
    for pressure, theirs in GOH.items():
        found = passive(**columns, **{
            "geometry.outer_radius": 1.3, "material.matrix": "gasser-ogden-holzapfel", "material.chain_density": 0.0,
            "material.lame_mu": 1.0, "material.lame_lambda": 1e4, "material.family_angle": float(np.degrees(0.7)),
            "loads.pressure.value": pressure,
        })[-1]  # fmt: skip
        yield row(
            f"V9 tube of Gasser, Ogden and Holzapfel, p = {pressure}",
            PYMECHT,
            theirs,
            found["inner_radius"],
            1e-4,
        )
    for forces in ((0.4, 0.2), (0.4, 0.4), (0.4, 0.1), (0.1, 0.3)):
        changes = {
            f"loads.force_{axis}.value": f"{force} N"
            for axis, force in zip("xy", forces, strict=True)
        }
        found = last_row(
            read_scene(DEMOS / "sheet.toml").with_values({**changes, "remodeling.half_life": 2.0})
        )
        theirs = np.degrees(np.arctan2(found["cauchy_stress_y"], found["cauchy_stress_x"]))
        label = "V10 sheet in the steady state, forces {} and {} N, degrees".format(*forces)
        yield row(label, "tan a = sigma_y / sigma_x", theirs, found["fibre_angle"], 0.05, False)
    force = 1.381e-23 * 310.0 / 14.5e-9 * 0.5 * extend.CHAINS["wormlike"].stiffness(0.5, 1.0)
    yield row(
        "Wormlike chain, 14.5 nm, half extended, pN",
        "Marko and Siggia 1995",
        0.369,
        1e12 * force,
        1e-3,
    )


# ---------------------------------------------------------------- against measurements
def von_mises_angle(mean: float, concentration: float) -> float:
    """Angle of the second moment of the density exp(b cos 2(t - mean)), in degrees: cos 2a = I1(b)/I0(b) cos 2 mean."""
    cosine = ive(1, concentration) / ive(0, concentration) * np.cos(2 * np.radians(mean))
    return float(np.degrees(np.arccos(cosine)) / 2)


def normal_angle(mean: float, deviation: float) -> float:
    """The same of a wrapped normal distribution: cos 2a = exp(-2 s^2) cos 2 mean, in degrees."""
    cosine = np.exp(-2 * np.radians(deviation) ** 2) * np.cos(2 * np.radians(mean))
    return float(np.degrees(np.arccos(cosine)) / 2)


def tube(outer_radius: float, opening_angle: float, **tables: Any) -> dict[str, Any]:
    """A scene of a wall on one radius with isotropic cells; it is short, so that it does not buckle."""
    return {
        "preset": "consistent", "mesh": {"refinement": 4, "degree": 2}, "model": {"kinematics": "radial"},
        "geometry": {"shape": "tube", "outer_radius": outer_radius, "length": 1.0},
        "cells": {"initial": "isotropic"}, "natural": {"opening_angle": opening_angle},
        "output": {"fields": False, "columns": ["inner_radius", *BANDS, FORCE]},
    } | tables  # fmt: skip


def wall(
    outer_radius: float, pressure: float, opening_angle: float, elongation: float = 0.1
) -> dict[str, float]:
    """Bands of the angle of a tube that has come to rest, and its axial force without that of its closed ends."""
    loads = {"pressure": {"value": pressure}, "elongation": {"value": elongation}}
    found = last_row(tube(outer_radius, opening_angle, loads=loads, time={"end": "equilibrium"}))
    return {name: found[name] for name in (*BANDS, FORCE)}


def walls() -> Iterator[Row]:
    """The walls at rest."""
    yield from ({"case": label} | wall(*numbers) for label, numbers in WALLS.items())


def at_rest(
    label: str, driver: str, exponent: float, elongation: float, pulse: bool = False
) -> list[Row]:
    """Rows of a wall that comes to rest; with a pulse the pressure then goes to 3/4 and 5/4 within no time."""
    outer, pressure, opening = WALLS[WALL_OF.get(label, label)]
    times = [[0.0, 0.0], [10.0, 1.0], [150.0, 1.0]] + (
        [[150.01, 0.75], [150.02, 1.25]] if pulse else []
    )
    return run(tube(
        outer, opening, regions=LAYERS if label == TWO_LAYERS else {},
        remodeling={"exponent": exponent, "driver": driver, "kappa": 0.2},
        loads=ramped(10.0, elongation=elongation) | {"pressure": {"value": pressure, "ramp": times}},
        time={"end": times[-1][0], "tolerance": 2.0, "step": 5.0},
    ))  # fmt: skip


WALL_OF = {TWO_LAYERS: "1 to 1.3"}
PULLED = ("1 to 1.3", "1 to 1.3, opening angle 90", TWO_LAYERS, "1 to 3, opening angle 120")


def share_of(row: Row) -> float:
    """The reduced axial force over that of the pressure on the lumen."""
    return float(row[FORCE] / (np.pi * row["pressure"] * row["inner_radius"] ** 2))


def pulled(case: tuple[str, str, float, float]) -> Row:
    """The wall at the length at which its reduced axial force has this share: angles, and what a pulse does to it."""
    label, driver, exponent, share = case
    found: Row = {"wall": label, "driver": driver, "exponent": exponent, "share": share}
    nothing = dict.fromkeys(("elongation", *BANDS, "pulse"), np.nan)
    try:
        low = -0.1

        @cache  # brentq begins with both ends
        def excess(elongation: float) -> float:
            return share_of(at_rest(label, driver, exponent, elongation)[-1]) - share

        if excess(low) > 0:
            return found | nothing
        while excess(low + 0.1) < 0:
            low += 0.1
            if low > 0.55:
                return found | nothing
        length = brentq(excess, low, low + 0.1, xtol=1e-4)
        rows = at_rest(label, driver, exponent, length, pulse=True)
    except RemodelError:
        return found | nothing
    rest, less = (
        next(row for row in rows if row["time"] >= time - 1e-9) for time in (150.0, 150.01)
    )
    return found | {
        "elongation": length,
        **{name: rest[name] for name in BANDS},
        "pulse": rows[-1][FORCE] / less[FORCE],
    }


def mapped(loads: tuple[float, float]) -> Row:
    """The thin wall at rest under another pressure and length."""
    pressure, elongation = loads
    try:
        found = wall(1.3, pressure, 0.0, elongation)
    except RemodelError:
        found = dict.fromkeys((*BANDS, FORCE), np.nan)
    return {"pressure": pressure, "elongation": elongation} | found


def growth(volume: float) -> Row:
    """How much the wall of demos/hypertension.toml changes from one rest to the next, under half more pressure."""
    scene = read_scene(DEMOS / "hypertension.toml").with_values(
        {"remodeling.turnover.volume": volume, "time.end": 4000.0, "output.columns": [*GROWN]}
    )
    rows = run(scene)
    before, after = (
        next(row for row in rows if row["time"] >= time - 1e-9) for time in (1600.0, 4000.0)
    )
    return {"volume": volume} | {name: after[name] / before[name] for name in GROWN}


GROWN = ("wall_thickness", "inner_radius", "mean_hoop_stress")
NO_PRESTRETCH: dict[str, Any] = {"material.elastin.prestretch": [1.0, 1.0]}
CAUCHY: dict[str, Any] = {"remodeling.driver": "cauchy", "remodeling.exponent": 2.0}
ELASTIN = {
    "neither: no prestretch, `cauchy`": NO_PRESTRETCH | CAUCHY,
    "prestretch, `cauchy`": CAUCHY,
    "no prestretch, `finger`": NO_PRESTRETCH,
    "both: prestretch, `finger`": {},
}
"""Variants of the preset `carotid`. The exponent of each driver is that with which it fares better."""
RELEASED = ("opening_angle", "axial_stretch_in_vivo")
MEASURED = [
    "measured",
    "16.7, even",
    "above 0",
    "0.8 to 1.2",
    "1.5, 1.0",
    "60 to 120 and more",
    "1.3 to 1.6",
]


def elastin(label: str) -> Row:
    """Compute a variant of demos/carotid.toml: steady states at p and 1.5 p, and a fast pulse at p between them."""
    held = 2500.0
    moments = {"rest": held, "less": held + 0.01, "more": held + 0.02, "high": 2 * held}
    ramp = [[0.0, 0.0], [24.0, 1.0], [held, 1.0], [held + 0.01, 0.75], [held + 0.02, 1.25]]
    rows = run(
        read_scene(DEMOS / "carotid.toml").with_values({
            "loads.pressure.ramp": [*ramp, [held + 0.03, 1.0], [held + 25.0, 1.5], [2 * held, 1.5]],
            "time.end": 2 * held, "output.times": [], "mesh.refinement": 1,
            "output.columns": [*BANDS, *GROWN, *RELEASED, FORCE], **ELASTIN[label],
        })
    )  # fmt: skip
    at = {
        name: next(row for row in rows if row["time"] >= time - 1e-9)
        for name, time in moments.items()
    }
    rest = at["rest"]
    return {
        "variant": label,
        **{name: rest[name] for name in (*BANDS, *RELEASED)},
        "share": share_of(rest),
        **{f"force {name}": at[name][FORCE] / rest[FORCE] for name in ("less", "more")},
        **{name: at["high"][name] / rest[name] for name in GROWN},
    }


def tissue() -> Row:
    """V3: the public biaxial set, fitted with the share of chains along x and y that fits it best."""
    scene, data = read_scene(DEMOS / "biaxial" / "scene.toml"), DEMOS / "biaxial" / "tissue.toml"
    best: Row = {"misfit": np.inf}
    for angle in CELL_ANGLES:
        cells = [
            float(0.96 * np.cos(np.radians(angle))),
            float(0.96 * np.sin(np.radians(angle))),
            0.28,
        ]
        with TemporaryDirectory() as folder:
            _, found = fit(
                scene.with_values({"cells.initial": cells}), data, folder, starts=1, profiles=False
            )
        if found.misfit < best["misfit"]:
            (table,), (model,) = found.problem.tables, found.modelled
            best = {"misfit": found.misfit, "angle": angle} | dict(
                zip(found.keys, map(float, found.values), strict=True)
            )
            for axis in "xy":
                values = table.columns[f"nominal_stress_{axis}"]
                left = ((values - model[f"nominal_stress_{axis}"]) ** 2).sum() / (
                    (values - values.mean()) ** 2
                ).sum()
                best[f"R2 {axis}"] = float(1 - left)
    return best


def runs(page: Page) -> None:
    """Make the tables."""
    page.save_table(
        by_column([tissue()]), ["a tissue's seven protocols, fitted with one cell"], "tissue"
    )
    page.save_table(
        by_column(agreements()), ["the program against other codes and closed forms"], "agreed"
    )
    page.save_table(by_column(walls()), list(CAPTION))
    page.save_table(
        by_column(map(growth, (0.0, 0.3, 0.5))), ["after over before a pressure x 1.5"], "growth"
    )
    page.save_table(
        by_column(map(mapped, product(*MAP))),
        ["the thin wall at rest over pressure and length"],
        "map",
    )
    rows = side_by_side(pulled, product(PULLED, DRIVERS, EXPONENTS, SHARES))
    page.save_table(by_column(rows), ["walls that pull along their axis"], "pulled")
    save_elastin(page)


def save_elastin(page: Page) -> None:
    """Make the table of the variants of elastin, in four minutes."""
    rows = side_by_side(elastin, ELASTIN)
    page.save_table(by_column(rows), ["variants of the preset carotid"], "elastin")


# ---------------------------------------------------------------- the page
def measured() -> tuple[float, float, float]:
    """The angle of the carotid artery, and one standard deviation of its concentration to each side."""
    mean, spread = CAROTID["b"]
    middle, narrow, wide = (
        von_mises_angle(CAROTID["mean"], b) for b in (mean, mean + spread, mean - spread)
    )
    return middle, narrow, wide


def of_wall(row: Row) -> float:
    """The angle of the second moment of the three bands together, in degrees."""
    return float(
        np.degrees(
            np.arcsin(np.sqrt(np.mean([np.sin(np.radians(row[name])) ** 2 for name in BANDS])))
        )
    )


def fitted(rows: list[Row], angle: float) -> str:
    """The least exponent at which the wall has this angle: ln tan goes with it, exactly in a thin wall."""
    known = [
        (row["exponent"], np.log(np.tan(np.radians(of_wall(row)))))
        for row in rows
        if np.isfinite(row[BANDS[0]])
    ]
    asked = np.log(np.tan(np.radians(angle)))
    for (n, value), (next_n, next_value) in zip(known, known[1:], strict=False):
        if (value - asked) * (next_value - asked) <= 0:
            return f"{n + (next_n - n) * (asked - value) / (next_value - value):.1f}"
    return "none"


def tables() -> dict[str, str]:
    """What the template names, from the kept tables alone."""
    parts = ("", "-agreed", "-pulled", "-growth", "-map", "-tissue", "-elastin")
    resting, agreed, pulling, grown, maps, tissues, variants = (
        rows_of(FIGURES / f"validation{part}.csv") for part in parts
    )
    over = [
        f"{row[BANDS[1]]:.0f} ({row[FORCE]:.1f})" if np.isfinite(row[FORCE]) else "-"
        for row in maps
    ]
    before, after = (normal_angle(*SHEET[name]) for name in ("before", "after"))
    kappa = np.log(np.sin(np.radians(before)) ** 2 / np.sin(np.radians(after)) ** 2) / DAYS
    middle, narrow, wide = measured()
    fits = []
    for label, driver in product(PULLED, DRIVERS):
        some = [
            row
            for row in pulling
            if (row["wall"], row["driver"], row["share"]) == (label, driver, SHARES[-1])
        ]
        angles = (
            "/".join("-" if np.isnan(row[name]) else f"{row[name]:.0f}" for name in BANDS)
            for row in some
        )
        fits.append([label, driver, *angles, fitted(some, middle)])
    pulses = {(row["wall"], row["driver"]): f"{row['pulse']:.2f}" for row in pulling
              if row["share"] == SHARES[-1] and row["exponent"] == 2 and np.isfinite(row["pulse"])}  # fmt: skip
    agreements: dict[tuple[str, str, float], list[float]] = {}
    for row in agreed:
        key = row["case"].partition(",")[0], row["source"], row["tolerance"]
        agreements.setdefault(key, []).append(row["difference"])
    places = ["inside", "half-way", "outside"]
    return {
        "agreed": markdown(["case", "source", "numbers", "largest difference", "tolerance"], (
            [case, source, f"{len(those)}", f"{max(those):.0e}", f"{tolerance:g}"]
            for (case, source, tolerance), those in agreements.items())),
        "measured_middle": f"{middle:.1f}",
        "closed": f"{2 * np.log(np.tan(np.radians(middle))) / np.log(0.5):.1f}",
        "closed_pulled": f"{2 * np.log(np.tan(np.radians(middle))) / np.log(0.75):.1f}",
        "measured": f"{middle:.1f} degrees, and {narrow:.1f} to {wide:.1f} for one standard deviation of b",
        "walls": markdown(["wall, 10 % longer, in equilibrium", *places], (
            [row["case"], *(f"{row[name]:.1f}" for name in BANDS)] for row in resting)),
        "map": markdown(["pressure", *(f"{100 * length:g} % longer" for length in MAP[1])], (
            [f"{pressure:g}", *over[len(MAP[1]) * k : len(MAP[1]) * (k + 1)]] for k, pressure in enumerate(MAP[0]))),
        "angle_before": f"{before:.1f}", "angle_after": f"{after:.1f}", "kappa": f"{kappa:.3f}",
        "sheets": "{} ± {} degrees before the test and {} ± {} after it".format(*SHEET["before"], *SHEET["after"]),
        "tissue": markdown(["R², along x", "along y", "matrix mu", "initial stiffness", "locking stretch", "l1 : l2"], (
            [f"{row['R2 x']:.2f}", f"{row['R2 y']:.2f}", *(f"{row[f'material.{key}']:.3g}" for key in TISSUE),
             f"1 : {np.tan(np.radians(row['angle'])):.2f}"] for row in tissues)),
        "growth": markdown(["volume", "thickness", "inner radius", "hoop stress, mean"], (
            [f"{row['volume']:g}", *(f"{row[name]:.2f}" for name in GROWN)] for row in grown)),
        "elastin": markdown(["variant", "angles", "f / (p π r²)", "f at 3/4 p, 5/4 p", "thickness, hoop stress",
                             "cut, degrees", "stretch in vivo"], (
            MEASURED, *([row["variant"], "/".join(f"{row[name]:.0f}" for name in BANDS), f"{row['share']:.2f}",
                         f"{row['force less']:.2f}, {row['force more']:.2f}",
                         f"{row['wall_thickness']:.2f}, {row['mean_hoop_stress']:.2f}",
                         f"{row['opening_angle']:.0f}", f"{row['axial_stretch_in_vivo']:.2f}"] for row in variants))),
        "fits": markdown(["wall", "driver", *(f"n = {n:g}" for n in EXPONENTS),
                          f"n for {middle:.1f}"], fits),
        "pulses": markdown(["force at 5/4 p over that at 3/4 p", *DRIVERS], (
            [label, *(pulses[label, driver] for driver in DRIVERS)] for label in PULLED)),
    }  # fmt: skip


def page_text() -> str:
    """The template with its tables."""
    return filled(Path(__file__).with_suffix(".template.md"), tables())


def draw(found: Columns) -> Figure:
    """Bands of the four walls over the measured range."""
    figure = Figure(figsize=(5.2, 3.2), layout="constrained")
    axes = figure.subplots()
    middle, narrow, wide = measured()
    axes.axhspan(narrow, wide, color="0.85", label="measured, one standard deviation")
    axes.axhline(middle, color="0.5", lw=1, label="measured, mean")
    for number, label in enumerate(WALLS):
        places = np.arange(len(BANDS)) + 0.12 * (number - 1.5)
        face = COLOURS[number // 2] if number % 2 else "white"
        angles = [found[name][number] for name in BANDS]
        text = f"model, radii {label}" + ("°" if number % 2 else "")
        axes.plot(places, angles, "os^D"[number], mec=COLOURS[number // 2], mfc=face, label=text)
    axes.set(ylabel="fibre angle to the circumference, degrees", ylim=(-2, 90), xlim=(-0.5, 2.5))
    axes.set_xticks(range(len(BANDS)), ["inner eighth", "mid-wall", "outer eighth"])
    axes.grid(axis="x", visible=False)
    axes.legend(fontsize=7, loc="upper left")
    return figure


def make(keep: bool) -> None:
    """Runs, tables, picture and page."""
    page = Page(FIGURES, "validation", *CAPTION)
    if not keep:
        runs(page)
    drawn(page, draw, read_table(FIGURES / "validation.csv"))
    PAGE.write_text(page_text(), encoding="utf-8")
