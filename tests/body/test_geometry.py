"""Meshes of the three shapes: counts, sizes, named faces, nodes for the supports, the files, two ranks."""

from __future__ import annotations

import runpy
import signal
from pathlib import Path

import basix
import dolfinx
import numpy as np
import pytest
import ufl
from mpi4py import MPI

from remodel_fenicsx.body import Cube, Tendon, Tube
from remodel_fenicsx.body.mesh_file import read_mesh
from tests.parts import cube, tendon, tube

ROOT = Path(__file__).resolve().parents[2]
BUILDERS = {"cube": cube, "tendon": tendon, "tube": tube}
KINDS = [(element, degree) for element in ("hexahedron", "tetrahedron") for degree in (1, 2)]
_built = {}


def domain_of(shape, element="hexahedron", degree=1, refinement=1):
    key = shape, element, degree, refinement
    if key not in _built:
        _built[key] = BUILDERS[shape](
            element=element, degree=degree, refinement=refinement, comm=MPI.COMM_SELF
        )
    return _built[key]


def jacobians(domain):
    """Weights of a quadrature rule and det J there and at the corners, (cells, points)."""
    element = domain.mesh.ufl_domain().ufl_coordinate_element().basix_element
    points, weights = basix.make_quadrature(element.cell_type, 8 if element.degree == 2 else 4)
    corners = basix.geometry(element.cell_type)
    nodes, cells = domain.gather_mesh()

    def determinants(at):
        gradients = element.tabulate(1, at)[1:, :, :, 0]
        return np.linalg.det(np.einsum("dpk,nki->npid", gradients, nodes[cells]))

    return weights, determinants(points), determinants(corners)


def area(domain, face):
    mesh = domain.mesh
    facets = domain.facet_tags.find(domain.faces[face])
    one = dolfinx.mesh.meshtags(mesh, 2, facets, np.ones(len(facets), dtype=np.int32))
    measure = ufl.Measure("ds", domain=mesh, subdomain_data=one, metadata={"quadrature_degree": 8})
    return dolfinx.fem.assemble_scalar(
        dolfinx.fem.form(dolfinx.fem.Constant(mesh, 1.0) * measure(1))
    )


# ---------------------------------------------------------------- counts
@pytest.mark.parametrize(
    ("shape", "cells", "nodes"),
    [("cube", 1, 8), ("tendon", 480, 57 * 11), ("tube", 1536, 16 * 9 * 13)],
)
@pytest.mark.parametrize("refinement", [1, 2])
def test_hexahedra_are_the_papers_times_the_refinement_in_every_direction(
    shape, cells, nodes, refinement
):
    domain = domain_of(shape, refinement=refinement)
    assert domain.number_of_elements == cells * refinement**3
    tables = {"cube": Cube, "tendon": Tendon, "tube": Tube}
    assert (
        tables[shape].number_of_elements == cells
    )  # by which a scene refuses a mesh before it is made
    refined = {"cube": 27, "tendon": (81 + 4 * 32) * 21, "tube": 32 * 17 * 25}
    assert domain.number_of_nodes == (nodes if refinement == 1 else refined[shape])
    assert domain.mesh.topology.cell_name() == "hexahedron"


# ---------------------------------------------------------------- sizes
@pytest.mark.parametrize("shape", BUILDERS)
@pytest.mark.parametrize(("element", "degree"), KINDS)
def test_volumes_and_jacobians(shape, element, degree):
    domain = domain_of(shape, element, degree)
    weights, inside, corners = jacobians(domain)
    # relative to a element's mean: neither turned inside out nor nearly flat anywhere
    assert np.min(inside / np.mean(inside, axis=1, keepdims=True)) > 0.5
    assert np.min(corners / np.mean(inside, axis=1, keepdims=True)) > 0.4
    polygon = 16 / 2 * np.sin(np.pi / 8)
    exact = {
        "cube": 1.0,
        "tendon": 100.0,
        "tube": (polygon if degree == 1 else np.pi) * (9 - 1) * 8,
    }[shape]
    tolerance = 1e-4 if (shape, degree) == ("tube", 2) else 1e-12
    assert np.sum(inside * weights) == pytest.approx(exact, rel=tolerance)


