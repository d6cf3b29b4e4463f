"""Common parts of shapes with a wall: layers, depths, angles and columns."""

from __future__ import annotations

import dataclasses
import itertools
from abc import abstractmethod
from collections.abc import Callable, Collection, Mapping
from functools import partial
from operator import attrgetter
from typing import Any, ClassVar, NamedTuple, TYPE_CHECKING

import numpy as np

from remodel_fenicsx.body.gmsh_model import mesh_length_problem
from remodel_fenicsx.body.shape import (
    Column,
    Columns,
    LoadKind,
    Regions,
    Unloads,
    WithAxes,
    WithRegions,
    mean_over,
)
from remodel_fenicsx.model.axes import LocalAxes
from remodel_fenicsx.model.cells import pitch_angle, radial_fraction
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.model.tensors import Array
from remodel_fenicsx.schema.settings import Natural, Region
from remodel_fenicsx.schema.tables import validation_error, format_value

if TYPE_CHECKING:
    from remodel_fenicsx.body.domain import Domain


# ---------------------------------------------------------------- layers of a round wall
# Positions of regions, and of elements such that none lies in two regions.


class Wall(NamedTuple):
    """Layers of a wall and their numbers of elements, from the lumen outwards."""

    names: tuple[str, ...]
    radii: tuple[float, ...]
    counts: tuple[int, ...]

    @classmethod
    def from_regions(
        cls, inner_radius: float, outer_radius: float, elements: int, regions: Regions
    ) -> Wall:
        """Return the wall of a scene's regions with these elements, at least one a layer."""
        order = sorted(regions, key=lambda name: _outer(regions[name], outer_radius)) or ["body"]
        inside = [_outer(regions[name], outer_radius) for name in order[:-1]]
        radii = (inner_radius, *inside, outer_radius)
        return cls(
            tuple(order), radii, shared_out([b - a for a, b in itertools.pairwise(radii)], elements)
        )

    def nodes(self, degree: int) -> Array:
        """Return the radii of nodes of elements of this degree, equally spaced in each layer."""
        ends = degree * np.cumsum([0, *self.counts])
        return np.interp(np.arange(ends[-1] + 1), ends, self.radii)

    def marked(self, domain: Domain) -> Domain:
        """Return the domain with its layers as regions; mid-radii of elements decide."""
        from remodel_fenicsx.fem import compat

        nodes = domain.mesh.geometry.x[compat.geometry_dofmap(domain.mesh)]
        radii = np.hypot(nodes[..., 0], nodes[..., 1])
        layer = np.searchsorted(self.radii[1:-1], (radii.min(axis=1) + radii.max(axis=1)) / 2)
        numbers = {name: number for number, name in enumerate(self.names, start=1)}
        return dataclasses.replace(
            domain, regions=numbers, element_region=(layer + 1).astype(np.int32)
        )


def _outer(region: Region, outer_radius: float) -> float:
    return outer_radius if region.outer_radius is None else region.outer_radius


def shared_out(thicknesses: list[float], elements: int) -> tuple[int, ...]:
    """Distribute elements over layers, at least one each, as evenly thick as possible."""
    counts = [1] * len(thicknesses)
    for _ in range(elements - len(counts)):
        counts[int(np.argmax(np.divide(thicknesses, counts)))] += 1
    return tuple(counts)


