"""The parts in demos/extensions: closed forms, and keys of their own in a scene."""

from __future__ import annotations

import pickle
import runpy
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from remodel_fenicsx import Scene, SceneError, Simulation, preset_scene, read_scene
from remodel_fenicsx.extend import CHAINS, DRIVERS, LAWS, MATRICES
from remodel_fenicsx.studies.fit import model_of, read_measurements

FOLDER = Path(__file__).parents[2] / "demos" / "extensions"


@pytest.fixture(autouse=True)
def parts() -> Iterator[None]:
    """Those of the files, as the command line loads them."""
    with patch.dict(CHAINS), patch.dict(DRIVERS), patch.dict(LAWS), patch.dict(MATRICES):
        for name in (
            "freely_jointed_chain",
            "mandel_driver",
            "kappa_by_temperature",
            "second_network",
        ):
            assert len((FOLDER / f"{name}.py").read_text().splitlines()) < 72
            runpy.run_path(str(FOLDER / f"{name}.py"))
        yield


def scene(preset: str = "kuhl-holzapfel-2007", **changes: Any) -> Scene:
    """The cube as a point: its kernels compile fastest."""
    values = {"time.end": 3.0, "model.kinematics": "point"}
    return preset_scene(preset, "cube").with_values(
        values | {k.replace("__", "."): v for k, v in changes.items()}
    )


def rows(scene: Scene, name: str = "mean_fibre_angle") -> list[float]:
    return [step.row[name] for step in Simulation(scene).steps()]


FREELY_JOINTED = {
    "material__chain": "freely-jointed",
    "material__links_per_persistence_length": 0.6,
}


def test_the_force_is_the_slope_of_the_energy() -> None:
    """Of a freely jointed chain: beta = x (3 - x^2)/(1 - x^2)."""
    chain, r = CHAINS["freely-jointed"].with_parameters(
        {"links_per_persistence_length": 0.6}
    ), np.linspace(0.05, 1.5, 9)
    slope = (chain.energy(r + 1e-6, 1.6) - chain.energy(r - 1e-6, 1.6)) / 2e-6
    x = r / 1.6
    np.testing.assert_allclose(slope, chain.force(r, 1.6, 1.0), rtol=1e-8)
    np.testing.assert_allclose(slope, 0.6 * x * (3 - x**2) / (1 - x**2), rtol=1e-8)


def test_a_key_of_a_chain_is_one_of_the_scene(tmp_path: Path) -> None:
    """It is written, read again, counts in the solution, and has its default."""
    found = scene(**FREELY_JOINTED)
    (tmp_path / "scene.toml").write_text(found.to_toml())
    assert read_scene(tmp_path / "scene.toml") == found == pickle.loads(pickle.dumps(found))
    stretch = rows(found, "mean_stretch")[-1]
    other = rows(scene(material__chain="freely-jointed"), "mean_stretch")[-1]
    assert abs(other / stretch - 1) > 1e-4
    assert scene(material__chain="freely-jointed").material.links_per_persistence_length == 0.5  # type: ignore


@pytest.mark.parametrize(("changes", "line"), [
    ({**FREELY_JOINTED, "material__links_per_persistence_length": -1.0},
     "material.links_per_persistence_length = -1.0: must be a finite number greater than 0"),
    ({"material__links_per_persistence_length": 0.6}, "material.links_per_persistence_length = 0.6: unknown key; "),
    ({**FREELY_JOINTED, "material__lame_mu": -1.0}, "material.lame_mu = -1.0: must be a finite number greater than 0"),
    ({"remodeling__activation_energy": 1.0}, "remodeling.activation_energy = 1.0: unknown key; "),
])  # fmt: skip
def test_what_is_refused(changes: dict[str, Any], line: str) -> None:
    with pytest.raises(SceneError) as refused:
        scene(**changes)
    assert str(refused.value).startswith(line)


def test_a_stiffness_of_an_experiment_is_that_of_the_chain() -> None:
    """A chain with twice the links has twice the stiffness: half of the density has the measured slope."""
    densities = []
    for links in (0.5, 1.0):
        material = {
            "chain": "freely-jointed",
            "links_per_persistence_length": links,
            "initial_stiffness": 2.0,
        }
        found = Scene(geometry={"shape": "cube"}, material=material, time={"end": 1.0})
        densities.append(found.material.chain_density)
    assert densities[0] == pytest.approx(2 * densities[1])


@pytest.mark.parametrize("coupling", ["relaxed", "extrapolated", "staggered"])
def test_the_mandel_stress_is_taken_by_every_coupling(coupling: str) -> None:
    """In a pulled cube it has the axes of Cauchy's stress, and so the same target."""
    driven = [
        scene("consistent", remodeling__driver=name, remodeling__coupling=coupling)
        for name in ("mandel", "cauchy")
    ]
    np.testing.assert_allclose(*map(rows, driven), atol=1e-9)


def test_kappa_depends_on_the_temperature_of_each_region() -> None:
    """exp(-E/R (1/theta - 1/theta_0)); cells remodel by it."""
    warm = scene(
        remodeling__law="arrhenius", material__temperature=320.0, remodeling__activation_energy=6e4
    )
    kappa = warm.remodeling.kappa * np.exp(-6e4 / 8.314 * (1 / 320 - 1 / 310))
    assert warm.properties()[""].kappa == pytest.approx(kappa, rel=1e-12)
    plain = scene(material__temperature=320.0, remodeling__kappa=kappa)
    np.testing.assert_allclose(rows(warm), rows(plain), atol=1e-12)
    layers = {"a": {"outer_radius": 2.0, "material": {"temperature": 300.0}}, "b": {}}
    tube = preset_scene("kuhl-holzapfel-2007", "tube").with_values(
        {"remodeling.law": "arrhenius", "regions": layers}
    )
    cool, usual = (one.kappa for one in tube.properties().values())
    assert cool < usual == tube.remodeling.kappa


SECOND = {
    "material__matrix": "with-second-network",
    "material__repulsion": "log",
    "remodeling__law": "none",
}


def test_a_second_network_like_the_first_is_as_good_as_twice_the_chains() -> None:
    """Of isotropic cells, in the units of the first, whose length without load is 1."""
    half = scene(**SECOND)
    tissue = Simulation(half).tissue
    second = {
        "second_modulus": tissue.network_modulus,
        "second_contour_length": tissue.contour_length,
    }
    two = scene(**SECOND, **{f"material__{name}": float(value) for name, value in second.items()})
    one = {"repulsion": "log", "chain_density": 2 * half.material.chain_density}
    one_of_twice = scene(
        remodeling__law="none", **{f"material__{name}": value for name, value in one.items()}
    )
    np.testing.assert_allclose(
        rows(two, "mean_stretch"), rows(one_of_twice, "mean_stretch"), rtol=1e-9
    )
    assert abs(rows(two, "mean_stretch")[-1] / rows(half, "mean_stretch")[-1] - 1) > 1e-3


def test_two_networks_follow_a_tissue_that_one_does_not() -> None:
    """Seven measured protocols: at least 0.97 of the variance, where one network comes to 0.69 and 0.79."""
    folder = FOLDER.parent / "biaxial"
    file = read_scene(folder / "two_networks.toml")
    _, (table,) = read_measurements(folder / "two_networks_tissue.toml", file)
    modelled = model_of(file, table, {})
    for column in ("nominal_stress_x", "nominal_stress_y"):
        measured = table.columns[column]
        assert 1 - np.var(modelled[column] - measured) / np.var(measured) > 0.97
