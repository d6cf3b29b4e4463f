"""Columns of the history against closed forms, on deformations that are given instead of solved for."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx.body import SHAPES
from remodel_fenicsx.body.shape import columns_of
from remodel_fenicsx.model.cells import cylindrical_axes
from remodel_fenicsx.results.columns import Observer
from remodel_fenicsx.results.fields import ElementFields
from remodel_fenicsx.schema.settings import Cells
from tests import parts
from tests.parts import cube, tube

INNER, OUTER, LENGTH = 1.0, 3.0, 1.0


def observed(made: parts.Body, **size: float) -> Any:
    """The row of the present state, as a function."""
    made.supported()
    stepper = made.stepper(lambda t: {})
    observer = Observer(SHAPES[made.domain.shape](shape=made.domain.shape, **size), stepper)
    return lambda: stepper.start([observer]).row


@pytest.fixture(scope="module")
def wall() -> tuple[parts.Body, Any]:
    """A short tube of four layers."""
    size = {"inner_radius": INNER, "outer_radius": OUTER, "length": LENGTH}
    made = parts.body(
        tube(**size, divisions=(8, 4, 1), comm=MPI.COMM_SELF), Cells(initial="isotropic")
    )
    return made, observed(made, **size)


def test_radii_are_means_over_the_deformed_area(wall: tuple[parts.Body, Any]) -> None:
    """Faces become cones, wide where they are large: means over trapezoids. What is between the faces stays."""
    made, row = wall
    end = 1.1  # radii grow by this factor along the tube
    radius = np.hypot(made.nodes[:, 0], made.nodes[:, 1])
    on_a_face = np.isclose(radius, INNER) | np.isclose(radius, OUTER)
    growth = np.where(on_a_face, (end - 1) * made.nodes[:, 2] / LENGTH, 0.0)
    made.set_displacement(made.nodes * np.stack([growth, growth, 0 * growth], axis=1))
    mean = (end**3 - 1) / 3 / ((end**2 - 1) / 2)
    assert mean > 1.0005 * (1 + end) / 2  # the mean over the reference
    found = row()
    # measured at the nodes, which lie on the circles, and linear between them
    assert found["inner_radius"] == pytest.approx(INNER * mean, rel=1e-12)
    assert found["outer_radius"] == pytest.approx(OUTER * mean, rel=1e-12)


def test_layer_angles_are_those_of_the_elements_at_the_radius(wall: tuple[parts.Body, Any]) -> None:
    """A pitch for each layer of elements: the middle radius lies between the second and the third."""
    made, row = wall
    radius = np.hypot(
        *made.quadrature.coordinates[..., :2].mean(axis=1).T
    )  # of the elements' middles
    layer = np.argsort(np.argsort(radius)) // 8
    pitch = np.radians(np.array([10.0, 30.0, 60.0, 80.0]))[layer][:, None]
    cells = np.stack(np.broadcast_arrays(np.cos(pitch), np.sin(pitch), 0.0), axis=-1)
    made.set_displacement(np.zeros_like(made.nodes))
    axes = cylindrical_axes(made.quadrature.coordinates)
    made.cells.set(np.broadcast_to(cells, made.cells.dimension_values.shape), axes)
    found = row()
    assert found["fibre_angle_inner"] == pytest.approx(10.0, abs=1e-9)
    assert found["fibre_angle_outer"] == pytest.approx(80.0, abs=1e-9)
    # layers of the same thickness have volumes like their middle radii
    assert found["fibre_angle_middle"] == pytest.approx((1.75 * 30.0 + 2.25 * 60.0) / 4.0, abs=1e-9)


def test_chains_out_of_the_wall_have_no_angle(wall: tuple[parts.Body, Any]) -> None:
    """Layers of pitch 10, none, 60, none and shares of the radial direction: means are over the others, or empty."""
    made, _ = wall
    shape = SHAPES["tube"](shape="tube", inner_radius=INNER, outer_radius=OUTER, length=LENGTH)
    columns = columns_of(shape, ["radial_share"], made.loading.values)
    observer = Observer(shape, made.stepper(lambda t: {}), columns)
    radius = np.hypot(*made.quadrature.coordinates[..., :2].mean(axis=1).T)
    layer = np.argsort(np.argsort(radius)) // 8
    pitch = np.radians(np.array([10.0, 80.0, 60.0, 30.0]))[layer][:, None]
    radial = np.array([0.5, 1.0, 0.0, 1.0 - 1e-7])[layer][:, None]  # share of tr A
    cells = np.stack([np.cos(pitch), np.sin(pitch), np.sqrt(radial)], axis=-1)
    cells[..., :2] *= np.sqrt(1.0 - radial)[..., None]
    made.set_displacement(np.zeros_like(made.nodes))
    axes = cylindrical_axes(made.quadrature.coordinates)
    made.cells.set(np.broadcast_to(cells, made.cells.dimension_values.shape), axes)
    found = observer.stepper.start([observer]).row
    assert found["fibre_angle_inner"] == pytest.approx(10.0, abs=1e-9)
    assert found["fibre_angle_middle"] == pytest.approx(60.0, abs=1e-9)
    assert np.isnan(found["fibre_angle_outer"])
    assert found["radial_share"] == pytest.approx(
        (0.5 * 1.25 + 1.75 + (1 - 1e-7) * 2.75) / 8.0, abs=1e-9
    )
    for angles in ElementFields(
        shape, observer.stepper, ("fibre_angle", "fibre_angle_deformed")
    )().values():
        assert np.isnan(angles[(layer == 1) | (layer == 3)]).all()
        np.testing.assert_allclose(angles[layer == 2], 60.0, atol=1e-9)


def test_a_few_radial_chains_among_others_of_an_element(wall: tuple[parts.Body, Any]) -> None:
    """An element's field is the mean over its points that have an angle."""
    made, _ = wall
    values = np.full(made.quadrature.shape, 30.0)
    values[:, 0] = np.nan
    np.testing.assert_allclose(made.quadrature.element_nanmean(values), 30.0, rtol=1e-14)
    assert made.quadrature.nanmean(values) == pytest.approx(30.0, rel=1e-14)
    assert np.isnan(made.quadrature.nanmean(np.full_like(values, np.nan)))


