"""Bodies that lock: a thick tube and, as shapes of their own, Cook's membrane and the bar of the cardiac benchmark.

S. Land et al., Proc. R. Soc. A 471 (2015) 20150641, problem 1: a bar of 10 x 1 x 1 mm, clamped at x = 0, bends under a
pressure of 0.004 kPa on its deformed bottom. R. D. Cook, J. Struct. Div. 100 (1974) 1851-1863: a tapered panel, clamped
on the left, sheared on the right. Importing this registers nothing; `registered` does, and takes it back.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar, Literal
from unittest.mock import patch

import numpy as np
import ufl
from mpi4py import MPI
from pydantic import Field

from remodel_fenicsx import Scene
from remodel_fenicsx.body import LoadKind, SHAPES, Shape, gmsh_model as model
from remodel_fenicsx.body.shape import Column
from remodel_fenicsx.body.domain import Domain, build_domain
from remodel_fenicsx.model.energy import MATRICES, Matrix, logarithmic_dilatation
from remodel_fenicsx.schema.units import FORCE, STRESS
from tests.values import ramped

EXACT_TUBE = 0.64144  # displacement of the inner face of the tube with J = 1, pressure 2, mu = 3.103, in plane strain


def place(m: Any, point: tuple[float, float, float], component: int) -> float:
    """Deformed coordinate of the node at a reference point, over all ranks."""
    nodes = m.state.unknown.function_space.tabulate_dof_coordinates()
    here = np.linalg.norm(nodes - point, axis=1) < 1e-6
    return float(m.domain.comm.allreduce(float(np.max(m.position[here, component], initial=-np.inf)), MPI.MAX))


class Prism(Shape):
    """A quadrilateral in the plane, extruded along z; faces x0, x1, y0, y1 and z0, z1."""

    face_names: ClassVar[tuple[str, ...]] = ("x0", "x1", "y0", "y1", "z0", "z1")
    corners: ClassVar[tuple[tuple[float, float], ...]]
    thickness: ClassVar[float]
    divisions: ClassVar[tuple[int, int, int]]
    through: ClassVar[bool]  # whether a refinement is one of the thickness too

    def build(self, mesh: Any, comm: Any = None) -> Domain:
        """Mesh it."""
        n, m, layers = self.divisions
        layers *= mesh.refinement if self.through else 1

        def draw() -> None:
            corners = model.points(np.array(self.corners))
            counts = (n * mesh.refinement, m * mesh.refinement) * 2
            lines = [model.line(corners[i], corners[(i + 1) % 4], count) for i, count in enumerate(counts)]
            section = model.block(lines, corners, mesh.element)
            sides = dict(zip(("y0", "x1", "y1", "x0"), lines, strict=True))
            model.extrude([section], self.thickness, layers, mesh.element, sides, ends=("z0", "z1"))
            model.raise_degree(mesh.degree, np.zeros_like)

        size = {"length": float(np.max(self.corners))}
        return build_domain(draw, self.name, size, comm)


class Bar(Prism):
    """The bar: x along it, z up."""

    loads: ClassVar[dict[str, LoadKind]] = {
        "pressure": LoadKind(
            lambda s, loading, name: loading.add_follower_pressure(name, "z0"), "on the bottom", STRESS
        )
    }
    columns: ClassVar[tuple[Column, ...]] = (
        Column("tip", "length", "z of the point (10, 0.5, 1)", lambda m: place(m, (10.0, 0.5, 1.0), 2)),
    )
    number_of_elements: ClassVar[int] = 80
    corners: ClassVar[tuple[tuple[float, float], ...]] = ((0.0, 0.0), (10.0, 0.0), (10.0, 1.0), (0.0, 1.0))
    thickness: ClassVar[float] = 1.0
    divisions: ClassVar[tuple[int, int, int]] = (20, 2, 2)
    through: ClassVar[bool] = True

    shape: Literal["bar"] = Field(default="bar", description="Which body it is.")

    def hold(self, loading: Any) -> None:
        """Clamped at x = 0."""
        for component in range(3):
            loading.hold_face("x0", component)


class Membrane(Prism):
    """Cook's membrane as a slab in plane strain, 1 thick."""

    loads: ClassVar[dict[str, LoadKind]] = {
        "force": LoadKind(
            lambda s, loading, name: loading.add_dead_force(name, "x1", 1), "up, on the right side", FORCE
        )
    }
    columns: ClassVar[tuple[Column, ...]] = (
        Column("tip", "length", "rise of the upper right corner", lambda m: place(m, (48.0, 60.0, 0.0), 1) - 60.0),
    )
    number_of_elements: ClassVar[int] = 16
    corners: ClassVar[tuple[tuple[float, float], ...]] = ((0.0, 0.0), (48.0, 44.0), (48.0, 60.0), (0.0, 44.0))
    thickness: ClassVar[float] = 1.0
    divisions: ClassVar[tuple[int, int, int]] = (4, 4, 1)
    through: ClassVar[bool] = False

    shape: Literal["membrane"] = Field(default="membrane", description="Which body it is.")

    def hold(self, loading: Any) -> None:
        """Clamped on the left, without strain along z."""
        for face, component in (("x0", 0), ("x0", 1), ("z0", 2), ("z1", 2)):
            loading.hold_face(face, component)


