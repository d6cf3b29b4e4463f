"""demos/figures.py: names, numbers against closed forms; runs that are kept; pictures in space; the page of them."""

from __future__ import annotations

import importlib.util
import math
import os
import re
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import pyvista
from PIL import Image

import remodel_fenicsx
from remodel_fenicsx import Recording, run
from remodel_fenicsx.body.shape import columns_of
from remodel_fenicsx.pictures import bodies
from remodel_fenicsx.results import vtkhdf
from remodel_fenicsx.results.recording import RecordingError
from remodel_fenicsx.scene.scene import Scene, SceneError, scene_from_dict
from remodel_fenicsx.studies import page
from remodel_fenicsx.studies.study import Run
from tests.conftest import Refused

PACKAGE = Path(remodel_fenicsx.__file__).parent
DOCS = PACKAGE.parent / "docs"
TINY = {"name": "tiny", "preset": "kuhl-holzapfel-2007", "geometry": {"shape": "tendon"}, "time": {"end": 2.0}}


def loaded(path: Path) -> Any:
    """A script as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


SCRIPT = PACKAGE.parent / "demos" / "figures.py"
figures = loaded(SCRIPT)


def draw(monkeypatch: pytest.MonkeyPatch, *words: str | Path) -> int:
    """The script with these words; its exit code."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), *map(str, words)])
    try:
        figures.main()
    except SystemExit as end:
        return int(end.code or 0)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    return 0


# ---------------------------------------------------------------- bad input


def test_the_command_of_old_names_the_script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused) -> None:
    monkeypatch.chdir(tmp_path)
    for words in (["figures"], ["figures", "fig7", "--format", "pdf", "-o", "out"]):
        assert "./with-fenicsx python3 demos/figures.py fig8" in refused(*words)
    assert os.listdir() == []


