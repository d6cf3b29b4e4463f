"""Fields on an unstructured grid over time in one VTKHDF file, which ParaView (from 5.12) and PyVista open as a series.

The format: https://docs.vtk.org/en/latest/vtk_file_formats/vtkhdf_file_format, version 2.2, type UnstructuredGrid, one
partition. The mesh is written once; each step appends its point and cell data, and its points if they move. Serial: in
a parallel run rank 0 writes arrays that were gathered in the mesh file's order.
"""

from __future__ import annotations

import io
import os
import signal
import struct
import threading
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from remodel_fenicsx.results.recording import RecordingError
from remodel_fenicsx.system.files import ClosedAtEnd, open_own

if TYPE_CHECKING:
    import h5py


# ---------------------------------------------------------------- a file that a full disk or a kill cannot spoil
# HDF5 changes a few bytes in the middle of a file at each step. They stand behind its end before they are changed, in
# this format since 0.1.0: a run that was killed meanwhile goes on.

_CHANGE = struct.Struct("<QQ")  # offset and length, before the bytes
_END = struct.Struct("<QI8s")  # length and check sum of the changes before it
_MARK = b"remodel1"


@contextmanager
def signals_held_back() -> Iterator[None]:
    """Let Python's signal handlers run after the block: an exception below HDF5 would crash the process."""
    numbers = signal.valid_signals() if threading.current_thread() is threading.main_thread() else ()
    handlers = {int(number): handler for number in numbers if callable(handler := signal.getsignal(number))}
    caught: list[int] = []
    try:
        for number in handlers:
            signal.signal(number, lambda number, _: caught.append(number))
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for number in caught:
            signal.raise_signal(number)


class StagedFile(io.RawIOBase):
    """The file below h5py: what HDF5 writes waits in memory until `commit`."""

    def __init__(self, path: Path, existing: bool = False):
        self._descriptor = -1
        super().__init__()
        self._descriptor = open_own(path, os.O_RDWR | (0 if existing else os.O_CREAT | os.O_EXCL))
        if existing:
            self._finish_changes()
        self._committed = self._end = os.fstat(self._descriptor).st_size
        self._writes: list[tuple[int, bytes]] = []  # what waits, in order
        self._position = 0

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._position = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._end}[whence]
        return self._position

    def readinto(self, buffer: Any) -> int:
        start, size = self._position, max(0, min(len(buffer), self._end - self._position))
        data = bytearray(os.pread(self._descriptor, size, start).ljust(size, b"\0"))
        for offset, change in self._writes:
            low, high = max(start, offset), min(start + size, offset + len(change))
            if low < high:
                data[low - start : high - start] = change[low - offset : high - offset]
        buffer[:size] = data
        self._position += size
        return size

    def write(self, buffer: Any) -> int:
        data = bytes(buffer)
        self._writes.append((self._position, data))
        self._position += len(data)
        self._end = max(self._end, self._position)
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        # a file that is longer than its header says is valid: what is on the disk stays
        self._end = max(self._committed, self._position if size is None else size)
        return self._end

    def commit(self) -> None:
        """Bring everything to the disk, or raise OSError and keep it for the next time."""
        changes: list[tuple[int, bytes]] = []
        tail = bytearray(self._end - self._committed)
        for offset, data in self._writes:
            old = max(0, min(len(data), self._committed - offset))
            changes += [(offset, data[:old])] if old else []
            start = offset + old - self._committed
            tail[start : start + len(data) - old] = data[old:]
        # HDF5's superblock, at offset 0, says how long the file is: first, for chunk indices will name the new end
        changes.sort(key=lambda change: change[0] > 0)
        try:
            self._write_all(self._committed, tail + _journal(changes))
            os.fdatasync(self._descriptor)  # some file systems find out only now that they are full
        except OSError:
            os.ftruncate(self._descriptor, self._committed)
            raise
        self._make_changes(changes, self._end)
        self._committed, self._writes = self._end, []

    def _make_changes(self, changes: list[tuple[int, bytes]], end: int) -> None:
        """Write over the old part, and only then forget what was to be written, which stands behind `end`."""
        for offset, change in changes:
            self._write_all(offset, change)
        if changes:
            os.fdatasync(self._descriptor)
            os.ftruncate(self._descriptor, end)

    def _finish_changes(self) -> None:
        """Make the changes of a commit that was cut off."""
        size = os.fstat(self._descriptor).st_size
        end = os.pread(self._descriptor, _END.size, max(0, size - _END.size))
        length, check_sum, mark = _END.unpack(end) if len(end) == _END.size else (0, 0, b"")
        start = size - _END.size - length
        if mark != _MARK or start < 0:
            return
        journal = os.pread(self._descriptor, length, start)
        if zlib.crc32(journal) != check_sum:
            return
        changes, position = [], 0
        while position < length:
            offset, count = _CHANGE.unpack_from(journal, position)
            position += _CHANGE.size + count
            changes.append((offset, journal[position - count : position]))
        self._make_changes(changes, start)

    def close(self) -> None:
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)
        super().close()

    def _write_all(self, offset: int, data: bytes | bytearray) -> None:
        view = memoryview(data)
        while view:
            written = os.pwrite(self._descriptor, view, offset)
            view, offset = view[written:], offset + written


