"""Deformation gradients of many points at once."""

from __future__ import annotations

import numpy as np

from remodel_fenicsx.model.tensors import cofactor


def test_the_cofactor_is_j_times_the_inverse_transposed() -> None:
    """Nanson's formula; also where there is no inverse."""
    F = np.eye(3) + 0.3 * np.random.default_rng(1).standard_normal((5, 2, 3, 3))
    expected = np.linalg.det(F)[..., None, None] * np.swapaxes(np.linalg.inv(F), -1, -2)
    np.testing.assert_allclose(cofactor(F), expected, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(cofactor(np.diag([2.0, 3.0, 0.0])), np.diag([0.0, 0.0, 6.0]))
