"""The consistent law beside the paper's on Figs. 5 to 11, for docs/verification.md.

Runs the preset `consistent` with the paper's kappa and with twice of it, and the printed method, where a reduced model
is exact (cube: a point; artery with isotropic cells: a ray); the tendon of Fig. 6 with its random cells is whole, and
the printed one is that of docs/figures/fig6.csv. A few minutes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from docs.making.pages import EDGES, FIGURES, Columns, drawn, panel_letters, read_table
from remodel_fenicsx.results.columns import Measurement
from remodel_fenicsx.scene import preset_scene
from remodel_fenicsx.studies.study import COLOURS, Page
from tests.runs import made

END, KAPPA = 150.0, 0.025
VARIANTS: dict[str, tuple[str, float, str, str]] = {
    "paper": ("kuhl-holzapfel-2007", 1.0, "the paper's law", COLOURS[0]),
    "once": ("consistent", 1.0, r"consistent, $\kappa$", COLOURS[1]),
    "twice": ("consistent", 2.0, r"consistent, $2\kappa$", COLOURS[2]),
}
KAPPAS = (0.01, 0.025, 0.05, 0.1)  # of Fig. 5
LOADS = {
    "10_0": (0.1, 0.0),
    "10_2.4": (0.1, 2.4),
    "10_4.8": (0.1, 4.8),
    "5_4.8": (0.05, 4.8),
    "0_4.8": (0.0, 4.8),
}
DRIVERS = ("pk2", "finger")
CAPTION = (
    "The consistent law beside the paper's",
    "Lines by law. (a) Mean angle to the load in the cube of Fig. 5; (b) stretch of the tendon of Fig. 6; (c) "
    "outer and inner radius of the artery of Fig. 7, isotropic cells; (d) its reference fibre angle over the "
    "radius at t = 150, Fig. 8.",
)


# ---------------------------------------------------------------- runs
def run(variant: str, shape: str, kinematics: str, **values: Any) -> tuple[Columns, np.ndarray]:
    """Columns, and means over the layers of the wall of the fibre angle at the end (of a tube)."""
    preset, factor, *_ = VARIANTS[variant]
    kappa = factor * values.pop("remodeling.kappa", KAPPA)
    changes = {
        "model.kinematics": kinematics,
        "output.fields": False,
        "time.end": END,
        "remodeling.kappa": kappa,
    }
    print(variant, shape, values, flush=True)
    with made(preset_scene(preset, shape).with_values(changes | values)) as simulation:
        steps = list(simulation.steps())
        columns = {name: np.array([step.row[name] for step in steps]) for name in steps[0].row}
        if shape != "tube":
            return columns, np.zeros(0)
        angle, volume = (
            Measurement(simulation.observer, steps[-1]).fibre_angle,
            simulation.quadrature.volumes,
        )
        layer = np.digitize(simulation.quadrature.coordinates[..., 0], EDGES) - 1
    return columns, np.array(
        [np.average(angle[layer == k], weights=volume[layer == k]) for k in range(8)]
    )


def histories() -> Columns:
    """By time: the cubes of Fig. 5, the tendon of Fig. 6, the artery of Fig. 7."""
    table: Columns = {"time": np.arange(1.0, END + 1)}
    for variant in VARIANTS:
        for kappa in KAPPAS:
            columns, _ = run(variant, "cube", "point", **{"remodeling.kappa": kappa})
            table[f"cube_{kappa:g}_{variant}"] = columns["mean_fibre_angle"]
        if variant != "paper":
            table[f"tendon_{variant}"] = run(variant, "tendon", "full")[0]["mean_stretch"]
    return table


def artery() -> tuple[Columns, Columns]:
    """By time the radii of Fig. 7, and by layer the angles of Figs. 8 to 11."""
    history: Columns = {}
    layers: Columns = {"layer": np.arange(1.0, 9.0), "radius": (EDGES[1:] + EDGES[:-1]) / 2}
    ray = {"cells.initial": "isotropic", "mesh.refinement": 2}
    for variant in VARIANTS:
        for case, (elongation, pressure) in LOADS.items():
            loads = {"loads.elongation.value": elongation, "loads.pressure.value": pressure}
            columns, layers[f"{case}_{variant}"] = run(variant, "tube", "radial", **ray, **loads)
            if case == "10_4.8":
                history |= {
                    f"{face}_{variant}": columns[f"{face}_radius"] for face in ("inner", "outer")
                }
        for driver in DRIVERS:
            layers[f"{driver}_{variant}"] = run(
                variant, "tube", "radial", **ray, **{"remodeling.driver": driver}
            )[1]
    return history, layers


# ---------------------------------------------------------------- picture
def draw(table: Columns, layers: Columns, tendon: Columns) -> Figure:
    """Four panels; a colour is a law."""
    figure = Figure(figsize=(7.2, 5.2), layout="constrained")
    panels = figure.subplots(2, 2).ravel()
    time, stretches = table["time"], table | {"tendon_paper": tendon["mean_stretch"][1:]}
    for variant, (_, _, label, colour) in VARIANTS.items():
        panels[0].plot(time, table[f"cube_0.025_{variant}"], color=colour, label=label)
        panels[1].plot(time, stretches[f"tendon_{variant}"], color=colour)
        for face in ("outer", "inner"):
            panels[2].plot(time, table[f"{face}_{variant}"], color=colour)
        panels[3].plot(layers["radius"], layers[f"10_4.8_{variant}"], "o-", ms=3, color=colour)
    names = ("angle to the load (degrees)", "mean stretch", "radius", "fibre angle (degrees)")
    for axes, name in zip(panels, names, strict=True):
        axes.set(xlabel="$t$", ylabel=name, xlim=(0, END))
    panels[3].set(xlabel="reference radius $R$", xlim=(1, 3), ylim=(0, 90))
    panels[0].legend(fontsize=7)
    panel_letters(*panels)
    return figure


# ---------------------------------------------------------------- the numbers on the page
def page_values(folder: Path) -> dict[str, str]:
    """What the page shows of the tables."""
    table, layers = (
        read_table(folder / f"{name}.csv") for name in ("consistent", "consistent-layers")
    )
    found: dict[str, str] = {}
    for variant in ("once", "twice"):
        # at the same time of the cells: a row of the printed method has those of the step before
        names = [(f"cube_{k:g}_{variant}", f"cube_{k:g}_paper") for k in KAPPAS]
        cubes = [np.abs(table[one][:-1] - table[other][1:]).max() for one, other in names]
        found[f"{variant}_cube"] = f"{max(cubes):.1f}"
        for case in (*LOADS, *DRIVERS):
            apart = np.abs(layers[f"{case}_{variant}"] - layers[f"{case}_paper"])
            found[f"{variant}_{case.replace('.', '')}"] = f"{apart.max():.1f}"
    return found


def make(keep: bool) -> None:
    """Run, draw, write the page."""
    from docs.making.verification import write_page

    page, source = Page(FIGURES, "consistent", *CAPTION), "docs/making/consistent.py"
    if not keep:
        table = histories()
        history, layers = artery()
        page.save_table(table | history, [source])
        page.save_table(layers, [source], "layers")
    tables = (
        read_table(FIGURES / f"{name}.csv") for name in ("consistent", "consistent-layers", "fig6")
    )
    drawn(page, draw, *tables, made=source)
    write_page()
