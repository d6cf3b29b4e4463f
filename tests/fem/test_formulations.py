"""Elements that do not lock: the selective formulation against closed forms, and the warning about those that do."""

from __future__ import annotations

from functools import cache
from typing import Any

import dolfinx.fem
import numpy as np
import pytest

from remodel_fenicsx import Scene, SceneError
from remodel_fenicsx.body.domain import Domain
from remodel_fenicsx.model.energy import MATRICES, neo_hookean
from remodel_fenicsx.scene import preset_scene
from remodel_fenicsx.schema.settings import Cells, Material
from remodel_fenicsx.watch.warnings import LockingWarning, PressureNoise
from tests import parts
from tests.conftest import Case, slowly
from tests.locking_bodies import EXACT_TUBE, bar_scene, registered, thick_tube
from tests.parts import cube, smooth, tube
from tests.reference.radial import RadialMaterial, solve_radial
from tests.runs import SELF, last_row, simulated
from tests.values import ANGLES, isotropic, ramp_to, ramped

SELECTIVE = "selective-integration"
STIFF = Material(lame_mu=3.103, lame_lambda=3.103e4)


# ---------------------------------------------------------------- the formulation on its own
def distorted_cube(scale: float = 0.1) -> parts.Body:
    """Random cells in eight hexahedra that are no parallelepipeds, with the selective formulation; nothing is held."""
    domain = cube(refinement=2)
    x = domain.mesh.geometry.x
    x += (
        scale * np.prod(x * (1 - x), axis=1)[:, None] * np.array([4.0, -3.0, 5.0])
    )  # the node inside
    x += 0.5 * scale * x[:, [1, 2, 0]] * x[:, [2, 0, 1]]
    made = parts.body(domain, Cells(initial="random", seed=3))
    made.formulation = SELECTIVE
    return made


def test_uniform_deformation_is_met_on_any_mesh() -> None:
    """Patch test: with the boundary displaced linearly the node inside follows, and the stress is uniform."""
    made = distorted_cube()
    made.cells.set(np.full_like(made.cells.dimension_values, 3**-0.5), made.cells.axis_values)
    gradient = np.array([[0.05, 0.1, 0.0], [0.0, -0.03, 0.06], [0.02, 0.0, 0.04]])
    target = made.nodes @ gradient.T
    support = dolfinx.fem.Function(made.displacement.function_space)
    support.x.array[:] = target.ravel()
    outer = dolfinx.fem.locate_dofs_topological(
        made.displacement.function_space, 2, np.sort(made.domain.facet_tags.indices)
    )
    made.loading.boundary_conditions.append(dolfinx.fem.dirichletbc(support, outer))
    assert len(outer) == 26
    problem = made.problem(material=STIFF)
    problem.solve()
    np.testing.assert_allclose(made.displacement.x.array.reshape(-1, 3), target, atol=1e-11)
    remodeling = made.remodeling(STIFF, driver="cauchy")
    F, stress = remodeling.driving_tensor()
    np.testing.assert_allclose(F, np.broadcast_to(np.eye(3) + gradient, F.shape), atol=1e-11)
    np.testing.assert_allclose(stress, np.broadcast_to(stress[0], stress.shape), atol=1e-7)
    assert stress[0, 0, 0] > 100  # of the bulk, not of mu


def test_the_driving_stress_has_the_pressure_of_the_element() -> None:
    """J sigma = mu (b - I) + lambda ln J_c I, J_c at the centroid: of the mean of the nodes, for trilinear elements."""
    made = distorted_cube()
    made.set_displacement(smooth(made.nodes, 0.05, 4))
    alone = STIFF.model_copy(update={"chain_density": 0.0})
    remodeling = made.remodeling(alone, driver="cauchy")
    made.set_displacement(
        smooth(made.nodes, 0.05, 5)
    )  # after it was made: it looks at the present state
    F, stress = remodeling.driving_tensor()
    J = np.linalg.det(F)[:, None, None]
    pressure = (J * stress - alone.lame_mu * (F @ np.swapaxes(F, 1, 2) - np.eye(3))).reshape(
        8, -1, 3, 3
    )
    signs = (
        np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]) / 4
    )  # slopes at the centre
    nodes = made.domain.mesh.geometry.dofmap
    reference = np.einsum("eni,nj->eij", made.domain.mesh.geometry.x[nodes], signs)
    dofs = made.displacement.function_space.dofmap.list
    change = np.einsum("eni,nj->eij", made.displacement.x.array.reshape(-1, 3)[dofs], signs)
    centroid = np.linalg.det(np.eye(3) + change @ np.linalg.inv(reference))
    expected = alone.lame_lambda * np.log(centroid)[:, None, None, None] * np.eye(3)
    np.testing.assert_allclose(
        pressure, np.broadcast_to(expected, pressure.shape), atol=1e-8 * np.abs(expected).max()
    )
    assert np.ptp(J.reshape(8, -1), axis=1).min() > 1e-3 and np.ptp(np.log(centroid)) > 1e-2
    made.formulation = "displacement"
    whole = made.remodeling(alone, driver="cauchy").driving_tensor()[1]
    assert np.abs(whole - stress).max() > 10


