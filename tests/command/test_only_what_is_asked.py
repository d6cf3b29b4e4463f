"""Nothing is computed, stored or written that nobody asked for: counted, not timed."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx import Recording, Scene, SceneError, Simulation, run
from remodel_fenicsx.evolution.remodeling import RemodelingPass
from remodel_fenicsx.fem import jit
from remodel_fenicsx.scene import scene_from_dict
from remodel_fenicsx.schema.settings import FIELDS_BY_NAME
from remodel_fenicsx.solver.equilibrium import Equilibrium
from tests.processes import ran
from tests.runs import made, rows_of

SELF = MPI.COMM_SELF


def scene(**tables: Any) -> Scene:
    """A cube as a point, three steps."""
    base: dict[str, Any] = {
        "preset": "kuhl-holzapfel-2007",
        "geometry": {"shape": "cube"},
        "time": {"end": 3.0},
    }
    return scene_from_dict(base | {"model": {"kinematics": "point"}} | tables)


class Calls:
    """Counts the calls of a function."""

    def __init__(self, patch: pytest.MonkeyPatch, owner: Any, name: str):
        self.number, function = 0, getattr(owner, name)

        def counted(*arguments: Any, **options: Any) -> Any:
            self.number += 1
            return function(*arguments, **options)

        patch.setattr(owner, name, counted)


def test_what_is_remembered_follows_every_change() -> None:
    """Of cells, unknowns and live parameters."""
    with made(scene()) as simulation:
        equilibrium, cells = simulation.stepper.coupling.equilibrium, simulation.cells
        seen = [equilibrium.limits().max_chain_extension]
        simulation.unknown.x.array[:] = 0.05
        seen.append(equilibrium.limits().max_chain_extension)
        cells.dimension_values[:] *= 1.1
        seen.append(equilibrium.limits().max_chain_extension)
        equilibrium.tissue.contour_length.value *= 2
        seen.append(equilibrium.limits().max_chain_extension)
        np.testing.assert_allclose(np.array(seen[1:]) / seen[:-1], [1.05, 1.1, 0.5], rtol=1e-12)


@pytest.mark.parametrize(("remodeling", "passes"), [
    ({}, 3), ({"kappa": 0.0}, 0), ({"law": "none"}, 0), ({"law": "tensor", "kappa": 0.0}, 0),
    ({"law": "rotation", "kappa": 0.0}, 3),
])  # fmt: skip
def test_cells_that_never_move_have_no_pass(
    remodeling: dict[str, Any], passes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither a pass nor its kernel; the law of rotation has a time of its own in place of kappa."""
    calls, kernels = Calls(monkeypatch, RemodelingPass, "apply"), Calls(
        monkeypatch, jit, "expression"
    )
    cells = {"initial": [0.6, 0.0, 0.8]}
    model = {"kinematics": "full" if "rotation" in remodeling.values() else "point"}
    with made(scene(remodeling=remodeling, cells=cells, model=model)) as simulation:
        needed, before = kernels.number, simulation.cells.structure_tensor().copy()
        list(simulation.steps())
        assert calls.number == passes
        if (
            not remodeling or not passes
        ):  # the axis that the law of rotation turns lies along the load already
            assert np.array_equal(before, simulation.cells.structure_tensor()) == (passes == 0)
    if not passes:
        Simulation(scene(cells=cells), SELF).close()
        assert kernels.number - needed > needed


def test_columns_that_are_named_are_the_only_ones_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    energy = Calls(monkeypatch, Equilibrium, "stored_energy")
    rows = rows_of(scene(output={"columns": ["mean_stretch"]}))
    assert list(rows[0]) == ["time", "force", "mean_stretch"] and energy.number == 0
    rows = rows_of(scene(output={"columns": ["pass_residual"]}))
    assert {"mean_stretch", "stored_energy", "pass_residual"} < set(rows[0]) and energy.number == 4
    with pytest.raises(SceneError, match="output.columns = 'inner_radius': no such column"):
        scene(output={"columns": ["inner_radius"]})


def test_fields_that_are_named_are_the_only_ones_written(tmp_path: Path) -> None:
    asked: dict[str, Any] = {
        "all": True,
        "two": ["displacement", "fibre_angle"],
        "chains": ["chains"],
        "none": False,
    }
    folders = {
        name: run(scene(output={"fields": fields}), tmp_path / name, SELF)
        for name, fields in asked.items()
    }
    whole = Recording(folders["all"]).fields(3.0)
    absent = "chains region fibre_angle_unloaded natural_gradient content natural_length growth "
    absent += "hoop_stress axial_stress"
    assert set(whole) == set(FIELDS_BY_NAME) - {*absent.split()}
    two = Recording(folders["two"]).fields(3.0)
    assert set(two) == {"displacement", "fibre_angle"}
    assert all(np.array_equal(two[name], whole[name]) for name in two)
    written = {
        name: {path.name for path in folder.glob("fields*")} for name, folder in folders.items()
    }
    assert written["all"] == written["chains"] == {"fields.vtkhdf", "fields_chains.vtkhdf"}
    assert written["two"] == {"fields.vtkhdf"} and written["none"] == set()


def test_a_run_imports_only_what_it_needs(tmp_path: Path) -> None:
    """No Gmsh for a lattice, no HDF5 without fields, no bar without a terminal, no units where none are written."""
    text = dict(scene(output={"fields": False}, time={"end": 1.0}).model_dump(mode="json"))
    program = (
        "import json, sys\nfrom remodel_fenicsx import run\nfrom remodel_fenicsx.scene import scene_from_dict\n"
        f"run(scene_from_dict(json.loads({json.dumps(text)!r})), {str(tmp_path / 'run')!r})\n"
        "print(*sorted({module.split('.')[0] for module in sys.modules}))"
    )
    done = ran([sys.executable, "-c", program])
    assert done.returncode == 0, done.stderr
    imported = set(done.stdout.split())
    assert {"dolfinx", "petsc4py", "ufl"} < imported
    assert not imported & {
        "gmsh",
        "h5py",
        "rich",
        "pint",
        "scipy",
        "matplotlib",
        "pyvista",
        "pandas",
        "PIL",
    }
    assert (
        "gmsh 4" in (tmp_path / "run" / "scene.toml").read_text()
    )  # its version is known all the same
