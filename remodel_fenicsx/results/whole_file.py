"""Files that are there whole or not at all, whenever the process is killed or the disk fills up."""

from __future__ import annotations

import os
from pathlib import Path


def write_whole(path: Path, data: bytes) -> None:
    """Make or replace a file: written beside it, brought to the disk, then renamed.

    Raises
    ------
    OSError
        If it cannot be written (disk full); the old file, if there was one, is still there.
    """
    part = path.with_name(f"{path.name}.part")
    try:
        with part.open("wb", buffering=0) as file:
            view = memoryview(data)
            while view:
                view = view[file.write(view) :]
            os.fsync(file.fileno())
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)  # the room it takes may be all there is
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # the name too
    finally:
        os.close(folder)
