"""The consistent variant on bodies: law `tensor`, repulsion `log`, the couplings `staggered` and `extrapolated`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.body import Cube, LoadKind
from remodel_fenicsx.scene.scene import scene_from_dict
from remodel_fenicsx.schema.units import FORCE
from remodel_fenicsx.simulation import Simulation
from tests.parts import tube
from tests.runs import goes_on, taylor_orders
from tests.values import ramp_to, ramped

Array = NDArray[np.float64]
KAPPA = 0.025


def scene(shape: str, **changes: Any) -> Any:
    values: dict[str, Any] = {
        "preset": "kuhl-holzapfel-2007",
        "geometry": {"shape": shape},
        "material": {"repulsion": "log"},
        "remodeling": {"law": "tensor", "frame": "material"} | changes.pop("remodeling", {}),
    }
    return scene_from_dict(values | changes)


def short_tube(
    end: float, step: float = 1.0, cells: str = "random", **remodeling: Any
) -> Simulation:
    """One layer of elements along the axis, coarse."""
    ramp = remodeling.pop("ramp", ramp_to(25.0))
    settings = scene(
        "tube",
        geometry={"shape": "tube", "length": 1.0},
        cells={"initial": cells},
        time={"end": end, "step": step},
        loads={"pressure": {"ramp": ramp}, "elongation": {"ramp": ramp}},
        remodeling=remodeling,
    )
    domain = tube(1.0, 3.0, 1.0, degree=1, divisions=(12, 3, 1), comm=MPI.COMM_SELF)
    return Simulation(settings, MPI.COMM_SELF, domain)


def run(simulation: Simulation) -> tuple[Array, Array, list[dict[str, float]]]:
    """Unknowns of each step, A at the end, rows."""
    rows, unknowns = [], []
    for step in simulation.steps():
        rows.append(step.row)
        unknowns.append(simulation.unknown.x.array.copy())
    return np.array(unknowns), simulation.cells.structure_tensor(), rows


@pytest.mark.parametrize("coupling, passes", [("staggered", 0), ("extrapolated", 1)])
@pytest.mark.parametrize("force", [0.01, 10.0])
def test_the_cubes_angle_is_the_closed_form(coupling: str, passes: int, force: float) -> None:
    """A_33 = r0^2 (1 - 2/3 exp(-kappa t)); the row of `staggered` is a pass behind."""
    settings = scene(
        "cube",
        remodeling={"coupling": coupling},
        loads=ramped(10.0, force=force),
        time={"end": 40.0},
    )
    simulation = Simulation(settings, MPI.COMM_SELF)
    _, A, rows = run(simulation)
    for number, row in enumerate(rows, start=1):
        left = 2 / 3 * np.exp(-KAPPA * (number - 1 + passes))
        assert row["mean_fibre_angle"] == pytest.approx(
            np.degrees(np.arctan(np.sqrt(left / (1 - left)))), abs=1e-9
        )
    np.testing.assert_allclose(np.trace(A, axis1=-2, axis2=-1), 1.0, atol=1e-13)
    assert np.abs(A - A[0, 0] * np.eye(3)).max() < 1e-12  # nothing turns


@pytest.mark.parametrize("coupling", ["staggered", "extrapolated"])
@pytest.mark.parametrize("driver", ["cauchy", "pk2", "finger"])
def test_loads_that_cross_leave_the_cube_homogeneous(
    driver: str, coupling: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Forces along x and z, of which first one is larger, then the other, equal in between."""

    def add_force(shape: Any, loading: Any, name: str) -> None:
        loading.add_dead_force(name, "x1", 0)

    monkeypatch.setitem(Cube.loads, "force_x", LoadKind(add_force, "dead force along x", FORCE))
    ramps = {"force": [[0, 0], [10, 1], [30, 0.2]], "force_x": [[0, 0], [10, 0.2], [30, 1]]}
    settings = scene(
        "cube",
        remodeling={"driver": driver, "coupling": coupling},
        loads={name: {"value": 10.0, "ramp": ramp} for name, ramp in ramps.items()},
        time={"end": 40.0},
    )
    simulation = Simulation(settings, MPI.COMM_SELF)
    _, A, rows = run(simulation)
    F = simulation.state.deformation_gradient().reshape(-1, 3, 3)
    assert (
        F[0, 0, 0] > F[0, 2, 2] + 0.05 and rows[9]["mean_stretch"] > 1.1
    )  # it is x that is stretched at last
    assert np.abs(F - F[0]).max() < 1e-8 and np.abs(A.reshape(-1, 3, 3) - A[0, 0]).max() < 1e-8


