#!/usr/bin/env python3
"""Where the time of the paper's artery goes: 150 steps, preset, random cells, recorded, on one core with a warm cache.

    ./with-fenicsx benchmarks/artery.py [--steps N] [--set KEY=VALUE]...

Prints seconds and shares of tangent, residual, linear solve, guards, remodeling and record. PETSc's own event log times
what happens inside SNES; the rest is timed by watchers between the others. A first run of one step warms the cache of
compiled forms.
"""

from __future__ import annotations

import argparse
import tempfile
import time as clock
from collections import defaultdict
from pathlib import Path

from petsc4py import PETSc

from remodel_fenicsx import Scene, Simulation, read_scene
from remodel_fenicsx.evolution.stepper import Step, Watcher, times
from remodel_fenicsx.fem.solver_methods import LAGGED
from remodel_fenicsx.results.fields import Fields
from remodel_fenicsx.results.run_folder import RunFolder
from remodel_fenicsx.system.environment import versions

# KSPSolve does not count the PCSetUp that it triggers
EVENTS = {
    "tangent": ("SNESJacobianEval",),
    "residual": ("SNESFunctionEval",),
    "linear solve": ("KSPSolve", "PCSetUp"),
}
SCENE = Path(__file__).parents[1] / "demos" / "artery.toml"


class Stopwatch:
    """Gives the wall time since it was last asked to a name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.start()

    def start(self) -> None:
        """From now on."""
        self._last = clock.perf_counter()

    def lap(self, name: str) -> None:
        """What has passed was this."""
        now = clock.perf_counter()
        self.seconds[name] += now - self._last
        self._last = now


class Lap(Watcher):
    """A watcher between others: what passes before it is called belongs to these names."""

    def __init__(self, watch: Stopwatch, solved: str, completed: str, committed: str = "the rest"):
        self.watch, self.names = watch, (solved, completed, committed)

    def solved(self, step: Step) -> None:
        self.watch.lap(self.names[0])

    def completed(self, step: Step) -> None:
        self.watch.lap(self.names[1])

    def committed(self, step: Step) -> None:
        self.watch.lap(self.names[2])


def events() -> dict[str, float]:
    """Seconds that PETSc has logged so far, by our names."""
    return {name: sum(_seconds(event) for event in parts) for name, parts in EVENTS.items()}


def _seconds(event: str) -> float:
    return float(PETSc.Log.Event(event).getPerfInfo()["time"])


def measure(scene: Scene, folder: Path) -> tuple[dict[str, float], float, int]:
    """Seconds by part, seconds of all steps, Newton iterations."""
    simulation, watch = Simulation(scene), Stopwatch()
    stepper, iterations = simulation.stepper, 0
    with RunFolder(folder, scene.to_toml()) as record, Fields(folder, scene.geometry, stepper) as fields:
        watchers = [
            Lap(watch, solved="solve", completed="remodeling"),
            simulation.observer,
            Lap(watch, solved="columns", completed="columns"),
            fields,
            record,
            Lap(watch, solved="record", completed="record"),
        ]
        stepper.start(watchers)
        before, set_up = events(), _seconds("PCSetUp")
        watch.start()
        for time in times(scene.time.end, scene.time.step):
            iterations += stepper.advance(time, watchers).work.newton_iterations
    after, total = events(), sum(watch.seconds.values())
    parts = {name: after[name] - before[name] for name in EVENTS}
    if stepper.coupling.newton.method == LAGGED:  # whose factors are made in the tangent's call-back
        parts["tangent"] -= _seconds("PCSetUp") - set_up
    parts["guards and the rest of SNES"] = watch.seconds.pop("solve") - sum(parts.values())
    simulation.close()
    return {**parts, **watch.seconds}, total, iterations


def main() -> None:
    """Warm up, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=150)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    options = parser.parse_args()
    scene = read_scene(SCENE, [*options.set, f"time.end={float(options.steps)}"])
    PETSc.Log.begin()
    with tempfile.TemporaryDirectory() as folder:
        measure(scene.with_values({"time.end": scene.time.step}), Path(folder) / "warm")
        parts, total, iterations = measure(scene, Path(folder) / "measured")
    print(
        ", ".join(f"{name} {version}" for name, version in versions().items() if name in ("dolfinx", "PETSc", "BLAS"))
    )
    print(f"{scene.name}: {scene.time.number_of_steps} steps, {iterations} Newton iterations, {total:.1f} s")
    for name, seconds in sorted(parts.items(), key=lambda pair: -pair[1]):
        print(f"{name:30} {seconds:8.3f} s {100 * seconds / total:5.1f} %")


if __name__ == "__main__":
    main()
