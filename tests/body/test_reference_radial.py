"""The one-dimensional reference tube stands on its own feet: closed forms, equilibrium, convergence, known numbers."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.optimize import fsolve

from tests.reference import radial

MATERIAL = radial.RadialMaterial()


@lru_cache(maxsize=None)
def run(**arguments: Any) -> radial.RadialHistory:
    return radial.solve_radial(elements=100, **arguments)


def energy(stretches: np.ndarray, squares: np.ndarray) -> float:
    """W on the axes (eq. 4 with errata 1 and 2)."""
    m, big_l = MATERIAL, MATERIAL.contour_length
    log_jacobian = np.log(np.prod(stretches))
    x = np.sqrt(squares @ stretches**2) / big_l
    matrix = m.lame_lambda / 2 * log_jacobian**2 + m.lame_mu * ((stretches @ stretches - 3) / 2 - log_jacobian)
    g0 = 1 / big_l + 1 / (4 * (1 - 1 / big_l) ** 2) - 0.25
    return matrix + m.network_modulus * (
        big_l / 4 * (2 * x**2 + 1 / (1 - x) - x) - g0 / 2 * squares @ np.log(stretches**2)
    )


def test_stress_is_the_slope_of_the_energy() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        stretches, squares = rng.uniform(0.85, 1.2, 3), rng.dirichlet([1.0, 1.0, 1.0])
        slopes = [(energy(stretches + h, squares) - energy(stretches - h, squares)) / 2e-6 for h in 1e-6 * np.eye(3)]
        found = radial.first_piola_kirchhoff(stretches[None], squares[None], MATERIAL)[0]
        np.testing.assert_allclose(found, slopes, atol=1e-7)


def test_small_pressure_is_lames_thick_cylinder() -> None:
    """u = A R + B/R with the linear elastic constants of matrix and isotropic chains together."""
    m, h = MATERIAL, 1e-5
    g = [float(radial.secant_stiffness(np.array(r), m.contour_length)) for r in (1 - h, 1.0, 1 + h)]
    mu = m.lame_mu + m.network_modulus * g[1] / 3
    lame = m.lame_lambda + m.network_modulus * (g[2] - g[0]) / (2 * h) / 9
    pressure = 1e-6
    history = run(pressure=pressure, stretch=0.0, end=1.0, ramp_time=1.0, law="none")
    a = pressure / (2 * (lame + mu) * (9 - 1))
    b = pressure * 9 / (2 * mu * (9 - 1))
    nodes = history.nodes
    np.testing.assert_allclose((history.radii[-1] - nodes) / (a * nodes + b / nodes), 1.0, atol=1e-5)


def test_thin_wall_is_laplaces_membrane() -> None:
    """As the wall gets thinner the tube tends to p r = sigma_t h, sigma_r = 0 at the rate of the thickness."""
    ratio, axial = 3.0, 1.1  # pressure over wall thickness
    squares = np.full((1, 3), 1 / 3)

    def unbalanced(unknown: np.ndarray) -> list[float]:
        stretches = np.array([[unknown[0], axial, unknown[1]]])
        stress = radial.cauchy_stress(stretches, squares, MATERIAL)[0]
        return [stress[radial.CIRCUMFERENTIAL] * unknown[1] - ratio * unknown[0], stress[radial.RADIAL]]

    membrane = fsolve(unbalanced, [1.1, 0.9], xtol=1e-13)[0]
    assert membrane > 1.1
    errors = []
    for thickness in (0.01, 0.005, 0.0025):
        history = radial.solve_radial(
            pressure=ratio * thickness,
            stretch=axial - 1,
            end=1.0,
            ramp_time=1.0,
            law="none",
            inner_radius=1 - thickness / 2,
            outer_radius=1 + thickness / 2,
            elements=4,
        )
        errors.append(np.interp(1.0, history.nodes, history.radii[-1]) - membrane)
    assert abs(errors[-1]) < 0.005
    np.testing.assert_allclose(np.array(errors[:-1]) / errors[1:], 2.0, atol=0.1)


def test_wall_is_in_equilibrium_pointwise() -> None:
    """sigma_r' + (sigma_r - sigma_t)/r = 0, -p inside and 0 outside, on a spline through the nodes."""
    history = run(end=25.0, law="none")
    place = CubicSpline(history.nodes, history.radii[-1])
    R = np.linspace(1.0, 3.0, 4001)
    r = place(R)
    stretches = np.stack([r / R, np.full_like(R, 1.1), place(R, 1)], axis=1)
    stress = radial.cauchy_stress(stretches, np.full((len(R), 3), 1 / 3), MATERIAL)
    hoop, across = stress[:, radial.CIRCUMFERENTIAL], stress[:, radial.RADIAL]
    assert across[0] == pytest.approx(-4.8, abs=5e-3) and across[-1] == pytest.approx(0.0, abs=5e-4)
    rest = CubicSpline(R, across)(R, 1) / place(R, 1) + (across - hoop) / r
    assert np.sqrt(np.mean(rest**2)) < 1e-3 * np.max(hoop)


