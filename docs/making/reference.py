"""The keys of scenes as Markdown, for docs/scene.md."""

from __future__ import annotations

import re
import textwrap

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from remodel_fenicsx.schema.tables import (
    allowed,
    choices,
    description,
    meaning,
    sections,
    format_value,
)

PAGE_WIDTH = 98  # characters of a line of a page


def markdown_reference(table: type[BaseModel]) -> str:
    """The keys of a table and of the tables in it, one section for each: default, what is allowed, description."""
    told: dict[str, dict[str, str]] = {}
    return "\n".join(
        _section(key, variant, inner, told.setdefault(key, {}))
        for key, variant, inner in sections(table)
    )


def _section(key: str, variant: str, table: type[BaseModel], told: dict[str, str]) -> str:
    """`told`: rows of other variants of the table, with the variant; they are named only."""
    name = f"[[{key[:-2]}]]" if key.endswith("[]") else f"[{key}]"
    title = (
        f"## `{name}`" + (f" of shape `{variant!r}`" if variant else "")
        if key
        else "## Top of the file"
    )
    fields = {
        name: field for name, field in table.model_fields.items() if choices(field) != [variant]
    }  # in the title
    texts = {name: text for name in fields if (text := description(table, name))}
    elsewhere: dict[str, list[str]] = {}
    for name, text in texts.items():
        if (as_key := re.match(r"As `([\w.]+)\.\w+`, for this region", text)) is not None:
            elsewhere.setdefault(f"as in `[{as_key[1]}]`, else those of the whole body", []).append(
                f"`{name}`"
            )
    in_regions = {name for names in elsewhere.values() for name in names}
    rows = {
        name: " | ".join(
            [f"| `{name}`", _default(fields[name]), _allowed_in_words(fields[name]), _cell(text)]
        )
        for name, text in texts.items()
        if f"`{name}`" not in in_regions
    }
    for name, row in rows.items():
        if variant and row in told:
            elsewhere.setdefault(f"as of shape `{told[row]!r}`", []).append(f"`{name}`")
    told |= {row: variant for row in rows.values() if row not in told}
    left_out = {name for names in elsewhere.values() for name in names}
    shown_rows = [f"{row} |" for name, row in rows.items() if f"`{name}`" not in left_out]
    also = [f"Keys {where}: {', '.join(names)}." for where, names in elsewhere.items()]
    head = ["| key | default | allowed | meaning |", "|---|---|---|---|"] if shown_rows else []
    said = "\n\n".join([meaning(table), *also])
    return "\n".join(
        [title, "", *paragraphs(said), "", *head, *shown_rows, *([""] if shown_rows else [])]
    )


def paragraphs(text: str) -> list[str]:
    """The lines of a text, filled to the width of a Markdown page."""
    filled = (
        textwrap.wrap(part, PAGE_WIDTH, break_on_hyphens=False) for part in text.split("\n\n")
    )
    return "\n\n".join(map("\n".join, filled)).split("\n")


def _allowed_in_words(field: FieldInfo) -> str:
    """What a field allows, without what stands once above all tables."""
    words = re.sub(r"^must be (one of )?", "", allowed(field))
    return _cell(words.replace("a finite number", "a number").replace("greater than", "above"))


def _cell(text: str) -> str:
    """Text for a cell of a Markdown table, where a bar would end the cell."""
    return text.replace("|", r"\|")


def _default(field: FieldInfo) -> str:
    if field.default is PydanticUndefined:
        return "required" if field.default_factory is None else "empty"
    return "none" if field.default is None else f"`{format_value(field.default)}`"
