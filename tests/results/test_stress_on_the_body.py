"""Stress on the body: an own aneurysm against its virial, what its page, pictures and files show of it."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from scipy.optimize import brentq

from remodel_fenicsx import Recording, cli, run
from remodel_fenicsx.scene import scene_from_dict
from tests.conftest import Refused
from tests.mesh_files import LENGTH, write_tube
from tests.runs import SELF, last_row
from tests.values import ramped

PRESSURE, STIFFNESS = 0.3, 40.0


def bulging(places: np.ndarray) -> np.ndarray:
    """Wider in the middle of the length, more so where x is positive."""
    radii = np.hypot(places[:, 0], places[:, 1])
    wider = 1.0 * np.exp(-(((places[:, 2] - LENGTH / 2) / 0.6) ** 2))
    grow = wider * (1 + 0.3 * places[:, 0] / radii) / radii
    return places * np.stack([1 + grow, 1 + grow, np.ones(len(places))], axis=1)


@pytest.fixture(scope="module")
def aneurysm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of tetrahedra under pressure between guided ends."""
    folder = tmp_path_factory.mktemp("aneurysm")
    mesh = write_tube(folder / "a.msh", "tetrahedron", counts=(12, 2, 16), moved=bulging)
    values: dict[str, Any] = {
        "geometry": {"shape": "mesh", "file": str(mesh)}, "cells": {"initial": "isotropic"},
        "material": {"lame_lambda": 3.0, "lame_mu": 1.0},
        "remodeling": {"law": "none"}, "loads": ramped(1.0, pressure=PRESSURE),
        "supports": {end: {"stiffness": STIFFNESS} for end in ("inlet", "outlet")},
        "time": {"end": 1.0, "step": 1.0}, "output": {"columns": ["max_principal_stress"]},
    }  # fmt: skip
    return run(scene_from_dict(values), folder / "run", SELF)


def faces_of(mesh: Any) -> dict[str, np.ndarray]:
    """Corners of the triangles of each face of a mesh by Gmsh, with normals out of the body."""
    triangles, group = mesh.get_cells_type("triangle"), mesh.get_cell_data(
        "gmsh:physical", "triangle"
    )
    tetrahedra = {tuple(sorted(t[list(f)])): np.setdiff1d(t, t[list(f)])[0]
                  for t in mesh.get_cells_type("tetra") for f in ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3))}  # fmt: skip
    inside = np.array([tetrahedra[tuple(sorted(t))] for t in triangles])
    sides = mesh.points[triangles]
    out = np.einsum("ni,ni->n", np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0]),
                    sides[:, 0] - mesh.points[inside])  # fmt: skip
    triangles[out < 0] = triangles[out < 0][:, ::-1]
    return {
        name: triangles[group == number]
        for name, (number, size) in mesh.field_data.items()
        if size == 2
    }


def area_vectors(corners: np.ndarray) -> np.ndarray:
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2


def test_the_mean_stress_is_that_of_the_tractions(aneurysm: Path) -> None:
    """V mean(sigma) is the integral over the surface of t (x) x: pressure inside, springs at both ends."""
    mesh = meshio.read(aneurysm.parent / "a.msh")
    recording = Recording(aneurysm)
    fields, elements = recording.fields(1.0), recording.elements
    np.testing.assert_allclose(recording.points, mesh.points, atol=1e-12)
    moved = mesh.points + fields["displacement"]
    sides = moved[elements[:, 1:]] - moved[elements[:, :1]]
    volumes = np.abs(np.linalg.det(sides)) / 6
    inner = np.einsum("n,nij->ij", volumes, fields["cauchy_stress"].reshape(-1, 3, 3))
    faces = faces_of(mesh)
    corners = moved[faces["inner"]]
    outer = -PRESSURE * np.einsum("ni,nj->ij", area_vectors(corners), corners.mean(axis=1))
    for name in ("inlet", "outlet"):
        reference, now = mesh.points[faces[name]], moved[faces[name]]
        vectors = area_vectors(reference)
        normal, areas = vectors.sum(axis=0), np.linalg.norm(vectors, axis=1)
        normal, centre = (
            normal / np.linalg.norm(normal),
            areas @ reference.mean(axis=1) / areas.sum(),
        )
        for k in range(3):  # at the middles of the edges
            place, x = ((one[:, k] + one[:, k - 1]) / 2 for one in (reference, now))
            around = np.cross(normal, place - centre)
            around /= np.linalg.norm(around, axis=1, keepdims=True)
            u = x - place
            force = np.outer(u @ normal, normal) + np.sum(u * around, axis=1)[:, None] * around
            outer -= STIFFNESS * np.einsum("n,ni,nj->ij", areas / 3, force, x)
    np.testing.assert_allclose(inner, outer, rtol=0, atol=1e-3 * np.abs(inner).max())
    assert np.abs(inner).max() > 1.0


