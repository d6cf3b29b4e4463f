#!/usr/bin/env python3
"""Write instrument.csv: a biaxial test of a synthetic tissue as an instrument records it.

    ./with-fenicsx python3 demos/biaxial/instrument.py [--seed 1]

Three protocols of five cycles each, with unloading, in mm and N. The tissue is that of scene.toml
with TRUTH; the first cycles are stiffer, unloading is softer, and forces have noise.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from remodel_fenicsx import Scene, Simulation, read_scene

FOLDER = Path(__file__).parent
TRUTH = {
    "material.lame_mu": 12.0,
    "material.initial_stiffness": 60.0,
    "material.locking_stretch": 1.6,
    "cells.fraction_x": 0.55,
    "cells.fraction_y": 0.35,
}
PROTOCOLS = {"1:1": (0.25, 0.25), "2:1": (0.3, 0.15), "1:2": (0.15, 0.3)}  # strains along x and y
LEVELS, CYCLES = np.arange(1, 9) / 8, 5
STIFFER, HYSTERESIS, NOISE = 0.3, 0.1, 0.001  # of the first cycle, of unloading, in N


def forces(scene: Scene, strains: tuple[float, float]) -> np.ndarray:
    """Return forces along x and y at `LEVELS` of the strains, (levels, 2), in N."""
    ramp = [[0.0, 0.0], [float(len(LEVELS)), 1.0]]
    loads = {f"elongation_{a}": {"value": e, "ramp": ramp} for a, e in zip("xy", strains)}
    test = {"loads": loads, "remodeling.law": "none", "time.end": float(len(LEVELS))}
    simulation = Simulation(scene.with_values(test))
    rows = [[step.row["force_x"], step.row["force_y"]] for step in simulation.steps()]
    simulation.close()
    return np.array(rows) / 1000.0  # kPa mm^2 is mN


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("-o", default=FOLDER / "instrument.csv")
    options = parser.parse_args()
    random = np.random.default_rng(options.seed)
    scene = read_scene(FOLDER / "scene.toml").with_values(TRUTH)
    lines = ["Planar biaxial tester", "Sample 20 x 20 x 1 mm", "Time,Test,Cycle,X,Y,Fx,Fy"]
    lines.append("(s),,,(mm),(mm),(N),(N)")
    time = 0
    for name, strains in PROTOCOLS.items():
        loading = forces(scene, strains)
        for cycle in range(1, CYCLES + 1):
            factor = 1 + STIFFER * (CYCLES - cycle) / CYCLES
            softer = 1 - HYSTERESIS * np.sin(np.pi * LEVELS)[:, None]
            levels = np.append(LEVELS, LEVELS[-2::-1])
            both = factor * np.concatenate([loading, (softer * loading)[-2::-1]])
            for level, force in zip(levels, both + random.normal(0.0, NOISE, both.shape)):
                time += 1
                moved = 20.0 * level * np.array(strains)
                numbers = ",".join(f"{number:.4f}" for number in (*moved, *force))
                lines.append(f"{time},{name},{cycle},{numbers}")
    Path(options.o).write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
