"""The JSON Schema of scenes: it takes what the reader takes and, key by key, refuses what the reader refuses."""

from __future__ import annotations

import copy
import json
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from remodel_fenicsx import SceneError, cli, read_scene
from remodel_fenicsx.body import SHAPES
from remodel_fenicsx.scene.reference import json_schema
from remodel_fenicsx.scene.presets import PRESETS
from remodel_fenicsx.scene.scene import preset_scene, scene_from_dict
from remodel_fenicsx.schema.text import set_nested
from tests.conftest import Refused
from tests.scene.test_bad_input import ODD_NUMBERS, ODD_TEXTS, changed
from tests.scene.test_scene import WRONG
from tests.tables import HUGE

jsonschema = pytest.importorskip("jsonschema", reason="python3-jsonschema is not there")

ROOT = Path(__file__).parents[2]
SCHEMA = json_schema()
CHECK = jsonschema.Draft202012Validator(SCHEMA)
WHOLE = [
    preset_scene(preset, shape)
    for preset, shapes in PRESETS.items()
    for shape in shapes
    if preset != "sun-2002"
]


def is_read(values: dict[str, Any]) -> bool:
    try:
        scene_from_dict(values)
    except SceneError:
        return False
    return True


def artery(**changes: Any) -> dict[str, Any]:
    """A whole scene without a preset, with other values by dotted key, whose dots are double underscores."""
    values = tomllib.loads(preset_scene("kuhl-holzapfel-2007", "tube").to_toml())
    del values["preset"]
    for key, value in changes.items():
        set_nested(values, key.replace("__", "."), value)
    return values


def test_it_is_a_schema():
    jsonschema.Draft202012Validator.check_schema(SCHEMA)


@pytest.mark.parametrize(
    "path", sorted((ROOT / "demos").glob("*.toml")), ids=lambda path: path.stem
)
def test_demos_are_valid(path: Path):
    assert not list(CHECK.iter_errors(tomllib.loads(path.read_text())))
    assert not list(
        CHECK.iter_errors(tomllib.loads(read_scene(path).to_toml()))
    ), "as run, with all its keys"


@pytest.mark.parametrize("scene", WHOLE, ids=lambda scene: f"{scene.preset}-{scene.geometry.name}")
def test_every_key_of_a_preset_is_valid(scene: Any):
    values = tomllib.loads(scene.to_toml())
    assert CHECK.is_valid(values)
    for table, entries in values.items():
        for key in entries if isinstance(entries, dict) else ():
            faulty = copy.deepcopy(values)
            faulty[table][f"{key}s"] = faulty[table].pop(key)
            assert not CHECK.is_valid(faulty), f"{table}.{key}s"


# of numbers a schema in JSON knows less: what is no number, or has no end
WRONG_FOR_BOTH = [
    (key, value)
    for key, value in WRONG
    if value not in (float("inf"), int(HUGE)) and value == value
]


@pytest.mark.parametrize(("key", "value"), WRONG_FOR_BOTH, ids=str)
def test_what_one_key_has_wrong_is_refused_as_the_reader_does(key: str, value: Any):
    assert not is_read(artery(**{key: value}))
    assert not CHECK.is_valid(artery(**{key: value}))


def test_what_always_must_be_there_is_asked_for():
    values = artery()
    del values["geometry"]
    assert not is_read(values) and not CHECK.is_valid(values)


def test_a_value_may_have_a_unit_where_the_reader_takes_one():
    units = artery(
        geometry__length_unit="mm", geometry__length="8 mm", loads__pressure__value="100 mmHg"
    )
    assert is_read(units) and CHECK.is_valid(units)
    for key in ("remodeling__kappa", "cells__end_to_end_length"):
        assert not is_read(artery(**{key: "1 mm"})) and not CHECK.is_valid(
            artery(**{key: "1 mm"})
        ), key


@settings(
    max_examples=300, derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
@given(
    shape=st.sampled_from(["cube", "tube"]),
    place=st.integers(0, 200),
    kind=st.sampled_from(["replace", "remove", "add"]),
    value=st.one_of(
        st.sampled_from(
            [number for number in ODD_NUMBERS if abs(number) < 1e308 and number == number]
        ),
        st.sampled_from([*ODD_TEXTS, "free", "auto", "direct", "equilibrium", "8 mm"]),
        st.booleans(),
        st.lists(st.floats(0, 2), max_size=3),
    ),
)
def test_whatever_the_reader_takes_is_valid(shape: str, place: int, kind: str, value: Any):
    values = changed(shape, [(place, kind, value)])
    assert CHECK.is_valid(values) or not is_read(values), list(CHECK.iter_errors(values))


def test_a_shape_of_a_script_is_in_it(monkeypatch: pytest.MonkeyPatch):
    class Rod(SHAPES["cube"]):  # type: ignore[misc, valid-type]
        shape: Any = "rod"

    monkeypatch.setitem(SHAPES, "rod", Rod)
    values = {"geometry": {"shape": "rod"}, "preset": "kuhl-holzapfel-2007"}
    assert not CHECK.is_valid(values) and jsonschema.Draft202012Validator(json_schema()).is_valid(
        values
    )


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Refused):
    assert cli.main(["schema"]) == 0
    printed = capsys.readouterr().out
    assert json.loads(printed) == json.loads(json.dumps(SCHEMA))
    assert cli.main(["schema", "-o", str(tmp_path / "s.json")]) == 0
    assert (tmp_path / "s.json").read_text(encoding="utf-8") == printed
    assert "already exists; must be a new file" in refused("schema", "-o", tmp_path / "s.json")
