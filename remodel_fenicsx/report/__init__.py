"""Report of a run: one page for a browser that needs no network, with results and the body in 3D.

`write_report` makes it from a run's folder alone, without dolfinx. A page is a list of parts,
`PAGE_PARTS`. Each part returns a card or None. A card has HTML, and data and arrays for the scripts
in `assets/`, which read them under the card's name.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import os
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from itertools import compress
from pathlib import Path
from string import Template
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from remodel_fenicsx._version import __version__
from remodel_fenicsx.body.shape import Column, columns_of_region
from remodel_fenicsx.body.wall import Walled
from remodel_fenicsx.errors import RemodelError
from remodel_fenicsx.model.axes import GROWTH, push_forward_axes
from remodel_fenicsx.results.recording import (
    AMBIENT,
    ANGLE_COLOURS,
    CHAIN_LOOK,
    HISTORY,
    LARGEST_HISTORY,
    RecordedRun,
    SCENE,
    VIEWS,
    kept_times,
    unit_of,
    with_unit,
    words,
)
from remodel_fenicsx.results.status import OVERRIDE, log_entries, state_of
from remodel_fenicsx.results.whole_body import (
    AXIS_FIELDS,
    axes_of,
    DIRECTION_FIELDS,
    SECTORS,
    TENSOR_FIELDS,
    WholeBody,
    has_a_body,
)
from remodel_fenicsx.scene.presets import profile_for
from remodel_fenicsx.scene.scene import leaves, preset_scene
from remodel_fenicsx.schema.settings import STRESS_FIELDS
from remodel_fenicsx.system.files import read_regular, write_new, write_whole
from remodel_fenicsx.system.terminal import duration


Places = NDArray[np.float64]


# ---------------------------------------------------------------- arrays as text of a page
# All arrays are one compressed block in base64. Numbers are rounded to few bytes.

# Levels of a byte for 0 to 90 degrees: 14 for each of the 18 colours, so that rounding keeps the
# colour.
ANGLE_STEPS = 252
NO_ANGLE = 255


def pack_arrays(arrays: Mapping[str, Array]) -> tuple[str, dict[str, dict[str, object]]]:
    """Return the block of arrays, and type, shape and position of each array in it."""
    block, table = bytearray(), {}
    for name, array in arrays.items():
        values = np.ascontiguousarray(array.values)
        # Differences are modulo the range of the type.
        stored = (
            np.diff(values, axis=0, prepend=np.zeros_like(values[:1]))
            if array.differences
            else values
        )
        table[name] = {
            "type": values.dtype.name,
            "shape": list(values.shape),
            "start": len(block),
            "differences": array.differences,
        }
        block += stored.astype(values.dtype.newbyteorder("<")).tobytes()
        block += bytes(-len(block) % 4)  # typed arrays start at multiples of their size
    # Level 6 is 5 % smaller and takes twice as long.
    return base64.b64encode(gzip.compress(bytes(block), 3, mtime=0)).decode("ascii"), table


# ---------------------------------------------------------------- parts of the page, and their HTML
# All text from files goes through `escape`.


class Array(NamedTuple):
    """An array that the page unpacks into a typed array."""

    values: NDArray[np.generic]
    differences: bool = False


class Card(NamedTuple):
    """A part of the page: HTML, and data and arrays for `assets/drawn.html` and the scripts."""

    name: str
    html: str = ""
    data: Mapping[str, object] = MappingProxyType({})
    arrays: Mapping[str, Array] = MappingProxyType({})


def section(title: str, content: str) -> str:
    """Return a card with a heading; `content` is HTML."""
    return f'<section class="card half"><h2>{escape(title)}</h2>{content}</section>'


def collapsed_section(title: str, content: str) -> str:
    """Return a card that is collapsed until a reader opens it; `content` is HTML."""
    return f'<details class="card half"><summary>{escape(title)}</summary>{content}</details>'


def table(rows: Iterable[tuple[str, str]]) -> str:
    """Return an HTML table of names and values."""
    cells = "".join(
        f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in rows
    )
    return f"<table>{cells}</table>"


# ---------------------------------------------------------------- the body at the times of a page

CELL = ("cell_dimensions", *AXIS_FIELDS)
NAMES = (
    *("displacement", "deformation_gradient", "fibre_angle_deformed", "chain_extension"),
    *(*CELL, *STRESS_FIELDS),
)
TURNOVER_FIELDS = ("content", GROWTH)
WALL_FIELDS = ("cauchy_stress", "station", *DIRECTION_FIELDS, *TURNOVER_FIELDS)


@dataclass(frozen=True)
class ShownBody:
    """A body at some recorded times, with the fields that the page shows."""

    whole: WholeBody
    times: Places
    # `position`, and recorded fields from `_of_elements` and `_of_layers`.
    series: dict[str, NDArray[np.float32]]
    is_deformed: bool

    @classmethod
    def from_run(cls, whole: WholeBody, times: Places) -> ShownBody:
        """Read the fields that a run has recorded at these times."""
        names = (
            *NAMES,
            *(WALL_FIELDS if isinstance(whole.recording.scene.geometry, Walled) else ()),
        )
        rows = defaultdict[str, list[NDArray[np.float32]]](list)
        is_deformed = True
        for time in times:
            displacement, fields = whole.fields(float(time), names)
            is_deformed = displacement is not None
            moved = 0.0 if displacement is None else displacement
            rows["position"].append((whole.points + moved).astype(np.float32))
            for name, values in (_of_elements(fields) | _of_layers(whole, fields)).items():
                rows[name].append(values.astype(np.float32))
        return cls(
            whole,
            times,
            {name: np.stack(values) for name, values in rows.items()},
            is_deformed,
        )

    def arrays(self) -> tuple[dict[str, Array], dict[str, object]]:
        """Return the arrays rounded to few bytes, and the scales that restore their values."""
        moved = self.series["position"]
        least = moved.min(axis=(0, 1))
        step = float((moved.max(axis=(0, 1)) - least).max() / 65535) or 1.0
        position = np.rint((moved - least) / step).astype(np.uint16)
        size = np.uint16 if len(self.whole.points) <= 65536 else np.uint32
        arrays = {
            "elements": Array(self.whole.elements.astype(size)),
            "layer": Array(self.whole.layer.astype(np.uint8)),
            "volume": Array(self.whole.volume.astype(np.float32)),
            "reference": Array(self.whole.points.astype(np.float32)),
            "position": Array(position, differences=True),
        }
        scales: dict[str, Any] = {"origin": least.tolist(), "position_step": step}
        if "angle" in self.series:
            levels = np.clip(
                np.floor(self.series["angle"] * ANGLE_STEPS / 90.0), 0, ANGLE_STEPS - 1
            )
            levels = np.where(np.isnan(levels), NO_ANGLE, levels).astype(np.uint8)
            arrays["angle"] = Array(levels, differences=True)
        if "extension" in self.series:
            extension = np.rint(255 * self.series["extension"]).astype(np.uint8)
            arrays["extension"] = Array(extension, differences=True)
        for name in (one for one in STRESS_FIELDS if one in self.series):
            low, high = (float(bound(self.series[name])) for bound in (np.min, np.max))
            levels = 255 * (self.series[name] - low) / (high - low or 1.0)
            arrays[name], scales[name] = Array(np.rint(levels).astype(np.uint8), True), [low, high]
        if "edges" in self.series:
            edges = self.series["edges"].reshape(*moved.shape[:1], -1, 9)
            # Components are integers; 127 is the largest.
            scales["edge_step"] = float(np.abs(edges).max()) / 127 or 1.0
            arrays["edges"] = Array(
                np.rint(edges / scales["edge_step"]).astype(np.int8), differences=True
            )
        return arrays, scales


def _of_elements(fields: dict[str, Places]) -> dict[str, Places]:
    """Return the recorded element fields by the names of `ShownBody.series`."""
    names = {"angle": "fibre_angle_deformed", "extension": "chain_extension"}
    names |= {name: name for name in STRESS_FIELDS}
    series = {name: fields[field] for name, field in names.items() if field in fields}
    if set(CELL) <= set(fields):
        axes = axes_of(fields)
        if "deformation_gradient" in fields:
            axes = axes @ np.swapaxes(fields["deformation_gradient"].reshape(-1, 3, 3), 1, 2)
        series["edges"] = fields["cell_dimensions"][:, :, None] * axes
    return series


def _of_layers(whole: WholeBody, fields: dict[str, Places]) -> dict[str, Places]:
    """Return means by layer of recorded stress, also by sector, and of `TURNOVER_FIELDS`."""
    unknown = np.full(len(whole.volume), np.nan)
    turnover = [fields.get(name, unknown) for name in TURNOVER_FIELDS]
    series = {"content": whole.means(turnover)} if set(TURNOVER_FIELDS) & set(fields) else {}
    if {"hoop_stress", "station"} <= set(fields):
        series["sectors"] = whole.by_sector(fields["hoop_stress"], fields["station"])
    shape = whole.recording.scene.geometry
    # Axes that are no function of the coordinates are recorded.
    recorded = DIRECTION_FIELDS if shape.constant_fields else ()
    if not set(fields) >= {*TENSOR_FIELDS, *recorded}:
        return series
    if recorded:
        axes = np.stack([fields[name] for name in recorded], axis=1)
    else:
        axes = shape.axes_at(whole.centres)
    F, stress = (fields[name].reshape(-1, 3, 3) for name in TENSOR_FIELDS)
    moved = push_forward_axes(axes, F)
    return series | {"stress": whole.means([*np.einsum("nki,nij,nkj->kn", moved, stress, moved)])}


# ---------------------------------------------------------------- a run from its folder
# Its state, history and warnings.

UNLOADED_PREFIX = "unloaded: "  # prefix of lines in run.log
_RANKS = re.compile(r"scene .* on (\d+) ranks?, results in ")


ASSETS = Path(__file__).with_name("assets")
MOST_TILES = 8
NO_PHYSICS = ("format", "name", "preset", "profile", "output", "solver", "geometry.sha256")
MOST_ROWS = 2000  # largest number of rows of a curve, which has fewer pixels
LARGEST_DOWNLOAD = 20_000_000  # bytes: larger histories are not in the page


@dataclass(frozen=True)
class ReportedRun:
    """A run with everything that parts of the page use."""

    recording: RecordedRun
    body: ShownBody | None = None

    @cached_property
    def log(self) -> list[tuple[str, str, str]]:
        """Entries of run.log: time, level and text."""
        return log_entries(self.recording.path)

    @cached_property
    def warnings(self) -> dict[str, int]:
        """Warnings of run.log with their counts; those that differ only in numbers count as one."""
        first, counts = dict[str, str](), Counter[str]()
        for _, level, text in self.log:
            if level in ("WARNING", "ERROR", "CRITICAL"):
                counts[first.setdefault(re.sub(r"\d+", "0", text), text)] += 1
        return dict(counts)

    @cached_property
    def state(self) -> tuple[str, str]:
        """State of the run in one word, and the reason or the time reached."""
        scene, times = self.recording.scene, self.recording.history["time"]
        state, reason = state_of(self.recording)
        if state in ("finished", "failed"):
            return state, reason
        at = f"at t = {float(times[-1]) if len(times) else 0.0:g} of {scene.last_time:g}"
        if state == "running":
            of = f" of {scene.time.number_of_steps}" if scene.time.tolerance is None else ""
            return state, f"step {max(0, len(times) - 1)}{of}, {at}"
        return state, f"{at}: {reason}" if reason else f"{at}: it was killed, and logged no reason"

    @cached_property
    def known(self) -> dict[str, Column]:
        """Columns of the scene, by name."""
        return {column.name: column for column in self.recording.scene.columns()}

    @cached_property
    def columns(self) -> list[str]:
        """Names of the history's columns with a number, those of the shape first."""
        scene, history = self.recording.scene, self.recording.history
        own = {
            column.name
            for group in (scene.geometry.columns, *map(columns_of_region, scene.regions))
            for column in group
        }
        names = [name for name in history if name != "time" and np.isfinite(history[name]).any()]
        if "substeps" in names and np.nanmax(history["substeps"]) <= 1:
            names.remove("substeps")
        return sorted(names, key=lambda name: name not in own)

    def unit(self, name: str) -> str:
        """Return the unit of a column; empty if the scene sets none."""
        return unit_of(self.recording.scene, self.known[name].unit) if name in self.known else ""


