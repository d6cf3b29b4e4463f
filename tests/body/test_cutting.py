"""The column opening_angle: what is closed from a sector opens to it; remodeling alone leaves no residual stress."""

from __future__ import annotations

import runpy
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from remodel_fenicsx import Scene, SceneError, preset_scene
from remodel_fenicsx.extend import MATRICES, UnitCell, neo_hookean
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.model.residual_stress import (
    ClosedRing,
    Layer,
    Loads,
    Rings,
    close_ring,
    cut,
    principal_stresses,
)
from tests.runs import last_row, made
from tests.values import ramp_to


def scene(preset: str = "consistent", kinematics: str = "radial", **changes: Any) -> Scene:
    """An artery of isotropic cells whose opening angle is asked for."""
    values = {"cells.initial": "isotropic", "model.kinematics": kinematics, "mesh.degree": 2}
    values |= {
        "output.columns": ["opening_angle"],
        "output.fields": False,
        "loads.pressure.ramp": ramp_to(5),
    }
    values |= {"loads.elongation.ramp": ramp_to(5), "time.end": 20.0}
    return preset_scene(preset, "tube").with_values(values | changes)


def angles(of: Scene) -> list[float]:
    with made(of) as simulation:
        return [float(step.row["opening_angle"]) for step in simulation.steps()]


RADII = (1.0, 3.0)
EDGES = np.linspace(*RADII, 17)


def rings(closed: ClosedRing, squared: Any) -> Rings:
    """Three in each of sixteen elements, of cells that depend on the share of the wall."""
    places, weights = np.polynomial.legendre.leggauss(3)
    radius = (EDGES[:-1, None] + np.diff(EDGES)[:, None] * (places + 1) / 2).ravel()
    natural = closed.stretches(radius)
    volume = np.tile(weights, 16) * radius / natural.prod(axis=1)
    return Rings(radius, volume, natural, squared((radius - RADII[0]) / np.ptp(RADII)))


def isotropic(tissue: Tissue) -> Any:
    return lambda share: np.full((len(share), 3), tissue.end_to_end_length**2 / 3)


@pytest.mark.parametrize("opening_angle", [60.0, 160.0])
def test_what_was_closed_opens_again(opening_angle: float) -> None:
    """From the sector's own shape, and from a ring that knows of no sector, by polynomials of its elements."""
    tissue = scene().properties()[""].tissue
    closed = close_ring([Layer(RADII, tissue)], opening_angle)
    for known, close in ((closed, 1e-9), (None, 5e-3)):
        found = cut(tissue, rings(closed, isotropic(tissue)), EDGES, known)
        assert found == pytest.approx(opening_angle, abs=close)


def test_thin_layers_bend_to_the_closed_form_of_a_strip() -> None:
    """Two of h/2, one shorter by m in all directions: as Timoshenko's bimetal that cannot bend along, many turns."""
    thickness, shorter = 0.01, 0.06
    edges = np.linspace(1.0, 1.0 + thickness, 17)
    tissue = replace(scene().properties()[""].tissue, chain=None)
    places, weights = np.polynomial.legendre.leggauss(3)
    radius = (edges[:-1, None] + np.diff(edges)[:, None] * (places + 1) / 2).ravel()
    natural = np.ones((48, 3))
    natural[radius > 1.0 + thickness / 2, 0] += shorter
    natural[:, [1, 2]] = natural[:, :1]
    thin = Rings(
        radius,
        np.tile(weights, 16) * radius / natural.prod(axis=1),
        natural,
        isotropic(tissue)(radius),
    )
    poisson = tissue.lame_lambda / (2 * (tissue.lame_lambda + tissue.lame_mu))
    turns = 1.5 * (1 + poisson) * shorter / (1 + shorter / 2) / thickness
    assert cut(tissue, thin, edges) / 360.0 == pytest.approx(turns, rel=0.02)


# ---------------------------------------------------------------- matrices with directions: the radius comes first
DIRECTED = {
    "gasser-ogden-holzapfel": {"fibre_stiffness": 20.0, "family_angle": 10.0, "dispersion": 0.0},
    "with-second-network": {"second_share_2": 0.6, "second_share_3": 0.3},
}


