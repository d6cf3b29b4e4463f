"""The body at the times that a page keeps: what is recorded, of reductions turned into the whole body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.report.card import Array, of_angles, of_places, of_vectors
from remodel_fenicsx.results.turned import AXIS_FIELDS
from remodel_fenicsx.results.whole_body import WholeBody

Numbers = NDArray[np.float64]

CELL = ("cell_dimensions", *AXIS_FIELDS)
NAMES = ("displacement", "deformation_gradient", "fibre_angle_deformed", "chain_extension", *CELL)


@dataclass(frozen=True)
class ShownBody:
    """A body over time."""

    whole: WholeBody
    times: Numbers
    volume: Numbers
    position: NDArray[np.float32]
    angle: NDArray[np.float32] | None
    extension: NDArray[np.float32] | None
    edges: NDArray[np.float32] | None
    is_deformed: bool

    @classmethod
    def of(cls, whole: WholeBody, times: Numbers) -> ShownBody:
        """What a run has recorded at these times."""
        rows: dict[str, list[NDArray[np.float32]]] = {name: [] for name in ("position", "angle", "extension", "edges")}
        is_deformed = True
        with whole.recording.kept_open():
            for time in times:
                displacement, found = whole.fields(float(time), NAMES)
                is_deformed = displacement is not None
                moved = 0.0 if displacement is None else displacement
                rows["position"].append((whole.points + moved).astype(np.float32))
                for name, values in _of_elements(found).items():
                    rows[name].append(values.astype(np.float32))
        series: Any = {name: np.stack(values) if values else None for name, values in rows.items()}
        volume = _volumes(whole.points[whole.elements])
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
