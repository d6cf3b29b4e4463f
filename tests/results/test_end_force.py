"""The force on the ends of a tube, measured in every kinematics, against solutions that share nothing with it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx import Simulation, cli
from remodel_fenicsx.scene import Scene, scene_from_dict
from tests.parts import tube
from tests.reference.radial import solve_radial
from tests.runs import last_row, rows_and_looks, rows_of
from tests.values import assert_close, isotropic, ramped

SELF = MPI.COMM_SELF
END = 2.0
FORCES = ["axial_force", "reduced_axial_force"]


def scene(kinematics: str, **tables: Any) -> Scene:
    base = {
        "loads": ramped(END, pressure=2.4, elongation=0.05),
        "remodeling": {"kappa": 0.1},
        "time": {"end": END},
    }
    return scene_from_dict(
        isotropic(kinematics=kinematics, **base | {"output": {"columns": FORCES}} | tables)
    )


def test_the_force_is_that_of_the_one_dimensional_reference() -> None:
    """2 pi int sigma_zz r dr of a solver that shares no code; less p pi r_i^2 of its inner radius."""
    reference = solve_radial(pressure=2.4, stretch=0.05, ramp_time=END, end=END, kappa=0.1)
    inside = reference.stretches[..., 0] * reference.stretches[..., 2] * reference.areas
    wall = 2 * np.pi * np.sum(inside * reference.cauchy[..., 1], axis=1)
    thrust = reference.pressures * np.pi * reference.inner_radii**2
    rows = rows_of(scene("radial", mesh={"refinement": 4, "degree": 2}))
    np.testing.assert_allclose([row["axial_force"] for row in rows], wall, rtol=1e-6)
    np.testing.assert_allclose(
        [row["reduced_axial_force"] for row in rows], wall - thrust, rtol=1e-6
    )


@pytest.mark.parametrize("tables", [{}, {"supports": {"ends": "clamped"}}])
def test_the_half_plane_and_the_quarter_carry_the_force_of_the_ray(tables: dict[str, Any]) -> None:
    clamped = "supports" in tables
    ray = last_row(scene("axisymmetric" if clamped else "radial", **tables))
    for name, tolerance in (("axisymmetric", 1e-9), ("sector", 0.04)):
        assert_close(last_row(scene(name, **tables)), ray, FORCES, tolerance)


def reaction(simulation: Simulation) -> tuple[float, float]:
    """Out-of-balance forces along z at the nodes of the top, and of the bottom."""
    equilibrium, unknown = simulation.stepper.coupling.equilibrium, simulation.unknown
    internal, external = (unknown.x.petsc_vec.duplicate() for _ in range(2))
    equilibrium.assemble_internal(internal)
    equilibrium.assemble_external(external)
    forces = (internal.array + external.array).reshape(-1, 3)[:, 2]
    z = unknown.function_space.tabulate_dof_coordinates()[:, 2]
    return float(forces[np.isclose(z, 1.0)].sum()), float(forces[np.isclose(z, 0.0)].sum())


@pytest.mark.parametrize("formulation", ["displacement", "selective-integration"])
def test_random_cells_pull_at_the_end_with_the_reaction_of_its_nodes(formulation: str) -> None:
    """To rounding, in every formulation. The lumen is no cylinder: the pressure pushes the wall along, and so the ends
    carry different forces; what is reduced by the pressure on either lumen is the same."""
    made = scene("full", geometry={"shape": "tube", "length": 1.0}, mesh={"formulation": formulation},
                 cells={"initial": "random", "seed": 3})  # fmt: skip
    domain = tube(1.0, 3.0, 1.0, divisions=(12, 3, 2), comm=SELF)
    rows, reactions = rows_and_looks(made, reaction, domain)
    for row, (top, bottom) in zip(rows, reactions, strict=True):
        assert row["axial_force"] == pytest.approx(top, rel=1e-9)
        assert abs(top + bottom) > 1e-6 * abs(top)
        lumen = (row["axial_force"] - row["reduced_axial_force"]) / row["pressure"]
        assert lumen == pytest.approx(
            12 / 2 * np.sin(np.pi / 6) * row["inner_radius"] ** 2, rel=0.02
        )


@pytest.mark.parametrize(
    "kinematics", ["radial", pytest.param("axisymmetric", marks=pytest.mark.slow)]
)
def test_closed_ends_need_no_force_and_a_load_is_what_a_machine_measures(kinematics: str) -> None:
    for force in (0.0, 5.0):
        loads = ramped(END, pressure=2.4, elongation=0.0, axial_force=force)
        rows = rows_of(scene(kinematics, supports={"ends": "closed"}, loads=loads))
        given = [force * row["time"] / END for row in rows]
        np.testing.assert_allclose([row["reduced_axial_force"] for row in rows], given, atol=1e-8)
        thrust = [row["pressure"] * np.pi * row["inner_radius"] ** 2 for row in rows]
        np.testing.assert_allclose(
            [row["axial_force"] for row in rows], np.add(given, thrust), atol=1e-8
        )
    rows = rows_of(scene(kinematics, loads=loads))  # free ends: the load is the force of the wall
    np.testing.assert_allclose([row["axial_force"] for row in rows], given, atol=1e-8)


def test_the_tensor_law_pulls_with_what_its_energy_says() -> None:
    """dW/de at fixed radii and cells is the work of stresses along the axis: a difference of two energies."""
    made = scene(
        "radial", remodeling={"law": "tensor", "kappa": 0.1}, material={"repulsion": "log"}
    )

    def look(simulation: Simulation) -> float:
        equilibrium, loading = simulation.stepper.coupling.equilibrium, simulation.loading
        loads, found = dict(loading.values), []
        for change in (1e-5, -1e-5):
            loading.set({"elongation": loads["elongation"] + change})
            found.append(equilibrium.stored_energy())
        loading.set(loads)
        return (found[0] - found[1]) / 2e-5 / float(made.geometry.axial_length)

    rows, energies = rows_and_looks(made, look)
    np.testing.assert_allclose([row["axial_force"] for row in rows], energies, rtol=1e-7)


def test_a_column_that_a_scene_cannot_have_is_refused_before_anything_runs(
    tmp_path: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    """In `validate` and in `run`, in one line that names what is allowed; fields too."""
    place = tmp_path / "scene.toml"
    place.write_text('preset = "kuhl-holzapfel-2007"\n[geometry]\nshape = "cube"\n')
    for key, name, allowed in (
        ("columns", "axial_force", "'force'"),
        ("fields", "stress", "'cauchy_stress'"),
    ):
        for command in (["validate"], ["run", "-o", str(tmp_path / "out")]):
            code = cli.main(
                [command[0], str(place), f"--set=output.{key}=['{name}']", *command[1:]]
            )
            error = capfd.readouterr().err
            assert code == 2 and error.count("\n") == 1 and not (tmp_path / "out").exists()
            assert f"'{name}'" in error and f"output.{key}" in error and allowed in error