def _journal(changes: list[tuple[int, bytes]]) -> bytes:
    """Changes as bytes; nothing for none."""
    if not changes:
        return b""
    whole = b"".join(_CHANGE.pack(offset, len(change)) + change for offset, change in changes)
    return whole + _END.pack(len(whole), zlib.crc32(whole), _MARK)


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
_LARGEST_RATIO = 1100  # deflate makes nothing smaller than a 1032nd: a block that claims more is not there
_ROWS_AT_ONCE = 10**6  # values that are read together where a whole file is checked
# with these bounds HDF5 sets no "open for writing" mark, which a killed process would leave for ever
_VERSIONS = ("earliest", "v110")
# of the mesh, which is written once; shuffle and deflate are built into every HDF5. Fields are not compressed: noisy
# floats become smaller by a fifth only, and a step would take twice as long
_COMPRESSION: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True, "fletcher32": True}


class TransientGrid(ClosedAtEnd):
    """A time series on one grid; the file is whole after the constructor and after every `append`."""

    def __init__(
        self,
        path: Path,
        points: ArrayLike,
        cells: ArrayLike,
        cell_type: int,
        *,
        point_dtype: DTypeLike = np.float64,
    ):
        with self._opened(path, "w"):
            self._make(np.asarray(points, dtype=point_dtype), np.asarray(cells, dtype=np.int64), cell_type)

    @classmethod
    def continued(cls, path: Path, time: float) -> TransientGrid:
        """Open a file again, to append after its steps up to `time`; later ones are dropped."""
        grid = cls.__new__(cls)
        with damage_named(path), grid._opened(path, "r+"):
            grid._root = grid._file["VTKHDF"]
            times = grid._root["Steps/Values"][: int(grid._root["Steps"].attrs["NSteps"])]
            grid._count(int(np.searchsorted(times, time, side="right")))
        return grid

    @contextmanager
    def _opened(self, path: Path, mode: str) -> Iterator[None]:
        """Within, a file that was just opened is filled or looked at; it stays open unless that fails."""
        import h5py

        self.path, self.number_of_steps, self.last_time = path, 0, -np.inf
        with signals_held_back():
            self._staged = StagedFile(path, existing=mode == "r+")
            # a file that is no HDF5 stays open where this fails: h5py still flushes it when it lets go of it
            self._file = h5py.File(self._staged, mode, libver=_VERSIONS)
            try:
                yield
                self._file.flush()
                self._staged.commit()
            except BaseException:
                self._file.close()
                self._staged.close()
                if mode == "w":  # not even begun
                    path.unlink(missing_ok=True)
                raise

    def append(
        self,
        time: float,
        point_data: Fields | None = None,
        cell_data: Fields | None = None,
        points: ArrayLike | None = None,
        constant: Fields | None = None,
    ) -> None:
        """Add one step and bring it to the disk; points are given at every step or at none."""
        step, root = self.number_of_steps, self._root
        kinds = (("PointData", point_data, step), ("CellData", cell_data, step), ("CellData", constant, 0))
        with signals_held_back():
            for kind, fields, place in kinds:
                for name, block in ((f"{kind}/{name}", np.asarray(values)) for name, values in (fields or {}).items()):
                    if name not in root:  # a chunk is a step, which readers take as a whole
                        _create(root, name, np.float32, block.shape, fletcher32=True)
                        _create(root, _offsets(name), np.int64, (_STEPS_PER_CHUNK,))
                    _write(root[name], place, block)
                    _write(root[_offsets(name)], step, [place * len(block)])
            # offsets that stay 0 say that the mesh is the one of the first step
            numbers: dict[str, float] = dict.fromkeys(_ALWAYS_0, 0)
            numbers |= {"Steps/NumberOfParts": 1, "Steps/PointOffsets": 0, "Steps/Values": time}
            if points is not None:  # block 0 is the reference configuration
                _write(root["Points"], step + 1, points)
                numbers["Steps/PointOffsets"] = (step + 1) * len(np.asarray(points))
            for name, number in numbers.items():
                columns = (1,) if name in _OF_TOPOLOGY else ()  # one for each kind of topology
                _write(root[name], step, np.full((1, *columns), number))
            self._file.flush()
            # the number of steps comes last: until then a reader sees the series without this step
            self.number_of_steps, self.last_time = step + 1, time
            root["Steps"].attrs.modify("NSteps", np.int64(step + 1))
            self._file.flush()
            self._staged.commit()

    def drop_last(self) -> None:
        """Take the last step back; the next `append`, or `close`, brings that to the disk."""
        with signals_held_back():
            self._count(self.number_of_steps - 1)

    def _count(self, number: int) -> None:
        """The file has so many steps from now on."""
        steps = self._root["Steps"]
        steps["Values"].resize(number, axis=0)  # VTK takes as many as stand there
        steps.attrs.modify("NSteps", np.int64(number))
        self.number_of_steps, self.last_time = number, float(steps["Values"][-1]) if number else -np.inf

    def close(self) -> None:
        """Write what is not yet on the disk and close; more than once does no harm."""
        if self._staged.closed:
            return
        with signals_held_back():
            try:
                self._file.close()
                self._staged.commit()
            finally:
                self._staged.close()

    def _make(self, points: Array, cells: Array, cell_type: int) -> None:
        """Write the mesh, and no steps."""
        self._root = root = self._file.create_group("VTKHDF")
        root.attrs["Version"] = np.array(VERSION, dtype=np.int64)
        root.attrs["Type"] = np.bytes_("UnstructuredGrid")  # VTK takes fixed-length ASCII only
        for name, number in {"Points": len(points), "Cells": len(cells), "ConnectivityIds": cells.size}.items():
            root[f"NumberOf{name}"] = np.array([number], dtype=np.int64)
        _create(root, "Points", points.dtype, points.shape, fletcher32=True)
        _write(root["Points"], 0, points)
        root.create_dataset("Connectivity", data=cells.ravel(), **_COMPRESSION)
        root.create_dataset("Offsets", data=cells.shape[1] * np.arange(len(cells) + 1), **_COMPRESSION)
        root.create_dataset("Types", data=np.full(len(cells), cell_type, dtype=np.uint8), **_COMPRESSION)
        for group in ("PointData", "CellData", "Steps/PointDataOffsets", "Steps/CellDataOffsets"):
            root.create_group(group)
        # no check sum: these chunks are written over, and a reader must find the file whole between two writes
        _create(root, "Steps/Values", np.float64, (_STEPS_PER_CHUNK,))
        for name in ("Steps/NumberOfParts", "Steps/PointOffsets", *_ALWAYS_0):
            columns = (1,) if name in _OF_TOPOLOGY else ()
            _create(root, name, np.int64, (_STEPS_PER_CHUNK, *columns))
        root["Steps"].attrs["NSteps"] = np.int64(0)


