"""The body of a run as it is shown: what is recorded, of reductions turned into the whole body. It needs no dolfinx."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.body.shape import Shape
from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.results.recording import RecordedRun
from remodel_fenicsx.results.turned import TurnedFields

Numbers = NDArray[np.float64]
Fields = tuple[Numbers | None, dict[str, Numbers]]

CORNERS = {"interval": 2, "quadrilateral": 4, "tetrahedron": 4, "hexahedron": 8}
MOST_LAYERS = 40  # of a mesh in layers; others are divided into FEW_LAYERS
FEW_LAYERS = 8


class WholeBody:
    """The body whose fields a run has recorded."""

    def __init__(self, recording: RecordedRun):
        scene = recording.scene
        shape, kinematics = scene.geometry, KINEMATICS[scene.model.kinematics]
        self.recording, self.is_turned = recording, kinematics.reduced
        points = recording.points
        elements = recording.elements[:, : CORNERS[kinematics.element(scene.mesh.element)]]
        self._turned: TurnedFields | None = None
        if self.is_turned:
            reduction = shape.reductions[scene.model.kinematics]
            assert reduction.whole is not None
            solved = points, recording.elements
            points, elements = reduction.whole(shape, points, elements)
            self._turned = TurnedFields(points, elements, *solved, reduction.turn)
        self._used, corners = np.unique(elements, return_inverse=True)
        self.points, self.elements = points[self._used], corners.reshape(elements.shape)
        self.layer, self.depth = _layers(self._depths(shape), self.elements)

    def _depths(self, shape: Shape) -> Numbers:
        """Of the elements, (m,): as recorded, or by their places."""
        recording = self.recording
        known = {} if self.is_turned else recording.fields(float(recording.times[0]), {"depth"})
        return known["depth"] if "depth" in known else shape.depth(self.points[self.elements].mean(axis=1))

    def fields(self, time: float, names: Collection[str] | None = None) -> Fields:
        """Displacement of the points, where it was recorded, and fields of the elements, at a recorded time."""
        fields = self.recording.fields(time, names)
        displacement, found = self._turned(fields) if self._turned else (fields.pop("displacement", None), fields)
        return None if displacement is None else displacement[self._used], found


def has_a_body(recording: RecordedRun) -> bool:
    """Whether a run recorded fields of a body that can be shown."""
    scene = recording.scene
    reduction = scene.geometry.reductions.get(scene.model.kinematics)
    return bool(len(recording.times)) and (reduction is None or reduction.whole is not None)


def _layers(depth: Numbers, elements: NDArray[np.int64]) -> tuple[NDArray[np.int64], Numbers]:
    """Number of each element's layer and the mean depth of each: those of the mesh, or equal parts of the way."""
    nodes = np.bincount(elements.ravel(), weights=np.repeat(depth, elements.shape[1])) / np.bincount(elements.ravel())
    extent = np.ptp(nodes[elements], axis=1).mean()
    number = max(1, round(float(np.ptp(nodes) / extent))) if extent > 0 else 1
    layer = rank_of(depth)
    if layer.max() >= number or number > MOST_LAYERS:
        number = number if number <= MOST_LAYERS else FEW_LAYERS
        layer = np.minimum((number * np.clip(depth, 0.0, 1.0)).astype(np.int64), number - 1)
        layer = np.unique(layer, return_inverse=True)[1].reshape(-1)  # none without an element
    counts = np.bincount(layer)
    return layer, np.bincount(layer, weights=depth) / counts


def rank_of(values: Numbers) -> NDArray[np.int64]:
    """Number of each value among the distinct ones, ascending, from 0: layers, rows or columns of a regular mesh."""
    ordered = np.sort(values)
    size = np.ptp(ordered) or 1.0  # of one layer there is no range
    starts = np.concatenate([[True], np.diff(ordered) > 1e-6 * size])
    return np.searchsorted(ordered[starts], values + 1e-7 * size) - 1
