"""What settings cost and how far they are from the finest: errors, what is said of them, and the command."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from remodel_fenicsx import Recording, cli, read_scene
from remodel_fenicsx.body.shape import PROFILE, PROFILE_PLACES, profile_weights
from remodel_fenicsx.results.status import status
from remodel_fenicsx.scene.presets import PROFILES
from remodel_fenicsx.scene.scene import Scene, preset_scene
from remodel_fenicsx.studies import trade
from tests.conftest import forked_children
from tests.reference.radial import solve_radial
from tests.tables import of_csv

PAPER = "kuhl-holzapfel-2007"
SMOOTH = np.array([[1.0, 2.0, -1.0], [0.5, 1.0, 0.0]])


def artery(**changes: Any) -> Scene:
    """Isotropic cells."""
    return preset_scene(PAPER, "tube").with_values({"cells.initial": "isotropic", **changes})


def made_up(setting: trade.Setting, noise: float = 0.0) -> trade.Result:
    """A result with an error of first order in the step and of second in the size of elements, and noise of seeds."""
    step = min(setting.step, setting.scene.time.tolerance or np.inf)
    error = 0.4 * step * SMOOTH + 1.6 * setting.element**2 * SMOOTH[:, ::-1]
    scatter = noise * np.random.default_rng(len(setting.name)).normal(
        size=(len(setting.seeds), *SMOOTH.shape)
    )
    angles = 45.0 + error + scatter
    cost = {"full": 100.0}.get(setting.scene.model.kinematics, 1.0) / setting.element / step
    return trade.Result(setting, angles, 2.0 * (1 + 0.01 * (angles[..., :2] - 45.0)), cost)


def compared(noise: float = 0.0, **changes: Any) -> list[trade.Row]:
    """Rows of all of the artery's ladder."""
    return trade.compared([made_up(setting, noise) for setting in trade.ladder(artery(**changes))])


# ---------------------------------------------------------------- errors
def test_errors_are_differences_from_the_finest_and_trusted_where_that_is_finer_in_both() -> None:
    rows = {row.setting.name: row for row in compared()}
    finest = made_up(rows["radial-4-degree-2-step-0.25"].setting)
    for name, row in rows.items():
        if name == finest.setting.name:
            assert (
                np.isnan(row.angle_error)
                and row.doubt == "the other settings are compared with it"
                and not row.on_front
            )
            continue
        apart = made_up(row.setting).angles - finest.angles
        assert row.angle_error == pytest.approx(trade.nanrms(apart))
        assert row.length_error == pytest.approx(np.abs(0.01 * apart[..., :2]).max(), rel=0.02)
    doubts = {name: rows[f"radial-{name}"].doubt for name in ("1-degree-1-step-1", "2-degree-2-step-1",
              "4-degree-2-step-1", "1-degree-1-step-0.25", "4-degree-2-step-0.25")}  # fmt: skip
    shared = "the finest has no finer "
    assert [*doubts.values()][:4] == ["", "", f"{shared}elements", f"{shared}steps"]


def test_seeds_are_compared_one_by_one() -> None:
    """What all settings have of a seed is no error and no noise; what each setting draws anew is both."""
    random = {"cells.initial": "random"}
    assert {row.setting.seeds for row in compared(**random)} == {(1, 2, 3)}
    results = [made_up(setting) for setting in trade.ladder(artery(**random))]
    shift = np.array([-5.0, 0.0, 5.0])[:, None, None]
    moved = trade.compared([replace(result, angles=result.angles + shift) for result in results])
    for row, same in zip(trade.compared(results), moved, strict=True):
        assert (
            same.angle_error == pytest.approx(row.angle_error, nan_ok=True)
            and same.doubt == row.doubt
        )
    rows = compared(noise=1.0, **random)
    noises = {
        row.doubt.removeprefix("noise of random cells "): row
        for row in rows
        if "noise" in row.doubt
    }
    assert len(noises) > 3 and all(
        row.angle_error < 2.1 * float(noise) for noise, row in noises.items()
    )
    assert (
        0.5 < np.median([float(noise) for noise in noises]) < 1.2
    )  # sqrt(2/3), of two means over three


