"""Mesh files that are none, damaged, hostile, or of another body: one line each, before any solve."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from remodel_fenicsx import SceneError
from remodel_fenicsx.body.gmsh_model import gmsh_model
from remodel_fenicsx.scene import read_scene, scene_from_dict
from tests.mesh_files import edited, write_tube

Edit = Callable[[list[str]], list[str]]
SCENE = '[geometry]\nshape = "mesh"\nfile = "{}"\n[time]\nend = 1.0\nstep = 1.0\n'


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """48 hexahedra in format 2.2, a line for each."""
    return write_tube(tmp_path_factory.mktemp("mesh") / "good.msh", version=2.2)


@pytest.fixture(scope="module")
def good41(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same in 4.1."""
    return write_tube(tmp_path_factory.mktemp("mesh") / "good.msh")


def refusal(file: Path, **geometry: Any) -> str:
    """What is said of a file."""
    values = {"geometry": {"shape": "mesh", "file": str(file), **geometry}, "time": {"end": 1.0, "step": 1.0}}
    with pytest.raises(SceneError) as error:
        scene_from_dict(values).geometry.checked()
    return str(error.value)


def of_type(lines: list[str], kind: int) -> list[int]:
    """Rows of the elements of one type of Gmsh's."""
    return [row for row, line in enumerate(lines) if row and int(line.split()[1]) == kind]


def replaced(line: str, column: int, word: str) -> str:
    words = line.split()
    words[column] = word
    return " ".join(words)


def in_rows(choose: Callable[[list[str]], int], change: Callable[[str], str]) -> Edit:
    def edit(lines: list[str]) -> list[str]:
        row = choose(lines)
        return [*lines[:row], change(lines[row]), *lines[row + 1 :]]

    return edit


def first(kind: int) -> Callable[[list[str]], int]:
    return lambda lines: of_type(lines, kind)[0]


def swap_corners(line: str) -> str:
    words = line.split()
    words[-1], words[-2] = words[-2], words[-1]
    return " ".join(words)


def without_one(lines: list[str]) -> list[str]:
    """One facet of the inner face less: a hole."""
    row = next(row for row in of_type(lines, 3) if lines[row].split()[3] == "3")
    return [str(int(lines[0]) - 1), *lines[1:row], *lines[row + 1 :]]


def also_outer(lines: list[str]) -> list[str]:
    """One facet of the inner face in the outer one too."""
    row = next(row for row in of_type(lines, 3) if lines[row].split()[3] == "3")
    return [str(int(lines[0]) + 1), *lines[1:], replaced(lines[row], 3, "4")]


def inside(lines: list[str]) -> list[str]:
    """A facet between two elements in the inner face: one that two hexahedra have."""
    hexahedra = [lines[row].split()[-8:] for row in of_type(lines, 5)]
    for number, one in enumerate(hexahedra):
        for side in ((0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)):
            corners = {one[k] for k in side}
            if any(corners <= set(other) for k, other in enumerate(hexahedra) if k != number):
                facet = f"9999 3 2 3 1 {' '.join(one[k] for k in side)}"
                return [str(int(lines[0]) + 1), *lines[1:], facet]
    raise AssertionError


def apart(lines: list[str]) -> list[str]:
    """Two bodies: of the three layers along, the middle one is left out."""
    nodes = [line.split() for line in NODES]
    middle = {words[0] for words in nodes[1:] if 0.5 < float(words[3]) < 1.5}
    lid = {words[0] for words in nodes[1:] if 1.5 < float(words[3]) < 2.5}
    kept = [
        line for row, line in enumerate(lines)
        if row and not (set(line.split()[5:]) & middle and set(line.split()[5:]) & lid)
    ]  # fmt: skip
    return [str(len(kept)), *kept]


def mixed(lines: list[str]) -> list[str]:
    """A tetrahedron among hexahedra."""
    words = lines[of_type(lines, 5)[0]].split()
    return [str(int(lines[0]) + 1), *lines[1:], " ".join(["9999", "4", *words[2:9]])]


def more(lines: list[str]) -> list[str]:
    return [str(10**15), *lines[1:]]


