"""A geometry that is the loaded one: what is unloaded and loaded again is as given."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import dolfinx
import numpy as np
import pytest
import tomlkit
from mpi4py import MPI

from remodel_fenicsx import Recording, Scene, SceneError, Simulation, cli, read_scene, run, unloaded
from remodel_fenicsx.body.domain import dof_of_node
from remodel_fenicsx.body.mesh_file import read_mesh
from remodel_fenicsx.results.recording import RunLock
from remodel_fenicsx.scene import scene_from_dict
from remodel_fenicsx.unloading import NoUnloadedShape, inverse_tangent
from tests.conftest import Refused
from tests.body.test_natural import scene
from tests.mesh_files import TUBE, write_tube
from tests.runs import last_row, made, simulated
from tests.values import isotropic, ramped

SELF = MPI.COMM_SELF
LOADED = {
    "geometry.is": "loaded",
    "geometry.inner_radius": 1.4,
    "geometry.outer_radius": 3.05,
    "geometry.length": 2.2,
}
VIRGIN = {"remodeling.law": "none", "time.end": 25.0, "natural.opening_angle": 0.0}


@pytest.mark.parametrize(
    "changes",
    [
        {"loads.pressure.value": 1.2},
        {"loads.pressure.value": 4.8},
        {"loads.pressure.value": 2.4, "natural.opening_angle": 120.0},
        {"loads.pressure.value": 2.4, "supports.ends": "closed", "loads.elongation.value": 0.0},
        {"regions": {"inside": {"outer_radius": 2.0, "material": {"lame_mu": 2.0}}, "outside": {}}},
        {"model.kinematics": "axisymmetric"},
        {"model.kinematics": "sector", "mesh.degree": 1},
    ],
    ids=["1.2", "4.8", "opened", "closed", "regions", "axisymmetric", "sector"],
)
def test_a_tube_comes_back_to_its_loaded_radii_and_length(
    changes: dict[str, Any], caplog: pytest.LogCaptureFixture
) -> None:
    """To the tolerance of the solver, in at most seven runs."""
    of = scene("radial", **(LOADED | VIRGIN | changes))
    caplog.set_level("INFO")
    found = unloaded(of, SELF)
    runs = int(caplog.messages[-1].split("(")[1].split()[0])
    assert runs <= 7
    with made(found) as simulation:
        row = [step.row for step in simulation.steps()][-1]
        places = simulation.domain.gather_nodes(simulation.domain.mesh.geometry.x)
        moved = places + simulation.state.gathered_displacement()  # type: ignore[operator]
    radii = np.hypot(moved[:, 0], moved[:, 1])
    assert radii.min() == pytest.approx(1.4, abs=1e-7)
    assert radii.max() == pytest.approx(3.05, abs=1e-7)
    shape: Any = found.geometry
    assert shape.length * (1 + row["axial_elongation"]) == pytest.approx(2.2, abs=1e-8)
    assert shape.inner_radius < 1.3 and getattr(shape, "is") == "unloaded"


def test_the_scan_of_a_tube_that_has_remodeled() -> None:
    """`natural.cells = "equilibrium"`: its unloaded radii by an independent solver, and back to the given ones."""
    changes = {
        "natural.opening_angle": 0.0,
        "natural.cells": "equilibrium",
        "time.end": "equilibrium",
    }
    changes |= {
        "remodeling.law": "tensor",
        "remodeling.coupling": "extrapolated",
        "material.repulsion": "log",
    }
    found = unloaded(scene("radial", **(LOADED | {"geometry.length": 2.0} | changes)), SELF)
    shape: Any = found.geometry
    assert shape.inner_radius == pytest.approx(0.99114, abs=2e-4)
    assert shape.outer_radius == pytest.approx(2.99557, abs=1e-4)
    row = last_row(found)
    assert row["inner_radius"] == pytest.approx(1.4, abs=1e-6)
    assert row["outer_radius"] == pytest.approx(3.05, abs=1e-6)


# ---------------------------------------------------------------- bodies from a file
def own_values(file: str, pressure: float = 2.4, elongation: float = 0.1) -> dict[str, Any]:
    """A tube from a file that is the loaded one."""
    return isotropic(
        None, "auto", geometry={"shape": "mesh", "file": file, "is": "loaded"}, remodeling={"law": "none"},
        loads=ramped(5.0, pressure=pressure, elongation=elongation), time={"end": 5.0, "step": 1.0},
        solver={"method": "direct"},
    )  # fmt: skip


def own_scene(folder: Path, pressure: float = 2.4) -> Path:
    file = write_tube(folder / "loaded.msh", counts=(8, 1, 2))
    path = folder / "scene.toml"
    path.write_text(tomlkit.dumps(own_values(file.name, pressure)))
    return path


def nodes_of(of: Scene) -> np.ndarray:
    """At the end of a run."""
    with simulated(of) as (simulation, _):
        places = simulation.domain.gather_nodes(simulation.domain.mesh.geometry.x)
        moved: np.ndarray = places + simulation.state.gathered_displacement()  # type: ignore[operator]
    return moved


def test_every_node_of_an_own_body_comes_back(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Refused
) -> None:
    """By the command; to 1e-9, in at most ten iterations; a run from the loaded scene has the same mesh."""
    of = own_scene(tmp_path)
    assert cli.main(["unload", str(of), "-o", str(tmp_path / "found")]) == 0
    said = capsys.readouterr()
    assert (
        "nodes, largest movement 0.3647" in said.err
        and "unloaded: iteration 1, 100 % of the load" in said.err
    )
    found = read_scene(tmp_path / "found" / "scene.toml")
    given = read_mesh(tmp_path / "loaded.msh").points
    np.testing.assert_allclose(nodes_of(found), given, rtol=0, atol=1e-9)
    refused("unload", of, "-o", tmp_path / "found")
    with RunLock(tmp_path / "other.part"):  # as another process does
        assert f"process {os.getpid()} on" in refused("unload", of, "-o", tmp_path / "other")
    assert sorted(path.name for path in (tmp_path / "found").iterdir()) == [
        "scene.toml",
        "unloaded.msh",
    ]
    assert cli.main(["run", str(of), "-o", str(tmp_path / "run"), "-q"]) == 0
    same = [read_mesh(tmp_path / name / "unloaded.msh").points for name in ("found", "run")]
    np.testing.assert_allclose(*same, rtol=0, atol=1e-11)
    log = (tmp_path / "run" / "run.log").read_text()
    assert int(log.split("found in ")[1].split()[0]) <= 8
    assert cli.main(["run", "--resume", str(tmp_path / "run"), "--set", "time.end=6", "-q"]) == 0
    loads = (tmp_path / "run" / "history.csv").read_text().splitlines()
    assert len(loads) == 8


def test_the_inverse_tangent_is_the_derivative_by_unloaded_positions() -> None:
    """Taylor: forces of a body whose nodes move by e V at fixed positions under load, for e and e / 2."""
    values = own_values(str(TUBE))
    values["geometry"]["is"] = "unloaded"
    with made(values) as simulation:
        equilibrium, mesh = simulation.stepper.coupling.equilibrium, simulation.domain.mesh
        unknown = equilibrium.state.unknown
        forces, moves = unknown.x.petsc_vec.duplicate(), unknown.x.array.reshape(-1, 3)
        dofs = dof_of_node(mesh, unknown.function_space)
        random = np.random.default_rng(1)
        places, moves[:] = mesh.geometry.x.copy(), 0.03 * random.standard_normal(moves.shape)
        before, change = moves.copy(), random.standard_normal(moves.shape)
        internal, _ = inverse_tangent(equilibrium)
        tangent = dolfinx.fem.assemble_matrix(internal).to_scipy()

        def errors(size: float) -> float:
            mesh.geometry.x[:] = places + size * change[dofs]
            moves[:] = before - size * change
            equilibrium.assemble_internal(forces)
            exact = start - size * (tangent @ change.ravel())
            return float(np.linalg.norm(forces.array - exact))

        equilibrium.assemble_internal(forces)
        start = forces.array.copy()
        assert errors(1e-3) / errors(5e-4) == pytest.approx(4, rel=0.05)


@pytest.mark.parametrize(("pressure", "most"), [(1.0, 14), (4.0, 30)])
def test_a_thin_wall_is_unloaded_beyond_what_its_forward_tangent_allows(
    pressure: float, most: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Its chains carry the load: to 0.57 and 0.42 of its radius; and back at the lower pressure."""

    def thin(places: Any) -> Any:
        radii = np.hypot(places[:, 0], places[:, 1])
        narrower = (1 + 0.1 * (radii - 1)) / radii
        return places * np.column_stack([narrower, narrower, np.ones_like(radii)])

    file = write_tube(tmp_path / "thin.msh", counts=(12, 1, 3), moved=thin)
    caplog.set_level("INFO")
    values = own_values(str(file), pressure, elongation=0.0)
    found = unloaded(scene_from_dict(values), SELF, tmp_path)
    assert int(caplog.messages[-1].split("found in ")[1].split()[0]) <= most
    inner = np.hypot(*read_mesh(tmp_path / "unloaded.msh").points[:, :2].T).min()
    assert inner == pytest.approx(1 - {1.0: 0.428, 4.0: 0.584}[pressure], abs=0.01)
    if pressure == 1.0:
        np.testing.assert_allclose(nodes_of(found), read_mesh(file).points, rtol=0, atol=1e-9)


