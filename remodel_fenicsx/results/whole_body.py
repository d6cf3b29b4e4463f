"""The whole body of a recorded run, for reductions too, without dolfinx."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from remodel_fenicsx._lazy import Late
from remodel_fenicsx.body.reductions import Turn
from remodel_fenicsx.model.axes import NATURAL_GRADIENT
from remodel_fenicsx.model.tensors import Array, Integers
from remodel_fenicsx.results.recording import RecordedRun, RecordingError
from remodel_fenicsx.results.vtkhdf import CELL_TYPES, LINE, TransientGrid

spatial = Late("scipy.spatial")  # most runs show no reduction
Fields = tuple[Array | None, dict[str, Array]]

CORNERS = {"interval": 2, "quadrilateral": 4, "tetrahedron": 4, "hexahedron": 8}
MOST_LAYERS = 40  # of a mesh in layers; others are divided into FEW_LAYERS
FEW_LAYERS = 8
SECTORS = 8  # parts of a vessel's length, from inlet to outlet


# ---------------------------------------------------------------- rotated fields of a reduction

DIRECTION_FIELDS = ("axis_c", "axis_a", "axis_r")
TENSOR_FIELDS = ("deformation_gradient", "cauchy_stress")


class RotatedFields:
    """Map from the nodes and elements of a whole body to those of its reduction, with fields."""

    def __init__(
        self,
        points: Array,
        elements: Integers,
        own_points: Array,
        own_elements: Integers,
        turn: Turn,
    ):
        self.turns = turn(points)
        back = np.einsum("nji,nj->ni", self.turns, points)  # Q^T X
        self.nodes = spatial.cKDTree(own_points).query(back)[1]
        self.offsets = back - own_points[self.nodes]
        owner = np.zeros(len(own_points), dtype=np.int64)
        owner[own_elements.reshape(-1)] = np.repeat(
            np.arange(len(own_elements)), own_elements.shape[1]
        )
        self.owners = owner[self.nodes]
        self.centres = points[elements].mean(axis=1)
        self.element_turns = turn(self.centres)
        # each node is rotated back by itself before the mean: chords of a coarse mesh lie inside of
        # their circles
        self.sources = spatial.cKDTree(own_points[own_elements].mean(axis=1)).query(
            back[elements].mean(axis=1)
        )[1]

    def __call__(self, fields: dict[str, Array]) -> tuple[Array | None, dict[str, Array]]:
        """Return the displacement of the body's nodes, if recorded, and fields of its elements."""
        rotated = {
            name: values[self.sources] for name, values in fields.items() if name != "displacement"
        }
        for name in set(rotated) & {*AXIS_FIELDS, *DIRECTION_FIELDS}:
            rotated[name] = np.einsum("nij,nj->ni", self.element_turns, rotated[name])
        for name in set(rotated) & {*TENSOR_FIELDS, NATURAL_GRADIENT}:
            tensors = rotated[name].reshape(-1, 3, 3)
            turned = self.element_turns @ tensors @ np.swapaxes(self.element_turns, 1, 2)
            rotated[name] = turned.reshape(-1, 9)
        if not {"displacement", "deformation_gradient"} <= set(fields):
            return None, rotated
        gradient = fields["deformation_gradient"].reshape(-1, 3, 3)[self.owners] - np.eye(3)
        moved = fields["displacement"][self.nodes] + np.einsum("nij,nj->ni", gradient, self.offsets)
        return np.einsum("nij,nj->ni", self.turns, moved), rotated


# ---------------------------------------------------------------- chains of unit cells as lines

AXIS_FIELDS = ("axis_1", "axis_2", "axis_3")
# fields that the lines need
OF_CHAINS = ("cell_dimensions", *AXIS_FIELDS, "deformation_gradient", "fibre_angle")


def axes_of(fields: Mapping[str, Array]) -> Array:
    """Return the axes of cells from their fields, as rows (m, 3, 3)."""
    return np.stack([fields[name] for name in AXIS_FIELDS], axis=1)


