"""From the surface of a lumen to a wall: volumes of closed form, formats, orientation, branches, what is refused."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from numpy.typing import NDArray

from remodel_fenicsx import cli
from remodel_fenicsx.scene import scene_from_dict
from tests.conftest import Refused
from tests.tables import rows

RADIUS, LENGTH, AROUND, ALONG = 1.0, 4.0, 48, 24
Triangles = NDArray[np.int64]


def tube(
    bend: float = 0.0, around: int = AROUND, along: int = ALONG
) -> tuple[NDArray[np.float64], Triangles]:
    """A grid of triangles around the z axis, perhaps along an arc, open at its ends, normals outwards."""
    z, turn = np.meshgrid(np.linspace(0, LENGTH, along + 1), 2 * np.pi * np.arange(around) / around)
    x, y = RADIUS * np.cos(turn), RADIUS * np.sin(turn)
    if bend:
        radius = LENGTH / bend
        x, z = (radius + x) * np.cos(z / radius) - radius, (radius + x) * np.sin(z / radius)
    number = np.arange(z.size).reshape(z.shape)
    a, b = number[:, :-1], np.roll(number, -1, axis=0)[:, :-1]
    rows = [np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, b + 1), (a, b + 1, a + 1))]
    return np.stack([x, y, z], axis=-1).reshape(-1, 3), np.concatenate(rows)


def written(path: Path, points: Any, triangles: Any, /, **arrays: Any) -> Path:
    """In the format of its ending; .vtp as VTK writes it."""
    if path.suffix != ".vtp":
        meshio.Mesh(points, [("triangle", triangles)], point_data=arrays).write(path)
        return path
    pyvista = pytest.importorskip("pyvista")
    data = pyvista.PolyData(points, np.column_stack([np.full(len(triangles), 3), triangles]))
    for name, values in arrays.items():
        data.point_data[name] = values
    data.save(path, binary=True)
    return path


def volumes(file: Path) -> dict[str, float]:
    """Of the regions, by straight-sided tetrahedra."""
    mesh = meshio.read(file)
    corners = mesh.points[mesh.get_cells_type("tetra10")[:, :4]]
    signed = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
    assert (signed > 0).all()
    tags = mesh.get_cell_data("gmsh:physical", "tetra10")
    names = {int(tag): name for name, (tag, dimension) in mesh.field_data.items() if dimension == 3}
    return {name: float(signed[tags == tag].sum()) for tag, name in names.items()}


def ring(inner: float, outer: float) -> float:
    return float(np.pi * (outer**2 - inner**2) * LENGTH)


def wall(*words: Any) -> int:
    return cli.main(["wall", *map(str, words)])


@pytest.mark.parametrize(
    ("ending", "inwards"), [("stl", 0), ("STL", 1), ("ply", 1), ("obj", 0), ("vtp", 0), ("vtp", 1)]
)
def test_layers_have_their_volumes_whatever_the_file(
    ending: str, inwards: int, tmp_path: Path
) -> None:
    """Of a straight tube, whichever way its triangles look; one in three looks the other way."""
    points, triangles = tube()
    turned = triangles[:, ::-1] if inwards else triangles.copy()
    turned[::3] = turned[::3, ::-1]
    file, path = tmp_path / f"lumen.{ending}", tmp_path / "vessel.msh"
    written(file.with_suffix(file.suffix.lower()), points, turned).rename(file)
    assert wall(file, "--layers", "media=0.3", "adventitia=0.2", "--size", 0.3, "-o", path) == 0
    found = volumes(path)
    assert found["media"] == pytest.approx(ring(1.0, 1.3), rel=0.03)
    assert found["adventitia"] == pytest.approx(ring(1.3, 1.5), rel=0.03)


def test_a_wall_may_be_thicker_than_the_radius_of_its_lumen(tmp_path: Path) -> None:
    """Where it does not fold; docs/my_own_vessel.md says so."""
    file, path = written(tmp_path / "lumen.stl", *tube()), tmp_path / "vessel.msh"
    assert wall(file, "--thickness", 2.9, "--size", 0.5, "-o", path) == 0
    assert sum(volumes(path).values()) == pytest.approx(ring(1.0, 3.9), rel=0.03)


def test_its_faces_lie_where_they_belong_and_a_scene_takes_it(tmp_path: Path) -> None:
    """Bent by a right angle: ends stay flat; the thickness comes from an array of the file."""
    points, triangles = tube(bend=np.pi / 2)
    thick = np.where(points[:, 1] > 0, 0.6, 0.3)
    file, path = (
        written(tmp_path / "lumen.vtp", points, triangles, wall=thick),
        tmp_path / "vessel.msh",
    )
    assert wall(file, "--thickness", "wall", "--size", 0.5, "--through", 3, "-o", path) == 0
    mesh = meshio.read(path)
    tags = mesh.get_cell_data("gmsh:physical", "triangle6")
    places = {
        name: mesh.points[np.unique(mesh.get_cells_type("triangle6")[tags == tag])]
        for name, (tag, dimension) in mesh.field_data.items()
        if dimension == 2
    }
    assert set(places) == {"inner", "outer", "inlet", "outlet_1"}
    assert np.abs(places["inlet"][:, 2]).max() < 1e-9
    centre = -LENGTH / (np.pi / 2)
    assert np.abs(places["outlet_1"][:, 0] - centre).max() < 1e-6
    distance = np.hypot(
        np.hypot(places["outer"][:, 0] - centre, places["outer"][:, 2]) + centre,
        places["outer"][:, 1],
    )
    assert distance.max() == pytest.approx(1.6, abs=0.05) and distance.min() == pytest.approx(
        1.3, abs=0.05
    )
    geometry = {
        "shape": "mesh",
        "file": str(path),
        "length_unit": "mm",
        "faces": {"outlet": "outlet_1"},
    }
    checked: Any = scene_from_dict(
        {"geometry": geometry, "time": {"end": 1.0, "step": 1.0}}
    ).geometry
    assert checked.checked() is not None


def test_a_branch_is_taken_and_its_ends_are_counted(tmp_path: Path) -> None:
    file, path = Path(__file__).with_name("files") / "branch.stl", tmp_path / "vessel.msh"
    assert wall(file, "--thickness", 0.3, "--size", 0.4, "-o", path) == 0
    names = {
        name for name, (_, dimension) in meshio.read(path).field_data.items() if dimension == 2
    }
    assert names == {"inner", "outer", "inlet", "outlet_1", "outlet_2"}
    assert min(volumes(path).values()) > 0


def with_words(
    points: Any, cells: Any, face: str = "vertex_indices", header: str = "", tail: str = ""
) -> str:
    """A PLY file as text; polygons have a number of corners each."""
    lines = [
        "ply",
        "format ascii 1.0",
        f"element vertex {len(points)}",
        *(f"property float {c}" for c in ["x", "y", "z"]),
    ]
    lines += [
        f"element face {len(cells)}",
        f"property list uchar int {face}",
        f"{header}end_header",
    ]
    rows = [
        " ".join(map(str, row))
        for row in [*points.tolist(), *([len(c), *c] for c in cells.tolist())]
    ]
    return "\n".join([*lines, *rows, tail])


def as_programs_write(points: Any, triangles: Any) -> dict[str, bytes]:
    """The same surface in files of other kinds."""
    number = np.arange(len(points)).reshape(AROUND, ALONG + 1)
    a, b = number[:, :-1], np.roll(number, -1, axis=0)[:, :-1]
    quads = np.stack([a, b, b + 1, a + 1], axis=-1).reshape(-1, 4)
    corners = ["vertex {:.6e} {:.6e} {:.6e}".format(*place) for place in points[triangles.ravel()]]
    facets = (
        "\n".join(["facet normal 0 0 0", "outer loop", *c, "endloop", "endfacet"])
        for c in zip(*[iter(corners)] * 3)
    )
    text = "\n".join(["solid lumen", *facets, "endsolid lumen\n"])
    places = "".join("v {} {} {}\n".format(*place) for place in points)
    coloured = places.replace("\n", " 0.5 0.5 0.5\n")

    def faces(form: str, cells: Any) -> str:
        return "".join(
            "f " + " ".join(form.format(k + 1, k % 2 + 1) for k in cell) + "\n" for cell in cells
        )

    binary = ["ply", "format binary_big_endian 1.0", f"element vertex {len(points)}"]
    binary += [
        f"property {kind} {c}"
        for kind, c in [("double", "x"), ("float", "y"), ("double", "z"), ("uchar", "red")]
    ]
    binary += [
        f"element face {len(quads)}",
        "property uchar flags",
        "property list uchar int vertex_index",
        "end_header\n",
    ]
    records = np.zeros(len(points), ">f8, >f4, >f8, u1")
    records["f0"], records["f1"], records["f2"] = points.T
    polygons = np.zeros(len(quads), "u1, u1, 4>i4")
    polygons["f1"], polygons["f2"] = 4, quads
    edges = "element edge 1\nproperty int vertex1\nproperty int vertex2\n"
    return {
        "capitals.stl": text.upper().encode(),
        "commas.stl": text.replace(".", ",").encode(),
        "texture.obj": (
            "mtllib a.mtl\nvt 0 0\nvt 1 1\nvn 0 0 1\n"
            + places
            + "usemtl a\n"
            + faces("{}/{}/1", quads)
        ).encode(),
        "normals.obj": ("vn 0 0 1\n" + coloured + "l 1 2\n" + faces("{}//1", triangles)).encode(),
        "index.ply": with_words(points, triangles, "vertex_index").encode(),
        "edge.ply": with_words(points, quads, header=edges, tail="0 1\n").encode(),
        "binary.ply": "\n".join(binary).encode() + records.tobytes() + polygons.tobytes(),
    }


def test_files_of_many_programs_are_the_same_surface(tmp_path: Path) -> None:
    points, triangles = tube()
    files = as_programs_write(points, triangles)
    named = dict.fromkeys(["triangles", "points", "file"], points[:, 2])
    written(tmp_path / "arrays.vtp", points, triangles, **named)
    written(tmp_path / "arrays.ply", points, triangles, **named)
    for name, text in files.items():
        (tmp_path / name).write_bytes(text)
    for name in ("arrays.vtp", "arrays.ply", *files):
        assert (
            wall(tmp_path / name, "--thickness", 0.3, "--size", 0.5, "-o", tmp_path / f"{name}.msh")
            == 0
        )
        radii = np.linalg.norm(meshio.read(tmp_path / f"{name}.msh").points[:, :2], axis=1)
        expected = [RADIUS, RADIUS + 0.3]
        np.testing.assert_allclose([radii.min(), radii.max()], expected, rtol=0.01, err_msg=name)


@pytest.mark.parametrize(("bend", "wide"), [(0.0, 3.0), (1.5, 1.0)])
def test_elements_bend_as_the_smooth_lumen(
    bend: float, wide: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of an ellipse, whose curvature is nine times its mean at its tips, and of a torus."""
    points, triangles = tube(bend)
    file, path = (
        written(tmp_path / "lumen.ply", points * [wide, 1, 1], triangles),
        tmp_path / "vessel.msh",
    )
    assert wall(file, "--thickness", 0.5, "--size", 0.5, "-o", path) == 0
    said = re.search(r"thickness ([\d.]+) to 0.5 at the nodes", capsys.readouterr().out)
    assert said is not None and float(said[1]) > 0.48
    mesh = meshio.read(path)
    face = mesh.get_cells_type("triangle6")[mesh.get_cell_data("gmsh:physical", "triangle6") == 1]
    u, v = (
        np.array(each)
        for each in zip(*[(i / 16, j / 16) for i in range(17) for j in range(17 - i)], strict=True)
    )
    w = 1 - u - v
    shapes = np.array(
        [w * (2 * w - 1), u * (2 * u - 1), v * (2 * v - 1), 4 * u * w, 4 * u * v, 4 * v * w]
    )
    x, y, z = np.moveaxis(np.einsum("np,fnd->fpd", shapes, mesh.points[face]), 2, 0)
    if bend:
        x = np.hypot(x + LENGTH / bend, z) - LENGTH / bend
    off = (x / wide) ** 2 + y**2 - 1
    assert abs(off.mean()) < 2e-3 and np.abs(off).max() < 0.03  # flat triangles of this size: 0.2


