"""Own bodies from files of other programs: the same mesh as Gmsh's own file, and what is refused."""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest

from remodel_fenicsx import SceneError
from remodel_fenicsx.body import mesh_file
from remodel_fenicsx.body.mesh_faces import rims
from remodel_fenicsx.body.mesh_faces import boundary_of, jacobian_determinants
from remodel_fenicsx.body.mesh_file import read_mesh
from remodel_fenicsx.errors import UnreadableFile
from remodel_fenicsx.body.mesh_body import refined
from remodel_fenicsx.scene import scene_from_dict
from tests.body.test_lumen import tube
from tests.mesh_files import write_tube
from tests.runs import last_row
from tests.values import ramped

LOADS = ramped(2, pressure=2.0)


def converted(source: Path, ending: str, **arrays: Any) -> Path:
    """By meshio, as a user would."""
    mesh = meshio.read(source)
    mesh.cell_sets = {}
    mesh.cell_data |= arrays
    target = source.with_suffix(ending)
    more = {"data_format": "XML"} if ending == ".xdmf" else {}
    meshio.write(target, mesh, **more)
    return target


def numbers_of(source: Path) -> dict[str, int]:
    return {
        name: int(number)
        for name, (number, dimension) in meshio.read(source).field_data.items()
        if dimension == 2
    }


def sorted_rows(table: Any) -> Any:
    return table[np.lexsort(table.T)]


@pytest.mark.parametrize(("ending", "element", "degree"), [
    (".vtu", "hexahedron", 1), (".vtu", "tetrahedron", 2), (".vtu", "hexahedron", 2),
    (".vtk", "tetrahedron", 1), (".xdmf", "hexahedron", 1), (".xdmf", "tetrahedron", 1),
])  # fmt: skip
def test_the_mesh_is_that_of_gmsh(tmp_path: Path, ending: str, element: str, degree: int) -> None:
    """The same elements, nodes in the same order, the same facets under the same numbers."""
    source = write_tube(tmp_path / "tube.msh", element, degree)
    one, other = read_mesh(source), read_mesh(converted(source, ending))
    assert (other.kind, other.degree) == (element, degree)
    places = [
        sorted_rows(file.points[file.cells].reshape(len(file.cells), -1)) for file in (one, other)
    ]
    assert np.abs(places[0] - places[1]).max() < 1e-12
    assert jacobian_determinants(other).min() > 0 or jacobian_determinants(other).max() < 0
    for number in mesh_file.unique_in_order(one.facet_groups):
        sides = [
            file.points[file.facets[file.facet_groups == number]].mean(axis=1)
            for file in (one, other)
        ]
        assert np.abs(sorted_rows(sides[0].round(9)) - sorted_rows(sides[1].round(9))).max() < 1e-8


PACKED = [
    ("vtu", mode, packer)
    for mode in ("Ascii", "Binary", "Appended", "raw")
    for packer in ("None", "LZ4", "LZMA")
]


@pytest.mark.parametrize(
    ("ending", "mode", "packer"), [*PACKED, ("vtk", "Ascii", ""), ("vtk", "Binary", "")]
)
def test_what_vtk_writes_is_read(tmp_path: Path, ending: str, mode: str, packer: str) -> None:
    """In each of the ways in which its writers, and so ParaView and PyVista, pack numbers."""
    io = pytest.importorskip("vtkmodules.vtkIOXML" if ending == "vtu" else "vtkmodules.vtkIOLegacy")
    source = converted(write_tube(tmp_path / "tube.msh", "tetrahedron", 2), ".vtu")
    reader = pytest.importorskip("vtkmodules.vtkIOXML").vtkXMLUnstructuredGridReader()
    reader.SetFileName(str(source))
    reader.Update()
    writer = getattr(
        io, "vtkXMLUnstructuredGridWriter" if ending == "vtu" else "vtkUnstructuredGridWriter"
    )()
    writer.SetInputData(reader.GetOutput())
    writer.SetFileName(str(tmp_path / f"packed.{ending}"))
    if ending == "vtu":
        getattr(writer, f"SetDataModeTo{mode.replace('raw', 'Appended')}")()
        getattr(writer, f"SetCompressorTypeTo{packer}")()
        writer.SetEncodeAppendedData(mode != "raw")
    else:
        getattr(writer, f"SetFileTypeTo{mode.replace('Ascii', 'ASCII')}")()
    assert writer.Write() == 1
    one, other = read_mesh(source), read_mesh(tmp_path / f"packed.{ending}")
    tolerance = 1e-12 if ending == "vtu" and mode != "Ascii" else 1e-5
    np.testing.assert_allclose(one.points[one.cells], other.points[other.cells], atol=tolerance)
    np.testing.assert_array_equal(one.facet_groups, other.facet_groups)


