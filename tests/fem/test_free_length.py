"""A length that is an unknown: axial force given, and ends closed by caps on which the pressure acts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx import Recording, Simulation, cli
from remodel_fenicsx.body.reductions import AUTO
from remodel_fenicsx.fem import jit
from remodel_fenicsx.scene import scene_from_dict
from remodel_fenicsx.solver.equilibrium import PointStresses
from tests.conftest import Case
from tests.parts import tube
from tests.runs import columns, goes_on, rows_and_looks, rows_of
from tests.values import assert_close, isotropic, ramped

SELF = MPI.COMM_SELF
END = 4.0


def values(kinematics: str, loads: dict[str, Any], **tables: Any) -> dict[str, Any]:
    direct = {"method": "direct"}  # whose iterations are counted
    base = {
        "loads": ramped(END, pressure=4.8, elongation=0.0) | loads,
        "solver": direct,
        "output": None,
    }
    return isotropic(
        kinematics=kinematics,
        **base | {"remodeling": {"kappa": 0.1}, "time": {"end": END}} | tables,
    )


def nodal_reaction(simulation: Simulation) -> float:
    """Sum of the internal forces along z at the nodes of the top."""
    equilibrium = simulation.stepper.coupling.equilibrium
    vector = simulation.unknown.x.petsc_vec.duplicate()
    equilibrium.assemble_internal(vector)
    forces: NDArray[np.float64] = vector.array.reshape(-1, 3)
    top = np.isclose(simulation.unknown.function_space.tabulate_dof_coordinates()[:, 2], 1.0)
    return float(forces[top, 2].sum())


def integral_of_stress(simulation: Simulation) -> float:
    """Integral of P_zz over the body over its length."""
    state, quadrature = simulation.state, simulation.quadrature
    stresses = PointStresses(state, simulation.tissue)
    stresses.refresh()
    P = stresses.ufl.first_piola_kirchhoff
    found = quadrature.evaluate(jit.expression(ufl.as_vector([P[2, 2]]), quadrature.points), (1,))[
        ..., 0
    ]
    return quadrature.integral(found) / simulation.scene.geometry.axial_length


def as_load(forces: list[float]) -> dict[str, Any]:
    return {
        "value": 1.0,
        "ramp": [[0.0, 0.0], *([float(n), force] for n, force in enumerate(forces, start=1))],
    }


@pytest.mark.parametrize(
    ("kinematics", "force_of"),
    [("radial", integral_of_stress), pytest.param("full", nodal_reaction, marks=pytest.mark.slow)],
)
def test_the_reaction_of_a_prescribed_length_gives_that_length(
    kinematics: str, force_of: Any
) -> None:
    length = {"length": 1.0} if kinematics == "full" else {}
    geometry = {"shape": "tube"} | length
    elongation = {"elongation": {"value": 0.1, "ramp": [[0, 0], [END / 2, 1]]}}
    domain = None
    if length:
        domain = tube(1.0, 3.0, 1.0, degree=1, divisions=(12, 3, 1), comm=SELF)
    prescribed, forces = rows_and_looks(
        values(kinematics, elongation, geometry=geometry), force_of, domain
    )
    assert min(forces) > 1.0 and np.ptp(forces) > 1.0
    asked = values(kinematics, {"axial_force": as_load(forces)}, geometry=geometry)
    found = rows_of(asked, domain)
    names = ("axial_elongation", "inner_radius", "stored_energy")
    assert_close(columns(found), columns(prescribed), names, 1e-9, 0.0)
    np.testing.assert_allclose([row["axial_force"] for row in found], forces, rtol=1e-9)
    assert max(row["newton_iterations"] for row in found) <= 6  # one method for field and length


def test_closed_ends_carry_the_force_on_the_caps() -> None:
    """p pi r_i^2 of the deformed inner radius."""
    closed = rows_of(values("radial", {}, supports={"ends": "closed"}))
    assert "axial_force" not in closed[0] and closed[-1]["axial_elongation"] > 1e-3
    forces = [row["pressure"] * np.pi * row["inner_radius"] ** 2 for row in closed]
    pulled = rows_of(values("radial", {"axial_force": as_load(forces)}))
    assert_close(columns(pulled), columns(closed), ("axial_elongation", "inner_radius"), 1e-9, 0.0)
    free = rows_of(values("radial", ramped(END, axial_force=0.0)))
    assert free[-1]["axial_elongation"] < 0.0 < closed[-1]["axial_elongation"]


def test_the_equilibrium_of_a_closed_tube() -> None:
    """The cells take the length with them."""
    tables = {"supports": {"ends": "closed"}, "output": {"columns": ["pass_residual"]}}
    closed = values("radial", {}, **tables)
    at_once, in_time = (
        rows_of(closed | {"time": time})
        for time in ({"end": "equilibrium"}, {"end": 240.0, "step": 2.0})
    )
    assert at_once[-1]["pass_residual"] < 1e-8
    assert at_once[-1]["axial_elongation"] == pytest.approx(
        in_time[-1]["axial_elongation"], abs=1e-6
    )
    assert abs(in_time[-1]["axial_elongation"] - in_time[1]["axial_elongation"]) > 0.01


@pytest.mark.slow
def test_one_and_two_ranks_agree(case: Case) -> None:
    scene = values("radial", {}, supports={"ends": "closed"})
    one, two = (case(scene, ranks=ranks) for ranks in (1, 2))
    assert_close(two, one, ("u", "l", "axial_elongation"), 1e-11, 1e-11)


# ---------------------------------------------------------------- scenes and records


def test_a_recorded_run_goes_on_and_is_revolved(tmp_path: Path) -> None:
    scene = scene_from_dict(values(AUTO, {}, supports={"ends": "closed"}))
    first, whole = goes_on(scene, tmp_path, 2.0), tmp_path / "whole"
    assert first.scene.model.kinematics == "radial"
    assert cli.main(["revolve", str(whole)]) == 0
    (whole / "fields.vtkhdf").write_bytes((whole / "fields_body.vtkhdf").read_bytes())
    body = Recording(whole)
    top = np.isclose(body.points[:, 2], 8.0)
    moved = body.fields(END)["displacement"][top, 2]
    np.testing.assert_allclose(moved, 8.0 * first.history["axial_elongation"][-1], rtol=1e-6)
