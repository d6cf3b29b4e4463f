"""Stresses as columns: against the one-dimensional reference, the law of Laplace, and each other's kinematics."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

from remodel_fenicsx import Scene, SceneError, preset_scene
from remodel_fenicsx.extend import Measurement
from remodel_fenicsx.scene import scene_from_dict
from tests.mesh_files import LENGTH, RADII, write_tube
from tests.reference.radial import (
    AXIAL,
    CIRCUMFERENTIAL,
    RADIAL,
    RadialMaterial,
    cauchy_stress,
    solve_radial,
)
from tests.parts import rotation, tube
from tests.runs import last_row, simulated
from tests.values import assert_close, ramp_to, ramped

ELEMENTS, END = 8, 30.0
MIDDLE = slice(9, 15)  # three Gauss points of each of the two elements at the middle radius
OF_REFERENCE = {"hoop": CIRCUMFERENTIAL, "axial": AXIAL, "radial": RADIAL}
NAMES = [
    f"{name}_stress_{where}" for name in OF_REFERENCE for where in ("inner", "middle", "outer")
]


def artery(**changes: Any) -> Scene:
    """The paper's, of isotropic cells, on elements of degree 2 in its plane of symmetry."""
    values = {
        "cells.initial": "isotropic",
        "mesh.degree": 2,
        "model.kinematics": "radial",
        "time.end": END,
    }
    columns = {"output.columns": [*NAMES, "mean_hoop_stress", "inner_radius", "outer_radius"]}
    return preset_scene("kuhl-holzapfel-2007", "tube").with_values(values | columns | changes)


def test_they_are_those_of_the_reference_while_it_remodels() -> None:
    """Mid-wall the same elements and Gauss points, so the same means; at the faces those of finer elements."""
    row = last_row(artery())
    known, finer = solve_radial(end=END, elements=ELEMENTS), solve_radial(end=END)
    for name, component in OF_REFERENCE.items():
        expected = np.average(known.cauchy[-1][MIDDLE, component], weights=known.areas[MIDDLE])
        assert row[f"{name}_stress_middle"] == pytest.approx(expected, rel=1e-6), name
        for where, point in (("inner", 0), ("outer", -1)):  # 0.0011 from the face
            expected = finer.cauchy[-1][point, component]
            assert row[f"{name}_stress_{where}"] == pytest.approx(expected, rel=0.05, abs=0.05), (
                name,
                where,
            )


def test_at_the_faces_they_converge_to_the_traction_and_the_closed_form() -> None:
    """Across: minus the pressure and zero. Around: the law at the stretches of the face, whose radial one balances."""
    short = {
        "remodeling.law": "none",
        "time.end": 5.0,
        "loads.pressure.ramp": ramp_to(5.0),
    }
    short |= {"loads.elongation.ramp": short["loads.pressure.ramp"]}
    fine = solve_radial(end=5.0, ramp_time=5.0, law="none")
    squares, material = np.full((1, 3), 1 / 3), RadialMaterial()
    at_face = np.array([[fine.inner_radii[-1], 1.1, 1.0]])

    def stresses(radial: float) -> np.ndarray:
        return cauchy_stress(np.where([False, False, True], radial, at_face), squares, material)[0]

    hoop = stresses(brentq(lambda radial: stresses(radial)[RADIAL] + 4.8, 0.2, 1.0))[
        CIRCUMFERENTIAL
    ]
    rows = [
        last_row(artery(**short, **{"mesh.refinement": refinement})) for refinement in (1, 2, 4)
    ]
    errors = np.array(
        [
            [abs(row["hoop_stress_inner"] / hoop - 1), abs(row["radial_stress_inner"] / 4.8 + 1)]
            for row in rows
        ]
    )
    assert (
        errors < [[0.02, 0.015], [0.01, 0.005], [0.005, 0.001]]
    ).all()  # means of elements: 62, 46 and 31 % off
    assert all(abs(row["radial_stress_outer"]) < 1e-3 for row in rows)
    linear = last_row(artery(**short, **{"mesh.degree": 1}))
    assert linear["radial_stress_inner"] == pytest.approx(-4.8, rel=0.05)
    assert (
        "linear elements are 0.25 inner radii thick" in artery(**{"mesh.degree": 1}).warnings()[0]
    )
    for fine in (artery(), artery(**{"mesh.degree": 1, "geometry.outer_radius": 1.3})):
        assert not [line for line in fine.warnings() if "linear elements" in line]