def test_stresses_of_the_elements_are_those_of_the_tensor(aneurysm: Path) -> None:
    """The largest principal one by its direction, von Mises by components, hoop by the local axis that moves along."""
    recording = Recording(aneurysm)
    fields = recording.fields(1.0)
    stress, F = (
        fields[name].reshape(-1, 3, 3) for name in ("cauchy_stress", "deformation_gradient")
    )
    x, y, z = np.moveaxis(np.diagonal(stress, axis1=1, axis2=2), 1, 0)
    shear = stress[:, 0, 1] ** 2 + stress[:, 1, 2] ** 2 + stress[:, 2, 0] ** 2
    mises = np.sqrt(((x - y) ** 2 + (y - z) ** 2 + (z - x) ** 2) / 2 + 3 * shear)
    np.testing.assert_allclose(fields["von_mises_stress"], mises, rtol=1e-5)
    largest = fields["max_principal_stress"]
    rest = np.linalg.det(stress - largest[:, None, None] * np.eye(3))
    assert np.abs(rest).max() < 1e-4 * np.abs(stress).max() ** 3
    assert (largest >= np.max([x, y, z], axis=0) - 1e-6).all()
    around = np.einsum("nij,nj->ni", F, fields["axis_c"])
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    hoop = np.einsum("ni,nij,nj->n", around, stress, around)
    np.testing.assert_allclose(fields["hoop_stress"], hoop, atol=1e-3 * np.abs(hoop).max())
    column = recording.history["max_principal_stress"][-1]
    assert column == pytest.approx(largest.max(), rel=1e-6)
    centres = recording.points[recording.elements].mean(axis=1)
    place = ", ".join(f"{c:.4g}" for c in centres[largest.argmax()])
    assert (
        f"largest principal stress {column:.6g} at the reference position ({place})"
        in (aneurysm / "run.log").read_text()
    )


def test_sectors_lead_from_inlet_to_outlet_on_the_page_and_as_a_file(
    aneurysm: Path, tmp_path: Path
) -> None:
    """Means of an eighth of the length each: the sack has more than the ends, and the page has the file's numbers."""
    from tests.report.test_report import Decoded

    recording = Recording(aneurysm)
    fields = recording.fields(1.0)
    assert (
        cli.main(["export", str(aneurysm), "--format", "csv", "-o", str(tmp_path / "f.csv")]) == 0
    )
    rows = list(csv.DictReader((tmp_path / "sectors.csv").read_text().splitlines()))
    assert [int(row["sector"]) for row in rows] == [*range(1, 9)]
    found = np.array(
        [[float(row[f"hoop_stress_{n}"]) for n in ("inner", "middle", "outer")] for row in rows]
    )
    corners = recording.points[recording.elements]
    volume = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))
    for k in range(8):
        for depth, column in ((fields["depth"] < 0.5, 0), (fields["depth"] > 0.5, 2)):
            here = (np.floor(8 * fields["station"]) == k) & depth
            expected = np.average(fields["hoop_stress"][here], weights=volume[here])
            assert found[k, column] == pytest.approx(expected, rel=1e-5)
    assert np.ptp(found[:, 0]) > 0.3 * found.max(), found
    np.testing.assert_allclose(found[:, 1], found[:, [0, 2]].mean(axis=1), rtol=0.05)
    page = Decoded.from_run(aneurysm)
    shown = page.data["parts"]["sectors"]
    np.testing.assert_allclose(
        np.array(shown["layers"])[-1][[0, -1]].T, found[:, [0, 2]], rtol=1e-5
    )
    low, high = page.view["max_principal_stress"]
    stored = low + (high - low) * page.arrays["view.max_principal_stress"][-1] / 255
    np.testing.assert_allclose(
        stored, fields["max_principal_stress"], atol=0.51 * (high - low) / 255
    )


# ---------------------------------------------------------------- columns
def test_columns_of_a_tube_are_those_of_the_closed_form() -> None:
    """Neo-Hookean, incompressible, of one length: sigma_rr follows from ln R/r - a/2r^2 with r^2 = R^2 + a."""
    inner, outer, pressure = 1.0, 1.5, 0.25

    def primitive(R: float, a: float) -> float:
        return float(0.5 * np.log(R**2 / (R**2 + a)) - a / (2 * (R**2 + a)))

    def around(R: float, a: float) -> float:
        square = (R**2 + a) / R**2
        return primitive(R, a) - primitive(outer, a) + square - 1 / square

    a = brentq(lambda a: primitive(outer, a) - primitive(inner, a) - pressure, 0.0, 2.0)
    values: dict[str, Any] = {
        "geometry": {"shape": "tube", "inner_radius": inner, "outer_radius": outer, "length": 1.0},
        "material": {"lame_lambda": 2000.0, "lame_mu": 1.0, "chain_density": 0.0},
        "cells": {"initial": "isotropic"}, "remodeling": {"law": "none"},
        "mesh": {"refinement": 2, "degree": 2}, "model": {"kinematics": "radial"},
        "loads": ramped(4.0, pressure=pressure, elongation=0.0), "time": {"end": 4.0, "step": 1.0},
        "output": {"columns": ["max_principal_stress", "percentile_99_stress"], "fields": False},
    }  # fmt: skip
    row = last_row(values)
    assert row["inner_radius"] == pytest.approx(np.sqrt(inner**2 + a), rel=1e-3)
    assert row["max_principal_stress"] == pytest.approx(around(inner, a), rel=0.02)
    there = np.sqrt(inner**2 + 0.01 * (outer**2 - inner**2))  # 1 % of the volume is farther inside
    assert row["percentile_99_stress"] == pytest.approx(around(there, a), rel=0.02)


def test_a_body_without_a_wall_has_neither_hoop_nor_axial_stress(
    tmp_path: Path, refused: Refused
) -> None:
    (tmp_path / "cube.toml").write_text(
        '[geometry]\nshape = "cube"\n[time]\nend = 1.0\nstep = 1.0\n'
    )
    said = refused("run", tmp_path / "cube.toml", "--set", "output.fields=['hoop_stress']")
    assert "hoop and axial are directions of a wall; a cube has none" in said
