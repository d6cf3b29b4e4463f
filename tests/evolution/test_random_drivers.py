"""Random cells with the drivers that over-correct, past the first steps that must be solved in parts (docs/theory.md).

A short tube on a coarse mesh, with more pressure than the paper has, so that this happens early.
"""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx.scene.scene import scene_from_dict
from remodel_fenicsx.simulation import Simulation
from tests.conftest import slowly
from tests.parts import tube

LENGTH = 0.5  # of a layer of elements
SCENE = {
    "preset": "kuhl-holzapfel-2007",
    "geometry": {"shape": "tube", "inner_radius": 1.0, "outer_radius": 3.0},
    "cells": {"initial": "random", "seed": 1},
    "loads": {"pressure": {"value": 6.0}},
    "time": {"end": 35.0},
}


@pytest.mark.parametrize(("driver", "layers"), [("pk2", 1), *slowly(("pk2", 3), ("finger", 3))])
def test_random_cells_stay_admissible_through_steps_in_parts(driver: str, layers: int) -> None:
    scene = scene_from_dict({**SCENE, "remodeling": {"driver": driver}}).with_values(
        {"geometry.length": LENGTH * layers}
    )
    domain = tube(1.0, 3.0, LENGTH * layers, degree=1, divisions=(12, 4, layers), comm=MPI.COMM_SELF)
    simulation = Simulation(scene, MPI.COMM_SELF, domain)
    rows = [step.row for step in simulation.steps()]
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    divided = np.flatnonzero(columns["substeps"] > 1)
    assert len(rows) == 35 and len(divided) > 3 and divided[0] < 30
    assert columns["max_chain_extension"].max() < 1.0 and columns["min_jacobian"].min() > 0.0
    inner, middle, outer = (columns[f"fibre_angle_{place}"][-1] for place in ("inner", "middle", "outer"))
    assert 0.0 < inner < middle < outer < 90.0
    assert outer - inner > 5.0
    # the tube is inflated, not collapsed, and the wall between its radii is no thicker than at first
    assert np.all(np.diff(columns["inner_radius"][:15]) > 0) and columns["inner_radius"].min() > 1.0
    assert np.all(columns["outer_radius"] - columns["inner_radius"] < 2.0)
