"""What docs/verification.md shows beside the figures: comparisons with the radial reference, invariance.

Each study is a table, NAME.csv. They take minutes.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from demos.figures import scenes
from docs.making.pages import by_column
from remodel_fenicsx.evolution.remodeling import RemodelingPass
from remodel_fenicsx.evolution.stepper import Step, Watcher
from remodel_fenicsx.model.spectral import positive_direction
from remodel_fenicsx.results.columns import Measurement
from remodel_fenicsx.studies.page import Page
from remodel_fenicsx.system.children import cores
from tests.runs import last_row, made

Row = dict[str, Any]
# ---------------------------------------------------------------- against the radial reference


def comparison(setting: Any) -> Row:
    """A setting of tests/radial_comparison.py and its errors; radii in percent, angles in degrees."""
    from tests import radial_comparison

    found = radial_comparison.errors(setting)
    angles = {f"angle_{name}": getattr(found, name) for name in ("mean", "largest", "mean_outside", "outside")}
    return {
        "stretch": setting.stretch, "pressure": setting.pressure, "driver": setting.driver, "law": setting.law,
        "supports": "symmetry planes" if setting.planes else "the scene's", "degree": setting.degree,
        "around": setting.divisions[0], "through": setting.divisions[1], "end": setting.end,
        "front_from": setting.front[0], "front_to": setting.front[1],
        "radii_percent": 100 * max(found.inner_radius, found.outer_radius), **angles,
        "inner_radius_error": found.inner_radius, "outer_radius_error": found.outer_radius,
    }  # fmt: skip


def layer_mean(setting: Any) -> Row:
    """The mean angle in the fourth of eight layers of the wall, the last before its middle."""
    from tests import radial_comparison

    run, exact = radial_comparison.finite_elements(setting), radial_comparison.reference(setting)
    layer = (run.R > 1.75) & (run.R < 2.0)
    mean = float(np.average(run.angle[layer], weights=run.volume[layer]))
    return {"around": setting.divisions[0], "through": setting.divisions[1], "degree": setting.degree,
            "fibre_angle_4": mean, "reference_4": exact.mean_fibre_angle(1.75, 2.0)}  # fmt: skip


# ---------------------------------------------------------------- invariance


def invariance(case: tuple[str, str, str]) -> Row:
    """The bar of tests/model/test_invariance.py twice, once turned: what differs, by r0, the side and the energy."""
    from remodel_fenicsx.model.cells import angle_to_axis
    from tests.model import test_invariance as bars

    driver, frame, turned = case
    if turned == "deformed body":
        turn = np.eye(3)
        still, other = bars.pair(driver, frame, bars.QUARTER)
    else:
        turn = bars.OBLIQUE
        still, other = bars.Bar(driver, frame), bars.Bar(driver, frame, turned_reference=turn)
        for bar in (still, other):
            bar.march(0, bars.END)
    axis = np.array([0.0, 0.0, 1.0])
    angles = [np.mean(angle_to_axis(bar.lengths, bar.body.cells.axis_values, axes @ axis))
              for bar, axes in ((still, np.eye(3)), (other, turn))]  # fmt: skip
    return {
        "driver": driver,
        "frame": frame,
        "turned": turned,
        "lengths": np.abs(other.lengths - still.lengths).max(),
        "tensor": np.abs(other.tensor - turn @ still.tensor @ turn.T).max(),
        "position": np.abs(other.position - still.position).max(),
        "energy": abs(other.problem.stored_energy() / still.problem.stored_energy() - 1),
        "angle_still": angles[0],
        "angle_turned": angles[1],
    }


# ---------------------------------------------------------------- single runs


class Passes(Watcher):
    """Counts, for every point, the passes in which a principal value of the driving tensor was positive."""

    def __init__(self, remodeling: RemodelingPass):
        self.remodeling, self.shape = remodeling, remodeling.quadrature.shape
        self.number = np.zeros(self.shape, dtype=int)
        self.active = np.ones(self.shape, dtype=bool)
        self.largest = np.zeros(self.shape)

    def solved(self, step: Step) -> None:
        """Look at what the pass of this step will see."""
        drive = self.remodeling.drive()
        values = np.linalg.eigvalsh(drive.tensor)
        self.largest = values[:, 2].reshape(self.shape)
        self.active = positive_direction(values, drive.noise)[1].reshape(self.shape)
        self.number += self.active


def stopped_points(name: str, **changes: Any) -> list[Row]:
    """Points of a run of the figures where no principal stress is positive in the last pass, so that it does nothing.

    `passes`: in how many passes the point did remodel before.
    """
    with made(scenes()[name].with_values({"output.fields": False, **changes})) as simulation:
        passes = Passes(simulation.stepper.remodeling)
        *_, last = simulation.steps([passes])
        x, angle = simulation.quadrature.coordinates, Measurement(simulation.observer, last).fibre_angle
    return [
        {"element": element, "radius": np.hypot(*x[element, point, :2]), "passes": passes.number[element, point],
         "largest_stress": passes.largest[element, point], "fibre_angle": angle[element, point]}
        for element, point in np.argwhere(~passes.active)
    ]  # fmt: skip


def stiff_tendon(name: str, **changes: Any) -> list[Row]:
    """The tendon with four times the energy of its chains (erratum 1): its stretch at the end."""
    scene = scenes()[name].with_values({"output.fields": False, "material.energy_factor": 4, **changes})
    row = last_row(scene)
    return [{name: row[name] for name in ("time", "mean_stretch")}]


# ---------------------------------------------------------------- all of them
Job = tuple[Callable[[Any], Any], Any]


def jobs() -> dict[str, list[Job]]:
    """By table, what gives its rows."""
    from tests import radial_comparison as compared

    meshes = [setting for settings in compared.CONVERGENCE.values() for setting in settings]
    # Fig. 9's pure pressure on the paper's mesh, in one layer along z, and on one twice as fine
    coarse, fine = (compared.Setting(0.0, 4.8, divisions=(12 * n, 8 * n, 1), degree=1) for n in (1, 2))
    # the deformed body turned by 90 degrees, and everything turned about an oblique axis
    turned = [(driver, frame, what) for what in ("deformed body", "everything")
              for frame in ("material", "spatial") for driver in ("cauchy", "pk2", "finger")]  # fmt: skip
    return {
        "stopped-points": [(stopped_points, "artery-0-4.8")],
        "stiff-tendon": [(stiff_tendon, "tendon")],
        "comparison-cases": [(comparison, setting) for setting in compared.LOAD_CASES],
        "comparison-drivers": [(comparison, setting) for setting in compared.DRIVERS],
        "pressure-meshes": [(layer_mean, setting) for setting in (coarse, fine)],
        "comparison-meshes": [(comparison, setting) for setting in meshes],
        "invariance": [(invariance, case) for case in turned],
    }


def called(job: Job) -> list[Row]:
    """Rows of a job, in a process of its own."""
    found = job[0](job[1])
    return found if isinstance(found, list) else [found]


def study(folder: Path, keep: bool) -> list[str]:
    """Write the tables, or with `keep` only those that are not there; returns the names of all."""
    tables = jobs()
    wanted = {name: of for name, of in tables.items() if not (keep and (folder / f"{name}.csv").is_file())}
    os.environ["OMP_NUM_THREADS"] = "1"  # of the processes below, one for each core
    pool = ProcessPoolExecutor(cores(), multiprocessing.get_context("spawn"))
    try:
        pending = {name: [pool.submit(called, job) for job in of] for name, of in wanted.items()}
        for name, futures in pending.items():
            print(f"verification: {name}", file=sys.stderr, flush=True)
            rows = [row for future in futures for row in future.result()]
            Page(folder, name).save_table(by_column(rows), ["docs/making/studies.py"])
    finally:
        pool.shutdown(cancel_futures=True)  # after a failure the rest is not waited for
    return list(tables)