Part = Callable[[ReportedRun], Card | None]


# ---------------------------------------------------------------- head of the page
def head(run: ReportedRun) -> Card:
    """Make the head of the page: name, state and dates of the run."""
    (state, why), name = run.state, run.recording.scene.name
    dates = " to ".join(dict.fromkeys(stamp for stamp, _, _ in (*run.log[:1], *run.log[-1:])))
    reason = f'<p class="reason">{escape(why)}</p>' if why else ""
    html = (
        f'<header class="whole"><h1>{escape(name)}</h1><span class="badge {state}">{state}</span>'
        f'<span class="note">{escape(dates)}</span>{reason}</header>'
    )
    return Card("head", html, {"name": name, "state": state})


def tiles(run: ReportedRun) -> Card | None:
    """Show the last and first values of the shape's columns and r/L."""
    history, shape = run.recording.history, run.recording.scene.geometry
    items: list[str] = []
    own = [column.name for column in shape.columns]
    for name in run.columns:
        values, unit = history[name][np.isfinite(history[name])], run.unit(name)
        if (
            name not in (*own, "max_chain_extension")
            or len(items) == MOST_TILES
            or not values.any()
        ):
            continue
        # Body and profile are deformed.
        reference = (
            " (reference)" if name.startswith("fibre_angle") and "deformed" not in name else ""
        )
        last, first = (escape(with_unit(float(values[index]), unit)) for index in (-1, 0))
        items.append(
            f'<div class="tile" title="{escape(run.known[name].meaning)}"><b>{last}</b>'
            f"<span>{escape(words(name))}{reference}</span>"
            f'<span class="note">from {first}</span></div>'
        )
    return Card("tiles", f'<div class="tiles whole">{"".join(items)}</div>') if items else None


