"""Attempts to solve a step, in their order, with log messages."""

from __future__ import annotations

import logging
from typing import NamedTuple

log = logging.getLogger(__name__)


class Attempt(NamedTuple):
    """Attempt to solve a step: description, class or function, and log message of its failure."""

    # The message has the fields {reason}, why the attempt failed, and {how} to proceed.

    what: str
    where: str
    message: str = ""


FROM_PREDICTION = Attempt(
    "from the displacement predicted by the last steps",
    "Staggered",
    "Newton failed from the predicted displacement ({reason}); using the last one",
)
FROM_PREVIOUS = Attempt("from the last displacement", "Staggered", "{reason}; solving in substeps")
WITH_FALLBACK = Attempt(
    "in each solve: again, with a new factorisation in every iteration, or instead of multigrid",
    "FullNewton.fallback",
    "Newton failed ({reason}); retrying {how}",
)
IN_SUBSTEPS = Attempt(
    "in substeps: first the remodeled cells, then the loads; a failed substep is halved",
    "Continuation",
)
STEP_FAILS = Attempt("the step fails, with its cause and advice", "diagnose_failure")
SHORTER_STEP = Attempt(
    "with time.tolerance: a quarter of the step size, up to three times",
    "StepControl",
    "{reason}; retrying with a smaller step",
)
ATTEMPTS = (FROM_PREDICTION, FROM_PREVIOUS, WITH_FALLBACK, IN_SUBSTEPS, STEP_FAILS, SHORTER_STEP)
"""Attempts in their order; docs/architecture.md has the table."""


def say(attempt: Attempt, reason: object, how: str = "") -> None:
    """Log that an attempt has failed, and how the next one proceeds."""
    log.info("%s", attempt.message.format(reason=reason, how=how))
