#!/usr/bin/env python3
"""How time and memory grow with the body: the artery on finer meshes, on one rank and on two.

    ./with-fenicsx benchmarks/scaling.py [--unknowns N]... [--ranks N]... [--steps 3] [--method auto]    # measures
    ./with-fenicsx benchmarks/scaling.py --report       # docs/speed.md's table and cost model from what was measured

Each case is a run of its own (the paper's tube, random cells, no fields, predictor on) with the mesh whose number of
unknowns is nearest to N; its first load steps are solved. Results are lines of results/scaling.jsonl: wall and
processor seconds of a step after the first, Newton and linear iterations, peak memory of all ranks, and what parts
took. Cases that are there are measured again and replaced. Wall time says something on an idle machine only.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time as clock
from pathlib import Path

import numpy as np

PROJECT = Path(__file__).resolve().parents[1]
RESULTS = PROJECT / "results" / "scaling.jsonl"
SIZES = [5_616, 17_000, 41_000, 81_000, 133_000, 310_000, 600_000, 1_000_000]
PAPER = (16, 8, 12)  # elements around, through the wall, along


def divisions(unknowns: int) -> tuple[int, int, int]:
    """Elements of a mesh like the paper's, with about so many unknowns."""

    def made(quarters: int) -> tuple[int, int, int]:
        around = 4 * quarters
        return around, max(1, round(around * PAPER[1] / PAPER[0])), max(1, round(around * PAPER[2] / PAPER[0]))

    def unknowns_of(mesh: tuple[int, int, int]) -> int:
        return 3 * mesh[0] * (mesh[1] + 1) * (mesh[2] + 1)

    return min((made(quarters) for quarters in range(1, 60)), key=lambda mesh: abs(unknowns_of(mesh) - unknowns))