def test_stretches_of_a_cube_that_is_pulled_more_on_one_side() -> None:
    """u_z = z (a + b y^) on two by two by two elements of side one."""
    made = parts.body(cube(2.0, refinement=2, comm=MPI.COMM_SELF), Cells(initial="isotropic"))
    row = observed(made, side=2.0)
    a, b = 0.1, 0.2
    made.set_displacement(made.nodes[:, 2:] * (a + b * made.nodes[:, 1:2]) * [0.0, 0.0, 1.0])
    found = row()
    assert found["mean_stretch"] == pytest.approx(1 + a + b, rel=1e-13)
    assert found["min_stretch"] == pytest.approx(1 + a + b / 2, rel=1e-13)
    assert found["max_stretch"] == pytest.approx(1 + a + 3 * b / 2, rel=1e-13)
    assert found["mean_fibre_angle"] == pytest.approx(np.degrees(np.arctan(np.sqrt(2))), rel=1e-13)


def test_random_cells_belong_to_the_elements_of_the_mesh_file() -> None:
    """dolfinx renumbers elements, the draws stay with them: so they do not depend on the number of ranks."""
    settings = Cells(initial="random", seed=7)
    domain = tube(INNER, OUTER, LENGTH, divisions=(8, 4, 1), comm=MPI.COMM_SELF)
    made = parts.body(domain, settings)
    assert not np.array_equal(domain.element_number, np.arange(domain.number_of_elements))
    first_points = domain.gather_elements(made.cells.initial_dimensions[:, 0])
    np.testing.assert_array_equal(first_points, settings.dimensions(domain.number_of_elements))
    assert np.all(np.ptp(made.cells.initial_dimensions, axis=1) == 0.0)  # one draw per element
