"""The sheet of a biaxial test: stresses against a point typed by hand, the state of rest, what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from remodel_fenicsx import Scene, SceneError, read_scene
from remodel_fenicsx.studies.fit import model_of, read_measurements
from tests.reference.point import cauchy, repulsion_of_logarithm
from tests.reference.radial import RadialMaterial
from tests.runs import last_row
from tests.tables import rows, values
from tests.values import assert_close, ramped

DEMOS = Path(__file__).parents[2] / "demos"
GREEN, SECOND = "green_strain", "second_piola_kirchhoff_stress"
STIFF = {"lame_lambda": 31030.0, "lame_mu": 3.103, "repulsion": "log"}


def sheet(loads: dict[str, float], **tables: Any) -> Scene:
    """Of 2 x 4 x 0.5, as it is before it remodels."""
    rest: dict[str, Any] = {
        "cells": {"initial": "isotropic"},
        "remodeling": {"law": "none"},
    } | tables
    return Scene(
        geometry={"shape": "sheet", "length_x": 2.0, "length_y": 4.0, "thickness": 0.5},
        loads=ramped(4.0, **loads),
        time={"end": 4.0, "step": 1.0},
        solver={"relative_tolerance": 1e-12},
        **rest,
    )


@pytest.mark.parametrize(
    "material", [{"repulsion": "log"}, STIFF], ids=["soft", "nearly incompressible"]
)
@pytest.mark.parametrize(
    ("cells", "fractions", "angle"),
    [
        ({"initial": "isotropic"}, (1 / 3, 1 / 3), 0.0),
        ({"initial": [0.6, 0.8, 0.0]}, (0.36, 0.64), 0.0),
        ({"fraction_x": 0.5, "fraction_y": 0.3, "mean_angle": 30.0}, (0.5, 0.3), 30.0),
    ],
    ids=["isotropic", "in plane", "oblique"],
)
@pytest.mark.parametrize(
    "loads",
    [
        {"force_x": 16.0, "force_y": 4.0},
        {"force_x": 16.0},
        {"elongation_x": 0.2, "elongation_y": -0.05},
        {"elongation_y": 0.3, "force_x": 8.0},
        {"force_x": 16.0, "force_y": 4.0, "shear": 0.3},
        {"elongation_x": 0.1, "shear": -0.2},
    ],
    ids=" ".join,
)
def test_stresses_are_those_of_a_point_typed_by_hand(
    loads: dict[str, float],
    cells: dict[str, Any],
    fractions: tuple[float, float],
    angle: float,
    material: Any,
) -> None:
    asked = [f"{name}_{axis}" for name in (GREEN, SECOND) for axis in ("x", "y", "xy")]
    row = last_row(sheet(loads, cells=cells, material=material, output={"columns": asked}))
    F = np.diag([1 + row["elongation_x"], 1 + row["elongation_y"], row["thickness_stretch"]])
    F[0, 1] = row["shear"]
    turned = Rotation.from_euler("z", angle, degrees=True).as_matrix()
    A = turned @ np.diag([*fractions, 1 - sum(fractions)]) @ turned.T
    known = RadialMaterial(lame_lambda=material.get("lame_lambda", 27.293))
    sigma = cauchy(F, A, repulsion_of_logarithm(F, A), known)
    nominal = np.linalg.det(F) * sigma @ np.linalg.inv(F).T
    close = {"rel": 1e-8, "abs": 1e-8 * known.lame_lambda}
    strain, second = (F.T @ F - np.eye(3)) / 2, np.linalg.inv(F) @ nominal
    for name, i, j in (("x", 0, 0), ("y", 1, 1), ("xy", 0, 1)):
        assert row[f"{GREEN}_{name}"] == pytest.approx(strain[i, j], abs=1e-12)
        assert row[f"{SECOND}_{name}"] == pytest.approx(second[i, j], **close)
        assert row[f"cauchy_stress_{name}"] == pytest.approx(sigma[i, j], **close)
        assert row[f"nominal_stress_{name}"] == pytest.approx(nominal[i, j], **close)
    assert row["nominal_stress_yx"] == pytest.approx(nominal[1, 0], **close)
    assert sigma[2, 2] == pytest.approx(0.0, abs=close["abs"])
    for axis, area, k in (("x", 4.0 * 0.5, 0), ("y", 2.0 * 0.5, 1)):
        assert row[f"force_{axis}"] == pytest.approx(
            nominal[k, k] * area, rel=1e-7, abs=close["abs"]
        )
        if f"elongation_{axis}" in loads:
            assert row[f"elongation_{axis}"] == pytest.approx(
                loads[f"elongation_{axis}"], abs=1e-12
            )
        else:
            assert row[f"force_{axis}"] == pytest.approx(loads.get(f"force_{axis}", 0.0), abs=1e-6)
    assert row["shear"] == loads.get("shear", 0.0)


@pytest.mark.parametrize("forces", [(0.4, 0.2), (0.4, 0.4), (0.4, 0.1), (0.1, 0.3)])
def test_at_rest_the_collagen_lies_where_the_stresses_say(forces: tuple[float, float]) -> None:
    """tan(angle) = sigma_y / sigma_x: l_I goes with the principal stresses, eq. (9)."""
    changes = {
        f"loads.force_{axis}.value": f"{force} N" for axis, force in zip("xy", forces, strict=True)
    }
    scene = read_scene(DEMOS / "sheet.toml").with_values({**changes, "remodeling.half_life": 2.0})
    assert scene.time.end == 100.0 and scene.loads["force_x"].value == pytest.approx(
        1000 * forces[0]
    )
    row = last_row(scene)
    expected = np.degrees(np.arctan2(row["cauchy_stress_y"], row["cauchy_stress_x"]))
    assert row["fibre_angle"] == pytest.approx(expected, abs=1e-5)


def test_the_mesh_finds_what_the_point_finds() -> None:
    tables: dict[str, Any] = {"remodeling": {"law": "tensor", "kappa": 0.2}}
    rows = [
        last_row(sheet({"force_x": 8.0, "elongation_y": 0.1}, model={"kinematics": name}, **tables))
        for name in ("point", "full")
    ]
    work = {"seconds", "newton_iterations", "linear_iterations", "substeps"}
    assert_close(rows[1], rows[0], set(rows[0]) - work, 1e-8, 1e-8)


@pytest.mark.parametrize(("loads", "tables", "words"), rows(__file__, "bad_sheets.txt"))
def test_what_a_sheet_cannot_have_is_refused_by_its_key(
    loads: str, tables: str, words: str
) -> None:
    with pytest.raises(SceneError, match=f"{words}.*$"):
        sheet(values(loads), **values(tables))


def test_protocols_are_read_as_they_are_published(tmp_path: Path) -> None:
    """Strains are prescribed and stresses compared, or forces drive: the rows of one test give those of the other."""
    scene = sheet({"force_x": 1.0}, material={"repulsion": "log"})
    (tmp_path / "scene.toml").write_text(scene.to_toml())
    strained = (
        "stretch_x;stretch_y;nominal_stress_x;nominal_stress_y\n1,05;1,02;0;0\n1,1;1,04;0;0\n"
    )
    (tmp_path / "strained.csv").write_text(strained)
    text = (
        '[unknowns]\n"material.lame_mu" = {{ start = 3.0 }}\n[[measured]]\nfile = "{0}.csv"\n{1}\n'
    )
    sd = "sd = { nominal_stress_x = 1.0, nominal_stress_y = 1.0 }"
    (tmp_path / "data.toml").write_text(text.format("strained", sd))
    _, (table,) = read_measurements(tmp_path / "data.toml", scene)
    assert table.loads == ("elongation_x", "elongation_y")
    found = model_of(scene, table, {})
    stresses = zip(found["nominal_stress_x"].tolist(), found["nominal_stress_y"].tolist())
    rows = "".join(f"{2 * x!r},{y!r},0,0\n" for x, y in stresses)
    (tmp_path / "driven.csv").write_text("force_x,force_y,elongation_x,elongation_y\n" + rows)
    sd = 'drive = ["force_x", "force_y"]\nsd = { elongation_x = 1.0, elongation_y = 1.0 }'
    (tmp_path / "data.toml").write_text(text.format("driven", sd))
    _, (table,) = read_measurements(tmp_path / "data.toml", scene)
    back = model_of(scene, table, {})
    np.testing.assert_allclose(back["elongation_x"], [0.05, 0.1], atol=1e-9)
    np.testing.assert_allclose(back["elongation_y"], [0.02, 0.04], atol=1e-9)
    (tmp_path / "data.toml").write_text(text.format("driven", sd.replace("force_y", "shear")))
    with pytest.raises(SceneError, match=r"measured\[0\].drive = 'shear': must be columns"):
        read_measurements(tmp_path / "data.toml", scene)
    (tmp_path / "data.toml").write_text(
        text.format("driven", "sd = { force_x = 1.0, force_y = 1.0 }")
    )
    _, (table,) = read_measurements(tmp_path / "data.toml", scene)
    assert table.loads == (
        "elongation_x",
        "elongation_y",
    )  # of a force and a strain along one axis the strain
