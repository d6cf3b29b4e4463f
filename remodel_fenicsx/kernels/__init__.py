"""What is computed at every quadrature point, in C: compiled like the forms, held against Python by tests.

`Library` compiles the C files and calls them; there is a method for each function. Most stand for
a function of the package: it is the reference, decides where C leaves a point open, and runs in its place with
``REMODEL_FENICSX_KERNELS=numpy`` in the environment, for a debugger.

=================== =====================================================================================
in C                stands for
=================== =====================================================================================
principal           model.spectral.principal
positive_direction  model.spectral.positive_direction
without_noise       model.spectral.without_noise
squared_length      model.energy.squared_end_to_end_length
structure           model.cells.structure_tensor
log_sum             model.energy.log_sum
log_derivatives     model.energy.log_derivatives
target              model.laws.tensor_target
=================== =====================================================================================
"""

from __future__ import annotations

import functools
import logging
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import ArrayLike, NDArray

from remodel_fenicsx.fem import jit
from remodel_fenicsx.model import cells, energy, spectral, tensor_law, tensors
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.drivers import rotated_back
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.model.laws import Drive
from remodel_fenicsx.system import NOTICE, environment

log = logging.getLogger(__name__)

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

FOLDER = Path(__file__).parent
NOT_FINITE = 2  # mark of a point with NaN or infinity
C_TYPES = {"?": "uint8_t", "B": "uint8_t", "i": "int32_t"}  # of numpy's characters; all others are double
NUMBERS = {"CLOSE": tensors.CLOSE_EIGENVALUES, "COMPRESSION": tensor_law.COMPRESSION}
"""What tensor.c takes from Python: the numbers that tune."""


def source(name: str, numbers: Mapping[str, float]) -> str:
    """A C file with the files that it includes in it, after a #define for each number."""
    # One text with everything that decides the machine code: by it the library is found in the cache.

    def included(found: re.Match[str]) -> str:
        following = found.string.count("\n", 0, found.end()) + 1
        return f'{source(found[1], {})}#line {following} "{name}"\n'

    text = re.sub(r'^#include "(.+)"\n', included, (FOLDER / name).read_text(encoding="utf-8"), flags=re.MULTILINE)
    return "".join(f"#define {key} {value!r}\n" for key, value in numbers.items()) + f'#line 1 "{name}"\n{text}'


def declarations(text: str) -> list[str]:
    """Of the functions in C that are not static, and of what it numbers."""
    return re.findall(r"^((?!static)\w+ \w+\([^)]*\)(?=\n\{)|enum \{[^}]*\}(?=;))", text, flags=re.MULTILINE)


def in_numpy() -> bool:
    """Whether Python's functions run in place of C's; says so, once."""
    if environment.kernels() == "numpy":
        _say_so()
        return True
    return False


@functools.cache
def _say_so() -> None:
    if MPI.COMM_WORLD.rank == 0:
        log.log(NOTICE, "%s=numpy: numpy computes what C does otherwise, for a debugger; slower", environment.KERNELS)


class Library:
    """The functions of a C file, which can be called with arrays."""

    def __init__(self, comm: MPI.Intracomm, name: str, what: str, numbers: Mapping[str, float]):
        text = source(name, numbers)
        called = "".join(f"{line};\n" for line in declarations(text))
        module = jit.library(comm, called, text, what)
        self._functions, self._ffi = module.lib, module.ffi

    def __call__(self, name: str, *arguments: Any) -> Any:
        """What a function returns. Arrays that it writes to are contiguous; None is a null pointer."""
        passed = [self._ffi.NULL if value is None else value for value in arguments]
        for number, value in enumerate(arguments):
            if isinstance(value, np.ndarray):
                kind = C_TYPES.get(value.dtype.char, "double")
                values = np.ascontiguousarray(value, np.float64 if kind == "double" else None)
                passed[number] = self._ffi.from_buffer(f"{kind}[]", values)
        return getattr(self._functions, name)(*passed)


def with_kernels(tissue: Tissue, comm: MPI.Intracomm) -> Tissue:
    """The tissue with its repulsion in C, where it is `log`."""
    if tissue.chain is None or tissue.repulsion.sum is not energy.log_sum or in_numpy():
        return tissue
    kernels = TensorKernels(comm)
    return replace(
        tissue, repulsion=replace(tissue.repulsion, sum=kernels.log_sum, derivatives=kernels.log_derivatives)
    )


# ---------------------------------------------------------------- what a pass and its limits compute at every point


