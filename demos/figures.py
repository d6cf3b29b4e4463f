"""Figs. 1 and 5 to 11 of Kuhl & Holzapfel 2007 from runs of the paper's preset, each with its numbers as CSV.

    ./with-fenicsx python3 demos/figures.py [NAME...] [-o FOLDER] [--runs FOLDER] [--jobs N]

Names are fig1, fig5 to fig11, rate (eqs. 10 and 11 on one artery) and energy (Remark 6); none: all. A figure needs the
runs that `FIGURES` names, and `scenes` says what each run is. All of them take an hour or more of one core. A run is
kept in its folder and used again while its scene and the versions are the same; one that was stopped goes on.

NAME.png has title, caption and versions in its file, NAME.csv and NAME-PART.csv have what is drawn, and NAME.json says
what that is. `Page`, `run_all` and `drawn` are the tools; each `draw_...` is a figure.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time as clock
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from mpi4py import MPI
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from remodel_fenicsx import Recording, RecordingError, Scene, __version__, preset_scene
from remodel_fenicsx.extend import CHAINS

PRESET = "kuhl-holzapfel-2007"
PERSISTENCE_LENGTHS = (0.1, 0.4, 0.8)  # Remark 1
KAPPAS = (0.01, 0.025, 0.05, 0.1)  # those of the printed Fig. 5 cannot be read
LOAD_CASES = (
    (0.10, 0.0),
    (0.10, 2.4),
    (0.10, 4.8),
    (0.05, 4.8),
    (0.0, 4.8),
)  # Fig. 9: (elongation, pressure)
TENDON_TIMES = (1.0, 12.0, 25.0, 50.0, 150.0)
ARTERY_TIMES = (1.0, 24.0, 50.0, 100.0, 150.0)
WALL_LAYERS = {
    "intima": 0,
    "media": 3,
    "adventitia": 7,
}  # of eight layers of elements, from the inside
PLACES = {"inner": ":", "middle": "--", "outer": "-"}

COLOURS = ("#1b4f9c", "#d1495b", "#2a9d6f", "#e09f3e")
STYLE: dict[str, Any] = {
    "font.size": 8.5, "axes.titlesize": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
    "grid.color": "0.9", "grid.linewidth": 0.6, "lines.linewidth": 1.6, "legend.frameon": False,
}  # fmt: skip
DOTS_PER_INCH = 200
ANGLES, LEVELS = (
    "RdYlBu",
    18,
)  # red along the first direction, blue across it, in steps of 5 degrees
ABOVE = (0.35, -1.0, 0.42)  # from where tubes are seen
MARK = "remodel_fenicsx figures"  # in NAME.json
SOLVED = "fields belong to the solved state of their time, before that time's remodeling pass"

Columns = dict[str, Any]
Runs = Mapping[str, Recording]


# ---------------------------------------------------------------- the runs


def case_name(elongation: float, pressure: float) -> str:
    """The run of one of Fig. 9's load cases."""
    return (
        "artery"
        if (elongation, pressure) == (0.10, 4.8)
        else f"artery-{100 * elongation:g}-{pressure:g}"
    )


def scenes() -> dict[str, Scene]:
    """Every scene that a figure needs, by name; of most only the last fields are drawn."""
    artery = preset_scene(PRESET, "tube")
    last_only = {"output.every": artery.time.number_of_steps}
    found = {"tendon": preset_scene(PRESET, "tendon"), "artery": artery}
    for elongation, pressure in LOAD_CASES:
        loads = {"loads.elongation.value": elongation, "loads.pressure.value": pressure}
        found.setdefault(case_name(elongation, pressure), artery.with_values(loads | last_only))
    for driver in ("pk2", "finger"):  # with these the printed pass over-corrects (docs/solver.md)
        method = {
            "remodeling.driver": driver,
            "remodeling.frame": "material",
            "remodeling.coupling": "relaxed",
        }
        found[f"artery-{driver}"] = artery.with_values(method | last_only)
    found["artery-rate"] = artery.with_values({"remodeling.law": "rate"} | last_only)
    for kappa in KAPPAS:  # a homogeneous body: one point of it is enough
        point = {"remodeling.kappa": kappa, "model.kinematics": "point", "output.fields": False}
        found[f"cube-{kappa:g}"] = preset_scene(PRESET, "cube").with_values(point)
    return {name: scene.with_values({"name": name}) for name, scene in found.items()}


def run_folder(scene: Scene, folder: Path) -> Path:
    """NAME-KEY in the folder: another scene or version, another key."""
    return (
        folder
        / f"{scene.name}-{hashlib.sha256(f'{__version__} {scene.to_toml()}'.encode()).hexdigest()[:8]}"
    )


