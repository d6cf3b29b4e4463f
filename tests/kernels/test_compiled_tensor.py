"""What tensor.c computes at points is what numpy does, without a mesh."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx.kernels import TensorKernels
from remodel_fenicsx.model import energy
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.drivers import DRIVERS, FRAMES
from remodel_fenicsx.model.laws import Drive, tensor_target
from tests.model.test_tensor_law import cells_of, right_cauchy_green, structures
from tests.values import deformations


@pytest.fixture(scope="module")
def kernels() -> TensorKernels:
    return TensorKernels(MPI.COMM_SELF)


def test_derivatives_of_the_logarithm(kernels: TensorKernels) -> None:
    """Equal and nearly equal eigenvalues too, on both sides of the series' threshold."""
    C = right_cauchy_green()
    A = structures(len(C))
    expected, found = energy.log_derivatives(C, A), kernels.log_derivatives(C, A)
    np.testing.assert_allclose(found[0], expected[0], atol=1e-13)
    np.testing.assert_allclose(found[1], expected[1], atol=1e-11 * np.abs(expected[1]).max())
    first, none = kernels.log_derivatives(C, A, second=False)
    assert none is None and np.array_equal(first, found[0])


def test_the_sum_of_the_energy(kernels: TensorKernels) -> None:
    F, cells = np.linalg.cholesky(right_cauchy_green()), cells_of(structures(26))
    expected = energy.log_sum(F, [cells], 1.0)
    np.testing.assert_allclose(kernels.log_sum(F, [cells], 1.0), expected, atol=1e-13)
    half = [UnitCell(*cells[:2], weight=0.5)] * 2
    np.testing.assert_allclose(kernels.log_sum(F, half, 1.0), expected, atol=1e-13)


@pytest.mark.parametrize("driver", ["cauchy", "pk2"])
@pytest.mark.parametrize("frame", ["material", "spatial"])
def test_the_target(kernels: TensorKernels, driver: str, frame: str) -> None:
    """Tension, compression, nothing, and values near the switch."""
    rng = np.random.default_rng(2)
    tensors = rng.standard_normal((40, 3, 3))
    tensors = tensors + np.swapaxes(tensors, 1, 2)
    tensors[:4] = np.array([0.0, -1.0, 3e-11, 1e200])[:, None, None] * np.eye(3)
    F = deformations(40, rng)
    drive = Drive(
        F, tensors, DRIVERS[driver], FRAMES[frame], 1e-14, np.zeros((40, 3)), np.ones(40), 0.025
    )
    for threshold, rounding in (
        (1e-14, 1e-14),
        (rng.uniform(0, 0.3, 40), 1e-14),
        (0.0, rng.uniform(0, 1e-4, 40)),
    ):
        asked = drive._replace(noise=threshold, rounding=rounding)
        expected, found = tensor_target(asked), kernels.target(asked)
        np.testing.assert_allclose(found.direction, expected.direction, atol=1e-12)
        np.testing.assert_allclose(found.switch, expected.switch, atol=1e-12)
