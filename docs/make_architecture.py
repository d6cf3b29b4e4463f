#!/usr/bin/env python3
"""Makes the table of sizes in docs/architecture.md: ``./with-fenicsx python3 docs/make_architecture.py``."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sized
from pathlib import Path
from types import FrameType
from typing import Any

PAGE = Path(__file__).with_name("architecture.md")
PACKAGE = PAGE.parents[1] / "remodel_fenicsx"
MARKS = "<!-- sizes: ./with-fenicsx python3 docs/make_architecture.py -->\n\n", "\n<!-- end of sizes -->"
STEP = 4  # by which nothing is made for the first time


def lines(files: Iterable[str | Path]) -> int:
    """Of files together, to a thousand: small changes of the code leave the page as it is."""
    return round(sum(len(Path(file).read_text(encoding="utf-8").splitlines()) for file in files), -3)


def tens(files: Sized) -> int:
    """How many, to ten."""
    return round(len(files), -1)


def table() -> str:
    """In a process that has imported nothing of the package before."""
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
        f"| whose functions the fourth step calls | {tens(called & set(all_files))} | |\n"
    )


def page_text(made: str) -> str:
    """The page with this table."""
    before, rest = PAGE.read_text(encoding="utf-8").split(MARKS[0])
    return before + MARKS[0] + made + MARKS[1] + rest.split(MARKS[1])[1]


if __name__ == "__main__":
    PAGE.write_text(page_text(table()), encoding="utf-8")
