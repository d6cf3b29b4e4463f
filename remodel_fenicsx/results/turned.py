"""Fields of a reduction turned to their places in the whole body, and its chains as lines; without dolfinx."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from remodel_fenicsx.body.reductions import Turn
from remodel_fenicsx.results.vtkhdf import LINE, TransientGrid


# ---------------------------------------------------------------- the fields of a reduction, turned to their places
# The fields of a reduction, turned to their places in the whole body. This needs no dolfinx.

Array = NDArray[np.float64]

DIRECTION_FIELDS = ("axis_c", "axis_a", "axis_r")
TENSOR_FIELDS = ("deformation_gradient", "cauchy_stress")
AT_ONCE = 1_000_000  # distances that are compared at a time


class TurnedFields:
    """Which node and element of a reduction stands for each of a body's own, and its fields there."""

    def __init__(
        self, points: Array, elements: NDArray[np.int64], own_points: Array, own_elements: NDArray[np.int64], turn: Turn
    ):
        self.turns = turn(points)
        back = np.einsum("nji,nj->ni", self.turns, points)  # Q^T X
        self.nodes = nearest(back, own_points)
        self.offsets = back - own_points[self.nodes]
        owner = np.zeros(len(own_points), dtype=np.int64)
        owner[own_elements.reshape(-1)] = np.repeat(np.arange(len(own_elements)), own_elements.shape[1])
        self.owners = owner[self.nodes]
        self.centres = points[elements].mean(axis=1)
        self.element_turns = turn(self.centres)
        # the mean of nodes that were turned back each by itself: chords of a coarse mesh lie inside of their circles
        self.sources = nearest(back[elements].mean(axis=1), own_points[own_elements].mean(axis=1))

    def __call__(self, fields: dict[str, Array]) -> tuple[Array | None, dict[str, Array]]:
        """Displacement of the body's nodes, where it was recorded, and fields of its elements."""
        found = {name: values[self.sources] for name, values in fields.items() if name != "displacement"}
        for name in set(found) & {*AXIS_FIELDS, *DIRECTION_FIELDS}:
            found[name] = np.einsum("nij,nj->ni", self.element_turns, found[name])
        for name in set(found) & set(TENSOR_FIELDS):
            tensors = found[name].reshape(-1, 3, 3)
            turned = self.element_turns @ tensors @ np.swapaxes(self.element_turns, 1, 2)
            found[name] = turned.reshape(-1, 9)
        if not {"displacement", "deformation_gradient"} <= set(fields):
            return None, found
        gradient = fields["deformation_gradient"].reshape(-1, 3, 3)[self.owners] - np.eye(3)
        moved = fields["displacement"][self.nodes] + np.einsum("nij,nj->ni", gradient, self.offsets)
        return np.einsum("nij,nj->ni", self.turns, moved), found


def nearest(places: Array, candidates: Array) -> NDArray[np.int64]:
    """Number of the candidate (m, 3) that is nearest to each place (n, 3)."""
    found = np.empty(len(places), dtype=np.int64)
    rows = max(1, AT_ONCE // len(candidates))
    for start in range(0, len(places), rows):
        distances = np.linalg.norm(places[start : start + rows, None] - candidates, axis=-1)
        found[start : start + rows] = distances.argmin(axis=1)
    return found


# ---------------------------------------------------------------- the chains of unit cells as lines to draw, and a
# The chains of unit cells as lines to draw, and a file of them over time. This needs no dolfinx.

AXIS_FIELDS = ("axis_1", "axis_2", "axis_3")
OF_CHAINS = (
    "cell_dimensions",
    *AXIS_FIELDS,
    "deformation_gradient",
    "fibre_angle",
)  # fields that the lines are made of


def chain_lines(
    centres: ArrayLike, lengths: ArrayLike, axes: ArrayLike, scale: float
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The four chains of unit cells, +-l_1 n_1 +-l_2 n_2 +-l_3 n_3 through each centre (paper, Fig. 2)."""
    middle = np.asarray(centres, dtype=np.float64)
    edges = np.asarray(lengths, dtype=np.float64)[:, :, None] * np.asarray(axes, dtype=np.float64)
    signs = np.array([(1.0, 1, 1), (1, 1, -1), (1, -1, 1), (1, -1, -1)])
    half = scale * (signs @ edges)
    ends = middle[:, None, None, :] + np.stack([half, -half], axis=2)
    return ends.reshape(-1, 3), np.arange(8 * len(middle)).reshape(-1, 2)


def chain_displacement(
    points: ArrayLike, centres: ArrayLike, displacement: ArrayLike, deformation_gradient: ArrayLike
) -> NDArray[np.float64]:
    """Displacement of the ends that `chain_lines` gives, shape (8 m, 3): u + (F - I)(X_end - X_centre)."""
    ends = np.asarray(points, dtype=np.float64).reshape(-1, 8, 3) - np.asarray(centres)[:, None, :]
    gradient = np.asarray(deformation_gradient) - np.eye(3)
    return (np.asarray(displacement)[:, None, :] + ends @ np.swapaxes(gradient, 1, 2)).reshape(-1, 3)


def append_chains(
    grid: TransientGrid | Path,
    time: float,
    centres: NDArray[np.float64],
    scale: float,
    displacement: NDArray[np.float64],
    fields: Mapping[str, NDArray[np.float64]],
) -> TransientGrid:
    """Add a step to a file of chain lines; it is made at its first step, where `grid` is still its path."""
    axes = np.stack([fields[name] for name in AXIS_FIELDS], axis=1)
    points, lines = chain_lines(centres, fields["cell_dimensions"], axes, scale)
    moved = chain_displacement(points, centres, displacement, fields["deformation_gradient"].reshape(-1, 3, 3))
    if isinstance(grid, Path):
        grid = TransientGrid(grid, points, lines, LINE, point_dtype=np.float32)
    angle = np.repeat(fields["fibre_angle"], len(lines) // len(centres))
    grid.append(time, {"displacement": moved}, {"fibre_angle": angle}, points=points)
    return grid
