"""Scripts need no more of the package than the public interface (docs/interface.md: test_documentation.py)."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from remodel_fenicsx import cli

ROOT = Path(__file__).parents[2]
PUBLIC = {"remodel_fenicsx", "remodel_fenicsx.parts", "remodel_fenicsx.extend"}
EXTENSIONS = [
    str(path.relative_to(ROOT)) for path in sorted((ROOT / "demos" / "extensions").glob("*.py"))
]


def imported(source: str) -> list[str]:
    """Modules of the package that a script imports, one for each import."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            modules = [
                name for name in names if name in PUBLIC
            ]  # from remodel_fenicsx import parts
            found += modules or [str(node.module)]
    return [name for name in found if name.partition(".")[0] == "remodel_fenicsx"]


@pytest.mark.parametrize("name", ["demos/artery.py", "demos/cube.py", "demos/tendon.py"])
def test_a_demo_needs_one_import(name: str) -> None:
    source = (ROOT / name).read_text(encoding="utf-8")
    assert imported(source) == ["remodel_fenicsx.parts"]
    assert len(source.splitlines()) < 80


@pytest.mark.parametrize(
    "name",
    [
        "README.md",
        "CONTRIBUTING.md",
        "docs/commands.md",
        "demos/figures.py",
        "tests/body/test_extensions.py",
        *EXTENSIONS,
    ],
)
def test_what_users_are_shown_imports_public_names(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    sources = (
        [text] if name.endswith(".py") else re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    )
    found = {module for source in sources for module in imported(source)}
    assert found and found <= PUBLIC


def test_the_table_of_exit_codes_has_those_of_the_command() -> None:
    rows = re.search(
        r"\| exit code \|.*?\n\n",
        (ROOT / "docs" / "commands.md").read_text(encoding="utf-8"),
        re.DOTALL,
    )
    assert rows is not None
    codes = [
        int(code)
        for row in rows[0].splitlines()[2:]
        if row
        for code in row.split("|")[1].split(",")
    ]
    assert codes == list(cli.EXIT_CODES)
