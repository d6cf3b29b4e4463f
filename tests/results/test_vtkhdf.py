"""VTKHDF files: what VTK's own reader finds in them, also after a crash, a full disk or Ctrl-C."""

from __future__ import annotations

import errno
import resource
import shutil
from pathlib import Path

import basix
import h5py
import numpy as np
import pytest

from remodel_fenicsx.results.whole_body import chain_displacement, chain_lines
from remodel_fenicsx.results.vtkhdf import DeferredErrorFile, TransientGrid, vtk_cells
from tests.forks import forked

# In a process of its own, as users do. Steps are read forwards and backwards: VTK keeps the meshes of earlier steps.
READER = """
import sys
import numpy as np, pyvista
found = {}
reader = pyvista.HDFReader(sys.argv[1])
reader.reader.UpdateInformation()
steps = reader.reader.GetNumberOfSteps()
for turn, order in enumerate((range(steps), reversed(range(steps)))):
    for step in order:
        reader.reader.SetStep(step)
        grid = reader.read()
        here = {"points": grid.points, "cells": grid.cell_connectivity, "types": grid.celltypes}
        here |= {"point " + name: grid.point_data[name] for name in grid.point_data.keys()}
        here |= {"cell " + name: grid.cell_data[name] for name in grid.cell_data.keys()}
        here["time"] = grid.field_data["Time"][0] if "Time" in grid.field_data.keys() else np.nan
        here["volumes"] = grid.compute_cell_sizes(length=False, area=False)["Volume"]
        here["parametric"] = np.array(grid.GetCell(0).GetParametricCoords()[: 3 * grid.GetCell(0).GetNumberOfPoints()])
        for name, values in here.items():
            key = f"{step} {name}"
            assert turn == 0 or np.array_equal(found[key], values, equal_nan=True), key
            found[key] = np.array(values)
np.savez(sys.argv[2], steps=steps, **found)
"""

CUBE = np.array(
    [[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=float
)  # dolfinx's order of nodes
VTK_CUBE = [[0, 1, 3, 2, 4, 5, 7, 6]]


def read(path: Path) -> dict[str, np.ndarray]:
    """What PyVista finds: "STEP NAME" -> array, and "steps"."""
    target = path.with_suffix(".npz")
    done = forked("python", READER, path, target, imports=("pyvista",))
    assert done.returncode == 0, done.stderr
    assert "rror" not in done.stderr, done.stderr  # VTK reports errors there and goes on
    return dict(np.load(target))


def raw_series(path: Path, field: str, points: int) -> list[np.ndarray]:
    """A point field of every step that the file declares, read by its offsets."""
    with h5py.File(path) as file:
        root = file["VTKHDF"]
        steps = int(root["Steps"].attrs["NSteps"])
        offsets = root["Steps/PointDataOffsets"][field][:steps] if steps else []
        return [root["PointData"][field][start : start + points] for start in offsets]


def test_reader_finds_every_step(tmp_path):
    random = np.random.default_rng(1)
    points = random.random((9, 3))
    cells = np.array([[0, 1, 2, 3, 4, 5, 6, 7], [1, 2, 3, 4, 5, 6, 7, 8]])
    of_points, of_cells = {"displacement": (9, 3), "pressure": (9,)}, {
        "stress": (2, 9),
        "l": (2, 3),
    }
    steps = [
        [{name: random.random(shape) for name, shape in of.items()} for of in (of_points, of_cells)]
        for _ in "abc"
    ]
    path = tmp_path / "fields.vtkhdf"
    with TransientGrid(path, points, cells, 12) as grid:
        for k, (point_data, cell_data) in enumerate(steps):
            grid.append(0.5 * k, point_data, cell_data)
        grid.close()
        grid.append(9.0, *steps[0])
        found = read(path)  # while the writer goes on
    assert found["steps"] == 3
    for k, (point_data, cell_data) in enumerate(steps):
        assert found[f"{k} time"] == 0.5 * k
        assert (
            np.array_equal(found[f"{k} points"], points)
            and found[f"{k} points"].dtype == np.float64
        )
        assert np.array_equal(found[f"{k} cells"], cells.ravel())
        for kind, data in (("point", point_data), ("cell", cell_data)):
            for name, values in data.items():
                assert np.array_equal(found[f"{k} {kind} {name}"], values.astype(np.float32))


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("cell", ["hexahedron", "tetrahedron"])
def test_node_order_is_that_of_vtk(tmp_path, cell, degree):
    # the reference cell of dolfinx, permuted, must have VTK's own parametric coordinates of that cell, node by node
    element = basix.create_element(
        basix.ElementFamily.P, basix.CellType[cell], degree, basix.LagrangeVariant.equispaced
    )
    cell_type, cells = vtk_cells(cell, degree, np.arange(len(element.points))[None])
    assert cell_type == {"hexahedron": (12, 72), "tetrahedron": (10, 71)}[cell][degree > 1]
    with TransientGrid(tmp_path / "f.vtkhdf", element.points, cells, cell_type) as grid:
        grid.append(0.0)
    found = read(grid.path)
    assert np.allclose(found["0 parametric"].reshape(-1, 3), element.points[cells[0]], atol=1e-12)
    assert found["0 types"].tolist() == [cell_type]
    assert found["0 volumes"] == pytest.approx(
        [{"hexahedron": 1.0, "tetrahedron": 1 / 6}[cell]], rel=1e-6
    )


def random_cells(m: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(3)
    axes = np.linalg.qr(random.standard_normal((m, 3, 3)))[0]
    return random.random((m, 3)), random.random((m, 3)), axes


def test_chain_lines_are_the_diagonals_of_the_cell():
    centres, lengths, axes = random_cells(5)
    points, lines = chain_lines(centres, lengths, axes, scale=0.1)
    assert points.shape == (40, 3) and lines.shape == (20, 2)
    first, second = points[lines[:, 0]], points[lines[:, 1]]
    assert np.allclose((first + second) / 2, np.repeat(centres, 4, axis=0), atol=1e-15)
    # in the axes of the cell every end is at (+-l_1, +-l_2, +-l_3), and all eight combinations occur
    local = np.einsum("mIi,mki->mkI", axes, points.reshape(5, 8, 3) - centres[:, None]) / 0.1
    assert np.allclose(np.abs(local), lengths[:, None], atol=1e-14)
    for signs in np.sign(local):
        assert len(np.unique(signs, axis=0)) == 8


def test_chain_displacement_is_that_of_the_body():
    centres, lengths, axes = random_cells(3)
    points, _ = chain_lines(centres, lengths, axes, 0.2)
    F = np.eye(3) + 0.3 * np.random.default_rng(4).standard_normal((3, 3))
    shift = np.array([1.0, 2.0, 3.0])
    moved = chain_displacement(
        points, centres, centres @ (F - np.eye(3)).T + shift, np.tile(F, (3, 1, 1))
    )
    assert np.allclose(points + moved, points @ F.T + shift, atol=1e-14)


def test_nothing_is_overwritten(tmp_path):
    path = tmp_path / "f.vtkhdf"
    path.write_text("mine")
    with pytest.raises(FileExistsError, match="File exists"):  # and not that it is a link
        TransientGrid(path, CUBE, VTK_CUBE, 12)
    assert path.read_text() == "mine"


def test_a_full_disk_raises_and_keeps_what_was_published(tmp_path):
    # a limit on the size of files stands for the full disk: the same error from the same system call
    path = tmp_path / "f.vtkhdf"
    field = np.random.default_rng(5).random((4, 8, 3)).astype(np.float32)
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    grid = TransientGrid(path, CUBE, VTK_CUBE, 12)
    grid.append(0.0, {"u": field[0]})
    grid.close()
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 20, old[1]))
    try:
        for k in (1, 2):  # an error again as long as there is no room
            with pytest.raises(OSError) as full:
                grid.append(k, {"u": field[k]})
            assert full.value.errno == errno.EFBIG
        with pytest.raises(OSError):
            grid.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)
    grid.close()
    assert np.array_equal(raw_series(path, "u", 8), field[:1])
    assert [found.name for found in tmp_path.iterdir()] == ["f.vtkhdf"]


