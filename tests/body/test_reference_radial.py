"""The one-dimensional reference tube stands on its own feet: closed forms, equilibrium, convergence, known numbers."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

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
