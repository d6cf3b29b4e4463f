"""What libraries would do again for every kernel, done once: without it a kernel takes half as much Python again."""

from __future__ import annotations

import functools
import importlib.metadata
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import basix.ufl
import ufl


def share_cells() -> None:
    """From now on elements on the same kind of cell give the same `ufl.Cell`, which never changes.

    Of itself basix makes one whenever it is asked, with all its faces, their edges and corners: half a millisecond
    for a hexahedron, 170 times in a start.
    """
    made = functools.cache(ufl.Cell)
    shared = property(lambda element: made(element.cell_type.name))
    setattr(basix.ufl._ElementBase, "cell", shared)  # noqa: B010  # it has no setter for mypy


@contextmanager
def packages_read_once() -> Iterator[None]:
    """Within, the entry points of the installed packages are what they were at the first look of this process.

    setuptools, through which cffi starts the compiler, reads the files of every package six times for each kernel.
    """
    read = importlib.metadata.entry_points
    importlib.metadata.entry_points = _selected
    try:
        yield
    finally:
        importlib.metadata.entry_points = read


_read_once = functools.cache(importlib.metadata.entry_points)


def _selected(**wanted: Any) -> Any:
    return _read_once().select(**wanted)
