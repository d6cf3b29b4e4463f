#!/usr/bin/env python3
"""What checkpoints cost: the paper's artery with them and without, in pairs in one process.

    ./with-fenicsx benchmarks/checkpoints.py [--steps N] [--pairs N] [--every N] [--set KEY=VALUE]...

Prints the ratio of processor times pair by pair, and what the checkpoints themselves took: share of the run,
milliseconds and bytes of one. --every: steps between two; without it they are chosen by time, as in every run.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time as clock
from pathlib import Path

from mpi4py import MPI

from remodel_fenicsx import Scene, read_scene
from remodel_fenicsx.results import checkpoint
from remodel_fenicsx.results.checkpoint import Checkpoints
from remodel_fenicsx.results.checkpoint_file import GENERATIONS
from remodel_fenicsx.running import run

SCENE = Path(__file__).parents[1] / "demos" / "artery.toml"


class Costs:
    """Processor and wall seconds of every checkpoint that is written."""

    def __init__(self) -> None:
        self.processor: list[float] = []
        self.wall: list[float] = []
        write = Checkpoints.write

        def timed(checkpoints: Checkpoints) -> None:
            processor, wall = clock.process_time(), clock.perf_counter()
            write(checkpoints)
            self.processor.append(clock.process_time() - processor)
            self.wall.append(clock.perf_counter() - wall)

        Checkpoints.write = timed  # type: ignore[method-assign]


def seconds_of(scene: Scene, folder: Path, without: bool) -> float:
    """Processor seconds of a run."""
    write = checkpoint.Checkpoints.write
    if without:
        checkpoint.Checkpoints.write = lambda checkpoints: None  # type: ignore[method-assign]
    start = clock.process_time()
    run(scene, folder, MPI.COMM_WORLD)
    checkpoint.Checkpoints.write = write  # type: ignore[method-assign]
    return clock.process_time() - start


def main() -> None:
    """Warm up, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=150)
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--every", type=int)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    options = parser.parse_args()
    scene = read_scene(SCENE, [*options.set, f"time.end={float(options.steps)}"])
    if options.every is not None:
        scene = scene.with_values({"output.checkpoint": options.every})
    ratios, shares, costs, number = [], [], Costs(), 0
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        seconds_of(scene.with_values({"time.end": scene.time.step}), place / "warm", without=True)
        for pair in range(options.pairs):
            before = len(costs.processor)
            with_them = seconds_of(scene, place / f"with-{pair}", without=False)
            alone = seconds_of(scene, place / f"without-{pair}", without=True)
            ratios.append(with_them / alone)
            shares.append(sum(costs.processor[before:]) / with_them)
            number = len(costs.processor) - before
        size = max(
            (place / "with-0" / file).stat().st_size for file in GENERATIONS if (place / "with-0" / file).exists()
        )
    each = 1000 * statistics.median(costs.processor), 1000 * statistics.median(costs.wall)
    print(f"{scene.name}: {options.steps} steps, {number} checkpoints, {with_them:.1f} s of processor time with them")
    print(f"with / without, pair by pair: {', '.join(f'{ratio:.3f}' for ratio in ratios)}")
    print(f"share of the run: {100 * statistics.median(shares):.2f} %")
    print(f"one checkpoint: {each[0]:.0f} ms of processor time, {each[1]:.0f} ms, {size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
