"""The equilibrium of cells and stress at once, against time stepping, other starts and the design's own figures."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx import Recording, Scene, SceneError, Simulation, cli
from remodel_fenicsx.body import tube
from remodel_fenicsx.evolution.homeostasis import Homeostasis
from remodel_fenicsx.evolution.uniqueness import STARTS, check_uniqueness
from remodel_fenicsx.results.columns import Measurement
from remodel_fenicsx.running import resume, run
from remodel_fenicsx.scene import scene_from_dict
from tests.conftest import Case, slowly

SELF = MPI.COMM_SELF
Array = NDArray[np.float64]


def values(kinematics: str = "radial", **tables: Any) -> dict[str, Any]:
    """The artery of isotropic cells."""
    base: dict[str, Any] = {
        "preset": "kuhl-holzapfel-2007",
        "geometry": {"shape": "tube"},
        "model": {"kinematics": kinematics},
        "cells": {"initial": "isotropic"},
        "time": {"end": "equilibrium"},
        "output": {"columns": ["pass_residual"], "fields": False},
    }
    return base | tables


def artery(kinematics: str = "radial", **tables: Any) -> Scene:
    return scene_from_dict(values(kinematics, **tables))


def coarse(cells: str, comm: Any = SELF, **remodeling: Any) -> Simulation:
    """One layer of a tube in three dimensions, few elements."""
    material = {"repulsion": "log" if remodeling.get("law") == "tensor" else "axes"}
    tables = {"cells": {"initial": cells}, "material": material, "remodeling": {"frame": "material"} | remodeling}
    scene = scene_from_dict(values("full", **tables) | {"geometry": {"shape": "tube", "length": 1.0}})
    return Simulation(scene, comm, tube(1.0, 3.0, 1.0, degree=1, divisions=(8, 3, 1), comm=comm))


def solved(simulation: Simulation) -> dict[str, float]:
    """The row of the only step."""
    (step,) = simulation.steps()
    return step.row


# ---------------------------------------------------------------- what it is
@pytest.mark.parametrize("driver", ["cauchy", "finger", *slowly("pk2")])
def test_it_is_where_time_leads(driver: str) -> None:
    """Staggered steps to t = 900, relaxed where they over-correct: the same lengths."""
    at_once = Simulation(artery(remodeling={"driver": driver}), SELF)
    row = solved(at_once)
    coupling = at_once.stepper.coupling
    assert isinstance(coupling, Homeostasis) and coupling.solves <= 15 and row["newton_iterations"] <= 60
    assert row["pass_residual"] < 1e-8
    changes = {"driver": driver, "coupling": "relaxed" if driver != "cauchy" else "staggered"}
    in_time = Simulation(artery(remodeling=changes, time={"end": 900.0, "step": 12.5}), SELF)
    last = list(in_time.steps())[-1].row
    np.testing.assert_allclose(at_once.cells.dimension_values, in_time.cells.dimension_values, rtol=0, atol=1e-6)
    for name in ("inner_radius", "outer_radius", "stored_energy"):
        assert row[name] == pytest.approx(last[name], rel=1e-6)
    assert row["inner_radius"] > 1.3  # remodeled, and loaded


def test_relaxation_and_tensor_have_the_same_limit_as_eq_11() -> None:
    """In a body whose axes are those of its loads; A has no memory of the start."""
    found = []
    for law in ("explicit", "relaxation", "tensor"):
        material = {"repulsion": "log" if law == "tensor" else "axes"}
        simulation = Simulation(artery(remodeling={"law": law, "frame": "material"}, material=material), SELF)
        assert solved(simulation)["pass_residual"] < 1e-8
        found.append(simulation.cells.structure_tensor())
    np.testing.assert_allclose(found[1], found[0], atol=1e-9)
    np.testing.assert_allclose(found[2], found[0], atol=1e-9)


@pytest.mark.parametrize("law", ["explicit", *slowly("tensor")])
def test_random_cells_come_to_the_same_state(law: str, caplog: pytest.LogCaptureFixture) -> None:
    """By passes; isotropic ones go along the path."""
    found = []
    for cells in ("isotropic", "random"):
        with caplog.at_level(logging.INFO):
            caplog.clear()
            simulation = coarse(cells, law=law)
            assert solved(simulation)["pass_residual"] < 1e-8
        assert ("relaxed passes" in caplog.text) == (cells == "random")
        found.append(simulation.cells.structure_tensor())
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)
    assert np.abs(found[0] - np.eye(3) / 3).max() > 0.3


@pytest.mark.slow
def test_one_and_two_ranks_agree(case: Case) -> None:
    scene = values("full") | {"geometry": {"shape": "cube"}, "mesh": {"refinement": 2}, "cells": {"initial": "random"}}
    one, two = (case(scene, ranks=ranks) for ranks in (1, 2))
    for name in ("u", "l"):
        np.testing.assert_allclose(two[name], one[name], atol=1e-8)
    np.testing.assert_allclose(np.sort(one["l"], axis=-1)[..., :2], 0.0, atol=1e-6)  # all of it along the load


TABLE = [
    # driver, frame, r_i, r_o, angles of the eight layers
    ("cauchy", "spatial", 1.4092, 3.0561, [0.38, 3.48, 14.06, 49.71, 64.03, 69.74, 72.92, 75.00]),
    ("cauchy", "material", 1.4064, 3.0550, [0.41, 3.52, 14.27, 50.18, 64.29, 69.90, 73.04, 75.10]),
    ("finger", "material", 1.5377, 3.1219, [30.3, 35.8, 39.6, 42.4, 44.4, 45.8, 47.0, 47.8]),
    ("pk2", "material", 1.4068, 3.0549, [0.65, 4.75, 16.50, 51.07, 61.54, 66.59, 69.66, 71.74]),
]


@pytest.mark.slow
@pytest.mark.parametrize(("driver", "frame", "inner", "outer", "angles"), TABLE)
def test_the_full_artery(driver: str, frame: str, inner: float, outer: float, angles: list[float]) -> None:
    """At most 15 solves and 60 iterations; means over the points of each layer of elements."""
    simulation = Simulation(artery("full", remodeling={"driver": driver, "frame": frame}), SELF)
    (step,) = simulation.steps()
    coupling = simulation.stepper.coupling
    assert isinstance(coupling, Homeostasis) and coupling.solves <= 15
    assert step.row["newton_iterations"] <= 60 and step.row["pass_residual"] < 1e-8
    assert (step.row["inner_radius"], step.row["outer_radius"]) == pytest.approx((inner, outer), abs=1e-3)
    angle = Measurement(simulation.observer, step).fibre_angle
    radius = np.linalg.norm(simulation.quadrature.coordinates[..., :2], axis=-1).mean(axis=1)
    layer = np.clip(((radius - 1.0) / 0.25).astype(int), 0, 7)
    means = [angle[layer == number].mean() for number in range(8)]
    np.testing.assert_allclose(means, angles, rtol=0, atol=0.1)


# ---------------------------------------------------------------- other starts
def test_other_starts_lead_to_the_same_state(caplog: pytest.LogCaptureFixture) -> None:
    simulation = Simulation(artery(), SELF)
    solved(simulation)
    coupling, before = simulation.stepper.coupling, simulation.state.snapshot()
    assert isinstance(coupling, Homeostasis)
    others = check_uniqueness(coupling, before.loads)
    assert [other.start for other in others] == list(STARTS) and all(other.distance < 1e-6 for other in others)
    after = simulation.state.snapshot()
    for name, array in before.arrays.items():
        np.testing.assert_array_equal(after.arrays[name], array)
    assert (after.time, after.number, after.loads) == (before.time, before.number, before.loads)
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]


def test_a_body_that_forgets_nothing_has_many_equilibria(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without tension no cell changes: every start is its own end, and that is said."""
    scene = scene_from_dict(values("point") | {"geometry": {"shape": "cube"}, "loads": {"force": {"value": 0.0}}})
    path = tmp_path / "cube.toml"
    path.write_text(scene.to_toml())
    assert cli.main(["run", str(path), "-o", str(tmp_path / "out"), "--check-uniqueness"]) == 0
    said = capsys.readouterr().err
    assert "uniqueness: from random cells to another equilibrium" in said
    assert "uniqueness: from isotropic cells to the same equilibrium" in said