def closed() -> tuple[Any, Any]:
    points, triangles = tube()
    ends = np.arange(len(points)).reshape(AROUND, ALONG + 1)
    caps = [
        np.stack([rim, np.roll(rim, -1), np.full(AROUND, len(points) + k)], 1)
        for k, rim in enumerate(ends[:, [0, -1]].T)
    ]
    return np.vstack([points, [[0, 0, 0], [0, 0, LENGTH]]]), np.vstack([triangles, *caps])


def two() -> tuple[Any, Any]:
    points, triangles = tube()
    return np.vstack([points, points + [5.0, 0, 0]]), np.vstack(
        [triangles, triangles + len(points)]
    )


def of_three() -> tuple[Any, Any]:
    points, triangles = tube()
    return np.vstack([points, [[2.0, 0, 2.0]]]), np.vstack(
        [triangles, [[*triangles[7, :2], len(points)]]]
    )


def flat() -> tuple[Any, Any]:
    points, triangles = tube()
    across = 2 + points[:, 2:]
    return np.column_stack([points[:, :2] * across, np.zeros(len(points))]), triangles


SURFACES = {
    "flat": flat,
    "one": lambda: (np.eye(3), np.array([[0, 1, 2]])),
    "tube": tube,
    "bend": lambda: tube(3.5),
    "closed": closed,
    "two": two,
    "of three": of_three,
}


