"""A run as one page for a browser, which needs no network: what was run, how it went, the body in space.

`write_report` makes it of a run's folder alone, without dolfinx. A page is a list of parts, `PAGE_PARTS`. Each gives a
card, or None: HTML and, for what moves, data and arrays that the scripts in `assets/` take under the card's name.
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
from remodel_fenicsx.fem.kinematics import KINEMATICS
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
from remodel_fenicsx.results.status import log_entries, state_of
from remodel_fenicsx.results.whole_body import (
    AXIS_FIELDS,
    DIRECTION_FIELDS,
    TENSOR_FIELDS,
    WholeBody,
    has_a_body,
)
from remodel_fenicsx.scene.scene import Scene, leaves, preset_scene
from remodel_fenicsx.system.files import read_regular, write_new, write_whole
from remodel_fenicsx.system.terminal import duration


Places = NDArray[np.float64]


# ---------------------------------------------------------------- arrays as text of a page
# One block, deflated, in base64; and how numbers become few bytes.

ANGLE_STEPS = 252  # of a byte for 0 to 90 degrees: 14 for each of the 18 colours, so that all agree about these
NO_ANGLE = 255


def pack_arrays(arrays: Mapping[str, Array]) -> tuple[str, dict[str, dict[str, object]]]:
    """The block, and what tells the page where each array is in it."""
    block, table = bytearray(), {}
    for name, array in arrays.items():
        values = np.ascontiguousarray(array.values)
        # differences are modulo the range of the type
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
        block += bytes(-len(block) % 4)  # typed arrays begin at multiples of their size
    # level 6 is 5 % smaller and takes as long again
    return base64.b64encode(gzip.compress(bytes(block), 3, mtime=0)).decode("ascii"), table


# ---------------------------------------------------------------- a part of the page, and its HTML
# All text of others goes through `escape`.


class Array(NamedTuple):
    """Numbers that the page unpacks into a typed array."""

    values: NDArray[np.generic]
    differences: bool = False


class Card(NamedTuple):
    """A part of the page: HTML, and what `assets/drawn.html` and the scripts take."""

    name: str
    html: str = ""
    data: Mapping[str, object] = MappingProxyType({})
    arrays: Mapping[str, Array] = MappingProxyType({})


def section(title: str, content: str) -> str:
    """A card with a heading; `content` is HTML."""
    return f'<section class="card half"><h2>{escape(title)}</h2>{content}</section>'


def collapsed_section(title: str, content: str) -> str:
    """The same, closed until somebody opens it."""
    return f'<details class="card half"><summary>{escape(title)}</summary>{content}</details>'


def table(rows: Iterable[tuple[str, str]]) -> str:
    """Names and values."""
    cells = "".join(
        f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in rows
    )
    return f"<table>{cells}</table>"


# ---------------------------------------------------------------- the body at the times that a page keeps

CELL = ("cell_dimensions", *AXIS_FIELDS)
NAMES = ("displacement", "deformation_gradient", "fibre_angle_deformed", "chain_extension", *CELL)
TURNOVER_FIELDS = ("content", GROWTH)
WALL_FIELDS = ("cauchy_stress", *DIRECTION_FIELDS, *TURNOVER_FIELDS)


@dataclass(frozen=True)
class ShownBody:
    """A body over time."""

    whole: WholeBody
    times: Places
    volume: Places
    series: dict[
        str, NDArray[np.float32]
    ]  # position, and of `_of_elements` and `_of_layers` what was recorded
    is_deformed: bool

    @classmethod
    def from_run(cls, whole: WholeBody, times: Places) -> ShownBody:
        """What a run has recorded at these times."""
        names = (
            *NAMES,
            *(WALL_FIELDS if isinstance(whole.recording.scene.geometry, Walled) else ()),
        )
        rows = defaultdict[str, list[NDArray[np.float32]]](list)
        volume, is_deformed = _volumes(whole.points[whole.elements]), True
        for time in times:
            displacement, found = whole.fields(float(time), names)
            is_deformed = displacement is not None
            moved = 0.0 if displacement is None else displacement
            rows["position"].append((whole.points + moved).astype(np.float32))
            for name, values in (_of_elements(found) | _of_layers(whole, volume, found)).items():
                rows[name].append(values.astype(np.float32))
        return cls(
            whole,
            times,
            volume,
            {name: np.stack(values) for name, values in rows.items()},
            is_deformed,
        )

    def arrays(self) -> tuple[dict[str, Array], dict[str, object]]:
        """The same in few bytes, and the numbers that lead back."""
        moved = self.series["position"]
        least = moved.min(axis=(0, 1))
        step = float((moved.max(axis=(0, 1)) - least).max() / 65535) or 1.0
        position = np.rint((moved - least) / step).astype(np.uint16)
        size = np.uint16 if len(self.whole.points) <= 65536 else np.uint32
        arrays = {
            "elements": Array(self.whole.elements.astype(size)),
            "layer": Array(self.whole.layer.astype(np.uint8)),
            "volume": Array(self.volume.astype(np.float32)),
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
        if "edges" in self.series:
            edges = self.series["edges"].reshape(*moved.shape[:1], -1, 9)
            scales["edge_step"] = (
                float(np.abs(edges).max()) / 127 or 1.0
            )  # components are 127ths of the largest
            arrays["edges"] = Array(
                np.rint(edges / scales["edge_step"]).astype(np.int8), differences=True
            )
        return arrays, scales


def _of_elements(fields: dict[str, Places]) -> dict[str, Places]:
    """What is shown of the elements, by the names of `ShownBody`, as far as it was recorded."""
    names = {"angle": "fibre_angle_deformed", "extension": "chain_extension"}
    found = {name: fields[field] for name, field in names.items() if field in fields}
    if set(CELL) <= set(fields):
        axes = np.stack([fields[name] for name in AXIS_FIELDS], axis=1)
        if "deformation_gradient" in fields:
            axes = axes @ np.swapaxes(fields["deformation_gradient"].reshape(-1, 3, 3), 1, 2)
        found["edges"] = fields["cell_dimensions"][:, :, None] * axes
    return found


def _of_layers(whole: WholeBody, volume: Places, fields: dict[str, Places]) -> dict[str, Places]:
    """Means in each layer, as far as they were recorded: of stress around, along and across the wall, of `MADE`."""

    def means(values: list[Places]) -> Places:
        """(layers, values)."""
        sums = [
            np.bincount(whole.layer, weights=volume * part)
            for part in (*values, np.ones_like(volume))
        ]
        return np.stack(sums[:-1], axis=1) / sums[-1][:, None]

    unknown = np.full(len(volume), np.nan)
    made = [fields.get(name, unknown) for name in TURNOVER_FIELDS]
    found = {"content": means(made)} if set(TURNOVER_FIELDS) & set(fields) else {}
    shape = whole.recording.scene.geometry
    recorded = (
        DIRECTION_FIELDS if shape.constant_fields else ()
    )  # where axes are no function of the place
    if not set(fields) >= {*TENSOR_FIELDS, *recorded}:
        return found
    if recorded:
        axes = np.stack([fields[name] for name in recorded], axis=1)
    else:
        axes = shape.axes_at(whole.centres)
    F, stress = (fields[name].reshape(-1, 3, 3) for name in TENSOR_FIELDS)
    moved = push_forward_axes(axes, F)
    return found | {"stress": means([*np.einsum("nki,nij,nkj->kn", moved, stress, moved)])}


def _volumes(corners: Places) -> Places:
    """Shares of hexahedra (m, 8, 3), by their middles, or of tetrahedra (m, 4, 3) in their sum."""
    sides = corners[:, 1:4] - corners[:, :1]
    if corners.shape[1] == 8:
        grid = corners[:, [0, 1, 3, 2, 4, 5, 7, 6]].reshape(-1, 2, 2, 2, 3)
        sides = np.stack([np.diff(grid, axis=k).mean(axis=(1, 2, 3)) for k in (1, 2, 3)], axis=1)
    total = np.abs(np.linalg.det(sides))
    return np.asarray(total / total.sum())


# ---------------------------------------------------------------- how a run went, from its folder
# Whether it has ended and why, what it warned of.

UNLOADED_PREFIX = "unloaded: "  # as logs say it
_RANKS = re.compile(r"scene .* on (\d+) ranks?, results in ")


ASSETS = Path(__file__).with_name("assets")
MOST_TILES = 8
NO_PHYSICS = ("format", "name", "preset", "profile", "output", "solver", "geometry.sha256")
MOST_ROWS = 2000  # of a curve: a curve has fewer pixels
LARGEST_DOWNLOAD = 20_000_000  # bytes of a history that still goes into the page


@dataclass(frozen=True)
class ReportedRun:
    """All that a part may ask of a run."""

    recording: RecordedRun
    body: ShownBody | None = None

    @cached_property
    def log(self) -> list[tuple[str, str, str]]:
        """Entries of run.log."""
        return log_entries(self.recording.path)

    @cached_property
    def warnings(self) -> dict[str, int]:
        """Those of run.log with their numbers; of some that differ in numbers alone the first."""
        first, found = dict[str, str](), Counter[str]()
        for _, level, text in self.log:
            if level in ("WARNING", "ERROR", "CRITICAL"):
                found[first.setdefault(re.sub(r"\d+", "0", text), text)] += 1
        return dict(found)

    @cached_property
    def state(self) -> tuple[str, str]:
        """A word, and why or where."""
        scene, times = self.recording.scene, self.recording.history["time"]
        state, reason = state_of(self.recording)
        if state in ("finished", "failed"):
            return state, reason
        at = f"at t = {float(times[-1]) if len(times) else 0.0:g} of {scene.last_time:g}"
        if state == "running":
            of = f" of {scene.time.number_of_steps}" if scene.time.tolerance is None else ""
            return state, f"step {max(0, len(times) - 1)}{of}, {at}"
        return state, f"{at}: {reason}" if reason else f"{at}, without a word: it was killed"

    @cached_property
    def known(self) -> dict[str, Column]:
        """The columns that its scene has, by name."""
        return {column.name: column for column in self.recording.scene.columns()}

    @cached_property
    def columns(self) -> list[str]:
        """Names of the history, those of the shape first; none without a number."""
        scene, history = self.recording.scene, self.recording.history
        own = {
            column.name
            for one in (scene.geometry.columns, *map(columns_of_region, scene.regions))
            for column in one
        }
        names = [name for name in history if name != "time" and np.isfinite(history[name]).any()]
        if "substeps" in names and np.nanmax(history["substeps"]) <= 1:
            names.remove("substeps")
        return sorted(names, key=lambda name: name not in own)

    def unit(self, name: str) -> str:
        """The column's unit where the scene says what it is, else nothing."""
        return unit_of(self.recording.scene, self.known[name].unit) if name in self.known else ""


