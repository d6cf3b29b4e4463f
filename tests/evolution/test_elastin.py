"""material.elastin: the matrix is stretched further than new collagen; figures of independent programs."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from remodel_fenicsx import Recording, Scene
from remodel_fenicsx.body.tube import whole_tube
from remodel_fenicsx.extend import DRIVERS, Driver
from remodel_fenicsx.model.cells import structure_tensor
from remodel_fenicsx.model.residual_stress import fresh_stretches
from remodel_fenicsx.results.columns import Measurement
from remodel_fenicsx.results.export import export
from remodel_fenicsx.running import run
from remodel_fenicsx.scene import scene_from_dict
from tests.conftest import Cases, slowly
from tests.mesh_files import TUBE, write_tube
from tests.reference.elastin import ElasticWall, fresh, shot, stiffness
from tests.reference.radial import RadialMaterial
from tests.results.test_export_again import again, grown, scene as growing
from tests.runs import SELF, goes_on, last_row, opening_angle, rows_of, simulated, taylor_orders
from tests.values import ANGLES, isotropic, ramped

STIFF = RadialMaterial(lame_mu=7.0, lame_lambda=61.6)
E8 = {"prestretch": (0.92, 1.36), "exponent": 8.0, "pressure": 1.3, "gain": 2.4, "volume": 0.42}
E4 = {"prestretch": (0.92, 1.6), "exponent": 4.0, "pressure": 1.35, "gain": 2.0, "volume": 0.4}
RADII = ["inner_radius", "outer_radius"]
GROWN = ["content", "natural_length", "growth"]
HOOP, AXIAL = (
    [f"{name}_stress{part}" for part in ("_matrix", "_collagen")] for name in ("hoop", "axial")
)

EARLY = ((0.0, 0.0), (8.0, 1.0))


def tube(columns: Any = (), kinematics: str = "radial", **tables: Any) -> Scene:
    """The thin wall of a carotid artery."""
    values: dict[str, Any] = {
        "geometry": {"shape": "tube", "inner_radius": 1.0, "outer_radius": 1.3, "length": 1.0},
        "mesh": {"refinement": 2, "degree": 2},
        "output": {"fields": False, "report": False, "columns": list(columns)},
    }
    values["geometry"] |= tables.pop("geometry", {})
    return scene_from_dict(isotropic("consistent", kinematics, **values | tables))


def passive(
    columns: Any,
    prestretch: Any = (1.2, 1.5),
    elongation: float = 0.1,
    pressure: float = 1.2,
    kinematics: str = "radial",
    **tables: Any,
) -> Scene:
    """The default tissue, which does not remodel."""
    values: dict[str, Any] = {
        "material": {"elastin": {"prestretch": prestretch}},
        "loads": ramped(24.0, pressure=pressure, elongation=elongation),
        "remodeling": {"law": "none"},
        "time": {"end": 24.0, "step": 4.0},
    }
    return tube(columns, kinematics, **values | tables)


def vessel(
    columns: Any = (),
    end: Any = "equilibrium",
    ramp: Any = ((0.0, 0.0), (25.0, 1.0)),
    kinematics: str = "radial",
    turns: bool = True,
    of: Any = E8,
    **changes: Any,
) -> Scene:
    """E8 of the design, or another one."""
    of = of | changes
    remodeling = {"driver": "finger", "kappa": 0.025, "exponent": of["exponent"]}
    if turns:
        remodeling["turnover"] = {
            "time": of.get("time", 40.0),
            "deposition_stretch": 1.11,
            "gain": of["gain"],
            "volume": of["volume"],
        }
    loads = ramped(ramp[1][0], pressure=of["pressure"], elongation=0.32)
    loads["pressure"]["ramp"] = [list(corner) for corner in ramp]
    material = {"lame_mu": 7.0, "lame_lambda": 61.6, "elastin": {"prestretch": of["prestretch"]}}
    time = {"end": end} | ({} if end == "equilibrium" else {"step": 4.0, "tolerance": 1.0})
    time |= of.get("steps", {})
    tables = {"loads": loads, "material": material, "remodeling": remodeling, "time": time}
    return tube(columns, kinematics, **tables)


def held(simulation: Any, pressure: float, elongation: float) -> dict[str, float]:
    """The columns under other loads that nothing has had time to follow."""
    loads = {"pressure": pressure, "elongation": elongation}
    simulation.stepper.coupling.solve_equilibrium(simulation.state.time + 1e-9, loads)
    step: Any = SimpleNamespace(time=simulation.state.time)
    measured = Measurement(simulation.observer, step)
    wanted = [*RADII, "axial_force", "reduced_axial_force"]
    columns = {column.name: column for column in simulation.observer.columns}
    return {name: columns[name].value(measured) for name in wanted}


# ---------------------------------------------------------------- fresh tissue
@pytest.mark.parametrize(
    ("of", "prestretch", "expected"),
    [
        (RadialMaterial(), (1.2, 1.5), (0.904205, 0.755517, 1.43663)),
        (STIFF, (0.92, 1.36), (1.078120, 0.765781, 1.207839)),
        (STIFF, (0.92, 1.6), (1.086226, 0.667959, 1.367824)),
    ],
)
def test_stretches_of_fresh_tissue(of: RadialMaterial, prestretch: Any, expected: Any) -> None:
    """At a point, by two other programs."""
    material = {"lame_mu": of.lame_mu, "lame_lambda": of.lame_lambda}
    scene = passive([], material=material | {"elastin": {"prestretch": prestretch}})
    found = fresh_stretches(scene.properties()[""].tissue)
    assert found == pytest.approx(expected, abs=1e-5)
    assert found == pytest.approx(fresh(of, prestretch), abs=1e-9)


def test_fresh_tissue_is_free_of_stress_at_every_point() -> None:
    """So that the mesh is the unloaded body, and a cut opens nothing."""
    names = [*RADII, "axial_force", "opening_angle", "axial_stretch_in_vivo"]
    scene = passive(names, (1.2, 1.5), 0.0, 0.0, time={"end": 1.0})
    with simulated(scene) as (simulation, rows):
        stress = Measurement(simulation.observer, SimpleNamespace(time=1.0)).stress  # type: ignore[arg-type]
    assert np.abs(stress).max() < 1e-9
    assert [rows[-1][name] for name in names] == pytest.approx([1.0, 1.3, 0.0, 0.0, 1.0], abs=1e-9)


# ---------------------------------------------------------------- tubes that do not remodel
@pytest.mark.parametrize(
    ("prestretch", "elongation", "expected"),
    [((1.2, 1.5), 0.1, (2.15685, 2.31100, 8.10436)), ((1.0, 1.5), 0.3, (2.0595, 2.19621, 12.0061))],
)
def test_passive_tubes_are_those_of_other_programs(
    prestretch: Any, elongation: float, expected: Any
) -> None:
    """Radii and force of the wall."""
    names = [*RADII, "axial_force"]
    row = last_row(passive(names, prestretch, elongation))
    layer = (1.0, 1.3, RadialMaterial(), prestretch)
    for other in (expected, shot([layer], 1.2, 1 + elongation)):
        assert [row[name] for name in names] == pytest.approx(other, rel=1e-4)


def test_a_prestretch_of_one_changes_no_digit() -> None:
    """Also not of a wall that remodels."""
    names = [*RADII, *ANGLES, "content", "elastin_stretch_axial", *HOOP]
    plain = vessel(names, 40.0, prestretch=(1.0, 1.0))
    material = {"lame_mu": 7.0, "lame_lambda": 61.6}
    without = plain.with_values({"material": material})
    assert plain.is_stress_free and not plain.material.has_elastin
    rows = [rows_of(scene) for scene in (plain, without)]
    for one, other in zip(*rows, strict=True):
        assert one | {"seconds": 0.0} == other | {"seconds": 0.0}


def test_layers_differ() -> None:
    """Without elastin inside; and two alike are one."""
    names = [*RADII, "axial_force"]

    def layered(inner: Any, outer: Any) -> list[float]:
        regions = {
            "media": {"outer_radius": 1.1, "material": {"elastin": {"prestretch": inner}}},
            "adventitia": {"material": {"elastin": {"prestretch": outer}}},
        }
        row = last_row(passive(names, (1.0, 1.0), regions=regions))
        return [row[name] for name in names]

    for inner, outer in (((1.0, 1.0), (1.2, 1.5)), ((0.9, 1.4), (1.1, 1.2))):
        layers = [
            (1.0, 1.1, RadialMaterial(), inner),
            (1.1, 1.3, RadialMaterial(), outer),
        ]
        assert layered(inner, outer) == pytest.approx(shot(layers, 1.2, 1.1), rel=1e-4)
    alike = last_row(passive(names, (1.2, 1.5)))
    assert layered((1.2, 1.5), (1.2, 1.5)) == pytest.approx([alike[n] for n in names], rel=1e-5)


SHORT: Any = {"loads": ramped(2.0, pressure=0.4, elongation=0.1), "time": {"end": 2.0}}
ALONG = ["elastin_stretch_circumferential", "elastin_stretch_axial", *HOOP, *AXIAL]


def test_a_whole_tube_is_the_one_on_a_radius() -> None:
    """Its elastin lies along the local axes; parts of the stress, and what a cut would show."""
    names = [*RADII, "axial_force", *ALONG, "opening_angle", "axial_stretch_in_vivo"]
    scene = passive(names, (1.2, 1.5), kinematics="full", **SHORT)
    whole = last_row(scene, whole_tube(scene.geometry, (16, 4, 1), "hexahedron", 2, SELF))
    radial = last_row(passive(names, (1.2, 1.5), **SHORT))
    assert [whole[name] for name in names] == pytest.approx(
        [radial[name] for name in names], rel=1e-3, abs=1e-2
    )
    for name in RADII:
        assert whole[name] == pytest.approx(radial[name], rel=1e-4)


def own_values(file: Path, **tables: Any) -> dict[str, Any]:
    """A tube from a file."""
    values = {
        "geometry": {"shape": "mesh", "file": str(file)},
        "cells": {"initial": "isotropic"},
        "material": {"repulsion": "log", "elastin": {"prestretch": [1.2, 1.5]}},
        "output": {"fields": False, "report": False, "columns": ["lumen_volume", *ALONG]},
        "solver": {"method": "direct"},
        "remodeling": {"law": "none"},
    }
    return values | SHORT | tables


def own(file: Path, **tables: Any) -> Scene:
    """The scene of `own_values`."""
    return scene_from_dict(own_values(file, **tables))


def thin(places: np.ndarray) -> np.ndarray:
    """A tube of 1 to 2 as one of 1 to 1.3, of length 1 instead of 3."""
    radius = np.hypot(places[:, 0], places[:, 1])[:, None]
    across = places[:, :2] / radius * (1 + 0.3 * (radius - 1))
    return np.column_stack([across, places[:, 2] / 3])


def test_an_own_mesh_of_the_tube_is_the_tube(tmp_path: Path) -> None:
    """With directions that are found in it; nothing moves without loads."""
    file = write_tube(tmp_path / "tube.msh", counts=(24, 3, 1), moved=thin)
    loose = {"loads": {}, "time": {"end": 1.0}}
    alone, row = last_row(own(file, **loose)), last_row(own(file))
    polygon = np.pi * np.sinc(1 / 12)
    assert alone["lumen_volume"] == pytest.approx(polygon, rel=1e-3)
    radial = last_row(passive([*RADII, *ALONG], (1.2, 1.5), **SHORT))
    radius = np.sqrt(row["lumen_volume"] / 1.1 / polygon)
    assert radius == pytest.approx(radial["inner_radius"], rel=0.01)
    for name in ALONG:
        assert row[name] == pytest.approx(radial[name], rel=0.01, abs=0.03), name


# ---------------------------------------------------------------- walls at rest
class Rest(NamedTuple):
    """A wall at rest by an independent program, as in `tests.evolution.test_growth`."""

    inner_radius: float
    wall_thickness: float
    mean_hoop_stress: float
    reduced_axial_force: float
    content: float
    natural_length: float
    growth: float
    angles: tuple[float, float, float]
    opening_angle: float
    unloaded: tuple[float, float, float]
    forces: tuple[float, float] | None = None


HIGHER = ((0.0, 0.0), (25.0, 1.0), (2500.0, 1.0), (2525.0, 1.5))
BACK = (*HIGHER, (5000.0, 1.5), (5025.0, 1.0))
# fmt: off
RESTS = {
    "E8": (vessel(), Rest(
        1.1153, 0.2626, 5.522, 9.917, 1.462, 1.044, 1.194, (14.3, 16.5, 20.0), 94.9,
        (0.9489, 1.3214, 0.9762), (1.138, 0.831))),
    "E8, pressure times 1.5": (vessel((), 5000.0, HIGHER), Rest(
        1.1506, 0.4040, 5.554, 5.845, 3.399, 1.126, 2.007, (11.0, 10.3, 8.5), 154.4,
        (0.9042, 1.4973, 0.9759), (1.484, 0.446))),
    "E8, and back": (vessel((), 7500.0, BACK), Rest(
        1.1298, 0.2544, 5.774, 9.860, 1.394, 1.057, 1.166, (12.9, 15.0, 19.1), 92.7,
        (0.9561, 1.3207, 0.9711))),
    "E4": (vessel(of=E4), Rest(
        1.1389, 0.2578, 5.965, 10.781, 1.460, 1.039, 1.184, (14.6, 16.0, 17.8), 92.3,
        (0.9342, 1.3054, 0.9814), (1.146, 0.808))),
    "E4, pressure times 1.5": (vessel((), 5000.0, HIGHER, of=E4), Rest(
        1.1782, 0.3854, 6.191, 6.714, 3.307, 1.131, 1.923, (12.7, 12.5, 11.8), 163.2,
        (0.8953, 1.4789, 0.9638), (1.470, 0.450))),
    "E8, volume 0": (vessel(volume=0.0), Rest(
        1.1417, 0.2196, 6.758, 9.915, 1.465, 1.041, 1.0, (12.4, 17.2, 21.8), 56.1,
        (0.9904, 1.3002, 0.9747))),
    "E8, volume 0.3": (vessel(volume=0.3), Rest(
        1.1218, 0.2504, 5.824, 9.919, 1.462, 1.043, 1.139, (13.7, 16.7, 20.6), 85.2,
        (0.9591, 1.3140, 0.9757))),
    "E8, no turnover": (vessel(turns=False), Rest(
        1.1302, 0.2213, 6.639, 10.025, 1.0, 1.0, 1.0, (13.4, 18.3, 23.0), 12.5,
        (0.9679, 1.2811, 0.9799), (1.13, 0.84))),
    "E4, exponent 2": (vessel(of=E4, exponent=2.0), Rest(
        1.1977, 0.2373, 6.815, 10.610, 1.317, 1.028, 1.127, (24.9, 26.4, 28.2), 69.6,
        (0.9498, 1.2986, 0.9908))),
    "E8, no prestretch": (vessel(prestretch=(1.0, 1.0)), Rest(
        1.1826, 0.4960, 3.100, 19.632, 4.824, 1.172, 2.606, (66.1, 58.1, 51.1), 170.7,
        (0.8340, 1.5326, 1.1055))),
    "E8, gain 0.35": (vessel(gain=0.35), Rest(
        1.2081, 0.2318, 6.774, 9.531, 1.268, 1.111, 1.113, (7.9, 10.9, 14.3), 81.8,
        (0.9994, 1.3423, 0.9602))),
}
# fmt: on
WITHIN = {name: 0.01 for name in Rest._fields[1:7]} | {"inner_radius": 0.005}


@pytest.mark.parametrize("case", ["E8", *slowly(*[name for name in RESTS if name != "E8"])])
def test_walls_rest_where_an_independent_program_says(case: str) -> None:
    """Radii, means, angles, cut, radii and length without loads, force under other pressures."""
    scene, expected = RESTS[case]
    turnover = scene.remodeling.turnover
    changing = {"growth": turnover.grows} | dict.fromkeys(GROWN[:2], turnover.is_on)
    names = [name for name in WITHIN if changing.get(name, True)]
    columns = [*names, "outer_radius", "axial_force", *ANGLES]
    eighths = {"output.columns": columns, "mesh.refinement": 1}
    with simulated(scene.with_values(eighths)) as (simulation, rows):
        row, cut = rows[-1], opening_angle(simulation)
        if case == "E8":
            identities_at_rest(simulation, 8.0, 1.11)
        e = opening_angle(simulation, "unloaded_stretch")
        slack = held(simulation, 0.0, e - 1)
        pressed = [held(simulation, share * row["pressure"], 0.32) for share in (0.75, 1.25)]
    for name in names:
        assert row[name] == pytest.approx(getattr(expected, name), rel=WITHIN[name]), name
    assert [row[name] for name in ANGLES] == pytest.approx(expected.angles, abs=0.5)
    assert cut == pytest.approx(expected.opening_angle, abs=2.0)
    assert (slack["inner_radius"], slack["outer_radius"], e) == pytest.approx(
        expected.unloaded, rel=0.005
    )
    assert abs(slack["axial_force"]) < 1e-3 * row["axial_force"]
    if expected.forces is not None:
        ratios = [one["reduced_axial_force"] / row["reduced_axial_force"] for one in pressed]
        assert ratios == pytest.approx(expected.forces, abs=0.01)


def identities_at_rest(simulation: Any, exponent: float, deposition_stretch: float) -> None:
    """tan a = (l_z/l_t)^n and r/rho = lambda_h r0, at every point."""
    axes = simulation.cells.local_axes.axes.reshape(-1, 3, 3)
    F = simulation.state.elastic_gradient().reshape(-1, 3, 3)
    around, along, _ = np.linalg.norm(np.einsum("nij,nkj->nki", F, axes), axis=-1).T
    A = structure_tensor(*simulation.cells.point_cells[:2])
    hoop, axial, _ = np.einsum("nij,njk,nik->in", axes, A, axes)
    np.testing.assert_allclose(np.sqrt(axial / hoop), (along / around) ** exponent, rtol=1e-3)
    tissue = simulation.stepper.remodeling.parameters.at_points()
    r = np.sqrt(np.einsum("nij,nji->n", A, F.swapaxes(1, 2) @ F)) / tissue.natural_length
    np.testing.assert_allclose(r, deposition_stretch * tissue.end_to_end_length, rtol=1e-3)


@pytest.mark.parametrize("gain", [2.4, *slowly(0.35)])
def test_a_wall_on_its_way_is_that_of_the_reference(gain: float) -> None:
    """Fine steps; what a cut opens, radii and length without loads."""
    reference = ElasticWall(
        STIFF, (1.0, 1.3), 0.0, 0.025, 10.0, 1.11, gain, 0.42,
        prestretch=E8["prestretch"], exponent=8.0,
    )  # fmt: skip
    reference.run(1.3, 0.32, 8.0, 20.0, 0.5)
    expected = reference.row()
    columns = [*expected, "outer_radius", "reduced_axial_force"]
    steps = {"step": 0.5, "tolerance": None}
    scene = vessel(
        columns, 20.0, EARLY,
        gain=gain, time=10.0, steps=steps,
    )  # fmt: skip
    with simulated(scene.with_values({"mesh.refinement": 4})) as (simulation, rows):
        cut, e = (opening_angle(simulation, release) for release in ("cut", "unloaded_stretch"))
        slack = held(simulation, 0.0, e - 1)
    for name, value in expected.items():
        assert rows[-1][name] == pytest.approx(value, rel=2e-3), name
    assert cut == pytest.approx(reference.cut(), abs=0.5)
    found = (slack["inner_radius"], slack["outer_radius"], e)
    assert found == pytest.approx(reference.unloaded(), rel=1e-3)


# ---------------------------------------------------------------- stress and parts of it
def test_the_stress_is_the_slope_of_the_energy_and_turns_with_the_body() -> None:
    """The formula in UFL against the one on arrays, which keeps its energy in a turned body."""
    scene = passive([], (1.2, 1.5), kinematics="full", **SHORT)
    domain = whole_tube(scene.geometry, (8, 1, 1), "hexahedron", 2, SELF)
    with simulated(scene, domain) as (simulation, _):
        measured = Measurement(simulation.observer, SimpleNamespace(time=2.0))  # type: ignore[arg-type]
        stress = measured.stress.reshape(-1, 3, 3)
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
    growth = simulation.stepper.part("turnover").growth.ratio.reshape(-1)
    J, rho = np.linalg.det(F) * growth, of.natural_length
    r = np.sqrt(np.einsum("nij,nij->n", F @ A, F)) / rho
    g, g0 = stiffness(r, of.contour_length), stiffness(of.end_to_end_length, of.contour_length)
    pulled = (g / rho**2)[:, None, None] * (F @ A @ F.swapaxes(1, 2))
    pushed = np.asarray(g0)[..., None, None] * A  # axes of A and of C are the same
    return np.asarray((of.content * of.network_modulus / J)[:, None, None] * (pulled - pushed))


def test_a_driver_may_take_the_stress_of_collagen_alone() -> None:
    """By hand; it has no elastin in it, and the columns of both parts are the whole stress."""
    names = [*HOOP, *AXIAL, "hoop_stress_middle"]
    mine = Driver(lambda F, stresses: stresses.collagen.cauchy, material=False)
    with patch.dict(DRIVERS, mine=mine):
        steps = {"step": 4.0, "tolerance": None}
        scene = vessel(names, 40.0, EARLY, steps=steps, time=10.0)
        scene = scene.with_values({"remodeling.driver": "mine", "remodeling.exponent": 2.0})
        with simulated(scene) as (simulation, rows):
            remodeling = simulation.stepper.remodeling
            step: Any = SimpleNamespace(time=40.0)
            measured = Measurement(simulation.observer, step)
            collagen, expected = remodeling.driving_tensor()[1], network_by_hand(simulation)
            whole = measured.stress.reshape(-1, 3, 3)
            parts = {
                column.name: column.value(measured)
                for column in simulation.observer.columns
                if column.name in names
            }
            content = remodeling.parameters.at_points().content
    assert np.ptp(content) > 0.01
    np.testing.assert_allclose(collagen.reshape(-1, 3, 3), expected, atol=1e-10)
    assert np.abs(whole - expected).max() > 1.0
    assert sum(parts[name] for name in HOOP) == pytest.approx(whole[:, 1, 1].mean(), rel=0.01)
    assert sum(parts[name] for name in AXIAL) == pytest.approx(whole[:, 2, 2].mean(), rel=0.01)


# ---------------------------------------------------------------- what is said, and runs that go on
def test_what_has_no_elastin_says_so_in_one_line() -> None:
    """With the key."""
    elastin = {"elastin": {"prestretch": [1.2, 1.5]}}
    isotropic_only = "must be [1.0, 1.0] unless cells.initial is 'isotropic'"
    key = "material.elastin.prestretch"
    cube: Any = {"geometry": {"shape": "cube"}, "material": elastin, "time": {"end": 1.0}}
    regions = {"media": {"outer_radius": 1.1, "material": elastin}, "adventitia": {}}
    random = {"initial": "random"}
    for make, line in (
        (lambda: scene_from_dict(cube), f"{key} = [1.2, 1.5]: must be [1.0, 1.0] unless geometry."),
        (lambda: passive([], (0.0, 1.5)), f"{key}[0] = 0.0: must be two numbers greater than 0"),
        (lambda: passive([], (1.2, -1.0)), f"{key}[1] = -1.0: must be two numbers greater than 0"),
        (lambda: passive([], (1.2,)), f"{key}[1]: missing; must be two numbers greater than 0"),
        (lambda: passive([], cells=random), f"{key} = [1.2, 1.5]: {isotropic_only}"),
        (lambda: own(TUBE, cells=random), f"{key} = [1.2, 1.5]: {isotropic_only}"),
        (
            lambda: passive([], (1.0, 1.0), cells=random, regions=regions),
            f"regions.media.{key} = [1.2, 1.5]: must be [1.0, 1.0] unless regions.media.cells",
        ),
    ):
        with pytest.raises(ValueError) as refused:
            make()
        said = str(refused.value)
        assert said.startswith(line) and "\n" not in said, said


def test_a_run_goes_on(tmp_path: Path) -> None:
    """Of a wall that grows."""
    names = [*RADII, *ANGLES, "content", "growth", *HOOP]
    scene = vessel(names, 40.0, EARLY, steps={"step": 4.0, "tolerance": None}, time=10.0)
    found = goes_on(scene, tmp_path, 12.0, 24.0)
    assert found.history["growth"][-1] != pytest.approx(1.0, abs=1e-2)
    assert "prestretch = [0.92, 1.36]" in (found.path / "scene.toml").read_text()


KEPT = ("lumen_volume", "fibre_angle_inner", "content", "growth", "elastin_stretch_axial")


def test_what_export_writes_begins_the_same_run(tmp_path: Path) -> None:
    """With the natural state that made fresh tissue stress-free; of tetrahedra, one F each."""
    mesh = write_tube(tmp_path / "tube.msh", "tetrahedron")
    tables: Any = {
        "natural": {},
        "material": {"repulsion": "log", "elastin": {"prestretch": [0.92, 1.36]}},
        "output": {"columns": [*KEPT], "report": False},
        "remodeling": grown(),
    }
    started = run(growing(mesh, 3.0, **tables), tmp_path / "run", SELF)
    file = export(started, "vtu", tmp_path / "first.vtu", 2.0)
    second = run(
        again(mesh, file, 1.0, **tables | {"natural": {"fibres": True}}), tmp_path / "second", SELF
    )
    original, read = (Recording(folder).history for folder in (started, second))
    assert abs(original["growth"][2] - 1.0) > 1e-3
    for name in KEPT:
        np.testing.assert_allclose(read[name][1], original[name][3], rtol=2e-3, err_msg=name)


ON_ONE_AND_TWO_RANKS = [{"scene": own_values(TUBE)}]


def test_two_ranks_find_the_same(cases: Cases) -> None:
    """Places and columns."""
    (one,), (two,) = (cases(ON_ONE_AND_TWO_RANKS, ranks) for ranks in (1, 2))
    for name in ("u", "lumen_volume", *ALONG):
        np.testing.assert_allclose(two[name], one[name], rtol=1e-7, atol=1e-8, err_msg=name)
