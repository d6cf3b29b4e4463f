"""The JSON Schema of scenes: what an editor needs to complete keys, to show their meanings and to mark faults.

It knows each key by itself. What depends on several keys (`time.end` on `time.step`, say) `remodel-fenicsx validate`
alone can tell.
"""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema

from remodel_fenicsx.body import LoadKind, SHAPES, Shape
from remodel_fenicsx.body.shape import WithRegions
from remodel_fenicsx.scene.scene import FORMAT, Scene
from remodel_fenicsx.schema.settings import Supports
from remodel_fenicsx.schema.tables import tables_in
from remodel_fenicsx.schema.units import STRESS, schema_with_unit


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
