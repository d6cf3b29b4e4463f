"""Bodies at a time of a recording, and in pictures: elements by their fibre angle, with the chains on the surface."""

from __future__ import annotations

import math
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, Colormap, ListedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from remodel_fenicsx.results.history import unit_of, with_unit, words
from remodel_fenicsx.results.recording import (
    AMBIENT,
    ANGLE_COLOURS,
    CHAIN_COLOUR,
    CHAIN_LIFT,
    CHAIN_REACH,
    CHAIN_ROOM,
    CHAIN_WIDTH,
    HistoryColumns,
    LEVELS,
    RecordedRun,
    VIEWS,
)
from remodel_fenicsx.results.turned import AXIS_FIELDS, chain_lines
from remodel_fenicsx.results.whole_body import WholeBody, has_a_body, rank_of
from remodel_fenicsx.schema.times import same_time
from remodel_fenicsx.studies.page import FigureError
from remodel_fenicsx.system.temporary import temporary_folder


# ---------------------------------------------------------------- pictures of bodies in space, drawn in a child
# Pictures of bodies in space, drawn in a child process: ``python3 -m remodel_fenicsx.pictures.bodies JOB``.
#  A VTK that knows only X (Debian 13's) kills its process where there is no display, so the child gets one of its own
# from xvfb-run; a VTK that can draw without (EGL) gets by without that program.

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

SAMPLES = 2  # pictures are drawn this much larger and made smaller: smooth edges with every VTK


@dataclass(frozen=True)
class Patch:
    """Quadrilaterals or triangles in space."""

    corners: Array
    colours: Array
    edges: bool = False
    lies_on: float = 0.0


@dataclass(frozen=True)
class View:
    """A parallel view: from which side, what is in the middle, the length from top to bottom, the pixels."""

    direction: tuple[float, float, float]
    centre: tuple[float, float, float]
    height: float
    pixels: tuple[int, int]
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Picture:
    """What is seen and from where."""

    view: View
    patches: list[Patch] = field(default_factory=list)


def render(pictures: list[Picture]) -> list[Pixels]:
    """Draw pictures off-screen, each (rows, columns, 3)."""
    with temporary_folder() as folder:
        job = folder / "job"
        job.write_bytes(pickle.dumps(pictures))
        command = [sys.executable, "-m", __name__, str(job)]
        if shutil.which("xvfb-run"):
            command = ["xvfb-run", "-a", "-s", "-screen 0 1280x1024x24", *command]
        paths = [str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "PYVISTA_OFF_SCREEN": "true"}
        environment["MPLBACKEND"] = "agg"  # a notebook's own is one that only its kernel may know
        # in the folder of the job: Python looks for modules where it is started, and that may be anybody's folder
        silent: Any = {"capture_output": True, "text": True, "stdin": subprocess.DEVNULL}
        child = subprocess.run(command, env=environment, cwd=folder, **silent)
        result = job.with_suffix(".npz")
        if child.returncode != 0 or not result.exists():
            said = (child.stderr.strip().splitlines() or ["it said nothing"])[-1]
            message = f"no picture in space: pyvista ended with {child.returncode}: {said}; are xvfb and xauth there?"
            raise FigureError(message, 5)
        with np.load(result) as found:
            return [found[f"picture{number}"] for number in range(len(pictures))]


# ---------------------------------------------------------------- the child


def main(job: str) -> None:
    """Draw the pictures of a job file and save them beside it."""
    with open(job, "rb") as file:
        pictures = pickle.load(file)
    drawn: dict[str, Any] = {f"picture{number}": _draw(picture) for number, picture in enumerate(pictures)}
    np.savez(f"{job}.npz", **drawn)


def add_patches(plotter: Any, patches: list[Patch], direction: Array | None, line_width: float = 1.0) -> None:
    """Put patches into a PyVista plotter whose light is a headlight."""
    import pyvista

    for patch in patches:
        count, size = patch.corners.shape[:2]
        if not count:
            continue
        faces = np.column_stack([np.full(count, size), np.arange(size * count).reshape(-1, size)]).ravel()
        lift = patch.lies_on * (_normal(patch.corners) if direction is None else direction)
        surface = pyvista.PolyData((patch.corners + lift).reshape(-1, 3), faces)
        surface.cell_data["colour"] = np.rint(255 * patch.colours).astype(np.uint8)
        plotter.add_mesh(
            surface, scalars="colour", rgb=True, show_edges=patch.edges, edge_color="#777777",
            line_width=line_width * 0.5, ambient=AMBIENT, diffuse=1 - AMBIENT, specular=0.0, smooth_shading=False,
            show_scalar_bar=False, culling="back" if patch.lies_on else None,
        )  # fmt: skip


