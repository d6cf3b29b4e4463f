"""docs/against_measurements.md: its tables are those of its runs, and its formulas are moments of densities."""

from __future__ import annotations

import numpy as np
import pytest

from docs.making import measurements as compare
from docs.making.pages import DOCS


def test_the_page_is_what_its_table_says() -> None:
    """Whoever makes the runs anew and forgets the page, or edits a number by hand, is told."""
    assert compare.page_text() == (DOCS / "against_measurements.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(("mean", "width"), [(0.7, 3.4), (20.0, 1.5)])
def test_angles_of_second_moments(mean: float, width: float) -> None:
    """By the moments of the densities on a fine grid."""
    angle = np.radians(np.arange(-89.975, 90, 0.05))
    m = np.radians(mean)
    von_mises = np.exp(width * np.cos(2 * (angle - m)))
    s = np.radians(10 * width)
    normal = sum(np.exp(-((angle - m + k * np.pi) ** 2) / (2 * s**2)) for k in range(-5, 6))
    for density, found in (
        (von_mises, compare.von_mises_angle(mean, width)),
        (normal, compare.normal_angle(mean, 10 * width)),
    ):
        across = (density * np.sin(angle) ** 2).sum() / density.sum()
        assert np.degrees(np.arcsin(np.sqrt(across))) == pytest.approx(found, abs=1e-6)


def test_a_row_of_the_table_is_run_again() -> None:
    """The sheet, and the thin wall with residual stress."""
    found = compare.read_table(DOCS / "figures" / "measurements.csv")
    assert compare.sheet(found["kappa"][-1]) == pytest.approx(found[compare.BANDS[0]][-1], rel=1e-6)
    number = list(compare.WALLS).index("1 to 1.3, opening angle 90")
    row = compare.wall(*compare.WALLS["1 to 1.3, opening angle 90"])
    for name in compare.BANDS:
        assert row[name] == pytest.approx(found[name][number], abs=1e-3)
