"""Kinds of refusals: what ends a step, and what helps."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Refusal:
    """Why there is no further step.

    Attributes
    ----------
    kind
        What it is called; empty where no cause is seen.
    advice
        What helps against it.
    """

    kind: str
    advice: str

    def __str__(self) -> str:
        return f"{self.kind}: {self.advice}" if self.kind else self.advice


TOO_LARGE = Refusal("", "try a smaller time.step, a slower ramp or lower loads")
UNSTABLE = Refusal("lost stability", 'lower the load, or go on beyond it with solver.unstable = "warn"')
