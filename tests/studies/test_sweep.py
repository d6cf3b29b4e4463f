"""Runs over numbers of a scene: closed form of the end, nothing done twice, bad input in one line."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from remodel_fenicsx import cli, preset_scene
from remodel_fenicsx.results.recording import RunLock
from remodel_fenicsx.results.status import status
from remodel_fenicsx.studies.study import label_of_key
from remodel_fenicsx.studies.sweep import latin_hypercube, read_axes, sweep
from tests.conftest import Refused, forked_children
from tests.tables import of_csv, rows as table

PAPER = "kuhl-holzapfel-2007"


@pytest.fixture
def cube(tmp_path: Path) -> Path:
    """A homogeneous cube whose angle at the end has a closed form."""
    changes = {"model.kinematics": "point", "time.end": 20.0, "time.step": 1.0}
    path = tmp_path / "cube.toml"
    path.write_text(preset_scene(PAPER, "cube").with_values(changes).to_toml())
    return path


def test_keys_are_those_of_people_from_python_too(tmp_path: Path) -> None:
    """A key that the scene converts, by words and by numbers: the same runs; the axis has its unit."""
    changes = {"model.kinematics": "point", "time.end": 2.0, "geometry.length_unit": "mm"}
    scene = preset_scene(PAPER, "cube").with_values(changes)
    stiffness = {"material.initial_stiffness": [5.0, 10.0], "loads.force.value": [4.0]}
    words = "material.initial_stiffness=5:10:2 loads.force.value=4"
    with forked_children():
        both = [sweep(scene, axes, tmp_path / "out")[1] for axes in (stiffness, words)]
    first, second = (one.ends["mean_stretch"] for one in both)
    assert first[0] > first[1] > 1.0 and (first == second).all()
    labels = [panel.get_xlabel() for panel in both[0].figure().axes[-2:]]
    assert labels == ["initial stiffness, Pa", "force, µN"]
    others = {"material.chain_density": "chain density, 1/m³", "natural.opening_angle": "opening angle, °",
              "geometry.side": "side, mm", "remodeling.kappa": "kappa", "material.temperature": "temperature, K"}  # fmt: skip
    assert {key: label_of_key(scene, key) for key in others} == others


def rows(folder: Path) -> list[dict[str, str]]:
    return of_csv(folder / "sweep.csv")


def test_the_ends_follow_the_closed_form(
    cube: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The angle of the printed scheme after 19 steps, for three kappas; a finer sweep runs what is new."""
    out = tmp_path / "out"
    with forked_children():
        words = ["sweep", str(cube), "remodeling.kappa=0.05:0.15:3", "-o", str(out), "-q"]
        assert cli.main(words) == 0
        said = capsys.readouterr().out
        assert "remodeling.kappa 0.15" in said and f"results in {out}" in said
        table = rows(out)
        assert [float(row["remodeling.kappa"]) for row in table] == [0.05, 0.1, 0.15]
        for row in table:
            s = 1 - np.exp(-float(row["remodeling.kappa"]) * 19.0)
            expected = np.degrees(np.arctan(np.sqrt(2) * (1 - s) / (1 - s + np.sqrt(3) * s)))
            assert float(row["mean_fibre_angle"]) == pytest.approx(expected, abs=1e-5)
        before = {path: path.stat().st_mtime_ns for path in out.glob("*/history.csv")}
        (out / "sweep.json").unlink()  # as a folder of 0.3.0
        (out / "sweep.csv").write_text(
            f"# remodel_fenicsx figures 0.3.0: sweep\n{(out / 'sweep.csv').read_text()}"
        )
        assert cli.main([*words[:2], "remodeling.kappa=0.05:0.15:5", *words[3:]]) == 0
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert len(rows(out)) == 5 and len(list(out.glob("*/history.csv"))) == 5
    assert (out / "sweep.png").stat().st_size > 10_000
    assert status(out)[0] == f"{out}: 5 runs: 5 finished"


