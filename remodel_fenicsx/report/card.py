"""What the report's page is made of: cards, arrays packed as text, the body at the times that it keeps."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.model.axes import moved_axes
from remodel_fenicsx.results.whole_body import AXIS_FIELDS, DIRECTION_FIELDS, TENSOR_FIELDS, WholeBody

Places = NDArray[np.float64]


# ---------------------------------------------------------------- arrays as text of a page
# One block, deflated, in base64; and how numbers become few bytes.

ANGLE_STEPS = 252  # of a byte for 0 to 90 degrees: 14 for each of the 18 colours, so that all agree about these
NO_ANGLE = 255


def packed(arrays: Mapping[str, Array]) -> tuple[str, dict[str, dict[str, Any]]]:
    """The block, and what tells the page where each array is in it."""
    parts, table, start = [], {}, 0
    for name, array in arrays.items():
        values = np.ascontiguousarray(array.values)
        stored = values
        if array.differences and len(values) > 1:
            stored = values.copy()
            stored[1:] -= values[:-1]  # modulo the range of the type
        data = stored.astype(values.dtype.newbyteorder("<")).tobytes()
        start += -start % 4  # typed arrays begin at multiples of their size
        parts.append((start, data))
        table[name] = {
            "type": values.dtype.name, "shape": list(values.shape), "start": start, "differences": array.differences
        }  # fmt: skip
        start += len(data)
    block = bytearray(start)
    for place, data in parts:
        block[place : place + len(data)] = data
    deflate = zlib.compressobj(
        3, zlib.DEFLATED, 31
    )  # 31: with the head of gzip; 6 is 5 % smaller and takes as long again
    return base64.b64encode(deflate.compress(bytes(block)) + deflate.flush()).decode("ascii"), table


def of_angles(degrees: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Angles from 0 to 90 degrees in `ANGLE_STEPS` levels; `NO_ANGLE` where there is none."""
    steps = np.clip(np.floor(degrees * ANGLE_STEPS / 90.0), 0, ANGLE_STEPS - 1)
    return np.where(np.isnan(degrees), NO_ANGLE, steps).astype(np.uint8)


def of_places(places: NDArray[np.float32]) -> tuple[NDArray[np.uint16], list[float], float]:
    """Coordinates (..., 3) as steps from the least of each, with these three and the length of a step."""
    flat = places.reshape(-1, 3)
    least = flat.min(axis=0)
    step = float((flat.max(axis=0) - least).max() / 65535) or 1.0
    return np.rint((places - least) / step).astype(np.uint16), [float(value) for value in least], step


def of_vectors(vectors: NDArray[np.float32]) -> tuple[NDArray[np.int8], float]:
    """Components as 127ths of the largest, and the length of a step."""
    step = float(np.abs(vectors).max()) / 127 or 1.0
    return np.rint(vectors / step).astype(np.int8), step


# ---------------------------------------------------------------- a part of the page, and its HTML
# All text of others goes through `escape`.


@dataclass(frozen=True)
class Array:
    """Numbers that the page unpacks into a typed array."""

    values: NDArray[Any]
    differences: bool = False


@dataclass(frozen=True)
class Card:
    """A part of the page."""

    name: str
    html: str
    data: Mapping[str, Any] = field(default_factory=dict)
    arrays: Mapping[str, Array] = field(default_factory=dict)


def section(title: str, content: str, width: str = "half", note: str = "") -> str:
    """A card with a heading; `content` is HTML, the others text. Widths: whole, wide, narrow, half, third."""
    more = f' <span class="note">{escape(note)}</span>' if note else ""
    heading = f"<h2>{escape(title)}{more}</h2>" if title else ""
    return f'<section class="card {width}">{heading}{content}</section>'


def folded(title: str, content: str) -> str:
    """The same, closed until somebody opens it."""
    return f'<details class="card half"><summary>{escape(title)}</summary>{content}</details>'


def table(rows: Iterable[tuple[str, str]]) -> str:
    """Names and values."""
    cells = "".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in rows)
    return f"<table>{cells}</table>"


# ---------------------------------------------------------------- the body at the times that a page keeps

