"""Pictures and animations as files: sheets of bodies at some times, with scale and axes; nothing is overwritten."""

from __future__ import annotations

import io
import itertools
import math
import os
import shutil
import subprocess
import textwrap
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.text import Text
from PIL import Image, features

from remodel_fenicsx._version import __version__
from remodel_fenicsx.pictures.bodies import Pixels, Sight, View, Viewing, angle_scale, render, scale_colours
from remodel_fenicsx.results.recording import RecordedRun, kept_times
from remodel_fenicsx.studies.page import DOTS_PER_INCH, STYLE, About, FigureError, Palette, as_file
from remodel_fenicsx.system.children import last_line
from remodel_fenicsx.system.files import TakenError, temporary_folder, write_new

PICTURES, ANIMATIONS = (".png", ".svg", ".pdf"), (".gif", ".webp", ".mp4")
MOST_PANELS = 12
FRAMES, FEWEST_FRAMES, MOST_FRAMES = 60, 2, 500  # by default; an animation of one is a picture; all are in memory
FRAME_DOTS = 120  # an inch
FRAME_TIME, LAST_TIME = 80, 1600  # ms that a frame stands; multiples of 10, as GIF counts


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
    ending = path.suffix.lower() if path else ".png"
    dots = DOTS_PER_INCH[ending[1:]]
    grids = sight.grids(shown)
    view = sight.view(grids, SEVERAL if len(shown) > 1 else ONE, dots)
    images = render(grids, view)
    with matplotlib.rc_context(STYLE):
        sheet = Leaf(sight, shown, images, view, dots, has_clock=False)
        data = as_file(sheet.figure, ending[1:], _about(sight, "picture"), scale_colours())
    return _write(path, sight, shown, ending, data)


def draw_animation(
    folder: str | os.PathLike[str], frames: int = FRAMES, viewing: Viewing | None = None, path: Path | None = None
) -> Path:
    """Draw the body of a run as it moves through time."""
    _check_new(path, ANIMATIONS)
    if not FEWEST_FRAMES <= frames <= MOST_FRAMES:
        raise FigureError(f"--frames {frames}: allowed is a whole number from {FEWEST_FRAMES} to {MOST_FRAMES}", 2)
    ending = path.suffix.lower() if path else ".gif"
    _check_encoder(ending)
    sight = Sight(RecordedRun(folder), viewing or Viewing())
    if len(sight.recording.times) < FEWEST_FRAMES:
        raise FigureError(f"{sight.recording.path}: fields of one time alone are recorded, so nothing moves", 2)
    times = [float(time) for time in kept_times(sight.history, sight.recording.times, frames)]
    grids = sight.grids(times)
    view = sight.view(grids, ONE, FRAME_DOTS)
    images = render(grids, view)
    with matplotlib.rc_context(STYLE):
        drawn = _drawn(Leaf(sight, times[:1], images[:1], view, FRAME_DOTS, has_clock=True), times, images)
    return _write(path, sight, [times[0], times[-1]], ending, _encoded(drawn, _about(sight, "animate"), ending))


def _drawn(sheet: Leaf, times: Sequence[float], images: Sequence[Pixels]) -> list[Image.Image]:
    canvas, found = FigureCanvasAgg(sheet.figure), []
    for number, (time, image) in enumerate(zip(times, images, strict=True)):
        sheet.show(time, image, number / (len(times) - 1))
        canvas.draw()
        found.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()))
    return found


def _about(sight: Sight, command: str) -> About:
    """What stands in the file."""
    scene, versions = sight.recording.scene, sight.recording.versions
    made_with = "; ".join(f"{name} {version}" for name, version in versions.items())
    title, caption = f"{scene.name}: angle of the collagen", " ".join(sight.notes())
    return About(f"remodel_fenicsx {__version__}", title, caption, made_with, f"remodel-fenicsx {command}")


# ---------------------------------------------------------------- a sheet with a body at one or several times
# All letters, the scale and the axes stand outside of the body.

# inches
ONE, SEVERAL = (5.0, 4.4), (2.5, 3.0)  # room for a body alone, and for each of several
NARROWEST, WIDEST = 4.4, 9.0  # sheets
NARROWEST_PANEL = 1.25  # its letters want that
HEAD, PANEL_TITLE, LOAD_LINE, FOOT, NOTE_LINE, EDGE = 0.34, 0.22, 0.14, 0.68, 0.125, 0.08
LETTER, NOTE_LETTER = 0.092, 0.049  # mean width in the head and in the notes
TRIAD = 0.17  # length of an axis that is seen from the side


