"""Equilibria are known for what they are: negative eigenvalues of the tangent, who looks when, and what is said."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx import Scene, read_scene
from remodel_fenicsx.evolution.stepper import Step
from remodel_fenicsx.schema.settings import Cells
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.solver.equilibrium import StateLimits
from remodel_fenicsx.solver.diagnosis import Inertia, diagnose_failure
from remodel_fenicsx.solver.newton import SolveFailure, Solution
from remodel_fenicsx.watch import stability as equilibrium_stability
from remodel_fenicsx.watch.stability import EquilibriumStability
from tests import parts
from tests.conftest import warnings_of
from tests.parts import cube, tube
from tests.runs import made
from tests.values import ramp_to

DEMOS = Path(__file__).parents[2] / "demos"
COLUMN = {"output.columns": ["negative_eigenvalues"]}


def pushed_cube(force: float, **values: Any) -> Scene:
    """The demo's cube under a force that is there after three steps."""
    scene = read_scene(DEMOS / "cube.toml")
    ramp = ramp_to(3.0)
    return scene.with_values(
        {"loads.force.value": force, "loads.force.ramp": ramp, "time.end": 4.0, **values}
    )


def run(scene: Scene, domain: Any = None) -> list[Step]:
    """Its steps."""
    with made(scene, domain) as simulation:
        return list(simulation.steps())


# ---------------------------------------------------------------- the count
def test_count_and_lowest_eigenvalue_are_those_of_the_dense_matrix() -> None:
    """A follower pressure and random cells: the tangent has every kind of entry; prescribed unknowns do not count."""
    made = parts.body(
        tube(length=1.0, divisions=(8, 2, 1)), Cells(initial="random", axes="cylindrical")
    ).supported()
    problem = made.problem()
    made.loading.set(
        {"pressure": -20.0, "elongation": 0.0}
    )  # no equilibrium: a tangent is one anywhere
    rng = np.random.default_rng(5)
    made.set_displacement(0.03 * rng.standard_normal(made.nodes.shape))
    matrix = problem.create_matrix()
    problem.assemble_tangent(matrix)
    dense = matrix.convert("dense").getDenseArray()
    free = np.isnan(problem.prescribed_values())
    dense_free = dense[np.ix_(free, free)]
    expected, modes = np.linalg.eig(dense_free)
    lowest = np.argmin(expected.real)
    assert (
        np.abs(dense - dense.T).max() > 1e-6 * np.abs(dense).max() and (expected.real < 0).sum() > 1
    )
    inertia = Inertia(problem)
    assert inertia.negative_eigenvalues() == (expected.real < 0).sum()
    mode = inertia.lowest()
    assert mode.eigenvalue == pytest.approx(expected[lowest].real, rel=1e-6)
    full = np.zeros(len(free))
    full[free] = modes[:, lowest].real
    assert inertia.cosine(mode, full) == pytest.approx(1.0, abs=1e-6)
    assert inertia.cosine(mode, np.where(free, 0.0, 1.0)) == pytest.approx(0.0, abs=1e-12)
    largest = made.nodes[np.argmax(np.linalg.norm(full.reshape(-1, 3), axis=1))]
    np.testing.assert_allclose(mode.place, largest, atol=1e-9)
    made.set_displacement(np.zeros(made.nodes.shape))
    made.loading.set({"pressure": 0.0})
    assert inertia.negative_eigenvalues() == 0 and inertia.lowest().eigenvalue > 0
    inertia.close()


