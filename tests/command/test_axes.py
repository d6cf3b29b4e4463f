"""`remodel-fenicsx axes` and the fields that do not change: what readers of others find in them."""

from __future__ import annotations

from pathlib import Path

import h5py
import meshio
import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx import Recording, Scene, cli, run
from remodel_fenicsx.results.whole_body import BODY, revolve
from remodel_fenicsx.schema.settings import CONSTANT_FIELDS
from tests.conftest import Refused
from tests.values import assert_close, isotropic, ramped

AXES = ("axis_c", "axis_a", "axis_r")


def scene(kinematics: str = "full", **output: object) -> Scene:
    """A short tube, hardly loaded."""
    loads, shape = ramped(2.0, pressure=0.5, elongation=0.02), {"shape": "tube", "length": 2.0}
    own = {
        "name": "short",
        "geometry": shape,
        "loads": loads,
        "time": {"end": 2.0},
        "output": output,
    }
    return Scene(**isotropic(kinematics=kinematics, **own))


def check_cylindrical(fields: dict[str, np.ndarray], centres: np.ndarray, atol: float) -> None:
    """Directions of a tube about z at the middles of its elements."""
    radial = centres * [1.0, 1.0, 0.0] / np.hypot(centres[:, 0], centres[:, 1])[:, None]
    axial = np.broadcast_to([0.0, 0.0, 1.0], radial.shape)
    for name, expected in zip(AXES, (np.cross(axial, radial), axial, radial), strict=True):
        np.testing.assert_allclose(fields[name], expected, atol=atol, err_msg=name)


def test_the_file_of_the_command(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    refused: Refused,
) -> None:
    """Read by meshio; a file that is there stays, and the default name is the scene's."""
    monkeypatch.chdir(tmp_path)
    Path("short.toml").write_text(scene().to_toml())
    assert cli.main(["axes", "short.toml", "-o", "found.vtu"]) == 0
    assert capsys.readouterr().out.splitlines() == ["1536 elements", "local axes in found.vtu"]
    grid = meshio.read("found.vtu")
    fields = {name: values[0] for name, values in grid.cell_data.items()}
    assert set(fields) == {*CONSTANT_FIELDS, "region"}
    centres = grid.points[grid.cells[0].data].mean(axis=1)
    check_cylindrical(fields, centres, 1e-12)
    np.testing.assert_allclose(fields["station"], centres[:, 2] / 2.0, atol=1e-12)
    assert np.unique(np.round(fields["depth"], 9)).size == 8 and 0.0 < fields["depth"].min()
    before = Path("found.vtu").read_bytes()
    assert "found.vtu: already exists; must be a new file" in refused(
        "axes", "short.toml", "-o", "found.vtu"
    )
    assert Path("found.vtu").read_bytes() == before
    assert cli.main(["axes", "short.toml"]) == 0 and Path("short-axes.vtu").read_bytes() == before


def test_constant_fields_stand_in_the_file_once_and_belong_to_every_time(tmp_path: Path) -> None:
    folder = run(scene(fields=["fibre_angle", *CONSTANT_FIELDS]), tmp_path / "run", MPI.COMM_SELF)
    recording = Recording(folder)
    first, last = (recording.fields(time) for time in (0.0, 2.0))
    assert set(first) == {"fibre_angle", *CONSTANT_FIELDS}
    assert_close(last, first, CONSTANT_FIELDS, atol=0.0)
    check_cylindrical(first, recording.points[recording.elements].mean(axis=1), 1e-6)
    with h5py.File(folder / "fields.vtkhdf") as file:
        assert (
            len(file["VTKHDF/CellData/axis_c"]) == 1536
            and len(file["VTKHDF/CellData/fibre_angle"]) == 3 * 1536
        )


def test_local_axes_of_a_sector_turn_with_it(tmp_path: Path) -> None:
    names = ["displacement", "deformation_gradient", *CONSTANT_FIELDS]
    folder = run(scene("sector", fields=names), tmp_path / "run", MPI.COMM_SELF)
    assert revolve(folder) == [folder / BODY]
    with h5py.File(folder / BODY) as file:
        root = file["VTKHDF"]
        number = int(root["NumberOfCells"][0])
        fields = {name: root["CellData"][name][:number] for name in CONSTANT_FIELDS}
        places = root["Points"][: int(root["NumberOfPoints"][0])][
            root["Connectivity"][:].reshape(number, -1)
        ]
    # mirrored axes: a direction is one up to its sign
    centres = places.mean(axis=1)
    signs = np.sign(centres[:, 0] * centres[:, 1])[:, None]
    check_cylindrical(fields | {"axis_c": signs * fields["axis_c"]}, centres, 0.01)
