"""Measured fibres as cells at t = 0: what is exported comes back; other meshes, ranks, resuming, and bad files."""

from __future__ import annotations

import csv
import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest

from remodel_fenicsx import Scene, SceneError, Simulation, cli, read_scene, run, running
from remodel_fenicsx.body import tube
from remodel_fenicsx.model.cells import structure_tensor
from remodel_fenicsx.model.axes import cells_from_tensors, structure_tensors
from remodel_fenicsx.running import resume
from tests.results.test_export import TUBE
from tests.runs import SELF, last_row, made
from tests.tables import of_csv, rows, unescaped
from tests.values import ANGLES, assert_close

R0 = 0.9


@pytest.fixture(scope="module", autouse=True)
def coarse() -> Any:
    """Tubes of 32 elements, eight around."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tube, "PAPER", (8, 4, 1))
        yield


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The last state of a run in a file of a format."""
    folder = run(Scene(**TUBE), tmp_path_factory.mktemp("out") / "run")

    def file(kind: str) -> Path:
        path = folder / f"fibres.{kind}"
        assert path.exists() or cli.main(["export", str(folder), "--format", kind]) == 0
        return path

    return file


def scene(file: Path | str, **cells: Any) -> Scene:
    """The tube with the cells of a file."""
    return Scene(
        **TUBE
        | {
            "cells": {"fibres": str(file), "end_to_end_length": R0, **cells},
            "solver": {"method": "direct"},
        }
    )


def tensors_of(one: Scene) -> np.ndarray:
    """A at the points of each element, by the number of the element."""
    with made(one) as simulation:
        tensors = simulation.cells.structure_tensor()
        found = np.empty_like(tensors)
        found[simulation.domain.element_number] = tensors
        return found


