"""Folders for a while, which go with the process that made them, if it was killed too: with the next one's."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PREFIX = "remodel-fenicsx-"


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """A new folder, locked as long as this process lives; those that nobody locks any more are removed."""
    for left in Path(tempfile.gettempdir()).glob(f"{PREFIX}*.tmp"):
        with suppress(OSError), _locked(left):  # of another process, or of another user
            if left.stat().st_uid == os.getuid():
                shutil.rmtree(left)
    with tempfile.TemporaryDirectory(prefix=PREFIX, suffix=".tmp") as folder, _locked(Path(folder)):
        yield Path(folder)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    descriptor = os.open(folder, os.O_RDONLY | os.O_NOFOLLOW | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)
