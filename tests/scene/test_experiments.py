"""Numbers of experiments in place of the model's own: initial stiffness, locking stretch, half-life."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from remodel_fenicsx import read_scene
from remodel_fenicsx.scene.scene import Scene, scene_from_dict
from remodel_fenicsx.schema.text import set_nested
from tests.runs import last_row


def cube(**changes: Any) -> Scene:
    """Aligned chains along the load that stay as they are."""
    values: dict[str, Any] = {
        "geometry": {"shape": "cube"},
        "cells": {"initial": "aligned"},
        "remodeling": {"law": "none"},
        "loads": {"force": {"value": 1e-4, "ramp": [[0.0, 1.0]]}},
        "time": {"step": 1.0, "end": 1.0},
        "output": {"fields": False},
    }
    for key, value in changes.items():
        set_nested(values, key, value)
    return scene_from_dict(values)


@pytest.mark.parametrize("factor", [1, 4])
def test_the_initial_stiffness_is_what_a_run_shows(factor: int) -> None:
    """Young's modulus of the matrix and that of the network add up along the chains: across, these bear nothing."""
    keys = {
        "material.initial_stiffness": "0.05 kPa",
        "material.energy_factor": factor,
        "cells.end_to_end_length": 0.8,
    }
    scene = cube(**keys)
    stretch = last_row(scene)["mean_stretch"]
    lame_lambda, mu = scene.material.lame_lambda, scene.material.lame_mu
    matrix = mu * (3 * lame_lambda + 2 * mu) / (lame_lambda + mu)
    strain = 1e-4 / scene.geometry.section_area / (matrix + 50.0)
    assert stretch - 1 == pytest.approx(strain, rel=1e-4)


def test_they_become_the_models_own_numbers(tmp_path: Path) -> None:
    """The scene as run has these, and is read back as it was."""
    keys = {
        "material.locking_stretch": 1.5,
        "remodeling.half_life": 10.0,
        "cells.end_to_end_length": 2.0,
    }
    scene = cube(**keys)
    assert scene.material.contour_length == pytest.approx(3.0, rel=1e-14)
    assert scene.remodeling.kappa == pytest.approx(math.log(2) / 10, rel=1e-14)
    assert scene.material.locking_stretch is None and scene.remodeling.half_life is None
    path = tmp_path / "scene.toml"
    path.write_text(scene.to_toml())
    assert read_scene(path).to_toml() == scene.to_toml()


def test_the_stiffness_asks_for_the_locking_stretch_of_the_same_scene() -> None:
    """Both together are what the contour length and the density of chains are together."""
    both = cube(**{"material.initial_stiffness": 5.0, "material.locking_stretch": 1.2})
    one = cube(**{"material.initial_stiffness": 5.0, "material.contour_length": 1.2})
    assert both.material.chain_density == one.material.chain_density
    softer = cube(**{"material.initial_stiffness": 5.0}).material
    assert both.material.chain_density < softer.chain_density


def test_a_region_has_its_own() -> None:
    """Each from the region's other numbers, or those of the body."""
    values = {
        "geometry": {"shape": "tube", "inner_radius": 1.0, "outer_radius": 3.0, "length": 8.0},
        "material": {"locking_stretch": 1.4},
        "regions": {
            "media": {
                "outer_radius": 2.0,
                "material": {"initial_stiffness": 8.0},
                "remodeling": {"half_life": 20.0},
            },
            "adventitia": {"material": {"locking_stretch": 1.2, "initial_stiffness": 8.0}},
        },
        "time": {"step": 1.0, "end": 1.0},
    }
    found = scene_from_dict(values).properties()
    media, adventitia = found["media"], found["adventitia"]
    assert (media.material.contour_length, adventitia.material.contour_length) == (1.4, 1.2)
    assert media.kappa == pytest.approx(math.log(2) / 20)
    assert media.material.chain_density > adventitia.material.chain_density


def test_a_changed_one_replaces_what_was_there() -> None:
    """Sweeps and fits set them on scenes that have every value."""
    changes = {"remodeling.half_life": 7.0, "material.initial_stiffness": 3.0}
    scene, again = cube().with_values(changes), cube(**changes)
    assert scene.remodeling.kappa == again.remodeling.kappa
    assert scene.material.chain_density == again.material.chain_density
