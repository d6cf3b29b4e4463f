"""What `export` writes of a wall with prestretch and turnover begins another run, which is the same."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest

from remodel_fenicsx import Recording, Scene, SceneError, run
from remodel_fenicsx.results.export import export
from tests.mesh_files import write_tube
from tests.runs import SELF, made
from tests.values import ramped

LAYERS = [
    {"from": 0.0, "to": 0.5, "prestretch": {"axial": 1.05}},
    {"from": 0.5, "prestretch": {"circumferential": 1.1}},
]
TURNOVER = {"time": 10.0, "deposition_stretch": 1.1, "gain": 1.0, "volume": 0.0}
COLUMNS = ("lumen_volume", "fibre_angle_inner", "content", "natural_length", "stored_energy")
WITH_GROWTH, LONG = {"columns": [*COLUMNS, "growth"], "report": False}, {"end": 20.0, "step": 2.0}


def scene(vessel: Path, end: float, loaded: float = 2.0, **tables: Any) -> Scene:
    """A tube of tetrahedra, which have one F each, with two layers that were stretched; all its loads by a time."""
    values: dict[str, Any] = {
        "geometry": {"shape": "mesh", "file": str(vessel)}, "cells": {"initial": "isotropic"},
        "natural": {"layers": LAYERS}, "loads": ramped(loaded, pressure=0.5, elongation=0.05),
        "remodeling": {"law": "tensor", "coupling": "staggered", "turnover": TURNOVER},
        "output": {"columns": [*COLUMNS], "report": False}, "time": {"end": end},
        "solver": {"method": "direct", "relative_tolerance": 1e-10},
    }  # fmt: skip
    return Scene(**values | tables)


def grown(**turnover: Any) -> dict[str, Any]:
    """The table of remodeling with a wall that grows."""
    return {
        "law": "tensor",
        "coupling": "staggered",
        "turnover": TURNOVER | {"volume": 0.6} | turnover,
    }


def again(vessel: Path, file: Path, end: float, loaded: float = 1.0, **tables: Any) -> Scene:
    """The scene that begins with an exported file, all loads in its first step."""
    values: dict[str, Any] = {"cells": {"fibres": str(file)}, "natural": {"fibres": True}}
    return scene(vessel, end, loaded, **values | tables)


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A mesh, and the first run on it."""
    folder = tmp_path_factory.mktemp("again")
    mesh = write_tube(folder / "tube.msh", "tetrahedron")
    return mesh, run(scene(mesh, 3.0), folder / "run", SELF)


def test_a_file_exported_and_read_again_gives_the_same_run(
    first: tuple[Path, Path], tmp_path: Path
) -> None:
    """As the first one, but for means over elements; of these, to the digits of the file, from whatever time."""
    mesh, started = first
    file = export(started, "vtu", tmp_path / "first.vtu", 2.0)
    second = run(again(mesh, file, 5.0), tmp_path / "second", SELF)
    third = run(
        again(mesh, export(second, "vtu", tmp_path / "second.vtu", 3.0), 3.0),
        tmp_path / "third",
        SELF,
    )
    original, read, twice = (Recording(folder).history for folder in (started, second, third))
    for name in COLUMNS:
        np.testing.assert_allclose(read[name][1:3], original[name][2:4], rtol=2e-3, err_msg=name)
        np.testing.assert_allclose(twice[name][1:], read[name][3:], rtol=2e-6, err_msg=name)
    assert read["content"][0] == pytest.approx(original["content"][2], rel=1e-6) != 1.0
    assert (
        read["natural_length"][0] == pytest.approx(original["natural_length"][2], rel=1e-6) != 1.0
    )