# ---------------------------------------------------------------- the body
def drawn(run: ReportedRun) -> Card:
    """Add the HTML elements in which the scripts draw."""
    return Card("drawn", _asset("drawn.html"))


def view(run: ReportedRun) -> Card:
    """Show the body in 3D over time, with its controls."""
    body = run.body
    if body is None:
        return Card("no_view")
    arrays, scales = body.arrays()
    notes, shape = body.whole.notes(body.is_deformed), run.recording.scene.geometry
    stored, all_times = len(body.times), len(run.recording.times)
    if stored < all_times:
        notes.append(f"{stored} of {all_times} recorded times are stored here, to save space.")
    data = {
        **scales, "times": body.times.tolist(), "layers": len(body.whole.depth),
        "words": shape.angle_in_words, "colours": ANGLE_COLOURS, "ambient": AMBIENT, "views": VIEWS,
        "chain": CHAIN_LOOK, "notes": " ".join(notes),
        "unit": unit_of(run.recording.scene, "stress"),
        "least_extension": float(np.floor(20 * np.nanmin(body.series.get("extension", 0.0))) / 20),
    }  # fmt: skip
    return Card("view", data=data, arrays=arrays)


def angles(run: ReportedRun) -> Card | None:
    """Plot the fibre angle over the depth, and the distribution of collagen directions."""
    body, scene = run.body, run.recording.scene
    shape = scene.geometry
    if body is None or "angle" not in body.series:
        return None
    through, start, end = shape.depth_labels
    if not np.isfinite(run.recording.history.get("lumen_volume", np.zeros(1))).any():
        through = "through the body"  # The inner face encloses no lumen.
    along, across = shape.angle_in_words
    depths = [
        {"name": words(name), "from": a, "to": b}
        for name, (a, b) in shape.region_depths(scene.regions).items()
    ]
    data = {"title": f"Collagen angle {through}, deformed", "depth": body.whole.depth.tolist(),
            "along": along, "through": f"{through} (0 {start}, 1 {end})", "across": across,
            "colours": ANGLE_COLOURS, "regions": depths}  # fmt: skip
    return Card("angles", data=data)


