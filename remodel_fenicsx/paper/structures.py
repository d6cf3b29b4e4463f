"""Figs. 6 to 9: tendon and artery as they deform and remodel, in the paper's arrangement."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from remodel_fenicsx.model.cells import cylindrical_axes, radial_direction
from remodel_fenicsx.pictures.bodies import (
    ALL,
    Array,
    DrawnBody,
    Shown,
    Table,
    angle_scale,
    body,
    layers,
    place,
    radii,
)  # fmt: skip
from remodel_fenicsx.pictures.rendering import Picture, View, render
from remodel_fenicsx.paper.runs import ELONGATION_COLUMN, LOAD_CASES, load_case_name, made_with
from remodel_fenicsx.results.recording import RecordedRun
from remodel_fenicsx.results.whole_body import rank_of
from remodel_fenicsx.studies.page import COLOURS, Page, panel_letters

TENDON_TIMES = (1.0, 12.0, 25.0, 50.0, 150.0)
ARTERY_TIMES = (1.0, 24.0, 50.0, 100.0, 150.0)
WALL_LAYERS = {"intima": 0, "media": 3, "adventitia": 7}  # element layers of eight, from the inside

TO_LOAD = "deformed angle between chains and load axis: 0° along it, 90° across"
IN_WALL = "deformed angle of the chains in the wall{}: 0° circumferential, 90° axial"
SOLVED = "fields belong to the solved state of their time, before that time's remodeling pass"

FROM_ABOVE = (0.35, -1.0, 0.42)  # the direction from which tubes are seen


def element_table(snapshot: DrawnBody, shown: Shown = ALL) -> Table:
    """What is drawn of each element: reference centre, angles in degrees, cell dimensions, r/L."""
    x, y, z = snapshot.centres[shown].T
    fields = {name: values[shown] for name, values in snapshot.fields.items()}
    lengths = {f"l_{i + 1}": fields["cell_dimensions"][:, i] for i in range(3)}
    return {
        "time": np.full(len(x), snapshot.time),
        "element": np.arange(len(snapshot.elements))[shown],
        "x": x,
        "y": y,
        "z": z,
        "fibre_angle_deformed": fields["fibre_angle_deformed"],
        "fibre_angle": fields["fibre_angle"],
        **lengths,
        "axial_stretch": fields["deformation_gradient"][:, 8],
        "chain_extension": fields["chain_extension"],
    }


def wall_table(snapshot: DrawnBody, shown: Shown = ALL) -> Table:
    """`element_table` of a tube, with the radial component of its cells."""
    return element_table(snapshot, shown) | {"l_radial": radial_dimension(snapshot)[shown]}


def radial_dimension(snapshot: DrawnBody) -> Array:
    """The radial component sqrt(e_r . A e_r) of each element's cell, A = sum l_I^2 n_I n_I^T its mean, (elements,)."""
    radial = radial_direction(snapshot.centres)
    axes = np.stack([snapshot.fields[f"axis_{i + 1}"] for i in range(3)], axis=1)
    components = snapshot.fields["cell_dimensions"] * np.einsum("mij,mj->mi", axes, radial)
    return np.linalg.norm(components, axis=1)


def joined(tables: Sequence[Table]) -> Table:
    """Tables of the same columns, one under the other."""
    return {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}


def at(snapshot: DrawnBody) -> str:
    """The time, to stand in a label."""
    return f" at $t$ = {snapshot.time:g}"


def tube_picture(snapshot: DrawnBody, shown: Shown, height: float, pixels: tuple[int, int]) -> Picture:
    """A tube seen obliquely from above, its middle in the middle."""
    top = snapshot.deformed[:, 2].max()
    return Picture(View(FROM_ABOVE, (0.0, 0.0, top / 2), height, pixels), body(snapshot, shown))


# ---------------------------------------------------------------- the tendon


def draw_tendon(runs: dict[str, RecordedRun], page: Page) -> None:
    """Fig. 6: stretch over time, and snapshots coloured by the angle to the load axis."""
    run = runs["tendon"]
    snapshots = [DrawnBody.of(run, time) for time in TENDON_TIMES]
    longest = max(snapshot.deformed[:, 2].max() for snapshot in snapshots)
    height, pixels = 1.1 * longest, (270, 1000)
    pictures = [
        Picture(View((0.3, -1.0, 0.14), (0.0, 0.0, 0.495 * longest), height, pixels), body(snapshot))
        for snapshot in snapshots
    ]
    images = render(pictures)
    figure = Figure(figsize=(8.2, 4.3))
    axes = figure.add_axes((0.065, 0.115, 0.36, 0.825))
    columns = run.history
    axes.fill_between(columns["time"], columns["min_stretch"], columns["max_stretch"], color="0.88", lw=0,
                      label="elements, least to most")  # fmt: skip
    axes.plot(columns["time"], columns["mean_stretch"], color=COLOURS[0], label="mean")
    marks = [run.value("mean_stretch", time) for time in TENDON_TIMES]
    axes.plot(TENDON_TIMES, marks, "o", ms=4, color=COLOURS[0], clip_on=False)
    axes.set(xlabel="time", ylabel="stretch", xlim=(0, run.scene.time.end), ylim=(1.0, None))
    axes.legend(loc="upper right")
    panels = [axes]
    for number, (time, image) in enumerate(zip(TENDON_TIMES, images, strict=True)):
        panels.append(figure.add_axes((0.45 + 0.109 * number, 0.145, 0.109, 0.795)))
        place(panels[-1], image)
        panels[-1].set_title(f"$t$ = {time:g}")
    angle_scale(figure, (0.50, 0.115, 0.44, 0.022), TO_LOAD)
    panel_letters(*panels)
    page.save_figure(figure, made_with(run))
    notes = [made_with(run), "fig6, left; stretches 1 = undeformed, angle in degrees to the load axis (reference)"]
    names = ("time", "force", "mean_stretch", "min_stretch", "max_stretch", "mean_fibre_angle")
    page.save_table({name: columns[name] for name in names}, notes)
    page.save_table(joined([element_table(s) for s in snapshots]), [made_with(run), f"fig6, right; {SOLVED}"],
                    "elements")  # fmt: skip
    page.save_table(snapshot_summary(snapshots), [made_with(run), f"over all elements; {SOLVED}"], "snapshots")


