"""The thumbnails of docs/gallery.md, and the animation, the report and its picture of README.md, from runs of minutes.

The runs stay in results/gallery: `--keep` draws them again. The picture of the report needs the browser of the
environment with WITH_FENICSX_ADD=browser, and stays as it is without one.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from demos import figures
from docs.making.pages import DOCS, FIGURES, drawn
from docs.making.tutorials import BLOCK
from remodel_fenicsx import Recording, read_scene
from remodel_fenicsx.pictures import ANGLE, add_body, new_plotter
from remodel_fenicsx.studies.fit import fit
from remodel_fenicsx.studies.study import COLOURS, Page
from remodel_fenicsx.system.environment import load_extensions
from tests.browser import Browser, browser_path

ROOT = DOCS.parent
WORK = ROOT / "results" / "gallery"
PIXELS = (520, 400)
FRONT = (0.35, -1.0, 0.42)  # direction from the bodies to the eye
REPORT = DOCS / "example_report.html"
MESHES = (
    ("python3", "demos/bent_vessel/mesh.py", "demos/bent_vessel/bent.msh"),
    ("python3", "demos/fork/mesh.py", "demos/fork/fork.msh"),
    ("python3", "demos/own_vessel/lumen.py", "demos/own_vessel/lumen.stl"),
    ("remodel-fenicsx", "wall", "demos/own_vessel/lumen.stl", "--thickness", "0.6", "--size", "0.9", "-o",
     "demos/own_vessel/vessel.msh"),
)  # fmt: skip


class Body(NamedTuple):
    """A demo of which the body is shown at its end."""

    scene: str
    options: tuple[str, ...] = ()
    cut: str = ""  # between "elements", which keep their chains, or by a "plane" through them
    eye: tuple[float, float, float] = FRONT


class Curves(NamedTuple):
    """A demo of which columns are shown over time."""

    scene: str
    label: str
    columns: dict[str, str]
    options: tuple[str, ...] = ()
    unit: str = "time"


class Fit(NamedTuple):
    """A demo of which a fitted column is shown."""

    scene: str
    data: str
    column: str
    labels: tuple[str, str]


BANDS = {f"fibre_angle_{band}": band for band in ("inner", "middle", "outer")}
ANGLES = "fibre angle, degrees"
DEMOS: dict[str, Body | Curves | Fit] = {
    "artery": Body("artery.toml", cut="elements"),
    "tendon": Body("tendon.toml", eye=(0.3, -1.0, 0.14)),
    "cube": Curves("cube.toml", "angle, degrees", {"mean_fibre_angle": ""}),
    "layers": Body("layers.toml", cut="elements"),
    "pulse": Curves("pulse.toml", "inner radius, mm", {"inner_radius": "diastole", "inner_radius@2": "systole"}),
    "sheet": Curves("sheet.toml", ANGLES, {"fibre_angle": ""}),
    "gel": Body("gel/scene.toml"),
    "bent_vessel": Body("bent_vessel/scene.toml"),
    "fork": Body("fork/scene.toml", cut="plane", eye=(0.15, -1.0, 0.25)),
    "own_vessel": Body("own_vessel/scene.toml", cut="plane", eye=(0.0, -1.0, 0.1)),
    "turnover": Curves("turnover.toml", "opening angle, degrees", {"opening_angle": ""},
                       ("--set", "time.end=1200.0", "--set", "time.step=4.0", "--set", "time.tolerance=1.0")),
    "hypertension": Curves("hypertension.toml", "wall thickness", {"wall_thickness": ""}),
    "carotid": Curves("carotid.toml", ANGLES, BANDS, unit="time, days"),
    "fit": Fit("fit/scene.toml", "fit/inflation.toml", "outer_radius", ("pressure, mmHg", "outer radius, mm")),
    "biaxial": Fit("biaxial/scene.toml", "biaxial/protocols.toml", "nominal_stress_x",
                   ("elongation along x", "nominal stress, kPa")),
    "torsion": Body("extensions/torsion.toml", ("--with", "demos/extensions/torsion.py")),
}  # fmt: skip


# ---------------------------------------------------------------- runs
def obey(*words: str) -> None:
    """Run a command in the folder of the runs."""
    print(*words, flush=True)
    subprocess.run(words, cwd=WORK, check=True)


def run_all() -> None:
    """Run all demos, and the tube of README.md with few recorded times."""
    shutil.rmtree(WORK, ignore_errors=True)
    WORK.mkdir(parents=True)
    shutil.copytree(ROOT / "demos", WORK / "demos")
    for words in MESHES:
        obey(*words)
    for name, demo in DEMOS.items():
        if not isinstance(demo, Fit) and not (WORK / name).exists():
            obey(
                "remodel-fenicsx",
                "run",
                f"demos/{demo.scene}",
                "-o",
                name,
                "-q",
                "--no-report",
                *demo.options,
            )
    (scene,) = (
        text for kind, text in BLOCK.findall((ROOT / "README.md").read_text()) if kind == "toml"
    )
    (WORK / "tube.toml").write_text(scene, encoding="utf-8")
    obey("remodel-fenicsx", "run", "tube.toml", "-o", "tube", "--set", "output.every=10")


# ---------------------------------------------------------------- bodies
def body_image(
    run: Recording, time: float | None, demo: Body, size: tuple[int, int], bounds: Any = None
) -> np.ndarray:
    """Draw a deformed body; one that is cut by a plane has no chains, which would lie in the cut."""
    grid, options = run.grid(time), {}
    if demo.cut == "elements":
        grid = grid.extract_cells(grid.cell_centers().points[:, 1] > grid.center[1])
    elif demo.cut:
        grid = grid.clip("-y", origin=grid.center)
        options = {"with_chains": False, "show_edges": False}
    plotter: Any = new_plotter(off_screen=True, window_size=[2 * n for n in size])
    add_body(
        plotter,
        grid.warp_by_vector("displacement"),
        ANGLE,
        show_scalar_bar=False,
        line_width=0.5,
        **options,
    )
    plotter.enable_parallel_projection()
    plotter.view_vector(demo.eye, (0, 0, 1), bounds=bounds)
    plotter.camera.zoom(1.05 if bounds is None else 1.2)
    image = Image.fromarray(np.asarray(plotter.screenshot(return_img=True)))
    plotter.close()
    return np.asarray(image.reduce(2))


# ---------------------------------------------------------------- thumbnails
def of_body(axes: Axes, name: str, demo: Body) -> None:
    """Show a body without axes."""
    axes.imshow(body_image(Recording(WORK / name), None, demo, PIXELS))
    axes.set_axis_off()


def of_curves(axes: Axes, name: str, demo: Curves) -> None:
    """Show columns over time."""
    history = Recording(WORK / name).history
    for (column, text), line in zip(demo.columns.items(), ("-", "--", ":"), strict=False):
        axes.plot(history["time"], history[column], line, label=text)
    axes.set(xlabel=demo.unit, ylabel=demo.label)
    if len(demo.columns) > 1:
        axes.legend(fontsize=7)


def of_fit(axes: Axes, name: str, demo: Fit) -> None:
    """Fit, and show the data and the model of each protocol."""
    scene, data = WORK / "demos" / demo.scene, WORK / "demos" / demo.data
    _, found = fit(read_scene(scene), data, WORK / name, starts=1, profiles=False)
    for table, model in zip(found.problem.tables, found.modelled, strict=True):
        unit_of = {column: unit for column, (_, unit) in table.units.items()}
        for rows in table.protocols.values():
            over = table.over(demo.column)
            x = table.columns[over][rows] / unit_of.get(over, 1.0)
            scale = unit_of.get(demo.column, 1.0)
            axes.plot(x, table.columns[demo.column][rows] / scale, "o", ms=3, color=COLOURS[0])
            axes.plot(x, model[demo.column][rows] / scale, color=COLOURS[1])
    axes.plot([], [], "o", ms=3, color=COLOURS[0], label="measured")
    axes.plot([], [], color=COLOURS[1], label="fitted")
    axes.set(xlabel=demo.labels[0], ylabel=demo.labels[1])
    axes.legend(fontsize=7)


DRAW: dict[type, Callable[[Axes, str, Any], None]] = {Body: of_body, Curves: of_curves, Fit: of_fit}


def thumbnail(name: str) -> Figure:
    """Draw the picture of a demo."""
    figure = Figure(figsize=(2.6, 2.0), layout="constrained")
    demo = DEMOS[name]
    DRAW[type(demo)](figure.subplots(), name, demo)
    return figure


# ---------------------------------------------------------------- vessels of docs/my_own_vessel.md
def vessel(name: str) -> Figure:
    """Draw a vessel before and after remodeling, cut by a plane, with its loads."""
    run, demo = Recording(WORK / name), DEMOS[name]
    assert isinstance(demo, Body)
    bounds = run.grid(run.times[-1]).warp_by_vector("displacement").bounds
    figure = Figure(figsize=(6.4, 4.4))
    for number, time in enumerate((0.0, run.times[-1])):
        axes = figure.add_axes((0.02 + 0.49 * number, 0.24, 0.47, 0.68))
        image = body_image(run, time, demo, (640, 600), bounds)
        figures.show(axes, image, f"pressure {run.value('pressure', time):.3g} kPa")
        axes.set_title(f"$t$ = {time:g}")
    label = "deformed fibre angle: 0° circumferential, 90° axial"
    figures.angle_scale(figure, (0.25, 0.13, 0.5, 0.025), label)
    return figure


# ---------------------------------------------------------------- README.md
def of_readme() -> None:
    """Keep the animation of the artery, an example of a report, and a picture of it."""
    animation = FIGURES / "artery.webp"
    animation.unlink(missing_ok=True)
    view = ("--cut", "half", "--view=0.35,-1,0.42")
    obey("remodel-fenicsx", "animate", "artery", *view, "--frames", "24", "-o", str(animation))
    shutil.copyfile(WORK / "tube" / "report.html", REPORT)
    if browser_path() is None:
        print("no browser: docs/figures/report.png stays as it is")
        return
    with Browser() as browser:
        browser.open(REPORT, width=1200, height=900)
        Image.fromarray(browser.screenshot()[:900]).quantize(256).save(
            FIGURES / "report.png", optimize=True
        )


def make(keep: bool) -> None:
    """Run and draw."""
    if not keep:
        run_all()
    load_extensions([str(WORK / "demos" / "extensions" / "torsion.py")])
    source = "docs/making/gallery.py"
    with figures.display():
        for name in DEMOS:
            drawn(
                Page(FIGURES, f"gallery-{name}", f"Demo {name}"),
                lambda name=name: thumbnail(name),
                made=source,
            )
        for name in ("own_vessel", "fork"):
            caption = "Cut by a plane through the middle of the unloaded vessel."
            drawn(
                Page(FIGURES, name, f"Demo {name}", caption),
                lambda name=name: vessel(name),
                made=source,
            )
    of_readme()
