"""demos/figures.py: names, numbers against closed forms; runs that are kept; pictures in space; the page of them."""

from __future__ import annotations

import importlib.util
import os
import re
import signal
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

import remodel_fenicsx
from docs.making import verification
from docs.making.pages import read_table
from remodel_fenicsx.scene.scene import Scene
from tests.forks import forked

PACKAGE = Path(remodel_fenicsx.__file__).parent
DOCS = PACKAGE.parent / "docs"


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


@pytest.mark.parametrize(("arguments", "named"), [
    (["fig12"], "fig12: no such figure; allowed are fig1, fig5"), (["fig1", "--jobs", "0"], "--jobs 0"),
    (["fig1", "-o", "taken"], "-o taken: is a file"), (["fig1", "--runs", "taken"], "--runs taken: is a file"),
])  # fmt: skip
def test_bad_input_is_one_line_and_writes_nothing(
    arguments: list[str],
    named: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
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


# ---------------------------------------------------------------- which recorded runs are valid


def begun_in_a_fork(scene: Scene, folder: Path, begin: Any = figures.begin) -> Any:
    """A run with the words of the script, which has ended."""

    def ended(command: list[str], env: dict[str, str]) -> SimpleNamespace:
        code = forked(*command, variables=env).returncode
        return SimpleNamespace(returncode=code, poll=lambda: code)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "subprocess", SimpleNamespace(Popen=ended))
        return begin(scene, folder)


# ---------------------------------------------------------------- figures 1 and 5 against closed forms


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with figs. 1 and 5, drawn by the script from runs of its own."""
    folder = tmp_path_factory.mktemp("drawn")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "begin", begun_in_a_fork)
        assert draw(patch, "fig1", "fig5", "-o", folder, "--runs", folder / "runs") == 0
    return folder


@pytest.mark.parametrize("name", ["fig1", "fig5"])
def test_the_numbers_are_those_of_the_page(drawn: Path, name: str) -> None:
    found, kept = (read_table(folder / f"{name}.csv") for folder in (drawn, DOCS / "figures"))
    assert list(found) == list(kept)
    for column, values in kept.items():
        np.testing.assert_allclose(found[column], values, rtol=1e-6, atol=1e-6)


def test_fig1_is_eq_2(drawn: Path) -> None:
    table = read_table(drawn / "fig1.csv")
    x = table["extension"]
    assert len(x) > 100 and x[0] == 0 and 0.9 < x[-1] < 1
    for A in (0.1, 0.4, 0.8):
        np.testing.assert_allclose(
            table[f"force_A_{A}"], (4 * x + (1 - x) ** -2 - 1) / (4 * A), rtol=1e-6, atol=1e-12
        )


def test_valid_runs_are_used_again_and_own_figures_drawn_anew(
    drawn: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    histories = sorted((drawn / "runs").glob("cube-*/history.csv"))
    assert len(histories) == 4
    before = [path.stat().st_mtime_ns for path in histories]
    (drawn / "fig5.png").write_bytes((drawn / "fig5.png").read_bytes()[:4096])
    assert draw(monkeypatch, "fig5", "-o", drawn, "--runs", drawn / "runs") == 0
    assert [path.stat().st_mtime_ns for path in histories] == before
    with Image.open(drawn / "fig5.png") as picture:
        picture.load()


# ---------------------------------------------------------------- all of it


@pytest.mark.slow
def test_all_numbers_are_those_of_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """To what another machine rounds: of angles in elements that hardly decide."""
    assert draw(monkeypatch, "-o", tmp_path, "--runs", tmp_path / "runs") == 0
    tables = [
        path for name in figures.FIGURES for path in (DOCS / "figures").glob(f"{name}[.-]*csv")
    ]
    assert len(tables) == 14
    for path in tables:
        found, kept = (read_table(folder / path.name) for folder in (tmp_path, DOCS / "figures"))
        assert list(found) == list(kept)
        for column, values in kept.items():
            if values.dtype.kind == "f":
                np.testing.assert_allclose(
                    found[column], values, rtol=1e-4, atol=0.01, err_msg=f"{path} {column}"
                )


# ---------------------------------------------------------------- docs/verification.md


def test_the_verification_page_is_what_its_data_says() -> None:
    """Whoever draws anew and forgets the page, or edits it by hand, is told: run docs/make verification."""
    text = (DOCS / "verification.md").read_text(encoding="utf-8")
    assert verification.page() == text  # every number again, from the tables beside the pictures
    shown = re.findall(r"!\[.*\]\((.*)\)", text)
    assert {f"figures/{name}.png" for name in figures.FIGURES} < set(shown)
    for name in shown:
        assert 5_000 < (DOCS / name).stat().st_size < 300_000