def run_all(wanted: Sequence[Scene], folder: Path, jobs: int) -> dict[str, Recording]:
    """The recordings, by name, after running what is not complete, so many at a time; stops all if one fails."""
    folders = {scene.name: run_folder(scene, folder) for scene in wanted}
    waiting = [scene for scene in wanted if not is_complete(scene, folders[scene.name])]
    running: dict[str, subprocess.Popen[bytes]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                scene = waiting.pop(0)
                running[scene.name] = begin(scene, folders[scene.name])
                steps, place = scene.time.number_of_steps, folders[scene.name]
                print(f"figures: runs {scene.name}, {steps} steps, in {place}", file=sys.stderr)
            clock.sleep(0.1)
            for name, process in [
                (name, process) for name, process in running.items() if process.poll() is not None
            ]:
                del running[name]
                if process.returncode:
                    code = process.returncode  # its own last line has said why
                    raise SystemExit(code if code > 0 else 128 - code)
    finally:
        for process in running.values():
            process.terminate()
            process.wait()
    return {name: Recording(path) for name, path in folders.items()}


def is_complete(scene: Scene, folder: Path) -> bool:
    """Whether a run has reached its end."""
    if not (folder / "history.csv").is_file():
        return False
    run = Recording(folder)
    try:
        has_fields = not scene.output.fields or scene.time.end in run.times
        return len(run.history["time"]) == scene.time.number_of_steps + 1 and has_fields
    except RecordingError:  # `run --resume` mends what was cut off, or says what is wrong
        return False


def begin(scene: Scene, folder: Path) -> subprocess.Popen[bytes]:
    """Begin a run in a process of its own, or go on with it."""
    words = ["--resume", str(folder)]
    if not (folder / "scene.toml").is_file():
        folder.parent.mkdir(parents=True, exist_ok=True)
        file = folder.with_suffix(f"{folder.suffix}.toml")
        file.write_text(scene.to_toml(), encoding="utf-8")
        words = [str(file), "-o", str(folder)]
    command = ["remodel-fenicsx", "run", *words, "-q", "--no-report"]
    return subprocess.Popen(command, env=os.environ | {"OMP_NUM_THREADS": "1"})


# ---------------------------------------------------------------- picture and tables of a figure


class Page:
    """Files of a figure: NAME.png, NAME.csv, NAME-PART.csv, and NAME.json with what is to be said of them."""

    def __init__(
        self, folder: Path, name: str, title: str, caption: str, run: Recording | None
    ) -> None:
        self.folder, self.name, self.title, self.caption = folder, name, title, caption
        self.made_with = "eq. (2), wormlike chain; no simulation" if run is None else made_with(run)
        self.notes: dict[str, list[str]] = {}

    def save(self, figure: Figure, colours: int = 256) -> None:
        """Write the picture; title, caption and versions stand in its file."""
        about = {"Title": self.title, "Description": self.caption}
        about["Source"] = f"{self.made_with}; matplotlib {matplotlib.__version__}"
        whole, texts = io.BytesIO(), PngInfo()
        figure.savefig(whole, dpi=DOTS_PER_INCH)
        for key, value in about.items():
            texts.add_text(key, value)
        self.folder.mkdir(parents=True, exist_ok=True)
        with Image.open(whole) as picture:  # 256 colours are enough, and a third of the bytes
            small = picture.convert("RGB").quantize(
                colours, Image.Quantize.MAXCOVERAGE, 2, dither=Image.Dither.NONE
            )
        small.save(
            self.folder / f"{self.name}.png",
            pnginfo=texts,
            optimize=True,
            dpi=(DOTS_PER_INCH, DOTS_PER_INCH),
        )

    def table(self, columns: Columns, note: str, part: str = "") -> None:
        """Write columns of one length, and what they are."""
        file = f"{self.name}-{part}.csv" if part else f"{self.name}.csv"
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / file).open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(columns)
            for row in zip(*columns.values(), strict=True):
                writer.writerow(
                    [x if isinstance(x, (str, int, np.integer)) else f"{float(x):.7g}" for x in row]
                )
        self.notes[file] = [self.made_with, note]
        said = {"made by": f"{MARK} {__version__}", "notes": self.notes}
        (self.folder / f"{self.name}.json").write_text(
            json.dumps(said, indent=1, ensure_ascii=False) + "\n"
        )


def made_with(run: Recording) -> str:
    """Versions and scene of a run, in a line."""
    scene = run.scene
    libraries = ", ".join(
        f"{name} {run.versions.get(name, '?')}" for name in ("remodel_fenicsx", "dolfinx")
    )
    kinematics = (
        "" if scene.model.kinematics == "full" else f" with kinematics {scene.model.kinematics}"
    )
    return f"{libraries}; preset {PRESET}{kinematics}, frame {scene.remodeling.frame}, {first_cells(run)}"


def first_cells(run: Recording) -> str:
    """How the cells of a run were at first, in words."""
    cells = run.scene.cells
    return (
        f"random cells of seed {cells.seed}"
        if cells.initial == "random"
        else f"{cells.initial} cells"
    )


def stacked(tables: Sequence[Columns]) -> Columns:
    """Tables of the same columns, one under the other."""
    return {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}


def lettered(panels: Sequence[Axes]) -> None:
    """Letter panels a, b, c, ... on the line of their titles."""
    for letter, axes in zip("abcdefgh", panels, strict=False):
        axes.set_title(letter, loc="left", fontsize=10, fontweight="bold")


