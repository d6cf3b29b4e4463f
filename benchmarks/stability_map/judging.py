"""From a run and what its reference says to an outcome."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from benchmarks.stability_map.cases import Case, Finding, Run

OUTCOMES = ("right", "refused", "unstable", "warned", "wrong", "unchecked")
# what a refusal must say to be one with a cause
CAUSES = re.compile(
    r"limit point|bifurcation|kinematic locking|chain locking|chains? lock|solver tolerance|eigenvalue",
    re.I,
)
UNSTABLE = re.compile(
    r"negative eigenvalue|unstable equilibrium|equilibrium is unstable|no longer a minimum|lost (its )?stability|"
    r"would buckle|expected buckling",
    re.I,
)
# warnings about what is asked for, units and compressible tissue, which say nothing about whether the answer is right
ABOUT_THE_SCENE = re.compile(r"^(material|geometry|loads)\.|the tissue has lost up to")
# a reference on the same elements cannot tell whether they are too large
SAME_MESH = "half of the step"
ABOUT_THE_MESH = re.compile(rf"{ABOUT_THE_SCENE.pattern}|the elements (lock|are too large)")
BAD_INPUT, SOLVE_FAILED, NO_END, CRASHED = 2, 3, -2, -1


@dataclass(frozen=True)
class Verdict:
    """How a case has ended.

    Attributes
    ----------
    outcome
        One of `OUTCOMES`.
    words
        Why.
    ratio
        Deviation over tolerance, where it is known.
    false_alarm
        Right, but the run warned.
    cause_named
        Of a refusal: whether it says why.
    """

    outcome: str
    words: str = ""
    ratio: float | None = None
    false_alarm: bool = False
    cause_named: bool | None = None


def judged(case: Case, run: Run) -> Verdict:
    """The verdict on a run."""
    if run.code == NO_END:
        return Verdict("unchecked", run.said)
    if run.code not in (0, BAD_INPUT, SOLVE_FAILED):
        return Verdict("wrong", f"exit {run.code}: {run.said[-300:].strip()}")
    if run.code == BAD_INPUT:
        return Verdict(
            "refused", run.said.strip(), cause_named=True
        )  # one line names key and value: the contract
    finding = case.check(case, run)
    ratio = float(finding.ratio) if np.isfinite(finding.ratio) else None
    if run.code == SOLVE_FAILED:
        return _refused(run, finding, ratio)
    if np.isnan(finding.ratio):
        return Verdict("unchecked", finding.words)
    beside = ABOUT_THE_MESH if case.reference == SAME_MESH else ABOUT_THE_SCENE
    warnings = [line for line in run.warnings if not beside.search(line)]
    named = [line for line in warnings if UNSTABLE.search(line)]
    others = [line for line in warnings if line not in named]
    if finding.unstable:
        if named:
            return Verdict("unstable", named[0], ratio)
        return Verdict("wrong", f"unstable equilibrium without a word; {finding.words}", ratio)
    if finding.ratio <= 1:
        if named and finding.unstable is None:
            return Verdict("unstable", named[0], ratio)
        said = [
            line
            for line in (*named, *others)
            if not any(text in line for text in finding.confirmed)
        ]
        return Verdict("right", said[0] if said else finding.words, ratio, false_alarm=bool(said))
    if warnings:
        return Verdict(
            "unstable" if named else "warned", f"{finding.words}; said: {warnings[0]}", ratio
        )
    return Verdict("wrong", finding.words, ratio)


def _refused(run: Run, finding: Finding, ratio: float | None) -> Verdict:
    said = run.said.strip().splitlines()
    message = next(
        (line for line in reversed(said) if "no equilibrium" in line), said[-1] if said else ""
    )
    notes = [message]
    if finding.solvable:
        notes.append("the reference goes on")
    if ratio is not None and ratio > 1:
        notes.append(f"accepted rows are off: {finding.words}")
    return Verdict("refused", "; ".join(notes), ratio, cause_named=bool(CAUSES.search(run.said)))
