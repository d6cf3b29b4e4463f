"""Figs. 1, 5, 10 and 11, the two forms of the evolution law, and Remark 6: curves from runs and closed forms."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from remodel_fenicsx.chains import CHAINS
from remodel_fenicsx.figures.bodies import angle_scale, place
from remodel_fenicsx.figures.output import COLOURS, Page
from remodel_fenicsx.figures.recordings import Array, Recording, Table
from remodel_fenicsx.figures.rendering import render
from remodel_fenicsx.figures.runs import KAPPAS
from remodel_fenicsx.figures.structures import SOLVED, layer_table, peeled, tube_picture

PERSISTENCE_LENGTHS = (0.1, 0.4, 0.8)  # Remark 1
ANGLE_LABEL = "fibre angle (degrees)"
DRIVER_NAMES = {
    "cauchy": r"Cauchy stress $\sigma$",
    "pk2": "second Piola-Kirchhoff stress $S$",
    "finger": "Finger tensor $b$",
}


def draw_chain_force(runs: dict[str, Recording], page: Page) -> None:
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
    made_with = "eq. (2), wormlike chain; no simulation"
    page.save_figure(figure, "Force of a single chain (Fig. 1)", made_with)
    notes = [made_with, "force for k theta = 1; lengths in link lengths"]
    page.save_table({"extension": extension} | {f"force_A_{A:g}": force[A] for A in PERSISTENCE_LENGTHS}, notes)


def closed_form_angle(time: Array, kappa: float) -> Array:
    """Angle between chain and load in degrees: cells that were isotropic at first, all of e on the load axis.

    l_1 = r0 (1 - s)/sqrt(3) + r0 s and l_2 = l_3 = r0 (1 - s)/sqrt(3), with s = 1 - exp(-kappa t) (eq. 11).
    """
    s = 1 - np.exp(-kappa * time)
    return np.degrees(np.arctan(np.sqrt(2) * (1 - s) / (1 - s + np.sqrt(3) * s)))


def draw_alignment(runs: dict[str, Recording], page: Page) -> None:
    """Fig. 5: how fast the chains of a cube align, for several kappa; circles are the closed form."""
    figure = Figure(figsize=(4.8, 3.3))
    axes = figure.add_axes((0.12, 0.15, 0.84, 0.81))
    table: Table = {}
    for kappa, colour in zip(KAPPAS, COLOURS, strict=False):
        columns = runs[f"cube-{kappa:g}"].history
        time = columns["time"]
        step = runs[f"cube-{kappa:g}"].scene.time.step
        # a row is the state before the pass of its time: its cells are those of the time before
        exact = closed_form_angle(time - step, kappa)
        table |= {"time": time, f"angle_kappa_{kappa:g}": columns["mean_fibre_angle"], f"exact_kappa_{kappa:g}": exact}
        axes.plot(time, columns["mean_fibre_angle"], color=colour, label=rf"$\kappa$ = {kappa:g}")
        axes.plot(time[9::10], exact[9::10], "o", ms=3.5, mfc="white", mec=colour)
    axes.plot([], [], "o", ms=3.5, mfc="white", mec="0.4", label="closed form")
    axes.set(xlabel="time", ylabel="angle between chains and load (degrees)", xlim=(0, 100), ylim=(0, 60))
    axes.legend(loc="upper right")
    made_with = runs[f"cube-{KAPPAS[0]:g}"].made_with()
    page.save_figure(figure, "Alignment of the chains of a cube under tension (Fig. 5)", made_with)
    notes = [made_with, "angle_kappa_K: run with kappa = K; exact_kappa_K: closed form of the cells of the same row"]
    page.save_table(table, [*notes, "rows belong to the solved state, whose cells are those after the pass before"])


# ---------------------------------------------------------------- through the wall


def draw_drivers(runs: dict[str, Recording], page: Page, other: str) -> None:
    """Figs. 10 and 11: angle over radius (left), peeled tubes (right), for the Cauchy stress and another driver."""
    pair = {"cauchy": runs["artery"], other: runs[f"artery-{other}"]}
    ends = {driver: run.snapshot(run.scene.time.end) for driver, run in pair.items()}
    tallest = max(snapshot.deformed[:, 2].max() for snapshot in ends.values())
    images = render([tube_picture(s, peeled(s), 1.25 * tallest, (390, 560)) for s in ends.values()])
    tables = {driver: layer_table(snapshot) for driver, snapshot in ends.items()}
    figure = Figure(figsize=(8.2, 3.5))
    axes = figure.add_axes((0.065, 0.145, 0.40, 0.81))
    for (driver, table), colour in zip(tables.items(), COLOURS, strict=False):
        axes.fill_between(table["radius"], table["fibre_angle_least"], table["fibre_angle_most"], color=colour,
                          alpha=0.15, lw=0)  # fmt: skip
        axes.plot(table["radius"], table["fibre_angle"], "o-", ms=3.5, color=colour, label=DRIVER_NAMES[driver])
    axes.set(xlabel="reference radius $R$", ylabel=ANGLE_LABEL, xlim=(1, 3), ylim=(-2, 92))
    axes.set_yticks(range(0, 91, 15))
    axes.legend(loc="upper left", title="driven by", alignment="left")
    axes.text(0.985, 0.02, "lines: means of the element layers; bands: all elements", transform=axes.transAxes,
              ha="right", fontsize=6.5, color="0.4")  # fmt: skip
    for number, (driver, image) in enumerate(zip(tables, images, strict=True)):
        picture = figure.add_axes((0.50 + 0.245 * number, 0.215, 0.24, 0.71))
        place(picture, image)
        picture.set_title(DRIVER_NAMES[driver], pad=3, fontsize=8.5)
    angle_scale(figure, (0.545, 0.15, 0.40, 0.026), "deformed angle: 0° circumferential, 90° axial")
    title = f"Remodeling driven by {' and '.join(tables)} (Fig. {10 if other == 'pk2' else 11})"
    page.save_figure(figure, title, pair["cauchy"].made_with())
    columns = {name: tables["cauchy"][name] for name in ("layer", "radius")}
    shown = ("fibre_angle", "fibre_angle_least", "fibre_angle_most", "fibre_angle_deformed", "l_3", "shear")
    for driver, table in tables.items():
        columns |= {f"{name}_{driver}": table[name] for name in shown}
    page.save_table(columns, [pair["cauchy"].made_with(), f"element layers, reference angles in degrees; {SOLVED}"])


def draw_rate(runs: dict[str, Recording], page: Page) -> None:
    """Erratum 7: eqs. (10) and (11) on the same artery."""
    pair = {"eq. (11), explicit": runs["artery"], "eq. (10), rate": runs["artery-rate"]}
    figure = Figure(figsize=(7.6, 3.2))
    over_time, over_radius = figure.add_axes((0.065, 0.15, 0.42, 0.80)), figure.add_axes((0.56, 0.15, 0.415, 0.80))
    places = {"inner": ":", "middle": "--", "outer": "-"}
    columns: Table = {}
    profile: Table = {}
    for (label, run), colour in zip(pair.items(), COLOURS, strict=False):
        law = run.scene.remodeling.law
        for name, dashes in places.items():
            angle = run.history[f"fibre_angle_{name}"]
            columns |= {"time": run.history["time"], f"fibre_angle_{name}_{law}": angle}
            over_time.plot(run.history["time"], angle, dashes, color=colour, lw=1.4)
        table = layer_table(run.snapshot(run.scene.time.end))
        profile |= {"layer": table["layer"], "radius": table["radius"]}
        profile |= {f"{name}_{law}": table[name] for name in ("fibre_angle", "fibre_angle_least", "fibre_angle_most")}
        over_radius.fill_between(table["radius"], table["fibre_angle_least"], table["fibre_angle_most"], color=colour,
                                 alpha=0.15, lw=0)  # fmt: skip
        over_radius.plot(table["radius"], table["fibre_angle"], "o-", ms=3.5, color=colour, label=label)
    for name, dashes in places.items():
        over_time.plot([], [], dashes, color="0.3", lw=1.4, label=f"{name} wall")
    over_time.set(xlabel="time", ylabel=ANGLE_LABEL, xlim=(0, 150), ylim=(-2, 92))
    over_radius.set(xlabel="reference radius $R$ (at $t$ = 150)", xlim=(1, 3.02), ylim=(-2, 92))
    for axes in (over_time, over_radius):
        axes.set_yticks(range(0, 91, 15))
        axes.legend(loc="upper left")
    made_with = pair["eq. (11), explicit"].made_with()
    page.save_figure(figure, "Eqs. (10) and (11) on the same artery (erratum 7)", made_with)
    page.save_table(profile, [made_with, f"element layers at the end, reference angles in degrees; {SOLVED}"])
    page.save_table(columns, [made_with, "rows of the two histories, reference angles in degrees"], "history")


# ---------------------------------------------------------------- Remark 6


def draw_energy(runs: dict[str, Recording], page: Page) -> None:
    """Remark 6: stored energy and power of remodeling over time for cube, tendon and artery."""
    demos = {"cube": runs["cube-0.025"], "tendon": runs["tendon"], "artery": runs["artery"]}
    figure = Figure(figsize=(8.2, 4.0))
    tables = []
    for number, (name, run) in enumerate(demos.items()):
        columns = run.history
        time, energy, power = columns["time"], columns["stored_energy"], columns["remodeling_power"]
        left = 0.085 + 0.322 * number
        above, below = figure.add_axes((left, 0.57, 0.25, 0.37)), figure.add_axes((left, 0.14, 0.25, 0.37))
        above.plot(time, energy, color=COLOURS[0])
        below.plot(time, power, color=COLOURS[1])
        _shade_sign(below, time, power)
        ramp_end = max(load.ramp[-1][0] for load in run.scene.loads.values())
        for axes in (above, below):
            axes.axvline(ramp_end, color="0.6", lw=0.8, ls=":")
            axes.set_xlim(0, run.scene.time.end)
        above.set_title(name)
        above.set_xticklabels([])
        above.set_ylim(0, None)
        below.set_xlabel("time")
        if number == 0:
            for axes, label in ((above, "stored energy"), (below, "power of remodeling")):
                axes.set_ylabel(label)
                axes.yaxis.set_label_coords(-0.25, 0.5)
        tables.append({"demo": np.full(len(time), name), "time": time, "stored_energy": energy,
                       "remodeling_power": power})  # fmt: skip
    explanation = "green: the passes release stored energy; red: they take energy in; dotted: end of the ramp"
    figure.text(0.99, 0.01, explanation, fontsize=6.5, color="0.35", ha="right")
    made_with = demos["artery"].made_with()
    page.save_figure(figure, "Stored energy and power of remodeling (Remark 6)", made_with)
    meaning = "remodeling_power = -dW/dl . dl/dt - dW/dn . dn/dt, over the body: positive where a pass releases"
    notes = [made_with, f"{meaning} stored energy at frozen deformation"]
    page.save_table({key: np.concatenate([table[key] for table in tables]) for key in tables[0]}, notes)


def _shade_sign(axes: Axes, time: Array, power: Array) -> None:
    axes.axhline(0.0, color="0.3", lw=0.8)
    axes.fill_between(time, np.maximum(power, 0.0), 0.0, color=COLOURS[2], alpha=0.25, lw=0)
    axes.fill_between(time, np.minimum(power, 0.0), 0.0, color=COLOURS[1], alpha=0.25, lw=0)
