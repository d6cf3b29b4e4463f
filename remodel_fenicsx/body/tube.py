"""Thick-walled tube, the paper's artery (Figs. 7 to 11)."""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Callable, Collection
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from remodel_fenicsx.body import gmsh_model as model
from remodel_fenicsx.body import reductions as reduced
from remodel_fenicsx.body.shape import (
    Column,
    End,
    LoadKind,
    Loads,
    Proportions,
    Regions,
    Shape,
    Supports,
    check_lengths,
)
from remodel_fenicsx.body.reductions import ReducedScene
from remodel_fenicsx.body.wall import (
    FACES,
    AngleOf,
    RoundWall,
    Wall,
    angle_columns,
    LUMEN_EXPANSION,
    STRESSES,
    check_layers,
    columns_on_request,
)
from remodel_fenicsx.model.cells import cylindrical_axes, structure_tensor
from remodel_fenicsx.model.energy import TURNED_OVER
from remodel_fenicsx.model.tensors import Array, Integers
from remodel_fenicsx.schema.settings import Mesh
from remodel_fenicsx.schema.tables import validation_error, format_value
from remodel_fenicsx.schema.units import FORCE, LENGTH, STRESS

if TYPE_CHECKING:
    from mpi4py import MPI

    from remodel_fenicsx.body.domain import Domain
    from remodel_fenicsx.body.loading import Loading

log = logging.getLogger(__name__)

PAPER = (16, 8, 12)  # the paper's elements around, through the wall, and along

# ---------------------------------------------------------------- meshes of reductions


def build_in_half_plane(dimension: int, scene: ReducedScene, comm: MPI.Intracomm | None) -> Domain:
    """Mesh the wall with the body's elements on the x axis (1) or in the half-plane y = 0 (2)."""
    from remodel_fenicsx.body.domain import lattice_domain

    shape, degree = scene.geometry, scene.mesh.degree
    counts = _counts(scene.mesh)[1 : dimension + 1]
    wall = shape.wall(counts[0], scene.regions)
    along = [np.linspace(0.0, shape.length, degree * count + 1) for count in counts[1:]] or [
        np.zeros(1)
    ]
    z, radii = np.meshgrid(*along, wall.nodes(degree), indexing="ij")
    points = np.stack([radii.ravel(), np.zeros(radii.size), z.ravel()], axis=1)
    faces = {
        "bottom": lambda x: np.isclose(x[2], 0.0, atol=1e-9 * shape.length),
        "top": lambda x: np.isclose(x[2], shape.length),
        "inner": lambda x: np.isclose(x[0], shape.inner_radius),
        "outer": lambda x: np.isclose(x[0], shape.outer_radius),
    }
    if not counts[1:]:  # a ray has no ends
        faces = {name: faces[name] for name in ("inner", "outer")}
    return wall.marked(
        lattice_domain(points, counts, degree, faces, shape.name, _dimensions(shape), comm)
    )


def build_quarter(scene: ReducedScene, comm: MPI.Intracomm | None) -> Domain:
    """Mesh the quarter x > 0, y > 0, with one layer along z if all sections are equal."""
    mesh, (around, through, _) = scene.mesh, _counts(scene.mesh)
    counts = around, through, layers(scene)
    return whole_tube(
        scene.geometry, counts, mesh.element, mesh.degree, comm, scene.regions, quarters=1
    )


def layers(scene: ReducedScene) -> int:
    """Return the number of a quarter's elements along z: one if only u_z depends on z, linearly."""
    alike = reduced.free_ends(scene) is None and reduced.same_cells(scene) is None
    return 1 if alike else PAPER[2] * scene.mesh.refinement


def _spoke(
    wall: Wall, number: int, corner: int, start: model.Point, stop: model.Point
) -> list[int]:
    """Add a chain of curves through the wall between the corners of one number on its two faces."""
    inside = [
        model.points(model.circle(radius, number)[[corner]])[0] for radius in wall.radii[1:-1]
    ]
    pairs = itertools.pairwise([start, *inside, stop])
    return [
        curve
        for pair, count in zip(pairs, wall.counts, strict=True)
        for curve in model.line(*pair, count)
    ]


def _counts(mesh: Mesh) -> tuple[int, int, int]:
    """Return the numbers of elements of the tube around, through the wall and along."""
    around, through, along = (mesh.refinement * count for count in PAPER)
    return around, through, along