def check_layers(inner_radius: float, outer_radius: float, elements: int, regions: Regions) -> None:
    """Check that the regions are layers of the wall, with at least one element each."""
    # A layer is at least as thick as Gmsh can mesh (`mesh_length_problem`).
    seen: dict[float, str] = {}
    for name, region in regions.items():
        key, radius = f"regions.{name}.outer_radius", _outer(region, outer_radius)
        if not inner_radius < radius <= outer_radius:
            inner, outer = format_value(inner_radius), format_value(outer_radius)
            rule = f"must be greater than geometry.inner_radius = {inner}"
            raise validation_error(f"{rule}, at most outer_radius = {outer}", key, radius)
        if radius in seen:
            rule = f"regions.{seen[radius]} also ends at {format_value(radius)}"
            raise validation_error(f"{rule}; outer radii must differ", key, region.outer_radius)
        seen[radius] = name
    if regions and outer_radius not in seen:
        last = seen[max(seen)]
        outer = f"geometry.outer_radius = {format_value(outer_radius)}"
        rule = f"must be {outer} or omitted: outermost region"
        raise validation_error(rule, f"regions.{last}.outer_radius", max(seen))
    if len(regions) > elements:
        rule = f"{len(regions)} regions, {elements} elements through the wall"
        raise validation_error(f"{rule}; increase mesh.refinement", "regions", None)
    for inside, radius in itertools.pairwise([inner_radius, *sorted(seen)]):
        key = f"regions.{seen[radius]}.outer_radius"
        if (
            problem := mesh_length_problem(
                {key: radius - inside, "geometry.outer_radius": outer_radius}
            )
        ) is not None:
            raise validation_error(f"the layer is {problem[1]}", key, radius)


# ---------------------------------------------------------------- stress-free configurations
# G maps the stress-free configuration to the mesh.


def prestretch(natural: Natural, local_axes: LocalAxes, domain: Domain) -> Array:
    """Return the layers' three stretches at the points, (elements, points, 3)."""
    depth = local_axes.depth
    stretches = np.ones((*depth.shape, 3))
    for layer in natural.layers:
        low, high = layer.share
        chosen = (depth >= low) & ((depth < high) | (high == 1.0))
        if layer.region is not None:
            chosen = domain.element_region == domain.regions[layer.region]
        stretches[chosen] = layer.prestretch.stretches
    return stretches


# ---------------------------------------------------------------- the lumen


LUMEN_EXPANSION = LoadKind(
    lambda shape, loading, name: loading.add_lumen_expansion(
        name, "inner", *shape.lumen(loading.domain)
    ),
    "change of the lumen's volume over its reference volume: prescribed, with the pressure as an "
    "unknown, or computed",
    above=-1.0,
    reductions=("radial", "axisymmetric", "sector"),
    value=lambda m: m.cached(
        "lumen",
        lambda: m.state.loading.lumen_expansion("inner", *m.observer.shape.lumen(m.domain)),
    )(),
    makes_pressure_unknown=True,
    replaces="pressure",
)


# ---------------------------------------------------------------- bodies with inner and outer face
# Measurements in the wall, and its local axes on any mesh.

AngleOf = Callable[[Any, Array], float]  # function of a measurement and of angles at its points
ANGLE_IN = "mean reference fibre angle (0 circumferential, 90 axial) in the wall, over the elements"


CONFIGURATIONS = {
    "unloaded": "in the unloaded body; it differs if that has residual stress",
    "deformed": "in the deformed configuration, in local axes that move with the body",
}
"""Further configurations for angles in addition to the cells' own, each with its description."""


def angle_columns(means: Mapping[str, tuple[str, AngleOf]], configuration: str = "") -> Columns:
    """Return columns of angles in the cells' own configuration, or in one of `CONFIGURATIONS`."""
    name = f"fibre_angle_{configuration}" if configuration else "fibre_angle"
    return tuple(
        Column(
            f"{name}_{where}",
            "degrees",
            (
                f"as `fibre_angle_{where}`, but {CONFIGURATIONS[configuration]}"
                if configuration
                else f"{ANGLE_IN} {words}"
            ),
            mean_over(mean, attrgetter(name)),
            by_case=bool(configuration),
        )
        for where, (words, mean) in means.items()
    )


STRESSES = {"hoop": ("around", 0), "axial": ("along", 1), "radial": ("across", 2)}
"""Components of the Cauchy stress in a wall: direction, and index in `Measurement.wall_stress`."""


