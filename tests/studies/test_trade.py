"""What settings cost and how far off they are: the estimates, what is said of them, and the command."""

from __future__ import annotations

import csv
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from remodel_fenicsx import Recording, cli, read_scene
from remodel_fenicsx.body.shape import PROFILE, PROFILE_PLACES, profile_weights
from remodel_fenicsx.results.recording import HistoryColumns
from remodel_fenicsx.results.status import status
from remodel_fenicsx.scene.presets import PROFILES
from remodel_fenicsx.scene.scene import Scene, preset_scene
from remodel_fenicsx.studies import trade
from tests.conftest import forked_children
from tests.reference.radial import solve_radial

PAPER = "kuhl-holzapfel-2007"
SMOOTH = np.array([[1.0, 2.0, -1.0], [0.5, 1.0, 0.0]])


def artery(**changes: Any) -> Scene:
    """Isotropic cells."""
    return preset_scene(PAPER, "tube").with_values({"cells.initial": "isotropic", **changes})


def made_up(setting: trade.Setting, noise: float = 0.0, jagged: float = 0.0) -> trade.Result:
    """A result with an error of first order in the step and of second in the size of elements over their degree."""
    kinematics, refinement, degree = setting.mesh
    step = setting.step or setting.scene.time.tolerance or 0.0
    error = 0.4 * step * SMOOTH + 1.6 / (refinement * degree**2) ** 2 * SMOOTH[:, ::-1]
    if jagged:
        error = jagged * np.sin(1e3 * step + refinement) * SMOOTH
    angles, lengths = 45.0 + error, 2.0 * (1 + 0.01 * error[:, :2])
    cost = refinement * degree / step * {"full": 100.0}.get(kinematics, 1.0)
    return trade.Result(setting, angles, lengths, cost, cost, noise, (angles, lengths))


def estimated(**how: float) -> tuple[list[trade.Row], list[str]]:
    """Rows and notes on all of the artery's ladder."""
    return trade.estimated([made_up(setting, **how) for setting in trade.ladder(artery())])


def assert_right(rows: list[trade.Row]) -> None:
    """Each says its own error."""
    for row in rows:
        exact = trade.typical(row.result.angles - 45.0)
        assert row.angle_error == pytest.approx(exact, rel=0.05, abs=2e-3), row.result.setting.name


# ---------------------------------------------------------------- estimates
def test_an_order_is_seen_and_what_is_left_with_it() -> None:
    for order in (1, 2, 4):
        found = trade.limit([10.0 + 0.5 ** (order * k) * SMOOTH for k in range(4)])
        assert found.trusted and found.order == pytest.approx(order)
        np.testing.assert_allclose(found.beyond, -(0.5 ** (3 * order)) * SMOOTH, rtol=1e-9)


@pytest.mark.parametrize("results", [
    [SMOOTH, 0 * SMOOTH, SMOOTH], [SMOOTH, 1.1 * SMOOTH, 1.21 * SMOOTH], [SMOOTH, 0.5 * SMOOTH],
    [SMOOTH, 0 * SMOOTH, np.array([[0.3, -0.3, 0.0], [0.0, 0.3, 0.3]])],
], ids=["to and fro", "growing", "too few", "another way"])  # fmt: skip
def test_where_no_order_shows_nothing_is_extrapolated(results: list[np.ndarray]) -> None:
    found = trade.limit(results)
    assert not found.trusted and not found.beyond.any()


def test_estimates_are_the_errors_of_a_smooth_problem() -> None:
    rows, notes = estimated()
    assert_right(rows)
    assert not any(row.doubt for row in rows)
    assert any(note.startswith("time: order 1 (steps 1, 0.5, 0.25 on refinement 2, degree 2)") for note in notes)
    assert any(note.startswith("mesh: order 2 (refinements 1, 2, 4 of degree 2)") for note in notes)