def _dimensions(shape: Any) -> dict[str, float]:
    return {
        name: float(getattr(shape, name)) for name in ("inner_radius", "outer_radius", "length")
    }


def _in_layers(points: Array, elements: Integers) -> reduced.Body:
    """Divide hexahedra as long as the body into layers for pictures; return others as is."""
    as_long = np.isclose(np.ptp(points[elements, 2], axis=1), np.ptp(points[:, 2])).all()
    return (
        reduced.divided_along(points, elements)
        if as_long and elements.shape[1] == 8
        else (points, elements)
    )


def springs_across(scene: ReducedScene) -> str | None:
    """Require springs without tangential stiffness, so that sections stay plane."""
    for face, support in scene.supports.faces.items():
        if support.tangential:
            return f"supports.{face}.tangential is above 0: sections do not stay plane"
    return None


def mirrored_draws(scene: ReducedScene) -> str | None:
    """Require no random cells: those of a quarter represent the tube only in means."""
    if reduced.drawn_once(scene) is None:
        return None
    return (
        "random cells are drawn for a quarter and mirrored to the other three: means over seeds "
        "are nearly those of the whole tube (docs/model.md, Kinematics), a single draw "
        "scatters about twice as much"
    )


_EVERYWHERE = (reduced.same_cells, reduced.symmetric_law)
REDUCTIONS = {
    "radial": reduced.Reduction(
        partial(build_in_half_plane, 1),
        lambda scene: PAPER[1] * scene.mesh.refinement,
        (
            *_EVERYWHERE,
            reduced.round_about_z,
            reduced.free_ends,
            springs_across,
            reduced.known_loads("radial"),
        ),
        reduced.about_z,
        lambda shape, points, lines: reduced.revolved(
            *reduced.extended(points, lines, shape.length)
        ),
    ),
    "axisymmetric": reduced.Reduction(
        partial(build_in_half_plane, 2),
        lambda scene: PAPER[1] * PAPER[2] * scene.mesh.refinement**2,
        (*_EVERYWHERE, reduced.round_about_z, reduced.known_loads("axisymmetric")),
        reduced.about_z,
        lambda shape, points, quadrilaterals: reduced.revolved(points, quadrilaterals),
    ),
    "sector": reduced.Reduction(
        build_quarter,
        lambda scene: PAPER[0] * PAPER[1] * scene.mesh.refinement**2 * layers(scene) // 4,
        (
            reduced.unmeasured_cells,
            reduced.symmetric_law,
            reduced.symmetric_planes,
            springs_across,
            reduced.known_loads("sector"),
        ),
        reduced.mirrored,
        lambda shape, points, elements: reduced.mirrored_twice(*_in_layers(points, elements)),
        in_the_mean=(mirrored_draws,),
    ),
}
"""Reductions of the tube, the cheapest first."""


# ---------------------------------------------------------------- columns and loads


def _mean_radius(face: str) -> Callable[[Any], float]:
    return lambda m: m.face_mean(face, np.linalg.norm(m.position[:, :2], axis=1), deformed=True)


def _mean_hoop_stress(m: Any) -> float:
    """Return the mean over dr: deformed volume over circumference 2 pi R |F c| and length."""
    local = m.state.cells.local_axes
    around = np.linalg.norm(np.einsum("...ij,...j->...i", m.F, local.axes[..., 0, :]), axis=-1)
    radii = np.linalg.norm(local.coordinates[..., :2], axis=-1)
    return m.quadrature.nanmean(m.wall_stress[..., 0], np.linalg.det(m.F) / (radii * around))


def _layer_angle(share: float) -> AngleOf:
    """Return the mean over the elements that touch R_i + share (R_o - R_i)."""

    def mean(m: Any, angle: Array) -> float:
        inner, outer = (m.domain.dimensions[f"{face}_radius"] for face in FACES)
        return m.quadrature.nanmean(
            angle, m.elements_touching_radius((1.0 - share) * inner + share * outer)
        )

    return mean


# Element thickness over the inner radius. At 0.25 the radial stress at the face of linear elements
# has an error of 4 to 5 %.
THICK_ELEMENTS = 0.2

