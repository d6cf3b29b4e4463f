"""Files of others are read in a child process: with limits, by rule, and from no other file than this one.

What holds for all formats stands here, so that a new reader cannot miss it (docs/reliability.md).
"""

from __future__ import annotations

import importlib
import io
import os
import re
import resource
import subprocess
import sys
import sysconfig
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.errors import RemodelError
from remodel_fenicsx.system.children import environment_of_child
from remodel_fenicsx.system.files import read_regular

LARGEST_FILE = 2 * 10**9  # bytes; ten million hexahedra take 1.1 GB
SECONDS, SECONDS_PER_MB = 20.0, 1.0  # of processor time
MEMORY, MEMORY_PER_BYTE = 10**9, 24  # bytes: of the libraries; of the file and all that it unfolds to
WAITING = 10  # times the processor time: the machine may be busy
ELSEWHERE = "its numbers stand in another file; allowed is a file that holds them (Format='XML')"
LONGEST_REASON = 150  # characters of what is wrong
DAMAGED = "cannot be read: "
_COUNTS = re.compile(r"(?i)^(number.*|dimensions|offset)$")
_LINES = re.compile(
    rb"(?im)^\s*(?:points|cells|cell_types|point_data|cell_data|offsets|connectivity)\b[^\n]{0,99}\s-\d"
)


class UnreadableFile(RemodelError, ValueError):  # noqa: N818
    """What is wrong with a file; one line."""


def read_guarded(path: Path, reader: str) -> tuple[dict[str, NDArray[Any]], bytes]:
    """What a reader makes of a file, and the file: the bytes that it has read, and no others."""
    data = read_regular(path, LARGEST_FILE)
    seconds, memory = SECONDS + SECONDS_PER_MB * len(data) / 1e6, MEMORY + MEMORY_PER_BYTE * len(data)
    with os.fdopen(os.memfd_create("read"), "wb") as source, os.fdopen(os.memfd_create("found"), "rb") as found:
        source.write(data)
        source.flush()
        words = [reader, str(source.fileno()), str(found.fileno()), str(int(seconds)), str(memory)]
        command = [sys.executable, "-P", "-W", "ignore", "-m", "remodel_fenicsx.system.guarded", *words]
        kept: dict[str, Any] = {"pass_fds": (source.fileno(), found.fileno()), "env": environment_of_child()}
        try:
            done = subprocess.run(
                command, stdin=subprocess.DEVNULL, capture_output=True, timeout=WAITING * seconds, **kept
            )
        except subprocess.TimeoutExpired:
            raise UnreadableFile(f"takes more than {seconds:.3g} seconds to read") from None
        said = " ".join(done.stderr[-4000:].decode(errors="replace").split())
        if done.returncode < 0:
            raise UnreadableFile(f"takes more than {seconds:.3g} seconds or {memory / 1e6:.0f} MB to read")
        if done.returncode or said:
            raise UnreadableFile(DAMAGED + (said if len(said) <= LONGEST_REASON else f"{said[:LONGEST_REASON]} ..."))
        found.seek(0)
        with np.load(io.BytesIO(found.read()), allow_pickle=False) as arrays:
            return dict(arrays), data


# ---------------------------------------------------------------- the child


def main(reader: str, source: str, found: str, seconds: str, memory: str) -> None:
    """Read, in a process of its own."""
    for limit, most in ((resource.RLIMIT_CPU, seconds), (resource.RLIMIT_AS, memory), (resource.RLIMIT_CORE, 0)):
        resource.setrlimit(limit, (int(most), int(most)))
    os.environ["OMP_NUM_THREADS"] = "1"
    module, _, name = reader.partition(":")
    file = f"/proc/self/fd/{source}"
    try:
        read: Callable[[str], dict[str, Any]] = getattr(importlib.import_module(module), name)
        _guard(file)
        arrays = read(file)
        with os.fdopen(int(found), "wb") as target:
            np.savez(target, **arrays)
    except MemoryError:
        sys.exit(f"takes more than {int(memory) / 1e6:.0f} MB to read")
    except KeyError as error:  # a table of types, or what was found
        sys.exit(f"something in it is missing or unknown: {error}")
    except BaseException as error:  # readers raise whatever happens on the way
        sys.exit(str(error) or type(error).__name__)


def _guard(file: str) -> None:
    """From here on XML is parsed by rule, and nothing but this file and Python's own is opened."""
    from xml.etree import ElementTree

    own = tuple({*map(os.path.realpath, sysconfig.get_paths().values()), str(Path(__file__).resolve().parents[1])})
    own += tuple(os.path.realpath(folder) for folder in sys.path if folder)

    def elsewhere(*_: Any, **__: Any) -> None:
        raise UnreadableFile(ELSEWHERE)

    sys.modules["h5py"] = types.ModuleType("h5py")  # it opens files by itself
    sys.modules["h5py"].File = elsewhere  # type: ignore[attr-defined]

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        if event in ("socket.connect", "subprocess.Popen", "os.system", "os.exec", "os.posix_spawn"):
            raise UnreadableFile("refers to something outside of itself")
        if event == "open" and isinstance(arguments[0], (str, bytes)):
            path = os.fsdecode(arguments[0])
            if path != file and not os.path.realpath(path).startswith(own):
                raise UnreadableFile("refers to another file")

    def parse(place: Any, parser: Any = None) -> Any:
        return ElementTree.ElementTree(tree_by_rule(Path(place).read_bytes()))

    def fromstring(text: str | bytes, parser: Any = None) -> Any:
        return tree_by_rule(text.encode() if isinstance(text, str) else text)

    changed: Any = ElementTree
    changed.parse, changed.fromstring, changed.XML = parse, fromstring, fromstring
    if found := _LINES.search(Path(file).read_bytes()[: 10**6]):
        raise UnreadableFile(f"has a number that is negative: {found[0].decode().strip()}")
    sys.addaudithook(watch)


def tree_by_rule(data: bytes) -> Any:
    """The root of XML in UTF-8 that has no entities of its own and nothing outside of itself."""
    from xml.etree import ElementTree
    from xml.parsers import expat

    def refuse(*_: Any) -> Any:
        raise UnreadableFile("has a document type or entities; allowed is plain XML")

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag.rpartition(":")[2] == "include" or attributes.get("Format", "XML") != "XML":
            raise UnreadableFile(ELSEWHERE)
        for name, value in attributes.items():
            if _COUNTS.match(name) and "-" in value:
                raise UnreadableFile(f"has a number that is negative: {name} = {value!r}")
        if attributes.get("header_type", "UInt32") not in ("UInt32", "UInt64"):
            raise UnreadableFile(f"header_type = {attributes['header_type']!r}; allowed are 'UInt32' and 'UInt64'")
        pieces.extend([tag] if tag == "Piece" else [])
        if len(pieces) > 1:
            raise UnreadableFile("has several pieces; allowed is one: read it in ParaView, Merge Blocks, save it again")
        builder.start(tag, attributes)

    if data.startswith((b"\xff\xfe", b"\xfe\xff")):  # which expat would follow, whatever it is told
        raise UnreadableFile("is no XML in UTF-8")
    builder, pieces, parser = ElementTree.TreeBuilder(), [], expat.ParserCreate("utf-8")  # type: ignore[var-annotated]
    parser.buffer_text, parser.buffer_size = True, 2**20
    parser.StartElementHandler, parser.EndElementHandler = start, builder.end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise ElementTree.ParseError(f"is no XML in UTF-8: {error}") from None
    return builder.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
