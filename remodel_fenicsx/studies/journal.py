"""What a fit has evaluated, line by line in a file: the same fit called again asks the same, and goes on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx._version import __version__
from remodel_fenicsx.scene.scene import Scene
from remodel_fenicsx.studies.measured import Measured, Unknown
from remodel_fenicsx.system.regular_files import check_no_link, read_regular

Array = NDArray[np.float64]
Point = tuple[float, ...]

JOURNAL = "evaluations.jsonl"
LARGEST_JOURNAL = 10**9  # bytes


class Evaluation(NamedTuple):
    """Residuals (n,) at a point, and their derivatives (n, k): NaN in columns that the model does not give."""

    residuals: Array
    jacobian: Array


def fingerprint(scene: Scene, unknowns: Sequence[Unknown], tables: Sequence[Measured]) -> str:
    """SHA-256 of all that a fit depends on but its starts."""
    said = [[t.name, t.state, t.time, t.sd, t.scaled, {n: v.tolist() for n, v in t.columns.items()}] for t in tables]
    text = json.dumps([__version__, scene.to_toml(), [list(vars(u).values()) for u in unknowns], said])
    return hashlib.sha256(text.encode()).hexdigest()


def fingerprint_in(folder: Path) -> str | None:
    """That of the fit in a folder; None where there is none.

    Raises
    ------
    ForeignFileError, OSError
        If the journal cannot be read.
    """
    lines = _lines(folder / JOURNAL)
    return str(lines[0].get("fit")) if lines else None


def _lines(path: Path) -> list[dict[str, object]]:
    """Whole lines; the last one may have been cut off."""
    if not path.exists():
        return []
    found = []
    for line in read_regular(path, LARGEST_JOURNAL).decode(errors="replace").splitlines():
        try:
            found.append(json.loads(line))
        except ValueError:
            break
    return [line for line in found if isinstance(line, dict)]


class Journal:
    """The file, open for more.

    Parameters
    ----------
    folder
        Of the fit; made if it is not there.
    mark
        `fingerprint`.

    Attributes
    ----------
    known
        What it holds: evaluations by logarithms of the unknowns.
    """

    def __init__(self, folder: Path, mark: str):
        folder.mkdir(parents=True, exist_ok=True)
        self._path = folder / JOURNAL
        check_no_link(self._path)
        lines = _lines(self._path)
        self.known: dict[Point, Evaluation] = {}
        for line in lines[1:]:
            point, off, ways = (np.array(line[name], dtype=np.float64) for name in ("at", "residuals", "jacobian"))
            self.known[tuple(map(float, point))] = Evaluation(off, ways)
        # without a line that was cut off
        text = "".join(json.dumps(line) + "\n" for line in (lines or [{"fit": mark}]))
        self._path.write_text(text, encoding="utf-8")

    def add(self, point: Point, evaluation: Evaluation) -> None:
        """One line more, on the disk when this returns."""
        values = {"residuals": evaluation.residuals.tolist(), "jacobian": evaluation.jacobian.tolist()}
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"at": list(point), **values}) + "\n")
