"""Bodies and loads that scenes do not have, as a script of a user's adds them (tests/body/test_extensions.py)."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal

import dolfinx.fem
import numpy as np
from pydantic import Field

from remodel_fenicsx.body import SHAPES, Cube, LoadKind
from remodel_fenicsx.body.shape import Column, uniaxial_columns
from remodel_fenicsx.body.domain import Domain
from remodel_fenicsx.body.tendon import Tendon
from remodel_fenicsx.schema.units import FORCE, LENGTH


def dead_force(component: int) -> LoadKind:
    """A dead force along an axis on the cube's far face."""
    axis = "xyz"[component]
    return LoadKind(
        lambda shape, loading, name: loading.add_dead_force(name, f"{axis}1", component),
        f"total dead force along {axis}",
        FORCE,
    )


class Block(Cube):
    """The sliding cube under forces along all three axes, perhaps flat, perhaps of bad elements."""

    loads: ClassVar[dict[str, LoadKind]] = {f"force_{axis}": dead_force(i) for i, axis in enumerate("xyz")}
    shape: Literal["block"] = Field(default="block", description="Which body it is.")
    aspect: Annotated[float, LENGTH] = Field(default=1.0, gt=0, description="Side over the thickness along x.")
    distortion: float = Field(default=0.0, ge=0, description="Of the node inside: 1 flattens the Jacobian to zero.")

    def build(self, mesh: Any, comm: Any = None) -> Domain:
        """The cube's mesh, moved."""
        return distorted(super().build(mesh, comm), self.shape, self.side, self.distortion, self.aspect)


def distorted(domain: Domain, shape: str, side: float, distortion: float, aspect: float = 1.0) -> Domain:
    """The mesh with the node at its centre moved along the diagonal, then flattened along x."""
    x = domain.mesh.geometry.x
    inside = np.linalg.norm(x - side / 2, axis=1) < 1e-9 * side
    x[inside] += distortion * side / 6
    x[:, 0] /= aspect
    return replace(domain, shape=shape)


class Affine:
    """A displacement u = H X of all boundary nodes, that loads are entries of."""

    def __init__(self, loading: Any):
        self.gradient, self.loading = np.zeros((3, 3)), loading
        self.values = dolfinx.fem.Function(loading.space)
        mesh = loading.domain.mesh
        facets = loading.domain.facet_tags.indices
        dofs = dolfinx.fem.locate_dofs_topological(loading.space, mesh.topology.dim - 1, facets)
        loading.boundary_conditions.append(dolfinx.fem.dirichletbc(self.values, dofs))

    def entry(self, name: str, i: int, j: int) -> None:
        """The load of this name is the entry H_ij."""
        affine = self

        class Entry:
            """What `Loading.set` sets."""

            @property
            def value(self) -> float:
                return float(affine.gradient[i, j])

            @value.setter
            def value(self, value: float) -> None:
                affine.gradient[i, j] = value
                affine.values.interpolate(lambda x: affine.gradient @ x)

        self.loading.magnitude(name)
        self.loading._magnitudes[name] = [(Entry(), 1.0)]  # a Constant cannot be a field


class Driven(Cube):
    """A block whose whole boundary has a given deformation gradient F = I + H: a patch test that remodels."""

    loads: ClassVar[dict[str, LoadKind]] = {
        f"h_{a}{b}": LoadKind(
            lambda shape, loading, name, i=i, j=j: shape.affine(loading).entry(name, i, j), f"H_{a}{b} of the boundary"
        )
        for i, a in enumerate("xyz")
        for j, b in enumerate("xyz")
    }
    columns: ClassVar[tuple[Column, ...]] = uniaxial_columns("z1", "side")[-1:]
    shape: Literal["driven"] = Field(default="driven", description="Which body it is.")
    distortion: float = Field(default=0.0, ge=0, description="Of the node inside: 1 flattens the Jacobian to zero.")

    def affine(self, loading: Any) -> Affine:
        """One for all loads of a body."""
        found = getattr(loading, "affine", None)
        if found is None:
            found = loading.affine = Affine(loading)
        return found

    def hold(self, loading: Any) -> None:
        """The loads hold all of it."""

    def build(self, mesh: Any, comm: Any = None) -> Domain:
        """The cube's mesh, moved."""
        return distorted(super().build(mesh, comm), self.shape, self.side, self.distortion)


class Twisted(Tendon):
    """A tendon that is clamped at its bottom, while its top is turned about z and lifted as a rigid plate."""

    loads: ClassVar[dict[str, LoadKind]] = {
        "twist": LoadKind(lambda shape, loading, name: turn_top(loading, name), "angle of the top in radians"),
        "elongation": LoadKind(
            lambda shape, loading, name: loading.add_prescribed_elongation(name, "top", 2, shape.length),
            "engineering strain of the length",
        ),
    }
    columns: ClassVar[tuple[Column, ...]] = uniaxial_columns("top", "length")[-1:]
    shape: Literal["twisted"] = Field(default="twisted", description="Which body it is.")

    def build(self, mesh: Any, comm: Any = None) -> Domain:
        """The tendon's mesh."""
        return replace(super().build(mesh, comm), shape=self.shape)

    def hold(self, loading: Any) -> None:
        """The bottom, wholly."""
        for component in range(3):
            loading.hold_face("bottom", component)


def turn_top(loading: Any, name: str) -> None:
    """Prescribe x and y of the top: a rotation by the load of this name."""
    facets = loading.domain.facet_tags.find(loading.domain.faces["top"])
    parts = []
    for component in (0, 1):
        space = loading.space.sub(component)
        collapsed = space.collapse()[0]
        parts.append(dolfinx.fem.Function(collapsed))
        dofs = dolfinx.fem.locate_dofs_topological((space, collapsed), 2, facets)
        loading.boundary_conditions.append(dolfinx.fem.dirichletbc(parts[-1], dofs, space))

    class Angle:
        """What `Loading.set` sets."""

        _value = 0.0

        @property
        def value(self) -> float:
            return self._value

        @value.setter
        def value(self, angle: float) -> None:
            self._value, c, s = angle, np.cos(angle) - 1, np.sin(angle)
            parts[0].interpolate(lambda x: c * x[0] - s * x[1])
            parts[1].interpolate(lambda x: s * x[0] + c * x[1])

    loading.magnitude(name)
    loading._magnitudes[name] = [(Angle(), 1.0)]  # a Constant cannot be a field


def register() -> None:
    """Scenes know these shapes from now on."""
    SHAPES.update({"block": Block, "driven": Driven, "twisted": Twisted})
