"""docs/scene.md: every key with default, what is allowed and meaning, and the presets."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from docs.making.pages import filled, lines
from docs.making.reference import markdown_reference, paragraphs
from remodel_fenicsx.extend import SHAPES, Dimension
from remodel_fenicsx.scene import Scene
from remodel_fenicsx.scene.presets import PRESET_NOTES, PRESETS, PROFILES, RANDOM_CELLS
from remodel_fenicsx.schema.tables import sections, format_value
from remodel_fenicsx.schema.units import dimension_of


def page() -> str:
    """Of the keys as they are."""
    words = {"keys": markdown_reference(Scene).rstrip(), "presets": "\n".join(_presets()).rstrip()}
    rows = {"units": _units(), "loads": _loads(), "profiles": _profiles()}
    return filled(
        Path(__file__).with_name("scene.template.md"),
        words | {name: lines(found) for name, found in rows.items()},
    )


def _keys_with_units() -> Iterator[tuple[str, Dimension]]:
    """Dotted key and dimension of every field that has one; a key of several variants comes once."""
    found: dict[str, Dimension] = {}
    for key, _, table in sections(Scene):
        for name, field in table.model_fields.items():
            if (dimension := dimension_of(field)) is not None:
                found.setdefault(f"{key}.{name}", dimension)
    yield from found.items()


def _units() -> Iterator[list[str]]:
    """A row for each dimension that a key of a scene has; regions have those of their tables."""
    loads = {
        name: kind.dimension
        for shape in SHAPES.values()
        for name, kind in shape.loads.items()
        if kind.dimension
    }
    keys: dict[Dimension, list[str]] = {}
    for key, dimension in (
        *_keys_with_units(),
        *((f"loads.{name}.value", unit) for name, unit in loads.items()),
    ):
        if not key.startswith("regions.NAME.material."):
            keys.setdefault(dimension, []).append(f"`{key}`")
    for dimension, names in keys.items():
        unit = " ".join(
            f"{name}^{power}" if power != 1 else name for name, power in dimension.powers
        )
        yield [dimension.name, f"`{dimension.example}`", f"`{unit}`", ", ".join(names)]


def _profiles() -> Iterator[list[str]]:
    """A row for each profile."""
    for name, one in (*PROFILES.items(), *RANDOM_CELLS.items()):
        measured = [f"{number:g}" for number in (one.degrees, one.percent, one.seconds)]
        yield [f"`{name}`", one.cells, one.settings_in_words(), *measured]


def _loads() -> Iterator[list[str]]:
    """A row for each load, with the shapes that have it."""
    shapes: dict[tuple[str, str], list[str]] = {}
    for shape, table in SHAPES.items():
        for name, kind in table.loads.items():
            unit = f", in the unit of {kind.dimension.name}" if kind.dimension else ""
            shapes.setdefault((name, f"{kind.meaning}{unit}"), []).append(f"`{shape}`")
    yield from (
        [f"`{name}`", ", ".join(having), meaning] for (name, meaning), having in shapes.items()
    )


def flat(values: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    """Dotted keys and values of nested tables, as a scene writes them."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{before}{name}.")
        else:
            yield f"{before}{name}", format_value(value)


def _presets() -> Iterator[str]:
    """A section for each preset: its note, and its keys by shape; after the first only what is other than there."""
    printed = next(iter(PRESETS.values()))
    for number, (name, shapes) in enumerate(PRESETS.items()):
        yield from (f"## Preset `{name}`", "", *paragraphs(PRESET_NOTES[name]), "")
        rows = _by_key(shapes)
        if number:
            yield from (f"All else is as in the preset `{next(iter(PRESETS))}`.", "")
            first = _by_key({shape: printed[shape] for shape in shapes})
            rows = {row: having for row, having in rows.items() if first.get(row) != having}
        groups: dict[str, list[str]] = {"all": []} if len(shapes) > 1 else {}
        for (key, value), having in rows.items():
            groups.setdefault("all" if having == list(printed) else ", ".join(having), []).append(
                f"{key} = {value}"
            )
        texts = ("\n".join([f"# {of}", *keys]) for of, keys in groups.items())
        yield from ("```toml", "\n\n".join(texts), "```", "")


def _by_key(shapes: Mapping[str, Any]) -> dict[tuple[str, str], list[str]]:
    """Shapes of each key and value of a preset, keys beside each other."""
    found: dict[str, dict[tuple[str, str], list[str]]] = {}
    for shape, values in shapes.items():
        for key, value in flat(values):
            found.setdefault(key, {}).setdefault((key, value), []).append(shape)
    return {row: having for rows in found.values() for row, having in rows.items()}
