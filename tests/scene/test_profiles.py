"""Profiles: settings that lie over the preset's and under the scene's own, or over all of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from remodel_fenicsx import cli, read_scene
from remodel_fenicsx.scene.presets import PROFILES
from remodel_fenicsx.scene.scene import scene_from_dict
from tests.conftest import Refused

TUBE = {"preset": "kuhl-holzapfel-2007", "geometry": {"shape": "tube"}}  # of random cells
ISOTROPIC = TUBE | {"cells": {"initial": "isotropic"}}


@pytest.mark.parametrize("name", PROFILES)
def test_a_profile_lies_over_the_preset_and_under_the_scene(name: str) -> None:
    scene = scene_from_dict(ISOTROPIC | {"profile": name})
    assert (
        scene.model.kinematics == "auto"
        and scene.time.tolerance == PROFILES[name].values["time.tolerance"]
    )
    assert scene.mesh.degree == PROFILES[name].values["mesh.degree"]
    own = scene_from_dict(
        ISOTROPIC | {"profile": name, "mesh": {"refinement": 5}, "model": {"kinematics": "full"}}
    )
    assert own.mesh.refinement == 5 and own.model.kinematics == "full"
    assert own.mesh.degree == PROFILES[name].values["mesh.degree"]


def test_each_is_finer_than_the_one_before() -> None:
    errors = [(profile.degrees, profile.values["time.tolerance"]) for profile in PROFILES.values()]
    assert errors == sorted(errors, reverse=True)
    assert [profile.seconds for profile in PROFILES.values()] == sorted(
        p.seconds for p in PROFILES.values()
    )


def test_on_the_command_line_it_lies_over_the_scene(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Refused
) -> None:
    path = tmp_path / "artery.toml"
    path.write_text(scene_from_dict(ISOTROPIC).to_toml())
    assert read_scene(path).mesh.degree == 1
    scene = read_scene(path, ["mesh.refinement=3"], "balanced")
    assert scene.mesh.degree == 2 and scene.mesh.refinement == 3 and scene.profile == "balanced"
    assert read_scene(path, [], "balanced").with_values({}) == read_scene(path, [], "balanced")
    assert cli.main(["validate", str(path), "--profile", "fast"]) == 0
    words = capsys.readouterr().out
    assert "steps with an error below 1 degrees" in words
    assert PROFILES["fast"].in_words("fast") in words
    said = refused("run", "--resume", tmp_path, "--profile", "fast")
    assert "--profile: a run resumes in its own folder, with its own settings" in said


@pytest.mark.parametrize("name", ["fast", "balanced"])
@pytest.mark.parametrize(("changes", "kinematics"), [
    ({}, "sector"),
    ({"remodeling": {"law": "rotation"}}, "auto"),  # leaves the planes of symmetry
    ({"loads": {"pressure": {"value": -4.8}}}, "auto"),  # suction may make it buckle
    ({"geometry": {"shape": "tendon"}}, "auto"),
    ({"model": {"kinematics": "full"}}, "full"),  # the scene's own
])  # fmt: skip
def test_random_cells_keep_mesh_and_steps(
    name: str, changes: dict[str, Any], kinematics: str, tmp_path: Path
) -> None:
    """Both decide which cells are drawn, and what all seeds have in common; on the command line too."""
    plain = scene_from_dict({**TUBE, **changes})
    scene = scene_from_dict({**TUBE, **changes, "profile": name})
    assert scene.model.kinematics == kinematics and scene.solver.relative_tolerance == 1e-6
    assert scene.cells.antithetic == (kinematics != "auto")
    mesh = plain.mesh.model_copy(update={"formulation": "auto"})
    assert (scene.mesh, scene.time, scene.remodeling) == (mesh, plain.time, plain.remodeling)
    path = tmp_path / "scene.toml"
    path.write_text(plain.to_toml())
    over = read_scene(path, ["solver.relative_tolerance=1e-8"], name)
    assert over.model.kinematics == (
        "sector" if kinematics == "full" else kinematics
    )  # over all that the file says
    assert over.solver.relative_tolerance == 1e-8 and over.time == plain.time