def chain_lines(
    centres: Array, lengths: Array, axes: Array, scale: float
) -> tuple[Array, Integers]:
    """Return the chains of unit cells, +-l_1 n_1 +-l_2 n_2 +-l_3 n_3 (paper, Fig. 2)."""
    signs = np.array([(1.0, 1, 1), (1, 1, -1), (1, -1, 1), (1, -1, -1)])
    half = scale * signs @ (lengths[:, :, None] * axes)
    ends = centres[:, None, None, :] + np.stack([half, -half], axis=2)
    return ends.reshape(-1, 3), np.arange(8 * len(centres)).reshape(-1, 2)


def chain_displacement(
    points: Array, centres: Array, displacement: Array, deformation_gradient: Array
) -> Array:
    """Compute the displacement of the chains' ends, (8 m, 3): u + (F - I)(X_end - X_centre)."""
    ends = points.reshape(-1, 8, 3) - centres[:, None, :]
    gradient = deformation_gradient - np.eye(3)
    return (displacement[:, None, :] + ends @ np.swapaxes(gradient, 1, 2)).reshape(-1, 3)


def append_chains(
    grid: TransientGrid | Path,
    time: float,
    points: Array,
    elements: Integers,
    scale: float,
    displacement: Array,
    fields: Mapping[str, Array],
) -> TransientGrid:
    """Append a step to a file of chain lines; for the first step, `grid` is the file's path."""
    axes = axes_of(fields)
    centres, middle = (values[elements].mean(axis=1) for values in (points, displacement))
    ends, lines = chain_lines(centres, fields["cell_dimensions"], axes, scale)
    moved = chain_displacement(
        ends, centres, middle, fields["deformation_gradient"].reshape(-1, 3, 3)
    )
    if isinstance(grid, Path):
        grid = TransientGrid(grid, ends, lines, LINE, point_dtype=np.float32)
    angle = np.repeat(fields["fibre_angle"], 4)
    grid.append(time, {"displacement": moved}, {"fibre_angle": angle}, points=ends)
    return grid


# ---------------------------------------------------------------- the body


class WholeBody:
    """The body whose fields a run has recorded; RecordingError if there are none."""

    def __init__(self, recording: RecordedRun):
        if not has_a_body(recording):
            raise RecordingError(
                f"{recording.path}: the run recorded no fields of a body (output.fields)"
            )
        scene = recording.scene
        shape, kinematics = scene.geometry, scene.kinematics
        self.recording, self.is_turned = recording, kinematics.reduced
        points = recording.points
        elements = recording.elements[:, : CORNERS[kinematics.element(scene.mesh.element)]]
        self._turned: RotatedFields | None = None
        if self.is_turned:
            reduction = shape.reductions[scene.model.kinematics]
            assert reduction.whole is not None
            solved = points, recording.elements
            points, elements = reduction.whole(shape, points, elements)
            self._turned = RotatedFields(points, elements, *solved, reduction.turn)
        self._used, corners = np.unique(elements, return_inverse=True)
        self.points, self.elements = points[self._used], corners.reshape(elements.shape)
        self.centres = self.points[self.elements].mean(axis=1)
        known = {} if self.is_turned else recording.fields(float(recording.times[0]), {"depth"})
        depth = known["depth"] if "depth" in known else shape.depth(self.centres)
        self.layer, self.depth = _layers(depth, self.elements)
        self.volume = _volumes(self.points[self.elements])

    def notes(self, is_deformed: bool) -> list[str]:
        """Return notes for the captions of the body's pictures."""
        model = self.recording.scene.model
        turned = f"Solved with the kinematics {model.kinematics!r}, shown as the whole body."
        reference = "Displacements were not recorded: this is the reference configuration."
        return [*([turned] if self.is_turned else []), *([] if is_deformed else [reference])]

    def fields(self, time: float, names: Collection[str] | None = None) -> Fields:
        """Read displacements of the points, if recorded, and fields of the elements at a time."""
        fields = self.recording.fields(time, names)
        displacement, of_elements = (
            self._turned(fields) if self._turned else (fields.pop("displacement", None), fields)
        )
        return None if displacement is None else displacement[self._used], of_elements

    def means(self, values: Sequence[Array], part: Integers | int = 0, parts: int = 1) -> Array:
        """Return volume means of the layers, or of sectors of each, (layers sectors, values)."""
        bins, number = parts * self.layer + part, parts * len(self.depth)
        weighted = [self.volume * one for one in (*values, np.ones_like(self.volume))]
        sums = np.stack([np.bincount(bins, one, number) for one in weighted], axis=1)
        with np.errstate(invalid="ignore"):  # of sectors without elements
            return sums[:, :-1] / sums[:, -1:]

    def by_sector(self, values: Array, station: Array) -> Array:
        """Return means by layer and sector, from inlet to outlet, (layers, SECTORS)."""
        sector = np.clip(SECTORS * station, 0, SECTORS - 1).astype(np.int64)
        return self.means([values], sector, SECTORS).reshape(-1, SECTORS)


