"""A test session's own rules, as a plugin of pytest's: limits that find a hang, how many kernels were compiled, and
which files start first.
"""

from __future__ import annotations

import contextlib
import faulthandler
import importlib
import os
import signal
import tempfile
from collections import defaultdict
from collections.abc import Generator
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from xdist.scheduler import LoadFileScheduling

from tests.forks import what_is_imported_stays

SLOW_LIMIT = 3600  # seconds for a test marked slow; pyproject.toml has the limit of all others
COMPILED = (
    "REMODEL_FENICSX_COMPILED"  # names the file that gets one line for each kernel that is compiled
)


# ---------------------------------------------------------------- limits
def descendants(process: int) -> list[int]:
    """All processes that this one has started, and those started by them."""
    children: dict[int, list[int]] = defaultdict(list)
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
        except (FileNotFoundError, ProcessLookupError):  # it has ended meanwhile
            continue
        children[parent].append(int(entry.name))
    found = [process]
    for one in found:
        found += children[one]
    return found[1:]


def kill_descendants() -> None:
    """What a test that hangs has started, mpirun's ranks as well: killing mpirun alone would leave them."""
    for process in descendants(os.getpid()):
        try:
            os.kill(process, signal.SIGKILL)
        except ProcessLookupError:  # it has ended meanwhile
            continue


def pytest_addoption(parser: pytest.Parser) -> None:
    """Of pyproject.toml, and of -o NAME=VALUE."""
    parser.addini(
        "timeout_grace",
        "seconds after a test's limit: if it goes on then, its process is ended",
        default="60",
    )
    parser.addini("start_first", "test files that take longest, for pytest-xdist", type="args")


@pytest.hookimpl(wrapper=True, optionalhook=True)
def pytest_timeout_set_timer(item: pytest.Item, settings: Any) -> Generator[None, Any, Any]:
    """At its limit a test fails, with all it has started; where Python's signals do not arrive, its process ends."""
    result = yield
    fail = signal.getsignal(signal.SIGALRM)
    assert callable(fail), "pytest-timeout's method must be 'signal'"

    def end(number: int, frame: FrameType | None) -> None:
        kill_descendants()
        fail(number, frame)

    signal.signal(signal.SIGALRM, end)
    end_at = settings.timeout + float(item.config.getini("timeout_grace"))
    faulthandler.dump_traceback_later(end_at, exit=True, file=item.config.stash[STANDARD_ERROR])
    return result


@pytest.hookimpl(optionalhook=True)
def pytest_timeout_cancel_timer(item: pytest.Item) -> None:
    """The test has ended."""
    faulthandler.cancel_dump_traceback_later()


def pytest_enter_pdb() -> None:
    """Who debugs takes the time it takes."""
    faulthandler.cancel_dump_traceback_later()


# ---------------------------------------------------------------- which files start first
class LongFilesFirst(LoadFileScheduling):  # type: ignore[misc]
    """One file goes to one worker, as with --dist loadfile; those of `start_first` (pyproject.toml) come first.

    By itself pytest-xdist starts with the files of most tests. Those that run through time have few, would come last,
    and one worker would wait for the other.
    """

    def _assign_work_unit(self, node: Any) -> None:
        long_files = self.config.getini("start_first")
        waiting = [
            scope for name in long_files for scope in self.workqueue if Path(scope).name == name
        ]
        if waiting:
            self.workqueue.move_to_end(waiting[0], last=False)
        super()._assign_work_unit(node)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """For --dist loadfile, which tests/run asks for."""
    return LongFilesFirst(config, log) if config.getoption("dist") == "loadfile" else None


# ---------------------------------------------------------------- what pytest makes of the test files
def pytest_collection(session: pytest.Session) -> None:
    """Each of pytest-xdist's workers imports the test files in another order before it collects them.

    pytest rewrites their assertions, in a fresh clone for as long as it imports all else, and leaves the bytecode to
    whoever comes later: so the workers share this work, where in the same order all would do all of it.
    """
    worker = getattr(session.config, "workerinput", None)
    if worker is None or session.config.args_source is not pytest.Config.ArgsSource.TESTPATHS:
        return
    tests = Path(__file__).parent
    files = sorted(tests.rglob("test_*.py"))
    first = int(worker["workerid"].removeprefix("gw")) * len(files) // worker["workercount"]
    for path in files[first:] + files[:first]:
        with contextlib.suppress(
            Exception, pytest.skip.Exception
        ):  # collecting it says what is wrong, or skipped
            importlib.import_module(
                ".".join(("tests", *path.relative_to(tests).with_suffix("").parts))
            )


# ---------------------------------------------------------------- the session
STANDARD_ERROR = pytest.StashKey[int]()


def pytest_itemcollected(item: pytest.Item) -> None:
    """Slow tests have a limit of their own."""
    if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
        item.add_marker(pytest.mark.timeout(SLOW_LIMIT))


def pytest_configure(config: pytest.Config) -> None:
    """Before anything is collected or started."""
    config.stash[STANDARD_ERROR] = os.dup(
        2
    )  # during a test, 2 is a file that would be lost with the process
    if (
        COMPILED not in os.environ
    ):  # pytest-xdist's workers have it from the process that starts them
        folder = tempfile.TemporaryDirectory(prefix="remodel-fenicsx-tests-")
        os.environ[COMPILED] = str(Path(folder.name) / "compiled")
        config.add_cleanup(lambda: (os.environ.pop(COMPILED), folder.cleanup()))
        os.environ.pop(
            "PYTHONUNBUFFERED", None
        )  # it writes a line in pieces, and those of two ranks come mixed
        # an mpirun that was killed leaves a folder, in the way of a later one with the same process number
        os.environ["PRTE_MCA_prte_tmpdir_base"] = os.environ["OMPI_MCA_orte_tmpdir_base"] = (
            folder.name
        )


def pytest_collection_finish() -> None:
    """From here on nothing is imported but by tests."""
    what_is_imported_stays()


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """How many kernels were compiled, by all processes of the session."""
    path = Path(os.environ[COMPILED])
    lines = path.read_text().splitlines() if path.exists() else []
    terminalreporter.write_line(f"kernels compiled: {len(lines)}")
