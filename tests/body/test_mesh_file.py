"""Mesh files that are none, damaged, hostile, or of another body: one line each, before any solve."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest

from remodel_fenicsx import SceneError
from remodel_fenicsx.body.gmsh_model import gmsh_model
from remodel_fenicsx.body.mesh_file import read_mesh
from remodel_fenicsx.scene import read_scene, scene_from_dict
from tests.mesh_files import TUBE, changed, write_tube
from tests.tables import rows, unescaped, values

SCENE = '[geometry]\nshape = "mesh"\nfile = "{}"\n[time]\nend = 1.0\nstep = 1.0\n'


def refusal(file: Path, **geometry: Any) -> str:
    """What is said of a file."""
    values = {
        "geometry": {"shape": "mesh", "file": str(file), **geometry},
        "time": {"end": 1.0, "step": 1.0},
    }
    with pytest.raises(SceneError) as error:
        scene_from_dict(values).geometry.checked()
    return str(error.value)


@pytest.mark.parametrize(("damage", "old", "new", "words"), rows(__file__, "damaged_meshes.txt"))
def test_a_damaged_file_is_refused(
    tmp_path: Path, damage: str, old: str, new: str, words: str
) -> None:
    said = refusal(changed(tmp_path / "bad.msh", (unescaped(old), unescaped(new))))
    assert re.search(words, said) and "\n" not in said, said


def test_two_bodies_are_refused() -> None:
    faces = dict(zip(("inner", "outer", "inlet", "outlet"), range(1, 5), strict=True))
    said = refusal(TUBE.with_name("two_bodies.msh"), faces=faces)
    assert "2 bodies without common nodes; must be one" in said


@pytest.mark.parametrize("version", [2.2, 4.1])
def test_a_file_that_is_cut_off_anywhere_is_refused(version: float, tmp_path: Path) -> None:
    data = write_tube(tmp_path / "good.msh", version=version).read_bytes()
    bad = tmp_path / "bad.msh"
    for share in (0.0, 0.001, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99):
        bad.write_bytes(data[: int(share * len(data))])
        assert re.search(r"is not a Gmsh mesh|truncated|one section", refusal(bad))


@pytest.mark.parametrize("more", ["1 2 x", "1 2 3"])
@pytest.mark.parametrize("section", ["Nodes", "Elements", "Entities"])
def test_more_lines_than_announced_in_format_4_are_refused(
    tmp_path: Path, section: str, more: str
) -> None:
    source = write_tube(tmp_path / "tube.msh")
    end = (f"$End{section}", f"{more}\n$End{section}")
    said = refusal(changed(tmp_path / "bad.msh", end, source=source))
    assert f"has other {section.lower()} than ${section} announces" in said


def test_parts_without_a_group_are_read_too(tmp_path: Path) -> None:
    """As `Mesh.SaveAll` of Gmsh writes them: lines and points here."""
    file = write_tube(tmp_path / "tube.msh", every=True)
    one, other = read_mesh(write_tube(tmp_path / "named.msh")), read_mesh(file)
    np.testing.assert_array_equal(one.points[one.cells], other.points[other.cells])
    np.testing.assert_array_equal(one.facet_groups, other.facet_groups[other.facet_groups > 0])


def test_no_script_runs_under_the_name_of_a_mesh(tmp_path: Path) -> None:
    mark, file = tmp_path / "mark", tmp_path / "vessel.msh"
    for before in ("", "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n"):
        file.write_text(f'{before}SystemCall "touch {mark}";\n')
        assert re.search("not a Gmsh mesh|outside of its sections", refusal(file))
        assert not mark.exists()


@pytest.mark.parametrize(("geometry", "words"), rows(__file__, "bad_faces.txt"))
def test_faces_that_the_file_has_not(geometry: str, words: str) -> None:
    assert words in refusal(TUBE, **values(geometry))


@pytest.mark.parametrize(
    "file", ["lumen.stl", "vessel.inp", "vessel.pvtu", "vessel.msh.gz", "vessel", "", "a/b.txt"]
)
@pytest.mark.parametrize("known", [{}, {"element": "hexahedron", "degree": 1}])
def test_another_ending_is_refused_by_key_and_value(
    tmp_path: Path, file: str, known: dict[str, Any]
) -> None:
    """As the scene has it, whether or not element and degree have to be read from the file."""
    (tmp_path / "scene.toml").write_text(SCENE.format(file))
    settings = [f"mesh.{key}={value}" for key, value in known.items()]
    with pytest.raises(SceneError) as error:
        read_scene(tmp_path / "scene.toml", settings)
    assert str(error.value).startswith(
        f"geometry.file = {file!r}: must be the path of a mesh (.msh, "
    )


def test_a_body_of_another_unit_is_refused(tmp_path: Path) -> None:
    large = write_tube(tmp_path / "large.msh", turn=1e3 * np.eye(3))
    said = refusal(large, file_unit="m", length_unit="um")
    assert (
        "the body is 4e+09 long in the scene's unit; must be 1e-06 to 1e+06 (geometry.file_unit"
        in said
    )


def test_an_open_boundary_is_allowed_when_asked(tmp_path: Path) -> None:
    bad = changed(tmp_path / "open.msh", ("\n23 3 2 3 61 2 55 53 3\n", "\n23 15 2 3 61 2\n"))
    values = {
        "geometry": {"shape": "mesh", "file": str(bad), "open_boundary": True},
        "time": {"end": 1.0, "step": 1.0},
    }
    assert scene_from_dict(values).geometry.checked()


def test_a_wall_of_one_element_is_warned_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    thin = write_tube(tmp_path / "thin.msh", counts=(8, 1, 2))
    values = {"geometry": {"shape": "mesh", "file": str(thin)}, "time": {"end": 1.0, "step": 1.0}}
    scene_from_dict(values).geometry.checked()
    assert any("one element thick" in line for line in caplog.messages)


def test_a_partitioned_mesh_is_the_whole_one(tmp_path: Path) -> None:
    """With and without elements of neighbours, in both formats, and with parameters of its nodes."""
    whole, files = read_mesh(write_tube(tmp_path / "tube.msh")), {}
    with gmsh_model("parts") as gmsh:
        gmsh.merge(str(tmp_path / "tube.msh"))
        for name, version, ghosts in (("parts", 4.1, 0), ("ghosts", 4.1, 1), ("old", 2.2, 0)):
            gmsh.option.setNumber("Mesh.PartitionCreateGhostCells", ghosts)
            gmsh.option.setNumber("Mesh.MshFileVersion", version)
            gmsh.model.mesh.partition(3)
            files[name] = tmp_path / f"{name}.msh"
            gmsh.write(str(files[name]))
            gmsh.model.mesh.unpartition()
        gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
        gmsh.option.setNumber("Mesh.SaveParametric", 1)
        files["parametric"] = tmp_path / "parametric.msh"
        gmsh.write(str(files["parametric"]))
    for file in files.values():
        found = read_mesh(file)
        assert (
            found.names == whole.names
            and (np.sort(found.cell_groups) == np.sort(whole.cell_groups)).all()
        )
        for number in whole.names[2].values():
            assert (found.facet_groups == number).sum() == (whole.facet_groups == number).sum()


@pytest.mark.parametrize("version", [2.2, 4.1])
def test_elements_are_in_the_order_of_the_file(version: float, tmp_path: Path) -> None:
    """Checkpoints have values by element: a run goes on with the same ones, whatever their groups and numbers."""
    file = write_tube(tmp_path / "tube.msh", "tetrahedron", version=version)
    if version == 2.2:
        lines = file.read_text().splitlines()
        solid = [number for number, line in enumerate(lines) if re.match(r"\d+ 4 2 5 ", line)]
        for place, number in enumerate(
            solid[::-1]
        ):  # other numbers, and every other element in a group of its own
            _, *words = lines[number].split()
            lines[number] = " ".join([str(10**6 + place), *words[:2], "56"[place % 2], *words[3:]])
        file.write_text("\n".join(lines) + "\n")
    mesh, found = meshio.read(file), read_mesh(file)
    np.testing.assert_array_equal(
        mesh.points[mesh.get_cells_type("tetra")], found.points[found.cells]
    )
    np.testing.assert_array_equal(mesh.get_cell_data("gmsh:physical", "tetra"), found.cell_groups)
