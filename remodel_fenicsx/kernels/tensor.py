"""The law `tensor` and the repulsion `log` in C (tensor.c); what C leaves open numpy solves (`tissue`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.kernels.library import Library, in_numpy
from remodel_fenicsx.model import logarithm, tensor_law
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.chains import CHAINS
from remodel_fenicsx.model.drivers import DRIVERS, rotated_back
from remodel_fenicsx.model.energy import MATRICES, REPULSIONS, Tissue, whole_structure_tensor
from remodel_fenicsx.model.implicit import condensed
from remodel_fenicsx.model.implicit.condensed import CondensedPoints
from remodel_fenicsx.model.implicit.responses import StepOfCells
from remodel_fenicsx.model.laws import LAWS, Drive
from remodel_fenicsx.model.tensor_law import Target

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

COMPILED_REPULSIONS = ("log", "length")
PARAMETERS = ("lame_lambda", "lame_mu", "network_modulus", "contour_length", "end_to_end_length")
NUMBERS = {
    **{
        name.upper(): i
        for names in (condensed.DRIVING_TENSORS, COMPILED_REPULSIONS, PARAMETERS)
        for i, name in enumerate(names)
    },
    "PARAMETERS": len(PARAMETERS),
    "ITERATIONS": condensed.LOCAL_ITERATIONS,
    "HALVINGS": condensed.LOCAL_HALVINGS,
    "TOLERANCE": condensed.TOLERANCE,
    "CLOSE": logarithm.CLOSE_EIGENVALUES,
    "COMPRESSION": tensor_law.COMPRESSION,
}
"""What tensor.c takes from Python: the numbers of drivers, repulsions and parameters, and those that tune."""


@dataclass(frozen=True)
class CompiledSolution:
    """As `condensed.Solution`, in the global basis; `rest`: what numpy has solved, and at which points."""

    gradient: Array
    driving_tensor: Array
    structure: Array
    first_piola_kirchhoff: Array
    squared_lengths: Array
    converged: Flags
    rest: tuple[NDArray[np.intp], condensed.LocalSolution] | None = None


class TensorKernels:
    """Functions in C on arrays of n points.

    Parameters
    ----------
    comm
        Its ranks compile, or load, together.
    """

    def __init__(self, comm: MPI.Intracomm):
        self.call = Library(comm, "tensor.c", "the law for the structure tensor", 5, NUMBERS)

    def target(self, drive: Drive) -> Target:
        """`laws.tensor_target`."""
        F, tensors = drive.deformation_gradient, drive.tensor
        n, turned_back = len(F), not drive.driver.material
        if turned_back and drive.frame.tensor is not rotated_back:
            turned_back, tensors = False, drive.frame.tensor(F, tensors)
        direction, share = np.empty((n, 3, 3)), np.empty(n)
        self.call("target", n, F, tensors, turned_back, np.broadcast_to(drive.floor, n), direction, share)
        return Target(direction, share)

    def log_sum(self, F: Array, cells: Sequence[UnitCell], end_to_end_length: Any) -> Array:
        """`energy.log_sum`."""
        result = np.empty(len(F))
        self.call("log_sum", len(F), F, whole_structure_tensor(cells), result)
        return result

    def log_derivatives(self, C: Array, A: Array, second: bool = True) -> tuple[Array, Array | None]:
        """`energy.log_derivatives`."""
        first, matrices = np.empty(C.shape), np.empty((len(C), 6, 6)) if second else None
        self.call("log_derivatives", len(C), C, A, first, matrices)
        return first, matrices


def tensor_kernels(comm: MPI.Intracomm) -> TensorKernels | None:
    """None where numpy is asked for. Collective."""
    return None if in_numpy() else TensorKernels(comm)


def condensed_points(kernels: TensorKernels | None, tissue: Tissue, step: StepOfCells) -> CondensedPoints:
    """Tissue and step of n points: in C, where that knows all of its parts."""
    known = (
        step.law is LAWS["tensor"]
        and step.driver in (DRIVERS[name] for name in condensed.DRIVING_TENSORS)
        and not step.is_spatial
        and tissue.chain is CHAINS["wormlike"]
        and tissue.matrix is MATRICES["neo-hookean"]
        and tissue.repulsion in (REPULSIONS[name] for name in COMPILED_REPULSIONS)
    )
    return CompiledPoints(tissue, step, kernels) if kernels is not None and known else CondensedPoints(tissue, step)


@dataclass(frozen=True)
class CompiledPoints(CondensedPoints):
    """As `CondensedPoints`, for the law `tensor`. Points that the kernel does not solve are solved by numpy."""

    kernels: TensorKernels

    @property
    def _given(self) -> tuple[Any, ...]:
        """Cells at the start, parameters, and what else C takes of tissue and step."""
        step, tissue = self.step, self.tissue
        driver = next(i for i, name in enumerate(condensed.DRIVING_TENSORS) if step.driver is DRIVERS[name])
        repulsion = next(i for i, name in enumerate(COMPILED_REPULSIONS) if tissue.repulsion is REPULSIONS[name])
        parameters = np.stack([getattr(tissue, name) for name in PARAMETERS])
        rate = step.kappa * (step.time_new - step.time_old)
        return step.structure, parameters, step.floor, step.rounding, rate, driver, repulsion

    def solve(self, F: Array, start: Array, left_out: Flags | None = None) -> Any:
        """As `CondensedPoints.solve`."""
        if left_out is not None and left_out.any():
            return super().solve(F, start, left_out)
        n = len(F)
        tensor, structure, stress = np.empty((3, n, 3, 3))
        squared, converged = np.empty(n), np.empty(n, np.bool_)
        self.kernels.call("solve", n, F, start, *self._given, tensor, structure, stress, squared, converged)
        found = CompiledSolution(F, tensor, structure, stress, squared, converged)
        lost = np.flatnonzero(~found.converged)
        return self._completed(found, lost, start[lost]) if lost.size else found

    def _completed(self, found: CompiledSolution, lost: NDArray[np.intp], start: Array) -> CompiledSolution:
        rest = self.at(lost).solve(found.gradient[lost], start)
        for name in ("driving_tensor", "structure", "first_piola_kirchhoff", "squared_lengths", "converged"):
            getattr(found, name)[lost] = getattr(rest, name)
        return replace(found, rest=(lost, rest))

    def tangent(self, found: Any, held: Flags) -> Array:
        """As `CondensedPoints.tangent`."""
        if not isinstance(found, CompiledSolution):
            return super().tangent(found, held)
        n, result = len(found.gradient), np.empty((len(found.gradient), 3, 3, 3, 3))
        self.kernels.call("tangent", n, found.gradient, found.driving_tensor, *self._given, result)
        if found.rest is not None:
            lost, rest = found.rest
            result[lost] = self.at(lost).tangent(rest, held[lost])
        return result
