"""What is recorded of a step: which steps have fields, to which cells they belong, and what the fields are."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx.body import SHAPES
from remodel_fenicsx.body.shape import Shape
from remodel_fenicsx.evolution.stepper import Step
from remodel_fenicsx.model.cells import cylindrical_axes, structure_tensor
from remodel_fenicsx.results.fields import ElementFields, Fields
from remodel_fenicsx.scene.scene import scene_from_dict
from remodel_fenicsx.schema.settings import Cells
from remodel_fenicsx.simulation import Simulation
from tests import parts
from tests.parts import tube

SIZE = {"inner_radius": 1.0, "outer_radius": 3.0, "length": 1.0}


# ---------------------------------------------------------------- which steps
def recorded(
    folder: Path, end: float, every: int
) -> tuple[dict[float, float], dict[float, Step], Simulation]:
    """Fibre angle of the paper's cube in the fields by time, the steps by time, and the simulation at the end."""
    scene = scene_from_dict(
        {
            "preset": "kuhl-holzapfel-2007",
            "geometry": {"shape": "cube"},
            "time": {"end": end, "step": 1.0},
        }
    )
    simulation = Simulation(scene, MPI.COMM_SELF)
    with Fields(folder, scene.geometry, simulation.stepper, every) as fields:
        steps = {step.time: step for step in simulation.steps([fields])}
    with h5py.File(folder / "fields.vtkhdf") as file:
        offsets = file["VTKHDF/Steps/CellDataOffsets/fibre_angle"][:]
        angles = file["VTKHDF/CellData/fibre_angle"][:][offsets]
        times = file["VTKHDF/Steps/Values"][:]
        return dict(zip(times.tolist(), angles.tolist(), strict=True)), steps, simulation


@pytest.mark.parametrize(("end", "times"), [(3.0, [0.0, 2.0, 3.0]), (4.0, [0.0, 2.0, 4.0])])
def test_every_second_step_the_first_and_the_last_have_fields(
    end: float, times: list[float], tmp_path: Path
) -> None:
    fields, steps, _ = recorded(tmp_path, end, every=2)
    assert list(fields) == times
    assert list(steps) == [float(k) for k in range(1, int(end) + 1)]


def test_fields_and_row_belong_to_the_cells_before_the_pass(tmp_path: Path) -> None:
    """The first step is solved with the isotropic cells of the start; the pass then turns them towards the load."""
    isotropic = np.degrees(np.arctan(np.sqrt(2.0)))
    fields, steps, simulation = recorded(tmp_path, 3.0, every=1)
    rows = {time: step.row["mean_fibre_angle"] for time, step in steps.items()}
    assert rows[1.0] == pytest.approx(isotropic, abs=1e-9)
    assert rows[3.0] < rows[2.0] < isotropic - 0.5
    for time, angle in rows.items():
        assert fields[time] == pytest.approx(angle, rel=1e-6)  # fields have seven digits
    cells = simulation.cells
    now = simulation.scene.geometry.fibre_angle(
        cells.dimension_values, cells.axis_values, cells.local_axes.axes
    )
    assert now.max() < rows[3.0] - 0.5


def test_what_the_pass_tells_comes_into_the_row_after_it(tmp_path: Path) -> None:
    """And the loads are those of the scene: 10 on a ramp of 10."""
    _, steps, _ = recorded(tmp_path, 3.0, every=1)
    for time, step in steps.items():
        assert step.row["remodeling_power"] == step.remodeling_power > 0.0
        assert step.row["seconds"] == step.seconds > 0.0
        assert step.row["force"] == pytest.approx(time, rel=1e-14)


# ---------------------------------------------------------------- what they are
@pytest.fixture
def wall() -> tuple[parts.Body, ElementFields]:
    """A short tube whose cells are random helices in its wall, with some radial chains."""
    made = parts.body(
        tube(**SIZE, divisions=(8, 2, 1), comm=MPI.COMM_SELF), Cells(axes="cylindrical")
    ).supported()
    lengths = np.random.default_rng(1).uniform(0.3, 0.8, made.cells.dimension_values.shape)
    made.cells.set(lengths, cylindrical_axes(made.quadrature.coordinates))
    shape: Shape = SHAPES["tube"](shape="tube", **SIZE)
    return made, ElementFields(shape, made.stepper(lambda t: {}))


def test_a_turn_about_the_tubes_axis_changes_no_fibre_angle(
    wall: tuple[parts.Body, ElementFields],
) -> None:
    """Deformed chains belong to the deformed place: what was circumferential is so after a turn."""
    made, fields = wall
    made.set_displacement(made.nodes @ parts.rotation((0.0, 0.0, 1.0), 70.0).T - made.nodes)
    found = fields()
    assert np.ptp(found["fibre_angle"]) > 1.0
    np.testing.assert_allclose(
        found["fibre_angle_deformed"], found["fibre_angle"], rtol=0, atol=1e-9
    )


def test_elongation_turns_deformed_chains_and_leaves_the_reference_angle(
    wall: tuple[parts.Body, ElementFields],
) -> None:
    made, fields = wall
    l, volumes = made.cells.dimension_values, made.quadrature.volumes  # noqa: E741
    made.set_displacement(made.nodes * [0.0, 0.0, 0.5])
    found = fields()
    for name, stretch in (("fibre_angle", 1.0), ("fibre_angle_deformed", 1.5)):
        expected = np.degrees(np.arctan2(stretch * l[..., 1], l[..., 0]))
        mean = (expected * volumes).sum(axis=1) / volumes.sum(axis=1)
        np.testing.assert_allclose(found[name], mean, rtol=1e-12, err_msg=name)


def test_chain_extension_is_the_largest_in_the_element(
    wall: tuple[parts.Body, ElementFields],
) -> None:
    made, fields = wall
    l = made.cells.dimension_values  # noqa: E741
    made.set_displacement(made.nodes * [0.1, 0.1, 0.5])
    length = np.sqrt((1.1 * l[..., 0]) ** 2 + (1.5 * l[..., 1]) ** 2 + (1.1 * l[..., 2]) ** 2)
    found = fields()
    np.testing.assert_allclose(
        found["chain_extension"], length.max(axis=1) / parts.MATERIAL.contour_length, rtol=1e-12
    )
    gradient = np.diag([1.1, 1.1, 1.5]).ravel()
    np.testing.assert_allclose(
        found["deformation_gradient"], np.tile(gradient, (len(length), 1)), atol=1e-13
    )


def test_the_cell_of_an_element_has_its_mean_structure_tensor(
    wall: tuple[parts.Body, ElementFields],
) -> None:
    made, fields = wall
    found = fields()
    lengths = found["cell_dimensions"]
    axes = np.stack([found[f"axis_{i}"] for i in (1, 2, 3)], axis=1)
    assert np.all(np.diff(lengths, axis=1) <= 0)
    weights = made.quadrature.volumes / made.quadrature.volumes.sum(axis=1, keepdims=True)
    mean = np.einsum("ep,epij->eij", weights, made.cells.structure_tensor())
    np.testing.assert_allclose(structure_tensor(lengths, axes), mean, atol=1e-13)
