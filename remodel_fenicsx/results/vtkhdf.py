"""Time series on an unstructured grid in one VTKHDF file, for ParaView (from 5.12) and PyVista.

The format: https://docs.vtk.org/en/latest/vtk_file_formats/vtkhdf_file_format, version 2.2, type
UnstructuredGrid, one partition. The mesh is written once; each step appends its point and cell
data, and its points if they move. Serial: in a parallel run rank 0 writes arrays that were gathered
in the mesh file's order.
"""

from __future__ import annotations

import errno
import io
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from remodel_fenicsx.results.recording import series_file
from remodel_fenicsx.system.files import ClosedAtEnd, partial_path
from remodel_fenicsx.system.interrupts import held_back

if TYPE_CHECKING:
    from collections.abc import Buffer
    import h5py

Array = NDArray[Any]
Fields = Mapping[str, ArrayLike]

VERSION = (2, 2)
# cell name of dolfinx: type of VTK for degree 1, for any higher degree ("Lagrange")
CELL_TYPES = {
    "interval": (3, 68),
    "triangle": (5, 69),
    "quadrilateral": (9, 70),
    "tetrahedron": (10, 71),
    "hexahedron": (12, 72),
}
LINE = 3
_STEPS_PER_CHUNK = 256
_OF_TOPOLOGY = ("Steps/CellOffsets", "Steps/ConnectivityIdOffsets")
_ALWAYS_0 = ("Steps/PartOffsets", *_OF_TOPOLOGY)  # of each step
# of the mesh, which is written once; shuffle and deflate are built into every HDF5. Fields are not
# compressed: noisy floats become smaller by a fifth only, and a step would take twice as long
_COMPRESSION: dict[str, object] = {
    "compression": "gzip",
    "compression_opts": 1,
    "shuffle": True,
    "fletcher32": True,
}


class DeferredErrorFile(io.FileIO):
    """File below h5py that defers errors until HDF5 has returned: HDF5 would crash the process."""

    fault: OSError | None = None

    def write(self, data: Buffer) -> int:
        view = memoryview(data)
        try:
            while view:
                view = view[super().write(view) :]
        except OSError as error:
            self.fault = error
        return memoryview(data).nbytes

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size)
        except OSError as error:  # longer than files may be
            self.fault = error
            return self.tell()

    def check(self) -> None:
        """Raise the deferred error, if there is one."""
        if self.fault is not None:
            raise self.fault


class TransientGrid(ClosedAtEnd):
    """A time series on one grid, written to a partial file; `close` gives it its name."""

    def __init__(
        self,
        path: Path,
        points: ArrayLike,
        cells: ArrayLike,
        cell_type: int,
        *,
        point_dtype: DTypeLike = np.float64,
    ):
        if os.path.lexists(path):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
        self.path, self._part = path, partial_path(path)
        self._part.unlink(missing_ok=True)  # of a process that was killed
        self.number_of_steps = 0
        self._open("x+")
        with self._written() as file:
            _begin(
                file.create_group("VTKHDF"),
                np.asarray(points, point_dtype),
                np.asarray(cells),
                cell_type,
            )

    @classmethod
    def continued(cls, path: Path, time: float) -> TransientGrid:
        """Open a copy of a file with its steps up to `time`, to append more."""
        grid = cls.__new__(cls)
        grid.path, grid._part = path, partial_path(path)
        grid._part.unlink(missing_ok=True)
        grid._reopen()
        with grid._written() as file:
            steps = file["VTKHDF/Steps"]
            times = steps["Values"][: steps.attrs["NSteps"]]
            grid.number_of_steps = int(np.searchsorted(times, time, side="right"))
            steps.attrs.modify("NSteps", np.int64(grid.number_of_steps))
        return grid

    def _reopen(self) -> None:
        shutil.copyfile(self.path, self._part)
        self._open("r+")

    def _open(self, mode: str) -> None:
        import h5py

        self._disk = DeferredErrorFile(self._part, mode)
        self._file = h5py.File(self._disk, "w" if mode == "x+" else "r+")

    @contextmanager
    def _written(self) -> Iterator[h5py.File]:
        """Hold back signals while HDF5 writes: a handler might raise in the file's `write`."""
        with held_back():
            yield self._file
            self._file.flush()
        self._disk.check()

    def append(
        self,
        time: float,
        point_data: Fields | None = None,
        cell_data: Fields | None = None,
        points: ArrayLike | None = None,
        constant: Fields | None = None,
    ) -> None:
        """Append one step; pass points at every step or at none."""
        if self._disk.closed:
            self._reopen()
        step = self.number_of_steps
        kinds = (
            ("PointData", point_data, step),
            ("CellData", cell_data, step),
            ("CellData", constant, 0),
        )
        # offsets that stay 0 mean that the mesh is the one of the first step
        numbers: dict[str, float] = dict.fromkeys(_ALWAYS_0, 0)
        numbers |= {"Steps/NumberOfParts": 1, "Steps/PointOffsets": 0, "Steps/Values": time}
        with self._written() as file:
            root = file["VTKHDF"]
            for kind, fields, place in kinds:
                for name, block in (
                    (f"{kind}/{name}", np.asarray(values))
                    for name, values in (fields or {}).items()
                ):
                    if name not in root:  # a chunk is a step, which readers take as a whole
                        _create(root, name, np.float32, block.shape)
                        _create(root, _offsets(name), np.int64, (_STEPS_PER_CHUNK,))
                    _write(root[name], place, block)
                    _write(root[_offsets(name)], step, [place * len(block)])
            if points is not None:  # block 0 is the reference configuration
                _write(root["Points"], step + 1, points)
                numbers["Steps/PointOffsets"] = (step + 1) * len(np.asarray(points))
            for name, number in numbers.items():
                columns = (1,) if name in _OF_TOPOLOGY else ()  # one for each kind of topology
                _write(root[name], step, np.full((1, *columns), number))
            root["Steps"].attrs.modify("NSteps", np.int64(step + 1))
            self.number_of_steps = step + 1

    def __exit__(self, *error: object) -> None:
        if error[0] is not None:  # not complete
            with held_back():
                self._file.close()
            self._disk.close()
        self.close()

    def close(self) -> None:
        """Give the file its name, if it is complete; a next step continues in a copy."""
        try:
            if not self._disk.closed:
                with held_back():
                    self._file.close()
                self._disk.check()
                os.fsync(self._disk.fileno())
                self._part.replace(self.path)
        finally:  # an incomplete file is removed
            self._disk.close()
            self._part.unlink(missing_ok=True)


