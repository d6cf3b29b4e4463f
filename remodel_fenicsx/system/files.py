"""Files of others and arguments: regular files alone are read, no link is written through."""

from __future__ import annotations

import argparse
import errno
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


# ---------------------------------------------------------------- files that somebody else may have put there
# Only regular files are read, no link is written through.
#  Scenes and folders of runs are passed around. A pipe would make whoever opens it wait, a device has no end, and a
# link (symbolic, or a second name of one file) would lead what is written out of the folder.

NEVER_WAITING = os.O_NONBLOCK | os.O_CLOEXEC  # opening a pipe without a writer would wait

NO_FILE = "is a pipe or a device, not a file"
LINK = "is a link; nothing is written through one"
# what the system says of a link in a circle, a folder, and a link that leads nowhere where a file is to be made
FOREIGN = {errno.ELOOP: LINK, errno.EISDIR: "is a folder, not a file", errno.EEXIST: LINK}


class ForeignFileError(RemodelError, OSError):
    """Under a name that a run uses there is something that no run has made: a link, a pipe, a file without end."""

    on_all_ranks = False

    def __str__(self) -> str:
        return f"{self.filename}: {self.strerror}"


class TakenError(ForeignFileError, FileExistsError, ValueError):
    """What was to be made is there already."""

    def __init__(self, path: Path, kind: str = "file"):
        super().__init__(errno.EEXIST, f"is there already; allowed is a new {kind}", str(path))


def refusal_in_words(error: OSError) -> str:
    """What the system has refused, on one line; Python's own words have `PosixPath(...)` in them."""
    if error.strerror is None:  # h5py's, say
        return " ".join(str(error).split())
    return f"{error.filename}: {error.strerror}" if error.filename is not None else error.strerror


def read_regular(path: Path, most: int) -> bytes:
    """All of a regular file; links to one are followed."""
    descriptor, found = _regular(path, os.O_RDONLY)
    with open(descriptor, "rb") as file:
        data = file.read(found.st_size + 1) if found.st_size <= most else b""
    if max(found.st_size, len(data)) > most:
        raise ForeignFileError(errno.EFBIG, f"is larger than {most / 1e6:g} MB", str(path))
    return data


def check_regular(path: Path) -> None:
    """Raise ForeignFileError if what stands there is no regular file, nor a link to one: opening it might wait."""
    os.close(_regular(path, os.O_RDONLY)[0])


def open_own(path: Path, flags: int) -> int:
    """Descriptor of a file that is written in place: a regular one of this name alone."""
    descriptor, found = _regular(path, flags | os.O_NOFOLLOW)
    if found.st_nlink > 1:
        os.close(descriptor)
        raise ForeignFileError(errno.EMLINK, "has a second name (a hard link); nothing is written to it", str(path))
    return descriptor


def make_own_folder(path: Path) -> None:
    """Make a folder inside of another one, if it is not there."""
    path.mkdir(parents=True, exist_ok=True)
    check_no_link(path)


def check_no_link(path: Path) -> None:
    """Raise ForeignFileError if a link stands in the place of a folder or of nothing yet."""
    if path.is_symlink():
        raise ForeignFileError(errno.ELOOP, LINK, str(path))


def numbered(path: Path) -> Iterator[Path]:
    """Names of something new: this one, and others where it is taken."""
    yield path
    for number in itertools.count(2):
        yield path.with_name(f"{path.stem}-{number}{path.suffix}")


def part_of(path: Path) -> Path:
    """Where a file is written before it gets its name."""
    return path.with_name(f"{path.name}.part")


def write_whole(path: Path, data: bytes) -> None:
    """Make or replace a file: written beside it, brought to the disk, then renamed. A link in its place is replaced."""
    with _written_beside(path, data) as part:
        part.replace(path)


def write_new(path: Path, data: bytes) -> None:
    """Make a file that is not there; it is there whole or not at all, whenever the process is killed."""
    with _written_beside(path, data) as part:
        try:
            os.link(part, path)  # unlike a rename it replaces nothing
        except OSError:
            if os.path.lexists(path):
                raise TakenError(path) from None
            part.rename(path)  # a file system without hard links


@contextmanager
def _written_beside(path: Path, data: bytes) -> Iterator[Path]:
    """Within, the data are on the disk beside their place; then the new name is, and the other one is gone."""
    part = part_of(path)
    part.unlink(missing_ok=True)  # of a run that was killed
    try:
        with open(open_own(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL), "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        yield part
    finally:
        part.unlink(missing_ok=True)  # the room it takes may be all there is
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # the name too
    finally:
        os.close(folder)


def _regular(path: Path, flags: int) -> tuple[int, os.stat_result]:
    """Descriptor of a regular file, and what the system knows of it."""
    try:
        descriptor = os.open(path, flags | NEVER_WAITING, 0o666)
    except ValueError as error:  # a NUL, or what is no UTF-8
        raise ForeignFileError(errno.EINVAL, f"has no name of a file: {error}", ascii(str(path))) from None
    except OSError as error:
        if error.errno in FOREIGN and (error.errno != errno.EEXIST or path.is_symlink()):
            raise ForeignFileError(error.errno, FOREIGN[error.errno], str(path)) from None
        raise
    found = os.fstat(descriptor)
    if not stat.S_ISREG(found.st_mode):
        os.close(descriptor)
        number = errno.EISDIR if stat.S_ISDIR(found.st_mode) else errno.EINVAL
        raise ForeignFileError(number, FOREIGN.get(number, NO_FILE), str(path))
    return descriptor, found


class ClosedAtEnd:
    """What is closed at the end of its `with`."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of files."""


# ---------------------------------------------------------------- what is typed on the command line


def wall_time(text: str) -> float:
    """Seconds of a time such as 90s, 30min, 2h."""
    found = re.fullmatch(r"([0-9]{1,9}(?:\.[0-9]{1,9})?)\s*(s|min|h|d)", text)
    seconds = float(found[1]) * {"s": 1, "min": 60, "h": 3600, "d": 86400}[found[2]] if found else 0.0
    if seconds <= 0:
        raise argparse.ArgumentTypeError(f"{text!r}: must be a time greater than 0 with its unit: 90s, 30min, 2h, 1.5d")
    return seconds


# of runs of a study, or of times that are analysed: each is a folder or a row that a person looks at
MOST_RUNS = 10_000


def positive(text: str) -> int:
    """A whole number from 1 to `MOST_RUNS`."""
    number = int(text)
    if not 1 <= number <= MOST_RUNS:
        raise argparse.ArgumentTypeError(f"{text}: allowed is a whole number from 1 to {MOST_RUNS}")
    return number


def typed() -> str:
    """The command as it has to be typed here: through the launcher, where that is how its programs are found."""
    launcher = Path(__file__).resolve().parents[2] / "with-fenicsx"
    found = shutil.which("remodel-fenicsx")
    if found is None or Path(found).resolve() != launcher.parent / "bin" / "remodel-fenicsx":
        return "remodel-fenicsx"
    near = os.path.relpath(launcher)
    return f"{shlex.quote(str(launcher) if near.startswith('..') else f'./{near}')} remodel-fenicsx"