Part = Callable[[ReportedRun], Card | None]


# ---------------------------------------------------------------- top
def head(run: ReportedRun) -> Card:
    """Name, how the run ended, when."""
    (state, why), name = run.state, run.recording.scene.name
    dates = " to ".join(dict.fromkeys(stamp for stamp, _, _ in (*run.log[:1], *run.log[-1:])))
    reason = f'<p class="reason">{escape(why)}</p>' if why else ""
    html = (
        f'<header class="whole"><h1>{escape(name)}</h1><span class="badge {state}">{state}</span>'
        f'<span class="note">{escape(dates)}</span>{reason}</header>'
    )
    return Card("head", html, {"name": name, "state": state})


def tiles(run: ReportedRun) -> Card | None:
    """The shape's own columns and r/L: the last value and the first."""
    history = run.recording.history
    found: list[str] = []
    own = [column.name for column in run.recording.scene.geometry.columns]
    for name in run.columns:
        values, unit = history[name][np.isfinite(history[name])], run.unit(name)
        if (
            name not in (*own, "max_chain_extension")
            or len(found) == MOST_TILES
            or not values.any()
        ):
            continue
        # body and profile are deformed
        reference = (
            " (reference)" if name.startswith("fibre_angle") and "deformed" not in name else ""
        )
        last, first = (escape(with_unit(float(values[index]), unit)) for index in (-1, 0))
        found.append(
            f'<div class="tile" title="{escape(run.known[name].meaning)}"><b>{last}</b>'
            f'<span>{escape(words(name))}{reference}</span><span class="note">from {first}</span></div>'
        )
    return Card("tiles", f'<div class="tiles whole">{"".join(found)}</div>') if found else None


