"""The body of a run in PyVista: a grid with its fields, a plotter with colours and chains, pictures and animations.

Pictures are drawn by a child process, ``python3 -m remodel_fenicsx.pictures.bodies JOB``: a VTK that knows only X
(Debian 13's) kills its process where there is no display, so the child gets one of its own from xvfb-run. A VTK that
can draw without (EGL) gets by without that program.
"""

from __future__ import annotations

import io
import itertools
import math
import os
import pickle
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TYPE_CHECKING

import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from remodel_fenicsx._version import __version__
from remodel_fenicsx.results.recording import (
    AMBIENT,
    ANGLE_COLOURS,
    CHAIN_LOOK,
    LEVELS,
    RecordedRun,
    RecordingError,
    VIEWS,
    kept_times,
    unit_of,
    with_unit,
    words,
)
from remodel_fenicsx.results.whole_body import AXIS_FIELDS, WholeBody, chain_lines, has_a_body
from remodel_fenicsx.schema import same_time
from remodel_fenicsx.studies.page import FigureError
from remodel_fenicsx.system.children import environment_of_child, last_line
from remodel_fenicsx.system.files import TakenError, write_new

if TYPE_CHECKING:
    import pyvista

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

SAMPLES = 2  # pictures are drawn this much larger and made smaller
LETTER, NOTE, FOOT, NARROWEST = 9, 6, 150, 800  # letters; pixels: what stands below all bodies, a sheet
ANGLE = "fibre_angle_deformed"  # by which bodies are coloured
ANGLES = ("fibre_angle", ANGLE)  # fields in degrees, from 0 to 90
OF_RIBBONS = ("deformation_gradient", "cell_dimensions", *AXIS_FIELDS)  # fields that chains are drawn of
SHOWN_FIELDS = ("displacement", ANGLE, *OF_RIBBONS)
NO_SIDE = 1e-4  # of the longest: such a side is one point of a wedge on an axis, to the digits of the fields
LIFT_ALONG_NORMALS = 0.05  # of chains, over the shorter side of a face, where the eye may be anywhere
NOTHING_KNOWN = (0.6, 0.62, 0.65)  # where chains have no angle


# ---------------------------------------------------------------- colours


def coloured(angle: Array) -> Array:
    """Colours (m, 3) of angles in degrees (m,), from red (0, aligned) over yellow to blue (90); NaN is grey."""
    step = np.clip(np.nan_to_num(angle) * LEVELS / 90.0, 0, LEVELS - 1).astype(int)
    return np.where(np.isnan(angle)[:, None], NOTHING_KNOWN, np.array([to_rgb(c) for c in ANGLE_COLOURS])[step])


# ---------------------------------------------------------------- in PyVista


def grid(
    whole: WholeBody, time: float, shown: NDArray[np.bool_] | None = None, names: Collection[str] | None = None
) -> pyvista.UnstructuredGrid:
    """The elements that are shown of the reference body, with the fields of a recorded time."""
    import pyvista

    displacement, fields = whole.fields(time, names)
    kind = {8: pyvista.CellType.HEXAHEDRON, 4: pyvista.CellType.TETRA}[whole.elements.shape[1]]
    found = pyvista.UnstructuredGrid({kind: whole.elements}, whole.points)
    if displacement is not None:
        found.point_data["displacement"] = displacement
    for name, values in {"layer": whole.layer, **fields}.items():
        found.cell_data[name] = values
    return found if shown is None else found.extract_cells(shown)


def whole_body(recording: RecordedRun) -> WholeBody:
    """That of a run, or RecordingError."""
    if not has_a_body(recording):
        raise RecordingError(f"{recording.path}: the run recorded no fields of a body (output.fields)")
    return WholeBody(recording)


