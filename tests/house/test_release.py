"""What is released: wheel and sdist, and the version that citation and image say."""

from __future__ import annotations

import os
import re
import shutil
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

from remodel_fenicsx import __version__
from tests.processes import ran

ROOT = Path(__file__).parents[2]
ASSETS = ROOT / "remodel_fenicsx" / "report" / "assets"
PRESET = "kuhl-holzapfel-2007"
VENDORED = tomllib.loads((ASSETS / "VENDOR.toml").read_text(encoding="utf-8"))["package"]


def test_citation_image_and_change_log_say_the_version() -> None:
    assert f"\nversion: {__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    first, second, *_ = re.findall(r"^## (.*)$", changes, re.MULTILINE)
    newest = second if first == f"After {__version__}" else first
    assert newest in (__version__, f"{__version__} (unreleased)")
    labels = dict(
        re.findall(
            r'org\.opencontainers\.image\.(\w+)="([^"]*)"', (ROOT / "Dockerfile").read_text()
        )
    )
    assert (
        labels["version"] == __version__
        and labels["licenses"] == "MIT"
        and labels["title"]
        and labels["description"]
    )


def test_the_licences_of_what_others_have_written_are_named() -> None:
    """Of what is in every report: in the README, with a copyright line in a file of its own."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert {package["name"] for package in VENDORED} == {"three", "uplot"}
    for package in VENDORED:
        assert package["licence"] in readme and package["licence_file"] in readme
        assert "Copyright" in (ASSETS / package["licence_file"]).read_text(encoding="utf-8")


def test_the_package_is_built_and_installed_beside_a_dolfinx(tmp_path: Path) -> None:
    """The sdist, the wheel from it, and the wheel in an environment that sees this Python's packages."""
    pytest.importorskip("build", reason="no python3-build")
    pytest.importorskip("ensurepip", reason="no python3-venv")
    source = tmp_path / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    shutil.copytree(
        ROOT / "remodel_fenicsx",
        source / "remodel_fenicsx",
        ignore=shutil.ignore_patterns("__pycache__"),
    )

    alone = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def call(*words: str | Path) -> str:
        done = ran(words, cwd=tmp_path, env=alone)
        assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-1000:]
        return done.stdout

    call(sys.executable, "-m", "build", "--no-isolation", "-o", tmp_path / "dist", source)
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    (sdist,) = (tmp_path / "dist").glob("*.tar.gz")
    needed = {f"kernels/{name}" for name in ("spectral.c", "algebra.h", "principal.h")}
    needed |= {"py.typed", "report/assets/template.html"}
    with zipfile.ZipFile(wheel) as archive:
        assert {f"remodel_fenicsx/{name}" for name in needed} <= set(archive.namelist())
        (place,) = (name for name in archive.namelist() if name.endswith("/METADATA"))
        metadata = archive.read(place).decode()
    assert "\nLicense-Expression: MIT\n" in metadata
    assert len(re.findall(r"^License-File: .*LICENSE", metadata, re.MULTILINE)) == 1 + len(VENDORED)
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
        assert {f"remodel_fenicsx/{name}" for name in needed} | {"LICENSE", "README.md"} <= names
    call(sys.executable, "-m", "venv", "--system-site-packages", tmp_path / "venv")
    call(tmp_path / "venv/bin/python", "-m", "pip", "install", "--no-index", "--no-deps", wheel)
    (tmp_path / "cube.toml").write_text(
        call(tmp_path / "venv/bin/remodel-fenicsx", "new", PRESET, "--shape", "cube")
    )
    call(
        tmp_path / "venv/bin/remodel-fenicsx",
        "run",
        "cube.toml",
        "-q",
        "--set",
        "time.end=1",
        "-o",
        "cube",
    )
    assert f"remodel_fenicsx {__version__}\n" in (tmp_path / "cube" / "scene.toml").read_text()
    assert (tmp_path / "cube" / "report.html").stat().st_size > 100_000
