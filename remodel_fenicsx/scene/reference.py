"""The keys of scenes for others: as Markdown for readers, as JSON Schema for editors."""

from __future__ import annotations

import re
import textwrap
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic.json_schema import GenerateJsonSchema
from pydantic_core import PydanticUndefined

from remodel_fenicsx.body import SHAPES
from remodel_fenicsx.scene.scene import FORMAT, Scene
from remodel_fenicsx.schema.tables import allowed, choices, description, meaning, sections, shown
from remodel_fenicsx.schema.units import STRESS, schema_with_unit

if TYPE_CHECKING:
    from pydantic_core import core_schema


PAGE_WIDTH = 98  # characters of a line of a page


# ---------------------------------------------------------------- JSON Schema (draft 2020-12)
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


# ---------------------------------------------------------------- Markdown


def markdown_reference(table: type[BaseModel]) -> str:
    """The keys of a table and of the tables in it as Markdown, as docs/scene.md has them.

    Parameters
    ----------
    table
        The class of the table, `Scene` or one of a script's own.

    Returns
    -------
    str
        One section for each table: its keys with default, what is allowed, and description.

    Examples
    --------
    >>> from remodel_fenicsx import Scene
    >>> from remodel_fenicsx.extend import markdown_reference
    >>> print(markdown_reference(Scene).splitlines()[0])
    ## Top of the file
    """
    told: dict[str, dict[str, str]] = {}
    return "\n".join(_section(key, variant, inner, told.setdefault(key, {})) for key, variant, inner in sections(table))


def _section(key: str, variant: str, table: type[BaseModel], told: dict[str, str]) -> str:
    """`told`: rows of other variants of the table, with the variant; they are named only."""
    name = f"[[{key[:-2]}]]" if key.endswith("[]") else f"[{key}]"
    title = f"## `{name}`" + (f" of shape `{variant!r}`" if variant else "") if key else "## Top of the file"
    fields = {name: field for name, field in table.model_fields.items() if choices(field) != [variant]}  # in the title
    texts = {name: text for name in fields if (text := description(table, name))}
    rows = {
        name: " | ".join([f"| `{name}`", _default(fields[name]), _allowed_in_words(fields[name]), _cell(text)])
        for name, text in texts.items()
    }
    elsewhere: dict[str, list[str]] = {}
    for name, row in rows.items():
        if (as_key := re.match(r"As `([\w.]+)\.\w+`, for this region", texts[name])) is not None:
            elsewhere.setdefault(f"as in `[{as_key[1]}]`, else those of the whole body", []).append(f"`{name}`")
        elif variant and row in told:
            elsewhere.setdefault(f"as of shape `{told[row]!r}`", []).append(f"`{name}`")
    told |= {row: variant for row in rows.values() if row not in told}
    left_out = {name for names in elsewhere.values() for name in names}
    shown_rows = [f"{row} |" for name, row in rows.items() if f"`{name}`" not in left_out]
    also = [f"Keys {where}: {', '.join(names)}." for where, names in elsewhere.items()]
    head = ["| key | default | allowed | meaning |", "|---|---|---|---|"] if shown_rows else []
    said = "\n\n".join([meaning(table), *also])
    return "\n".join([title, "", *paragraphs(said), "", *head, *shown_rows, *([""] if shown_rows else [])])


def paragraphs(text: str) -> list[str]:
    """The lines of a text, filled to the width of a Markdown page."""
    filled = (textwrap.wrap(part, PAGE_WIDTH, break_on_hyphens=False) for part in text.split("\n\n"))
    return "\n\n".join(map("\n".join, filled)).split("\n")


def _allowed_in_words(field: FieldInfo) -> str:
    """What a field allows, without what stands once above all tables."""
    words = re.sub(r"^(must be|allowed is|allowed are) ", "", allowed(field))
    return _cell(words.replace("a finite number", "a number").replace("greater than", "above"))


def _cell(text: str) -> str:
    """Text for a cell of a Markdown table, where a bar would end the cell."""
    return text.replace("|", r"\|")


def _default(field: FieldInfo) -> str:
    if field.default is PydanticUndefined:
        return "required" if field.default_factory is None else "empty"
    return "none" if field.default is None else f"`{shown(field.default)}`"
