"""What a reader of one step has to follow: a ceiling on the functions of the package that it calls."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

import remodel_fenicsx
from remodel_fenicsx import preset_scene
from tests.runs import made

ROOT = Path(remodel_fenicsx.__file__).parent
MODULES, FUNCTIONS, CALLS = 27, 200, 858
WATCHED = 0.05


def calls_of_a_step(number: int) -> Counter[tuple[str, str]]:
    """Count the calls of each function of the package, by module and name, in a step of the printed tube."""
    found: Counter[tuple[str, str]] = Counter()

    def count(frame: FrameType, event: str, argument: Any) -> None:
        path = Path(frame.f_code.co_filename)
        if event == "call" and path.is_relative_to(ROOT):
            found[str(path.relative_to(ROOT)), frame.f_code.co_qualname] += 1

    with made(preset_scene("kuhl-holzapfel-2007", "tube")) as simulation:
        steps = simulation.steps()
        for _ in range(number - 1):
            next(steps)
        sys.setprofile(count)
        try:
            next(steps)
        finally:
            sys.setprofile(None)
    return found


def test_a_step_of_the_printed_tube_is_small() -> None:
    """Its fourth, counted on the day these ceilings were set."""
    found = calls_of_a_step(4)
    modules = Counter[str]()
    for (module, _), number in found.items():
        modules[module] += number
    said = f"{len(modules)} modules, {len(found)} functions, {found.total()} calls: {modules.most_common()}"
    assert len(modules) <= MODULES and len(found) <= FUNCTIONS and found.total() <= CALLS, said
    watched = sum(number for module, number in modules.items() if module.startswith("watch/"))
    assert watched <= WATCHED * found.total(), said
    assert found.total() > 100  # it was a step