MEANS = {
    "inner": ("that touch the inner radius", _layer_angle(0.0)),
    "middle": ("that touch the middle radius, (R_i + R_o)/2", _layer_angle(0.5)),
    "outer": ("that touch the outer radius", _layer_angle(1.0)),
}


def _elongation(m: Any) -> float:
    """Return the prescribed elongation, or the solution if the length is an unknown."""
    strain = getattr(m.state.kinematics, "strain_of_length", None)
    return (
        float(m.step.loads.get("elongation", 0.0))
        if strain is None
        else float(strain(m.state.unknown))
    )


def _of_the_end(name: str, m: Any) -> float:
    """Return `wall_force` or `reduced` of an `EndForce`."""
    return float(getattr(m.end_force("inner"), name)(m.state.loading.lumen_pressure()))


def _of_rings(release: str, m: Any) -> float:
    """Return `cut` or `unloaded_stretch` of the tube with its current cells. Collective."""
    from remodel_fenicsx.model import residual_stress

    arguments = m.cached_for_step("rings", lambda: _rings(m))
    try:
        return float(getattr(residual_stress, release)(*arguments))
    except ArithmeticError as error:
        if m.domain.comm.rank == 0:
            log.warning(
                "time %g: opening_angle or axial_stretch_in_vivo is NaN: %s", m.step.time, error
            )
        return float("nan")


def _rings(m: Any) -> tuple[object, ...]:
    """Return the arguments of `cut`: tissue, rings, radii of elements, closed ring. Collective."""
    from remodel_fenicsx.model.residual_stress import Rings, means_through

    state, stepper = m.state, m.observer.stepper
    cells, comm = state.cells, state.comm
    local, tissue = cells.local_axes, stepper.remodeling.parameters.largest()  # numbers
    axes = local.axes.reshape(-1, 3, 3)

    def along(tensors: Array) -> Array:
        """Return the components around, along and across the wall."""
        return np.einsum("nia,nab,nib->ni", axes, tensors.reshape(-1, 3, 3), axes)

    natural, closed = state.natural_gradient, state.kinematics.closed_ring

    def at_first(radii: Array) -> Array:
        return np.ones((len(radii), 3)) if closed is None else closed.stretches(radii)

    radii = np.linalg.norm(local.coordinates.reshape(-1, 3)[:, :2], axis=1)
    changed = np.ones((len(radii), 3)) if natural is None else along(natural) / at_first(radii)
    density = state.per_mesh_volume(np.ones(m.quadrature.shape)).reshape(-1)
    columns = [radii, density, *along(structure_tensor(*cells.point_cells[:2])).T, *changed.T]
    turned = [name for name in TURNED_OVER if getattr(tissue, name) is not None]
    columns += [getattr(stepper.remodeling.parameters.at_points(), name) for name in turned]
    rows = np.column_stack([m.quadrature.volumes.reshape(-1), *columns])
    owned = m.quadrature.owned(rows.reshape(*m.quadrature.shape, -1))
    rows = np.concatenate(comm.allgather(owned.reshape(-1, rows.shape[1])))
    edges, parts = m.cached("cut", lambda: _elements_through(m.domain, m.quadrature.element_degree))
    volumes, means = means_through(rows[:, 1], rows[:, 0], rows[:, 1:], parts)
    (radii, density), (squared, changed, turnover) = means[:, :2].T, np.split(
        means[:, 2:], [3, 6], axis=1
    )
    rings = Rings(radii, volumes * density, changed * at_first(radii), squared)
    tissue = replace(tissue, **dict(zip(turned, turnover.T, strict=True)))
    return tissue, rings, edges, closed


def _elements_through(domain: Domain, degree: int) -> tuple[Array, Array]:
    """Return radii of element boundaries on the x axis, and radii that separate Gauss points."""
    geometry = domain.mesh.geometry
    nodes = domain.comm.bcast(domain.gather_nodes(geometry.x))
    off, size = np.abs(nodes[:, 1:]).max(axis=1), np.abs(nodes).max()
    radii = np.sort(nodes[(off < 1e-9 * size) & (nodes[:, 0] > 0), 0])
    edges = radii[:: geometry.cmap.degree]
    shares = np.cumsum(np.polynomial.legendre.leggauss(degree + 1)[1][:-1]) / 2
    return edges, np.sort(np.append(edges, edges[:-1, None] + np.diff(edges)[:, None] * shares))


