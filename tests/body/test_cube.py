"""Fig. 5: the unit cube in uniaxial tension, against closed forms and an independent scalar solve."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import fsolve

from tests.conftest import Case, slowly

L, A_P, DENSITY, LAMBDA, MU = 2.125, 1.82, 7.0e21, 27.293, 3.103
C_NETWORK = 1.381e-23 * 310.0 * DENSITY / (4 * A_P)


def cube_scene(kappa: float, **remodeling: str) -> dict:
    """The preset's cube."""
    return {
        "preset": "kuhl-holzapfel-2007",
        "geometry": {"shape": "cube"},
        "remodeling": {"kappa": kappa, **remodeling},
    }


def closed_form_angle(kappa: float, time: Any) -> Any:
    """Model of Fig. 5: tan(angle) = sqrt2 (1-s) / (1 - s + sqrt3 s), s = 1 - exp(-kappa t); degrees."""
    s = -np.expm1(-kappa * time)
    return np.degrees(np.arctan2(np.sqrt(2) * (1 - s), 1 - s + np.sqrt(3) * s))


def uniaxial_stretches(force: float, l_along: float, l_across: float) -> tuple[float, float]:
    """Axial and lateral stretch of the cube from eq. (7) typed by hand: nominal axial stress = force, lateral zero."""

    def g(r: float) -> float:
        return 1 / L + 1 / (4 * r * (1 - r / L) ** 2) - 1 / (4 * r)

    def balance(stretch: np.ndarray) -> list[float]:
        a, b = stretch
        volume = a * b * b
        r = np.sqrt(l_along**2 * a * a + 2 * l_across**2 * b * b)

        def cauchy(square: float, length: float) -> float:
            matrix = (LAMBDA * np.log(volume) - MU) + MU * square
            return (matrix + C_NETWORK * length**2 * (g(r) * square - g(1.0))) / volume

        return [cauchy(a * a, l_along) * b * b - force, cauchy(b * b, l_across)]

    a, b = fsolve(balance, [1.2 + 0.05 * force, 0.85], xtol=1e-13)
    return float(a), float(b)


@pytest.mark.parametrize(
    ("kappa", "frame"),
    [(0.025, "spatial"), (0.1, "material"),
     *slowly((0.025, "material"), (0.1, "spatial"), (0.01, "spatial"), (0.01, "material"))],
)  # fmt: skip
def test_angle_is_the_closed_form_at_every_step(case: Case, kappa: float, frame: str) -> None:
    result = case(cube_scene(kappa, frame=frame))
    assert len(result["time"]) == 100
    # a row belongs to the solved state: its cells are those of the step before
    expected = closed_form_angle(kappa, result["time"] - 1.0)
    np.testing.assert_allclose(result["mean_fibre_angle"], expected, rtol=0, atol=1e-10)
    # the last pass gives the cells of t = 100
    across, along = np.hypot(result["l"][..., 1], result["l"][..., 2]), result["l"][..., 0]
    last = np.degrees(np.arctan2(across, along))
    np.testing.assert_allclose(last, closed_form_angle(kappa, 100.0), rtol=0, atol=1e-10)


@pytest.mark.parametrize("kappa", [0.025, *slowly(0.01, 0.1)])
def test_stretch_is_that_of_an_independent_scalar_solve(case: Case, kappa: float) -> None:
    result = case(cube_scene(kappa, frame="spatial"))
    for time, force, stretch in zip(
        result["time"], result["force"], result["mean_stretch"], strict=True
    ):
        s = 1 - np.exp(-kappa * (time - 1.0))
        across = (1 - s) / np.sqrt(3)
        axial, _ = uniaxial_stretches(force, across + s, across)
        assert stretch == pytest.approx(axial, abs=1e-8), f"t = {time}"
    assert np.all(result["substeps"] == 1)