@pytest.mark.parametrize(("arguments", "named"), [
    (["fig12"], "fig12: no such figure; allowed are fig1, fig5"), (["fig1", "--jobs", "0"], "--jobs 0"),
    (["fig1", "-o", "taken"], "-o taken: is a file"), (["fig1", "--runs", "taken"], "--runs taken: is a file"),
])  # fmt: skip
def test_bad_input_is_one_line_and_writes_nothing(
    arguments: list[str], named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("taken").write_text("")
    assert draw(monkeypatch, *arguments) == 2
    message = capsys.readouterr().err
    assert named in message and message.count("\n") == 1
    assert os.listdir() == ["taken"]


def test_every_figure_of_the_paper_is_there_and_every_run_is_drawn() -> None:
    assert list(figures.FIGURES) == ["fig1", *(f"fig{n}" for n in range(5, 12)), "rate", "energy"]
    known = figures.scenes()
    assert {run for figure in figures.FIGURES.values() for run in figure.runs} == set(known)
    assert all(scene.name == name for name, scene in known.items())


def test_an_older_table_is_read(tmp_path: Path) -> None:
    """It begins with what was said of it."""
    (tmp_path / "fig1.csv").write_text("# remodel_fenicsx figures 0.3.0: fig1\n# no simulation\nextension\n0.5\n")
    assert page.read_table(tmp_path / "fig1.csv")["extension"].tolist() == [0.5]


# ---------------------------------------------------------------- which recorded runs are valid


def tiny(**changes: float | str) -> Scene:
    """Two steps of the tendon."""
    return scene_from_dict(TINY).with_values({key.replace("__", "."): value for key, value in changes.items()})


def record(runs_folder: Path, scene: Scene, last: float | None = None) -> Path:
    """What a run leaves, as far as the command looks: one hexahedron that does not move. Returns its folder."""
    folder = runs_folder / scene.name
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


def answers(runs_folder: Path, scene: Scene) -> bool | str:
    """Whether the record of a scene counts as its run, or the one line that refuses it."""
    try:
        return Run(scene.name, scene, runs_folder / scene.name).is_complete()
    except (SceneError, RecordingError) as error:
        assert "\n" not in str(error)
        return str(error)


def test_a_recorded_run_is_complete_when_all_of_it_is_there(tmp_path: Path) -> None:
    scene = tiny(time__end=5.0)
    assert answers(tmp_path, scene) is False
    record(tmp_path, scene, last=4.0)
    assert answers(tmp_path, scene) is False
    shutil.rmtree(tmp_path / "tiny")
    record(tmp_path, scene)
    assert answers(tmp_path, scene) is True
    # a default that the scene does not name
    assert "another scene" in str(answers(tmp_path, tiny(time__end=5.0, solver__maximum_halvings=11)))
    shutil.rmtree(tmp_path / "tiny")
    without = tiny(output__fields=False)
    (record(tmp_path, without) / "fields.vtkhdf").unlink()
    assert answers(tmp_path, without) is True


def cut_text(name: str, change: Callable[[str], str]) -> Callable[[Path], object]:
    """A file of the folder with another text."""
    return lambda folder: (folder / name).write_text(change((folder / name).read_text()))


def resized(dataset: str, length: int) -> Callable[[Path], None]:
    """Fields with fewer of these values."""

    def damage(folder: Path) -> None:
        with h5py.File(folder / "fields.vtkhdf", "r+") as file:
            file[f"VTKHDF/{dataset}"].resize(length, axis=0)

    return damage


DAMAGES: dict[str, Callable[[Path], object]] = {
    "another scene": cut_text("scene.toml", lambda text: tiny(cells__seed=2).to_toml()),
    "no scene": lambda folder: (folder / "scene.toml").unlink(),
    "no fields": lambda folder: (folder / "fields.vtkhdf").unlink(),
    "no second row": cut_text("history.csv", lambda text: re.sub("\n1.0,.*", "", text)),
    "half a row": cut_text("history.csv", lambda text: text[:-4]),
    "fields cut short": lambda folder: os.truncate(folder / "fields.vtkhdf", 5000),
    "no last values": resized("CellData/fibre_angle", 2),
    "no last time": resized("Steps/Values", 5),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_run_is_not_complete(damage: str, tmp_path: Path) -> None:
    scene = tiny(time__end=5.0)
    DAMAGES[damage](record(tmp_path, scene))
    assert answers(tmp_path, scene) is not True


def test_a_failing_run_ends_the_script_with_its_code(tmp_path: Path) -> None:
    # more than any chain can bear at once, and no part of the step is tried
    torn = tiny(name="torn", loads__force__value=1e9, solver__maximum_halvings=0)
    with pytest.raises(SystemExit) as end:
        figures.run_all([torn], tmp_path, 1)
    assert end.value.code == 3 and not figures.is_complete(torn, figures.run_folder(torn, tmp_path))


def test_a_damaged_run_ends_the_script_with_the_line_of_the_run(tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    path = figures.run_all([tiny()], tmp_path, 1)["tiny"].path
    DAMAGES["half a row"](path)
    capfd.readouterr()
    with pytest.raises(SystemExit) as end:
        figures.run_all([tiny()], tmp_path, 1)
    assert end.value.code == 2 and f"{path / 'history.csv'}: " in capfd.readouterr().err.splitlines()[-1]


def test_another_scene_is_another_run(tmp_path: Path) -> None:
    folders = {figures.run_folder(scene, tmp_path) for scene in (tiny(), tiny(), tiny(remodeling__kappa=0.03))}
    assert len(folders) == 2


# ---------------------------------------------------------------- figures 1 and 5 against closed forms


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with figs. 1 and 5, drawn by the script from runs of its own."""
    folder = tmp_path_factory.mktemp("drawn")
    with pytest.MonkeyPatch.context() as patch:
        assert draw(patch, "fig1", "fig5", "-o", folder, "--runs", folder / "runs") == 0
    return folder


@pytest.mark.parametrize("name", ["fig1", "fig5"])
def test_the_numbers_are_those_of_the_page(drawn: Path, name: str) -> None:
    found, kept = (page.read_table(folder / f"{name}.csv") for folder in (drawn, DOCS / "figures"))
    assert list(found) == list(kept)
    for column, values in kept.items():
        np.testing.assert_allclose(found[column], values, rtol=1e-6, atol=1e-6)


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


def test_valid_runs_are_used_again_and_own_figures_drawn_anew(drawn: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    histories = sorted((drawn / "runs").glob("cube-*/history.csv"))
    assert len(histories) == 4
    before = [path.stat().st_mtime_ns for path in histories]
    (drawn / "fig5.png").write_bytes((drawn / "fig5.png").read_bytes()[:4096])
    assert draw(monkeypatch, "fig5", "-o", drawn, "--runs", drawn / "runs") == 0
    assert [path.stat().st_mtime_ns for path in histories] == before
    with Image.open(drawn / "fig5.png") as picture:
        picture.load()


# ---------------------------------------------------------------- pictures in space


def two_hexahedra(F: np.ndarray, cell: list[float]) -> pyvista.UnstructuredGrid:
    """Two unit cubes side by side in x, beginning at x = 1; l_1, l_2, l_3 along z, x and y."""
    x, y, z = np.meshgrid([1.0, 2.0, 3.0], [-0.5, 0.5], [0.0, 1.0], indexing="ij")
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    first = np.array([0, 4, 6, 2, 1, 5, 7, 3])  # VTK's order, node number 4 i + 2 j + k
    grid = pyvista.UnstructuredGrid({pyvista.CellType.HEXAHEDRON: np.array([first, first + 4])}, points)
    grid.point_data["displacement"] = points @ (F - np.eye(3)).T
    fields = {"cell_dimensions": cell, "axis_1": [0, 0, 1], "axis_2": [1, 0, 0], "axis_3": [0, 1, 0]}
    for name, values in (fields | {"deformation_gradient": F.ravel()}).items():
        grid.cell_data[name] = np.tile(np.asarray(values, dtype=float), (2, 1))
    return grid


def ribbons(F: np.ndarray, cell: list[float]) -> np.ndarray:
    """Corners (4, 4, 3) of those on the face x = 3."""
    corners = np.asarray(bodies.chains(two_hexahedra(F, cell), None).points).reshape(10, 4, 4, 3)
    (found,) = corners[np.all(corners[..., 0] > 3.0, axis=(1, 2))]
    return found


def test_chains_lie_on_the_deformed_face_along_their_deformed_direction() -> None:
    corners = ribbons(np.diag([1.0, 1.0, 2.0]), [1.0, 0.0, 0.0])
    ends = np.stack([corners[:, [0, 3]].mean(axis=1), corners[:, [1, 2]].mean(axis=1)], axis=1)
    np.testing.assert_allclose(ends.mean(axis=1)[:, 1:], [[0.0, 1.0]] * 4, atol=1e-6)
    lengths = np.abs(ends[:, 1] - ends[:, 0])
    np.testing.assert_allclose(lengths, [[0.0, 0.0, 2 * 2 * bodies.CHAIN_LOOK["reach"]]] * 4, atol=1e-6)
    np.testing.assert_allclose(corners[..., 0], corners[0, 0, 0], atol=1e-6)


def outline(F: np.ndarray, cell: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the same ribbons the places (n, 2) in the undeformed face, a square, and the lengths."""
    corners = ribbons(F, list(cell))
    flat = (corners.reshape(-1, 3) @ np.linalg.inv(F).T)[:, 1:] - [0.0, 0.5]
    return flat, np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)


def test_colours_go_from_red_along_to_blue_across() -> None:
    red, middle, blue = bodies.coloured(np.array([0.0, 45.0, 90.0]))
    assert red[0] > 0.6 and red[1:].max() < 0.2
    assert blue[2] > 0.5 and blue[:2].max() < 0.3
    assert middle.min() > 0.7
    assert np.all(np.isfinite(bodies.coloured(np.array([-1e-9, 90.0 + 1e-9]))))


@pytest.fixture(scope="module")
def tiny_run(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Two steps of the tendon, as the command runs them."""
    return Recording(run(tiny(), tmp_path_factory.mktemp("runs") / "tiny", report=False))


def test_a_body_is_really_drawn(tiny_run: Recording) -> None:
    """Of the tendon with and without chains; seen nearly from the side."""
    grid = tiny_run.grid(2.0)
    without = grid.copy()
    without.cell_data.remove("cell_dimensions")
    length = float((grid.points + grid.point_data["displacement"])[:, 2].max())
    view = bodies.View((0.3, -1.0, 0.14), (0.0, 0.0, length / 2), 14.0, (120, 320))
    both, bare = bodies.render([bodies.PictureSheet([each], ["t"], [""], 1, "", "") for each in (grid, without)], view)
    head = 4 * bodies.LETTER
    both, bare = (image[head : head + 320] for image in (both, bare))
    assert np.all(both[0, 0] == 255)
    body = np.any(bare < 245, axis=2)
    # length along z of the body over the height of the picture, its width over the same
    rows, columns = np.flatnonzero(body.any(axis=1)), np.flatnonzero(body.any(axis=0))
    assert np.ptp(rows) / 320 == pytest.approx(length / 14.0, abs=0.06)
    assert np.ptp(columns) / 320 == pytest.approx(2 * math.sqrt(10 / math.pi) / 14.0, abs=0.03)
    red, green, blue = np.moveaxis(bare[body].astype(int), -1, 0)
    assert np.mean(red - blue > 60) > 0.1 and np.mean(blue - red > 40) > 0.1
    # no chain shows beyond the outline, where those of the far side would
    assert not np.any(np.any(both < 245, axis=2) & np.all(bare == 255, axis=2))
    dark = np.all(both < 70, axis=2)
    assert 0.02 < dark.sum() / body.sum() < 0.4 and not np.any(np.all(bare < 70, axis=2))


# ---------------------------------------------------------------- all of it


@pytest.fixture(scope="module")
def everything(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every figure, drawn by the script."""
    folder = tmp_path_factory.mktemp("everything")
    with pytest.MonkeyPatch.context() as patch:
        assert draw(patch, "-o", folder, "--runs", folder / "runs") == 0
    return folder


@pytest.mark.slow
def test_all_numbers_are_those_of_the_page(everything: Path) -> None:
    """To what another machine rounds: of angles in elements that hardly decide."""
    tables = [path for name in figures.FIGURES for path in (DOCS / "figures").glob(f"{name}[.-]*csv")]
    assert len(tables) == 14
    for path in tables:
        found, kept = (page.read_table(folder / path.name) for folder in (everything, DOCS / "figures"))
        assert list(found) == list(kept)
        for column, values in kept.items():
            if values.dtype.kind == "f":
                np.testing.assert_allclose(found[column], values, rtol=1e-4, atol=0.01, err_msg=f"{path} {column}")


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


@pytest.fixture(scope="module")
def make_verification() -> Any:
    """The program that makes the page, as a module."""
    return importlib.import_module("docs.making.verification")


def test_the_verification_page_is_what_its_data_says(make_verification: Any) -> None:
    """Whoever draws anew and forgets the page, or edits it by hand, is told: run docs/make verification."""
    text = (DOCS / "verification.md").read_text(encoding="utf-8")
    assert make_verification.page() == text  # every number again, from the tables beside the pictures
    shown = re.findall(r"!\[.*\]\((.*)\)", text)
    assert {f"figures/{name}.png" for name in figures.FIGURES} < set(shown)
    for name in shown:
        assert 5_000 < (DOCS / name).stat().st_size < 300_000


def test_the_verification_page_shows_the_proof(make_verification: Any) -> None:
    """What is promised in words holds in the tables."""
    kept = DOCS / "figures"
    cases, drivers = (make_verification.rows_of(kept / f"comparison-{name}.csv") for name in ("cases", "drivers"))
    assert {(row["stretch"], row["pressure"]) for row in cases} == set(figures.LOAD_CASES)
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
