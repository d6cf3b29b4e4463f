"""Finite elements held against the one-dimensional tube of tests/reference: for docs/verification.md.

Isotropic cells with cylindrical axes, one layer of elements along z, else the preset. The reference cannot twist, swirl
or turn its cells out of the directions circumferential, axial, radial; finite elements can, and do where the remodeling
pass amplifies a small tilt of the axes (docs/solver.md, Stability of the pass):

- driver `cauchy`, law `explicit`: never; these runs have the scene's own supports;
- drivers `pk2` and `finger`: the pass over-corrects. A swirl (pk2) or a twist (finger, frame `spatial`) changes its
  sign and grows by 1.5 and 1.9 in every pass, from rounding on, also with half the time step, and shows from about
  t = 80. These runs are held in the planes of symmetry x = 0 and y = 0, which the reference has too; `finger` also
  takes elements of degree 1, whose mesh has no difference between its nodes that would feed the next mode, and ends
  before that one shows all the same, and `pk2` no finer mesh, which would have room for the next mode;
- law `rate`: l_1 and l_2 differ where the eigenvalues cross, so the axes there turn steadily (a tilt doubles in every
  pass) before the reference, which can only exchange them, does so: around the front these are two solutions.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import dolfinx.fem
import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from remodel_fenicsx.results.columns import Measurement
from remodel_fenicsx.scene.scene import Scene, scene_from_dict
from remodel_fenicsx.simulation import Simulation
from tests.parts import tube
from tests.reference.radial import RadialHistory, solve_radial

LENGTH = 0.5
Divisions = tuple[int, int, int]
FINE: Divisions = (8, 12, 1)  # around, through the wall, along; of degree 2
CURVED: Divisions = (8, 6, 1)  # the same, cheaper


@dataclass(frozen=True)
class Setting:
    """A run that is compared: loads, remodeling, elements, supports (with planes of symmetry or the scene's) and end.

    `front` are the radii between which the angle is a steep function of the radius, pointwise errors left out.
    """

    stretch: float = 0.1
    pressure: float = 4.8
    driver: str = "cauchy"
    law: str = "explicit"
    divisions: Divisions = FINE
    degree: int = 2
    planes: bool = False
    end: float = 150.0
    front: tuple[float, float] = (1.7, 2.0)


LOAD_CASES = tuple(
    Setting(*loads) for loads in ((0.1, 0.0), (0.1, 2.4), (0.1, 4.8), (0.05, 4.8), (0.0, 4.8))
)  # Fig. 9
PK2 = Setting(driver="pk2", planes=True, divisions=(8, 8, 1))
FINGER = Setting(driver="finger", planes=True, divisions=(48, 16, 1), degree=1, end=120.0)
PK2_FREE = Setting(driver="pk2", divisions=(8, 8, 1), end=60.0)
FINGER_FREE = Setting(driver="finger", divisions=CURVED, end=75.0)
RATE = Setting(law="rate", planes=True, divisions=CURVED, front=(1.9, 2.35))
DRIVERS = (Setting(), PK2, PK2_FREE, FINGER, FINGER_FREE, RATE)
MESHES: dict[int, tuple[Divisions, ...]] = {
    1: ((8, 4, 1), (16, 8, 1), (32, 16, 1)),
    2: ((4, 2, 1), (8, 4, 1), (16, 8, 1)),
}
CONVERGENCE = {
    degree: tuple(Setting(divisions=mesh, degree=degree, end=40.0) for mesh in meshes)
    for degree, meshes in MESHES.items()
}


@dataclass(frozen=True)
class Run:
    """Radii by step; reference radius, final fibre angle and volume by quadrature point."""

    inner: np.ndarray
    outer: np.ndarray
    R: np.ndarray
    angle: np.ndarray
    volume: np.ndarray


def scene(setting: Setting) -> Scene:
    """The preset's artery, short, with isotropic cells."""
    return scene_from_dict({
        "preset": "kuhl-holzapfel-2007",
        "geometry": {"shape": "tube", "inner_radius": 1.0, "outer_radius": 3.0, "length": LENGTH},
        "mesh": {"degree": setting.degree},
        "cells": {"initial": "isotropic", "axes": "cylindrical"},
        "loads": {"pressure": {"value": setting.pressure}, "elongation": {"value": setting.stretch}},
        "remodeling": {"driver": setting.driver, "law": setting.law},
        "time": {"end": setting.end},
    })  # fmt: skip


def hold_symmetry_planes(simulation: Simulation) -> None:
    """u_x = 0 on x = 0 and u_y = 0 on y = 0: no swirl, no twist of the whole tube."""
    space, zero = simulation.unknown.function_space, PETSc.ScalarType(0.0)  # type: ignore[attr-defined]
    for component in (0, 1):
        subspace = space.sub(component)
        dofs = dolfinx.fem.locate_dofs_geometrical(
            (subspace, subspace.collapse()[0]), lambda x, i=component: np.abs(x[i]) < 1e-9
        )
        value = dolfinx.fem.Constant(simulation.domain.mesh, zero)
        simulation.loading.boundary_conditions.append(
            dolfinx.fem.dirichletbc(value, dofs[0], subspace)
        )


@lru_cache(maxsize=None)
def finite_elements(setting: Setting) -> Run:
    """The run of a setting."""
    domain = tube(
        1.0, 3.0, LENGTH, degree=setting.degree, divisions=setting.divisions, comm=MPI.COMM_SELF
    )
    simulation = Simulation(scene(setting), MPI.COMM_SELF, domain)
    if setting.planes:
        hold_symmetry_planes(simulation)
    steps = list(simulation.steps())
    inner, outer = (
        np.array([step.row[f"{face}_radius"] for step in steps]) for face in ("inner", "outer")
    )
    angle, x = (
        Measurement(simulation.observer, steps[-1]).fibre_angle,
        simulation.quadrature.coordinates,
    )
    return Run(
        inner,
        outer,
        np.hypot(x[..., 0], x[..., 1]).ravel(),
        angle.ravel(),
        simulation.quadrature.volumes.ravel(),
    )


@lru_cache(maxsize=None)
def reference(setting: Setting) -> RadialHistory:
    """The same by the one-dimensional solver."""
    return solve_radial(
        stretch=setting.stretch, pressure=setting.pressure, driver=setting.driver, law=setting.law, end=setting.end,
        elements=150,
    )  # fmt: skip


def errors(setting: Setting) -> dict[str, float]:
    """Largest relative error of a radius over all steps; errors of the final fibre angle in degrees.

    `angle_mean` is the volume mean over the wall of the absolute difference at the same radius, `angle_largest` the
    largest one, `angle_mean_outside` and `angle_outside` the same for the points outside of the setting's front.
    """
    run, exact = finite_elements(setting), reference(setting)
    angle = np.abs(run.angle - np.interp(run.R, exact.points, exact.fibre_angle()))
    outside = (run.R < setting.front[0]) | (run.R > setting.front[1])
    return {
        "angle_mean": float(np.average(angle, weights=run.volume)),
        "angle_largest": float(angle.max()),
        "angle_mean_outside": float(np.average(angle[outside], weights=run.volume[outside])),
        "angle_outside": float(angle[outside].max()),
        "inner_radius_error": float(np.max(np.abs(run.inner / exact.inner_radii - 1))),
        "outer_radius_error": float(np.max(np.abs(run.outer / exact.outer_radii - 1))),
    }
