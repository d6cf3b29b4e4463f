"""Who writes in a folder: one run at a time, and others can see which."""

from __future__ import annotations

import fcntl
import os
import re
import socket
from pathlib import Path

from remodel_fenicsx.errors import RemodelError
from remodel_fenicsx.results.recording import SCENE
from remodel_fenicsx.system.files import open_own, part_of

LOCK = "run.lock"
_WRITER = re.compile(r"process \d+ on [\w.-]+( \(\d+ ranks\))?")


class FolderTaken(RemodelError, ValueError):
    """The folder asked for holds something already, or a run writes in it.

    Examples
    --------
    >>> from pathlib import Path
    >>> from mpi4py import MPI
    >>> from remodel_fenicsx import parts
    >>> Path("taken").mkdir()
    >>> written = Path("taken/notes.txt").write_text("mine")
    >>> parts.chosen_folder("taken", "cube", MPI.COMM_WORLD)
    Traceback (most recent call last):
        ...
    remodel_fenicsx.results.run_lock.FolderTaken: folder taken: is not empty; allowed is a new or an empty folder
    """


class RunLock:
    """This process writes alone in a folder, as long as it lives: the system gives back a lock of a killed process."""

    def __init__(self, folder: Path, ranks: int = 1):
        self._path = folder / LOCK
        folder.mkdir(parents=True, exist_ok=True)
        self._descriptor = open_own(self._path, os.O_RDWR | os.O_CREAT)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            while not self._is_at_its_place():  # the writer before has taken the file away meanwhile
                os.close(self._descriptor)
                self._descriptor = open_own(self._path, os.O_RDWR | os.O_CREAT)
                fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._descriptor)
            if isinstance(error, BlockingIOError):
                raise FolderTaken(f"{folder}: {writer(folder)[0] or 'another process'} writes in it") from None
            raise
        others = f" ({ranks} ranks)" if ranks > 1 else ""
        os.ftruncate(self._descriptor, 0)
        os.write(self._descriptor, f"process {os.getpid()} on {socket.gethostname()}{others}\n".encode())

    def _is_at_its_place(self) -> bool:
        return self._path.exists() and os.path.samestat(os.fstat(self._descriptor), os.stat(self._path))

    def close(self) -> None:
        """Let others in."""
        self._path.unlink(missing_ok=True)
        os.close(self._descriptor)

    def __enter__(self) -> RunLock:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def writer(folder: Path) -> tuple[str | None, bool]:
    """The process that writes in a folder, or wrote in it when it was killed, in words; and whether it lives."""
    try:
        descriptor = open_own(folder / LOCK, os.O_RDONLY)
    except FileNotFoundError:
        return None, False
    with open(descriptor, "rb") as file:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
            lives = False
        except BlockingIOError:
            lives = True
        words = file.read(4096).decode(errors="replace").strip()
    return words if _WRITER.fullmatch(words) else None, lives  # none: just being written, or of another kind


def is_vacant(folder: Path) -> bool:
    """Whether a folder is empty, or holds only what a process leaves that is killed before its scene has its name."""
    left = {LOCK, part_of(Path(SCENE)).name}
    return {entry.name for entry in folder.iterdir()} <= left and not writer(folder)[1]
