"""Quadrature points: integrals and means by volume."""

from __future__ import annotations

import dolfinx.mesh
import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx.fem.quadrature import Quadrature
from tests.parts import tube

AROUND, LENGTH, RADII = 8, 1.5, (1.0, 2.0, 3.0)


@pytest.fixture(scope="module")
def points() -> Quadrature:
    """Two layers of eight straight pieces: the inner points of an element stand for less volume than the outer ones."""
    domain = tube(RADII[0], RADII[2], LENGTH, divisions=(AROUND, 2, 1), comm=MPI.COMM_SELF)
    return Quadrature(domain.mesh, 1)


def distance(points: Quadrature) -> np.ndarray:
    """From the axis along the middle of the element, (elements, points)."""
    middle = points.coordinates[..., :2].mean(axis=1)
    return np.einsum(
        "epi,ei->ep", points.coordinates[..., :2], middle / np.linalg.norm(middle, axis=1)[:, None]
    )


def trapezoid(inner: float, outer: float) -> tuple[float, float]:
    """Volume of an element between two radii, and the mean distance in it: its sides lie at radius times cos(half)."""
    half = np.pi / AROUND
    a, b = inner * np.cos(half), outer * np.cos(half)
    return np.tan(half) * (b**2 - a**2) * LENGTH, 2 / 3 * (b**3 - a**3) / (b**2 - a**2)


def test_means_over_elements_are_by_volume(points: Quadrature) -> None:
    found = points.element_mean(distance(points))
    expected = sorted([trapezoid(1.0, 2.0)[1], trapezoid(2.0, 3.0)[1]] * AROUND)
    np.testing.assert_allclose(np.sort(found), expected, rtol=1e-13)
    together = points.element_mean(np.stack([distance(points), np.ones(points.shape)], axis=-1))
    np.testing.assert_allclose(together[:, 0], found, rtol=1e-14)
    np.testing.assert_allclose(together[:, 1], 1.0, rtol=1e-14)


def test_integral_and_mean_are_by_volume_over_all_elements_or_some(points: Quadrature) -> None:
    (small, near), (large, far) = trapezoid(1.0, 2.0), trapezoid(2.0, 3.0)
    values = distance(points)
    assert points.integral(np.ones(points.shape)) == pytest.approx(
        AROUND * (small + large), rel=1e-13
    )
    assert points.integral(values) == pytest.approx(
        AROUND * (small * near + large * far), rel=1e-13
    )
    assert points.mean(values) == pytest.approx(
        (small * near + large * far) / (small + large), rel=1e-13
    )
    inner = values.max(axis=1) < 2.0
    assert points.nanmean(values, inner) == pytest.approx(near, rel=1e-13)
    # elements of two sizes: not the mean of their means
    some = inner.copy()
    some[np.flatnonzero(~inner)[0]] = True
    expected = (AROUND * small * near + large * far) / (AROUND * small + large)
    assert points.nanmean(values, some) == pytest.approx(expected, rel=1e-13)
    assert points.maximum(values) == values.max() and points.minimum(values) == values.min()


def test_areas_are_volume_over_the_least_and_the_largest_extent() -> None:
    box = dolfinx.mesh.create_box(
        MPI.COMM_SELF,
        [[0.0, 0.0, 0.0], [4.0, 3.0, 6.0]],
        [2, 1, 1],
        dolfinx.mesh.CellType.hexahedron,
    )
    points = Quadrature(box, 1)
    np.testing.assert_allclose(points.largest_areas, [3.0 * 6.0] * 2, rtol=1e-14)
    np.testing.assert_allclose(points.smallest_areas, [2.0 * 3.0] * 2, rtol=1e-14)
    assert points.norm(np.array([3.0, 4.0])) == pytest.approx(5.0, rel=1e-15)
