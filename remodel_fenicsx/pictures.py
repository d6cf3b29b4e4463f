"""Pictures and animations of a run's body in PyVista, with its fields and chains.

A child process renders pictures: ``python3 -m remodel_fenicsx.pictures JOB``. A VTK build that
supports only X11 (Debian 13's) aborts without a display, so the child runs under xvfb-run, if that
is installed. A VTK build with EGL needs no display.
"""

from __future__ import annotations

import io
import math
import os
import pickle
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Collection, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from remodel_fenicsx._version import __version__
from remodel_fenicsx.errors import BAD_ENVIRONMENT, FigureError
from remodel_fenicsx.model.tensors import Array, Flags
from remodel_fenicsx.results.recording import (
    AMBIENT,
    ANGLE_COLOURS,
    CHAIN_LOOK,
    RecordedRun,
    VIEWS,
    kept_times,
    unit_of,
    words,
)
from remodel_fenicsx.results.whole_body import AXIS_FIELDS, WholeBody, axes_of, chain_lines
from remodel_fenicsx.schema.settings import STRESS_FIELDS
from remodel_fenicsx.system.children import environment_of_child, last_line
from remodel_fenicsx.system.files import TakenError, numbered, write_new

if TYPE_CHECKING:
    import pyvista

Pixels = NDArray[np.uint8]

ANGLE = "fibre_angle_deformed"  # field that colours the bodies
ANGLES = ("fibre_angle", ANGLE)  # fields in degrees, from 0 to 90
# fields from which chains are drawn
OF_TUBES = ("deformation_gradient", "cell_dimensions", *AXIS_FIELDS)
SHOWN_FIELDS = ("displacement", ANGLE, *OF_TUBES, *STRESS_FIELDS)
NAN_COLOUR = "#999ea6"  # colour of points without a fibre angle
LIFT = 0.015  # distance of chains above a face, which may be curved, over the width of the face
LIGHT: dict[str, Any] = {"ambient": AMBIENT, "diffuse": 1 - AMBIENT, "specular": 0.0}


# ---------------------------------------------------------------- in PyVista


def grid(
    whole: WholeBody,
    time: float,
    shown: Flags | None = None,
    names: Collection[str] | None = None,
) -> pyvista.UnstructuredGrid:
    """Make the grid of the visible elements, undeformed, with the fields of a recorded time."""
    import pyvista

    displacement, fields = whole.fields(time, names)
    kind = {8: pyvista.CellType.HEXAHEDRON, 4: pyvista.CellType.TETRA}[whole.elements.shape[1]]
    body = pyvista.UnstructuredGrid({kind: whole.elements}, whole.points)
    if displacement is not None:
        body.point_data["displacement"] = displacement
    body.cell_data["layer"] = whole.layer
    body.cell_data.update({**fields})
    return body if shown is None else body.extract_cells(shown)


def deformed(body: pyvista.UnstructuredGrid) -> pyvista.UnstructuredGrid:
    """Displace the points of a grid, if displacements were recorded."""
    return body.warp_by_vector("displacement") if "displacement" in body.point_data else body


def new_plotter(**options: Any) -> pyvista.Plotter:
    """Make a plotter with a white background and a light at the camera."""
    import pyvista

    plotter = pyvista.Plotter(lighting="none", **options)
    plotter.background_color = "white"
    for renderer in plotter.renderers:
        renderer.add_light(pyvista.Light(light_type="headlight", intensity=1.0))
    return plotter


def add_body(
    plotter: pyvista.Plotter,
    body: pyvista.UnstructuredGrid,
    name: str,
    with_chains: bool = True,
    **options: Any,
) -> pyvista.Actor:
    """Add a grid to a plotter, with its chains if they were recorded."""
    looks: dict[str, Any] = {"scalars": name, "show_edges": True, "edge_color": "#777777", **LIGHT}
    if name in ANGLES:
        looks |= {"cmap": list(ANGLE_COLOURS), "clim": (0, 90), "nan_color": NAN_COLOUR}
    actor = plotter.add_mesh(body, **(looks | options))
    if with_chains and set(OF_TUBES) <= set(body.cell_data):
        plotter.add_mesh(chains(body), color=CHAIN_LOOK["colour"], **LIGHT)
    return actor


