"""The command `figures`: names, validity of recorded runs, data against closed forms, pictures in space."""

from __future__ import annotations

import dataclasses
import importlib.util
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import time as clock
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

import remodel_fenicsx
from remodel_fenicsx import cli
from remodel_fenicsx.body.columns import columns_of
from remodel_fenicsx.paper import FIGURES, curves, runs
from remodel_fenicsx.paper.runs import LOAD_CASES
from remodel_fenicsx.pictures import bodies, rendering
from remodel_fenicsx.results import vtkhdf
from remodel_fenicsx import Recording
from remodel_fenicsx.results.recording import RecordingError, steps_recorded
from remodel_fenicsx.scene.scene import Scene, scene_from_dict
from remodel_fenicsx.studies import page
from remodel_fenicsx.studies.page import FigureError
from tests import forks
from tests.conftest import forked_children

PACKAGE = Path(remodel_fenicsx.__file__).parent
TINY = {
    "name": "tiny",
    "preset": "kuhl-holzapfel-2007",
    "geometry": {"shape": "tendon"},
    "time": {"end": 2.0},
}


# ---------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["fig12"], "figures fig12: no such figure; allowed are fig1, fig5, fig6, fig7, fig8, fig9, fig10, fig11, "),
        (["fig1", "Fig5"], "figures Fig5: no such figure; allowed are fig1, "),
        (["fig1", "--format", "png,jpg"], "--format jpg: no such format; allowed are png, pdf, svg"),
        (["fig1", "--jobs", "0"], "--jobs 0: must be at least 1"),
        (["fig1", "-o", "taken"], "-o taken: is a file; allowed is a folder"),
        (["fig1", "--runs", "taken"], "--runs taken: is a file; allowed is a folder"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(
    arguments: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("taken").write_text("")
    assert cli.main(["figures", *arguments]) == 2
    message = capsys.readouterr().err
    assert message.startswith(f"remodel-fenicsx: {said}") and message.count("\n") == 1
    assert os.listdir() == ["taken"]


def test_every_name_of_the_contract_is_there() -> None:
    assert list(FIGURES) == ["fig1", *(f"fig{n}" for n in range(5, 12)), "rate", "energy"]
    known = runs.scenes()
    assert {run for figure in FIGURES.values() for run in figure.runs} == set(known)
    assert all(scene.name == name for name, scene in known.items())


@pytest.mark.parametrize("name", ["fig1.png", "fig1.pdf", "fig1.svg", "fig1.csv", "fig1-mine.csv", "fig1.json"])
def test_a_file_of_somebody_else_is_not_overwritten(name: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    theirs = tmp_path / name
    theirs.write_text("a year of work")
    assert cli.main(["figures", "fig1", "-o", str(tmp_path), "--format", "png,pdf,svg"]) == 2
    assert f"{theirs}: is not a figure of this command" in capsys.readouterr().err
    assert theirs.read_text() == "a year of work" and os.listdir(tmp_path) == [name]


def test_tables_begin_with_their_names_and_those_of_older_versions_are_drawn_anew(tmp_path: Path) -> None:
    """An older one begins with what was said of it; it is read, and taken for the command's own."""
    (tmp_path / "fig1.csv").write_text("# remodel_fenicsx figures 0.3.0: fig1\n# no simulation\nextension\n0.5\n")
    assert page.read_table(tmp_path / "fig1.csv")["extension"].tolist() == [0.5]
    assert cli.main(["figures", "fig1", "-o", str(tmp_path)]) == 0
    assert (tmp_path / "fig1.csv").read_text().startswith("extension,force_A_0.1,")
    assert "no simulation" in (tmp_path / "fig1.json").read_text()
    assert cli.main(["figures", "fig1", "-o", str(tmp_path)]) == 0


# ---------------------------------------------------------------- which recorded runs are valid


def tiny(**changes: float | str) -> Scene:
    """Two steps of the tendon."""
    return scene_from_dict(TINY).with_values({key.replace("__", "."): value for key, value in changes.items()})


def record(runs_folder: Path, scene: Scene, last: float | None = None) -> Path:
    """What a run leaves, as far as the command looks: one hexahedron that does not move. Returns its folder."""
    folder = runs.kept_run(scene, runs_folder).folder
    folder.mkdir(parents=True)
    (folder / "scene.toml").write_text(scene.to_toml("as run\ndolfinx 0.0"))
    corners = np.array([(x, y, z) for z in (0.0, 1.0) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))])
    with vtkhdf.TransientGrid(folder / "fields.vtkhdf", corners, np.arange(8).reshape(1, 8), 12) as grid:
        for time in np.arange(scene.time.number_of_steps + 1.0):
            grid.append(time, {"displacement": 0 * corners}, {"fibre_angle": np.array([1.0])})
    names = [column.name for column in columns_of(scene.geometry, scene.output.columns, scene.loads)]
    rows = [[time, *[1.0] * (len(names) - 1)] for time in np.arange(0.0, (last or scene.time.end) + 0.5)]
    (folder / "history.csv").write_text("\n".join(",".join(map(str, row)) for row in [names, *rows]) + "\n")
    return folder


def is_whole(runs_folder: Path, scene: Scene) -> bool:
    """Whether the record of a scene counts as its run."""
    return runs.kept_run(scene, runs_folder).is_complete()


def test_a_recorded_run_is_valid_until_scene_or_versions_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = tiny()
    assert not is_whole(tmp_path, scene)
    record(tmp_path, scene)
    assert is_whole(tmp_path, scene) and is_whole(tmp_path, tiny())
    assert not is_whole(tmp_path, tiny(remodeling__kappa=0.03))
    assert not is_whole(tmp_path, tiny(solver__maximum_halvings=11))  # a default that the scene does not name
    versions = runs.library_versions()
    for name in ("fenics-dolfinx", "remodel_fenicsx"):
        with monkeypatch.context() as patch:
            patch.setattr(runs, "library_versions", lambda name=name: versions | {name: "0.0"})
            assert not is_whole(tmp_path, scene)
    assert is_whole(tmp_path, scene)


def test_a_run_that_is_not_whole_is_not_valid(tmp_path: Path) -> None:
    record(tmp_path, tiny(time__end=5.0), last=4.0)
    assert not is_whole(tmp_path, tiny(time__end=5.0))
    without = tiny(output__fields=False)
    (record(tmp_path, without) / "fields.vtkhdf").unlink()
    assert is_whole(tmp_path, without)


def another_scene(folder: Path) -> None:
    (folder / "scene.toml").write_text(tiny(cells__seed=2).to_toml())


def no_scene(folder: Path) -> None:
    (folder / "scene.toml").unlink()


def no_fields(folder: Path) -> None:
    (folder / "fields.vtkhdf").unlink()


def history_without_its_second_row(folder: Path) -> None:
    lines = (folder / "history.csv").read_text().splitlines(keepends=True)
    (folder / "history.csv").write_text("".join(lines[:2] + lines[3:]))


def history_with_half_a_row(folder: Path) -> None:
    (folder / "history.csv").write_text((folder / "history.csv").read_text()[:-4])


def fields_cut_short(folder: Path) -> None:
    os.truncate(folder / "fields.vtkhdf", os.path.getsize(folder / "fields.vtkhdf") - 100)


def fields_that_are_none(folder: Path) -> None:
    (folder / "fields.vtkhdf").write_text("")


def fields_without_their_last_values(folder: Path) -> None:
    with h5py.File(folder / "fields.vtkhdf", "r+") as file:
        file["VTKHDF/CellData/fibre_angle"].resize(2, axis=0)


def fields_without_their_last_time(folder: Path) -> None:
    with h5py.File(folder / "fields.vtkhdf", "r+") as file:
        file["VTKHDF/Steps/Values"].resize(5, axis=0)


@pytest.mark.parametrize("damage", [
    another_scene, no_scene, no_fields, history_without_its_second_row, history_with_half_a_row, fields_cut_short,
    fields_that_are_none, fields_without_their_last_values, fields_without_their_last_time,
])  # fmt: skip
def test_a_damaged_run_is_made_again_and_that_is_said(
    damage: Callable[[Path], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """It is removed; one that is whole is left alone."""
    begun: list[str] = []
    monkeypatch.setattr(runs, "run_all", lambda missing, *of, **more: begun.extend(run.name for run in missing))
    scene = tiny(time__end=5.0)
    folder = record(tmp_path, scene)
    assert runs.obtain([scene], tmp_path, jobs=1) == {"tiny": folder}
    assert not begun and not capsys.readouterr().err
    damage(folder)
    runs.obtain([scene], tmp_path, jobs=1)
    assert begun == ["tiny"] and not folder.exists()
    said = capsys.readouterr().err
    assert said.startswith(f"figures: run again: {folder}: ") and said.count("\n") == 1


def test_a_failing_run_ends_with_its_own_code_and_leaves_nothing_that_looks_valid(tmp_path: Path) -> None:
    # more than any chain can bear at once, and no part of the step is tried
    scene = tiny(name="torn", loads__force__value=1e9, solver__maximum_halvings=0)
    with forked_children(), pytest.raises(FigureError, match="the run torn in .*torn-.*: .*time") as failure:
        runs.obtain([scene], tmp_path, jobs=1)
    assert failure.value.exit_code == 3
    assert not is_whole(tmp_path, scene)


@pytest.mark.parametrize(("code", "expected"), [(3, 3), (4, 4), (143, 143), (-9, 137)])
def test_the_command_ends_as_the_run_that_failed_or_was_stopped(
    code: int, expected: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """A process that a signal has killed counts as a shell counts it."""

    def ended(program: str, *words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess(words, code, "", "remodel-fenicsx: its last words\n")

    monkeypatch.setattr(forks, "forked", ended)
    with forked_children():
        words = ["figures", "fig7", "-o", str(tmp_path / "out"), "--runs", str(tmp_path / "runs"), "--jobs", "1"]
        assert cli.main(words) == expected
    assert "its last words" in capsys.readouterr().err and not (tmp_path / "out").exists()


COMMAND = "import sys; from remodel_fenicsx.cli import main; sys.exit(main(sys.argv[1:]))"


def artery_under_way(tmp_path: Path) -> subprocess.Popen[str]:
    """The command that draws Fig. 7, once its run has begun."""
    command = [sys.executable, "-c", COMMAND, "figures", "fig7", "--jobs", "1", "--runs", str(tmp_path / "runs")]
    process = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    assert process.stderr.readline().startswith("figures: 0 % of 1 runs: artery 0/150")
    return process


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGUSR1])
def test_a_stopped_command_ends_its_runs(number: int, tmp_path: Path) -> None:
    with artery_under_way(tmp_path) as process:
        (worker,) = children_of(process.pid)
        process.send_signal(number)
        assert process.stderr is not None
        rest = process.stderr.read()
    assert process.returncode == (4 if number == signal.SIGUSR1 else 143) and not is_alive(worker)
    said = "remodel-fenicsx: stopped; all that is recorded is kept, the same command goes on"
    assert rest.splitlines()[-1] == said and not (tmp_path / "figures").exists()
    assert all(steps_recorded(history.parent) < 150 for history in (tmp_path / "runs").rglob("history.csv"))


def children_of(number: int) -> list[int]:
    """Process numbers of the children of a process."""
    return [int(text) for text in Path(f"/proc/{number}/task/{number}/children").read_text().split()]


def is_alive(number: int) -> bool:
    """Whether a process runs; one that has ended and that nobody asks for does not."""
    try:
        return Path(f"/proc/{number}/stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_runs_do_not_outlive_a_killed_command(tmp_path: Path) -> None:
    with artery_under_way(tmp_path) as process:
        (worker,) = children_of(process.pid)
        process.kill()
    for _ in range(300):
        if not is_alive(worker):
            break
        clock.sleep(0.1)
    assert not is_alive(worker)


def test_a_run_whose_command_is_killed_before_it_begins_does_not_begin(tmp_path: Path) -> None:
    """setpriv, which asks for the signal of that death, comes too late here."""
    late, messages = tmp_path / "setpriv", tmp_path / "messages"
    late.write_text(f"#!/bin/sh\nsleep 0.3\nexec {shutil.which('setpriv')} \"$@\"\n")
    late.chmod(0o755)
    code = f"""
import os, pathlib, signal
from remodel_fenicsx.system.children import Worker, wait_for_one
child = Worker()
child.begin(["info"], pathlib.Path({str(messages)!r}))
print(child.process.pid, flush=True)
if {{killed}}:
    os.kill(os.getpid(), signal.SIGKILL)
wait_for_one([child], 100.0)
child.poll()
child.stop()
"""
    environment = os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}"}
    for killed in (True, False):
        command = [sys.executable, "-c", code.replace("{killed}", str(killed))]
        done = subprocess.run(command, capture_output=True, text=True, timeout=100, env=environment)
        child = int(done.stdout)
        for _ in range(1000):
            if not is_alive(child):
                break
            clock.sleep(0.01)
        assert not is_alive(child)
        assert (messages.read_text() == "") == killed


def test_a_folder_that_cannot_be_written_is_refused_before_any_run(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert cli.main(["figures", "fig7", "-o", "/proc/nope", "--runs", str(tmp_path / "runs")]) == 5
    message = capsys.readouterr().err
    assert message.startswith("remodel-fenicsx: cannot write the figures: ") and message.count("\n") == 1
    assert os.listdir(tmp_path) == []


# ---------------------------------------------------------------- figures 1 and 5 against closed forms


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with figs. 1 and 5, drawn by the command from runs of its own."""
    folder = tmp_path_factory.mktemp("drawn")
    with forked_children():
        assert cli.main(["figures", "fig1", "fig5", "-o", str(folder), "--runs", str(folder / "runs")]) == 0
    return folder


def test_fig1_is_eq_2(drawn: Path) -> None:
    table = page.read_table(drawn / "fig1.csv")
    x = table["extension"]
    assert len(x) > 100 and x[0] == 0 and 0.9 < x[-1] < 1
    for A in (0.1, 0.4, 0.8):
        np.testing.assert_allclose(table[f"force_A_{A}"], (4 * x + (1 - x) ** -2 - 1) / (4 * A), rtol=1e-6, atol=1e-12)


def test_fig5_is_the_closed_form_of_the_cells_before_the_pass(drawn: Path) -> None:
    table = page.read_table(drawn / "fig5.csv")
    np.testing.assert_array_equal(table["time"][table["time"] > 0], np.arange(1.0, 101.0))
    for kappa in (0.01, 0.025, 0.05, 0.1):
        s = 1 - np.exp(-kappa * np.maximum(table["time"] - 1.0, 0.0))
        exact = np.degrees(np.arctan2(math.sqrt(2) * (1 - s), 1 - s + math.sqrt(3) * s))
        np.testing.assert_allclose(table[f"angle_kappa_{kappa:g}"], exact, rtol=0, atol=1e-3)
        np.testing.assert_allclose(table[f"exact_kappa_{kappa:g}"], exact, rtol=1e-6)


def test_figures_say_with_what_they_were_made(drawn: Path) -> None:
    with Image.open(drawn / "fig5.png") as picture:
        assert picture.size[0] > 800
        notes = picture.text  # type: ignore[attr-defined]
    assert notes["Comment"] == "remodel-fenicsx figures fig5"
    assert (notes["Title"], notes["Description"]) == (FIGURES["fig5"].title, FIGURES["fig5"].caption)
    version = runs.library_versions()["fenics-dolfinx"].split(".post")[0]
    for text in (notes["Source"], page.read_notes(drawn, "fig5")["fig5.csv"][0]):
        assert f"remodel_fenicsx {remodel_fenicsx.__version__}, dolfinx {version}" in text
        assert "preset kuhl-holzapfel-2007 with kinematics point, frame spatial, isotropic cells" in text


@pytest.fixture(scope="module")
def formats(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fig. 1 in all formats, without and with the stamp; the second command draws over one of the first one's files."""
    folder = tmp_path_factory.mktemp("formats")
    all_of_them = ["--format", "png,pdf", "--format", "svg"]
    for name, words in (("plain", all_of_them), ("plain", ["--format", "svg"]), ("stamped", ["--stamp"])):
        if words == ["--format", "svg"]:
            shutil.copy(folder / "plain" / "fig1.svg", folder / "first.svg")
        assert cli.main(["figures", "fig1", "-o", str(folder / name), *words]) == 0
    return folder


def test_a_figure_in_every_format_says_what_it_is(formats: Path) -> None:
    assert sorted(os.listdir(formats / "plain")) == ["fig1.csv", "fig1.json", "fig1.pdf", "fig1.png", "fig1.svg"]
    title, caption = FIGURES["fig1"].title, FIGURES["fig1"].caption
    pdf, svg = (formats / "plain" / "fig1.pdf").read_bytes(), (formats / "plain" / "fig1.svg").read_text()
    assert pdf.startswith(b"%PDF-") and title.replace("(", "\\(").replace(")", "\\)").encode() in pdf
    assert b"/Subject" in pdf and caption.encode("utf-16-be")[:40] in pdf and b"no simulation" in pdf
    assert svg.startswith("<?xml") and title in svg and caption in svg and "no simulation" in svg


def test_what_a_figure_was_made_with_is_in_the_picture_only_on_demand(formats: Path) -> None:
    def foot(name: str) -> np.ndarray:
        with Image.open(formats / name / "fig1.png") as picture:
            return np.asarray(picture.convert("L"))[-14:, :400]

    assert np.all(foot("plain") == 255) and np.any(foot("stamped") < 200)


def test_only_the_format_that_is_wanted_is_written_and_the_same_figure_is_the_same_file(
    formats: Path, drawn: Path, tmp_path: Path
) -> None:
    assert cli.main(["figures", "fig1", "-o", str(tmp_path), "--format", "pdf"]) == 0
    assert sorted(os.listdir(tmp_path)) == ["fig1.csv", "fig1.json", "fig1.pdf"]
    again = {"pdf": tmp_path / "fig1.pdf", "svg": formats / "first.svg", "png": drawn / "fig1.png"}
    assert set(again) == set(page.FORMATS)
    for ending, path in again.items():
        assert path.read_bytes() == (formats / "plain" / f"fig1.{ending}").read_bytes(), ending


def test_panels_are_lettered_in_line_with_their_titles() -> None:
    figure = Figure(figsize=(6, 4))
    panels = [figure.add_axes((left, low, 0.3, 0.3)) for low in (0.6, 0.1) for left in (0.15, 0.6)]
    panels[0].set_ylabel("a long way out")
    panels[1].set_title("title")
    page.panel_letters(*panels)
    renderer = FigureCanvasAgg(figure).get_renderer()
    letters = [axes.texts[0] for axes in panels]
    assert [letter.get_text() for letter in letters] == ["a", "b", "c", "d"]
    boxes = [letter.get_window_extent(renderer) for letter in letters]
    assert boxes[0].x0 == pytest.approx(boxes[2].x0) and boxes[1].x0 == pytest.approx(boxes[3].x0)
    for axes, box in zip(panels, boxes, strict=True):
        assert box.x0 < axes.get_window_extent().x0 and box.y0 >= axes.get_window_extent().y1
    label = panels[0].yaxis.label.get_window_extent(renderer)
    assert boxes[0].x0 == pytest.approx(label.x0, abs=2)


# ---------------------------------------------------------------- curves


def test_curves_show_a_pass_over_the_whole_of_its_step(tmp_path: Path) -> None:
    folder = record(tmp_path, tiny(time__end=3.0))
    rows = [(time, 10.0 - time, 1.0 if time == 1.0 else -time) for time in np.arange(4.0)]
    text = "\n".join(",".join(map(str, row)) for row in rows)
    (folder / "history.csv").write_text(f"time,stored_energy,remodeling_power\n{text}\n")
    above, below = Figure().subplots(2)
    curves._draw_energy(above, below, Recording(folder))
    assert above.lines[0].get_xdata()[0] == 0.0 and above.lines[0].get_ydata()[0] == 10.0
    steps = below.patches[-1].get_data()
    np.testing.assert_array_equal(steps.edges, [0.0, 1.0, 2.0, 3.0])
    np.testing.assert_array_equal(steps.values, [1.0, -2.0, -3.0])


def test_valid_runs_are_used_again_and_own_figures_drawn_anew(drawn: Path) -> None:
    histories = sorted((drawn / "runs").glob("cube-*/history.csv"))
    assert len(histories) == 4
    before = [path.stat().st_mtime_ns for path in histories]
    (drawn / "fig5.png").write_bytes((drawn / "fig5.png").read_bytes()[:4096])
    assert cli.main(["figures", "fig5", "-o", str(drawn), "--runs", str(drawn / "runs")]) == 0
    assert [path.stat().st_mtime_ns for path in sorted((drawn / "runs").glob("cube-*/history.csv"))] == before
    with Image.open(drawn / "fig5.png") as picture:
        picture.load()


# ---------------------------------------------------------------- pictures in space


def two_hexahedra() -> bodies.DrawnBody:
    """Two unit cubes side by side in x, beginning at x = 1; all chains along z, stretched to twice in z."""
    x, y, z = np.meshgrid([1.0, 2.0, 3.0], [-0.5, 0.5], [0.0, 1.0], indexing="ij")
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    first = np.array([0, 4, 6, 2, 1, 5, 7, 3])  # VTK's order, node number 4 i + 2 j + k
    fields = {
        "cell_dimensions": np.tile([1.0, 0.0, 0.0], (2, 1)),
        "axis_1": np.tile([0.0, 0.0, 1.0], (2, 1)),
        "axis_2": np.tile([1.0, 0.0, 0.0], (2, 1)),
        "axis_3": np.tile([0.0, 1.0, 0.0], (2, 1)),
        "deformation_gradient": np.tile(np.diag([1.0, 1.0, 2.0]).ravel(), (2, 1)),
        "fibre_angle_deformed": np.array([0.0, 90.0]),
    }
    return bodies.DrawnBody(0.0, points, np.array([first, first + 4]), points * [0.0, 0.0, 1.0], fields)


def test_exterior_has_the_faces_that_no_other_element_covers() -> None:
    snapshot = two_hexahedra()
    faces, elements = snapshot.exterior()
    assert len(faces) == 10 and np.array_equal(np.bincount(elements), [5, 5])
    centres = snapshot.points[faces].mean(axis=1)
    assert not np.any(np.all(np.isclose(centres, [2.0, 0.0, 0.5]), axis=1))
    alone, _ = snapshot.exterior(np.array([True, False]))
    assert len(alone) == 6


def test_chains_lie_on_the_deformed_face_along_their_deformed_direction() -> None:
    snapshot = two_hexahedra()
    surface, ribbons = bodies.body(snapshot)
    assert len(surface.corners) == 10
    np.testing.assert_allclose(surface.corners[..., 2].max(), 2.0)
    # of the faces only the one at x = 3 looks away from the z axis
    assert len(ribbons.corners) == 4
    ends = np.stack([ribbons.corners[:, [0, 3]].mean(axis=1), ribbons.corners[:, [1, 2]].mean(axis=1)], axis=1)
    np.testing.assert_allclose(ends.mean(axis=1)[:, 1:], [[0.0, 1.0]] * 4, atol=1e-12)
    lengths = np.abs(ends[:, 1] - ends[:, 0])
    np.testing.assert_allclose(lengths, [[0.0, 0.0, 2 * 2 * bodies.CHAIN_REACH]] * 4, atol=1e-12)
    np.testing.assert_allclose(ribbons.corners[..., 0], 3.0, atol=1e-12)
    assert ribbons.lies_on > 0


def outline(snapshot: bodies.DrawnBody) -> tuple[np.ndarray, np.ndarray]:
    """Of the ribbons on the face x = 3 the places (n, 2) in the undeformed face, a square, and the lengths."""
    corners = bodies.body(snapshot)[1].corners
    gradient = snapshot.fields["deformation_gradient"][0].reshape(3, 3)
    flat = (corners.reshape(-1, 3) @ np.linalg.inv(gradient).T)[:, 1:] - [0.0, 0.5]
    return flat, np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)


@pytest.mark.parametrize("angle", [0.0, 5.0, 45.0, 85.0])
@pytest.mark.parametrize("sheared", [0.0, 1.5])
def test_chains_of_neighbours_do_not_join(angle: float, sheared: float) -> None:
    """Whatever their direction and however long, they end before the edge of their face."""
    body, direction = two_hexahedra(), np.radians(angle)
    cell = np.tile([np.cos(direction), np.sin(direction), 0.0], (2, 1))
    gradient = np.eye(3)
    gradient[1, 2] = sheared
    fields = body.fields | {"cell_dimensions": cell, "deformation_gradient": np.tile(gradient.ravel(), (2, 1))}
    body = dataclasses.replace(body, fields=fields, displacement=body.points @ (gradient - np.eye(3)).T)
    places, lengths = outline(body)
    assert np.abs(places).max() < 0.44
    long = dataclasses.replace(body, fields=fields | {"cell_dimensions": 3 * cell})
    places, cut = outline(long)
    assert np.abs(places).max() < 0.44 and np.all(cut > 0.9 * lengths)
    short = dataclasses.replace(body, fields=fields | {"cell_dimensions": 0.2 * cell})
    np.testing.assert_allclose(outline(short)[1], lengths * 0.2, rtol=0.2 if sheared else 1e-9)


def test_colours_go_from_red_along_to_blue_across() -> None:
    red, middle, blue = bodies.coloured(np.array([0.0, 45.0, 90.0]))
    assert red[0] > 0.6 and red[1:].max() < 0.2
    assert blue[2] > 0.5 and blue[:2].max() < 0.3
    assert middle.min() > 0.7
    assert np.all(np.isfinite(bodies.coloured(np.array([-1e-9, 90.0 + 1e-9]))))


def test_every_colour_of_the_scale_stays_as_it_is_in_the_palette() -> None:
    scale = np.rint(255 * bodies.scale_colours()).astype(np.uint8)
    rng = np.random.default_rng(1)
    # beside them many other colours, among them the grey that Pillow alone takes for one of the scale
    others = np.concatenate([np.tile([[234, 234, 234]], (500, 1)), rng.integers(0, 256, (18_000, 3))]).astype(np.uint8)
    pixels = np.concatenate([scale, others[: 10_000 - len(scale)]]).reshape(100, 100, 3)
    drawn = page.with_palette(Image.fromarray(pixels), bodies.scale_colours())
    assert drawn.mode == "P"
    found = np.asarray(drawn.convert("RGB")).reshape(-1, 3)
    np.testing.assert_array_equal(found[: len(scale)], scale)
    assert np.abs(found.astype(int) - pixels.reshape(-1, 3).astype(int)).mean() < 25


@pytest.fixture(scope="module")
def tiny_run(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Two steps of the tendon, as the command runs them."""
    with forked_children():
        return Recording(runs.obtain([tiny()], tmp_path_factory.mktemp("runs"), jobs=1)["tiny"])


def test_a_recording_gives_back_what_was_run(tiny_run: Recording) -> None:
    assert tiny_run.scene == tiny()
    assert tiny_run.value("force", 2.0) == pytest.approx(50.0)
    with pytest.raises(RecordingError, match="no fields at time 7"):
        bodies.DrawnBody.of(tiny_run, 7.0)
    snapshot = bodies.DrawnBody.of(tiny_run, 2.0)
    assert snapshot.elements.shape == (480, 8)
    top = snapshot.points[:, 2] > 10.0 - 1e-9
    assert np.all(snapshot.displacement[snapshot.points[:, 2] < 1e-9, 2] == 0)
    # nodes stand for unequal areas: the means agree roughly
    assert 1 + snapshot.displacement[top, 2].mean() / 10 == pytest.approx(tiny_run.value("mean_stretch", 2.0), abs=0.02)
    assert np.all(snapshot.fields["cell_dimensions"][:, 0] >= snapshot.fields["cell_dimensions"][:, 1])


@pytest.fixture(scope="module")
def pictures(tiny_run: Recording) -> list[np.ndarray]:
    """Of the tendon with and without chains, of chains on the near side and on the far one; drawn by one process."""
    snapshot = bodies.DrawnBody.of(tiny_run, 2.0)
    middle = (0.0, 0.0, snapshot.deformed[:, 2].max() / 2)
    view = rendering.View((0.3, -1.0, 0.14), middle, 14.0, (120, 320))
    patches = bodies.body(snapshot)
    _, ribbons = bodies.body(two_hexahedra())  # on the face x = 3
    sides = [rendering.View((side, 0.0, 0.0), (3.0, 0.0, 1.0), 2.0, (160, 160)) for side in (1.0, -1.0)]
    wanted = [(view, patches), (view, patches[:1]), *((side, [ribbons]) for side in sides)]
    return rendering.render([rendering.Picture(*one) for one in wanted])


def test_a_snapshot_is_really_drawn(tiny_run: Recording, pictures: list[np.ndarray]) -> None:
    both, bare, *_ = pictures
    length = bodies.DrawnBody.of(tiny_run, 2.0).deformed[:, 2].max()
    assert both.shape == bare.shape == (320, 120, 3)
    assert np.all(both[0, 0] == 255)
    body = np.any(bare < 245, axis=2)
    # length along z of the body over the height of the picture, its width over the same; seen nearly from the side
    rows, columns = np.flatnonzero(body.any(axis=1)), np.flatnonzero(body.any(axis=0))
    assert np.ptp(rows) / 320 == pytest.approx(length / 14.0, abs=0.06)
    assert np.ptp(columns) / 320 == pytest.approx(2 * math.sqrt(10 / math.pi) / 14.0, abs=0.03)
    red, green, blue = np.moveaxis(bare[body].astype(int), -1, 0)
    assert np.mean(red - blue > 60) > 0.1 and np.mean(blue - red > 40) > 0.1
    # no chain shows beyond the outline
    assert not np.any(np.any(both < 245, axis=2) & np.all(bare == 255, axis=2))
    dark = np.all(both < 70, axis=2)
    assert 0.02 < dark.sum() / body.sum() < 0.4 and not np.any(np.all(bare < 70, axis=2))


def test_chains_on_the_far_side_are_not_drawn(pictures: list[np.ndarray]) -> None:
    *_, front, behind = pictures
    assert front.min() < 70 and np.all(behind == 255)


def test_what_the_child_says_reaches_the_user(monkeypatch: pytest.MonkeyPatch) -> None:
    view = rendering.View((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0, (10, 10))
    with pytest.raises(FigureError, match="no picture in space: pyvista ended with 1: .*boom") as failure:
        rendering.render([dataclasses.replace(rendering.Picture(view), patches=[Boom()])])  # type: ignore[list-item]
    assert failure.value.exit_code == 5


class Boom:
    """Cannot be read back."""

    def __reduce__(self) -> tuple:
        return (_raise, ())


def _raise() -> None:
    raise RuntimeError("boom")


# ---------------------------------------------------------------- all of it


@pytest.fixture(scope="module")
def everything(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every figure, drawn by the command."""
    folder = tmp_path_factory.mktemp("everything")
    assert cli.main(["figures", "-o", str(folder), "--runs", str(folder / "runs")]) == 0
    return folder


@pytest.mark.slow
def test_every_figure_has_a_picture_and_its_data(everything: Path) -> None:
    for name in FIGURES:
        with Image.open(everything / f"{name}.png") as picture:
            colours = picture.convert("RGB").getcolors(100_000)
        assert colours is not None and len(colours) > 50
        assert len(next(iter(page.read_table(everything / f"{name}.csv").values()))) >= 5
        assert (everything / f"{name}.png").stat().st_size < 300_000
    for name in ("fig6", "fig7", "fig8", "fig9", "fig10", "fig11"):
        assert len(page.read_table(everything / f"{name}-elements.csv")["fibre_angle_deformed"]) > 300


@pytest.mark.slow
def test_the_figures_show_what_the_design_says(everything: Path) -> None:
    tendon = page.read_table(everything / "fig6.csv")
    assert 1.735 <= tendon["mean_stretch"][tendon["time"] == 12.0].item() <= 1.750
    assert 1.4244 <= tendon["mean_stretch"][-1] <= 1.4250
    radial = page.read_table(everything / "fig7.csv")["mean_l_radial"]
    assert 0.49 < radial[0] < 0.53 and 0.02 < radial[-1] < 0.035
    layers = page.read_table(everything / "fig8.csv")
    target = [1.1, 4.2, 14.0, 36.9, 60.2, 66.7, 70.3, 72.7]
    np.testing.assert_allclose(layers["fibre_angle"], target, rtol=0, atol=1.5)
    cases = page.read_table(everything / "fig9.csv")
    stretched, pressed = (cases["pressure"] == 0.0, cases["stretch"] == 0.0)
    assert np.all(cases["fibre_angle"][stretched] > 89.0)
    assert np.all(cases["fibre_angle"][pressed][:4] < 1.5) and np.all(cases["fibre_angle"][pressed] < 13.0)
    second, strain = page.read_table(everything / "fig10.csv"), page.read_table(everything / "fig11.csv")
    variation = {name: np.ptp(table[f"fibre_angle_{name}"]) for name, table in
                 (("cauchy", second), ("pk2", second), ("finger", strain))}  # fmt: skip
    assert variation["finger"] < 25 < 60 < variation["pk2"] < variation["cauchy"] < variation["pk2"] + 6
    rate = page.read_table(everything / "rate.csv")
    assert 15 < rate["fibre_angle_explicit"][-1] - rate["fibre_angle_rate"][-1] < 25


# ---------------------------------------------------------------- docs/verification.md


DOCS = PACKAGE.parent / "docs"


@pytest.fixture(scope="module")
def make_verification() -> Any:
    """The program that makes the page, as a module."""
    spec = importlib.util.spec_from_file_location("make_verification", DOCS / "make_verification.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_verification_page_is_what_its_data_says(make_verification: Any) -> None:
    """Whoever draws anew and forgets the page, or edits it by hand, is told: run docs/make_verification.py."""
    text = (DOCS / "verification.md").read_text(encoding="utf-8")
    assert make_verification.page() == text  # every number again, from the tables beside the pictures
    appendix = make_verification.page(template="appendix_verification")
    assert appendix == (DOCS / "appendix_verification.md").read_text(encoding="utf-8")
    shown = re.findall(r"!\[.*\]\((.*)\)", text)
    assert {f"figures/{name}.png" for name in FIGURES} < set(shown)
    for name in shown:
        assert 5_000 < (DOCS / name).stat().st_size < 300_000


@pytest.mark.parametrize(("table", "column", "said"), [
    ("fig10", "fibre_angle_pk2", "variation_pk2"),
    ("fig7", "mean_l_radial", "artery_radial_end"),
    ("fig11-history", "inner_radius_finger", "finger_inner_radius"),
    ("fig6-snapshots", "stretch_least_aligned_tenth", "tendon_across"),
    ("stiff-tendon", "mean_stretch", "tendon_stiff_end"),
])  # fmt: skip
def test_numbers_of_the_verification_page_follow_their_tables(
    make_verification: Any, table: str, column: str, said: str, tmp_path: Path
) -> None:
    """Nothing is kept elsewhere: another table, another number."""
    kept = tmp_path / "figures"
    shutil.copytree(DOCS / "figures", kept, ignore=shutil.ignore_patterns("*.png"))
    before, page = make_verification.all_numbers(kept)[said], make_verification.page(kept)
    lines = (kept / f"{table}.csv").read_text().splitlines()
    index = lines[0].split(",").index(column)
    for number in range(1, len(lines)):
        cells = lines[number].split(",")
        cells[index] = f"{1.2 * float(cells[index])}"
        lines[number] = ",".join(cells)
    (kept / f"{table}.csv").write_text("\n".join(lines) + "\n")
    assert make_verification.all_numbers(kept)[said] != before and make_verification.page(kept) != page


def test_the_verification_page_shows_the_proof(make_verification: Any) -> None:
    """What is promised in words holds in the tables."""
    kept = DOCS / "figures"
    cases, drivers = (make_verification.rows_of(kept / f"comparison-{name}.csv") for name in ("cases", "drivers"))
    assert {(row["stretch"], row["pressure"]) for row in cases} == set(LOAD_CASES)
    assert {row["driver"] for row in drivers} == {"cauchy", "pk2", "finger"}
    assert all(row["radii_percent"] < 0.2 for row in [*cases, *drivers])
    explicit = [*cases, *(row for row in drivers if row["law"] == "explicit")]
    assert all(row["angle_mean"] < 1.0 and row["angle_outside"] < 1.0 for row in explicit)
    objective = make_verification.rows_of(kept / "invariance.csv")
    assert len(objective) == 12
    for row in objective:
        changes = row["frame"] == "spatial" and row["driver"] != "pk2" and row["turned"] == "deformed body"
        assert (row["lengths"] > 0.01) == changes and (row["energy"] > 0.01) == changes
        assert changes or max(row["lengths"], row["tensor"], row["energy"]) < 1e-8
