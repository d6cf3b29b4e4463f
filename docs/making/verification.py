"""docs/verification.md, its appendix and docs/figures/.

Draws every figure, solves the independent radial reference of tests/, makes the studies of docs/making/studies.py, and
keeps the pictures and the small tables in docs/figures/. The page is verification.template.md, the appendix
appendix_verification.template.md. Each {name} in them is computed from the tables in docs/figures/, so that a test can
do the same without a run.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from demos import figures
from docs.making.consistent import page_values
from docs.making.pages import DOCS, EDGES, FIGURES, Columns, by_layer, drawn, markdown, rows_of
from docs.making.studies import study
from remodel_fenicsx.studies.page import COLOURS, Page, read_notes, read_table
from remodel_fenicsx.system.children import cores
from tests.reference.radial import RadialHistory, solve_radial

MORE_TABLES = ("fig6-snapshots", "fig7-history", "fig10-history", "fig11-history", "radial-reference-radii")
REFERENCE = {
    "cauchy": {"driver": "cauchy"}, "pk2": {"driver": "pk2"}, "finger": {"driver": "finger"}, "rate": {"law": "rate"},
}  # fmt: skip
CASES = tuple((100 * elongation, pressure) for elongation, pressure in figures.LOAD_CASES)
REFERENCE_CAPTION = (
    "The artery against the independent radial reference",
    "Reference fibre angle at t = 150 by driver and law. Points: means of the layers of elements, random cells; "
    "lines: the radial reference, isotropic cells.",
)


# ---------------------------------------------------------------- the independent reference


def radial_reference(page: Page) -> None:
    """Layer means and final radii of the one-dimensional reference, and the picture that compares it with the runs."""
    histories = {name: solve_radial(**settings) for name, settings in REFERENCE.items()}  # type: ignore[arg-type]
    curves = {name: (history.points, history.fibre_angle(-2)) for name, history in histories.items()}
    for stretch, pressure in CASES:
        histories[f"case_{stretch:g}_{pressure:g}"] = solve_radial(pressure=pressure, stretch=stretch / 100)
    middle = (EDGES[1:] + EDGES[:-1]) / 2
    table = {"layer": np.arange(1, 9), "radius": middle}
    table |= {name: layer_means(history) for name, history in histories.items()}
    made = f"{_made_with(page.folder)}; tests/reference/radial.py"
    drawn(page, draw_reference, layer_angles(page.folder), curves, middle, made=made)
    page.save_table(table, ["tests/reference/radial.py: means over the element layers at t = 150, degrees"])
    inner, outer = (np.array([getattr(history, f"{face}_radii")[-1] for history in histories.values()])
                    for face in ("inner", "outer"))  # fmt: skip
    radii = {"name": list(histories), "inner_radius": inner, "outer_radius": outer}
    page.save_table(radii, ["tests/reference/radial.py: deformed radii at t = 150"], "radii")


def layer_means(history: RadialHistory) -> np.ndarray:
    """Fibre angles; row -2: the cells with which the last step was solved, as in a run's last row."""
    return np.array([history.mean_fibre_angle(a, b, -2) for a, b in zip(EDGES, EDGES[1:], strict=False)])


def draw_reference(runs: Columns, curves: dict[str, tuple[np.ndarray, np.ndarray]], middle: np.ndarray) -> Figure:
    """Points: means of layers; lines: the reference."""
    figure = Figure(figsize=(5.4, 3.6))
    axes = figure.add_axes((0.11, 0.14, 0.86, 0.83))
    labels = {"cauchy": r"$\sigma$, eq. (11)", "pk2": "$S$, eq. (11)", "finger": "$b$, eq. (11)",
              "rate": r"$\sigma$, eq. (10)"}  # fmt: skip
    for (name, (radius, angle)), colour in zip(curves.items(), COLOURS, strict=False):
        axes.plot(radius, angle, color=colour, lw=1.2)
        axes.plot(middle, runs[name], "o", ms=4, color=colour, label=labels[name])
    axes.plot([], [], color="0.3", lw=1.2, label="radial reference")
    axes.set(xlabel="reference radius $R$", ylabel="reference fibre angle at $t$ = 150 (degrees)", xlim=(1, 3))
    axes.set_ylim(-2, 92)
    axes.set_yticks(range(0, 91, 15))
    axes.legend(loc="upper left")
    return figure


