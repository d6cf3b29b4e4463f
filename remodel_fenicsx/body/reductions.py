"""Which kinematics a scene allows: rules with reasons, and the cheapest kinematics that none of them objects to.

A rule is a function of a scene that returns why a reduced kinematics would be wrong for it, or None. Every shape names
its own (`Shape.reductions`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TYPE_CHECKING

import numpy as np

from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.fem.solver_methods import AUTO
from remodel_fenicsx.model.cells import cylindrical_axes
from remodel_fenicsx.model.drivers import DRIVERS
from remodel_fenicsx.model.laws import LAWS
from remodel_fenicsx.model.tensors import Array, Integers
from remodel_fenicsx.schema.settings import (
    LARGEST_MESH,
    Cells,
    Load,
    Mesh,
    Model,
    Properties,
    Region,
    Remodeling,
    Solver,
    Supports,
)

if TYPE_CHECKING:
    from mpi4py import MPI

    from remodel_fenicsx.body.domain import Domain


# ---------------------------------------------------------------- whole bodies for pictures
# Whole bodies for pictures, from the meshes of reductions: extended, revolved or mirrored.
#  Meshes are points (n, 3) and the corners of the elements (m, 2, 4 or 8) in VTK's order.

Body = tuple[Array, Integers]

ROUND, LONG = 16, 12  # elements around and along, the paper's of its artery


def _swept(levels: Array, elements: Integers) -> Body:
    """Elements of one more dimension between the same mesh at places (levels, nodes, 3)."""
    near = np.arange(len(levels) - 1)[:, None, None] * levels.shape[1] + elements
    far = near + levels.shape[1]
    found = np.concatenate([near, far[..., ::-1] if elements.shape[1] == 2 else far], axis=-1)
    return _shared(levels.reshape(-1, 3), found.reshape(-1, 2 * elements.shape[1]))


def _between(low: Array, high: Array) -> Array:
    """Places of a mesh at `LONG` + 1 levels, (levels, nodes, 3)."""
    share = np.linspace(0.0, 1.0, LONG + 1)[:, None, None]
    return (1.0 - share) * low + share * high


def extended(points: Array, lines: Integers, length: float) -> Body:
    """Quadrilaterals of lines across z, from z = 0 to the length."""
    low = points * [1.0, 1.0, 0.0]
    return _swept(_between(low, low + [0.0, 0.0, length]), lines)


def revolved(points: Array, quadrilaterals: Integers) -> Body:
    """Hexahedra around the z axis of quadrilaterals in the half-plane y = 0, x before z."""
    angles = -2 * np.pi * np.arange(ROUND + 1)[:, None] / ROUND  # the volumes of VTK's hexahedra are positive
    radii, z = points[:, 0], np.broadcast_to(points[:, 2], (ROUND + 1, len(points)))
    return _swept(np.stack([radii * np.cos(angles), radii * np.sin(angles), z], axis=-1), quadrilaterals)


_MIRRORED = {8: (0, 3, 2, 1, 4, 7, 6, 5), 4: (0, 2, 1, 3)}  # order of the corners of a mirror image


def mirrored_twice(points: Array, elements: Integers) -> Body:
    """The quarter x > 0, y > 0 and its images in the planes x = 0 and y = 0; nodes on the planes are shared."""
    signs = np.array([(1.0, 1.0, 1.0), (-1.0, 1.0, 1.0), (-1.0, -1.0, 1.0), (1.0, -1.0, 1.0)])
    ways = elements, elements[:, _MIRRORED[elements.shape[1]]]  # so that all volumes are positive
    every = [ways[number % 2] + number * len(points) for number in range(4)]
    return _shared((signs[:, None] * points).reshape(-1, 3), np.concatenate(every))


def _shared(points: Array, elements: Integers) -> Body:
    """Nodes at one place become one."""
    places = np.rint(points / (1e-7 * np.abs(points).max())).astype(np.int64)
    _, first, number = np.unique(places, axis=0, return_index=True, return_inverse=True)
    return points[first], np.ravel(number)[elements]


def divided_along(points: Array, hexahedra: Integers) -> Body:
    """One layer of hexahedra from a bottom to a top face across z, in `LONG` layers."""
    low, high = (points[hexahedra[:, side].ravel()] for side in (slice(4), slice(4, 8)))
    return _swept(_between(low, high), np.arange(len(low)).reshape(-1, 4))


def box(*sides: float) -> Body:
    """A block from the origin along x, y and z, one element."""
    section = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    points = np.array([(*place, z) for z in (0.0, 1.0) for place in section])
    return points * sides, np.arange(8)[None]


def cylinder(radius: float, length: float) -> Body:
    """About z, from z = 0 to the length: wedges, as hexahedra with one edge on the axis."""
    return revolved(*extended(np.array([(0.0, 0.0, 0.0), (radius, 0.0, 0.0)]), np.array([[0, 1]]), length))


# ---------------------------------------------------------------- what of a body buckles


@dataclass(frozen=True)
class Strut:
    """A body along z that thrust may bend."""

    length: float
    end_factor: float
    directions: Callable[[Array], Array]
    squared_distances: Callable[[Array], Array]
    inner_radius: float | None = None


class ReducedScene(Protocol):
    """What reductions ask of a scene."""

    geometry: Any
    mesh: Mesh
    model: Model
    cells: Cells
    supports: Supports
    regions: dict[str, Region]
    loads: dict[str, Load]
    remodeling: Remodeling
    solver: Solver

    @property
    def has_random_cells(self) -> bool: ...
    @property
    def measured_cells(self) -> dict[str, Cells]: ...

    def each_case(self) -> Sequence[ReducedScene]: ...
    def properties(self) -> dict[str, Properties]: ...


Rule = Callable[[ReducedScene], str | None]
Turn = Callable[[Array], Array]
POINTS = {
    ("interval", 1): 2, ("interval", 2): 3, ("quadrilateral", 1): 4, ("quadrilateral", 2): 9,
    ("hexahedron", 1): 8, ("hexahedron", 2): 27, ("tetrahedron", 1): 1, ("tetrahedron", 2): 4,
}  # fmt: skip
POINTS_OF_THE_REST = 60.0  # what a step costs whatever the mesh, in quadrature points of hexahedra


@dataclass(frozen=True)
class Reduction:
    """A kinematics that is exact for some scenes of a shape.

    Attributes
    ----------
    build
        The mesh, from the scene and the communicator.
    elements
        How many elements it has, from the scene.
    rules
        Why it may be wrong.
    turn
        Q (n, 3, 3) for places X (n, 3) of the body: Q^T X lies in, or beside, the part that stands for it.
    whole
        Function of the shape and of the places (nodes, 3) and corners of the reduction's mesh: the whole body for
        reports (`body.whole`); None: they show none.
    in_the_mean
        Why it is right only for means over many seeds, as rules say it: then it is taken where a scene names it, and
        `auto` leaves it.

    Examples
    --------
    Those of the tube, the cheapest first:

    >>> from remodel_fenicsx.parts import Tube
    >>> {name: len(reduction.rules) for name, reduction in Tube.reductions.items()}
    {'radial': 6, 'axisymmetric': 4, 'sector': 5}
    """

    build: Callable[[ReducedScene, MPI.Intracomm | None], Domain]
    elements: Callable[[ReducedScene], int]
    rules: tuple[Rule, ...]
    turn: Turn
    whole: Callable[[Any, Array, Integers], Body] | None = None
    in_the_mean: tuple[Rule, ...] = ()


@dataclass(frozen=True)
class Choice:
    """A kinematics for a scene."""

    name: str
    objections: dict[str, list[str]]


def choice(scene: ReducedScene) -> Choice:
    """The scene's kinematics, or the cheapest that it allows where it leaves the choice."""
    # Under loads that press it chooses none that is reduced: what buckles leaves the symmetry.
    reductions = scene.geometry.reductions  # the cheapest first
    found = {name: objections(scene, name) for name in reductions}
    if scene.model.kinematics != AUTO:
        return Choice(scene.model.kinematics, found)
    if threats(scene):
        return Choice("full", found)
    exact = (name for name, reasons in found.items() if not reasons and not is_for_means(scene, name))
    return Choice(next(exact, "full"), found)


