"""Many seeds of random cells: means and bands, one failure that loses only itself, nothing done twice."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx import Recording, SceneError, cli, read_scene
from remodel_fenicsx.evolution.coupling import Staggered
from remodel_fenicsx.running import run
from remodel_fenicsx.scene.scene import Scene
from remodel_fenicsx.studies import ensemble as study
from remodel_fenicsx.studies.members import Member, run_members
from remodel_fenicsx.system.interrupts import Paused
from tests import forks
from tests.conftest import forked_children
from tests.parts import pulled_cube

END = 5.0


def scene(**tables: object) -> Scene:
    """The pulled cube."""
    return pulled_cube(END, **tables)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, study.Ensemble]:
    """Three seeds, of which the second cannot write, and isotropic cells."""
    folder = tmp_path_factory.mktemp("ensemble") / "out"
    folder.mkdir()
    (folder / "seed-2").write_text("a file of the user's\n")
    with forked_children():
        return study.ensemble(scene(), folder, seeds=3)


def test_one_that_fails_loses_only_itself(made: tuple[Path, study.Ensemble]) -> None:
    folder, found = made
    assert list(found.failed) == ["seed-2"] and "seed-2" in found.failed["seed-2"]
    assert (folder / "seed-2").read_text() == "a file of the user's\n"
    assert found.seeds == 2 and found.time.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]


def test_the_table_is_that_of_the_runs(made: tuple[Path, study.Ensemble]) -> None:
    folder, _ = made
    runs = [Recording(folder / f"seed-{seed}") for seed in (1, 3)]
    assert [run.scene.cells.seed for run in runs] == [1, 3]
    lines = [line for line in (folder / "ensemble.csv").read_text().splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    for row, when in enumerate(runs[0].history["time"]):
        one, two = (run.history["mean_stretch"][row] for run in runs)
        assert float(rows[row]["time"]) == when
        assert float(rows[row]["mean_stretch_mean"]) == pytest.approx((one + two) / 2, rel=1e-6)
        assert float(rows[row]["mean_stretch_deviation"]) == pytest.approx(abs(one - two) / 2**0.5, rel=1e-4, abs=1e-6)
        assert float(rows[row]["mean_stretch_most"]) == pytest.approx(max(one, two), rel=1e-6)
    isotropic = Recording(folder / "isotropic")
    assert isotropic.scene.cells.initial == "isotropic"
    assert float(rows[-1]["mean_stretch_isotropic"]) == pytest.approx(isotropic.history["mean_stretch"][-1], rel=1e-6)
    assert (folder / "ensemble.png").stat().st_size > 10_000


def test_what_is_there_is_not_run_again(made: tuple[Path, study.Ensemble]) -> None:
    folder, found = made
    before = {path: path.stat().st_mtime_ns for path in folder.glob("*/history.csv")}
    with forked_children():
        _, again = study.ensemble(scene(), folder, seeds=3)
    assert {path: path.stat().st_mtime_ns for path in folder.glob("*/history.csv")} == before
    np.testing.assert_array_equal(again.columns["mean_stretch"], found.columns["mean_stretch"])
    with pytest.raises(SceneError, match="holds a run of another scene"):
        study.ensemble(scene(solver={"maximum_halvings": 3}), folder, seeds=3)


@pytest.mark.parametrize(
    ("code", "said"), [(3, "no equilibrium"), (4, "SIGUSR1: all is kept"), (-9, "it said nothing")]
)
def test_the_command_says_whose_run_has_failed_or_was_stopped(
    code: int,
    said: str,
    tmp_path: Path,
    made: tuple[Path, study.Ensemble],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The others are evaluated; the exit code is 3."""

    def ended(program: str, *words: str) -> subprocess.CompletedProcess[str]:
        assert program == "remodel-fenicsx" and "seed-2" in " ".join(words)
        return subprocess.CompletedProcess(words, code, "", f"remodel-fenicsx: {said}\n")

    monkeypatch.setattr(forks, "forked", ended)
    monkeypatch.setattr(study, "draw", lambda *of: None)
    path = tmp_path / "scene.toml"
    path.write_text(scene().to_toml())
    with forked_children():
        assert cli.main(["ensemble", str(path), "-o", str(made[0]), "--seeds", "3", "-q"]) == 3
    written = capsys.readouterr()
    assert "time 5, 2 seeds" in written.out and f"seed-2 has failed: {said}" in written.err


def test_what_was_stopped_goes_on(
    tmp_path: Path, made: tuple[Path, study.Ensemble], monkeypatch: pytest.MonkeyPatch
) -> None:
    """At a step of its own choice; the same command goes on to the same end."""
    (member,) = [member for member in study.members_of(scene(), tmp_path, 3) if member.name == "seed-3"]
    solve = Staggered.solve

    def signalled(coupling: Staggered, time: float, loads: Any) -> Any:
        if time == 2.0:
            signal.raise_signal(signal.SIGUSR1)
        return solve(coupling, time, loads)

    monkeypatch.setattr(Staggered, "solve", signalled)
    with pytest.raises(Paused):
        run(member.scene, member.folder, MPI.COMM_SELF)
    assert member.steps_done == 2 and not member.is_complete()
    with forked_children():
        assert run_members([member], 1, "test", quiet=True) == {}
    assert member.is_complete()
    whole = Recording(made[0] / "seed-3").history
    np.testing.assert_array_equal(member.history()["mean_stretch"], whole["mean_stretch"])


def test_a_signal_ends_all_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "scene.toml", tmp_path / "out"
    path.write_text(pulled_cube(5000.0).to_toml())
    asked = Member.steps_done.fget
    assert asked is not None

    def then_stop(member: Member) -> int:
        steps = asked(member)
        if steps:
            os.kill(os.getpid(), signal.SIGTERM)
        return int(steps)

    monkeypatch.setattr(Member, "steps_done", property(then_stop))
    code = cli.main(["ensemble", str(path), "-o", str(out), "--seeds", "2", "--jobs", "1"])
    assert code == 128 + signal.SIGTERM
    assert "stopped; all that is recorded is kept, the same command goes on" in capsys.readouterr().err
    members = study.members_of(read_scene(path), out, 2)
    assert any(asked(member) for member in members) and not any(member.is_complete() for member in members)


def test_words_say_whether_the_cheap_model_is_enough() -> None:
    times = np.array([0.0, 1.0])
    values = np.array([[1.0, 2.0], [1.0, 4.0]])
    found = study.Ensemble(times, {"stretch": values, "force": np.ones((2, 2))}, {"stretch": np.array([1.0, 3.5])}, {})
    text = study.in_words(found, [1.0])
    assert "+0.4 deviations: within the spread" in text and "force" not in text
    found.isotropic["stretch"][1] = 30.0
    assert "+19.1 deviations: outside of it" in study.in_words(found, [1.0])


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(scene(output={"fields": False}).with_values({"cells.initial": "isotropic"}).to_toml())
    assert cli.main(["ensemble", str(path), "-o", str(tmp_path / "out")]) == 2
    assert "an ensemble is one of 'random' cells" in capsys.readouterr().err
    assert cli.main(["ensemble", str(path), "--seeds", "1"]) == 2
    assert "--seeds 1: allowed is a whole number at least 2" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