def measure(unknowns: int, steps: int, method: str) -> None:
    """On every rank: one case; rank 0 prints it."""
    from mpi4py import MPI
    from petsc4py import PETSc

    from remodel_fenicsx.body.tube import Tube, whole_tube
    from remodel_fenicsx.scene import preset_scene
    from remodel_fenicsx.simulation import Simulation

    comm, chosen = MPI.COMM_WORLD, divisions(unknowns)
    scene = preset_scene("kuhl-holzapfel-2007", "tube").with_values(
        {"time.end": steps + 1.0, "solver.method": method, "solver.predictor": "autoregressive"}
    )
    PETSc.Log.begin()
    begun = clock.perf_counter()
    simulation = Simulation(
        scene, comm, whole_tube(Tube(inner_radius=1.0, outer_radius=3.0, length=8.0), chosen, "hexahedron", 1, comm)
    )
    made = clock.perf_counter() - begun
    wall, cpu, newton, linear = [], [], [], []
    before, spent = clock.perf_counter(), clock.process_time()
    for step in simulation.steps():
        wall.append(clock.perf_counter() - before)
        cpu.append(comm.allreduce(clock.process_time() - spent))
        newton.append(step.work.newton_iterations)
        linear.append(step.work.linear_iterations)
        before, spent = clock.perf_counter(), clock.process_time()
        if len(wall) == steps:  # the last step of a run counts negative eigenvalues, which is no part of a step
            break
    names = {"tangent": "SNESJacobianEval", "residual": "SNESFunctionEval", "setup": "PCSetUp", "solve": "KSPSolve"}
    parts = {name: PETSc.Log.Event(event).getPerfInfo()["time"] for name, event in names.items()}
    memory = comm.allreduce(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
    coupling = simulation.stepper.coupling
    if comm.rank == 0:
        record = {
            "unknowns": coupling.newton._x.getSize(), "divisions": chosen, "ranks": comm.size,
            "method": coupling.newton.method, "made": made, "wall": wall, "cpu": cpu, "newton": newton,
            "linear": linear, "parts": parts, "memory": memory,
        }  # fmt: skip
        print("RECORD", json.dumps(record), flush=True)


def run(unknowns: int, ranks: int, options: argparse.Namespace) -> None:
    """A case in processes of its own."""
    command = [sys.executable, "-m", "mpi4py", __file__, "--case", str(unknowns), "--steps", str(options.steps)]
    command += ["--method", options.method]
    start = ["mpirun", "-n", str(ranks), "--bind-to", "none"] if ranks > 1 else []
    environment = os.environ | {"PYTHONPATH": str(PROJECT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([*start, *command], capture_output=True, text=True, env=environment)
    lines = [line.removeprefix("RECORD ") for line in done.stdout.splitlines() if line.startswith("RECORD ")]
    if not lines:
        print(f"{unknowns} unknowns on {ranks} ranks: exit {done.returncode}\n{done.stderr[-1500:]}")
        return
    record = json.loads(lines[0])
    key = (record["unknowns"], ranks, record["method"])
    kept = [r for r in read() if (r["unknowns"], r["ranks"], r["method"]) != key]
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text("".join(json.dumps(r) + "\n" for r in [*kept, record]))
    print(row(record), flush=True)


def read() -> list[dict]:
    """What was measured."""
    return [json.loads(line) for line in RESULTS.read_text().splitlines()] if RESULTS.exists() else []


def per_iteration(record: dict) -> float:
    """Wall seconds per unknown and Newton iteration, of all steps, in microseconds."""
    return 1e6 * sum(record["wall"]) / record["unknowns"] / sum(record["newton"])


def row(record: dict) -> str:
    """Of the table."""
    steps, size = len(record["wall"]), record["unknowns"]
    return (
        f"| {size:,} | {record['ranks']} | {record['method']} | {sum(record['wall']) / steps:.3g} | "
        f"{sum(record['cpu']) / steps:.3g} | {sum(record['newton']) / steps:.3g} | "
        f"{sum(record['linear']) / sum(record['newton']):.3g} | {per_iteration(record):.3g} | "
        f"{record['memory'] / 1e9:.3g} | {record['memory'] / size / 1e3:.3g} |"
    )


HEAD = """| unknowns | ranks | method | wall s a step | processor s | Newton its | linear its each | \
us per unknown and it | GB | kB per unknown |
|---|---|---|---|---|---|---|---|---|---|"""


# ---------------------------------------------------------------- what it would cost elsewhere
ON_PAPER = (5, 12)  # Newton iterations a step, and linear ones each
LATENCY, REDUCTIONS, LEVELS = 20e-6, 3, 5  # seconds of a message; reductions and multigrid levels of a linear iteration
PARTS = ("tangent", "residual", "setup", "solve")


def prices(records: list[dict]) -> dict[str, float]:
    """Seconds per unknown: of a tangent, a residual, a setup, a linear iteration, and a step's rest; of one rank."""
    price = dict.fromkeys((*PARTS, "rest"), 0.0)
    for record in records:
        newton, linear, steps = sum(record["newton"]), sum(record["linear"]), len(record["wall"])
        counts = {"tangent": newton, "residual": newton + steps, "setup": newton, "solve": linear}
        share = 1 / len(records) / record["unknowns"]
        for name in PARTS:
            price[name] += share * record["parts"][name] / counts[name]
        price["rest"] += share * (sum(record["wall"]) - sum(record["parts"][name] for name in PARTS)) / steps
    return price


def predicted(price: dict[str, float], unknowns: float, ranks: int, newton: float, linear: float) -> float:
    """Wall seconds of a step: work shared by all ranks, and what their messages wait for."""
    work = newton * (price["tangent"] + price["residual"] + price["setup"]) + newton * linear * price["solve"]
    messages = newton * linear * (REDUCTIONS * np.log2(max(ranks, 1)) + 4 * LEVELS * (ranks > 1))
    return (work + price["rest"]) * unknowns / ranks + messages * LATENCY


def report() -> None:
    """Table, prices, prediction against measurement, and larger machines."""
    records = sorted(read(), key=lambda r: (r["unknowns"], r["ranks"], r["method"]))
    print(HEAD)
    for record in records:
        print(row(record))
    fitted = [r for r in records if r["method"] == "iterative" and r["ranks"] == 1]
    if not fitted:
        return
    price = prices(fitted)
    print(
        "\nSeconds per million unknowns, one rank: " + ", ".join(f"{k} {1e6 * v:.3g}" for k, v in price.items()) + "."
    )
    print("\n| unknowns | ranks | predicted, s a step | measured |\n|---|---|---|---|")
    for r in (r for r in records if r["method"] == "iterative"):
        steps, newton = len(r["wall"]), sum(r["newton"])
        found = predicted(price, r["unknowns"], r["ranks"], newton / steps, sum(r["linear"]) / newton)
        print(f"| {r['unknowns']:,} | {r['ranks']} | {found:.3g} | {sum(r['wall']) / steps:.3g} |")
    newton, linear = ON_PAPER
    print(f"\nOn paper, {newton} Newton iterations of {linear} linear ones:\n")
    print("| unknowns | ranks | s a step |\n|---|---|---|")
    for unknowns, ranks in ((1e6, 16), (1e7, 64), (1e7, 256), (1e8, 1024)):
        print(f"| {unknowns:.0e} | {ranks} | {predicted(price, unknowns, ranks, newton, linear):.3g} |")


def main() -> None:
    """Measure, or report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--unknowns", type=int, action="append")
    parser.add_argument("--ranks", type=int, action="append")
    parser.add_argument("--steps", type=int, default=3)
    parser.add_argument("--method", default="auto")
    parser.add_argument("--case", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()
    if options.case:
        measure(options.case, options.steps, options.method)
        return
    if options.report:
        report()
        return
    print(HEAD)
    for unknowns in options.unknowns or SIZES:
        for ranks in options.ranks or [1, 2]:
            run(unknowns, ranks, options)


if __name__ == "__main__":
    main()