def stress(run: ReportedRun) -> Card | None:
    """Plot stress through the wall, and the circumferential mean by the law of Laplace."""
    history, unit = run.recording.history, unit_of(run.recording.scene, "stress")
    level = None
    legend, name = "Means of layers, in axes that move with the wall.", "Cauchy stress"
    if {"pressure", "inner_radius", "outer_radius"} <= set(history):
        inner, outer = history["inner_radius"], history["outer_radius"]
        level = history["pressure"] * inner / (outer - inner)
        legend += " Dashed: p r_i / h, by the law of Laplace the mean around."
    label = ", ".join(filter(None, (name, unit)))
    return _by_layer(
        run,
        "stress",
        ("around", "along", "across"),
        label,
        level,
        title=name,
        unit=unit,
        legend=legend,
    )


def sectors(run: ReportedRun) -> Card | None:
    """Plot hoop stress through the wall in sectors of a vessel's length."""
    unit = unit_of(run.recording.scene, "stress")
    names, label = [f"{k + 1} of {SECTORS}" for k in range(SECTORS)], f"hoop stress {unit}"
    return _by_layer(
        run,
        "sectors",
        names,
        label,
        unit=unit,
        title="Hoop stress by sector",
        legend="Means of layers in sectors of the length; 1 is at the inlet.",
    )


