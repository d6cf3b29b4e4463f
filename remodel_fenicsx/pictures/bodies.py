"""The body of a run in PyVista: a grid with its fields, a plotter with colours and chains, and pictures of it.

Pictures are drawn by a child process, ``python3 -m remodel_fenicsx.pictures.bodies JOB``: a VTK that knows only X
(Debian 13's) kills its process where there is no display, so the child gets one of its own from xvfb-run. A VTK that
can draw without (EGL) gets by without that program.
"""

from __future__ import annotations

import math
import pickle
import shutil
import subprocess
import sys
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TYPE_CHECKING

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, Colormap, ListedColormap
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from remodel_fenicsx.results.recording import (
    AMBIENT,
    ANGLE_COLOURS,
    CHAIN_LOOK,
    HistoryColumns,
    LEVELS,
    RecordedRun,
    RecordingError,
    VIEWS,
    unit_of,
    with_unit,
    words,
)
from remodel_fenicsx.results.whole_body import AXIS_FIELDS, WholeBody, chain_lines, has_a_body
from remodel_fenicsx.schema import same_time
from remodel_fenicsx.studies.page import FigureError
from remodel_fenicsx.system.children import environment_of_child, last_line
from remodel_fenicsx.system.files import temporary_folder

if TYPE_CHECKING:
    import pyvista

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

SAMPLES = 2  # pictures are drawn this much larger and made smaller: smooth edges with every VTK
ANGLE = "fibre_angle_deformed"  # by which bodies are coloured
ANGLES = ("fibre_angle", ANGLE)  # fields in degrees, from 0 to 90
OF_RIBBONS = ("deformation_gradient", "cell_dimensions", *AXIS_FIELDS)  # fields that chains are drawn of
SHOWN_FIELDS = ("displacement", ANGLE, *OF_RIBBONS)
NO_SIDE = 1e-4  # of the longest: such a side is one point of a wedge on an axis, to the digits of the fields
LIFT_ALONG_NORMALS = 0.05  # of chains, over the shorter side of a face, where the eye may be anywhere
NOTHING_KNOWN = (0.6, 0.62, 0.65)  # where chains have no angle


# ---------------------------------------------------------------- colours


def scale() -> tuple[Colormap, BoundaryNorm]:
    """Colours from red (0 degrees, aligned) over yellow to blue (90 degrees, orthogonal), in equal steps."""
    return ListedColormap(ANGLE_COLOURS), BoundaryNorm(np.linspace(0.0, 90.0, LEVELS + 1), LEVELS, clip=True)


def coloured(angle: Array) -> Array:
    """Colours (m, 3) of angles in degrees (m,); NaN is grey."""
    colours, steps = scale()
    return np.where(np.isnan(angle)[:, None], NOTHING_KNOWN, colours(steps(np.nan_to_num(angle)))[:, :3])


def scale_colours() -> Array:
    """Every colour of the scale, also as a face shows it that is turned away from the eye, (n, 3) in 0..1."""
    return np.concatenate([share * coloured(_middles()) for share in np.linspace(1.0, AMBIENT, 5)])


def _middles() -> Array:
    """Of the steps of the scale, in degrees."""
    return (np.arange(LEVELS) + 0.5) * (90.0 / LEVELS)


def angle_scale(figure: Figure, place_at: tuple[float, float, float, float], label: str) -> None:
    """The scale of all angles: 0 to 90 degrees, red to blue; `label` says from which direction to which."""
    axes = figure.add_axes(place_at)
    colours, steps = scale()
    bar: Any = figure.colorbar(ScalarMappable(steps, colours), cax=axes, orientation="horizontal")
    bar.set_ticks(range(0, 91, 15), labels=[f"{angle}°" for angle in range(0, 91, 15)])
    bar.ax.tick_params(length=2.5, labelsize=8, pad=2)
    bar.outline.set_linewidth(0.5)
    bar.set_label(label, fontsize=8.5, labelpad=2)


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
    plotter.add_light(pyvista.Light(light_type="headlight", intensity=1.0))
    return plotter


def add_body(
    plotter: pyvista.Plotter, found: pyvista.UnstructuredGrid, name: str, with_chains: bool, towards: Array | None,
    **options: Any,
) -> None:  # fmt: skip
    """A deformed body by a field, and its chains, as far as they were recorded."""
    import pyvista

    light: dict[str, Any] = {"ambient": AMBIENT, "diffuse": 1 - AMBIENT, "specular": 0.0}
    looks = {"scalars": name, "show_edges": True, "edge_color": "#777777", **light}
    if name in ANGLES:
        table: Any = pyvista.LookupTable()
        table.values = np.rint(255 * np.column_stack([coloured(_middles()), np.ones(LEVELS)])).astype(np.uint8)
        table.scalar_range, table.nan_color = (0.0, 90.0), NOTHING_KNOWN
        looks["cmap"] = table
    is_deformed = "displacement" in found.point_data
    plotter.add_mesh(found.warp_by_vector("displacement") if is_deformed else found, **{**looks, **options})
    if with_chains and set(OF_RIBBONS) <= set(found.cell_data):
        plotter.add_mesh(chains(found, towards), color=CHAIN_LOOK["colour"], culling="back", **light)


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


