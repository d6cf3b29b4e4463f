"""The scripts of demos/extensions: parts from outside, and the physics of what they add."""

from __future__ import annotations

import runpy
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from remodel_fenicsx import Recording, Scene, SceneError, cli, preset_scene, read_scene
from remodel_fenicsx.extend import MATRICES, REMODELS, SHAPES
from remodel_fenicsx.parts import Tube
from remodel_fenicsx.system import environment
from tests.runs import last_row, rows_of, simulated

FOLDER = Path(__file__).parents[2] / "demos" / "extensions"
ELASTIC = {
    "remodeling.law": "none",
    "remodeling.coupling": "staggered",
    "material.chain_density": 0.0,
    "time.end": 4.0,
}


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], Scene]]:
    """The scene of a script, which has been run; what it registers is taken back."""
    monkeypatch.setattr(Tube, "loads", dict(Tube.loads))
    monkeypatch.setattr(Tube, "columns", Tube.columns)

    def read(name: str) -> Scene:
        runpy.run_path(str(FOLDER / f"{name}.py"))
        return read_scene(FOLDER / f"{name}.toml")

    with patch.dict(SHAPES), patch.dict(REMODELS):
        yield read


def test_each_is_short() -> None:
    scripts = sorted(FOLDER.glob("*.py"))
    assert scripts and all(len(script.read_text().splitlines()) < 72 for script in scripts)


def test_a_turned_tube_has_the_shear_of_torsion(scene: Any) -> None:
    """sigma_ca = mu r theta / length, of an elastic tube that is turned by one degree; its end turns as a whole."""
    changes = {
        **ELASTIC,
        "loads.torsion.value": 1.0,
        "loads.pressure.value": 0.0,
        "loads.elongation.value": 0.0,
    }
    turned = scene("torsion").with_values(changes)
    with simulated(turned) as (simulation, rows):
        moved = simulation.unknown.x.array.reshape(-1, 3)
        nodes = simulation.unknown.function_space.tabulate_dof_coordinates()
        assert len(simulation.domain.mesh.geometry.x) == len(nodes)
    radius = 2 / 3 * (2.0**3 - 1.0**3) / (2.0**2 - 1.0**2)  # the mean over the wall
    assert rows[-1]["shear_stress"] == pytest.approx(
        turned.material.lame_mu * radius * np.radians(1.0) / 3.0, rel=0.02
    )
    top = nodes[:, 2] > 3.0 - 1e-9
    angle = np.angle((nodes + moved)[top] @ [1, 1j, 0]) - np.angle(nodes[top] @ [1, 1j, 0])
    np.testing.assert_allclose(np.degrees((angle + np.pi) % (2 * np.pi) - np.pi), 1.0, atol=1e-9)
    other = rows_of(turned.with_values({"loads.torsion.value": -1.0}))
    assert other[-1]["shear_stress"] == pytest.approx(-rows[-1]["shear_stress"], rel=1e-6)


def test_torsion_stands_beside_elongation_and_turns_the_collagen(scene: Any) -> None:
    """One angle for both ends of a spiral: chains leave 45 degrees; one number cannot say it, so no reduction does."""
    turned = scene("torsion")
    rows = rows_of(turned)
    assert rows[-1]["axial_elongation"] == pytest.approx(0.05) and rows[-1]["torsion"] == 20.0
    assert rows[-1]["shear_stress"] > 0.5 and rows[-1]["fibre_angle_inner"] < 44.0
    with pytest.raises(
        SceneError, match="model.kinematics = 'radial': loads.torsion would have to be applied"
    ):
        turned.with_values({"model.kinematics": "radial"})