class Tube(RoundWall):
    """Thick-walled tube about z under internal pressure and elongation: the paper's artery.

    The ends stay in their planes. They move radially, are clamped, or are closed by caps
    (`supports.ends`). Inner radius, wall thickness and length: 1e-6 to 1e6, one up to 10,000 times
    the other.

    Its keyword arguments are the keys of `[geometry]`: `inner_radius`, `outer_radius` and `length`
    in the unit `length_unit`, or in any one unit.

    Raises
    ------
    SceneError
        If a value is not allowed: one line.

    Examples
    --------
    >>> import numpy as np
    >>> from remodel_fenicsx import parts
    >>> body = parts.Tube(inner_radius=1.0, outer_radius=3.0, length=8.0)
    >>> body.depth(np.array([[2.0, 0.0, 4.0]]))  # through the wall
    array([0.5])
    >>> round(body.section_area, 4), list(body.loads)
    (25.1327, ['pressure', 'elongation', 'axial_force', 'lumen_expansion'])
    """

    loads = {
        "pressure": LoadKind(
            lambda shape, loading, name: (
                loading.add_cavity_pressure if loading.has_caps else loading.add_follower_pressure
            )(name, "inner"),
            "pressure on the deformed inner face, and on the caps of closed ends",
            STRESS,
            reductions=tuple(REDUCTIONS),
            value=lambda m: m.state.loading.lumen_pressure(),
            replaces="lumen_expansion",
        ),
        "elongation": LoadKind(
            lambda shape, loading, name: loading.add_prescribed_elongation(
                name, "top", 2, shape.length
            ),
            "engineering strain of the length (0.1: 10 % longer), prescribed or computed",
            column="axial_elongation",
            above=-1.0,
            reductions=tuple(REDUCTIONS),
            value=_elongation,
        ),
        "axial_force": LoadKind(
            lambda shape, loading, name: loading.add_axial_force(name),
            "force along z in the wall at the end z = `length`. As a load it is a dead load on the "
            "ends, in addition to the pressure on caps; the length is then an unknown",
            FORCE,
            reductions=tuple(REDUCTIONS),
            makes_length_unknown=True,
            value=partial(_of_the_end, "wall_force"),
            area=lambda shape: shape.section_area,
        ),
        "lumen_expansion": LUMEN_EXPANSION,
    }
    columns = (
        *(
            Column(
                f"{face}_radius",
                "length",
                f"mean distance from the axis over the deformed {face} face",
                _mean_radius(face),
            )
            for face in FACES
        ),
        *angle_columns(MEANS),
    )
    columns_on_request = (
        Column(
            "reduced_axial_force",
            "force",
            "force that a testing machine measures: `axial_force` minus p pi r_i^2 at that end",
            partial(_of_the_end, "reduced"),
        ),
        Column(
            "opening_angle",
            "degrees",
            "sector by which the unloaded tube would open after a cut along its length now",
            partial(_of_rings, "cut"),
            by_case=False,
            of_one_tissue=True,
        ),
        Column(
            "axial_stretch_in_vivo",
            "",
            "length over that of the unloaded tube with its cells now: retraction after excision",
            lambda m: (1 + _elongation(m)) / _of_rings("unloaded_stretch", m),
            of_one_tissue=True,
        ),
        Column(
            "mean_hoop_stress",
            "stress",
            "Cauchy stress around the wall, mean over the deformed thickness: p r_i / h",
            _mean_hoop_stress,
        ),
        Column(
            "wall_thickness",
            "length",
            "outer minus inner radius",
            lambda m: _mean_radius("outer")(m) - _mean_radius("inner")(m),
        ),
        *columns_on_request(MEANS),
    )
    axis_kinds = ("global", "cylindrical")
    number_of_elements = 1536
    face_names = ("bottom", "top", "inner", "outer")
    reductions = REDUCTIONS
    ends = Shape.ends | {
        "clamped": End(lambda shape, loading: shape.clamp(loading)),
        "closed": End(lambda shape, loading: shape.close(loading), makes_length_unknown=True),
    }
    supported_faces = ("outer",)
    # With global axes a tube of isotropic cells would not stay round in the first step.
    defaults = {"cells": {"axes": "cylindrical"}}

    shape: Literal["tube"] = "tube"
    """Shape of the body."""
    inner_radius: Annotated[float, LENGTH] = Field(gt=0)
    """Inner radius R_i, in the scene's unit of length."""
    outer_radius: Annotated[float, LENGTH] = Field(gt=0)
    """Outer radius R_o, in the scene's unit of length."""
    length: Annotated[float, LENGTH] = Field(gt=0)
    """Length along z, in the scene's unit of length."""

    def hold_faces(
        self, loading: Loading, supports: Supports, modulus: float, loads: Loads
    ) -> None:
        """Add springs for the surrounding tissue."""
        for face, support in supports.items():
            from remodel_fenicsx.body.mesh_domain import (
                add_support,
                warn_of_twist,
            )  # few tubes need it

            add_support(loading, face, support, modulus, None)
            if loading.kinematics.has_rigid_modes:
                warn_of_twist(face, support, loading.domain.comm)

    def wall(self, elements: int, regions: Regions) -> Wall:
        """Return the layered wall with this number of elements through it."""
        return Wall.from_regions(self.inner_radius, self.outer_radius, elements, regions)

    @model_validator(mode="after")
    def _has_a_wall(self) -> Tube:
        if self.inner_radius >= self.outer_radius:
            limit = (
                f"must be smaller than geometry.outer_radius = {format_value(self.outer_radius)}"
            )
            raise validation_error(limit, "inner_radius", self.inner_radius)
        wall = self.outer_radius - self.inner_radius
        check_lengths(
            self, {"inner_radius": self.inner_radius, "outer_radius": wall, "length": self.length}
        )
        return self

    def unresolved(self, mesh: Mesh, columns: Collection[str]) -> list[str]:
        """Warn of stresses at the inner face of linear elements that are too thick."""
        size = (self.outer_radius - self.inner_radius) / _counts(mesh)[1] / self.inner_radius
        at_face = [
            name
            for name in columns
            if name in {f"{component}_stress_inner" for component in STRESSES}
        ]
        if mesh.degree > 1 or size < THICK_ELEMENTS:
            return []
        return [
            f"output.columns = {name!r}: error of 4 % or more, and several times as much if chains "
            f"nearly lock: linear elements are {size:.2g} inner radii thick; set mesh.degree = 2"
            for name in at_face
        ]

    def build(self, mesh: Mesh, comm: MPI.Intracomm | None = None) -> Domain:
        """Mesh 16 elements around, 8 through the wall, 12 along, times the refinement."""
        return self.build_with({}, mesh, comm)

    def build_with(self, regions: Regions, mesh: Mesh, comm: MPI.Intracomm | None = None) -> Domain:
        """Mesh the tube with the scene's layers; no element lies in two layers."""
        return whole_tube(self, _counts(mesh), mesh.element, mesh.degree, comm, regions)

    def check_regions(self, regions: Regions, mesh: Mesh) -> None:
        """Check that the regions are layers of the wall with distinct outer radii."""
        check_layers(self.inner_radius, self.outer_radius, _counts(mesh)[1], regions)

    def region_depths(self, regions: Regions) -> dict[str, tuple[float, float]]:
        """Return start and end depth of the layers, from the lumen outwards."""
        wall = self.wall(len(regions), regions)
        places = ((np.array(wall.radii) - wall.radii[0]) / np.ptp(wall.radii)).tolist()
        return dict(zip(wall.names, itertools.pairwise(places), strict=True)) if regions else {}

    def support(
        self, loading: Loading, ends: str = "free", loads: Collection[str] | None = None
    ) -> None:
        """Add supports and loads; without elongation the top is fixed along z."""
        super().support(loading, ends, loads)
        if "elongation" not in loading.values:
            loading.hold_face("top", 2)

    def hold(self, loading: Loading) -> None:
        """Constrain u_z at the bottom, and the other rigid body modes at three of its nodes."""
        loading.hold_face("bottom", 2)
        loading.hold_node((self.inner_radius, 0.0, 0.0), 1)
        loading.hold_node((-self.inner_radius, 0.0, 0.0), 1)
        loading.hold_node((0.0, self.inner_radius, 0.0), 0)

    def clamp(self, loading: Loading) -> None:
        """Constrain u_z at the bottom, and u_x and u_y at the bottom and the top."""
        loading.hold_face("bottom", 2)
        for face in ("bottom", "top"):
            for component in (0, 1):
                loading.hold_face(face, component)

    def close(self, loading: Loading) -> None:
        """Add the supports of free ends, and caps under the pressure."""
        self.hold(loading)
        loading.has_caps = True

    def lumen(self, domain: Domain) -> tuple[Array, float]:
        """Return `across` and `caps` of `Loading.add_lumen_expansion`."""
        return np.eye(3)[:, :2], 0.0

    @property
    def axial_length(self) -> float:
        """Length of the tube along z."""
        return self.length

    @property
    def section_area(self) -> float:
        """Area of the wall's section."""
        return math.pi * (self.outer_radius**2 - self.inner_radius**2)

    @property
    def proportions(self) -> Proportions:
        """Proportions of vessels, which are neither rings nor threads."""
        outer = self.outer_radius
        return (
            ("inner_radius", "outer_radius / inner_radius", outer / self.inner_radius, (0, 0.5)),
            ("length", "length / outer_radius", self.length / outer, (-2, 3)),
        )

    def log_of_radii(self, wall: Any) -> float:
        """Return ln(r_o/r_i) of the scene's geometry."""
        return math.log(self.outer_radius / self.inner_radius)

    def strut(self, ends: str) -> reduced.Strut:
        """Return the column: planes of the ends are fixed, one end moves unless clamped."""
        return reduced.Strut(
            self.length,
            0.5 if ends == "clamped" else 1.0,
            reduced.about_z,
            lambda places: np.square(places[:, :2]).sum(axis=1) / 2,
            self.inner_radius,
        )

    def depth(self, coordinates: Array) -> Array:
        """Return the depth from the inner (0) to the outer face (1), (...,)."""
        # The plane faces of elements lie inside the cylinders.
        radii = np.linalg.norm(coordinates[..., :2], axis=-1)
        return np.clip(
            (radii - self.inner_radius) / (self.outer_radius - self.inner_radius), 0.0, 1.0
        )

    def axes_at(self, coordinates: Array) -> Array:
        """Return circumferential, axial and radial axes about z, rows (..., 3, 3)."""
        return cylindrical_axes(coordinates)


