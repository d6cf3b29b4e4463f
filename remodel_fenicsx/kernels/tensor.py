"""Implicit steps, the law `tensor` and the repulsion `log` in C (tensor.c); numpy solves what C leaves open."""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.kernels import Library, in_numpy
from remodel_fenicsx.model import local_problem, spectral, tensor_law, tensors
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.drivers import rotated_back
from remodel_fenicsx.model.energy import PARAMETERS, Tissue, log_sum, whole_structure_tensor
from remodel_fenicsx.model.local_problem import LocalProblem, LocalSolution, Slopes, StepOfCells, at, put
from remodel_fenicsx.model.laws import COMPLEX_STEP, Drive
from remodel_fenicsx.model.tensor_law import Target

log = logging.getLogger(__name__)

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

NUMBERS = {
    **{name.upper(): i for i, name in enumerate(PARAMETERS)},
    "PARAMETERS": len(PARAMETERS),
    "ITERATIONS": local_problem.LOCAL_ITERATIONS,
    "HALVINGS": local_problem.LOCAL_HALVINGS,
    "TOLERANCE": local_problem.TOLERANCE,
    "AGREE": local_problem.AGREE,
    "ROUNDING": spectral.ROUNDING,
    "CLOSE": tensors.CLOSE_EIGENVALUES,
    "COMPRESSION": tensor_law.COMPRESSION,
}
"""What tensor.c takes from Python: the places of parameters, and the numbers that tune."""


class TensorKernels:
    """Functions in C on arrays of n points."""

    def __init__(self, comm: MPI.Intracomm):
        self.call = Library(comm, "tensor.c", "the law for the structure tensor and implicit steps", 6, NUMBERS)

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
        self.call("log_sum", result.size, F, whole_structure_tensor(cells), result)
        return result

    def log_derivatives(self, C: Array, A: Array, second: bool = True) -> tuple[Array, Array | None]:
        """`energy.log_derivatives`."""
        first, matrices = np.empty(C.shape), np.empty((len(C), 6, 6)) if second else None
        self.call("log_derivatives", len(C), C, A, first, matrices)
        return first, matrices


def tensor_kernels(comm: MPI.Intracomm) -> TensorKernels | None:
    """None where numpy is asked for. Collective."""
    return None if in_numpy() else TensorKernels(comm)


def problem_of(kernels: TensorKernels | None, tissue: Tissue, step: StepOfCells) -> LocalProblem:
    """Of n points: in C, where that knows all of its parts."""
    if kernels is None:
        return LocalProblem(tissue, step)
    parts: dict[str, Any] = {name: getattr(tissue, name) for name in ("chain", "matrix", "repulsion")}
    parts |= {"law": step.law, "driver": step.drive.driver}
    unknown = [name for name, part in parts.items() if kernels.call.number(getattr(part, "compiled", "")) is None]
    unknown += ["pairing"] * (step.law.dimensions is not None and step.drive.pairing is not spectral.principal)
    unknown += ["turnover"] * (step.turnover is not None)
    if not unknown:
        return CompiledProblem(tissue, step, kernels)
    _say_of_numpy(", ".join(unknown))
    return LocalProblem(tissue, step)


@functools.cache
def _say_of_numpy(parts: str) -> None:
    log.info("numpy finds the cells of an implicit step, slower: C does not have this %s", parts)


@dataclass(frozen=True)
class CompiledProblem(LocalProblem):
    """As `LocalProblem`. Points that the kernel does not solve are solved by numpy."""

    kernels: TensorKernels

    @functools.cached_property
    def _given(self) -> Array:
        """What C's `given` has of each point, (n, numbers)."""
        drive, cells = self.step.drive, self.step.cells
        n = len(cells.dimensions)
        tuning = (drive.floor, drive.noise, drive.rounding, self.step.kappa_dt)
        numbers = [getattr(self.tissue, name) for name in PARAMETERS] + [np.broadcast_to(some, n) for some in tuning]
        others = cells.dimensions, cells.axes, self.step.structure, *self._by_target(n)
        rows = (some.reshape(n, math.prod(some.shape[1:])) for some in others)  # a rank may have no points
        return np.concatenate([np.stack(numbers, axis=1), *rows], axis=1)

    def _by_target(self, n: int) -> tuple[Array, Array]:
        """Of a law by rank, whose lengths are an affine function of the target: those at zero, and the slope."""
        law, step = self.step.law.dimensions, self.step
        if law is None:
            return np.zeros((n, 3)), np.zeros(n)
        given = step.cells.dimensions, step.drive.initial_dimensions, np.full((n, 3), 1j * COMPLEX_STEP)
        lengths: Any = law(*given, step.drive.kappas, step.time_old, step.time_new)
        return lengths.real, lengths.imag[:, 0] / COMPLEX_STEP

    def _call(self, name: str, F: Array, tensor: Array, *results: Array | Flags) -> None:
        """A function in C with F, D, what it takes of tissue and step, and the parts of the model."""
        step, number = self.step, self.kernels.call.number
        frame = "TO_SPACE" if step.is_spatial else "PULLED_BACK" if step.carries_axes else "STAYS"
        parts = step.law.compiled, step.drive.driver.compiled, self.tissue.repulsion.compiled, frame
        self.kernels.call(name, len(F), F, tensor, self._given, *map(number, parts), *results)

    def solve(self, F: Array, guess: Array) -> LocalSolution:
        """As `LocalProblem.solve`."""
        tensor, structure, stress = np.empty((3, len(F), 3, 3))
        squared, (converged, left_open) = np.empty(len(F)), np.empty((2, len(F)), np.bool_)
        self._call("solve", F, guess, tensor, structure, stress, squared, converged, left_open)
        found = LocalSolution(F, tensor, structure, stress, squared, converged)
        if self.step.law.dimensions is None:  # numpy knows one more way there
            left_open |= ~converged
        lost = np.flatnonzero(left_open)
        if lost.size:
            put(found, lost, self.at(lost).solve(F[lost], guess[lost]))
        return found

    def tangent(self, found: LocalSolution) -> Slopes:
        """As `LocalProblem.tangent`."""
        n = len(found.gradient)
        result, left_open = Slopes(np.empty((n, 3, 3, 3, 3)), np.empty((n, 6, 9))), np.empty(n, np.bool_)
        self._call("tangent", found.gradient, found.driving_tensor, *result, left_open)
        lost = np.flatnonzero(left_open | ~found.converged)
        if lost.size:
            put(result, lost, self.at(lost).tangent(at(found, lost)))
        return result
