"""Files and arguments: safe reading and writing of files, and values of the command line."""

from __future__ import annotations

import argparse
import errno
import fcntl
import itertools
import os
import re
import shlex
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Self

from remodel_fenicsx.errors import RemodelError


# ---------------------------------------------------------------- untrusted files
# Only regular files are read, and nothing is written through a link.
#  Scenes and run folders are passed around. Opening a pipe would block, and reading a device would
# never end. A link (symbolic, or a second name of one file) would lead writes out of the folder.

NON_BLOCKING = os.O_NONBLOCK | os.O_CLOEXEC  # Opening a pipe without a writer would block.

NO_FILE = "is a pipe or a device, not a file"
LINK = "is a link; nothing is written through one"
# System errors for a circular link, a folder, and a dangling link in place of a new file.
FOREIGN = {errno.ELOOP: LINK, errno.EISDIR: "is a folder, not a file", errno.EEXIST: LINK}


class ForeignFileError(RemodelError, OSError):
    """Link, pipe, device or file of excessive size in place of a file of a run."""

    on_all_ranks = False

    def __str__(self) -> str:
        return f"{self.filename}: {self.strerror}"


class TakenError(ForeignFileError, FileExistsError, ValueError):
    """Output file or folder that already exists."""

    def __init__(self, path: Path, kind: str = "file"):
        super().__init__(errno.EEXIST, f"already exists; must be a new {kind}", str(path))


def refusal_in_words(error: OSError) -> str:
    """Describe a system error on one line, without the `PosixPath(...)` of Python's message."""
    if error.strerror is None:  # h5py, for one, sets no message.
        return " ".join(str(error).split())
    return f"{error.filename}: {error.strerror}" if error.filename is not None else error.strerror


def read_regular(path: Path, most: int) -> bytes:
    """Read a regular file of at most `most` bytes, following symbolic links."""
    descriptor, status = _regular(path, os.O_RDONLY)
    with open(descriptor, "rb") as file:
        data = file.read(status.st_size + 1) if status.st_size <= most else b""
    if max(status.st_size, len(data)) > most:
        raise ForeignFileError(errno.EFBIG, f"is larger than {most / 1e6:g} MB", str(path))
    return data


def check_regular(path: Path) -> None:
    """Raise ForeignFileError unless the path is a regular file or a link to one; never block."""
    os.close(_regular(path, os.O_RDONLY)[0])


def open_own(path: Path, flags: int) -> int:
    """Open a file to write in place: a regular file with no second name. Return its descriptor."""
    descriptor, status = _regular(path, flags | os.O_NOFOLLOW)
    if status.st_nlink > 1:
        os.close(descriptor)
        raise ForeignFileError(
            errno.EMLINK, "has a second name (a hard link); nothing is written to it", str(path)
        )
    return descriptor


def make_own_folder(path: Path) -> None:
    """Make a folder and its parents, unless they exist; raise if the folder is a link."""
    path.mkdir(parents=True, exist_ok=True)
    check_no_link(path)


def check_no_link(path: Path) -> None:
    """Raise ForeignFileError if the path is a symbolic link."""
    if path.is_symlink():
        raise ForeignFileError(errno.ELOOP, LINK, str(path))


def numbered(path: Path) -> Iterator[Path]:
    """Yield names for a new file: this one, then numbered ones."""
    yield path
    for number in itertools.count(2):
        yield path.with_name(f"{path.stem}-{number}{path.suffix}")


def partial_path(path: Path) -> Path:
    """Return the temporary name of a file that is being written."""
    return path.with_name(f"{path.name}.part")


def write_whole(path: Path, data: bytes) -> None:
    """Write or replace a file atomically: write next to it, sync, rename. A link is replaced."""
    with _written_beside(path, data) as part:
        part.replace(path)


def write_new(path: Path, data: bytes) -> None:
    """Write a new file atomically; raise if it exists. A killed process leaves all or nothing."""
    with _written_beside(path, data) as part:
        try:
            os.link(part, path)  # Unlike a rename, a link replaces nothing.
        except OSError:
            if os.path.lexists(path):
                raise TakenError(path) from None
            part.rename(path)  # The file system has no hard links.


@contextmanager
def _written_beside(path: Path, data: bytes) -> Iterator[Path]:
    """Write and sync a temporary file, yield it, then remove it and sync the folder."""
    part = partial_path(path)
    part.unlink(missing_ok=True)  # left by a killed run
    try:
        with open(open_own(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL), "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        yield part
    finally:
        part.unlink(missing_ok=True)  # The disk may have no other free space.
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # Syncs the new name.
    finally:
        os.close(folder)


def _regular(path: Path, flags: int) -> tuple[int, os.stat_result]:
    """Open a regular file without blocking; return its descriptor and status."""
    try:
        descriptor = os.open(path, flags | NON_BLOCKING, 0o666)
    except ValueError as error:  # A name with a NUL, or not in UTF-8.
        raise ForeignFileError(
            errno.EINVAL, f"is not a file name: {error}", ascii(str(path))
        ) from None
    except OSError as error:
        if error.errno in FOREIGN and (error.errno != errno.EEXIST or path.is_symlink()):
            raise ForeignFileError(error.errno, FOREIGN[error.errno], str(path)) from None
        raise
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode):
        os.close(descriptor)
        number = errno.EISDIR if stat.S_ISDIR(status.st_mode) else errno.EINVAL
        raise ForeignFileError(number, FOREIGN.get(number, NO_FILE), str(path))
    return descriptor, status


# ---------------------------------------------------------------- runs in folders
SCENE, LOCK = "scene.toml", "run.lock"


def lock_holder(folder: Path) -> tuple[str | None, bool]:
    """Return text on the process that holds, or held, a folder's lock, and whether it lives."""
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
    return words or None, lives  # none: just being written


class ClosedAtEnd:
    """Base class of context managers that close themselves on exit."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files that the object holds."""


# ---------------------------------------------------------------- command line values


def wall_time(text: str) -> float:
    """Convert a duration such as 90s, 30min or 2h to seconds."""
    match = re.fullmatch(r"([0-9]{1,9}(?:\.[0-9]{1,9})?)\s*(s|min|h|d)", text)
    seconds = (
        float(match[1]) * {"s": 1, "min": 60, "h": 3600, "d": 86400}[match[2]] if match else 0.0
    )
    if seconds <= 0:
        raise argparse.ArgumentTypeError(
            f"{text!r}: must be a time greater than 0 with its unit: 90s, 30min, 2h, 1.5d"
        )
    return seconds


# runs of a study, or analysed times: a person looks at each folder or row
MOST_RUNS = 10_000


def positive(text: str) -> int:
    """Convert text to an integer from 1 to `MOST_RUNS`."""
    number = int(text)
    if not 1 <= number <= MOST_RUNS:
        raise argparse.ArgumentTypeError(f"{text}: must be an integer from 1 to {MOST_RUNS}")
    return number


def command_name() -> str:
    """Return the command name for messages: with the launcher, if it provides the command."""
    launcher = Path(__file__).resolve().parents[2] / "with-fenicsx"
    program = shutil.which("remodel-fenicsx")
    if program is None or Path(program).resolve() != launcher.parent / "bin" / "remodel-fenicsx":
        return "remodel-fenicsx"
    near = os.path.relpath(launcher)
    return f"{shlex.quote(str(launcher) if near.startswith('..') else f'./{near}')} remodel-fenicsx"
