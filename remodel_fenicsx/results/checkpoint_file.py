"""Checkpoints as files: numpy's .npz with a JSON header, in two generations, and the pointer that names them.

The pointer, checkpoint.json, is written last: what it names is whole. It holds the check sum of each generation, the
newest first; a file that does not fit is damaged, and the one before counts. The sums tell of accidents, not of intent:
types and shapes are looked at too. This needs no dolfinx.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import tokenize
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from remodel_fenicsx.errors import RemodelError
from remodel_fenicsx.system.files import ForeignFileError, read_regular, write_whole

log = logging.getLogger(__name__)
Array = NDArray[Any]

POINTER, FORMAT = "checkpoint.json", 1
GENERATIONS = ("checkpoint-a.npz", "checkpoint-b.npz")
_HEADER = "header"  # name of the array that holds the JSON
LARGEST, LARGEST_POINTER = 10**11, 10**6  # bytes


class CheckpointError(RemodelError, ValueError):
    """A checkpoint is damaged or does not belong to the run; one line."""


class _Model(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, arbitrary_types_allowed=True)


class Generation(_Model):
    """What the pointer says of a checkpoint."""

    file: str = Field(pattern=r"^checkpoint-[ab]\.npz$")
    number: int = Field(ge=0)
    time: float
    sha256: str


class _Pointer(_Model):
    """checkpoint.json."""

    format: int = Field(default=FORMAT, ge=1, le=FORMAT)
    generations: list[Generation] = Field(min_length=1)  # the newest first


class Checkpoint(_Model):
    """A state by the input mesh's numbering."""

    format: int = Field(default=FORMAT, ge=1, le=FORMAT)
    time: float = Field(ge=0)
    number: int = Field(ge=0)
    scene: str
    versions: dict[str, str]
    loads: dict[str, float]
    numbers: dict[str, float]
    functions: list[str]
    arrays: dict[str, Array] = Field({}, exclude=True)


def write_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint over the older generation, then the pointer."""
    text = np.frombuffer(checkpoint.model_dump_json().encode(), dtype=np.uint8)
    whole = io.BytesIO()
    np.savez(whole, **{_HEADER: text}, **checkpoint.arrays)  # type: ignore[arg-type]
    data = whole.getvalue()
    try:
        newest = read_pointer(folder)[:1]
    except CheckpointError:  # whoever resumed has been told
        newest = []
    file = next(name for name in GENERATIONS if name not in [one.file for one in newest])
    write_whole(folder / file, data)
    sha256 = hashlib.sha256(data).hexdigest()
    generation = Generation(file=file, number=checkpoint.number, time=checkpoint.time, sha256=sha256)
    write_whole(
        folder / POINTER, (_Pointer(generations=[generation, *newest]).model_dump_json(indent=1) + "\n").encode()
    )


def read_pointer(folder: Path) -> list[Generation]:
    """What checkpoint.json names, the newest first; nothing if there is none."""
    path = folder / POINTER
    try:
        data = read_regular(path, LARGEST_POINTER)
        if json.loads(data)["format"] > FORMAT:
            raise CheckpointError(f"{path}: was written by a newer version")
        return _Pointer.model_validate_json(data).generations
    except FileNotFoundError:
        return []
    except CheckpointError:
        raise
    except (ValueError, KeyError, TypeError, RecursionError, ForeignFileError) as error:
        raise CheckpointError(f"{path}: is damaged or of another kind") from error


def read_checkpoint(folder: Path) -> Checkpoint | None:
    """The newest checkpoint that is whole, with a warning where it is not the newest."""
    generations, faults = read_pointer(folder), []
    for generation in generations:
        try:
            found = _read(folder / generation.file, generation)
        except CheckpointError as error:
            faults.append(str(error))
        else:
            for fault in faults:
                log.warning("%s", fault)
            return found
    if generations:
        remedy = "without its files checkpoint* the run starts again at t = 0"
        raise CheckpointError(f"{folder}: has no checkpoint that is whole ({'; '.join(faults)}); {remedy}")
    return None


def _read(path: Path, generation: Generation) -> Checkpoint:
    try:
        data = read_regular(path, LARGEST)
    except FileNotFoundError:
        raise CheckpointError(f"{path}: is missing") from None
    if hashlib.sha256(data).hexdigest() != generation.sha256:
        raise CheckpointError(f"{path}: is damaged: it is not the file that {POINTER} names")
    try:
        # what is compressed may be of any size: a checkpoint is not
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
                raise ValueError("compressed")
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files if name != _HEADER}
            checkpoint = Checkpoint.model_validate_json(file[_HEADER].tobytes())
        for name in ("points", "elements", *(f"function/{function}" for function in checkpoint.functions)):
            _check_table(arrays[name])
    except (
        ValueError,
        KeyError,
        TypeError,
        EOFError,
        OSError,
        MemoryError,
        RuntimeError,  # encrypted, of an unknown method, too deep
        SyntaxError,  # a header that is no literal
        tokenize.TokenError,
    ) as error:
        raise CheckpointError(f"{path}: is of another kind than the checkpoints of this version") from error
    except zipfile.BadZipFile as error:
        raise CheckpointError(f"{path}: is no archive of numpy's") from error
    return checkpoint.model_copy(update={"arrays": arrays})


def _check_table(array: Array) -> None:
    """Raise ValueError unless it is a table of finite numbers."""
    if array.ndim != 2 or array.dtype.kind not in "fiu" or not np.isfinite(array).all():
        raise ValueError("no table of finite numbers")