def layer_angles(folder: Path) -> Columns:
    """Layer means of the runs at t = 150 by driver or law."""
    files = {"cauchy": "fig10", "pk2": "fig10", "finger": "fig11", "rate": "rate"}
    return {name: read_table(folder / f"{file}.csv")[f"fibre_angle_{name}"] for name, file in files.items()}


# ---------------------------------------------------------------- the numbers on the page


def all_numbers(folder: Path) -> dict[str, str]:
    """Every number in the prose, by its name in the template, as it is shown."""
    found: dict[str, str] = {}
    for part in (_cube, _tendon, _artery, _cases, _drivers, _energy):
        found |= part(folder)
    return found


def _cube(folder: Path) -> dict[str, str]:
    table = read_table(folder / "fig5.csv")
    kappas = ("0.01", "0.025", "0.05", "0.1")
    error = max(np.abs(table[f"angle_kappa_{k}"] - table[f"exact_kappa_{k}"]).max() for k in kappas)
    ends = {f"cube_end_{k.replace('.', '')}": f"{table[f'angle_kappa_{k}'][-1]:.1f}" for k in kappas}
    within = f"within {error:.1g} degrees" if error > 0 else "in all 7 digits of the table"
    return {"cube_within": within, "cube_start": f"{table['angle_kappa_0.1'][0]:.1f}"} | ends


def _tendon(folder: Path) -> dict[str, str]:
    table, seen = read_table(folder / "fig6.csv"), read_table(folder / "fig6-snapshots.csv")
    row = table["time"] == 12.0

    def value(name: str, time: float) -> float:
        return float(seen[name][seen["time"] == time].item())

    return {
        "tendon_peak": f"{100 * table['mean_stretch'][row].item():.1f}",
        "tendon_end": f"{100 * table['mean_stretch'][-1]:.1f}",
        "tendon_least": f"{table['min_stretch'][row].item():.2f}",
        "tendon_most": f"{table['max_stretch'][row].item():.2f}",
        "tendon_spread_end": f"{table['max_stretch'][-1] - table['min_stretch'][-1]:.3f}",
        "tendon_aligned": f"{value('stretch_most_aligned_tenth', 12.0):.2f}",
        "tendon_across": f"{value('stretch_least_aligned_tenth', 12.0):.2f}",
        "tendon_angle_1": f"{value('max_fibre_angle', 1.0):.0f}",
        "tendon_angle_12": f"{value('max_fibre_angle', 12.0):.0f}",
        "tendon_deformed_12": f"{value('max_fibre_angle_deformed', 12.0):.0f}",
        "tendon_deformed_mean_12": f"{value('mean_fibre_angle_deformed', 12.0):.0f}",
        "tendon_angle_end": f"{value('mean_fibre_angle', 150.0):.1f}",
        "tendon_l1": f"{value('min_l_1', 150.0):.4f}",
        "tendon_stiff_end": f"{100 * read_table(folder / 'stiff-tendon.csv')['mean_stretch'].item():.0f}",
        "left_of_start": f"{100 * np.exp(-0.025 * 149):.1f}",
    }


def _artery(folder: Path) -> dict[str, str]:
    history, seen = read_table(folder / "fig7-history.csv"), read_table(folder / "fig7.csv")
    outer, inner, time = history["outer_radius"], history["inner_radius"], history["time"]
    peak, at_24 = int(outer.argmax()), int(np.argmin(np.abs(time - 24.0)))
    layers = read_table(folder / "fig8.csv")
    return {
        "artery_peak": f"{outer[peak]:.3f}",
        "artery_peak_time": f"{time[peak]:g}",
        "artery_24": f"{outer[at_24]:.3f}",
        "artery_end": f"{outer[-1]:.3f}",
        "artery_shrinks": f"{outer[at_24] - outer[-1]:.3f}",
        "artery_stretch_inside": f"{inner[-1] / 1.0:.2f}",  # R_i = 1, R_o = 3
        "artery_stretch_outside": f"{outer[-1] / 3.0:.2f}",
        "artery_wall_24": f"{outer[at_24] - inner[at_24]:.2f}",
        "artery_wall_end": f"{outer[-1] - inner[-1]:.2f}",
        "artery_radial_start": f"{seen['mean_l_radial'][0]:.2f}",
        "artery_radial_end": f"{seen['mean_l_radial'][-1]:.3f}",
        "artery_middle_end": f"{history['fibre_angle_middle'][-1]:.1f}",
        "intima": f"{layers['fibre_angle'][0]:.1f}",
        "media": f"{layers['fibre_angle'][3]:.1f}",
        "adventitia": f"{layers['fibre_angle'][-1]:.1f}",
        "intima_deformed": f"{layers['fibre_angle_deformed'][0]:.1f}",
        "media_deformed": f"{layers['fibre_angle_deformed'][3]:.1f}",
        "adventitia_deformed": f"{layers['fibre_angle_deformed'][-1]:.1f}",
    }


