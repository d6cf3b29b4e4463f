"""`Recording` in scripts and notebooks: its page, its grid and plot in PyVista, its pictures; the artery's notebook."""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from remodel_fenicsx import Recording, RecordingError
from remodel_fenicsx.results.recording import ANGLE_COLOURS
from tests.forks import forked
from tests.report.conftest import DEMOS, Recorded

NOTEBOOK = DEMOS / "artery.ipynb"
# on a display: a VTK that knows only X ends its process where there is none
PLOT = """
import sys, json
import numpy as np, pyvista
from remodel_fenicsx import Recording
pyvista.OFF_SCREEN = True
folder, target, options = sys.argv[1], sys.argv[2], json.loads(sys.argv[3])
plotter = Recording(folder).plot(**options)
plotter.camera_position = "xz"
np.save(target, plotter.screenshot(return_img=True, window_size=(400, 400)))
"""


def plotted(
    recording: Recording, target: Path, display: dict[str, str], **options: Any
) -> np.ndarray:
    """What the plotter shows, (400, 400, 3)."""
    words = PLOT, recording.path, target, json.dumps(options)
    done = forked("python", *words, variables=os.environ | display, imports=("pyvista.plotting",))
    assert done.returncode == 0, done.stderr
    return np.load(target)[..., :3]


def black(pixels: np.ndarray) -> int:
    return int((pixels.max(axis=-1) < 60).sum())


# ---------------------------------------------------------------- the page in a notebook
def test_a_notebook_shows_the_page_in_a_frame_that_reaches_nothing(recorded: Recorded) -> None:
    recording = Recording(recorded("cube"))
    html = recording._repr_html_()
    found = re.fullmatch(
        r'<iframe srcdoc="([^"]*)" sandbox="([a-z -]*)" [^<>]*></iframe>', html, re.DOTALL
    )
    assert found is not None
    assert found[2].split() == [
        "allow-scripts",
        "allow-downloads",
    ]  # no origin that it shares with the notebook
    page = unescape(found[1])
    assert (
        page == recording.report(recording.path.parent / "cube-in-a-notebook.html").read_text()
    )  # below 5 MB
    assert repr(recording) == f"Recording({str(recording.path)!r})"


# ---------------------------------------------------------------- the grid
@pytest.mark.parametrize("name", ["artery", "tetrahedra", "quadratic"])
def test_the_grid_has_what_was_recorded(recorded: Recorded, name: str) -> None:
    recording = Recording(recorded(name))
    for time in (None, float(recording.times[0])):
        grid = recording.grid(time)
        fields = recording.fields(float(recording.times[-1]) if time is None else time)
        displacement = fields.pop("displacement")
        assert set(grid.cell_data) == {"layer", *fields}
        for field, values in fields.items():
            np.testing.assert_array_equal(grid.cell_data[field], values)
        corners = {
            tuple(place): moved for place, moved in zip(recording.points, displacement, strict=True)
        }
        found = [corners[tuple(place)] for place in np.asarray(grid.points, dtype=float)]
        np.testing.assert_array_equal(grid.point_data["displacement"], found)
    volume = np.prod(np.ptp(recording.points, axis=0))  # of cubes
    if name != "artery":
        assert grid.volume == pytest.approx(volume, rel=1e-12)


@pytest.mark.parametrize("name", ["radial", "axisymmetric", "sector"])
def test_the_grid_of_a_reduction_is_the_whole_tube(recorded: Recorded, name: str) -> None:
    grid = Recording(recorded(name)).grid()
    assert (grid.compute_cell_sizes()["Volume"] > 0).all()
    assert grid.volume == pytest.approx(np.pi * (3**2 - 1**2) * 8, rel=0.03)  # faceted
    deformed = grid.warp_by_vector("displacement")
    radius = np.linalg.norm(np.asarray(deformed.points)[:, :2], axis=1)
    assert radius.min() == pytest.approx(
        Recording(recorded(name)).history["inner_radius"][-1], rel=1e-4
    )