def _offsets(field: str) -> str:
    """Where the offsets of a field stand."""
    return "Steps/" + field.replace("/", "Offsets/", 1)


def _create(group: h5py.Group, name: str, dtype: DTypeLike, chunk: tuple[int, ...], fletcher32: bool = False) -> None:
    """An empty dataset that grows by rows; with `fletcher32` every chunk has a check sum."""
    shape = (0, *chunk[1:]), dtype
    group.create_dataset(name, *shape, maxshape=(None, *chunk[1:]), chunks=chunk, fletcher32=fletcher32)


def _write(dataset: h5py.Dataset, number: int, block: ArrayLike) -> None:
    """Write a block of rows, the last one of a dataset whose blocks have this one's length."""
    start, rows = number * len(np.asarray(block)), len(np.asarray(block))
    dataset.resize(start + rows, axis=0)
    dataset[start:] = block


def vtk_cells(cell_name: str, degree: int, elements: NDArray[np.int64]) -> tuple[int, NDArray[np.int64]]:
    """VTK's cell type, and the elements with their nodes in VTK's order."""
    # here and not above: whoever reads or writes lines alone need not wait for dolfinx
    from dolfinx import cpp
    from dolfinx.mesh import to_type

    from_vtk = np.asarray(cpp.io.perm_vtk(to_type(cell_name), elements.shape[1]))
    return CELL_TYPES[cell_name][degree > 1], elements[:, np.argsort(from_vtk)]