@pytest.fixture(params=DIRECTED)
def directed(request: pytest.FixtureRequest) -> Iterator[Scene]:
    """The artery with such a matrix."""
    own = {f"material.{key}": value for key, value in DIRECTED[request.param].items()}
    with patch.dict(MATRICES):
        for name in ("gasser_ogden_holzapfel", "second_network"):
            runpy.run_path(str(Path(__file__).parents[2] / "demos" / "extensions" / f"{name}.py"))
        yield scene(
            **{
                "material.matrix": request.param,
                "remodeling.law": "none",
                "remodeling.coupling": "staggered",
            }
            | own
        )


def test_a_closed_ring_of_a_directed_matrix_is_in_balance(directed: Scene) -> None:
    """Axial force from the energy's own derivative by F along x, y and z, the radius, circumference and length."""
    unloaded = {
        "natural.opening_angle": 60.0,
        "loads.pressure.value": 0.0,
        "loads.elongation.value": 0.0,
    }
    columns = {"output.columns": ["opening_angle", "reduced_axial_force"], "mesh.refinement": 2}
    tissue, step = directed.properties()[""].tissue, 1e-30j
    with made(directed.with_values(unloaded | columns)) as simulation:
        start = simulation.stepper.start(simulation.watchers).row
        closed = simulation.state.kinematics.closed_ring
        first = next(iter(simulation.steps())).row
    around, along, across = np.moveaxis(closed.at_panels(), -1, 0)
    F = np.stack([across, around, along * np.exp(step)], axis=-1)[..., None] * np.eye(3)
    cell = UnitCell(
        np.full((*around.shape, 3), tissue.end_to_end_length / 3**0.5),
        np.broadcast_to(np.eye(3), F.shape),
    )
    stress = np.imag(tissue.strain_energy(F, [cell])) / 1e-30 / (across * around * along)
    assert abs(closed.panels.integral(stress * closed.panels.places)) < 1e-10
    assert start["opening_angle"] == pytest.approx(60.0, abs=1e-6)
    assert (
        abs(start["reduced_axial_force"]) < 5e-4
    )  # points on both sides of where fibres begin to pull
    assert first["inner_radius"] == pytest.approx(1.0, abs=2e-5)


def test_the_inverse_of_a_directed_matrix_is_the_unloaded_tube(directed: Scene) -> None:
    row = last_row(directed.with_values({"mesh.refinement": 2, "output.columns": []}))
    layer = Layer((row["inner_radius"], row["outer_radius"]), directed.properties()[""].tissue)
    loads = Loads(directed.loads["pressure"].value, None, 1.0 + directed.loads["elongation"].value)
    assert close_ring([layer], 0.0, loads).natural_radius(np.array(layer.radii)) == pytest.approx(
        RADII, abs=1e-4
    )


def test_directions_that_do_not_follow_the_wall_are_refused(directed: Scene) -> None:
    directed.with_values({"model.kinematics": "axisymmetric"})
    for kinematics in ("full", "sector"):
        with pytest.raises(
            SceneError, match="material.matrix = '[a-z-]+': has directions along x, y and z"
        ):
            directed.with_values({"model.kinematics": kinematics})


def test_an_energy_that_takes_no_complex_numbers_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def of_absolutes(F: Any, lame_lambda: Any, lame_mu: Any) -> Any:
        stretch = F[..., 1, 1] - 1
        return neo_hookean(F, lame_lambda, lame_mu) + lame_mu * (stretch + abs(stretch)) ** 2

    monkeypatch.setitem(MATRICES, "of absolutes", of_absolutes)
    of = scene(**{"material.matrix": "of absolutes", "natural.opening_angle": 60.0})
    with (
        pytest.raises(SceneError, match="material.matrix, chain or repulsion: .* complex numbers"),
        made(of),
    ):
        pass


