"""Selection of the kinematics of a scene: rules with reasons, and the cheapest exact kinematics.

A rule is a function of a scene that returns why a reduced kinematics would be wrong for the scene,
or None. Every shape lists its own rules (`Shape.reductions`).
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
# Whole bodies are the meshes of reductions, extruded, revolved or mirrored. A mesh is points (n, 3)
# and the corners of the elements (m, 2, 4 or 8) in VTK's order.

Body = tuple[Array, Integers]

ROUND, LONG = 16, 12  # elements around and along, as in the paper's artery


def _swept(levels: Array, elements: Integers) -> Body:
    """Connect the same mesh at positions (levels, nodes, 3) by elements of one more dimension."""
    near = np.arange(len(levels) - 1)[:, None, None] * levels.shape[1] + elements
    far = near + levels.shape[1]
    connected = np.concatenate([near, far[..., ::-1] if elements.shape[1] == 2 else far], axis=-1)
    return _shared(levels.reshape(-1, 3), connected.reshape(-1, 2 * elements.shape[1]))


def _between(low: Array, high: Array) -> Array:
    """Interpolate the positions of a mesh at `LONG` + 1 levels, (levels, nodes, 3)."""
    share = np.linspace(0.0, 1.0, LONG + 1)[:, None, None]
    return (1.0 - share) * low + share * high


def extended(points: Array, lines: Integers, length: float) -> Body:
    """Extrude lines across z to quadrilaterals, from z = 0 to the length."""
    low = points * [1.0, 1.0, 0.0]
    return _swept(_between(low, low + [0.0, 0.0, length]), lines)


def revolved(points: Array, quadrilaterals: Integers) -> Body:
    """Revolve quadrilaterals in the half-plane y = 0 around the z axis to hexahedra."""
    # Negative angles make the volumes of VTK's hexahedra positive; quadrilaterals have x before z.
    angles = -2 * np.pi * np.arange(ROUND + 1)[:, None] / ROUND
    radii, z = points[:, 0], np.broadcast_to(points[:, 2], (ROUND + 1, len(points)))
    return _swept(
        np.stack([radii * np.cos(angles), radii * np.sin(angles), z], axis=-1), quadrilaterals
    )


_MIRRORED = {8: (0, 3, 2, 1, 4, 7, 6, 5), 4: (0, 2, 1, 3)}  # order of the corners of a mirror image


def mirrored_twice(points: Array, elements: Integers) -> Body:
    """Mirror the quarter x > 0, y > 0 in the planes x = 0 and y = 0, with shared nodes."""
    signs = np.array([(1.0, 1.0, 1.0), (-1.0, 1.0, 1.0), (-1.0, -1.0, 1.0), (1.0, -1.0, 1.0)])
    ways = elements, elements[:, _MIRRORED[elements.shape[1]]]  # keeps all volumes positive
    every = [ways[number % 2] + number * len(points) for number in range(4)]
    return _shared((signs[:, None] * points).reshape(-1, 3), np.concatenate(every))


def _shared(points: Array, elements: Integers) -> Body:
    """Merge nodes at the same position."""
    places = np.rint(points / (1e-7 * np.abs(points).max())).astype(np.int64)
    _, first, number = np.unique(places, axis=0, return_index=True, return_inverse=True)
    return points[first], np.ravel(number)[elements]


def divided_along(points: Array, hexahedra: Integers) -> Body:
    """Divide one layer of hexahedra from a bottom to a top face across z into `LONG` layers."""
    low, high = (points[hexahedra[:, side].ravel()] for side in (slice(4), slice(4, 8)))
    return _swept(_between(low, high), np.arange(len(low)).reshape(-1, 4))


def box(*sides: float) -> Body:
    """Return a block of one element from the origin along x, y and z."""
    section = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    points = np.array([(*place, z) for z in (0.0, 1.0) for place in section])
    return points * sides, np.arange(8)[None]


def cylinder(radius: float, length: float) -> Body:
    """Return a cylinder about z of hexahedra with one edge on the axis."""
    return revolved(
        *extended(np.array([(0.0, 0.0, 0.0), (radius, 0.0, 0.0)]), np.array([[0, 1]]), length)
    )


# ---------------------------------------------------------------- buckling


@dataclass(frozen=True)
class Strut:
    """Model of a body along z as a column that axial compression may buckle."""

    length: float
    end_factor: float
    directions: Callable[[Array], Array]
    squared_distances: Callable[[Array], Array]
    inner_radius: float | None = None


class ReducedScene(Protocol):
    """Protocol of the scene that reductions use."""

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
OVERHEAD_IN_POINTS = 60.0  # a step's cost independent of the mesh, in points of hexahedra


@dataclass(frozen=True)
class Reduction:
    """Kinematics that is exact for some scenes of a shape.

    Attributes
    ----------
    build
        Function of the scene and the communicator that returns the mesh.
    elements
        Function of the scene that returns the number of elements.
    rules
        Rules that return why the kinematics is wrong for a scene.
    turn
        Function of positions X (n, 3) of the body that returns Q (n, 3, 3): Q^T X lies in the part
        that represents the body, or next to it.
    whole
        Function of the shape and of the positions (nodes, 3) and corners of the reduction's mesh
        that returns the whole body for reports (`body.whole`). With None reports show no body.
    in_the_mean
        Rules that return why the kinematics is right only for means over many seeds. A scene may
        then name it, but `auto` does not select it.

    Examples
    --------
    Reductions of the tube, the cheapest first:

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
    """Kinematics of a scene, and the objections to each reduction."""

    name: str
    objections: dict[str, list[str]]