@pytest.mark.parametrize(("made", "words", "said"), rows(__file__, "bad_lumens.txt"))
def test_what_is_no_lumen_is_refused_in_one_line(
    made: str, words: str, said: str, tmp_path: Path, refused: Refused
) -> None:
    file = written(tmp_path / "lumen.stl", *SURFACES[made]())
    size = [] if "--size" in words else ["--size", 0.5]
    assert re.search(
        said, refused("wall", file, *words.split(), *size, "-o", tmp_path / "vessel.msh")
    )
    assert list(tmp_path.iterdir()) == [file]


WORDS = with_words(*tube())
CUT = WORDS[: len(WORDS) * 3 // 4].encode()


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("lumen.stl", b"solid nothing"), ("lumen.ply", b"ply\nformat ascii 1.0\nelement vertex 99999999999\n"),
        ("lumen.vtp", b"<!DOCTYPE x [<!ENTITY a 'b'>]><VTKFile/>"), ("lumen.obj", b"v 0 0\nf 1 2 3\n"),
        ("more.ply", CUT), ("fewer.ply", WORDS.replace("face 2304", "face 2302").encode()),
        ("cut.stl", as_programs_write(*tube())["capitals.stl"][:5000]),
        ("corners.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3 4\n"),
        ("points.ply", WORDS.replace("\n3 0 ", "\n3 5000 ").encode()),
        ("lumen.step", b""), ("lumen.vtp", b"<VTKFile type='PolyData'><xi:include href='/etc/passwd'/></VTKFile>"),
    ],
)  # fmt: skip
def test_files_that_are_none_are_refused_in_one_line(
    name: str, text: bytes, tmp_path: Path, refused: Refused
) -> None:
    (tmp_path / name).write_bytes(text)
    words = ("--thickness", 1, "--size", 1, "-o", tmp_path / "vessel.msh")
    said = refused("wall", tmp_path / name, *words)
    assert name in said and "/proc/" not in said and "Compos" not in said
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_wall_gets_thinner_where_it_would_fold(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Inside a bend there is room for its radius of curvature less that of the lumen."""
    bend, thickness = 2.6, 0.8
    file, path = tmp_path / "bend.vtp", tmp_path / "wall.msh"
    points, triangles = tube(bend)
    written(file, points, triangles)
    assert wall(file, "--thickness", thickness, "--size", 0.3, "-o", path) == 0
    said = re.search(
        r"thinner than requested at \d+ of .*; least ([\d.]+) for 0.8 at", capsys.readouterr().out
    )
    room = LENGTH / bend - RADIUS
    assert said is not None and 0.5 * room < float(said[1]) < 1.1 * room
    volumes(path)  # has no element that folds
    mesh = meshio.read(path)
    far = LENGTH / bend + RADIUS  # of the lumen's outside from the axis of the bend
    distance = np.hypot(mesh.points[:, 0] + LENGTH / bend, mesh.points[:, 2])
    assert distance.max() == pytest.approx(far + thickness, rel=5e-3)