def test_little_is_made_of_what_is_off_the_axes_under_compression() -> None:
    """A off by up to 1e-3: the switch lets the lateral tension, which is noise, turn nothing."""
    ramp = ramp_to(10.0)
    settings = scene("cube", loads={"force": {"value": -10.0, "ramp": ramp}}, time={"end": 40.0})
    simulation = Simulation(settings, MPI.COMM_SELF)
    noise = np.random.default_rng(1).uniform(
        -1e-3, 1e-3, (*simulation.cells.dimension_values.shape[:2], 3, 3)
    )
    noise -= np.trace(noise, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) / 3
    before = np.eye(3) / 3 + (noise + np.swapaxes(noise, -1, -2)) / 2
    squares, vectors = np.linalg.eigh(before)
    simulation.cells.set(np.sqrt(squares), np.swapaxes(vectors, -1, -2))
    np.testing.assert_allclose(simulation.cells.structure_tensor(), before, atol=1e-14)
    _, after, rows = run(simulation)
    assert rows[-1]["mean_stretch"] < 0.9
    assert np.abs(after - before).max() < 5e-3


def test_the_tangent_is_the_derivative_of_the_residual() -> None:
    """Order 2 of the Taylor remainder, cells and deformation at random, and of the blend of two cells."""
    simulation = short_tube(4.0)
    run(simulation)
    coupling: Any = simulation.stepper.coupling
    coupling.blend.set(0.3)
    for equilibrium in (coupling.equilibrium, coupling.blend.equilibrium):
        np.testing.assert_allclose(taylor_orders(simulation, equilibrium, 1e-2), 2.0, atol=0.1)


def test_the_driving_stress_is_that_of_the_energy() -> None:
    """The pass sees the repulsion too: unloaded, with any A, no stress."""
    simulation = short_tube(1.0)
    _, tensor = simulation.stepper.remodeling.driving_tensor()
    assert np.abs(tensor).max() < 1e-12
    printed = Simulation(
        scene("tube", material={"repulsion": "axes"}, time={"end": 1.0}), MPI.COMM_SELF
    )
    assert np.abs(printed.stepper.remodeling.driving_tensor()[1]).max() < 1e-12


def test_the_extrapolated_scheme_is_of_second_order_and_the_staggered_one_of_first() -> None:
    fine = run(short_tube(4.0, 0.125, coupling="extrapolated"))
    orders = {}
    for coupling in ("staggered", "extrapolated"):
        errors = []
        for step in (1.0, 0.5):
            found = run(short_tube(4.0, step, coupling=coupling))
            errors.append(
                [np.abs(found[0][-1] - fine[0][-1]).max(), np.abs(found[1] - fine[1]).max()]
            )
        orders[coupling] = np.log2(np.array(errors[0]) / errors[1])
    assert np.all(orders["extrapolated"] > 1.7)
    np.testing.assert_allclose(orders["staggered"], 1.0, atol=0.1)


def pulled_cube(ramp: list[list[float]], end: float, **changes: Any) -> Simulation:
    """Random cells are those of two elements in each direction."""
    cells = changes.pop("cells", "isotropic")
    values: dict[str, Any] = {
        "geometry": {"shape": "cube"},
        "cells": {"initial": cells},
        "loads": {"force": {"value": changes.pop("force", 10.0), "ramp": ramp}},
        "remodeling": {"kappa": changes.pop("kappa", 0.25)},
        "time": {"end": end} | changes,
    }
    if cells == "random":
        values["mesh"] = {"refinement": 2}
    return Simulation(scene_from_dict(values), MPI.COMM_SELF)


LATE = [[4.0, 0.0], [5.0, 1.0]]
TO_NOTHING_AND_BACK = [
    [0.0, 0.0],
    [2.0, 1.0],
    [4.0, 0.0],
    [6.0, 0.0],
    [7.0, 1.0],
    [8.0, -0.2],
    [9.0, 1.0],
]


@pytest.mark.parametrize("kappa", [0.025, 0.25, 10.0])
def test_cells_that_tension_reaches_late_follow_from_then_on(kappa: float) -> None:
    """The closed form of the angle from the beginning of the tension on, in its first step too."""
    for row in run(pulled_cube(LATE, 7.0, kappa=kappa))[2]:
        left = 2 / 3 * np.exp(-kappa * max(row["time"] - 4.0, 0.0))
        expected = np.degrees(np.arctan(np.sqrt(left / (1 - left))))
        assert row["mean_fibre_angle"] == pytest.approx(expected, abs=1e-7)