def test_means_of_hexahedra_are_said_where_they_are_written(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """With how much elements differ from each other."""
    mesh = write_tube(tmp_path / "tube.msh", "hexahedron", counts=(8, 3, 1))
    export(run(scene(mesh, 6.0), tmp_path / "run", SELF), "vtu", tmp_path / "cells.vtu")
    (written,) = re.findall(r"up to ([\d.]+) % of tr A", caplog.text)
    assert 0.5 < float(written) < 30.0


def test_it_goes_on_as_itself(first: tuple[Path, Path], tmp_path: Path) -> None:
    """Resumed from its own copy of the file, to the last digit."""
    from tests.runs import goes_on

    mesh, started = first
    goes_on(
        again(mesh, export(started, "vtu", tmp_path / "first.vtu", 2.0), 3.0), tmp_path, 2.0, 3.0
    )


def test_the_arrays_are_those_of_the_wall(first: tuple[Path, Path], tmp_path: Path) -> None:
    """G of the layers in VTU and FEBio, of the whole element; what has no place for it is said."""
    mesh, started = first
    written = meshio.read(export(started, "vtu", tmp_path / "a.vtu"))
    G = written.cell_data["natural_gradient"][0].reshape(-1, 3, 3)
    with made(scene(mesh, 3.0)) as simulation:
        domain, own = simulation.domain, simulation.state.natural_gradient.mean(axis=1)  # type: ignore[union-attr]
        np.testing.assert_allclose(G, domain.gather_elements(own), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(G), 1.0, atol=1e-2)
    (data,) = ElementTree.parse(export(started, "febio", tmp_path / "a.feb")).iterfind(
        ".//*[@name='natural_gradient']"
    )
    rows = [[float(word) for word in (entry.text or "").split(",")] for entry in data]
    assert data.get("data_type") == "mat3"
    np.testing.assert_allclose(np.reshape(rows, (-1, 3, 3)), G)


@pytest.fixture(scope="module")
def began(first: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of a body that grows from a time."""
    of = scene(first[0], 20.0, output=WITH_GROWTH, time=LONG, remodeling=grown(**{"from": 4.0}))
    return run(of, tmp_path_factory.mktemp("grown") / "run", SELF)


def test_what_has_grown_is_written_as_it_is(began: Path, tmp_path: Path) -> None:
    """G of each time: its determinant falls as the wall grows."""
    times = (0.0, 4.0, 20.0)
    ends = [
        meshio.read(export(began, "vtu", tmp_path / f"{time:g}.vtu", time)).cell_data
        for time in times
    ]
    volumes = [1 / np.linalg.det(data["natural_gradient"][0].reshape(-1, 3, 3)) for data in ends]
    np.testing.assert_allclose(volumes[1], volumes[0], atol=1e-6)
    content = ends[2]["content"][0] / ends[1]["content"][0]
    np.testing.assert_allclose(volumes[2] / volumes[0], 1 + 0.6 * (content - 1), rtol=1e-5)
    assert np.abs(volumes[2] / volumes[0] - 1).max() > 0.02


def test_a_body_that_grew_from_a_time_goes_on(
    first: tuple[Path, Path], began: Path, tmp_path: Path
) -> None:
    """The file has J_g beside content and G, so that nothing need know when growth began."""
    file = export(began, "vtu", tmp_path / "a.vtu", 18.0)
    of = again(
        first[0], file, 4.0, 2.0, output=WITH_GROWTH, time=LONG | {"end": 4.0}, remodeling=grown()
    )
    original, read = (
        Recording(folder).history for folder in (began, run(of, tmp_path / "second", SELF))
    )
    assert (
        read["growth"][0] == pytest.approx(original["growth"][-2], rel=1e-6)
        and read["growth"][0] < 0.9
    )
    for name in (*COLUMNS, "growth"):
        np.testing.assert_allclose(read[name][1:], original[name][-2:], rtol=2e-6, err_msg=name)
    for turnover, line in (
        ({"volume": 0.0}, "volume must be above"),
        ({"from": 1.0}, "from must be 0"),
    ):
        refused = again(first[0], file, 1.0, remodeling=grown(**turnover), output={})
        with pytest.raises(
            SceneError, match=f"^cells.fibres = .*: has growth of .*remodeling.turnover.{line}"
        ):
            with made(refused):
                pass


def test_what_has_no_place_is_said(
    first: tuple[Path, Path], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    export(first[1], "csv", tmp_path / "a.csv")
    assert (
        "csv has no place for natural_gradient, content, natural_length; vtu and febio files have"
        in caplog.text
    )


def test_what_is_refused(first: tuple[Path, Path], tmp_path: Path) -> None:
    mesh, started = first
    file = export(started, "vtu", tmp_path / "a.vtu")
    still = {"law": "tensor", "coupling": "staggered"}
    for changed, line in (
        (
            again(mesh, file, 1.0, natural={}),
            "cells.fibres = .*: has natural_gradient, content, natural_length of an",
        ),
        (
            again(mesh, file, 1.0, remodeling=still, output={}),
            "cells.fibres = .*: has content and natural_length, wh",
        ),
    ):
        with pytest.raises(SceneError, match=f"^{line}"), made(changed):
            pass
    for keys, line in (
        ({"cells": {"initial": "isotropic"}}, "natural.fibres = true: needs cells.fibres"),
        (
            {"natural": {"fibres": True, "layers": LAYERS}},
            "natural.fibres = true: natural.opening_angle or natural.layers is",
        ),
    ):
        with pytest.raises(SceneError, match=f"^{line}"):
            again(mesh, file, 1.0, **keys)  # type: ignore[arg-type]
    plain = {"natural": {"fibres": False}, "remodeling": {"law": "none"}, "output": {}}
    with made(again(mesh, file, 1.0, **plain)) as simulation:
        assert simulation.state.natural_gradient is None
