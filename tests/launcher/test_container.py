"""What the container image is made of, without a container engine: the files that .dockerignore lets through."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

PROJECT = Path(__file__).parents[2]
IGNORED = PROJECT / ".dockerignore"
# whatever is imported comes from beside this program, not from the checkout that the tests run in
IMPORT_ALL = """
import importlib, pathlib, pkgutil, sys
import remodel_fenicsx
assert pathlib.Path(remodel_fenicsx.__file__).parents[1] == pathlib.Path(sys.argv[1]), remodel_fenicsx.__file__
for module in pkgutil.walk_packages(remodel_fenicsx.__path__, "remodel_fenicsx."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
from remodel_fenicsx import cli
sys.exit(cli.main(sys.argv[2:]))
"""


def as_expression(pattern: str) -> str:
    """A pattern of .dockerignore as a regular expression, as Docker's own `patternmatcher` reads it."""
    parts = {"**/": "(?:.*/)?", "**": ".*", "*": "[^/]*", "?": "[^/]"}
    found = re.split(r"(\*\*/|\*\*|\*|\?|\[[^]]*\]|\\.)", pattern)
    words = (part if part.startswith("[") else re.escape(part.removeprefix("\\")) for part in found)
    return "".join(parts.get(part, word) for part, word in zip(found, words, strict=True))


def rules(text: str) -> list[tuple[re.Pattern[str], bool]]:
    """Of each line: what it speaks of, and whether that is let through (a line that begins with !)."""
    lines = [line.strip() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    cleaned = [(os.path.normpath(line.removeprefix("!").strip()).lstrip("/"), line.startswith("!")) for line in lines]
    return [(re.compile(as_expression(pattern)), kept) for pattern, kept in cleaned]


def judge(text: str) -> Callable[[str], bool]:
    """Whether a path is let through: the last line that speaks of it, or of a folder it lies in, decides."""
    known = rules(text)

    def is_kept(path: str) -> bool:
        parts = path.split("/")
        places = ["/".join(parts[: number + 1]) for number in range(len(parts))]
        spoken = [kept for expression, kept in known if any(map(expression.fullmatch, places))]
        return spoken[-1] if spoken else True

    return is_kept


def let_through(folder: Path) -> Iterator[str]:
    """The files of a folder that its .dockerignore lets through."""
    is_kept = judge((folder / ".dockerignore").read_text())
    for place, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if name != ".git"]
        paths = ((Path(place) / name).relative_to(folder).as_posix() for name in files)
        yield from filter(is_kept, paths)


def test_the_image_has_the_package_and_nothing_of_a_user(tmp_path: Path) -> None:
    """The tree that is let through, elsewhere: every module can be imported, and the cube runs."""
    tree, work = tmp_path / "tree", tmp_path / "work"
    paths = list(let_through(PROJECT))
    for path in paths:
        (tree / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(PROJECT / path, tree / path)
    for folder in ("remodel_fenicsx", "bin"):
        there = {path.relative_to(PROJECT).as_posix() for path in (PROJECT / folder).rglob("*") if path.is_file()}
        assert {path for path in there if "__pycache__" not in path} == {p for p in paths if p.startswith(folder)}
    command = [sys.executable, "-c", IMPORT_ALL, str(tree)]
    words = ["run", str(tree / "demos" / "cube.toml"), "--set", "time.end=2", "-o", str(work), "-q"]
    environment = {**os.environ, "PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [*command, *words], cwd=tmp_path, capture_output=True, text=True, env=environment, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert len((work / "history.csv").read_text().splitlines()) == 4


def test_what_runs_have_left_stays_out() -> None:
    is_kept = judge(IGNORED.read_text())
    mine = ["results/cube/history.csv", "demos/results/cube/history.csv", "meshes/results/x", "tests/run", ".git/HEAD",
            "figures/fig1.png", "remodel_fenicsx/fem/__pycache__/jit.pyc"]  # fmt: skip
    assert not [path for path in mine if is_kept(path)]


@pytest.mark.skipif(os.getuid() != 0, reason="only root builds the image")
@pytest.mark.parametrize(("engine", "words"), [
    ("docker", "echo 27.5"), ("podman", "true"), ("buildah", "true"),
    ("docker", "echo no daemon >&2; exit 1"), ("podman", "exit 125"), ("nothing", ""),
])  # fmt: skip
def test_a_client_alone_builds_no_image(engine: str, words: str, tmp_path: Path) -> None:
    """What .ci/run asks before it builds the image."""
    for name in ("bash", "dirname", "env", "id", "readlink", "unshare"):
        (tmp_path / name).symlink_to(str(shutil.which(name)))
    (tmp_path / engine).write_text(f"#!/bin/sh\n{words}\n")
    (tmp_path / engine).chmod(0o755)
    command = [str(PROJECT / "tests" / "container" / "run"), "--possible"]
    done = subprocess.run(command, env={"PATH": str(tmp_path)}, capture_output=True, text=True)
    possible = engine != "nothing" and "exit" not in words
    assert done.returncode == (0 if possible else 5)
    assert done.stderr == ("" if possible else "neither buildah, nor an engine that answers to podman or docker\n")
