#!/usr/bin/env python3
"""What reduced kinematics save: processor time of the artery's steps for each of them, in one paired run.

    ./with-fenicsx benchmarks/kinematics.py [--steps N] [--rounds N] [--without-full]

The preset's tube with isotropic cells, its ramp and a part of the hold, every tangent factorised. Only solving and
remodeling count: no columns, no fields, no record; kernels are warm. The kinematics take turns, and the least time of
each counts, so that what else the machine does falls on all of them. The full model makes its steps once.
"""

from __future__ import annotations

import argparse
import time as clock

from mpi4py import MPI

from remodel_fenicsx import Simulation
from remodel_fenicsx.evolution.stepper import times
from remodel_fenicsx.scene import Scene, scene_from_dict
from remodel_fenicsx.system.environment import versions

REDUCED = ("radial", "axisymmetric", "sector")


def scene(kinematics: str, steps: int) -> Scene:
    """The artery of isotropic cells."""
    return scene_from_dict({
        "preset": "kuhl-holzapfel-2007",
        "geometry": {"shape": "tube"},
        "model": {"kinematics": kinematics},
        "cells": {"initial": "isotropic"},
        "time": {"end": float(steps)},
        "solver": {"method": "direct", "predictor": "none"},
        "output": {"fields": False},
    })  # fmt: skip


def seconds(kinematics: str, steps: int) -> tuple[float, int, int]:
    """Processor time of the steps, their Newton iterations, and the number of unknowns."""
    case = scene(kinematics, steps)
    simulation = Simulation(case, MPI.COMM_SELF)
    start, iterations = clock.process_time(), 0
    for step in simulation.stepper.march(times(case.time.end, case.time.step)):
        iterations += step.work.newton_iterations
    spent, unknowns = clock.process_time() - start, simulation.state.number_of_owned_unknowns
    simulation.close()
    return spent, iterations, unknowns


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=150, metavar="N", help="steps of each run (default: 150)")
    parser.add_argument("--rounds", type=int, default=3, metavar="N", help="turns of the reduced ones (default: 3)")
    parser.add_argument("--without-full", action="store_true", help="the reduced ones alone, without ratios")
    options = parser.parse_args()
    print(", ".join(f"{name} {version}" for name, version in versions().items()))
    names = REDUCED if options.without_full else (*REDUCED, "full")
    for name in names:
        seconds(name, 1)  # warms the kernels
    found: dict[str, list[tuple[float, int, int]]] = {name: [] for name in names}
    for turn in range(options.rounds):
        for name in REDUCED:
            found[name].append(seconds(name, options.steps))
        if not options.without_full and turn == options.rounds // 2:  # amid the others
            found["full"].append(seconds("full", options.steps))
    whole = min(found["full"])[0] if "full" in found else float("nan")
    print(f"{'kinematics':14}{'unknowns':>9}{'Newton':>8}{'s, CPU':>10}{'ms a step':>11}{'full over it':>14}")
    for name in names:
        least, iterations, unknowns = min(found[name])
        ratio = f"{whole / least:14.0f}" if "full" in found else ""
        print(f"{name:14}{unknowns:9}{iterations:8}{least:10.3f}{1000 * least / options.steps:11.2f}{ratio}")


if __name__ == "__main__":
    main()
