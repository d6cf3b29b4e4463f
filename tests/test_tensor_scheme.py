"""The consistent variant on bodies: law `tensor`, repulsion `log`, the couplings `staggered` and `extrapolated`."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.body import Cube, LoadKind, tube
from remodel_fenicsx.evolution.blend import Blend
from remodel_fenicsx.scene.scene import SceneError, scene_from_dict
from remodel_fenicsx.schema.units import FORCE
from remodel_fenicsx.simulation import Simulation

Array = NDArray[np.float64]
KAPPA = 0.025


def scene(shape: str, **changes: Any) -> Any:
    values: dict[str, Any] = {
        "preset": "kuhl-holzapfel-2007",
        "geometry": {"shape": shape},
        "material": {"repulsion": "log"},
        "remodeling": {"law": "tensor", "frame": "material"} | changes.pop("remodeling", {}),
    }
    return scene_from_dict(values | changes)


def short_tube(end: float, step: float = 1.0, cells: str = "random", **remodeling: Any) -> Simulation:
    """One layer of elements along the axis, coarse."""
    settings = scene(
        "tube",
        geometry={"shape": "tube", "length": 1.0},
        cells={"initial": cells},
        time={"end": end, "step": step},
        remodeling=remodeling,
    )
    domain = tube(1.0, 3.0, 1.0, degree=1, divisions=(12, 3, 1), comm=MPI.COMM_SELF)
    return Simulation(settings, MPI.COMM_SELF, domain)


def run(simulation: Simulation) -> tuple[Array, Array, list[dict[str, float]]]:
    """Unknowns of each step, A at the end, rows."""
    rows, unknowns = [], []
    for step in simulation.steps():
        rows.append(step.row)
        unknowns.append(simulation.unknown.x.array.copy())
    return np.array(unknowns), simulation.cells.structure_tensor(), rows


@pytest.mark.parametrize("coupling, passes", [("staggered", 0), ("extrapolated", 1)])
@pytest.mark.parametrize("force", [0.01, 10.0])
def test_the_cubes_angle_is_the_closed_form(coupling: str, passes: int, force: float) -> None:
    """A_33 = r0^2 (1 - 2/3 exp(-kappa t)); the row of `staggered` is a pass behind."""
    settings = scene(
        "cube",
        remodeling={"coupling": coupling},
        loads={"force": {"value": force, "ramp": [[0.0, 0.0], [10.0, 1.0]]}},
        time={"end": 40.0},
    )
    simulation = Simulation(settings, MPI.COMM_SELF)
    _, A, rows = run(simulation)
    for number, row in enumerate(rows, start=1):
        left = 2 / 3 * np.exp(-KAPPA * (number - 1 + passes))
        assert row["mean_fibre_angle"] == pytest.approx(np.degrees(np.arctan(np.sqrt(left / (1 - left)))), abs=1e-9)
    np.testing.assert_allclose(np.trace(A, axis1=-2, axis2=-1), 1.0, atol=1e-13)
    assert np.abs(A - A[0, 0] * np.eye(3)).max() < 1e-12  # nothing turns


@pytest.mark.parametrize("coupling", ["staggered", "extrapolated"])
@pytest.mark.parametrize("driver", ["cauchy", "pk2", "finger"])
def test_loads_that_cross_leave_the_cube_homogeneous(
    driver: str, coupling: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Forces along x and z, of which first one is larger, then the other, equal in between."""

    def add_force(shape: Any, loading: Any, name: str) -> None:
        loading.add_dead_force(name, "x1", 0)

    monkeypatch.setitem(Cube.loads, "force_x", LoadKind(add_force, "dead force along x", FORCE))
    ramps = {"force": [[0, 0], [10, 1], [30, 0.2]], "force_x": [[0, 0], [10, 0.2], [30, 1]]}
    settings = scene(
        "cube",
        remodeling={"driver": driver, "coupling": coupling},
        loads={name: {"value": 10.0, "ramp": ramp} for name, ramp in ramps.items()},
        time={"end": 40.0},
    )
    simulation = Simulation(settings, MPI.COMM_SELF)
    _, A, rows = run(simulation)
    F = simulation.state.deformation_gradient().reshape(-1, 3, 3)
    assert F[0, 0, 0] > F[0, 2, 2] + 0.05 and rows[9]["mean_stretch"] > 1.1  # it is x that is stretched at last
    assert np.abs(F - F[0]).max() < 1e-8 and np.abs(A.reshape(-1, 3, 3) - A[0, 0]).max() < 1e-8


