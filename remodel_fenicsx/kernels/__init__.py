"""Kernels in C for computations at every quadrature point.

`Library` compiles the C files like the forms, and calls their functions. Most functions in C
replace a function in Python. That function is the reference of the tests, and computes the points
that C leaves open. For a debugger it runs in place of C, with ``REMODEL_FENICSX_KERNELS=numpy`` in
the environment.

=================== ============================================================
in C                replaces
=================== ============================================================
principal           model.spectral.principal
positive_direction  model.spectral.positive_direction
drop_noise_shear    model.spectral.drop_noise_shear
squared_length      model.energy.squared_end_to_end_length
structure           model.cells.structure_tensor
log_sum             model.energy.log_sum
log_derivatives     model.energy.log_derivatives
target              model.laws.tensor_target
=================== ====================================================="""

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
from numpy.typing import ArrayLike

from remodel_fenicsx.fem import jit
from remodel_fenicsx.model import cells, energy, spectral, tensor_law, tensors
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.drivers import corotational_tensor
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.model.laws import Drive
from remodel_fenicsx.model.tensors import Array, Flags
from remodel_fenicsx.system import NOTICE, environment

log = logging.getLogger(__name__)


FOLDER = Path(__file__).parent
NOT_FINITE = 2  # flag of a point with NaN or infinity
# By numpy's type character; double for all others.
C_TYPES = {"?": "uint8_t", "B": "uint8_t", "i": "int32_t"}
NUMBERS = {"CLOSE": tensors.CLOSE_EIGENVALUES, "COMPRESSION": tensor_law.COMPRESSION}
"""Constants that tensor.c takes from Python."""


def source(name: str, numbers: Mapping[str, float]) -> str:
    """Return the text of a C file with its includes, after a #define for each number."""
    # The text holds everything that decides the machine code, because it names the library in the
    # cache.

    def included(match: re.Match[str]) -> str:
        following = match.string.count("\n", 0, match.end()) + 1
        return f'{source(match[1], {})}#line {following} "{name}"\n'

    text = re.sub(
        r'^#include "(.+)"\n',
        included,
        (FOLDER / name).read_text(encoding="utf-8"),
        flags=re.MULTILINE,
    )
    return (
        "".join(f"#define {key} {value!r}\n" for key, value in numbers.items())
        + f'#line 1 "{name}"\n{text}'
    )


def declarations(text: str) -> list[str]:
    """Return the declarations of a C text's non-static functions and enumerations."""
    return re.findall(
        r"^((?!static)\w+ \w+\([^)]*\)(?=\n\{)|enum \{[^}]*\}(?=;))", text, flags=re.MULTILINE
    )


def uses_numpy() -> bool:
    """Return whether numpy's functions replace those in C, and log that once."""
    if environment.kernels() == "numpy":
        _log_numpy_once()
        return True
    return False


@functools.cache
def _log_numpy_once() -> None:
    if MPI.COMM_WORLD.rank == 0:
        log.log(
            NOTICE, "%s=numpy: using the numpy kernels (slower; for debugging)", environment.KERNELS
        )


class Library:
    """Functions of a C file that can be called with arrays."""

    def __init__(self, comm: MPI.Intracomm, name: str, what: str, numbers: Mapping[str, float]):
        text = source(name, numbers)
        called = "".join(f"{line};\n" for line in declarations(text))
        module = jit.library(comm, called, text, what)
        self._functions, self._ffi = module.lib, module.ffi

    def __call__(self, name: str, *arguments: Any) -> Any:
        """Call a function. Arrays that it writes to must be contiguous; None is a null pointer."""
        passed = [self._ffi.NULL if value is None else value for value in arguments]
        for number, value in enumerate(arguments):
            if isinstance(value, np.ndarray):
                kind = C_TYPES.get(value.dtype.char, "double")
                values = np.ascontiguousarray(value, np.float64 if kind == "double" else None)
                passed[number] = self._ffi.from_buffer(f"{kind}[]", values)
        return getattr(self._functions, name)(*passed)


def with_kernels(tissue: Tissue, comm: MPI.Intracomm) -> Tissue:
    """Return the tissue with its repulsion in C if that is `log`. Collective."""
    if tissue.chain is None or tissue.repulsion.sum is not energy.log_sum or uses_numpy():
        return tissue
    kernels = TensorKernels(comm)
    return replace(
        tissue,
        repulsion=replace(
            tissue.repulsion, sum=kernels.log_sum, derivatives=kernels.log_derivatives
        ),
    )


# ---------------------------------------------------------------- pointwise functions


