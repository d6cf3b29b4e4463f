#!/usr/bin/env python3
"""How time and memory grow with the body: the artery on finer meshes, on one rank and on two.

    ./with-fenicsx benchmarks/scaling.py [--unknowns N]... [--ranks N]... [--steps 3] [--method auto]    # measures
    ./with-fenicsx benchmarks/scaling.py --report       # the table (docs/reliability.md)
    ./with-fenicsx benchmarks/scaling.py --aorta SIZE [--ranks N]    # an arch with three branches

Each case is a run of its own (the paper's tube, random cells, no fields, predictor on) with the mesh whose number of
unknowns is nearest to N; its first load steps are solved. Results are lines of results/scaling.jsonl: wall and
processor seconds of a step after the first, Newton and linear iterations, peak memory of all ranks. Cases that are
there are measured again and replaced. Wall time says something on an idle machine only.

The aorta goes from the surface of its lumen (benchmarks/arch.py) through the commands of a user with
the program's defaults: a wall of 1.2 mm of triangles of SIZE mm, two load steps of a quarter of 80
mmHg, `unload` on one rank, and 20 steps of remodeling of the unloaded body after its load steps.
Its tissue has Young's modulus of an adult's aorta, 0.9 MPa. 251,000 unknowns have a size of 3,
846,000 one of 1.5, 976,000 one of 1.38. Its folder is results/aorta-SIZE.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import resource
import shutil
import subprocess
import sys
import time as clock
from pathlib import Path
from typing import Any

from mpi4py import MPI

from benchmarks.arch import write_lumen
from docs.making.pages import lines, markdown
from remodel_fenicsx.body.tube import Tube, whole_tube
from remodel_fenicsx.scene import preset_scene
from remodel_fenicsx.simulation import Simulation

PROJECT = Path(__file__).resolve().parents[1]
RESULTS = PROJECT / "results" / "scaling.jsonl"
SIZES = [5_616, 17_000, 41_000, 81_000, 133_000, 310_000, 600_000, 1_000_000]
PAPER = (16, 8, 12)  # elements around, through the wall, along


def divisions(unknowns: int) -> tuple[int, int, int]:
    """Elements of a mesh like the paper's, with about so many unknowns."""
    made = [
        tuple(max(1, round(4 * k * number / PAPER[0])) for number in PAPER) for k in range(1, 60)
    ]
    return min(made, key=lambda mesh: abs(3 * mesh[0] * (mesh[1] + 1) * (mesh[2] + 1) - unknowns))


