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


def test_the_bent_vessel_says_nothing_at_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = [sys.executable, str(DEMOS / "bent_vessel" / "mesh.py"), str(tmp_path / "bent.msh")]
    subprocess.run(line, check=True, capture_output=True, timeout=120)
    path, few = shutil.copy(DEMOS / "bent_vessel" / "scene.toml", tmp_path), [
        "--set",
        "time.end=1",
        "-q",
    ]
    assert (
        cli.main(["validate", path])
        == cli.main(["run", path, "-o", str(tmp_path / "run"), *few])
        == 0
    )
    said = capsys.readouterr()
    assert "WARNING" not in said.out + said.err + (tmp_path / "run" / "run.log").read_text()


def test_the_forks_axes_follow_its_legs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Away from the fork the axial direction is that of the leg; layers and depth agree; nothing is doubtful."""
    line = [sys.executable, str(DEMOS / "fork" / "mesh.py"), str(tmp_path / "fork.msh")]
    subprocess.run(line, check=True, capture_output=True, timeout=120)
    out, scene = tmp_path / "axes.vtu", shutil.copy(DEMOS / "fork" / "scene.toml", tmp_path)
    assert cli.main(["axes", scene, "-o", str(out)]) == 0
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
    assert cli.main(["validate", scene]) == 0
    said = capsys.readouterr()
    assert "WARNING" not in said.out + said.err