def stress_columns(means: Mapping[str, tuple[str, AngleOf]]) -> Columns:
    """Return columns of the Cauchy stress at the wall's faces, and of its means."""
    return tuple(
        Column(
            f"{name}_stress_{where}",
            "stress",
            f"Cauchy stress {direction} the deformed wall, "
            + (
                FITTED_TO_FACE
                if where in FACES
                else f"mean over the elements of `fibre_angle_{where}`"
            ),
            partial(_stress, where, mean, component),
        )
        for name, (direction, component) in STRESSES.items()
        for where, (_, mean) in means.items()
    )


def columns_on_request(means: Mapping[str, tuple[str, AngleOf]]) -> Columns:
    """Return columns of angles in other configurations and of stresses, and those of all walls."""
    angles = (angle_columns(means, name) for name in CONFIGURATIONS)
    return (*itertools.chain(*angles), *stress_columns(means), *Walled.columns_on_request)


FACES = ("inner", "outer")
FITTED_TO_FACE = (
    "mean over the face: fitted through two layers of elements "
    "(docs/reliability.md, Stress at faces)"
)
ON_THE_FACE = 1e-6  # normalised depth within the rounding of coordinates
SECOND_LAYER = 1.5  # depth over layer thickness, between the start of the second and third layer


def _stress(where: str, mean: AngleOf, component: int, m: Any) -> float:
    if where in FACES:
        return float(
            m.cached_for_step(("stress at", where), lambda: _fitted_to_face(where, m))[component]
        )
    return mean(m, m.wall_stress[..., component])


def _stress_of_part(part: str, component: int, m: Any) -> float:
    collagen = m.collagen_wall_stress
    stress = collagen if part == "collagen" else m.wall_stress - collagen
    return float(m.quadrature.nanmean(stress[..., component], np.linalg.det(m.F)))


def _fitted_to_face(face: str, m: Any) -> Array:
    """Return the stress around, along and across the wall at a face, (3,). Collective."""
    # The stress at superconvergent points is fitted by a polynomial of (R_face/R)^2. In a linear
    # elastic tube the components are linear in it (Lame). R/R_face follows from the areas of both
    # faces, so that the fit holds for any wall.
    from remodel_fenicsx.fem.compat import geometry_dofmap

    quadrature, comm = m.quadrature, m.domain.comm
    inner, outer = (m.cached(("area", name), lambda name=name: m.face_area(name)) for name in FACES)
    local_axes, widening = m.state.cells.local_axes, outer / inner - 1
    depths = local_axes.nodal_depth[geometry_dofmap(m.domain.mesh)]
    if face == "outer":
        widening, depths = inner / outer - 1, 1 - depths
    depths = quadrature.owned(depths)
    volumes, at_face = (
        quadrature.owned(quadrature.volumes.sum(axis=1)),
        depths.min(axis=1) < ON_THE_FACE,
    )
    thickness, total = comm.allreduce(
        np.array([depths.max(axis=1), np.ones(len(depths))]) @ (volumes * at_face)
    )
    near = depths.min(axis=1) < SECOND_LAYER * thickness / total
    if m.domain.regions:  # the circumferential stress of another tissue differs
        region = quadrature.owned(m.domain.element_region)
        near &= np.isin(region, np.concatenate(comm.allgather(np.unique(region[at_face]))))
    layers = 2 if any(comm.allgather(bool((near & ~at_face).any()))) else 1
    t, values = (
        quadrature.superconvergent_from_nodes(depths[near]),
        quadrature.owned(quadrature.superconvergent(m.wall_stress))[near],
    )
    place = (2 + t * widening) * t / (1 + t * widening) ** 2  # (1 - (R_face/R)^2) / widening
    powers = place.reshape(-1)[:, None] ** np.arange(layers * quadrature.element_degree)
    weighted = powers.T * np.repeat(volumes[near], t.shape[1])
    normal, right = comm.allreduce(weighted @ powers), comm.allreduce(
        weighted @ values.reshape(-1, 3)
    )
    return np.linalg.solve(normal, right)[0]


