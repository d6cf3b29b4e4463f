"""docs/scene.md: every key with default, what is allowed and meaning, and the presets."""

from __future__ import annotations

from collections.abc import Iterator

import tomlkit

from docs.making.pages import DOCS, filled, lines
from remodel_fenicsx.extend import SHAPES, Dimension, markdown_reference
from remodel_fenicsx.scene import Scene
from remodel_fenicsx.scene.presets import PRESET_NOTES, PRESETS, PROFILES, RANDOM_CELLS
from remodel_fenicsx.schema.tables import paragraphs
from remodel_fenicsx.schema.text import merged
from remodel_fenicsx.schema.units import keys_with_units


def page() -> str:
    """Of the keys as they are."""
    words = {"keys": markdown_reference(Scene).rstrip(), "presets": "\n".join(_presets()).rstrip()}
    rows = {"units": _units(), "loads": _loads(), "profiles": _profiles()}
    return filled(DOCS / "scene.template.md", words | {name: lines(found) for name, found in rows.items()})


def _units() -> Iterator[list[str]]:
    """A row for each dimension that a key of a scene has."""
    loads = {name: kind.dimension for shape in SHAPES.values() for name, kind in shape.loads.items() if kind.dimension}
    keys: dict[Dimension, list[str]] = {}
    for key, dimension in (*keys_with_units(Scene), *((f"loads.{name}.value", unit) for name, unit in loads.items())):
        keys.setdefault(dimension, []).append(f"`{key}`")
    for dimension, names in keys.items():
        unit = " ".join(f"{name}^{power}" if power != 1 else name for name, power in dimension.powers)
        yield [dimension.name, f"`{dimension.example}`", f"`{unit}`", ", ".join(names)]


def _profiles() -> Iterator[list[str]]:
    """A row for each profile."""
    for name, one in (*PROFILES.items(), *RANDOM_CELLS.items()):
        measured = [f"{number:g}" for number in (one.degrees, one.percent, one.seconds)]
        yield [f"`{name}`", one.cells, one.settings_in_words(), *measured]


def _loads() -> Iterator[list[str]]:
    """A row for each load of each shape."""
    for shape, table in SHAPES.items():
        for name, kind in table.loads.items():
            unit = f", in the unit of {kind.dimension.name}" if kind.dimension else ""
            yield [f"`{name}`", f"`{shape}`", f"{kind.meaning}{unit}"]


def _presets() -> Iterator[str]:
    """A section for each preset: its note, and a scene of each shape."""
    for name, shapes in PRESETS.items():
        yield from (f"## Preset `{name}`", "", *paragraphs(PRESET_NOTES[name]), "")
        for shape, values in shapes.items():
            body = tomlkit.dumps(merged({"geometry": {"shape": shape}}, values)).strip()
            yield from (f"Shape `{shape}`:", "", f"```toml\n{body}\n```", "")
