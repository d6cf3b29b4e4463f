"""The cells of a run in files of other programs, read back by parsers that are written from their manuals."""

from __future__ import annotations

import csv
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx import Recording, Scene, cli, run
from remodel_fenicsx.body import tube
from remodel_fenicsx.results.vtkhdf import TransientGrid, vtk_cells
from tests.conftest import Refused
from tests.mesh_files import NAMES, write_tube
from tests.values import ramped

RAMP = [[0.0, 0.0], [3.0, 1.0]]
TUBE: dict[str, Any] = {
    "geometry": {"shape": "tube", "inner_radius": 1.0, "outer_radius": 3.0, "length": 1.0},
    "cells": {"initial": "random"},
    "loads": {"pressure": {"value": 2.4, "ramp": RAMP}, "elongation": {"value": 0.1, "ramp": RAMP}},
    "time": {"end": 2.0}, "model": {"kinematics": "full"},
}  # fmt: skip
MESHES = {
    "hexahedra": {},
    "tetrahedra": {"element": "tetrahedron"},
    "quadratic hexahedra": {"degree": 2},
    "quadratic tetrahedra": {"element": "tetrahedron", "degree": 2},
}
# nodes of an element that lie between two of its corners: Abaqus, C3D20 and C3D10; FEBio counts like it
BETWEEN = {
    20: [
        (1, 2),
        (2, 3),
        (3, 4),
        (4, 1),
        (5, 6),
        (6, 7),
        (7, 8),
        (8, 5),
        (1, 5),
        (2, 6),
        (3, 7),
        (4, 8),
    ],
    10: [(1, 2), (2, 3), (3, 1), (1, 4), (2, 4), (3, 4)],
}


def exported(folder: Path, kind: str, *words: str) -> Path:
    """The file that the command writes."""
    path = folder / f"out-{kind}"
    assert cli.main(["export", str(folder), "--format", kind, "-o", str(path), *words]) == 0
    return path


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A run of two steps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tube, "PAPER", (8, 4, 1))
        yield run(Scene(**TUBE), tmp_path_factory.mktemp("export") / "run")


