"""Makes docs/verification.md and docs/figures/ anew: ./with-fenicsx python3 docs/make_verification.py

Draws every figure (runs that are still valid are used again), solves the independent radial reference of tests/, keeps
the pictures and the small tables in docs/figures/, and writes the page from docs/verification.template.md, where {name}
pictures and the small tables in docs/figures/, and writes the page from make_verification.template.md, where {name}
run could change.
"""

from __future__ import annotations

import csv
import shutil
import sys
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS.parent))

from remodel_fenicsx import figures  # noqa: E402
from remodel_fenicsx.figures.output import COLOURS, STYLE, Page, read_table  # noqa: E402
from tests.reference.radial import solve_radial  # noqa: E402

KEPT = DOCS / "figures"
EDGES = np.linspace(1.0, 3.0, 9)  # of the eight element layers
REFERENCE = {
    "cauchy": {"driver": "cauchy"},
    "pk2": {"driver": "pk2"},
    "finger": {"driver": "finger"},
    "rate": {"law": "rate"},
}
CASES = ((10.0, 0.0), (10.0, 2.4), (10.0, 4.8), (5.0, 4.8), (0.0, 4.8))

Columns = dict[str, np.ndarray]


def numbers_of(path: Path) -> Columns:
    """Columns of a table; those of words stay words."""
    found = {}
    for name, values in read_table(path).items():
        try:
            found[name] = np.array(values, dtype=float)
        except ValueError:
            found[name] = np.array(values)
    return found


# ---------------------------------------------------------------- the independent reference


def radial_reference(page: Page) -> None:
    """Layer means of the one-dimensional reference, and the picture that compares them with the runs."""
    table: dict[str, np.ndarray] = {"layer": np.arange(1, 9), "radius": (EDGES[1:] + EDGES[:-1]) / 2}
    curves = {}
    for name, settings in REFERENCE.items():
        history = solve_radial(**settings)  # type: ignore[arg-type]
        # row -2: the cells with which the last step was solved, as in a run's last row
        curves[name] = history.points, history.fibre_angle(-2)
        table[name] = np.array([history.mean_fibre_angle(a, b, -2) for a, b in zip(EDGES, EDGES[1:], strict=False)])
    for stretch, pressure in CASES:
        history = solve_radial(pressure=pressure, stretch=stretch / 100)
        name = f"case_{stretch:g}_{pressure:g}"
        table[name] = np.array([history.mean_fibre_angle(a, b, -2) for a, b in zip(EDGES, EDGES[1:], strict=False)])
    runs = layer_angles(page.folder)
    figure = Figure(figsize=(5.4, 3.6))
    axes = figure.add_axes((0.11, 0.14, 0.86, 0.83))
    labels = {"cauchy": r"$\sigma$, eq. (11)", "pk2": "$S$, eq. (11)", "finger": "$b$, eq. (11)",
              "rate": r"$\sigma$, eq. (10)"}  # fmt: skip
    for (name, (radius, angle)), colour in zip(curves.items(), COLOURS, strict=False):
        axes.plot(radius, angle, color=colour, lw=1.2)
        axes.plot(table["radius"], runs[name], "o", ms=4, color=colour, label=labels[name])
    axes.plot([], [], color="0.3", lw=1.2, label="radial reference")
    axes.set(xlabel="reference radius $R$", ylabel="fibre angle at $t$ = 150 (degrees)", xlim=(1, 3), ylim=(-2, 92))
    axes.set_yticks(range(0, 91, 15))
    axes.legend(loc="upper left")
    made_with = "points: layer means of the runs, random cells; lines: tests/reference/radial.py, isotropic cells"
    page.save_figure(figure, "The artery against the independent radial reference", made_with)
    page.save_table(table, ["tests/reference/radial.py: means over the element layers at t = 150, degrees"])


def layer_angles(folder: Path) -> Columns:
    """Layer means of the runs at t = 150 by driver or law."""
    second, strain, rate = (numbers_of(folder / f"{name}.csv") for name in ("fig10", "fig11", "rate"))
    return {
        "cauchy": second["fibre_angle_cauchy"],
        "pk2": second["fibre_angle_pk2"],
        "finger": strain["fibre_angle_finger"],
        "rate": rate["fibre_angle_rate"],
    }


# ---------------------------------------------------------------- the numbers on the page


def all_numbers(folder: Path) -> dict[str, str]:
    """Every number in the prose, by its name in the template, as it is shown."""
    found: dict[str, str] = {}
    for part in (_cube, _tendon, _artery, _cases, _drivers, _energy):
        found |= part(folder)
    return found


