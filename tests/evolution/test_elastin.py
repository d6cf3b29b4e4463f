"""material.elastin: the matrix is stretched further than new collagen, by other programs."""

from __future__ import annotations

import runpy
import tomllib
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from remodel_fenicsx import Recording, Scene, preset_scene, read_scene
from remodel_fenicsx.body.tube import whole_tube
from remodel_fenicsx.extend import DRIVERS, MATRICES, Driver
from remodel_fenicsx.model.cells import structure_tensor
from remodel_fenicsx.model.residual_stress import fresh_stretches
from remodel_fenicsx.results.columns import Measurement
from remodel_fenicsx.results.export import export
from remodel_fenicsx.running import run
from remodel_fenicsx.scene import scene_from_dict
from tests.conftest import slowly
from tests.mesh_files import TUBE, write_tube
from tests.reference.elastin import ElasticWall, fresh, outwards, pulled
from tests.reference.radial import RadialMaterial, secant_stiffness
from tests.results.test_export_again import again, grown, scene as growing
from tests.runs import (
    SELF,
    goes_on,
    last_row,
    made,
    opening_angle,
    rows_of,
    simulated,
    taylor_orders,
)
from tests.tables import rows, values
from tests.values import ANGLES, assert_close, isotropic, ramped

RADII = ["inner_radius", "outer_radius"]
GROWN = ["content", "natural_length", "growth"]
HOOP, AXIAL = (
    [f"{name}_stress{part}" for part in ("_matrix", "_collagen")] for name in ("hoop", "axial")
)

numbers = partial(np.fromstring, sep=" ")
COMMON = tomllib.loads(Path(__file__).with_name("elastin_tables.toml").read_text())
EARLY = COMMON["early"]


def passive(
    columns: Any,
    prestretch: Any = (1.2, 1.5),
    elongation: float = 0.1,
    pressure: float = 1.2,
    kinematics: str = "radial",
    **tables: Any,
) -> Scene:
    """The default tissue, which does not remodel."""
    of: dict[str, Any] = {
        "output": {"fields": False, "report": False, "columns": list(columns)},
        "material": {"elastin": {"prestretch": prestretch}},
        "loads": ramped(24.0, pressure=pressure, elongation=elongation),
    }
    return scene_from_dict(isotropic("consistent", kinematics, **COMMON["passive"] | of | tables))


def vessel(columns: Any, **changes: Any) -> Scene:
    """Of elastin.toml, by dotted keys."""
    scene = read_scene(Path(__file__).with_name("elastin.toml"))
    return scene.with_values({"output.columns": list(columns)} | changes)


def measured(simulation: Any) -> Measurement:
    """Of the present state."""
    return Measurement(simulation.observer, SimpleNamespace(time=0.0))  # type: ignore[arg-type]


def seen(simulation: Any, names: Any) -> dict[str, float]:
    """Columns of the present state."""
    present = measured(simulation)
    return {
        one.name: one.value(present) for one in simulation.observer.columns if one.name in names
    }


def held(simulation: Any, pressure: float, elongation: float) -> dict[str, float]:
    """Radii and forces under other loads, that nothing has had time to follow."""
    loads = {"pressure": pressure, "elongation": elongation}
    simulation.stepper.coupling.solve_equilibrium(simulation.state.time + 1e-9, loads)
    return seen(simulation, [*WALL, "reduced_axial_force"])


def without_loads(simulation: Any) -> tuple[float, float, float]:
    """Inner and outer radius and length over that of the mesh; no force is left."""
    length = opening_angle(simulation, "unloaded_stretch")
    row = held(simulation, 0.0, length - 1)
    assert abs(row["axial_force"]) < 0.01
    return row["inner_radius"], row["outer_radius"], length


# ---------------------------------------------------------------- fresh tissue
def free_of_stress(simulation: Any) -> None:
    """In its place."""
    present = measured(simulation)
    assert np.abs(present.stress).max() < 1e-9 > np.abs(present.F - np.eye(3)).max()


