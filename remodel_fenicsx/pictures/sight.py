"""What of a run's body is seen, at which times and from where."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.pictures.bodies import ANGLE, OF_RIBBONS, SHOWN_FIELDS, DrawnBody, body
from remodel_fenicsx.pictures.rendering import Picture, Pixels, View, render
from remodel_fenicsx.results.drawing import VIEWS
from remodel_fenicsx.results.recording import HistoryColumns, RecordedRun
from remodel_fenicsx.results.whole_body import WholeBody, has_a_body
from remodel_fenicsx.results.words import unit_of, with_unit, words
from remodel_fenicsx.schema.times import same_time
from remodel_fenicsx.studies.page import FigureError

Numbers = NDArray[np.float64]

CUTS = ("half", "quarter")
CUT_IN_WORDS = {"half": "the half in front cut off", "quarter": "the quarter in front cut off"}
VIEW_MARGIN = 1.05  # of what is seen over the body's size
ASPECT = (0.28, 2.2)  # least and largest width over height of a view


@dataclass(frozen=True)
class Viewing:
    """How a body is looked at.

    Attributes
    ----------
    layers
        How many are shown, from the inside of a tube and from the bottom of other bodies; None: all.
    cut
        One of `CUTS`, or None: elements whose centre lies in front of the middle are left out, or only those of them
        to the right.
    view
        "front", "above" or X,Y,Z: where the eye is, from the middle of the body.
    """

    layers: int | None = None
    cut: str | None = None
    view: str = "front"

    @property
    def direction(self) -> tuple[float, float, float]:
        """Towards the eye.

        Raises
        ------
        FigureError
            If the view is none.
        """
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
    """Which elements are neither peeled nor cut off, (elements,).

    Raises
    ------
    FigureError
        If there are no such layers, or nothing to cut off, with exit code 2.
    """
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
    """A run's body and what of it is seen.

    Parameters
    ----------
    recording
        The run, finished or not.
    viewing
        How it is looked at.

    Attributes
    ----------
    shown
        Which elements, (elements,).

    Raises
    ------
    FigureError
        If nothing of the kind can be drawn, with exit code 2.
    RecordingError
        If the folder is damaged.
    """

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
        """The recorded times nearest to these, each once; the last one where none are wanted.

        Raises
        ------
        FigureError
            If one lies outside of what is recorded, with exit code 2.
        """
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
        """What is seen at these times, each (rows, columns, 3).

        Raises
        ------
        FigureError
            If nothing can be drawn, with exit code 5.
        """
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