def test_multigrid_unloads_a_body_whose_tangent_is_not_symmetric(tmp_path: Path) -> None:
    """The same nodes as by factorisations."""
    file = write_tube(tmp_path / "tube.msh", "tetrahedron", degree=2, counts=(8, 1, 2))
    found = {}
    for method in ("direct", "iterative"):
        values = own_values(str(file), 5.0) | {"solver": {"method": method}}
        unloaded(scene_from_dict(values), SELF, tmp_path)
        found[method] = read_mesh(tmp_path / "unloaded.msh").points
    np.testing.assert_allclose(found["iterative"], found["direct"], rtol=0, atol=1e-8)


ON_ONE_AND_TWO_RANKS = [{"scene": own_values(str(TUBE), 0.6, elongation=0.01)}]


def test_two_ranks_find_the_same(both_ranks: Any) -> None:
    """Nodes of the body, and where its points lie before."""
    ((one, two),) = both_ranks
    for name in ("x", "u"):
        np.testing.assert_allclose(
            two[name], one[name], rtol=0, atol=1e-8
        )  # the solves have a tolerance of 1e-10


def test_what_has_no_unloaded_shape_says_at_which_share(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit code 3, and nothing is left behind; from Python an exception."""
    thin = LOADED | VIRGIN | {"geometry.inner_radius": 3.0, "loads.pressure.value": 30.0}
    with pytest.raises(
        NoUnloadedShape,
        match=r"no unloaded configuration at [\d.]+ % of the loads \(last converged: [\d.]+ %\)",
    ):
        unloaded(scene("radial", **thin), SELF)
    of = own_scene(tmp_path, pressure=500.0)
    assert cli.main(["run", str(of), "-o", str(tmp_path / "run"), "-q"]) == 3
    assert (
        "no unloaded configuration at" in capsys.readouterr().err
        and not (tmp_path / "run").exists()
    )


def test_a_loaded_shape_that_turning_cells_leave_is_warned_of(tmp_path: Path) -> None:
    """By scene and run; the way out that the line names has a row with the given radii."""
    ramp = {f"loads.{name}.ramp": [[0.0, 1.0]] for name in ("pressure", "elongation")}
    turning = scene(
        "radial", **(LOADED | {"natural.opening_angle": 0.0, "loads.pressure.value": 1.2, **ramp})
    )
    turning = turning.with_values({"time.end": 8.0, "time.step": 1.0})
    (line,) = (line for line in turning.warnings() if line.startswith("geometry.is = 'loaded': "))
    assert "natural.cells = 'equilibrium'" in line and "first step" in line
    rows = Recording(run(turning, tmp_path / "run")).history["inner_radius"]
    assert rows[1] == pytest.approx(1.4, abs=1e-6) and abs(rows[-1] - 1.4) > 1e-3
    log = (tmp_path / "run" / "run.log").read_text()
    assert log.count(line) == log.count("unloaded: ") == 1
    for still in ({"remodeling.law": "none"}, {"geometry.is": "unloaded"}):
        assert not any("geometry.is" in other for other in turning.with_values(still).warnings())


def test_a_simulation_asks_for_the_unloaded_body() -> None:
    with pytest.raises(
        SceneError, match="needs the unloaded body, from .*remodel-fenicsx unload SCENE"
    ):
        Simulation(scene("radial", **(LOADED | VIRGIN)), SELF)
