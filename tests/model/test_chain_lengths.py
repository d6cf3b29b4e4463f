"""Lengths of chains have any unit: L, A_p and r0 times a factor change nothing but the lengths of the cells.

c = omega k theta n/(4 A_p) goes with 1/length, psi(r) with length, g(r) with 1/length: W, and all that follows from it,
has no length of chains in it. r0 = 1, as in the paper, hides every wrong power of it.
"""

from __future__ import annotations

import logging
from typing import Any, NamedTuple

import numpy as np
import pytest
from mpi4py import MPI
from scipy.spatial.transform import Rotation

from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.energy import REPULSIONS, Tissue
from remodel_fenicsx.scene import preset_scene
from remodel_fenicsx.scene.scene import Scene
from remodel_fenicsx.simulation import Simulation
from tests.conftest import warnings_of
from tests.runs import columns
from tests.tables import rows as table, values as values_of
from tests.values import deformations
from tests.watch.test_over_correction import Tilt

PAPER = "kuhl-holzapfel-2007"
METRES = 1e-9
POWER = 2.0**-30  # about metres
BASES: dict[str, dict[str, Any]] = {
    "point": {"model.kinematics": "point", "time.end": 12.0, "time.step": 2.0},
    "random": {"mesh.refinement": 2, "cells.initial": "random", "time.end": 6.0, "time.step": 2.0},
    "radial": {
        "model.kinematics": "radial",
        "cells.initial": "isotropic",
        "time.end": 30.0,
        "time.step": 5.0,
    },
}
CASES = {
    name: (preset, shape, BASES[base] | values_of(changes))
    for name, preset, shape, base, changes in table(__file__, "chain_lengths.txt")
}


class Run(NamedTuple):
    """Rows by column, Newton iterations of the steps, what was said, lengths of the cells at the end over the unit."""

    rows: dict[str, np.ndarray]
    iterations: list[int]
    said: list[str]
    lengths: np.ndarray


def scene_in(unit: float, preset: str, shape: str, changes: dict[str, Any]) -> Scene:
    """Of a case, with lengths of chains in another unit; one nm is `unit` of it."""
    scene = preset_scene(preset, shape).with_values(
        {"output.columns": ["pass_residual"], **changes}
    )
    lengths = {
        "material.contour_length": scene.material.contour_length,
        "material.persistence_length": scene.material.persistence_length,
        "cells.end_to_end_length": scene.cells.end_to_end_length,
    }
    return scene.with_values({name: unit * length for name, length in lengths.items()})


def run(name: str, unit: float, caplog: pytest.LogCaptureFixture) -> Run:
    caplog.clear()
    with caplog.at_level(logging.INFO, "remodel_fenicsx"):
        simulation = Simulation(scene_in(unit, *CASES[name]), MPI.COMM_SELF)
        steps = list(simulation.steps())
    said = [line for line in caplog.messages if "compil" not in line]
    rows = columns([step.row for step in steps])
    rows["pass_residual"] = rows["pass_residual"] / unit**2
    del rows["seconds"]
    return Run(
        rows,
        [step.work.newton_iterations for step in steps],
        said,
        simulation.cells.dimension_values / unit,
    )


IN_NANOMETRES: dict[str, Run] = {}  # runs of the cases as they are, each made once


def assert_same(found: Run, expected: Run, digits: float) -> None:
    assert found.iterations == expected.iterations
    assert found.said == expected.said
    np.testing.assert_allclose(
        found.lengths, expected.lengths, rtol=0, atol=digits * expected.lengths.max()
    )
    for column, values in expected.rows.items():
        if values.size > 1 or column not in (
            "remodeling_power",
            "pass_residual",
        ):  # of an equilibrium: rounding
            size = np.nanmax(np.abs(values), initial=0.0)
            np.testing.assert_allclose(
                found.rows[column], values, rtol=0, atol=digits * size, err_msg=column
            )


@pytest.mark.parametrize("name", CASES)
def test_another_unit_changes_nothing(name: str, caplog: pytest.LogCaptureFixture) -> None:
    """A power of two rounds nothing, so that all that is said, and every number, is the same."""
    expected = IN_NANOMETRES.get(name) or IN_NANOMETRES.setdefault(name, run(name, 1.0, caplog))
    assert_same(run(name, POWER, caplog), expected, 1e-15)
    if name == "load to nothing and back":
        assert any("cells resume remodeling" in text for text in expected.said)


def test_a_swing_is_warned_of_alike(caplog: pytest.LogCaptureFixture) -> None:
    said = []
    for unit in (1.0, POWER):
        caplog.clear()
        simulation = Simulation(
            scene_in(unit, PAPER, "cube", {"loads.force.value": 0.01, "time.end": 35.0})
        )
        list(simulation.steps([Tilt(simulation, 20.0, 1e-8)]))
        said.append(warnings_of(caplog))
    assert said[1] == said[0] and "overshoots" in said[0][0]


@pytest.mark.parametrize("name", ["explicit", "strong", "extrapolated"])
def test_units_that_round(name: str, caplog: pytest.LogCaptureFixture) -> None:
    expected = IN_NANOMETRES.get(name) or IN_NANOMETRES.setdefault(name, run(name, 1.0, caplog))
    for unit in (METRES, 92.4, 1e6):
        assert_same(run(name, unit, caplog), expected, 1e-13)


def test_the_rounding_of_a_stress_is_one() -> None:
    """r^2 d(g r)/dr: against differences of the network's stress in a stretch of all chains."""
    for unit in (1.0, METRES, 1e6):
        tissue = Tissue(0.0, 0.0, 1.57 / unit, 1.594 * unit, 1.1 * unit)
        assert tissue.chain is not None
        for r in np.array([0.3, 1.0, 1.5]) * unit:
            up, down = (
                tissue.chain.stiffness(r * s, 1.594 * unit) * r * s for s in (1 + 1e-6, 1 - 1e-6)
            )
            tension = 1.57 / unit * (up - down) * r / 2e-6  # c dF/d(ln r) r
            initial = (
                1.57 / unit * tissue.chain.stiffness(1.1 * unit, 1.594 * unit) * (1.1 * unit) ** 2
            )
            assert tissue.stiffness(r) == pytest.approx(tension + initial, rel=1e-5)


@pytest.mark.parametrize("repulsion", REPULSIONS)
def test_the_energy_has_no_length_in_it(repulsion: str) -> None:
    rng, found = np.random.default_rng(3), []
    F, axes = deformations(12, rng), Rotation.random(12, random_state=rng).as_matrix()
    lengths = np.abs(rng.standard_normal((12, 3)))
    lengths /= np.linalg.norm(lengths, axis=1, keepdims=True)
    for unit in (1.0, METRES, 1e6):
        tissue = Tissue(27.3, 3.1, 1.57 / unit, 1.594 * unit, unit, repulsion=REPULSIONS[repulsion])
        old, new = (UnitCell(l * unit * lengths, axes) for l in (1.0, 1.01))
        found.append([tissue.strain_energy(F, [old]), tissue.energy_increment(F, old, new)])
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], rtol=1e-11)
