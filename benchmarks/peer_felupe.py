"""The artery of `benchmarks/peers.py` in FElupe, as one of its users would write it: run by that command, not by hand.

    python3 peer_felupe.py PROBLEM.npz STEPS TOLERANCE RESULT.npz tensortrax|jax

PROBLEM has the mesh, the cells before the first pass, the numbers of the material and of the loads. W is differentiated
by tensortrax, and SciPy solves the linear systems; or by jax (compiled, double precision), and MKL's Pardiso solves
them. The follower pressure and Newton's method are FElupe's. The pass is eqs. (8) to (11) of the paper, typed here. It
imports nothing of this project.
"""

from __future__ import annotations

import importlib
import sys
import warnings
from functools import partial
from typing import Any

import felupe
import numpy as np

# What differentiates W, its functions of tensors, and what solves the linear systems
PARTS = {
    "tensortrax": ("felupe.constitution.tensortrax", "tensortrax.math", "scipy.sparse.linalg"),
    "jax": ("felupe.constitution.jax", "jax.numpy", "pypardiso"),
}


def energy(
    tm: Any,
    C: Any,
    cells: Any,
    mu: float,
    lmbda: float,
    modulus: float,
    contour: float,
    initial: float,
) -> Any:
    """W of eqs. (4) and (6) per reference volume, of the energy factor 1; `cells`: three lengths, then three axes."""
    squared, repulsion = 0.0, 0.0
    for i in range(3):
        n = cells[3 + 3 * i : 6 + 3 * i]
        stretch = sum(n[a] * n[b] * C[a, b] for a in range(3) for b in range(3))
        squared = squared + cells[i] ** 2 * stretch
        repulsion = repulsion + cells[i] ** 2 * tm.log(stretch)
    x, x0 = tm.sqrt(squared) / contour, initial / contour
    chains = contour / 4 * (2 * x**2 + 1 / (1 - x) - x)
    slope = (1 + (2 - x0) / (4 * (1 - x0) ** 2)) / contour
    volume = tm.log(tm.linalg.det(C)) / 2
    matrix = lmbda / 2 * volume**2 - mu * volume + mu / 2 * (tm.trace(C) - 3)
    return matrix + modulus * (chains - slope / 2 * repulsion), cells


def remodeled(cells: Any, first: Any, cauchy: Any, grown: float, initial: float) -> Any:
    """The pass: axes along the principal stresses, lengths towards r0 times the direction of the positive ones."""
    values, vectors = np.linalg.eigh(np.moveaxis(cauchy, (0, 1), (-2, -1)))
    values, vectors = values[..., ::-1], vectors[..., ::-1]
    positive = np.maximum(values, 0.0)
    size = np.linalg.norm(positive, axis=-1, keepdims=True)
    target = initial * positive / np.where(size > 0, size, 1.0)
    lengths = np.moveaxis(first, 0, -1)
    lengths = lengths + (target - lengths) * grown
    axes = np.swapaxes(vectors, -1, -2).reshape(*lengths.shape[:-1], 9)
    new = np.moveaxis(np.concatenate([lengths, axes], axis=-1), -1, 0)
    return np.where(size[..., 0] > 0, new, cells)


class Tube:
    """The body, its supports and what changes from step to step."""

    def __init__(self, given: Any, parts: str):
        constitution, math, systems = (importlib.import_module(name) for name in PARTS[parts])
        self.given, self.solve = given, systems.spsolve
        mesh = felupe.Mesh(given["points"], given["elements"], "hexahedron")
        region = felupe.RegionHexahedron(mesh)
        self.field = felupe.FieldContainer([felupe.Field(region, dim=3)])
        names = ("mu", "lmbda", "modulus", "contour", "initial")
        material = constitution.Hyperelastic(
            partial(energy, math), nstatevars=12, **{name: float(given[name]) for name in names}
        )
        self.cells = self.cells_before(region)
        self.first = self.cells[:3].copy()
        self.solid = felupe.SolidBody(material, self.field, statevars=self.cells)
        inside = np.isclose(np.hypot(*mesh.points[:, :2].T), given["inner_radius"])
        face = felupe.RegionHexahedronBoundary(mesh, only_surface=True, mask=inside)
        self.pressure = felupe.SolidBodyPressure(felupe.FieldContainer([felupe.Field(face, dim=3)]))
        self.inside = inside
        self.held, self.drawn = held_and_drawn(mesh.points, given)

    def cells_before(self, region: Any) -> Any:
        """One draw of lengths for each element; circumferential, axial and radial axes at its points."""
        places = felupe.Field(region, dim=3, values=region.mesh.points).interpolate()
        cells = np.zeros((12, *places.shape[1:]))
        cells[:3] = self.given["lengths"].T[:, None, :]
        cosine, sine = places[:2] / np.hypot(*places[:2])
        cells[3], cells[4], cells[8], cells[9], cells[10] = -sine, cosine, 1.0, cosine, sine
        return cells

    def step(self, time: float, tolerance: float) -> int:
        """Solve, then remodel; the number of iterations."""
        given = self.given
        factor = min(time / float(given["ramp"]), 1.0)
        self.pressure.update(float(given["pressure"]) * factor)
        prescribed = np.concatenate([self.held, self.drawn])
        values = np.concatenate(
            [np.zeros(len(self.held)), np.full(len(self.drawn), float(given["drawn"]) * factor)]
        )
        order = np.argsort(prescribed)
        prescribed, values = prescribed[order], values[order]
        free = np.setdiff1d(np.arange(self.field[0].values.size), prescribed)
        items = [self.solid, self.pressure]
        solved = felupe.newtonraphson(
            items=items, dof0=prescribed, dof1=free, ext0=values, tol=tolerance, maxiter=30, verbose=0,
            solver=self.solve,
        )  # fmt: skip
        self.field = solved.x
        grown = -np.expm1(-float(given["kappa"]) * time)
        cauchy = self.solid.evaluate.cauchy_stress(self.field)
        self.cells = remodeled(self.cells, self.first, cauchy, grown, float(given["initial"]))
        self.solid.results.statevars = self.cells
        return int(solved.iterations)


def held_and_drawn(points: Any, given: Any) -> tuple[Any, Any]:
    """Unknowns that are zero, and those of the end that is drawn along z."""
    x, y, z = points.T
    inner = float(given["inner_radius"])
    held = [3 * np.flatnonzero(np.isclose(z, 0.0)) + 2]
    for place, component in (((inner, 0, 0), 1), ((-inner, 0, 0), 1), ((0, inner, 0), 0)):
        held.append(
            3 * np.flatnonzero(np.isclose(points, place, atol=1e-9).all(axis=1)) + component
        )
    return np.concatenate(held), 3 * np.flatnonzero(np.isclose(z, float(given["length"]))) + 2


def main(problem: str, steps: str, tolerance: str, result: str, parts: str) -> None:
    """Run, write the displacement and the number of iterations."""
    if parts == "jax":
        importlib.import_module("jax").config.update("jax_enable_x64", True)
    warnings.simplefilter(
        "error", RuntimeWarning
    )  # a chain at its full length: no number may come of it
    tube, iterations = Tube(np.load(problem), parts), 0
    for number in range(1, int(steps) + 1):
        iterations += tube.step(float(number), float(tolerance))
    np.savez(result, displacement=tube.field[0].values, iterations=iterations)


if __name__ == "__main__":
    main(*sys.argv[1:])
