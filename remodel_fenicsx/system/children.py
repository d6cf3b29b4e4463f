"""Child processes: workers that run commands, and guarded readers of untrusted files."""

from __future__ import annotations

import ctypes
import errno
import gc
import importlib
import io
import json
import os
import re
import resource
import select
import signal
import subprocess
import sys
import sysconfig
import types
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, cast

from remodel_fenicsx.errors import BAD_ENVIRONMENT, RemodelError, UnreadableFile
from remodel_fenicsx.system.environment import extensions_for_children
from remodel_fenicsx.system.files import open_own, read_regular

if TYPE_CHECKING:
    from numpy.typing import NDArray

SECONDS_TO_END = 30.0  # seconds until a worker is killed
PARENT_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of prctl(2)
SERVE, PART = "serve", "fit-part"  # internal commands: of a worker, and of a parallel part of a fit


class Worker:
    """A process that runs commands one after another, with modules and kernels loaded once."""

    def __init__(self) -> None:
        # -P: import no module from the working folder, which may belong to somebody else.
        command = [sys.executable, "-P", "-m", "remodel_fenicsx.cli", SERVE]
        # SIGTERM if this process is killed. If it was killed before, the pipe has ended.
        end_with_parent = partial(ctypes.CDLL(None).prctl, PARENT_DEATH_SIGNAL, signal.SIGTERM)
        self.process = subprocess.Popen(
            command,
            env=environment_of_child(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
            preexec_fn=end_with_parent,
        )
        self._tasks, self._answers = cast(IO[str], self.process.stdin), cast(
            IO[str], self.process.stdout
        )
        self.messages: Path | None = None
        self.is_at_work = False

    def begin(self, arguments: Sequence[str], messages: Path) -> None:
        """Start a command; its output goes to a new file."""
        messages.unlink(missing_ok=True)  # The old entry may be a link.
        os.close(open_own(messages, os.O_WRONLY | os.O_CREAT | os.O_EXCL))
        self.messages, self.is_at_work = messages, True
        # Otherwise `poll` reports the end. PETSc, if loaded, aborts when a pipe closes.
        if self.is_alive:
            self._tasks.write(json.dumps([list(arguments), str(messages.absolute())]) + "\n")

    def poll(self) -> int | None:
        """Return the exit code of the command (negative: signal), or None while it runs."""
        if not wait_for_one([self], 0.0):
            return None
        self.is_at_work, line = False, self._answers.readline()
        # The process has ended without an answer.
        return int(line) if line else self.process.wait() or 1

    @property
    def is_alive(self) -> bool:
        """Whether the worker accepts another command."""
        return self.process.poll() is None

    def last_output(self) -> str:
        """Return the last line of the command's output, or the signal that killed the process."""
        code = self.process.poll()
        if code is not None and code < 0:
            return f"killed by {signal.Signals(-code).name}"
        assert self.messages is not None
        return last_line(self.messages.read_text(errors="replace")).removeprefix(
            "remodel-fenicsx: "
        )

    def stop(self) -> None:
        """Stop the worker; kill it after `SECONDS_TO_END`."""
        if self.is_at_work:
            self.process.terminate()
        self._tasks.close()
        try:
            self.process.wait(timeout=SECONDS_TO_END)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._answers.close()


def wait_for_one(workers: Collection[Worker], seconds: float) -> bool:
    """Wait at most this long for an answer of a worker; return whether there is one."""
    return bool(select.select([worker.process.stdout for worker in workers], [], [], seconds)[0])


def serve(command: Callable[[Sequence[str]], int]) -> int:
    """Run the commands that a `Worker` sends, until it closes the pipe; return the exit code."""
    with os.fdopen(os.dup(1), "w") as answers:
        for line in sys.stdin:
            words, messages = json.loads(line)
            descriptor = open_own(Path(messages), os.O_WRONLY | os.O_APPEND)
            for stream in (1, 2):
                os.dup2(descriptor, stream)
            os.close(descriptor)
            try:
                code = command(words)
            except SystemExit as end:  # argparse ends in this way.
                code = int(end.code or 0)
            sys.stdout.flush()
            if code > 128:  # A signal has stopped this process.
                return code
            print(code, file=answers, flush=True)
            gc.collect()  # Frees meshes and matrices in reference cycles.
    return 0


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


def environment_of_child() -> dict[str, str]:
    """Return a child's environment: this package, the loaded extensions, and one thread."""
    paths = [str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])]
    own = {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    return os.environ | own | extensions_for_children()


def last_line(said: str) -> str:
    """Return the last line of a process's output."""
    return (said.strip().splitlines() or ["no output"])[-1]


# ---------------------------------------------------------------- readers of untrusted files
# Each reader runs with limits, checks the format first, and opens no other file. All rules that
# hold for every format are here, so that a new reader cannot bypass them
# (docs/what_may_go_wrong.md).

LARGEST_FILE = 2 * 10**9  # bytes; ten million hexahedra take 1.1 GB
SECONDS, SECONDS_PER_MB = 20.0, 1.0  # CPU time
# bytes: for the libraries, and per byte of the file for its arrays
MEMORY, MEMORY_PER_BYTE = 10**9, 24
WAITING = 10  # wall time limit over CPU time limit, since the machine may be busy
ELSEWHERE = "its data are in another file; save it with the data inside (Format='XML')"
LONGEST_REASON = 150  # characters of a reader's error message
DAMAGED = "cannot be read: "
FOR_EVER, NO_LIMIT = 1e5, 10**15  # seconds (the system allows ten times this number) and bytes
NO_ROOM = (errno.EFBIG, errno.ENOSPC, errno.EDQUOT)
# Prefixes and addresses in VTK's error messages.
_HEAD = r"\S+ \S+ \( *[\d.]+s\) \[ *\w+\] ?\S+ ERR\| "
_LOGGED = re.compile(
    rf"\x1b\[[0-9;]*m|{_HEAD}vtkCompositeDataPipeline.*|"
    rf"{_HEAD}(\w+ \(0x[0-9a-f]+\): )?|\(0x[0-9a-f]+\)"
)
UTF_16 = (b"\xff\xfe", b"\xfe\xff")  # byte order marks
_COUNTS = re.compile(r"(?i)^(number.*|dimensions|offset)$")
_LINES = re.compile(
    rb"(?im)^\s*(?:points|cells|cell_types|point_data|cell_data|offsets|connectivity)\b"
    rb"[^\n]{0,99}\s-\d"
)


class NoRoomError(RemodelError):
    """Full disk, or file size limit of the system; not an error of the file."""

    exit_code = BAD_ENVIRONMENT

    def __init__(self) -> None:
        super().__init__(
            "cannot store the arrays of a file: full disk, or a file size limit (ulimit -f)"
        )


def read_guarded(path: Path, reader: str) -> tuple[dict[str, NDArray[Any]], bytes]:
    """Read a file in a child with limits; return the arrays and the bytes that were read."""
    data = read_regular(path, LARGEST_FILE)
    seconds, memory = SECONDS + SECONDS_PER_MB * len(data) / 1e6, MEMORY + MEMORY_PER_BYTE * len(
        data
    )
    return made_apart(data, path.name, reader, seconds, memory), data


def made_apart(
    data: bytes, name: str, reader: str, seconds: float = FOR_EVER, memory: int = NO_LIMIT
) -> dict[str, NDArray[Any]]:
    """Call a reader on these bytes in a child with limits; return the arrays."""
    with (
        os.fdopen(os.memfd_create("read"), "wb") as source,
        os.fdopen(os.memfd_create("found"), "rb") as output,
    ):
        try:
            with open(source.fileno(), "wb", closefd=False) as copy:
                copy.write(data)
        except OSError as error:
            raise NoRoomError from error
        ends = source.fileno(), output.fileno()
        words = [reader, *map(str, (*ends, int(seconds), memory))]
        try:
            done = subprocess.run(
                [
                    sys.executable,
                    "-P",
                    "-W",
                    "ignore",
                    "-m",
                    "remodel_fenicsx.system.children",
                    *words,
                ],
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=WAITING * seconds,
                pass_fds=ends,
                env=environment_of_child(),
            )
        except subprocess.TimeoutExpired:
            raise UnreadableFile(f"takes more than {seconds:.3g} seconds to read") from None
        if done.returncode == BAD_ENVIRONMENT:
            raise NoRoomError
        said = _LOGGED.sub("", " ".join(done.stderr[-4000:].decode(errors="replace").split()))
        said = said.replace(f"/proc/self/fd/{source.fileno()}", name)
        if -done.returncode in (signal.SIGXCPU, signal.SIGKILL):
            raise UnreadableFile(
                f"takes more than {seconds:.3g} seconds or {memory / 1e6:.0f} MB to read"
            )
        if done.returncode < 0:
            raise UnreadableFile(
                f"{DAMAGED}file is corrupt, its reader has crashed "
                f"({signal.Signals(-done.returncode).name})"
            )
        if done.returncode or said:
            raise UnreadableFile(
                DAMAGED + (said if len(said) <= LONGEST_REASON else f"{said[:LONGEST_REASON]} ...")
            )
        output.seek(0)
        import numpy as np  # Imported late because most commands need no arrays.

        with np.load(io.BytesIO(output.read()), allow_pickle=False) as arrays:
            return dict(arrays)


# ---------------------------------------------------------------- child process


def read_as_child(reader: str, source: str, output: str, seconds: str, memory: str) -> None:
    """Read a file in the child: set limits, guard, read, and save the arrays."""
    for limit, most in (
        (resource.RLIMIT_CPU, seconds),
        (resource.RLIMIT_AS, memory),
        (resource.RLIMIT_CORE, 0),
    ):
        highest = resource.getrlimit(limit)[1]  # set by the process that has started the command
        most = int(most) if highest == resource.RLIM_INFINITY else min(int(most), highest)
        resource.setrlimit(limit, (most, most))
    os.environ["OMP_NUM_THREADS"] = "1"
    modules, _, name = reader.partition(":")
    file = f"/proc/self/fd/{source}"
    try:
        # The reader's module comes last, after the libraries that it needs.
        last = [importlib.import_module(module) for module in modules.split()][-1]
        read: Callable[[str], dict[str, Any]] = getattr(last, name)
        if int(memory) < NO_LIMIT:  # Only untrusted files have a limit.
            _guard(file)
        arrays = read(file)
        import numpy as np

        with os.fdopen(int(output), "wb") as target:
            np.savez(target, **arrays)
    except OSError as error:
        sys.exit(BAD_ENVIRONMENT if error.errno in NO_ROOM else str(error))
    except MemoryError:
        sys.exit(f"takes more than {int(memory) / 1e6:.0f} MB to read")
    except KeyError as error:  # An unknown type, or a missing array.
        sys.exit(f"something in it is missing or unknown: {error}")
    except BaseException as error:  # Readers raise errors of any kind.
        sys.exit(str(error) or type(error).__name__)


def _guard(file: str) -> None:
    """Reject unsafe XML, then block access to all files but this one and Python's own."""
    data = Path(file).read_bytes()
    if data.startswith(UTF_16) or b"<" in data.lstrip(b"\0 \t\r\n")[:4]:
        _check_xml(data)
    if match := _LINES.search(data[: 10**6]):
        raise UnreadableFile(f"has a negative number: {match[0].decode().strip()}")
    own = tuple(
        {
            *map(os.path.realpath, sysconfig.get_paths().values()),
            str(Path(__file__).resolve().parents[1]),
        }
    )
    own += tuple(os.path.realpath(folder) for folder in sys.path if folder)

    def elsewhere(*_: object, **__: object) -> None:
        raise UnreadableFile(ELSEWHERE)

    sys.modules["h5py"] = types.ModuleType("h5py")  # h5py opens files without Python's audit hook.
    sys.modules["h5py"].File = elsewhere  # type: ignore[attr-defined]

    def watch(event: str, arguments: tuple[object, ...]) -> None:
        if event in (
            "socket.connect",
            "subprocess.Popen",
            "os.system",
            "os.exec",
            "os.posix_spawn",
        ):
            raise UnreadableFile("refers to something outside the file")
        if event == "open" and isinstance(arguments[0], (str, bytes)):
            path = os.fsdecode(arguments[0])
            if path != file and not os.path.realpath(path).startswith(own):
                raise UnreadableFile("refers to another file")

    sys.addaudithook(watch)


def _check_xml(data: bytes) -> None:
    """Reject XML that is not UTF-8, defines entities, or refers to other files."""
    from xml.etree import ElementTree

    start = data.find(b"<AppendedData")
    # Raw binary data at the end is not XML.
    if start >= 0 and b'encoding="raw"' in data[start : start + 100]:
        data = data[:start] + b"</VTKFile>"
    # expat follows a byte order mark whatever encoding it is told to use.
    if data.startswith(UTF_16):
        raise UnreadableFile("is not XML in UTF-8")
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise UnreadableFile("has a document type or entities; must be plain XML")
    parser = ElementTree.XMLParser(encoding="utf-8")
    try:
        parser.feed(data)
        root = parser.close()
    except ElementTree.ParseError as error:
        raise UnreadableFile(f"is not XML in UTF-8: {error}") from None
    for element in root.iter():
        if element.tag.rpartition("}")[2] == "include" or element.get("Format", "XML") != "XML":
            raise UnreadableFile(ELSEWHERE)
        for name, value in element.items():
            if _COUNTS.match(name) and "-" in value:
                raise UnreadableFile(f"has a negative number: {name} = {value!r}")
        if (kind := element.get("header_type", "UInt32")) not in ("UInt32", "UInt64"):
            raise UnreadableFile(f"header_type = {kind!r}: must be 'UInt32' or 'UInt64'")
    if len(list(root.iter("Piece"))) > 1:
        raise UnreadableFile(
            "has several pieces, must have one: read it in ParaView, Merge Blocks, save it again"
        )


if __name__ == "__main__":
    read_as_child(*sys.argv[1:])