def chains(body: pyvista.UnstructuredGrid) -> pyvista.PolyData:
    """Make the four deformed chains of each element as tubes on its outer faces."""
    import pyvista

    surface = body.extract_surface().compute_normals(point_normals=False, split_vertices=False)
    faces = surface.faces.reshape(surface.n_cells, -1)[:, 1:]
    corners = surface.points[faces]
    middle = corners.mean(1)
    moved = surface.point_data.get("displacement", np.zeros((surface.n_points, 3)))
    reference = corners - moved[faces]
    sides = (reference + np.roll(reference, 1, axis=1)) / 2 - reference.mean(1, keepdims=True)
    # Twice the undeformed distance from the middle of a face to its closest side.
    size = 2 * np.linalg.norm(sides, axis=2).min(1)
    axes = axes_of(surface.cell_data)
    lengths = surface.cell_data["cell_dimensions"]
    ends, lines = chain_lines(np.zeros_like(middle), lengths, axes, CHAIN_LOOK["reach"])
    gradient = surface.cell_data["deformation_gradient"].reshape(-1, 3, 3)
    arms = size[:, None, None] * ends.reshape(-1, 8, 3) @ np.swapaxes(gradient, 1, 2)
    normal = surface.cell_data["Normals"]
    arms -= np.einsum("mki,mi->mk", arms, normal)[..., None] * normal[:, None]
    middle += LIFT * size[:, None] * normal
    drawn = pyvista.PolyData(
        (middle[:, None] + arms).reshape(-1, 3), lines=np.insert(lines, 0, 2, axis=1)
    )
    drawn["radius"] = np.repeat(CHAIN_LOOK["width"] / 2 * size, 8)
    return drawn.tube(scalars="radius", absolute=True, n_sides=6)


# ---------------------------------------------------------------- pictures, by a child process

LETTER, NOTE = 15, 12  # font sizes
PANEL = 600  # pixels: longer side of a body's panel, with its title
FOOT = 150  # pixels: height of the footer
ZOOM = 1.7  # twice the fraction of a panel that a body fills, which leaves space for the title


class Job(NamedTuple):
    """A drawing job: sheets of bodies with titles, view direction, field, and texts below them."""

    sheets: Sequence[Sequence[tuple[str, pyvista.UnstructuredGrid]]]
    direction: tuple[float, float, float]
    field: str
    limits: Sequence[float]
    scale: str
    notes: str


def render(job: Job) -> list[Pixels]:
    """Draw sheets off-screen in a child process, each (rows, columns, 3)."""
    with TemporaryDirectory(prefix="remodel-fenicsx-") as folder:
        file = Path(folder) / "job"
        file.write_bytes(pickle.dumps(job))
        command = [sys.executable, "-m", __name__, str(file)]
        if shutil.which("xvfb-run"):
            command = ["xvfb-run", "-a", "-s", "-screen 0 1280x1024x24", *command]
        # The backend of a notebook works in its kernel alone.
        environment = environment_of_child() | {"PYVISTA_OFF_SCREEN": "true", "MPLBACKEND": "agg"}
        # Python imports modules from the working folder first, which must not be a user's folder.
        child = subprocess.run(
            command,
            env=environment,
            cwd=folder,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
        )
        result = file.with_suffix(".npy")
        if child.returncode or not result.exists():
            raise FigureError(
                f"rendering failed: pyvista ended with {child.returncode}: "
                f"{last_line(child.stderr)}; check that xvfb and xauth are installed",
                BAD_ENVIRONMENT,
            )
        return list(np.load(result))


def main(file: str) -> None:
    """Draw the sheets of a job file and save the pictures next to it."""
    job = pickle.loads(Path(file).read_bytes())
    bounds = np.array([body.bounds for sheet in job.sheets for _, body in sheet]).reshape(-1, 3, 2)
    extent = np.stack([bounds[..., 0].min(0), bounds[..., 1].max(0)], 1)
    np.save(f"{file}.npy", [_drawn(job, sheet, extent) for sheet in job.sheets])


