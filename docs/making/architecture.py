"""Prints the table of sizes in docs/architecture.md: a process of its own, which has imported nothing before."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterable, Sized
from pathlib import Path
from types import FrameType
from typing import Any

PACKAGE = Path(__file__).resolve().parents[2] / "remodel_fenicsx"
STEP = 4  # by which nothing is made for the first time


def lines(files: Iterable[str | Path]) -> int:
    """Of files together, to a thousand: small changes of the code leave the page as it is."""
    return round(sum(len(Path(file).read_text(encoding="utf-8").splitlines()) for file in files), -3)


def tens(files: Sized) -> int:
    """How many, to ten."""
    return round(len(files), -1)


def table() -> str:
    """Of the package, of what a simulation imports, of what a step calls."""
    sys.path.insert(0, str(PACKAGE.parent))
    from remodel_fenicsx import Simulation, preset_scene

    simulation = Simulation(preset_scene("kuhl-holzapfel-2007", "tube"))
    imported = {str(module.__file__) for name, module in sys.modules.items() if name.startswith(PACKAGE.name)}
    called = set[str]()

    def note(frame: FrameType, event: str, _: Any) -> None:
        if event == "call":
            called.add(frame.f_code.co_filename)

    steps = simulation.steps()
    for _ in range(STEP - 1):
        next(steps)
    sys.setprofile(note)
    next(steps)
    sys.setprofile(None)
    simulation.close()
    all_files = [str(path) for path in PACKAGE.rglob("*.py")]
    return (
        "| | modules | lines |\n|---|---|---|\n"
        f"| the package | {tens(all_files)} | {lines(all_files):,} |\n"
        f"| imported by `Simulation` | {tens(imported)} | {lines(imported):,} |\n"
        f"| whose functions the fourth step calls | {tens(called & set(all_files))} | |"
    )


def made_alone() -> str:
    """The table, by a process that has imported nothing yet."""
    return subprocess.run([sys.executable, __file__], capture_output=True, text=True, check=True).stdout


if __name__ == "__main__":
    print(table())
