"""What the figures take from a recording: the body at a time, and its layers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.results.recording import Recording

Array = NDArray[np.float64]
Table = dict[str, NDArray[Any]]  # columns by name, all of one length

# faces of VTK's hexahedron, by its local nodes
_FACES = np.array([(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)])


@dataclass(frozen=True)
class Snapshot:
    """A body of hexahedra at one time.

    Attributes
    ----------
    time
    points, displacement
        Reference coordinates and displacements of the nodes, (nodes, 3).
    elements
        Nodes of the elements in VTK's order, (elements, 8).
    fields
        Means over the elements, by name (docs/commands.md): (elements,) or (elements, n).
    """

    time: float
    points: Array
    elements: NDArray[np.int64]
    displacement: Array
    fields: dict[str, Array]

    @classmethod
    def of(cls, run: Recording, time: float) -> Snapshot:
        """The solved state of a run at a recorded time.

        Raises
        ------
        RecordingError
            If there is none.
        """
        fields = run.fields(time)
        return cls(time, run.points, run.elements, fields.pop("displacement"), fields)

    @property
    def centres(self) -> Array:
        """Reference centres of the elements, (elements, 3)."""
        return self.points[self.elements].mean(axis=1)

    @property
    def deformed(self) -> Array:
        """Deformed coordinates of the nodes, (nodes, 3)."""
        return self.points + self.displacement

    def exterior(self, shown: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Faces of the shown elements (elements,) that no other shown element covers: nodes (m, 4), elements (m,)."""
        elements = np.flatnonzero(shown)
        faces = self.elements[elements][:, _FACES].reshape(-1, 4)
        _, number, count = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
        alone = count[np.ravel(number)] == 1
        return faces[alone], np.repeat(elements, len(_FACES))[alone]


def rank_of(values: Array) -> NDArray[np.int64]:
    """Number of each value among the distinct ones, ascending, from 0: layers, rows or columns of a regular mesh."""
    ordered = np.sort(values)
    starts = np.concatenate([[True], np.diff(ordered) > 1e-6 * (ordered[-1] - ordered[0])])
    return np.searchsorted(ordered[starts], values + 1e-7 * (ordered[-1] - ordered[0])) - 1


def radii(points: Array, elements: NDArray[np.int64]) -> Array:
    """Mean distance of each element's nodes from the z axis, (elements,)."""
    return np.linalg.norm(points[:, :2], axis=1)[elements].mean(axis=1)


def layers(snapshot: Snapshot) -> NDArray[np.int64]:
    """Number of each element's layer in the wall of a tube, from the inside, (elements,)."""
    return rank_of(radii(snapshot.points, snapshot.elements))
