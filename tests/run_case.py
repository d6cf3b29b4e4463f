"""Runs scenes on the ranks of this process group and saves what tests look at: python3 run_case.py OUT.npz JSON ...

JSON: {"scene": {...}, "snapshots": [times], "divisions": elements of a tube around, through the wall and along, of a
tendon the last of these, or null for the scene's own mesh}. Saved: the history's columns; at each snapshot the state
after the solve of that time (u_T by node, stretch_T and angle_T by element); at the end l, n by element and point, the
reference coordinates of the points, the initial l, and whether the third principal Cauchy stress was ever positive.
"""

from __future__ import annotations

import json
import sys

import numpy as np
from mpi4py import MPI

from remodel_fenicsx.evolution.stepper import Step, Watcher
from remodel_fenicsx.results.columns import Measurement
from remodel_fenicsx.scene.scene import scene_from_dict
from remodel_fenicsx.simulation import Simulation
from tests.parts import tube


def main(out: str, request: dict) -> None:
    """Run and save; everything is gathered in the mesh file's order."""
    scene = scene_from_dict(request["scene"])
    domain = None
    body = scene.geometry
    if body.shape == "tendon":
        sys.modules["remodel_fenicsx.body.tendon"].ALONG = (request["divisions"] or [10])[-1]  # type: ignore
    elif request["divisions"]:
        domain = tube(
            body.inner_radius, body.outer_radius, body.length, scene.mesh.degree, divisions=request["divisions"]
        )
    simulation = Simulation(scene, MPI.COMM_WORLD, domain)
    domain, cells, quadrature = simulation.domain, simulation.cells, simulation.quadrature
    displacement = simulation.state.gathered_displacement
    saved: dict[str, object] = {}
    tension = np.zeros(quadrature.shape, dtype=bool)

    class Snapshots(Watcher):
        """Looks at the solved state, before the cells change."""

        def solved(self, step: Step) -> None:
            nonlocal tension
            if any(abs(step.time - wanted) < 1e-9 for wanted in request["snapshots"]):
                measured = Measurement(simulation.observer, step)
                saved[f"u_{step.time:g}"] = displacement()
                saved[f"stretch_{step.time:g}"] = domain.gather_elements(measured.axial_stretch)
                angle = quadrature.element_mean(measured.fibre_angle)
                saved[f"angle_{step.time:g}"] = domain.gather_elements(angle)
            _, driver = simulation.stepper.remodeling.driving_tensor()
            third = np.linalg.eigvalsh(driver)[:, 0].reshape(quadrature.shape)
            tension |= third > 0

    rows = [step.row for step in simulation.steps([Snapshots()])]
    saved["u"] = displacement()
    for name, values in {
        "l": cells.dimension_values,
        "l0": cells.initial_dimensions,
        "n": cells.axis_values,
        "x": quadrature.coordinates,
        "third_in_tension": tension,
    }.items():
        saved[name] = domain.gather_elements(values)
    if MPI.COMM_WORLD.rank == 0:
        columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
        np.savez(out, **columns, **saved)  # type: ignore[arg-type]
    simulation.close()


if __name__ == "__main__":
    for path, text in zip(sys.argv[1::2], sys.argv[2::2], strict=True):
        main(path, json.loads(text))
