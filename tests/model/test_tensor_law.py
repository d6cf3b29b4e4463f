"""The consistent variant without a mesh: ln C and its derivatives, the repulsion made of it, the law for A."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import logm
from scipy.spatial.transform import Rotation

from remodel_fenicsx.model import energy
from remodel_fenicsx.model.cells import UnitCell, structure_tensor
from remodel_fenicsx.model.drivers import DRIVERS, FRAMES
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.model.laws import LAWS, Drive
from remodel_fenicsx.model.tensor_law import (
    MIN_TENSION_OVER_ROUNDING,
    Target,
    switch_threshold,
    relax_exactly,
    target,
)
from remodel_fenicsx.model.tensors import MANDEL, logarithm, second_divided_differences

Array = NDArray[np.float64]
RNG = np.random.default_rng(7)


def symmetric(tensors: Array) -> Array:
    return (tensors + np.swapaxes(tensors, -1, -2)) / 2


def right_cauchy_green() -> Array:
    """General, diagonal with two and three equal values, nearly equal ones on both sides of the series' threshold."""
    F = np.eye(3) + 0.15 * RNG.standard_normal((20, 3, 3))
    R = Rotation.random(6, random_state=RNG).as_matrix()
    values = np.array(
        [
            [1, 1, 1],
            [2, 2, 2],
            [0.5, 0.5, 3],
            [1, 1 + 4e-4, 1 + 9e-4],
            [1, 1 + 6e-4, 1 + 1.1e-3],
            [1, 1 + 1e-9, 1.5],
        ]
    )
    special = R @ (values[:, :, None] * np.swapaxes(R, 1, 2))
    return np.concatenate([np.swapaxes(F, 1, 2) @ F, special])


def structures(number: int) -> Array:
    """Positive semi-definite with trace one."""
    roots = RNG.standard_normal((number, 3, 3))
    A = roots @ np.swapaxes(roots, 1, 2)
    return A / np.trace(A, axis1=1, axis2=2)[:, None, None]


def test_logarithm_is_scipys() -> None:
    C = right_cauchy_green()
    np.testing.assert_allclose(logarithm(C), [logm(tensor) for tensor in C], atol=1e-12)


def test_first_derivative_against_the_integral_of_resolvents() -> None:
    """D ln(C)[A] = integral of X A X, X = ((1 - t) I + t C)^-1, t from 0 to 1."""
    C = right_cauchy_green()
    A = structures(len(C))
    t, w = np.polynomial.legendre.leggauss(40)
    share = ((1 + t) / 2)[:, None, None, None]
    X = np.linalg.inv((1 - share) * np.eye(3) + share * C)
    expected = np.einsum("t,tnij->nij", w / 2, X @ A @ X)
    first, none = energy.log_derivatives(C, A, second=False)
    np.testing.assert_allclose(first, expected, atol=1e-11 * np.abs(expected).max())
    assert none is None


def test_second_derivative_against_central_differences() -> None:
    C = right_cauchy_green()
    A, H, h = structures(len(C)), symmetric(RNG.standard_normal(C.shape)), 1e-5
    _, second = energy.log_derivatives(C, A)
    assert second is not None
    number = (energy.log_derivatives(C + h * H, A)[0] - energy.log_derivatives(C - h * H, A)[0]) / (
        2 * h
    )
    found = from_mandel(np.einsum("nab,nb->na", second, to_mandel(H)))
    error = np.abs(found - number).max(axis=(1, 2)) / np.abs(number).max(axis=(1, 2))
    assert np.median(error) < 1e-8 and error.max() < 1e-7
    np.testing.assert_allclose(second, np.swapaxes(second, 1, 2), atol=1e-12 * np.abs(second).max())


def to_mandel(tensors: Array) -> Array:
    root = np.sqrt([1, 1, 1, 2, 2, 2])
    return root * np.stack([tensors[:, i, j] for i, j in MANDEL], axis=1)


def from_mandel(vectors: Array) -> Array:
    tensors = np.empty((len(vectors), 3, 3))
    for number, (i, j) in enumerate(MANDEL):
        tensors[:, i, j] = tensors[:, j, i] = vectors[:, number] / np.sqrt(1 if i == j else 2)
    return tensors