def choice(scene: ReducedScene) -> Choice:
    """Return the scene's kinematics, or with 'auto' the cheapest one that the scene allows."""
    # Under compressive loads no reduction is selected, because a body that buckles leaves the
    # symmetry.
    reductions = scene.geometry.reductions  # the cheapest first
    reasons_by_name = {name: objections(scene, name) for name in reductions}
    if scene.model.kinematics != AUTO:
        return Choice(scene.model.kinematics, reasons_by_name)
    if buckling_risks(scene):
        return Choice("full", reasons_by_name)
    exact = (
        name
        for name, reasons in reasons_by_name.items()
        if not reasons and not reasons_for_means(scene, name)
    )
    return Choice(next(exact, "full"), reasons_by_name)


def objections(scene: ReducedScene, name: str) -> list[str]:
    """Return the reasons why a kinematics would be wrong for a scene; none if it is right."""
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


def reasons_for_means(scene: ReducedScene, name: str) -> list[str]:
    """Return why an allowed kinematics is right only for means over many seeds; none if exact."""
    reductions = scene.geometry.reductions
    return _reasons(reductions[name].in_the_mean, scene) if name in reductions else []


def only_for_means(scene: ReducedScene) -> list[str]:
    """Return why the scene's own kinematics is right only for means over seeds; none if exact."""
    name = scene.model.kinematics
    return [f"{name!r}: {reason}" for reason in reasons_for_means(scene, name)]


def for_means(scene: ReducedScene) -> str:
    """Return the cheapest kinematics that is right for means over many random seeds, or `auto`."""
    if buckling_risks(scene):
        return AUTO
    suitable = (
        name
        for name in scene.geometry.reductions
        if reasons_for_means(scene, name) and not objections(scene, name)
    )
    return next(suitable, AUTO)


