"""Folders of runs of earlier versions: they are read, shown and gone on with; a newer one is refused plainly.

run-VERSION.zip is the folder that three steps of the paper's cube left with that version; layers-VERSION.zip is of a
tube with regions, natural.opening_angle and turnover (0.2.0 has none of these).
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from remodel_fenicsx import Recording, __version__, cli, preset_scene, run
from tests.conftest import Refused


def unpacked(name: str, place: Path) -> Path:
    """The folder of a run."""
    with zipfile.ZipFile(Path(__file__).with_name(f"{name}.zip")) as archive:
        archive.extractall(place / "run")
    return place / "run"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The run of 0.2.0."""
    return unpacked("run-0.2.0", tmp_path)


@pytest.mark.usefixtures("drawn_by_forks")
@pytest.mark.parametrize(
    "kept", ["run-0.2.0", "run-0.3.0", "run-0.4.0", "layers-0.3.0", "layers-0.4.0"]
)
def test_folders_of_each_release_are_whole_for_each_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kept: str
) -> None:
    """They are validated, shown, drawn and gone on with; turnover is on where it was."""
    folder = unpacked(kept, tmp_path)
    assert Recording(folder).scene.remodeling.turnover.is_on == kept.startswith("layers")
    for words in ("status", "report", "picture", "run -q --set time.end=4 --resume"):
        assert cli.main([*words.split(), str(folder)]) == 0, capsys.readouterr().err
    assert cli.main(["validate", str(folder / "scene.toml")]) == 0
    np.testing.assert_array_equal(Recording(folder).times, np.arange(5.0))


def test_a_run_with_the_coupling_that_went_is_read_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of 'implicit'; going on is refused with a line that says who can, and what new runs take."""
    folder = unpacked("implicit-0.4.0", tmp_path)
    for words in ("status", "report"):
        assert cli.main([words, str(folder)]) == 0
    assert Recording(folder).scene.remodeling.coupling == "implicit"
    assert cli.main(["run", "--resume", str(folder), "--set", "time.end=3"]) == 2
    assert (
        "remodeling.coupling = 'implicit': only version 0.4.0 can continue this run"
        in capsys.readouterr().err
    )


def test_it_goes_on_as_if_this_version_had_begun_it(folder: Path, tmp_path: Path) -> None:
    """The same rows, and the log says that the version is another one."""
    assert (
        cli.main(["run", "--resume", str(folder), "--set", "time.end=5", "-q", "--no-report"]) == 0
    )
    whole = Recording(
        run(
            preset_scene("kuhl-holzapfel-2007", "cube").with_values({"time.end": 5.0}),
            tmp_path / "new",
        )
    )
    found, expected = Recording(folder).history, whole.history
    np.testing.assert_array_equal(found["time"], expected["time"])
    for name in (
        "force",
        "mean_stretch",
        "mean_fibre_angle",
        "max_chain_extension",
        "stored_energy",
    ):
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-7, err_msg=name)
    said = f"resumes with remodel_fenicsx {__version__}, but was started with 0.2.0"
    assert said in (folder / "run.log").read_text()


def newer_scene(folder: Path) -> None:
    """Of a later format."""
    text = (folder / "scene.toml").read_text()
    (folder / "scene.toml").write_text(text.replace("\nformat = 2\n", "\nformat = 99\n"))


def newer_checkpoints(folder: Path) -> None:
    """The same."""
    for path in folder.glob("checkpoint*.npz"):
        with np.load(path) as file:
            arrays = dict(file)
        header = json.loads(arrays["header"].tobytes()) | {"format": 99}
        np.savez(path, **arrays | {"header": np.frombuffer(json.dumps(header).encode(), np.uint8)})


@pytest.mark.parametrize("change", [newer_scene, newer_checkpoints])
def test_what_a_newer_version_has_left_is_refused_in_one_line(
    folder: Path, refused: Refused, change: Callable[[Path], None]
) -> None:
    """Nothing changes in the folder."""
    change(folder)
    kept = {path: path.read_bytes() for path in folder.iterdir()}
    assert "newer version" in refused("run", "--resume", folder, "--set", "time.end=5", "-q")
    assert {path: path.read_bytes() for path in folder.iterdir()} == kept