# ---------------------------------------------------------------- the body
def drawn(run: ReportedRun) -> Card:
    """The places of what is drawn."""
    return Card("drawn", _asset("drawn.html"))


def view(run: ReportedRun) -> Card:
    """The body in space, with time, and what can be done with it."""
    body = run.body
    if body is None:
        return Card("no_view")
    arrays, scales = body.arrays()
    notes, kept, all_times = (
        body.whole.notes(body.is_deformed),
        len(body.times),
        len(run.recording.times),
    )
    if kept < all_times:
        notes.append(f"{kept} of {all_times} recorded times are kept here, to save room.")
    data = {
        **scales, "times": body.times.tolist(), "layers": len(body.whole.depth),
        "words": run.recording.scene.geometry.angle_in_words, "colours": ANGLE_COLOURS, "ambient": AMBIENT,
        "views": VIEWS, "chain": CHAIN_LOOK, "notes": " ".join(notes),
        "least_extension": float(np.floor(20 * np.nanmin(body.series.get("extension", 0.0))) / 20),
    }  # fmt: skip
    return Card("view", data=data, arrays=arrays)


def angles(run: ReportedRun) -> Card | None:
    """The fibre angle through the body, and where the collagen points."""
    body, shape, regions = run.body, run.recording.scene.geometry, run.recording.scene.regions
    if body is None or "angle" not in body.series:
        return None
    through, start, end = shape.depth_labels
    if not np.isfinite(run.recording.history.get("lumen_volume", np.zeros(1))).any():
        through = "through the body"  # its inner face encloses nothing
    along, across = shape.angle_in_words
    places = [
        {"name": words(name), "from": a, "to": b}
        for name, (a, b) in shape.region_depths(regions).items()
    ]
    data = {"title": f"Collagen angle {through}, deformed", "depth": body.whole.depth.tolist(), "along": along,
            "through": f"{through} (0 {start}, 1 {end})", "across": across, "colours": ANGLE_COLOURS,
            "regions": places}  # fmt: skip
    return Card("angles", data=data)


