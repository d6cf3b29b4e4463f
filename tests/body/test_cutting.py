"""The column opening_angle: what is closed from a sector opens to it; remodeling alone leaves no residual stress."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from remodel_fenicsx import Scene, preset_scene
from remodel_fenicsx.model.residual_stress import Layer, closing, cut, principal_stresses
from tests.runs import made


def scene(preset: str = "consistent", kinematics: str = "radial", **changes: Any) -> Scene:
    """An artery of isotropic cells whose opening angle is asked for."""
    values = {"cells.initial": "isotropic", "model.kinematics": kinematics, "mesh.degree": 2}
    values |= {"output.columns": ["opening_angle"], "output.fields": False, "loads.pressure.ramp": [[0, 0], [5, 1]]}
    values |= {"loads.elongation.ramp": [[0, 0], [5, 1]], "time.end": 20.0}
    return preset_scene(preset, "tube").with_values(values | changes)


def angles(of: Scene) -> list[float]:
    with made(of) as simulation:
        return [float(step.row["opening_angle"]) for step in simulation.steps()]


@pytest.mark.parametrize("opening_angle", [60.0, 160.0])
def test_what_was_closed_opens_again(opening_angle: float) -> None:
    """Angle, radii and length of the sector, from another start than the solution."""
    of = scene(**{"natural.opening_angle": opening_angle})
    tissue, radii = of.properties()[""].tissue, (1.0, 3.0)
    closed = closing([Layer(radii, tissue)], opening_angle)
    radius = np.linspace(*radii, 40)
    isotropic = np.full((40, 3), tissue.end_to_end_length**2 / 3)
    near = closed._replace(circumferential=closed.circumferential)
    found = cut(closed.layers, near, radius, isotropic)
    sector = closed.natural_radius(np.array(radii))
    assert found.opening_angle == pytest.approx(opening_angle, abs=1e-6)
    assert found.radii == pytest.approx(tuple(sector), abs=1e-6)
    assert found.axial == pytest.approx(1 / closed.axial, abs=1e-8)


@pytest.mark.parametrize("preset", ["kuhl-holzapfel-2007", "consistent"])
def test_the_tangent_of_stresses_is_their_derivative(preset: str) -> None:
    """By logarithms of the stretches, of points whose cells differ; with turnover as arrays over the points."""
    tissue = replace(scene(preset).properties()[""].tissue, content=np.array([1.0, 1.5]), natural_length=np.array(1.1))
    stretches, cells = np.array([[1.2, 0.9, 0.95], [1.0, 1.3, 0.8]]), np.array([[0.6, 0.5, 0.6], [0.3, 0.9, 0.2]])
    _, tangents = principal_stresses(tissue, stretches, cells)
    for axis, way in enumerate(1e-4 * np.eye(3)):
        ahead, behind = (principal_stresses(tissue, stretches * np.exp(side * way), cells)[0] for side in (1, -1))
        np.testing.assert_allclose(tangents[..., axis], (ahead - behind) / 2e-4, rtol=1e-4, atol=1e-4)


def test_tensor_and_log_leave_the_angle_as_it_was() -> None:
    """F_e = 1 is free of stress for every structure tensor: a cut of the remodeled tube opens by what was given."""
    for opening_angle in (0.0, 120.0):
        found = angles(scene(**{"natural.opening_angle": opening_angle, "time.end": 40.0, "time.step": 2.5}))
        assert found == pytest.approx([opening_angle] * len(found), abs=1e-5)


def test_the_paper_s_law_makes_hardly_any_residual_stress() -> None:
    """On the way |l| is below r0, which is stress; it fades."""
    found = angles(scene("kuhl-holzapfel-2007", **{"time.end": 200.0, "time.step": 5.0}))
    assert 1.0 < max(map(abs, found)) < 4.0 and 1e-3 < abs(found[-1]) < 0.3


def test_a_stiffer_inside_changes_the_cut() -> None:
    """Cells that were turned by force: the sector is in balance with the cells that are given."""
    tissue, radii = scene().properties()[""].tissue, (1.0, 3.0)
    closed = closing([Layer(radii, tissue)], 120.0)
    radius = np.linspace(*radii, 40)
    share = np.linspace(0.9, 0.05, 40)
    cells = tissue.end_to_end_length**2 * np.stack([share, 0.9 - share + 0.05, np.full(40, 0.05)], axis=1)
    axes_repulsion = preset_scene("kuhl-holzapfel-2007", "tube").properties()[""].tissue
    assert cut(closed.layers, closed, radius, cells).opening_angle == pytest.approx(120.0, abs=1e-5)
    assert cut([Layer(radii, axes_repulsion)], closed, radius, 0.9 * cells).opening_angle != pytest.approx(
        120.0, abs=0.05
    )


def test_no_equilibrium_of_the_cut_is_said(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    def fails(*parts: Any) -> None:
        raise ArithmeticError("out of balance by 0.1")

    monkeypatch.setattr("remodel_fenicsx.model.residual_stress.cut", fails)
    with caplog.at_level(logging.WARNING):
        assert np.isnan(angles(scene(**{"time.end": 5.0})))[0]
    assert "no opening_angle: out of balance by 0.1" in caplog.text
