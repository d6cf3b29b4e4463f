"""docs/verification.md and docs/figures/.

Draws every figure, solves the independent radial reference of tests/, makes the studies of docs/making/studies.py, and
keeps the pictures and the small tables in docs/figures/. The page is verification.template.md. Each {name}
in it is computed from the tables in docs/figures/, so that a test can do the same without a run.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from demos import figures
from docs.making.consistent import page_values
from docs.making.pages import DOCS, EDGES, FIGURES, Columns, drawn, markdown, read_table, rows_of
from docs.making.studies import study
from remodel_fenicsx.studies.study import COLOURS, Page, read_notes
from remodel_fenicsx.system.children import cores
from tests.reference.radial import RadialHistory, solve_radial

MORE_TABLES = (
    "fig6-snapshots",
    "fig7-history",
    "fig10-history",
    "fig11-history",
    "radial-reference-radii",
)
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
    curves = {
        name: (history.points, history.fibre_angle(-2)) for name, history in histories.items()
    }
    for stretch, pressure in CASES:
        histories[f"case_{stretch:g}_{pressure:g}"] = solve_radial(
            pressure=pressure, stretch=stretch / 100
        )
    middle = (EDGES[1:] + EDGES[:-1]) / 2
    table = {"layer": np.arange(1, 9), "radius": middle}
    table |= {name: layer_means(history) for name, history in histories.items()}
    made = f"{_made_with(page.folder)}; tests/reference/radial.py"
    drawn(page, draw_reference, layer_angles(page.folder), curves, middle, made=made)
    page.save_table(
        table, ["tests/reference/radial.py: means over the element layers at t = 150, degrees"]
    )
    inner, outer = (np.array([getattr(history, f"{face}_radii")[-1] for history in histories.values()])
                    for face in ("inner", "outer"))  # fmt: skip
    radii = {"name": list(histories), "inner_radius": inner, "outer_radius": outer}
    page.save_table(radii, ["tests/reference/radial.py: deformed radii at t = 150"], "radii")


def layer_means(history: RadialHistory) -> np.ndarray:
    """Fibre angles; row -2: the cells with which the last step was solved, as in a run's last row."""
    return np.array(
        [history.mean_fibre_angle(a, b, -2) for a, b in zip(EDGES, EDGES[1:], strict=False)]
    )


def draw_reference(
    runs: Columns, curves: dict[str, tuple[np.ndarray, np.ndarray]], middle: np.ndarray
) -> Figure:
    """Points: means of layers; lines: the reference."""
    figure = Figure(figsize=(5.4, 3.6))
    axes = figure.add_axes((0.11, 0.14, 0.86, 0.83))
    labels = {"cauchy": r"$\sigma$, eq. (11)", "pk2": "$S$, eq. (11)", "finger": "$b$, eq. (11)",
              "rate": r"$\sigma$, eq. (10)"}  # fmt: skip
    for (name, (radius, angle)), colour in zip(curves.items(), COLOURS, strict=False):
        axes.plot(radius, angle, color=colour, lw=1.2)
        axes.plot(middle, runs[name], "o", ms=4, color=colour, label=labels[name])
    axes.plot([], [], color="0.3", lw=1.2, label="radial reference")
    axes.set(
        xlabel="reference radius $R$",
        ylabel="reference fibre angle at $t$ = 150 (degrees)",
        xlim=(1, 3),
    )
    axes.set_ylim(-2, 92)
    axes.set_yticks(range(0, 91, 15))
    axes.legend(loc="upper left")
    return figure


def layer_angles(folder: Path) -> Columns:
    """Layer means of the runs at t = 150 by driver or law."""
    files = {"cauchy": "fig10", "pk2": "fig10", "finger": "fig11", "rate": "rate"}
    return {
        name: read_table(folder / f"{file}.csv")[f"fibre_angle_{name}"]
        for name, file in files.items()
    }


# ---------------------------------------------------------------- the numbers on the page


class Numbers:
    """A column as templates ask for it: {fig8[fibre_angle].last:.1f}, or {fig6[mean_stretch][12]:.2f} at a time."""

    def __init__(self, values: np.ndarray, places: np.ndarray):
        self.values, self.places = values, places

    def __getattr__(self, how: str) -> Any:
        v = self.values
        if how == "percent":
            return Numbers(100 * v, self.places)
        return {
            "first": v[0],
            "last": v[-1],
            "least": v.min(),
            "most": v.max(),
            "mean": v.mean(),
            "spread": np.ptp(v),
        }[how]

    def __getitem__(self, place: int) -> float:
        return float(self.values[self.places == place].item())