def test_wedges_are_split_into_tetrahedra_that_fit_each_other(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A wall of prisms, as boundary layers are; its volume, and no facet but those of its faces."""
    points, triangles = tube()
    size, levels = len(points), [1.0, 1.2, 1.5]
    rng = np.random.default_rng(1)
    order = rng.permutation(3 * size)  # any corner may be the smallest
    whole = np.empty((3 * size, 3))
    whole[order] = np.concatenate([points * [level, level, 1.0] for level in levels])
    wedges = np.concatenate(
        [np.hstack([triangles + k * size, triangles + (k + 1) * size]) for k in range(2)]
    )
    quads = [
        np.concatenate(
            [np.hstack([rim + k * size, rim[:, ::-1] + (k + 1) * size]) for k in range(2)]
        )
        for rim in rims(triangles)
    ]
    cells = [("wedge", wedges), ("triangle", triangles), ("triangle", triangles + 2 * size)]
    cells += [("quad", quad) for quad in quads]
    tags = [np.full(len(rows), number) for number, (_, rows) in enumerate(cells)]
    mesh = meshio.Mesh(
        whole, [(kind, order[rows]) for kind, rows in cells], cell_data={"medit:ref": tags}
    )
    mesh.write(tmp_path / "wall.vtu")
    faces = {"inner": 1, "outer": 2, "inlet": 3, "outlet": 4}
    caplog.set_level("INFO")
    file, boundary, _ = scene_of(tmp_path / "wall.vtu", faces=faces).geometry.checked()
    assert (
        file.kind == "tetrahedron"
        and len(file.cells) == 3 * len(wedges)
        and "each wedge is split" in caplog.text
    )
    sides = file.points[file.cells[:, 1:]] - file.points[file.cells[:, :1]]
    volumes = np.linalg.det(sides) / 6
    assert volumes.min() > 0 and volumes.sum() == pytest.approx(
        np.pi * (1.5**2 - 1.0) * 4.0, rel=0.01
    )


def scene_of(file: Path, **geometry: Any) -> Any:
    return scene_from_dict({
        "geometry": {"shape": "mesh", "file": str(file)} | geometry, "cells": {"initial": "isotropic"},
        "loads": LOADS, "remodeling": {"law": "none"}, "time": {"end": 2.0, "step": 1.0},
        "solver": {"method": "direct"},
    })  # fmt: skip


@pytest.mark.parametrize("sign", [1, -1])  # SALOME counts families of elements below zero
def test_a_med_file_is_converted_as_the_docs_say(tmp_path: Path, sign: int) -> None:
    page = (Path(__file__).parents[2] / "docs" / "my_own_vessel.md").read_text(encoding="utf-8")
    command = re.search(r"^\./with-fenicsx (.*meshio.*)$", page, flags=re.MULTILINE)
    source = write_tube(tmp_path / "tube.msh")
    mesh, kinds = meshio.read(source), ("quad", "hexahedron")
    tags = [sign * mesh.get_cell_data("gmsh:physical", kind).astype(np.int64) for kind in kinds]
    cells = [(kind, mesh.get_cells_type(kind)) for kind in kinds]
    meshio.Mesh(mesh.points, cells, cell_data={"cell_tags": tags}).write(tmp_path / "a.med")
    assert command is not None
    subprocess.run(shlex.split(command[1]), cwd=tmp_path, check=True)
    faces = {name: sign * number for name, number in numbers_of(source).items()}
    _, boundary, _ = scene_of(tmp_path / "b.vtu", faces=faces, tags="cell_tags").geometry.checked()
    assert boundary.area("inner") == pytest.approx(
        scene_of(source).geometry.checked()[1].area("inner")
    )


def test_what_is_wrong_is_said_in_one_line(tmp_path: Path) -> None:
    source = write_tube(tmp_path / "tube.msh")
    file, names = converted(source, ".vtu"), numbers_of(source)
    with pytest.raises(
        SceneError, match=r"geometry.faces.inner = 'inner': the file has no such face; it has \d"
    ):
        scene_of(file).geometry.checked()
    with pytest.raises(
        SceneError, match="geometry.regions.media = 99: the file has no such volume; it has"
    ):
        scene_of(file, faces=names, regions={"media": 99}).geometry.checked()
    with pytest.raises(SceneError, match="has no array 'parts' with the numbers of faces"):
        scene_of(file, faces=names, tags="parts")
    with pytest.raises(UnreadableFile, match="no such file"):
        read_mesh(tmp_path / "other.vtu")
    half = tmp_path / "half.vtu"
    half.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(
        UnreadableFile, match="cannot be read: .*; save it as VTU with data mode ASCII"
    ):
        read_mesh(half)


@pytest.mark.parametrize(
    ("cells", "tags", "words"),
    [
        ([("pyramid", [[0, 1, 2, 3, 4]])], [[1]], "elements of type 'pyramid'"),
        ([("hexahedron", [range(8)])], [[0.5]], "an integer for each element"),
        ([("hexahedron", [range(8)])], [[np.nan]], "an integer for each element"),
        ([("quad", [range(4)])], [[1]], "no elements of a volume"),
    ],
)
def test_other_meshes_are_refused(tmp_path: Path, cells: Any, tags: Any, words: str) -> None:
    places = np.array(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1.0]]
    )
    arrays = {"medit:ref": [np.array(values) for values in tags]}
    mesh = meshio.Mesh(
        places,
        [(kind, np.array([list(row) for row in rows])) for kind, rows in cells],
        cell_data=arrays,
    )
    mesh.write(tmp_path / "one.vtu")
    with pytest.raises(UnreadableFile, match=words):
        read_mesh(tmp_path / "one.vtu")


# ---------------------------------------------------------------- smaller elements


@pytest.mark.parametrize("element", ["hexahedron", "tetrahedron"])
@pytest.mark.parametrize(("refinement", "degree"), [(2, 1), (1, 2), (2, 2), (4, 1)])
def test_refined_it_is_the_same_body(
    tmp_path: Path, element: str, refinement: int, degree: int
) -> None:
    """As many elements as halves make; volume and faces as before."""
    source = read_mesh(write_tube(tmp_path / "tube.msh", element))
    found = refined(source, refinement, degree)
    assert (found.kind, found.degree, len(found.cells)) == (
        element,
        degree,
        len(source.cells) * refinement**3,
    )
    assert found.sha256 == source.sha256 and found.names == source.names
    groups = {name: (number,) for name, number in source.names[2].items()}
    one, other = boundary_of(source, groups, False), boundary_of(found, groups, False)
    assert other.volume == pytest.approx(one.volume, rel=1e-12)
    for name in groups:
        assert other.area(name) == pytest.approx(one.area(name), rel=1e-12)
        assert len(other.faces) == len(one.faces)
    assert mesh_file.unique_in_order(found.cell_groups) == mesh_file.unique_in_order(
        source.cell_groups
    )


def test_a_refined_run_is_nearer_to_a_finer_file(tmp_path: Path) -> None:
    """Through the scene; what is no power of 2, or of degree 2 already, is refused by name."""
    source = write_tube(tmp_path / "tube.msh", counts=(8, 1, 2))
    rows = [
        last_row(scene_of(source).with_values(changes | {"time.end": 1.0}))
        for changes in ({}, {"mesh.refinement": 2}, {"mesh.refinement": 2, "mesh.degree": 2})
    ]
    volumes = [row["lumen_volume"] for row in rows]
    assert abs(volumes[1] - volumes[2]) < 0.6 * abs(volumes[0] - volumes[2])
    with pytest.raises(SceneError, match="mesh.refinement = 3: must be a power of 2"):
        scene_of(source).with_values({"mesh.refinement": 3})
    curved = write_tube(tmp_path / "curved.msh", degree=2)
    with pytest.raises(
        SceneError,
        match="mesh.refinement = 2, mesh.degree = 2: curved.msh has elements of degree 2",
    ):
        last_row(scene_of(curved).with_values({"mesh.refinement": 2}))
