"""Whether a recorded run still stands: it is whole, and scene, source and libraries are the present ones."""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.metadata
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.results.recording import Recording, RecordingError
from remodel_fenicsx.scene.scene import Scene, SceneError

_DISTRIBUTIONS = ("fenics-dolfinx", "fenics-ufl", "fenics-ffcx", "petsc4py", "gmsh", "numpy")


def fault(folder: Path, scene: Scene) -> str | None:
    """Why a folder does not hold the whole record of a scene, in words; None: it does."""
    try:
        recording = Recording(folder)
        if recording.scene != scene:
            return "it is of another scene"
        step, steps = scene.time.step, scene.time.number_of_steps
        times = recording.history["time"]
        if not _same_times(times[times > 0], step * np.arange(1, steps + 1)):
            return "history.csv has not the rows of all steps"
        if scene.output.fields:
            recorded = sorted({*range(0, steps + 1, scene.output.every), steps})
            if not _same_times(recording.times, step * np.array(recorded)):
                return "fields.vtkhdf has not all times"
            recording.fields(recording.times[-1])  # behind all others in the file
    except (RecordingError, SceneError, OSError) as error:
        return " ".join(str(error).split())
    return None


def _same_times(found: NDArray[Any], wanted: NDArray[Any]) -> bool:
    return found.shape == wanted.shape and bool(np.allclose(found, wanted, rtol=1e-9, atol=0.0))


def run_key(scene: Scene, source: str, libraries: Mapping[str, str]) -> str:
    """What a recorded run depends on, as one hash: the scene with all its defaults, the source, the libraries."""
    everything = json.dumps([scene.model_dump(mode="json"), source, dict(libraries)], sort_keys=True)
    return _hash(everything)[:12]


def library_versions() -> dict[str, str]:
    """Versions of the libraries that decide a run's numbers, without importing them."""
    return {name: importlib.metadata.version(name) for name in _DISTRIBUTIONS}


# ---------------------------------------------------------------- the source


def source_fingerprint(package: Path = Path(__file__).parents[1]) -> str:
    """Hash of all source that a run imports, whatever its files are called and wherever they lie, and of all C.

    Comments, docstrings, layout and the order of imports of Python do not change it, nor does moving a module. What a
    module imports from the package counts by the source that it comes from, not by its path.
    """
    read = _imported(package)
    bodies = {name: body for name, (_, body) in read.items()}
    whole = []
    for name, body in bodies.items():
        taken = set()
        for source, part, alias in read[name][0]:
            if f"{source}.{part}" in bodies:  # a module of the package
                taken.add((bodies[f"{source}.{part}"], "", alias))
            else:  # what stands in one, or a library
                taken.add((bodies.get(source, source), part, alias))
        whole.append(_hash(repr((body, sorted(taken)))))
    whole += [_hash(path.read_text(encoding="utf-8")) for path in package.rglob("*.[ch]")]
    return _hash(repr(sorted(set(whole))))


Imports = tuple[tuple[str, str, str], ...]


def _imported(package: Path) -> dict[str, tuple[Imports, str]]:
    """What a run imports from the package, by module name: what each module imports, and the hash of the rest of it."""
    found: dict[str, tuple[Imports, str]] = {}
    waiting = [f"{package.name}.running"]
    while waiting:
        name = waiting.pop()
        if name in found or name.partition(".")[0] != package.name:
            continue
        place = package.parent.joinpath(*name.split("."))
        path = next((file for file in (place.with_suffix(".py"), place / "__init__.py") if file.is_file()), None)
        if path is not None:  # and no name that stands in a module
            found[name] = _read(path.read_text(encoding="utf-8"))
            waiting.append(name.rpartition(".")[0])
            waiting += [module for source, part, _ in found[name][0] for module in (source, f"{source}.{part}")]
    return found


@functools.cache
def _read(text: str) -> tuple[Imports, str]:
    """Of a module's source; read once, for a command asks before and after its runs."""
    reader = _ImportsAndTexts()
    tree = reader.visit(ast.parse(text))
    return tuple(reader.imports), _hash(ast.dump(tree))


class _ImportsAndTexts(ast.NodeTransformer):
    """Takes imports and docstrings out of a module; keeps (from where, what, as what) of each import."""

    def __init__(self) -> None:
        self.imports: list[tuple[str, str, str]] = []

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:  # noqa: N802
        self.imports += [(node.module or "", alias.name, alias.asname or alias.name) for alias in node.names]

    def visit_Import(self, node: ast.Import) -> None:  # noqa: N802
        self.imports += [(alias.name, "", alias.asname or alias.name) for alias in node.names]

    def visit_Expr(self, node: ast.Expr) -> ast.AST | None:  # noqa: N802
        is_text = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return None if is_text else self.generic_visit(node)


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