def has_a_body(recording: RecordedRun) -> bool:
    """Return whether a run recorded fields of a body that can be shown."""
    scene = recording.scene
    reduction = scene.geometry.reductions.get(scene.model.kinematics)
    return bool(len(recording.times)) and (reduction is None or reduction.whole is not None)


def _volumes(corners: Array) -> Array:
    """Return volume fractions of hexahedra (m, 8, 3), at their centres, or tetrahedra (m, 4, 3)."""
    sides = corners[:, 1:4] - corners[:, :1]
    if corners.shape[1] == 8:
        grid = corners[:, [0, 1, 3, 2, 4, 5, 7, 6]].reshape(-1, 2, 2, 2, 3)
        sides = np.stack([np.diff(grid, axis=k).mean(axis=(1, 2, 3)) for k in (1, 2, 3)], axis=1)
    total = np.abs(np.linalg.det(sides))
    return total / total.sum()


def _layers(depth: Array, elements: Integers) -> tuple[Integers, Array]:
    """Return each element's layer and the layers' mean depths: of the mesh, or equal intervals."""
    nodes = np.bincount(
        elements.ravel(), weights=np.repeat(depth, elements.shape[1])
    ) / np.bincount(elements.ravel())
    extent = np.ptp(nodes[elements], axis=1).mean()
    number = max(1, round(float(np.ptp(nodes) / extent))) if extent > 0 else 1
    layer = np.unique(depth.round(6), return_inverse=True)[1]
    if layer.max() >= number or number > MOST_LAYERS:
        number = number if number <= MOST_LAYERS else FEW_LAYERS
        layer = np.minimum((number * np.clip(depth, 0.0, 1.0)).astype(np.int64), number - 1)
        layer = np.unique(layer, return_inverse=True)[1]  # none without an element
    return layer, np.bincount(layer, weights=depth) / np.bincount(layer)


# ---------------------------------------------------------------- files of the whole body

BODY, BODY_CHAINS = "fields_body.vtkhdf", "fields_body_chains.vtkhdf"


def revolve(folder: Path | str) -> list[Path]:
    """Write the recorded fields of a reduced run on the mesh of the whole body."""
    recording = RecordedRun(folder)
    kinematics = recording.scene.kinematics
    if not kinematics.reduced:
        raise RecordingError(
            f"{recording.path}: its kinematics are {kinematics.name!r}: "
            "the fields are those of the body already"
        )
    paths = [recording.path / file for file in (BODY, BODY_CHAINS)]
    for path in paths:
        if path.exists():
            raise RecordingError(f"{path}: already exists; nothing is overwritten")
    whole = WholeBody(recording)
    scale = 0.4 * float(np.prod(np.ptp(whole.points, axis=0)) / len(whole.elements)) ** (1 / 3)
    kind = CELL_TYPES["hexahedron" if whole.elements.shape[1] == 8 else "tetrahedron"][0]
    with ExitStack() as stack:  # the body is closed last: if it exists, all do
        grid = stack.enter_context(TransientGrid(paths[0], whole.points, whole.elements, kind))
        chains: TransientGrid | None = None
        for time in recording.times:
            displacement, fields = whole.fields(float(time))
            grid.append(
                float(time), {} if displacement is None else {"displacement": displacement}, fields
            )
            if displacement is not None and set(OF_CHAINS) <= set(fields):
                place, body = chains or paths[1], (whole.points, whole.elements)
                new = append_chains(place, float(time), *body, scale, displacement, fields)
                chains = chains or stack.enter_context(new)
    return [path for path in paths if path.exists()]