def stress(run: ReportedRun) -> Card | None:
    """Stress through the wall, and what the law of Laplace says of its mean around."""
    history, unit, level = run.recording.history, unit_of(run.recording.scene, "stress"), None
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


def content(run: ReportedRun) -> Card | None:
    """Content and growth of the collagen through the wall, where they were recorded."""
    return _by_layer(run, "content", TURNOVER_FIELDS, "over the start")


def _by_layer(
    run: ReportedRun,
    name: str,
    names: Sequence[str],
    label: str,
    level: Places | None = None,
    **said: str,
) -> Card | None:
    """A series of `ShownBody` over the depth, and a dashed level of each row of the history."""
    body = run.body
    if body is None or name not in body.series or len(body.whole.depth) < 2:
        return None
    through, start, end = run.recording.scene.geometry.depth_labels
    known = np.any(np.isfinite(body.series[name]), axis=(0, 1)).tolist()
    names = [*compress(names, known)]
    data = {
        "layers": _finite(body.series[name][..., known]), "names": names, "label": label,
        "depth": body.whole.depth.tolist(), "through": f"{through} (0 {start}, 1 {end})",
        "level": [] if level is None else _finite(np.interp(body.times, run.recording.history["time"], level)),
        **said, "title": f"{said.get('title', ' and '.join(names).capitalize())} {through}",
    }  # fmt: skip
    return Card(name, data=data)


# ---------------------------------------------------------------- curves
def curves(run: ReportedRun) -> Card | None:
    """The history, columns of one kind together."""
    history = run.recording.history
    if len(history["time"]) < 2 or not run.columns:
        return None
    rows = np.unique(np.linspace(0, len(history["time"]) - 1, MOST_ROWS).round().astype(int))
    groups = defaultdict[tuple[str, str], list[str]](list)
    for name in run.columns:
        groups[run.known[name].unit if name in run.known else "", _family(name)].append(name)
    data = []
    for (_, family), group in groups.items():
        unit = run.unit(group[0])
        title = words(group[0] if len(group) == 1 else WHOLE.get(family, family))
        title = title[0].upper() + title[1:]
        series = [{"name": words(name), "values": _finite(history[name][rows])} for name in group]
        data.append({"title": title, "unit": unit, "series": series})
    times = history["time"][rows].tolist()
    return Card("curves", data={"times": times, "curves": data})


WHOLE = {"max_chain": "max_chain_extension"}  # families that are no words by themselves


