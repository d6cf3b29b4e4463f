"""Turnover: collagen that is removed in time and deposited under a stretch; arrays over points.

m is the density of the chains and rho their natural length, each over that at the start. With lambda_e = r/(rho r0),
lambda_h the stretch of deposition and tau(lambda) = g(lambda r0) lambda, proportional to the force of a chain,

    dm/dt / m = k/T (tau(lambda_e)/tau(lambda_h) - 1), limited to k/T,
    drho/dt / rho = (1/T + (dm/dt / m)^+) (lambda_e/lambda_h - 1)

The idea is that of Cyron, Aydin and Humphrey 2016, whose rates are others (docs/turnover.md, Limits).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.model.energy import Tissue

Array = NDArray[np.float64]


STRETCH_ITERATIONS = 60  # of Newton's method for one number; halved brackets alone reach a last digit from any start
COMPLEX_STEP = 1e-30  # of complex steps
LOCKING_MARGIN = 1e-9  # of ln lambda_e: nearer to the locking stretch nothing is looked for


class TurnoverRates(NamedTuple):
    """Of content and natural length: d ln m / dt and d ln rho / dt, 1/time, (n,)."""

    content: Array
    natural_length: Array


class TurnoverRule(NamedTuple):
    """How collagen is turned over: T, lambda_h and k."""

    time: float
    deposition_stretch: float
    gain: float

    def rates(self, tissue: Tissue, stretch: Any) -> TurnoverRates:
        """Where chains have a stretch lambda_e (n,); complex for a derivative by a complex step."""
        chain, r0, contour = tissue.chain, tissue.end_to_end_length, tissue.contour_length
        assert chain is not None

        def tension(some: Any) -> Any:
            return chain.stiffness(some * r0, contour) * some

        relative = tension(stretch) / tension(self.deposition_stretch) - 1.0
        limited = np.where(np.abs(np.real(relative)) < 1.0, relative, np.sign(np.real(relative)))
        content = self.gain / self.time * limited
        turned_over = 1.0 / self.time + np.where(np.real(content) > 0.0, content, 0.0)
        return TurnoverRates(content, turned_over * (stretch / self.deposition_stretch - 1.0))


class TurnedOver(NamedTuple):
    """Content and natural length at the end of a step as functions of r at its end; arrays (n,)."""

    content: Array
    natural_length: Array
    content_slope: Array
    natural_length_slope: Array


def rates(tissue: Tissue, length: Array, time: float, deposition_stretch: float, gain: float) -> TurnoverRates:
    """How fast content and natural length change where chains have a length."""
    stretch = tissue.relative(length) / tissue.end_to_end_length
    return TurnoverRule(time, deposition_stretch, gain).rates(tissue, stretch)


def at_the_end(rule: TurnoverRule, tissue: Tissue, length: Array, duration: float) -> TurnedOver:
    """m and rho after a step with the rates at its end (backward Euler), where r there is `length`."""
    # One number at each point: y = ln lambda_e with
    # ln(r/r0) - y - ln rho_0 = duration (d ln rho / dt)(y), ln rho = ln(r/r0) - y.
    # The left side falls and the right side rises with y. The solution lies between the stretch with rho_0, and
    # lambda_h, where the right side is zero. Where it were beyond the locking stretch there is none: then rho is such
    # that r/(rho L) >= 1.
    assert tissue.chain is not None
    start = np.log(length / (tissue.end_to_end_length * tissue.natural_length))
    deposited = np.full_like(start, np.log(rule.deposition_stretch))
    locked = np.log(tissue.contour_length / tissue.end_to_end_length) if tissue.chain.locks else np.inf + 0 * start
    below = locked - LOCKING_MARGIN  # where the tension is still a number

    def missing(y: Array) -> tuple[Array, Array]:
        found = rule.rates(tissue, np.exp(y + 1j * COMPLEX_STEP))
        change = duration * found.natural_length
        return start - y - change.real, -1.0 - change.imag / COMPLEX_STEP

    low, high = np.minimum(start, deposited), np.minimum(np.maximum(start, deposited), below)
    lost = (high >= below) & (missing(high)[0] > 0.0)
    y = np.clip(start, low, high)
    for _ in range(STRETCH_ITERATIONS):
        value, slope = missing(y)
        low, high = np.where(value > 0.0, y, low), np.where(value > 0.0, high, y)
        better = y - value / slope
        better = np.where((better >= low) & (better <= high), better, (low + high) / 2)
        if np.all(np.abs(better - y) <= np.finfo(float).eps * (1.0 + np.abs(y))):
            break
        y = better
    # beyond the locking stretch: as much as r is beyond the largest one that the step can follow
    found = rule.rates(tissue, np.exp(y + 1j * COMPLEX_STEP))
    y = np.where(lost, locked + missing(y)[0], y)
    by_stretch = [np.imag(rate) * duration / COMPLEX_STEP for rate in found]  # of the changes of ln m and ln rho, by y
    answer = 1.0 / (1.0 + by_stretch[1])  # dy / d ln r
    content = tissue.content * np.exp(duration * np.real(found.content))
    natural_length = length / (tissue.end_to_end_length * np.exp(y))
    return TurnedOver(content, natural_length, by_stretch[0] * answer, 1.0 - answer)