def test_the_front() -> None:
    assert trade.pareto([1.0, 2.0, 3.0, 3.0], [4.0, 2.0, 3.0, 1.0]) == [True, True, False, True]
    assert trade.pareto([1.0, 2.0], [np.nan, 1.0]) == [False, True]
    # as they are shown: the second one is dearer by more than timings are known to, and no better
    assert trade.pareto([10.01, 12.0, 9.99], [0.502, 0.498, 0.504]) == [True, False, True]


# ---------------------------------------------------------------- the ladder
def test_the_ladder_has_each_setting_once_and_all_can_be_run() -> None:
    scene = artery()
    settings = trade.ladder(scene)
    named = {setting.name: setting for setting in settings}
    assert len(named) == len(settings) > 20
    assert {setting.scene.model.kinematics for setting in settings} == {"radial", "sector", "full"}
    coarse = {name.removeprefix("radial-1-degree-1-step-") for name in named}
    assert {"0.125", "0.25", "0.5", "1", "2.5", "5"} <= coarse
    assert {f"profile-{name}" for name in PROFILES} <= set(named)
    fast = {"model.kinematics": "radial", "time.tolerance": 1.0, "mesh.formulation": "auto"}
    assert named["profile-fast"].scene == scene.with_values(fast)
    assert (
        named["profile-reference"].cost < 0.1 * named["full-1-degree-1-step-1"].cost
    )  # measured: a fiftieth
    for setting in settings:
        run = trade.as_run(setting, 3)
        assert run.cells.seed == 3 and not run.output.times and not run.output.fields
        assert setting.scene.output == scene.output


def test_a_point_has_no_mesh() -> None:
    """No row for one, and no doubt for want of one."""
    scene = preset_scene(PAPER, "cube").with_values({"cells.initial": "isotropic"})
    settings = trade.ladder(scene)
    assert {(setting.scene.mesh.refinement, setting.scene.mesh.degree) for setting in settings} == {
        (1, 1)
    }
    points = [setting for setting in settings if setting.scene.model.kinematics == "point"]
    rows = trade.compared([made_up(setting) for setting in points])
    assert len(rows) > 10 and not any("elements" in row.doubt for row in rows)


def test_hats_add_up_to_one_and_are_one_at_their_places() -> None:
    np.testing.assert_allclose(profile_weights(np.linspace(0, 1, 37)).sum(axis=-1), 1.0)
    np.testing.assert_allclose(
        profile_weights(np.linspace(0, 1, PROFILE_PLACES)), np.eye(PROFILE_PLACES), atol=1e-15
    )


