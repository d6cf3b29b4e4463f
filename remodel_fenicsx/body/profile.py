"""The fibre angle through a body as a few numbers that do not depend on the mesh: columns on request."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.body.column import Column

Array = NDArray[np.float64]

PLACES = 9
PROFILE = tuple(f"angle_profile_{number}" for number in range(PLACES))


def weights(depth: Array) -> Array:
    """Hat functions about equally spaced depths from 0 to 1, one more axis of length PLACES; their sum is one."""
    return np.maximum(0.0, 1.0 - np.abs(np.asarray(depth)[..., None] * (PLACES - 1) - np.arange(PLACES)))


def _value(number: int, measurement: Any) -> float:
    return float(measurement.tool_of_step("angle profile", lambda: _profile(measurement))[number])


def _profile(measurement: Any) -> Array:
    quadrature, shape = measurement.quadrature, measurement.observer.shape
    hats = measurement.tool("hats", lambda: weights(shape.depth(quadrature.coordinates)))
    return np.array([quadrature.mean_of_known(measurement.fibre_angle, hats[..., k]) for k in range(PLACES)])


COLUMNS = tuple(
    Column(
        name,
        "degrees",
        f"mean of the reference fibre angle about {number}/{PLACES - 1} of the way through the wall of a tube, or "
        "along z, weighted with a hat function as wide as a quarter of the way",
        partial(_value, number),
    )
    for number, name in enumerate(PROFILE)
)