def _cases(folder: Path) -> dict[str, str]:
    table = read_table(folder / "fig9.csv")

    def angles(stretch: float, pressure: float, name: str = "fibre_angle") -> np.ndarray:
        chosen = np.isclose(table["stretch"], stretch) & np.isclose(table["pressure"], pressure)
        return table[name][chosen]

    stretched, pressed = angles(0.1, 0.0), angles(0.0, 4.8)
    most, least = (angles(*case, f"fibre_angle_{name}") for case, name in (((0.0, 4.8), "most"), ((0.1, 0.0), "least")))
    reference = read_table(folder / "radial-reference.csv")["case_0_4.8"]
    stopped = read_table(folder / "stopped-points.csv")
    coarse, fine = read_table(folder / "pressure-meshes.csv")["fibre_angle_4"]
    first = stopped["radius"] < EDGES[1]
    return {
        "stretch_least": f"{stretched.min():.1f}",
        "stretch_most": f"{stretched.max():.1f}",
        "stretch_single": f"{least.min():.1f}",
        "pressure_1": f"{pressed[0]:.1f}",
        "pressure_3": f"{pressed[:3].max():.1f}",
        "pressure_4": f"{pressed[3]:.1f}",
        "pressure_reference_4": f"{reference[3]:.1f}",
        "pressure_coarse_4": f"{coarse:.1f}",
        "pressure_fine_4": f"{fine:.1f}",
        "pressure_single_1": f"{most[0]:.1f}",
        "pressure_single_4": f"{most[1:4].max():.1f}",
        "pressure_outside": f"{pressed[-1]:.1f}",
        "pressure_reference_outside": f"{reference[-1]:.1f}",
        "pressure_most": f"{most[-1]:.1f}",
        "stopped_points": f"{len(first)}",
        "stopped_inside": f"{first.sum()}",
        "stopped_passes": f"{stopped['passes'].min():.0f} to {stopped['passes'].max():.0f}",
        "stopped_angle": f"{stopped['fibre_angle'].max():.0f}",
    }


def _drivers(folder: Path) -> dict[str, str]:
    angles = layer_angles(folder)
    second, strain = read_table(folder / "fig10.csv"), read_table(folder / "fig11.csv")
    reference = read_table(folder / "radial-reference.csv")
    drivers = ("cauchy", "pk2", "finger")
    radii = read_table(folder / "radial-reference-radii.csv")
    exact = {face: radii[f"{face}_radius"][radii["name"] == "finger"].item() for face in ("inner", "outer")}
    drifted = read_table(folder / "fig11-history.csv")
    inner, outer = (drifted[f"{face}_radius_finger"][-1] for face in ("inner", "outer"))
    found = {f"variation_{name}": f"{np.ptp(angles[name]):.1f}" for name in drivers}
    found |= {f"reference_variation_{name}": f"{np.ptp(reference[name]):.1f}" for name in drivers}
    found |= {f"mean_difference_{name}": f"{np.abs(angles[name] - reference[name]).mean():.1f}" for name in angles}
    rate = next(row for row in rows_of(folder / "comparison-drivers.csv") if row["law"] == "rate")
    return found | {
        "rate_mean_outside": f"{rate['angle_mean_outside']:.2f}",
        "largest_difference_pk2": f"{np.abs(angles['cauchy'] - angles['pk2']).max():.1f}",
        "finger_inner_radius": f"{inner:.3f}",
        "finger_exact_inner_radius": f"{exact['inner']:.3f}",
        "finger_inner_error": f"{100 * (inner / exact['inner'] - 1):+.1f}",
        "finger_outer_radius": f"{outer:.3f}",
        "finger_exact_outer_radius": f"{exact['outer']:.3f}",
        "finger_outer_error": f"{100 * (outer / exact['outer'] - 1):+.1f}",
        "finger_parts": f"{(parts := int(drifted['substeps_finger'].max()))} part{'s' * (parts > 1)}",
        "finger_inside": f"{angles['finger'][0]:.1f}",
        "finger_outside": f"{angles['finger'][-1]:.1f}",
        "finger_reference_inside": f"{reference['finger'][0]:.1f}",
        "finger_reference_outside": f"{reference['finger'][-1]:.1f}",
        "finger_l3": f"{strain['l_3_finger'].min():.2f} to {strain['l_3_finger'].max():.2f}",
        "finger_shear": f"{strain['shear_finger'][0]:.3f}",
        "cauchy_shear": f"{second['shear_cauchy'].max():.3f}",
        "pk2_shear": f"{second['shear_pk2'].max():.3f}",
        "rate_outside": f"{angles['rate'][-1]:.1f}",
        "explicit_outside": f"{angles['cauchy'][-1]:.1f}",
        "rate_difference": f"{angles['cauchy'][-1] - angles['rate'][-1]:.1f}",
    }


