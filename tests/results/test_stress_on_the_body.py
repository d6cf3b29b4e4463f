"""Stress on the body: an own aneurysm against its virial, what its page, pictures and files show of it."""

from __future__ import annotations

import tomllib
from pathlib import Path

import meshio
import numpy as np
import pytest
from scipy.optimize import brentq

from remodel_fenicsx import Recording, cli, run
from remodel_fenicsx.scene import scene_from_dict
from tests.mesh_files import LENGTH, write_tube
from tests.report.test_report import Decoded
from tests.runs import SELF, last_row

SCENES = tomllib.loads(Path(__file__).with_name("stressed.toml").read_text())
PRESSURE, STIFFNESS = 0.3, 40.0  # of the aneurysm


def bulging(places: np.ndarray) -> np.ndarray:
    """Wider in the middle of the length, as thick as before."""
    wider = np.exp(-(((places[:, 2:] - LENGTH / 2) / 0.6) ** 2))
    return places + wider * places * [1, 1, 0] / np.hypot(places[:, :1], places[:, 1:2])


@pytest.fixture(scope="module")
def aneurysm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of tetrahedra under pressure between guided ends."""
    folder = tmp_path_factory.mktemp("aneurysm")
    mesh = write_tube(folder / "a.msh", "tetrahedron", counts=(12, 2, 16), moved=bulging)
    scene = SCENES["aneurysm"]
    scene["geometry"]["file"] = str(mesh)
    return run(scene_from_dict(scene), folder / "run", SELF)


def test_the_mean_stress_is_that_of_the_tractions(aneurysm: Path) -> None:
    """V mean(sigma) is the integral over the surface of t (x) x: pressure inside, springs at both ends."""
    recording, mesh = Recording(aneurysm), meshio.read(aneurysm.parent / "a.msh")
    fields = recording.fields(1.0)
    moved = recording.points + fields["displacement"]
    corners = moved[recording.elements]
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6
    inner = np.einsum("n,nij->ij", volumes, fields["cauchy_stress"].reshape(-1, 3, 3))
    outer, group = np.zeros((3, 3)), mesh.get_cell_data("gmsh:physical", "triangle")
    for name in ("inner", "inlet", "outlet"):
        nodes = mesh.get_cells_type("triangle")[group == mesh.field_data[name][0]]
        x, X = moved[nodes], recording.points[nodes]
        vectors, areas = (np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]) / 2 for p in (x, X))
        if name == "inner":  # the normal of the body points to the axis
            vectors *= -np.sign(np.sum(vectors * [1, 1, 0] * x[:, 0], axis=1))[:, None]
            outer -= PRESSURE * np.einsum("ni,nj->ij", vectors, x.mean(axis=1))
            continue
        for k in range(3):  # at the middles of the edges, which is exact
            x_k, X_k = ((p[:, k] + p[:, k - 1]) / 2 for p in (x, X))
            weight = STIFFNESS / 3 * np.linalg.norm(areas, axis=1)
            outer -= np.einsum("n,ni,nj->ij", weight, x_k - X_k, x_k)
    np.testing.assert_allclose(inner, outer, rtol=0, atol=1e-3 * np.abs(inner).max())


def test_stresses_of_the_elements_are_those_of_the_tensor(aneurysm: Path) -> None:
    """Von Mises by components, hoop by the local axis that moves along; where the largest one is."""
    recording = Recording(aneurysm)
    fields = recording.fields(1.0)
    stress, F = (fields[n].reshape(-1, 3, 3) for n in ("cauchy_stress", "deformation_gradient"))
    deviator = stress - np.trace(stress, axis1=1, axis2=2)[:, None, None] * np.eye(3) / 3
    mises, largest = (
        np.sqrt(1.5) * np.linalg.norm(deviator, axis=(1, 2)),
        fields["max_principal_stress"],
    )
    np.testing.assert_allclose(fields["von_mises_stress"], mises, rtol=1e-5)
    around = np.einsum("nij,nj->ni", F, fields["axis_c"])
    hoop = np.einsum("ni,nij,nj->n", around, stress, around) / np.sum(around**2, axis=1)
    np.testing.assert_allclose(fields["hoop_stress"], hoop, atol=1e-3)
    assert recording.history["max_principal_stress"][-1] == pytest.approx(largest.max(), rel=1e-6)
    centre = recording.points[recording.elements[largest.argmax()]].mean(axis=0)
    place = ", ".join(f"{c:.4g}" for c in centre)
    assert f"at the reference position ({place})" in (aneurysm / "run.log").read_text()


def test_sectors_lead_from_inlet_to_outlet(aneurysm: Path, tmp_path: Path) -> None:
    """Means of an eighth of the length each, which differ; the page has the file's numbers."""
    recording = Recording(aneurysm)
    fields = recording.fields(1.0)
    assert (
        cli.main(["export", str(aneurysm), "--format", "csv", "-o", str(tmp_path / "f.csv")]) == 0
    )
    _, inner, middle, outer = np.loadtxt(tmp_path / "sectors.csv", delimiter=",", skiprows=1).T
    corners = recording.points[recording.elements]
    volume = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))
    for k, found in enumerate(inner):
        here = (np.floor(8 * fields["station"]) == k) & (fields["depth"] < 0.5)
        expected = np.average(fields["hoop_stress"][here], weights=volume[here])
        assert found == pytest.approx(expected, rel=1e-5)
    assert np.ptp(inner) > 0.3 * inner.max()
    np.testing.assert_allclose(middle, (inner + outer) / 2, rtol=0.05)
    shown = np.array(Decoded.from_run(aneurysm).data["parts"]["sectors"]["layers"])[-1]
    np.testing.assert_allclose(shown[[0, -1]], [inner, outer], rtol=1e-5)


# ---------------------------------------------------------------- columns
def test_columns_of_a_tube_are_those_of_the_closed_form() -> None:
    """Neo-Hookean, incompressible, of one length: sigma_rr follows from ln R/r - a/2r^2 with r^2 = R^2 + a."""
    inner, outer, pressure = 1.0, 1.5, 0.25

    def stress(R: float, a: float) -> np.ndarray:
        """sigma_rr but for a constant, and sigma_cc - sigma_rr."""
        square = (R**2 + a) / R**2
        return np.array([-0.5 * np.log(square) - a / (2 * (R**2 + a)), square - 1 / square])

    def around(R: float) -> float:
        return float(stress(R, a).sum() - stress(outer, a)[0])

    a = brentq(lambda a: stress(outer, a)[0] - stress(inner, a)[0] - pressure, 0.0, 2.0)
    row = last_row(SCENES["tube"])
    assert row["inner_radius"] == pytest.approx(np.sqrt(inner**2 + a), rel=1e-3)
    assert row["max_principal_stress"] == pytest.approx(around(inner), rel=0.02)
    there = np.sqrt(inner**2 + 0.01 * (outer**2 - inner**2))  # 1 % of the volume is farther inside
    assert row["percentile_99_stress"] == pytest.approx(around(there), rel=0.02)