NODES: list[str] = []


def in_first_node(column: int, word: str) -> Edit:
    return in_rows(lambda lines: 1, lambda line: replaced(line, column, word))


def in_first_hexahedron(column: int, word: str) -> Edit:
    return in_rows(first(5), lambda line: replaced(line, column, word))


@pytest.mark.parametrize(
    ("section", "edit", "words"),
    [
        ("Nodes", in_first_node(2, "nan"), r"node 1 is at .*nan.*: its place must be finite"),
        ("Nodes", in_first_node(2, "one"), r"line \d+: '1 .*' where number and place of a node should be"),
        ("Nodes", more, r"line \d+: 1000000000000000 of nodes, but \$Nodes has 96 more lines"),
        ("Nodes", lambda lines: lines[:-1], r"line \d+: 96 of nodes, but \$Nodes has 95 more lines"),
        ("Nodes", lambda lines: [*lines, "SystemCall"], r"line \d+: more lines in \$Nodes than it announces"),
        ("Elements", more, r"line \d+: 1000000000000000 of elements, but \$Elements has"),
        ("Elements", in_first_hexahedron(-1, "777"), r"line \d+: element \d+ has the node 777, which is not in \$No"),
        ("Elements", in_first_hexahedron(1, "6"), r"line \d+: elements of Gmsh's type 6; allowed are tetrahedra"),
        ("Elements", in_rows(first(5), swap_corners), r"element \d+ at \(.*\) is twisted or flat.* \(1 such element\)"),
        ("Elements", mixed, r"elements of several types: tetrahedron of degree 1 and hexahedron of degree 1"),
        ("Elements", without_one, r"1 of 80 facets of the boundary are in no face .* at \(.*open_boundary = true"),
        ("Elements", also_outer, r"geometry.faces.outer = 'outer': shares facets with the face 'inner', the first at"),
        ("Elements", inside, r"geometry.faces.inner = 'inner': has facets inside the body, the first at"),
        ("Elements", lambda lines: lines[:-5], r"line \d+: \d+ of elements, but \$Elements has \d+ more lines"),
        ("Elements", apart, r"2 bodies that have no node in common; allowed is one"),
    ],
)
def test_a_damaged_file_is_refused(good: Path, tmp_path: Path, section: str, edit: Edit, words: str) -> None:
    lines = good.read_text().splitlines()
    NODES[:] = lines[lines.index("$Nodes") + 1 : lines.index("$EndNodes")]
    said = refusal(edited(good, tmp_path / "bad.msh", section, edit))
    assert re.search(words, said), said
    assert "\n" not in said


@pytest.mark.parametrize("format_of", ["good", "good41"])
def test_a_file_that_is_cut_off_anywhere_is_refused(format_of: str, tmp_path: Path, request: Any) -> None:
    data = request.getfixturevalue(format_of).read_bytes()
    bad = tmp_path / "bad.msh"
    for share in (0.0, 0.001, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99):
        bad.write_bytes(data[: int(share * len(data))])
        said = refusal(bad)
        assert re.search(r"line \d+: ", said), said


def test_a_missing_line_of_format_4_is_named(good41: Path, tmp_path: Path) -> None:
    lines = good41.read_text().splitlines()
    row = lines.index("$Elements") + 10
    bad = tmp_path / "bad.msh"
    bad.write_text("\n".join([*lines[:row], "1 2 x", *lines[row + 1 :]]) + "\n")
    assert f"line {row + 1}: '1 2 x' where" in refusal(bad)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('SystemCall "touch {mark}";\n', "line 1: not a mesh by Gmsh: it must begin with $MeshFormat"),
        ('$MeshFormat\n2.2 0 8\n$EndMeshFormat\nSystemCall "touch {mark}";\n', "line 4: 'SystemCall"),
        ("$MeshFormat\n1.0 0 8\n$EndMeshFormat\n", "line 2: format 1.0; allowed are 2.2 and 4.1"),
        ("$MeshFormat\n4.1 1 8\n$EndMeshFormat\n", "line 2: a binary file; allowed is text"),
        ("$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Merge\nx\n$EndMerge\n", "line 4: unknown section '$Merge'"),
        ("$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Nodes\n", "line 4: the file ends within $Nodes"),
        ("", "line 1: not a mesh by Gmsh"),
    ],
)
def test_no_script_runs_under_the_name_of_a_mesh(tmp_path: Path, text: str, words: str) -> None:
    mark, file = tmp_path / "mark", tmp_path / "vessel.msh"
    file.write_text(text.format(mark=mark))
    assert words in refusal(file)
    assert not mark.exists()


