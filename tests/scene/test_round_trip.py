"""A scene as run reads back as the same scene: every key, with every kind of value that it takes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import pytest
from pydantic import TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from remodel_fenicsx import SceneError, preset_scene, read_scene
from remodel_fenicsx.body import SHAPES
from remodel_fenicsx.scene.scene import Scene, scene_from_dict
from remodel_fenicsx.schema.tables import choices, sections
from tests.mesh_files import write_tube
from tests.values import ramp_to

RAMP = ramp_to(1.0)
LOAD = {"kind": "pressure", "face": "outer", "value": 1.0, "ramp": RAMP}
NAMES = {"regions": "media", "loads": "wall", "supports": "outer"}  # that some base has
# one of each kind of value that TOML has, and what some keys ask for; None is a key that is not there
VALUES: list[Any] = [
    None, True, False, 0, 1, 2, 7, 0.0, 0.25, 0.3, 0.5, 1.1, 30.0, 1500.0, "mm", "kPa", "10 mm", "1.5 kPa",
    "/tmp/ä' \"b.vtu", "a" * 64, "equilibrium", "kuhl-holzapfel-2007", "fast", "inner", "pressure", "clamped",
    [], [0.5], [1.0], [0.6, 0.8, 0.0], [0.9, 1.25], RAMP, ["fibre_angle", "cells"], ["outer_area"], ["lumen_volume"],
    {}, {"axial": 1.1}, {"value": 2.0, "ramp": RAMP}, {"wall": LOAD}, {"inner": 3, "outer": ["outer"]},
    {"ksp_type": "preonly", "snes_monitor": True}, {"media": {}}, {"media": {"outer_radius": 2.0}}, {"time": 3.0},
    {"kind": "elastic", "stiffness": 1.0}, [{"from": 0.25, "to": 0.5, "prestretch": {"axial": 1.1}}],
    [{"weight": 0.5, "loads": {}}, {"weight": 0.5, "loads": {"pressure": 2.0}}],
]  # fmt: skip
NOT_REACHED = {
    "geometry",
    "cells.fibres",
    "cells.fraction_x",
    "cells.fraction_y",
}  # a whole table; it takes the place of cells.initial (regions have it); two that go together


@pytest.fixture(scope="module")
def bases(tmp_path_factory: pytest.TempPathFactory) -> list[Scene]:
    """Scenes that between them can have every key."""
    file = write_tube(tmp_path_factory.mktemp("scenes") / "tube.msh")
    pressure = {"value": 1.0, "ramp": RAMP}
    mesh = {
        "geometry": {"shape": "mesh", "file": str(file), "length_unit": "mm"},
        "loads": {"pressure": pressure, "wall": LOAD},
        "supports": {"outer": {"kind": "elastic", "stiffness": 1.0}},
        "time": {"end": 3.0},
    }
    tube = preset_scene("kuhl-holzapfel-2007", "tube")
    return [
        tube.with_values({"regions": {"media": {"outer_radius": 2.0}, "adventitia": {}}}),
        tube.with_values(
            {"geometry.length_unit": "mm", "geometry.is": "loaded", "time.end": "equilibrium"}
        ),
        scene_from_dict(mesh),
        scene_from_dict(
            {
                "geometry": {"shape": "solid", "file": str(file)},
                "loads": {"wall": LOAD | {"kind": "traction", "direction": [0.0, 0.0, 1.0]}},
                "time": {"end": 3.0},
            }
        ),
        preset_scene("consistent", "tube").with_values(
            {"cells.initial": "isotropic", "regions": {"media": {"outer_radius": 2.0}, "rest": {}}}
        ),
        *(preset_scene("consistent", shape) for shape in ("cube", "tendon", "sheet")),
    ]


def keys() -> Iterator[tuple[str, FieldInfo]]:
    """Dotted key and field; those of a list of tables are among the values of the list."""
    tables = [*sections(Scene), *(("geometry", "", shape) for shape in SHAPES.values())]
    for key, _, table in tables:
        if "[]" not in key:
            table_name = key.replace("NAME", NAMES.get(key.partition(".")[0], ""))
            for name, field in table.model_fields.items():
                yield ".".join(filter(None, [table_name, field.alias or name])), field


def fitting(field: FieldInfo) -> Iterator[Any]:
    """Values that its type alone takes, texts with units as they are: to try a scene costs more."""
    kind: Any = TypeAdapter(
        Annotated[field.annotation, *field.metadata] if field.metadata else field.annotation
    )
    for value in (*choices(field), *VALUES):
        with suppress(ValidationError):
            with suppress(KeyError):  # which shape a table means is said by the base
                if value not in (None, {}, "10 mm", "1.5 kPa"):
                    kind.validate_python(value)
            yield value


def test_every_key_with_every_kind_of_value(bases: list[Scene], tmp_path: Path):
    path, reached, asked, seen = tmp_path / "scene.toml", set(), dict(keys()), set()
    for key, field in asked.items():
        for base in bases:
            for value in fitting(field):
                if key.endswith((".file", "cells.fibres")) and not Path(str(value)).is_absolute():
                    continue  # read_scene puts the scene's folder before it
                try:
                    scene = base.with_values({key: value})
                except SceneError:
                    continue
                reached |= {key} if value is not None else set()
                if (
                    whole := scene.model_dump_json()
                ) not in seen:  # many values, and no value, make the same scene
                    path.write_text(scene.to_toml(), encoding="utf-8")
                    assert read_scene(path) == scene, f"{key} = {value!r} of a {base.geometry.name}"
                seen.add(whole)
            if key in reached:
                break
    assert set(asked) - reached == NOT_REACHED