def _energy(folder: Path) -> dict[str, str]:
    table = read_table(folder / "energy.csv")
    found = {}
    for demo in ("cube", "tendon", "artery"):
        chosen = table["demo"] == demo
        time, power, energy = (table[name][chosen] for name in ("time", "remodeling_power", "stored_energy"))
        negative = power < 0
        # from the last time at which it was not negative
        turn = int(np.flatnonzero(~negative)[-1]) + 1
        found |= {
            f"energy_turn_{demo}": f"{time[turn]:g}",
            f"energy_peak_{demo}": f"{energy.max():.3g}",
            f"energy_end_{demo}": f"{energy[-1]:.3g}",
        }
        if demo == "tendon":
            held = (time >= 12.0) & (time < time[-1])  # the passes between the solved states of t = 12 and of the end
            found["tendon_supplied"] = f"{-power[held].sum() * (time[1] - time[0]):.0f}"
            found["tendon_drop"] = f"{energy[time == 12.0].item() - energy[-1]:.0f}"
    curve = read_table(folder / "fig6.csv")
    shorter = curve["mean_stretch"][curve["time"] == 12.0].item() - curve["mean_stretch"][-1]
    return found | {"tendon_work": f"{curve['force'][-1] * 10.0 * shorter:.0f}"}  # the tendon is 10 long


# ---------------------------------------------------------------- tables


def layer_table(folder: Path) -> str:
    """Runs against the reference, layer by layer."""
    runs, reference = layer_angles(folder), read_table(folder / "radial-reference.csv")
    columns: list[tuple[str, Any]] = [("R", [f"{radius:g}" for radius in reference["radius"]])]
    for name, label in zip(REFERENCE, ("σ, eq. (11)", "S, eq. (11)", "b, eq. (11)", "σ, eq. (10)"), strict=True):
        columns += [(label, runs[name]), ("reference", reference[name])]
    return by_layer(columns)


def case_table(folder: Path) -> str:
    """Fig. 9, layer by layer, against the reference."""
    table, reference = read_table(folder / "fig9.csv"), read_table(folder / "radial-reference.csv")
    columns: list[tuple[str, Any]] = []
    for stretch, pressure in CASES:
        chosen = np.isclose(table["stretch"], stretch / 100) & np.isclose(table["pressure"], pressure)
        exact = reference[f"case_{stretch:g}_{pressure:g}"]
        columns += [(f"{stretch:g} %, p = {pressure:g}", table["fibre_angle"][chosen]), ("reference", exact)]
    return by_layer(columns)


def error_table(folder: Path, name: str, label: str, what: Callable[[dict[str, Any]], str]) -> str:
    """Finite elements against the reference, a row for each run."""
    header = [label, "to t =", "radii", "angle, mean", "outside the front", "largest"]
    return markdown(header, [
        [what(row), f"{row['end']:g}", percent(row["radii_percent"]), *(
            degrees(row[f"angle_{key}"]) for key in ("mean", "outside", "largest")
        )] for row in rows_of(folder / f"{name}.csv")
    ])  # fmt: skip


def percent(value: float) -> str:
    """Two significant digits; what is rounding is no number."""
    return "< 10⁻⁶ %" if value < 1e-6 else f"{value:.2g} %"


def degrees(value: float) -> str:
    """Two digits, or what is rounding."""
    return "< 10⁻⁶°" if value < 1e-6 else f"{value:.2f}°" if value >= 0.01 else f"{value:.1g}°"


def elements_of(row: dict[str, Any]) -> str:
    """The elements of a comparison in words."""
    return f"{row['around']:.0f} × {row['through']:.0f}, degree {row['degree']:.0f}"


