"""The unloaded tube of a loaded one: radii and length.

They are found by runs of the scene's own kinematics, so that the run that follows comes to the given numbers: a fixed
point in the targets of inverse elastostatics of one radius (`model.closing`).
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.model.closing import Loads, closing
from remodel_fenicsx.results.fields import NodalGather
from remodel_fenicsx.scene import Scene
from remodel_fenicsx.settings import AS_GIVEN, EQUILIBRIUM, Natural
from remodel_fenicsx.simulation import Simulation
from remodel_fenicsx.unloading.failure import in_shares

log = logging.getLogger(__name__)
Array = NDArray[np.float64]

LOADED_AGAIN = 1e-9  # of the largest length: how far the loaded numbers may be from those of the scene
MOST_LOADINGS = 30  # runs for one share of the loads
REMEMBERED = 5  # differences of earlier runs from which the next is guessed (Anderson 1965)
LOAD_STEPS = 10  # of a run to the end of the ramps


def unloaded_tube(scene: Scene, comm: MPI.Intracomm) -> Scene:
    """By fixed-point iteration for the targets of inverse elastostatics, with Anderson's extrapolation."""
    shape: Any = scene.geometry
    names = sorted((n for n in scene.regions if scene.regions[n].outer_radius), key=lambda n: _outer(scene, n))
    inside = [_outer(scene, name) for name in names if _outer(scene, name) < shape.outer_radius]
    given = np.array([shape.inner_radius, *inside, shape.outer_radius, shape.length])
    runs = 0

    def find(share: float, start: Array) -> Array:
        nonlocal runs
        found, number = _found(scene, comm, given, share, start)
        runs += number
        return found

    found = in_shares(find, given)
    geometry = _with_numbers(scene, found)
    unloaded, loaded = (f"radii {', '.join(f'{r:.6g}' for r in radii)}, length {l:.6g}" for *radii, l in (found, given))
    log.info("unloaded: %s, so that under the loads it has the given %s (%d runs)", unloaded, loaded, runs)
    return geometry


def _outer(scene: Scene, name: str) -> float:
    outer: Any = scene.regions[name].outer_radius
    return float(outer)


def _found(scene: Scene, comm: MPI.Intracomm, given: Array, share: float, start: Array) -> tuple[Array, int]:
    """Radii and length that a share of the loads brings to the given ones, and how many runs that took.

    Raises
    ------
    ArithmeticError, StepFailure, SceneError
        If they are not found.
    """
    target, targets, errors = given.copy(), [], []
    length = start[-1]
    for number in range(1, MOST_LOADINGS + 1):
        numbers = _inverse(scene, target, share, given[-1] / length)
        found = _loaded(scene, comm, numbers, share)
        length = numbers[-1] * given[-1] / found[-1]
        error = given - found
        if np.abs(error).max() <= LOADED_AGAIN * given.max():
            return numbers, number
        targets.append(target)
        errors.append(error)
        target = _extrapolated(targets[-REMEMBERED:], errors[-REMEMBERED:])
    raise ArithmeticError(f"off by {np.abs(error).max():.2g} after {MOST_LOADINGS} runs")


def _extrapolated(targets: list[Array], errors: list[Array]) -> Array:
    """Where the error, were it linear in the target, would be least; then on by what is left of it."""
    target, error = targets[-1], errors[-1]
    if len(targets) == 1:
        return target + error
    steps = np.stack([target - earlier for earlier in targets[:-1]], axis=1)
    changes = np.stack([error - earlier for earlier in errors[:-1]], axis=1)
    weights = np.linalg.lstsq(changes, error, rcond=1e-10)[0]
    found: Array = target + error - (steps + changes) @ weights
    return found


def _inverse(scene: Scene, target: Array, share: float, axial: float) -> Array:
    """Unloaded radii and length of a tube with these loaded ones, whose mesh is free of stress; on one radius.

    Raises
    ------
    ArithmeticError
        If there are none.
    """
    loaded = _with_numbers(scene, target)
    tissues = {name: properties.tissue for name, properties in scene.properties().items()}
    layers = loaded.geometry.layers_of_tissue(Natural(), loaded.regions, tissues)
    pressure = scene.loads["pressure"] if "pressure" in scene.loads else None
    value = 0.0 if pressure is None else pressure.value * pressure.factor(scene.end_of_ramps) * share
    radii = closing(layers, 0.0, Loads(value, None, axial)).natural_radius(target[:-1])
    return np.append(radii, target[-1] / axial)


def _loaded(scene: Scene, comm: MPI.Intracomm, numbers: Array, share: float) -> Array:
    """Radii and length under a share of the loads, as a run has them."""
    end = scene.end_of_ramps or 1.0
    changes: dict[str, Any] = {"output.columns": [], "output.times": [], "output.fields": False}
    if scene.natural.cells == AS_GIVEN:
        changes |= {"remodeling.law": "none", "remodeling.coupling": "staggered", "remodeling.threshold": 0.0}
        changes |= {"remodeling.turnover": {}}
        changes |= {"remodeling.exponent": 2.0, "time.end": end, "time.step": end / LOAD_STEPS, "time.tolerance": None}
    else:
        changes |= {"time.end": EQUILIBRIUM}
    changes |= {"solver.relative_tolerance": min(scene.solver.relative_tolerance, LOADED_AGAIN / 10)}
    for name, load in scene.loads.items():
        changes |= {f"loads.{name}.value": load.value * load.factor(end) * share}
        changes |= {f"loads.{name}.ramp": [[0.0, 0.0], [end, 1.0]]}
    simulation = Simulation(_with_numbers(scene, numbers).with_values(changes), comm)
    try:
        row = [step.row for step in simulation.steps()][-1]
        domain = simulation.domain
        places, moves = domain.gather_nodes(domain.mesh.geometry.x), NodalGather(domain, simulation.state)()
    finally:
        simulation.close()
    radii = None
    if places is not None and moves is not None:
        before, after = (np.hypot(x[:, 0], x[:, 1]) for x in (places, places + moves))
        radii = np.array([after[np.abs(before - radius) < 1e-6 * numbers.max()].mean() for radius in numbers[:-1]])
    found: Array = comm.bcast(radii)
    return np.append(found, numbers[-1] * (1 + row["axial_elongation"]))


def _with_numbers(scene: Scene, numbers: Array) -> Scene:
    """The scene of an unloaded tube of these radii, from the lumen outwards, and this length."""
    changes: dict[str, Any] = {"geometry.is": "unloaded", "natural.cells": AS_GIVEN}
    changes |= {"geometry.inner_radius": float(numbers[0]), "geometry.outer_radius": float(numbers[-2])}
    changes |= {"geometry.length": float(numbers[-1])}
    said = [name for name in scene.regions if scene.regions[name].outer_radius is not None]
    for name, radius in zip(sorted(said, key=lambda n: _outer(scene, n)), numbers[1:-1], strict=False):
        changes[f"regions.{name}.outer_radius"] = float(radius)
    return scene.with_values(changes)
