"""The fields of a reduced run in the whole body: revolved about z, mirrored or extended, as its kinematics mean it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from mpi4py import MPI

from remodel_fenicsx.body.reductions import Turn
from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.results.turned import OF_CHAINS, TurnedFields, append_chains
from remodel_fenicsx.results.recording import RecordedRun, RecordingError
from remodel_fenicsx.system.files import part_of
from remodel_fenicsx.results.vtkhdf import TransientGrid, vtk_cells

BODY, BODY_CHAINS = "fields_body.vtkhdf", "fields_body_chains.vtkhdf"


def revolve(folder: Path | str) -> list[Path]:
    """Write the recorded fields of a reduced run on the mesh of the whole body that its scene asks for. One process."""
    recording = RecordedRun(folder)
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
    parts = [part_of(path) for path in paths]
    for part in parts:
        part.unlink(missing_ok=True)  # of one that was killed
    with TransientGrid(parts[0], image.points, image.cells, image.cell_type) as grid:
        chains: TransientGrid | None = None
        for time in recording.times:
            displacement, fields = image(recording.fields(float(time)))
            grid.append(float(time), {} if displacement is None else {"displacement": displacement}, fields)
            if displacement is not None and set(OF_CHAINS) <= set(fields):
                middle = displacement[image.elements].mean(axis=1)
                chains = append_chains(chains or parts[1], float(time), image.centres, image.scale, middle, fields)
        if chains is not None:
            chains.close()
    written = [path for part, path in zip(parts, paths, strict=True) if part.exists()]
    for path in reversed(written):  # the body last: where it is, all are
        part_of(path).rename(path)
    return written


class _Image(TurnedFields):
    """The body's mesh, and the fields on it."""

    def __init__(self, recording: RecordedRun, turn: Turn):
        scene = recording.scene
        domain = scene.geometry.build_with(scene.regions, scene.mesh, MPI.COMM_SELF)
        points, elements = domain.gather_mesh()
        assert points is not None and elements is not None
        super().__init__(points, elements, recording.points, recording.elements, turn)
        self.points, self.elements = points, elements
        kind = domain.mesh.topology.cell_name()
        self.cell_type, self.cells = vtk_cells(kind, domain.mesh.geometry.cmap.degree, elements)
        extents = np.ptp(points, axis=0)
        self.scale = 0.4 * float(np.prod(extents) / len(elements)) ** (1 / 3)
