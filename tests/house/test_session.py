"""tests/session.py: sessions of pytest's of their own, with tests that hang, and what it says at its end."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import mpirun, slowly
from tests.processes import has_ended, ran

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
    return ran(command, cwd=folder, env=environment_of(**variables))


def words_of(folder: Path, *arguments: str) -> list[str]:
    """Of pytest's command line."""
    plugins = ["-p", "xdist", "-p", "timeout", "-p", "tests.session"]
    return [*plugins, "-c", str(PROJECT / "pyproject.toml"), "--rootdir", str(folder), *arguments]


def environment_of(**variables: str) -> dict[str, str]:
    """This one, but for what belongs to this session, and without plugins that take longer than these tests do."""
    inherited = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("PYTEST_", "REMODEL_"))
    }
    return {
        **inherited,
        "PYTHONPATH": str(PROJECT),
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
        **variables,
    }


@pytest.mark.parametrize(
    "name, workers", [("mpirun", "0"), ("deaf", "1"), *slowly(("sleep", "1"), ("deaf", "0"))]
)
def test_a_test_that_hangs_fails_and_the_others_go_on(
    name: str, workers: str, tmp_path: Path
) -> None:
    ranks = tmp_path / "ranks"
    ranks.mkdir()
    before, argument = (
        (RANKS.replace("FOLDER", str(ranks)), "ranks") if name == "mpirun" else ("", "")
    )
    text = f"{before}\ndef test_hangs({argument}):\n    {HANGS[name]}\ndef test_after(): pass\n"
    (tmp_path / "test_it.py").write_text(text)
    done = session(tmp_path, "-n", workers, "--timeout=1", "-o", "timeout_grace=0.5", "test_it.py")
    assert done.returncode == 1, done.stdout + done.stderr
    if name == "deaf":
        assert 'test_it.py", line 3 in test_hangs' in done.stderr
        # it can only be ended with its process: one of several is replaced
        assert (
            workers == "0"
            or "1 failed, 1 passed" in done.stdout
            and "crashed while running" in done.stdout
        )
    else:
        assert "Timeout >1.0s" in done.stdout and "1 failed, 1 passed" in done.stdout
    pids = list(ranks.iterdir())
    assert len(pids) == (2 if name == "mpirun" else 0)
    assert all(has_ended(int(rank.name)) for rank in pids)
