"""How far results are from those of ever finer settings: Richardson's extrapolation, where an order shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

RATIOS = (1.35, 40.0)  # of differences of one halving and the next that are those of an order
ALIGNED = 0.5  # cosine of the angle between two differences, as vectors, that shrink along one way


@dataclass(frozen=True)
class Limit:
    """What a sweep of one factor tends to.

    Attributes
    ----------
    beyond
        What is left from its finest member to the limit; zero where no order shows.
    order
        Power of the step or of the size of the elements; NaN where none shows.
    last
        Difference of the finest two.
    """

    beyond: Array
    order: float
    last: Array

    @property
    def trusted(self) -> bool:
        """Whether an order shows."""
        return bool(np.isfinite(self.order))


def limit(results: Sequence[Array]) -> Limit:
    """The limit of results of settings that are each half of the one before, the finest last.

    Differences d of results Q fall by a ratio q = 2^p from halving to halving; what is left is d / (q - 1). An order
    shows where the differences shrink along one way: by a ratio in RATIOS, ALIGNED.
    """
    if len(results) < 3:
        last = results[-1] - results[-2] if len(results) == 2 else np.full_like(results[-1], np.nan)
        return Limit(np.zeros_like(results[-1]), np.nan, last)
    before, last = results[-2] - results[-3], results[-1] - results[-2]
    size_before, size = _norm(before), _norm(last)
    if size == 0:
        return Limit(np.zeros_like(last), np.inf, last)
    ratio = size_before / size
    cosine = float(np.nansum(before * last) / max(np.nansum(before**2) ** 0.5 * np.nansum(last**2) ** 0.5, 1e-300))
    if not RATIOS[0] < ratio < RATIOS[1] or cosine < ALIGNED:
        return Limit(np.zeros_like(last), np.nan, last)
    return Limit(np.asarray(last / (ratio - 1), dtype=np.float64), float(np.log2(ratio)), last)


def _norm(values: Array) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def typical(difference: Array) -> float:
    """Root mean square of what is known."""
    return _norm(difference)


def pareto(costs: Sequence[float], errors: Sequence[float]) -> list[bool]:
    """Which of some settings no other one beats in cost and error."""
    pairs = list(zip(costs, errors, strict=True))
    return [
        np.isfinite(error) and not any((c <= cost and e < error) or (c < cost and e <= error) for c, e in pairs)
        for cost, error in pairs
    ]
