"""Meshes with arrays in formats of other programs, by meshio: VTU, VTK, XDMF. They are data: nothing is followed."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

ENDINGS = (".vtu", ".vtk", ".xdmf")


class ExchangeFileError(ValueError):
    """What is wrong with such a file; one line."""


def read_exchange_file(path: Path, data: bytes) -> Any:
    """A `meshio.Mesh`.

    Parameters
    ----------
    path
        The file; its ending is one of `ENDINGS`.
    data
        What it holds.

    Raises
    ------
    ExchangeFileError
        If it is damaged, or its numbers stand in another file.
    """
    if path.suffix.lower() == ".xdmf" and re.search(rb"Format\s*=\s*[\"'](?!XML)|<!|xi:include", data):
        raise ExchangeFileError(
            "its numbers stand in another file; allowed is an XDMF file that holds them (Format='XML')"
        )
    if b"<!ENTITY" in data[:10000]:
        raise ExchangeFileError("has entities; allowed is plain XML")
    from meshio import vtk, vtu, xdmf

    reader: Any = {".vtu": vtu, ".vtk": vtk, ".xdmf": xdmf}[path.suffix.lower()]
    try:
        return reader.read(str(path))
    except (Exception, SystemExit) as error:  # meshio raises whatever happens on the way
        words = " ".join(str(error).split()) or type(error).__name__
        raise ExchangeFileError(f"cannot be read: {words}") from error