class Tables(dict[str, Any]):
    """Those of a folder, by the name of the file, beside what else a template names."""

    def __init__(self, folder: Path, others: dict[str, str]):
        super().__init__(others)
        self.folder = folder

    def __missing__(self, name: str) -> dict[str, Numbers]:
        table = read_table(self.folder / f"{name}.csv")
        self[name] = {
            column: Numbers(values, next(iter(table.values()))) for column, values in table.items()
        }
        return dict(self[name])


def all_numbers(folder: Path) -> dict[str, str]:
    """Numbers in the prose that no table has as they are, by their names in the template, as they are shown."""
    return _runs(folder) | _cases(folder) | _drivers(folder) | _energy(folder)


def _runs(folder: Path) -> dict[str, str]:
    cube, tendon, artery = (
        read_table(folder / f"{name}.csv") for name in ("fig5", "fig6", "fig7-history")
    )
    kappas = ("0.01", "0.025", "0.05", "0.1")
    error = max(np.abs(cube[f"angle_kappa_{k}"] - cube[f"exact_kappa_{k}"]).max() for k in kappas)
    outer, inner, time = artery["outer_radius"], artery["inner_radius"], artery["time"]
    at_24 = int(np.argmin(np.abs(time - 24.0)))
    return {
        "cube_within": (
            f"within {error:.1g} degrees" if error > 0 else "in all 7 digits of the table"
        ),
        "tendon_spread_end": f"{tendon['max_stretch'][-1] - tendon['min_stretch'][-1]:.3f}",
        "left_of_start": f"{100 * np.exp(-0.025 * 149):.1f}",
        "artery_stretch_outside": f"{outer[-1] / 3.0:.2f}",  # R_i = 1, R_o = 3
        "artery_wall_24": f"{outer[at_24] - inner[at_24]:.2f}",
        "artery_wall_end": f"{outer[-1] - inner[-1]:.2f}",
    }


def _cases(folder: Path) -> dict[str, str]:
    table = read_table(folder / "fig9.csv")

    stretched = table["fibre_angle"][
        np.isclose(table["stretch"], 0.1) & np.isclose(table["pressure"], 0.0)
    ]
    return {
        "stretch_least": f"{stretched.min():.1f}",
        "stretch_most": f"{stretched.max():.1f}",
    }


def _drivers(folder: Path) -> dict[str, str]:
    angles = layer_angles(folder)
    reference = read_table(folder / "radial-reference.csv")
    radii = read_table(folder / "radial-reference-radii.csv")
    exact = {
        face: radii[f"{face}_radius"][radii["name"] == "finger"].item()
        for face in ("inner", "outer")
    }
    drifted = read_table(folder / "fig11-history.csv")
    inner, outer = (drifted[f"{face}_radius_finger"][-1] for face in ("inner", "outer"))
    found = {
        f"mean_difference_{name}": f"{np.abs(angles[name] - reference[name]).mean():.1f}"
        for name in angles
    }
    rate = next(row for row in rows_of(folder / "comparison-drivers.csv") if row["law"] == "rate")
    return found | {
        "rate_mean_outside": f"{rate['angle_mean_outside']:.2f}",
        "largest_difference_pk2": f"{np.abs(angles['cauchy'] - angles['pk2']).max():.1f}",
        "finger_exact_inner_radius": f"{exact['inner']:.3f}",
        "finger_inner_error": f"{100 * (inner / exact['inner'] - 1):+.1f}",
        "finger_exact_outer_radius": f"{exact['outer']:.3f}",
        "finger_outer_error": f"{100 * (outer / exact['outer'] - 1):+.1f}",
        "rate_difference": f"{angles['cauchy'][-1] - angles['rate'][-1]:.1f}",
    }