CELL = ("cell_dimensions", *AXIS_FIELDS)
NAMES = ("displacement", "fibre_angle_deformed", "chain_extension", *CELL, *TENSOR_FIELDS, *DIRECTION_FIELDS)


@dataclass(frozen=True)
class ShownBody:
    """A body over time."""

    whole: WholeBody
    times: Places
    volume: Places
    position: NDArray[np.float32]
    angle: NDArray[np.float32] | None
    extension: NDArray[np.float32] | None
    edges: NDArray[np.float32] | None
    wall_stress: Places | None
    is_deformed: bool

    @classmethod
    def of(cls, whole: WholeBody, times: Places) -> ShownBody:
        """What a run has recorded at these times."""
        names = ("position", "angle", "extension", "edges", "wall_stress")
        rows: dict[str, list[NDArray[np.float32]]] = {name: [] for name in names}
        volume, is_deformed = _volumes(whole.points[whole.elements]), True
        with whole.recording.kept_open():
            for time in times:
                displacement, found = whole.fields(float(time), NAMES)
                is_deformed = displacement is not None
                moved = 0.0 if displacement is None else displacement
                rows["position"].append((whole.points + moved).astype(np.float32))
                for name, values in (_of_elements(found) | _of_layers(whole, volume, found)).items():
                    rows[name].append(values.astype(np.float32))
        series: Any = {name: np.stack(values) if values else None for name, values in rows.items()}
        return cls(whole, times, volume, **series, is_deformed=is_deformed)

    def arrays(self) -> tuple[dict[str, Array], dict[str, Any]]:
        """The same in few bytes, and the numbers that lead back."""
        position, origin, step = of_places(self.position)
        size = np.uint16 if len(self.whole.points) <= 65536 else np.uint32
        arrays = {
            "elements": Array(self.whole.elements.astype(size)),
            "layer": Array(self.whole.layer.astype(np.uint8)),
            "volume": Array(self.volume.astype(np.float32)),
            "reference": Array(self.whole.points.astype(np.float32)),
            "position": Array(position, differences=True),
        }
        scales: dict[str, Any] = {"origin": origin, "position_step": step}
        if self.angle is not None:
            arrays["angle"] = Array(of_angles(self.angle), differences=True)
        if self.extension is not None:
            arrays["extension"] = Array(np.rint(255 * self.extension).astype(np.uint8), differences=True)
        if self.edges is not None:
            edges, scales["edge_step"] = of_vectors(self.edges)
            arrays["edges"] = Array(edges.reshape(*edges.shape[:2], 9), differences=True)
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
    """Mean stress around, along and across the wall in each layer, (layers, 3); nothing without a wall or fields."""
    shape = whole.recording.scene.geometry
    known = set(fields) >= {*TENSOR_FIELDS, *(DIRECTION_FIELDS if shape.constant_fields else ())}
    if not shape.is_a("Walled") or not known:
        return {}
    centres = whole.points[whole.elements].mean(axis=1)
    axes = (
        np.stack([fields[name] for name in DIRECTION_FIELDS], axis=1)
        if shape.constant_fields
        else shape.axes_at(centres)
    )
    F, stress = (fields[name].reshape(-1, 3, 3) for name in ("deformation_gradient", "cauchy_stress"))
    moved = moved_axes(axes, F)
    components = volume[:, None] * np.einsum("nki,nij,nkj->nk", moved, stress, moved)
    sums = [np.bincount(whole.layer, weights=part) for part in (*components.T, volume)]
    return {"wall_stress": np.stack(sums[:3], axis=1) / sums[3][:, None]}


def _volumes(corners: Places) -> Places:
    """Of hexahedra (m, 8, 3), in six tetrahedra about a diagonal, or of tetrahedra (m, 4, 3): shares of their sum."""
    if corners.shape[1] == 8:
        ring = (1, 2, 3, 7, 4, 5, 1)
        parts = [(0, 6, ring[k], ring[k + 1]) for k in range(6)]
    else:
        parts = [(0, 1, 2, 3)]
    total = np.zeros(len(corners))
    for a, b, c, d in parts:
        first, second, third = (corners[:, k] - corners[:, a] for k in (b, c, d))
        total += np.abs(np.einsum("mi,mi->m", np.cross(first, second), third))
    return total / total.sum()