# ---------------------------------------------------------------- plot and screenshot
def test_a_plot_has_the_colours_and_the_chains_of_all_pictures(
    recorded: Recorded, tmp_path: Path, display: dict[str, str]
) -> None:
    recording = Recording(recorded("artery"))
    with_chains = plotted(recording, tmp_path / "chains.npy", display)
    without = plotted(
        recording,
        tmp_path / "none.npy",
        display,
        chains=False,
        show_edges=False,
        show_scalar_bar=False,
    )
    body = without[(without < 250).any(axis=-1)].astype(float)
    assert 0.05 < len(body) / without[..., 0].size < 0.95
    # every colour is one of the scale, as bright as its face is lit
    hue = body / np.linalg.norm(body, axis=1, keepdims=True)
    scale = np.array([to_rgb(colour) for colour in ANGLE_COLOURS])
    scale /= np.linalg.norm(scale, axis=1, keepdims=True)
    distance = np.linalg.norm(hue[:, None] - scale[None], axis=2).min(axis=1)
    assert np.quantile(distance, 0.95) < 0.03
    assert black(with_chains) > 5 * black(without) + 200


def test_a_plot_shows_the_deformed_body(recorded: Recorded) -> None:
    """Its bounds: making a plotter opens no window."""
    recording = Recording(recorded("tendon"))
    plotter = recording.plot(chains=False)
    deformed = recording.points + recording.fields(float(recording.times[-1]))["displacement"]
    bounds = np.reshape(list(plotter.bounds), (3, 2)).T
    np.testing.assert_allclose(
        bounds, [deformed.min(axis=0), deformed.max(axis=0)], rtol=1e-6, atol=1e-6
    )


@pytest.mark.parametrize(
    "options, words",
    [({"time": 2.5}, "time 2.5"), ({"name": "stress"}, "no field 'stress'"), ({"layers": 9}, "layers 9: "),
     ({"elements": [True]}, "a mask of all 1536"), ({"cut": "all"}, "cut all: ")],
)  # fmt: skip
def test_what_cannot_be_shown_is_one_line(
    recorded: Recorded, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(ValueError, match=words) as error:
        Recording(recorded("artery")).plot(**options)
    assert "\n" not in str(error.value)


def test_without_fields_there_is_no_body(recorded: Recorded) -> None:
    recording = Recording(recorded("without fields"))
    for show in (recording.grid, recording.plot):
        with pytest.raises(RecordingError, match="recorded no fields"):
            show()
    assert "<iframe" in recording._repr_html_()


@pytest.mark.usefixtures("drawn_by_forks")
def test_a_screenshot_is_the_picture_of_the_command(recorded: Recorded, tmp_path: Path) -> None:
    path = Recording(recorded("cube")).screenshot(tmp_path / "cube.png", [0.0, 10.0], view="above")
    assert path.read_bytes().startswith(b"\x89PNG")
    recording = Recording(recorded("cube"))
    for said, wish in (
        (".*cube.png: already exists", {}),
        ("view behind: must be", {"view": "behind"}),
    ):
        with pytest.raises(ValueError, match=f"^{said}"):  # by the arguments of this method
            recording.screenshot(**{"path": tmp_path / "new.png" if wish else path} | wish)


# ---------------------------------------------------------------- the notebook
@pytest.mark.usefixtures("drawn_by_forks")
def test_the_notebook_of_the_artery_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cell by cell as a kernel does it: the last expression of a cell is shown."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(DEMOS / "artery.toml", tmp_path)
    kept = json.loads(NOTEBOOK.read_text())["cells"]
    cells = ["".join(cell["source"]) for cell in kept if cell["cell_type"] == "code"]
    assert cells[0].startswith("end = 150.0")
    names: dict[str, Any] = {}
    shown = []
    for source in ["end = 2.0", *cells[1:]]:
        tree = ast.parse(source)
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, str(NOTEBOOK), "exec"), names)
        if isinstance(last, ast.Expr):
            shown.append(eval(compile(ast.Expression(last.value), str(NOTEBOOK), "eval"), names))
    recording, table, _, picture = shown
    assert "<iframe" in recording._repr_html_() and recording.times[-1] == 2.0
    assert len(table) == 1 and recording.history["pressure"][-1] == pytest.approx(4.8 * 2 / 25)
    assert picture.exists() and not any(cell.get("outputs") for cell in kept)