def test_little_is_made_of_what_is_off_the_axes_under_compression() -> None:
    """A off by up to 1e-3: the switch lets the lateral tension, which is noise, turn nothing."""
    ramp = [[0.0, 0.0], [10.0, 1.0]]
    settings = scene("cube", loads={"force": {"value": -10.0, "ramp": ramp}}, time={"end": 40.0})
    simulation = Simulation(settings, MPI.COMM_SELF)
    noise = np.random.default_rng(1).uniform(-1e-3, 1e-3, (*simulation.cells.dimension_values.shape[:2], 3, 3))
    noise -= np.trace(noise, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) / 3
    before = np.eye(3) / 3 + (noise + np.swapaxes(noise, -1, -2)) / 2
    squares, vectors = np.linalg.eigh(before)
    simulation.cells.set(np.sqrt(squares), np.swapaxes(vectors, -1, -2))
    np.testing.assert_allclose(simulation.cells.structure_tensor(), before, atol=1e-14)
    _, after, rows = run(simulation)
    assert rows[-1]["mean_stretch"] < 0.9
    assert np.abs(after - before).max() < 5e-3


def test_the_tangent_is_the_derivative_of_the_residual() -> None:
    """Order 2 of the Taylor remainder, cells and deformation at random, and of the blend of two cells."""
    simulation = short_tube(4.0)
    run(simulation)
    blend = next(thing for thing in [simulation.stepper.coupling.blend] if isinstance(thing, Blend))  # type: ignore
    blend.set(0.3)
    for equilibrium in (simulation.stepper.coupling.equilibrium, blend.equilibrium):
        x = simulation.unknown.x.petsc_vec
        residual, matrix = x.duplicate(), equilibrium.create_matrix()
        direction = np.random.default_rng(3).standard_normal(len(simulation.unknown.x.array)) * 1e-2
        free = np.isnan(equilibrium.prescribed_values())
        direction[~free] = 0.0
        start = simulation.unknown.x.array.copy()

        def force(h: float) -> Array:
            simulation.unknown.x.array[:] = start + h * direction
            equilibrium.assemble_internal(residual)
            equilibrium_load = residual.duplicate()
            equilibrium.assemble_external(equilibrium_load)
            return (residual.array + equilibrium_load.array)[free]

        zero = force(0.0)
        equilibrium.assemble_tangent(matrix)
        change = matrix.createVecLeft()
        step = matrix.createVecRight()
        step.array[:] = direction
        matrix.mult(step, change)
        remainders = [np.linalg.norm(force(h) - zero - h * change.array[free]) for h in (1.0, 0.5, 0.25)]
        simulation.unknown.x.array[:] = start
        orders = np.log2(np.array(remainders[:-1]) / remainders[1:])
        np.testing.assert_allclose(orders, 2.0, atol=0.1)


def test_the_ends_of_a_blend_are_the_plain_model() -> None:
    """With the share 1 the new cells alone, with 0 those of the last equilibrium."""
    simulation = short_tube(3.0)
    run(simulation)
    coupling: Any = simulation.stepper.coupling
    blend, plain, cells = coupling.blend, coupling.equilibrium, simulation.cells
    forces = [simulation.unknown.x.petsc_vec.duplicate() for _ in range(2)]

    def difference(share: float) -> float:
        blend.set(share)
        for equilibrium, force in zip((blend.equilibrium, plain), forces, strict=True):
            equilibrium.assemble_internal(force)
        return float(np.abs(forces[0].array - forces[1].array).max())

    assert difference(1.0) < 1e-12 < difference(0.0)
    old = simulation.state.equilibrium_cells
    cells.set(old.dimension_values, old.axis_values)
    assert difference(0.0) < 1e-12


def test_the_driving_stress_is_that_of_the_energy() -> None:
    """The pass sees the repulsion too: unloaded, with any A, no stress."""
    simulation = short_tube(1.0)
    _, tensor = simulation.stepper.remodeling.driving_tensor()
    assert np.abs(tensor).max() < 1e-12
    printed = Simulation(scene("tube", material={"repulsion": "axes"}, time={"end": 1.0}), MPI.COMM_SELF)
    assert np.abs(printed.stepper.remodeling.driving_tensor()[1]).max() < 1e-12


