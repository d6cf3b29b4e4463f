"""The demos with a mesh of their own: their scripts make what their scenes ask for."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import meshio
import numpy as np
import pytest

from remodel_fenicsx import cli

DEMOS = Path(__file__).parents[2] / "demos"
DEMO = DEMOS / "bent_vessel"


@pytest.fixture(scope="module")
def vessel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the scene with its mesh."""
    folder = tmp_path_factory.mktemp("bent")
    shutil.copy(DEMO / "scene.toml", folder)
    line = [sys.executable, str(DEMO / "mesh.py"), str(folder / "vessel.msh")]
    subprocess.run(line, check=True, capture_output=True, timeout=120)
    return folder


def test_its_scene_is_valid_and_says_its_loads(vessel: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["validate", str(vessel / "scene.toml")]) == 0
    said = capsys.readouterr()
    assert "WARNING" not in said.out + said.err


def test_its_first_steps_say_nothing(vessel: Path, tmp_path: Path) -> None:
    few = ["--set", "time.end=2", "--set", "output.fields=false", "-q"]
    assert cli.main(["run", str(vessel / "scene.toml"), "-o", str(tmp_path / "run"), *few]) == 0
    assert "WARNING" not in (tmp_path / "run" / "run.log").read_text()


# ---------------------------------------------------------------- the fork


@pytest.fixture(scope="module")
def fork(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the scene with its mesh."""
    folder = tmp_path_factory.mktemp("fork")
    shutil.copy(DEMOS / "fork" / "scene.toml", folder)
    line = [sys.executable, str(DEMOS / "fork" / "mesh.py"), str(folder / "fork.msh")]
    subprocess.run(line, check=True, capture_output=True, timeout=120)
    return folder


def test_the_forks_axes_follow_its_legs(fork: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Away from the fork the axial direction is that of the leg; layers and depth agree; nothing is doubtful."""
    out = fork / "axes.vtu"
    assert cli.main(["axes", str(fork / "scene.toml"), "-o", str(out)]) == 0
    body = meshio.read(out)
    axial, depth, region = (body.cell_data[name][0] for name in ("axis_a", "depth", "region"))
    middle = body.points[body.cells[0].data[:, :4]].mean(axis=1)
    angle = np.radians(25.0)
    left, right = (np.array([side * np.sin(angle), 0.0, np.cos(angle)]) for side in (-1, 1))
    for direction, along in (([0, 0, -1], [0, 0, 1]), (left, left), (right, right)):
        far = (middle @ np.array(direction) > 4.5) & (middle[:, 0] * direction[0] >= 0)
        off = np.degrees(np.arccos(np.clip(axial[far] @ np.array(along), -1, 1)))
        assert far.sum() > 100 and np.sqrt(np.mean(off**2)) < 2.0
    inside = region == region[depth.argmin()]
    assert 0.1 < inside.mean() < 0.9 and depth[inside].mean() < 0.4 < 0.6 < depth[~inside].mean()
    assert cli.main(["validate", str(fork / "scene.toml")]) == 0
    said = capsys.readouterr()
    assert "WARNING" not in said.out + said.err