@pytest.mark.parametrize(("of", "prestretch", "expected"), COMMON["fresh"])
def test_stretches_of_fresh_tissue(of: Any, prestretch: Any, expected: Any) -> None:
    """At a point, by two other programs."""
    scene = passive([], material=of | {"elastin": {"prestretch": prestretch}})
    found = fresh_stretches(scene.properties()[""].tissue)
    assert found == pytest.approx(expected, abs=1e-5)
    assert found == pytest.approx(fresh(RadialMaterial(**of), prestretch), abs=1e-9)


def test_fresh_tissue_is_free_of_stress_at_every_point() -> None:
    """So that the mesh is the unloaded body, and a cut opens nothing."""
    names = [*WALL, "opening_angle", *ALONG[:2]]
    elastin = fresh(RadialMaterial(), (1.2, 1.5))[:2] * (1.2, 1.5)
    scene = passive(names, (1.2, 1.5), 0.0, 0.0, time={"end": 1.0})
    with simulated(scene) as (simulation, of_run):
        free_of_stress(simulation)
    assert [of_run[-1][name] for name in names] == pytest.approx([1, 1.3, 0, 0, *elastin], abs=1e-9)


# ---------------------------------------------------------------- blocks and tendons
@pytest.mark.parametrize(("changes", "axes", "nominal"), COMMON["blocks"])
def test_blocks_are_stretched_as_by_hand(changes: Any, axes: Any, nominal: Any) -> None:
    """And are free of stress, in their place, once they are let go."""
    expected = pulled(RadialMaterial(), (1.2, 1.5), np.array(nominal))
    with simulated(scene_from_dict(COMMON["block"]).with_values(changes)) as (simulation, _):
        assert np.abs(measured(simulation).F[..., axes, axes] - expected).max() < 1e-8
        loads = dict.fromkeys(simulation.scene.loads, 0.0)
        simulation.stepper.coupling.solve_equilibrium(4.1, loads)
        free_of_stress(simulation)


def test_a_sheet_with_its_axes_swapped_is_the_other_one() -> None:
    """Numbers, forces, and directions of the matrix."""
    found = []
    with patch.dict(MATRICES):
        runpy.run_path(str(Path(__file__).parents[2] / "demos/extensions/second_network.py"))
        for changes in COMMON["swapped"]:
            with made(scene_from_dict(COMMON["block"]).with_values(changes)) as simulation:
                free_of_stress(simulation)
                *_, step = simulation.steps()
            found.append([step.row["elongation_x"], step.row["elongation_y"]])
    assert found[0] == pytest.approx(found[1][::-1], rel=1e-8)
    assert np.ptp(found[0]) > 0.01


# ---------------------------------------------------------------- tubes that do not remodel
@pytest.mark.parametrize(("prestretch", "elongation", "expected"), COMMON["tubes"])
def test_passive_tubes_are_those_of_other_programs(
    prestretch: Any, elongation: float, expected: Any
) -> None:
    """Radii and force of the wall."""
    row = last_row(passive(WALL, prestretch, elongation))
    assert [row[name] for name in WALL] == pytest.approx(expected, rel=1e-4)
    balanced([(1.0, 1.3, RadialMaterial(), prestretch)], row, 1 + elongation)


WALL = [*RADII, "axial_force"]


def balanced(layers: Any, row: dict[str, float], axial: float = 1.1) -> None:
    """By the reference."""
    outer, left, force = outwards(layers, row["inner_radius"], 1.2, axial)
    assert abs(left) < 1e-3
    assert [row[name] for name in WALL[1:]] == pytest.approx([outer, force], rel=1e-4)


def test_a_prestretch_of_one_changes_no_digit() -> None:
    """Also not of a wall that remodels."""
    names = [*RADII, *ANGLES, "content", *HOOP]
    plain, without = (vessel(names, **EARLY | change) for change in COMMON["plain"])
    assert plain.is_stress_free and not plain.material.has_elastin
    for one, other in zip(*map(rows_of, (plain, without)), strict=True):
        assert one | {"seconds": 0.0} == other | {"seconds": 0.0}


