"""Reading results back: what a folder holds, and what is said of one that does not hold it."""

from __future__ import annotations

import os
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from remodel_fenicsx.results import run_folder
from remodel_fenicsx import Recording
from remodel_fenicsx.results.recording import RecordingError
from remodel_fenicsx.results.vtkhdf import TransientGrid
from remodel_fenicsx.scene.scene import Scene, scene_from_dict
from tests.processes import ran

POINTS = np.array(
    [[x, y, z] for z in (0, 1, 2) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))], dtype=float
)
ELEMENTS = np.array([np.arange(8), np.arange(4, 12)])
TIMES = (0.0, 1.0, 2.0)


def scene() -> Scene:
    """The scene of the recording."""
    return scene_from_dict(
        {"name": "two", "preset": "kuhl-holzapfel-2007", "geometry": {"shape": "tendon"}}
    )


def displacement(time: float) -> np.ndarray:
    """At the nodes."""
    return 0.125 * time * POINTS


def tensor(time: float) -> np.ndarray:
    """In the elements."""
    return np.arange(18.0).reshape(2, 9) + time


def write_step(grid: TransientGrid, time: float) -> None:
    """As a run does."""
    grid.append(
        time,
        {"displacement": displacement(time)},
        {"fibre_angle": [time, 2.0], "stress": tensor(time)},
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """What a run leaves: two elements, three times."""
    (tmp_path / "scene.toml").write_text(
        scene().to_toml("as run\nremodel_fenicsx 9.8.7\nsystem a b c")
    )
    (tmp_path / "history.csv").write_text(
        "time,force,substeps,pass_residual\n1.0,0.1,1,\n2.0,0.30000000000000004,3,0.5\n"
    )
    with TransientGrid(tmp_path / "fields.vtkhdf", POINTS, ELEMENTS, 12) as grid:
        for time in TIMES:
            write_step(grid, time)
    return tmp_path


def test_everything_of_a_run_is_read_back(folder: Path) -> None:
    recording = Recording(str(folder))
    assert recording.path == folder
    assert recording.scene == scene()
    assert recording.versions == {"remodel_fenicsx": "9.8.7", "system": "a b c"}
    assert list(recording.history) == ["time", "force", "substeps", "pass_residual"]
    assert recording.history["force"].tolist() == [0.1, 0.30000000000000004]
    np.testing.assert_array_equal(recording.history["pass_residual"], [np.nan, 0.5])
    assert recording.value("substeps", 2.0) == 3.0
    assert recording.times.tolist() == [*TIMES]
    np.testing.assert_array_equal(recording.points, POINTS)
    np.testing.assert_array_equal(recording.elements, ELEMENTS)
    for time in TIMES:
        fields = recording.fields(time)
        assert set(fields) == {"displacement", "fibre_angle", "stress"}
        np.testing.assert_array_equal(fields["displacement"], displacement(time))
        np.testing.assert_array_equal(fields["fibre_angle"], [time, 2.0])
        np.testing.assert_array_equal(fields["stress"], tensor(time))


def test_a_time_or_column_that_is_not_there_is_named_with_those_that_are(folder: Path) -> None:
    recording = Recording(folder)
    for ask, words in (
        (lambda: recording.fields(1.5), "time 1.5; recorded are 0, 1, 2"),
        (lambda: recording.value("force", 0.0), "time 0; recorded are 1, 2"),
        (
            lambda: recording.value("radius", 1.0),
            "'radius'; there are time, force, substeps, pass_residual",
        ),
    ):
        with pytest.raises(RecordingError, match=f"{words}$"):
            ask()


def test_a_run_under_way_is_read(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(scene().to_toml())
    history = run_folder.History(tmp_path / "history.csv")
    assert Recording(tmp_path).history["time"].shape == (0,)
    assert Recording(tmp_path).times.shape == (0,)
    with TransientGrid(tmp_path / "fields.vtkhdf", POINTS, ELEMENTS, 12) as grid:
        grid.close()
        assert Recording(tmp_path).times.shape == (0,)
        for count, time in enumerate(TIMES, start=1):
            write_step(grid, time)
            grid.close()
            history.append({"time": time, "force": 2 * time})
            recording = Recording(tmp_path)
            assert recording.times.tolist() == [*TIMES[:count]]
            assert recording.history["force"].tolist() == [2 * time for time in TIMES[:count]]
            np.testing.assert_array_equal(
                recording.fields(time)["displacement"], displacement(time)
            )
    history.close()


def test_the_history_as_a_frame(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pandas = pytest.importorskip("pandas")
    frame = Recording(folder).history.frame()
    assert isinstance(frame, pandas.DataFrame)
    assert frame.loc[1, "force"] == 0.30000000000000004 and list(frame.columns)[0] == "time"
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="needs pandas"):
        Recording(folder).history.frame()


# ---------------------------------------------------------------- what is no recorded run


def test_what_is_no_folder_of_a_run_is_refused(
    folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    other = tmp_path_factory.mktemp("other")
    for path, words in (
        (other / "nowhere", "no such folder"), (folder / "history.csv", "is a file"), (other, "no scene.toml")
    ):  # fmt: skip
        with pytest.raises(RecordingError, match=words):
            Recording(path)


def test_a_scene_of_another_kind_is_damage_of_the_folder(folder: Path) -> None:
    (folder / "scene.toml").write_text("[tool.black]\n")
    assert Recording(folder).history["time"].tolist() == [1.0, 2.0]
    with pytest.raises(RecordingError, match=rf"^{folder}/scene\.toml: geometry\.shape: missing"):
        _ = Recording(folder).scene


# ---------------------------------------------------------------- on a laptop

WITHOUT_DOLFINX = """
import sys
for name in ("dolfinx", "mpi4py", "petsc4py", "basix", "ufl", "gmsh", "matplotlib"):
    sys.modules[name] = None  # importing it is an error
"""


def test_the_page_shows_what_reads_results_without_dolfinx(
    folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    page = (Path(__file__).parents[2] / "docs" / "commands.md").read_text(encoding="utf-8")
    (code,) = [
        block
        for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL)
        if "Recording(" in block
    ]
    place = tmp_path_factory.mktemp("place")
    shutil.copytree(folder, place / "results" / "artery")
    environment = os.environ | {"PYTHONPATH": str(Path(run_folder.__file__).parents[2])}
    command = [sys.executable, "-c", WITHOUT_DOLFINX + code]
    done = ran(command, cwd=place, env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{scene().time.end} 2.0 (2, 8, 3) 2.0\n"