def test_series_and_quotient_meet() -> None:
    """Where the series for three close values ends, both say the same."""
    for gap in (0.999e-3, 1.001e-3):
        x = np.array([1.0, 1.0 + 0.3 * gap, 1.0 + gap])
        # 1/2 f'' at some place between: and by the integral over the simplex, of third order exact here
        simplex = -0.5 * np.mean(x) ** -2 * (1 + 3 / 4 * np.mean((x / np.mean(x) - 1) ** 2))
        assert second_divided_differences(x[None])[0, 0, 1, 2] == pytest.approx(simplex, rel=1e-9)


def cells_of(A: Array) -> UnitCell:
    values, vectors = np.linalg.eigh(A)
    return UnitCell(np.sqrt(np.maximum(values, 0)), np.swapaxes(vectors, 1, 2))


def test_log_is_the_papers_repulsion_where_cell_and_stretch_are_coaxial() -> None:
    axes = Rotation.random(8, random_state=RNG).as_matrix()
    cells = UnitCell(np.abs(RNG.standard_normal((8, 3))), axes)
    stretches = RNG.uniform(0.5, 2.0, (8, 3))
    U = np.swapaxes(axes, 1, 2) @ (stretches[:, :, None] * axes)
    F = Rotation.random(8, random_state=RNG).as_matrix() @ U
    np.testing.assert_allclose(
        energy.log_sum(F, [cells], 1.0), energy.axes_sum(F, [cells], 1.0), rtol=1e-12
    )
    turned = F @ Rotation.random(8, random_state=RNG).as_matrix()
    differences = energy.log_sum(turned, [cells], 1.0) - energy.axes_sum(turned, [cells], 1.0)
    assert np.abs(differences).max() > 0.1


@pytest.mark.parametrize("name", ["log", "length"])
def test_energy_is_stress_free_unloaded_for_every_structure(name: str) -> None:
    """dW/dF = 0 at F = I whatever A, if tr A = r0^2; only 'length' needs A isotropic."""
    tissue = Tissue(27.3, 3.1, 1.57, 1.594, 1.0, repulsion=energy.REPULSIONS[name])
    A = structures(5) if name == "log" else np.tile(np.eye(3) / 3, (5, 1, 1))
    for _ in range(6):
        H, h = RNG.standard_normal((5, 3, 3)), 1e-6
        up, down = (
            tissue.strain_energy(np.eye(3) + sign * h * H, [cells_of(A)]) for sign in (1, -1)
        )
        np.testing.assert_allclose((up - down) / (2 * h), 0, atol=2e-8)


def drive(F: Array, tensor: Array, driver: str = "cauchy", kappa: float = 0.025) -> Drive:
    n = len(F)
    return Drive(
        F, tensor, DRIVERS[driver], FRAMES["material"], 1e-14, np.zeros((n, 3)), np.ones(n), kappa
    )


@pytest.mark.parametrize("driver", ["cauchy", "finger"])
def test_the_law_is_objective(driver: str) -> None:
    """A rotation after the deformation turns a spatial driver with it; A, in material space, stays."""
    F = np.eye(3) + 0.2 * RNG.standard_normal((10, 3, 3))
    tensor = (
        F @ np.swapaxes(F, 1, 2)
        if driver == "finger"
        else symmetric(RNG.standard_normal((10, 3, 3)))
    )
    Q = Rotation.random(10, random_state=RNG).as_matrix()
    cells = cells_of(structures(10))
    turned = drive(Q @ F, Q @ tensor @ np.swapaxes(Q, 1, 2), driver)
    new = [LAWS["tensor"].update(cells, d, 0.0, 3.0) for d in (drive(F, tensor, driver), turned)]
    np.testing.assert_allclose(
        structure_tensor(*new[0][:2]), structure_tensor(*new[1][:2]), atol=1e-12
    )


