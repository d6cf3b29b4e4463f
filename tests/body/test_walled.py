"""A straight tube as a body whose local axes are found on its mesh: the rows and pictures of the tube."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import pytest
from mpi4py import MPI
from pydantic import Field

from remodel_fenicsx import Recording, Scene, SceneError, run
from remodel_fenicsx.body import SHAPES, LoadKind, Tube
from remodel_fenicsx.body.domain import Domain
from remodel_fenicsx.body.tube import whole_tube
from remodel_fenicsx.body.mesh_body import WalledMesh
from remodel_fenicsx.results.whole_body import WholeBody
from remodel_fenicsx.schema.settings import CONSTANT_FIELDS
from remodel_fenicsx.simulation import Simulation
from tests import parts
from tests.mesh_files import NAMES
from tests.values import ANGLES, assert_close, isotropic, ramped

COUNTS = (8, 8, 2)


class WalledTube(WalledMesh):
    """The paper's tube, two long, that says nothing of its axes."""

    loads: ClassVar[dict[str, LoadKind]] = {
        name: Tube.loads[name] for name in ("pressure", "elongation")
    }
    number_of_elements: ClassVar[int] = 128
    face_names: ClassVar[tuple[str, ...]] = ("inner", "outer", "inlet", "outlet")

    shape: Literal["walled"] = Field(default="walled", description="Which body it is.")
    length: float = Field(default=2.0, description="Along z.")

    def build(self, mesh: Any, comm: Any = None) -> Domain:
        """The tube's mesh with other names."""
        tube = Tube(inner_radius=1.0, outer_radius=3.0, length=self.length)
        made = whole_tube(tube, COUNTS, mesh.element, mesh.degree, comm)
        return replace(
            made, faces={NAMES[face]: tag for face, tag in made.faces.items()}, shape="walled"
        )

    def hold(self, loading: Any) -> None:
        """As the tube."""
        loading.hold_face("inlet", 2)
        loading.hold_node((1.0, 0.0, 0.0), 1)
        loading.hold_node((-1.0, 0.0, 0.0), 1)
        loading.hold_node((0.0, 1.0, 0.0), 0)

    def support(self, loading: Any, ends: str = "free", loads: Any = None) -> None:
        """As the tube."""
        self.hold(loading)
        loading.add_follower_pressure("pressure", "inner")
        loading.add_prescribed_elongation("elongation", "outlet", 2, self.length)


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The shape, for a test."""
    monkeypatch.setitem(SHAPES, "walled", WalledTube)
    yield


def scene(shape: str, end: float = 3.0, **tables: Any) -> Scene:
    """Pressed and pulled, with isotropic cells."""
    radii = {"inner_radius": 1.0, "outer_radius": 3.0} if shape == "tube" else {}
    values = {
        "geometry": {"shape": shape, "length": 2.0, **radii},
        "loads": ramped(2.0, pressure=2.0, elongation=0.1),
    }
    values |= {"time": {"end": end}, "solver": {"method": "direct"}, "output": {}}
    return Scene(**isotropic(None, "full", **values | tables))


def test_rows_are_those_of_the_tube() -> None:
    """Columns, profile and axes of the cells; the tube's own mesh, so that nothing else differs."""
    output = {"columns": [*ANGLES, "radial_share", "angle_profile_3"]}
    found = Simulation(scene("walled", output=output), MPI.COMM_SELF)
    mesh = parts.tube(length=2.0, divisions=COUNTS, comm=MPI.COMM_SELF)
    expected = Simulation(scene("tube", output=output), MPI.COMM_SELF, mesh)
    assert found.scene.cells.axes == "local" and expected.scene.cells.axes == "cylindrical"
    np.testing.assert_allclose(found.cells.axis_values, expected.cells.axis_values, atol=1e-9)
    for one, other in zip(found.steps(), expected.steps(), strict=True):
        assert_close(one.row, other.row, (*ANGLES, "radial_share"), atol=1e-6)
        # at points between plane faces the tube's depth is that of the place, here a share of the way
        assert one.row["angle_profile_3"] == pytest.approx(other.row["angle_profile_3"], abs=1.0)
    assert abs(one.row["fibre_angle_inner"] - one.row["fibre_angle_outer"]) > 1.0


def test_columns_of_tetrahedra_have_elements_in_every_mesh() -> None:
    simulation = Simulation(scene("walled", 1.0, mesh={"element": "tetrahedron"}), MPI.COMM_SELF)
    (row, *_) = [step.row for step in simulation.steps()]
    assert all(np.isfinite(row[name]) for name in ANGLES)


def test_recorded_fields_and_layers_of_pictures(tmp_path: Path) -> None:
    """Local axes without being asked for, and a picture that knows the layers by the recorded depth."""
    recording = Recording(
        run(scene("walled", 1.0, output={"fields": True}), tmp_path / "run", MPI.COMM_SELF)
    )
    fields = recording.fields(1.0)
    assert {*CONSTANT_FIELDS} <= set(fields)
    body = WholeBody(recording)
    assert len(body.depth) == 8 and np.all(np.bincount(body.layer) == 16)
    np.testing.assert_allclose(body.depth, (np.arange(8) + 0.5) / 8, atol=0.01)


def test_a_missing_end_is_refused() -> None:
    whole = WalledTube().build(scene("walled").mesh, MPI.COMM_SELF)
    faces = {name: tag for name, tag in whole.faces.items() if name != "outlet"}
    walled = replace(whole, faces=faces)
    with pytest.raises(SceneError, match="^geometry.faces: the local axes need a face 'outlet'$"):
        WalledTube().local_axes(
            walled, Simulation(scene("walled"), MPI.COMM_SELF, whole).quadrature
        )