def _cube(folder: Path) -> dict[str, str]:
    table = numbers_of(folder / "fig5.csv")
    kappas = ("0.01", "0.025", "0.05", "0.1")
    error = max(np.abs(table[f"angle_kappa_{k}"] - table[f"exact_kappa_{k}"]).max() for k in kappas)
    ends = {f"cube_end_{k.replace('.', '')}": f"{table[f'angle_kappa_{k}'][-1]:.1f}" for k in kappas}
    within = f"within {error:.1g} degrees" if error > 0 else "in all 7 digits of the table"
    return {"cube_within": within, "cube_start": f"{table['angle_kappa_0.1'][0]:.1f}"} | ends


def _tendon(folder: Path) -> dict[str, str]:
    table, elements = numbers_of(folder / "fig6.csv"), numbers_of(folder / "fig6-elements.csv")
    first = elements["time"] == 1.0
    loaded, end = elements["time"] == 12.0, elements["time"] == 150.0
    row = table["time"] == 12.0
    order = np.argsort(elements["fibre_angle"][loaded])
    stretch = elements["axial_stretch"][loaded][order]
    tenth = len(order) // 10
    return {
        "tendon_peak": f"{100 * table['mean_stretch'][row].item():.1f}",
        "tendon_end": f"{100 * table['mean_stretch'][-1]:.1f}",
        "tendon_least": f"{table['min_stretch'][row].item():.2f}",
        "tendon_most": f"{table['max_stretch'][row].item():.2f}",
        "tendon_spread_end": f"{table['max_stretch'][-1] - table['min_stretch'][-1]:.3f}",
        "tendon_aligned": f"{stretch[:tenth].mean():.2f}",
        "tendon_across": f"{stretch[-tenth:].mean():.2f}",
        "tendon_angle_1": f"{elements['fibre_angle'][first].max():.0f}",
        "tendon_angle_12": f"{elements['fibre_angle'][loaded].max():.0f}",
        "tendon_deformed_12": f"{elements['fibre_angle_deformed'][loaded].max():.0f}",
        "tendon_deformed_mean_12": f"{elements['fibre_angle_deformed'][loaded].mean():.0f}",
        "tendon_angle_end": f"{elements['fibre_angle'][end].mean():.1f}",
        "tendon_l1": f"{elements['l_1'][end].min():.4f}",
    }


def _artery(folder: Path) -> dict[str, str]:
    history, elements = numbers_of(folder / "fig7-history.csv"), numbers_of(folder / "fig7-elements.csv")
    outer, inner, time = history["outer_radius"], history["inner_radius"], history["time"]
    peak, at_24 = int(outer.argmax()), int(np.argmin(np.abs(time - 24.0)))
    first, end = elements["time"] == 1.0, elements["time"] == 150.0
    layers = numbers_of(folder / "fig8.csv")
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
        "artery_l3_start": f"{elements['l_3'][first].mean():.2f}",
        "artery_l3_end": f"{elements['l_3'][end].mean():.3f}",
        "artery_middle_end": f"{history['fibre_angle_middle'][-1]:.1f}",
        "intima": f"{layers['fibre_angle'][0]:.1f}",
        "media": f"{layers['fibre_angle'][3]:.1f}",
        "adventitia": f"{layers['fibre_angle'][-1]:.1f}",
    }


def _cases(folder: Path) -> dict[str, str]:
    table = numbers_of(folder / "fig9.csv")

    def angles(stretch: float, pressure: float, name: str = "fibre_angle") -> np.ndarray:
        chosen = np.isclose(table["stretch"], stretch) & np.isclose(table["pressure"], pressure)
        return table[name][chosen]

    stretched, pressed = angles(0.1, 0.0), angles(0.0, 4.8)
    return {
        "stretch_least": f"{stretched.min():.1f}",
        "stretch_most": f"{stretched.max():.1f}",
        "pressure_inside": f"{pressed[:4].max():.1f}",
        "pressure_outside": f"{pressed[-1]:.1f}",
        "pressure_most": f"{angles(0.0, 4.8, 'fibre_angle_most')[-1]:.1f}",
    }


