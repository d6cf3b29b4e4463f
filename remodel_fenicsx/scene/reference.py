"""The reference of keys, docs/scene.md, and the JSON Schema of scenes for editors."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, get_args, get_origin

import tomlkit
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from remodel_fenicsx.body import SHAPES, Shape
from remodel_fenicsx.scene.presets import PRESETS, PRESET_NOTES, PROFILES, RANDOM_CELLS
from remodel_fenicsx.scene.scene import FORMAT, Scene
from remodel_fenicsx.schema.settings import Load, Supports
from remodel_fenicsx.schema.tables import (
    choices,
    free_names,
    is_table,
    listed_tables,
    markdown_reference,
    meaning,
    paragraphs,
)
from remodel_fenicsx.schema.toml import merged
from remodel_fenicsx.schema.units import Dimension, QUANTITY, STRESS, dimension_of, keys_with_units


# ---------------------------------------------------------------- a JSON Schema of scenes
# A JSON Schema of scenes: what an editor needs to complete keys, to show their meanings and to mark faults.
#  It knows each key by itself. What depends on several keys (`time.end` on `time.step`, say) `remodel-fenicsx
# validate` alone can tell.

Schema = dict[str, Any]


def json_schema() -> Schema:
    """The JSON Schema (draft 2020-12) of a scene file of this version, what scripts have registered included."""
    schema = _table(Scene)
    schema["properties"] |= _of_any_shape()
    schema["properties"]["preset"] |= {"enum": list(PRESETS)}
    schema["properties"]["profile"] |= {"enum": list(PROFILES)}
    head = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"urn:remodel-fenicsx:scene:{FORMAT}",
        "title": "A scene of remodel_fenicsx",
    }
    whole = {"if": {"not": {"required": ["preset"]}}, "then": _required(Scene)}
    return head | schema | {"required": ["geometry"], "allOf": [whole, *map(_of_shape, SHAPES.values())]}


def _table(table: type[BaseModel]) -> Schema:
    """Of a table with all its keys; none of them is required."""
    by_pydantic = table.model_json_schema()["properties"]
    properties = {name: _field(field, by_pydantic[name]) for name, field in table.model_fields.items()}
    description = {"description": text} if (text := meaning(table)) else {}
    further = free_names(table)
    others = _table(further) if further is not None else False
    return {"type": "object", **description, "properties": properties, "additionalProperties": others}


def _field(field: FieldInfo, by_pydantic: Schema) -> Schema:
    """Of a key: a table, or the values that it takes."""
    if is_table(field.annotation):
        return _table(field.annotation)  # type: ignore[arg-type]
    if get_origin(field.annotation) is dict and is_table(kind := get_args(field.annotation)[1]):
        return {"type": "object", "additionalProperties": _table(kind)}
    if (listed_kind := listed_tables(field.annotation)) is not None:
        return {"type": "array", "description": field.description or "", "items": _table(listed_kind)}
    schema = _without_null({name: entry for name, entry in by_pydantic.items() if name not in ("title", "allowed")})
    if listed := choices(field):
        schema["enum"] = listed
    if dimension := dimension_of(field):
        schema = _with_unit(schema, dimension)
    return schema


def _with_unit(schema: Schema, dimension: Dimension) -> Schema:
    """A number, or one with a unit as text."""
    limits = {name: schema.pop(name) for name in list(schema) if name in ("type", "minimum", "exclusiveMinimum")}
    text = {"type": "string", "pattern": f"^\\s*{QUANTITY}\\s*$", "examples": [dimension.example]}
    return schema | {"anyOf": [limits, text]}


def _without_null(schema: Schema) -> Schema:
    """TOML has no null: a key that may be None may be absent."""
    schema = {name: entry for name, entry in schema.items() if (name, entry) != ("default", None)}
    kinds = [kind for kind in schema.get("anyOf", []) if kind != {"type": "null"}]
    return schema if len(kinds) != 1 else {name: e for name, e in schema.items() if name != "anyOf"} | kinds[0]


def _of_any_shape() -> Schema:
    """Keys of the geometry and loads that some shape has: editors complete these; `_of_shape` tells what is allowed."""
    geometry: Schema = {}
    loads: Schema = {}
    for shape in SHAPES.values():
        geometry |= {name: {"description": field.description} for name, field in shape.model_fields.items()}
        loads |= {name: {"type": "object", "description": kind.meaning} for name, kind in shape.loads.items()}
    geometry["shape"]["enum"] = list(SHAPES)
    return {
        "geometry": {"type": "object", "properties": geometry, "required": ["shape"]},
        "loads": {"type": "object", "properties": loads},
    }


def _of_shape(shape: type[Shape]) -> Schema:
    """What a shape decides: the keys of its geometry, its loads, its supports, its axes."""
    name = shape.model_fields["shape"].default
    geometry = _table(shape)
    geometry["properties"]["shape"] = {"const": name}
    loads = {load: _load(kind.meaning, kind.dimension) for load, kind in shape.loads.items()}
    tables = {
        "geometry": geometry,
        "loads": {"type": "object", "properties": loads, "additionalProperties": _load_on_face(shape)},
        "supports": {"properties": {"ends": {"enum": list(shape.ends)}}}
        | ({} if shape.holds_faces else {"propertyNames": {"enum": [*Supports.model_fields, *shape.surrounded_faces]}}),
        "cells": {"properties": {"axes": {"enum": list(shape.axis_kinds)}}},
        "regions": {} if shape.has_regions else {"maxProperties": 0},
    }
    chosen = {"properties": {"geometry": {"properties": {"shape": {"const": name}}}}}
    without_preset = {"if": {"not": {"required": ["preset"]}}, "then": {"properties": {"geometry": _required(shape)}}}
    return {"if": chosen, "then": {"properties": tables, "allOf": [without_preset]}}


def _load(meaning: str, dimension: Dimension | None) -> Schema:
    table = _table(Load)
    keys = {name: entry for name, entry in table["properties"].items() if name not in ("kind", "face")}
    if dimension:
        keys["value"] = _with_unit(keys["value"], dimension)
    return table | {"properties": keys, "description": meaning}


def _load_on_face(shape: type[Shape]) -> Schema | bool:
    """A further load of an own body, where the shape has such."""
    if not shape.holds_faces:
        return False
    table = _table(Load)
    keys = table["properties"] | {"value": _with_unit(table["properties"]["value"], STRESS)}
    return table | {"properties": keys, "required": ["kind", "face", "value", "ramp"]}


def _required(table: type[BaseModel]) -> Schema:
    """Which keys of a table and of the tables in it must be there, where nothing lies under them."""
    schema: Schema = {"required": [name for name, field in table.model_fields.items() if field.is_required()]}
    inner = {}
    for name, field in table.model_fields.items():
        if is_table(field.annotation):
            inner[name] = _required(field.annotation)  # type: ignore[arg-type]
        elif get_origin(field.annotation) is dict and is_table(kind := get_args(field.annotation)[1]):
            inner[name] = {"additionalProperties": _required(kind)}
    return schema | {"properties": inner}


# ---------------------------------------------------------------- the page docs/scene.md, made from the code

_REFERENCE = """# Keys of a scene