def transversely_isotropic(F: Any, lame_lambda: Any, lame_mu: Any) -> Any:
    """W = C/2 (exp Q - 1), Q = b_f E11^2 + b_t (E22^2 + E33^2 + 2 E23^2) + 2 b_fs (E12^2 + E13^2), C = mu, fibre x."""
    E = (F.T * F - ufl.Identity(3)) / 2
    along, across = 8 * E[0, 0] ** 2, 2 * (E[1, 1] ** 2 + E[2, 2] ** 2 + E[1, 2] ** 2 + E[2, 1] ** 2)
    sheared = 4 * (E[0, 1] ** 2 + E[1, 0] ** 2 + E[0, 2] ** 2 + E[2, 0] ** 2)
    return lame_mu / 2 * (ufl.exp(along + across + sheared) - 1)


@contextmanager
def registered() -> Iterator[None]:
    """Within, scenes know the two shapes and the matrix energy "cardiac"."""
    cardiac = Matrix(logarithmic_dilatation, transversely_isotropic)
    with patch.dict(SHAPES, bar=Bar, membrane=Membrane), patch.dict(MATRICES, cardiac=cardiac):
        yield


def elastic_scene(
    shape: str, mesh: dict[str, Any], material: dict[str, Any], load: tuple[str, float], steps: int
) -> Scene:
    """A body without chains, its load applied in equal steps."""
    return Scene(
        geometry={"shape": shape},
        mesh=mesh,
        material={"chain_density": 0.0, **material},
        loads=ramped(float(steps), **dict([load])),
        remodeling={"law": "none"},
        time={"end": float(steps)},
    )


def bar_scene(ratio: float = 1e3, steps: int = 10, **mesh: Any) -> Scene:
    """The benchmark's bar: C = 2 kPa, pressure 0.004 kPa, lambda = ratio C."""
    material = {"matrix": "cardiac", "lame_mu": 2.0, "lame_lambda": 2.0 * ratio, "stress_unit": "kPa"}
    return elastic_scene("bar", mesh, material, ("pressure", 0.004), steps)


def membrane_scene(ratio: float = 1e4, steps: int = 4, **mesh: Any) -> Scene:
    """Cook's membrane: mu = 80.194, a force of 100 on the right side, lambda = ratio mu."""
    material = {"lame_mu": 80.194, "lame_lambda": 80.194 * ratio}
    return elastic_scene("membrane", mesh, material, ("force", 100.0), steps)


def thick_tube(ratio: float, formulation: str, pressure: float = 2.0, **material: Any) -> Scene:
    """The tube in plane strain, its pressure applied in four steps; no chains unless they are asked for."""
    return Scene(
        geometry={"shape": "tube", "inner_radius": 1.0, "outer_radius": 3.0, "length": 1.0},
        mesh={"formulation": formulation},
        material={"lame_mu": 3.103, "lame_lambda": 3.103 * ratio, "chain_density": 0.0, **material},
        cells={"initial": "isotropic"},
        loads=ramped(4.0, pressure=pressure, elongation=0.0),
        remodeling={"law": "none"},
        time={"end": 4.0},
        solver={"method": "direct"},
    )