def render(grids: Sequence[pyvista.UnstructuredGrid], view: View) -> list[Pixels]:
    """Draw bodies off-screen by their angle, each (rows, columns, 3)."""
    with temporary_folder() as folder:
        job = folder / "job"
        job.write_bytes(pickle.dumps((list(grids), view)))
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
    """Draw the bodies of a job file and save the pictures beside it."""
    with open(job, "rb") as file:
        grids, view = pickle.load(file)
    np.save(f"{job}.npy", [_drawn(found, view) for found in grids])


def _drawn(found: pyvista.UnstructuredGrid, view: View) -> Pixels:
    columns, rows = (SAMPLES * pixels for pixels in view.pixels)
    plotter: Any = new_plotter(off_screen=True, window_size=[columns, rows])
    direction = np.array(view.direction) / np.linalg.norm(view.direction)
    add_body(plotter, found, ANGLE, True, direction, line_width=0.5 * SAMPLES, show_scalar_bar=False)
    camera = plotter.camera
    camera.focal_point, camera.up = view.centre, view.up
    camera.position = tuple(np.array(view.centre) + 10 * view.height * direction)
    camera.parallel_projection, camera.parallel_scale = True, view.height / 2
    plotter.reset_camera_clipping_range()
    image = np.asarray(plotter.screenshot(return_img=True))[..., :3]
    plotter.close()
    smaller = image.reshape(rows // SAMPLES, SAMPLES, columns // SAMPLES, SAMPLES, 3).mean(axis=(1, 3))
    return np.rint(smaller).astype(np.uint8)


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

    @cached_property
    def history(self) -> HistoryColumns:
        """Of the run, which may still be under way."""
        return self.recording.history

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

    def grids(self, times: Sequence[float]) -> list[pyvista.UnstructuredGrid]:
        """What is seen at recorded times."""
        return [grid(self.whole, time, self.shown, SHOWN_FIELDS) for time in times]

    def axes(self) -> Array:
        """Right, up and towards the eye: unit vectors, as rows (3, 3)."""
        towards = np.array(self.direction) / np.linalg.norm(self.direction)
        up = np.array([0.0, 0.0, 1.0]) if abs(towards[2]) < 0.9999 else np.array([0.0, 1.0, 0.0])
        right = np.cross(up, towards)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(towards, right), towards])

    def view(self, grids: Sequence[pyvista.UnstructuredGrid], box: tuple[float, float], dots: float) -> View:
        """All of what is seen, at all of these times, as large as a box (width, height) in inches holds it."""
        axes, moved = self.axes(), [found.point_data.get("displacement", 0.0) for found in grids]
        places = np.concatenate([(found.points + by) @ axes.T for found, by in zip(grids, moved, strict=True)])
        low, high = places.min(axis=0), places.max(axis=0)
        wide, tall, _ = high - low
        aspect = float(np.clip(wide / max(tall, 1e-9 * wide), *ASPECT))
        height = min(box[1], box[0] / aspect)
        pixels = round(dots * height * aspect), round(dots * height)
        x, y, z = ((low + high) / 2) @ axes
        up = axes[1] if abs(axes[2, 2]) >= 0.9999 else np.array([0.0, 0.0, 1.0])
        return View(tuple(axes[2]), (x, y, z), VIEW_MARGIN * max(tall, wide / aspect), pixels, tuple(up))

    def loads(self, time: float) -> list[str]:
        """The loads at a recorded time, as its row of the history has them; none before there is one."""
        scene, found = self.recording.scene, []
        row = np.flatnonzero([same_time(recorded, time) for recorded in self.history["time"]])
        for name in scene.loads:
            column = scene.load_kinds[name].make_column(name)
            if len(row) and column.name in self.history:
                value = with_unit(float(self.history[column.name][row[0]]), unit_of(scene, column.unit))
                found.append(f"{words(column.name)} {value}")
        return found

    def notes(self) -> list[str]:
        """What is to be known of the picture."""
        scene, count = self.recording.scene, len(self.whole.depth)
        number = len(self.whole.elements)
        kind = "hexahedr" if self.whole.elements.shape[1] == 8 else "tetrahedr"
        first = [f"{scene.geometry.name}, {number:,} {kind}{'on' if number == 1 else 'a'}"]
        if self.viewing.layers not in (None, count):
            first.append(f"{self.viewing.layers} of {count} layers, from the {scene.geometry.depth_in_words[1]}")
        if self.viewing.cut:
            first.append(CUT_IN_WORDS[self.viewing.cut])
        chains = "Black: the four chains of each element's mean cell, deformed, projected on its face."
        return ["; ".join(first), *self.whole.notes(self.is_deformed), *([chains] if self.has_chains else [])]


if __name__ == "__main__":
    main(sys.argv[1])