def test_a_run_that_fails_is_nan_and_named(
    cube: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its folder's name is taken by a file."""
    out = tmp_path / "out"
    out.mkdir()
    (out / "remodeling.kappa-0.1_loads.force.value-4").write_text("a file of the user's")
    with forked_children():
        words = ["remodeling.kappa=0.05,0.1", "loads.force.value=4:8:2", "-o", str(out), "-q"]
        assert cli.main(["sweep", str(cube), *words]) == 3
    assert "remodeling.kappa-0.1_loads.force.value-4 has failed: " in capsys.readouterr().err
    angles = {
        (row["remodeling.kappa"], row["loads.force.value"]): row["mean_fibre_angle"]
        for row in rows(out)
    }
    assert sorted(angles) == [("0.05", "4"), ("0.05", "8"), ("0.1", "4"), ("0.1", "8")]
    assert [key for key, angle in angles.items() if not np.isfinite(float(angle or "nan"))] == [
        ("0.1", "4")
    ]
    run = out / "remodeling.kappa-0.05_loads.force.value-4"
    (run / "history.csv").write_text(
        "".join((run / "history.csv").read_text().splitlines(keepends=True)[:-1])
    )
    with (run / "run.log").open("a") as log:
        log.write("2026-01-01 00:00:00,000 INFO failed: no equilibrium\n")
    assert status(out) == [
        f"{out}: 3 runs: 1 failed, 2 finished",
        f"{run.name} has failed: no equilibrium",
    ]


def test_drawn_numbers_outside_of_a_range_are_failed_points(
    cube: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Refused
) -> None:
    """The ends that are typed are allowed together; of the points some are no scenes, and the others are run."""
    out = tmp_path / "out"
    with forked_children():
        words = [
            "cells.end_to_end_length=1.5:2.5",
            "material.contour_length=1.6:2.6",
            "--latin",
            "6",
            "-o",
            str(out),
        ]
        assert cli.main(["sweep", str(cube), *words, "-q"]) == 3
    table, errors = rows(out), capsys.readouterr().err
    beyond = [
        float(r["cells.end_to_end_length"]) >= float(r["material.contour_length"]) for r in table
    ]
    assert len(table) == 6 and 0 < sum(beyond) < 5
    assert [not np.isfinite(float(row["mean_fibre_angle"] or "nan")) for row in table] == beyond
    assert errors.count("has failed: ") == sum(beyond) and "Traceback" not in errors
    said = refused("sweep", cube, "remodeling.kappa=-3:-2", "--latin", "5", "-o", tmp_path / "no")
    assert "remodeling.kappa = -" in said and not (tmp_path / "no").exists()


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a scene and a sweep of it, out/."""
    folder = tmp_path_factory.mktemp("done")
    changes = {"model.kinematics": "point", "time.end": 2.0, "name": "cube"}
    (folder / "cube.toml").write_text(preset_scene(PAPER, "cube").with_values(changes).to_toml())
    with forked_children():
        assert cli.main(sweep_of(folder)) == 0
    return folder


def sweep_of(folder: Path) -> list[str]:
    """The words of its command."""
    return [
        "sweep",
        str(folder / "cube.toml"),
        "remodeling.kappa=0.05,0.1,0.15",
        "-o",
        str(folder / "out"),
        "-q",
    ]


@pytest.mark.parametrize(
    ("file", "damage"),
    [
        *(("history.csv", damage) for damage in ("folder", "pipe", "other columns", "cut")),
        *(
            ("scene.toml", damage)
            for damage in ("folder", "pipe", "a = 1", "\0", "", "cells.seed = -1")
        ),
    ],
)
def test_a_damaged_finished_run_is_left_out_and_named(
    done: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], file: str, damage: str
) -> None:
    """The others are the answer; nothing of the damaged folder is removed."""
    shutil.copytree(done, tmp_path, dirs_exist_ok=True)
    path = tmp_path / "out" / "remodeling.kappa-0.1" / file
    text = path.read_text()
    path.unlink()
    if damage in ("folder", "pipe"):
        path.mkdir() if damage == "folder" else os.mkfifo(path)
    else:
        path.write_text(
            {"cut": text[:-20], "other columns": text.replace("time,", "time,other,", 1)}.get(
                damage, damage
            )
        )
    with forked_children():
        assert cli.main(sweep_of(tmp_path)) == 3
    said = capsys.readouterr().err.strip()
    assert (
        said.startswith("remodel-fenicsx: remodeling.kappa-0.1 has failed: ") and "\n" not in said
    )
    assert str(path.parent) in said and len(said) < 600
    angles = [float(row["mean_fibre_angle"]) for row in rows(tmp_path / "out")]
    assert np.isfinite(angles).tolist() == [True, False, True]
    assert path.is_dir() == (damage == "folder")


def test_each_part_of_each_range_has_one_point() -> None:
    """And another seed has others."""
    ranges = {"a.b": (2.0, 6.0), "a.c": (-1.0, 1.0)}
    points = latin_hypercube(ranges, 8)
    for key, (low, high) in ranges.items():
        parts = [int((float(point[key]) - low) / (high - low) * 8) for point in points]
        assert sorted(parts) == list(range(8))
    assert points == latin_hypercube(ranges, 8) != latin_hypercube(ranges, 8, seed=2)


def test_whole_numbers_stay_whole() -> None:
    found = read_axes(["mesh.refinement=1:3:3", "remodeling.kappa=0.1:0.3:3"])
    assert found == {"mesh.refinement": [1, 2, 3], "remodeling.kappa": [0.1, 0.2, 0.3]}
    assert all(isinstance(number, int) for number in found["mesh.refinement"])


@pytest.mark.parametrize(("words", "said"), table(__file__, "refused_sweeps.txt"))
def test_bad_input_is_one_line(cube: Path, words: str, said: str, refused: Refused) -> None:
    """Exit code 2, before any run."""
    assert said in refused("sweep", cube, *words.split(), "-o", cube.parent / "out", "-q")
    assert not (cube.parent / "out").exists()


def test_two_equal_studies_do_not_share_a_folder(
    done: Path, tmp_path: Path, refused: Refused
) -> None:
    """The second names the first; when that has ended it may."""
    shutil.copytree(done, tmp_path, dirs_exist_ok=True)
    with forked_children():
        with RunLock(tmp_path / "out"):
            before = sorted(tmp_path.rglob("*"))
            said = refused(*sweep_of(tmp_path))
            assert sorted(tmp_path.rglob("*")) == before
        assert f"process {os.getpid()} on " in said and f"{tmp_path}/out: " in said
        assert cli.main(sweep_of(tmp_path)) == 0
    assert not (tmp_path / "out" / "run.lock").exists()
