"""The page docs/scene.md, made from the code: ``python3 -m remodel_fenicsx.scene.reference`` prints it."""

from __future__ import annotations

import tomlkit

from remodel_fenicsx.scene.parameters import PRESET_NOTES, PRESETS
from remodel_fenicsx.scene.scene import Scene
from remodel_fenicsx.schema.tables import markdown_reference
from remodel_fenicsx.schema.toml import merged

_REFERENCE = """# Keys of a scene

This page is made from the code: `./with-fenicsx python3 -m remodel_fenicsx.scene.reference > docs/scene.md`.

A scene is a TOML file. Every key is checked before anything is solved: an unknown key, a value of the wrong type (a
string for a number, `true` for a number), NaN, or values that do not fit together give one line with key, value and
what is allowed. Lengths of the geometry are in any one unit of length, chain lengths in link lengths of the chain,
stresses in `material.stress_unit`, time in the unit of 1/`remodeling.kappa`.

Where a key has several sources, the first of these wins: `--set KEY=VALUE` on the command line, the file, the preset
for the shape, the defaults below. Tables are merged key by key, lists are replaced whole. A preset's load stays when
the scene names only another one; to take it away set its `value` to 0.

`--set` takes a dotted key and a TOML value; a bare word is a string: `--set cells.seed=2`,
`--set remodeling.frame=spatial`, `--set 'loads.pressure.ramp=[[0, 0], [25, 1]]'`.

"""


def scene_reference() -> str:
    """The page docs/scene.md: every key with default, what is allowed and meaning, and the presets."""
    text = _REFERENCE + markdown_reference(Scene)
    for name, shapes in PRESETS.items():
        text += f"\n## Preset `{name}`\n\n{PRESET_NOTES[name]}\n"
        for shape, values in shapes.items():
            body = tomlkit.dumps(merged({"geometry": {"shape": shape}}, values))
            text += f"\nShape `{shape}`:\n\n```toml\n{body.strip()}\n```\n"
    return text


if __name__ == "__main__":
    print(scene_reference(), end="")
