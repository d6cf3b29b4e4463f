"""The laws of the paper and the consistent one on the paper's artery, implicit and extrapolated: minutes each."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx.scene.scene import Scene, scene_from_dict
from remodel_fenicsx.simulation import Simulation
from tests.conftest import Case

pytestmark = pytest.mark.slow
COLUMNS = ["newton_iterations", "substeps", "inner_radius", "outer_radius"]
SECTOR = {"geometry": {"shape": "tube"}, "model": {"kinematics": "sector"}, "cells": {"initial": "isotropic"}}


def artery(end: float, step: float = 1.0, law: str = "tensor", **changes: Any) -> dict[str, Any]:
    """Values of a scene; `tables` lie over them."""
    tables = changes.pop("tables", {"geometry": {"shape": "tube"}})
    remodeling = {"law": law, "coupling": "implicit", "frame": "material"} | changes
    return {
        "preset": "kuhl-holzapfel-2007",
        "material": {"repulsion": "log" if law == "tensor" else "axes"},
        "remodeling": remodeling,
        "time": {"end": end, "step": step},
        "solver": {"method": "direct", "predictor": "none"},
        "output": {"columns": COLUMNS, "fields": False},
    } | tables


def history(scene: Scene) -> tuple[dict[str, np.ndarray], Simulation]:
    """Columns by step, and the end."""
    simulation = Simulation(scene, MPI.COMM_SELF)
    rows = [step.row for step in simulation.steps()]
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}, simulation


@pytest.mark.parametrize(
    ("driver", "frame", "inner", "outer"),
    [
        ("finger", "material", 1.546, 3.126),
        ("finger", "spatial", 1.548, 3.127),
        ("cauchy", "material", 1.421, 3.062),
        ("cauchy", "spatial", 1.424, 3.063),
        ("pk2", "material", 1.422, 3.062),
    ],
)
def test_the_printed_law_to_the_end(driver: str, frame: str, inner: float, outer: float) -> None:
    """A quarter of the paper's mesh, which is exact for isotropic cells: six iterations a step at most."""
    found, _ = history(scene_from_dict(artery(150.0, law="explicit", driver=driver, frame=frame, tables=SECTOR)))
    assert found["newton_iterations"][1:].max() <= 6
    assert found["substeps"].max() == 1
    assert abs(found["inner_radius"][-1] - inner) < 2e-3 and abs(found["outer_radius"][-1] - outer) < 2e-3


@pytest.mark.parametrize("coupling", ["implicit", "extrapolated"])
def test_the_consistent_law_on_one_and_two_ranks(case: Case, coupling: str) -> None:
    """The whole mesh, random cells, 24 steps of the ramp: no step in parts, five iterations a step."""
    scene = artery(24.0, coupling=coupling)
    one, two = (case(scene, ranks=ranks) for ranks in (1, 2))
    assert max(one["substeps"]) == 1
    assert np.mean(one["newton_iterations"]) <= 5
    for name in ("u", "l"):
        np.testing.assert_allclose(two[name], one[name], atol=1e-7)
    np.testing.assert_allclose((np.asarray(one["l"]) ** 2).sum(axis=-1), 1.0, atol=1e-13)


def test_the_consistent_law_from_random_cells_to_the_end() -> None:
    """The whole mesh, implicit, t = 150: no step in parts, four iterations a step in the mean."""
    found, _ = history(scene_from_dict(artery(150.0)))
    assert found["substeps"].max() == 1
    assert found["newton_iterations"].mean() <= 4
