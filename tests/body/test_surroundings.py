"""Springs on the outer face of a tube: what surrounds a vessel."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx import Scene, SceneError
from remodel_fenicsx.body.reductions import choice
from remodel_fenicsx.body.tube import whole_tube
from tests.body.test_natural import scene
from tests.runs import last_row, made
from tests.values import assert_close, ramp_to

SELF = MPI.COMM_SELF


def surrounded(
    stiffness: float, kinematics: str = "radial", tangential: float = 0.0, **changes: Any
) -> Scene:
    springs = {"kind": "elastic", "stiffness": stiffness, "tangential": tangential}
    values: dict[str, Any] = {"natural.opening_angle": 0.0}
    values |= {"supports": {"outer": springs}} if stiffness else {}
    return scene(kinematics, **(values | changes))


def test_a_stiffer_surrounding_turns_the_outside_further() -> None:
    """The paper's artery at its equilibrium, of an independent solver: outer eighth of the wall, and inner radius."""
    law = {
        "remodeling.law": "tensor",
        "remodeling.coupling": "extrapolated",
        "material.repulsion": "log",
    }
    law |= {"time.end": "equilibrium", "mesh.refinement": 2, "output.columns": []}
    for stiffness, angle, radius in ((0.0, 75.2, 1.413), (0.5, 75.8, None), (2.0, 77.2, 1.409)):
        with made(surrounded(stiffness, **law)) as simulation:
            row = [step.row for step in simulation.steps()][-1]
            cells = simulation.cells
            found = simulation.observer.shape.fibre_angle(
                cells.dimension_values, cells.axis_values, cells.local_axes.axes
            )  # fmt: skip
            outside = cells.local_axes.coordinates[..., 0] > 2.75
            mean = float(np.average(found[outside], weights=simulation.quadrature.volumes[outside]))
        assert mean == pytest.approx(angle, abs=0.3)
        if radius is not None:
            assert row["inner_radius"] == pytest.approx(radius, abs=1.5e-3)


def test_kinematics_agree_on_springs() -> None:
    """Of fixed direction, square to the face: on one radius, a half-plane, a quarter and the whole tube."""
    few = {
        "time.end": 6.0,
        "loads.pressure.ramp": ramp_to(5),
        "loads.elongation.ramp": ramp_to(5),
    }
    ends = {
        name: last_row(surrounded(2.0, name, **few))
        for name in ("radial", "axisymmetric", "sector")
    }
    without = last_row(surrounded(0.0, "radial", **few))
    assert without["outer_radius"] - ends["radial"]["outer_radius"] > 0.02
    for name in ("axisymmetric", "sector"):
        assert_close(ends[name], ends["radial"], ("inner_radius", "outer_radius"), atol=2e-3)


def test_springs_along_the_wall_need_what_shows_them() -> None:
    """Sections do not stay plane: the half-plane and the whole tube agree, one radius is refused, with its reason."""
    few = {
        "time.end": 2.0,
        "loads.pressure.ramp": ramp_to(2),
        "loads.elongation.ramp": ramp_to(2),
    }
    few |= {"time.step": 1.0}
    assert choice(surrounded(2.0, "auto", 1.0)).name == "axisymmetric"
    assert choice(surrounded(2.0, "auto", 0.0)).name == "radial"
    with pytest.raises(
        SceneError, match="supports.outer.tangential is above 0: sections do not stay plane"
    ):
        surrounded(2.0, "radial", 1.0)
    half = last_row(surrounded(2.0, "axisymmetric", 1.0, **few))
    whole = surrounded(2.0, "full", 1.0, **few)
    full = last_row(whole, whole_tube(whole.geometry, (8, 4, 2), "hexahedron", 2, SELF))
    across = last_row(surrounded(2.0, "axisymmetric", 0.0, **few))
    assert abs(half["stored_energy"] / across["stored_energy"] - 1) > 1e-3
    assert full["stored_energy"] == pytest.approx(half["stored_energy"], rel=3e-3)
    assert full["outer_radius"] == pytest.approx(half["outer_radius"], abs=2e-3)