def test_the_first_step_under_tension_is_as_accurate_as_the_others() -> None:
    """Of second order with it, from random cells."""
    found = {
        step: run(pulled_cube(LATE, 6.0, cells="random", force=1.0, step=step))[:2]
        for step in (1.0, 0.5, 0.125)
    }
    errors = [
        [
            np.abs(found[h][1] - found[0.125][1]).max(),
            np.abs(found[h][0][-1] - found[0.125][0][-1]).max(),
        ]
        for h in (1.0, 0.5)
    ]
    assert np.all(np.log2(np.array(errors[0]) / errors[1]) > 1.7) and np.all(
        np.array(errors[1]) < 3e-3
    )


@pytest.mark.parametrize(
    "changes", [{"cells": "random"}, {"kappa": 10.0, "cells": "random"}, {"tolerance": 1.0}]
)
def test_the_trace_stays_where_tension_comes_goes_and_comes_back(changes: dict[str, Any]) -> None:
    simulation = pulled_cube(TO_NOTHING_AND_BACK, 10.0, **changes)
    for _ in simulation.steps():
        A = simulation.cells.structure_tensor()
        np.testing.assert_allclose(np.trace(A, axis1=-2, axis2=-1), 1.0, atol=1e-12)


def test_nothing_remodels_where_the_tension_is_gone() -> None:
    """The share ahead of a tension that has just gone is below zero: it counts as none."""
    simulation, cells = pulled_cube(TO_NOTHING_AND_BACK, 10.0), {}
    for step in simulation.steps():
        cells[step.time] = simulation.cells.structure_tensor()
    for time in (5.0, 6.0):
        np.testing.assert_allclose(cells[time], cells[4.0], atol=1e-12)
    assert np.abs(cells[7.0] - cells[6.0]).max() > 0.01


def test_the_target_of_a_first_step_is_not_extrapolated() -> None:
    """Where pressure lets it count for less than one, it counts for as much in the second step."""
    simulation = short_tube(2.0, coupling="extrapolated", ramp=[[1.0, 0.0], [2.0, 0.04]])
    run(simulation)
    coupling: Any = simulation.stepper.coupling
    share = coupling._newest["switch"]
    some = (share > 0.01) & (share < 0.95)
    assert some.any()
    np.testing.assert_allclose(coupling._extrapolated(3.0).switch[some], share[some], atol=1e-13)


def test_a_step_that_is_solved_twice_is_one_step() -> None:
    """The little that its second solve moves is no measure for the next step, which would be looked into."""
    first, second = (
        step.work.newton_iterations for step in pulled_cube(ramp_to(10.0), 2.0).steps()
    )
    assert second < first


def test_late_tension_is_the_same_in_a_run_that_goes_on(tmp_path: Path) -> None:
    """What a point has had as targets, or that it has had none, is kept."""
    goes_on(pulled_cube([[1.0, 0.0], [2.0, 1.0]], 3.0).scene, tmp_path, 1.0, 2.0)


def test_where_the_extrapolated_target_would_break_the_cells_the_last_one_counts(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Chains along z whose target came from y: the target ahead is negative along y, and so would be A."""
    simulation = short_tube(4.0, coupling="extrapolated")
    run(simulation)
    coupling: Any = simulation.stepper.coupling
    state, cells = simulation.state, simulation.cells
    points = cells.dimension_values.shape[1]
    dimensions, axes = cells.dimension_values.copy(), cells.axis_values.copy()
    dimensions[0], axes[0] = [0.0, 0.0, 1.0], np.eye(3)
    cells.set(dimensions, axes)
    for targets, along in ((coupling._newest, [0.0, 0.0, 1.0]), (coupling._older, [0.0, 1.0, 0.0])):
        targets["direction"][:points], targets["switch"][:points] = np.diag(along), 1.0
    before, target = cells.structure_tensor(), coupling._extrapolated(state.time + 1.0)
    with caplog.at_level("INFO"):
        coupling._set_cells_after(target, state.time + 1.0)
    assert f"time 5: {points} points use the last target" in caplog.text
    A = cells.structure_tensor()
    np.testing.assert_allclose(
        A[0], np.broadcast_to(np.diag([0.0, 0.0, 1.0]), A[0].shape), atol=1e-14
    )
    share = -np.expm1(-KAPPA * target.switch)[:, None, None]
    expected = before.reshape(-1, 3, 3) + share * (target.direction - before.reshape(-1, 3, 3))
    np.testing.assert_allclose(A.reshape(-1, 3, 3)[points:], expected[points:], atol=1e-13)
