"""The compiled twins of the law `tensor` and the repulsion `log`; what they leave open numpy solves (`tissue`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.fem import jit
from remodel_fenicsx.tissue import condensed, tensor_kernels
from remodel_fenicsx.tissue.cells import UnitCell
from remodel_fenicsx.tissue.chains import CHAINS
from remodel_fenicsx.tissue.condensed import CondensedPoints
from remodel_fenicsx.tissue.drivers import DRIVERS, rotated_back
from remodel_fenicsx.tissue.energy import MATRICES, Tissue
from remodel_fenicsx.tissue.laws import LAWS, Drive
from remodel_fenicsx.tissue.repulsion import REPULSIONS, Repulsion, whole_structure_tensor
from remodel_fenicsx.tissue.responses import StepOfCells
from remodel_fenicsx.tissue.tensor_law import Target

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

COMPILED_REPULSIONS = ("log", "length")  # in the order of the kernels, as the drivers in condensed.TENSORS
PARAMETERS = ("lame_lambda", "lame_mu", "network_modulus", "contour_length", "end_to_end_length")


@dataclass(frozen=True)
class CompiledSolution:
    """As `condensed.Solution`, in the global basis; `rest`: what numpy has solved, and at which points."""

    gradient: Array
    driving_tensor: Array
    structure: Array
    first_piola_kirchhoff: Array
    squared_lengths: Array
    converged: Flags
    rest: tuple[NDArray[np.intp], condensed.Solution] | None = None


class TensorKernels:
    """Compiled functions on arrays of n points.

    Parameters
    ----------
    comm
        Its ranks compile, or load, together.
    """

    def __init__(self, comm: MPI.Intracomm):
        declarations, source = tensor_kernels.DECLARATIONS, tensor_kernels.SOURCE
        module = jit.library(comm, declarations, source, "the law for the structure tensor", 5)
        self.call, self._ffi = module.lib, module.ffi

    def target(self, drive: Drive) -> Target:
        """`laws.tensor_target`."""
        F, tensors = np.ascontiguousarray(drive.deformation_gradient), np.ascontiguousarray(drive.tensor)
        n, turned_back = len(F), not drive.driver.material
        if turned_back and drive.frame.tensor is not rotated_back:
            turned_back, tensors = False, np.ascontiguousarray(drive.frame.tensor(F, tensors))
        floor = np.ascontiguousarray(np.broadcast_to(np.asarray(drive.floor, np.float64), (n,)))
        direction, share = np.empty((n, 3, 3)), np.empty(n)
        out = self.pointer(floor), self.pointer(direction), self.pointer(share)
        self.call.target(n, self.pointer(F), self.pointer(tensors), turned_back, *out)
        return Target(direction, share)

    def log_sum(self, F: Array, cells: Sequence[UnitCell], end_to_end_length: Any) -> Array:
        """`repulsion.log_sum`."""
        F, A, result = np.ascontiguousarray(F), np.ascontiguousarray(whole_structure_tensor(cells)), np.empty(len(F))
        self.call.log_sum(len(F), self.pointer(F), self.pointer(A), self.pointer(result))
        return result

    def log_derivatives(self, C: Array, A: Array, second: bool = True) -> tuple[Array, Array | None]:
        """`repulsion.log_derivatives`."""
        first, matrices = np.empty(C.shape), np.empty((len(C), 6, 6)) if second else None
        out = self._ffi.NULL if matrices is None else self.pointer(matrices)
        self.call.log_derivatives(len(C), self.pointer(C), self.pointer(A), self.pointer(first), out)
        return first, matrices

    def pointer(self, values: NDArray[Any]) -> Any:
        """To the numbers of an array."""
        kind = "uint8_t[]" if values.dtype == np.uint8 else "double[]"
        return self._ffi.from_buffer(kind, np.ascontiguousarray(values))

    def pointers(self, arrays: list[Array]) -> Any:
        """To several."""
        return self._ffi.new("double *[]", [self.pointer(array) for array in arrays])


def with_kernels(tissue: Tissue, comm: MPI.Intracomm) -> Tissue:
    """The tissue with its repulsion compiled, where it is `log`."""
    if tissue.chain is None or tissue.repulsion is not REPULSIONS["log"]:
        return tissue
    kernels = TensorKernels(comm)
    return replace(tissue, repulsion=Repulsion(kernels.log_sum, kernels.log_derivatives))


def points(kernels: TensorKernels | None, tissue: Tissue, step: StepOfCells) -> CondensedPoints:
    """Tissue and step of n points: compiled, where the kernels know all of its parts."""
    known = (
        step.law is LAWS["tensor"]
        and step.driver in (DRIVERS[name] for name in condensed.TENSORS)
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

    def _arguments(self) -> tuple[list[Any], list[Array]]:
        """Cells at the start, parameters, and what else a kernel takes; the arrays that must live as long."""
        step, tissue = self.step, self.tissue
        arrays = [np.ascontiguousarray(getattr(tissue, name), np.float64) for name in PARAMETERS]
        driver = next(i for i, name in enumerate(condensed.TENSORS) if step.driver is DRIVERS[name])
        repulsion = next(i for i, name in enumerate(COMPILED_REPULSIONS) if tissue.repulsion is REPULSIONS[name])
        old, rate = np.ascontiguousarray(step.structure), step.kappa * (step.time_new - step.time_old)
        pointers = self.kernels.pointer(old), self.kernels.pointers(arrays)
        return [*pointers, step.floor, step.rounding, rate, driver, repulsion], [*arrays, old]

    def solve(self, F: Array, start: Array, left_out: Flags | None = None) -> Any:
        """As `CondensedPoints.solve`."""
        if left_out is not None and left_out.any():
            return super().solve(F, start, left_out)
        n, pointer = len(F), self.kernels.pointer
        F, start = np.ascontiguousarray(F), np.ascontiguousarray(start)
        tensor, structure, stress = (np.empty((n, 3, 3)) for _ in range(3))
        squared, flags = np.empty(n), np.empty(n, np.uint8)
        arguments, _alive = self._arguments()
        out = (pointer(values) for values in (tensor, structure, stress, squared, flags))
        self.kernels.call.solve(n, pointer(F), pointer(start), *arguments, *out)
        found = CompiledSolution(F, tensor, structure, stress, squared, flags.astype(bool))
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
        n, pointer, result = len(found.gradient), self.kernels.pointer, np.empty((len(found.gradient), 3, 3, 3, 3))
        arguments, _alive = self._arguments()
        gradient, tensor = pointer(found.gradient), pointer(found.driving_tensor)
        self.kernels.call.tangent(n, gradient, tensor, *arguments, pointer(result))
        if found.rest is not None:
            lost, rest = found.rest
            result[lost] = self.at(lost).tangent(rest, held[lost])
        return result