def angle_scale(figure: Figure, place: tuple[float, float, float, float], label: str) -> None:
    """The colours of angles."""
    steps = BoundaryNorm(np.linspace(0, 90, LEVELS + 1), LEVELS)
    colours = ScalarMappable(steps, matplotlib.colormaps[ANGLES].resampled(LEVELS))
    bar = figure.colorbar(
        colours, cax=figure.add_axes(place), orientation="horizontal", label=label
    )
    bar.set_ticks(list(range(0, 91, 15)), labels=[f"{angle}°" for angle in range(0, 91, 15)])


# ---------------------------------------------------------------- bodies in space


class Shown(NamedTuple):
    """A run at a time, and which of its elements are seen: all where None is given."""

    run: Recording
    time: float | None = None
    elements: Any = None


@contextmanager
def display() -> Iterator[None]:
    """A screen that nobody sees, for a VTK that needs one and where there is none."""
    if "DISPLAY" in os.environ or not shutil.which("Xvfb"):
        yield
        return
    reading, writing = os.pipe()
    words = ["Xvfb", "-displayfd", str(writing), "-screen", "0", "1280x1024x24", "-nolisten", "tcp"]
    with subprocess.Popen(words, pass_fds=[writing], stderr=subprocess.DEVNULL) as server:
        os.close(writing)
        os.environ["DISPLAY"] = f":{os.read(reading, 16).decode().strip()}"
        try:
            yield
        finally:
            del os.environ["DISPLAY"]
            server.terminate()


def drawn(
    shown: Sequence[Shown],
    eye: Sequence[float],
    middle: float,
    height: float,
    pixels: Sequence[int],
) -> list:
    """Pictures of deformed bodies, seen from `eye`, at one scale: `height` from top to bottom, z = `middle` inside."""
    import pyvista

    pyvista.OFF_SCREEN = True
    place, images = np.array([0.0, 0.0, middle]), []
    for run, time, elements in shown:
        plotter: Any = run.plot(time, elements=elements, show_scalar_bar=False)
        plotter.window_size = [2 * n for n in pixels]
        plotter.camera.focal_point, plotter.camera.up = place, (0.0, 0.0, 1.0)
        plotter.camera.position = tuple(place + 10 * height * np.array(eye) / np.linalg.norm(eye))
        plotter.camera.parallel_projection, plotter.camera.parallel_scale = True, height / 2
        plotter.reset_camera_clipping_range()
        images.append(np.asarray(plotter.screenshot(return_img=True)))
        plotter.close()
    return images


def top(grid: Any) -> float:
    """The deformed length of a body that stands on z = 0."""
    return float((grid.points + grid.point_data["displacement"])[:, 2].max())


def peeled(run: Recording) -> Shown:
    """At the end, each layer of the wall but the innermost cut shorter than the one inside it."""
    grid = run.grid()
    row = np.unique(np.round(grid.cell_centers().points[:, 2], 6), return_inverse=True)[1]
    return Shown(run, None, row < row.max() + 1 - grid.cell_data["layer"])


def show(axes: Axes, image: np.ndarray, below: str = "") -> None:
    """Put a picture into axes that show nothing else, and a line below it."""
    axes.imshow(image, interpolation="lanczos")
    axes.set_anchor("N")
    axes.set_axis_off()
    axes.text(
        0.5,
        -0.015,
        below,
        transform=axes.transAxes,
        ha="center",
        va="top",
        fontsize=7,
        color="0.35",
    )


def tubes(
    figure: Figure,
    grids: Sequence[Any],
    shown: Sequence[Shown],
    below: Sequence[str],
    bottom: float = 0.215,
    height: float = 0.72,
) -> list[Axes]:
    """Draw five tubes next to each other, on one scale."""
    tallest = max(top(grid) for grid in grids)
    panels = []
    for number, image in enumerate(drawn(shown, ABOVE, tallest / 2, 1.25 * tallest, (360, 560))):
        panels.append(figure.add_axes((0.005 + 0.198 * number, bottom, 0.198, height)))
        show(panels[-1], image, below[number])
    return panels


def loads_in_words(elongation: float, pressure: float) -> str:
    """To stand below a tube."""
    return f"elongation {100 * elongation:.2g} %,  $p$ = {pressure:.3g}"


# ---------------------------------------------------------------- means over a wall


def cylindrical(grid: Any) -> np.ndarray:
    """Circumferential, axial and radial direction at the reference centres of the elements, (elements, 3, 3)."""
    x, y, z = grid.cell_centers().points.T
    zero, radial = 0 * x, np.stack([x, y, 0 * z], axis=1) / np.hypot(x, y)[:, None]
    return np.stack(
        [
            np.stack([-radial[:, 1], radial[:, 0], zero], 1),
            np.stack([zero, zero, zero + 1], 1),
            radial,
        ],
        1,
    )


def radial_dimension(grid: Any) -> np.ndarray:
    """sqrt(e_r . A e_r) of each element's cell, A = sum l_I^2 n_I n_I^T."""
    axes = np.stack([grid.cell_data[f"axis_{i}"] for i in (1, 2, 3)], axis=1)
    return np.linalg.norm(
        grid.cell_data["cell_dimensions"] * np.einsum("mij,mj->mi", axes, cylindrical(grid)[:, 2]),
        axis=1,
    )


