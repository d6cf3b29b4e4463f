"""Directions in a body: local axes and depths at points, and unit cells from measured fibres."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property

import numpy as np

from remodel_fenicsx.model.cells import components_first, cylindrical_axes, global_axes
from remodel_fenicsx.model.spectral import principal
from remodel_fenicsx.model.tensors import Array, Flags

Maker = Callable[[], Array]

# name of a measured quantity: allowed numbers of columns
NATURAL_GRADIENT = "natural_gradient"
GROWTH = "growth"  # J_g
MEASURED = {
    "structure_tensor": (9, 6),
    "fibre": (3,),
    "angle": (1,),
    "fibre_2": (3,),
    "weight": (1,),
}
# These need one of SOURCES.
MEASURED |= {NATURAL_GRADIENT: (9,), "content": (1,), "natural_length": (1,), GROWTH: (1,)}
FIBRE_INPUTS = ("structure_tensor", "fibre", "angle")  # exactly one is needed
# Row-major tensor from xx, yy, zz, xy, yz, xz (VTK's order).
VTK_TO_FULL = np.array([0, 3, 5, 3, 1, 4, 5, 4, 2])
# Smallest negative eigenvalue over the trace that counts as rounding of a file with 7 digits.
FILE_ROUNDING = 1e-6


# ---------------------------------------------------------------- local axes of a body
# Circumferential, axial and radial direction at the points of a body, and the depth of the points.


class LocalAxes:
    """Local axes and depths at points of a body; the shape makes them once (`Shape.local_axes`).

    Parameters
    ----------
    coordinates
        Reference positions of the points, (..., 3).
    axes, depth, station, nodal_depth
        Functions that compute the attributes of these names on first access.
    thickness, undefined
        The attributes of these names, for axes computed on a mesh (`body.local_axes`).

    Attributes
    ----------
    coordinates
        Reference positions of the points, (..., 3).
    axes
        Circumferential, axial and radial unit vectors c, a, r as rows, (..., 3, 3); c x a = r.
    depth
        Normalised depth from 0 to 1 through the wall, or along a body without a wall, (...,).
    station
        Position along the body as a fraction of its length, (...,).
    nodal_depth
        Depth of the local geometry nodes, ghosts included, (nodes,).
    thickness
        Thickness of the wall at the points, (...,); None if the shape's keys give it.
    undefined
        Points whose axes are copied from the nearest point with defined axes, (...,); None if all
        points have defined axes.

    Examples
    --------
    Local axes of a tube at one point at mid-wall:

    >>> import numpy as np
    >>> from remodel_fenicsx import parts
    >>> from remodel_fenicsx.extend import LocalAxes
    >>> tube = parts.Tube(inner_radius=1.0, outer_radius=3.0, length=8.0)
    >>> points = np.array([[2.0, 0.0, 4.0]])
    >>> local = LocalAxes(points, axes=lambda: tube.axes_at(points),
    ...                   depth=lambda: tube.depth(points), station=lambda: tube.station(points),
    ...                   nodal_depth=lambda: None)
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
        undefined: Flags | None = None,
    ):
        self.coordinates = coordinates
        self.thickness, self.undefined = thickness, undefined
        self._axes, self._depth = axes, depth
        self._station, self._nodal_depth = station, nodal_depth

    @cached_property
    def axes(self) -> Array:
        """Unit vectors c, a, r as rows, (..., 3, 3)."""
        return self._axes()

    @cached_property
    def depth(self) -> Array:
        """Normalised depth of the points, (...,)."""
        return self._depth()

    @cached_property
    def station(self) -> Array:
        """Normalised position along the body, (...,)."""
        return self._station()

    @cached_property
    def nodal_depth(self) -> Array:
        """Normalised depth of the local geometry nodes, ghosts included, (nodes,)."""
        return self._nodal_depth()

    def deformed(self, deformation_gradient: Array) -> Array:
        """Return the axes in the deformed configuration: rows c', a', r', (..., 3, 3).

        ``c' = F c / |F c|`` follows a material line. ``r' = F^-T r / |F^-T r|`` stays normal to a
        material surface. It is computed as F c x F a, which needs no inverse. a' = r' x c' lies in
        that surface, orthogonal to c'.

        Parameters
        ----------
        deformation_gradient
            F at the points, (..., 3, 3).
        """
        return push_forward_axes(self.axes, deformation_gradient)


def push_forward_axes(axes: Array, deformation_gradient: Array) -> Array:
    """Return deformed axes, rows (..., 3, 3), from reference axes; see `LocalAxes.deformed`."""
    F, rows = components_first(deformation_gradient), components_first(axes)
    circumferential, axial = (
        [F[i, 0] * rows[k, 0] + F[i, 1] * rows[k, 1] + F[i, 2] * rows[k, 2] for i in range(3)]
        for k in (0, 1)
    )
    radial = _unit(_cross(circumferential, axial))
    circumferential = _unit(circumferential)
    deformed = [circumferential, _cross(radial, circumferential), radial]
    return np.moveaxis(np.array(deformed), (0, 1), (-2, -1))