def whole_tube(
    shape: Tube, counts: tuple[int, int, int], element: str, degree: int,
    comm: MPI.Intracomm | None = None,
    regions: Regions | None = None, quarters: int = 4,
) -> Domain:  # fmt: skip
    """Mesh a tube with these elements around (a multiple of 4), through the wall and along.

    Collective.
    """
    # The nodes lie exactly on the radii, equally spaced through each layer. Some are on the
    # positive and negative x and y axes. Elements of degree 1 have plane faces: the inner and outer
    # faces of the mesh are regular prisms inside the cylinders.
    from remodel_fenicsx.body.domain import build_domain

    around, through, along = counts
    wall = shape.wall(through, regions or {})
    draw = partial(draw_tube, wall, shape.length, (around, along), element, degree, quarters)
    return wall.marked(build_domain(draw, shape.name, _dimensions(shape), comm))


def draw_tube(
    wall: Wall, length: float, counts: tuple[int, int], element: str, degree: int, quarters: int = 4
) -> None:
    """Draw and mesh quarters of the tube in the current Gmsh model, extruded along z.

    `counts` are the elements around the whole tube and along.
    """
    number, along = counts
    quarter, is_whole = number // 4, quarters == 4
    nodes = quarters * quarter + (not is_whole)
    inner, outer = (
        model.points(model.circle(radius, number)[:nodes])
        for radius in (wall.radii[0], wall.radii[-1])
    )
    inner_lines, outer_lines = (model.polygon(nodes, is_whole) for nodes in (inner, outer))
    spokes = [_spoke(wall, number, k, inner[k], outer[k]) for k in range(0, nodes, quarter)]
    section = model.ring(inner, outer, inner_lines, outer_lines, spokes, element)
    sides = {"inner": inner_lines, "outer": outer_lines}
    sides |= {} if is_whole else {"plane_y": spokes[0], "plane_x": spokes[-1]}
    model.extrude(section, length, along, element, sides)
    model.raise_degree(degree, np.ones_like)
