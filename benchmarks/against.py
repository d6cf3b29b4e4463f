#!/usr/bin/env python3
"""Two states of this project, or two settings of one, in pairs: processor time, and how far results are apart.

    ./with-fenicsx benchmarks/against.py COMMIT [--scene demos/artery.toml] [--steps N] [--pairs 3] [--core 0]
        [--set KEY=VALUE]... [--set-here KEY=VALUE]... [--set-there KEY=VALUE]...

COMMIT is a commit of this project, or a folder with a checkout of it (`.`: this one, with other settings). Each state
takes its own file SCENE, all --set, and its own --set-here or --set-there (keys that were not there, or had other names
then). Both run as a user runs them, recorded, on one core; they take turns, and what a run of one step costs is taken
off: imports, the mesh, the forms from the cache. The ratio is what counts: it hardly depends on the machine, nor on
what else runs there.
"""

from __future__ import annotations

import argparse
import csv
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1]


def checkout(commit: str, into: Path) -> Path:
    """The folder of a state."""
    if Path(commit).is_dir():
        return Path(commit).resolve()
    subprocess.run(
        ["git", "clone", "--quiet", "--shared", "--no-checkout", str(PROJECT), str(into)],
        check=True,
    )
    subprocess.run(["git", "-C", str(into), "checkout", "--quiet", commit], check=True)
    return into


def processor_seconds(
    command: list[str], core: int, *paths: Path, folder: Path | None = None
) -> float:
    """Of a command on one core with these paths of Python, which must succeed."""
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(map(str, paths)),
        "OMP_NUM_THREADS": "1",
    }
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        ["taskset", "--cpu-list", str(core), *command], check=True, env=environment, cwd=folder
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def run(state: Path, scene: str, settings: list[str], folder: Path, core: int) -> float:
    """Processor seconds of a recorded run."""
    command = [
        sys.executable,
        "-m",
        "remodel_fenicsx.cli",
        "run",
        str(state / scene),
        "-o",
        str(folder),
        "-q",
    ]
    changes = [word for setting in settings for word in ("--set", setting)]
    return processor_seconds([*command, *changes], core, state, folder=state)


def history(folder: Path) -> dict[float, dict[str, float]]:
    """Rows by time; without what was not computed."""
    with (folder / "history.csv").open() as file:
        rows = [
            {name: float(value) for name, value in row.items() if value}
            for row in csv.DictReader(file)
        ]
    return {row["time"]: row for row in rows}


def farthest(
    one: dict[float, dict[str, float]], other: dict[float, dict[str, float]]
) -> dict[str, float]:
    """Largest difference of each column that both have, relative where values are above 1."""
    found: dict[str, float] = {}
    for time in one.keys() & other.keys():
        for name in one[time].keys() & other[time].keys() - {"time", "seconds"}:
            a, b = one[time][name], other[time][name]
            found[name] = max(found.get(name, 0.0), abs(a - b) / max(1.0, abs(a)))
    return found


def main() -> None:
    """Warm up, measure in turns, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("commit")
    parser.add_argument("--scene", default="demos/artery.toml")
    parser.add_argument("--steps", type=float, default=150, help="time.end")
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--core", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--set-here", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--set-there", action="append", default=[], metavar="KEY=VALUE")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        states = {"there": checkout(options.commit, Path(temporary) / "state"), "here": PROJECT}
        settings = {
            "there": options.set + options.set_there,
            "here": options.set + options.set_here,
        }
        seconds, starts, rows = dict[str, list[float]](), dict[str, list[float]](), {}
        step = [
            "1.0",
            *(word.split("=")[1] for word in options.set if word.startswith("time.step=")),
        ][-1]
        for pair in range(options.pairs + 1):  # the first fills the caches
            for name, state in states.items():
                folder = Path(temporary) / f"{name}-{pair}"
                start = run(
                    state,
                    options.scene,
                    [*settings[name], f"time.end={step}"],
                    folder / "one",
                    options.core,
                )
                if pair:
                    asked = [*settings[name], f"time.end={options.steps}"]
                    total = run(state, options.scene, asked, folder / "all", options.core)
                    starts.setdefault(name, []).append(start)
                    seconds.setdefault(name, []).append(total - start)
                    rows[name] = history(folder / "all")
    ratios = [here / there for here, there in zip(seconds["here"], seconds["there"], strict=True)]
    print(
        f"{options.scene} to t = {options.steps:g}, against {options.commit}: processor seconds without the start"
    )
    for name in ("there", "here"):
        print(
            f"{name:6} {statistics.median(seconds[name]):8.2f} s "
            f"({min(seconds[name]):.2f} to {max(seconds[name]):.2f}), "
            f"start {statistics.median(starts[name]):.2f} s"
        )
    print(f"ratio  {statistics.median(ratios):8.3f}   ({min(ratios):.3f} to {max(ratios):.3f})")
    for name, difference in sorted(
        farthest(rows["there"], rows["here"]).items(), key=lambda pair: -pair[1]
    ):
        print(f"       {name:28} {difference:.1e}")


if __name__ == "__main__":
    main()