def test_doubts_are_said() -> None:
    rows, notes = estimated(jagged=1.0)
    assert any("no order seen" in note for note in notes)
    assert any(row.doubt == "no order seen" for row in rows)
    rows, _ = estimated(noise=1.0)
    assert {row.doubt for row in rows if row.angle_error < 1.0} == {"noise of random cells 1"}
    only_time = [made_up(s) for s in trade.ladder(artery()) if s.mesh == ("radial", 1, 1)]
    rows, notes = trade.estimated(only_time)
    assert "mesh: fewer than two settings were run, so its error is in no estimate" in notes
    assert {row.doubt for row in rows} == {"a factor was not varied"}


def test_random_cells_are_compared_in_the_mean() -> None:
    """A step on the cells of one seed is compared with another step on the same cells."""
    shift = 5.0
    results = []
    for setting in trade.ladder(artery(**{"cells.initial": "random"})):
        result = made_up(setting)
        single = result.angles + shift, result.lengths
        if len(setting.seeds) == 1:
            result = replace(result, angles=result.angles + shift, single=single)
        else:
            result = replace(result, noise=0.01, single=single)
        results.append(result)
    assert {len(result.setting.seeds) for result in results} == {1, trade.SEEDS}
    rows, _ = trade.estimated(results)
    for row in rows:
        assert row.angle_error < 5.0


def test_the_front() -> None:
    assert trade.pareto([1.0, 2.0, 3.0, 3.0], [4.0, 2.0, 3.0, 1.0]) == [True, True, False, True]
    assert trade.pareto([1.0, 2.0], [np.nan, 1.0]) == [False, True]
    # as they are shown: the second one is dearer by more than timings are known to, and no better
    assert trade.pareto([10.01, 12.0, 9.99], [0.502, 0.498, 0.504]) == [True, False, True]


# ---------------------------------------------------------------- the ladder
def test_the_ladder_has_each_setting_once_and_all_can_be_run() -> None:
    scene = artery()
    settings = trade.ladder(scene)
    assert len({setting.name for setting in settings}) == len(settings) > 20
    assert {setting.mesh[0] for setting in settings} == {"radial", "sector", "full"}
    coarse = [s for s in settings if s.mesh == ("radial", 1, 1) and s.step]
    assert sorted(s.step or 0 for s in coarse) == [0.125, 0.25, 0.5, 1, 2.5, 5]
    profiles = {s.profile: s for s in settings if s.profile}
    assert list(profiles) == [s.profile for s in settings if s.profile] and set(profiles) == set(PROFILES)
    fast = {"model.kinematics": "radial", "time.tolerance": 1.0, "mesh.formulation": "auto"}
    assert profiles["fast"].scene == scene.with_values(fast)
    assert profiles["reference"].expected_seconds < 5.0  # measured: 1.4
    times = trade.compared_times(scene, settings)
    assert times[0] == 5.0 and 25.0 in times and times[-1] == 150.0
    for setting in settings:
        run = trade.as_run(setting, 3, times)
        assert run.cells.seed == 3 and run.output.times == tuple(times) and not run.output.fields
        assert setting.scene.output == scene.output


def test_a_tendon_of_random_cells_stays_whole_and_has_seeds() -> None:
    settings = trade.ladder(preset_scene(PAPER, "tendon"))
    assert {setting.mesh[0] for setting in settings} == {"full"}
    assert {setting.seeds for setting in settings} == {(1,), (1, 2, 3)}


def test_a_point_has_no_mesh() -> None:
    """No row for one, no doubt for want of one, no word of one."""
    scene = preset_scene(PAPER, "cube").with_values({"cells.initial": "isotropic"})
    settings = trade.ladder(scene)
    assert {setting.mesh[1:] for setting in settings} == {(1, 1)} and len(settings) > 10
    points = [setting for setting in settings if setting.mesh[0] == "point"]
    rows, notes = trade.estimated([made_up(setting) for setting in points])
    assert not any(row.doubt for row in rows) and not any("mesh" in note for note in notes)


