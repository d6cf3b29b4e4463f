"""Sheets of pictures: bodies in PyVista with scales, times and captions."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import Any, TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.text import Text
from numpy.typing import NDArray

from remodel_fenicsx.pictures.bodies import (
    DrawnBody,
    OF_RIBBONS,
    Pixels,
    Sight,
    View,
    Viewing,
    add_patches,
    angle_scale,
    chains,
    outer_faces,
    scale,
    shown_elements,
)
from remodel_fenicsx.results.recording import AMBIENT, LEVELS, RecordedRun, RecordingError
from remodel_fenicsx.results.whole_body import WholeBody, has_a_body

if TYPE_CHECKING:
    import pyvista


# ---------------------------------------------------------------- the body of a run in PyVista
# The body of a run in PyVista: a grid with its fields, and a plotter with the colours and chains of all pictures.

ANGLES = ("fibre_angle", "fibre_angle_deformed")  # fields in degrees, from 0 to 90


def grid(recording: RecordedRun, time: float) -> pyvista.UnstructuredGrid:
    """The whole reference body with the fields of a recorded time; parameters and errors as of `Recording.grid`."""
    whole = _whole(recording)
    return _grid(whole, time, np.ones(len(whole.elements), dtype=bool))


def plot(
    recording: RecordedRun, time: float, name: str, viewing: Viewing, with_chains: bool,
    plotter: pyvista.Plotter | None, options: dict[str, Any],
) -> pyvista.Plotter:  # fmt: skip
    """Put a body into a plotter; parameters and errors as of `Recording.plot`."""
    import pyvista

    whole = _whole(recording)
    shown = shown_elements(whole, viewing)
    found = _grid(whole, time, shown)
    if name not in found.cell_data:
        raise RecordingError(f"{recording.path}: no field {name!r} of elements; there are {', '.join(found.cell_data)}")
    if plotter is None:
        plotter = pyvista.Plotter(lighting="none")
        plotter.background_color = "white"
        plotter.add_light(pyvista.Light(light_type="headlight", intensity=1.0))
    is_deformed = "displacement" in found.point_data
    body = found.warp_by_vector("displacement") if is_deformed else found
    plotter.add_mesh(body, **{**_looks(name), **options})
    snapshot = DrawnBody.at(whole, time)
    if with_chains and is_deformed and set(OF_RIBBONS) <= set(snapshot.fields):
        faces, elements, _ = outer_faces(snapshot, shown)
        add_patches(plotter, [chains(snapshot, faces, elements)], None)
    return plotter


def _looks(name: str) -> dict[str, Any]:
    """How `add_mesh` draws a body that is coloured by this field."""
    found = {"scalars": name, "show_edges": True, "edge_color": "#777777", "ambient": AMBIENT, "diffuse": 1 - AMBIENT}
    if name in ANGLES:
        found |= {"cmap": scale()[0], "clim": (0.0, 90.0), "n_colors": LEVELS}
    return found


def _whole(recording: RecordedRun) -> WholeBody:
    if not has_a_body(recording):
        raise RecordingError(f"{recording.path}: the run recorded no fields of a body (output.fields)")
    return WholeBody(recording)


def _grid(whole: WholeBody, time: float, shown: NDArray[np.bool_]) -> pyvista.UnstructuredGrid:
    """Of the elements that are shown."""
    import pyvista

    displacement, fields = whole.fields(time)
    kind = {8: pyvista.CellType.HEXAHEDRON, 4: pyvista.CellType.TETRA}[whole.elements.shape[1]]
    found = pyvista.UnstructuredGrid({kind: whole.elements[shown]}, whole.points)
    if displacement is not None:
        found.point_data["displacement"] = displacement
    for name, values in {"layer": whole.layer, **fields}.items():
        found.cell_data[name] = values[shown]
    return found


# ---------------------------------------------------------------- a sheet with a body at one or several times
# A sheet with a body at one or several times: all letters, the scale and the axes stand outside of the body.

# inches
ONE, SEVERAL = (5.0, 4.4), (2.5, 3.0)  # room for a body alone, and for each of several
NARROWEST, WIDEST = 4.4, 9.0  # sheets
NARROWEST_PANEL = 1.25  # its letters want that
HEAD, PANEL_TITLE, LOAD_LINE, FOOT, NOTE_LINE, EDGE = 0.34, 0.22, 0.14, 0.68, 0.125, 0.08
LETTER, NOTE_LETTER = 0.092, 0.049  # mean width in the head and in the notes
TRIAD = 0.17  # length of an axis that is seen from the side


class Sheet:
    """A figure with one panel for each time."""

    def __init__(
        self, sight: Sight, times: Sequence[float], images: Sequence[Pixels], view: View, dots: float, has_clock: bool
    ):
        self.sight = sight
        self.panel = view.pixels[0] / dots, view.pixels[1] / dots
        cell = max(self.panel[0], NARROWEST_PANEL) + EDGE
        columns = max(1, min(len(times), int(WIDEST / cell)))
        rows = math.ceil(len(times) / columns)
        self.width = max(columns * cell, NARROWEST)
        notes = [line for note in sight.notes() for line in textwrap.wrap(note, int(self.width / NOTE_LETTER))]
        self.stacked = len(times) > 1
        loads = LOAD_LINE * (len(sight.recording.scene.loads) if self.stacked else 1)
        row = PANEL_TITLE + self.panel[1] + loads + 0.06
        self.height = HEAD + rows * row + FOOT + NOTE_LINE * len(notes) + EDGE
        self.figure = Figure(figsize=(self.width, self.height), dpi=dots)
        self._head()
        margin = (self.width - columns * cell) / 2
        self.panels = [
            self._panel(image, margin + (number % columns + 0.5) * cell, HEAD + number // columns * row)
            for number, image in enumerate(images)
        ]
        for number, time in enumerate(times):
            self._label(number, time)
        self._foot(view, NOTE_LINE * len(notes) + EDGE)
        for number, note in enumerate(notes):
            y = (EDGE + NOTE_LINE * (len(notes) - number - 0.8)) / self.height
            self.figure.text(0.5, y, note, fontsize=6.5, color="0.35", ha="center", parse_math=False)
        self.clock = self._clock(NOTE_LINE * len(notes) + EDGE + FOOT) if has_clock else None

    def _head(self) -> None:
        title = textwrap.shorten(self.sight.recording.scene.name, max(8, int(self.width / LETTER)), placeholder=" …")
        self.figure.text(0.5, 1 - 0.22 / self.height, title, fontsize=10, fontweight="bold", ha="center",
                         parse_math=False)  # fmt: skip

    def _panel(self, image: Pixels, middle: float, top: float) -> tuple[AxesImage, Text, Text]:
        """A body with its middle at, and its title below, places in inches from the left and from the top."""
        wide, tall = self.panel
        bottom = self.height - top - PANEL_TITLE - tall
        place = ((middle - wide / 2) / self.width, bottom / self.height, wide / self.width, tall / self.height)
        axes: Axes = self.figure.add_axes(place)
        axes.set_axis_off()
        shown = axes.imshow(image, interpolation="nearest", aspect="auto")
        title = self.figure.text(middle / self.width, (bottom + tall + 0.06) / self.height, "", fontsize=9, ha="center")
        loads = self.figure.text(middle / self.width, (bottom - 0.03) / self.height, "", fontsize=7.5, color="0.25",
                                 ha="center", va="top", parse_math=False)  # fmt: skip
        return shown, title, loads

    def _label(self, number: int, time: float) -> None:
        _, title, loads = self.panels[number]
        title.set_text(f"$t$ = {time:g}")
        loads.set_text(("\n" if self.stacked else ",  ").join(self.sight.loads(time)))

    def _foot(self, view: View, bottom: float) -> None:
        """Scale of the angles in the middle, a length to its left, the axes to its right."""
        along, across = self.sight.recording.scene.geometry.angle_in_words
        place = (0.24, (bottom + 0.42) / self.height, 0.56, 0.1 / self.height)
        angle_scale(self.figure, place, f"angle of the collagen, deformed: 0° {along}, 90° {across}")
        inches = view.pixels[1] / self.figure.dpi / view.height  # of a unit of length
        length = _round_length(0.13 * self.width / inches)
        start, y = 0.035, (bottom + 0.47) / self.height
        end = start + length * inches / self.width
        self.figure.add_artist(Line2D((start, end), (y, y), color="0.2", lw=1.6, solid_capstyle="butt"))
        unit = self.sight.recording.scene.geometry.length_unit
        label = f"{length:g} {unit}" if unit else f"length {length:g}"
        self.figure.text((start + end) / 2, y - 0.06 / self.height, label, fontsize=7.5, ha="center", va="top")
        self._triad(0.895 * self.width, bottom + 0.38)

    def _triad(self, x: float, y: float) -> None:
        right, up, _ = self.sight.axes()
        for name, across, along in zip("xyz", right, up, strict=True):
            ends = (x, x + TRIAD * across), (y, y + TRIAD * along)
            line = np.array(ends) / np.array([[self.width], [self.height]])
            self.figure.add_artist(Line2D(*line, color="0.2", lw=1.0))
            if math.hypot(across, along) > 0.15:
                tip = (x + 1.55 * TRIAD * across) / self.width, (y + 1.55 * TRIAD * along) / self.height
                self.figure.text(*tip, name, fontsize=7.5, ha="center", va="center")

    def _clock(self, bottom: float) -> Line2D:
        y = bottom / self.height
        self.figure.add_artist(Line2D((0.24, 0.80), (y, y), color="0.85", lw=1.5))
        line = Line2D((0.24, 0.24), (y, y), color="0.2", lw=1.5)
        self.figure.add_artist(line)
        return line

    def show(self, time: float, image: Pixels, share: float) -> None:
        """Another time in the first panel; `share` is how far it is through the animation."""
        self.panels[0][0].set_data(image)
        self._label(0, time)
        if self.clock is not None:
            self.clock.set_xdata((0.24, 0.24 + 0.56 * share))


def _round_length(most: float) -> float:
    """The largest of 1, 2, 5, 10, ... that is not longer."""
    power = 10.0 ** math.floor(math.log10(most))
    return power * next(factor for factor in (5, 2, 1) if factor * power <= most * (1 + 1e-9))