@pytest.mark.parametrize("regions", COMMON["layers"])
def test_layers_differ(regions: Any) -> None:
    """Without elastin inside, and with the same."""
    row = last_row(passive(WALL, (1.0, 1.0), regions=regions))
    inner, outer = (one["material"]["elastin"]["prestretch"] for one in regions.values())
    tissue = RadialMaterial()
    balanced([(1.0, 1.1, tissue, inner), (1.1, 1.3, tissue, outer)], row)


SHORT = COMMON["short"]
ALONG = ["elastin_stretch_circumferential", "elastin_stretch_axial", *HOOP, *AXIAL]


def test_a_whole_tube_is_the_one_on_a_radius() -> None:
    """Its elastin lies along the local axes; parts of the stress, and what a cut would show."""
    names = [*WALL, *ALONG, "opening_angle", "axial_stretch_in_vivo"]
    scene = passive(names, (1.2, 1.5), kinematics="full", **SHORT)
    whole = last_row(scene, whole_tube(scene.geometry, (16, 4, 1), "hexahedron", 2, SELF))
    radial = last_row(passive(names, (1.2, 1.5), **SHORT))
    assert_close(whole, radial, names, 1e-3, 1e-2)


def own_values(file: Path, **tables: Any) -> dict[str, Any]:
    """A tube from a file."""
    of: dict[str, Any] = {
        "geometry": {"shape": "mesh", "file": str(file)},
        "output": {"fields": False, "report": False, "columns": ["lumen_volume", *ALONG]},
    }
    return COMMON["own"] | of | SHORT | tables


def own(file: Path, **tables: Any) -> Scene:
    """The scene of `own_values`."""
    return scene_from_dict(own_values(file, **tables))


def test_an_own_mesh_of_the_tube_is_the_tube(tmp_path: Path) -> None:
    """With directions that are found in it; nothing moves without loads."""
    file = write_tube(tmp_path / "tube.msh", counts=(24, 4, 1), degree=2)
    pressed = COMMON["pressed"]
    alone = last_row(own(file, **pressed | {"loads": {}}))
    assert alone["lumen_volume"] == pytest.approx(3 * np.pi, rel=1e-4)
    radial = last_row(passive([*RADII, *ALONG], **COMMON["same"] | pressed))
    row = last_row(own(file, **pressed))
    assert row["lumen_volume"] == pytest.approx(3.3 * np.pi * radial["inner_radius"] ** 2, rel=1e-3)
    assert_close(row, radial, ALONG, 1e-3)


# ---------------------------------------------------------------- walls at rest
RESTS = rows(__file__, "elastin_rests.txt")
MEANS = ["wall_thickness", "mean_hoop_stress", "reduced_axial_force", *GROWN]


@pytest.mark.parametrize(
    ("changes", "means", "angles", "cut", "unloaded", "forces"),
    [tuple(RESTS[0]), *slowly(*map(tuple, RESTS[1:]))],
)
def test_walls_rest_where_an_independent_program_says(
    changes: str, means: str, angles: str, cut: str, unloaded: str, forces: str
) -> None:
    """Radii, means, angles, cut, radii and length without loads, force under other pressures."""
    scene = vessel([], **values(changes))
    turnover = scene.remodeling.turnover
    changing = {"growth": bool(turnover.growth_key)} | dict.fromkeys(GROWN[:2], turnover.is_on)
    columns = [name for name in MEANS if changing.get(name, True)]
    columns += [*WALL, *ANGLES]
    with simulated(scene.with_values({"output.columns": columns})) as (simulation, of_run):
        row = of_run[-1]
        assert opening_angle(simulation) == pytest.approx(float(cut), abs=2.0)
        if "E8" in changes:
            identities_at_rest(simulation)
        slack = without_loads(simulation)
        pressed = [held(simulation, share * row["pressure"], 0.32) for share in (0.75, 1.25)]
    inner, *others = numbers(means)
    assert row["inner_radius"] == pytest.approx(inner, rel=0.005)
    assert [row.get(name, 1.0) for name in MEANS] == pytest.approx(others, rel=0.01)
    assert [row[name] for name in ANGLES] == pytest.approx(numbers(angles), abs=0.5)
    assert slack == pytest.approx(numbers(unloaded), rel=0.005)
    ratios = [one["reduced_axial_force"] / row["reduced_axial_force"] for one in pressed]
    assert forces == "-" or ratios == pytest.approx(numbers(forces), abs=0.01)