@pytest.mark.parametrize("load", ["pulled", "pushed", "dead thrust"])
def test_a_pressure_that_follows_a_free_end_has_no_buckling_load(
    load: str, caplog: pytest.LogCaptureFixture
) -> None:
    """A clamped beam under follower tension or thrust bends in no direction (EI w'' = T w: only w = 0).

    The symmetric part of its tangent is indefinite nevertheless. A dead thrust of this size is beyond Euler's load.
    """
    made = parts.body(parts.tendon(area=1.0), Cells(initial="isotropic"))
    made.loading.hold_facets(made.domain.facet_tags.find(made.domain.faces["bottom"]))
    if load == "dead thrust":
        made.loading.add_dead_force("end", "top", component=2)
    else:
        made.loading.add_follower_pressure("end", "top")
    size = 0.15 if load == "pushed" else -0.15
    stepper = made.stepper(lambda t: {"end": size * t}, law="none")
    watcher = EquilibriumStability(stepper, every_step=True)
    last = [*stepper.march([0.5, 1.0], [watcher])][-1]
    matrix = stepper.coupling.equilibrium.create_matrix()
    stepper.coupling.equilibrium.assemble_tangent(matrix)
    dense = matrix.convert("dense").getDenseArray()
    watcher.close()
    assert np.linalg.eigvalsh(dense + dense.T)[0] < 0
    assert (
        last.negative_eigenvalues
        == (2 if load == "dead thrust" else 0)
        == (np.linalg.eigvals(dense).real < 0).sum()
    )
    assert bool(warnings_of(caplog)) == (load == "dead thrust")


@pytest.mark.parametrize(
    ("force", "expected"), [(-30.0, [0, 0, 1, 3, 3]), (-10.0, [0] * 5), (10.0, [0] * 5)]
)
def test_a_compressed_cube_in_every_row(
    force: float, expected: list[int], caplog: pytest.LogCaptureFixture
) -> None:
    """At -30 its lowest eigenvalue is -2.3 of the unloaded one, at -10 still 0.16."""
    scene = pushed_cube(force, **COLUMN, **{"remodeling.law": "none"})
    rows = [step.row["negative_eigenvalues"] for step in run(scene)]
    assert rows == expected[1:]
    said = [line for line in warnings_of(caplog) if "unstable" in line]
    assert len(said) == len(set(expected)) - 1  # each change once
    if said:
        assert (
            "time 2: unstable equilibrium: " in said[0]
            and "1 negative eigenvalue of the tangent (before: 0" in said[0]
        )
        assert (
            "the lowest is -2.3 times its unloaded value, and its mode is largest at (1, 1, 0)"
            in said[1]
        )


# ---------------------------------------------------------------- when somebody looks
def test_nobody_counts_without_a_sign_but_at_the_end() -> None:
    counts = [step.negative_eigenvalues for step in run(pushed_cube(10.0))]
    assert np.isnan(counts[:-1]).all() and counts[-1] == 0