This page is made from the code: `./with-fenicsx docs/make scene`.

A scene is a TOML file that says what to compute: a body, its tissue, its loads, and how the
collagen remodels. This page lists every key with its default, what is allowed and what it means.
`remodel-fenicsx validate SCENE` checks a scene.

Every key is checked before anything is solved. One line names a key that is wrong, its value and
what is allowed: for an unknown key, a value of the wrong type (a string for a number, `true` for a
number), NaN, or values that do not fit together.

| quantity | unit |
|---|---|
| lengths of the body | any one unit of length |
| lengths of chains and cells | link lengths of the chain |
| stresses | `material.stress_unit` |
| time | the unit of 1/`remodeling.kappa` |

Where a key has a value from several sources, the first of these wins:

1. `--set KEY=VALUE` on the command line
2. `--profile` on the command line
3. the scene file
4. the profile that the file names
5. the preset for the shape
6. the defaults below

Tables are merged key by key; lists are replaced as a whole. A load of a preset stays when the scene
names only another load. To take it away set its `value` to 0.

`--set` takes a dotted key and a TOML value. A bare word is a string, and so is a number with a
unit:

```text
--set cells.seed=2
--set remodeling.frame=spatial
--set 'loads.pressure.ramp=[[0, 0], [25, 1]]'
--set loads.pressure.value="100 mmHg"
```