def _cross(first: list[Array], second: list[Array]) -> list[Array]:
    """Return the cross product of two vectors by component."""
    return [first[j] * second[k] - first[k] * second[j] for j, k in ((1, 2), (2, 0), (0, 1))]


def _unit(vector: list[Array]) -> list[Array]:
    length = np.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    return [component / length for component in vector]


AXES: dict[str, Callable[[LocalAxes], Array]] = {
    "global": lambda points: global_axes(points.coordinates),
    "cylindrical": lambda points: cylindrical_axes(points.coordinates),
    "local": lambda points: points.axes,
}
"""Initial axes of the cells by name: functions of a `LocalAxes`."""


# ---------------------------------------------------------------- unit cells from measured fibres
# The measurements are structure tensors, fibre directions or fibre angles.


def fibres_problem(measured: Mapping[str, Array]) -> str | None:
    """Return the first error in measured fibres, (n, columns) by name of `MEASURED`, or None."""
    sources = [name for name in FIBRE_INPUTS if name in measured]
    if len(sources) != 1:
        given = " and ".join(sources) or "none"
        return f"has {given} of {', '.join(FIBRE_INPUTS)}; exactly one is needed"
    for name, values in measured.items():
        if values.shape[1] not in MEASURED[name]:
            numbers = " or ".join(map(str, MEASURED[name]))
            return f"{name} has {values.shape[1]} numbers in a row; must be {numbers}"
        if not (valid := np.isfinite(values).all(axis=1)).all():
            return _row(name, valid, "is not finite")
    (source,) = sources
    for name, allowed in (("fibre_2", ("fibre",)), ("weight", ("fibre", "angle"))):
        if name in measured and source not in allowed:
            return f"has {name} with {source}; it belongs to {' or '.join(allowed)}"
    for name in ("fibre", "fibre_2"):
        if name in measured and not (valid := (measured[name] != 0).any(axis=1)).all():
            return _row(name, valid, "is the zero vector")
    weight = measured.get("weight", np.zeros((1, 1)))[:, 0]
    if not (valid := (weight >= 0) & (weight <= 1)).all():
        return _row("weight", valid, "is not from 0 to 1")
    for name in ("content", "natural_length", GROWTH):
        if name in measured and not (valid := measured[name][:, 0] > 0).all():
            return _row(name, valid, "is not above 0")
    if NATURAL_GRADIENT in measured:
        if not (valid := np.linalg.det(measured[NATURAL_GRADIENT].reshape(-1, 3, 3)) > 0).all():
            return _row(NATURAL_GRADIENT, valid, "has no determinant above 0")
    if source == "structure_tensor":
        eigenvalues = np.linalg.eigvalsh(_tensors(measured[source]))
        trace = eigenvalues.sum(axis=1)
        if not (valid := (trace > 0) & (eigenvalues[:, 0] >= -FILE_ROUNDING * trace)).all():
            first = ", ".join(f"{value:.3g}" for value in eigenvalues[~valid][0])
            rule = "none may be below 0, nor all be 0"
            return _row(source, valid, f"has eigenvalues {first}; {rule}")
    return None


def _row(name: str, valid: Flags | np.bool_, problem: str) -> str:
    return f"{name} of row {int(np.argmin(valid)) + 1} {problem}"


def structure_tensors(measured: Mapping[str, Array], axes: Array) -> Array:
    """Return unscaled structure tensors at points, (..., 3, 3); `cells_of` scales them."""
    if "structure_tensor" in measured:
        return _tensors(measured["structure_tensor"])
    if "angle" in measured:
        angle = np.radians(measured["angle"])
        first = np.cos(angle) * axes[..., 0, :] + np.sin(angle) * axes[..., 1, :]
    else:
        first = measured["fibre"]
    remainder = _along(measured["fibre_2"]) if "fibre_2" in measured else np.eye(3) / 3
    default_weight = np.full((*first.shape[:-1], 1), 0.5 if "fibre_2" in measured else 1.0)
    weight = measured.get("weight", default_weight)[..., None]
    return weight * _along(first) + (1 - weight) * remainder


def cells_from_tensors(
    tensors: Array, end_to_end_length: float, previous: Array
) -> tuple[Array, Array]:
    """Return l_I (..., 3), longest first, and n_I as rows (..., 3, 3) with A = r0^2 T / tr T."""
    # Equal eigenvalues of T leave axes undetermined; these are then taken from `previous`,
    # (..., 3, 3).
    shape = tensors.shape[:-2]
    values, axes = principal(tensors.reshape(-1, 3, 3), previous.reshape(-1, 3, 3))
    values = np.maximum(values, 0.0)
    lengths = end_to_end_length * np.sqrt(values / values.sum(axis=1, keepdims=True))
    return lengths.reshape(*shape, 3), axes.reshape(*shape, 3, 3)


def _tensors(rows: Array) -> Array:
    """Return symmetric tensors (..., 3, 3) from rows of 9 or 6 numbers."""
    full = rows if rows.shape[-1] == 9 else rows[..., VTK_TO_FULL]
    tensors = full.reshape(*rows.shape[:-1], 3, 3)
    return (tensors + np.swapaxes(tensors, -1, -2)) / 2


def _along(vectors: Array) -> Array:
    unit = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return unit[..., :, None] * unit[..., None, :]