def describe_choice(scene: ReducedScene) -> list[str]:
    """Describe the choice: why nothing cheaper is allowed, and what the kinematics cannot show."""
    made = choice(scene)
    lines = [f"kinematics {made.name!r}: {KINEMATICS[made.name].meaning}"]
    for name, reasons in made.objections.items():
        if name != made.name:
            means = " for means over seeds" if reasons_for_means(scene, name) else ""
            verdict = f"not allowed: {'; '.join(reasons)}" if reasons else f"also allowed{means}"
            lines.append(f"{name!r} is {verdict}")
    lines += only_for_means(scene)
    if KINEMATICS[made.name].reduced and (swinging := _leaves_symmetry(scene)):
        lines.append(
            f"{made.name!r} is the symmetric solution; with {swinging} the full body leaves it "
            "after a while, because the pass overshoots (docs/solver.md, Stability of the pass)"
        )
    cannot = ", which this one cannot show" if KINEMATICS[made.name].reduced else ""
    return [
        *lines,
        *(
            f"{threat}: the body may buckle out of the symmetry of a reduction{cannot}"
            for threat in buckling_risks(scene)
        ),
    ]


def buckling_risks(scene: ReducedScene) -> list[str]:
    """Describe loads that may buckle the body: negative ones, which are compression or suction."""
    if not scene.geometry.reductions or not scene.geometry.buckles:
        return []
    pressing = [f"loads.{name}" for name in negative_loads(scene)]
    return [f"{' and '.join(pressing)} below zero"] if pressing else []


def negative_loads(scene: ReducedScene) -> dict[str, None]:
    """Return the names of loads that are negative at some time: compression or suction."""
    loads = (item for case in scene.each_case() for item in case.loads.items())
    return dict.fromkeys(
        name for name, load in loads if min(load.value * factor for _, factor in load.ramp) < 0
    )


def elements(scene: ReducedScene, name: str) -> int:
    """Return the number of hexahedra, or of elements of fewer dimensions, of a kinematics."""
    if KINEMATICS[name].reduced:
        return scene.geometry.reductions[name].elements(scene)
    return scene.geometry.number_of_elements * scene.mesh.refinement**3


def too_many_elements(scene: ReducedScene) -> str:
    """Return the limit of the refinement if the mesh has too many elements, or an empty string."""
    name, refinement = choice(scene).name, scene.mesh.refinement
    if (number := elements(scene, name)) <= LARGEST_MESH:
        return ""
    dimension = {"interval": 1, "quadrilateral": 2}.get(
        KINEMATICS[name].element(scene.mesh.element), 3
    )
    largest = math.floor(
        math.exp(math.log(refinement) - (math.log(number) - math.log(LARGEST_MESH)) / dimension)
    )
    return (
        f"must be at most {largest} for a {scene.geometry.name}: "
        f"more makes over {LARGEST_MESH:g} elements"
    )


def step_cost(scene: ReducedScene, name: str) -> float:
    """Estimate the cost of a step from its quadrature points; 1 is a point of a hexahedron."""
    import basix
    from remodel_fenicsx.fem.quadrature import DEGREES

    kinematics, mesh = KINEMATICS[name], scene.mesh
    element, number = kinematics.element(mesh.element), elements(scene, name)
    if element == "tetrahedron":
        number *= 6
    _, weights = basix.make_quadrature(basix.CellType[element], DEGREES[element, mesh.degree])
    return OVERHEAD_IN_POINTS + kinematics.cost * number * np.size(weights)


def _leaves_symmetry(scene: ReducedScene) -> str:
    """Return the key and value that make the full body leave the symmetric solution, or nothing."""
    remodeling = scene.remodeling
    if remodeling.coupling != "staggered" or scene.geometry.axis_kinds == ("global",):
        return ""
    if DRIVERS[remodeling.driver].over_corrects and LAWS[remodeling.law].remodels:
        return f"remodeling.driver = {remodeling.driver!r}"
    return f"remodeling.law = {remodeling.law!r}" if LAWS[remodeling.law].over_corrects else ""


