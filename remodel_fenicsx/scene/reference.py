"""The keys of scenes as JSON Schema (draft 2020-12), for editors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pydantic.json_schema import GenerateJsonSchema

from remodel_fenicsx.body import SHAPES
from remodel_fenicsx.scene.scene import FORMAT, Scene
from remodel_fenicsx.schema.units import STRESS, schema_with_unit

if TYPE_CHECKING:
    from pydantic_core import core_schema

# What an editor needs to complete keys, to show their meanings and to mark faults. It knows each key by itself. What
# depends on several keys (loads on the shape, say), or must be there without a preset, `validate` alone can tell.

Schema = dict[str, Any]


class _Keys(GenerateJsonSchema):
    """No key is required, for a preset may lie under it; nothing is null, which TOML does not have."""

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
    """The JSON Schema (draft 2020-12) of a scene file of this version, what scripts have registered included."""
    schema = Scene.model_json_schema(schema_generator=_Keys)
    properties = schema["properties"]
    load = schema["$defs"]["Load"]["properties"]["value"]
    load["anyOf"] = [{"type": load.pop("type")}, schema_with_unit(STRESS)]
    loads = {name: kind.meaning for shape in SHAPES.values() for name, kind in shape.loads.items()}
    known = {name: {"$ref": "#/$defs/Load", "description": meaning} for name, meaning in loads.items()}
    further = {"$ref": "#/$defs/Load", "required": ["kind", "face"]}
    properties["loads"] |= {"properties": known, "additionalProperties": further}
    head = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"urn:remodel-fenicsx:scene:{FORMAT}",
        "title": "A scene of remodel_fenicsx",
    }
    return head | schema | {"required": ["geometry"]}
