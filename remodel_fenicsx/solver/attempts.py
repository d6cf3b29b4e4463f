"""What is tried where a solve fails: in which order, and what the log says of it."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import NamedTuple, TypeVar

log = logging.getLogger(__name__)
T = TypeVar("T")
F = TypeVar("F", bound=Exception)


class Attempt(NamedTuple):
    """One way to the solution of a step: what it is, who makes it, and what is logged where it fails."""

    what: str
    where: str
    fails: str = ""


FROM_EXPECTED = Attempt(
    "from the displacement that the last steps let expect",
    "Staggered",
    "not solved from the predicted displacement",
)
FROM_LAST = Attempt("from the last displacement", "Staggered", "solving in parts")
MADE_ANEW = Attempt(
    "in each solve: once more, with new factors or levels in each iteration",
    "EveryTangent.second_try",
    "the step is solved once more",
)
IN_PARTS = Attempt("in parts: first what has remodeled, then the loads, a failed part halved", "Change")
STEP_REFUSED = Attempt("the step is refused, with its kind and advice", "diagnosed")
SHORTER_STEP = Attempt(
    "with a tolerance: a step of a quarter, up to three times", "StepControl", "a shorter step is tried"
)
ATTEMPTS = (FROM_EXPECTED, FROM_LAST, MADE_ANEW, IN_PARTS, STEP_REFUSED, SHORTER_STEP)
"""In their order; docs/architecture.md has the table."""


def attempted(solve: Callable[[], T], *failures: type[F]) -> T | F:
    """Return what a solve gives, or its failure."""
    try:
        return solve()
    except failures as failed:
        return failed


def say(attempt: Attempt, reason: object, how: str = "") -> None:
    """Log that an attempt has failed, and how the next one goes."""
    log.info("%s%s: %s", attempt.fails, f", {how}" if how else "", reason)
