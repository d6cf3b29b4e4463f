"""Bodies that lock: a thick tube and, as a shape of its own, the bar of the cardiac benchmark.

S. Land et al., Proc. R. Soc. A 471 (2015) 20150641, problem 1: a bar of 10 x 1 x 1 mm, clamped at x = 0, bends under a
pressure of 0.004 kPa on its deformed bottom. Importing this registers nothing; `registered` does, and takes it back.
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
from remodel_fenicsx.schema.units import STRESS
from tests.values import ramped

EXACT_TUBE = 0.64144  # displacement of the inner face of the tube with J = 1, pressure 2, mu = 3.103, in plane strain


def place(m: Any, point: tuple[float, float, float], component: int) -> float:
    """Deformed coordinate of the node at a reference point, over all ranks."""
    nodes = m.state.unknown.function_space.tabulate_dof_coordinates()
    here = np.linalg.norm(nodes - point, axis=1) < 1e-6
    return float(
        m.domain.comm.allreduce(
            float(np.max(m.position[here, component], initial=-np.inf)), MPI.MAX
        )
    )


class Bar(Shape):
    """The bar: x along it, z up; faces x0, x1, y0, y1 and z0, z1."""

    face_names: ClassVar[tuple[str, ...]] = ("x0", "x1", "y0", "y1", "z0", "z1")
    loads: ClassVar[dict[str, LoadKind]] = {
        "pressure": LoadKind(
            lambda s, loading, name: loading.add_follower_pressure(name, "z0"),
            "on the bottom",
            STRESS,
        )
    }
    columns: ClassVar[tuple[Column, ...]] = (
        Column(
            "tip", "length", "z of the point (10, 0.5, 1)", lambda m: place(m, (10.0, 0.5, 1.0), 2)
        ),
    )
    number_of_elements: ClassVar[int] = 80

    shape: Literal["bar"] = Field(default="bar", description="Which body it is.")

    def build(self, mesh: Any, comm: Any = None) -> Domain:
        """Mesh it: 20 x 2 x 2 elements, times the refinement."""
        along, across = 20 * mesh.refinement, 2 * mesh.refinement

        def draw() -> None:
            corners = model.points(np.array([(0.0, 0.0), (10.0, 0.0), (10.0, 1.0), (0.0, 1.0)]))
            counts = (along, across) * 2
            lines = [
                model.line(corners[i], corners[(i + 1) % 4], count)
                for i, count in enumerate(counts)
            ]
            section = model.block(lines, corners, mesh.element)
            sides = dict(zip(("y0", "x1", "y1", "x0"), lines, strict=True))
            model.extrude([section], 1.0, across, mesh.element, sides, ends=("z0", "z1"))
            model.raise_degree(mesh.degree, np.zeros_like)

        return build_domain(draw, self.name, {"length": 10.0}, comm)

    def hold(self, loading: Any) -> None:
        """Clamped at x = 0."""
        for component in range(3):
            loading.hold_face("x0", component)


def transversely_isotropic(F: Any, lame_lambda: Any, lame_mu: Any) -> Any:
    """W = C/2 (exp Q - 1), Q = b_f E11^2 + b_t (E22^2 + E33^2 + 2 E23^2) + 2 b_fs (E12^2 + E13^2), C = mu, fibre x."""
    E = (F.T * F - ufl.Identity(3)) / 2
    along, across = 8 * E[0, 0] ** 2, 2 * (
        E[1, 1] ** 2 + E[2, 2] ** 2 + E[1, 2] ** 2 + E[2, 1] ** 2
    )
    sheared = 4 * (E[0, 1] ** 2 + E[1, 0] ** 2 + E[0, 2] ** 2 + E[2, 0] ** 2)
    return lame_mu / 2 * (ufl.exp(along + across + sheared) - 1)


@contextmanager
def registered() -> Iterator[None]:
    """Within, scenes know the shape and the matrix energy "cardiac"."""
    cardiac = Matrix(logarithmic_dilatation, transversely_isotropic)
    with patch.dict(SHAPES, bar=Bar), patch.dict(MATRICES, cardiac=cardiac):
        yield


def bar_scene(**mesh: Any) -> Scene:
    """The benchmark's bar: C = 2 kPa, pressure 0.004 kPa in ten steps, lambda = 1000 C."""
    material = {
        "matrix": "cardiac",
        "lame_mu": 2.0,
        "lame_lambda": 2000.0,
        "stress_unit": "kPa",
        "chain_density": 0.0,
    }
    return Scene(
        geometry={"shape": "bar"}, mesh=mesh, material=material, loads=ramped(10.0, pressure=0.004),
        remodeling={"law": "none"}, time={"end": 10.0},
    )  # fmt: skip


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