class Leaf:
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
        head = textwrap.shorten(sight.recording.scene.name, max(8, int(self.width / LETTER)), placeholder=" …")
        self._write(self.width / 2, self.height - 0.22, head, 10, fontweight="bold")
        margin = (self.width - columns * cell) / 2
        self.panels = [
            self._panel(image, margin + (number % columns + 0.5) * cell, HEAD + number // columns * row)
            for number, image in enumerate(images)
        ]
        for number, time in enumerate(times):
            self._label(number, time)
        bottom = EDGE + NOTE_LINE * len(notes)
        self._foot(view, bottom)
        for number, note in enumerate(notes):
            self._write(self.width / 2, bottom - NOTE_LINE * (number + 0.8), note, 6.5, color="0.35")
        self.clock: Line2D | None = None
        if has_clock:
            start, end, y = 0.24 * self.width, 0.80 * self.width, bottom + FOOT
            self._line((start, end), (y, y), "0.85", 1.5)
            self.clock = self._line((start, start), (y, y), "0.2", 1.5)

    def _write(self, x: float, y: float, text: str, size: float, **how: Any) -> Text:
        """Letters with their middle at a place in inches from the left and from the bottom."""
        how = {"ha": "center", "parse_math": False, **how}
        return self.figure.text(x / self.width, y / self.height, text, fontsize=size, **how)

    def _line(self, x: Sequence[float], y: Sequence[float], colour: str, wide: float, **how: Any) -> Line2D:
        line = Line2D(np.divide(x, self.width), np.divide(y, self.height), color=colour, lw=wide, **how)
        self.figure.add_artist(line)
        return line

    def _panel(self, image: Pixels, middle: float, top: float) -> tuple[AxesImage, Text, Text]:
        """A body with its middle at, and its title below, places in inches from the left and from the top."""
        wide, tall = self.panel
        bottom = self.height - top - PANEL_TITLE - tall
        place = ((middle - wide / 2) / self.width, bottom / self.height, wide / self.width, tall / self.height)
        axes: Axes = self.figure.add_axes(place)
        axes.set_axis_off()
        shown = axes.imshow(image, interpolation="nearest", aspect="auto")
        title = self._write(middle, bottom + tall + 0.06, "", 9, parse_math=True)
        return shown, title, self._write(middle, bottom - 0.03, "", 7.5, color="0.25", va="top")

    def _label(self, number: int, time: float) -> None:
        _, title, loads = self.panels[number]
        title.set_text(f"$t$ = {time:g}")
        loads.set_text(("\n" if self.stacked else ",  ").join(self.sight.loads(time)))

    def _foot(self, view: View, bottom: float) -> None:
        """Scale of the angles in the middle, a length to its left, the axes to its right."""
        geometry = self.sight.recording.scene.geometry
        along, across = geometry.angle_in_words
        place = (0.24, (bottom + 0.42) / self.height, 0.56, 0.1 / self.height)
        angle_scale(self.figure, place, f"angle of the collagen, deformed: 0° {along}, 90° {across}")
        inches = view.pixels[1] / self.figure.dpi / view.height  # of a unit of length
        most = 0.13 * self.width / inches
        power = 10.0 ** math.floor(math.log10(most))
        length = power * next(factor for factor in (5, 2, 1) if factor * power <= most * (1 + 1e-9))
        start, y = 0.035 * self.width, bottom + 0.47
        end = start + length * inches
        self._line((start, end), (y, y), "0.2", 1.6, solid_capstyle="butt")
        label = f"{length:g} {geometry.length_unit}" if geometry.length_unit else f"length {length:g}"
        self._write((start + end) / 2, y - 0.06, label, 7.5, va="top")
        x, y, (right, up, _) = 0.895 * self.width, bottom + 0.38, TRIAD * self.sight.axes()
        for name, wide, tall in zip("xyz", right, up, strict=True):
            self._line((x, x + wide), (y, y + tall), "0.2", 1.0)
            if math.hypot(wide, tall) > 0.15 * TRIAD:
                self._write(x + 1.55 * wide, y + 1.55 * tall, name, 7.5, va="center")

    def show(self, time: float, image: Pixels, share: float) -> None:
        """Another time in the first panel; `share` is how far it is through the animation."""
        self.panels[0][0].set_data(image)
        self._label(0, time)
        if self.clock is not None:
            self.clock.set_xdata((0.24, 0.24 + 0.56 * share))


# ---------------------------------------------------------------- kinds of animations
def _check_encoder(ending: str) -> None:
    """Before anything is drawn."""
    if ending == ".mp4" and shutil.which("ffmpeg") is None:
        raise FigureError("mp4 needs ffmpeg, which is not there; .webp needs nothing", 5)
    if ending == ".webp" and not features.check("webp"):
        raise FigureError("webp needs a Pillow that writes it; .gif needs nothing", 5)


def _encoded(frames: list[Image.Image], about: About, ending: str) -> bytes:
    """As a file; a GIF keeps the colours of the scale as they are."""
    if ending == ".mp4":
        return _mp4(frames, about)
    how: dict[str, Any] = {"quality": 90, "method": 4}
    if ending == ".gif":
        some = np.concatenate([np.asarray(frames[k]) for k in (0, len(frames) // 2, -1)], axis=1)
        palette = Palette(Image.fromarray(some), scale_colours())
        frames = [palette(frame) for frame in frames]
        how = {"comment": f"{about.comment}; {about.made_by}".encode()}
    file, durations = io.BytesIO(), [FRAME_TIME] * (len(frames) - 1) + [LAST_TIME]
    kept: dict[str, Any] = {"save_all": True, "append_images": frames[1:], "loop": 0, "duration": durations}
    frames[0].save(file, ending[1:], **kept, **how)
    return file.getvalue()


def _mp4(frames: list[Image.Image], about: About) -> bytes:
    last = [frames[-1]] * (LAST_TIME // FRAME_TIME - 1)
    wide, tall = (size - size % 2 for size in frames[0].size)  # H.264 wants even ones
    pixels = b"".join(frame.crop((0, 0, wide, tall)).tobytes() for frame in frames + last)
    with temporary_folder() as folder:
        given = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{wide}x{tall}", "-r", f"{1000 / FRAME_TIME:g}"]
        wanted = ["-pix_fmt", "yuv420p", "-movflags", "+faststart", "-metadata", f"comment={about.comment}", "film.mp4"]
        command = ["ffmpeg", "-v", "error", *given, "-i", "-", *wanted]
        done = subprocess.run(command, input=pixels, capture_output=True, cwd=folder)
        film = folder / "film.mp4"
        if done.returncode != 0 or not film.exists():
            said = last_line(done.stderr.decode(errors="replace"))
            raise FigureError(f"ffmpeg ended with {done.returncode}: {said}; .webp needs nothing", 5)
        return film.read_bytes()


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


def _write(path: Path | None, sight: Sight, times: Sequence[float], ending: str, data: bytes) -> Path:
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
