"""A quantity of the history, named once: what it is called, its unit, what it means, how it is measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Column:
    """A column of history.csv.

    Attributes
    ----------
    name
        As in the file's first row.
    unit
        In words, for the documentation: "stress", "length", "degrees", "" for none.
    meaning
        One sentence.
    value
        Its value from a `results.columns.Measurement`.
    after_pass
        Whether it is known only when the cells have remodeled; all others belong to the solved state.
    extreme
        Whether it is the largest or smallest value of the body: of random cells it goes with their number.
    """

    name: str
    unit: str
    meaning: str
    value: Callable[[Any], float]
    after_pass: bool = False
    extreme: bool = False
