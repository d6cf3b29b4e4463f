"""Strict tables with errors of one line, and TOML in and out; knows no key of any scene."""

# when two times are one: the only tolerance of time
SAME_TIME = 1e-9
"""Relative difference below which two times are the same: what is lost when times are written as decimal numbers."""


def same_time(first: float, second: float) -> bool:
    """Whether two times are the same, in any unit of time."""
    return abs(first - second) <= SAME_TIME * max(abs(first), abs(second))


def is_multiple(time: float, step: float) -> bool:
    """Whether a time is a whole number of steps."""
    return same_time(time, round(time / step) * step)
