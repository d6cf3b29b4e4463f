"""JSON Schema (draft 2020-12) of scene files, for editors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pydantic.json_schema import GenerateJsonSchema

from remodel_fenicsx.body import SHAPES
from remodel_fenicsx.scene.scene import FORMAT, Scene
from remodel_fenicsx.schema.units import STRESS, schema_with_unit

if TYPE_CHECKING:
    from pydantic_core import core_schema

# An editor uses the schema to complete keys, show their meanings and mark errors key by key. Only
# `validate` checks what depends on several keys (loads on the shape, for example) or must be set
# without a preset.

Schema = dict[str, Any]


class _Keys(GenerateJsonSchema):
    """Generator of a schema without required keys, which a preset may set, and without null."""

    def field_is_required(self, field: object, total: bool) -> bool:
        return False

    def field_title_should_be_set(self, schema: object) -> bool:
        return False

    def nullable_schema(self, schema: core_schema.NullableSchema) -> Schema:
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema: core_schema.WithDefaultSchema) -> Schema:
        own = isinstance(schema.get("default"), (str, bool, int, float, tuple))
        return super().default_schema(schema) if own else self.generate_inner(schema["schema"])


def json_schema() -> Schema:
    """Return the JSON Schema (draft 2020-12) of scene files, with registered components."""
    schema = Scene.model_json_schema(schema_generator=_Keys)
    properties = schema["properties"]
    load = schema["$defs"]["Load"]["properties"]["value"]
    load["anyOf"] = [{"type": load.pop("type")}, schema_with_unit(STRESS)]
    loads = {name: kind.meaning for shape in SHAPES.values() for name, kind in shape.loads.items()}
    known = {
        name: {"$ref": "#/$defs/Load", "description": meaning} for name, meaning in loads.items()
    }
    further = {"$ref": "#/$defs/Load", "required": ["kind", "face"]}
    properties["loads"] |= {"properties": known, "additionalProperties": further}
    head = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"urn:remodel-fenicsx:scene:{FORMAT}",
        "title": "A scene of remodel_fenicsx",
    }
    return head | schema | {"required": ["geometry"]}