def content(run: ReportedRun) -> Card | None:
    """Plot content and growth of the collagen through the wall, if they were recorded."""
    return _by_layer(run, "content", TURNOVER_FIELDS, "over the start")


def _by_layer(
    run: ReportedRun,
    name: str,
    names: Sequence[str],
    label: str,
    level: Places | None = None,
    **texts: str,
) -> Card | None:
    """Plot a series of `ShownBody` over the depth, with a dashed level over time."""
    body = run.body
    if body is None or name not in body.series or len(body.whole.depth) < 2:
        return None
    recording = run.recording
    shape = recording.scene.geometry
    through, start, end = shape.depth_labels
    known = np.any(np.isfinite(body.series[name]), axis=(0, 1)).tolist()
    names = [*compress(names, known)]
    data = {
        "layers": _finite(body.series[name][..., known]), "names": names, "label": label,
        "depth": body.whole.depth.tolist(), "through": f"{through} (0 {start}, 1 {end})",
        "level": [] if level is None
        else _finite(np.interp(body.times, recording.history["time"], level)),
        **texts, "title": f"{texts.get('title', ' and '.join(names).capitalize())} {through}",
    }  # fmt: skip
    return Card(name, data=data)


# ---------------------------------------------------------------- curves
def curves(run: ReportedRun) -> Card | None:
    """Plot the history; related columns share a frame."""
    history = run.recording.history
    if len(history["time"]) < 2 or not run.columns:
        return None
    groups = defaultdict[tuple[str, str], list[str]](list)
    for name in run.columns:
        groups[run.known[name].unit if name in run.known else "", _family(name)].append(name)
    data = []
    for (_, family), group in groups.items():
        unit = run.unit(group[0])
        title = words(group[0] if len(group) == 1 else WHOLE.get(family, family))
        title = title[0].upper() + title[1:]
        series = [
            {"name": words(name), "values": _finite(kept_times(history[name], MOST_ROWS))}
            for name in group
        ]
        data.append({"title": title, "unit": unit, "series": series})
    times = kept_times(history["time"], MOST_ROWS).tolist()
    return Card("curves", data={"times": times, "curves": data})


WHOLE = {"max_chain": "max_chain_extension"}  # families whose names are incomplete


def _family(name: str) -> str:
    """Return the family of a column: its first two words, or the second of two."""
    first, *others = name.split("_")
    if len(others) == 1 and len(others[0]) > 1:  # not the letter of an axis
        return others[0]
    return "_".join([first, *others[:1]]) if len(others) > 1 else first


def _finite(values: ArrayLike) -> object:
    """Return nested lists of numbers with 7 digits; None for NaN and infinity."""
    if isinstance(values, np.ndarray):
        return [*map(_finite, values)]
    return float(f"{values:.7g}") if np.isfinite(values) else None


# ---------------------------------------------------------------- texts
def facts(run: ReportedRun) -> Card:
    """List the scene's tables, with results of the run such as its number of steps."""
    scene, history = run.recording.scene, run.recording.history
    tables = defaultdict[str, list[str]](list)
    off = [f"remodeling.{one.name}" for one in scene.remodeling.processes if not one.is_on]
    without = (*NO_PHYSICS, *off)
    for key, value in leaves(scene.model_dump(exclude_none=True), without):
        path, _, name = key.rpartition(".")
        path = re.sub(r"^cases\[(\d+)\]", lambda number: f"load case {int(number[1]) + 1}", path)
        if value not in ((), {}):
            tables[path or "load cases"].append(f"{words(name)} {_as_text(value)}")
    texts = [text for _, _, text in run.log]
    tables["geometry"] += [text for text in texts if text.startswith(UNLOADED_PREFIX)][-1:]
    if run.body:
        tables["mesh"].append(f"{len(run.recording.elements):,} elements")
    tables["model"].append(scene.kinematics.meaning)
    tables["material"].append(scene.summary())
    steps = f"{max(0, len(history['time']) - 1)}{'' if scene.time.is_adaptive else ' of'} "
    steps += scene.time.in_words()
    solving = f"{duration(float(np.nansum(history.get('seconds', 0.0))))} of solving"
    ranks = [
        f"{match[1]} ranks" for text in texts if (match := _RANKS.match(text)) and match[1] != "1"
    ]
    tables["time"] += [steps, solving, *ranks[-1:]]
    rows = _changes(run) | {
        path.replace(".", " "): ", ".join(parts) for path, parts in tables.items()
    }
    return Card(
        "facts",
        section(
            "What was run", table((words(n).capitalize(), row) for n, row in rows.items() if row)
        ),
    )