def table(path: Path, rows: list[dict[str, Any]]) -> Path:
    """A file of rows."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    return path


def expected(path: Path) -> np.ndarray:
    """A of a table, scaled to the trace r0^2."""
    names = [f"structure_tensor_{i}{j}" for i in "xyz" for j in "xyz"]
    tensors = np.array([[float(row[name]) for name in names] for row in of_csv(path)]).reshape(
        -1, 1, 3, 3
    )
    return R0**2 * tensors / np.trace(tensors, axis1=2, axis2=3)[..., None, None]


# ---------------------------------------------------------------- files that were exported


@pytest.mark.parametrize("kind", ["vtu", "csv", "xdmf"])
def test_what_is_exported_comes_back(
    kind: str, exported: Callable[[str], Path], tmp_path: Path
) -> None:
    """A to 1e-12, at every point of an element, by number; dimensions with the longest first."""
    if kind == "xdmf":
        path = tmp_path / "fibres.xdmf"
        meshio.xdmf.write(path, meshio.read(exported("vtu")), data_format="XML")
    else:
        path = exported(kind)
    found = tensors_of(scene(path))
    wanted = np.broadcast_to(expected(exported("csv")), found.shape)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12 if kind != "xdmf" else 1e-6)
    assert np.ptp(found, axis=0).max() > 0.1, "elements differ"


def test_rows_belong_to_numbers_or_else_to_places(
    exported: Callable[[str], Path], tmp_path: Path
) -> None:
    """Shuffled rows; six numbers in place of nine; places a little beside those of the elements."""
    table_rows = of_csv(exported("csv"))
    wanted = tensors_of(scene(exported("csv")))
    order = np.random.default_rng(2).permutation(len(table_rows))
    np.testing.assert_allclose(
        tensors_of(scene(table(tmp_path / "a.csv", [table_rows[i] for i in order]))),
        wanted,
        atol=1e-14,
    )
    six = [{f"structure_tensor_{c}": row[f"structure_tensor_{c}"] for c in ("xx", "yy", "zz", "xy", "yz", "xz")}
           | {c: float(row[c]) + 0.05 for c in "xyz"} for row in table_rows]  # fmt: skip
    shuffled = [six[i] for i in order] + [six[0] | {"x": 100.0, "structure_tensor_xx": 50.0}]
    for number, found in enumerate((shuffled[:-1], shuffled)):  # as many as elements, and one more
        path = table(tmp_path / f"b{number}.csv", found)
        np.testing.assert_allclose(tensors_of(scene(path)), wanted, atol=1e-12)


DIALECTS: dict[str, Callable[[str], str | bytes]] = {
    "mark of the byte order": lambda text: b"\xef\xbb\xbf" + text.encode(),
    "UTF-16": lambda text: text.encode("utf-16"),
    "capitals": lambda text: text.replace("x,y,z,angle", "X,Y,Z,Angle"),
    "ParaView": lambda text: text.replace(
        "x,y,z,angle", '"Points:0","Points:1","Points:2","angle"'
    ),
    "tabs": lambda text: text.replace(",", "\t"),
    "spaces": lambda text: "  " + text.replace(",", "   ").replace("\n", " \n  "),
    "semicolons and decimal commas": lambda text: text.replace(",", ";").replace(".", ","),
    "as it is said": lambda text: "SEP=|\n" + text.replace(",", "|"),
    "trailing commas": lambda text: text.replace("\n", ",,\n") + ",,,,,\n",
    "quotes and spaces": lambda text: "\n".join(
        '"' + line.replace(",", '", "') + '"' for line in text.splitlines()
    ),
    "comments and empty lines": lambda text: "# of the left wall\n\n"
    + text.replace("\n", "\r\n")
    + "\r\n",
}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_tables_are_read_however_they_are_written(
    dialect: str, exported: Callable[[str], Path], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Rows of another order go by their places: another angle in each. The log says what was found."""
    rows = of_csv(exported("csv"))[::-1]
    plain = "x,y,z,angle\n" + "".join(
        f"{r['x']},{r['y']},{r['z']},{2.5 * n}\n" for n, r in enumerate(rows)
    )
    (tmp_path / "plain.csv").write_text(plain)
    written = DIALECTS[dialect](plain)
    (tmp_path / "found.csv").write_bytes(
        written if isinstance(written, bytes) else written.encode()
    )
    wanted = tensors_of(scene(tmp_path / "plain.csv"))
    with caplog.at_level("INFO"):
        np.testing.assert_array_equal(tensors_of(scene(tmp_path / "found.csv")), wanted)
    assert (
        np.ptp(wanted[:, 0, 0, 0]) > 0.1 and "found.csv: 32 rows of x, y, z, angle; " in caplog.text
    )


@pytest.mark.parametrize(("angle", "doubted"), [("1.2", True), ("0", False), ("40", False)])
def test_angles_that_look_like_radians_are_doubted(
    angle: str, doubted: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "a.csv").write_text(
        "angle\n" + "-0.5\n" * 31 * doubted + "0\n" * 31 * (not doubted) + f"{angle}\n"
    )
    tensors_of(scene(tmp_path / "a.csv"))
    assert [record.levelname for record in caplog.records if "radians" in record.message] == [
        "WARNING"
    ] * doubted


def test_values_of_points_go_to_the_nearest_elements(
    exported: Callable[[str], Path], tmp_path: Path
) -> None:
    mesh = meshio.read(exported("vtu"))
    direction = mesh.points * [0.0, 0.0, 1.0] + [1.0, 0.0, 0.0]
    meshio.Mesh(mesh.points, mesh.cells, {"fibre": direction}).write(tmp_path / "points.vtu")
    found = tensors_of(scene(tmp_path / "points.vtu"))
    for element, corners in enumerate(mesh.cells[0].data):
        candidates = [np.outer(d, d) / (d @ d) for d in direction[corners]]
        assert (
            min(np.abs(R0**2 * candidate - found[element]).max() for candidate in candidates)
            < 1e-12
        )


# ---------------------------------------------------------------- what is measured, in closed form