class PointKernels:
    """Functions on arrays of n points, in numpy: what they are in C stands for these."""

    principal: spectral.Pairing = staticmethod(spectral.principal)
    positive_direction: Callable[..., tuple[Array, Flags]] = staticmethod(spectral.positive_direction)
    without_noise: Callable[..., Array] = staticmethod(spectral.without_noise)
    structure_tensor: Callable[..., Array] = staticmethod(cells.structure_tensor)

    def squared_length(self, F: Array, cell: UnitCell) -> Array:
        """`energy.squared_end_to_end_length` of one whole cell."""
        return np.asarray(energy.squared_end_to_end_length(F, [cell]))


class CompiledPointKernels(PointKernels):
    """The same in C. `PointKernels` says what goes in and comes out, and does what C leaves open."""

    def __init__(self, comm: MPI.Intracomm):
        self._call = Library(comm, "spectral.c", "the pass", {})

    def principal(
        self, tensors: ArrayLike, previous: ArrayLike, tolerance: float = spectral.AGREEMENT, threshold: ArrayLike = 0.0
    ) -> tuple[Array, Array]:
        """By Jacobi's method where the tensor decides."""
        tensors, previous = np.asarray(tensors), np.asarray(previous)
        n, limit = len(tensors), np.broadcast_to(threshold, len(tensors))
        values, axes, left_open = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n, np.uint8)
        given = tensors, previous, tolerance, limit, spectral.DECISIVE
        if self._call("principal", n, *given, values, axes, left_open):
            if np.any(left_open == NOT_FINITE):  # for the words that name the first one
                return super().principal(tensors, previous, tolerance, threshold)
            at = np.flatnonzero(left_open)
            values[at], axes[at] = super().principal(tensors[at], previous[at], tolerance, limit[at])
        return values, axes

    def positive_direction(self, values: ArrayLike, threshold: ArrayLike = 0.0) -> tuple[Array, Flags]:
        values = np.asarray(values)
        n, limit = len(values), np.broadcast_to(threshold, len(values))
        direction, active = np.empty((n, 3)), np.empty(n, np.bool_)
        if self._call("positive_direction", n, values, limit, spectral.ROUNDING, direction, active):
            return super().positive_direction(values, threshold)  # for the words that name the first one
        return direction, active

    def without_noise(self, tensors: Array, axes: Array, noise: ArrayLike) -> Array:
        n, steady = len(tensors), np.empty(tensors.shape)
        self._call("without_noise", n, tensors, axes, np.broadcast_to(noise, n), steady)
        return steady

    def structure_tensor(self, dimensions: Array, axes: Array) -> Array:
        tensor = np.empty(axes.shape)
        self._call("structure", axes.size // 9, dimensions, axes, tensor)
        return tensor

    def squared_length(self, F: Array, cell: UnitCell) -> Array:
        squared = np.empty(len(F))
        self._call("squared_length", len(F), F, cell.dimensions, cell.axes, squared)
        return squared


def point_kernels(comm: MPI.Intracomm) -> PointKernels:
    """In C, or in numpy where that is asked for. Collective."""
    return PointKernels() if in_numpy() else CompiledPointKernels(comm)


# ---------------------------------------------------------------- the structure tensor


class TensorKernels:
    """The law `tensor` and the repulsion `log` in C (tensor.c), on arrays of n points."""

    def __init__(self, comm: MPI.Intracomm):
        self.call = Library(comm, "tensor.c", "the law for the structure tensor", NUMBERS)

    def target(self, drive: Drive) -> tensor_law.Target:
        """`laws.tensor_target`."""
        F, given = drive.deformation_gradient, drive.tensor
        n, turned_back = len(F), not drive.driver.material
        if turned_back and drive.frame.tensor is not rotated_back:
            turned_back, given = False, drive.frame.tensor(F, given)
        direction, switch = np.empty((n, 3, 3)), np.empty(n)
        self.call("target", n, F, given, turned_back, np.broadcast_to(drive.floor, n), direction, switch)
        return tensor_law.Target(direction, switch)

    def log_sum(self, F: Array, cells: Sequence[UnitCell], end_to_end_length: Any) -> Array:
        """`energy.log_sum`."""
        if np.iscomplexobj(F):
            return energy.log_sum(F, cells, end_to_end_length)
        result = np.empty(F.shape[:-2])
        self.call("log_sum", result.size, F, np.broadcast_to(energy.whole_structure_tensor(cells), F.shape), result)
        return result

    def log_derivatives(self, C: Array, A: Array, second: bool = True) -> tuple[Array, Array | None]:
        """`energy.log_derivatives`."""
        first, matrices = np.empty(C.shape), np.empty((len(C), 6, 6)) if second else None
        self.call("log_derivatives", len(C), C, A, first, matrices)
        return first, matrices
