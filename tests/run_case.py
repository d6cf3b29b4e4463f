"""Runs scenes on the ranks of this process group and saves what tests look at: python3 run_case.py OUT.npz JSON ...

JSON: {"scene": {...}, "divisions": elements of a tube around, through the wall and along, of a
tendon the last of these, or null for the scene's own mesh}. Saved: the history's columns; u at the end by node, l and
n by element and point, the reference coordinates of the points, and the initial l.
"""

from __future__ import annotations

import json
import sys

import numpy as np
from mpi4py import MPI

from remodel_fenicsx.body import tendon
from remodel_fenicsx.scene.scene import scene_from_dict
from remodel_fenicsx.simulation import Simulation
from remodel_fenicsx.unloading import as_unloaded
from tests.forks import readers_are_forks
from tests.own_bodies import gathered_bend
from tests.parts import tube


def main(out: str, request: dict) -> None:
    """Run and save; everything is gathered in the mesh file's order."""
    readers_are_forks()
    if request["scene"] == "a bend with legs":  # whose local axes are found
        if (found := gathered_bend(MPI.COMM_WORLD)) is not None:
            np.savez(out, **found)  # type: ignore[arg-type]
        return
    with as_unloaded(scene_from_dict(request["scene"]), MPI.COMM_WORLD) as scene:
        domain = None
        body = scene.geometry
        if body.shape == "tendon":
            tendon.ALONG = (request["divisions"] or [10])[-1]
        elif request["divisions"]:
            domain = tube(
                body.inner_radius,
                body.outer_radius,
                body.length,
                scene.mesh.degree,
                divisions=request["divisions"],
            )
        simulation = Simulation(scene, MPI.COMM_WORLD, domain)
        domain, cells, quadrature = simulation.domain, simulation.cells, simulation.quadrature
        rows = [step.row for step in simulation.steps()]
        saved: dict[str, object] = {"u": simulation.state.gathered_displacement()}
        of_points = {
            "l": cells.dimension_values,
            "l0": cells.initial_dimensions,
            "n": cells.axis_values,
        }
        for name, values in (of_points | {"x": quadrature.coordinates}).items():
            saved[name] = domain.gather_elements(values)
        if MPI.COMM_WORLD.rank == 0:
            columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
            np.savez(out, **columns, **saved)  # type: ignore[arg-type]
        simulation.close()


if __name__ == "__main__":
    for path, text in zip(sys.argv[1::2], sys.argv[2::2], strict=True):
        main(path, json.loads(text))