# ---------------------------------------------------------------- what a run shows
def test_the_angle_converges() -> None:
    """Turnover with residual stress, a wall that grows with layers, and linear elements; with the mesh, to 0.05."""
    turnover: dict[str, Any] = {
        "time": 17.0,
        "deposition_stretch": 1.1,
        "gain": 2.0,
        "rates": "cauchy",
    }
    whole = {
        "natural.opening_angle": 120.0,
        "geometry.outer_radius": 1.3,
        "time.end": 12.0,
        "time.step": 1.0,
    }
    whole |= {"loads.pressure.value": 1.2, "remodeling.turnover": turnover}
    growing = {"remodeling.turnover": turnover | {"volume": 0.3, "rates": "tension"}}
    growing |= {"natural.layers": [{"from": 0.5, "prestretch": {"axial": 0.93}}]}
    for changes in (whole, whole | growing, whole | {"mesh.degree": 1}):
        coarse, fine = (
            angles(scene(**changes | {"mesh.refinement": number}))[-1] for number in (2, 4)
        )
        assert coarse == pytest.approx(fine, abs=0.05) and abs(fine - 120.0) > 0.3


@pytest.mark.parametrize("preset", ["kuhl-holzapfel-2007", "consistent"])
def test_the_tangent_of_stresses_is_their_derivative(preset: str) -> None:
    """By logarithms of the stretches, of points whose cells differ; with turnover as arrays over the points."""
    tissue = replace(
        scene(preset).properties()[""].tissue,
        content=np.array([1.0, 1.5]),
        natural_length=np.array(1.1),
    )
    stretches, cells = np.array([[1.2, 0.9, 0.95], [1.0, 1.3, 0.8]]), np.array(
        [[0.6, 0.5, 0.6], [0.3, 0.9, 0.2]]
    )
    _, tangents = principal_stresses(tissue, stretches, cells)
    for axis, way in enumerate(1e-4 * np.eye(3)):
        ahead, behind = (
            principal_stresses(tissue, stretches * np.exp(side * way), cells)[0] for side in (1, -1)
        )
        np.testing.assert_allclose(
            tangents[..., axis], (ahead - behind) / 2e-4, rtol=1e-4, atol=1e-4
        )


def test_tensor_and_log_leave_the_angle_as_it_was() -> None:
    """F_e = 1 is free of stress for every structure tensor: a cut of the remodeled tube opens by what was given."""
    for opening_angle in (0.0, 120.0):
        found = angles(
            scene(**{"natural.opening_angle": opening_angle, "time.end": 40.0, "time.step": 2.5})
        )
        assert found == pytest.approx([opening_angle] * len(found), abs=1e-5)


def test_the_paper_s_law_makes_hardly_any_residual_stress() -> None:
    """On the way |l| is below r0, which is stress; it fades."""
    found = angles(scene("kuhl-holzapfel-2007", **{"time.end": 200.0, "time.step": 5.0}))
    assert 1.0 < max(map(abs, found)) < 4.0 and 1e-3 < abs(found[-1]) < 0.3


def test_a_stiffer_inside_changes_the_cut() -> None:
    """Cells that were turned by force: the sector is in balance with the cells that are given."""
    tissue = scene().properties()[""].tissue
    closed = close_ring([Layer(RADII, tissue)], 120.0)

    def cells(share: Any) -> Any:
        inside = 0.9 - 0.85 * share
        return tissue.end_to_end_length**2 * np.stack(
            [inside, 0.95 - inside, np.full_like(share, 0.05)], axis=1
        )

    axes_repulsion = preset_scene("kuhl-holzapfel-2007", "tube").properties()[""].tissue
    assert cut(tissue, rings(closed, cells), EDGES, closed) == pytest.approx(120.0, abs=1e-6)
    fewer = rings(closed, lambda share: 0.9 * cells(share))
    assert cut(axes_repulsion, fewer, EDGES, closed) != pytest.approx(120.0, abs=0.05)


def test_no_equilibrium_of_the_cut_is_said(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fails(*parts: Any) -> None:
        raise ArithmeticError("out of balance by 0.1")

    monkeypatch.setattr("remodel_fenicsx.model.residual_stress.cut", fails)
    assert np.isnan(angles(scene(**{"time.end": 5.0})))[0]
    assert "axial_stretch_in_vivo is NaN: out of balance by 0.1" in caplog.text
