"""Fig. 5: the unit cube in uniaxial tension, against closed forms and an independent scalar solve."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.conftest import Case, slowly
from tests.reference.point import uniaxial_stretches
from tests.reference.radial import RadialMaterial

TISSUE = RadialMaterial(
    network_modulus=1.381e-23 * 310.0 * 7.0e21 / (4 * 1.82), contour_length=2.125
)


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


def axial_stretch(force: float, share: float) -> float:
    """Of isotropic cells that have gone a share of their way to the load, from eq. (7) typed by hand."""
    across = (1 - share) / np.sqrt(3)
    cells = np.array([across + share, across, across])
    return float(uniaxial_stretches(force, cells, TISSUE)[0])


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
        axial = axial_stretch(force, 1 - np.exp(-kappa * (time - 1.0)))
        assert stretch == pytest.approx(axial, abs=1e-8), f"t = {time}"
    assert np.all(result["substeps"] == 1)
