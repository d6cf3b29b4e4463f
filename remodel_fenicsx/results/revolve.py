"""The fields of a reduced run in the whole body: revolved about z, mirrored or extended, as its kinematics mean it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.body.reductions import Turn
from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.results.chain_lines import AXIS_FIELDS, OF_CHAINS, append_chains
from remodel_fenicsx.results.recording import Recording, RecordingError
from remodel_fenicsx.results.vtkhdf import TransientGrid, vtk_cells

Array = NDArray[np.float64]

BODY, BODY_CHAINS = "fields_body.vtkhdf", "fields_body_chains.vtkhdf"
TENSOR_FIELDS = ("deformation_gradient", "cauchy_stress")
AT_ONCE = 1_000_000  # distances that are compared at a time


def revolve(folder: Path | str) -> list[Path]:
    """Write the recorded fields of a reduced run on the mesh of the whole body that its scene asks for. One process.

    Every element of the body takes the values of the element that stands for it, turned to its place; a node takes
    d = Q (d_0 + (F - I)(Q^T X - X_0)), X_0 the nearest node of the reduction, F of its element, Q the turn.

    Parameters
    ----------
    folder
        Of a run; it may still be under way.

    Returns
    -------
    The files: fields_body.vtkhdf, and fields_body_chains.vtkhdf where the cells were recorded.

    Raises
    ------
    RecordingError
        If it is no run of a reduced kinematics with fields, or the files are there already.
    """
    recording = Recording(folder)
    name = recording.scene.model.kinematics
    if name not in KINEMATICS or not KINEMATICS[name].reduced:
        raise RecordingError(f"{recording.path}: its kinematics are {name!r}: the fields are those of the body already")
    paths = [recording.path / file for file in (BODY, BODY_CHAINS)]
    for path in paths:
        if path.exists():
            raise RecordingError(f"{path}: is there already; nothing is overwritten")
    if not len(recording.times):
        raise RecordingError(f"{recording.path}: the run recorded no fields")
    image = _Image(recording, recording.scene.geometry.reductions[name].turn)
    with TransientGrid(paths[0], image.points, image.cells, image.cell_type) as grid:
        chains: TransientGrid | None = None
        for time in recording.times:
            displacement, fields = image(recording.fields(float(time)))
            grid.append(float(time), {} if displacement is None else {"displacement": displacement}, fields)
            if displacement is not None and set(OF_CHAINS) <= set(fields):
                middle = displacement[image.elements].mean(axis=1)
                chains = append_chains(chains or paths[1], float(time), image.centres, image.scale, middle, fields)
        if chains is not None:
            chains.close()
    return paths if chains is not None else paths[:1]


class _Image:
    """The body's mesh, and which node and element of the reduction stands for each of its own."""

    def __init__(self, recording: Recording, turn: Turn):
        scene = recording.scene
        domain = scene.geometry.build(scene.mesh, MPI.COMM_SELF)
        points, elements = domain.gather_mesh()
        assert points is not None and elements is not None
        self.points, self.elements = points, elements
        kind = domain.mesh.topology.cell_name()
        self.cell_type, self.cells = vtk_cells(kind, domain.mesh.geometry.cmap.degree, elements)
        self.turns = turn(points)
        own_points, own_elements = recording.points, recording.elements
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
        extents = np.ptp(points, axis=0)
        self.scale = 0.4 * float(np.prod(extents) / len(elements)) ** (1 / 3)

    def __call__(self, fields: dict[str, Array]) -> tuple[Array | None, dict[str, Array]]:
        """Displacement of the body's nodes, where it was recorded, and fields of its elements."""
        found = {name: values[self.sources] for name, values in fields.items() if name != "displacement"}
        for name in set(found) & set(AXIS_FIELDS):
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
