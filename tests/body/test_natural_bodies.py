"""F_e = F G in three dimensions: quarters, whole tubes and bodies from a file, and runs that go on."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx import SceneError, Simulation
from remodel_fenicsx.body.tube import whole_tube
from remodel_fenicsx.model.residual_stress import Layer, close_ring
from remodel_fenicsx.scene import scene_from_dict
from tests.body.test_layers import write_layers
from tests.body.test_natural import layers, scene
from tests.body.test_stresses import NAMES
from tests.runs import goes_on, last_row, made
from tests.tables import rows, values
from tests.values import TURN, assert_close, ramp_to

SELF = MPI.COMM_SELF
MEDIA, ADVENTITIA = {"circumferential": 1.05, "axial": 0.95}, {"axial": 1.1}


@pytest.mark.parametrize(
    ("law", "kinematics"), [("explicit", ["axisymmetric"]), ("none", ["sector", "full"])]
)
def test_all_kinematics_agree_with_one_radius(law: str, kinematics: list[str]) -> None:
    """Radii and stresses, within the facets of their elements. Cells turn where kernels compile faster."""
    few = {
        "time.end": 6.0,
        "loads.pressure.ramp": ramp_to(5),
        "loads.elongation.ramp": ramp_to(5),
    }
    names = ["inner_radius", "outer_radius", "fibre_angle_outer", "mean_hoop_stress", *NAMES]
    ends = []
    for name in ("radial", *kinematics):
        of = scene(name, **few, **{"remodeling.law": law, "output.columns": names})
        domain = (
            whole_tube(of.geometry, (16, 8, 1), "hexahedron", 2, SELF) if name == "full" else None
        )
        ends.append(last_row(of, domain))
    for row in ends[1:]:
        assert_close(row, ends[0], names, 1e-4, 1e-5)


def test_a_wall_thinner_than_its_elements_are_flat_is_refused() -> None:
    """Points outside of the wall would have no stretches: the first row had J below zero."""
    thin = {"geometry.outer_radius": 1.008, "geometry.length": 1.0, "mesh.degree": 1}
    thin |= {"natural.opening_angle": 111.0, "time.end": 1.0}
    with pytest.raises(
        SceneError, match="natural.opening_angle = 111: must be smaller, or mesh.refinement larger"
    ):
        Simulation(scene("full", **thin), SELF)


@pytest.fixture(scope="module")
def two_layers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_layers(tmp_path_factory.mktemp("mesh") / "layers.msh")


def own_body(file: Path, elongation: float, **tables: Any) -> Any:
    """Two layers of a file with a prestretch each, let go and elongated."""
    ramp = ramp_to(1.0)
    values: dict[str, Any] = {
        "geometry": {"shape": "mesh", "file": str(file)}, "cells": {"initial": "isotropic"},
        "natural": {"layers": layers(("media", MEDIA), ("adventitia", ADVENTITIA))},
        "loads": {"elongation": {"value": elongation, "ramp": ramp}}, "remodeling": {"law": "none"},
        "output": {"fields": False, "columns": ["outer_area"]}, "time": {"end": 1.0, "step": 1.0},
        "solver": {"method": "direct"},
    }  # fmt: skip
    return scene_from_dict(values | tables)


def test_layers_of_a_file_come_to_rest_as_the_closing_of_a_ring_says(
    two_layers: Path, tmp_path: Path
) -> None:
    """The ring to which two stretched layers close, from elements and from one radius; the same for a turned body."""
    ring = (1.0, 1.5, 3.0)
    tissue = own_body(two_layers, 0.0).properties()[""].tissue
    stretches = [part["prestretch"] for part in layers((0.0, MEDIA), (0.5, ADVENTITIA))]
    of = scene("radial", **{"natural.layers": layers((0.0, MEDIA))}).natural.layers[0]
    both = [type(of.prestretch)(**stretch).stretches for stretch in stretches]
    parts = [Layer((a, b), tissue, s) for a, b, s in zip(ring, ring[1:], both, strict=False)]
    closed = close_ring(parts, 0.0)
    free = tuple(float(radius) for radius in closed.natural_radius(np.array(ring)))
    assert max(abs(np.array(free) - ring)) > 0.01 and abs(closed.axial - 1) > 0.01
    file = write_layers(tmp_path / "layers.msh", free)
    row = last_row(own_body(file, closed.axial - 1.0))
    length = 0.5 * closed.axial
    assert np.sqrt(row["lumen_volume"] / np.pi / length) == pytest.approx(ring[0], abs=1e-3)
    assert row["outer_area"] / (2 * np.pi * length) == pytest.approx(ring[-1], abs=1e-3)
    turned = last_row(
        own_body(write_layers(tmp_path / "turned.msh", free, TURN), closed.axial - 1.0)
    )
    assert_close(turned, row, ("lumen_volume", "outer_area", "stored_energy"), 1e-6)


def test_a_prestretch_that_is_given_back_leaves_no_stress(two_layers: Path) -> None:
    """The same everywhere: shortened by as much, the body finds its natural state, F_e = 1 up to a rotation."""
    whole = {"natural": {"layers": [{"prestretch": {"axial": 1.1}}]}}
    row = last_row(own_body(two_layers, 1 / 1.1 - 1.0, **whole))
    held = last_row(own_body(two_layers, 0.0, **whole))
    assert (
        abs(row["stored_energy"] - last_row(own_body(two_layers, 0.0, natural={}))["stored_energy"])
        < 1e-4
    )
    assert held["stored_energy"] > 0.1
    assert np.sqrt(row["lumen_volume"] / (np.pi * 0.5 / 1.1)) == pytest.approx(
        np.sqrt(1.1), abs=2e-3
    )


def test_an_own_body_begins_in_balance_without_loads(
    two_layers: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The row of t = 0 is the one that a step without loads has, also where the prestretch comes in parts."""
    strong = {
        "natural": {
            "layers": layers(("media", {"circumferential": 1.3}), ("adventitia", {"axial": 1.2}))
        }
    }
    few: dict[str, Any] = {"method": "direct", "maximum_iterations": 3}
    columns = {"output": {"fields": False, "columns": ["outer_area", *NAMES]}}
    for tables, parts in (({}, 1), (strong | {"solver": few}, 2)):
        caplog.clear()
        with (
            caplog.at_level(logging.INFO),
            made(own_body(two_layers, 0.0, **columns, **tables)) as simulation,
        ):
            start = simulation.stepper.start(simulation.watchers)
            row = next(iter(simulation.steps())).row
        assert_close(start.row, row, ("lumen_volume", "outer_area", *NAMES), 1e-8, 1e-8)
        assert start.work.substeps >= parts and "prestretched body equilibrated" in caplog.text


@pytest.mark.parametrize(("table", "words"), rows(__file__, "bad_layers.txt"))
def test_bad_layers_get_one_line(table: str, words: str, two_layers: Path) -> None:
    with pytest.raises(ValueError) as refused:
        Simulation(own_body(two_layers, 0.0, natural=values(table)), SELF)
    assert words in str(refused.value) and "\n" not in str(refused.value)


def test_a_run_with_residual_stress_goes_on(tmp_path: Path) -> None:
    """Its scene as run has the layers, and it knows all three angles."""
    names = [f"fibre_angle_{of}outer" for of in ("", "unloaded_", "deformed_")]
    asked = scene(
        "radial", **{"natural.layers": layers((0.5, {"axial": 1.1})), "output.columns": names}
    )
    found = goes_on(
        asked.with_values({"output.fields": ["fibre_angle_unloaded"], "time.end": 4.0}),
        tmp_path,
        2.0,
    )
    assert "[[natural.layers]]" in (found.path / "scene.toml").read_text()
    angles = [float(found.history[name][-1]) for name in names]
    assert np.ptp(angles) > 1.0 and len({round(angle, 3) for angle in angles}) == 3