def snapshot_summary(snapshots: Sequence[DrawnBody]) -> Table:
    """What the paper says of the tendon's elements, by time: angles, least l_1, stretch of the extreme tenths."""
    rows = []
    for snapshot in snapshots:
        fields = snapshot.fields
        reference, deformed = fields["fibre_angle"], fields["fibre_angle_deformed"]
        stretch = fields["deformation_gradient"][np.argsort(reference), 8]
        tenth = len(stretch) // 10
        rows.append({
            "time": snapshot.time,
            "mean_fibre_angle": reference.mean(),
            "max_fibre_angle": reference.max(),
            "mean_fibre_angle_deformed": deformed.mean(),
            "max_fibre_angle_deformed": deformed.max(),
            "stretch_most_aligned_tenth": stretch[:tenth].mean(),
            "stretch_least_aligned_tenth": stretch[-tenth:].mean(),
            "min_l_1": fields["cell_dimensions"][:, 0].min(),
        })  # fmt: skip
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


# ---------------------------------------------------------------- the artery


def draw_artery(runs: dict[str, RecordedRun], page: Page) -> None:
    """Fig. 7: five snapshots of the artery."""
    run = runs["artery"]
    snapshots = [DrawnBody.of(run, time) for time in ARTERY_TIMES]
    figure = Figure(figsize=(8.2, 3.5))
    loads = [(run.value(ELONGATION_COLUMN, time), run.value("pressure", time)) for time in ARTERY_TIMES]
    panels = _tubes(figure, snapshots, [ALL] * len(snapshots), loads)
    for axes, time in zip(panels, ARTERY_TIMES, strict=True):
        axes.set_title(f"$t$ = {time:g}")
    angle_scale(figure, (0.25, 0.125, 0.5, 0.026), IN_WALL.format(""))
    panel_letters(*panels)
    page.save_figure(figure, made_with(run))
    names = ("pressure", ELONGATION_COLUMN, "inner_radius", "outer_radius",
             "fibre_angle_inner", "fibre_angle_middle", "fibre_angle_outer")  # fmt: skip
    summary = {"time": list(ARTERY_TIMES)} | {name: [run.value(name, t) for t in ARTERY_TIMES] for name in names}
    summary["mean_l_radial"] = [radial_dimension(s).mean() for s in snapshots]
    meaning = "rows of the run's history; reference angles in degrees; mean_l_radial: radial component, all elements"
    page.save_table(summary, [made_with(run), meaning])
    history = {name: run.history[name] for name in ("time", *names)}
    page.save_table(history, [made_with(run), "the whole history"], "history")
    tables = [wall_table(s) for s in snapshots]
    page.save_table(joined(tables), [made_with(run), f"what is drawn; {SOLVED}"], "elements")


def _tubes(
    figure: Figure, snapshots: Sequence[DrawnBody], shown: Sequence[Shown], loads: Sequence[tuple[float, float]]
) -> list[Axes]:
    """Five tubes beside each other, on one scale, with elongation and pressure below each; returns their panels."""
    height = 1.25 * max(snapshot.deformed[:, 2].max() for snapshot in snapshots)
    images = render([tube_picture(*one, height, (360, 560)) for one in zip(snapshots, shown, strict=True)])
    panels = []
    for number, ((elongation, pressure), image) in enumerate(zip(loads, images, strict=True)):
        panels.append(figure.add_axes((0.005 + 0.198 * number, 0.215, 0.198, 0.72)))
        place(panels[-1], image)
        _write_below(panels[-1], f"elongation {100 * elongation:.2g} %,  $p$ = {pressure:.3g}", 7)
    return panels


def _write_below(axes: Axes, text: str, size: float) -> None:
    axes.text(0.5, -0.015, text, transform=axes.transAxes, ha="center", va="top", fontsize=size, color="0.35")


