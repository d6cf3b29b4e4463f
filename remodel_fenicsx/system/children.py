"""Commands of this very package, and readers of files of others, in processes of their own."""

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

SECONDS_TO_END = 30.0  # seconds
PARENT_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of prctl(2)
SERVE, PART = "serve", "fit-part"  # commands of processes: of a worker, and of what it does for a fit


class Worker:
    """A process that does commands one after the other: what it has imported and compiled serves all of them."""

    def __init__(self) -> None:
        # -P: no module is taken from the working folder, which may be somebody else's
        command = [sys.executable, "-P", "-m", "remodel_fenicsx.cli", SERVE]
        # SIGTERM where this process is killed; where it was killed before, the pipe has ended
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
        self._tasks, self._answers = cast(IO[str], self.process.stdin), cast(IO[str], self.process.stdout)
        self.messages: Path | None = None
        self.is_at_work = False

    def begin(self, arguments: Sequence[str], messages: Path) -> None:
        """Begin a command, with a file for all that it says."""
        messages.unlink(missing_ok=True)  # whatever was in its place: a link too
        os.close(open_own(messages, os.O_WRONLY | os.O_CREAT | os.O_EXCL))
        self.messages, self.is_at_work = messages, True
        if self.is_alive:  # else `poll` will see it; PETSc, where it is loaded, aborts at a closed pipe
            self._tasks.write(json.dumps([list(arguments), str(messages.absolute())]) + "\n")

    def poll(self) -> int | None:
        """Exit code of the command, negative for a signal that has ended the process; None while it is at work."""
        if not wait_for_one([self], 0.0):
            return None
        self.is_at_work, line = False, self._answers.readline()
        return int(line) if line else self.process.wait() or 1  # it has ended without an answer

    @property
    def is_alive(self) -> bool:
        """Whether it takes another command."""
        return self.process.poll() is None

    def last_words(self) -> str:
        """The last line that the command has said, or what has ended the process."""
        code = self.process.poll()
        if code is not None and code < 0:
            return f"killed by {signal.Signals(-code).name}"
        assert self.messages is not None
        return last_line(self.messages.read_text(errors="replace")).removeprefix("remodel-fenicsx: ")

    def stop(self) -> None:
        """End it, by force if it takes too long."""
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
    """Wait until a worker has something to say, at most so long; whether one has."""
    return bool(select.select([worker.process.stdout for worker in workers], [], [], seconds)[0])


def serve(command: Callable[[Sequence[str]], int]) -> int:
    """Do what a `Worker` asks for until it asks no more: the other end of its pipes."""
    with os.fdopen(os.dup(1), "w") as answers:
        for line in sys.stdin:
            words, messages = json.loads(line)
            descriptor = open_own(Path(messages), os.O_WRONLY | os.O_APPEND)
            for stream in (1, 2):
                os.dup2(descriptor, stream)
            os.close(descriptor)
            try:
                code = command(words)
            except SystemExit as end:  # argparse's way
                code = int(end.code or 0)
            sys.stdout.flush()
            if code > 128:  # a signal has asked this process to end
                return code
            print(code, file=answers, flush=True)
            gc.collect()  # meshes and matrices that refer to each other
    return 0


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0))


