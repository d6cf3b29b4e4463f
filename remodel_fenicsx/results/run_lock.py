"""Who writes in a folder: one run at a time, and others can see which."""

from __future__ import annotations

import fcntl
import json
import os
import socket
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType

from remodel_fenicsx.results.recording import SCENE
from remodel_fenicsx.system.regular_files import open_own, part_of

LOCK = "run.lock"


class FolderTaken(ValueError):
    """The folder asked for holds something already, or a run writes in it."""


@dataclass(frozen=True)
class Process:
    """A process as others see it."""

    number: int
    host: str
    ranks: int

    def __str__(self) -> str:
        ranks = f" ({self.ranks} ranks)" if self.ranks > 1 else ""
        return f"process {self.number} on {self.host}{ranks}"


class RunLock:
    """Holds a folder as long as the process lives, however it ends: the system gives back a lock of a killed process.

    Parameters
    ----------
    folder
        It is made with its parents if it is not there.
    ranks
        How many write together; this process is the first of them.

    Raises
    ------
    FolderTaken
        If a process holds the folder; it is named.
    OSError
        If the folder cannot be made or written, or the lock is a link or no regular file.
    """

    def __init__(self, folder: Path, ranks: int = 1):
        self._path = folder / LOCK
        folder.mkdir(parents=True, exist_ok=True)
        self._descriptor = -1
        while self._descriptor < 0:
            descriptor = open_own(self._path, os.O_RDWR | os.O_CREAT)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(descriptor)
                holder = lock_holder(folder)[0]
                raise FolderTaken(f"{folder}: {holder or 'another process'} writes in it") from None
            except OSError:
                os.close(descriptor)
                raise
            if _is_at(descriptor, self._path):
                self._descriptor = descriptor
            else:  # who held it has taken the file away meanwhile
                os.close(descriptor)
        process = Process(os.getpid(), socket.gethostname(), ranks)
        os.ftruncate(self._descriptor, 0)
        os.write(self._descriptor, (json.dumps(asdict(process)) + "\n").encode())

    def close(self) -> None:
        """Let others in."""
        if self._descriptor >= 0:
            self._path.unlink(missing_ok=True)
            os.close(self._descriptor)
            self._descriptor = -1

    def __enter__(self) -> RunLock:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def lock_holder(folder: Path) -> tuple[Process | None, bool]:
    """The process that holds a folder or held it when it was killed, and whether it lives.

    Raises
    ------
    OSError
        If that cannot be found out.
    """
    try:
        descriptor = open_own(folder / LOCK, os.O_RDONLY)
    except FileNotFoundError:
        return None, False
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
            lives = False
        except BlockingIOError:
            lives = True
        try:
            process = Process(**json.loads(os.read(descriptor, 4096)))
        except (ValueError, TypeError):  # just being written, or of another kind
            process = None
        return process, lives
    finally:
        os.close(descriptor)


def is_vacant(folder: Path) -> bool:
    """Whether a folder is empty, or holds only what a process leaves that is killed before its scene has its name.

    Raises
    ------
    OSError
        If that cannot be found out.
    """
    return {entry.name for entry in folder.iterdir()} <= {LOCK, part_of(Path(SCENE)).name} and not lock_holder(folder)[
        1
    ]


def _is_at(descriptor: int, path: Path) -> bool:
    """Whether the open file is the one of this name."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False
