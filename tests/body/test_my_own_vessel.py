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
SHORT = {"vessel.toml -o vessel": "vessel.toml -o vessel --set time.end=2.5", "--time 0 60": "--time 0 2.5"}


def commands() -> list[str]:
    text = (ROOT / "docs" / "my_own_vessel.md").read_text(encoding="utf-8")
    lines = "\n".join(re.findall(r"^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL)).splitlines()
    for words, short in SHORT.items():
        assert any(words in line for line in lines), words
        lines = [line.replace(words, short) for line in lines]
    return [line.replace("demos/", f"{ROOT}/demos/").removeprefix("./with-fenicsx ") for line in lines if line]


def test_the_page_leads_from_a_surface_to_angles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    along = np.degrees(np.arccos(np.clip((axes.cell_data["axis_a"][0] * tangent).sum(axis=1), -1, 1)))
    around = np.abs((axes.cell_data["axis_c"][0] * tangent).sum(axis=1))
    assert np.sqrt(np.mean(along**2)) < 4.0 and around.mean() < 0.05
    names, *_, last = (line.split(",") for line in Path("vessel/history.csv").read_text().splitlines())
    row = dict(zip(names, map(float, last), strict=True))
    assert row["fibre_angle_inner"] < row["fibre_angle_outer"] < 45.0
    assert meshio.read("fibres.vtu").cell_data["structure_tensor"][0].shape[1] in (6, 9)


SCRIPT = ROOT / "demos" / "own_vessel" / "mesh.py"


def written(path: Path, corners: np.ndarray) -> Path:
    """Triangles (n, 3, 3) as an STL file."""
    meshio.Mesh(corners.reshape(-1, 3), [("triangle", np.arange(corners.size // 3).reshape(-1, 3))]).write(path)
    return path


def open_tube() -> np.ndarray:
    """Triangles of a round surface of radius 1, length 4, normals outwards."""
    angles, heights = np.linspace(0, 2 * np.pi, 25), np.linspace(0, 4, 9)
    places = np.stack([np.broadcast_to(f(angles)[:, None], (25, 9)) for f in (np.cos, np.sin)], axis=-1)
    grid = np.concatenate([places, np.broadcast_to(heights, (25, 9))[..., None]], axis=-1).round(12)
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    return np.concatenate([np.stack(corners, axis=-2).reshape(-1, 3, 3) for corners in ((a, b, c), (a, c, d))])


def meshed(surface: Path, *more: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(SCRIPT), str(surface), str(surface.with_suffix(".msh"))]
    command += more or ("--thickness", "0.5", "--size", "0.6")
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize("turned", [1, -1])
def test_a_wall_is_outside_of_its_lumen_whichever_way_normals_point(tmp_path: Path, turned: int) -> None:
    """As after marching cubes, whose normals point inwards."""
    surface = written(tmp_path / "lumen.stl", open_tube()[:, ::turned])
    assert meshed(surface).returncode == 0
    mesh = meshio.read(surface.with_suffix(".msh"))
    for number, radius in ((1, 1.0), (2, 1.5)):
        faces = [
            b.data[g == number] for b, g in zip(mesh.cells, mesh.cell_data["gmsh:physical"]) if b.type == "triangle6"
        ]
        nodes = mesh.points[np.unique(np.concatenate(faces))]
        assert np.linalg.norm(nodes[:, :2], axis=1).mean() == pytest.approx(radius, rel=0.03)


def test_a_surface_that_is_no_open_one_gets_one_line(tmp_path: Path) -> None:
    """Closed by caps, not there, of another ending; a wall of no thickness."""
    tube = open_tube()
    rims = [(tube[np.isclose(tube[..., 2], z).sum(axis=1) == 2], z) for z in (0.0, 4.0)]
    caps = []
    for rim, z in rims:
        ends = np.array([[corner for corner in one if np.isclose(corner[2], z)] for one in rim])
        caps.append(np.concatenate([ends, np.broadcast_to([[[0.0, 0.0, z]]], (len(ends), 1, 3))], axis=1))
    closed = written(tmp_path / "closed.stl", np.concatenate([tube, *caps]))
    for done, words in (
        (meshed(closed), "closed.stl has no open end: cut its ends"),
        (meshed(tmp_path / "none.stl"), "none.stl: needed is an STL file that is there"),
        (meshed(tmp_path / "lumen.ply"), "lumen.ply: needed is an STL file"),
        (meshed(closed, "--thickness", "0", "--size", "1"), "must be above 0"),
    ):
        assert done.returncode == 2 and words in done.stderr and "Traceback" not in done.stderr
