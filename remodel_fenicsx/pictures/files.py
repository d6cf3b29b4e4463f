"""Pictures and animations as files: of which kind, under which name; nothing is ever overwritten."""

from __future__ import annotations

import io
import itertools
import os
import shutil
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image, features

from remodel_fenicsx._version import __version__
from remodel_fenicsx.pictures.bodies import Pixels, Sight, Viewing, scale_colours
from remodel_fenicsx.pictures.sheet import ONE, SEVERAL, Sheet
from remodel_fenicsx.results.recording import RecordedRun, kept_times
from remodel_fenicsx.studies.page import DOTS_PER_INCH, STYLE, About, FigureError, Palette, as_file
from remodel_fenicsx.system.files import write_new
from remodel_fenicsx.system.temporary import temporary_folder

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
    snapshots = sight.snapshots(shown)
    view = sight.view(snapshots, SEVERAL if len(shown) > 1 else ONE, dots)
    images = sight.images(snapshots, view)
    with matplotlib.rc_context(STYLE):
        sheet = Sheet(sight, shown, images, view, dots, has_clock=False)
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
    encode = _encoder(ending)
    sight = Sight(RecordedRun(folder), viewing or Viewing())
    if len(sight.recording.times) < FEWEST_FRAMES:
        raise FigureError(f"{sight.recording.path}: fields of one time alone are recorded, so nothing moves", 2)
    times = [float(time) for time in kept_times(sight.history, sight.recording.times, frames)]
    snapshots = sight.snapshots(times)
    view = sight.view(snapshots, ONE, FRAME_DOTS)
    images = sight.images(snapshots, view)
    with matplotlib.rc_context(STYLE):
        drawn = _drawn(Sheet(sight, times[:1], images[:1], view, FRAME_DOTS, has_clock=True), times, images)
    return _write(path, sight, [times[0], times[-1]], ending, encode(drawn, _about(sight, "animate")))


def _drawn(sheet: Sheet, times: Sequence[float], images: Sequence[Pixels]) -> list[Image.Image]:
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


# ---------------------------------------------------------------- kinds of animations
Encoder = Callable[[list[Image.Image], About], bytes]


def _encoder(ending: str) -> Encoder:
    """The one for a kind of file."""
    if ending == ".mp4" and shutil.which("ffmpeg") is None:
        raise FigureError("mp4 needs ffmpeg, which is not there; .webp needs nothing", 5)
    if ending == ".webp" and not features.check("webp"):
        raise FigureError("webp needs a Pillow that writes it; .gif needs nothing", 5)
    return {".gif": _gif, ".webp": _webp, ".mp4": _mp4}[ending]


def _durations(frames: list[Image.Image]) -> list[int]:
    return [FRAME_TIME] * (len(frames) - 1) + [LAST_TIME]


def _gif(frames: list[Image.Image], about: About) -> bytes:
    """The colours of the scale are kept as they are."""
    palette = Palette(_side_by_side([frames[0], frames[len(frames) // 2], frames[-1]]), scale_colours())
    first, *others = [palette(frame) for frame in frames]
    comment = f"{about.comment}; {about.made_by}".encode()
    return _saved(first, others, "GIF", duration=_durations(frames), comment=comment)


def _side_by_side(frames: Sequence[Image.Image]) -> Image.Image:
    return Image.fromarray(np.concatenate([np.asarray(frame) for frame in frames], axis=1))


def _webp(frames: list[Image.Image], about: About) -> bytes:
    first, *others = frames
    return _saved(first, others, "WEBP", duration=_durations(frames), quality=90, method=4)


def _saved(first: Image.Image, others: list[Image.Image], kind: str, **how: Any) -> bytes:
    file = io.BytesIO()
    first.save(file, kind, save_all=True, append_images=others, loop=0, **how)
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
            said = (done.stderr.decode(errors="replace").strip().splitlines() or ["it said nothing"])[-1]
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
        raise _taken(path)
    if not path.parent.is_dir():
        raise FigureError(f"path {path}: there is no folder {path.parent}", 2)


def _taken(path: Path) -> FigureError:
    return FigureError(f"path {path}: is there already; allowed is a new file", 2)


def _write(path: Path | None, sight: Sight, times: Sequence[float], ending: str, data: bytes) -> Path:
    if path is not None:
        try:
            write_new(path, data)
        except FileExistsError:
            raise _taken(path) from None
        return path
    ends = dict.fromkeys([times[0], times[-1]])
    stem = "-".join([sight.recording.scene.name, *(f"t{time:g}" for time in ends)])
    for number in itertools.count(1):
        free = sight.recording.path / f"{stem}{f'-{number}' if number > 1 else ''}{ending}"
        try:
            write_new(free, data)
            return free
        except FileExistsError:
            continue
    raise AssertionError("numbers do not end")