def objections(scene: ReducedScene, name: str) -> list[str]:
    """Why a kinematics would be wrong for a scene; nothing if it is right."""
    if not KINEMATICS[name].reduced:
        return []
    shape = scene.geometry
    if name not in shape.reductions:
        known = " or ".join(map(repr, shape.reductions)) or "none"
        return [f"a {shape.name} has no such reduction; it has {known}"]
    reasons = _reasons(shape.reductions[name].rules, scene)
    if scene.solver.unstable == "stop":
        reasons.append("solver.unstable = 'stop' needs the modes of the whole body")
    return reasons


def _reasons(rules: Sequence[Rule], scene: ReducedScene) -> list[str]:
    return [reason for rule in rules if (reason := rule(scene)) is not None]


def is_for_means(scene: ReducedScene, name: str) -> bool:
    """Whether a kinematics, where it is allowed, is right for means over many seeds alone."""
    reductions = scene.geometry.reductions
    return name in reductions and bool(_reasons(reductions[name].in_the_mean, scene))


def only_for_means(scene: ReducedScene) -> list[str]:
    """Why the scene's own kinematics is right for means over many seeds alone, in words; nothing where it is exact."""
    name, reductions = scene.model.kinematics, scene.geometry.reductions
    reasons = _reasons(reductions[name].in_the_mean, scene) if name in reductions else []
    return [f"{name!r}: {reason}" for reason in reasons]