def identities_at_rest(simulation: Any) -> None:
    """tan a = (l_z/l_t)^n and r/rho = lambda_h r0, at every point."""
    axes = simulation.cells.local_axes.axes.reshape(-1, 3, 3)
    F = simulation.state.elastic_gradient().reshape(-1, 3, 3)
    around, along, _ = np.linalg.norm(np.einsum("nij,nkj->nki", F, axes), axis=-1).T
    A = structure_tensor(*simulation.cells.point_cells[:2])
    hoop, axial, _ = np.einsum("nij,njk,nik->in", axes, A, axes)
    np.testing.assert_allclose(np.sqrt(axial / hoop), (along / around) ** 8, rtol=1e-3)
    tissue = simulation.stepper.remodeling.parameters.at_points()
    r = np.sqrt(np.einsum("nij,nji->n", A, F.swapaxes(1, 2) @ F)) / tissue.natural_length
    np.testing.assert_allclose(r, 1.11 * tissue.end_to_end_length, rtol=1e-3)


def test_a_wall_on_its_way_is_that_of_the_reference() -> None:
    """Fine steps, and what a cut opens."""
    reference = ElasticWall(RadialMaterial(lame_mu=7.0, lame_lambda=61.6), **COMMON["reference"])
    reference.run(1.3, 0.32, 8.0, 20.0, 0.5)
    expected = reference.row()
    scene = vessel(expected, **EARLY | COMMON["fine"])
    with simulated(scene) as (simulation, of_run):
        assert opening_angle(simulation) == pytest.approx(reference.cut(), abs=0.5)
    assert_close(of_run[-1], expected, expected, 2e-3)


# ---------------------------------------------------------------- stress and parts of it
def test_the_stress_is_the_slope_of_the_energy_and_turns_with_the_body() -> None:
    """The formula in UFL against the one on arrays, which keeps its energy in a turned body."""
    scene = passive([], (1.2, 1.5), kinematics="full", **SHORT)
    domain = whole_tube(scene.geometry, (8, 1, 1), "hexahedron", 2, SELF)
    with simulated(scene, domain) as (simulation, _):
        stress = measured(simulation).stress.reshape(-1, 3, 3)
        of = simulation.stepper.remodeling.parameters.at_points()
        F, cells = simulation.state.elastic_gradient(), [simulation.cells.point_cells]
        orders = taylor_orders(simulation, simulation.stepper.coupling.equilibrium, 1e-3)
    assert orders == pytest.approx(2.0, abs=0.05)
    J, h = np.linalg.det(F), 1e-30

    def energy(gradient: np.ndarray) -> np.ndarray:
        return np.asarray(of.strain_energy(gradient, cells))

    P = np.empty_like(F)
    for i, j in np.ndindex(3, 3):
        way = np.zeros((3, 3), dtype=complex)
        way[i, j] = 1j * h
        P[:, i, j] = energy(F + way).imag / h
    np.testing.assert_allclose(stress, P @ F.swapaxes(1, 2) / J[:, None, None], atol=1e-9)
    R = Rotation.random(len(F), random_state=1).as_matrix()
    np.testing.assert_allclose(energy(R @ F), energy(F), rtol=1e-12)


