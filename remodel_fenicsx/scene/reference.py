"""The reference of keys, docs/scene.md, and the JSON Schema of scenes for editors."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import tomlkit
from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema

from remodel_fenicsx.body import LoadKind, SHAPES, Shape
from remodel_fenicsx.body.shape import WithRegions
from remodel_fenicsx.scene.presets import PRESETS, PRESET_NOTES, PROFILES, RANDOM_CELLS
from remodel_fenicsx.scene.scene import FORMAT, Scene
from remodel_fenicsx.schema.settings import Supports
from remodel_fenicsx.schema.tables import markdown_reference, paragraphs, tables_in
from remodel_fenicsx.schema.toml import merged
from remodel_fenicsx.schema.units import Dimension, STRESS, keys_with_units, schema_with_unit


# ---------------------------------------------------------------- a JSON Schema of scenes
# What an editor needs to complete keys, to show their meanings and to mark faults. It knows each key by itself. What
# depends on several keys (`time.end` on `time.step`, say) `remodel-fenicsx validate` alone can tell.

Schema = dict[str, Any]


class _Keys(GenerateJsonSchema):
    """No key is required, for a preset may lie under it; nothing is null, which TOML does not have."""

    def field_is_required(self, field: Any, total: bool) -> bool:
        return False

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False

    def nullable_schema(self, schema: Any) -> Schema:
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema: Any) -> Schema:
        own = isinstance(schema.get("default"), (str, bool, int, float, tuple))
        return super().default_schema(schema) if own else self.generate_inner(schema["schema"])


def json_schema() -> Schema:
    """The JSON Schema (draft 2020-12) of a scene file of this version, what scripts have registered included."""
    schema = Scene.model_json_schema(schema_generator=_Keys)
    properties = schema["properties"]
    load = schema["$defs"]["Load"]["properties"]["value"]
    load["anyOf"] = [{"type": load.pop("type")}, schema_with_unit(STRESS)]
    loads = {name: kind.meaning for shape in SHAPES.values() for name, kind in shape.loads.items()}
    known = {name: {"$ref": "#/$defs/Load", "description": meaning} for name, meaning in loads.items()}
    properties["loads"]["properties"] = known
    head = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"urn:remodel-fenicsx:scene:{FORMAT}",
        "title": "A scene of remodel_fenicsx",
    }
    whole = {"if": {"not": {"required": ["preset"]}}, "then": _required(Scene)}
    return head | schema | {"required": ["geometry"], "allOf": [whole, *map(_of_shape, SHAPES.items())]}


def _of_shape(item: tuple[str, type[Shape]]) -> Schema:
    """What a shape decides: its loads, its supports, its axes, and which keys of its geometry must be there."""
    name, shape = item
    on_face = {"required": ["kind", "face", "value", "ramp"]} if shape.supported_faces is None else False
    known = [*Supports.model_fields, *(shape.supported_faces or ())]
    tables = {
        "loads": {
            "properties": {load: _load(kind) for load, kind in shape.loads.items()},
            "additionalProperties": on_face,
        },
        "supports": {"properties": {"ends": {"enum": list(shape.ends)}}}
        | ({} if shape.supported_faces is None else {"propertyNames": {"enum": known}}),
        "cells": {"properties": {"axes": {"enum": list(shape.axis_kinds)}}},
        "regions": {} if issubclass(shape, WithRegions) else {"maxProperties": 0},
    }
    chosen = {"properties": {"geometry": {"properties": {"shape": {"const": name}}}}}
    without_preset = {"if": {"not": {"required": ["preset"]}}, "then": {"properties": {"geometry": _required(shape)}}}
    return {"if": chosen, "then": {"properties": tables, "allOf": [without_preset]}}


def _load(kind: LoadKind) -> Schema:
    """What a load of a shape may not have of the keys that loads have."""
    value = {} if kind.dimension else {"type": "number"}
    return {"description": kind.meaning, "properties": {"kind": False, "face": False, "value": value}}


def _required(table: type[BaseModel]) -> Schema:
    """Which keys of a table and of the tables in it must be there, where nothing lies under them."""
    inner: Schema = {}
    for name, field in table.model_fields.items():
        for suffix, variant, kind in tables_in(field):
            if not variant and suffix != "[]":
                inner[name] = {"additionalProperties": _required(kind)} if suffix else _required(kind)
    required = [name for name, field in table.model_fields.items() if field.is_required()]
    return {"required": required, "properties": inner}


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
