"""The one-dimensional reference tube stands on its own feet: closed forms, equilibrium, convergence, known numbers."""

from __future__ import annotations


import numpy as np

from tests.reference import radial

MATERIAL = radial.RadialMaterial()


def energy(stretches: np.ndarray, squares: np.ndarray) -> float:
    """W on the axes (eq. 4 with errata 1 and 2)."""
    m, big_l = MATERIAL, MATERIAL.contour_length
    log_jacobian = np.log(np.prod(stretches))
    x = np.sqrt(squares @ stretches**2) / big_l
    matrix = m.lame_lambda / 2 * log_jacobian**2 + m.lame_mu * (
        (stretches @ stretches - 3) / 2 - log_jacobian
    )
    g0 = 1 / big_l + 1 / (4 * (1 - 1 / big_l) ** 2) - 0.25
    return matrix + m.network_modulus * (
        big_l / 4 * (2 * x**2 + 1 / (1 - x) - x) - g0 / 2 * squares @ np.log(stretches**2)
    )


def test_stress_is_the_slope_of_the_energy() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        stretches, squares = rng.uniform(0.85, 1.2, 3), rng.dirichlet([1.0, 1.0, 1.0])
        slopes = [
            (energy(stretches + h, squares) - energy(stretches - h, squares)) / 2e-6
            for h in 1e-6 * np.eye(3)
        ]
        found = radial.first_piola_kirchhoff(stretches[None], squares[None], MATERIAL)[0]
        np.testing.assert_allclose(found, slopes, atol=1e-7)


def test_small_pressure_is_lames_thick_cylinder() -> None:
    """u = A R + B/R with the linear elastic constants of matrix and isotropic chains together."""
    m, h = MATERIAL, 1e-5
    g = [float(radial.secant_stiffness(np.array(r), m.contour_length)) for r in (1 - h, 1.0, 1 + h)]
    mu = m.lame_mu + m.network_modulus * g[1] / 3
    lame = m.lame_lambda + m.network_modulus * (g[2] - g[0]) / (2 * h) / 9
    pressure = 1e-6
    history = radial.solve_radial(
        elements=100, pressure=pressure, stretch=0.0, end=1.0, ramp_time=1.0, law="none"
    )
    a = pressure / (2 * (lame + mu) * (9 - 1))
    b = pressure * 9 / (2 * mu * (9 - 1))
    nodes = history.nodes
    np.testing.assert_allclose(
        (history.radii[-1] - nodes) / (a * nodes + b / nodes), 1.0, atol=1e-5
    )
