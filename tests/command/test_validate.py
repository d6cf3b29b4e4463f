"""`validate` opens the files that a scene names: what `run` refuses before its first solve, it refuses too."""

from __future__ import annotations

import csv
import tomllib
from pathlib import Path
from typing import Any

import pytest
import tomlkit

from remodel_fenicsx import cli, initial
from tests.conftest import Refused
from tests.mesh_files import changed


@pytest.fixture(scope="module")
def tube(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """48 hexahedra with fibres beside them: a row for each element, and some that are far away."""
    folder = tmp_path_factory.mktemp("tube")
    file = changed(folder / "tube.msh")
    changed(folder / "twice.msh", ("$Elements\n128\n", "$Elements\n129\n9999 3 2 2 1 1 17 81 2\n"))
    (folder / "folder.msh").mkdir()
    (folder / "fibres.txt").write_text("angle\n30\n")
    (folder / "short.csv").write_text("angle\n30\n")
    (folder / "broken.vtu").write_text("<VTKFile>")
    for name, away in (("near.csv", 0.0), ("far.csv", 100.0)):
        with (folder / name).open("w", newline="") as table:
            rows = csv.writer(table)
            rows.writerow(["x", "y", "z", "angle"])
            rows.writerows(
                [x + away, y, z, 30]
                for x in (-1.5, 0, 1.5)
                for y in (-1.5, 0, 1.5)
                for z in (0.5, 1.5, 2.5)
            )
    return file


def written(tube: Path, tables: dict[str, Any]) -> Path:
    """A scene of these tables beside the mesh."""
    scene = {"time": {"end": 1.0, "step": 1.0}, **tables}
    scene["geometry"] = {"shape": "mesh", "file": tube.name, **tables.get("geometry", {})}
    path = tube.parent / "scene.toml"
    path.write_text(tomlkit.dumps(scene))
    return path


BAD = tomllib.loads((Path(__file__).parent / "scenes_of_bad_files.toml").read_text())


@pytest.mark.parametrize("case", BAD)
def test_what_run_refuses_validate_refuses(tube: Path, case: str, refused: Refused) -> None:
    """The same line, exit code 2, and nothing is written."""
    tables = dict(BAD[case])
    words = tables.pop("said")
    scene, out = written(tube, tables), tube.parent / "out"
    before = {*tube.parent.iterdir()}
    said = refused("validate", scene)
    assert words in said and refused("run", scene, "-o", out) == said
    assert {*tube.parent.iterdir()} == before


def test_files_that_fit_are_valid(tube: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["validate", str(written(tube, {"cells": {"fibres": "near.csv"}}))]) == 0
    assert "a valid scene" in (said := capsys.readouterr().out) and "not checked" not in said


@pytest.mark.parametrize(
    ("limit", "words"),
    [
        ("ELEMENTS_OF_A_LOOK", "not checked: how files fit the body of 48 elements"),
        ("LARGEST_LOOK", "not checked: cells.fibres"),
    ],
)
def test_what_would_take_long_is_said(
    tube: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    limit: str,
    words: str,
    refused: Refused,
) -> None:
    """Files that are not there are found nevertheless."""
    monkeypatch.setattr(initial, limit, 10)
    assert cli.main(["validate", str(written(tube, {"cells": {"fibres": "far.csv"}}))]) == 0
    assert words in capsys.readouterr().out
    refused("validate", written(tube, {"cells": {"fibres": "none.csv"}}))
