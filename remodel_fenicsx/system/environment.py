"""What this run computes with: versions of the package and of the libraries that decide its numbers."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import importlib.util
import os
import platform
import re
import shutil
import sys
import traceback
import types
from collections.abc import Mapping, Sequence
from pathlib import Path

from remodel_fenicsx._version import __version__
from remodel_fenicsx.errors import BAD_ENVIRONMENT, RemodelError
from remodel_fenicsx.system.files import read_regular, refusal_in_words
from remodel_fenicsx.system.interrupts import take_back_signals

OLDEST_DOLFINX = (0, 9)
KERNELS = "REMODEL_FENICSX_KERNELS"  # what computes at points: C, or numpy for a debugger
NEEDED = "basix dolfinx gmsh h5py mpi4py petsc4py pint rich ufl".split()


class UnusableEnvironment(RemodelError):  # noqa: N818
    """What a command needs is missing; the text says what."""

    exit_code = BAD_ENVIRONMENT

    def in_words(self) -> str:
        """With what to do."""
        return f"the environment is not usable: {self}; run through ./with-fenicsx"


def check_usable(reason: str | None) -> None:
    """Refuse to go on in an environment that is not usable for a reason, if there is one."""
    if reason is not None:
        raise UnusableEnvironment(reason)


def versions() -> dict[str, str]:
    """Names and versions of everything that the numbers depend on; of extensions their SHA-256."""
    import dolfinx
    import numpy
    from mpi4py import MPI
    from petsc4py import PETSc

    return {
        "remodel_fenicsx": __version__,
        "dolfinx": dolfinx.__version__,
        "ufl": importlib.metadata.version("fenics-ufl"),
        "PETSc": ".".join(map(str, PETSc.Sys.getVersion())),
        "gmsh": gmsh_version(),
        "numpy": numpy.__version__,
        "kernels": kernels(),
        "Python": platform.python_version(),
        "MPI": MPI.Get_library_version().split(",")[0].strip(),
        "BLAS": blas_library(),
        "system": platform.platform(),
    } | extensions()


def kernels() -> str:
    """What computes at the points: "C", or "numpy" where REMODEL_FENICSX_KERNELS says so."""
    name = os.environ.get(KERNELS, "C")
    if name not in ("C", "numpy"):
        raise RemodelError(f"{KERNELS} = {name!r}: allowed are 'C' and 'numpy'")
    return name


@functools.cache
def gmsh_version() -> str:
    """What `gmsh.__version__` is, read from its file: loading Gmsh takes 0.2 s, and many runs mesh nothing with it."""
    spec = importlib.util.find_spec("gmsh")
    head = Path(spec.origin).read_text(encoding="utf-8") if spec is not None and spec.origin else ""
    return re.findall(r'^GMSH_API_VERSION = "(.+)"$', head, re.MULTILINE)[0]  # as all of its versions have it


def reason_unusable() -> str | None:
    """Why this environment cannot run a scene, or None: dolfinx missing or too old, PETSc with complex numbers."""
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        return f"{', '.join(missing)} is missing"
    if not any(shutil.which(name) for name in (os.environ.get("CC", "cc").split()[0], "gcc", "clang")):
        return "there is no C compiler"
    try:
        take_back_signals()
        import dolfinx
        import numpy
        from mpi4py import MPI
        from petsc4py import PETSc
    except ImportError as error:
        return str(error)
    if (tasks := os.environ.get("SLURM_STEP_NUM_TASKS", "1")) != "1" and MPI.COMM_WORLD.size == 1:
        return (
            f"srun has started {tasks} processes that know nothing of each other: use mpirun -n {tasks} or srun "
            "--mpi=pmix (for runs of their own unset SLURM_STEP_NUM_TASKS)"
        )
    major, minor = (int(part) for part in dolfinx.__version__.split(".")[:2])
    if (major, minor) < OLDEST_DOLFINX:
        oldest = ".".join(map(str, OLDEST_DOLFINX))
        return f"dolfinx {dolfinx.__version__} is too old, {oldest} is the oldest that works"
    if numpy.issubdtype(PETSc.ScalarType, numpy.complexfloating):
        return "PETSc is built with complex numbers, real ones are needed (Debian: python3-dolfinx-real)"
    return None


@functools.cache
def blas_library() -> str:
    """Path of the BLAS that this process has loaded (Debian's links resolved), or `unknown`."""
    try:
        maps = Path("/proc/self/maps").read_text().splitlines()
    except OSError:
        return "unknown"
    names = {line.split()[-1] for line in maps}
    found = sorted(name for name in names if re.match(r"lib(open)?blas", name.rsplit("/", 1)[-1]))
    return ", ".join(found) or "unknown"


# ---------------------------------------------------------------- parts of one's own
# Python files that are run before a command looks at anything else.

EXTENSIONS = "REMODEL_FENICSX_EXTENSIONS"  # files, separated like those of PATH
LARGEST_EXTENSION = 10**7  # bytes
SUM = "sha256:"  # what stands before the sum of an extension where other names have a version
_loaded: dict[str, tuple[Path, str]] = {}  # of this process, by name: where it is, and its sum


class ExtensionError(RemodelError):
    """A file of parts cannot be run, or is missing; one line."""


def load_extensions(files: Sequence[str]) -> None:
    """Run the files of the variable and these, each of them once in a process."""
    for file in filter(None, [*os.environ.get(EXTENSIONS, "").split(os.pathsep), *files]):
        path = Path(file).resolve()
        if path.name not in _loaded:
            _loaded[path.name] = path, SUM + _run(path, file)
        elif _loaded[path.name][0] != path:
            raise ExtensionError(
                f"extension {file}: {_loaded[path.name][0]} has the same name; allowed are different ones"
            )


def _run(path: Path, file: str) -> str:
    """Run a file as a module of its own; the SHA-256 of what was run."""
    if len(path.name.split()) > 1 or os.pathsep in str(path):
        raise ExtensionError(f"extension {file}: allowed are names without spaces, in folders without {os.pathsep!r}")
    try:
        source = read_regular(path, LARGEST_EXTENSION)
    except OSError as error:
        raise ExtensionError(f"extension {refusal_in_words(error)}") from error
    module = types.ModuleType(f"remodel_fenicsx_extension_{path.stem}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # where pydantic looks for the names of annotations
    try:
        exec(compile(source, str(path), "exec", dont_inherit=True), module.__dict__)
    except (Exception, SystemExit) as error:
        words = getattr(error, "msg", error)
        raise ExtensionError(f"extension {file}{_line(error, path)}: {type(error).__name__}: {words}") from error
    return hashlib.sha256(source).hexdigest()


def _line(error: BaseException, path: Path) -> str:
    """The last line of the file that had a part in it."""
    if isinstance(error, SyntaxError):
        return f", line {error.lineno}" if error.filename == str(path) and error.lineno else ""
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if frame.filename == str(path)]
    return f", line {lines[-1]}" if lines else ""


def blamed(error: BaseException) -> str:
    """What went wrong in a part, and in which file and line; nothing of what no part had a share in."""
    for path, _ in _loaded.values():
        if line := _line(error, path):
            return f"extension {path}{line}: {type(error).__name__}: {error}"
    return ""


def extensions() -> dict[str, str]:
    """The sums of those that were run, by name."""
    return {name: found for name, (_, found) in _loaded.items()}


def extensions_for_children() -> dict[str, str]:
    """The variable for processes that this one starts."""
    return {EXTENSIONS: os.pathsep.join(str(path) for path, _ in _loaded.values())}


def check_extensions(versions: Mapping[str, str], place: Path) -> None:
    """Refuse to read a run without the extensions that it was begun with."""
    for name, version in versions.items():
        if version.startswith(SUM) and name not in _loaded:
            raise ExtensionError(f"{place}: was begun with the extension {name}; add --with and the place of this file")
