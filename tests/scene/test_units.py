"""Values with units in scenes: what they become, what is refused, and that pint is not loaded for nothing."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given, settings, strategies

from remodel_fenicsx.scene.scene import read_scene, scene_from_dict
from remodel_fenicsx.schema.tables import SceneError
from remodel_fenicsx.schema.units import is_quantity

ROOT = Path(__file__).resolve().parents[2]
ARTERY = ROOT / "demos" / "artery.toml"
TENDON = ROOT / "demos" / "tendon.toml"


def artery(**changes: Any) -> Any:
    """The artery in mm, with other values: "__" stands for the dot of a key."""
    keys = {"geometry.length_unit": "mm"} | {
        name.replace("__", "."): value for name, value in changes.items()
    }
    return read_scene(ARTERY).with_values(keys)


# ---------------------------------------------------------------- what values become

STRESSES = tomllib.loads(Path(__file__).with_name("stresses.toml").read_text())


@pytest.mark.parametrize(("text", "number"), STRESSES.items())
def test_stresses_in_pascal_exactly(text, number):
    value = artery(loads__pressure__value=text).loads["pressure"].value
    assert value == number and type(value) is float


LENGTHS = {"m": 0.0123, "cm": 1.23, "mm": 12.3, "um": 12300.0}


@pytest.mark.parametrize("unit", LENGTHS)
@pytest.mark.parametrize(
    "text", ["12.3 mm", "1.23 cm", "12300 um", "12300 µm", "0.0123 m", "12300 micrometers"]
)
def test_lengths_in_every_unit_exactly(unit, text):
    scene = scene_from_dict(
        {"geometry": {"shape": "cube", "side": text, "length_unit": unit}, "time": {"end": 1.0}}
    )
    assert (
        scene.geometry.side == LENGTHS[unit]
    )  # a product of floats gives 12.299999999999999 for some of these


def test_the_units_are_those_of_the_scene():
    keys = {"material__stress_unit": "kPa", "geometry__length_unit": "cm"}
    keys |= {
        "loads__pressure__value": "100 mmHg",
        "geometry__inner_radius": "1 mm",
        "geometry__length": "8 mm",
    }
    scene = artery(**keys, material__lame_lambda="27.293 Pa", solver__absolute_tolerance="1 mN")
    assert scene.loads["pressure"].value == 13.3322387415
    assert (scene.geometry.inner_radius, scene.geometry.length) == (0.1, 0.8)
    assert scene.geometry.outer_radius == 3.0  # a number without a unit stays as it is
    assert scene.material.lame_lambda == 0.027293
    assert scene.solver.absolute_tolerance == 0.01  # kPa cm^2 are 100 mN


def test_forces_and_areas():
    values = ["geometry.length_unit=mm", "geometry.area=10 mm^2", "geometry.length=1 cm"]
    scene = read_scene(TENDON, [*values, "material.stress_unit=kPa", "loads.force.value=300 mN"])
    assert (scene.geometry.area, scene.geometry.length, scene.loads["force"].value) == (
        10.0,
        10.0,
        300.0,
    )


def test_temperature_and_chain_density():
    assert artery(material__temperature="37 degC").material.temperature == 310.15
    assert artery(material__temperature="98.6 degF").material.temperature == 310.15
    assert artery(material__temperature="310 K").material.temperature == 310.0
    for text in ("2e21 / m^3", "2e21 m^-3", "2e21/m**3", "2e15 / cm^3", "2000 / um^3"):
        assert artery(material__chain_density=text).material.chain_density == 2e21


def test_a_scene_as_run_holds_numbers(tmp_path):
    text = artery(loads__pressure__value="100 mmHg", geometry__length="8 mm").to_toml()
    again = tmp_path / "again.toml"
    again.write_text(text)
    values = tomllib.loads(text)
    assert (values["loads"]["pressure"]["value"], values["geometry"]["length"]) == (
        13332.2387415,
        8.0,
    )
    assert values["geometry"]["length_unit"] == "mm"
    assert read_scene(again) == read_scene(again, ["geometry.length=8 mm"])


# ---------------------------------------------------------------- the command line


@pytest.mark.parametrize(
    "value", ['"100 mmHg"', "100 mmHg", "100mmHg", "'100 mmHg'", " 13332.2387415 "]
)
def test_set_with_and_without_quotes(value):
    assert (
        read_scene(ARTERY, [f"loads.pressure.value={value}"]).loads["pressure"].value
        == 13332.2387415
    )


def test_a_quantity():
    assert all(
        map(
            is_quantity,
            ("5 mm", "-5 mm", "2e21 / m^3", "37 degC", "1 N/mm^2", "1 kg m s^-2", "37 °C"),
        )
    )
    for text in (
        "5",
        "2e21",
        "mm",
        "two words",
        "5 mm = 3",
        "5 mm, 6 mm",
        "2 / 3",
        "5 m(",
        "",
        "1_000",
    ):
        assert not is_quantity(text), text


@settings(max_examples=100, deadline=None)
@example("²1_")  # pint reads with Python's tokenizer, which has errors of its own
@given(strategies.text("19.eE+-*/^()[]{}%°·²³_ \n'mkNPasgHK€", max_size=30))
def test_any_text_becomes_a_number_or_one_line(text):
    # towers of powers and exponents of many digits among them: neither takes long nor ends otherwise
    for value in (text, f"1 {text}", f"{text} Pa", f"1 m**{text}"):
        try:
            scene = artery(loads__pressure__value=value)
        except SceneError as error:
            assert re.match(r"loads\.pressure\.value = .*: ", str(error)) and "\n" not in str(error)
        else:
            assert isinstance(scene.loads["pressure"].value, float)


# ---------------------------------------------------------------- start-up


@pytest.mark.parametrize(("value", "loaded"), [("4.8", False), ("4.8 Pa", True)])
def test_pint_is_loaded_only_where_there_is_a_unit(value, loaded):
    code = (
        "import sys; from remodel_fenicsx.scene.scene import read_scene; read_scene(*sys.argv[1:2], sys.argv[2:]); "
        "print('pint' in sys.modules)"
    )
    command = [sys.executable, "-c", code, str(ARTERY), f"loads.pressure.value={value}"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=200)
    assert done.stdout == f"{loaded}\n"