def plot(
    recording: RecordedRun, time: float, name: str, viewing: Viewing, elements: ArrayLike | None, with_chains: bool,
    plotter: pyvista.Plotter | None, options: dict[str, Any],
) -> pyvista.Plotter:  # fmt: skip
    """Put a body into a plotter; parameters and errors as of `Recording.plot`."""
    whole = whole_body(recording)
    shown = shown_elements(whole, viewing)
    if elements is not None:
        if np.shape(elements) != shown.shape:
            raise FigureError(f"elements of shape {np.shape(elements)}: allowed is a mask of all {len(shown)}", 2)
        shown &= np.asarray(elements, dtype=bool)
    found = grid(whole, time, shown)
    if name not in found.cell_data:
        raise RecordingError(f"{recording.path}: no field {name!r} of elements; there are {', '.join(found.cell_data)}")
    plotter = new_plotter() if plotter is None else plotter
    add_body(plotter, found, name, with_chains, None, **options)
    return plotter


def new_plotter(**options: Any) -> pyvista.Plotter:
    """White, with the light where the eye is."""
    import pyvista

    plotter = pyvista.Plotter(lighting="none", **options)
    plotter.background_color = "white"
    for renderer in plotter.renderers:
        renderer.add_light(pyvista.Light(light_type="headlight", intensity=1.0))
    return plotter


def add_body(
    plotter: pyvista.Plotter, found: pyvista.UnstructuredGrid, name: str, with_chains: bool, towards: Array | None,
    **options: Any,
) -> Any:  # fmt: skip
    """A deformed body by a field, and its chains, as far as they were recorded; gives what knows its colours."""
    import pyvista

    light: dict[str, Any] = {"ambient": AMBIENT, "diffuse": 1 - AMBIENT, "specular": 0.0}
    looks = {"scalars": name, "show_edges": True, "edge_color": "#777777", **light}
    if name in ANGLES:
        table: Any = pyvista.LookupTable()
        middles = (np.arange(LEVELS) + 0.5) * (90.0 / LEVELS)  # of the steps of the scale, in degrees
        table.values = np.rint(255 * np.column_stack([coloured(middles), np.ones(LEVELS)])).astype(np.uint8)
        table.scalar_range, table.nan_color = (0.0, 90.0), NOTHING_KNOWN
        looks["cmap"] = table
    is_deformed = "displacement" in found.point_data
    body = plotter.add_mesh(found.warp_by_vector("displacement") if is_deformed else found, **{**looks, **options})
    if with_chains and set(OF_RIBBONS) <= set(found.cell_data):
        plotter.add_mesh(chains(found, towards), color=CHAIN_LOOK["colour"], culling="back", **light)
    return body.mapper


def chains(found: pyvista.UnstructuredGrid, towards: Array | None) -> pyvista.PolyData:
    """The four chains of each element, deformed, on its outer faces: narrow ribbons, a little towards the eye."""
    import pyvista

    surface = found.extract_surface()
    faces = surface.faces.reshape(surface.n_cells, -1)[:, 1:]
    reference = np.asarray(surface.points, dtype=float)[faces]
    deformed = reference + np.asarray(surface.point_data.get("displacement", np.zeros((surface.n_points, 3))))[faces]
    has_area = np.any(_normals(reference), axis=1)  # wedges on an axis are hexahedra with a face of no area
    reference, deformed = reference[has_area], deformed[has_area]
    fields = {name: np.asarray(surface.cell_data[name])[has_area] for name in OF_RIBBONS}
    axes = np.stack([fields[name] for name in AXIS_FIELDS], axis=1)
    gradient = fields["deformation_gradient"].reshape(-1, 3, 3)
    sides = np.linalg.norm(reference - np.roll(reference, 1, axis=1), axis=2)
    size = np.where(sides > 0, sides, np.inf).min(axis=1)[:, None, None]  # of a wedge one side has no length
    ends, _ = chain_lines(np.zeros((len(faces[has_area]), 3)), fields["cell_dimensions"], axes, 1.0)
    half = CHAIN_LOOK["reach"] * size * ends.reshape(-1, 8, 3)[:, ::2]  # (m, 4, 3): one half of each chain
    outward, middle = _normals(deformed), deformed.mean(axis=1, keepdims=True)
    arms = _on_plane(half @ np.swapaxes(gradient, 1, 2), outward)
    room = CHAIN_LOOK["room"] * _room(arms, _on_plane(deformed - middle, outward), outward)
    arms *= np.minimum(1.0, room)[..., None]
    across = np.cross(outward[:, None], arms)
    length = np.linalg.norm(across, axis=-1, keepdims=True)
    across *= CHAIN_LOOK["width"] / 2 * size / np.where(length > 0, length, 1.0)
    lift = LIFT_ALONG_NORMALS * outward[:, None] if towards is None else CHAIN_LOOK["lift"] * towards
    middle = middle + np.median(size) * lift
    corners = [middle - arms - across, middle + arms - across, middle + arms + across, middle - arms + across]
    points = np.stack(corners, axis=2).reshape(-1, 3)
    return pyvista.PolyData.from_regular_faces(points, np.arange(len(points), dtype=int).reshape(-1, 4))