def network_by_hand(simulation: Any) -> np.ndarray:
    """Cauchy stress of the chains with their repulsion at all points, for cells along the axes."""
    of, state = simulation.stepper.remodeling.parameters.at_points(), simulation.state
    F, A = state.elastic_gradient(), structure_tensor(*simulation.cells.point_cells[:2])
    growth = simulation.stepper.process("turnover").growth.ratio.reshape(-1)
    J, rho = np.linalg.det(F) * growth, of.natural_length
    r = np.sqrt(np.einsum("nij,nij->n", F @ A, F)) / rho
    g, g0 = (secant_stiffness(length, of.contour_length) for length in (r, of.end_to_end_length))
    pulled = (g / rho**2)[:, None, None] * (F @ A @ F.swapaxes(1, 2))
    pushed = np.asarray(g0)[..., None, None] * A  # axes of A and of C are the same
    return np.asarray((of.content * of.network_modulus / J)[:, None, None] * (pulled - pushed))


def test_a_driver_may_take_the_stress_of_collagen_alone() -> None:
    """By hand; it has no elastin in it, and the columns of both parts are the whole stress."""
    mine = Driver(lambda F, stresses: stresses.collagen.cauchy, False)  # type: ignore[union-attr]
    with patch.dict(DRIVERS, mine=mine):
        scene = vessel(HOOP, **EARLY | COMMON["mine"])
        with simulated(scene) as (simulation, _):
            remodeling = simulation.stepper.remodeling
            collagen, expected = remodeling.driving_tensor()[1], network_by_hand(simulation)
            whole = measured(simulation).stress.reshape(-1, 3, 3)
            parts = seen(simulation, HOOP)
    np.testing.assert_allclose(collagen.reshape(-1, 3, 3), expected, atol=1e-10)
    assert np.abs(whole - expected).max() > 1.0
    assert sum(parts.values()) == pytest.approx(whole[:, 1, 1].mean(), rel=0.01)
    assert parts[HOOP[1]] == pytest.approx(expected[:, 1, 1].mean(), rel=0.01)


# ---------------------------------------------------------------- what is said, and runs that go on
@pytest.mark.parametrize(("changes", "line"), rows(__file__, "elastin_refused.txt"))
def test_what_has_no_elastin_says_so_in_one_line(changes: str, line: str) -> None:
    """With the key."""
    with pytest.raises(ValueError) as refused:
        own(TUBE).with_values(values(changes))
    said = str(refused.value)
    assert said.startswith(line) and "\n" not in said


def test_a_run_goes_on(tmp_path: Path) -> None:
    """Of a wall that grows."""
    found = goes_on(vessel(["content", "growth"], **EARLY), tmp_path, 12.0, 24.0)
    assert found.history["growth"][-1] != pytest.approx(1.0, abs=1e-2)
    assert "prestretch = [0.92, 1.36]" in (found.path / "scene.toml").read_text()


def test_what_export_writes_begins_the_same_run(tmp_path: Path) -> None:
    """With the natural state that made fresh tissue stress-free; of tetrahedra, one F each."""
    mesh = write_tube(tmp_path / "tube.msh", "tetrahedron")
    tables = COMMON["exported"] | {"remodeling": grown()}
    started = run(growing(mesh, 3.0, natural={}, **tables), tmp_path / "run", SELF)
    file = export(started, "vtu", tmp_path / "first.vtu", 2.0)
    second = run(again(mesh, file, 2.0, **tables), tmp_path / "second", SELF)
    original, read = (Recording(folder).history for folder in (started, second))
    assert abs(original["growth"][2] - 1.0) > 1e-3
    for name in tables["output"]["columns"]:
        np.testing.assert_allclose(read[name][1:3], original[name][2:4], rtol=2e-3, err_msg=name)


ON_ONE_AND_TWO_RANKS = [{"scene": own_values(TUBE)}]


def test_two_ranks_find_the_same(both_ranks: Any) -> None:
    """Places and columns."""
    ((one, two),) = both_ranks
    assert_close(two, one, ("u", "lumen_volume", *ALONG), 1e-7, 1e-8)


def test_a_wall_without_chains_has_stress_in_the_matrix_alone() -> None:
    """Both parts are columns there too."""
    changes = COMMON["alone"] | {"output.columns": HOOP}
    row = last_row(preset_scene("consistent", "tube").with_values(changes))
    assert row[HOOP[0]] > 0 == row[HOOP[1]]