def test_same_as_an_initial_value_problem() -> None:
    """Shooting with an adaptive Runge-Kutta method: another discretisation of the same equations, no remodeling."""
    history = run(end=25.0, law="none")
    squares = np.full((1, 3), 1 / 3)

    def stress(r: float, slope: float, R: float) -> np.ndarray:
        return radial.first_piola_kirchhoff(np.array([[r / R, 1.1, slope]]), squares, MATERIAL)[0]

    def slopes(R: float, y: np.ndarray) -> list[float]:
        # unknowns r and P_r R; the slope of r from P_r by Newton's method
        slope, h = R / (1.1 * y[0]), 1e-7
        for _ in range(20):
            wrong = stress(y[0], slope, R)[radial.RADIAL] - y[1] / R
            rate = (stress(y[0], slope + h, R) - stress(y[0], slope - h, R))[radial.RADIAL] / (2 * h)
            slope -= wrong / rate
            if abs(wrong) < 1e-11:
                break
        return [slope, stress(y[0], slope, R)[radial.CIRCUMFERENTIAL]]

    def shoot(inner: float) -> np.ndarray:
        return solve_ivp(slopes, (1.0, 3.0), [inner, -4.8 * 1.1 * inner], rtol=1e-9, atol=1e-11).y[:, -1]

    inner = history.inner_radii[-1]
    outer, force = shoot(inner)
    assert outer == pytest.approx(history.outer_radii[-1], rel=1e-6)
    assert force == pytest.approx(0.0, abs=2e-5)


def test_hoop_stress_carries_the_pressure_while_remodeling() -> None:
    """int sigma_t dr = p r_i at every step, whatever the cells are."""
    history = run()
    widths = history.areas / history.points * history.stretches[:, :, radial.RADIAL]
    carried = np.sum(history.cauchy[:, :, radial.CIRCUMFERENTIAL] * widths, axis=1)
    np.testing.assert_allclose(carried, history.pressures * history.inner_radii, rtol=2e-5)


def test_mesh_convergence() -> None:
    """Radii: fourth order without remodeling, and far below the tolerance of any comparison with it."""
    radii = [radial.solve_radial(end=25.0, law="none", elements=n).inner_radii[-1] for n in (40, 80, 160, 320)]
    differences = np.abs(np.diff(radii))
    assert differences[-1] < 1e-8
    assert 9 < differences[0] / differences[1] < differences[1] / differences[2] < 16
    assert differences[1] / differences[2] > 14
    coarse, fine = radial.solve_radial(elements=50), run()
    np.testing.assert_allclose(coarse.inner_radii, fine.inner_radii, rtol=1e-5)
    np.testing.assert_allclose(coarse.outer_radii, fine.outer_radii, rtol=1e-6)
    for place in (1.0, 1.5, 2.0, 3.0):
        assert coarse.fibre_angle_at(place) == pytest.approx(fine.fibre_angle_at(place), abs=0.05)


def test_elastic_state_does_not_depend_on_the_load_steps() -> None:
    ramped = run(end=25.0, law="none")
    at_once = run(end=1.0, ramp_time=1.0, law="none")
    np.testing.assert_allclose(at_once.radii[-1], ramped.radii[-1], rtol=1e-9)


def test_parts_of_a_step_end_in_the_same_state(monkeypatch: pytest.MonkeyPatch) -> None:
    """Exchange of cells first, loads afterwards; only the path differs from a single solve."""
    tube = radial.Tube(1.0, 3.0, 20, MATERIAL)
    isotropic = np.full((60, 3), 1 / 3)
    circumferential = np.tile([0.8, 0.2, 0.0], (60, 1))
    old, new = (isotropic, 1.0, 1.02), (circumferential, 2.0, 1.05)
    start = tube.newton(tube.nodes, *old)
    assert start is not None
    direct = tube.newton(start, *new)
    assert direct is not None and np.max(np.abs(direct - start)) > 0.05
    calls: list[Any] = []
    newton = tube.newton

    def refuses_first(*arguments: Any) -> Any:
        calls.append(arguments)
        return None if len(calls) == 1 else newton(*arguments)

    monkeypatch.setattr(tube, "newton", refuses_first)
    parts = tube.advance(start, old, new)
    assert tube.substeps == 4 and len(calls) == 5
    np.testing.assert_allclose(parts, direct, rtol=1e-10)


def test_tangent_is_the_slope_of_the_residual() -> None:
    tube = radial.Tube(1.0, 3.0, 3, MATERIAL)
    rng = np.random.default_rng(2)
    squares = rng.dirichlet([1.0, 1.0, 1.0], 9)
    radii = 1.1 * tube.nodes + rng.uniform(-0.02, 0.02, 7)
    banded = tube.tangent(radii, squares, 3.0, 1.05)
    dense = sum(np.diag(banded[2 - k, max(k, 0) : 7 + min(k, 0)], k) for k in range(-2, 3))
    shifts = 1e-6 * np.eye(7)
    slopes = [
        (tube.residual(radii + h, squares, 3.0, 1.05) - tube.residual(radii - h, squares, 3.0, 1.05)) / 2e-6
        for h in shifts
    ]
    np.testing.assert_allclose(dense, np.array(slopes).T, atol=1e-6)