def driver_of(row: dict[str, Any]) -> str:
    """Driver, supports and elements of a comparison, as cells of a table."""
    symbol = {"cauchy": "σ", "pk2": "S", "finger": "b"}[row["driver"]]
    law = {"explicit": "(11)", "rate": f"(10), front {row['front_from']:g} < R < {row['front_to']:g}"}[row["law"]]
    return f"{symbol}, eq. {law} | {row['supports']} | {elements_of(row)}"


def mesh_table(folder: Path) -> str:
    """Errors over the size of the elements, and the orders between one mesh and the next."""
    found, before = [], None
    keys = ("inner_radius_error", "outer_radius_error", "angle_mean")
    for row in rows_of(folder / "comparison-meshes.csv"):
        same = before is not None and before["degree"] == row["degree"]
        orders = [f" ({np.log2(before[key] / row[key]):.2f})" if same and before else "" for key in keys]
        size = f"{2.0 / row['through']:g}"
        found.append([f"{row['degree']:.0f}", elements_of(row).split(",")[0], size, *(
            f"{row[key]:.2e}{order}" for key, order in zip(keys, orders, strict=True)
        )])  # fmt: skip
        before = row
    header = ["degree", "around × through the wall", "h", "inner radius", "outer radius", "angle, mean (degrees)"]
    return markdown(header, found)


def invariance_table(folder: Path, turned: str) -> str:
    """What a turned body differs by."""
    header = ["driver", "frame", "l / r₀", "A / r₀²", "place", "energy", "mean reference angle"]
    found = []
    for row in rows_of(folder / "invariance.csv"):
        if row["turned"] == turned:
            angles = f"{row['angle_still']:.1f}° → {row['angle_turned']:.1f}°"
            found.append([row["driver"], f"`{row['frame']}`", *(
                small(row[key]) for key in ("lengths", "tensor", "position", "energy")
            ), angles])  # fmt: skip
    return markdown(header, found)


def small(value: float) -> str:
    """A difference: two digits, or its order of magnitude."""
    return f"{value:.2g}" if value > 1e-6 else f"10{str(int(np.ceil(np.log10(max(value, 1e-16))))).translate(RAISED)}"


RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def _made_with(folder: Path) -> str:
    """The line of Fig. 7 that says what it was made with."""
    return read_notes(folder, "fig7")["fig7.csv"][0].split(";")[0]


def page(kept: Path = FIGURES, template: str = "verification") -> str:
    """docs/verification.md, or the page of another template, from the tables in docs/figures."""
    values = all_numbers(kept) | page_values(kept) | {
        "table_layers": layer_table(kept),
        "table_cases": case_table(kept),
        "table_errors_cases": error_table(kept, "comparison-cases", "stretch, pressure",
                                          lambda row: f"{100 * row['stretch']:g} %, {row['pressure']:g}"),
        "table_errors_drivers": error_table(kept, "comparison-drivers", "driver | supports | elements", driver_of),
        "table_meshes": mesh_table(kept),
        "table_turned": invariance_table(kept, "deformed body"),
        "table_everything": invariance_table(kept, "everything"),
        "made_with": _made_with(kept),
        **{f"caption_{name}": figure.caption for name, figure in figures.FIGURES.items()},
        "caption_reference": REFERENCE_CAPTION[1],
    }  # fmt: skip
    values |= {name: fill(f"*{text}*", 100) for name, text in values.items() if name.startswith("caption_")}
    return (DOCS / f"{template}.template.md").read_text(encoding="utf-8").format_map(values)


def write_pages() -> None:
    """Both, from what is there."""
    for name in ("verification", "appendix_verification"):
        (DOCS / f"{name}.md").write_text(page(template=name), encoding="utf-8")


def make(keep: bool) -> None:
    """Draw, compare, keep, write."""
    folder, runs = Path("figures"), Path("results/verification-runs")
    if not keep:
        shutil.rmtree(runs, ignore_errors=True)
    figures.draw(list(figures.FIGURES), folder, runs, cores())
    radial_reference(Page(folder, "radial-reference", *REFERENCE_CAPTION))
    studies = study(folder, keep)
    pictures = (*figures.FIGURES, "radial-reference")
    files = [f"{name}.{ending}" for name in pictures for ending in ("png", "json")]
    for file in (*files, *(f"{name}.csv" for name in (*pictures, *MORE_TABLES, *studies))):
        shutil.copyfile(folder / file, FIGURES / file)
    write_pages()