def test_the_guard_knows_j_where_the_formulation_takes_it() -> None:
    """An hourglass makes J at the points larger than in the middle; its opposite makes it smaller."""
    made = parts.body(cube(), Cells(initial="isotropic"))
    made.formulation = SELECTIVE
    problem = made.problem()
    x, y, z = (2 * made.nodes - 1).T
    for sign in (-1.0, 1.0):
        made.set_displacement(
            0.15 * np.column_stack((y * z, x * z, sign * x * y)) - 0.3 * made.nodes
        )
        at_points, at_centre = (
            problem.evaluate().jacobians.min(),
            problem.state.dilatation.jacobians().min(),
        )
        assert at_centre == pytest.approx(0.7**3, rel=1e-12)
        assert (at_points > at_centre) == (sign < 0) and abs(at_points - at_centre) > 1e-3
        assert problem.limits().min_jacobian == min(at_points, at_centre)


# ---------------------------------------------------------------- bodies that lock
def meshed(scene: Scene, around: int, through: int, along: int = 1) -> Domain:
    """A tube with so many elements."""
    shape, mesh = scene.geometry, scene.mesh
    size = shape.inner_radius, shape.outer_radius, shape.length
    return tube(*size, 1, mesh.element, mesh.degree, SELF, (around, through, along))


@pytest.mark.parametrize(
    ("around", "through", "tolerance"), [(16, 8, 0.035), *slowly((32, 16, 0.01))]
)
def test_a_thick_tube_does_not_lock(
    around: int, through: int, tolerance: float, caplog: Any
) -> None:
    """Incompressible, closed form."""
    # few halvings: the three steps that go three times as far as their first Newton step are not looked into again
    scene = thick_tube(1e4, SELECTIVE).with_values({"solver.maximum_halvings": 4})
    with simulated(scene, meshed(scene, around, through)) as (_, rows):
        assert rows[-1]["inner_radius"] - 1 == pytest.approx(EXACT_TUBE, rel=tolerance)
        assert max(row["newton_iterations"] for row in rows) <= 9
        assert {row["substeps"] for row in rows[1:]} == {1.0}
    assert not caplog.records


def test_a_tube_that_locks_is_told(caplog: Any) -> None:
    """Once, with what to set and about how much the displacement lacks."""
    locking = thick_tube(1e3, "displacement")
    with simulated(locking, meshed(locking, 16, 8)) as (_, rows):
        lacking = 1 - (rows[-1]["inner_radius"] - 1) / EXACT_TUBE
    (line,) = caplog.messages
    assert line.startswith("time 1: volumetric locking: displacements too small by about ")
    assert line.endswith(
        " % (lambda/mu up to 1000); set mesh.element = 'hexahedron' and mesh.formulation = "
        "'selective-integration' (docs/solver.md, Volumetric locking)"
    )
    said = float(line.split("about ")[1].split(" %")[0]) / 100
    assert lacking == pytest.approx(said, abs=0.15) and lacking > 0.7


LACKING = [  # lambda/mu, outer radius, degree, formulation, part of the pressure that bursts an incompressible tube
    (8.8, 3.0, 1, "displacement", 0.5), (49.0, 3.0, 1, "displacement", 0.5), (8.8, 10.0, 1, "displacement", 0.05),
    (20.0, 10.0, 1, "displacement", 0.5), (8.8, 10.0, 1, SELECTIVE, 0.05), (49.0, 10.0, 2, "displacement", 0.05),
    (49.0, 3.0, 2, "displacement", 0.5),
]  # fmt: skip


