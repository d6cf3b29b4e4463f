"""tests/session.py: sessions of pytest's of their own, with tests that hang and a stand-in for the launcher's tests."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.conftest import mpirun, slowly
from tests.forks import forked
from tests.session import pytest_collection

PROJECT = Path(__file__).resolve().parents[2]
RANK = "import os, sys, time; from mpi4py import MPI; open(f'{sys.argv[1]}/{os.getpid()}', 'w'); MPI.COMM_WORLD.recv()"
HANGS = {
    "sleep": "import time; time.sleep(1000)",
    "mpirun": "ranks.wait()",
    # in C, where no handler of Python's is called
    "deaf": "import itertools; sum(itertools.repeat(0))",
}
# ranks are there before the time begins to count, however long mpirun takes
RANKS = f"""
import os, subprocess, time, pytest
@pytest.fixture
def ranks():
    process = subprocess.Popen({mpirun(2, sys.executable, '-c', RANK, 'FOLDER')!r})
    while len(os.listdir('FOLDER')) < 2:
        time.sleep(0.05)
    return process
pytestmark = pytest.mark.timeout(1, func_only=True)
"""


def session(folder: Path, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run pytest with the plugin on a folder's tests."""
    command = [sys.executable, "-m", "pytest", *words_of(folder, *arguments)]
    return subprocess.run(command, cwd=folder, env=environment_of(**variables), capture_output=True, text=True)


def words_of(folder: Path, *arguments: str) -> list[str]:
    """Of pytest's command line."""
    plugins = ["-p", "xdist", "-p", "timeout", "-p", "tests.session"]
    return [*plugins, "-c", str(PROJECT / "pyproject.toml"), "--rootdir", str(folder), *arguments]