def layer_table(grid: Any) -> Columns:
    """Means and extremes over each layer of elements, from the inside; angles in degrees.

    `shear`: the largest root mean square of a shear component of F in the local directions, large where a tube swirls.
    """
    number, fields = np.asarray(grid.cell_data["layer"]), grid.cell_data
    layers = [number == k for k in range(number.max() + 1)]
    nodes, directions = grid.cell_connectivity.reshape(-1, 8), cylindrical(grid)
    local = (
        directions
        @ fields["deformation_gradient"].reshape(-1, 3, 3)
        @ np.swapaxes(directions, 1, 2)
    )
    shear = local[:, ~np.eye(3, dtype=bool)]

    def means(values: np.ndarray) -> np.ndarray:
        return np.array([values[layer].mean() for layer in layers])

    def radius(points: np.ndarray) -> np.ndarray:
        return means(np.hypot(points[:, 0], points[:, 1])[nodes].mean(axis=1))

    return {
        "layer": np.arange(1, len(layers) + 1),
        "radius": radius(grid.points),
        "deformed_radius": radius(grid.points + grid.point_data["displacement"]),
        "fibre_angle": means(fields["fibre_angle"]),
        "fibre_angle_least": np.array([fields["fibre_angle"][layer].min() for layer in layers]),
        "fibre_angle_most": np.array([fields["fibre_angle"][layer].max() for layer in layers]),
        "fibre_angle_deformed": means(fields["fibre_angle_deformed"]),
        **{f"l_{i + 1}": means(fields["cell_dimensions"][:, i]) for i in range(3)},
        "l_radial": means(radial_dimension(grid)),
        "shear": np.array([np.sqrt(np.mean(shear[layer] ** 2, axis=0)).max() for layer in layers]),
    }


def profiles(axes: Axes, tables: Mapping[str, Columns]) -> None:
    """Angle over reference radius by label: means of the layers, and bands of all elements."""
    for (label, table), colour in zip(tables.items(), COLOURS, strict=False):
        least, most = table["fibre_angle_least"], table["fibre_angle_most"]
        axes.fill_between(table["radius"], least, most, color=colour, alpha=0.15, lw=0)
        axes.plot(table["radius"], table["fibre_angle"], "o-", ms=3.5, color=colour, label=label)
    axes.set(xlim=(1, 3.02), ylim=(-2, 92), yticks=range(0, 91, 15), xlabel="reference radius $R$")
    axes.set_ylabel("reference fibre angle at $t$ = 150 (degrees)")


# ---------------------------------------------------------------- the figures


def draw_chain_force(runs: Runs, page: Page) -> None:
    """Fig. 1."""
    extension = np.linspace(0.0, 0.95, 191)
    force = {A: CHAINS["wormlike"].force(extension, 1.0, A) for A in PERSISTENCE_LENGTHS}
    figure = Figure(figsize=(4.2, 3.1), layout="constrained")
    axes = figure.subplots()
    for A, colour in zip(PERSISTENCE_LENGTHS, COLOURS, strict=False):
        axes.plot(extension, force[A], color=colour, label=f"$A$ = {A:g}")
    axes.axvline(1.0, color="0.5", lw=0.8, ls=":")
    axes.set(
        xlabel="chain stretch $r/L$",
        ylabel=r"chain force $f$ for $k\theta$ = 1",
        xlim=(0, 1.02),
        ylim=(0, 30),
    )
    axes.legend(title="persistence length", loc="upper left")
    page.save(figure)
    table = {"extension": extension} | {f"force_A_{A:g}": force[A] for A in PERSISTENCE_LENGTHS}
    page.table(table, "force for k theta = 1; lengths in link lengths")


def closed_form_angle(time: np.ndarray, kappa: float) -> np.ndarray:
    """Angle in degrees between chain and load of cells that were isotropic at first, all of e on the load axis.

    l_1 = r0 (1 - s)/sqrt(3) + r0 s and l_2 = l_3 = r0 (1 - s)/sqrt(3), with s = 1 - exp(-kappa t) (eq. 11).
    """
    s = 1 - np.exp(-kappa * time)
    return np.degrees(np.arctan(np.sqrt(2) * (1 - s) / (1 - s + np.sqrt(3) * s)))


def draw_alignment(runs: Runs, page: Page) -> None:
    """Fig. 5. A row is the state before the pass of its time: its cells are those of the time before."""
    figure = Figure(figsize=(4.8, 3.3), layout="constrained")
    axes = figure.subplots()
    table: Columns = {}
    for kappa, colour in zip(KAPPAS, COLOURS, strict=True):
        run = runs[f"cube-{kappa:g}"]
        time, angle = run.history["time"], run.history["mean_fibre_angle"]
        exact = closed_form_angle(np.maximum(time - run.scene.time.step, 0.0), kappa)
        marked = np.isclose(time % 10.0, 0.0) & (time > 0)
        table |= {"time": time, f"angle_kappa_{kappa:g}": angle, f"exact_kappa_{kappa:g}": exact}
        axes.plot(time, angle, color=colour, label=rf"$\kappa$ = {kappa:g}")
        axes.plot(time[marked], exact[marked], "o", ms=3.5, mfc="white", mec=colour)
    axes.plot([], [], "o", ms=3.5, mfc="white", mec="0.4", label="closed form")
    axes.set(
        xlabel="time", ylabel="angle between chains and load (degrees)", xlim=(0, 100), ylim=(0, 60)
    )
    axes.legend(loc="upper right")
    page.save(figure)
    page.table(
        table,
        "angle_kappa_K: run with kappa = K; exact_kappa_K: closed form of the cells of the same row",
    )