def measure(unknowns: int, steps: int, method: str) -> None:
    """On every rank: one case; rank 0 prints it."""
    comm, chosen = MPI.COMM_WORLD, divisions(unknowns)
    scene = preset_scene("kuhl-holzapfel-2007", "tube").with_values(
        {"time.end": steps + 1.0, "solver.method": method, "solver.predictor": "autoregressive"}
    )
    begun = clock.perf_counter()
    body = Tube(inner_radius=1.0, outer_radius=3.0, length=8.0)
    simulation = Simulation(scene, comm, whole_tube(body, chosen, "hexahedron", 1, comm))
    record: dict[str, Any] = {
        "divisions": chosen,
        "ranks": comm.size,
        "made": clock.perf_counter() - begun,
    }
    record |= {name: [] for name in ("wall", "cpu", "newton", "linear")}
    before, spent = clock.perf_counter(), clock.process_time()
    for step in simulation.steps():
        record["wall"].append(clock.perf_counter() - before)
        record["cpu"].append(comm.allreduce(clock.process_time() - spent))
        record["newton"].append(step.work.newton_iterations)
        record["linear"].append(step.work.linear_iterations)
        before, spent = clock.perf_counter(), clock.process_time()
        if (
            len(record["wall"]) == steps
        ):  # the last step of a run counts negative eigenvalues, which is no part of it
            break
    record["memory"] = comm.allreduce(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
    newton = simulation.stepper.coupling.newton
    record |= {"unknowns": newton._x.getSize(), "method": newton.method}
    if comm.rank == 0:
        print("RECORD", json.dumps(record), flush=True)


def run(unknowns: int, ranks: int, options: argparse.Namespace) -> None:
    """A case in processes of its own."""
    command = [
        sys.executable,
        "-m",
        "mpi4py",
        __file__,
        "--case",
        str(unknowns),
        "--steps",
        str(options.steps),
    ]
    command += ["--method", options.method]
    start = ["mpirun", "-n", str(ranks), "--bind-to", "none"] if ranks > 1 else []
    environment = os.environ | {"PYTHONPATH": str(PROJECT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([*start, *command], capture_output=True, text=True, env=environment)
    said = [
        line.removeprefix("RECORD ")
        for line in done.stdout.splitlines()
        if line.startswith("RECORD ")
    ]
    if not said:
        print(
            f"{unknowns} unknowns on {ranks} ranks: exit {done.returncode}\n{done.stderr[-1500:]}"
        )
        return
    record = json.loads(said[0])
    key = (record["unknowns"], ranks, record["method"])
    kept = [r for r in read() if (r["unknowns"], r["ranks"], r["method"]) != key]
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text("".join(json.dumps(r) + "\n" for r in [*kept, record]))
    print(lines([row(record)]), flush=True)


def read() -> list[dict]:
    """What was measured."""
    return (
        [json.loads(line) for line in RESULTS.read_text().splitlines()] if RESULTS.exists() else []
    )


HEAD = ["unknowns", "ranks", "method", "wall s a step", "processor s", "Newton its", "linear its each",
        "us per unknown and it", "GB", "kB per unknown"]  # fmt: skip


def row(record: dict) -> list[str]:
    """Of the table."""
    size, steps = record["unknowns"], len(record["wall"])
    wall, cpu, newton, linear = (sum(record[name]) for name in ("wall", "cpu", "newton", "linear"))
    numbers = (
        wall / steps,
        cpu / steps,
        newton / steps,
        linear / newton,
        1e6 * wall / size / newton,
    )
    memory = (record["memory"] / 1e9, record["memory"] / size / 1e3)
    return [
        f"{size:,}",
        f"{record['ranks']}",
        record["method"],
        *(f"{number:.3g}" for number in (*numbers, *memory)),
    ]


AORTA = """
[geometry]
shape = "mesh"
file = "wall.msh"
length_unit = "mm"
[geometry.faces]
outlet = ["outlet_1", "outlet_2", "outlet_3", "outlet_4"]
[material]
stress_unit = "kPa"
lame_lambda = 2700.0
lame_mu = 300.0
chain_density = 1.2e26
[cells]
initial = "isotropic"
[supports.inlet]
kind = "guided"
[supports.outlet]
kind = "guided"
[loads.pressure]
value = "80 mmHg"
ramp = [[0.0, 0.0], [4.0, 1.0]]
[remodeling]
law = "tensor"
kappa = 0.025
[time]
end = 24.0
step = 1.0
"""


def aorta(size: float, ranks: int) -> None:
    """Run a user's commands on the arch; print a row of time, memory and iterations of each."""
    folder = RESULTS.parent / f"aorta-{size:g}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    (folder / "aorta.toml").write_text(AORTA)
    triangles = write_lumen(folder / "lumen.vtp")
    print(f"{triangles} triangles of the lumen", flush=True)
    wall = ["wall", "lumen.vtp", "--thickness", "1.2", "--size", f"{size:g}", "-o"]
    unload = ["unload", "aorta.toml", "--set", "geometry.is=loaded", "-o"]
    commands = {
        "wall": (1, wall),
        "two load steps": (ranks, ["run", "aorta.toml", "--set", "time.end=2.0", "-o"]),
        "unload": (1, unload),
        "20 steps of remodeling": (ranks, ["run", "unload/scene.toml", "-o"]),
    }
    print(markdown(["command", "wall s", "processor s", "GB", "Newton its", "linear its"], []))
    for name, (processes, command) in commands.items():
        start = ["mpirun", "-n", str(processes), "--bind-to", "none"] if processes > 1 else []
        begun = clock.perf_counter()
        output = "wall.msh" if name == "wall" else name.replace(" ", "_")
        started = [*start, "remodel-fenicsx", *command, output]
        process = subprocess.Popen(started, cwd=folder)
        _, status, usage = os.wait4(process.pid, 0)
        table = folder / output / "history.csv"
        rows = list(csv.DictReader(table.open())) if table.is_file() else []
        iterations = [
            f"{sum(int(float(row[name])) for row in rows)}"
            for name in ("newton_iterations", "linear_iterations")
        ]
        seconds = (clock.perf_counter() - begun, usage.ru_utime + usage.ru_stime)
        numbers = (*seconds, usage.ru_maxrss / 1e6)
        row = [name, *(f"{number:.3g}" for number in numbers), *iterations]
        print(lines([row]), flush=True)
        if status:
            sys.exit(f"{name}: exit code {os.waitstatus_to_exitcode(status)}")


def main() -> None:
    """Measure, or report."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--unknowns", type=int, action="append")
    parser.add_argument("--ranks", type=int, action="append")
    parser.add_argument("--steps", type=int, default=3)
    parser.add_argument("--method", default="auto")
    parser.add_argument("--aorta", type=float, metavar="SIZE")
    parser.add_argument("--case", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()
    if options.aorta:
        aorta(options.aorta, *(options.ranks or [1])[:1])
        return
    if options.case:
        measure(options.case, options.steps, options.method)
        return
    if options.report:
        print(
            markdown(
                HEAD,
                map(row, sorted(read(), key=lambda r: (r["unknowns"], r["ranks"], r["method"]))),
            )
        )
        return
    print(markdown(HEAD, []))
    for unknowns in options.unknowns or SIZES:
        for ranks in options.ranks or [1, 2]:
            run(unknowns, ranks, options)


if __name__ == "__main__":
    main()