def for_means(scene: ReducedScene) -> str:
    """The cheapest kinematics with the body's means over many seeds of random cells; `auto` where there is none."""
    if threats(scene):
        return AUTO
    found = (name for name in scene.geometry.reductions if is_for_means(scene, name) and not objections(scene, name))
    return next(found, AUTO)


def explained(scene: ReducedScene) -> list[str]:
    """The choice in words: why nothing cheaper, what it cannot show."""
    made = choice(scene)
    lines = [f"kinematics {made.name!r}: {KINEMATICS[made.name].meaning}"]
    for name, reasons in made.objections.items():
        if name != made.name:
            means = " for means over seeds" if is_for_means(scene, name) else ""
            verdict = f"not allowed: {'; '.join(reasons)}" if reasons else f"allowed{means}"
            lines.append(f"{name!r}, {verdict}")
    lines += only_for_means(scene)
    if KINEMATICS[made.name].reduced and (swinging := _leaves_symmetry(scene)):
        lines.append(
            f"{made.name!r} is the symmetric solution; with {swinging} the full body leaves it after a while, because "
            "the pass over-corrects (docs/theory.md, Stability of the pass)"
        )
    cannot = ", which this one cannot show" if KINEMATICS[made.name].reduced else ""
    return [
        *lines,
        *(f"{threat}: the body may buckle out of the symmetry of a reduction{cannot}" for threat in threats(scene)),
    ]


def threats(scene: ReducedScene) -> list[str]:
    """What may make a body buckle, in words: loads below zero (compression, suction)."""
    if not scene.geometry.reductions or not scene.geometry.buckles:
        return []
    smallest = [
        (name, min(load.value * factor for _, factor in load.ramp))
        for case in scene.each_case()
        for name, load in case.loads.items()
    ]
    pressing = dict.fromkeys(f"loads.{name}" for name, value in smallest if value < 0)
    return [f"{' and '.join(pressing)} press"] if pressing else []


def elements(scene: ReducedScene, name: str) -> int:
    """How many hexahedra, or elements of fewer dimensions, a kinematics has."""
    if KINEMATICS[name].reduced:
        return scene.geometry.reductions[name].elements(scene)
    return scene.geometry.number_of_elements * scene.mesh.refinement**3


def too_many_elements(scene: ReducedScene) -> str:
    """What is allowed where a body, or the part that stands for it, has too many elements; nothing elsewhere."""
    name, refinement = choice(scene).name, scene.mesh.refinement
    if (number := elements(scene, name)) <= LARGEST_MESH:
        return ""
    dimension = {"interval": 1, "quadrilateral": 2}.get(KINEMATICS[name].element(scene.mesh.element), 3)
    largest = math.floor(math.exp(math.log(refinement) - (math.log(number) - math.log(LARGEST_MESH)) / dimension))
    return f"must be at most {largest} for a {scene.geometry.name}: more makes over {LARGEST_MESH:g} elements"


def step_cost(scene: ReducedScene, name: str) -> float:
    """Of a step, in that of one point of a hexahedron; a rough figure from the number of quadrature points."""
    kinematics, mesh = KINEMATICS[name], scene.mesh
    element, number = kinematics.element(mesh.element), elements(scene, name)
    if element == "tetrahedron":
        number *= 6
    return POINTS_OF_THE_REST + kinematics.cost * number * POINTS[element, mesh.degree]