def _drawn(
    job: Job, sheet: Sequence[tuple[str, pyvista.UnstructuredGrid]], bounds: Array
) -> Pixels:
    """Draw the bodies of a sheet next to each other, at one scale."""
    columns = min(len(sheet), MOST_COLUMNS)
    rows = -(-len(sheet) // columns)
    up = (0, 1, 0) if math.hypot(*job.direction[:2]) < 0.01 * abs(job.direction[2]) else (0, 0, 1)
    across = np.cross(up, job.direction)
    axes = np.array([across, np.cross(across, job.direction)])
    seen = np.abs(axes) @ np.ptp(bounds, 1) / np.linalg.norm(axes, axis=1)
    width, height = (PANEL * np.maximum(seen / seen.max(), 0.6)).astype(int)
    plotter: Any = new_plotter(
        off_screen=True,
        window_size=[max(800, width * columns), height * rows + FOOT],
        shape=(rows + 1, columns),
        row_weights=[*[height] * rows, FOOT],
        groups=[(rows, slice(None))],
        border=False,
    )
    for number, (title, body) in enumerate(sheet):
        plotter.subplot(*divmod(number, columns))
        actor = add_body(
            plotter, body, job.field, show_scalar_bar=False, line_width=0.5, clim=job.limits
        )
        plotter.add_text(title, "upper_edge", LETTER)
        plotter.enable_parallel_projection()
        plotter.view_vector(job.direction, up, bounds=bounds.ravel())
        plotter.camera.parallel_scale = seen.max() * height / PANEL / ZOOM
    plotter.subplot(rows, 0)
    plotter.view_vector(job.direction, up)
    plotter.add_scalar_bar(
        "",
        mapper=actor.mapper,
        height=0.45,
        position_x=0.2,
        position_y=0.5,
        n_labels=7,
        fmt="%.0f°" if job.field == ANGLE else "%.3g",
        label_font_size=LETTER,
    )
    plotter.add_text(f"{job.scale}\n{job.notes}", "lower_edge", NOTE)
    plotter.add_axes(viewport=(0.84, 0.0, 1.0, 1.0))
    image = Image.fromarray(plotter.screenshot(scale=2))
    plotter.close()
    return np.asarray(image.reduce(2))  # antialiasing with every VTK


# ---------------------------------------------------------------- visible elements and view


class ViewOptions(NamedTuple):
    """View options of a picture: visible layers, cut, view direction and field."""

    layers: int | None = None
    cut: str | None = None
    view: str = "front"
    field: str = ANGLE

    @property
    def direction(self) -> tuple[float, float, float]:
        """Direction from the body towards the camera."""
        if self.view in VIEWS:
            return VIEWS[self.view]
        try:
            x, y, z = map(float, self.view.split(","))
        except ValueError:
            x = y = z = math.nan
        if not 0 < math.hypot(x, y, z) < math.inf:
            raise FigureError(
                f"view {self.view}: must be {', '.join(VIEWS)} or X,Y,Z, "
                "the direction from the body to the camera"
            )
        return x, y, z


def visible_elements(whole: WholeBody, viewing: ViewOptions) -> Flags:
    """Return which elements are visible: neither peeled nor cut off, (elements,)."""
    layers, count = viewing.layers, len(whole.depth)
    if layers is not None and not 1 <= layers <= count:
        shape = whole.recording.scene.geometry
        start = shape.depth_labels[1]
        raise FigureError(
            f"layers {layers}: must be an integer from 1 to {count}, from the {start}"
        )
    return (whole.layer < (layers or count)) & ~_cut_off(whole, viewing.cut)


def _cut_off(whole: WholeBody, cut: str | None) -> Flags:
    """Return which elements are cut off: those that lie completely in front, (elements,)."""
    if cut is None:
        return np.zeros(len(whole.elements), dtype=bool)
    middle = (whole.points.min(axis=0) + whole.points.max(axis=0)) / 2
    x, y, _ = (whole.centres - middle).T
    slack = 1e-6 * np.ptp(whole.points)  # An element that touches the plane stays.
    cuts = {"half": y < -slack, "quarter": (y < -slack) & (x > slack)}
    if cut not in cuts:
        raise FigureError(f"cut {cut}: must be {' or '.join(cuts)}")
    if not cuts[cut].any():
        raise FigureError(f"cut {cut}: no element of this body lies completely in that part")
    return cuts[cut]


# ---------------------------------------------------------------- pictures and animations as files

MOST_PANELS, MOST_COLUMNS = 12, 4
FEWEST_FRAMES, MOST_FRAMES = 2, 500  # An animation of one frame is a picture.
FRAME_TIME, LAST_TIME = 80, 1600  # ms per frame; multiples of 10, the unit of GIF


def draw_picture(
    folder: str | os.PathLike[str],
    times: Sequence[float] | None,
    viewing: ViewOptions,
    path: Path | None,
) -> Path:
    """Draw the body of a run at recorded times, next to each other."""
    whole = _body_for(folder, path, (".png", ".pdf"))
    recorded = whole.recording.times
    for time in times or ():
        if not recorded[0] <= time <= recorded[-1]:
            raise FigureError(f"times {time:g}: must be from {recorded[0]:g} to {recorded[-1]:g}")
    shown = dict.fromkeys(
        float(recorded[np.abs(recorded - time).argmin()]) for time in times or recorded[-1:]
    )
    if len(shown) > MOST_PANELS:
        raise FigureError(
            f"times: {len(shown)} times; must be at most {MOST_PANELS} (animate shows more)"
        )
    return _draw(whole, [[*shown]], viewing, path, ".png")


def draw_animation(
    folder: str | os.PathLike[str], frames: int, viewing: ViewOptions, path: Path | None
) -> Path:
    """Draw the body of a run over time."""
    if not FEWEST_FRAMES <= frames <= MOST_FRAMES:
        raise FigureError(
            f"--frames {frames}: must be an integer from {FEWEST_FRAMES} to {MOST_FRAMES}"
        )
    whole = _body_for(folder, path, (".gif", ".webp"))
    recorded = whole.recording.times
    if len(recorded) == 1:
        raise FigureError(
            f"{whole.recording.path}: fields are recorded at one time only; an animation needs two"
        )
    return _draw(
        whole, [[float(time)] for time in kept_times(recorded, frames)], viewing, path, ".gif"
    )


def _body_for(
    folder: str | os.PathLike[str], path: Path | None, endings: Sequence[str]
) -> WholeBody:
    """Read the body of a run; first check that the output file can be written."""
    if path is not None:
        if path.suffix.lower() not in endings:
            raise FigureError(f"path {path}: the suffix must be {' or '.join(endings)}")
        if os.path.lexists(path):
            raise TakenError(path)
        if not path.parent.is_dir():
            raise FigureError(f"path {path}: folder {path.parent} does not exist")
    return WholeBody(RecordedRun(folder))


def _draw(
    whole: WholeBody,
    sheets: Sequence[Sequence[float]],
    viewing: ViewOptions,
    path: Path | None,
    ending: str,
) -> Path:
    """Draw sheets, each with some times, and write them to a new file."""
    recording, shown = whole.recording, visible_elements(whole, viewing)
    scene, field = recording.scene, viewing.field
    if field not in recording.fields(sheets[0][0], {field}):
        raise FigureError(f"{recording.path}: the run recorded no {field} (output.fields)")
    drawn = [
        [(f"t = {t:g}", deformed(grid(whole, t, shown, SHOWN_FIELDS))) for t in times]
        for times in sheets
    ]
    label, (along, across) = "angle of the collagen", scene.geometry.angle_in_words
    scale, limits = f"deformed fibre angle: 0° {along}, 90° {across}", [0.0, 90.0]
    if field != ANGLE:
        values = [body.cell_data[field] for sheet in drawn for _, body in sheet]
        label, limits = words(field), [np.min(values), np.max(values)]
        scale = f"{label}, means of elements {unit_of(scene, 'stress')}"
    notes = f"{scene.name}: {len(whole.elements):,} elements. " + " ".join(
        whole.notes("displacement" in drawn[0][0][1].point_data)
    )
    job = Job(drawn, viewing.direction, field, limits, scale, textwrap.fill(notes, 110))
    first, *others = map(Image.fromarray, render(job))
    texts, title = PngInfo(), f"{scene.name}: {label}"
    texts.add_text("Title", title)
    texts.add_text("Description", notes)
    texts.add_text("Software", f"remodel_fenicsx {__version__}")
    texts.add_text("Source", "; ".join(map(" ".join, recording.versions.items())))
    moving = {
        "save_all": True,
        "append_images": others,
        "loop": 0,
        "duration": [FRAME_TIME] * len(others) + [LAST_TIME],
    }
    file = io.BytesIO()
    first.save(
        file,
        (path.suffix.lower() if path else ending)[1:],
        pnginfo=texts,
        title=title,
        **(moving if others else {}),
    )
    stem = "-".join(
        [scene.name, *dict.fromkeys(f"t{times[0]:g}" for times in (sheets[0], sheets[-1][-1:]))]
    )
    for free in [path] if path else numbered(recording.path / f"{stem}{ending}"):
        try:
            write_new(free, file.getvalue())
            break
        except TakenError:
            if path:
                raise
    return free


if __name__ == "__main__":
    main(sys.argv[1])