@pytest.mark.parametrize(("ratio", "radius", "degree", "formulation", "part"), LACKING)
def test_a_run_knows_what_its_elements_lack(
    ratio: float, radius: float, degree: int, formulation: str, part: float, caplog: Any
) -> None:
    """Eight elements through walls from thin to thick against 200 of a reference that shares no code."""
    pressure = part * 3.103 * np.log(radius)
    scene = thick_tube(ratio, formulation, pressure).with_values(
        {"geometry.outer_radius": radius, "model.kinematics": "radial", "mesh.degree": degree}
    )
    material = RadialMaterial(lame_lambda=3.103 * ratio, lame_mu=3.103, network_modulus=0.0)
    exact = solve_radial(
        pressure, 0.0, 4.0, 4.0, law="none", outer_radius=radius, material=material
    ).inner_radii[-1]
    with simulated(scene) as (simulation, rows):
        missing = sum(
            LockingWarning(simulation.stepper, formulation == "displacement").missing_deformation()
        )
    lacking = 1 - (rows[-1]["inner_radius"] - 1) / (exact - 1)
    assert missing == pytest.approx(lacking, rel=0.25, abs=0.005)
    told = caplog.messages
    assert len(told) == (lacking > 0.05), told
    cause = "volumetric locking" if formulation == "displacement" else "elements too large"
    assert all(cause in line for line in told)


@pytest.mark.parametrize(
    ("kinematics", "pressure"), [("radial", 0.0), ("radial", 0.3), ("axisymmetric", 0.3)]
)
def test_elements_that_lock_in_an_elongated_tube_are_told(
    kinematics: str, pressure: float, caplog: Any
) -> None:
    """Most of the lateral motion is the contraction, which elements follow, and most of the work the elongation's.

    Chains along the radius make the contraction differ between the directions across, so that strain varies.
    """
    scene = thick_tube(250.0, "displacement", pressure, chain_density=2e21).with_values({
        "model.kinematics": kinematics, "cells.initial": "aligned", "cells.aligned_axis": 1,
        "cells.axes": "cylindrical", "loads.elongation": {"value": 0.1, "ramp": ramp_to(4.0)},
    })  # fmt: skip
    with simulated(scene) as (simulation, rows):
        missing = sum(LockingWarning(simulation.stepper, True).missing_deformation())
    with simulated(scene.with_values({"mesh.refinement": 2, "mesh.degree": 2})) as (_, fine):
        pass
    found, exact = (
        np.array([of[-1]["inner_radius"] - 1, of[-1]["outer_radius"] - 3]) for of in (rows, fine)
    )
    assert np.abs(found - exact).max() > 0.05 * np.abs(exact).max()
    assert missing > 0.05
    assert ["volumetric locking" in line for line in caplog.messages] == [True]


# ---------------------------------------------------------------- cells that turn in a stiff bulk
def remodeling_tube(ratio: float, **values: Any) -> Scene:
    """A thick tube of isotropic cells on a ray, lambda over mu given."""
    scene = isotropic(
        None, geometry={"shape": "tube", "inner_radius": 1.0, "outer_radius": 3.0, "length": 2.0},
        material={"lame_lambda": 3.103 * ratio}, loads=ramped(20.0, pressure=4.8, elongation=0.1),
        remodeling={"law": "tensor"}, time={"end": 40.0, "step": 2.5},
    )  # fmt: skip
    return Scene(**scene).with_values({"mesh.degree": 2} | values)


WATCHED = ("inner_radius", "outer_radius", *ANGLES)


def at_the_end(scene: Scene) -> np.ndarray:
    """Radii and angles of the last row."""
    row = last_row(scene)
    return np.array([row[name] for name in WATCHED])


@cache
def mean_angles(ratio: float) -> np.ndarray:
    """Radii, and the same means over elements of a reference that shares no code."""
    material = RadialMaterial(lame_lambda=3.103 * ratio, lame_mu=3.103)
    found = solve_radial(
        4.8, 0.1, 20.0, 40.0, law="tensor", step=0.5, elements=160, material=material
    )
    angles = [found.mean_fibre_angle(*place) for place in ((1.0, 1.25), (1.75, 2.25), (2.75, 3.0))]
    return np.array([found.inner_radii[-1], found.outer_radii[-1], *angles])


