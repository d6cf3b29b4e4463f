"""Scenes: what is read, what is refused and in which words."""

from __future__ import annotations

import copy
import math
import pickle
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from remodel_fenicsx.body import SHAPES, Tube
from remodel_fenicsx.model.chains import wormlike_stiffness
from remodel_fenicsx.model.laws import LAWS
from remodel_fenicsx.scene.presets import PRESET_NOTES, PRESETS
from remodel_fenicsx.scene.scene import (
    FORMAT,
    Scene,
    preset_scene,
    read_scene,
    scene_from_dict,
    too_soft,
)
from remodel_fenicsx.schema.settings import Cells, Load, Material, Remodeling, Time
from remodel_fenicsx.schema.tables import SceneError, allowed, locate, format_value
from remodel_fenicsx.schema.text import set_nested
from tests.runs import rows_of
from tests.tables import rows, values
from tests.values import ramp_to, ramped

ROOT = Path(__file__).resolve().parents[2]
DEMOS = sorted((ROOT / "demos").glob("*.toml"))
PAPER = "kuhl-holzapfel-2007"

TUBE: dict[str, Any] = {
    "geometry": {"shape": "tube", "inner_radius": 1.0, "outer_radius": 3.0, "length": 8.0},
    "loads": ramped(25.0, pressure=4.8),
    "time": {"end": 30.0, "step": 1.0},
}
CUBE: dict[str, Any] = {"geometry": {"shape": "cube"}, "time": {"end": 10.0}}
CONSISTENT: dict[str, Any] = {"preset": "consistent", "geometry": {"shape": "tube"}}
BASES: dict[str, dict[str, Any]] = {
    "none": {}, "tube": TUBE, "cube": CUBE, "printed": CONSISTENT | {"preset": PAPER}, "consistent": CONSISTENT,
    "isotropic": CONSISTENT | {"cells": {"initial": "isotropic"}},
    "layers": TUBE | {"regions": {"media": {"outer_radius": 1.9}, "adventitia": {}}, "cells": {"initial": "isotropic"}},
}  # fmt: skip


