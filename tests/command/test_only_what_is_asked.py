"""Nothing is computed, stored or written that nobody asked for: counted, not timed."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx import Recording, Scene, SceneError, Simulation, run
from remodel_fenicsx.evolution.remodeling import RemodelingPass
from remodel_fenicsx.fem import assembly, jit
from remodel_fenicsx.fem.quadrature import Quadrature
from remodel_fenicsx.results import run_folder
from remodel_fenicsx.scene import scene_from_dict
from remodel_fenicsx.schema.settings import FIELDS_BY_NAME
from remodel_fenicsx.solver.continuation import Blend, Work
from remodel_fenicsx.solver.equilibrium import Equilibrium
from remodel_fenicsx.watch.warnings import LockingWarning
from tests.parts import pulled_cube
from tests.runs import made, rows_of

SELF = MPI.COMM_SELF


def scene(**tables: Any) -> Scene:
    """A cube as a point, three steps."""
    base: dict[str, Any] = {"preset": "kuhl-holzapfel-2007", "geometry": {"shape": "cube"}, "time": {"end": 3.0}}
    return scene_from_dict(base | {"model": {"kinematics": "point"}} | tables)


class Calls:
    """Counts the calls of a function."""

    def __init__(self, patch: pytest.MonkeyPatch, owner: Any, name: str):
        self.number, function = 0, getattr(owner, name)

        def counted(*arguments: Any, **options: Any) -> Any:
            self.number += 1
            return function(*arguments, **options)

        patch.setattr(owner, name, counted)


def test_a_state_is_looked_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """How far it is from its limits: at the start of a step, of its solve, and for each Newton iteration."""
    calls = Calls(monkeypatch, Equilibrium, "_look")
    with made(scene()) as simulation:
        iterations = sum(step.work.newton_iterations for step in simulation.stepper.march([1.0, 2.0, 3.0]))
        assert iterations >= 6 and calls.number <= iterations + 2 * 3 + 1


def test_a_state_is_evaluated_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """r, J and F together where it is looked at, F and the driver in the pass; parameters only where they change."""
    with made(scene()) as simulation:
        march = simulation.stepper.march([1.0, 2.0, 3.0])
        next(march)
        evaluations = Calls(monkeypatch, Quadrature, "evaluate")
        parameters = Calls(monkeypatch, assembly, "point_values")
        iterations = sum(step.work.newton_iterations for step in march)
        assert evaluations.number <= iterations + 2 * 2 and parameters.number == 0


def test_energies_of_elements_are_summed_up_once_a_look(monkeypatch: pytest.MonkeyPatch) -> None:
    """They tell whether to look for elements that lock, and what such a look begins with."""
    calls, looks = (Calls(monkeypatch, LockingWarning, name) for name in ("energies", "work"))
    with made(pulled_cube(3.0)) as simulation:
        assert [step.is_due for step in simulation.steps()] == [True, False, True]
    assert calls.number == 2 and looks.number


def test_what_is_remembered_follows_every_change() -> None:
    """Of cells, unknowns and live parameters."""
    with made(scene()) as simulation:
        equilibrium, cells = simulation.stepper.coupling.equilibrium, simulation.cells
        seen = [equilibrium.extension().max_chain_extension]
        simulation.unknown.x.array[:] = 0.05
        seen.append(equilibrium.extension().max_chain_extension)
        cells.dimension_values[:] *= 1.1
        seen.append(equilibrium.extension().max_chain_extension)
        equilibrium.tissue.contour_length.value *= 2
        seen.append(equilibrium.extension().max_chain_extension)
        np.testing.assert_allclose(np.array(seen[1:]) / seen[:-1], [1.05, 1.1, 0.5], rtol=1e-12)


@pytest.mark.parametrize(
    ("remodeling", "passes"),
    [
        ({}, 3),
        ({"kappa": 0.0}, 0),
        ({"law": "none"}, 0),
        ({"law": "tensor", "kappa": 0.0}, 0),
        ({"coupling": "implicit", "kappa": 0.0}, 0),
        ({"law": "rotation", "kappa": 0.0}, 3),
    ],
)
def test_cells_that_never_move_have_no_pass(
    remodeling: dict[str, Any], passes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither a pass nor its kernel; the law of rotation has a time of its own in place of kappa."""
    calls, kernels = Calls(monkeypatch, RemodelingPass, "apply"), Calls(monkeypatch, jit, "expression")
    cells = {"initial": [0.6, 0.0, 0.8]}
    model = {"kinematics": "full" if "rotation" in remodeling.values() else "point"}
    with made(scene(remodeling=remodeling, cells=cells, model=model)) as simulation:
        needed, before = kernels.number, simulation.cells.structure_tensor().copy()
        list(simulation.steps())
        assert calls.number == passes
        if not remodeling or not passes:  # the axis that the law of rotation turns lies along the load already
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
    asked: dict[str, Any] = {"all": True, "two": ["displacement", "fibre_angle"], "chains": ["chains"], "none": False}
    folders = {name: run(scene(output={"fields": fields}), tmp_path / name, SELF) for name, fields in asked.items()}
    whole = Recording(folders["all"]).fields(3.0)
    assert set(whole) == set(FIELDS_BY_NAME) - {
        "chains",
        "region",
        "fibre_angle_unloaded",
        "natural_gradient",
        "content",
        "natural_length",
    }
    two = Recording(folders["two"]).fields(3.0)
    assert set(two) == {"displacement", "fibre_angle"}
    assert all(np.array_equal(two[name], whole[name]) for name in two)
    written = {name: {path.name for path in folder.glob("fields*")} for name, folder in folders.items()}
    assert written["all"] == {"fields.vtkhdf", "fields_chains.vtkhdf"}
    assert written["two"] == {"fields.vtkhdf"} and written["none"] == set()
    sizes = {name: (folders[name] / "fields.vtkhdf").stat().st_size for name in ("all", "two")}
    assert sizes["two"] < 0.6 * sizes["all"]
    chains = [(folders[name] / "fields_chains.vtkhdf").stat().st_size for name in ("all", "chains")]
    assert chains[0] == chains[1]
    with pytest.raises(SceneError, match=r"output.fields = \['stress'\]: must be true, false or a list of"):
        scene(output={"fields": ["stress"]})


