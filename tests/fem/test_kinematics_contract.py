"""What every kinematics keeps, alone and within what stands around it: one list of checks for all."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from remodel_fenicsx import Simulation
from remodel_fenicsx.extend import KINEMATICS, UnitCell
from remodel_fenicsx.fem import jit
from remodel_fenicsx.fem.kinematics import FreeLength, NaturalConfiguration
from remodel_fenicsx.solver.equilibrium import Equilibrium
from tests.runs import made, taylor_orders
from tests.values import isotropic, ramped

AROUND, DIVISIONS = 8, (8, 2, 2)
PRESTRETCH = {
    "natural": {"layers": [{"prestretch": {"circumferential": 1.05, "axial": 1.1}}]},
    "cells": {"initial": "isotropic"},
}
FREE = {"loads": ramped(4.0, axial_force=1.0, elongation=0.0, pressure=4.8)}
AROUND_A_TUBE = {"alone": {}, "prestretched": PRESTRETCH, "of free length": FREE}
TUBES = ("full", "sector", "axisymmetric", "radial")
CASES: dict[str, tuple[str, str, dict[str, Any]]] = {
    **{
        f"tube {name} {around}": ("tube", name, tables)
        for name in TUBES
        for around, tables in AROUND_A_TUBE.items()
    },
    "tube full with selective integration": (
        "tube",
        "full",
        {"mesh": {"formulation": "selective-integration"}},
    ),
    "tube radial both": ("tube", "radial", PRESTRETCH | FREE),
    "cube point": ("cube", "point", {}),
    "cube full": ("cube", "full", {}),
    "tendon point": ("tendon", "point", {}),
    "sheet point sheared": (
        "sheet",
        "point",
        {"loads": ramped(4.0, force_x=50.0, force_y=50.0, shear=0.2)},
    ),
}
UNKNOWNS_PER_NODE = {"full": 3, "sector": 3, "axisymmetric": 2, "radial": 1}
# the largest class of homogeneous gradients that each of them shows: where an entry may differ from that of I
SHOWN = {
    "full": np.ones((3, 3)),
    "sector": np.ones((3, 3)),
    "axisymmetric": np.diag([1, 1, 1]) + np.eye(3, k=-2),
    "radial": np.eye(3),
    "point": np.eye(3),
}
ROUND = {"axisymmetric", "radial"}


@pytest.fixture(scope="module", params=CASES)
def body(request: pytest.FixtureRequest) -> Iterator[Simulation]:
    """A body of each kind before its first step, on few elements."""
    shape, name, tables = CASES[request.param]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("remodel_fenicsx.body.tube.PAPER", DIVISIONS)
        tables = {"cells": {"initial": [0.48, 0.6, 0.64]}, "time": {"end": 4.0}} | tables
        values = isotropic(kinematics=name, geometry={"shape": shape}, **tables)
        with made(values) as simulation:
            yield simulation


def a_gradient(name: str) -> np.ndarray:
    """Draw an F that this kinematics shows."""
    F = np.eye(3) + SHOWN[name] * np.random.default_rng(1).uniform(-0.15, 0.15, (3, 3))
    F[1, 1] = F[0, 0] if name in ROUND else F[1, 1]
    return F


def name_of(body: Simulation) -> str:
    return str(body.scene.model.kinematics)


def deform(body: Simulation, F: np.ndarray) -> None:
    """Give the body x = F X: all that is shown is linear in the unknowns, so least squares find them."""
    kinematics, unknown, has_length = (
        body.state.kinematics,
        body.unknown,
        body.scene.has_free_length,
    )
    strain, nodes = F - np.eye(3), kinematics.nodal_space(unknown).tabulate_dof_coordinates()
    uniform = [
        kinematics.uniform_unknown(unknown.function_space, component) for component in range(3)
    ]
    numbers = [(space.dofmap.list.flatten()[0], size) for space, size in filter(None, uniform)]
    wanted = [*(nodes @ strain.T).ravel(), *np.diag(strain)[: len(numbers)]]
    wanted += [strain[2, 2]] * has_length

    def shown() -> np.ndarray:
        found = [*kinematics.nodal_displacement(unknown).ravel()]
        found += [unknown.x.array[place] / size for place, size in numbers]
        return np.array(found + ([kinematics.strain_of_length(unknown)] if has_length else []))

    columns = []
    for place in range(len(unknown.x.array)):
        unknown.x.array[:] = np.arange(len(unknown.x.array)) == place
        columns.append(shown())
    unknown.x.array[:] = np.linalg.lstsq(np.stack(columns, axis=1), wanted, rcond=None)[0]
    np.testing.assert_allclose(shown(), wanted, atol=1e-12)
    elongation = 0.0 if has_length else strain[2, 2]
    asked = {"elongation": elongation, "shear": strain[0, 1], "pressure": 2.0, "force": 3.0}
    body.state.loading.set({name: asked.get(name, 0.0) for name in body.state.loading.values})


@pytest.fixture
def deformed(body: Simulation) -> tuple[Simulation, np.ndarray]:
    """The body with a homogeneous deformation, and its F."""
    F = a_gradient(name_of(body))
    F[0, 1] = 0.2 if "shear" in body.state.loading.values else F[0, 1]
    deform(body, F)
    return body, F


def test_all_kinematics_and_what_stands_around_them_are_here() -> None:
    assert {name for _, name, _ in CASES.values()} == set(KINEMATICS)


def test_what_stands_around_is_what_the_scene_asks_for(body: Simulation) -> None:
    kinematics = body.state.kinematics
    assert isinstance(kinematics, NaturalConfiguration) == bool(body.scene.natural.layers)
    inner = kinematics.field if isinstance(kinematics, NaturalConfiguration) else kinematics
    assert isinstance(inner, FreeLength) == body.scene.has_free_length
    assert kinematics.name == name_of(body)


def test_a_homogeneous_deformation_has_its_gradient(
    deformed: tuple[Simulation, np.ndarray],
) -> None:
    body, F = deformed
    found = body.state.deformation_gradient()
    np.testing.assert_allclose(found, np.broadcast_to(F, found.shape), atol=1e-12)


def test_the_displacement_of_forms_is_that_of_the_nodes(
    deformed: tuple[Simulation, np.ndarray],
) -> None:
    body, F = deformed
    quadrature = body.quadrature
    expression = jit.expression(body.state.kinematics.displacement(body.unknown), quadrature.points)
    found = quadrature.evaluate(expression, (3,))
    strain = F - np.eye(3)
    strain[
        0, 1
    ] *= body.state.kinematics.three_dimensional  # a prescribed shear is no part of the unknowns
    np.testing.assert_allclose(found, quadrature.coordinates @ strain.T, atol=1e-12)


def test_the_number_of_unknowns(body: Simulation) -> None:
    nodes = len(body.state.kinematics.nodal_displacement(body.unknown))
    count = UNKNOWNS_PER_NODE.get(name_of(body), 0) * nodes or 3
    assert body.state.number_of_owned_unknowns == count + body.scene.has_free_length


def test_the_weight_makes_the_mesh_the_body(body: Simulation) -> None:
    shape, quadrature = body.scene.geometry, body.quadrature
    volume = shape.axial_length * shape.section_area
    if name_of(body) in ("full", "sector") and shape.shape == "tube":
        volume *= AROUND / (2 * np.pi) * np.sin(2 * np.pi / AROUND)  # its sections are polygons
    assert quadrature.integral(np.ones(quadrature.shape)) == pytest.approx(volume, rel=1e-12)


def test_the_energy_is_that_of_the_tissue_free_of_stress(
    deformed: tuple[Simulation, np.ndarray],
) -> None:
    """Typed on arrays: W of F G, for every volume of the tissue before it was stretched to the mesh."""
    body, F = deformed
    state, quadrature = body.state, body.quadrature
    G = (
        np.broadcast_to(np.eye(3), (*quadrature.shape, 3, 3))
        if state.natural_gradient is None
        else state.natural_gradient
    )
    assert (np.abs(G - np.eye(3)).max() > 0.04) == bool(body.scene.natural.layers)
    lengths = np.broadcast_to(state.cells.dimension_values, (*quadrature.shape, 3))
    W = body.tissue.strain_energy(F @ G, [UnitCell(lengths, state.cells.axis_values)])
    expected = quadrature.integral(W / np.linalg.det(G))
    assert Equilibrium(state, body.tissue).stored_energy() == pytest.approx(expected, rel=1e-10)


def test_the_forces_are_the_slope_of_the_energy_and_the_tangent_is_theirs(
    deformed: tuple[Simulation, np.ndarray],
) -> None:
    body, _ = deformed
    equilibrium, x = Equilibrium(body.state, body.tissue), body.unknown.x.array
    forces, start = body.unknown.x.petsc_vec.duplicate(), x.copy()
    way = np.random.default_rng(2).standard_normal(len(x)) * 1e-5
    energies = []
    for sign in (1.0, -1.0):
        x[:] = start + sign * way
        energies.append(equilibrium.stored_energy())
    x[:] = start
    equilibrium.assemble_internal(forces)
    assert (energies[0] - energies[1]) / 2 == pytest.approx(forces.array @ way, rel=1e-6)
    np.testing.assert_allclose(taylor_orders(body, equilibrium, 1e-2), 2.0, atol=0.1)


@pytest.mark.parametrize(
    "body", [key for key in CASES if KINEMATICS[CASES[key][1]].three_dimensional], indirect=True
)
def test_the_energy_does_not_see_a_turn_of_the_body(
    deformed: tuple[Simulation, np.ndarray],
) -> None:
    """Reductions have no turns."""
    body, F = deformed
    equilibrium = Equilibrium(body.state, body.tissue)
    still = equilibrium.stored_energy()
    deform(body, Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix() @ F)
    assert equilibrium.stored_energy() == pytest.approx(still, rel=1e-10)