def test_only_an_equilibrium_has_other_starts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "cube.toml"
    path.write_text(artery(time={"end": 2.0}).to_toml())
    assert cli.main(["run", str(path), "-o", str(tmp_path / "out"), "--check-uniqueness"]) == 2
    assert "--check-uniqueness: only with time.end = 'equilibrium'" in capsys.readouterr().err


# ---------------------------------------------------------------- scenes and records
@pytest.mark.parametrize(
    ("changes", "allowed", "words"),
    [
        ({"remodeling.law": "rate"}, {"remodeling.law": "relaxation"}, "'rate' has no limit"),
        ({"remodeling.law": "rotation", "model.kinematics": "full"}, {"remodeling.law": "explicit"}, "no limit"),
        ({"remodeling.law": "none"}, {"remodeling.law": "explicit"}, "no limit"),
        ({"remodeling.kappa": 0.0}, {"remodeling.kappa": 0.1}, "never change"),
        ({"material.chain_density": 0.0}, {"material.chain_density": 1e21}, "needs chains"),
        ({"time.end": "soon"}, {"time.end": 3.0}, "a finite number greater than 0, or 'equilibrium'"),
        ({"time.end": -1.0}, {"time.end": 1}, "a finite number greater than 0, or 'equilibrium'"),
    ],
)
def test_what_has_no_equilibrium_is_refused(changes: dict[str, Any], allowed: dict[str, Any], words: str) -> None:
    with pytest.raises(SceneError, match=words) as error:
        artery().with_values(changes)
    assert str(error.value).startswith("time.end = ") and "\n" not in str(error.value)
    artery().with_values(allowed)


