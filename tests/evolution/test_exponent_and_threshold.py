"""remodeling.exponent and remodeling.threshold: closed forms, and what has none of them is refused by name."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from remodel_fenicsx.model import tensor_law
from tests.runs import last_row
from tests.values import ramped, isotropic


@pytest.mark.parametrize(("exponent", "angle"), [(1.0, 35.26), (2.0, 26.57), (4.0, 14.04)])
def test_fibres_of_a_thin_closed_tube(exponent: float, angle: float) -> None:
    """Its hoop stress is twice the axial one: tan^2 a = 2^-n; n = 1 is netting analysis."""
    values = isotropic(
        "consistent", geometry={"shape": "tube", "inner_radius": 100.0, "outer_radius": 100.5, "length": 10.0},
        supports={"ends": "closed"}, remodeling={"exponent": exponent, "kappa": 0.1},
        loads=ramped(10.0, pressure=0.005, elongation=0.0), time={"end": 300.0, "step": 5.0},
    )  # fmt: skip
    assert last_row(values)["fibre_angle_middle"] == pytest.approx(angle, abs=0.25)


def stiff_cube(**remodeling: Any) -> dict[str, Any]:
    """Under a stress of 10, which hardly deforms it."""
    return isotropic(
        None, "point", geometry={"shape": "cube", "side": 1.0}, material={"lame_mu": 1e6, "lame_lambda": 1e6},
        loads={"force": {"value": 10.0, "ramp": [[0.0, 1.0]]}}, time={"end": 20.0, "step": 1.0},
        remodeling={"law": "tensor", "coupling": "staggered", "kappa": 0.02} | remodeling,
        output={"fields": False, "columns": ["inactive_fraction", "mean_fibre_angle"]},
    )  # fmt: skip


@pytest.mark.parametrize("coupling", ["staggered", "extrapolated"])
def test_the_lazy_zone_slows_and_stops(coupling: str) -> None:
    """A threshold of half the stress is half of kappa; one above it leaves the cells alone."""
    slow = last_row(stiff_cube(threshold=5.0, coupling=coupling))
    half = last_row(stiff_cube(kappa=0.01, coupling=coupling))
    asleep = last_row(stiff_cube(threshold=10.5, coupling=coupling))
    assert slow["mean_fibre_angle"] == pytest.approx(half["mean_fibre_angle"], abs=2e-3)
    start = np.degrees(np.arccos(1 / np.sqrt(3)))
    assert slow["mean_fibre_angle"] < start - 3 and asleep["mean_fibre_angle"] == pytest.approx(
        start, abs=1e-9
    )
    assert (slow["inactive_fraction"], asleep["inactive_fraction"]) == (0.0, 1.0)
    with np.errstate(all="raise"):
        assert tensor_law.activation(np.diag([1e-300, 0.0, -1.0])[None], 1e60) == 0


def test_the_target_of_any_exponent() -> None:
    """Its principal values are powers of those of the driving tensor, in any basis; the trace is one."""
    random = np.random.default_rng(3)
    axes = np.linalg.qr(random.standard_normal((3, 3)))[0]
    values = np.array([4.0, 1.0, -2.0])
    tensor = (axes * values) @ axes.T
    for exponent in (0.5, 1.0, 3.0):
        powers = np.maximum(values, 0) ** exponent
        expected = (axes * (powers / powers.sum())) @ axes.T
        found = tensor_law.target(tensor[None], 0.0, exponent)
        assert np.abs(found.direction[0] - expected).max() < 1e-12
        assert found.switch == pytest.approx(tensor_law.target(tensor[None], 0.0).switch)
    zero = tensor_law.target(-np.eye(3)[None], 0.0, 1.0)
    assert not zero.direction.any() and np.isfinite(zero.switch).all()