def test_a_large_body_is_counted_on_request_only(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    monkeypatch.setattr(equilibrium_stability, "MOST_UNKNOWNS", 23)  # the cube has 24
    monkeypatch.setattr(equilibrium_stability, "ITERATIONS_BETWEEN_LOOKS", 1)
    assert np.isnan([step.negative_eigenvalues for step in run(pushed_cube(10.0))]).all()
    assert caplog.text.count("the stability of equilibria was not checked: with 24 unknowns") == 1
    assert [step.negative_eigenvalues for step in run(pushed_cube(10.0, **COLUMN))] == [0] * 4
    monkeypatch.setattr(equilibrium_stability, "MOST_UNKNOWNS", 24)
    assert run(pushed_cube(10.0))[-1].negative_eigenvalues == 0


def test_the_sign_of_the_determinant_tells_at_once(caplog: pytest.LogCaptureFixture) -> None:
    steps = run(
        pushed_cube(-30.0, **{"time.end": 2.0, "loads.force.ramp": [[0.0, 0.0], [12.0, 4.0]]})
    )
    assert [step.negative_eigenvalues for step in steps][-1] == 1 and len(warnings_of(caplog)) == 1


def test_a_dead_hydrostatic_load_beyond_rivlins(caplog: pytest.LogCaptureFixture) -> None:
    """The cube that stays a cube is no minimum any more; its symmetry planes do not hide that."""
    made = parts.body(cube(comm=MPI.COMM_SELF), Cells(initial="isotropic"))
    for component, face in enumerate(("x0", "y0", "z0")):
        made.loading.hold_face(face, component)
        made.loading.add_dead_force("force", face.replace("0", "1"), component)
    stepper = made.stepper(lambda t: {"force": 10.0 * t}, law="none")
    watcher = EquilibriumStability(stepper, every_step=True)
    steps = list(stepper.march([1.0, 2.0, 3.0], [watcher]))
    watcher.close()
    stretch = 1 + made.displacement.x.array.max()
    assert stretch > 1.05 and made.displacement.x.array.min() == pytest.approx(0.0, abs=1e-9)
    assert steps[-1].negative_eigenvalues > 0 and warnings_of(caplog)


# ---------------------------------------------------------------- what is said, and done
def test_a_start_that_is_indefinite_is_told_apart(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(equilibrium_stability, "inertia_without_loads", lambda inertia: (1, -0.1))
    caplog.set_level(logging.INFO)
    run(pushed_cube(-20.0, **COLUMN, **{"remodeling.law": "none", "solver.unstable": "stop"}))
    assert not warnings_of(caplog)
    assert sum("this is no loss of stability" in line for line in caplog.messages) == 1


# ---------------------------------------------------------------- refusals
def refused(values: dict[str, Any]) -> tuple[StepFailure, float]:
    """The failure of a short, coarse artery of equal cells, and its last time."""
    base = {"geometry.length": 1.0, "cells.initial": "isotropic", "loads.pressure.value": 0.0}
    scene = read_scene(DEMOS / "artery.toml").with_values({**base, **values})
    with made(scene, tube(length=1.0, divisions=(8, 3, 1))) as simulation:
        with pytest.raises(StepFailure) as caught:
            list(simulation.steps())
        return caught.value, simulation.state.time


def test_an_asymptote_of_the_pressure_is_a_limit_point() -> None:
    """Without chains p(r_i) rises to mu ln(R_o/R_i) and no further; on this mesh, a prism of eight sides, to more."""
    rising = {
        "loads.pressure.value": 8.0,
        "loads.pressure.ramp": ramp_to(10.0),
        "time.end": 10.0,
    }
    failure, last = refused(
        {
            "material.chain_density": 0.0,
            "remodeling.law": "none",
            "loads.elongation.value": 0.0,
            **rising,
        }
    )
    assert failure.refusal.kind == "limit point" and 2.0 <= last < 10.0
    assert "approaches the largest that the body can carry" in failure.refusal.advice
    assert "the lowest eigenvalue of the tangent is" in failure.refusal.finding


def test_more_elongation_than_chains_allow_is_chain_locking() -> None:
    """All chains axial: l lambda = L at a stretch of 1.594. Newton's method must not end with the elongation unmet."""
    failure, last = refused(
        {"loads.elongation.value": 0.6, "remodeling.kappa": 0.5, "time.end": 25.0}
    )
    assert failure.refusal.kind == "chain locking" and last == 24.0
    reached = 0.024 * (24 + float(str(failure).split(" failed at ")[1].split(" %")[0]) / 100)
    assert reached == pytest.approx(0.594, abs=1e-3)


@pytest.mark.parametrize(("left", "kind"), [(50.0, "solver tolerance"), (1e6, "")])
def test_a_residual_that_is_almost_small_enough_is_a_matter_of_the_tolerance(
    left: float, kind: str
) -> None:
    made = parts.body(cube(comm=MPI.COMM_SELF), Cells(initial="isotropic")).supported()
    failure = SolveFailure(
        "refused", Solution(25, 25, limits=StateLimits(0.7, 1.0, (0.0, 0.0, 0.0))), left
    )
    assert diagnose_failure(made.problem().newton, failure).kind == kind