def test_the_extrapolated_scheme_is_of_second_order_and_the_staggered_one_of_first() -> None:
    fine = run(short_tube(4.0, 0.125, coupling="extrapolated"))
    orders = {}
    for coupling in ("staggered", "extrapolated"):
        errors = []
        for step in (1.0, 0.5):
            found = run(short_tube(4.0, step, coupling=coupling))
            errors.append([np.abs(found[0][-1] - fine[0][-1]).max(), np.abs(found[1] - fine[1]).max()])
        orders[coupling] = np.log2(np.array(errors[0]) / errors[1])
    assert np.all(orders["extrapolated"] > 1.7)
    np.testing.assert_allclose(orders["staggered"], 1.0, atol=0.1)


def test_nothing_swings_from_pass_to_pass() -> None:
    """Each further difference over the steps is smaller, random cells included; the printed law's grow."""
    unknowns, _, rows = run(short_tube(32.0))
    sizes = [np.linalg.norm(np.diff(unknowns[-6:], order, axis=0)[-1]) for order in (1, 2, 3)]
    assert sizes[1] < sizes[0] / 5 and sizes[2] < sizes[1] / 5
    assert all(row["substeps"] == 1 for row in rows)
    printed = run(short_tube(32.0, law="explicit"))[0]
    sizes = [np.linalg.norm(np.diff(printed[-6:], order, axis=0)[-1]) for order in (1, 2, 3)]
    assert sizes[2] > sizes[1]


def test_isotropic_cells_keep_the_tube_symmetric() -> None:
    """All elements of a layer do the same, for the drivers that over-correct with the printed law too."""
    for driver in ("pk2", "finger"):
        simulation = short_tube(12.0, cells="isotropic", driver=driver)
        _, _, rows = run(simulation)
        angle = simulation.scene.geometry.fibre_angle(
            simulation.cells.dimension_values, simulation.cells.axis_values, simulation.quadrature.coordinates
        )
        layers = np.round(np.linalg.norm(simulation.quadrature.coordinates[..., :2], axis=-1), 6)
        scatter = max(np.ptp(angle[layers == radius]) for radius in np.unique(layers))
        assert scatter < 1e-8


def test_where_the_extrapolated_target_would_break_the_cells_the_last_one_counts(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Chains along z whose target came from y: the target ahead is negative along y, and so would be A."""
    simulation = short_tube(4.0, coupling="extrapolated")
    run(simulation)
    coupling: Any = simulation.stepper.coupling
    state, cells = simulation.state, simulation.cells
    points = cells.dimension_values.shape[1]
    dimensions, axes = cells.dimension_values.copy(), cells.axis_values.copy()
    dimensions[0], axes[0] = [0.0, 0.0, 1.0], np.eye(3)
    cells.set(dimensions, axes)
    along_y, along_z = np.diag([0.0, 1.0, 0.0]).ravel(), np.diag([0.0, 0.0, 1.0]).ravel()
    coupling._values[0, :, :, :10] = np.stack([[*along_z, 1.0], [*along_y, 1.0]])
    before, target = cells.structure_tensor(), coupling._extrapolated(state.time + 1.0)
    with caplog.at_level("INFO"):
        coupling._follow(target, state.time + 1.0)
    assert f"time 5: {points} points follow the last stress" in caplog.text
    A = cells.structure_tensor()
    np.testing.assert_allclose(A[0], np.broadcast_to(np.diag([0.0, 0.0, 1.0]), A[0].shape), atol=1e-14)
    share = -np.expm1(-KAPPA * target.share)[:, None, None]
    expected = before.reshape(-1, 3, 3) + share * (target.direction - before.reshape(-1, 3, 3))
    np.testing.assert_allclose(A.reshape(-1, 3, 3)[points:], expected[points:], atol=1e-13)


def test_only_a_law_with_a_target_can_be_extrapolated() -> None:
    with pytest.raises(SceneError) as caught:
        scene("cube", remodeling={"law": "explicit", "coupling": "extrapolated"})
    assert "remodeling.coupling = 'extrapolated'" in str(caught.value) and "'tensor'" in str(caught.value)