def environment_of(**variables: str) -> dict[str, str]:
    """This one, but for what belongs to this session, and without plugins that take longer than these tests do."""
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(("PYTEST_", "REMODEL_"))}
    return {**inherited, "PYTHONPATH": str(PROJECT), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", **variables}


def has_ended(process: int) -> bool:
    """Whether nothing is left of it but, at most, what its parent has not asked for yet."""
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return True
    return state == "Z"


@pytest.mark.parametrize("name, workers", [("mpirun", "0"), ("deaf", "1"), *slowly(("sleep", "1"), ("deaf", "0"))])
def test_a_test_that_hangs_fails_and_the_others_go_on(name: str, workers: str, tmp_path: Path) -> None:
    ranks = tmp_path / "ranks"
    ranks.mkdir()
    before, argument = (RANKS.replace("FOLDER", str(ranks)), "ranks") if name == "mpirun" else ("", "")
    text = f"{before}\ndef test_hangs({argument}):\n    {HANGS[name]}\ndef test_after(): pass\n"
    (tmp_path / "test_it.py").write_text(text)
    done = session(tmp_path, "-n", workers, "--timeout=1", "-o", "timeout_grace=0.5", "test_it.py")
    assert done.returncode == 1, done.stdout + done.stderr
    if name == "deaf":
        assert 'test_it.py", line 3 in test_hangs' in done.stderr
        # it can only be ended with its process: one of several is replaced
        assert workers == "0" or "1 failed, 1 passed" in done.stdout and "crashed while running" in done.stdout
    else:
        assert "Timeout >1.0s" in done.stdout and "1 failed, 1 passed" in done.stdout
    pids = list(ranks.iterdir())
    assert len(pids) == (2 if name == "mpirun" else 0)
    assert all(has_ended(int(rank.name)) for rank in pids)


def test_a_slow_test_has_a_longer_limit(tmp_path: Path) -> None:
    text = "import pytest, time\n@pytest.mark.slow\ndef test_slow(): time.sleep(2)\ndef test_quick(): time.sleep(2)\n"
    (tmp_path / "test_it.py").write_text(text)
    done = session(tmp_path, "-n", "0", "--timeout=1", "test_it.py")
    assert "FAILED test_it.py::test_quick" in done.stdout and "1 failed, 1 passed" in done.stdout


MAIN = "import sys, pytest; sys.exit(pytest.main(sys.argv[1:]))"


def launcher_session(folder: Path, *arguments: str, **variables: str) -> dict[str, str]:
    """What pytest says at its end, with a cache of the test's own; forked, for nothing in it looks at processes."""
    words, environment = words_of(folder, *arguments), environment_of(XDG_CACHE_HOME=str(folder / "cache"), **variables)
    plugins = ("pytest", "xdist.plugin", "pytest_timeout")
    done = forked("python", MAIN, *words, cwd=folder, variables=environment, imports=plugins)
    said = done.stdout.splitlines()
    return {"summary": said[-1], "skipped": "\n".join(line for line in said if line.startswith("SKIPPED"))}


def test_the_launchers_tests_are_skipped_after_they_have_passed_until_its_files_change(tmp_path: Path) -> None:
    """And the number of kernels that all processes have compiled is said at the end."""
    compile_one = "open(os.environ['REMODEL_FENICSX_COMPILED'], 'a').write('a form\\n')"
    launcher = f"import os\ndef test_one(): {compile_one}\ndef test_two(): pass\n"
    (tmp_path / "test_launcher.py").write_text(launcher)
    (tmp_path / "test_other.py").write_text(f"import os\ndef test_three(): {compile_one}\n")
    done = session(tmp_path, "-n", "2", "--dist", "loadfile", XDG_CACHE_HOME=str(tmp_path / "cache"))
    assert "3 passed" in done.stdout
    assert "\nkernels compiled: 2\n" in done.stdout  # by both workers
    again = launcher_session(tmp_path)
    assert "1 passed, 2 skipped" in again["summary"]
    assert again["skipped"].startswith("SKIPPED [2] test_launcher.py: they passed here on 2")
    assert "-m launcher runs them" in again["skipped"]
    for arguments in (["-m", "launcher"], ["test_launcher.py"], ["-k", "test_launcher"]):
        assert "2 passed" in launcher_session(tmp_path, *arguments)["summary"], arguments
    assert "3 passed" in launcher_session(tmp_path, REMODEL_FENICSX_ROOT="another environment")["summary"]


@pytest.mark.parametrize(
    "arguments, text",
    [
        ([], "def test_one(): pass\ndef test_two(): assert False\n"),
        ([], "import pytest\ndef test_one(): pass\ndef test_two(): pytest.skip('not here')\n"),
        (["-k", "one"], "def test_one(): pass\ndef test_two(): pass\n"),
        (["test_launcher.py::test_one"], "def test_one(): pass\ndef test_two(): pass\n"),
    ],
    ids=["failed", "skipped", "selected", "named"],
)
def test_the_launchers_tests_leave_no_stamp_if_not_all_have_passed(
    arguments: list[str], text: str, tmp_path: Path
) -> None:
    (tmp_path / "test_launcher.py").write_text(text)
    assert "1 passed" in launcher_session(tmp_path, *arguments)["summary"]
    assert not list(tmp_path.rglob("launcher-tests"))


def test_the_launchers_key_changes_with_its_files(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from tests import session as plugin

    before = plugin.launcher_key()
    assert plugin.launcher_key() == before
    copied = ("with-fenicsx", "Dockerfile", "environment", "bin", ".ci", "tests")
    subprocess.run(["cp", "-r", *(PROJECT / name for name in copied), tmp_path], check=True)
    monkeypatch.setattr(plugin, "PROJECT", tmp_path)
    assert plugin.launcher_key() == before
    for name in ("with-fenicsx", "environment/enter-root", "Dockerfile", "tests/launcher/test_launcher.py"):
        last = plugin.launcher_key()
        with (tmp_path / name).open("a") as file:
            file.write("\n")
        assert plugin.launcher_key() != last, name


def test_a_file_that_is_skipped_as_a_whole_does_not_end_the_session(monkeypatch: pytest.MonkeyPatch) -> None:
    """As the tests in a browser are, where there is none: each worker imports all files before it collects them."""
    worker = {"workerid": "gw0", "workercount": 1}
    config = SimpleNamespace(workerinput=worker, args_source=pytest.Config.ArgsSource.TESTPATHS)
    asked: list[str] = []

    def imported(name: str) -> None:
        asked.append(name)
        pytest.skip("there is none", allow_module_level=True)

    monkeypatch.setattr(importlib, "import_module", imported)
    try:
        pytest_collection(SimpleNamespace(config=config))  # type: ignore[arg-type]
    except pytest.skip.Exception:
        pytest.fail("the first file that is skipped ends the worker")
    assert asked == sorted(asked) and __name__ in asked
