"""Software environment: versions that determine the results, requirements, and extensions."""

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
from remodel_fenicsx.system.interrupts import restore_signal_handlers

OLDEST_DOLFINX = (0, 9)
KERNELS = "REMODEL_FENICSX_KERNELS"  # kernels at the points: C, or numpy for a debugger
NEEDED = "basix dolfinx gmsh h5py mpi4py petsc4py pint rich ufl".split()


class UnusableEnvironment(RemodelError):  # noqa: N818
    """Environment without something that a command needs; the text names it."""

    exit_code = BAD_ENVIRONMENT

    def in_words(self) -> str:
        """Return the reason and the remedy, on one line."""
        return f"the environment is not usable: {self}; run through ./with-fenicsx"


def check_usable(reason: str | None) -> None:
    """Raise UnusableEnvironment if there is a reason."""
    if reason is not None:
        raise UnusableEnvironment(reason)


def versions() -> dict[str, str]:
    """Return names and versions of everything that determines results; SHA-256 of extensions."""
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
    } | extension_hashes()


def software(extensions: str) -> dict[str, str]:
    """Return hashes of sources and extensions and versions of libraries, without loading them."""
    versions = {each.name: each.version for each in importlib.metadata.distributions()}
    sources = sorted(Path(__file__).parents[1].rglob("*.[pcht]*"))
    files = {file: [Path(file)] for file in extensions.split(os.pathsep) if file}
    files["remodel_fenicsx"] = [path for path in sources if path.suffix != ".pyc"]
    hashes = {}
    for name, paths in files.items():
        content = [path.read_bytes() for path in paths if path.is_file()]
        hashes[name] = hashlib.sha256(b"".join(content)).hexdigest()
    return versions | hashes | {EXTENSIONS: extensions, "kernels": kernels()}


def kernels() -> str:
    """Return the kernels at the points: "C", or "numpy" if REMODEL_FENICSX_KERNELS sets it."""
    name = os.environ.get(KERNELS, "C")
    if name not in ("C", "numpy"):
        raise RemodelError(f"{KERNELS} = {name!r}: must be 'C' or 'numpy'")
    return name


@functools.cache
def gmsh_version() -> str:
    """Return Gmsh's version from its file: loading Gmsh takes 0.2 s, and few runs need it."""
    spec = importlib.util.find_spec("gmsh")
    head = Path(spec.origin).read_text(encoding="utf-8") if spec is not None and spec.origin else ""
    # All versions of Gmsh have this line.
    return re.findall(r'^GMSH_API_VERSION = "(.+)"$', head, re.MULTILINE)[0]


def environment_problem() -> str | None:
    """Return why this environment cannot run a scene, or None."""
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        return f"{', '.join(missing)} is missing"
    if not any(
        shutil.which(name) for name in (os.environ.get("CC", "cc").split()[0], "gcc", "clang")
    ):
        return "there is no C compiler"
    try:
        restore_signal_handlers()
        import dolfinx
        import numpy
        from mpi4py import MPI
        from petsc4py import PETSc
    except ImportError as error:
        return str(error)
    if (tasks := os.environ.get("SLURM_STEP_NUM_TASKS", "1")) != "1" and MPI.COMM_WORLD.size == 1:
        return (
            f"srun has started {tasks} processes without a common MPI: use mpirun -n {tasks} or "
            "srun --mpi=pmix (for independent runs unset SLURM_STEP_NUM_TASKS)"
        )
    major, minor = (int(part) for part in dolfinx.__version__.split(".")[:2])
    if (major, minor) < OLDEST_DOLFINX:
        oldest = ".".join(map(str, OLDEST_DOLFINX))
        return f"dolfinx {dolfinx.__version__} is too old; the oldest supported version is {oldest}"
    if numpy.issubdtype(PETSc.ScalarType, numpy.complexfloating):
        return "PETSc is built with complex numbers; must be real (Debian: python3-dolfinx-real)"
    return None


@functools.cache
def blas_library() -> str:
    """Return the path of the loaded BLAS (Debian's links resolved), or "unknown"."""
    try:
        maps = Path("/proc/self/maps").read_text().splitlines()
    except OSError:
        return "unknown"
    names = {line.split()[-1] for line in maps}
    libraries = sorted(
        name for name in names if re.match(r"lib(open)?blas", name.rsplit("/", 1)[-1])
    )
    return ", ".join(libraries) or "unknown"


# ---------------------------------------------------------------- extensions
# User-supplied Python files that run before a command reads its scene.

EXTENSIONS = "REMODEL_FENICSX_EXTENSIONS"  # files, separated as in PATH
LARGEST_EXTENSION = 10**7  # bytes
SUM = "sha256:"  # prefix of an extension's hash, where other names have a version
_loaded: dict[str, tuple[Path, str]] = {}  # extensions of this process by name: path and hash


class ExtensionError(RemodelError):
    """Extension that fails or is missing; one line."""


def load_extensions(files: Sequence[str]) -> None:
    """Run the files of the environment variable and these files, once per process."""
    for file in filter(None, [*os.environ.get(EXTENSIONS, "").split(os.pathsep), *files]):
        path = Path(file).resolve()
        if path.name not in _loaded:
            _loaded[path.name] = path, SUM + _run(path, file)
        elif _loaded[path.name][0] != path:
            raise ExtensionError(
                f"extension {file}: {_loaded[path.name][0]} has the same name; names must differ"
            )


def _run(path: Path, file: str) -> str:
    """Run a file as a module of its own; return the SHA-256 of its source."""
    if len(path.name.split()) > 1 or os.pathsep in str(path):
        raise ExtensionError(
            f"extension {file}: must have a name without spaces, in a folder without {os.pathsep!r}"
        )
    try:
        source = read_regular(path, LARGEST_EXTENSION)
    except OSError as error:
        raise ExtensionError(f"extension {refusal_in_words(error)}") from error
    module = types.ModuleType(f"remodel_fenicsx_extension_{path.stem}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # pydantic resolves the names of annotations there.
    try:
        exec(compile(source, str(path), "exec", dont_inherit=True), module.__dict__)
    except (Exception, SystemExit) as error:
        words = getattr(error, "msg", error)
        raise ExtensionError(
            f"extension {file}{_line(error, path)}: {type(error).__name__}: {words}"
        ) from error
    return hashlib.sha256(source).hexdigest()


def _line(error: BaseException, path: Path) -> str:
    """Return ", line N" for the last line of the file in an error's traceback, or ""."""
    if isinstance(error, SyntaxError):
        return f", line {error.lineno}" if error.filename == str(path) and error.lineno else ""
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if frame.filename == str(path)]
    return f", line {lines[-1]}" if lines else ""


def blamed(error: BaseException) -> str:
    """Describe an error raised in an extension, with file and line; "" for any other error."""
    for path, _ in _loaded.values():
        if line := _line(error, path):
            return f"extension {path}{line}: {type(error).__name__}: {error}"
    return ""


def extension_hashes() -> dict[str, str]:
    """Return the hashes of the loaded extensions by name."""
    return {name: digest for name, (_, digest) in _loaded.items()}


def extensions_for_children() -> dict[str, str]:
    """Return the environment variable that loads the same extensions in a child."""
    return {EXTENSIONS: os.pathsep.join(str(path) for path, _ in _loaded.values())}


def check_extensions(versions: Mapping[str, str], place: Path) -> None:
    """Check that all extensions of a run are loaded."""
    for name, version in versions.items():
        if version.startswith(SUM) and name not in _loaded:
            raise ExtensionError(
                f"{place}: was started with extension {name}; add --with and its path"
            )
