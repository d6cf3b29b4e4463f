"""Solver methods: all come to the same states, each with its own work, and what each falls back to when it must."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from remodel_fenicsx import Simulation
from remodel_fenicsx.fem import solver_methods as methods
from remodel_fenicsx.scene import preset_scene
from remodel_fenicsx.solver import linear, newton
from remodel_fenicsx.solver.linear import LaggedFactorisation, Lagged, LimitedMemoryUpdate
from remodel_fenicsx.solver.newton import GuardedNewton
from tests import parts
from tests.parts import tube
from tests.runs import columns, made
from tests.values import assert_close, ramp_to

SELF = MPI.COMM_SELF
TUBE = {"geometry.length": 2.0, "time.end": 8.0, "loads.pressure.ramp": ramp_to(5.0),
        "loads.elongation.ramp": ramp_to(5.0), "solver.predictor": "none"}  # fmt: skip


@pytest.fixture(autouse=True)
def information(caplog: pytest.LogCaptureFixture) -> None:
    """All tests see what run.log has."""
    caplog.set_level(logging.INFO)


def simulated(method: str, **changes: Any) -> tuple[Simulation, list[dict[str, float]]]:
    """A tube of two layers with random cells, loaded at full within five steps."""
    values = (
        TUBE
        | {"solver.method": method}
        | {name.replace("__", "."): value for name, value in changes.items()}
    )
    scene = preset_scene("kuhl-holzapfel-2007", "tube").with_values(values)
    simulation = Simulation(scene, SELF, tube(length=2.0, divisions=(8, 2, 1), comm=SELF))
    return simulation, [step.row for step in simulation.steps()]


def rows_of(method: str, **changes: Any) -> list[dict[str, float]]:
    simulation, rows = simulated(method, **changes)
    simulation.close()
    return rows


@pytest.fixture(scope="module")
def direct() -> list[dict[str, float]]:
    return rows_of("direct")


def assert_same(found: list[dict[str, float]], expected: list[dict[str, float]]) -> None:
    """To what the tolerance leaves open."""
    names = (
        "inner_radius",
        "outer_radius",
        "stored_energy",
        "fibre_angle_inner",
        "max_chain_extension",
    )
    assert_close(columns(found), columns(expected), names, 1e-8, 0.0)


# ---------------------------------------------------------------- what is chosen
@pytest.mark.parametrize(
    ("small", "reduced"), [(methods.MAX_DIRECT_3D, False), (methods.MAX_DIRECT_REDUCED, True)]
)
def test_auto_goes_by_the_size(small: int, reduced: bool) -> None:
    large = methods.MIN_MULTIGRID
    for unknowns, method in (
        (small, "direct"),
        (small + 1, "lagged"),
        (large, "lagged"),
        (large + 1, "iterative"),
    ):
        assert methods.resolve_auto("auto", unknowns, reduced) == method
        assert all(
            methods.resolve_auto(name, unknowns, reduced) == name for name in methods.SOLVER_METHODS
        )
    assert methods.resolve_auto("auto", large + 1, reduced, multigrid=False) == "lagged"


# ---------------------------------------------------------------- same states, other work
@pytest.mark.parametrize("predictor", ["none", "autoregressive"])
@pytest.mark.parametrize("method", ["lagged", "iterative"])
def test_all_methods_come_to_the_same_states(
    method: str, predictor: str, direct: list[dict[str, float]], monkeypatch: pytest.MonkeyPatch
) -> None:
    factors = []
    renew = LaggedFactorisation.renew
    monkeypatch.setattr(
        LaggedFactorisation, "renew", lambda self, matrix: (factors.append(1), renew(self, matrix))
    )
    simulation, rows = simulated(method, solver__predictor=predictor)
    assert_same(rows, direct)
    tangents = simulation.stepper.coupling.newton.linear.tangents
    iterations, krylov = (
        sum(row[name] for row in rows) for name in ("newton_iterations", "linear_iterations")
    )
    if method == "lagged":
        assert len(factors) == tangents < iterations / 2 and krylov == iterations
    else:
        assert not factors and krylov > 4 * iterations
    simulation.close()


def test_options_of_ones_own_lie_over_the_methods(direct: list[dict[str, float]]) -> None:
    """A preconditioner of one's own is kept like the factors."""
    options = {"pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}
    simulation, rows = simulated("lagged", solver__petsc_options=options)
    solver = simulation.stepper.coupling.newton.linear
    assert solver.factorisation().getFactorSolverType() == "mumps"
    assert solver.tangents < sum(row["newton_iterations"] for row in rows) / 2
    assert_same(rows, direct)
    simulation.close()


# ---------------------------------------------------------------- factors
def matrix_of(values: np.ndarray) -> Any:
    matrix = PETSc.Mat().createAIJ(values.shape, nnz=len(values), comm=PETSc.COMM_SELF)
    matrix.setValues(range(len(values)), range(len(values)), values)
    matrix.assemble()
    return matrix


def test_factors_of_every_kind(caplog: pytest.LogCaptureFixture) -> None:
    """CHOLMOD, MUMPS for the indefinite and the unsymmetric one, and back; else no answer."""
    rng = np.random.default_rng(3)
    some = rng.standard_normal((30, 30))
    definite, indefinite, general = (
        some @ some.T + np.eye(30),
        some + some.T,
        some + 30 * np.eye(30),
    )
    factor, kinds = LaggedFactorisation(), []
    for values in (definite, indefinite, general, definite, 2 * definite):
        matrix = matrix_of(values)
        x, y = matrix.createVecs()
        x.array[:] = rng.standard_normal(30)
        factor.renew(matrix)
        factor.apply(None, x, y)
        np.testing.assert_allclose(values @ y.array, x.array, rtol=0, atol=1e-11)
        kinds.append((factor.preconditioner.getFactorSolverType(), factor.preconditioner.getType()))
    cholmod, symmetric, unsymmetric = (
        ("cholmod", "cholesky"),
        ("mumps", "cholesky"),
        ("mumps", "lu"),
    )
    assert kinds == [cholmod, symmetric, unsymmetric, cholmod, cholmod]
    assert caplog.messages == [
        "Cholesky factorisation of the tangent failed (tried in this order: Cholesky, LDL^T, LU)"
    ]
    factor.renew(matrix_of(np.zeros((30, 30))))
    factor.apply(None, x, y)
    assert np.isnan(y.array).all() and "LU factorisation of the tangent failed" in caplog.text
    factor.close()


def test_a_tangent_that_stays_indefinite_is_refused_once(caplog: pytest.LogCaptureFixture) -> None:
    """CHOLMOD is asked again when MUMPS has found no negative pivot."""
    factor, packages = LaggedFactorisation(), []
    for shift in (-3.0, -2.0, -1.0, 1.0, 2.0):
        factor.renew(matrix_of(np.diag(np.arange(5.0)) + shift * np.eye(5) + 0.1))
        packages.append(factor.preconditioner.getFactorSolverType())
    assert packages == ["mumps"] * 4 + ["cholmod"]
    assert len(caplog.records) == 1 and "Cholesky factorisation" in caplog.text
    factor.close()


def test_a_kept_factor_stays_when_its_matrix_changes() -> None:
    """PETSc would make it anew by itself."""
    matrix, factor = matrix_of(2 * np.eye(5)), LaggedFactorisation()
    x, y = matrix.createVecs()
    x.set(1.0)
    factor.renew(matrix)
    matrix.scale(5.0)
    factor.apply(None, x, y)
    np.testing.assert_allclose(y.array, 0.5)
    factor.close()


def test_a_solve_of_many_factors_goes_on_by_newtons_method(
    direct: list[dict[str, float]],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Then there is one for each iteration, without L-BFGS; twice as many are too many. Parts may have any number."""
    monkeypatch.setattr(linear, "MOST_RENEWALS", 2)
    made, renew = [], Lagged.renew
    monkeypatch.setattr(
        Lagged, "renew", lambda self: (renew(self), made.append(self.tangents - self._before))
    )
    rows = rows_of("lagged")
    assert_same(rows, direct)
    assert 2 < max(made) <= 4 and "once more" not in caplog.text

    lagged = object.__new__(Lagged)
    lagged._norms, lagged._before, lagged.secants = [], 0, LimitedMemoryUpdate(SELF)
    lagged._due = lagged._always = False
    monkeypatch.setattr(Lagged, "renew", lambda self: made.append(self.tangents))
    for lagged.tangents, every, given_up in (
        (2, False, False),
        (3, True, False),
        (4, True, False),
        (5, True, True),
    ):
        made.clear()
        lagged.tangent(1.0, 1e-9)
        assert (made == [lagged.tangents], lagged.given_up) == (every, given_up)
        assert not (every and lagged.improve(None, None, None, True))
        lagged._norms.clear()
    lagged.disable_reuse()
    assert not lagged.given_up


# ---------------------------------------------------------------- fall-backs
def test_where_old_factors_do_not_do_every_tangent_is_taken(
    direct: list[dict[str, float]],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Never renewed, and all of the load in two steps: the first factor is of no use for what follows."""
    monkeypatch.setattr(Lagged, "_costs_more", lambda self, tolerance: False)
    changes = {
        "loads.pressure.ramp": ramp_to(2.0),
        "time.end": 3.0,
        "solver.maximum_iterations": 8,
    }
    rows = [rows_of(method, **changes) for method in ("direct", "lagged")]
    assert (
        "Newton failed (no equilibrium within 24 Newton iterations); "
        "retrying with a new factorisation in every iteration" in caplog.text
    )
    assert_same(rows[1], rows[0])


def test_an_indefinite_tangent_is_solved_by_every_method(caplog: pytest.LogCaptureFixture) -> None:
    """The paper's artery begins with one, by the stress of random cells. CHOLMOD cannot take it."""
    scene, rows, said = preset_scene("kuhl-holzapfel-2007", "tube"), {}, {}
    for method in methods.SOLVER_METHODS:
        domain = tube(divisions=(12, 4, 8), comm=SELF)
        with made(
            scene.with_values({"time.end": 1.0, "solver.method": method}), domain
        ) as simulation:
            rows[method] = [step.row for step in simulation.steps()]
            said[method] = caplog.text
            caplog.clear()
        assert_same(rows[method], rows["direct"])
        assert "retrying with" not in said[method]
    assert "Cholesky factorisation" in said["lagged"]


def test_where_multigrid_fails_a_factor_is_taken(caplog: pytest.LogCaptureFixture) -> None:
    """GMRES may do two iterations, which is enough with a factor alone."""
    changes = {"time__end": 3.0, "loads__pressure__value": 30.0}
    expected = rows_of("direct", **changes)
    rows = rows_of("iterative", solver__petsc_options={"ksp_max_it": 2}, **changes)
    assert (
        "Newton failed (the linear solver failed); retrying with a factorisation from now on"
        in caplog.text
    )
    assert "substeps" not in caplog.text
    assert_same(rows, expected)


@pytest.mark.parametrize(
    ("limit", "value", "method"),
    [
        ("CHEAP_FACTOR", 10_000, "lagged"),
        ("CHEAP_FACTOR", 10, "iterative"),
        ("FACTOR_BYTES", 1e12, "iterative"),
    ],
)
def test_auto_takes_a_factor_where_it_is_cheap(
    limit: str,
    value: float,
    method: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """By its operations and its memory, of bodies above a size."""
    monkeypatch.setattr(methods, "MIN_MULTIGRID", 0)
    monkeypatch.setattr(linear, limit, value)
    simulation, _ = simulated("auto")
    simulation.close()
    assert simulation.stepper.coupling.newton.method == method
    assert f"solver.method 'auto' takes {method!r}: a factorisation needs" in caplog.text


@pytest.mark.parametrize("method", ["lagged", "iterative"])
def test_a_solve_that_the_guards_hold_up_goes_on_in_substeps(
    method: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Here with a limit that this step reaches; it comes to the same state."""
    changes = {"loads__pressure__ramp": ramp_to(1.0), "time__end": 1.0}
    changes["loads__pressure__value"] = 12.0
    expected = rows_of(method, **changes)
    assert "too short" not in caplog.text
    caplog.clear()
    monkeypatch.setattr(newton, "SHORT_STEPS", 1)
    monkeypatch.setattr(newton, "SHORT_STEP_HALVINGS", 1)
    rows = rows_of(method, **changes)
    failed = "the guards r < L and J > 0 made the last Newton steps too short"
    assert f"{failed}; solving in substeps" in caplog.text and "retrying" not in caplog.text
    assert_same(rows, expected)


@pytest.mark.parametrize(
    ("bulk", "options", "thickness"),
    [
        (27.3, {}, 2.0),
        (5000.0, {}, 2.0),
        (27.3, {"pc_gamg_threshold": 0.02}, 2.0),
        (27.3, {}, 0.16),
    ],
)
def test_degree_one_is_the_next_level_of_degree_two(
    bulk: float, options: dict[str, Any], thickness: float, caplog: pytest.LogCaptureFixture
) -> None:
    """Unless options are given; also where elements are 15 to 30 times as wide as thick."""
    mesh = tube(3.0 - thickness, length=2.0, divisions=(8, 2, 1), degree=2, comm=SELF)
    rows, scene = {}, preset_scene("kuhl-holzapfel-2007", "tube")
    scene = scene.with_values(
        {
            "mesh.degree": 2,
            "material.lame_lambda": bulk,
            "time.end": 1.0,
            "geometry.length": 2.0,
            "geometry.inner_radius": 3.0 - thickness,
            "loads.pressure.value": 1.2 * thickness,
        }
    )
    for method, given in (("direct", {}), ("iterative", options)):
        changes = {"solver.method": method, "solver.petsc_options": given}
        with made(scene.with_values(changes), mesh) as simulation:
            rows[method] = [step.row for step in simulation.steps()]
            levels = simulation.stepper.coupling.newton._snes.getKSP().getPC()
            kind = levels.getType()
            if kind == "mg":  # whose lower level has the options of its own
                kind = levels.getMGCoarseSolve().getPC().getType()
    assert_same(rows["iterative"], rows["direct"])
    assert kind == ("gamg" if options else "lu") and "retrying" not in caplog.text


# ---------------------------------------------------------------- quasi-Newton steps
def test_a_linear_problem_is_soon_solved_with_secants() -> None:
    """Many times faster than with its diagonal alone."""
    rng = np.random.default_rng(2)
    some = rng.standard_normal((40, 40))
    values = np.diag(np.linspace(1.0, 8.0, 40)) + 0.1 * (some + some.T)
    matrix, right = matrix_of(values), rng.standard_normal(40)
    norms = {}
    for most in (0, 20):
        secants = LimitedMemoryUpdate(SELF)
        x, residual = matrix.createVecs()
        for _ in range(25):
            residual.array[:] = values @ x.array - right
            step = residual.copy()
            step.array[:] /= 8.0
            if most:
                secants.improve(x, residual, step)
            x.axpy(-1.0, step)
        norms[most] = residual.norm()
    assert norms[20] < 5e-3 * norms[0]


# ---------------------------------------------------------------- the bound that spares looks
def test_no_displacement_changes_f_by_more_than_the_bound() -> None:
    """And some come near it: an element that one of its nodes leaves."""
    made = parts.body(tube(length=2.0, divisions=(8, 2, 1), comm=SELF), preset_scene(
        "kuhl-holzapfel-2007", "tube").cells)  # fmt: skip
    state, bound, rng = made.state(), made.quadrature.largest_gradient, np.random.default_rng(1)
    largest = 0.0
    for _ in range(20):
        u = rng.standard_normal(made.nodes.shape)
        u /= (
            np.linalg.norm(u, axis=1).max()
            if rng.random() < 0.5
            else np.linalg.norm(u, axis=1)[:, None]
        )
        made.set_displacement(u)
        change = np.linalg.norm(state.deformation_gradient() - np.eye(3), axis=(1, 2))
        largest = max(largest, float(change.max()))
    assert 0.2 * bound < largest < bound


def test_what_the_bound_spares_is_admissible(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each state that nobody looked at is looked at here; far more are spared than not."""
    spared, assemble = [], GuardedNewton._assemble_residual

    def checked(self: GuardedNewton, *arguments: Any) -> None:
        assemble(self, *arguments)
        spared.append(self._present.is_known_admissible)
        if self._present.is_known_admissible:
            extension = self.equilibrium.limits()
            assert extension.admissible and extension.max_chain_extension < 0.95

    monkeypatch.setattr(GuardedNewton, "_assemble_residual", checked)
    simulation, _ = simulated("lagged", solver__predictor="autoregressive", time__end=4.0)
    assert sum(spared) > len(spared) / 2
    equilibrium, x = simulation.stepper.coupling.equilibrium, simulation.unknown.x.array
    near = equilibrium.limits().max_chain_extension + 1e-3
    for far in (near, 0.95, 0.99, 1.0):  # as far as the bound allows, in many directions
        change, start = equilibrium.safe_change(far), x.copy()
        for seed in range(5):
            way = np.random.default_rng(seed).standard_normal((len(x) // 3, 3))
            way /= np.linalg.norm(way, axis=1).max()
            x[:] = start + 0.999 * change / simulation.quadrature.largest_gradient * way.ravel()
            extension = equilibrium.limits()
            assert extension.admissible and extension.max_chain_extension < far
        x[:] = start
    simulation.close()


def test_a_residual_below_the_tolerance_is_still_reduced() -> None:
    """Rounded displacements explain it, so that Newton goes on; a linear tolerance above 1 is none."""
    changes = {"solver.method": "iterative", "solver.relative_tolerance": 1e-3}
    changes |= {"model.kinematics": "full", "loads.force.value": 3e-5, "time.end": 6.0}
    steps = list(Simulation(preset_scene("consistent", "cube").with_values(changes)).steps())
    assert len(steps) == 6
