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


def test_its_run_keeps_the_mesh_and_goes_on_without_the_first(vessel: Path, tmp_path: Path) -> None:
    """A run of two steps, then two more from its folder alone, are four steps."""
    here, place = tmp_path / "scene", tmp_path / "run"
    shutil.copytree(vessel, here)
    few = ["--set", "output.fields=false", "-q"]
    assert cli.main(["run", str(here / "scene.toml"), "-o", str(place), "--set", "time.end=2", *few]) == 0
    assert cli.main(["run", str(here / "scene.toml"), "-o", str(tmp_path / "all"), "--set", "time.end=4", *few]) == 0
    shutil.rmtree(here)
    assert cli.main(["run", "--resume", str(place), "--set", "time.end=4", *few]) == 0
    rows = [(tmp_path / name / "history.csv").read_text().splitlines() for name in ("run", "all")]
    physics = rows[0][0].split(",").index("newton_iterations")  # what follows is how it was solved
    ends = [np.array([float(value) for value in lines[-1].split(",")[:physics]]) for lines in rows]
    assert len(rows[0]) == len(rows[1]) and np.allclose(*ends, rtol=1e-8, atol=1e-9)
    assert "WARNING" not in (place / "run.log").read_text()


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
