"""Reading back what a run has recorded: its history, its fields at a time, what it was made with."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.results.run_folder import read_history
from remodel_fenicsx.scene.scene import Scene, SceneError, read_scene

Array = NDArray[np.float64]
Table = dict[str, NDArray[Any]]  # columns by name, all of one length

# faces of VTK's hexahedron, by its local nodes
_FACES = np.array([(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)])


@dataclass(frozen=True)
class Recording:
    """A recorded run.

    Parameters
    ----------
    folder
        What `remodel-fenicsx run -o` was given.
    """

    folder: Path

    @cached_property
    def scene(self) -> Scene:
        """The scene as run."""
        return read_scene(self.folder / "scene.toml")

    @cached_property
    def history(self) -> dict[str, Array]:
        """Columns of history.csv."""
        return read_history(self.folder)

    @cached_property
    def versions(self) -> dict[str, str]:
        """Versions that the run wrote on top of its scene, by name."""
        lines = (self.folder / "scene.toml").read_text(encoding="utf-8").splitlines()
        comments = [line[1:].strip() for line in lines[: lines.index("")]]
        return dict(line.split(" ", 1) for line in comments[1:] if " " in line)

    @property
    def first_cells(self) -> str:
        """How the cells were at first, in words."""
        cells = self.scene.cells
        return f"random cells of seed {cells.seed}" if cells.initial == "random" else f"{cells.initial} cells"

    def made_with(self, cells: str | None = None) -> str:
        """Package, library and scene of the run, in a line; `cells` says more than `first_cells` of this run alone."""
        scene, versions = self.scene, self.versions
        libraries = ", ".join(f"{name} {versions.get(name, '?')}" for name in ("remodel_fenicsx", "dolfinx"))
        return f"{libraries}; preset {scene.preset}, frame {scene.remodeling.frame}, {cells or self.first_cells}"

    def fault(self, scene: Scene) -> str | None:
        """Why this is not the whole record of a scene, in words; None: it is."""
        try:
            if self.scene != scene:
                return "it is of another scene"
            step, steps = scene.time.step, scene.time.number_of_steps
            if not _same_times(self.history["time"], step * np.arange(1, steps + 1)):
                return "history.csv has not the rows of all steps"
            if scene.output.fields:
                every = scene.output.every
                recorded = sorted({*range(0, steps + 1, every), steps})
                return self._fault_of_fields(step * np.array(recorded))
        except (SceneError, OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
            return " ".join(f"{type(error).__name__}: {error}".split())
        return None

    def _fault_of_fields(self, times: NDArray[Any]) -> str | None:
        with h5py.File(self.folder / "fields.vtkhdf") as file:
            root, steps = file["VTKHDF"], file["VTKHDF/Steps"]
            if not _same_times(steps["Values"][:], times):
                return "fields.vtkhdf has not all times"
            for kind, unit in (("PointData", "Points"), ("CellData", "Types")):
                for name, values in root[kind].items():
                    if len(values) < int(steps[f"{kind}Offsets"][name][-1]) + len(root[unit]):
                        return f"fields.vtkhdf lacks values of {name}"
        self.snapshot(float(times[-1]))
        return None

    def value(self, column: str, time: float) -> float:
        """A column of the history at a recorded time."""
        row = int(np.argmin(np.abs(self.history["time"] - time)))
        if abs(self.history["time"][row] - time) > 1e-9 * max(1.0, time):
            raise KeyError(f"{self.folder}: no row at time {time}")
        return float(self.history[column][row])

    def snapshot(self, time: float) -> Snapshot:
        """The fields of the solved state at a recorded time.

        Raises
        ------
        KeyError
            If there are none.
        """
        with h5py.File(self.folder / "fields.vtkhdf") as file:
            root, steps = file["VTKHDF"], file["VTKHDF/Steps"]
            found = np.flatnonzero(np.abs(steps["Values"][:] - time) <= 1e-9 * max(1.0, time))
            if not len(found):
                raise KeyError(f"{self.folder}: no fields at time {time}")
            points, offsets = root["Points"][:], root["Offsets"][:]
            cells = root["Connectivity"][:].reshape(len(offsets) - 1, -1)

            def block(kind: str, name: str, length: int) -> Array:
                start = int(steps[f"{kind}Offsets"][name][found[0]])
                return np.asarray(root[kind][name][start : start + length], dtype=float)

            fields = {name: block("CellData", name, len(cells)) for name in root["CellData"]}
            displacement = block("PointData", "displacement", len(points))
        return Snapshot(time, np.asarray(points, dtype=float), cells, displacement, fields)


@dataclass(frozen=True)
class Snapshot:
    """A body of hexahedra at one time.

    Attributes
    ----------
    time
    points, displacement
        Reference coordinates and displacements of the nodes, (nodes, 3).
    cells
        Nodes of the elements in VTK's order, (elements, 8).
    fields
        Means over the elements, by name (docs/contract): (elements,) or (elements, n).
    """

    time: float
    points: Array
    cells: NDArray[np.int64]
    displacement: Array
    fields: dict[str, Array]

    @property
    def centres(self) -> Array:
        """Reference centres of the elements, (elements, 3)."""
        return self.points[self.cells].mean(axis=1)

    @property
    def deformed(self) -> Array:
        """Deformed coordinates of the nodes, (nodes, 3)."""
        return self.points + self.displacement

    def exterior(self, shown: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Faces of the shown elements (elements,) that no other shown element covers: nodes (m, 4), elements (m,)."""
        elements = np.flatnonzero(shown)
        faces = self.cells[elements][:, _FACES].reshape(-1, 4)
        _, number, count = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
        alone = count[np.ravel(number)] == 1
        return faces[alone], np.repeat(elements, len(_FACES))[alone]


def _same_times(found: NDArray[Any], wanted: NDArray[Any]) -> bool:
    return found.shape == wanted.shape and bool(np.allclose(found, wanted, rtol=1e-9, atol=0.0))


def rank_of(values: Array) -> NDArray[np.int64]:
    """Number of each value among the distinct ones, ascending, from 0: layers, rows or columns of a regular mesh."""
    ordered = np.sort(values)
    starts = np.concatenate([[True], np.diff(ordered) > 1e-6 * (ordered[-1] - ordered[0])])
    return np.searchsorted(ordered[starts], values + 1e-7 * (ordered[-1] - ordered[0])) - 1


def radii(points: Array, cells: NDArray[np.int64]) -> Array:
    """Mean distance of each element's nodes from the z axis, (elements,)."""
    return np.linalg.norm(points[:, :2], axis=1)[cells].mean(axis=1)


def layers(snapshot: Snapshot) -> NDArray[np.int64]:
    """Number of each element's layer in the wall of a tube, from the inside, (elements,)."""
    return rank_of(radii(snapshot.points, snapshot.cells))