def _on_plane(vectors: Array, normal: Array) -> Array:
    """Vectors (m, n, 3) without their part along a unit normal (m, 3)."""
    return vectors - np.einsum("mki,mi->mk", vectors, normal)[..., None] * normal[:, None]


def _room(arms: Array, corners: Array, normal: Array) -> Array:
    """Factors (m, n) by which lines from -arm to +arm (m, n, 3) reach the edge of faces about 0, corners (m, k, 3)."""
    edges = np.roll(corners, -1, axis=1) - corners
    across = np.cross(edges, normal[:, None])
    distance = np.abs(np.sum(across * corners, axis=2))
    towards = np.abs(np.einsum("mei,mki->mke", across, arms))
    reach = distance[:, None] / np.where(towards > 0, towards, np.finfo(float).tiny)
    length = np.linalg.norm(edges, axis=2)
    is_side = length > NO_SIDE * length.max(axis=1, keepdims=True)
    return np.where(is_side[:, None], reach, np.inf).min(axis=2)


def _normals(corners: Array) -> Array:
    """Unit normals of quadrilaterals (m, 4, 3) or triangles (m, 3, 3); 0 where they have no area."""
    last = corners.shape[1] - 1
    normal = np.cross(corners[:, 2] - corners[:, 0], corners[:, last] - corners[:, 1])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return normal / np.where(length > 0, length, 1.0)


# ---------------------------------------------------------------- pictures, by a child process


@dataclass(frozen=True)
class View:
    """A parallel view: from which side, what is in the middle, the length from top to bottom, the pixels."""

    direction: tuple[float, float, float]
    centre: tuple[float, float, float]
    height: float
    pixels: tuple[int, int]
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class PictureSheet:
    """Bodies beside each other, each with what stands above and below it; what stands below all of them."""

    grids: Sequence[pyvista.UnstructuredGrid]
    titles: Sequence[str]
    loads: Sequence[str]
    columns: int
    scale: str
    notes: str


def render(sheets: Sequence[PictureSheet], view: View) -> list[Pixels]:
    """Draw sheets off-screen, each (rows, columns, 3)."""
    with TemporaryDirectory(prefix="remodel-fenicsx-") as folder:
        job = Path(folder) / "job"
        job.write_bytes(pickle.dumps((list(sheets), view)))
        command = [sys.executable, "-m", __name__, str(job)]
        if shutil.which("xvfb-run"):
            command = ["xvfb-run", "-a", "-s", "-screen 0 1280x1024x24", *command]
        # the backend of a notebook is one that only its kernel may know
        environment = environment_of_child() | {"PYVISTA_OFF_SCREEN": "true", "MPLBACKEND": "agg"}
        # in the folder of the job: Python looks for modules where it is started, and that may be anybody's folder
        silent: Any = {"capture_output": True, "text": True, "stdin": subprocess.DEVNULL}
        child = subprocess.run(command, env=environment, cwd=folder, **silent)
        result = job.with_suffix(".npy")
        if child.returncode != 0 or not result.exists():
            said = last_line(child.stderr)
            message = f"no picture in space: pyvista ended with {child.returncode}: {said}; are xvfb and xauth there?"
            raise FigureError(message, 5)
        return list(np.load(result))