@pytest.mark.parametrize("changes", [{}, {"geometry.outer_radius": 1.2}], ids=["thick", "thin"])
def test_the_mean_around_is_that_of_the_law_of_laplace(changes: dict[str, Any]) -> None:
    row = last_row(artery(**changes, **{"loads.pressure.value": 1.0}))
    thickness = row["outer_radius"] - row["inner_radius"]
    assert row["mean_hoop_stress"] == pytest.approx(
        row["pressure"] * row["inner_radius"] / thickness, rel=1e-6
    )


def test_a_half_plane_has_the_same() -> None:
    """The sector and the whole tube too: tests/body/test_natural_bodies.py."""
    short = {
        "time.end": 3.0,
        "loads.pressure.ramp": ramp_to(3.0),
        "loads.pressure.value": 1.5,
    }
    short |= {"remodeling.law": "none"}
    one, other = (
        last_row(artery(**short, **{"model.kinematics": name}))
        for name in ("radial", "axisymmetric")
    )
    assert_close(other, one, (*NAMES, "mean_hoop_stress"), 1e-6, 1e-6)


def test_regions_and_a_mesh_of_ones_own_have_them(tmp_path: Path) -> None:
    """Two layers of a tube; a mesh file of one tissue beside the same tube on one radius."""
    tables: dict[str, Any] = {
        "cells": {"initial": "isotropic"}, "remodeling": {"law": "none"}, "time": {"end": 2.0, "step": 1.0},
        "loads": ramped(2.0, pressure=1.0),
    }  # fmt: skip
    names = ["hoop_stress_inner", "hoop_stress_middle", "radial_stress_inner"]
    round_tube = {
        "shape": "tube",
        "inner_radius": RADII[0],
        "outer_radius": RADII[1],
        "length": LENGTH,
    }
    regions = {"media": {"outer_radius": 1.5}, "adventitia": {}}
    wall = [f"{name}_stress_{layer}" for name in ("hoop", "radial") for layer in regions]
    mesh = {"degree": 2}
    exact = scene_from_dict(
        {"geometry": round_tube, "mesh": mesh, "output": {"columns": names}, **tables}
    )
    layered = exact.with_values({"regions": regions, "output.columns": [*wall, "mean_hoop_stress"]})
    row = last_row(layered)
    assert row["hoop_stress_media"] > row["mean_hoop_stress"] > row["hoop_stress_adventitia"] > 0.0
    assert -1.0 < row["radial_stress_media"] < row["radial_stress_adventitia"] < 0.0
    file = write_tube(tmp_path / "tube.msh", degree=2, counts=(16, 8, 1))
    own = {"shape": "mesh", "file": str(file), "length_unit": "mm"}
    supports = {face: {"kind": "guided"} for face in ("inlet", "outlet")}
    found = scene_from_dict(
        {"geometry": own, "supports": supports, "output": {"columns": names}, **tables}
    )
    assert_close(last_row(found), last_row(exact), names, 0.02)
    with pytest.raises(SceneError, match="output.columns = .*hoop_stress_intima"):
        layered.with_values({"output.columns": ["hoop_stress_intima"]})


def test_they_turn_with_the_wall() -> None:
    """Of a body that is turned about z as a whole: the same stresses, in axes that have turned too."""
    turned = rotation((0.0, 0.0, 1.0), 30.0)
    changes = {"model.kinematics": "full", "mesh.degree": 1, "time.end": 2.0}
    with simulated(artery(**changes), tube(divisions=(8, 4, 2))) as (simulation, _):
        step = simulation.stepper.start()
        before = Measurement(simulation.observer, step)
        expected, placed = before.wall_stress, before.position @ turned.T
        moved = simulation.unknown.x.array.reshape(-1, 3)
        moved += placed - before.position
        found = Measurement(simulation.observer, step).wall_stress
        np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())
        assert np.abs(expected[..., 0] - expected[..., 2]).max() > 0.1