def draw_tendon(runs: Runs, page: Page) -> None:
    """Fig. 6: stretch over time, and the elements by their angle to the load axis."""
    run = runs["tendon"]
    rows, grids = run.history, [run.grid(time) for time in TENDON_TIMES]
    longest = max(map(top, grids))
    figure = Figure(figsize=(8.2, 4.3))
    panels = [figure.add_axes((0.065, 0.115, 0.36, 0.825))]
    axes = panels[0]
    band = {"color": "0.88", "lw": 0, "label": "elements, minimum to maximum"}
    axes.fill_between(rows["time"], rows["min_stretch"], rows["max_stretch"], **band)
    axes.plot(rows["time"], rows["mean_stretch"], color=COLOURS[0], label="mean")
    marks = [run.value("mean_stretch", time) for time in TENDON_TIMES]
    axes.plot(TENDON_TIMES, marks, "o", ms=4, color=COLOURS[0], clip_on=False)
    axes.set(xlabel="time", ylabel="stretch", xlim=(0, run.scene.time.end), ylim=(1.0, None))
    axes.legend(loc="upper right")
    images = drawn(
        [Shown(run, time) for time in TENDON_TIMES],
        (0.3, -1.0, 0.14),
        0.495 * longest,
        1.1 * longest,
        (270, 1000),
    )
    for number, (time, image) in enumerate(zip(TENDON_TIMES, images, strict=True)):
        panels.append(figure.add_axes((0.45 + 0.109 * number, 0.145, 0.109, 0.795)))
        show(panels[-1], image)
        panels[-1].set_title(f"$t$ = {time:g}")
    angle_scale(
        figure,
        (0.50, 0.115, 0.44, 0.022),
        "deformed angle to the load axis: 0° along it, 90° across",
    )
    lettered(panels)
    page.save(figure)
    names = ("time", "force", "mean_stretch", "min_stretch", "max_stretch", "mean_fibre_angle")
    page.table(
        {name: rows[name] for name in names},
        "stretches 1 = undeformed; reference angle to the load axis",
    )
    summaries = [tendon_summary(*one) for one in zip(TENDON_TIMES, grids, strict=True)]
    summary = {name: [row[name] for row in summaries] for name in summaries[0]}
    page.table(summary, f"over all elements; {SOLVED}", "snapshots")


def tendon_summary(time: float, grid: Any) -> dict[str, float]:
    """What the paper says of the tendon's elements: angles, least l_1, stretch of the extreme tenths."""
    reference, deformed = grid.cell_data["fibre_angle"], grid.cell_data["fibre_angle_deformed"]
    stretch = grid.cell_data["deformation_gradient"].reshape(-1, 9)[np.argsort(reference), 8]
    tenth = len(stretch) // 10
    return {
        "time": time,
        "mean_fibre_angle": reference.mean(),
        "max_fibre_angle": reference.max(),
        "mean_fibre_angle_deformed": deformed.mean(),
        "max_fibre_angle_deformed": deformed.max(),
        "stretch_most_aligned_tenth": stretch[:tenth].mean(),
        "stretch_least_aligned_tenth": stretch[-tenth:].mean(),
        "min_l_1": grid.cell_data["cell_dimensions"][:, 0].min(),
    }


IN_WALL = "deformed angle of the chains in the wall{}: 0° circumferential, 90° axial"
AT_END = IN_WALL.format(" at $t$ = 150")


def draw_artery(runs: Runs, page: Page) -> None:
    """Draw Fig. 7: the artery at five times, from outside, and the half behind its axis."""
    run = runs["artery"]
    grids = [run.grid(time) for time in ARTERY_TIMES]
    loads = [
        (run.value("axial_elongation", time), run.value("pressure", time)) for time in ARTERY_TIMES
    ]
    figure = Figure(figsize=(8.2, 5.9))
    behind = grids[0].cell_centers().points[:, 1] > 0
    words = [loads_in_words(*pair) for pair in loads]
    panels = tubes(
        figure, grids, [Shown(run, time) for time in ARTERY_TIMES], [""] * len(words), 0.545, 0.42
    )
    tubes(figure, grids, [Shown(run, time, behind) for time in ARTERY_TIMES], words, 0.125, 0.42)
    for axes, time in zip(panels, ARTERY_TIMES, strict=True):
        axes.set_title(f"$t$ = {time:g}")
    angle_scale(figure, (0.25, 0.075, 0.5, 0.016), IN_WALL.format(""))
    lettered(panels)
    page.save(figure, colours=64)  # two thirds of the bytes
    names = (
        "pressure",
        "axial_elongation",
        "inner_radius",
        "outer_radius",
        *(f"fibre_angle_{p}" for p in PLACES),
    )
    summary = {"time": ARTERY_TIMES} | {
        name: [run.value(name, time) for time in ARTERY_TIMES] for name in names
    }
    summary["mean_l_radial"] = [radial_dimension(grid).mean() for grid in grids]
    page.table(
        summary,
        "rows of the history, reference angles; mean_l_radial: radial component, all elements",
    )
    page.table(
        {name: run.history[name] for name in ("time", *names)}, "the whole history", "history"
    )