# ---------------------------------------------------------------- files that somebody else may have made


@contextmanager
def damage_named(path: Path) -> Iterator[None]:
    """Within, HDF5's errors say in one line that the file is damaged; those of the disk stay what they are."""
    try:
        yield
    except (KeyError, ValueError, TypeError, IndexError, RuntimeError, OSError) as error:
        if isinstance(error, OSError) and error.errno is not None:  # the disk's have a number, HDF5's none
            raise
        words = " ".join(str(error).split())
        remedy = "the run goes on without this file"
        raise RecordingError(f"{path}: is damaged or of another kind: {words}; {remedy}") from error


def check_file(path: Path) -> None:
    """Read a file of `TransientGrid` as a whole, so that damage and what is foreign are noticed. Nothing is changed."""
    import h5py

    os.close(open_own(path, os.O_RDONLY))
    with damage_named(path), h5py.File(path, "r") as file:
        _check_group(file["VTKHDF"], _LARGEST_RATIO * path.stat().st_size)
        _check_steps(file["VTKHDF"])


def _check_group(group: h5py.Group, most: int) -> None:
    import h5py

    for name in group:
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            raise ValueError(f"{group.name}/{name} is a link to elsewhere")
        entry = group[name]
        if isinstance(entry, h5py.Group):
            _check_group(entry, most)
        elif entry.nbytes > most:
            raise ValueError(f"{entry.name} claims {entry.nbytes} bytes")
        elif entry.is_virtual or entry.external:
            raise ValueError(f"{entry.name} is kept in another file")
        else:
            rows = max(1, _ROWS_AT_ONCE // max(1, int(np.prod(entry.shape[1:])))) if entry.shape else 1
            for start in range(0, entry.shape[0] if entry.shape else 0, rows):
                entry[start : start + rows]


def _check_steps(root: h5py.Group) -> None:
    steps, number = root["Steps"], int(root["Steps"].attrs["NSteps"])
    times = steps["Values"][:number]
    if len(times) != number or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise ValueError("the times of its steps do not increase")
    for kind, unit in (("PointData", "NumberOfPoints"), ("CellData", "NumberOfCells")):
        size = int(root[unit][0])
        for name, offsets in steps[f"{kind}Offsets"].items():
            places = offsets[:number]
            at_every_step, once = (places == size * np.arange(number)).all(), not places.any()  # constant ones
            if not (at_every_step or once) or len(root[kind][name]) < places[-1:].sum() + size * bool(number):
                raise ValueError(f"the values of {name} are not where they belong")
