"""Layers of a round wall: which regions lie where, and where elements begin and end so that none lies in two."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.body.gmsh_model import length_fault
from remodel_fenicsx.schema.tables import fault, shown
from remodel_fenicsx.settings import Region

if TYPE_CHECKING:
    from remodel_fenicsx.body.domain import Domain

Array = NDArray[np.float64]


class Wall(NamedTuple):
    """A wall and its elements in the direction of its thickness, from the lumen outwards.

    Attributes
    ----------
    names
        Of its layers; one without a name is the whole wall.
    radii
        Where layers begin and end: one more than layers.
    counts
        Elements through each layer; within one they are equally thick.
    """

    names: tuple[str, ...]
    radii: tuple[float, ...]
    counts: tuple[int, ...]

    @classmethod
    def of(cls, inner_radius: float, outer_radius: float, elements: int, regions: Mapping[str, Region]) -> Wall:
        """The wall of a scene's regions with so many elements through it, as many as layers or more."""
        order = sorted(regions, key=lambda name: _outer(regions[name], outer_radius)) or ["body"]
        inside = [_outer(regions[name], outer_radius) for name in order[:-1]]
        radii = (inner_radius, *inside, outer_radius)
        return cls(tuple(order), radii, shared_out([b - a for a, b in itertools.pairwise(radii)], elements))

    def nodes(self, degree: int) -> Array:
        """Radii of the nodes of elements of this degree, equally spaced within a layer."""
        return lattice(self.radii, self.counts, degree)

    def shares(self, degree: int) -> Array:
        """The same as shares of the way through the wall, from 0 to 1."""
        inner, outer = self.radii[0], self.radii[-1]
        inside = [(radius - inner) / (outer - inner) for radius in self.radii[1:-1]]
        return lattice([0.0, *inside, 1.0], self.counts, degree)

    def marked(self, domain: Domain) -> Domain:
        """The domain with its layers as regions: an element is where the middle of its radii is."""
        from remodel_fenicsx.fem import compat

        nodes = domain.mesh.geometry.x[compat.geometry_dofmap(domain.mesh)]
        radii = np.hypot(nodes[..., 0], nodes[..., 1])
        layer = np.searchsorted(self.radii[1:-1], (radii.min(axis=1) + radii.max(axis=1)) / 2)
        numbers = {name: number for number, name in enumerate(self.names, start=1)}
        return dataclasses.replace(domain, regions=numbers, element_region=(layer + 1).astype(np.int32))


def _outer(region: Region, outer_radius: float) -> float:
    return outer_radius if region.outer_radius is None else region.outer_radius


def shared_out(thicknesses: list[float], elements: int) -> tuple[int, ...]:
    """Elements for each layer, one at least: the next one always where elements are thickest."""
    counts = [1] * len(thicknesses)
    for _ in range(elements - len(counts)):
        counts[int(np.argmax(np.divide(thicknesses, counts)))] += 1
    return tuple(counts)


def lattice(ends: list[float] | tuple[float, ...], counts: tuple[int, ...], degree: int) -> Array:
    """Places of nodes between the ends of layers, equally spaced in each."""
    parts = [np.linspace(a, b, degree * n + 1) for (a, b), n in zip(itertools.pairwise(ends), counts, strict=True)]
    return np.concatenate([parts[0], *(part[1:] for part in parts[1:])])


def check_layers(inner_radius: float, outer_radius: float, elements: int, regions: Mapping[str, Region]) -> None:
    """Refuse regions that are no layers of the wall between two radii with so many elements through it.

    A layer is at least as thick as Gmsh can mesh (`length_fault`).

    Raises
    ------
    PydanticCustomError
        A `fault` that names the region's key.
    """
    seen: dict[float, str] = {}
    for name, region in regions.items():
        key, radius = f"regions.{name}.outer_radius", _outer(region, outer_radius)
        if not inner_radius < radius <= outer_radius:
            limits = f"geometry.inner_radius = {shown(inner_radius)}, at most outer_radius = {shown(outer_radius)}"
            raise fault(f"must be greater than {limits}", key, radius)
        if radius in seen:
            rule = f"regions.{seen[radius]} ends at {shown(radius)} too; each layer has an outer radius of its own"
            raise fault(rule, key, region.outer_radius)
        seen[radius] = name
    if regions and outer_radius not in seen:
        last = seen[max(seen)]
        rule = f"the outermost region ends at geometry.outer_radius = {shown(outer_radius)}, or leaves it out"
        raise fault(rule, f"regions.{last}.outer_radius", max(seen))
    if len(regions) > elements:
        rule = f"{elements} elements through the wall; {len(regions)} regions need one each: a larger mesh.refinement"
        raise fault(rule, "regions", None)
    for inside, radius in itertools.pairwise([inner_radius, *sorted(seen)]):
        key = f"regions.{seen[radius]}.outer_radius"
        if (found := length_fault({key: radius - inside, "geometry.outer_radius": outer_radius})) is not None:
            raise fault(f"the layer is {found[1]}", key, radius)