def _family(name: str) -> str:
    """What columns that are drawn in one frame have in common: two first words, or the second of two."""
    first, *others = name.split("_")
    if len(others) == 1 and len(others[0]) > 1:  # no letter of an axis
        return others[0]
    return "_".join([first, *others[:1]]) if len(others) > 1 else first


def _finite(values: ArrayLike) -> object:
    """Nested lists of numbers with 7 digits; None where there is none."""
    if isinstance(values, np.ndarray):
        return [*map(_finite, values)]
    return float(f"{values:.7g}") if np.isfinite(values) else None


# ---------------------------------------------------------------- in words
def facts(run: ReportedRun) -> Card:
    """What was run: the tables of the scene, and what the run has made of them."""
    scene, history, tables = (
        run.recording.scene,
        run.recording.history,
        defaultdict[str, list[str]](list),
    )
    without = (
        NO_PHYSICS if scene.remodeling.turnover.is_on else (*NO_PHYSICS, "remodeling.turnover")
    )
    for key, value in leaves(scene.model_dump(exclude_none=True), without):
        place, _, name = key.rpartition(".")
        place = re.sub(r"^cases\[(\d+)\]", lambda number: f"load case {int(number[1]) + 1}", place)
        if value not in ((), {}):
            tables[place or "load cases"].append(f"{words(name)} {_as_text(value)}")
    said = [text for _, _, text in run.log]
    tables["geometry"] += [text for text in said if text.startswith(UNLOADED_PREFIX)][-1:]
    if run.body:
        tables["mesh"].append(f"{len(run.recording.elements):,} elements")
    tables["model"].append(KINEMATICS[scene.model.kinematics].meaning)
    tables["material"].append(scene.summary())
    steps = f"{max(0, len(history['time']) - 1)}{'' if scene.time.is_adaptive else ' of'} {scene.time.in_words()}"
    solving = f"{duration(float(np.nansum(history.get('seconds', 0.0))))} of solving"
    ranks = [
        f"{found[1]} ranks" for text in said if (found := _RANKS.match(text)) and found[1] != "1"
    ]
    tables["time"] += [steps, solving, *ranks[-1:]]
    rows = {"changed": _changed(scene)} | {
        place.replace(".", " "): ", ".join(parts) for place, parts in tables.items()
    }
    return Card(
        "facts",
        section(
            "What was run", table((words(n).capitalize(), row) for n, row in rows.items() if row)
        ),
    )


def _changed(scene: Scene) -> str:
    """Keys whose values are others than those of the preset, which stand beside them."""
    if scene.preset is None:
        return ""
    preset = preset_scene(scene.preset, scene.geometry.name)
    before, now = (
        dict(leaves(one.model_dump(exclude_none=True), NO_PHYSICS)) for one in (preset, scene)
    )
    new = {key: value for key, value in now.items() if before.get(key) != value}
    return ", ".join(
        f"{key} = {_as_text(value)} for {_as_text(before.get(key, '-'))}"
        for key, value in new.items()
    )


def _as_text(value: object) -> str:
    """A value of a scene."""
    if isinstance(value, dict):
        return ", ".join(
            f"{words(str(name))} {_as_text(one)}"
            for name, one in value.items()
            if one not in ({}, ())
        )
    if isinstance(value, (list, tuple)):
        return f"({', '.join(map(_as_text, value))})"
    return f"{value:g}" if isinstance(value, float) else str(value)


def warnings(run: ReportedRun) -> Card:
    """What the run warned of, and its files."""
    found = run.warnings
    numbers = {text: "once" if count == 1 else f"{count} times" for text, count in found.items()}
    items = "".join(
        f'<li>{escape(text)} <span class="note">({n})</span></li>' for text, n in numbers.items()
    )
    said = f"<ul>{items}</ul>" if found else '<p class="note">None: the run raised no warnings.</p>'
    files = {
        name: read_regular(run.recording.path / name, LARGEST_HISTORY) for name in (SCENE, HISTORY)
    }
    # a history that is larger than a page may be stays where it is
    files = {name: data for name, data in files.items() if len(data) <= LARGEST_DOWNLOAD}
    buttons = "".join(
        f'<a class="download" data-file="{file}" href="#">{file}</a> ' for file in files
    )
    html = section(
        f"Warnings ({sum(found.values())})", f"{said}<h2>Files of the run</h2><p>{buttons}</p>"
    )
    arrays = {file: Array(np.frombuffer(data, dtype=np.uint8)) for file, data in files.items()}
    return Card("warnings", html, {"files": list(arrays)}, arrays)


