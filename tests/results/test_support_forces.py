"""Forces of the supports of own bodies, against the force in the wall and against each other."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from remodel_fenicsx import Scene, SceneError, preset_scene
from remodel_fenicsx.body.tube import whole_tube
from remodel_fenicsx.results.recording import unit_of
from tests.mesh_files import COUNTS, LENGTH, RADII, write_tube
from tests.runs import SELF, last_row, rows_of
from tests.values import TURN, ramp_to, ramped

ENDS = ["support_force_inlet", "support_force_outlet"]
LAW = {"law": "tensor", "coupling": "staggered"}


def scene(file: Path, columns: Any = ENDS, **tables: Any) -> Scene:
    """The tube of a file that is elongated and keeps its pressure."""
    values: dict[str, Any] = {
        "geometry": {"shape": "mesh", "file": str(file)}, "cells": {"initial": "isotropic"},
        "loads": ramped(2, pressure=0.6, elongation=0.1), "time": {"end": 4.0}, "output": {"columns": columns},
        "solver": {"method": "direct", "relative_tolerance": 1e-10},
    }  # fmt: skip
    return Scene(**values | tables)


@pytest.fixture(scope="module")
def tube(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tube(
        tmp_path_factory.mktemp("mesh") / "tube.msh", turn=TURN, shift=(3.0, 4.0, 5.0)
    )


@pytest.mark.parametrize(
    ("kind", "ends"), [("guided", "free"), ("sliding", "free"), ("held", "clamped")]
)
def test_ends_pull_with_the_force_of_the_wall(kind: str, ends: str, tube: Path) -> None:
    """Measured otherwise, by a virtual lengthening of a tube by numbers with the same elements; at both ends."""
    supports = {
        "inlet": {"kind": "guided" if kind == "sliding" else kind},
        "outlet": {"kind": kind},
    }
    rows = rows_of(scene(tube, supports=supports, remodeling=LAW))
    by_numbers = Scene(
        geometry={"shape": "tube", "inner_radius": RADII[0], "outer_radius": RADII[1], "length": LENGTH},
        supports={"ends": ends}, model={"kinematics": "full"}, loads=ramped(2, pressure=0.6, elongation=0.1),
        output={"columns": ["axial_force"]}, cells={"initial": "isotropic"}, time={"end": 4.0}, remodeling=LAW,
    )  # fmt: skip
    numbers = rows_of(by_numbers, whole_tube(by_numbers.geometry, COUNTS, "hexahedron", 1, SELF))
    for row, number in zip(rows[1:], numbers[1:], strict=True):
        np.testing.assert_allclose([row[name] for name in ENDS], number["axial_force"], rtol=2e-3)


def test_a_pressure_on_an_end_is_what_its_support_bears(tube: Path) -> None:
    """Of springs: the pressure times the area of the end, by Newton's third law, whatever the tissue does."""
    loads = {"push": {"kind": "pressure", "face": "outlet", "value": 0.2, "ramp": ramp_to(1)}}
    springs = {"outlet": {"kind": "free"}}
    short: dict[str, Any] = {"loads": loads, "time": {"end": 1.0}}
    row = last_row(scene(tube, ENDS[:1], supports=springs, **short))
    area = 8 / 2 * np.sin(2 * np.pi / 8) * (RADII[1] ** 2 - RADII[0] ** 2)  # of eight chords
    assert row[ENDS[0]] == pytest.approx(-0.2 * area, rel=0.05)
    held = last_row(scene(tube, ENDS[:1], supports=springs | {"inlet": {"kind": "held"}}, **short))
    assert held[ENDS[0]] == pytest.approx(row[ENDS[0]], rel=0.05)
    elastic = {
        "outlet": {"kind": "elastic", "stiffness": 2.0},
        "inlet": {"kind": "elastic", "stiffness": 2.0},
    }
    row = last_row(
        scene(tube, ENDS, supports=elastic, loads={"push": {**loads["push"], "face": "inlet"}})
    )
    assert row[ENDS[0]] - row[ENDS[1]] == pytest.approx(0.2 * area, rel=0.05)


@pytest.mark.parametrize(("stress", "length", "unit"), [
    ("kPa", "mm", "mN"), ("MPa", "mm", "N"), ("Pa", "mm", "µN"), ("kPa", "um", "nN"), ("Pa", "m", "N"),
    ("MPa", "cm", "MPa cm²"), ("kPa", None, ""),
])  # fmt: skip
def test_forces_have_a_unit_of_force_where_there_is_one(
    stress: str, length: str | None, unit: str
) -> None:
    tube = preset_scene("consistent", "tube")
    values = {"material.stress_unit": stress} | ({"geometry.length_unit": length} if length else {})
    assert unit_of(tube.with_values(values), "force") == unit


def test_what_is_refused(tube: Path) -> None:
    around = {"outer": {"kind": "elastic", "stiffness": 0.1}}
    with pytest.raises(
        SceneError, match="output.columns = 'support_force_outer': the face goes around the body"
    ):
        last_row(scene(tube, ["support_force_outer"], supports=around))
    unknown = "output.columns = '{}': no such column on request"
    for name in ("support_force_outer", "support_force_nothing"):
        with pytest.raises(SceneError, match=f"{unknown.format(name)}; .*'support_force_i"):
            scene(tube, [name])
    with pytest.raises(SceneError, match=unknown.format(ENDS[0])):
        scene(tube, supports={"inlet": {"kind": "free"}})
    with pytest.raises(SceneError, match=unknown.format(ENDS[0])):
        Scene(geometry={"shape": "tube"}, preset="consistent", output={"columns": ENDS})
