"""docs/validation.md: its tables are those of its runs, its formulas moments of densities, and others' numbers met."""

from __future__ import annotations

import numpy as np
import pytest

from docs.making import validation
from docs.making.pages import DOCS, rows_of
from tests.values import assert_close


def test_the_page_is_what_its_tables_say() -> None:
    """Whoever makes the runs anew and forgets the page, or edits a number by hand, is told."""
    assert validation.page_text() == (DOCS / "validation.md").read_text(encoding="utf-8")


def test_what_must_agree_agrees() -> None:
    """In the kept table; tests of peers, sheets, exponents and thresholds run such cases again."""
    rows = rows_of(DOCS / "figures" / "validation-agreed.csv")
    assert len(rows) > 30 and all(row["difference"] <= row["tolerance"] for row in rows)


@pytest.mark.parametrize(("mean", "width"), [(0.7, 3.4), (20.0, 1.5)])
def test_angles_of_second_moments(mean: float, width: float) -> None:
    """By the moments of the densities on a fine grid."""
    angle = np.radians(np.arange(-89.975, 90, 0.05))
    m = np.radians(mean)
    von_mises = np.exp(width * np.cos(2 * (angle - m)))
    s = np.radians(10 * width)
    normal = sum(np.exp(-((angle - m + k * np.pi) ** 2) / (2 * s**2)) for k in range(-5, 6))
    for density, found in (
        (von_mises, validation.von_mises_angle(mean, width)),
        (normal, validation.normal_angle(mean, 10 * width)),
    ):
        across = (density * np.sin(angle) ** 2).sum() / density.sum()
        assert np.degrees(np.arcsin(np.sqrt(across))) == pytest.approx(found, abs=1e-6)


def test_a_row_of_the_table_is_run_again() -> None:
    """The thin wall with residual stress."""
    label = "1 to 1.3, opening angle 90"
    (kept,) = (row for row in rows_of(DOCS / "figures" / "validation.csv") if row["case"] == label)
    row = validation.wall(*validation.WALLS[label])
    assert_close(row, kept, validation.BANDS, atol=1e-3)