SWAPPED = "geometry.faces.inner = 'outer': its area is 36.74, that of outer 18.37: are inner and outer swapped?"


@pytest.mark.parametrize(
    ("geometry", "words"),
    [
        (
            {"faces": {"inner": "lumen"}},
            "geometry.faces.inner = 'lumen': the file has no such face; it has 'inlet', 'outlet', 'inner', 'outer'",
        ),
        ({"faces": {"inlet": 12}}, "geometry.faces.inlet = 12: the file has no such face"),
        ({"faces": {"inner": "outer", "outer": "inner"}}, SWAPPED),
        ({"faces": {"inlet": 1.5}}, "geometry.faces.inlet = 1.5: must be a name or a number"),
        ({"file_unit": "m"}, "geometry.file_unit = 'm': needs geometry.length_unit"),
    ],
)
def test_faces_that_the_file_has_not(good: Path, geometry: dict[str, Any], words: str) -> None:
    assert words in refusal(good, **geometry)


def bent(x: Any) -> Any:
    """About an axis 4 away."""
    radius, angle = 4 + x[:, 0], x[:, 2] / 2
    return np.stack([radius * np.cos(angle), x[:, 1], radius * np.sin(angle)], axis=1)


@pytest.mark.parametrize("end", ["inlet", "outlet"])
@pytest.mark.parametrize("wall", ["inner", "outer"])
@pytest.mark.parametrize(
    "body",
    [
        {},
        {"length": 0.1},  # the ends are larger than the inner face
        {"moved": bent},
        {"element": "tetrahedron", "degree": 2},
    ],
    ids=["tube", "ring", "bent", "curved tetrahedra"],
)
def test_an_end_and_a_wall_that_are_exchanged(tmp_path: Path, body: dict[str, Any], wall: str, end: str) -> None:
    """Whichever two of the names; the line says which."""
    file = write_tube(tmp_path / "tube.msh", **body)
    said = refusal(file, faces={wall: end, end: wall})
    assert f"geometry.faces.{wall} = '{end}': inner and outer touch each other: are {wall} and {end} swapped?" in said


@pytest.mark.parametrize("file", ["lumen.stl", "vessel.inp", "vessel.pvtu", "vessel.msh.gz", "vessel", "", "a/b.txt"])
@pytest.mark.parametrize("known", [{}, {"element": "hexahedron", "degree": 1}])
def test_another_ending_is_refused_by_key_and_value(tmp_path: Path, file: str, known: dict[str, Any]) -> None:
    """As the scene has it, whether or not element and degree have to be read from the file."""
    (tmp_path / "scene.toml").write_text(SCENE.format(file))
    settings = [f"mesh.{key}={value}" for key, value in known.items()]
    with pytest.raises(SceneError) as error:
        read_scene(tmp_path / "scene.toml", settings)
    assert str(error.value).startswith(f"geometry.file = {file!r}: must be the path of a mesh (.msh, ")


