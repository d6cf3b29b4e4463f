"""docs/my_own_vessel.md: each of its commands is run in its order, the run and the picture in a short form."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import meshio
import numpy as np
import pytest

from remodel_fenicsx import cli

ROOT = Path(__file__).parents[2]
SHORT = {
    "--size 0.9": "--size 1.0",
    "vessel.toml -o vessel": "vessel.toml -o vessel --set time.end=2.5",
    "--time 0 60": "--time 0 2.5",
}


def commands() -> list[str]:
    text = (ROOT / "docs" / "my_own_vessel.md").read_text(encoding="utf-8")
    lines = "\n".join(re.findall(r"^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL)).splitlines()
    for words, short in SHORT.items():
        assert any(words in line for line in lines), words
        lines = [line.replace(words, short) for line in lines]
    return [
        line.replace("demos/", f"{ROOT}/demos/").removeprefix("./with-fenicsx ")
        for line in lines
        if line
    ]


def test_the_page_leads_from_a_surface_to_angles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is doubtful; axes go around and along; fibres turn towards the circumference."""
    monkeypatch.chdir(tmp_path)
    for line in commands():
        program, *words = shlex.split(line)
        if program == "remodel-fenicsx":
            if words[0] != "picture":  # a window of its own, tested elsewhere
                assert cli.main(words) == 0, line
        elif program == "cp":
            shutil.copy(*words)
        else:
            assert program == "python3"
            subprocess.run([sys.executable, *words], check=True, capture_output=True, timeout=120)
    assert "WARNING" not in Path("vessel/run.log").read_text()
    axes = meshio.read("axes.vtu")
    middle = axes.points[axes.cells[0].data[:, :4]].mean(axis=1)
    turn = np.arctan2(middle[:, 2], middle[:, 0] + 14.0 / np.radians(45.0))
    tangent = np.stack([-np.sin(turn), 0 * turn, np.cos(turn)], axis=1)
    along = np.degrees(
        np.arccos(np.clip((axes.cell_data["axis_a"][0] * tangent).sum(axis=1), -1, 1))
    )
    around = np.abs((axes.cell_data["axis_c"][0] * tangent).sum(axis=1))
    assert np.sqrt(np.mean(along**2)) < 4.0 and around.mean() < 0.05
    names, *_, last = (
        line.split(",") for line in Path("vessel/history.csv").read_text().splitlines()
    )
    row = dict(zip(names, map(float, last), strict=True))
    assert row["fibre_angle_inner"] < row["fibre_angle_outer"] < 45.0
    assert meshio.read("fibres.vtu").cell_data["structure_tensor"][0].shape[1] in (6, 9)