def _changes(run: ReportedRun) -> dict[str, str]:
    """Describe the keys whose values differ from the preset's, with both values, by origin."""
    scene, changes = run.recording.scene, defaultdict[str, str](str)
    if scene.preset is None:
        return changes
    preset = preset_scene(scene.preset, scene.geometry.name)
    before, now = (
        dict(leaves(each.model_dump(exclude_none=True), NO_PHYSICS)) for each in (preset, scene)
    )
    profile = profile_for(scene.profile, scene).settings(scene) if scene.profile else {}
    texts = [text for _, _, text in run.log]
    overrides = [text.partition("=")[0] + "." for text in texts if text.startswith(OVERRIDE)]
    for key, value in now.items():
        if before.get(key) != value:
            origin = f"profile {scene.profile}" if key in profile else "in the scene"
            if f"{OVERRIDE}{key}.".startswith(tuple(overrides)):
                origin = "by --set"
            text = f"{key} = {_as_text(value)} for {_as_text(before.get(key, '-'))}"
            changes[f"changed {origin}"] += f", {text}"
    return {origin: text.removeprefix(", ") for origin, text in changes.items()}


def _as_text(value: object) -> str:
    """Format a value of a scene."""
    if isinstance(value, dict):
        return ", ".join(
            f"{words(str(name))} {_as_text(item)}"
            for name, item in value.items()
            if item not in ({}, ())
        )
    if isinstance(value, (list, tuple)):
        return f"({', '.join(map(_as_text, value))})"
    return f"{value:g}" if isinstance(value, float) else str(value)


def warnings(run: ReportedRun) -> Card:
    """List the warnings of the run, and its files."""
    counts = run.warnings
    numbers = {text: "once" if count == 1 else f"{count} times" for text, count in counts.items()}
    items = "".join(
        f'<li>{escape(text)} <span class="note">({n})</span></li>' for text, n in numbers.items()
    )
    text = (
        f"<ul>{items}</ul>" if counts else '<p class="note">None: the run raised no warnings.</p>'
    )
    files = {
        name: read_regular(run.recording.path / name, LARGEST_HISTORY) for name in (SCENE, HISTORY)
    }
    # Histories that are too large for a page are left out.
    files = {name: data for name, data in files.items() if len(data) <= LARGEST_DOWNLOAD}
    buttons = "".join(
        f'<a class="download" data-file="{file}" href="#">{file}</a> ' for file in files
    )
    html = section(
        f"Warnings ({sum(counts.values())})", f"{text}<h2>Files of the run</h2><p>{buttons}</p>"
    )
    arrays = {file: Array(np.frombuffer(data, dtype=np.uint8)) for file, data in files.items()}
    return Card("warnings", html, {"files": list(arrays)}, arrays)


def scene(run: ReportedRun) -> Card:
    """Show the whole scene, with its comments."""
    text = read_regular(run.recording.path / SCENE, LARGEST_HISTORY).decode(errors="replace")
    return Card("scene", collapsed_section("The whole scene, as run", f"<pre>{escape(text)}</pre>"))


def versions(run: ReportedRun) -> Card:
    """List the recorded versions, and the licences of the code in the page."""
    rows = [*run.recording.versions.items(), ("this page", f"remodel_fenicsx {__version__}")]
    licences = "".join(
        f"<h3>{escape(name)}</h3><pre>{escape(_asset(f'LICENSE.{file}'))}</pre>"
        for name, file in (("three.js", "three"), ("uPlot", "uplot"))
    )
    note = "<p>This page has the code of three.js and uPlot in it.</p>"
    return Card(
        "versions", collapsed_section("Versions and licences", table(rows) + note + licences)
    )


