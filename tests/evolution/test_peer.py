"""Random cells that remodel in three dimensions, as FElupe 11.3, another finite element code, has them."""

from __future__ import annotations

import numpy as np
import pytest

from remodel_fenicsx import preset_scene
from tests.runs import simulated
from tests.values import PAPER, ramped

# made by benchmarks/peers.py `write_problem` of this scene and mesh, and benchmarks/peer_felupe.py
# with tensortrax, 5 steps, tolerance 1e-12: root mean square over the nodes of u_x, u_y and u_z
FELUPE = [0.505435699, 0.4443364331, 0.5046086328]


def test_the_remodeled_artery_is_that_of_felupe(monkeypatch: pytest.MonkeyPatch) -> None:
    """The printed method on few elements: neither matrix, chains, pressure nor pass share a line with it."""
    monkeypatch.setattr("remodel_fenicsx.body.tube.PAPER", (8, 2, 2))
    loads, solver = ramped(4.0, pressure=4.8, elongation=0.1), {"solver.relative_tolerance": 1e-12}
    values = {"loads": loads, "remodeling.kappa": 0.1, "time.end": 5.0, **solver}
    with simulated(preset_scene(PAPER, "tube").with_values(values)) as (simulation, rows):
        displacement = simulation.state.gathered_displacement()
    assert displacement is not None
    np.testing.assert_allclose(np.sqrt((displacement**2).mean(axis=0)), FELUPE, rtol=1e-8)
    assert rows[-1]["fibre_angle_inner"] < 40.0  # from 45 at random
