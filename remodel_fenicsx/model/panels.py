"""Functions of the radius on panels: values at Chebyshev points, with derivative and integral.

A panel is a layer or a part of one: within it a function is smooth, from one to the next its derivative may jump.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Panels:
    """Chebyshev points of one or more panels, and what is done with values there.

    Parameters
    ----------
    edges
        Radii at which the panels begin and end, one more than panels.
    degree
        Of the polynomials.

    Attributes
    ----------
    places
        Radii of the points, (panels, degree + 1), increasing; neighbours share their edge.
    """

    def __init__(self, edges: Sequence[float], degree: int):
        self.edges, self.degree = np.asarray(edges, dtype=np.float64), degree
        self._points = points = np.cos(np.pi * np.arange(degree, -1, -1) / degree)
        self._half = np.diff(self.edges)[:, None] / 2
        self.places: Array = self.edges[:-1, None] + self._half * (points + 1)
        self.places[:, -1] = self.edges[1:]
        self._coefficients = np.linalg.inv(chebyshev.chebvander(points, degree))
        ones = np.eye(degree + 1)
        slopes = np.stack([chebyshev.chebval(points, chebyshev.chebder(one)) for one in ones], axis=-1)
        self._slope: Array = slopes @ self._coefficients
        areas = np.array([chebyshev.chebval(1.0, chebyshev.chebint(one, lbnd=-1)) for one in ones])
        self._weights: Array = areas @ self._coefficients

    def derivative(self, values: Array) -> Array:
        """By the radius, of values (panels, points)."""
        found: Array = values @ self._slope.T / self._half
        return found

    def integral(self, values: Array) -> float:
        """Over all panels."""
        return float(np.sum(values * self._weights * self._half))

    def jumps(self, values: Array) -> Array:
        """From one panel to the next, (panels - 1,)."""
        return values[1:, 0] - values[:-1, -1]

    def of(self, radius: Array) -> NDArray[np.intp]:
        """Number of the panel of each radius (...,); what is outside belongs to the nearest."""
        return np.clip(np.searchsorted(self.edges, radius, side="right") - 1, 0, len(self.edges) - 2)

    def missing(self, values: Array) -> Array:
        """About what the polynomials leave out of values (panels, points), as shares of the largest; (panels,)."""
        found: Array = np.abs(values @ self._coefficients.T)
        return found[:, -2:].max(axis=1) / found.max()

    def at(self, radius: Array, values: Array) -> Array:
        """Of values (panels, points), at radii (...,)."""
        panel = self.of(radius)
        share = (radius - self.edges[panel]) / (2 * self._half[panel, 0]) * 2 - 1
        found = np.empty_like(radius, dtype=np.float64)
        for number, row in enumerate(values @ self._coefficients.T):
            found[panel == number] = chebyshev.chebval(share[panel == number], row)
        return found
