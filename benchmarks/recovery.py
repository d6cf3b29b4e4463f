#!/usr/bin/env python3
"""Whether `fit` finds six numbers again in noisy measurements that the model made: minima, bands, runs, seconds.

    ./with-fenicsx benchmarks/recovery.py [--starts 12] [--draws 20]

A tube on one radius, 46 data: an inflation of virgin tissue (radius, force), radii and fibre angles over time, and an
inflation of the tissue that has remodeled. Standard deviations: radii 1 %, forces 5 % of the largest, angles 5 degrees.
docs/fit.md has the figures.
"""

from __future__ import annotations

import argparse
import time as clock
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx import Scene, preset_scene
from remodel_fenicsx.studies.fit import (
    PROFILE_TOLERANCE,
    Fit,
    Measured,
    Problem,
    Unknown,
    minimised,
    result_of,
)

Array = NDArray[np.float64]

TRUTH = {
    "material.lame_lambda": 10.0,
    "material.lame_mu": 2.0,
    "material.chain_density": 3e21,
    "material.contour_length": 2.0,
    "remodeling.kappa": 0.05,
    "scale.pressure": 1.0,
}
PRESSURES = np.array([0.2, 0.4, 0.6, 0.8, 1.0])
VIRGIN_PRESSURES = np.array([0.1, *PRESSURES])
TIMES = np.array([5.0, 10.0, 20.0, 30.0, 45.0, 60.0])
RADIUS, FORCE, ANGLE = (
    0.01,
    0.05,
    5.0,
)  # standard deviations: shares of the radius and of the largest force, degrees
FACTOR = 2.0  # of the starts, to both sides


def tube() -> Scene:
    """A vessel with isotropic cells and the true numbers."""
    values = {
        "cells.initial": "isotropic", "model.kinematics": "radial", "geometry.outer_radius": 1.4, "mesh.degree": 2,
        "loads.pressure.value": 1.0, "geometry.length": 3.0, "time.end": 60.0, "geometry.length_unit": "mm",
    }  # fmt: skip
    numbers = {key: value for key, value in TRUTH.items() if not key.startswith("scale.")}
    return preset_scene("consistent", "tube").with_values(values | numbers)


def unknowns(factors: Array) -> dict[str, Unknown]:
    """Those of `TRUTH`, from starts off by factors."""
    pairs = zip(TRUTH.items(), factors, strict=True)
    return {
        key: Unknown(start=value * factor, lower=value / 1e2, upper=value * 1e2)
        for (key, value), factor in pairs
    }


def tables(scene: Scene) -> list[Measured]:
    """46 data without noise."""

    def table(state: str, along: str, places: Array, *names: str, time: float = 0.0) -> Measured:
        columns = {along: places} | dict.fromkeys(names, np.zeros(len(places)))
        loads, scaled = ((), ()) if along == "time" else ((along,), (along,))
        return Measured(state, state, time, columns, loads, dict.fromkeys(names, 1.0), scaled, {})

    passive = ("outer_radius", "reduced_axial_force")
    angles = ("fibre_angle_inner", "fibre_angle_middle", "fibre_angle_outer")
    found = [
        table("virgin", "pressure", VIRGIN_PRESSURES, *passive),
        table("history", "time", TIMES, "inner_radius", *angles),
        table("after", "pressure", PRESSURES, *passive, time=60.0),
    ]
    return filled(scene, found)


def filled(scene: Scene, empty: list[Measured]) -> list[Measured]:
    """The tables with what the model says, and standard deviations."""
    problem = Problem(scene, unknowns(np.ones(len(TRUTH))), empty)
    said = problem.predictions(np.log(list(TRUTH.values())))
    return [
        replace(
            one,
            columns=one.columns | modelled,
            sd={name: _sd(name, modelled[name]) for name in one.sd},
        )
        for one, modelled in zip(empty, said, strict=True)
    ]


def _sd(name: str, values: Array) -> float:
    if "angle" in name:
        return ANGLE
    return FORCE * float(np.abs(values).max()) if "force" in name else RADIUS * float(values.mean())


def noisy(tables_: list[Measured], random: np.random.Generator) -> list[Measured]:
    """With an error of each datum."""
    return [
        replace(
            one,
            columns=one.columns
            | {n: one.columns[n] + sd * random.normal(size=one.rows) for n, sd in one.sd.items()},
        )
        for one in tables_
    ]


def fitted(scene: Scene, data: list[Measured], factors: Array) -> tuple[Fit, float]:
    """One fit from one start, and its seconds of one processor."""
    began = clock.process_time()
    problem = Problem(scene, unknowns(factors), data)
    rough = minimised(
        problem,
        np.log([unknown.start for unknown in problem.unknowns.values()]),
        enough=PROFILE_TOLERANCE,
    )
    return result_of(problem, [minimised(problem, rough.x)]), clock.process_time() - began


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--starts", type=int, default=12)
    parser.add_argument("--draws", type=int, default=20)
    options = parser.parse_args()
    scene, random = tube(), np.random.default_rng(1)
    clean, truth = tables(scene), np.array(list(TRUTH.values()))
    count = sum(one.rows * len(one.sd) for one in clean)
    data = noisy(clean, random)
    print(f"{count} data, {len(TRUTH)} unknowns")
    ends: list[tuple[Fit, float]] = []
    for _ in range(options.starts):
        factors = np.exp(random.uniform(-np.log(FACTOR), np.log(FACTOR), len(TRUTH)))
        ends.append(fitted(scene, data, factors))
        print(f"  start: {_line(*ends[-1])}")
    least = min(end.minima[0] for end, _ in ends)
    same = sum(end.minima[0] - least < 1e-2 * max(least, 1.0) for end, _ in ends)
    inside: Any = np.zeros(len(TRUTH), dtype=int)
    for _ in range(options.draws):
        ends.append(fitted(scene, noisy(clean, random), np.ones(len(TRUTH))))
        found = ends[-1][0]
        inside += (found.band[0] <= np.log(truth)) & (np.log(truth) <= found.band[1])
        print(f"  draw: {_line(*ends[-1])}")
    last = ends[0][0]
    print(f"{same} of {options.starts} starts end in one minimum")
    for key, covered, low, high in zip(TRUTH, inside, *np.exp(last.band), strict=True):
        print(
            f"{key}: the band covers the truth in {covered} of {options.draws}; +-{50 * np.log(high / low):.0f} %"
        )
    print(
        f"most runs {max(len(end.problem.known) for end, _ in ends)}, most seconds {max(s for _, s in ends):.1f}"
    )


def _line(found: Fit, seconds: float) -> str:
    return f"sum of squares {found.minima[0]:.4f}, {len(found.problem.known)} runs, {seconds:.2f} s"


if __name__ == "__main__":
    main()