FIBRES = {
    "preset": "consistent", "geometry.outer_radius": 1.3, "cells.initial": "isotropic", "model.kinematics": "radial",
    "mesh.degree": 2, "mesh.refinement": 2, "material.matrix": "gasser-ogden-holzapfel", "material.lame_mu": 3.0,
    "material.lame_lambda": 3e4, "material.fibre_stiffness": 5.0, "material.fibre_exponent": 2.0,
    "material.dispersion": 0.1, "material.family_angle": 40.0, "time.step": 1.0, **ELASTIC, "time.end": 3.0,
}  # fmt: skip
LOADS = [
    "loads.pressure={value=3.0,ramp=[[0.0,0.0],[3.0,1.0]]}",
    "loads.elongation.ramp=[[0.0,0.0],[1.0,1.0]]",
]


def test_fibres_that_stay_bear_a_tube_as_pymecht_says(tmp_path: Path) -> None:
    """pymecht 1.1.3, `goh` and `nh`, a tube of 1 to 1.3 that is 10 % longer; two layers of one tissue are none."""
    script, demo = FOLDER / "gasser_ogden_holzapfel.py", FOLDER.parent / "artery.toml"
    layers = {"regions": {"media": {"outer_radius": 1.1}, "adventitia": {}}}
    with patch.dict(MATRICES), patch.dict(environment._loaded):
        for name, regions in (("one", {}), ("layers", layers)):
            words = [*(f"{key}={toml(value)}" for key, value in (FIBRES | regions).items()), *LOADS]
            asked = [part for word in words for part in ("--set", word)]
            line = f"run {demo} --with {script} -q --no-report -o {tmp_path / name}".split() + asked
            assert cli.main(line) == 0
            radii = Recording(tmp_path / name).history["inner_radius"]
            np.testing.assert_allclose(radii[1:], [1.23184606, 1.42517281, 1.52797886], rtol=1e-5)


def toml(value: Any) -> str:
    """An inline value."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {toml(part)}" for key, part in value.items()) + "}"
    return f'"{value}"' if isinstance(value, str) else repr(value)


def test_lost_collagen_is_a_network_of_that_density(scene: Any) -> None:
    """At each time the cube is as long as one whose chain density is exp(-rate t) of the whole."""
    runpy.run_path(str(FOLDER / "decaying_collagen.py"))
    cube = preset_scene("kuhl-holzapfel-2007", "cube").with_values(
        {"model.kinematics": "point", "time.end": 4.0}
    )
    still = {"remodeling.law": "none"}
    decaying = cube.with_values({**still, "remodeling.decay.rate": 0.3})
    assert decaying.remodeling.decay.rate == 0.3 and not cube.remodeling.decay.is_on  # type: ignore[attr-defined]
    assert Scene(**tomllib.loads(decaying.to_toml())) == decaying
    found = [row["mean_stretch"] for row in rows_of(decaying)]
    for number, stretch in enumerate(found, start=1):
        less = {
            **still,
            "material.chain_density": cube.material.chain_density * np.exp(-0.3 * number),
        }
        assert stretch == pytest.approx(
            rows_of(cube.with_values(less))[number - 1]["mean_stretch"], rel=1e-9
        )
    remodeled = cube.with_values({"remodeling.decay.rate": 0.3})
    assert rows_of(remodeled)[-1]["mean_fibre_angle"] < 54.0  # the cells remodel beside it
    with pytest.raises(SceneError, match=r"remodeling\.decay\.rate = -1.0: must be .* at least 0"):
        cube.with_values({"remodeling.decay.rate": -1.0})


@pytest.mark.usefixtures("scene")
def test_a_steady_state_that_there_is_not_is_told(caplog: pytest.LogCaptureFixture) -> None:
    """What is lost at a constant rate never rests: the path ends with a warning, at its beginning."""
    runpy.run_path(str(FOLDER / "decaying_collagen.py"))
    changes = {
        "time.end": "equilibrium",
        "remodeling.decay.rate": 0.05,
        "model.kinematics": "point",
    }
    assert last_row(preset_scene("consistent", "cube").with_values(changes))["mean_stretch"] > 1.0
    assert any("lost at a constant rate" in line for line in caplog.messages)