def scene(run: ReportedRun) -> Card:
    """The whole scene, with its comments."""
    text = read_regular(run.recording.path / SCENE, LARGEST_HISTORY).decode(errors="replace")
    return Card("scene", collapsed_section("The whole scene, as run", f"<pre>{escape(text)}</pre>"))


def versions(run: ReportedRun) -> Card:
    """Versions that the run wrote, and the licences of what is in the page."""
    rows = [*run.recording.versions.items(), ("this page", f"remodel_fenicsx {__version__}")]
    licences = "".join(
        f"<h3>{escape(name)}</h3><pre>{escape((ASSETS / f'LICENSE.{file}').read_text(encoding='utf-8'))}</pre>"
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
    content,
    facts,
    warnings,
    scene,
    versions,
]
"""In the order of the page."""


def cards(run: ReportedRun) -> list[Card]:
    """Of all parts that have something to say."""
    return [card for card in (part(run) for part in PAGE_PARTS) if card is not None]


# ---------------------------------------------------------------- the page as one file
# Template, cards, data, scripts; nothing in it asks for anything from outside.

REPORT = "report.html"
PAGE_SIZE = 20.0  # MB that a page should have at most
SCRIPTS = "data.js body.js angles.js through_the_wall.js curves.js page.js".split()
STYLES = ("report.bundle.css", "page.css")
GENERATOR_TAG = b'name="generator" content="remodel_fenicsx'  # what bears it may be made anew
LARGEST_PAGE = 10**9  # bytes
FEWEST_TIMES = 2
RATIO = 0.35  # of deflated to plain bytes of fields: few are larger


class ReportError(RemodelError, ValueError):
    """No report for a reason that its one line names."""


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
    """The page as text, of about so many MB at most."""
    if not has_a_body(recording):
        return render_page(cards(ReportedRun(recording)))
    of_a_time = (
        4 / 3 * RATIO * (6 * len(recording.points) + 11 * len(recording.elements))
    )  # bytes, in base64
    whole, most = WholeBody(recording), max(FEWEST_TIMES, int(1e6 * size / of_a_time))
    body = ShownBody.from_run(whole, kept_times(recording.times, most))
    return render_page(cards(ReportedRun(recording, body)))


def render_page(found: list[Card]) -> str:
    """A page with these cards, the first one the head, whose data have the page's `name`."""
    data = {card.name: dict(card.data) for card in found}  # as the script takes them
    arrays = {f"{card.name}.{name}": array for card in found for name, array in card.arrays.items()}
    block, table = pack_arrays(arrays)
    script = "{\n" + "\n".join(_asset(name) for name in SCRIPTS) + "\n}\n"
    style = "\n".join(_asset(name) for name in STYLES)
    bundle = _asset("report.bundle.js")
    parts = {
        "POLICY": policy([bundle, script], style),
        "GENERATOR": f"remodel_fenicsx {__version__}",
        "TITLE": escape(str(data["head"]["name"])),
        "STYLE": style,
        "CARDS": "\n".join(card.html for card in found),
        "DATA": as_json({"parts": data, "arrays": table}),
        "ARRAYS": block,
        "BUNDLE": bundle,
        "SCRIPT": script,
    }
    return Template(_asset("template.html")).substitute(
        parts
    )  # what is put in is not looked at again


def policy(scripts: list[str], style: str) -> str:
    """What the browser allows the page: its own scripts and style, known by their hashes, and nothing from anywhere."""
    allowed = " ".join(_hash(text) for text in scripts)
    return (
        f"default-src 'none'; script-src {allowed}; style-src {_hash(style)}; img-src data: blob:; "
        "connect-src 'none'; base-uri 'none'; form-action 'none'"
    )


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode('utf-8')).digest()).decode('ascii')}'"


def as_json(values: object) -> str:
    """JSON that no reader of HTML takes for an end of its script."""
    text = json.dumps(values, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _asset(name: str) -> str:
    return (ASSETS / name).read_text(encoding="utf-8")
