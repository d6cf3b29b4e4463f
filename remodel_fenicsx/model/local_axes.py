"""Local axes of a body: what is circumferential, axial and radial at its points, and how deep they lie."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.model.cells import by_component, cylindrical_axes, global_axes

Array = NDArray[np.float64]
Maker = Callable[[], Array]


class LocalAxes:
    """What a body knows of its points; its shape makes it once (`Shape.local_axes`).

    Parameters
    ----------
    coordinates
        Reference places of the points, (..., 3).
    axes, depth, station, nodal_depth
        Functions that make the attributes of these names; nothing is made that nobody asks for.
    thickness, undefined
        The attributes of these names, of axes that were found on a mesh (`body.local_axes`).

    Attributes
    ----------
    coordinates
        Reference places of the points, (..., 3).
    axes
        Circumferential, axial and radial unit vectors c, a, r as rows, (..., 3, 3); c x a = r.
    depth
        From 0 to 1 through the wall, or along a body without one, (...,).
    station
        Share of the length along the body, (...,).
    nodal_depth
        Depth of the local geometry nodes, ghosts included, (nodes,).
    thickness
        Of the wall at the points, (...,); None where the shape's keys say it.
    undefined
        Where the axes are those of the nearest point that has some, (...,); None where all have their own.

    Examples
    --------
    Those of a tube at one place, half through its wall:

    >>> import numpy as np
    >>> from remodel_fenicsx import parts
    >>> from remodel_fenicsx.extend import LocalAxes
    >>> tube = parts.Tube(inner_radius=1.0, outer_radius=3.0, length=8.0)
    >>> places = np.array([[2.0, 0.0, 4.0]])
    >>> local = LocalAxes(places, axes=lambda: tube.axes_at(places), depth=lambda: tube.depth(places),
    ...                   station=lambda: tube.station(places), nodal_depth=lambda: None)
    >>> local.axes[0]  # circumferential, axial, radial
    array([[-0.,  1.,  0.],
           [ 0.,  0.,  1.],
           [ 1.,  0.,  0.]])
    >>> local.depth, local.station
    (array([0.5]), array([0.5]))
    """

    def __init__(
        self,
        coordinates: Array,
        axes: Maker,
        depth: Maker,
        station: Maker,
        nodal_depth: Maker,
        thickness: Array | None = None,
        undefined: NDArray[np.bool_] | None = None,
    ):
        self.coordinates, self.thickness, self.undefined = coordinates, thickness, undefined
        self._axes, self._depth, self._station, self._nodal_depth = axes, depth, station, nodal_depth

    @cached_property
    def axes(self) -> Array:
        """Rows c, a, r, (..., 3, 3)."""
        return self._axes()

    @cached_property
    def depth(self) -> Array:
        """Of the points, (...,)."""
        return self._depth()

    @cached_property
    def station(self) -> Array:
        """Of the points, (...,)."""
        return self._station()

    @cached_property
    def nodal_depth(self) -> Array:
        """Of the local geometry nodes, (nodes,)."""
        return self._nodal_depth()

    def deformed(self, deformation_gradient: Array) -> Array:
        """The axes in the deformed body: rows c', a', r', (..., 3, 3), with F (..., 3, 3).

        ``c' = F c / |F c|`` follows a material line. ``r' = F^-T r / |F^-T r|`` stays normal to a material surface,
        and is taken as F c x F a, which needs no inverse. a' = r' x c' lies in that surface, square to c'.

        Parameters
        ----------
        deformation_gradient
            F at the points, (..., 3, 3).
        """
        F, axes = by_component(deformation_gradient), by_component(self.axes)
        circumferential, axial = (
            [F[i, 0] * axes[k, 0] + F[i, 1] * axes[k, 1] + F[i, 2] * axes[k, 2] for i in range(3)] for k in (0, 1)
        )
        radial = _unit(_cross(circumferential, axial))
        circumferential = _unit(circumferential)
        rows = [circumferential, _cross(radial, circumferential), radial]
        return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def _cross(one: list[Array], other: list[Array]) -> list[Array]:
    """Of vectors by component."""
    return [one[j] * other[k] - one[k] * other[j] for j, k in ((1, 2), (2, 0), (0, 1))]


def _unit(vector: list[Array]) -> list[Array]:
    length = np.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    return [component / length for component in vector]


AXES: dict[str, Callable[[LocalAxes], Array]] = {
    "global": lambda points: global_axes(points.coordinates),
    "cylindrical": lambda points: cylindrical_axes(points.coordinates),
    "local": lambda points: points.axes,
}
"""Axes of the cells before the first pass by name: functions of a `LocalAxes`."""
