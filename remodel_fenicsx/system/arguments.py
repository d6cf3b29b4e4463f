"""What is typed on the command line."""

from __future__ import annotations

import argparse
import math
import os
import re
import shlex
import shutil
from pathlib import Path


def wall_time(text: str) -> float:
    """Seconds of a time such as 90s, 30min, 2h.

    Raises
    ------
    ArgumentTypeError
        If it is none.
    """
    found = re.fullmatch(r"([0-9]{1,9}(?:\.[0-9]{1,9})?)\s*(s|min|h|d)", text)
    seconds = float(found[1]) * {"s": 1, "min": 60, "h": 3600, "d": 86400}[found[2]] if found else 0.0
    if seconds <= 0:
        raise argparse.ArgumentTypeError(f"{text!r}: must be a time greater than 0 with its unit: 90s, 30min, 2h, 1.5d")
    return seconds


MOST_RUNS = (
    10_000  # of runs of a study, or of times that are analysed: each is a folder or a row that a person looks at
)


def positive(text: str) -> int:
    """A whole number from 1 to `MOST_RUNS`.

    Raises
    ------
    ArgumentTypeError
        If it is none.
    """
    number = int(text)
    if not 1 <= number <= MOST_RUNS:
        raise argparse.ArgumentTypeError(f"{text}: allowed is a whole number from 1 to {MOST_RUNS}")
    return number


MOST_MEGABYTES = 1000.0  # of a page: browsers open no larger one


def megabytes(text: str) -> float:
    """A number above 0, up to `MOST_MEGABYTES`.

    Raises
    ------
    ArgumentTypeError
        If it is none.
    """
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 < number <= MOST_MEGABYTES:
        raise argparse.ArgumentTypeError(f"{text!r}: allowed is a number of MB above 0, up to {MOST_MEGABYTES:g}")
    return number


def typed() -> str:
    """The command as it has to be typed here: through the launcher, where that is how its programs are found."""
    launcher = Path(__file__).resolve().parents[2] / "with-fenicsx"
    found = shutil.which("remodel-fenicsx")
    if found is None or Path(found).resolve() != launcher.parent / "bin" / "remodel-fenicsx":
        return "remodel-fenicsx"
    near = os.path.relpath(launcher)
    return f"{shlex.quote(str(launcher) if near.startswith('..') else f'./{near}')} remodel-fenicsx"