PAGE_PARTS: list[Part] = [
    head,
    tiles,
    drawn,
    view,
    angles,
    curves,
    stress,
    sectors,
    content,
    facts,
    warnings,
    scene,
    versions,
]
"""Parts in the order of the page."""


def cards(run: ReportedRun) -> list[Card]:
    """Return the cards of all parts that are not empty."""
    return [card for card in (part(run) for part in PAGE_PARTS) if card is not None]


# ---------------------------------------------------------------- the page as one file
# Template, cards, data and scripts. The page loads nothing from outside.

REPORT = "report.html"
PAGE_SIZE = 20.0  # MB: largest size of a page, about
SCRIPTS = "data.js body.js angles.js through_the_wall.js curves.js page.js".split()
STYLES = ("report.bundle.css", "page.css")
GENERATOR_TAG = b'name="generator" content="remodel_fenicsx'  # pages with this tag may be replaced
LARGEST_PAGE = 10**9  # bytes
FEWEST_TIMES = 2
RATIO = 0.35  # size of compressed over plain fields; few are larger


class ReportError(RemodelError, ValueError):
    """Failure to make a report; the message is one line with the reason."""


def write_report(folder: str | os.PathLike[str], path: Path | None = None) -> Path:
    """Make the report of a run, finished or not, from its folder."""
    recording = RecordedRun(folder)
    if path is not None:
        write_new(path, page_of(recording).encode("utf-8"))
        return path
    path = recording.path / REPORT
    if path.exists() and GENERATOR_TAG not in read_regular(path, LARGEST_PAGE)[:4096]:
        raise ReportError(
            f"{path}: is no report of this command and is not overwritten; choose another file"
        )
    write_whole(path, page_of(recording).encode("utf-8"))
    return path


def page_of(recording: RecordedRun, size: float = PAGE_SIZE) -> str:
    """Return the page as text; `size` is about its largest size in MB."""
    if not has_a_body(recording):
        return render_page(cards(ReportedRun(recording)))
    # Bytes of a recorded time, in base64.
    of_a_time = 4 / 3 * RATIO * (6 * len(recording.points) + 15 * len(recording.elements))
    whole, most = WholeBody(recording), max(FEWEST_TIMES, int(1e6 * size / of_a_time))
    body = ShownBody.from_run(whole, kept_times(recording.times, most))
    return render_page(cards(ReportedRun(recording, body)))


def render_page(shown: list[Card]) -> str:
    """Return a page with these cards; the first is the head, whose data have the page's `name`."""
    data = {card.name: dict(card.data) for card in shown}  # as the scripts read them
    arrays = {f"{card.name}.{name}": array for card in shown for name, array in card.arrays.items()}
    block, table = pack_arrays(arrays)
    script = "{\n" + "\n".join(_asset(name) for name in SCRIPTS) + "\n}\n"
    style = "\n".join(_asset(name) for name in STYLES)
    bundle = _asset("report.bundle.js")
    parts = {
        "POLICY": policy([bundle, script], style),
        "GENERATOR": f"remodel_fenicsx {__version__}",
        "TITLE": escape(str(data["head"]["name"])),
        "STYLE": style,
        "CARDS": "\n".join(card.html for card in shown),
        "DATA": as_json({"parts": data, "arrays": table}),
        "ARRAYS": block,
        "BUNDLE": bundle,
        "SCRIPT": script,
    }
    # Template does not substitute inside of the substituted texts.
    return Template(_asset("template.html")).substitute(parts)


def policy(scripts: list[str], style: str) -> str:
    """Return the content security policy: the page's scripts and style by hash, nothing else."""
    allowed = " ".join(_hash(text) for text in scripts)
    return (
        f"default-src 'none'; script-src {allowed}; style-src {_hash(style)}; img-src data: blob:; "
        "connect-src 'none'; base-uri 'none'; form-action 'none'"
    )


def _hash(text: str) -> str:
    digest = base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest())
    return f"'sha256-{digest.decode('ascii')}'"


def as_json(values: object) -> str:
    """Return JSON that cannot end the HTML script in which it stands."""
    text = json.dumps(values, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _asset(name: str) -> str:
    return (ASSETS / name).read_text(encoding="utf-8")
