"""Figs. 1, 5, 10 and 11, the two forms of the evolution law, and Remark 6: curves from runs and closed forms."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from remodel_fenicsx.model.chains import CHAINS
from remodel_fenicsx.pictures.bodies import Array, DrawnBody, Table, angle_scale, place
from remodel_fenicsx.pictures.rendering import render
from remodel_fenicsx.paper.runs import KAPPAS, first_cells, made_with
from remodel_fenicsx.paper.structures import SOLVED, at, joined, layer_table, peeled, tube_picture, wall_table
from remodel_fenicsx.results.recording import RecordedRun
from remodel_fenicsx.studies.page import COLOURS, Page, panel_letters

PERSISTENCE_LENGTHS = (0.1, 0.4, 0.8)  # Remark 1
ANGLE_LABEL = "reference fibre angle{} (degrees)"
DRIVER_LABELS = {
    "cauchy": ("Cauchy stress", r"$\sigma$"),
    "pk2": ("second Piola-Kirchhoff stress", "$S$"),
    "finger": ("Finger tensor", "$b$"),
}
PLACES = {"inner": ":", "middle": "--", "outer": "-"}


def draw_chain_force(runs: dict[str, RecordedRun], page: Page) -> None:
    """Fig. 1: the force of a single chain."""
    extension = np.linspace(0.0, 0.95, 191)
    force = {A: CHAINS["wormlike"].force(extension, 1.0, A) for A in PERSISTENCE_LENGTHS}
    figure = Figure(figsize=(4.2, 3.1))
    axes = figure.add_axes((0.13, 0.16, 0.83, 0.80))
    for A, colour in zip(PERSISTENCE_LENGTHS, COLOURS, strict=False):
        axes.plot(extension, force[A], color=colour, label=f"$A$ = {A:g}")
    axes.axvline(1.0, color="0.5", lw=0.8, ls=":")
    axes.set(xlabel="chain stretch $r/L$", ylabel=r"chain force $f$ for $k\theta$ = 1", xlim=(0, 1.02), ylim=(0, 30))
    axes.legend(title="persistence length", loc="upper left")
    made = "eq. (2), wormlike chain; no simulation"
    page.save_figure(figure, made)
    notes = [made, "force for k theta = 1; lengths in link lengths"]
    page.save_table({"extension": extension} | {f"force_A_{A:g}": force[A] for A in PERSISTENCE_LENGTHS}, notes)


def closed_form_angle(time: Array, kappa: float) -> Array:
    """Angle between chain and load in degrees: cells that were isotropic at first, all of e on the load axis.

    l_1 = r0 (1 - s)/sqrt(3) + r0 s and l_2 = l_3 = r0 (1 - s)/sqrt(3), with s = 1 - exp(-kappa t) (eq. 11).
    """
    s = 1 - np.exp(-kappa * time)
    return np.degrees(np.arctan(np.sqrt(2) * (1 - s) / (1 - s + np.sqrt(3) * s)))


def draw_alignment(runs: dict[str, RecordedRun], page: Page) -> None:
    """Fig. 5: how fast the chains of a cube align, for several kappa; circles are the closed form."""
    figure = Figure(figsize=(4.8, 3.3))
    axes = figure.add_axes((0.12, 0.15, 0.84, 0.81))
    table: Table = {}
    for kappa, colour in zip(KAPPAS, COLOURS, strict=False):
        columns = runs[f"cube-{kappa:g}"].history
        time = columns["time"]
        step = runs[f"cube-{kappa:g}"].scene.time.step
        # a row is the state before the pass of its time: its cells are those of the time before, or the first ones
        exact = closed_form_angle(np.maximum(time - step, 0.0), kappa)
        marked = np.isclose(time % 10.0, 0.0) & (time > 0)
        table |= {"time": time, f"angle_kappa_{kappa:g}": columns["mean_fibre_angle"], f"exact_kappa_{kappa:g}": exact}
        axes.plot(time, columns["mean_fibre_angle"], color=colour, label=rf"$\kappa$ = {kappa:g}")
        axes.plot(time[marked], exact[marked], "o", ms=3.5, mfc="white", mec=colour)
    axes.plot([], [], "o", ms=3.5, mfc="white", mec="0.4", label="closed form")
    axes.set(xlabel="time", ylabel="angle between chains and load (degrees)", xlim=(0, 100), ylim=(0, 60))
    axes.legend(loc="upper right")
    made = made_with(runs[f"cube-{KAPPAS[0]:g}"])
    page.save_figure(figure, made)
    notes = [made, "angle_kappa_K: run with kappa = K; exact_kappa_K: closed form of the cells of the same row"]
    page.save_table(table, [*notes, "rows belong to the solved state, whose cells are those after the pass before"])


# ---------------------------------------------------------------- through the wall


def draw_drivers(runs: dict[str, RecordedRun], page: Page, other: str) -> None:
    """Figs. 10 and 11: angle over radius (left), peeled tubes (right), for the Cauchy stress and another driver."""
    pair = {"cauchy": runs["artery"], other: runs[f"artery-{other}"]}
    ends = {driver: DrawnBody.of(run, run.scene.time.end) for driver, run in pair.items()}
    tallest = max(snapshot.deformed[:, 2].max() for snapshot in ends.values())
    images = render([tube_picture(s, peeled(s), 1.25 * tallest, (390, 560)) for s in ends.values()])
    when = at(ends["cauchy"])
    figure = Figure(figsize=(8.2, 3.5))
    axes = figure.add_axes((0.065, 0.145, 0.40, 0.79))
    _draw_profiles(axes, {" ".join(DRIVER_LABELS[driver]): layer_table(snapshot) for driver, snapshot in ends.items()})
    axes.set(xlabel="reference radius $R$", ylabel=ANGLE_LABEL.format(when))
    axes.legend(loc="upper left", title="driven by", alignment="left")
    panels = [axes]
    for number, (driver, image) in enumerate(zip(ends, images, strict=True)):
        panels.append(figure.add_axes((0.50 + 0.245 * number, 0.215, 0.24, 0.72)))
        place(panels[-1], image)
        panels[-1].set_title(f"driven by {DRIVER_LABELS[driver][1]}")
    angle_scale(figure, (0.545, 0.15, 0.40, 0.026), f"deformed angle{when}: 0° circumferential, 90° axial")
    panel_letters(*panels)
    page.save_figure(figure, made_with(pair["cauchy"]))
    _save_drivers(pair, ends, page)


def _draw_profiles(axes: Axes, tables: dict[str, Table]) -> None:
    """Angle over reference radius by label: means of the layers, and bands of all elements."""
    for (label, table), colour in zip(tables.items(), COLOURS, strict=False):
        least, most = table["fibre_angle_least"], table["fibre_angle_most"]
        axes.fill_between(table["radius"], least, most, color=colour, alpha=0.15, lw=0)
        axes.plot(table["radius"], table["fibre_angle"], "o-", ms=3.5, color=colour, label=label)
    axes.set(xlim=(1, 3.02), ylim=(-2, 92))
    axes.set_xticks(np.arange(1.0, 3.1, 0.5))
    axes.set_yticks(range(0, 91, 15))


def _save_drivers(pair: dict[str, RecordedRun], ends: dict[str, DrawnBody], page: Page) -> None:
    """Layers, histories and every element that is drawn, of both drivers."""
    made = made_with(pair["cauchy"])
    layers: Table = {}
    history: Table = {}
    elements = []
    shown = ("fibre_angle", "fibre_angle_least", "fibre_angle_most", "fibre_angle_deformed", "l_3", "l_radial", "shear")
    recorded = ("inner_radius", "outer_radius", *(f"fibre_angle_{name}" for name in PLACES), "substeps")
    for driver, snapshot in ends.items():
        table, rows = layer_table(snapshot), pair[driver].history
        layers |= {name: table[name] for name in ("layer", "radius")}
        layers |= {f"{name}_{driver}": table[name] for name in shown}
        history |= {"time": rows["time"]} | {f"{name}_{driver}": rows[name] for name in recorded}
        drawn = wall_table(snapshot, peeled(snapshot))
        elements.append({"driver": np.full(len(drawn["time"]), driver)} | drawn)
    page.save_table(layers, [made, f"element layers, reference angles in degrees; {SOLVED}"])
    page.save_table(history, [made, "rows of the two histories, reference angles in degrees"], "history")
    page.save_table(joined(elements), [made, f"the elements that are drawn; {SOLVED}"], "elements")


def draw_rate(runs: dict[str, RecordedRun], page: Page) -> None:
    """Erratum 7: eqs. (10) and (11) on the same artery."""
    pair = {"eq. (11), explicit": runs["artery"], "eq. (10), rate": runs["artery-rate"]}
    figure = Figure(figsize=(7.8, 3.6))
    over_time, over_radius = figure.add_axes((0.065, 0.135, 0.42, 0.79)), figure.add_axes((0.56, 0.135, 0.415, 0.79))
    ends = {label: DrawnBody.of(run, run.scene.time.end) for label, run in pair.items()}
    tables = {label: layer_table(snapshot) for label, snapshot in ends.items()}
    _draw_rate_histories(over_time, pair)
    _draw_profiles(over_radius, tables)
    when = at(ends["eq. (10), rate"])
    over_radius.set(xlabel="reference radius $R$", ylabel=ANGLE_LABEL.format(when))
    over_radius.legend(loc="upper left")
    columns: Table = {}
    profile: Table = {}
    for label, run in pair.items():
        law, table = run.scene.remodeling.law, tables[label]
        angles = {f"fibre_angle_{name}_{law}": run.history[f"fibre_angle_{name}"] for name in PLACES}
        columns |= {"time": run.history["time"]} | angles
        profile |= {"layer": table["layer"], "radius": table["radius"]}
        profile |= {f"{name}_{law}": table[name] for name in ("fibre_angle", "fibre_angle_least", "fibre_angle_most")}
    made = made_with(pair["eq. (11), explicit"])
    panel_letters(over_time, over_radius)
    page.save_figure(figure, made)
    page.save_table(profile, [made, f"element layers at the end, reference angles in degrees; {SOLVED}"])
    page.save_table(columns, [made, "rows of the two histories, reference angles in degrees"], "history")


def _draw_rate_histories(axes: Axes, pair: dict[str, RecordedRun]) -> None:
    """Angle over time at three places of the wall; a colour for each law, dashes for each place."""
    for (label, run), colour in zip(pair.items(), COLOURS, strict=False):
        for name, dashes in PLACES.items():
            axes.plot(run.history["time"], run.history[f"fibre_angle_{name}"], dashes, color=colour, lw=1.4)
        axes.plot([], [], color=colour, lw=1.4, label=label)
    axes.plot([], [], " ", label=" ")  # fills the legend's first column
    for name, dashes in PLACES.items():
        axes.plot([], [], dashes, color="0.3", lw=1.4, label=f"{name} wall")
    end = next(iter(pair.values())).scene.time.end
    axes.set(xlabel="time", ylabel=ANGLE_LABEL.format(""), xlim=(0, end), ylim=(-2, 92))
    axes.set_yticks(range(0, 91, 15))
    axes.legend(loc="upper left", ncols=2, columnspacing=1.2)


# ---------------------------------------------------------------- Remark 6


def draw_energy(runs: dict[str, RecordedRun], page: Page) -> None:
    """Remark 6: stored energy and power of remodeling over time for cube, tendon and artery."""
    demos = {"cube": runs["cube-0.025"], "tendon": runs["tendon"], "artery": runs["artery"]}
    figure = Figure(figsize=(8.2, 4.2))
    unit = demos["cube"].scene.material.stress_unit
    labels = f"stored energy\n({unit} · length³)", f"power of remodeling\n({unit} · length³ / time)"
    panels = []
    for number, (name, run) in enumerate(demos.items()):
        left = 0.11 + 0.313 * number
        above, below = figure.add_axes((left, 0.575, 0.245, 0.36)), figure.add_axes((left, 0.12, 0.245, 0.36))
        panels.append((above, below))
        _draw_energy(above, below, run)
        above.set_title(f"{name}, {first_cells(run)}", fontsize=8.5)
        if number == 0:
            for axes, label in zip((above, below), labels, strict=True):
                axes.set_ylabel(label)
                axes.yaxis.set_label_coords(-0.26, 0.5)
    panel_letters(*(axes for row in zip(*panels, strict=True) for axes in row))
    made = made_with(demos["artery"], ", ".join(f"{first_cells(run)} ({name})" for name, run in demos.items()))
    page.save_figure(figure, made)
    meaning = "remodeling_power = -dW/dl . dl/dt - dW/dn . dn/dt, over the body: positive where a pass releases"
    notes = [made, f"{meaning} stored energy at frozen deformation; in {unit}, the scene's length and time"]
    names = ("time", "stored_energy", "remodeling_power")
    tables = [{"demo": np.full(len(run.history["time"]), demo)} | {name: run.history[name] for name in names}
              for demo, run in demos.items()]  # fmt: skip
    page.save_table(joined(tables), notes)


def _draw_energy(above: Axes, below: Axes, run: RecordedRun) -> None:
    """Stored energy above; below the power of remodeling, a pass's over the whole of its step."""
    time = run.history["time"]
    above.plot(time, run.history["stored_energy"], color=COLOURS[0])
    _draw_power(below, time, run.history["remodeling_power"][1:])  # no pass comes before t = 0
    ramp_end = run.scene.end_of_ramps
    for axes in (above, below):
        axes.axvline(ramp_end, color="0.6", lw=0.8, ls=":")
        axes.set_xlim(0, run.scene.time.end)
    above.set_xticklabels([])
    above.set_ylim(0, None)
    below.set_xlabel("time")


def _draw_power(axes: Axes, edges: Array, power: Array) -> None:
    """Power (n,) of the steps between n + 1 times; green where energy is released, red where it is taken in."""
    for sign, colour in ((1, COLOURS[2]), (-1, COLOURS[1])):
        axes.stairs(sign * np.maximum(sign * power, 0.0), edges, fill=True, color=colour, alpha=0.25, lw=0)
    axes.stairs(power, edges, baseline=None, color=COLOURS[1], lw=1.2)
    axes.axhline(0.0, color="0.3", lw=0.8)
