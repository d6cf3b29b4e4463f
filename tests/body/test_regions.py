"""Regions of a body: which element is in which, what a scene may ask, and what each has of its own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from pydantic_core import PydanticCustomError

from remodel_fenicsx import Scene, SceneError
from remodel_fenicsx.body import SHAPES, Tube
from remodel_fenicsx.body.domain import Domain, build_domain
from remodel_fenicsx.body.gmsh_model import GeometryError
from remodel_fenicsx.body.shape import WithRegions
from remodel_fenicsx.body.wall import shared_out
from remodel_fenicsx.schema.settings import Mesh, Region
from remodel_fenicsx.initial import checked_domain, mesh_of
from remodel_fenicsx.simulation import Simulation

SELF = MPI.COMM_SELF
WALL = {"shape": "tube", "inner_radius": 1.0, "outer_radius": 3.0, "length": 2.0}
LAYERS = {
    "adventitia": {},
    "media": {"outer_radius": 1.7},
    "intima": {"outer_radius": 1.02},
}  # in any order


def layered(regions: dict[str, Any] = LAYERS, **tables: Any) -> Scene:
    """A scene of a tube with layers."""
    values = {"cells": {"initial": "isotropic"}, "time": {"end": 1.0}} | tables
    return Scene(geometry=WALL, regions=regions, **values)


def radii_of(domain: Domain) -> np.ndarray:
    """Smallest and largest distance from the axis of each local element's nodes, (elements, 2)."""
    from remodel_fenicsx.fem.compat import geometry_dofmap

    radii = np.linalg.norm(domain.mesh.geometry.x[geometry_dofmap(domain.mesh)][..., :2], axis=-1)
    return np.stack([radii.min(axis=1), radii.max(axis=1)], axis=1)


@pytest.mark.parametrize("kinematics, element, degree", [
    ("radial", "hexahedron", 1), ("axisymmetric", "hexahedron", 2), ("sector", "hexahedron", 2),
    ("full", "hexahedron", 1), ("full", "tetrahedron", 1),
])  # fmt: skip
def test_no_element_is_in_two_layers(kinematics: str, element: str, degree: int) -> None:
    """Elements of a thin layer are thin, all layers together are the wall; as many elements as without them."""
    mesh = {"element": element, "degree": degree}
    scene = layered(mesh=mesh, model={"kinematics": kinematics})
    domain, whole = mesh_of(scene, SELF), mesh_of(
        layered({}, mesh=mesh, model={"kinematics": kinematics}), SELF
    )
    assert domain.number_of_elements == whole.number_of_elements and set(whole.regions) == {"body"}
    assert list(domain.regions) == ["intima", "media", "adventitia"], "from the lumen outwards"
    radii, ends = radii_of(domain), (1.0, 1.02, 1.7, 3.0)
    for name, inner, outer in zip(domain.regions, ends[:-1], ends[1:], strict=True):
        own = radii[domain.element_region == domain.regions[name]]
        assert (
            len(own)
            and own.min() == pytest.approx(inner, rel=1e-12)
            and own.max() == pytest.approx(outer, rel=1e-12)
        )
    assert set(domain.element_region) == set(domain.regions.values())


@pytest.mark.parametrize("thicknesses, elements, counts", [
    ([1.0, 1.0], 8, (4, 4)), ([0.01, 2.0], 8, (1, 7)), ([1.0, 3.0], 8, (2, 6)), ([0.1, 0.1, 0.1], 3, (1, 1, 1)),
    ([2.0], 8, (8,)),
])  # fmt: skip
def test_elements_are_shared_out_by_thickness(
    thicknesses: list[float], elements: int, counts: tuple[int, ...]
) -> None:
    assert shared_out(thicknesses, elements) == counts


def test_a_line_of_the_mesh_that_is_there_already_changes_nothing() -> None:
    """Two layers of the same thickness: the mesh of the wall without layers."""
    halves = layered({"media": {"outer_radius": 2.0}, "adventitia": {"outer_radius": 3.0}})
    for kinematics in ("radial", "axisymmetric", "sector", "full"):
        change = {"model.kinematics": kinematics}
        points, elements = mesh_of(halves.with_values(change), SELF).gather_mesh()
        others, same = mesh_of(layered({}).with_values(change), SELF).gather_mesh()
        assert points is not None and others is not None
        np.testing.assert_allclose(points[elements], others[same], rtol=0, atol=1e-15)