def changed(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Nested dict with values at dotted keys."""
    result = copy.deepcopy(base)
    for key, value in changes.items():
        set_nested(result, key, value)
    return result


def refusal(tables: dict[str, Any]) -> str:
    with pytest.raises(SceneError) as caught:
        scene_from_dict(tables)
    return str(caught.value)


WRONG = [
    (key, value)
    for key, row in rows(__file__, "wrong_values.txt")
    for value in values(f"all = [{row}]")["all"]
]


@pytest.mark.parametrize(("key", "value"), WRONG)
def test_a_value_that_a_key_never_has(key: str, value: Any) -> None:
    _, _, field = locate(Scene, tuple(key.split(".")))
    assert field is not None
    assert (
        refusal(changed(TUBE, {key: value})) == f"{key} = {format_value(value)}: {allowed(field)}"
    )


@pytest.mark.parametrize(("base", "changes", "line"), rows(__file__, "bad_scenes.txt"))
def test_a_bad_scene_gives_one_line_with_key_value_and_what_is_allowed(base, changes, line):
    message = refusal(changed(BASES[base], values(changes)))
    assert "\n" not in message and re.match(line, message), message


def test_the_bases_of_the_bad_scenes_are_good():
    assert all(scene_from_dict(base) for base in BASES.values() if base)
    assert scene_from_dict(TUBE).geometry == Tube(inner_radius=1.0, outer_radius=3.0, length=8.0)
    assert scene_from_dict(CUBE).time == Time(end=10.0, step=1.0)


def test_a_preset_without_the_shape(monkeypatch):
    monkeypatch.setitem(PRESETS, "bent", {"tendon": {}, "tube": {}})
    assert (
        refusal({**CUBE, "preset": "bent"})
        == "geometry.shape = 'cube': the preset 'bent' has the shapes 'tendon', 'tube'"
    )


def test_what_is_read_is_of_the_present_format():
    assert scene_from_dict(CUBE) == scene_from_dict({**CUBE, "format": 1})
    text = scene_from_dict({**CUBE, "format": 1}).to_toml("as run")
    assert tomllib.loads(text)["format"] == FORMAT
    assert [line for line in text.splitlines() if line and not line.startswith("#")][
        0
    ] == "format = 2"


@pytest.mark.parametrize(
    "kinematics, most", [("radial", 10**6), ("axisymmetric", 197), ("sector", 29), ("full", 18)]
)
def test_elements_are_counted_of_the_mesh_that_is_made(kinematics: str, most: int) -> None:
    """A ray or a quarter has fewer than the tube, and more of them in each direction are allowed."""
    tube = changed(
        TUBE,
        {"cells": {"initial": "isotropic", "axes": "cylindrical"}, "model.kinematics": kinematics},
    )
    assert scene_from_dict(changed(tube, {"mesh.refinement": most})).mesh.refinement == most
    with pytest.raises(SceneError, match=f"^mesh.refinement = {20 * most}: must be at most"):
        scene_from_dict(changed(tube, {"mesh.refinement": 20 * most}))


@pytest.mark.parametrize("values", [None, [], 3, {1: 2}])
def test_something_else_than_a_table(values):
    with pytest.raises(SceneError, match=r"^scene = .*: must be a table$"):
        scene_from_dict(values)


# ---------------------------------------------------------------- files

BAD_FILES = [
    (
        b"name = 'a'\n[time\nend = 1",
        r"line 2: not TOML: Expected ']' at the end of a table declaration",
    ),
    (b"[time]\nend = 1.0\nend = 2.0\n", r"line 3: not TOML: Cannot overwrite a value"),
    (
        "[geometry]\nshape = \u201ccube\u201d\n".encode(),
        "line 2: not TOML: .*; \u201c is not a quote of TOML: type .*",
    ),
    (
        'name = "a\u201d\n[time]\n'.encode(),
        "line 1: not TOML: .*; \u201d is not a quote of TOML: .*",
    ),
    ("[\u2018time\u2019]\n".encode(), "line 1: not TOML: .*; \u2018 is not a quote of TOML: .*"),
    (b"a = [1,\n2", r"line 2: not TOML: Unclosed array"),
    (b"[time]\nend = 150 s", r"line 2: not TOML: .*"),
    (b"[time]\nend = 1.0\n# caf\xe9", r"line 3: not UTF-8 text; a scene is a TOML file in UTF-8"),
    (b"a = " + b"[" * 100000, r"not TOML: .*"),
    (b"a = " + b"9" * 5000, r"not TOML: .*"),
]


@pytest.mark.parametrize(("content", "line"), BAD_FILES)
def test_a_file_that_is_not_toml_gives_one_line_with_its_line(tmp_path, content, line):
    path = tmp_path / "bad.toml"
    path.write_bytes(content)
    with pytest.raises(SceneError) as caught:
        read_scene(path)
    assert re.fullmatch(re.escape(f"{path}: ") + line, str(caught.value))


def test_a_missing_file_and_a_folder(tmp_path):
    with pytest.raises(SceneError, match=r"/none\.toml: no such file; a scene is a TOML file$"):
        read_scene(tmp_path / "none.toml")
    with pytest.raises(
        SceneError, match=re.escape(f"{tmp_path}: cannot be read: is a folder, not a file")
    ):
        read_scene(tmp_path)
    with pytest.raises(SceneError, match="cannot be read: .*embedded null"):
        read_scene("a\0b")


def test_a_byte_order_mark_and_windows_line_ends_are_read(tmp_path):
    path = tmp_path / "from windows (2).toml"
    path.write_bytes(b"\xef\xbb\xbf[geometry]\r\nshape = 'cube'\r\n[time]\r\nend = 1\r\n")
    read = read_scene(path)
    assert read.time.end == 1.0
    assert read.name == "from windows 2"


@pytest.mark.parametrize(("file", "name"), [
    ("step-0.5.toml", "step-0.5"), ("step-0.25", "step-0.25"), ("a.b.TOML", "a.b"), (".toml", "scene"),
])  # fmt: skip
def test_a_name_is_not_cut_at_a_dot(file, name, tmp_path):
    path = tmp_path / file
    path.write_text("geometry = {shape = 'cube'}\ntime = {end = 1}\n")
    assert read_scene(path).name == name


# ---------------------------------------------------------------- overrides


@pytest.mark.parametrize(("override", "line"), rows(__file__, "bad_overrides.txt"))
def test_a_bad_override_gives_one_line(override, line):
    with pytest.raises(SceneError, match=f"^{line}"):
        read_scene(ROOT / "demos" / "cube.toml", [override.replace(r"\n", "\n")])


def test_overrides_lie_over_the_file_and_the_preset():
    overrides = [
        "remodeling.driver=pk2", "cells.seed = 7", "loads.pressure.value=2", "time.end=40", "output.fields=false",
        "solver.petsc_options.pc_factor_mat_solver_type=mumps", "solver.petsc_options.mat_mumps_icntl_14=50",
        'name="a b"',
    ]  # fmt: skip
    read = read_scene(ROOT / "demos" / "artery.toml", overrides)
    assert (read.remodeling.driver, read.cells.seed, read.time.end, read.name) == (
        "pk2",
        7,
        40.0,
        "a b",
    )
    assert read.loads["pressure"] == Load(value=2.0, ramp=((0.0, 0.0), (25.0, 1.0)))
    assert read.solver.petsc_options == {
        "pc_factor_mat_solver_type": "mumps",
        "mat_mumps_icntl_14": 50,
    }
    assert read.output.fields is False


def test_a_preset_can_be_set_on_the_command_line(tmp_path):
    path = tmp_path / "own.toml"
    path.write_text("[geometry]\nshape = 'tendon'\n[time]\nend = 12\n")
    assert read_scene(path).remodeling.frame == "material"
    read = read_scene(path, [f"preset={PAPER}"])
    assert (read.remodeling.frame, read.loads["force"].value, read.time.end) == (
        "spatial",
        300.0,
        12.0,
    )


# ---------------------------------------------------------------- presets and defaults


@pytest.mark.parametrize("shape", ["cube", "tendon", "tube"])
def test_the_preset_is_the_printed_method(shape):
    """Its numbers and loads, typed from the paper."""
    printed = tomllib.loads(Path(__file__).with_name("printed.toml").read_text())
    built = scene_from_dict({"preset": PAPER, "geometry": {"shape": shape}})
    for key, value in (printed["all"] | printed[shape]).items():
        table, name = key.split(".")
        assert getattr(getattr(built, table), name) == value, key
    loads = {
        name: Load(value=most, ramp=[[0, 0], [end, 1]])
        for name, (most, end) in printed["loads"][shape].items()
    }
    assert built.loads == loads


def test_every_preset_gives_good_scenes_and_is_explained():
    assert set(PRESETS) == set(PRESET_NOTES)
    for name, shapes in PRESETS.items():
        assert set(shapes) == ({"tube"} if name == "carotid" else set(SHAPES) - {"mesh", "solid"})
        for shape in shapes:
            values = changed(
                TUBE if shape == "tube" else CUBE, {"preset": name, "geometry.shape": shape}
            )
            assert scene_from_dict(values).preset == name


def test_collagen_as_measured():
    built = preset_scene("sun-2002", "tendon")
    lengths = (
        built.material.contour_length,
        built.material.persistence_length,
        built.cells.end_to_end_length,
    )
    assert lengths == (309.0, 14.5, 92.4)  # nm
    free_chain = math.sqrt(2 * 14.5 * 309.0 * (1 - 14.5 / 309.0 * (1 - math.exp(-309.0 / 14.5))))
    assert built.cells.end_to_end_length == pytest.approx(free_chain, abs=0.05)
    paper = preset_scene("kuhl-holzapfel-2007", "tendon")

    def chain_stress(scene):
        material, r0 = scene.material, scene.cells.end_to_end_length
        return material.network_modulus * wormlike_stiffness(r0, material.contour_length) * r0**2

    assert chain_stress(built) == pytest.approx(chain_stress(paper), rel=0.01)


def test_a_tube_starts_with_cylindrical_axes_unless_the_scene_says_otherwise():
    assert scene_from_dict(TUBE).cells.axes == "cylindrical"
    assert scene_from_dict(changed(TUBE, {"cells.axes": "global"})).cells.axes == "global"
    assert scene_from_dict({**CUBE, "geometry": {"shape": "tendon"}}).cells.axes == "global"


def test_without_a_preset_law_repulsion_and_coupling_are_what_measures_best():
    scene = scene_from_dict(CUBE)
    assert scene.material.repulsion == "log"
    assert scene.remodeling == Remodeling(
        driver="cauchy", law="tensor", frame="material", kappa=0.025, coupling="extrapolated"
    )
    assert (
        scene_from_dict(changed(CUBE, {"remodeling.coupling": "staggered"})).remodeling.coupling
        == "staggered"
    )


@pytest.mark.parametrize("law", [law for law in LAWS if law != "tensor"])
def test_without_a_preset_another_law_has_what_goes_with_it(law):
    scene = scene_from_dict(changed(CUBE, {"remodeling.law": law}))
    assert (scene.material.repulsion, scene.remodeling.coupling) == ("axes", "staggered")
    assert scene.remodeling.frame == "material"


def test_the_network_modulus():
    # c = k theta n / (4 A_p) by hand: 1.381e-23 * 310 * 2e21 / 5.46
    assert Material().network_modulus == pytest.approx(1.56817, rel=1e-5)
    assert Material(energy_factor=4).network_modulus == pytest.approx(4 * 1.56817, rel=1e-5)
    assert Material(stress_unit="kPa", chain_density=2e24).network_modulus == pytest.approx(
        1.56817, rel=1e-5
    )


# ---------------------------------------------------------------- Python and TOML


def test_the_demos_are_the_preset():
    of_the_paper = {"artery": "tube", "cube": "cube", "tendon": "tendon"}
    assert [path.stem for path in DEMOS if path.stem not in of_the_paper] == [
        "carotid",
        "hypertension",
        "layers",
        "pulse",
        "sheet",
        "turnover",
    ]
    for path in (path for path in DEMOS if path.stem in of_the_paper):
        shape = of_the_paper[path.stem]
        printed = scene_from_dict(
            {"name": path.stem, "preset": PAPER, "geometry": {"shape": shape}}
        )
        assert read_scene(path) == printed


def test_a_preset_by_name():
    assert preset_scene(PAPER, "tube") == read_scene(ROOT / "demos" / "artery.toml", ["name=tube"])


def test_python_says_what_toml_says():
    built = Scene(
        name="artery",
        preset=PAPER,
        geometry=Tube(inner_radius=1.0, outer_radius=3.0, length=8.0),
        cells=Cells(seed=1),
        loads={"pressure": Load(value=4.8, ramp=[(0, 0), (25, 1)])},
    )
    assert built == read_scene(ROOT / "demos" / "artery.toml")
    assert pickle.loads(pickle.dumps(built)) == built


def test_growth_from_rest_is_growth_from_equilibrium():
    values = {
        "geometry": {"shape": "tube", "inner_radius": 1.0, "outer_radius": 3.0, "length": 8.0},
        "loads": {"pressure": {"value": 4.8, "ramp": [(0, 0), (5, 1), (10, 1), (15, 1.5)]}},
        "time": {"end": "equilibrium"},
    }
    now, before = (
        Scene(name="wall", remodeling={"turnover": {"time": 40.0, "from": start}}, **values)
        for start in ("equilibrium", "rest")
    )
    assert now == before
    assert now.remodeling.turnover.starts_at_equilibrium


def test_a_changed_copy_is_validated():
    artery = read_scene(ROOT / "demos" / "artery.toml")
    changed_scene = artery.with_values(
        {"loads.pressure.value": 0.0, "remodeling.frame": "material"}
    )
    assert (changed_scene.loads["pressure"].value, changed_scene.remodeling.frame) == (
        0.0,
        "material",
    )
    assert changed_scene.loads["elongation"] == artery.loads["elongation"]
    assert artery.loads["pressure"].value == 4.8
    with pytest.raises(SceneError, match=r"^time\.step = 1\.0: must be at most time\.end = 0\.5$"):
        artery.with_values({"time.end": 0.5})


def test_a_scene_cannot_be_changed_in_place():
    with pytest.raises(ValueError, match="frozen"):
        read_scene(ROOT / "demos" / "cube.toml").time.end = 3.0  # type: ignore[misc]


# ---------------------------------------------------------------- loads and time


def test_good_ramps_and_times():
    assert Time(end=0.3, step=0.1).number_of_steps == 3
    assert Time(end=150).number_of_steps == 150
    # a kink on a step that binary fractions miss by rounding, and one beyond the end
    ramp = [[0.3, 0.0], [0.7, 1.0], [25.05, 2.0]]
    values = changed(TUBE, {"time": {"end": 1.2, "step": 0.1}, "loads.pressure.ramp": ramp})
    assert scene_from_dict(values).loads["pressure"].factor(0.5) == pytest.approx(0.5)
    held = changed(TUBE, {"loads.elongation": {"value": -0.5, "ramp": [[0, 1]]}})
    assert scene_from_dict(held).loads["elongation"].factor(17.0) == 1.0


# ---------------------------------------------------------------- summary and warnings


def test_the_summary_is_one_line_in_one_unit():
    beginning = "network modulus c = 1.568 Pa, shear modulus mu = 3.103 Pa"
    assert preset_scene(PAPER, "tube").summary() == f"{beginning}, largest pressure 4.8 Pa"
    assert (
        preset_scene(PAPER, "tendon").summary() == f"{beginning}, largest force over its area 30 Pa"
    )
    stiff = preset_scene(PAPER, "cube").with_values(
        {"material.stress_unit": "kPa", "geometry.side": 2.0}
    )
    line = "network modulus c = 0.004116 kPa, shear modulus mu = 3.103 kPa, largest force over its area 2.5 kPa"
    assert stiff.summary() == line
    assert scene_from_dict(CUBE).summary() == beginning
    grows = preset_scene(PAPER, "tube").with_values(
        {
            "remodeling.law": "tensor",
            "remodeling.turnover": {"time": 40.0, "deposition_stretch": 1.1},
        }
    )
    assert grows.summary().endswith("'cauchy' and volume = 0.3")


def test_the_largest_load_is_the_largest_of_the_run():
    load = Load(value=-2.0, ramp=[[0.0, 0.5], [10.0, -1.0], [20.0, 3.0]])
    assert load.largest(10.0) == 2.0
    assert load.largest(12.0) == 2.0 * 1.0  # the ramp passes 0 on the way from -1 to 3
    assert load.largest(15.0) == pytest.approx(-2.0)
    assert load.largest(18.0) == pytest.approx(-2.0 * 2.2)
    assert load.largest(100.0) == -6.0
    assert (
        Load(value=1.0, ramp=[[5.0, -2.0], [10.0, 1.0]]).largest(10.0) == -2.0
    )  # held before the first pair


SOFT = (
    "material.chain_density = 2e+21: the network (c g(r0) r0^2 = 0.00341 kPa) is 910 times (3.0 decades) softer than "
    "the matrix (lame_mu = 3.103 kPa); check chain_density (in 1/m^3), lame_mu and stress_unit"
)


def test_a_chain_density_of_another_stress_unit_is_warned_of():
    printed = preset_scene(PAPER, "tube")
    assert printed.warnings() == []
    soft = printed.with_values({"material.stress_unit": "kPa"})
    assert soft.warnings() == [SOFT]
    assert scene_from_dict(changed(TUBE, {"material.stress_unit": "kPa"})).warnings() == [
        SOFT
    ]  # the defaults
    # another density than the preset's is no excuse
    assert len(soft.with_values({"material.chain_density": 2.1e21}).warnings()) == 1
    assert (
        soft.with_values({"material.stress_unit": "MPa"})
        .warnings()[0]
        .count("is 910000 times (6.0 decades)")
        == 1
    )
    softer = {"material.lame_mu": "3.103 Pa", "loads.pressure.value": "4.8 Pa"}
    for remedy in (
        {"material.chain_density": 2e24},
        {"material.chain_density": 0.0, "loads.pressure.value": 3.0},
        softer,
    ):
        assert soft.with_values(remedy).warnings() == [], remedy


def test_a_wall_too_soft_for_its_pressure_is_warned_of():
    """At the pressure at which the chains of a thin wall come to 90 % of their length; one without them at mu h/r."""
    changes = {
        "geometry.outer_radius": 1.02,
        "model.kinematics": "radial",
        "loads.elongation.value": 0.0,
    }
    changes |= {
        "cells.initial": "isotropic",
        "remodeling.law": "none",
        "material.lame_lambda": 3000.0,
    }
    thin = preset_scene(PAPER, "tube").with_values(
        {**changes, "time.end": 1.0, "loads.pressure.ramp": ramp_to(1)}
    )
    wall = math.log(1.02)
    (words,) = too_soft(thin.with_values({"loads.pressure.value": 600.0 * wall}))
    borne = float(re.search("the tissue bears ([0-9.]+) Pa", words)[1])
    row = rows_of(thin.with_values({"loads.pressure.value": borne * wall}))[-1]
    assert row["max_chain_extension"] == pytest.approx(0.9, abs=6e-3)  # at the inner face
    soft = thin.with_values(
        {"material.chain_density": 0.0, "loads.pressure.value": 1.001 * 3.103 * wall}
    )
    assert (
        len(soft.warnings()) == 1
        and not soft.with_values({"loads.pressure.value": 3.1 * wall}).warnings()
    )
    stiff = thin.with_values({"loads.pressure.value": 0.99 * borne * wall})
    assert not [*too_soft(stiff), *too_soft(stiff.with_values({"geometry.is": "loaded"}))]


def test_a_preset_with_units_in_another_stress_unit(monkeypatch):
    material = {
        "stress_unit": "kPa",
        "lame_mu": "3.103 kPa",
        "lame_lambda": "27293 Pa",
        "chain_density": 2e24,
    }
    monkeypatch.setitem(PRESETS, "stiff", {"cube": {"material": material}})
    stiff = scene_from_dict({**CUBE, "preset": "stiff"})
    assert (stiff.material.lame_mu, stiff.material.lame_lambda, stiff.warnings()) == (
        3.103,
        27.293,
        [],
    )
    assert (
        "(3.0 decades) stiffer than"
        in stiff.with_values({"material.stress_unit": "Pa"}).warnings()[0]
    )


@pytest.mark.parametrize(("shape", "changes", "line"), rows(__file__, "traps.txt"))
def test_numbers_of_another_unit_are_warned_of(shape, changes, line):
    found = preset_scene(PAPER, shape).with_values(values(changes)).warnings()
    assert sum(bool(re.search(line, warning)) for warning in found) == 1, found


def test_bodies_of_plausible_tissue_are_not_warned_of():
    """All that the project ships, and neighbours of it; whatever the unit of chain lengths."""
    for preset, shapes in PRESETS.items():
        for shape in shapes:
            assert preset_scene(preset, shape).warnings() == [], (preset, shape)
    for demo in sorted((ROOT / "demos").glob("*.toml")):
        assert read_scene(demo).warnings() == [], demo
    tube = preset_scene(PAPER, "tube")
    for quiet in (
        {"geometry.inner_radius": 2.99, "loads.pressure.value": 0.01}, {"loads.elongation.value": 0.9},
        {"material.temperature": "20 degC"}, {"material.chain_density": 2e22}, {"material.lame_mu": 50.0},
        {"loads.pressure.value": 0.0}, {"geometry.length": 300.0},
    ):  # fmt: skip
        assert tube.with_values(quiet).warnings() == [], quiet
    metres = {"material.contour_length": 1.594e-9, "material.persistence_length": 1.365e-9,
              "cells.end_to_end_length": 1e-9}  # fmt: skip
    assert [
        len(tube.with_values(metres | more).warnings())
        for more in ({}, {"material.chain_density": 2e24})
    ] == [
        0,
        1,
    ]


# ---------------------------------------------------------------- documentation


def test_a_law_that_shares_of_passes_make_slower_is_said() -> None:
    relaxed = {"coupling": "relaxed"}
    (line,) = scene_from_dict(CUBE | {"remodeling": relaxed | {"law": "rate"}}).warnings()
    assert "remodel at about 0.5 times the rate" in line and "'rate'" in line
    for quiet in (relaxed | {"law": "explicit"}, relaxed | {"law": "none"}, {"law": "rate"}):
        assert scene_from_dict(CUBE | {"remodeling": quiet}).warnings() == []


@pytest.mark.parametrize("preset", ['preset = "consistent"\n', ""])
def test_the_coupling_of_the_default_law_goes_with_it(tmp_path: Path, preset: str) -> None:
    """In a scene as it was run, with its preset or without, and in the preset itself; not where it was asked for."""
    path = tmp_path / "cube.toml"
    as_run = preset_scene("consistent", "cube").to_toml()
    path.write_text(as_run.replace('preset = "consistent"\n', preset))
    for scene in (
        read_scene(path, ["remodeling.law=none"]),
        read_scene(path).with_values({"remodeling.law": "none"}),
    ):
        assert scene.remodeling.coupling == "staggered"
    path.write_text('preset = "consistent"\ngeometry.shape = "cube"\nremodeling.law = "none"\n')
    assert read_scene(path).remodeling.coupling == "staggered"
    with pytest.raises(SceneError, match="remodeling.coupling = 'extrapolated'"):
        read_scene(path, ["remodeling.coupling=extrapolated"])


def test_times_after_an_earlier_end_are_dropped_with_a_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "cube.toml"
    path.write_text(
        'preset = "consistent"\ngeometry.shape = "cube"\noutput.times = [2.0, 5.0, 6.0]\n'
    )
    assert read_scene(path, ["time.end=3"]).output.times == (2.0,)
    assert caplog.messages == ["output.times: dropped 2 times after time.end = 3"]
    with pytest.raises(SceneError, match="must be at most time.end"):
        read_scene(path, ["time.end=3", "output.times=[5]"])


def test_what_a_run_has_chosen_is_chosen_anew(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """With a line, where it does not go with what is set; not what is set itself, nor without any change."""
    path = tmp_path / "scene.toml"
    path.write_text(
        scene_from_dict(BASES["layers"]).with_values({"model.kinematics": "radial"}).to_toml()
    )
    assert (
        read_scene(path, ["remodeling.kappa=0.1"]).model.kinematics == "radial"
        and not caplog.messages
    )
    assert read_scene(path, ["cells.initial=random"]).model.kinematics == "auto"
    assert re.fullmatch(
        "model.kinematics = 'radial': cells.initial .*; using 'auto' instead", *caplog.messages
    )
    with pytest.raises(SceneError, match="model.kinematics = 'radial'"):
        read_scene(path, ["cells.initial=random", "model.kinematics=radial"])
    path.write_text(path.read_text().replace("format = ", "# "))
    with pytest.raises(SceneError, match="model.kinematics = 'radial'"):
        read_scene(path, ["cells.initial=random"])