def environment_of_child() -> dict[str, str]:
    """With this very package, and parts of one's own; one thread, as there are jobs for the cores."""
    paths = [str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])]
    own = {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    return os.environ | own | extensions_for_children()


def last_line(said: str) -> str:
    """Of what a process has said."""
    return (said.strip().splitlines() or ["it said nothing"])[-1]


# ---------------------------------------------------------------- readers of files of others
# With limits, by rule, and from no other file than this one. What holds for all formats stands here, so that a new
# reader cannot miss it (docs/what_may_go_wrong.md).

LARGEST_FILE = 2 * 10**9  # bytes; ten million hexahedra take 1.1 GB
SECONDS, SECONDS_PER_MB = 20.0, 1.0  # of processor time
MEMORY, MEMORY_PER_BYTE = 10**9, 24  # bytes: of the libraries; of the file and all that it unfolds to
WAITING = 10  # times the processor time: the machine may be busy
ELSEWHERE = "its numbers stand in another file; allowed is a file that holds them (Format='XML')"
LONGEST_REASON = 150  # characters of what is wrong
DAMAGED = "cannot be read: "
FOR_EVER, NO_LIMIT = 1e5, 10**15  # seconds, which the system takes ten times; bytes
NO_ROOM = (errno.EFBIG, errno.ENOSPC, errno.EDQUOT)
# as VTK adds to its words
_HEAD = r"\S+ \S+ \( *[\d.]+s\) \[ *\w+\] ?\S+ ERR\| "
_LOGGED = re.compile(
    rf"\x1b\[[0-9;]*m|{_HEAD}vtkCompositeDataPipeline.*|{_HEAD}(\w+ \(0x[0-9a-f]+\): )?|\(0x[0-9a-f]+\)"
)
UTF_16 = (b"\xff\xfe", b"\xfe\xff")  # marks of its byte order
_COUNTS = re.compile(r"(?i)^(number.*|dimensions|offset)$")
_LINES = re.compile(
    rb"(?im)^\s*(?:points|cells|cell_types|point_data|cell_data|offsets|connectivity)\b[^\n]{0,99}\s-\d"
)


class NoRoomError(RemodelError):
    """A disk, or the largest file that the system allows, is full: not the fault of what is read."""

    exit_code = BAD_ENVIRONMENT

    def __init__(self) -> None:
        super().__init__(
            "there is no room for the numbers of a file: a full disk, or a limit of the size of files (ulimit -f)"
        )


def read_guarded(path: Path, reader: str) -> tuple[dict[str, NDArray[Any]], bytes]:
    """What a reader makes of a file, and the file: the bytes that it has read, and no others."""
    data = read_regular(path, LARGEST_FILE)
    seconds, memory = SECONDS + SECONDS_PER_MB * len(data) / 1e6, MEMORY + MEMORY_PER_BYTE * len(data)
    return made_apart(data, path.name, reader, seconds, memory), data


def made_apart(
    data: bytes, name: str, reader: str, seconds: float = FOR_EVER, memory: int = NO_LIMIT
) -> dict[str, NDArray[Any]]:
    """What a function makes of a file of that name with these bytes, in a process of its own with limits."""
    with os.fdopen(os.memfd_create("read"), "wb") as source, os.fdopen(os.memfd_create("found"), "rb") as found:
        try:
            with open(source.fileno(), "wb", closefd=False) as copy:
                copy.write(data)
        except OSError as error:
            raise NoRoomError from error
        ends = source.fileno(), found.fileno()
        words = [reader, *map(str, (*ends, int(seconds), memory))]
        try:
            done = subprocess.run(
                [sys.executable, "-P", "-W", "ignore", "-m", "remodel_fenicsx.system.children", *words],
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
            raise UnreadableFile(f"takes more than {seconds:.3g} seconds or {memory / 1e6:.0f} MB to read")
        if done.returncode < 0:
            raise UnreadableFile(
                f"{DAMAGED}its reader has crashed, so it is damaged ({signal.Signals(-done.returncode).name})"
            )
        if done.returncode or said:
            raise UnreadableFile(DAMAGED + (said if len(said) <= LONGEST_REASON else f"{said[:LONGEST_REASON]} ..."))
        found.seek(0)
        import numpy as np  # late: most commands need no numbers

        with np.load(io.BytesIO(found.read()), allow_pickle=False) as arrays:
            return dict(arrays)


# ---------------------------------------------------------------- the child


def read_as_child(reader: str, source: str, found: str, seconds: str, memory: str) -> None:
    """Read, in a process of its own."""
    for limit, most in ((resource.RLIMIT_CPU, seconds), (resource.RLIMIT_AS, memory), (resource.RLIMIT_CORE, 0)):
        highest = resource.getrlimit(limit)[1]  # of whoever has started the command
        most = int(most) if highest == resource.RLIM_INFINITY else min(int(most), highest)
        resource.setrlimit(limit, (most, most))
    os.environ["OMP_NUM_THREADS"] = "1"
    modules, _, name = reader.partition(":")
    file = f"/proc/self/fd/{source}"
    try:
        last = [importlib.import_module(module) for module in modules.split()][-1]  # libraries it needs come before
        read: Callable[[str], dict[str, Any]] = getattr(last, name)
        if int(memory) < NO_LIMIT:  # a file of others
            _guard(file)
        arrays = read(file)
        import numpy as np

        with os.fdopen(int(found), "wb") as target:
            np.savez(target, **arrays)
    except OSError as error:
        sys.exit(BAD_ENVIRONMENT if error.errno in NO_ROOM else str(error))
    except MemoryError:
        sys.exit(f"takes more than {int(memory) / 1e6:.0f} MB to read")
    except KeyError as error:  # a table of types, or what was found
        sys.exit(f"something in it is missing or unknown: {error}")
    except BaseException as error:  # readers raise whatever happens on the way
        sys.exit(str(error) or type(error).__name__)


def _guard(file: str) -> None:
    """Refuse XML against the rules; from here on nothing but this file and Python's own is opened."""
    data = Path(file).read_bytes()
    if data.startswith(UTF_16) or b"<" in data.lstrip(b"\0 \t\r\n")[:4]:
        _check_xml(data)
    if found := _LINES.search(data[: 10**6]):
        raise UnreadableFile(f"has a number that is negative: {found[0].decode().strip()}")
    own = tuple({*map(os.path.realpath, sysconfig.get_paths().values()), str(Path(__file__).resolve().parents[1])})
    own += tuple(os.path.realpath(folder) for folder in sys.path if folder)

    def elsewhere(*_: object, **__: object) -> None:
        raise UnreadableFile(ELSEWHERE)

    sys.modules["h5py"] = types.ModuleType("h5py")  # it opens files by itself
    sys.modules["h5py"].File = elsewhere  # type: ignore[attr-defined]

    def watch(event: str, arguments: tuple[object, ...]) -> None:
        if event in ("socket.connect", "subprocess.Popen", "os.system", "os.exec", "os.posix_spawn"):
            raise UnreadableFile("refers to something outside of itself")
        if event == "open" and isinstance(arguments[0], (str, bytes)):
            path = os.fsdecode(arguments[0])
            if path != file and not os.path.realpath(path).startswith(own):
                raise UnreadableFile("refers to another file")

    sys.addaudithook(watch)


def _check_xml(data: bytes) -> None:
    """Refuse what is no XML in UTF-8, has entities of its own, or something outside of itself."""
    from xml.etree import ElementTree

    start = data.find(b"<AppendedData")
    if start >= 0 and b'encoding="raw"' in data[start : start + 100]:  # numbers in bytes at its end are not looked at
        data = data[:start] + b"</VTKFile>"
    if data.startswith(UTF_16):  # which expat would follow, whatever it is told
        raise UnreadableFile("is no XML in UTF-8")
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise UnreadableFile("has a document type or entities; allowed is plain XML")
    parser = ElementTree.XMLParser(encoding="utf-8")
    try:
        parser.feed(data)
        root = parser.close()
    except ElementTree.ParseError as error:
        raise UnreadableFile(f"is no XML in UTF-8: {error}") from None
    for element in root.iter():
        if element.tag.rpartition("}")[2] == "include" or element.get("Format", "XML") != "XML":
            raise UnreadableFile(ELSEWHERE)
        for name, value in element.items():
            if _COUNTS.match(name) and "-" in value:
                raise UnreadableFile(f"has a number that is negative: {name} = {value!r}")
        if (kind := element.get("header_type", "UInt32")) not in ("UInt32", "UInt64"):
            raise UnreadableFile(f"header_type = {kind!r}; allowed are 'UInt32' and 'UInt64'")
    if len(list(root.iter("Piece"))) > 1:
        raise UnreadableFile("has several pieces; allowed is one: read it in ParaView, Merge Blocks, save it again")


if __name__ == "__main__":
    read_as_child(*sys.argv[1:])
