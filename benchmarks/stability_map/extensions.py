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

    loads: ClassVar[dict[str, LoadKind]] = {
        f"force_{axis}": dead_force(i) for i, axis in enumerate("xyz")
    }
    shape: Literal["block"] = Field(default="block", description="Which body it is.")
    aspect: Annotated[float, LENGTH] = Field(
        default=1.0, gt=0, description="Side over the thickness along x."
    )
    distortion: float = Field(
        default=0.0, ge=0, description="Of the node inside: 1 flattens the Jacobian to zero."
    )

    def build(self, mesh: Any, comm: Any = None) -> Domain:
        """The cube's mesh, moved."""
        domain = super().build(mesh, comm)
        x = domain.mesh.geometry.x
        inside = np.linalg.norm(x - self.side / 2, axis=1) < 1e-9 * self.side
        x[inside] += self.distortion * self.side / 6  # the node at the centre, along the diagonal
        x[:, 0] /= self.aspect
        return replace(domain, shape=self.shape)


def prescribed(loading: Any, face: str | None = None, component: int | None = None) -> Any:
    """A function whose values all or one component of a face, or of the whole boundary, take."""
    tags = loading.domain.facet_tags
    facets = tags.indices if face is None else tags.find(loading.domain.faces[face])
    dimension, space = loading.domain.mesh.topology.dim - 1, loading.space
    if component is None:
        values = dolfinx.fem.Function(space)
        condition = dolfinx.fem.dirichletbc(
            values, dolfinx.fem.locate_dofs_topological(space, dimension, facets)
        )
    else:
        part = space.sub(component)
        values = dolfinx.fem.Function(part.collapse()[0])
        dofs = dolfinx.fem.locate_dofs_topological((part, values.function_space), dimension, facets)
        condition = dolfinx.fem.dirichletbc(values, dofs, part)
    loading.boundary_conditions.append(condition)
    return values


def entry_of_gradient(i: int, j: int) -> LoadKind:
    """H_ij of u = H X on the whole boundary."""

    def add(shape: Any, loading: Any, name: str) -> None:
        if not hasattr(loading, "affine"):  # one for all loads of a body
            loading.affine = np.zeros((3, 3)), prescribed(loading)
        gradient, values = loading.affine

        def take(value: float) -> None:
            gradient[i, j] = value
            values.interpolate(lambda x: gradient @ x)

        loading.follow(name, take)

    return LoadKind(add, f"H_{'xyz'[i]}{'xyz'[j]} of the boundary")


class Driven(Block):
    """A block whose whole boundary has a given deformation gradient F = I + H: a patch test that remodels."""

    loads: ClassVar[dict[str, LoadKind]] = {
        f"h_{a}{b}": entry_of_gradient(i, j)
        for i, a in enumerate("xyz")
        for j, b in enumerate("xyz")
    }
    columns: ClassVar[tuple[Column, ...]] = uniaxial_columns("z1", "side")[-1:]
    shape: Literal["driven"] = Field(default="driven", description="Which body it is.")

    def hold(self, loading: Any) -> None:
        """The loads hold all of it."""


def turn_top(shape: Any, loading: Any, name: str) -> None:
    """Prescribe x and y of the top: a rotation by the load of this name."""
    along, across = (prescribed(loading, "top", component) for component in (0, 1))

    def take(angle: float) -> None:
        c, s = np.cos(angle) - 1, np.sin(angle)
        along.interpolate(lambda x: c * x[0] - s * x[1])
        across.interpolate(lambda x: s * x[0] + c * x[1])

    loading.follow(name, take)


class Twisted(Tendon):
    """A tendon that is clamped at its bottom, while its top is turned about z and lifted as a rigid plate."""

    loads: ClassVar[dict[str, LoadKind]] = {
        "twist": LoadKind(turn_top, "angle of the top in radians"),
        "elongation": LoadKind(
            lambda shape, loading, name: loading.add_prescribed_elongation(
                name, "top", 2, shape.length
            ),
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


def register() -> None:
    """Scenes know these shapes from now on."""
    SHAPES.update({"block": Block, "driven": Driven, "twisted": Twisted})