def main(job: str) -> None:
    """Draw the sheets of a job file and save the pictures beside it."""
    with open(job, "rb") as file:
        sheets, view = pickle.load(file)
    np.save(f"{job}.npy", [_drawn(sheet, view) for sheet in sheets])


def _drawn(sheet: PictureSheet, view: View) -> Pixels:
    """Twice as large, then made smaller: smooth edges with every VTK."""
    rows, (wide, tall) = math.ceil(len(sheet.grids) / sheet.columns), view.pixels
    head, foot = 4 * LETTER, 3 * LETTER * (1 + sheet.loads[0].count("\n"))
    whole = head + tall + foot
    size = [SAMPLES * max(NARROWEST, wide * sheet.columns), SAMPLES * (rows * whole + FOOT)]
    parts: dict[str, Any] = {"row_weights": [*[whole] * rows, FOOT], "groups": [(rows, slice(None))], "border": False}
    plotter: Any = new_plotter(off_screen=True, window_size=size, shape=(rows + 1, sheet.columns), **parts)
    direction, mapper = np.array(view.direction) / np.linalg.norm(view.direction), None
    for number, found in enumerate(sheet.grids):
        plotter.subplot(*divmod(number, sheet.columns))
        mapper = add_body(plotter, found, ANGLE, True, direction, line_width=0.5 * SAMPLES, show_scalar_bar=False)
        _look(plotter.camera, view, direction, whole / tall)
        plotter.renderer.reset_camera_clipping_range()
        _letters(plotter, sheet.titles[number], 1 - head / whole, LETTER)
        _letters(plotter, sheet.loads[number], 0.0, LETTER)
    plotter.subplot(rows, 0)
    look = {"n_labels": 7, "fmt": "%.0f", "color": "black", "label_font_size": 2 * SAMPLES * LETTER}
    plotter.add_scalar_bar("", mapper=mapper, width=0.6, position_x=0.2, position_y=0.5, height=0.45, **look)
    _look(plotter.camera, view, direction, 1.0)
    plotter.add_axes(viewport=(0.84, 0.3, 1.0, 1.0), color="black")
    _letters(plotter, sheet.scale, 0.3, LETTER)
    _letters(plotter, sheet.notes, 0.05, NOTE)
    image = Image.fromarray(np.asarray(plotter.screenshot(return_img=True))[..., :3])
    plotter.close()
    return np.asarray(image.reduce(SAMPLES))


def _letters(plotter: Any, text: str, height: float, size: int) -> None:
    """Letters in the middle of the present part, so far above its lower edge."""
    look: dict[str, Any] = {"color": "black", "viewport": True, "font_size": SAMPLES * size}
    plotter.add_text(text, position=(0.5, height), **look).prop.justification_horizontal = "center"


def _look(camera: Any, view: View, direction: Array, room: float) -> None:
    camera.focal_point, camera.up = view.centre, view.up
    camera.position = tuple(np.array(view.centre) + 10 * view.height * direction)
    camera.parallel_projection, camera.parallel_scale = True, room * view.height / 2


# ---------------------------------------------------------------- what is seen, at which times and from where

CUTS = ("half", "quarter")
CUT_IN_WORDS = {"half": "the half in front cut off", "quarter": "the quarter in front cut off"}
VIEW_MARGIN = 1.05  # of what is seen over the body's size
ASPECT = (0.28, 2.2)  # least and largest width over height of a view


@dataclass(frozen=True)
class Viewing:
    """How a body is looked at."""

    layers: int | None = None
    cut: str | None = None
    view: str = "front"

    @property
    def direction(self) -> tuple[float, float, float]:
        """Towards the eye."""
        if self.view in VIEWS:
            return VIEWS[self.view]
        try:
            x, y, z = (float(text) for text in self.view.split(","))
        except ValueError:
            x = y = z = math.nan
        if not 0 < math.hypot(x, y, z) < math.inf:
            allowed = f"{', '.join(VIEWS)} or X,Y,Z, where the eye is from the middle of the body"
            raise FigureError(f"view {self.view}: allowed is {allowed}", 2)
        return x, y, z


