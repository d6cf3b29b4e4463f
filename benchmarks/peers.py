#!/usr/bin/env python3
"""The paper's artery here and in FElupe: the same mesh, cells, loads, steps and tolerance, on one core in turns.

    pip install --no-deps --target peers felupe==11.3.0 tensortrax==0.29.0     # once, with any pip: pure Python
    ./with-fenicsx benchmarks/peers.py peers [--steps 40] [--pairs 1] [--core 0] [--tolerance 1e-10]
        [--parts tensortrax|jax] [--set KEY=VALUE]...

`--parts jax` needs jax and pypardiso (which needs mkl) in the folder too; PYPARDISO_MKL_RT names libmkl_rt.so there.

FElupe is a finite element library of Python for hyperelastic bodies; numpy and SciPy are the environment's for both.
Ours is run as a user runs it (solver.method auto, predictor autoregressive, all fields recorded) and its record gives
the other one mesh and cells: benchmarks/peer_felupe.py. What a run of one step costs is taken off both: imports,
mesh, forms from the cache. Radii have to agree to 1e-3. `--set` changes ours.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.against import PROJECT, processor_seconds, run
from remodel_fenicsx import Recording, Scene
from tests.runs import made

TO_VTK = [0, 1, 3, 2, 4, 5, 7, 6]  # nodes of a hexahedron
OWN = ("solver.method=auto", "solver.predictor=autoregressive")


def own(steps: int, folder: Path, options: argparse.Namespace) -> float:
    """Processor seconds of a run of ours."""
    changes = [
        *OWN,
        f"solver.relative_tolerance={options.tolerance}",
        *options.set,
        f"time.end={steps}",
    ]
    return run(PROJECT, "demos/artery.toml", changes, folder, options.core)


def other(steps: int, problem: Path, result: Path, options: argparse.Namespace) -> float:
    """Processor seconds of a run of FElupe."""
    script = PROJECT / "benchmarks" / "peer_felupe.py"
    command = [sys.executable, str(script), str(problem), str(steps), str(options.tolerance)]
    command += [str(result), options.parts]
    return processor_seconds(command, options.core, options.packages.resolve())


def write_problem(scene: Scene, path: Path) -> None:
    """What the other one needs to know."""
    with made(scene) as simulation:
        lengths = simulation.cells.dimension_values[:, 0]
    mesh, material, tube = simulation.domain.mesh, scene.material, scene.geometry
    np.savez(
        path, points=mesh.geometry.x, elements=mesh.geometry.dofmap[:, TO_VTK],
        lengths=lengths, mu=material.lame_mu, lmbda=material.lame_lambda,
        modulus=material.network_modulus, contour=material.contour_length, initial=scene.cells.end_to_end_length,
        inner_radius=tube.inner_radius, length=tube.length, pressure=scene.loads["pressure"].value,
        drawn=scene.loads["elongation"].value * tube.length, ramp=scene.loads["pressure"].ramp[-1][0],
        kappa=scene.remodeling.kappa,
    )  # fmt: skip


def radii(points: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """Mean deformed radius of the nodes inside and outside."""
    reference = np.hypot(points[:, 0], points[:, 1])
    deformed = np.hypot(*(points + displacement)[:, :2].T)
    faces = (reference.min(), reference.max())
    return np.array([deformed[np.isclose(reference, radius)].mean() for radius in faces])


def main() -> None:
    """Measure in turns, compare, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("packages", type=Path, help="folder with felupe and tensortrax")
    parser.add_argument(
        "--parts", choices=("tensortrax", "jax"), default="tensortrax", help="jax: with Pardiso"
    )
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--pairs", type=int, default=1)
    parser.add_argument("--core", type=int, default=0)
    parser.add_argument("--tolerance", type=float, default=1e-10, help="of the nodal forces")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="of ours")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        first = own(1, folder / "first", options)
        recorded = Recording(folder / "first")
        write_problem(recorded.scene, folder / "problem.npz")
        points = np.load(folder / "problem.npz")["points"]
        first_of_other = other(1, folder / "problem.npz", folder / "first.npz", options)
        for pair in range(options.pairs):
            seconds = own(options.steps, folder / f"own-{pair}", options) - first
            seconds_of_other = other(
                options.steps, folder / "problem.npz", folder / "other.npz", options
            )
            seconds_of_other -= first_of_other
            recording, found = Recording(folder / f"own-{pair}"), np.load(folder / "other.npz")
            ours = radii(recording.points, recording.fields(float(options.steps))["displacement"])
            theirs = radii(points, found["displacement"])
            iterations = int(np.sum(recording.history["newton_iterations"]))
            difference = np.abs(ours - theirs).max()
            print(
                f"{options.steps} steps: here {seconds:.1f} s, {iterations} iterations; FElupe, {options.parts} "
                f"{seconds_of_other:.1f} s, {int(found['iterations'])} iterations; ratio "
                f"{seconds_of_other / seconds:.1f}; radii here {ours}, there {theirs}",
                flush=True,
            )
            if difference > 1e-3:
                sys.exit(f"radii differ by {difference:.1e}: these are not the same problem")


if __name__ == "__main__":
    main()