def test_hats_add_up_to_one_and_are_one_at_their_places() -> None:
    np.testing.assert_allclose(profile_weights(np.linspace(0, 1, 37)).sum(axis=-1), 1.0)
    np.testing.assert_allclose(profile_weights(np.linspace(0, 1, PROFILE_PLACES)), np.eye(PROFILE_PLACES), atol=1e-15)


def test_noise_is_the_standard_error_of_the_mean() -> None:
    """Of seeds whose angles differ by a known standard deviation; the angles are their mean."""
    setting = next(s for s in trade.ladder(artery(**{"cells.initial": "random"})) if len(s.seeds) == trade.SEEDS)
    spread, times = np.array([-1.0, 0.0, 1.0]), [0.0, 1.0]  # a sample of standard deviation 1

    def history(number: int) -> HistoryColumns:
        columns = dict.fromkeys(PROFILE, np.full(2, 30.0 + spread[number]))
        columns |= dict.fromkeys(("inner_radius", "outer_radius", "seconds"), np.ones(2))
        return HistoryColumns(columns, time=np.array(times), processor_seconds=np.full(2, 1.0 + number))

    members = [SimpleNamespace(history=lambda number=number: history(number)) for number in range(3)]
    result = trade.read(setting, members, times)  # type: ignore[arg-type]
    assert result.noise == pytest.approx(3**-0.5)
    np.testing.assert_allclose(result.angles, 30.0)
    assert result.seconds == pytest.approx(4.0)  # of one run, two rows of 1, 2 and 3
    assert trade.read(setting, members[:1], times).noise == 0.0  # type: ignore[arg-type]


# ---------------------------------------------------------------- the command
def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """On a cube whose stress is the same everywhere: three steps; again: nothing is run; a row is a scene."""
    for name, value in {"STEPS": (2.0, 0.5), "MESHES": (), "TOGETHER": (), "TOLERANCES": (), "PROFILES": {}}.items():
        monkeypatch.setattr(trade, name, value)
    path, out = tmp_path / "cube.toml", tmp_path / "out"
    changes = {"model.kinematics": "point", "time.end": 20.0, "remodeling.kappa": 0.1}
    path.write_text(preset_scene(PAPER, "cube").with_values(changes).to_toml())
    monkeypatch.setattr(trade, "objections", lambda scene, name: ["left out by the test"])
    out.mkdir()
    (out / "point-1-degree-1-step-0.5-1").write_text("a file of the user's: this run fails")
    with forked_children():
        assert cli.main(["trade", str(path), "-o", str(out), "--jobs", "12", "-q"]) == 3
        assert "point-1-degree-1-step-0.5-1 has failed: " in capsys.readouterr().err
        assert status(out) == [f"{out}: 2 runs: 2 finished"]
        (out / "point-1-degree-1-step-0.5-1").unlink()
        assert cli.main(["trade", str(path), "-o", str(out), "--jobs", "12", "--budget", "10min"]) == 0
    words = capsys.readouterr().out
    assert "time: order 1.1 (steps 2, 1, 0.5 on refinement 1, degree 1)" in words and "mesh:" not in words
    names = [f"point-1-degree-1-step-{step}" for step in ("2", "1", "0.5")]
    assert [name in (out / "trade.csv").read_text() for name in names] == [True] * 3
    with (out / "trade.csv").open() as file:
        table = list(csv.DictReader(file))
    assert list(table[0])[:7] == ["setting", "scene", "error_degrees", "error_stretch", "cpu_seconds", "on_front",
                                  "trusted"]  # fmt: skip
    for entry in table:
        assert read_scene(out / entry["scene"]).time.step == float(entry["setting"].split("-")[5])
        assert entry["trusted"] == "1" and float(entry["error_degrees"]) > 0 and float(entry["cpu_seconds"]) > 0
    assert (out / "trade.png").stat().st_size > 10_000
    assert [read_scene(out / f"{name}-1.toml").time.step for name in names] == [2.0, 1.0, 0.5]
    row = read_scene(out / "rows" / f"{names[2]}.toml")
    assert row.time.step == 0.5 and row.output.fields is True and row.name == "cube"
    # the closed form of the printed scheme: a row of fixed steps has the angle of one step before
    last = Recording(out / f"{names[0]}-1").history["angle_profile_2"][-1]
    s = 1 - np.exp(-0.1 * 18.0)
    assert last == pytest.approx(np.degrees(np.arctan(np.sqrt(2) * (1 - s) / (1 - s + np.sqrt(3) * s))), abs=1e-6)

    assert status(out) == [f"{out}: 3 runs: 3 finished"]
    before = {file: file.stat().st_mtime_ns for file in out.glob("*/history.csv")}
    assert len(before) == 3
    assert cli.main(["trade", str(path), "-o", str(out), "-q"]) == 0
    assert {file: file.stat().st_mtime_ns for file in out.glob("*/history.csv")} == before
    with monkeypatch.context() as patch:
        patch.setattr(trade, "TOLERANCES", (0.5,))
        assert cli.main(["trade", str(path), "-o", str(out), "--budget", "0.001s", "-q"]) == 0
    assert "left out, over the budget: point-1-degree-1-tolerance-0.5" in capsys.readouterr().out
    assert cli.main(["trade", str(path), "-o", str(tmp_path / "none"), "--budget", "0.001s", "-q"]) == 4
    said = capsys.readouterr().err
    assert said.startswith("remodel-fenicsx: 0 of 3 settings reached the end within the budget of 0.001 s, at least 2")
    assert said.endswith("is kept, a larger budget goes on\n")
    assert said.count("\n") == 1
    for kept in (names[0] + "-1", names[0] + "-1.toml"):  # one run says what all take
        (shutil.copytree if (out / kept).is_dir() else shutil.copy)(out / kept, tmp_path / "one" / kept)
    assert cli.main(["trade", str(path), "-o", str(tmp_path / "one"), "--budget", "0.001s", "-q"]) == 4
    said = capsys.readouterr().err
    assert "1 of 3 settings" in said and re.search(r"all settings take about [\d.e-]+ min more \(--budget\)\n$", said)


