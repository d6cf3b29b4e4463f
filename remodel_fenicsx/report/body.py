"""The body at the times that a page keeps: what is recorded, of reductions turned into the whole body."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.report.card import Array
from remodel_fenicsx.report.packing import of_angles, of_places, of_vectors
from remodel_fenicsx.results.chain_lines import AXIS_FIELDS
from remodel_fenicsx.results.recording import HistoryColumns, Recording
from remodel_fenicsx.results.turned import TurnedFields

Numbers = NDArray[np.float64]
Fields = tuple[Numbers | None, dict[str, Numbers]]

CORNERS = {"interval": 2, "quadrilateral": 4, "tetrahedron": 4, "hexahedron": 8}
CELL = ("cell_dimensions", *AXIS_FIELDS)
NAMES = ("displacement", "deformation_gradient", "fibre_angle_deformed", "chain_extension", *CELL)
MOST_LAYERS = 40  # of a mesh in layers; others are divided into FEW_LAYERS
FEW_LAYERS = 8


@dataclass(frozen=True)
class ShownBody:
    """A body over time.

    Attributes
    ----------
    times
        That are shown, (t,).
    points
        Of the reference body, (n, 3): nodes that are corners.
    elements
        Corners in VTK's order, (m, 8 or 4).
    layer, depth
        Number of each element's layer, (m,); mean depth of each layer, from 0 to 1.
    volume
        Of each element in the reference body, as a share of all, (m,).
    position
        Of the points, (t, n, 3).
    angle, extension, edges
        Deformed fibre angle in degrees (t, m), largest r/L (t, m), l_I F n_I (t, m, 3, 3); None if not recorded.
    is_turned
        Whether a reduction was solved.
    is_deformed
        Whether displacements were recorded.
    """

    times: Numbers
    points: Numbers
    elements: NDArray[np.int64]
    layer: NDArray[np.int64]
    depth: Numbers
    volume: Numbers
    position: NDArray[np.float32]
    angle: NDArray[np.float32] | None
    extension: NDArray[np.float32] | None
    edges: NDArray[np.float32] | None
    is_turned: bool
    is_deformed: bool

    @classmethod
    def of(cls, recording: Recording, times: Numbers) -> ShownBody:
        """What a run has recorded at these times.

        Raises
        ------
        RecordingError
            If the fields are damaged.
        """
        points, elements, fields = _whole_body(recording)
        used, corners = np.unique(elements, return_inverse=True)
        elements, points = corners.reshape(elements.shape), points[used]
        layer, depth = _layers(recording.scene.geometry.depth(points[elements].mean(axis=1)))
        volume = _volumes(points[elements])
        rows: dict[str, list[NDArray[np.float32]]] = {name: [] for name in ("position", "angle", "extension", "edges")}
        is_deformed = True
        for time in times:
            displacement, found = fields(float(time))
            is_deformed = displacement is not None
            moved = 0.0 if displacement is None else displacement[used]
            rows["position"].append((points + moved).astype(np.float32))
            for name, values in _of_elements(found).items():
                rows[name].append(values.astype(np.float32))
        series = {name: np.stack(values) if values else None for name, values in rows.items()}
        reduced = KINEMATICS[recording.scene.model.kinematics].reduced
        known: Any = {**series, "is_turned": reduced, "is_deformed": is_deformed}
        return cls(times, points, elements, layer, depth, volume, **known)

    def arrays(self) -> tuple[dict[str, Array], dict[str, Any]]:
        """The same in few bytes, and the numbers that lead back."""
        position, origin, step = of_places(self.position)
        size = np.uint16 if len(self.points) <= 65536 else np.uint32
        arrays = {
            "elements": Array(self.elements.astype(size)),
            "layer": Array(self.layer.astype(np.uint8)),
            "volume": Array(self.volume.astype(np.float32)),
            "reference": Array(self.points.astype(np.float32)),
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

    @property
    def bytes_of_a_time(self) -> int:
        """Before anything is deflated."""
        return 6 * len(self.points) + 11 * len(self.elements)


def has_a_body(recording: Recording) -> bool:
    """Whether a run recorded fields of a body that can be shown."""
    scene = recording.scene
    reduction = scene.geometry.reductions.get(scene.model.kinematics)
    return bool(len(recording.times)) and (reduction is None or reduction.whole is not None)


def _whole_body(recording: Recording) -> tuple[Numbers, NDArray[np.int64], Callable[[float], Fields]]:
    """Points, corners, and a function of time: displacement of the points and fields of the elements."""
    scene = recording.scene
    name, shape = scene.model.kinematics, scene.geometry
    points, elements = recording.points, recording.elements
    corners = elements[:, : CORNERS[KINEMATICS[name].element(scene.mesh.element)]]

    def recorded(time: float) -> Fields:
        fields = recording.fields(time, NAMES)
        return fields.pop("displacement", None), fields

    if not KINEMATICS[name].reduced:
        return points, corners, recorded
    reduction = shape.reductions[name]
    assert reduction.whole is not None
    body, hexahedra = reduction.whole(shape, points, corners)
    turned = TurnedFields(body, hexahedra, points, elements, reduction.turn)
    return body, hexahedra, lambda time: turned(recording.fields(time, NAMES))


def _of_elements(fields: dict[str, Numbers]) -> dict[str, Numbers]:
    """What is shown of the elements, by the names of `ShownBody`, as far as it was recorded."""
    names = {"angle": "fibre_angle_deformed", "extension": "chain_extension"}
    found = {name: fields[field] for name, field in names.items() if field in fields}
    if set(CELL) <= set(fields):
        axes = np.stack([fields[name] for name in AXIS_FIELDS], axis=1)
        if "deformation_gradient" in fields:
            axes = axes @ np.swapaxes(fields["deformation_gradient"].reshape(-1, 3, 3), 1, 2)
        found["edges"] = fields["cell_dimensions"][:, :, None] * axes
    return found


def _layers(depth: Numbers) -> tuple[NDArray[np.int64], Numbers]:
    """Number of each element's layer and the mean depth of each: those of the mesh, or equal parts of the way."""
    ordered = np.sort(depth)
    starts = np.concatenate([[True], np.diff(ordered) > 1e-6])
    if starts.sum() <= MOST_LAYERS:
        layer = np.searchsorted(ordered[starts], depth + 1e-7) - 1
    else:
        layer = np.minimum((FEW_LAYERS * np.clip(depth, 0.0, 1.0)).astype(np.int64), FEW_LAYERS - 1)
        layer = np.unique(layer, return_inverse=True)[1].reshape(-1)  # none without an element
    counts = np.bincount(layer)
    return layer, np.bincount(layer, weights=depth) / counts


def _volumes(corners: Numbers) -> Numbers:
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


def kept_times(history: HistoryColumns, times: Numbers, most: int) -> Numbers:
    """So many of the recorded times, the first and the last among them: spaced evenly, half in time, half in change.

    Parameters
    ----------
    history
        What changes: each column over its range.
    times
        That are recorded, (n,).
    most
        How many may be kept, at least 2.
    """
    if len(times) <= most:
        return times
    rows = np.stack([np.interp(times, history["time"], column) for column in history.values()])
    rows = np.where(np.isfinite(rows), rows, 0.0)
    change = np.abs(np.diff(rows, axis=1)) / np.maximum(np.ptp(rows, axis=1), np.finfo(float).tiny)[:, None]
    share = [np.concatenate([[0.0], np.cumsum(part)]) for part in (np.diff(times), change.sum(axis=0))]
    place = np.sum([part / (part[-1] or 1.0) for part in share], axis=0)
    wanted = np.linspace(0.0, float(place[-1]), most)
    return times[np.unique(np.abs(place[:, None] - wanted).argmin(axis=0))]
