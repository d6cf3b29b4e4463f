"""Many seeds of random cells: means and bands, one failure that loses only itself, nothing done twice."""

from __future__ import annotations

import signal
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx import Recording, SceneError, cli
from remodel_fenicsx.evolution.coupling import Staggered
from remodel_fenicsx.results.status import status
from remodel_fenicsx.running import run
from remodel_fenicsx.scene.scene import Scene, scene_from_dict
from remodel_fenicsx.studies import sweep as study
from remodel_fenicsx.studies.study import Study, TooFewRuns
from remodel_fenicsx.system.interrupts import Paused
from tests.conftest import Refused, forked_children
from tests.parts import pulled_cube
from tests.tables import of_csv

END = 5.0


def scene(**tables: object) -> Scene:
    """The pulled cube."""
    return pulled_cube(END, **tables)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, study.Ensemble]:
    """Three seeds, of which the second cannot write."""
    folder = tmp_path_factory.mktemp("ensemble") / "out"
    folder.mkdir()
    (folder / "seed-2").write_text("a file of the user's\n")
    with forked_children():
        return study.ensemble(scene(), folder, seeds=3)


def test_one_that_fails_loses_only_itself(
    made: tuple[Path, study.Ensemble], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The others are evaluated, and not run again; the command names it, and its exit code is 3."""
    folder, found = made
    assert (
        list(found.failed) == ["seed-2"]
        and "seed-2" in found.failed["seed-2"]
        and len(found.histories) == 2
    )
    assert status(folder) == [f"{folder}: 2 runs: 2 finished"]  # the third has not begun
    (tmp_path / "scene.toml").write_text(scene().to_toml())
    before = {path: path.stat().st_mtime_ns for path in folder.glob("*/history.csv")}
    with forked_children():
        assert (
            cli.main(
                ["ensemble", str(tmp_path / "scene.toml"), "-o", str(folder), "--seeds", "3", "-q"]
            )
            == 3
        )
    written = capsys.readouterr()
    assert "At time 5, mean of 2 seeds: " in written.out and "seed-2 has failed: " in written.err
    assert {path: path.stat().st_mtime_ns for path in folder.glob("*/history.csv")} == before
    assert (folder / "seed-2").read_text() == "a file of the user's\n"
    with pytest.raises(SceneError, match="holds a run of another scene"):
        study.ensemble(scene(solver={"maximum_halvings": 3}), folder, seeds=3)


def test_the_table_is_that_of_the_runs(made: tuple[Path, study.Ensemble]) -> None:
    folder, _ = made
    runs = [Recording(folder / name) for name in ("seed-1", "seed-3")]
    assert [run.scene.cells.seed for run in runs] == [1, 3]
    rows = of_csv(folder / "ensemble.csv")
    found = [
        [float(row[f"mean_stretch_{kind}"]) for row in rows] for kind in ("mean", "std", "max")
    ]
    one, two = (run.history["mean_stretch"] for run in runs)
    expected = [(one + two) / 2, np.abs(one - two) / 2**0.5, np.maximum(one, two)]
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)
    assert [float(row["time"]) for row in rows] == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    assert (folder / "ensemble.png").stat().st_size > 10_000


def test_two_seeds_are_needed(tmp_path: Path) -> None:
    """Runs that have failed are no bad input."""
    for seed in (2, 3):
        (tmp_path / f"seed-{seed}").write_text("a file of the user's\n")
    with (
        forked_children(),
        pytest.raises(TooFewRuns, match="1 of 3 runs reached the end, .* are kept") as too_few,
    ):
        study.ensemble(pulled_cube(1.0), tmp_path, seeds=3)
    assert list(too_few.value.failed) == ["seed-2", "seed-3"] and too_few.value.exit_code == 3


def test_what_was_stopped_goes_on(
    tmp_path: Path, made: tuple[Path, study.Ensemble], monkeypatch: pytest.MonkeyPatch
) -> None:
    """At a step of its own choice; the same command goes on to the same end."""
    third = {"output.fields": False, "name": "seed-3", "cells.seed": 3}
    both = Study("ensemble", scene(), tmp_path, {"seed-3": scene().with_values(third)}, jobs=1)
    (member,) = both.runs
    solve = Staggered.solve

    def signalled(coupling: Staggered, time: float, loads: Any) -> Any:
        if time == 2.0:
            signal.raise_signal(signal.SIGUSR1)
        return solve(coupling, time, loads)

    monkeypatch.setattr(Staggered, "solve", signalled)
    with pytest.raises(Paused):
        run(member.scene, member.folder, MPI.COMM_SELF)
    assert len(member.history()["time"]) == 3 and not member.is_complete()
    with forked_children(), closing(both):
        both.run_all()
    assert both.failed == {} and member.is_complete()
    whole = Recording(made[0] / "seed-3").history
    np.testing.assert_array_equal(member.history()["mean_stretch"], whole["mean_stretch"])


def of_seeds(scene: Scene, columns: dict[str, np.ndarray]) -> study.Ensemble:
    """An ensemble of columns (seeds, rows) at times 0, 1, ..."""
    seeds, rows = next(iter(columns.values())).shape
    time = {"time": np.arange(float(rows))}
    histories = {
        f"seed-{n}": time | {name: values[n] for name, values in columns.items()}
        for n in range(seeds)
    }
    points = {name: {"cells.seed": number} for number, name in enumerate(histories)}
    return study.Ensemble(scene, points, histories)


def test_words_say_how_far_seeds_are_apart() -> None:
    """Stretches of mean 3 and standard deviation 1 at the end; what is the same for all is left out."""
    ends = np.array([-1.0, 1.0] * 4) * np.sqrt(7 / 8) + 3.0
    values = {"mean_stretch": np.stack([np.ones(8), ends], axis=1), "force": np.ones((8, 2))}
    text = of_seeds(pulled_cube(1.0), values).in_words()
    assert "mean_stretch" in text and "force" not in text
    said = "At time 1, mean of 8 seeds: mean_stretch is 3, with a standard deviation of 1."
    assert text.splitlines()[-1] == said
    same = of_seeds(pulled_cube(1.0), {"force": values["force"]})
    assert same.verdict() == "At time 1 no column differs between the 8 seeds."


def test_bad_input_is_one_line(tmp_path: Path, refused: Refused) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(
        scene(output={"fields": False}).with_values({"cells.initial": "isotropic"}).to_toml()
    )
    assert "an ensemble needs 'random' cells" in refused("ensemble", path, "-o", tmp_path / "out")
    assert "--seeds 1: must be an integer of at least 2" in refused(
        "ensemble", path, "--seeds", "1"
    )
    assert not (tmp_path / "out").exists()


def test_seeds_of_a_quarter_say_that_their_deviations_are_not_those_of_the_whole() -> None:
    tube = {"preset": "kuhl-holzapfel-2007", "profile": "balanced", "geometry": {"shape": "tube"}}
    found = of_seeds(scene_from_dict(tube), {"outer_radius": np.eye(6)[:, 4:]})
    assert "The standard deviations are not those of the whole body: 'sector': " in found.verdict()
