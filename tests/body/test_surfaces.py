"""A volume and its faces in files of their own, as SimVascular writes them."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
import pyvista

from remodel_fenicsx import Recording, Scene, SceneError, read_scene, run
from remodel_fenicsx.body.mesh_file import read_mesh
from remodel_fenicsx.running import resume
from tests.mesh_files import write_tube
from tests.runs import SELF, last_row
from tests.values import assert_close, ramped

FACES = {"inner": "lumen", "outer": "wall_outer", "inlet": "cap_in", "outlet": "cap_out"}


def write_all(folder: Path, element: str = "tetrahedron", degree: int = 1) -> dict[str, Path]:
    """volume.vtu without a number of any face, and a .vtp of each face with numbers of all nodes; by names."""
    mesh = read_mesh(write_tube(folder / "tube.msh", element, degree))
    kind = {("tetrahedron", 1): "tetra", ("tetrahedron", 2): "tetra10"}.get(
        (element, degree), "hexahedron"
    )
    arrays = {"ModelRegionID": [np.ones(len(mesh.cells), dtype=np.int32)]}
    cells = meshio.read(folder / "tube.msh").get_cells_type(kind)
    points = meshio.read(folder / "tube.msh").points
    meshio.write(folder / "volume.vtu", meshio.Mesh(points, [(kind, cells)], cell_data=arrays))
    found = {"volume": folder / "volume.vtu", "msh": folder / "tube.msh"}
    for face, name in FACES.items():
        rows = mesh.facets[mesh.facet_groups == mesh.names[2][face]]
        used, corners = np.unique(rows, return_inverse=True)
        polygons = np.insert(corners.reshape(rows.shape), 0, rows.shape[1], axis=1)
        surface = pyvista.PolyData(mesh.points[used].astype(np.float32), polygons.ravel())
        surface.point_data["GlobalNodeID"] = used + 1
        surface.save(folder / f"{name}.vtp")
        found[face] = folder / f"{name}.vtp"
    return found


def scene(geometry: dict[str, Any], **tables: Any) -> Scene:
    values: dict[str, Any] = {
        "geometry": {"shape": "mesh", **geometry}, "cells": {"initial": "isotropic"},
        "loads": ramped(2, pressure=0.5, elongation=0.05), "time": {"end": 3.0}, "output": {"report": False},
        "solver": {"method": "direct"},
    }  # fmt: skip
    return Scene(**values | tables)


def in_faces(files: dict[str, Path]) -> dict[str, Any]:
    """A table of faces with a file each."""
    return {
        "file": str(files["volume"]),
        "faces": {face: {"file": str(files[face])} for face in FACES},
    }


@pytest.mark.parametrize("degree", [1, 2])
def test_it_is_the_body_of_one_file(degree: int, tmp_path: Path) -> None:
    """Surfaces after the volume in a list, with names of faces, or in the faces themselves."""
    files = write_all(tmp_path, degree=degree)
    listed = {"file": [str(files[name]) for name in ("volume", *FACES)], "faces": FACES}
    found = [scene(one) for one in ({"file": str(files["msh"])}, listed, in_faces(files))]
    assert found[1] == found[2] and found[1].mesh.degree == degree
    for one in found[1:]:
        (file, boundary, regions), (of_one, as_one, _) = (
            some.geometry.checked() for some in (one, found[0])
        )
        assert regions == {"body": 0} and len(file.cells) == len(of_one.cells)
        for face in FACES:
            assert boundary.area(face) == pytest.approx(as_one.area(face), rel=1e-12)
    if degree == 1:
        names = ("lumen_volume", "fibre_angle_inner", "stored_energy")
        assert_close(last_row(found[2]), last_row(found[0]), names, 1e-9)


def test_a_scene_beside_them_is_run_with_copies_and_goes_on(tmp_path: Path) -> None:
    """Paths are relative to the scene; the folder holds all files, and one that has changed is refused."""
    write_all(tmp_path)
    (tmp_path / "scene.toml").write_text(
        'geometry.shape = "mesh"\ngeometry.file = ["volume.vtu", "cap_in.vtp", "cap_out.vtp"]\n[geometry.faces]\n'
        'inner = { file = "lumen.vtp" }\nouter = { file = "wall_outer.vtp" }\ninlet = "cap_in"\noutlet = "cap_out"\n'
        '[cells]\ninitial = "isotropic"\n[time]\nend = 2.0\n[loads]\n'
        "pressure = { value = 0.5, ramp = [[0, 0], [2, 1]] }\nelongation = { value = 0.05, ramp = [[0, 0], [2, 1]] }\n"
    )
    folder = run(read_scene(tmp_path / "scene.toml"), tmp_path / "run", SELF)
    assert {"volume.vtu", *(f"{name}.vtp" for name in FACES.values())} <= {
        path.name for path in folder.iterdir()
    }
    assert read_scene(folder / "scene.toml").geometry.file[0].endswith("run/volume.vtu")
    assert len(Recording(resume(folder, ["time.end=3"], SELF)).history["time"]) == 4
    (folder / "lumen.vtp").write_bytes((folder / "wall_outer.vtp").read_bytes())
    with pytest.raises(
        SceneError, match="geometry.file = 'volume.vtu': has changed: its SHA-256 was"
    ):
        resume(folder, ["time.end=4"], SELF)


def test_numbers_of_regions_are_read_beside_them(tmp_path: Path) -> None:
    geometry = in_faces(write_all(tmp_path)) | {"tags": "ModelRegionID", "regions": {"wall": 1}}
    assert scene(geometry, regions={"wall": {"remodeling": {"kappa": 0.1}}}).geometry.checked()[
        2
    ] == {"wall": 1}


def shifted(files: dict[str, Path]) -> None:
    surface = pyvista.read(files["inner"])
    surface.points[3] += 0.05
    surface.save(files["inner"])


def in_metres(files: dict[str, Path]) -> None:
    surface = pyvista.read(files["inner"])
    surface.points /= 1000
    surface.save(files["inner"])


def inside(files: dict[str, Path]) -> None:
    mesh = meshio.read(files["volume"])
    rows = mesh.cells[0].data[:, [0, 1, 2]]  # also those between two elements
    pyvista.PolyData(mesh.points, np.insert(rows, 0, 3, axis=1).ravel()).save(files["inner"])


@pytest.mark.parametrize(("change", "line"), [
    (shifted, "lumen.vtp: [0-9]+ triangle corners are no nodes, the first at .* node. The surface must belong"),
    (in_metres, "lumen.vtp: [0-9]+ triangle corners are no nodes, the first at .* from the nearest node. The"),
    (lambda files: files["inner"].write_bytes(b"<VTKFile>"), "lumen.vtp: cannot be read: "),
    (lambda files: files["inner"].write_bytes(files["inner"].read_bytes()[:900]), "lumen.vtp: "),
    (lambda files: files["inner"].unlink(), "no such file: .*lumen.vtp"),
    (lambda files: [files["inner"].unlink(), files["inner"].mkdir()], "is a folder; a mesh is a file"),
])  # fmt: skip
def test_a_surface_of_another_body_is_refused(
    change: Callable[[Any], Any], line: str, tmp_path: Path
) -> None:
    files = write_all(tmp_path)
    change(files)
    with pytest.raises(SceneError) as refused:
        scene(in_faces(files))
    assert re.match(f"geometry.file = 'volume.vtu': {line}", str(refused.value)), refused.value
    assert "\n" not in str(refused.value)


def test_triangles_inside_of_the_body_are_no_face(tmp_path: Path) -> None:
    files = write_all(tmp_path)
    inside(files)
    with pytest.raises(
        SceneError, match="geometry.faces.inner = 'lumen': has facets inside the body, the first at"
    ):
        scene(in_faces(files)).geometry.checked()


def test_what_is_no_list_of_a_mesh_and_surfaces_is_refused(tmp_path: Path) -> None:
    files = {name: str(path) for name, path in write_all(tmp_path).items()}
    twice = tmp_path / "other" / "lumen.vtp"
    twice.parent.mkdir()
    twice.write_bytes(Path(files["inner"]).read_bytes())
    for geometry, line in (
        (
            {"file": [files["inner"], files["volume"]]},
            "geometry.file = .*: must be the path of a mesh",
        ),
        ({"file": []}, "geometry.file = \\[\\]: must be the path of a mesh"),
        (
            {"file": [files["volume"], files["msh"]]},
            "geometry.file = .*or a list of it and paths of its su",
        ),
        (
            {"file": [files["volume"], files["inner"], str(twice)]},
            "geometry.file = .*: .*lumen.vtp: face .lumen. already exists",
        ),
        (
            {"file": files["msh"], "faces": {"inner": {"file": "lumen.txt"}}},
            "geometry.f.*name or a number in the fi",
        ),
        (
            {"file": files["volume"]},
            "geometry.file = 'volume.vtu': has no array 'gmsh:physical' or",
        ),
    ):
        with pytest.raises(SceneError, match=f"^{line}"):
            scene(geometry).geometry.checked()
    hexahedra = write_all(tmp_path, "hexahedron")
    with pytest.raises(
        SceneError, match="lumen.vtp: a surface of triangles needs a mesh of tetrahedra"
    ):
        scene(in_faces(hexahedra))
