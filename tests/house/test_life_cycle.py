"""What remodels is a list: the heart asks no feature by its name, and runs without the files of those it has."""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path

import pytest

from tests.processes import ran

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "remodel_fenicsx"
HEART = [
    *(
        PACKAGE / "evolution" / f"{name}.py"
        for name in ("stepper", "coupling", "time_steps", "homeostasis")
    ),
    PACKAGE / "evolution" / "remodeling.py",
    *sorted((PACKAGE / "solver").glob("*.py")),
    PACKAGE / "state.py",
    PACKAGE / "simulation.py",
    *sorted((PACKAGE / "watch").glob("*.py")),
]
MOST_QUESTIONS = 25
THREE_BODIES = """
import sys
from remodel_fenicsx import Simulation, preset_scene
for shape in ("cube", "tube", "tendon"):
    scene = preset_scene("kuhl-holzapfel-2007", shape).with_values({"time.end": 3.0, "cells.initial": "isotropic"})
    if shape == "tube":
        scene = scene.with_values({"model.kinematics": "radial"})
    steps = list(Simulation(scene).steps())
    assert len(steps) == 3 and steps[-1].limits.max_chain_extension > 0.4
print(*(name for name in sys.modules if name.startswith("remodel_fenicsx.evolution.")))
"""
UNKNOWN = """
from remodel_fenicsx import SceneError, preset_scene
from remodel_fenicsx.extend import COLUMNS_ON_REQUEST
assert not {"growth", "collagen_share", "turnover_power"} & {*COLUMNS_ON_REQUEST}
for values in ({"remodeling.turnover": {"time": 40.0}}, {"output.columns": ["turnover_power"]}):
    try:
        preset_scene("kuhl-holzapfel-2007", "tube").with_values(values)
    except SceneError as error:
        print(error)
"""


def test_the_heart_hardly_asks_for_a_feature() -> None:
    """Whole words, in code, docstrings and comments; none of them is an import."""
    asks = re.compile(r"\b(turnover|growth|cases)\b", flags=re.IGNORECASE)
    lines = [
        line
        for file in HEART
        for line in file.read_text(encoding="utf-8").splitlines()
        if asks.search(line)
    ]
    assert len(lines) <= MOST_QUESTIONS, "\n".join(lines)
    assert not [line for line in lines if re.match(r"\s*(from|import) ", line)]


TURNOVER = ("evolution/turnover.py", "schema/processes/turnover.py")


@pytest.mark.parametrize("files", [TURNOVER, (*TURNOVER, "evolution/load_cases.py")])
def test_a_feature_leaves_with_its_files(files: tuple[str, ...], tmp_path: Path) -> None:
    """Cube, tube and tendon run in a copy of the package without it; its keys and columns are unknown."""
    copy = tmp_path / PACKAGE.name
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    for file in files:
        (copy / file).unlink()
    command = [sys.executable, "-c", THREE_BODIES + UNKNOWN]
    done = ran(command, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    modules, table, column = done.stdout.splitlines()
    assert "remodel_fenicsx.evolution.stepper" in modules.split()
    assert re.match(r"remodeling\.turnover = \{time = 40\.0\}: unknown key; ", table)
    assert re.match(r"output\.columns = 'turnover_power': no such column on request; ", column)