# ---------------------------------------------------------------- the command
def test_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a cube whose stress is the same everywhere: three steps, of which one fails at first; a row is a scene."""
    for name, value in {
        "STEPS": (2.0, 0.5),
        "MESHES": (),
        "TOLERANCES": (),
        "PROFILES": {},
    }.items():
        monkeypatch.setattr(trade, name, value)
    monkeypatch.setattr(trade, "objections", lambda scene, name: ["left out by the test"])
    path, out = tmp_path / "cube.toml", tmp_path / "out"
    changes = {"model.kinematics": "point", "time.end": 20.0, "remodeling.kappa": 0.1}
    path.write_text(preset_scene(PAPER, "cube").with_values(changes).to_toml())

    def traded(folder: Path, budget: str = "10min") -> tuple[int, str]:
        with forked_children():
            code = cli.main(
                ["trade", str(path), "-o", str(folder), "--jobs", "12", "--budget", budget, "-q"]
            )
        return code, "".join(capsys.readouterr())

    out.mkdir()
    names = [f"point-1-degree-1-step-{step}" for step in ("2", "1", "0.5")]
    (out / f"{names[2]}-1").write_text("a file of the user's: this run fails")
    code, said = traded(out)
    assert (
        code == 3
        and f"{names[2]}-1 has failed: " in said
        and status(out) == [f"{out}: 2 runs: 2 finished"]
    )
    before = {file: file.stat().st_mtime_ns for file in out.glob("*/history.csv")}
    (out / f"{names[2]}-1").unlink()
    assert traded(out)[0] == 0 and {file: file.stat().st_mtime_ns for file in before} == before
    table = sorted(of_csv(out / "trade.csv"), key=lambda entry: names.index(entry["setting"]))
    assert list(table[0])[:5] == [
        "setting",
        "scene",
        "error_degrees",
        "error_stretch",
        "cpu_seconds",
    ]
    scenes = [read_scene(out / entry["scene"]) for entry in table]
    assert [one.time.step for one in scenes] == [2.0, 1.0, 0.5] and scenes[0].output.fields is True
    assert [entry["trusted"] for entry in table] == ["1", "1", "0"] and table[2][
        "error_degrees"
    ] == "nan"
    # the closed form of the printed scheme: a row of fixed steps has the angle of one step before
    times, columns = np.linspace(0.0, 20.0, 10)[1:], []
    for step in (2.0, 1.0, 0.5):
        rows = np.arange(0.0, 20.5, step)
        s = 1 - np.exp(-0.1 * np.maximum(rows - step, 0.0))
        columns.append(
            np.interp(
                times, rows, np.degrees(np.arctan(np.sqrt(2) * (1 - s) / (1 - s + np.sqrt(3) * s)))
            )
        )
    apart = [trade.nanrms(column - columns[2]) for column in columns[:2]]
    np.testing.assert_allclose(
        [float(entry["error_degrees"]) for entry in table[:2]], apart, rtol=1e-5
    )
    monkeypatch.setattr(trade, "TOLERANCES", (0.5,))
    code, said = traded(out, "0.001s")
    assert code == 0 and "left out, over the budget: point-1-degree-1-tolerance-0.5" in said
    code, said = traded(tmp_path / "none", "0.001s")
    assert (
        code == 4
        and "0 of 4 settings reached the end within the budget of 0.001 s, at least 2 are needed"
        in said
    )
    assert "set a larger budget to continue" in said


@pytest.mark.slow
def test_trusted_errors_of_the_artery_are_the_true_ones(tmp_path: Path) -> None:
    """Against the one-dimensional reference with small steps: eight of ten rows within a factor of two."""
    scene = artery(**{"model.kinematics": "radial"})
    folder, found = trade.trade(scene, tmp_path / "out", budget=3000.0)
    times = [25.0 * number for number in range(1, 7)]
    coarse, fine = (_reference(step, times) for step in (1 / 8, 1 / 16))
    ratios = []
    for row in found.rows:
        if not row.doubt:
            history = Recording(folder / f"{row.setting.name}-1").history
            angles = np.transpose(
                [np.interp(times, history["time"], history[name]) for name in PROFILE]
            )
            ratios.append(row.angle_error / trade.nanrms(angles - (2 * fine - coarse)))
    assert len(ratios) > 8 and np.mean([0.5 <= ratio <= 2.0 for ratio in ratios]) >= 0.8, sorted(
        ratios
    )


def _reference(step: float, times: list[float]) -> np.ndarray:
    """Angles of the reference, at the times and places that are compared."""
    history = solve_radial(step=step, elements=150)
    hats = profile_weights((history.points - 1.0) / 2.0) * history.areas[:, None]
    rows = [history.dimensions[round(time / step) - 1] for time in times]
    angles = np.array([np.degrees(np.arctan2(row[:, 1], row[:, 0])) for row in rows])
    return np.asarray(angles @ hats / hats.sum(axis=0))
