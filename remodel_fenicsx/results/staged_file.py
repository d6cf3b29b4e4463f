"""A file below h5py that a full disk or a killed process cannot spoil."""

from __future__ import annotations

import io
import os
import signal
import struct
import threading
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from remodel_fenicsx.system.regular_files import open_own

_CHANGE = struct.Struct("<QQ")  # offset and length, before the bytes
_END = struct.Struct("<QI8s")  # length and check sum of the changes before it
_MARK = b"remodel1"


@contextmanager
def signals_held_back() -> Iterator[None]:
    """Let Python's signal handlers (Ctrl-C, termination) run after the block: an exception inside a call-back that
    HDF5 makes into `StagedFile` would crash it."""
    caught: list[int] = []
    handlers = {int(number): signal.getsignal(number) for number in signal.valid_signals()}
    if threading.current_thread() is not threading.main_thread():  # handlers run in the main thread only
        handlers = {}
    handlers = {number: handler for number, handler in handlers.items() if callable(handler)}
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
    """The file below h5py: keeps what HDF5 writes in memory until `commit`, which first writes what is new at the end.

    HDF5 spoils a file when the disk fills up, or the process is killed, between its own writes. Here the disk can only
    be full while the new end is written, which nothing refers to yet; then the few changed bytes of the old part follow
    (those of the headers and chunk indices), in HDF5's order. HDF5 itself never meets an error.

    Whoever is killed between two of these changes leaves a file that can be read, but perhaps not be written any more.
    So the changes stand behind the new end until all are made; who opens the file again makes them to the end.

    Parameters
    ----------
    path
        The file.
    existing
        Open a file that is there; without, make a new one.

    Raises
    ------
    FileExistsError, FileNotFoundError, OSError
        If it is there, is not there, or cannot be opened.
    """

    def __init__(self, path: Path, existing: bool = False):
        self._descriptor = -1
        super().__init__()
        self._descriptor = open_own(path, os.O_RDWR | (0 if existing else os.O_CREAT | os.O_EXCL))
        if existing:
            self._finish_changes()
        self._committed = os.fstat(self._descriptor).st_size  # bytes on the disk
        self._changes: list[tuple[int, bytes]] = []  # to write over these, in order
        self._tail = bytearray()  # to write after these
        self._position = 0

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._position

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._committed + len(self._tail)}[whence]
        self._position = base + offset
        return self._position

    def readinto(self, buffer: Any) -> int:
        start, size = self._position, len(buffer)
        data = bytearray(os.pread(self._descriptor, max(0, min(size, self._committed - start)), start))
        for offset, change in self._changes:
            low, high = max(start, offset), min(start + len(data), offset + len(change))
            if low < high:
                data[low - start : high - start] = change[low - offset : high - offset]
        from_tail = max(0, start - self._committed)
        data += self._tail[from_tail : from_tail + size - len(data)]
        buffer[: len(data)] = data
        self._position += len(data)
        return len(data)

    def write(self, buffer: Any) -> int:
        data = bytes(buffer)
        old = max(0, min(len(data), self._committed - self._position))
        if old:
            self._changes.append((self._position, data[:old]))
        if old < len(data):
            start = self._position + old - self._committed
            self._tail.extend(bytes(max(0, start - len(self._tail))))
            self._tail[start : start + len(data) - old] = data[old:]
        self._position += len(data)
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        size = self._position if size is None else size
        # a file that is longer than its header says is valid: what is on the disk stays
        wanted = max(0, size - self._committed)
        self._tail[wanted:] = bytes(max(0, wanted - len(self._tail)))
        return size

    def commit(self) -> None:
        """Bring everything to the disk, or raise OSError and keep it for the next time."""
        # HDF5's superblock, at offset 0, says how long the file is: first, for chunk indices will name the new end
        changes = sorted(self._changes, key=lambda item: item[0] > 0)
        end = self._committed + len(self._tail)
        try:
            self._write_all(self._committed, self._tail + _journal(changes))
            os.fdatasync(self._descriptor)  # some file systems find out only now that they are full
        except OSError:
            os.ftruncate(self._descriptor, self._committed)
            raise
        self._make_changes(changes, end)
        self._committed, self._tail, self._changes = end, bytearray(), []

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
