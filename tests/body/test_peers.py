"""Passive walls as pymecht 1.1.3, a Python package for tubes on one radius, computes them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from remodel_fenicsx import preset_scene
from tests.runs import rows_of
from tests.values import ramp_to

PRESSURES = (1.2, 2.4, 3.6, 4.8)
PASSIVE = {
    "cells.initial": "isotropic", "remodeling.law": "none", "model.kinematics": "radial",
    "material.lame_lambda": 31030.0, "mesh.degree": 2, "mesh.refinement": 4, "mesh.formulation": "auto",
    "loads.pressure.ramp": ramp_to(4.0), "loads.elongation.ramp": ramp_to(1.0),
    "time.end": 4.0,
}  # fmt: skip
FORCES = {"output.columns": ["inner_radius", "axial_force"]}


def passive(**changes: Any) -> Any:
    """The paper's artery, nearly incompressible and before it remodels: pressure in four steps, then each row."""
    scene = preset_scene("kuhl-holzapfel-2007", "tube").with_values({**PASSIVE, **changes})
    return rows_of(scene)


def test_a_thick_tube_is_that_of_pymecht() -> None:
    rows = passive(**FORCES)
    np.testing.assert_allclose([row["pressure"] for row in rows], PRESSURES)
    np.testing.assert_allclose(
        [row["inner_radius"] for row in rows], [1.16158, 1.49517, 1.96467, 2.25815], rtol=1e-4
    )
    assert rows[-1]["axial_force"] == pytest.approx(62.867, rel=5e-4)


@pytest.mark.parametrize(
    ("angle", "radius", "force"),
    [(60.0, 2.43220, None), (120.0, 2.54422, 68.039), (160.0, 2.57366, 68.651)],
)
def test_so_is_one_that_was_closed_from_a_sector(
    angle: float, radius: float, force: float | None
) -> None:
    row = passive(**{**FORCES, "natural.opening_angle": angle})[-1]
    assert row["inner_radius"] == pytest.approx(radius, rel=1e-4)
    assert force is None or row["axial_force"] == pytest.approx(force, rel=5e-4)