def _energy(folder: Path) -> dict[str, str]:
    table, curve = read_table(folder / "energy.csv"), read_table(folder / "fig6.csv")
    is_tendon = table["demo"] == "tendon"
    time, power, energy = (
        table[name][is_tendon] for name in ("time", "remodeling_power", "stored_energy")
    )
    held = (time >= 12.0) & (
        time < time[-1]
    )  # the passes between the solved states of t = 12 and of the end
    shorter = curve["mean_stretch"][curve["time"] == 12.0].item() - curve["mean_stretch"][-1]
    return {
        "tendon_supplied": f"{-power[held].sum() * (time[1] - time[0]):.0f}",
        "tendon_drop": f"{energy[time == 12.0].item() - energy[-1]:.0f}",
        "tendon_work": f"{curve['force'][-1] * 10.0 * shorter:.0f}",  # the tendon is 10 long
    }


# ---------------------------------------------------------------- tables


def case_table(folder: Path) -> tuple[str, str]:
    """Fig. 9, layer by layer, and the mean difference from the reference."""
    table, reference = read_table(folder / "fig9.csv"), read_table(folder / "radial-reference.csv")
    header, rows = ["layer"], [[str(number)] for number in range(1, 9)]
    differences = []
    for stretch, pressure in CASES:
        header.append(f"{stretch:g} %, p = {pressure:g}")
        chosen = np.isclose(table["stretch"], stretch / 100) & np.isclose(
            table["pressure"], pressure
        )
        angles = table["fibre_angle"][chosen]
        differences.append(angles - reference[f"case_{stretch:g}_{pressure:g}"])
        for row, angle in zip(rows, angles, strict=True):
            row.append(f"{angle:.1f}")
    return markdown(header, rows), f"{np.abs(differences).mean():.1f}"


def error_table(
    rows: list[dict[str, Any]], label: str, what: Callable[[dict[str, Any]], str]
) -> str:
    """Finite elements against the reference, a row for each run."""
    header = [label, "radii", "angle, mean", "outside the front", "largest"]
    return markdown(header, [
        [what(row), percent(row["radii_percent"]), *(
            degrees(row[f"angle_{key}"]) for key in ("mean", "outside", "largest")
        )] for row in rows
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
    law = {
        "explicit": "(11)",
        "rate": f"(10), front {row['front_from']:g} < R < {row['front_to']:g}",
    }[row["law"]]
    return f"{symbol}, eq. {law} | {row['supports']} | {elements_of(row)} | {row['end']:g}"


def _made_with(folder: Path) -> str:
    """The line of Fig. 7 that says what it was made with."""
    return read_notes(folder, "fig7")["fig7.csv"][0].split(";")[0]


def page(kept: Path = FIGURES) -> str:
    """docs/verification.md, from the tables in docs/figures."""
    table_cases, case_difference = case_table(kept)
    values = all_numbers(kept) | page_values(kept) | {
        "table_cases": table_cases,
        "case_difference": case_difference,
        "table_errors_cases": error_table(rows_of(kept / "comparison-cases.csv"), "stretch, pressure",
                                          lambda row: f"{100 * row['stretch']:g} %, {row['pressure']:g}"),
        "table_errors_drivers": error_table(  # the first row is one of the cases
            rows_of(kept / "comparison-drivers.csv")[1:], "driver | supports | elements | to t =", driver_of
        ),
        "made_with": _made_with(kept),
    }  # fmt: skip
    return (
        Path(__file__)
        .with_suffix(".template.md")
        .read_text(encoding="utf-8")
        .format_map(Tables(kept, values))
    )


def write_page() -> None:
    """From what is there."""
    (DOCS / "verification.md").write_text(page(), encoding="utf-8")


def make(keep: bool) -> None:
    """Draw, compare, keep, write."""
    folder, runs = Path("figures"), Path("results/verification-runs")
    if not keep:
        shutil.rmtree(runs, ignore_errors=True)
    figures.draw(list(figures.FIGURES), folder, runs, cores())
    radial_reference(Page(folder, "radial-reference", *REFERENCE_CAPTION))
    studies = study(folder, keep)
    pictures = (*figures.FIGURES, "radial-reference")
    files = [
        *(f"{name}.png" for name in pictures),
        *(f"{name}.json" for name in (*pictures, *studies)),
    ]
    for file in (*files, *(f"{name}.csv" for name in (*pictures, *MORE_TABLES, *studies))):
        shutil.copyfile(folder / file, FIGURES / file)
    write_page()
