"""What is said where there is no unloaded shape, and the shares of the loads in which it is looked for."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

from remodel_fenicsx.scene import SceneError
from remodel_fenicsx.solver.continuation import StepFailure

Found = TypeVar("Found")
log = logging.getLogger(__name__)

SHARES = (0.25, 0.5, 0.75, 1.0)  # of the loads, where they cannot be taken in one piece


class NoUnloadedShape(RuntimeError):
    """There is none that the loads bring to the given one; one line with the share of the loads, and why."""


def in_shares(find: Callable[[float, Found], Found], start: Found) -> Found:
    """What is found at all of the loads: in one piece, or in shares, each from the one before.

    Parameters
    ----------
    find
        Of a share of the loads and a start; ArithmeticError, StepFailure or SceneError where nothing is found.

    Raises
    ------
    NoUnloadedShape
        If a share has none.
    """
    refusals = (ArithmeticError, StepFailure, SceneError)
    try:
        return find(1.0, start)
    except refusals as error:
        log.info("unloading all loads at once failed (%s); they are now taken in parts", " ".join(str(error).split()))
    done = 0.0
    for share in SHARES:
        try:
            start = find(share, start)
        except refusals as error:
            reason = " ".join(str(error).split())
            raise NoUnloadedShape(
                f"geometry.is = 'loaded': no unloaded body was found at {100 * share:g} % of the loads, there is "
                f"one at {100 * done:g} %: {reason}; try lower loads, or a stiffer tissue"
            ) from error
        done = share
    return start