def _drivers(folder: Path) -> dict[str, str]:
    angles = layer_angles(folder)
    second, strain = numbers_of(folder / "fig10.csv"), numbers_of(folder / "fig11.csv")
    reference = numbers_of(folder / "radial-reference.csv")
    drivers = ("cauchy", "pk2", "finger")
    found = {f"variation_{name}": f"{np.ptp(angles[name]):.1f}" for name in drivers}
    found |= {f"reference_variation_{name}": f"{np.ptp(reference[name]):.1f}" for name in drivers}
    found |= {f"mean_difference_{name}": f"{np.abs(angles[name] - reference[name]).mean():.1f}" for name in angles}
    return found | {
        "largest_difference_pk2": f"{np.abs(angles['cauchy'] - angles['pk2']).max():.1f}",
        "finger_inside": f"{angles['finger'][0]:.1f}",
        "finger_outside": f"{angles['finger'][-1]:.1f}",
        "finger_reference_inside": f"{reference['finger'][0]:.1f}",
        "finger_reference_outside": f"{reference['finger'][-1]:.1f}",
        "finger_l3": f"{strain['l_3_finger'].min():.2f} to {strain['l_3_finger'].max():.2f}",
        "finger_shear": f"{strain['shear_finger'][0]:.2f}",
        "cauchy_shear": f"{second['shear_cauchy'].max():.3f}",
        "pk2_shear": f"{second['shear_pk2'].max():.3f}",
        "rate_outside": f"{angles['rate'][-1]:.1f}",
        "explicit_outside": f"{angles['cauchy'][-1]:.1f}",
        "rate_difference": f"{angles['cauchy'][-1] - angles['rate'][-1]:.1f}",
    }


def _energy(folder: Path) -> dict[str, str]:
    table = numbers_of(folder / "energy.csv")
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
    curve = numbers_of(folder / "fig6.csv")
    shorter = curve["mean_stretch"][curve["time"] == 12.0].item() - curve["mean_stretch"][-1]
    return found | {"tendon_work": f"{curve['force'][-1] * 10.0 * shorter:.0f}"}  # the tendon is 10 long


# ---------------------------------------------------------------- tables


def markdown(header: list[str], rows: list[list[str]]) -> str:
    """A table in Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def layer_table(folder: Path) -> str:
    """Runs against the reference, layer by layer."""
    runs, reference = layer_angles(folder), numbers_of(folder / "radial-reference.csv")
    header = ["layer", "R"]
    for label in ("σ, eq. (11)", "S, eq. (11)", "b, eq. (11)", "σ, eq. (10)"):
        header += [label, "reference"]
    rows = []
    for k in range(8):
        row = [str(k + 1), f"{reference['radius'][k]:g}"]
        for name in REFERENCE:
            row += [f"{runs[name][k]:.1f}", f"{reference[name][k]:.1f}"]
        rows.append(row)
    return markdown(header, rows)


def case_table(folder: Path) -> str:
    """Fig. 9, layer by layer, against the reference."""
    table, reference = numbers_of(folder / "fig9.csv"), numbers_of(folder / "radial-reference.csv")
    header, columns = ["layer"], []
    for stretch, pressure in CASES:
        chosen = np.isclose(table["stretch"], stretch / 100) & np.isclose(table["pressure"], pressure)
        header += [f"{stretch:g} %, p = {pressure:g}", "reference"]
        columns += [table["fibre_angle"][chosen], reference[f"case_{stretch:g}_{pressure:g}"]]
    return markdown(header, [[str(k + 1), *(f"{column[k]:.1f}" for column in columns)] for k in range(8)])


def made_with(folder: Path) -> str:
    """The line of Fig. 7 that says what it was made with."""
    return (folder / "fig7.csv").read_text(encoding="utf-8").splitlines()[1].removeprefix("# ").split(";")[0]


def page(kept: Path = KEPT) -> str:
    """docs/verification.md from what is in docs/figures."""
    with (kept / "numbers.csv").open(newline="", encoding="utf-8") as file:
        values = {row["name"]: row["value"] for row in csv.DictReader(file)}
    values |= {"table_layers": layer_table(kept), "table_cases": case_table(kept), "made_with": made_with(kept)}
    return (DOCS / "make_verification.template.md").read_text(encoding="utf-8").format_map(values)


def main() -> None:
    """Draw, keep, write."""
    drawn = figures.DEFAULT_FOLDER
    figures.draw(folder=drawn)
    reference = Page(drawn, "radial-reference")
    with matplotlib.rc_context(STYLE):
        radial_reference(reference)
    KEPT.mkdir(exist_ok=True)
    for name in (*figures.FIGURES, "radial-reference"):
        for ending in ("png", "csv"):
            shutil.copyfile(drawn / f"{name}.{ending}", KEPT / f"{name}.{ending}")
    with (KEPT / "numbers.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["name", "value"])
        writer.writerows(all_numbers(drawn).items())
    (DOCS / "verification.md").write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