def _leaves_symmetry(scene: ReducedScene) -> str:
    """What of a scene makes the full body leave the symmetric solution, in words."""
    remodeling = scene.remodeling
    if remodeling.coupling != "staggered" or scene.geometry.axis_kinds == ("global",):
        return ""
    if DRIVERS[remodeling.driver].over_corrects and LAWS[remodeling.law].remodels:
        return f"remodeling.driver = {remodeling.driver!r}"
    return f"remodeling.law = {remodeling.law!r}" if LAWS[remodeling.law].over_corrects else ""


# ---------------------------------------------------------------- where the body's places are in the reduction
def about_z(places: Array) -> Array:
    """x, y, z become the radial, circumferential and axial direction."""
    circumferential, axial, radial = np.moveaxis(cylindrical_axes(places), -2, 0)
    return np.stack([radial, circumferential, axial], axis=-1)


def mirrored(places: Array) -> Array:
    """The quarter x > 0, y > 0 becomes each of the four."""
    signs = np.where(places < -1e-9 * np.abs(places).max(), -1.0, 1.0)
    signs[:, 2] = 1.0
    return signs[:, :, None] * np.eye(3)


# ---------------------------------------------------------------- rules
def same_cells(scene: ReducedScene) -> str | None:
    """Random or measured cells are other ones in every element."""
    return unmeasured_cells(scene) or drawn_once(scene)


def unmeasured_cells(scene: ReducedScene) -> str | None:
    """A file gives the cells of all elements."""
    return "cells.fibres gives other cells to each element" if scene.measured_cells else None


def drawn_once(scene: ReducedScene) -> str | None:
    """Random cells are other ones in every element."""
    number = scene.geometry.number_of_elements * scene.mesh.refinement**3
    if not scene.has_random_cells or (number == 1 and scene.mesh.element == "hexahedron"):
        return None
    return f"cells.initial = 'random' draws other cells for each of {number} elements"


def symmetric_law(scene: ReducedScene) -> str | None:
    """A law that turns axes to one of two sides leaves the symmetry of body and loads."""
    law = scene.remodeling.law
    return None if LAWS[law].keeps_symmetry else f"remodeling.law = {law!r} may turn axes out of planes of symmetry"


def round_about_z(scene: ReducedScene) -> str | None:
    """Cells that are the same in every half-plane through the z axis."""
    axes = scene.cells.axes
    if axes == "cylindrical" or (axes == "global" and all(a == b == 0 for a, b, _ in _dimensions(scene))):
        return None
    return f"cells.axes = {axes!r}: the tube is not round, along x it differs from along the diagonal"


def symmetric_planes(scene: ReducedScene) -> str | None:
    """Cells whose mirror images in x = 0 and y = 0 are cells of the body."""
    axes = scene.cells.axes
    return None if axes in ("cylindrical", "global") else f"cells.axes = {axes!r} may have no planes of symmetry"


def homogeneous(scene: ReducedScene) -> str | None:
    """Cells that are the same everywhere, and stay so."""
    axes, lengths = scene.cells.axes, _dimensions(scene)
    if len(lengths) > 1:
        return "regions may make cells, and stress, that are not the same everywhere"
    if axes == "global":
        return None
    if axes != "cylindrical":
        return f"cells.axes = {axes!r} may make cells that are not the same everywhere"
    # passes give dimensions to ranks: with l1 = l3 != l2 the cells would differ after the first one
    ((first, second, third),) = lengths
    stays = first == third and (second == first or not LAWS[scene.remodeling.law].remodels)
    return None if stays else "cells.axes = 'cylindrical' makes cells, and stress, that are not the same everywhere"


def free_ends(scene: ReducedScene) -> str | None:
    """Ends that move radially as all other sections do."""
    ends = scene.supports.ends
    return None if ends in ("free", "closed") else f"supports.ends = {ends!r}: the sections are not alike"


def known_loads(name: str) -> Rule:
    """Loads that the kinematics of this name has."""

    def rule(scene: ReducedScene) -> str | None:
        kinds = scene.geometry.loads
        unknown = [f"loads.{load}" for load in scene.loads if name not in kinds[load].reductions]
        return f"{', '.join(unknown)} would have to be applied to the whole body" if unknown else None

    return rule


def _dimensions(scene: ReducedScene) -> list[tuple[float, ...]]:
    """l1, l2, l3 of the first cell at the start, of each region."""
    return [tuple(map(float, properties.cells.dimensions(1)[0])) for properties in scene.properties().values()]