def _normal(corners: Array) -> Array:
    """Unit normals of faces (m, n, 3), as (m, 1, 3)."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return (normal / np.where(length > 0, length, 1.0))[:, None]


def _draw(picture: Picture) -> Pixels:
    import pyvista

    columns, rows = (SAMPLES * pixels for pixels in picture.view.pixels)
    plotter: Any = pyvista.Plotter(off_screen=True, window_size=[columns, rows], lighting="none")
    plotter.set_background("white")
    plotter.add_light(pyvista.Light(light_type="headlight", intensity=1.0))
    direction = np.array(picture.view.direction) / np.linalg.norm(picture.view.direction)
    add_patches(plotter, picture.patches, direction, SAMPLES)
    view = picture.view
    camera = plotter.camera
    camera.focal_point = view.centre
    camera.position = tuple(np.array(view.centre) + 10 * view.height * direction)
    camera.up = view.up
    camera.parallel_projection = True
    camera.parallel_scale = view.height / 2
    plotter.reset_camera_clipping_range()
    image = np.asarray(plotter.screenshot(return_img=True))[..., :3]
    plotter.close()
    smaller = image.reshape(rows // SAMPLES, SAMPLES, columns // SAMPLES, SAMPLES, 3).mean(axis=(1, 3))
    return np.rint(smaller).astype(np.uint8)


Table = dict[str, NDArray[Any]]  # columns by name, all of one length
Shown = NDArray[np.bool_] | slice  # which elements
ALL = slice(None)

ANGLE = "fibre_angle_deformed"  # by which bodies are coloured
OF_RIBBONS = ("deformation_gradient", "cell_dimensions", *AXIS_FIELDS)  # fields that chains are drawn of
SHOWN_FIELDS = ("displacement", ANGLE, *OF_RIBBONS)
NO_SIDE = 1e-4  # of the longest: such a side is one point of a wedge on an axis, to the digits of the fields
NOTHING_KNOWN = (0.6, 0.62, 0.65)  # where chains have no angle

# faces of VTK's hexahedron and tetrahedron, by their local nodes
_FACES = {
    8: np.array([(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]),
    4: np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)]),
}


@dataclass(frozen=True)
class DrawnBody:
    """A body of hexahedra or tetrahedra at one time."""

    time: float
    points: Array
    elements: NDArray[np.int64]
    displacement: Array
    fields: dict[str, Array]

    @classmethod
    def of(cls, run: RecordedRun, time: float) -> DrawnBody:
        """The solved state of a run at a recorded time."""
        return cls.at(WholeBody(run), time)

    @classmethod
    def at(cls, whole: WholeBody, time: float, names: Collection[str] | None = None) -> DrawnBody:
        """The same of a body that is looked at several times; without displacements it is the reference body."""
        displacement, fields = whole.fields(time, names)
        moved = np.zeros_like(whole.points) if displacement is None else displacement
        return cls(time, whole.points, whole.elements, moved, fields)

    @property
    def centres(self) -> Array:
        """Reference centres of the elements, (elements, 3)."""
        return self.points[self.elements].mean(axis=1)

    @property
    def deformed(self) -> Array:
        """Deformed coordinates of the nodes, (nodes, 3)."""
        return self.points + self.displacement

    def exterior(self, shown: Shown = ALL) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Faces of the shown elements that no other shown element covers: nodes (m, 4 or 3), elements (m,)."""
        elements, of_one = np.arange(len(self.elements))[shown], _FACES[self.elements.shape[1]]
        faces = self.elements[elements][:, of_one].reshape(-1, of_one.shape[1])
        _, number, count = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
        alone = count[np.ravel(number)] == 1
        return faces[alone], np.repeat(elements, len(of_one))[alone]


