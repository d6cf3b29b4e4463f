"""Checkpoints as files: numpy's .npz with a JSON header.

A folder has the newest checkpoint, which is the one with the larger number, and its predecessor.
A new checkpoint replaces the older file when it is complete. The check sums of zip detect
accidents, not intent, so types and shapes are checked too. This module needs no dolfinx.
"""

from __future__ import annotations

import io
import json
import logging
import os
import tokenize
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from remodel_fenicsx.errors import RemodelError
from remodel_fenicsx.system.files import check_regular, write_whole

log = logging.getLogger(__name__)
Array = NDArray[Any]

CHECKPOINT_FORMAT = 1
FILES = ("checkpoint-a.npz", "checkpoint-b.npz")
_HEADER = "header"  # name of the array that holds the JSON
# errors of numpy, zipfile and pydantic if a file was changed: encrypted, too deep, no literal, ...
_FAULTS = (
    ValueError,
    KeyError,
    TypeError,
    EOFError,
    OSError,
    MemoryError,
    RuntimeError,
    SyntaxError,
    tokenize.TokenError,
    zipfile.BadZipFile,
)


class CheckpointError(RemodelError, ValueError):
    """A checkpoint is corrupt or does not belong to the run; one line."""


class Checkpoint(BaseModel):
    """A state in the numbering of the input mesh."""

    model_config = ConfigDict(
        strict=True, extra="forbid", allow_inf_nan=False, arbitrary_types_allowed=True
    )

    format: int = Field(default=CHECKPOINT_FORMAT, ge=1, le=CHECKPOINT_FORMAT)
    time: float = Field(ge=0)
    number: int = Field(ge=0)
    scene: str
    versions: dict[str, str]
    loads: dict[str, float]
    numbers: dict[str, float]
    functions: list[str]
    arrays: dict[str, Array] = Field({}, exclude=True)


def write_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint over the older one."""
    text = np.frombuffer(checkpoint.model_dump_json().encode(), dtype=np.uint8)
    whole = io.BytesIO()
    np.savez(whole, **{_HEADER: text}, **checkpoint.arrays)  # type: ignore[arg-type]
    # over the one that was written earlier
    older = min(
        (folder / name for name in FILES),
        key=lambda path: path.stat().st_mtime_ns if path.exists() else 0,
    )
    write_whole(older, whole.getvalue())


def time_of_checkpoint(folder: Path) -> float | None:
    """Return the time of the newest checkpoint, or None if there is none."""
    checkpoint = read_checkpoint(folder)
    return None if checkpoint is None else checkpoint.time


def read_checkpoint(folder: Path) -> Checkpoint | None:
    """Return the newest complete checkpoint, or None if there is none.

    The program logs a warning about an incomplete one.
    """
    checkpoints, faults = list[Checkpoint](), list[str]()
    for path in (folder / name for name in FILES):
        try:
            if os.path.lexists(path):
                checkpoints.append(read_file(path))
        except CheckpointError as error:
            faults.append(str(error))
    if faults and not checkpoints:
        remedy = "without its files checkpoint* the run starts again at t = 0"
        raise CheckpointError(
            f"{folder}: has no checkpoint that is whole ({'; '.join(faults)}); {remedy}"
        )
    for fault in faults:
        log.warning("%s", fault)
    return max(checkpoints, key=lambda one: one.number) if checkpoints else None


def read_file(path: Path) -> Checkpoint:
    """Read a checkpoint and check its types and shapes."""
    check_regular(path)
    try:
        with np.load(path, allow_pickle=False) as file, zipfile.ZipFile(path) as archive:
            # Compressed data may expand to any size; checkpoints are never compressed.
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
                raise ValueError("compressed")
            header = file[_HEADER].tobytes()
            if json.loads(header)["format"] > CHECKPOINT_FORMAT:
                raise CheckpointError(f"{path}: was written by a newer version")
            checkpoint = Checkpoint.model_validate_json(header)
            checkpoint.arrays |= {name: file[name] for name in file.files if name != _HEADER}
            for name in (
                "points",
                "elements",
                *(f"function/{function}" for function in checkpoint.functions),
            ):
                _check_table(checkpoint.arrays[name])
    except CheckpointError:
        raise
    except _FAULTS as error:
        raise CheckpointError(
            f"{path}: is corrupt or of another kind than the checkpoints of this version"
        ) from error
    return checkpoint


def _check_table(array: Array) -> None:
    """Raise ValueError unless the array is a table of finite numbers."""
    if array.ndim != 2 or array.dtype.kind not in "fiu" or not np.isfinite(array).all():
        raise ValueError("no table of finite numbers")