def test_a_run_that_goes_on_to_the_equilibrium(tmp_path: Path) -> None:
    """From random cells that have remodeled for a while, to where the equilibrium at once is."""
    tables: dict[str, Any] = {"geometry": {"shape": "cube"}, "mesh": {"refinement": 2}, "cells": {"initial": "random"}}
    tables["output"] = {"columns": ["mean_stretch", "pass_residual"]}
    at_once = run(scene_from_dict(values("full") | tables), tmp_path / "at_once", SELF)
    in_parts = run(scene_from_dict(values("full") | tables | {"time": {"end": 40.0}}), tmp_path / "in_parts", SELF)
    resume(in_parts, ["time.end=equilibrium"], SELF)
    first, second = Recording(at_once), Recording(in_parts)
    assert first.scene.time.end == second.scene.time.end == "equilibrium"
    assert len(first.history["time"]) == 2 and len(second.history["time"]) == 42
    assert second.history["mean_stretch"][-1] == pytest.approx(first.history["mean_stretch"][-1], rel=1e-7)
    assert abs(second.history["mean_stretch"][-2] / second.history["mean_stretch"][-1] - 1) > 1e-4
    assert max(record.history["pass_residual"][-1] for record in (first, second)) < 1e-8
    time = first.scene.last_time
    np.testing.assert_array_equal(first.times, [0.0, time])
    np.testing.assert_allclose(first.fields(time)["displacement"], second.fields(time)["displacement"], atol=1e-6)
    resume(in_parts, [], SELF)  # nothing is left to do
    assert len(Recording(in_parts).history["time"]) == 42