def shown_elements(whole: WholeBody, viewing: Viewing) -> NDArray[np.bool_]:
    """Which elements are neither peeled nor cut off, (elements,)."""
    layers, count = viewing.layers, len(whole.depth)
    if layers is not None and not 1 <= layers <= count:
        start = whole.recording.scene.geometry.depth_in_words[1]
        raise FigureError(f"layers {layers}: allowed is a whole number from 1 to {count}, from the {start}", 2)
    return (whole.layer < (layers or count)) & ~_cut_off(whole, viewing.cut)


def _cut_off(whole: WholeBody, cut: str | None) -> NDArray[np.bool_]:
    centres = whole.points[whole.elements].mean(axis=1)
    middle = (whole.points.min(axis=0) + whole.points.max(axis=0)) / 2
    slack = 1e-6 * np.ptp(whole.points)  # an element on the border stays
    is_front, is_right = centres[:, 1] < middle[1] - slack, centres[:, 0] > middle[0] + slack
    found = {None: np.zeros(len(centres), dtype=bool), "half": is_front, "quarter": is_front & is_right}
    if cut not in found:
        raise FigureError(f"cut {cut}: allowed are {', '.join(CUTS)}", 2)
    if cut is not None and not found[cut].any():
        raise FigureError(f"cut {cut}: no whole element of this body lies in that part", 2)
    return found[cut]


class Sight:
    """A run's body and what of it is seen."""

    def __init__(self, recording: RecordedRun, viewing: Viewing):
        self.recording, self.viewing, self.direction = recording, viewing, viewing.direction
        self.whole = whole_body(recording)
        recorded = set(recording.fields(recording.times[0], SHOWN_FIELDS))
        if ANGLE not in recorded:
            raise FigureError(
                f"{recording.path}: the run recorded no {ANGLE} (output.fields), which the colours show", 2
            )
        self.has_chains = set(OF_RIBBONS) <= recorded
        self.is_deformed = self.whole.is_turned <= ("deformation_gradient" in recorded) and "displacement" in recorded
        self.shown = shown_elements(self.whole, viewing)

    def times(self, wanted: Sequence[float] | None) -> list[float]:
        """The recorded times nearest to these, each once; the last one where none are wanted."""
        recorded = self.recording.times
        first, last = float(recorded[0]), float(recorded[-1])
        for time in wanted or ():
            inside = first <= time <= last or same_time(time, first) or same_time(time, last)
            if not inside:
                raise FigureError(f"times {time:g}: allowed are times from {first:g} to {last:g}", 2)
        nearest = [float(recorded[np.abs(recorded - time).argmin()]) for time in wanted or (last,)]
        return list(dict.fromkeys(nearest))

    def view(self, grids: Sequence[pyvista.UnstructuredGrid], box: tuple[int, int]) -> View:
        """All of what is seen, at all of these times, as large as a box (width, height) in pixels holds it."""
        towards = np.array(self.direction) / np.linalg.norm(self.direction)
        is_steep = abs(towards[2]) >= 0.9999  # no direction of z is left in the picture
        right = np.cross([0.0, 1.0, 0.0] if is_steep else [0.0, 0.0, 1.0], towards)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(towards, right), towards])
        moved = [found.point_data.get("displacement", 0.0) for found in grids]
        places = np.concatenate([(found.points + by) @ axes.T for found, by in zip(grids, moved, strict=True)])
        low, high = places.min(axis=0), places.max(axis=0)
        wide, tall, _ = high - low
        aspect = float(np.clip(wide / max(tall, 1e-9 * wide), *ASPECT))
        height = min(box[1], box[0] / aspect)
        pixels = round(height * aspect), round(height)
        x, y, z = ((low + high) / 2) @ axes
        up = tuple(axes[1]) if is_steep else (0.0, 0.0, 1.0)
        return View(tuple(towards), (x, y, z), VIEW_MARGIN * max(tall, wide / aspect), pixels, up)

    def loads(self, time: float) -> list[str]:
        """The loads at a recorded time, as its row of the history has them; none before there is one."""
        scene, history, found = self.recording.scene, self.recording.history, []
        row = np.flatnonzero([same_time(recorded, time) for recorded in history["time"]])
        for name in scene.loads:
            column = scene.load_kinds[name].make_column(name)
            if len(row) and column.name in history:
                value = with_unit(float(history[column.name][row[0]]), unit_of(scene, column.unit))
                found.append(f"{words(column.name)} {value}")
        return found

    def notes(self) -> list[str]:
        """What is to be known of the picture."""
        scene, count = self.recording.scene, len(self.whole.depth)
        number = len(self.whole.elements)
        kind = "hexahedr" if self.whole.elements.shape[1] == 8 else "tetrahedr"
        size = " x ".join(f"{length:.3g}" for length in np.ptp(self.whole.points, axis=0))
        first = [f"{scene.geometry.name} of {size} {scene.geometry.length_unit or ''}".rstrip()]
        first.append(f"{number:,} {kind}{'on' if number == 1 else 'a'}")
        if self.viewing.layers not in (None, count):
            first.append(f"{self.viewing.layers} of {count} layers, from the {scene.geometry.depth_in_words[1]}")
        if self.viewing.cut:
            first.append(CUT_IN_WORDS[self.viewing.cut])
        chains = "Black: the four chains of each element's mean cell, deformed, projected on its face."
        return ["; ".join(first) + ".", *self.whole.notes(self.is_deformed), *([chains] if self.has_chains else [])]