def test_what_is_doubted_is_not_trusted(tmp_path: Path) -> None:
    rows, notes = estimated(noise=0.3)
    trade.Trade(artery(), rows, notes).write(tmp_path)
    with (tmp_path / "trade.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [entry["trusted"] == "1" for entry in table] == [entry["doubt"] == "" for entry in table]
    assert {entry["trusted"] for entry in table} == {"0", "1"} and "error_radii" in table[0]


@pytest.mark.slow
def test_estimates_of_the_artery_are_the_true_errors(tmp_path: Path) -> None:
    """Against the one-dimensional reference with small steps: eight of ten rows within a factor of two."""
    scene = artery(**{"model.kinematics": "radial"})
    folder, found = trade.trade(scene, tmp_path / "out", budget=3000.0)
    times = trade.compared_times(scene, trade.ladder(scene))
    coarse, fine = (_reference(step, times) for step in (1 / 8, 1 / 16))
    true = {row.result.setting.name: trade.typical(row.result.angles - (2 * fine - coarse)) for row in found.rows}
    ratios = [row.angle_error / true[row.result.setting.name] for row in found.rows]
    assert np.mean([0.5 <= ratio <= 2.0 for ratio in ratios]) >= 0.8, sorted(ratios)


def _reference(step: float, times: list[float]) -> np.ndarray:
    """Angles of the reference, at the times and places that are compared."""
    history = solve_radial(step=step, elements=150)
    hats = profile_weights((history.points - 1.0) / 2.0) * history.areas[:, None]
    rows = [history.dimensions[round(time / step) - 1] for time in times]
    angles = np.array([np.degrees(np.arctan2(row[:, 1], row[:, 0])) for row in rows])
    return np.asarray(angles @ hats / hats.sum(axis=0))