def test_a_file_that_is_continued_without_a_step_ends_at_its_time(tmp_path):
    path = tmp_path / "f.vtkhdf"
    with TransientGrid(path, CUBE, VTK_CUBE, 12) as grid:
        for time in range(3):
            grid.append(time, {"u": CUBE})
    TransientGrid.continued(path, 1.0).close()
    assert len(raw_series(path, "u", 8)) == 2


@pytest.mark.parametrize("steps", [1, 64])  # the index of HDF5 grows a level at 64 chunks
def test_a_process_that_is_killed_leaves_what_was_published(tmp_path, monkeypatch, steps):
    path, copies, write = tmp_path / "f.vtkhdf", [], DeferredErrorFile.write

    def look(*arguments):
        copies.append(shutil.copy(path, tmp_path / f"{len(copies)}.copy"))
        return write(*arguments)

    def append(grid, first, last, sign=1):
        for k in range(first, last):
            grid.append(k, {"u": np.full(8, sign * k)}, points=CUBE + sign * k)

    grid = TransientGrid(path, CUBE, VTK_CUBE, 12)
    append(grid, 0, steps)
    grid.close()
    monkeypatch.setattr(DeferredErrorFile, "write", look)
    append(grid, steps, steps + 1)
    grid.close()
    append(grid, steps + 1, steps + 2)
    grid.close()
    monkeypatch.undo()
    counts = [len(raw_series(copy, "u", 8)) for copy in copies]
    assert counts == sorted(counts) and set(counts) == {steps, steps + 1}
    for copy, count in [*zip(copies, counts, strict=True)][:: len(copies) // 5]:
        with TransientGrid.continued(Path(copy), count - 1.5) as grid:  # without the last one
            append(grid, count - 1, steps + 3, sign=-1)
        expected = [*range(count - 1), *(-k for k in range(count - 1, steps + 3))]
        assert [values[0] for values in raw_series(copy, "u", 8)] == expected
        with h5py.File(copy) as file:
            moved = file["VTKHDF/Points"][:].reshape(-1, 8, 3)[1:] - CUBE
        assert moved[:, 0, 0].tolist() == expected


def test_who_reads_a_file_keeps_it(tmp_path):
    """A file that is read is not written on."""
    path = tmp_path / "f.vtkhdf"
    with TransientGrid(path, CUBE, VTK_CUBE, 12) as grid:
        for k in range(20):
            grid.append(k, {"u": np.full(8, k)}, constant={"depth": [0.5]})
            grid.close()
            assert len(raw_series(path, "u", 8)) == k + 1
        with h5py.File(path) as file, path.open("rb") as opened:
            data = opened.read()
            for k in range(20, 23):
                grid.append(k, {"u": np.full(8, k)}, constant={"depth": [0.5]})
                grid.close()
            assert int(file["VTKHDF/Steps"].attrs["NSteps"]) == 20
            opened.seek(0)
            assert opened.read() == data
        assert len(raw_series(path, "u", 8)) == 23
    with h5py.File(path) as file:
        assert file["VTKHDF/CellData/depth"].shape == (1,)
    assert [found.name for found in tmp_path.iterdir()] == ["f.vtkhdf"]
