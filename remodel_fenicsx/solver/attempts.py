"""Attempts to solve a step, in their order, with log messages."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import NamedTuple, TypeVar

log = logging.getLogger(__name__)
T = TypeVar("T")
F = TypeVar("F", bound=Exception)


class Attempt(NamedTuple):
    """Attempt to solve a step: description, class or function, and log message of its failure."""

    # The message has the fields {reason}, why the attempt failed, and {how} to proceed.

    what: str
    where: str
    message: str = ""


FROM_EXPECTED = Attempt(
    "from the displacement predicted by the last steps",
    "Staggered",
    "Newton failed from the predicted displacement ({reason}); using the last one",
)
FROM_LAST = Attempt("from the last displacement", "Staggered", "{reason}; solving in substeps")
MADE_ANEW = Attempt(
    "in each solve: again, with a new factorisation in every iteration, or instead of multigrid",
    "FullNewton.fallback",
    "Newton failed ({reason}); retrying {how}",
)
IN_PARTS = Attempt(
    "in substeps: first the remodeled cells, then the loads; a failed substep is halved", "Change"
)
STEP_REFUSED = Attempt("the step fails, with its cause and advice", "diagnose_failure")
SHORTER_STEP = Attempt(
    "with time.tolerance: a quarter of the step size, up to three times",
    "StepControl",
    "{reason}; retrying with a smaller step",
)
ATTEMPTS = (FROM_EXPECTED, FROM_LAST, MADE_ANEW, IN_PARTS, STEP_REFUSED, SHORTER_STEP)
"""Attempts in their order; docs/architecture.md has the table."""


def attempted(solve: Callable[[], T], *failures: type[F]) -> T | F:
    """Return the result of a solve, or its failure."""
    try:
        return solve()
    except failures as failed:
        return failed


def say(attempt: Attempt, reason: object, how: str = "") -> None:
    """Log that an attempt has failed, and how the next one proceeds."""
    log.info("%s", attempt.message.format(reason=reason, how=how))