@pytest.mark.parametrize("ratio", [1e2, 1e3, 1e4])
@pytest.mark.parametrize("degree", [1, 2])
def test_cells_turn_alike_however_stiff_the_bulk(ratio: float, degree: int, caplog: Any) -> None:
    """By default, from the common soft tissue to the nearly incompressible."""
    found = at_the_end(remodeling_tube(ratio, **{"mesh.degree": degree}))
    exact = mean_angles(ratio)
    np.testing.assert_allclose(found[:2], exact[:2], rtol=5e-3)
    np.testing.assert_allclose(found[2:], exact[2:], atol=1.0)
    assert not caplog.records


@pytest.mark.parametrize(
    ("ratio", "degree", "told"), [(1e3, 2, True), (1e2, 1, True), (1e2, 2, False), (8.8, 1, False)]
)
def test_pressure_that_is_noise_is_told(ratio: float, degree: int, told: bool, caplog: Any) -> None:
    """Where J is taken at all points: displacements are right to 3 %, and no warning of locking comes."""
    scene = remodeling_tube(ratio, **{"mesh.degree": degree, "mesh.formulation": "displacement"})
    found = at_the_end(scene)
    smooth_pressure = at_the_end(scene.with_values({"mesh.formulation": SELECTIVE}))
    assert (np.abs(found - smooth_pressure)[2:].max() > 1.0) == told
    said = [line for line in caplog.messages if "pressure oscillations" in line]
    assert len(said) == told and all(
        "mesh.formulation = 'selective-integration'" in line for line in said
    )


def test_a_slope_of_the_pressure_is_no_noise() -> None:
    """Quadratic elements follow it: what turns is a third of what would if their mean alone were right."""
    scene = remodeling_tube(20.0, **{"mesh.formulation": "displacement"})
    with simulated(scene) as (simulation, _):
        watcher = PressureNoise(simulation.stepper)
        noise, quadrature = watcher.degrees(), watcher.quadrature
        with pytest.MonkeyPatch.context() as patch:
            beyond = quadrature.polynomial_residual
            patch.setattr(
                quadrature, "polynomial_residual", lambda degree, values: beyond(0, values)
            )
            assert noise < 0.4 * watcher.degrees()


def test_linear_tetrahedra_in_a_stiff_bulk_are_told(caplog: Any) -> None:
    """They have no formulation that helps: the run says what their pressure does."""
    values = {
        "mesh.element": "tetrahedron",
        "mesh.degree": 1,
        "model.kinematics": "full",
        "geometry.length": 0.5,
    }
    scene = remodeling_tube(300.0, **values, **{"time.end": 5.0})
    with simulated(scene, meshed(scene, 8, 4)):
        pass
    assert any("pressure oscillations" in line for line in caplog.messages)


@pytest.mark.parametrize(("changes", "remedy"), [
    ({"natural.opening_angle": 60.0}, "mesh.degree = 2 or a larger mesh.refinement, because [natural] needs"),
    ({"time.tolerance": 0.5, "mesh.formulation": "displacement"}, "mesh.formulation = 'selective-integration'"),
])  # fmt: skip
def test_what_is_told_can_be_done_and_is_told_once(
    changes: dict[str, Any], remedy: str, caplog: Any
) -> None:
    """Of accepted steps alone: a step that is taken back has said nothing."""
    scene = remodeling_tube(1e3, **{"time.end": 5.0}, **changes)
    with simulated(scene) as (_, rows):
        times = [float(line[5:].split(":")[0]) for line in caplog.messages]
    told = [line for line in caplog.messages if "pressure oscillations" in line]
    assert len(told) == 1 and remedy in told[0]
    assert all(np.isclose(time, [row["time"] for row in rows]).any() for time in times)


