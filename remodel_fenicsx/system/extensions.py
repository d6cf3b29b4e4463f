"""Parts of one's own for the command line: Python files that are run before a command looks at anything else."""

from __future__ import annotations

import hashlib
import os
import sys
import traceback
import types
from collections.abc import Mapping, Sequence
from pathlib import Path

from remodel_fenicsx.errors import RemodelError
from remodel_fenicsx.system.files import read_regular, refusal_in_words

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
