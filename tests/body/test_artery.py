"""Figs. 7 and 8: the artery with the preset's random cells.

The whole one to its end is slow, two of its twelve layers to the middle of the hold are not.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.conftest import Case

ARTERY = {
    "preset": "kuhl-holzapfel-2007",
    "geometry": {"shape": "tube", "inner_radius": 1.0, "outer_radius": 3.0, "length": 8.0},
    "solver": {"method": "direct", "predictor": "none", "absolute_tolerance": 1e-10, "relative_tolerance": 0.0},
}


LAYERS = 2  # of elements along the axis, each 8/12 long
KAPPA = 0.025


def slice_of(scene: dict, layers: int = LAYERS) -> dict[str, Any]:
    """Arguments of `case` for a short piece of the artery with elements like the whole one's."""
    geometry = {**scene["geometry"], "length": 8.0 / 12 * layers}
    return {"scene": {**scene, "geometry": geometry}, "divisions": (16, 8, layers)}


@pytest.fixture(scope="module", params=["slice", pytest.param("whole", marks=pytest.mark.slow)])
def artery(request: pytest.FixtureRequest, case: Case) -> dict:
    """150 steps; 75 of the slice, when most of it is done."""
    if request.param == "slice":
        return case(**slice_of(ARTERY | {"time": {"end": 75.0}}), snapshots=(24.0,))
    return case(ARTERY, snapshots=(24.0, 150.0))


def is_whole(artery: dict) -> bool:
    """All twelve layers along the axis."""
    return len(artery["x"]) == 16 * 8 * 12


def test_outer_radius_peaks_at_full_load_and_shrinks_as_the_wall_stiffens(artery: dict) -> None:
    peak = artery["time"][np.argmax(artery["outer_radius"])]
    assert 22 <= peak <= 26
    fall = artery["outer_radius"].max() - artery["outer_radius"][-1]
    assert 0.15 <= fall <= 0.20 if is_whole(artery) else 0.13 <= fall <= 0.15
    # symmetry planes would give 3.228; a slice has a sixth of the whole's random cells
    assert artery["outer_radius"][23] == pytest.approx(3.243, abs=2e-3 if is_whole(artery) else 6e-3)


def layer_angles(artery: dict) -> np.ndarray:
    """Mean reference fibre angle of each of the eight element layers at the end, from the inside, degrees."""
    x, l, n = artery["x"], artery["l"], artery["n"]
    radius = np.hypot(x[..., 0], x[..., 1])
    around = np.stack([-x[..., 1], x[..., 0], 0 * radius], axis=-1) / radius[..., None]
    tensor = np.einsum("epI,epIi,epIj->epij", l**2, n, n)
    pitch = np.degrees(
        np.arctan2(np.sqrt(tensor[..., 2, 2]), np.sqrt(np.einsum("epi,epij,epj->ep", around, tensor, around)))
    )
    layer = np.floor((radius.mean(axis=1) - 1.0) / 0.25 + 1e-6).astype(int)
    assert np.array_equal(np.bincount(layer), np.full(8, len(x) // 8))
    return np.array([pitch[layer == k].mean() for k in range(8)])


def test_fibre_angle_rises_from_layer_to_layer(artery: dict) -> None:
    angles = layer_angles(artery)
    assert np.all(np.diff(angles) > 0)
    whole, half_way = [1.1, 4.2, 14.0, 36.9, 60.2, 66.7, 70.3, 72.7], [5.0, 9.1, 18.4, 31.6, 41.0, 53.4, 57.0, 61.4]
    expected, tolerance = (whole, 1.5) if is_whole(artery) else (half_way, 2.0)
    np.testing.assert_allclose(angles, expected, rtol=0, atol=tolerance)


def test_history_columns_are_the_means_of_their_layers(artery: dict) -> None:
    angles = layer_angles(artery)
    assert artery["fibre_angle_inner"][-1] == pytest.approx(angles[0], abs=0.5)
    assert artery["fibre_angle_middle"][-1] == pytest.approx((angles[3] * 15 + angles[4] * 17) / 32, abs=1.0)
    assert artery["fibre_angle_outer"][-1] == pytest.approx(angles[7], abs=0.5)


def test_third_dimension_dies_out_where_there_is_no_third_tension(artery: dict) -> None:
    never = ~artery["third_in_tension"]
    assert 0.05 < never.mean()
    left = artery["l"][..., 2][never]
    share = np.exp(-KAPPA * artery["time"][-1])  # 0.0235 at t = 150
    assert np.all(left <= share * artery["l0"][..., 2][never] + 1e-3)


def test_no_accepted_state_passes_the_contour_length(artery: dict) -> None:
    assert np.all(artery["max_chain_extension"] < 1.0)
    assert np.all(artery["min_jacobian"] > 0.0)
    assert np.all(artery["substeps"] == 1)  # the printed method needs no help here


def test_newton_converges_as_with_a_consistent_tangent(artery: dict) -> None:
    assert artery["newton_iterations"].max() <= 8
    assert artery["newton_iterations"].mean() < 4.0
