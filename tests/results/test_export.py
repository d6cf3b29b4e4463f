"""The cells of a run in files of other programs, read back by parsers that are written from their manuals."""

from __future__ import annotations

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
from tests.results.test_stress_on_the_body import SCENES
from tests.tables import of_csv, rows
from tests.values import TURN, ramp_to

RAMP = ramp_to(3.0)
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
MEDIA = {"outer_radius": 1.5, "material": {"lame_lambda": 5.0, "lame_mu": 2.0}}
LAYERS = TUBE | {"regions": {"media": MEDIA, "adventitia": {}}}
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
        yield run(Scene(**LAYERS), tmp_path_factory.mktemp("export") / "run")


@pytest.fixture(params=MESHES)
def start(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What a run on a mesh leaves, without the run: cells and displacements by chance."""
    monkeypatch.setattr(tube, "PAPER", (8, 4, 1))
    scene = Scene(**LAYERS | {"mesh": MESHES[request.param]})
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
        self.nodes, self.elements, self.parts, self.faces = {}, {}, {}, {}
        self.a, self.d, self.dimensions, self.pressures = {}, {}, {}, {}
        self.fixed, self.materials, self.kind = {}, {}, ""

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


def read_febio(path: Path) -> Solid:
    """FEBio User Manual 4 (names of tags in febio.txt): lid counts the elements of the set that a part names."""
    root, solid = ElementTree.parse(path).getroot(), Solid()
    known = {tag: names.split() for tag, names in rows(__file__, "febio.txt")}
    assert [part.tag for part in root] == known[root.tag][:-1]
    for one in root.iter():
        types = [one.attrib["type"].replace(" ", "-")] if "type" in one.attrib else []
        assert {part.tag for part in one} | {*one.attrib} | {*types} <= {*known[one.tag]}, one.tag
    solid.nodes = {int(node.attrib["id"]): numbers(node.text) for node in root.iter("node")}
    for part in root.iter("Elements"):
        of_part = {int(e.attrib["id"]): [*map(int, numbers(e.text))] for e in part}
        solid.parts[part.attrib["name"]] = [*of_part]
        solid.elements |= of_part
        solid.kind = part.attrib["type"]
    for data in root.iter("ElementData"):
        for one in data:
            element = solid.parts[data.attrib["elem_set"]][int(one.attrib["lid"]) - 1]
            if data.attrib.get("type") == "mat_axis":
                found = {axis.tag: numbers(axis.text) for axis in one}
                solid.a[element], solid.d[element] = found["a"], found["d"]
            else:
                solid.dimensions.setdefault(element, []).append(float(one.text or ""))
    for surface in root.iter("Surface"):
        solid.faces[surface.attrib["name"]] = [[*map(int, numbers(f.text))] for f in surface]
    sets = {one.attrib["name"]: {*numbers(one.text)} for one in root.iter("NodeSet")}
    for bc in root.iter("bc"):
        solid.fixed |= {dof.tag[0]: sets[bc.attrib["node_set"]] for dof in bc if dof.text == "1"}
    materials = {one.attrib["name"]: one for one in root.iter("material")}
    assert [one.attrib["id"] for one in materials.values()] == [
        *map(str, range(1, len(materials) + 1))
    ]
    for domain in root.iter("SolidDomain"):
        E, v = (float(one.text or "") for one in materials[domain.attrib["mat"]])
        solid.materials[domain.attrib["name"]] = E * v / (1 + v) / (1 - 2 * v), E / 2 / (1 + v)
    for load in root.iter("surface_load"):
        solid.pressures[load.attrib["surface"]] = float(load[0].text or "")
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
    mesh, materials = meshio.read(path, file_format="abaqus"), {}
    assert max(map(len, re.findall(r"[-+.\de]+", text))) <= 20  # CalculiX reads no more
    assert max(line.count(",") for line in text.splitlines()) <= 16 and "\n\n" not in text
    for keyword, said, body in re.findall(
        r"^\*(\w[^,\n]*)(.*)\n((?:[^*].*\n)*)", re.sub(r"^\*\*.*\n", "", text, flags=re.M), re.M
    ):
        options = dict(word.strip().split("=") for word in said.split(",") if "=" in word)
        lines = [line.split(",") for line in body.replace(",\n", ",").splitlines()]
        if keyword == "NODE":
            solid.nodes = {int(n): [*map(float, place)] for n, *place in lines}
        elif keyword == "ELEMENT":
            solid.kind, part = options["TYPE"], {int(e): [*map(int, nodes)] for e, *nodes in lines}
            solid.parts[options["ELSET"]] = [*part]
            solid.elements |= part
        elif keyword == "SURFACE":
            corners = ABAQUS_SIDES[4 if solid.kind in ("C3D4", "C3D10") else 8]
            solid.faces[options["NAME"]] = [
                [solid.elements[int(e)][int(c) - 1] for c in corners[int(side[1]) - 1][::-1]]
                for e, side in lines
            ]
        elif keyword == "BOUNDARY":
            for name, first, last in lines:
                assert first == last
                nodes = np.array([*solid.nodes])[mesh.point_sets[name]].tolist()
                solid.fixed["xyz"[int(first) - 1]] = {*nodes}
        elif keyword == "MATERIAL":
            material = options["NAME"]
        elif keyword == "HYPERELASTIC":
            assert "NEO HOOKE" in said
            C10, D1 = map(float, lines[0])
            materials[material] = 2 / D1 - 4 * C10 / 3, 2 * C10
        elif keyword == "SOLID SECTION":
            assert options["ORIENTATION"] == "CELLS"
            solid.materials[options["ELSET"]] = materials[options["MATERIAL"]]
        elif keyword == "DSLOAD":
            solid.pressures |= {face: float(value) for face, _, value in lines}
        elif keyword == "DISTRIBUTION":
            for element, *values in lines[1:]:
                axes = [*map(float, values)]
                solid.a[int(element)], solid.d[int(element)] = axes[:3], axes[3:]
    for element, length in re.findall(r"^\*\* (\d+),(.*)$", text, re.M):
        solid.dimensions.setdefault(int(element), []).append(float(length))
    np.testing.assert_array_equal(mesh.points, [solid.nodes[n] for n in sorted(solid.nodes)])
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
        solid = reader(path)
        middles = solid.places().mean(axis=1)[np.array(solid.parts["media"]) - 1]
        assert len(solid.parts) == 2 and (np.hypot(*middles.T[:2]) < 1.5).all()
        found = solid.tensors()
        np.testing.assert_allclose(found, recorded_tensors(recording, time), rtol=0, atol=1e-6)
    assert np.abs(recorded_tensors(recording, 0.0) - recorded_tensors(recording, 2.0)).max() > 0.01
    np.testing.assert_allclose(
        reader(exported(recorded, kind)).tensors(), found, rtol=0, atol=0
    )  # the last one


@pytest.mark.parametrize(("kind", "reader"), [("febio", read_febio), ("abaqus", read_abaqus)])
def test_elements_are_those_of_the_mesh_and_have_their_nodes_in_order(
    kind: str, reader: Any, start: Path
) -> None:
    """Nodes of edges lie between the corners that manuals name."""
    recording, solid = Recording(start), reader(exported(start, kind))
    places, corners = solid.places(), 8 if solid.kind in ("hex8", "hex20", "C3D8", "C3D20") else 4
    assert int("".join(filter(str.isdigit, solid.kind[3:]))) == places.shape[1]
    assert set(solid.nodes) == {node for nodes in solid.elements.values() for node in nodes}
    np.testing.assert_array_equal(
        places.mean(axis=1).round(9),
        recording.points[recording.elements[:, : places.shape[1]]].mean(axis=1).round(9),
    )
    for node, (i, j) in enumerate(BETWEEN.get(places.shape[1], []), start=corners):
        ends = places[:, i - 1], places[:, j - 1]
        chord = np.linalg.norm(ends[1] - ends[0], axis=1)
        assert (
            np.linalg.norm(places[:, node] - (ends[0] + ends[1]) / 2, axis=1) < 0.25 * chord
        ).all(), (node, i, j)


@pytest.mark.parametrize(("kind", "reader"), [("febio", read_febio), ("abaqus", read_abaqus)])
def test_faces_close_around_the_body(kind: str, reader: Any, start: Path) -> None:
    """Seen from outside: area vectors sum to zero, and enclose the volume of a ring between two octagons."""
    solid, total, volume = reader(exported(start, kind)), np.zeros(3), 0.0
    assert {*solid.faces} == {"bottom", "top", "inner", "outer"} and solid.pressures == {
        "inner": 0.0
    }
    for facets in solid.faces.values():
        corners = 3 if solid.kind in ("tet4", "tet10", "C3D4", "C3D10") else 4
        places = np.array([[solid.nodes[n] for n in facet[:corners]] for facet in facets])
        vectors = np.cross(places[:, 2] - places[:, 0], places[:, -1] - places[:, 1]) / 2
        total += vectors.sum(axis=0)
        volume += np.einsum("ni,ni->", vectors, places.mean(axis=1)) / 3
    assert np.abs(total).max() < 1e-9 and volume == pytest.approx(8 * np.sqrt(8), rel=1e-9)


READERS = {"febio": read_febio, "abaqus": read_abaqus}


@pytest.mark.parametrize("kind", READERS)
def test_regions_have_their_matrix_and_a_tube_its_ends(
    kind: str, start: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Lame constants from E and v or C10 and D1; planes of the ends, and three nodes against rigid motions."""
    solid = READERS[kind](exported(start, kind))
    assert solid.materials.keys() == solid.parts.keys() == {"media", "adventitia"}
    assert solid.materials["media"] == pytest.approx((5.0, 2.0))
    assert solid.materials["adventitia"] == pytest.approx((27.293, 3.103))
    assert solid.fixed["z"] == {n for n, (_, _, z) in solid.nodes.items() if z in (0.0, 1.0)}
    assert [len(solid.fixed[axis]) for axis in "xy"] == [1, 2]
    assert ": loads.elongation (left out)\n" in caplog.text


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("kind", READERS)
def test_an_own_vessel_has_what_its_supports_hold(
    kind: str, turned: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A held outlet, a guided inlet if its plane is one of the axes', pressures at half of the ramps; no springs."""
    names = NAMES | {"outer": "1 out"}
    mesh = write_tube(
        tmp_path / "a.msh", "tetrahedron", turn=TURN if turned else None, renamed=names
    )
    scene = SCENES["vessel"]
    scene["geometry"]["file"] = str(mesh)
    solid = READERS[kind](path := exported(run(Scene(**scene), tmp_path / "run"), kind))
    said = "left out" if turned else "simplified"
    assert f": supports.inlet ({said}), supports.outer (left out)\n" in caplog.text
    assert solid.pressures == pytest.approx({"inner": 0.3, "outer": 0.1})
    assert "lengths: mm, stresses: kPa" in path.read_text() and len(solid.parts) == 1
    inlet, outlet = (
        {n for facet in solid.faces[end] for n in facet} for end in ("inlet", "outlet")
    )
    guided = {axis: solid.fixed[axis] - outlet for axis in "xyz"}
    assert all(outlet <= nodes for nodes in solid.fixed.values())
    if turned:
        assert not any(guided.values())
        return
    assert guided.pop("z") == inlet
    for axis, nodes in guided.items():  # around the centre
        places = {n: solid.nodes[n]["xy".index(axis)] for n in inlet}
        assert nodes == {n for n, place in places.items() if abs(place) < 1e-9} and len(nodes) > 3


def test_a_cube_has_its_planes_of_symmetry(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cube = {"geometry": {"shape": "cube"}, "model": {"kinematics": "full"}, "time": {"end": 1.0}}
    folder = run(Scene(preset="kuhl-holzapfel-2007", **cube), tmp_path / "run")
    for kind, reader in READERS.items():
        solid = reader(exported(folder, kind))
        for i, axis in enumerate("xyz"):
            assert solid.fixed[axis] == {n for n, place in solid.nodes.items() if place[i] == 0.0}
    assert caplog.text.count(": loads.force (left out)\n") == 2


def test_what_means_of_elements_leave_out_is_said(
    start: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The largest difference of A from the mean at a node, which elements with one point do not lose."""
    mesh = meshio.read(exported(start, "vtu"), file_format="vtu")
    said = re.findall(r"up to ([\d.]+) % of tr A", caplog.text)
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
    rows = of_csv(exported(start, "csv"))
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