def draw_layers(runs: Runs, page: Page) -> None:
    """Fig. 8: three layers of the wall apart."""
    run, grid = runs["artery"], runs["artery"].grid()
    table, tallest = layer_table(grid), top(grid)
    layers = [Shown(run, None, grid.cell_data["layer"] == k) for k in WALL_LAYERS.values()]
    images = drawn(layers, ABOVE, tallest / 2, 1.27 * tallest, (440, 600))
    figure, panels = Figure(figsize=(6.4, 3.95)), []
    for number, ((name, k), image) in enumerate(zip(WALL_LAYERS.items(), images, strict=True)):
        panels.append(figure.add_axes((0.01 + 0.33 * number, 0.255, 0.32, 0.69)))
        means = f"{table['fibre_angle'][k]:.1f}° reference, {table['fibre_angle_deformed'][k]:.1f}° deformed"
        show(panels[-1], image, f"layer {k + 1} of {len(table['layer'])}; mean angle\n{means}")
        panels[-1].set_title(name)
    angle_scale(figure, (0.2, 0.125, 0.6, 0.025), AT_END)
    lettered(panels)
    page.save(figure)
    page.table(table, f"means over element layers at the end; {SOLVED}")


def draw_load_cases(runs: Runs, page: Page) -> None:
    """Fig. 9: the ends of five load cases."""
    cases = [runs[case_name(*case)] for case in LOAD_CASES]
    grids = [run.grid() for run in cases]
    figure = Figure(figsize=(8.2, 3.4))
    panels = tubes(
        figure, grids, list(map(peeled, cases)), [loads_in_words(*case) for case in LOAD_CASES]
    )
    angle_scale(figure, (0.25, 0.125, 0.5, 0.026), AT_END)
    lettered(panels)
    page.save(figure)
    tables = [layer_table(grid) for grid in grids]
    loads = [
        {"stretch": np.full(8, elongation), "pressure": np.full(8, pressure)}
        for elongation, pressure in LOAD_CASES
    ]
    together = stacked([one | table for one, table in zip(loads, tables, strict=True)])
    page.table(together, f"means over element layers at the end; stretch: the elongation; {SOLVED}")


def draw_drivers(runs: Runs, page: Page) -> None:
    """Figs. 10 and 11: the Cauchy stress and another driver."""
    pair = {run.scene.remodeling.driver: run for run in runs.values()}
    symbols = {"cauchy": r"$\sigma$", "pk2": "$S$", "finger": "$b$"}
    words = {
        "cauchy": "Cauchy stress",
        "pk2": "second Piola-Kirchhoff stress",
        "finger": "Finger tensor",
    }
    ends = {driver: run.grid() for driver, run in pair.items()}
    tables = {driver: layer_table(grid) for driver, grid in ends.items()}
    figure = Figure(figsize=(8.2, 3.5))
    panels = [figure.add_axes((0.065, 0.145, 0.40, 0.79))]
    profiles(
        panels[0], {f"{words[driver]} {symbols[driver]}": table for driver, table in tables.items()}
    )
    panels[0].legend(loc="upper left", title="driven by", alignment="left")
    tallest = max(map(top, ends.values()))
    images = drawn(list(map(peeled, pair.values())), ABOVE, tallest / 2, 1.25 * tallest, (390, 560))
    for number, (driver, image) in enumerate(zip(ends, images, strict=True)):
        panels.append(figure.add_axes((0.50 + 0.245 * number, 0.215, 0.24, 0.72)))
        show(panels[-1], image)
        panels[-1].set_title(f"driven by {symbols[driver]}")
    angle_scale(
        figure,
        (0.545, 0.15, 0.40, 0.026),
        "deformed angle at $t$ = 150: 0° circumferential, 90° axial",
    )
    lettered(panels)
    page.save(figure)
    shown = (
        "fibre_angle",
        "fibre_angle_least",
        "fibre_angle_most",
        "fibre_angle_deformed",
        "l_3",
        "l_radial",
        "shear",
    )
    recorded = (
        "inner_radius",
        "outer_radius",
        *(f"fibre_angle_{place}" for place in PLACES),
        "substeps",
    )
    page.table(
        side_by_side(tables, ("layer", "radius"), shown),
        f"element layers, reference angles; {SOLVED}",
    )
    histories = {driver: run.history for driver, run in pair.items()}
    page.table(
        side_by_side(histories, ("time",), recorded),
        "rows of the two histories, reference angles",
        "history",
    )


def side_by_side(
    tables: Mapping[str, Columns], common: Sequence[str], each: Sequence[str]
) -> Columns:
    """Columns NAME_LABEL of several tables, beside those that they have in common."""
    first = next(iter(tables.values()))
    labelled = {f"{name}_{label}": table[name] for label, table in tables.items() for name in each}
    return {name: first[name] for name in common} | labelled