def test_what_auto_takes() -> None:
    """What a scene needs decides; the choice is that of the scene as run."""
    linear = {"mesh.element": "tetrahedron", "mesh.degree": 1}
    for values, taken in (
        ({}, SELECTIVE), ({"material.lame_lambda": 27.293}, "displacement"), ({"mesh.degree": 1}, SELECTIVE),
        ({"natural.opening_angle": 60.0}, "displacement"),
        (linear, "displacement"), ({"mesh.element": "tetrahedron"}, SELECTIVE),
    ):  # fmt: skip
        scene = remodeling_tube(1e3, **values, **{"time.end": 40.0})
        assert scene.mesh.formulation == "auto" and scene.formulation == taken, values
        assert scene.describe_formulation().startswith(f"formulation {taken!r}: lambda/mu = ")
    with simulated(remodeling_tube(1e3, **{"time.end": 2.5})) as (simulation, _):
        assert simulation.scene.mesh.formulation == SELECTIVE


def random_artery(**values: Any) -> Scene:
    """The paper's artery."""
    return preset_scene("kuhl-holzapfel-2007", "tube").with_values(
        {"cells.initial": "random", **values}
    )


def test_the_papers_artery_is_fine_enough(caplog: Any) -> None:
    """Where its random cells make strain vary most: two thirds of what is said."""
    artery = random_artery(**{"time.end": 5.0})
    with simulated(artery, meshed(artery, 16, 8, 2)) as (simulation, _):
        watcher = LockingWarning(simulation.stepper, True)
        assert 0.025 < sum(watcher.missing_deformation()) < 0.038
    assert not caplog.records


def test_what_cells_do_is_no_lack_of_elements(caplog: Any) -> None:
    """Under a tenth of the paper's pressure random cells deform the wall by more than the load does."""
    values = {"loads.pressure.value": 0.48, "loads.elongation.value": 0.0, "time.end": 3.0}
    artery = random_artery(**values)
    with simulated(artery, meshed(artery, 16, 8)) as (simulation, _):
        watcher = LockingWarning(simulation.stepper, True)
        assert sum(watcher.energies()[1:]) > 0.2 * watcher.work()[0]
    assert "displacements are off by" not in caplog.text


RANDOM_CUBE = {
    "preset": "kuhl-holzapfel-2007",
    "geometry": {"shape": "cube"},
    "mesh": {"refinement": 2, "formulation": SELECTIVE},
    "material": {"lame_lambda": 3.103e4, "chain_density": 0.0},
    "cells": {"initial": "random"},
    "time": {"end": 6.0},
    "solver": {"absolute_tolerance": 1e-9, "relative_tolerance": 0.0},
}
ON_ONE_AND_TWO_RANKS = [{"scene": RANDOM_CUBE}]


def test_one_and_two_ranks_agree(case: Case) -> None:
    one, two = (case(RANDOM_CUBE, ranks=ranks) for ranks in (1, 2))
    assert np.ptp(one["l"] - one["l0"]) > 0.05
    for name, tolerance in (
        ("mean_stretch", 1e-8),
        ("min_jacobian", 1e-8),
        ("u", 1e-7),
        ("l", 1e-6),
    ):
        np.testing.assert_allclose(two[name], one[name], rtol=0, atol=tolerance, err_msg=name)


@pytest.mark.slow
def test_the_bar_of_the_cardiac_benchmark_bends_as_far_as_everywhere() -> None:
    """S. Land et al. 2015, problem 1: the tip at z = 4.17 mm, within 0.5 %."""
    with registered(), simulated(bar_scene(formulation=SELECTIVE, degree=2)) as (_, rows):
        assert rows[-1]["tip"] == pytest.approx(4.17, rel=0.005)


# ---------------------------------------------------------------- scenes
def test_what_does_not_fit_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(MATRICES, "plain", lambda F, *lame: neo_hookean(F, *lame))
    cubic: dict[str, Any] = {"geometry": {"shape": "cube"}, "time": {"end": 1.0}}
    Scene(**cubic, material={"matrix": "plain"})
    for mesh, material in (
        ({"element": "tetrahedron", "formulation": SELECTIVE}, {}), ({"formulation": "f-bar"}, {}),
        ({"formulation": SELECTIVE}, {"matrix": "plain"}),
    ):  # fmt: skip
        with pytest.raises(SceneError, match=f"^mesh.formulation = '{mesh['formulation']}': "):
            Scene(**cubic, mesh=mesh, material=material)
    made = distorted_cube()
    with pytest.raises(TypeError, match="Matrix"):
        made.problem(material=Material(matrix="plain"))