def radii(points: Array, elements: NDArray[np.int64]) -> Array:
    """Mean distance of each element's nodes from the z axis, (elements,)."""
    return np.linalg.norm(points[:, :2], axis=1)[elements].mean(axis=1)


def layers(snapshot: DrawnBody) -> NDArray[np.int64]:
    """Number of each element's layer in the wall of a tube, from the inside, (elements,)."""
    return rank_of(radii(snapshot.points, snapshot.elements))


# ---------------------------------------------------------------- pictures


def scale() -> tuple[Colormap, BoundaryNorm]:
    """Colours from red (0 degrees, aligned) over yellow to blue (90 degrees, orthogonal), in equal steps."""
    return ListedColormap(ANGLE_COLOURS), BoundaryNorm(np.linspace(0.0, 90.0, LEVELS + 1), LEVELS, clip=True)


def coloured(angle: Array) -> Array:
    """Colours (m, 3) of angles in degrees (m,); NaN is grey."""
    colours, steps = scale()
    return np.where(np.isnan(angle)[:, None], NOTHING_KNOWN, colours(steps(np.nan_to_num(angle)))[:, :3])


def scale_colours() -> Array:
    """Every colour of the scale, also as a face shows it that is turned away from the eye, (n, 3) in 0..1."""
    middle = (np.arange(LEVELS) + 0.5) * (90.0 / LEVELS)
    return np.concatenate([share * coloured(middle) for share in np.linspace(1.0, AMBIENT, 5)])


def body(snapshot: DrawnBody, shown: Shown = ALL, chains_everywhere: bool = False) -> list[Patch]:
    """The surface of the shown elements in the deformed configuration, and chains on its faces."""
    faces, elements, normal = outer_faces(snapshot, shown)
    surface = Patch(snapshot.deformed[faces], coloured(snapshot.fields[ANGLE][elements]), edges=True)
    if not set(OF_RIBBONS) <= set(snapshot.fields):
        return [surface]
    if not chains_everywhere:
        centres = snapshot.points[faces].mean(axis=1)
        normal *= np.sign(np.sum(normal * (centres - snapshot.centres[elements]), axis=1))[:, None]
        away = np.sum(normal[:, :2] * centres[:, :2], axis=1) > 0.5 * np.linalg.norm(centres[:, :2], axis=1)
        faces, elements = faces[away], elements[away]
    return [surface, chains(snapshot, faces, elements)]


