"""A JSON Schema of scenes: what an editor needs to complete keys, to show their meanings and to mark faults.

It knows each key by itself. What depends on several keys (`time.end` on `time.step`, say) `remodel-fenicsx validate`
alone can tell.
"""

from __future__ import annotations

from typing import Any, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from remodel_fenicsx.body import SHAPES, Shape
from remodel_fenicsx.scene.presets import PRESETS, PROFILES
from remodel_fenicsx.scene.scene import FORMAT, Scene
from remodel_fenicsx.schema.tables import choices, free_names, is_table, listed_tables, meaning
from remodel_fenicsx.schema.units import QUANTITY, STRESS, Dimension, dimension_of
from remodel_fenicsx.settings import Load, Supports

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
