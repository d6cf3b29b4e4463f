"""Local axes, depth and station at the points of any body, from the fields of `axis_fields`."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
import ufl
from numpy.typing import NDArray

from remodel_fenicsx.body.axis_fields import axis_fields
from remodel_fenicsx.body.domain import Domain
from remodel_fenicsx.fem import jit
from remodel_fenicsx.fem.assembly import of_all_ranks
from remodel_fenicsx.fem.compat import geometry_dofmap
from remodel_fenicsx.fem.positive import SolveStopped
from remodel_fenicsx.fem.quadrature import Quadrature
from remodel_fenicsx.model.local_axes import LocalAxes
from remodel_fenicsx.schema.tables import SceneError

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

LEAST_RADIAL = 0.2  # length of the mean of unit gradients: below, they point all ways
LEAST_TANGENT = 0.1  # share of the axial field that lies in the wall: below, it runs through the wall
# of the volume: 13 forks, coarse and fine, with one element through the wall or two, had 0.03 % at most, in the crotch;
# with half of the outer face named inner it was 0.7 % (a thick wall, fine) to 43 % (one element)
MOST_UNDEFINED = 0.01
AT_ONCE = 1_000_000  # distances that are compared at a time


class UndefinedAxes(SceneError):
    """More of the body than a few points has no local axes."""


def found_axes(
    domain: Domain, quadrature: Quadrature, inlets: Sequence[str] = ("inlet",), outlets: Sequence[str] = ("outlet",)
) -> LocalAxes:
    """Local axes of a mesh with faces "inner" and "outer", and ends. Collective.

    Raises
    ------
    UndefinedAxes
        If a face is missing, if more than MOST_UNDEFINED of the volume has none, or if a linear solve stops; one line.
    """
    missing = [face for face in ("inner", "outer", *inlets, *outlets) if face not in domain.faces]
    if missing:
        raise UndefinedAxes(f"geometry.faces: the local axes of a wall need a face {', '.join(map(repr, missing))}")
    try:
        fields = axis_fields(domain, quadrature, inlets, outlets)
    except SolveStopped as stopped:
        raise UndefinedAxes(f"geometry.faces: the local axes were not found: {stopped}") from stopped
    lengths = (fields.from_inner, fields.from_outer, fields.from_inlet, fields.from_outlet)
    values = _at_points([*fields.radial, *fields.axial, *lengths], quadrature)
    axes, known = _axes(values[..., :3], values[..., 3:6])
    share = quadrature.mean((~known).astype(np.float64))
    if share > 0:
        x, y, z = _first_place(quadrature, ~known)
        words = f"undefined in {100 * share:.2g} % of the wall, first at ({x:.4g}, {y:.4g}, {z:.4g})"
        if share > MOST_UNDEFINED:
            raise UndefinedAxes(
                f"geometry.faces: the local axes are {words}; allowed is {100 * MOST_UNDEFINED:g} %. Is there an outer "
                "face across the wall from the inner one?"
            )
        if domain.comm.rank == 0:
            log.info("the local axes are %s; those of the nearest point are used there", words)
        _fill(axes, known, quadrature)
    depth, station = (_share(values[..., k], values[..., k + 1]) for k in (6, 8))
    nodal = _share(*(_at_nodes(length) for length in (fields.from_inner, fields.from_outer)))
    makers = (lambda: axes), (lambda: depth), (lambda: station), (lambda: nodal)
    return LocalAxes(quadrature.coordinates, *makers, values[..., 6] + values[..., 7], ~known)


def _axes(radial: Array, axial: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Rows c, a, r from vectors of any length, and where they are defined."""
    length, along = np.linalg.norm(radial, axis=-1), np.linalg.norm(axial, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):  # what is undefined is filled afterwards
        r = radial / length[..., None]
        tangent = axial - np.sum(axial * r, axis=-1)[..., None] * r
        size = np.linalg.norm(tangent, axis=-1)
        a = tangent / size[..., None]
    known: NDArray[np.bool_] = (length > LEAST_RADIAL) & (size > LEAST_TANGENT * along)
    return np.stack([np.cross(a, r), a, r], axis=-2), known


def _share(first: Array, second: Array) -> Array:
    """first / (first + second) between 0 and 1; lengths of a few points are below zero by their error."""
    low, high = np.maximum(first, 0.0), np.maximum(second, 0.0)
    total = low + high
    return np.divide(low, total, out=np.full_like(total, 0.5), where=total > 0)


def _at_points(fields: Sequence[Any], quadrature: Quadrature) -> Array:
    compiled = jit.expression(ufl.as_vector(fields), quadrature.points)
    return quadrature.evaluate(compiled, (len(fields),))


def _at_nodes(function: Any) -> Array:
    """Of a scalar of the mesh's degree, by local geometry node: node k of an element is dof k of it."""
    space = function.function_space
    found = np.zeros(len(space.mesh.geometry.x))
    found[geometry_dofmap(space.mesh).reshape(-1)] = np.real(function.x.array[space.dofmap.list.reshape(-1)])
    return found


def _first_place(quadrature: Quadrature, there: NDArray[np.bool_]) -> Array:
    """The first marked place in space, whatever the number of ranks."""
    marked = quadrature.owned(quadrature.coordinates)[quadrature.owned(there)]
    places = [place for part in of_all_ranks(quadrature.mesh.comm, marked) for place in part]
    first: Array = min(places, key=lambda place: np.round(place, 9).tolist())
    return first


def _fill(axes: Array, known: NDArray[np.bool_], quadrature: Quadrature) -> None:
    """Give points without axes those of the nearest one that has some. Collective."""
    comm, wanted = quadrature.mesh.comm, quadrature.coordinates[~known]
    asked = of_all_ranks(comm, wanted)
    good = quadrature.owned(known)
    places, candidates = quadrature.owned(quadrature.coordinates)[good], quadrature.owned(axes)[good]
    answers = []
    for part in asked:
        index, distance = _nearest(part, places)
        answers.append((distance, candidates[index] if len(candidates) else np.zeros((len(part), 3, 3))))
    mine = [answers] if comm.size == 1 else comm.alltoall([[answer] for answer in answers])
    distances = np.stack([answer[0][0] for answer in mine])
    choices = np.stack([answer[0][1] for answer in mine])
    axes[~known] = choices[distances.argmin(axis=0), np.arange(len(wanted))]


def _nearest(places: Array, candidates: Array) -> tuple[NDArray[np.int64], Array]:
    """Number of the candidate (m, 3) nearest to each place (n, 3), and its distance; infinite where there is none."""
    index, least = np.zeros(len(places), dtype=np.int64), np.full(len(places), np.inf)
    rows = max(1, AT_ONCE // max(1, len(candidates)))
    for start in range(0, len(places) if len(candidates) else 0, rows):
        distances = np.linalg.norm(places[start : start + rows, None] - candidates, axis=-1)
        index[start : start + rows], least[start : start + rows] = distances.argmin(axis=1), distances.min(axis=1)
    return index, least