def draw_rate(runs: Runs, page: Page) -> None:
    """Erratum 7: eqs. (10) and (11) on the same artery."""
    pair = {"explicit": runs["artery"], "rate": runs["artery-rate"]}
    label = {"explicit": "eq. (11), explicit", "rate": "eq. (10), rate"}
    tables = {law: layer_table(run.grid()) for law, run in pair.items()}
    figure = Figure(figsize=(7.8, 3.6), layout="constrained")
    over_time, over_radius = figure.subplots(1, 2)
    for (law, run), colour in zip(pair.items(), COLOURS, strict=False):
        for place, dashes in PLACES.items():
            angle = run.history[f"fibre_angle_{place}"]
            over_time.plot(
                run.history["time"],
                angle,
                dashes,
                color=colour,
                lw=1.4,
            )
            if law == "explicit":
                over_time.plot([], [], dashes, color="0.3", lw=1.4, label=f"{place} elements")
    over_time.set(
        xlabel="time", ylabel="reference fibre angle (degrees)", xlim=(0, 150), ylim=(-2, 92)
    )
    over_time.set_yticks(range(0, 91, 15))
    over_time.legend(loc="upper left")
    profiles(over_radius, {label[law]: table for law, table in tables.items()})
    over_radius.legend(loc="upper left")
    lettered([over_time, over_radius])
    page.save(figure)
    shown = ("fibre_angle", "fibre_angle_least", "fibre_angle_most")
    page.table(
        side_by_side(tables, ("layer", "radius"), shown), f"element layers at the end; {SOLVED}"
    )
    histories, places = {law: run.history for law, run in pair.items()}, [
        f"fibre_angle_{place}" for place in PLACES
    ]
    page.table(
        side_by_side(histories, ("time",), places),
        "rows of the two histories, reference angles",
        "history",
    )


def draw_energy(runs: Runs, page: Page) -> None:
    """Remark 6: stored energy, and power of the remodeling passes; a pass belongs to the step that it ends."""
    demos = {"cube": runs["cube-0.025"], "tendon": runs["tendon"], "artery": runs["artery"]}
    unit_of = demos["cube"].scene.material.stress_unit
    figure = Figure(figsize=(8.2, 4.2), layout="constrained")
    panels = figure.subplots(2, 3)
    for (above, below), (name, run) in zip(panels.T, demos.items(), strict=True):
        time, power = (
            run.history["time"],
            run.history["remodeling_power"][1:],
        )  # no pass comes before t = 0
        above.plot(time, run.history["stored_energy"], color=COLOURS[0])
        for sign, colour in ((1, COLOURS[2]), (-1, COLOURS[1])):  # released, taken in
            part = sign * np.maximum(sign * power, 0.0)
            below.stairs(part, time, fill=True, color=colour, alpha=0.25, lw=0)
        below.stairs(power, time, baseline=None, color=COLOURS[1], lw=1.2)
        below.axhline(0.0, color="0.3", lw=0.8)
        for axes in (above, below):
            axes.axvline(run.scene.end_of_ramps, color="0.6", lw=0.8, ls=":")
            axes.set_xlim(0, run.scene.time.end)
        above.set_ylim(0, None)
        above.set_title(f"{name}, {first_cells(run)}", loc="right", fontsize=7.5)
        below.set_xlabel("time")
    panels[0, 0].set_ylabel(f"stored energy\n({unit_of} · length³)")
    panels[1, 0].set_ylabel(f"power of remodeling\n({unit_of} · length³ / time)")
    lettered(panels.ravel())
    page.save(figure)
    names = ("time", "stored_energy", "remodeling_power")
    tables = [{"demo": np.full(len(run.history["time"]), demo)} | {name: run.history[name] for name in names}
              for demo, run in demos.items()]  # fmt: skip
    meaning = "remodeling_power = -dW/dl . dl/dt - dW/dn . dn/dt over the body: positive where a pass releases energy"
    page.table(stacked(tables), f"{meaning}; in {unit_of}, the scene's length and time")


# ---------------------------------------------------------------- which figures there are

CHAINS_DRAWN = (
    "Black: the four chains of each element's mean cell, deformed and projected on its face."
)
PEELED = "the outer layers of elements cut shorter than the inner ones"
WALL = "coloured by the deformed angle of the chains in the wall"
PROFILE = "Reference fibre angle over the radius at t = 150; lines: means of the element layers, bands: all elements"
RELAXED = (
    "The printed pass overshoots with {}: here it is relaxed by one half, in the material frame "
    "(docs/solver.md, Stability of the pass)."
)


class Spec(NamedTuple):
    """A figure: title and caption, which stand in its file and in docs/verification.md, its runs, how it is drawn."""

    title: str
    caption: str
    runs: tuple[str, ...]
    draw: Callable[[Runs, Page], None]


