"""Tissue without chains: the closed form of its matrix."""

from __future__ import annotations

import numpy as np
import pytest

from remodel_fenicsx import Scene
from tests.runs import simulated
from tests.values import ramped


def neo_hookean_stretch(stress: float, lame_lambda: float, lame_mu: float) -> float:
    """Stretch a of a bar under a nominal stress: P_zz = stress and P_xx = 0 of eq. (4a), by Newton's method."""
    a, b = 1.0, 1.0
    for fraction in np.linspace(0.0, 1.0, 201)[1:]:
        for _ in range(50):
            log_jacobian = np.log(a * b**2)
            residual = np.array([
                (lame_lambda * log_jacobian - lame_mu) / a + lame_mu * a - fraction * stress,
                (lame_lambda * log_jacobian - lame_mu) / b + lame_mu * b,
            ])  # fmt: skip
            slope = np.array([
                [(lame_lambda - lame_lambda * log_jacobian + lame_mu) / a**2 + lame_mu, 2 * lame_lambda / (a * b)],
                [lame_lambda / (a * b), (2 * lame_lambda - lame_lambda * log_jacobian + lame_mu) / b**2 + lame_mu],
            ])  # fmt: skip
            a, b = np.array([a, b]) - np.linalg.solve(slope, residual)
    assert np.abs(residual).max() < 1e-10
    return float(a)


@pytest.mark.parametrize("law", ["none", "explicit"])
def test_without_chains_nothing_locks(law: str) -> None:
    """Cells may turn and grow as they like: the body is its matrix, far beyond the contour length."""
    scene = Scene(
        geometry={"shape": "cube"},
        material={"chain_density": 0.0},
        loads=ramped(10.0, force=30.0),
        remodeling={"law": law},
        time={"end": 11.0},
    )
    with simulated(scene) as (simulation, rows):
        exact = neo_hookean_stretch(30.0, scene.material.lame_lambda, scene.material.lame_mu)
        assert exact > 3 * scene.material.contour_length
        assert rows[-1]["mean_stretch"] == pytest.approx(exact, rel=1e-8)
        assert {row["max_chain_extension"] for row in rows} == {0.0}
        assert {row["remodeling_power"] for row in rows} == {0.0}
        # no chain is in the kernels: constants of the matrix and the size of the body; the only field is displacement
        (energy,) = simulation.stepper.coupling.equilibrium.energies
        assert energy.coefficients() == (simulation.unknown,)
        assert {float(c.value) for c in energy.constants()} == {27.293, 3.103, scene.geometry.side}