def _begin(root: h5py.Group, points: Array, cells: Array, cell_type: int) -> None:
    """Write the mesh, and no steps."""
    root.attrs["Version"] = np.array(VERSION, dtype=np.int64)
    root.attrs["Type"] = np.bytes_("UnstructuredGrid")  # VTK takes fixed-length ASCII only
    for name, number in {
        "Points": len(points),
        "Cells": len(cells),
        "ConnectivityIds": cells.size,
    }.items():
        root[f"NumberOf{name}"] = np.array([number], dtype=np.int64)
    _create(root, "Points", points.dtype, points.shape)
    _write(root["Points"], 0, points)
    kinds = np.full(len(cells), cell_type, dtype=np.uint8)
    root.create_dataset("Connectivity", data=cells.astype(np.int64).ravel(), **_COMPRESSION)
    root.create_dataset("Offsets", data=cells.shape[1] * np.arange(len(cells) + 1), **_COMPRESSION)
    root.create_dataset("Types", data=kinds, **_COMPRESSION)
    for group in ("PointData", "CellData", "Steps/PointDataOffsets", "Steps/CellDataOffsets"):
        root.create_group(group)
    _create(root, "Steps/Values", np.float64, (_STEPS_PER_CHUNK,))
    for name in ("Steps/NumberOfParts", "Steps/PointOffsets", *_ALWAYS_0):
        columns = (1,) if name in _OF_TOPOLOGY else ()
        _create(root, name, np.int64, (_STEPS_PER_CHUNK, *columns))
    root["Steps"].attrs["NSteps"] = np.int64(0)


def _offsets(field: str) -> str:
    """Return the name of the dataset with the offsets of a field."""
    return "Steps/" + field.replace("/", "Offsets/", 1)


def _create(group: h5py.Group, name: str, dtype: DTypeLike, chunk: tuple[int, ...]) -> None:
    """Create an empty dataset that grows by rows, with a check sum of every chunk."""
    shape = (0, *chunk[1:]), dtype
    group.create_dataset(name, *shape, maxshape=(None, *chunk[1:]), chunks=chunk, fletcher32=True)


def _write(dataset: h5py.Dataset, number: int, block: ArrayLike) -> None:
    """Write a block of rows, the last one of a dataset whose blocks have this one's length."""
    start, rows = number * len(np.asarray(block)), len(np.asarray(block))
    dataset.resize(start + rows, axis=0)
    dataset[start:] = block


def vtk_cells(
    cell_name: str, degree: int, elements: NDArray[np.int64]
) -> tuple[int, NDArray[np.int64]]:
    """Return VTK's cell type, and the elements with their nodes in VTK's order."""
    # here and not above: whoever reads or writes lines alone need not wait for dolfinx
    from dolfinx import cpp
    from dolfinx.mesh import to_type

    from_vtk = cpp.io.perm_vtk(to_type(cell_name), elements.shape[1])
    return CELL_TYPES[cell_name][degree > 1], elements[:, np.argsort(from_vtk)]


# ---------------------------------------------------------------- untrusted files

WITHOUT_IT = "; without this file the run can continue"


def check_series(path: Path) -> None:
    """Read all of a file of `TransientGrid`. Raise an error for any invalid content."""
    with series_file(path, WITHOUT_IT) as root:
        number = int(root["Steps"].attrs["NSteps"])
        times = root["Steps/Values"][:number]
        if len(times) != number or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
            raise ValueError("the times of its steps do not increase")
        _ = root["Connectivity"][:]
        places = dict.fromkeys(root["Steps/PointOffsets"][:number])
        sizes = {kind: int(root[f"NumberOf{kind}s"][0]) for kind in ("Point", "Cell")}
        blocks = [("Points", root["Points"], place, sizes["Point"]) for place in places]
        for kind, size in sizes.items():
            for name in root[f"{kind}Data"]:
                values = root[f"{kind}Data"][name]
                starts = root[f"Steps/{kind}DataOffsets"][name][:number]
                if len(starts) != number or not {*starts} <= {0, *range(0, number * size, size)}:
                    raise ValueError(f"the values of {name} are not where they belong")
                blocks += [(name, values, start, size) for start in dict.fromkeys(starts)]
        for name, values, start, size in blocks:
            if values.is_virtual or values.external or len(values[start : start + size]) != size:
                raise ValueError(f"the values of {name} are not where they belong")