def test_the_trace_stays_and_the_axes_do_not_matter() -> None:
    n = 20
    F, tensor = np.tile(np.eye(3), (n, 1, 1)), np.abs(RNG.standard_normal((n, 1, 1))) * structures(
        n
    )
    A = np.tile(np.eye(3) / 3, (n, 1, 1))
    some = UnitCell(
        np.full((n, 3), 1 / np.sqrt(3)), Rotation.random(n, random_state=RNG).as_matrix()
    )
    new = [
        LAWS["tensor"].update(cells, drive(F, tensor), 0.0, 40.0) for cells in (cells_of(A), some)
    ]
    results = [structure_tensor(*cells[:2]) for cells in new]
    np.testing.assert_allclose(np.trace(results[0], axis1=1, axis2=2), 1.0, atol=1e-13)
    np.testing.assert_allclose(results[0], results[1], atol=1e-13)


def test_follow_is_the_solution_of_its_differential_equation() -> None:
    A, E = structures(2)
    s, kappa, r0 = 0.7, 0.05, 1.3
    solution: Any = solve_ivp(
        lambda t, y: (kappa * s * (r0**2 * E - y.reshape(3, 3))).ravel(),
        (0, 30),
        A.ravel(),
        rtol=1e-11,
        atol=1e-12,
    )
    found = relax_exactly(A[None], Target(E[None], np.array([s])), r0, kappa * 30)[0]
    np.testing.assert_allclose(found, solution.y[:, -1].reshape(3, 3), atol=1e-9)


def test_the_target_is_that_of_eq_9_to_11_in_the_principal_axes() -> None:
    """l_I^2 tends to r0^2 (lambda_I^+)^2 / |lambda^+|^2: the paper's e_I squared."""
    R = Rotation.random(1, random_state=RNG).as_matrix()[0]
    values = np.array([3.0, 1.0, -2.0])
    found = target((R * values @ R.T)[None], 1e-14)
    expected = np.array([9.0, 1.0, 0.0]) / 10
    np.testing.assert_allclose(R.T @ found.direction[0] @ R, np.diag(expected), atol=1e-14)
    assert found.switch[0] == pytest.approx(10 / (10 + 0.01 * 4), rel=1e-12)


def test_what_is_out_of_balance_counts_once() -> None:
    """The rounding is widened for Newton's method; a residual, which may be large, is not: half there, and no more."""
    tension = np.diag([1e-3, 0.0, 0.0])[None]
    assert target(tension, switch_threshold(1e-3, 0.0)).switch[0] == pytest.approx(0.5)
    assert target(tension, switch_threshold(0.0, 1e-3 / MIN_TENSION_OVER_ROUNDING)).switch[
        0
    ] == pytest.approx(0.5)


def test_between_and_beyond_targets_the_direction_has_trace_one_and_the_share_is_one() -> None:
    """sE is linear; a target that does not count leaves the direction to the other."""
    ends = structures(2)
    none, first, second = (
        Target(direction[None], np.array([share]))
        for direction, share in ((np.zeros((3, 3)), 0.0), (ends[0], 1.0), (ends[1], 0.6))
    )
    middle = first.towards(second, 0.5)
    np.testing.assert_allclose(middle.direction[0], (ends[0] + 0.6 * ends[1]) / 1.6, atol=1e-14)
    assert middle.switch[0] == pytest.approx(0.8, rel=1e-13)
    for weight, share in ((1.5, 1.0), (0.5, 0.5), (-0.5, 0.0), (0.0, 0.0)):
        found = none.towards(first, weight)
        assert found.switch[0] == pytest.approx(share, abs=1e-14)
        np.testing.assert_allclose(
            found.switch[0] * (found.direction[0] - ends[0]), 0.0, atol=1e-14
        )


def test_the_switch() -> None:
    """One under tension, nothing under compression or noise; no jump between."""
    floor = switch_threshold(0.0, 1e-14)
    tensors = np.array(
        [np.diag(v) for v in ([1, 0, 0], [-1, -1, -1], [1e-14, -1, 0], [1e-15, 0, 0], [0.0, 0, 0])]
    )
    np.testing.assert_allclose(target(tensors, floor).switch, [1, 0, 0, 0, 0], atol=1e-6)
    sizes = np.logspace(-13, 0, 400)
    shares = target(np.array([np.diag([size, -1.0, -1.0]) for size in sizes]), floor).switch
    assert np.all(np.diff(shares) > 0) and np.diff(shares).max() < 0.04
    assert np.isfinite(target(np.diag([1e300, -1e300, 0])[None], floor).switch).all()
