"""The C files of this folder: compiled like the forms (`fem.jit.library`), with the numbers that Python has."""

from __future__ import annotations

import functools
import logging
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from mpi4py import MPI

from remodel_fenicsx.fem import jit
from remodel_fenicsx.model.energy import BY_LOG, Repulsion, Tissue
from remodel_fenicsx.system import NOTICE, environment

log = logging.getLogger(__name__)

FOLDER = Path(__file__).parent
NO_NUMBERS: Mapping[str, float] = MappingProxyType({})


def source(name: str, numbers: Mapping[str, float] = NO_NUMBERS) -> str:
    """A C file with the files that it includes in it, after a #define for each number."""
    # One text with everything that decides the machine code: by it the library is found in the cache.

    def included(found: re.Match[str]) -> str:
        following = found.string.count("\n", 0, found.end()) + 1
        return f'{source(found[1])}#line {following} "{name}"\n'

    text = re.sub(r'^#include "(.+)"\n', included, (FOLDER / name).read_text(encoding="utf-8"), flags=re.MULTILINE)
    return "".join(f"#define {key} {value!r}\n" for key, value in numbers.items()) + f'#line 1 "{name}"\n{text}'


def declarations(text: str) -> list[str]:
    """Of the functions in C that are not static."""
    return re.findall(r"^(?!static)(\w+ \w+\([^)]*\))\n\{", text, flags=re.MULTILINE)


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

    def __init__(
        self,
        comm: MPI.Intracomm,
        name: str,
        what: str,
        seconds: int = 2,
        numbers: Mapping[str, float] = NO_NUMBERS,
        include: Path | None = None,
        libraries: tuple[str, ...] = (),
    ):
        text = source(name, numbers)
        called = "".join(f"{line};\n" for line in declarations(text))
        module = jit.library(comm, called, text, what, seconds, include, libraries)
        self._functions, self._ffi = module.lib, module.ffi

    def __call__(self, name: str, *arguments: Any) -> Any:
        """What a function returns. Arrays that it writes to are contiguous; None is a null pointer."""
        return getattr(self._functions, name)(*map(self._argument, arguments))

    def _argument(self, value: Any) -> Any:
        if isinstance(value, np.ndarray):
            if value.dtype in (np.bool_, np.uint8):
                return self._ffi.from_buffer("uint8_t[]", value)
            if value.dtype == np.int32:
                return self._ffi.from_buffer("int32_t[]", np.ascontiguousarray(value))
            return self._ffi.from_buffer("double[]", np.ascontiguousarray(value, np.float64))
        return self._ffi.NULL if value is None else value


def with_kernels(tissue: Tissue, comm: MPI.Intracomm) -> Tissue:
    """The tissue with its repulsion in C, where it is `log`."""
    if tissue.chain is None or tissue.repulsion != BY_LOG or in_numpy():
        return tissue
    from remodel_fenicsx.kernels.tensor import TensorKernels  # with the law `tensor`: most runs need neither

    kernels = TensorKernels(comm)
    return replace(tissue, repulsion=Repulsion(kernels.log_sum, kernels.log_derivatives))