class PointKernels:
    """Functions on arrays of n points in numpy, the reference for those in C."""

    principal: spectral.Pairing = staticmethod(spectral.principal)
    positive_direction: Callable[..., tuple[Array, Flags]] = staticmethod(
        spectral.positive_direction
    )
    drop_noise_shear: Callable[..., Array] = staticmethod(spectral.drop_noise_shear)
    structure_tensor: Callable[..., Array] = staticmethod(cells.structure_tensor)

    def squared_length(self, F: Array, cell: UnitCell) -> Array:
        """Return `energy.squared_end_to_end_length` of one whole cell, (n,)."""
        return energy.squared_end_to_end_length(F, [cell])


class CompiledPointKernels(PointKernels):
    """Functions of `PointKernels` in C; numpy computes the points that C leaves open."""

    def __init__(self, comm: MPI.Intracomm):
        self._call = Library(comm, "spectral.c", "the pass", {})

    def principal(
        self,
        tensors: ArrayLike,
        previous: ArrayLike,
        tolerance: float = spectral.AGREEMENT,
        threshold: ArrayLike = 0.0,
    ) -> tuple[Array, Array]:
        """Compute by Jacobi's method; numpy computes the points that this leaves open."""
        tensors, previous = np.asarray(tensors), np.asarray(previous)
        n, limit = len(tensors), np.broadcast_to(threshold, len(tensors))
        values, axes = np.empty((n, 3)), np.empty((n, 3, 3))
        left_open = np.empty(n, np.uint8)
        given = tensors, previous, tolerance, limit, spectral.MIN_OVERLAP
        if self._call("principal", n, *given, values, axes, left_open):
            # Numpy raises an error that names the first such point.
            if np.any(left_open == NOT_FINITE):
                return super().principal(tensors, previous, tolerance, threshold)
            at = np.flatnonzero(left_open)
            values[at], axes[at] = super().principal(
                tensors[at], previous[at], tolerance, limit[at]
            )
        return values, axes

    def positive_direction(
        self, values: ArrayLike, threshold: ArrayLike = 0.0
    ) -> tuple[Array, Flags]:
        values = np.asarray(values)
        n, limit = len(values), np.broadcast_to(threshold, len(values))
        direction, active = np.empty((n, 3)), np.empty(n, np.bool_)
        if self._call("positive_direction", n, values, limit, spectral.ROUNDING, direction, active):
            return super().positive_direction(values, threshold)  # numpy raises the error
        return direction, active

    def drop_noise_shear(self, tensors: Array, axes: Array, noise: ArrayLike) -> Array:
        n, steady = len(tensors), np.empty(tensors.shape)
        self._call("drop_noise_shear", n, tensors, axes, np.broadcast_to(noise, n), steady)
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
    """Return the point functions in C, or in numpy on request. Collective."""
    return PointKernels() if uses_numpy() else CompiledPointKernels(comm)


# ---------------------------------------------------------------- the structure tensor


class TensorKernels:
    """Law `tensor` and repulsion `log` in C (tensor.c), on arrays of n points."""

    def __init__(self, comm: MPI.Intracomm):
        self.call = Library(comm, "tensor.c", "the law for the structure tensor", NUMBERS)

    def target(self, drive: Drive) -> tensor_law.Target:
        """Compute the target of `laws.tensor_target`."""
        F, given = drive.deformation_gradient, drive.tensor
        n, turned_back = len(F), not drive.driver.material
        if turned_back and drive.frame.tensor is not corotational_tensor:
            turned_back, given = False, drive.frame.tensor(F, given)
        direction, switch = np.empty((n, 3, 3)), np.empty(n)
        self.call(
            "target", n, F, given, turned_back, np.broadcast_to(drive.floor, n), direction, switch
        )
        return tensor_law.Target(direction, switch)

    def log_sum(self, F: Array, cells: Sequence[UnitCell], end_to_end_length: Any) -> Array:
        """Compute the sum of `energy.log_sum`."""
        if np.iscomplexobj(F):
            return energy.log_sum(F, cells, end_to_end_length)
        result = np.empty(F.shape[:-2])
        self.call(
            "log_sum",
            result.size,
            F,
            np.broadcast_to(energy.total_structure_tensor(cells), F.shape),
            result,
        )
        return result

    def log_derivatives(
        self, C: Array, A: Array, second: bool = True
    ) -> tuple[Array, Array | None]:
        """Compute the derivatives of `energy.log_derivatives`."""
        first, matrices = np.empty(C.shape), np.empty((len(C), 6, 6)) if second else None
        self.call("log_derivatives", len(C), C, A, first, matrices)
        return first, matrices