def local(angle: float) -> np.ndarray:
    """Axes c, a, r turned about z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[-s, c, 0.0], [0.0, 0.0, 1.0], [c, s, 0.0]])


def test_angles_are_measured_from_circumferential_towards_axial() -> None:
    axes = np.stack([local(0.3), local(2.0)])[:, None]
    found = structure_tensors({"angle": np.array([[[90.0]], [[30.0]]])}, axes)
    np.testing.assert_allclose(found[0, 0], np.diag([0.0, 0.0, 1.0]), atol=1e-15)
    direction = np.sqrt(0.75) * axes[1, 0, 0] + 0.5 * axes[1, 0, 1]
    np.testing.assert_allclose(found[1, 0], np.outer(direction, direction), atol=1e-15)


def test_weights_share_out_two_fibres_or_leave_the_rest_to_all_directions() -> None:
    one, two = np.array([[2.0, 0.0, 0.0]]), np.array([[0.0, 0.0, -0.1]])
    axes = np.eye(3)[None]
    np.testing.assert_allclose(
        structure_tensors({"fibre": one, "fibre_2": two}, axes)[0], np.diag([0.5, 0, 0.5])
    )
    weighed = structure_tensors({"fibre": one, "fibre_2": two, "weight": np.array([[0.8]])}, axes)
    np.testing.assert_allclose(weighed[0], np.diag([0.8, 0, 0.2]), atol=1e-15)
    # the generalised structure tensor kappa I + (1 - 3 kappa) f f of Gasser, Ogden & Holzapfel 2006, kappa = 0.1
    dispersed = structure_tensors({"fibre": one, "weight": np.array([[0.7]])}, axes)
    np.testing.assert_allclose(
        dispersed[0], 0.1 * np.eye(3) + 0.7 * np.diag([1.0, 0, 0]), atol=1e-15
    )


def test_cells_have_the_tensor_with_the_longest_side_first() -> None:
    axes = np.stack([local(0.3), np.eye(3)])
    tensors = structure_tensor(np.sqrt([[0.2, 0.7, 0.1], [1 / 3, 1 / 3, 1 / 3]]), axes)
    lengths, found = cells_from_tensors(tensors, 2.0, axes)
    np.testing.assert_allclose(lengths[0], 2.0 * np.sqrt([0.7, 0.2, 0.1]), rtol=1e-12)
    np.testing.assert_allclose(structure_tensor(lengths, found), 4.0 * tensors, atol=1e-12)
    np.testing.assert_allclose(
        found[1], axes[1], atol=1e-12
    )  # no direction is its own: those of before


# ---------------------------------------------------------------- runs


def test_a_run_keeps_the_file_and_goes_on_with_it(
    exported: Callable[[str], Path], tmp_path: Path
) -> None:
    """Stopped, moved to another folder, without the file that it began with; another file is refused."""
    (tmp_path / "in").mkdir()
    shutil.copy(exported("vtu"), tmp_path / "in" / "measured.vtu")
    (tmp_path / "in" / "scene.toml").write_text(scene("measured.vtu").to_toml())
    one = read_scene(tmp_path / "in" / "scene.toml")
    whole = run(one, tmp_path / "whole")
    half = run(one.with_values({"time.end": 1.0}), tmp_path / "half")
    digest = hashlib.sha256((tmp_path / "in" / "measured.vtu").read_bytes()).hexdigest()
    said = f"cells.fibres: structure_tensor read from 32 rows by number; SHA-256 {digest}"
    assert said in (half / "run.log").read_text()
    shutil.rmtree(tmp_path / "in")
    half = Path(shutil.move(half, tmp_path / "moved"))
    kept = half / "fibres.vtu"
    assert (read_scene(half / "scene.toml").cells.fibres, read_scene(half / "scene.toml").cells.fibres_sha256) == (
        str(kept), digest)  # fmt: skip
    data = kept.read_bytes()
    kept.write_bytes(data.replace(b"axis_3", b"axis_4"))
    for use in (
        lambda: resume(half, ["time.end=2.0"]),
        lambda: Simulation(read_scene(half / "scene.toml")),
    ):
        with pytest.raises(
            SceneError, match=r"^cells.fibres = .*fibres.vtu': has changed: its SHA-256 was "
        ):
            use()
    kept.write_bytes(data)
    resume(half, ["time.end=2.0"])
    mine, others = half / "scene.toml", whole / "scene.toml"
    assert mine.read_text().replace("end = 2.0", "") == others.read_text().replace("end = 2.0", "")
    again, once = (
        np.loadtxt(folder / "history.csv", delimiter=",", skiprows=1, usecols=range(5))
        for folder in (half, whole)
    )
    np.testing.assert_array_equal(again, once)


@pytest.mark.parametrize("moment", ["before it is read", "before it is kept"])
def test_what_is_kept_is_what_was_read(
    moment: str, exported: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file that is replaced meanwhile: the run does not begin."""
    path = tmp_path / "measured.vtu"
    shutil.copy(exported("vtu"), path)
    built = running.Simulation

    def replaced(*arguments: Any) -> Any:
        simulation = built(*arguments) if moment == "before it is kept" else None
        path.write_bytes(path.read_bytes() + b" ")
        return simulation or built(*arguments)

    monkeypatch.setattr(running, "Simulation", replaced)
    with pytest.raises(
        SceneError, match=r"^cells.fibres = .*measured.vtu': has changed: its SHA-256 was "
    ):
        run(scene(str(path)).with_values({"time.end": 1.0}), tmp_path / "run")