# ---------------------------------------------------------------- rotations to the reduction
def about_z(places: Array) -> Array:
    """Return rotations of x, y, z to the radial, circumferential and axial direction."""
    circumferential, axial, radial = np.moveaxis(cylindrical_axes(places), -2, 0)
    return np.stack([radial, circumferential, axial], axis=-1)


def mirrored(places: Array) -> Array:
    """Return reflections of the quarter x > 0, y > 0 to the quarter of each position."""
    signs = np.where(places < -1e-9 * np.abs(places).max(), -1.0, 1.0)
    signs[:, 2] = 1.0
    return signs[:, :, None] * np.eye(3)


# ---------------------------------------------------------------- rules
def same_cells(scene: ReducedScene) -> str | None:
    """Require cells that are equal in all elements, neither random nor measured."""
    return unmeasured_cells(scene) or drawn_once(scene)


def unmeasured_cells(scene: ReducedScene) -> str | None:
    """Require cells that do not come from a file."""
    return "cells.fibres has different cells in each element" if scene.measured_cells else None


def drawn_once(scene: ReducedScene) -> str | None:
    """Require random cells to be drawn for one element only."""
    number = scene.geometry.number_of_elements * scene.mesh.refinement**3
    if not scene.has_random_cells or (number == 1 and scene.mesh.element == "hexahedron"):
        return None
    return f"cells.initial = 'random' draws different cells for each of {number} elements"


def symmetric_law(scene: ReducedScene) -> str | None:
    """Require a law that keeps the symmetry of body and loads."""
    law = scene.remodeling.law
    return None if LAWS[law].keeps_symmetry else f"remodeling.law = {law!r} may break the symmetry"


def round_about_z(scene: ReducedScene) -> str | None:
    """Require cells that are equal in every half-plane through the z axis."""
    axes = scene.cells.axes
    if axes == "cylindrical" or (
        axes == "global" and all(a == b == 0 for a, b, _ in _dimensions(scene))
    ):
        return None
    return f"cells.axes = {axes!r}: cells along x and along the diagonal differ"


def symmetric_planes(scene: ReducedScene) -> str | None:
    """Require cells whose mirror images in x = 0 and y = 0 are cells of the body."""
    axes = scene.cells.axes
    return (
        None
        if axes in ("cylindrical", "global")
        else f"cells.axes = {axes!r} may have no planes of symmetry"
    )


def homogeneous(scene: ReducedScene) -> str | None:
    """Require cells that are equal everywhere, and stay equal."""
    axes, lengths = scene.cells.axes, _dimensions(scene)
    if len(lengths) > 1:
        return "with regions, cells and stress may not be homogeneous"
    if axes == "global":
        return None
    if axes != "cylindrical":
        return f"cells.axes = {axes!r}: the cells may not be homogeneous"
    # A pass sorts the dimensions. With l1 = l3 != l2 the cells would differ after the first pass.
    ((first, second, third),) = lengths
    stays = first == third and (second == first or not LAWS[scene.remodeling.law].remodels)
    return None if stays else "cells.axes = 'cylindrical': cells and stress are not homogeneous"


def free_ends(scene: ReducedScene) -> str | None:
    """Require ends that move radially as all other sections."""
    ends = scene.supports.ends
    return None if ends in ("free", "closed") else f"supports.ends = {ends!r}: sections differ"


def known_loads(name: str) -> Rule:
    """Return the rule that a scene has only loads that a kinematics can apply."""

    def rule(scene: ReducedScene) -> str | None:
        kinds = scene.geometry.loads
        unknown = [f"loads.{load}" for load in scene.loads if name not in kinds[load].reductions]
        return (
            f"{', '.join(unknown)} would have to be applied to the whole body" if unknown else None
        )

    return rule


def _dimensions(scene: ReducedScene) -> list[tuple[float, ...]]:
    """Return the initial l1, l2, l3 of the first cell of each region."""
    return [
        tuple(map(float, properties.cells.dimensions(1)[0]))
        for properties in scene.properties().values()
    ]
