"""What a run leaves in its folder: history.csv, fields, the scene as run and a log. Only rank 0 writes.

A checkpoint of displacement, cells and time belongs here too, beside `Fields`; it does not exist yet.
"""

from __future__ import annotations

import csv
import io
import os
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.fem import compat
from remodel_fenicsx.body import Domain
from remodel_fenicsx.results.columns import Observer
from remodel_fenicsx.results.recording import read_history as read_history  # where it was before
from remodel_fenicsx.evolution.stepper import SolvedStep
from remodel_fenicsx.results.vtkhdf import (
    LINE,
    TransientGrid,
    cell_type_and_permutation,
    chain_displacement,
    chain_lines,
)

Array = NDArray[np.float64]

COMMON_COLUMNS = (
    "time",
    "max_chain_extension",
    "min_jacobian",
    "stored_energy",
    "remodeling_power",
    "newton_iterations",
    "linear_iterations",
    "substeps",
    "seconds",
)


def history_row(
    solved: SolvedStep, columns: dict[str, float], stored_energy: float, remodeling_power: float, seconds: float
) -> dict[str, float]:
    """A whole row of the history, in the order of its columns (docs/commands.md).

    Parameters
    ----------
    solved
        The accepted state.
    columns
        Those of the shape (`observables.Observer.columns`).
    stored_energy
        Energy of the solved state.
    remodeling_power
        Energy per time that the remodeling pass released.
    seconds
        Wall time of the step.
    """
    common = (
        solved.time,
        solved.extension.max_chain_extension,
        solved.extension.min_jacobian,
        stored_energy,
        remodeling_power,
        solved.work.newton_iterations,
        solved.work.linear_iterations,
        solved.work.substeps,
        seconds,
    )
    row = dict(zip(COMMON_COLUMNS, common, strict=True))
    return {"time": row.pop("time"), **columns, **row}


class FolderTaken(ValueError):
    """The folder asked for holds something already."""


def choose_folder(requested: Path | None, name: str) -> Path:
    """The folder of a run: the one asked for, which must be new or empty, or the first free results/NAME[-2, -3, ...].

    The one asked for is not made yet; a default one is, so that two runs started at once take two.

    Raises
    ------
    FolderTaken
        If the requested folder is not empty or is no folder.
    OSError
        If the default folder cannot be made.
    """
    if requested is not None:
        if requested.exists() and not requested.is_dir():
            raise FolderTaken(f"-o {requested}: is a file; allowed is a new or an empty folder")
        if requested.is_dir() and any(requested.iterdir()):
            raise FolderTaken(f"-o {requested}: is not empty; allowed is a new or an empty folder")
        return requested
    Path("results").mkdir(exist_ok=True)
    number, folder = 1, Path("results") / name
    while True:
        try:
            folder.mkdir()
        except FileExistsError:
            number += 1
            folder = Path("results") / f"{name}-{number}"
        else:
            return folder


def chosen_folder(requested: Path | str | None, name: str, comm: MPI.Intracomm) -> Path:
    """`choose_folder` on rank 0, its folder or its refusal on all ranks. Collective.

    Raises
    ------
    FolderTaken, OSError
        As `choose_folder` does, on all ranks.
    """
    verdict: Path | FolderTaken | OSError | None = None
    if comm.rank == 0:
        try:
            verdict = choose_folder(None if requested is None else Path(requested), name)
        except (FolderTaken, OSError) as refusal:
            verdict = refusal
    verdict = comm.bcast(verdict)
    if isinstance(verdict, Exception):
        raise verdict
    assert verdict is not None
    return verdict


class History:
    """history.csv: one row per accepted step, complete on disk as soon as the step is accepted."""

    def __init__(self, path: Path):
        self._file = path.open("xb", buffering=0)
        self._columns: list[str] | None = None
        self._size = 0  # bytes of whole rows

    def append(self, row: dict[str, float]) -> None:
        """Write one row; the first one decides the columns.

        Raises
        ------
        OSError
            If the row could not be written (disk full); the file then ends with the row before.
        ValueError
            If the row has other columns than the first one.
        """
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, fieldnames=self._columns or list(row), lineterminator="\n")
        if self._columns is None:
            writer.writeheader()
        writer.writerow({key: _number(value) for key, value in row.items()})
        self._write(text.getvalue().encode())
        self._columns = list(writer.fieldnames)

    def _write(self, data: bytes) -> None:
        """All of it or nothing: a number that was cut short would read as another number."""
        view = memoryview(data)
        try:
            while view:
                view = view[self._file.write(view) :]
            os.fsync(self._file.fileno())
        except OSError:
            self._file.truncate(self._size)
            self._file.seek(self._size)
            raise
        self._size += len(data)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _number(value: float) -> str:
    """Shortest text that reads back as the same number."""
    return str(value) if isinstance(value, int) else repr(float(value))


