"""Fig. 6: the tendon under uniaxial tension, with the preset's random cells and with isotropic ones.

The whole one is slow, two of its ten layers are not.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from remodel_fenicsx.scene.scene import preset_scene
from tests.conftest import Case, slowly
from tests.reference.point import uniaxial_stretches
from tests.reference.radial import RadialMaterial
from tests.values import ramped

KAPPA = 0.025


def tendon_scene(**cells: object) -> dict:
    """The preset's tendon."""
    return {"preset": "kuhl-holzapfel-2007", "geometry": {"shape": "tendon"}, "cells": cells}


LAYERS = 2  # of elements along the axis, each of length 1


def slice_of(scene: dict, layers: int = LAYERS) -> dict[str, Any]:
    """Arguments of `case` for a short piece of the tendon with elements like the whole one's."""
    return {
        "scene": {**scene, "geometry": {"shape": "tendon", "length": layers}},
        "divisions": (16, 4, layers),
    }


@pytest.fixture(scope="module", params=["slice", *slowly(1, 2, 3)])
def random_tendon(request: pytest.FixtureRequest, case: Case) -> dict:
    """150 steps of a seed."""
    if request.param == "slice":
        return case(**slice_of(tendon_scene()))
    return case(tendon_scene(seed=request.param))


def is_whole(tendon: dict) -> bool:
    """All ten layers along the axis."""
    return len(tendon["x"]) == 480


def test_stretch_rises_to_175_and_falls_to_140_percent(random_tendon: dict) -> None:
    stretch = dict(zip(random_tendon["time"], random_tendon["mean_stretch"], strict=True))
    assert 1.70 <= stretch[12.0] <= 1.80
    assert 1.41 <= stretch[150.0] <= 1.43
    # narrower: what five seeds gave with this method; a slice has a fifth of the whole's random cells
    if is_whole(random_tendon):
        assert 1.735 <= stretch[12.0] <= 1.750
        assert 1.4243 <= stretch[150.0] <= 1.4251
    else:
        assert stretch[150.0] == pytest.approx(1.425, abs=1e-3)


def test_first_dimension_follows_the_closed_form(random_tendon: dict) -> None:
    """Uniaxial tension to the end: l_1 -> r0 (1 - exp(-kappa t)) + l0_1 exp(-kappa t), up to small other tensions."""
    left = np.exp(-KAPPA * 150.0)
    expected = (1 - left) + left * random_tendon["l0"][..., 0]
    assert np.quantile(np.abs(random_tendon["l"][..., 0] - expected), 0.95) < 2e-3
    assert left == pytest.approx(0.0235, abs=5e-5)


def test_only_the_stress_as_printed_ends_near_140_percent(case: Case) -> None:
    """Erratum 1: energy_factor 1 against 4, one element of isotropic cells with the tendon's material and traction."""
    preset = preset_scene("kuhl-holzapfel-2007", "tendon")
    final = {}
    for factor in (1, 4):
        scene = {
            "preset": "kuhl-holzapfel-2007",
            "geometry": {"shape": "cube"},
            "material": preset.material.model_dump() | {"energy_factor": factor},
            "loads": ramped(12.0, force=30.0),
            "time": {"end": 150.0, "step": 3.0},
        }
        final[factor] = case(scene)["mean_stretch"][-1]
    assert final[1] == pytest.approx(1.424, abs=2e-3)
    assert final[4] == pytest.approx(1.27, abs=5e-3)


@pytest.mark.slow
def test_isotropic_cells_stay_homogeneous_and_follow_the_point_solution(case: Case) -> None:
    result = case(tendon_scene(initial="isotropic") | {"time": {"end": 50.0}})
    np.testing.assert_allclose(result["max_stretch"], result["min_stretch"], rtol=0, atol=1e-8)
    for time in (1.0, 6.0, 12.0, 13.0, 50.0):
        row = int(np.flatnonzero(result["time"] == time)[0])
        s = 1 - np.exp(-KAPPA * (time - 1.0))
        across = (1 - s) / np.sqrt(3)
        cells, stress = np.array([across + s, across, across]), result["force"][row] / 10.0
        expected = uniaxial_stretches(stress, cells, RadialMaterial())[0]
        assert result["mean_stretch"][row] == pytest.approx(expected, abs=1e-8), f"t = {time}"
