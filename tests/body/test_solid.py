"""Bodies of one's own without a lumen: faces of any name, displacements of faces, and what has no meaning there."""

from __future__ import annotations

import re
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from remodel_fenicsx import Recording, Scene, SceneError, read_scene, run
from remodel_fenicsx.body.gmsh_model import gmsh_model
from remodel_fenicsx.report import write_report
from tests.mesh_files import write_tube
from tests.runs import SELF, goes_on, last_row, rows_of
from tests.tables import rows, values
from tests.values import ramp_to

GEL = Path(__file__).parents[2] / "demos" / "gel"
RAMP = ramp_to(2.0)


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A unit cube of tetrahedra whose six faces have names."""
    path = tmp_path_factory.mktemp("solid") / "block.msh"
    with gmsh_model("block") as gmsh:
        gmsh.model.occ.addBox(0, 0, 0, 1, 1, 1)
        gmsh.model.occ.synchronize()
        for _, surface in gmsh.model.getEntities(2):
            centre = np.array(gmsh.model.occ.getCenterOfMass(2, surface))
            axis = int(np.abs(centre - 0.5).argmax())
            gmsh.model.addPhysicalGroup(
                2, [surface], name=f"{'xyz'[axis]}{int(centre[axis] > 0.5)}"
            )
        gmsh.model.addPhysicalGroup(3, [1], name="block")
        gmsh.option.setNumber("Mesh.MeshSizeMax", 0.6)
        gmsh.model.mesh.generate(3)
        gmsh.write(str(path))
    return path


def scene(file: Path, moved: dict[str, Any], **tables: Any) -> Scene:
    """Sliding on three planes, with faces that slide and are moved: name of the load by face and way."""
    slides = {"kind": "sliding", "stiffness": 1e6}
    kind = {"kind": "displacement", "ramp": RAMP}
    loads = {f"to_{face}": kind | {"face": face, "value": way} for face, way in moved.items()}
    values: dict[str, Any] = {
        "geometry": {"shape": "solid", "file": str(file), "axis": "z"}, "cells": {"initial": "isotropic"},
        "supports": {face: slides for face in ("x0", "y0", "z0", *moved)}, "loads": loads,
        "remodeling": {"law": "tensor", "coupling": "staggered"}, "time": {"end": 6.0},
        "output": {"columns": ["support_force_z0", "fibre_angle", "volume", "stored_energy", "cauchy_stress_z"]},
    }  # fmt: skip
    return Scene(**values | tables)


def test_a_block_is_pulled_as_the_cube(block: Path) -> None:
    """What its support bears, as a force on the cube, has the stretch that was given, and turns its chains alike."""
    rows = rows_of(scene(block, {"z1": 0.3}))
    ramp = [[row["time"], row["support_force_z0"]] for row in rows]
    cube = Scene(
        geometry={"shape": "cube", "side": 1.0}, cells={"initial": "isotropic"},
        loads={"force": {"value": 1.0, "ramp": ramp}}, time={"end": 6.0},
        remodeling={"law": "tensor", "coupling": "staggered"},
    )  # fmt: skip
    for row, other in zip(rows, rows_of(cube), strict=True):
        assert other["mean_stretch"] == pytest.approx(1 + row["to_z1"], rel=1e-5)
        assert row["fibre_angle"] == pytest.approx(other["mean_fibre_angle"], rel=1e-4)
        assert row["stored_energy"] == pytest.approx(other["stored_energy"], rel=1e-4, abs=1e-12)
        assert row["volume"] == pytest.approx(other["min_jacobian"], rel=1e-4)


def test_two_faces_are_moved_and_a_third_is_pressed(block: Path) -> None:
    """Each along its own normal; a pressure on a face that is free."""
    press = {"press": {"kind": "pressure", "face": "y1", "value": 0.1, "ramp": RAMP}}
    moved = scene(block, {"z1": 0.2, "x1": -0.1})
    loads = {name: load.model_dump(exclude_none=True) for name, load in moved.loads.items()}
    row = last_row(moved.with_values({"loads": loads | press}))
    assert (row["to_z1"], row["to_x1"], row["press"]) == (0.2, -0.1, 0.1)
    assert row["cauchy_stress_z"] * row["volume"] / 1.2 == pytest.approx(
        row["support_force_z0"], rel=1e-3
    )


def test_a_traction_keeps_direction_and_force(block: Path) -> None:
    """Along the normal it pulls as a dead force; aside the support bears traction times area, however it turns."""
    load = {"kind": "traction", "face": "z1", "ramp": RAMP}
    pulled = scene(block, {}, loads={"pull": load | {"value": 3.0, "direction": [0, 0, 2.0]}})
    cube = Scene(
        geometry={"shape": "cube", "side": 1.0}, cells={"initial": "isotropic"},
        loads={"force": {"value": 3.0, "ramp": RAMP}}, time={"end": 6.0},
        remodeling={"law": "tensor", "coupling": "staggered"},
    )  # fmt: skip
    for row, other in zip(rows_of(pulled), rows_of(cube), strict=True):
        assert row["pull"] == other["force"]
        assert row["support_force_z0"] == pytest.approx(other["force"], rel=1e-6)
        assert row["volume"] == pytest.approx(other["min_jacobian"], rel=1e-4)
    held = {"z0": {"kind": "held"}, "x0": {"kind": "free"}, "y0": {"kind": "free"}}
    for direction, force in (([3.0, 0, 4.0], 0.8), ([1.0, 0, 0], 0.0)):
        loads = {"push": load | {"value": 2.0, "direction": direction}}
        row = last_row(scene(block, {}, loads=loads, supports=held))
        assert row["support_force_z0"] == pytest.approx(2.0 * force, abs=1e-6)


def test_a_run_goes_on(block: Path, tmp_path: Path) -> None:
    goes_on(scene(block, {"z1": 0.2}, time={"end": 3.0}), tmp_path, 2.0, 3.0)


def test_the_gel_between_posts(tmp_path: Path) -> None:
    """Both posts bear the same; collagen turns along the line between them; nobody speaks of a wall."""
    path = tmp_path / "gel.msh"
    runpy.run_path(str(GEL / "mesh.py"))["main"](path)
    (tmp_path / "scene.toml").write_text((GEL / "scene.toml").read_text())
    asked = read_scene(tmp_path / "scene.toml", ["time.end=8"])
    folder = run(asked, tmp_path / "run", SELF)
    history = Recording(folder).history
    left, right = (history[f"support_force_{side}_post"] for side in ("left", "right"))
    np.testing.assert_allclose(left[1:], right[1:], rtol=1e-8)
    assert (np.diff(left) > 0).all() and (np.diff(history["fibre_angle"]) < 0).all()
    assert not {name for name in history if "inner" in name or "lumen" in name or "outer" in name}
    page = write_report(folder).read_text()
    shown = re.sub(r"(?s)<script.*?</script>|<style.*?</style>|<details.*?</details>", "", page)
    assert "angle" in shown and not re.search(r"\b(wall|lumen|around)\b", shown, re.IGNORECASE)
    said = (folder / "run.log").read_text()
    assert not re.search(r"\b(wall|lumen|inlet)\b", said), said


@pytest.mark.parametrize(("body", "tables", "words"), rows(__file__, "bad_solids.txt"))
def test_what_is_refused(body: str, tables: str, words: str, block: Path, tmp_path: Path) -> None:
    file = block if body == "block" else write_tube(tmp_path / "tube.msh")
    with pytest.raises(SceneError, match=f"^{words}.*$"):
        last_row(scene(file, {}, **values(tables)))
