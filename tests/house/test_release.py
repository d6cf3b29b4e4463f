"""What is released: wheel and sdist, and the version that citation and image say."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from remodel_fenicsx import __version__

ROOT = Path(__file__).parents[2]


def test_citation_and_image_say_the_version() -> None:
    assert f"\nversion: {__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    labels = dict(re.findall(r'org\.opencontainers\.image\.(\w+)="([^"]*)"', (ROOT / "Dockerfile").read_text()))
    assert (
        labels["version"] == __version__ and labels["licenses"] == "MIT" and labels["title"] and labels["description"]
    )


def test_the_package_is_built_and_installed_beside_a_dolfinx(tmp_path: Path) -> None:
    """The sdist, the wheel from it, and the wheel in an environment that sees this Python's packages."""
    pytest.importorskip("build", reason="no python3-build")
    pytest.importorskip("ensurepip", reason="no python3-venv")
    source = tmp_path / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    shutil.copytree(ROOT / "remodel_fenicsx", source / "remodel_fenicsx", ignore=shutil.ignore_patterns("__pycache__"))

    alone = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def call(*words: str | Path) -> str:
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=200, env=alone)
        assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-1000:]
        return done.stdout

    call(sys.executable, "-m", "build", "--no-isolation", "-o", tmp_path / "dist", source)
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    (sdist,) = (tmp_path / "dist").glob("*.tar.gz")
    needed = {"py.typed", "kernels/spectral.c", "kernels/algebra.h", "report/assets/template.html"}
    with zipfile.ZipFile(wheel) as archive:
        assert {f"remodel_fenicsx/{name}" for name in needed} <= set(archive.namelist())
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
        assert {f"remodel_fenicsx/{name}" for name in needed} | {"LICENSE", "README.md"} <= names
    call(sys.executable, "-m", "venv", "--system-site-packages", tmp_path / "venv")
    call(tmp_path / "venv/bin/python", "-m", "pip", "install", "--no-index", "--no-deps", wheel)
    assert __version__ in call(tmp_path / "venv/bin/remodel-fenicsx", "info")
    assert "[geometry]" in call(tmp_path / "venv/bin/remodel-fenicsx", "new", "consistent", "--shape", "tube")