def layer_table(snapshot: DrawnBody) -> Table:
    """Means and extremes over each element layer of a tube's wall, from the inside; angles in degrees.

    `shear` is the largest root mean square of a shear component of F in the local directions: nearly 0 in a tube that
    stays round, large where it swirls or where elements are sheared to and fro.
    """
    number = layers(snapshot)
    of_layer = [number == k for k in range(number.max() + 1)]
    count = np.bincount(number)

    def means(values: Array) -> Array:
        # the elements of a layer are alike: their mean is the volume mean
        return np.bincount(number, values) / count

    fields, shear = snapshot.fields, local_shear(snapshot)
    return {
        "layer": np.arange(1, len(count) + 1),
        "radius": means(radii(snapshot.points, snapshot.elements)),
        "deformed_radius": means(radii(snapshot.deformed, snapshot.elements)),
        "fibre_angle": means(fields["fibre_angle"]),
        "fibre_angle_least": np.array([fields["fibre_angle"][those].min() for those in of_layer]),
        "fibre_angle_most": np.array([fields["fibre_angle"][those].max() for those in of_layer]),
        "fibre_angle_deformed": means(fields["fibre_angle_deformed"]),
        **{f"l_{i + 1}": means(fields["cell_dimensions"][:, i]) for i in range(3)},
        "l_radial": means(radial_dimension(snapshot)),
        "shear": np.array([np.sqrt(np.mean(shear[those] ** 2, axis=0)).max() for those in of_layer]),
    }


def local_shear(snapshot: DrawnBody) -> Array:
    """The six off-diagonal components of F in circumferential, axial and radial direction, (elements, 6)."""
    directions = cylindrical_axes(snapshot.centres)
    gradient = snapshot.fields["deformation_gradient"].reshape(-1, 3, 3)
    local = directions @ gradient @ np.swapaxes(directions, 1, 2)
    return local[:, ~np.eye(3, dtype=bool)]


def draw_layers(runs: dict[str, RecordedRun], page: Page) -> None:
    """Fig. 8: the end of Fig. 7, three layers of its wall apart."""
    run = runs["artery"]
    snapshot = DrawnBody.of(run, run.scene.time.end)
    number, table = layers(snapshot), layer_table(snapshot)
    tallest = snapshot.deformed[:, 2].max()
    images = render([tube_picture(snapshot, number == k, 1.27 * tallest, (440, 600)) for k in WALL_LAYERS.values()])
    figure = Figure(figsize=(6.4, 3.95))
    panels = []
    for place_number, ((name, k), image) in enumerate(zip(WALL_LAYERS.items(), images, strict=True)):
        axes = figure.add_axes((0.01 + 0.33 * place_number, 0.255, 0.32, 0.69))
        panels.append(axes)
        place(axes, image)
        axes.set_title(name)
        means = f"{table['fibre_angle'][k]:.1f}° reference, {table['fibre_angle_deformed'][k]:.1f}° deformed"
        _write_below(axes, f"layer {k + 1} of {len(table['layer'])}; mean angle\n{means}", 7.5)
    angle_scale(figure, (0.2, 0.125, 0.6, 0.025), IN_WALL.format(at(snapshot)))
    panel_letters(*panels)
    page.save_figure(figure, made_with(run))
    page.save_table(table, [made_with(run), f"means over element layers; time {run.scene.time.end:g}; {SOLVED}"])
    drawn = np.isin(number, list(WALL_LAYERS.values()))
    page.save_table(wall_table(snapshot, drawn), [made_with(run), "the elements that are drawn"], "elements")


def peeled(snapshot: DrawnBody) -> NDArray[np.bool_]:
    """The elements that stay when each layer of the wall but the innermost is cut shorter than the one inside it."""
    row = rank_of(snapshot.centres[:, 2])
    return row < row.max() + 1 - layers(snapshot)


def draw_load_cases(runs: dict[str, RecordedRun], page: Page) -> None:
    """Fig. 9: the ends of five load cases, the layers virtually peeled off."""
    cases = [runs[load_case_name(*case)] for case in LOAD_CASES]
    snapshots = [DrawnBody.of(run, run.scene.time.end) for run in cases]
    figure = Figure(figsize=(8.2, 3.4))
    panels = _tubes(figure, snapshots, [peeled(s) for s in snapshots], LOAD_CASES)
    angle_scale(figure, (0.25, 0.125, 0.5, 0.026), IN_WALL.format(at(snapshots[0])))
    panel_letters(*panels)
    made = made_with(cases[0])
    page.save_figure(figure, made)
    layered = [_with_loads(case, layer_table(s)) for case, s in zip(LOAD_CASES, snapshots, strict=True)]
    page.save_table(joined(layered), [made, f"means over element layers; {SOLVED}"])
    drawn = [_with_loads(case, wall_table(s, peeled(s))) for case, s in zip(LOAD_CASES, snapshots, strict=True)]
    page.save_table(joined(drawn), [made, f"the elements that are drawn; {SOLVED}"], "elements")


def _with_loads(case: tuple[float, float], table: Table) -> Table:
    """A table with the loads of its case in front; `stretch` is the elongation."""
    rows = len(next(iter(table.values())))
    return {"stretch": np.full(rows, case[0]), "pressure": np.full(rows, case[1])} | table
