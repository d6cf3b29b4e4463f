"""By what a pass multiplies a small change of the cells: against full solves, against runs, and as a command."""

from __future__ import annotations

import csv
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx.cli import main
from remodel_fenicsx.evolution.stepper import Step
from remodel_fenicsx.model.cells import structure_tensor
from remodel_fenicsx.scene import preset_scene
from remodel_fenicsx.simulation import Simulation
from remodel_fenicsx.studies.stability import AmplificationWatcher, LinearPass, verdict
from tests.conftest import Refused
from tests.runs import AtSolved
from tests.watch.test_over_correction import Tilt

PAPER = "kuhl-holzapfel-2007"
SOLVED = 20.0


def weak_cube(end: float, frame: str = "spatial") -> Simulation:
    """The preset's cube under a force at which its pass over-corrects."""
    changes = {"loads.force.value": 0.03, "time.end": end, "remodeling.frame": frame}
    return Simulation(preset_scene(PAPER, "cube").with_values(changes), MPI.COMM_SELF)


@pytest.mark.parametrize("frame", ["spatial", "material"])
def test_the_map_is_what_a_solve_and_a_pass_make_of_other_cells(frame: str) -> None:
    """Newton's method to the end, both ways, in place of the linear answer; and the state is left as it was."""
    simulation = weak_cube(SOLVED, frame)
    stepper, cells, unknown = simulation.stepper, simulation.cells, simulation.unknown
    compared = []

    def compare(step: Step) -> None:
        if step.time != SOLVED:
            return
        change = np.random.default_rng(2).standard_normal((8, 3, 3))
        change = change + np.swapaxes(change, 1, 2)
        change[:, 0, 1] = change[:, 1, 0] = 0.0  # l_2 = l_3: a turn there is no change of A
        change[:, 1, 1] = change[:, 0, 0]
        before = [f.x.array.copy() for f in (unknown, cells.dimensions, cells.axes)]
        with closing(LinearPass(stepper, step.time, step.work.residual)) as linear:
            expected = linear(change)
            other = structure_tensor(*linear._changed(1e-5 * change)[:2]) - structure_tensor(*linear.cells[:2])
            np.testing.assert_allclose(other, 1e-5 * change, atol=1e-8)
            for array, f in zip(before, (unknown, cells.dimensions, cells.axes), strict=True):
                np.testing.assert_array_equal(f.x.array, array)
            passed = []
            for sign in (1.0, -1.0):
                linear._set(linear._changed(sign * 1e-5 * change))
                stepper.coupling.newton.solve()  # type: ignore[attr-defined]
                new, _ = stepper.remodeling.updated_cells(step.time - 1.0, step.time, step.work.residual)
                passed.append(structure_tensor(*new[:2]))
            linear._set(linear.cells)
        unknown.x.array[:] = before[0]
        compared.append(((passed[0] - passed[1]) / 2e-5, expected))

    for _ in simulation.steps([AtSolved(compare)]):
        pass
    ((found, expected),) = compared
    assert np.abs(expected).max() > 1.0
    np.testing.assert_allclose(found, expected, atol=2e-3 * np.abs(expected).max())


def test_the_factor_is_that_by_which_a_tilt_grows_in_a_run() -> None:
    straight, tilted = weak_cube(26.0), weak_cube(26.0)
    analysis = AmplificationWatcher(straight.stepper, lambda step: step.number == 26)
    straight_cells = [straight.cells.structure_tensor() for _ in straight.steps([analysis])]
    tilted_cells = [tilted.cells.structure_tensor() for _ in tilted.steps([Tilt(tilted, 16.0, 1e-8)])]
    last, one_more = (tilted_cells[k] - straight_cells[k] for k in (-2, -1))
    grown = float(np.sum(last * one_more) / np.sum(last**2))
    (found,) = analysis.found
    # lateral stresses are zero, where the positive part has a kink: a run sees one side, central differences their mean
    assert found.reversing is not None and found.reversing.factor == pytest.approx(grown, rel=0.15)
    assert grown < -2.5
    assert 0.1 < found.reversing.volume_share <= 1.0


def read(folder: Path) -> dict[str, list[float]]:
    """Columns of stability.csv."""
    with (folder / "stability.csv").open() as file:
        rows = list(csv.DictReader(file))
    return {name: [float(row[name]) for row in rows] for name in rows[0]}


def test_the_command_writes_table_and_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Refused
) -> None:
    scene = tmp_path / "weak.toml"
    scene.write_text(f'preset = "{PAPER}"\n[geometry]\nshape = "cube"\n')
    folder = tmp_path / "out"
    settings = ["time.end=14", "loads.force.value=0.01", "remodeling.coupling=relaxed"]
    arguments = [str(scene), *(f"--set={text}" for text in settings), "-o", str(folder), "--times", "2", "-q"]
    assert main(["stability", *arguments]) == 0
    table = read(folder)
    assert table["time"] == [7.0, 14.0] and table["factor"][1] < -1.0
    np.testing.assert_allclose(table["factor_of_coupling"], 1 - 0.5 * (1 - np.array(table["factor"])), rtol=1e-5)
    np.testing.assert_allclose(1 - np.array(table["stable_share"]) * (1 - np.array(table["factor"])), -1.0, rtol=1e-5)
    assert (folder / "stability.png").read_bytes().startswith(b"\x89PNG")
    assert {"history.csv", "scene.toml", "run.log"} <= {path.name for path in folder.iterdir()}
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].split()[:3] == ["time", "factor", "factor_of_coupling"] and len(printed) == 5
    assert float(printed[2].split()[-1]) == pytest.approx(table["growing_factor"][1], rel=1e-4)  # the verdict's too
    assert printed[3].startswith("Unstable: passes over-correct at 1 of 2 times, first at 14; ")
    refused("stability", *arguments)  # the folder is taken
    nothing = ("--set", "remodeling.law=none", "-o", tmp_path / "none")
    assert "nothing remodels" in refused("stability", scene, *nothing) and not (tmp_path / "none").exists()


def table(factors: list[float], growing: float = 0.5, share: float = 1.0) -> dict[str, list[float]]:
    """Of an analysis at times 1, 2, ..."""
    return {
        "time": [float(number + 1) for number in range(len(factors))],
        "factor": factors,
        "factor_of_coupling": [1 - share * (1 - factor) for factor in factors],
        "stable_share": [min(1.0, 2 / (1 - min(factor, 0.0))) for factor in factors],
        "growing_factor": [growing] * len(factors),
    }


@pytest.mark.parametrize(("found", "words"), [
    (table([-0.5, 0.2, -0.99]), "Stable: at all 3 times"),
    (table([-0.5, -1.5, -3.0]), "Unstable: passes over-correct at 2 of 3 times, first at 2; the worst multiplies a "
     "small change by -3 at time 3. The coupling 'relaxed' with a relaxation_factor below 0.5 does not."),
    (table([-0.5, -1.5, -2.9], share=0.5), "Stable: at all 3 times"),
    (table([-0.5, 0.2], growing=1.2), "Unstable: at 2 of 2 times a small change of the cells grows from pass to pass"),
    (table([0.5, 0.5], growing=1.0023), "Unstable: at 2 of 2 times a small change of the cells grows from pass to pass "
     "without swinging, first at 1; at time 1 by a factor of 1.0023 a pass, 1.00115 a unit of time."),
    (table([-0.5, np.nan]), "Not known: at 1 of 2 times no mode was found"),
])  # fmt: skip
def test_the_verdict(found: dict[str, list[float]], words: str) -> None:
    assert verdict(found, 2.0).startswith(words)
