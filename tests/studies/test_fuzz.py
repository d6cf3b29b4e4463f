"""The fuzzer: one in fourteen of its scenes, that they are valid and draw every key; it can tell right from wrong."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from benchmarks.fuzzing.command import evaluated, said
from benchmarks.fuzzing.scenes import made
from benchmarks.stability_map.running import Runner
from remodel_fenicsx.scene import scene_from_dict

ALL = range(1, 301)
QUICK = (  # half a second with what they are held against, most of them with kernels that other tests compile too
    1, 24, 60, 73, 85, 109, 117, 127, 137, 138, 140, 147, 149, 173, 194, 212, 217, 220, 227, 238, 242, 259,
)  # fmt: skip
# Equilibria that have no end within the limit (they may have one with more time)
ENDLESS = (29, 40, 46, 130, 166, 193, 223, 231, 268)
HELD = ("right", "refused", "unstable", "warned")


@pytest.fixture(scope="module")
def runner() -> Iterator[Runner]:
    """The package of this checkout."""
    made_runner = Runner(limit=60)
    yield made_runner
    made_runner.close()


def hold(seed: int, runner: Runner) -> None:
    """Nothing that a reference or another run contradicts without a word."""
    record = evaluated(seed, runner)
    if seed in ENDLESS and record["outcome"] == "unchecked":
        return
    assert (
        record["outcome"] in HELD
    ), f"./with-fenicsx benchmarks/fuzz.py --only {seed}: {said(record)}"


@pytest.mark.parametrize("seed", QUICK)
def test_quick_scenes(seed: int, runner: Runner) -> None:
    hold(seed, runner)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [seed for seed in ALL if seed not in QUICK])
def test_all_scenes(seed: int, runner: Runner) -> None:
    hold(seed, runner)


# ---------------------------------------------------------------- the scenes
OF_FILES = {
    "cells.fibres",
    "cells.fibres_sha256",
    "natural.fibres",
}  # a seed makes a scene and no files beside it
OTHER_WORDS = {
    "material.initial_stiffness",
    "material.locking_stretch",
    "remodeling.half_life",
    "cells.fraction_x",
    "cells.fraction_y",
    "cells.mean_angle",
}  # a scene has the others
OWN_REFERENCE = {"material.elastin"}  # held against tests/reference/elastin.py


def test_scenes_are_valid_and_draw_every_key() -> None:
    """What the package has as keys, some scene sets; a seed makes the same scene each time."""
    drawn: set[str] = set()
    for seed in ALL:
        scene, _ = made(seed)
        assert scene == made(seed)[0]
        valid = scene_from_dict(scene)
        tables = {
            name: table
            for name, table in scene.items()
            if isinstance(table, dict) and name != "loads"
        }
        drawn |= {f"{name}.{key}" for name, table in tables.items() for key in table} | set(scene)
    keys = {name for name in type(valid).model_fields}
    for name in keys - {"geometry", "loads"}:
        table = getattr(valid, name)
        keys = keys | {f"{name}.{key}" for key in getattr(type(table), "model_fields", ())}
    missing = keys - OF_FILES - OTHER_WORDS - OWN_REFERENCE - drawn
    assert not missing, f"benchmarks/fuzzing/scenes.py draws no {sorted(missing)}"
