"""tests/mutate: what it says of faults that are noticed and of those that are not; and that its table is in order."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

MUTATE = Path(__file__).parents[1] / "mutate"
SOURCE = "def double(x):\n    return 2 * x\n\n\ndef unused():\n    return 5\n"
TEST = "from remodel_fenicsx.arithmetic import double\n\n\ndef test_double():\n    assert double(2) == 4\n"
TABLE = """
["test_arithmetic.py"]
square = 'arithmetic.double: 2*x => x ** x'
unused = 'unused: 5 => 6'
"""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A file, its test, and faults of every kind."""
    made = tmp_path / "project"
    (made / "tests").mkdir(parents=True)
    for name in ("table", "remodel_fenicsx"):
        (made / name).mkdir()
    (made / "remodel_fenicsx" / "arithmetic.py").write_text(SOURCE)
    (made / "tests" / "test_arithmetic.py").write_text(TEST)
    (made / "table" / "all.toml").write_text(TABLE)
    return made


def mutate(project: Path, *arguments: str) -> tuple[int, str]:
    """Exit status and what it said."""
    command = [sys.executable, str(MUTATE), "--project", str(project), "--table", str(project / "table"), *arguments]
    # the project's tests are plain: pytest's plugins, which take longer than they do, stay away
    environment = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment)
    assert "Traceback" not in done.stderr, done.stderr
    return done.returncode, done.stdout


def test_a_survivor_is_named_and_the_project_stays(project: Path) -> None:
    before = {path: path.read_text() for path in project.rglob("*") if path.is_file()}
    status, said = mutate(project, "--only", "square", "--only", "unused")
    assert status == 1 and "0 of 2 killed" in said
    assert said.endswith("survived: square\nsurvived: unused\n")  # 2 ** 2 is 4 too
    assert before == {path: path.read_text() for path in project.rglob("*") if path.is_file()}


def test_the_table_fits_the_project() -> None:
    """Every text occurs once, every test is there: who changes what a fault changes changes tests/mutations too."""
    done = subprocess.run([sys.executable, str(MUTATE), "--list"], capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(done.stdout.splitlines()) >= 40
