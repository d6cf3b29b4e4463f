"""The commands `picture` and `animate`: what is on the pictures of real runs, pixel by pixel, and what is refused."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from remodel_fenicsx import Recording, cli
from remodel_fenicsx import pictures as rendering
from remodel_fenicsx.results.recording import ANGLE_COLOURS
from remodel_fenicsx.results.whole_body import WholeBody
from tests.conftest import Refused
from tests.report.conftest import Recorded
from tests.tables import rows

FROM_THE_FRONT = "--view=0,-1,0"  # faces that look there have the colours of the scale as they are
Drawn = Callable[..., np.ndarray]


@pytest.fixture
def drawn(recorded: Recorded, drawn_by_forks: None) -> Drawn:
    """drawn(name of a run, options) -> the picture in 0..255, (rows, columns, 3); each is drawn once."""

    def draw(name: str, *options: str) -> np.ndarray:
        path = recorded(name).parent / f"{' '.join([name, *options])}.png"
        if not path.exists():
            assert cli.main(["picture", str(recorded(name)), *options, "-o", str(path)]) == 0
        with Image.open(path) as picture:
            return np.asarray(picture.convert("RGB"))

    return draw


def panel(picture: np.ndarray) -> np.ndarray:
    """What lies between title and loads: the largest run of rows with something in them."""
    filled = np.concatenate([[False], np.any(picture < 245, axis=(1, 2)), [False]])
    starts, ends = np.flatnonzero(~filled[:-1] & filled[1:]), np.flatnonzero(
        filled[:-1] & ~filled[1:]
    )
    longest = int(np.argmax(ends - starts))
    return picture[starts[longest] : ends[longest]]


def outline(part: np.ndarray) -> tuple[int, int]:
    """Rows and columns of what has a colour: chains have none."""
    body = np.ptp(part, axis=2) > 12
    rows, columns = np.flatnonzero(body.any(axis=1)), np.flatnonzero(body.any(axis=0))
    return int(np.ptp(rows)) + 1, int(np.ptp(columns)) + 1


def levels(part: np.ndarray, least: float = 0.004) -> set[int]:
    """Which steps of the scale, unshaded, fill more than a share of it."""
    scale = np.rint(
        255
        * np.array([[int(text[i : i + 2], 16) / 255 for i in (1, 3, 5)] for text in ANGLE_COLOURS])
    )
    return {k for k, colour in enumerate(scale) if np.all(part == colour, axis=2).mean() > least}


def levels_of(angles: np.ndarray) -> set[int]:
    """The steps of angles in degrees."""
    return set(np.minimum(angles // 5, 17).astype(int))


# ---------------------------------------------------------------- what is seen
def test_the_cube_has_its_size_and_its_colour(recorded: Recorded, drawn: Drawn) -> None:
    picture, run = drawn("cube", FROM_THE_FRONT), Recording(recorded("cube"))
    fields = run.fields(run.times[-1])
    size = np.ptp(run.points + fields["displacement"], axis=0)
    body = panel(picture)
    rows, columns = outline(body)
    assert rows / columns == pytest.approx(size[2] / size[0], rel=0.02)
    assert levels(body, 0.05) == levels_of(fields["fibre_angle_deformed"])
    chains = np.all(body < 70, axis=2).sum() / (rows * columns)
    assert 0.03 < chains < 0.3


def test_all_that_is_written_lies_outside_of_the_body(drawn: Drawn) -> None:
    """Every letter below it ends before the edge of the sheet, and there is white between all parts."""
    for name, options in (("artery", ()), ("tendon", ("--time", "0", "5"))):
        picture = drawn(name, *options)
        assert np.all(picture[0] > 245) and np.all(picture[-1] > 245)
        assert np.all(picture[:, :4] > 245) and np.all(picture[:, -4:] > 245)
        filled = np.any(picture < 245, axis=(1, 2))
        # title, body, scale with its label and numbers, notes
        assert np.count_nonzero(~filled[:-1] & filled[1:]) >= 4
    scale = picture[-picture.shape[0] // 4 :]
    assert levels(scale, 0.0005) == set(range(18))


def test_a_cut_shows_the_inside_and_layers_are_taken_off(recorded: Recorded, drawn: Drawn) -> None:
    """A tube of equal cells has one angle in each layer."""
    whole = WholeBody(Recording(recorded("radial")))
    _, fields = whole.fields(whole.recording.times[-1])
    angle = np.array([fields["fibre_angle_deformed"][whole.layer == k].mean() for k in range(8)])
    expected = levels_of(angle)
    assert len(expected) >= 2 and levels_of(angle[:3]) < expected
    middle = slice(100, -100)
    outside = panel(
        drawn("radial", f"--view={np.sin(np.pi / 16)},{-np.cos(np.pi / 16)},0")
    )  # onto one of 16 sides
    cut = panel(drawn("radial", FROM_THE_FRONT, "--cut", "half"))
    peeled = panel(drawn("radial", FROM_THE_FRONT, "--cut", "half", "--layers", "3"))
    assert levels(outside[middle]) == levels_of(angle[-1:])
    assert levels(cut[middle], 0.02) == expected and levels(peeled[middle], 0.02) == levels_of(
        angle[:3]
    )
    # 3 of 8 layers from 1 to 3: to 1.75, and so much wider is the same length
    assert np.divide(*outline(peeled)) / np.divide(*outline(cut)) == pytest.approx(
        3.0 / 1.75, rel=0.03
    )


@pytest.mark.parametrize(
    ("name", "dark"),
    [("tetrahedra", True), ("quadratic", True), ("point", True), ("angles alone", False)],
)
def test_all_elements_are_drawn_and_chains_where_they_were_recorded(
    drawn: Drawn, name: str, dark: bool
) -> None:
    body = panel(drawn(name))
    rows, columns = outline(body)
    assert 0.4 < (np.ptp(body, axis=2) > 12).sum() / (rows * columns) <= 1.0
    assert (np.all(body < 70, axis=2).mean() > 0.003) == dark


# ---------------------------------------------------------------- files
@pytest.fixture
def empty_sheets(monkeypatch: pytest.MonkeyPatch) -> None:
    """In place of what is drawn, where the file alone is looked at."""
    monkeypatch.setattr(
        rendering, "render", lambda job: [np.zeros((9, 9, 3), np.uint8) for _ in job.sheets]
    )


@pytest.mark.usefixtures("empty_sheets")
def test_a_picture_says_what_it_is_and_where_it_comes_from(
    recorded: Recorded, tmp_path: Path
) -> None:
    folder = shutil.copytree(recorded("cube"), tmp_path / "run")
    for name in ("cube-t4.png", "cube-t4-2.png"):
        assert cli.main(["picture", str(folder), "--time", "4.2"]) == 0
        with Image.open(folder / name) as picture:
            assert picture.info["Title"] == "cube: angle of the collagen"
            assert (
                "dolfinx" in picture.info["Source"] and "1 elements" in picture.info["Description"]
            )
    path = tmp_path / "cube.PDF"
    assert cli.main(["picture", str(folder), "-o", str(path)]) == 0
    assert path.read_bytes().startswith(b"%PDF") and b"/Width 9" in path.read_bytes()


@pytest.mark.usefixtures("drawn_by_forks")
@pytest.mark.parametrize(("ending", "frames"), [("gif", 3), ("webp", 2)])
def test_an_animation_has_so_many_frames_that_differ(
    recorded: Recorded, tmp_path: Path, ending: str, frames: int
) -> None:
    path = tmp_path / f"film.{ending}"
    assert (
        cli.main(["animate", str(recorded("cube")), "--frames", str(frames), "-o", str(path)]) == 0
    )
    with Image.open(path) as film:
        assert film.n_frames == frames  # type: ignore[attr-defined]
        found = []
        for number in range(frames):
            film.seek(number)
            found.append(panel(np.asarray(film.convert("RGB"))))
    heights = [rows / columns for rows, columns in map(outline, found)]
    assert heights[-1] > 1.2 * heights[0]  # it grows long and thin, in one view


def test_a_run_that_failed_is_drawn(drawn: Drawn) -> None:
    assert np.any(panel(drawn("failed", "--layers", "1")) < 200)


# ---------------------------------------------------------------- what is refused
@pytest.mark.parametrize(("name", "words", "said"), rows(__file__, "refused.txt"))
def test_bad_input_is_one_line_and_writes_nothing(
    recorded: Recorded,
    name: str,
    words: str,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    refused: Refused,
) -> None:
    folder = recorded(name)
    before = sorted(os.listdir(folder))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(rendering, "render", lambda *_: pytest.fail("something was drawn"))
    message = refused(*(folder if word == "DIR" else word for word in words.split()))
    assert message.startswith(said.replace("DIR", str(folder)))
    assert os.listdir() == [] and sorted(os.listdir(folder)) == before


# ---------------------------------------------------------------- what belongs to others
@pytest.mark.usefixtures("empty_sheets")
@pytest.mark.parametrize("kind", ["file", "link"])
def test_nothing_is_overwritten(
    recorded: Recorded, kind: str, tmp_path: Path, refused: Refused
) -> None:
    """What the default name is taken by stays, and no link is followed."""
    folder, victim = shutil.copytree(recorded("cube"), tmp_path / "run"), tmp_path / "victim"
    places = [folder / "cube-t10.png", tmp_path / "mine.png"]
    for place in places:
        place.write_bytes(b"a year of work") if kind == "file" else place.symlink_to(victim)
    assert cli.main(["picture", str(folder)]) == 0 and (folder / "cube-t10-2.png").exists()
    assert f"{places[1]}: already exists" in refused("picture", folder, "-o", places[1])
    assert all(
        p.is_symlink() if kind == "link" else p.read_bytes() == b"a year of work" for p in places
    )
    assert not victim.exists()


def test_no_module_of_the_working_folder_runs_and_no_backend_of_a_notebook(
    recorded: Recorded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    for name in ("pyvista", "numpy", "remodel_fenicsx"):
        (theirs / f"{name}.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    monkeypatch.chdir(theirs)
    monkeypatch.setenv(
        "MPLBACKEND", "module://matplotlib_inline.backend_inline"
    )  # as in a kernel of Jupyter
    assert cli.main(["picture", str(recorded("cube")), "-o", str(tmp_path / "x.png")]) == 0
    assert not (tmp_path / "ran").exists() and sorted(os.listdir(theirs)) == sorted(
        ["numpy.py", "pyvista.py", "remodel_fenicsx.py"]
    )
