"""The implicit coupling on bodies: cells that belong to the stress of the same step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.evolution.implicit import Implicit
from remodel_fenicsx.model.cells import structure_tensor
from remodel_fenicsx import Recording
from remodel_fenicsx.running import run as record
from remodel_fenicsx.scene.scene import scene_from_dict
from remodel_fenicsx.simulation import Simulation
from remodel_fenicsx.solver.continuation import StepFailure
from tests.conftest import Case, slowly
from tests.parts import tube
from tests.runs import goes_on, taylor_orders
from tests.values import isotropic

Array = NDArray[np.float64]


def short_tube(end: float, step: float = 1.0, law: str = "tensor", comm: Any = MPI.COMM_SELF, **changes: Any) -> Any:
    """One layer of elements along the axis, coarse."""
    divisions = changes.pop("divisions", (12, 3, 1))
    values: dict[str, Any] = {
        "preset": "kuhl-holzapfel-2007",
        "geometry": {"shape": "tube", "length": 1.0},
        "material": {"repulsion": "log" if law == "tensor" else "axes"},
        "cells": {"initial": changes.pop("cells", "random")},
        "time": {"end": end, "step": step},
        "solver": {"method": changes.pop("method", "auto")},
        "output": {"columns": ["pass_residual"]},
        "remodeling": {"law": law, "coupling": "implicit", "frame": "material"} | changes,
    }
    domain = tube(1.0, 3.0, 1.0, degree=1, divisions=divisions, comm=comm)
    return Simulation(scene_from_dict(values), comm, domain)


def run(simulation: Simulation) -> list[dict[str, float]]:
    return [step.row for step in simulation.steps()]


def missed(simulation: Simulation, time: float) -> Array:
    """By how much a pass with the present stress, from the cells of the step before, would make other cells."""
    pass_ = simulation.stepper.remodeling
    assert pass_._change is not None
    before, now = pass_._change
    law, drive = pass_.law, pass_.drive(simulation.state.numbers["residual of the last step"])
    asked = law.update(before, drive, time - 1.0, time)
    return np.linalg.norm(structure_tensor(*asked[:2]) - structure_tensor(*now[:2]), axis=(1, 2))


@pytest.mark.parametrize("driver", ["cauchy", *slowly("pk2", "finger")])
def test_random_cells_belong_to_their_stress(driver: str) -> None:
    """The law for A: no step made in parts, four iterations a step in the mean; tr A stays."""
    simulation = short_tube(8.0, driver=driver, divisions=(8, 2, 1))
    rows = run(simulation)
    assert all(row["substeps"] == 1 for row in rows)
    assert np.mean([row["newton_iterations"] for row in rows[1:]]) <= 4
    assert missed(simulation, 8.0).max() < 1e-8
    A = simulation.cells.structure_tensor()
    np.testing.assert_allclose(np.trace(A, axis1=-2, axis2=-1), 1.0, atol=1e-13)


@pytest.mark.parametrize("driver, frame", [("cauchy", "spatial"), *slowly(("pk2", "material"), ("finger", "material"))])
def test_the_printed_law_from_isotropic_cells(driver: str, frame: str) -> None:
    """At most six iterations a step (the first one, from cells that do not answer, apart), and a symmetric tube."""
    simulation = short_tube(8.0, law="explicit", cells="isotropic", driver=driver, frame=frame, divisions=(8, 3, 1))
    rows = run(simulation)
    assert max(row["newton_iterations"] for row in rows[1:]) <= 6
    assert all(row["substeps"] == 1 for row in rows)
    assert missed(simulation, 8.0).max() < 1e-6
    radii = np.round(np.linalg.norm(simulation.quadrature.coordinates[..., :2], axis=-1), 6)
    lengths = simulation.cells.dimension_values
    assert max(np.ptp(lengths[radii == radius], axis=0).max() for radius in np.unique(radii)) < 1e-8


def test_eq_11_has_no_error_of_the_time_step() -> None:
    """It is a function of the present stress and of absolute time: so is the implicit state."""
    ends = []
    for step in (5.0, 1.25):
        simulation = short_tube(5.0, step, law="explicit", cells="isotropic", frame="spatial", divisions=(8, 3, 1))
        run(simulation)
        ends.append(simulation.cells.structure_tensor())
    assert np.abs(ends[0] - ends[1]).max() < 1e-7 < np.abs(ends[0] - np.eye(3) / 3).max()


@pytest.mark.parametrize(
    "law, cells, end", [("explicit", "isotropic", 5.0), ("tensor", "random", 3.0), *slowly(("tensor", "random", 5.0))]
)
def test_long_steps_run(law: str, cells: str, end: float) -> None:
    """kappa times the step is ten; iterations are counted with the tangent of each, for kept factors take more."""
    divisions = (12, 3, 1) if end == 5.0 else (4, 3, 1)
    simulation = short_tube(end, law=law, cells=cells, kappa=10.0, divisions=divisions, method="direct")
    rows = run(simulation)
    assert rows[-1]["newton_iterations"] <= 4 and rows[-1]["substeps"] == 1
    assert missed(simulation, end).max() < 1e-6


def test_a_run_of_before_ends_at_a_step_without_a_solution(tmp_path: Path) -> None:
    """A scene as 0.3.0 ran it is read, random cells under a printed law or not: exit code 3, and rows are kept."""
    values = cube(1.0) | {"format": 2, "remodeling": {"law": "explicit", "coupling": "implicit", "driver": "finger"}}
    values |= {"material": {}, "output": {"fields": False, "report": False, "columns": ["held_points"]}}
    scene = scene_from_dict(values)
    assert not scene.output.columns and scene.with_values({"name": "again"}).is_as_run
    with pytest.raises(StepFailure) as failed:
        record(scene, tmp_path / "run", MPI.COMM_SELF)
    assert failed.value.exit_code == 3 and len(Recording(tmp_path / "run").history["time"]) == 1


def pulled_cube(force: float, end: float, law: str = "explicit", kappa: float = 0.5, **material: float) -> Simulation:
    """Isotropic cells, pulled from the first step on."""
    values = isotropic(
        None, "auto", geometry={"shape": "cube"}, material=material, time={"end": end},
        loads={"force": {"value": force, "ramp": [[0.0, 1.0]]}},
        remodeling={"law": law, "coupling": "implicit", "kappa": kappa},
        output={"columns": ["mean_fibre_angle", "newton_iterations"]},
    )  # fmt: skip
    return Simulation(scene_from_dict(values), MPI.COMM_SELF)


@pytest.mark.parametrize("law", ["explicit", "rate", "relaxation"])
def test_isotropic_cells_under_a_weak_load(law: str) -> None:
    """The closed form of eq. (11) under uniaxial tension, across l0 (1 - s): all printed laws have it."""
    for row in run(pulled_cube(0.2, 3.0, law)):
        s = -np.expm1(-0.5 * row["time"])
        expected = np.degrees(np.arctan(np.sqrt(2) * (1 - s) / (1 - s + np.sqrt(3) * s)))
        assert row["mean_fibre_angle"] == pytest.approx(expected, abs=1e-6)


def test_a_hard_step_starts_again_from_passes_with_frozen_cells() -> None:
    """lambda/mu = 1e6 and chains near L: cells that follow F are far too sensitive to start from; the closed form."""
    for row in run(pulled_cube(10.0, 2.0, lame_lambda=1e6, lame_mu=1.0)):
        s = -np.expm1(-0.5 * row["time"])
        expected = np.degrees(np.arctan(np.sqrt(2) * (1 - s) / (1 - s + np.sqrt(3) * s)))
        assert row["mean_fibre_angle"] == pytest.approx(expected, abs=1e-6)
        assert row["newton_iterations"] < 150


def test_cells_across_the_load_are_solved() -> None:
    """At the strain of the cells before there is no solution, without tension they stay; in equilibrium there is one.

    Under uniaxial tension eq. (10) gives l = l_old exp(-kappa dt) + (1 - exp(-kappa dt)) r0 along the load.
    """
    values = {
        "geometry": {"shape": "cube"},
        "cells": {"initial": "aligned", "aligned_axis": 2},
        "loads": {"force": {"value": 0.06, "ramp": [[0.0, 0.0], [20.0, 1.0]]}},
        "remodeling": {"law": "relaxation", "frame": "material", "coupling": "implicit", "kappa": 0.025},
        "time": {"end": 40.0, "step": 20.0},
        "output": {"columns": ["mean_fibre_angle", "newton_iterations"]},
    }
    rows = run(Simulation(scene_from_dict(values), MPI.COMM_SELF))
    for row in rows[1:]:
        left = np.exp(-0.025 * row["time"])
        expected = np.degrees(np.arctan(left / (1 - left)))
        assert row["mean_fibre_angle"] == pytest.approx(expected, abs=1e-3)


def test_the_tangent_is_the_derivative_of_the_residual() -> None:
    """Order 2 of the Taylor remainder of the assembled forces, cells and deformation at random."""
    simulation = short_tube(3.0)
    run(simulation)
    coupling: Any = simulation.stepper.coupling
    assert isinstance(coupling, Implicit)
    coupling.cells.begin(5.0, 0.0)
    np.testing.assert_allclose(taylor_orders(simulation, coupling.newton.equilibrium, 1e-4), 2.0, atol=0.15)


def test_another_end_of_the_step_has_another_stress_at_the_same_unknowns() -> None:
    """A part that fails takes back its time before any unknown has changed."""
    simulation = short_tube(3.0)
    run(simulation)
    coupling: Any = simulation.stepper.coupling
    cells, stresses = coupling.cells, []
    cells.begin(5.0, 0.0)
    for time in (5.0, 15.0, 5.0):
        cells.set_time(time)
        stresses.append(cells.solution().first_piola_kirchhoff)
        np.testing.assert_array_equal(cells.stress.x.array, stresses[-1].ravel())
    assert np.abs(stresses[1] - stresses[0]).max() > 1e-2 * np.abs(stresses[0]).max()
    np.testing.assert_array_equal(stresses[2], stresses[0])


def cube(end: float) -> dict[str, Any]:
    """Eight elements with random cells, pulled."""
    return {
        "preset": "kuhl-holzapfel-2007",
        "geometry": {"shape": "cube"},
        "mesh": {"refinement": 2},
        "material": {"repulsion": "log"},
        "cells": {"initial": "random"},
        "remodeling": {"law": "tensor", "coupling": "implicit", "frame": "material"},
        "time": {"end": end},
        "solver": {"absolute_tolerance": 1e-10, "relative_tolerance": 0.0},
        "output": {"fields": False},
    }


ON_ONE_AND_TWO_RANKS = [{"scene": cube(4.0)}]


def test_one_and_two_ranks_agree(case: Case) -> None:
    one, two = (case(cube(4.0), ranks=ranks) for ranks in (1, 2))
    for name in ("u", "l"):
        np.testing.assert_allclose(two[name], one[name], atol=1e-8)


def test_a_run_goes_on_as_if_nothing_had_happened(tmp_path: Path) -> None:
    goes_on(cube(6.0), tmp_path, 3.0)