OF_A_FILE = TUBE | {"cells": {"fibres": str(Path(__file__).parent / "files" / "fibres.csv")}}
ON_ONE_AND_TWO_RANKS = [
    {"scene": OF_A_FILE | {"solver": {"method": "direct"}}, "divisions": [8, 4, 1]}
]


def test_one_and_two_ranks_have_the_same(both_ranks: Any) -> None:
    """Each element another angle."""
    ((one, two),) = both_ranks
    assert np.ptp(one["n"][:, 0, 0], axis=0).max() > 0.4
    assert_close(two, one, ("n", "inner_radius", *ANGLES), atol=1e-9)


def test_angles_of_a_sheet_are_measured_from_x() -> None:
    of: dict[str, Any] = {"geometry": {"shape": "sheet"}, "remodeling": {"law": "none"}}
    file = Path(__file__).parent / "files" / "sheet.csv"
    row = last_row(Scene(**of, cells={"fibres": str(file)}, time={"end": 1.0, "step": 1.0}))
    assert row["fibre_angle"] == pytest.approx(30.0)


def test_a_region_has_a_file_of_its_own(tmp_path: Path) -> None:
    rows = [{"element": n, "angle": 30.0} for n in range(1, 33)]
    path = table(tmp_path / "angle.csv", rows)
    regions = {"media": {"outer_radius": 2.0, "cells": {"fibres": str(path)}}, "adventitia": {}}
    with made(
        Scene(**TUBE | {"cells": {"initial": "isotropic"}, "regions": regions})
    ) as simulation:
        inside = simulation.domain.element_region == simulation.domain.regions["media"]
        lengths, axes = simulation.cells.dimension_values, simulation.cells.axis_values
        np.testing.assert_allclose(lengths[inside] - [1.0, 0.0, 0.0], 0.0, atol=1e-7)
        np.testing.assert_allclose(np.abs(axes[inside][..., 0, 2]), 0.5, atol=1e-12)
        np.testing.assert_allclose(lengths[~inside], np.sqrt(1 / 3), atol=1e-12)


# ---------------------------------------------------------------- what is refused


@pytest.mark.parametrize(("name", "text", "row", "often", "said"), rows(__file__, "bad_fibres.txt"))
def test_a_bad_file_is_said_in_one_line(
    name: str, text: str, row: str, often: str, said: str, tmp_path: Path
) -> None:
    if text != "-":
        (tmp_path / name).write_bytes(unescaped(text + int(often) * row).encode("latin-1"))
    with pytest.raises(SceneError, match=rf"^cells.fibres = '.*{name}': .*{said}") as error:
        Simulation(scene(tmp_path / name), SELF)
    assert "\n" not in str(error.value)


def test_the_presets_random_cells_lie_under_a_file() -> None:
    preset = Scene(
        preset="kuhl-holzapfel-2007", geometry={"shape": "tube"}, cells={"fibres": "a.csv"}
    )
    assert preset.cells.initial == "fibres"
