"""The page docs/scene.md, made from the code: ``python3 -m remodel_fenicsx.scene.reference`` prints it."""

from __future__ import annotations

from collections.abc import Iterator

import tomlkit

from remodel_fenicsx.body import SHAPES
from remodel_fenicsx.scene.presets import PRESET_NOTES, PRESETS, PROFILES, RANDOM_CELLS
from remodel_fenicsx.scene.scene import Scene
from remodel_fenicsx.schema.tables import markdown_reference, paragraphs
from remodel_fenicsx.schema.toml import merged
from remodel_fenicsx.schema.units import Dimension, keys_with_units

_REFERENCE = """# Keys of a scene

This page is made from the code:
`./with-fenicsx python3 -m remodel_fenicsx.scene.reference > docs/scene.md`.

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


if __name__ == "__main__":
    print(scene_reference(), end="")