@pytest.fixture(params=MESHES)
def start(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What a run on a mesh leaves, without the run: cells and displacements by chance."""
    monkeypatch.setattr(tube, "PAPER", (8, 4, 1))
    scene = Scene(**TUBE | {"mesh": MESHES[request.param]})
    (tmp_path / "scene.toml").write_text(scene.to_toml("as run"))
    (tmp_path / "history.csv").write_text("time\n")
    domain = scene.geometry.build_with(scene.regions, scene.mesh, MPI.COMM_SELF)
    points, elements = domain.gather_mesh()
    cell_type, cells = vtk_cells(
        domain.mesh.topology.cell_name(), domain.mesh.geometry.cmap.degree, elements
    )
    draw = np.random.default_rng(1).standard_normal
    axes = np.linalg.qr(draw((len(cells), 3, 3)))[0]
    values = dict(
        zip(CELLS, [np.abs(draw((len(cells), 3))), *np.moveaxis(axes, 1, 0)], strict=True)
    )
    with TransientGrid(tmp_path / "fields.vtkhdf", points, cells, cell_type) as grid:
        grid.append(0.0, {"displacement": draw(points.shape)}, values)
    return tmp_path


CELLS = ("cell_dimensions", "axis_1", "axis_2", "axis_3")


def recorded_tensors(recording: Recording, time: float) -> np.ndarray:
    """A of each element, term by term."""
    fields = recording.fields(time)
    axes = [fields[f"axis_{i + 1}"] for i in range(3)]
    return sum(
        fields["cell_dimensions"][:, i, None, None] ** 2 * axes[i][:, :, None] * axes[i][:, None, :]
        for i in range(3)
    )


def from_axes(a: np.ndarray, d: np.ndarray, dimensions: np.ndarray) -> np.ndarray:
    """A of two vectors in the plane of axes 1 and 2 and three dimensions: 3 = a x d, 2 = 3 x 1, all of unit length."""
    third = np.cross(a, d)
    axes = np.stack([a, np.cross(third, a), third], axis=1)
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    return np.einsum("ni,nij,nik->njk", dimensions**2, axes, axes)


class Solid:
    """What a parser found: nodes by number, elements with their numbers of nodes, a and d and dimensions of each."""

    def __init__(self) -> None:
        self.nodes: dict[int, list[float]] = {}
        self.elements: dict[int, list[int]] = {}
        self.a: dict[int, list[float]] = {}
        self.d: dict[int, list[float]] = {}
        self.dimensions: dict[int, list[float]] = {}
        self.kind = ""
        self.parts: dict[str, list[int]] = {}
        self.faces: dict[str, list[list[int]]] = {}
        self.fixed: list[str] = []
        self.pressures: dict[str, float] = {}

    def tensors(self) -> np.ndarray:
        """A of the elements by their number, which begins with 1."""
        order = range(1, len(self.elements) + 1)
        return from_axes(
            *(np.array([values[n] for n in order]) for values in (self.a, self.d, self.dimensions))
        )

    def places(self) -> np.ndarray:
        """Of the nodes of each element."""
        return np.array(
            [[self.nodes[n] for n in self.elements[e]] for e in range(1, len(self.elements) + 1)]
        )


# Tags of the sections that are written, with their attributes, as the User Manual of FEBio 4 and FEBioXML
# (FEBioMeshSection4, FEBioMeshDataSection4, FEBioBoundarySection3, FEBioLoadsSection4) name them.
FEBIO_TAGS = {
    "febio_spec": ("Mesh MeshData Boundary Loads LoadData", "version"),
    "Mesh": ("Nodes Elements Surface NodeSet", ""),
    "Nodes": ("node", "name"), "node": ("", "id"), "Elements": ("elem", "type name"),
    "Surface": ("tri3 quad4 tri6 quad8", "name"), "NodeSet": ("", "name"),
    **dict.fromkeys(("tri3", "quad4", "tri6", "quad8"), ("", "id")),
    "MeshData": ("ElementData", ""), "ElementData": ("elem", "type elem_set name data_type"),
    "elem": ("a d", "id lid"), "a": ("", ""), "d": ("", ""),
    "Boundary": ("bc", ""), "bc": ("x_dof y_dof z_dof", "type node_set"),
    **dict.fromkeys(("x_dof", "y_dof", "z_dof"), ("", "")),
    "Loads": ("surface_load", ""), "surface_load": ("pressure", "type surface"), "pressure": ("", "lc"),
    "LoadData": ("load_controller", ""), "load_controller": ("interpolate points", "id name type"),
    "interpolate": ("", ""), "points": ("pt", ""), "pt": ("", ""),
}  # fmt: skip
FEBIO_TYPES = {
    "Elements": ("tet4", "tet10", "hex8", "hex20"), "ElementData": ("mat_axis",), "bc": ("zero displacement",),
    "surface_load": ("pressure",), "load_controller": ("loadcurve",),
}  # fmt: skip


def read_febio(path: Path) -> Solid:
    """FEBio User Manual 4: lid counts the elements of the set, which the part gives its name."""
    root, solid = ElementTree.parse(path).getroot(), Solid()
    assert (root.tag, root.attrib["version"]) == ("febio_spec", "4.0")
    assert [part.tag for part in root] == FEBIO_TAGS["febio_spec"][0].split()
    for one in root.iter():
        tags, attributes = (words.split() for words in FEBIO_TAGS[one.tag])
        assert {part.tag for part in one} <= {*tags} and {*one.attrib} <= {*attributes}, one.tag
        if "type" in one.attrib:
            assert one.attrib["type"] in FEBIO_TYPES[one.tag]
    solid.nodes = {int(node.attrib["id"]): numbers(node.text) for node in root.iter("node")}
    for part in root.iter("Elements"):
        of_part = {int(e.attrib["id"]): [int(n) for n in (e.text or "").split(",")] for e in part}
        solid.parts[part.attrib["name"]] = [*of_part]
        solid.elements |= of_part
        solid.kind = part.attrib["type"]
    for data in root.iter("ElementData"):
        part_elements = solid.parts[data.attrib["elem_set"]]
        for one in data:
            element = part_elements[int(one.attrib["lid"]) - 1]
            if data.attrib.get("type") == "mat_axis":
                found = {axis.tag: numbers(axis.text) for axis in one}
                solid.a[element], solid.d[element] = found["a"], found["d"]
            else:
                assert data.attrib["data_type"] == "scalar"
                solid.dimensions.setdefault(element, []).append(float(one.text or ""))
    sets = {one.attrib["name"]: numbers(one.text) for one in root.iter("NodeSet")}
    for surface in root.iter("Surface"):
        facets = [[int(n) for n in numbers(facet.text)] for facet in surface]
        assert {*sets[surface.attrib["name"]]} == {node for facet in facets for node in facet}
        solid.faces[surface.attrib["name"]] = facets
    solid.fixed = [bc.attrib["node_set"] for bc in root.iter("bc")]
    assert all([dof.text for dof in bc] == ["1", "1", "1"] for bc in root.iter("bc"))
    for load in root.iter("surface_load"):
        (value,) = load
        assert value.attrib["lc"] == next(root.iter("load_controller")).attrib["id"]
        solid.pressures[load.attrib["surface"]] = float(value.text or "")
    return solid


def numbers(text: str | None) -> list[float]:
    """With commas between."""
    return [float(word) for word in (text or "").split(",")]


# corners of the sides of solids, from the Keywords Reference Guide: *SURFACE, TYPE=ELEMENT
ABAQUS_SIDES = {
    4: ["123", "142", "243", "341"],
    8: ["1234", "5876", "1562", "2673", "3784", "4851"],
}


def read_abaqus(path: Path) -> Solid:
    """Abaqus Keywords Reference Guide: keyword lines, data lines, ** comments; after a comma a data line goes on."""
    solid, text = Solid(), path.read_text()
    assert text.isascii() and max(map(len, text.splitlines())) <= 256
    assert max(line.count(",") for line in text.splitlines()) <= 16 and "\n\n" not in text
    keywords = re.findall(
        r"^\*(\w[^,\n]*)(.*)\n((?:[^*].*\n)*)", re.sub(r"^\*\*.*\n", "", text, flags=re.M), re.M
    )
    rows: dict[str, list[list[str]]] = {}
    for keyword, said, body in keywords:
        options = dict(word.strip().split("=") for word in said.split(",") if "=" in word)
        lines = [line.split(",") for line in re.sub(r",\n", ",", body).splitlines()]
        rows[keyword] = lines
        if keyword == "ELEMENT":
            solid.kind, part = options["TYPE"], {
                int(e): [int(n) for n in rest] for e, *rest in lines
            }
            solid.parts[options["ELSET"]] = [*part]
            solid.elements |= part
        elif keyword == "SURFACE":
            assert options["TYPE"] == "ELEMENT"
            corners = ABAQUS_SIDES[4 if solid.kind in ("C3D4", "C3D10") else 8]
            solid.faces[options["NAME"]] = [
                [solid.elements[int(e)][int(c) - 1] for c in corners[int(side.strip("S")) - 1]][
                    ::-1
                ]
                for e, side in lines
            ]
        elif keyword == "NSET":
            nodes = {int(n) for n in lines[0]}
            assert nodes >= {n for facet in solid.faces[options["NSET"]] for n in facet}
        elif keyword == "BOUNDARY":
            assert [line[1:] for line in lines] == [["1", "3"]]
            solid.fixed.append(lines[0][0])
        elif keyword == "DSLOAD":
            ((face, kind, value),) = lines
            assert kind == "P"
            solid.pressures[face] = float(value)
        elif keyword == "DISTRIBUTION":
            assert options["LOCATION"] == "ELEMENT"
        elif keyword == "ORIENTATION":
            assert options["DEFINITION"] == "COORDINATES"
    assert rows["DISTRIBUTION TABLE"] == [["COORD3D", " COORD3D"]]
    solid.nodes = {int(line[0]): [float(x) for x in line[1:]] for line in rows["NODE"]}
    default, *axes = rows["DISTRIBUTION"]
    assert default[0] == "", "the first line is the default"
    for line in axes:
        values = [float(x) for x in line[1:]]
        solid.a[int(line[0])], solid.d[int(line[0])] = values[:3], values[3:]
    for body in re.findall(r"^\*\* cell_dimension_\d of .*\n((?:\*\* \d.*\n)*)", text, re.M):
        for line in body.splitlines():
            element, length = line.removeprefix("** ").split(",")
            solid.dimensions.setdefault(int(element), []).append(float(length))
    return solid


@pytest.mark.parametrize(("kind", "reader"), [("febio", read_febio), ("abaqus", read_abaqus)])
def test_other_programs_get_the_structure_tensor_of_each_element(
    kind: str, reader: Any, recorded: Path
) -> None:
    recording = Recording(recorded)
    for time in (0.0, 2.0):
        path = recorded / f"{kind}-{time}"
        assert (
            cli.main(
                ["export", str(recorded), "--format", kind, "-o", str(path), "--time", str(time)]
            )
            == 0
        )
        found = reader(path).tensors()
        np.testing.assert_allclose(found, recorded_tensors(recording, time), rtol=0, atol=1e-6)
    assert np.abs(recorded_tensors(recording, 0.0) - recorded_tensors(recording, 2.0)).max() > 0.01
    np.testing.assert_allclose(
        reader(exported(recorded, kind)).tensors(), found, rtol=0, atol=0
    )  # the last one


@pytest.mark.parametrize(("kind", "reader"), [("febio", read_febio), ("abaqus", read_abaqus)])
def test_elements_are_those_of_the_mesh_and_have_their_nodes_in_order(
    kind: str, reader: Any, start: Path
) -> None:
    """Corners turn around so that the volume is positive; nodes of edges lie between the corners that manuals name."""
    recording, solid = Recording(start), reader(exported(start, kind))
    places, corners = solid.places(), 8 if solid.kind in ("hex8", "hex20", "C3D8", "C3D20") else 4
    assert int("".join(filter(str.isdigit, solid.kind[3:]))) == places.shape[1]
    assert set(solid.nodes) == {node for nodes in solid.elements.values() for node in nodes}
    np.testing.assert_array_equal(
        places.mean(axis=1).round(9),
        recording.points[recording.elements[:, : places.shape[1]]].mean(axis=1).round(9),
    )
    last = places[:, 4 if corners == 8 else 3]
    sides = [places[:, 1], places[:, 3 if corners == 8 else 2], last]
    assert (np.linalg.det(np.stack([side - places[:, 0] for side in sides], axis=1)) > 0).all()
    for node, (i, j) in enumerate(BETWEEN.get(places.shape[1], []), start=corners):
        ends = places[:, i - 1], places[:, j - 1]
        chord = np.linalg.norm(ends[1] - ends[0], axis=1)
        assert (
            np.linalg.norm(places[:, node] - (ends[0] + ends[1]) / 2, axis=1) < 0.25 * chord
        ).all(), (node, i, j)


@pytest.mark.parametrize(("kind", "reader"), [("febio", read_febio), ("abaqus", read_abaqus)])
def test_faces_are_seen_from_outside_and_bear_the_pressure(
    kind: str, reader: Any, start: Path
) -> None:
    """All boundary facets once; area vectors of a closed surface sum to zero, and enclose the volume of the prism."""
    solid = reader(exported(start, kind))
    assert set(solid.faces) == {"bottom", "top", "inner", "outer"} and solid.fixed == []
    assert solid.pressures == {"inner": 0.0}  # at t = 0
    nodes = np.array([solid.nodes.get(n, [np.nan] * 3) for n in range(max(solid.nodes) + 1)])
    sizes = {name: 0.0 for name in solid.faces}
    total, volume = np.zeros(3), 0.0
    for name, facets in solid.faces.items():
        corners = nodes[
            np.array(facets)[:, : 3 if solid.kind in ("tet4", "tet10", "C3D4", "C3D10") else 4]
        ]
        vectors = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
        if corners.shape[1] == 4:
            vectors = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]) / 2
        total += vectors.sum(axis=0)
        volume += np.einsum("ni,ni->", vectors, corners.mean(axis=1)) / 3
        sizes[name] = np.linalg.norm(vectors, axis=1).sum()
    section = 4 * np.sin(np.pi / 4) * (3.0**2 - 1.0**2)
    assert np.abs(total).max() < 1e-9 and volume == pytest.approx(section, rel=1e-9)
    assert sizes["top"] == sizes["bottom"] == pytest.approx(section)
    assert (
        sizes["outer"] == pytest.approx(3 * sizes["inner"]) == pytest.approx(48 * np.sin(np.pi / 8))
    )
    for facets in solid.faces.values():  # nodes of edges lie between their corners
        for facet in facets:
            middles = nodes[facet[len(facet) // 2 :]] if len(facet) > 4 else []
            for k, middle in enumerate(middles):
                ends = nodes[facet[k]], nodes[facet[(k + 1) % len(middles)]]
                assert np.linalg.norm(middle - sum(ends) / 2) < 0.25 * np.linalg.norm(
                    ends[1] - ends[0]
                )


def test_regions_are_parts_and_ends_of_an_own_vessel_are_fixed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two layers and two loads at half their ramp; springs around the vessel are no condition; names become labels."""
    tube_with_layers = TUBE | {"regions": {"media": {"outer_radius": 1.5}, "adventitia": {}}}
    mesh = write_tube(tmp_path / "a.msh", "tetrahedron", renamed=NAMES | {"outer": "outside 1"})
    own = {
        "geometry": {"shape": "mesh", "file": str(mesh), "length_unit": "mm",
                     "faces": {"outer": "outside 1"}},
        "material": {"stress_unit": "kPa"},
        "supports": {"outlet": {"kind": "held"}, "outer": {"kind": "elastic", "stiffness": 1.0}},
        "loads": ramped(2.0, pressure=0.6) | {
            "tissue": {"kind": "pressure", "face": "outer", "value": 0.2, "ramp": [[0.0, 0.0], [2.0, 1.0]]}},
        "time": {"end": 1.0, "step": 1.0}, "cells": {"initial": "isotropic"},
    }  # fmt: skip
    monkeypatch.setattr(tube, "PAPER", (8, 4, 1))
    layered = run(Scene(**tube_with_layers | {"time": {"end": 1.0}}), tmp_path / "layered")
    vessel = run(Scene(**own), tmp_path / "vessel")
    for kind, reader in (("febio", read_febio), ("abaqus", read_abaqus)):
        solid = reader(exported(layered, kind))
        radii = {
            name: np.hypot(*solid.places().mean(axis=1)[np.array(rows) - 1, :2].T)
            for name, rows in solid.parts.items()
        }
        assert radii["media"].max() < 1.5 < radii["adventitia"].min()
        np.testing.assert_allclose(
            solid.tensors(), recorded_tensors(Recording(layered), 1.0), rtol=0, atol=1e-6
        )
        path = exported(vessel, kind)
        solid = reader(path)
        assert sorted(solid.fixed) == ["inlet", "outlet"]
        assert solid.pressures == {"inner": pytest.approx(0.3), "outer": pytest.approx(0.1)}
        assert "lengths in mm, stresses in kPa" in path.read_text()


def test_what_means_of_elements_leave_out_is_said(
    start: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The largest difference of A from the mean at a node, which elements with one point do not lose."""
    mesh = meshio.read(exported(start, "vtu"), file_format="vtu")
    said = re.findall(r"differ from their mean by up to ([\d.]+) % of tr A", caplog.text)
    (block,), tensors = mesh.cells, mesh.cell_data["structure_tensor"][0]
    if block.type == "tetra":
        assert not said
        return
    units = tensors / tensors[:, [0, 4, 8]].sum(axis=1, keepdims=True)
    largest = 0.0
    for node in range(len(mesh.points)):
        here = units[np.any(block.data == node, axis=1)]
        largest = max(largest, np.linalg.norm(here - here.mean(axis=0), axis=1).max())
    assert float(said[0]) == pytest.approx(100 * largest, abs=0.06)


def test_vtu_and_csv_hold_the_same(start: Path) -> None:
    """To the last digit, with centroids and, in VTU, the displacement."""
    recording = Recording(start)
    tensors = recorded_tensors(recording, 0.0)
    mesh = meshio.read(exported(start, "vtu"), file_format="vtu")
    (elements,) = mesh.cells
    np.testing.assert_array_equal(mesh.points, recording.points)
    np.testing.assert_array_equal(elements.data, recording.elements)
    np.testing.assert_array_equal(
        mesh.point_data["displacement"], recording.fields(0.0)["displacement"]
    )
    np.testing.assert_allclose(
        mesh.cell_data["structure_tensor"][0].reshape(-1, 3, 3), tensors, rtol=0, atol=1e-15
    )
    for name in CELLS:
        np.testing.assert_array_equal(mesh.cell_data[name][0], recording.fields(0.0)[name])
    rows = list(csv.DictReader(exported(start, "csv").read_text().splitlines()))
    assert [int(row["element"]) for row in rows] == [*range(1, len(tensors) + 1)]
    found = [[float(row[f"structure_tensor_{i}{j}"]) for i in "xyz" for j in "xyz"] for row in rows]
    np.testing.assert_allclose(np.reshape(found, (-1, 3, 3)), tensors, rtol=0, atol=1e-15)
    middle = [[float(row[i]) for i in "xyz"] for row in rows]
    np.testing.assert_allclose(
        middle, recording.points[recording.elements].mean(axis=1), atol=1e-12
    )


def test_what_cannot_be_exported_is_said_in_a_line(
    recorded: Path, tmp_path: Path, refused: Refused
) -> None:
    def said(*words: str | Path, folder: Path = recorded) -> str:
        found = refused("export", folder, "--format", "csv", "-o", tmp_path / "new.csv", *words)
        assert not (tmp_path / "new.csv").exists()
        return found

    assert "time 1.5; recorded are 0, 1, 2" in said("--time", "1.5")
    (tmp_path / "old.csv").write_text("dear")
    assert "old.csv: already exists" in said("-o", tmp_path / "old.csv")
    assert (tmp_path / "old.csv").read_text() == "dear"
    cube = {"geometry": {"shape": "cube"}, "model": {"kinematics": "point"}, "time": {"end": 1.0}}
    for name, table in (
        ("kinematics", {}),
        ("fields", {"model": {}, "output": {"fields": ["displacement"]}}),
    ):
        folder = run(Scene(preset="kuhl-holzapfel-2007", **cube | table), tmp_path / name)
        assert name in said(folder=folder)