def test_stress_that_nobody_writes_is_not_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    from remodel_fenicsx.results.fields import ElementFields

    sizes = []
    for driver, name in (("cauchy", "cauchy_stress"), ("pk2", "cauchy_stress"), ("cauchy", "fibre_angle")):
        with made(scene().with_values({"remodeling.driver": driver})) as simulation:
            fields = ElementFields(simulation.scene.geometry, simulation.stepper, [name])
            assert set(fields()) == {name}
            sizes.append(None if fields._state is None else fields._state.components)
            assert (fields._shared is simulation.stepper.remodeling) == (sizes[-1] is None)
    assert sizes == [None, 18, 9]  # the stress that drives the cells is there already


def test_rows_that_come_fast_are_flushed_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice a second, before a checkpoint, and at the end; every row is in the file at once."""
    flushes, now = Calls(monkeypatch, os, "fsync"), 0.0
    monkeypatch.setattr(run_folder.clock, "monotonic", lambda: now)
    written = run_folder.History(tmp_path / "history.csv")
    for number in range(101):
        now = number / 50
        written.append({"time": float(number)})
        assert (tmp_path / "history.csv").read_text().count("\n") == number + 2
    assert flushes.number == 5  # at 0, 0.5, 1, 1.5, 2 s
    written.append({"time": 101.0})
    written.flush()
    written.flush()
    assert flushes.number == 6
    written.append({"time": 102.0})
    written.close()
    written.close()
    assert flushes.number == 7


def test_the_rows_of_a_checkpoint_are_on_the_disk_before_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    order: list[str] = []
    from remodel_fenicsx.results import checkpoint

    write, flush = checkpoint.write_checkpoint, run_folder.History.flush
    monkeypatch.setattr(checkpoint, "write_checkpoint", lambda *a: (order.append("checkpoint"), write(*a)))
    monkeypatch.setattr(run_folder.History, "flush", lambda self: (order.append("rows"), flush(self)))
    monkeypatch.setattr(run_folder, "FLUSHED_AFTER", 1e9)
    run(scene(output={"fields": False, "checkpoint": 2}), tmp_path / "run", SELF)
    assert [entry for entry in order if entry][-3:] == ["rows", "checkpoint", "rows"]
    assert order.count("checkpoint") == 2


def test_a_run_imports_only_what_it_needs(tmp_path: Path) -> None:
    """No Gmsh for a lattice, no HDF5 without fields, no bar without a terminal, no units where none are written."""
    text = dict(scene(output={"fields": False}, time={"end": 1.0}).model_dump(mode="json"))
    program = (
        "import json, sys\nfrom remodel_fenicsx import run\nfrom remodel_fenicsx.scene import scene_from_dict\n"
        f"run(scene_from_dict(json.loads({json.dumps(text)!r})), {str(tmp_path / 'run')!r})\n"
        "print(*sorted({module.split('.')[0] for module in sys.modules}))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    imported = set(done.stdout.split())
    assert {"dolfinx", "petsc4py", "ufl"} < imported
    assert not imported & {"gmsh", "h5py", "rich", "pint", "scipy", "matplotlib", "pyvista", "pandas", "PIL"}
    assert "gmsh 4" in (tmp_path / "run" / "scene.toml").read_text()  # its version is known all the same


def test_the_printed_law_imports_no_other_coupling() -> None:
    """Nor what chooses steps, goes to an equilibrium, looks after reductions, or draws on a terminal."""
    program = (
        "import sys\nfrom remodel_fenicsx import Simulation, preset_scene\n"
        "Simulation(preset_scene('kuhl-holzapfel-2007', 'cube')).close()\n"
        "print(*sorted(name for name in sys.modules if name.startswith('remodel_fenicsx.')))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    imported = done.stdout.split()
    assert "remodel_fenicsx.evolution.coupling" in imported
    others = {"evolution.implicit", "model.implicit", "evolution.homeostasis",
              "evolution.time_steps", "kernels.tensor", "system.terminal"}  # fmt: skip
    assert all(importlib.util.find_spec(f"remodel_fenicsx.{name}") for name in others)
    assert not {name.removeprefix("remodel_fenicsx.") for name in imported} & others


def test_no_form_is_made_in_the_middle_of_a_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a step in parts needs is there before the first step."""
    with made(scene()) as simulation:
        forms, expressions = Calls(monkeypatch, jit, "form"), Calls(monkeypatch, jit, "expression")
        coupling: Any = simulation.stepper.coupling
        assert isinstance(coupling.blend, Blend)
        list(simulation.stepper.march([1.0, 2.0]))
        work, before = Work(), dict(simulation.state.loading.values)
        loads = {name: 1.1 * value for name, value in before.items()}
        coupling._solve_in_parts(3.0, before, loads, work, failure=None)
        assert work.substeps >= 2  # the cells', the loads'
        assert forms.number == 0 and expressions.number == 0