def test_order_of_directions() -> None:
    previous = np.array([[1, 0, 2], [1, 0, 2], [2, 1, 0], [0, 1, 2]])
    values = np.array([[1.0, 1.0, 3.0], [1.0 + 1e-10, 1.0, 3.0], [-1.0, 0.0, 1.0], [1.0, 2.0, 3.0]])
    ranks = radial.sorted_directions(values, previous)
    np.testing.assert_array_equal(ranks, [[2, 1, 0], [2, 1, 0], [2, 1, 0], [2, 1, 0]])


@pytest.mark.parametrize("density", [2e21, 1e24])
def test_the_solvers_noise_does_not_remodel(density: float) -> None:
    """A tube that is only shortened: hoop and radial stress are zero up to the solver's tolerance, and no tension."""
    material = radial.RadialMaterial(network_modulus=MATERIAL.network_modulus * density / 2e21)
    history = radial.solve_radial(pressure=0.0, stretch=-0.05, end=30.0, elements=10, material=material)
    np.testing.assert_array_equal(history.dimensions[-1], history.dimensions[0])
    assert np.all(history.cauchy[-1, :, 1] < -0.1)


def test_published_numbers_of_the_artery() -> None:
    """Radii of the resolved solve, the remodeling from t = 24 to 150, angles of Fig. 8, the decay of l_3."""
    history = run()
    assert history.times[23] == 24.0 and history.times[-1] == 150.0
    assert history.inner_radii[23] == pytest.approx(1.8021, abs=1e-4)
    assert history.outer_radii[23] == pytest.approx(3.2684, abs=1e-4)
    assert history.times[np.argmax(history.outer_radii)] == 24.0
    assert 0.15 < history.outer_radii.max() - history.outer_radii[-1] < 0.21
    assert history.fibre_angle_at(1.0) < 1.0
    assert history.fibre_angle_at(2.0) == pytest.approx(53.5, abs=0.05)
    assert history.fibre_angle_at(3.0) == pytest.approx(74.0, abs=0.5)
    np.testing.assert_allclose(history.dimensions[-1, :, radial.RADIAL], np.exp(-3.75) / np.sqrt(3), rtol=1e-12)
    layers = [history.mean_fibre_angle(1 + i / 4, 1 + (i + 1) / 4) for i in range(8)]
    # random cells of a finite element run: single layers by chance up to a degree away
    np.testing.assert_allclose(layers, [1.1, 4.2, 14.0, 36.9, 60.2, 66.7, 70.3, 72.7], atol=1.5)


def test_rate_differs_from_explicit_by_20_degrees() -> None:
    """Erratum 7: 52 by eq. (10), 74 by eq. (11) at the outer wall."""
    history = run(law="rate")
    assert history.fibre_angle_at(3.0) == pytest.approx(52.0, abs=0.5)
    assert run().fibre_angle_at(3.0) - history.fibre_angle_at(3.0) > 20.0


def test_laws_agree_while_nothing_turns() -> None:
    """Pure stretch: the direction of tension never changes, so all laws are eq. (11)."""
    ends = [run(pressure=0.0, law=law) for law in ("explicit", "rate", "relaxation")]
    for other in ends[1:]:
        np.testing.assert_allclose(other.dimensions[-1], ends[0].dimensions[-1], atol=1e-9)


@pytest.mark.parametrize(
    "stretch, pressure, inner, middle, outer",
    [
        (0.1, 0.0, (89.0, 90.0), (89.0, 90.0), (89.0, 90.0)),
        (0.1, 2.4, (0.0, 1.0), (70.0, 72.0), (78.0, 80.0)),
        (0.1, 4.8, (0.0, 1.0), (53.0, 54.0), (73.5, 74.5)),
        (0.05, 4.8, (0.0, 1.0), (15.0, 16.0), (56.0, 58.0)),
        (0.0, 4.8, (0.0, 1.0), (0.0, 1.0), (12.0, 13.0)),
    ],
)
def test_figure_9(stretch: float, pressure: float, inner: tuple, middle: tuple, outer: tuple) -> None:
    history = run(stretch=stretch, pressure=pressure)
    for place, (low, high) in zip((1.0, 2.0, 3.0), (inner, middle, outer)):
        assert low <= history.fibre_angle_at(place) <= high


def test_figures_10_and_11() -> None:
    """S varies a little less over the wall than sigma, b much less: 27 to 48 degrees."""
    finger = run(driver="finger")
    assert finger.fibre_angle_at(1.0) == pytest.approx(27.0, abs=0.2)
    assert finger.fibre_angle_at(3.0) == pytest.approx(48.0, abs=0.2)
    for driver, angle in (("cauchy", 76.0), ("pk2", 73.0)):
        coarse = radial.solve_radial(elements=20, driver=driver, end=500.0, step=2.5)
        assert coarse.fibre_angle_at(3.0) == pytest.approx(angle, abs=0.5)