class Fields:
    """Time series of fields: fields.vtkhdf (the mesh) and fields_chains.vtkhdf (four chain lines per element).

    Both open in ParaView (5.12 or later) and PyVista as one time series. Nodes and cells stand in the mesh file's
    order, whatever the number of ranks.
    """

    def __init__(self, folder: Path, domain: Domain, observer: Observer):
        self.domain, self.observer = domain, observer
        self._displacement = NodalGather(domain, observer.displacement)
        points, cells = domain.gather_mesh()
        volume = observer.quadrature.integral(np.ones(observer.quadrature.shape))
        self._grid: TransientGrid | None = None
        self._chains: TransientGrid | None = None
        if points is not None and cells is not None:
            geometry = domain.mesh.geometry.cmap
            cell_type, order = cell_type_and_permutation(domain.mesh.topology.cell_name(), geometry.degree)
            self._grid = TransientGrid(folder / "fields.vtkhdf", points, cells[:, order], cell_type)
            self._centres = points[cells].mean(axis=1)
            self._cells = cells
            # a chain reaches half of the smallest mean distance between elements, so that pictures stay readable
            self._scale = 0.4 * (volume / len(cells)) ** (1 / 3)

    def append(self, time: float) -> None:
        """Write the present state as the state of `time`."""
        displacement = self._displacement()
        gathered = {name: self.domain.gather_cells(values) for name, values in self.observer.cell_fields().items()}
        if self._grid is None or displacement is None:
            return
        fields = {name: values for name, values in gathered.items() if values is not None}
        self._grid.append(time, {"displacement": displacement}, fields)
        self._append_chains(time, displacement, fields)

    def _append_chains(self, time: float, displacement: Array, fields: dict[str, Array]) -> None:
        axes = np.stack([fields[f"axis_{i + 1}"] for i in range(3)], axis=1)
        points, lines = chain_lines(self._centres, fields["cell_dimensions"], axes, self._scale)
        gradient = fields["deformation_gradient"].reshape(-1, 3, 3)
        moved = chain_displacement(points, self._centres, displacement[self._cells].mean(axis=1), gradient)
        if self._chains is None:
            assert self._grid is not None
            self._chains = TransientGrid(
                self._grid.path.with_name("fields_chains.vtkhdf"), points, lines, LINE, point_dtype=np.float32
            )
        angle = np.repeat(fields["fibre_angle"], len(lines) // len(self._centres))
        self._chains.append(time, {"displacement": moved}, {"fibre_angle": angle}, points=points)

    def close(self) -> None:
        """Close the files."""
        for grid in (self._grid, self._chains):
            if grid is not None:
                grid.close()


class NodalGather:
    """Gathers a vector function's values at the mesh nodes to rank 0, in the mesh file's order."""

    def __init__(self, domain: Domain, function: Any):
        self.domain, self.function = domain, function
        dofs = function.function_space.dofmap.list.reshape(-1)
        nodes = compat.geometry_dofmap(domain.mesh).reshape(-1)
        # the element and the geometry have the same degree: node k of a cell is dof k of that cell
        self._dof_of_node = np.zeros(len(domain.node_number), dtype=np.int64)
        self._dof_of_node[nodes] = dofs

    def __call__(self) -> Array | None:
        values = self.function.x.array.reshape(-1, 3)[self._dof_of_node]
        return self.domain.gather_nodes(values)


class RunFolder:
    """A run's folder, open for writing.

    Parameters
    ----------
    folder
        Must not hold a run; it is made with its parents.
    scene_text
        The scene as run, written to scene.toml.
    rank
        Rank in the communicator: all but rank 0 write nothing.

    Raises
    ------
    OSError
        If the folder cannot be made or written.
    """

    def __init__(self, folder: Path, scene_text: str, rank: int = 0):
        self.folder = Path(folder)
        self.history: History | None = None
        self.fields: Fields | None = None
        if rank == 0:
            self.folder.mkdir(parents=True, exist_ok=True)
            with (self.folder / "scene.toml").open("x", encoding="utf-8") as file:
                file.write(scene_text)
                file.flush()
                os.fsync(file.fileno())
            self.history = History(self.folder / "history.csv")

    def append(self, row: dict[str, float]) -> None:
        """Write a row of the history."""
        if self.history is not None:
            self.history.append(row)

    def close(self) -> None:
        """Close all files."""
        try:
            if self.history is not None:
                self.history.close()
        finally:
            if self.fields is not None:
                self.fields.close()

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
