"""By what a pass multiplies a small change of the cells: against full solves, against runs, and as a command."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx.cli import main
from remodel_fenicsx.scene import preset_scene
from remodel_fenicsx.simulation import Simulation
from remodel_fenicsx.studies.stability import Analysis, FactorWatcher
from tests.conftest import Refused
from tests.tables import of_csv
from tests.watch.test_over_correction import Tilt

PAPER = "kuhl-holzapfel-2007"


def weak_cube(end: float) -> Simulation:
    """The preset's cube under a force at which its pass over-corrects."""
    changes = {"loads.force.value": 0.03, "time.end": end}
    return Simulation(preset_scene(PAPER, "cube").with_values(changes), MPI.COMM_SELF)


def test_the_factor_is_that_by_which_a_tilt_grows_in_a_run() -> None:
    straight, tilted = weak_cube(26.0), weak_cube(26.0)
    analysis = FactorWatcher(straight.stepper, lambda step: step.number == 26)
    straight_cells = [straight.cells.structure_tensor() for _ in straight.steps([analysis])]
    tilted_cells = [
        tilted.cells.structure_tensor() for _ in tilted.steps([Tilt(tilted, 16.0, 1e-8)])
    ]
    last, one_more = (tilted_cells[k] - straight_cells[k] for k in (-2, -1))
    grown = np.sign(np.sum(last * one_more)) * np.linalg.norm(one_more) / np.linalg.norm(last)
    # lateral stresses are zero, where the positive part has a kink: a run sees one side, central differences their mean
    assert analysis.factors == {26.0: pytest.approx(grown, rel=0.15)} and grown < -2.5


def test_the_command_writes_table_and_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Refused
) -> None:
    """The coupling makes a half of each pass, which then swings by less."""
    scene, factors = tmp_path / "weak.toml", {}
    scene.write_text(f'preset = "{PAPER}"\n[geometry]\nshape = "cube"\n')
    for coupling in ("staggered", "relaxed"):
        folder = tmp_path / coupling
        settings = ["time.end=14", "loads.force.value=0.01", f"remodeling.coupling={coupling}"]
        arguments = [
            str(scene),
            *(f"--set={text}" for text in settings),
            "-o",
            str(folder),
            "--times",
            "2",
            "-q",
        ]
        assert main(["stability", *arguments]) == 0
        table = of_csv(folder / "stability.csv")
        assert [(list(row), row["time"]) for row in table] == [
            (["time", "factor"], "7"),
            (["time", "factor"], "14"),
        ]
        factors[coupling] = float(table[1]["factor"])
        assert (folder / "stability.png").read_bytes().startswith(b"\x89PNG") and (
            folder / "run.log"
        ).exists()
        printed = capsys.readouterr().out.splitlines()
        assert printed[0].split() == ["time", "factor"] and len(printed) == 5
        assert printed[3].startswith("Unstable: at 2 of 2 times")
    assert factors["staggered"] < factors["relaxed"] < -1.0
    refused("stability", *arguments)  # the folder is taken
    nothing = ("--set", "remodeling.law=none", "-o", tmp_path / "none")
    assert (
        "nothing remodels" in refused("stability", scene, *nothing)
        and not (tmp_path / "none").exists()
    )


@pytest.mark.parametrize(("factors", "words"), [
    ([-0.5, 0.2, 1.0], "Stable: at all 3 times a pass makes small changes of the cells smaller, or keeps them."),
    ([-0.5, -1.5, -3.0], "Unstable: at 2 of 3 times a pass makes small changes of the cells larger, first at 2; the "
     "worst by a factor of -3, at time 3. The coupling 'relaxed' with a relaxation_factor below 0.5 damps the "
     "oscillation."),
    ([-0.5, 1.2], "Unstable: at 1 of 2 times a pass makes small changes of the cells larger, first at 2; the "
     "worst by a factor of 1.2, at time 2."),
    ([-0.5, np.nan], "Unknown: at 1 of 2 times the factor could not be computed; stable at all other times."),
])  # fmt: skip
def test_the_verdict(factors: list[float], words: str) -> None:
    by_time = {number + 1.0: factor for number, factor in enumerate(factors)}
    scene = preset_scene(PAPER, "cube")
    assert Analysis(scene, by_time, "full", 1.0).verdict() == words
    assert "relaxation_factor below 0.25" in Analysis(scene, {1.0: -3.0}, "full", 0.5).verdict()
    unseen = " But kinematics 'point' shows only changes with its symmetry; 'full' shows all."
    assert Analysis(scene, by_time, "point", 1.0).verdict() == words + unseen
