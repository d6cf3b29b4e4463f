"""Values of scenes with isotropic cells: tests say what is special in theirs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

ANGLES = ["fibre_angle_inner", "fibre_angle_middle", "fibre_angle_outer"]
PAPER = "kuhl-holzapfel-2007"
TURN = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
"""A rotation that mixes all axes."""


def ramp_to(end: float) -> list[list[float]]:
    """A ramp from nothing to the whole load."""
    return [[0.0, 0.0], [end, 1.0]]


def ramped(end: float, **values: float) -> dict[str, Any]:
    """Loads that rise to their values until a time."""
    return {name: {"value": value, "ramp": ramp_to(end)} for name, value in values.items()}


def isotropic(
    preset: str | None = PAPER, kinematics: str = "radial", **tables: Any
) -> dict[str, Any]:
    """By itself a tube on one radius, without fields of its run; a table that is None is left out."""
    values: dict[str, Any] = {
        "preset": preset,
        "geometry": {"shape": "tube"},
        "model": {"kinematics": kinematics},
    }
    values |= {"cells": {"initial": "isotropic"}, "output": {"fields": False}, **tables}
    return {name: table for name, table in values.items() if table is not None}


def assert_close(
    found: Mapping[str, Any],
    expected: Mapping[str, Any],
    names: Iterable[str],
    rtol: float = 0.0,
    atol: float = 1e-12,
    equal_nan: bool = False,
) -> None:
    """Numbers or arrays of these names, of rows, columns or fields; the larger tolerance holds."""
    for name in names:
        near = pytest.approx(expected[name], rel=rtol, abs=atol, nan_ok=equal_nan)
        assert found[name] == near, name


def assert_orthonormal(axes: np.ndarray, atol: float = 1e-12) -> None:
    """Rows of matrices (..., 3, 3)."""
    products = axes @ np.swapaxes(axes, -1, -2)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), axes.shape), atol=atol)


TENSION = {"rates": "tension", "volume": 0.0}
"""Turnover as version 0.3.0 has it."""


def deformations(number: int, rng: np.random.Generator) -> np.ndarray:
    """Stretches apart, with a rotation: under tension."""
    R = Rotation.random(2 * number, random_state=rng).as_matrix()
    stretches = np.array([1.35, 1.12, 0.8]) + rng.uniform(-0.06, 0.06, (number, 3))
    return R[:number] @ (stretches[:, :, None] * R[number:])