def test_an_outer_radius_where_no_layer_is_is_refused() -> None:
    """Also by shapes of scripts that have regions and say no more about them."""
    mesh = SHAPES["mesh"](file="vessel.msh")
    assert isinstance(mesh, WithRegions)
    mesh.check_regions({"core": Region()}, Mesh())
    with pytest.raises(
        PydanticCustomError, match="the mesh defines the regions of a mesh; only a tube has"
    ):
        mesh.check_regions({"core": Region(outer_radius=1.0)}, Mesh())


def test_radii_of_layers_take_units_and_are_read_back(tmp_path: Any) -> None:
    scene = Scene(
        geometry=WALL | {"length_unit": "mm"}, regions={"media": {"outer_radius": "0.17 cm"}, "adventitia": {}},
        time={"end": 1.0},
    )  # fmt: skip
    assert scene.regions["media"].outer_radius == 1.7
    (tmp_path / "scene.toml").write_text(scene.to_toml())
    from remodel_fenicsx import read_scene

    assert read_scene(tmp_path / "scene.toml") == scene
    assert (
        read_scene(tmp_path / "scene.toml", ["regions.media.outer_radius=1.5"])
        .regions["media"]
        .outer_radius
        == 1.5
    )


def test_a_mesh_without_the_scenes_regions_is_refused() -> None:
    """Meshes of scripts have to have them; a scene may leave some of the mesh's out."""
    tube = Tube(**WALL)
    regions = {"media": Region(outer_radius=1.7), "adventitia": Region()}
    scene, mesh = layered({"media": {"outer_radius": 1.7}, "adventitia": {}}), Mesh()
    checked_domain(
        tube.build_with(regions, mesh, SELF), scene.with_values({"model.kinematics": "full"})
    )
    with pytest.raises(
        SceneError, match="^regions.media: the mesh has no such region; it has body$"
    ):
        Simulation(scene.with_values({"model.kinematics": "full"}), SELF, tube.build(mesh, SELF))


# ---------------------------------------------------------------- named volumes of Gmsh


def boxes(*groups: dict[str, list[int]], numbers: bool = False) -> Any:
    """Draws two boxes on each other as a body of several volumes; groups of volumes by name."""

    def draw() -> None:
        import gmsh

        occ = gmsh.model.occ
        pair = [(3, occ.addBox(0, 0, z, 1, 1, 1)) for z in (0, 1)]
        occ.fragment(pair[:1], pair[1:])
        occ.synchronize()
        faces = [tag for _, tag in gmsh.model.getEntities(2)]
        gmsh.model.addPhysicalGroup(2, faces, name="all")
        for number, (name, volumes) in enumerate(groups[0].items(), start=11):
            gmsh.model.addPhysicalGroup(3, volumes, number, name="" if numbers else name)
        gmsh.model.mesh.setSize(gmsh.model.getEntities(0), 0.6)
        gmsh.model.mesh.generate(3)

    return draw


@pytest.mark.parametrize("numbers", [False, True])
def test_named_volumes_become_regions(numbers: bool) -> None:
    """As a mesh file has them; where they have no names, their numbers are names."""
    domain = build_domain(
        boxes({"lower": [1], "upper": [2]}, numbers=numbers), "cube", {"side": 1.0}, SELF
    )
    assert domain.regions == ({"11": 11, "12": 12} if numbers else {"lower": 11, "upper": 12})
    middle = domain.mesh.geometry.x[domain.mesh.geometry.dofmap].mean(axis=1)[:, 2]
    assert np.array_equal(domain.element_region == 12, middle > 1.0) and set(
        domain.element_region
    ) == {11, 12}


@pytest.mark.parametrize("groups, line", [
    ({"lower": [1]}, "volume 2 is in no physical group; a volume must be in one group"),
    ({"lower": [1, 2], "upper": [2]}, "volume 2 is in 'lower' and 'upper'; a volume must be in one group"),
    ({}, "0 named volumes, 1 types of elements, 1 named faces; must be at least 1, exactly 1 and at least 1"),
])  # fmt: skip
def test_volumes_that_are_not_shared_out_are_refused(
    groups: dict[str, list[int]], line: str
) -> None:
    with pytest.raises(GeometryError, match=f"^Gmsh could not mesh the cube: {line}$"):
        build_domain(boxes(groups), "cube", {"side": 1.0}, SELF)