# ---------------------------------------------------------------- pictures and animations as files
# Sheets of bodies at some times, with scale and axes; nothing is overwritten.

PICTURES, ANIMATIONS = (".png", ".pdf"), (".gif", ".webp")
MOST_PANELS, MOST_COLUMNS = 12, 4
MOVIE_FRAMES, FEWEST_FRAMES, MOST_FRAMES = 60, 2, 500  # by default; an animation of one is a picture; all are in memory
FRAME_TIME, LAST_TIME = 80, 1600  # ms that a frame stands; multiples of 10, as GIF counts
ALONE, BESIDE, FRAME = (1000, 880), (500, 600), (600, 530)  # pixels of a body: alone, beside others, in an animation
NOTE_LETTER = 6.3  # pixels, mean width


def draw_picture(
    folder: str | os.PathLike[str], times: Sequence[float] | None = None, viewing: Viewing | None = None,
    path: Path | None = None,
) -> Path:  # fmt: skip
    """Draw the body of a run at some of its times, beside each other."""
    _check_new(path, PICTURES)
    sight = Sight(RecordedRun(folder), viewing or Viewing())
    shown = sight.times(times)
    if len(shown) > MOST_PANELS:
        raise FigureError(f"times: {len(shown)} times; allowed are {MOST_PANELS} in a picture (animate shows more)", 2)
    sheets, view = _sheets(sight, shown, BESIDE if len(shown) > 1 else ALONE, min(len(shown), MOST_COLUMNS))
    return _write(path, sight, shown, path.suffix.lower() if path else ".png", render(sheets, view), "picture")


def draw_animation(
    folder: str | os.PathLike[str], frames: int = MOVIE_FRAMES, viewing: Viewing | None = None, path: Path | None = None
) -> Path:
    """Draw the body of a run as it moves through time."""
    _check_new(path, ANIMATIONS)
    if not FEWEST_FRAMES <= frames <= MOST_FRAMES:
        raise FigureError(f"--frames {frames}: allowed is a whole number from {FEWEST_FRAMES} to {MOST_FRAMES}", 2)
    sight = Sight(RecordedRun(folder), viewing or Viewing())
    if len(sight.recording.times) < FEWEST_FRAMES:
        raise FigureError(f"{sight.recording.path}: fields of one time alone are recorded, so nothing moves", 2)
    times = [float(time) for time in kept_times(sight.recording.history, sight.recording.times, frames)]
    sheets, view = _sheets(sight, times, FRAME, 0)
    images = render(sheets, view)
    return _write(path, sight, [times[0], times[-1]], path.suffix.lower() if path else ".gif", images, "animate")


