"""The fields of a reduction, turned to their places in the whole body. This needs no dolfinx."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.body.reductions import Turn
from remodel_fenicsx.results.chain_lines import AXIS_FIELDS

Array = NDArray[np.float64]

DIRECTION_FIELDS = ("axis_c", "axis_a", "axis_r")
TENSOR_FIELDS = ("deformation_gradient", "cauchy_stress")
AT_ONCE = 1_000_000  # distances that are compared at a time


class TurnedFields:
    """Which node and element of a reduction stands for each of a body's own, and its fields there.

    Every element of the body takes the values of the element that stands for it, turned to its place; a node takes
    d = Q (d_0 + (F - I)(Q^T X - X_0)), X_0 the nearest node of the reduction, F of its element, Q the turn.

    Parameters
    ----------
    points, elements
        Of the body, (nodes, 3) and (elements, nodes of one).
    own_points, own_elements
        The same of the reduction.
    turn
        Of the `Reduction`.
    """

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