class Walled(WithAxes):
    """Body with a wall, in which fibre angles are measured and `natural.layers` are allowed.

    Its keyword arguments are the keys of `[geometry]`, as of every `Shape`.

    Examples
    --------
    >>> from remodel_fenicsx.extend import SHAPES, Walled
    >>> [name for name, shape in SHAPES.items() if issubclass(shape, Walled)]
    ['tube', 'mesh']
    """

    columns_on_request: ClassVar[Columns] = (
        Column(
            "radial_share",
            "",
            "fraction of the chains that points out of the wall, volume mean of A_rr / tr A",
            lambda m: m.quadrature.nanmean(m.radial_share),
            by_case=False,
        ),
        *(
            Column(
                f"elastin_stretch_{name}",
                "",
                f"{name} stretch of the matrix with its prestretch, mean over the volume",
                lambda m, i=i: m.quadrature.mean(m.elastin_stretches[..., i]),  # type: ignore[misc]
            )
            for i, name in enumerate(("circumferential", "axial"))
        ),
        *(
            Column(
                f"{name}_stress_{part}",
                "stress",
                f"Cauchy stress {STRESSES[name][0]} the wall in the {part}, mean over its volume",
                partial(_stress_of_part, part, STRESSES[name][1]),
            )
            for name in ("hoop", "axial")
            for part in ("matrix", "collagen")
        ),
    )
    angle_layers = {
        "fibre_angle_inner": 0.0,
        "fibre_angle_middle": 0.5,
        "fibre_angle_outer": 1.0,
    }
    depth_labels = ("through the wall", "inside", "outside")
    angle_in_words = ("around", "along")

    @classmethod
    def region_columns_on_request(cls, name: str) -> Columns:
        """Return columns of the stresses in the region's wall."""
        words = f"of the region `{name}`"
        return stress_columns(
            {name: (words, lambda m, v: m.quadrature.nanmean(v, m.elements_of_region(name)))}
        )

    fibre_angle = staticmethod(pitch_angle)  # type: ignore[assignment]
    radial_share = staticmethod(radial_fraction)  # type: ignore[assignment]


class RoundWall(Walled, WithRegions, Unloads):
    """Wall between two radii, filled by layers as regions, which may close from a sector."""

    @abstractmethod
    def wall(self, elements: int, regions: Regions) -> Wall:
        """Return the layered wall with this number of elements through it."""

    def layers_of_tissue(
        self, natural: Natural, regions: Regions, tissues: Mapping[str, Tissue]
    ) -> Any:
        """Return layers of one tissue and prestretch, `model.residual_stress.Layer`, outwards."""
        from remodel_fenicsx.model.residual_stress import UNSTRETCHED, Layer, fresh_stretches

        wall = self.wall(len(regions), regions)
        inner, outer = wall.radii[0], wall.radii[-1]
        edges = set(wall.radii)
        for layer in natural.layers:
            edges |= {inner + share * (outer - inner) for share in layer.share}
        apart = [a for a, b in itertools.pairwise(sorted(edges)) if b - a > 1e-9 * outer] + [outer]
        layers = []
        for low, high in itertools.pairwise(apart):
            middle = (low + high) / 2
            region = wall.names[int(np.searchsorted(wall.radii[1:-1], middle))]
            share = (middle - inner) / (outer - inner)
            of_layer = [
                layer.prestretch.stretches
                for layer in natural.layers
                if (
                    layer.share[0] <= share < layer.share[1]
                    if layer.region is None
                    else layer.region == region
                )
            ]
            tissue = tissues[region if region in tissues else ""]
            stretches = (*of_layer, UNSTRETCHED)[0] * fresh_stretches(tissue)
            layers.append(Layer((low, high), tissue, stretches))
        return layers

    def covers_body(self, regions: Collection[str]) -> bool:
        """Return whether there are regions; the outermost one ends at the outer radius."""
        return bool(regions)
