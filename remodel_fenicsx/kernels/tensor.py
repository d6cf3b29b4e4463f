"""The law `tensor` and the repulsion `log` in C (tensor.c)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.kernels import Library
from remodel_fenicsx.model import tensor_law, tensors
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.drivers import rotated_back
from remodel_fenicsx.model.energy import log_sum, whole_structure_tensor
from remodel_fenicsx.model.laws import Drive
from remodel_fenicsx.model.tensor_law import Target

Array = NDArray[np.float64]

NUMBERS = {"CLOSE": tensors.CLOSE_EIGENVALUES, "COMPRESSION": tensor_law.COMPRESSION}
"""What tensor.c takes from Python: the numbers that tune."""


class TensorKernels:
    """Functions in C on arrays of n points."""

    def __init__(self, comm: MPI.Intracomm):
        self.call = Library(comm, "tensor.c", "the law for the structure tensor", 2, NUMBERS)

    def target(self, drive: Drive) -> Target:
        """`laws.tensor_target`."""
        F, given = drive.deformation_gradient, drive.tensor
        n, turned_back = len(F), not drive.driver.material
        if turned_back and drive.frame.tensor is not rotated_back:
            turned_back, given = False, drive.frame.tensor(F, given)
        direction, switch = np.empty((n, 3, 3)), np.empty(n)
        self.call("target", n, F, given, turned_back, np.broadcast_to(drive.floor, n), direction, switch)
        return Target(direction, switch)

    def log_sum(self, F: Array, cells: Sequence[UnitCell], end_to_end_length: Any) -> Array:
        """`energy.log_sum`."""
        if np.iscomplexobj(F):
            return log_sum(F, cells, end_to_end_length)
        result = np.empty(F.shape[:-2])
        self.call("log_sum", result.size, F, np.broadcast_to(whole_structure_tensor(cells), F.shape), result)
        return result

    def log_derivatives(self, C: Array, A: Array, second: bool = True) -> tuple[Array, Array | None]:
        """`energy.log_derivatives`."""
        first, matrices = np.empty(C.shape), np.empty((len(C), 6, 6)) if second else None
        self.call("log_derivatives", len(C), C, A, first, matrices)
        return first, matrices