def overlapping(path: Path, version: float) -> Path:
    """Two boxes and their faces, with names for both boxes at once, for all of the boundary, and for two faces."""
    with gmsh_model("boxes") as gmsh:
        for z in (0, 1):
            gmsh.model.occ.addBox(0, 0, z, 1, 1, 1)
        gmsh.model.occ.fragment([(3, 1)], [(3, 2)])
        gmsh.model.occ.synchronize()
        centre = {tag: gmsh.model.occ.getCenterOfMass(2, tag) for _, tag in gmsh.model.getEntities(2)}

        def at(axis: int, value: float) -> list[int]:
            return [tag for tag, place in centre.items() if abs(place[axis] - value) < 1e-9]

        for number, (axis, value, name) in enumerate(
            [
                (0, 0.0, "inner"),
                (0, 1.0, "outer"),
                (2, 0.0, "inlet"),
                (2, 2.0, "outlet"),
                (1, 0.0, "front"),
                (1, 1.0, "back"),
            ],
            1,
        ):
            gmsh.model.addPhysicalGroup(2, at(axis, value), number, name)
        gmsh.model.addPhysicalGroup(2, [tag for tag in centre if tag not in at(2, 1.0)], 7, "boundary")
        gmsh.model.addPhysicalGroup(2, at(1, 0.0) + at(1, 1.0), 8, "sides")
        for number, (tags, name) in enumerate([([1], "lower"), ([2], "upper"), ([1, 2], "wall")], 11):
            gmsh.model.addPhysicalGroup(3, tags, number, name)
        gmsh.model.mesh.setSize(gmsh.model.getEntities(0), 0.5)
        gmsh.model.mesh.generate(3)
        gmsh.option.setNumber("Mesh.MshFileVersion", version)
        gmsh.write(str(path))
    return path


@pytest.mark.parametrize("version", [2.2, 4.1])
@pytest.mark.parametrize("refinement", [1, 2])
def test_groups_that_the_scene_does_not_name_may_overlap(tmp_path: Path, version: float, refinement: int) -> None:
    """They are left alone; those that it names may not."""
    file = overlapping(tmp_path / "boxes.msh", version)
    regions = {"lower": "lower", "upper": "upper"}
    values = {"geometry": {"shape": "mesh", "file": str(file), "regions": regions}, "time": {"end": 1.0, "step": 1.0},
              "mesh": {"refinement": refinement}}  # fmt: skip
    scene = scene_from_dict(values)
    _, boundary, found = scene.geometry.checked(scene.mesh)
    assert {face.name for face in boundary.faces} == {"inner", "outer", "inlet", "outlet", "front", "back"}
    assert boundary.volume == pytest.approx(2.0) and set(found) == {"lower", "upper"}
    assert "shares facets with the face" in refusal(file, regions=regions, faces={"all": "boundary"})
    assert "in two named volumes" in refusal(file, regions={**regions, "all": "wall"})


def test_a_body_of_another_unit_is_refused(tmp_path: Path) -> None:
    large = write_tube(tmp_path / "large.msh", turn=1e3 * np.eye(3))
    said = refusal(large, file_unit="m", length_unit="um")
    assert "the body is 4e+09 long in the scene's unit; allowed are 1e-06 to 1e+06 (geometry.file_unit" in said


def test_an_open_boundary_is_allowed_when_asked(good: Path, tmp_path: Path) -> None:
    bad = edited(good, tmp_path / "open.msh", "Elements", without_one)
    values = {"geometry": {"shape": "mesh", "file": str(bad), "open_boundary": True}, "time": {"end": 1.0, "step": 1.0}}
    assert scene_from_dict(values).geometry.checked()


def test_a_wall_of_one_element_is_warned_of(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    thin = write_tube(tmp_path / "thin.msh", counts=(8, 1, 2))
    values = {"geometry": {"shape": "mesh", "file": str(thin)}, "time": {"end": 1.0, "step": 1.0}}
    scene_from_dict(values).geometry.checked()
    assert any("one element thick" in record.message for record in caplog.records)


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("missing.msh", "no such file"),
        ("../scene.toml", "must be the path of a mesh (.msh, "),
        ("folder.msh", "is a folder"),
    ],
)
def test_the_command_refuses_with_2_and_leaves_nothing(tmp_path: Path, file: str, words: str) -> None:
    (tmp_path / "folder.msh").mkdir()
    scene, out = tmp_path / "scene.toml", tmp_path / "out"
    scene.write_text(SCENE.format(file))
    words_of = ["python3", "-m", "remodel_fenicsx", "run", str(scene), "-o", str(out)]
    done = subprocess.run(words_of, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert words in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not out.exists()