An editor that knows JSON Schema completes keys and marks faults. For Even Better TOML (VS Code) or
taplo write the schema with `remodel-fenicsx schema -o scene.schema.json`, and begin the scene with
the line `#:schema ./scene.schema.json`. The schema checks each key by itself;
`remodel-fenicsx validate SCENE` checks them together.

"""

_UNITS = """## Values with units

A number is in the scene's own unit. The keys of this table also take a number with another unit, in
quotes: `length = "8 mm"`, `value = "100 mmHg"`. It is converted once, when the scene is read; a
scene as run has numbers. `remodel-fenicsx validate` prints network modulus, shear modulus and the
largest load in one unit.

Unit names are those of pint: `kPa`, `mmHg`, `cmH2O`, `N/mm^2`, `um`, `degC`. Lengths and forces
with units need `geometry.length_unit`. All other keys take no unit, such as lengths of chains and
times.

| unit of | example | in the unit | keys |
|---|---|---|---|
"""

_PROFILES = """
## Profiles

Errors and cost were measured on the artery of isotropic cells (docs/speed_and_accuracy.md): the
root mean square error of the fibre angle, the error of the radii, and the processor time. Where
cells are random a profile keeps mesh and steps, and errors are those of means over many seeds, on
the artery of random cells (docs/speed.md).

| profile | cells | settings | degrees | radii, % | seconds |
|---|---|---|---|---|---|
"""


def scene_reference() -> str:
    """The page docs/scene.md: every key with default, what is allowed and meaning, and the presets."""
    text = _REFERENCE + _UNITS + "\n".join(_unit_rows()) + "\n\n" + markdown_reference(Scene)
    text += "\n## Loads of the shapes\n\n| load | shape | meaning |\n|---|---|---|\n" + "\n".join(_load_rows()) + "\n"
    text += _PROFILES + "\n".join(_profile_rows()) + "\n"
    for name, shapes in PRESETS.items():
        text += f"\n## Preset `{name}`\n\n{chr(10).join(paragraphs(PRESET_NOTES[name]))}\n"
        for shape, values in shapes.items():
            body = tomlkit.dumps(merged({"geometry": {"shape": shape}}, values))
            text += f"\nShape `{shape}`:\n\n```toml\n{body.strip()}\n```\n"
    return text


def _unit_rows() -> Iterator[str]:
    """One row of a Markdown table for each dimension that a key of a scene has."""
    loads = {name: kind.dimension for shape in SHAPES.values() for name, kind in shape.loads.items() if kind.dimension}
    keys: dict[Dimension, list[str]] = {}
    for key, dimension in (*keys_with_units(Scene), *((f"loads.{name}.value", unit) for name, unit in loads.items())):
        keys.setdefault(dimension, []).append(f"`{key}`")
    for dimension, names in keys.items():
        unit = " ".join(f"{name}^{power}" if power != 1 else name for name, power in dimension.powers)
        yield f"| {dimension.name} | `{dimension.example}` | `{unit}` | {', '.join(names)} |"


def _profile_rows() -> Iterator[str]:
    """One row of a Markdown table for each profile."""
    for name, one in (*PROFILES.items(), *RANDOM_CELLS.items()):
        measured = f"{one.degrees:g} | {one.percent:g} | {one.seconds:g}"
        yield f"| `{name}` | {one.cells} | {one.settings_in_words()} | {measured} |"


def _load_rows() -> Iterator[str]:
    """One row of a Markdown table for each load of each shape."""
    for shape, table in SHAPES.items():
        for name, kind in table.loads.items():
            unit = f", in the unit of {kind.dimension.name}" if kind.dimension else ""
            yield f"| `{name}` | `{shape}` | {kind.meaning}{unit} |"
