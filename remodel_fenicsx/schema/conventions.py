"""Numbers in another convention than the one that is asked for: one table, for scenes and for measurements."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


class Doubt(NamedTuple):
    """What numbers of a quantity hardly are."""

    quantity: str  # regular expression of its key or column, with the unit of a column in brackets
    holds: Callable[[Array, Array], bool]  # of magnitudes, and of those of the model, NaN where there is none
    words: str


# The first that holds is said. Comparisons with NaN do not hold.
CONVENTIONS = (
    Doubt("elongation", lambda x, _: x.max() > 3.0, "reaches {high:.4g}: percent? An elongation of 10 % is 0.1"),
    # a table of stretches begins at 1 within what is measured
    Doubt(
        "elongation",
        lambda x, _: x.min() > 0.98,
        "reaches {high:.4g}: a stretch? A stretch of 1.1 is an elongation of 0.1, an engineering strain",
    ),
    Doubt("stretch", lambda x, _: x.max() > 10.0, "reaches {high:.4g}: percent? A stretch of 110 % is 1.1"),
    # soft tissue is compressed to 0.5 at most
    Doubt(
        "stretch", lambda x, _: x.min() < 0.4, "begins at {low:.4g}: strains? A stretch of 1 is the reference length"
    ),
    # fibres along circles have angles of 0.1 and less; those of the model may be small too
    Doubt(
        r"\b(\w*_)?angle",
        lambda x, model: 0.1 < x.max() <= 3.15 and not model.max() <= 3.15,
        "{high:.3g} at most: radians? Degrees are asked",
    ),
    Doubt(
        "temperature",
        lambda x, _: not 250.0 <= x.min() <= x.max() <= 400.0,  # of what is neither ice nor cooked
        "{high:.4g} is hardly an absolute temperature in K; 37 degC are 310.15",
    ),
    Doubt(
        r"radius \(length\)",  # the model's tissue is a guess
        lambda x, model: 1.7 < (x / model).min() <= np.median(x / model) < 2.4,
        "{ratio:.3g} times those of the scene at the start; are they diameters?",
    ),
    Doubt(
        r"\(length\)",  # units differ by ten and more
        lambda x, model: abs(np.log(np.median(x / model))) > np.log(5.0),
        "{ratio:.3g} times those of the scene at the start; another unit than geometry.length_unit? See units",
    ),
    Doubt(
        "wall_thickness / inner_radius",
        lambda x, model: bool(np.median(x) > 1.0 >= np.median(model)),
        "a wall thicker than the lumen's radius, and {ratio:.3g} times the scene's at the start: another unit?",
    ),
)


def convention_doubt(quantity: str, values: ArrayLike, model: ArrayLike = np.nan) -> str:
    """Return what numbers of a quantity may be instead, or nothing."""
    numbers, expected = np.abs(np.atleast_1d(values)), np.maximum(np.abs(np.atleast_1d(model)), 1e-300)
    for doubt in CONVENTIONS:
        if re.search(doubt.quantity, quantity) and doubt.holds(numbers, expected):
            ratio = np.median(numbers / expected)
            return doubt.words.format(low=numbers.min(), high=numbers.max(), ratio=ratio)
    return ""
