"""The wormlike chain: eqs. (1), (2), Fig. 1 and the bracket of eq. (7)."""

import numpy as np
import pytest

from remodel_fenicsx.model.chains import BOLTZMANN_CONSTANT, CHAINS

CONTOUR_LENGTHS = [1.594, 2.125]
WORMLIKE = CHAINS["wormlike"]


def lengths(contour_length: float) -> np.ndarray:
    return contour_length * np.linspace(0.02, 0.98, 25)


def test_boltzmann_constant_as_printed() -> None:
    assert BOLTZMANN_CONSTANT == 1.381e-23


@pytest.mark.parametrize("contour_length", CONTOUR_LENGTHS)
def test_force_is_the_slope_of_the_energy(contour_length: float) -> None:
    r = lengths(contour_length)
    h = 1e-5 * (contour_length - r)
    slope = (WORMLIKE.energy(r + h, contour_length) - WORMLIKE.energy(r - h, contour_length)) / (
        2 * h
    )
    np.testing.assert_allclose(WORMLIKE.force(r, contour_length, 1.0), slope, rtol=1e-7)


@pytest.mark.parametrize("contour_length", CONTOUR_LENGTHS)
def test_stiffness_is_the_bracket_of_eq_7_and_force_over_length(contour_length: float) -> None:
    r, big_l = lengths(contour_length), contour_length
    printed = 1 / big_l + 1 / (4 * r * (1 - r / big_l) ** 2) - 1 / (4 * r)
    np.testing.assert_allclose(WORMLIKE.stiffness(r, big_l), printed, rtol=1e-13)
    np.testing.assert_allclose(WORMLIKE.force(r, big_l, 1.0), printed * r, rtol=1e-13)


def test_stiffness_has_no_pole_at_zero_length() -> None:
    assert WORMLIKE.stiffness(0.0, 2.0) == pytest.approx(1.5 / 2.0, rel=1e-15)
    assert WORMLIKE.stiffness(1e-12, 2.0) == pytest.approx(1.5 / 2.0, rel=1e-11)


def test_values_of_the_paper() -> None:
    """2 x^2 + 1/(1-x) - x = 2 at x = 1/2; the tendon's network modulus c = 1.568 Pa and c g(r0) = 3.415 Pa."""
    assert WORMLIKE.energy(1.0, 2.0) == pytest.approx(2.0 / 4 * 2.0, rel=1e-15)
    c = BOLTZMANN_CONSTANT * 310.0 * 2e21 / (4 * 1.365)
    assert c == pytest.approx(1.568, abs=5e-4)
    assert c * WORMLIKE.stiffness(1.0, 1.594) == pytest.approx(3.4149, abs=5e-5)


def test_force_is_finite_and_positive_beyond_the_contour_length() -> None:
    """The silent wrong branch: nothing in eq. (2) forbids r > L, so the solver must."""
    assert 0 < WORMLIKE.force(1.4, 1.0, 0.25) < WORMLIKE.force(0.9, 1.0, 0.25)