def outer_faces(snapshot: DrawnBody, shown: Shown = ALL) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Faces that are seen: nodes (m, 4 or 3), elements (m,), unit normals in the reference body (m, 3)."""
    faces, elements = snapshot.exterior(shown)
    normal = _normals(snapshot.points[faces])
    has_area = np.any(normal, axis=1)  # wedges on an axis are hexahedra with a face of no area
    return faces[has_area], elements[has_area], normal[has_area]


def chains(snapshot: DrawnBody, faces: NDArray[np.int64], elements: NDArray[np.int64]) -> Patch:
    """The four chains of each element, deformed, projected on one of its faces: narrow ribbons."""
    fields, reference, deformed = snapshot.fields, snapshot.points[faces], snapshot.deformed[faces]
    centres, middle = reference.mean(axis=1), deformed.mean(axis=1)
    axes = np.stack([fields[f"axis_{i + 1}"][elements] for i in range(3)], axis=1)
    gradient = fields["deformation_gradient"][elements].reshape(-1, 3, 3)
    sides = np.linalg.norm(reference - np.roll(reference, 1, axis=1), axis=2)
    size = np.where(sides > 0, sides, np.inf).min(axis=1)  # of a wedge one side has no length
    ends, _ = chain_lines(np.zeros_like(centres), fields["cell_dimensions"][elements], axes, 1.0)
    half = CHAIN_REACH * size[:, None, None] * ends.reshape(-1, 8, 3)[:, ::2]  # (m, 4, 3): one half of each chain
    outward = _normals(deformed)
    inner = np.einsum("mij,mj->mi", gradient, snapshot.centres[elements] - centres)
    outward *= -np.sign(np.sum(outward * inner, axis=1))[:, None]
    arms = _on_plane(half @ np.swapaxes(gradient, 1, 2), outward)
    arms *= np.minimum(1.0, CHAIN_ROOM * _room(arms, _on_plane(deformed - middle[:, None], outward), outward))[
        ..., None
    ]
    across = np.cross(outward[:, None], arms)
    length = np.linalg.norm(across, axis=-1, keepdims=True)
    across *= (CHAIN_WIDTH / 2 * size)[:, None, None] / np.where(length > 0, length, 1.0)
    start, end = middle[:, None] - arms, middle[:, None] + arms
    corners = np.stack([start - across, end - across, end + across, start + across], axis=2).reshape(-1, 4, 3)
    lift = CHAIN_LIFT * float(np.median(size)) if len(size) else 0.0
    return Patch(corners, np.tile(CHAIN_COLOUR, (len(corners), 1)), lies_on=lift)


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


# ---------------------------------------------------------------- on the page


def place(axes: Axes, image: Pixels) -> None:
    """Put a picture into axes that show nothing else, at their upper edge."""
    axes.imshow(image, interpolation="lanczos")
    axes.set_anchor("N")
    axes.set_axis_off()


def angle_scale(figure: Figure, place_at: tuple[float, float, float, float], label: str) -> None:
    """The scale of all angles: 0 to 90 degrees, red to blue; `label` says from which direction to which."""
    axes = figure.add_axes(place_at)
    colours, steps = scale()
    bar: Any = figure.colorbar(ScalarMappable(steps, colours), cax=axes, orientation="horizontal")
    bar.set_ticks(range(0, 91, 15), labels=[f"{angle}°" for angle in range(0, 91, 15)])
    bar.ax.tick_params(length=2.5, labelsize=8, pad=2)
    bar.outline.set_linewidth(0.5)
    bar.set_label(label, fontsize=8.5, labelpad=2)


# ---------------------------------------------------------------- what of a run's body is seen, at which times and
# What of a run's body is seen, at which times and from where.

Numbers = NDArray[np.float64]

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
        if not has_a_body(recording):
            raise FigureError(f"{recording.path}: the run recorded no fields of a body (output.fields)", 2)
        self.whole = WholeBody(recording)
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

    def snapshots(self, times: Sequence[float]) -> list[DrawnBody]:
        """The body at recorded times."""
        return [DrawnBody.at(self.whole, time, SHOWN_FIELDS) for time in times]

    def axes(self) -> Numbers:
        """Right, up and towards the eye: unit vectors, as rows (3, 3)."""
        towards = np.array(self.direction) / np.linalg.norm(self.direction)
        up = np.array([0.0, 0.0, 1.0]) if abs(towards[2]) < 0.9999 else np.array([0.0, 1.0, 0.0])
        right = np.cross(up, towards)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(towards, right), towards])

    def view(self, snapshots: Sequence[DrawnBody], box: tuple[float, float], dots: float) -> View:
        """All of what is seen, at all of these times, as large as a box (width, height) in inches holds it."""
        axes, used = self.axes(), np.unique(self.whole.elements[self.shown])
        places = np.concatenate([snapshot.deformed[used] @ axes.T for snapshot in snapshots])
        low, high = places.min(axis=0), places.max(axis=0)
        wide, tall, _ = high - low
        aspect = float(np.clip(wide / max(tall, 1e-9 * wide), *ASPECT))
        height = min(box[1], box[0] / aspect)
        pixels = round(dots * height * aspect), round(dots * height)
        x, y, z = ((low + high) / 2) @ axes
        up = axes[1] if abs(axes[2, 2]) >= 0.9999 else np.array([0.0, 0.0, 1.0])
        return View(tuple(axes[2]), (x, y, z), VIEW_MARGIN * max(tall, wide / aspect), pixels, tuple(up))

    def images(self, snapshots: Sequence[DrawnBody], view: View) -> list[Pixels]:
        """What is seen at these times, each (rows, columns, 3)."""
        return render([Picture(view, body(snapshot, self.shown, True)) for snapshot in snapshots])

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
        found = ["; ".join(first)]
        if self.whole.is_turned:
            found.append(f"Solved with the kinematics {scene.model.kinematics!r}, shown as the whole body.")
        if self.has_chains:
            found.append("Black: the four chains of each element's mean cell, deformed, projected on its face.")
        if not self.is_deformed:
            found.append("Displacements were not recorded: this is the reference body.")
        return found


if __name__ == "__main__":
    main(sys.argv[1])