@pytest.mark.parametrize(
    ("element", "degree", "refinement"),
    [
        *((element, degree, 1) for element, degree in KINDS),
        ("hexahedron", 1, 2),
        ("hexahedron", 2, 2),
    ],
)
def test_the_area_of_the_meshed_tendon_is_the_scenes(element, degree, refinement):
    domain = domain_of("tendon", element, degree, refinement)
    assert set(domain.faces) == {"bottom", "top", "side"}
    assert area(domain, "bottom") == pytest.approx(10.0, rel=1e-12)
    assert area(domain, "top") == pytest.approx(10.0, rel=1e-12)
    radius, number = domain.dimensions["radius"], 16 * refinement
    if degree == 1:
        assert area(domain, "side") == pytest.approx(
            number * 2 * radius * np.sin(np.pi / number) * 10.0, rel=1e-12
        )
        assert radius > np.sqrt(10.0 / np.pi)
    else:
        assert area(domain, "side") == pytest.approx(2 * np.sqrt(np.pi * 10.0) * 10.0, rel=1e-4)
        assert radius == pytest.approx(np.sqrt(10.0 / np.pi), rel=1e-4)


# ---------------------------------------------------------------- faces and nodes
@pytest.mark.parametrize("shape", BUILDERS)
@pytest.mark.parametrize(("element", "degree"), KINDS)
def test_the_named_faces_cover_the_boundary_exactly_once(shape, element, degree):
    domain = domain_of(shape, element, degree)
    mesh = domain.mesh
    mesh.topology.create_connectivity(2, 3)
    named = np.concatenate([domain.facet_tags.find(tag) for tag in domain.faces.values()])
    assert sorted(named) == sorted(dolfinx.mesh.exterior_facet_indices(mesh.topology))


# ---------------------------------------------------------------- arguments


@pytest.mark.parametrize("unit", [1e-2, 1e2])
@pytest.mark.parametrize(("shape", "lengths"), [
    ("cube", (1.0,)), ("tendon", (1.0, 1.02e-8)), ("tendon", (1.01e-4, 1.0)), ("tube", (1.01e-4, 1.0, 1.0)),
    ("tube", (1.0, 1.000101, 1.0)), ("tube", (0.5, 1.0, 1.01e-4)), ("tube", (1.01e-4, 2.02e-4, 1.0)),
])  # fmt: skip
def test_bodies_of_extreme_proportions_are_meshed(shape, lengths, unit):
    """At the limits that are allowed no two nodes become one, in any unit of length."""
    powers = (1, 2) if shape == "tendon" else (1, 1, 1)
    scaled = [length * unit**power for length, power in zip(lengths, powers, strict=False)]
    domain, ordinary = BUILDERS[shape](*scaled, refinement=2, comm=MPI.COMM_SELF), domain_of(
        shape, refinement=2
    )
    assert domain.number_of_elements == ordinary.number_of_elements
    assert domain.number_of_nodes == ordinary.number_of_nodes


# ---------------------------------------------------------------- Gmsh's manners
def test_gmsh_is_left_as_it_was(capfd):
    import gmsh

    handler = signal.getsignal(signal.SIGINT)
    cube(comm=MPI.COMM_SELF)
    assert not gmsh.isInitialized() and signal.getsignal(signal.SIGINT) is handler
    gmsh.initialize(
        interruptible=False
    )  # else Gmsh would leave Ctrl-C deadly for all tests that follow
    try:
        gmsh.model.add("somebody's")
        gmsh.model.geo.addPoint(0.0, 0.0, 0.0, tag=7)
        gmsh.model.geo.synchronize()
        terminal = gmsh.option.getNumber("General.Terminal")
        cube(comm=MPI.COMM_SELF)
        assert gmsh.model.getCurrent() == "somebody's" and gmsh.model.getEntities(0) == [(0, 7)]
        assert gmsh.option.getNumber("General.Terminal") == terminal
    finally:
        gmsh.finalize()
    assert capfd.readouterr() == ("", "")


# ---------------------------------------------------------------- files


def test_the_script_makes_the_mesh_files_again(tmp_path):
    script = runpy.run_path(str(ROOT / "meshes" / "make.py"))
    script["make"](tmp_path)
    for name in script["MESHES"]:
        old, new = read_mesh(ROOT / "meshes" / name), read_mesh(tmp_path / name)
        assert np.abs(old.points - new.points).max() < 1e-12 and np.array_equal(
            old.cells, new.cells
        )
