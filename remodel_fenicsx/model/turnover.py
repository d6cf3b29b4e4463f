"""Turnover: collagen that is removed in time and deposited under a stretch; arrays over points.

m is the density of the chains and rho their natural length, each over that at the start. With lambda_e = r/(rho r0),
lambda_h the stretch of deposition and tau(lambda) = g(lambda r0) lambda, proportional to the force of a chain,

    dm/dt / m = k/T (tau(lambda_e)/tau(lambda_h) - 1), limited to k/T,
    drho/dt / rho = (1/T + (dm/dt / m)^+) (lambda_e/lambda_h - 1)

after Cyron, Aydin and Humphrey 2016 (docs/turnover.md).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.model.energy import Tissue

Array = NDArray[np.float64]


class TurnoverRates(NamedTuple):
    """Of content and natural length: d ln m / dt and d ln rho / dt, 1/time, (n,)."""

    content: Array
    natural_length: Array


def rates(tissue: Tissue, length: Array, time: float, deposition_stretch: float, gain: float) -> TurnoverRates:
    """How fast content and natural length change where chains have a length.

    Parameters
    ----------
    tissue
        With chains; content and natural length are arrays over points.
    length
        r, in link lengths (n,), below rho L.
    time, deposition_stretch, gain
        T, lambda_h and k.
    """
    chain, r0, contour = tissue.chain, tissue.end_to_end_length, tissue.contour_length
    assert chain is not None

    def tension(stretch: Any) -> Any:
        return chain.stiffness(stretch * r0, contour) * stretch

    stretch = tissue.relative(length) / r0
    content = gain / time * np.clip(tension(stretch) / tension(deposition_stretch) - 1.0, -1.0, 1.0)
    turned_over = 1.0 / time + np.maximum(content, 0.0)
    return TurnoverRates(content, turned_over * (stretch / deposition_stretch - 1.0))