FIGURES = {
    "fig1": Spec(
        "Force of a single chain (Fig. 1)",
        "Force of a wormlike chain, eq. (2), for kθ = 1 and three persistence lengths A. It locks at r = L (dotted).",
        (),
        draw_chain_force,
    ),
    "fig5": Spec(
        "Alignment of the chains of a cube under tension (Fig. 5)",
        "Mean reference angle between chains and load for four values of κ. Circles: closed form of the same cells.",
        tuple(f"cube-{kappa:g}" for kappa in KAPPAS),
        draw_alignment,
    ),
    "fig6": Spec(
        "Cylindrical tendon under uniaxial tension (Fig. 6)",
        "(a) Stretch over time; points: the times of the pictures. (b) to (f) Its elements by their deformed angle "
        f"between chains and load axis. {CHAINS_DRAWN}",
        ("tendon",),
        draw_tendon,
    ),
    "fig7": Spec(
        "Artery under axial elongation and inner pressure (Fig. 7)",
        f"(a) to (e) The wall at five times, {WALL}; below it, its rear half and the loads. {CHAINS_DRAWN}",
        ("artery",),
        draw_artery,
    ),
    "fig8": Spec(
        "Chains in the layers of the artery's wall (Fig. 8)",
        f"(a) The innermost, (b) the fourth and (c) the outermost of eight layers of elements at t = 150, {WALL}. "
        f"{CHAINS_DRAWN}",
        ("artery",),
        draw_layers,
    ),
    "fig9": Spec(
        "Load cases from pure elongation to pure pressure (Fig. 9)",
        f"(a) to (e) The wall at t = 150 under five pairs of axial elongation and inner pressure p, {PEELED}, {WALL}. "
        f"{CHAINS_DRAWN}",
        tuple(case_name(*case) for case in LOAD_CASES),
        draw_load_cases,
    ),
    "fig10": Spec(
        "Remodeling driven by the Cauchy or the second Piola-Kirchhoff stress (Fig. 10)",
        f"(a) {PROFILE}. (b), (c) The wall, {PEELED}. {CHAINS_DRAWN} {RELAXED.format('S')}",
        ("artery", "artery-pk2"),
        draw_drivers,
    ),
    "fig11": Spec(
        "Remodeling driven by the Cauchy stress or the Finger tensor (Fig. 11)",
        f"(a) {PROFILE}. (b), (c) The wall, {PEELED}. {CHAINS_DRAWN} {RELAXED.format('b')}",
        ("artery", "artery-finger"),
        draw_drivers,
    ),
    "rate": Spec(
        "Eqs. (10) and (11) on the same artery (erratum 7)",
        "(a) Mean reference fibre angle of the innermost, middle and outermost elements over time. "
        f"(b) {PROFILE}.",
        ("artery", "artery-rate"),
        draw_rate,
    ),
    "energy": Spec(
        "Stored energy and power of remodeling (Remark 6)",
        "(a) to (c) Stored energy. (d) to (f) Power of each step's remodeling pass; green: it releases stored energy, "
        "red: it takes energy in. Dotted: end of the ramp.",
        ("cube-0.025", "tendon", "artery"),
        draw_energy,
    ),
}  # fmt: skip


def draw(names: Sequence[str], folder: Path, runs: Path, jobs: int) -> None:
    """Run what is missing, and draw."""
    known = scenes()
    needed = dict.fromkeys(run for name in names for run in FIGURES[name].runs)
    recorded = run_all([known[run] for run in needed], runs, jobs)
    with matplotlib.rc_context(STYLE), display():
        for name in names:
            title, caption, of, draw_it = FIGURES[name]
            draw_it(
                {run: recorded[run] for run in of},
                Page(folder, name, title, caption, recorded[of[0]] if of else None),
            )
            print(folder / f"{name}.png")


def main() -> None:
    """The command line; bad input ends it with one line and exit code 2."""
    parser = argparse.ArgumentParser(description="Draw figures of Kuhl & Holzapfel 2007.")
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"Of {', '.join(FIGURES)}; none: all."
    )
    parser.add_argument(
        "-o", dest="folder", type=Path, default=Path("figures"), help="For the figures: figures."
    )
    parser.add_argument(
        "--runs", type=Path, default=Path("results/figures"), help="For the runs: results/figures."
    )
    parser.add_argument(
        "--jobs", type=int, default=len(os.sched_getaffinity(0)), help="Runs at a time: all cores."
    )
    options = parser.parse_args()
    names = options.names or list(FIGURES)
    said = None
    for name in names:
        if name not in FIGURES:
            said = f"{name}: no such figure; allowed are {', '.join(FIGURES)}"
        elif any(options.folder.glob(f"{name}[.-]*")) and not is_own(
            options.folder / f"{name}.json"
        ):
            said = (
                f"-o {options.folder}: has files {name}* of another origin; choose another folder"
            )
    for option, path in (("-o", options.folder), ("--runs", options.runs)):
        if path.exists() and not path.is_dir():
            said = f"{option} {path}: is a file; allowed is a folder"
    if options.jobs < 1:
        said = f"--jobs {options.jobs}: must be at least 1"
    if MPI.COMM_WORLD.size > 1:
        said = "uses all cores by itself (--jobs); start it without mpirun"
    if said:
        parser.exit(2, f"figures.py: {said}\n" if MPI.COMM_WORLD.rank == 0 else "")
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, frame: sys.exit(128 + number))  # its runs end with it
    try:
        draw(names, options.folder, options.runs, options.jobs)
    except (RecordingError, OSError) as error:
        parser.exit(5 if isinstance(error, OSError) else 2, f"figures.py: {error}\n")


def is_own(path: Path) -> bool:
    """Whether a NAME.json is of this script."""
    return path.is_file() and MARK in path.read_text(encoding="utf-8", errors="replace")


if __name__ == "__main__":
    main()