def _sheets(
    sight: Sight, times: Sequence[float], box: tuple[int, int], columns: int
) -> tuple[list[PictureSheet], View]:
    """One of so many columns for all times, or one for each; all of one view."""
    grids = [grid(sight.whole, time, sight.shown, SHOWN_FIELDS) for time in times]
    view, parts = sight.view(grids, box), [slice(None)] if columns else [slice(k, k + 1) for k in range(len(times))]
    titles, loads = [f"t = {time:g}" for time in times], ["\n".join(sight.loads(time)) for time in times]
    along, across = sight.recording.scene.geometry.angle_in_words
    wide = max(NARROWEST, max(1, columns) * view.pixels[0])
    notes = textwrap.fill(" ".join([f"{sight.recording.scene.name}:", *sight.notes()]), int(wide / NOTE_LETTER))
    scale = f"angle of the collagen, deformed: 0 {along}, 90 {across} (degrees)"
    return [PictureSheet(grids[p], titles[p], loads[p], max(1, columns), scale, notes) for p in parts], view


def _encoded(sight: Sight, images: Sequence[Pixels], ending: str, command: str) -> bytes:
    """Pictures as a file, with what it shows and what it was made with."""
    scene, versions = sight.recording.scene, sight.recording.versions
    about = {
        "Title": f"{scene.name}: angle of the collagen", "Software": f"remodel_fenicsx {__version__}",
        "Description": " ".join(sight.notes()), "Comment": f"remodel-fenicsx {command}",
        "Source": "; ".join(f"{name} {version}" for name, version in versions.items()),
    }  # fmt: skip
    texts, file, durations = PngInfo(), io.BytesIO(), [FRAME_TIME] * (len(images) - 1) + [LAST_TIME]
    for key, value in about.items():
        texts.add_text(key, value)
    first, *others = map(Image.fromarray, images)
    moving: dict[str, Any] = {"save_all": True, "append_images": others, "loop": 0, "duration": durations}
    kinds: dict[str, dict[str, Any]] = {
        ".png": {"pnginfo": texts, "optimize": True}, ".pdf": {"title": about["Title"], "resolution": 200},
        ".gif": {**moving, "comment": about["Comment"].encode()}, ".webp": {**moving, "quality": 90},
    }  # fmt: skip
    first.save(file, ending[1:], **kinds[ending])
    return file.getvalue()


# ---------------------------------------------------------------- names
def _check_new(path: Path | None, endings: Sequence[str]) -> None:
    """Before anything is drawn."""
    if path is None:
        return
    if path.suffix.lower() not in endings:
        raise FigureError(f"path {path}: allowed is a name that ends in {', '.join(endings)}", 2)
    if os.path.lexists(path):
        raise TakenError(path)
    if not path.parent.is_dir():
        raise FigureError(f"path {path}: there is no folder {path.parent}", 2)


def _write(
    path: Path | None, sight: Sight, times: Sequence[float], ending: str, images: Sequence[Pixels], command: str
) -> Path:
    data = _encoded(sight, images, ending, command)
    if path is not None:
        write_new(path, data)
        return path
    ends = dict.fromkeys([times[0], times[-1]])
    stem = "-".join([sight.recording.scene.name, *(f"t{time:g}" for time in ends)])
    for number in itertools.count(1):
        free = sight.recording.path / f"{stem}{f'-{number}' if number > 1 else ''}{ending}"
        with suppress(TakenError):
            write_new(free, data)
            return free
    raise AssertionError("numbers do not end")


if __name__ == "__main__":
    main(sys.argv[1])
