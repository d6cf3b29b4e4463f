"""tests/mutate: what its changes do, what it says of faults that are noticed or not, and that its table is in order."""

from __future__ import annotations

import ast
import os
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.processes import ran
from tests.tables import rows

MUTATE = Path(__file__).parents[1] / "mutate"
SOURCE = "def double(x):\n    return 2 * x\n\n\ndef unused():\n    return 5\n"
TEST = "from remodel_fenicsx.arithmetic import double\n\n\ndef test_double():\n    assert double(2) == 4\n"
TABLE = """
["test_arithmetic.py"]
"arithmetic:double" = ["operator * **", "operator * +"]
"arithmetic:unused" = "factor"
"""


@pytest.fixture(scope="module")
def tool() -> Any:
    """The command as a module."""
    return SimpleNamespace(**runpy.run_path(str(MUTATE)))


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
    command = [
        sys.executable,
        str(MUTATE),
        "--project",
        str(project),
        "--table",
        str(project / "table"),
        *arguments,
    ]
    # the project's tests are plain: pytest's plugins, which take longer than they do, stay away
    environment = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    done = ran(command, env=environment)
    assert "Traceback" not in done.stderr, done.stderr
    return done.returncode, done.stdout


@pytest.mark.parametrize(("change", "old", "new"), rows(__file__, "changes.txt"))
def test_a_change_makes_of_a_function_what_it_says(
    tool: Any, tmp_path: Path, change: str, old: str, new: str
) -> None:
    (tmp_path / "remodel_fenicsx").mkdir()
    lines = (text.replace("; ", "\n    ") for text in (old, new))
    before, after = (f"def f(x, y=()):\n    {text}\n" for text in lines)
    (tmp_path / "remodel_fenicsx" / "m.py").write_text(before)
    assert tool.changed(tool.Mutation("m:f", change, ()), tmp_path) == ast.unparse(ast.parse(after))


def test_every_change_has_a_row(tool: Any) -> None:
    assert {row[0].split()[0] for row in rows(__file__, "changes.txt")} == set(tool.CHANGES)


def test_a_survivor_is_named_and_the_project_stays(project: Path) -> None:
    before = {path: path.read_text() for path in project.rglob("*") if path.is_file()}
    status, said = mutate(project, "--only", "**", "--only", "unused")
    assert status == 1 and "0 of 2 killed" in said
    assert said.endswith(
        "survived: arithmetic:double operator * **\nsurvived: arithmetic:unused factor\n"
    )  # 2 ** 2 is 4
    assert before == {path: path.read_text() for path in project.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    "entry", ['"arithmetic:triple" = "factor"', '"arithmetic:double" = "sign"', '"arithmetic:double" = "number 2 2"',
              '"nothing:double" = "factor"', '"arithmetic:double" = "another"']
)  # fmt: skip
def test_what_is_not_there_is_said_and_nothing_runs(project: Path, entry: str) -> None:
    (project / "table" / "all.toml").write_text(f'["test_arithmetic.py"]\n{entry}\n')
    status, said = mutate(project)
    assert status == 1 and len(said.splitlines()) == 1 and entry.split('"')[1] in said


def test_the_table_fits_the_project() -> None:
    """Who takes away what a fault changes takes its entry away too."""
    done = ran([sys.executable, str(MUTATE), "--list"])
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(done.stdout.splitlines()) >= 250
